// Data of a run: its method, options, buffers and clock. NumPy arrays show all of this memory, so that Python can read
// it during the run. A complex state of n components is stored here as 2 n floats, so that Re<., .> is the ordinary
// product.
#pragma once

#include <cstdint>
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

constexpr int64_t MEMORIES = 3;  // of the metric, see `MetricMemory`

// The records below come from Python, where they are named tuples. A list names the fields of a record once, in their order there:
// FIELD(type, name) or, of an array, FIELD(type, name, lengths of its axes...); STATES in the place of FIELD for
// arrays of the type of a state; PYTHON(name, type, whether it may be left out) for what is read elsewhere; DERIVED(name, value) for a number that Python does not have.
// A length that is `Bound` is that of the array, all others must fit; `run` has the sizes of the run. EIP_RECORD declares the
// fields, and a function `fields` that visits them, by which records.cpp makes the named tuple and reads it.
struct Bound {
    int64_t &length;
};

struct Sizes {
    int64_t n = 0, m = 0, l = 0, blocks = 0, events = 0, params = 0;
};

#define EIP_DECLARE(TYPE, NAME, ...) TYPE NAME;
#define EIP_DECLARE_DERIVED(NAME, ...) int64_t NAME;
#define EIP_DECLARE_NOTHING(...)
#define EIP_VISIT(TYPE, NAME, ...) visit(#NAME, NAME __VA_OPT__(, ) __VA_ARGS__);
#define EIP_VISIT_STATES(TYPE, NAME, ...) visit.states(#NAME, NAME, __VA_ARGS__);
#define EIP_VISIT_PYTHON(NAME, ...) visit.in_python(#NAME, __VA_ARGS__);
#define EIP_VISIT_DERIVED(NAME, VALUE) NAME = VALUE;
#define EIP_RECORD(LIST, TEXT)                                                 \
    static constexpr const char *RECORD = TEXT;                                \
    LIST(EIP_DECLARE, EIP_DECLARE, EIP_DECLARE_NOTHING, EIP_DECLARE_DERIVED)   \
    template <class Visit>                                                     \
    void fields(Visit &visit) {                                                \
        [[maybe_unused]] const Sizes &run = visit.sizes;                       \
        LIST(EIP_VISIT, EIP_VISIT_STATES, EIP_VISIT_PYTHON, EIP_VISIT_DERIVED) \
    }

// clang-format off
#define EIP_SPAN(FIELD, STATES, PYTHON, DERIVED) \
    FIELD(double, t0) FIELD(double, h) FIELD(double, t_bound) FIELD(double, sign) FIELD(int64_t, n_steps) \
    FIELD(double, max_step)

#define EIP_MULTISTEP(FIELD, STATES, PYTHON, DERIVED) \
    FIELD(const double *, predict_q, Bound{order}) FIELD(const double *, predict_v, order) \
    FIELD(const double *, states_q, order, order) FIELD(const double *, states_v, order, order) \
    FIELD(const double *, correction, order + 1) FIELD(const double *, shape_q, order + 1) \
    FIELD(const double *, shape_v, order + 1) FIELD(const double *, size, order + 1) \
    FIELD(double, error_constant) FIELD(double, growth) FIELD(int64_t, middle) FIELD(bool, brief) FIELD(bool, level) \
    FIELD(bool, uses_v) FIELD(double, t0) FIELD(double, h) FIELD(int64_t, substeps) FIELD(int64_t, spacing) \
    FIELD(int64_t, corrected_first) FIELD(int64_t, corrected_count) FIELD(double *, nodes, Bound{rows}, Bound{pitch}) \
    FIELD(double *, sums, 4, pitch) FIELD(double *, predicted, 3, pitch) FIELD(double *, change, run.m / 2) \
    FIELD(double *, levels, 3, run.l) FIELD(double *, rates, rows, Bound{balances}) \
    FIELD(double *, rate_sums, 2, balances) FIELD(int64_t *, place, N_NODE_PLACES) DERIVED(half, run.m / 2)

#define EIP_METHOD(FIELD, STATES, PYTHON, DERIVED) \
    FIELD(const double *, b, Bound{stages}) FIELD(const double *, c, stages) FIELD(double, exponent) \
    FIELD(const double *, A, stages, Bound{columns}) FIELD(const double *, b_low, stages) \
    FIELD(const double *, b_v, stages) FIELD(const double *, b_v_low, stages) FIELD(const double *, e, Bound{n_e}) \
    FIELD(const double *, e_v, Bound{n_e_v}) FIELD(const double *, e_low, Bound{n_e_low}) FIELD(bool, nystrom) \
    FIELD(bool, fsal) FIELD(bool, paired) FIELD(bool, sees_velocity) PYTHON(multistep, "Multistep | None", true)

