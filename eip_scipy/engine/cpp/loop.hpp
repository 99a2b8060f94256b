// The loop over steps, and what it saves.
#pragma once

#include <algorithm>

#include "control.hpp"
#include "crossings.hpp"
#include "dense.hpp"

namespace eip {

// Steps of a run and what it saves. `place` holds [step, row, pending]: pending is 1 between a step and its becoming
// the current state, so that functions called in between see both of its ends. Of the events there are the values and
// the rates of change at both ends; a rate that is not known yet is NaN.
// clang-format off
#define EIP_SCHEDULE(FIELD, STATES, PYTHON, DERIVED) \
    FIELD(Span, span) FIELD(int64_t, save_every) FIELD(const double *, t_eval, Bound{n_eval}) \
    FIELD(int64_t *, place, 3) FIELD(double *, clock, 4) FIELD(double *, g, Bound{n_events}) \
    FIELD(double *, g_new, n_events) FIELD(double *, rate, n_events) FIELD(double *, rate_new, n_events) \
    FIELD(const double *, g_direction, n_events)
// clang-format on
struct Schedule {
    int64_t n_eval, n_events;
    EIP_RECORD(EIP_SCHEDULE, "Schedule")
};

struct Saved {
    double *t, *y;
    int64_t rows;
};

// Interpolants of all steps, where they are kept.
struct Pieces {
    double *first;
    int64_t capacity;
};

// Roots that the loop has found since Python last read them: the event, the time and the state of each. `left`: how
// often an event may still happen before it ends the run. If there is too little room for the states of a step's roots,
// or a root cannot be found, these roots are stored in `pending_*`. The counts are those of the roots, the interpolants and the
// pending roots.
// clang-format off
#define EIP_ROOTS(FIELD, STATES, PYTHON, DERIVED) \
    FIELD(int64_t *, event, Bound{capacity}) FIELD(double *, t, capacity) STATES(double *, y, capacity, run.n) \
    FIELD(int64_t *, counts, 3) FIELD(double *, left, run.events) \
    FIELD(int64_t *, pending_event, MOST_CROSSINGS * run.events) FIELD(double *, pending_t, MOST_CROSSINGS * run.events)
// clang-format on
struct Roots {
    int64_t capacity;
    EIP_RECORD(EIP_ROOTS, "Roots")
};

// Dense output, and what the loop samples by it; `interpolants` are kept where there is room for any.
struct Samples {
    static constexpr const char *RECORD = "Dense";
    Dense dense;
    Roots roots;
    Pieces interpolants;

