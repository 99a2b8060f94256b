"""Eight members of an ensemble in one value: functions written for one member, compiled for eight at a time.

An octet holds one float of each of eight members, in a vector register. It adds, multiplies and compares as a float
does, lane by lane, so that Numba compiles the same source for floats and for octets, and every lane gets the bits that
the float gets. What differs between members cannot be branched on: comparisons of octets give masks, for `where`. A
function with such a branch does not compile for octets.

An array of n octets is a float64 array (n, 8), or 8 neighbouring columns of a wider one.
"""

from __future__ import annotations

import itertools
import math
import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import config, types
from numba.core import cgutils
from numba.core.typeconv import Conversion
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, lower_cast, models, register_model
from numba.np.arrayobj import populate_array

__all__ = [
    "LANES",
    "MASK",
    "OCTET",
    "any_lane",
    "in_octets",
    "is_not",
    "lane_of",
    "multiply_add",
    "no_lane",
    "octets",
    "on_stack",
    "over_members",
    "spread",
    "where",
]

LANES = 8
DOUBLE, BIT = ir.DoubleType(), ir.IntType(1)
VECTOR, BITS = ir.VectorType(DOUBLE, LANES), ir.VectorType(BIT, LANES)


class Octet(types.Type):  # emits LLVM
    """Numba type of one float of each of eight members."""

    def __init__(self) -> None:
        super().__init__(name="octet")

    def can_convert_from(self, typingctx: Any, other: Any) -> Any:
        """Numbers stand for themselves in every lane."""
        return Conversion.safe if isinstance(other, types.Float | types.Integer) else None


class Mask(types.Type):  # emits LLVM
    """Numba type of one truth value of each of eight members."""

    def __init__(self) -> None:
        super().__init__(name="mask of an octet")

    def can_convert_from(self, typingctx: Any, other: Any) -> Any:
        """A truth value stands for itself in every lane."""
        return Conversion.safe if isinstance(other, types.Boolean) else None


OCTET, MASK = Octet(), Mask()


@register_model(Octet)
class _OctetModel(models.PrimitiveModel):  # emits LLVM
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, VECTOR)


@register_model(Mask)
class _MaskModel(models.PrimitiveModel):  # emits LLVM
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, BITS)


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


@lower_cast(types.Boolean, Mask)
def _cast_truth(context, builder, from_type, to_type, value):  # emits LLVM
    return _spread(builder, context.cast(builder, value, from_type, types.boolean))


def _define(function: Any, arguments: int, kind: Any, result: Any, emit: Callable[..., Any]) -> None:  # emits LLVM
    """Type and emit a function of octets or masks (`kind`), any argument of which may be a plain number."""

    @infer_global(function)
    class _Template(AbstractTemplate):
        def generic(self, args: tuple[Any, ...], kws: Any) -> Any:
            plain = types.Float | types.Integer if kind is OCTET else types.Boolean
            if len(args) != arguments or kind not in args:
                return None
            if all(a is kind or isinstance(a, plain) for a in args):
                return signature(result, *[kind] * arguments)
            return None

    @lower_builtin(function, *[type(kind)] * arguments)
    def _lower(context, builder, sig, args):
        return emit(builder, *args)


def _compare(symbol: str) -> Callable[..., Any]:  # emits LLVM
    if symbol == "!=":
        return lambda builder, a, b: builder.fcmp_unordered("!=", a, b)
    return lambda builder, a, b: builder.fcmp_ordered(symbol, a, b)


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
        _define(_operator, 2, OCTET, OCTET, _emit)
for _operator, _symbol in (
    (operator.lt, "<"), (operator.le, "<="), (operator.gt, ">"), (operator.ge, ">="), (operator.eq, "=="),
    (operator.ne, "!="),
):  # fmt: skip
    _define(_operator, 2, OCTET, MASK, _compare(_symbol))
_define(operator.neg, 1, OCTET, OCTET, lambda builder, a: builder.fneg(a))
_define(operator.pos, 1, OCTET, OCTET, lambda builder, a: a)
_define(abs, 1, OCTET, OCTET, _intrinsic("fabs"))
_define(math.fabs, 1, OCTET, OCTET, _intrinsic("fabs"))
_define(math.sqrt, 1, OCTET, OCTET, _intrinsic("sqrt"))
_define(operator.and_, 2, MASK, MASK, lambda builder, a, b: builder.and_(a, b))
_define(operator.or_, 2, MASK, MASK, lambda builder, a, b: builder.or_(a, b))
_define(operator.invert, 1, MASK, MASK, lambda builder, a: builder.not_(a))


def _larger(builder: Any, a: Any, b: Any) -> Any:  # emits LLVM
    return builder.select(builder.fcmp_ordered(">", b, a), b, a)


def _smaller(builder: Any, a: Any, b: Any) -> Any:  # emits LLVM
    return builder.select(builder.fcmp_ordered("<", b, a), b, a)


_define(max, 2, OCTET, OCTET, _larger)
_define(min, 2, OCTET, OCTET, _smaller)


def _define_by_lanes(function: Any, arguments: int) -> None:  # emits LLVM
    """What the processor has no vector instruction for: the function of floats, lane after lane."""

    @infer_global(function)
    class _Template(AbstractTemplate):
        def generic(self, args: tuple[Any, ...], kws: Any) -> Any:
            if len(args) != arguments or OCTET not in args:
                return None
            if all(a is OCTET or isinstance(a, types.Float | types.Integer) for a in args):
                return signature(OCTET, *args)
            return None

    def lower(context, builder, sig, args):
        kinds = tuple(types.float64 if a is OCTET else types.unliteral(a) for a in sig.args)
        kind = context.typing_context.resolve_value_type(function)
        of_floats = context.typing_context.resolve_function_type(kind, kinds, {})
        callee = context.get_function(kind, of_floats)
        # Numba passes constant exponents as they stand in the source.
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


