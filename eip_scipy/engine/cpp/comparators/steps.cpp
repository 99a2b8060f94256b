// Schemes of fixed step and the loop over steps that they share. A scheme makes one step, y <- y(t + h), and says whether there
// is one.
#include "../module.hpp"

#include <chrono>
#include <cmath>
#include <limits>
#include <optional>
#include <string_view>
#include <vector>

#include "../calls.hpp"
#include "../python_functions.hpp"
#include "../records.hpp"

namespace eip {
namespace {

// Functions that the schemes call; `f` and `stage` are their buffers, and `evaluations` counts calls of the user's function.
struct Callee {
    System &system;
    const Work &work;
    int64_t evaluations = 0;

    double *f() const { return work.K; }
    double *stage() const { return work.stage; }
    // Into f, at a state that is kept.
    void operator()(double t, const double *y) {
        system.rhs(work, t, y, f());
        ++evaluations;
    }
    // Into f, at what is in `stage`, which may be changed.
    void at_stage(double t) {
        system.rhs_of_scratch(work, t, stage(), f());
        ++evaluations;
    }
};

// x += c dx.
inline void add(double *x, double c, const double *dx, int64_t n) {
    for (int64_t i = 0; i < n; ++i) x[i] += c * dx[i];
}

// Stoermer-Verlet for y = (q, v), in both forms; f holds (v, a).
struct KickDriftKick {
    Callee &callee;

    // The accelerations at y stand in f already.
    bool step(double t, double h, double *y) {
        const int64_t half = callee.work.m / 2;
        double *q = y, *v = y + half;
        const double *a = callee.f() + half;
        add(v, 0.5 * h, a, half);
        add(q, h, v, half);
        callee(t + h, y);
        add(v, 0.5 * h, a, half);
        return true;
    }
};

struct DriftKickDrift {
    Callee &callee;

    bool step(double t, double h, double *y) {
        const int64_t half = callee.work.m / 2;
        double *q = y, *v = y + half;
        add(q, 0.5 * h, v, half);
        callee(t + 0.5 * h, y);
        add(v, h, callee.f() + half, half);
        add(q, 0.5 * h, v, half);
        return true;
    }
};

// For a charged particle y = (x, v) in fields f = (E, B): half a step along v, half of the electric kick, a rotation
// around B, and the halves once more.
struct Boris {
    Callee &callee;
    double charge_by_mass;

    bool step(double t, double h, double *y) {
        const double half = 0.5 * h, kick = charge_by_mass * half;
        const double *E = callee.f(), *B = E + 3;
        add(y, half, y + 3, 3);
        for (int i = 0; i < 3; ++i) callee.stage()[i] = y[i];
        callee.at_stage(t + half);
        const double u = y[3] + kick * E[0], v = y[4] + kick * E[1], w = y[5] + kick * E[2];
        const double a = kick * B[0], b = kick * B[1], c = kick * B[2];
        const double s = 2.0 / (1.0 + a * a + b * b + c * c);
        // v' = v + v x t, then v + v' x s.
        const double p = u + v * c - w * b;
        const double q = v + w * a - u * c;
        const double r = w + u * b - v * a;
        y[3] = u + s * (q * c - r * b) + kick * E[0];
        y[4] = v + s * (r * a - p * c) + kick * E[1];
        y[5] = w + s * (p * b - q * a) + kick * E[2];
        add(y, half, y + 3, 3);
        return true;
    }
};

// y + h k, k = f(t + h / 2, y + h k / 2): by fixed-point iteration until round-off, from an extrapolation of the last two
// steps. There is no step where that does not converge.
struct ImplicitMidpoint {
    Callee &callee;
    std::vector<double> k, before;

    static constexpr int MOST_ITERATIONS = 100;
    static constexpr double SOLVED = 1e-12;  // relative change below which an iteration that no longer improves is done

    explicit ImplicitMidpoint(Callee &given) : callee(given), k(given.work.m), before(given.work.m) {}

