// Arithmetic of numbers that are the sum of two floats.
#pragma once

#include <cmath>

#include "lanes8.hpp"

namespace eip {

// A number as the sum of two floats, or as many such numbers as a vector holds.
template <class Value>
struct PairOf {
    Value value, rest;
};

using Pair = PairOf<double>;

template <class Value>
inline PairOf<Value> two_sum(const Value &a, const Value &b) {
    const Value s = a + b, v = s - a;
    return {s, (a - (s - v)) + (b - v)};
}

// Both branches return the exact rounding error. Without a fused instruction Dekker's splitting is faster than a call of fma.
template <class Value>
inline PairOf<Value> two_product(const Value &a, const Value &b) {
    const Value p = a * b;
#if defined(__FMA__) || defined(__ARM_FEATURE_FMA)
    return {p, fused(a, b, -p)};
#else
    constexpr double SPLITTER = 134217729.0;  // 2^27 + 1
    Value x = SPLITTER * a;
    const Value a_high = x - (x - a), a_low = a - a_high;
    x = SPLITTER * b;
    const Value b_high = x - (x - b), b_low = b - b_high;
    return {p, ((a_high * b_high - p) + a_high * b_low + a_low * b_high) + a_low * b_low};
#endif
}

// Quotients, products and roots are accurate to a few units of 2^-104, sums to that of the larger term.
inline Pair quotient(const Pair &a, const Pair &b) {
    const double first = a.value / b.value;
    const Pair product = two_product(first, b.value);
    const double rest = (a.value - product.value) - product.rest + a.rest - first * b.rest;
    return two_sum(first, rest / b.value);
}

template <class Value>
inline PairOf<Value> product(const PairOf<Value> &a, const PairOf<Value> &b) {
    const PairOf<Value> p = two_product(a.value, b.value);
    return two_sum<Value>(p.value, p.rest + (a.value * b.rest + a.rest * b.value));
}

template <class Value>
inline PairOf<Value> sum(const PairOf<Value> &a, const PairOf<Value> &b) {
    const PairOf<Value> s = two_sum(a.value, b.value);
    return two_sum<Value>(s.value, s.rest + (a.rest + b.rest));
}

inline Pair square_root(const Pair &a) {
    const double first = std::sqrt(a.value);
    const Pair square = two_product(first, first);
    return two_sum(first, ((a.value - square.value) - square.rest + a.rest) / (2.0 * first));
}

}  // namespace eip
