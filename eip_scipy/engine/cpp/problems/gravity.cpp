// Newton's gravitation of N bodies; the parameters are every G m.
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

bool with_columns(int64_t n, int64_t p) { return p > 0 && n > 0 && n % (6 * p) == 0; }
bool in_phase_space(int64_t n, int64_t p) { return p > 0 && n == 6 * p; }
bool at_positions(int64_t n, int64_t p) { return p > 0 && n == 3 * p; }
bool at_positions_first(int64_t n, int64_t p) { return n > 0 && n % 3 == 0 && p >= n / 3; }
constexpr const char *COLUMNS =
    "a state of 6 numbers per body, columns of the same size, and G m of every body as parameters";
constexpr const char *BODIES = "positions and velocities, 6 numbers per body, and G m of every body as parameters";
constexpr const char *POSITIONS = "positions, 3 numbers per body, and G m of every body as parameters";

#define EIP_BOTH(function) plain<double, function<double>>, plain<Lanes8, function<Lanes8>>
#define EIP_OF_BODIES(function) plain<double, of_bodies<double, function>>, plain<Lanes8, of_bodies<Lanes8, function>>
const LibraryFunction functions[] = {
    {"gravity.rhs", Value::DERIVATIVE, 0, EIP_OF_BODIES(newton_rhs), in_phase_space, BODIES, rhs_apart, nullptr,
     nullptr, &RHS_WITH_ENERGY},
    {"gravity.acc", Value::ACCELERATION, 0, EIP_OF_BODIES(accelerate), at_positions, POSITIONS, acc_apart, nullptr,
     nullptr, &ACC_WITH_ENERGY},
    {"gravity.variational", Value::DERIVATIVE, 0, EIP_BOTH(variational), with_columns, COLUMNS},
    {"gravity.central", Value::GRADIENT_BY_F, 1, EIP_BOTH(central), at_positions_first, POSITIONS},
    {"gravity.energy", Value::NUMBERS, 1, EIP_BOTH(energy), in_phase_space, BODIES},
    {"gravity.energy_gradient", Value::GRADIENT_BY_F, 1, EIP_BOTH(gradient_of_energy), in_phase_space, BODIES},
    {"gravity.momentum", Value::NUMBERS, 3, EIP_OF_BODIES(angular_momentum), in_phase_space, BODIES},
    {"gravity.momentum_gradient", Value::GRADIENT, 3, EIP_OF_BODIES(angular_momentum_gradient), in_phase_space, BODIES},
};
#undef EIP_BOTH
#undef EIP_OF_BODIES

}  // namespace

std::span<const LibraryFunction> gravity_functions() { return functions; }

}  // namespace eip
