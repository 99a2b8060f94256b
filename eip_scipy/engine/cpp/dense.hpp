// Dense output: over each step an interpolant of SciPy's order, projected onto the invariants' levels between those of the
// step's two ends, which are met exactly.
#pragma once

#include <vector>

#include "columns.hpp"
#include "multistep.hpp"

namespace eip {

// The most nodes of a polynomial through accelerations.
constexpr int64_t MOST_NODES = 32;
// The number of roundings by which a state that is handed out as it is may miss its targets.
constexpr double SHOWN_ROUNDINGS = 4.0;
// A share of an invariant's terms: the square of a smaller residual is below rounding.
constexpr double SMALL_SHARE = 1e-9;

// Inputs of the interpolants of a run, and the buffers of their projections. `weights` are rows over the stages:
// those of a tableau's own polynomial, or of that of DOP853 or a Nystrom method, which have `further` stages, or Lagrange's
// for the nodes of a multistep method, [interval, node, power].
//
// `own_slopes`: the steps leave no f at their ends. `by_travel`: weights of the projection by what each block travels within the
// step, else those of the run. `shows`: states that a step leaves unprojected are handed out as projected copies. `missed`: how many
// states were left unprojected, and the time of the first. `waiting`: whether the states at the start and at the end of the current
// step are not projected. `piece` is scratch for the interpolant of a step.
// clang-format off
#define EIP_DENSE(FIELD, STATES, PYTHON, DERIVED) \
    FIELD(int64_t, kind) FIELD(const double *, weights, Bound{polynomials}, Bound{columns}) \
    FIELD(const double *, c, Bound{further}) FIELD(const double *, A, further, Bound{A_columns}) \
    FIELD(bool, own_slopes) FIELD(bool, by_travel) FIELD(bool, shows) PYTHON(options, "Options", false) \
    PYTHON(work, "Work", false)     FIELD(double *, missed, 2) FIELD(int64_t *, waiting, 2) \
    FIELD(double *, piece, floats())
// clang-format on
struct Dense {
    int64_t polynomials, columns, further, A_columns;
    EIP_RECORD(EIP_DENSE, "Dense")
    Options options;
    Work work;
    const Multistep *multistep;

    // States that make up an interpolant, in addition to those of the two ends and the weights.
    int64_t rows() const {
        if (kind == HISTORY) return (columns + 1) / 2 + 2;
        if (kind == NYSTROM) return (polynomials + 1) / 2 + 1;
        return kind == POLYNOMIAL ? polynomials + 1 : kind == SEVENTH ? 3 + polynomials : 3;
    }
    int64_t floats() const { return 3 + (3 + rows()) * work.m + 2 * work.l + (2 + rows()) * work.balances; }
};

// One step's interpolant, in floats() numbers that outlive the step.
struct Piece {
    double *t_old, *t, *known, *y_old, *y, *rows, *sigma, *levels_old, *levels;
    double *balance_old, *balance, *balance_rows;  // the balances as the run carries them, interpolated as a state is

    Piece(double *first, const Dense &d)
        : t_old(first),
          t(first + 1),
          known(first + 2),
          y_old(first + 3),
          y(y_old + d.work.m),
          rows(y + d.work.m),
          sigma(rows + d.rows() * d.work.m),
          levels_old(sigma + d.work.m),
          levels(levels_old + d.work.l),
          balance_old(levels + d.work.l),
          balance(balance_old + d.work.balances),
          balance_rows(balance + d.work.balances) {}

    // Returns the part of this interpolant that belongs to the balances, in the form of an interpolant of a state.
    Piece of_balances() const {
        Piece piece(*this);
        piece.y_old = balance_old;
        piece.y = balance;
        piece.rows = balance_rows;
        return piece;
    }
};

// Returns false if an interpolant, which a file may hold, does not say at which node of the history its step begins.
inline bool has_node(const Dense &d, double *piece) {
    const double node = Piece(piece, d).rows[(d.rows() - 1) * d.work.m];
    return d.kind != HISTORY || (node >= 0.0 && node < static_cast<double>(d.polynomials / d.columns));
}

// Buffers in which the balances are the state, and their rates its derivatives.
inline Work work_of_balances(const Work &w) {
    Work own(w);
    own.n = own.m = w.balances;
    own.K = w.rates;
    return own;
}

// Dense output as a run of its own.
struct DenseRun {
    const Dense &dense;
    const Method none{};
    const Work work;
    Run run;

