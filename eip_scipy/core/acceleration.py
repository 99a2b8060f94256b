"""Right-hand sides of y = (q, v) made from accelerations a(t, q)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from .inputs import as_vector, filled

__all__ = ["BY_NAME", "AccelerationField"]

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
