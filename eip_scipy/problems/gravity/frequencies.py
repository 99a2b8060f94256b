"""Angular frequencies of orbits, which limit the step of a multistep method."""

from __future__ import annotations

import numpy as np

from ...engine.native import BUILD

__all__ = ["orbital_frequencies"]


def orbital_frequencies(gm: np.ndarray, y: np.ndarray, duration: float = np.inf) -> tuple[np.ndarray, float]:
    """Return an angular frequency for each orbit about the heaviest body, and the largest one of the other pairs.

    `gm` (N,) are G times the masses, `y` (6 N,) positions and velocities, and `duration` is the length of the run,
    negative if it goes back in time. The frequencies (N,) are in radians per unit of time, 0 for the heaviest body. The
    other pairs are those, such as a planet and its moon, for which the sum of both G m divided by the cube of the
    distance is larger than it is for the heaviest body and one body of the pair; without such pairs the second result
    is 0.

    The frequency of a bound pair is computed from its osculating orbit. It is the geometric mean of the mean motion n
    and the frequency in the pericentre, n (1 - e)^(-3/2), because this mean determines the stability of a multistep
    method, as was measured with Mercury (e = 0.2). If the eccentricity of a bound pair is above 0.5, and the pair does
    not reach its pericentre within the run, its least distance within the run takes the place of the pericentre. If
    other bodies change the motion of a pair more than its own attraction does, or if the pair flies apart for good, the
    frequency is that of its attraction at the present distance. Therefore the frequency of a pair without angular
    momentum is finite.
    """
    bodies, others = BUILD.gravity.frequencies(gm, y, duration)
    return bodies, others
