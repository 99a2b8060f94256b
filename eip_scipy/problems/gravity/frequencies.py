"""Frequencies of bodies, which limit the step of a multistep method."""

from __future__ import annotations

import numpy as np

from ...engine.native import BUILD

__all__ = ["orbital_frequencies"]


def orbital_frequencies(gm: np.ndarray, y: np.ndarray, duration: float = np.inf) -> tuple[np.ndarray, float]:
    """Return the largest angular frequency of each orbit about the heaviest body, and that of all other pairs.

    Parameters
    ----------
    gm : ndarray, shape (N,)
    y : ndarray, shape (6 N,)
        Positions and velocities.
    duration : float
        Length of the run, negative if it goes back in time.

    Returns
    -------
    bodies : ndarray, shape (N,)
        0 for the heaviest body.
    others : float
        Frequencies of pairs that bind each other more than the heaviest body does, such as a planet and its moon.

    Notes
    -----
    From the osculating orbit. Between the mean motion n and the frequency in the pericentre, n (1 - e)^(-3/2), a
    multistep method's stability is that of their geometric mean: measured with Mercury, e = 0.2. If a bound pair does
    not reach its pericentre within the run, its distance at the end takes the place of the pericentre. A pair has no
    such orbit if the others change its motion more than its own attraction does, and no pericentre to come if it flies
    apart for good: then the frequency is that at the present distance. So the frequency of a pair without angular
    momentum is finite.
    """
    bodies, others = BUILD.gravity.frequencies(gm, y, duration)
    return bodies, others
