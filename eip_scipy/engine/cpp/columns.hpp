// The projection of the columns of derivatives behind a state. The derivative of I(y(t)) = const by the start is G M = const,
// with G the gradients at y(t): linear invariants of the variational equations.
#pragma once

#include <cstring>

#include "correction.hpp"

namespace eip {

// Moves the numbers of the state in each row to the front of the row; the columns of derivatives in it are not needed
// and may be overwritten.
inline void pack_rows(const Columns &columns, double *rows, int64_t count, int64_t stride) {
    const int64_t cut = columns.cut();
    for (int64_t i = 0; i < count; ++i) {
        double *row = rows + i * stride;
        std::memmove(row + cut, row + columns.second(-1), (columns.size - cut) * sizeof(double));
    }
}

// Copies column c out of a state y (`take_column`) and back into it (`put_column`).
inline void take_column(const Columns &columns, int64_t c, const double *y, double *column) {
    const int64_t cut = columns.cut();
    copy(y + columns.first(c), column, cut);
    copy(y + columns.second(c), column + cut, columns.size - cut);
}
inline void put_column(const Columns &columns, int64_t c, const double *column, double *y) {
    const int64_t cut = columns.cut();
    copy(column, y + columns.first(c), cut);
    copy(column + cut, y + columns.second(c), columns.size - cut);
}

// Sets kept = G M at the start y of a member, by sums in the order of tangent_vectors.py.
inline void keep_products(const Columns &columns, const Work &w, const double *y) {
    for (int64_t i = 0; i < w.l; ++i)
        for (int64_t c = 0; c < columns.count; ++c) {
            const double *G = w.gradient(i);
            double sum = 0.0;
            for (int64_t j = 0; j < columns.cut(); ++j) sum += G[j] * y[columns.first(c) + j];
            for (int64_t j = 0; j < columns.size - columns.cut(); ++j)
                sum += G[columns.second(-1) + j] * y[columns.second(c) + j];
            columns.kept[i * columns.count + c] = sum;
        }
}

// Change a column, or a row as long, as numbers in their places in a state: itself where the places are the same.
template <class W, class Change>
inline void change_in_place(const Columns &columns, const W &w, double *column, const Change &change) {
    if (columns.half == 0) return change(column);
    put_column(columns, -1, column, w.stage);  // what the other places hold is not read
    change(w.stage);
    take_column(columns, -1, w.stage, column);
}

// The gradients of the state, packed, and from them the rows of Q, in the weights `sigma`. Only what belongs to the state is
// touched: the columns behind it are many times longer.
template <class W>
inline void weigh_packed_rows(const Options &o, const W &w, const double *sigma) {
    const Columns &columns = o.columns;
    if (columns.half > 0) pack_rows(columns, w.G, w.l, w.m);
    for (int64_t i = 0; i < w.l; ++i) {
        double *row = w.Q + i * w.m;
        copy(w.gradient(i), row, columns.size);
        if (o.frame.rows > 0)
            change_in_place(columns, w, row, [&](double *whole) { remove_sparse(o.frame, 1, w.products, whole); });
        for (int64_t j = 0; j < columns.size; ++j) row[j] *= sigma[j];
    }
}

// Computes for each invariant the correction of a column if G M = kept is missed by one, into w.B: the least one in the weights
// sigma of the state. The rows of G and of its factorisation are packed.
template <class W>
inline void find_corrections(const Options &o, const W &w, int64_t rank, const Matrix &rows, const double *sigma) {
    const int64_t n = o.columns.size;
    for (int64_t i = 0; i < w.l; ++i) {
        double *correction = w.B + i * w.m;
        fill(w.g, 0.0, w.l);
        w.g[i] = 1.0;
        least_norm(w.g, w.inverse_norms, corner(w.R, w.l, w), w.pivots, rank, w.mu);
        fill(correction, 0.0, n);
        for (int64_t k = 0; k < rank; ++k) {
            const double *row = rows.row(w.pivots[k]), factor = w.mu[w.pivots[k]];
            for (int64_t j = 0; j < n; ++j) correction[j] += factor * row[j];
        }
        for (int64_t j = 0; j < n; ++j) correction[j] *= sigma[j];
        if (o.frame.rows == 0) continue;
        change_in_place(o.columns, w, correction, [&](double *whole) { remove_sparse(o.frame, 0, w.products, whole); });
    }
}

// Removes the shift in time from these corrections like `remove_shift` from that of the state; they make the shift tangent.
template <class W>
inline void remove_shifts(const Options &o, const W &w, const double *f) {
    const int64_t n = o.columns.size;
    double *shift = w.shift, *measure = w.f_point;
    shift_by_errors(o, w, f, w.move);
    if (o.frame.rows > 0) remove_sparse(o.frame, 0, w.products, w.move);
    take_column(o.columns, -1, w.move, shift);
    for (int64_t i = 0; i < w.l; ++i) w.g[i] = dot(w.gradient(i), shift, n);
    for (int64_t i = 0; i < w.l; ++i)
        for (int64_t j = 0; j < n; ++j) shift[j] += w.g[i] * w.B[i * w.m + j];
    take_column(o.columns, -1, w.unit, measure);
    for (int64_t j = 0; j < n; ++j) measure[j] *= shift[j];
    const double size = dot(shift, measure, n);
    if (!(size > 0.0)) return;
    for (int64_t i = 0; i < w.l; ++i) {
        double *correction = w.B + i * w.m;
        const double factor = dot(correction, measure, n) / size;
        for (int64_t j = 0; j < n; ++j) correction[j] -= factor * shift[j];
    }
}

// The columns M (count, size) moved onto G M = kept by these corrections.
template <class W>
inline void project_each(const Columns &columns, const W &w, double *M) {
    const int64_t n = columns.size;
    for (int64_t c = 0; c < columns.count; ++c) {
        double *column = M + c * n;
        for (int64_t i = 0; i < w.l; ++i) w.g[i] = dot(w.gradient(i), column, n) - columns.kept[i * columns.count + c];
        for (int64_t i = 0; i < w.l; ++i) {
            const double *correction = w.B + i * w.m, missed = w.g[i];
            for (int64_t j = 0; j < n; ++j) column[j] += missed * correction[j];
        }
    }
}

// One Newton step on M^T J M = J, for M of as many columns as y = (q, p) has numbers: with E = M^T J M - J, M + M J E / 2.
inline void restore_symplectic(int64_t n, double *M, double *E, double *row) {
    const int64_t half = n / 2;
    const auto product = [&](int64_t a, int64_t b) {
        const double *u = M + a * n, *v = M + b * n;
        double sum = 0.0;
        for (int64_t i = 0; i < half; ++i) sum += u[i] * v[half + i] - u[half + i] * v[i];
        return sum;
    };
    for (int64_t a = 0; a < n; ++a) {
        E[a * n + a] = 0.0;
        for (int64_t b = 0; b < a; ++b) {
            E[a * n + b] = product(a, b) - (a == b + half ? -1.0 : 0.0);
            E[b * n + a] = -E[a * n + b];
        }
    }
    // Row i of M J: minus the second half of the columns, then the first half.
    for (int64_t i = 0; i < n; ++i) {
        for (int64_t c = 0; c < half; ++c) {
            row[c] = -M[(half + c) * n + i];
            row[half + c] = M[c * n + i];
        }
        fill(row + n, 0.0, n);
        for (int64_t a = 0; a < n; ++a)
            for (int64_t c = 0; c < n; ++c) row[n + c] += row[a] * E[a * n + c];
        for (int64_t c = 0; c < n; ++c) M[c * n + i] += 0.5 * row[n + c];
    }
}

// The columns of a state that has been projected, y_new. The errors of the step are not needed any more: their buffers, of
// size (1 + count) numbers each, hold the columns one after the other, the matrix E, or the state's weights.
template <class AnyRun>
[[gnu::noinline]] inline void project_columns(const AnyRun &run, const Step &step) {
    const Options &o = run.options;
    const auto &w = run.work;
    const Columns &columns = o.columns;
    const int64_t n = columns.size;
    evaluate_gradients(run, step.t_new, step.y_new, w.f_point);
    const bool in_halves = columns.half > 0;
    double *M = in_halves ? w.err : step.y_new + n, *scratch = w.err_low;
    for (int64_t c = 0; in_halves && c < columns.count; ++c) take_column(columns, c, step.y_new, M + c * n);
    take_column(columns, -1, w.sigma, scratch);
    weigh_packed_rows(o, w, scratch);
    const Matrix rows{w.Q, w.l, n, w.m};
    const Matrix R = corner(w.R, w.l, w);
    const int64_t rank = before_parallel(R, w.pivots, factor(rows, w.inverse_norms, R, w.pivots));
    ++w.counters[NLU];
    if (rank > 0) {
        find_corrections(o, w, rank, rows, scratch);
        if (const double *f = flow_at_raw(run, step)) remove_shifts(o, w, f);
        project_each(columns, w, M);
    }
    if (columns.symplectic) restore_symplectic(n, M, scratch, w.move);
    for (int64_t c = 0; in_halves && c < columns.count; ++c) put_column(columns, c, M + c * n, step.y_new);
}

// The functions below look at the state alone, without the columns behind it, and cost what they cost without columns.

// Return whether the state is at the front and its functions are called by pointer. Batches of members have none.
template <class AnyRun>
inline bool has_state_alone(const AnyRun &) {
    return false;
}
template <class W>
inline bool has_state_alone(const RunOf<W, System> &run) {
    return run.system.columns && run.options.columns.half == 0;
}

// Call with a run of the state alone, on the front of the buffers; by code of its own for short states, as in engine.cpp. HAVE_F
// is OF_STATE where f is that of the state alone too.
template <class Call>
inline auto of_state_alone(const Run &run, const Call &call) {
    Work front(run.work);
    front.n = front.m = run.options.columns.size;
    front.behind = run.work.m - front.m;
    const auto by = [&]<class W>(const W &work) {
        return call(RunOf<W, System>{run.method, run.options, work, run.system, run.hooks});
    };
    if (front.m == 4 && front.l == 2) return by(SizedWith<4, 2>(front));
    return front.m == 6 ? by(Sized<6>(front)) : by(front);
}

// The columns behind a state that has been projected, step.y_new.
inline void project_columns_behind(const Run &run, const Step &step) {
    if (!has_state_alone(run)) return project_columns(run, step);
    of_state_alone(run, [&](const auto &alone) { project_columns(alone, step); });
}

// The projection of the state, and that of its columns.
[[gnu::noinline]] inline Code project_with_columns(const Run &run, const Step &step) {
    const int64_t size = run.options.columns.size;
    Code status;
    if (has_state_alone(run)) {
        status = of_state_alone(run, [&](const auto &alone) { return project_any(alone, step); });
        copy(run.work.y_hat + size, step.y_new + size, run.work.m - size);
    } else {
        status = project_any(run, step);
    }
    if (status == OK) project_columns_behind(run, step);
    return status;
}

template <class AnyRun>
inline Code project_whole(const AnyRun &run, const Step &step) {
    return project_any(run, step);
}
template <class W>
inline Code project_whole(const RunOf<W, System> &run, const Step &step) {
    if (run.options.columns.count > 0) [[unlikely]]
        return project_with_columns(of_any_length(run), step);
    return project_any(run, step);
}

}  // namespace eip
