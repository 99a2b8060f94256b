// The functions of eight members of an ensemble.
#pragma once

#include "system.hpp"

namespace eip {

// A function of eight members gave up: they run one by one.
struct GaveUp {};

// The functions of eight members: those of a single run, on arrays of vectors.
struct OctetSystem {
    static constexpr int MEMBERS = LANES;
    Native<ValuePointer, Octet> rhs_pointer{};
    std::vector<Native<ValuePointer, Octet>> inv_pointers;
    std::vector<Native<GradientPointer, Octet>> grad_pointers;
    Native<GradientPointer, Octet> jacobian_pointer{};
    bool second_order = false;
    std::vector<Octet> params, scratch, scratch_f;

    template <class W>
    void rhs(const W &w, double t, const double *y, double *out) {
        rhs_of_scratch(w, t, rhs_pointer.library ? y : copied(y, scratch), out);
    }

    template <class W>
    void rhs_of_scratch(const W &w, double t, const double *y, double *out) {
        const int64_t half = w.m / 2, floats = second_order ? half : w.m;
        if (second_order) {
            copy(y + half, out, half);
            out += half;
        }
        if (rhs_pointer.library)
            return rhs_pointer.library(t, octets_of(y), nullptr, octets_of(out), params.data(), floats / LANES, p());
        fill(out, NOT_A_NUMBER, floats);
        require(rhs_pointer.pointer(t, y, out, floats_of(params.data())));
    }

    // Computes the accelerations like `System::acceleration`.
    template <class W>
    void acceleration(const W &w, double t, const double *y, double *f, double *a) {
        const int64_t half = w.m / 2;
        if (second_order && rhs_pointer.library)
            return rhs_pointer.library(t, octets_of(y), nullptr, octets_of(a), params.data(), half / LANES, p());
        rhs_of_scratch(w, t, y, f);
        copy(f + half, a, half);
    }

    template <class W>
    void jacobian(const W &w, double t, const double *q, const double *dq, double *out, int64_t count) {
        const auto &[pointer, library, octets] = jacobian_pointer;
        if (library) return library(t, octets_of(q), octets_of(dq), octets_of(out), params.data(), count / LANES, p());
        fill(out, NOT_A_NUMBER, w.m / 2);
        require(pointer(t, q, dq, out, floats_of(params.data())));
    }

    template <class W>
    void inv(const W &, double t, const Octet *y, Octet *values) {
        call_each(inv_pointers, t, y, nullptr, values, [&](auto pointer, double *out) {
            return pointer(t, copied(floats_of(y), scratch), out, floats_of(params.data()));
        });
    }

    template <class W>
    void grad(const W &, double t, const Octet *y, const Octet *f, Octet *G) {
        call_each(grad_pointers, t, y, f, G, [&](auto pointer, double *out) {
            const double *state = copied(floats_of(y), scratch), *slope = copied(floats_of(f), scratch_f);
            return pointer(t, state, slope, out, floats_of(params.data()));
        });
    }

    static Octet *octets_of(double *a) { return reinterpret_cast<Octet *>(a); }
    static const Octet *octets_of(const double *a) { return reinterpret_cast<const Octet *>(a); }
    static double *floats_of(Octet *a) { return reinterpret_cast<double *>(a); }
    static const double *floats_of(const Octet *a) { return reinterpret_cast<const double *>(a); }

  private:
    int64_t n() const { return std::ssize(scratch); }
    int64_t p() const { return std::ssize(params); }
    static const double *copied(const double *a, std::vector<Octet> &own) {
        copy(a, floats_of(own.data()), LANES * static_cast<int64_t>(own.size()));
        return floats_of(own.data());
    }
    static void require(int status) {
        if (status) throw GaveUp{};
    }
    template <class Calls, class ByPointer>
    void call_each(const Calls &functions, double t, const Octet *y, const Octet *f, Octet *out,
                   const ByPointer &by_pointer) {
        for (const auto &[pointer, library, octets] : functions) {
            if (library) {
                library(t, y, f, out, params.data(), n(), p());
            } else {
                fill(out, NOT_A_NUMBER, octets);
                require(by_pointer(pointer, floats_of(out)));
            }
            out += octets;
        }
    }
};

}  // namespace eip
