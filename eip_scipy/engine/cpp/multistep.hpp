// Multistep steps for q'' = a(t, q): Gauss-Jackson's method, summed, one evaluation a step, with the projection in its sums
// (methods/gauss_jackson.py has the formulas). The history is `middle` nodes ahead of the states that a run shows: formulas
// centred on it lose nothing to rounding, those at its newest end do.
#pragma once

#include "correction.hpp"
#include "stages.hpp"

namespace eip {

// Estimates that are collected before one is used, and what is left of each a turn later.
constexpr int64_t COLLECTED = 20;
constexpr double MEMORY = 0.9;
// One in this number of projections in groups, whose weights do not depend on the estimates, is examined: by the estimates, and by the
// rates of the balances. That takes as long as the projection itself.
constexpr int64_t EXAMINED_EACH = 4;
// Values of the invariants around the start that are averaged, how far from it in parts of the state, and how many roundings
// of an invariant's terms their mean may be off.
constexpr int64_t LEVELS = 64;
constexpr double LEVEL_DISTANCE = 0x1p-44, LEVEL_BANDS = 4.0;

inline double *newest(const Multistep &ms) { return ms.nodes + ms.place[NEWEST_ROW] * ms.pitch; }

// The `count` newest nodes under their weights.
inline Rows latest(const Multistep &ms, const double *weights, int64_t count) {
    return {weights, newest(ms) - (count - 1) * ms.pitch, count, ms.pitch};
}

// Their sums from entry i on, in two parts that do not wait for each other.
template <class Value, int COUNT>
inline void row_sums(const Rows &rows, int64_t i, Value *out) {
    constexpr int LENGTH = sizeof(Value) / sizeof(double);
    Value even[COUNT] = {}, odd[COUNT] = {};
    const double *row = rows.first + i;
    const auto add = [&](int64_t j, Value *sums) {
        const Value weight = spread<Value>(rows.weights[j]);
        for (int k = 0; k < COUNT; ++k)
            sums[k] = fused(weight, load_as<Value>(row + j * rows.stride + k * LENGTH), sums[k]);
    };
    for (int64_t j = 0; j + 1 < rows.count; j += 2) add(j, even), add(j + 1, odd);
    if (rows.count % 2) add(rows.count - 1, even);
    for (int k = 0; k < COUNT; ++k) out[k] = even[k] + odd[k];
}

// The vectors that hold the entries `first` to `end` - 1; `out` goes to the rows' ends.
inline void row_sums(const Rows &rows, double *out, int64_t first, int64_t end) {
    const int64_t start = first - first % WIDTH;
    in_blocks((end - start + WIDTH - 1) / WIDTH * WIDTH, [&]<class Value, int COUNT>(int64_t i) {
        Value sums[COUNT];
        row_sums<Value, COUNT>(rows, start + i, sums);
        for (int k = 0; k < COUNT; ++k) store_as<Value>(sums[k], out + start + i + k * sizeof(Value) / sizeof(double));
    });
}

// scale (total + (rest + what the rows add)). The scale h^2 is a pair of floats: its rounding would move all bodies along their
// orbits, by -4 times its relative size.
template <class Value>
inline Value scaled(const Pair &scale, const Value &total, const Value &rest, const Value &rows) {
    const Value sum = total + (rest + rows);
    return fused(spread<Value>(scale.value), sum, scale.rest * sum);
}

// Writes the scaled sums that `scaled` returns to `out`, up to the ends of the rows.
inline void predict(const Rows &rows, const Pair &scale, const double *total, const double *rest, double *out) {
    in_blocks(rows.stride, [&]<class Value, int COUNT>(int64_t i) {
        Value sums[COUNT];
        row_sums<Value, COUNT>(rows, i, sums);
        for (int k = 0; k < COUNT; ++k, i += sizeof(Value) / sizeof(double))
            store_as<Value>(scaled(scale, load_as<Value>(total + i), load_as<Value>(rest + i), sums[k]), out + i);
    });
}

// The row of the next node; the others move to the first rows where there is none left.
inline double *next_row(const Multistep &ms) {
    int64_t &at = ms.place[NEWEST_ROW];
    if (at + 1 == ms.rows) {
        std::copy(newest(ms) - (ms.order - 1) * ms.pitch, newest(ms) + ms.pitch, ms.nodes);
        std::copy(ms.rates_at(at + 1 - ms.order), ms.rates_at(at + 1), ms.rates);
        at = ms.order - 1;
    }
    return ms.nodes + (at + 1) * ms.pitch;
}

// S += s + a, s += a for the newest node a; what rounding leaves is accumulated separately. Rows' ends are 0. If it PREDICTS, the
// positions at the next node go into y: the older nodes' part does not wait for the newest one.
template <bool PREDICTS>
inline void add_to_sums(const Multistep &ms, double *y) {
    double *S = ms.sums, *S_rest = S + ms.pitch, *s = S_rest + ms.pitch, *s_rest = s + ms.pitch;
    const double *a = newest(ms);
    const Pair square = two_product(ms.h, ms.h);
    const Rows rows = latest(ms, ms.predict_q, ms.order);
    in_blocks(ms.pitch, [&]<class Value, int COUNT>(int64_t i) {
        Value sums[COUNT];
        if constexpr (PREDICTS) row_sums<Value, COUNT>(rows, i, sums);
        for (int k = 0; k < COUNT; ++k, i += sizeof(Value) / sizeof(double)) {
            const PairOf<Value> first = two_sum(load_as<Value>(s + i), load_as<Value>(a + i));
            const PairOf<Value> second = two_sum(load_as<Value>(S + i), first.value);
            const Value rest = load_as<Value>(s_rest + i) + first.rest;
            const Value second_rest = load_as<Value>(S_rest + i) + (second.rest + rest);
            store_as<Value>(first.value, s + i);
            store_as<Value>(rest, s_rest + i);
            store_as<Value>(second.value, S + i);
            store_as<Value>(second_rest, S_rest + i);
            if constexpr (PREDICTS) store_as<Value>(scaled(square, second.value, second_rest, sums[k]), y + i);
        }
    });
}

// True if no entry of a row is NaN or infinite, which times 0 are NaN.
inline bool is_finite_row(const Multistep &ms, const double *a) {
    Vector zeros{};
    for (int64_t i = 0; i < ms.pitch; i += WIDTH) zeros += 0.0 * load(a + i);
    for (int k = 0; k < WIDTH; ++k)
        if (!(zeros[k] == 0.0)) return false;
    return true;
}

// (y, rest): the state `back` nodes before the newest.
inline void state_of(const Multistep &ms, int64_t back, double *y, double *rest) {
    const int64_t half = ms.half, n = ms.order;
    const Pair step{ms.h, 0.0}, step_squared = two_product(ms.h, ms.h);
    const double lag = -(1.0 + static_cast<double>(back));
    const double *S = ms.sums, *S_rest = S + ms.pitch, *s = S_rest + ms.pitch, *s_rest = s + ms.pitch;
    const Rows rows_q = latest(ms, ms.states_q + back * n, n), rows_v = latest(ms, ms.states_v + back * n, n);
    in_blocks(half, [&]<class Value, int COUNT>(int64_t i) {
        const auto both = [](const Pair &a) { return PairOf<Value>{Value{} + a.value, Value{} + a.rest}; };
        const PairOf<Value> h = both(step), square = both(step_squared);
        Value shift[COUNT], kick[COUNT];
        row_sums<Value, COUNT>(rows_q, i, shift);
        row_sums<Value, COUNT>(rows_v, i, kick);
        for (int k = 0; k < COUNT; ++k, i += sizeof(Value) / sizeof(double)) {
            const PairOf<Value> first{load_as<Value>(s + i), load_as<Value>(s_rest + i)};
            const PairOf<Value> second{load_as<Value>(S + i), load_as<Value>(S_rest + i)};
            const PairOf<Value> moved = two_product<Value>(Value{} + lag, first.value);
            const PairOf<Value> lagged = sum<Value>(second, {moved.value, moved.rest + lag * first.rest});
            const PairOf<Value> q = product(square, sum<Value>(lagged, {shift[k], Value{}}));
            const PairOf<Value> v = product(h, sum<Value>(first, {kick[k], Value{}}));
            store_as<Value>(q.value, y + i);
            store_as<Value>(q.rest, rest + i);
            store_as<Value>(v.value, y + half + i);
            store_as<Value>(v.rest, rest + half + i);
        }
    });
}

// The derivative at that node: its velocity, and its acceleration as the history has it.
inline void slope_of(const Multistep &ms, int64_t back, const double *y, double *f) {
    copy(y + ms.half, f, ms.half);
    copy(newest(ms) - back * ms.pitch, f + ms.half, ms.half);
}

// The sums, from the state (q, v) that they hold as pairs of floats, `back` nodes before the newest.
inline void begin_sums(const Multistep &ms, int64_t back, double *scratch) {
    const int64_t half = ms.half, n = ms.order;
    const Pair h{ms.h, 0.0}, square = two_product(ms.h, ms.h);
    const double lag = 1.0 + static_cast<double>(back);
    double *S = ms.sums, *s = S + 2 * ms.pitch;
    weighted_sum(1.0, latest(ms, ms.states_q + back * n, n), scratch, half);
    weighted_sum(1.0, latest(ms, ms.states_v + back * n, n), scratch + half, half);
    for (int64_t i = 0; i < half; ++i) {
        const Pair v = quotient({s[i], s[ms.pitch + i]}, h), q = quotient({S[i], S[ms.pitch + i]}, square);
        const Pair first = sum(v, {-scratch[half + i], 0.0}), moved = product(first, {lag, 0.0});
        const Pair second = sum(sum(q, moved), {-scratch[i], 0.0});
        s[i] = first.value;
        s[ms.pitch + i] = first.rest;
        S[i] = second.value;
        S[ms.pitch + i] = second.rest;
    }
}

// Contribution of the rates of the history to the sum of the rates of balance b, for its value `back` nodes before the newest.
inline double rates_beside_sum(const Multistep &ms, int64_t back, int64_t b) {
    const double *weights = ms.states_v + back * ms.order, *oldest = ms.rates_at(ms.place[NEWEST_ROW] + 1 - ms.order);
    double kick = 0.0;
    for (int64_t j = 0; j < ms.order; ++j) kick += weights[j] * oldest[j * ms.balances + b];
    return kick;
}

// The value of balance b `back` nodes before the newest, as a pair of floats: by the formula of the velocities, with rates in
// the place of accelerations.
inline Pair balance_at(const Multistep &ms, int64_t back, int64_t b) {
    const Pair total{ms.rate_sums[b], ms.rate_sums[ms.balances + b]};
    const Pair first = sum(total, Pair{rates_beside_sum(ms, back, b), 0.0});
    return product(Pair{ms.h, 0.0}, first);
}

// The sum of the rates, from the values at the oldest node, which are those of w.level.
inline void begin_rate_sums(const Multistep &ms, const Work &w) {
    for (int64_t b = 0; b < ms.balances; ++b) {
        const Pair scaled = quotient({w.level[b], w.level_carry[b]}, {ms.h, 0.0});
        const Pair first = sum(scaled, Pair{-rates_beside_sum(ms, ms.order - 1, b), 0.0});
        ms.rate_sums[b] = first.value;
        ms.rate_sums[ms.balances + b] = first.rest;
    }
}

// True if the accelerations come with the pulls from which the rates are found.
template <class AnyRun>
inline bool come_with_pulls(const AnyRun &run) {
    if constexpr (IS_SINGLE<AnyRun>)
        return run.system.rates_by_pulls && run.system.second_order;
    else
        return false;
}

// The acceleration of the next node at the predicted state y, and its rates, unless they are found from pulls. They are those
// of the acceleration that has not been corrected: what the correction changes is as large as the errors of the predictor, and
// more than the rates' own.
template <class AnyRun>
inline void accelerate_node(const AnyRun &run, double t, double *y, double *a) {
    const Multistep &ms = *run.method.multistep;
    const auto &w = run.work;
    if constexpr (IS_SINGLE<AnyRun>) {
        if (come_with_pulls(run)) return run.system.accelerate_with_pulls(w, y, a);
        if (ms.balances > 0) [[unlikely]] {
            copy(y, w.stage, w.m);
            run.system.acceleration(w, t, y, w.row(1), a);
            copy(w.stage + ms.half, w.row(1), ms.half);
            copy(a, w.row(1) + ms.half, ms.half);
            return run.system.rates(w, t, w.stage, w.row(1), ms.rates_at(ms.place[NEWEST_ROW] + 1));
        }
    }
    run.system.acceleration(w, t, y, w.row(1), a);
}

// The values of the balances `back` nodes before the newest as targets.
inline void aim_at_node(const Run &run, int64_t back) {
    const Multistep &ms = *run.method.multistep;
    for (int64_t b = 0; b < ms.balances; ++b)
        run.work.target[run.options.balances.place[b]] = balance_at(ms, back, b).value;
}

// The balances at both ends of a step that ends `back` nodes before the newest.
inline void keep_balances(const Run &run, int64_t back) {
    const Multistep &ms = *run.method.multistep;
    const Work &w = run.work;
    for (int64_t b = 0; b < ms.balances; ++b) {
        const Pair now = balance_at(ms, back, b);
        if (back + 1 < ms.order) w.level_old[b] = balance_at(ms, back + 1, b).value;
        w.level[b] = now.value;
        w.level_carry[b] = now.rest;
    }
    restore_levels(run.options.balances, w);
}

// The balances at the end of a run, `length` behind the newest node, where w.y_hat is the state and w.last() its derivative:
// the polynomial through the rates there and at the newest nodes, integrated by Gauss's formula of six points.
inline void finish_balances(const Run &run, double t, double length) {
    constexpr int64_t MOST = 12;  // points
    constexpr double FROM_MIDDLE[] = {0.1193095930415985, 0.3306046932331323, 0.4662347571015760};
    constexpr double PARTS[] = {0.2339569672863455, 0.1803807865240693, 0.0856622461895852};
    const Multistep &ms = *run.method.multistep;
    const Work &w = run.work;
    const int64_t points = std::min(MOST, ms.order + 1);
    const double share = length / ms.h;
    const auto at = [&](int64_t k) { return k == 0 ? share : static_cast<double>(1 - k); };
    double *end = w.rate(w.stages);
    run.system.rates(w, t, w.y_hat, w.last(), end);
    keep_balances(run, 0);
    copy(w.level, w.level_old, ms.balances);
    for (int64_t j = 0; j < points; ++j) {
        double weight = 0.0;
        for (int g = 0; g < 6; ++g) {
            const double place = share * (0.5 + (g % 2 ? 1.0 : -1.0) * FROM_MIDDLE[g / 2]);
            double basis = PARTS[g / 2] * length;
            for (int64_t k = 0; k < points; ++k)
                if (k != j) basis *= (place - at(k)) / (at(j) - at(k));
            weight += basis;
        }
        const double *rates = j == 0 ? end : ms.rates_at(ms.place[NEWEST_ROW] + 1 - j);
        for (int64_t b = 0; b < ms.balances; ++b) {
            const Pair sum = two_sum(w.level[b], weight * rates[b]);
            w.level[b] = sum.value;
            w.level_carry[b] += sum.rest;
        }
    }
    restore_levels(run.options.balances, w);
}

// Resets the history to what it is before the first step.
inline void forget_history(const Multistep &ms, int64_t l) {
    std::fill_n(ms.place, static_cast<int64_t>(N_NODE_PLACES), 0);
    fill(ms.levels, 0.0, 3 * l);
}

// A step of the method that starts, from (y, w.carry) at t, with the derivative in w.row(0); into w.y_hat, w.carry_hat.
template <class AnyRun>
inline void start_step(const AnyRun &run, double t, double h, const double *y) {
    const Multistep &ms = *run.method.multistep;
    const auto &w = run.work;
    const double part = h / static_cast<double>(ms.substeps);
    for (int64_t k = 0; k < ms.substeps; ++k) {
        const double here = t + static_cast<double>(k) * part;
        if (k > 0) {
            copy(w.y_hat, w.move, w.m);
            copy(w.carry_hat, w.carry, w.m);
            evaluate_f(run, here, w.move, w.row(0));
        }
        const Step step{here, here + part, part, k > 0 ? w.move : y, w.y_hat, false, false};
        if (run.method.nystrom)
            rkn_stages(run, step);
        else
            rk_stages(run, step);
        w.counters[NFEV] += run.method.stages - 1;
    }
}

// How far the invariants at the start are from the targets, into the second row of ms.levels: the mean over states as near
// as some hundred roundings, less what the gradients make of the distance. The one value at the start is off by its own
// rounding, which is more than the motion's errors come to in a long time; values on the way are off by errors of the steps,
// which differ from place to place of an orbit. What is more than rounding is a target of the user's.
template <class System, class W, class Value = typename W::Value>
inline void find_levels(System &system, const Multistep &ms, const W &w, const Value *y) {
    Value *levels = as_values<Value>(ms.levels) + w.l, *close_by = w.y_hat, *distance = w.move;
    system.grad(w, ms.t0, y, w.row(0), w.G);
    ++w.counters[NJEV];
    for (int64_t k = 0; k < LEVELS; ++k) {
        for (int64_t i = 0; i < w.m; ++i) {
            const double turn = 0.6180339887498949 * static_cast<double>(k * w.m + i + 1);
            close_by[i] = y[i] + (LEVEL_DISTANCE * (turn - std::floor(turn) - 0.5)) * y[i];
            distance[i] = close_by[i] - y[i];
        }
        system.inv(w, ms.t0, close_by, w.values);
        for (int64_t i = 0; i < w.l; ++i)
            levels[i] +=
                ((w.values[i] - w.target[i]) - dot(w.gradient(i), distance, w.m)) / static_cast<double>(LEVELS);
    }
    for (int64_t i = 0; i < w.l; ++i) {
        const Value terms = max(abs(w.values[i]), abs_dot(w.gradient(i), y, w.m));
        levels[i] = where(abs(levels[i]) < LEVEL_BANDS * EPS * terms, levels[i], 0.0);
    }
}

// The first `order` nodes, from y at the start with the derivative in w.row(0); `y` is overwritten. Of eight members what is
// not finite stays in one, and shows when that is looked at.
template <class AnyRun>
inline Code begin_history(const AnyRun &run, double *y) {
    const Multistep &ms = *run.method.multistep;
    const auto &w = run.work;
    double *S = ms.sums;
    ms.place[NEWEST_ROW] = -1;
    fill(w.carry, 0.0, w.m);
    fill(w.err_sum, 0.0, w.m);
    for (int64_t k = 0; k < ms.order; ++k) {
        if (k > 0) {
            start_step(run, ms.t0 + static_cast<double>(k - 1) * ms.h, ms.h, y);
            copy(w.y_hat, y, w.m);
            copy(w.carry_hat, w.carry, w.m);
            evaluate_f(run, ms.t0 + static_cast<double>(k) * ms.h, y, w.row(0));
        }
        if (run.system.MEMBERS == 1 && !all_finite(w.row(0), w.m)) return NOT_FINITE;
        copy(w.row(0) + ms.half, next_row(ms), ms.half);
        ++ms.place[NEWEST_ROW];
        if constexpr (IS_SINGLE<AnyRun>)
            if (ms.balances > 0)
                run.system.rates(w, ms.t0 + static_cast<double>(k) * ms.h, y, w.row(0), ms.rates_at(k));
        if (k != ms.order - 1 - ms.middle) continue;
        for (int64_t part = 0; part < 2; ++part) {
            copy(y + part * ms.half, S + 2 * part * ms.pitch, ms.half);
            copy(w.carry + part * ms.half, S + (2 * part + 1) * ms.pitch, ms.half);
        }
    }
    begin_sums(ms, ms.middle, w.stage);
    if constexpr (IS_SINGLE<AnyRun>) begin_rate_sums(ms, w);
    ms.place[NEWEST] = ms.order - 1;
    return OK;
}

// The change of the newest position by the corrector, times the Jacobian, is added to the newest acceleration; `older`
// is the older nodes' part of it.
template <class AnyRun>
inline void correct_node(const AnyRun &run, double t, double *q, const double *older, double *a) {
    const Multistep &ms = *run.method.multistep;
    const auto &w = run.work;
    const int64_t first = ms.corrected_first, end = first + ms.corrected_count;
    const double square = ms.h * ms.h, weight = ms.correction[ms.order];
    double *change = ms.change;
    for (int64_t i = first; i < end; ++i) change[i] = square * (older[i] + weight * a[i]);
    run.system.jacobian(w, t, q, change, w.f_point, end);
    // They have just been written float by float, and a load of several would wait until all those stores are done: they are
    // gathered here, for the sums to read `a` in vectors.
    const volatile double *product = w.f_point;
    for (int64_t i = first - first % WIDTH; i < end; i += WIDTH) {
        Vector added{};
        for (int k = 0; k < WIDTH; ++k)
            if (first <= i + k && i + k < end) added[k] = product[i + k];
        store(load(a + i) + added, a + i);
    }
}

// The velocities that are predicted for the next node, behind the positions y.
inline void predict_velocities(const Multistep &ms, double *y) {
    const double *s = ms.sums + 2 * ms.pitch;
    predict(latest(ms, ms.predict_v, ms.order), {ms.h, 0.0}, s, s + ms.pitch, y + ms.half);
}

// The rates of the next node to their sum; those from pulls are found here, because what has just been written is read late.
template <class AnyRun>
inline void add_rates(const AnyRun &run, double t, double *y) {
    const Multistep &ms = *run.method.multistep;
    double *rates = ms.rates_at(ms.place[NEWEST_ROW] + 1);
    if constexpr (IS_SINGLE<AnyRun>)
        if (come_with_pulls(run)) {
            if (!ms.uses_v) predict_velocities(ms, y);
            run.system.rates_from_pulls(run.work, t, y, rates);
        }
    double *s = ms.rate_sums, *s_rest = s + ms.balances;
    for (int64_t b = 0; b < ms.balances; ++b) {
        const Pair first = two_sum(s[b], rates[b]);
        s[b] = first.value;
        s_rest[b] += first.rest;
    }
}

// One more node. The positions predicted for it are in ms.predicted if it `is_predicted`, and are left there for the node
// after it if this one `predicts`.
template <class AnyRun>
inline Code add_node(const AnyRun &run, bool is_predicted, bool predicts) {
    const Multistep &ms = *run.method.multistep;
    const auto &w = run.work;
    const double t = ms.t0 + static_cast<double>(ms.place[NEWEST] + 1) * ms.h;
    double *y = ms.predicted, *older = y + 2 * ms.pitch;
    if (!is_predicted)
        predict(latest(ms, ms.predict_q, ms.order), two_product(ms.h, ms.h), ms.sums, ms.sums + ms.pitch, y);
    if (ms.uses_v || (ms.balances > 0 && !come_with_pulls(run))) predict_velocities(ms, y);
    if (ms.corrected_count > 0)
        row_sums(latest(ms, ms.correction, ms.order), older, ms.corrected_first,
                 ms.corrected_first + ms.corrected_count);
    double *a = next_row(ms);
    accelerate_node(run, t, y, a);
    ++w.counters[NFEV];
    if (run.system.MEMBERS == 1 && !is_finite_row(ms, a)) return NOT_FINITE;
    if (ms.corrected_count > 0) correct_node(run, t, y, older, a);
    if (ms.balances > 0) add_rates(run, t, y);
    ++ms.place[NEWEST_ROW];
    ++ms.place[NEWEST];
    ++ms.place[SINCE];
    predicts ? add_to_sums<true>(ms, y) : add_to_sums<false>(ms, y);
    return OK;
}

// True if the highest difference of the newest nodes is small compared with the accelerations, in each body or in all together: it
// is that of a smooth motion in steps that resolve it. Squares compared with the newest accelerations, which are almost always
// enough, cost less than norms compared with the largest ones.
template <class Value>
inline Truth<Value> is_smooth(const Multistep &ms, const Options &o, const Value *highest, int64_t half) {
    const int64_t size = o.blocks.size == 3 && half % 3 == 0 ? 3 : half;
    const auto node = [&](int64_t back) { return as_values<Value>(newest(ms) - back * ms.pitch); };
    const Value *last = node(0);
    Truth<Value> rough{};
    for (int64_t i = 0; i < half; i += size) {
        const Value square = dot(highest + i, highest + i, size), bound = dot(last + i, last + i, size);
        rough = rough | !(square < (ms.growth * ms.growth) * bound);
    }
    if (!any(rough)) return !rough;
    rough = {};
    for (int64_t i = 0; i < half; i += size) {
        Value top = 0.0;
        for (const int64_t back : {int64_t{0}, ms.middle, ms.order - 1}) top = max(top, norm(node(back) + i, size));
        rough = rough | !(norm(highest + i, size) <= ms.growth * top);
    }
    return !rough;
}

// The highest difference of the newest nodes into w.stage; whether they are smooth.
template <class W, class Value = typename W::Value>
inline Truth<Value> look_at_nodes(const Multistep &ms, const Options &o, const W &w) {
    weighted_sum(1.0, latest(ms, ms.size, ms.order + 1), as_floats(w.stage), ms.half);
    return is_smooth(ms, o, w.stage, w.m / 2);
}

// The shape of the steps' errors into w.err_sum, collected over the last turns, and their size now, which counts where the
// history is smooth; whether it is.
template <class W, class Value = typename W::Value>
inline Truth<Value> estimate_nodes(const Multistep &ms, const Options &o, Value &size, const W &w) {
    const int64_t half = w.m / 2, n = ms.order + 1;
    Value *shape = w.move;
    const Truth<Value> smooth = look_at_nodes(ms, o, w);
    weighted_sum(ms.h * ms.h, latest(ms, ms.shape_q, n), as_floats(shape), ms.half);
    weighted_sum(ms.h, latest(ms, ms.shape_v, n), as_floats(shape + half), ms.half);
    const Value *last = as_values<Value>(newest(ms)), *before = as_values<Value>(newest(ms) - ms.pitch);
    for (int64_t i = 0; i < half; ++i) w.f_point[i] = last[i] - before[i];
    const Value faster = norm(shape + half, half) * norm(last, half) * ms.h;
    const Value slower = norm(shape, half) * norm(w.f_point, half);
    const Value part = where(faster > 0.0, min(Value(1.0), slower / faster), 1.0);
    for (int64_t i = half; i < w.m; ++i) shape[i] *= part;
    const Value lower = norm(shape, half), upper = ms.h * ms.h * norm(w.stage, half);
    size = where(lower > 0.0, ms.error_constant * upper / lower, 0.0);
    for (int64_t i = 0; i < w.m; ++i) w.err_sum[i] = MEMORY * w.err_sum[i] + abs(shape[i]);
    ++ms.place[SEEN];
    return smooth;
}

// Computes how far the values w.values are from those at the start, into w.target.
template <class W>
inline void residuals_of_values(const Multistep &ms, const W &w) {
    const auto *levels = as_values<typename W::Value>(ms.levels);
    for (int64_t i = 0; i < w.l; ++i) w.target[i] = (w.values[i] - levels[i]) - levels[w.l + i];
}

// (w.y_hat, w.carry_hat): the newest state, with the gradients there in w.G.
template <class AnyRun>
inline void newest_state(const AnyRun &run, double t) {
    const Multistep &ms = *run.method.multistep;
    const auto &w = run.work;
    state_of(ms, 0, as_floats(w.y_hat), as_floats(w.carry_hat));
    slope_of(ms, 0, as_floats(w.y_hat), as_floats(w.last()));
    gradients(run, t, w.y_hat, w.last(), w.G);
    ++w.counters[NJEV];
}

// Computes the corrections required at the newest state, into w.target: the residuals in the middle of the history, where the formula for
// the state is the most accurate. Values at the newest state are left in w.values. (scratch, w.carry) is the state in the
// middle, and w.Q the gradients there.
template <class AnyRun, class Value>
inline void residuals_in_the_middle(const AnyRun &run, double t, Value *scratch) {
    const Multistep &ms = *run.method.multistep;
    const auto &w = run.work;
    const double before = ms.t0 + static_cast<double>(ms.place[NEWEST] - ms.middle) * ms.h;
    state_of(ms, ms.middle, as_floats(scratch), as_floats(w.carry));
    slope_of(ms, ms.middle, as_floats(scratch), as_floats(w.f_point));
    gradients(run, before, scratch, w.f_point, w.Q);
    ++w.counters[NJEV];
    evaluate_carried(run, before, scratch, w.carry, w.Q);
    residuals_of_values(ms, w);
    evaluate_invariants(run, t, w.y_hat);
}

// Before a projection of w.y_hat by the residuals in w.target, with the targets in the first row of ms.levels: of a residual as
// small as its rounding only a part is to be taken, the less the smaller it is, because each correction turns the orbit a
// little, in a direction that no invariant holds. What is left goes into the third row.
template <class W>
inline void soften_residuals(const Multistep &ms, const Options &o, const W &w) {
    using Value = typename W::Value;
    Value *levels = as_values<Value>(ms.levels), *left = levels + 2 * w.l;
    for (int64_t i = 0; i < w.l; ++i) {
        const Value residual = w.target[i], square = residual * residual;
        Value part = 1.0;
        if (o.balance_groups.count == 0) {
            const Value noise = EPS * abs_dot(w.gradient(i), w.y_hat, w.m);
            part = where(square > 0.0, square / (square + noise * noise), 0.0);
        }
        w.target[i] = w.values[i] - part * residual;
        left[i] = (residual - part * residual) + levels[w.l + i];
    }
}

// To be called after the projection that `soften_residuals` has prepared: restores the targets, and records what was left
// of the residuals. `those`: the members that were projected.
template <class W>
inline void note_what_is_left(const Multistep &ms, const Truth<typename W::Value> &those, const W &w) {
    using Value = typename W::Value;
    const Value *levels = as_values<Value>(ms.levels), *left = levels + 2 * w.l;
    copy(levels, w.target, w.l);
    for (int64_t i = 0; i < w.l; ++i) {
        w.residual[i] += left[i];
        w.max_residual[i] = where(those, max(w.max_residual[i], abs(w.residual[i])), w.max_residual[i]);
    }
}

// Projects between `soften_residuals` and `note_what_is_left`.
inline Code project_softly(const Run &run, const Step &step) {
    const Multistep &ms = *run.method.multistep;
    soften_residuals(ms, run.options, run.work);
    const Code status = project_evaluated(run, step);
    note_what_is_left(ms, true, run.work);
    return status;
}

// The estimates of errors into w.err, `since` nodes after the last projection.
template <class Value, class W>
inline void gather_errors(const Value &size, const Value &since, const W &w) {
    const Value factor = size * sqrt(1.0 + since);
    for (int64_t i = 0; i < w.m; ++i) w.err[i] = factor * w.err_sum[i];
    w.counters[HAVE_ERROR] = 1;
    w.counters[WAITED] = 0;
}

// Adds the correction w.move to the sums, for the members `those`.
template <class W>
inline void move_sums(const Multistep &ms, const Truth<typename W::Value> &those, const W &w) {
    using Value = typename W::Value;
    const int64_t half = w.m / 2;
    const auto row = [&](int64_t k) { return as_values<Value>(ms.sums + k * ms.pitch); };
    Value *S = row(0), *S_rest = row(1), *s = row(2), *s_rest = row(3);
    for (int64_t i = 0; i < half; ++i) {
        const Value kick = w.move[half + i] / ms.h, shift = w.move[i] / (ms.h * ms.h) + kick;
        const PairOf<Value> first = two_sum(s[i], kick), second = two_sum(S[i], shift);
        s[i] = where(those, first.value, s[i]);
        s_rest[i] = where(those, s_rest[i] + first.rest, s_rest[i]);
        S[i] = where(those, second.value, S[i]);
        S_rest[i] = where(those, S_rest[i] + second.rest, S_rest[i]);
    }
}

// Projects the newest state and adds the correction to the sums; the accelerations of the history remain unchanged.
[[gnu::noinline]] inline Code project_nodes(const Run &run, double *scratch) {
    const Multistep &ms = *run.method.multistep;
    const Options &o = run.options;
    const auto &w = run.work;
    const bool examined =
        o.balance_groups.count == 0 || ms.place[SEEN] < COLLECTED || ms.place[SEEN] % EXAMINED_EACH == 0;
    double size = 0.0;
    if (!(examined ? estimate_nodes(ms, o, size, w) : look_at_nodes(ms, o, w))) return UNSTABLE;
    ms.place[SEEN] += !examined;
    if (w.l == 0 || ms.place[SEEN] <= COLLECTED) return OK;
    const double t = ms.t0 + static_cast<double>(ms.place[NEWEST]) * ms.h;
    if (examined) gather_errors(size, static_cast<double>(ms.place[SINCE]), w);
    w.counters[HAVE_ERROR] = w.counters[F_AT_RAW] = examined;
    w.counters[WAITED] = 0;
    newest_state(run, t);
    note_rates(run, Step{t, t, ms.h, w.y_hat, scratch, true, true});
    if (o.every == AUTO && o.balance_groups.count == 0 && !tells_more(w)) return OK;
    aim_at_node(run, ms.middle);
    copy(w.target, ms.levels, w.l);
    residuals_in_the_middle(run, t, scratch);
    const int64_t before = w.counters[PROJECTIONS];
    const Code status = project_softly(run, Step{t, t, ms.h, w.y_hat, scratch, true, true});
    if (status != OK) return status;
    ms.place[SINCE] = 0;
    if (w.counters[PROJECTIONS] > before) move_sums(ms, true, w);
    return OK;
}

// A look at the history, and the projection of the last state, w.y_hat, which a step from `from` has made.
inline Code project_last(const Run &run, const Step &step, double from) {
    const Multistep &ms = *run.method.multistep;
    const auto &w = run.work;
    if (ms.brief) {
        estimate_error(run, Step{from, step.t_new, step.h, step.y_new, step.y_new, true, true});
        w.counters[HAVE_ERROR] = 1;
    } else {
        double size;
        if (!estimate_nodes(ms, run.options, size, w)) return UNSTABLE;
        gather_errors(size, static_cast<double>(ms.place[SINCE]), w);
    }
    if (w.l == 0) return OK;
    gradients(run, step.t_new, w.y_hat, w.last(), w.G);
    w.counters[F_AT_RAW] = 1;
    note_rates(run, step);
    evaluate_invariants(run, step.t_new, w.y_hat);
    ++w.counters[NJEV];
    copy(w.target, ms.levels, w.l);
    residuals_of_values(ms, w);
    const Code status = project_softly(run, step);
    if (status != OK || run.options.reuse_f) return status;
    evaluate_f(run, step.t_new, step.y_new, w.last());
    return OK;
}

// The state at t, beyond what the history can be centred on, by the method that starts: from the middle of the history, or
// in a run without one from y at t_old; step.h is the length from there. The last one is projected.
[[gnu::noinline]] inline Code finish_nodes(const Run &run, const Step &step) {
    const Multistep &ms = *run.method.multistep;
    const auto &w = run.work;
    double from = step.t;
    if (!ms.brief) {
        state_of(ms, ms.middle, step.y_new, w.carry);
        slope_of(ms, ms.middle, step.y_new, w.row(0));
        from = ms.t0 + static_cast<double>(ms.place[NEWEST] - ms.middle) * ms.h;
    } else {
        copy(step.y, step.y_new, w.m);
    }
    start_step(run, from, step.h, step.y_new);
    if (!all_finite(w.y_hat, w.m)) return NOT_FINITE;
    evaluate_f(run, step.t_new, w.y_hat, w.last());
    Code status = OK;
    copy(w.y_hat, step.y_new, w.m);
    if (step.last && ms.balances > 0)
        finish_balances(run, step.t_new, step.t_new - (ms.t0 + static_cast<double>(ms.place[NEWEST]) * ms.h));
    if (step.last) status = project_last(run, Step{step.t, step.t_new, step.h, w.y_hat, step.y_new, true, true}, from);
    copy(w.carry_hat, w.carry, w.m);
    return status;
}

// Operations of a run of one state in addition to adding nodes.
struct OneState {
    const Run &run;
    double *scratch;

