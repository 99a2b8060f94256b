// The user's functions as the step calls them, and what a step knows of its run.
#pragma once

#include <type_traits>
#include <vector>

#include "data.hpp"
#include "differences.hpp"
#include "floats.hpp"
#include "library.hpp"

namespace eip {

// A function that failed; see `System::failed`.
struct Broken {};

// Functions by pointer. They return 0; > 0: no value here, a shorter step may have one; < 0: the run is to end. Complex
// states are pairs of floats. `y` and `f` are scratch.
using ValuePointer = int (*)(double t, const double *y, double *out, const double *params);
using GradientPointer = int (*)(double t, const double *y, const double *f, double *G, const double *params);

// Gradients that are made from the derivative f = (v, a) of a state of 2 `pairs` floats instead of being computed: the
// gradient of value i of the invariants is (-M a, M v), with M = masses[i * pairs ...], or is not one of them if M is NaN.
struct FromF {
    const double *masses = nullptr;
    int64_t pairs = 0;

    bool has(int64_t i) const { return pairs > 0 && !std::isnan(masses[i * pairs]); }

    // Fills the row G of value i.
    void fill_row(int64_t i, const double *f, double *G) const {
        for (int64_t k = 0; k < pairs; ++k) {
            const double mass = masses[i * pairs + k];
            G[k] = -mass * f[pairs + k];
            G[pairs + k] = mass * f[k];
        }
    }
};

// Functions in Python, of these kinds; of a balance without a rate of its own there is none of the last one.
enum Functions { VALUES, GRADIENTS, EVENTS, RATES, N_FUNCTIONS };
class CalledFunctions {
  public:
    virtual ~CalledFunctions() = default;
    virtual void rhs(double t, const double *y, double *out) = 0;
    virtual void jacobian(double t, const double *q, const double *dq, double *out) = 0;
    // All functions of a kind; the gradients but those that are known; and one function.
    virtual void all(Functions kind, double t, const double *y, const double *f, double *out) = 0;
    virtual void gradients(double t, const double *y, const double *f, double *G, const FromF &known) = 0;
    virtual void one(Functions kind, int64_t k, double t, const double *y, const double *f, double *out) = 0;
};

struct Step;

// The quantities that are known at the raw result of a step when its derivative has been computed: none, the value of one
// invariant, which is System::energy, or values and gradients of all.
enum class Known { NOTHING, ENERGY, ALL };

// Parts of a step that Python code replaces: the raw step of a user-defined one-step method, and the joint projection of
// a field, which may decline. The codes are those of the step. If `drives`, the raw step is that of a solver which
// controls its error and its length: `drive` makes it, and with `again` repeats one whose projection has failed.
class Hooks {
  public:
    virtual ~Hooks() = default;
    bool raw = false, drives = false, joint = false;
    virtual int drive(double t, const double *y, bool again, double *clock) = 0;
    virtual int raw_step(const Step &step) = 0;
    virtual bool project_jointly(const Step &step) = 0;
};

// A function by pointer, or the library's own in its place, and how many floats it fills.
template <typename Pointer, class Value = double>
struct Native {
    Pointer pointer;
    LibraryCall<Value> library;
    int64_t floats;
};

// A balance: its place among the functions of the invariants, how many values it has, and its rate by pointer. Without a
// rate of its own it changes at the rate of its gradient along the flow and of its explicit dependence on time.
struct Balance {
    int64_t item = 0, floats = 0;
    bool is_given = false;
    Native<GradientPointer> rate{};
};

// A call by pointer that failed: the kind of the function, its index among the functions of that kind, its arguments,
// and the status that it returned.
struct FailedCall {
    const char *functions = "";
    int64_t index = 0;
    double t = 0.0;
    std::vector<double> y, f;
    int status = 0;
};

// The length of a state, in the place of the buffers of a run.
struct Length {
    int64_t m;
};

// The functions of a run, by pointer or in Python: all of them, or of a run by pointer the events.
struct System {
    static constexpr int MEMBERS = 1;
    Native<ValuePointer> rhs_pointer{};
    std::vector<Native<ValuePointer>> inv_pointers, event_pointers;
    std::vector<Native<GradientPointer>> grad_pointers;
    Native<GradientPointer> jacobian_pointer{};
    CalledFunctions *python = nullptr;
    bool by_pointer = false;
    bool second_order = false;  // rhs_pointer gives the accelerations of y = (q, v)
    std::vector<Balance> balances;
    Times times;  // for derivatives in time
    double *params = nullptr;
    int64_t n_params = 0;
    std::vector<double> scratch, scratch_f, scratch_G, state, slope_of_state;
    std::vector<double> pulls;  // those that come with accelerations
    bool rates_by_pulls = false;
    AllPointer jitted_together = nullptr;  // of a user's functions
    AllPointer together = nullptr;         // where one pass gives all functions of the run
    std::vector<double> f_at_end;          // by such a pass, where `has_f_at_end`: the derivative at the end of a step
    bool has_f_at_end = false;
    const WithEnergy *with_energy = nullptr;  // where the invariant `energy_item` is one that comes with the derivative
    int64_t energy_item = 0;
    double energy = 0.0;
    Known at_raw = Known::NOTHING;
    Shifts shifts;  // for gradients without a function
    FailedCall failed;
    // The description of the columns, in runs by pointer whose states have columns of derivatives behind them;
    // otherwise null. The functions of the invariants then take the state alone, and so does `rhs_pointer` if
    // `takes_state`. `by_parameters` are the derivatives of all invariants with respect to the parameters behind the
    // state, (l, parameters).
    const Columns *columns = nullptr;
    bool takes_state = false;
    std::vector<Native<ValuePointer>> by_parameters;

