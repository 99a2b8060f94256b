"""Problems of celestial mechanics: a satellite, and close encounters, chaos and choreography with reference states.

The starts are here; the reference states are data (``data/scene_references.json``), made in 160-bit arithmetic by
``tools/references.py``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np

from ...core.inputs import is_number, real_array, shown
from ...core.problem import Problem
from . import solar_data
from .forces import ForceConstants
from .nbody import nbody
from .orbits import QUANTITIES

__all__ = ["comet", "figure_eight", "pythagorean", "satellite"]

FIGURE_EIGHT_PERIOD = 6.32591398
YEAR_DAYS = 365.25
STEPS = 16  # a revolution, of the default step of `satellite`
# 1e13 kg, a nucleus of about 3 km, in solar masses.
COMET_MASS = 5e-18
# From the Sun, at the epoch of the DE440 data; AU and AU per year.
COMET_POSITION = np.array([1.002501036766, 3.897477161147, 2.176397333067])
COMET_VELOCITY = np.array([-2.100710600073, -0.613156552068, 0.134394494981])


def pythagorean() -> Problem:
    """Return Burrau's problem: masses 3, 4 and 5 at rest in the corners of the triangle with these sides.

    Returns
    -------
    Problem
        A problem from t = 0 to 70, with G = 1. Near t = 15.83 the bodies of masses 4 and 5 pass within 4e-4 of each
        other; from about t = 60 on they are a binary, and the body of mass 3 leaves. The invariants are those of
        `nbody`; the angular momentum is zero. There are `reference` states at t = 10, 20, ..., 70.

    References
    ----------
    C. Burrau, Numerische Berechnung eines Spezialfalles des Dreikörperproblems, Astronomische Nachrichten 195 (1913)
    113-118. V. Szebehely, C. F. Peters, Complete solution of a general problem of three bodies, Astronomical Journal
    72 (1967) 876-883.
    """
    return nbody(
        [3.0, 4.0, 5.0],
        [[1.0, 3.0, 0.0], [-2.0, -1.0, 0.0], [1.0, -1.0, 0.0]],
        np.zeros((3, 3)),
        t_span=(0.0, 70.0),
        name="pythagorean",
        units="G = 1",
        source="Burrau (1913); Szebehely & Peters, AJ 72 (1967) 876",
        reference=partial(_reference, "pythagorean"),
    )


def figure_eight(periods: float = 100.0) -> Problem:
    """Return the problem of three equal masses that follow each other along a figure of eight.

    Parameters
    ----------
    periods : float, optional
        Length of the interval in periods, T = 6.32591398.

    Returns
    -------
    Problem
        The start has the eight digits that were published, so that the bodies return to it within 1e-7 after one
        period. The invariants are those of `nbody`; the angular momentum is zero. There are `reference` states after 1,
        10 and 100 periods.

    Raises
    ------
    ValueError
        If `periods` is not positive.

    References
    ----------
    A. Chenciner, R. Montgomery, A remarkable periodic solution of the three-body problem in the case of equal masses,
    Annals of Mathematics 152 (2000) 881-901; initial data by C. Simó, there.
    """
    if not (is_number(periods, "periods") and periods > 0 and np.isfinite(periods)):
        raise ValueError(f"figure_eight: periods must be positive and finite, got {periods!r}.")
    q = np.array([0.97000436, -0.24308753, 0.0])
    v = np.array([-0.93240737, -0.86473146, 0.0])
    return nbody(
        np.ones(3),
        [q, -q, np.zeros(3)],
        [-v / 2, -v / 2, v],
        t_span=(0.0, periods * FIGURE_EIGHT_PERIOD),
        h=FIGURE_EIGHT_PERIOD / 100,
        name="figure-eight",
        units="G = 1",
        source="Chenciner & Montgomery, Ann. Math. 152 (2000) 881 (data by Simó)",
        reference=partial(_reference, "figure-eight"),
    )


def comet() -> Problem:
    """Return the problem of a comet, Sun, Jupiter and Saturn, in which a passage of Jupiter ejects the comet.

    Returns
    -------
    Problem
        A problem over twenty years, in AU and years, with the centre of mass at rest. Sun, Jupiter and Saturn start
        from the DE440 data of `SolarSystemData` (2014-02-02). The comet is synthetic: a body of 1e13 kg, placed so that
        after 10 years it passes Jupiter's centre at 3.0 radii (0.0014 AU), about as near as Lexell's comet did in 1779.
        Before the passage its semi-major axis is 3.2 AU, with perihelia at 1.3 AU; afterwards it is 500 AU. An error
        before the passage has grown 700-fold at the end. The invariants are those of `nbody`. The comet's share in them
        is 1e-17, so that they do not show errors of its orbit. There is a `reference` state at 20 years.
    """
    data = solar_data.load("de440")
    rows = [data.bodies.index(name) for name in ("Sun", "Jupiter", "Saturn")]
    gm = data.gm[rows] * YEAR_DAYS**2
    q, v = data.position[rows], data.velocity[rows] * YEAR_DAYS
    q = np.vstack([q, q[0] + COMET_POSITION])
    v = np.vstack([v, v[0] + COMET_VELOCITY])
    gm = np.append(gm, COMET_MASS * gm[0])
    q, v = solar_data.to_barycentre(gm, q, v)
    return nbody(
        gm,
        q,
        v,
        t_span=(0.0, 20.0),
        name="comet",
        units="AU, Julian year",
        source="DE440; the comet is synthetic",
        reference=partial(_reference, "comet"),
    )


def _reference(name: str, t: float) -> np.ndarray | None:
    """Return the stored reference state (6 N,) of the problem `name` at the time `t`; None if there is none."""
    for time, state in _references()[name]:
        if abs(t - time) <= 1e-14 * abs(time):
            return np.array(state)
    return None


@cache
def _references() -> dict[str, list[tuple[float, list[float]]]]:
    states = solar_data.read("scene_references.json")["states"]
    return {name: [(row["t"], row["state"]) for row in rows] for name, rows in states.items()}


def satellite(
    position: Any,
    velocity: Any,
    *,
    mu: float,
    radius: float,
    t_span: tuple[float, float],
    h: float | None = None,
    j2: float = 0.0,
    drag: float = 0.0,
    height: float = 0.0,
    scale_height: float | None = None,
    spin: float = 0.0,
    pole: Sequence[float] = (0.0, 0.0, 1.0),
    balances: str | Sequence[str] | None = QUANTITIES,
    name: str = "satellite",
    units: str = "",
) -> Problem:
    """Return the problem of a satellite about an oblate planet, with drag in an exponential atmosphere.

    The acceleration is the gradient of ``mu / r (1 - j2 (radius / r)^2 (3 sin(latitude)^2 - 1) / 2)``, and
    ``-drag exp((radius + height - r) / scale_height) |u| u`` with the velocity u relative to the air.

    Parameters
    ----------
    position, velocity : array_like, shape (3,)
        Position and velocity at the start, relative to the planet's centre.
    mu, radius : float
        G m and the equatorial radius of the planet. All arguments have the units of length and time of your choice.
    t_span : (float, float)
    h : float, optional
        Step. Default: 1/16 of the period of the Kepler orbit at the start; none if that orbit is unbound.
    j2 : float, optional
        Oblateness J2, a number without unit.
    drag : float, optional
        Half of the air's density at `height`, times c_D A / m of the satellite. Its unit is one over a length.
    height, scale_height : float, optional
        `drag` holds at the distance `radius` + `height` from the planet's centre. `scale_height`, which must be given
        with `drag`, is the height over which the density falls by a factor of e.
    spin : float, optional
        Angular velocity of the air about the pole, in radians per unit of time.
    pole : sequence of 3 floats, optional
        Axis of the planet.
    balances : str or sequence of str, optional
        Quantities of Kepler's motion to keep, see `orbital_balances`. The default is all of them, which is most
        accurate for nearly circular orbits. "kepler", the energy alone, is more accurate from eccentricities of about
        0.1. If it is None, the problem has no invariants.
    name, units : str, optional
        See `Problem`.

    Returns
    -------
    Problem
        A problem of `nbody`, with the planet at rest in the origin and a satellite of mass 0. The state is (position of
        the planet, position of the satellite, velocity of the planet, velocity of the satellite).

    Raises
    ------
    ValueError
        If a shape is wrong, `mu`, `radius` or `scale_height` is not positive, `j2`, `drag` or `height` is negative, or
        a quantity in `balances` is unknown.

    Examples
    --------
    >>> import numpy as np
    >>> from eip_scipy import EIPDOP853, integrate
    >>> from eip_scipy.problems import satellite
    >>> earth = {"mu": 398600.4418, "radius": 6378.137, "j2": 1.08262668e-3}  # km, s
    >>> air = {"drag": 3.3e-11, "height": 400, "scale_height": 60}
    >>> problem = satellite([6798, 0, 0], [0, 4.756, 6.001], t_span=(0, 86400), **earth, **air)
    >>> run = integrate(problem, method=EIPDOP853)
    >>> run.trusted, problem.component_names[3]
    (True, 'x_satellite')
    """
    x, v = (real_array(key, value) for key, value in (("position", position), ("velocity", velocity)))
    if x.shape != (3,) or v.shape != (3,):
        raise ValueError(f"satellite: position has shape {x.shape} and velocity {v.shape}; expected (3,) for both.")
    lengths = {"mu": mu, "radius": radius} | ({} if scale_height is None else {"scale_height": scale_height})
    for key, value in {**lengths, "j2": j2, "drag": drag, "height": height}.items():
        if not is_number(value) or not np.isfinite(value) or value < 0 or (key in lengths and value == 0):
            least = "> 0" if key in lengths else ">= 0"
            raise ValueError(f"satellite: {key} must be a finite number {least}, got {shown(value)}.")
    if drag and scale_height is None:
        raise ValueError(
            "satellite: drag needs scale_height, the height over which the density of the air falls by a factor of e; "
            "give it."
        )
    forces = [force for force, size in (("j2", j2), ("drag", drag)) if size]
    constants = ForceConstants(
        j2=j2 * radius**2,
        pole=pole,
        drag=drag,
        drag_radius=radius + height,
        scale_height=scale_height,
        spin=spin,
    )
    if h is None:
        inverse = 2 / float(np.linalg.norm(x)) - float(v @ v) / mu  # of the semi-major axis
        h = None if inverse <= 0 else 2 * np.pi / STEPS / float(np.sqrt(mu * inverse**3))
    problem = nbody(
        [mu, 0.0],
        [np.zeros(3), x],
        [np.zeros(3), v],
        t_span=t_span,
        h=h,
        forces=forces,
        constants=constants,
        balances="kepler" if balances is None else balances,
        name=name,
        units=units,
        bodies=("planet", "satellite"),
        source="exponential atmosphere, drag proportional to the squared speed",
    )
    return problem if balances is not None else replace(problem, invariants=())