    // Balances begin at their values, which a projection of their own does not take as rounded.
    void begin(const double *y) const {
        if (run.options.balance_groups.count == 0) find_levels(run.system, *run.method.multistep, run.work, y);
    }
    Code look() const { return look_at_nodes(*run.method.multistep, run.options, run.work) ? OK : UNSTABLE; }
    Code project() const { return project_nodes(run, scratch); }
    Code finish(const Step &step) const { return finish_nodes(run, step); }
};

// The history up to node `last`; `states` as OneState. Each node is among those of a look or of a projection.
template <class States>
inline Code advance_history(const States &states, int64_t last) {
    const auto &run = states.run;
    const Multistep &ms = *run.method.multistep;
    bool predicted = false;
    while (ms.place[NEWEST] < last) {
        const int64_t next = ms.place[NEWEST] + 1;
        const bool projects = next % ms.spacing == 0, predicts = !projects && next < last;
        Code status = add_node(run, predicted, predicts);
        if (status != OK) return status;
        predicted = predicts;
        if (projects)
            status = states.project();
        else if (next % ms.order == 0)
            status = states.look();
        if (status != OK) return status;
    }
    return OK;
}

// From the state y at step k to that at step `stop`, whose derivative is left in w.last(). The last step of a run is never a
// node: it may be shorter.
template <class States>
inline Code next_states(const States &states, const Span &span, double *clock, int64_t k, int64_t stop, const double *y,
                        double *y_new) {
    const auto &run = states.run;
    const Multistep &ms = *run.method.multistep;
    const auto &w = run.work;
    int64_t *place = ms.place;
    const int64_t last_node = span.n_steps - 1;
    const bool last = stop >= span.n_steps;
    clock[TIME] = span.t0 + static_cast<double>(k) * span.h;
    clock[TIME_NEW] = last ? span.t_bound : span.t0 + static_cast<double>(stop) * span.h;
    clock[LENGTH] = span.between(k, stop);
    const Step step{clock[TIME], clock[TIME_NEW], clock[LENGTH], y, y_new, last, last};
    if (ms.brief) {
        w.counters[WAITED] = k;
        return states.finish(step);
    }
    if (!place[HAVE_NODES]) {
        if (w.l > 0) states.begin(y);
        copy(y, y_new, w.m);
        const Code status = begin_history(run, y_new);
        if (status != OK) return status;
        place[HAVE_NODES] = 1;
    }
    const int64_t ahead = ms.level ? 0 : ms.middle;
    const Code status = advance_history(states, std::min(stop + ahead, last_node));
    if (status != OK) return status;
    const int64_t back = place[NEWEST] - stop;
    if constexpr (IS_SINGLE<decltype(run)>)
        if (ms.balances > 0 && !last) keep_balances(of_any_length(run), back);
    if (last || back < ahead) {
        const double length = span.between(place[NEWEST] - ms.middle, stop);
        return states.finish(Step{step.t, step.t_new, length, y, y_new, last, last});
    }
    state_of(ms, back, y_new, w.carry_hat);
    if (run.system.MEMBERS == 1 && !all_finite(y_new, w.m)) return NOT_FINITE;
    slope_of(ms, back, y_new, w.last());
    return OK;
}

}  // namespace eip
