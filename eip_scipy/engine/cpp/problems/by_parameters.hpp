// Derivatives of the functions of bodies by their parameters: differences of order 6, which round-off alone limits.
//
// All functions of three or more bodies are polynomials of degree 2 in each G m but the first, so that their differences may
// be as long as the largest G m, and all are linear in beta. The recoil of drag and the invariants of two bodies with "1pn"
// are not polynomials. Such a function is bound to the parameters of a run, the indices of those by which it is
// differentiated, and their number.
#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

#include "../library.hpp"

namespace eip {

// The parameters of a run, and the indices of some of them. Those that do not fit count as none.
struct BoundParameters {
    const double *params, *indices;
    int64_t n_params, count, bodies, linear;

    // EXTRA parameters follow every G m and, unless there are none, every beta, in which functions are linear.
    template <int64_t EXTRA>
    static BoundParameters of(const Given<double> &g) {
        const double wanted = g.params[g.p - 1];
        const int64_t count = 0.0 <= wanted && wanted < g.p - 1 - EXTRA ? static_cast<int64_t>(wanted) : 0;
        const int64_t n = g.p - 1 - count, bodies = std::max<int64_t>(EXTRA > 0 ? (n - EXTRA) / 2 : n, 0);
        return {g.params, g.params + n, n, count, bodies, bodies + EXTRA};
    }

    // Adds to out the derivative by parameter k of the `size` numbers that FUNCTION fills.
    template <void (*FUNCTION)(const Given<double> &)>
    void add_derivative(const Given<double> &g, int64_t n, double index, int64_t size, double *out) const {
        if (!(0.0 <= index && index < n_params) || n != 6 * bodies) return std::fill_n(out, size, std::nan("")), void();
        constexpr double WEIGHTS[] = {3.0 / 4.0, -3.0 / 20.0, 1.0 / 60.0};
        const auto k = static_cast<int64_t>(index);
        std::vector<double> changed(params, params + n_params), value(size);
        const double own = changed[k], largest = *std::max_element(params, params + bodies);
        const double unit = k < bodies ? largest : own != 0.0 && k < linear ? std::abs(own) : 1.0;
        const bool is_long = k >= linear || (0 < k && k < bodies && bodies > 2);
        const double shift = std::ldexp(1.0, std::ilogb(unit) - (is_long ? 1 : 8));
        for (int multiple = -3; multiple <= 3; ++multiple) {
            if (multiple == 0) continue;
            changed[k] = own + multiple * shift;
            FUNCTION({g.t, g.y, nullptr, value.data(), changed.data(), n, n_params});
            const double weight = (multiple > 0 ? 1.0 : -1.0) * WEIGHTS[std::abs(multiple) - 1] / shift;
            for (int64_t i = 0; i < size; ++i) out[i] += weight * value[i];
        }
    }
};

// For a state and columns, each followed by as many numbers as there are parameters: the last columns, one for each of them,
// are derivatives by it.
template <int64_t EXTRA, void (*VARIATIONAL)(const Given<double> &), void (*RHS)(const Given<double> &)>
void variational_by_parameters(const Given<double> &g) {
    const BoundParameters bound = BoundParameters::of<EXTRA>(g);
    const int64_t n = 6 * bound.bodies, size = n + bound.count, rows = g.n / size;
    std::vector<double> Y(n * rows), out(n * rows);
    for (int64_t i = 0; i < rows; ++i) std::copy_n(g.y + size * i, n, Y.data() + n * i);
    if (rows > 0) VARIATIONAL({g.t, Y.data(), nullptr, out.data(), bound.params, n * rows, bound.n_params});
    for (int64_t k = 0; k < bound.count && bound.count < rows; ++k)
        bound.add_derivative<RHS>(g, n, bound.indices[k], n, out.data() + n * (rows - bound.count + k));
    std::fill_n(g.out, g.n, 0.0);
    for (int64_t i = 0; i < rows; ++i) std::copy_n(out.data() + n * i, n, g.out + size * i);
}

// Fills the derivatives (NUMBERS, parameters) of the numbers that FUNCTION fills.
template <int64_t EXTRA, void (*FUNCTION)(const Given<double> &), int64_t NUMBERS>
void value_by_parameters(const Given<double> &g) {
    const BoundParameters bound = BoundParameters::of<EXTRA>(g);
    for (int64_t k = 0; k < bound.count; ++k) {
        double slopes[NUMBERS] = {};
        bound.add_derivative<FUNCTION>(g, g.n, bound.indices[k], NUMBERS, slopes);
        for (int64_t i = 0; i < NUMBERS; ++i) g.out[i * bound.count + k] = slopes[i];
    }
}

}  // namespace eip
