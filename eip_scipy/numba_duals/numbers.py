"""Dual numbers for Numba: a value and its derivatives along several directions, carried through a function at once.

A `Dual` computes as a float does and also applies the chain rule. Numba compiles a function of arrays of floats for
arrays of duals too, including its branches, because duals are compared by their values. The module is imported only if
an invariant is jitted and has no gradient.

Each mathematical function is defined by one line: its derivative, as a function of its arguments and value. Operations
on arrays are either typed here (expressions, which Numba turns into loops over scalars) or written as loops.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.core.imputils import lower_constant
from numba.core.typeconv import Conversion
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, lower_cast, models, overload, register_model
from numba.np.arrayobj import populate_array

__all__ = ["Dual", "put_slope", "seed", "slope", "stack_array", "value_of"]

PLAIN = types.Float | types.Integer


class Dual(types.Type):
    """Numba type of a float and its derivatives along `lanes` directions."""

    def __init__(self, lanes: int) -> None:
        super().__init__(name=f"dual{lanes}")
        self.lanes = lanes
        self.vector = ir.VectorType(ir.DoubleType(), lanes)

    def can_convert_from(self, typingctx: Any, other: Any) -> Any:
        """Allow conversion from plain numbers, whose derivatives are 0."""
        return Conversion.safe if isinstance(other, PLAIN) else None

    def unify(self, typingctx: Any, other: Any) -> Any:
        """Return this type if `other` is a plain number or the same type, and None otherwise."""
        return self if isinstance(other, PLAIN) or other == self else None


@register_model(Dual)
class _DualModel(models.PrimitiveModel):
    """Pair of a number and a vector, packed because Numba's arrays do not have the alignment of the vector type."""

    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, ir.LiteralStructType([ir.DoubleType(), kind.vector]))
        self._data = ir.LiteralStructType([ir.DoubleType(), kind.vector], packed=True)

    def get_data_type(self) -> Any:
        return self._data

    def as_data(self, builder: Any, value: Any) -> Any:
        return _pair(builder, *_parts(builder, value), self._data)

    def from_data(self, builder: Any, data: Any) -> Any:
        return _pair(builder, *_parts(builder, data))


def _parts(builder: Any, pair: Any) -> tuple[Any, Any]:
    return builder.extract_value(pair, 0), builder.extract_value(pair, 1)


def _pair(builder: Any, value: Any, vector: Any, kind: Any = None) -> Any:
    kind = kind or ir.LiteralStructType([value.type, vector.type])
    return builder.insert_value(builder.insert_value(ir.Constant(kind, ir.Undefined), value, 0), vector, 1)


@lower_cast(types.Float, Dual)
@lower_cast(types.Integer, Dual)
def _cast_number(context, builder, from_type, to_type, value):
    return _pair(builder, context.cast(builder, value, from_type, types.float64), ir.Constant(to_type.vector, None))


@lower_constant(Dual)
def _constant(context, builder, kind, number):
    return ir.Constant.literal_struct([ir.Constant(ir.DoubleType(), float(number)), ir.Constant(kind.vector, None)])


@intrinsic
def value_of(typingctx, x):
    """Return the value of a dual; a plain number is returned as a float."""
    if isinstance(x, PLAIN):
        return types.float64(x), lambda context, builder, sig, args: context.cast(builder, args[0], x, types.float64)
    return types.float64(x), lambda context, builder, sig, args: builder.extract_value(args[0], 0)


@intrinsic
def _dual(typingctx, value, slope, x):
    """Return the dual of `value`, a function of the dual x with the derivative `slope`."""

    def emit(context, builder, sig, args):
        value, slope, x = args
        return _pair(builder, value, _times(builder, slope, builder.extract_value(x, 1)))

    return x(types.float64, types.float64, x), emit


@intrinsic
def _dual_of_two(typingctx, value, slope, x, other, y):
    """Return the dual of `value`, a function of the duals x and y with the partial derivatives `slope` and `other`."""

    def emit(context, builder, sig, args):
        value, slope, x, other, y = args
        terms = [_times(builder, s, builder.extract_value(d, 1)) for s, d in ((slope, x), (other, y))]
        return _pair(builder, value, builder.fadd(*terms))

    return x(types.float64, types.float64, x, types.float64, y), emit


