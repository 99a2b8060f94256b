// Sums in an order of their own: lane k sums the entries k, k + 8, k + 16, ...; the lanes are added in pairs, the entries
// beyond the last multiple of eight come last. The same bits on every processor, whatever its vectors' length.
#pragma once

#include <cstdint>
#include <cstring>

namespace eip {

constexpr int64_t LANES = 8;

// No wider than the processor's registers: GCC lowers wider ones through memory.
#if defined(__AVX__)
constexpr int WIDTH = 4;
#else
constexpr int WIDTH = 2;
#endif
typedef double Vector __attribute__((vector_size(WIDTH * sizeof(double))));
constexpr int VECTORS = LANES / WIDTH;
static_assert(sizeof(Vector) == WIDTH * sizeof(double) && VECTORS * WIDTH == LANES);

// One float, or a vector of them.
template <class Value>
inline Value load_as(const double *a) {
    Value v;
    std::memcpy(&v, a, sizeof v);
    return v;
}

template <class Value>
inline void store_as(Value v, double *a) {
    std::memcpy(a, &v, sizeof v);
}

inline Vector load(const double *a) { return load_as<Vector>(a); }

inline void store(Vector v, double *a) { store_as(v, a); }

// A vector, or a float that the compiler must not load, or store, together with its neighbours: the load of a vector waits until
// all floats that have just been written there are in the cache, and to pack them takes longer than to compute with each.
template <typename Float>
inline Float load_alone(const double *a) {
    if constexpr (sizeof(Float) == sizeof(double))
        return *const_cast<const volatile double *>(a);
    else
        return load_as<Float>(a);
}

template <typename Float>
inline void store_alone(Float value, double *a) {
    if constexpr (sizeof(Float) == sizeof(double))
        *static_cast<volatile double *>(a) = value;
    else
        store_as(value, a);
}

// part.template operator()<Value, COUNT>(i): COUNT vectors, or floats, from i on, until n. No entry is met twice, and
// vectors begin at multiples of their length: what has just been written in such vectors is read at once.
template <class Part>
[[gnu::always_inline]] inline void in_blocks(int64_t n, const Part &part) {
    int64_t i = 0;
    for (; i + 4 * WIDTH <= n; i += 4 * WIDTH) part.template operator()<Vector, 4>(i);
    if (i + 2 * WIDTH <= n) part.template operator()<Vector, 2>(i), i += 2 * WIDTH;
    if (i + WIDTH <= n) part.template operator()<Vector, 1>(i), i += WIDTH;
    for (; i < n; ++i) part.template operator()<double, 1>(i);
}

struct Lanes {
    Vector part[VECTORS] = {};

