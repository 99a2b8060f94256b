"""Functions of augmented states, which consist of a state and its tangent vectors, for the option `variations`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from ..engine.native import LibraryFunction, library
from .derivatives import First, NumericalGradient, Products, by_duals, difference_gradient, typical_sizes, with_duals
from .functions import (
    NotCompilableError,
    PointerFunction,
    compiled_like,
    is_compiled,
    is_jitted,
    jit_is_off,
    jitted_call,
    scalars,
    without_gradient,
)
from .inputs import filled
from .invariants import Invariant, copied
from .tangent_vectors import TangentVectors

__all__ = ["Variations", "augmented_rhs"]

Array = np.ndarray
BY_PARAMETERS = "_by_parameters"  # ends the names of functions of the library
LEAST = 1e-3  # size for differences of a parameter that is 0


class Unaugmented(NamedTuple):
    """A function of the state (n,) alone, which the engine calls for an invariant or event of augmented states.

    `function` is the `Invariant` or the event. If `parameters` parameters are in the augmented state,
    ``by_parameters(t, y, params)`` returns the derivatives of an invariant with respect to them.
    """

    n: int
    function: Any
    by_parameters: Callable[..., Any] | None = None
    parameters: int = 0


@dataclass(frozen=True)
class Variations:
    """The functions of augmented states.

    `rhs` is the right-hand side in place, ``rhs(t, Y, out, *extra)``. `invariants` are functions of augmented states,
    and `given` the same invariants as functions of states. `source` is the source of the products with the Jacobian:
    "problem", "jvp", "dual numbers" or "complex steps".
    """

    tangents: TangentVectors
    rhs: Callable[..., Any]
    source: str
    invariants: tuple[Invariant, ...]
    given: tuple[Invariant, ...]

    @classmethod
    def of(
        cls, tangents: TangentVectors, rhs: Any, source: str, first: First, given: Any, *, in_python: bool = False
    ) -> Variations:
        """Return the functions with a right-hand side from `augmented_rhs`; compiled ones unless `in_python`."""
        if any(item.is_balance for item in given):
            raise ValueError(
                "variations: derivatives are not carried together with balances, whose values depend on the whole "
                "orbit; omit the balances in this run."
            )
        compiled = _has_address(rhs) and not in_python
        items = tuple(_augmented(item, tangents, first, compiled) for item in given)
        return cls(tangents, rhs, source, items, tuple(given))

    def derivative(self, t: float, Y: Array, *extra: Any) -> Array:
        """Return the derivative (m,) of the augmented state Y with respect to time."""
        out = np.empty_like(Y)
        self.rhs(t, Y, out, *extra)
        return out

    def with_targets(self, augmented: tuple[Invariant, ...]) -> tuple[Invariant, ...]:
        """Return copies of `given` with the targets of the same invariants as functions of augmented states."""
        kept = tuple(map(copied, self.given))
        for own, known in zip(kept, augmented, strict=True):
            own.target, own.is_measured = known.target, known.is_measured
        return kept

    def event(self, fun: Callable[..., Any]) -> Callable[..., Any]:
        """Return an event as a function of augmented states."""

        def augmented(t: float, Y: Array, *extra: Any) -> Any:
            return fun(t, self.tangents.state(Y), *extra)

        augmented.unaugmented = Unaugmented(self.tangents.n, fun)  # type: ignore[attr-defined]
        for name in ("terminal", "direction"):
            if hasattr(fun, name):
                setattr(augmented, name, getattr(fun, name))
        return augmented


def _has_address(fun: Any) -> bool:
    """Return True if a function belongs to the library or is jitted, so that the engine calls it by its address."""
    return is_compiled(fun) and not (is_jitted(fun) and jit_is_off())


def augmented_rhs(
    tangents: TangentVectors, fun: Any, form: str, first: First, jvp: Any, own: Any = None
) -> tuple[Callable[..., Any], str]:
    """Return the right-hand side of augmented states, in place, and the source of its products with the Jacobian.

    `own` is that of the problem, see ``Problem.variational``; otherwise the products of `fun` are made by `jvp`, if it
    is given, by dual numbers or by complex steps, and compared with differences of `fun`.
    """
    if tangents.parameters and scalars(first.extra) != "":
        raise ValueError("variations: derivatives with respect to parameters need params=[...], one array of numbers.")
    if own is not None and jvp is None:
        rhs = own(tangents.parameters)
        if isinstance(rhs, LibraryFunction) and rhs.__name__.endswith(BY_PARAMETERS):
            return _bound(rhs.__name__, tangents.parameters, first.extra), "problem"
        return _rearranged(rhs, tangents.order[:, : tangents.n]), "problem"
    products = Products(tangents, fun, form, first)
    rhs, source = products.by_numbers() if jvp is None else (products.by_jvp(jvp), "jvp")
    return _rearranged(rhs, tangents.order), source


def _bound(function: str, parameters: tuple[int, ...], extra: tuple) -> LibraryFunction:
    """Return a function of the library by parameters, bound to those of a run, see problems/by_parameters.hpp."""
    return library[function].bound((*extra[0], *parameters, len(parameters)))


def _rearranged(rhs: Callable[..., Any], places: Array) -> Callable[..., Any]:
    """Return the in-place right-hand side of a state that is that of `rhs` at `places` and constant elsewhere."""
    order = tuple(places.ravel().tolist())
    if order == tuple(range(len(order))):
        return rhs
    called = jitted_call(rhs)
    keeps = is_jitted(called) and not jit_is_off()  # what has been compiled, which takes seconds
    return (_at_places if keeps else _at_places.__wrapped__)(called if keeps else rhs, order)


@lru_cache(maxsize=256)
def _at_places(rhs: Callable[..., Any], order: tuple[int, ...]) -> Callable[..., Any]:
    places = np.array(order, np.int64)

    def in_place(t, Y, out, *extra):  # type: ignore[no-untyped-def] # may be compiled
        found = np.empty(places.size)
        rhs(t, Y[places], found, *extra)
        out[:] = 0.0
        out[places] = found

    return compiled_like(in_place, rhs)


def _augmented(item: Invariant, tangents: TangentVectors, first: First, compiled: bool) -> Invariant:
    """Return an invariant, with a gradient, as a function of augmented states; `compiled`: see `Unaugmented`."""
    shape = np.shape(item.function(first.t, first.y.copy(), *item.args, *first.extra))
    places = list(tangents.parameters) if first.extra and not item.args else []
    own, why = None, ""
    try:
        own = _unaugmented(item, tangents.n, shape, tuple(places), first.extra) if compiled else None
    except NotCompilableError as error:  # the function is then called from Python
        why = without_gradient(str(item.name or getattr(item.function, "__name__", "?")), str(error))
    by_parameters: Callable[..., Any] | None = None if own is None else own.by_parameters
    known = item if own is None else own.function
    known_gradient = _gradient(known, shape, first)

    def arguments(Y: Array, extra: tuple) -> tuple:
        return tangents.arguments(Y, extra) if places else extra

    def value(t: float, Y: Array, *extra: Any) -> Any:
        return item.function(t, tangents.state(Y), *item.args, *arguments(Y, extra))

    def slopes(t: float, y: Array, params: Array) -> Any:
        if by_parameters is not None:
            return np.reshape(by_parameters(t, y, params), (*shape, len(places)))
        floors = np.abs(params) + LEAST
        return np.asarray(difference_gradient(lambda p: item.function(t, y.copy(), p), params, floors))[..., places]

    def gradient(t: float, Y: Array, *rest: Any) -> Array:
        F, extra = (rest[:1], rest[1:]) if known.uses_f else ((), rest)
        extra = arguments(Y, extra)
        found = known_gradient(t, *map(tangents.state, (Y, *F)), extra)
        return tangents.spread(found, shape, slopes(t, tangents.state(Y), *extra) if places else 0.0)

    augmented = copied(item)
    value.not_jitted = why  # type: ignore[attr-defined]
    augmented.function, augmented.gradient, augmented.args = value, gradient, ()
    augmented.in_place, augmented.uses_f, augmented.unaugmented = False, known.uses_f, own
    return augmented


def _gradient(item: Invariant, shape: tuple[int, ...], first: First) -> Callable[..., Any]:
    """Return ``gradient(t, y[, f], extra)``, for calls from Python, of an invariant whose value has this `shape`."""
    gradient, n = item.gradient, first.y.size
    if gradient is None:
        takes_complex = not isinstance(item.function, PointerFunction | LibraryFunction)
        floors = typical_sizes(first.y, np.zeros(n), 0.0)
        numerical = NumericalGradient(item.function, item.args, takes_complex, *first[:2], floors, first.extra)
        return lambda t, y, extra: numerical(t, y, *extra)
    if not item.in_place:
        return lambda *given: gradient(*given[:-1], *item.args, *given[-1])

    def in_place(*given: Any) -> Array:
        def fill(out: Array) -> Any:
            return gradient(*given[:-1], out, *item.args, *given[-1])

        return filled(fill, (*shape, n), float, "gradient", given[0])

    return in_place


def _unaugmented(
    item: Invariant, n: int, shape: tuple[int, ...], parameters: tuple[int, ...], extra: tuple
) -> Unaugmented | None:
    """Return what the engine calls for an invariant; None if it would have to call Python for it.

    Raise NotCompilableError if dual numbers cannot do what the invariant does.
    """
    slopes, by_library = None, f"{getattr(item.function, '__name__', '')}{BY_PARAMETERS}"
    has_slopes = not parameters or is_jitted(item.function) or by_library in library
    if item.args or scalars(extra) is None or not (_has_address(item.function) and has_slopes):
        return None
    own = with_duals(item, "gradient", n, shape, extra) if item.gradient is None else item
    if parameters and by_library in library:
        slopes = _bound(by_library, parameters, extra)
    elif parameters:
        slopes = by_duals("parameter_gradient", own.function, extra[0].size, shape, parameters)
    return Unaugmented(n, own, slopes, len(parameters)) if _has_address(own.gradient) else None
