// Vectors of three numbers, which may be dual: numbers with their derivatives along eight columns.
#pragma once

#include <array>
#include <cmath>
#include <type_traits>

#include "../lanes8.hpp"

namespace eip {

struct Dual {
    double value = 0.0;
    Lanes8 slope = 0.0;

    Dual() = default;
    Dual(double x) : value(x) {}  // NOLINT: a constant
    Dual(double x, const Lanes8 &slope) : value(x), slope(slope) {}

    Dual operator-() const { return {-value, -slope}; }
    Dual &operator+=(const Dual &b) { return *this = {value + b.value, slope + b.slope}; }
    Dual &operator-=(const Dual &b) { return *this += -b; }
};

inline Dual operator+(Dual a, const Dual &b) { return a += b; }
inline Dual operator-(Dual a, const Dual &b) { return a -= b; }
inline Dual operator*(const Dual &a, const Dual &b) {
    return {a.value * b.value, a.value * b.slope + b.value * a.slope};
}
inline Dual operator/(const Dual &a, const Dual &b) {
    const double quotient = a.value / b.value;
    return {quotient, (a.slope - quotient * b.slope) / b.value};
}
// At 0 it has no derivative: what moves nowhere is 0 in all directions.
inline Dual sqrt(const Dual &a) {
    const double root = std::sqrt(a.value);
    return {root, a.slope * (root > 0.0 ? 0.5 / root : 0.0)};
}
inline Dual exp(const Dual &a) {
    const double power = std::exp(a.value);
    return {power, a.slope * power};
}

template <class T>
using Vec3 = std::array<T, 3>;
using Three = Vec3<double>;
template <class T>
using Factor = std::type_identity_t<T>;  // of which the type is not deduced

template <class T>
inline T dot(const Vec3<T> &a, const Vec3<T> &b) {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}
template <class T>
inline Vec3<T> cross(const Vec3<T> &a, const Vec3<T> &b) {
    return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}
template <class T>
inline Vec3<T> body(const T *vectors, int64_t i) {
    return {vectors[3 * i], vectors[3 * i + 1], vectors[3 * i + 2]};
}
// s a + t b.
template <class T>
inline Vec3<T> sum(const Factor<T> &s, const Vec3<T> &a, const Factor<T> &t, const Vec3<T> &b) {
    return {s * a[0] + t * b[0], s * a[1] + t * b[1], s * a[2] + t * b[2]};
}
template <class T>
inline Vec3<T> operator-(const Vec3<T> &a, const Vec3<T> &b) {
    return {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
}
template <class T>
inline Vec3<T> operator-(const Vec3<T> &a) {
    return {-a[0], -a[1], -a[2]};
}
template <class T>
inline void add(T *out, int64_t i, const Factor<T> &s, const Vec3<T> &a) {
    for (int c = 0; c < 3; ++c) out[3 * i + c] += s * a[c];
}

}  // namespace eip
