#include "records.hpp"

#include <nanobind/stl/pair.h>

#include <cstring>
#include <memory>
#include <string>
#include <tuple>
#include <utility>

#include "frame.hpp"
#include "library.hpp"

namespace eip {

void *memory_of(nb::handle object, const char *name, int type, std::span<const npy_intp> shape, bool read) {
    auto *array = reinterpret_cast<PyArrayObject *>(object.ptr());
    const bool plain = is_plain(object.ptr(), type, static_cast<int>(shape.size()));
    if (plain && std::equal(shape.begin(), shape.end(), PyArray_DIMS(array)) && (read || PyArray_ISWRITEABLE(array)))
        return PyArray_DATA(array);
    nb::list lengths;
    for (const npy_intp length : shape) length < 0 ? lengths.append("any") : lengths.append(length);
    const auto dtype = owned(reinterpret_cast<PyObject *>(PyArray_DescrFromType(type)));
    const nb::tuple wanted(lengths);
    if (!PyArray_Check(object.ptr()))
        refuse(PyExc_TypeError, "engine: %s is %.80R; expected an array, %S of shape %S", name, object.ptr(),
               dtype.ptr(), wanted.ptr());
    const nb::object has = object.attr("dtype"), came = object.attr("shape");
    refuse(PyExc_ValueError, "engine: %s is %S of shape %S; expected %saligned, C-contiguous %S of shape %S", name,
           has.ptr(), came.ptr(), read ? "" : "writable, ", dtype.ptr(), wanted.ptr());
}

void require_floats(const char *name, int64_t total, int64_t expected) {
    if (total != expected)
        refuse(PyExc_ValueError, "engine: the values of %s are %lld floats, expected %lld", name,
               static_cast<long long>(total), static_cast<long long>(expected));
}

double number(const nb::object &object) {
    const double value = PyFloat_AsDouble(object.ptr());
    if (value == -1.0 && PyErr_Occurred()) throw nb::python_error();
    return value;
}

static int64_t integer(const nb::object &object) {
    const long long value = PyLong_AsLongLong(object.ptr());
    if (value == -1 && PyErr_Occurred()) throw nb::python_error();
    return value;
}

bool truth(const nb::object &object) {
    const int value = PyObject_IsTrue(object.ptr());
    if (value < 0) throw nb::python_error();
    return value;
}

namespace {

// Reads the fields of a record, which is a tuple of them in this order, or has attributes of these names.
class Reader {
  public:
    Reader(nb::handle record, int type, const Sizes &sizes, nb::list &kept)
        : sizes(sizes),
          record_(record),
          type_(type),
          kept_(kept) {}

    void operator()(const char *name, double &value) { value = number(next(name)); }
    void operator()(const char *name, int64_t &value) { value = integer(next(name)); }
    void operator()(const char *name, bool &value) { value = truth(next(name)); }

    template <class T, class... Axes>
        requires(sizeof...(Axes) > 0)
    void operator()(const char *name, T *&place, Axes... axes) {
        place = memory<std::remove_const_t<T>>(next(name), name, TYPE<T>, axes...);
    }
    template <class... Axes>
    void states(const char *name, double *&place, Axes... axes) {
        place = memory<double>(next(name), name, type_, axes...);
    }
    template <class Record>
        requires(sizeof(Record::RECORD) > 0)
    void operator()(const char *name, Record &place) {
        const nb::object inner = next(name);
        Reader reader(inner, type_, sizes, kept_);
        place.fields(reader);
    }
    void in_python(const char *, const char *, bool) { ++place_; }

    const Sizes sizes;

  private:
    // To look a field up by its name takes most of the time of reading it. A tuple keeps its items; others are kept here.
    nb::object next(const char *name) {
        const Py_ssize_t place = place_++;
        if (PyTuple_Check(record_.ptr()) && place < PyTuple_Size(record_.ptr()))
            return nb::borrow(PyTuple_GetItem(record_.ptr(), place));
        nb::object found = record_.attr(name);
        kept_.append(found);
        return found;
    }

