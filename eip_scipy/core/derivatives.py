"""Derivatives of a user's functions: gradients of invariants, and products of the Jacobian of f with vectors.

Each has one source: a function of the user's, dual numbers for jitted functions, complex steps if they are correct,
otherwise differences. Gradients that f has already are in `conserved`. Products are compared with a difference along a
random direction at the start of a run, and gradients in `invariant_checks`.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from ..engine.data import EPS
from ..engine.native import BUILD
from .functions import (
    GRADIENT,
    NotCompilableError,
    PointerFunction,
    by_pointer,
    compiled_like,
    is_jitted,
    jit_is_off,
    jitted_call,
    scalars,
)
from .inputs import as_vector, require_arguments, shown
from .invariants import Invariant, copied

if TYPE_CHECKING:
    from .tangent_vectors import TangentVectors

__all__ = [
    "First", "NumericalGradient", "Products", "by_duals", "difference_gradient", "random_directions", "time_of_motion",
    "typical_sizes", "unless_error", "with_duals",
]  # fmt: skip

Array = np.ndarray

COMPLEX_STEP = 1e-100
# Distances from the start, in units of its components' sizes, at which a complex step is tried, and the largest allowed
# difference from central differences, in units of the largest component. The shorter distances avoid a singularity
# close to the start.
TRIALS = ((1e-2, 1e-7), (1e-4, 1e-9), (1e-6, 1e-10))
# Central differences of order 6: weights of +-1, +-2, +-3 steps (Fornberg 1988, table 1); those of order 4, to compare.
DIFFERENCE_WEIGHTS = ((1, 3 / 4), (2, -3 / 20), (3, 1 / 60))
LOWER_WEIGHTS = (2 / 3, -1 / 12, 0.0)
# Largest number of floats of a state for which quadratic forms are looked for, by half the square of it in evaluations.
MOST_QUADRATIC = 64
# As in engine/cpp/differences.hpp.
FIRST_SHIFT, SHORTER, MOST_SHIFTS = 5e-3, 1 / 16, 7
DIFFER, ROUNDINGS, LEAST = 1e-8, 1e3, np.finfo(float).tiny
# Largest difference between a derivative that a run would use and a difference of order 6 of the right-hand side: as
# shares of the component and of the largest component. A jvp of the user may itself consist of differences.
TOLERANCES = {"jvp": (0.0, 1e-3), "dual numbers": (1e-3, 1e-12), "complex steps": (0.0, 1e-6)}
# Distances from the start, in units of the state, at which they are compared: at the first one within the domain of the
# function. At the start itself the function may have a kink, or terms that vanish there alone.
DISTANCES = (1e-2, 1e-4, 1e-6, 0.0)
POWER_STEP = 2.0**-332  # a power of two, so that the product has no other error than the rounding of the function
time_of_motion, typical_sizes = BUILD.time_of_motion, BUILD.typical_sizes


def unless_error(function: Callable[..., Any], *args: Any) -> Any:
    """Return ``function(*args)``, of a user's or a library's function; None if it raises any error but MemoryError."""
    try:
        return function(*args)
    except MemoryError:
        raise
    except Exception:
        return None


@lru_cache(maxsize=256)
def by_duals(kind: str, *given: Any) -> Any:
    """Return the derivative of this `kind` by dual numbers, ``numba_duals.<kind>(*given)``, which loads Numba.

    Raise NotCompilableError if dual numbers cannot do what the function does.
    """
    from .. import numba_duals

    try:
        return getattr(numba_duals, kind)(*given)
    except numba_duals.NotDifferentiableError as error:
        raise NotCompilableError(str(error)) from error


def with_duals(item: Invariant, kind: str, n: int, shape: tuple[int, ...], extra: tuple) -> Invariant:
    """Return an invariant with a compiled "gradient" or "rate", the `kind`; itself if it is not jitted, or has args.

    The state is real and has n components. Raise NotCompilableError if dual numbers cannot do what the invariant does.
    """
    types = scalars(extra)
    if item.args or types is None or not is_jitted(item.function) or jit_is_off():
        return item
    made = by_duals(kind, item.function, n, shape, bool(extra), types)
    item = copied(item)
    if kind == "gradient":
        item.gradient, item.in_place = made, True
    else:
        item.rate_function, item.rate_uses_f = made, True
    return item


class NumericalGradient:
    """Numerical gradient: by complex steps if they are correct, otherwise by differences of order 6.

    A complex step is wrong if the function uses an absolute value, a norm or a real part, perhaps only in a part of its
    domain. Therefore each gradient by complex steps is compared with a difference along one direction. So is that of a
    quadratic form, found at the start, which takes the place of differences. The choice depends on the state only, so
    that a resumed run makes the same steps. `by_differences` is True if neither is possible.

    ``fun(t, y, *args, *extra)`` is the invariant's function, with its own arguments and those of the run;
    `takes_complex` is False if it cannot be called with complex states. `t` and `y` are the start. `floors` (n,) are
    added to the sizes of the components in the lengths of difference steps, see `typical_sizes`.
    """

    def __init__(
        self, fun: Callable[..., Any], args: tuple, takes_complex: bool, t: float, y: Array, floors: Array, extra: tuple
    ) -> None:
        self._function, self._args = fun, args
        self.floors = floors
        self._direction = random_directions(y.size, False)[-1]
        self.complex_step = takes_complex and y.dtype.kind == "f" and self._takes_complex_steps(t, y, extra)
        self.quadratic: tuple[Array, Array] | None = None
        if not (self.complex_step or isinstance(fun, PointerFunction) or y.view(float).size > MOST_QUADRATIC):
            with np.errstate(all="ignore"):
                self.quadratic = unless_error(self._quadratic_form, t, y, extra)
        self.by_differences = not self.complex_step and self.quadratic is None

    def __call__(self, t: float, y: Array, *extra: Any) -> Array:
        """Return the gradient (n,) at (t, y), or (l_i, n) of an invariant with l_i values."""
        if self.complex_step:
            where = self._function, t, y, self._args + extra, COMPLEX_STEP, self._direction, self.floors
            found: Array | None = unless_error(BUILD.gradients.checked_complex_step, *where)
            if found is not None:  # it is None if it disagrees with a difference
                return found
        if self.quadratic is not None and (found := self._of_form(t, y, extra)) is not None:
            return found
        return difference_gradient(lambda x: self._fun(t, x, extra), y, self.floors)

    def _units(self, y: Array) -> Array:
        """Return for each float of y a power of two that has about its size."""
        return 2.0 ** np.round(np.log2(np.repeat(np.abs(y) + self.floors, y.itemsize // 8)))

    def _quadratic_form(self, t: float, y: Array, extra: tuple) -> tuple[Array, Array] | None:
        """Return Q and b of values z Q z / 2 + b z + c of the floats z of the state; None if they have another form."""
        z, units, here = y.view(float), self._units(y), self._fun(t, y, extra)

        def value(shift: Array) -> Array:
            return self._fun(t, (z + shift).view(y.dtype), extra)

        for way in random_directions(z.size, False) * units:
            ends = np.array([value(way), here, value(-way), value(2 * way)])
            third = ends[3] - 3 * ends[0] + 3 * ends[1] - ends[2]
            if not (np.abs(third) <= ROUNDINGS * EPS * np.abs(ends).max(axis=0)).all():
                return None
        shifts = np.diag(units)
        above, below = (np.array([value(sign * shift) for shift in shifts]) for sign in (1, -1))
        Q, rounding = np.zeros((z.size, *above.shape)), ROUNDINGS * EPS * np.abs([above, below]).max(axis=(0, 1))
        for j in range(z.size):
            Q[j, j] = above[j] - 2 * here + below[j]
            for k in range(j):
                Q[j, k] = Q[k, j] = value(shifts[j] + shifts[k]) - above[j] - above[k] + here
        Q = np.moveaxis(np.where(np.abs(Q) <= rounding, 0.0, Q), (0, 1), (-2, -1)) / np.outer(units, units)
        return Q, np.moveaxis(above - below, 0, -1) / (2 * units) - Q @ z

    def _of_form(self, t: float, y: Array, extra: tuple) -> Array | None:
        """Return the gradient of the quadratic form; None if it disagrees with a difference along one direction."""
        Q, b = cast(tuple[Array, Array], self.quadratic)
        found, way = Q @ y.view(float) + b, self._units(y) * random_directions(b.shape[-1], False)[-1]
        above, below = (self._fun(t, y + shift.view(y.dtype), extra) for shift in (way, -way))
        terms = DIFFER * (np.abs(found) @ np.abs(way)) + ROUNDINGS * EPS * np.maximum(np.abs(above), np.abs(below))
        return found.view(y.dtype) if (np.abs(above - below - 2 * (found @ way)) <= terms).all() else None

    def _fun(self, t: float, y: Array, extra: tuple) -> Array:
        return np.array(self._function(t, y.copy(), *self._args, *extra))  # the function may return the same array

    def _takes_complex_steps(self, t: float, y: Array, extra: tuple) -> bool:
        """Return True if the function accepts complex states and is analytic at states near the start."""
        real = self._fun(t, y, extra)

        def is_analytic() -> bool:
            plain = self._fun(t, y.astype(complex), extra)
            if np.any(np.imag(plain) != 0) or not np.allclose(np.real(plain), real, rtol=1e-12):
                return False
            return any(self._agrees_beside(t, y, extra, *trial) for trial in TRIALS)

        with warnings.catch_warnings():
            warnings.simplefilter("error", np.exceptions.ComplexWarning)
            return bool(unless_error(is_analytic))

    def _agrees_beside(self, t: float, y: Array, extra: tuple, length: float, tolerance: float) -> bool:
        size = np.abs(y) + self.floors
        y = y + length * size * random_directions(y.size, False)[0]
        G = BUILD.gradients.complex_step(self._function, t, y, self._args + extra, COMPLEX_STEP)
        D = difference_gradient(lambda x: self._fun(t, x, extra), y, self.floors)
        return bool(np.all(np.abs((G - D) * size) <= tolerance * np.max(np.abs(D * size), axis=-1, keepdims=True)))


def difference_gradient(value: Callable[[Array], Any], y: Array, floor: Array) -> Array:
    """Return the gradient (..., n) of value(y) by central differences of order 6, with the bits of differences.hpp.

    The shift of y_k is a fixed multiple of ``abs(y[k]) + floor[k]``, rounded to a power of two. If differences of order
    4 disagree, as near a singularity that is closer than the state's size, the shifts are shortened until both orders
    agree. If they never agree, the shift with the best agreement is used.
    """

    def along(k: int, unit: complex) -> Any:
        # The shift is a power of two, so that adding it to y has no other error than the rounding of the sum.
        shift = 2.0 ** np.round(np.log2(FIRST_SHIFT * (abs(y[k]) + floor[k])))
        found, least = None, np.inf
        for _ in range(MOST_SHIFTS):
            sums, excess = _shifted_sums(value, y, k, shift * unit)
            found = np.full_like(sums, np.nan) if found is None else found
            if excess < least:
                found, least = sums / shift, excess
            if least <= 1:
                break
            shift *= SHORTER
        return found

    columns = [along(k, 1.0) for k in range(y.size)]
    if y.dtype.kind == "c":
        columns = [column + 1j * along(k, 1j) for k, column in enumerate(columns)]
    return np.stack(columns, axis=-1)


def _shifted_sums(value: Callable[[Array], Any], y: Array, k: int, shift: complex) -> tuple[Array, float]:
    """Return differences of order 6 for y_k times the shift, and their largest share of what order 4 may differ."""
    sums, lower, largest = np.zeros(()), np.zeros(()), np.zeros(())
    for (multiple, weight), lower_weight in zip(DIFFERENCE_WEIGHTS, LOWER_WEIGHTS, strict=True):
        ends = [y.copy(), y.copy()]
        ends[0][k] += multiple * shift
        ends[1][k] -= multiple * shift
        above, below = (np.array(value(end)) for end in ends)  # copies, because both may be the same array
        with np.errstate(invalid="ignore"):
            sums, lower = sums + weight * (above - below), lower + lower_weight * (above - below)
            largest = np.max([np.broadcast_to(largest, above.shape), np.abs(above), np.abs(below)], axis=0)
    with np.errstate(invalid="ignore"):
        excess = np.abs(sums - lower) / (DIFFER * np.abs(sums) + ROUNDINGS * EPS * largest + LEAST)
    return sums, float(np.max(excess, initial=0.0))


class First(NamedTuple):
    """Arguments of the first call of a run's functions: time, state (n,) and further arguments."""

    t: float
    y: Array
    extra: tuple


