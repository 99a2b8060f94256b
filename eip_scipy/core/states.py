"""Conversion of states and derivatives from the user to arrays."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ..engine.native import BUILD
from .inputs import as_vector, numbers, shown
from .jitted import is_jitted

__all__ = ["as_derivative", "initial_state", "own_values", "states"]


def own_values(fun: Callable[..., Any]) -> Callable[..., Any]:
    """Return a user's function with values that its later calls do not change; it may return one array again and again.

    Numba functions, which cannot fill a global array, are returned unchanged.
    """
    if is_jitted(fun):
        return fun

    def own(*args: Any) -> Any:
        value = fun(*args)
        return np.array(value) if isinstance(value, np.ndarray | list) else value

    return own


def as_derivative(value: Any, n: int, dtype: np.dtype, t: float, name: str = "fun") -> np.ndarray:
    """Return the value of a user's right-hand side at t as an array (n,), or raise an error; see `as_vector`."""
    return as_vector(value, n, dtype, f"{name} returned", t)


def initial_state(y0: Any, name: str = "y0") -> np.ndarray:
    """Return y0 as a new float64 or complex128 array (n,), with SciPy's error messages."""
    y = states(name, y0)
    if y.ndim != 1:
        raise ValueError(f"`{name}` must be 1-dimensional.")
    if not BUILD.are_finite(y.view(float)):
        raise ValueError(f"All components of the initial state `{name}` must be finite.")
    return y


def states(name: str, value: Any) -> np.ndarray:
    """Return a state, or several states, as a new float64 or complex128 array of any shape, after checks."""
    if type(value) is np.ndarray and value.dtype == float:
        return np.array(value, order="C")
    if np.ma.isMaskedArray(value) and np.ma.is_masked(value):
        raise ValueError(f"masked values in {name}; fill or drop them first.")
    found = numbers(name, value)
    if found is None:
        raise TypeError(f"`{name}` must hold numbers, got {shown(value)}.")
    return found
