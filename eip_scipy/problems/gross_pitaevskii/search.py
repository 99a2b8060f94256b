"""Searches for the lowest stationary state: from several starts, and over windings for a condensate with a hole."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from .equation import GrossPitaevskii
from .ground_state import GroundState, Progress, ground_state
from .starts import mean_square_radius, ring_start, thomas_fermi, with_noise

__all__ = ["lowest_ring", "lowest_state"]

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