def _times(builder: Any, number: Any, vector: Any) -> Any:
    one = builder.insert_element(ir.Constant(vector.type, ir.Undefined), number, ir.Constant(ir.IntType(32), 0))
    mask = ir.Constant(ir.VectorType(ir.IntType(32), vector.type.count), [0] * vector.type.count)
    return builder.fmul(builder.shuffle_vector(one, ir.Constant(vector.type, ir.Undefined), mask), vector)


@intrinsic
def seed(typingctx, kind, value, lane):
    """Return the dual of `value` whose derivative is 1 in `lane`, if that lane exists, and 0 in all others."""
    dual = kind.instance_type

    def emit(context, builder, sig, args):
        one = builder.insert_element(ir.Constant(dual.vector, None), ir.Constant(ir.DoubleType(), 1.0), args[2])
        inside = builder.icmp_unsigned("<", args[2], ir.Constant(ir.IntType(64), dual.lanes))
        return _pair(builder, args[1], builder.select(inside, one, ir.Constant(dual.vector, None)))

    return dual(kind, types.float64, types.int64), emit


@intrinsic
def put_slope(typingctx, x, lane, number):
    """Return a copy of the dual x with the derivative `number` in one lane."""

    def emit(context, builder, sig, args):
        slopes = builder.insert_element(builder.extract_value(args[0], 1), args[2], args[1])
        return _pair(builder, builder.extract_value(args[0], 0), slopes)

    return x(x, types.int64, types.float64), emit


@intrinsic
def slope(typingctx, x, lane):
    """Return the derivative of x in one lane, which is 0 for a plain number."""
    if isinstance(x, Dual):
        return types.float64(x, types.int64), lambda context, builder, sig, args: builder.extract_element(
            builder.extract_value(args[0], 1), args[1]
        )
    return types.float64(x, types.int64), lambda context, builder, sig, args: ir.Constant(ir.DoubleType(), 0.0)


@intrinsic(prefer_literal=True)
def stack_array(typingctx, kind, size):
    """Return an array of duals on the stack, valid until the function returns; `size` is constant at compilation."""
    array = types.Array(kind.instance_type, 1, "C")
    length = size.literal_value

    def emit(context, builder, sig, args):
        data = context.get_data_type(array.dtype)
        found = context.make_array(array)(context, builder)
        itemsize = context.get_constant(types.intp, context.get_abi_sizeof(data))
        memory = cgutils.alloca_once(builder, data, size=length)
        shape = [context.get_constant(types.intp, length)]
        populate_array(found, data=memory, shape=shape, strides=[itemsize], itemsize=itemsize, meminfo=None)
        return found._getvalue()

    return array(kind, size), emit


def _is_dual(*kinds: Any) -> bool:
    """Return True if all types are scalars and at least one of them is a dual."""
    return any(isinstance(k, Dual) for k in kinds) and all(isinstance(k, Dual | PLAIN) for k in kinds)


def _define(emit: Callable[..., Any], *functions: Any, compares: bool = False) -> None:
    """Define operations on duals directly in LLVM, because Numba takes longer to compile those written in Python.

    ``emit(builder, *values)`` returns the value and the derivative by each argument; with `compares` only the value.
    """

    def lower(context, builder, sig, args):
        duals = [isinstance(kind, Dual) for kind in sig.args]
        values = [builder.extract_value(x, 0) if dual else x for x, dual in zip(args, duals, strict=True)]
        if compares:
            return emit(builder, *values)
        value, *slopes = emit(builder, *values)
        terms = [
            _times(builder, slope, builder.extract_value(x, 1))
            for x, slope, dual in zip(args, slopes, duals, strict=True)
            if dual
        ]
        return _pair(builder, value, builder.fadd(*terms) if len(terms) > 1 else terms[0])

    kinds = [(Dual,), (Dual, Dual), (Dual, types.Float), (types.Float, Dual)]
    for function in functions:

        class _Template(AbstractTemplate):
            key = function

            def generic(self, args: tuple[Any, ...], kws: Any) -> Any:
                if not _is_dual(*args):
                    return None
                dual = next(k for k in args if isinstance(k, Dual))
                found = [k if k == dual else types.float64 for k in args]
                return signature(types.boolean if compares else dual, *found)

        # The decorator form is not used because it needs the module of each function, which NumPy 2.0 does not give.
        infer_global(function, types.Function(_Template))
        for choice in kinds:
            lower_builtin(function, *choice)(lower)


