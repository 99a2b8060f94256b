"""Osculating orbits of bodies: Keplerian elements of states and of whole runs."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from ...core.inputs import real_array, shown
from ...core.problem import Problem
from .bodies import bodies_of

__all__ = ["OrbitalElements", "orbital_elements"]

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
    a : ndarray
        Semi-major axis, negative for a hyperbola.
    e : ndarray
        Eccentricity.
    inc : ndarray
        Inclination to the plane of x and y, from 0 to pi. Angles are in radians.
    Omega : ndarray
        Longitude of the ascending node, from 0 to 2 pi, as are the angles that follow.
    omega : ndarray
        Argument of the pericentre.
    pomega : ndarray
        Longitude of the pericentre, Omega + omega; for a retrograde orbit Omega - omega.
    f : ndarray
        True anomaly.
    M : ndarray
        Mean anomaly, n times the time since the pericentre. For a hyperbola it is not reduced to the range from 0 to
        2 pi, unlike in REBOUND. NaN for a parabola.
    theta : ndarray
        True longitude, Omega + omega + f; for a retrograde orbit Omega - omega - f.
    l : ndarray
        Mean longitude, Omega + omega + M; for a retrograde orbit Omega - omega - M.
    n : ndarray
        Mean motion in radians per unit of time; negative for a hyperbola, as in REBOUND.
    P : ndarray
        Period, 2 pi / n; negative for a hyperbola.
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

    Notes
    -----
    The gravitational parameter of an orbit is G times the sum of the masses of body and primary.

    Near a circle, or near an orbit in the plane of reference, single angles lose digits, because the angles themselves
    are almost undefined: an error of 1e-16 of the state moves omega by 1e-16 / e. The sums of angles keep their digits.
    Angles are computed by arc tangents of two components. Therefore angles near 0 and pi do not lose half of their
    digits, as they would with an arc cosine.

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
    if primary == "jacobi":
        relative, mu = _jacobi(state, masses)
        orbiting = list(range(1, len(names)))
    else:
        relative, mu, orbiting = _around(state, masses, primary, names)
    return OrbitalElements(tuple(names[k] for k in orbiting), t, **_elements(relative, mu))


def _read(run: Any, gm: Any) -> tuple[np.ndarray, np.ndarray | None, np.ndarray, tuple[str, ...]]:
    """Return the states (2, N, 3, ...), times, G m and names of the bodies, from arguments of `orbital_elements`."""
    t, names = None, None
    if hasattr(run, "y") and hasattr(run, "t"):
        y, t, names = run.y, np.asarray(run.t, dtype=float), getattr(run, "component_names", None)
        gm = run.gm if gm is None and "gm" in run else gm
    else:
        y = run.y0 if isinstance(run, Problem) else run
    if gm is None:
        bodies = bodies_of(run) if not isinstance(run, (np.ndarray, list, tuple)) else None
        if bodies is None:
            raise TypeError("orbital_elements: states alone have no masses; give gm, G times the mass of each body.")
        gm, names = bodies.gm, bodies.problem.component_names
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


def _jacobi(state: np.ndarray, gm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the states relative to the centre of mass of all bodies before each body, and G m of all up to it."""
    if not gm[0] > 0:
        raise ValueError(
            f"orbital_elements: primary='jacobi' needs a first body with a mass, but its G m is {gm[0]!r}. "
            "Put a body with a mass first, or give another primary."
        )
    total = np.cumsum(gm)
    weighted = gm.reshape(-1, 1, *[1] * (state.ndim - 3)) * state
    centres = np.cumsum(weighted, axis=1) / total.reshape(-1, 1, *[1] * (state.ndim - 3))
    return state[:, 1:] - centres[:, :-1], total[1:]


