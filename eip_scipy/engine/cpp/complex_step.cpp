// Gradients of functions in Python by complex steps: Im I(y + i h e_k) / h, which loses no digit to a difference.
#include "module.hpp"

#include <cmath>
#include <vector>

namespace eip {

namespace {

// Steps of the differences that a gradient is compared with, one to one side, then some to both, the shorter one next to
// a singularity; and how far they may differ: in units of the sum of the derivative's terms, and in roundings of the
// values.
constexpr double ONE_SIDED = 1e-8, TWO_SIDED[] = {1e-5, 1e-7};
constexpr double AGREEMENT = 1e-6, ROUNDINGS = 8.0;

// y with a small imaginary part in component k: a new array each time, since the function may keep what it was given.
Array shifted(const double *y, npy_intp n, npy_intp k, double step) {
    Array array = new_array({n}, NPY_CDOUBLE);
    double *z = array.floats();
    for (npy_intp j = 0; j < n; ++j) {
        z[2 * j] = y[j];
        z[2 * j + 1] = 0.0;
    }
    z[2 * k + 1] = step;
    return array;
}

// The gradient (..., n) of a function with values of the shape (...,), filled by columns.
class Columns {
  public:
    Columns(npy_intp n, double step) : n_(n), step_(step) {}

    void take(PyObject *value, npy_intp k) {
        // The real part is taken from the first column.
        if (k > 0 && PyComplex_Check(value) && PyArray_NDIM(gradient_.get()) == 1) {
            out_[k] = PyComplex_ImagAsDouble(value) / step_;
            return;
        }
        const Array numbers = as_complex(value);
        PyArrayObject *found = numbers.get();
        if (k == 0) make(found);
        require_shape(found);
        const double *pairs = numbers.floats();
        for (npy_intp i = 0; i < PyArray_SIZE(found); ++i) out_[i * n_ + k] = pairs[2 * i + 1] / step_;
        if (k > 0) return;
        values_.resize(PyArray_SIZE(found));
        for (size_t i = 0; i < values_.size(); ++i) values_[i] = pairs[2 * i];
    }

    const double *row(size_t i) const { return out_ + i * n_; }
    const std::vector<double> &values() const { return values_; }

    const Array &gradient() const { return gradient_; }

  private:
    static Array as_complex(PyObject *value) {
        const Array array = owned<Array>(PyArray_FROM_O(value));
        const int type = PyArray_TYPE(array.get());
        if (!PyTypeNum_ISNUMBER(type) && !PyTypeNum_ISBOOL(type))
            refuse(PyExc_TypeError, "the function returned %.80R, expected numbers", value);
        return owned<Array>(PyArray_FROM_OTF(array.ptr(), NPY_CDOUBLE, NPY_ARRAY_IN_ARRAY | NPY_ARRAY_FORCECAST));
    }

    void make(PyArrayObject *value) {
        std::vector<npy_intp> shape(PyArray_DIMS(value), PyArray_DIMS(value) + PyArray_NDIM(value));
        shape.push_back(n_);
        gradient_ = owned<Array>(PyArray_SimpleNew(static_cast<int>(shape.size()), shape.data(), NPY_DOUBLE));
        out_ = gradient_.floats();
    }

    void require_shape(PyArrayObject *value) const {
        const int axes = PyArray_NDIM(value);
        PyArrayObject *gradient = gradient_.get();
        require(axes + 1 == PyArray_NDIM(gradient) &&
                    PyArray_CompareLists(PyArray_DIMS(value), PyArray_DIMS(gradient), axes),
                "the function returned values of different shapes; return the same shape in each call");
    }

