// Gradients of functions in Python by complex steps: Im I(y + i h e_k) / h, which loses no digit to a difference.
#include <vector>

#include "functions.hpp"

namespace eip {

namespace {

PyArrayObject *array_of(const Ref &object) { return reinterpret_cast<PyArrayObject *>(object.get()); }

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
    }

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
    double *out_ = nullptr;
};

PyObject *gradient(PyObject *fun, PyObject *t, PyObject *y, PyObject *args, double step) {
    auto *state = reinterpret_cast<PyArrayObject *>(y);
    const npy_intp n = PyArray_DIM(state, 0);
    const Py_ssize_t further = PyTuple_GET_SIZE(args);
    std::vector<PyObject *> arguments(3 + further);  // the callee's place, t and y before the others
    arguments[1] = t;
    for (Py_ssize_t k = 0; k < further; ++k) arguments[3 + k] = PyTuple_GET_ITEM(args, k);
    Columns columns(n, step);
    for (npy_intp k = 0; k < n; ++k) {
        const Ref z = shifted(static_cast<const double *>(PyArray_DATA(state)), n, k, step);
        arguments[2] = z.get();
        const size_t count = static_cast<size_t>(2 + further) | PY_VECTORCALL_ARGUMENTS_OFFSET;
        columns.take(Ref(PyObject_Vectorcall(fun, arguments.data() + 1, count, nullptr)).get(), k);
    }
    return columns.release();
}

PyObject *complex_step(PyObject *, PyObject *const *arguments, Py_ssize_t count) {
    return guarded([&]() -> PyObject * {
        if (count != 5 || !is_plain(arguments[2], NPY_DOUBLE, {ANY}) ||
            PyArray_SIZE(reinterpret_cast<PyArrayObject *>(arguments[2])) == 0 || !PyTuple_Check(arguments[3])) {
            PyErr_SetString(PyExc_TypeError, "complex_step: expected fun, t, y (n,) of float64 with n > 0, args, step");
            throw PythonError{};
        }
        const double step = PyFloat_AsDouble(arguments[4]);
        if (step == -1.0 && PyErr_Occurred()) throw PythonError{};
        return gradient(arguments[0], arguments[1], arguments[2], arguments[3], step);
    });
}

}  // namespace

PyMethodDef gradient_functions[] = {
    {"complex_step", reinterpret_cast<PyCFunction>(complex_step), METH_FASTCALL,
     "complex_step(fun, t, y, args, step)\n\nThe gradient of ``fun(t, y, *args)`` along the components of y (n,): "
     "(..., n), the imaginary parts over the step."},
    {nullptr, nullptr, 0, nullptr},
};

}  // namespace eip
