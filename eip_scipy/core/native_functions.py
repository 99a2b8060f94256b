"""A user's functions as the native engine takes them: Numba functions by C pointers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import carray, cfunc, from_dtype, njit, types
from numba.core.errors import NumbaError
from numba.extending import intrinsic, is_jitted

from ..engine.native import NativeFunctions
from .invariants import InvariantSet
from .jitted import ChangedShapeError, NotCompilableError

__all__ = ["compiled_functions", "raise_again"]


class Kind(NamedTuple):
    """What a function takes and gives.

    `shape` of its value, () for a number; `size` of the state it gets; `p` of its params, -1 where it takes none; the
    type of the state's numbers; whether the value is real, the function takes f, fills an argument `out`, or is a
    gradient.
    """

    shape: tuple[int, ...]
    size: int
    p: int
    dtype: str
    real: bool = False
    takes_f: bool = False
    in_place: bool = False
    gradient: bool = False


class Compiled(NamedTuple):
    """A function as C calls it, and as Python does to see what it raises, both with all arguments."""

    pointer: Any
    call: Any
    name: str
    kind: Kind


def compiled_functions(
    fun: Callable[..., Any],
    form: str,
    params: np.ndarray | None,
    invariants: InvariantSet,
    events: Sequence[Callable[..., Any]],
    y0: np.ndarray,
) -> NativeFunctions:
    """C pointers to a run's functions.

    Parameters
    ----------
    fun : callable
        The right-hand side, of the `form` "value", "in place", "acceleration" or "acceleration in place".
    form : str
    params : ndarray or None
        Their last argument, where they take one; the functions read this array.
    invariants : InvariantSet
    events : sequence of callable
    y0 : ndarray, shape (n,)

    Raises
    ------
    NotCompilableError
        When one of them is no lazily jitted Numba function of the arguments that `integrate` documents.
    """
    n, second_order = y0.size, form.startswith("acceleration")
    size = n // 2 if second_order else n
    number = Kind((), n, -1 if params is None else params.size, y0.dtype.char, real=True)
    rhs = _compiled(fun, number._replace(shape=(size,), size=size, real=False, in_place=form.endswith("place")), "fun")
    inv, grad = list[Compiled](), list[Compiled]()
    for k, (item, label) in enumerate(zip(invariants.items, invariants.labels, strict=True)):
        name = f"invariant {label!r}"
        if item.args:
            raise NotCompilableError(f"{name} has args; pass its parameters through params")
        if item.grad is None:
            raise NotCompilableError(f"{name} has no grad")
        shape = () if invariants.scalar[k] else (invariants.starts[k + 1] - invariants.starts[k],)
        inv.append(_compiled(item.fun, number._replace(shape=shape), name))
        rows = Kind((*shape, n), n, number.p, number.dtype, False, item.uses_f, item.in_place, gradient=True)
        grad.append(_compiled(item.grad, rows, f"gradient of {name}"))
    event = [_compiled(function, number, f"event {k}") for k, function in enumerate(events)]
    return NativeFunctions(
        rhs=rhs.pointer.address,
        inv=_addresses(inv),
        grad=_addresses(grad),
        event=_addresses(event),
        params=np.zeros(0) if params is None else params,  # itself: an ensemble writes each member's there
        second_order=second_order,
        owner={"rhs": [rhs], "inv": inv, "grad": grad, "event": event},
    )


def raise_again(functions: NativeFunctions, group: str, k: int, t: float, y: bytes, f: bytes | None) -> None:
    """Raise what the function that failed in the engine raises, from the arguments of its `FailedCallError`.

    Raises
    ------
    RuntimeError
        When it raises nothing in a second call.
    """
    compiled = functions.owner[group][k]
    kind = compiled.kind
    state = np.frombuffer(y, kind.dtype)[: kind.size].copy()
    out = np.empty(kind.shape or (1,), float if kind.real else kind.dtype)
    try:
        compiled.call(t, state, np.frombuffer(f or bytes(len(y)), kind.dtype).copy(), out, functions.params)
    except ChangedShapeError:
        raise ChangedShapeError(f"{compiled.name} returned an array of another shape than at the start") from None
    raise RuntimeError(f"{compiled.name} raised an exception at t={t:.10g}, but not when it was called again there.")


def _addresses(functions: list[Compiled]) -> tuple[tuple[int, int], ...]:
    return tuple((found.pointer.address, _floats(found.kind)) for found in functions)


def _floats(kind: Kind) -> int:
    width = 2 if np.dtype(kind.dtype).kind == "c" and not kind.real else 1
    return int(np.prod(kind.shape, dtype=int)) * width


def _compiled(fun: Any, kind: Kind, name: str) -> Compiled:
    if not is_jitted(fun):
        raise NotCompilableError(f"{name} is not a Numba function; decorate it with @numba.njit")
    try:
        call, pointer = _compile(fun, kind)
    except NumbaError as error:
        first = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
        raise NotCompilableError(f"{name} does not compile for this state: {first}") from error
    if any(isinstance(known.return_type, types.Optional) for known in fun.nopython_signatures):
        raise NotCompilableError(f"{name} returns None in some places, and a number or an array in others")
    return Compiled(pointer, call, name, kind)


@lru_cache(maxsize=256)
def _compile(fun: Any, kind: Kind) -> tuple[Any, Any]:
    """For the same function and kind of state once in a process."""
    call = _with_all_arguments(fun, kind)
    scalar = from_dtype(np.dtype(kind.dtype))
    state, floats = types.CPointer(scalar), types.CPointer(types.float64)
    size, p, shape = kind.size, max(kind.p, 0), kind.shape or (1,)

    def value(t, y, out, params):
        given = carray(y, (size,))
        return _status_of(call, t, given, given, carray(out, shape), carray(params, (p,)))

    def rows(t, y, f, out, params):
        return _status_of(call, t, carray(y, (size,)), carray(f, (size,)), carray(out, shape), carray(params, (p,)))

    out = floats if kind.real else state
    if kind.gradient:
        return call, cfunc(types.int32(types.float64, state, state, out, floats))(rows)
    return call, cfunc(types.int32(types.float64, state, out, floats))(value)


@intrinsic  # emits LLVM
def _status_of(typingctx, function, t, y, f, out, params):
    """0 after a call of a Numba function, -1 where it raised an exception."""
    arguments = t, y, f, out, params
    resolved = function.get_call_type(typingctx, arguments, {})

    def codegen(context, builder, signature, values):
        compiled = function.dispatcher.get_compile_result(resolved)
        context.active_code_library.add_linking_library(compiled.library)
        status, _ = context.call_internal_no_propagate(builder, compiled.fndesc, resolved, values[1:])
        return builder.sext(status.is_error, ir.IntType(32))

    return types.int32(function, *arguments), codegen


def _with_all_arguments(fun: Any, kind: Kind) -> Any:
    """``call(t, y, f, out, params)``, which puts the function's value into out."""
    has_params = kind.p >= 0
    # Inlined: that an array is nobody's, and needs no counting of references, shows only there.
    bare = njit(forceinline=True)(
        {
            (False, False, False): lambda t, y, f, out, params: fun(t, y),
            (False, False, True): lambda t, y, f, out, params: fun(t, y, params),
            (False, True, False): lambda t, y, f, out, params: fun(t, y, out),
            (False, True, True): lambda t, y, f, out, params: fun(t, y, out, params),
            (True, False, False): lambda t, y, f, out, params: fun(t, y, f),
            (True, False, True): lambda t, y, f, out, params: fun(t, y, f, params),
            (True, True, False): lambda t, y, f, out, params: fun(t, y, f, out),
            (True, True, True): lambda t, y, f, out, params: fun(t, y, f, out, params),
        }[kind.takes_f, kind.in_place, has_params]
    )
    if kind.in_place:
        return bare
    put = {0: _put_number, 1: _put_values if kind.real else _put_array, 2: _put_rows}[len(kind.shape)]
    return njit(forceinline=True)(lambda t, y, f, out, params: put(bare(t, y, f, out, params), out))


@njit
def _put_number(value, out):
    out[0] = value


@njit
def _put_values(values, out):
    if len(values) != out.size:
        raise ChangedShapeError
    for i in range(out.size):
        out[i] = values[i]


@njit
def _put_array(values, out):
    if values.size != out.size:
        raise ChangedShapeError
    for i in range(out.size):
        out[i] = values[i]


@njit
def _put_rows(rows, out):
    if rows.shape[0] != out.shape[0] or rows.shape[1] != out.shape[1]:
        raise ChangedShapeError
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = rows[i, j]
