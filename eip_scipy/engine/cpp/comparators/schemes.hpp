// One step of each scheme of fixed step: y <- y(t + h), and whether there is one. `evaluations` counts calls of the user's
// function.
#pragma once

#include <cmath>
#include <limits>
#include <vector>

#include "../system.hpp"

namespace eip {

// Functions that the schemes call; `f` and `stage` are their buffers.
struct Callee {
    System &system;
    const Work &work;
    int64_t evaluations = 0;

    double *f() const { return work.K; }
    double *stage() const { return work.stage; }
    // Into f, at a state that is kept.
    void operator()(double t, const double *y) {
        system.rhs(work, t, y, f());
        ++evaluations;
    }
    // Into f, at what is in `stage`, which may be changed.
    void at_stage(double t) {
        system.rhs_of_scratch(work, t, stage(), f());
        ++evaluations;
    }
};

// x += c dx.
inline void add(double *x, double c, const double *dx, int64_t n) {
    for (int64_t i = 0; i < n; ++i) x[i] += c * dx[i];
}

// Stoermer-Verlet for y = (q, v), in both forms; f holds (v, a).
struct KickDriftKick {
    Callee &callee;

    // The accelerations at y stand in f already.
    bool step(double t, double h, double *y) {
        const int64_t half = callee.work.m / 2;
        double *q = y, *v = y + half;
        const double *a = callee.f() + half;
        add(v, 0.5 * h, a, half);
        add(q, h, v, half);
        callee(t + h, y);
        add(v, 0.5 * h, a, half);
        return true;
    }
};

struct DriftKickDrift {
    Callee &callee;

    bool step(double t, double h, double *y) {
        const int64_t half = callee.work.m / 2;
        double *q = y, *v = y + half;
        add(q, 0.5 * h, v, half);
        callee(t + 0.5 * h, y);
        add(v, h, callee.f() + half, half);
        add(q, 0.5 * h, v, half);
        return true;
    }
};

// For a charged particle y = (x, v) in fields f = (E, B): half a step along v, half of the electric kick, a rotation
// around B, and the halves once more.
struct Boris {
    Callee &callee;
    double charge_by_mass;

    bool step(double t, double h, double *y) {
        const double half = 0.5 * h, kick = charge_by_mass * half;
        const double *E = callee.f(), *B = E + 3;
        add(y, half, y + 3, 3);
        for (int i = 0; i < 3; ++i) callee.stage()[i] = y[i];
        callee.at_stage(t + half);
        const double u = y[3] + kick * E[0], v = y[4] + kick * E[1], w = y[5] + kick * E[2];
        const double a = kick * B[0], b = kick * B[1], c = kick * B[2];
        const double s = 2.0 / (1.0 + a * a + b * b + c * c);
        // v' = v + v x t, then v + v' x s.
        const double p = u + v * c - w * b;
        const double q = v + w * a - u * c;
        const double r = w + u * b - v * a;
        y[3] = u + s * (q * c - r * b) + kick * E[0];
        y[4] = v + s * (r * a - p * c) + kick * E[1];
        y[5] = w + s * (p * b - q * a) + kick * E[2];
        add(y, half, y + 3, 3);
        return true;
    }
};

// y + h k, k = f(t + h / 2, y + h k / 2): by fixed-point iteration until round-off, from an extrapolation of the last two
// steps. There is no step where that does not converge.
struct ImplicitMidpoint {
    Callee &callee;
    std::vector<double> k, before;

    static constexpr int MOST_ITERATIONS = 100;
    static constexpr double SOLVED = 1e-12;  // relative change below which an iteration that no longer improves is done

    explicit ImplicitMidpoint(Callee &given) : callee(given), k(given.work.m), before(given.work.m) {}

    bool step(double t, double h, double *y) {
        const int64_t n = callee.work.m;
        for (int64_t i = 0; i < n; ++i) {
            const double guess = 2.0 * k[i] - before[i];
            before[i] = k[i];
            k[i] = guess;
        }
        double last = std::numeric_limits<double>::infinity();
        for (int iteration = 0; iteration < MOST_ITERATIONS; ++iteration) {
            for (int64_t i = 0; i < n; ++i) callee.stage()[i] = y[i] + 0.5 * h * k[i];
            callee.at_stage(t + 0.5 * h);
            double change = 0.0, size = 0.0;
            for (int64_t i = 0; i < n; ++i) {
                const double f = callee.f()[i];
                change = std::max(change, std::fabs(f - k[i]));
                size = std::max(size, std::fabs(f));
                k[i] = f;
            }
            if (change == 0.0 || (change >= last && change <= SOLVED * size)) {
                for (int64_t i = 0; i < n; ++i) y[i] += h * k[i];
                return true;
            }
            last = change;
        }
        return false;
    }
};

}  // namespace eip