_function: Any
ONE, MINUS_ONE = (ir.Constant(ir.DoubleType(), number) for number in (1.0, -1.0))


def _divide(builder: Any, a: Any, b: Any) -> tuple[Any, ...]:
    value = builder.fdiv(a, b)
    return value, builder.fdiv(ONE, b), builder.fneg(builder.fdiv(value, b))


def _root(builder: Any, a: Any) -> tuple[Any, ...]:
    kind = ir.FunctionType(ir.DoubleType(), [ir.DoubleType()])
    value = builder.call(cgutils.get_or_insert_function(builder.module, kind, "llvm.sqrt.f64"), [a])
    return value, builder.fdiv(ir.Constant(ir.DoubleType(), 0.5), value)


_define(lambda builder, a, b: (builder.fadd(a, b), ONE, ONE), operator.add, operator.iadd, np.add)
_define(lambda builder, a, b: (builder.fsub(a, b), ONE, MINUS_ONE), operator.sub, operator.isub, np.subtract)
_define(lambda builder, a, b: (builder.fmul(a, b), b, a), operator.mul, operator.imul, np.multiply)
_define(_divide, operator.truediv, operator.itruediv, np.divide)
_define(lambda builder, a: (builder.fneg(a), MINUS_ONE), operator.neg, np.negative)
_define(lambda builder, a: (a, ONE), operator.pos)
_define(lambda builder, a: (builder.fmul(a, a), builder.fadd(a, a)), np.square)
_define(_root, math.sqrt, np.sqrt)
for _function, _sign in (
    (operator.lt, "<"), (operator.le, "<="), (operator.gt, ">"), (operator.ge, ">="), (operator.eq, "==")
):  # fmt: skip
    _define(lambda builder, a, b, sign=_sign: builder.fcmp_ordered(sign, a, b), _function, compares=True)
_define(lambda builder, a, b: builder.fcmp_unordered("!=", a, b), operator.ne, compares=True)


# With this error model a derivative such as that of the square root at 0 is infinite and raises no ZeroDivisionError.
_overload = partial(overload, jit_options={"error_model": "numpy"})
_inner = njit(error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)


def _define_unary(function: Any, slope: Callable[..., Any], *names: Any) -> None:
    slope = _inner(slope)

    def typed(x):
        if not isinstance(x, Dual):
            return None

        def of_dual(x):
            a = value_of(x)
            v = function(a)
            return _dual(v, slope(a, v), x)

        return of_dual

    for name in (function, *names):
        _overload(name)(typed)


def _of_two(function: Any, slope: Callable[..., Any], other: Callable[..., Any], x: Any, y: Any) -> Any:
    """Return ``function(x, y)`` for scalars of the Numba types x and y, one of them a dual; None for other types.

    `slope` and `other`, as functions of the two values and of that of `function`, are the derivatives by x and y.
    """
    if not _is_dual(x, y):
        return None

    def of_first(x, y):
        a, b = value_of(x), value_of(y)
        v = function(a, b)
        return _dual(v, slope(a, b, v), x)

    def of_second(x, y):
        a, b = value_of(x), value_of(y)
        v = function(a, b)
        return _dual(v, other(a, b, v), y)

    def of_both(x, y):
        a, b = value_of(x), value_of(y)
        v = function(a, b)
        return _dual_of_two(v, slope(a, b, v), x, other(a, b, v), y)

    if isinstance(x, Dual) and isinstance(y, Dual):
        return of_both
    return of_first if isinstance(x, Dual) else of_second


