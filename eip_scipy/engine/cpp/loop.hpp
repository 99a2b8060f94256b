// The loop over steps, and what it saves.
#pragma once

#include <algorithm>
#include <type_traits>

#include "control.hpp"
#include "dense.hpp"
#include "roots.hpp"

namespace eip {

// Where a run steps and what it saves. `place` holds [step, row, pending]: pending is 1 between a step and its becoming
// the current state, so that whoever is called in between sees both of its ends.
struct Schedule {
    Span span;
    int64_t save_every;
    const double *t_eval;
    int64_t n_eval;
    int64_t *place;
    double *clock, *g, *g_new;
    const double *g_direction;
    int64_t n_events;
};

struct Saved {
    double *t, *y;
    int64_t rows;
};

// Roots that the loop has found since someone looked: of which event, when, in which state. `left`: how often an event may
// still happen before it ends the run.
struct Roots {
    int64_t *event;
    double *t, *y;
    int64_t *count;
    int64_t capacity;
    double *left;
};

// Interpolants of all steps, where they are kept.
struct Pieces {
    double *first;
    int64_t *count;
    int64_t capacity;
};

// Dense output, and what the loop samples by it; `interpolants` are kept where there is room for any.
struct Samples {
    Dense dense;
    Roots roots;
    Pieces interpolants;
    double *piece;  // scratch for the interpolant of a step
};

// Whether event i changes its sign in the direction that it looks at.
inline bool crossed(const Schedule &s, int64_t i) {
    return (s.g[i] <= 0.0 && 0.0 <= s.g_new[i] && s.g_direction[i] >= 0.0) ||
           (s.g[i] >= 0.0 && 0.0 >= s.g_new[i] && s.g_direction[i] <= 0.0);
}

inline bool any_crossed(const Schedule &s) {
    for (int64_t i = 0; i < s.n_events; ++i)
        if (crossed(s, i)) return true;
    return false;
}

// Notes the events that happen in a step, in the order of their times. ENDED where one of them ends the run, at `end`: what
// comes after it does not count. PAUSE, and nothing noted, where one has no root to be found.
inline Code locate(const Run &run, const DenseRun &dense, const Schedule &s, Roots &roots, double *piece, double &end) {
    const auto &w = run.work;
    std::vector<double> values(s.n_events), state(w.m);
    std::vector<std::pair<double, int64_t>> found;
    for (int64_t i = 0; i < s.n_events; ++i) {
        if (!crossed(s, i)) continue;
        const double root = root_between(s.clock[TIME], s.g[i], s.clock[TIME_NEW], s.g_new[i], [&](double t) {
            interpolate(dense, piece, t, state.data());
            run.system.event(w, t, state.data(), values.data());
            return values[i];
        });
        if (std::isnan(root)) return PAUSE;
        const auto place = std::find_if(found.begin(), found.end(),
                                        [&](const auto &other) { return s.span.sign * (root - other.first) < 0.0; });
        found.emplace(place, root, i);
    }
    for (const auto &[t, event] : found) {
        int64_t &count = *roots.count;
        roots.event[count] = event;
        roots.t[count] = t;
        interpolate(dense, piece, t, roots.y + count * w.m);
        ++count;
        roots.left[event] -= 1.0;
        if (roots.left[event] <= 0.0) {
            end = t;
            return ENDED;
        }
    }
    return OK;
}

// What is asked for within the step that is pending: its interpolant, roots of events, states at given times. OK, ENDED by
// an event, or PAUSE where the caller has to do it: events in Python, one without a root, no room for more.
inline Code sample(const Run &run, Samples &samples, const Schedule &s, const double *y, const double *y_new,
                   const Saved &saved) {
    const auto &w = run.work;
    const DenseRun dense(samples.dense, run.system);
    Pieces &kept = samples.interpolants;
    Roots &roots = samples.roots;
    double end = s.clock[TIME_NEW];
    const bool crossing = any_crossed(s), able = !run.system.python && roots.capacity - *roots.count >= s.n_events;
    if (crossing && !able && kept.capacity == 0) return PAUSE;
    double *piece = kept.capacity > 0 ? kept.first + *kept.count * samples.dense.floats() : samples.piece;
    describe(dense, w, s.clock[TIME], y, end, y_new, piece);
    *kept.count += kept.capacity > 0;
    Code code = OK;
    if (crossing) code = able ? locate(run, dense, s, roots, piece, end) : PAUSE;
    for (int64_t &row = s.place[ROW]; code != PAUSE && row < s.n_eval; ++row) {
        if (s.span.sign * (s.t_eval[row] - end) > 0.0) break;
        saved.t[row] = s.t_eval[row];
        interpolate(dense, piece, s.t_eval[row], saved.y + row * w.m);
    }
    count_calls(dense, w);
    return code;
}

// Whether something within the step is asked for: more than a time that is its end, whose state is saved here.
inline bool wants_samples(const Work &w, const Samples *samples, const Schedule &s, const double *y_new,
                          const Saved &saved) {
    int64_t &row = s.place[ROW];
    if (any_crossed(s) || (samples && samples->interpolants.capacity > 0)) return true;
    const double t_new = s.clock[TIME_NEW];
    if (row >= s.n_eval || s.span.sign * (s.t_eval[row] - t_new) > 0.0) return false;
    if (s.t_eval[row] != t_new) return true;
    saved.t[row] = t_new;
    copy(y_new, saved.y + row * w.m, w.m);
    ++row;
    return false;
}

// How far the steps go before someone looks: a multistep method makes many at once.
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

// The step up to which a member goes that is at step k, in so many steps: to its end where a multistep method is near it,
// whose last states cost a step of the method that starts, each of them that is asked for.
inline int64_t last_of(const Method &method, const Span &span, int64_t k, int64_t steps) {
    const bool near = method.multistep && span.n_steps - method.multistep->middle <= k + steps;
    return near ? span.n_steps : k + steps;
}

// Steps up to `k_end`; returns OK or why it stopped. Without `samples` it pauses where there is something to sample.
template <class AnyRun>
[[gnu::noinline]] inline Code advance(const AnyRun &run, Samples *samples, const Schedule &s, int64_t k_end, double *y,
                                      double *y_new, const Saved &saved) {
    const auto &w = run.work;
    int64_t *place = s.place;
    while (true) {
        if (place[PENDING] == 1) {
            s.clock[TIME] = s.clock[TIME_NEW];
            copy(w.last(), w.row(0), w.m);
            copy(y_new, y, w.m);
            copy(s.g_new, s.g, s.n_events);
            place[PENDING] = 0;
        }
        const int64_t k = place[STEP];
        if (s.clock[TIME] == s.span.t_bound || k >= k_end) return OK;
        if (s.n_eval == 0 && place[ROW] + 2 > saved.rows) return FULL;
        if (samples && samples->interpolants.capacity > 0 &&
            *samples->interpolants.count == samples->interpolants.capacity)
            return FULL;
        const int64_t stop = next_stop(run.method, samples, s, k, k_end);
        const Code status =
            stop == k + 1 ? next_step(run, s.span, s.clock, k, y, y_new)
                          : next_states(OneState{of_any_length(run), y_new}, s.span, s.clock, k, stop, y, y_new);
        if (status != OK) return status;
        place[STEP] = stop;
        place[PENDING] = 1;
        const double t_new = s.clock[TIME_NEW];
        const bool due = t_new == s.span.t_bound || (s.save_every > 0 && stop % s.save_every == 0);
        if (s.n_eval == 0 && due) {
            saved.t[place[ROW]] = t_new;
            copy(y_new, saved.y + place[ROW] * w.m, w.m);
            ++place[ROW];
        }
        if (s.n_events > 0) run.system.event(w, t_new, y_new, s.g_new);
        if (!wants_samples(w, samples, s, y_new, saved)) continue;
        const Code code = samples ? sample(of_any_length(run), *samples, s, y, y_new, saved) : PAUSE;
        if (code != OK) return code;
    }
}

}  // namespace eip
