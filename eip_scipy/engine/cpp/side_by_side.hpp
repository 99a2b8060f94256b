// Vectorised members of an ensemble, in batches of eight, for members with the same fixed steps.
//
// What is added and multiplied component by component (stages, error estimates) runs over 8 n floats as over one long
// state, by the code of a single run; the projection is also that of the single run, on vectors. So each member agrees bit by bit with
// a run of its own. What only some members need has no place there: where gradients are nearly parallel, the member's
// Newton step is solved by itself; where more is needed (softened weights, a second try, squares that overflow, figures
// that stand out), the member makes that step on the buffers of the single run.
#pragma once

#include "members.hpp"
#include "project_octet.hpp"

namespace eip {

// Counts of one member, if all members have counted `shared`.
inline void count_of(const Eight &eight, int64_t lane, const int64_t *shared, int64_t *out) {
    for (int c = 0; c < N_COUNTERS; ++c) out[c] = shared[c] + eight.own[lane][c];
    const auto projections = static_cast<int64_t>(eight.at(eight.projections, lane));
    out[PROJECTIONS] += projections;
    out[NLU] += projections;
    out[SKIPPED] += static_cast<int64_t>(eight.at(eight.skips, lane));
    out[RANK_REDUCED] += static_cast<int64_t>(eight.at(eight.reduced, lane));
    out[LAST_RANK] = eight.rank[lane];
}

inline Mask alive_of(const Eight &eight) {
    double lanes[LANES];
    for (int64_t lane = 0; lane < LANES; ++lane) lanes[lane] = eight.alive[lane];
    return Octet::load(lanes) > 0.0;
}

// The parameters of one member, for the functions of the single run.
inline void take_params(const Eight &eight, int64_t lane, System &system) {
    eight.take(eight.system.params.data(), lane, system.params, system.n_params);
}

// Copies the inputs and outputs of the projections of one member to the buffers of the single run.
inline void take_member(const Run &run, Eight &eight, int64_t lane) {
    const auto &w = run.work;
    const WorkOf<Octet> &eights = eight.work;
    eight.take(eights.err_sum, lane, w.err_sum, w.m);
    eight.take(eights.sigma, lane, w.sigma, w.m);
    eight.take(eights.target, lane, w.target, w.l);
    eight.take(eights.trust, lane, w.trust, w.l * N_FIGURES);
    eight.take(eights.max_residual, lane, w.max_residual, w.l);
    eight.take(eights.memory, lane, w.memory, MEMORIES * run.options.blocks.count);
    copy(eight.suspect(lane), w.suspect, w.suspect_size());
    w.max_correction[0] = eight.at(eights.max_correction, lane);
    take_params(eight, lane, run.system);
}

// The step of one member on the buffers of the single run, up to its new state; false where it fails. `shared`: what all
// had counted before the step.
[[gnu::noinline]] inline bool step_alone(const Run &run, Eight &eight, int64_t lane, const Schedule &s,
                                         const int64_t *shared, double *y, double *y_new) {
    const auto &w = run.work;
    const WorkOf<Octet> &eights = eight.work;
    take_member(run, eight, lane);
    eight.take(eight.y, lane, y, w.m);
    eight.take(eights.K, lane, w.K, w.m);
    count_of(eight, lane, shared, w.counters);
    s.clock[NEXT_LENGTH] = std::abs(s.span.h);
    try {
        if (next_step(run, s.span, s.clock, eight.step, y, y_new) != OK) return false;
    } catch (const Broken &) {
        return false;
    }
    eight.give(y_new, lane, eight.y_new, w.m);
    eight.give(w.sigma, lane, eights.sigma, w.m);
    eight.give(w.memory, lane, eights.memory, MEMORIES * run.options.blocks.count);
    eight.give(w.trust, lane, eights.trust, w.l * N_FIGURES);
    eight.give(w.max_residual, lane, eights.max_residual, w.l);
    copy(w.suspect, eight.suspect(lane), w.suspect_size());
    eight.at(eights.max_correction, lane) = w.max_correction[0];
    for (Octet *counts : {eight.projections, eight.skips, eight.reduced}) eight.at(counts, lane) = 0.0;
    std::copy_n(w.counters, static_cast<int64_t>(N_COUNTERS), eight.own[lane]);
    eight.rank[lane] = w.counters[LAST_RANK];
    return true;
}

// For a multistep method: copies the data for the projections of one member to the buffers of the single run.
inline void take_history(const Run &run, Eight &eight, int64_t lane) {
    const auto &w = run.work;
    const Multistep &one = *run.method.multistep, &all = eight.multistep;
    take_member(run, eight, lane);
    const int64_t rows = std::min(all.order, all.place[NEWEST_ROW]) + 1;
    std::copy_n(all.place, static_cast<int64_t>(N_NODE_PLACES), one.place);
    one.place[NEWEST_ROW] = rows - 1;
    one.place[SINCE] -= eight.projected[lane];
    const Octet *oldest = OctetSystem::octets_of(newest(all)) - (rows - 1) * one.half;
    for (int64_t j = 0; j < rows; ++j) eight.take(oldest + j * one.half, lane, one.nodes + j * one.pitch, one.half);
    for (int64_t j = 0; j < 4; ++j) eight.take(eight.sums + j * one.half, lane, one.sums + j * one.pitch, one.half);
    eight.take(eight.levels, lane, one.levels, 3 * w.l);
    std::copy_n(eight.own[lane], static_cast<int64_t>(N_COUNTERS), w.counters);
    w.counters[LAST_RANK] = eight.rank[lane];
}

// For a multistep method: copies back what the projection of one member may have changed.
inline void give_history(const Run &run, Eight &eight, int64_t lane) {
    const auto &w = run.work;
    const WorkOf<Octet> &eights = eight.work;
    const Multistep &one = *run.method.multistep;
    eight.give(one.levels, lane, eight.levels, 3 * w.l);
    eight.give(w.err_sum, lane, eights.err_sum, w.m);
    std::copy_n(w.counters, static_cast<int64_t>(N_COUNTERS), eight.own[lane]);
    eight.rank[lane] = w.counters[LAST_RANK];
    eight.give(w.trust, lane, eights.trust, w.l * N_FIGURES);
    copy(w.suspect, eight.suspect(lane), w.suspect_size());
    if (one.place[SINCE] > 0) return;
    eight.projected[lane] = eight.multistep.place[SINCE];
    for (int64_t j = 0; j < 4; ++j) eight.give(one.sums + j * one.pitch, lane, eight.sums + j * one.half, one.half);
    eight.give(w.sigma, lane, eights.sigma, w.m);
    eight.give(w.memory, lane, eights.memory, MEMORIES * run.options.blocks.count);
    eight.give(w.max_residual, lane, eights.max_residual, w.l);
    eight.at(eights.max_correction, lane) = w.max_correction[0];
}

// Does for eight members what OneState does for one: nodes are added to eight histories at once, and projected. What is
// rare is done for one member after the other.
struct EightStates {
    const Eight::Run &run;
    const Run &single;
    Eight &eight;
    double *y_new;

