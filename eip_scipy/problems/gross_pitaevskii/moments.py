"""Mass, energy and their gradients' products from psi and f = -i H psi alone: one pass over both, no transform."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...engine.caching import cached_njit

__all__ = ["Moments", "expansion", "moments", "shifted", "total_mass"]

# Sums in the order that suits the processor's vectors; called from Python only, so that they have one order each.
_jit = cached_njit(error_model="numpy", fastmath={"reassoc", "contract", "nsz"})


class Moments(NamedTuple):
    """Sums over the grid.

    Attributes
    ----------
    mass : float
        Of ``|psi|^2``.
    along : float
        Of Re(conj(psi) H psi).
    square : float
        Of ``|H psi|^2``.
    quartic : float
        Of ``|psi|^4``.
    sizes : float
        Of the terms of `along`, without their signs.
    """

    mass: float
    along: float
    square: float
    quartic: float
    sizes: float

    def energy(self, beta: float) -> float:
        """The sum whose multiple by the cell is the energy: beta / 2 of `quartic` are counted twice in `along`."""
        return self.along - 0.5 * beta * self.quartic


def moments(psi: np.ndarray, f: np.ndarray) -> Moments:
    """The moments of a field and f there; both float views (rows, 2 m)."""
    return Moments(*_moments(psi, f))


@_jit
def _moments(psi, f):
    mass = along = square = quartic = sizes = 0.0
    for r in range(psi.shape[0]):
        a, b = psi[r], f[r]
        row_mass = row_along = row_square = row_quartic = row_sizes = 0.0
        for i in range(a.size // 2):
            x, y, u, v = a[2 * i], a[2 * i + 1], b[2 * i], b[2 * i + 1]
            n = x * x + y * y
            first, second = y * u, x * v
            row_mass += n
            row_quartic += n * n
            row_along += first - second
            row_sizes += abs(first) + abs(second)
            row_square += u * u + v * v
        mass += row_mass
        along += row_along
        square += row_square
        quartic += row_quartic
        sizes += row_sizes
    return mass, along, square, quartic, sizes


@_jit
def total_mass(psi):
    """The moment `mass` alone."""
    mass = 0.0
    for r in range(psi.shape[0]):
        row, part = psi[r], 0.0
        for i in range(row.size):
            part += row[i] * row[i]
        mass += part
    return mass


@_jit
def expansion(psi, near, f):
    """Sums of ``|d|^2`` and Re(conj(i f) d) for d = psi - near; all float views (rows, 2 m)."""
    square = slope = 0.0
    for r in range(psi.shape[0]):
        a, b, c = psi[r], near[r], f[r]
        row_square = row_slope = 0.0
        for i in range(a.size // 2):
            x, y = a[2 * i] - b[2 * i], a[2 * i + 1] - b[2 * i + 1]
            row_square += x * x + y * y
            row_slope += y * c[2 * i] - x * c[2 * i + 1]
        square += row_square
        slope += row_slope
    return square, slope


@_jit
def shifted(psi, f, a, b, out):
    """Fill out = psi + a psi + b i f, all float views (rows, 2 m).

    Returns the sums of ``|out|^2``, and of ``|d|^2`` and Re(conj(i f) d) for the difference d from psi.
    """
    mass = square = slope = 0.0
    for r in range(psi.shape[0]):
        source, image, target = psi[r], f[r], out[r]
        row_mass = row_square = row_slope = 0.0
        for i in range(source.size // 2):
            x, y, u, v = source[2 * i], source[2 * i + 1], image[2 * i], image[2 * i + 1]
            p = a * x - b * v
            q = a * y + b * u
            x, y = x + p, y + q
            target[2 * i], target[2 * i + 1] = x, y
            row_mass += x * x + y * y
            row_square += p * p + q * q
            row_slope += q * u - p * v
        mass += row_mass
        square += row_square
        slope += row_slope
    return mass, square, slope
