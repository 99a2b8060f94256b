// The invariants of a run as Python calls them, all at once, and a first look at them, at one of a run's states. If it finds
// something, core/invariant_checks.py examines it in Python, and writes the messages.
#include "module.hpp"

#include <nanobind/stl/tuple.h>

#include <bit>
#include <cmath>

#include "floats.hpp"
#include "python_functions.hpp"

namespace eip {
namespace {

// Gradients are compared with central differences over steps of this length in units of the components' motion, and may
// differ by this fraction of the terms and by this number of roundings of the values.
constexpr double CHECK_STEP = 6e-6, CHECK_TOLERANCE = 1e-4, CHECK_NOISE = 6.0;
// The share of its terms by which an invariant may change along the flow.
constexpr double INVARIANCE_TOLERANCE = 1e-8;
// Derivatives in time are taken over this share of a step, and to both sides where as many of these shares have room.
constexpr double TIME_SHARE = 0.01, TIME_ROOM = 5.0;
// Short differences along the flow: their step, in the time in which the state moves by its size, and the share of the
// rate's terms from which on those to both sides differ. What curvature makes them differ by is half as large at half
// the step; what a kink does is not. Next to a kink of the slope, where terms may vanish, the differences to both
// sides differ by more than the rate that is found.
constexpr double SHORT = 1e-6, KINK = 1e-4, KEPT_AT_HALF = 0.6;
// The rounding of a value, in units of its terms.
constexpr double VALUE_ROUNDINGS = 4.0;

using Buffer = std::vector<double>;
using Interval = std::tuple<double, double>;

// Detection of numbers of single precision that use more than half of its bits.
class Single {
  public:
    void add(double value) {
        exact_ = exact_ && static_cast<double>(static_cast<float>(value)) == value;
        long_ = long_ || (std::bit_cast<uint64_t>(value) & ((uint64_t{1} << 40) - 1)) != 0;
    }
    explicit operator bool() const { return exact_ && long_; }

  private:
    bool exact_ = true, long_ = false;
};

class InvariantFunctions {
  public:
    InvariantFunctions(const nb::tuple &values, const nb::tuple &gradients, int64_t n, bool is_complex)
        : type_(is_complex ? static_cast<int>(NPY_CDOUBLE) : static_cast<int>(NPY_DOUBLE)),
          n_(n),
          m_(is_complex ? 2 * n : n) {
        for (const nb::handle call : values) l_ += inv_.emplace_back(call, type_, n, kept_).floats();
        int64_t floats = 0;
        for (const nb::handle call : gradients) floats += grad_.emplace_back(call, type_, n, kept_).floats();
        require(floats == l_ * m_,
                "invariants: the gradients do not have l * n numbers for the l values of the invariants");
    }

    Array values(double t, nb::handle y) {
        Array out = new_array({l_});
        evaluate(t, state(y), out.floats());
        return out;
    }

    Array gradients(double t, nb::handle y, nb::handle f) {
        Array out = new_array({l_, n_}, type_);
        const double *at = state(y), *slope = state(f);
        double *G = out.floats();
        for (const PythonCall &call : grad_) {
            call(t, at, slope, G, out);
            G += call.floats();
        }
        return out;
    }

    // True if nothing is wrong with the values' precision, with the gradients G and with the invariance at a state. For a
    // run of no duration it is false, and for NaN too.
    bool is_in_order(double t, nb::handle y, nb::handle f, nb::handle G, nb::handle here, double tau, Interval interval,
                     nb::handle directions) {
        const Point at(*this, t, y, f, G, here);
        return are_kept(at) && are_fixed(at, tau, interval) && have_right_gradients(at, tau, rows(directions, 2));
    }

    // Calls `note_rates` and `is_in_order` for a state of a run. If f is empty or not finite, it only returns true.
    bool look(nb::handle figures, double t, nb::handle y, nb::handle f, nb::handle target, nb::handle scales,
              double tau, Interval interval, nb::handle directions) {
        if (n_ == 0 || !all_finite(state(f), m_)) return true;
        const Array G = gradients(t, y, f), here = values(t, y);
        note_rates(figures, t, y, f, G, here, target, scales, nb::none());
        return is_in_order(t, y, f, G, here, tau, interval, directions);
    }

