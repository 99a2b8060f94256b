// Members of an ensemble one after the other, on the buffers of one run.
#pragma once

#include "loop.hpp"

namespace eip {

// All members: `count` starts, parameters, lengths of first steps and values of the events, and the results of each member. `where` holds the
// current member and whether it has begun. Rows are saved for each member, or for none if `kept` is false; their times are the same.
// clang-format off
#define EIP_MEMBERS(FIELD, STATES, PYTHON, DERIVED) \
    STATES(double *, starts, Bound{count}, run.n) FIELD(double *, params, count, run.params) \
    FIELD(double *, first_steps, count) FIELD(double *, events, count, run.events) FIELD(int64_t, evaluations) \
    FIELD(double *, sigma, run.m) FIELD(double *, left, run.events) FIELD(double *, t_saved, Bound{n_rows}) \
    FIELD(bool, kept) STATES(double *, rows, kept ? count : 1, n_rows, run.n) STATES(double *, y, count, run.n) \
    FIELD(double *, t, count) FIELD(int64_t *, status, count) FIELD(double *, max_residual, count, run.l) \
    FIELD(int64_t *, counters, count, N_COUNTERS) FIELD(double *, max_correction, count) \
    FIELD(double *, figures, count, run.l, N_FIGURES) FIELD(double *, suspects, count, N_SUSPECT + 2 * run.m) \
    FIELD(int64_t *, where, 2)
// clang-format on
struct Members {
    int64_t count, n_rows;
    EIP_RECORD(EIP_MEMBERS, "Members")

    Saved saved(int64_t k, const Work &w) const { return {t_saved, rows + (kept ? k * n_rows * w.m : 0), n_rows}; }
};

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
        samples->roots.counts[0] = 0;
        copy(members.left, samples->roots.left, s.n_events);
    }
    if (s.n_eval > 0 && s.t_eval[0] != t0) return true;
    const Saved saved = members.saved(k, w);
    saved.t[0] = t0;
    copy(y, saved.y, w.m);
    s.place[ROW] = 1;
    return true;
}

// After an event: no row lies beyond it.
inline void end_by_event(const Roots &roots, const Schedule &s, const Members &members, const Work &w) {
    const int64_t k = members.where[0], root = roots.counts[0] - 1;
    const double t = roots.t[root], *y = roots.y + root * w.m;
    const Saved saved = members.saved(k, w);
    int64_t row = s.place[ROW];
    if (s.n_eval == 0) {
        while (row > 0 && s.span.sign * (saved.t[row - 1] - t) > 0.0) --row;
        if (row > 0 && saved.t[row - 1] == t) copy(y, saved.y + (row - 1) * w.m, w.m);
    }
    if (members.kept) fill(saved.y + row * w.m, NOT_A_NUMBER, (saved.rows - row) * w.m);
}

// Stores the results of member k, whose buffers are those of `w`.
inline void store_member(const Work &w, const Members &members, int64_t k, int64_t status, double t, const double *y) {
    members.status[k] = status;
    members.t[k] = t;
    members.max_correction[k] = w.max_correction[0];
    copy(y, members.y + k * w.m, w.m);
    copy(w.max_residual, members.max_residual + k * w.l, w.l);
    copy(w.trust, members.figures + k * w.l * N_FIGURES, w.l * N_FIGURES);
    copy(w.suspect, members.suspects + k * w.suspect_size(), w.suspect_size());
    copy(w.counters, members.counters + k * N_COUNTERS, N_COUNTERS);
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
        const double *end = y;
        double t = s.span.t_bound;
        if (code == ENDED) {
            end_by_event(samples->roots, s, members, run.work);
            t = samples->roots.t[samples->roots.counts[0] - 1];
            end = samples->roots.y + (samples->roots.counts[0] - 1) * run.work.m;
        }
        store_member(of_any_length(run).work, members, k, code == ENDED, t, end);
        if (s.n_events > 0) {  // whose roots the caller takes before those of the next member
            ++k;
            begun = 0;
            return OK;
        }
    }
    return OK;
}

}  // namespace eip
