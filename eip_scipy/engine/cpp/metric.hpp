// Weights of the projection by the estimated errors, and corrections measured by them.
#pragma once

#include "system.hpp"

namespace eip {

constexpr double METRIC_FLOOR = 1e-7, TINY = 1e-290;
// The shares that are left one step later of the errors and the scales of the weights, and of the errors that a shift in
// time is measured by.
constexpr double SHORT_MEMORY = 0.8, LONG_MEMORY = 0.999;
// A shift in time of which less than this share, squared, changes no invariant is rounding.
constexpr double LEAST_SHIFT = 1e-12;

// Return whether a shift in time is removed from corrections: if each block is one component, real or complex.
inline bool removes_shift(const auto &o) {
    return o.metric == BY_ERROR && o.blocks.members == o.blocks.count * o.blocks.width;
}

inline int64_t blocks_of(const Options &o, int64_t m) { return o.blocks.size == 1 ? m : o.blocks.count; }

// Call set(i, b) for each float i of each block b.
template <class Set>
[[gnu::always_inline]] inline void each_float(const Blocks &blocks, int64_t m, const Set &set) {
    const auto adjacent = [&](auto size) {
        for (int64_t b = 0; b < blocks.count; ++b)
            for (int64_t c = 0; c < size; ++c) set(size * b + c, b);
    };
    if (blocks.size == 1) {
        for (int64_t i = 0; i < m; ++i) set(i, i);
    } else if (blocks.size == 3) {
        adjacent(std::integral_constant<int64_t, 3>());
    } else if (blocks.size == 2) {
        adjacent(std::integral_constant<int64_t, 2>());
    } else {
        for (int64_t b = 0; b < blocks.count; ++b)
            for (uint64_t p = blocks.start[b]; p < blocks.start[b + 1]; ++p) set(blocks.member[p], b);
    }
}

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

// Does what `block_sizes` does if each component is a block; no size is too extreme.
template <class Value, class W>
inline void component_sizes(const Value *__restrict y, double rounding, const Options &o, const W &w) {
    const double *__restrict rtol = o.rtol;
    const Value *__restrict y_hat = w.y_hat, *__restrict err = w.err;
    Value *__restrict scale = w.scale, *__restrict ratio = w.ratio;
    for (int64_t i = 0; i < w.m; ++i) {
        const Value size = abs(y_hat[i]);
        scale[i] = rtol[i] * max(abs(y[i]), size);
        ratio[i] = max(abs(err[i]), rounding * size);
    }
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

// Computes for each block w.scale = max(|rtol y|, |rtol y_hat|) and w.ratio = |max(err, rounding y_hat)|; returns whether
// some sizes are too extreme for squares.
template <class Value, class W>
inline Truth<Value> block_sizes(const Value *y, double rounding, const Options &o, const W &w) {
    if (o.blocks.size == 1) {
        component_sizes(y, rounding, o, w);
        return {};
    }
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
        const Value x = max(abs(w.err[i]), rounding * abs(w.y_hat[i]));
        scratch[i] = x * x;
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
            x = unit * std::max(std::abs(w.err[i]), rounding * std::abs(w.y_hat[i]));
            error += x * x;
        }
        w.scale[b] = std::sqrt(std::max(before, after)) / unit;
        w.ratio[b] = std::sqrt(error) / unit;
    }
}

// What is left of the memories after the steps since the last projection.
struct Kept {
    double brief, lasting;
};
template <class AnyRun>
inline Kept memory_kept(const AnyRun &run) {
    const int64_t waited = run.work.counters[WAITED];
    const double steps = static_cast<double>(1 + waited);
    const Kept kept = waited == 0 ? Kept{SHORT_MEMORY, LONG_MEMORY}
                                  : Kept{std::pow(SHORT_MEMORY, steps), std::pow(LONG_MEMORY, steps)};
    // The estimates of a multistep method have a memory of their own.
    return {run.method.multistep ? 0.0 : kept.brief, kept.lasting};
}

// The memory of the metric by block: the scale, the error in units of the step's largest relative one, and the largest
// relative error, in these units too, of a long time, which is known where each component is a block.
template <class Value>
struct MetricMemory {
    Value *scale, *error, *lasting;

    MetricMemory(Value *rows, int64_t n) : scale(rows), error(rows + n), lasting(rows + 2 * n) {}
};

