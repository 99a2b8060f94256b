// The Kepler problem with its relativistic term, and the harmonic oscillator.
#include "../library.hpp"

namespace eip {
namespace {

using std::sqrt;

template <class T>
struct Distance {
    T r2, r;

    explicit Distance(const T *q) : r2(q[0] * q[0] + q[1] * q[1]), r(sqrt(r2)) {}
};

// The pull over r: r^-3 + 3/2 eps r^-5, by divisions that do not wait for each other.
template <class T>
[[gnu::always_inline]] inline T pull(const Distance<T> &d, const T &eps) {
    const T w = 1.0 / (d.r2 * d.r);
    return w + 1.5 * eps * w * (1.0 / d.r2);
}

template <class T>
[[gnu::always_inline]] inline T energy_of(const Distance<T> &d, const T *v, const T &eps) {
    return 0.5 * (v[0] * v[0] + v[1] * v[1]) - 1.0 / d.r - 0.5 * eps / (d.r * d.r2);
}

template <class T>
[[gnu::always_inline]] inline T momentum_of(const T *y) {
    return y[0] * y[3] - y[1] * y[2];
}

template <class T>
void kepler_rhs(const Given<T> &g) {
    const T *y = g.y;
    const T w = pull(Distance(y), g.params[0]);
    g.out[0] = y[2];
    g.out[1] = y[3];
    g.out[2] = -w * y[0];
    g.out[3] = -w * y[1];
}

template <class T>
void kepler_acc(const Given<T> &g) {
    const T w = pull(Distance(g.y), g.params[0]);
    g.out[0] = -w * g.y[0];
    g.out[1] = -w * g.y[1];
}

// The derivative of the accelerations at q.
template <class T>
struct PullSlope {
    const T *q;
    T r2 = q[0] * q[0] + q[1] * q[1], inverse = 1.0 / r2, w = inverse / sqrt(r2), pull, radial;

