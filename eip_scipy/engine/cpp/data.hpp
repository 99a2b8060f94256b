// Data of a run: its method, options, buffers and clock. NumPy arrays show all of this memory, so that Python can read
// it during the run. A complex state of n components is stored here as 2 n floats, so that Re<., .> is the ordinary
// product.
#pragma once

#include <cstdint>
#include <initializer_list>
#include <limits>

namespace eip {

// An enumeration, with the text of its names, by which Python gets them (module.cpp).
#define EIP_ENUM(NAME, ...)          \
    enum NAME : int { __VA_ARGS__ }; \
    constexpr const char *NAME##_NAMES = #__VA_ARGS__

// Codes of a step; from PAUSE on those of the loops.
EIP_ENUM(Code, OK, NOT_FINITE, FAILED_PROJECTION, TOO_SMALL, POSTPONED, UNSTABLE, NEAR_SINGULAR, BY_VELOCITY,
         PAUSE = 10, FULL, ENDED, DOUBTFUL);

EIP_ENUM(Direction, NEW, OLD, MIDPOINT);
EIP_ENUM(Metric, EUCLIDEAN, BY_ERROR, GIVEN);
constexpr int64_t AUTO = 0;  // the option `every`

// Indices of the counters, which the step updates and leaves for the next one. From HAVE_ERROR on they are: whether an
// estimate of the step's error is available; the number of projections begun; the steps since the last projection; how
// many figures stood out; whether the last row of K holds f at the raw result; and how many gradients of the last
// accepted projection, and of the last one that was tried, are clearly independent; the failed projections of steps so
// short that shorter ones do not help, less the steps without one; and whether gradients are made from f, see `FromF` in
// system.hpp. HAVE_F may also be OF_STATE, see columns.hpp.
EIP_ENUM(Counter, NFEV, NJEV, NLU, PROJECTIONS, SKIPPED, RANK_REDUCED, REJECTED, LAST_RANK, HAVE_F, HAVE_ERROR, BEGUN,
         WAITED, FOUND, F_AT_RAW, INDEPENDENT, TRIED_INDEPENDENT, STUCK, FROM_F, N_COUNTERS);
constexpr int64_t OF_STATE = 2;
// Indices of the clock of a run: the current time, the time at the end of the step tried last and its length, and the
// length to try next.
EIP_ENUM(Clock, TIME, TIME_NEW, LENGTH, NEXT_LENGTH);
EIP_ENUM(Place, STEP, ROW, PENDING);
// Indices of `place` in the record of a multistep method: whether there is a history, the number of the newest node and
// its row, the nodes since the last projection, and the number of estimates collected.
EIP_ENUM(Node, HAVE_NODES, NEWEST, NEWEST_ROW, SINCE, SEEN, N_NODE_PLACES);
EIP_ENUM(Interpolant, CUBIC, QUINTIC, POLYNOMIAL, SEVENTH, HISTORY, NYSTROM);

// Columns of the figures of a run's projections. An invariant's terms at the start, and the largest on the manifold. The
// number of projections; the residual that the last one left; the largest that one left, in these terms, and when. The
// largest residual before a projection, in these terms, when, and how many were DISTANT. Between two projections an invariant
// changes: the largest change in local errors, when, how many were LARGE, and when the first was; the sum of the changes,
// that of the local errors, and their number. The largest rate of change along the flow, in its own terms; the largest of
// these terms; the largest rate when a step was kept for an examination last. In the first row only: the largest local
// error of a block, in what the step changes there, when a step was kept for that reason last. The share of its terms from
// which on a residual before a projection is DISTANT. A flag for a gradient that is computed from values, which is not accurate
// near kinks; the largest rate of change along the flow that examinations found by short differences, in its own terms.
EIP_ENUM(Figure, START, TERMS, NOTED, LEFT, SHARE, SHARE_AT, RAW, RAW_AT, RAW_MANY, NU, AT, MANY, FIRST, SUM, EXPECTED,
         JUDGED, RATE, RATE_TERMS, RATE_NOTED, ROUGH_NOTED, FAR_FROM, BY_VALUES, EXAMINED, N_FIGURES);

// The step that is to be examined: why, its two times, and behind these its two states (`suspect` in trust.hpp).
EIP_ENUM(SuspectPlace, REASON, SUSPECT_FROM, SUSPECT_TO, SUSPECT_WAITED, N_SUSPECT);
EIP_ENUM(Reason, NOTHING, LARGE_CORRECTION, LARGE_ERROR, CHANGES_ALONG_FLOW);

// Rows of `slow`, with a column for each balance: sums of the sizes of rates and of their terms over the whole run, the
// same sums with earlier samples gradually forgotten, and the number of samples.
EIP_ENUM(SlowRow, ALL_RATES, ALL_TERMS, LATE_RATES, LATE_TERMS, SAMPLES, N_SLOW);
// The late sums of a balance remember this share of the samples so far, and at least LEAST_LATE samples, because rate
// and terms vary within a period.
constexpr double LATE_SHARE = 1.0 / 8.0, LEAST_LATE = 16.0;

// Changes of LARGE local errors are noted, and residuals of DISTANT and LARGE_SHARE of the terms before and after projections.
constexpr double LARGE = 50.0, DISTANT = 0.03, LARGE_SHARE = 1e-2;
constexpr double EPS = 2.220446049250313e-16;
constexpr double ENDLESS = std::numeric_limits<double>::infinity();
constexpr double NOT_A_NUMBER = std::numeric_limits<double>::quiet_NaN();

// The records below come from Python, where they are named tuples. `fields` lists a record's fields once, in their order:
// `visit` gets each one's name, its place here and, of an array, the lengths of its axes. A length that is `Bound` is that of
// the array; all others must fit. `visit.sizes` are those of the run; what is derived from the fields is set at the end.
// records.cpp makes the named tuples by these functions, and reads them.
struct Bound {
    int64_t &length;
};

struct Sizes {
    int64_t n = 0, m = 0, l = 0, blocks = 0, events = 0, params = 0, rows = 0;
    bool tableau = true;  // whether a method has one
};

// Visits several fields of the same kind, each given as its name and its place. For arrays the lengths of their axes
// come first.
template <class Visit, class Place, class... Others>
void each(Visit &visit, const char *name, Place &place, Others &&...others) {
    visit(name, place);
    if constexpr (sizeof...(others) > 0) each(visit, others...);
}
template <class Visit, class Place, class... Others>
void each(Visit &visit, std::initializer_list<int64_t> shape, const char *name, Place &place, Others &&...others) {
    visit(name, place, shape);
    if constexpr (sizeof...(others) > 0) each(visit, shape, others...);
}

// Times of the steps of a run: t_k = t0 + k h (h = 0: adaptive steps), the last one on t_bound.
struct Span {
    double t0, h, t_bound, sign;
    int64_t n_steps;
    double max_step;

