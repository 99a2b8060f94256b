"""Quantities that a system conserves only while constraints hold, such as the energy of a constrained system."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from ..engine.data import EPS

if TYPE_CHECKING:
    from .invariants import InvariantSet

__all__ = ["is_kept_on_a_surface", "on_targets"]

Array = np.ndarray
Derivative = Callable[[float, Array], Array]

NEWTON_STEPS, ROUNDINGS, RANK_TOLERANCE = 10, 8.0, 1e-8
# Slopes of a rate take 2 n evaluations of all gradients: components up to which that is worth it.
MOST_COMPONENTS = 64
SHIFT = 1e-6
# A surface counts as near within this part of the components' sizes. Newton's method must leave at most the second
# number of a rate after RATE_STEPS steps, and ends below the third.
NEAR, CONVERGED, FOUND, RATE_STEPS = 0.1, 1e-2, 1e-6, 5
# The flow keeps a rate at 0 if the rate of the rate is below this share of its terms, in units of the distance to the
# surface, or rounding of differences. Friction in place of a violated constraint makes the share as large as that
# distance: 1.1e-3 at a distance of 7e-4 for a pendulum in Cartesian coordinates, where a right one leaves 1e-9.
VANISHES, UNSEEN = 0.05, 1e-8


def on_targets(known: InvariantSet, t: float, y: Array, span: Array, rhs: Derivative) -> Array | None:
    """Move y by Newton's method towards the targets of all invariants; return None if y itself is the best state.

    The best state is the one whose largest residual, relative to the terms of the invariant concerned, is smallest.
    Each Newton step is the shortest one in units of `span`.
    """
    state, best, nearest = y, np.inf, None
    weights = np.repeat(span, state.view(float).size // span.size)
    for step in range(NEWTON_STEPS):
        G, values = known.gradients(t, state, rhs(t, state)), known.values(t, state)
        size = known.sizes_of_terms(state, G, values) + known.norm_products(G, state)
        residual = (values - known.target) / np.where(size > 0, size, 1.0)
        worst = np.abs(residual).max()
        if not worst < best:
            break
        best, nearest = worst, state
        if worst <= ROUNDINGS * EPS:
            return None if step == 0 else state
        rows = G.view(float) * weights / np.where(size > 0, size, 1.0)[:, None]
        lengths = np.linalg.norm(rows, axis=1)
        lengths[lengths == 0] = 1.0
        move = np.linalg.lstsq(rows / lengths[:, None], residual / lengths, rcond=RANK_TOLERANCE)[0]
        state = (state.view(float) - weights * move).view(y.dtype)
    return None if nearest is y else nearest


def is_kept_on_a_surface(
    known: InvariantSet, k: int, held: Array, t: float, y: Array, f: Array, rhs: Derivative
) -> bool:
    """Return True if the rate of invariant k vanishes on a surface near y that the flow does not leave.

    For example, the rate of change of a length is the velocity along it, and a system that constrains the length keeps
    it while that velocity is 0. Near y there are states where this rate is 0, and there the flow does not change the
    rate. If the invariant changes because of friction, a driving force or a wrong term, there is no such surface. The
    function also returns False, without a search, if more than `MOST_COMPONENTS` floats of the state are nonzero or
    change.

    `held` (l,) is a mask of the invariants that the system keeps. The first search is limited to states where, to first
    order, these invariants have the same values as at y. Without this limit a nearby state that violates a constraint a
    little could be found, at which the violation cancels the effect of friction, and the result would be wrong. If this
    search finds no surface, all states are searched. A state then counts only if one of these invariants is not 0 at y
    and is smaller there by the factor `CONVERGED`, which shows that y violates a constraint.
    """
    size, moved_by = np.abs(y).max(), np.abs(f).max()
    # How far the components move while the state moves by its own size: more than in a step.
    span = np.abs(y) + (size / moved_by if moved_by > 0 else 0.0) * np.abs(f)
    rate = _Rate(known, k, t, y, span, rhs)
    if not 0 < np.count_nonzero(rate.weights) <= MOST_COMPONENTS:
        return False
    G = known.gradients(t, y, f)[held]
    if rate.is_kept_at(rate.root(G)):
        return True
    if not held.any():
        return False
    found = rate.root(G[:0])
    if found is None:
        return False
    before, after = np.abs(known.values(t, y))[held], np.abs(known.values(t, found.view(y.dtype)))[held]
    return bool((after <= CONVERGED * before)[before > 0].any()) and rate.is_kept_at(found)


class _Rate:
    """Rate of change of invariant k as a function of the m floats of a state, which move in units of `weights` (m,).

    The floats start at those of y. The weights are the entries of `span`, twice each for complex states.
    """

    def __init__(self, known: InvariantSet, k: int, t: float, y: Array, span: Array, rhs: Derivative) -> None:
        self._known, self._k, self._t, self._rhs, self._dtype = known, k, t, rhs, y.dtype
        self.floats = np.ascontiguousarray(y).view(float).copy()
        self.weights = np.repeat(span, self.floats.size // span.size)

    def __call__(self, floats: Array) -> float:
        state = floats.view(self._dtype)
        f = self._rhs(self._t, state)
        return float(self._known.gradients(self._t, state, f)[self._k].view(float) @ f.view(float))

    def slopes(self, floats: Array) -> Array:
        """Return the derivatives (m,) of the rate by the floats, times their weights, from central differences."""
        found = np.zeros(floats.size)
        for j in np.flatnonzero(self.weights):
            ends = []
            for shift in (SHIFT, -SHIFT):
                moved = floats.copy()
                moved[j] += shift * self.weights[j]
                ends.append(self(moved))
            found[j] = (ends[0] - ends[1]) / (2 * SHIFT)
        return found

    def root(self, G: Array) -> Array | None:
        """Return the floats of a nearby state where the rate vanishes, along directions with G unchanged, or None."""
        floats, first = self.floats, self(self.floats)
        value = first
        for _ in range(RATE_STEPS):
            move = self._newton_step(self.slopes(floats), value, G)
            if move is None:
                return None
            floats = floats + self.weights * move
            if self._distance(floats) > NEAR:
                return None
            value = self(floats)
            if abs(value) <= FOUND * abs(first):
                break
        return floats if abs(value) <= CONVERGED * abs(first) else None

    def is_kept_at(self, floats: Array | None) -> bool:
        """Return True if the flow does not change the rate at the state `floats`; False if `floats` is None."""
        if floats is None:
            return False
        moving = self.weights > 0
        f = self._rhs(self._t, floats.view(self._dtype)).view(float)
        changes = self.slopes(floats)[moving] / self.weights[moving] * f[moving]
        share = max(VANISHES * self._distance(floats), UNSEEN)
        return bool(abs(changes.sum()) <= share * np.abs(changes).sum())

    def _newton_step(self, slope: Array, value: float, G: Array) -> Array | None:
        """Return the shortest move (m,), with G unchanged, that makes ``value + slope @ move`` 0, or None."""
        rows = np.vstack([slope, G.view(float) * self.weights])
        lengths = np.linalg.norm(rows, axis=1)
        if not (0 < lengths[0] < np.inf and np.isfinite(lengths).all()):
            return None
        lengths[lengths == 0] = 1.0
        wanted = np.zeros(len(rows))
        wanted[0] = -value / lengths[0]
        rows /= lengths[:, None]
        move = np.linalg.lstsq(rows, wanted, rcond=RANK_TOLERANCE)[0]
        return move if np.abs(rows @ move - wanted).max() <= CONVERGED * abs(wanted[0]) else None

    def _distance(self, floats: Array) -> float:
        moving = self.weights > 0
        return float((np.abs(floats - self.floats)[moving] / self.weights[moving]).max())
