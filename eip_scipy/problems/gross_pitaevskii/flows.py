"""Exact flows of the linear part: free motion and rotation together, by multipliers along one axis after another."""

from __future__ import annotations

from math import cos, pi, sin, tan
from typing import Any

import numpy as np

from .equation import GrossPitaevskii
from .phases import LineFlow
from .transforms import Axes

__all__ = ["LinearFlow"]

LARGEST_TURN = pi / 4


class LinearFlow:
    """exp(-i (time T - angle Lz)), T = -Laplace / 2, exact in time: a rotation by `angle` and free motion for `time`.

    Parameters
    ----------
    gpe : GrossPitaevskii
    time : float
        Of the free motion.
    angle : float, optional
        Default: ``gpe.Omega * time``, the flow of the equation's linear part.

    Raises
    ------
    ValueError
        When the angle is above pi / 4 or the equation has one dimension and the angle is not 0.

    Notes
    -----
    Without rotation this is one multiplier of all modes. With it, three factors along x, y and x again, each of which
    multiplies the modes along its axis: ``exp(-i (a k^2 / 2 + c y k))``, ``exp(-i (b q^2 / 2 - d x q))`` and the first
    once more, with c = tan(angle / 2), d = sin(angle), a = time / (1 + cos(angle)), b = time cos(angle). For time = 0
    that is the rotation of images by three shears (Unser, Thevenaz & Yaroslavsky 1995); with the free motion see
    Bernier, Crouseilles & Li, J. Comput. Phys. 443 (2021) 110518, for such splittings of quadratic operators. The
    values given here follow from the classical motion, which determines the flow of a quadratic Hamiltonian.
    On the grid the flow is unitary to round-off, and exact as far as the field and its spectrum vanish at the ends.
    """

    def __init__(self, gpe: GrossPitaevskii, time: float, angle: float | None = None) -> None:
        angle = gpe.Omega * time if angle is None else angle
        if abs(angle) > LARGEST_TURN * (1 + 1e-9):
            raise ValueError(f"a flow turns by pi / 4 at most, got {angle:.3g} (Omega h); take shorter steps.")
        self._fft = gpe.transforms
        self._lines: LineFlow | None = None
        self._factors: list[tuple[Axes, list[np.ndarray]]] = []
        if gpe.own_transforms:
            self._lines = LineFlow(gpe.grid, self._passes(gpe, time, angle), gpe.transforms.threads)
        else:
            self._factors = self._all_factors(gpe, time, angle)

    @staticmethod
    def _passes(gpe: GrossPitaevskii, time: float, angle: float) -> list[tuple[int, np.ndarray, np.ndarray]]:
        """The phases axis by axis, as `LineFlow` takes them."""
        kinetic = [gpe.kinetic_factor(axis) for axis in range(gpe.grid.dim)]
        still = [np.zeros_like(k) for k in kinetic]
        if angle == 0:
            return [(axis, time * k, still[axis]) for axis, k in enumerate(kinetic)]
        k, q = (gpe.grid.wavenumbers(axis, odd=True) for axis in (0, 1))
        x = 0, time / (1 + cos(angle)) * kinetic[0], tan(angle / 2) * k
        y = 1, time * cos(angle) * kinetic[1], -sin(angle) * q
        return [x, y, *((2, time * p, still[2]) for p in kinetic[2:]), x]

    @classmethod
    def _all_factors(cls, gpe: GrossPitaevskii, time: float, angle: float) -> list[tuple[Axes, list[np.ndarray]]]:
        """The same as factors of a library's modes."""
        kinetic = [gpe.kinetic_factor(axis) for axis in range(gpe.grid.dim)]
        if angle == 0:
            return [cls._factor(gpe, tuple(range(gpe.grid.dim)), [time * sum(kinetic)])]
        along_x, along_y = gpe.rotation_factors()
        x = cls._factor(gpe, (0,), [time / (1 + cos(angle)) * kinetic[0] - tan(angle / 2) * along_x])
        y = [time * cos(angle) * kinetic[1] - sin(angle) * along_y, *(time * k for k in kinetic[2:])]
        return [x, cls._factor(gpe, tuple(range(1, gpe.grid.dim)), y), x]

    @staticmethod
    def _factor(gpe: GrossPitaevskii, axes: Axes, phases: list[Any]) -> tuple[Axes, list[np.ndarray]]:
        """The factors exp(-i phase), which broadcast, the first divided by the number of points."""
        points = int(np.prod([gpe.grid.shape[axis] for axis in axes]))
        first, *rest = (np.exp(-1j * phase) for phase in phases)
        return axes, [first / points, *rest]

    def apply(self, psi: np.ndarray, work: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The image of a contiguous field, in one of the two arrays, and the other one; both may be overwritten."""
        if self._lines is not None:
            self._lines.apply(psi)
        for axes, factors in self._factors:
            self._fft.forward(psi, axes, work)
            for factor in factors:
                work *= factor
            self._fft.backward(work, axes)
            psi, work = work, psi
        return psi, work
