// Pointwise loops of the implicit schemes for the Gross-Pitaevskii equation.
#include "../module.hpp"

#include <nanobind/stl/array.h>

#include <cmath>

#include "../pairs.hpp"

namespace eip {
namespace {

// The parabola through first, before and last, equally spaced, one spacing further, into `first`.
void extrapolate(ConstField last, ConstField before, Field first) {
    require_one_length(last, before, first);
    const Released released(first.points);
    for (npy_intp i = 0; i < 2 * first.points; ++i) first.data[i] += 3.0 * (last.data[i] - before.data[i]);
}

// Modes times complex factors.
void multiply_modes(Field modes, ConstField factor) {
    require_one_length(modes, factor);
    const Released released(modes.points);
    for (npy_intp i = 0, left = 2 * modes.points; left > 0; i += WIDTH, left -= WIDTH)
        store_some(times(load_some(factor.data + i, left), load_some(modes.data + i, left)), modes.data + i, left);
}

// out <- start - i c ((W - w) mean + rotation), `rotation` may be empty; the norm of its change.
double right_side(ConstField start, ConstField mean, ConstField rotation, ConstReals W, double w, double c, Field out) {
    require_one_length(start, mean, W, out);
    const bool rotates = rotation.points > 0;
    require(!rotates || rotation.points == out.points,
            "right_side: rotation must be empty or have one value for each point");
    const Released released(out.points);
    double total = 0.0;
    for (npy_intp i = 0; i < out.points; ++i) {
        const double s = c * (W.data[i] - w);
        double re = start.data[2 * i] + s * mean.data[2 * i + 1], im = start.data[2 * i + 1] - s * mean.data[2 * i];
        if (rotates) {
            re += c * rotation.data[2 * i + 1];
            im += -c * rotation.data[2 * i];
        }
        const double change = re - out.data[2 * i], other = im - out.data[2 * i + 1];
        total += change * change + other * other;
        out.data[2 * i] = re;
        out.data[2 * i + 1] = im;
    }
    return std::sqrt(total);
}

// start <- 2 mean - start.
void other_end(ConstField mean, Field start) {
    require_one_length(mean, start);
    const Released released(start.points);
    for (npy_intp i = 0; i < 2 * start.points; ++i) start.data[i] = 2.0 * mean.data[i] - start.data[i];
}

// out <- V + beta / 2 (|2 mean - start|^2 + |start|^2).
void mean_density(ConstField start, ConstField mean, ConstReals V, double beta, Reals out) {
    require_one_length(start, mean, V, out);
    const Released released(out.points);
    for (npy_intp i = 0; i < out.points; ++i) {
        const double x = start.data[2 * i], y = start.data[2 * i + 1];
        const double p = 2.0 * mean.data[2 * i] - x, q = 2.0 * mean.data[2 * i + 1] - y;
        out.data[i] = V.data[i] + 0.5 * beta * (x * x + y * y + p * p + q * q);
    }
}

// out <- V + beta |psi|^2.
void density(ConstField psi, ConstReals V, double beta, Reals out) {
    require_one_length(psi, V, out);
    const Released released(out.points);
    for (npy_intp i = 0; i < out.points; ++i)
        out.data[i] =
            V.data[i] + beta * (psi.data[2 * i] * psi.data[2 * i] + psi.data[2 * i + 1] * psi.data[2 * i + 1]);
}

// out <- (V + beta |p|^2) p, p = psi + a (psi - other); the sum of V |p|^2 + beta / 2 |p|^4.
double nonlinear_force(ConstField psi, ConstField other, double a, ConstReals V, double beta, Field out) {
    require_one_length(psi, other, V, out);
    const Released released(out.points);
    double total = 0.0;
    for (npy_intp i = 0; i < out.points; ++i) {
        const double x = psi.data[2 * i], y = psi.data[2 * i + 1];
        const double p = x + a * (x - other.data[2 * i]), q = y + a * (y - other.data[2 * i + 1]);
        const double n = p * p + q * q, v = V.data[i] + beta * n;
        out.data[2 * i] = v * p;
        out.data[2 * i + 1] = v * q;
        total += (V.data[i] + 0.5 * beta * n) * n;
    }
    return total;
}

// Sums of Re conj(force) (inverse - 1) modes and of Re conj(force) i c inverse force.
std::array<double, 2> projections(ConstField force, ConstField modes, ConstField inverse, double c) {
    require_one_length(force, modes, inverse);
    const Released released(force.points);
    double along = 0.0, norm = 0.0;
    for (npy_intp i = 0; i < force.points; ++i) {
        const double g = force.data[2 * i], k = force.data[2 * i + 1];
        const double q = inverse.data[2 * i], r = inverse.data[2 * i + 1];
        const double a = modes.data[2 * i], b = modes.data[2 * i + 1];
        const double re = (q * a - r * b) - a, im = (q * b + r * a) - b;
        along += g * re + k * im;
        norm -= c * r * (g * g + k * k);
    }
    return {along, norm};
}

// Into new_modes 2 inverse (modes - i factor force) - modes; into force the same over the number of points.
void advance(ConstField modes, ConstField inverse, double factor, Field new_modes, Field force) {
    require_one_length(modes, inverse, new_modes, force);
    const Released released(modes.points);
    const double points = static_cast<double>(modes.points);
    const Vector turned = turning(-factor);
    for (npy_intp i = 0, left = 2 * modes.points; left > 0; i += WIDTH, left -= WIDTH) {
        const Vector before = load_some(modes.data + i, left), g = load_some(force.data + i, left);
        const Vector source = before + turned * swapped(g);
        const Vector value = 2.0 * times(load_some(inverse.data + i, left), source) - before;
        store_some(value, new_modes.data + i, left);
        store_some(value / points, force.data + i, left);
    }
}

}  // namespace

void add_fields(nb::module_ module) {
    module.def("extrapolate", extrapolate, "last"_a, "before"_a, "first"_a);
    module.def("multiply_modes", multiply_modes, "modes"_a, "factor"_a);
    module.def("right_side", right_side, "start"_a, "mean"_a, "rotation"_a, "W"_a, "w"_a, "c"_a, "out"_a);
    module.def("other_end", other_end, "mean"_a, "start"_a);
    module.def("mean_density", mean_density, "start"_a, "mean"_a, "V"_a, "beta"_a, "out"_a);
    module.def("density", density, "psi"_a, "V"_a, "beta"_a, "out"_a);
    module.def("nonlinear_force", nonlinear_force, "psi"_a, "other"_a, "a"_a, "V"_a, "beta"_a, "out"_a);
    module.def("projections", projections, "force"_a, "modes"_a, "inverse"_a, "c"_a);
    module.def("advance", advance, "modes"_a, "inverse"_a, "factor"_a, "new_modes"_a, "force"_a);
}

}  // namespace eip
