"""Users' Numba functions in the form that the compiled driver takes, ``(t, y, out, params) -> None``; and the driver.

Arrays are copied by loops: these wrappers are compiled in every process, and a slice assignment alone takes Numba more
than a second.

The state, and f where a gradient takes it, are the driver's own buffers. They are handed on as arrays that cannot be
written to; a function that does write to them, which does not compile then, gets copies, as in interpreted runs.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from math import nan
from types import FunctionType
from typing import Any, NamedTuple

import numpy as np
from numba import config, from_dtype, njit, types
from numba.core.errors import NumbaError
from numba.extending import is_jitted

from ..engine.caching import cached_njit
from ..engine.octets import LANES, OCTET, octets
from .invariants import Invariant, InvariantSet
from .jitted import ChangedShapeError, NotCompilableError

WRONG_FUN = "fun returned an array of another shape than at the start"

__all__ = [
    "CompiledFunctions",
    "compile_functions",
    "signatures",
    "with_inlined",
]


class CompiledFunctions(NamedTuple):
    """The functions of the loop, as Numba dispatchers or as Python functions."""

    rhs: Callable[..., None]
    inv: Callable[..., None]
    grad: Callable[..., None]
    event: Callable[..., None]


def with_inlined(function: Callable[..., Any], *callees: Callable[..., Any]) -> Callable[..., Any]:
    """A copy of a driver, to be compiled, into which Numba writes those of its callees before it compiles anything.

    A callee that is compiled for itself is optimised and translated once by itself, and once more in the driver, with
    all that it calls.
    """
    inlined = {callee.__name__: njit(inline="always", error_model="numpy", _nrt=False)(callee) for callee in callees}
    names = function.__globals__ | inlined
    return FunctionType(function.__code__, names, function.__name__, None, function.__closure__)


class Signatures(NamedTuple):
    """Their signatures for one type of state."""

    rhs: Any
    inv: Any
    grad: Any


def signatures(dtype: np.dtype) -> Signatures:
    """Signatures of rhs, inv and grad for states of `dtype`."""
    real, scalar = types.float64, from_dtype(np.dtype(dtype))
    state, rows, floats = scalar[::1], scalar[:, ::1], real[::1]
    given = state.copy(readonly=True)
    return Signatures(
        rhs=types.void(real, given, state, floats),
        inv=types.void(real, given, floats, floats),
        grad=types.void(real, given, given, rows, floats),
    )


def signatures_of_octets() -> Signatures:
    """The same for the members of an octet."""
    real, state, rows = types.float64, *(types.Array(OCTET, ndim, "A", aligned=False) for ndim in (1, 2))
    given = state.copy(readonly=True)
    return Signatures(
        rhs=types.void(real, given, state, state),
        inv=types.void(real, given, state, state),
        grad=types.void(real, given, given, rows, state),
    )


def signatures_of_batches() -> Signatures:
    """Signatures of rhs, inv and grad for lanes of members: (n, lanes), (l, lanes), (l, n, lanes), (p, lanes)."""
    real, lanes, rows = types.float64, types.float64[:, ::1], types.float64[:, :, ::1]
    return Signatures(
        rhs=types.void(real, lanes, lanes, lanes),
        inv=types.void(real, lanes, lanes, lanes),
        grad=types.void(real, lanes, lanes, rows, lanes),
    )


def compile_functions(
    fun: Callable[..., Any],
    form: str,
    has_params: bool,
    invariants: InvariantSet,
    events: tuple[Callable[..., Any], ...],
    dtype: np.dtype,
    in_octets: bool = False,
) -> CompiledFunctions:
    """Wrap and compile the functions of a run, or with `in_octets` those of members side by side.

    Raises
    ------
    NotCompilableError
        When one of them is no lazily jitted Numba function of the arguments that `integrate` documents.
    """
    if config.DISABLE_JIT:
        raise NotCompilableError("Numba's JIT is disabled (NUMBA_DISABLE_JIT)")
    parts = tuple(
        _Part(
            *_invariant_functions(item, label),
            label,
            invariants.scalar[k],
            invariants.starts[k],
            invariants.starts[k + 1],
            item.in_place,
            item.uses_f,
        )
        for k, (item, label) in enumerate(zip(invariants.items, invariants.labels, strict=True))
    )
    names = tuple(f"event {k}" for k in range(len(events)))
    jitted = tuple(_jitted(event, name) for event, name in zip(events, names, strict=True))
    sigs = signatures_of_octets() if in_octets else signatures(dtype)
    functions = _compile_parts(_jitted(fun, "fun"), form, has_params, parts, jitted, sigs)
    return _for_batches(functions) if in_octets else functions


class _Part(NamedTuple):
    """One invariant: its functions and its places among all values."""

    fun: Callable[..., Any]
    grad: Callable[..., Any]
    label: str
    scalar: bool
    start: int
    stop: int
    in_place: bool
    uses_f: bool


@lru_cache(maxsize=64)
def _compile_parts(
    fun: Callable[..., Any],
    form: str,
    has_params: bool,
    parts: tuple[_Part, ...],
    events: tuple[Callable[..., Any], ...],
    sigs: Signatures,
) -> CompiledFunctions:
    """The wrappers of the same functions are compiled once in a process."""
    rhs = _compiled(lambda f: WRAPPERS[form](f, has_params), fun, sigs.rhs, "fun")
    inv, grad = _no_values, _no_gradients
    for part in parts:
        chain = partial(_chain_value, inv, part, has_params)
        inv = _compiled(chain, part.fun, sigs.inv, f"invariant {part.label!r}")
        chain = partial(_chain_gradient, grad, part, has_params)
        grad = _compiled(chain, part.grad, sigs.grad, f"gradient of invariant {part.label!r}", part.uses_f)
    event = _no_values
    for k, function in enumerate(events):
        one = _Part(function, function, f"event {k}", True, k, k + 1, False, False)
        event = _compiled(partial(_chain_value, event, one, has_params), function, sigs.inv, f"event {k}")
    return CompiledFunctions(rhs, inv, grad, event)


@lru_cache(maxsize=64)
def _for_batches(one: CompiledFunctions) -> CompiledFunctions:
    """Functions of all lanes from those of eight."""
    rhs, inv, grad, event = one

    @njit(_nrt=False)
    def all_rhs(t, y, out, params):
        for c in range(0, y.shape[1], LANES):
            rhs(t, octets(y, c), octets(out, c), octets(params, c))

    @njit(_nrt=False)
    def all_inv(t, y, values, params):
        for c in range(0, y.shape[1], LANES):
            inv(t, octets(y, c), octets(values, c), octets(params, c))

    @njit(_nrt=False)
    def all_grad(t, y, f, G, params):
        for c in range(0, y.shape[1], LANES):
            grad(t, octets(y, c), octets(f, c), octets(G, c), octets(params, c))

    sigs = signatures_of_batches()
    return CompiledFunctions(
        _compile(all_rhs, sigs.rhs),
        _compile(all_inv, sigs.inv),
        _compile(all_grad, sigs.grad),
        event,
    )


def _jitted(fun: Callable[..., Any], name: str) -> Callable[..., Any]:
    if not is_jitted(fun):
        raise NotCompilableError(f"{name} is not a Numba function; decorate it with @numba.njit")
    return fun


def _invariant_functions(item: Invariant, label: str) -> tuple[Callable[..., Any], Callable[..., Any]]:
    if item.args:
        raise NotCompilableError(f"invariant {label!r} has args; pass its parameters through params")
    if item.grad is None:
        raise NotCompilableError(f"invariant {label!r} has no grad")
    return _jitted(item.fun, f"invariant {label!r}"), _jitted(item.grad, f"gradient of invariant {label!r}")


def _compiled(
    make: Callable[[Any], Any], fun: Any, signature: Any, name: str, takes_f: bool = False
) -> Callable[..., None]:
    """The wrapper that `make` puts around a user's function, compiled: around one that copies first, if need be."""
    try:
        wrapper = _compile(make(fun), signature)
    except NumbaError:
        try:
            wrapper = _compile(make(_with_copies(fun, takes_f)), signature)
        except NumbaError as error:
            first = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
            raise NotCompilableError(f"{name} does not compile for this state: {first}") from error
    if any(isinstance(known.return_type, types.Optional) for known in fun.nopython_signatures):
        raise NotCompilableError(f"{name} returns None in some places, and a number or an array in others")
    return wrapper


