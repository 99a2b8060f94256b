// Functions of whole arrays for Python: each argument is looked at here, by the type that the function asks for.
#pragma once

#include "python.hpp"

#include <algorithm>
#include <array>
#include <cstddef>
#include <tuple>
#include <type_traits>
#include <utility>

namespace eip {

// Complex numbers, or floats in pairs, C-contiguous and aligned, with as many axes as there are; `columns` along the last.
struct ConstField {
    const double *data;
    npy_intp points, columns;
};

struct Field {
    double *data;
    npy_intp points, columns;
    operator ConstField() const { return {data, points, columns}; }
};

// Floats in such an array.
struct ConstReals {
    const double *data;
    npy_intp points, columns;
};

struct Reals {
    double *data;
    npy_intp points, columns;
};

// Where an argument stands, for messages.
struct Place {
    const char *function;
    int argument;
};

[[noreturn]] inline void refuse_array(PyObject *object, Place place, bool pairs, bool written) {
    const char *what = pairs ? "complex128, or float64 in pairs" : "float64";
    const char *kept = written ? "writable, " : "";
    if (PyArray_Check(object)) {
        const Ref dtype = attribute(object, "dtype"), shape = attribute(object, "shape");
        PyErr_Format(
            PyExc_ValueError,
            "%s: argument %d is %S of shape %S; expected a %saligned, C-contiguous array of %s with an axis or more",
            place.function, place.argument, dtype.get(), shape.get(), kept, what);
    } else {
        PyErr_Format(PyExc_TypeError, "%s: argument %d is %.80R; expected a %saligned, C-contiguous array of %s",
                     place.function, place.argument, object, kept, what);
    }
    throw PythonError{};
}

// The memory of an array, as `Found` says.
template <class Found>
Found read_array(PyObject *object, Place place, bool pairs, bool written) {
    auto *array = reinterpret_cast<PyArrayObject *>(object);
    if (!PyArray_Check(object) || PyArray_NDIM(array) == 0 || !PyArray_ISCARRAY_RO(array) ||
        (written && !PyArray_ISWRITEABLE(array)))
        refuse_array(object, place, pairs, written);
    npy_intp points = PyArray_SIZE(array), columns = PyArray_DIM(array, PyArray_NDIM(array) - 1);
    const int type = PyArray_TYPE(array);
    const bool split = pairs && type == NPY_DOUBLE && columns % 2 == 0;
    if (!split && type != (pairs ? NPY_CDOUBLE : NPY_DOUBLE)) refuse_array(object, place, pairs, written);
    if (split) {
        points /= 2;
        columns /= 2;
    }
    return {static_cast<double *>(PyArray_DATA(array)), points, columns};
}

template <class Argument>
Argument read_argument(PyObject *object, Place place) {
    if constexpr (std::is_same_v<Argument, double>) {
        const double value = PyFloat_AsDouble(object);
        if (value == -1.0 && PyErr_Occurred()) throw PythonError{};
        return value;
    } else {
        constexpr bool pairs = std::is_same_v<Argument, Field> || std::is_same_v<Argument, ConstField>;
        constexpr bool written = std::is_same_v<Argument, Field> || std::is_same_v<Argument, Reals>;
        return read_array<Argument>(object, place, pairs, written);
    }
}

// What a function asks of its arrays' lengths.
inline void require(bool good, const char *what) {
    if (good) return;
    PyErr_SetString(PyExc_ValueError, what);
    throw PythonError{};
}

template <class First, class... Others>
void require_one_length(const First &first, const Others &...others) {
    require(((first.points == others.points) && ...), "expected arrays of as many points");
}

// Lets other threads run while a large array is worked on.
class Released {
  public:
    explicit Released(npy_intp points) : state_(points >= LARGE ? PyEval_SaveThread() : nullptr) {}
    Released(const Released &) = delete;
    Released &operator=(const Released &) = delete;
    ~Released() {
        if (state_) PyEval_RestoreThread(state_);
    }

  private:
    static constexpr npy_intp LARGE = 1 << 14;
    PyThreadState *state_;
};

inline PyObject *python_value(double value) { return PyFloat_FromDouble(value); }

template <std::size_t N>
PyObject *python_value(const std::array<double, N> &values) {
    Ref found(PyTuple_New(N));
    for (std::size_t k = 0; k < N; ++k) PyTuple_SET_ITEM(found.get(), k, Ref(PyFloat_FromDouble(values[k])).release());
    return found.release();
}

// A name as an argument of a template.
template <std::size_t N>
struct Name {
    char text[N];
    constexpr Name(const char (&given)[N]) { std::copy_n(given, N, text); }
};

template <Name NAME, auto FUNCTION>
struct Bound;

template <Name NAME, class Value, class... Arguments, Value (*FUNCTION)(Arguments...)>
struct Bound<NAME, FUNCTION> {
    static PyObject *call(PyObject *, PyObject *const *args, Py_ssize_t count) {
        return guarded([&]() -> PyObject * {
            if (count != sizeof...(Arguments)) {
                PyErr_Format(PyExc_TypeError, "%s takes %d arguments, got %zd", NAME.text,
                             static_cast<int>(sizeof...(Arguments)), count);
                return nullptr;
            }
            return call_with(args, std::index_sequence_for<Arguments...>());
        });
    }

  private:
    template <std::size_t... K>
    static PyObject *call_with(PyObject *const *args, std::index_sequence<K...>) {
        const std::tuple<Arguments...> read{read_argument<Arguments>(args[K], Place{NAME.text, K + 1})...};
        if constexpr (std::is_void_v<Value>) {
            std::apply(FUNCTION, read);
            Py_RETURN_NONE;
        } else {
            return python_value(std::apply(FUNCTION, read));
        }
    }
};

// A function of arrays and floats, which returns nothing, a float or several, as one of the module.
template <Name NAME, auto FUNCTION>
PyMethodDef bound(const char *doc) {
    return {NAME.text, reinterpret_cast<PyCFunction>(Bound<NAME, FUNCTION>::call), METH_FASTCALL, doc};
}

}  // namespace eip
