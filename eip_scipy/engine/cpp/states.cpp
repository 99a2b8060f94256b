// Sizes of a state and of its motion, and states near it, for the checks at the start of a run. By NumPy each of these
// functions would take as long as ten steps of a small system.
#include "module.hpp"

#include <cmath>

#include "data.hpp"
#include "floats.hpp"

namespace eip {
namespace {

// Columns are clearly independent if no remainder in their QR decomposition is below this share of the largest. Only
// this many are looked at: LAPACK is faster for more.
constexpr double INDEPENDENT = 1e-8;
constexpr int64_t FEW = 24;

using State = StatesOf<const double, 1>;
using Numbers = ArrayOf<const double, 1>;

// The absolute values of the components of a state, and of those times a factor.
struct Moduli {
    const double *y;
    int64_t n;
    bool is_complex;

    explicit Moduli(const State &state) : y(state.data), n(state.shape[0]), is_complex(state.type == NPY_CDOUBLE) {}
    double operator()(int64_t k, double factor = 1.0) const {
        return is_complex ? std::hypot(factor * y[2 * k], factor * y[2 * k + 1]) : std::abs(factor * y[k]);
    }
    double largest() const {
        double top = 0.0;
        for (int64_t k = 0; k < n && !std::isnan(top); ++k)
            if (const double size = (*this)(k); !(size <= top)) top = size;  // NaN too
        return top;
    }
    bool is_finite(int64_t k) const { return std::isfinite((*this)(k)); }
};

void require_pair(const State &y, const State &f) { require(y.shape[0] == f.shape[0], "expected f of the size of y"); }

double time_of_motion(State y, State f) {
    const double moving = Moduli(f).largest(), size = Moduli(y).largest();
    return moving > 0.0 && size > 0.0 ? size / moving : ENDLESS;
}

Array typical_sizes(State y, State f, double tau) {
    require_pair(y, f);
    const Moduli sizes(y), motion(f);
    Array out = new_array({sizes.n});
    double *floors = out.floats(), top = 0.0;
    for (int64_t k = 0; k < sizes.n; ++k) {
        const double moved = motion.is_finite(k) ? motion(k, tau) : 0.0, least = 1e-3 * sizes(k);
        floors[k] = moved >= least || std::isnan(moved) ? moved : least;
        if (!(floors[k] <= top)) top = floors[k];
    }
    for (int64_t k = 0; k < sizes.n; ++k)
        if (floors[k] == 0.0) floors[k] = top == 0.0 ? 1.0 : top;
    return out;
}

bool is_canonical(State y, State f) {
    require_pair(y, f);
    const int64_t half = y.shape[0] / 2;
    if (y.shape[0] % 2 != 0 || y.type != NPY_DOUBLE || f.type != NPY_DOUBLE) return false;
    const double *p = y.data + half, *q_dot = f.data;
    const auto is_set = [](double a) { return a != 0.0; };
    double along = 0.0;
    for (int64_t k = 0; k < half; ++k) along += is_set(p[k]) ? q_dot[k] * std::copysign(1.0, p[k]) : 0.0 * q_dot[k];
    return std::any_of(q_dot, q_dot + half, is_set) == std::any_of(p, p + half, is_set) && along >= 0.0;
}

Array states_near(State y, Numbers sizes, ArrayOf<const double, 2> ways) {
    const int64_t n = y.shape[0], width = y.type == NPY_CDOUBLE ? 2 : 1;
    require(sizes.shape[0] == n && ways.shape[1] == n, "expected one size and one distance for each component");
    Array out = new_array({ways.shape[0], n}, y.type);
    double *state = out.floats();
    for (int64_t i = 0; i < ways.shape[0]; ++i, state += n * width) {
        const double *way = ways.data + i * n;
        copy(y.data, state, n * width);
        for (int64_t k = 0; k < n; ++k) {
            double &shifted = state[k * width];
            const bool is_zero = shifted == 0.0 && (width == 1 || state[2 * k + 1] == 0.0);
            shifted += (is_zero ? std::abs(way[k]) : way[k]) * sizes.data[k];
        }
    }
    return out;
}

// By a QR decomposition with pivots: the column with the largest remainder is next.
bool are_independent(ArrayOf<const double, 2> F) {
    const int64_t m = F.shape[0], n = F.shape[1];
    if (m < n || n > FEW || !all_finite(F.data, m * n)) return false;
    std::vector<double> columns(m * n);
    const auto scaled = [](double *a, int64_t count, int64_t stride) {
        double top = 0.0;
        for (int64_t i = 0; i < count; ++i) top = std::max(top, std::abs(a[i * stride]));
        for (int64_t i = 0; i < count && top > 0.0; ++i) a[i * stride] /= top;
    };
    for (int64_t i = 0; i < m; ++i) {
        for (int64_t k = 0; k < n; ++k) columns[k * m + i] = F.data[i * n + k];
        scaled(columns.data() + i, n, m);
    }
    for (int64_t k = 0; k < n; ++k) scaled(columns.data() + k * m, m, 1);
    double largest = 0.0;
    for (int64_t done = 0; done < n; ++done) {
        double *pivot = columns.data() + done * m, square = -1.0;
        int64_t best = done;
        for (int64_t k = done; k < n; ++k)
            if (const double own = dot(columns.data() + k * m, columns.data() + k * m, m); own > square)
                square = own, best = k;
        std::swap_ranges(pivot, pivot + m, columns.data() + best * m);
        if (done == 0) largest = square;
        if (!(square > INDEPENDENT * INDEPENDENT * largest)) return false;
        for (int64_t k = done + 1; k < n; ++k) {
            double *other = columns.data() + k * m;
            const double share = dot(pivot, other, m) / square;
            for (int64_t i = 0; i < m; ++i) other[i] -= share * pivot[i];
        }
    }
    return true;
}

void raise_residuals(ArrayOf<double, 1> largest, ArrayOf<const double, 2> values, Numbers target) {
    const int64_t l = largest.shape[0];
    require(values.shape[1] == l && target.shape[0] == l, "expected one number for each value of the invariants");
    for (int64_t i = 0; i < values.shape[0]; ++i)
        for (int64_t k = 0; k < l; ++k)
            largest.data[k] = std::fmax(largest.data[k], std::abs(values.data[i * l + k] - target.data[k]));
}

}  // namespace

void add_states(Module module) {
    module.def("time_of_motion", &time_of_motion, "y"_a, "f"_a,
               "Return the time in which a state changes by its own size; infinite if it or its derivative `f` is 0.");
    module.def("typical_sizes", &typical_sizes, "y"_a, "f"_a, "tau"_a,
               "Return for each component a size that is added to |y_k|, so that shifts do not vanish with the "
               "component: ``abs(tau * f[k])``, the motion in a step of length `tau`, and at least 1e-3 |y_k|. If both "
               "are 0, it is the largest size of the other components, or 1 if all are 0.");
    module.def("is_canonical", &is_canonical, "y"_a, "f"_a,
               "Return True if a state y with the derivative f is taken as (q, p): it is real and has an even number n "
               "of components, ``f[: n // 2]`` and ``p = y[n // 2 :]`` are both zero or both nonzero, and the sum of "
               "``f[: n // 2] * sign(p)`` is not negative.");
    module.def("states_near", &states_near, "y"_a, "sizes"_a, "ways"_a,
               "Return the states ``y + ways * sizes``, (m, n). Components that are 0 at y become positive.");
    module.def(
        "are_independent", &are_independent, "F"_a,
        "Return True if the columns of F (m, n), with rows and then columns in units of their largest entries, are "
        "clearly independent; False too if there are more than 24 columns, or a number is not finite.");
    module.def("raise_residuals", &raise_residuals, "largest"_a, "values"_a, "target"_a,
               "Raise `largest` (l,) to the distances of the values (m, l) from the target (l,); NaN does not count.");
}

}  // namespace eip
