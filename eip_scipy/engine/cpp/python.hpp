// Python objects and NumPy arrays, each looked at in one place before their memory is used.
// Included before all headers of the standard library, as Python asks.
#pragma once

#define PY_SSIZE_T_CLEAN
#define NPY_NO_DEPRECATED_API NPY_2_0_API_VERSION
#define NPY_TARGET_VERSION NPY_2_0_API_VERSION
#define PY_ARRAY_UNIQUE_SYMBOL eip_scipy_array_api
#ifndef EIP_IMPORTS_NUMPY
#define NO_IMPORT_ARRAY
#endif
#include <Python.h>
#include <numpy/arrayobject.h>

#include <exception>
#include <initializer_list>
#include <new>
#include <utility>

namespace eip {

// A Python error is set; thrown through our own code only, and turned into NULL where Python called it.
struct PythonError {};

// An owned reference.
class Ref {
  public:
    Ref() = default;
    explicit Ref(PyObject *object) : object_(object) {
        if (!object) throw PythonError{};
    }
    Ref(Ref &&other) noexcept : object_(std::exchange(other.object_, nullptr)) {}
    Ref &operator=(Ref &&other) noexcept {
        std::swap(object_, other.object_);
        return *this;
    }
    Ref(const Ref &) = delete;
    Ref &operator=(const Ref &) = delete;
    ~Ref() { Py_XDECREF(object_); }

    PyObject *get() const { return object_; }
    PyObject *release() { return std::exchange(object_, nullptr); }

    static Ref borrowed(PyObject *object) {
        Py_XINCREF(object);
        return Ref(object);
    }

  private:
    PyObject *object_ = nullptr;
};

inline Ref attribute(PyObject *object, const char *name) { return Ref(PyObject_GetAttrString(object, name)); }

inline double number(PyObject *object, const char *name) {
    const double value = PyFloat_AsDouble(attribute(object, name).get());
    if (value == -1.0 && PyErr_Occurred()) throw PythonError{};
    return value;
}

inline int64_t integer(PyObject *object, const char *name) {
    const long long value = PyLong_AsLongLong(attribute(object, name).get());
    if (value == -1 && PyErr_Occurred()) throw PythonError{};
    return value;
}

inline bool truth(PyObject *object, const char *name) {
    const int value = PyObject_IsTrue(attribute(object, name).get());
    if (value < 0) throw PythonError{};
    return value;
}

constexpr npy_intp ANY = -1;

// Whether an object is an array whose memory can be used as it is: of this type and shape, C-contiguous, aligned, in the
// machine's byte order.
inline bool is_plain(PyObject *object, int type, std::initializer_list<npy_intp> shape) {
    if (!PyArray_Check(object)) return false;
    auto *array = reinterpret_cast<PyArrayObject *>(object);
    if (PyArray_TYPE(array) != type || PyArray_NDIM(array) != static_cast<int>(shape.size())) return false;
    int axis = 0;
    for (const npy_intp length : shape)
        if (PyArray_DIM(array, axis++) != length && length != ANY) return false;
    return PyArray_ISCARRAY_RO(array);
}

// The arrays of a run: checked, and kept alive in a list.
class Arrays {
  public:
    explicit Arrays(PyObject *kept) : kept_(kept) {}

    // The memory of an array, ANY for lengths that are not known; writable unless `read_only`.
    void *memory(PyObject *object, const char *name, int type, std::initializer_list<npy_intp> shape,
                 bool read_only = false) {
        if (!is_plain(object, type, shape) ||
            !(read_only || PyArray_ISWRITEABLE(reinterpret_cast<PyArrayObject *>(object))))
            refuse(object, name, type, shape);
        if (PyList_Append(kept_, object) < 0) throw PythonError{};
        return PyArray_DATA(reinterpret_cast<PyArrayObject *>(object));
    }

    void *memory_of(PyObject *owner, const char *name, int type, std::initializer_list<npy_intp> shape) {
        return memory(attribute(owner, name).get(), name, type, shape);
    }

    double *floats(PyObject *owner, const char *name, std::initializer_list<npy_intp> shape) {
        return static_cast<double *>(memory_of(owner, name, NPY_DOUBLE, shape));
    }

    template <typename Integer>
    Integer *integers(PyObject *owner, const char *name, std::initializer_list<npy_intp> shape) {
        constexpr int type = std::is_signed_v<Integer> ? NPY_INT64 : NPY_UINT64;
        return static_cast<Integer *>(memory_of(owner, name, type, shape));
    }

    static npy_intp length(PyObject *owner, const char *name, int axis = 0) {
        const Ref object = attribute(owner, name);
        auto *array = reinterpret_cast<PyArrayObject *>(object.get());
        if (!PyArray_Check(object.get()) || PyArray_NDIM(array) <= axis) {
            PyErr_Format(PyExc_TypeError, "engine: %s must be an array of %d dimensions or more", name, axis + 1);
            throw PythonError{};
        }
        return PyArray_DIM(array, axis);
    }

  private:
    [[noreturn]] static void refuse(PyObject *object, const char *name, int type,
                                    std::initializer_list<npy_intp> shape) {
        const Ref wanted(PyTuple_New(static_cast<Py_ssize_t>(shape.size())));
        Py_ssize_t axis = 0;
        for (const npy_intp size : shape) PyTuple_SET_ITEM(wanted.get(), axis++, PyLong_FromSsize_t(size));
        const Ref dtype(reinterpret_cast<PyObject *>(PyArray_DescrFromType(type)));
        if (PyArray_Check(object)) {
            const Ref has = attribute(object, "dtype"), came = attribute(object, "shape");
            PyErr_Format(
                PyExc_ValueError,
                "engine: %s is %S of shape %S; expected writable, aligned, C-contiguous %S of shape %S (-1: any)", name,
                has.get(), came.get(), dtype.get(), wanted.get());
        } else {
            PyErr_Format(PyExc_TypeError, "engine: %s is %.80R; expected an array, %S of shape %S (-1: any)", name,
                         object, dtype.get(), wanted.get());
        }
        throw PythonError{};
    }

    PyObject *kept_;
};

// Run `call` where Python calls the engine, and return NULL with a Python error set if it throws. No exception may pass
// into Python's own frames: that ends the process.
template <typename Call>
PyObject *guarded(Call call) {
    try {
        return call();
    } catch (const PythonError &) {
        return nullptr;
    } catch (const std::bad_alloc &) {
        return PyErr_NoMemory();
    } catch (const std::exception &error) {
        return PyErr_Format(PyExc_RuntimeError, "engine: %s", error.what());
    }
}

}  // namespace eip