    // The derivative at a state that is kept.
    template <class W>
    void rhs(const W &w, double t, const double *y, double *out) {
        if (!by_pointer) return python->rhs(t, y, out);
        if (columns) [[unlikely]]
            return rhs_with_columns(w.m, t, y, out);
        call_rhs(w, t, rhs_pointer.library ? y : copied(y, scratch, w.m), out);
    }

    // The derivative with those of all columns, also for the state alone, behind which the columns are.
    template <class W>
    void rhs_of_whole(const W &w, double t, const double *y, double *out) {
        if (columns) [[unlikely]]
            return rhs_with_columns(columns->wide(), t, y, out);
        rhs(w, t, y, out);
    }

    // The derivative at a state that is made anew for each call.
    template <class W>
    [[gnu::always_inline]] void rhs_of_scratch(const W &w, double t, const double *y, double *out) {
        if (!by_pointer) return python->rhs(t, y, out);
        call_rhs(w, t, y, out);
    }

    // The second half of the derivative at such a state (q, v) into `a`, by way of `f` where it comes with the first.
    template <class W>
    void acceleration(const W &w, double t, const double *y, double *f, double *a) {
        if (by_pointer && second_order) return call_rhs_pointer(w, t, y, a, w.m / 2);
        rhs_of_scratch(w, t, y, f);
        copy(f + w.m / 2, a, w.m / 2);
    }

    // Computes what is `wanted` at a state, its derivative into f, in one pass. False where there is no such pass, or it gives up:
    // the functions have to be called one by one, and that one which fails is then known.
    template <class W>
    [[gnu::always_inline]] bool in_one_pass(const W &w, double t, const double *y, double *f, int wanted) {
        return together && together(t, y, f, w.values, w.G, params, wanted) == 0;
    }

    // Computes the derivative at the raw result of a step that will be projected, and the quantities that the same pass gives.
    template <class W>
    void evaluate_for_projection(const W &w, double t, const double *y, double *out) {
        if (in_one_pass(w, t, y, out, DERIVATIVE_TOO + VALUES_TOO + GRADIENTS_TOO)) {
            at_raw = Known::ALL;
        } else if (with_energy) {
            const int64_t half = second_order ? w.m / 2 : 0;
            copy(y + half, out, half);
            energy = with_energy->both(y, params, n_params, out + half);
            at_raw = Known::ENERGY;
        } else {
            rhs(w, t, y, out);
        }
    }

    // The values at the raw result of a step, where `known` says what of them is known.
    template <class W>
    void inv_at_raw(const W &w, double t, const double *y, double *values, Known known) {
        if (known == Known::ALL) return;
        if (known == Known::NOTHING) return inv(w, t, y, values);
        for (int64_t k = 0; k < std::ssize(inv_pointers); ++k) {
            if (k == energy_item)
                values[0] = energy;
            else
                call_kept(w, inv_pointers[k], "inv", k, t, y, nullptr, values);
            values += inv_pointers[k].floats;
        }
    }

