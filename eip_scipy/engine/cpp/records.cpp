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

namespace {

[[noreturn]] void refuse_array(nb::handle object, const char *name, int type, Lengths shape) {
    nb::list lengths;
    for (const npy_intp length : shape) lengths.append(length);
    const auto dtype = owned(reinterpret_cast<PyObject *>(PyArray_DescrFromType(type)));
    const nb::tuple wanted(lengths);
    if (!PyArray_Check(object.ptr()))
        refuse(PyExc_TypeError, "engine: %s is %.80R; expected an array, %S of shape %S", name, object.ptr(),
               dtype.ptr(), wanted.ptr());
    const nb::object has = object.attr("dtype"), came = object.attr("shape");
    refuse(PyExc_ValueError, "engine: %s is %S of shape %S; expected writable, aligned, C-contiguous %S of shape %S",
           name, has.ptr(), came.ptr(), dtype.ptr(), wanted.ptr());
}

}  // namespace

void *memory(nb::handle object, const char *name, int type, Lengths shape, nb::list &kept) {
    auto *array = reinterpret_cast<PyArrayObject *>(object.ptr());
    if (!is_plain(object.ptr(), type, shape) || !PyArray_ISWRITEABLE(array)) refuse_array(object, name, type, shape);
    kept.append(object);
    return PyArray_DATA(array);
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
        place = static_cast<T *>(array(name, TYPE<T>, axes...));
    }

    template <class... Axes>
    void states(const char *name, double *&place, Axes... axes) {
        place = static_cast<double *>(array(name, type_, axes...));
    }

    template <class Record>
    void record(const char *name, const char *, Record &place) {
        const nb::object inner = next(name);
        Reader reader(inner, type_, sizes, kept_);
        fields(place, reader);
    }

    void in_python(const char *, const char *, bool) { ++place_; }

    const Sizes sizes;

  private:
    // To look a field up by its name takes most of the time of reading it.
    nb::object next(const char *name) {
        const Py_ssize_t place = place_++;
        if (!PyTuple_Check(record_.ptr()) || place >= PyTuple_Size(record_.ptr())) return record_.attr(name);
        return nb::borrow(PyTuple_GetItem(record_.ptr(), place));
    }

    template <class... Axes>
    void *array(const char *name, int type, Axes... axes) {
        const nb::object object = next(name);
        int axis = 0;
        const auto length = [&](auto given) -> npy_intp {
            if constexpr (std::is_same_v<decltype(given), Bound>)
                return given.length = is_plain(object.ptr(), type, sizeof...(Axes))
                                          ? PyArray_DIM(reinterpret_cast<PyArrayObject *>(object.ptr()), axis++)
                                          : 0;
            else
                return ++axis, given;
        };
        return memory(object, name, type, {length(axes)...}, kept_);
    }

    nb::handle record_;
    Py_ssize_t place_ = 0;
    int type_;
    nb::list &kept_;
};

template <class Record>
void read(Record &place, nb::handle record, int type, const Sizes &sizes, nb::list &kept) {
    Reader reader(record, type, sizes, kept);
    fields(place, reader);
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
        add(name, ArrayOf<T, 1>::ARGUMENT.text);
    }
    template <class... Axes>
    void states(const char *name, double *&, Axes...) {
        add(name, NUMBERS.text);
    }
    template <class Record>
    void record(const char *name, const char *type, Record &) {
        add(name, type);
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
void add_record(nb::module_ &module, const char *name) {
    Record record{};
    Names names;
    fields(record, names);
    nb::object type =
        nb::module_::import_("collections")
            .attr("namedtuple")(name, names.names, "defaults"_a = names.defaults, "module"_a = "eip_scipy.engine.data");
    type.attr("__annotations__") = names.types;
    type.attr("__doc__") =
        "Record that the engine reads. The functions `fields` in engine/cpp (data.hpp, loop.hpp, members.hpp) list its "
        "fields, and comments there explain them.";
    module.attr(name) = type;
}

}  // namespace

