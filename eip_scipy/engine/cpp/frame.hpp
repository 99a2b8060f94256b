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
    Triple operator*(const Triple &other) const { return {x * other.x, y * other.y, z * other.z}; }
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
    void store_last(double *out) const {
        std::memcpy(out, &part, 2 * sizeof(double));
        out[2] = part[2];
    }
    Triple operator-() const { return {-part}; }
    Triple operator*(const Triple &other) const { return {part * other.part}; }
};

template <>
inline Triple<double> multiply_add(const Triple<double> &a, const Triple<double> &b, const Triple<double> &c) {
    return {fused(a.part, b.part, c.part)};
}
#endif

// Weighted sums over bodies of their x, y and z, of several rows at once: each addition waits for the last one.
template <int ROWS, class Value>
inline void sum_bodies(const double *weights, const Value *rows, int64_t stride, int64_t count, Triple<Value> *out) {
    using Body = Triple<Value>;
    Body sums[ROWS];
    for (int64_t j = 0; j + 1 < count; ++j)
        for (int i = 0; i < ROWS; ++i)
            sums[i] = multiply_add(Body::spread(weights[j]), Body::load(rows + i * stride + 3 * j), sums[i]);
    const int64_t last = count - 1;
    for (int i = 0; i < ROWS; ++i)
        out[i] = multiply_add(Body::spread(weights[last]), Body::load_last(rows + i * stride + 3 * last), sums[i]);
}

// out = factors (row - weights[j] (x, y, z)) for each body j, where there are factors; what is stored behind a body is
// overwritten by the next one.
template <class Value>
inline void shift_bodies(const Value *row, const double *weights, const Triple<Value> &by, const Value *factors,
                         Value *out, int64_t count) {
    using Body = Triple<Value>;
    const Body back = -by;
    for (int64_t j = 0; j + 1 < count; ++j) {
        const Body body = multiply_add(Body::spread(weights[j]), back, Body::load(row + 3 * j));
        (factors ? body * Body::load(factors + 3 * j) : body).store(out + 3 * j);
    }
    const int64_t last = 3 * (count - 1);
    const Body body = multiply_add(Body::spread(weights[count - 1]), back, Body::load_last(row + last));
    (factors ? body * Body::load_last(factors + last) : body).store_last(out + last);
}

// Computes sigma * (row projected along the frame of bodies) for `ROWS` rows from G on, into B.
template <int ROWS, class Value, class W>
inline void project_rows(const Frame &frame, const W &w, const Value *G, Value *B) {
    for (int64_t k = 0; k < frame.groups; ++k) {
        const int64_t first = 3 * frame.count * k;
        const double *C = frame.bodies + k * frame.count, *M = C + frame.groups * frame.count;
        Triple<Value> sums[ROWS];
        sum_bodies<ROWS>(M, G + first, w.m, frame.count, sums);
        for (int i = 0; i < ROWS; ++i)
            shift_bodies(G + i * w.m + first, C, sums[i], w.sigma + first, B + i * w.m + first, frame.count);
    }
}

// Rows B_i = sigma * (G_i projected along the frame).
template <class Value, class W>
inline void weigh_rows(const Frame &frame, const W &w, Value *B) {
    constexpr int ROWS = sizeof(Value) > sizeof(double) ? 1 : 4;  // as many as registers take
    int64_t first = 0;
    for (; first + ROWS <= w.l; first += ROWS) project_rows<ROWS>(frame, w, w.gradient(first), B + first * w.m);
    for (; first < w.l; ++first) project_rows<1>(frame, w, w.gradient(first), B + first * w.m);
    if (frame.groups > 0) return;
    for (int64_t i = 0; i < w.l; ++i) {
        const Value *G = w.gradient(i);
        Value *row = B + i * w.m;
        if (frame.rows > 0) {
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
        Triple<Value> sum;
        sum_bodies<1>(C, move + first, w.m, frame.count, &sum);
        shift_bodies<Value>(move + first, M, sum, nullptr, out + first, frame.count);
    }
    if (frame.groups == 0) {
        copy(move, out, w.m);
        remove_sparse(frame, 0, w.products, out);
    }
}

}  // namespace eip
