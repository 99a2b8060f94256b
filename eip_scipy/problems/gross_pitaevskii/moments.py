"""Mass, energy and their gradients' products from psi and f = -i H psi alone: one pass over both, no transform."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from ..._octets import LANES, multiply_add
from .vectors import larger, load_pair, octets, spread, store_pair

__all__ = ["Moments", "expansion", "moments", "shifted", "total_mass"]

_jit = njit(cache=True, error_model="numpy", _nrt=False)

STEP = 2 * LANES  # floats of eight points


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
    peak : float
        Largest ``|psi|^2``; no sum.
    """

    mass: float
    along: float
    square: float
    quartic: float
    sizes: float
    peak: float

    def energy(self, beta: float) -> float:
        """The sum whose multiple by the cell is the energy: beta / 2 of `quartic` are counted twice in `along`."""
        return self.along - 0.5 * beta * self.quartic


@_jit
def fold(lanes):
    """The sum of eight lanes, in pairs."""
    return ((lanes[0] + lanes[4]) + (lanes[2] + lanes[6])) + ((lanes[1] + lanes[5]) + (lanes[3] + lanes[7]))


@_jit
def add_moments(psi, f, totals):
    """Gather the moments of (rows, floats) in `totals` (6, 8), row by row; the rest of a row goes to the first lane."""
    rows, width = psi.shape
    whole = width - width % STEP
    sums = octets(totals, 0)
    for r in range(rows):
        a, b = psi[r], f[r]
        mass = along = square = quartic = sizes = spread(0.0)
        for i in range(0, whole, STEP):
            x, y = load_pair(a, i)
            u, v = load_pair(b, i)
            n = multiply_add(x, x, y * y)
            first, second = y * u, x * v
            mass += n
            sums[5] = larger(sums[5], n)
            quartic = multiply_add(n, n, quartic)
            along += first - second
            sizes += abs(first) + abs(second)
            square += multiply_add(u, u, v * v)
        sums[0] += mass
        sums[1] += along
        sums[2] += square
        sums[3] += quartic
        sums[4] += sizes
        for i in range(whole, width, 2):
            x, y, u, v = a[i], a[i + 1], b[i], b[i + 1]
            n = x * x + y * y
            totals[0, 0] += n
            totals[1, 0] += y * u - x * v
            totals[2, 0] += u * u + v * v
            totals[3, 0] += n * n
            totals[4, 0] += abs(y * u) + abs(x * v)
            totals[5, 0] = max(totals[5, 0], n)


@_jit
def add_squares(psi, totals):
    """Add the sum of ``|psi|^2`` to `totals` (8), in the order of `add_moments`."""
    rows, width = psi.shape
    whole = width - width % STEP
    sums = octets(totals, 0)
    for r in range(rows):
        a = psi[r]
        mass = spread(0.0)
        for i in range(0, whole, STEP):
            x, y = load_pair(a, i)
            mass += multiply_add(x, x, y * y)
        sums[0] += mass
        for i in range(whole, width, 2):
            totals[0, 0] += a[i] * a[i] + a[i + 1] * a[i + 1]


@_jit
def add_expansion(psi, near, f, totals):
    """Add the sums of ``|d|^2`` and Re(conj(i f) d), d = psi - near, to `totals` (2, 8); all (rows, floats)."""
    rows, width = psi.shape
    whole = width - width % STEP
    sums = octets(totals, 0)
    for r in range(rows):
        a, b, c = psi[r], near[r], f[r]
        square = slope = spread(0.0)
        for i in range(0, whole, STEP):
            x, y = load_pair(a, i)
            p, q = load_pair(b, i)
            u, v = load_pair(c, i)
            x, y = x - p, y - q
            square += multiply_add(x, x, y * y)
            slope += y * u - x * v
        sums[0] += square
        sums[1] += slope
        for i in range(whole, width, 2):
            x, y = a[i] - b[i], a[i + 1] - b[i + 1]
            totals[0, 0] += x * x + y * y
            totals[1, 0] += y * c[i] - x * c[i + 1]


@_jit
def fill_shifted(psi, f, a, b, out, totals):
    """Out = psi + a psi + b i f, all (rows, floats); adds to `totals` (3, 8) as `shifted` returns them."""
    rows, width = psi.shape
    whole = width - width % STEP
    sums = octets(totals, 0)
    for r in range(rows):
        source, image, target = psi[r], f[r], out[r]
        mass = square = slope = spread(0.0)
        for i in range(0, whole, STEP):
            x, y = load_pair(source, i)
            u, v = load_pair(image, i)
            p = x + (a * x - b * v)
            q = y + (a * y + b * u)
            store_pair(p, q, target, i)
            mass += multiply_add(p, p, q * q)
            x, y = p - x, q - y
            square += multiply_add(x, x, y * y)
            slope += y * u - x * v
        sums[0] += mass
        sums[1] += square
        sums[2] += slope
        for i in range(whole, width, 2):
            x, y, u, v = source[i], source[i + 1], image[i], image[i + 1]
            p = x + (a * x - b * v)
            q = y + (a * y + b * u)
            target[i], target[i + 1] = p, q
            totals[0, 0] += p * p + q * q
            totals[1, 0] += (p - x) * (p - x) + (q - y) * (q - y)
            totals[2, 0] += (q - y) * u - (p - x) * v


def moments(psi: np.ndarray, f: np.ndarray) -> Moments:
    """The moments of a field and f there; both float views (rows, 2 m)."""
    totals = np.zeros((6, LANES))
    add_moments(psi, f, totals)
    mass, along, square, quartic, sizes = (float(fold(lanes)) for lanes in totals[:5])
    return Moments(mass, along, square, quartic, sizes, float(totals[5].max()))


def total_mass(psi: np.ndarray) -> float:
    """The moment `mass` alone, to the last bit."""
    totals = np.zeros((1, LANES))
    add_squares(psi, totals)
    return float(fold(totals[0]))


def expansion(psi: np.ndarray, near: np.ndarray, f: np.ndarray) -> tuple[float, float]:
    """Sums of ``|d|^2`` and Re(conj(i f) d) for d = psi - near; all (rows, 2 m)."""
    totals = np.zeros((2, LANES))
    add_expansion(psi, near, f, totals)
    return float(fold(totals[0])), float(fold(totals[1]))


def shifted(psi: np.ndarray, f: np.ndarray, a: float, b: float, out: np.ndarray) -> tuple[float, float, float]:
    """Fill out = psi + a psi + b H psi, all float views (rows, 2 m).

    Returns
    -------
    tuple of float
        Sums of ``|out|^2``, and of ``|d|^2`` and Re(conj(H psi) d) for the difference d from psi.
    """
    totals = np.zeros((3, LANES))
    fill_shifted(psi, f, a, b, out, totals)
    mass, square, slope = (float(fold(lanes)) for lanes in totals)
    return mass, square, slope
