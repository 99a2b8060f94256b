// The binding: an Engine holds a run's arrays and functions, and steps.
#define EIP_IMPORTS_NUMPY
#include "functions.hpp"

#include "calls.hpp"
#include "library_functions.hpp"
#include "python_functions.hpp"
#include "records.hpp"

#if defined(__clang__)
#define EIP_COMPILER __VERSION__  // begins with its name
#elif defined(__GNUC__)
#define EIP_COMPILER "GCC " __VERSION__
#else
#define EIP_COMPILER "an unnamed compiler"
#endif

namespace eip {

// FailedCallError(which functions, which of them, t, bytes of y, of f, status): whoever made them says what it means.
static PyObject *failed_call_error = nullptr;

void raise_broken(const System &system) {
    if (PyErr_Occurred()) return;
    const FailedCall &call = system.failed;
    const auto bytes = [](const std::vector<double> &a) { return static_cast<Py_ssize_t>(a.size() * sizeof(double)); };
    const Ref arguments(Py_BuildValue("(sLdy#y#i)", call.functions, static_cast<long long>(call.index), call.t,
                                      call.y.data(), bytes(call.y), call.f.data(), bytes(call.f), call.status));
    PyErr_SetObject(failed_call_error, arguments.get());
}

namespace {

// Whether the processor takes the other build, for x86-64-v3.
bool has_v3() {
#if defined(__x86_64__)
    __builtin_cpu_init();
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2");
#else
    return false;
#endif
}

struct Engine {
    PyObject_HEAD
    PyObject *kept;  // every object that the run uses
    Data *data;
    Schedule *schedule;
    Samples *samples;
    Eight *eight;
    PythonFunctions *functions;
    PythonHooks *hooks;
    int type;
    bool busy, interpolating;
};

void engine_setup(Engine *self, PyObject *method, PyObject *options, PyObject *work, PyObject *functions,
                  PyObject *schedule, PyObject *hooks) {
    Arrays arrays(self->kept);
    const Ref y_hat = attribute(work, "y_hat");
    const bool is_complex =
        PyArray_Check(y_hat.get()) && PyArray_TYPE(reinterpret_cast<PyArrayObject *>(y_hat.get())) == NPY_CDOUBLE;
    self->type = is_complex ? NPY_CDOUBLE : NPY_DOUBLE;
    self->data = new Data();
    Data &run = *self->data;
    run.method = method_of(method, arrays);
    run.work = work_of(work, run.method.stages, Arrays::length(work, "scale"), arrays, self->type);
    run.options = options_of(options, run.work, arrays);
    if (run.options.blocks.count != Arrays::length(work, "scale")) {
        PyErr_SetString(PyExc_ValueError, "engine: work has room for another number of blocks");
        throw PythonError{};
    }
    if (schedule != Py_None) self->schedule = new Schedule(schedule_of(schedule, arrays));
    System &system = run.system;
    const int64_t events = self->schedule ? self->schedule->n_events : 0;
    for (PyObject *object : {method, options, work, functions, schedule, hooks})
        if (PyList_Append(self->kept, object) < 0) throw PythonError{};
    const bool native = truth(functions, "native");
    const Ref python = native ? attribute(functions, "python") : Ref::borrowed(functions);
    const bool by_python = python.get() != Py_None;
    if (native) read_pointers(functions, run.work, by_python ? 0 : events, arrays, system);
    if (by_python) {
        self->functions = new PythonFunctions(python.get(), work, run.work, self->type, self->kept);
        system.python = self->functions;
        if (self->functions->events() != events) {
            PyErr_SetString(PyExc_ValueError, "engine: another number of events than their values have room for");
            throw PythonError{};
        }
    }
    if (hooks != Py_None) {
        const Run steps{run.method, run.options, run.work, run.system, nullptr};
        self->hooks = new PythonHooks(hooks, work, steps, self->type, self->kept);
    }
    if (!self->hooks || !self->hooks->raw) read_tableau(method, arrays, run.method);
    const Ref multistep = attribute(method, "multistep");
    if (multistep.get() != Py_None) {
        run.multistep = multistep_of(multistep.get(), run.work, arrays);
        run.method.multistep = &run.multistep;
        const bool jacobian = native ? system.jacobian_pointer.pointer || system.jacobian_pointer.library
                                     : self->functions->has_jacobian();
        if (self->hooks || !run.options.compensated || (run.multistep.count > 0 && !jacobian)) {
            PyErr_SetString(PyExc_ValueError, "engine: the options do not fit a multistep method");
            throw PythonError{};
        }
    }
    if ((run.method.nystrom || system.second_order) && run.work.m % 2) {
        PyErr_SetString(PyExc_ValueError, "engine: a state of positions and velocities has an even length");
        throw PythonError{};
    }
}

// The engine steps for one caller at a time, and interpolates for one: a function that does so with the run it belongs to
// is refused. Hooks come back to it while it works, to project and to close the step at hand.
class Busy {
  public:
    explicit Busy(bool &flag) : flag_(flag) {
        if (flag) {
            PyErr_SetString(PyExc_RuntimeError,
                            "engine: a run cannot be stepped, nor its dense output evaluated, from its own functions");
            throw PythonError{};
        }
        flag = true;
    }
    ~Busy() { flag_ = false; }