    template <class W>
    void inv(const W &w, double t, const double *y, double *values) {
        if (together && together(t, y, nullptr, values, nullptr, params, VALUES_TOO) == 0) return;
        if (!by_pointer) return python->all(VALUES, t, y, nullptr, values);
        if (columns) [[unlikely]]
            return call_each(Length{columns->seen}, inv_pointers, "inv", t, state_of(y, state), values);
        call_each(w, inv_pointers, "inv", t, y, values);
    }

    template <class W>
    void event(const W &w, double t, const double *y, double *values) {
        if (python) return python->all(EVENTS, t, y, nullptr, values);
        if (columns) [[unlikely]]
            return call_each(Length{columns->seen}, event_pointers, "event", t, state_of(y, state), values);
        call_each(w, event_pointers, "event", t, y, values);
    }

    template <class W>
    void grad(const W &w, double t, const double *y, const double *f, double *G) {
        if (!by_pointer) return python->all(GRADIENTS, t, y, f, G);
        if (columns) [[unlikely]]
            return grad_with_columns(w.m, t, y, f, G);
        each_gradient(w, t, y, f, G);
    }

    // Compute the gradients, some of which are made from f, of a run whose states have no columns.
    template <class W>
    [[gnu::noinline]] void grad(const W &w, double t, const double *y, const double *f, double *G, const FromF &known) {
        if (by_pointer)
            each_gradient(w, t, y, f, G, known);
        else
            python->gradients(t, y, f, G, known);
        for (int64_t i = 0; i < w.l; ++i)
            if (known.has(i)) known.fill_row(i, f, G + i * w.m);
    }

    // The rates of all balances, where f is the derivative at y.
    template <class W>
    [[gnu::noinline]] void rates(const W &w, double t, const double *y, const double *f, double *out) {
        for (int64_t b = 0; b < std::ssize(balances); ++b) {
            const Balance &balance = balances[b];
            if (!balance.is_given)
                rate_along_flow(w, balance, t, y, f, out);
            else if (!by_pointer)
                python->one(RATES, b, t, y, f, out);
            else
                call_kept(w, balance.rate, "rate", b, t, y, f, out);
            out += balance.floats;
        }
    }

    // Chooses functions that share intermediate results. Parameters may change from one run to the next.
    void choose() {
        choose_rates();
        choose_together();
        choose_energy();
    }

    // Sets `together` if these are a user's functions, or those of a problem, with one pass for all of them.
    void choose_together() {
        const Together *known = rhs_pointer.library.together;
        const auto same = [](const auto &functions, std::span<const LibraryPointer<double>> alone) {
            return std::equal(functions.begin(), functions.end(), alone.begin(), alone.end(),
                              [](const auto &a, auto b) { return a.library.pointer == b && !a.library.own; });
        };
        const bool all = by_pointer && known && !columns && same(inv_pointers, known->values_alone) &&
                         same(grad_pointers, known->gradients_alone);
        together = all ? known->all : jitted_together;
    }

    // Sets `with_energy` if one of the invariants comes with the derivative, in a run without columns.
    void choose_energy() {
        const WithEnergy *known = rhs_pointer.library.with_energy;
        with_energy = nullptr;
        if (!by_pointer || !known || columns || rhs_pointer.library.own || n_params < known->least) return;
        for (energy_item = 0; energy_item < std::ssize(inv_pointers); ++energy_item) {
            const LibraryCall<double> &library = inv_pointers[energy_item].library;
            if (library.pointer != known->energy || library.own) continue;
            with_energy = known;
            return;
        }
    }

    // Sets `rates_by_pulls` if all rates are found from the pulls that come with the derivative: those of the same masses.
    void choose_rates() {
        const double *first = params, *end = params + n_params;
        rates_by_pulls = by_pointer && rhs_pointer.library.apart && !balances.empty() && n_params > 0;
        for (const Balance &balance : balances) {
            const LibraryCall<double> &rate = balance.rate.library;
            rates_by_pulls =
                rates_by_pulls && rate.by_pulls && rate.n_own >= n_params && std::equal(first, end, rate.own);
        }
    }