    DenseRun(const Dense &d, System &system) : dense(d), work(d.work), run{none, d.options, work, system, nullptr} {}
};

// Adds the evaluations of f that the dense output has made to those of the run.
inline void count_calls(const DenseRun &dense, const Work &step) {
    step.counters[NFEV] += std::exchange(dense.work.counters[NFEV], 0);
}

// The 2-norm of block b of a, or of a - minus.
inline double block_norm(const double *a, const double *minus, int64_t b, const Blocks &blocks, const Work &w) {
    int64_t count = 0;
    for (uint64_t p = blocks.start[b]; p < blocks.start[b + 1]; ++p, ++count)
        w.move[count] = a[blocks.member[p]] - (minus ? minus[blocks.member[p]] : 0.0);
    return norm(w.move, count);
}

// Weights sigma, at most 1, from a weight of each block; 1 if all of them are 0. What is in no block, such as columns of
// derivatives, does not move.
template <typename WeightOf>
inline void weigh_blocks(double *sigma, const Blocks &blocks, const Work &w, WeightOf weight_of) {
    double largest_weight = 0.0;
    if (blocks.members < w.m) fill(sigma, 0.0, w.m);
    for (int64_t b = 0; b < blocks.count; ++b) {
        const double weight = weight_of(b);
        for (uint64_t p = blocks.start[b]; p < blocks.start[b + 1]; ++p) sigma[blocks.member[p]] = weight;
        largest_weight = std::max(largest_weight, weight);
    }
    if (largest_weight > 0.0)
        for (int64_t i = 0; i < w.m; ++i) sigma[i] /= largest_weight;
    else
        fill(sigma, 1.0, w.m);
}

// How far each block goes within the step, as weights of the interpolant's correction.
//
// Those of the step do not fit: an interpolant errs in other components than the end of a step does. A slope that passes
// through zero within the step does not make a block immobile, hence the second term.
inline void travelled(const Piece &piece, double h, const double *f_old, const double *f, const Blocks &blocks,
                      const Work &w) {
    weigh_blocks(piece.sigma, blocks, w, [&](int64_t b) {
        const auto size_of = [&](const double *a, const double *minus) { return block_norm(a, minus, b, blocks, w); };
        const double size = std::max(size_of(piece.y_old, nullptr), size_of(piece.y, nullptr));
        const double slope = std::abs(h) * std::max(size_of(f_old, nullptr), size_of(f, nullptr));
        const double turn = std::abs(h) * size_of(f_old, f);
        return std::hypot(slope, std::sqrt(size) * std::sqrt(turn));
    });
}

// The cubic through both ends with their slopes: rows change, h f_old - change, h f - change.
inline void cubic(const Piece &piece, double h, const double *f_old, const double *f, const Work &w) {
    double *change = piece.rows, *left = change + w.m, *right = left + w.m;
    for (int64_t i = 0; i < w.m; ++i) {
        change[i] = piece.y[i] - piece.y_old[i];
        left[i] = h * f_old[i] - change[i];
        right[i] = h * f[i] - change[i];
    }
}

// For y = (q, v) the quintic through positions, velocities and accelerations at both ends; v is its slope. Its rows are
// the coefficients of theta^0 to theta^5, by what the Taylor polynomial at the old end misses at the new one.
inline void quintic(const Piece &piece, double h, const double *f_old, const double *f, const Work &w) {
    const int64_t half = w.m / 2;
    double *rows = piece.rows;
    for (int64_t i = 0; i < half; ++i) {
        const double q = piece.y_old[i], v = piece.y_old[half + i], a = f_old[half + i];
        const double place = piece.y[i] - q - h * v - 0.5 * h * h * a;
        const double slope = h * (piece.y[half + i] - v - h * a);
        const double curvature = h * h * (f[half + i] - a);
        const double coefficients[] = {q,
                                       h * v,
                                       0.5 * h * h * a,
                                       10 * place - 4 * slope + 0.5 * curvature,
                                       -15 * place + 7 * slope - curvature,
                                       6 * place - 3 * slope + 0.5 * curvature};
        for (int k = 0; k < 6; ++k) rows[k * half + i] = coefficients[k];
    }
}

// The tableau's own: rows h K^T P, and last what this misses at the end of the step, the projection's move.
inline void polynomial(const Dense &d, const Piece &piece, double h, const Work &step, const Work &w) {
    double *missing = piece.rows + d.polynomials * w.m;
    for (int64_t i = 0; i < w.m; ++i) missing[i] = piece.y[i] - piece.y_old[i];
    for (int64_t j = 0; j < d.polynomials; ++j) {
        double *row = piece.rows + j * w.m;
        weighted_sum(h, {d.weights + j * d.columns, step.K, d.columns, w.m}, row, w.m);
        for (int64_t i = 0; i < w.m; ++i) missing[i] -= row[i];
    }
}

// Rows of the interpolant if w.K holds all stages: change, h f_old - change, 2 change - h (f + f_old), h D K.
inline void rows_of_seventh(const Dense &d, const Piece &piece, double h, const Work &step, const Work &w) {
    const int64_t m = w.m;
    double *change = piece.rows, *left = change + m, *bend = left + m;
    for (int64_t i = 0; i < m; ++i) {
        change[i] = piece.y[i] - piece.y_old[i];
        left[i] = h * w.K[i] - change[i];
        bend[i] = 2 * change[i] - h * (step.last()[i] + w.K[i]);
    }
    for (int64_t j = 0; j < d.polynomials; ++j)
        weighted_sum(h, {d.weights + j * d.columns, w.K, d.columns, m}, bend + (1 + j) * m, m);
}

// DOP853's of order 7, from three more evaluations.
inline void seventh(const DenseRun &dense, const Piece &piece, double h, const double *y_old, const Work &step) {
    const Dense &d = dense.dense;
    const Work &w = dense.work;
    const int64_t known = step.stages + 1, m = w.m;
    copy(step.K, w.K, known * m);
    copy(step.rates, w.rates, known * w.balances);
    for (int64_t k = 0; k < d.further; ++k) {
        const double t = *piece.t_old + d.c[k] * h;
        combine(y_old, h, {d.A + k * d.columns, w.K, known + k, m}, w.stage, m);
        if (w.balances == 0) {
            dense.run.system.rhs_of_scratch(w, t, w.stage, w.row(known + k));
        } else {
            dense.run.system.rhs(w, t, w.stage, w.row(known + k));
            dense.run.system.rates(w, t, w.stage, w.row(known + k), w.rate(known + k));
        }
        ++w.counters[NFEV];
    }
    rows_of_seventh(d, piece, h, step, w);
}

// Constants of the recurrences below, which take divisions.
struct LegendreFactors {
    double ahead[MOST_NODES + 1], behind[MOST_NODES + 1], integral[MOST_NODES + 1];

