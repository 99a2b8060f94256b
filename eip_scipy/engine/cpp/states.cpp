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

// A real or complex state, the absolute values of its components, and of those times a factor.
struct Moduli {
    const double *y;
    int64_t n;
    bool is_complex;

    // A state of `length` components, -1 for any number of them.
    Moduli(nb::handle state, const char *name, int64_t length = -1)
        : n(length),
          is_complex(is_plain(state.ptr(), NPY_CDOUBLE, 1)) {
        const int type = is_complex ? static_cast<int>(NPY_CDOUBLE) : static_cast<int>(NPY_DOUBLE);
        y = length < 0 ? memory<const double>(state, name, type, Bound{n})
                       : memory<const double>(state, name, type, length);
    }
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

double time_of_motion(nb::handle y, nb::handle f) {
    const double moving = Moduli(f, "f").largest(), size = Moduli(y, "y").largest();
    return moving > 0.0 && size > 0.0 ? size / moving : ENDLESS;
}

Array typical_sizes(nb::handle y, nb::handle f, double tau) {
    const Moduli sizes(y, "y"), motion(f, "f", sizes.n);
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

bool is_canonical(nb::handle y, nb::handle f) {
    const Moduli state(y, "y"), motion(f, "f", state.n);
    const int64_t half = state.n / 2;
    if (state.n % 2 != 0 || state.is_complex || motion.is_complex) return false;
    const double *p = state.y + half, *q_dot = motion.y;
    const auto is_set = [](double a) { return a != 0.0; };
    double along = 0.0;
    for (int64_t k = 0; k < half; ++k) along += is_set(p[k]) ? q_dot[k] * std::copysign(1.0, p[k]) : 0.0 * q_dot[k];
    return std::any_of(q_dot, q_dot + half, is_set) == std::any_of(p, p + half, is_set) && along >= 0.0;
}

Array states_near(nb::handle y, nb::handle sizes, nb::handle ways) {
    const Moduli start(y, "y");
    const int64_t n = start.n, width = start.is_complex ? 2 : 1;
    int64_t count = 0;
    const auto *size = memory<const double>(sizes, "sizes", NPY_DOUBLE, n);
    const auto *way = memory<const double>(ways, "ways", NPY_DOUBLE, Bound{count}, n);
    Array out = new_array({count, n}, start.is_complex ? NPY_CDOUBLE : NPY_DOUBLE);
    double *state = out.floats();
    for (int64_t i = 0; i < count; ++i, state += n * width, way += n) {
        copy(start.y, state, n * width);
        for (int64_t k = 0; k < n; ++k) {
            double &shifted = state[k * width];
            const bool is_zero = shifted == 0.0 && (width == 1 || state[2 * k + 1] == 0.0);
            shifted += (is_zero ? std::abs(way[k]) : way[k]) * size[k];
        }
    }
    return out;
}

// Uses a QR decomposition with pivots: the column with the largest remainder is next.
bool are_independent(nb::handle matrix) {
    int64_t m = 0, n = 0;
    const auto *F = memory<const double>(matrix, "F", NPY_DOUBLE, Bound{m}, Bound{n});
    if (m < n || n > FEW || !all_finite(F, m * n)) return false;
    std::vector<double> columns(m * n);
    const auto scaled = [](double *a, int64_t count, int64_t stride) {
        double top = 0.0;
        for (int64_t i = 0; i < count; ++i) top = std::max(top, std::abs(a[i * stride]));
        for (int64_t i = 0; i < count && top > 0.0; ++i) a[i * stride] /= top;
    };
    for (int64_t i = 0; i < m; ++i) {
        for (int64_t k = 0; k < n; ++k) columns[k * m + i] = F[i * n + k];
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

void raise_residuals(nb::handle largest, nb::handle values, nb::handle target) {
    int64_t l = 0, rows = 0;
    auto *most = memory<double>(largest, "largest", NPY_DOUBLE, Bound{l});
    const auto *value = memory<const double>(values, "values", NPY_DOUBLE, Bound{rows}, l);
    const auto *targets = memory<const double>(target, "target", NPY_DOUBLE, l);
    for (int64_t i = 0; i < rows; ++i)
        for (int64_t k = 0; k < l; ++k) most[k] = std::fmax(most[k], std::abs(value[i * l + k] - targets[k]));
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
