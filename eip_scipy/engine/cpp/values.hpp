// One source for a float and for the floats of eight members: what the templates of the projection choose by a
// condition they choose lane by lane, and go another way only where no lane needs this one.
#pragma once

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstdint>

#include "lanes8.hpp"

namespace eip {

// Result of a comparison of two values; initialised as false.
template <class Value>
using Truth = decltype(std::declval<Value>() < std::declval<Value>());

inline double max(double a, double b) { return std::max(a, b); }
inline double min(double a, double b) { return std::min(a, b); }
inline double abs(double x) { return std::abs(x); }
inline double sqrt(double x) { return std::sqrt(x); }
inline double where(bool condition, double a, double b) { return condition ? a : b; }

// x^exponent for x in [0, 1] and an exponent in [1, 2], to fourteen digits. By arithmetic that has
// the same bits on every machine, and without branches, so that loops of it become vectors.
inline double power(double x, double exponent) {
    constexpr uint64_t ONE = 0x3ff0000000000000, ROOT = 0x3fe6a09e667f3bcd;  // the bits of 1 and of sqrt(1/2)
    constexpr double TO_52 = 0x1p52, ROUND = 0x1.8p52, LN2 = 0x1.62e42fefa39efp-1;
    // x = 2^k m, with m from sqrt(1/2) to sqrt(2); log(m) = 2 artanh(s).
    const auto bits = std::bit_cast<uint64_t>(x), biased = (bits - ROOT + ONE) >> 52;
    const double k = std::bit_cast<double>(biased | std::bit_cast<uint64_t>(TO_52)) - (TO_52 + 1023.0);
    const double m = std::bit_cast<double>(bits - (biased << 52) + ONE), s = (m - 1.0) / (m + 1.0), q = s * s;
    constexpr double ODD[] = {1.0 / 15.0, 1.0 / 13.0, 1.0 / 11.0, 1.0 / 9.0, 1.0 / 7.0, 1.0 / 5.0, 1.0 / 3.0, 1.0};
    double series = 1.0 / 17.0;
    for (const double term : ODD) series = term + q * series;
    const double log_m = 2.0 * s * series;
    // exp(u + n ln 2)
    const double y = exponent * (k + log_m * (1.0 / LN2)), rounded = y + ROUND, u = (y - (rounded - ROUND)) * LN2;
    constexpr double TERMS[] = {
        1.0 / 479001600.0, 1.0 / 39916800.0, 1.0 / 3628800.0, 1.0 / 362880.0, 1.0 / 40320.0, 1.0 / 5040.0, 1.0 / 720.0,
        1.0 / 120.0,       1.0 / 24.0,       1.0 / 6.0,       1.0 / 2.0,      1.0,           1.0};
    double sum = 1.0 / 6227020800.0;
    for (const double term : TERMS) sum = term + sum * u;
    const double scale = std::bit_cast<double>((std::bit_cast<uint64_t>(rounded) << 52) + ONE);
    return x > 1e-150 ? sum * scale : 0.0;
}

inline bool any(bool condition) { return condition; }
inline bool any(const Mask &mask) { return mask.any(); }

inline Lanes8 power(const Lanes8 &x, double exponent) {
    double lanes[LANES];
    x.store(lanes);
    for (double &lane : lanes) lane = power(lane, exponent);
    return Lanes8::load(lanes);
}

// Operand of the sums of sums.hpp instead of a float: a vector, whose lanes are added in the same order.
template <class Value>
inline const Value &load_as(const Lanes8 *a) {
    return *a;
}
template <class Value>
inline const Value &load_alone(const Lanes8 *a) {
    return *a;
}
inline void store_as(const Lanes8 &x, Lanes8 *a) { *a = x; }
template <class Value>
inline const Lanes8 &spread(const Lanes8 &x) {
    return x;
}
inline Lanes8 absolute(const Lanes8 &x) { return abs(x); }

// in_blocks of the entries of an array: floats in vectors, and vectors one by one. The pointer says which.
template <class Part>
[[gnu::always_inline]] inline void in_blocks(const double *, int64_t n, const Part &part) {
    in_blocks(n, part);
}
template <class Part>
[[gnu::always_inline]] inline void in_blocks(const Lanes8 *, int64_t n, const Part &part) {
    for (int64_t i = 0; i < n; ++i) part.template operator()<Lanes8, 1>(i);
}

template <class Term>
inline Lanes8 sum_of(const Lanes8 *, int64_t n, const Term &term) {
    const int64_t whole = n - n % LANES;
    Lanes8 rest(0.0);
    for (int64_t i = whole; i < n; ++i) rest += term.template operator()<Lanes8>(i);
    if (whole == 0) return rest;
    Lanes8 sums[LANES];
    for (Lanes8 &sum : sums) sum = 0.0;
    for (int64_t i = 0; i < whole; i += LANES)
        for (int k = 0; k < LANES; ++k) sums[k] += term.template operator()<Lanes8>(i + k);
    return ((sums[0] + sums[4]) + (sums[2] + sums[6])) + ((sums[1] + sums[5]) + (sums[3] + sums[7])) + rest;
}

inline AbsDots<Lanes8> abs_dots(const Lanes8 *a, const Lanes8 *b, const Lanes8 *c, int64_t n) {
    return {abs_dot(a, b, n), abs_dot(a, c, n)};
}

// The largest entry of non-negative ones, 0 for none; NaN is passed over.
template <class Value>
inline Value largest(const Value *a, int64_t n) {
    Value top = 0.0;
    for (int64_t i = 0; i < n; ++i) top = max(top, a[i]);
    return top;
}

// True if the sum of squares is finite: of a state so large that it overflows this says no.
inline Mask all_finite(const Lanes8 *a, int64_t n) {
    const Lanes8 square = dot(a, a, n);
    return square - square == 0.0;
}

// Floats as values and back: those of eight members are adjacent.
template <class Value>
inline Value *as_values(double *a) {
    return reinterpret_cast<Value *>(a);
}
inline double *as_floats(double *a) { return a; }
inline double *as_floats(Lanes8 *a) { return reinterpret_cast<double *>(a); }

// x, or 1 in place of 0: a divisor where the quotient does not count.
template <class Value>
inline Value positive(const Value &x) {
    return where(x > 0.0, x, 1.0);
}

}  // namespace eip
