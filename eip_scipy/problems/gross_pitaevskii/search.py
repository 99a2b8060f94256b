"""Searches for the lowest stationary state, and their starts: Thomas-Fermi densities with vortices.

There are searches from several starts, and over windings for a condensate with a hole.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from math import cos, pi, sin, sqrt
from typing import Any

import numpy as np
from scipy.optimize import brentq

from .equation import GrossPitaevskii
from .ground_state import GroundState, Progress, ground_state

__all__ = [
    "imprint",
    "lowest_ring",
    "lowest_state",
    "polygon",
    "ring_start",
    "thomas_fermi",
    "vortex_starts",
    "with_noise",
]

NOISE = 0.05  # of a start's amplitude: enough to leave a symmetry at once


def thomas_fermi(gpe: GrossPitaevskii) -> np.ndarray:
    """Return the Thomas-Fermi density of mass 1, (mu - V + Omega^2 r^2 / 2) / beta where this is positive, and else 0.

    Parameters
    ----------
    gpe : GrossPitaevskii
        An equation with beta > 0 and a trap that confines the condensate in spite of the rotation.

    Returns
    -------
    ndarray, shape (J[, K[, L]])

    Raises
    ------
    ValueError
        If beta is not positive, or the density reaches the ends of the box.
    """
    if not gpe.beta > 0:
        raise ValueError(
            f"a Thomas-Fermi density needs beta > 0, got {gpe.beta:g}; call ground_state with a start of your own."
        )
    r2 = sum(a**2 for a in gpe.grid.mesh()[:2]) if gpe.Omega else 0.0
    well = gpe.V - 0.5 * gpe.Omega**2 * r2
    cell, low = gpe.grid.cell, float(well.min())

    def excess(mu: float) -> float:
        return cell * float(np.maximum(mu - well, 0.0).sum()) / gpe.beta - 1.0

    volume = cell * gpe.grid.size
    mu = brentq(excess, low, float(well.max()) + gpe.beta / volume, xtol=1e-12)
    density = np.maximum(mu - well, 0.0) / gpe.beta
    if any(np.any(np.take(density, 0, axis=axis)) for axis in range(gpe.grid.dim)):
        raise ValueError("the condensate does not fit into the box of the grid: enlarge the box, or lower Omega.")
    return density


def imprint(gpe: GrossPitaevskii, positions: Any) -> np.ndarray:
    """Return the Thomas-Fermi amplitude with singly charged vortices, which are lines along z in three dimensions.

    Parameters
    ----------
    gpe : GrossPitaevskii
        An equation in two or three dimensions.
    positions : array_like, shape (k, 2)
        x and y of each vortex.

    Returns
    -------
    ndarray, shape (J, K[, L])
        A field of mass near 1.
    """
    density = thomas_fermi(gpe)
    x, y, *_ = gpe.grid.mesh()
    psi = np.sqrt(density).astype(complex)
    core2 = 1 / (2 * gpe.beta * float(density.max()))  # the square of the healing length
    for a, b in np.asarray(positions, dtype=float).reshape(-1, 2):
        z = (x - a) + 1j * (y - b)
        psi *= z / np.sqrt(np.abs(z) ** 2 + core2)
    return psi


def polygon(count: int, radius: float) -> np.ndarray:
    """Return the corners (count, 2) of a regular polygon about the origin, the first on the x axis."""
    angle = 2 * pi * np.arange(count) / max(count, 1)
    return radius * np.column_stack([np.cos(angle), np.sin(angle)])


def ring_start(gpe: GrossPitaevskii, count: int, winding: int) -> np.ndarray:
    """Return the Thomas-Fermi amplitude of a ring with vortices at equal distances on its mean circle.

    The radius of the circle is the root of `mean_square_radius`.

    Parameters
    ----------
    gpe : GrossPitaevskii
        An equation whose Thomas-Fermi density has a hole.
    count, winding : int
        Number of vortices on the circle, and winding number of the phase inside the circle.

    Returns
    -------
    ndarray, shape (J, K[, L])
    """
    psi = imprint(gpe, polygon(count, sqrt(mean_square_radius(gpe))))
    x, y, *_ = gpe.grid.mesh()
    return psi * np.exp(1j * winding * np.arctan2(y, x))


def mean_square_radius(gpe: GrossPitaevskii) -> float:
    """Return the mean of x^2 + y^2 over the Thomas-Fermi density."""
    density = thomas_fermi(gpe)
    x, y, *_ = gpe.grid.mesh()
    return float(((x**2 + y**2) * density).sum() / density.sum())


def with_noise(psi: np.ndarray, rng: np.random.Generator, size: float = NOISE) -> np.ndarray:
    """Return `psi` plus complex noise of `size` times the modulus at each point, so that the field has no symmetry."""
    noise = rng.standard_normal((2, *psi.shape))
    return psi + size * np.abs(psi) * (noise[0] + 1j * noise[1])


def vortex_starts(gpe: GrossPitaevskii, count: int, seed: int = 0) -> Iterator[np.ndarray]:
    """Yield fields with triangular lattices of vortices, turned, shifted and stretched at random, with some noise.

    A condensate that turns as a rigid body has Omega / pi vortices per unit area; the lattices have 0.6 to 1.2 times
    as many, over the whole condensate and any hole in it. Without rotation (`Omega` = 0) the fields have no vortices.

    Parameters
    ----------
    gpe : GrossPitaevskii
    count : int
        Number of fields.
    seed : int, optional
        Seed of the random numbers.

    Yields
    ------
    ndarray, shape (J[, K[, L]])
    """
    rng = np.random.default_rng(seed)
    amplitude = np.sqrt(thomas_fermi(gpe))
    for _ in range(count):
        psi = amplitude.astype(complex)
        if gpe.Omega:
            psi = imprint(gpe, _lattice(gpe, amplitude, rng))
        yield with_noise(psi, rng)


def _lattice(gpe: GrossPitaevskii, amplitude: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the points (k, 2) of a random triangular lattice within the outer radius of the condensate."""
    x, y, *_ = gpe.grid.mesh()
    radius = sqrt(float(np.max((x**2 + y**2) * (amplitude > 0))))
    area = pi / abs(gpe.Omega) / rng.uniform(0.6, 1.2)
    side, angle = sqrt(2 * area / sqrt(3.0)), rng.uniform(0, pi / 3)
    reach = int(2 * radius / side) + 2
    i, j = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1) + rng.uniform(size=(2, 1))
    a, b = side * (i + 0.5 * j), side * sqrt(0.75) * j
    points = np.column_stack([cos(angle) * a - sin(angle) * b, sin(angle) * a + cos(angle) * b])
    return points[np.hypot(*points.T) < radius]


