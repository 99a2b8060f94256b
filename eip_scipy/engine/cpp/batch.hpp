// Batch members of an ensemble: their functions, buffers and counters.
#pragma once

#include <bit>

#include "system.hpp"

namespace eip {

// A function of eight members gave up: they run one by one.
struct GaveUp {};

// The functions of eight members: those of a single run, on arrays of vectors.
struct BatchFunctions {
    static constexpr int MEMBERS = LANES;
    Native<ValuePointer, Lanes8> rhs_pointer{};
    std::vector<Native<ValuePointer, Lanes8>> inv_pointers;
    std::vector<Native<GradientPointer, Lanes8>> grad_pointers;
    Native<GradientPointer, Lanes8> jacobian_pointer{};
    bool second_order = false;
    std::vector<Lanes8> params, scratch, scratch_f;

    template <class W>
    void rhs(const W &w, double t, const double *y, double *out) {
        rhs_of_scratch(w, t, rhs_pointer.library ? y : copied(y, scratch), out);
    }

    template <class W>
    void rhs_of_scratch(const W &w, double t, const double *y, double *out) {
        const int64_t half = w.m / 2;
        if (second_order) copy(y + half, out, half);
        call(rhs_pointer, t, y, nullptr, second_order ? out + half : out, rhs_pointer.floats);
    }

    // Computes the accelerations like `System::acceleration`.
    template <class W>
    void acceleration(const W &w, double t, const double *y, double *f, double *a) {
        if (second_order) return call(rhs_pointer, t, y, nullptr, a, rhs_pointer.floats);
        rhs_of_scratch(w, t, y, f);
        copy(f + w.m / 2, a, w.m / 2);
    }

    template <class W>
    void jacobian(const W &, double t, const double *q, const double *dq, double *out, int64_t count) {
        call(jacobian_pointer, t, q, dq, out, count / LANES);
    }

    template <class W>
    void inv(const W &, double t, const Lanes8 *y, Lanes8 *values) {
        call_each(inv_pointers, t, y, nullptr, values);
    }

    template <class W>
    void grad(const W &, double t, const Lanes8 *y, const Lanes8 *f, Lanes8 *G) {
        call_each(grad_pointers, t, y, f, G);
    }

    static Lanes8 *lanes8_of(double *a) { return reinterpret_cast<Lanes8 *>(a); }
    static const Lanes8 *lanes8_of(const double *a) { return reinterpret_cast<const Lanes8 *>(a); }
    static double *floats_of(Lanes8 *a) { return reinterpret_cast<double *>(a); }
    static const double *floats_of(const Lanes8 *a) { return reinterpret_cast<const double *>(a); }

  private:
    int64_t n() const { return std::ssize(scratch); }
    int64_t p() const { return std::ssize(params); }
    static const double *copied(const double *a, std::vector<Lanes8> &own) {
        copy(a, floats_of(own.data()), LANES * static_cast<int64_t>(own.size()));
        return floats_of(own.data());
    }
    // Calls a function at a state of n vectors; f is null if the function does not take it.
    template <class Pointer>
    void call(const Native<Pointer, Lanes8> &function, double t, const double *y, const double *f, double *out,
              int64_t n) {
        const auto &[pointer, library, floats] = function;
        if (library) return library(t, lanes8_of(y), lanes8_of(f), lanes8_of(out), params.data(), n, p());
        fill(lanes8_of(out), NOT_A_NUMBER, floats);
        int status;
        if constexpr (std::is_same_v<Pointer, ValuePointer>)
            status = pointer(t, y, out, floats_of(params.data()));
        else
            status = pointer(t, y, f, out, floats_of(params.data()));
        if (status) throw GaveUp{};
    }
    template <class Calls>
    void call_each(const Calls &functions, double t, const Lanes8 *y, const Lanes8 *f, Lanes8 *out) {
        for (const auto &function : functions) {
            const double *state = floats_of(y), *slope = floats_of(f);
            if (!function.library) state = copied(state, scratch), slope = f ? copied(slope, scratch_f) : slope;
            call(function, t, state, slope, floats_of(out), n());
            out += function.floats;
        }
    }
};

// Batch members: their buffers, as vectors and as 8 n floats, and the state of each.
struct Batch {
    using Run = RunOf<Work, BatchFunctions>;

    Method method;
    Options options, flat_options{};  // those of the run; with tolerances for 8 n floats
    BatchFunctions system;
    std::vector<Lanes8> memory;
    std::vector<double> tolerances, no_norm;
    Multistep multistep{};  // of a multistep method: that of one state of 8 n floats
    int64_t counters[N_COUNTERS] = {};
    WorkOf<Lanes8> work{};
    Work flat{};                               // the same buffers seen as those of one state of 8 n floats
    SizedWith<4, 2, Lanes8> short_work{work};  // the same where it is of that length
    Lanes8 *y, *y_new, *suspects, *levels, *nodes, *sums, *predicted, *change;
    Mask alive{}, corrected{};            // members that are still here; those that the last projection moved
    int64_t first = -1, count = 0;        // the first member, of how many in all
    int64_t own[LANES][N_COUNTERS] = {};  // the counters of each beyond those of all
    int64_t place[N_NODE_PLACES] = {}, projected[LANES] = {};  // of the history; the node of each one's last projection

