// Sums that carry their rounding along: states as pairs of floats.
#pragma once

#include "data.hpp"
#include "two_floats.hpp"

namespace eip {

// y + carry + h sum_j (b + b_low)[j] rate(j), rounded once to two floats.
template <class Rate>
[[gnu::always_inline]] inline Pair compensated_sum(double y, double carry, double h, const Method &m,
                                                   const Rate &rate) {
    double main = 0.0, low = 0.0;
    for (int64_t j = 0; j < m.stages; ++j) {
        const double f = rate(j);
        main += m.b[j] * f;
        low += m.b_low[j] * f;
    }
    const Pair increment = two_product(h, main), s = two_sum(y, increment.value);
    return two_sum(s.value, s.rest + (increment.rest + h * low + carry));
}

// (y_hat, carry_hat), the end of a step from y.
template <class W>
inline void compensated_step(const double *y, double h, const Method &m, const W &w) {
    for (int64_t i = 0; i < w.m; ++i) {
        const Pair sum = compensated_sum(y[i], w.carry[i], h, m, [&](int64_t j) { return w.row(j)[i]; });
        w.y_hat[i] = sum.value;
        w.carry_hat[i] = sum.rest;
    }
}

// Computes the values of the balances at the end of the step, in the same way; these values become the targets.
template <class W>
inline void compensated_levels(double h, const Method &m, const Balances &balances, const W &w) {
    for (int64_t b = 0; b < w.balances; ++b) {
        const auto rate = [&](int64_t j) { return balances.rated[j] ? w.rate(j)[b] : 0.0; };
        const Pair sum = compensated_sum(w.level[b], w.level_carry[b], h, m, rate);
        w.target[balances.place[b]] = sum.value;
        w.level_carry_new[b] = sum.rest;
    }
}

// The balances at the end of a step that is accepted.
template <class W>
inline void keep_levels(const Balances &balances, const W &w) {
    copy(w.level, w.level_old, w.balances);
    for (int64_t b = 0; b < w.balances; ++b) w.level[b] = w.target[balances.place[b]];
    copy(w.level_carry_new, w.level_carry, w.balances);
}

// The targets of the balances at the current state, after a step that was not accepted.
template <class W>
inline void restore_levels(const Balances &balances, const W &w) {
    for (int64_t b = 0; b < w.balances; ++b) w.target[balances.place[b]] = w.level[b];
}

// Does what `compensated_step` does for a Nystrom method: q + h v + h^2 sum_j (b + b_low)[j] a_j, and for the
// velocities v + h sum_j (b_v + b_v_low)[j] a_j.
template <class W>
inline void compensated_nystrom(const double *y, double h, const Method &m, const W &w) {
    const int64_t half = w.m / 2;
    for (int64_t i = 0; i < half; ++i) {
        const int64_t k = half + i;
        double place = 0.0, place_low = 0.0, speed = 0.0, speed_low = 0.0;
        for (int64_t j = 0; j < m.stages; ++j) {
            const double a = w.row(j)[k];
            place += m.b[j] * a;
            place_low += m.b_low[j] * a;
            speed += m.b_v[j] * a;
            speed_low += m.b_v_low[j] * a;
        }
        const Pair drift = two_product(h, y[k]), half_kick = two_product(h, place);
        const Pair kick = two_product(h, half_kick.value);
        const double rest = drift.rest + kick.rest + h * (w.carry[k] + half_kick.rest + h * place_low) + w.carry[i];
        const Pair first = two_sum(y[i], drift.value), second = two_sum(first.value, kick.value);
        const Pair q = two_sum(second.value, first.rest + second.rest + rest);
        w.y_hat[i] = q.value;
        w.carry_hat[i] = q.rest;
        const Pair increment = two_product(h, speed), s = two_sum(y[k], increment.value);
        const Pair v = two_sum(s.value, s.rest + (increment.rest + h * speed_low + w.carry[k]));
        w.y_hat[k] = v.value;
        w.carry_hat[k] = v.rest;
    }
}

// y + carry += move, in place.
inline void compensated_add(double *y, double *carry, const double *move, int64_t n) {
    for (int64_t i = 0; i < n; ++i) {
        const Pair s = two_sum(y[i], move[i]), sum = two_sum(s.value, s.rest + carry[i]);
        y[i] = sum.value;
        carry[i] = sum.rest;
    }
}

}  // namespace eip