    // The derivative at a state that is kept, and the rates there.
    template <class W>
    void rhs_and_rates(const W &w, double t, const double *y, double *out, double *rates_out) {
        if (!rates_by_pulls) {
            rhs(w, t, y, out);
            return rates(w, t, y, out, rates_out);
        }
        const int64_t half = w.m / 2;
        if (second_order) copy(y + half, out, half);
        accelerate_with_pulls(w, y, second_order ? out + half : out);
        rates_from_pulls(w, t, y, rates_out);
    }

    // With `rates_by_pulls`: the derivative, or in systems of second order the accelerations, and `pulls`.
    template <class W>
    void accelerate_with_pulls(const W &w, const double *y, double *out) {
        rhs_pointer.library.apart(y, out, pulls.data(), params, second_order ? w.m / 2 : w.m, n_params);
    }

    // Computes the rates of all balances from `pulls`, at the state (q, v) for which `accelerate_with_pulls` computed
    // them.
    template <class W>
    void rates_from_pulls(const W &w, double t, const double *y, double *out) {
        for (const Balance &balance : balances) {
            const LibraryCall<double> &rate = balance.rate.library;
            rate.by_pulls(t, y, pulls.data(), out, rate.own, w.m, rate.n_own);
            out += balance.floats;
        }
    }

    // Explicit time derivative of a balance at the state y.
    template <class W>
    void rate_in_time(const W &w, const Balance &balance, double t, const double *y, double *out) {
        const auto values_at = [&](double time, double *values) { inv_of(w, balance.item, time, y, values); };
        time_difference(values_at, t, balance.floats, times, out);
    }

    // Jacobian of the accelerations at positions q, times dq; all three of half a state's length, and q and dq scratch. Only the
    // first `count` entries of dq are not 0, and only these of the product are wanted.
    template <class W>
    void jacobian(const W &w, double t, const double *q, const double *dq, double *out, int64_t count) {
        if (!by_pointer) return python->jacobian(t, q, dq, out);
        call<false>(jacobian_pointer, "jacobian", 0, w.m / 2, count, w.m / 2, t, q, dq, out);
    }

  private:
    // Derivative of the state alone if m is its length and the function accepts it, or of the state with its columns.
    void rhs_with_columns(int64_t m, double t, const double *y, double *out) {
        const int64_t wide = columns->wide(), length = takes_state && m == columns->size ? m : wide;
        call_rhs(Length{length}, t, rhs_pointer.library ? y : copied(y, scratch, wide), out);
    }

    // The numbers of the state in one with columns behind it.
    const double *state_of(const double *y, std::vector<double> &own) const {
        const int64_t half = columns->half;
        if (half == 0 || !y) return y;
        copy(y, own.data(), half);
        copy(y + columns->second(-1), own.data() + half, columns->seen - half);
        return own.data();
    }

    // Rows of m numbers, m being the length of the state with its parameters or with its columns too: of the derivatives by the
    // state, which the functions give one after the other, and by the parameters; 0 elsewhere.
    [[gnu::noinline]] void grad_with_columns(int64_t m, double t, const double *y, const double *f, double *G) {
        const int64_t n = columns->seen, p = columns->size - n, first = columns->half > 0 ? columns->half : n;
        const double *at = state_of(y, state), *slope = state_of(f, slope_of_state);
        each_gradient(Length{n}, t, at, slope, G);
        if (p > 0) call_each(Length{n}, by_parameters, "by_parameters", t, at, scratch_G.data());
        if (m == n) return;
        for (int64_t i = rows_of_gradients(n) - 1; i >= 0; --i) {
            double *row = G + i * m, *second = row + (columns->half > 0 ? columns->second(-1) : n);
            std::memmove(second, G + i * n + first, (n - first) * sizeof(double));
            std::memmove(row, G + i * n, first * sizeof(double));
            if (p > 0) copy(scratch_G.data() + i * p, second, p);
            double *behind = second + (n - first) + p;
            fill(row + first, 0.0, second - (row + first));
            fill(behind, 0.0, row + m - behind);
        }
    }

    int64_t rows_of_gradients(int64_t n) const {
        int64_t floats = 0;
        for (const auto &grad : grad_pointers) floats += grad.floats;
        return floats / n;
    }

    template <class W>
    [[gnu::always_inline]] void each_gradient(const W &w, double t, const double *y, const double *f, double *G,
                                              const FromF &known = {}) {
        for (int64_t k = 0, i = 0; k < std::ssize(grad_pointers); ++k) {
            if (!known.has(i)) grad_by_pointer(w, k, t, y, f, G);
            G += grad_pointers[k].floats;
            if (known.pairs > 0) i += grad_pointers[k].floats / w.m;
        }
    }

