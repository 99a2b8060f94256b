"""Splitting methods for the Gross-Pitaevskii equation, to compare with, and the exact flows of its linear part."""

from __future__ import annotations

from math import ceil, cos, pi, remainder, sin, tan
from typing import Any

import numpy as np

from eip_scipy.problems import GrossPitaevskii

from .pointwise import local_flow

SMALL_TURN = pi / 32  # shears stretch what they turn by a fortieth of its radius: the field must stay inside the box


class LinearFlow:
    """The flow exp(-i (time T - angle Lz)) with T = -Laplace / 2: a rotation by `angle` and free motion for `time`.

    The default of `angle` gives the flow of the equation's linear part. Without rotation the flow is one factor of all
    modes. With rotation there are three factors, of the modes along x, y and x again, which follow from the classical
    motion: ``exp(-i (a k^2 / 2 + c y k))``, ``exp(-i (b q^2 / 2 - d x q))`` and the first once more, with c = tan(angle
    / 2), d = sin(angle), a = time / (1 + cos(angle)), b = time cos(angle). On the grid the flow is unitary.
    """

    def __init__(self, gpe: GrossPitaevskii, time: float, angle: float | None = None) -> None:
        angle = gpe.Omega * time if angle is None else angle
        self._gpe = gpe
        kinetic = [gpe.kinetic_factor(axis) for axis in range(gpe.grid.dim)]
        if angle == 0:
            self._factors = [self._factor(tuple(range(gpe.grid.dim)), [time * sum(kinetic)])]
            return
        along_x, along_y = gpe.rotation_factors()
        x = self._factor((0,), [time / (1 + cos(angle)) * kinetic[0] - tan(angle / 2) * along_x])
        y = [time * cos(angle) * kinetic[1] - sin(angle) * along_y, *(time * k for k in kinetic[2:])]
        self._factors = [x, self._factor(tuple(range(1, gpe.grid.dim)), y), x]

    def _factor(self, axes: tuple[int, ...], phases: list[Any]) -> tuple[tuple[int, ...], list[np.ndarray]]:
        """Return `axes`, and the factors exp(-i phase) of the modes along them, the first with the normalisation."""
        points = int(np.prod([self._gpe.grid.shape[axis] for axis in axes]))
        first, *rest = (np.exp(-1j * phase) for phase in phases)
        return axes, [first / points, *rest]

    def apply(self, psi: np.ndarray, work: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the array that contains the field after the flow from `psi`, and the other one of the two arguments.

        Both arrays are overwritten; the content of `work` is not used.
        """
        for axes, factors in self._factors:
            self._gpe.transforms.forward(psi, axes, work)
            for factor in factors:
                work *= factor
            self._gpe.transforms.backward(work, axes)
            psi, work = work, psi
        return psi, work


# Blanes & Moan, J. Comput. Appl. Math. 142 (2002) 313, table 3, SRKN6b of order 4: coefficients are symmetric, sum 1.
A = (0.0829844064174052, 0.396309801498368, -0.0390563049223486)
B = (0.245298957184271, 0.604872665711080)
# Order, and fractions of the step for the flows of V + beta |psi|^2 and, between them, of the linear part.
SCHEMES: dict[str, tuple[int, tuple[float, ...], tuple[float, ...]]] = {
    "strang": (2, (0.5, 0.5), (1.0,)),  # Strang, SIAM J. Numer. Anal. 5 (1968) 506
    "rkn6": (4, (*A, 1 - 2 * sum(A), *A[::-1]), (*B, 0.5 - sum(B), 0.5 - sum(B), *B[::-1])),
}


class Splitting:
    """One-step method for `eip_method` that solves the linear part and the local part alternately, both exactly.

    ``|psi|^2`` is constant in the local flow, which therefore only changes the phase.
    """

    def __init__(self, gpe: GrossPitaevskii, scheme: str = "rkn6") -> None:
        self.gpe, self.name = gpe, f"splitting-{scheme}"
        self.order, self._local, self._linear = SCHEMES[scheme]
        self.evaluations = len(self._linear)  # each takes about as many transforms as a right-hand side
        self._kept: tuple[float, list[LinearFlow]] | None = None

    def one_step(self, t: float, y: np.ndarray, h: float) -> np.ndarray:
        """Make one step of length h; `y` is overwritten and returned."""
        gpe = self.gpe
        if self._kept is None or self._kept[0] != h:
            made = {part: LinearFlow(gpe, part * h) for part in set(self._linear)}
            self._kept = h, [made[part] for part in self._linear]
        psi = y.reshape(gpe.grid.shape)
        field, work = psi, np.empty_like(psi)
        for part, flow in zip(self._local, self._kept[1], strict=False):
            local_flow(field, gpe.V, gpe.beta, part * h)
            field, work = flow.apply(field, work)
        local_flow(field, gpe.V, gpe.beta, self._local[-1] * h)
        if field is not psi:
            psi[...] = field
        return y


def rotated(gpe: GrossPitaevskii, psi: Any, angle: float) -> np.ndarray:
    """Return exp(i angle Lz) psi, the field at points turned anticlockwise by `angle` about the z axis."""
    psi = gpe.as_field(psi).copy()
    angle = remainder(angle, 2 * pi)
    parts = max(1, ceil(abs(angle) / SMALL_TURN - 1e-9))
    flow, work = LinearFlow(gpe, 0.0, angle / parts), np.empty_like(psi)
    for _ in range(parts):
        psi, work = flow.apply(psi, work)
    return psi
