// The projection: from y_hat along the gradients onto the targets.
#pragma once

#include "compensated.hpp"
#include "estimate.hpp"
#include "frame.hpp"
#include "linear_algebra.hpp"
#include "trust.hpp"

namespace eip {

constexpr int MAX_FURTHER = 3;
// A gradient from f is refuted by a projection that leaves this share of a residual, and more than this many dead bands.
constexpr double MOST_MISSED = 0.02, MISSED_BANDS = 4.0;

// A Newton step: its rank, -1 where gradients are not finite, the largest relative error, and its size in local errors.
struct Moved {
    int64_t rank;
    double largest_error, correction;
};

template <class Value, class W>
inline MatrixOf<Value> rows_of(Value *a, const W &w) {
    return {a, w.l, w.m, w.m};
}
template <class Value, class W>
inline MatrixOf<Value> corner(Value *a, int64_t size, const W &w) {
    return {a, size, size, w.l};
}

// Add to w.values, in compensated runs, what the carry is worth by gradients G.
template <class AnyRun, class Value>
inline void add_carried(const AnyRun &run, const Value *carry, const Value *G) {
    const auto &w = run.work;
    if (run.options.compensated)
        for (int64_t i = 0; i < w.l; ++i) w.values[i] += dot(G + i * w.m, carry, w.m);
}
// w.values = I(y) with the carry.
template <class AnyRun, class Value>
inline void evaluate_carried(const AnyRun &run, double t, const Value *y, const Value *carry, const Value *G) {
    run.system.inv(run.work, t, y, run.work.values);
    add_carried(run, carry, G);
}
// Computes w.values = I(y) like `evaluate_carried`, with the carry w.carry_hat and the current gradients w.G.
template <class AnyRun, class Value>
inline void evaluate_invariants(const AnyRun &run, double t, const Value *y) {
    evaluate_carried<AnyRun, Value>(run, t, y, run.work.carry_hat, run.work.G);
}

// Computes w.values at the end of a step, and the derivative with them where one pass gives both and the next step begins with
// it. That derivative is of no use after another try.
template <class AnyRun>
inline void evaluate_end(const AnyRun &run, const Step &step) {
    const auto &w = run.work;
    if constexpr (IS_SINGLE<AnyRun>) {
        auto &system = run.system;
        const bool wanted = system.together && !run.method.multistep && !(w.counters[HAVE_F] && run.options.reuse_f);
        system.has_f_at_end = wanted && system.in_one_pass(w, step.t_new, step.y_new, system.f_at_end.data(),
                                                           DERIVATIVE_TOO + VALUES_TOO);
        if (system.has_f_at_end) return add_carried(run, w.carry_hat, w.G);
    }
    evaluate_invariants(run, step.t_new, step.y_new);
}

// Rows along which a correction goes: w.Q, or the gradients as they are where the weights are 1.
template <class W>
[[gnu::always_inline]] inline auto *weighed_gradients(const auto &o, const W &w) {
    if (o.metric == EUCLIDEAN && o.frame.rows == 0) return w.G;
    weigh_rows(o.frame, w, w.Q);
    return w.Q;
}

// Call take(j, x) with x = entry j of sigma * (Q^T mu), for all j, vector by vector.
template <class Value, class W, class Take>
[[gnu::always_inline]] inline void combine_rows(const W &w, const Value *mu, const Value *__restrict Q,
                                                const Take &take) {
    in_blocks(Q, w.m, [&]<class Part, int COUNT>(int64_t first) {
        constexpr int64_t LENGTH = sizeof(Part) / sizeof(Value);
        Part sums[COUNT];
        for (int c = 0; c < COUNT; ++c) sums[c] = spread<Part>(mu[0]) * load_as<Part>(Q + first + c * LENGTH);
        for (int64_t k = 1; k < w.l; ++k) {
            const Part factor = spread<Part>(mu[k]);
            for (int c = 0; c < COUNT; ++c)
                sums[c] = sums[c] + factor * load_as<Part>(Q + k * w.m + first + c * LENGTH);
        }
        for (int c = 0; c < COUNT; ++c) {
            const int64_t j = first + c * LENGTH;
            take(j, load_as<Part>(w.sigma + j) * sums[c]);
        }
    });
}

// w.move = (1 - S (C S)^-1 C) sigma * (Q^T mu), the correction along rows Q, neutral to the frame; out = y_hat + move. In one
// pass, which writes in vectors what the next step reads in vectors.
template <class Value, class W>
[[gnu::always_inline]] inline void move_along(const auto &o, const W &w, const Value *__restrict Q,
                                              Value *__restrict out) {
    if (o.frame.rows == 0)
        return combine_rows(w, w.mu, Q, [&]<class Part>(int64_t j, const Part &x) {
            store_as(x, w.move + j);
            store_as(load_as<Part>(w.y_hat + j) + x, out + j);
        });
    combine_rows(w, w.mu, Q, [&](int64_t j, const auto &x) { store_as(x, out + j); });
    keep_frame(o.frame, w, out, w.move);
    for (int64_t j = 0; j < w.m; ++j) out[j] = w.y_hat[j] + w.move[j];
}

// Return f at the raw result, or nearly so: what the stages make of it where the step does not evaluate it. Null where
// it is not needed.
template <class AnyRun>
inline auto *flow_at_raw(const AnyRun &run, const Step &step) {
    const auto &m = run.method;
    const auto &w = run.work;
    if (!removes_shift(run.options)) return decltype(w.last())(nullptr);
    const bool in_python = run.hooks && run.hooks->raw;
    if (in_python && !w.counters[F_AT_RAW]) {
        run.system.rhs(w, step.t_new, as_floats(w.y_hat), as_floats(w.last()));
        ++w.counters[NFEV];
    }
    if (in_python || m.multistep || w.counters[HAVE_F]) return w.last();
    const auto *first = w.row(0), *last = w.row(m.stages - 1);
    const double beyond = 1.0 / m.c[m.stages - 1] - 1.0;
    for (int64_t j = 0; j < w.m; ++j) w.f_point[j] = last[j] + beyond * (last[j] - first[j]);
    if (m.nystrom) copy(w.y_hat + w.m / 2, w.f_point, w.m / 2);
    return w.f_point;
}

// Coefficients of `rank` orthonormal rows of Q in what makes w.shift tangent; w.mu is needed for further Newton steps.
template <class W>
inline const double *along_orthonormal_rows(int64_t rank, const W &w) {
    double *mu = w.inner_mu;
    fill(mu, 0.0, w.l);
    for (int64_t k = 0; k < rank; ++k) {
        const double *row = w.Q + w.pivots[k] * w.m;
        for (int64_t j = 0; j < w.m; ++j)
            if (w.sigma[j] > 0.0) mu[w.pivots[k]] -= row[j] * w.shift[j] / w.sigma[j];
    }
    return mu;
}

// w.shift *= factor, also where it is not finite and the factor 0; then w.move -= w.shift, where out = y_hat + move.
template <class Value, class W>
[[gnu::always_inline]] inline void subtract_shift(const W &w, const Value &factor, Value *__restrict out) {
    Value *__restrict shift = w.shift, *__restrict move = w.move;
    const Value *__restrict y_hat = w.y_hat;
    for (int64_t j = 0; j < w.m; ++j) {
        shift[j] = where(abs(factor) > 0.0, factor * shift[j], 0.0);
        move[j] -= shift[j];
        out[j] = y_hat[j] + move[j];
    }
}

// Removes from w.move its part along a shift in time, which is left in w.shift; out = y_hat + move.
//
// A multiple of the flow f changes no invariant: the weights alone decide how much of it a correction contains, and where
// the error estimate of a component vanishes for a moment, they decide badly. Each component is shifted in proportion to
// its squared share in the errors; the rows of Q, of which `rank` are orthonormal (-1: those of `solve_gram`), make that
// tangent. Of all corrections that differ by a multiple of it the result is the smallest one in units of the scales.
template <class Value, class W>
[[gnu::always_inline]] inline void remove_shift(const auto &o, const W &w, const Value *f, int64_t rank, Value *out) {
    const bool framed = o.frame.rows > 0;
    Value *raw = framed ? out : w.shift, *shift = w.shift;
    shift_by_errors(o, w, f, raw);
    const auto product = [&](const Value *a, const Value *b) {
        return sum_of(a, w.m, [=, &w]<class Part>(int64_t j) {
            return load_alone<Part>(a + j) * (load_alone<Part>(b + j) * load_alone<Part>(w.unit + j));
        });
    };
    const Value whole = product(raw, raw);
    if (framed) keep_frame(o.frame, w, raw, shift);
    const Value *mu = w.mu;
    if constexpr (std::is_same_v<Value, double>)
        if (rank >= 0) mu = along_orthonormal_rows(rank, w);
    if (mu == w.mu) {
        for (int64_t i = 0; i < w.l; ++i) w.values[i] = dot(w.gradient(i), shift, w.m);
        substitute_gram(corner(w.R, w.l, w), w.values, w.mu);
    }
    combine_rows(w, mu, w.Q,
                 [&]<class Part>(int64_t j, const Part &x) { store_as(load_as<Part>(shift + j) + x, raw + j); });
    if (framed) keep_frame(o.frame, w, raw, shift);
    const Value size = product(shift, shift), factor = product(w.move, shift) / positive(size);
    const auto known = (size > LEAST_SHIFT * whole) & (abs(factor) < ENDLESS);
    subtract_shift(w, where(known, factor, Value(0.0)), out);
}

// Coefficients w.mu of the rows of B in their least-norm solution, and its rank. One row, the usual case, by itself.
template <class W>
inline int64_t solve_part(const Matrix &B, const double *residuals, const W &w) {
    if (B.rows == 1) {
        const double square = dot<double>(B.data, B.data, B.columns);
        if (1e-200 < square && square < 1e200) {
            w.mu[0] = -residuals[0] / square;
            return 1;
        }
    }
    const Matrix R = corner(w.R, B.rows, w);
    const int64_t rank = factor(B, w.inverse_norms, R, w.pivots);
    if (rank >= 0) least_norm(residuals, w.inverse_norms, R, w.pivots, rank, w.mu);
    return rank;
}

// The Newton step of each group of values separately, along its own directions, SIZE of which are adjacent; all
// components together then restore the frame's C y. Residuals within rounding are corrected too, because the rounding of values
// that are carried does not accumulate. Returns the sum of the ranks, -1 where gradients are not finite. w.g are the residuals
// that `judge` compares with: the carried values of a group whose rows are dependent need not agree exactly, so that the residual
// of a row that was left out may grow to the sum of all.
template <int SIZE, class W>
[[gnu::noinline]] inline int64_t move_groups(const Options &o, const W &w, double *out) {
    const Groups &groups = o.balance_groups;
    double *total = o.frame.rows > 0 ? w.stage : w.move, *residuals = w.inner_g;
    int64_t rank = 0;
    fill(total, 0.0, w.m);
    for (int64_t k = 0; k < groups.count; ++k) {
        const int64_t *value = groups.value + groups.first_value[k];
        const int64_t rows = groups.first_value[k + 1] - groups.first_value[k];
        const int64_t *start = groups.first_float + groups.first_direction[k];
        const int64_t directions = groups.first_direction[k + 1] - groups.first_direction[k];
        const Matrix B{w.Q, rows, SIZE * directions, SIZE * directions};
        for (int64_t i = 0; i < rows; ++i) {
            const double *G = w.gradient(value[i]);
            residuals[i] = w.before[value[i]];
            for (int64_t d = 0; d < directions; ++d) {
                double slope[SIZE] = {};
                for (int64_t j = start[d]; j < start[d + 1]; ++j)
                    for (int c = 0; c < SIZE; ++c) slope[c] += groups.weight[j] * G[groups.place[j] + c];
                std::copy(slope, slope + SIZE, B.row(i) + SIZE * d);
            }
        }
        const int64_t found = solve_part(B, residuals, w);
        if (found < 0) return -1;
        rank += found;
        double sum = 0.0;
        for (int64_t i = 0; found < rows && i < rows; ++i) sum += std::abs(residuals[i]) * w.inverse_norms[i];
        for (int64_t i = 0; i < rows; ++i) {
            const bool grows = found < rows && w.inverse_norms[i] > 0.0;
            w.g[value[i]] = grows ? 2.0 * sum / w.inverse_norms[i] : residuals[i];
        }
        for (int64_t d = 0; d < directions; ++d) {
            double move[SIZE] = {};
            for (int64_t i = 0; i < rows; ++i)
                for (int c = 0; c < SIZE; ++c) move[c] += w.mu[i] * B(i, SIZE * d + c);
            for (int64_t j = start[d]; j < start[d + 1]; ++j)
                for (int c = 0; c < SIZE; ++c) total[groups.place[j] + c] += groups.weight[j] * move[c];
        }
    }
    if (o.frame.rows > 0) keep_frame(o.frame, w, total, w.move);
    for (int64_t j = 0; j < w.m; ++j) out[j] = w.y_hat[j] + w.move[j];
    return rank;
}

template <class W>
inline int64_t move_in_groups(const Options &o, const W &w, double *out) {
    return o.balance_groups.size == 3 ? move_groups<3>(o, w, out) : move_groups<1>(o, w, out);
}

// The residuals that those after a projection are compared with.
template <class W>
inline auto *limits(const auto &o, const W &w) {
    return o.balance_groups.count > 0 ? w.g : w.before;
}

// The first Newton step by `factor`. Gradients that are nearly parallel are given their whole residuals, also those inside the dead
// bands: 0 in the place of one would disagree with the other.
template <class W>
[[gnu::noinline]] inline int64_t factored_move(const Options &o, const W &w, const double *f, double *out) {
    const Matrix R = corner(w.R, w.l, w);
    const int64_t rank = factor(rows_of(w.Q, w), w.inverse_norms, R, w.pivots);
    w.counters[TRIED_INDEPENDENT] = clearly_independent(R, w.pivots, rank);
    least_norm(w.before, w.inverse_norms, R, w.pivots, rank, w.mu, w.band, EPS * o.per_band);
    if (rank < 0) return rank;
    move_along(o, w, w.Q, out);
    if (f) remove_shift(o, w, f, rank, out);
    return rank;
}

// The first Newton step along the gradients at y_hat; given f, without a shift in time. If `more` follow, Q is orthonormal.
template <class W>
[[gnu::always_inline]] inline int64_t first_move(const auto &o, const W &w, const double *f, double *out, bool more) {
    if (o.balance_groups.count > 0) [[unlikely]]
        return move_in_groups(o, w, out);
    double *rows = more ? nullptr : weighed_gradients(o, w);
    if (rows && solve_gram(rows_of(rows, w), w.g, corner(w.R, w.l, w), w.mu)) {
        move_along(o, w, rows, out);
        if (f) remove_shift(o, w, f, -1, out);
        w.counters[TRIED_INDEPENDENT] = w.l;
        return w.l;
    }
    if (rows != w.Q) weigh_rows(o.frame, w, w.Q);
    return factored_move(o, w, f, out);
}

// Computes the gradients w.G at the state y, and f there if they take it.
template <class AnyRun>
inline void evaluate_gradients(const AnyRun &run, double t, const double *y, double *f) {
    if (run.options.uses_f) evaluate_f(run, t, y, f);
    gradients(run, t, y, f, run.work.G);
    ++run.work.counters[NJEV];
}

// Add to w.mu the Newton step of (B . Q) step = -g, on the rows that the first factorisation chose.
inline void newton_matrix_solve(int64_t rank, const Work &w) {
    const Matrix matrix = corner(w.inner_matrix, rank, w), R = corner(w.inner_R, w.l, w);
    for (int64_t k = 0; k < rank; ++k) {
        for (int64_t q = 0; q < rank; ++q) matrix(k, q) = dot(w.B + w.pivots[k] * w.m, w.Q + w.pivots[q] * w.m, w.m);
        w.inner_g[k] = w.g[w.pivots[k]];
    }
    const int64_t inner_rank = factor(matrix, w.inner_inverse_norms, R, w.inner_pivots);
    if (inner_rank < 0) fill(w.mu, NOT_A_NUMBER, w.l);
    least_norm(w.inner_g, w.inner_inverse_norms, R, w.inner_pivots, inner_rank, w.inner_mu);
    for (int64_t k = 0; k < rank; ++k)
        for (int64_t q = 0; q < rank; ++q) w.mu[w.pivots[q]] += w.inner_mu[k] * matrix(k, q);
    ++w.counters[NLU];
}

// The first Newton step along the gradients at y or at the midpoint; w.G holds those at y_hat. Returns the rank.
[[gnu::noinline]] inline int64_t other_directions(const Run &run, const Step &step) {
    const Options &o = run.options;
    const auto &w = run.work;
    weigh_rows(o.frame, w, w.B);
    if (o.direction == OLD) {
        gradients(run, step.t, step.y, w.row(0), w.G);
        ++w.counters[NJEV];
    } else {
        midpoint(step.y, w.y_hat, w.stage, w.m);
        evaluate_gradients(run, 0.5 * (step.t + step.t_new), w.stage, w.f_point);
    }
    weigh_rows(o.frame, w, w.Q);
    const int64_t rank = factor(rows_of(w.Q, w), w.inverse_norms, corner(w.R, w.l, w), w.pivots);
    if (rank >= 0) {
        fill(w.mu, 0.0, w.l);
        newton_matrix_solve(rank, w);
        move_along(o, w, w.Q, step.y_new);
    }
    return rank;
}

// The first Newton step.
template <class AnyRun>
inline Moved move(const AnyRun &run, const Step &step) {
    const auto &o = run.options;
    const auto &w = run.work;
    ++w.counters[NLU];
    double largest_error = 0.0;
    if (o.metric == BY_ERROR) {
        largest_error = relative_errors(step.y, run);
        weights_from_errors(step.y, o, w);
    }
    int64_t rank;
    if (o.direction == NEW) {
        rank = first_move(o, w, flow_at_raw(run, step), step.y_new, o.iterations > 1);
    } else {
        rank = other_directions(of_any_length(run), step);
    }
    return {rank, largest_error, correction_in_local_errors(largest_error, o, w)};
}

// One more Newton step along the same directions; false when every residual is inside its dead band.
[[gnu::noinline]] inline bool newton_iteration(const Run &run, const Step &step, int64_t rank) {
    const Options &o = run.options;
    const auto &w = run.work;
    run.system.inv(w, step.t_new, step.y_new, w.values);
    evaluate_gradients(run, step.t_new, step.y_new, w.f_point);
    if (!residuals<double>(nullptr, step.y_new, o, w, w.residual)) return false;
    weigh_rows(o.frame, w, w.B);
    newton_matrix_solve(rank, w);
    move_along(o, w, w.Q, step.y_new);
    if (removes_shift(o) && o.direction == NEW) subtract_shift(w, 1.0, step.y_new);
    return true;
}

// The state that a step comes from; null for a projection by itself.
template <class W>
inline const double *origin(const Step &step, const W &w) {
    return step.h != 0.0 && step.y != w.y_hat ? step.y : nullptr;
}

// The largest distance of w.values from a given target, in units of what may be left of it.
template <class W>
inline auto missed_targets(const Options &o, const W &w) {
    typename W::Value worst = 0.0;
    for (int64_t i = 0; i < w.l; ++i)
        worst = max(worst, abs(w.values[i] - w.target[i]) / (o.most_left[i] * o.per_band * w.band[i] + TINY));
    return worst;
}

// Further Newton steps towards given targets, while they come nearer; returns the rank. Gradients that are nearly parallel
// may not reach them at all: the state is then the nearest so far. w.values are its invariants, before and after.
[[gnu::cold, gnu::noinline]] inline int64_t come_nearer(const Run &run, const Step &step, int64_t rank) {
    const Options &o = run.options;
    const Work &w = run.work;
    const auto evaluate = [&] { run.system.inv(w, step.t_new, step.y_new, w.values); };
    double missed = missed_targets(o, w);
    if (o.direction == NEW && o.iterations == 1) rank = first_move(o, w, flow_at_raw(run, step), step.y_new, true);
    for (int k = 0; rank >= 0 && k < MAX_FURTHER && missed > 1.0; ++k) {
        copy(step.y_new, w.stage, w.m);
        if (!newton_iteration(run, step, rank)) break;
        const double before = missed;
        evaluate();
        missed = missed_targets(o, w);
        if (missed < before) continue;
        copy(w.stage, step.y_new, w.m);
        for (int64_t j = 0; j < w.m; ++j) w.move[j] = step.y_new[j] - w.y_hat[j];
        break;
    }
    evaluate();
    return rank;
}

// (y_new, carry) = (y_hat, carry) + move, in compensated runs.
template <class AnyRun>
inline void add_move(const AnyRun &run, const Step &step) {
    const auto &w = run.work;
    if (!run.options.compensated) return;
    copy(w.y_hat, step.y_new, w.m);
    compensated_add(step.y_new, w.carry_hat, w.move, w.m);
}

// Computations after the first Newton step: further ones, and whether the projection holds.
template <class AnyRun>
inline Code correct(const AnyRun &run, const Step &step, int64_t rank) {
    const auto &o = run.options;
    const auto &w = run.work;
    if (rank < 0) {
        copy(w.before, w.residual, w.l);
        return FAILED_PROJECTION;
    }
    for (int64_t k = 1; k < o.iterations; ++k)
        if (!newton_iteration(of_any_length(run), step, rank)) break;
    if (o.has_limits) {
        run.system.inv(w, step.t_new, step.y_new, w.values);
        if (missed_targets(o, w) > 1.0) [[unlikely]]
            rank = come_nearer(of_any_length(run), step, rank);
    }
    add_move(run, step);
    if (o.compensated || !o.has_limits) evaluate_end(run, step);
    return judge(limits(o, w), origin(step, w), step.y_new, o, w);
}

// Before another try: the raw state's carry, its gradients and its residuals, where the last try has replaced them.
[[gnu::cold, gnu::noinline]] inline void start_again(const Run &run, const Step &step) {
    const Options &o = run.options;
    const Work &w = run.work;
    if (o.compensated) {
        if (run.method.nystrom)
            compensated_nystrom(step.y, step.h, run.method, w);
        else
            compensated_step(step.y, step.h, run.method, w);
    }
    if (o.iterations == 1 && o.direction == NEW) return;
    gradients(run, step.t_new, w.y_hat, w.last(), w.G);
    ++w.counters[NJEV];
    evaluate_invariants(run, step.t_new, w.y_hat);
    residuals<double>(nullptr, w.y_hat, o, w, w.before);
}

// Further tries: with the shift in time, whose square may be large, then with weights ever nearer to equal relative errors,
// for which an estimate that vanishes in some component counts less. Constants keep their weights.
[[gnu::cold, gnu::noinline]] inline Code correct_evenly(const Run &run, const Step &step, Moved &moved) {
    const Options &o = run.options;
    const Work &w = run.work;
    Code status = FAILED_PROJECTION;
    for (int k = 0; k <= MAX_FURTHER && status != OK; ++k) {
        each_float(o.blocks, w.m, [&](int64_t i, int64_t b) {
            if (k > 0 && !is_constant_block(step.y, b, o.blocks, w))
                w.sigma[i] = std::sqrt(w.sigma[i]) * std::sqrt(w.scale[b]);
        });
        start_again(run, step);
        fill(w.shift, 0.0, w.m);
        moved.rank =
            o.direction == NEW ? first_move(o, w, nullptr, step.y_new, o.iterations > 1) : other_directions(run, step);
        moved.correction = correction_in_local_errors(moved.largest_error, o, w);
        status = correct(run, step, moved.rank);
    }
    return status;
}

// A last try with the first `rank` directions only.
//
// Where gradients are nearly parallel, as on a nearly circular orbit, states near y_hat may not reach a target at all:
// the distance is of second order, and no shorter step corrects it. What the directions left out would have corrected
// stays, so that a residual may grow to the sum of all.
[[gnu::cold, gnu::noinline]] inline Code correct_with_fewer(const Run &run, const Step &step, int64_t &rank) {
    const Options &o = run.options;
    const auto &w = run.work;
    const Matrix R = corner(w.R, w.l, w);
    start_again(run, step);
    run.system.has_f_at_end = false;
    weigh_rows(o.frame, w, w.Q);
    const int64_t found = factor(rows_of(w.Q, w), w.inverse_norms, R, w.pivots);
    rank = std::max<int64_t>(0, std::min(rank, found));
    least_norm(w.g, w.inverse_norms, R, w.pivots, rank, w.mu);
    move_along(o, w, w.Q, step.y_new);
    add_move(run, step);
    evaluate_invariants(run, step.t_new, step.y_new);
    shared_residuals(w, w.g);
    return judge(w.g, origin(step, w), step.y_new, o, w);
}

// Accept y_hat, which lies in all dead bands, as it is. The errors are remembered all the same: in free flight, where
// the estimates vanish, all relative errors are rounding and equal.
template <class AnyRun>
inline Code stay(const AnyRun &run, const Step &step) {
    const auto &o = run.options;
    const auto &w = run.work;
    ++w.counters[SKIPPED];
    copy(w.y_hat, step.y_new, w.m);
    const Code status = judge(w.before, origin(step, w), step.y_new, o, w);
    if (status != OK) return status;
    take_note(step, origin(step, w), o, w);
    if (o.metric == BY_ERROR) {
        relative_errors(step.y, run);
        remember_errors(o, w);
    }
    return OK;
}

template <class AnyRun>
inline Code project_evaluated(const AnyRun &run, const Step &step);

// Return whether the last projection left more of a residual than it would with a gradient that is right: one from f may
// hold no longer, as with drag or a wall.
template <class AnyRun>
inline bool refutes(const AnyRun &run) {
    const auto &w = run.work;
    const FromF known = from_f(run);
    for (int64_t i = 0; known.pairs > 0 && i < w.l; ++i)
        if (known.has(i) &&
            !(std::abs(w.residual[i]) <= MOST_MISSED * std::abs(w.before[i]) + MISSED_BANDS * w.band[i]))
            return true;
    return false;
}

// Repeat the projection with computed gradients, which the run uses from now on.
[[gnu::cold, gnu::noinline]] inline Code project_without_f(const Run &run, const Step &step) {
    const Work &w = run.work;
    w.counters[FROM_F] = 0;
    fill(w.flow, 0.0, w.l);
    start_again(run, step);
    gradients(run, step.t_new, w.y_hat, w.last(), w.G);
    ++w.counters[NJEV];
    evaluate_invariants(run, step.t_new, w.y_hat);
    return project_evaluated(run, step);
}

// Project w.y_hat into y_new by o.iterations Newton steps; returns OK, FAILED_PROJECTION, POSTPONED or NEAR_SINGULAR.
//
// w.err holds the local error of y_hat where the metric wants it, w.last() f there where a gradient does. POSTPONED:
// with every = AUTO, while the invariants know no more than round-off (y_new is then y_hat).
template <class AnyRun>
inline Code project_step(const AnyRun &run, const Step &step) {
    const auto &o = run.options;
    const auto &w = run.work;
    Known known = std::exchange(run.system.at_raw, Known::NOTHING);
    if (known == Known::NOTHING && run.system.in_one_pass(w, step.t_new, w.y_hat, nullptr, VALUES_TOO + GRADIENTS_TOO))
        known = Known::ALL;
    if (known != Known::ALL) gradients(run, step.t_new, w.y_hat, w.last(), w.G);
    ++w.counters[NJEV];
    note_rates(run, step);
    if (o.every != 1 && (o.metric == BY_ERROR || o.every == AUTO || o.adaptive)) {
        quadrature(w.err, w.err_sum, w.err, w.m);
        if (o.every == AUTO && !step.last && !tells_more(w)) {
            copy(w.y_hat, step.y_new, w.m);
            return POSTPONED;
        }
    }
    run.system.inv_at_raw(w, step.t_new, w.y_hat, w.values, known);
    add_carried(run, w.carry_hat, w.G);
    return project_evaluated(run, step);
}

// Second part of `project_step`, when the gradients at w.y_hat and the values of the invariants are known.
// NEAR_SINGULAR: the step avoids singular positions, and at its end more gradients are nearly dependent than at its
// start. Derivatives after such a step would be those of a state off the manifold, divided by the distance from the
// singular position, and steps would become very short.
template <class AnyRun>
inline Code project_evaluated(const AnyRun &run, const Step &step) {
    const auto &o = run.options;
    const auto &w = run.work;
    if (!residuals<double>(nullptr, w.y_hat, o, w, w.before) && o.balance_groups.count == 0) return stay(run, step);
    Moved moved = move(run, step);
    if (step.avoids_singular && w.counters[TRIED_INDEPENDENT] < w.counters[INDEPENDENT]) [[unlikely]]
        return NEAR_SINGULAR;
    Code status = correct(run, step, moved.rank);
    if constexpr (IS_SINGLE<AnyRun>)
        if (refutes(run)) [[unlikely]]
            return project_without_f(of_any_length(run), step);
    const bool plain = o.direction == NEW && o.iterations == 1 && !o.compensated;
    const bool again = o.balance_groups.count == 0 && (plain || (!run.method.multistep && origin(step, w)));
    if (status != OK && again && moved.largest_error > 0.0 && all_finite(w.residual, w.l)) [[unlikely]]
        status = correct_evenly(of_any_length(run), step, moved);
    if (status != OK && again && moved.rank > 1) {
        --moved.rank;
        status = correct_with_fewer(of_any_length(run), step, moved.rank);
    }
    w.counters[LAST_RANK] = std::max<int64_t>(moved.rank, 0);
    if (moved.rank >= 0) {
        ++w.counters[PROJECTIONS];
        w.counters[RANK_REDUCED] += moved.rank < w.l;
    }
    if (status == OK) {
        take_note(step, origin(step, w), o, w);
        remember_errors(o, w);
        w.counters[INDEPENDENT] = w.counters[TRIED_INDEPENDENT];
        w.max_correction[0] = std::max(w.max_correction[0], moved.correction);
    }
    return status;
}

// Projects by a hook if there is one: by joint invariants if one pass over them is enough, or by other code in Python.
// Otherwise it calls `project_step`.
template <class AnyRun>
inline Code project_any(const AnyRun &run, const Step &step) {
    if (run.hooks && run.hooks->joint && run.hooks->project_jointly(step)) return OK;
    return project_step(run, step);
}

}  // namespace eip
