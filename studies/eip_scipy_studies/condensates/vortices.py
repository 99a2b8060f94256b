"""Vortices of a field, around which the phase winds, and surfaces of equal density that show them as tubes."""

from __future__ import annotations

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

    Places where the density is below `THRESHOLD` are outside, after cores have been filled by a grey closing. From the
    phase differences along the edges of a cell those of the rigid rotation are subtracted, because the phase of a fast
    rotating field may turn by more than pi between two points. The sum of the rests, reduced to (-pi, pi], plus the
    circulation 2 Omega dx dy of the rotation, is 2 pi times the charge.
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


class Surface(NamedTuple):
    """Triangles: their corners (m, 3, 3), and whether they lie inside the condensate (m,), around a vortex line."""

    corners: np.ndarray
    inside: np.ndarray


def density_surface(gpe: GrossPitaevskii, psi: Any, level: float) -> Surface:
    """Return the surface on which ``|psi|^2`` has a value `level`, by marching cubes (Lewiner et al. 2003).

    The field, 0 at the ends of the box, is interpolated to twice as many points on each axis.
    """
    psi = gpe.as_field(psi)
    top = float((np.abs(psi) ** 2).max())
    try:
        from skimage.measure import marching_cubes
    except ModuleNotFoundError as error:
        message = 'surfaces of equal density need scikit-image: pip install "eip_scipy[surfaces]"'
        raise ImportError(message, name="skimage") from error
    for axis, n in enumerate(gpe.grid.shape):
        psi = scipy.signal.resample(psi, 2 * n, axis=axis)
    density = np.abs(psi) ** 2
    points, triangles, _, _ = marching_cubes(density, level)
    closed = scipy.ndimage.grey_closing(density, size=[*(2 * n + 1 for n in _core_size(gpe, top)), 1])
    filled = scipy.ndimage.gaussian_filter(closed, SMOOTH)
    around = scipy.ndimage.map_coordinates(filled, points[triangles].mean(axis=1).T, order=1)
    return Surface((gpe.grid.lower + 0.5 * gpe.grid.spacing * points)[triangles], around > DEEP * level)
