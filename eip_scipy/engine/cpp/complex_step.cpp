// Gradients of functions in Python by complex steps: Im I(y + i h e_k) / h, which loses no digit to a difference.
#include "functions.hpp"

#include <cmath>
#include <vector>

namespace eip {

namespace {

// Steps of the differences that a gradient is compared with, one to one side, then some to both, the shorter one next to
// a singularity; and how far they may differ: in units of the sum of the derivative's terms, and in roundings of the
// values.
constexpr double ONE_SIDED = 1e-8, TWO_SIDED[] = {1e-5, 1e-7};
constexpr double AGREEMENT = 1e-6, ROUNDINGS = 8.0, EPS = 2.220446049250313e-16;

PyArrayObject *array_of(const Ref &object) { return reinterpret_cast<PyArrayObject *>(object.get()); }
const double *floats_of(PyObject *array) {
    return static_cast<const double *>(PyArray_DATA(reinterpret_cast<PyArrayObject *>(array)));
}

// y with a small imaginary part in component k: a new array each time, since the function may keep what it was given.
Ref shifted(const double *y, npy_intp n, npy_intp k, double step) {
    Ref array(PyArray_SimpleNew(1, &n, NPY_CDOUBLE));
    auto *z = static_cast<double *>(PyArray_DATA(array_of(array)));
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
        if (k > 0 && PyComplex_Check(value) && PyArray_NDIM(array_of(gradient_)) == 1) {
            out_[k] = PyComplex_ImagAsDouble(value) / step_;
            return;
        }
        const Ref numbers = as_complex(value);
        PyArrayObject *found = array_of(numbers);
        if (k == 0) make(found);
        require_shape(found);
        const auto *pairs = static_cast<const double *>(PyArray_DATA(found));
        for (npy_intp i = 0; i < PyArray_SIZE(found); ++i) out_[i * n_ + k] = pairs[2 * i + 1] / step_;
        if (k > 0) return;
        values_.resize(PyArray_SIZE(found));
        for (size_t i = 0; i < values_.size(); ++i) values_[i] = pairs[2 * i];
    }

    const double *row(size_t i) const { return out_ + i * n_; }
    const std::vector<double> &values() const { return values_; }

    PyObject *release() { return gradient_.release(); }

  private:
    static Ref as_complex(PyObject *value) {
        const Ref array(PyArray_FROM_O(value));
        const int type = PyArray_TYPE(array_of(array));
        if (!PyTypeNum_ISNUMBER(type) && !PyTypeNum_ISBOOL(type)) {
            PyErr_Format(PyExc_TypeError, "the function returned %.80R, expected numbers", value);
            throw PythonError{};
        }
        return Ref(PyArray_FROM_OTF(array.get(), NPY_CDOUBLE, NPY_ARRAY_IN_ARRAY | NPY_ARRAY_FORCECAST));
    }

    void make(PyArrayObject *value) {
        std::vector<npy_intp> shape(PyArray_DIMS(value), PyArray_DIMS(value) + PyArray_NDIM(value));
        shape.push_back(n_);
        gradient_ = Ref(PyArray_SimpleNew(static_cast<int>(shape.size()), shape.data(), NPY_DOUBLE));
        out_ = static_cast<double *>(PyArray_DATA(array_of(gradient_)));
    }

    void require_shape(PyArrayObject *value) const {
        const int axes = PyArray_NDIM(value);
        PyArrayObject *gradient = array_of(gradient_);
        if (axes + 1 == PyArray_NDIM(gradient) &&
            PyArray_CompareLists(PyArray_DIMS(value), PyArray_DIMS(gradient), axes))
            return;
        PyErr_SetString(PyExc_ValueError, "the function's values differ in shape");
        throw PythonError{};
    }

    npy_intp n_;
    double step_;
    Ref gradient_;
    std::vector<double> values_;
    double *out_ = nullptr;
};

// A function in Python of t, the state and further arguments.
class Function {
  public:
    Function(PyObject *fun, PyObject *t, PyObject *args) : fun_(fun), arguments_(3 + PyTuple_GET_SIZE(args)) {
        arguments_[1] = t;  // after the place that a vectorcall may write to
        for (Py_ssize_t k = 0; k < PyTuple_GET_SIZE(args); ++k) arguments_[3 + k] = PyTuple_GET_ITEM(args, k);
    }

