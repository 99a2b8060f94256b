// Members of an ensemble side by side, eight in an octet, where all take the same fixed steps.
//
// What is added and multiplied component by component (stages, error estimates) runs over 8 n floats as over one long
// state, by the code of a single run; the projection is the single run's too, on octets. So each member gets the bits of a
// run of its own. What only some members need has no place there: where gradients are nearly parallel, the member's
// Newton step is solved by itself; where more is needed (softened weights, a second try, squares that overflow, figures
// that stand out), the member makes that step on the buffers of the single run.
#pragma once

#include "members.hpp"

namespace eip {

// A function of eight members gave up: they run one by one.
struct GaveUp {};

// The functions of eight members: those of a single run on arrays of octets.
struct OctetSystem {
    Native<ValuePointer, Octet> rhs_pointer{};
    std::vector<Native<ValuePointer, Octet>> inv_pointers;
    std::vector<Native<GradientPointer, Octet>> grad_pointers;
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

    void inv(double t, const Octet *y, Octet *values) {
        for (const auto &[pointer, library, octets] : inv_pointers) {
            if (library) {
                library(t, y, nullptr, values, params.data(), n(), p());
            } else {
                fill(values, NOT_A_NUMBER, octets);
                require(pointer(t, copied(floats_of(y), scratch), floats_of(values), floats_of(params.data())));
            }
            values += octets;
        }
    }

    void grad(double t, const Octet *y, const Octet *f, Octet *G) {
        for (const auto &[pointer, library, octets] : grad_pointers) {
            if (library) {
                library(t, y, f, G, params.data(), n(), p());
            } else {
                fill(G, NOT_A_NUMBER, octets);
                const double *state = copied(floats_of(y), scratch), *slope = copied(floats_of(f), scratch_f);
                require(pointer(t, state, slope, floats_of(G), floats_of(params.data())));
            }
            G += octets;
        }
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
};

// Eight members: their buffers, as octets and as 8 n floats, and what each has done.
struct Eight {
    using Run = RunOf<Work, OctetSystem>;

    const Method &method;
    Options options;  // those of the run, tolerances for 8 n floats
    OctetSystem system;
    std::vector<Octet> memory;
    std::vector<double> tolerances, no_norm;
    int64_t counters[N_COUNTERS] = {};
    Work flat{};
    WorkOf<Octet> work{};
    Octet *y, *y_new, *projections, *skips, *reduced;
    // Members that are still here; their counters beyond those of all; rank of the last projection.
    bool alive[LANES] = {};
    int64_t row = 0;  // the next one to be saved
    int64_t own[LANES][N_COUNTERS] = {}, rank[LANES] = {};

    Eight(const Method &method, const Options &o, const Work &w, OctetSystem functions)
        : method(method), options(o), system(std::move(functions)), no_norm(1) {
        const int64_t n = w.n, l = w.l, blocks = o.blocks.count, products = o.frame.rows;
        work.n = work.m = n;
        work.l = l;
        work.stages = w.stages;
        const std::pair<Octet **, int64_t> places[] = {
            {&work.K, (w.stages + 1) * n}, {&work.G, l * n}, {&work.Q, l * n}, {&work.R, l * l}, {&work.stage, n},
            {&work.y_hat, n}, {&work.err, n}, {&work.err_low, n}, {&work.err_sum, n},
            {&work.sigma, n}, {&work.move, n}, {&work.scale, blocks}, {&work.ratio, blocks}, {&work.mu, l},
            {&work.values, l}, {&work.g, l}, {&work.band, l}, {&work.before, l}, {&work.worth, l}, {&work.defect, l},
            {&work.max_defect, l}, {&work.target, l}, {&work.trust, l * N_FIGURES}, {&work.products, products},
            {&work.max_correction, 1}, {&y, n}, {&y_new, n}, {&projections, 1}, {&skips, 1}, {&reduced, 1}};
        int64_t total = 0;
        for (const auto &[place, count] : places) total += count;
        memory.resize(total, Octet(0.0));
        Octet *next = memory.data();
        for (const auto &[place, count] : places) {
            *place = next;
            next += count;
        }
        work.counters = counters;
        tolerances.resize(2 * LANES * n);
        for (int64_t i = 0; i < LANES * n; ++i) {
            tolerances[i] = o.rtol[i / LANES];
            tolerances[LANES * n + i] = o.atol[i / LANES];
        }
        flatten(w);
    }