    PullSlope(const T *q, const T &eps) : q(q) {
        const T over = 1.5 * eps * inverse;
        pull = w + w * over;
        radial = (3.0 * w + 5.0 * w * over) * inverse;
    }
    void along(const T *d, T *out) const {
        const T along = radial * (q[0] * d[0] + q[1] * d[1]);
        out[0] = along * q[0] - pull * d[0];
        out[1] = along * q[1] - pull * d[1];
    }
};

// Along dq, which stands in f.
template <class T>
void kepler_jacobian(const Given<T> &g) {
    PullSlope(g.y, g.params[0]).along(g.f, g.out);
}

// The derivative of a state with columns behind it. The last column may be that by the relativistic coefficient.
template <bool BY_PARAMETER>
void kepler_variational(const Given<double> &g) {
    kepler_rhs(g);
    const PullSlope slope(g.y, g.params[0]);
    for (int64_t k = 4; k < g.n; k += 4) {
        g.out[k] = g.y[k + 2];
        g.out[k + 1] = g.y[k + 3];
        slope.along(g.y + k, g.out + k + 2);
    }
    if constexpr (BY_PARAMETER)
        for (int c = 0; c < 2; ++c) g.out[g.n - 2 + c] -= 1.5 * slope.w * slope.inverse * g.y[c];
}

template <class T>
void kepler_energy(const Given<T> &g) {
    g.out[0] = energy_of(Distance(g.y), g.y + 2, g.params[0]);
}

template <class T>
void kepler_energy_gradient(const Given<T> &g) {
    g.out[0] = -g.f[2];
    g.out[1] = -g.f[3];
    g.out[2] = g.y[2];
    g.out[3] = g.y[3];
}

template <class T>
void kepler_momentum(const Given<T> &g) {
    g.out[0] = momentum_of(g.y);
}

template <class T>
void kepler_momentum_gradient(const Given<T> &g) {
    g.out[0] = g.y[3];
    g.out[1] = -g.y[2];
    g.out[2] = -g.y[1];
    g.out[3] = g.y[0];
}

int kepler_all(double, const double *y, double *f, double *values, double *G, const double *params, int wanted) {
    const Distance distance(y);
    const double w = pull(distance, params[0]);
    const double x = y[0], z = y[1], u = y[2], v = y[3], a = -w * x, b = -w * z;
    if (wanted & VALUES_TOO) values[0] = energy_of(distance, y + 2, params[0]), values[1] = momentum_of(y);
    if (wanted & DERIVATIVE_TOO) f[0] = u, f[1] = v, f[2] = a, f[3] = b;
    if (wanted & GRADIENTS_TOO) {
        G[0] = -a, G[1] = -b, G[2] = u, G[3] = v;
        G[4] = v, G[5] = -u, G[6] = -z, G[7] = x;
    }
    return 0;
}

constexpr LibraryPointer<double> KEPLER_VALUES[] = {plain<double, kepler_energy<double>>,
                                                    plain<double, kepler_momentum<double>>};
constexpr LibraryPointer<double> KEPLER_GRADIENTS[] = {plain<double, kepler_energy_gradient<double>>,
                                                       plain<double, kepler_momentum_gradient<double>>};
constexpr Together KEPLER{kepler_all, KEPLER_VALUES, KEPLER_GRADIENTS};

template <class T>
void harmonic_rhs(const Given<T> &g) {
    g.out[0] = g.params[0] * g.y[1];
    g.out[1] = -g.params[0] * g.y[0];
}

template <bool BY_PARAMETER>
void harmonic_variational(const Given<double> &g) {
    for (int64_t k = 0; k < g.n; k += 2) {
        g.out[k] = g.params[0] * g.y[k + 1];
        g.out[k + 1] = -g.params[0] * g.y[k];
    }
    if constexpr (BY_PARAMETER) {
        g.out[g.n - 2] += g.y[1];
        g.out[g.n - 1] -= g.y[0];
    }
}

template <class T>
void harmonic_energy(const Given<T> &g) {
    g.out[0] = 0.5 * g.params[0] * (g.y[0] * g.y[0] + g.y[1] * g.y[1]);
}

template <class T>
void harmonic_energy_gradient(const Given<T> &g) {
    g.out[0] = g.params[0] * g.y[0];
    g.out[1] = g.params[0] * g.y[1];
}

bool of_four(int64_t n, int64_t p) { return n == 4 && p == 1; }
bool of_two(int64_t n, int64_t p) { return n == 2 && p == 1; }
// States with at least COLUMNS columns.
template <int64_t SIZE, int64_t COLUMNS>
bool with_columns(int64_t n, int64_t p) {
    return n >= SIZE * (1 + COLUMNS) && n % SIZE == 0 && p == 1;
}
constexpr const char *FOURS = "a state of 4 numbers, columns of 4 numbers, and 1 parameter";
constexpr const char *TWOS = "a state of 2 numbers, columns of 2 numbers, and 1 parameter";
constexpr const char *FOUR = "a state of 4 numbers and 1 parameter", *TWO = "2 numbers and 1 parameter";

#define EIP_BOTH(function) plain<double, function<double>>, plain<Lanes8, function<Lanes8>>
#define EIP_VARIATIONAL(function, by_parameter, size, sizes) \
    Value::DERIVATIVE, 0, plain<double, function<by_parameter>>, nullptr, with_columns<size, by_parameter>, sizes
const LibraryFunction functions[] = {
    {"kepler.rhs", Value::DERIVATIVE, 0, EIP_BOTH(kepler_rhs), of_four, FOUR, nullptr, nullptr, &KEPLER},
    {"kepler.acc", Value::ACCELERATION, 0, EIP_BOTH(kepler_acc), of_two, TWO},
    {"kepler.jacobian", Value::GRADIENT_BY_F, 1, EIP_BOTH(kepler_jacobian), of_two, TWO},
    {"kepler.variational", EIP_VARIATIONAL(kepler_variational, false, 4, FOURS)},
    {"kepler.variational_by_parameter", EIP_VARIATIONAL(kepler_variational, true, 4, FOURS)},
    {"kepler.energy", Value::NUMBERS, 1, EIP_BOTH(kepler_energy), of_four, FOUR},
    {"kepler.energy_gradient", Value::GRADIENT_BY_F, 1, EIP_BOTH(kepler_energy_gradient), of_four, FOUR},
    {"kepler.momentum", Value::NUMBERS, 1, EIP_BOTH(kepler_momentum), of_four, FOUR},
    {"kepler.momentum_gradient", Value::GRADIENT, 1, EIP_BOTH(kepler_momentum_gradient), of_four, FOUR},
    {"harmonic.rhs", Value::DERIVATIVE, 0, EIP_BOTH(harmonic_rhs), of_two, TWO},
    {"harmonic.variational", EIP_VARIATIONAL(harmonic_variational, false, 2, TWOS)},
    {"harmonic.variational_by_parameter", EIP_VARIATIONAL(harmonic_variational, true, 2, TWOS)},
    {"harmonic.energy", Value::NUMBERS, 1, EIP_BOTH(harmonic_energy), of_two, TWO},
    {"harmonic.energy_gradient", Value::GRADIENT, 1, EIP_BOTH(harmonic_energy_gradient), of_two, TWO},
};
#undef EIP_BOTH
#undef EIP_VARIATIONAL

}  // namespace

std::span<const LibraryFunction> kepler_functions() { return functions; }

}  // namespace eip