Method method_of(nb::handle method, bool has_tableau, nb::list &kept) {
    Method m{};
    read(m, method, NPY_DOUBLE, {.tableau = has_tableau}, kept);
    if (!has_tableau) return m;
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
    const bool fits = ms.first >= 0 && ms.count >= 0 && ms.first <= ms.half && ms.count <= ms.half - ms.first;
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
    check_places(b.start, b.starts, b.member, b.members, m, "groups");
    const bool consecutive = b.size == 0 || b.size * b.count == m;
    require(b.starts >= 1 && (b.width == 1 || b.width == 2) && consecutive, "engine: groups do not fit the state");
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
    const nb::object work = dense.attr("work");
    const Buffers &buffers = buffers_of(work);
    kept.append(work);
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
    samples.roots.count = samples.counts;
    samples.interpolants.count = samples.counts + 1;
    samples.roots.pending_count = samples.counts + 2;
    return samples;
}

Members members_of(nb::handle members, const Data &run, const Schedule &schedule, int64_t rows, int type,
                   nb::list &kept) {
    Members m{};
    const Work &w = run.work;
    read(m, members, type,
         {.n = w.n, .m = w.m, .l = w.l, .events = schedule.n_events, .params = run.system.n_params, .rows = rows},
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
static void take(const LibraryFunction &function, LibraryCall<Octet> &place) {
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
    system.shifts.floors = static_cast<double *>(memory(functions.attr("floors"), "floors", NPY_DOUBLE, {w.n}, kept));
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
    system.n_params = PyArray_Check(params.ptr()) ? Array(params, nb::detail::borrow_t()).size() : 0;
    system.params = static_cast<double *>(memory(params, "params", NPY_DOUBLE, {system.n_params}, kept));
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

OctetSystem octet_system_of(nb::handle functions, const Data &run) {
    OctetSystem system;
    const Work &w = run.work;
    const int64_t size = run.system.second_order ? w.n / 2 : w.n, p = run.system.n_params;
    using Values = Native<ValuePointer, Octet>;
    system.rhs_pointer = pointer_of<Values>(functions.attr("rhs"), "rhs", size, size, p);
    system.inv_pointers = pointers_of<Values>(functions, "inv", w.l, w.n, p);
    system.grad_pointers = pointers_of<Native<GradientPointer, Octet>>(functions, "grad", w.l * w.n, w.n, p);
    system.second_order = run.system.second_order;
    system.params.resize(p);
    system.scratch.resize(w.n);
    system.scratch_f.resize(w.n);
    const Options &o = run.options;
    const nb::object jacobian = functions.attr("jacobian");
    if (!jacobian.is_none())
        system.jacobian_pointer = pointer_of<Native<GradientPointer, Octet>>(jacobian, "jacobian", w.n / 2, w.n / 2, p);
    const Multistep *ms = run.method.multistep;
    const bool steps =
        ms ? !ms->brief && !ms->level && (ms->count == 0 || !jacobian.is_none()) : !o.compensated && o.every >= 1;
    const bool plain = w.n == w.m && o.pairs == 0 && !o.adaptive && o.iterations == 1 && o.direction == NEW;
    require(!run.system.python && plain && steps,
            "engine: members with these options cannot be run in batches of eight");
    return system;
}

namespace {

// One for each buffer, so that a sanitizer sees where each one ends.
using Memory = std::vector<std::vector<double>>;

// Calls `found(name, place, type, shape)` for each buffer.
template <class Found>
struct Finder {
    Found found;
    int type;

    template <class T>
    void operator()(const char *name, T *&place, std::initializer_list<int64_t> shape) {
        found(name, place, TYPE<T>, std::span(shape));
    }
    void states(const char *name, double *&place, std::initializer_list<int64_t> shape) {
        found(name, place, type, std::span(shape));
    }
};

template <class Found>
void for_each_buffer(Work &work, int64_t blocks, int type, Found found) {
    Finder<Found> finder{found, type};
    each_buffer(work, blocks, finder);
}

}  // namespace

Buffers::Buffers(int64_t n, nb::handle dtype, int64_t stages, int64_t invariants, int64_t blocks, int64_t balances)
    : blocks(blocks) {
    require(n >= 0 && stages >= 0 && invariants >= 0 && blocks >= 0 && balances >= 0,
            "engine: a negative number of buffers");
    PyArray_Descr *found = nullptr;
    if (!PyArray_DescrConverter(dtype.ptr(), &found)) throw nb::python_error();
    const auto kept = owned(reinterpret_cast<PyObject *>(found));
    type = found->type_num;
    require(type == NPY_DOUBLE || type == NPY_CDOUBLE, "engine: a state is of float64 or complex128");
    work.n = n;
    work.m = type == NPY_CDOUBLE ? 2 * n : n;
    work.l = invariants;
    work.stages = stages;
    work.balances = balances;
    auto own = std::make_unique<Memory>();
    for_each_buffer(work, blocks, type, [&own]<class T>(const char *, T *&place, int type, auto shape) {
        static_assert(sizeof(T) == sizeof(double));
        int64_t count = type == NPY_CDOUBLE ? 2 : 1;
        for (const int64_t length : shape) count *= length;
        place = reinterpret_cast<T *>(own->emplace_back(std::max<int64_t>(count, 1)).data());
    });
    owner_ = nb::capsule(own.get(), [](void *memory) noexcept { delete static_cast<Memory *>(memory); });
    own.release();
    fill(work.sigma, 1.0, work.m);
    for (int64_t i = 0; i < work.l; ++i) work.figures(i)[TERMS] = ENDLESS;
}

Buffers::Buffers(const nb::tuple &state)
    : Buffers(nb::cast<int64_t>(state[0]), state[1], nb::cast<int64_t>(state[2]), nb::cast<int64_t>(state[3]),
              nb::cast<int64_t>(state[4]), nb::cast<int64_t>(state[5])) {
    for (const auto &[name, array] : nb::cast<nb::dict>(state[6]))
        if (PyArray_CopyInto(nb::borrow<Array>(arrays()[name]).get(), nb::cast<Array>(array).get()) < 0)
            throw nb::python_error();
}

nb::tuple Buffers::state() const {
    return nb::make_tuple(work.n, owned(reinterpret_cast<PyObject *>(PyArray_DescrFromType(type))), work.stages, work.l,
                          blocks, work.balances, arrays());
}

const nb::dict &Buffers::arrays(const char *only) const {
    if (only && arrays_.contains(only)) return arrays_;
    Work own = work;
    for_each_buffer(own, blocks, type, [&](const char *name, auto *place, int type, auto shape) {
        if ((only && std::strcmp(name, only) != 0) || arrays_.contains(name)) return;
        const std::vector<npy_intp> lengths(shape.begin(), shape.end());
        arrays_[name] = view(place, static_cast<int>(lengths.size()), lengths.data(), type, owner_);
    });
    return arrays_;
}

const Buffers &buffers_of(nb::handle work) {
    const Buffers *found = nullptr;
    if (!nb::try_cast(work, found) || !found) throw nb::type_error("engine: work must be an object of the class Work");
    return *found;
}

void add_records(nb::module_ &module) {
    add_record<Span>(module, "Span");
    add_record<Schedule>(module, "Schedule");
    add_record<Multistep>(module, "Multistep");
    add_record<Method>(module, "Method");
    add_record<Blocks>(module, "Grouping");
    add_record<Frame>(module, "FrameRows");
    add_record<Balances>(module, "Balances");
    add_record<Groups>(module, "Groups");
    add_record<Columns>(module, "Columns");
    add_record<Options>(module, "Options");
    add_record<Members>(module, "Members");
    add_record<Samples>(module, "Dense");
    nb::class_<Buffers> type(
        module, "Work", "Buffers of a run in the engine's memory; each attribute is an array that shows one buffer.");
    type.def(nb::init<int64_t, nb::handle, int64_t, int64_t, int64_t, int64_t>(), "n"_a, "dtype"_a, "stages"_a,
             "n_invariants"_a, "n_blocks"_a, "n_balances"_a = 0)
        .def(
            "arrays", [](const Buffers &own) { return own.arrays(); },
            nb::sig("def arrays(self) -> dict[str, numpy.typing.NDArray[typing.Any]]"), "Return all arrays by name.")
        .def("__getstate__", &Buffers::state)
        .def("__setstate__", [](Buffers &own, const nb::tuple &state) { new (&own) Buffers(state); });
    Work any{};
    for_each_buffer(any, 0, NPY_CDOUBLE, [&type](const char *name, auto *, int number, auto) {
        const char *array = number == NPY_INT64 ? INTEGERS.text : number == NPY_DOUBLE ? FLOATS.text : "numpy.ndarray";
        const std::string signature = "def " + std::string(name) + "(self, /) -> " + array;
        type.def_prop_ro(name, [name](const Buffers &own) { return own.array(name); }, nb::sig(signature.c_str()));
    });
}

}  // namespace eip
