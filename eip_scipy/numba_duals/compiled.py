"""Compiled derivatives of jitted functions ``fun(t, y, ...)``: gradients, rates, and products with vectors."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit, types
from numba.extending import overload

from .arrays import for_duals, inside
from .numbers import Dual, put_slope, seed, slope, stack_array, value_of

__all__ = ["NotDifferentiableError", "gradient", "parameter_gradient", "pushforward", "rate"]

# Derivatives carried through a function at once, at most: more fill the registers.
LANES = 12
# Duals on the stack, at most.
STACK = 64
NUMBERS = {"d": types.float64, "q": types.int64, "?": types.boolean}
# How the line of Numba's errors begins that names what is missing.
SAYING = ("No implementation", "Cannot", "Unknown", "astype", "dual")


class NotDifferentiableError(TypeError):
    """Exception for a function that dual numbers cannot compute; its text is a clause that says why."""


@lru_cache(maxsize=256)
def gradient(fun: Any, n: int, shape: tuple[int, ...], has_params: bool, scalars: str = "") -> Any:
    """Return the gradient ``grad(t, y, out[, params])`` of a jitted invariant whose value has this `shape`.

    The gradient fills `out` (*shape, n), exact up to rounding. If `scalars` is not empty, it takes numbers of these
    types instead of params, ``grad(t, y, out, *numbers)``; see `scalars`. Raise NotDifferentiableError if dual numbers
    cannot do what `fun` does.
    """
    dual = _dual_along(n)
    lanes = dual.lanes
    fun, make_state = for_duals(fun, dual), _new_state(dual, n)

    def filled(t, y, out, args):
        x = make_state()
        for first in range(0, n, lanes):
            for i in range(n):
                x[i] = seed(dual, y[i], i - first)
            put_slopes(fun(t, x, *args), out, first, min(lanes, n - first))

    return _compiled(filled, 1 + len(shape), has_params, scalars)


@lru_cache(maxsize=256)
def rate(fun: Any, n: int, shape: tuple[int, ...], has_params: bool, scalars: str = "") -> Any:
    """Return the rate ``rate(t, y, f[, params])`` of a jitted balance, its derivative along (1, f) in (t, y).

    The arguments and the exception are those of `gradient`.
    """
    dual = Dual(1)
    fun, make_state, slopes = for_duals(fun, dual), _new_state(dual, n), inside(_slopes_of(shape))

    def along(t, y, f, args):
        x = make_state()
        for i in range(n):
            x[i] = put_slope(seed(dual, y[i], 1), 0, f[i])
        return slopes(fun(seed(dual, t, 0), x, *args))

    return _compiled(along, 1, has_params, scalars)


@lru_cache(maxsize=64)
def pushforward(
    fun: Any, form: str, n: int, parameters: tuple[int, ...], count: int, has_params: bool, scalars: str
) -> Any:
    """Return ``rhs(t, Y, out, ...)``, the in-place right-hand side of an augmented state, for a jitted `fun`.

    Y consists of the state (n,), the parameters with the indices `parameters`, which are constants, and `count` tangent
    vectors of n + len(parameters) numbers, one after the other. The derivatives of `fun` are exact up to rounding.
    `form` is "value", "in place", "acceleration" or "acceleration in place". If `scalars` is not empty, `fun` takes
    numbers of these types instead of params, see `scalars`. Raise NotDifferentiableError if dual numbers cannot do what
    `fun` does.
    """
    dual, places = _dual_along(count), np.array(parameters, np.int64)
    lanes, size = dual.lanes, n + len(parameters)
    taken = n // 2 if form.startswith("acceleration") else n
    offset, in_place, by_parameters = n - taken, form.endswith("place"), len(parameters) > 0
    user, new = for_duals(fun, dual), _new_state(dual, taken)

    def seeded(Y, first, i):
        x = seed(dual, Y[i], lanes)
        for lane in range(min(lanes, count - first)):
            x = put_slope(x, lane, Y[size * (1 + first + lane) + i])
        return x

    seeded = inside(seeded)

    def fill(t, Y, out, args):
        out[:] = 0.0
        x, found = new(), new()
        for first in range(0, count, lanes):
            for i in range(taken):
                x[i] = seeded(Y, first, i)
            if by_parameters:
                p = np.empty(args[0].size, dual)
                for i in range(p.size):
                    p[i] = seed(dual, args[0][i], lanes)
                for j in range(places.size):
                    p[places[j]] = seeded(Y, first, n + j)
                given = (p,)
            else:
                given = args
            if in_place:
                user(t, x, found, *given)
                f = found
            else:
                f = user(t, x, *given)
            for i in range(offset):
                out[i] = Y[taken + i]
            for i in range(taken):
                out[offset + i] = value_of(f[i])
            for lane in range(min(lanes, count - first)):
                start = size * (1 + first + lane)
                for i in range(offset):
                    out[start + i] = Y[start + taken + i]
                for i in range(taken):
                    out[start + offset + i] = slope(f[i], lane)

    return _compiled(fill, 1, has_params, scalars)


@lru_cache(maxsize=256)
def parameter_gradient(fun: Any, p: int, shape: tuple[int, ...], parameters: tuple[int, ...]) -> Any:
    """Return ``slopes(t, y, params) -> (*shape, k)``, derivatives of a jitted invariant by k of its p `parameters`."""
    swapped = njit(lambda t, params, y: fun(t, y, params))
    grad = gradient(swapped, p, shape, True)
    sizes, places = (*shape, p), np.array(parameters, np.int64)

    def slopes(t, y, params):
        found = np.empty(sizes)
        grad(t, params, found, y)
        return found[..., places]

    return njit(slopes)


def _dual_along(directions: int) -> Dual:
    """Return the smallest dual type with which derivatives along `directions` directions need the fewest calls."""
    passes = -(-directions // LANES)
    return Dual(-(-directions // passes))


def _new_state(dual: Any, n: int) -> Any:
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


def _compiled(function: Callable[..., Any], ndim: int, has_params: bool, scalars: str) -> Any:
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
        raise NotDifferentiableError(f"it does not compile for dual numbers: {said[0].rstrip(':')}") from error
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
