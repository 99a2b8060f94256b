// Least-norm solutions of a few equations with long rows.
#pragma once

#include <utility>

#include "floats.hpp"

namespace eip {

constexpr double RANK_TOLERANCE = 1.4901161193847656e-08;  // sqrt(EPS)
// Below this length one Gram-Schmidt pass would leave errors of 1e-13 and more of the residuals uncorrected.
constexpr double REORTHOGONALISE = 0.05;
// Rows of length 1 of which less than this is left without their components along others are nearly dependent.
constexpr double NEARLY_DEPENDENT = 1e-4;
// Columns of derivatives are not corrected along a row of which less than this is left: the gradients, at a state that has
// errors, do not say more about that direction than the steps.
constexpr double PARALLEL = 1e-2;

// Rows of a matrix, `stride` values from one to the next.
template <class Value>
struct MatrixOf {
    Value *data;
    int64_t rows, columns, stride;

    Value *row(int64_t i) const { return data + i * stride; }
    Value &operator()(int64_t i, int64_t j) const { return data[i * stride + j]; }
};

using Matrix = MatrixOf<double>;

// Pivoted QR of the normalised rows of B, in place; returns the numerical rank, -1 where B is not finite.
//
// `inverse_norms` normalise the rows (0 for a zero row). Row pivots[k] of B becomes the k-th orthonormal direction;
// R(k, i) is the component of normalised row i along it, except for i = pivots[k] its reciprocal. By modified
// Gram-Schmidt, with a second pass where cancellation would have spoilt the first.
[[gnu::noinline]] inline int64_t factor(const Matrix &B, double *inverse_norms, const Matrix &R, int64_t *pivots) {
    const int64_t rows = B.rows, n = B.columns;
    int64_t first = 0;
    for (int64_t i = 0; i < rows; ++i) {
        pivots[i] = i;
        const double length = norm(B.row(i), n);
        if (!std::isfinite(length)) return -1;
        inverse_norms[i] = length > 0.0 ? 1.0 / length : 0.0;
        scale_by(B.row(i), inverse_norms[i], n);
        if (inverse_norms[first] == 0.0) first = i;
    }
    if (rows == 0 || inverse_norms[first] == 0.0) return 0;
    pivots[0] = first;
    pivots[first] = 0;
    R(0, first) = 1.0;
    for (int64_t k = 1; k < rows; ++k) {
        int64_t best = k;
        double left = -1.0;
        for (int64_t p = k; p < rows; ++p) {
            const Removed removed = remove_component(B.row(pivots[p]), B.row(pivots[k - 1]), n);
            R(k - 1, pivots[p]) = removed.product;
            if (removed.square > left) {
                best = p;
                left = removed.square;
            }
        }
        double length = std::sqrt(left);
        std::swap(pivots[k], pivots[best]);
        const int64_t row = pivots[k];
        if (RANK_TOLERANCE < length && length < REORTHOGONALISE) {
            for (int64_t q = 0; q < k; ++q) {
                const Removed removed = remove_component(B.row(row), B.row(pivots[q]), n);
                R(q, row) += removed.product;
                left = removed.square;
            }
            length = std::sqrt(left);
        }
        if (length <= RANK_TOLERANCE) return k;
        R(k, row) = 1.0 / length;
        scale_by(B.row(row), R(k, row), n);
    }
    return rows;
}

// Return how many of the first `rank` rows that `factor` chose are not nearly dependent.
inline int64_t clearly_independent(const Matrix &R, const int64_t *pivots, int64_t rank) {
    int64_t count = 0;
    for (int64_t k = 0; k < rank; ++k) count += R(k, pivots[k]) * NEARLY_DEPENDENT < 1.0;
    return count;
}

// Return the number of the first directions that `factor` chose before one of a row that is nearly parallel to them.
inline int64_t before_parallel(const Matrix &R, const int64_t *pivots, int64_t rank) {
    for (int64_t k = 0; k < rank; ++k)
        if (R(k, pivots[k]) * PARALLEL > 1.0) return k;
    return rank;
}

// Coefficients mu of the rows that `factor` left, of the least-norm x with row_i . x = -g_i; 0 beyond the rank. With `sizes`, g_i
// is known to noise * sizes[i]: a row that is nearly parallel to those before it gets a direction of its own only where they
// leave more of its g than that. Otherwise x would be rounding errors, divided by the sine of the angle.
inline void least_norm(const double *g, const double *inverse_norms, const Matrix &R, const int64_t *pivots,
                       int64_t rank, double *mu, const double *sizes = nullptr, double noise = 0.0) {
    fill(mu, 0.0, R.rows);
    for (int64_t k = 0; k < rank; ++k) {
        const int64_t row = pivots[k];
        double value = -g[row] * inverse_norms[row];
        for (int64_t q = 0; q < k; ++q) value -= R(q, row) * mu[pivots[q]];
        if (sizes && R(k, row) * REORTHOGONALISE > 1.0) {
            double size = sizes[row] * inverse_norms[row];
            for (int64_t q = 0; q < k; ++q) size += std::abs(R(q, row)) * sizes[pivots[q]] * inverse_norms[pivots[q]];
            if (std::abs(value) <= noise * size) continue;
        }
        mu[row] = value * R(k, row);
    }
}

// Factors the Gram matrix of rows in the lower half of R, which is overwritten, if the rows are far from dependent.
//
// The factorisation is L D L^T, which costs 0.33 of `factor` and squares the condition number: whether it will do
// shows on the way, by the same bound below which one pass of Gram-Schmidt would not. The diagonal of R then holds 1/D.
// Two rows, the usual case, by Cramer's rule: one division to wait for, the result of which is kept above the diagonal.
template <class Value>
[[gnu::always_inline]] inline Truth<Value> factor_gram(const MatrixOf<Value> &R) {
    const int64_t rows = R.rows;
    constexpr double LEAST = REORTHOGONALISE * REORTHOGONALISE;
    Truth<Value> bad{};
    for (int64_t i = 0; i < rows; ++i) {
        const Value diagonal = R(i, i);
        bad = bad | !((diagonal > 1e-140) & (diagonal < 1e140));
    }
    if (!any(!bad)) return !bad;
    if (rows == 2) {
        const Value determinant = R(0, 0) * R(1, 1) - R(1, 0) * R(1, 0);
        R(0, 1) = 1.0 / positive(determinant);
        return (!bad) & (determinant > LEAST * (R(0, 0) * R(1, 1)));
    }
    for (int64_t i = 0; i < rows; ++i) {
        for (int64_t j = 1; j < i; ++j)
            for (int64_t k = 0; k < j; ++k) R(i, j) -= R(i, k) * R(j, k);
        Value square = R(i, i);
        const Value least = LEAST * square;
        for (int64_t j = 0; j < i; ++j) {
            const Value x = R(i, j) * R(j, j);
            square -= x * R(i, j);
            R(i, j) = x;
        }
        bad = bad | !(square > least);
        if (!any(!bad)) return !bad;
        R(i, i) = 1.0 / square;
    }
    return !bad;
}

// Coefficients mu of the rows in the least-norm x with rows . x = -g, from what `factor_gram` has left in R.
template <class Value>
[[gnu::always_inline]] inline void substitute_gram(const MatrixOf<Value> &R, const Value *g, Value *mu) {
    const int64_t rows = R.rows;
    if (rows == 2) {
        mu[0] = (R(1, 0) * g[1] - R(1, 1) * g[0]) * R(0, 1);
        mu[1] = (R(1, 0) * g[0] - R(0, 0) * g[1]) * R(0, 1);
        return;
    }
    for (int64_t i = 0; i < rows; ++i) {
        mu[i] = -g[i];
        for (int64_t j = 0; j < i; ++j) mu[i] -= R(i, j) * mu[j];
    }
    for (int64_t i = rows - 1; i >= 0; --i) {
        mu[i] *= R(i, i);
        for (int64_t j = i + 1; j < rows; ++j) mu[i] -= R(j, i) * mu[j];
    }
}

template <class Value>
[[gnu::always_inline]] inline Truth<Value> gram_solution(const MatrixOf<Value> &R, const Value *g, Value *mu) {
    const Truth<Value> solved = factor_gram(R);
    if (any(solved)) substitute_gram(R, g, mu);
    return solved;
}

template <class Value>
[[gnu::always_inline]] inline Truth<Value> solve_gram(const MatrixOf<Value> &B, const Value *g,
                                                      const MatrixOf<Value> &R, Value *mu) {
    for (int64_t i = 0; i < B.rows; ++i)
        for (int64_t j = 0; j <= i; ++j) R(i, j) = dot(B.row(i), B.row(j), B.columns);
    return gram_solution(R, g, mu);
}

}  // namespace eip
