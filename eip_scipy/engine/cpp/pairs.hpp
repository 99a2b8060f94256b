// Complex numbers in vectors, as pairs of floats.
//
// Products are written so because GCC 12 and later fuse the two halves of a loop over a c - b d and a d + b c into one
// operation (vfmaddsub) in spite of -ffp-contract=off: other bits where the processor has it.
#pragma once

#include "sums.hpp"

namespace eip {

// Loads the remaining floats into a vector and fills it with zeros.
inline Vector load_some(const double *a, int64_t left) {
    if (left >= WIDTH) return load(a);
    Vector v{};
    std::memcpy(&v, a, left * sizeof(double));
    return v;
}

inline void store_some(Vector v, double *a, int64_t left) {
    std::memcpy(a, &v, (left >= WIDTH ? WIDTH : left) * sizeof(double));
}

// With their parts exchanged.
inline Vector swapped(Vector z) {
    Vector w{};
    for (int k = 0; k < WIDTH; ++k) w[k] = z[k ^ 1];
    return w;
}

// (-s, s, -s, s): i s z is this times z with its parts exchanged.
inline Vector turning(double s) {
    Vector v;
    for (int k = 0; k < WIDTH; ++k) v[k] = k % 2 ? s : -s;
    return v;
}

inline Vector times(Vector w, Vector z) {
    Vector re{}, im{};
    for (int k = 0; k < WIDTH; ++k) {
        re[k] = w[k & ~1];
        im[k] = k % 2 ? w[k] : -w[k + 1];
    }
    return re * z + im * swapped(z);
}

}  // namespace eip
