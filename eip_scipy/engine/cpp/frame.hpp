// Gradients and corrections made neutral to a frame of linear invariants.
#pragma once

#include "system.hpp"

namespace eip {

// Row k of C (which = 0) or of M^T (1).
template <class Value>
inline Value sparse_product(const Frame &frame, int which, int64_t k, const Value *a) {
    const uint64_t *start = frame.start + which * (frame.rows + 1);
    Value total = 0.0;
    for (uint64_t p = start[k]; p < start[k + 1]; ++p) total += frame.value[p] * a[frame.place[p]];
    return total;
}

// a -= sum_k factors[k] times that row.
template <class Value>
inline void subtract_sparse(const Frame &frame, int which, const Value *factors, Value *a) {
    const uint64_t *start = frame.start + which * (frame.rows + 1);
    for (int64_t k = 0; k < frame.rows; ++k)
        for (uint64_t p = start[k]; p < start[k + 1]; ++p) a[frame.place[p]] -= factors[k] * frame.value[p];
}

// a minus its part along one of the two, which the other one measures.
template <class Value>
inline void remove_sparse(const Frame &frame, int measure, Value *products, Value *a) {
    for (int64_t k = 0; k < frame.rows; ++k) products[k] = sparse_product(frame, measure, k, a);
    subtract_sparse(frame, 1 - measure, products, a);
}

// x, y and z of a body; each product and sum rounded once.
template <class Value>
struct Triple {
    Value x = 0.0, y = 0.0, z = 0.0;

    static Triple spread(double weight) { return {weight, weight, weight}; }
    static Triple load(const Value *a) { return {a[0], a[1], a[2]}; }
    static Triple load_last(const Value *a) { return load(a); }
    void store(Value *out) const { out[0] = x, out[1] = y, out[2] = z; }
    void store_last(Value *out) const { store(out); }
    Triple operator-() const { return {-x, -y, -z}; }
};

template <class Value>
inline Triple<Value> multiply_add(const Triple<Value> &a, const Triple<Value> &b, const Triple<Value> &c) {
    return {multiply_add(a.x, b.x, c.x), multiply_add(a.y, b.y, c.y), multiply_add(a.z, b.z, c.z)};
}

#if defined(__FMA__)
// With a fourth number that means nothing.
template <>
struct Triple<double> {
    Vector part = {};

    static Triple spread(double weight) { return {spread_vector(weight)}; }
    static Triple load(const double *a) { return {eip::load(a)}; }
    static Triple load_last(const double *a) { return {Vector{a[0], a[1], a[2], 0.0}}; }
    void store(double *out) const { eip::store(part, out); }
    void store_last(double *out) const { std::memcpy(out, &part, 3 * sizeof(double)); }
    Triple operator-() const { return {-part}; }
};

template <>
inline Triple<double> multiply_add(const Triple<double> &a, const Triple<double> &b, const Triple<double> &c) {
    return {fused(a.part, b.part, c.part)};
}
#endif

// Weighted sum over bodies of their x, y and z.
template <class Value>
inline Triple<Value> sum_bodies(const double *weights, const Value *row, int64_t count) {
    using Body = Triple<Value>;
    Body sum;
    for (int64_t j = 0; j + 1 < count; ++j) sum = multiply_add(Body::spread(weights[j]), Body::load(row + 3 * j), sum);
    return multiply_add(Body::spread(weights[count - 1]), Body::load_last(row + 3 * (count - 1)), sum);
}

// out = row - weights[j] (x, y, z) for each body j; what is stored behind a body is overwritten by the next one.
template <class Value>
inline void shift_bodies(const Value *row, const double *weights, const Triple<Value> &by, Value *out, int64_t count) {
    using Body = Triple<Value>;
    const Body back = -by;
    for (int64_t j = 0; j + 1 < count; ++j)
        multiply_add(Body::spread(weights[j]), back, Body::load(row + 3 * j)).store(out + 3 * j);
    const int64_t last = count - 1;
    multiply_add(Body::spread(weights[last]), back, Body::load_last(row + 3 * last)).store_last(out + 3 * last);
}

// Rows B_i = sigma * (G_i projected along the frame).
template <class Value, class W>
inline void weigh_rows(const Frame &frame, const W &w, Value *B) {
    for (int64_t i = 0; i < w.l; ++i) {
        const Value *G = w.gradient(i);
        Value *row = B + i * w.m;
        for (int64_t k = 0; k < frame.groups; ++k) {
            const int64_t first = 3 * frame.count * k;
            const double *C = frame.bodies + k * frame.count, *M = C + frame.groups * frame.count;
            shift_bodies(G + first, C, sum_bodies(M, G + first, frame.count), row + first, frame.count);
        }
        if (frame.groups == 0 && frame.rows > 0) {
            copy(G, row, w.m);
            remove_sparse(frame, 1, w.products, row);
        }
        const Value *from = frame.rows > 0 ? row : G;
        for (int64_t j = 0; j < w.m; ++j) row[j] = from[j] * w.sigma[j];
    }
}

// out = move - M C move, neutral to the frame.
template <class Value, class W>
inline void keep_frame(const Frame &frame, const W &w, const Value *move, Value *out) {
    for (int64_t k = 0; k < frame.groups; ++k) {
        const int64_t first = 3 * frame.count * k;
        const double *C = frame.bodies + k * frame.count, *M = C + frame.groups * frame.count;
        shift_bodies(move + first, M, sum_bodies(C, move + first, frame.count), out + first, frame.count);
    }
    if (frame.groups == 0) {
        copy(move, out, w.m);
        remove_sparse(frame, 0, w.products, out);
    }
}

}  // namespace eip