    // The rates of change along f by short differences to both sides; NaN where these differ at a kink. Rates that are
    // within the rounding of the values, which is larger than terms that nearly vanish, are 0.
    Array rates_by_values(double t, nb::handle y, nb::handle f, nb::handle G, nb::handle here, nb::handle target,
                          nb::handle scales) {
        const Point at(*this, t, y, f, G, here);
        const double *targets = numbers(target), *least = numbers(scales);
        Array out = new_array({l_});
        double *rates = out.floats();
        fill(rates, 0.0, l_);
        const double moving = largest(at.f), size = largest(at.y);
        if (!(0.0 < moving && moving < ENDLESS && 0.0 < size && size < ENDLESS)) return out;
        const double step = SHORT * size / moving;
        const Slopes slopes = slopes_along(at, step), half = slopes_along(at, 0.5 * step);
        for (int64_t i = 0; i < l_; ++i) {
            const double jump = std::abs(slopes.forth[i] - slopes.back[i]);
            const double half_jump = std::abs(half.forth[i] - half.back[i]);
            const double *row = at.G + i * m_;
            rates[i] = 0.5 * (slopes.back[i] + slopes.forth[i]);
            if (jump > KINK * terms(row, at.f) && (half_jump > KEPT_AT_HALF * jump || std::abs(rates[i]) <= jump))
                rates[i] = NOT_A_NUMBER;
            const double own = std::max({std::abs(at.values[i]), std::abs(targets[i]), terms(row, at.y), least[i]});
            if (std::abs(rates[i]) <= VALUE_ROUNDINGS * EPS * own / step) rates[i] = 0.0;
        }
        return out;
    }

    // Raises the largest rates of change along f that figures hold, by gradients and by values. They are in units of the
    // terms, without what the values change by anyway: `own`, of balances, or None.
    void note_rates(nb::handle figures, double t, nb::handle y, nb::handle f, nb::handle G, nb::handle here,
                    nb::handle target, nb::handle scales, nb::handle own) {
        double *noted = memory<double>(figures, "figures", NPY_DOUBLE, l_, N_FIGURES);
        const Array by_values = rates_by_values(t, y, f, G, here, target, scales);
        const double *slope = state(f), *row = rows(G, l_), *changes = own.is_none() ? nullptr : numbers(own);
        for (int64_t i = 0; i < l_; ++i, noted += N_FIGURES, row += m_) {
            const double expected = changes ? changes[i] : 0.0, size = terms(row, slope),
                         unit = size > 0.0 ? size : 1.0;
            noted[RATE] = std::fmax(noted[RATE], std::abs(dot(row, slope, m_) - expected) / unit);
            noted[EXAMINED] = std::fmax(noted[EXAMINED], std::abs(by_values.floats()[i] - expected) / unit);
        }
    }

    nb::handle kept() const { return kept_; }
    void clear() {
        inv_.clear();
        grad_.clear();
        kept_.reset();
    }

  private:
    struct Slopes {
        Buffer back, forth;
    };

    const double *state(nb::handle y) const { return memory<const double>(y, "a state", type_, n_); }
    const double *rows(nb::handle G, int64_t count) const {
        return memory<const double>(G, "G or directions", type_, count, n_);
    }
    const double *numbers(nb::handle a) const {
        return memory<const double>(a, "a number of each value", NPY_DOUBLE, l_);
    }

    // A state with its derivative, and the gradients and values there.
    struct Point {
        double t;
        const double *y, *f, *G, *values;

        Point(const InvariantFunctions &all, double t, nb::handle y, nb::handle f, nb::handle G, nb::handle values)
            : t(t),
              y(all.state(y)),
              f(all.state(f)),
              G(all.rows(G, all.l_)),
              values(all.numbers(values)) {}
    };

    void evaluate(double t, const double *y, double *out) const {
        for (const PythonCall &call : inv_) {
            call(t, y, nullptr, out, {});
            out += call.floats();
        }
    }

    double modulus(const double *a, int64_t k) const {
        return type_ == NPY_CDOUBLE ? std::hypot(a[2 * k], a[2 * k + 1]) : std::abs(a[k]);
    }
    double largest(const double *a) const {
        double top = 0.0;
        for (int64_t k = 0; k < n_; ++k) {
            const double size = modulus(a, k);
            if (!(size <= top)) top = size;  // NaN too
        }
        return top;
    }
    // The sum of |G_k| |a_k|.
    double terms(const double *G, const double *a) const {
        double total = 0.0;
        for (int64_t k = 0; k < n_; ++k) total += modulus(G, k) * modulus(a, k);
        return total;
    }

    Buffer shifted(const double *y, double by, const double *way) const {
        Buffer state(y, y + m_);
        for (int64_t j = 0; j < m_; ++j) state[j] += by * way[j];
        return state;
    }

    Slopes slopes_along(const Point &at, double step) const {
        Slopes found{Buffer(l_), Buffer(l_)};
        evaluate(at.t, shifted(at.y, -step, at.f).data(), found.back.data());
        evaluate(at.t, shifted(at.y, step, at.f).data(), found.forth.data());
        for (int64_t i = 0; i < l_; ++i) {
            found.back[i] = (at.values[i] - found.back[i]) / step;
            found.forth[i] = (found.forth[i] - at.values[i]) / step;
        }
        return found;
    }

