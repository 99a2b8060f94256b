"""Right-hand sides in the form that the interpreted loop calls: in place, with checks of their values."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from ..core.inputs import filled
from ..core.states import as_derivative
from ..engine.native import LibraryFunction
from ..methods.nystrom import check_halves

__all__ = ["FORMS", "interpreted"]

FORMS = {  # (given as an acceleration, in place) -> name of the form of the user's function
    (False, False): "value",
    (False, True): "in place",
    (True, False): "acceleration",
    (True, True): "acceleration in place",
}


def interpreted(form: str, fun: Callable[..., Any], extra: tuple, y0: np.ndarray) -> Callable[..., None]:
    """Return ``rhs(t, y, out)``, which calls the user's function `fun` of a form in `FORMS` and checks its value.

    `extra` are the last arguments of `fun`, and `y0` has the shape and dtype of a state.
    """
    checked = _in_place if "in place" in form else _value
    if not form.startswith("acceleration"):
        return checked(fun, extra, y0, "fun")
    check_halves(y0.size)
    half = y0.size // 2
    acc = checked(fun, extra, y0[:half], "acceleration")

    def rhs(t: float, y: np.ndarray, out: np.ndarray) -> None:
        out[:half] = y[half:]
        acc(t, y[:half], out[half:])

    return rhs


def _value(fun: Callable[..., Any], extra: tuple, y0: np.ndarray, name: str) -> Callable[..., None]:
    n, dtype, shape = y0.size, y0.dtype, y0.shape

    def rhs(t: float, y: np.ndarray, out: np.ndarray) -> None:
        f = fun(t, y.copy(), *extra)
        known = type(f) is np.ndarray and f.shape == shape and f.dtype == dtype
        out[:] = f if known else as_derivative(f, n, dtype, t, name)

    return rhs


def _in_place(fun: Callable[..., Any], extra: tuple, y0: np.ndarray, name: str) -> Callable[..., None]:
    """Return `fun` after a check of its first call, which functions of the package's problems do not need.

    `out` is filled with NaN before each call: the first call raises an error if the function leaves components
    unfilled, and later ones leave NaN there.
    """
    first = not isinstance(fun, LibraryFunction)

    def rhs(t: float, y: np.ndarray, out: np.ndarray) -> None:
        nonlocal first
        if first:
            first = False
            out[:] = filled(lambda part: fun(t, y.copy(), part, *extra), out.shape, out.dtype, name, t)
        else:
            out.fill(math.nan)
            fun(t, y.copy(), out, *extra)

    return rhs
