// The library's functions as Python calls them: ``fun(t, y[, f], params)`` for values, ``fun(t, y[, f], out, params)`` for
// what fills an array, as users' functions that are given to `integrate`.
#include "module.hpp"

#include <nanobind/stl/vector.h>

#include "data.hpp"
#include "library.hpp"

namespace eip {
namespace {

// A vector of floats, converted if need be.
Array vector_of(PyObject *object) {
    if (is_plain(object, NPY_DOUBLE, 1)) return nb::borrow<Array>(object);
    return owned<Array>(PyArray_FROMANY(object, NPY_DOUBLE, 1, 1, NPY_ARRAY_CARRAY_RO));
}

// The array to fill, or a contiguous copy that NumPy writes back.
Array out_of(PyObject *object, const LibraryFunction &function, int64_t n) {
    Array out = owned<Array>(PyArray_FROM_OTF(object, NPY_DOUBLE, NPY_ARRAY_INOUT_ARRAY2));
    const int64_t expected = function.filled(n), has = out.size();
    if (has == expected) return out;
    PyArray_DiscardWritebackIfCopy(out.get());
    refuse(PyExc_ValueError, "%s fills %lld numbers for this state, but out has %lld", function.name,
           static_cast<long long>(expected), static_cast<long long>(has));
}

void require_count(const LibraryFunction &function, Py_ssize_t count, bool by_f) {
    const Py_ssize_t expected = 3 + by_f + !function.returns() - !function.own.empty();
    if (count == expected || (count > expected && !function.own.empty())) return;
    refuse(PyExc_TypeError, "%s takes the %zd arguments (t, y%s%s%s); got %zd", function.name, expected,
           by_f ? ", f" : "", function.returns() ? "" : ", out", function.own.empty() ? ", params" : "", count);
}

nb::object called(const LibraryFunction &function, PyObject *arguments) {
    const bool by_f = function.takes_f();
    const Py_ssize_t count = PyTuple_Size(arguments);
    require_count(function, count, by_f);
    const auto argument = [arguments](Py_ssize_t place) { return PyTuple_GetItem(arguments, place); };
    const double t = PyFloat_AsDouble(argument(0));
    if (t == -1.0 && PyErr_Occurred()) throw nb::python_error();
    const Array y = vector_of(argument(1));
    Array given;
    if (function.own.empty()) given = vector_of(argument(count - 1));
    const double *params = function.own.empty() ? given.floats() : function.own.data();
    const int64_t n = y.size(), p = function.own.empty() ? given.size() : std::ssize(function.own);
    require_sizes(function, n, p);
    Array f;
    if (by_f) f = vector_of(argument(2));
    if (by_f && f.size() != n)
        refuse(PyExc_ValueError, "%s: f has %lld numbers, but y has %lld; they must have the same size", function.name,
               static_cast<long long>(f.size()), static_cast<long long>(n));
    Array out = function.returns() ? new_array({function.filled(n)}) : out_of(argument(2 + by_f), function, n);
    function.one(t, y.floats(), by_f ? f.floats() : nullptr, out.floats(), params, n, p);
    if (!function.returns()) {
        if (PyArray_ResolveWritebackIfCopy(out.get()) < 0) throw nb::python_error();
        return nb::none();
    }
    if (function.is_numbers() && function.numbers == 1 && !function.by_parameters) return nb::float_(out.floats()[0]);
    return out;
}

// Python calls it without a detour: through a method it takes three times as long. No exception may pass into its frames.
PyObject *call(PyObject *self, PyObject *arguments, PyObject *names) noexcept {
    const LibraryFunction &function = *nb::inst_ptr<LibraryFunction>(self);
    const FloatingPoint mode;
    try {
        if (names && PyDict_Size(names) > 0) refuse(PyExc_TypeError, "%s takes no keywords", function.name);
        return called(function, arguments).release().ptr();
    } catch (nb::python_error &error) {
        error.restore();
    } catch (const std::bad_alloc &) {
        PyErr_NoMemory();
    }
    return nullptr;
}

// Call a function for one state from compiled code that no exception may pass through. Returns the number if `out` is null,
// else 0. NaN: the sizes are wrong, or there is no number; 1: the function did not get the memory that it needs to fill `out`.
double call_by_handle(const void *handle, double t, const double *y, const double *f, double *out, const double *params,
                      int64_t n, int64_t p) {
    const LibraryFunction &function = *static_cast<const LibraryFunction *>(handle);
    if (!function.fits(n, p)) return NOT_A_NUMBER;
    double number = 0.0;
    try {
        function.one(t, y, f, out ? out : &number, params, n, p);
        return number;
    } catch (const std::exception &) {
        return out ? 1.0 : NOT_A_NUMBER;
    }
}

template <class Pointer>
uintptr_t address(Pointer pointer) {
    return reinterpret_cast<uintptr_t>(pointer);
}

PyObject *name_of(PyObject *self, void *) { return PyUnicode_FromString(nb::inst_ptr<LibraryFunction>(self)->name); }

PyGetSetDef named[] = {{"__name__", name_of, nullptr, "Name of the function in `library`.", nullptr}, {}};
PyType_Slot slots[] = {{Py_tp_call, reinterpret_cast<void *>(call)}, {Py_tp_getset, named}, {0, nullptr}};

}  // namespace

void require_sizes(const LibraryFunction &function, int64_t n, int64_t p) {
    if (function.fits(n, function.own.empty() ? p : std::ssize(function.own))) return;
    refuse(PyExc_ValueError, "%s expects %s; got y with %lld numbers, and %lld parameters", function.name,
           function.sizes, static_cast<long long>(n), static_cast<long long>(p));
}

void add_library(nb::module_ &module) {
    using Function = LibraryFunction;
    nb::class_<Function>(module, "LibraryFunction", nb::type_slots(slots),
                         "A function in C++ of one of the package's problems.")
        .def_prop_ro("takes_f", &Function::takes_f, "True if the function takes the derivative f of the state.")
        .def_prop_ro(
            "in_place", [](const Function &f) { return !f.returns(); },
            "True if the function fills an argument `out`; False if it returns its value.")
        .def_prop_ro(
            "handle", [](const Function &f) { return address(&f); },
            "First argument of the function at `call_address`.")
        .def_prop_ro(
            "call_address", [](const Function &) { return address(call_by_handle); },
            "Address of `call_by_handle`, whose signature is in library.cpp.")
        .def_prop_ro(
            "numbers", [](const Function &f) { return f.numbers == 0 ? 1 : f.numbers; },
            "Number of numbers, or of rows of the state's size, that are filled; if negative, that for each orbit.")
        .def_prop_ro(
            "returns_numbers", [](const Function &f) { return f.value == Value::NUMBERS; },
            "True if the function returns as many numbers for states of any size, and does not take f.")
        .def_prop_ro(
            "lanes8_address", [](const Function &f) { return f.own.empty() ? address(f.eight) : 0; },
            "Address of the version for eight states at once; 0 if there is none.")
        .def(
            "bound",
            [](const Function &f, nb::handle params) {
                Function out = f;
                const Array given = vector_of(params.ptr());
                require(given.size() > 0, "a function is bound to one parameter at least");
                out.own.assign(given.floats(), given.floats() + given.size());
                return out;
            },
            "params"_a, "Return the function with fixed parameters, which it uses instead of those of a run.")
        .def_ro("own", &Function::own, "Fixed parameters of the function; empty if it uses the parameters of a run.")
        .def("__repr__", [](const Function &f) { return nb::str("<{} of eip_scipy>").format(f.name); })
        // Pickled by its name, so that it can be sent to other processes.
        .def("__reduce__", [](const Function &f) {
            const nb::object made = nb::module_::import_("eip_scipy.engine.native").attr("library_function");
            return nb::make_tuple(made, nb::make_tuple(f.name, f.own));
        });
    nb::dict library;
    for (const auto functions :
         {kepler_functions(), gravity_functions(), force_functions(), orbit_functions(), planet_functions()})
        for (const Function &function : functions)
            library[function.name] = nb::cast(&function, nb::rv_policy::reference);
    module.attr("LIBRARY") = library;
}

}  // namespace eip