    Ref operator()(const Ref &state) {
        arguments_[2] = state.get();
        const size_t count = (arguments_.size() - 1) | PY_VECTORCALL_ARGUMENTS_OFFSET;
        return Ref(PyObject_Vectorcall(fun_, arguments_.data() + 1, count, nullptr));
    }

  private:
    PyObject *fun_;
    std::vector<PyObject *> arguments_;
};

// The function's values at y + step * way, (l,).
std::vector<double> values_at(Function &function, const double *y, const std::vector<double> &way, double step) {
    npy_intp n = static_cast<npy_intp>(way.size());
    const Ref state(PyArray_SimpleNew(1, &n, NPY_DOUBLE));
    auto *moved = static_cast<double *>(PyArray_DATA(array_of(state)));
    for (npy_intp k = 0; k < n; ++k) moved[k] = y[k] + step * way[k];
    const Ref found(PyArray_FROM_OTF(function(state).get(), NPY_DOUBLE, NPY_ARRAY_IN_ARRAY));
    const double *first = floats_of(found.get());
    return {first, first + PyArray_SIZE(array_of(found))};
}

// Whether the gradient's product with `way` is (above - below) / distance.
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

// Whether a gradient agrees with the function's differences along one direction, in units of |y_k| + floors_k.
bool agrees(Function &function, const Columns &columns, const double *y, npy_intp n, const double *direction,
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

Columns columns_of(Function &function, PyObject *y, double step) {
    const npy_intp n = PyArray_SIZE(reinterpret_cast<PyArrayObject *>(y));
    Columns columns(n, step);
    for (npy_intp k = 0; k < n; ++k) columns.take(function(shifted(floats_of(y), n, k, step)).get(), k);
    return columns;
}

bool is_state(PyObject *y) {
    return is_plain(y, NPY_DOUBLE, {ANY}) && PyArray_SIZE(reinterpret_cast<PyArrayObject *>(y)) > 0;
}

double number(PyObject *value) {
    const double found = PyFloat_AsDouble(value);
    if (found == -1.0 && PyErr_Occurred()) throw PythonError{};
    return found;
}

PyObject *complex_step(PyObject *, PyObject *const *arguments, Py_ssize_t count) {
    return guarded([&]() -> PyObject * {
        if (count != 5 || !is_state(arguments[2]) || !PyTuple_Check(arguments[3])) {
            PyErr_SetString(PyExc_TypeError, "complex_step: expected fun, t, y (n,) of float64 with n > 0, args, step");
            throw PythonError{};
        }
        Function function(arguments[0], arguments[1], arguments[3]);
        return columns_of(function, arguments[2], number(arguments[4])).release();
    });
}

PyObject *checked_complex_step(PyObject *, PyObject *const *arguments, Py_ssize_t count) {
    return guarded([&]() -> PyObject * {
        const bool right = count == 7 && is_state(arguments[2]) && PyTuple_Check(arguments[3]);
        const npy_intp n = right ? PyArray_SIZE(reinterpret_cast<PyArrayObject *>(arguments[2])) : 0;
        if (!right || !is_plain(arguments[5], NPY_DOUBLE, {n}) || !is_plain(arguments[6], NPY_DOUBLE, {n})) {
            PyErr_SetString(
                PyExc_TypeError,
                "checked_complex_step: expected fun, t, y (n,) of float64 with n > 0, args, step, direction "
                "(n,), floors (n,)");
            throw PythonError{};
        }
        Function function(arguments[0], arguments[1], arguments[3]);
        Columns columns = columns_of(function, arguments[2], number(arguments[4]));
        if (!agrees(function, columns, floats_of(arguments[2]), n, floats_of(arguments[5]), floats_of(arguments[6])))
            Py_RETURN_NONE;
        return columns.release();
    });
}

}  // namespace

PyMethodDef gradient_functions[] = {
    {"complex_step", reinterpret_cast<PyCFunction>(complex_step), METH_FASTCALL,
     "complex_step(fun, t, y, args, step)\n\nThe gradient of ``fun(t, y, *args)`` along the components of y (n,): "
     "(..., n), the imaginary parts over the step."},
    {"checked_complex_step", reinterpret_cast<PyCFunction>(checked_complex_step), METH_FASTCALL,
     "checked_complex_step(fun, t, y, args, step, direction, floors)\n\nThe same, or None where it disagrees with a "
     "difference of ``fun`` along ``direction * (abs(y) + floors)``, as that of a function does which is not "
     "analytic."},
    {nullptr, nullptr, 0, nullptr},
};

}  // namespace eip
