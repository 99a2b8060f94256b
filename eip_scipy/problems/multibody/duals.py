"""Derivatives of the motion of a constrained system with dual numbers; imported only for compiled functions."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

from ...core.functions import compilable, jitted
from ...numba_duals import inside, put_slope, seed, slope, value_of
from .differentiated import difference, fill_changed
from .motion import changed, solve, solve_changed

__all__ = ["fill_duals", "solve_duals"]

_solve, _changed, _difference = inside(solve), inside(changed), jitted(compilable(difference))


@inside
def _parts_of(numbers, lane, values, slopes):
    for k in range(numbers.size):
        values[k], slopes[k] = value_of(numbers[k]), slope(numbers[k], lane)


@cache
def _put(dual: Any) -> Any:
    def put(values, slopes, lane, numbers):
        for k in range(numbers.size):
            numbers[k] = put_slope(seed(dual, values[k], -1) if lane == 0 else numbers[k], lane, slopes[k])

    return inside(put)


@cache
def solve_duals(dual: Any) -> Callable[..., int]:
    """Return the function `solve` of `motion`, which takes addresses of floats, for numbers of the type `dual`."""
    found: Callable[..., int] = inside(solve_changed(_solve, _changed, dual.lanes, _parts_of, _put(dual)))
    return found


@cache
def fill_duals(fill: Any, dual: Any) -> Callable[..., None]:
    """Return ``fill(t, y, out)`` for numbers of the type `dual`; its derivatives are differences."""
    found: Callable[..., None] = inside(fill_changed(fill, _difference, dual.lanes, _parts_of, _put(dual)))
    return found