def _define_binary(function: Any, slope: Callable[..., Any], other: Callable[..., Any], *names: Any) -> None:
    slope, other = _inner(slope), _inner(other)

    def typed(x, y):
        return _of_two(function, slope, other, x, y)

    for name in (function, *names):
        _overload(name)(typed)


def _define_flat(function: Any) -> None:
    """Define a function of a dual whose derivative is 0 or undefined: it returns a plain number."""

    def typed(x):
        return (lambda x: function(value_of(x))) if isinstance(x, Dual) else None

    _overload(function)(typed)


def _define_flat_for_arrays(function: Any) -> None:
    """Define such a function with values of floats for an array of duals."""

    def typed(x):
        if not (_is_array(x, 1, 2) and isinstance(x.dtype, Dual)):
            return None

        def of_array(x):
            out = np.empty(x.shape)
            for place in np.ndindex(x.shape):
                out[place] = function(value_of(x[place]))
            return out

        return of_array

    _overload(function)(typed)


def _define_rounding(function: Any) -> None:
    """Define a function that rounds a number, or the numbers of an array, to a number of decimals if it is given."""
    _define_flat(function)
    _define_flat_for_arrays(function)

    def typed(x, decimals):
        return (lambda x, decimals: function(value_of(x), decimals)) if isinstance(x, Dual) else None

    _overload(function)(typed)


@_inner
def _slope_of_power(a, b, v):
    if b == 0.0:
        return 0.0
    return b * v / a if a != 0.0 else b * a ** (b - 1.0)


@_inner
def _slope_of_exponent(a, b, v):
    return v * math.log(a) if v != 0.0 else 0.0


_define_unary(abs, lambda a, v: math.copysign(1.0, a), math.fabs, np.abs, np.fabs)
_define_unary(np.cbrt, lambda a, v: 1.0 / (3.0 * v * v))
_define_unary(np.reciprocal, lambda a, v: -v * v)
_define_unary(math.exp, lambda a, v: v, np.exp)
_define_unary(np.exp2, lambda a, v: v * math.log(2.0))
_define_unary(math.expm1, lambda a, v: v + 1.0, np.expm1)
_define_unary(math.log, lambda a, v: 1.0 / a, np.log)
_define_unary(math.log1p, lambda a, v: 1.0 / (1.0 + a), np.log1p)
_define_unary(np.log2, lambda a, v: 1.0 / (a * math.log(2.0)), math.log2)
_define_unary(math.log10, lambda a, v: 1.0 / (a * math.log(10.0)), np.log10)
_define_unary(math.sin, lambda a, v: math.cos(a), np.sin)
_define_unary(math.cos, lambda a, v: -math.sin(a), np.cos)
_define_unary(math.tan, lambda a, v: 1.0 + v * v, np.tan)
_define_unary(math.asin, lambda a, v: 1.0 / math.sqrt((1.0 - a) * (1.0 + a)), np.arcsin)
_define_unary(math.acos, lambda a, v: -1.0 / math.sqrt((1.0 - a) * (1.0 + a)), np.arccos)
_define_unary(math.atan, lambda a, v: 1.0 / (1.0 + a * a), np.arctan)
_define_unary(math.sinh, lambda a, v: math.cosh(a), np.sinh)
_define_unary(math.cosh, lambda a, v: math.sinh(a), np.cosh)
_define_unary(math.tanh, lambda a, v: 1.0 / math.cosh(a) ** 2, np.tanh)
_define_unary(math.asinh, lambda a, v: 1.0 / math.hypot(1.0, a), np.arcsinh)
_define_unary(math.acosh, lambda a, v: 1.0 / math.sqrt((a - 1.0) * (a + 1.0)), np.arccosh)
_define_unary(math.atanh, lambda a, v: 1.0 / ((1.0 - a) * (1.0 + a)), np.arctanh)
_define_unary(math.erf, lambda a, v: 2.0 / math.sqrt(math.pi) * math.exp(-a * a))
_define_unary(math.erfc, lambda a, v: -2.0 / math.sqrt(math.pi) * math.exp(-a * a))

