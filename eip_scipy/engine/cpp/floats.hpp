// Small loops over floats.
#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

#include "values.hpp"

namespace eip {

template <class Value>
inline void copy(const Value *a, Value *out, int64_t n) {
    for (int64_t i = 0; i < n; ++i) out[i] = a[i];
}

template <class Value>
inline void fill(Value *a, double value, int64_t n) {
    for (int64_t i = 0; i < n; ++i) a[i] = value;
}

inline void scale_by(double *a, double factor, int64_t n) {
    for (int64_t i = 0; i < n; ++i) a[i] *= factor;
}

inline double largest_abs(const double *a, int64_t n) {
    double top = 0.0;
    for (int64_t i = 0; i < n; ++i) top = std::max(top, std::abs(a[i]));
    return top;
}

// The 2-norm, by squares where these neither vanish nor overflow.
inline double norm(const double *a, int64_t n) {
    const double square = dot(a, a, n);
    if (1e-200 < square && square < 1e200) return std::sqrt(square);
    const double top = largest_abs(a, n);
    if (top == 0.0 || !std::isfinite(top)) return square - square + top;
    double total = 0.0;
    for (int64_t i = 0; i < n; ++i) total += (a[i] / top) * (a[i] / top);
    return top * std::sqrt(total);
}

// One value for each of eight members.
inline Lanes8 norm(const Lanes8 *a, int64_t n) {
    const Lanes8 square = dot(a, a, n);
    const Mask extreme = !((1e-200 < square) & (square < 1e200));
    if (!any(extreme)) return sqrt(square);
    double norms[LANES];
    sqrt(square).store(norms);
    std::vector<double> own(n);
    for (int lane = 0; lane < LANES; ++lane) {
        if (!extreme.lane(lane)) continue;
        for (int64_t i = 0; i < n; ++i) own[i] = a[i].lane(lane);
        norms[lane] = norm(own.data(), n);
    }
    return Lanes8::load(norms);
}

// True if no entry is NaN or infinite: the sum of squares is finite too unless it overflows; x - x is 0 then.
inline bool all_finite(const double *a, int64_t n) {
    if (std::isfinite(dot(a, a, n))) return true;
    double total = 0.0;
    for (int64_t i = 0; i < n; ++i) total += a[i] - a[i];
    return total == 0.0;
}

inline void raise_to(const double *sizes, double *record, int64_t n) {
    for (int64_t i = 0; i < n; ++i) record[i] = std::max(record[i], std::abs(sizes[i]));
}

inline void midpoint(const double *a, const double *b, double *out, int64_t n) {
    for (int64_t i = 0; i < n; ++i) out[i] = 0.5 * (a[i] + b[i]);
}

// out = sqrt(a^2 + b^2) by component, by hypot where squares would vanish or overflow.
inline void quadrature(const double *a, const double *b, double *out, int64_t n) {
    for (int64_t i = 0; i < n; ++i) {
        const double size = std::abs(a[i]) + std::abs(b[i]);
        const bool extreme = size > 1e140 || (size < 1e-140 && size > 0.0);
        out[i] = extreme ? std::hypot(a[i], b[i]) : std::sqrt(a[i] * a[i] + b[i] * b[i]);
    }
}

}  // namespace eip