    void begin(const double *) const { find_levels(eight.system, eight.multistep, eight.work, eight.y); }
    Code look() const {
        keep(alive_of(eight) & look_at_nodes(eight.multistep, eight.options, eight.work));
        return OK;
    }
    Code project() const {
        Mask alive = alive_of(eight);
        const Mask alone = project_octet_nodes(eight, alive, single.work);
        keep(alive);
        if (!any(alone)) return OK;
        each(alone, [&](int64_t lane) {  // from the beginning: what has been counted and gathered is taken back
            eight.take(eight.work.err_low, lane, single.work.err_sum, single.work.m);
            --single.work.counters[NJEV];
            return project_nodes(single, y_new);
        });
        return OK;
    }
    Code finish(const Step &step) const {
        const auto &w = single.work;
        each(alive_of(eight), [&](int64_t lane) {
            const Step own{step.t, step.t_new, step.h, nullptr, y_new, step.project, step.last};
            const Code code = finish_nodes(single, own);
            if (step.last) single.method.multistep->place[SINCE] = 0;  // the last state is projected
            eight.give(y_new, lane, eight.y_new, w.m);
            eight.give(w.last(), lane, eight.work.last(), w.m);
            return code;
        });
        return OK;
    }

  private:
    void keep(const Mask &those) const {
        for (int64_t lane = 0; lane < LANES; ++lane) eight.alive[lane] = those.lane(lane);
    }

