"""Functions of augmented states, which consist of a state and its tangent vectors, for the option `variations`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from ..engine.native import BUILD, LibraryFunction
from .functions import (
    GRADIENT,
    NotCompilableError,
    PointerFunction,
    by_pointer,
    compiled_like,
    is_compiled,
    is_jitted,
    jit_is_off,
    jitted_call,
    scalars,
)
from .gradients import NumericalGradient, difference_gradient, typical_sizes, unless_error
from .inputs import as_vector, filled, require_arguments, shown
from .invariant_set import with_duals
from .invariants import Invariant, copied
from .tangent_vectors import TangentVectors

__all__ = ["First", "Variations", "augmented_rhs"]

Array = np.ndarray
# Largest difference between a derivative that a run would use and a difference of order 6 of the right-hand side: as
# shares of the component and of the largest component. A jvp of the user may itself consist of differences.
TOLERANCES = {"jvp": (0.0, 1e-3), "dual numbers": (1e-3, 1e-12), "complex steps": (0.0, 1e-6)}
# Distances from the start, in units of the state, at which they are compared: at the first one within the domain of the
# function. At the start itself the function may have a kink, or terms that vanish there alone.
DISTANCES = (1e-2, 1e-4, 1e-6, 0.0)
COMPLEX_STEP = 2.0**-332  # a power of two, so that the product has no other error than the rounding of the function
LEAST = 1e-3  # size for differences of a parameter that is 0


class First(NamedTuple):
    """Arguments of the first call of a run's functions: time, state (n,) and further arguments."""

    t: float
    y: Array
    extra: tuple


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
        return _rearranged(own(tangents.parameters), tangents.order[:, : tangents.n]), "problem"
    products = _Products(tangents, fun, form, first)
    rhs, source = products.by_numbers() if jvp is None else (products.by_jvp(jvp), "jvp")
    return _rearranged(rhs, tangents.order), source


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


@lru_cache(maxsize=256)
def _by_products(fun: Any, form: str, jvp: Any, n: int, count: int) -> Any:
    """Return the in-place right-hand side of a state (n,) with `count` tangent vectors; jitted if `fun` and `jvp` are.

    `form` is that of `fun`, see `native_functions`. ``jvp(t, y, dy, ...)`` returns the derivative (n,) along dy.
    """
    taken = n // 2 if form.startswith("acceleration") else n
    offset, in_place = n - taken, form.endswith("place")

    def rhs(t, Y, out, *extra):  # type: ignore[no-untyped-def] # may be compiled
        y = Y[:n]
        out[:offset] = y[taken:]
        if in_place:
            fun(t, y[:taken], out[offset:n], *extra)
        else:
            out[offset:n] = fun(t, y[:taken], *extra)
        for k in range(1, count + 1):
            out[n * k : n * (k + 1)] = jvp(t, y, Y[n * k : n * (k + 1)], *extra)

    return compiled_like(rhs, fun, jvp)


