// Weights of the projection by the estimated errors, and corrections measured by them.
#pragma once

#include "system.hpp"

namespace eip {

constexpr double METRIC_FLOOR = 1e-7, TINY = 1e-290;
// The share of a relative error that the metric still remembers one step later.
constexpr double ERROR_MEMORY = 0.9;

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

// Returns whether a square is so small or so large that it cannot be relied on, because it may have underflowed or may
// overflow in sums.
template <class Value>
inline Truth<Value> is_extreme(const Value &square) {
    return !((square > 1e-280) & (square < 1e280));
}

// Does what `block_sizes` does if each component is a block.
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

// Replaces squares by their roots. A few that have just been written float by float are not read in vectors, which would wait
// until all those stores are done.
template <class Value>
inline void take_roots(Value *squares, int64_t n) {
    if constexpr (std::is_same_v<Value, double>)
        if (n < WIDTH) {
            for (int64_t b = 0; b < n; ++b) store_alone(sqrt(squares[b]), squares + b);
            return;
        }
    for (int64_t b = 0; b < n; ++b) squares[b] = sqrt(squares[b]);
}

// Computes for each block w.scale = max(|rtol y|, |rtol y_hat|) and w.ratio = |(err, rounding y_hat)|; returns whether
// some sizes are too extreme for squares.
template <class Value, class W>
inline Truth<Value> block_sizes(const Value *y, double rounding, const Options &o, const W &w) {
    if (o.blocks.size == 1) return component_sizes(y, rounding, o, w);
    Value *scratch = w.move, *sizes = w.scale, *errors = w.ratio;
    weighted_squares(o.rtol, y, scratch, w.m);
    block_sums(scratch, o.blocks, errors);
    weighted_squares(o.rtol, w.y_hat, scratch, w.m);
    block_sums(scratch, o.blocks, sizes);
    Truth<Value> extreme{};
    for (int64_t b = 0; b < o.blocks.count; ++b) {
        sizes[b] = max(sizes[b], errors[b]);
        extreme = extreme | is_extreme(sizes[b]);
    }
    take_roots(sizes, o.blocks.count);
    for (int64_t i = 0; i < w.m; ++i) {
        const Value x = rounding * w.y_hat[i];
        scratch[i] = w.err[i] * w.err[i] + x * x;
    }
    block_sums(scratch, o.blocks, errors);
    take_roots(errors, o.blocks.count);
    return extreme;
}

// Does what `block_sizes` does for extreme sizes: squares are taken in a unit of each block's own, so that they neither
// vanish nor overflow.
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

// Compute, from the sizes of n blocks and of their errors, the relative errors in units of the largest one: `ratio` of
// this step, `memory_new` with what is remembered of earlier steps, of which the share `kept` is left. Returns the
// largest relative error of this step.
template <class Value>
inline Value remembered_errors(Value *__restrict scale, Value *__restrict ratio, const Value *__restrict memory,
                               Value *__restrict memory_new, double kept, const Options &o, int64_t n) {
    const double *__restrict atol = o.block_atol;
    for (int64_t b = 0; b < n; ++b) {
        scale[b] += atol[b];
        // Over a scale of 0 there is no error to speak of.
        ratio[b] = where(scale[b] > 0.0, ratio[b], 0.0) / max(scale[b], Value(TINY));
    }
    const Value largest_ratio = largest(ratio, n), inverse = 1.0 / positive(largest_ratio);
    for (int64_t b = 0; b < n; ++b) {
        ratio[b] = min(Value(1.0), ratio[b] * inverse);
        memory_new[b] = max(ratio[b], kept * memory[b]);
    }
    return largest_ratio;
}

// Compute the weights of n blocks from their scales and their relative errors, which the weights replace.
template <class Value>
inline void block_weights(const Value *__restrict scale, Value *__restrict weights, const Options &o, int64_t n) {
    const auto known = largest(weights, n) > 0.0;
    powers(weights, o.kappa, n);
    for (int64_t b = 0; b < n; ++b) weights[b] = scale[b] * (weights[b] + METRIC_FLOOR);
    const Value inverse = 1.0 / positive(largest(weights, n));
    for (int64_t b = 0; b < n; ++b) weights[b] = where(known, weights[b] * inverse, 1.0);
}

// Return whether a step from y has neither changed component i nor seen an error there. A component that is constant for
// good, such as a parameter carried along as a component of the state, is not to be moved because of earlier steps.
template <class Value, class W>
inline Truth<Value> is_constant(const Value *y, int64_t i, const W &w) {
    return (w.y_hat[i] == y[i]) & (w.err[i] == 0.0);
}

// Return whether all components of block b are constant in this sense.
template <class Value, class W>
inline Truth<Value> is_constant_block(const Value *y, int64_t b, const Blocks &blocks, const W &w) {
    auto constant = is_constant(y, blocks.member[blocks.start[b]], w);
    for (uint64_t p = blocks.start[b] + 1; any(constant) && p < blocks.start[b + 1]; ++p)
        constant = constant & is_constant(y, blocks.member[p], w);
    return constant;
}

// Compute the weights w.sigma from the blocks' scales and relative errors after a step from y.
template <class Value, class W>
inline void weights_from_errors(const Value *y, const Options &o, const W &w) {
    const Blocks &blocks = o.blocks;
    if (blocks.size == 1) {
        for (int64_t i = 0; i < w.m; ++i) w.sigma[i] = where(is_constant(y, i, w), w.ratio[i], w.memory_new[i]);
        return block_weights(w.scale, w.sigma, o, w.m);
    }
    for (int64_t b = 0; b < blocks.count; ++b)
        w.ratio[b] = where(is_constant_block(y, b, blocks, w), w.ratio[b], w.memory_new[b]);
    block_weights(w.scale, w.ratio, o, blocks.count);
    for (int64_t b = 0; b < blocks.count; ++b) {
        if (blocks.size == 3)
            w.sigma[3 * b] = w.sigma[3 * b + 1] = w.sigma[3 * b + 2] = w.ratio[b];
        else if (blocks.size == 2)
            w.sigma[2 * b] = w.sigma[2 * b + 1] = w.ratio[b];
        else
            for (uint64_t p = blocks.start[b]; p < blocks.start[b + 1]; ++p) w.sigma[blocks.member[p]] = w.ratio[b];
    }
}

// Return the share of a remembered error that is left after the steps since the last projection. The estimates of a
// multistep method have a memory of their own.
template <class AnyRun>
inline double memory_kept(const AnyRun &run) {
    if (run.method.multistep) return 0.0;
    const int64_t waited = run.work.counters[WAITED];
    return waited == 0 ? ERROR_MEMORY : std::pow(ERROR_MEMORY, static_cast<double>(1 + waited));
}

// Compute the blocks' relative errors and scales, and return the largest relative error of the step. An error is the
// estimate and, unless it is carried along, the rounding of the state, in quadrature.
template <class AnyRun>
inline double relative_errors(const double *y, const AnyRun &run) {
    const auto &o = run.options;
    const auto &w = run.work;
    const double rounding = o.compensated ? 0.0 : EPS;
    if (block_sizes(y, rounding, o, w)) extreme_block_sizes(y, rounding, o, w);
    return remembered_errors(w.scale, w.ratio, w.memory, w.memory_new, memory_kept(run), o,
                             o.blocks.size == 1 ? w.m : o.blocks.count);
}

// Remember the errors of a step that is accepted.
template <class W>
inline void remember_errors(const Options &o, const W &w) {
    if (o.metric == BY_ERROR) copy(w.memory_new, w.memory, o.blocks.size == 1 ? w.m : o.blocks.count);
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

// Half way, on a log scale, from the error metric to equal relative errors; constants are left out.
inline void soften(const double *y, const Options &o, const Work &w) {
    const double inverse = 1.0 / largest(w.scale, o.blocks.count);
    for (int64_t b = 0; b < o.blocks.count; ++b) {
        if (is_constant_block(y, b, o.blocks, w)) continue;
        for (uint64_t p = o.blocks.start[b]; p < o.blocks.start[b + 1]; ++p) {
            const uint64_t i = o.blocks.member[p];
            w.sigma[i] = std::sqrt(w.sigma[i] * (w.scale[b] * inverse));
        }
    }
}

}  // namespace eip
