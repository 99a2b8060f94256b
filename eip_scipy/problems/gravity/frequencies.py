"""Angular frequencies of orbits, which limit the step of a multistep method."""

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
        Frequency of the orbit of each body about the heaviest body; 0 for the heaviest body.
    others : float
        Largest frequency of pairs that bind each other more than the heaviest body does, such as a planet and its moon;
        0 without such pairs.

    Notes
    -----
    The frequency of a bound pair is computed from its osculating orbit. It is the geometric mean of the mean motion n
    and the frequency in the pericentre, n (1 - e)^(-3/2), because this mean determines the stability of a multistep
    method, as was measured with Mercury (e = 0.2). If a bound pair does not reach its pericentre within the run, its
    distance at the end takes the place of the pericentre. If other bodies change the motion of a pair more than its own
    attraction does, or if the pair flies apart for good, the frequency is that of its attraction at the present
    distance. Therefore the frequency of a pair without angular momentum is finite.
    """
    bodies, others = BUILD.gravity.frequencies(gm, y, duration)
    return bodies, others