    // The length that is left after k fixed steps. The difference of two times far from 0 has lost its last digits.
    double left(int64_t k) const { return (t_bound - t0) - static_cast<double>(k) * h; }
    // The length from step k to step `stop`, the last of which may be of another length than h.
    double between(int64_t k, int64_t stop) const {
        return stop >= n_steps ? left(k) : static_cast<double>(stop - k) * h;
    }
};

template <class Visit>
void fields(Span &s, Visit &visit) {
    each(visit, "t0", s.t0, "h", s.h, "t_bound", s.t_bound, "sign", s.sign, "n_steps", s.n_steps, "max_step",
         s.max_step);
}

// Data of a multistep method in addition to the state (multistep.hpp); weights go from the oldest node to the newest.
struct Multistep {
    int64_t order, middle, half, pitch, rows;  // numbers of an acceleration, of a row for it, and rows
    const double *predict_q, *predict_v;       // (order)
    const double *states_q, *states_v;         // (order, order): of the state at a number of nodes before the newest
    const double *correction;                  // (order + 1)
    const double *shape_q, *shape_v, *size;    // (order + 1): differences that tell the errors' shape, and their size
    double error_constant, growth;
    bool brief, level, uses_v;  // no history at all; states not `middle` nodes behind it; accelerations take velocities
    double t0, h;
    int64_t substeps, spacing;            // of the method that starts; nodes from one projection to the next
    int64_t first, count;                 // components that the Jacobian corrects
    double *nodes, *sums;                 // (rows, pitch), (4, pitch)
    double *predicted, *change, *levels;  // (3, pitch), (half), (3, l)
    double *rates, *rate_sums;            // of the balances: (rows, balances), (2, balances)
    int64_t balances;
    int64_t *place;

