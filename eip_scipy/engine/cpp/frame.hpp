// Gradients and corrections made neutral to a frame of linear invariants.
#pragma once

#include "system.hpp"

namespace eip {

// Row k of C (which = 0) or of M^T (1).
inline double sparse_product(const Frame &frame, int which, int64_t k, const double *a) {
    const uint64_t *start = frame.start + which * (frame.rows + 1);
    double total = 0.0;
    for (uint64_t p = start[k]; p < start[k + 1]; ++p) total += frame.value[p] * a[frame.place[p]];
    return total;
}

// a -= sum_k factors[k] times that row.
inline void subtract_sparse(const Frame &frame, int which, double *a) {
    const uint64_t *start = frame.start + which * (frame.rows + 1);
    for (int64_t k = 0; k < frame.rows; ++k)
        for (uint64_t p = start[k]; p < start[k + 1]; ++p) a[frame.place[p]] -= frame.products[k] * frame.value[p];
}

// a minus its part along one of the two, which the other one measures.
inline void remove_sparse(const Frame &frame, int measure, double *a) {
    for (int64_t k = 0; k < frame.rows; ++k) frame.products[k] = sparse_product(frame, measure, k, a);
    subtract_sparse(frame, 1 - measure, a);
}

// Weighted sum over bodies of their x, y and z, each product and sum rounded once.
struct Triple {
    double x = 0.0, y = 0.0, z = 0.0;
};

inline Triple sum_bodies(const double *weights, const double *row, int64_t count) {
    Triple sum;
    for (int64_t j = 0; j < count; ++j) {
        sum.x = std::fma(weights[j], row[3 * j], sum.x);
        sum.y = std::fma(weights[j], row[3 * j + 1], sum.y);
        sum.z = std::fma(weights[j], row[3 * j + 2], sum.z);
    }
    return sum;
}

// out = row - weights[j] (x, y, z) for each body j.
inline void shift_bodies(const double *row, const double *weights, const Triple &by, double *out, int64_t count) {
    for (int64_t j = 0; j < count; ++j) {
        out[3 * j] = std::fma(weights[j], -by.x, row[3 * j]);
        out[3 * j + 1] = std::fma(weights[j], -by.y, row[3 * j + 1]);
        out[3 * j + 2] = std::fma(weights[j], -by.z, row[3 * j + 2]);
    }
}

// Rows B_i = sigma * (G_i projected along the frame).
template <class W>
inline void weigh_rows(const Frame &frame, const W &w, double *B) {
    for (int64_t i = 0; i < w.l; ++i) {
        const double *G = w.gradient(i);
        double *row = B + i * w.m;
        for (int64_t k = 0; k < frame.groups; ++k) {
            const int64_t first = 3 * frame.count * k;
            const double *C = frame.bodies + k * frame.count, *M = C + frame.groups * frame.count;
            shift_bodies(G + first, C, sum_bodies(M, G + first, frame.count), row + first, frame.count);
        }
        if (frame.groups == 0 && frame.rows > 0) {
            copy(G, row, w.m);
            remove_sparse(frame, 1, row);
        }
        const double *from = frame.rows > 0 ? row : G;
        for (int64_t j = 0; j < w.m; ++j) row[j] = from[j] * w.sigma[j];
    }
}

// out = move - M C move, neutral to the frame.
inline void keep_frame(const Frame &frame, const double *move, double *out, int64_t m) {
    for (int64_t k = 0; k < frame.groups; ++k) {
        const int64_t first = 3 * frame.count * k;
        const double *C = frame.bodies + k * frame.count, *M = C + frame.groups * frame.count;
        shift_bodies(move + first, M, sum_bodies(C, move + first, frame.count), out + first, frame.count);
    }
    if (frame.groups == 0) {
        copy(move, out, m);
        remove_sparse(frame, 0, out);
    }
}

}  // namespace eip