// Compute, from the sizes of the blocks and of their errors, w.scale, its reciprocals w.inverse (0 for 0, where no error is
// known), the relative errors w.ratio of this step and those that are remembered, w.remembered, in units of the largest one
// of this step, which is returned.
template <class Value, class W>
inline Value remembered_errors(const Kept &kept, const Options &o, const W &w) {
    const int64_t n = blocks_of(o, w.m);
    const MetricMemory<Value> old(w.memory, n), now(w.memory_new, n);
    Value *__restrict scale = w.scale, *__restrict inverse = w.inverse, *__restrict ratio = w.ratio;
    for (int64_t b = 0; b < n; ++b) {
        scale[b] = now.scale[b] = max(scale[b] + o.block_atol[b], kept.brief * old.scale[b]);
        inverse[b] = where(scale[b] > 0.0, 1.0 / positive(scale[b]), 0.0);
        ratio[b] *= inverse[b];
    }
    const Value largest_ratio = largest(ratio, n), unit = 1.0 / positive(largest_ratio);
    for (int64_t b = 0; b < n; ++b) {
        ratio[b] = min(Value(1.0), ratio[b] * unit);
        now.error[b] = max(ratio[b] * scale[b], kept.brief * old.error[b]);
        w.remembered[b] = now.error[b] * inverse[b];
    }
    for (int64_t b = 0; removes_shift(o) && b < n; ++b) now.lasting[b] = max(ratio[b], kept.lasting * old.lasting[b]);
    return largest_ratio;
}

// Compute the weights of n blocks from their scales and their relative errors, which the weights replace.
template <class Value>
inline void block_weights(const Value *__restrict scale, Value *__restrict weights, const Options &o, int64_t n) {
    const auto known = largest(weights, n) > 0.0;
    powers(weights, o.kappa, n);
    Value top = 0.0;
    for (int64_t b = 0; b < n; ++b) {
        weights[b] = where(known, scale[b] * (weights[b] + METRIC_FLOOR), 1.0);
        top = max(top, weights[b]);
    }
    const auto extreme = !((top > 1e-100) & (top < 1e100));
    for (int64_t b = 0; any(extreme) && b < n; ++b) weights[b] = where(extreme, weights[b] / positive(top), weights[b]);
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
        for (int64_t i = 0; i < w.m; ++i) w.sigma[i] = where(is_constant(y, i, w), w.ratio[i], w.remembered[i]);
        return block_weights(w.scale, w.sigma, o, w.m);
    }
    for (int64_t b = 0; b < blocks.count; ++b)
        w.ratio[b] = where(is_constant_block(y, b, blocks, w), w.ratio[b], w.remembered[b]);
    block_weights(w.scale, w.ratio, o, blocks.count);
    each_float(blocks, w.m, [&](int64_t i, int64_t b) { w.sigma[i] = w.ratio[b]; });
}

// Compute the blocks' relative errors and scales, and return the largest relative error of the step. An error is the
// estimate, and unless it is carried along at least the rounding of the state.
template <class AnyRun>
inline double relative_errors(const double *y, const AnyRun &run) {
    const auto &o = run.options;
    const auto &w = run.work;
    const double rounding = o.compensated ? 0.0 : EPS;
    if (block_sizes(y, rounding, o, w)) extreme_block_sizes(y, rounding, o, w);
    return remembered_errors<double>(memory_kept(run), o, w);
}

// Remember the errors of a step that is accepted.
template <class W>
inline void remember_errors(const Options &o, const W &w) {
    if (o.metric == BY_ERROR) copy(w.memory_new, w.memory, (removes_shift(o) ? MEMORIES : 2) * blocks_of(o, w.m));
}

// Compute the flow f with each component in proportion to the square of its share in the lasting errors, and w.unit, the
// weight of the square of a component in the size of a correction. Each component is a block.
template <class Value, class W>
inline void shift_by_errors(const Options &o, const W &w, const Value *__restrict f, Value *__restrict shift) {
    const Value *__restrict lasting = MetricMemory<Value>(w.memory_new, o.blocks.count).lasting;
    const Value *__restrict inverse = w.inverse;
    Value *__restrict unit = w.unit;
    if (o.blocks.members < w.m) fill(shift, 0.0, w.m), fill(unit, 0.0, w.m);
    each_float(o.blocks, w.m, [=](int64_t i, int64_t b) {
        shift[i] = lasting[b] * lasting[b] * f[i];
        unit[i] = inverse[b] * inverse[b];
    });
}

// Largest ratio over the blocks of the correction to the step's largest local error; 0 where there is none.
template <class Value, class W>
inline Value correction_in_local_errors(const Value &largest_error, const Options &o, const W &w) {
    if (!any(largest_error > 0.0)) return 0.0 * largest_error;
    Value top = 0.0;
    for (int64_t b = 0; b < blocks_of(o, w.m); ++b) {
        const Value unit = w.inverse[b];
        Value square;
        if (o.blocks.size == 1) {
            const Value x = w.move[b] * unit;
            square = x * x;
        } else {
            square = block_square(w.move, b, unit, o.blocks);
        }
        top = max(top, square);
    }
    return where(largest_error > 0.0, sqrt(top) / largest_error, 0.0 * largest_error);
}

}  // namespace eip
