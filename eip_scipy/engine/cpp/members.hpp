// Members of an ensemble one after the other, on the buffers of one run.
#pragma once

#include "loop.hpp"

namespace eip {

// All members: `count` starts, parameters, lengths of first steps and values of the events, and the results of each member. `where` holds the
// current member and whether it has begun. Rows are saved for each member, or for none if `kept` is false.
struct Members {
    int64_t count, n_rows, evaluations;
    bool kept;
    double *starts, *params, *first_steps, *events, *sigma, *left, *t_saved;
    double *y, *t, *rows, *max_residual, *max_correction, *figures, *suspects;
    int64_t *status, *counters, *where;

    Saved saved(int64_t k, const Work &w) const { return {t_saved, rows + (kept ? k * n_rows * w.m : 0), n_rows}; }
};

template <class Visit>
void fields(Members &m, Visit &visit) {
    const Sizes &is = visit.sizes;
    visit.states("starts", m.starts, Bound{m.count}, is.n);
    visit("params", m.params, m.count, is.params);
    visit("first_steps", m.first_steps, m.count);
    visit("events", m.events, m.count, is.events);
    visit("evaluations", m.evaluations);
    visit("sigma", m.sigma, is.m);
    visit("left", m.left, is.events);
    visit("kept", m.kept);
    visit.states("rows", m.rows, m.kept ? m.count : 1, is.rows, is.n);
    visit.states("y", m.y, m.count, is.n);
    visit("t", m.t, m.count);
    visit("status", m.status, m.count);
    visit("max_residual", m.max_residual, m.count, is.l);
    visit("counters", m.counters, m.count, N_COUNTERS);
    visit("max_correction", m.max_correction, m.count);
    visit("figures", m.figures, m.count, is.l, N_FIGURES);
    visit("suspects", m.suspects, m.count, N_SUSPECT + 2 * is.m);
    visit("where", m.where, 2);
    m.n_rows = is.rows;
}

// Resets one member or eight: nothing is recorded or counted except the evaluations at the start.
template <class W>
inline void clear_notes(const Members &members, const Options &o, const W &w) {
    fill(w.memory, 0.0, MEMORIES * o.blocks.count);
    fill(w.err_sum, 0.0, w.m);
    fill(w.max_residual, 0.0, w.l);
    w.max_correction[0] = 0.0;
    std::fill_n(w.counters, static_cast<int64_t>(N_COUNTERS), 0);
    w.counters[NFEV] = members.evaluations;
    fill(w.trust, 0.0, w.l * N_FIGURES);
    for (int64_t i = 0; i < w.l; ++i) w.figures(i)[TERMS] = ENDLESS;
}

// Computes targets and gradients at the start y, where the first row of K holds f. Returns whether all of them are
// finite.
template <class System, class W, class Value>
inline Truth<Value> evaluate_start(System &system, const W &w, double t0, const Value *y) {
    system.inv(w, t0, y, w.target);
    copy(w.target, w.values, w.l);
    system.grad(w, t0, y, w.row(0), w.G);
    Truth<Value> finite = all_finite(y, w.m);
    for (const auto &[values, count] : {std::pair(w.row(0), w.m), {w.target, w.l}, {w.G, w.l * w.m}})
        finite = finite & all_finite(values, count);
    return finite;
}

// Sets everything as at the start of a run. Returns false if some value at the start is not finite; the caller then has
// to explain that.
inline bool begin_member(const Run &run, Samples *samples, const Schedule &s, const Members &members, double *y) {
    const auto &w = run.work;
    const Options &o = run.options;
    System &system = run.system;
    const int64_t k = members.where[0];
    const double t0 = s.span.t0;
    copy(members.params + k * system.n_params, system.params, system.n_params);
    copy(members.starts + k * w.m, y, w.m);
    copy(members.sigma, w.sigma, w.m);
    clear_notes(members, o, w);
    fill(w.carry, 0.0, w.m);
    fill(w.residual, 0.0, w.l);
    w.suspect[REASON] = NOTHING;
    std::fill_n(s.place, 3, 0);
    if (run.method.multistep) forget_history(*run.method.multistep, w.l);
    s.clock[TIME] = s.clock[TIME_NEW] = t0;
    s.clock[NEXT_LENGTH] = members.first_steps[k];
    if (std::isnan(members.first_steps[k])) return false;
    system.rhs(w, t0, y, w.row(0));
    if (!evaluate_start(system, w, t0, y)) return false;
    if (o.columns.count > 0) keep_products(o.columns, w, y);
    if (o.watched) start_figures(y, w.row(0), members.first_steps[k], run.method, run.hooks, o, w);
    copy(members.events + k * s.n_events, s.g, s.n_events);
    fill(s.rate, NOT_A_NUMBER, s.n_events);
    if (samples) {
        *samples->roots.count = 0;
        copy(members.left, samples->roots.left, s.n_events);
    }
    if (s.n_eval > 0 && s.t_eval[0] != t0) return true;
    const Saved saved = members.saved(k, w);
    saved.t[0] = t0;
    copy(y, saved.y, w.m);
    s.place[ROW] = 1;
    return true;
}

// After an event: its time and state are the member's last ones, and no row lies beyond it.
inline void end_by_event(const Roots &roots, const Schedule &s, const Members &members, const Work &w) {
    const int64_t k = members.where[0], root = *roots.count - 1;
    const double t = roots.t[root], *y = roots.y + root * w.m;
    const Saved saved = members.saved(k, w);
    int64_t row = s.place[ROW];
    if (s.n_eval == 0) {
        while (row > 0 && s.span.sign * (saved.t[row - 1] - t) > 0.0) --row;
        if (row > 0 && saved.t[row - 1] == t) copy(y, saved.y + (row - 1) * w.m, w.m);
    }
    if (members.kept) fill(saved.y + row * w.m, NOT_A_NUMBER, (saved.rows - row) * w.m);
    members.status[k] = 1;
    members.t[k] = t;
    copy(y, members.y + k * w.m, w.m);
}

inline void end_member(const Run &run, Samples *samples, const Schedule &s, const Members &members, const double *y,
                       Code code) {
    const auto &w = run.work;
    const int64_t k = members.where[0];
    if (code == ENDED) {
        end_by_event(samples->roots, s, members, w);
    } else {
        members.status[k] = 0;
        members.t[k] = s.span.t_bound;
        copy(y, members.y + k * w.m, w.m);
    }
    copy(w.max_residual, members.max_residual + k * w.l, w.l);
    copy(w.trust, members.figures + k * w.l * N_FIGURES, w.l * N_FIGURES);
    copy(w.suspect, members.suspects + k * w.suspect_size(), w.suspect_size());
    std::copy_n(w.counters, static_cast<int64_t>(N_COUNTERS), members.counters + k * N_COUNTERS);
    members.max_correction[k] = w.max_correction[0];
}

// Runs members from where[0] on, up to the given number of steps. OK: all have ended, or more calls are needed; else what has
// happened to the current member: a code of the step, DOUBTFUL for a start that is not finite, PAUSE as by `advance`.
template <class AnyRun>
inline Code sweep(const AnyRun &run, Samples *samples, const Schedule &s, const Members &members, int64_t steps,
                  double *y, double *y_new) {
    int64_t &k = members.where[0], &begun = members.where[1];
    for (; k < members.count; ++k, begun = 0) {
        if (!begun && !begin_member(of_any_length(run), samples, s, members, y)) return DOUBTFUL;
        begun = 1;
        const int64_t before = s.place[STEP];
        const int64_t k_end = last_of(run.method, s.span, before, steps);
        const Code code = advance(run, samples, s, k_end, y, y_new, members.saved(k, run.work));
        steps = std::max<int64_t>(0, steps - (s.place[STEP] - before));
        if (code == OK && s.clock[TIME] != s.span.t_bound) return OK;
        if (code != OK && code != ENDED) return code;
        end_member(of_any_length(run), samples, s, members, y, code);
        if (s.n_events > 0) {  // whose roots the caller takes before those of the next member
            ++k;
            begun = 0;
            return OK;
        }
    }
    return OK;
}

}  // namespace eip
