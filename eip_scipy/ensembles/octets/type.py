"""Numba type for eight members of an ensemble: functions written for one member are compiled for eight at a time.

A value of this type holds one float of each of eight members in a vector register. Arithmetic applies to each lane as
to a float, so that Numba compiles the same source for floats and for vectors, and every lane agrees bit by bit with the
float. A function cannot branch on values that differ between members: vectors cannot be compared, and a function with
such a branch does not compile.

An array of n vectors has the layout (n, 8) of doubles.
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

from ...core.numba_bridge import refuse_addresses

__all__ = ["OCTET"]

LANES = 8
VECTOR = ir.VectorType(ir.DoubleType(), LANES)


class Octet(types.Type):  # emits LLVM
    """Numba type that holds one float of each of eight members."""

    def __init__(self) -> None:
        super().__init__(name="octet")

    def can_convert_from(self, typingctx: Any, other: Any) -> Any:
        """Return the kind of conversion of a number, which has the same value in every lane; None for other types."""
        return Conversion.safe if isinstance(other, types.Float | types.Integer) else None


OCTET = Octet()
refuse_addresses(OCTET, "vectors of eight members")


@register_model(Octet)
class _OctetModel(models.PrimitiveModel):  # emits LLVM
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, VECTOR)


def _lane(k: int) -> Any:  # emits LLVM
    return ir.Constant(ir.IntType(32), k)


def _spread(builder: Any, value: Any) -> Any:  # emits LLVM
    kind = ir.VectorType(value.type, LANES)
    first = builder.insert_element(ir.Constant(kind, ir.Undefined), value, _lane(0))
    mask = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    return builder.shuffle_vector(first, ir.Constant(kind, ir.Undefined), mask)


@lower_cast(types.Float, Octet)
@lower_cast(types.Integer, Octet)
def _cast_number(context, builder, from_type, to_type, value):  # emits LLVM
    return _spread(builder, context.cast(builder, value, from_type, types.float64))


def _declare(function: Any, arguments: int, *, by_lanes: bool) -> None:  # emits LLVM
    """Declare the types of a function of vectors, any argument of which may be a plain number.

    If `by_lanes`, plain numbers keep their types, otherwise they become vectors.
    """

    @infer_global(function)
    class _Template(AbstractTemplate):
        def generic(self, args: tuple[Any, ...], kws: Any) -> Any:
            known = all(a is OCTET or isinstance(a, types.Float | types.Integer) for a in args)
            if len(args) != arguments or OCTET not in args or not known:
                return None
            return signature(OCTET, *(args if by_lanes else [OCTET] * arguments))


def _define(function: Any, arguments: int, emit: Callable[..., Any]) -> None:  # emits LLVM
    """Define a function of `arguments` vectors, whose LLVM code ``emit(builder, *vectors)`` writes."""
    _declare(function, arguments, by_lanes=False)

    @lower_builtin(function, *[Octet] * arguments)
    def _lower(context, builder, sig, args):
        return emit(builder, *args)


def _intrinsic(name: str) -> Callable[..., Any]:  # emits LLVM
    def emit(builder: Any, *args: Any) -> Any:
        kind = ir.FunctionType(VECTOR, [VECTOR] * len(args))
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}f64"), args)

    return emit


for _operators, _emit in (
    ((operator.add, operator.iadd), lambda builder, a, b: builder.fadd(a, b)),
    ((operator.sub, operator.isub), lambda builder, a, b: builder.fsub(a, b)),
    ((operator.mul, operator.imul), lambda builder, a, b: builder.fmul(a, b)),
    ((operator.truediv, operator.itruediv), lambda builder, a, b: builder.fdiv(a, b)),
):
    for _operator in _operators:
        _define(_operator, 2, _emit)
_define(operator.neg, 1, lambda builder, a: builder.fneg(a))
_define(operator.pos, 1, lambda builder, a: a)
_define(abs, 1, _intrinsic("fabs"))
_define(math.fabs, 1, _intrinsic("fabs"))
_define(math.sqrt, 1, _intrinsic("sqrt"))
_define(math.copysign, 2, _intrinsic("copysign"))


_define(max, 2, lambda builder, a, b: builder.select(builder.fcmp_ordered(">", b, a), b, a))
_define(min, 2, lambda builder, a, b: builder.select(builder.fcmp_ordered("<", b, a), b, a))


def _define_by_lanes(function: Any, arguments: int) -> None:  # emits LLVM
    """Define a function without a vector instruction: it is called as a function of floats for each lane."""
    _declare(function, arguments, by_lanes=True)

    def lower(context, builder, sig, args):
        kinds = tuple(types.float64 if a is OCTET else types.unliteral(a) for a in sig.args)
        kind = context.typing_context.resolve_value_type(function)
        of_floats = context.typing_context.resolve_function_type(kind, kinds, {})
        callee = context.get_function(kind, of_floats)
        # Numba passes constant exponents as Python numbers.
        args = [context.get_constant(types.int64, a) if isinstance(a, int) else a for a in args]
        out = ir.Constant(VECTOR, ir.Undefined)
        for k in range(LANES):
            lane = []
            for value, own, plain, wanted in zip(args, sig.args, kinds, of_floats.args, strict=True):
                number = builder.extract_element(value, _lane(k)) if own is OCTET else value
                lane.append(number if plain == wanted else context.cast(builder, number, plain, wanted))
            out = builder.insert_element(out, callee(builder, lane), _lane(k))
        return out

    kinds = (Octet, types.Float, types.Integer)
    for choice in itertools.product(kinds, repeat=arguments):
        if Octet in choice:
            lower_builtin(function, *choice)(lower)


_UNARY: tuple[Any, ...] = (
    math.sin, math.cos, math.tan, math.asin, math.acos, math.atan, math.sinh, math.cosh, math.tanh, math.exp,
    math.expm1, math.log, math.log1p,
)  # fmt: skip
_BINARY: tuple[Any, ...] = (math.atan2, math.hypot, math.pow, operator.pow, operator.ipow)
for _count, _functions in enumerate((_UNARY, _BINARY), start=1):
    for _function in _functions:
        _define_by_lanes(_function, _count)
