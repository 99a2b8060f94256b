// The raw step: stages and their sum, y_hat.
#pragma once

#include "compensated.hpp"
#include "system.hpp"

namespace eip {

// out's first half = q + c h v + h^2 sum_j weights[j] a_j, for y = (q, v); a_j is the second half of K[j].
inline void nystrom_position(const double *y, double h, double c, const Rows &rows, double *out, int64_t half) {
    weighted_sum(1.0, rows, out, half);
    for (int64_t i = 0; i < half; ++i) out[i] = y[i] + h * (c * y[half + i] + h * out[i]);
}

// The sum of the stages, y_hat.
template <class AnyRun>
inline void sum_stages(const AnyRun &run, const Step &step) {
    const auto &m = run.method;
    const auto &w = run.work;
    if (run.options.compensated)
        compensated_step(step.y, step.h, m, w);
    else
        combine(step.y, step.h, {m.b, w.K, m.stages, w.m}, w.y_hat, w.m);
}

template <class AnyRun>
inline void rk_stages(const AnyRun &run, const Step &step) {
    const auto &m = run.method;
    const auto &w = run.work;
    for (int64_t i = 1; i < m.stages; ++i) {
        combine(step.y, step.h, {m.A + i * m.columns, w.K, i, w.m}, w.stage, w.m);
        run.system.rhs_of_scratch(w, step.t + m.c[i] * step.h, w.stage, w.row(i));
    }
    sum_stages(run, step);
}

// As above, with the rates of the balances at the stages where they are needed. Those at the first stage are those at the end
// of the last step; NaN where there was none. Return whether the run has any balances; batches of members have none.
template <class AnyRun>
inline bool made_with_rates(const AnyRun &, const Step &) {
    return false;
}
[[gnu::noinline]] inline void rated_stages(const Run &run, const Step &step) {
    const auto &m = run.method;
    const Work &w = run.work;
    const int64_t *rated = run.options.balances.rated;
    if (std::isnan(w.rate(0)[0])) run.system.rates(w, step.t, step.y, w.row(0), w.rate(0));
    for (int64_t i = 1; i < m.stages; ++i) {
        const double t = step.t + m.c[i] * step.h;
        combine(step.y, step.h, {m.A + i * m.columns, w.K, i, w.m}, w.stage, w.m);
        if (rated[i])
            run.system.rhs_and_rates(w, t, w.stage, w.row(i), w.rate(i));
        else
            run.system.rhs(w, t, w.stage, w.row(i));
    }
    compensated_levels(step.h, m, run.options.balances, w);
    sum_stages(run, step);
}
template <class W>
inline bool made_with_rates(const RunOf<W, System> &run, const Step &step) {
    if (run.work.balances == 0) [[likely]]
        return false;
    rated_stages(of_any_length(run), step);
    return true;
}

// About once in this number of steps a Nystrom method checks whether accelerations depend on velocities at the present state.
constexpr int64_t VELOCITY_EACH = 4;
constexpr double VELOCITY_SHIFT = 0x1p-6;  // change of the velocities in this check, relative to the largest

// Returns whether the accelerations at y = (q, v) are others with velocities that differ a little, so that a function is hardly asked
// where it is not defined. Only the number of evaluations says how many steps have been made.
template <class AnyRun>
[[gnu::cold, gnu::noinline]] inline bool depends_on_velocity(const AnyRun &run, double t, const double *y) {
    const auto &w = run.work;
    const int64_t half = w.m / 2;
    const double fastest = largest_abs(y + half, half), shift = VELOCITY_SHIFT * (fastest > 0.0 ? fastest : 1.0);
    copy(y, w.stage, w.m);
    run.system.rhs_of_scratch(w, t, w.stage, w.row(1));
    copy(y, w.stage, half);
    for (int64_t i = half; i < w.m; ++i) w.stage[i] = y[i] + shift;
    run.system.rhs_of_scratch(w, t, w.stage, w.f_point);
    w.counters[NFEV] += 2;
    for (int64_t i = half; i < w.m; ++i) {
        const double here = w.row(1)[i], there = w.f_point[i];
        if (here != there && std::isfinite(here) && std::isfinite(there)) return true;
    }
    return false;
}

// Stages keep v, which the accelerations must not see: BY_VELOCITY if they are found to do.
template <class AnyRun>
inline Code rkn_stages(const AnyRun &run, const Step &step) {
    const auto &m = run.method;
    const auto &w = run.work;
    const int64_t half = w.m / 2;
    const double *accelerations = w.K + half;
    if (m.sees_velocity && w.counters[NFEV] / m.stages % VELOCITY_EACH == 0) [[unlikely]]
        if (depends_on_velocity(run, step.t, step.y)) return BY_VELOCITY;
    copy(step.y + half, w.stage + half, half);
    for (int64_t i = 1; i < m.stages; ++i) {
        nystrom_position(step.y, step.h, m.c[i], {m.A + i * m.columns, accelerations, i, w.m}, w.stage, half);
        run.system.rhs_of_scratch(w, step.t + m.c[i] * step.h, w.stage, w.row(i));
    }
    if (run.options.compensated) {
        compensated_nystrom(step.y, step.h, m, w);
        return OK;
    }
    nystrom_position(step.y, step.h, 1.0, {m.b, accelerations, m.stages, w.m}, w.y_hat, half);
    combine(step.y + half, step.h, {m.b_v, accelerations, m.stages, w.m}, w.y_hat + half, half);
    return OK;
}

}  // namespace eip
