"""Osculating orbits of bodies: Keplerian elements of states and of whole runs."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from ...core.inputs import real_array, shown
from ...core.problem import Problem
from .bodies import bodies_of

__all__ = ["OrbitalElements", "elements_of", "orbital_elements"]

PRIMARIES = ("jacobi", "heliocentric", "barycentric")
# Below this inclination, or as near to pi, the node is all but undefined, and angles are measured from the x axis.
FLAT = 1e-8
# Below this eccentricity the eccentric anomaly follows from the true one: as e falls their difference is lost in
# rounding.
ROUND = 0.1
TURN = 2 * np.pi


@dataclass(frozen=True, eq=False)
class OrbitalElements:
    """Osculating elements of bodies; each array has the shape (bodies,) for one state, or (bodies, m) for m states.

    Attributes
    ----------
    bodies : tuple of str
        Names of the bodies that move on the orbits, in the order of the arrays.
    t : ndarray, shape (m,), or None
        Times of the states; None if the states have no times.
    a, e : ndarray
        Semi-major axis, negative for a hyperbola, and eccentricity.
    inc : ndarray
        Inclination to the plane of x and y, from 0 to pi. Angles are in radians.
    Omega, omega, pomega : ndarray
        Longitude of the ascending node, argument of the pericentre, and longitude of the pericentre, Omega + omega, or
        Omega - omega for a retrograde orbit; from 0 to 2 pi, as are the angles that follow.
    f, M : ndarray
        True anomaly and mean anomaly, n times the time since the pericentre. M of a hyperbola is not reduced to the
        range from 0 to 2 pi, unlike in REBOUND. NaN for a parabola.
    theta, l : ndarray
        True and mean longitude, Omega + omega + f and Omega + omega + M; for a retrograde orbit Omega - omega - f and
        Omega - omega - M.
    n, P : ndarray
        Mean motion in radians per unit of time, and period 2 pi / n; negative for a hyperbola, as in REBOUND.

    See Also
    --------
    orbital_elements

    Examples
    --------
    >>> from eip_scipy.problems import orbital_elements
    >>> found = orbital_elements([0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 1.1, 0], gm=[1, 0])
    >>> found.bodies, found.e.round(3), found.P.round(3)
    (('1',), array([0.21]), array([8.948]))
    """

    bodies: tuple[str, ...]
    t: np.ndarray | None
    a: np.ndarray
    e: np.ndarray
    inc: np.ndarray
    Omega: np.ndarray
    omega: np.ndarray
    pomega: np.ndarray
    f: np.ndarray
    M: np.ndarray
    theta: np.ndarray
    l: np.ndarray  # noqa: E741
    n: np.ndarray
    P: np.ndarray

    def __getitem__(self, body: str | int) -> OrbitalElements:
        """Return the elements of one body, given by its name or its index in `bodies`, as numbers or arrays (m,)."""
        if isinstance(body, str) and body not in self.bodies:
            raise KeyError(f"there is no orbit of {body!r}; the bodies with orbits are {', '.join(self.bodies)}.")
        k = self.bodies.index(body) if isinstance(body, str) else body
        names = [item.name for item in fields(self) if item.name not in ("bodies", "t")]
        return replace(self, bodies=(self.bodies[k],), **{name: getattr(self, name)[k] for name in names})


def orbital_elements(run: Any, gm: Any = None, *, primary: str | int = "jacobi") -> OrbitalElements:
    """Return the osculating orbital elements of the bodies of a state, or of all saved states of a run.

    Parameters
    ----------
    run : IntegrationResult or Problem or array_like, shape (6 N,) or (6 N, m)
        A run of bodies, a problem (its start), or states (q, v): positions of all bodies, then velocities. With `gm`
        also a result that was loaded, or one of `scipy.integrate.solve_ivp`.
    gm : array_like, shape (N,), optional
        G times the masses; default: those of the run's problem.
    primary : {"jacobi", "heliocentric", "barycentric"} or str or int
        The body or point that the orbits go around:

        - "jacobi": for each body the centre of mass of all bodies before it, with their mass; REBOUND's default;
        - "heliocentric": the first body;
        - "barycentric": the centre of mass of all, with the mass of all;
        - a body, by its name or number, for instance the Earth for the Moon.

    Returns
    -------
    OrbitalElements
        Elements of all bodies except the primary, in the conventions of REBOUND's ``Simulation.orbits()``. These
        conventions include hyperbolae and undefined angles: in the plane of reference the longitudes theta and pomega
        are measured from the x axis; on a circle only the sum of omega and f is meaningful. ``elements["Earth"].a``
        belongs to one body.

    Raises
    ------
    TypeError
        If masses are missing.
    ValueError
        If shapes do not fit, `primary` is unknown, or the primary has no mass.

    See Also
    --------
    nbody, OrbitalElements

    Notes
    -----
    The gravitational parameter of an orbit is G times the sum of the masses of body and primary.

    Near a circle, or near an orbit in the plane of reference, single angles lose digits, because the angles themselves
    are almost undefined: an error of 1e-16 of the state moves omega by 1e-16 / e. The sums of angles keep their digits.

    Examples
    --------
    >>> from eip_scipy import EIPRKN12, integrate
    >>> from eip_scipy.problems import orbital_elements, solar_system
    >>> run = integrate(solar_system(years=10), method=EIPRKN12, h=0.02, save_every=50)
    >>> elements = orbital_elements(run)
    >>> elements.a.shape, float(elements["Jupiter"].a[0].round(2))
    ((9, 11), 5.2)
    """
    state, t, masses, names = _read(run, gm)
    orbiting, centre, mu = _centre(state, masses, primary, names)
    bodies = tuple(names[k] for k in orbiting)
    return OrbitalElements(bodies, t, **elements_of(np.moveaxis(state[:, orbiting] - centre, 2, 1), mu))


def _read(run: Any, gm: Any) -> tuple[np.ndarray, np.ndarray | None, np.ndarray, tuple[str, ...]]:
    """Return the states (2, N, 3, ...), times, G m and names of the bodies, from arguments of `orbital_elements`."""
    y, t, names = run, None, None
    if isinstance(run, Problem):
        y = run.y0
    elif hasattr(run, "y") and hasattr(run, "t"):
        y, t, names = run.y, np.asarray(run.t, dtype=float), getattr(run, "component_names", None)
        gm = run.gm if gm is None and "gm" in run else gm
    elif gm is None and isinstance(run, (np.ndarray, list, tuple)):
        raise TypeError("orbital_elements: states alone have no masses; give gm, G times the mass of each body.")
    if gm is None:
        problem, gm, *_ = bodies_of(run)
        names = problem.component_names
    masses, y = real_array("gm", gm), real_array("y", y)
    n = masses.size
    if masses.ndim != 1 or n < 2 or y.ndim not in (1, 2) or y.shape[0] != 6 * n:
        raise ValueError(
            f"orbital_elements: gm has the shape {masses.shape} and the states {y.shape}; expected (N,) with N > 1, "
            "and (6 N,) or (6 N, m)."
        )
    labels = tuple(map(str, range(n)))
    if names is not None and len(names) == 6 * n and names[0].startswith("x_"):
        labels = tuple(name[2:] for name in names[: 3 * n : 3])
    return y.reshape(2, n, 3, *y.shape[1:]), t, masses, labels


def _centre(
    state: np.ndarray, gm: np.ndarray, primary: str | int, names: tuple[str, ...]
) -> tuple[list[int], np.ndarray, np.ndarray]:
    """Return the indices (k,) of the bodies with orbits, the centres (2, k or 1, 3, ...) and G m (k,) of these."""
    every, gm_of_rows = list(range(gm.size)), gm.reshape(-1, *[1] * (state.ndim - 2))
    if primary == "jacobi":
        if not gm[0] > 0:
            raise ValueError(
                f"orbital_elements: primary='jacobi' needs a first body with a mass, but its G m is {gm[0]!r}. "
                "Put a body with a mass first, or give another primary."
            )
        centres = np.cumsum(gm_of_rows * state, axis=1) / np.cumsum(gm_of_rows, axis=0)
        return every[1:], centres[:, :-1], np.cumsum(gm)[1:]
    if primary == "barycentric":
        total = gm.sum()
        return every, np.tensordot(gm / total, state, axes=(0, 1))[:, None], total + gm
    k: Any = 0 if primary == "heliocentric" else primary
    k = names.index(k) if k in names else k
    if isinstance(k, bool) or k not in every:
        raise ValueError(
            f"orbital_elements: unknown primary {shown(primary)}; expected one of {', '.join(map(repr, PRIMARIES))}, a "
            f"number from 0 to {gm.size - 1}, or one of the names {', '.join(names)}."
        )
    if gm[k] == 0:
        raise ValueError(
            f"orbital_elements: the primary {names[k]!r} has no mass, so nothing orbits it. Give another primary."
        )
    every.remove(k)
    return every, state[:, [k]], gm[k] + gm[every]


@np.errstate(divide="ignore", invalid="ignore", over="ignore")
def elements_of(state: np.ndarray, mu: np.ndarray) -> dict[str, np.ndarray]:
    """Return the elements (bodies, ...) of relative states (2, 3, bodies, ...) by their names in `OrbitalElements`."""
    q, v = state
    mu = mu.reshape(-1, *[1] * (q.ndim - 2))
    h = np.cross(q, v, axis=0) + 0.0  # adding 0 leaves no -0, whose arc tangent is pi
    r, level, size = np.sqrt((q * q).sum(axis=0)), np.hypot(h[0], h[1]), np.hypot(np.hypot(h[0], h[1]), h[2])
    v2, rv = (v * v).sum(axis=0), (q * v).sum(axis=0)
    a = mu / (2 * mu / r - v2)
    to_pericentre = ((v2 - mu / r) * q - rv * v) / mu
    e = np.sqrt((to_pericentre**2).sum(axis=0))
    n = np.copysign(np.sqrt(np.abs(mu / a**3)), a)
    inc = np.arctan2(level, h[2])
    Omega = np.arctan2(h[0], -h[1] + 0.0)  # along the node (-hy, hx, 0)
    flat = (inc < FLAT) | (inc > np.pi - FLAT)
    turns = np.where(inc < np.pi / 2, 1.0, -1.0)  # in which sense longitudes grow along the orbit

    def from_node(x: np.ndarray) -> np.ndarray:
        """Return the angle in the orbit from the node to x; in a flat orbit its sum with Omega is from the x axis."""
        along = h[0] * x[1] - h[1] * x[0] + 0.0
        # Product of h x node, (-hx hz, -hy hz, hx^2 + hy^2), with x, divided by h.
        across = np.where(size > 0, (level**2 * x[2] - h[2] * (h[0] * x[0] + h[1] * x[1])) / size, 0.0)
        return np.where(flat, turns * (np.arctan2(x[1], x[0]) - Omega), np.arctan2(across, along))

    position, pericentre = from_node(q), from_node(to_pericentre)
    f = position - pericentre
    M = _mean_anomaly(e, f, a, r, rv / np.sqrt(mu))
    angles = {
        "Omega": Omega,
        "omega": pericentre,
        "pomega": Omega + turns * pericentre,
        "f": f,
        "theta": Omega + turns * position,
        "l": Omega + turns * (pericentre + M),
    }
    angles = {name: angle % TURN for name, angle in angles.items()}
    return {"a": a, "e": e, "inc": inc, "M": M, "n": n, "P": TURN / n, **angles}


def _mean_anomaly(e: np.ndarray, f: np.ndarray, a: np.ndarray, r: np.ndarray, rv: np.ndarray) -> np.ndarray:
    """Return the mean anomaly, between 0 and 2 pi for an ellipse, NaN for a parabola; `rv` is q . v / sqrt(mu)."""
    sine, cosine = rv / np.sqrt(np.abs(a)), 1 - r / a  # e times those of the eccentric anomaly
    nearly = 2 * np.arctan2(np.sqrt(np.abs(1 - e)) * np.sin(f / 2), np.sqrt(1 + e) * np.cos(f / 2))
    anomaly = np.where(e < ROUND, nearly, np.arctan2(sine, cosine))
    hyperbola = sine - np.arcsinh(sine / e)
    return np.where(np.isfinite(a), np.where(a > 0, (anomaly - sine) % TURN, hyperbola), np.nan)