    nb::handle record_;
    Py_ssize_t place_ = 0;
    int type_;
    nb::list &kept_;
};

template <class Record>
void read(Record &place, nb::handle record, int type, const Sizes &sizes, nb::list &kept) {
    kept.append(record);
    Reader reader(record, type, sizes, kept);
    place.fields(reader);
}

// Collects the names of a record's fields, their types for type checkers, and what they are if they are left out.
class Names {
  public:
    void operator()(const char *name, double &) { add(name, "float"); }
    void operator()(const char *name, int64_t &) { add(name, "int"); }
    void operator()(const char *name, bool &) { add(name, "bool"); }

    template <class T, class... Axes>
        requires(sizeof...(Axes) > 0)
    void operator()(const char *name, T *&, Axes...) {
        add(name, TYPE<T> == NPY_DOUBLE  ? "numpy.typing.NDArray[numpy.float64]"
                  : TYPE<T> == NPY_INT64 ? "numpy.typing.NDArray[numpy.int64]"
                                         : "numpy.typing.NDArray[numpy.uint64]");
    }
    template <class... Axes>
    void states(const char *name, double *&, Axes...) {
        add(name, "numpy.typing.NDArray[typing.Any]");
    }
    template <class Record>
        requires(sizeof(Record::RECORD) > 0)
    void operator()(const char *name, Record &) {
        add(name, Record::RECORD);
    }
    void in_python(const char *name, const char *type, bool may_be_missing) {
        add(name, type);
        if (may_be_missing) defaults.append(nb::none());
    }

    const Sizes sizes;
    nb::list names, defaults;
    nb::dict types;

