"""How fast bodies move: what bounds the step of a multistep method."""

from __future__ import annotations

import numpy as np

__all__ = ["orbital_frequencies"]


def orbital_frequencies(gm: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, float]:
    """The largest angular frequency of each body on its orbit about the heaviest one, and that of all other pairs.

    Parameters
    ----------
    gm : ndarray, shape (N,)
    y : ndarray, shape (6 N,)
        Positions and velocities.

    Returns
    -------
    bodies : ndarray, shape (N,)
        0 for the heaviest body.
    others : float
        Of pairs that bind each other more than the heaviest body does, a planet and its moon.

    Notes
    -----
    From the osculating orbit. Between the mean motion n and the frequency in the pericentre, n (1 - e)^(-3/2), a
    multistep method's stability is that of their geometric mean: measured with Mercury, e = .2.
    """
    q, v = y.reshape(2, -1, 3)
    centre = int(np.argmax(gm))
    about = _frequencies(gm, q, v, centre)
    others = 0.0
    for i in range(gm.size):  # row by row: all pairs at once would take the memory of N^2 distances
        if i == centre:
            continue
        pair = _frequencies(gm, q, v, i)
        pair[[i, centre]] = 0.0
        distance = np.linalg.norm(q - q[i], axis=1)
        distance[i] = np.inf
        nearer = (gm + gm[i]) / distance**3 > (gm[centre] + gm[i]) / distance[centre] ** 3
        others = max(others, float(pair[nearer].max(initial=0.0)))
    return about, others


def _frequencies(gm: np.ndarray, q: np.ndarray, v: np.ndarray, i: int) -> np.ndarray:
    """Of the orbits of all bodies about body i."""
    r, u, mass = q - q[i], v - v[i], gm + gm[i]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.linalg.norm(r, axis=1)
        inverse_axis = 2 / distance - (u**2).sum(axis=1) / mass
        momentum = (np.cross(r, u) ** 2).sum(axis=1) / mass
        eccentricity = np.sqrt(np.maximum(0.0, 1 - momentum * inverse_axis))
        pericentre = momentum / (1 + eccentricity)
        fastest = np.sqrt(mass / pericentre**3)
        mean = np.sqrt(mass * np.maximum(inverse_axis, 0.0) ** 3)
        found = np.where(inverse_axis > 0, np.sqrt(mean * fastest), fastest)
    found[i] = 0.0
    return np.where((mass > 0) & ~np.isnan(found), found, 0.0)
