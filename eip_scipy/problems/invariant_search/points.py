"""A vector field at random points around a state, and the rates of monomials and further functions there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import DOP853

from .polynomials import Monomial, Term

__all__ = ["Sample", "Surroundings"]

Array = np.ndarray

SPREADS = (1.0, 0.3, 0.1, 0.03, 0.01)  # of the points, in units of the components' sizes
STEPS = 200
# Largest time of the points in units of `tau`: what drives a system may be much slower than its motion.
LATEST = 1000.0
# A trajectory that moves by less than this part of the components' sizes tests nothing.
AT_REST = 1e-3
# Times after `t`, in any unit, at which a system is looked at that does not move at `t` from any state.
LATER = 10.0 ** np.arange(-9, 19)


class Sample(NamedTuple):
    """Values at m random points, one row for each point.

    `points` are z = y / scale, and `slopes` are dz/dt divided by the sum of its absolute values. `rates` (m, k) are the
    rates dI/dz . slopes of k functions I: the monomials of a basis, then the given functions. `sizes` (m, k) are the
    sums of the absolute values of the products in the rates, with one product for each factor of a monomial.
    """

    points: Array
    slopes: Array
    rates: Array
    sizes: Array


class Surroundings:
    """The region around a state in which invariants are searched, and random points in it.

    `terms` are the given functions. `scale` (n,) holds the sizes of the components of the state, `tau` is a time in
    which the state moves by its own size, and `trajectory` (m, n) holds states on the trajectory from y0, or from
    nearby if that from y0 tests nothing. A ValueError is raised if the vector field is not finite at y0.
    """

    def __init__(self, fun: Callable[..., Any], y0: Array, terms: Sequence[Term], t: float, seed: int) -> None:
        self.fun, self.y0, self.terms, self.t = fun, y0, terms, t
        self.rng = np.random.default_rng(seed)
        self.failure: Exception | None = None
        self._look_around()
        self.trajectory = self._follow()

    def _slope(self, t: float, y: Array) -> Array:
        """Return the derivative f(t, y), shape (n,); all NaN if `fun` raises an ArithmeticError or ValueError."""
        try:
            found = np.asarray(self.fun(t, y.copy()), dtype=float)
        except (ArithmeticError, ValueError) as error:
            self.failure = self.failure or error
            return np.full_like(y, np.nan)
        if found.shape != y.shape:
            raise ValueError(f"find_invariants: fun returned shape {found.shape} for a state of shape {y.shape}.")
        return found

    def term_gradients(self, y: Array) -> Array:
        """Return the gradients (k, n) of the given functions (`terms`); all NaN if one of them cannot be computed."""
        try:
            return np.array([item.grad(y.copy()) for item in self.terms], dtype=float).reshape(-1, y.size)
        except (ArithmeticError, ValueError) as error:
            self.failure = self.failure or error
            return np.full((len(self.terms), y.size), np.nan)

    def term_values(self, y: Array) -> Array:
        """Return the values (k,) of the given functions (`terms`); all NaN if one of them cannot be computed."""
        try:
            return np.array([item.fun(y.copy()) for item in self.terms], dtype=float)
        except (ArithmeticError, ValueError):
            return np.full(len(self.terms), np.nan)

    def _look_around(self) -> None:
        """Set `scale`, the sizes of the components, and `tau`, a time in which the state moves by its own size."""
        first = self._slope(self.t, self.y0)
        if not np.isfinite(first).all():
            found = f"is {first}" if self.failure is None else f"raised {type(self.failure).__name__}"
            raise ValueError(
                f"find_invariants: fun(t, y0) {found}, expected finite numbers. Choose another y0 or t."
            ) from self.failure
        here, self.scale, self.tau = self.y0, np.abs(self.y0), 0.0
        for _ in range(3):  # a component may start to move only where others have moved
            f = self._speeds(self.t, here)
            if f.any():  # a start near a fixed point is slow, and its surroundings are not
                tau = float(np.max(self.scale, initial=0.0) or 1.0) / float(np.max(f))
                self.tau = min(self.tau or tau, tau)
            self.scale = np.maximum(self.scale, self.tau * f)
            here = self.y0 + 0.1 * self.scale * self.rng.standard_normal(self.y0.size)
        self.scale[self.scale == 0.0] = np.max(self.scale) or 1.0
        if self.tau == 0.0:
            self.tau = self._time_of_a_start_at_rest()

    def _speeds(self, t: float, y: Array) -> Array:
        """Return the absolute values of the derivative (n,), with 0 for those that are not finite."""
        f = np.abs(self._slope(t, y))
        f[~np.isfinite(f)] = 0.0
        return f

    def _time_of_a_start_at_rest(self) -> float:
        """Return a time in which displaced states around y0 move by their size, at `t` or later; 0 if nothing moves."""
        if speed := self._speed_around(self.t):
            return 1.0 / speed
        tau = 0.0
        for later in LATER.tolist():
            if speed := self._speed_around(self.t + later):
                tau = later
            if later * speed >= 1.0:
                break
        return tau

    def _speed_around(self, t: float) -> float:
        y = self._near(t)
        return float(np.max(self._speeds(t, y) / self.scale))

    def _near(self, t: float) -> Array:
        """Return a random state near y0 at which all functions are finite at `t`; y0 if none is found."""
        for spread in SPREADS:
            y = self.y0 + spread * self.scale * self.rng.standard_normal(self.y0.size)
            if self._is_defined(t, y):
                return y
        return self.y0

    def _is_defined(self, t: float, y: Array) -> bool:
        return bool(np.isfinite(self._slope(t, y)).all() and np.isfinite(self.term_gradients(y)).all())

    def sample(self, wanted: int, basis: Sequence[Monomial]) -> Sample:
        """Return `wanted` random points, with the rates of the monomials `basis` and of the given functions there.

        A ValueError is raised if the vector field, or the gradient of a given function, is finite at too few points.
        """
        for spread in SPREADS:
            points, slopes, gradients = [], [], []
            for k in range(4 * wanted):
                y = self.y0 + spread * self.scale * self.rng.standard_normal(self.y0.size)
                t = self.t + self.tau * self._later(k)
                f, g = self._slope(t, y), self.term_gradients(y)
                if np.isfinite(f).all() and np.isfinite(g).all():
                    points.append(y / self.scale)
                    slopes.append(f / self.scale)
                    gradients.append(g * self.scale)
                if len(points) == wanted:
                    return _rates(np.array(points), np.array(slopes), np.array(gradients), basis)
        raise ValueError(
            f"find_invariants: fun or a term is finite at fewer than 25 % of the random points around y0, even at "
            f"distances of {SPREADS[-1]} times the sizes of the components. Choose another y0 or t."
        ) from self.failure

    def _later(self, k: int) -> float:
        """Return the time of point k after `t`, in units of `tau`: 0, a number below 1, or one up to `LATEST`.

        Half of the points are at `t`, because `fun` may be undefined later.
        """
        part = float(self.rng.random())
        return part if k % 4 == 1 else LATEST**part if k % 4 == 3 else 0.0

    def _follow(self) -> Array:
        """Return states (m, n) on a trajectory from y0, or from nearby if that from y0 would test nothing."""
        if self._is_defined(self.t, self.y0):
            states = self._states_from(self.y0)
            if np.any(np.abs(states - self.y0) > AT_REST * self.scale):
                return states
        return self._states_from(self._near(self.t))

    def _states_from(self, start: Array) -> Array:
        """Return the states (m, n) of at most 200 steps from `start`, within the time 3 `tau`."""
        solver = DOP853(self._slope, self.t, start, self.t + 3 * self.tau, rtol=1e-12, atol=1e-16 * self.scale)
        states = [start]
        while solver.status == "running" and len(states) <= STEPS:
            solver.step()
            if solver.status != "failed":
                states.append(solver.y.copy())
        return np.array(states)


def _rates(points: Array, slopes: Array, gradients: Array, basis: Sequence[Monomial]) -> Sample:
    speed = np.abs(slopes).sum(axis=1, keepdims=True)
    slopes = slopes / np.where(speed == 0, 1.0, speed)
    m, column = len(points), {item: k for k, item in enumerate(basis)}
    values, rates, sizes = [np.empty((m, len(basis))) for _ in range(3)]
    for k, (*rest, last) in enumerate(basis):
        z, f = points[:, last], slopes[:, last]
        if not rest:
            values[:, k], rates[:, k], sizes[:, k] = z, f, np.abs(f)
            continue
        j = column[tuple(rest)]
        values[:, k] = z * values[:, j]
        rates[:, k] = f * values[:, j] + z * rates[:, j]
        sizes[:, k] = np.abs(f * values[:, j]) + np.abs(z) * sizes[:, j]
    products = gradients * slopes[:, None, :]
    rates = np.hstack([rates, products.sum(axis=2)])
    sizes = np.hstack([sizes, np.abs(products).sum(axis=2)])
    return Sample(points, slopes, rates, sizes)