  private:
    void add(const char *name, const char *type) {
        names.append(name);
        types[name] = type;
    }
};

template <class Record>
void add_record(nb::module_ &module) {
    Record record{};
    Names names;
    record.fields(names);
    nb::object type = nb::module_::import_("collections")
                          .attr("namedtuple")(Record::RECORD, names.names, "defaults"_a = names.defaults,
                                              "module"_a = "eip_scipy.engine.data");
    type.attr("__annotations__") = names.types;
    type.attr("__doc__") = "Record that the engine reads; lists in engine/cpp (EIP_RECORD) name its fields.";
    module.attr(Record::RECORD) = type;
}

}  // namespace

Method method_of(nb::handle method, bool has_tableau, nb::list &kept) {
    Method m{};
    if (!has_tableau) {
        Reader reader(method, NPY_DOUBLE, {}, kept);
        reader("b", m.b, Bound{m.stages});
        reader("c", m.c, m.stages);
        return reader("exponent", m.exponent), m;
    }
    read(m, method, NPY_DOUBLE, {}, kept);
    require(m.columns >= m.stages - 1, "engine: A has too few columns");
    require(m.n_e <= m.stages + 1 && m.n_e_v <= m.stages + 1 && (!m.paired || m.n_e_low >= m.n_e),
            "engine: e or e_v has more weights than the stages plus one, or e_low has fewer weights than e");
    return m;
}

// Places that a list of indices names: all below `bound`, their starts in order.
static void check_places(const uint64_t *start, int64_t count, const uint64_t *place, int64_t size, int64_t bound,
                         const char *name) {
    bool good = true;
    for (int64_t k = 0; k + 1 < count; ++k) good &= start[k] <= start[k + 1];
    good &= count == 0 || start[count - 1] <= static_cast<uint64_t>(size);
    for (int64_t p = 0; p < size; ++p) good &= place[p] < static_cast<uint64_t>(bound);
    if (!good) refuse(PyExc_ValueError, "engine: %s contains indices outside the state, or starts that decrease", name);
}

Multistep multistep_of(nb::handle record, const Work &w, nb::list &kept) {
    Multistep ms{};
    read(ms, record, NPY_DOUBLE, {.m = w.m, .l = w.l}, kept);
    check_history(ms);
    const bool fits = ms.corrected_first >= 0 && ms.corrected_count >= 0 && ms.corrected_first <= ms.half &&
                      ms.corrected_count <= ms.half - ms.corrected_first;
    const bool sizes =
        fits && ms.order >= 4 && ms.pitch % 4 == 0 && ms.rows > 2 * ms.order && ms.pitch >= ms.half && ms.middle >= 0;
    require(ms.balances == w.balances && (ms.balances == 0 || !ms.brief),
            "engine: the multistep record has another number of balances than work, or is brief and has balances");
    require(w.m % 2 == 0 && sizes && ms.middle < ms.order && ms.substeps >= 1 && ms.spacing >= 1 && ms.h != 0.0,
            "engine: the record of the multistep method does not fit the run");
    return ms;
}

void check_history(const Multistep &ms) {
    const int64_t at = ms.place[NEWEST_ROW];
    require(!ms.place[HAVE_NODES] || (at >= ms.order - 1 && at < ms.rows),
            "engine: the row of the newest node must be at least order - 1 and less than the number of rows");
}

static void check_blocks(const Blocks &b, int64_t m) {
    check_places(b.start, b.starts, b.member, b.members, m, "blocks");
    const bool consecutive = b.size == 0 || b.size * b.count == m;
    require(b.starts >= 1 && (b.width == 1 || b.width == 2) && consecutive, "engine: blocks do not fit the state");
}

static void check_balances(const Balances &b, const Work &w) {
    bool good = b.count == w.balances;
    for (int64_t k = 0; k < b.count; ++k) good &= b.place[k] >= 0 && b.place[k] < w.l;
    require(good, "engine: the balances do not fit the run");
}

// True if the numbers ascend from 0 to `last`.
static bool ascend(const int64_t *first, int64_t count, int64_t last) {
    bool good = first[0] == 0 && first[count] == last;
    for (int64_t k = 0; k < count; ++k) good &= first[k] <= first[k + 1];
    return good;
}

static void check_groups(const Groups &g, const Work &w) {
    bool good = g.count >= 0 && g.directions >= 0 && ascend(g.first_value, g.count, g.values) &&
                ascend(g.first_direction, g.count, g.directions) && ascend(g.first_float, g.directions, g.floats) &&
                (g.count == 0 || g.values == w.l) && (g.size == 1 || g.size == 3);
    for (int64_t k = 0; k < g.values; ++k) good &= g.value[k] >= 0 && g.value[k] < w.l;
    for (int64_t k = 0; k < g.floats; ++k) good &= g.place[k] >= 0 && g.place[k] <= w.m - g.size;
    for (int64_t k = 0; good && k < g.count; ++k)
        good &= g.size * (g.first_direction[k + 1] - g.first_direction[k]) <= w.m;
    require(good, "engine: the groups of balances do not fit the run");
}

static void check_columns(const Columns &c, const Work &w) {
    const bool halves = c.half == 0 || (2 * c.half == c.size && c.seen == c.size);
    const bool fits = c.count == 0 || (c.seen > 0 && c.seen <= c.size && c.size * (1 + c.count) == w.m && halves);
    require(fits && (!c.symplectic || (c.count == c.size && c.size % 2 == 0)),
            "engine: the columns of derivatives do not fit the state");
}

Options options_of(nb::handle options, Work &w, int64_t blocks, nb::list &kept) {
    Options o{};
    read(o, options, NPY_DOUBLE, {.n = w.n, .m = w.m, .l = w.l, .blocks = blocks}, kept);
    check_blocks(o.blocks, w.m);
    check_blocks(o.kinds, w.m);
    require(o.blocks.count == blocks, "engine: work and options have different numbers of blocks");
    check_places(o.frame.start, 2 * o.frame.starts, o.frame.place, o.frame.values, w.m, "frame");
    require(o.frame.groups == 0 || (o.frame.count >= 1 && 3 * o.frame.groups * o.frame.count == w.m),
            "engine: the frame's bodies do not fit the state");
    require(o.every >= 0, "engine: every must not be negative");
    require(o.pairs == 0 || (2 * o.pairs == w.m && w.n == w.m && o.balances.count == 0 && o.columns.count == 0),
            "engine: gradients from f need a real state (q, v) without balances and columns");
    check_balances(o.balances, w);
    check_groups(o.balance_groups, w);
    check_columns(o.columns, w);
    w.target = o.target;
    w.products = o.frame.products;
    o.has_limits = std::any_of(o.most_left, o.most_left + w.l, [](double share) { return share < ENDLESS; });
    require(o.balance_groups.count == 0 || (o.direction == NEW && !o.has_limits),
            "engine: groups of balances need direction NEW and most_left without finite limits");
    return o;
}

Schedule schedule_of(nb::handle schedule, nb::list &kept) {
    Schedule s{};
    read(s, schedule, NPY_DOUBLE, {}, kept);
    return s;
}

// Rows of weights over the stages, of the lengths that the kind of interpolant has.
static void check_interpolant(const Dense &d, int64_t stages) {
    const bool history = d.multistep && !d.multistep->brief;
    const bool ordered = d.columns == (history ? d.multistep->order : 0) && d.polynomials == d.columns * d.columns;
    const bool known =
        history ? d.kind == HISTORY && ordered : d.kind >= CUBIC && d.kind <= NYSTROM && d.kind != HISTORY;
    const bool staged = d.kind == SEVENTH || d.kind == NYSTROM;
    bool fits = !staged || (d.columns == stages + 1 + d.further && d.columns <= d.work.stages + 1);
    if (d.kind == POLYNOMIAL) fits = d.columns == stages + 1;
    if (d.kind == NYSTROM) fits &= d.polynomials >= 1 && d.polynomials <= MOST_NODES;
    require(known && fits && (d.further == 0 || d.A_columns == d.columns),
            "engine: the interpolant does not fit the method");
    const bool halves = d.kind == QUINTIC || d.kind == HISTORY || d.kind == NYSTROM;
    require(!halves || (d.work.m % 2 == 0 && d.work.stages >= 1),
            "engine: a state of positions and velocities has an even length");
}

Samples samples_of(nb::handle dense, const Data &run, int64_t events, int type, nb::list &kept) {
    Samples samples{};
    Dense &d = samples.dense;
    const Buffers buffers(dense.attr("work"), kept);
    d.work = buffers.work;
    require(
        buffers.type == type && d.work.n == run.work.n && d.work.l == run.work.l && d.work.stages >= 0 &&
            d.work.balances == run.work.balances,
        "engine: dense.work has another dtype, or other numbers of components, invariants or balances, than the run");
    d.options = options_of(dense.attr("options"), d.work, run.options.blocks.count, kept);
    require(buffers.blocks == run.options.blocks.count, "engine: dense.work has another number of blocks than the run");
    d.multistep = run.method.multistep;
    read(samples, dense, type, {.n = d.work.n, .events = events}, kept);
    require(!d.own_slopes || d.work.stages >= 1, "engine: dense.work needs at least one stage if own_slopes is True");
    check_interpolant(d, run.work.stages);
    return samples;
}

Members members_of(nb::handle members, const Data &run, const Schedule &schedule, int type, nb::list &kept) {
    Members m{};
    const Work &w = run.work;
    read(m, members, type, {.n = w.n, .m = w.m, .l = w.l, .events = schedule.n_events, .params = run.system.n_params},
         kept);
    require(m.where[0] >= 0 && m.where[0] <= m.count, "engine: members.where is outside the members");
    return m;
}

// A function of the library's for one state or for eight.
static void take(const LibraryFunction &function, LibraryCall<double> &place) {
    place = {function.one,
             function.own.empty() ? nullptr : function.own.data(),
             std::ssize(function.own),
             function.apart,
             function.by_pulls,
             function.together,
             function.with_energy};
}
static void take(const LibraryFunction &function, LibraryCall<Lanes8> &place) {
    if (function.own.empty()) place = {function.eight};
}

// The function at an address.
template <class Pointer>
static Pointer pointer_to(nb::handle object, const char *name) {
    const auto address = static_cast<uintptr_t>(PyLong_AsUnsignedLongLong(object.ptr()));
    if (PyErr_Occurred()) throw nb::python_error();
    if (!address) refuse(PyExc_ValueError, "engine: %s contains an address that is 0", name);
    return reinterpret_cast<Pointer>(address);
}

// An address, or a function of the library with these sizes that fills the given number of floats.
template <class Function>
static Function pointer_of(nb::handle object, const char *name, int64_t floats, int64_t n, int64_t p) {
    Function out{};
    out.floats = floats;
    const LibraryFunction *function;
    if (nb::try_cast(object, function)) {
        require_sizes(*function, n, p);
        take(*function, out.library);
        if (out.library && function->filled(n) == floats) return out;
        refuse(PyExc_ValueError, "engine: %s fills %lld floats, expected %lld", function->name,
               static_cast<long long>(out.library ? function->filled(n) : 0), static_cast<long long>(floats));
    }
    out.pointer = pointer_to<decltype(out.pointer)>(object, name);
    if (floats < 0) refuse(PyExc_ValueError, "engine: %s contains a negative number of floats", name);
    return out;
}

// Functions by pointer: (function, floats) of each of inv, grad and event; None where one `may_lack` it.
template <class Function>
static std::vector<Function> pointers_of(nb::handle functions, const char *name, int64_t expected, int64_t n, int64_t p,
                                         bool may_lack = false) {
    std::vector<Function> out;
    int64_t total = 0;
    for (const nb::handle pair : nb::object(functions.attr(name))) {
        if (!nb::isinstance<nb::tuple>(pair) || nb::len(pair) != 2)
            refuse(PyExc_TypeError, "engine: %s must hold pairs, got %.80R", name, pair.ptr());
        const nb::object function = pair[0];
        const auto floats = nb::cast<int64_t>(pair[1]);
        if (may_lack && function.is_none())
            out.push_back({{}, {}, floats});
        else
            out.push_back(pointer_of<Function>(function, name, floats, n, p));
        total += floats;
    }
    require_floats(name, total, expected);
    return out;
}

// For gradients without a function: by differences of an invariant that has one.
static void read_shifts(nb::handle functions, const Work &w, nb::list &kept, System &system) {
    bool wanted = false, good = system.grad_pointers.size() == system.inv_pointers.size();
    for (size_t k = 0; good && k < system.grad_pointers.size(); ++k) {
        const auto &grad = system.grad_pointers[k];
        const auto &inv = system.inv_pointers[k];
        if (grad.pointer || grad.library) continue;
        wanted = true;
        good = inv.pointer && inv.floats * w.m == grad.floats;
    }
    require(good, "engine: the gradients do not fit the invariants");
    if (!wanted) return;
    system.shifts.m = w.m;
    system.shifts.width = w.m / w.n;
    const nb::object floors = functions.attr("floors");
    kept.append(floors);
    system.shifts.floors = memory<double>(floors, "floors", NPY_DOUBLE, w.n);
    system.shifts.state.resize(w.m);
}

void read_balances(nb::handle functions, const Work &w, System &system) {
    const nb::object rates = functions.attr("rates");
    const int64_t items = static_cast<int64_t>(nb::len(nb::object(functions.attr("inv"))));
    int64_t total = 0;
    for (const nb::handle pair : nb::object(rates.attr("items"))) {
        Balance balance;
        std::tie(balance.item, balance.floats) = nb::cast<std::pair<int64_t, int64_t>>(pair);
        require(balance.item >= 0 && balance.item < items && balance.floats >= 0,
                "engine: an item of rates has an index outside the invariants, or a negative number of values");
        system.balances.push_back(balance);
        total += balance.floats;
    }
    size_t given = 0;
    for (const nb::handle function : nb::object(rates.attr("functions"))) {
        require(given < system.balances.size(), "engine: more rates than balances");
        system.balances[given++].is_given = !function.is_none();
    }
    require(total == w.balances && given == system.balances.size(), "engine: the rates do not fit the balances");
    system.times.low = number(rates.attr("low"));
    system.times.high = number(rates.attr("high"));
    system.times.shift = number(rates.attr("shift"));
    system.scratch_G.resize(w.l * w.m);
}

// The functions of the invariants of a state with columns of derivatives behind it, which take the state alone.
static void read_functions_of_state(nb::handle functions, const Work &w, const Columns &columns, System &system) {
    const int64_t n = columns.seen, by = columns.size - n, p = system.n_params;
    require(columns.wide() == w.m && n <= columns.size, "engine: the columns do not fit the state");
    system.columns = &columns;
    system.inv_pointers = pointers_of<Native<ValuePointer>>(functions, "inv", w.l, n, p);
    system.grad_pointers = pointers_of<Native<GradientPointer>>(functions, "grad", w.l * n, n, p);
    system.by_parameters = pointers_of<Native<ValuePointer>>(functions, "by_parameters", w.l * by, n, p);
    const LibraryFunction *rhs;
    system.takes_state = nb::try_cast(nb::object(functions.attr("rhs")), rhs) && rhs->fits(columns.size, p);
    for (auto *own : {&system.state, &system.slope_of_state}) own->resize(n);
    system.scratch_G.resize(w.l * by);
}

void read_pointers(nb::handle functions, const Work &w, const Columns &columns, int64_t events, nb::list &kept,
                   System &system) {
    system.by_pointer = true;
    system.second_order = truth(functions.attr("second_order"));
    const nb::object params = functions.attr("params");
    kept.append(params);
    system.params = memory<double>(params, "params", NPY_DOUBLE, Bound{system.n_params});
    const int64_t size = system.second_order ? w.m / 2 : w.m, p = system.n_params;
    system.rhs_pointer = pointer_of<Native<ValuePointer>>(functions.attr("rhs"), "rhs", size, size, p);
    if (columns.count > 0) {
        read_functions_of_state(functions, w, columns, system);
    } else {
        system.inv_pointers = pointers_of<Native<ValuePointer>>(functions, "inv", w.l, w.m, p);
        system.grad_pointers = pointers_of<Native<GradientPointer>>(functions, "grad", w.l * w.m, w.m, p, true);
        read_shifts(functions, w, kept, system);
    }
    const nb::object rates = nb::object(functions.attr("rates")).attr("functions");
    for (size_t b = 0; b < system.balances.size(); ++b)
        if (Balance &balance = system.balances[b]; balance.is_given)
            balance.rate = pointer_of<Native<GradientPointer>>(rates[b], "rates", balance.floats, w.m, p);
    const int64_t seen = columns.count > 0 ? columns.seen : w.m;
    system.event_pointers = pointers_of<Native<ValuePointer>>(functions, "event", events, seen, p);
    const nb::object jacobian = functions.attr("jacobian");
    if (!jacobian.is_none())
        system.jacobian_pointer = pointer_of<Native<GradientPointer>>(jacobian, "jacobian", w.m / 2, w.m / 2, p);
    const nb::object together = functions.attr("together");
    if (!together.is_none()) {
        require(columns.count == 0 && system.balances.empty() && w.n == w.m,
                "engine: a pass over all functions of a run with columns, balances or complex states");
        system.jitted_together = pointer_to<AllPointer>(together, "together");
    }
    system.f_at_end.resize(w.m);
    system.scratch.resize(w.m);
    system.scratch_f.resize(w.m);
    if (!system.balances.empty()) system.pulls.resize(w.m / 2);
}

BatchFunctions batch_functions_of(nb::handle functions, const Data &run) {
    BatchFunctions system;
    const Work &w = run.work;
    const int64_t size = run.system.second_order ? w.n / 2 : w.n, p = run.system.n_params;
    using Values = Native<ValuePointer, Lanes8>;
    system.rhs_pointer = pointer_of<Values>(functions.attr("rhs"), "rhs", size, size, p);
    system.inv_pointers = pointers_of<Values>(functions, "inv", w.l, w.n, p);
    system.grad_pointers = pointers_of<Native<GradientPointer, Lanes8>>(functions, "grad", w.l * w.n, w.n, p);
    system.second_order = run.system.second_order;
    system.params.resize(p);
    system.scratch.resize(w.n);
    system.scratch_f.resize(w.n);
    const Options &o = run.options;
    const nb::object jacobian = functions.attr("jacobian");
    if (!jacobian.is_none())
        system.jacobian_pointer =
            pointer_of<Native<GradientPointer, Lanes8>>(jacobian, "jacobian", w.n / 2, w.n / 2, p);
    const Multistep *ms = run.method.multistep;
    const bool steps = ms ? !ms->brief && !ms->level && (ms->corrected_count == 0 || !jacobian.is_none())
                          : !o.compensated && o.every >= 1;
    const bool plain = w.n == w.m && o.pairs == 0 && !o.adaptive && o.iterations == 1 && o.direction == NEW;
    require(!run.system.python && plain && steps,
            "engine: members with these options cannot be run in batches of eight");
    return system;
}

Buffers::Buffers(nb::handle record, nb::list &kept) : record(record) {
    kept.append(record);
    const auto length = [&](const char *name, int axes, int axis) {
        const nb::object array = nb::getattr(record, name, nb::none());
        if (!PyArray_Check(array.ptr()) || PyArray_NDIM(nb::borrow<Array>(array).get()) != axes)
            refuse(PyExc_TypeError, "engine: work must be a record Work of arrays, and not %.80R", record.ptr());
        return PyArray_DIM(nb::borrow<Array>(array).get(), axis);
    };
    work.n = length("K", 2, 1);
    type = PyArray_TYPE(array("K").get()) == NPY_CDOUBLE ? NPY_CDOUBLE : NPY_DOUBLE;
    work.m = type == NPY_CDOUBLE ? 2 * work.n : work.n;
    work.l = length("R", 2, 0);
    work.stages = length("K", 2, 0) - 1;
    work.balances = length("level", 1, 0);
    blocks = length("scale", 1, 0);
    require(work.stages >= 0, "engine: work.K has no rows");
    Reader reader(record, type, {.blocks = blocks}, kept);
    work.fields(reader);
}

namespace {

// Makes the arrays of a run's buffers, filled with 0.
struct Maker {
    int type;
    Sizes sizes;
    nb::list arrays;

