// Weights of the projection by the estimated errors, and corrections measured by them.
#pragma once

#include "system.hpp"

namespace eip {

constexpr double METRIC_FLOOR = 1e-7, TINY = 1e-290;

// x <- x^exponent, x in [0, 1]; for RK4 and DOP853 by square roots, several times faster than pow.
template <class Value>
inline void powers(Value *x, double exponent, int64_t n) {
    if (exponent == 1.25) {
        for (int64_t i = 0; i < n; ++i) x[i] *= sqrt(sqrt(x[i]));
    } else if (exponent == 1.125) {
        for (int64_t i = 0; i < n; ++i) x[i] *= sqrt(sqrt(sqrt(x[i])));
    } else {
        for (int64_t i = 0; i < n; ++i) x[i] = power(x[i], exponent);
    }
}

// Squared norm of block b of a, in units of 1 / unit.
template <class Value>
inline Value block_square(const Value *a, int64_t b, const Value &unit, const Blocks &blocks) {
    if (blocks.size == 3) {
        const Value x = a[3 * b] * unit, y = a[3 * b + 1] * unit, z = a[3 * b + 2] * unit;
        return x * x + y * y + z * z;
    }
    if (blocks.size == 2) {
        const Value x = a[2 * b] * unit, y = a[2 * b + 1] * unit;
        return x * x + y * y;
    }
    Value total = 0.0;
    for (uint64_t p = blocks.start[b]; p < blocks.start[b + 1]; ++p) {
        const Value x = a[blocks.member[p]] * unit;
        total += x * x;
    }
    return total;
}

// Per block the sum of a; consecutive blocks of two or three without looking places up.
template <class Value>
inline void block_sums(const Value *a, const Blocks &blocks, Value *out) {
    if (blocks.size == 3) {
        for (int64_t b = 0; b < blocks.count; ++b) out[b] = a[3 * b] + a[3 * b + 1] + a[3 * b + 2];
    } else if (blocks.size == 2) {
        for (int64_t b = 0; b < blocks.count; ++b) out[b] = a[2 * b] + a[2 * b + 1];
    } else {
        for (int64_t b = 0; b < blocks.count; ++b) {
            Value total = 0.0;
            for (uint64_t p = blocks.start[b]; p < blocks.start[b + 1]; ++p) total += a[blocks.member[p]];
            out[b] = total;
        }
    }
}

template <class Value>
inline void weighted_squares(const double *weights, const Value *a, Value *out, int64_t n) {
    for (int64_t i = 0; i < n; ++i) {
        const Value x = weights[i] * a[i];
        out[i] = x * x;
    }
}

// Squares so small or large that they are not to be trusted.
template <class Value>
inline Truth<Value> is_extreme(const Value &square) {
    return !((square > 1e-280) & (square < 1e280));
}

// Per component, where each stands alone: what `block_sizes` does.
template <class Value, class W>
inline Truth<Value> component_sizes(const Value *__restrict y, double rounding, const Options &o, const W &w) {
    const double *__restrict rtol = o.rtol;
    const Value *__restrict y_hat = w.y_hat, *__restrict err = w.err;
    Value *__restrict scale = w.scale, *__restrict ratio = w.ratio;
    Truth<Value> extreme{};
    for (int64_t i = 0; i < w.m; ++i) {
        const Value before = rtol[i] * y[i], after = rtol[i] * y_hat[i], x = rounding * y_hat[i];
        const Value square = max(after * after, before * before);
        extreme = extreme | is_extreme(square);
        scale[i] = sqrt(square);
        ratio[i] = sqrt(err[i] * err[i] + x * x);
    }
    return extreme;
}

// Per block: w.scale = max(|rtol y|, |rtol y_hat|), w.ratio = |(err, rounding y_hat)|; whether some are too extreme.
template <class Value, class W>
inline Truth<Value> block_sizes(const Value *y, double rounding, const Options &o, const W &w) {
    if (o.blocks.size == 1) return component_sizes(y, rounding, o, w);
    Value *scratch = w.sigma, *sizes = w.scale, *errors = w.ratio;
    weighted_squares(o.rtol, y, scratch, w.m);
    block_sums(scratch, o.blocks, errors);
    weighted_squares(o.rtol, w.y_hat, scratch, w.m);
    block_sums(scratch, o.blocks, sizes);
    Truth<Value> extreme{};
    for (int64_t b = 0; b < o.blocks.count; ++b) {
        sizes[b] = max(sizes[b], errors[b]);
        extreme = extreme | is_extreme(sizes[b]);
    }
    for (int64_t b = 0; b < o.blocks.count; ++b) sizes[b] = sqrt(sizes[b]);
    for (int64_t i = 0; i < w.m; ++i) {
        const Value x = rounding * w.y_hat[i];
        scratch[i] = w.err[i] * w.err[i] + x * x;
    }
    block_sums(scratch, o.blocks, errors);
    for (int64_t b = 0; b < o.blocks.count; ++b) errors[b] = sqrt(errors[b]);
    return extreme;
}

// The same, squares taken in a unit of each block's own, so that they neither vanish nor overflow.
[[gnu::cold, gnu::noinline]] inline void extreme_block_sizes(const double *y, double rounding, const Options &o,
                                                             const Work &w) {
    for (int64_t b = 0; b < o.blocks.count; ++b) {
        const uint64_t first = o.blocks.start[b], last = o.blocks.start[b + 1];
        double top = 0.0;
        for (uint64_t p = first; p < last; ++p) {
            const uint64_t i = o.blocks.member[p];
            const double size = o.rtol[i] * std::max(std::abs(y[i]), std::abs(w.y_hat[i]));
            top = std::max(top, std::max(size, std::abs(w.err[i])));
        }
        const double unit = top > 0.0 ? 1.0 / top : 1.0;
        double before = 0.0, after = 0.0, error = 0.0;
        for (uint64_t p = first; p < last; ++p) {
            const uint64_t i = o.blocks.member[p];
            const double weight = o.rtol[i] * unit;
            double x = weight * y[i];
            before += x * x;
            x = weight * w.y_hat[i];
            after += x * x;
            x = w.err[i] * unit;
            error += x * x;
            x = rounding * unit * w.y_hat[i];
            error += x * x;
        }
        w.scale[b] = std::sqrt(std::max(before, after)) / unit;
        w.ratio[b] = std::sqrt(error) / unit;
    }
}

// From the sizes of n blocks and of their errors the weights, in `ratio`; returns the largest relative error.
template <class Value>
inline Value block_weights(Value *__restrict scale, Value *__restrict ratio, const Options &o, int64_t n) {
    const double *__restrict atol = o.block_atol;
    for (int64_t b = 0; b < n; ++b) {
        scale[b] += atol[b];
        // Over a scale of 0 there is no error to speak of.
        ratio[b] = where(scale[b] > 0.0, ratio[b], 0.0) / max(scale[b], Value(TINY));
    }
    const Value largest_ratio = largest(ratio, n);
    Value inverse = 1.0 / positive(largest_ratio);
    for (int64_t b = 0; b < n; ++b) ratio[b] = min(Value(1.0), ratio[b] * inverse);
    powers(ratio, o.kappa, n);
    for (int64_t b = 0; b < n; ++b) ratio[b] = scale[b] * (ratio[b] + METRIC_FLOOR);
    inverse = 1.0 / positive(largest(ratio, n));
    for (int64_t b = 0; b < n; ++b) ratio[b] = where(largest_ratio > 0.0, ratio[b] * inverse, 1.0);
    return largest_ratio;
}

// The weights w.sigma from what `block_sizes` has found, and the blocks' scales; returns the largest relative error.
template <class W>
inline auto weights_from_sizes(const Options &o, const W &w) {
    const Blocks &blocks = o.blocks;
    const auto largest_ratio = block_weights(w.scale, w.ratio, o, blocks.size == 1 ? w.m : blocks.count);
    if (blocks.size == 1) {
        copy(w.ratio, w.sigma, w.m);
        return largest_ratio;
    }
    for (int64_t b = 0; b < blocks.count; ++b) {
        if (blocks.size == 3)
            w.sigma[3 * b] = w.sigma[3 * b + 1] = w.sigma[3 * b + 2] = w.ratio[b];
        else if (blocks.size == 2)
            w.sigma[2 * b] = w.sigma[2 * b + 1] = w.ratio[b];
        else
            for (uint64_t p = blocks.start[b]; p < blocks.start[b + 1]; ++p) w.sigma[blocks.member[p]] = w.ratio[b];
    }
    return largest_ratio;
}

// Weights w.sigma of the error metric and the blocks' scales; returns the largest relative error r. The error is the
// estimate and `rounding` times the state, in quadrature. r = 0 (no error at all) leaves the euclidean metric.
template <class W>
inline double error_metric(const double *y, double rounding, const Options &o, const W &w) {
    if (block_sizes(y, rounding, o, w)) extreme_block_sizes(y, rounding, o, w);
    return weights_from_sizes(o, w);
}

// Largest ratio over the blocks of the correction to the step's largest local error; 0 where there is none.
template <class Value, class W>
inline Value correction_in_local_errors(const Value &largest_error, const Options &o, const W &w) {
    if (!any(largest_error > 0.0)) return 0.0 * largest_error;
    Value top = 0.0;
    for (int64_t b = 0; b < (o.blocks.size == 1 ? w.m : o.blocks.count); ++b) {
        const Value unit = 1.0 / positive(w.scale[b]);
        Value square;
        if (o.blocks.size == 1) {
            const Value x = w.move[b] * unit;
            square = x * x;
        } else {
            square = block_square(w.move, b, unit, o.blocks);
        }
        top = where(w.scale[b] > 0.0, max(top, square), top);
    }
    return where(largest_error > 0.0, sqrt(top) / largest_error, 0.0 * largest_error);
}

// Half way, on a log scale, from the error metric to equal relative errors; blocks without error stay put.
inline void soften(const Options &o, const Work &w) {
    const double inverse = 1.0 / largest(w.scale, o.blocks.count);
    for (int64_t b = 0; b < o.blocks.count; ++b) {
        if (w.scale[b] == 0.0 || block_square(w.err, b, 1.0 / w.scale[b], o.blocks) == 0.0) continue;
        for (uint64_t p = o.blocks.start[b]; p < o.blocks.start[b + 1]; ++p) {
            const uint64_t i = o.blocks.member[p];
            w.sigma[i] = std::sqrt(w.sigma[i] * (w.scale[b] * inverse));
        }
    }
}

}  // namespace eip
