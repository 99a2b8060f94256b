// Energies, angular momenta and Laplace vectors of the orbits in a system of N bodies. There is one orbit for each body but one:
// of the body, or of the centre of mass of a group of bodies, about another body. All other pulls change these slowly.
//
// Parameters: G m of every body; then for each orbit the energy at which its balance is 0, how many bodies take part, and for
// each of these its number and its weight w in the relative position r = sum_k w_k q_k. The first body of an orbit is the one
// that the group moves about.
#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "../two_floats.hpp"
#include "einstein.hpp"

namespace eip {
namespace {

constexpr double NOT_A_NUMBER = std::numeric_limits<double>::quiet_NaN();
enum Entry { ENERGY, BODIES, N_ENTRIES };

struct Orbit {
    Pair mu;  // of all that take part: its rounding as one float would be an error of the energy
    double energy;
    int64_t bodies;
    const double *list;

    template <class Function>
    void each(const Function &function) const {
        for (int64_t k = 0; k < bodies; ++k) function(number(k), list[2 * k + 1]);
    }

    int64_t number(int64_t k) const { return static_cast<int64_t>(list[2 * k]); }

    // The centre of mass of the group less its first body. The weight of that body is what the others leave of 1: as a float
    // of its own it would make the sum of all another one than 1.
    Three beside_first(const double *vectors) const {
        const Three first = body(vectors, number(1));
        Three out{};
        for (int64_t k = 2; k < bodies; ++k) add(out.data(), 0, list[2 * k + 1], body(vectors, number(k)) - first);
        return out;
    }
    Three relative(const double *vectors) const {
        return sum(1.0, body(vectors, number(1)) - body(vectors, number(0)), 1.0, beside_first(vectors));
    }
};

// Call `function` with each orbit, by its number. The parameters may come from anywhere: where they do not describe orbits,
// all of `out` becomes NaN.
template <class Function>
void each_orbit(const Given<double> &g, int64_t floats, const Function &function) {
    const int64_t n = g.n / 6;
    const double *entry = g.params + n, *end = g.params + g.p;
    for (int64_t k = 0; k + 1 < n; ++k) {
        bool good = end - entry > N_ENTRIES && entry[BODIES] >= 2.0 && entry[BODIES] <= static_cast<double>(n);
        const int64_t bodies = good ? static_cast<int64_t>(entry[BODIES]) : 0;
        good = good && end - entry >= N_ENTRIES + 2 * bodies;
        Pair mu{0.0, 0.0};
        for (int64_t j = 0; good && j < bodies; ++j) {
            const double number = entry[N_ENTRIES + 2 * j];
            good = number >= 0.0 && number < static_cast<double>(n);
            if (good) mu = sum(mu, Pair{g.params[static_cast<int64_t>(number)], 0.0});
        }
        if (!good) {
            std::fill(g.out, g.out + floats, NOT_A_NUMBER);
            return;
        }
        function(k, Orbit{mu, entry[ENERGY], bodies, entry + N_ENTRIES});
        entry += N_ENTRIES + 2 * bodies;
    }
}

// An orbit with its position and velocity.
struct Motion : Orbit {
    int64_t n;
    Three r, v;
    double distance, pull;

    Motion(const Orbit &orbit, const double *y, int64_t bodies_of_all)
        : Orbit(orbit),
          n(bodies_of_all),
          r(relative(y)),
          v(relative(y + 3 * n)),
          distance(std::sqrt(dot(r, r))),
          pull(mu.value / (distance * distance * distance)) {}