    template <class T>
    void operator()(const char *, T *&place, auto... lengths) {
        make(TYPE<T>, place, {static_cast<npy_intp>(lengths)...});
    }
    void states(const char *, double *&place, auto... lengths) {
        make(type, place, {static_cast<npy_intp>(lengths)...});
    }

  private:
    template <class T>
    void make(int type, T *&place, Lengths shape) {
        const auto array =
            owned<Array>(PyArray_ZEROS(static_cast<int>(shape.size()), const_cast<npy_intp *>(shape.begin()), type, 0));
        place = reinterpret_cast<T *>(array.floats());
        arrays.append(array);
    }
};

nb::handle work_type;  // the record's class in Python, which the module keeps

nb::object new_work(int64_t n, nb::handle dtype, int64_t stages, int64_t invariants, int64_t blocks, int64_t balances) {
    require(n >= 0 && stages >= 0 && invariants >= 0 && blocks >= 0 && balances >= 0,
            "engine: a negative number of buffers");
    PyArray_Descr *found = nullptr;
    if (!PyArray_DescrConverter(dtype.ptr(), &found)) throw nb::python_error();
    const auto kept = owned(reinterpret_cast<PyObject *>(found));
    Maker maker{found->type_num, {.blocks = blocks}, {}};
    require(maker.type == NPY_DOUBLE || maker.type == NPY_CDOUBLE, "engine: a state is of float64 or complex128");
    Work work{n, maker.type == NPY_CDOUBLE ? 2 * n : n, invariants, stages, balances};
    work.fields(maker);
    fill(work.sigma, 1.0, work.m);
    for (int64_t i = 0; i < work.l; ++i) work.figures(i)[TERMS] = ENDLESS;
    // Does what `Work(*arrays)` does, without its function in Python.
    return nb::handle(reinterpret_cast<PyObject *>(&PyTuple_Type)).attr("__new__")(work_type, maker.arrays);
}

}  // namespace

void add_records(nb::module_ &module) {
    const auto add = [&module]<class... Records>(std::tuple<Records...> *) { (add_record<Records>(module), ...); };
    add(static_cast<std::tuple<Span, Schedule, Multistep, Method, Blocks, Frame, Balances, Groups, Columns, Options,
                               Members, Samples, Work> *>(nullptr));
    work_type = nb::object(module.attr("Work"));
    module.def("new_work", new_work, "n"_a, "dtype"_a, "stages"_a, "n_invariants"_a, "n_blocks"_a, "n_balances"_a = 0,
               nb::sig("def new_work(n: int, dtype: typing.Any, stages: int, n_invariants: int, n_blocks: int, "
                       "n_balances: int = 0) -> Work"),
               "Return the buffers of a run.");
}

}  // namespace eip
