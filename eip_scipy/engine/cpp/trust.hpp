// Whether a projection holds, and what it leaves: figures by which a run is judged (trust.py).
#pragma once

#include "metric.hpp"

namespace eip {

constexpr double FAILURE_BANDS = 100.0, NOISE_BANDS = 3.0;
// Terms that vanish for a moment, where an invariant's own pass through zero, count as this share of those at the start.
constexpr double LEAST_SHARE = 1e-3;
// Coordinates that move by less than this share of their size stand still.
constexpr double STILL = 1e4 * EPS;
// A rate of change along the flow is suspicious from LEAST_RATE of its terms on, in runs with balances from
// LEAST_BALANCE_RATE on, because a wrong rate of a slow balance shows no more, and again when it has grown by RATE_GROWTH.
// Terms that vanish for a moment, as those of velocity constraints do at singular positions, count as LEAST_TERMS of the
// largest so far.
// Part of a step over which differences of values along the flow are taken.
constexpr double PART_OF_STEP = 1.0 / 64.0;
constexpr double LARGEST = std::numeric_limits<double>::max();
constexpr double LEAST_RATE = 1e-8, LEAST_BALANCE_RATE = 1e-10, RATE_GROWTH = 2.0, LEAST_TERMS = 0.1;
// A local error is suspicious from this share of what the step changes in its block, or of the block's size, on, and again
// when it has grown by ERROR_GROWTH; from CLEAR_ERROR on it is clearly too large. Blocks count as if they changed by
// LEAST_CHANGE of the largest change at least.
constexpr double LEAST_ERROR = 3e-3, CLEAR_ERROR = 0.1, ERROR_GROWTH = 2.0, LEAST_CHANGE = 1e-2;

// Residuals w.g = values - target and their dead bands; inside its band a residual is set to 0, `raw` keeps all. Returns
// whether anything is left to project. Invariants with given targets are then corrected by all of their residuals: where their
// gradients are nearly dependent, what is left of them counts in units of the distance from the singular position, and
// derivatives may hold on the targets only. `terms`: sums of |G_k y_k|, else they are taken at `y`; then, where the step's
// errors are known, w.worth = sums of |G_k err_k| too.
template <class Value, class W>
inline Truth<Value> residuals(const double *terms, const Value *y, const Options &o, const W &w, Value *raw) {
    const bool measured = o.watched && w.counters[HAVE_ERROR] && !terms;
    const double band = 1.0 / o.per_band;
    Truth<Value> outside{};
    for (int64_t i = 0; i < w.l; ++i) {
        Value size = max(abs(w.values[i]), abs(w.target[i])), own;
        if (measured) {
            const auto sums = abs_dots(w.gradient(i), y, w.err, w.m);
            own = sums.b;
            w.worth[i] = sums.c;
        } else {
            own = terms ? Value(terms[i]) : abs_dot(w.gradient(i), y, w.m);
        }
        // A gradient that is not finite makes its band so: the projection then fails, also of a state on the manifold.
        size = max(own, max(size, Value(o.scales[i])));
        w.band[i] = band * size;
        raw[i] = w.values[i] - w.target[i];
        const Truth<Value> inside = (w.band[i] < ENDLESS) & (abs(raw[i]) <= w.band[i]);
        w.g[i] = o.most_left[i] < ENDLESS ? raw[i] : where(inside, Value(0.0), raw[i]);
        outside = outside | !inside;
    }
    return outside;
}

// The first figures of a run: its invariants' terms; those that vanish at the start, as they are a step later. Where other
// code projects, or a multistep method does, RATE begins as that of a quantity which is not known to be an invariant.
template <class Value, class W>
inline void start_figures(const Value *y, const Value *f, double tau, const Method &method, const Hooks *hooks,
                          const Options &o, const W &w) {
    const bool own = !hooks || !((hooks->raw && !hooks->drives) || hooks->joint);
    const bool known = !method.multistep && own;
    for (int64_t i = 0; i < w.l; ++i) {
        const Value *G = w.gradient(i);
        Value terms = max(max(abs(w.values[i]), abs(w.target[i])), max(Value(o.scales[i]), abs_dot(G, y, w.m)));
        terms = max(terms, tau * abs_dot(G, f, w.m));
        Value *figures = w.figures(i);
        fill(figures, 0.0, N_FIGURES);
        figures[LEFT] = w.values[i] - w.target[i];
        figures[RATE] = known ? 0.0 : 1.0;
        figures[EXAMINED] = known ? 0.0 : 1.0;
        figures[BY_VALUES] = o.computed[i];
        figures[FAR_FROM] = o.distant;
        figures[START] = where(terms < ENDLESS, terms, 0.0);
        figures[TERMS] = where(terms > 0.0, terms, ENDLESS);
    }
}

// Terms of invariant i to measure a residual by: those now, at most the largest of a state that was on the manifold. A
// state that blows up carries terms as large as its residual. TINY, for what underflows.
template <class W>
inline auto own_terms(int64_t i, const Options &o, const W &w) {
    const auto *figures = w.figures(i);
    const auto now = max(o.per_band * w.band[i], LEAST_SHARE * figures[START]);
    return min(now, figures[TERMS]) + TINY;
}

// The sum of |G_b| |x_b| over groups of floats with the same unit. Terms G_k x_k may vanish together by the orientation
// of the axes; these products do not.
[[gnu::cold, gnu::noinline]] inline double norm_products(const double *G, const double *x, const Blocks &kinds) {
    double total = 0.0;
    for (int64_t b = 0; b < kinds.count; ++b) {
        double gradient = 0.0, size = 0.0;
        for (uint64_t place = kinds.start[b]; place < kinds.start[b + 1]; ++place) {
            gradient = std::hypot(gradient, G[kinds.member[place]]);
            size = std::hypot(size, x[kinds.member[place]]);
        }
        total += gradient * size;
    }
    return total;
}

// Return whether a state (q, v) stands still: its coordinates move by roundings in a step from y, and what its
// velocities do is the rounding of forces that cancel.
[[gnu::cold, gnu::noinline]] inline bool at_rest(const double *y, const Options &o, const Work &w) {
    if (o.kinds.count != 2 || 2 * o.kinds.size != w.m || o.blocks.count != w.m) return false;
    double moved = 0.0, size = 0.0;
    for (int64_t j = 0; j < w.m / 2; ++j) {
        moved = std::max(moved, std::abs(w.y_hat[j] - y[j]));
        size = std::max(size, std::abs(y[j]));
    }
    return moved <= STILL * size;
}

// The terms by which a residual is measured that is large in units of `own`. `y`, the state at the step's start, must be
// on the manifold: a state that blows up has large terms too. It is null where no such state is available. Components
// whose units are unknown have no orientation that could hide anything.
inline double generous_terms(int64_t i, double own, const double *y, const Options &o, const Work &w) {
    if (!y || o.kinds.count == w.m) return own;
    if (at_rest(y, o, w)) return ENDLESS;
    const double found = norm_products(w.gradient(i), y, o.kinds);
    return std::abs(w.figures(i)[LEFT]) <= LARGE_SHARE * found ? std::max(own, found) : own;
}

// Note the residuals; whether all are finite and none has grown beyond what round-off explains: FAILURE_BANDS dead bands, or
// as many roundings where bands are smaller.
template <class Value, class W>
inline Truth<Value> residuals_held(const Value *before, const Options &o, const W &w) {
    const double bands = FAILURE_BANDS * std::max(1.0, EPS * o.per_band);
    Truth<Value> bad{};
    for (int64_t i = 0; i < w.l; ++i) {
        w.residual[i] = w.values[i] - w.target[i];
        const Value size = abs(w.residual[i]);
        bad = bad | !(size < ENDLESS) | ((size > abs(before[i])) & (size > bands * w.band[i]));
    }
    return !bad;
}

// True if no residual is more than o.limit times its invariant's terms.
template <class W>
inline auto small_shares(const Options &o, const W &w) {
    Truth<typename W::Value> bad{};
    for (int64_t i = 0; i < w.l; ++i) bad = bad | !(abs(w.residual[i]) <= o.limit * own_terms(i, o, w));
    return !bad;
}

// Return whether the residuals hold in units of the terms that the orientation of the axes does not hide, and of their
// rounding.
[[gnu::cold, gnu::noinline]] inline bool held_generously(const double *before, const double *y_old, const Options &o,
                                                         const Work &w) {
    const double bands = FAILURE_BANDS * std::max(1.0, EPS * o.per_band);
    bool bad = false;
    for (int64_t i = 0; i < w.l; ++i) {
        const double size = std::abs(w.residual[i]), own = generous_terms(i, own_terms(i, o, w), y_old, o, w);
        const double rounding =
            bands * std::max(w.band[i], norm_products(w.gradient(i), w.y_hat, o.kinds) / o.per_band);
        bad = bad || !(size < ENDLESS) || (size > std::abs(before[i]) && size > rounding) || !(size <= o.limit * own);
    }
    return !bad;
}

// Note the residuals after a projection. It has failed where something is not finite, or a residual has grown and stands
// above FAILURE_BANDS dead bands and roundings, or is more than the limit. y_old: the state at the step's start, or null.
template <class W>
inline Code judge(const double *before, const double *y_old, const double *y, const Options &o, const W &w) {
    const bool held = residuals_held(before, o, w);
    if (!all_finite(y, w.m)) return FAILED_PROJECTION;
    return (held && small_shares(o, w)) || held_generously(before, y_old, o, w) ? OK : FAILED_PROJECTION;
}

// Keep a step for an examination, which takes place in Python. A change along the flow has precedence.
[[gnu::cold, gnu::noinline]] inline void suspect(Reason reason, const Step &step, const Work &w) {
    if (w.suspected() > reason) return;
    w.suspect[REASON] = reason;
    w.suspect[SUSPECT_FROM] = step.t;
    w.suspect[SUSPECT_TO] = step.t_new;
    w.suspect[SUSPECT_WAITED] = static_cast<double>(w.counters[WAITED]);
    copy(step.y, w.suspect + N_SUSPECT, w.whole());
    copy(w.y_hat, w.suspect + N_SUSPECT + w.whole(), w.whole());
    ++w.counters[FOUND];
}

// A suspect step is examined at the state that is accepted, and not at one that was rejected or moved since.
[[gnu::cold, gnu::noinline]] inline void keep_accepted(const Step &step, const Work &w) {
    if (w.suspect[SUSPECT_FROM] != step.t) return;
    w.suspect[SUSPECT_TO] = step.t_new;
    copy(step.y_new, w.suspect + N_SUSPECT + w.whole(), w.whole());
}

// Return whether some invariant changes along the flow at y_hat by more than was known before, relative to the terms of that
// rate; f at y_hat is in w.last(). An explicit dependence on time shows here, too.
template <class W>
[[gnu::noinline]] inline auto rates_stand_out(const W &w, double least) {
    using Value = typename W::Value;
    Truth<Value> found{};
    for (int64_t i = 0; i < w.l; ++i) {
        Value *figures = w.figures(i);
        const Value *G = w.gradient(i), *f = w.last();
        const Value rate = abs(dot(G, f, w.m) - w.flow[i]), terms = abs_dot(G, f, w.m);
        figures[RATE_TERMS] = max(figures[RATE_TERMS], min(terms, Value(LARGEST)));
        const Value unit = max(terms, LEAST_TERMS * figures[RATE_TERMS]) + TINY;
        const Truth<Value> record = (rate > figures[RATE] * unit) & (rate < ENDLESS);
        if (any(record)) [[unlikely]]
            figures[RATE] = where(record, rate / unit, figures[RATE]);
        found = found | (figures[RATE] > max(Value(least), RATE_GROWTH * figures[RATE_NOTED]));
    }
    return found;
}

// Add a sample of balance b to the sums by which its slowness is judged.
inline void note_slowness(double rate, double terms, int64_t b, const Work &w) {
    const auto row = [&](SlowRow k) -> double & { return w.slow[k * w.balances + b]; };
    row(ALL_RATES) += rate;
    row(ALL_TERMS) += terms;
    const double kept = 1.0 - 1.0 / std::max(LEAST_LATE, LATE_SHARE * ++row(SAMPLES));
    row(LATE_RATES) = kept * row(LATE_RATES) + rate;
    row(LATE_TERMS) = kept * row(LATE_TERMS) + terms;
}

// The rates at which the balances are to change with the state, and sums of rates and of their terms. Nothing is known of
// those that have no rate of their own.
[[gnu::cold, gnu::noinline]] inline void note_balances(const Run &run, const Step &step) {
    const Work &w = run.work;
    double *rates = w.rate(w.stages);
    run.system.rates(w, step.t_new, w.y_hat, w.last(), rates);
    int64_t first = 0;
    for (const Balance &balance : run.system.balances) {
        double *in_time = w.mu;
        if (balance.is_given) run.system.rate_in_time(w, balance, step.t_new, w.y_hat, in_time);
        for (int64_t k = 0; k < balance.floats; ++k) {
            const int64_t b = first + k, i = run.options.balances.place[b];
            const double terms = abs_dot(w.gradient(i), w.last(), w.m);
            w.flow[i] = balance.is_given ? rates[b] - in_time[k] : NOT_A_NUMBER;
            if (!std::isfinite(rates[b]) || !std::isfinite(terms)) continue;
            note_slowness(std::abs(rates[b]), terms, b, w);
        }
        first += balance.floats;
    }
}

// Write the rates along the flow of the invariants whose gradients are made from f to w.flow, with the other sign. They are
// differences of values. The product of such a gradient with f tells nothing: it is 0 in each state.
[[gnu::cold, gnu::noinline]] inline void note_values_along_flow(const Run &run, const Step &step, const FromF &known) {
    const Work &w = run.work;
    const double part = PART_OF_STEP * step.h;
    double *state = w.stage, *values = w.inner_mu;
    fill(w.flow, 0.0, w.l);
    for (const int shifts : {1, -1, 2, -2}) {
        for (int64_t j = 0; j < w.m; ++j) state[j] = w.y_hat[j] + shifts * part * w.last()[j];
        run.system.inv(w, step.t_new, state, values);
        const double weight = (shifts > 0 ? 1.0 : -1.0) * ORDER_4[std::abs(shifts) - 1] / part;
        for (int64_t i = 0; i < w.l; ++i)
            if (known.has(i)) w.flow[i] -= weight * values[i];
    }
}

// Note the rates where f at y_hat is known.
template <class AnyRun>
[[gnu::noinline]] inline void note_known_rates(const AnyRun &run, const Step &step) {
    const auto &w = run.work;
    if (w.balances > 0) note_balances(of_any_length(run), step);
    if constexpr (IS_SINGLE<AnyRun>)
        if (const FromF known = from_f(run); known.pairs > 0) note_values_along_flow(of_any_length(run), step, known);
    if (!rates_stand_out(w, w.balances > 0 ? LEAST_BALANCE_RATE : LEAST_RATE)) return;
    for (int64_t i = 0; i < w.l; ++i) w.figures(i)[RATE_NOTED] = w.figures(i)[RATE];
    suspect(CHANGES_ALONG_FLOW, step, w);
}

template <class AnyRun>
inline void note_rates(const AnyRun &run, const Step &step) {
    if (run.options.watched && run.work.counters[F_AT_RAW]) [[unlikely]]
        note_known_rates(run, step);
}

// The largest local error of a block, relative to what a fixed step of length h from y changes in it and to its size.
template <class Value, class W>
[[gnu::noinline]] inline Value largest_error_share(double h, const Value *y, const Options &o, const W &w) {
    Value *change = w.stage, largest_size = 0.0, top = 0.0;
    const auto size = [&](int64_t b) {
        const Value moved =
            max(block_square(change, b, Value(1.0), o.blocks), block_square(w.row(0), b, Value(h), o.blocks));
        return max(moved, block_square(y, b, Value(1.0), o.blocks));
    };
    for (int64_t i = 0; i < w.m; ++i) change[i] = w.y_hat[i] - y[i];
    for (int64_t b = 0; b < o.blocks.count; ++b) largest_size = max(largest_size, size(b));
    const Value least = LEAST_CHANGE * LEAST_CHANGE * largest_size + TINY;
    for (int64_t b = 0; b < o.blocks.count; ++b)
        top = max(top, block_square(w.err, b, Value(1.0), o.blocks) / (size(b) + least));
    return sqrt(top);
}

template <class Value>
inline auto is_rough(const Value &share, const Value *figures) {
    return share > max(Value(LEAST_ERROR), ERROR_GROWTH * figures[ROUGH_NOTED]);
}

// Note a fixed step whose local error is large compared with what it changes in some block. The step may not resolve that
// block, which the invariants need not show.
[[gnu::cold, gnu::noinline]] inline void note_roughness(const Step &step, const Options &o, const Work &w) {
    // The first one that is clearly too large is examined: later ones may come of it.
    if (w.suspected() > LARGE_ERROR || (w.suspected() == LARGE_ERROR && w.figures(0)[ROUGH_NOTED] > CLEAR_ERROR))
        return;
    const double share = largest_error_share(step.h, step.y, o, w);
    if (!is_rough(share, w.figures(0))) return;
    w.figures(0)[ROUGH_NOTED] = share;
    suspect(LARGE_ERROR, step, w);
}

// A residual that is large compared with the terms of its invariant.
inline void note_share(double share, double t, double *figures, Figure largest_so_far, Figure at) {
    if (share > figures[largest_so_far]) {
        figures[largest_so_far] = share;
        figures[at] = t;
    }
}

// Return what the step's errors are worth for invariant i if those that the metric remembers are counted: the estimates of
// the components that its gradient touches may vanish by chance in one step.
[[gnu::cold, gnu::noinline]] inline double remembered_worth(int64_t i, const Options &o, const Work &w) {
    // The errors of several steps hardly vanish together.
    if (o.metric != BY_ERROR || w.counters[WAITED] > 0) return 0.0;
    double largest_error = 0.0, worth = 0.0;
    for (int64_t b = 0; b < o.blocks.count; ++b)
        largest_error = std::max(largest_error, std::sqrt(block_square(w.err, b, w.inverse[b], o.blocks)));
    for (int64_t b = 0; b < o.blocks.count; ++b)
        for (uint64_t place = o.blocks.start[b]; place < o.blocks.start[b + 1]; ++place)
            worth += std::abs(w.gradient(i)[o.blocks.member[place]]) * w.remembered[b] * w.scale[b];
    return worth * largest_error;
}

// Compare what an invariant changed by since its last projection with what the steps' errors explain; return whether it is
// LARGE.
inline bool weigh_change(double size, double expected, double t, double *figures) {
    figures[JUDGED] += 1.0;
    figures[SUM] += size;
    figures[EXPECTED] += expected;
    if (size > figures[NU] * expected) {
        figures[NU] = size / expected;
        figures[AT] = t;
    }
    if (!(size > LARGE * expected)) return false;
    if (figures[MANY] == 0.0) figures[FIRST] = t;
    figures[MANY] += 1.0;
    return true;
}

// Records an accepted projection: its residuals, and whether the errors of the steps explain its corrections.
//
// An invariant's local errors since the last projection are worth `errors` times w.worth, their rounding `rounding` times
// its terms; with errors = 0 nothing is known of them. y_old: the state at the step's start, or null.
template <class W>
inline void note(const Step &step, double errors, double rounding, const double *y_old, const Options &o, const W &w) {
    const double t = step.t_new;
    for (int64_t i = 0; i < w.l; ++i) {
        double *figures = w.figures(i);
        const double size = std::abs(w.residual[i]), raw = std::abs(w.before[i]);
        w.max_residual[i] = std::max(w.max_residual[i], size);
        const double terms = o.per_band * w.band[i];
        double own = own_terms(i, o, w);
        if (raw > o.distant * own || size > LARGE_SHARE * own) own = generous_terms(i, own, y_old, o, w);
        figures[NOTED] += 1.0;
        if (raw > o.distant * own) {
            note_share(raw / own, t, figures, RAW, RAW_AT);
            figures[RAW_MANY] += 1.0;
            ++w.counters[FOUND];
        }
        if (size > LARGE_SHARE * own) {
            note_share(size / own, t, figures, SHARE, SHARE_AT);
            ++w.counters[FOUND];
        } else {
            const double known = figures[TERMS] < ENDLESS ? figures[TERMS] : 0.0;
            figures[TERMS] = std::max(known, terms);
        }
        // An estimate that vanishes tells nothing: that of RK4 does where f depends on t alone.
        if (errors > 0.0 && w.worth[i] > 0.0) {
            const double change = std::abs(w.before[i] - figures[LEFT]);
            double expected = errors * w.worth[i] + rounding * terms + TINY;
            if (change > LARGE * expected)
                expected += rounding * generous_terms(i, 0.0, y_old, o, w) + errors * remembered_worth(i, o, w);
            if (expected < ENDLESS && weigh_change(change, expected, t, figures)) [[unlikely]] {
                ++w.counters[FOUND];
                if (figures[AT] == t) suspect(LARGE_CORRECTION, step, w);
            }
        }
        figures[LEFT] = w.residual[i];
    }
    if (w.suspected() != NOTHING) [[unlikely]]
        keep_accepted(step, w);
}

// Records the projection of a step like `note`. If the estimates of several steps are gathered in quadrature, the
// errors of these steps may nevertheless add up, hence the factor.
template <class W>
inline void take_note(const Step &step, const double *y_old, const Options &o, const W &w) {
    if (!o.watched) return raise_to(w.residual, w.max_residual, w.l);
    const double waited = w.counters[WAITED];
    double rounding = EPS, errors = w.counters[HAVE_ERROR] ? 1.0 : 0.0;
    if (waited > 0) {
        rounding *= std::sqrt(1.0 + waited);
        const bool gathered = o.metric == BY_ERROR || o.every == AUTO || o.adaptive;
        errors *= gathered ? std::sqrt(1.0 + waited) : 1.0 + waited;
    }
    note(step, errors, rounding, y_old, o, w);
}

// True if the errors gathered make some invariant more uncertain than NOISE_BANDS roundings of its terms.
template <class W>
inline auto tells_more(const W &w) {
    using Value = typename W::Value;
    Truth<Value> more{};
    for (int64_t i = 0; i < w.l; ++i) {
        const Value *G = w.gradient(i);
        const Value error = sqrt(square_dot(w.err, G, w.m)), noise = abs_dot(G, w.y_hat, w.m);
        more = more | (error > NOISE_BANDS * EPS * noise);
    }
    return more;
}

// Per row, twice the residuals of all rows in its own unit: what a projection of lower rank may move between them. Twice,
// because what one row loses to second order another may gain.
inline void shared_residuals(const Work &w, double *shared) {
    double total = 0.0;
    for (int64_t i = 0; i < w.l; ++i) total += std::abs(w.before[i]) * w.inverse_norms[i];
    for (int64_t i = 0; i < w.l; ++i)
        shared[i] = w.inverse_norms[i] > 0.0 ? 2.0 * total / w.inverse_norms[i] : std::abs(w.before[i]);
}

}  // namespace eip
