"""Right-hand sides of y = (q, v) made from accelerations a(t, q); detection of accelerations given in their place."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np

from .inputs import filled
from .one_step import as_vector
from .pointers import PointerFunction

__all__ = ["BY_NAME", "AccelerationField", "is_acceleration", "named_accelerations"]

BY_NAME = (
    "pass it by name: integrate(acceleration=fun, t_span=..., y0=..., ...), or "
    "eip_scipy.solve_ivp(acceleration=fun, t_span=..., y0=..., ...)"
)


class AccelerationField:
    """First-order right-hand side ``f(t, y[, *args]) = (v, a)`` of y = (q, v), made from an acceleration.

    This is ``acceleration(t, q, *args) -> (n/2,)``, or ``acceleration(t, q, out, *args)`` with `in_place`. `integrate`
    and the functions built on it call the acceleration itself. The object can be pickled if the acceleration can.
    """

    def __init__(self, acceleration: Callable[..., Any], in_place: bool = False) -> None:
        self.acceleration, self.in_place = acceleration, in_place

    def __call__(self, t: float, y: np.ndarray, *args: Any) -> np.ndarray:
        """Return the derivative at (t, y) as a new array."""
        half, state = y.size // 2, np.asarray(y)
        q, v = state[:half].copy(), state[half:]
        if self.in_place:
            a = filled(lambda out: self.acceleration(t, q, out, *args), q.shape, q.dtype, "acceleration", t)
        else:
            a = as_vector(self.acceleration(t, q, *args), half, q.dtype, "acceleration returned", t)
        return np.concatenate([v, a])


@contextmanager
def named_accelerations(
    method: str, fun: Callable[..., Any], in_place: bool, extra: tuple[Any, ...], t: float, y: np.ndarray
) -> Iterator[None]:
    """Run the body of a ``with`` statement, which first calls `fun`; explain its error if `fun` is an acceleration."""
    try:
        yield
    except ArithmeticError:  # at this state, with values that do not show what fun is
        raise
    except Exception as error:
        if is_acceleration(fun, in_place, extra, t, y):
            raise ValueError(
                f"fun gives {y.size // 2} of the {y.size} components that the state y = (q, v) has. For {method}, as "
                "for every method, fun(t, y) must return the derivative (v, a) of the state. If fun is the "
                f"acceleration a(t, q), {BY_NAME}."
            ) from error
        raise


def is_acceleration(fun: Callable[..., Any], in_place: bool, extra: tuple[Any, ...], t: float, y: np.ndarray) -> bool:
    """Return True if `fun` is not a right-hand side of y = (q, v) but returns n/2 accelerations.

    The function is called with y, and then with q in place of y. Numba functions are called as Python code, and C
    functions with y only, because compiled code could read or write beyond the end of a shorter array. For the same
    reason q is passed as the first half of an array as long as y.
    """
    code = getattr(fun, "py_func", fun)
    sizes = (y.size,) if isinstance(fun, PointerFunction) else (y.size, y.size // 2)
    gives = partial(_gives, code, in_place, extra, t)
    if y.size % 2 or gives(y.copy(), y.size):
        return False
    return any(gives(y.copy()[:size], y.size // 2) for size in sizes)


def _gives(
    fun: Callable[..., Any], in_place: bool, extra: tuple[Any, ...], t: float, state: np.ndarray, count: int
) -> bool:
    """Return True if `fun` returns an array (count,), or fills the first `count` entries of out with finite numbers.

    It must not fill the other entries. Return False also if it raises an exception.
    """
    out = np.full_like(state, np.nan)
    try:
        with np.errstate(all="ignore"):
            if not in_place:
                return np.shape(fun(t, state, *extra)) == (count,)
            fun(t, state, out, *extra)
    except Exception:  # the function does not take these arguments
        return False
    return bool(np.isfinite(out[:count]).all() and np.isnan(out[count:]).all())
