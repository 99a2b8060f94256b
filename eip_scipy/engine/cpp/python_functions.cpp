#include "python_functions.hpp"

#include <numpy/arrayscalars.h>

#include "correction.hpp"

namespace eip {

namespace {

PyObject *kept_attribute(PyObject *object, const char *name, PyObject *kept) {
    const Ref found = attribute(object, name);
    if (PyList_Append(kept, found.get()) < 0) throw PythonError{};
    return found.get();
}

// An np.float64: where a function divides by t = 0 it gets inf, as from SciPy.
Ref time(double t) {
    Ref object(PyArrayScalar_New(Double));
    PyArrayScalar_ASSIGN(object.get(), Double, t);
    return object;
}

// A new array with a copy of a state, or of its first `components`.
Ref copied(const double *y, int64_t components, int type) {
    npy_intp length = components;
    Ref array(PyArray_SimpleNew(1, &length, type));
    std::memcpy(PyArray_DATA(reinterpret_cast<PyArrayObject *>(array.get())), y,
                PyArray_NBYTES(reinterpret_cast<PyArrayObject *>(array.get())));
    return array;
}

// An array over memory that belongs to `owner`.
Ref view(double *memory, int n_dimensions, const npy_intp *dimensions, int type, PyObject *owner) {
    Ref array(PyArray_SimpleNewFromData(n_dimensions, dimensions, type, memory));
    Py_INCREF(owner);
    if (PyArray_SetBaseObject(reinterpret_cast<PyArrayObject *>(array.get()), owner) < 0) throw PythonError{};
    return array;
}

constexpr int MOST_ARGUMENTS = 8;

int width_of(int type) { return type == NPY_CDOUBLE ? 2 : 1; }

}  // namespace

PythonCall::PythonCall(PyObject *description, int type, int64_t components, PyObject *kept)
    : fun_(kept_attribute(description, "fun", kept)),
      convert_(kept_attribute(description, "convert", kept)),
      type_(type),
      components_(components),
      takes_f_(truth(description, "takes_f")),
      in_place_(truth(description, "in_place")) {
    PyObject *args = kept_attribute(description, "args", kept);
    if (!PyTuple_Check(args)) {
        PyErr_SetString(PyExc_TypeError, "engine: args must be a tuple");
        throw PythonError{};
    }
    if (PyTuple_GET_SIZE(args) > MOST_ARGUMENTS) {
        PyErr_Format(PyExc_ValueError, "engine: at most %d further arguments", MOST_ARGUMENTS);
        throw PythonError{};
    }
    for (Py_ssize_t k = 0; k < PyTuple_GET_SIZE(args); ++k) args_.push_back(PyTuple_GET_ITEM(args, k));
    const bool real = truth(description, "real");
    value_type_ = real ? static_cast<int>(NPY_DOUBLE) : type;
    const Ref shape = attribute(description, "shape");
    n_dimensions_ = PyTuple_Check(shape.get()) ? static_cast<int>(PyTuple_GET_SIZE(shape.get())) : 3;
    if (n_dimensions_ > 2) {
        PyErr_SetString(PyExc_TypeError, "engine: shape must be a tuple of at most two lengths");
        throw PythonError{};
    }
    floats_ = width_of(value_type_);
    for (int k = 0; k < n_dimensions_; ++k) {
        dimensions_[k] = PyLong_AsSsize_t(PyTuple_GET_ITEM(shape.get(), k));
        if (dimensions_[k] < 0) {
            if (!PyErr_Occurred()) PyErr_SetString(PyExc_ValueError, "engine: negative length");
            throw PythonError{};
        }
        floats_ *= dimensions_[k];
    }
}

void PythonCall::operator()(double t, const double *y, const double *f, double *out, PyObject *owner) const {
    PyObject *arguments[5 + MOST_ARGUMENTS];  // t, y, f and out before them, and the place of the callee
    const Ref time_object = time(t), y_object = copied(y, components_, type_);
    Ref f_object, out_object;
    size_t count = 1;  // the first place is the callee's
    arguments[count++] = time_object.get();
    arguments[count++] = y_object.get();
    if (takes_f_) {
        f_object = copied(f, components_, type_);
        arguments[count++] = f_object.get();
    }
    if (in_place_) {
        fill(out, NOT_A_NUMBER, floats_);  // shows where the function leaves a part of it as it was
        out_object = view(out, n_dimensions_, dimensions_, value_type_, owner);
        arguments[count++] = out_object.get();
    }
    for (PyObject *argument : args_) arguments[count++] = argument;
    const Ref value(PyObject_Vectorcall(fun_, arguments + 1, (count - 1) | PY_VECTORCALL_ARGUMENTS_OFFSET, nullptr));
    if (!in_place_) take(value.get(), time_object.get(), out);
}

// Whether a value is a list of as many floats as are expected, Python's or NumPy's: what most functions return.
bool PythonCall::takes_list(PyObject *value) const {
    if (n_dimensions_ != 1 || value_type_ != NPY_DOUBLE || !PyList_CheckExact(value)) return false;
    if (PyList_GET_SIZE(value) != dimensions_[0]) return false;
    for (Py_ssize_t k = 0; k < dimensions_[0]; ++k)
        if (!PyFloat_Check(PyList_GET_ITEM(value, k))) return false;
    return true;
}

void PythonCall::take(PyObject *value, PyObject *t, double *out) const {
    if (n_dimensions_ == 0 && PyFloat_Check(value)) {
        out[0] = PyFloat_AS_DOUBLE(value);
        return;
    }
    if (takes_list(value)) {
        for (Py_ssize_t k = 0; k < floats_; ++k) out[k] = PyFloat_AS_DOUBLE(PyList_GET_ITEM(value, k));
        return;
    }
    const auto plain = [this](PyObject *a) {
        if (n_dimensions_ == 1) return is_plain(a, value_type_, {dimensions_[0]});
        return n_dimensions_ == 2 ? is_plain(a, value_type_, {dimensions_[0], dimensions_[1]})
                                  : is_plain(a, value_type_, {});
    };
    Ref found = Ref::borrowed(value);
    if (!PyArray_CheckExact(value) || !plain(value)) {
        found = Ref(PyObject_CallFunctionObjArgs(convert_, value, t, nullptr));
        if (!plain(found.get())) {
            PyErr_Format(PyExc_TypeError, "engine: convert returned %.80R", found.get());
            throw PythonError{};
        }
    }
    std::memcpy(out, PyArray_DATA(reinterpret_cast<PyArrayObject *>(found.get())), floats_ * sizeof(double));
}

PythonFunctions::PythonFunctions(PyObject *functions, PyObject *work, const Work &sizes, int type, PyObject *kept)
    : m_(sizes.m),
      second_order_(truth(functions, "second_order")) {
    const int64_t components = second_order_ ? sizes.n / 2 : sizes.n;
    rhs_.emplace(attribute(functions, "rhs").get(), type, components, kept);
    const auto calls = [&](const char *name, std::vector<PythonCall> &out, int64_t expected) {
        const Ref items(PySequence_Fast(attribute(functions, name).get(), "engine: expected a sequence of functions"));
        int64_t total = 0;
        for (Py_ssize_t k = 0; k < PySequence_Fast_GET_SIZE(items.get()); ++k) {
            out.emplace_back(PySequence_Fast_GET_ITEM(items.get(), k), type, sizes.n, kept);
            total += out.back().floats();
        }
        if (expected >= 0 && total != expected) {
            PyErr_Format(PyExc_ValueError, "engine: the values of %s are %lld floats, expected %lld", name,
                         static_cast<long long>(total), static_cast<long long>(expected));
            throw PythonError{};
        }
    };
    calls("inv", inv_, sizes.l);
    calls("grad", grad_, sizes.l * sizes.m);
    calls("event", event_, -1);
    if (rhs_->floats() != (second_order_ ? m_ / 2 : m_)) {
        PyErr_SetString(PyExc_ValueError, "engine: rhs must give as many numbers as the state has");
        throw PythonError{};
    }
    const Ref jacobian = attribute(functions, "jacobian");
    if (jacobian.get() != Py_None) {
        jacobian_.emplace(jacobian.get(), type, sizes.n / 2, kept);
        if (jacobian_->floats() != m_ / 2) {
            PyErr_SetString(PyExc_ValueError, "engine: jacobian must fill half as many numbers as the state has");
            throw PythonError{};
        }
    }
    add_buffers(work, kept);
}

void PythonFunctions::add_buffers(PyObject *work, PyObject *kept) {
    for (const char *name : {"K", "stage", "f_point", "G"}) {
        PyObject *array = kept_attribute(work, name, kept);
        auto *first = static_cast<const double *>(PyArray_DATA(reinterpret_cast<PyArrayObject *>(array)));
        const npy_intp bytes = PyArray_NBYTES(reinterpret_cast<PyArrayObject *>(array));
        owners_.push_back({first, first + bytes / static_cast<npy_intp>(sizeof(double)), array});
    }
}

PyObject *PythonFunctions::owner_of(const double *out) const {
    for (const Owner &owner : owners_)
        if (owner.first <= out && out < owner.last) return owner.array;
    return owners_.front().array;
}

void PythonFunctions::rhs(double t, const double *y, double *out) {
    if (!second_order_) return (*rhs_)(t, y, nullptr, out, owner_of(out));
    copy(y + m_ / 2, out, m_ / 2);
    (*rhs_)(t, y, nullptr, out + m_ / 2, owner_of(out));
}

void PythonFunctions::inv(double t, const double *y, double *values) {
    for (const PythonCall &call : inv_) {
        call(t, y, nullptr, values, nullptr);
        values += call.floats();
    }
}

void PythonFunctions::grad(double t, const double *y, const double *f, double *G) {
    for (const PythonCall &call : grad_) {
        call(t, y, f, G, owner_of(G));
        G += call.floats();
    }
}

void PythonFunctions::event(double t, const double *y, double *values) {
    for (const PythonCall &call : event_) {
        call(t, y, nullptr, values, nullptr);
        values += call.floats();
    }
}

void PythonFunctions::jacobian(double t, const double *q, const double *dq, double *out) {
    (*jacobian_)(t, q, dq, out, owner_of(out));
}

PythonHooks::PythonHooks(PyObject *hooks, PyObject *work, const Run &run, int type, PyObject *kept)
    : run_(run),
      type_(type) {
    const auto given = [&](const char *name) -> PyObject * {
        PyObject *found = kept_attribute(hooks, name, kept);
        return found == Py_None ? nullptr : found;
    };
    one_step_ = given("one_step");
    finish_ = given("finish");
    project_ = given("project");
    agree_ = given("agree");
    estimates_ = truth(hooks, "estimates");
    raw = one_step_ != nullptr;
    finish = finish_ != nullptr;
    project = project_ != nullptr;
    agree = agree_ != nullptr;
    if (PyObject *joint_invariants = given("joint")) {
        joint = true;
        moments_ = kept_attribute(joint_invariants, "moments", kept);
        shift_ = kept_attribute(joint_invariants, "shift", kept);
        y_hat_ = kept_attribute(work, "y_hat", kept);
        values_ = kept_attribute(work, "values", kept);
        R_ = kept_attribute(work, "R", kept);
        terms_ = kept_attribute(work, "inverse_norms", kept);
        mu_ = kept_attribute(work, "mu", kept);
        const Ref K = attribute(work, "K"), last(PyLong_FromLong(-1)), row(PyObject_GetItem(K.get(), last.get()));
        if (PyList_Append(kept, row.get()) < 0) throw PythonError{};
        f_hat_ = row.get();
    }
}

namespace {

int code_of(const Ref &returned) {
    const long value = PyLong_AsLong(returned.get());
    if (value == -1 && PyErr_Occurred()) throw PythonError{};
    return static_cast<int>(value);
}

PyObject *truth_of(bool value) { return value ? Py_True : Py_False; }

}  // namespace

// What `raw_step` does, by a method of the user's own. f is evaluated only where a gradient takes it: the steps do not.
int PythonHooks::raw_step(const Step &step) {
    const Options &o = run_.options;
    const Work &w = run_.work;
    const Ref t = time(step.t), y = copied(step.y, w.n, type_), h = time(step.h);
    const Ref none(PyObject_CallFunctionObjArgs(one_step_, t.get(), y.get(), h.get(), nullptr));
    if (!all_finite(w.y_hat, w.m)) return NOT_FINITE;
    if (step.project && o.uses_f) {
        if (o.direction == OLD) {
            run_.system.rhs(w, step.t, step.y, w.row(0));
            ++w.counters[NFEV];
        }
        run_.system.rhs(w, step.t_new, w.y_hat, w.last());
        ++w.counters[NFEV];
    }
    w.counters[HAVE_F] = 1;  // as far as anyone asks for it: the next step does not
    w.counters[HAVE_ERROR] = estimates_;
    const bool sampled = step.project && is_sampled(run_);
    w.counters[F_AT_RAW] = sampled || (step.project && o.uses_f);
    if (sampled) run_.system.rhs(w, step.t_new, w.y_hat, w.last());
    if (sampled && !estimates_) {
        run_.system.rhs(w, step.t, step.y, w.f_point);
        trapezoid_error(step.y, w.y_hat, step.h, w.f_point, w.last(), w.err, w.m);
        w.counters[HAVE_ERROR] = 1;
    }
    if (o.adaptive) w.norm[0] = error_norm(w.err, step.y, w.y_hat, o, w.n);
    return OK;
}

int PythonHooks::project_elsewhere(const Step &step) {
    const Ref t_old = time(step.t), t = time(step.t_new);
    const npy_intp n = run_.work.n;
    const Ref y_new = view(step.y_new, 1, &n, type_, to_);
    return code_of(
        Ref(PyObject_CallFunctionObjArgs(project_, t_old.get(), t.get(), truth_of(step.last), y_new.get(), nullptr)));
}

bool PythonHooks::all_agree(bool here) {
    const Ref found(PyObject_CallFunctionObjArgs(agree_, truth_of(here), nullptr));
    const int value = PyObject_IsTrue(found.get());
    if (value < 0) throw PythonError{};
    return value;
}

int PythonHooks::finish_step(const Step &step) {
    const Ref t_new = time(step.t_new);
    return code_of(
        Ref(PyObject_CallFunctionObjArgs(finish_, t_new.get(), truth_of(step.project), truth_of(step.last), nullptr)));
}

// One Newton step by the functions of `JointInvariants`: the one that `project_step` takes in the euclidean metric, its
// dead bands, bounds and verdict included. False where that needs more: gradients nearly parallel, or a projection that
// does not hold; nothing is counted then.
bool PythonHooks::project_jointly(const Step &step) {
    const Options &o = run_.options;
    const Work &w = run_.work;
    const Ref t = time(step.t_new);
    Ref(PyObject_CallFunctionObjArgs(moments_, t.get(), y_hat_, f_hat_, values_, R_, terms_, nullptr));
    const bool measured = o.watched && w.counters[HAVE_ERROR];
    if (measured) {
        const double err = norm(w.err, w.m);
        for (int64_t i = 0; i < w.l; ++i) w.worth[i] = std::abs(std::sqrt(w.R[i * w.l + i]) * err);
    }
    const bool outside = defects<double>(w.inverse_norms, nullptr, o, w, w.before);
    if (outside) {
        if (!gram_solution(Matrix{w.R, w.l, w.l, w.l}, w.g, w.mu)) return false;
        const npy_intp n = w.n;
        const Ref y_new = view(step.y_new, 1, &n, type_, to_);
        Ref(PyObject_CallFunctionObjArgs(shift_, t.get(), y_hat_, f_hat_, mu_, y_new.get(), values_, nullptr));
    } else {
        copy(w.y_hat, step.y_new, w.m);
    }
    if (!defects_held<double>(w.before, o, w) || !small_shares(o, w)) return false;
    ++w.counters[NJEV];
    if (outside) {
        ++w.counters[NLU];
        ++w.counters[PROJECTIONS];
        w.counters[LAST_RANK] = w.l;
    } else {
        ++w.counters[SKIPPED];
    }
    if (!o.watched) {
        raise_to(w.defect, w.max_defect, w.l);
    } else {
        const double steps = 1.0 + static_cast<double>(w.counters[WAITED]);
        note(step, measured ? steps : 0.0, EPS * std::sqrt(steps), nullptr, o, w);
    }
    return true;
}

}  // namespace eip
