// Roots of events, and the points within a step between which an event changes its sign more often than its ends show.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <utility>

#include "data.hpp"

namespace eip {

constexpr double ROOT_TOLERANCE = 4.0 * EPS;  // of the step's length, and relative to the time
constexpr int MAX_ROOT_STEPS = 100;

// A root of f between a and b, where its values fa and fb differ in sign; NaN where f is. Brent's method, each operation as in
// scipy.optimize.brentq, and bisection where that does not converge, as at a zero of high multiplicity. `length` is that of
// the step, whatever the unit of time: SciPy's absolute tolerance of 9e-16 would be all of a step of 1e-15.
template <class Function>
inline double root_between(double length, double a, double fa, double b, double fb, Function f) {
    if (fa == 0.0) return a;
    double before = a, f_before = fa, best = b, f_best = fb, other = 0.0, f_other = 0.0;
    double last = 0.0, move = 0.0;  // the two moves made last
    for (int k = 0; k < MAX_ROOT_STEPS; ++k) {
        if (f_before != 0.0 && f_best != 0.0 && std::signbit(f_before) != std::signbit(f_best)) {
            other = before;
            f_other = f_before;
            last = move = best - before;
        }
        if (std::abs(f_other) < std::abs(f_best)) {
            before = best;
            best = other;
            other = before;
            f_before = f_best;
            f_best = f_other;
            f_other = f_before;
        }
        const double tolerance = ROOT_TOLERANCE * (length + std::abs(best)) / 2.0, half = (other - best) / 2.0;
        if (f_best == 0.0 || std::abs(half) < tolerance) return best;
        double next = half;
        if (std::abs(last) > tolerance && std::abs(f_best) < std::abs(f_before)) {
            if (before == other) {
                next = -f_best * (best - before) / (f_best - f_before);
            } else {
                const double slope_before = (f_before - f_best) / (before - best);
                const double slope_other = (f_other - f_best) / (other - best);
                next = -f_best * (f_other * slope_other - f_before * slope_before) /
                       (slope_other * slope_before * (f_other - f_before));
            }
            const bool short_enough = 2.0 * std::abs(next) < std::min(std::abs(last), 3.0 * std::abs(half) - tolerance);
            last = short_enough ? move : half;
            move = short_enough ? next : half;
        } else {
            last = move = half;
        }
        before = best;
        f_before = f_best;
        best += std::abs(move) > tolerance ? move : half > 0.0 ? tolerance : -tolerance;
        f_best = f(best);
        if (std::isnan(f_best)) return f_best;
    }
    if (std::signbit(f_before) != std::signbit(f_best)) other = before;
    while (std::abs(other - best) >= ROOT_TOLERANCE * (length + std::abs(best))) {
        const double middle = best + (other - best) / 2.0, value = f(middle);
        if (std::isnan(value)) return value;
        if (value == 0.0) return middle;
        (std::signbit(value) == std::signbit(f_best) ? best : other) = middle;
    }
    return best;
}

constexpr int MOST_CROSSINGS = 3;          // that are looked for in a step, of each event
constexpr double SLOPE_PART = 1.0 / 4096;  // of the step, over which the slope of an event is taken
constexpr double REACH = 4.0;              // slopes times the step: a larger value does not reach zero
constexpr int MAX_SEARCHES = 40;           // values in one search for an extremum
constexpr double SEARCH_TOLERANCE = 1e-9;  // of the step
constexpr double VERTEX_ERROR = 0.25;      // of a parabola's vertex, relative to the distance of its points

// The values of an event at both ends of a step, and its slopes there times the step's length.
struct EventEnds {
    double old, now, slope_old, slope;
};

// A time as a fraction of the step, and the value there.
struct EventPoint {
    double theta, value;
};

struct EventPoints {
    std::array<EventPoint, 2> point{};
    int count = 0;
    void add(const EventPoint &p) { point[count++] = p; }
};

// The extrema inside the step of the cubic through these values and slopes, in order, and which of them are minima.
struct Turns {
    double theta[2] = {0.0, 0.0};
    bool minimum[2] = {false, false};
    int count = 0;
};

inline Turns turns_of(const EventEnds &e) {
    const double change = e.now - e.old;
    const double a = 3.0 * change - 2.0 * e.slope_old - e.slope, b = e.slope_old + e.slope - 2.0 * change;
    Turns turns;
    const double square = a * a - 3.0 * b * e.slope_old;  // of the slope slope_old + 2 a theta + 3 b theta^2
    if (!(square > 0.0)) return turns;
    const double q = -(a + std::copysign(std::sqrt(square), a));
    double first = q == 0.0 ? NOT_A_NUMBER : e.slope_old / q, second = b == 0.0 ? NOT_A_NUMBER : q / (3.0 * b);
    if (second < first) std::swap(first, second);
    for (const double theta : {first, second}) {
        if (!(0.0 < theta && theta < 1.0)) continue;
        turns.theta[turns.count] = theta;
        turns.minimum[turns.count++] = a + 3.0 * b * theta > 0.0;
    }
    return turns;
}

// Says whether the ends of a step leave it open how often the event crosses zero inside.
inline bool may_cross_inside(const EventEnds &e) {
    if (e.old == 0.0 || e.now == 0.0) return turns_of(e).count > 0;
    if ((e.old < 0.0) != (e.now < 0.0)) {  // three times, where it rises at both ends, or falls, but turns between them
        const bool along = (e.slope_old > 0.0) == (e.now > 0.0) && (e.slope > 0.0) == (e.now > 0.0);
        return along && turns_of(e).count == 2;
    }
    const double slope = std::max(std::abs(e.slope_old), std::abs(e.slope));
    if (!(REACH * slope >= std::min(std::abs(e.old), std::abs(e.now)))) return false;
    const Turns turns = turns_of(e);
    for (int k = 0; k < turns.count; ++k)
        if (turns.minimum[k] == (e.old > 0.0)) return true;
    return false;
}

// The first point found between a and b where sign * g is below zero, or the one where it is lowest: Brent's search for a
// minimum (1973, chapter 5) from `theta` on, given up where a parabola says that it stays above zero.
template <class Function>
inline EventPoint lowest(double sign, double a, double b, double theta, Function g) {
    constexpr double GOLDEN = 0.3819660112501051;
    double x = theta, w = theta, v = theta, move = 0.0, before = 0.0;
    double fx = sign * g(x), fw = fx, fv = fx;
    for (int k = 1; k < MAX_SEARCHES && fx >= 0.0; ++k) {
        const double middle = 0.5 * (a + b);
        if (std::abs(x - middle) + 0.5 * (b - a) <= 2.0 * SEARCH_TOLERANCE) break;
        bool golden = true;
        double next = 0.0;
        if (k > 2) {
            const double r = (x - w) * (fx - fv), q = (x - v) * (fx - fw);
            double p = (x - v) * q - (x - w) * r, s = 2.0 * (q - r);
            if (s > 0.0) p = -p;
            s = std::abs(s);
            const bool inside = s > 0.0 && p > s * (a - x) && p < s * (b - x);
            const double bend = ((fv - fx) / (v - x) - (fw - fx) / (w - x)) / (v - w);
            const double spread = std::max({std::abs(x - w), std::abs(x - v), std::abs(v - w)});
            const double farthest = std::abs(p / s) + VERTEX_ERROR * spread;
            if (inside && bend * farthest * farthest < fx) break;
            if (inside && std::abs(p) < std::abs(0.5 * s * before)) {
                before = move;
                next = p / s;
                golden = false;
            }
        }
        if (golden) {
            before = (x < middle ? b : a) - x;
            next = GOLDEN * before;
        }
        move = std::abs(next) >= SEARCH_TOLERANCE ? next : std::copysign(SEARCH_TOLERANCE, next);
        const double u = x + move, fu = sign * g(u);
        if (std::isnan(fu)) break;
        if (fu <= fx) {
            (u < x ? b : a) = x;
            v = std::exchange(w, std::exchange(x, u));
            fv = std::exchange(fw, std::exchange(fx, fu));
        } else {
            (u < x ? a : b) = u;
            if (fu <= fw || w == x) {
                v = std::exchange(w, u);
                fv = std::exchange(fw, fu);
            } else if (fu <= fv || v == x || v == w) {
                v = u;
                fv = fu;
            }
        }
    }
    return {x, sign * fx};
}

// Points inside the step between which the event changes its sign more often than the ends say; none where it does not.
template <class Function>
inline EventPoints points_inside(const EventEnds &e, Function g) {
    EventPoints found;
    const Turns turns = turns_of(e);
    if (e.old == 0.0 || e.now == 0.0) {
        for (int k = 0; k < turns.count; ++k)
            if (const double value = g(turns.theta[k]); value != 0.0) found.add({turns.theta[k], value});
        return found;
    }
    const double sign = e.old > 0.0 ? 1.0 : -1.0;
    if ((e.old < 0.0) != (e.now < 0.0)) {
        if (turns.count < 2) return found;
        const EventPoint over = lowest(sign, 0.0, turns.theta[1], turns.theta[0], g);
        if (!(sign * over.value < 0.0)) return found;
        const EventPoint back = lowest(-sign, over.theta, 1.0, turns.theta[1], g);
        if (!(sign * back.value > 0.0)) return found;
        found.add(over);
        found.add(back);
        return found;
    }
    for (int k = 0; k < turns.count; ++k) {
        if (turns.minimum[k] != (e.old > 0.0)) continue;
        const double a = k == 1 ? turns.theta[0] : 0.0, b = k == 0 && turns.count == 2 ? turns.theta[1] : 1.0;
        const EventPoint point = lowest(sign, a, b, turns.theta[k], g);
        if (sign * point.value < 0.0) found.add(point);
    }
    return found;
}

}  // namespace eip