WALK_TOLERANCE, WALK_ITERATIONS = 1e-3, 150
NEIGHBOURS = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, -1), (-1, 1))
# Part of the vortices of a rigid rotation that a single row in the ring holds: only where the walk starts.
ROW = 0.4
BREAK_SYMMETRY = 1e-3


def lowest_state(
    gpe: GrossPitaevskii,
    starts: Iterable[Any],
    *,
    tol: float = 1e-8,
    max_iterations: int = 10_000,
    progress: Progress | None = None,
) -> list[GroundState]:
    """Search for the lowest state from several starts.

    Parameters
    ----------
    gpe : GrossPitaevskii
    starts : iterable of array_like
        See `vortex_starts` and `imprint`.
    tol, max_iterations, progress
        See `ground_state`.

    Returns
    -------
    list of GroundState
        States in the order of the starts. The lowest energy is an upper bound for that of the ground state.
    """
    return [ground_state(gpe, s, tol=tol, max_iterations=max_iterations, progress=progress) for s in starts]


def lowest_ring(
    gpe: GrossPitaevskii,
    *,
    tol: float = 1e-8,
    max_iterations: int = 10_000,
    seed: int = 0,
    progress: Progress | None = None,
    report: Callable[[int, int, float], Any] | None = None,
) -> GroundState:
    """Search for the lowest state of a condensate with a hole that has one row of vortices around the hole.

    The search is over the number of vortices and the winding number of the phase around the hole.

    Parameters
    ----------
    gpe : GrossPitaevskii
        An equation whose Thomas-Fermi density has a hole.
    tol, max_iterations, progress
        Arguments of the last search, see `ground_state`.
    seed : int, optional
        Seed of the noise that breaks the symmetry of the best state before the last search.
    report : callable, optional
        ``report(count, winding, energy)``, called for each pair of a number of vortices and a winding number that is
        tried.

    Returns
    -------
    GroundState

    Raises
    ------
    ValueError
        If the condensate has no hole, or its hole is narrower than the grid resolves.

    Notes
    -----
    No descent leads from a state to one with another winding. Therefore short searches are made from starts with pairs
    (count, winding): from each pair the search goes on to its neighbour of lowest energy, until no neighbour is lower.
    The last search starts from the best state with noise.
    """
    density = thomas_fermi(gpe)
    x, y, *_ = gpe.grid.mesh()
    r2 = (x**2 + y**2)[density > 0] if gpe.grid.dim == 2 else (x**2 + y**2 + 0 * density)[density > 0]
    if not r2.min() > (4 * gpe.grid.spacing[:2].max()) ** 2:
        raise ValueError(
            "the condensate has no hole with a radius above 4 grid spacings; use lowest_state, or a finer grid if "
            "the hole is narrow."
        )
    count = round(ROW * abs(gpe.Omega) * (r2.max() - r2.min()))
    here = count, round(abs(gpe.Omega) * mean_square_radius(gpe) - count / 2)
    found: dict[tuple[int, int], GroundState] = {}

    def energy(pair: tuple[int, int]) -> float:
        if pair not in found:
            start = ring_start(gpe, *pair)
            found[pair] = ground_state(gpe, start, tol=WALK_TOLERANCE, max_iterations=WALK_ITERATIONS)
            if report is not None:
                report(*pair, found[pair].energy)
        return found[pair].energy

    while True:
        best = min([here, *((here[0] + a, here[1] + b) for a, b in NEIGHBOURS)], key=energy)
        if best == here:
            break
        here = best
    start = with_noise(found[here].psi, np.random.default_rng(seed), BREAK_SYMMETRY)
    return ground_state(gpe, start, tol=tol, max_iterations=max_iterations, progress=progress)