@intrinsic  # emits LLVM
def octets(typingctx, array, column):
    """The octets in the columns `column` ... `column` + 7 of a C-contiguous float64 array (..., lanes)."""
    if not (isinstance(array, types.Array) and array.layout == "C" and array.dtype == types.float64):
        return None
    kind = types.Array(OCTET, array.ndim - 1, "A", aligned=False)

    def codegen(context, builder, sig, args):
        source = context.make_array(sig.args[0])(context, builder, args[0])
        out = context.make_array(kind)(context, builder)
        populate_array(
            out,
            data=builder.bitcast(builder.gep(source.data, [args[1]]), VECTOR.as_pointer()),
            shape=cgutils.unpack_tuple(builder, source.shape)[:-1],
            strides=cgutils.unpack_tuple(builder, source.strides)[:-1],
            itemsize=context.get_constant(types.intp, 8 * LANES),
            meminfo=None,
            parent=None,
        )
        return out._getvalue()

    return kind(array, types.intp), codegen


def over_members(*kinds: Any) -> bool:  # emits LLVM
    """Whether one of the types is an octet, a mask or an array of octets."""
    return any(kind in (OCTET, MASK) or (isinstance(kind, types.Array) and kind.dtype is OCTET) for kind in kinds)


@intrinsic  # emits LLVM
def spread(typingctx, number):
    """A number as an octet."""

    def codegen(context, builder, sig, args):
        return _spread(builder, args[0])

    return OCTET(types.float64), codegen


@intrinsic  # emits LLVM
def on_stack(typingctx, count):
    """An array of a constant number of octets that lives as long as the function that calls this."""
    if not isinstance(count, types.IntegerLiteral):
        return None
    size, kind = count.literal_value, types.Array(OCTET, 1, "A", aligned=False)

    def codegen(context, builder, sig, args):
        out = context.make_array(kind)(context, builder)
        populate_array(
            out,
            data=builder.bitcast(cgutils.alloca_once(builder, ir.ArrayType(VECTOR, size)), VECTOR.as_pointer()),
            shape=[context.get_constant(types.intp, size)],
            strides=[context.get_constant(types.intp, 8 * LANES)],
            itemsize=context.get_constant(types.intp, 8 * LANES),
            meminfo=None,
            parent=None,
        )
        return out._getvalue()

    return kind(count), codegen


def in_octets(function: Callable[..., Any], result: Any, *kinds: Any) -> Any:  # emits LLVM
    """Signature and code of an intrinsic that for octets is `function`, compiled."""

    def codegen(context, builder, sig, args):
        return context.compile_internal(builder, function, sig, args)

    return result(*kinds), codegen


@intrinsic  # emits LLVM
def where(typingctx, condition, a, b):
    """A where the condition holds, else b: numbers, or octets lane by lane."""
    lanes = over_members(condition, a, b)
    truth, kind = (MASK, OCTET) if lanes else (types.boolean, types.float64)

    def codegen(context, builder, sig, args):
        return builder.select(*args)

    return kind(truth, kind, kind), codegen


@intrinsic  # emits LLVM
def is_not(typingctx, condition):
    """Not, for a truth value or lane by lane."""
    kind = MASK if over_members(condition) else types.boolean

    def codegen(context, builder, sig, args):
        return builder.not_(args[0])

    return kind(kind), codegen


@intrinsic  # emits LLVM
def multiply_add(typingctx, a, b, c):
    """The sum a b + c, rounded once where the processor can."""
    kind = OCTET if over_members(a, b, c) else types.float64

    def codegen(context, builder, sig, args):
        value = context.get_value_type(kind)
        name = "llvm.fmuladd." + (f"v{LANES}f64" if kind is OCTET else "f64")
        fma = cgutils.get_or_insert_function(builder.module, ir.FunctionType(value, [value] * 3), name)
        return builder.call(fma, args)

    return kind(kind, kind, kind), codegen


@intrinsic  # emits LLVM
def any_lane(typingctx, mask):
    """Whether the mask holds in any lane."""

    def codegen(context, builder, sig, args):
        bits = builder.bitcast(args[0], ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(LANES), 0))

    return types.boolean(MASK), codegen


@intrinsic  # emits LLVM
def no_lane(typingctx, condition):
    """Whether the condition holds in no lane; for a truth value, whether it does not hold."""
    if not over_members(condition):
        return types.boolean(types.boolean), lambda context, builder, sig, args: builder.not_(args[0])
    return in_octets(lambda mask: not any_lane(mask), types.boolean, condition)


@intrinsic  # emits LLVM
def lane_of(typingctx, mask, k):
    """Whether the mask holds in lane k."""

    def codegen(context, builder, sig, args):
        return builder.extract_element(args[0], builder.trunc(args[1], ir.IntType(32)))

    return types.boolean(MASK, types.intp), codegen


if config.DISABLE_JIT:

    def where(condition, a, b):
        return a if condition else b

    def is_not(condition):
        return not condition

    no_lane = is_not

    def multiply_add(a, b, c):
        return a * b + c
