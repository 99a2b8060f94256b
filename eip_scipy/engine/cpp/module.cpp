// The binding: an Engine holds a run's arrays and functions, and steps. What comes from Python is looked at here, once;
// all arrays of a run keep their memory, so that Python reads what the engine writes.
#define EIP_IMPORTS_NUMPY
#include "loop.hpp"
#include "python_functions.hpp"

#if defined(__SSE2__)
#include <xmmintrin.h>
#endif

namespace eip {
namespace {

// Subnormal numbers are numbers here, whatever another library left in the processor's mode.
class FloatingPoint {
  public:
#if defined(__SSE2__)
    FloatingPoint() : mode_(_mm_getcsr()) { _mm_setcsr(mode_ & ~0x8040u); }
    ~FloatingPoint() { _mm_setcsr(mode_); }

  private:
    unsigned mode_;
#endif
};

// Whether the processor takes the other build, for x86-64-v3.
bool has_v3() {
#if defined(__x86_64__)
    __builtin_cpu_init();
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2");
#else
    return false;
#endif
}

// What the steps of a run refer to.
struct Data {
    Method method;
    Options options;
    Work work;
    System system;
};

struct Engine {
    PyObject_HEAD
    PyObject *kept;  // every object that the run uses
    Data *data;
    Schedule *schedule;
    Samples *samples;
    PythonFunctions *functions;
    PythonHooks *hooks;
    int type;
    bool busy, interpolating;
};

Method method_of(PyObject *method, Arrays &arrays) {
    Method m{};
    m.stages = Arrays::length(method, "b");
    m.exponent = number(method, "exponent");
    m.c = arrays.floats(method, "c", {m.stages});
    m.b = arrays.floats(method, "b", {m.stages});
    return m;
}

// Coefficients of a tableau, which a one-step method of a user's own has none of.
void read_tableau(PyObject *method, Arrays &arrays, Method &m) {
    m.columns = Arrays::length(method, "A", 1);
    m.A = arrays.floats(method, "A", {m.stages, m.columns});
    if (m.columns < m.stages - 1) {
        PyErr_SetString(PyExc_ValueError, "engine: A has too few columns");
        throw PythonError{};
    }
    m.b_low = arrays.floats(method, "b_low", {m.stages});
    m.b_v = arrays.floats(method, "b_v", {m.stages});
    m.b_v_low = arrays.floats(method, "b_v_low", {m.stages});
    m.n_e = Arrays::length(method, "e");
    m.n_e_v = Arrays::length(method, "e_v");
    m.e = arrays.floats(method, "e", {m.n_e});
    m.e_v = arrays.floats(method, "e_v", {m.n_e_v});
    m.e_low = arrays.floats(method, "e_low", {ANY});
    m.nystrom = truth(method, "nystrom");
    m.fsal = truth(method, "fsal");
    m.paired = truth(method, "paired");
    if (m.n_e > m.stages + 1 || m.n_e_v > m.stages + 1 || (m.paired && Arrays::length(method, "e_low") < m.n_e)) {
        PyErr_SetString(PyExc_ValueError, "engine: the weights of the error estimate do not fit the stages");
        throw PythonError{};
    }
}

Work work_of(PyObject *work, int64_t stages, int64_t blocks, Arrays &arrays, int type) {
    Work w{};
    const int64_t width = type == NPY_CDOUBLE ? 2 : 1;
    const int64_t n = Arrays::length(work, "y_hat"), l = Arrays::length(work, "values"), m = n * width;
    w.n = n;
    w.m = m;
    w.l = l;
    w.stages = stages;
    const auto state = [&](const char *name, std::initializer_list<npy_intp> shape) {
        return static_cast<double *>(arrays.memory_of(work, name, type, shape));
    };
    w.K = state("K", {stages + 1, n});
    w.stage = state("stage", {n});
    w.y_hat = state("y_hat", {n});
    w.f_point = state("f_point", {n});
    w.G = state("G", {l, n});
    for (const auto &[name, place] : std::initializer_list<std::pair<const char *, double **>>{
             {"err", &w.err}, {"err_low", &w.err_low}, {"err_sum", &w.err_sum}, {"sigma", &w.sigma},
             {"move", &w.move}, {"carry", &w.carry}, {"carry_hat", &w.carry_hat}})
        *place = arrays.floats(work, name, {m});
    for (const auto &[name, place] : std::initializer_list<std::pair<const char *, double **>>{
             {"inverse_norms", &w.inverse_norms}, {"mu", &w.mu}, {"values", &w.values}, {"g", &w.g}, {"band", &w.band},
             {"before", &w.before}, {"worth", &w.worth}, {"defect", &w.defect}, {"max_defect", &w.max_defect}})
        *place = arrays.floats(work, name, {l});
    w.scale = arrays.floats(work, "scale", {blocks});
    w.ratio = arrays.floats(work, "ratio", {blocks});
    w.B = arrays.floats(work, "B", {l, m});
    w.Q = arrays.floats(work, "Q", {l, m});
    w.R = arrays.floats(work, "R", {l, l});
    w.max_correction = arrays.floats(work, "max_correction", {1});
    w.norm = arrays.floats(work, "norm", {1});
    w.trust = arrays.floats(work, "trust", {l, N_FIGURES});
    w.pivots = arrays.integers<int64_t>(work, "pivots", {l});
    w.counters = arrays.integers<int64_t>(work, "counters", {N_COUNTERS});
    const Ref inner = attribute(work, "inner");
    w.inner.matrix = arrays.floats(inner.get(), "matrix", {l, l});
    w.inner.R = arrays.floats(inner.get(), "R", {l, l});
    w.inner.g = arrays.floats(inner.get(), "g", {l});
    w.inner.inverse_norms = arrays.floats(inner.get(), "inverse_norms", {l});
    w.inner.mu = arrays.floats(inner.get(), "mu", {l});
    w.inner.pivots = arrays.integers<int64_t>(inner.get(), "pivots", {l});
    return w;
}

// Places that a list of indices names: all below `bound`, their starts in order.
void check_places(const uint64_t *start, int64_t count, const uint64_t *place, int64_t size, int64_t bound,
                  const char *name) {
    bool good = true;
    for (int64_t k = 0; k + 1 < count; ++k) good &= start[k] <= start[k + 1];
    good &= count == 0 || start[count - 1] <= static_cast<uint64_t>(size);
    for (int64_t p = 0; p < size; ++p) good &= place[p] < static_cast<uint64_t>(bound);
    if (good) return;
    PyErr_Format(PyExc_ValueError, "engine: %s names places outside the state", name);
    throw PythonError{};
}

Blocks blocks_of(PyObject *groups, int64_t m, Arrays &arrays) {
    Blocks blocks{};
    const int64_t members = Arrays::length(groups, "member"), starts = Arrays::length(groups, "start");
    blocks.member = arrays.integers<uint64_t>(groups, "member", {members});
    blocks.start = arrays.integers<uint64_t>(groups, "start", {starts});
    blocks.count = starts - 1;
    blocks.width = integer(groups, "width");
    blocks.size = integer(groups, "size");
    check_places(blocks.start, starts, blocks.member, members, m, "groups");
    const bool consecutive = blocks.size == 0 || blocks.size * blocks.count == m;
    if (starts < 1 || (blocks.width != 1 && blocks.width != 2) || !consecutive) {
        PyErr_SetString(PyExc_ValueError, "engine: groups do not fit the state");
        throw PythonError{};
    }
    return blocks;
}

Frame frame_of(PyObject *rows, int64_t m, Arrays &arrays) {
    Frame frame{};
    frame.rows = Arrays::length(rows, "products");
    const int64_t values = Arrays::length(rows, "value");
    frame.start = arrays.integers<uint64_t>(rows, "start", {2, frame.rows + 1});
    frame.place = arrays.integers<uint64_t>(rows, "place", {values});
    frame.value = arrays.floats(rows, "value", {values});
    frame.products = arrays.floats(rows, "products", {frame.rows});
    frame.groups = Arrays::length(rows, "bodies", 1);
    frame.count = Arrays::length(rows, "bodies", 2);
    frame.bodies = arrays.floats(rows, "bodies", {2, frame.groups, frame.count});
    check_places(frame.start, 2 * (frame.rows + 1), frame.place, values, m, "frame");
    if (frame.groups > 0 && 3 * frame.groups * frame.count != m) {
        PyErr_SetString(PyExc_ValueError, "engine: the frame's bodies do not fit the state");
        throw PythonError{};
    }
    return frame;
}

Options options_of(PyObject *options, const Work &w, Arrays &arrays) {
    Options o{};
    o.rtol = arrays.floats(options, "rtol", {w.m});
    o.atol = arrays.floats(options, "atol", {w.n});
    o.blocks = blocks_of(attribute(options, "groups").get(), w.m, arrays);
    o.block_atol = arrays.floats(options, "block_atol", {o.blocks.count});
    o.frame = frame_of(attribute(options, "frame").get(), w.m, arrays);
    o.target = arrays.floats(options, "target", {w.l});
    o.scales = arrays.floats(options, "scales", {w.l});
    o.kappa = number(options, "kappa");
    o.metric = integer(options, "metric");
    o.direction = integer(options, "direction");
    o.iterations = integer(options, "iterations");
    o.every = integer(options, "every");
    o.reuse_f = truth(options, "reuse_f");
    o.uses_f = truth(options, "uses_f");
    o.compensated = truth(options, "compensated");
    o.adaptive = truth(options, "adaptive");
    o.watched = truth(options, "watched");
    o.per_band = number(options, "per_band");
    o.limit = number(options, "limit");
    if (o.every < 0) {
        PyErr_SetString(PyExc_ValueError, "engine: every must not be negative");
        throw PythonError{};
    }
    return o;
}

Span span_of(PyObject *span) {
    return {number(span, "t0"), number(span, "h"), number(span, "t_bound"), number(span, "sign"),
            integer(span, "n_steps"), number(span, "max_step")};
}

Schedule schedule_of(PyObject *schedule, Arrays &arrays) {
    Schedule s{};
    s.span = span_of(attribute(schedule, "span").get());
    s.save_every = integer(schedule, "save_every");
    s.n_eval = Arrays::length(schedule, "t_eval");
    s.n_events = Arrays::length(schedule, "g");
    s.t_eval = arrays.floats(schedule, "t_eval", {s.n_eval});
    s.place = arrays.integers<int64_t>(schedule, "place", {3});
    s.clock = arrays.floats(schedule, "clock", {4});
    s.g = arrays.floats(schedule, "g", {s.n_events});
    s.g_new = arrays.floats(schedule, "g_new", {s.n_events});
    s.g_direction = arrays.floats(schedule, "g_direction", {s.n_events});
    return s;
}

// Rows of weights over the stages, of the lengths that the kind of interpolant has.
void read_interpolant(PyObject *dense, int64_t stages, Arrays &arrays, Dense &d) {
    d.kind = integer(dense, "kind");
    d.polynomials = Arrays::length(dense, "weights");
    d.columns = Arrays::length(dense, "weights", 1);
    d.further = Arrays::length(dense, "c");
    d.weights = arrays.floats(dense, "weights", {d.polynomials, d.columns});
    d.A = arrays.floats(dense, "A", {d.further, ANY});
    d.c = arrays.floats(dense, "c", {d.further});
    const bool known = d.kind >= CUBIC && d.kind <= SEVENTH;
    const bool fits = d.kind == POLYNOMIAL ? d.columns == stages + 1
                    : d.kind == SEVENTH    ? d.columns == stages + 1 + d.further && d.columns <= d.work.stages + 1
                                           : true;
    if (!known || !fits || (d.further > 0 && Arrays::length(dense, "A", 1) != d.columns)) {
        PyErr_SetString(PyExc_ValueError, "engine: the interpolant does not fit the method");
        throw PythonError{};
    }
}

Dense dense_of(PyObject *dense, const Data &run, Arrays &arrays, int type) {
    Dense d{};
    const Ref work = attribute(dense, "work"), options = attribute(dense, "options");
    d.work = work_of(work.get(), Arrays::length(work.get(), "K") - 1, run.options.blocks.count, arrays, type);
    d.own_slopes = truth(dense, "own_slopes");
    if (d.work.n != run.work.n || d.work.l != run.work.l || (d.own_slopes && d.work.stages < 1)) {
        PyErr_SetString(PyExc_ValueError, "engine: the buffers for dense output do not fit the run");
        throw PythonError{};
    }
    d.options = options_of(options.get(), d.work, arrays);
    d.target = arrays.floats(options.get(), "target", {d.work.l});
    d.by_travel = truth(dense, "by_travel");
    d.missed = arrays.floats(dense, "missed", {2});
    read_interpolant(dense, run.work.stages, arrays, d);
    if (d.kind == QUINTIC && d.work.m % 2) {
        PyErr_SetString(PyExc_ValueError, "engine: a state of positions and velocities has an even length");
        throw PythonError{};
    }
    return d;
}

Samples samples_of(PyObject *dense, const Data &run, int64_t events, Arrays &arrays, int type) {
    Samples samples{};
    samples.dense = dense_of(dense, run, arrays, type);
    const Dense &d = samples.dense;
    Roots &roots = samples.roots;
    roots.capacity = Arrays::length(dense, "event");
    roots.event = arrays.integers<int64_t>(dense, "event", {roots.capacity});
    roots.t = arrays.floats(dense, "t", {roots.capacity});
    roots.y = static_cast<double *>(arrays.memory_of(dense, "y", type, {roots.capacity, d.work.n}));
    roots.left = arrays.floats(dense, "left", {events});
    samples.piece = arrays.floats(dense, "piece", {d.floats()});
    auto *counts = arrays.integers<int64_t>(dense, "counts", {2});
    roots.count = counts;
    samples.interpolants.count = counts + 1;
    return samples;
}

// Functions by pointer: the address of `rhs`, and (address, floats) of each of inv, grad and event.
template <typename Pointer>
std::vector<Native<Pointer>> pointers_of(PyObject *functions, const char *name, int64_t expected) {
    std::vector<Native<Pointer>> out;
    const Ref items(PySequence_Fast(attribute(functions, name).get(), "engine: expected a sequence of pairs"));
    int64_t total = 0;
    for (Py_ssize_t k = 0; k < PySequence_Fast_GET_SIZE(items.get()); ++k) {
        unsigned long long address;
        long long floats;
        PyObject *pair = PySequence_Fast_GET_ITEM(items.get(), k);
        if (!PyTuple_Check(pair)) PyErr_Format(PyExc_TypeError, "engine: %s must hold pairs, got %.80R", name, pair);
        if (PyErr_Occurred() || !PyArg_ParseTuple(pair, "KL", &address, &floats)) throw PythonError{};
        if (!address || floats < 0) {
            PyErr_Format(PyExc_ValueError, "engine: function %zd of %s is missing", k, name);
            throw PythonError{};
        }
        out.push_back({reinterpret_cast<Pointer>(static_cast<uintptr_t>(address)), floats});
        total += floats;
    }
    if (total != expected) {
        PyErr_Format(PyExc_ValueError, "engine: the values of %s are %lld floats, expected %lld", name,
                     static_cast<long long>(total), static_cast<long long>(expected));
        throw PythonError{};
    }
    return out;
}

void read_pointers(PyObject *functions, const Work &w, int64_t events, Arrays &arrays, System &system) {
    system.rhs_pointer = reinterpret_cast<ValuePointer>(static_cast<uintptr_t>(integer(functions, "rhs")));
    system.inv_pointers = pointers_of<ValuePointer>(functions, "inv", w.l);
    system.grad_pointers = pointers_of<GradientPointer>(functions, "grad", w.l * w.m);
    system.event_pointers = pointers_of<ValuePointer>(functions, "event", events);
    system.second_order = truth(functions, "second_order");
    system.params = arrays.floats(functions, "params", {ANY});
    system.scratch.resize(w.m);
    system.scratch_f.resize(w.m);
    if (!system.rhs_pointer) {
        PyErr_SetString(PyExc_ValueError, "engine: rhs is missing");
        throw PythonError{};
    }
}

void engine_setup(Engine *self, PyObject *method, PyObject *options, PyObject *work, PyObject *functions,
                  PyObject *schedule, PyObject *hooks) {
    Arrays arrays(self->kept);
    const Ref y_hat = attribute(work, "y_hat");
    const bool is_complex = PyArray_Check(y_hat.get()) &&
                            PyArray_TYPE(reinterpret_cast<PyArrayObject *>(y_hat.get())) == NPY_CDOUBLE;
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
    if (!self->data) PyErr_SetString(PyExc_RuntimeError, "engine: not set up");
    else if (count != expected) PyErr_Format(PyExc_TypeError, "engine: expected the arguments %s", names);
    if (PyErr_Occurred()) throw PythonError{};
}

// FailedCallError(which functions, which of them, t, bytes of y, of f, status): whoever made them says what it means.
PyObject *failed_call_error = nullptr;

void raise_broken(const System &system) {
    if (PyErr_Occurred()) return;
    const FailedCall &call = system.failed;
    const auto bytes = [](const std::vector<double> &a) { return static_cast<Py_ssize_t>(a.size() * sizeof(double)); };
    const Ref arguments(Py_BuildValue("(sLdy#y#i)", call.functions, static_cast<long long>(call.index), call.t,
                                      call.y.data(), bytes(call.y), call.f.data(), bytes(call.f), call.status));
    PyErr_SetObject(failed_call_error, arguments.get());
}

// A step or more by `call`, which takes a RunOf; without the GIL where no function is Python's, and then by code for short
// states where there is any.
template <typename Call>
Code stepped(Engine *self, Call call) {
    const FloatingPoint mode;
    Data &d = *self->data;
    const bool python = d.system.python || self->hooks;
    PyThreadState *released = python ? nullptr : PyEval_SaveThread();
    Code code = OK;
    bool broken = false;
    try {
        if (d.work.n == 4 && d.work.m == 4 && !python) {
            const Sized<4> work(d.work);
            RunOf<Sized<4>> run{d.method, d.options, work, d.system, nullptr};
            code = call(run);
        } else {
            Run run{d.method, d.options, d.work, d.system, self->hooks};
            code = call(run);
        }
    } catch (const Broken &) {
        broken = true;
    } catch (const PythonError &) {
        broken = true;
    }
    if (released) PyEval_RestoreThread(released);
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
void check_room(const Schedule &schedule, const Saved &saved, const Samples *samples) {
    const int64_t row = schedule.place[ROW];
    bool good = row >= 0 && row <= saved.rows && schedule.n_eval < std::max<int64_t>(saved.rows, 1);
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
        saved.y = static_cast<double *>(
            arrays.memory(args[4], "y_saved", self->type, {saved.rows, self->data->work.n}));
        Samples *samples = self->samples;
        if (samples) {
            Pieces &pieces = samples->interpolants;
            pieces.first = static_cast<double *>(
                arrays.memory(args[5], "pieces", NPY_DOUBLE, {ANY, samples->dense.floats()}));
            pieces.capacity = PyArray_DIM(reinterpret_cast<PyArrayObject *>(args[5]), 0);
        }
        check_room(schedule, saved, samples);
        if (self->hooks) self->hooks->set_states(args[1], args[2]);
        return PyLong_FromLong(
            stepped(self, [&](auto &run) { return advance(run, samples, schedule, k_end, y, y_new, saved); }));
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
        stepped(self, [&](auto &run) {
            const DenseRun<std::decay_t<decltype(run.work)>> dense(d, run.system);
            describe(dense, run.work, t_old, y_old, t, y, piece);
            count_calls(dense, run.work);
            return OK;
        });
        Py_RETURN_NONE;
    });
}

PyDoc_STRVAR(interpolate_doc,
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
        stepped(self, [&](auto &run) {
            const DenseRun<std::decay_t<decltype(run.work)>> dense(d, run.system);
            for (npy_intp k = 0; k < rows; ++k) interpolate(dense, piece, t[k], out + k * d.work.m);
            count_calls(dense, run.work);
            return OK;
        });
        Py_RETURN_NONE;
    });
}