def _around(
    state: np.ndarray, gm: np.ndarray, primary: str | int, names: tuple[str, ...]
) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Return the states relative to `primary`, the gravitational parameters, and the indices of the orbiting bodies."""
    every = list(range(gm.size))
    if primary == "barycentric":
        total = gm.sum()
        return state - (np.tensordot(gm / total, state, axes=(0, 1)))[:, None], total + gm, every
    if primary == "heliocentric":
        k = 0
    elif primary in names:
        k = names.index(str(primary))
    elif isinstance(primary, (int, np.integer)) and not isinstance(primary, bool) and 0 <= primary < gm.size:
        k = int(primary)
    else:
        raise ValueError(
            f"orbital_elements: unknown primary {shown(primary)}; expected one of {', '.join(map(repr, PRIMARIES))}, a "
            f"number from 0 to {gm.size - 1}, or one of the names {', '.join(names)}."
        )
    others = [i for i in every if i != k]
    if gm[k] == 0:
        raise ValueError(
            f"orbital_elements: the primary {names[k]!r} has no mass, so nothing orbits it. Give another primary."
        )
    return state[:, others] - state[:, [k]], gm[k] + gm[others], others


def _elements(state: np.ndarray, mu: np.ndarray) -> dict[str, np.ndarray]:
    """Return the elements (bodies, ...) of relative states (2, bodies, 3, ...) by their names in `OrbitalElements`."""
    (x, y, z), (vx, vy, vz) = np.moveaxis(state, 2, 1)
    mu = mu.reshape(-1, *[1] * (x.ndim - 1))
    # Adding 0 leaves no -0, whose arc tangent is pi.
    hx, hy, hz = y * vz - z * vy + 0.0, z * vx - x * vz, x * vy - y * vx
    r = np.sqrt(x**2 + y**2 + z**2)
    v2, rv = vx**2 + vy**2 + vz**2, x * vx + y * vy + z * vz
    level = np.hypot(hx, hy)
    h = np.hypot(level, hz)
    with np.errstate(divide="ignore", invalid="ignore"):
        a = mu / (2 * mu / r - v2)
        ex, ey, ez = ((v2 - mu / r) * q - rv * v for q, v in ((x, vx), (y, vy), (z, vz)))
        ex, ey, ez = ex / mu, ey / mu, ez / mu
        e = np.sqrt(ex**2 + ey**2 + ez**2)
        n = np.copysign(np.sqrt(np.abs(mu / a**3)), a)
        period = TURN / n
    inc = np.arctan2(level, hz)
    Omega = np.arctan2(hx, -hy + 0.0)  # along the node (-hy, hx, 0)
    flat = (inc < FLAT) | (inc > np.pi - FLAT)
    turns = np.where(inc < np.pi / 2, 1.0, -1.0)  # in which sense longitudes grow along the orbit
    # Angles from the node in the plane of the orbit; from the x axis where that plane is flat.
    from_node = [_in_plane(q, (hx, hy, hz), level, h) for q in ((x, y, z), (ex, ey, ez))]
    position, pericentre = (
        np.where(flat, turns * (np.arctan2(q[1], q[0]) - Omega), angle)
        for q, angle in zip(((x, y), (ex, ey)), from_node, strict=True)
    )
    f = position - pericentre
    M = _mean_anomaly(e, f, a, r, rv / np.sqrt(mu))
    return {
        "a": a,
        "e": e,
        "inc": inc,
        "Omega": Omega % TURN,
        "omega": pericentre % TURN,
        "pomega": (Omega + turns * pericentre) % TURN,
        "f": f % TURN,
        "M": M,
        "theta": (Omega + turns * position) % TURN,
        "l": (Omega + turns * (pericentre + M)) % TURN,
        "n": n,
        "P": period,
    }


def _in_plane(q: Any, momentum: Any, level: np.ndarray, h: np.ndarray) -> np.ndarray:
    """Return the angle in the plane of the orbit from the ascending node to q; 0 if the node or q is undefined.

    `level` is the length of the part (hx, hy) of the angular `momentum`, and `h` that of the whole.
    """
    hx, hy, hz = momentum
    along = hx * q[1] - hy * q[0] + 0.0
    # Product of h x node, (-hx hz, -hy hz, hx^2 + hy^2), with q, divided by h.
    with np.errstate(divide="ignore", invalid="ignore"):
        across = np.where(h > 0, (level**2 * q[2] - hz * (hx * q[0] + hy * q[1])) / h, 0.0)
    return np.arctan2(across, along)


def _mean_anomaly(e: np.ndarray, f: np.ndarray, a: np.ndarray, r: np.ndarray, rv: np.ndarray) -> np.ndarray:
    """Return the mean anomaly, between 0 and 2 pi for an ellipse, NaN for a parabola; `rv` is q . v / sqrt(mu)."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        sine, cosine = rv / np.sqrt(np.abs(a)), 1 - r / a  # e times those of the eccentric anomaly
        nearly = 2 * np.arctan2(np.sqrt(np.abs(1 - e)) * np.sin(f / 2), np.sqrt(1 + e) * np.cos(f / 2))
        anomaly = np.where(e < ROUND, nearly, np.arctan2(sine, cosine))
        ellipse = (anomaly - sine) % TURN
        hyperbola = sine - np.arcsinh(sine / e)
    return np.where(np.isfinite(a), np.where(a > 0, ellipse, hyperbola), np.nan)
