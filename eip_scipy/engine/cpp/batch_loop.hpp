// Vectorised members of an ensemble, in batches of eight, for members with the same fixed steps.
//
// What is added and multiplied component by component (stages, error estimates) runs over 8 n floats as over one long
// state, by the code of a single run; the projection is also that of the single run, on vectors. So each member agrees bit by bit with
// a run of its own. What only some members need has no place there: where gradients are nearly parallel, the member's
// Newton step is solved by itself; where more is needed (softened weights, a second try, squares that overflow, figures
// that stand out), the member makes that step on the buffers of the single run.
#pragma once

#include "members.hpp"
#include "batch_projection.hpp"

namespace eip {

// The parameters of one member, for the functions of the single run.
inline void take_params(const Batch &batch, int64_t lane, System &system) {
    batch.take(batch.system.params.data(), lane, system.params, system.n_params);
}

// Copies what the projections of one member take to the buffers of the single run.
inline void take_member(const Run &run, const Batch &batch, int64_t lane) {
    const auto &w = run.work;
    batch.each_carried(w, [&](const Lanes8 *all, double *one, int64_t n) { batch.take(all, lane, one, n); });
    batch.take(batch.work.err_sum, lane, w.err_sum, w.m);
    batch.take(batch.work.target, lane, w.target, w.l);
    take_params(batch, lane, run.system);
}

// Copies what they have changed back.
inline void give_member(const Run &run, Batch &batch, int64_t lane) {
    batch.each_carried(run.work, [&](Lanes8 *all, const double *one, int64_t n) { batch.give(one, lane, all, n); });
    std::copy_n(run.work.counters, static_cast<int64_t>(N_COUNTERS), batch.own[lane]);
}

// The step of one member on the buffers of the single run, up to its new state; false where it fails. `shared`: what all
// had counted before the step.
[[gnu::noinline]] inline bool step_alone(const Run &run, Batch &batch, int64_t lane, const Schedule &s,
                                         const int64_t *shared, double *y, double *y_new) {
    const auto &w = run.work;
    take_member(run, batch, lane);
    batch.take(batch.y, lane, y, w.m);
    batch.take(batch.work.K, lane, w.K, w.m);
    batch.count_of(lane, shared, w.counters);
    s.clock[NEXT_LENGTH] = std::abs(s.span.h);
    if (next_step(run, s.span, s.clock, s.place[STEP], y, y_new) != OK) return false;
    batch.give(y_new, lane, batch.y_new, w.m);
    give_member(run, batch, lane);
    return true;
}

// For a multistep method: copies the data for the projections of one member to the buffers of the single run.
inline void take_history(const Run &run, const Batch &batch, int64_t lane) {
    const auto &w = run.work;
    const Multistep &one = *run.method.multistep, &all = batch.multistep;
    take_member(run, batch, lane);
    const int64_t rows = std::min(all.order, all.place[NEWEST_ROW]) + 1;
    std::copy_n(all.place, static_cast<int64_t>(N_NODE_PLACES), one.place);
    one.place[NEWEST_ROW] = rows - 1;
    one.place[SINCE] -= batch.projected[lane];
    const Lanes8 *oldest = BatchFunctions::lanes8_of(newest(all)) - (rows - 1) * one.half;
    for (int64_t j = 0; j < rows; ++j) batch.take(oldest + j * one.half, lane, one.nodes + j * one.pitch, one.half);
    for (int64_t j = 0; j < 4; ++j) batch.take(batch.sums + j * one.half, lane, one.sums + j * one.pitch, one.half);
    batch.take(batch.levels, lane, one.levels, 3 * w.l);
    std::copy_n(batch.own[lane], static_cast<int64_t>(N_COUNTERS), w.counters);
}

// For a multistep method: copies back what the projection of one member may have changed.
inline void give_history(const Run &run, Batch &batch, int64_t lane) {
    const auto &w = run.work;
    const Multistep &one = *run.method.multistep;
    give_member(run, batch, lane);
    batch.give(one.levels, lane, batch.levels, 3 * w.l);
    batch.give(w.err_sum, lane, batch.work.err_sum, w.m);
    for (int64_t j = 0; j < 4; ++j) batch.give(one.sums + j * one.pitch, lane, batch.sums + j * one.half, one.half);
    if (one.place[SINCE] == 0) batch.projected[lane] = batch.multistep.place[SINCE];
}

// Does for eight members what OneState does for one: nodes are added to eight histories at once, and projected. What is
// rare is done for one member after the other.
struct BatchStates {
    const Batch::Run &run;
    const Run &single;
    Batch &batch;
    double *y_new;