class Products:
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

        rhs = _with_products.__wrapped__(fun, "value", product, self.n, self.tangents.count)
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
            return _with_products(called, self.form, jvp, self.n, self.tangents.count)
        return rhs

    def by_numbers(self) -> tuple[Any, str]:
        """Return the right-hand side by dual numbers, or else by complex steps, and which of them, if it is right."""
        t, y, extra = self.first
        as_vector(self.derivative(t, y, extra), self.n, y.dtype, "fun returned", t)
        numbers, reason = scalars(extra), "it is not compiled by Numba"
        if is_jitted(self.fun) and not jit_is_off() and numbers is not None:
            parameters, count = self.tangents.parameters, self.tangents.count
            try:
                rhs = by_duals("pushforward", self.fun, self.form, self.n, parameters, count, bool(extra), numbers)
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

        found[1:, : self.n] = BUILD.gradients.complex_step(along, t, np.zeros(len(M)), (), POWER_STEP).T * sizes

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


@lru_cache(maxsize=256)
def _with_products(fun: Any, form: str, jvp: Any, n: int, count: int) -> Any:
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


@lru_cache
def random_directions(n: int, is_complex: bool) -> Array:
    """Return two random directions (2, n), the same in each run; they are cached, because making them takes long."""
    rng = np.random.default_rng(20220)
    parts = rng.standard_normal((2, 2 if is_complex else 1, n))
    return parts[:, 0] + 1j * parts[:, 1] if is_complex else parts[:, 0]
