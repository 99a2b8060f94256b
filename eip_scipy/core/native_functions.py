"""Addresses of the user's functions, which the native engine calls: C functions and compiled Numba functions."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

import numpy as np

from ..engine.native import LibraryFunction, NativeFunctions, Rates
from .arguments import Packed
from .invariant_set import InvariantSet
from .jitted import NotCompilableError, is_jitted, jit_is_off
from .pointers import PointerFunction

if TYPE_CHECKING:
    from .numba_pointers import Compiled
    from .runs import Run

__all__ = ["Kind", "native_functions", "raise_again", "with_events"]

NO_DUALS = "a gradient is compiled only for jitted functions of real states"


class Kind(NamedTuple):
    """Signature of a function.

    Its value has the `shape`, () for a number, and is real, even if the state is complex, if `real`. It receives `size`
    components of the state, of the type `dtype`, and an array params of length `p`, -1 for none, or numbers of the
    types `scalars`, see `Packed`. The user's function takes f, the derivative of the state, if `takes_f`, and fills an
    argument `out` if `in_place`. If `gradient`, the engine calls it with the arguments of a gradient, which include f.
    """

    shape: tuple[int, ...]
    size: int
    p: int
    dtype: str
    real: bool = False
    takes_f: bool = False
    in_place: bool = False
    gradient: bool = False
    scalars: str = ""

    def like(self, shape: tuple[int, ...], size: int, **flags: bool) -> Kind:
        """Return the signature of a function with the same parameters and type of state (`_replace` is slow)."""
        return Kind(shape, size, self.p, self.dtype, scalars=self.scalars, **flags)


class Native(NamedTuple):
    """A function that the engine calls, or None if it computes this itself, and the number of floats filled."""

    function: PointerFunction | Compiled | LibraryFunction | None
    floats: int

    @property
    def entry(self) -> Any:
        """Form in which the engine receives the function: its address, or the `LibraryFunction` or None itself."""
        if self.function is None or isinstance(self.function, LibraryFunction):
            return self.function
        return self.function.address


def native_functions(
    fun: Callable[..., Any], form: str, params: Packed | None, run: Run, jacobian: Callable[..., Any] | None = None
) -> NativeFunctions:
    """Return the addresses of the functions of a run, except those of its events, which `with_events` adds.

    The right-hand side `fun` has the `form` "value", "in place", "acceleration" or "acceleration in place". `params`
    are the last arguments of the functions; the engine passes their array itself, not a copy. For a multistep method,
    ``jacobian(t, q, dq, out[, params])`` is the Jacobian times dq. Raise NotCompilableError if one of these functions
    is neither a function of the library, nor a C function by pointer, nor a Numba function of the documented arguments,
    or if an invariant has `args`, or no gradient that can be compiled.
    """
    invariants, y0 = run.invariants, run.y0
    second_order, number = form.startswith("acceleration"), _number(params, y0)
    size = y0.size // 2 if second_order else y0.size
    of_rhs = number.like((size,), size, in_place=form.endswith("place"))
    rhs = _native(fun, of_rhs, "acceleration" if second_order else "fun")
    inv: list[Native] = []
    grad: list[Native] = []
    slopes: list[Native] = []
    rate: list[Native] = []
    product: list[Native] = []
    for k, (item, label) in enumerate(zip(invariants.items, invariants.labels, strict=True)):
        own = item.unaugmented
        item, value = _unaugmented(item, number)
        name, shape = f"invariant {label!r}", _shape(invariants, k)
        if item.args:
            raise NotCompilableError(f"{name} has args; pass its parameters through params")
        inv.append(_native(item.function, value.like(shape, value.size, real=True), name))
        if item.gradient is None and not isinstance(item.function, PointerFunction):
            raise NotCompilableError(f"{name} has no grad, and {invariants.why_not.get(label, NO_DUALS)}")
        rows = (*shape, value.size)
        of_rows = value.like(rows, value.size, takes_f=item.uses_f, in_place=item.in_place, gradient=True)
        grad.append(_native(item.gradient, of_rows, f"gradient of {name}"))
        if own is not None and own.by_parameters is not None:
            of_slope = value.like((*shape, own.parameters), value.size, real=True)
            slopes.append(_native(own.by_parameters, of_slope, f"derivatives by parameters of {name}"))
    for k, item in invariants.balances.items.items():
        of_rate = number.like(_shape(invariants, k), y0.size, real=True, takes_f=item.rate_uses_f, gradient=True)
        rate.append(_native(item.rate_function, of_rate, f"rate of balance {invariants.labels[k]!r}"))
    if jacobian is not None:
        half = y0.size // 2
        of_product = number.like((half,), half, takes_f=True, in_place=True, gradient=True)
        product.append(_native(jacobian, of_product, "jacobian"))
    return NativeFunctions(
        rhs=rhs.entry,
        inv=_addresses(inv),
        grad=_addresses(grad),
        event=(),
        params=np.zeros(0) if params is None else params.values,  # itself: an ensemble writes each member's there
        second_order=second_order,
        jacobian=product[0].entry if product else None,
        rates=invariants.rates(run.options.adaptive, [found.entry for found in rate]) if rate else Rates(),
        by_parameters=_addresses(slopes),
        floors=invariants.floors if any(found.function is None for found in grad) else None,
        owner={
            "rhs": [rhs], "inv": inv, "grad": grad, "event": [], "by_parameters": slopes, "rate": rate,
            "jacobian": product,
        },
    )  # fmt: skip


def _shape(invariants: InvariantSet, k: int) -> tuple[int, ...]:
    """Return the shape of the value of invariant k."""
    return () if invariants.scalar[k] else (invariants.starts[k + 1] - invariants.starts[k],)


def _unaugmented(fun: Any, number: Kind) -> tuple[Any, Kind]:
    """Return what the engine calls for `fun`, the function of the state alone if there is one, and its signature."""
    alone = getattr(fun, "unaugmented", None)
    return (fun, number) if alone is None else (alone.function, number._replace(size=alone.n))


def with_events(
    functions: NativeFunctions, events: Sequence[Callable[..., Any]], params: Packed | None, y0: np.ndarray
) -> NativeFunctions:
    """Return a copy of `functions` with the addresses of the events, or raise NotCompilableError."""
    number = _number(params, y0)
    event = [_native(*_unaugmented(function, number), f"event {k}") for k, function in enumerate(events)]
    return functions._replace(event=_addresses(event), owner=functions.owner | {"event": event})


def raise_again(functions: NativeFunctions, group: str, k: int, t: float, y: bytes, f: bytes, status: int) -> NoReturn:
    """Raise the exception of a function whose call failed in the engine: of a Numba function its own, of any type.

    The arguments after `functions` are those of the `FailedCallError` that the engine raised. The function is number
    `k` of the list ``functions.owner[group]``. It was called with `t` and the arrays whose bytes are `y` and `f`, and
    returned `status`.
    """
    function = functions.owner[group][k].function
    if isinstance(function, PointerFunction):
        raise function.failure(t, status)
    raise function.failure(t, y, f, functions.params)


def _number(params: Packed | None, y0: np.ndarray) -> Kind:
    if params is None:
        return Kind((), y0.size, -1, y0.dtype.char, real=True)
    return Kind((), y0.size, params.values.size, y0.dtype.char, real=True, scalars=params.scalars)


def _native(fun: Any, kind: Kind, name: str) -> Native:
    """Return a function as `Native`, compiled if it is a Numba function, of the signature `kind`.

    `name` is its name in messages. The engine computes gradients and rates that are None.
    """
    floats = math.prod(kind.shape) * (2 if kind.dtype in "FD" and not kind.real else 1)
    if fun is None or isinstance(fun, (PointerFunction, LibraryFunction)):
        return Native(fun, floats)
    if jit_is_off():
        raise NotCompilableError("Numba's JIT is disabled (NUMBA_DISABLE_JIT)")
    if not is_jitted(fun):
        raise NotCompilableError(f"{name} is not a Numba function; decorate it with @numba.njit")
    from .numba_pointers import compiled  # which loads Numba

    return Native(compiled(fun, kind, name), floats)


def _addresses(functions: list[Native]) -> tuple[tuple[int, int], ...]:
    return tuple((found.entry, found.floats) for found in functions)
