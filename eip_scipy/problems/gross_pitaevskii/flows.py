"""Exact flows of the linear part of the Gross-Pitaevskii equation, by factors of Fourier modes along axes in turn."""

from __future__ import annotations

from math import cos, pi, sin, tan
from typing import TYPE_CHECKING, Any

import numpy as np

from .transforms import Axes

if TYPE_CHECKING:
    from .equation import GrossPitaevskii

__all__ = ["LinearFlow"]

LARGEST_TURN = pi / 4


class LinearFlow:
    """The flow exp(-i (time T - angle Lz)) with T = -Laplace / 2: a rotation by `angle` and free motion for `time`.

    Parameters
    ----------
    gpe : GrossPitaevskii
    time : float
        Time of the free motion.
    angle : float, optional
        Angle of the rotation. Default: ``gpe.Omega * time``, which gives the flow of the equation's linear part.

    Raises
    ------
    ValueError
        If the absolute value of the angle is above pi / 4, or the equation has one dimension and the angle is not 0.

    Notes
    -----
    The flow is exact in time. Without rotation it is one factor of all modes. With rotation there are three factors, of
    the modes along x, y and x again: ``exp(-i (a k^2 / 2 + c y k))``, ``exp(-i (b q^2 / 2 - d x q))`` and the first
    once more, with c = tan(angle / 2), d = sin(angle), a = time / (1 + cos(angle)), b = time cos(angle). For time = 0
    this is the rotation of images by three shears (Unser, Thevenaz & Yaroslavsky 1995); for splittings with the free
    motion see Bernier, Crouseilles & Li, J. Comput. Phys. 443 (2021) 110518. The values given here follow from the
    classical motion, which determines the flow of a quadratic Hamiltonian. On the grid the flow is unitary to
    round-off, and exact as far as the field and its spectrum vanish at the ends.
    """

    def __init__(self, gpe: GrossPitaevskii, time: float, angle: float | None = None) -> None:
        angle = gpe.Omega * time if angle is None else angle
        if abs(angle) > LARGEST_TURN * (1 + 1e-9):
            raise ValueError(
                f"the absolute value of the angle, by default Omega times time, must be at most pi / 4, got "
                f"{angle:.3g}; use shorter steps."
            )
        self._fft = gpe.transforms
        kinetic = [gpe.kinetic_factor(axis) for axis in range(gpe.grid.dim)]
        if angle == 0:
            axes = tuple(range(gpe.grid.dim))
            self._factors = [self._factor(gpe, axes, [time * sum(kinetic)])]
            return
        along_x, along_y = gpe.rotation_factors()
        others = tuple(range(1, gpe.grid.dim))
        x = self._factor(gpe, (0,), [time / (1 + cos(angle)) * kinetic[0] - tan(angle / 2) * along_x])
        y = [time * cos(angle) * kinetic[1] - sin(angle) * along_y, *(time * k for k in kinetic[2:])]
        self._factors = [x, self._factor(gpe, others, y), x]

    @staticmethod
    def _factor(gpe: GrossPitaevskii, axes: Axes, phases: list[Any]) -> tuple[Axes, list[np.ndarray]]:
        """Return `axes`, and the factors exp(-i phase) of the modes along them, the first with the normalisation."""
        points = int(np.prod([gpe.grid.shape[axis] for axis in axes]))
        first, *rest = (np.exp(-1j * phase) for phase in phases)
        return axes, [first / points, *rest]

    def apply(self, psi: np.ndarray, work: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the array that contains the field after the flow from `psi`, and the other one of the two arguments.

        Both arrays are overwritten; the content of `work` is not used.
        """
        for axes, factors in self._factors:
            self._fft.forward(psi, axes, work)
            for factor in factors:
                work *= factor
            self._fft.backward(work, axes)
            psi, work = work, psi
        return psi, work
