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

struct Octet {
    Vector part[VECTORS];

    Octet() = default;
    // Vector by vector: GCC copies the whole in pieces of 8 and 16 bytes, by way of memory.
    Octet(const Octet &x) {
        for (int v = 0; v < VECTORS; ++v) part[v] = x.part[v];
    }
    Octet &operator=(const Octet &x) {
        for (int v = 0; v < VECTORS; ++v) part[v] = x.part[v];
        return *this;
    }
    Octet(double x) {  // NOLINT: a number stands for itself in every lane
        for (Vector &v : part) v = spread_vector(x);
    }

    static Octet load(const double *a) {
        Octet x;
        for (int v = 0; v < VECTORS; ++v) x.part[v] = eip::load(a + v * WIDTH);
        return x;
    }
    void store(double *a) const {
        for (int v = 0; v < VECTORS; ++v) eip::store(part[v], a + v * WIDTH);
    }
    double lane(int k) const { return part[k / WIDTH][k % WIDTH]; }
};

// Arrays of vectors are also arrays of 8 n floats, and masks choose lane by lane.
static_assert(sizeof(Octet) == LANES * sizeof(double) && sizeof(Mask) == sizeof(Octet) &&
              sizeof(Bits) == sizeof(Vector));

#define EIP_FOR_PARTS(Result, expression)                       \
    Result out;                                                 \
    for (int v = 0; v < VECTORS; ++v) out.part[v] = expression; \
    return out

inline Octet operator+(const Octet &a, const Octet &b) { EIP_FOR_PARTS(Octet, a.part[v] + b.part[v]); }
inline Octet operator-(const Octet &a, const Octet &b) { EIP_FOR_PARTS(Octet, a.part[v] - b.part[v]); }
inline Octet operator*(const Octet &a, const Octet &b) { EIP_FOR_PARTS(Octet, a.part[v] * b.part[v]); }
inline Octet operator/(const Octet &a, const Octet &b) { EIP_FOR_PARTS(Octet, a.part[v] / b.part[v]); }
inline Octet operator-(const Octet &a) { EIP_FOR_PARTS(Octet, -a.part[v]); }
inline Octet &operator+=(Octet &a, const Octet &b) { return a = a + b; }
inline Octet &operator-=(Octet &a, const Octet &b) { return a = a - b; }
inline Octet &operator*=(Octet &a, const Octet &b) { return a = a * b; }
inline Mask operator<(const Octet &a, const Octet &b) { EIP_FOR_PARTS(Mask, a.part[v] < b.part[v]); }
inline Mask operator<=(const Octet &a, const Octet &b) { EIP_FOR_PARTS(Mask, a.part[v] <= b.part[v]); }
inline Mask operator>(const Octet &a, const Octet &b) { EIP_FOR_PARTS(Mask, a.part[v] > b.part[v]); }
inline Mask operator>=(const Octet &a, const Octet &b) { EIP_FOR_PARTS(Mask, a.part[v] >= b.part[v]); }
inline Mask operator==(const Octet &a, const Octet &b) { EIP_FOR_PARTS(Mask, a.part[v] == b.part[v]); }
inline Mask operator&(const Mask &a, const Mask &b) { EIP_FOR_PARTS(Mask, a.part[v] & b.part[v]); }
inline Mask operator|(const Mask &a, const Mask &b) { EIP_FOR_PARTS(Mask, a.part[v] | b.part[v]); }
inline Mask operator!(const Mask &a) { EIP_FOR_PARTS(Mask, ~a.part[v]); }
inline Octet where(const Mask &mask, const Octet &a, const Octet &b) {
    EIP_FOR_PARTS(Octet, mask.part[v] ? a.part[v] : b.part[v]);
}
inline Octet sqrt(const Octet &a) { EIP_FOR_PARTS(Octet, sqrt(a.part[v])); }
inline Octet abs(const Octet &a) { EIP_FOR_PARTS(Octet, absolute(a.part[v])); }
inline Octet multiply_add(const Octet &a, const Octet &b, const Octet &c) {
    EIP_FOR_PARTS(Octet, fused(a.part[v], b.part[v], c.part[v]));
}

#undef EIP_FOR_PARTS

inline Octet max(const Octet &a, const Octet &b) { return where(b > a, b, a); }
inline Octet min(const Octet &a, const Octet &b) { return where(b < a, b, a); }
inline double multiply_add(double a, double b, double c) { return fused(a, b, c); }

}  // namespace eip
