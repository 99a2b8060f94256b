// A whole step: the raw one, the projection, and the control of its length, which is SciPy's.
#pragma once

#include "columns.hpp"
#include "multistep.hpp"

namespace eip {

constexpr double SAFETY = 0.9, MIN_FACTOR = 0.2, MAX_FACTOR = 10.0;
// A failed projection shrinks the step as CVODE does.
constexpr double RETRY_FACTOR = 0.25;
constexpr int MAX_RETRIES = 10;
// Steps that change almost nothing may meet targets that no state near the trajectory meets. A run ends after MOST_STUCK
// failed projections in steps whose estimated error, in tolerances, is below TINY_ERROR.
constexpr double TINY_ERROR = 1e-6;
constexpr int64_t MOST_STUCK = 100;
// A step that ends next to a singular position is made again, once, with this fraction of its length.
constexpr double SHORTENED = 0.5;
// every = AUTO: every few steps the step asks whether a projection is worth it, and the step after one that was.
constexpr int64_t AUTO_SPACING = 5;

// The stages and their sum, y_hat.
template <class AnyRun>
inline Code make_stages(const AnyRun &run, const Step &step) {
    Code status = OK;
    if (run.method.nystrom)
        status = rkn_stages(run, step);
    else if (!made_with_rates(run, step))
        rk_stages(run, step);
    run.work.counters[NFEV] += run.method.stages - 1;
    return status;
}

// Return whether the derivative at y_hat serves the projection only, and another one follows.
inline bool is_for_projection(const auto &o, const Step &step) { return step.project && !o.reuse_f; }

// Computes f at y_hat in w.last(), and if the step is to be projected what else one pass finds there.
template <class AnyRun>
inline void evaluate_raw(const AnyRun &run, const Step &step) {
    const auto &w = run.work;
    ++w.counters[NFEV];
    if constexpr (IS_SINGLE<AnyRun>) {
        auto &system = run.system;
        system.at_raw = Known::NOTHING;
        if (step.project && (system.together || system.with_energy))
            return system.evaluate_for_projection(w, step.t_new, w.y_hat, w.last());
        if (!is_for_projection(run.options, step)) return system.rhs_of_whole(w, step.t_new, w.y_hat, w.last());
    }
    run.system.rhs(w, step.t_new, w.y_hat, w.last());
}

// Computations after the stages: f at y_hat in w.last(), the local error in w.err and its norm in w.norm where they are needed.
// Return whether the step's local errors are to be compared with what it changes in each block.
template <class AnyRun>
inline bool look_back(const AnyRun &run, const Step &step) {
    const auto &m = run.method;
    const auto &o = run.options;
    const auto &w = run.work;
    const bool estimate = o.adaptive || ((o.metric == BY_ERROR || o.every == AUTO) && w.l > 0);
    w.counters[HAVE_F] = (estimate && m.fsal) || (step.project && o.uses_f);
    w.counters[HAVE_ERROR] = estimate;
    if (w.counters[HAVE_F]) evaluate_raw(run, step);
    if (estimate) estimate_error(run, step);
    if (!step.project) return false;
    const bool sampled = is_sampled(run);
    if (sampled) [[unlikely]]
        sample(of_any_length(run), step);
    w.counters[F_AT_RAW] = sampled || (o.adaptive && w.counters[HAVE_F] && w.counters[BEGUN] % ADAPTIVE_EACH == 0);
    return sampled && is_sampled_for_resolution(w);
}

// Computes what the projection needs, and compares the local errors with the changes in each block.
template <class AnyRun>
inline void look_back_and_compare(const AnyRun &run, const Step &step) {
    if (look_back(run, step) && !run.options.adaptive) [[unlikely]]
        note_roughness(step, run.options, run.work);
}

// Does so for a run with columns of derivatives; nothing of it depends on them.
[[gnu::noinline]] inline void look_back_at_state(const Run &run, const Step &step) {
    of_state_alone(run, [&](const auto &alone) { look_back_and_compare(alone, step); });
    int64_t &have = run.work.counters[HAVE_F];
    if (have && run.system.takes_state && is_for_projection(run.options, step)) have = OF_STATE;
}

template <class AnyRun>
inline Code raw_step(const AnyRun &run, const Step &step) {
    const Code status = make_stages(run, step);
    if (status != OK) return status;
    if (!all_finite(run.work.y_hat, run.work.m)) return NOT_FINITE;
    if (has_state_alone(run)) [[unlikely]]
        look_back_at_state(of_any_length(run), step);
    else
        look_back_and_compare(run, step);
    return OK;
}

template <class AnyRun>
inline Code any_raw_step(const AnyRun &run, const Step &step) {
    return run.hooks && run.hooks->raw ? static_cast<Code>(run.hooks->raw_step(step)) : raw_step(run, step);
}

// The balances at the end y of a step, and their rates at the state where w.last() is the derivative, which is found at y if
// it is `wanted`: rates by another state would hold what the derivatives differ by.
[[gnu::noinline]] inline void close_balances(const Run &run, double t, const double *y, bool wanted) {
    const Work &w = run.work;
    keep_levels(run.options.balances, w);
    if (wanted)
        run.system.rhs_and_rates(w, t, y, w.last(), w.rate(w.stages));
    else
        run.system.rates(w, t, w.y_hat, w.last(), w.rate(w.stages));
}

// f at the end y of a step in w.last(), if it is `wanted`, and the balances there. Batches of members have none.
template <class AnyRun>
inline void close_derivative(const AnyRun &run, double t, const double *y, bool wanted) {
    const auto &w = run.work;
    w.counters[NFEV] += wanted;
    if constexpr (IS_SINGLE<AnyRun>)
        if (w.balances > 0) [[unlikely]]
            return close_balances(of_any_length(run), t, y, wanted);
    if constexpr (IS_SINGLE<AnyRun>)
        if (wanted && run.system.has_f_at_end) return copy(run.system.f_at_end.data(), w.last(), w.m);
    if (wanted) run.system.rhs(w, t, y, w.last());
}

// After the projection: the carry, the errors gathered, and f for the next step's first stage in w.last().
template <class AnyRun>
inline void close_step(const AnyRun &run, const Step &step, Code status) {
    const auto &o = run.options;
    const auto &w = run.work;
    if (o.compensated) copy(w.carry_hat, w.carry, w.m);
    if (!step.project || status == POSTPONED)
        ++w.counters[WAITED];
    else
        w.counters[WAITED] = 0;
    if (o.every != 1) {
        if (status == POSTPONED)
            copy(w.err, w.err_sum, w.m);
        else if (step.project)
            fill(w.err_sum, 0.0, w.m);
        else if (o.metric == BY_ERROR || o.every == AUTO || o.adaptive)
            quadrature(w.err, w.err_sum, w.err_sum, w.m);
    }
    const bool have = w.counters[HAVE_F] && w.counters[HAVE_F] != OF_STATE;
    const bool wanted = !have || (step.project && status == OK && !o.reuse_f);
    close_derivative(run, step.t_new, step.y_new, wanted);
}

// The rest of a step whose raw result is accepted; OK, FAILED_PROJECTION or NEAR_SINGULAR.
template <class AnyRun>
inline Code finish_step(const AnyRun &run, const Step &step) {
    Code status = OK;
    if constexpr (IS_SINGLE<AnyRun>) run.system.has_f_at_end = false;
    if (step.project) {
        status = project_whole(run, step);
        if (status == NEAR_SINGULAR) [[unlikely]]
            return status;
        if (status == FAILED_PROJECTION) {
            ++run.work.counters[REJECTED];
            return status;
        }
    } else {
        copy(run.work.y_hat, step.y_new, run.work.m);
    }
    close_step(run, step, status);
    return OK;
}

// SciPy's: ten spacings of the numbers at t.
inline double least_step(double t, double sign) { return 10.0 * std::abs(std::nextafter(t, sign * ENDLESS) - t); }

// Says whether step k is projected; the last one always is.
template <class AnyRun>
inline bool is_projected(const AnyRun &run, int64_t k, bool last) {
    const int64_t every = run.options.every, spacing = every == AUTO ? AUTO_SPACING : every;
    const bool again = every == AUTO && !run.method.multistep && run.work.counters[WAITED] == 0;
    return run.work.l > 0 && (last || again || spacing == 1 || (k + 1) % spacing == 0);
}

// Step k of a solver that controls its error and its length. Where a projection fails it takes the step back and makes a
// shorter one, at most MAX_RETRIES times.
template <class AnyRun>
[[gnu::noinline]] inline Code driven_step(const AnyRun &run, const Span &span, double *clock, int64_t k,
                                          const double *y, double *y_new) {
    if (std::isnan(clock[NEXT_LENGTH])) return NOT_FINITE;
    Code status = OK;
    for (int retries = 0; retries <= MAX_RETRIES; ++retries) {
        const auto code = static_cast<Code>(run.hooks->drive(clock[TIME], y, retries > 0, clock));
        if (code != OK) return status == OK ? code : status;
        const bool last = clock[TIME_NEW] == span.t_bound;
        const Step step{clock[TIME], clock[TIME_NEW], clock[LENGTH], y, y_new, is_projected(run, k, last), last};
        status = any_raw_step(run, step);
        if (status == OK) status = finish_step(run, step);
        if (status != FAILED_PROJECTION) return status;
    }
    return status;
}

// Step k: fixed, or the first one that the error control accepts; K[0] = f(t, y) on entry, w.last() = f at its end.
//
// A failed projection shortens the step, at most MAX_RETRIES times in a row, and not where that does not help; the first end next to a singular position
// does, too, because a step from elsewhere may cross it. Returns OK, NOT_FINITE, FAILED_PROJECTION or
// TOO_SMALL; of a multistep method UNSTABLE and of a Nystrom method BY_VELOCITY too.
template <class AnyRun>
inline Code next_step(const AnyRun &run, const Span &span, double *clock, int64_t k, const double *y, double *y_new) {
    if (run.method.multistep) return next_states(OneState{of_any_length(run), y_new}, span, clock, k, k + 1, y, y_new);
    if (run.hooks && run.hooks->drives) return driven_step(run, span, clock, k, y, y_new);
    const auto &w = run.work;
    const bool adaptive = run.options.adaptive;
    if (!adaptive) clock[TIME] = span.t0 + k * span.h;
    const double t = clock[TIME], least = adaptive ? least_step(t, span.sign) : 0.0;
    double h_abs = clock[NEXT_LENGTH];
    if (h_abs > span.max_step)
        h_abs = span.max_step;
    else if (h_abs < least)
        h_abs = least;
    bool rejected = false, avoids_singular = adaptive;
    int retries = 0;
    Code status = std::isnan(h_abs) ? NOT_FINITE : TOO_SMALL;
    while (h_abs >= least) {
        const double t_new = adaptive ? t + h_abs * span.sign : span.t0 + (k + 1) * span.h;
        const bool last = adaptive ? span.sign * (t_new - span.t_bound) >= 0 : k + 1 >= span.n_steps;
        clock[TIME_NEW] = last ? span.t_bound : t_new;
        clock[LENGTH] = adaptive ? clock[TIME_NEW] - t : span.between(k, k + 1);
        h_abs = std::abs(clock[LENGTH]);
        avoids_singular = avoids_singular && !last && SHORTENED * h_abs >= least;
        const Step step{t, clock[TIME_NEW], clock[LENGTH], y, y_new, is_projected(run, k, last), last, avoids_singular};
        status = any_raw_step(run, step);
        if (status == BY_VELOCITY) [[unlikely]]
            return status;
        const double norm = adaptive ? w.norm[0] : 0.0;
        if (status == OK && !std::isfinite(norm)) status = NOT_FINITE;
        if (status == OK && norm < 1.0) {
            status = finish_step(run, step);
            if (status == OK) {
                if (adaptive && w.counters[STUCK] > 0) [[unlikely]]
                    w.counters[STUCK] -= retries == 0;
                const double factor =
                    norm == 0.0 ? MAX_FACTOR : std::min(MAX_FACTOR, SAFETY * std::pow(norm, run.method.exponent));
                clock[NEXT_LENGTH] = h_abs * (rejected ? std::min(1.0, factor) : factor);
                return OK;
            }
            if (status == NEAR_SINGULAR) {
                avoids_singular = false;
                h_abs *= SHORTENED;
                continue;
            }
            w.counters[STUCK] += adaptive && norm < TINY_ERROR;
            if (retries == MAX_RETRIES || w.counters[STUCK] >= MOST_STUCK) return status;
            ++retries;
            h_abs *= RETRY_FACTOR;
        } else if (status == OK) {
            h_abs *= std::max(MIN_FACTOR, SAFETY * std::pow(norm, run.method.exponent));
            status = TOO_SMALL;
        } else {
            h_abs *= MIN_FACTOR;
        }
        if (!adaptive) return status;
        rejected = true;
    }
    return status;
}

}  // namespace eip
