// One float of each of eight members of an ensemble, or of eight bodies, in vector registers: it adds, multiplies and
// compares lane by lane as a float does, so that a template takes either, and every lane has the bits of the float.
#pragma once

#include <cmath>
#include <type_traits>

#include "sums.hpp"

namespace eip {

typedef int64_t Bits __attribute__((vector_size(sizeof(Vector))));

inline Vector spread_vector(double x) {
#if defined(__AVX__)
    return Vector{x, x, x, x};
#else
    return Vector{x, x};
#endif
}

template <class Value>
inline Value spread(double x) {
    if constexpr (std::is_same_v<Value, double>)
        return x;
    else
        return spread_vector(x);
}

// One instruction, and below by the compiler's own name for it: the header with the processor's takes longer to compile
// than most of these files.
inline Vector sqrt(Vector v) {
    for (int k = 0; k < WIDTH; ++k) v[k] = std::sqrt(v[k]);
    return v;
}

// a b + c, rounded once.
#if defined(__FMA__) && !defined(__clang__)
inline Vector fused(Vector a, Vector b, Vector c) { return __builtin_ia32_vfmaddpd256(a, b, c); }
#else
#if !defined(__FMA__) && !defined(__ARM_FEATURE_FMA)
[[gnu::noinline]]  // calls a function lane by lane
#endif
inline Vector fused(Vector a, Vector b, Vector c) {
    for (int k = 0; k < WIDTH; ++k) c[k] = std::fma(a[k], b[k], c[k]);
    return c;
}
#endif

inline double fused(double a, double b, double c) { return std::fma(a, b, c); }

// A truth value for each of eight.
struct Mask {
    Bits part[VECTORS];

    // Lane k as bit k.
    unsigned bits() const {
        unsigned found = 0;
        for (int v = 0; v < VECTORS; ++v) {
#if defined(__AVX__) && !defined(__clang__)
            found |= static_cast<unsigned>(__builtin_ia32_movmskpd256((Vector)part[v])) << (v * WIDTH);
#else
            for (int k = 0; k < WIDTH; ++k) found |= (part[v][k] != 0 ? 1U : 0U) << (v * WIDTH + k);
#endif
        }
        return found;
    }
    bool lane(int64_t k) const { return (bits() >> k & 1U) != 0; }
    bool any() const { return bits() != 0; }
    bool all() const { return bits() == (1U << LANES) - 1U; }
    void set(int64_t k, bool value) { part[k / WIDTH][k % WIDTH] = value ? -1 : 0; }
};

struct Lanes8 {
    Vector part[VECTORS];

    Lanes8() = default;
    // Vector by vector: GCC copies the whole in pieces of 8 and 16 bytes, by way of memory.
    Lanes8(const Lanes8 &x) {
        for (int v = 0; v < VECTORS; ++v) part[v] = x.part[v];
    }
    Lanes8 &operator=(const Lanes8 &x) {
        for (int v = 0; v < VECTORS; ++v) part[v] = x.part[v];
        return *this;
    }
    Lanes8(double x) {  // NOLINT: a number stands for itself in every lane
        for (Vector &v : part) v = spread_vector(x);
    }

    static Lanes8 load(const double *a) {
        Lanes8 x;
        for (int v = 0; v < VECTORS; ++v) x.part[v] = eip::load(a + v * WIDTH);
        return x;
    }
    void store(double *a) const {
        for (int v = 0; v < VECTORS; ++v) eip::store(part[v], a + v * WIDTH);
    }
    double lane(int k) const { return part[k / WIDTH][k % WIDTH]; }
};

// Arrays of vectors are also arrays of 8 n floats, and masks choose lane by lane.
static_assert(sizeof(Lanes8) == LANES * sizeof(double) && sizeof(Mask) == sizeof(Lanes8) &&
              sizeof(Bits) == sizeof(Vector));

#define EIP_FOR_PARTS(Result, expression)                       \
    Result out;                                                 \
    for (int v = 0; v < VECTORS; ++v) out.part[v] = expression; \
    return out

inline Lanes8 operator+(const Lanes8 &a, const Lanes8 &b) { EIP_FOR_PARTS(Lanes8, a.part[v] + b.part[v]); }
inline Lanes8 operator-(const Lanes8 &a, const Lanes8 &b) { EIP_FOR_PARTS(Lanes8, a.part[v] - b.part[v]); }
inline Lanes8 operator*(const Lanes8 &a, const Lanes8 &b) { EIP_FOR_PARTS(Lanes8, a.part[v] * b.part[v]); }
inline Lanes8 operator/(const Lanes8 &a, const Lanes8 &b) { EIP_FOR_PARTS(Lanes8, a.part[v] / b.part[v]); }
inline Lanes8 operator-(const Lanes8 &a) { EIP_FOR_PARTS(Lanes8, -a.part[v]); }
inline Lanes8 &operator+=(Lanes8 &a, const Lanes8 &b) { return a = a + b; }
inline Lanes8 &operator-=(Lanes8 &a, const Lanes8 &b) { return a = a - b; }
inline Lanes8 &operator*=(Lanes8 &a, const Lanes8 &b) { return a = a * b; }
inline Mask operator<(const Lanes8 &a, const Lanes8 &b) { EIP_FOR_PARTS(Mask, a.part[v] < b.part[v]); }
inline Mask operator<=(const Lanes8 &a, const Lanes8 &b) { EIP_FOR_PARTS(Mask, a.part[v] <= b.part[v]); }
inline Mask operator>(const Lanes8 &a, const Lanes8 &b) { EIP_FOR_PARTS(Mask, a.part[v] > b.part[v]); }
inline Mask operator>=(const Lanes8 &a, const Lanes8 &b) { EIP_FOR_PARTS(Mask, a.part[v] >= b.part[v]); }
inline Mask operator==(const Lanes8 &a, const Lanes8 &b) { EIP_FOR_PARTS(Mask, a.part[v] == b.part[v]); }
inline Mask operator&(const Mask &a, const Mask &b) { EIP_FOR_PARTS(Mask, a.part[v] & b.part[v]); }
inline Mask operator|(const Mask &a, const Mask &b) { EIP_FOR_PARTS(Mask, a.part[v] | b.part[v]); }
inline Mask operator!(const Mask &a) { EIP_FOR_PARTS(Mask, ~a.part[v]); }
inline Lanes8 where(const Mask &mask, const Lanes8 &a, const Lanes8 &b) {
    EIP_FOR_PARTS(Lanes8, mask.part[v] ? a.part[v] : b.part[v]);
}
inline Lanes8 sqrt(const Lanes8 &a) { EIP_FOR_PARTS(Lanes8, sqrt(a.part[v])); }
inline Lanes8 abs(const Lanes8 &a) { EIP_FOR_PARTS(Lanes8, absolute(a.part[v])); }
inline Lanes8 multiply_add(const Lanes8 &a, const Lanes8 &b, const Lanes8 &c) {
    EIP_FOR_PARTS(Lanes8, fused(a.part[v], b.part[v], c.part[v]));
}

#undef EIP_FOR_PARTS

inline Lanes8 max(const Lanes8 &a, const Lanes8 &b) { return where(b > a, b, a); }
inline Lanes8 min(const Lanes8 &a, const Lanes8 &b) { return where(b < a, b, a); }
inline double multiply_add(double a, double b, double c) { return fused(a, b, c); }

}  // namespace eip