    // A row of a gradient, from the derivatives by r and v.
    void spread(const Three &by_r, const Three &by_v, double *row) const {
        std::fill(row, row + 6 * n, 0.0);
        each([&](int64_t k, double w) {
            add(row, k, w, by_r);
            add(row, n + k, w, by_v);
        });
    }
};

// Call `function` with each orbit as a motion, by its number.
template <class Function>
void each_motion(const Given<double> &g, int64_t floats, const Function &function) {
    each_orbit(g, floats, [&](int64_t k, const Orbit &orbit) { function(k, Motion(orbit, g.y, g.n / 6)); });
}

// The relative acceleration less the pull of both sides on each other, from the accelerations `a`.
Three perturbation(const Motion &m, const double *a) { return sum(1.0, m.relative(a), m.pull, m.r); }

// The pull of a mass at -s on a body at d, less its pull on a body at 0. Nothing large cancels.
Three tide(double gm, const Three &s, const Three &d) {
    const Three x = sum(1.0, s, 1.0, d);
    const double s2 = dot(s, s), x2 = dot(x, x), a = std::sqrt(s2), b = std::sqrt(x2), cube = x2 * b;
    const double change = dot(d, sum(1.0, s, 1.0, x)) * (s2 + a * b + x2) / ((a + b) * s2 * a * cube);
    return sum(gm * change, s, -gm / cube, d);
}

// This perturbation is taken from the accelerations without the pulls of the body `sun`.
Three perturbation(const Motion &m, const double *q, const double *a, const double *gm, int64_t sun) {
    const int64_t centre = m.number(0), first = m.number(1);
    const bool about_sun = centre == sun;
    const Three s = about_sun ? m.r : body(q, centre) - body(q, sun);
    const Three origin = body(q, about_sun ? first : centre), shift = about_sun ? m.beside_first(q) : Three{};
    double mass = 0.0;
    for (int64_t k = 1; k < m.bodies; ++k) mass += gm[m.number(k)];
    Three rest = sum(1.0, m.relative(a), about_sun ? m.pull * (mass / m.mu.value) : m.pull, m.r);
    if (about_sun && m.bodies == 2) return rest;
    for (int64_t k = 1; k < m.bodies; ++k)
        rest = sum(1.0, rest, m.list[2 * k + 1], tide(gm[sun], s, (body(q, m.number(k)) - origin) - shift));
    return rest;
}

// Call `function` with each orbit and its perturbation: from f, or by Newton's law from the masses, without the pulls of the
// heaviest body, whose rounding would exceed the perturbation's.
template <bool NEWTON, class Function>
void each_perturbed(const Given<double> &g, int64_t floats, const Function &function) {
    const int64_t n = g.n / 6;
    constexpr int64_t FEW = 64;
    double small_masses[FEW], small_pulls[3 * FEW];
    std::vector<double> masses(NEWTON && n > FEW ? n : 0), pulls(3 * masses.size());
    double *gm = masses.empty() ? small_masses : masses.data(), *a = pulls.empty() ? small_pulls : pulls.data();
    int64_t sun = 0;
    if constexpr (NEWTON) {
        std::copy(g.params, g.params + n, gm);
        sun = std::max_element(gm, gm + n) - gm;
        gm[sun] = 0.0;
        accelerate(g.y, gm, n, a);
    }
    each_motion(g, floats, [&](int64_t k, const Motion &m) {
        function(k, m, NEWTON ? perturbation(m, g.y, a, g.params, sun) : perturbation(m, g.f + 3 * n));
    });
}

void put(const Three &value, double *out) { std::copy(value.begin(), value.end(), out); }

// A component of a relative vector as a pair of floats, exact for one body about another.
Pair relative_pair(const Orbit &orbit, const double *vectors, int c) {
    const auto at = [&](int64_t k) { return vectors[3 * orbit.number(k) + c]; };
    Pair total = two_sum(at(1), -at(0));
    for (int64_t k = 2; k < orbit.bodies; ++k)
        total = sum(total, product(Pair{orbit.list[2 * k + 1], 0.0}, two_sum(at(k), -at(1))));
    return total;
}

Pair square_of_length(const Orbit &orbit, const double *vectors) {
    Pair total{0.0, 0.0};
    for (int c = 0; c < 3; ++c) {
        const Pair part = relative_pair(orbit, vectors, c), square = two_product(part.value, part.value);
        total = sum(total, {square.value, square.rest + 2.0 * part.value * part.rest});
    }
    return total;
}

// The energies, less those in the parameters, in pairs of floats: a projection corrects only what exceeds their rounding.
void energy(const Given<double> &g) {
    const int64_t n = g.n / 6;
    each_orbit(g, n - 1, [&](int64_t number, const Orbit &orbit) {
        const Pair v2 = square_of_length(orbit, g.y + 3 * n), r = square_root(square_of_length(orbit, g.y));
        const Pair potential = quotient(orbit.mu, r);
        const Pair kinetic = two_sum(0.5 * v2.value, -orbit.energy);
        const Pair whole = two_sum(kinetic.value, -potential.value);
        g.out[number] = whole.value + (whole.rest + (kinetic.rest + 0.5 * v2.rest - potential.rest));
    });
}

void energy_gradient(const Given<double> &g) {
    each_motion(g, (g.n / 6 - 1) * g.n,
                [&](int64_t k, const Motion &m) { m.spread(sum(m.pull, m.r, 0.0, m.r), m.v, g.out + k * g.n); });
}

template <bool NEWTON>
void energy_rate(const Given<double> &g) {
    each_perturbed<NEWTON>(g, g.n / 6 - 1, [&](int64_t k, const Motion &m, const Three &P) { g.out[k] = dot(m.v, P); });
}

void momentum(const Given<double> &g) {
    each_motion(g, 3 * (g.n / 6 - 1), [&](int64_t k, const Motion &m) { put(cross(m.r, m.v), g.out + 3 * k); });
}

void momentum_gradient(const Given<double> &g) {
    each_motion(g, 3 * (g.n / 6 - 1) * g.n, [&](int64_t k, const Motion &m) {
        for (int c = 0; c < 3; ++c) {
            Three axis{};
            axis[c] = 1.0;
            m.spread(cross(m.v, axis), cross(axis, m.r), g.out + (3 * k + c) * g.n);
        }
    });
}

template <bool NEWTON>
void momentum_rate(const Given<double> &g) {
    each_perturbed<NEWTON>(g, 3 * (g.n / 6 - 1),
                           [&](int64_t k, const Motion &m, const Three &P) { put(cross(m.r, P), g.out + 3 * k); });
}

// v x h - mu r / |r|. Its length is mu times the eccentricity, and it points to the pericentre.
void laplace(const Given<double> &g) {
    each_motion(g, 3 * (g.n / 6 - 1), [&](int64_t k, const Motion &m) {
        put(sum(dot(m.v, m.v) - m.mu.value / m.distance, m.r, -dot(m.r, m.v), m.v), g.out + 3 * k);
    });
}

// The derivative of Laplace's vector along a change of v alone.
Three kicked(const Motion &m, const Three &kick) {
    const Three first = sum(2.0 * dot(m.v, kick), m.r, -dot(m.r, kick), m.v);
    return sum(1.0, first, -dot(m.r, m.v), kick);
}

// The derivative of Laplace's vector along a change of r alone.
Three moved(const Motion &m, const Three &move) {
    const Three first = sum(dot(m.v, m.v) - m.mu.value / m.distance, move, -dot(m.v, move), m.v);
    return sum(1.0, first, m.pull * dot(m.r, move), m.r);
}

void laplace_gradient(const Given<double> &g) {
    each_motion(g, 3 * (g.n / 6 - 1) * g.n, [&](int64_t number, const Motion &m) {
        Three by_r[3], by_v[3];
        for (int c = 0; c < 3; ++c) {
            Three axis{};
            axis[c] = 1.0;
            const Three column_r = moved(m, axis), column_v = kicked(m, axis);
            for (int k = 0; k < 3; ++k) by_r[k][c] = column_r[k], by_v[k][c] = column_v[k];
        }
        for (int k = 0; k < 3; ++k) m.spread(by_r[k], by_v[k], g.out + (3 * number + k) * g.n);
    });
}

template <bool NEWTON>
void laplace_rate(const Given<double> &g) {
    each_perturbed<NEWTON>(g, 3 * (g.n / 6 - 1),
                           [&](int64_t k, const Motion &m, const Three &P) { put(kicked(m, P), g.out + 3 * k); });
}

bool of_orbits(int64_t n, int64_t p) { return n >= 12 && n % 6 == 0 && p > n / 6; }
constexpr const char *SIZES =
    "positions and velocities, 6 numbers per body, and as parameters G m of every body and the entries of the orbits";

#define EIP_ORBIT(name, function, value, numbers) \
    {name, Value::value, numbers, plain<double, function>, nullptr, of_orbits, SIZES}
const LibraryFunction functions[] = {
    EIP_ORBIT("orbits.energy", energy, NUMBERS, EACH_ORBIT),
    EIP_ORBIT("orbits.energy_gradient", energy_gradient, GRADIENT_BY_F, EACH_ORBIT),
    EIP_ORBIT("orbits.energy_rate", energy_rate<false>, RATES, EACH_ORBIT),
    EIP_ORBIT("orbits.energy_rate_newton", energy_rate<true>, RATES, EACH_ORBIT),
    EIP_ORBIT("orbits.momentum", momentum, NUMBERS, 3 * EACH_ORBIT),
    EIP_ORBIT("orbits.momentum_gradient", momentum_gradient, GRADIENT_BY_F, 3 * EACH_ORBIT),
    EIP_ORBIT("orbits.momentum_rate", momentum_rate<false>, RATES, 3 * EACH_ORBIT),
    EIP_ORBIT("orbits.momentum_rate_newton", momentum_rate<true>, RATES, 3 * EACH_ORBIT),
    EIP_ORBIT("orbits.laplace", laplace, NUMBERS, 3 * EACH_ORBIT),
    EIP_ORBIT("orbits.laplace_gradient", laplace_gradient, GRADIENT_BY_F, 3 * EACH_ORBIT),
    EIP_ORBIT("orbits.laplace_rate", laplace_rate<false>, RATES, 3 * EACH_ORBIT),
    EIP_ORBIT("orbits.laplace_rate_newton", laplace_rate<true>, RATES, 3 * EACH_ORBIT),
};
#undef EIP_ORBIT

}  // namespace

std::span<const LibraryFunction> orbit_functions() { return functions; }

}  // namespace eip
