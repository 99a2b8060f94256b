// The projection of the columns of derivatives behind a state. The derivative of I(y(t)) = const by the start is G M = const,
// with G the gradients at y(t): linear invariants of the variational equations.
#pragma once

#include "correction.hpp"

namespace eip {

// The columns of w, of a state that is `y`, moved onto G M = kept, each by the least correction in the weights of the state.
template <class W>
inline void project_each(const Options &o, const W &w, double *y, int64_t rank, const Matrix &rows, const Matrix &R) {
    const Columns &columns = o.columns;
    const int64_t n = columns.size;
    double *move = w.stage;
    fill(move, 0.0, w.m);
    for (int64_t c = 0; c < columns.count; ++c) {
        double *column = y + (c + 1) * n;
        for (int64_t i = 0; i < w.l; ++i) w.g[i] = dot(w.gradient(i), column, n) - columns.kept[i * columns.count + c];
        least_norm(w.g, w.inverse_norms, R, w.pivots, rank, w.mu);
        fill(move, 0.0, n);
        for (int64_t k = 0; k < rank; ++k) {
            const double *row = rows.row(w.pivots[k]), factor = w.mu[w.pivots[k]];
            for (int64_t j = 0; j < n; ++j) move[j] += factor * row[j];
        }
        for (int64_t j = 0; j < n; ++j) move[j] *= w.sigma[j];
        if (o.frame.rows > 0) {
            keep_frame(o.frame, w, move, w.move);
            for (int64_t j = 0; j < n; ++j) column[j] += w.move[j];
        } else {
            for (int64_t j = 0; j < n; ++j) column[j] += move[j];
        }
    }
}

// One Newton step on M^T J M = J, for M of as many columns as y = (q, p) has numbers: with E = M^T J M - J, M + M J E / 2.
inline void restore_symplectic(const Columns &columns, double *y, double *E, double *row) {
    const int64_t n = columns.size, half = n / 2;
    double *M = y + n;
    const auto product = [&](int64_t a, int64_t b) {
        const double *u = M + a * n, *v = M + b * n;
        double sum = 0.0;
        for (int64_t i = 0; i < half; ++i) sum += u[i] * v[half + i] - u[half + i] * v[i];
        return sum;
    };
    for (int64_t a = 0; a < n; ++a) {
        E[a * n + a] = 0.0;
        for (int64_t b = 0; b < a; ++b) {
            const double j = a == b + half ? -1.0 : 0.0;
            E[a * n + b] = product(a, b) - j;
            E[b * n + a] = -E[a * n + b];
        }
    }
    // Row i of M J: -(second half) in the first half of the columns, the first half in the second.
    for (int64_t i = 0; i < n; ++i) {
        for (int64_t c = 0; c < half; ++c) {
            row[c] = -M[(half + c) * n + i];
            row[half + c] = M[c * n + i];
        }
        for (int64_t c = 0; c < n; ++c) row[n + c] = 0.0;
        for (int64_t a = 0; a < n; ++a)
            for (int64_t c = 0; c < n; ++c) row[n + c] += row[a] * E[a * n + c];
        for (int64_t c = 0; c < n; ++c) M[c * n + i] += 0.5 * row[n + c];
    }
}

// The columns of a state that has been projected, y_new.
template <class AnyRun>
[[gnu::noinline]] inline void project_columns(const AnyRun &run, const Step &step) {
    const Options &o = run.options;
    const auto &w = run.work;
    const Columns &columns = o.columns;
    const int64_t n = columns.size;
    if (o.uses_f) {
        run.system.rhs(w, step.t_new, step.y_new, w.f_point);
        ++w.counters[NFEV];
    }
    run.system.grad(w, step.t_new, step.y_new, w.f_point, w.G);
    ++w.counters[NJEV];
    weigh_rows(o.frame, w, w.Q);
    const Matrix rows{w.Q, w.l, n, w.m}, R = corner(w.R, w.l, w);
    const int64_t rank = factor(rows, w.inverse_norms, R, w.pivots);
    ++w.counters[NLU];
    if (rank > 0) project_each(o, w, step.y_new, rank, rows, R);
    // A state with all its columns has room for n numbers n times and more in two buffers that are free here.
    if (columns.symplectic) restore_symplectic(columns, step.y_new, w.err_low, w.move);
}

}  // namespace eip