    template <class Visit>
    void fields(Visit &visit) {
        dense.fields(visit);
        roots.fields(visit);
    }
};

// Says whether event i goes from the value `before` to the value `after` in the direction that it looks at.
inline bool crosses(const Schedule &s, int64_t i, double before, double after) {
    // A zero before has been counted at the end of the last step, and does not count at the start of a run.
    return (before < 0.0 && 0.0 <= after && s.g_direction[i] >= 0.0) ||
           (before > 0.0 && 0.0 >= after && s.g_direction[i] <= 0.0);
}

// Says whether event i is a limit, which has an infinite direction, and the run starts beyond it.
inline bool starts_beyond(const Schedule &s, int64_t i) {
    return s.clock[TIME] == s.span.t0 && s.g[i] * s.g_direction[i] == ENDLESS;
}

inline EventEnds ends_of(const Schedule &s, int64_t i) {
    const double h = s.clock[TIME_NEW] - s.clock[TIME];
    return {s.g[i], s.g_new[i], h * s.rate[i], h * s.rate_new[i]};
}

// Says whether an event happens in the step, or may happen there twice.
inline bool any_crossing(const Schedule &s) {
    for (int64_t i = 0; i < s.n_events; ++i)
        if (starts_beyond(s, i) || crosses(s, i, s.g[i], s.g_new[i]) || may_cross_inside(ends_of(s, i))) return true;
    return false;
}

// Values of the events at the end of the step, and their rates of change: a difference over a small part of the step, inside
// of it, along the slope of the state.
[[gnu::noinline]] inline void evaluate_events(const Run &run, const Dense &d, const Schedule &s, const double *y,
                                              const double *y_new) {
    const Work &w = run.work;
    const double t = s.clock[TIME], t_new = s.clock[TIME_NEW], part = SLOPE_PART * (t_new - t);
    double *state = d.work.y_hat;
    const auto values_near = [&](double time, double distance, const double *at, const double *f, double *values) {
        for (int64_t i = 0; i < w.m; ++i) state[i] = at[i] + distance * f[i];
        run.system.event(w, time + distance, state, values);
    };
    run.system.event(w, t_new, y_new, s.g_new);
    if (std::isnan(s.rate[0])) {
        // An event that does not count at the start has the value 0 in s.g.
        values_near(t, part, y, slope_at(false, run, d, t, t, y), s.rate);
        run.system.event(w, t, y, s.rate_new);
        for (int64_t i = 0; i < s.n_events; ++i) s.rate[i] = (s.rate[i] - s.rate_new[i]) / part;
    }
    values_near(t_new, -part, y_new, slope_at(true, run, d, t, t_new, y_new), s.rate_new);
    for (int64_t i = 0; i < s.n_events; ++i) s.rate_new[i] = (s.g_new[i] - s.rate_new[i]) / part;
}

struct Root {
    double t;
    int64_t event;
};

// The roots of all events in a step, in the order of their times; NaN for one that is not found.
inline std::vector<Root> roots_in_step(const Run &run, const DenseRun &dense, const Schedule &s, double *piece) {
    const auto &w = run.work;
    const double t = s.clock[TIME], t_new = s.clock[TIME_NEW], length = std::abs(t_new - t);
    std::vector<double> values(s.n_events), state(w.m);
    std::vector<Root> found;
    for (int64_t i = 0; i < s.n_events; ++i) {
        if (starts_beyond(s, i)) {
            found.insert(found.begin(), {t, i});
            continue;
        }
        const auto value_at = [&](double time) {
            interpolate(dense, piece, time, state.data());
            run.system.event(w, time, state.data(), values.data());
            return values[i];
        };
        const auto time_of = [&](double theta) { return t + theta * (t_new - t); };
        const EventEnds ends = ends_of(s, i);
        EventPoints inside;
        if (may_cross_inside(ends)) {
            const double missed = dense.dense.missed[0];
            inside = points_inside(ends, [&](double theta) { return value_at(time_of(theta)); });
            if (inside.count == 0) dense.dense.missed[0] = missed;  // no result has a state that was left unprojected
        }
        double before = t, g_before = s.g[i];
        for (int k = 0; k <= inside.count; ++k) {
            const bool last = k == inside.count;
            const double after = last ? t_new : time_of(inside.point[k].theta);
            const double g_after = last ? s.g_new[i] : inside.point[k].value;
            if (crosses(s, i, g_before, g_after)) {
                const double root = root_between(length, before, g_before, after, g_after, value_at);
                const auto place = std::find_if(found.begin(), found.end(), [&](const Root &other) {
                    return s.span.sign * (root - other.t) < 0.0;
                });
                found.insert(place, {root, i});
            }
            before = after;
            g_before = g_after;
        }
    }
    return found;
}

// Notes the events that happen in a step, in the order of their times. ENDED where one of them ends the run, at `end`: what
// comes after it does not count. PAUSE, with all of them pending, if their states have no room or one cannot be found.
inline Code locate(const Run &run, const DenseRun &dense, const Schedule &s, Roots &roots, double *piece, double &end) {
    const std::vector<Root> found = roots_in_step(run, dense, s, piece);
    const auto number = std::ssize(found);
    const bool lost = std::any_of(found.begin(), found.end(), [](const Root &root) { return std::isnan(root.t); });
    if (lost || roots.capacity - roots.counts[0] < number) {
        for (const auto &[t, event] : found) {
            roots.pending_event[roots.counts[2]] = event;
            roots.pending_t[roots.counts[2]++] = t;
        }
        return PAUSE;
    }
    for (const auto &[t, event] : found) {
        int64_t &count = roots.counts[0];
        roots.event[count] = event;
        roots.t[count] = t;
        interpolate(dense, piece, t, roots.y + count * run.work.m);
        ++count;
        roots.left[event] -= 1.0;
        if (roots.left[event] <= 0.0) {
            end = t;
            return ENDED;
        }
    }
    return OK;
}

// Notes whether the state at an end of a step (0 or 1) is one that no projection has made: `waited` steps after the last
// one, or of a multistep method, whose projections are those of its history, `inside` the run.
inline void note_waiting(const Samples *samples, int64_t end, const Method &method, int64_t waited, bool inside) {
    if (samples) samples->dense.waiting[end] = method.multistep ? inside : waited > 0;
}

// Saves the state y at t, an end of the current step, as a row: as it is returned.
template <class AnyRun>
inline void give(const AnyRun &run, const Samples *samples, int64_t end, double t, const double *y, double *out) {
    const auto &w = run.work;
    if (!samples || !samples->dense.shows || !samples->dense.waiting[end]) return copy(y, out, w.m);
    const DenseRun dense(samples->dense, run.system);
    hand_out(of_any_length(run), dense, t, y, w.level, out);
    count_calls(dense, of_any_length(run).work);
}

// Handles requests within the pending step: its interpolant, roots of events, states at given times. OK, ENDED by
// an event, or PAUSE where the caller has to do the rest, see `locate`.
inline Code sample(const Run &run, Samples &samples, const Schedule &s, const double *y, const double *y_new,
                   const Saved &saved) {
    const auto &w = run.work;
    const DenseRun dense(samples.dense, run.system);
    Pieces &kept = samples.interpolants;
    double end = s.clock[TIME_NEW];
    int64_t &count = samples.roots.counts[1];
    double *piece = kept.capacity > 0 ? kept.first + count * samples.dense.floats() : samples.dense.piece;
    describe(run, dense, s.clock[TIME], y, end, y_new, piece);
    count += kept.capacity > 0;
    const Code code = any_crossing(s) ? locate(run, dense, s, samples.roots, piece, end) : OK;
    for (int64_t &row = s.place[ROW]; code != PAUSE && row < s.n_eval; ++row) {
        if (s.span.sign * (s.t_eval[row] - end) > 0.0) break;
        saved.t[row] = s.t_eval[row];
        interpolate(dense, piece, s.t_eval[row], saved.y + row * w.m);
    }
    count_calls(dense, w);
    return code;
}

// True if something within the step is requested: more than a time that is its end, whose state is saved here.
template <class AnyRun>
inline bool wants_samples(const AnyRun &run, const Samples *samples, const Schedule &s, const double *y_new,
                          const Saved &saved) {
    int64_t &row = s.place[ROW];
    if (any_crossing(s) || (samples && samples->interpolants.capacity > 0)) return true;
    const double t_new = s.clock[TIME_NEW];
    if (row >= s.n_eval || s.span.sign * (s.t_eval[row] - t_new) > 0.0) return false;
    if (s.t_eval[row] != t_new) return true;
    saved.t[row] = t_new;
    give(run, samples, 1, t_new, y_new, saved.y + row * run.work.m);
    ++row;
    return false;
}

// Returns the step up to which steps are made at once: the next one, or a later one if a multistep method makes many
// steps at once and nothing between them is needed.
inline int64_t next_stop(const Method &method, const Samples *samples, const Schedule &s, int64_t k, int64_t k_end) {
    const bool each = s.n_events > 0 || (samples && samples->interpolants.capacity > 0);
    if (!method.multistep || method.multistep->brief || each) return k + 1;
    int64_t stop = std::min(k_end, s.span.n_steps);
    if (s.save_every > 0) stop = std::min(stop, (k / s.save_every + 1) * s.save_every);
    if (s.place[ROW] < s.n_eval) {  // the step before the one with the next time in it
        const double steps = (s.t_eval[s.place[ROW]] - s.span.t0) / s.span.h;
        stop = std::min(stop, static_cast<int64_t>(std::floor(steps)) - 1);
    }
    return std::max(stop, k + 1);
}

// Returns the step to which a member at step k advances within the given number of steps. A member of a multistep
// method that is close to its end advances to the end: each of the last states costs a step of the starting method
// whenever one of them is needed.
inline int64_t last_of(const Method &method, const Span &span, int64_t k, int64_t steps) {
    const bool at_end = method.multistep && span.n_steps - method.multistep->middle <= k + steps;
    return at_end ? span.n_steps : k + steps;
}

// Steps up to `k_end`; returns OK or why it stopped. Without `samples` it pauses where there is something to sample.
template <class AnyRun>
[[gnu::noinline]] inline Code advance(const AnyRun &run, Samples *samples, const Schedule &s, int64_t k_end, double *y,
                                      double *y_new, const Saved &saved) {
    const auto &w = run.work;
    int64_t *place = s.place;
    run.system.choose();
    while (true) {
        if (place[PENDING] == 1) {
            s.clock[TIME] = s.clock[TIME_NEW];
            copy(w.last(), w.row(0), w.m);
            copy(w.rate(w.stages), w.rate(0), w.balances);
            copy(y_new, y, w.m);
            copy(s.g_new, s.g, s.n_events);
            copy(s.rate_new, s.rate, s.n_events);
            place[PENDING] = 0;
        }
        const int64_t k = place[STEP];
        if (s.clock[TIME] == s.span.t_bound || k >= k_end) return OK;
        if (s.n_eval == 0 && place[ROW] + 2 > saved.rows) return FULL;
        if (samples && samples->interpolants.capacity > 0 && samples->roots.counts[1] == samples->interpolants.capacity)
            return FULL;
        note_waiting(samples, 0, run.method, w.counters[WAITED], k > 0);
        const int64_t stop = next_stop(run.method, samples, s, k, k_end);
        const Code status = stop == k + 1
                                ? next_step(run, s.span, s.clock, k, y, y_new)
                                : next_states(OneState{of_any_length(run), y_new}, s.span, s.clock, k, stop, y, y_new);
        if (status != OK) {
            restore_levels(run.options.balances, w);
            return status;
        }
        place[STEP] = stop;
        place[PENDING] = 1;
        const double t_new = s.clock[TIME_NEW];
        note_waiting(samples, 1, run.method, w.counters[WAITED], t_new != s.span.t_bound);
        const bool due = t_new == s.span.t_bound || (s.save_every > 0 && stop % s.save_every == 0);
        if (s.n_eval == 0 && due) {
            saved.t[place[ROW]] = t_new;
            give(run, samples, 1, t_new, y_new, saved.y + place[ROW] * w.m);
            ++place[ROW];
        }
        if (s.n_events > 0) evaluate_events(of_any_length(run), samples->dense, s, y, y_new);
        if (!wants_samples(run, samples, s, y_new, saved)) continue;
        const Code code = samples ? sample(of_any_length(run), *samples, s, y, y_new, saved) : PAUSE;
        if (code != OK) return code;
    }
}

}  // namespace eip