    npy_intp n_;
    double step_;
    Array gradient_;
    std::vector<double> values_;
    double *out_ = nullptr;
};

// The function's values at y + step * way, (l,).
template <class Function>
std::vector<double> values_at(const Function &function, const double *y, const std::vector<double> &way, double step) {
    const Array state = new_array({static_cast<npy_intp>(way.size())});
    for (size_t k = 0; k < way.size(); ++k) state.floats()[k] = y[k] + step * way[k];
    const Array found = owned<Array>(PyArray_FROM_OTF(function(state).ptr(), NPY_DOUBLE, NPY_ARRAY_IN_ARRAY));
    return {found.floats(), found.floats() + found.size()};
}

// True if the gradient's product with `way` is (above - below) / distance.
bool is_slope(const Columns &columns, const std::vector<double> &way, const std::vector<double> &above,
              const std::vector<double> &below, double distance) {
    if (above.size() != below.size()) return false;
    for (size_t i = 0; i < above.size(); ++i) {
        double along = 0.0, terms = 0.0;
        for (size_t k = 0; k < way.size(); ++k) {
            along += columns.row(i)[k] * way[k];
            terms += std::abs(columns.row(i)[k] * way[k]);
        }
        const double rounding = ROUNDINGS * EPS * (std::abs(above[i]) + std::abs(below[i])) / distance;
        if (!(std::abs((above[i] - below[i]) / distance - along) <= AGREEMENT * terms + rounding)) return false;
    }
    return true;
}

// True if a gradient agrees with the function's differences along one direction, in units of |y_k| + floors_k.
template <class Function>
bool agrees(const Function &function, const Columns &columns, const double *y, npy_intp n, const double *direction,
            const double *floors) {
    std::vector<double> way(n);
    for (npy_intp k = 0; k < n; ++k) way[k] = direction[k] * (std::abs(y[k]) + floors[k]);
    if (is_slope(columns, way, values_at(function, y, way, ONE_SIDED), columns.values(), ONE_SIDED)) return true;
    for (const double step : TWO_SIDED) {
        const std::vector<double> above = values_at(function, y, way, step);
        if (is_slope(columns, way, above, values_at(function, y, way, -step), 2.0 * step)) return true;
    }
    return false;
}

// The state of these floats.
std::span<const double> state_of(nb::handle y) {
    int64_t n = 0;
    const double *floats = memory<const double>(y, "y", NPY_DOUBLE, Bound{n});
    require(n > 0, "complex_step: expected a state of one number or more");
    return {floats, static_cast<size_t>(n)};
}

template <class Function>
Columns columns_of(const Function &function, std::span<const double> y, double step) {
    const auto n = std::ssize(y);
    Columns columns(n, step);
    for (npy_intp k = 0; k < n; ++k) columns.take(function(shifted(y.data(), n, k, step)).ptr(), k);
    return columns;
}

Array complex_step(nb::handle fun, nb::handle t, nb::handle y, const nb::tuple &args, double step) {
    const auto function = [&](const Array &state) { return nb::object(fun(t, state, *args)); };
    return columns_of(function, state_of(y), step).gradient();
}

nb::object checked_complex_step(nb::handle fun, nb::handle t, nb::handle y, const nb::tuple &args, double step,
                                nb::handle direction, nb::handle floors) {
    const std::span<const double> state = state_of(y);
    const auto n = std::ssize(state);
    const double *way = memory<const double>(direction, "direction", NPY_DOUBLE, n);
    const double *least = memory<const double>(floors, "floors", NPY_DOUBLE, n);
    const auto function = [&](const Array &state) { return nb::object(fun(t, state, *args)); };
    const Columns columns = columns_of(function, state, step);
    if (!agrees(function, columns, state.data(), n, way, least)) return nb::none();
    return columns.gradient();
}

}  // namespace

void add_gradients(Module module) {
    module.def("complex_step", complex_step, "fun"_a, "t"_a, "y"_a, "args"_a, "step"_a,
               "Return the derivatives (..., n) of ``fun(t, y, *args)`` by `y` (n,), by complex steps of this length.");
    module.def(
        "checked_complex_step", checked_complex_step, "fun"_a, "t"_a, "y"_a, "args"_a, "step"_a, "direction"_a,
        "floors"_a,
        nb::sig("def checked_complex_step(fun: object, t: object, y: object, args: tuple, step: float, "
                "direction: object, floors: object) -> numpy.ndarray | None"),
        "Return `complex_step`, or None if differences along ``direction * (abs(y) + floors)`` disagree with it.");
}

}  // namespace eip
