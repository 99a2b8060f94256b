// Roots of events.
#pragma once

#include <cmath>

#include "data.hpp"

namespace eip {

constexpr double ROOT_TOLERANCE = 4.0 * EPS;  // of the step's length, and relative to the time
constexpr int MAX_ROOT_STEPS = 100;

// A root of f between a and b, where its values fa and fb differ in sign; NaN where f is. Brent's method, each operation as in
// scipy.optimize.brentq, and bisection where that does not converge, as at a zero of high multiplicity. `length` is that of the step, whatever the unit of time: SciPy's
// absolute tolerance of 9e-16 would be all of a step of 1e-15.
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

}  // namespace eip
