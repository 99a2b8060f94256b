// The loop over steps, and what it saves.
#pragma once

#include "control.hpp"

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

// Whether an event changes its sign in the direction that it looks at.
inline bool crossed(const Schedule &s) {
    for (int64_t i = 0; i < s.n_events; ++i) {
        if (s.g[i] <= 0.0 && 0.0 <= s.g_new[i] && s.g_direction[i] >= 0.0) return true;
        if (s.g[i] >= 0.0 && 0.0 >= s.g_new[i] && s.g_direction[i] <= 0.0) return true;
    }
    return false;
}

// Steps up to `k_end`; returns OK or why it stopped.
template <class AnyRun>
inline Code advance(AnyRun &run, const Schedule &s, int64_t k_end, double *y, double *y_new, const Saved &saved) {
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
        if (place[ROW] + 2 > saved.rows) return FULL;
        const Code status = next_step(run, s.span, s.clock, k, y, y_new);
        if (status != OK) return status;
        place[STEP] = k + 1;
        place[PENDING] = 1;
        const double t_new = s.clock[TIME_NEW];
        const bool due = t_new == s.span.t_bound || (s.save_every > 0 && (k + 1) % s.save_every == 0);
        if (s.n_eval == 0 && due) {
            saved.t[place[ROW]] = t_new;
            copy(y_new, saved.y + place[ROW] * w.m, w.m);
            ++place[ROW];
        }
        if (s.n_events > 0) {
            run.system.event(w, t_new, y_new, s.g_new);
            if (crossed(s)) return PAUSE;
        }
        if (place[ROW] < s.n_eval && s.span.sign * (s.t_eval[place[ROW]] - t_new) <= 0.0) return PAUSE;
    }
}

}  // namespace eip