    double *rates_at(int64_t row) const { return rates + row * balances; }
};

template <class Visit>
void fields(Multistep &ms, Visit &visit) {
    visit("predict_q", ms.predict_q, Bound{ms.order});
    visit("predict_v", ms.predict_v, ms.order);
    visit("states_q", ms.states_q, ms.order, ms.order);
    visit("states_v", ms.states_v, ms.order, ms.order);
    visit("correction", ms.correction, ms.order + 1);
    visit("shape_q", ms.shape_q, ms.order + 1);
    visit("shape_v", ms.shape_v, ms.order + 1);
    visit("size", ms.size, ms.order + 1);
    each(visit, "error_constant", ms.error_constant, "growth", ms.growth, "middle", ms.middle, "brief", ms.brief,
         "level", ms.level, "uses_v", ms.uses_v, "t0", ms.t0, "h", ms.h, "substeps", ms.substeps, "spacing", ms.spacing,
         "corrected_first", ms.first, "corrected_count", ms.count);
    visit("nodes", ms.nodes, Bound{ms.rows}, Bound{ms.pitch});
    visit("sums", ms.sums, 4, ms.pitch);
    visit("predicted", ms.predicted, 3, ms.pitch);
    visit("change", ms.change, visit.sizes.m / 2);
    visit("levels", ms.levels, 3, visit.sizes.l);
    visit("rates", ms.rates, ms.rows, Bound{ms.balances});
    visit("rate_sums", ms.rate_sums, 2, ms.balances);
    visit("place", ms.place, N_NODE_PLACES);
    ms.half = visit.sizes.m / 2;
}

// A tableau; rows of A are `columns` long. e weighs the rows of K in the error estimate, e_low in DOP853's second one;
// names ending in _v are a Nystrom method's weights of the velocity.
struct Method {
    int64_t stages, columns;
    const double *A, *b, *b_low, *b_v, *b_v_low, *c, *e, *e_v, *e_low;
    int64_t n_e, n_e_v, n_e_low;
    bool nystrom, fsal, paired;
    bool sees_velocity;  // whether the accelerations of a Nystrom method come from a function that takes velocities too
    double exponent;
    const Multistep *multistep;  // whose first states the tableau makes, else null
};

// A one-step method of a user's own has no tableau.
template <class Visit>
void fields(Method &m, Visit &visit) {
    visit("b", m.b, Bound{m.stages});
    visit("c", m.c, m.stages);
    visit("exponent", m.exponent);
    if (!visit.sizes.tableau) return;
    visit("A", m.A, m.stages, Bound{m.columns});
    visit("b_low", m.b_low, m.stages);
    visit("b_v", m.b_v, m.stages);
    visit("b_v_low", m.b_v_low, m.stages);
    visit("e", m.e, Bound{m.n_e});
    visit("e_v", m.e_v, Bound{m.n_e_v});
    visit("e_low", m.e_low, Bound{m.n_e_low});
    each(visit, "nystrom", m.nystrom, "fsal", m.fsal, "paired", m.paired, "sees_velocity", m.sees_velocity);
    visit.in_python("multistep", "Multistep | None", true);
}

// Blocks of floats: block b contains the floats with the indices member[start[b]] to member[start[b + 1] - 1]. `size`
// is the size of all blocks if they are consecutive and equally large, otherwise 0.
struct Blocks {
    const uint64_t *member, *start;
    int64_t members, starts, count, width, size;
};

template <class Visit>
void fields(Blocks &b, Visit &visit) {
    visit("member", b.member, Bound{b.members});
    visit("start", b.start, Bound{b.starts});
    each(visit, "width", b.width, "size", b.size);
    b.count = b.starts - 1;
}

// Linear invariants that corrections must not change: the non-zeros of C and, after them, those of M^T, where M = S (C
// S)^-1. If the x, y and z of bodies have equal rows, `bodies` (2, groups, count) holds their weights instead.
struct Frame {
    const uint64_t *start, *place;
    const double *value;
    int64_t starts, rows, values;
    double *products;  // scratch
    const double *bodies;
    int64_t groups, count;
};

template <class Visit>
void fields(Frame &f, Visit &visit) {
    visit("start", f.start, 2, Bound{f.starts});
    visit("place", f.place, Bound{f.values});
    visit("value", f.value, f.values);
    f.rows = f.starts - 1;
    visit("products", f.products, f.rows);
    visit("bodies", f.bodies, 2, Bound{f.groups}, Bound{f.count});
}

// Invariants whose targets change at known rates, by their places, and whether the step takes their rates at each stage.
struct Balances {
    const int64_t *place, *rated;
    int64_t count, stages;
};

template <class Visit>
void fields(Balances &b, Visit &visit) {
    visit("place", b.place, Bound{b.count});
    visit("rated", b.rated, Bound{b.stages});
}

// Groups of values of the invariants, each of which is projected separately: the indices of the values of a group, its
// directions, and the floats that move along a direction, each with its weight. `size` is 3 if a float stands for x, y
// and z of a body, each with a direction of its own; otherwise it is 1.
struct Groups {
    const int64_t *value, *first_value, *first_direction, *first_float, *place;
    const double *weight;
    int64_t values, count, ends, directions, floats, size;  // ends: count + 1
};

template <class Visit>
void fields(Groups &g, Visit &visit) {
    visit("value", g.value, Bound{g.values});
    visit("first_value", g.first_value, Bound{g.ends});
    visit("first_direction", g.first_direction, g.ends);
    g.count = g.ends - 1;
    visit("first_float", g.first_float, Bound{g.directions});
    visit("place", g.place, Bound{g.floats});
    visit("weight", g.weight, g.floats);
    visit("size", g.size);
    --g.directions;
}

// Columns of derivatives behind a state of `size` floats, of as many each: solutions M of the variational equations. The
// first `seen` floats of the state are the user's, behind which parameters may stand as constants. A Nystrom method, whose
// states are positions and velocities, has the first `half` floats of all first, then the others. `kept`: G M of the
// invariants' gradients G, which is constant. symplectic: M^T J M = J is restored as well.
struct Columns {
    double *kept;  // (l, count)
    int64_t count, size, seen, half;
    bool symplectic;

