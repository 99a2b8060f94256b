// The binding: an Engine holds a run's arrays and functions, and steps.
#define EIP_IMPORTS_NUMPY
#include "module.hpp"

#include <nanobind/stl/tuple.h>

#include <atomic>
#include <optional>
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

class Engine {
  public:
    Engine(nb::object method, nb::object options, nb::object work, nb::object functions, nb::object schedule,
           nb::object hooks) {
        for (const nb::object &object : {method, options, functions, schedule, hooks}) kept_.append(object);
        const Buffers buffers(work, kept_);
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
            functions_ = std::make_unique<PythonFunctions>(python, work, data_.work, type_, kept_);
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
                !hooks_ && data_.options.compensated && (data_.multistep.corrected_count == 0 || jacobian),
                "engine: a multistep method needs compensated summation, no hooks, and a Jacobian if it is corrected");
        }
        require(!(data_.method.nystrom || system.second_order) || data_.work.m % 2 == 0,
                "engine: a state of positions and velocities has an even length");
    }

    // Nothing is called from now on.
    void clear() {
        busy_ = true;
        interpolating_ = true;
        batch_.reset();
        functions_.reset();
        hooks_.reset();
        kept_.reset();
    }

    int advance(int64_t k_end, nb::handle y, nb::handle y_new, nb::handle t_saved, nb::handle y_saved,
                nb::handle pieces) {
        const Busy busy(busy_);
        double *from = state<double>(y, "y"), *to = state<double>(y_new, "y_new");
        Saved saved{};
        saved.t = memory<double>(t_saved, "t_saved", NPY_DOUBLE, Bound{saved.rows});
        saved.y = memory<double>(y_saved, "y_saved", type_, saved.rows, data_.work.n);
        if (samples_) {
            Pieces &all = samples_->interpolants;
            all.first = memory<double>(pieces, "pieces", NPY_DOUBLE, Bound{all.capacity}, dense().floats());
        }
        check_room(saved);
        if (hooks_) hooks_->set_state(y_new);
        return stepped([&](const Run &run) { return advance_run(run, samples(), *schedule_, k_end, from, to, saved); });
    }

    void side_by_side(nb::object functions) {
        const Busy busy(busy_);
        kept_.append(functions);
        batch_ = std::make_unique<Batch>(data_.method, data_.options, data_.work, batch_functions_of(functions, data_));
    }

    int sweep(nb::object members, int64_t steps, nb::handle y, nb::handle y_new) {
        const Busy busy(busy_);
        nb::list kept;
        const Schedule &s = schedule();
        double *from = state<double>(y, "y"), *to = state<double>(y_new, "y_new");
        const Members all = members_of(members, data_, s, type_, kept);
        require(steps >= 1 && all.n_rows >= 2 && !functions_ && !hooks_ && (s.n_events == 0 || samples_),
                "engine: `sweep` needs a step or more, two rows or more, functions given by addresses, no hooks, and "
                "dense output if there are events");
        check_room(all.saved(0, data_.work));
        if (samples_) samples_->interpolants.capacity = 0;
        if (!batch_)
            return stepped([&](const Run &run) { return sweep_members(run, samples(), s, all, steps, from, to); });
        const bool fixed = s.span.h != 0.0 && s.n_events == 0 && (s.n_eval == 0 || (samples_ && all.kept));
        const int64_t saved = s.n_eval > 0 ? s.n_eval : s.save_every > 0 ? s.span.n_steps / s.save_every + 2 : 2;
        require(fixed && (!all.kept || all.n_rows >= saved),
                "engine: batches of members need fixed steps without events, a row for each saved state, and dense "
                "output and kept rows for t_eval");
        return stepped([&](const Run &run) { return sweep_batches(run, *batch_, samples(), s, all, steps, from, to); });
    }

    void sample(nb::object dense) {
        const Busy busy(busy_), interpolating(interpolating_);
        kept_.append(dense);
        samples_ = samples_of(dense, data_, schedule_ ? schedule_->n_events : 0, type_, kept_);
        if (functions_) functions_->add_owner(dense.attr("work"), kept_);
    }

    void describe(double t_old, nb::handle y_old, double t, nb::handle y, nb::handle piece) {
        const Busy busy(busy_), interpolating(interpolating_);
        double *floats = memory<double>(piece, "piece", NPY_DOUBLE, dense().floats());
        const double *from = state(y_old, "y_old"), *to = state(y, "y");
        stepped([&](const Run &run) { return describe_step(run, dense(), t_old, from, t, to, floats), OK; });
    }

    void show(double t, nb::handle y, nb::handle out) {
        const Busy busy(busy_), interpolating(interpolating_);
        dense();
        const double *from = state(y, "y");
        double *to = state<double>(out, "out");
        const int64_t end = schedule().place[PENDING] == 1;
        stepped([&](const Run &run) { return show_state(run, *samples_, end, t, from, to), OK; });
    }

    void interpolate(nb::handle piece, nb::handle t, nb::handle out) {
        const Busy interpolating(interpolating_);
        int64_t rows = 0;
        double *floats = memory<double>(piece, "piece", NPY_DOUBLE, dense().floats());
        const double *times = memory<const double>(t, "t", NPY_DOUBLE, Bound{rows});
        double *states = memory<double>(out, "out", type_, rows, data_.work.n);
        require(has_node(dense(), floats), "engine: the interpolant belongs to no node of the history");
        stepped([&](const Run &run) { return interpolate_step(run, dense(), floats, times, rows, states), OK; });
    }

    std::tuple<int, double, Array, Array> step(int64_t k, double t, nb::handle y, nb::handle f) {
        const Busy busy(busy_);
        const Work &w = data_.work;
        const Schedule &s = schedule();
        const double *from = state(y, "y");
        copy(state(f, "f"), w.row(0), w.m);
        s.clock[TIME] = t;
        if (stepped_) copy(w.rate(w.stages), w.rate(0), w.balances);
        Array y_new = new_array({w.n}, type_), f_new = new_array({w.n}, type_);
        if (hooks_) hooks_->set_state(y_new);
        const Code code = stepped([&](const Run &run) { return step_once(run, s, k, from, y_new.floats()); });
        stepped_ = true;
        copy(w.last(), f_new.floats(), w.m);
        return {code, s.clock[TIME_NEW], std::move(y_new), std::move(f_new)};
    }

    int project(double t_old, nb::handle y, double t, bool last, nb::handle y_new) {
        const Busy busy(busy_);
        const Step step{t_old, t, t - t_old, state(y, "y"), state<double>(y_new, "y_new"), true, last};
        if (hooks_) hooks_->set_state(y_new);
        return stepped([&](const Run &run) { return project_once(run, step); });
    }

    void values(nb::handle t, nb::handle y, nb::handle out, nb::handle params) {
        const Busy busy(busy_);
        const Work &w = data_.work;
        const int64_t p = data_.system.n_params;
        int64_t rows = 0;
        const double *times = memory<const double>(t, "t", NPY_DOUBLE, Bound{rows}), *given = nullptr;
        const double *states = memory<const double>(y, "y", type_, rows, w.n);
        double *found = memory<double>(out, "out", NPY_DOUBLE, rows, w.l);
        if (!params.is_none() && p > 0) given = memory<const double>(params, "params", NPY_DOUBLE, rows, p);
        stepped([&](const Run &run) {
            for (int64_t k = 0; k < rows; ++k) {
                if (given) copy(given + k * p, run.system.params, p);
                run.system.inv(w, times[k], states + k * w.m, found + k * w.l);
            }
            return OK;
        });
    }

    void start(nb::handle y, nb::handle f, double tau) {
        const Busy busy(busy_);
        start_figures(state(y, "y"), state(f, "f"), tau, data_.method, hooks_.get(), data_.options, data_.work);
    }

    // The objects that the garbage collector visits.
    nb::handle kept() const { return kept_; }

  private:
    template <class T = const double>
    T *state(nb::handle object, const char *name) const {
        return memory<T>(object, name, type_, data_.work.n);
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
            const int64_t roots = samples_->roots.counts[0], pieces = samples_->roots.counts[1];
            good &= roots >= 0 && pieces >= 0 && pieces <= samples_->interpolants.capacity;
        }
        require(good,
                "engine: the position in the schedule or the counts of dense output are outside their rows, or there "
                "are too few rows");
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
    std::unique_ptr<Batch> batch_;
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
             "With dense output, `pieces` (rows, floats) is filled with the interpolants of all steps if it has rows.")
        .def("side_by_side", &Engine::side_by_side, "functions"_a,
             "Let `sweep` run members in batches of eight from now on, with these functions for eight members.")
        .def("sweep", &Engine::sweep, "members"_a, "steps"_a, "y"_a, "y_new"_a,
             "Run members of an ensemble for `steps` steps in all, or slightly more. Return OK, or a code for what "
             "happened to the current member. A member of a batch whose status is not set must be run alone.")
        .def("step", &Engine::step, "k"_a, "t"_a, "y"_a, "f"_a,
             "Make step `k` from the state `y` at time `t`, where the derivative is `f`. Return (status, t_new, y_new, "
             "f_new).")
        .def("project", &Engine::project, "t_old"_a, "y"_a, "t"_a, "last"_a, "y_new"_a,
             "Project the state work.y_hat onto the invariants, write the result to `y_new`, and return the code.")
        .def("values", &Engine::values, "t"_a, "y"_a, "out"_a, "params"_a = nb::none(),
             "Fill `out` (m, l) with the invariants at the times `t` (m,) and states `y` (m, n), each with its own row "
             "of parameters if `params` (m, p) is given.")
        .def("start", &Engine::start, "y"_a, "f"_a, "tau"_a,
             "Set the sizes of the invariants' terms at the start, where work.values and work.G are known.")
        .def("sample", &Engine::sample, "dense"_a, "Make dense output from now on, as the record `dense` says.")
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
