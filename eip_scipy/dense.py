"""Dense output of the solvers."""

from __future__ import annotations

import numpy as np
from scipy.integrate import DenseOutput

__all__ = ["HermiteDenseOutput"]


class HermiteDenseOutput(DenseOutput):
    """Cubic Hermite interpolation between two steps, from the states and slopes at both ends."""

    def __init__(
        self, t_old: float, t: float, y_old: np.ndarray, y: np.ndarray, f_old: np.ndarray, f: np.ndarray
    ) -> None:
        super().__init__(t_old, t)
        self.h = t - t_old
        self.y_old, self.y, self.f_old, self.f = y_old, y, f_old, f

    def _call_impl(self, t: np.ndarray) -> np.ndarray:
        theta = np.asarray((t - self.t_old) / self.h)
        column = (slice(None),) + (None,) * theta.ndim
        y_old, y = self.y_old[column], self.y[column]
        out = hermite(theta, self.h, y_old, self.f_old[column], y, self.f[column])
        # Exactly the steps' own states at both ends, whatever rounding the polynomial has there.
        return np.where(theta == 1, y, np.where(theta == 0, y_old, out))


def hermite(
    theta: np.ndarray, h: float, y_old: np.ndarray, f_old: np.ndarray, y: np.ndarray, f: np.ndarray
) -> np.ndarray:
    """The cubic with the given values and slopes at theta = 0 and 1 of a step of length h."""
    change = y - y_old
    rest = 1 - theta
    return y_old + theta * change + theta * rest * (rest * (h * f_old - change) - theta * (h * f - change))
