"""Numerical gradients of invariants: complex steps if they are correct, otherwise differences."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np

from ..engine.data import EPS
from ..engine.native import BUILD

__all__ = ["NumericalGradient", "difference_gradient", "random_directions", "typical_sizes", "unless_error"]

Array = np.ndarray

COMPLEX_STEP = 1e-100
# Distances from the start, in units of its components' sizes, at which a complex step is tried, and the largest allowed
# difference from central differences, in units of the largest component. The shorter distances avoid a singularity
# close to the start.
TRIALS = ((1e-2, 1e-7), (1e-4, 1e-9), (1e-6, 1e-10))
# Central differences of order 6: weights of +-1, +-2, +-3 steps (Fornberg 1988, table 1); those of order 4, to compare.
DIFFERENCE_WEIGHTS = ((1, 3 / 4), (2, -3 / 20), (3, 1 / 60))
LOWER_WEIGHTS = (2 / 3, -1 / 12, 0.0)
# As in engine/cpp/differences.hpp.
FIRST_SHIFT, SHORTER, MOST_SHIFTS = 5e-3, 1 / 16, 7
DIFFER, ROUNDINGS, LEAST = 1e-8, 1e3, np.finfo(float).tiny


def unless_error(function: Callable[..., Any], *args: Any) -> Any:
    """Return ``function(*args)``, of a user's or a library's function; None if it raises any error but MemoryError."""
    try:
        return function(*args)
    except MemoryError:
        raise
    except Exception:
        return None


class NumericalGradient:
    """Numerical gradient: by complex steps if they are correct, otherwise by differences of order 6.

    A complex step is wrong if the function uses an absolute value, a norm or a real part, perhaps only in a part of its
    domain. Therefore each gradient by complex steps is compared with a difference along one direction. The choice
    depends on the state only, so that a resumed run makes the same steps.

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

    def __call__(self, t: float, y: Array, *extra: Any) -> Array:
        """Return the gradient (n,) at (t, y), or (l_i, n) of an invariant with l_i values."""
        if self.complex_step:
            where = self._function, t, y, self._args + extra, COMPLEX_STEP, self._direction, self.floors
            found: Array | None = unless_error(BUILD.gradients.checked_complex_step, *where)
            if found is not None:  # it is None if it disagrees with a difference
                return found
        return difference_gradient(lambda x: self._fun(t, x, extra), y, self.floors)

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


def typical_sizes(y: Array, f: Array, tau: float) -> Array:
    """Return for each component a size that is added to |y_k|, so that shifts do not vanish with the component.

    The size is ``abs(tau * f[k])``, the motion in a step of length `tau`, and at least 1e-3 |y_k|. If both are
    0, it is the largest size of the other components, or 1 if all are 0.
    """
    floors = np.where(np.isfinite(f), np.abs(tau * f), 0.0)
    floors = np.maximum(floors, 1e-3 * np.abs(y))
    floors[floors == 0] = floors.max(initial=0.0) or 1.0
    return floors


def time_of_motion(y: Array, f: Array) -> float:
    """Return the time in which a state changes by its own size; infinite if the state or its derivative is 0."""
    moving, size = float(np.abs(f).max(initial=0.0)), float(np.abs(y).max(initial=0.0))
    return size / moving if moving > 0 and size > 0 else np.inf


@lru_cache
def random_directions(n: int, is_complex: bool) -> Array:
    """Return two random directions (2, n), the same in each run; they are cached, because making them takes long."""
    rng = np.random.default_rng(20220)
    parts = rng.standard_normal((2, 2 if is_complex else 1, n))
    return parts[:, 0] + 1j * parts[:, 1] if is_complex else parts[:, 0]