  private:
    bool &flag_;
};

// A method's arguments: as many as `names` says, of an engine that is set up.
void expect(Engine *self, Py_ssize_t count, Py_ssize_t expected, const char *names) {
    if (!self->data)
        PyErr_SetString(PyExc_RuntimeError, "engine: not set up");
    else if (count != expected)
        PyErr_Format(PyExc_TypeError, "engine: expected the arguments %s", names);
    if (PyErr_Occurred()) throw PythonError{};
}

// Make a step or more by `call`, which takes a Run, without the GIL if no function is Python's. An exception of the engine
// leaves only after the GIL is taken again, since `guarded` turns it into Python's.
template <typename Call>
Code stepped(Engine *self, Call call) {
    const FloatingPoint mode;
    Data &d = *self->data;
    PyThreadState *released = d.system.python || self->hooks ? nullptr : PyEval_SaveThread();
    Code code = OK;
    bool broken = false;
    std::exception_ptr thrown;
    try {
        code = call(Run{d.method, d.options, d.work, d.system, self->hooks});
    } catch (const Broken &) {
        broken = true;
    } catch (const PythonError &) {
        broken = true;
    } catch (const std::exception &) {
        thrown = std::current_exception();
    }
    if (released) PyEval_RestoreThread(released);
    if (thrown) std::rethrow_exception(thrown);
    if (broken) {
        raise_broken(d.system);
        throw PythonError{};
    }
    return code;
}

Schedule &scheduled(Engine *self) {
    if (!self->schedule) {
        PyErr_SetString(PyExc_RuntimeError, "engine: this one has no schedule");
        throw PythonError{};
    }
    return *self->schedule;
}

double *state_of(PyObject *object, const char *name, Engine *self, PyObject *kept, bool read_only = false) {
    Arrays arrays(kept);
    return static_cast<double *>(arrays.memory(object, name, self->type, {self->data->work.n}, read_only));
}

// Counts that Python may have written, before the loop goes by them.
void check_room(const Schedule &schedule, const Saved &saved, const Samples *samples, const Multistep *multistep) {
    const int64_t row = schedule.place[ROW];
    bool good = row >= 0 && row <= saved.rows && schedule.n_eval < std::max<int64_t>(saved.rows, 1);
    if (multistep) check_history(*multistep);
    if (samples) {
        const int64_t roots = *samples->roots.count, pieces = *samples->interpolants.count;
        good &= roots >= 0 && pieces >= 0 && pieces <= samples->interpolants.capacity;
    }
    if (good) return;
    PyErr_SetString(PyExc_ValueError, "engine: place or counts are outside the rows, or there are too few");
    throw PythonError{};
}

PyDoc_STRVAR(advance_doc,
             "advance(k_end, y, y_new, t_saved, y_saved, pieces) -> int\n\nStep on to step k_end, or to what stops the "
             "loop. pieces (rows, floats) receives the interpolants of all steps if it has rows.");

PyObject *engine_advance(Engine *self, PyObject *const *args, Py_ssize_t count) {
    return guarded([&]() -> PyObject * {
        expect(self, count, 6, "k_end, y, y_new, t_saved, y_saved, pieces");
        const Busy busy(self->busy);
        const Ref kept(PyList_New(0));
        const Schedule &schedule = scheduled(self);
        const long long k_end = PyLong_AsLongLong(args[0]);
        if (k_end == -1 && PyErr_Occurred()) return nullptr;
        double *y = state_of(args[1], "y", self, kept.get()), *y_new = state_of(args[2], "y_new", self, kept.get());
        Arrays arrays(kept.get());
        Saved saved{};
        saved.t = static_cast<double *>(arrays.memory(args[3], "t_saved", NPY_DOUBLE, {ANY}));
        saved.rows = PyArray_DIM(reinterpret_cast<PyArrayObject *>(args[3]), 0);
        saved.y =
            static_cast<double *>(arrays.memory(args[4], "y_saved", self->type, {saved.rows, self->data->work.n}));
        Samples *samples = self->samples;
        if (samples) {
            Pieces &pieces = samples->interpolants;
            pieces.first =
                static_cast<double *>(arrays.memory(args[5], "pieces", NPY_DOUBLE, {ANY, samples->dense.floats()}));
            pieces.capacity = PyArray_DIM(reinterpret_cast<PyArrayObject *>(args[5]), 0);
        }
        check_room(schedule, saved, samples, self->data->method.multistep);
        if (self->hooks) self->hooks->set_state(args[2]);
        return PyLong_FromLong(
            stepped(self, [&](const Run &run) { return advance_run(run, samples, schedule, k_end, y, y_new, saved); }));
    });
}

// What both sweeps take: the members, how many steps, and the states of the run.
struct SweepArguments {
    Members members;
    int64_t steps;
    double *y, *y_new;
};

SweepArguments sweep_arguments(Engine *self, PyObject *const *args, PyObject *kept) {
    SweepArguments given{};
    given.steps = PyLong_AsLongLong(args[1]);
    if (given.steps == -1 && PyErr_Occurred()) throw PythonError{};
    given.y = state_of(args[2], "y", self, kept);
    given.y_new = state_of(args[3], "y_new", self, kept);
    Arrays arrays(kept);
    auto *t_saved = static_cast<double *>(arrays.memory(args[4], "t_saved", NPY_DOUBLE, {ANY}));
    const npy_intp rows = PyArray_DIM(reinterpret_cast<PyArrayObject *>(args[4]), 0);
    given.members = members_of(args[0], *self->data, scheduled(self), rows, arrays, self->type);
    given.members.t_saved = t_saved;
    if (given.steps < 1 || rows < 2) {
        PyErr_SetString(PyExc_ValueError, "engine: members need a step or more, and two rows or more");
        throw PythonError{};
    }
    return given;
}

PyDoc_STRVAR(
    sweep_doc,
    "sweep(members, steps, y, y_new, t_saved) -> int\n\nRun members of an ensemble one after the other, so many "
    "steps in all; `members` is a record of data.py, whose `where` says how far they are.");

PyObject *engine_sweep(Engine *self, PyObject *const *args, Py_ssize_t count) {
    return guarded([&]() -> PyObject * {
        expect(self, count, 5, "members, steps, y, y_new, t_saved");
        const Busy busy(self->busy);
        const Ref kept(PyList_New(0));
        const Schedule &schedule = scheduled(self);
        const auto [members, steps, y, y_new] = sweep_arguments(self, args, kept.get());
        if (self->functions || self->hooks || (schedule.n_events > 0 && !self->samples)) {
            PyErr_SetString(PyExc_ValueError, "engine: members are swept by native functions");
            return nullptr;
        }
        check_room(schedule, members.saved(0, self->data->work), self->samples, self->data->method.multistep);
        if (self->samples) self->samples->interpolants.capacity = 0;
        return PyLong_FromLong(stepped(self, [&](const Run &run) {
            return sweep_members(run, self->samples, schedule, members, steps, y, y_new);
        }));
    });
}

PyDoc_STRVAR(
    eight_doc,
    "side_by_side(functions) -> None\n\nFunctions of eight members, by which `sweep_octets` runs them from now "
    "on; `functions` holds addresses, as those of the run.");

PyObject *engine_side_by_side(Engine *self, PyObject *const *args, Py_ssize_t count) {
    return guarded([&]() -> PyObject * {
        expect(self, count, 1, "functions");
        const Busy busy(self->busy);
        if (PyList_Append(self->kept, args[0]) < 0) return nullptr;
        const Data &d = *self->data;
        delete std::exchange(self->eight, new Eight(d.method, d.options, d.work, octet_system_of(args[0], d)));
        Py_RETURN_NONE;
    });
}

PyDoc_STRVAR(
    sweep_octets_doc,
    "sweep_octets(members, steps, y, y_new, t_saved) -> int\n\nThe same, eight members side by side, by steps of "
    "all eight. Whose status is not set has to run by itself.");

PyObject *engine_sweep_octets(Engine *self, PyObject *const *args, Py_ssize_t count) {
    return guarded([&]() -> PyObject * {
        expect(self, count, 5, "members, steps, y, y_new, t_saved");
        const Busy busy(self->busy);
        const Ref kept(PyList_New(0));
        const Schedule &s = scheduled(self);
        const auto [members, steps, y, y_new] = sweep_arguments(self, args, kept.get());
        const bool fixed = s.span.h != 0.0 && s.n_events == 0 && (s.n_eval == 0 || (self->samples && members.kept));
        const int64_t saved = s.n_eval > 0 ? s.n_eval : s.save_every > 0 ? s.span.n_steps / s.save_every + 2 : 2;
        if (!self->eight || !fixed || (members.kept && members.n_rows < saved)) {
            PyErr_SetString(PyExc_ValueError,
                            "engine: members side by side take fixed steps, and need room for all rows");
            return nullptr;
        }
        Samples *samples = self->samples;
        if (samples) samples->interpolants.capacity = 0;
        const Octets octets{*self->eight, samples};
        return PyLong_FromLong(
            stepped(self, [&](const Run &run) { return sweep_eights(run, octets, s, members, steps, y, y_new); }));
    });
}

PyDoc_STRVAR(sample_doc, "sample(dense) -> None\n\nDense output from now on; `dense` is a record of data.py.");

PyObject *engine_sample(Engine *self, PyObject *const *args, Py_ssize_t count) {
    return guarded([&]() -> PyObject * {
        expect(self, count, 1, "dense");
        const Busy busy(self->busy), interpolating(self->interpolating);
        Arrays arrays(self->kept);
        if (PyList_Append(self->kept, args[0]) < 0) return nullptr;
        const int64_t events = self->schedule ? self->schedule->n_events : 0;
        const Samples samples = samples_of(args[0], *self->data, events, arrays, self->type);
        if (self->functions) self->functions->add_buffers(attribute(args[0], "work").get(), self->kept);
        delete std::exchange(self->samples, new Samples(samples));
        Py_RETURN_NONE;
    });
}

const Dense &dense_output(Engine *self) {
    if (!self->samples) {
        PyErr_SetString(PyExc_RuntimeError, "engine: no dense output");
        throw PythonError{};
    }
    return self->samples->dense;
}

PyDoc_STRVAR(describe_doc,
             "describe(t_old, y_old, t, y, piece) -> None\n\nThe interpolant over the step made last, as numbers.");

PyObject *engine_describe(Engine *self, PyObject *const *args, Py_ssize_t count) {
    return guarded([&]() -> PyObject * {
        expect(self, count, 5, "t_old, y_old, t, y, piece");
        const Busy busy(self->busy), interpolating(self->interpolating);
        const Dense &d = dense_output(self);
        const Ref kept(PyList_New(0));
        const double t_old = PyFloat_AsDouble(args[0]), t = PyFloat_AsDouble(args[2]);
        if (PyErr_Occurred()) return nullptr;
        const double *y_old = state_of(args[1], "y_old", self, kept.get(), true);
        const double *y = state_of(args[3], "y", self, kept.get(), true);
        Arrays arrays(kept.get());
        auto *piece = static_cast<double *>(arrays.memory(args[4], "piece", NPY_DOUBLE, {d.floats()}));
        stepped(self, [&](const Run &run) {
            describe_step(run, d, t_old, y_old, t, y, piece);
            return OK;
        });
        Py_RETURN_NONE;
    });
}

PyDoc_STRVAR(show_doc,
             "show(t, y, out) -> None\n\nFill out (n,) with the last state, y at t, as the run hands it out.");

PyObject *engine_show(Engine *self, PyObject *const *args, Py_ssize_t count) {
    return guarded([&]() -> PyObject * {
        expect(self, count, 3, "t, y, out");
        const Busy busy(self->busy), interpolating(self->interpolating);
        dense_output(self);
        const Ref kept(PyList_New(0));
        const double t = PyFloat_AsDouble(args[0]);
        if (PyErr_Occurred()) return nullptr;
        const double *y = state_of(args[1], "y", self, kept.get(), true);
        double *out = state_of(args[2], "out", self, kept.get());
        const int64_t end = scheduled(self).place[PENDING] == 1;
        stepped(self, [&](const Run &run) {
            show_state(run, *self->samples, end, t, y, out);
            return OK;
        });
        Py_RETURN_NONE;
    });
}

PyDoc_STRVAR(
    interpolate_doc,
    "interpolate(piece, t, out) -> None\n\nFill out (m, n) with the states at times t (m,) by an interpolant.");

PyObject *engine_interpolate(Engine *self, PyObject *const *args, Py_ssize_t count) {
    return guarded([&]() -> PyObject * {
        expect(self, count, 3, "piece, t, out");
        const Busy interpolating(self->interpolating);
        const Dense &d = dense_output(self);
        const Ref kept(PyList_New(0));
        Arrays arrays(kept.get());
        auto *piece = static_cast<double *>(arrays.memory(args[0], "piece", NPY_DOUBLE, {d.floats()}));
        const auto *t = static_cast<const double *>(arrays.memory(args[1], "t", NPY_DOUBLE, {ANY}, true));
        const npy_intp rows = PyArray_DIM(reinterpret_cast<PyArrayObject *>(args[1]), 0);
        auto *out = static_cast<double *>(arrays.memory(args[2], "out", self->type, {rows, d.work.n}));
        stepped(self, [&](const Run &run) {
            interpolate_step(run, d, piece, t, rows, out);
            return OK;
        });
        Py_RETURN_NONE;
    });
}

PyDoc_STRVAR(
    step_doc,
    "step(k, t, y, f) -> (status, t_new, y_new, f_new)\n\nStep k from the state y at t with the derivative f.");

PyObject *engine_step(Engine *self, PyObject *const *args, Py_ssize_t count) {
    return guarded([&]() -> PyObject * {
        expect(self, count, 4, "k, t, y, f");
        const Busy busy(self->busy);
        const Work &w = self->data->work;
        const Ref kept(PyList_New(0));
        const Schedule &s = scheduled(self);
        const long long k = PyLong_AsLongLong(args[0]);
        s.clock[TIME] = PyFloat_AsDouble(args[1]);
        if (PyErr_Occurred()) return nullptr;
        const double *y = state_of(args[2], "y", self, kept.get(), true);
        copy(state_of(args[3], "f", self, kept.get(), true), w.row(0), w.m);
        npy_intp n = w.n;
        Ref y_new(PyArray_SimpleNew(1, &n, self->type));
        double *end = static_cast<double *>(PyArray_DATA(reinterpret_cast<PyArrayObject *>(y_new.get())));
        if (self->hooks) self->hooks->set_state(y_new.get());
        const Code code = stepped(self, [&](const Run &run) { return step_once(run, s, k, y, end); });
        Ref f_new(PyArray_SimpleNew(1, &n, self->type));
        copy(w.last(), static_cast<double *>(PyArray_DATA(reinterpret_cast<PyArrayObject *>(f_new.get()))), w.m);
        return Py_BuildValue("(idNN)", static_cast<int>(code), s.clock[TIME_NEW], y_new.release(), f_new.release());
    });
}

// A projection by itself, or within a step whose hook calls for it.
PyDoc_STRVAR(project_doc, "project(t_old, y, t, last, y_new) -> int\n\nProject work.y_hat into y_new.");

PyObject *engine_project(Engine *self, PyObject *const *args, Py_ssize_t count) {
    return guarded([&]() -> PyObject * {
        expect(self, count, 5, "t_old, y, t, last, y_new");
        const Ref kept(PyList_New(0));
        Step step{};
        step.t = PyFloat_AsDouble(args[0]);
        step.t_new = PyFloat_AsDouble(args[2]);
        step.h = step.t_new - step.t;
        step.y = state_of(args[1], "y", self, kept.get(), true);
        step.y_new = state_of(args[4], "y_new", self, kept.get());
        step.last = PyObject_IsTrue(args[3]);
        step.project = true;
        if (PyErr_Occurred()) return nullptr;
        if (self->hooks) self->hooks->set_state(args[4]);
        return PyLong_FromLong(stepped(self, [&](const Run &run) { return project_once(run, step); }));
    });
}

PyDoc_STRVAR(close_doc,
             "close(t_new, y_new, project, status) -> None\n\nEnd a step whose state is y_new, after its projection.");

PyObject *engine_close(Engine *self, PyObject *const *args, Py_ssize_t count) {
    return guarded([&]() -> PyObject * {
        expect(self, count, 4, "t_new, y_new, project, status");
        const Ref kept(PyList_New(0));
        Step step{};
        step.t_new = PyFloat_AsDouble(args[0]);
        step.y_new = state_of(args[1], "y_new", self, kept.get());
        step.project = PyObject_IsTrue(args[2]);
        const auto status = static_cast<Code>(PyLong_AsLong(args[3]));
        if (PyErr_Occurred()) return nullptr;
        stepped(self, [&](const Run &run) {
            close_once(run, step, status);
            return OK;
        });
        Py_RETURN_NONE;
    });
}

PyDoc_STRVAR(
    values_doc,
    "values(t, y, out, params=None) -> None\n\nFill out (m, l) with the invariants at states y (m, n), each with "
    "its own params (m, p) where they are given.");

PyObject *engine_values(Engine *self, PyObject *const *args, Py_ssize_t count) {
    return guarded([&]() -> PyObject * {
        expect(self, count == 4 ? 3 : count, 3, "t, y, out, and params or not");
        const Busy busy(self->busy);
        const Ref kept(PyList_New(0));
        Arrays arrays(kept.get());
        const Work &w = self->data->work;
        const System &system = self->data->system;
        const auto *t = static_cast<const double *>(arrays.memory(args[0], "t", NPY_DOUBLE, {ANY}, true));
        const npy_intp rows = PyArray_DIM(reinterpret_cast<PyArrayObject *>(args[0]), 0);
        const auto *y = static_cast<const double *>(arrays.memory(args[1], "y", self->type, {rows, w.n}, true));
        auto *out = static_cast<double *>(arrays.memory(args[2], "out", NPY_DOUBLE, {rows, w.l}));
        const double *params = nullptr;
        if (count == 4 && system.n_params > 0)
            params = static_cast<const double *>(
                arrays.memory(args[3], "params", NPY_DOUBLE, {rows, system.n_params}, true));
        stepped(self, [&](const Run &run) {
            for (npy_intp k = 0; k < rows; ++k) {
                if (params) copy(params + k * system.n_params, system.params, system.n_params);
                run.system.inv(run.work, t[k], y + k * w.m, out + k * w.l);
            }
            return OK;
        });
        Py_RETURN_NONE;
    });
}

PyDoc_STRVAR(start_doc, "start(y, f, tau) -> None\n\nThe invariants' terms at the start, from work.values and work.G.");

PyObject *engine_start(Engine *self, PyObject *const *args, Py_ssize_t count) {
    return guarded([&]() -> PyObject * {
        expect(self, count, 3, "y, f, tau");
        const Busy busy(self->busy);
        const Ref kept(PyList_New(0));
        const double *y = state_of(args[0], "y", self, kept.get(), true),
                     *f = state_of(args[1], "f", self, kept.get(), true);
        const double tau = PyFloat_AsDouble(args[2]);
        if (PyErr_Occurred()) return nullptr;
        const Data &run = *self->data;
        start_figures(y, f, tau, run.method, self->hooks, run.options, run.work);
        Py_RETURN_NONE;
    });
}

int engine_traverse(Engine *self, visitproc visit, void *arg) {
    Py_VISIT(self->kept);
    return 0;
}

void engine_release(Engine *self) {
    delete std::exchange(self->data, nullptr);
    delete std::exchange(self->schedule, nullptr);
    delete std::exchange(self->samples, nullptr);
    delete std::exchange(self->eight, nullptr);
    delete std::exchange(self->functions, nullptr);
    delete std::exchange(self->hooks, nullptr);
}

int engine_clear(Engine *self) {
    engine_release(self);
    Py_CLEAR(self->kept);
    return 0;
}

void engine_dealloc(Engine *self) {
    PyObject_GC_UnTrack(self);
    engine_clear(self);
    Py_TYPE(self)->tp_free(reinterpret_cast<PyObject *>(self));
}

PyObject *engine_new(PyTypeObject *type, PyObject *args, PyObject *keywords) {
    static const char *names[] = {"method", "options", "work", "functions", "schedule", "hooks", nullptr};
    PyObject *method, *options, *work, *functions, *schedule = Py_None, *hooks = Py_None;
    if (!PyArg_ParseTupleAndKeywords(args, keywords, "OOOO|OO", const_cast<char **>(names), &method, &options, &work,
                                     &functions, &schedule, &hooks))
        return nullptr;
    auto *self = reinterpret_cast<Engine *>(type->tp_alloc(type, 0));
    if (!self) return nullptr;
    PyObject *made = guarded([&]() -> PyObject * {
        self->kept = Ref(PyList_New(0)).release();
        engine_setup(self, method, options, work, functions, schedule, hooks);
        return reinterpret_cast<PyObject *>(self);
    });
    if (!made) Py_DECREF(self);
    return made;
}

PyMethodDef engine_methods[] = {
    {"advance", reinterpret_cast<PyCFunction>(engine_advance), METH_FASTCALL, advance_doc},
    {"sweep", reinterpret_cast<PyCFunction>(engine_sweep), METH_FASTCALL, sweep_doc},
    {"side_by_side", reinterpret_cast<PyCFunction>(engine_side_by_side), METH_FASTCALL, eight_doc},
    {"sweep_octets", reinterpret_cast<PyCFunction>(engine_sweep_octets), METH_FASTCALL, sweep_octets_doc},
    {"step", reinterpret_cast<PyCFunction>(engine_step), METH_FASTCALL, step_doc},
    {"project", reinterpret_cast<PyCFunction>(engine_project), METH_FASTCALL, project_doc},
    {"close", reinterpret_cast<PyCFunction>(engine_close), METH_FASTCALL, close_doc},
    {"values", reinterpret_cast<PyCFunction>(engine_values), METH_FASTCALL, values_doc},
    {"start", reinterpret_cast<PyCFunction>(engine_start), METH_FASTCALL, start_doc},
    {"sample", reinterpret_cast<PyCFunction>(engine_sample), METH_FASTCALL, sample_doc},
    {"describe", reinterpret_cast<PyCFunction>(engine_describe), METH_FASTCALL, describe_doc},
    {"interpolate", reinterpret_cast<PyCFunction>(engine_interpolate), METH_FASTCALL, interpolate_doc},
    {"show", reinterpret_cast<PyCFunction>(engine_show), METH_FASTCALL, show_doc},
    {nullptr, nullptr, 0, nullptr},
};

PyDoc_STRVAR(engine_doc,
             "Engine(method, options, work, functions, schedule=None, hooks=None)\n\n"
             "The step of one run, on its arrays. `functions` says in `native` whether it holds addresses.");

PyTypeObject engine_type = {.ob_base = PyVarObject_HEAD_INIT(nullptr, 0)};

PyModuleDef module = {
    .m_base = PyModuleDef_HEAD_INIT,
    .m_name = EIP_NAME,
    .m_doc = "The step in C++.",
    .m_size = -1,
};

// Functions by subject, as a module in this one.
int add_functions(PyObject *module, const char *subject, PyMethodDef *functions) {
    PyObject *found = PyModule_New(subject);
    const int status = found ? PyModule_AddFunctions(found, functions) : -1;
    const int added = status < 0 ? -1 : PyModule_AddObjectRef(module, subject, found);
    Py_XDECREF(found);
    return added;
}

}  // namespace
}  // namespace eip