    // The places of the first and of the second part of column c, -1 for the state, and the length of the first part.
    int64_t cut() const { return half > 0 ? half : size; }
    int64_t first(int64_t c) const { return (c + 1) * cut(); }
    int64_t second(int64_t c) const { return (1 + count) * cut() + (c + 1) * (size - cut()); }
    // The length of the state with all of its columns.
    int64_t wide() const { return (1 + count) * size; }
};

template <class Visit>
void fields(Columns &c, Visit &visit) {
    visit("kept", c.kept, visit.sizes.l, Bound{c.count});
    each(visit, "size", c.size, "seen", c.seen, "half", c.half, "symplectic", c.symplectic);
}

struct Options {
    const double *rtol, *atol, *block_atol;  // by float, by component, by block
    Blocks blocks;
    Frame frame;
    Balances balances;
    Groups balance_groups;
    Columns columns;
    double *target;
    const double *scales, *computed;  // computed: 1 for invariants without a gradient of the user's
    const double *most_left;          // the share of its terms that a Newton step may leave without a further one
    bool has_limits;                  // whether any of these is finite
    Blocks kinds;                     // floats of the same unit, as far as that is known
    const double *masses;             // (l, pairs), see `FromF` in system.hpp; pairs = 0 in runs without such gradients
    int64_t pairs;
    double kappa;
    int64_t metric, direction, iterations, every;
    bool reuse_f, uses_f, compensated, adaptive, watched;
    double per_band;  // an invariant's terms are this many dead bands
    double limit;     // the share of the terms that may be left
    double distant;   // residuals before a projection are noted from this share of the terms on
};

template <class Visit>
void fields(Options &o, Visit &visit) {
    const Sizes &is = visit.sizes;
    visit("rtol", o.rtol, is.m);
    visit("atol", o.atol, is.n);
    visit("block_atol", o.block_atol, is.blocks);
    visit.record("groups", "Grouping", o.blocks);
    visit.record("frame", "FrameRows", o.frame);
    visit.record("balances", "Balances", o.balances);
    visit.record("balance_groups", "Groups", o.balance_groups);
    visit.record("columns", "Columns", o.columns);
    visit("target", o.target, is.l);
    visit("scales", o.scales, is.l);
    visit("computed", o.computed, is.l);
    visit("most_left", o.most_left, is.l);
    visit.record("kinds", "Grouping", o.kinds);
    visit("masses", o.masses, is.l, Bound{o.pairs});
    each(visit, "kappa", o.kappa, "metric", o.metric, "direction", o.direction, "iterations", o.iterations, "every",
         o.every, "reuse_f", o.reuse_f, "uses_f", o.uses_f, "compensated", o.compensated, "adaptive", o.adaptive,
         "per_band", o.per_band, "watched", o.watched, "limit", o.limit, "distant", o.distant);
    visit.in_python("joint", "typing.Any", true);
}

constexpr int64_t MEMORIES = 3;  // of the metric, see `MetricMemory`

// Buffers of a run of m values (floats, or those of eight members), l invariants, some of which are balances, and
// `stages` + 1 rows of K. For each balance: rows of rates at the stages, its value at the current state and what rounding
// took from it, the same of the step that is tried, its value before the last step, and sums of its rates and of their terms
// over some steps. `flow`: the rate at which each invariant is to change with the state.
template <class V>
struct WorkOf {
    using Value = V;
    // Types in a run with these buffers; a plain run has others (`Plain` in system.hpp).
    using Method = eip::Method;
    using Options = eip::Options;
    int64_t n, m, l, stages, balances;
    Value *K, *stage, *y_hat, *f_point, *G, *err, *err_low, *err_sum, *sigma, *scale, *inverse, *ratio, *remembered,
        *memory, *memory_new, *move, *shift, *unit, *carry, *carry_hat, *B, *Q, *R, *inverse_norms, *mu, *values, *g,
        *band, *before, *worth, *residual, *max_residual, *max_correction, *trust, *flow, *rates, *level, *level_old,
        *level_carry, *level_carry_new, *slow, *target,
        *products;  // the last two: the invariants' targets; scratch of the frame
    double *norm, *suspect;
    int64_t *pivots, *counters;
    double *inner_matrix, *inner_g, *inner_inverse_norms, *inner_R, *inner_mu;  // scratch of the small Newton systems
    int64_t *inner_pivots;
    int64_t behind = 0;  // of a part of a state: floats of the whole one that are behind its m