    // True if no invariant changes along a derivative of double precision.
    bool are_kept(const Point &at) const {
        for (int64_t j = 0; j < m_; ++j) {
            Single single;
            single.add(at.f[j]);
            if (single) return false;
        }
        for (const double *row = at.G; row < at.G + l_ * m_; row += m_)
            if (!(std::abs(dot(row, at.f, m_)) <= INVARIANCE_TOLERANCE * abs_dot(row, at.f, m_))) return false;
        return true;
    }

    bool have_values(double t, const double *y, const double *expected) const {
        Buffer values(l_);
        evaluate(t, y, values.data());
        return std::equal(values.begin(), values.end(), expected);
    }

    // True if the values are the same at two other times.
    bool are_fixed(const Point &at, double tau, const Interval &interval) const {
        const double t = at.t;
        const auto [low, high] = std::minmax(std::get<0>(interval), std::get<1>(interval));
        const double before = t - low, after = high - t, room = std::max(before, after);
        const double side = after >= before ? 1.0 : -1.0, far = t + side * std::min(room, tau);
        if (far == t || !(0.0 < tau && tau < ENDLESS)) return false;
        const bool centred = std::min(before, after) >= TIME_ROOM * TIME_SHARE * tau;
        const double step = centred ? std::nearbyint(std::log2(TIME_SHARE * tau))
                                    : std::floor(std::log2(std::min(TIME_SHARE * tau, room / 6.0)));
        return have_values(far, at.y, at.values) && have_values(t + side * std::exp2(step), at.y, at.values);
    }

    // True if the gradients agree with differences along two directions, `ways`, of values that have double precision.
    bool have_right_gradients(const Point &at, double tau, const double *ways) const {
        const double moving = largest(at.f), size = largest(at.y);
        const double reach = size > 0.0 && moving > 0.0 ? std::min(tau, size / moving) : tau;
        std::vector<Single> single(l_);
        for (int64_t i = 0; i < l_; ++i) single[i].add(at.values[i]);
        Buffer way(m_), ends[2] = {Buffer(l_), Buffer(l_)};
        const int width = static_cast<int>(m_ / n_);
        for (const double *direction : {ways, ways + m_}) {
            for (int64_t j = 0; j < m_; ++j)
                way[j] = direction[j] * (modulus(at.y, j / width) + reach * modulus(at.f, j / width));
            evaluate(at.t, shifted(at.y, CHECK_STEP, way.data()).data(), ends[0].data());
            evaluate(at.t, shifted(at.y, -CHECK_STEP, way.data()).data(), ends[1].data());
            for (int64_t i = 0; i < l_; ++i) {
                const double *row = at.G + i * m_, above = ends[0][i], below = ends[1][i];
                const double difference = (above - below) * (0.5 / CHECK_STEP), along = dot(row, way.data(), m_);
                const double noise = CHECK_NOISE / CHECK_STEP * EPS * std::max(std::abs(above), std::abs(below));
                if (!(std::abs(difference - along) <= CHECK_TOLERANCE * abs_dot(row, way.data(), m_) + noise))
                    return false;
                single[i].add(above);
                single[i].add(below);
            }
        }
        return std::none_of(single.begin(), single.end(), [](const Single &found) { return bool(found); });
    }

    nb::list kept_;  // every object that is called
    int type_;
    int64_t n_, m_, l_ = 0;
    std::vector<PythonCall> inv_, grad_;
};

// The right-hand side of a run as Python calls it. If it is of second order, the function returns the accelerations.
class RightHandSide {
  public:
    RightHandSide(nb::handle call, int64_t n, bool is_complex, bool second_order)
        : type_(is_complex ? static_cast<int>(NPY_CDOUBLE) : static_cast<int>(NPY_DOUBLE)),
          n_(n),
          half_((second_order ? n / 2 : 0) * (is_complex ? 2 : 1)) {
        const int64_t m = is_complex ? 2 * n : n;
        require(function_.emplace_back(call, type_, second_order ? n / 2 : n, kept_).floats() == m - half_,
                "rhs must give as many numbers as the state has");
    }

    Array derivative(nb::handle time, nb::handle y) {
        const Array state = owned<Array>(PyArray_FROMANY(y.ptr(), type_, 1, 1, NPY_ARRAY_CARRAY_RO));
        require(kept_.is_valid() && state.size() == n_, "rhs: y has another size than the state of the run");
        Array out = new_array({n_}, type_);
        evaluate(nb::cast<double>(time), state.floats(), out.floats(), out, time);
        return out;
    }