def _compile(wrapper: Any, signature: Any) -> Any:
    """A wrapper for this signature only: others' arguments are converted to it."""
    wrapper.compile(signature.args)
    wrapper.disable_compile()
    return wrapper


def _with_copies(fun: Any, takes_f: bool) -> Any:
    """A user's function that writes to the state, or to f, on copies of them."""
    if takes_f:
        return njit(lambda t, y, f, *rest: fun(t, y.copy(), f.copy(), *rest))
    return njit(lambda t, y, *rest: fun(t, y.copy(), *rest))


def _wrap_value(fun: Any, has_params: bool) -> Any:
    """From fun(t, y[, params]) -> (n,)."""
    if has_params:
        return njit(lambda t, y, out, params: _fill(out, fun(t, y, params)))
    return njit(lambda t, y, out, params: _fill(out, fun(t, y)))


def _wrap_in_place(fun: Any, has_params: bool) -> Any:
    """From fun(t, y, out[, params])."""
    if has_params:

        @njit
        def rhs(t, y, out, params):
            _clear(out)
            fun(t, y, out, params)

    else:

        @njit
        def rhs(t, y, out, params):
            _clear(out)
            fun(t, y, out)

    return rhs


def _wrap_acceleration(fun: Any, has_params: bool) -> Any:
    """From fun(t, q[, params]) -> (n / 2,), for y = (q, v)."""
    return njit(_second_order(_wrap_value(fun, has_params)))


