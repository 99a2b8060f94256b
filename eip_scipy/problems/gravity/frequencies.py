"""Frequencies of orbits, which bound the steps of multistep methods."""

from __future__ import annotations

import numpy as np

from ...engine.native import library
from .orbital_elements import elements_of

__all__ = ["orbital_frequencies"]

Array = np.ndarray
# Least pericentre, in units of a pair's present distance: nearer, a radial orbit ends in a collision or is perturbed.
LEAST_PERICENTRE = 1e-3
# Least eccentricity of a pair whose time to the pericentre is considered, and halvings that solve Kepler's equation.
LEAST_ECCENTRICITY, HALVINGS = 0.5, 30


def orbital_frequencies(gm: Array, y: Array, duration: float = np.inf) -> tuple[Array, float]:
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
    n, centre, f = len(gm), int(np.argmax(gm)), np.empty_like(y)
    library["gravity.rhs"](0.0, y, f, gm)
    bodies = np.concatenate([y, f[3 * n :]]).reshape(3, n, 3)  # positions, velocities, accelerations

    def binding(k: int) -> Array:
        return (gm + gm[k]) / np.linalg.norm(bodies[0] - bodies[0, k], axis=1) ** 3

    with np.errstate(all="ignore"):  # of a body and itself, and of massless pairs
        about, others = _of_pairs(gm + gm[centre], bodies - bodies[:, [centre]], duration), 0.0
        to_centre = binding(centre)
        for i in range(n):
            near = binding(i) > to_centre
            near[[i, centre]] = False
            if i != centre and near.any():
                pairs = _of_pairs(gm[near] + gm[i], bodies[:, near] - bodies[:, [i]], duration)
                others = max(others, float(pairs.max()))
    about[centre] = 0.0
    return about, others


def _of_pairs(mass: Array, relative: Array, duration: float) -> Array:
    """Return the frequencies (k,) of pairs of this `mass`, with relative positions, velocities and pulls (3, k, 3)."""
    r, u, pull = relative
    orbit = elements_of(np.moveaxis(relative[:2], 2, 1), mass)
    distance, bound = np.linalg.norm(r, axis=1), orbit["n"] > 0.0
    pericentre = np.maximum(orbit["a"] * (1.0 - orbit["e"]), LEAST_PERICENTRE * distance)
    least = np.where(bound, _least_distances(orbit, distance, duration), 0.0)
    fastest = np.sqrt(mass / np.maximum(pericentre, least) ** 3)
    own = mass / distance**3
    alone = np.linalg.norm(pull + own[:, None] * r, axis=1) < mass / distance**2
    comes_back = bound | ~(np.sum(r * u, axis=1) > 0.0)
    of_orbit = np.where(bound, np.sqrt(orbit["n"] * fastest), fastest)
    found = np.where(alone & comes_back, of_orbit, np.sqrt(own))
    return np.where((mass > 0.0) & ~np.isnan(found), found, 0.0)


def _least_distances(orbit: dict[str, Array], distance: Array, duration: float) -> Array:
    """Return the least distances (k,) in the run of ellipses whose pericentre comes after its end, 0 for others."""
    a, e, M = orbit["a"], orbit["e"], orbit["M"]
    left = (2 * np.pi - M if duration > 0 else M) - abs(duration) * orbit["n"]  # the mean anomaly
    wanted = np.minimum(left, 2 * np.pi - left)  # the same distance before and after the apocentre
    later = (e > LEAST_ECCENTRICITY) & (left > 0.0)  # circles have no pericentre to wait for
    low, high = np.zeros_like(a), np.full_like(a, np.pi)
    for _ in range(HALVINGS if later.any() else 0):  # of Kepler's equation
        middle = 0.5 * (low + high)
        below = middle - e * np.sin(middle) < wanted
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return np.where(later, np.minimum(distance, a * (1.0 - e * np.cos(low))), 0.0)
