"""Compiled gradients of jitted invariants without a gradient; imported only if there is such an invariant."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit, types
from numba.extending import overload

from .dual_arrays import for_duals, inside
from .dual_numbers import Dual, put_slope, seed, slope, stack_array
from .functions import NotCompilableError

__all__ = ["compiled_for", "dual_along", "gradient_by_duals", "new_state", "rate_by_duals"]

# Derivatives carried through a function at once, at most: more fill the registers.
LANES = 12
# Duals on the stack, at most.
STACK = 64
NUMBERS = {"d": types.float64, "q": types.int64, "?": types.boolean}
# How the line of Numba's errors begins that names what is missing.
SAYING = ("No implementation", "Cannot", "Unknown")


@lru_cache(maxsize=256)
def gradient_by_duals(fun: Any, n: int, shape: tuple[int, ...], has_params: bool, scalars: str = "") -> Any:
    """Return the gradient ``grad(t, y, out[, params])`` of a jitted invariant whose value has this `shape`.

    The gradient fills `out` (*shape, n), exact up to rounding. If `scalars` is not empty, it takes numbers of these
    types instead of params, ``grad(t, y, out, *numbers)``; see `scalars`. Raise NotCompilableError if dual numbers
    cannot do what `fun` does.
    """
    dual = dual_along(n)
    lanes = dual.lanes
    fun, make_state = for_duals(fun, dual), new_state(dual, n)

    def filled(t, y, out, args):
        x = make_state()
        for first in range(0, n, lanes):
            for i in range(n):
                x[i] = seed(dual, y[i], i - first)
            put_slopes(fun(t, x, *args), out, first, min(lanes, n - first))

    return compiled_for(filled, 1 + len(shape), has_params, scalars)


@lru_cache(maxsize=256)
def rate_by_duals(fun: Any, n: int, shape: tuple[int, ...], has_params: bool, scalars: str = "") -> Any:
    """Return the rate ``rate(t, y, f[, params])`` of a jitted balance, its derivative along (1, f) in (t, y).

    The arguments and the exception are those of `gradient_by_duals`.
    """
    dual = Dual(1)
    fun, make_state, slopes = for_duals(fun, dual), new_state(dual, n), inside(_slopes_of(shape))

    def along(t, y, f, args):
        x = make_state()
        for i in range(n):
            x[i] = put_slope(seed(dual, y[i], 1), 0, f[i])
        return slopes(fun(seed(dual, t, 0), x, *args))

    return compiled_for(along, 1, has_params, scalars)


def dual_along(directions: int) -> Dual:
    """Return the smallest dual type with which derivatives along `directions` directions need the fewest calls."""
    passes = -(-directions // LANES)
    return Dual(-(-directions // passes))


def new_state(dual: Any, n: int) -> Any:
    """Return a function that allocates an array of `n` duals, on the stack if n is at most `STACK`."""
    return inside((lambda: np.empty(n, dual)) if n > STACK else (lambda: stack_array(dual, n)), forceinline=True)


def _slopes_of(shape: tuple[int, ...]) -> Callable[..., Any]:
    """Return a function that returns the derivatives of a dual value of this shape along its first direction."""
    if shape == ():
        return lambda value: slope(value, 0)

    def slopes(values):
        out = np.empty(len(values))
        for j in range(out.size):
            out[j] = slope(values[j], 0)
        return out

    return slopes


def compiled_for(function: Callable[..., Any], ndim: int, has_params: bool, scalars: str) -> Any:
    """Compile ``function(t, y, a, args)`` as ``call(t, y, a, *args)``, for real y (n,) and a of `ndim` dimensions.

    `args` are the arguments that follow in a user's functions: params if `has_params`, or numbers of the types in
    `scalars`, see `scalars`.
    """
    function = inside(function)
    floats, third = (types.Array(types.float64, dimensions, "C") for dimensions in (1, ndim))
    args = [NUMBERS[scalar] for scalar in scalars] if scalars or not has_params else [floats]
    compiled = njit(lambda t, y, a, *args: function(t, y, a, args))
    try:
        compiled.compile((types.float64, floats, third, types.BaseTuple.from_types(args)))
    except Exception as error:  # Numba has no one class for what its parts raise on a type that they do not expect
        said = [line for line in str(error).splitlines() if line.startswith(SAYING)] or [type(error).__name__]
        raise NotCompilableError(f"it does not compile for dual numbers: {said[0].rstrip(':')}") from error
    return compiled


def put_slopes(value, out, first, count):
    """Write `count` slopes of the dual `value` to columns of `out` from `first` on; for compiled code only."""


@overload(put_slopes)
def _put_slopes(value, out, first, count):
    if out.ndim == 1:

        def put_number(value, out, first, count):
            for k in range(count):
                out[first + k] = slope(value, k)

        return put_number

    def put_numbers(value, out, first, count):
        for j in range(out.shape[0]):
            for k in range(count):
                out[j, first + k] = slope(value[j], k)

    return put_numbers