    constexpr LegendreFactors() : ahead{}, behind{}, integral{} {
        for (int j = 0; j <= MOST_NODES; ++j) {
            ahead[j] = (2.0 * j + 1.0) / (j + 1.0);
            behind[j] = j / (j + 1.0);
            integral[j] = 0.5 / (2.0 * j + 1.0);
        }
    }
};

constexpr LegendreFactors LEGENDRE;

// Integrals of the Legendre polynomials P_0 to P_(count - 1) of 2 theta - 1 over theta, from the start of a step on: once
// for velocities, twice for positions. The integral of P_j is a difference of P_(j + 1) and P_(j - 1), and its integral the
// same difference of their integrals.
struct LegendreIntegrals {
    double once[MOST_NODES + 1], twice[MOST_NODES];

    LegendreIntegrals(double theta, int64_t count) {
        const double x = 2.0 * theta - 1.0;
        double before = 1.0, here = x;
        once[0] = theta;
        for (int64_t j = 1; j <= count; ++j) {
            const double next = LEGENDRE.ahead[j] * x * here - LEGENDRE.behind[j] * before;
            once[j] = LEGENDRE.integral[j] * (next - before);
            before = here;
            here = next;
        }
        twice[0] = 0.5 * theta * theta;
        for (int64_t j = 1; j < count; ++j) twice[j] = LEGENDRE.integral[j] * (once[j + 1] - once[j - 1]);
    }
};

// The state a time `passed` after the start of a step, from accelerations: h rows are what they add to velocities, and
// h^2 rows under the weights `twice` what they add to positions.
inline void integrate(const Piece &piece, double h, double passed, const Rows &rows, const double *twice, double *out) {
    const int64_t half = rows.stride;
    weighted_sum(h * h, {twice, rows.first, rows.count, half}, out, half);
    weighted_sum(h, rows, out + half, half);
    for (int64_t i = 0; i < half; ++i) {
        const double v = piece.y_old[half + i];
        out[i] = piece.y_old[i] + (passed * v + out[i]);
        out[half + i] = v + out[half + i];
    }
}

// The state at t_old + theta h by the accelerations' polynomial, whose Legendre coefficients are the first rows.
inline void from_accelerations(const Dense &d, const Piece &piece, double theta, double *out, const Work &w) {
    const int64_t half = w.m / 2;
    const double h = *piece.t - *piece.t_old;
    const LegendreIntegrals integrals(theta, d.polynomials);
    integrate(piece, h, h * theta, {integrals.once, piece.rows, d.polynomials, half}, integrals.twice, out);
}

// For y = (q, v) of a Nystrom method: the accelerations at further stages, which the method's own ones give accurately, and
// the polynomial through some of them, integrated. Its rows are Legendre coefficients, and last what the integrals miss at
// the end of the step: the method's error and the projection's move.
inline void nystrom(const DenseRun &dense, const Piece &piece, double h, const double *y_old, const Work &step) {
    const Dense &d = dense.dense;
    const Work &w = dense.work;
    const int64_t known = step.stages + 1, m = w.m, half = m / 2;
    const double *accelerations = w.K + half;
    copy(step.K, w.K, known * m);
    copy(y_old + half, w.stage + half, half);
    for (int64_t k = 0; k < d.further; ++k) {
        nystrom_position(y_old, h, d.c[k], {d.A + k * d.columns, accelerations, known + k, m}, w.stage, half);
        dense.run.system.rhs_of_scratch(w, *piece.t_old + d.c[k] * h, w.stage, w.row(known + k));
        ++w.counters[NFEV];
    }
    for (int64_t j = 0; j < d.polynomials; ++j)
        weighted_sum(1.0, {d.weights + j * d.columns, accelerations, d.columns, m}, piece.rows + j * half, half);
    double *missing = piece.rows + (d.rows() - 1) * m;
    from_accelerations(d, piece, 1.0, missing, w);
    for (int64_t i = 0; i < m; ++i) missing[i] = piece.y[i] - missing[i];
}

// How many nodes before the newest a step begins at t_old.
inline int64_t nodes_back(const Multistep &ms, double t_old) {
    return ms.place[NEWEST] - std::llround((t_old - ms.t0) / ms.h);
}

// For the nodes of a multistep method: the accelerations of the whole history, and behind them how many nodes before the
// newest the step begins, and its length in nodes' distances; before these, what the projections of the states that are
// handed out change between the ends.
inline void history(const Dense &d, const Piece &piece, const double *y_old, const double *y, const Work &w) {
    const Multistep &ms = *d.multistep;
    double *missing = piece.rows + (d.rows() - 2) * w.m, *about = missing + w.m;
    for (int64_t i = 0; i < w.m; ++i) missing[i] = (piece.y[i] - y[i]) - (piece.y_old[i] - y_old[i]);
    const double h = *piece.t - *piece.t_old;
    about[0] = static_cast<double>(nodes_back(ms, *piece.t_old));
    about[1] = h / ms.h;
    for (int64_t j = 0; j < ms.order; ++j) copy(newest(ms) - j * ms.pitch, piece.rows + j * ms.half, ms.half);
}

// The derivative at the start or at the end of the step just made from t_old, at the state y at t: where the step left it,
// from the history of a multistep method, or by an evaluation where the method leaves none.
inline const double *slope_at(bool end, const Run &run, const Dense &d, double t_old, double t, const double *y) {
    double *f = end ? d.work.last() : d.work.row(0);
    const double *left = end ? run.work.last() : run.work.row(0);
    if (d.own_slopes) {
        run.system.rhs(d.work, t, y, f);
        ++run.work.counters[NFEV];
        return f;
    }
    if (!d.multistep || d.multistep->brief) return left;
    const int64_t back = nodes_back(*d.multistep, t_old) - end;
    if (back < 0) return left;
    slope_of(*d.multistep, back, y, f);
    return f;
}

// The state by a history: that at the start of the step, and the accelerations' polynomial integrated twice.
inline void from_history(const Dense &d, const Piece &piece, double theta, double *out, const Work &w) {
    const double *about = piece.rows + (d.rows() - 1) * w.m;
    const int64_t order = d.columns, half = w.m / 2;
    const double x = theta * about[1], h = (*piece.t - *piece.t_old) / about[1];
    std::vector<double> weights(2 * order);
    for (int64_t j = 0; j < order; ++j) {
        const double *polynomial = d.weights + (static_cast<int64_t>(about[0]) * order + j) * order;
        double place = 0.0, speed = 0.0;
        for (int64_t k = order - 1; k >= 0; --k) {
            place = place * x + polynomial[k] / static_cast<double>((k + 1) * (k + 2));
            speed = speed * x + polynomial[k] / static_cast<double>(k + 1);
        }
        weights[j] = place * x * x;
        weights[order + j] = speed * x;
    }
    integrate(piece, h, h * x, {weights.data() + order, piece.rows, order, half}, weights.data(), out);
}

// Project w.y_hat onto w.target by Newton steps, into `out`; return false if no state nearby meets the target. One step
// removes a residual whose square is far below the rounding of the invariant's terms; no evaluation confirms that.
inline bool project_sample(const Run &run, double t, double *out) {
    const Options &o = run.options;
    const Work &w = run.work;
    for (int64_t k = 0; k < o.iterations; ++k) {
        evaluate_gradients(run, t, w.y_hat, w.last());
        evaluate_invariants(run, t, w.y_hat);
        if (!residuals<double>(nullptr, w.y_hat, o, w, w.before)) {
            copy(w.y_hat, out, w.m);
            return all_finite(out, w.m);
        }
        const int64_t rank = first_move(o, w, nullptr, out, false);
        if (rank < 0) return false;
        bool sure = rank == w.l, met = true;
        for (int64_t i = 0; i < w.l; ++i) sure &= std::abs(w.before[i]) <= SMALL_SHARE * o.per_band * w.band[i];
        if (sure) return all_finite(out, w.m);
        evaluate_invariants(run, t, out);
        if (judge(limits(o, w), nullptr, out, o, w) != OK) return false;
        for (int64_t i = 0; i < w.l; ++i) met &= std::abs(w.residual[i]) <= w.band[i];
        if (met) return true;
        copy(out, w.y_hat, w.m);
    }
    return true;
}

// Fit the columns of derivatives to the state in front of them, which meets its targets.
inline void fit_columns(const DenseRun &dense, double t, double *y) {
    const Columns &columns = dense.dense.options.columns;
    if (columns.count == 0 || dense.work.l == 0) [[likely]]
        return;
    const Step at_rest{t, t, 0.0, y, y, true, false};
    project_columns_behind(dense.run, at_rest);
}

// The state y at t, where the balances have these values, which no projection has made, as it is handed out: a copy projected onto the targets, or y itself if it
// misses them by rounding only, or if no state nearby meets them. With the error metric each block moves in proportion to
// its size. The copy depends on nothing but the state, so that it is the same as the end of one step and as the start of the
// next.
inline void hand_out(const Run &run, const DenseRun &dense, double t, const double *y, const double *balances,
                     double *out) {
    const Dense &d = dense.dense;
    const Work &w = dense.work;
    System &system = dense.run.system;
    const auto try_to_project = [&] {
        copy(y, w.y_hat, w.m);
        return project_sample(dense.run, t, out);
    };
    copy(y, out, w.m);
    copy(run.work.target, w.target, w.l);
    for (int64_t b = 0; b < w.balances; ++b) w.target[d.options.balances.place[b]] = balances[b];
    system.inv(w, t, y, w.values);
    bool meets = true;
    for (int64_t i = 0; i < w.l; ++i) {
        const double size = std::max(std::max(std::abs(w.values[i]), std::abs(w.target[i])), d.options.scales[i]);
        meets &= std::abs(w.values[i] - w.target[i]) <= SHOWN_ROUNDINGS * EPS * size;
    }
    if (meets) return fit_columns(dense, t, out);
    if (d.by_travel)
        weigh_blocks(w.sigma, d.options.blocks, w,
                     [&](int64_t b) { return block_norm(y, nullptr, b, d.options.blocks, w); });
    else
        copy(run.work.sigma, w.sigma, w.m);
    bool met = try_to_project();
    if (!met) {
        fill(w.sigma, 1.0, w.m);
        met = try_to_project();
    }
    if (!met) return copy(y, out, w.m);
    fit_columns(dense, t, out);
}

// The interpolant of the balances, of the kind that the state has, with their rates in the place of its derivatives.
inline void describe_balances(const Dense &d, const Piece &piece, double h, const Work &step, const Work &w) {
    const Work rates = work_of_balances(w), rates_of_step = work_of_balances(step);
    const Piece balances = piece.of_balances();
    copy(step.level_old, balances.y_old, w.balances);
    copy(step.level, balances.y, w.balances);
    if (d.kind == CUBIC) cubic(balances, h, rates_of_step.row(0), rates_of_step.last(), rates);
    if (d.kind == HISTORY) {
        const Multistep &ms = *d.multistep;
        const int64_t back = nodes_back(ms, *piece.t_old), at = ms.place[NEWEST_ROW] - back;
        cubic(balances, h, ms.rates_at(at), back > 0 ? ms.rates_at(at + 1) : rates_of_step.last(), rates);
    }
    if (d.kind == POLYNOMIAL) polynomial(d, balances, h, rates_of_step, rates);
    if (d.kind == SEVENTH) rows_of_seventh(d, balances, h, rates_of_step, rates);
}

// The interpolant over a step from y_old at t_old to y at t, from the buffers that it left. It meets the states at both ends
// as they are handed out.
inline void describe(const Run &run, const DenseRun &dense, double t_old, const double *y_old, double t,
                     const double *y, double *out) {
    const Dense &d = dense.dense;
    const Work &w = dense.work, &step = run.work;
    const Piece piece(out, d);
    const double h = t - t_old;
    *piece.t_old = t_old;
    *piece.t = t;
    *piece.known = 0.0;
    const auto end_of_piece = [&](bool waiting, double time, const double *state, const double *balances, double *end) {
        if (d.shows && waiting) return hand_out(run, dense, time, state, balances, end);
        copy(state, end, w.m);
    };
    end_of_piece(d.waiting[0], t_old, y_old, step.level_old, piece.y_old);
    end_of_piece(d.waiting[1], t, y, step.level, piece.y);
    const double *f_old = slope_at(false, run, d, t_old, t_old, y_old), *f = slope_at(true, run, d, t_old, t, y);
    if (d.kind == CUBIC) cubic(piece, h, f_old, f, w);
    if (d.kind == QUINTIC) quintic(piece, h, f_old, f, w);
    if (d.kind == POLYNOMIAL) polynomial(d, piece, h, step, w);
    if (d.kind == SEVENTH) seventh(dense, piece, h, y_old, step);
    if (d.kind == NYSTROM) nystrom(dense, piece, h, y_old, step);
    if (d.kind == HISTORY) history(d, piece, y_old, y, w);
    if (w.balances > 0) describe_balances(d, piece, h, step, w);
    if (d.by_travel)
        travelled(piece, h, f_old, f, d.options.blocks, w);
    else
        copy(step.sigma, piece.sigma, w.m);
}

// The cubic at t_old + theta h.
inline void from_cubic(const Piece &piece, double theta, double *out, const Work &w) {
    const int64_t m = w.m;
    const double rest = 1.0 - theta, *rows = piece.rows;
    for (int64_t i = 0; i < m; ++i)
        out[i] = piece.y_old[i] + theta * rows[i] + theta * rest * (rest * rows[m + i] - theta * rows[2 * m + i]);
}

// The interpolant itself, at t_old + theta h.
inline void evaluate(const Dense &d, const Piece &piece, double theta, double *out, const Work &w) {
    const int64_t m = w.m, half = m / 2;
    const double rest = 1.0 - theta;
    const double *rows = piece.rows;
    if (d.kind == HISTORY) {
        from_history(d, piece, theta, out, w);
    } else if (d.kind == NYSTROM) {
        from_accelerations(d, piece, theta, out, w);
    } else if (d.kind == CUBIC) {
        from_cubic(piece, theta, out, w);
    } else if (d.kind == QUINTIC) {
        const double h = *piece.t - *piece.t_old;
        for (int64_t i = 0; i < half; ++i) {
            double place = rows[5 * half + i], slope = 5.0 * place;
            for (int k = 4; k >= 0; --k) place = place * theta + rows[k * half + i];
            for (int k = 4; k >= 1; --k) slope = slope * theta + k * rows[k * half + i];
            out[i] = place;
            out[half + i] = slope / h;
        }
    } else if (d.kind == POLYNOMIAL) {
        for (int64_t i = 0; i < m; ++i) {
            double total = 0.0;
            for (int64_t j = d.polynomials - 1; j >= 0; --j) total = (total + rows[j * m + i]) * theta;
            out[i] = piece.y_old[i] + total;
        }
    } else {
        for (int64_t i = 0; i < m; ++i) {
            double total = 0.0;
            for (int64_t k = d.rows() - 1, odd = 0; k >= 0; --k, odd = !odd)
                total = (total + rows[k * m + i]) * (odd ? rest : theta);
            out[i] = total + piece.y_old[i];
        }
    }
    if (d.kind != HISTORY && d.kind != NYSTROM && d.kind != POLYNOMIAL) return;
    const double *missing = rows + (d.rows() - (d.kind == HISTORY ? 2 : 1)) * m;
    const double share = theta * theta * (3.0 - 2.0 * theta);
    for (int64_t i = 0; i < m; ++i) out[i] += share * missing[i];
}

// The state at t: an end of the step, or the interpolant's projected. Where no state near it meets the levels it is given
// as it is, and counted; beyond the step, where an extrapolation may lead anywhere, without a count.
inline void interpolate(const DenseRun &dense, double *floats, double t, double *out) {
    const Dense &d = dense.dense;
    const Work &w = dense.work;
    const Piece piece(floats, d);
    if (t == *piece.t) return copy(piece.y, out, w.m);
    if (t == *piece.t_old) return copy(piece.y_old, out, w.m);
    const double theta = (t - *piece.t_old) / (*piece.t - *piece.t_old);
    evaluate(d, piece, theta, out, w);
    if (w.l == 0) return;
    System &system = dense.run.system;
    if (*piece.known == 0.0) {
        system.inv(w, *piece.t_old, piece.y_old, piece.levels_old);
        system.inv(w, *piece.t, piece.y, piece.levels);
        *piece.known = 1.0;
    }
    const double share = std::min(1.0, std::max(0.0, theta));
    for (int64_t i = 0; i < w.l; ++i) w.target[i] = (1.0 - share) * piece.levels_old[i] + share * piece.levels[i];
    if (w.balances > 0) {  // these change by more than a line between the two ends
        if (d.kind == HISTORY)
            from_cubic(piece.of_balances(), theta, w.rates, work_of_balances(w));
        else
            evaluate(d, piece.of_balances(), theta, w.rates, work_of_balances(w));
        for (int64_t b = 0; b < w.balances; ++b)
            w.target[d.options.balances.place[b]] +=
                w.rates[b] - ((1.0 - share) * piece.balance_old[b] + share * piece.balance[b]);
    }
    copy(piece.sigma, w.sigma, w.m);
    copy(out, w.y_hat, w.m);
    if (project_sample(dense.run, t, out)) return fit_columns(dense, t, out);
    evaluate(d, piece, theta, out, w);
    if (theta != share) return;
    if (d.missed[0] == 0.0) d.missed[1] = t;
    d.missed[0] += 1.0;
}

}  // namespace eip
