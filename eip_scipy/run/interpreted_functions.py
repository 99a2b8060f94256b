"""Right-hand sides in the form that the interpreted loop calls: in place, with checks of their values."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from ..core.inputs import filled
from ..core.states import as_derivative
from ..core.steppers import check_halves
from ..engine.native import LibraryFunction

__all__ = ["FORMS", "INTERPRETED"]

FORMS = {  # (given as an acceleration, in place) -> name of the form of the user's function
    (False, False): "value",
    (False, True): "in place",
    (True, False): "acceleration",
    (True, True): "acceleration in place",
}


def _interpreted_value(fun: Callable[..., Any], extra: tuple, y0: np.ndarray, name: str = "fun") -> Callable[..., None]:
    """Return an in-place right-hand side that calls ``fun(t, y, *extra)`` and checks its value by `y0`."""
    n, dtype, shape = y0.size, y0.dtype, y0.shape

    def rhs(t: float, y: np.ndarray, out: np.ndarray, params: np.ndarray) -> None:
        f = fun(t, y.copy(), *extra)
        known = type(f) is np.ndarray and f.shape == shape and f.dtype == dtype
        out[:] = f if known else as_derivative(f, n, dtype, t, name)

    return rhs


def _interpreted_in_place(
    fun: Callable[..., Any], extra: tuple, y0: np.ndarray, name: str = "fun"
) -> Callable[..., None]:
    """Return an in-place right-hand side that checks ``fun(t, y, out, *extra)`` in its first call.

    `out` is filled with NaN before each call: the first call raises an error if the function leaves components
    unfilled, and later ones leave NaN there. Functions of the package's problems are not checked.
    """
    first = not isinstance(fun, LibraryFunction)

    def rhs(t: float, y: np.ndarray, out: np.ndarray, params: np.ndarray) -> None:
        nonlocal first
        if first:
            first = False
            out[:] = filled(lambda part: fun(t, y.copy(), part, *extra), out.shape, out.dtype, name, t)
        else:
            out.fill(math.nan)
            fun(t, y.copy(), out, *extra)

    return rhs


def _second_order(
    interpreted: Callable[..., Callable[..., None]], fun: Callable[..., Any], extra: tuple, y0: np.ndarray
) -> Callable[..., None]:
    """Return the in-place right-hand side of y = (q, v) for the acceleration `fun`, which `interpreted` checks."""
    check_halves(y0.size)
    half = y0.size // 2
    acc = interpreted(fun, extra, y0[:half], "acceleration")

    def rhs(t: float, y: np.ndarray, out: np.ndarray, params: np.ndarray) -> None:
        out[:half] = y[half:]
        acc(t, y[:half], out[half:], params)

    return rhs


INTERPRETED: dict[str, Callable[..., Callable[..., None]]] = {
    "value": _interpreted_value,
    "in place": _interpreted_in_place,
    "acceleration": partial(_second_order, _interpreted_value),
    "acceleration in place": partial(_second_order, _interpreted_in_place),
}