class _Products:
    """Right-hand sides of augmented states in which one vector follows the other, for `fun`, which has this `form`."""

    def __init__(self, tangents: TangentVectors, fun: Any, form: str, first: First) -> None:
        self.tangents, self.fun, self.form, self.first = tangents, fun, form, first
        self.n, self.places = tangents.n, list(tangents.parameters)
        # The derivatives are compared along a random direction whose components have about the sizes of the state's.
        own = np.abs(first.extra[0][self.places]) if self.places else np.zeros(0)
        sizes = np.abs(first.y)
        least = sizes[sizes > 0].min() if sizes.any() else 1.0
        sizes = np.concatenate([np.where(sizes > 0, sizes, least), np.where(own > 0, own, 1.0)])
        self.way = np.random.default_rng(0).standard_normal(tangents.size) * sizes

    def by_jvp(self, jvp: Any) -> Any:
        """Return the right-hand side with the products ``jvp(t, y, dy, ...)``, which are required to be right."""
        if self.places:
            raise ValueError(
                "variations: derivatives with respect to parameters cannot be computed with jvp. Omit jvp, or pass "
                'variations="state" or an array of initial columns.'
            )
        jvp = by_pointer(jvp, "jvp", GRADIENT, takes_f=True, shape=(self.n,))
        if not callable(jvp):
            raise TypeError(f"jvp must be a function jvp(t, y, dy, ...) -> (n,), got {shown(jvp)}.")

        def fun(t: float, y: Array, *extra: Any) -> Array:
            return as_vector(self.derivative(t, y, extra), self.n, y.dtype, "fun returned", t)

        def product(t: float, y: Array, dy: Array, *extra: Any) -> Array:
            return as_vector(jvp(t, y.copy(), dy.copy(), *extra), self.n, y.dtype, "jvp returned", t)

        rhs = _by_products.__wrapped__(fun, "value", product, self.n, self.tangents.count)
        try:
            wrong = self.wrong(rhs, "jvp")
        except TypeError:
            names = ["t", "y", "dy", *["params"] * len(self.first.extra)]
            require_arguments(jvp, names, "jvp", f"Write jvp({', '.join(names)}).")
            raise
        if wrong is not None:
            along = f"along {shown(self.way)}"
            raise ValueError(f"jvp is not the Jacobian of the right-hand side times dy {along}: {wrong}. Correct jvp.")
        called = jitted_call(self.fun)
        if is_jitted(called) and is_jitted(jvp) and not jit_is_off():
            return _by_products(called, self.form, jvp, self.n, self.tangents.count)
        return rhs

    def by_numbers(self) -> tuple[Any, str]:
        """Return the right-hand side by dual numbers, or else by complex steps, and which of them, if it is right."""
        t, y, extra = self.first
        as_vector(self.derivative(t, y, extra), self.n, y.dtype, "fun returned", t)
        numbers, reason = scalars(extra), "it is not compiled by Numba"
        if is_jitted(self.fun) and not jit_is_off() and numbers is not None:
            from .jitted_tangents import rhs_by_duals

            parameters, count = self.tangents.parameters, self.tangents.count
            try:
                rhs = rhs_by_duals(self.fun, self.form, self.n, parameters, count, bool(extra), numbers)
                if (wrong := self.wrong(rhs, "dual numbers")) is None:
                    return rhs, "dual numbers"
                reason = wrong
            except NotCompilableError as error:
                reason = str(error)
            except MemoryError:
                raise
            except Exception as error:  # the function itself raises none at the start
                reason = f"it raises {type(error).__name__} with dual numbers"
        if not unless_error(lambda: self.wrong(self._by_complex_steps, "complex steps") is None):
            raise ValueError(
                "variations: the derivatives of the right-hand side cannot be computed: it does not belong to a "
                f"problem with derivatives, {reason}, and it does not support complex steps. Give jvp=..., a function "
                "jvp(t, y, dy) that returns the product of the Jacobian with dy."
            )
        return self._by_complex_steps, "complex steps"

    def derivative(self, t: float, y: Array, extra: tuple) -> Array:
        """Return the derivative (n,) of a real or complex state y."""
        half = self.n // 2 if self.form.startswith("acceleration") else 0
        state = y[: self.n - half].copy()
        if self.form.endswith("place"):
            found = np.full(self.n - half, np.nan, y.dtype)
            self.fun(t, state, found, *extra)
        else:  # copied, because fun may return the same array in each call
            found = np.array(self.fun(t, state, *extra), ndmin=1)
        return np.concatenate([y[half:], found]) if half else found

    def _shifted(self, t: float, y: Array, shift: Array, extra: tuple) -> Array:
        """Return the derivative where the state and the parameters are shifted by the n + p numbers of `shift`."""
        if self.places:
            params = extra[0].astype(shift.dtype)
            params[self.places] += shift[self.n :]
            extra = (params,)
        return self.derivative(t, y + shift[: self.n], extra)

    def _by_complex_steps(self, t: float, Y: Array, out: Array, *extra: Any) -> None:
        """Compute the right-hand side with products by complex steps, in place."""
        rows, found = (a.reshape(-1, self.tangents.size) for a in (Y, out))
        y, M = rows[0, : self.n], rows[1:]
        found[:, self.n :] = 0.0
        found[0, : self.n] = as_vector(self.derivative(t, y, extra), self.n, Y.dtype, "fun returned", t)
        # Rows of a size below 2, because complex steps have to be small. Powers of two change them without rounding.
        sizes = 2.0 ** (np.frexp(np.abs(M).max(axis=1, keepdims=True))[1] - 1)
        vectors = M / sizes

        def along(t: float, shares: Array) -> Array:
            return self._shifted(t, y, shares @ vectors, extra)

        found[1:, : self.n] = BUILD.gradients.complex_step(along, t, np.zeros(len(M)), (), COMPLEX_STEP).T * sizes

    def wrong(self, rhs: Callable[..., Any], source: str) -> str | None:
        """Return a clause about a wrong product in `rhs`, from the `source`, along the test direction; None if right.

        The products are compared with a difference near the start, at the first distance where `fun` is defined.
        """
        own, of_largest = TOLERANCES[source]
        for share in DISTANCES:
            y = self.first.y + share * self.way[: self.n]
            found, right = unless_error(self._along, rhs, y), self._difference(y)
            if found is not None and np.isfinite(right).all():
                break
        found = self._along(rhs, y) if found is None else found  # raises the error
        with np.errstate(invalid="ignore"):
            sizes = np.maximum(np.abs(found), np.abs(right))
            close = np.abs(found - right) <= own * sizes + of_largest * np.nanmax(sizes, initial=0.0)
        wrong = np.argwhere(np.isfinite(right) & ~close)
        if not wrong.size:
            return None
        row, k = wrong[0]
        return (
            f"component {k} of its derivative along a test direction is {right[k]:.6g} near the start, but "
            f"{found[row, k]:.6g} with {source}"
        )

    def _along(self, rhs: Callable[..., Any], y: Array) -> Array:
        """Return the products (k, n) in `rhs` for vectors that all are the test direction."""
        t, _, extra = self.first
        rows = np.tile(self.way, (1 + self.tangents.count, 1))
        rows[0] = np.concatenate([y, extra[0][self.places] if self.places else []])
        out = np.empty(rows.size)
        rhs(t, rows.ravel(), out, *extra)
        return out.reshape(rows.shape)[1:, : self.n]

    def _difference(self, y: Array) -> Array:
        """Return the derivative (n,) along the test direction by differences; NaN where `fun` raises an error."""
        t, _, extra = self.first

        def along(s: Array) -> Array:
            found: Array | None = unless_error(self._shifted, t, y, s[0] * self.way, extra)
            return np.full(self.n, np.nan) if found is None else found

        with np.errstate(all="ignore"):
            return np.asarray(difference_gradient(along, np.zeros(1), np.full(1, 1e-2)))[..., 0]


