// Energies of planets about the first body of a system, and what changes them: those of orbits.cpp where every other body
// moves about the first one by itself, as many planets side by side as a vector has lanes.
//
// Parameters: G m of every body, then for each planet the energy at which its balance is 0.
#include <algorithm>

#include "../two_floats.hpp"
#include "newton.hpp"

namespace eip {
namespace {

// A vector of each coordinate: of as many planets as it has lanes.
struct Triplet {
    Vector x, y, z;

    Vector dot(const Triplet &other) const { return fused(z, other.z, fused(y, other.y, x * other.x)); }
    // factor this + other.
    Triplet times_plus(Vector factor, const Triplet &other) const {
        return {fused(factor, x, other.x), fused(factor, y, other.y), fused(factor, z, other.z)};
    }
};

struct Planets {
    int64_t bodies;
    const double *q, *v, *gm, *start;
    double *out;

    explicit Planets(const Given<double> &g)
        : bodies(g.n / 6),
          q(g.y),
          v(g.y + g.n / 2),
          gm(g.params),
          start(g.params + g.n / 6),
          out(g.out) {}

    // Call `function` with the first planet of each vector. The last vector ends with the last planet, and may overlap the
    // one before it; of less planets than lanes the last one fills the lanes that are left.
    template <class Function>
    void each(const Function &function) const {
        for (int64_t k = 1; k < bodies; k += WIDTH) function(std::max<int64_t>(1, std::min(k, bodies - WIDTH)));
    }
    bool fills_vectors() const { return bodies > WIDTH; }

