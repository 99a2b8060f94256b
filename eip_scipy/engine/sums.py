"""Reductions in eight explicit lanes: fast, and the same bits wherever they are compiled.

A plain loop over a sum is not vectorised without "fastmath", which would let every place where the loop is inlined
choose its own order of summation. Here the order is fixed: lane k sums the entries k, k + 8, k + 16, ..., the lanes
are added in pairs, the entries beyond the last multiple of eight come last. Members of an ensemble that run side by
side (see `octets`) take their sums in the same order, so that each gets the bits of a run of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba import config, types
from numba.core import cgutils
from numba.extending import intrinsic, lower_builtin, type_callable

from .caching import cached_njit
from .octets import OCTET, in_octets, over_members, spread, where

__all__ = ["abs_dot", "combined_rows", "dot", "largest", "out_of_line", "remove_component", "weighted_rows"]

LANES = 8
WIDTHS = (16, 8, 4, 2, 1)  # of sums over rows: two vectors side by side wait less for each other
DOUBLE = ir.DoubleType()
VECTOR = ir.VectorType(DOUBLE, LANES)


def _pointer(context: Any, builder: Any, kind: Any, array: Any, i: Any) -> Any:  # emits LLVM
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [i]), VECTOR.as_pointer())


def _load(builder: Any, pointer: Any) -> Any:  # emits LLVM
    return builder.load(pointer, align=8)


def _fold(builder: Any, vector: Any, join: Callable[..., Any]) -> Any:  # emits LLVM
    lanes = [builder.extract_element(vector, ir.Constant(ir.IntType(32), k)) for k in range(LANES)]
    while len(lanes) > 1:
        half = len(lanes) // 2
        lanes = [join(builder, lanes[k], lanes[k + half]) for k in range(half)]
    return lanes[0]


def _add(builder: Any, a: Any, b: Any) -> Any:  # emits LLVM
    return builder.fadd(a, b)


def _larger(builder: Any, a: Any, b: Any) -> Any:  # emits LLVM
    return builder.select(builder.fcmp_ordered(">", b, a), b, a)


def _loop(builder: Any, n: Any, body: Callable[[Any], Any], join: Callable[..., Any] = _add) -> Any:  # emits LLVM
    """The vectors that `body` gives for i = 0, 8, ... below n, joined by lane, then the lanes."""
    total = cgutils.alloca_once_value(builder, ir.Constant(VECTOR, [0.0] * LANES))
    zero, step = (ir.Constant(n.type, value) for value in (0, LANES))
    with cgutils.for_range_slice(builder, zero, n, step, n.type) as (i, _):
        builder.store(join(builder, builder.load(total), body(i)), total)
    return _fold(builder, builder.load(total), join)


def _products(context: Any, builder: Any, signature: Any, arguments: Any, i: Any) -> Any:  # emits LLVM
    a, b = (_load(builder, _pointer(context, builder, signature.args[k], arguments[k], i)) for k in range(2))
    return builder.fmul(a, b)


def _members_dot(a, b, n):  # emits LLVM
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = spread(0.0)
    for i in range(0, n, 8):
        s0 += a[i] * b[i]
        s1 += a[i + 1] * b[i + 1]
        s2 += a[i + 2] * b[i + 2]
        s3 += a[i + 3] * b[i + 3]
        s4 += a[i + 4] * b[i + 4]
        s5 += a[i + 5] * b[i + 5]
        s6 += a[i + 6] * b[i + 6]
        s7 += a[i + 7] * b[i + 7]
    return ((s0 + s4) + (s2 + s6)) + ((s1 + s5) + (s3 + s7))


def _members_abs_dot(a, b, n):  # emits LLVM
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = spread(0.0)
    for i in range(0, n, 8):
        s0 += abs(a[i] * b[i])
        s1 += abs(a[i + 1] * b[i + 1])
        s2 += abs(a[i + 2] * b[i + 2])
        s3 += abs(a[i + 3] * b[i + 3])
        s4 += abs(a[i + 4] * b[i + 4])
        s5 += abs(a[i + 5] * b[i + 5])
        s6 += abs(a[i + 6] * b[i + 6])
        s7 += abs(a[i + 7] * b[i + 7])
    return ((s0 + s4) + (s2 + s6)) + ((s1 + s5) + (s3 + s7))


def _members_largest(a, n):  # emits LLVM
    top = spread(0.0)
    for i in range(n):
        top = max(top, a[i])
    return top


@intrinsic  # emits LLVM
def _lanes_dot(typingctx, a, b, n):
    if over_members(a, b):
        return in_octets(_members_dot, OCTET, a, b, n)

    def codegen(context, builder, signature, arguments):
        return _loop(builder, arguments[2], lambda i: _products(context, builder, signature, arguments, i))

    return types.float64(a, b, types.intp), codegen


@intrinsic  # emits LLVM
def _lanes_abs_dot(typingctx, a, b, n):
    if over_members(a, b):
        return in_octets(_members_abs_dot, OCTET, a, b, n)

    def codegen(context, builder, signature, arguments):
        kind = ir.FunctionType(VECTOR, [VECTOR])
        fabs = cgutils.get_or_insert_function(builder.module, kind, f"llvm.fabs.v{LANES}f64")
        return _loop(
            builder,
            arguments[2],
            lambda i: builder.call(fabs, [_products(context, builder, signature, arguments, i)]),
        )

    return types.float64(a, b, types.intp), codegen


@intrinsic  # emits LLVM
def _lanes_largest(typingctx, a, n):
    if over_members(a):
        return in_octets(_members_largest, OCTET, a, n)

    def codegen(context, builder, signature, arguments):
        return _loop(
            builder,
            arguments[1],
            lambda i: _load(builder, _pointer(context, builder, signature.args[0], arguments[0], i)),
            _larger,
        )

    return types.float64(a, types.intp), codegen


def _spread(builder: Any, value: Any, kind: Any) -> Any:  # emits LLVM
    vector = ir.Constant(kind, ir.Undefined)
    for k in range(kind.count):
        vector = builder.insert_element(vector, value, ir.Constant(ir.IntType(32), k))
    return vector


@intrinsic  # emits LLVM
def _lanes_remove(typingctx, row, unit_row, r, n):
    def codegen(context, builder, signature, arguments):
        spread = _spread(builder, arguments[2], VECTOR)

        def body(i):
            target = _pointer(context, builder, signature.args[0], arguments[0], i)
            unit = _load(builder, _pointer(context, builder, signature.args[1], arguments[1], i))
            left = builder.fsub(_load(builder, target), builder.fmul(spread, unit))
            builder.store(left, target, align=8)
            return builder.fmul(left, left)

        return _loop(builder, arguments[3], body)

    return types.float64(row, unit_row, types.float64, types.intp), codegen


def _emit_rows(
    builder: Any, y: Any, scale: Any, weights: Any, K: Any, stride: Any, rows: Any, out: Any, i: Any, width: int
) -> None:  # emits LLVM
    """out[i : i + width] = y + scale times the sum, row by row, weights of 0 skipped; no y: without it."""
    kind = ir.VectorType(DOUBLE, width)

    def place(data: Any, at: Any) -> Any:
        return builder.bitcast(builder.gep(data, [at]), kind.as_pointer())

    total = cgutils.alloca_once_value(builder, ir.Constant(kind, [0.0] * width))
    zero, one = (ir.Constant(rows.type, value) for value in (0, 1))
    with cgutils.for_range_slice(builder, zero, rows, one, rows.type) as (j, _):
        weight = builder.load(builder.gep(weights, [j]))
        with builder.if_then(builder.fcmp_unordered("!=", weight, ir.Constant(DOUBLE, 0.0))):
            row = builder.load(place(K, builder.add(builder.mul(j, stride), i)), align=8)
            product = builder.fmul(_spread(builder, weight, kind), row)
            builder.store(builder.fadd(builder.load(total), product), total)
    result = builder.fmul(_spread(builder, scale, kind), builder.load(total))
    if y is not None:
        result = builder.fadd(builder.load(place(y, i), align=8), result)
    builder.store(result, place(out, i), align=8)


def _emit_choice(builder: Any, n: Any, widths: Sequence[int], blocks: Callable[[int], None]) -> None:  # emits LLVM
    """The first of the `widths` that n reaches."""
    width, *narrower = widths
    with builder.if_else(builder.icmp_signed(">=", n, ir.Constant(n.type, width))) as (then, otherwise):
        with then:
            blocks(width)
        with otherwise:
            if narrower:
                _emit_choice(builder, n, narrower, blocks)


def _emit_all_rows(context: Any, builder: Any, kinds: Any, y: Any, arguments: Any) -> Any:  # emits LLVM
    """All of out, from (scale, weights, K, rows, first, out)."""
    scale, weights, K, rows, first, out = arguments
    weights, K, out = (
        context.make_array(kind)(context, builder, a) for kind, a in zip(kinds, (weights, K, out), strict=True)
    )
    stride = cgutils.unpack_tuple(builder, K.shape)[1]
    data, n = builder.gep(K.data, [first]), out.nitems

    def fill(begin: Any, width: int) -> None:
        _emit_rows(builder, y, scale, weights.data, data, stride, rows, out.data, begin, width)

    def blocks(width: int) -> None:
        """Blocks of one width; the last one ends with the array and may overlap the one before it."""
        step = ir.Constant(n.type, width)
        last = builder.sub(n, step)
        with cgutils.for_range_slice(builder, ir.Constant(n.type, 0), n, step, n.type) as (i, _):
            fill(builder.select(builder.icmp_signed("<", i, last), i, last), width)

    _emit_choice(builder, n, WIDTHS, blocks)
    return context.get_dummy_value()


@intrinsic  # emits LLVM
def weighted_rows(typingctx, scale, weights, K, rows, first, out):
    """out = scale * sum_j weights[j] K[j, first:] over the first `rows` rows, in their order, zero weights skipped."""

    def codegen(context, builder, signature, arguments):
        return _emit_all_rows(context, builder, (weights, K, out), None, arguments)

    return types.void(types.float64, weights, K, types.intp, types.intp, out), codegen


@intrinsic  # emits LLVM
def combined_rows(typingctx, y, scale, weights, K, rows, first, out):
    """out = y + scale * that sum; y is not out."""

    def codegen(context, builder, signature, arguments):
        start = context.make_array(y)(context, builder, arguments[0]).data
        return _emit_all_rows(context, builder, (weights, K, out), start, arguments[1:])

    return types.void(y, types.float64, weights, K, types.intp, types.intp, out), codegen


def out_of_line():
    """Keep the function that calls this out of its callers, and its code small: it is rarely run."""


@type_callable(out_of_line)
def _type_out_of_line(context):
    return lambda: types.none


@lower_builtin(out_of_line)  # emits LLVM
def _mark_out_of_line(context, builder, signature, arguments):
    # Numba's `forceinline` is handed on from a function to all those that it calls.
    builder.function.attributes.discard("alwaysinline")
    for attribute in ("noinline", "cold", "optsize"):
        builder.function.attributes.add(attribute)
    return context.get_dummy_value()


if config.DISABLE_JIT:

    def weighted_rows(scale, weights, K, rows, first, out):
        out[:] = 0.0
        for j in range(rows):
            if weights[j] != 0.0:
                out += weights[j] * K[j, first : first + out.size]
        out *= scale

    def combined_rows(y, scale, weights, K, rows, first, out):
        weighted_rows(scale, weights, K, rows, first, out)
        out += y

    def _numpy_sum(products):
        lanes = np.add.reduce(products.reshape(-1, LANES), axis=0)
        while lanes.size > 1:
            lanes = lanes[: lanes.size // 2] + lanes[lanes.size // 2 :]
        return lanes[0]

    def _lanes_dot(a, b, n):
        return _numpy_sum(a[:n] * b[:n])

    def _lanes_abs_dot(a, b, n):
        return _numpy_sum(np.abs(a[:n] * b[:n]))

    def _lanes_largest(a, n):
        return np.max(a[:n], initial=0.0)

    def _lanes_remove(row, unit_row, r, n):
        row[:n] -= r * unit_row[:n]
        return _numpy_sum(row[:n] * row[:n])


_jit = cached_njit(error_model="numpy", _nrt=False)


@_jit
def dot(a, b):
    """A . b."""
    whole = a.size - a.size % LANES
    rest = 0.0
    for i in range(whole, a.size):
        rest += a[i] * b[i]
    return _lanes_dot(a, b, whole) + rest


@_jit
def abs_dot(a, b):
    """Sum of |a_i b_i|."""
    whole = a.size - a.size % LANES
    rest = 0.0
    for i in range(whole, a.size):
        rest += abs(a[i] * b[i])
    return _lanes_abs_dot(a, b, whole) + rest


@_jit
def largest(a):
    """Largest entry of a non-negative array, 0 for an empty one; NaN is passed over."""
    whole = a.size - a.size % LANES
    top = _lanes_largest(a, whole)
    for i in range(whole, a.size):
        top = where(a[i] > top, a[i], top)
    return top


@_jit
def remove_component(row, unit_row):
    """Row -= (unit_row . row) unit_row; returns that product and the square of what is left."""
    r = dot(unit_row, row)
    whole = row.size - row.size % LANES
    rest = 0.0
    for i in range(whole, row.size):
        left = row[i] - r * unit_row[i]
        row[i] = left
        rest += left * left
    return r, _lanes_remove(row, unit_row, r, whole) + rest