    Run run() { return {method, flat_options_, flat, system, nullptr}; }
    double &at(Octet *a, int64_t lane) const { return OctetSystem::floats_of(a)[lane]; }

    // One member's part of n octets, to floats and back.
    void take(const Octet *a, int64_t lane, double *out, int64_t n) const {
        for (int64_t i = 0; i < n; ++i) out[i] = OctetSystem::floats_of(a)[LANES * i + lane];
    }
    void give(const double *a, int64_t lane, Octet *out, int64_t n) const {
        for (int64_t i = 0; i < n; ++i) OctetSystem::floats_of(out)[LANES * i + lane] = a[i];
    }

  private:
    Options flat_options_{};

    // The same buffers as those of one state of 8 n floats, as far as the raw step needs them.
    void flatten(const Work &w) {
        flat.n = flat.m = LANES * w.n;
        flat.l = w.l;
        flat.stages = w.stages;
        for (const auto &[place, octets] : std::initializer_list<std::pair<double **, Octet *>>{
                 {&flat.K, work.K}, {&flat.stage, work.stage}, {&flat.y_hat, work.y_hat}, {&flat.err, work.err},
                 {&flat.err_low, work.err_low}, {&flat.err_sum, work.err_sum}})
            *place = OctetSystem::floats_of(octets);
        flat.norm = no_norm.data();
        flat.counters = counters;
        flat_options_ = options;
        flat_options_.rtol = tolerances.data();
        flat_options_.atol = tolerances.data() + LANES * w.n;
    }
};

// The Newton step of one member, whose gradients are nearly parallel or vanish, by pivoted QR.
template <class W>
[[gnu::noinline]] inline void solve_alone(Eight &eight, int64_t lane, const Options &o, const W &w) {
    const WorkOf<Octet> &eights = eight.work;
    eight.take(eights.sigma, lane, w.sigma, w.m);
    eight.take(eights.y_hat, lane, w.y_hat, w.m);
    eight.take(eights.G, lane, w.G, w.l * w.m);
    eight.take(eights.g, lane, w.g, w.l);
    weigh_rows(o.frame, w, w.Q);
    const Matrix R = small(w.R, w.l, w);
    const int64_t rank = factor(rows_of(w.Q, w), w.inverse_norms, R, w.pivots);
    eight.rank[lane] = std::max<int64_t>(rank, 0);
    if (rank >= 0) {
        least_norm(w.g, w.inverse_norms, R, w.pivots, rank, w.mu);
        move_along(o, w, w.stage);
    } else {
        fill(w.stage, NOT_A_NUMBER, w.m);
    }
    eight.give(w.move, lane, eights.move, w.m);
    eight.give(w.stage, lane, eight.y_new, w.m);
}

// What `note` does for one member, for those in `done`; returns those for whom there is more to be noted, untouched.
inline Mask note_octet(double t, const Mask &done, const Options &o, const WorkOf<Octet> &w) {
    const double waited = static_cast<double>(w.counters[WAITED]), many = std::sqrt(1.0 + waited);
    const double rounding = waited > 0 ? EPS * many : EPS;
    const double errors = !w.counters[HAVE_ERROR] ? 0.0 : waited == 0 ? 1.0 : o.metric == ERROR ? many : 1.0 + waited;
    const auto expected_of = [&](int64_t i) {
        return errors * w.worth[i] + rounding * (o.per_band * w.band[i]) + TINY;
    };
    Mask more{};
    for (int64_t i = 0; i < w.l; ++i) {
        const Octet *figures = w.figures(i);
        const Octet own = own_terms(i, o, w);
        more = more | (abs(w.before[i]) > FAR * own) | (abs(w.defect[i]) > LARGE_SHARE * own);
        if (errors > 0.0)
            more = more | ((w.worth[i] > 0.0) & (abs(w.before[i] - figures[LEFT]) > LARGE * expected_of(i)));
    }
    more = more & done;
    const Mask noted = done & !more;
    for (int64_t i = 0; i < w.l; ++i) {
        Octet *figures = w.figures(i);
        const auto set = [&](Figure figure, const Mask &those, const Octet &value) {
            figures[figure] = where(those, value, figures[figure]);
        };
        set(NOTED, noted, figures[NOTED] + 1.0);
        set(TERMS, noted, max(where(figures[TERMS] < INFINITE, figures[TERMS], 0.0), o.per_band * w.band[i]));
        if (errors > 0.0) {
            const Octet size = abs(w.before[i] - figures[LEFT]), expected = expected_of(i);
            const Mask judged = noted & (w.worth[i] > 0.0);
            set(JUDGED, judged, figures[JUDGED] + 1.0);
            set(SUM, judged, figures[SUM] + size);
            set(EXPECTED, judged, figures[EXPECTED] + expected);
            const Mask record = judged & (size > figures[NU] * expected);
            if (any(record)) {
                set(NU, record, size / expected);
                set(AT, record, t);
            }
        }
        set(LEFT, noted, w.defect[i]);
    }
    return more;
}

// Projects eight members; returns those of `alive` who have to make this step by themselves. As `project_step`.
template <class W>
inline Mask project_octet(Eight &eight, const Step &step, const Mask &alive, const W &single) {
    const Options &o = eight.options;
    const WorkOf<Octet> &w = eight.work;
    eight.system.grad(step.t_new, w.y_hat, w.last(), w.G);
    ++w.counters[NJEV];
    if (o.every != 1 && o.metric == ERROR) quadrature(eight.flat.err, eight.flat.err_sum, eight.flat.err, eight.flat.m);
    eight.system.inv(step.t_new, w.y_hat, w.values);
    const Mask outside = defects<Octet>(nullptr, w.y_hat, o, w, w.before);
    Mask leave{};
    Octet largest_error = 0.0;
    if (o.metric == ERROR) {
        leave = outside & block_sizes<Octet>(eight.y, EPS, o, w);
        largest_error = weights_from_sizes(o, w);
    }
    weigh_rows(o.frame, w, w.Q);
    const Mask dependent = outside & alive & !solve_gram(rows_of(w.Q, w), w.g, small(w.R, w.l, w), w.mu);
    move_along(o, w, eight.y_new);
    const Mask moved = outside & alive;
    for (int64_t lane = 0; lane < LANES; ++lane)
        if (moved.lane(lane)) eight.rank[lane] = w.l;
    if (any(dependent))
        for (int64_t lane = 0; lane < LANES; ++lane)
            if (dependent.lane(lane)) solve_alone(eight, lane, o, single);
    const Octet correction = correction_in_local_errors(largest_error, o, w);
    if (o.blocks.count * o.blocks.width == w.m) leave = leave | (outside & (correction > HEALTHY));
    for (int64_t j = 0; j < w.m; ++j) eight.y_new[j] = where(outside, eight.y_new[j], w.y_hat[j]);
    eight.system.inv(step.t_new, eight.y_new, w.values);
    const Mask held = defects_held<Octet>(w.before, w) & small_shares(o, w) & all_finite(eight.y_new, w.m);
    Mask done = alive & held & !leave;
    if (o.watched) done = done & !note_octet(step.t_new, done, o, w);
    for (int64_t i = 0; i < w.l; ++i)
        w.max_defect[i] = where(done, max(w.max_defect[i], abs(w.defect[i])), w.max_defect[i]);
    const Mask corrected = done & outside;
    *w.max_correction = where(corrected, max(*w.max_correction, correction), *w.max_correction);
    *eight.projections += where(corrected, 1.0, 0.0);
    *eight.skips += where(done & !outside, 1.0, 0.0);
    for (int64_t lane = 0; lane < LANES; ++lane)
        if (corrected.lane(lane) && eight.rank[lane] < w.l) eight.at(eight.reduced, lane) += 1.0;
    return alive & !done;
}

// What one member has counted, where all have counted `shared`.
inline void count_of(const Eight &eight, int64_t lane, const int64_t *shared, int64_t *out) {
    for (int c = 0; c < N_COUNTERS; ++c) out[c] = shared[c] + eight.own[lane][c];
    const auto projections = static_cast<int64_t>(eight.at(eight.projections, lane));
    out[PROJECTIONS] += projections;
    out[NLU] += projections;
    out[SKIPPED] += static_cast<int64_t>(eight.at(eight.skips, lane));
    out[RANK_REDUCED] += static_cast<int64_t>(eight.at(eight.reduced, lane));
    out[LAST_RANK] = eight.rank[lane];
}

// The parameters of one member, for the functions of the single run.
inline void take_params(const Eight &eight, int64_t lane, System &system) {
    eight.take(eight.system.params.data(), lane, system.params, system.n_params);
}

// Step k of one member on the buffers of the single run, up to its new state; false where it fails. `shared`: what all
// had counted before the step.
template <class AnyRun>
[[gnu::cold, gnu::noinline]] inline bool step_alone(AnyRun &run, Eight &eight, int64_t lane, const Schedule &s, int64_t k,
                                                    const int64_t *shared, double *y, double *y_new) {
    const auto &w = run.work;
    const WorkOf<Octet> &eights = eight.work;
    eight.take(eight.y, lane, y, w.m);
    eight.take(eights.K, lane, w.K, w.m);
    eight.take(eights.err_sum, lane, w.err_sum, w.m);
    eight.take(eights.target, lane, w.target, w.l);
    eight.take(eights.trust, lane, w.trust, w.l * N_FIGURES);
    eight.take(eights.max_defect, lane, w.max_defect, w.l);
    w.max_correction[0] = eight.at(eights.max_correction, lane);
    take_params(eight, lane, run.system);
    count_of(eight, lane, shared, w.counters);
    s.clock[NEXT_LENGTH] = std::abs(s.span.h);
    try {
        if (next_step(run, s.span, s.clock, k, y, y_new) != OK) return false;
    } catch (const Broken &) {
        return false;
    }
    eight.give(y_new, lane, eight.y_new, w.m);
    eight.give(w.trust, lane, eights.trust, w.l * N_FIGURES);
    eight.give(w.max_defect, lane, eights.max_defect, w.l);
    eight.at(eights.max_correction, lane) = w.max_correction[0];
    for (Octet *counts : {eight.projections, eight.skips, eight.reduced}) eight.at(counts, lane) = 0.0;
    std::copy_n(w.counters, static_cast<int64_t>(N_COUNTERS), eight.own[lane]);
    eight.rank[lane] = w.counters[LAST_RANK];
    return true;
}

inline Mask alive_of(const Eight &eight) {
    double lanes[LANES];
    for (int64_t lane = 0; lane < LANES; ++lane) lanes[lane] = eight.alive[lane];
    return Octet::load(lanes) > 0.0;
}

// Whether a time of t_eval lies in the step that ends at t_new.
inline bool is_due(const Schedule &s, int64_t row, double t_new) {
    return row < s.n_eval && s.span.sign * (s.t_eval[row] - t_new) <= 0.0;
}

// States at the times of t_eval within the step just made, member by member as in a single run.
template <class AnyRun>
[[gnu::noinline]] inline void sample_octet(AnyRun &run, Samples &samples, Eight &eight, const Schedule &s,
                                           const Members &members, const Step &step, double *y, double *y_new) {
    const auto &w = run.work;
    const WorkOf<Octet> &eights = eight.work;
    const int64_t row = eight.row;
    s.clock[TIME] = step.t;
    s.clock[TIME_NEW] = step.t_new;
    for (int64_t lane = 0; lane < LANES; ++lane) {
        if (!eight.alive[lane]) continue;
        eight.take(eights.K, lane, w.K, (w.stages + 1) * w.m);
        eight.take(eights.sigma, lane, w.sigma, w.m);
        eight.take(eight.y, lane, y, w.m);
        eight.take(eight.y_new, lane, y_new, w.m);
        take_params(eight, lane, run.system);
        w.counters[NFEV] = 0;
        s.place[ROW] = row;
        const Saved saved = members.saved(members.where[0] + lane, w);
        try {
            if (wants_samples(run, &samples, s, y_new, saved)) sample(run, samples, s, y, y_new, saved);
        } catch (const Broken &) {
            eight.alive[lane] = false;
        }
        eight.own[lane][NFEV] += w.counters[NFEV];
    }
    while (is_due(s, eight.row, step.t_new)) ++eight.row;
}

// Step k of all eight.
template <class AnyRun>
inline void step_octet(AnyRun &run, Samples *samples, Eight &eight, const Schedule &s, const Members &members, int64_t k,
                       double *y, double *y_new) {
    const Span &span = s.span;
    const Options &o = eight.options;
    WorkOf<Octet> &w = eight.work;
    const double t = span.t0 + k * span.h;
    const bool last = k + 1 >= span.n_steps;
    const double t_new = last ? span.t_bound : span.t0 + (k + 1) * span.h;
    const bool project = w.l > 0 && (last || (k + 1) % o.every == 0);
    double *from = OctetSystem::floats_of(eight.y), *to = OctetSystem::floats_of(eight.y_new);
    const Step step{t, t_new, last ? t_new - t : span.h, from, to, project, last};
    int64_t before[N_COUNTERS];
    std::copy_n(w.counters, static_cast<int64_t>(N_COUNTERS), before);
    Eight::Run all = eight.run();
    make_stages(all, step);
    look_back(all, step);
    const Mask alive = alive_of(eight);
    Mask leave;
    if (project) {
        leave = project_octet(eight, step, alive, run.work);
    } else {
        copy(w.y_hat, eight.y_new, w.m);
        leave = alive & !all_finite(w.y_hat, w.m);
    }
    bool returned[LANES] = {};
    if (any(leave))
        for (int64_t lane = 0; lane < LANES; ++lane)
            if (leave.lane(lane))
                eight.alive[lane] = returned[lane] = step_alone(run, eight, lane, s, k, before, y, y_new);
    close_step(all, step, OK);
    for (int64_t lane = 0; lane < LANES; ++lane)
        for (int c = 0; returned[lane] && c < N_COUNTERS; ++c) eight.own[lane][c] -= w.counters[c];
    if (is_due(s, eight.row, t_new)) sample_octet(run, *samples, eight, s, members, step, y, y_new);
    copy(w.last(), w.row(0), w.m);
    std::swap(eight.y, eight.y_new);
}

// Eight members, the last one repeated where there are fewer, as at the start of a run.
template <class AnyRun>
inline void begin_octet(AnyRun &run, Eight &eight, const Schedule &s, const Members &members) {
    const int64_t first = members.where[0], n = eight.work.n, p = run.system.n_params;
    WorkOf<Octet> &w = eight.work;
    const double t0 = s.span.t0;
    for (int64_t lane = 0; lane < LANES; ++lane) {
        const int64_t k = std::min(first + lane, members.count - 1);
        eight.give(members.starts + k * n, lane, eight.y, n);
        eight.give(members.params + k * p, lane, eight.system.params.data(), p);
        eight.give(members.sigma, lane, w.sigma, n);
    }
    copy(members.sigma, run.work.sigma, n);
    fill(w.err_sum, 0.0, n);
    fill(w.max_defect, 0.0, w.l);
    for (Octet *one : {w.max_correction, eight.projections, eight.skips, eight.reduced}) *one = 0.0;
    std::fill_n(w.counters, static_cast<int64_t>(N_COUNTERS), 0);
    w.counters[NFEV] = members.evaluations;
    std::fill_n(&eight.own[0][0], LANES * N_COUNTERS, 0);
    std::fill_n(eight.rank, LANES, 0);
    fill(w.trust, 0.0, w.l * N_FIGURES);
    for (int64_t i = 0; i < w.l; ++i) w.figures(i)[TERMS] = INFINITE;
    eight.system.rhs(eight.flat, t0, OctetSystem::floats_of(eight.y), OctetSystem::floats_of(w.row(0)));
    eight.system.inv(t0, eight.y, w.target);
    copy(w.target, w.values, w.l);
    eight.system.grad(t0, eight.y, w.row(0), w.G);
    const Mask sound = all_finite(eight.y, n) & all_finite(w.row(0), n) & all_finite(w.target, w.l) &
                       all_finite(w.G, w.l * n);
    if (eight.options.watched) start_figures<Octet>(eight.y, w.row(0), members.first_steps[first], eight.options, w);
    for (int64_t lane = 0; lane < LANES; ++lane) eight.alive[lane] = first + lane < members.count && sound.lane(lane);
}

// States of all members as their next row.
inline void save_octet(Eight &eight, const Members &members) {
    const int64_t n = eight.work.n, row = eight.row++;
    for (int64_t lane = 0; members.kept && lane < LANES && members.where[0] + lane < members.count; ++lane)
        eight.take(eight.y, lane, members.rows + ((members.where[0] + lane) * members.n_rows + row) * n, n);
}

// Results of those members that came to their ends.
inline void end_octet(const Eight &eight, const Schedule &s, const Members &members) {
    const WorkOf<Octet> &w = eight.work;
    for (int64_t lane = 0; lane < LANES; ++lane) {
        if (!eight.alive[lane]) continue;
        const int64_t k = members.where[0] + lane;
        members.status[k] = 0;
        members.t[k] = s.span.t_bound;
        members.max_correction[k] = eight.at(w.max_correction, lane);
        eight.take(eight.y, lane, members.y + k * w.n, w.n);
        eight.take(w.max_defect, lane, members.max_defect + k * w.l, w.l);
        eight.take(w.trust, lane, members.figures + k * w.l * N_FIGURES, w.l * N_FIGURES);
        count_of(eight, lane, w.counters, members.counters + k * N_COUNTERS);
    }
}

// Octets of members from where[0] on, so many steps in all; where[1] is one more than the step they are at. OK when none
// is left, or it is to be called again. Whose status is not set has to run by itself.
template <class AnyRun>
inline Code sweep_octets(AnyRun &run, Samples *samples, Eight &eight, const Schedule &s, const Members &members,
                         int64_t steps, double *y, double *y_new) {
    int64_t &first = members.where[0], &begun = members.where[1];
    for (; first < members.count; first += LANES, begun = 0) {
        try {
            if (begun == 0) {
                begin_octet(run, eight, s, members);
                eight.row = 0;
                if (s.n_eval == 0 || s.t_eval[0] == s.span.t0) save_octet(eight, members);
                begun = 1;
            }
            for (int64_t k = begun - 1; k < s.span.n_steps && any(alive_of(eight)); begun = ++k + 1) {
                if (steps-- == 0) return OK;
                step_octet(run, samples, eight, s, members, k, y, y_new);
                const bool due = k + 1 == s.span.n_steps || (s.save_every > 0 && (k + 1) % s.save_every == 0);
                if (s.n_eval == 0 && due) save_octet(eight, members);
            }
            end_octet(eight, s, members);
        } catch (const GaveUp &) {
            continue;
        }
    }
    return OK;
}

}  // namespace eip