    Batch(const Method &method, const Options &o, const Work &w, BatchFunctions functions)
        : method(method),
          options(o),
          flat_options(o),
          system(std::move(functions)),
          no_norm(1) {
        const int64_t n = w.n, l = w.l, products = o.frame.rows;
        work.n = work.m = n;
        work.l = l;
        work.stages = w.stages;
        const Multistep *ms = method.multistep;
        const int64_t half = ms ? ms->half : 0, nodes_kept = ms ? ms->rows : 0;
        Places places;
        places.sizes.blocks = o.blocks.count;
        work.fields(places);
        places.add(work.target, l, work.products, products, y, n, y_new, n, suspects, work.suspect_size(), levels,
                   3 * l, nodes, nodes_kept * half, sums, 4 * half, predicted, 3 * half, change, half);
        memory.resize(places.total, Lanes8(0.0));
        Lanes8 *next = memory.data();
        for (const auto &[place, count] : places.of) {
            *place = next;
            next += count;
        }
        work.counters = counters;
        work.norm = no_norm.data();
        short_work = SizedWith<4, 2, Lanes8>(work);
        flat = std::bit_cast<Work>(work);
        flat.n = flat.m = LANES * n;
        tolerances.resize(2 * LANES * n);
        for (int64_t i = 0; i < LANES * n; ++i) {
            tolerances[i] = o.rtol[i / LANES];
            tolerances[LANES * n + i] = o.atol[i / LANES];
        }
        flat_options.rtol = tolerances.data();
        flat_options.atol = tolerances.data() + LANES * n;
        if (ms) lengthen(*ms, nodes_kept);
    }

    Run run() { return {method, flat_options, flat, system, nullptr}; }

    // Conversion of one member's part of n vectors to floats and back.
    static void take(const Lanes8 *a, int64_t lane, double *out, int64_t n) {
        for (int64_t i = 0; i < n; ++i) out[i] = BatchFunctions::floats_of(a)[LANES * i + lane];
    }
    static void give(const double *a, int64_t lane, Lanes8 *out, int64_t n) {
        for (int64_t i = 0; i < n; ++i) BatchFunctions::floats_of(out)[LANES * i + lane] = a[i];
    }

    // Call `move` with each buffer that a projection changes for the next one, of all members and of one, and its length.
    template <class Move>
    void each_carried(const Work &one, const Move &move) const {
        move(work.sigma, one.sigma, one.m);
        move(work.memory, one.memory, MEMORIES * options.blocks.count);
        move(work.trust, one.trust, one.l * N_FIGURES);
        move(work.max_residual, one.max_residual, one.l);
        move(work.max_correction, one.max_correction, 1);
        move(suspects, one.suspect, one.suspect_size());
    }

    // The counters of one member if all members have counted `shared`.
    void count_of(int64_t lane, const int64_t *shared, int64_t *out) const {
        for (int c = 0; c < N_COUNTERS; ++c) out[c] = shared[c] + own[lane][c];
    }

    // Calls `action` for each of those members. One for which it fails is removed: it must be run alone.
    template <class Action>
    void each_alone(const Mask &those, const Action &action) {
        for (int64_t lane = 0; any(those) && lane < LANES; ++lane) {
            if (!those.lane(lane)) continue;
            bool good = false;
            try {
                good = action(lane);
            } catch (const Broken &) {
            }
            if (!good) alive.set(lane, false);
        }
    }

  private:
    // Starts and lengths of the buffers of vectors; other buffers of a run do not belong to its members.
    struct Places {
        Sizes sizes;
        std::vector<std::pair<Lanes8 **, int64_t>> of;
        int64_t total = 0;

        template <class... Others>
        void add(Lanes8 *&place, int64_t count, Others &&...others) {
            of.emplace_back(&place, count);
            total += count;
            if constexpr (sizeof...(others) > 0) add(others...);
        }
        void operator()(const char *, Lanes8 *&place, auto... lengths) { add(place, (int64_t{1} * ... * lengths)); }
        void states(const char *, Lanes8 *&place, auto... lengths) { add(place, (int64_t{1} * ... * lengths)); }
        template <class Other>
        void operator()(const char *, Other *&, auto...) {}
    };

    // The history of one state of 8 n floats.
    void lengthen(const Multistep &one, int64_t rows) {
        multistep = one;
        multistep.half = multistep.pitch = LANES * one.half;
        multistep.rows = rows;
        multistep.corrected_first *= LANES;
        multistep.corrected_count *= LANES;
        multistep.nodes = BatchFunctions::floats_of(nodes);
        multistep.sums = BatchFunctions::floats_of(sums);
        multistep.predicted = BatchFunctions::floats_of(predicted);
        multistep.change = BatchFunctions::floats_of(change);
        multistep.levels = BatchFunctions::floats_of(levels);
        multistep.place = place;
        method.multistep = &multistep;
    }
};

}  // namespace eip