_define_binary(math.hypot, lambda a, b, v: a / v, lambda a, b, v: b / v, np.hypot)
_define_binary(
    math.atan2,
    lambda a, b, v: b / math.hypot(a, b) / math.hypot(a, b),
    lambda a, b, v: -a / math.hypot(a, b) / math.hypot(a, b),
    np.arctan2,
)
_define_binary(operator.mod, lambda a, b, v: 1.0, lambda a, b, v: -math.floor(a / b), np.mod, np.remainder)
_define_binary(math.copysign, lambda a, b, v: math.copysign(1.0, a) * math.copysign(1.0, b), lambda a, b, v: 0.0)
_define_binary(max, lambda a, b, v: 1.0 if a >= b else 0.0, lambda a, b, v: 1.0 if a < b else 0.0, np.maximum, np.fmax)
_define_binary(min, lambda a, b, v: 1.0 if a <= b else 0.0, lambda a, b, v: 1.0 if a > b else 0.0, np.minimum, np.fmin)

FLAT: tuple[Any, ...] = (math.floor, math.ceil, math.trunc, math.isnan, math.isinf, math.isfinite, int)
FLAT_FOR_ARRAYS: tuple[Any, ...] = (np.sign, np.isnan, np.isfinite, np.floor, np.ceil, np.trunc, np.rint)
for _function in FLAT + FLAT_FOR_ARRAYS:
    _define_flat(_function)