#define EIP_BLOCKS(FIELD, STATES, PYTHON, DERIVED) \
    FIELD(const uint64_t *, member, Bound{members}) FIELD(const uint64_t *, start, Bound{starts}) \
    FIELD(int64_t, width) FIELD(int64_t, size) DERIVED(count, starts - 1)

#define EIP_FRAME(FIELD, STATES, PYTHON, DERIVED) \
    FIELD(const uint64_t *, start, 2, Bound{starts}) FIELD(const uint64_t *, place, Bound{values}) \
    FIELD(const double *, value, values) DERIVED(rows, starts - 1) FIELD(double *, products, rows) \
    FIELD(const double *, bodies, 2, Bound{groups}, Bound{count})

#define EIP_BALANCES(FIELD, STATES, PYTHON, DERIVED) \
    FIELD(const int64_t *, place, Bound{count}) FIELD(const int64_t *, rated, Bound{stages})

#define EIP_GROUPS(FIELD, STATES, PYTHON, DERIVED) \
    FIELD(const int64_t *, value, Bound{values}) FIELD(const int64_t *, first_value, Bound{ends}) \
    FIELD(const int64_t *, first_direction, ends) FIELD(const int64_t *, first_float, Bound{float_ends}) \
    FIELD(const int64_t *, place, Bound{floats}) FIELD(const double *, weight, floats) FIELD(int64_t, size) \
    DERIVED(count, ends - 1) DERIVED(directions, float_ends - 1)

#define EIP_COLUMNS(FIELD, STATES, PYTHON, DERIVED) \
    FIELD(double *, kept, run.l, Bound{count}) FIELD(int64_t, size) FIELD(int64_t, seen) FIELD(int64_t, half) \
    FIELD(bool, symplectic)

#define EIP_OPTIONS(FIELD, STATES, PYTHON, DERIVED) \
    FIELD(const double *, rtol, run.m) FIELD(const double *, atol, run.n) FIELD(const double *, block_atol, run.blocks) \
    FIELD(Blocks, blocks) FIELD(Frame, frame) FIELD(Balances, balances) FIELD(Groups, balance_groups) \
    FIELD(Columns, columns) FIELD(double *, target, run.l) FIELD(const double *, scales, run.l) \
    FIELD(const double *, computed, run.l) FIELD(const double *, most_left, run.l) FIELD(Blocks, kinds) \
    FIELD(const double *, masses, run.l, Bound{pairs}) FIELD(double, kappa) FIELD(int64_t, metric) \
    FIELD(int64_t, direction) FIELD(int64_t, iterations) FIELD(int64_t, every) FIELD(bool, reuse_f) \
    FIELD(bool, uses_f) FIELD(bool, compensated) FIELD(bool, adaptive) FIELD(double, per_band) FIELD(bool, watched) \
    FIELD(double, limit) FIELD(double, distant) PYTHON(joint, "typing.Any", true)

#define EIP_WORK(FIELD, STATES, PYTHON, DERIVED) \
    STATES(V *, K, stages + 1, n) STATES(V *, stage, n) STATES(V *, y_hat, n) STATES(V *, f_point, n) \
    STATES(V *, G, l, n) FIELD(V *, err, m) FIELD(V *, err_low, m) FIELD(V *, err_sum, m) FIELD(V *, sigma, m) FIELD(V *, move, m) FIELD(V *, shift, m) \
    FIELD(V *, unit, m) FIELD(V *, carry, m) FIELD(V *, carry_hat, m) FIELD(V *, scale, run.blocks) \
    FIELD(V *, inverse, run.blocks) FIELD(V *, ratio, run.blocks) FIELD(V *, remembered, run.blocks) \
    FIELD(V *, memory, MEMORIES, run.blocks) FIELD(V *, memory_new, MEMORIES, run.blocks) FIELD(V *, B, l, m) \
    FIELD(V *, Q, l, m) FIELD(V *, R, l, l) FIELD(V *, inverse_norms, l) FIELD(V *, mu, l) FIELD(V *, values, l) \
    FIELD(V *, g, l) FIELD(V *, band, l) FIELD(V *, before, l) FIELD(V *, worth, l) FIELD(V *, residual, l) \
    FIELD(V *, max_residual, l) FIELD(V *, max_correction, 1) FIELD(double *, norm, 1) FIELD(V *, trust, l, N_FIGURES) \
    FIELD(V *, flow, l) FIELD(V *, rates, stages + 1, balances) FIELD(V *, level, balances) \
    FIELD(V *, level_old, balances) FIELD(V *, level_carry, balances) FIELD(V *, level_carry_new, balances) \
    FIELD(V *, slow, N_SLOW, balances) FIELD(double *, suspect, suspect_size()) FIELD(int64_t *, pivots, l) \
    FIELD(int64_t *, counters, N_COUNTERS) FIELD(double *, inner_matrix, l, l) FIELD(double *, inner_R, l, l) \
    FIELD(double *, inner_g, l) FIELD(double *, inner_inverse_norms, l) FIELD(double *, inner_mu, l) \
    FIELD(int64_t *, inner_pivots, l)
