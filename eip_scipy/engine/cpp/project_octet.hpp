// The projection of eight members: that of a single run on vectors, except for steps that only some of them need.
#pragma once

#include "correction.hpp"
#include "eight.hpp"

namespace eip {

// The Newton step of one member, whose gradients are nearly parallel or vanish, by pivoted QR.
[[gnu::noinline]] inline void solve_alone(Eight &eight, int64_t lane, const Octet *f, const Options &o, const Work &w) {
    const WorkOf<Octet> &eights = eight.work;
    eight.take(eights.sigma, lane, w.sigma, w.m);
    eight.take(eights.y_hat, lane, w.y_hat, w.m);
    eight.take(eights.G, lane, w.G, w.l * w.m);
    eight.take(eights.before, lane, w.before, w.l);
    eight.take(eights.band, lane, w.band, w.l);
    weigh_rows(o.frame, w, w.Q);
    if (f) {
        eight.take(eights.inverse, lane, w.inverse, o.blocks.count);
        eight.take(eights.memory_new, lane, w.memory_new, MEMORIES * o.blocks.count);
        eight.take(f, lane, w.f_point, w.m);
    }
    const int64_t rank = factored_move(o, w, f ? w.f_point : nullptr, w.stage);
    eight.own[lane][LAST_RANK] = std::max<int64_t>(rank, 0);
    for (double *out : {w.move, w.stage})
        if (rank < 0) fill(out, NOT_A_NUMBER, w.m);
    eight.give(w.move, lane, eights.move, w.m);
    eight.give(w.stage, lane, eight.y_new, w.m);
}

// Does for the members in `done` what `note` does for one; returns those with more to record, unchanged.
template <class W>
inline Mask note_octet(double t, const Mask &done, const Options &o, const W &w) {
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
        const Octet *figures = w.figures(i);
        const Octet own = own_terms(i, o, w);
        more = more | (abs(w.before[i]) > o.distant * own) | (abs(w.residual[i]) > LARGE_SHARE * own);
        if (errors > 0.0)
            more = more | ((w.worth[i] > 0.0) & (abs(w.before[i] - figures[LEFT]) > LARGE * expected_of(i)));
    }
    more = more & done;
    const Mask noted = done & !more;
    for (int64_t i = 0; i < w.l; ++i) {
        Octet *figures = w.figures(i);
        const auto set = [&](Figure figure, const Mask &those, const Octet &value) {
            figures[figure] = where(those, value, figures[figure]);
        };
        set(NOTED, noted, figures[NOTED] + 1.0);
        set(TERMS, noted, max(where(figures[TERMS] < ENDLESS, figures[TERMS], 0.0), o.per_band * w.band[i]));
        if (errors > 0.0) {
            const Octet size = abs(w.before[i] - figures[LEFT]), expected = expected_of(i);
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
[[gnu::flatten]] inline Mask project_octet_evaluated(Eight &eight, const W &w, const Step &step, const Octet *y,
                                                     const Mask &alive, const Work &single) {
    const Options &o = eight.options;
    const Mask outside = residuals<Octet>(nullptr, w.y_hat, o, w, w.before);
    const Mask moved = outside & alive;
    const bool all_move = moved.all();
    const RunOf<W, OctetSystem> run{eight.method, o, w, eight.system, nullptr};
    const int64_t blocks = o.blocks.count;
    Mask leave{};
    Octet largest_error = 0.0;
    if (o.metric == BY_ERROR) {
        if (!all_move) copy(w.sigma, w.stage, w.m);
        leave = block_sizes<Octet>(y, o.compensated ? 0.0 : EPS, o, w);
        largest_error = remembered_errors<Octet>(memory_kept(run), o, w);
        weights_from_errors(y, o, w);
        for (int64_t j = 0; !all_move && j < w.m; ++j) w.sigma[j] = where(moved, w.sigma[j], w.stage[j]);
    }
    Octet *rows = weighed_gradients(o, w);
    const Mask dependent = moved & !solve_gram(rows_of(rows, w), w.g, corner(w.R, w.l, w), w.mu);
    move_along(o, w, rows, eight.y_new);
    const Octet *f = flow_at_raw(run, step);
    if (f) remove_shift(o, w, f, -1, eight.y_new);
    for (int64_t lane = 0; lane < LANES; ++lane)
        if (all_move || moved.lane(lane)) eight.own[lane][LAST_RANK] = w.l;
    if (any(dependent))
        for (int64_t lane = 0; lane < LANES; ++lane)
            if (dependent.lane(lane)) solve_alone(eight, lane, f, o, single);
    const Octet correction = correction_in_local_errors(largest_error, o, w);
    if (o.compensated) {
        for (int64_t j = 0; j < w.m; ++j) w.move[j] = where(outside, w.move[j], 0.0);
        copy(w.y_hat, eight.y_new, w.m);
        compensated_add(as_floats(eight.y_new), as_floats(w.carry_hat), as_floats(w.move), LANES * w.m);
    }
    for (int64_t j = 0; !all_move && j < w.m; ++j) eight.y_new[j] = where(outside, eight.y_new[j], w.y_hat[j]);
    evaluate_invariants(run, step.t_new, eight.y_new);
    const Mask held = residuals_held<Octet>(w.before, o, w) & small_shares(o, w) & all_finite(eight.y_new, w.m);
    if (o.has_limits) leave = leave | (missed_targets(o, w) > 1.0);
    Mask done = alive & held & !leave;
    if (o.watched) done = done & !note_octet(step.t_new, done, o, w);
    for (int64_t i = 0; i < w.l; ++i)
        w.max_residual[i] = where(done, max(w.max_residual[i], abs(w.residual[i])), w.max_residual[i]);
    for (int64_t b = 0; o.metric == BY_ERROR && b < MEMORIES * blocks; ++b)
        w.memory[b] = where(done, w.memory_new[b], w.memory[b]);
    eight.corrected = done & outside;
    *w.max_correction = where(eight.corrected, max(*w.max_correction, correction), *w.max_correction);
    const unsigned finished = done.bits(), changed = eight.corrected.bits();
    for (int64_t lane = 0; lane < LANES; ++lane) {
        int64_t *own = eight.own[lane];
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
inline Mask project_octet(Eight &eight, const W &w, const Step &step, const Mask &alive, const Work &single) {
    const Options &o = eight.options;
    eight.system.grad(w, step.t_new, w.y_hat, w.last(), w.G);
    ++w.counters[NJEV];
    if (o.every != 1 && o.metric == BY_ERROR)
        quadrature(eight.flat.err, eight.flat.err_sum, eight.flat.err, eight.flat.m);
    const Mask noticed = o.watched && w.counters[F_AT_RAW] ? alive & rates_stand_out(w, LEAST_RATE) : Mask{};
    eight.system.inv(w, step.t_new, w.y_hat, w.values);
    return noticed | project_octet_evaluated(eight, w, step, eight.y, alive & !noticed, single);
}

// Projects eight members of a multistep method as `project_nodes` projects one. Members whose steps are not stable are
// removed. Returns the members that must be projected alone; the errors gathered for them before are in w.err_low.
inline Mask project_octet_nodes(Eight &eight, const Work &single) {
    const Options &o = eight.options;
    const WorkOf<Octet> &w = eight.work;
    const Multistep &ms = eight.multistep;
    const RunOf<WorkOf<Octet>, OctetSystem> run{eight.method, o, w, eight.system, nullptr};
    Octet size;
    copy(w.err_sum, w.err_low, w.m);
    const Mask alive = eight.alive = eight.alive & estimate_nodes(ms, o, size, w);
    if (w.l == 0 || ms.place[SEEN] <= COLLECTED) return Mask{};
    const double t = ms.t0 + static_cast<double>(ms.place[NEWEST]) * ms.h;
    double since[LANES];
    for (int lane = 0; lane < LANES; ++lane) since[lane] = static_cast<double>(ms.place[SINCE] - eight.projected[lane]);
    gather_errors(size, Octet::load(since), w);
    newest_state(run, t);
    const Mask noticed = o.watched ? alive & rates_stand_out(w, LEAST_RATE) : Mask{};
    const Mask those = (o.every == AUTO ? alive & tells_more(w) : alive) & !noticed;
    if (!any(those)) return noticed;
    copy(w.target, as_values<Octet>(ms.levels), w.l);
    const int64_t counted = w.counters[NJEV];
    residuals_in_the_middle(run, t, eight.y_new);
    w.counters[NJEV] = counted;
    soften_residuals(ms, o, w);
    const Mask leave = project_octet_evaluated(eight, w, Step{t, t, ms.h, nullptr, nullptr, true, true}, w.y_hat, those,
                                               single),
               done = those & !leave;
    note_what_is_left(ms, done, w);
    move_sums(ms, eight.corrected, w);
    for (int lane = 0; lane < LANES; ++lane) {
        if (!done.lane(lane)) continue;
        eight.projected[lane] = ms.place[SINCE];
        ++eight.own[lane][NJEV];
    }
    return leave | noticed;
}

}  // namespace eip
