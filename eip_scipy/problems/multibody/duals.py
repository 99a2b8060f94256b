"""Derivatives of the motion of a constrained system with dual numbers; imported only for compiled functions."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from ...numba_duals import inside, put_slope, seed, slope, value_of
from .motion import changed, solve

__all__ = ["by_differences", "solve_duals"]

_solve, _changed = inside(solve), inside(changed)


@cache
def solve_duals(dual: Any) -> Callable[..., int]:
    """Return the function `solve` of `motion` for arrays of numbers of the type `dual`.

    The library's solver takes addresses of floats: it solves for the values, and then for each direction.
    """
    lanes = dual.lanes

    def solved(matrices, n, m, tolerance, accelerations, multipliers):
        values, changes = np.empty(matrices.size), np.empty(matrices.size)
        for k in range(matrices.size):
            values[k] = value_of(matrices[k])
        solution, found = (np.empty(n), np.empty(m)), (np.empty(n), np.empty(m))
        rank = _solve(values, n, m, tolerance, solution[0], solution[1])
        for i in range(n):
            accelerations[i] = seed(dual, solution[0][i], -1)
        for k in range(m):
            multipliers[k] = seed(dual, solution[1][k], -1)
        for lane in range(lanes):
            for k in range(matrices.size):
                changes[k] = slope(matrices[k], lane)
            _changed(values, changes, n, m, tolerance, solution, found)
            for i in range(n):
                accelerations[i] = put_slope(accelerations[i], lane, found[0][i])
            for k in range(m):
                multipliers[k] = put_slope(multipliers[k], lane, found[1][k])
        return rank

    return inside(solved)


@cache
def by_differences(fill: Any, difference: Any, dual: Any) -> Callable[..., None]:
    """Return ``fill(t, y, out)`` for arrays of numbers of the type `dual`.

    ``difference(t, y, y, dt, dy, unit, out)`` fills `out` with the derivative of `fill` along a direction.
    """
    lanes = dual.lanes

    def filled(t, y, out):
        values, way, found = np.empty(y.size), np.empty(y.size), np.empty(out.size)
        for i in range(y.size):
            values[i] = value_of(y[i])
        fill(t, values, found)
        for i in range(out.size):
            out[i] = seed(dual, found[i], -1)
        for lane in range(lanes):
            size, moving = 0.0, 0.0
            for i in range(y.size):
                way[i] = slope(y[i], lane)
                size, moving = max(size, abs(values[i])), max(moving, abs(way[i]))
            if moving == 0.0:
                continue
            difference(t, values, values, 0.0, way, (size if size > 0.0 else 1.0) / moving, found)
            for i in range(out.size):
                out[i] = put_slope(out[i], lane, found[i])

    return inside(filled)
