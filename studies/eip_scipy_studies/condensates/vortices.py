"""Vortices of a field, around which the phase winds, their motion, and surfaces of equal density around them."""

from __future__ import annotations

from itertools import pairwise
from math import ceil, sqrt
from typing import Any, NamedTuple

import numpy as np
import scipy  # its parts load when they are used

from eip_scipy.problems import GrossPitaevskii

CORE = 4.0  # width of a core, in healing lengths
THRESHOLD = 0.01  # of the largest density; phases have no meaning where there is less
DEEP, SMOOTH = 2.0, 2.0  # factor of the surface's density inside, with filled cores; points, for an edge without teeth


class Vortices(NamedTuple):
    """Vortices in a plane: positions (k, 2), and the turns of the phase around each, positive if anticlockwise."""

    positions: np.ndarray
    charges: np.ndarray


def vortices(gpe: GrossPitaevskii, psi: Any) -> Vortices:
    """Return the vortices of a field inside the condensate; in three dimensions those in the middle plane.

    Places where the density is below `THRESHOLD`, after cores have been filled by a grey closing, are outside. The
    phase differences along the edges of a cell are those beyond the rigid rotation, by which the phase may turn by more
    than pi between two points. Their sum, plus the circulation 2 Omega dx dy of the rotation, is 2 pi times the charge.
    """
    psi = gpe.as_field(psi)
    top = float((np.abs(psi) ** 2).max())
    if gpe.grid.dim == 3:
        psi = psi[:, :, gpe.grid.shape[2] // 2]
    x, y = (gpe.grid.points(axis) for axis in (0, 1))
    dx, dy = gpe.grid.spacing[:2]
    filled = scipy.ndimage.grey_closing(np.abs(psi) ** 2, size=_core_size(gpe, top), mode="wrap")
    charge = _charges(psi, gpe.Omega, x, y, dx, dy)
    least = np.minimum(filled[1:], filled[:-1])
    least = np.minimum(least[:, 1:], least[:, :-1])  # of the corners of each cell
    i, j = np.nonzero((charge != 0) & (least > THRESHOLD * top))
    places = [_zero(psi[a : a + 2, b : b + 2], gpe.Omega, x[a], y[b], dx, dy) for a, b in zip(i, j, strict=True)]
    return Vortices(np.array(places).reshape(-1, 2), charge[i, j])


def _core_size(gpe: GrossPitaevskii, top: float) -> list[int]:
    """Return the odd numbers of points, at least 3, across a core of the width of 4 healing lengths at `top`."""
    width = CORE / sqrt(2 * gpe.beta * top)
    return [max(3, ceil(width / d) | 1) for d in gpe.grid.spacing[:2]]


def _charges(psi: np.ndarray, Omega: float, x: np.ndarray, y: np.ndarray, dx: float, dy: float) -> np.ndarray:
    """Return the winding numbers (J - 1, K - 1) around the cells of the grid, without those across the box's ends."""
    psi = np.where(psi == 0, 1.0, psi)  # a vortex on a point of the grid: any phase will do, as long as it has one
    along_x = np.angle(psi[1:] * np.conj(psi[:-1]) * np.exp(1j * Omega * dx * y))
    along_y = np.angle(psi[:, 1:] * np.conj(psi[:, :-1]) * np.exp(-1j * Omega * dy * x[:, None]))
    around = along_x[:, :-1] + along_y[1:] - along_x[:, 1:] - along_y[:-1]
    return np.rint((around + 2 * Omega * dx * dy) / (2 * np.pi)).astype(int)


def _zero(corners: np.ndarray, Omega: float, x: float, y: float, dx: float, dy: float) -> tuple[float, float]:
    """Return x and y of the zero of the linear function that fits the field at the `corners` of a cell best."""
    u = np.array([[-0.5], [0.5]])
    middle = x + 0.5 * dx, y + 0.5 * dy
    c = corners * np.exp(-1j * Omega * (middle[0] * dy * u.T - middle[1] * dx * u))
    slopes = np.array([(c[1] - c[0]).mean(), (c[:, 1] - c[:, 0]).mean()])
    matrix, mean = np.array([slopes.real, slopes.imag]), c.mean()
    shift = np.linalg.lstsq(matrix, -np.array([mean.real, mean.imag]), rcond=None)[0]
    a, b = np.clip(shift, -0.5, 0.5)
    return middle[0] + a * dx, middle[1] + b * dy


class Motion:
    """Vortices in the states `fields` (n, m) at the times `t` (m,), and the `angle` (m,) by which they have turned.

    From one state to the next, the angle of each vortex about the centre is extrapolated and matched with the nearest.
    """

    def __init__(self, gpe: GrossPitaevskii, t: np.ndarray, fields: np.ndarray) -> None:
        self.t, self.vortices = t, [vortices(gpe, y) for y in fields.T]
        turned, step = [0.0], 0.0
        for old, new in pairwise(np.arctan2(*each.positions.T[::-1]) for each in self.vortices):
            if old.size and new.size:
                off = np.angle(np.exp(1j * (new[None, :] - old[:, None] - step)))
                nearest = np.abs(off).argmin(axis=1)
                step += float(np.median(off[np.arange(old.size), nearest]))
            turned.append(turned[-1] + step)
        self.angle = np.array(turned)

    def off(self, k: int, x: Any, y: Any) -> Any:
        """Return polar angles of points in the k-th state, relative to the first vortex with the largest x, turned."""
        a, b = self.vortices[0].positions[np.argmax(self.vortices[0].positions[:, 0])]
        return np.angle(np.exp(1j * (np.arctan2(y, x) - np.arctan2(b, a) - self.angle[k])))

    def followed(self, k: int) -> int | None:
        """Return the index of the vortex closest to the reference of `off` in the k-th state; None without vortices."""
        if not (self.vortices[0].charges.size and self.vortices[k].charges.size):
            return None
        return int(np.abs(self.off(k, *self.vortices[k].positions.T)).argmin())


def density_surface(gpe: GrossPitaevskii, psi: Any, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the surface on which ``|psi|^2`` has a value `level`, by marching cubes (Lewiner et al. 2003).

    These are corners (m, 3, 3) of triangles, and whether they lie inside the condensate (m,), around a vortex line. The
    field, 0 at the ends of the box, is interpolated to twice as many points on each axis.
    """
    from skimage.measure import marching_cubes

    psi = gpe.as_field(psi)
    top = float((np.abs(psi) ** 2).max())
    for axis, n in enumerate(gpe.grid.shape):
        psi = scipy.signal.resample(psi, 2 * n, axis=axis)
    density = np.abs(psi) ** 2
    points, triangles, _, _ = marching_cubes(density, level)
    closed = scipy.ndimage.grey_closing(density, size=[*(2 * n + 1 for n in _core_size(gpe, top)), 1])
    filled = scipy.ndimage.gaussian_filter(closed, SMOOTH)
    around = scipy.ndimage.map_coordinates(filled, points[triangles].mean(axis=1).T, order=1)
    return (gpe.grid.lower + 0.5 * gpe.grid.spacing * points)[triangles], around > DEEP * level
