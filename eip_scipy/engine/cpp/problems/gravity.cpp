// Newton's gravitation of N bodies; the parameters are every G m.
#include "by_parameters.hpp"
#include "newton.hpp"
#include "tides.hpp"

namespace eip {
namespace {

// A function of the state, every G m, the number of bodies, and what is to be filled.
template <class T, void (*FUNCTION)(const T *, const T *, int64_t, T *)>
void of_bodies(const Given<T> &g) {
    FUNCTION(g.y, g.params, g.p, g.out);
}

void rhs_apart(const double *y, double *out, double *pulls, const double *gm, int64_t, int64_t bodies) {
    std::copy(y + 3 * bodies, y + 6 * bodies, out);
    accelerate_apart(y, gm, bodies, out + 3 * bodies, pulls);
}

void acc_apart(const double *q, double *out, double *pulls, const double *gm, int64_t, int64_t bodies) {
    accelerate_apart(q, gm, bodies, out, pulls);
}

template <class T>
void energy(const Given<T> &g) {
    g.out[0] = energy_sum(g.y, g.params, g.p);
}

void momentum(const Given<double> &g) { of_bodies<double, angular_momentum>(g); }

double rhs_with_energy(const double *y, const double *gm, int64_t bodies, double *out) {
    std::copy(y + 3 * bodies, y + 6 * bodies, out);
    return accelerate_with_energy(y, gm, bodies, out + 3 * bodies);
}

constexpr WithEnergy RHS_WITH_ENERGY{rhs_with_energy, plain<double, energy<double>>, MANY};
constexpr WithEnergy ACC_WITH_ENERGY{accelerate_with_energy, plain<double, energy<double>>, MANY};

template <class T>
void gradient_of_energy(const Given<T> &g) {
    energy_gradient(g.y, g.f, g.params, g.p, g.out);
}

template <class T>
void central(const Given<T> &g) {
    central_jacobian(g.y, g.f, g.params, g.n / 3, g.out);
}

// For a state followed by columns of derivatives.
template <class T>
void variational(const Given<T> &g) {
    newton_variational(g.y, g.params, g.p, g.n / (6 * g.p) - 1, g.out);
}

// Half the rate of the squared distance of bodies i and j, in space or as seen along an axis, of the parameters (i, j, axis).
void approach(const Given<double> &g) {
    const auto index = [&](double body) { return 0.0 <= body && body < g.n / 6 ? static_cast<int64_t>(body) : 0; };
    const int64_t i = index(g.params[0]), j = index(g.params[1]);
    const double *x = g.y, *v = g.y + g.n / 2, *axis = g.params + 2;
    double rate = 0.0, along = 0.0, speed = 0.0;
    for (int c = 0; c < 3; ++c) {
        const double dx = x[3 * j + c] - x[3 * i + c], dv = v[3 * j + c] - v[3 * i + c];
        rate += dx * dv;
        along += axis[c] * dx;
        speed += axis[c] * dv;
    }
    g.out[0] = rate - along * speed;
}

bool with_columns(int64_t n, int64_t p) { return p > 0 && n > 0 && n % (6 * p) == 0; }
bool of_pair(int64_t n, int64_t p) { return n > 0 && n % 6 == 0 && p == 5; }
bool is_bound(int64_t n, int64_t p) { return n > 0 && p > 2; }
bool in_phase_space(int64_t n, int64_t p) { return p > 0 && n == 6 * p; }
bool at_positions(int64_t n, int64_t p) { return p > 0 && n == 3 * p; }
bool at_positions_first(int64_t n, int64_t p) { return n > 0 && n % 3 == 0 && p >= n / 3; }
constexpr const char *COLUMNS =
    "a state of 6 numbers per body, columns of the same size, and G m of every body as parameters";
constexpr const char *BODIES = "positions and velocities, 6 numbers per body, and G m of every body as parameters";
constexpr const char *BOUND = "a state of bodies, and to be bound to parameters, the indices of some, and their number";
constexpr const char *POSITIONS = "positions, 3 numbers per body, and G m of every body as parameters";

#define EIP_BOTH(function) plain<double, function<double>>, plain<Lanes8, function<Lanes8>>
#define EIP_OF_BODIES(function) plain<double, of_bodies<double, function>>, plain<Lanes8, of_bodies<Lanes8, function>>
#define EIP_BY_PARAMETERS(function, numbers)                                                                     \
    Value::NUMBERS, numbers, plain<double, value_by_parameters<0, function, numbers>>, nullptr, is_bound, BOUND, \
        nullptr, nullptr, nullptr, nullptr, true
const LibraryFunction functions[] = {
    {"gravity.rhs", Value::DERIVATIVE, 0, EIP_OF_BODIES(newton_rhs), in_phase_space, BODIES, rhs_apart, nullptr,
     nullptr, &RHS_WITH_ENERGY},
    {"gravity.acc", Value::ACCELERATION, 0, EIP_OF_BODIES(accelerate), at_positions, POSITIONS, acc_apart, nullptr,
     nullptr, &ACC_WITH_ENERGY},
    {"gravity.variational", Value::DERIVATIVE, 0, EIP_BOTH(variational), with_columns, COLUMNS},
    {"gravity.variational_by_parameters", Value::DERIVATIVE, 0,
     plain<double, variational_by_parameters<0, variational<double>, of_bodies<double, newton_rhs>>>, nullptr, is_bound,
     BOUND},
    {"gravity.energy_by_parameters", EIP_BY_PARAMETERS(energy<double>, 1)},
    {"gravity.momentum_by_parameters", EIP_BY_PARAMETERS(momentum, 3)},
    {"gravity.approach", Value::NUMBERS, 1, plain<double, approach>, nullptr, of_pair,
     "positions and velocities, and to be bound to two indices and an axis"},
    {"gravity.central", Value::GRADIENT_BY_F, 1, EIP_BOTH(central), at_positions_first, POSITIONS},
    {"gravity.energy", Value::NUMBERS, 1, EIP_BOTH(energy), in_phase_space, BODIES},
    {"gravity.energy_gradient", Value::GRADIENT_BY_F, 1, EIP_BOTH(gradient_of_energy), in_phase_space, BODIES},
    {"gravity.momentum", Value::NUMBERS, 3, EIP_OF_BODIES(angular_momentum), in_phase_space, BODIES},
    {"gravity.momentum_gradient", Value::GRADIENT, 3, EIP_OF_BODIES(angular_momentum_gradient), in_phase_space, BODIES},
};
#undef EIP_BOTH
#undef EIP_OF_BODIES
#undef EIP_BY_PARAMETERS

}  // namespace

std::span<const LibraryFunction> gravity_functions() { return functions; }

}  // namespace eip
