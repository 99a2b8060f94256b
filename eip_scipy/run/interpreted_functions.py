"""A user's functions as the loop calls them: in place, their values looked at, or compiled."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from ..core import setup
from ..core.inputs import filled
from ..core.jitted import is_jitted

__all__ = ["FORMS", "INTERPRETED", "Handed", "hand"]

FORMS = {  # (of a Nystrom method, in place) -> what a user's function is
    (False, False): "value",
    (False, True): "in place",
    (True, False): "acceleration",
    (True, True): "acceleration in place",
}


def _interpreted_value(fun: Callable[..., Any], extra: tuple, y0: np.ndarray) -> Callable[..., None]:
    """The user's right-hand side as Python calls it, its values checked."""
    n, dtype, shape = y0.size, y0.dtype, y0.shape

    def rhs(t: float, y: np.ndarray, out: np.ndarray, params: np.ndarray) -> None:
        f = fun(t, y.copy(), *extra)
        known = type(f) is np.ndarray and f.shape == shape and f.dtype == dtype
        out[:] = f if known else setup.as_derivative(f, n, dtype, t)

    return rhs


def _interpreted_in_place(fun: Callable[..., Any], extra: tuple, y0: np.ndarray) -> Callable[..., None]:
    """The user's right-hand side in place, looked at in its first call; NaN in `out` then shows what it leaves out."""
    first = True

    def rhs(t: float, y: np.ndarray, out: np.ndarray, params: np.ndarray) -> None:
        nonlocal first
        if first:
            first = False
            out[:] = filled(lambda part: fun(t, y.copy(), part, *extra), out.shape, out.dtype, "fun", t)
        else:
            out.fill(math.nan)
            fun(t, y.copy(), out, *extra)

    return rhs


def _interpreted_acceleration(fun: Callable[..., Any], extra: tuple, y0: np.ndarray) -> Callable[..., None]:
    return _second_order(_interpreted_value(fun, extra, _positions(y0)))


def _interpreted_acceleration_in_place(fun: Callable[..., Any], extra: tuple, y0: np.ndarray) -> Callable[..., None]:
    return _second_order(_interpreted_in_place(fun, extra, _positions(y0)))


def _positions(y0: np.ndarray) -> np.ndarray:
    setup.check_halves(y0.size)
    return y0[: y0.size // 2]


def _second_order(acc: Callable[..., None]) -> Callable[..., None]:
    """The right-hand side of (q, v) from its acceleration."""

    def rhs(t: float, y: np.ndarray, out: np.ndarray, params: np.ndarray) -> None:
        half = y.size // 2
        out[:half] = y[half:]
        acc(t, y[:half], out[half:], params)

    return rhs


INTERPRETED = {
    "value": _interpreted_value,
    "in place": _interpreted_in_place,
    "acceleration": _interpreted_acceleration,
    "acceleration in place": _interpreted_acceleration_in_place,
}


def hand(handed: list[Handed], fun: Callable[..., Any], arrays: int) -> Callable[..., Any]:
    """What is called in place of a user's function; those that are jitted are listed."""
    if not is_jitted(fun):
        return fun
    handed.append(Handed(fun, arrays))
    return handed[-1]


class Handed:
    """A user's jitted function as Python calls it: on arrays that it cannot write to, as compiled runs call it.

    So that one version of it is compiled, not two. Where it writes to them it gets them writable, as do interpreted
    runs, whose calls take less time then, once `read_only` is False.

    Parameters
    ----------
    fun : callable
        ``fun(t, y, ...)``.
    arrays : int
        How many of the arguments after t: the state, and f where a gradient takes it.
    """

    __slots__ = ("_arrays", "_fun", "read_only")

    def __init__(self, fun: Callable[..., Any], arrays: int) -> None:
        self._fun, self._arrays, self.read_only = fun, arrays, True

    def __call__(self, t: float, *arguments: Any) -> Any:
        """The function's value."""
        if self.read_only:
            given = (_read_only(a) for a in arguments[: self._arrays])
            try:
                return self._fun(t, *given, *arguments[self._arrays :])
            except _numba_error():
                self.read_only = False
        return self._fun(t, *arguments)


def _read_only(a: np.ndarray) -> np.ndarray:
    a = a[:]
    a.flags.writeable = False
    return a


def _numba_error() -> type[Exception]:
    from numba.core.errors import NumbaError

    return NumbaError
