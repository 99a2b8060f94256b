"""Lawson's integrating-factor Runge-Kutta method of order 4 for the Gross-Pitaevskii equation."""

from __future__ import annotations

import numpy as np

from .equation import GrossPitaevskii
from .flows import LinearFlow
from .pointwise import derivative_at_once

__all__ = ["Lawson4"]


class Lawson4:
    """The classical Runge-Kutta method in the variables in which the linear part, with the rotation, stands still.

    The potential and the interaction are explicit and limit the step, the Laplacian and the rotation do not.

    Parameters
    ----------
    gpe : GrossPitaevskii

    Attributes
    ----------
    gpe
    order : int
        4.
    error_estimator_order : int
        3: as for `EIPRK4`, from the local part at the new point in the place of the fourth stage, without a transform.
    name : str

    References
    ----------
    .. [1] J. D. Lawson, SIAM J. Numer. Anal. 4 (1967) 372.
    .. [2] C. Besse, G. Dujardin, I. Lacroix-Violet, SIAM J. Numer. Anal. 55 (2017) 1387, for the rotating equation.
    """

    order = 4
    error_estimator_order = 3
    name = "lawson4"

    def __init__(self, gpe: GrossPitaevskii) -> None:
        self.gpe = gpe
        self._h: float | None = None
        self._half: LinearFlow

    def __repr__(self) -> str:
        return f"Lawson4({self.gpe!r})"

    def one_step(self, t: float, y: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
        """One step of length h, and its error estimate."""
        if h != self._h:
            self._half, self._h = LinearFlow(self.gpe, 0.5 * h), h
        psi = y.reshape(self.gpe.grid.shape)
        moved_k1 = self._moved(self._local(psi))
        psi = self._moved(psi)
        k2 = self._local(psi + 0.5 * h * moved_k1)
        k3 = self._local(psi + 0.5 * h * k2)
        k4 = self._local(self._moved(psi + h * k3))
        k2 += k3
        new = self._moved(psi + h / 6 * moved_k1 + h / 3 * k2) + h / 6 * k4
        return new.reshape(-1), (h / 6 * (k4 - self._local(new))).reshape(-1)

    def _local(self, psi: np.ndarray) -> np.ndarray:
        """-i (V + beta |psi|^2) psi."""
        out = np.zeros_like(psi)
        gpe = self.gpe
        derivative_at_once(gpe.rows(psi), gpe.V.reshape(-1, gpe.grid.shape[-1]), gpe.beta, gpe.rows(out))
        return out

    def _moved(self, psi: np.ndarray) -> np.ndarray:
        """`psi` after half a step of the linear part; `psi` is overwritten."""
        return self._half.apply(psi, np.empty_like(psi))[0]
