// The local error of a raw step and its norm.
#pragma once

#include "system.hpp"

namespace eip {

// The first SAMPLED_FIRST projections of a run are examined. After them every SAMPLED_EACH-th one is, if the method has
// no error estimate of its own.
constexpr int64_t SAMPLED_FIRST = 8, SAMPLED_EACH = 16;
// If the method has an error estimate of its own, every OWN_EACH-th projection is examined for rates of change along
// the flow. With adaptive steps, which are longer, every ADAPTIVE_EACH-th one is, if f at the raw result is known
// anyway. Every RESOLUTION_EACH-th projection compares local errors with what the step changes in each block.
constexpr int64_t OWN_EACH = 32, ADAPTIVE_EACH = 4, RESOLUTION_EACH = 64;

// Square of component i of a in units of atol + rtol max(|y|, |y_hat|); a complex one is a pair of floats.
inline double relative_square(const double *a, int64_t i, const double *y, const double *y_hat, const Options &o) {
    double size, part;
    if (o.blocks.width == 1) {
        size = std::max(std::abs(y[i]), std::abs(y_hat[i]));
        part = std::abs(a[i]);
    } else {
        size = std::max(std::hypot(y[2 * i], y[2 * i + 1]), std::hypot(y_hat[2 * i], y_hat[2 * i + 1]));
        part = std::hypot(a[2 * i], a[2 * i + 1]);
    }
    const double scale = o.atol[i] + o.rtol[o.blocks.width * i] * size;
    if (scale == 0.0) return part == 0.0 ? 0.0 : ENDLESS;
    const double ratio = part / scale;
    return ratio * ratio;
}

// SciPy's norm of the error: root mean square in units of the tolerance.
inline double error_norm(const double *err, const double *y, const double *y_hat, const Options &o, int64_t n) {
    double total = 0.0;
    for (int64_t i = 0; i < n; ++i) total += relative_square(err, i, y, y_hat, o);
    return std::sqrt(total / n);
}

// Returns the norm of the error of the state alone, for a run with columns of derivatives, which do not count.
[[gnu::noinline]] inline double error_norm_of_state(const double *err, const double *y, const double *y_hat,
                                                    const Options &o) {
    const Columns &columns = o.columns;
    const int64_t first = std::min(columns.seen, columns.cut()), second = columns.second(-1);
    double total = 0.0;
    for (int64_t i = 0; i < first; ++i) total += relative_square(err, i, y, y_hat, o);
    for (int64_t i = second; i < second + columns.seen - first; ++i) total += relative_square(err, i, y, y_hat, o);
    return std::sqrt(total / columns.seen);
}

// The norm of w.err.
template <class W>
inline double norm_of_error(const double *y, const auto &o, const W &w) {
    if (o.columns.count > 0) [[unlikely]]
        return error_norm_of_state(w.err, y, w.y_hat, o);
    return error_norm(w.err, y, w.y_hat, o, w.n);
}

// Returns the norm of the error from DOP853's pair of estimates, and replaces err by err |err| / hypot(err, low / 10),
// by component.
inline double paired_error_norm(double *err, const double *low, const double *y, const double *y_hat, const Options &o,
                                int64_t n) {
    const int64_t width = o.blocks.width;
    double fine = 0.0, coarse = 0.0;
    for (int64_t i = 0; i < n; ++i) {
        fine += relative_square(err, i, y, y_hat, o);
        coarse += relative_square(low, i, y, y_hat, o);
    }
    for (int64_t i = 0; i < n; ++i) {
        const double a = width == 1 ? std::abs(err[i]) : std::hypot(err[2 * i], err[2 * i + 1]);
        const double b = width == 1 ? std::abs(low[i]) : std::hypot(low[2 * i], low[2 * i + 1]);
        const double factor = a > 0.0 ? a / std::hypot(a, 0.1 * b) : 0.0;
        for (int64_t part = 0; part < width; ++part) err[width * i + part] *= factor;
    }
    if (fine == 0.0 && coarse == 0.0) return 0.0;
    return fine / std::sqrt((fine + 0.01 * coarse) * n);
}

// The estimate into w.err, and its norm for the step control.
template <class AnyRun>
inline void estimate_error(const AnyRun &run, const Step &step) {
    const auto &m = run.method;
    const auto &o = run.options;
    const auto &w = run.work;
    if (m.nystrom) {
        const int64_t half = w.m / 2;
        weighted_sum(step.h * step.h, {m.e, w.K + half, m.n_e, w.m}, w.err, half);
        weighted_sum(step.h, {m.e_v, w.K + half, m.n_e_v, w.m}, w.err + half, half);
        if (o.adaptive) w.norm[0] = norm_of_error(step.y, o, w);
    } else if (m.paired) {
        weighted_sum(step.h, {m.e, w.K, m.n_e, w.whole()}, w.err, w.m);
        weighted_sum(step.h, {m.e_low, w.K, m.n_e, w.whole()}, w.err_low, w.m);
        const int64_t seen = o.columns.count > 0 ? o.columns.seen : w.n;
        w.norm[0] = paired_error_norm(w.err, w.err_low, step.y, w.y_hat, o, seen);
    } else {
        weighted_sum(step.h, {m.e, w.K, m.n_e, w.whole()}, w.err, w.m);
        w.norm[0] = o.adaptive ? norm_of_error(step.y, o, w) : 0.0;
    }
}

// err = y_hat - y - h (f + f_hat) / 2: the size of the local error for orders 1 and 2, above it for others.
inline void trapezoid_error(const double *y, const double *y_hat, double h, const double *f, const double *f_hat,
                            double *err, int64_t n) {
    for (int64_t i = 0; i < n; ++i) err[i] = y_hat[i] - y[i] - 0.5 * h * (f[i] + f_hat[i]);
}

// Return whether this projection is one of those that are examined by an evaluation of f, which is not counted.
template <class AnyRun>
inline bool is_sampled(const AnyRun &run) {
    const int64_t begun = ++run.work.counters[BEGUN];
    const int64_t each = run.work.counters[HAVE_ERROR] ? OWN_EACH : SAMPLED_EACH;
    return run.options.watched && (begun % each == 0 || begun <= SAMPLED_FIRST);
}

template <class W>
inline bool is_sampled_for_resolution(const W &w) {
    return w.counters[BEGUN] <= SAMPLED_FIRST || w.counters[BEGUN] % RESOLUTION_EACH == 0;
}

// f at the raw result in w.last(), and the local error in w.err where the step makes no estimate of it.
template <class AnyRun>
[[gnu::cold, gnu::noinline]] inline void sample(const AnyRun &run, const Step &step) {
    const auto &m = run.method;
    const auto &w = run.work;
    if (!w.counters[HAVE_F]) run.system.rhs(w, step.t_new, w.y_hat, w.last());
    if (w.counters[HAVE_ERROR]) return;
    if (largest_abs(m.e, m.n_e) > 0.0 || largest_abs(m.e_v, m.n_e_v) > 0.0)
        estimate_error(run, step);
    else
        trapezoid_error(step.y, w.y_hat, step.h, w.row(0), w.last(), w.err, w.m);
    w.counters[HAVE_ERROR] = 1;
}

}  // namespace eip
