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


class Sample(NamedTuple):
    """Values at m random points, one row for each point.

    `points` (m, n) are z = y / scale, and `slopes` (m, n) are dz/dt divided by the sum of its absolute values. `rates`
    (m, k) are the rates dI/dz . slopes of k functions I, one column for each: first the monomials of a basis, then the
    given functions (`terms` of `Surroundings`). `sizes` (m, k) are the sums of the absolute values of the products in
    the rates, ``dI/dz_i dz_i/dt``, where the derivative of a monomial is written as one product for each of its
    factors.
    """

    points: Array
    slopes: Array
    rates: Array
    sizes: Array


class Surroundings:
    """The region around a state in which invariants are searched, and random points in it.

    `terms` are the given functions, each a `Term`: invariants are searched among sums of multiples of monomials of the
    state and of these functions. `scale` (n,) holds the sizes of the components of the state, `tau` is a time in which
    the state moves by its own size, and `trajectory` (m, n) holds states on the trajectory that starts at y0.
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
        here, self.scale, self.tau = self.y0, np.abs(self.y0), 0.0
        for _ in range(3):  # a component may start to move only where others have moved
            f = np.abs(self._slope(self.t, here))
            f[~np.isfinite(f)] = 0.0
            if f.any():  # a start near a fixed point is slow, and its surroundings are not
                tau = float(np.max(self.scale, initial=0.0) or 1.0) / float(np.max(f))
                self.tau = min(self.tau or tau, tau)
            self.scale = np.maximum(self.scale, self.tau * f)
            here = self.y0 + 0.1 * self.scale * self.rng.standard_normal(self.y0.size)
        self.scale[self.scale == 0.0] = np.max(self.scale) or 1.0

    def sample(self, wanted: int, basis: Sequence[Monomial]) -> Sample:
        """Return `wanted` random points, with the rates of monomials and of the given functions (`terms`) there.

        `basis` lists the monomials.

        Raises
        ------
        ValueError
            If the vector field, or the gradient of a given function, is finite at too few points.
        """
        for spread in SPREADS:
            points, slopes, gradients = [], [], []
            for k in range(4 * wanted):
                y = self.y0 + spread * self.scale * self.rng.standard_normal(self.y0.size)
                # A quantity that depends on time must be conserved at all times.
                t = self.t + self.tau * self.rng.random() * (k % 2)
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

    def _follow(self) -> Array:
        """Return states (m, n) on the trajectory from y0: those of at most 200 steps, within the time 3 `tau`."""
        solver = DOP853(self._slope, self.t, self.y0, self.t + 3 * self.tau, rtol=1e-12, atol=1e-16 * self.scale)
        states = [self.y0]
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