def _wrap_acceleration_in_place(fun: Any, has_params: bool) -> Any:
    """From fun(t, q, out[, params]), for y = (q, v)."""
    return njit(_second_order(_wrap_in_place(fun, has_params)))


@cached_njit()
def _clear(out):
    """Where a function in place leaves a part as it was, NaN ends the run: not the value of another call."""
    for i in range(out.size):
        out[i] = nan


@cached_njit()
def _clear_rows(out):
    for row in out:
        _clear(row)


@njit
def _fill(out, f):
    if f.size != out.size:
        raise ChangedShapeError(WRONG_FUN)
    for i in range(out.size):
        out[i] = f[i]


def _second_order(acc: Any) -> Any:
    def rhs(t, y, out, params):
        half = y.size // 2
        for i in range(half):
            out[i] = y[half + i]
        acc(t, y[:half], out[half:], params)

    return rhs


WRAPPERS = {
    "value": _wrap_value,
    "in place": _wrap_in_place,
    "acceleration": _wrap_acceleration,
    "acceleration in place": _wrap_acceleration_in_place,
}


@cached_njit()
def _no_values(t, y, values, params):
    pass


@cached_njit()
def _no_gradients(t, y, f, G, params):
    pass


def _chain_value(before: Any, part: _Part, has_params: bool, fun: Any) -> Any:
    """`before`, then the values of one more invariant, by the function `fun`."""
    start, stop, scalar = part.start, part.stop, part.scalar
    wrong = f"invariant {part.label!r} returned an array of another shape than at the start"
    if scalar and has_params:

        @njit
        def inv(t, y, values, params):
            before(t, y, values, params)
            values[start] = fun(t, y, params)

    elif scalar:

        @njit
        def inv(t, y, values, params):
            before(t, y, values, params)
            values[start] = fun(t, y)

    elif has_params:

        @njit
        def inv(t, y, values, params):
            before(t, y, values, params)
            found = fun(t, y, params)
            if len(found) != stop - start:
                raise ChangedShapeError(wrong)
            for i in range(stop - start):
                values[start + i] = found[i]

    else:

        @njit
        def inv(t, y, values, params):
            before(t, y, values, params)
            found = fun(t, y)
            if len(found) != stop - start:
                raise ChangedShapeError(wrong)
            for i in range(stop - start):
                values[start + i] = found[i]

    return inv


def _wrap_gradient(part: _Part, has_params: bool) -> Any:
    """The user's gradient with all arguments: (t, y, f, params) -> rows, or (t, y, f, out, params) in place."""
    grad, uses_f = part.grad, part.uses_f
    if part.in_place:
        if uses_f and has_params:
            return njit(lambda t, y, f, out, params: grad(t, y, f, out, params))
        if uses_f:
            return njit(lambda t, y, f, out, params: grad(t, y, f, out))
        if has_params:
            return njit(lambda t, y, f, out, params: grad(t, y, out, params))
        return njit(lambda t, y, f, out, params: grad(t, y, out))
    if uses_f and has_params:
        return njit(lambda t, y, f, params: grad(t, y, f, params))
    if uses_f:
        return njit(lambda t, y, f, params: grad(t, y, f))
    if has_params:
        return njit(lambda t, y, f, params: grad(t, y, params))
    return njit(lambda t, y, f, params: grad(t, y))


def _chain_gradient(before: Any, part: _Part, has_params: bool, given: Any) -> Any:
    """`before`, then the gradient of one more invariant, by the function `given`, in its row or rows."""
    start, stop, rows = part.start, part.stop, part.stop - part.start
    gradient = _wrap_gradient(part._replace(grad=given), has_params)
    wrong = f"gradient of invariant {part.label!r} has another shape than at the start"
    if part.in_place and not part.scalar:

        @njit
        def grad(t, y, f, G, params):
            before(t, y, f, G, params)
            _clear_rows(G[start:stop])
            gradient(t, y, f, G[start:stop], params)

    elif part.in_place:

        @njit
        def grad(t, y, f, G, params):
            before(t, y, f, G, params)
            _clear(G[start])
            gradient(t, y, f, G[start], params)

    elif not part.scalar:

        @njit
        def grad(t, y, f, G, params):
            before(t, y, f, G, params)
            found = gradient(t, y, f, params)
            if found.shape[0] != rows or found.shape[1] != G.shape[1]:
                raise ChangedShapeError(wrong)
            for i in range(rows):
                for j in range(G.shape[1]):
                    G[start + i, j] = found[i, j]

    else:

        @njit
        def grad(t, y, f, G, params):
            before(t, y, f, G, params)
            found = gradient(t, y, f, params)
            if found.size != G.shape[1]:
                raise ChangedShapeError(wrong)
            for j in range(G.shape[1]):
                G[start, j] = found[j]

    return grad
