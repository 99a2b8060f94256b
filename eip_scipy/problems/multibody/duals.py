"""Derivatives of the motion of a constrained system with dual numbers; imported only for compiled functions."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from ...core.dual_arrays import inside
from ...core.dual_numbers import put_slope, seed, slope, value_of
from ...core.functions import compilable, jitted
from .differentiated import difference
from .motion import changed, solve

__all__ = ["fill_duals", "solve_duals"]

_solve, _changed, _difference = inside(solve), inside(changed), jitted(compilable(difference))


def _parts_of(numbers, lane, values, slopes):
    """Fill `values` and `slopes` with the values of dual numbers and their derivatives in one lane."""
    for k in range(numbers.size):
        values[k], slopes[k] = value_of(numbers[k]), slope(numbers[k], lane)


def _put(dual, values, slopes, lane, out):
    """Write values to the dual numbers `out` if `lane` is 0, and derivatives in this lane."""
    for k in range(out.size):
        out[k] = put_slope(seed(dual, values[k], -1) if lane == 0 else out[k], lane, slopes[k])


_parts_of, _put = inside(_parts_of), inside(_put)


@cache
def solve_duals(dual: Any) -> Callable[..., int]:
    """Return the function `solve` of `motion` for arrays of numbers of the type `dual`.

    The library's solver takes addresses of floats: it solves for the values, and then for each direction.
    """
    lanes = dual.lanes

    def solved(matrices, n, m, tolerance, accelerations, multipliers):
        values, changes = np.empty(matrices.size), np.empty(matrices.size)
        solution, found, rank = (np.empty(n), np.empty(m)), (np.empty(n), np.empty(m)), 0
        for lane in range(lanes):
            _parts_of(matrices, lane, values, changes)
            if lane == 0:
                rank = _solve(values, n, m, tolerance, solution[0], solution[1])
            _changed(values, changes, n, m, tolerance, solution, found)
            _put(dual, solution[0], found[0], lane, accelerations)
            _put(dual, solution[1], found[1], lane, multipliers)
        return rank

    return inside(solved)


@cache
def fill_duals(fill: Any, dual: Any) -> Callable[..., None]:
    """Return ``fill(t, y, out)`` for arrays of numbers of the type `dual`; its derivatives are differences."""
    lanes = dual.lanes

    def filled(t, y, out):
        values, way, found, changes = np.empty(y.size), np.empty(y.size), np.empty(out.size), np.empty(out.size)
        for lane in range(lanes):
            _parts_of(y, lane, values, way)
            if lane == 0:
                fill(t, values, found)
            _difference(fill, t, values, 0.0, way, np.inf, changes)
            _put(dual, found, changes, lane, out)

    return inside(filled)
