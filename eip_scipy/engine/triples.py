"""Sums over bodies and shifts of bodies, three components at once: the frame of N bodies costs a third this way.

A row of the state holds x, y, z of one body after the other. A vector of four lanes takes a body's three components
and one float of the next body's, which is overwritten when that body's turn comes; the last body is taken float by
float.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import config, types
from numba.core import cgutils
from numba.extending import intrinsic

from .octets import OCTET, in_octets, multiply_add, over_members, spread

__all__ = ["shift_and_weigh", "shift_bodies", "sum_bodies"]

DOUBLE, INDEX = ir.DoubleType(), ir.IntType(64)
VECTOR = ir.VectorType(DOUBLE, 4)
NOTHING = ir.Constant(VECTOR, ir.Undefined)


def _lane(k: int) -> Any:  # emits LLVM
    return ir.Constant(ir.IntType(32), k)


def _index(k: int) -> Any:  # emits LLVM
    return ir.Constant(INDEX, k)


def _multiply_add(builder: Any, a: Any, b: Any, c: Any) -> Any:  # emits LLVM
    kind = ir.FunctionType(VECTOR, [VECTOR] * 3)
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, "llvm.fmuladd.v4f64"), [a, b, c])


def _spread(builder: Any, number: Any) -> Any:  # emits LLVM
    first = builder.insert_element(NOTHING, number, _lane(0))
    return builder.shuffle_vector(first, NOTHING, ir.Constant(ir.VectorType(ir.IntType(32), 4), [0] * 4))


def _join(builder: Any, numbers: list[Any]) -> Any:  # emits LLVM
    vector = ir.Constant(VECTOR, [0.0] * 4)
    for k, number in enumerate(numbers):
        vector = builder.insert_element(vector, number, _lane(k))
    return vector


def _split(builder: Any, vector: Any) -> list[Any]:  # emits LLVM
    return [builder.extract_element(vector, _lane(k)) for k in range(3)]


class _Bodies:  # emits LLVM
    """Bodies of a row from the float `first` on; nothing behind the last one is touched."""

    def __init__(self, builder: Any, data: Any, first: Any) -> None:
        self.builder, self.data = builder, builder.gep(data, [first])

    def _floats(self, j: Any) -> list[Any]:
        b = self.builder
        return [b.gep(self.data, [b.add(b.mul(j, _index(3)), _index(k))]) for k in range(3)]

    def _vector(self, j: Any) -> Any:
        return self.builder.bitcast(self._floats(j)[0], VECTOR.as_pointer())

    def load(self, j: Any, last: bool) -> Any:
        if last:
            return _join(self.builder, [self.builder.load(p) for p in self._floats(j)])
        return self.builder.load(self._vector(j), align=8)

    def store(self, value: Any, j: Any, last: bool) -> None:
        if not last:
            self.builder.store(value, self._vector(j), align=8)
            return
        for number, pointer in zip(_split(self.builder, value), self._floats(j), strict=True):
            self.builder.store(number, pointer)


def _for_each(builder: Any, count: Any, body: Callable[[Any, bool], None]) -> None:  # emits LLVM
    last = builder.sub(count, _index(1))
    with cgutils.for_range_slice(builder, _index(0), last, _index(1), INDEX) as (j, _):
        body(j, False)
    body(last, True)


def _members_sum(weights, row, first, count):  # emits LLVM
    x = y = z = spread(0.0)
    for j in range(count):
        i = first + 3 * j
        x = multiply_add(weights[j], row[i], x)
        y = multiply_add(weights[j], row[i + 1], y)
        z = multiply_add(weights[j], row[i + 2], z)
    return x, y, z


def _members_shift(row, weights, x, y, z, out, first, count):  # emits LLVM
    for j in range(count):
        i = first + 3 * j
        out[i] = multiply_add(weights[j], -x, row[i])
        out[i + 1] = multiply_add(weights[j], -y, row[i + 1])
        out[i + 2] = multiply_add(weights[j], -z, row[i + 2])


def _members_shift_and_weigh(row, weights, x, y, z, sigma, out, first, count):  # emits LLVM
    for j in range(count):
        i = first + 3 * j
        out[i] = multiply_add(weights[j], -x, row[i]) * sigma[i]
        out[i + 1] = multiply_add(weights[j], -y, row[i + 1]) * sigma[i + 1]
        out[i + 2] = multiply_add(weights[j], -z, row[i + 2]) * sigma[i + 2]


def _data(context: Any, builder: Any, signature: Any, arguments: Any, k: int) -> Any:  # emits LLVM
    return context.make_array(signature.args[k])(context, builder, arguments[k]).data


@intrinsic  # emits LLVM
def sum_bodies(typingctx, weights, row, first, count):
    """The sums over `count` >= 1 bodies of weights[j] times x, y and z, which stand in the row from `first` on."""

    def codegen(context, builder, signature, arguments):
        weights, row = (_data(context, builder, signature, arguments, k) for k in (0, 1))
        bodies = _Bodies(builder, row, arguments[2])
        total = cgutils.alloca_once_value(builder, ir.Constant(VECTOR, [0.0] * 4))

        def add(j: Any, last: bool) -> None:
            weight = _spread(builder, builder.load(builder.gep(weights, [j])))
            builder.store(_multiply_add(builder, weight, bodies.load(j, last), builder.load(total)), total)

        _for_each(builder, arguments[3], add)
        return context.make_tuple(builder, signature.return_type, _split(builder, builder.load(total)))

    if over_members(row):
        return in_octets(_members_sum, types.UniTuple(OCTET, 3), weights, row, first, count)
    return types.UniTuple(types.float64, 3)(weights, row, types.intp, types.intp), codegen


def _emit_shift(context: Any, builder: Any, signature: Any, arguments: Any, weigh: bool) -> Any:  # emits LLVM
    first, count = arguments[-2:]
    row, weights, out = (_data(context, builder, signature, arguments, k) for k in (0, 1, len(arguments) - 3))
    row, out = _Bodies(builder, row, first), _Bodies(builder, out, first)
    sigma = _Bodies(builder, _data(context, builder, signature, arguments, 5), first) if weigh else None
    shift = builder.fneg(_join(builder, arguments[2:5]))

    def move(j: Any, last: bool) -> None:
        weight = _spread(builder, builder.load(builder.gep(weights, [j])))
        value = _multiply_add(builder, weight, shift, row.load(j, last))
        out.store(value if sigma is None else builder.fmul(value, sigma.load(j, last)), j, last)

    _for_each(builder, count, move)
    return context.get_dummy_value()


@intrinsic  # emits LLVM
def shift_bodies(typingctx, row, weights, x, y, z, out, first, count):
    """out = row - weights[j] (x, y, z) for `count` >= 1 bodies j; `out` and `row` must not overlap."""

    def codegen(context, builder, signature, arguments):
        return _emit_shift(context, builder, signature, arguments, False)

    if over_members(row):
        return in_octets(_members_shift, types.void, row, weights, OCTET, OCTET, OCTET, out, first, count)
    number = types.float64
    return types.void(row, weights, number, number, number, out, types.intp, types.intp), codegen


@intrinsic  # emits LLVM
def shift_and_weigh(typingctx, row, weights, x, y, z, sigma, out, first, count):
    """The same, times sigma."""

    def codegen(context, builder, signature, arguments):
        return _emit_shift(context, builder, signature, arguments, True)

    if over_members(row):
        return in_octets(
            _members_shift_and_weigh, types.void, row, weights, OCTET, OCTET, OCTET, sigma, out, first, count
        )
    number = types.float64
    return types.void(row, weights, number, number, number, sigma, out, types.intp, types.intp), codegen


if config.DISABLE_JIT:

    def sum_bodies(weights, row, first, count):
        return weights[:count] @ row[first : first + 3 * count].reshape(count, 3)

    def shift_bodies(row, weights, x, y, z, out, first, count):
        place = slice(first, first + 3 * count)
        out[place] = row[place] - (weights[:count, None] * (x, y, z)).ravel()

    def shift_and_weigh(row, weights, x, y, z, sigma, out, first, count):
        shift_bodies(row, weights, x, y, z, out, first, count)
        out[first : first + 3 * count] *= sigma[first : first + 3 * count]