    template <class W>
    void rate_along_flow(const W &w, const Balance &balance, double t, const double *y, const double *f, double *out) {
        double *G = scratch_G.data();
        rate_in_time(w, balance, t, y, out);
        if (by_pointer)
            grad_by_pointer(w, balance.item, t, y, f, G);
        else
            python->one(GRADIENTS, balance.item, t, y, f, G);
        for (int64_t i = 0; i < balance.floats; ++i) out[i] += dot(G + i * w.m, f, w.m);
    }

    template <class W>
    void inv_of(const W &w, int64_t k, double t, const double *y, double *values) {
        if (!by_pointer) return python->one(VALUES, k, t, y, nullptr, values);
        call_kept(w, inv_pointers[k], "inv", k, t, y, nullptr, values);
    }

    template <class W>
    [[gnu::always_inline]] void grad_by_pointer(const W &w, int64_t k, double t, const double *y, const double *f,
                                                double *G) {
        const Native<GradientPointer> &grad = grad_pointers[k];
        if (!grad.pointer && !grad.library) return grad_by_differences(w, k, t, y, G);
        call_kept(w, grad, "grad", k, t, y, f, G);
    }

    // Calls a function at y and f, of m numbers each; f is null if the function does not take it. A function of the library
    // gets n as their length, another one copies of those that are KEPT.
    template <bool KEPT, class Pointer>
    [[gnu::always_inline]] void call(const Native<Pointer> &function, const char *name, int64_t k, int64_t m, int64_t n,
                                     int64_t floats, double t, const double *y, const double *f, double *out) {
        if (function.library) return function.library(t, y, f, out, params, n, n_params);
        fill(out, NOT_A_NUMBER, floats);  // shows where a function leaves a part of it as it was
        const double *state = KEPT ? copied(y, scratch, m) : y;
        int status;
        if constexpr (std::is_same_v<Pointer, ValuePointer>)
            status = function.pointer(t, state, out, params);
        else
            status = function.pointer(t, state, KEPT ? copied(f, scratch_f, m) : f, out, params);
        if (status) [[unlikely]]
            gave_up(status, name, k, t, y, f, m, out, floats);
    }

    template <class W, class Pointer>
    [[gnu::always_inline]] void call_kept(const W &w, const Native<Pointer> &function, const char *name, int64_t k,
                                          double t, const double *y, const double *f, double *out) {
        call<true>(function, name, k, w.m, w.m, function.floats, t, y, f, out);
    }

    static const double *copied(const double *y, std::vector<double> &own, int64_t m) {
        copy(y, own.data(), m);
        return own.data();
    }

    template <class W>
    [[gnu::always_inline]] void call_rhs(const W &w, double t, const double *y, double *out) {
        if (!second_order) return call_rhs_pointer(w, t, y, out, w.m);
        copy(y + w.m / 2, out, w.m / 2);
        call_rhs_pointer(w, t, y, out + w.m / 2, w.m / 2);
    }

    template <class W>
    [[gnu::always_inline]] void call_rhs_pointer(const W &w, double t, const double *y, double *out, int64_t floats) {
        call<false>(rhs_pointer, "rhs", 0, w.m, floats, floats, t, y, nullptr, out);
    }

    template <class W>
    void call_each(const W &w, const std::vector<Native<ValuePointer>> &functions, const char *name, double t,
                   const double *y, double *values) {
        for (int64_t k = 0; k < std::ssize(functions); ++k) {
            call_kept(w, functions[k], name, k, t, y, nullptr, values);
            values += functions[k].floats;
        }
    }

    template <class W>
    [[gnu::cold, gnu::noinline]] void grad_by_differences(const W &w, int64_t k, double t, const double *y, double *G) {
        const Native<ValuePointer> &inv = inv_pointers[k];
        const auto values_at = [&](double *state, double *out) {
            call<false>(inv, "inv", k, w.m, w.m, inv.floats, t, state, nullptr, out);
        };
        difference_gradient(values_at, y, inv.floats, shifts, G);
    }

