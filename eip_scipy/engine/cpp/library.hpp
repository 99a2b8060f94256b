// The library's own functions of problems, of one state or of eight members of an ensemble side by side.
#pragma once

#include <span>

#include "octet.hpp"

namespace eip {

// What such a function gets: a state of n numbers, f there for gradients that take it (else null), `out` to fill, and p
// parameters. Octets stand one after the other: n of them are (n, 8) doubles.
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

// A function of `Given` as such a pointer.
template <class T, void (*FUNCTION)(const Given<T> &)>
void plain(double t, const T *y, const T *f, T *out, const T *params, int64_t n, int64_t p) {
    FUNCTION({t, y, f, out, params, n, p});
}

// What its value is: the derivative of the state, of its size, in place; the accelerations at positions; numbers, of
// which one stands for itself; gradients of so many numbers, in place.
enum class Value { DERIVATIVE, ACCELERATION, NUMBERS, GRADIENT, GRADIENT_BY_F };

struct LibraryFunction {
    const char *name;
    Value value;
    int64_t numbers;  // of an invariant
    LibraryPointer<double> one;
    LibraryPointer<Octet> eight;  // null where there is none
    bool (*fits)(int64_t n, int64_t p);
    const char *sizes;  // what fits

    bool is_gradient() const { return value == Value::GRADIENT || value == Value::GRADIENT_BY_F; }
    bool returns() const { return value == Value::ACCELERATION || value == Value::NUMBERS; }
    // Numbers in `out` for a state of n.
    int64_t filled(int64_t n) const {
        if (value == Value::NUMBERS) return numbers;
        return is_gradient() ? numbers * n : n;
    }
};

// Refuses sizes that a function of the library's does not take.
void require_sizes(const LibraryFunction &function, int64_t n, int64_t p);

std::span<const LibraryFunction> kepler_functions();
std::span<const LibraryFunction> gravity_functions();
std::span<const LibraryFunction> force_functions();

}  // namespace eip
