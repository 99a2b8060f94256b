// Eight members of an ensemble: their functions, buffers and counters.
#pragma once

#include <functional>
#include <numeric>

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
    void inv(const W &, double t, const Octet *y, Octet *values) {
        call_each(inv_pointers, t, y, nullptr, values);
    }

    template <class W>
    void grad(const W &, double t, const Octet *y, const Octet *f, Octet *G) {
        call_each(grad_pointers, t, y, f, G);
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
    // Calls a function at a state of n vectors; f is null if the function does not take it.
    template <class Pointer>
    void call(const Native<Pointer, Octet> &function, double t, const double *y, const double *f, double *out,
              int64_t n) {
        const auto &[pointer, library, octets] = function;
        if (library) return library(t, octets_of(y), octets_of(f), octets_of(out), params.data(), n, p());
        fill(octets_of(out), NOT_A_NUMBER, octets);
        int status;
        if constexpr (std::is_same_v<Pointer, ValuePointer>)
            status = pointer(t, y, out, floats_of(params.data()));
        else
            status = pointer(t, y, f, out, floats_of(params.data()));
        if (status) throw GaveUp{};
    }
    template <class Calls>
    void call_each(const Calls &functions, double t, const Octet *y, const Octet *f, Octet *out) {
        for (const auto &function : functions) {
            const double *state = floats_of(y), *slope = floats_of(f);
            if (!function.library) state = copied(state, scratch), slope = f ? copied(slope, scratch_f) : slope;
            call(function, t, state, slope, floats_of(out), n());
            out += function.floats;
        }
    }
};

// Eight members: their buffers, as vectors and as 8 n floats, and the state of each.
struct Eight {
    using Run = RunOf<Work, OctetSystem>;

    Method method;
    Options options;  // those of the run, tolerances for 8 n floats
    OctetSystem system;
    std::vector<Octet> memory;
    std::vector<double> tolerances, no_norm, suspects;  // the last of all members, one after the other
    Multistep multistep{};                              // of a multistep method: that of one state of 8 n floats
    int64_t counters[N_COUNTERS] = {};
    Work flat{};
    WorkOf<Octet> work{};
    SizedWith<4, 2, Octet> short_work{work};  // the same where it is of that length
    Octet *y, *y_new, *projections, *skips, *reduced, *levels, *nodes, *sums, *predicted, *change;
    // Members that are still here; their counters beyond those of all; rank of the last projection.
    bool alive[LANES] = {};
    int64_t first = -1, count = 0;  // the first of them, of how many in all
    int64_t step = 0, row = 0;      // the next step, and the next row to be saved
    int64_t own[LANES][N_COUNTERS] = {}, rank[LANES] = {};
    int64_t place[N_NODE_PLACES] = {}, projected[LANES] = {};  // of the history; the node of each one's last projection

    Eight(const Method &method, const Options &o, const Work &w, OctetSystem functions)
        : method(method),
          options(o),
          system(std::move(functions)),
          no_norm(1) {
        const int64_t n = w.n, l = w.l, blocks = o.blocks.count, products = o.frame.rows;
        work.n = work.m = n;
        work.l = l;
        work.stages = w.stages;
        const Multistep *ms = method.multistep;
        const int64_t half = ms ? ms->half : 0, nodes_kept = ms ? ms->rows : 0;
        Places places;
        each_buffer(work, blocks, places);
        places.add(work.target, l, work.products, products, y, n, y_new, n, projections, 1, skips, 1, reduced, 1,
                   levels, 3 * l, nodes, nodes_kept * half, sums, 4 * half, predicted, 3 * half, change, half);
        memory.resize(places.total, Octet(0.0));
        Octet *next = memory.data();
        for (const auto &[place, count] : places.of) {
            *place = next;
            next += count;
        }
        work.counters = counters;
        short_work = SizedWith<4, 2, Octet>(work);
        suspects.resize(LANES * work.suspect_size());
        tolerances.resize(2 * LANES * n);
        for (int64_t i = 0; i < LANES * n; ++i) {
            tolerances[i] = o.rtol[i / LANES];
            tolerances[LANES * n + i] = o.atol[i / LANES];
        }
        flatten(w);
        if (ms) lengthen(*ms, nodes_kept);
    }

    Run run() { return {method, flat_options_, flat, system, nullptr}; }
    double &at(Octet *a, int64_t lane) const { return OctetSystem::floats_of(a)[lane]; }

    // The suspect step of one member.
    double *suspect(int64_t lane) { return suspects.data() + lane * work.suspect_size(); }
    const double *suspect(int64_t lane) const { return suspects.data() + lane * work.suspect_size(); }

    // Conversion of one member's part of n vectors to floats and back.
    void take(const Octet *a, int64_t lane, double *out, int64_t n) const {
        for (int64_t i = 0; i < n; ++i) out[i] = OctetSystem::floats_of(a)[LANES * i + lane];
    }
    void give(const double *a, int64_t lane, Octet *out, int64_t n) const {
        for (int64_t i = 0; i < n; ++i) OctetSystem::floats_of(out)[LANES * i + lane] = a[i];
    }

  private:
    // Starts and lengths of the buffers of vectors; other buffers of a run do not belong to its members.
    struct Places {
        std::vector<std::pair<Octet **, int64_t>> of;
        int64_t total = 0;

        template <class... Others>
        void add(Octet *&place, int64_t count, Others &&...others) {
            of.emplace_back(&place, count);
            total += count;
            if constexpr (sizeof...(others) > 0) add(others...);
        }
        void operator()(const char *, Octet *&place, std::initializer_list<int64_t> shape) {
            add(place, std::accumulate(shape.begin(), shape.end(), int64_t{1}, std::multiplies()));
        }
        void states(const char *name, Octet *&place, std::initializer_list<int64_t> shape) {
            (*this)(name, place, shape);
        }
        template <class Other>
        void operator()(const char *, Other *&, std::initializer_list<int64_t>) {}
    };

    Options flat_options_{};

    template <class... Others>
    static void see(double *&place, Octet *octets, Others &&...others) {
        place = OctetSystem::floats_of(octets);
        if constexpr (sizeof...(others) > 0) see(others...);
    }

    // Sets up `flat`: the same buffers seen as those of one state of 8 n floats, as far as the raw step needs them.
    void flatten(const Work &w) {
        flat.n = flat.m = LANES * w.n;
        flat.l = w.l;
        flat.stages = w.stages;
        see(flat.K, work.K, flat.stage, work.stage, flat.y_hat, work.y_hat, flat.err, work.err, flat.err_low,
            work.err_low, flat.err_sum, work.err_sum, flat.carry, work.carry, flat.carry_hat, work.carry_hat,
            flat.f_point, work.f_point, flat.move, work.move);
        flat.norm = no_norm.data();
        flat.counters = counters;
        flat_options_ = options;
        flat_options_.rtol = tolerances.data();
        flat_options_.atol = tolerances.data() + LANES * w.n;
    }

    // The history of one state of 8 n floats.
    void lengthen(const Multistep &one, int64_t rows) {
        multistep = one;
        multistep.half = multistep.pitch = LANES * one.half;
        multistep.rows = rows;
        multistep.first *= LANES;
        multistep.count *= LANES;
        multistep.nodes = OctetSystem::floats_of(nodes);
        multistep.sums = OctetSystem::floats_of(sums);
        multistep.predicted = OctetSystem::floats_of(predicted);
        multistep.change = OctetSystem::floats_of(change);
        multistep.levels = OctetSystem::floats_of(levels);
        multistep.place = place;
        method.multistep = &multistep;
    }
};

}  // namespace eip
