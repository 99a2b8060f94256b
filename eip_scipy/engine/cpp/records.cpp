#include "records.hpp"

#include "library_functions.hpp"

namespace eip {

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
    for (const auto &[name, place] :
         std::initializer_list<std::pair<const char *, double **>>{{"err", &w.err},
                                                                   {"err_low", &w.err_low},
                                                                   {"err_sum", &w.err_sum},
                                                                   {"sigma", &w.sigma},
                                                                   {"move", &w.move},
                                                                   {"carry", &w.carry},
                                                                   {"carry_hat", &w.carry_hat}})
        *place = arrays.floats(work, name, {m});
    for (const auto &[name, place] :
         std::initializer_list<std::pair<const char *, double **>>{{"inverse_norms", &w.inverse_norms},
                                                                   {"mu", &w.mu},
                                                                   {"values", &w.values},
                                                                   {"g", &w.g},
                                                                   {"band", &w.band},
                                                                   {"before", &w.before},
                                                                   {"worth", &w.worth},
                                                                   {"defect", &w.defect},
                                                                   {"max_defect", &w.max_defect}})
        *place = arrays.floats(work, name, {l});
    w.scale = arrays.floats(work, "scale", {blocks});
    w.ratio = arrays.floats(work, "ratio", {blocks});
    w.memory = arrays.floats(work, "memory", {blocks});
    w.memory_new = arrays.floats(work, "memory_new", {blocks});
    w.B = arrays.floats(work, "B", {l, m});
    w.Q = arrays.floats(work, "Q", {l, m});
    w.R = arrays.floats(work, "R", {l, l});
    w.max_correction = arrays.floats(work, "max_correction", {1});
    w.norm = arrays.floats(work, "norm", {1});
    w.trust = arrays.floats(work, "trust", {l, N_FIGURES});
    w.suspect = arrays.floats(work, "suspect", {w.suspect_size()});
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
static void check_places(const uint64_t *start, int64_t count, const uint64_t *place, int64_t size, int64_t bound,
                         const char *name) {
    bool good = true;
    for (int64_t k = 0; k + 1 < count; ++k) good &= start[k] <= start[k + 1];
    good &= count == 0 || start[count - 1] <= static_cast<uint64_t>(size);
    for (int64_t p = 0; p < size; ++p) good &= place[p] < static_cast<uint64_t>(bound);
    if (good) return;
    PyErr_Format(PyExc_ValueError, "engine: %s names places outside the state", name);
    throw PythonError{};
}

Multistep multistep_of(PyObject *record, const Work &w, Arrays &arrays) {
    Multistep ms{};
    ms.order = Arrays::length(record, "predict_q");
    ms.middle = integer(record, "middle");
    ms.half = w.m / 2;
    ms.pitch = Arrays::length(record, "nodes", 1);
    ms.rows = Arrays::length(record, "nodes");
    ms.predict_q = arrays.floats(record, "predict_q", {ms.order});
    ms.predict_v = arrays.floats(record, "predict_v", {ms.order});
    ms.states_q = arrays.floats(record, "states_q", {ms.order, ms.order});
    ms.states_v = arrays.floats(record, "states_v", {ms.order, ms.order});
    for (const auto &[name, place] : std::initializer_list<std::pair<const char *, const double **>>{
             {"correction", &ms.correction}, {"shape_q", &ms.shape_q}, {"shape_v", &ms.shape_v}, {"size", &ms.size}})
        *place = arrays.floats(record, name, {ms.order + 1});
    ms.error_constant = number(record, "error_constant");
    ms.growth = number(record, "growth");
    ms.brief = truth(record, "brief");
    ms.level = truth(record, "level");
    ms.uses_v = truth(record, "uses_v");
    ms.t0 = number(record, "t0");
    ms.h = number(record, "h");
    ms.substeps = integer(record, "substeps");
    ms.spacing = integer(record, "spacing");
    ms.first = integer(record, "corrected_first");
    ms.count = integer(record, "corrected_count");
    ms.nodes = arrays.floats(record, "nodes", {ms.rows, ms.pitch});
    ms.sums = arrays.floats(record, "sums", {4, ms.pitch});
    ms.predicted = arrays.floats(record, "predicted", {3, ms.pitch});
    ms.change = arrays.floats(record, "change", {ms.half});
    ms.levels = arrays.floats(record, "levels", {3, w.l});
    ms.place = arrays.integers<int64_t>(record, "place", {N_NODE_PLACES});
    check_history(ms);
    const bool fits = ms.first >= 0 && ms.count >= 0 && ms.first <= ms.half && ms.count <= ms.half - ms.first;
    const bool sizes =
        fits && ms.order >= 4 && ms.pitch % 4 == 0 && ms.rows > 2 * ms.order && ms.pitch >= ms.half && ms.middle >= 0;
    if (w.m % 2 || !sizes || ms.middle >= ms.order || ms.substeps < 1 || ms.spacing < 1 || ms.h == 0.0) {
        PyErr_SetString(PyExc_ValueError, "engine: the record of the multistep method does not fit the run");
        throw PythonError{};
    }
    return ms;
}

void check_history(const Multistep &ms) {
    const int64_t at = ms.place[NEWEST_ROW];
    if (!ms.place[HAVE_NODES] || (at >= ms.order - 1 && at < ms.rows)) return;
    PyErr_SetString(PyExc_ValueError, "engine: the newest node is in none of the history's rows");
    throw PythonError{};
}

static Blocks blocks_of(PyObject *groups, int64_t m, Arrays &arrays) {
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

static Frame frame_of(PyObject *rows, int64_t m, Arrays &arrays) {
    Frame frame{};
    frame.rows = Arrays::length(rows, "products");
    const int64_t values = Arrays::length(rows, "value");
    frame.start = arrays.integers<uint64_t>(rows, "start", {2, frame.rows + 1});
    frame.place = arrays.integers<uint64_t>(rows, "place", {values});
    frame.value = arrays.floats(rows, "value", {values});
    frame.groups = Arrays::length(rows, "bodies", 1);
    frame.count = Arrays::length(rows, "bodies", 2);
    frame.bodies = arrays.floats(rows, "bodies", {2, frame.groups, frame.count});
    check_places(frame.start, 2 * (frame.rows + 1), frame.place, values, m, "frame");
    if (frame.groups > 0 && (frame.count < 1 || 3 * frame.groups * frame.count != m)) {
        PyErr_SetString(PyExc_ValueError, "engine: the frame's bodies do not fit the state");
        throw PythonError{};
    }
    return frame;
}

Options options_of(PyObject *options, Work &w, Arrays &arrays) {
    Options o{};
    o.rtol = arrays.floats(options, "rtol", {w.m});
    o.atol = arrays.floats(options, "atol", {w.n});
    o.blocks = blocks_of(attribute(options, "groups").get(), w.m, arrays);
    o.kinds = blocks_of(attribute(options, "kinds").get(), w.m, arrays);
    o.block_atol = arrays.floats(options, "block_atol", {o.blocks.count});
    o.frame = frame_of(attribute(options, "frame").get(), w.m, arrays);
    w.target = arrays.floats(options, "target", {w.l});
    w.products = arrays.floats(attribute(options, "frame").get(), "products", {o.frame.rows});
    o.scales = arrays.floats(options, "scales", {w.l});
    o.computed = arrays.floats(options, "computed", {w.l});
    o.most_left = arrays.floats(options, "most_left", {w.l});
    o.has_limits = std::any_of(o.most_left, o.most_left + w.l, [](double share) { return share < INFINITE; });
    read_each(o, [options](const char *name, auto &value) {
        using Value = std::decay_t<decltype(value)>;
        if constexpr (std::is_same_v<Value, bool>)
            value = truth(options, name);
        else if constexpr (std::is_same_v<Value, double>)
            value = number(options, name);
        else
            value = integer(options, name);
    });
    if (o.every < 0) {
        PyErr_SetString(PyExc_ValueError, "engine: every must not be negative");
        throw PythonError{};
    }
    return o;
}

static Span span_of(PyObject *span) {
    return {number(span, "t0"),   number(span, "h"),        number(span, "t_bound"),
            number(span, "sign"), integer(span, "n_steps"), number(span, "max_step")};
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
    s.rate = arrays.floats(schedule, "rate", {s.n_events});
    s.rate_new = arrays.floats(schedule, "rate_new", {s.n_events});
    s.g_direction = arrays.floats(schedule, "g_direction", {s.n_events});
    return s;
}

// Rows of weights over the stages, of the lengths that the kind of interpolant has.
static void read_interpolant(PyObject *dense, int64_t stages, Arrays &arrays, Dense &d) {
    d.kind = integer(dense, "kind");
    d.polynomials = Arrays::length(dense, "weights");
    d.columns = Arrays::length(dense, "weights", 1);
    const bool history = d.multistep && !d.multistep->brief;
    if (history && (d.columns != d.multistep->order || d.polynomials != d.columns * d.columns)) d.kind = -1;
    d.further = Arrays::length(dense, "c");
    d.weights = arrays.floats(dense, "weights", {d.polynomials, d.columns});
    d.A = arrays.floats(dense, "A", {d.further, ANY});
    d.c = arrays.floats(dense, "c", {d.further});
    const bool known = history ? d.kind == HISTORY : d.kind >= CUBIC && d.kind <= NYSTROM && d.kind != HISTORY;
    const bool staged = d.kind == SEVENTH || d.kind == NYSTROM;
    bool fits = !staged || (d.columns == stages + 1 + d.further && d.columns <= d.work.stages + 1);
    if (d.kind == POLYNOMIAL) fits = d.columns == stages + 1;
    if (d.kind == NYSTROM) fits &= d.polynomials >= 1 && d.polynomials <= MOST_NODES;
    if (!known || !fits || (d.further > 0 && Arrays::length(dense, "A", 1) != d.columns)) {
        PyErr_SetString(PyExc_ValueError, "engine: the interpolant does not fit the method");
        throw PythonError{};
    }
}

static Dense dense_of(PyObject *dense, const Data &run, Arrays &arrays, int type) {
    Dense d{};
    const Ref work = attribute(dense, "work"), options = attribute(dense, "options");
    d.work = work_of(work.get(), Arrays::length(work.get(), "K") - 1, run.options.blocks.count, arrays, type);
    d.own_slopes = truth(dense, "own_slopes");
    if (d.work.n != run.work.n || d.work.l != run.work.l || (d.own_slopes && d.work.stages < 1)) {
        PyErr_SetString(PyExc_ValueError, "engine: the buffers for dense output do not fit the run");
        throw PythonError{};
    }
    d.options = options_of(options.get(), d.work, arrays);
    d.by_travel = truth(dense, "by_travel");
    d.shows = truth(dense, "shows");
    d.missed = arrays.floats(dense, "missed", {2});
    d.waiting = arrays.integers<int64_t>(dense, "waiting", {2});
    d.multistep = run.method.multistep;
    read_interpolant(dense, run.work.stages, arrays, d);
    const bool halves = d.kind == QUINTIC || d.kind == HISTORY || d.kind == NYSTROM;
    if (halves && (d.work.m % 2 || d.work.stages < 1)) {
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
    roots.pending_event = arrays.integers<int64_t>(dense, "pending_event", {MOST_CROSSINGS * events});
    roots.pending_t = arrays.floats(dense, "pending_t", {MOST_CROSSINGS * events});
    samples.piece = arrays.floats(dense, "piece", {d.floats()});
    auto *counts = arrays.integers<int64_t>(dense, "counts", {3});
    roots.count = counts;
    roots.pending_count = counts + 2;
    samples.interpolants.count = counts + 1;
    return samples;
}

Members members_of(PyObject *members, const Data &run, const Schedule &schedule, int64_t rows, Arrays &arrays,
                   int type) {
    Members m{};
    const Work &w = run.work;
    m.count = Arrays::length(members, "starts");
    m.n_rows = rows;
    m.kept = truth(members, "kept");
    m.evaluations = integer(members, "evaluations");
    const auto states = [&](const char *name, std::initializer_list<npy_intp> shape) {
        return static_cast<double *>(arrays.memory_of(members, name, type, shape));
    };
    m.starts = states("starts", {m.count, w.n});
    m.y = states("y", {m.count, w.n});
    m.rows = states("rows", {m.kept ? m.count : 1, rows, w.n});
    m.params = arrays.floats(members, "params", {m.count, run.system.n_params});
    m.first_steps = arrays.floats(members, "first_steps", {m.count});
    m.sigma = arrays.floats(members, "sigma", {w.m});
    m.left = arrays.floats(members, "left", {schedule.n_events});
    m.t = arrays.floats(members, "t", {m.count});
    m.max_defect = arrays.floats(members, "max_defect", {m.count, w.l});
    m.max_correction = arrays.floats(members, "max_correction", {m.count});
    m.figures = arrays.floats(members, "figures", {m.count, w.l, N_FIGURES});
    m.suspects = arrays.floats(members, "suspects", {m.count, w.suspect_size()});
    m.status = arrays.integers<int64_t>(members, "status", {m.count});
    m.counters = arrays.integers<int64_t>(members, "counters", {m.count, N_COUNTERS});
    m.where = arrays.integers<int64_t>(members, "where", {2});
    if (m.where[0] < 0 || m.where[0] > m.count) {
        PyErr_SetString(PyExc_ValueError, "engine: where is outside the members");
        throw PythonError{};
    }
    return m;
}

// A function of the library's for one state or for eight.
static void take(const LibraryFunction &function, LibraryPointer<double> &place) { place = function.one; }
static void take(const LibraryFunction &function, LibraryPointer<Octet> &place) { place = function.eight; }

// An address, or a function of the library's that takes these sizes and fills so many floats.
template <class Function>
static Function pointer_of(PyObject *object, const char *name, int64_t floats, int64_t n, int64_t p) {
    Function out{};
    out.floats = floats;
    if (const LibraryFunction *function = library_function_of(object)) {
        require_sizes(*function, n, p);
        take(*function, out.library);
        if (out.library && function->filled(n) == floats) return out;
        PyErr_Format(PyExc_ValueError, "engine: %s fills %lld floats where %lld are expected", function->name,
                     static_cast<long long>(out.library ? function->filled(n) : 0), static_cast<long long>(floats));
        throw PythonError{};
    }
    const auto address = static_cast<uintptr_t>(PyLong_AsUnsignedLongLong(object));
    if (PyErr_Occurred()) throw PythonError{};
    if (!address || floats < 0) {
        PyErr_Format(PyExc_ValueError, "engine: a function of %s is missing", name);
        throw PythonError{};
    }
    out.pointer = reinterpret_cast<decltype(out.pointer)>(address);
    return out;
}

// Functions by pointer: (function, floats) of each of inv, grad and event; None where one `may_lack` it.
template <class Function>
static std::vector<Function> pointers_of(PyObject *functions, const char *name, int64_t expected, int64_t n, int64_t p,
                                         bool may_lack = false) {
    std::vector<Function> out;
    const Ref items(PySequence_Fast(attribute(functions, name).get(), "engine: expected a sequence of pairs"));
    int64_t total = 0;
    for (Py_ssize_t k = 0; k < PySequence_Fast_GET_SIZE(items.get()); ++k) {
        PyObject *function;
        long long floats;
        PyObject *pair = PySequence_Fast_GET_ITEM(items.get(), k);
        if (!PyTuple_Check(pair)) PyErr_Format(PyExc_TypeError, "engine: %s must hold pairs, got %.80R", name, pair);
        if (PyErr_Occurred() || !PyArg_ParseTuple(pair, "OL", &function, &floats)) throw PythonError{};
        if (may_lack && function == Py_None)
            out.push_back({{}, {}, floats});
        else
            out.push_back(pointer_of<Function>(function, name, floats, n, p));
        total += floats;
    }
    if (total != expected) {
        PyErr_Format(PyExc_ValueError, "engine: the values of %s are %lld floats, expected %lld", name,
                     static_cast<long long>(total), static_cast<long long>(expected));
        throw PythonError{};
    }
    return out;
}

// For gradients without a function: by differences of an invariant that has one.
static void read_shifts(PyObject *functions, const Work &w, Arrays &arrays, System &system) {
    bool wanted = false, good = system.grad_pointers.size() == system.inv_pointers.size();
    for (size_t k = 0; good && k < system.grad_pointers.size(); ++k) {
        const auto &grad = system.grad_pointers[k];
        const auto &inv = system.inv_pointers[k];
        if (grad.pointer || grad.library) continue;
        wanted = true;
        good = inv.pointer && inv.floats * w.m == grad.floats;
    }
    if (!good) {
        PyErr_SetString(PyExc_ValueError, "engine: the gradients do not fit the invariants");
        throw PythonError{};
    }
    if (!wanted) return;
    system.shifts.m = w.m;
    system.shifts.width = w.m / w.n;
    system.shifts.floors = arrays.floats(functions, "floors", {w.n});
    system.shifts.state.resize(w.m);
}

void read_pointers(PyObject *functions, const Work &w, int64_t events, Arrays &arrays, System &system) {
    system.by_pointer = true;
    system.second_order = truth(functions, "second_order");
    system.n_params = Arrays::length(functions, "params");
    system.params = arrays.floats(functions, "params", {system.n_params});
    const int64_t size = system.second_order ? w.m / 2 : w.m, p = system.n_params;
    system.rhs_pointer = pointer_of<Native<ValuePointer>>(attribute(functions, "rhs").get(), "rhs", size, size, p);
    system.inv_pointers = pointers_of<Native<ValuePointer>>(functions, "inv", w.l, w.m, p);
    system.grad_pointers = pointers_of<Native<GradientPointer>>(functions, "grad", w.l * w.m, w.m, p, true);
    read_shifts(functions, w, arrays, system);
    system.event_pointers = pointers_of<Native<ValuePointer>>(functions, "event", events, w.m, p);
    const Ref jacobian = attribute(functions, "jacobian");
    if (jacobian.get() != Py_None)
        system.jacobian_pointer = pointer_of<Native<GradientPointer>>(jacobian.get(), "jacobian", w.m / 2, w.m / 2, p);
    system.scratch.resize(w.m);
    system.scratch_f.resize(w.m);
}

OctetSystem octet_system_of(PyObject *functions, const Data &run) {
    OctetSystem system;
    const Work &w = run.work;
    const int64_t size = run.system.second_order ? w.n / 2 : w.n, p = run.system.n_params;
    using Values = Native<ValuePointer, Octet>;
    system.rhs_pointer = pointer_of<Values>(attribute(functions, "rhs").get(), "rhs", size, size, p);
    system.inv_pointers = pointers_of<Values>(functions, "inv", w.l, w.n, p);
    system.grad_pointers = pointers_of<Native<GradientPointer, Octet>>(functions, "grad", w.l * w.n, w.n, p);
    system.second_order = run.system.second_order;
    system.params.resize(p);
    system.scratch.resize(w.n);
    system.scratch_f.resize(w.n);
    const Options &o = run.options;
    const Ref jacobian = attribute(functions, "jacobian");
    if (jacobian.get() != Py_None)
        system.jacobian_pointer =
            pointer_of<Native<GradientPointer, Octet>>(jacobian.get(), "jacobian", w.n / 2, w.n / 2, p);
    const Multistep *ms = run.method.multistep;
    const bool steps =
        ms ? !ms->brief && !ms->level && (ms->count == 0 || jacobian.get() != Py_None) : !o.compensated && o.every >= 1;
    if (run.system.python || w.n != w.m || o.adaptive || o.iterations != 1 || o.direction != NEW || !steps) {
        PyErr_SetString(PyExc_ValueError, "engine: a run of this kind does not go side by side with others");
        throw PythonError{};
    }
    return system;
}

}  // namespace eip