@_overload(operator.floordiv)
def _floordiv(x, y):
    return (lambda x, y: value_of(x) // value_of(y)) if _is_dual(x, y) else None


def _power(x, y):
    """Return a function that computes x ** y as `_of_two`, integer powers by products, as Numba does for floats."""
    if isinstance(x, Dual) and isinstance(y, types.Integer):

        def by_products(x, y):
            a = value_of(x)
            if y == 0:
                return _dual(1.0, 0.0, x)
            below = a ** (y - 1)
            return _dual(below * a if y > 0 else a**y, y * below, x)

        def square(x, y):
            a = value_of(x)
            return _dual(a * a, 2.0 * a, x)

        return square if getattr(y, "literal_value", None) == 2 else by_products

    return _of_two(operator.pow, _slope_of_power, _slope_of_exponent, x, y)


for _function in (operator.pow, operator.ipow, math.pow, np.power):
    _overload(_function, prefer_literal=True)(_power)


def _is_array(kind: Any, *ndims: int) -> bool:
    return isinstance(kind, types.Array) and kind.ndim in ndims and isinstance(kind.dtype, Dual | PLAIN)


for _function in FLAT_FOR_ARRAYS:
    _define_flat_for_arrays(_function)
for _function in (round, np.round, np.around):
    _define_rounding(_function)


def _define_for_arrays(function: Any) -> None:
    """Define the type of `function` for arrays of duals; Numba turns such calls into loops over scalar duals."""

    class _Template(AbstractTemplate):
        key = function

        def generic(self, args: tuple[Any, ...], kws: Any) -> Any:
            found = [a for a in args if isinstance(a, types.Array)]
            kinds = [a.dtype if isinstance(a, types.Array) else a for a in args]
            if not found or not _is_dual(*kinds) or any(isinstance(a, Dual) for a in args):
                return None
            dual = next(k for k in kinds if isinstance(k, Dual))
            return signature(types.Array(dual, max(a.ndim for a in found), "C"), *args)

    infer_global(function, types.Function(_Template))


ARITHMETIC = operator.add, operator.sub, operator.mul, operator.truediv, np.add, np.subtract, np.multiply, np.divide
ARRAY_FUNCTIONS: tuple[Any, ...] = (
    *ARITHMETIC, operator.pow, operator.neg, np.power, np.negative, np.sqrt, np.square, np.abs, np.exp, np.log,
    np.log1p, np.expm1, np.sin, np.cos, np.tan, np.sinh, np.cosh, np.tanh, np.arctan, np.hypot, np.arctan2, np.maximum,
    np.minimum,
)  # fmt: skip
for _function in ARRAY_FUNCTIONS:
    _define_for_arrays(_function)


def _define_with_scalar(function: Any) -> None:
    """Define an operation of an array and one dual by a loop: Numba supports no scalar duals in array expressions."""

    def typed(x, y):
        of_first = _is_array(x, 1, 2) and isinstance(y, Dual)
        if not of_first and not (isinstance(x, Dual) and _is_array(y, 1, 2)):
            return None
        dual = y if of_first else x

        def array_and_dual(x, y):
            out = np.empty(x.shape, dual)
            for place in np.ndindex(x.shape):
                out[place] = function(x[place], y)
            return out

        def dual_and_array(x, y):
            out = np.empty(y.shape, dual)
            for place in np.ndindex(y.shape):
                out[place] = function(x, y[place])
            return out

        return array_and_dual if of_first else dual_and_array

    _overload(function)(typed)


for _function in ARITHMETIC:
    _define_with_scalar(_function)


# Numba turns the expressions x + y into loops, but not calls of operator.add, and so there are four functions.
def _add(x, y):
    x[:] = x + y
    return x


def _subtract(x, y):
    x[:] = x - y
    return x


def _multiply(x, y):
    x[:] = x * y
    return x


def _divide_array(x, y):
    x[:] = x / y
    return x


def _define_in_place(function: Any, in_place: Callable[..., Any]) -> None:
    """Define an operation such as ``x += y`` for an array x of duals, before Numba's own rule, which would fail."""
    _overload(function, target="cpu")(
        lambda x, y: in_place if _is_array(x, 1, 2) and isinstance(x.dtype, Dual) else None
    )


for _function, _in_place in (
    (operator.iadd, _add), (operator.isub, _subtract), (operator.imul, _multiply), (operator.itruediv, _divide_array),
):  # fmt: skip
    _define_in_place(_function, _in_place)


def _are_arrays_of_duals(*kinds: Any) -> bool:
    return all(_is_array(k, 1, 2) for k in kinds) and any(isinstance(k.dtype, Dual) for k in kinds)


def _dot(a, b):
    if not _are_arrays_of_duals(a, b):
        return None
    dual = a.dtype if isinstance(a.dtype, Dual) else b.dtype

    def of_vectors(a, b):
        total = seed(dual, 0.0, -1)
        for i in range(a.size):
            total += a[i] * b[i]
        return total

    def of_matrix_and_vector(a, b):
        out = np.zeros(a.shape[0], dual)
        for i in range(a.shape[0]):
            for j in range(a.shape[1]):
                out[i] += a[i, j] * b[j]
        return out

    def of_vector_and_matrix(a, b):
        out = np.zeros(b.shape[1], dual)
        for i in range(b.shape[0]):
            for j in range(b.shape[1]):
                out[j] += a[i] * b[i, j]
        return out

    def of_matrices(a, b):
        out = np.zeros((a.shape[0], b.shape[1]), dual)
        for i in range(a.shape[0]):
            for k in range(b.shape[0]):
                for j in range(b.shape[1]):
                    out[i, j] += a[i, k] * b[k, j]
        return out

    return {
        (1, 1): of_vectors, (2, 1): of_matrix_and_vector, (1, 2): of_vector_and_matrix, (2, 2): of_matrices
    }[a.ndim, b.ndim]  # fmt: skip


for _function in (operator.matmul, np.dot):
    _overload(_function)(_dot)


@_overload(np.vdot)
def _vdot(a, b):
    return (lambda a, b: np.dot(a, b)) if _are_arrays_of_duals(a, b) and a.ndim == b.ndim == 1 else None


@_overload(np.linalg.norm)
def _norm(a):
    if not (_are_arrays_of_duals(a) and a.ndim == 1):
        return None
    dual = a.dtype

    def scaled(a):
        # Dividing by the largest component avoids overflow. It is a plain number because it cancels in the result.
        largest = 0.0
        for i in range(a.size):
            largest = max(largest, abs(value_of(a[i])))
        if largest == 0.0:
            largest = 1.0
        total = seed(dual, 0.0, -1)
        for i in range(a.size):
            total += (a[i] / largest) * (a[i] / largest)
        return math.sqrt(total) * largest

    return scaled


@_overload(float)
def _float(x):
    return (lambda x: x) if isinstance(x, Dual) else None
