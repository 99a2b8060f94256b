// Gradients by central differences of order 6; `difference_gradient` in core/invariants.py computes the same bits.
#pragma once

#include <algorithm>
#include <limits>
#include <vector>

#include "data.hpp"
#include "floats.hpp"

namespace eip {

// The longest shift, in units of a component's size, and how much shorter each further one is.
constexpr double FIRST_SHIFT = 5e-3, SHORTER = 1.0 / 16.0;
constexpr int MOST_SHIFTS = 7;
constexpr int64_t PAIRS = 3;
// Weights of the differences over one, two and three shifts to either side, of order 6 and of order 4.
constexpr double ORDER_6[] = {3.0 / 4.0, -3.0 / 20.0, 1.0 / 60.0}, ORDER_4[] = {2.0 / 3.0, -1.0 / 12.0, 0.0};
// How far both orders may differ: in units of the derivative, and of the rounding of the values.
constexpr double DIFFER = 1e-8, ROUNDINGS = 1e3, LEAST = std::numeric_limits<double>::min();

// Description of a state: its floats, how many of them are a component, below what size each is shifted as if it had that size.
struct Shifts {
    int64_t m = 0, width = 1;
    const double *floors = nullptr;
    std::vector<double> state, values, sums;
};

// The length of the first shift of a float: a power of two, so that both ends lie as far apart as it says.
inline double first_shift(const double *y, int64_t j, const Shifts &s) {
    const int64_t k = j / s.width;
    const double size = s.width == 1 ? std::abs(y[k]) : std::hypot(y[2 * k], y[2 * k + 1]);
    return std::exp2(std::nearbyint(std::log2(FIRST_SHIFT * (size + s.floors[k]))));
}

// The sums over all shifts into s.sums; returns by how much more than they may both orders differ, NaN where a value is.
template <class Values>
inline double shifted_sums(const Values &values_at, const double *y, int64_t j, double shift, int64_t l, Shifts &s) {
    double *ends = s.values.data(), *sums = s.sums.data(), worst = 0.0;
    for (int64_t i = 0; i < PAIRS; ++i)
        for (int64_t side = 0; side < 2; ++side) {
            copy(y, s.state.data(), s.m);
            s.state[j] = side ? y[j] - static_cast<double>(i + 1) * shift : y[j] + static_cast<double>(i + 1) * shift;
            values_at(s.state.data(), ends + (2 * i + side) * l);
        }
    for (int64_t k = 0; k < l; ++k) {
        double lower = 0.0, largest = 0.0;
        sums[k] = 0.0;
        for (int64_t i = 0; i < PAIRS; ++i) {
            const double above = ends[2 * i * l + k], below = ends[(2 * i + 1) * l + k];
            sums[k] += ORDER_6[i] * (above - below);
            lower += ORDER_4[i] * (above - below);
            largest = std::max(largest, std::max(std::abs(above), std::abs(below)));
        }
        const double allowed = DIFFER * std::abs(sums[k]) + ROUNDINGS * EPS * largest + LEAST;
        const double excess = std::abs(sums[k] - lower) / allowed;
        if (!(excess <= worst)) worst = excess;  // NaN too, which stays
        if (std::isnan(worst)) break;
    }
    return worst;
}

// Rows G (l, m) of the gradients at y of the invariants that ``values_at(state, out)`` puts into out (l,).
//
// The shifts are shortened until both orders agree, which they do not at first next to a singularity that is nearer than
// the state's size; if they never do, the shift at which the orders agree best is taken. A shift that reaches
// about as far as the singularity agrees worse than a longer one, so that the search must not end there.
template <class Values>
inline void difference_gradient(const Values &values_at, const double *y, int64_t l, Shifts &s, double *G) {
    s.values.resize(2 * PAIRS * l);
    s.sums.resize(l);
    for (int64_t j = 0; j < s.m; ++j) {
        double shift = first_shift(y, j, s), least = ENDLESS;
        for (int64_t k = 0; k < l; ++k) G[k * s.m + j] = NOT_A_NUMBER;
        for (int tries = 0; tries < MOST_SHIFTS; ++tries, shift *= SHORTER) {
            const double excess = shifted_sums(values_at, y, j, shift, l, s);
            if (excess < least) {
                least = excess;
                for (int64_t k = 0; k < l; ++k) G[k * s.m + j] = s.sums[k] / shift;
            }
            if (least <= 1.0) break;
        }
    }
}

// Times at which derivatives in time are taken: the interval of the run, which they do not leave, and the shift, a power of two.
struct Times {
    double low = 0.0, high = 0.0, shift = 0.0;
    std::vector<double> values;
};

constexpr int64_t ONE_SIDED = 6;
constexpr double TO_ONE_SIDE[] = {-49.0 / 20.0, 6.0, -15.0 / 2.0, 20.0 / 3.0, -15.0 / 4.0, 6.0 / 5.0, -1.0 / 6.0};

// The derivative in time of `l` values by differences of order 6, to one side next to an end of the interval. It is exactly
// zero where the values at the two or three outermost times are equal: the others are not looked at then.
template <class Values>
[[gnu::noinline]] inline void time_difference(const Values &values_at, double t, int64_t l, Times &times, double *out) {
    fill(out, 0.0, l);
    if (!(times.shift > 0.0)) return;
    times.values.resize((ONE_SIDED + 1) * l);
    double *values = times.values.data();
    const double reach = PAIRS * times.shift;
    const bool central = t - reach >= times.low && t + reach <= times.high;
    const double shift = central || times.high - t >= t - times.low ? times.shift : -times.shift;
    const auto evaluate = [&](int64_t k) {
        values_at(t + static_cast<double>(central ? k - PAIRS : k) * shift, values + k * l);
    };
    evaluate(0);
    evaluate(ONE_SIDED);
    bool changes = !std::equal(values, values + l, values + ONE_SIDED * l);
    if (!central) {
        evaluate(1);
        changes = changes || !std::equal(values, values + l, values + l);
    }
    if (!changes) return;
    for (int64_t k = central ? 1 : 2; k < ONE_SIDED; ++k)
        if (!central || k != PAIRS) evaluate(k);
    for (int64_t i = 0; i < l; ++i) {
        double sum = 0.0;
        for (int64_t k = 0; central && k < PAIRS; ++k)
            sum += ORDER_6[k] * (values[(PAIRS + 1 + k) * l + i] - values[(PAIRS - 1 - k) * l + i]);
        for (int64_t k = 1; !central && k <= ONE_SIDED; ++k) sum += TO_ONE_SIDE[k] * (values[k * l + i] - values[i]);
        out[i] = sum / shift;
    }
}

}  // namespace eip
