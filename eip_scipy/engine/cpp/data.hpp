// What a run holds: its method, options, buffers and clock. All memory is that of NumPy arrays, which Python reads while
// the run goes on; a complex state of n components stands here as 2 n floats, so that Re<., .> is the ordinary product.
#pragma once

#include <cstdint>
#include <limits>

namespace eip {

// Codes of a step; the last four are the loops'.
enum Code : int {
    OK = 0,
    NOT_FINITE = 1,
    FAILED_PROJECTION = 2,
    TOO_SMALL = 3,
    POSTPONED = 4,
    UNSTABLE = 5,
    PAUSE = 10,
    FULL = 11,
    ENDED = 12,
    DOUBTFUL = 13
};

enum Direction : int { NEW, OLD, MIDPOINT };
enum Metric : int { EUCLIDEAN, ERROR, GIVEN };
constexpr int64_t AUTO = 0;  // the option `every`

// Places in the counters (counters.py), in the clock and in the place of a run.
enum Counter : int {
    NFEV,
    NJEV,
    NLU,
    PROJECTIONS,
    SKIPPED,
    RANK_REDUCED,
    REJECTED,
    LAST_RANK,
    HAVE_F,
    SOFTENED,
    HAVE_ERROR,
    BEGUN,
    WAITED,
    FOUND,
    F_AT_RAW,
    N_COUNTERS
};
enum Clock : int { TIME, TIME_NEW, LENGTH, NEXT_LENGTH };
enum Place : int { STEP, ROW, PENDING };
// And of a multistep method's history: whether there is one, the newest node and its row, nodes since the last projection,
// and estimates collected.
enum Node : int { HAVE_NODES, NEWEST, NEWEST_ROW, SINCE, SEEN, N_NODE_PLACES };

// Columns of the figures of a run's projections (trust.py says what they mean).
enum Figure : int {
    START,
    TERMS,
    NOTED,
    LEFT,
    SHARE,
    SHARE_AT,
    RAW,
    RAW_AT,
    RAW_MANY,
    NU,
    AT,
    MANY,
    FIRST,
    SUM,
    EXPECTED,
    JUDGED,
    RATE,
    RATE_TERMS,
    RATE_NOTED,
    ROUGH_NOTED,
    FAR_FROM,
    BY_VALUES,
    EXAMINED,
    N_FIGURES
};

// The step that is to be examined: why, its two times, and behind these its two states (`suspect` in trust.hpp).
enum SuspectPlace : int { REASON, SUSPECT_FROM, SUSPECT_TO, N_SUSPECT };
enum Reason : int { NOTHING, LARGE_CORRECTION, LARGE_ERROR, CHANGES_ALONG_FLOW };

constexpr double EPS = 2.220446049250313e-16;
constexpr double INFINITE = std::numeric_limits<double>::infinity();
constexpr double NOT_A_NUMBER = std::numeric_limits<double>::quiet_NaN();

// Where a run steps: t_k = t0 + k h (h = 0: adaptive steps), the last one on t_bound.
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

// What a multistep method knows of a run besides the state (multistep.hpp); weights go from the oldest node to the newest.
struct Multistep {
    int64_t order, middle, half, pitch, rows;  // numbers of an acceleration, of a row for it, and rows
    const double *predict_q, *predict_v;       // (order)
    const double *states_q, *states_v;         // (order, order): of the state so many nodes before the newest
    const double *correction;                  // (order + 1)
    const double *shape_q, *shape_v, *size;    // (order + 1): differences that tell the errors' shape, and their size
    double error_constant, growth;
    bool brief, level, uses_v;  // no history at all; states not `middle` nodes behind it; accelerations take velocities
    double t0, h;
    int64_t substeps, spacing;            // of the method that starts; nodes from one projection to the next
    int64_t first, count;                 // components that the Jacobian corrects
    double *nodes, *sums;                 // (rows, pitch), (4, pitch)
    double *predicted, *change, *levels;  // (3, pitch), (half), (3, l)
    int64_t *place;
};

// A tableau; rows of A are `columns` long. e weighs the rows of K in the error estimate, e_low in DOP853's second one;
// names ending in _v are a Nystrom method's weights of the velocity.
struct Method {
    int64_t stages, columns;
    const double *A, *b, *b_low, *b_v, *b_v_low, *c, *e, *e_v, *e_low;
    int64_t n_e, n_e_v;
    bool nystrom, fsal, paired;
    double exponent;
    const Multistep *multistep;  // whose first states the tableau makes, else null
};

// Blocks of floats: member[start[b]] to member[start[b + 1]]. `size` is that of consecutive blocks alike, else 0.
struct Blocks {
    const uint64_t *member, *start;
    int64_t count, width, size;
};

// Linear invariants that corrections must not touch: non-zeros of C and, after them, of M^T, M = S (C S)^-1. Where x, y
// and z of bodies have rows alike, `bodies` (2, groups, count) holds their weights instead.
struct Frame {
    const uint64_t *start, *place;
    const double *value;
    int64_t rows;
    const double *bodies;
    int64_t groups, count;
};

struct Options {
    const double *rtol, *atol, *block_atol;  // by float, by component, by block
    Blocks blocks;
    Frame frame;
    const double *scales, *computed;  // computed: 1 for invariants without a gradient of the user's
    const double *most_left;          // the share of its terms that a Newton step may leave without a further one
    bool has_limits;                  // whether any of these is finite
    Blocks kinds;                     // floats of the same unit, as far as that is known
    double kappa;
    int64_t metric, direction, iterations, every;
    bool reuse_f, uses_f, compensated, adaptive, watched;
    double per_band;  // an invariant's terms are this many dead bands
    double limit;     // the share of the terms that may be left
    double far;       // defects before a projection are noted from this share of the terms on
};

// Its numbers and flags, for whoever reads them by their names.
template <class Read>
inline void read_each(Options &o, Read read) {
    read("kappa", o.kappa);
    read("metric", o.metric);
    read("direction", o.direction);
    read("iterations", o.iterations);
    read("every", o.every);
    read("reuse_f", o.reuse_f);
    read("uses_f", o.uses_f);
    read("compensated", o.compensated);
    read("adaptive", o.adaptive);
    read("watched", o.watched);
    read("per_band", o.per_band);
    read("limit", o.limit);
    read("far", o.far);
}

// Scratch of the small Newton systems.
struct Inner {
    double *matrix, *g, *inverse_norms, *R, *mu;
    int64_t *pivots;
};

// Buffers of a run of m values (floats, or those of eight members), l invariants and `stages` + 1 rows of K.
template <class V>
struct WorkOf {
    using Value = V;
    int64_t n, m, l, stages;
    Value *K, *stage, *y_hat, *f_point, *G, *err, *err_low, *err_sum, *sigma, *scale, *ratio, *memory, *memory_new,
        *move, *carry, *carry_hat, *B, *Q, *R, *inverse_norms, *mu, *values, *g, *band, *before, *worth, *defect,
        *max_defect, *max_correction, *trust, *target, *products;  // the invariants' levels; scratch of the frame
    double *norm, *suspect;
    int64_t *pivots, *counters;
    Inner inner;

    int64_t suspect_size() const { return N_SUSPECT + 2 * m; }
    Reason suspected() const { return static_cast<Reason>(suspect[REASON]); }
    Value *row(int64_t i) const { return K + i * m; }  // f of stage i
    Value *last() const { return K + stages * m; }     // f at the raw result, or at the end of the step
    Value *gradient(int64_t i) const { return G + i * m; }
    Value *figures(int64_t i) const { return trust + i * N_FIGURES; }
};

using Work = WorkOf<double>;

}  // namespace eip
