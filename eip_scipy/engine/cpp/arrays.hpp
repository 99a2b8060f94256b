// Arguments that are NumPy arrays: `memory` checks the type and the shape of each one before its memory is used. This header
// must be included before all headers of the standard library, because Python.h requires that.
#pragma once

#include <nanobind/nanobind.h>

#define NPY_NO_DEPRECATED_API NPY_2_0_API_VERSION
#define NPY_TARGET_VERSION NPY_2_0_API_VERSION
#define PY_ARRAY_UNIQUE_SYMBOL eip_scipy_array_api
#ifndef EIP_IMPORTS_NUMPY
#define NO_IMPORT_ARRAY
#endif
#include <numpy/arrayobject.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <chrono>
#include <initializer_list>
#include <span>
#include <thread>
#include <type_traits>

#include "data.hpp"

namespace eip {

namespace nb = nanobind;
using namespace nb::literals;
using Lengths = std::initializer_list<npy_intp>;

static_assert(sizeof(npy_intp) == sizeof(int64_t), "the engine needs a 64-bit platform");

// An error in Python's format, which knows %R and %S.
template <class... Values>
[[noreturn]] void refuse(PyObject *error, const char *format, Values... values) {
    PyErr_Format(error, format, values...);
    throw nb::python_error();
}

inline void require(bool good, const char *what) {
    if (!good) throw nb::value_error(what);
}

// A new reference that Python returned, or its error.
template <class Object = nb::object>
Object owned(PyObject *object) {
    if (!object) throw nb::python_error();
    return nb::steal<Object>(object);
}

// An object that NumPy made.
class Array : public nb::object {
    NB_OBJECT_DEFAULT(Array, nb::object, "numpy.ndarray", PyArray_Check)

  public:
    PyArrayObject *get() const { return reinterpret_cast<PyArrayObject *>(ptr()); }
    double *floats() const { return static_cast<double *>(PyArray_DATA(get())); }
    npy_intp size() const { return PyArray_SIZE(get()); }
};

inline Array new_array(Lengths shape, int type = NPY_DOUBLE) {
    return owned<Array>(PyArray_SimpleNew(static_cast<int>(shape.size()), const_cast<npy_intp *>(shape.begin()), type));
}

// An array over memory that `owner` keeps.
inline Array view(void *memory, int axes, const npy_intp *shape, int type, nb::handle owner) {
    Array array = owned<Array>(PyArray_SimpleNewFromData(axes, const_cast<npy_intp *>(shape), type, memory));
    if (PyArray_SetBaseObject(array.get(), owner.inc_ref().ptr()) < 0) throw nb::python_error();
    return array;
}

// True if an object is an array whose memory can be used as it is: of this type and number of axes, C-contiguous, aligned,
// in the machine's byte order.
inline bool is_plain(PyObject *object, int type, int axes) {
    if (!PyArray_Check(object)) return false;
    auto *array = reinterpret_cast<PyArrayObject *>(object);
    return PyArray_TYPE(array) == type && PyArray_NDIM(array) == axes && PyArray_ISCARRAY_RO(array);
}

template <class T>
constexpr int TYPE = std::is_same_v<std::remove_const_t<T>, double>    ? NPY_DOUBLE
                     : std::is_same_v<std::remove_const_t<T>, int64_t> ? NPY_INT64
                                                                       : NPY_UINT64;

// The memory of an array of this type and shape, to which it must be possible to write unless it is only `read`. The array has to
// live as long as its memory is used.
void *memory_of(nb::handle object, const char *name, int type, std::span<const npy_intp> shape, bool read);

// The same, given the lengths of the axes; a `Bound` length becomes that of the array. Memory of `const T` is only read.
template <class T, class... Axes>
T *memory(nb::handle object, const char *name, int type, Axes... axes) {
    int axis = 0;
    const auto length = [&]<class Axis>(Axis given) -> npy_intp {
        const int at = axis++;
        if constexpr (!std::is_same_v<Axis, Bound>)
            return given;
        else if (!is_plain(object.ptr(), type, sizeof...(Axes)))
            return given.length = -1;
        else
            return given.length = PyArray_DIM(reinterpret_cast<PyArrayObject *>(object.ptr()), at);
    };
    const npy_intp shape[] = {length(axes)...};
    return static_cast<T *>(memory_of(object, name, type, shape, std::is_const_v<T>));
}

// The end of the process: which thread ends it. A daemon thread that then asks for the lock of Python is ended on the spot,
// wherever it is; below frames of C++ that crashes the process. So threads that are in the engine sleep from then on, and
// the thread that ends the process waits, for a second at most, until they do.
class Ending {
  public:
    static void begin() {
        by_ = std::this_thread::get_id();
        begun_ = true;
        PyThreadState *state = PyEval_SaveThread();
        for (int k = 0; k < 1000 && inside_ > 0; ++k) std::this_thread::sleep_for(std::chrono::milliseconds(1));
        PyEval_RestoreThread(state);
    }

    // For a thread without the lock.
    static void sleep_if_begun() {
        while (is_for_this_thread()) std::this_thread::sleep_for(std::chrono::hours(1));
    }

    // For a thread with the lock, between two calls of functions in Python.
    static void leave_if_begun() {
        if (!is_for_this_thread()) [[likely]]
            return;
        PyEval_SaveThread();
        inside_ -= depth_;
        sleep_if_begun();
    }

    // A call of the engine that calls functions in Python.
    class Inside {
      public:
        Inside() {
            leave_if_begun();
            ++inside_;
            ++depth_;
        }
        Inside(const Inside &) = delete;
        ~Inside() {
            --inside_;
            --depth_;
        }
    };

  private:
    static bool is_for_this_thread() { return begun_ && by_ != std::this_thread::get_id(); }

    inline static std::atomic<bool> begun_ = false;
    inline static std::atomic<int> inside_ = 0;
    inline static std::thread::id by_;
    inline static thread_local int depth_ = 0;
};

// Lets other threads run, without the lock of Python, during the life of the object.
class [[maybe_unused]] WithoutLock {
  public:
    WithoutLock() = default;
    WithoutLock(const WithoutLock &) = delete;
    ~WithoutLock() {
        Ending::sleep_if_begun();
        PyEval_RestoreThread(state_);
    }

  private:
    PyThreadState *state_ = PyEval_SaveThread();
};

}  // namespace eip
