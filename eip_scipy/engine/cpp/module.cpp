// The binding: an Engine holds a run's arrays and functions, and steps.
#define EIP_IMPORTS_NUMPY
#include "module.hpp"

#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <atomic>
#include <string>
#include <string_view>
#if defined(__x86_64__)
#include <cpuid.h>
#endif

#include "python_functions.hpp"
#include "threads.hpp"

#if defined(__clang__)
#define EIP_COMPILER __VERSION__  // begins with its name
#elif defined(__GNUC__)
#define EIP_COMPILER "GCC " __VERSION__
#else
#define EIP_COMPILER "an unnamed compiler"
#endif

namespace eip {

// FailedCallError(which functions, which of them, t, bytes of y, of f, status): the code that made the functions knows what it means.
static PyObject *failed_call_error = nullptr;

void raise_broken(const System &system) {
    if (PyErr_Occurred()) throw nb::python_error();
    const FailedCall &call = system.failed;
    const auto bytes = [](const std::vector<double> &a) { return nb::bytes(a.data(), a.size() * sizeof(double)); };
    const nb::tuple arguments =
        nb::make_tuple(call.functions, call.index, call.t, bytes(call.y), bytes(call.f), call.status);
    PyErr_SetObject(failed_call_error, arguments.ptr());
    throw nb::python_error();
}

namespace {

using State = StatesOf<double, 1>;
using ConstState = StatesOf<const double, 1>;
using Times = ArrayOf<const double, 1>;

// True if the processor supports the other build, for x86-64-v3, and the operating system saves its registers. CPUID is used
// directly, because the library behind __builtin_cpu_supports is not available with each compiler and on each system.
bool has_v3() {
#if defined(__x86_64__)
    constexpr unsigned FIRST = bit_FMA | bit_MOVBE | bit_OSXSAVE | bit_F16C, SEVENTH = bit_AVX2 | bit_BMI | bit_BMI2;
    constexpr unsigned EXTENDED = bit_LZCNT, KEPT = 6;  // XMM and YMM
    unsigned a, b, c, d, low, high;
    if (!__get_cpuid(1, &a, &b, &c, &d) || (c & FIRST) != FIRST) return false;
    __asm__("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
    if ((low & KEPT) != KEPT || !__get_cpuid_count(7, 0, &a, &b, &c, &d) || (b & SEVENTH) != SEVENTH) return false;
    return __get_cpuid(0x80000001, &a, &b, &c, &d) && (c & EXTENDED) == EXTENDED;
#else
    return false;
#endif
}

// The engine steps for one caller at a time, and interpolates for one: a function that does so with the run it belongs to
// is refused, and so is another thread.
class Busy {
  public:
    explicit Busy(std::atomic<bool> &flag) : flag_(flag) {
        if (flag.exchange(true, std::memory_order_acquire))
            refuse(PyExc_RuntimeError,
                   "engine: the run is in use: its own functions, or a second thread, must not step it or evaluate its "
                   "dense output; use a separate run for that");
    }
    ~Busy() { flag_.store(false, std::memory_order_release); }
    Busy(const Busy &) = delete;
    Busy &operator=(const Busy &) = delete;

  private:
    std::atomic<bool> &flag_;
};

template <class Array>
void require_shape(const Array &array, const char *name, Lengths shape) {
    if (std::equal(shape.begin(), shape.end(), array.shape)) return;
    refuse(PyExc_ValueError, "engine: %s has another shape than the run expects", name);
}

class Engine {
  public:
    Engine(nb::object method, nb::object options, nb::object work, nb::object functions, nb::object schedule,
           nb::object hooks) {
        for (const nb::object &object : {method, options, work, functions, schedule, hooks}) kept_.append(object);
        const Buffers &buffers = buffers_of(work);
        type_ = buffers.type;
        data_.work = buffers.work;
        const bool has_tableau = hooks.is_none() || nb::object(hooks.attr("one_step")).is_none();
        data_.method = method_of(method, has_tableau, kept_);
        require(data_.method.stages == data_.work.stages, "engine: work and method have different numbers of stages");
        data_.options = options_of(options, data_.work, buffers.blocks, kept_);
        if (!schedule.is_none()) schedule_ = schedule_of(schedule, kept_);
        System &system = data_.system;
        const int64_t events = schedule_ ? schedule_->n_events : 0;
        const bool native = truth(functions.attr("native"));
        const nb::object python = native ? nb::object(functions.attr("python")) : functions;
        require(data_.work.balances == 0 || data_.options.balances.stages == data_.work.stages,
                "engine: the record of the balances has another number of stages than the method");
        read_balances(functions, data_.work, system);
        if (native)
            read_pointers(functions, data_.work, data_.options.columns, python.is_none() ? events : 0, kept_, system);
        if (!python.is_none()) {
            functions_ = std::make_unique<PythonFunctions>(python, buffers.owner(), data_.work, type_, kept_);
            system.python = functions_.get();
            require(functions_->events() == events,
                    "engine: the number of event functions differs from that in the schedule");
        }
        if (!hooks.is_none()) {
            const Run steps{data_.method, data_.options, data_.work, data_.system, nullptr};
            hooks_ = std::make_unique<PythonHooks>(hooks, buffers, steps, kept_);
        }
        const nb::object multistep = method.attr("multistep");
        if (!multistep.is_none()) {
            data_.multistep = multistep_of(multistep, data_.work, kept_);
            data_.method.multistep = &data_.multistep;
            const bool jacobian = native ? system.jacobian_pointer.pointer || system.jacobian_pointer.library
                                         : functions_->has_jacobian();
            require(
                !hooks_ && data_.options.compensated && (data_.multistep.count == 0 || jacobian),
                "engine: a multistep method needs compensated summation, no hooks, and a Jacobian if it is corrected");
        }
        require(!(data_.method.nystrom || system.second_order) || data_.work.m % 2 == 0,
                "engine: a state of positions and velocities has an even length");
    }

    // Nothing is called from now on.
    void clear() {
        busy_ = true;
        interpolating_ = true;
        eight_.reset();
        functions_.reset();
        hooks_.reset();
        kept_.reset();
    }

    int advance(int64_t k_end, State y, State y_new, ArrayOf<double, 1> t_saved, StatesOf<double, 2> y_saved,
                std::optional<ArrayOf<double, 2>> pieces) {
        const Busy busy(busy_);
        double *from = checked(y, "y"), *to = checked(y_new, "y_new");
        const Saved saved{t_saved.data, checked(y_saved, "y_saved", t_saved.shape[0]), t_saved.shape[0]};
        if (samples_) {
            require(pieces.has_value(), "engine: `pieces` is None, but dense output needs it");
            require_shape(*pieces, "pieces", {pieces->shape[0], dense().floats()});
            samples_->interpolants.first = pieces->data;
            samples_->interpolants.capacity = pieces->shape[0];
        }
        check_room(saved);
        if (hooks_) hooks_->set_state(y_new.object);
        return stepped([&](const Run &run) { return advance_run(run, samples(), *schedule_, k_end, from, to, saved); });
    }

    int sweep(nb::object members, int64_t steps, State y, State y_new, ArrayOf<double, 1> t_saved) {
        const Busy busy(busy_);
        nb::list kept;
        double *from = checked(y, "y"), *to = checked(y_new, "y_new");
        const Members all = swept(members, steps, t_saved, kept);
        require(!functions_ && !hooks_ && (schedule().n_events == 0 || samples_),
                "engine: `sweep` needs functions given by addresses, no hooks, and dense output if there are events");
        check_room(all.saved(0, data_.work));
        if (samples_) samples_->interpolants.capacity = 0;
        return stepped([&](const Run &run) { return sweep_members(run, samples(), *schedule_, all, steps, from, to); });
    }

    void side_by_side(nb::object functions) {
        const Busy busy(busy_);
        kept_.append(functions);
        eight_ = std::make_unique<Eight>(data_.method, data_.options, data_.work, octet_system_of(functions, data_));
    }

    int sweep_octets(nb::object members, int64_t steps, State y, State y_new, ArrayOf<double, 1> t_saved) {
        const Busy busy(busy_);
        nb::list kept;
        const Schedule &s = schedule();
        double *from = checked(y, "y"), *to = checked(y_new, "y_new");
        const Members all = swept(members, steps, t_saved, kept);
        const bool fixed = s.span.h != 0.0 && s.n_events == 0 && (s.n_eval == 0 || (samples_ && all.kept));
        const int64_t saved = s.n_eval > 0 ? s.n_eval : s.save_every > 0 ? s.span.n_steps / s.save_every + 2 : 2;
        require(eight_ && fixed && (!all.kept || all.n_rows >= saved),
                "engine: `sweep_octets` needs functions for eight members, fixed steps without events, a row for each "
                "saved state, and dense output and kept rows for t_eval");
        if (samples_) samples_->interpolants.capacity = 0;
        return stepped(
            [&](const Run &run) { return eip::sweep_octets(run, *eight_, samples(), s, all, steps, from, to); });
    }

    void sample(nb::object dense) {
        const Busy busy(busy_), interpolating(interpolating_);
        kept_.append(dense);
        samples_ = samples_of(dense, data_, schedule_ ? schedule_->n_events : 0, type_, kept_);
        if (functions_) functions_->add_owner(buffers_of(dense.attr("work")).owner(), kept_);
    }

    void describe(double t_old, ConstState y_old, double t, ConstState y, ArrayOf<double, 1> piece) {
        const Busy busy(busy_), interpolating(interpolating_);
        const Dense &d = dense();
        const double *from = checked(y_old, "y_old"), *to = checked(y, "y");
        require_shape(piece, "piece", {d.floats()});
        stepped([&](const Run &run) { return describe_step(run, d, t_old, from, t, to, piece.data), OK; });
    }

    void show(double t, ConstState y, State out) {
        const Busy busy(busy_), interpolating(interpolating_);
        dense();
        const double *from = checked(y, "y");
        double *to = checked(out, "out");
        const int64_t end = schedule().place[PENDING] == 1;
        stepped([&](const Run &run) { return show_state(run, *samples_, end, t, from, to), OK; });
    }

    void interpolate(ArrayOf<double, 1> piece, Times t, StatesOf<double, 2> out) {
        const Busy interpolating(interpolating_);
        const Dense &d = dense();
        require_shape(piece, "piece", {d.floats()});
        require(has_node(d, piece.data), "engine: the interpolant belongs to no node of the history");
        double *states = checked(out, "out", t.shape[0]);
        stepped([&](const Run &run) { return interpolate_step(run, d, piece.data, t.data, t.shape[0], states), OK; });
    }

    std::tuple<int, double, Array, Array> step(int64_t k, double t, ConstState y, ConstState f) {
        const Busy busy(busy_);
        const Work &w = data_.work;
        const Schedule &s = schedule();
        const double *from = checked(y, "y");
        copy(checked(f, "f"), w.row(0), w.m);
        s.clock[TIME] = t;
        if (stepped_) copy(w.rate(w.stages), w.rate(0), w.balances);
        Array y_new = new_array({w.n}, type_), f_new = new_array({w.n}, type_);
        if (hooks_) hooks_->set_state(y_new);
        const Code code = stepped([&](const Run &run) { return step_once(run, s, k, from, y_new.floats()); });
        stepped_ = true;
        copy(w.last(), f_new.floats(), w.m);
        return {code, s.clock[TIME_NEW], std::move(y_new), std::move(f_new)};
    }

    int project(double t_old, ConstState y, double t, bool last, State y_new) {
        const Busy busy(busy_);
        const Step step{t_old, t, t - t_old, checked(y, "y"), checked(y_new, "y_new"), true, last};
        if (hooks_) hooks_->set_state(y_new.object);
        return stepped([&](const Run &run) { return project_once(run, step); });
    }

    void values(Times t, StatesOf<const double, 2> y, ArrayOf<double, 2> out,
                std::optional<ArrayOf<const double, 2>> params) {
        const Busy busy(busy_);
        const Work &w = data_.work;
        const System &system = data_.system;
        const npy_intp rows = t.shape[0];
        const double *states = checked(y, "y", rows);
        require_shape(out, "out", {rows, w.l});
        const double *given = params && system.n_params > 0 ? params->data : nullptr;
        if (given) require_shape(*params, "params", {rows, system.n_params});
        stepped([&](const Run &run) {
            for (npy_intp k = 0; k < rows; ++k) {
                if (given) copy(given + k * system.n_params, system.params, system.n_params);
                run.system.inv(run.work, t.data[k], states + k * w.m, out.data + k * w.l);
            }
            return OK;
        });
    }

    void start(ConstState y, ConstState f, double tau) {
        const Busy busy(busy_);
        start_figures(checked(y, "y"), checked(f, "f"), tau, data_.method, hooks_.get(), data_.options, data_.work);
    }

    // The objects that the garbage collector visits.
    nb::handle kept() const { return kept_; }

  private:
    // The memory of a state, or of `rows` of them.
    template <class T, int AXES>
    T *checked(const StatesOf<T, AXES> &array, const char *name, npy_intp rows = 1) const {
        if (array.type != type_)
            refuse(PyExc_ValueError, "engine: %s has another dtype than the states of the run", name);
        if constexpr (AXES == 1)
            require_shape(array, name, {data_.work.n});
        else
            require_shape(array, name, {rows, data_.work.n});
        return array.data;
    }
    const Schedule &schedule() const {
        if (!schedule_)
            refuse(PyExc_RuntimeError, "engine: this call needs a schedule, but the engine was made without one");
        return *schedule_;
    }
    const Dense &dense() const {
        if (!samples_) refuse(PyExc_RuntimeError, "engine: this engine has no dense output; call `sample` first");
        return samples_->dense;
    }
    Samples *samples() { return samples_ ? &*samples_ : nullptr; }

    // Counts that Python may have written, before the loop goes by them.
    void check_room(const Saved &saved) {
        const int64_t row = schedule().place[ROW];
        bool good = row >= 0 && row <= saved.rows && schedule().n_eval < std::max<int64_t>(saved.rows, 1);
        if (data_.method.multistep) check_history(*data_.method.multistep);
        if (samples_) {
            const int64_t roots = *samples_->roots.count, pieces = *samples_->interpolants.count;
            good &= roots >= 0 && pieces >= 0 && pieces <= samples_->interpolants.capacity;
        }
        require(good,
                "engine: the position in the schedule or the counts of dense output are outside their rows, or there "
                "are too few rows");
    }

    // Members of an ensemble as a sweep takes them.
    Members swept(nb::handle members, int64_t steps, const ArrayOf<double, 1> &t_saved, nb::list &kept) {
        const int64_t rows = t_saved.shape[0];
        Members found = members_of(members, data_, schedule(), rows, type_, kept);
        found.t_saved = t_saved.data;
        require(steps >= 1 && rows >= 2, "engine: `steps` must be at least 1, and t_saved must have at least two rows");
        return found;
    }

    // Make a step or more by `call`, which takes a Run, without the GIL if no function is Python's.
    template <class Call>
    Code stepped(Call call) {
        if (!kept_.is_valid())
            refuse(PyExc_RuntimeError, "engine: this engine has been cleared or was never set up; make a new one");
        try {
            std::optional<WithoutLock> released;
            std::optional<Ending::Inside> inside;
            if (data_.system.python || hooks_)
                inside.emplace();
            else
                released.emplace();
            return call(Run{data_.method, data_.options, data_.work, data_.system, hooks_.get()});
        } catch (const Broken &) {  // the GIL is taken again
            raise_broken(data_.system);
        }
    }

    nb::list kept_;  // every object that the run uses
    Data data_{};
    std::optional<Schedule> schedule_;
    std::optional<Samples> samples_;
    std::unique_ptr<Eight> eight_;
    std::unique_ptr<PythonFunctions> functions_;
    std::unique_ptr<PythonHooks> hooks_;
    int type_ = NPY_DOUBLE;
    std::atomic<bool> busy_ = false, interpolating_ = false;
    bool stepped_ = false;  // by `step`
};

void add_engine(nb::module_ &m) {
    Class<Engine>(m, "Engine", nb::type_slots(Collected<Engine>::slots),
                  "Engine of one run, which makes its steps on its arrays. ``functions.native`` is True if "
                  "`functions` holds addresses.")
        .def(nb::init<nb::object, nb::object, nb::object, nb::object, nb::object, nb::object>(), "method"_a,
             "options"_a, "work"_a, "functions"_a, "schedule"_a = nb::none(), "hooks"_a = nb::none(),
             nb::sig("def __init__(self, method: typing.Any, options: Options, work: Work, functions: typing.Any, "
                     "schedule: Schedule | None = None, hooks: typing.Any = None) -> None"))
        .def("advance", &Engine::advance, "k_end"_a, "y"_a, "y_new"_a, "t_saved"_a, "y_saved"_a, "pieces"_a.none(),
             "Make steps up to step `k_end`, or until something else stops the loop, and return the reason as a code. "
             "If `pieces` (rows, floats) has rows, it is filled with the interpolants of all steps.")
        .def("sweep", &Engine::sweep, "members"_a, "steps"_a, "y"_a, "y_new"_a, "t_saved"_a,
             "Run members of an ensemble one after the other, for `steps` steps in all (slightly more if a multistep "
             "method is near its end). Return OK, or a code for what happened to the current member. `members.where` "
             "holds the current member and whether it has begun.")
        .def("side_by_side", &Engine::side_by_side, "functions"_a,
             "Set the functions for eight members with which `sweep_octets` runs members from now on. Like those of "
             "the run, `functions` holds addresses.")
        .def("sweep_octets", &Engine::sweep_octets, "members"_a, "steps"_a, "y"_a, "y_new"_a, "t_saved"_a,
             "Run members like `sweep`, in batches of eight that step together; `steps` counts steps of a batch. A "
             "member whose status is not set afterwards must be run alone.")
        .def("step", &Engine::step, "k"_a, "t"_a, "y"_a, "f"_a,
             "Make step `k` from the state `y` at time `t`, where the derivative is `f`. Return (status, t_new, y_new, "
             "f_new).")
        .def("project", &Engine::project, "t_old"_a, "y"_a, "t"_a, "last"_a, "y_new"_a,
             "Project the state work.y_hat onto the invariants, write the result to `y_new`, and return the code.")
        .def("values", &Engine::values, "t"_a, "y"_a, "out"_a, "params"_a = nb::none(),
             "Fill `out` (m, l) with the invariants at the times `t` (m,) and states `y` (m, n). If `params` (m, p) is "
             "given, each state has its own row of parameters.")
        .def("start", &Engine::start, "y"_a, "f"_a, "tau"_a,
             "Set the sizes of the invariants' terms at the start of a run, from the state `y`, the derivative `f`, "
             "the length `tau` of a step, work.values and the gradients work.G.")
        .def("sample", &Engine::sample, "dense"_a,
             "Make dense output from now on, with the buffers of the record `dense`.")
        .def("describe", &Engine::describe, "t_old"_a, "y_old"_a, "t"_a, "y"_a, "piece"_a,
             "Fill `piece` with the interpolant over the last step, from (t_old, y_old) to (t, y).")
        .def("interpolate", &Engine::interpolate, "piece"_a, "t"_a, "out"_a,
             "Fill `out` (m, n) with the states at the times `t` (m,), computed with the interpolant `piece`.")
        .def("show", &Engine::show, "t"_a, "y"_a, "out"_a,
             "Fill `out` (n,) with the state `y` at `t` in the form in which the run saves its last state.");
}

// The integers of an enumeration, by the text of its names.
void add_integers(nb::module_ &m, std::string_view names) {
    for (long value = 0; !names.empty(); ++value) {
        const size_t end = std::min(names.find(','), names.size());
        const std::string entry(names.substr(0, end));
        const size_t equals = entry.find('=');
        if (equals != std::string::npos) value = std::stol(entry.substr(equals + 1));
        m.attr(entry.substr(0, entry.find_first_of(" =")).c_str()) = value;
        names.remove_prefix(std::min(names.find_first_not_of(", ", end), names.size()));
    }
}

void add_constants(nb::module_ &m) {
    for (const char *names :
         {Code_NAMES, Direction_NAMES, Metric_NAMES, Counter_NAMES, Clock_NAMES, Place_NAMES, Node_NAMES,
          Interpolant_NAMES, Figure_NAMES, SuspectPlace_NAMES, Reason_NAMES, SlowRow_NAMES})
        add_integers(m, names);
    m.attr("AUTO") = AUTO;
    m.attr("MOST_ARGUMENTS") = MOST_ARGUMENTS;
    m.attr("MOST_CROSSINGS") = MOST_CROSSINGS;
    m.attr("EPS") = EPS;
    m.attr("LATE_SHARE") = LATE_SHARE;
    m.attr("LARGE") = LARGE;
    m.attr("DISTANT") = DISTANT;
    m.attr("LARGE_SHARE") = LARGE_SHARE;
    m.attr("LEAST_CHANGE") = LEAST_CHANGE;
    m.attr("SOURCES") = EIP_SOURCES;
    m.attr("COMPILER") = EIP_COMPILER;
    m.attr("HAS_V3") = has_v3();
}

}  // namespace
}  // namespace eip

NB_MODULE(EIP_MODULE, made) {
    eip::Module m(made);
    if (_import_array() < 0) throw nanobind::python_error();
    nanobind::set_leak_warnings(false);  // objects that live until the end of the process are not leaks
    m.doc() = "Engine of eip_scipy in C++: steps, projections, dense output and ensembles.";
    eip::failed_call_error =
        PyErr_NewExceptionWithDoc("eip_scipy.engine.FailedCallError",
                                  "Error for a user's function, called by its address, that failed.", nullptr, nullptr);
    m.attr("FailedCallError") = eip::owned(eip::failed_call_error);
    m.def(
        "work_alone", eip::work_alone, nanobind::arg("alone"),
        "If `alone` is True, keep the calling thread from sharing sums over many bodies with other threads; if False, "
        "let it share them. Return the previous setting.");
    m.def(
        "call", [](const nanobind::callable &fun, const nanobind::args &args) { return nanobind::object(fun(*args)); },
        "Return ``fun(*args)``, with subnormal numbers.");
    m.def("end_threads", eip::end_threads,
          "End the threads that share sums over many bodies. They are not started again.");
    const auto at_exit = nanobind::module_::import_("atexit").attr("register");
    at_exit(nanobind::cpp_function(eip::Ending::begin));
    at_exit(m.attr("end_threads"));
    eip::add_constants(m);
    eip::add_records(m);
    eip::add_engine(m);
    eip::add_library(m);
    eip::add_examination(m);
    eip::add_states(m);
    eip::add_condensates(m.def_submodule("condensates"));
    eip::add_gradients(m.def_submodule("gradients"));
    eip::add_multibody(m.def_submodule("multibody"));
}