def _augmented(item: Invariant, tangents: TangentVectors, first: First, compiled: bool) -> Invariant:
    """Return an invariant, with a gradient, as a function of augmented states; `compiled`: see `Unaugmented`."""
    shape = np.shape(item.function(first.t, first.y.copy(), *item.args, *first.extra))
    places = list(tangents.parameters) if first.extra and not item.args else []
    own = _unaugmented(item, tangents.n, shape, tuple(places), first.extra) if compiled else None
    by_parameters: Callable[..., Any] | None = None if own is None else own.by_parameters
    known = item if own is None else own.function
    known_gradient = _gradient(known, shape, first)

    def arguments(Y: Array, extra: tuple) -> tuple:
        return tangents.arguments(Y, extra) if places else extra

    def value(t: float, Y: Array, *extra: Any) -> Any:
        return item.function(t, tangents.state(Y), *item.args, *arguments(Y, extra))

    def slopes(t: float, y: Array, params: Array) -> Any:
        if by_parameters is not None:
            return by_parameters(t, y, params)
        floors = np.abs(params) + LEAST
        return np.asarray(difference_gradient(lambda p: item.function(t, y.copy(), p), params, floors))[..., places]

    def gradient(t: float, Y: Array, *rest: Any) -> Array:
        F, extra = (rest[:1], rest[1:]) if known.uses_f else ((), rest)
        extra = arguments(Y, extra)
        found = known_gradient(t, *map(tangents.state, (Y, *F)), extra)
        return tangents.spread(found, shape, slopes(t, tangents.state(Y), *extra) if places else 0.0)

    augmented = copied(item)
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
    """Return what the engine calls for an invariant; None if it would have to call Python for it."""
    slopes, has_slopes = None, not parameters or is_jitted(item.function)
    if item.args or scalars(extra) is None or not (_has_address(item.function) and has_slopes):
        return None
    try:
        own = with_duals(item, "gradient", n, shape, extra) if item.gradient is None else item
        if parameters:
            from .jitted_tangents import parameter_gradient

            slopes = parameter_gradient(own.function, extra[0].size, shape, parameters)
    except NotCompilableError:  # the function is then called from Python
        return None
    return Unaugmented(n, own, slopes, len(parameters)) if _has_address(own.gradient) else None
