// N bodies with further forces. After every G m the parameters hold the entries of forces.py, then every beta.
#include <algorithm>
#include <cmath>

#include "by_parameters.hpp"
#include "einstein.hpp"
#include "tides.hpp"

namespace eip {
namespace {

// Entries after the G m, and which relativity the first one names.
enum Entry {
    KIND,
    OVER_C2,
    OBLATENESS,
    POLE,
    MOON_BODY = 6,
    MOON,
    DRAG,
    BASE,
    SCALE_HEIGHT,
    SPIN,
    OBLATENESS_4,
    N_ENTRIES
};
constexpr double ONE_PN = 1.0, EIH = 2.0, POTENTIAL = 3.0;

struct Bodies {
    int64_t n;
    const double *gm, *k, *beta;

    explicit Bodies(const Given<double> &g)
        : n((g.p - N_ENTRIES) / 2),
          gm(g.params),
          k(g.params + n),
          beta(k + N_ENTRIES) {}
    template <class T = double>
    Vec3<T> pole() const {
        return {k[POLE], k[POLE + 1], k[POLE + 2]};
    }
    template <class T>
    Einstein<T> einstein(const T *y) const {
        return {y, gm, n, k[OVER_C2]};
    }
};

using std::exp;
using std::sqrt;

// The Sun's J4 at x, of which s is the part along the pole: the acceleration is -w x - along pole.
template <class T>
struct FourthHarmonic {
    T w, along;

