// The library's functions as Python calls them: ``fun(t, y[, f], params)`` for values, ``fun(t, y[, f], out, params)`` for
// what fills an array, as users' functions that are given to `integrate`.
#include "library_functions.hpp"

#include <algorithm>

namespace eip {
namespace {

struct Function {
    PyObject_HEAD
    vectorcallfunc vectorcall;
    const LibraryFunction *function;
};

PyTypeObject function_type = {.ob_base = PyVarObject_HEAD_INIT(nullptr, 0)};

const LibraryFunction &of(PyObject *self) { return *reinterpret_cast<Function *>(self)->function; }

// A vector of floats, converted if need be.
Ref vector_of(PyObject *object) {
    if (is_plain(object, NPY_DOUBLE, {ANY})) return Ref::borrowed(object);
    return Ref(PyArray_FROMANY(object, NPY_DOUBLE, 1, 1, NPY_ARRAY_CARRAY_RO));
}

double *data(const Ref &array) {
    return static_cast<double *>(PyArray_DATA(reinterpret_cast<PyArrayObject *>(array.get())));
}

int64_t size(const Ref &array) { return PyArray_SIZE(reinterpret_cast<PyArrayObject *>(array.get())); }

Ref new_value(const LibraryFunction &function, int64_t n) {
    npy_intp length = function.filled(n);
    return Ref(PyArray_SimpleNew(1, &length, NPY_DOUBLE));
}

// The array to fill, or a contiguous copy that NumPy writes back.
Ref out_of(PyObject *object, const LibraryFunction &function, int64_t n) {
    Ref out(PyArray_FROM_OTF(object, NPY_DOUBLE, NPY_ARRAY_INOUT_ARRAY2));
    const int64_t expected = function.filled(n);
    if (size(out) != expected) {
        PyErr_Format(PyExc_ValueError, "%s fills %lld numbers for this state; out has %lld", function.name,
                     static_cast<long long>(expected), static_cast<long long>(size(out)));
        PyArray_DiscardWritebackIfCopy(reinterpret_cast<PyArrayObject *>(out.get()));
        throw PythonError{};
    }
    return out;
}

void require_length(const LibraryFunction &function, const Ref &f, int64_t n) {
    if (size(f) == n) return;
    PyErr_Format(PyExc_ValueError, "%s: f has %lld numbers, y has %lld", function.name, static_cast<long long>(size(f)),
                 static_cast<long long>(n));
    throw PythonError{};
}

void require_count(const LibraryFunction &function, Py_ssize_t count, bool by_f) {
    const Py_ssize_t expected = 3 + by_f + !function.returns();
    if (count == expected) return;
    PyErr_Format(PyExc_TypeError, "%s takes (t, y%s%s, params), %zd arguments; got %zd", function.name,
                 by_f ? ", f" : "", function.returns() ? "" : ", out", expected, count);
    throw PythonError{};
}

PyObject *called(const LibraryFunction &function, PyObject *const *arguments, Py_ssize_t count) {
    const bool by_f = function.value == Value::GRADIENT_BY_F;
    require_count(function, count, by_f);
    const double t = PyFloat_AsDouble(arguments[0]);
    if (t == -1.0 && PyErr_Occurred()) throw PythonError{};
    const Ref y = vector_of(arguments[1]), params = vector_of(arguments[count - 1]);
    const int64_t n = size(y);
    require_sizes(function, n, size(params));
    Ref f;
    if (by_f) {
        f = vector_of(arguments[2]);
        require_length(function, f, n);
    }
    Ref out = function.returns() ? new_value(function, n) : out_of(arguments[count - 2], function, n);
    function.one(t, data(y), by_f ? data(f) : nullptr, data(out), data(params), n, size(params));
    if (!function.returns()) {
        if (PyArray_ResolveWritebackIfCopy(reinterpret_cast<PyArrayObject *>(out.get())) < 0) throw PythonError{};
        Py_RETURN_NONE;
    }
    if (function.value == Value::NUMBERS && function.numbers == 1) return PyFloat_FromDouble(data(out)[0]);
    return out.release();
}

PyObject *function_call(PyObject *self, PyObject *const *arguments, size_t flags, PyObject *names) {
    return guarded([&]() -> PyObject * {
        if (names && PyTuple_GET_SIZE(names) > 0) {
            PyErr_Format(PyExc_TypeError, "%s takes no keywords", of(self).name);
            throw PythonError{};
        }
        return called(of(self), arguments, PyVectorcall_NARGS(flags));
    });
}

// Call a function for one state from compiled code that no exception may pass through. Returns 0, or 1 if the function
// did not get the memory that it needs.
int call_by_handle(const void *handle, double t, const double *y, const double *f, double *out, const double *params,
                   int64_t n, int64_t p) {
    try {
        static_cast<const LibraryFunction *>(handle)->one(t, y, f, out, params, n, p);
        return 0;
    } catch (const std::exception &) {
        return 1;
    }
}

PyObject *function_repr(PyObject *self) { return PyUnicode_FromFormat("<%s of eip_scipy>", of(self).name); }

// By its name, so that it travels to other processes.
PyObject *function_reduce(PyObject *self, PyObject *) {
    return guarded([&]() -> PyObject * {
        const Ref module(PyImport_ImportModule("eip_scipy.engine.native"));
        const Ref made = attribute(module.get(), "library_function");
        return Py_BuildValue("O(s)", made.get(), of(self).name);
    });
}

PyObject *get_name(PyObject *self, void *) { return PyUnicode_FromString(of(self).name); }
PyObject *get_takes_f(PyObject *self, void *) { return PyBool_FromLong(of(self).value == Value::GRADIENT_BY_F); }
PyObject *get_in_place(PyObject *self, void *) { return PyBool_FromLong(!of(self).returns()); }
PyObject *get_handle(PyObject *self, void *) { return PyLong_FromVoidPtr(const_cast<LibraryFunction *>(&of(self))); }
PyObject *get_call_address(PyObject *, void *) { return PyLong_FromVoidPtr(reinterpret_cast<void *>(call_by_handle)); }
PyObject *get_fits_address(PyObject *self, void *) {
    return PyLong_FromVoidPtr(reinterpret_cast<void *>(of(self).fits));
}
PyObject *get_numbers(PyObject *self, void *) { return PyLong_FromLongLong(std::max<int64_t>(of(self).numbers, 1)); }
PyObject *get_fills_states(PyObject *self, void *) { return PyBool_FromLong(of(self).value != Value::NUMBERS); }
PyObject *get_octet_address(PyObject *self, void *) {
    return PyLong_FromVoidPtr(reinterpret_cast<void *>(of(self).eight));
}

PyGetSetDef function_attributes[] = {
    {"__name__", get_name, nullptr, "Its name in `library`.", nullptr},
    {"takes_f", get_takes_f, nullptr, "Whether it takes the derivative of the state.", nullptr},
    {"in_place", get_in_place, nullptr, "Whether it fills an array.", nullptr},
    {"handle", get_handle, nullptr, "The first argument of the function at `call_address`.", nullptr},
    {"call_address", get_call_address, nullptr, "Address of `call_by_handle`, whose signature is in library.cpp.",
     nullptr},
    {"fits_address", get_fits_address, nullptr, "Of ``bool fits(int64_t n, int64_t p)``.", nullptr},
    {"numbers", get_numbers, nullptr, "How many numbers, or states, it fills.", nullptr},
    {"fills_states", get_fills_states, nullptr, "Whether these are of the state's size.", nullptr},
    {"octet_address", get_octet_address, nullptr, "For eight states side by side, 0 where there is none.", nullptr},
    {nullptr, nullptr, nullptr, nullptr, nullptr},
};

PyMethodDef function_methods[] = {
    {"__reduce__", function_reduce, METH_NOARGS, "By its name."},
    {nullptr, nullptr, 0, nullptr},
};

void function_dealloc(PyObject *self) { Py_TYPE(self)->tp_free(self); }

}  // namespace

void require_sizes(const LibraryFunction &function, int64_t n, int64_t p) {
    if (function.fits(n, p)) return;
    PyErr_Format(PyExc_ValueError, "%s takes %s; got %lld numbers and %lld parameters", function.name, function.sizes,
                 static_cast<long long>(n), static_cast<long long>(p));
    throw PythonError{};
}

const LibraryFunction *library_function_of(PyObject *object) {
    return Py_TYPE(object) == &function_type ? &of(object) : nullptr;
}

bool add_library(PyObject *module) {
    PyTypeObject &type = function_type;
    type.tp_name = "eip_scipy.engine.LibraryFunction";
    type.tp_basicsize = sizeof(Function);
    type.tp_dealloc = function_dealloc;
    type.tp_flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_VECTORCALL;
    type.tp_call = PyVectorcall_Call;
    type.tp_vectorcall_offset = offsetof(Function, vectorcall);
    type.tp_repr = function_repr;
    type.tp_getset = function_attributes;
    type.tp_methods = function_methods;
    type.tp_doc = "A function of one of the library's problems.";
    PyObject *added = guarded([&]() -> PyObject * {
        if (PyType_Ready(&type) < 0) throw PythonError{};
        Ref library(PyDict_New());
        for (const auto functions : {kepler_functions(), gravity_functions(), force_functions()}) {
            for (const LibraryFunction &function : functions) {
                const Ref made(type.tp_alloc(&type, 0));
                auto *self = reinterpret_cast<Function *>(made.get());
                self->vectorcall = function_call;
                self->function = &function;
                if (PyDict_SetItemString(library.get(), function.name, made.get()) < 0) throw PythonError{};
            }
        }
        auto *made = reinterpret_cast<PyObject *>(&type);
        if (PyModule_AddObjectRef(module, "LibraryFunction", made) < 0) throw PythonError{};
        if (PyModule_AddObjectRef(module, "LIBRARY", library.get()) < 0) throw PythonError{};
        return module;
    });
    return added != nullptr;
}

}  // namespace eip