    void begin(const double *) const { find_levels(batch.system, batch.multistep, batch.work, batch.y); }
    Code look() const {
        batch.alive = batch.alive & look_at_nodes(batch.multistep, batch.options, batch.work);
        return OK;
    }
    Code project() const {
        const Mask alone = project_batch_nodes(batch, single.work);
        each(alone, [&](int64_t lane) {  // from the beginning: what has been counted and gathered is taken back
            batch.take(batch.work.err_low, lane, single.work.err_sum, single.work.m);
            --single.work.counters[NJEV];
            return project_nodes(single, y_new);
        });
        return OK;
    }
    Code finish(const Step &step) const {
        const auto &w = single.work;
        each(batch.alive, [&](int64_t lane) {
            const Step own{step.t, step.t_new, step.h, nullptr, y_new, step.project, step.last};
            const Code code = finish_nodes(single, own);
            if (step.last) single.method.multistep->place[SINCE] = 0;  // the last state is projected
            batch.give(y_new, lane, batch.y_new, w.m);
            batch.give(w.last(), lane, batch.work.last(), w.m);
            return code;
        });
        return OK;
    }

  private:
    template <typename Action>
    void each(const Mask &those, Action action) const {
        batch.each_alone(those, [&](int64_t lane) {
            take_history(single, batch, lane);
            if (action(lane) != OK) return false;
            give_history(single, batch, lane);
            return true;
        });
    }
};

// True if a time of t_eval lies in the step that ends at t_new.
inline bool is_due(const Schedule &s, int64_t row, double t_new) {
    return row < s.n_eval && s.span.sign * (s.t_eval[row] - t_new) <= 0.0;
}

// Copies what handing out states of one member takes onto the buffers of the single run.
inline void take_shown(const Run &run, Batch &batch, int64_t lane) {
    const auto &w = run.work;
    batch.take(batch.work.sigma, lane, w.sigma, w.m);
    batch.take(batch.work.target, lane, w.target, w.l);
    take_params(batch, lane, run.system);
    w.counters[NFEV] = 0;
}

// States at the times of t_eval within the step just made, member by member as in a single run.
[[gnu::noinline]] inline void sample_batch(const Run &run, Samples &samples, Batch &batch, const Schedule &s,
                                           const Members &members, const Step &step, double *y, double *y_new) {
    const auto &w = run.work;
    const int64_t row = s.place[ROW];
    s.clock[TIME] = step.t;
    s.clock[TIME_NEW] = step.t_new;
    batch.each_alone(batch.alive, [&](int64_t lane) {
        if (run.method.multistep) take_history(run, batch, lane);
        batch.take(batch.work.K, lane, w.K, (w.stages + 1) * w.m);
        take_shown(run, batch, lane);
        batch.take(batch.y, lane, y, w.m);
        batch.take(batch.y_new, lane, y_new, w.m);
        s.place[ROW] = row;
        const Saved saved = members.saved(members.where[0] + lane, w);
        if (wants_samples(run, &samples, s, y_new, saved)) sample(run, samples, s, y, y_new, saved);
        batch.own[lane][NFEV] += w.counters[NFEV];
        return true;
    });
    s.place[ROW] = row;
    while (is_due(s, s.place[ROW], step.t_new)) ++s.place[ROW];
}

// Makes the next step of all eight members, and returns the number of steps made so far.
inline int64_t step_batch(const Run &run, Samples *samples, Batch &batch, const Schedule &s, const Members &members,
                          double *y, double *y_new) {
    const Span &span = s.span;
    const Options &o = batch.options;
    WorkOf<Lanes8> &w = batch.work;
    const int64_t k = s.place[STEP];
    const double t = span.t0 + k * span.h;
    const bool last = k + 1 >= span.n_steps;
    const double t_new = last ? span.t_bound : span.t0 + (k + 1) * span.h;
    const bool project = w.l > 0 && (last || (k + 1) % o.every == 0);
    double *from = BatchFunctions::floats_of(batch.y), *to = BatchFunctions::floats_of(batch.y_new);
    const Step step{t, t_new, span.between(k, k + 1), from, to, project, last};
    int64_t before[N_COUNTERS];
    std::copy_n(w.counters, static_cast<int64_t>(N_COUNTERS), before);
    Batch::Run all = batch.run();
    const bool stay_together = make_stages(all, step) == OK;
    const bool sampled = look_back(all, step);
    Mask alive = stay_together ? batch.alive : Mask{}, leave, rough{};
    if (sampled) [[unlikely]]
        rough = alive & is_rough(largest_error_share(step.h, batch.y, o, w), w.figures(0));
    alive = alive & !rough;
    if (project) {
        leave = w.m == 4 && w.l == 2 ? project_batch(batch, batch.short_work, step, alive, run.work)
                                     : project_batch(batch, w, step, alive, run.work);
    } else {
        copy(w.y_hat, batch.y_new, w.m);
        leave = alive & !all_finite(w.y_hat, w.m);
    }
    leave = stay_together ? leave | rough : batch.alive;
    batch.each_alone(leave, [&](int64_t lane) { return step_alone(run, batch, lane, s, before, y, y_new); });
    close_step(all, step, OK);
    note_waiting(samples, 0, run.method, before[WAITED], k > 0);
    note_waiting(samples, 1, run.method, w.counters[WAITED], !last);
    leave = leave & batch.alive;
    for (int64_t lane = 0; any(leave) && lane < LANES; ++lane)
        for (int c = 0; leave.lane(lane) && c < N_COUNTERS; ++c) batch.own[lane][c] -= w.counters[c];
    if (is_due(s, s.place[ROW], t_new)) sample_batch(run, *samples, batch, s, members, step, y, y_new);
    copy(w.last(), w.row(0), w.m);
    std::swap(batch.y, batch.y_new);
    return k + 1;
}

// The next states of all eight by a multistep method, at most `steps` further; the step that they belong to.
[[gnu::noinline]] inline int64_t next_batch_states(const Run &run, Samples *samples, Batch &batch, const Schedule &s,
                                                   const Members &members, int64_t steps, double *y, double *y_new) {
    const int64_t k = s.place[STEP], stop = next_stop(run.method, samples, s, k, last_of(run.method, s.span, k, steps));
    double *from = BatchFunctions::floats_of(batch.y), *to = BatchFunctions::floats_of(batch.y_new);
    const Batch::Run all = batch.run();
    next_states(BatchStates{all, run, batch, y_new}, s.span, s.clock, k, stop, from, to);
    const Step step{s.clock[TIME], s.clock[TIME_NEW], s.clock[LENGTH], from, to, false, false};
    note_waiting(samples, 0, run.method, 0, k > 0);
    note_waiting(samples, 1, run.method, 0, step.t_new != s.span.t_bound);
    if (is_due(s, s.place[ROW], step.t_new)) sample_batch(run, *samples, batch, s, members, step, y, y_new);
    copy(batch.work.last(), batch.work.row(0), batch.work.m);
    std::swap(batch.y, batch.y_new);
    return stop;
}

// Batch members, the last one repeated where there are fewer, as at the start of a run.
inline void begin_batch(const Run &run, Batch &batch, const Schedule &s, const Members &members) {
    const int64_t first = members.where[0], n = batch.work.n, p = run.system.n_params;
    WorkOf<Lanes8> &w = batch.work;
    const double t0 = s.span.t0;
    batch.first = first;
    batch.count = members.count;
    s.place[STEP] = s.place[ROW] = 0;
    for (int64_t lane = 0; lane < LANES; ++lane) {
        const int64_t k = std::min(first + lane, members.count - 1);
        batch.give(members.starts + k * n, lane, batch.y, n);
        batch.give(members.params + k * p, lane, batch.system.params.data(), p);
        batch.give(members.sigma, lane, w.sigma, n);
    }
    copy(members.sigma, run.work.sigma, n);
    clear_notes(members, batch.options, w);
    std::fill_n(&batch.own[0][0], LANES * N_COUNTERS, 0);
    fill(batch.suspects, 0.0, w.suspect_size());
    std::fill_n(batch.projected, LANES, 0);
    if (batch.method.multistep) forget_history(batch.multistep, LANES * w.l);
    batch.system.rhs(batch.flat, t0, BatchFunctions::floats_of(batch.y), BatchFunctions::floats_of(w.row(0)));
    const Mask sound = evaluate_start(batch.system, w, t0, batch.y);
    if (batch.options.watched)
        start_figures<Lanes8>(batch.y, w.row(0), members.first_steps[first], batch.method, nullptr, batch.options, w);
    for (int64_t lane = 0; lane < LANES; ++lane)
        batch.alive.set(lane, first + lane < members.count && sound.lane(lane));
}

// States of all members at t as their next row.
inline void save_batch(const Run &run, const Samples *samples, Batch &batch, double t, const Schedule &s,
                       const Members &members, double *y) {
    const int64_t n = batch.work.n, row = s.place[ROW];
    const auto row_of = [&](int64_t lane) { return members.saved(members.where[0] + lane, run.work).y + row * n; };
    if (!members.kept) return;
    ++s.place[ROW];
    for (int64_t lane = 0; lane < std::min<int64_t>(LANES, members.count - members.where[0]); ++lane)
        batch.take(batch.y, lane, row_of(lane), n);
    if (!samples || !samples->dense.shows || !samples->dense.waiting[1]) return;
    batch.each_alone(batch.alive, [&](int64_t lane) {
        take_shown(run, batch, lane);
        batch.take(batch.y, lane, y, n);
        give(run, samples, 1, t, y, row_of(lane));
        batch.own[lane][NFEV] += run.work.counters[NFEV];
        return true;
    });
}

// Results of those members that came to their ends.
inline void end_batch(const Run &run, Batch &batch, const Schedule &s, const Members &members, double *y) {
    batch.each_alone(batch.alive, [&](int64_t lane) {
        take_member(run, batch, lane);
        batch.take(batch.y, lane, y, run.work.m);
        batch.count_of(lane, batch.counters, run.work.counters);
        store_member(run.work, members, members.where[0] + lane, 0, s.span.t_bound, y);
        return true;
    });
}

// Runs batches of members from where[0] on, up to the given number of steps. Returns OK if no member is left or if more
// calls are needed. A member whose status is not set afterwards must be run alone.
Code sweep_batches(const Run &run, Batch &batch, Samples *samples, const Schedule &s, const Members &members,
                   int64_t steps, double *y, double *y_new) {
    int64_t &first = members.where[0], &begun = members.where[1];
    for (; first < members.count; first += LANES, begun = 0) {
        try {
            if (!begun || batch.first != first || batch.count != members.count) {
                begin_batch(run, batch, s, members);
                if (s.n_eval == 0 || s.t_eval[0] == s.span.t0)
                    save_batch(run, nullptr, batch, s.span.t0, s, members, y);
                begun = 1;
            }
            while (s.place[STEP] < s.span.n_steps && any(batch.alive)) {
                if (steps <= 0) return OK;
                const int64_t made = batch.method.multistep
                                         ? next_batch_states(run, samples, batch, s, members, steps, y, y_new)
                                         : step_batch(run, samples, batch, s, members, y, y_new);
                steps -= made - s.place[STEP];
                s.place[STEP] = made;
                const bool last = made == s.span.n_steps;
                const double t = last ? s.span.t_bound : s.span.t0 + static_cast<double>(made) * s.span.h;
                if (s.n_eval == 0 && (last || (s.save_every > 0 && made % s.save_every == 0)))
                    save_batch(run, samples, batch, t, s, members, y);
            }
            end_batch(run, batch, s, members, y);
        } catch (const GaveUp &) {
            batch.first = -1;
        }
    }
    return OK;
}

}  // namespace eip