    Vector at(const double *numbers, int64_t first) const {
        if (fills_vectors()) return load(numbers + first);
        Vector out;
        for (int k = 0; k < WIDTH; ++k) out[k] = numbers[std::min(first + k, bodies - 1)];
        return out;
    }
    Triplet vectors_at(const double *vectors, int64_t first) const {
        Vector out[3];
        if (fills_vectors()) {
            load_bodies(vectors + 3 * first, out);
        } else {
            for (int c = 0; c < 3; ++c)
                for (int k = 0; k < WIDTH; ++k) out[c][k] = vectors[3 * std::min(first + k, bodies - 1) + c];
        }
        return {out[0], out[1], out[2]};
    }
    // Relative to the first body.
    Triplet relative(const double *vectors, int64_t first) const {
        const Triplet a = vectors_at(vectors, first);
        return {a.x - vectors[0], a.y - vectors[1], a.z - vectors[2]};
    }
    // G m of both bodies over r^3.
    Vector pull(const Triplet &r, int64_t first) const { return over_cube(r.dot(r), at(gm, first) + gm[0]); }
    void put(Vector value, int64_t first) const {
        if (fills_vectors()) return store(value, out + first - 1);
        for (int64_t k = first; k < bodies; ++k) out[k - 1] = value[k - first];
    }
};

// The square of a vector's length relative to the first body, as a pair of floats that is not normalised: each coordinate is the
// exact difference of two floats.
PairOf<Vector> square_of_length(const Triplet &a, const double *first) {
    const auto square = [](const Vector &x, double origin) {
        const PairOf<Vector> part = two_sum<Vector>(x, spread_vector(-origin)),
                             whole = two_product(part.value, part.value);
        return PairOf<Vector>{whole.value, fused(2.0 * part.value, part.rest, whole.rest)};
    };
    const PairOf<Vector> x = square(a.x, first[0]), y = square(a.y, first[1]), z = square(a.z, first[2]);
    const PairOf<Vector> two = two_sum(x.value, y.value), three = two_sum(two.value, z.value);
    return {three.value, (x.rest + y.rest) + z.rest + two.rest + three.rest};
}

// mu / sqrt(x), by one step of Newton's from the float next to 1 / sqrt(x), whose own error is in h.
PairOf<Vector> quotient_by_root(const PairOf<Vector> &mu, const PairOf<Vector> &x) {
    const Vector y = over_root(x.value);
    const PairOf<Vector> square = two_product(y, y), out = two_product(mu.value, y);
    const Vector off = fused(-x.value, square.value, spread_vector(1.0));
    const Vector h = fused(-x.value, square.rest, fused(-x.rest, square.value, off));
    return {out.value, fused(0.5 * out.value, h, fused(mu.rest, y, out.rest))};
}

// In pairs of floats, and G m of both bodies too: a projection corrects only what exceeds the rounding.
void energy(const Given<double> &g) {
    const Planets p(g);
    p.each([&](int64_t k) {
        const PairOf<Vector> mu = two_sum<Vector>(spread_vector(p.gm[0]), p.at(p.gm, k));
        const PairOf<Vector> v2 = square_of_length(p.vectors_at(p.v, k), p.v);
        const PairOf<Vector> potential = quotient_by_root(mu, square_of_length(p.vectors_at(p.q, k), p.q));
        const PairOf<Vector> kinetic = two_sum<Vector>(0.5 * v2.value, -p.at(p.start - 1, k));
        const PairOf<Vector> whole = two_sum<Vector>(kinetic.value, -potential.value);
        p.put(whole.value + (whole.rest + (kinetic.rest + 0.5 * v2.rest - potential.rest)), k);
    });
}

void energy_gradient(const Given<double> &g) {
    const Planets p(g);
    const int64_t half = g.n / 2;
    std::fill(g.out, g.out + (p.bodies - 1) * g.n, 0.0);
    p.each([&](int64_t first) {
        const Triplet r = p.relative(p.q, first), v = p.relative(p.v, first);
        const Vector pull = p.pull(r, first);
        const Vector parts[2][3] = {{pull * r.x, pull * r.y, pull * r.z}, {v.x, v.y, v.z}};
        for (int lane = 0; lane < WIDTH && first + lane < p.bodies; ++lane) {
            double *row = g.out + (first + lane - 1) * g.n;
            for (int c = 0; c < 6; ++c) {
                double *part = row + c / 3 * half + c % 3;
                const double value = parts[c / 3][c % 3][lane];
                part[0] = -value;
                part[3 * (first + lane)] = value;
            }
        }
    });
}

// v . P, where P is the relative acceleration less the pull of both bodies on each other.
void energy_rate(const Given<double> &g) {
    const Planets p(g);
    p.each([&](int64_t k) {
        const Triplet r = p.relative(p.q, k), a = p.relative(g.f + g.n / 2, k);
        p.put(p.relative(p.v, k).dot(r.times_plus(p.pull(r, k), a)), k);
    });
}

// Computes the same rate from the pulls of `accelerate_apart`, which are in the place of f; no large terms cancel then.
void energy_rate_by_pulls(const Given<double> &g) {
    const Planets p(g);
    p.each([&](int64_t k) { p.put(p.relative(p.v, k).dot(p.relative(g.f, k)), k); });
}

void energy_rate_newton(const Given<double> &g) {
    constexpr int64_t FEW = 64;
    const int64_t half = g.n / 2;
    double few[2 * 3 * FEW];
    std::vector<double> many(half > 3 * FEW ? 2 * half : 0);
    double *a = many.empty() ? few : many.data();
    accelerate_apart(g.y, g.params, g.n / 6, a, a + half);
    energy_rate_by_pulls({g.t, g.y, a + half, g.out, g.params, g.n, g.p});
}

bool of_planets(int64_t n, int64_t p) { return n >= 12 && n % 6 == 0 && p == n / 3 - 1; }
constexpr const char *SIZES =
    "positions and velocities, 6 numbers per body, and as parameters G m of every body and an energy for every body "
    "except the first";

#define EIP_PLANETS(name, function, value) \
    {name, Value::value, EACH_ORBIT, plain<double, function>, nullptr, of_planets, SIZES}
const LibraryFunction functions[] = {
    EIP_PLANETS("planets.energy", energy, NUMBERS),
    EIP_PLANETS("planets.energy_gradient", energy_gradient, GRADIENT_BY_F),
    EIP_PLANETS("planets.energy_rate", energy_rate, RATES),
    {"planets.energy_rate_newton", Value::RATES, EACH_ORBIT, plain<double, energy_rate_newton>, nullptr, of_planets,
     SIZES, nullptr, plain<double, energy_rate_by_pulls>},
};
#undef EIP_PLANETS

}  // namespace

std::span<const LibraryFunction> planet_functions() { return functions; }

}  // namespace eip
