#include "python_functions.hpp"

#include <numpy/arrayscalars.h>

#include "correction.hpp"

namespace eip {

namespace {

nb::handle kept_attribute(nb::handle object, const char *name, nb::list &kept) {
    const nb::object found = object.attr(name);
    kept.append(found);
    return found;
}

// An np.float64: where a function divides by t = 0 it gets inf, as from SciPy.
nb::object time(double t) {
    PyTypeObject *type = &PyDoubleArrType_Type;
    static const auto allocate = reinterpret_cast<allocfunc>(PyType_GetSlot(type, Py_tp_alloc));
    nb::object object = owned(allocate(type, 0));
    reinterpret_cast<PyDoubleScalarObject *>(object.ptr())->obval = t;
    return object;
}

// A new array with a copy of a state, or of its first `components`.
Array copied(const double *y, int64_t components, int type) {
    Array array = new_array({components}, type);
    std::memcpy(array.floats(), y, PyArray_NBYTES(array.get()));
    return array;
}

int width_of(int type) { return type == NPY_CDOUBLE ? 2 : 1; }

}  // namespace

PythonCall::PythonCall(nb::handle description, int type, int64_t components, nb::list &kept)
    : fun_(kept_attribute(description, "fun", kept)),
      convert_(kept_attribute(description, "convert", kept)),
      type_(type),
      components_(components),
      takes_f_(truth(description.attr("takes_f"))),
      in_place_(truth(description.attr("in_place"))) {
    const nb::handle args = kept_attribute(description, "args", kept);
    if (!nb::isinstance<nb::tuple>(args)) throw nb::type_error("engine: args must be a tuple");
    require(nb::len(args) <= MOST_ARGUMENTS, "engine: args has more than MOST_ARGUMENTS items");
    for (const nb::handle argument : nb::borrow<nb::tuple>(args)) args_.push_back(argument);
    value_type_ = truth(description.attr("real")) ? static_cast<int>(NPY_DOUBLE) : type;
    const nb::object shape = description.attr("shape");
    n_dimensions_ = nb::isinstance<nb::tuple>(shape) ? static_cast<int>(nb::len(shape)) : 3;
    if (n_dimensions_ > 2) throw nb::type_error("engine: shape must be a tuple of at most two lengths");
    floats_ = width_of(value_type_);
    for (int k = 0; k < n_dimensions_; ++k) {
        dimensions_[k] = nb::cast<npy_intp>(shape[k]);
        require(dimensions_[k] >= 0, "engine: shape contains a negative length");
        floats_ *= dimensions_[k];
    }
    const nb::handle compiled = kept_attribute(description, "compiled", kept);
    if (compiled.is_none()) return;
    pointer_ = nb::cast<uintptr_t>(compiled.attr("address"));
    pointer_takes_f_ = truth(compiled.attr("takes_f"));
    require(pointer_, "engine: compiled code needs an address");
    const nb::object params = compiled.attr("params");
    require(is_plain(params.ptr(), NPY_DOUBLE, 1), "engine: params must be an array of floats");
    params_ = nb::cast<Array>(params).floats();
    for (std::vector<double> &state : states_) state.resize(components_ * width_of(type_));
}

// Call the compiled function; false if it raised an exception, or its value has another shape.
bool PythonCall::by_pointer(double t, const double *y, const double *f, double *out) const {
    const int64_t m = std::ssize(states_[0]);
    copy(y, states_[0].data(), m);
    if (!pointer_takes_f_) return reinterpret_cast<ValuePointer>(pointer_)(t, states_[0].data(), out, params_) == 0;
    if (f) copy(f, states_[1].data(), m);
    return reinterpret_cast<GradientPointer>(pointer_)(t, states_[0].data(), states_[1].data(), out, params_) == 0;
}

void PythonCall::operator()(double t, const double *y, const double *f, double *out, nb::handle owner,
                            nb::handle given) const {
    if (pointer_ && by_pointer(t, y, f, out)) return;
    PyObject *arguments[5 + MOST_ARGUMENTS];  // t, y, f and out before them, and the place of the callee
    const nb::object time_object = given.is_valid() ? nb::borrow(given) : time(t),
                     y_object = copied(y, components_, type_);
    nb::object f_object, out_object;
    size_t count = 1;  // the first place is the callee's
    arguments[count++] = time_object.ptr();
    arguments[count++] = y_object.ptr();
    if (takes_f_) {
        f_object = copied(f, components_, type_);
        arguments[count++] = f_object.ptr();
    }
    if (in_place_) {
        fill(out, NOT_A_NUMBER, floats_);  // shows where the function leaves a part of it as it was
        out_object = view(out, n_dimensions_, dimensions_, value_type_, owner);
        arguments[count++] = out_object.ptr();
    }
    for (const nb::handle argument : args_) arguments[count++] = argument.ptr();
    const nb::object value =
        owned(PyObject_Vectorcall(fun_.ptr(), arguments + 1, (count - 1) | PY_VECTORCALL_ARGUMENTS_OFFSET, nullptr));
    if (!in_place_) take(value.ptr(), time_object.ptr(), out);
    Ending::leave_if_begun();
}

// Copy a list of the expected number of floats, of Python or NumPy, as most functions return; false if it is another value.
bool PythonCall::take_list(PyObject *value, double *out) const {
    const nb::ft_object_guard unchanged{nb::handle(value)};  // by other threads, in a Python without a global lock
    if (n_dimensions_ != 1 || value_type_ != NPY_DOUBLE || !PyList_CheckExact(value)) return false;
    if (PyList_Size(value) != dimensions_[0]) return false;
    for (Py_ssize_t k = 0; k < dimensions_[0]; ++k)
        if (!PyFloat_Check(PyList_GetItem(value, k))) return false;
    for (Py_ssize_t k = 0; k < floats_; ++k) out[k] = PyFloat_AsDouble(PyList_GetItem(value, k));
    return true;
}

void PythonCall::take(PyObject *value, PyObject *t, double *out) const {
    if (n_dimensions_ == 0 && PyFloat_Check(value)) {
        out[0] = PyFloat_AsDouble(value);
        return;
    }
    if (take_list(value, out)) return;
    const auto plain = [this](PyObject *a) {
        return is_plain(a, value_type_, n_dimensions_) &&
               std::equal(dimensions_, dimensions_ + n_dimensions_, PyArray_DIMS(reinterpret_cast<PyArrayObject *>(a)));
    };
    nb::object found = nb::borrow(value);
    if (!PyArray_CheckExact(value) || !plain(value)) {
        found = convert_(nb::handle(value), nb::handle(t));
        if (!plain(found.ptr()))
            refuse(PyExc_TypeError,
                   "engine: convert returned %.80R, expected an array of the shape and dtype of the function's values",
                   found.ptr());
    }
    std::memcpy(out, PyArray_DATA(reinterpret_cast<PyArrayObject *>(found.ptr())), floats_ * sizeof(double));
}

PythonFunctions::PythonFunctions(nb::handle functions, nb::handle owner, const Work &sizes, int type, nb::list &kept)
    : owner_(owner),
      m_(sizes.m),
      second_order_(truth(functions.attr("second_order"))) {
    const int64_t components = second_order_ ? sizes.n / 2 : sizes.n;
    rhs_.emplace(functions.attr("rhs"), type, components, kept);
    const auto calls = [&](const nb::object &items, const char *name, Functions kind, int64_t expected) {
        int64_t total = 0;
        for (const nb::handle item : items) {
            std::optional<PythonCall> &call = calls_[kind].emplace_back();
            if (!item.is_none()) total += call.emplace(item, type, sizes.n, kept).floats();
        }
        if (expected >= 0) require_floats(name, total, expected);
    };
    calls(nb::object(functions.attr("inv")), "inv", VALUES, sizes.l);
    calls(nb::object(functions.attr("grad")), "grad", GRADIENTS, sizes.l * sizes.m);
    calls(nb::object(functions.attr("event")), "event", EVENTS, -1);
    calls(nb::object(nb::object(functions.attr("rates")).attr("functions")), "rates", RATES, -1);
    require(rhs_->floats() == (second_order_ ? m_ / 2 : m_), "engine: rhs must give as many numbers as the state has");
    const nb::object jacobian = functions.attr("jacobian");
    if (jacobian.is_none()) return;
    jacobian_.emplace(jacobian, type, sizes.n / 2, kept);
    require(jacobian_->floats() == m_ / 2, "engine: jacobian must fill n / 2 numbers for a state of n numbers");
}

void PythonFunctions::add_owner(nb::handle owner, nb::list &kept) {
    const nb::object both = nb::make_tuple(owner_, owner);
    kept.append(both);
    owner_ = both;
}

void PythonFunctions::rhs(double t, const double *y, double *out) {
    if (!second_order_) return (*rhs_)(t, y, nullptr, out, owner_);
    copy(y + m_ / 2, out, m_ / 2);
    (*rhs_)(t, y, nullptr, out + m_ / 2, owner_);
}

void PythonFunctions::jacobian(double t, const double *q, const double *dq, double *out) {
    (*jacobian_)(t, q, dq, out, owner_);
}

void PythonFunctions::all(Functions kind, double t, const double *y, const double *f, double *out) {
    for (const auto &call : calls_[kind]) {
        (*call)(t, y, f, out, owner_);
        out += call->floats();
    }
}

void PythonFunctions::gradients(double t, const double *y, const double *f, double *G, const FromF &known) {
    int64_t i = 0;
    for (const auto &call : calls_[GRADIENTS]) {
        if (!known.has(i)) (*call)(t, y, f, G, owner_);
        G += call->floats();
        i += call->floats() / m_;
    }
}

void PythonFunctions::one(Functions kind, int64_t k, double t, const double *y, const double *f, double *out) {
    (*calls_[kind][k])(t, y, f, out, owner_);
}

PythonHooks::PythonHooks(nb::handle hooks, const Buffers &buffers, const Run &run, nb::list &kept)
    : run_(run),
      type_(buffers.type) {
    const auto given = [&](const char *name) {
        const nb::handle found = kept_attribute(hooks, name, kept);
        return found.is_none() ? nb::handle() : found;
    };
    one_step_ = given("one_step");
    estimates_ = truth(hooks.attr("estimates"));
    raw = one_step_.is_valid();
    drives = truth(hooks.attr("drives"));
    const nb::handle joint_invariants = given("joint");
    joint = joint_invariants.is_valid();
    if (!joint) return;
    moments_ = kept_attribute(joint_invariants, "moments", kept);
    shift_ = kept_attribute(joint_invariants, "shift", kept);
    const auto array = [&](const char *name) {
        const Array found = buffers.array(name);
        kept.append(found);
        return nb::handle(found);
    };
    y_hat_ = array("y_hat");
    values_ = array("values");
    R_ = array("R");
    terms_ = array("inverse_norms");
    mu_ = array("mu");
    const nb::object last = buffers.array("K")[-1];
    kept.append(last);
    f_hat_ = last;
}

// A step of a solver into w.y_hat, w.err and w.K, and its times into the clock. TOO_SMALL: it has failed.
int PythonHooks::drive(double t, const double *y, bool again, double *clock) {
    const nb::object made = one_step_(time(t), copied(y, run_.work.n, type_), nb::bool_(again));
    if (made.is_none()) return TOO_SMALL;
    clock[TIME] = t;
    clock[TIME_NEW] = nb::cast<double>(made[0]);
    clock[LENGTH] = clock[TIME_NEW] - t;
    clock[NEXT_LENGTH] = nb::cast<double>(made[1]);
    return OK;
}

// Does the work of `raw_step` by a user-defined method. f is evaluated only if a gradient needs it: the steps do not.
int PythonHooks::raw_step(const Step &step) {
    const Options &o = run_.options;
    const Work &w = run_.work;
    if (!drives) one_step_(time(step.t), copied(step.y, w.n, type_), time(step.h));
    if (!all_finite(w.y_hat, w.m)) return NOT_FINITE;
    if (step.project && o.uses_f) {
        if (o.direction == OLD) evaluate_f(run_, step.t, step.y, w.row(0));
        evaluate_f(run_, step.t_new, w.y_hat, w.last());
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
    if (o.adaptive && !drives) w.norm[0] = error_norm(w.err, step.y, w.y_hat, o, w.n);
    return OK;
}

// One Newton step by the functions `moments` and `shift` of the invariants of a field: the one that `project_step` takes
// in the euclidean metric, its dead bands, bounds and verdict included. False where that needs more: gradients nearly
// parallel, or a projection that does not hold; nothing is counted then.
bool PythonHooks::project_jointly(const Step &step) {
    const Options &o = run_.options;
    const Work &w = run_.work;
    const nb::object t = time(step.t_new);
    moments_(t, y_hat_, f_hat_, values_, R_, terms_);
    const bool measured = o.watched && w.counters[HAVE_ERROR];
    if (measured) {
        const double err = norm(w.err, w.m);
        for (int64_t i = 0; i < w.l; ++i) w.worth[i] = std::abs(std::sqrt(w.R[i * w.l + i]) * err);
    }
    const bool outside = residuals<double>(w.inverse_norms, nullptr, o, w, w.before);
    if (outside) {
        if (!gram_solution(Matrix{w.R, w.l, w.l, w.l}, w.g, w.mu)) return false;
        const npy_intp n = w.n;
        shift_(t, y_hat_, f_hat_, mu_, view(step.y_new, 1, &n, type_, to_), values_);
    } else {
        copy(w.y_hat, step.y_new, w.m);
    }
    if (!residuals_held<double>(w.before, o, w) || !small_shares(o, w)) return false;
    ++w.counters[NJEV];
    if (outside) {
        ++w.counters[NLU];
        ++w.counters[PROJECTIONS];
        w.counters[LAST_RANK] = w.l;
    } else {
        ++w.counters[SKIPPED];
    }
    if (!o.watched) {
        raise_to(w.residual, w.max_residual, w.l);
    } else {
        const double steps = 1.0 + static_cast<double>(w.counters[WAITED]);
        note(step, measured ? steps : 0.0, EPS * std::sqrt(steps), nullptr, o, w);
    }
    return true;
}

}  // namespace eip