    int64_t whole() const { return m + behind; }
    int64_t suspect_size() const { return N_SUSPECT + 2 * whole(); }
    Reason suspected() const { return static_cast<Reason>(suspect[REASON]); }
    Value *row(int64_t i) const { return K + i * whole(); }  // f of stage i
    Value *last() const { return K + stages * whole(); }     // f at the raw result, or at the end of the step
    Value *gradient(int64_t i) const { return G + i * m; }
    Value *rate(int64_t i) const { return rates + i * balances; }  // of the balances at stage i
    Value *figures(int64_t i) const { return trust + i * N_FIGURES; }
};

// Visits all buffers of a run, by name and shape, for code that creates the buffers or passes them on. Buffers with the
// type of a state hold w.n of its numbers in each row.
template <class V, class Visit>
void each_buffer(WorkOf<V> &w, int64_t blocks, Visit &visit) {
    const int64_t n = w.n, l = w.l, m = w.m;
    visit.states("K", w.K, {w.stages + 1, n});
    visit.states("stage", w.stage, {n});
    visit.states("y_hat", w.y_hat, {n});
    visit.states("f_point", w.f_point, {n});
    visit.states("G", w.G, {l, n});
    each(visit, {m}, "err", w.err, "err_low", w.err_low, "err_sum", w.err_sum, "sigma", w.sigma, "move", w.move,
         "shift", w.shift, "unit", w.unit, "carry", w.carry, "carry_hat", w.carry_hat);
    each(visit, {blocks}, "scale", w.scale, "inverse", w.inverse, "ratio", w.ratio, "remembered", w.remembered);
    each(visit, {MEMORIES, blocks}, "memory", w.memory, "memory_new", w.memory_new);
    each(visit, {l, m}, "B", w.B, "Q", w.Q);
    visit("R", w.R, {l, l});
    each(visit, {l}, "inverse_norms", w.inverse_norms, "mu", w.mu, "values", w.values, "g", w.g, "band", w.band,
         "before", w.before, "worth", w.worth, "residual", w.residual, "max_residual", w.max_residual);
    each(visit, {1}, "max_correction", w.max_correction, "norm", w.norm);
    visit("trust", w.trust, {l, N_FIGURES});
    visit("flow", w.flow, {l});
    visit("rates", w.rates, {w.stages + 1, w.balances});
    each(visit, {w.balances}, "level", w.level, "level_old", w.level_old, "level_carry", w.level_carry,
         "level_carry_new", w.level_carry_new);
    visit("slow", w.slow, {N_SLOW, w.balances});
    visit("suspect", w.suspect, {w.suspect_size()});
    visit("pivots", w.pivots, {l});
    visit("counters", w.counters, {N_COUNTERS});
    each(visit, {l, l}, "inner_matrix", w.inner_matrix, "inner_R", w.inner_R);
    each(visit, {l}, "inner_g", w.inner_g, "inner_inverse_norms", w.inner_inverse_norms, "inner_mu", w.inner_mu,
         "inner_pivots", w.inner_pivots);
}

using Work = WorkOf<double>;

}  // namespace eip