    // Calls `action` for each member in `those`. A member for which it fails must be run alone.
    template <typename Action>
    void each(const Mask &those, Action action) const {
        for (int64_t lane = 0; lane < LANES; ++lane) {
            if (!those.lane(lane)) continue;
            take_history(single, eight, lane);
            try {
                eight.alive[lane] = action(lane) == OK;
            } catch (const Broken &) {
                eight.alive[lane] = false;
            }
            if (eight.alive[lane]) give_history(single, eight, lane);
        }
    }
};

// True if a time of t_eval lies in the step that ends at t_new.
inline bool is_due(const Schedule &s, int64_t row, double t_new) {
    return row < s.n_eval && s.span.sign * (s.t_eval[row] - t_new) <= 0.0;
}

// Copies what handing out states of one member takes onto the buffers of the single run.
inline void take_shown(const Run &run, Eight &eight, int64_t lane) {
    const auto &w = run.work;
    eight.take(eight.work.sigma, lane, w.sigma, w.m);
    eight.take(eight.work.target, lane, w.target, w.l);
    take_params(eight, lane, run.system);
    w.counters[NFEV] = 0;
}

// States at the times of t_eval within the step just made, member by member as in a single run.
[[gnu::noinline]] inline void sample_octet(const Run &run, Samples &samples, Eight &eight, const Schedule &s,
                                           const Members &members, const Step &step, double *y, double *y_new) {
    const auto &w = run.work;
    const WorkOf<Octet> &eights = eight.work;
    const int64_t row = eight.row;
    s.clock[TIME] = step.t;
    s.clock[TIME_NEW] = step.t_new;
    for (int64_t lane = 0; lane < LANES; ++lane) {
        if (!eight.alive[lane]) continue;
        if (run.method.multistep) take_history(run, eight, lane);
        eight.take(eights.K, lane, w.K, (w.stages + 1) * w.m);
        take_shown(run, eight, lane);
        eight.take(eight.y, lane, y, w.m);
        eight.take(eight.y_new, lane, y_new, w.m);
        s.place[ROW] = row;
        const Saved saved = members.saved(members.where[0] + lane, w);
        try {
            if (wants_samples(run, &samples, s, y_new, saved)) sample(run, samples, s, y, y_new, saved);
        } catch (const Broken &) {
            eight.alive[lane] = false;
        }
        eight.own[lane][NFEV] += w.counters[NFEV];
    }
    while (is_due(s, eight.row, step.t_new)) ++eight.row;
}

// Makes the next step of all eight members, and returns the number of steps made so far.
inline int64_t step_octet(const Run &run, Samples *samples, Eight &eight, const Schedule &s, const Members &members,
                          double *y, double *y_new) {
    const Span &span = s.span;
    const Options &o = eight.options;
    WorkOf<Octet> &w = eight.work;
    const int64_t k = eight.step;
    const double t = span.t0 + k * span.h;
    const bool last = k + 1 >= span.n_steps;
    const double t_new = last ? span.t_bound : span.t0 + (k + 1) * span.h;
    const bool project = w.l > 0 && (last || (k + 1) % o.every == 0);
    double *from = OctetSystem::floats_of(eight.y), *to = OctetSystem::floats_of(eight.y_new);
    const Step step{t, t_new, span.between(k, k + 1), from, to, project, last};
    int64_t before[N_COUNTERS];
    std::copy_n(w.counters, static_cast<int64_t>(N_COUNTERS), before);
    Eight::Run all = eight.run();
    const bool stay_together = make_stages(all, step) == OK;
    const bool sampled = look_back(all, step);
    Mask alive = stay_together ? alive_of(eight) : Mask{}, leave, rough{};
    if (sampled) [[unlikely]]
        rough = alive & is_rough(largest_error_share(step.h, eight.y, o, w), w.figures(0));
    alive = alive & !rough;
    if (project) {
        leave = w.m == 4 && w.l == 2 ? project_octet(eight, eight.short_work, step, alive, run.work)
                                     : project_octet(eight, w, step, alive, run.work);
    } else {
        copy(w.y_hat, eight.y_new, w.m);
        leave = alive & !all_finite(w.y_hat, w.m);
    }
    bool returned[LANES] = {};
    leave = stay_together ? leave | rough : alive_of(eight);
    if (any(leave))
        for (int64_t lane = 0; lane < LANES; ++lane)
            if (leave.lane(lane))
                eight.alive[lane] = returned[lane] = step_alone(run, eight, lane, s, before, y, y_new);
    close_step(all, step, OK);
    note_waiting(samples, 0, run.method, before[WAITED], k > 0);
    note_waiting(samples, 1, run.method, w.counters[WAITED], !last);
    for (int64_t lane = 0; any(leave) && lane < LANES; ++lane)
        for (int c = 0; returned[lane] && c < N_COUNTERS; ++c) eight.own[lane][c] -= w.counters[c];
    if (is_due(s, eight.row, t_new)) sample_octet(run, *samples, eight, s, members, step, y, y_new);
    copy(w.last(), w.row(0), w.m);
    std::swap(eight.y, eight.y_new);
    return k + 1;
}

// The next states of all eight by a multistep method, at most `steps` further; the step that they belong to.
[[gnu::noinline]] inline int64_t next_octet_states(const Run &run, Samples *samples, Eight &eight, const Schedule &s,
                                                   const Members &members, int64_t steps, double *y, double *y_new) {
    s.place[ROW] = eight.row;
    const int64_t k = eight.step, stop = next_stop(run.method, samples, s, k, last_of(run.method, s.span, k, steps));
    double *from = OctetSystem::floats_of(eight.y), *to = OctetSystem::floats_of(eight.y_new);
    const Eight::Run all = eight.run();
    next_states(EightStates{all, run, eight, y_new}, s.span, s.clock, k, stop, from, to);
    const Step step{s.clock[TIME], s.clock[TIME_NEW], s.clock[LENGTH], from, to, false, false};
    note_waiting(samples, 0, run.method, 0, k > 0);
    note_waiting(samples, 1, run.method, 0, step.t_new != s.span.t_bound);
    if (is_due(s, eight.row, step.t_new)) sample_octet(run, *samples, eight, s, members, step, y, y_new);
    copy(eight.work.last(), eight.work.row(0), eight.work.m);
    std::swap(eight.y, eight.y_new);
    return stop;
}

// Eight members, the last one repeated where there are fewer, as at the start of a run.
inline void begin_octet(const Run &run, Eight &eight, const Schedule &s, const Members &members) {
    const int64_t first = members.where[0], n = eight.work.n, p = run.system.n_params;
    WorkOf<Octet> &w = eight.work;
    const double t0 = s.span.t0;
    eight.first = first;
    eight.count = members.count;
    eight.step = eight.row = 0;
    for (int64_t lane = 0; lane < LANES; ++lane) {
        const int64_t k = std::min(first + lane, members.count - 1);
        eight.give(members.starts + k * n, lane, eight.y, n);
        eight.give(members.params + k * p, lane, eight.system.params.data(), p);
        eight.give(members.sigma, lane, w.sigma, n);
    }
    copy(members.sigma, run.work.sigma, n);
    clear_notes(members, eight.options, w);
    for (Octet *one : {eight.projections, eight.skips, eight.reduced}) *one = 0.0;
    std::fill_n(&eight.own[0][0], LANES * N_COUNTERS, 0);
    std::fill(eight.suspects.begin(), eight.suspects.end(), 0.0);
    std::fill_n(eight.rank, LANES, 0);
    std::fill_n(eight.projected, LANES, 0);
    if (eight.method.multistep) forget_history(eight.multistep, LANES * w.l);
    eight.system.rhs(eight.flat, t0, OctetSystem::floats_of(eight.y), OctetSystem::floats_of(w.row(0)));
    const Mask sound = evaluate_start(eight.system, w, t0, eight.y);
    if (eight.options.watched)
        start_figures<Octet>(eight.y, w.row(0), members.first_steps[first], eight.method, nullptr, eight.options, w);
    for (int64_t lane = 0; lane < LANES; ++lane) eight.alive[lane] = first + lane < members.count && sound.lane(lane);
}

// States of all members at t as their next row.
inline void save_octet(const Run &run, const Samples *samples, Eight &eight, double t, const Members &members,
                       double *y) {
    const int64_t n = eight.work.n, row = eight.row++;
    for (int64_t lane = 0; members.kept && lane < LANES && members.where[0] + lane < members.count; ++lane) {
        double *out = members.rows + ((members.where[0] + lane) * members.n_rows + row) * n;
        eight.take(eight.y, lane, out, n);
        if (!samples || !samples->dense.shows || !samples->dense.waiting[1] || !eight.alive[lane]) continue;
        take_shown(run, eight, lane);
        copy(out, y, n);
        try {
            give(run, samples, 1, t, y, out);
        } catch (const Broken &) {
            eight.alive[lane] = false;
        }
        eight.own[lane][NFEV] += run.work.counters[NFEV];
    }
}

// Results of those members that came to their ends.
inline void end_octet(const Eight &eight, const Schedule &s, const Members &members) {
    const WorkOf<Octet> &w = eight.work;
    for (int64_t lane = 0; lane < LANES; ++lane) {
        if (!eight.alive[lane]) continue;
        const int64_t k = members.where[0] + lane;
        members.status[k] = 0;
        members.t[k] = s.span.t_bound;
        members.max_correction[k] = eight.at(w.max_correction, lane);
        eight.take(eight.y, lane, members.y + k * w.n, w.n);
        eight.take(w.max_residual, lane, members.max_residual + k * w.l, w.l);
        eight.take(w.trust, lane, members.figures + k * w.l * N_FIGURES, w.l * N_FIGURES);
        copy(eight.suspect(lane), members.suspects + k * w.suspect_size(), w.suspect_size());
        count_of(eight, lane, w.counters, members.counters + k * N_COUNTERS);
    }
}

// Runs batches of members from where[0] on, up to the given number of steps. Returns OK if no member is left or if more
// calls are needed. A member whose status is not set afterwards must be run alone.
Code sweep_octets(const Run &run, Eight &eight, Samples *samples, const Schedule &s, const Members &members,
                  int64_t steps, double *y, double *y_new) {
    int64_t &first = members.where[0], &begun = members.where[1];
    for (; first < members.count; first += LANES, begun = 0) {
        try {
            if (!begun || eight.first != first || eight.count != members.count) {
                begin_octet(run, eight, s, members);
                if (s.n_eval == 0 || s.t_eval[0] == s.span.t0) save_octet(run, nullptr, eight, s.span.t0, members, y);
                begun = 1;
            }
            while (eight.step < s.span.n_steps && any(alive_of(eight))) {
                if (steps <= 0) return OK;
                const int64_t made = eight.method.multistep
                                         ? next_octet_states(run, samples, eight, s, members, steps, y, y_new)
                                         : step_octet(run, samples, eight, s, members, y, y_new);
                steps -= made - eight.step;
                eight.step = made;
                const bool due = made == s.span.n_steps || (s.save_every > 0 && made % s.save_every == 0);
                const double t =
                    made == s.span.n_steps ? s.span.t_bound : s.span.t0 + static_cast<double>(made) * s.span.h;
                if (s.n_eval == 0 && due) save_octet(run, samples, eight, t, members, y);
            }
            end_octet(eight, s, members);
        } catch (const GaveUp &) {
            eight.first = -1;
        }
    }
    return OK;
}

}  // namespace eip