    double sum() const {
        double lane[LANES];
        std::memcpy(lane, part, sizeof lane);
        return ((lane[0] + lane[4]) + (lane[2] + lane[6])) + ((lane[1] + lane[5]) + (lane[3] + lane[7]));
    }
};

inline Vector absolute(Vector v) {
    for (int k = 0; k < WIDTH; ++k) v[k] = __builtin_fabs(v[k]);
    return v;
}

inline double absolute(double x) { return __builtin_fabs(x); }

// The sum of the terms of all i < n; term<Value>(i) is that of one float, or a vector of those from i on. The pointer says
// what is added: floats, or vectors (values.hpp).
template <class Term>
[[gnu::always_inline]] inline double sum_of(const double *, int64_t n, const Term &term) {
    const int64_t whole = n - n % LANES;
    double rest = 0.0;
    for (int64_t i = whole; i < n; ++i) rest += term.template operator()<double>(i);
    if (whole == 0) return 0.0 + rest;
    Lanes lanes;
    for (int64_t i = 0; i < whole; i += LANES)
        for (int k = 0; k < VECTORS; ++k) lanes.part[k] += term.template operator()<Vector>(i + k * WIDTH);
    return lanes.sum() + rest;
}

template <class Value>
[[gnu::always_inline]] inline Value dot(const Value *a, const Value *b, int64_t n) {
    return sum_of(a, n, [=]<class Part>(int64_t i) { return load_alone<Part>(a + i) * load_alone<Part>(b + i); });
}

// Sum of |a_i b_i|.
template <class Value>
[[gnu::always_inline]] inline Value abs_dot(const Value *a, const Value *b, int64_t n) {
    return sum_of(a, n,
                  [=]<class Part>(int64_t i) { return absolute(load_alone<Part>(a + i) * load_alone<Part>(b + i)); });
}

// Sum of (a_i b_i)^2.
template <class Value>
inline Value square_dot(const Value *a, const Value *b, int64_t n) {
    return sum_of(a, n, [=]<class Part>(int64_t i) {
        const Part x = load_as<Part>(a + i) * load_as<Part>(b + i);
        return x * x;
    });
}

// Sums of |a_i b_i| and of |a_i c_i|, each as by `abs_dot`, in one pass over floats.
template <class Value>
struct AbsDots {
    Value b, c;
};

inline AbsDots<double> abs_dots(const double *a, const double *b, const double *c, int64_t n) {
    const int64_t whole = n - n % LANES;
    double rest_b = 0.0, rest_c = 0.0;
    for (int64_t i = whole; i < n; ++i) {
        rest_b += absolute(a[i] * b[i]);
        rest_c += absolute(a[i] * c[i]);
    }
    if (whole == 0) return {0.0 + rest_b, 0.0 + rest_c};
    Lanes lanes_b, lanes_c;
    for (int64_t i = 0; i < whole; i += LANES)
        for (int k = 0; k < VECTORS; ++k) {
            const int64_t at = i + k * WIDTH;
            const Vector x = load(a + at);
            lanes_b.part[k] += absolute(x * load(b + at));
            lanes_c.part[k] += absolute(x * load(c + at));
        }
    return {lanes_b.sum() + rest_b, lanes_c.sum() + rest_c};
}

// row -= (unit . row) unit; that product, and the square of what is left.
struct Removed {
    double product, square;
};

inline Removed remove_component(double *row, const double *unit, int64_t n) {
    const double r = dot<double>(unit, row, n);
    const double square = sum_of(row, n, [=]<class Part>(int64_t i) {
        const Part left = load_as<Part>(row + i) - r * load_as<Part>(unit + i);
        store_as(left, row + i);
        return left * left;
    });
    return {r, square};
}

// Rows of stages and their weights: sum_j weights[j] rows[j], in this order, weights of 0 skipped.
struct Rows {
    const double *weights, *first;
    int64_t count, stride;
};

// Vectors, or floats, number K... of out = y + scale sum or, without ADD, of scale sum. The sums stay in registers because the
// compiler takes the numbers as constants from the start, which it does not in a loop.
template <typename Float, bool ADD, int... K>
[[gnu::always_inline]] inline void combine_those(const double *y, double scale, const Rows &rows, double *out,
                                                 std::integer_sequence<int, K...>) {
    constexpr int LENGTH = sizeof(Float) / sizeof(double);
    Float total[sizeof...(K)] = {};
    for (int64_t j = 0; j < rows.count; ++j) {
        const double weight = rows.weights[j], *row = rows.first + j * rows.stride;
        if (weight == 0.0) continue;
        ((total[K] += weight * load_alone<Float>(row + K * LENGTH)), ...);
    }
    ((total[K] *= scale), ...);
    if constexpr (ADD) ((total[K] += load_as<Float>(y + K * LENGTH)), ...);
    (store_alone(total[K], out + K * LENGTH), ...);
}

template <typename Float, int COUNT, bool ADD>
[[gnu::always_inline]] inline void combine_part(const double *y, double scale, const Rows &rows, double *out,
                                                int64_t i) {
    const Rows from{rows.weights, rows.first + i, rows.count, rows.stride};
    combine_those<Float, ADD>(y + i, scale, from, out + i, std::make_integer_sequence<int, COUNT>{});
}

// Blocks of one length; the last one ends with the array and may overlap the one before it.
template <typename Float, int COUNT, bool ADD>
inline void combine_blocks(const double *y, double scale, const Rows &rows, double *out, int64_t n) {
    constexpr int64_t LENGTH = COUNT * sizeof(Float) / sizeof(double);
    for (int64_t i = 0; i < n; i += LENGTH)
        combine_part<Float, COUNT, ADD>(y, scale, rows, out, i < n - LENGTH ? i : n - LENGTH);
}

// Combines short rows, float by float: the last row has just been written so, and a load of several floats would wait
// until all those stores are done.
template <bool ADD, int COUNT = 2 * WIDTH - 1>
inline void combine_short(const double *y, double scale, const Rows &rows, double *out, int64_t n) {
    if (n == COUNT) return combine_part<double, COUNT, ADD>(y, scale, rows, out, 0);
    if constexpr (COUNT > 1) combine_short<ADD, COUNT - 1>(y, scale, rows, out, n);
}

template <bool ADD>
inline void combine_rows(const double *y, double scale, const Rows &rows, double *out, int64_t n) {
    if (n >= 4 * WIDTH)
        combine_blocks<Vector, 4, ADD>(y, scale, rows, out, n);
    else if (n >= 2 * WIDTH)
        combine_blocks<Vector, 2, ADD>(y, scale, rows, out, n);
    else
        combine_short<ADD>(y, scale, rows, out, n);
}

// out = y + scale sum; out is neither y nor a row.
inline void combine(const double *y, double scale, const Rows &rows, double *out, int64_t n) {
    combine_rows<true>(y, scale, rows, out, n);
}

// out = scale sum.
inline void weighted_sum(double scale, const Rows &rows, double *out, int64_t n) {
    combine_rows<false>(nullptr, scale, rows, out, n);
}

}  // namespace eip