    [[gnu::cold, gnu::noinline]] void gave_up(int status, const char *name, int64_t k, double t, const double *y,
                                              const double *f, int64_t m, double *out, int64_t floats) {
        if (status > 0) return fill(out, NOT_A_NUMBER, floats);
        failed = {name, k, t, {y, y + m}, {f, f ? f + m : f}, status};
        throw Broken{};
    }
};

// One run: K[0] holds f(t, y) when a step begins. W is Work, or one of a length that the compiler knows.
template <class W, class Called = System>
struct RunOf {
    const typename W::Method &method;
    const typename W::Options &options;
    const W &work;
    Called &system;
    Hooks *hooks;
};

using Run = RunOf<Work>;

// Computes f at the state y, and counts the evaluation.
template <class AnyRun>
inline void evaluate_f(const AnyRun &run, double t, const double *y, double *f) {
    run.system.rhs(run.work, t, y, f);
    ++run.work.counters[NFEV];
}

// True if a run is one of a single state: batches of members have no balances, and no gradients from f.
template <class AnyRun>
constexpr bool IS_SINGLE = std::remove_cvref_t<decltype(std::declval<AnyRun>().system)>::MEMBERS == 1;

// Return what the run makes gradients of; it is empty after a projection that has refuted them.
template <class AnyRun>
inline FromF from_f(const AnyRun &run) {
    if (run.options.pairs == 0 || !run.work.counters[FROM_F]) return {};
    return {run.options.masses, run.options.pairs};
}

// Compute the gradients at y, where the derivative is f.
template <class AnyRun, class Value>
inline void gradients(const AnyRun &run, double t, const Value *y, const Value *f, Value *G) {
    if constexpr (IS_SINGLE<AnyRun>)
        if (const FromF known = from_f(run); known.pairs > 0) return run.system.grad(run.work, t, y, f, G, known);
    run.system.grad(run.work, t, y, f, G);
}

// Uses the code for states of any length.
template <class W, class Called>
inline RunOf<Work, Called> of_any_length(const RunOf<W, Called> &run) {
    return {run.method, run.options, run.work, run.system, run.hooks};
}

// A short real state, most of whose time goes into loops' beginnings and ends.
template <int64_t M, class Value = double>
struct Sized : WorkOf<Value> {
    explicit Sized(const WorkOf<Value> &w) : WorkOf<Value>(w) {}
    static constexpr int64_t n = M, m = M;
};

// A short real state whose number of invariants is also known to the compiler.
template <int64_t M, int64_t L, class Value = double>
struct SizedWith : Sized<M, Value> {
    explicit SizedWith(const WorkOf<Value> &w) : Sized<M, Value>(w) {}
    static constexpr int64_t l = L;
};

// Options and method of a run by a one-step method without what most runs leave out, so that the compiler leaves it out, too:
// adaptive steps, steps that are not projected, further Newton steps, balances, frames, columns and carried sums.
struct PlainOptions : Options {
    explicit PlainOptions(const Options &o) : Options(o) {}
    static constexpr Frame frame{};
    static constexpr Balances balances{};
    static constexpr Groups balance_groups{};
    static constexpr Columns columns{};
    static constexpr int64_t direction = NEW, iterations = 1, every = 1, pairs = 0;
    static constexpr bool has_limits = false, compensated = false, adaptive = false;
};
struct PlainMethod : Method {
    explicit PlainMethod(const Method &m) : Method(m) {}
    static constexpr bool nystrom = false, paired = false;
    static constexpr const Multistep *multistep = nullptr;
};

inline bool is_plain(const Method &m, const Options &o) {
    const bool whole = o.frame.rows == 0 && o.balances.count == 0 && o.balance_groups.count == 0 &&
                       o.columns.count == 0 && o.pairs == 0;
    const bool once = o.direction == NEW && o.iterations == 1 && o.every == 1 && !o.has_limits;
    return whole && once && !o.compensated && !o.adaptive && !m.nystrom && !m.paired && !m.multistep;
}

// A short state in such a run.
template <int64_t M, int64_t L>
struct Plain : SizedWith<M, L> {
    using Method = PlainMethod;
    using Options = PlainOptions;
    explicit Plain(const Work &w) : SizedWith<M, L>(w) {}
    static constexpr int64_t balances = 0;
};

// One try of a step from (t, y).
struct Step {
    double t, t_new, h;
    const double *y;
    double *y_new;
    bool project, last;
    bool avoids_singular = false;  // the step is given up if it ends next to a singular position
};

}  // namespace eip
