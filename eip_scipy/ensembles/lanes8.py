"""Numba type for eight members of an ensemble: functions written for one member are compiled for eight at a time.

A value of this type holds one float of each of eight members in a vector register. Arithmetic applies to each lane as
to a float, so that Numba compiles the same source for floats and for vectors, and every lane agrees bit by bit with the
float. A function cannot branch on values that differ between members: vectors cannot be compared, and a function with
such a branch does not compile.

An array of n vectors has the layout (n, 8) of doubles. Loaded only if a function is jitted.
"""

from __future__ import annotations

import itertools
import math
import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typeconv import Conversion
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import lower_builtin, lower_cast, models, register_model

from ..numba_duals import refuse_addresses

__all__ = ["LANES8"]

LANES = 8
VECTOR, INDEX = ir.VectorType(ir.DoubleType(), LANES), ir.IntType(32)
UNDEFINED = ir.Constant(VECTOR, ir.Undefined)


class Lanes8(types.Type):  # emits LLVM
    """Numba type that holds one float of each of eight members."""

    def __init__(self) -> None:
        super().__init__(name="lanes8")

    def can_convert_from(self, typingctx: Any, other: Any) -> Any:
        """Return the kind of conversion of a number, which has the same value in every lane; None for other types."""
        return Conversion.safe if isinstance(other, types.Float | types.Integer) else None


LANES8 = Lanes8()
refuse_addresses(LANES8, "vectors of eight members")
register_model(Lanes8)(lambda manager, kind: models.PrimitiveModel(manager, kind, VECTOR))


@lower_cast(types.Float, Lanes8)
@lower_cast(types.Integer, Lanes8)
def _cast_number(context, builder, from_type, to_type, value):  # emits LLVM
    first = builder.insert_element(UNDEFINED, context.cast(builder, value, from_type, types.float64), INDEX(0))
    return builder.shuffle_vector(first, UNDEFINED, ir.Constant(ir.VectorType(INDEX, LANES), [0] * LANES))


def _declare(function: Any, arguments: int, *, by_lanes: bool) -> None:  # emits LLVM
    """Declare the types of a function of vectors, any argument of which may be a plain number.

    If `by_lanes`, plain numbers keep their types, otherwise they become vectors.
    """

    @infer_global(function)
    class _Template(AbstractTemplate):
        def generic(self, args: tuple[Any, ...], kws: Any) -> Any:
            known = all(isinstance(a, Lanes8 | types.Float | types.Integer) for a in args)
            if len(args) == arguments and LANES8 in args and known:
                return signature(LANES8, *(args if by_lanes else [LANES8] * arguments))
            return None


def _define(functions: Any, arguments: int, emit: Callable[..., Any]) -> None:  # emits LLVM
    """Define functions of `arguments` vectors, whose LLVM code ``emit(builder, *vectors)`` writes."""
    for function in functions:
        _declare(function, arguments, by_lanes=False)
        lower_builtin(function, *[Lanes8] * arguments)(lambda context, builder, sig, args: emit(builder, *args))


def _intrinsic(name: str) -> Callable[..., Any]:  # emits LLVM
    def emit(builder: Any, *args: Any) -> Any:
        kind = ir.FunctionType(VECTOR, [VECTOR] * len(args))
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}f64"), args)

    return emit


_define((operator.add, operator.iadd), 2, lambda builder, a, b: builder.fadd(a, b))
_define((operator.sub, operator.isub), 2, lambda builder, a, b: builder.fsub(a, b))
_define((operator.mul, operator.imul), 2, lambda builder, a, b: builder.fmul(a, b))
_define((operator.truediv, operator.itruediv), 2, lambda builder, a, b: builder.fdiv(a, b))
_define([operator.neg], 1, lambda builder, a: builder.fneg(a))
_define([operator.pos], 1, lambda builder, a: a)
_define((abs, math.fabs), 1, _intrinsic("fabs"))
_define([math.sqrt], 1, _intrinsic("sqrt"))
_define([math.copysign], 2, _intrinsic("copysign"))
_define([max], 2, lambda builder, a, b: builder.select(builder.fcmp_ordered(">", b, a), b, a))
_define([min], 2, lambda builder, a, b: builder.select(builder.fcmp_ordered("<", b, a), b, a))


def _define_by_lanes(function: Any, arguments: int) -> None:  # emits LLVM
    """Define a function without a vector instruction: it is called as a function of floats for each lane."""
    _declare(function, arguments, by_lanes=True)

    def lower(context, builder, sig, args):
        kinds = tuple(types.float64 if a is LANES8 else types.unliteral(a) for a in sig.args)
        kind = context.typing_context.resolve_value_type(function)
        of_floats = context.typing_context.resolve_function_type(kind, kinds, {})
        callee, out = context.get_function(kind, of_floats), UNDEFINED
        # Numba passes constant exponents as Python numbers.
        args = [context.get_constant(types.int64, a) if isinstance(a, int) else a for a in args]
        for k in map(INDEX, range(LANES)):
            lane = []
            for value, own, plain, wanted in zip(args, sig.args, kinds, of_floats.args, strict=True):
                number = builder.extract_element(value, k) if own is LANES8 else value
                lane.append(number if plain == wanted else context.cast(builder, number, plain, wanted))
            out = builder.insert_element(out, callee(builder, lane), k)
        return out

    for choice in itertools.product((Lanes8, types.Float, types.Integer), repeat=arguments):
        if Lanes8 in choice:
            lower_builtin(function, *choice)(lower)


for _function in (
    math.sin, math.cos, math.tan, math.asin, math.acos, math.atan, math.sinh, math.cosh, math.tanh, math.exp,
    math.expm1, math.log, math.log1p,
):  # fmt: skip
    _define_by_lanes(_function, 1)
for _operation in (math.atan2, math.hypot, math.pow, operator.pow, operator.ipow):
    _define_by_lanes(_operation, 2)
