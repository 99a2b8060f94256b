"""Linear invariants of a system, found from values of its right-hand side: constraints that corrections keep."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from .gradients import time_of_motion, unless_error

__all__ = [
    "FoundInvariants", "LinearInvariants", "Samples", "confirmed", "found_invariants", "independent_of", "reduced_rows",
]  # fmt: skip

# Largest state whose linear invariants are searched for: the time grows with the cube of the number of components.
MOST_COMPONENTS = 300
# Points near the start beyond the number of components; points far from it; points at which gradients are examined.
MORE, FAR, MOST_GRADIENTS = 5, 5, 12
# Distances of the points from the start, in units of the components' sizes.
NEAR_DISTANCE, FAR_DISTANCE = 1e-2, 0.5
# Singular values below NULL times the largest are zero. The search finds nothing if one is between NULL and CLEAR.
NULL, CLEAR = 1e-12, 1e-10
# Bounds of the residuals of rates of the form d y, where d y is an invariant, as for the centre of mass.
NULL_RATE, CLEAR_RATE = 1e-9, 1e-6
# Coefficients below this share of the largest one are 0; pivots are larger than LEAST_PIVOT. Others are rounded to BITS
# bits, so that they do not depend on the points. A rate may differ from 0 by HOLDS times the sum of its terms.
NEGLIGIBLE, LEAST_PIVOT, BITS, HOLDS = 1e-9, 1e-4, 32, 1e-8
# A gradient is a combination of the rows of C if its remainder is below SPANNED times the gradient.
SPANNED = 1e-7

Array = np.ndarray
Derivative = Callable[[float, Array], Array]


class LinearInvariants(NamedTuple):
    """Quantities C y, with C of shape (k, n), and their rates A C y, with A of shape (k, k)."""

    C: Array
    A: Array


class FoundInvariants(NamedTuple):
    """Linear invariants that are `kept`, the number of those that were `found`, and the number of `calls` of f."""

    kept: LinearInvariants
    found: int
    calls: int

    @property
    def C(self) -> Array:  # noqa: N802
        """Return the matrix (k, n) of those that are kept."""
        return self.kept.C

    def __str__(self) -> str:
        kept = len(self.C)
        rest = "" if kept == self.found else "; the given invariants determine the others"
        return f"linear invariants: {self.found} found by {self.calls} evaluations (not in nfev), {kept} kept{rest}"


class Samples:
    """States around a start and their derivatives. The states are the same in each run that starts there.

    `t` (m,), `y` (m, n) and `f` (m, n) hold the points near the start, at its time, and after `add_far` also points at
    other times up to `t_bound` and at larger distances, as far as their derivatives are finite.
    """

    def __init__(self, rhs: Derivative, t0: float, y0: Array, f0: Array, tau: float, count: int) -> None:
        self._rhs, self._t0, self._y0, self.calls = rhs, t0, y0, 0
        sizes = np.abs(y0) + min(tau, time_of_motion(y0, f0)) * np.abs(f0)
        half = y0.size // 2
        if not sizes.all():
            parts = [slice(half), slice(half, None)] if np.array_equal(f0[:half], y0[half:]) else [slice(None)]
            for part in parts:
                sizes[part][sizes[part] == 0] = sizes[part].max(initial=0.0) or 1.0
        ways = _directions(count + MORE + FAR, y0.size)
        # A component that is 0 at the start may have to stay nonnegative, as a concentration.
        self.sizes, self._ways = sizes, ways if y0.all() else np.where(y0 == 0, np.abs(ways), ways)
        self.t, self.y, self.f = self._at(np.full(count, t0), NEAR_DISTANCE * self._ways[:count])

    def _at(self, times: Array, distances: Array) -> tuple[Array, Array, Array]:
        """Return times, states at these distances, and derivatives, which are NaN where the function fails."""
        states = self._y0 + distances * self.sizes
        self.calls += len(states)
        f = np.full(states.shape, np.nan)
        for k, t in enumerate(times.tolist()):
            found = unless_error(self._rhs, t, states[k])
            if found is not None:
                f[k] = found
        return times, states, f

    def add_near(self) -> None:
        """Add further points near the start."""
        self._add(*self._at(np.full(MORE, self._t0), NEAR_DISTANCE * self._ways[-MORE - FAR : -FAR]))

    def add_far(self, t_bound: float) -> None:
        """Add the points far from the start at which the derivative is finite."""
        end = t_bound if np.isfinite(t_bound) else self._t0
        times = self._t0 + (end - self._t0) * np.linspace(0, 1, FAR)
        points = self._at(times, FAR_DISTANCE * np.tanh(self._ways[-FAR:]))
        good = np.isfinite(points[2]).all(axis=1)
        self._add(*(values[good] for values in points))

    def _add(self, t: Array, y: Array, f: Array) -> None:
        self.t, self.y, self.f = (np.concatenate(pair) for pair in ((self.t, t), (self.y, y), (self.f, f)))


@lru_cache(maxsize=8)
def _directions(count: int, n: int) -> Array:
    return np.random.default_rng(20220).standard_normal((count, n))


def found_invariants(samples: Samples, t_bound: float) -> LinearInvariants:
    """Return the linear invariants c y, c f = 0, and the quantities whose rates are such invariants."""
    n = samples.y.shape[1]
    none = LinearInvariants(np.zeros((0, n)), np.zeros((0, 0)))
    if not np.isfinite(samples.f).all():
        return none
    s = np.linalg.svd(_scaled(samples.f)[0], compute_uv=False)
    if s[-1] > NULL * s[0]:  # n points show that there are none
        return none
    samples.add_near()
    if not np.isfinite(samples.f).all():
        return none
    F, units = _scaled(samples.f)
    U, s, V = np.linalg.svd(F, full_matrices=False)
    rank = _rank(s)
    if rank == n:
        return none
    # Columns of F have the units of their components, and rows those of the largest rate at their point.
    momenta = _sparse(V[rank:]) / units
    momenta = _rounded(momenta / np.abs(momenta).max(axis=1, keepdims=True))
    scale = np.max(np.abs(samples.f), axis=1, keepdims=True)
    D = samples.y @ momenta.T / np.where(scale > 0, scale, 1.0)
    sizes = np.linalg.norm(D, axis=0)
    left = np.linalg.norm(D - U[:, :rank] @ (U[:, :rank].T @ D), axis=0)
    paired = left <= NULL_RATE * sizes
    if not (paired | (left >= CLEAR_RATE * sizes)).all():
        paired[:] = False
    rates = (V[:rank].T / s[:rank]) @ (U[:, :rank].T @ D[:, paired])
    rates[np.abs(rates) < NEGLIGIBLE * np.abs(rates).max(axis=0, initial=0.0)] = 0.0
    k, m = len(momenta), int(paired.sum())
    A = np.zeros((k + m, k + m))
    A[:m, m:][:, paired] = np.eye(m)
    samples.add_far(t_bound)
    return confirmed(samples.y, samples.f, LinearInvariants(np.concatenate([_rounded(rates.T / units), momenta]), A))


def _scaled(f: Array) -> tuple[Array, Array]:
    """Return derivatives f (m, n) with largest entries of 1 in rows and columns, and the scales of the columns (n,)."""
    size = np.abs(f).max(axis=1, keepdims=True)
    F = f / np.where(size > 0, size, 1.0)
    units = np.abs(F).max(axis=0)
    units[units == 0] = 1.0
    return F / units, units


def _rank(s: Array) -> int:
    """Return the rank of a matrix with the singular values s; their number if the rank is not clear."""
    rank = int(np.count_nonzero(s > NULL * s[0]))
    return len(s) if rank and s[rank - 1] < CLEAR * s[0] else rank


def confirmed(y: Array, f: Array, given: LinearInvariants) -> LinearInvariants:
    """Return the rows of `given` whose rates agree with the derivatives f (m, n) at the states y, and are kept too."""
    C, A = given
    expected, found = y @ C.T @ A.T, f @ C.T
    terms = np.abs(f) @ np.abs(C).T + np.abs(y) @ np.abs(C).T @ np.abs(A).T
    kept = (np.abs(found - expected) <= HOLDS * terms).all(axis=0)
    kept &= ~(A[:, ~kept] != 0).any(axis=1)
    return LinearInvariants(C[kept], A[np.ix_(kept, kept)])


def independent_of(given: LinearInvariants, gradients: Array, sizes: Array) -> LinearInvariants:
    """Return the rows, combinations of those of C (k, n), that leave room for the corrections of all invariants.

    `gradients` (m, l, n) are those of the invariants at m points, and `sizes` (n,) those of the components. Where a
    combination of the gradients is a combination of the rows, no correction could change that combination of the
    invariants, and these rows are left out, such as those of a momentum that is an invariant. So are the rows whose
    rates are among them.
    """
    C, A = given
    Q, R = np.linalg.qr((C * sizes).T)
    G = gradients * sizes
    G /= np.maximum(np.linalg.norm(G, axis=2, keepdims=True), np.finfo(float).tiny)
    inside = G @ Q
    U, s, _ = np.linalg.svd(G - inside @ Q.T, full_matrices=False)
    rows = (np.swapaxes(U, 1, 2) @ inside)[s < SPANNED]
    rows = rows[np.linalg.norm(rows, axis=1) > SPANNED]
    if not len(rows):
        return given
    if len(rows) > 1 and np.linalg.matrix_rank(rows, SPANNED) == len(rows):  # further points may span further rows
        return LinearInvariants(C[:0], A[:0, :0])
    rows = np.concatenate([rows, np.linalg.solve(R, rows.T).T @ A.T @ R.T])
    _, s, V = np.linalg.svd(rows)
    rest = V[int(np.count_nonzero(s > SPANNED * s[0])) :] @ Q.T
    if not len(rest):
        return LinearInvariants(C[:0], A[:0, :0])
    rows = _sparse(rest) / sizes
    rows = _rounded(rows / np.abs(rows).max(axis=1, keepdims=True))
    # The rates of the new rows are combinations of these rows, because the rows whose rates are not kept are left out.
    rates = np.linalg.lstsq((C * sizes).T, (rows * sizes).T)[0].T @ A @ C
    return LinearInvariants(rows, np.linalg.lstsq((rows * sizes).T, (rates * sizes).T)[0].T)


def reduced_rows(rows: Array, least: float) -> Array:
    """Return the reduced row echelon form of independent rows; pivots are larger than `least`."""
    rows, done = rows.copy(), 0
    for column in range(rows.shape[1]):
        if done == len(rows):
            break
        pivot = done + int(np.argmax(np.abs(rows[done:, column])))
        if abs(rows[pivot, column]) < least:
            continue
        rows[[done, pivot]] = rows[[pivot, done]]
        rows[done] /= rows[done, column]
        others = np.arange(len(rows)) != done
        rows[others] -= np.outer(rows[others, column], rows[done])
        done += 1
    return rows


def _sparse(rows: Array) -> Array:
    """Return rows with the same span that have few nonzero entries, as one for each axis of a momentum."""
    rows = reduced_rows(rows, LEAST_PIVOT)
    rows[np.abs(rows) < NEGLIGIBLE * np.abs(rows).max(axis=1, keepdims=True)] = 0.0
    return rows


def _rounded(rows: Array) -> Array:
    mantissa, exponent = np.frexp(rows)
    return np.ldexp(np.round(np.ldexp(mantissa, BITS)), exponent - BITS)
