"""Surfaces of equal density in three dimensions, with the parts that are tubes around vortex lines marked."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy  # its parts load when they are used: scipy.signal, with statistics behind it, would take 0.9 s here

from .equation import GrossPitaevskii
from .vortices import core_size

__all__ = ["Surface", "density_surface"]

DEEP = 2.0  # a point is inside if the density with filled cores exceeds that of the surface by this factor
SMOOTH = 2.0  # points, for an edge without teeth


class Surface(NamedTuple):
    """A surface of triangles.

    Attributes
    ----------
    corners : ndarray, shape (m, 3, 3)
        x, y and z of the three corners of each triangle.
    inside : ndarray of bool, shape (m,)
        True if the triangle lies inside the condensate. It is then part of a tube around a vortex line.
    """

    corners: np.ndarray
    inside: np.ndarray


def density_surface(gpe: GrossPitaevskii, psi: Any, level: float) -> Surface:
    """Return the surface on which ``|psi|^2`` has a given value, by marching cubes (Lewiner et al. 2003, scikit-image).

    Parameters
    ----------
    gpe : GrossPitaevskii
        An equation in three dimensions.
    psi : array_like
        A field or flat state that is 0 at the ends of the box. It is interpolated to twice as many points on each axis.
    level : float
        The value of the density on the surface, between 0 and the largest density.

    Returns
    -------
    Surface

    Raises
    ------
    ValueError
        If the grid has one or two dimensions, or the density does not reach the level.
    ImportError
        If scikit-image is not installed.
    """
    if gpe.grid.dim != 3:
        raise ValueError(f"a surface needs three dimensions, got {gpe.grid!r}.")
    psi = gpe.as_field(psi)
    top = float((np.abs(psi) ** 2).max())
    if not 0 < level < top:
        raise ValueError(f"level must be between 0 and the largest density {top:.3g}, got {level!r}.")
    try:
        from skimage.measure import marching_cubes
    except ModuleNotFoundError as error:
        message = 'surfaces of equal density need scikit-image: pip install "eip_scipy[surfaces]"'
        raise ImportError(message, name="skimage") from error
    for axis, n in enumerate(gpe.grid.shape):
        psi = scipy.signal.resample(psi, 2 * n, axis=axis)
    density = np.abs(psi) ** 2
    points, triangles, _, _ = marching_cubes(density, level)
    closed = scipy.ndimage.grey_closing(density, size=[*(2 * n + 1 for n in core_size(gpe, top)), 1])
    filled = scipy.ndimage.gaussian_filter(closed, SMOOTH)
    around = scipy.ndimage.map_coordinates(filled, points[triangles].mean(axis=1).T, order=1)
    return Surface((gpe.grid.lower + 0.5 * gpe.grid.spacing * points)[triangles], around > DEEP * level)
