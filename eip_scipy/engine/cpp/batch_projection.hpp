// The projection of eight members: that of a single run on vectors, except for steps that only some of them need.
#pragma once

#include "correction.hpp"
#include "batch.hpp"

namespace eip {

// The Newton step of one member, whose gradients are nearly parallel or vanish, by pivoted QR.
[[gnu::noinline]] inline void solve_alone(Batch &batch, int64_t lane, const Lanes8 *f, const Options &o,
                                          const Work &w) {
    const WorkOf<Lanes8> &all = batch.work;
    batch.take(all.sigma, lane, w.sigma, w.m);
    batch.take(all.y_hat, lane, w.y_hat, w.m);
    batch.take(all.G, lane, w.G, w.l * w.m);
    batch.take(all.before, lane, w.before, w.l);
    batch.take(all.band, lane, w.band, w.l);
    weigh_rows(o.frame, w, w.Q);
    if (f) {
        batch.take(all.inverse, lane, w.inverse, o.blocks.count);
        batch.take(all.memory_new, lane, w.memory_new, MEMORIES * o.blocks.count);
        batch.take(f, lane, w.f_point, w.m);
    }
    const int64_t rank = factored_move(o, w, f ? w.f_point : nullptr, w.stage);
    batch.own[lane][LAST_RANK] = std::max<int64_t>(rank, 0);
    for (double *out : {w.move, w.stage})
        if (rank < 0) fill(out, NOT_A_NUMBER, w.m);
    batch.give(w.move, lane, all.move, w.m);
    batch.give(w.stage, lane, batch.y_new, w.m);
}

// Does for the members in `done` what `note` does for one; returns those with more to record, unchanged.
template <class W>
inline Mask note_batch(double t, const Mask &done, const Options &o, const W &w) {
    const double waited = static_cast<double>(w.counters[WAITED]), many = std::sqrt(1.0 + waited);
    const double rounding = waited > 0 ? EPS * many : EPS;
    const double errors = !w.counters[HAVE_ERROR] ? 0.0
                          : waited == 0           ? 1.0
                          : o.metric == BY_ERROR  ? many
                                                  : 1.0 + waited;
    const auto expected_of = [&](int64_t i) {
        return errors * w.worth[i] + rounding * (o.per_band * w.band[i]) + TINY;
    };
    Mask more{};
    for (int64_t i = 0; i < w.l; ++i) {
        const Lanes8 *figures = w.figures(i);
        const Lanes8 own = own_terms(i, o, w);
        more = more | (abs(w.before[i]) > o.distant * own) | (abs(w.residual[i]) > LARGE_SHARE * own);
        if (errors > 0.0)
            more = more | ((w.worth[i] > 0.0) & (abs(w.before[i] - figures[LEFT]) > LARGE * expected_of(i)));
    }
    more = more & done;
    const Mask noted = done & !more;
    for (int64_t i = 0; i < w.l; ++i) {
        Lanes8 *figures = w.figures(i);
        const auto set = [&](Figure figure, const Mask &those, const Lanes8 &value) {
            figures[figure] = where(those, value, figures[figure]);
        };
        set(NOTED, noted, figures[NOTED] + 1.0);
        set(TERMS, noted, max(where(figures[TERMS] < ENDLESS, figures[TERMS], 0.0), o.per_band * w.band[i]));
        if (errors > 0.0) {
            const Lanes8 size = abs(w.before[i] - figures[LEFT]), expected = expected_of(i);
            const Mask judged = noted & (w.worth[i] > 0.0);
            set(JUDGED, judged, figures[JUDGED] + 1.0);
            set(SUM, judged, figures[SUM] + size);
            set(EXPECTED, judged, figures[EXPECTED] + expected);
            const Mask record = judged & (size > figures[NU] * expected);
            if (any(record)) {
                set(NU, record, size / expected);
                set(AT, record, t);
            }
        }
        set(LEFT, noted, w.residual[i]);
    }
    return more;
}

// Second part of a projection of eight members, when the gradients at w.y_hat and the values of the invariants are
// known. The step begins at y, and the result is written to eight.y_new. Returns the members of `alive` that must be
// projected alone.
template <class W>
[[gnu::flatten]] inline Mask project_batch_evaluated(Batch &batch, const W &w, const Step &step, const Lanes8 *y,
                                                     const Mask &alive, const Work &single) {
    const Options &o = batch.options;
    const Mask outside = residuals<Lanes8>(nullptr, w.y_hat, o, w, w.before);
    const Mask moved = outside & alive;
    const bool all_move = moved.all();
    const RunOf<W, BatchFunctions> run{batch.method, o, w, batch.system, nullptr};
    const int64_t blocks = o.blocks.count;
    Mask leave{};
    Lanes8 largest_error = 0.0;
    if (o.metric == BY_ERROR) {
        if (!all_move) copy(w.sigma, w.stage, w.m);
        leave = block_sizes<Lanes8>(y, o.compensated ? 0.0 : EPS, o, w);
        largest_error = remembered_errors<Lanes8>(memory_kept(run), o, w);
        weights_from_errors(y, o, w);
        for (int64_t j = 0; !all_move && j < w.m; ++j) w.sigma[j] = where(moved, w.sigma[j], w.stage[j]);
    }
    Lanes8 *rows = weighed_gradients(o, w);
    const Mask dependent = moved & !solve_gram(rows_of(rows, w), w.g, corner(w.R, w.l, w), w.mu);
    move_along(o, w, rows, batch.y_new);
    const Lanes8 *f = flow_at_raw(run, step);
    if (f) remove_shift(o, w, f, -1, batch.y_new);
    for (int64_t lane = 0; lane < LANES; ++lane)
        if (all_move || moved.lane(lane)) batch.own[lane][LAST_RANK] = w.l;
    if (any(dependent))
        for (int64_t lane = 0; lane < LANES; ++lane)
            if (dependent.lane(lane)) solve_alone(batch, lane, f, o, single);
    const Lanes8 correction = correction_in_local_errors(largest_error, o, w);
    if (o.compensated) {
        for (int64_t j = 0; j < w.m; ++j) w.move[j] = where(outside, w.move[j], 0.0);
        copy(w.y_hat, batch.y_new, w.m);
        compensated_add(as_floats(batch.y_new), as_floats(w.carry_hat), as_floats(w.move), LANES * w.m);
    }
    for (int64_t j = 0; !all_move && j < w.m; ++j) batch.y_new[j] = where(outside, batch.y_new[j], w.y_hat[j]);
    evaluate_invariants(run, step.t_new, batch.y_new);
    const Mask held = residuals_held<Lanes8>(w.before, o, w) & small_shares(o, w) & all_finite(batch.y_new, w.m);
    if (o.has_limits) leave = leave | (missed_targets(o, w) > 1.0);
    Mask done = alive & held & !leave;
    if (o.watched) done = done & !note_batch(step.t_new, done, o, w);
    for (int64_t i = 0; i < w.l; ++i)
        w.max_residual[i] = where(done, max(w.max_residual[i], abs(w.residual[i])), w.max_residual[i]);
    for (int64_t b = 0; o.metric == BY_ERROR && b < MEMORIES * blocks; ++b)
        w.memory[b] = where(done, w.memory_new[b], w.memory[b]);
    batch.corrected = done & outside;
    *w.max_correction = where(batch.corrected, max(*w.max_correction, correction), *w.max_correction);
    const unsigned finished = done.bits(), changed = batch.corrected.bits();
    for (int64_t lane = 0; lane < LANES; ++lane) {
        int64_t *own = batch.own[lane];
        const unsigned moves = changed >> lane & 1U;
        own[PROJECTIONS] += moves;
        own[NLU] += moves;
        own[SKIPPED] += (finished >> lane & 1U) - moves;
        own[RANK_REDUCED] += moves && own[LAST_RANK] < w.l;
    }
    return alive & !done;
}

// Projects eight members as `project_step` projects one. W is the work of all eight, or the same with a length that the
// compiler knows.
template <class W>
inline Mask project_batch(Batch &batch, const W &w, const Step &step, const Mask &alive, const Work &single) {
    const Options &o = batch.options;
    batch.system.grad(w, step.t_new, w.y_hat, w.last(), w.G);
    ++w.counters[NJEV];
    if (o.every != 1 && o.metric == BY_ERROR)
        quadrature(batch.flat.err, batch.flat.err_sum, batch.flat.err, batch.flat.m);
    const Mask noticed = o.watched && w.counters[F_AT_RAW] ? alive & rates_stand_out(w, LEAST_RATE) : Mask{};
    batch.system.inv(w, step.t_new, w.y_hat, w.values);
    return noticed | project_batch_evaluated(batch, w, step, batch.y, alive & !noticed, single);
}

// Projects eight members of a multistep method as `project_nodes` projects one. Members whose steps are not stable are
// removed. Returns the members that must be projected alone; the errors gathered for them before are in w.err_low.
inline Mask project_batch_nodes(Batch &batch, const Work &single) {
    const Options &o = batch.options;
    const WorkOf<Lanes8> &w = batch.work;
    const Multistep &ms = batch.multistep;
    const RunOf<WorkOf<Lanes8>, BatchFunctions> run{batch.method, o, w, batch.system, nullptr};
    Lanes8 size;
    copy(w.err_sum, w.err_low, w.m);
    const Mask alive = batch.alive = batch.alive & estimate_nodes(ms, o, size, w);
    if (w.l == 0 || ms.place[SEEN] <= COLLECTED) return Mask{};
    const double t = ms.t0 + static_cast<double>(ms.place[NEWEST]) * ms.h;
    double since[LANES];
    for (int lane = 0; lane < LANES; ++lane) since[lane] = static_cast<double>(ms.place[SINCE] - batch.projected[lane]);
    gather_errors(size, Lanes8::load(since), w);
    newest_state(run, t);
    const Mask noticed = o.watched ? alive & rates_stand_out(w, LEAST_RATE) : Mask{};
    const Mask those = (o.every == AUTO ? alive & tells_more(w) : alive) & !noticed;
    if (!any(those)) return noticed;
    copy(w.target, as_values<Lanes8>(ms.levels), w.l);
    const int64_t counted = w.counters[NJEV];
    residuals_in_the_middle(run, t, batch.y_new);
    w.counters[NJEV] = counted;
    soften_residuals(ms, o, w);
    const Mask leave = project_batch_evaluated(batch, w, Step{t, t, ms.h, nullptr, nullptr, true, true}, w.y_hat, those,
                                               single),
               done = those & !leave;
    note_what_is_left(ms, done, w);
    move_sums(ms, batch.corrected, w);
    for (int lane = 0; lane < LANES; ++lane) {
        if (!done.lane(lane)) continue;
        batch.projected[lane] = ms.place[SINCE];
        ++batch.own[lane][NJEV];
    }
    return leave | noticed;
}

}  // namespace eip