PyDoc_STRVAR(step_doc,
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
        if (self->hooks) self->hooks->set_states(args[2], y_new.get());
        const Code code = stepped(self, [&](auto &run) { return next_step(run, s.span, s.clock, k, y, end); });
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
        if (self->hooks) self->hooks->set_states(args[1], args[4]);
        return PyLong_FromLong(stepped(self, [&](auto &run) { return project_any(run, step); }));
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
        stepped(self, [&](auto &run) {
            close_step(run, step, status);
            return OK;
        });
        Py_RETURN_NONE;
    });
}

PyDoc_STRVAR(values_doc, "values(t, y, out) -> None\n\nFill out (m, l) with the invariants at states y (m, n).");

PyObject *engine_values(Engine *self, PyObject *const *args, Py_ssize_t count) {
    return guarded([&]() -> PyObject * {
        expect(self, count, 3, "t, y, out");
        const Busy busy(self->busy);
        const Ref kept(PyList_New(0));
        Arrays arrays(kept.get());
        const Work &w = self->data->work;
        const auto *t = static_cast<const double *>(arrays.memory(args[0], "t", NPY_DOUBLE, {ANY}, true));
        const npy_intp rows = PyArray_DIM(reinterpret_cast<PyArrayObject *>(args[0]), 0);
        const auto *y = static_cast<const double *>(arrays.memory(args[1], "y", self->type, {rows, w.n}, true));
        auto *out = static_cast<double *>(arrays.memory(args[2], "out", NPY_DOUBLE, {rows, w.l}));
        stepped(self, [&](auto &run) {
            for (npy_intp k = 0; k < rows; ++k) run.system.inv(run.work, t[k], y + k * w.m, out + k * w.l);
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
        const double *y = state_of(args[0], "y", self, kept.get(), true), *f = state_of(args[1], "f", self, kept.get(), true);
        const double tau = PyFloat_AsDouble(args[2]);
        if (PyErr_Occurred()) return nullptr;
        start_figures(y, f, tau, self->data->options, self->data->work);
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
    {"step", reinterpret_cast<PyCFunction>(engine_step), METH_FASTCALL, step_doc},
    {"project", reinterpret_cast<PyCFunction>(engine_project), METH_FASTCALL, project_doc},
    {"close", reinterpret_cast<PyCFunction>(engine_close), METH_FASTCALL, close_doc},
    {"values", reinterpret_cast<PyCFunction>(engine_values), METH_FASTCALL, values_doc},
    {"start", reinterpret_cast<PyCFunction>(engine_start), METH_FASTCALL, start_doc},
    {"sample", reinterpret_cast<PyCFunction>(engine_sample), METH_FASTCALL, sample_doc},
    {"describe", reinterpret_cast<PyCFunction>(engine_describe), METH_FASTCALL, describe_doc},
    {"interpolate", reinterpret_cast<PyCFunction>(engine_interpolate), METH_FASTCALL, interpolate_doc},
    {nullptr, nullptr, 0, nullptr},
};

PyDoc_STRVAR(engine_doc,
             "Engine(method, options, work, functions, schedule=None, hooks=None)\n\n"
             "The step of one run, on its arrays. `functions` says in `native` whether it holds addresses.");

PyTypeObject engine_type = {.ob_base = PyVarObject_HEAD_INIT(nullptr, 0)};

PyModuleDef module = {
    .m_base = PyModuleDef_HEAD_INIT, .m_name = EIP_NAME, .m_doc = "The step in C++.", .m_size = -1,
};

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
    eip::failed_call_error =
        PyErr_NewExceptionWithDoc("eip_scipy.engine.FailedCallError", "A function by pointer failed.", nullptr, nullptr);
    if (!eip::failed_call_error || PyModule_AddObjectRef(module, "FailedCallError", eip::failed_call_error) < 0 ||
        PyModule_AddObjectRef(module, "Engine", reinterpret_cast<PyObject *>(&type)) < 0 ||
        PyModule_AddStringConstant(module, "SOURCES", EIP_SOURCES) < 0 ||
        PyModule_AddIntConstant(module, "HAS_V3", eip::has_v3()) < 0) {
        Py_DECREF(module);
        return nullptr;
    }
    return module;
}
