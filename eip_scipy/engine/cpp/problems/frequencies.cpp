// How fast bodies move: what bounds the step of a multistep method. problems/gravity/frequencies.py says what is computed.
#include "../module.hpp"

#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <cmath>
#include <numbers>

#include "einstein.hpp"

namespace eip {
namespace {

// Least pericentre, in units of a pair's present distance: nearer, a radial orbit ends in a collision or is perturbed.
constexpr double LEAST_PERICENTRE = 1e-3;
// Least eccentricity of a pair whose time to the pericentre is looked at, and halvings that solve Kepler's equation.
constexpr double LEAST_ECCENTRICITY = 0.5;
constexpr int HALVINGS = 30;

double cube(double x) { return x * x * x; }
double square(const Three &a) { return dot(a, a); }

// A bound pair: its mass, its distance, the elements of its orbit, and whether it comes nearer.
struct Orbit {
    double mass, distance, inverse_axis, eccentricity;
    bool approaches;
};

// The least distance within the run of a bound pair whose pericentre comes later than its end, else 0.
double nearest(const Orbit &o, double duration) {
    const double a = 1.0 / o.inverse_axis, e = o.eccentricity, full = 2.0 * std::numbers::pi;
    // Circles have no pericentre to wait for.
    if (!(o.inverse_axis > 0.0 && e > LEAST_ECCENTRICITY && std::isfinite(o.distance) && std::isfinite(duration)))
        return 0.0;
    const double anomaly = std::acos(std::clamp((1.0 - o.distance / a) / e, -1.0, 1.0));
    const double until = anomaly - e * std::sin(anomaly);  // the mean anomaly left
    const double left = (o.approaches ? until : full - until) - duration * std::sqrt(o.mass / cube(a));
    if (!(left > 0.0)) return 0.0;
    const double wanted = std::min(left, full - left);  // the same distance before and after the apocentre
    double low = 0.0, high = std::numbers::pi;
    for (int k = 0; k < HALVINGS; ++k) {
        const double middle = 0.5 * (low + high);
        (middle - e * std::sin(middle) < wanted ? low : high) = middle;
    }
    return std::min(o.distance, a * (1.0 - e * std::cos(low)));
}

struct Bodies {
    const double *gm, *q, *v, *pulls;
    double duration;

    // The frequency of the orbit of body i about body j.
    double frequency(int64_t i, int64_t j) const {
        const double mass = gm[i] + gm[j];
        if (i == j || !(mass > 0.0)) return 0.0;
        const Three r = body(q, i) - body(q, j), u = body(v, i) - body(v, j);
        const double distance = std::sqrt(square(r)), along = dot(r, u), own = mass / cube(distance);
        const double inverse_axis = 2.0 / distance - square(u) / mass, momentum = square(cross(r, u)) / mass;
        const double eccentricity = std::sqrt(std::max(0.0, 1.0 - momentum * inverse_axis));
        const Orbit orbit{mass, distance, inverse_axis, eccentricity, along * (duration < 0.0 ? -1.0 : 1.0) < 0.0};
        const double pericentre = std::max(momentum / (1.0 + eccentricity), LEAST_PERICENTRE * distance);
        const double fastest = std::sqrt(mass / cube(std::max(pericentre, nearest(orbit, std::abs(duration)))));
        const double mean = std::sqrt(mass * cube(std::max(inverse_axis, 0.0)));
        const Three pull = body(pulls, i) - body(pulls, j);
        const Three others = sum(1.0, pull, own, r);
        const bool bound = inverse_axis > 0.0, alone = std::sqrt(square(others)) < mass / (distance * distance);
        const double of_orbit = bound ? std::sqrt(mean * fastest) : fastest;
        const double found = alone && (bound || !(along > 0.0)) ? of_orbit : std::sqrt(own);
        return std::isnan(found) ? 0.0 : found;
    }

    double attraction(int64_t i, int64_t j) const {
        return (gm[i] + gm[j]) / cube(std::sqrt(square(body(q, i) - body(q, j))));
    }
};

std::tuple<Array, double> frequencies(ArrayOf<const double, 1> gm, ArrayOf<const double, 1> y, double duration) {
    const int64_t n = gm.shape[0];
    require(n > 0 && y.shape[0] == 6 * n, "frequencies: expected positions and velocities, 6 numbers for each mass");
    std::vector<double> pulls(3 * n);
    accelerate(y.data, gm.data, n, pulls.data());
    const Bodies bodies{gm.data, y.data, y.data + 3 * n, pulls.data(), duration};
    const int64_t centre = std::max_element(gm.data, gm.data + n) - gm.data;
    Array about = new_array({n});
    double others = 0.0;
    for (int64_t i = 0; i < n; ++i) {
        about.floats()[i] = bodies.frequency(i, centre);
        for (int64_t j = 0; j < n; ++j)
            if (i != j && i != centre && j != centre && bodies.attraction(i, j) > bodies.attraction(centre, j))
                others = std::max(others, bodies.frequency(i, j));
    }
    return {about, others};
}

}  // namespace

void add_gravity(nb::module_ module) {
    module.def("frequencies", frequencies, "gm"_a, "y"_a, "duration"_a,
               "Return the largest angular frequency of each body on its orbit about the heaviest one, and that of all "
               "other pairs.");
    module.def("work_alone", work_alone, "alone"_a,
               "If `alone` is True, keep the calling thread from sharing sums over many bodies with other threads; if "
               "False, let it share them. Return the previous setting.");
    module.def("end_threads", end_threads,
               "End the threads that share sums over many bodies. They are not started again.");
    nb::module_::import_("atexit").attr("register")(module.attr("end_threads"));
}

}  // namespace eip