    bool step(double t, double h, double *y) {
        const int64_t n = callee.work.m;
        for (int64_t i = 0; i < n; ++i) {
            const double guess = 2.0 * k[i] - before[i];
            before[i] = k[i];
            k[i] = guess;
        }
        double last = std::numeric_limits<double>::infinity();
        for (int iteration = 0; iteration < MOST_ITERATIONS; ++iteration) {
            for (int64_t i = 0; i < n; ++i) callee.stage()[i] = y[i] + 0.5 * h * k[i];
            callee.at_stage(t + 0.5 * h);
            double change = 0.0, size = 0.0;
            for (int64_t i = 0; i < n; ++i) {
                const double f = callee.f()[i];
                change = std::max(change, std::fabs(f - k[i]));
                size = std::max(size, std::fabs(f));
                k[i] = f;
            }
            if (change == 0.0 || (change >= last && change <= SOLVED * size)) {
                for (int64_t i = 0; i < n; ++i) y[i] += h * k[i];
                return true;
            }
            last = change;
        }
        return false;
    }
};

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
    explicit Unlocked(bool unlocks) {
        if (unlocks) release();
    }

    void look() {
        if (!released_ || Clock::now() < next_) return;
        released_.reset();
        if (PyErr_CheckSignals() < 0) throw nb::python_error();
        release();
        next_ = Clock::now() + PAUSE;
    }

  private:
    using Clock = std::chrono::steady_clock;
    static constexpr std::chrono::milliseconds PAUSE{20};
    void release() { released_ = std::make_unique<WithoutLock>(); }

    std::unique_ptr<WithoutLock> released_;
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

FixedSteps steps_of(nb::handle record, const StatesOf<double, 2> &rows, int64_t n) {
    const nb::object numbers = record.attr("saved");
    const auto saved = nb::cast<ArrayOf<const int64_t, 1>>(numbers);
    const FixedSteps s{number(record.attr("t0")),
                       number(record.attr("h")),
                       number(record.attr("last")),
                       saved.data,
                       saved.shape[0],
                       rows.data};
    bool good = s.rows > 0 && s.saved[0] == 0 && rows.shape[0] == s.rows && rows.shape[1] == n;
    for (int64_t r = 1; good && r < s.rows; ++r) good = s.saved[r] > s.saved[r - 1];
    require(good,
            "take_steps: the numbers of saved steps must increase from 0, and rows must have one row of n numbers for "
            "each");
    return s;
}

void require_scheme(std::string_view name, int64_t n) {
    const bool halves = name == "kick-drift-kick" || name == "drift-kick-drift";
    require((halves && n % 2 == 0) || (name == "boris" && n == 6) || name == "implicit-midpoint",
            "take_steps: unknown scheme, or a state whose size the scheme does not accept (even for kick-drift-kick "
            "and drift-kick-drift, 6 for boris)");
}

int64_t take_steps(const char *name, double constant, nb::object functions, const Buffers &buffers, nb::object record,
                   ArrayOf<double, 1> y, StatesOf<double, 2> rows) {
    nb::list kept;
    const Work &work = buffers.work;
    require(work.m == y.shape[0] && work.n == work.m && rows.type == NPY_DOUBLE && work.stages >= 1,
            "take_steps: work must be real, with the size of y and at least one stage, and rows must be float64");
    require_scheme(name, work.n);
    const FixedSteps steps = steps_of(record, rows, work.n);
    System system;
    std::optional<PythonFunctions> in_python;
    if (truth(functions.attr("native"))) {
        read_pointers(functions, work, {}, 0, kept, system);
    } else {
        in_python.emplace(functions, buffers.owner(), work, NPY_DOUBLE, kept);
        system.python = &*in_python;
    }
    const FloatingPoint mode;
    Callee callee{system, work};
    try {
        Unlocked others(!in_python);
        drive_by_name(name, callee, constant, steps, y.data, others);
    } catch (const Broken &) {
        raise_broken(system);
    }
    return callee.evaluations;
}

}  // namespace

void add_comparators(nb::module_ module) {
    module.def("take_steps", take_steps, "scheme"_a, "constant"_a, "functions"_a, "work"_a, "steps"_a, "y"_a, "rows"_a,
               "Make all steps from the state `y`, which is overwritten, and fill `rows` (saved, n), whose first row "
               "is the start, with the states to save. Return the number of evaluations.");
}

}  // namespace eip