    Array derivatives(nb::handle times, nb::handle states) {
        require(kept_.is_valid(), "rhs: the functions of the run are gone");
        int64_t count = 0;
        const auto *time = memory<const double>(times, "times", NPY_DOUBLE, Bound{count});
        const auto *y = memory<const double>(states, "y", type_, count, n_);
        Array out = new_array({count, n_}, type_);
        const int64_t m = n_ * (type_ == NPY_CDOUBLE ? 2 : 1);
        for (int64_t k = 0; k < count; ++k) {
            double *f = out.floats() + k * m;
            try {
                evaluate(time[k], y + k * m, f, out, nb::float_(time[k]));
            } catch (nb::python_error &error) {
                if (!error.matches(PyExc_Exception) || error.matches(PyExc_MemoryError)) throw;
                fill(f, NOT_A_NUMBER, m);
            }
        }
        return out;
    }

    nb::handle kept() const { return kept_; }
    void clear() {
        function_.clear();
        kept_.reset();
    }

  private:
    void evaluate(double t, const double *y, double *f, nb::handle owner, nb::handle time) const {
        copy(y + half_, f, half_);
        function_.front()(t, y, nullptr, f + half_, owner, time);
    }

    nb::list kept_;  // every object that is called
    int type_;
    int64_t n_, half_;
    std::vector<PythonCall> function_;  // none after `clear`
};

bool are_finite(const nb::object &numbers) {
    auto *array = reinterpret_cast<PyArrayObject *>(numbers.ptr());
    const bool floats = PyArray_Check(numbers.ptr()) && PyArray_TYPE(array) == NPY_DOUBLE && PyArray_ISCARRAY_RO(array);
    if (!floats) throw nb::type_error("are_finite: expected a C-contiguous array of float64");
    return all_finite(static_cast<const double *>(PyArray_DATA(array)), PyArray_SIZE(array));
}

}  // namespace

void add_examination(Module module) {
    module.def("are_finite", &are_finite, "numbers"_a, "Return True if no number is NaN or infinite.");
    Class<RightHandSide>(
        module, "RightHandSide", nb::type_slots(Collected<RightHandSide>::slots),
        "The right-hand side of a run, from a `Call` of the function, which returns the accelerations if "
        "the equations are of `second_order`.")
        .def(nb::init<nb::handle, int64_t, bool, bool>(), "call"_a, "n"_a, "is_complex"_a, "second_order"_a)
        .def("__call__", &RightHandSide::derivative, "t"_a, "y"_a, "Return the derivative (n,) at (t, y), a new array.")
        .def("derivatives", &RightHandSide::derivatives, "times"_a, "y"_a,
             "Return the derivatives (m, n) at times (m,) and states (m, n); NaN where the function raises an "
             "exception.");
    using Functions = InvariantFunctions;
    Class<Functions>(module, "InvariantFunctions", nb::type_slots(Collected<Functions>::slots),
                     "The invariants of a run and their gradients, each as a `Call`.")
        .def(nb::init<const nb::tuple &, const nb::tuple &, int64_t, bool>(), "values"_a, "gradients"_a, "n"_a,
             "is_complex"_a)
        .def("values", &Functions::values, "t"_a, "y"_a, "Return all values (l,).")
        .def("gradients", &Functions::gradients, "t"_a, "y"_a, "f"_a, "Return all gradients (l, n).")
        .def("is_in_order", &Functions::is_in_order, "t"_a, "y"_a, "f"_a, "G"_a, "here"_a, "tau"_a, "interval"_a,
             "directions"_a, "Return True if the checks of precision, gradients `G` and invariance find nothing.")
        .def("look", &Functions::look, "figures"_a, "t"_a, "y"_a, "f"_a, "target"_a, "scales"_a, "tau"_a, "interval"_a,
             "directions"_a, "Call `note_rates` and return `is_in_order`, for a state of a run without balances.")
        .def("rates_by_values", &Functions::rates_by_values, "t"_a, "y"_a, "f"_a, "G"_a, "here"_a, "target"_a,
             "scales"_a, "Return the rates of change (l,) of the invariants along `f`, by short differences.")
        .def("note_rates", &Functions::note_rates, "figures"_a, "t"_a, "y"_a, "f"_a, "G"_a, "here"_a, "target"_a,
             "scales"_a, "own"_a = nb::none(), "Update the largest rates of change along `f` in `figures`.");
    module.attr("CHECK_STEP") = CHECK_STEP;
    module.attr("CHECK_TOLERANCE") = CHECK_TOLERANCE;
    module.attr("CHECK_NOISE") = CHECK_NOISE;
    module.attr("INVARIANCE_TOLERANCE") = INVARIANCE_TOLERANCE;
    module.attr("TIME_SHARE") = TIME_SHARE;
    module.attr("TIME_ROOM") = TIME_ROOM;
}

}  // namespace eip
