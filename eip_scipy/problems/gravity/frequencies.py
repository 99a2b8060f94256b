"""How fast bodies move: what bounds the step of a multistep method."""

from __future__ import annotations

import numpy as np

from ...engine.native import library

__all__ = ["orbital_frequencies"]

# Least pericentre, in units of a pair's present distance: nearer, a radial orbit ends in a collision or is perturbed.
LEAST_PERICENTRE = 1e-3
# Least eccentricity of a pair whose time to the pericentre is looked at, and halvings that solve Kepler's equation.
LEAST_ECCENTRICITY, HALVINGS = 0.5, 30
PAIRS = 2**15  # that are looked at at once: all of them would take the memory of N^2 distances


def orbital_frequencies(gm: np.ndarray, y: np.ndarray, duration: float = np.inf) -> tuple[np.ndarray, float]:
    """The largest angular frequency of each body on its orbit about the heaviest one, and that of all other pairs.

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
        Of pairs that bind each other more than the heaviest body does, a planet and its moon.

    Notes
    -----
    From the osculating orbit. Between the mean motion n and the frequency in the pericentre, n (1 - e)^(-3/2), a
    multistep method's stability is that of their geometric mean: measured with Mercury, e = 0.2. If a bound pair does
    not reach its pericentre within the run, its distance at the end takes the place of the pericentre. A pair has no
    such orbit if the others change its motion more than its own attraction does, and no pericentre to come if it flies
    apart for good: then the frequency is that at the present distance. So the frequency of a pair without angular
    momentum is finite.
    """
    q, v = y.reshape(2, -1, 3)
    pulls = library["gravity.acc"](0.0, q.ravel(), gm).reshape(-1, 3)
    centre = int(np.argmax(gm))
    about = _frequencies(gm, q, v, pulls, np.array([centre]), duration)[0]
    others = 0.0
    rows = max(1, PAIRS // gm.size)
    for first in range(0, gm.size, rows):
        bodies = np.arange(first, min(first + rows, gm.size))
        here = np.arange(bodies.size)
        pairs = _frequencies(gm, q, v, pulls, bodies, duration)
        pairs[:, centre] = pairs[bodies == centre] = 0.0
        distance = np.linalg.norm(q - q[bodies, None], axis=2)
        to_centre = distance[:, centre].copy()
        distance[here, bodies] = to_centre[bodies == centre] = np.inf
        mass = gm[bodies]
        with np.errstate(divide="ignore"):  # two bodies at the same place are reported with the accelerations
            nearer = (gm + mass[:, None]) / distance**3 > ((gm[centre] + mass) / to_centre**3)[:, None]
        others = max(others, float(pairs[nearer].max(initial=0.0)))
    return about, others


def _frequencies(
    gm: np.ndarray, q: np.ndarray, v: np.ndarray, pulls: np.ndarray, bodies: np.ndarray, duration: float
) -> np.ndarray:
    """Return the frequencies of the orbits of all bodies about each of `bodies`, a row for each of these."""
    r, u, mass = q - q[bodies, None], v - v[bodies, None], gm + gm[bodies, None]
    (x, y, z), (vx, vy, vz) = r.T, u.T
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.sqrt(x * x + y * y + z * z).T
        inverse_axis = 2 / distance - (vx * vx + vy * vy + vz * vz).T / mass
        momentum = ((y * vz - z * vy) ** 2 + (z * vx - x * vz) ** 2 + (x * vy - y * vx) ** 2).T / mass
        eccentricity = np.sqrt(np.maximum(0.0, 1 - momentum * inverse_axis))
        pericentre = np.maximum(momentum / (1 + eccentricity), LEAST_PERICENTRE * distance)
        approaches = (x * vx + y * vy + z * vz).T * np.sign(duration) < 0
        nearest = _nearest(distance, inverse_axis, eccentricity, mass, approaches, abs(duration))
        fastest = np.sqrt(mass / np.maximum(pericentre, nearest) ** 3)
        mean = np.sqrt(mass * np.maximum(inverse_axis, 0.0) ** 3)
        here = np.sqrt(mass / distance**3)
        attraction = mass / distance**2
        others = pulls - pulls[bodies, None] + (mass / distance**3)[:, :, None] * r
        alone = np.sqrt((others**2).sum(axis=2)) < attraction
        bound = inverse_axis > 0
        apart = ~bound & ((x * vx + y * vy + z * vz).T > 0)
        found = np.where(bound, np.sqrt(mean * fastest), fastest)
        found = np.where(alone & ~apart, found, here)
    found[np.arange(bodies.size), bodies] = 0.0
    return np.where((mass > 0) & ~np.isnan(found), found, 0.0)


def _nearest(
    distance: np.ndarray,
    inverse_axis: np.ndarray,
    eccentricity: np.ndarray,
    mass: np.ndarray,
    approaches: np.ndarray,
    duration: float,
) -> np.ndarray:
    """Return the least distance within the run of bound pairs whose pericentre comes later than its end, else 0."""
    out = np.zeros_like(distance)
    # Circles have no pericentre to wait for.
    pairs = (inverse_axis > 0) & (eccentricity > LEAST_ECCENTRICITY) & (mass > 0) & np.isfinite(distance)
    if not (np.isfinite(duration) and pairs.any()):
        return out
    a, e, r = 1 / inverse_axis[pairs], eccentricity[pairs], distance[pairs]
    anomaly = np.arccos(np.clip((1 - r / a) / e, -1.0, 1.0))
    to_pericentre = anomaly - e * np.sin(anomaly)  # the mean anomaly left
    to_pericentre = np.where(approaches[pairs], to_pericentre, 2 * np.pi - to_pericentre)
    left = to_pericentre - duration * np.sqrt(mass[pairs] / a**3)
    low, high = np.zeros_like(left), np.full_like(left, np.pi)
    wanted = np.minimum(left, 2 * np.pi - left)  # the same distance before and after the apocentre
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        before = middle - e * np.sin(middle) < wanted
        low, high = np.where(before, middle, low), np.where(before, high, middle)
    out[pairs] = np.where(left > 0, np.minimum(r, a * (1 - e * np.cos(low))), 0.0)
    return out
