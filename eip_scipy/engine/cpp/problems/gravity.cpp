// Newton's gravitation of N bodies; the parameters are every G m.
#include "newton.hpp"

namespace eip {
namespace {

template <class T>
void rhs(const Given<T> &g) {
    newton_rhs(g.y, g.params, g.p, g.out);
}

template <class T>
void acc(const Given<T> &g) {
    accelerate(g.y, g.params, g.p, g.out);
}

template <class T>
void energy(const Given<T> &g) {
    g.out[0] = energy_sum(g.y, g.params, g.p);
}

template <class T>
void gradient_of_energy(const Given<T> &g) {
    energy_gradient(g.y, g.f, g.params, g.p, g.out);
}

template <class T>
void momentum(const Given<T> &g) {
    angular_momentum(g.y, g.params, g.p, g.out);
}

template <class T>
void gradient_of_momentum(const Given<T> &g) {
    angular_momentum_gradient(g.y, g.params, g.p, g.out);
}

template <class T>
void central(const Given<T> &g) {
    central_jacobian(g.y, g.f, g.params, g.n / 3, g.out);
}

bool of_bodies(int64_t n, int64_t p) { return p > 0 && n == 6 * p; }
bool at_positions(int64_t n, int64_t p) { return p > 0 && n == 3 * p; }
bool at_positions_first(int64_t n, int64_t p) { return n > 0 && n % 3 == 0 && p >= n / 3; }
constexpr const char *BODIES = "positions and velocities, 6 numbers a body, and every G m";
constexpr const char *POSITIONS = "positions, 3 numbers a body, and every G m";

#define EIP_BOTH(function) plain<double, function<double>>, plain<Octet, function<Octet>>
const LibraryFunction functions[] = {
    {"gravity.rhs", Value::DERIVATIVE, 0, EIP_BOTH(rhs), of_bodies, BODIES},
    {"gravity.acc", Value::ACCELERATION, 0, EIP_BOTH(acc), at_positions, POSITIONS},
    {"gravity.central", Value::GRADIENT_BY_F, 1, EIP_BOTH(central), at_positions_first, POSITIONS},
    {"gravity.energy", Value::NUMBERS, 1, EIP_BOTH(energy), of_bodies, BODIES},
    {"gravity.energy_gradient", Value::GRADIENT_BY_F, 1, EIP_BOTH(gradient_of_energy), of_bodies, BODIES},
    {"gravity.momentum", Value::NUMBERS, 3, EIP_BOTH(momentum), of_bodies, BODIES},
    {"gravity.momentum_gradient", Value::GRADIENT, 3, EIP_BOTH(gradient_of_momentum), of_bodies, BODIES},
};
#undef EIP_BOTH

}  // namespace

std::span<const LibraryFunction> gravity_functions() { return functions; }

}  // namespace eip