    FourthHarmonic(const Bodies &b, const T &s, const T &r2) {
        const T q = s * s / r2, k = 2.5 * b.gm[0] * b.k[OBLATENESS_4] / (r2 * r2 * r2 * sqrt(r2));
        w = -0.75 * k * (21.0 * q * q - 14.0 * q + 1.0);
        along = k * s * (7.0 * q - 3.0);
    }
};

// Acceleration of body i at x from the Sun by the terms that depend on positions.
template <class T>
Vec3<T> pull(const Vec3<T> &x, const Bodies &b, int64_t i) {
    const double gm_sun = b.gm[0];
    const T r2 = dot(x, x);
    T w = 0.0, along = 0.0;
    if (b.k[KIND] == POTENTIAL) w += 6.0 * gm_sun * gm_sun * b.k[OVER_C2] / (r2 * r2);
    if (b.k[MOON_BODY] == i) w += 3.0 * gm_sun * b.k[MOON] / (r2 * r2 * sqrt(r2));
    const Vec3<T> pole = b.pole<T>();
    if (b.k[OBLATENESS] > 0.0) {
        const T s = dot(x, pole), u = 1.5 * gm_sun * b.k[OBLATENESS] / (r2 * r2 * sqrt(r2));
        w += u * (1.0 - 5.0 * s * s / r2);
        along = 2.0 * u * s;
    }
    if (b.k[OBLATENESS_4] != 0.0) {
        const FourthHarmonic<T> j4(b, dot(x, pole), r2);
        w += j4.w;
        along += j4.along;
    }
    return {-w * x[0] - along * pole[0], -w * x[1] - along * pole[1], -w * x[2] - along * pole[2]};
}

// The Sun's first post-Newtonian pull on a body at x with the velocity v, both relative.
template <class T>
Vec3<T> pull_1pn(const Vec3<T> &x, const Vec3<T> &v, const Bodies &b) {
    const double gm_sun = b.gm[0];
    const T r2 = dot(x, x), r = sqrt(r2), w = gm_sun * b.k[OVER_C2] / (r2 * r);
    return sum(w * (4.0 * gm_sun / r - dot(v, v)), x, 4.0 * w * dot(x, v), v);
}

// Drag on a body at x with the velocity v, both relative, by air that turns about the pole and whose density falls by e
// in each scale height.
template <class T>
Vec3<T> drag(const Vec3<T> &x, const Vec3<T> &v, const Bodies &b) {
    const Vec3<T> u = sum(1.0, v, -b.k[SPIN], cross(b.pole<T>(), x));
    const T height = sqrt(dot(x, x)) - b.k[BASE];
    const T w = -b.k[DRAG] * exp(-height / b.k[SCALE_HEIGHT]) * sqrt(dot(u, u));
    return {w * u[0], w * u[1], w * u[2]};
}

// Radiation pressure and Poynting-Robertson drag on body i at x with the velocity v, both relative.
template <class T>
Vec3<T> radiation(const Vec3<T> &x, const Vec3<T> &v, const Bodies &b, int64_t i) {
    const T r2 = dot(x, x), r = sqrt(r2), w = b.beta[i] * b.gm[0] / r2;
    const double over_c = std::sqrt(b.k[OVER_C2]);
    return sum(w / r * (1.0 - over_c * dot(x, v) / r), x, -over_c * w, v);
}

// Add to out (3 N) the Sun's further forces on all others, and their reactions on it, except that of the radiation, which
// carries momentum away; v is null where none depends on it.
template <class T>
void add_pulls(const T *q, const T *v, const Bodies &b, T *out) {
    Vec3<T> back{};
    for (int64_t i = 1; i < b.n; ++i) {
        const Vec3<T> x = body(q, i) - body(q, 0);
        Vec3<T> a = pull(x, b, i);
        if (v && b.k[KIND] == ONE_PN) a = sum(1.0, a, 1.0, pull_1pn(x, body(v, i) - body(v, 0), b));
        if (v && b.k[DRAG] > 0.0) a = sum(1.0, a, 1.0, drag(x, body(v, i) - body(v, 0), b));
        add(out, i, 1.0, a);
        if (v && b.beta[i] != 0.0) add(out, i, 1.0, radiation(x, body(v, i) - body(v, 0), b, i));
        const double share = b.gm[i] / b.gm[0];
        for (int c = 0; c < 3; ++c) back[c] += share * a[c];
    }
    for (int c = 0; c < 3; ++c) out[c] -= back[c];
}

void rhs(const Given<double> &g) {
    const Bodies b(g);
    double *a = g.out + 3 * b.n;
    newton_rhs(g.y, b.gm, b.n, g.out);
    if (b.k[KIND] == EIH) b.einstein(g.y).add_accelerations(a);
    add_pulls(g.y, g.y + 3 * b.n, b, a);
}

void acc(const Given<double> &g) {
    const Bodies b(g);
    accelerate(g.y, b.gm, b.n, g.out);
    add_pulls<double>(g.y, nullptr, b, g.out);
}

// For a state followed by columns of derivatives, eight of which are found at once; the last one may stand in several lanes.
void variational(const Given<double> &g) {
    const Bodies b(g);
    const int64_t size = 6 * b.n, half = 3 * b.n, columns = g.n / size - 1;
    newton_variational(g.y, b.gm, b.n, columns, g.out);
    std::vector<Dual> y(size), a(half);
    const std::vector<double> newton(g.out + half, g.out + size);
    for (int64_t first = 1; first <= std::max<int64_t>(columns, 1); first += LANES) {
        const auto slopes = [&](const double *numbers) {
            double lanes[LANES];
            for (int64_t k = 0; k < LANES; ++k) lanes[k] = numbers[size * std::min(first + k, columns)];
            return Lanes8::load(lanes);
        };
        for (int64_t i = 0; i < size; ++i) y[i] = {g.y[i], slopes(g.y + i)};
        for (int64_t i = 0; i < half; ++i) a[i] = {newton[i], slopes(g.out + half + i)};
        if (b.k[KIND] == EIH) b.einstein(y.data()).add_accelerations(a.data());
        add_pulls<Dual>(y.data(), y.data() + half, b, a.data());
        for (int64_t i = 0; i < half; ++i) {
            g.out[half + i] = a[i].value;
            for (int64_t k = 0; k < LANES && first + k <= columns; ++k)
                g.out[size * (first + k) + half + i] = a[i].slope.lane(static_cast<int>(k));
        }
    }
}

// G times the potential energy of `pull`.
double potential(const double *y, const Bodies &b) {
    double total = 0.0;
    for (int64_t i = 1; i < b.n; ++i) {
        const Three x = body(y, i) - body(y, 0);
        const double r2 = dot(x, x), over_r3 = 1.0 / (r2 * std::sqrt(r2));
        double part = 0.0;
        if (b.k[KIND] == POTENTIAL) part -= 3.0 * b.gm[0] * b.k[OVER_C2] / r2;
        if (b.k[MOON_BODY] == i) part -= b.k[MOON] * over_r3;
        if (b.k[OBLATENESS] > 0.0) {
            const double s = dot(x, b.pole());
            part += 0.5 * b.k[OBLATENESS] * over_r3 * (3.0 * s * s / r2 - 1.0);
        }
        if (b.k[OBLATENESS_4] != 0.0) {
            const double s = dot(x, b.pole()), q = s * s / r2;
            part += 0.125 * b.k[OBLATENESS_4] * over_r3 / r2 * (35.0 * q * q - 30.0 * q + 3.0);
        }
        total += b.gm[i] * part;
    }
    return b.gm[0] * total;
}

// For forces that do not depend on velocities.
void energy(const Given<double> &g) {
    const Bodies b(g);
    g.out[0] = energy_sum(g.y, b.gm, b.n) + potential(g.y, b);
}

void gradient_of_energy(const Given<double> &g) { energy_gradient(g.y, g.f, g.params, Bodies(g).n, g.out); }

void momentum(const Given<double> &g) { angular_momentum(g.y, g.params, Bodies(g).n, g.out); }

void momentum_gradient(const Given<double> &g) { angular_momentum_gradient(g.y, g.params, Bodies(g).n, g.out); }

// Along the Sun's pole.
void axial_momentum(const Given<double> &g) {
    const Bodies b(g);
    Three L;
    angular_momentum(g.y, b.gm, b.n, L.data());
    g.out[0] = dot(L, b.pole());
}

// G m v x pole and G m pole x q.
void axial_momentum_gradient(const Given<double> &g) {
    const Bodies b(g);
    for (int64_t i = 0; i < b.n; ++i) {
        const Three by_q = cross(body(g.y, b.n + i), b.pole()), by_v = cross(b.pole(), body(g.y, i));
        for (int c = 0; c < 3; ++c) {
            g.out[3 * i + c] = b.gm[i] * by_q[c];
            g.out[3 * (b.n + i) + c] = b.gm[i] * by_v[c];
        }
    }
}

void eih_energy(const Given<double> &g) {
    const Bodies b(g);
    g.out[0] = b.einstein(g.y).energy() + potential(g.y, b);
}

void eih_energy_gradient(const Given<double> &g) {
    const Bodies b(g);
    b.einstein(g.y).energy_gradient(g.out);
    std::vector<double> pulls(3 * b.n);
    add_pulls<double>(g.y, nullptr, b, pulls.data());
    for (int64_t i = 0; i < 3 * b.n; ++i) g.out[i] -= b.gm[i / 3] * pulls[i];
}

void eih_momentum(const Given<double> &g) {
    const Three L = Bodies(g).einstein(g.y).momentum();
    std::copy(L.begin(), L.end(), g.out);
}

void eih_momentum_gradient(const Given<double> &g) { Bodies(g).einstein(g.y).momentum_gradient(g.out); }

void eih_axial_momentum(const Given<double> &g) {
    const Bodies b(g);
    g.out[0] = dot(b.einstein(g.y).momentum(), b.pole());
}

void eih_axial_momentum_gradient(const Given<double> &g) {
    const Bodies b(g);
    std::vector<double> rows(3 * g.n);
    b.einstein(g.y).momentum_gradient(rows.data());
    for (int64_t i = 0; i < g.n; ++i) g.out[i] = dot({rows[i], rows[g.n + i], rows[2 * g.n + i]}, b.pole());
}

// Two bodies' relative motion with "1pn", per reduced mass; no order is left out.
struct Pair {
    double gm_sun, mu, over_c2, u, x;
    Three r, v;

