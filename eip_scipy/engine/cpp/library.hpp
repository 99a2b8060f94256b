// The library's own functions of problems, of one state or of eight members of an ensemble side by side.
#pragma once

#include <span>
#include <vector>

#include "lanes8.hpp"

namespace eip {

// Arguments of such a function: a state of n numbers, f there for gradients that take it (else null), `out` to fill, and p
// parameters. Vectors are stored one after the other: n of them are (n, 8) doubles.
template <class T>
struct Given {
    double t;
    const T *y, *f;
    T *out;
    const T *params;
    int64_t n, p;
};

// Such a function fills all of `out` and leaves y, f and params as they are. It throws nothing but std::bad_alloc.
template <class T>
using LibraryPointer = void (*)(double t, const T *y, const T *f, T *out, const T *params, int64_t n, int64_t p);

// Fills `out` with the derivative of a state of n numbers, or with the accelerations at n numbers of positions, and
// `pulls` with the pulls that `accelerate_apart` computes for p bodies.
using ApartPointer = void (*)(const double *y, double *out, double *pulls, const double *params, int64_t n, int64_t p);

// The derivative of a state, the values of all invariants of a run and their gradients in one pass, in which they share their
// terms, with the bits of the functions one by one. Those that are `wanted`, one of the sums in `Wanted`, are filled; returns
// 0, or another number where a function gives up.
enum Wanted { DERIVATIVE_TOO = 1, VALUES_TOO = 2, GRADIENTS_TOO = 4 };
using AllPointer = int (*)(double t, const double *y, double *f, double *values, double *G, const double *params,
                           int wanted);

// Such a pass over functions of the library: a derivative, whose it is, and these invariants.
struct Together {
    AllPointer all;
    std::span<const LibraryPointer<double>> values_alone, gradients_alone;
};

// Fills `out` with a derivative, or accelerations, of a state of at least `least` parameters, and returns the value of the
// invariant `energy` there, both with the bits that they have one by one.
struct WithEnergy {
    double (*both)(const double *y, const double *params, int64_t p, double *out);
    LibraryPointer<double> energy;
    int64_t least;
};

// A function of `Given` as such a pointer.
template <class T, void (*FUNCTION)(const Given<T> &)>
void plain(double t, const T *y, const T *f, T *out, const T *params, int64_t n, int64_t p) {
    FUNCTION({t, y, f, out, params, n, p});
}

// Kind of a function's value: the derivative of the state, in place, of the state's size; the accelerations at
// positions; numbers, of which a single one is returned directly; rates of numbers, which take f; gradients of these
// numbers, in place.
enum class Value { DERIVATIVE, ACCELERATION, NUMBERS, RATES, GRADIENT, GRADIENT_BY_F };

// Stands for the number of numbers of functions that fill N - 1 numbers, one for each orbit of N bodies; k times it
// stands for k numbers for each orbit.
constexpr int64_t EACH_ORBIT = -1;

struct LibraryFunction {
    const char *name;
    Value value;
    int64_t numbers;  // of an invariant
    LibraryPointer<double> one;
    LibraryPointer<Lanes8> eight;  // null where there is none
    bool (*fits)(int64_t n, int64_t p);
    const char *sizes;                          // what fits
    ApartPointer apart = nullptr;               // null where there is none
    LibraryPointer<double> by_pulls = nullptr;  // of rates: from such pulls in the place of f
    const Together *together = nullptr;         // of a derivative; null where there is none
    const WithEnergy *with_energy = nullptr;    // as well
    bool by_parameters = false;  // of numbers: as many for each parameter, see problems/by_parameters.hpp
    std::vector<double> own{};   // parameters that replace those of the run; empty in the library itself

    bool is_gradient() const { return value == Value::GRADIENT || value == Value::GRADIENT_BY_F; }
    bool is_numbers() const { return value == Value::NUMBERS || value == Value::RATES; }
    bool takes_f() const { return value == Value::RATES || value == Value::GRADIENT_BY_F; }
    bool returns() const { return value == Value::ACCELERATION || is_numbers(); }
    // Numbers in `out` for a state of n.
    int64_t filled(int64_t n) const {
        if (is_numbers()) return numbers_of(n);
        return is_gradient() ? numbers_of(n) * n : n;
    }
    int64_t numbers_of(int64_t n) const {
        const int64_t each = by_parameters && !own.empty() ? static_cast<int64_t>(own.back()) : 1;
        return numbers < 0 ? numbers / EACH_ORBIT * (n / 6 - 1) : numbers * each;
    }
};

// Such a function as a run calls it: with its own parameters if it has any, else with those of the run. The object in Python
// that holds them must outlive the call.
template <class T>
struct LibraryCall {
    LibraryPointer<T> pointer = nullptr;
    const T *own = nullptr;
    int64_t n_own = 0;
    ApartPointer apart = nullptr;
    LibraryPointer<T> by_pulls = nullptr;
    const Together *together = nullptr;
    const WithEnergy *with_energy = nullptr;

    explicit operator bool() const { return pointer; }
    [[gnu::always_inline]] void operator()(double t, const T *y, const T *f, T *out, const T *params, int64_t n,
                                           int64_t p) const {
        if (own) [[unlikely]]
            return pointer(t, y, f, out, own, n, n_own);
        pointer(t, y, f, out, params, n, p);
    }
};

// Refuses sizes that a function of the library's does not take.
void require_sizes(const LibraryFunction &function, int64_t n, int64_t p);

std::span<const LibraryFunction> kepler_functions();
std::span<const LibraryFunction> gravity_functions();
std::span<const LibraryFunction> force_functions();
std::span<const LibraryFunction> orbit_functions();
std::span<const LibraryFunction> planet_functions();

}  // namespace eip
