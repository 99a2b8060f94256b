// The loop over steps of one length that the comparators share.
#include "../functions.hpp"

#include <chrono>
#include <optional>
#include <string_view>

#include "../calls.hpp"
#include "../python_functions.hpp"
#include "../records.hpp"
#include "schemes.hpp"

namespace eip {
namespace {

// Step k leads from t0 + k h; the last one is of another length. Row r of `y` receives the state after step saved[r], the
// start being in the first already.
struct FixedSteps {
    double t0, h, last;
    const int64_t *saved;
    int64_t rows;
    double *y;
};

// Lets other threads run, and looks at signals now and then.
class Unlocked {
  public:
    explicit Unlocked(bool unlocks) : state_(unlocks ? PyEval_SaveThread() : nullptr) {}
    ~Unlocked() {
        if (state_) PyEval_RestoreThread(state_);
    }
    Unlocked(const Unlocked &) = delete;
    Unlocked &operator=(const Unlocked &) = delete;

    void look() {
        if (!state_ || Clock::now() < next_) return;
        PyEval_RestoreThread(std::exchange(state_, nullptr));
        if (PyErr_CheckSignals() < 0) throw PythonError{};
        state_ = PyEval_SaveThread();
        next_ = Clock::now() + PAUSE;
    }

  private:
    using Clock = std::chrono::steady_clock;
    static constexpr std::chrono::milliseconds PAUSE{20};
    PyThreadState *state_;
    Clock::time_point next_ = Clock::now() + PAUSE;
};

constexpr int64_t BETWEEN_LOOKS = 64;  // steps: what a look at the clock takes is to be nothing

template <class Scheme>
void drive(Scheme scheme, const FixedSteps &steps, double *y, int64_t n, Unlocked &others) {
    const int64_t count = steps.saved[steps.rows - 1];
    for (int64_t k = 0, row = 1; k < count; ++k) {
        if (!scheme.step(steps.t0 + static_cast<double>(k) * steps.h, k == count - 1 ? steps.last : steps.h, y)) return;
        if (k + 1 == steps.saved[row]) copy(y, steps.y + row++ * n, n);
        if (k % BETWEEN_LOOKS == 0) others.look();
    }
}

void drive_by_name(std::string_view name, Callee &callee, double constant, const FixedSteps &steps, double *y,
                   Unlocked &others) {
    const int64_t n = callee.work.m;
    if (name == "kick-drift-kick") {
        if (steps.saved[steps.rows - 1] > 0) callee(steps.t0, y);
        drive(KickDriftKick{callee}, steps, y, n, others);
    } else if (name == "drift-kick-drift") {
        drive(DriftKickDrift{callee}, steps, y, n, others);
    } else if (name == "boris") {
        drive(Boris{callee, constant}, steps, y, n, others);
    } else {
        drive(ImplicitMidpoint(callee), steps, y, n, others);
    }
}

FixedSteps steps_of(PyObject *record, PyObject *rows, int64_t n, Arrays &arrays) {
    FixedSteps s{};
    s.t0 = number(record, "t0");
    s.h = number(record, "h");
    s.last = number(record, "last");
    s.rows = Arrays::length(record, "saved");
    s.saved = arrays.integers<int64_t>(record, "saved", {s.rows});
    s.y = static_cast<double *>(arrays.memory(rows, "rows", NPY_DOUBLE, {s.rows, n}));
    bool good = s.rows > 0 && s.saved[0] == 0;
    for (int64_t r = 1; r < s.rows; ++r) good &= s.saved[r] > s.saved[r - 1];
    if (good) return s;
    PyErr_SetString(PyExc_ValueError, "take_steps: the steps to save must rise from 0");
    throw PythonError{};
}

void require_scheme(std::string_view name, int64_t n) {
    const bool halves = name == "kick-drift-kick" || name == "drift-kick-drift";
    if ((halves && n % 2 == 0) || (name == "boris" && n == 6) || name == "implicit-midpoint") return;
    PyErr_SetString(PyExc_ValueError, "take_steps: no such scheme, or a state of another size than it has");
    throw PythonError{};
}

PyDoc_STRVAR(take_steps_doc,
             "take_steps(scheme, constant, functions, work, steps, y, rows) -> int\n\nTake all steps from y, which "
             "moves; rows (saved, n) receives the states to save. Returns the number of evaluations.");

PyObject *take_steps(PyObject *, PyObject *args) {
    return guarded([&]() -> PyObject * {
        const char *name;
        double constant;
        PyObject *functions, *work_object, *record, *y_object, *rows;
        if (!PyArg_ParseTuple(args, "sdOOOOO", &name, &constant, &functions, &work_object, &record, &y_object, &rows))
            return nullptr;
        const Ref kept(PyList_New(0));
        Arrays arrays(kept.get());
        const Work work = work_of(work_object, 1, 0, arrays, NPY_DOUBLE);
        auto *y = static_cast<double *>(arrays.memory(y_object, "y", NPY_DOUBLE, {work.n}));
        require_scheme(name, work.n);
        const FixedSteps steps = steps_of(record, rows, work.n, arrays);
        System system;
        std::optional<PythonFunctions> in_python;
        if (truth(functions, "native")) {
            read_pointers(functions, work, 0, arrays, system);
        } else {
            in_python.emplace(functions, work_object, work, NPY_DOUBLE, kept.get());
            system.python = &*in_python;
        }
        const FloatingPoint mode;
        Callee callee{system, work};
        try {
            Unlocked others(!in_python);
            drive_by_name(name, callee, constant, steps, y, others);
        } catch (const Broken &) {
            raise_broken(system);
            return nullptr;
        }
        return PyLong_FromLongLong(callee.evaluations);
    });
}

}  // namespace

PyMethodDef comparator_functions[] = {
    {"take_steps", take_steps, METH_VARARGS, take_steps_doc},
    {nullptr, nullptr, 0, nullptr},
};

}  // namespace eip
