// Arguments that are NumPy arrays. Each array is checked before its memory is used: its type against the one that the
// function asks for, or its lengths against those of the run. This header must be included before all headers of the
// standard library, because Python.h requires that.
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
#include <atomic>
#include <chrono>
#include <initializer_list>
#include <optional>
#include <thread>
#include <type_traits>

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

inline bool is_plain(PyObject *object, int type, Lengths shape) {
    if (!is_plain(object, type, static_cast<int>(shape.size()))) return false;
    return std::equal(shape.begin(), shape.end(), PyArray_DIMS(reinterpret_cast<PyArrayObject *>(object)));
}

template <class T>
constexpr int TYPE = std::is_same_v<std::remove_const_t<T>, double>    ? NPY_DOUBLE
                     : std::is_same_v<std::remove_const_t<T>, int64_t> ? NPY_INT64
                                                                       : NPY_UINT64;

// The text for stub files.
constexpr auto NUMBERS = nb::detail::const_name("numpy.typing.NDArray[numpy.inexact]");
constexpr auto FLOATS = nb::detail::const_name("numpy.typing.NDArray[numpy.float64]");
constexpr auto INTEGERS = nb::detail::const_name("numpy.typing.NDArray[numpy.int64]");
constexpr auto UNSIGNED = nb::detail::const_name("numpy.typing.NDArray[numpy.uint64]");

// An argument of a function in Python: an array of T with the given number of axes, which is written to unless T is
// const. If `STATES` is true and T is double, the array has the type of a state, float64 or complex128; complex numbers
// are pairs of floats here.
template <class T, int AXES, bool STATES = false>
struct ArrayOf {
    static constexpr auto ARGUMENT = nb::detail::const_name<STATES>(
        NUMBERS, nb::detail::const_name<TYPE<T> == NPY_DOUBLE>(
                     FLOATS, nb::detail::const_name<TYPE<T> == NPY_INT64>(INTEGERS, UNSIGNED)));
    T *data;
    const npy_intp *shape;
    int type;
    PyObject *object;

    bool take(PyObject *given) {
        type = STATES && is_plain(given, NPY_CDOUBLE, AXES) ? static_cast<int>(NPY_CDOUBLE) : TYPE<T>;
        if (!is_plain(given, type, AXES)) return false;
        object = given;
        auto *array = reinterpret_cast<PyArrayObject *>(given);
        data = static_cast<T *>(PyArray_DATA(array));
        shape = PyArray_DIMS(array);
        return std::is_const_v<T> || PyArray_ISWRITEABLE(array);
    }
};

template <class T, int AXES>
using StatesOf = ArrayOf<T, AXES, true>;

// An array argument with any number of axes. Its numbers are floats or, if PAIRS, complex numbers or an even number of
// floats. `columns` is the length of its last axis.
template <class T, bool PAIRS>
struct PointsOf {
    static constexpr auto ARGUMENT = nb::detail::const_name<PAIRS>(NUMBERS, FLOATS);
    T *data;
    npy_intp points, columns;

    operator PointsOf<const T, PAIRS>() const { return {data, points, columns}; }

    bool take(PyObject *object) {
        auto *array = reinterpret_cast<PyArrayObject *>(object);
        if (!PyArray_Check(object) || PyArray_NDIM(array) == 0 || !PyArray_ISCARRAY_RO(array)) return false;
        points = PyArray_SIZE(array);
        columns = PyArray_DIM(array, PyArray_NDIM(array) - 1);
        const int type = PyArray_TYPE(array);
        const bool split = PAIRS && type == NPY_DOUBLE && columns % 2 == 0;
        if (split) {
            points /= 2;
            columns /= 2;
        }
        data = static_cast<T *>(PyArray_DATA(array));
        return (split || type == (PAIRS ? NPY_CDOUBLE : NPY_DOUBLE)) &&
               (std::is_const_v<T> || PyArray_ISWRITEABLE(array));
    }
};

using Field = PointsOf<double, true>;
using ConstField = PointsOf<const double, true>;
using ConstReals = PointsOf<const double, false>;

template <class First, class... Others>
void require_one_length(const First &first, const Others &...others) {
    require(((first.points == others.points) && ...), "expected arrays with the same number of points");
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

// Lets other threads run while a large array is worked on.
class [[maybe_unused]] Released {
  public:
    explicit Released(npy_intp points) {
        if (points >= LARGE) released_.emplace();
    }

  private:
    static constexpr npy_intp LARGE = 1 << 14;
    std::optional<WithoutLock> released_;
};

}  // namespace eip

namespace nanobind::detail {

// NumPy's own interface is used, which costs 1 ns an argument; nb::ndarray takes 115.
template <class Argument>
struct type_caster<Argument, enable_if_t<(sizeof(Argument::ARGUMENT) > 0)>> {
    NB_TYPE_CASTER(Argument, Argument::ARGUMENT)
    bool from_python(handle object, uint32_t, cleanup_list *) noexcept { return value.take(object.ptr()); }
};

}  // namespace nanobind::detail