PyMODINIT_FUNC EIP_INIT() {
    import_array();
    PyTypeObject &type = eip::engine_type;
    type.tp_name = "eip_scipy.engine.Engine";
    type.tp_basicsize = sizeof(eip::Engine);
    type.tp_dealloc = reinterpret_cast<destructor>(eip::engine_dealloc);
    type.tp_flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC;
    type.tp_doc = eip::engine_doc;
    type.tp_traverse = reinterpret_cast<traverseproc>(eip::engine_traverse);
    type.tp_clear = reinterpret_cast<inquiry>(eip::engine_clear);
    type.tp_methods = eip::engine_methods;
    type.tp_new = eip::engine_new;
    if (PyType_Ready(&type) < 0) return nullptr;
    PyObject *module = PyModule_Create(&eip::module);
    if (!module) return nullptr;
    eip::failed_call_error = PyErr_NewExceptionWithDoc("eip_scipy.engine.FailedCallError",
                                                       "A function by pointer failed.", nullptr, nullptr);
    if (!eip::failed_call_error || !eip::add_library(module) ||
        PyModule_AddObjectRef(module, "FailedCallError", eip::failed_call_error) < 0 ||
        PyModule_AddObjectRef(module, "Engine", reinterpret_cast<PyObject *>(&type)) < 0 ||
        eip::add_functions(module, "condensates", eip::condensate_functions) < 0 ||
        eip::add_functions(module, "fields", eip::field_functions) < 0 ||
        eip::add_functions(module, "comparators", eip::comparator_functions) < 0 ||
        eip::add_functions(module, "gradients", eip::gradient_functions) < 0 ||
        PyModule_AddStringConstant(module, "SOURCES", EIP_SOURCES) < 0 ||
        PyModule_AddStringConstant(module, "COMPILER", EIP_COMPILER) < 0 ||
        PyModule_AddIntConstant(module, "HAS_V3", eip::has_v3()) < 0) {
        Py_DECREF(module);
        return nullptr;
    }
    return module;
}
