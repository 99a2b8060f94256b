"""Compiled gradients of jitted invariants that come without one; loaded only where there is such an invariant."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit, types
from numba.extending import overload

from .dual_arrays import for_duals, inside
from .dual_numbers import Dual, seed, slope, stack_array
from .jitted import NotCompilableError

__all__ = ["gradient_by_duals"]

# Derivatives carried through a function at once, at most: more fill the registers.
LANES = 12
# Duals on the stack, at most.
STACK = 64
NUMBERS = {"d": types.float64, "q": types.int64, "?": types.boolean}
# How the line of Numba's errors begins that names what is missing.
SAYING = ("No implementation", "Cannot", "Unknown")


@lru_cache(maxsize=256)
def gradient_by_duals(fun: Any, n: int, shape: tuple[int, ...], has_params: bool, scalars: str = "") -> Any:
    """The gradient ``grad(t, y, out[, params])`` of a jitted invariant, by dual numbers: exact but for rounding.

    With `scalars`, the types of some numbers, it is ``grad(t, y, out, *numbers)``.

    Raises
    ------
    NotCompilableError
        When the function does something that dual numbers cannot.
    """
    passes = -(-n // LANES)
    lanes = -(-n // passes)
    dual = Dual(lanes)
    call = _with_params(for_duals(fun, dual), has_params, bool(scalars))

    made = (lambda: np.empty(n, dual)) if n > STACK else (lambda: stack_array(dual, n))
    new_state = inside(made, forceinline=True)

    def filled(t, y, out, params):
        x = new_state()
        for first in range(0, n, lanes):
            for i in range(n):
                x[i] = seed(dual, y[i], i - first)
            put_slopes(call(t, x, params), out, first, min(lanes, n - first))

    return _compiled(filled, shape, has_params, scalars)


def _with_params(fun: Any, has_params: bool, one_by_one: bool) -> Any:
    if one_by_one:
        return inside(lambda t, x, numbers: fun(t, x, *numbers))
    return inside((lambda t, x, params: fun(t, x, params)) if has_params else (lambda t, x, params: fun(t, x)))


def _compiled(filled: Callable[..., None], shape: tuple[int, ...], has_params: bool, scalars: str) -> Any:
    """A gradient compiled for real states, as it is called from Python; from the engine it takes the same types."""
    filled = inside(filled)
    floats, out = (types.Array(types.float64, ndim, "C") for ndim in (1, 1 + len(shape)))
    if scalars:
        numbers = types.BaseTuple.from_types([NUMBERS[scalar] for scalar in scalars])
        gradient, arguments = njit(lambda t, y, out, *numbers: filled(t, y, out, numbers)), [floats, out, numbers]
    elif has_params:
        gradient, arguments = njit(lambda t, y, out, params: filled(t, y, out, params)), [floats, out, floats]
    else:
        gradient, arguments = njit(lambda t, y, out: filled(t, y, out, y)), [floats, out]
    try:
        gradient.compile((types.float64, *arguments))
    except Exception as error:  # Numba has no one class for what its parts raise on a type that they do not expect
        said = [line for line in str(error).splitlines() if line.startswith(SAYING)] or [type(error).__name__]
        raise NotCompilableError(f"it does not compile for dual numbers: {said[0].rstrip(':')}") from error
    return gradient


def put_slopes(value, out, first, count):
    """The derivatives of an invariant into columns of its gradient; for compiled code alone."""


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