    // r and v of the second body from the first, u = 1/r and x = mu / (c^2 r).
    explicit Pair(const Given<double> &g)
        : gm_sun(g.params[0]),
          mu(g.params[0] + g.params[1]),
          over_c2(g.params[2 + OVER_C2]),
          r(body(g.y, 1) - body(g.y, 0)),
          v(body(g.y, 3) - body(g.y, 2)) {
        u = 1.0 / std::sqrt(dot(r, r));
        x = over_c2 * mu * u;
    }
};

// With w = v^2 and u = 1/r the equations give dw/du + 6 mu/c^2 w = 2 mu - 8 mu M u/c^2, linear; this is the constant of
// its solution. For a test particle it is, to first order in 1/c^2, the known energy
// v^2/2 - M/r + c^-2 (3/8 v^4 + 3/2 M v^2/r + M^2/(2 r^2)), except 3/(2 c^2) (v^2/2 - M/r)^2, which is constant too.
void pair_energy(const Given<double> &g) {
    const Pair p(g);
    const double third = 2.0 / 3.0 * p.gm_sun;
    g.out[0] = (0.5 * dot(p.v, p.v) + third * p.u) * std::exp(6.0 * p.x) -
               (p.mu + third) / (6.0 * p.mu * p.over_c2) * std::expm1(6.0 * p.x);
}

void pair_energy_gradient(const Given<double> &g) {
    const Pair p(g);
    const double growth = std::exp(6.0 * p.x);
    const double by_u = growth * (3.0 * p.over_c2 * p.mu * (dot(p.v, p.v) + 4.0 / 3.0 * p.gm_sun * p.u) - p.mu);
    for (int i = 0; i < 3; ++i) {
        g.out[3 + i] = -by_u * p.u * p.u * p.u * p.r[i];
        g.out[9 + i] = growth * p.v[i];
        g.out[i] = -g.out[3 + i];
        g.out[6 + i] = -g.out[9 + i];
    }
}

// r x v exp(4 mu / (c^2 r)).
Three momentum_of(const Pair &p) {
    const double growth = std::exp(4.0 * p.x);
    const Three L = cross(p.r, p.v);
    return {growth * L[0], growth * L[1], growth * L[2]};
}

void pair_momentum(const Given<double> &g) {
    const Three L = momentum_of(Pair(g));
    std::copy(L.begin(), L.end(), g.out);
}

void pair_momentum_gradient(const Given<double> &g) {
    const Pair p(g);
    const double growth = std::exp(4.0 * p.x);
    const Three L = momentum_of(p);
    std::fill(g.out, g.out + 36, 0.0);
    for (int i = 0; i < 2; ++i) {
        const double sign = i == 0 ? -1.0 : 1.0;
        const ThreeColumns by_q{g.out + 3 * i, 12}, by_v{g.out + 6 + 3 * i, 12};
        by_q.add_cross(-sign * growth, p.v);
        by_v.add_cross(sign * growth, p.r);
        by_q.add_outer(-4.0 * sign * p.x * p.u * p.u, L, p.r);
    }
}

// Numbers of 6 or 3 for each body: as many, or a multiple.
bool fits(int64_t n, int64_t p, int64_t each, bool multiple) {
    const int64_t size = each * (p - N_ENTRIES) / 2;
    return p > N_ENTRIES && (p - N_ENTRIES) % 2 == 0 && n > 0 && (multiple ? n % size == 0 : n == size);
}
bool with_columns(int64_t n, int64_t p) { return fits(n, p, 6, true); }
bool of_bodies(int64_t n, int64_t p) { return fits(n, p, 6, false); }
bool at_positions(int64_t n, int64_t p) { return fits(n, p, 3, false); }
bool is_bound(int64_t n, int64_t p) { return n > 0 && p > N_ENTRIES + 2; }
bool of_two(int64_t n, int64_t p) { return n == 12 && p == 4 + N_ENTRIES; }
constexpr const char *COLUMNS =
    "a state of 6 numbers per body, columns of the same size, and as parameters G m of every body, 13 entries of the "
    "forces, and beta of every body";
constexpr const char *BODIES =
    "positions and velocities, 6 numbers per body, and as parameters G m of every body, 13 entries of the forces, and "
    "beta of every body";
constexpr const char *POSITIONS =
    "positions, 3 numbers per body, and as parameters G m of every body, 13 entries of the forces, and beta of every "
    "body";
constexpr const char *BOUND = "a state of bodies, and to be bound to parameters, the indices of some, and their number";
constexpr const char *TWO =
    "a state of 12 numbers, and as parameters G m of both bodies, 13 entries of the forces, and beta of both";

#define EIP_FORCES(name, function, value, numbers, fits, sizes) \
    {name, Value::value, numbers, plain<double, function>, nullptr, fits, sizes}
#define EIP_BY_PARAMETERS(name, function, numbers)                     \
    {name "_by_parameters",                                            \
     Value::NUMBERS,                                                   \
     numbers,                                                          \
     plain<double, value_by_parameters<N_ENTRIES, function, numbers>>, \
     nullptr,                                                          \
     is_bound,                                                         \
     BOUND,                                                            \
     nullptr,                                                          \
     nullptr,                                                          \
     nullptr,                                                          \
     nullptr,                                                          \
     true}
const LibraryFunction functions[] = {
    EIP_FORCES("forces.rhs", rhs, DERIVATIVE, 0, of_bodies, BODIES),
    EIP_FORCES("forces.acc", acc, ACCELERATION, 0, at_positions, POSITIONS),
    EIP_FORCES("forces.variational", variational, DERIVATIVE, 0, with_columns, COLUMNS),
    {"forces.variational_by_parameters", Value::DERIVATIVE, 0,
     plain<double, variational_by_parameters<N_ENTRIES, variational, rhs>>, nullptr, is_bound, BOUND},
    EIP_BY_PARAMETERS("forces.energy", energy, 1),
    EIP_BY_PARAMETERS("forces.momentum", momentum, 3),
    EIP_BY_PARAMETERS("forces.axial_momentum", axial_momentum, 1),
    EIP_BY_PARAMETERS("eih.energy", eih_energy, 1),
    EIP_BY_PARAMETERS("eih.momentum", eih_momentum, 3),
    EIP_BY_PARAMETERS("eih.axial_momentum", eih_axial_momentum, 1),
    EIP_BY_PARAMETERS("pair.energy", pair_energy, 1),
    EIP_BY_PARAMETERS("pair.momentum", pair_momentum, 3),
    EIP_FORCES("forces.energy", energy, NUMBERS, 1, of_bodies, BODIES),
    EIP_FORCES("forces.energy_gradient", gradient_of_energy, GRADIENT_BY_F, 1, of_bodies, BODIES),
    EIP_FORCES("forces.momentum", momentum, NUMBERS, 3, of_bodies, BODIES),
    EIP_FORCES("forces.momentum_gradient", momentum_gradient, GRADIENT, 3, of_bodies, BODIES),
    EIP_FORCES("forces.axial_momentum", axial_momentum, NUMBERS, 1, of_bodies, BODIES),
    EIP_FORCES("forces.axial_momentum_gradient", axial_momentum_gradient, GRADIENT, 1, of_bodies, BODIES),
    EIP_FORCES("eih.energy", eih_energy, NUMBERS, 1, of_bodies, BODIES),
    EIP_FORCES("eih.energy_gradient", eih_energy_gradient, GRADIENT, 1, of_bodies, BODIES),
    EIP_FORCES("eih.momentum", eih_momentum, NUMBERS, 3, of_bodies, BODIES),
    EIP_FORCES("eih.momentum_gradient", eih_momentum_gradient, GRADIENT, 3, of_bodies, BODIES),
    EIP_FORCES("eih.axial_momentum", eih_axial_momentum, NUMBERS, 1, of_bodies, BODIES),
    EIP_FORCES("eih.axial_momentum_gradient", eih_axial_momentum_gradient, GRADIENT, 1, of_bodies, BODIES),
    EIP_FORCES("pair.energy", pair_energy, NUMBERS, 1, of_two, TWO),
    EIP_FORCES("pair.energy_gradient", pair_energy_gradient, GRADIENT, 1, of_two, TWO),
    EIP_FORCES("pair.momentum", pair_momentum, NUMBERS, 3, of_two, TWO),
    EIP_FORCES("pair.momentum_gradient", pair_momentum_gradient, GRADIENT, 3, of_two, TWO),
};
#undef EIP_FORCES
#undef EIP_BY_PARAMETERS

}  // namespace

std::span<const LibraryFunction> force_functions() { return functions; }

}  // namespace eip