// clang-format on

// Times of the steps of a run: t_k = t0 + k h (h = 0: adaptive steps), the last one on t_bound.
struct Span {
    EIP_RECORD(EIP_SPAN, "Span")

    // The length that is left after k fixed steps. The difference of two times far from 0 has lost its last digits.
    double left(int64_t k) const { return (t_bound - t0) - static_cast<double>(k) * h; }
    // The length from step k to step `stop`, the last of which may be of another length than h.
    double between(int64_t k, int64_t stop) const {
        return stop >= n_steps ? left(k) : static_cast<double>(stop - k) * h;
    }
};

// Data of a multistep method in addition to the state (multistep.hpp); weights go from the oldest node to the newest.
//
// Numbers of an acceleration, of a row for it, and rows. The shapes and the size are those of differences that tell the errors. `brief`:
// there is no history at all; `level`: states are not `middle` nodes behind it; `uses_v`: accelerations take velocities. `substeps`
// of the method that starts; `spacing`: nodes from one projection to the next. The Jacobian corrects `corrected_count` components.
struct Multistep {
    int64_t order, pitch, rows, balances;
    EIP_RECORD(EIP_MULTISTEP, "Multistep")

    double *rates_at(int64_t row) const { return rates + row * balances; }
};

// A tableau; rows of A are `columns` long. e weighs the rows of K in the error estimate, e_low in DOP853's second one;
// names ending in _v are a Nystrom method's weights of the velocity. `sees_velocity`: whether the accelerations of a Nystrom method
// come from a function that takes velocities too. `multistep` is null unless the tableau makes the first states of such a method.
// A one-step method of a user's own has an empty tableau.
struct Method {
    int64_t stages, columns, n_e, n_e_v, n_e_low;
    EIP_RECORD(EIP_METHOD, "Method")
    const Multistep *multistep;
};

// Blocks of floats: block b contains the floats with the indices member[start[b]] to member[start[b + 1] - 1]. `size`
// is the size of all blocks if they are consecutive and equally large, otherwise 0.
struct Blocks {
    int64_t members, starts;
    EIP_RECORD(EIP_BLOCKS, "Grouping")
};

// Linear invariants that corrections must not change: the non-zeros of C and, after them, those of M^T, where M = S (C
// S)^-1. If the x, y and z of bodies have equal rows, `bodies` (2, groups, count) holds their weights instead. `products` is scratch.
struct Frame {
    int64_t starts, values, groups, count;
    EIP_RECORD(EIP_FRAME, "FrameRows")
};

// Invariants whose targets change at known rates, by their places, and whether the step takes their rates at each stage.
struct Balances {
    int64_t count, stages;
    EIP_RECORD(EIP_BALANCES, "Balances")
};

// Groups of values of the invariants, each of which is projected separately: the indices of the values of a group, its
// directions, and the floats that move along a direction, each with its weight. `size` is 3 if a float stands for x, y
// and z of a body, each with a direction of its own; otherwise it is 1.
struct Groups {
    int64_t values, ends, float_ends, floats;
    EIP_RECORD(EIP_GROUPS, "Groups")
};

// Columns of derivatives behind a state of `size` floats, of as many each: solutions M of the variational equations. The
// first `seen` floats of the state are the user's, behind which parameters may stand as constants. A Nystrom method, whose
// states are positions and velocities, has the first `half` floats of all first, then the others. `kept`: G M of the
// invariants' gradients G, which is constant. symplectic: M^T J M = J is restored as well.
struct Columns {
    int64_t count;
    EIP_RECORD(EIP_COLUMNS, "Columns")

    // The places of the first and of the second part of column c, -1 for the state, and the length of the first part.
    int64_t cut() const { return half > 0 ? half : size; }
    int64_t first(int64_t c) const { return (c + 1) * cut(); }
    int64_t second(int64_t c) const { return (1 + count) * cut() + (c + 1) * (size - cut()); }
    // The length of the state with all of its columns.
    int64_t wide() const { return (1 + count) * size; }
};

// Options of the steps and of their projections. Tolerances by float, by component and by block; `computed` is 1 for invariants
// without a gradient of the user's; `most_left` is the share of its terms that a Newton step may leave without a further one, and
// `has_limits` says whether any of these is finite; `kinds` are the floats of the same unit, as far as that is known; `masses` is
// explained at `FromF` in system.hpp, `pairs` is 0 in runs without such gradients. An invariant's terms are `per_band` dead bands;
// `limit` is the share of the terms that may be left, and `distant` that from which on residuals before a projection are noted.
struct Options {
    int64_t pairs;
    bool has_limits;
    EIP_RECORD(EIP_OPTIONS, "Options")
};

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
    V *target, *products;  // the invariants' targets; scratch of the frame
    EIP_RECORD(EIP_WORK, "Work")
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

using Work = WorkOf<double>;

}  // namespace eip
