"""Quantities that a system keeps only where others hold, as constraints and energies of constrained systems are."""

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
# Gradients of rates take 2 n evaluations of all gradients: components up to which that is worth it.
MOST_COMPONENTS = 64
SHIFT = 1e-6
# A surface counts as near within such a part of the components' sizes; Newton's method must find it at once; a rate
# counts as 0 below such a part of its terms.
NEAR, CONVERGED, VANISHES = 0.05, 1e-2, 1e-2


def on_targets(known: InvariantSet, t: float, y: Array, span: Array, rhs: Derivative) -> Array | None:
    """Return the state nearest to y, in units of `span`, on which all invariants have their targets.

    None where y is there already, or where no such state is found.
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


def is_kept_on_a_surface(known: InvariantSet, k: int, t: float, y: Array, span: Array, rhs: Derivative) -> bool:
    """Return whether the rate of invariant k vanishes on a surface near y that the flow does not leave.

    The rate of a length is the velocity along it, and a system with that constraint keeps both together: the rate is 0
    near y, and there its own rate is 0. Friction, a driving force or a wrong term do neither.
    """
    weights = np.repeat(span, y.view(float).size // span.size)
    moving = np.flatnonzero(weights > 0)
    if moving.size > MOST_COMPONENTS or not moving.size:
        return False

    def rate(floats: Array) -> float:
        state = floats.view(y.dtype)
        f = rhs(t, state)
        return float(known.gradients(t, state, f)[k].view(float) @ f.view(float))

    def slopes(floats: Array) -> Array:
        found = np.zeros(floats.size)
        for j in moving:
            ends = []
            for shift in (SHIFT, -SHIFT):
                moved = floats.copy()
                moved[j] += shift * weights[j]
                ends.append(rate(moved))
            found[j] = (ends[0] - ends[1]) / (2 * SHIFT)
        return found

    floats = np.ascontiguousarray(y).view(float).copy()
    first = rate(floats)
    slope = slopes(floats)
    square = float(slope @ slope)
    if not 0 < square < np.inf or abs(first) > NEAR * np.sqrt(square):
        return False
    floats -= weights * slope * (first / square)
    if not abs(rate(floats)) <= CONVERGED * abs(first):
        return False
    slope = slopes(floats)
    f = rhs(t, floats.view(y.dtype)).view(float)
    changes = slope[moving] / weights[moving] * f[moving]
    return bool(abs(changes.sum()) <= VANISHES * np.abs(changes).sum())
