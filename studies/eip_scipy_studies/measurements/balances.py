"""``eip-scipy study balances``: final errors with and without balances, in cases in which they help or do not help.

Each system runs with the same fixed steps (the close encounter with the same tolerances) without projection and with
one or more sets of balances, in the default metric unless a line says otherwise. Systems in space are run in several
rotations of the axes, oscillators from several phases of the driving, and chaos from several starts. References are
runs of DOP853 with shorter steps and compensated sums; their own error is the difference from a run with steps of
twice the length. A warning is any that a run raises, or a run that is not reliable; a run that ends early has an
infinite error.

A function with the arguments `turned` and `turn` gets a rotation matrix (3, 3) of the axes and its number 0, 1, ...
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from eip_scipy import EIPDOP853, Balance, integrate
from eip_scipy.problems import (
    ParticleField,
    charged_particle,
    nbody,
    satellite,
)
from eip_scipy.problems.gravity.forces import ForceConstants
from eip_scipy.problems.gravity.orbits import orbital_balances
from eip_scipy.problems.gravity.solar_data import YEAR_D, load

from ..report import needed, table
from ..study import Rows, Session, Study, option, some_of
from .relativity import speed_of_light

njit = needed("numba", '"eip_scipy[numba]"').njit

TURN = 2 * math.pi
# Km and s. Drag per squared speed at 400 km: half of 3e-12 kg/m^3 times 0.022 m^2/kg.
EARTH: dict[str, Any] = {"mu": 398600.4418, "radius": 6378.137, "j2": 1.08262668e-3}
AIR: dict[str, Any] = {"drag": 0.5 * 3e-12 * 0.022 * 1e3, "height": 400.0, "scale_height": 60.0}
LUNAR_MONTH = 27.321661 / YEAR_D
KM_S = 86400 * YEAR_D / 149597870.7  # AU/yr
MOST_TIMES, MOST_UNWARNED, LEAST_GAIN = 1.5, 3.0, 100.0


class Case(NamedTuple):
    """A system in one rotation of the axes, or with one phase or start, and the settings of its runs.

    ``run(**options)`` returns a run by `integrate`, and `sets` are the sets of balances by their names. `steps` are the
    options h, or rtol and atol. `finer` is the number of steps of the reference in one step, or the tolerances divided
    by those of the reference. `places` are the slices of the state that hold the vectors (such as positions of bodies)
    whose errors count: the error of a state is the largest length of their differences from the reference.
    """

    run: Callable[..., Any]
    sets: Mapping[str, Any]
    steps: dict[str, float]
    finer: int
    places: tuple[slice, ...]


class System(NamedTuple):
    """A system, and the conditions (bars) that its results must fulfil.

    ``make(rotation, number)`` returns the `Case` for a rotation matrix (3, 3) and its number 0, 1, ..., from which
    phases and starts are made. `unit` is the unit of the error. If `helps`, the error with balances must be at most
    `MOST_TIMES` that without; otherwise a run with more than `MOST_UNWARNED` times the error must come with a warning.
    If `gains`, the error must be `LEAST_GAIN` times smaller. `times` is the factor that converts errors to `unit`.
    """

    make: Callable[[np.ndarray, int], Case]
    unit: str
    helps: bool
    gains: bool = False
    times: float = 1.0


# Kepler's motion with drag, GM = 1.


@njit
def dragged(t, y, c):
    r3 = (y[0] ** 2 + y[1] ** 2 + y[2] ** 2) ** 1.5
    out = np.empty(6)
    for k in range(3):
        out[k] = y[3 + k]
        out[3 + k] = -y[k] / r3 - c * y[3 + k]
    return out


@njit
def kepler_energy(t, y, c):
    return 0.5 * (y[3] ** 2 + y[4] ** 2 + y[5] ** 2) - 1 / np.sqrt(y[0] ** 2 + y[1] ** 2 + y[2] ** 2)


@njit
def energy_loss(t, y, c):
    return -c * (y[3] ** 2 + y[4] ** 2 + y[5] ** 2)


@njit
def energy_loss_doubled(t, y, c):
    return -2 * c * (y[3] ** 2 + y[4] ** 2 + y[5] ** 2)


@njit
def energy_loss_off_by_a_hundredth(t, y, c):
    return -1.01 * c * (y[3] ** 2 + y[4] ** 2 + y[5] ** 2)


@njit
def spin(t, y, c):
    return np.array([y[1] * y[5] - y[2] * y[4], y[2] * y[3] - y[0] * y[5], y[0] * y[4] - y[1] * y[3]])


@njit
def spin_loss(t, y, c):
    return -c * spin(t, y, c)


@njit
def laplace(t, y, c):
    r = np.sqrt(y[0] ** 2 + y[1] ** 2 + y[2] ** 2)
    l0, l1, l2 = y[1] * y[5] - y[2] * y[4], y[2] * y[3] - y[0] * y[5], y[0] * y[4] - y[1] * y[3]
    return np.array(
        [y[4] * l2 - y[5] * l1 - y[0] / r, y[5] * l0 - y[3] * l2 - y[1] / r, y[3] * l1 - y[4] * l0 - y[2] / r]
    )


@njit
def laplace_loss(t, y, c):
    l0, l1, l2 = y[1] * y[5] - y[2] * y[4], y[2] * y[3] - y[0] * y[5], y[0] * y[4] - y[1] * y[3]
    return np.array(
        [-2 * c * (y[4] * l2 - y[5] * l1), -2 * c * (y[5] * l0 - y[3] * l2), -2 * c * (y[3] * l1 - y[4] * l0)]
    )


def drag(strength: float, revolutions: float, steps: int = 16, rates: Mapping[str, Any] | None = None) -> Any:
    """Return a function that makes the case of a planet with e = 0.2 and the drag -`strength` times the velocity.

    The runs have `steps` steps per revolution. `rates`, if given, maps names to wrong rates of the energy; each of them
    makes one of the `sets` of the `Case`, and there are no other sets.
    """
    energy = Balance(kepler_energy, energy_loss, name="E")
    others = [Balance(spin, spin_loss, name="h"), Balance(laplace, laplace_loss, name="e")]
    sets = {"E": energy, "E, h, e": [energy, *others]}
    if rates is not None:
        sets = {name: Balance(kepler_energy, rate, name="E") for name, rate in rates.items()}

    def make(turned: np.ndarray, turn: int) -> Case:
        y0 = np.concatenate([turned @ [0.8, 0, 0], turned @ [0, 1.5**0.5, 0]])
        run = runner(fun=dragged, t_span=(0, revolutions * TURN), y0=y0, args=(strength,))
        return Case(run, sets, {"h": TURN / steps}, 16, (slice(0, 3),))

    return make


# A satellite 400 km above an oblate Earth, with drag.


def leo(days: float) -> Any:
    """Return a function that makes the case of a satellite in a low orbit, over a number of days."""
    a, e, tilt = EARTH["radius"] + 420, 2e-3, math.radians(51.6)
    speed = math.sqrt(EARTH["mu"] / a * (1 + e) / (1 - e))
    start = np.array([[a * (1 - e), 0, 0], [0, speed * math.cos(tilt), speed * math.sin(tilt)]])

    def make(turned: np.ndarray, turn: int) -> Case:
        pole = tuple(turned[:, 2].tolist())
        problem = satellite(
            start[0] @ turned.T, start[1] @ turned.T, **EARTH, **AIR, pole=pole, t_span=(0.0, 86400 * days)
        )
        assert problem.h is not None
        assert problem.params is not None
        sets = {"E": orbital_balances(problem.params[:2], problem.y0), "E, h, e": problem.invariants}
        return Case(of(problem), sets, {"h": problem.h}, 16, (slice(3, 6),))

    return make


# Bodies.


def bodies(
    names: tuple[str, ...], years: float, h: float, finer: int, data: str = "de440", relativity: bool = False,
    wrong: bool = False,
) -> Any:  # fmt: skip
    """Return a function that makes the case of some bodies of a data set over `years`; the Sun's error does not count.

    `h` is the step in years, and `finer` is that of `Case`. With `wrong` the only balance is the Moon's energy about
    the Sun, which is the wrong centre.
    """
    known = load(data)
    places = [list(known.bodies).index(name) for name in names]
    gm = known.gm[places] * YEAR_D**2
    q, v = known.position[places], known.velocity[places] * YEAR_D
    q, v = (values - gm @ values / gm.sum() for values in (q, v))

    def make(turned: np.ndarray, turn: int) -> Case:
        forces: dict[str, Any] = {"forces": "1pn", "constants": ForceConstants(c=speed_of_light)} if relativity else {}
        problem = nbody(gm, q @ turned.T, v @ turned.T, t_span=(0.0, years), bodies=names, **forces)
        sets: dict[str, Any] = {"E": orbital_balances(gm, problem.y0, bodies=names, newton=not relativity)}
        if "Moon" in names:
            alone = orbital_balances(gm, problem.y0, bodies=names, newton=not relativity)
            for item in alone:
                item.subspaces = ()
            sets["E, error metric"] = alone
        if wrong:
            own = (np.asarray(problem.params),)
            sets = {"E of the Moon about the Sun": Balance(about_the_first, rate_about_the_first, args=own, name="E")}
        return Case(of(problem), sets, {"h": h}, finer, tuple(slice(3 * k, 3 * k + 3) for k in range(1, len(names))))

    return make


def asteroid(turned: np.ndarray, turn: int) -> Case:
    """Return the case of an asteroid inside the orbit of Jupiter, with a = 3.7 AU and e = 0.1, for 2000 years."""
    sun, gm = 4 * math.pi**2, np.array([4 * math.pi**2, 4 * math.pi**2 / 1047.35, 0.0])
    q = np.array([[0, 0, 0], [0, 5.2 * 0.95, 0], [3.7 * 0.9, 0, 0]])
    speeds = math.sqrt((sun + gm[1]) / 5.2 * 1.05 / 0.95), math.sqrt(sun / 3.7 * 1.1 / 0.9)
    v = np.array([[0, 0, 0], [-speeds[0], 0, 0], [0, speeds[1] * math.cos(0.1), speeds[1] * math.sin(0.1)]])
    q, v = (values - gm @ values / gm.sum() for values in (q, v))
    problem = nbody(gm, q @ turned.T, v @ turned.T, t_span=(0.0, 2000.0))
    sets = {"E": orbital_balances(gm, problem.y0, newton=True)}
    return Case(of(problem), sets, {"h": 3.7**1.5 / 16}, 16, (slice(6, 9),))


@njit
def about_the_first(t, y, p):
    """Return the energy of the third of three bodies about the first."""
    r = np.sqrt((y[6] - y[0]) ** 2 + (y[7] - y[1]) ** 2 + (y[8] - y[2]) ** 2)
    v2 = (y[15] - y[9]) ** 2 + (y[16] - y[10]) ** 2 + (y[17] - y[11]) ** 2
    return 0.5 * v2 - (p[0] + p[2]) / r


@njit
def rate_about_the_first(t, y, p):
    """Return the rate of change of `about_the_first`, from the pulls of the second body on the third and the first."""
    near = ((y[6] - y[3]) ** 2 + (y[7] - y[4]) ** 2 + (y[8] - y[5]) ** 2) ** 1.5
    far = ((y[0] - y[3]) ** 2 + (y[1] - y[4]) ** 2 + (y[2] - y[5]) ** 2) ** 1.5
    rate = 0.0
    for k in range(3):
        rate += (y[15 + k] - y[9 + k]) * p[1] * ((y[3 + k] - y[6 + k]) / near - (y[3 + k] - y[k]) / far)
    return rate


def encounter(turned: np.ndarray, turn: int) -> Case:
    """Return the case of an asteroid that passes the Earth at 5e-4 AU with 10 km/s after the first of two years.

    The run is adaptive, with rtol = 1e-9.
    """
    gm = 4 * math.pi**2 * np.array([1, 3.003e-6, 0])
    earth, speed = np.array([1.0, 0, 0]), math.sqrt(gm[0] + gm[1])
    q = np.array([[0, 0, 0], earth, earth + [5e-4, 0, 0]])
    v = np.array([[0, 0, 0], [0, speed, 0], [0, speed + 8 * KM_S, 6 * KM_S]])
    q, v = (values - gm @ values / gm.sum() for values in (q, v))
    problem = nbody(gm, q @ turned.T, v @ turned.T, t_span=(0.0, -1.0))
    start = integrate(problem, method=EIPDOP853, rtol=1e-13, atol=1e-15, invariants=()).y[:, -1]
    problem = nbody(gm, start[:9].reshape(3, 3), start[9:].reshape(3, 3), t_span=(0.0, 2.0))
    own = (np.asarray(problem.params),)
    sets = {
        "E of each orbit, own weights": orbital_balances(gm, start, newton=True),
        "E of the asteroid, error metric": Balance(about_the_first, rate_about_the_first, args=own, name="E"),
    }
    return Case(of(problem), sets, {"rtol": 1e-9, "atol": 1e-12}, 2000, (slice(6, 9),))


# A charge in a magnetic mirror, whose field B(t) (1 + z^2 / L^2) along its axis varies slowly; q / m = 1.


@njit
def field(t, omega):
    return 1 + 0.02 * np.sin(omega * t), 0.02 * omega * np.cos(omega * t)


@njit
def charge(t, y, a, b, c, omega):
    strength, change = field(t, omega)
    z = a * y[0] + b * y[1] + c * y[2]
    along, across = strength * (1 + z * z / 100), -strength * z / 100
    # B = along n + across (r - z n); E = -A'(t) with A = B(t) (1 + z^2 / L^2) n x r / 2.
    bx, by, bz = a * along + across * (y[0] - z * a), b * along + across * (y[1] - z * b), 0.0
    bz = c * along + across * (y[2] - z * c)
    e = -0.5 * change * (1 + z * z / 100)
    return np.array(
        [
            y[3],
            y[4],
            y[5],
            y[4] * bz - y[5] * by + e * (b * y[2] - c * y[1]),
            y[5] * bx - y[3] * bz + e * (c * y[0] - a * y[2]),
            y[3] * by - y[4] * bx + e * (a * y[1] - b * y[0]),
        ]
    )


@njit
def kinetic_energy(t, y, a, b, c, omega):
    return 0.5 * (y[3] ** 2 + y[4] ** 2 + y[5] ** 2)


@njit
def electric_power(t, y, a, b, c, omega):
    z = a * y[0] + b * y[1] + c * y[2]
    e = -0.5 * field(t, omega)[1] * (1 + z * z / 100)
    ex, ey, ez = b * y[2] - c * y[1], c * y[0] - a * y[2], a * y[1] - b * y[0]
    return e * (y[3] * ex + y[4] * ey + y[5] * ez)


def particle(turned: np.ndarray, turn: int) -> Case:
    """Return the case of a charged particle over 500 gyrations with 16 steps each."""
    y0 = np.concatenate([turned @ [1.0, 0, 0], turned @ [0, 0.5, 0.25]])
    run = runner(fun=charge, t_span=(0, 500 * TURN), y0=y0, args=(*turned[:, 2].tolist(), 0.01))
    sets = {"kinetic energy": Balance(kinetic_energy, electric_power, name="E")}
    return Case(run, sets, {"h": TURN / 16}, 16, (slice(0, 3),))


# A charge in a field B(t) (1 + r^2) along the z axis and a potential that varies too.


@njit
def strengths(t):
    return 1 + 0.02 * np.sin(0.01 * t), 2e-4 * np.cos(0.01 * t), 0.05 + 0.005 * np.sin(0.013 * t)


@njit
def vector_potential(t, x, y, z):
    around = strengths(t)[0] * (0.5 + 0.25 * (x * x + y * y))
    return -around * y, around * x, 0.0


@njit
def magnetic(t, x, y, z):
    return 0.0, 0.0, strengths(t)[0] * (1 + x * x + y * y)


@njit
def potential(t, x, y, z):
    r2 = x * x + y * y
    return strengths(t)[2] * (0.5 * r2 + 0.1 * r2 * r2)


@njit
def electric(t, x, y, z):
    r2 = x * x + y * y
    around, out = -strengths(t)[1] * (0.5 + 0.25 * r2), -strengths(t)[2] * (1 + 0.4 * r2)
    return out * x - around * y, out * y + around * x, 0.0


VARYING = ParticleField(
    vector_potential, magnetic=magnetic, potential=potential, electric=electric, axisymmetric=True, varies=True
)


def held(turned: np.ndarray, turn: int) -> Case:
    """Return the case of a charged particle over some 400 gyrations; `turn` gives the direction of its velocity."""
    start = [0.5, 0, 0], [0.3 * math.sin(turn), 0.3 * math.cos(turn), 0]
    made = {
        name: charged_particle(VARYING, *start, t_span=(0, 2000), form="velocity", balances=name)
        for name in ("energy", "kinetic")
    }
    sets = {"H and L": made["energy"].invariants, "T and L": made["kinetic"].invariants}
    return Case(of(made["energy"]), sets, {"h": 0.4}, 16, (slice(0, 3),))


# Oscillators x'' = -a x - b x^3 - c x' + d cos(w t + phase).


@njit
def swinging(t, y, a, b, c, d, w, phase):
    return np.array([y[1], -a * y[0] - b * y[0] ** 3 - c * y[1] + d * np.cos(w * t + phase)])


@njit
def swing_energy(t, y, a, b, c, d, w, phase):
    return 0.5 * y[1] ** 2 + 0.5 * a * y[0] ** 2 + 0.25 * b * y[0] ** 4


@njit
def swing_power(t, y, a, b, c, d, w, phase):
    return -c * y[1] ** 2 + d * y[1] * np.cos(w * t + phase)


def oscillator(a: float, b: float, c: float, d: float, w: float, end: float, h: float = 0.4) -> Any:
    """Return a function that makes the case of x'' = -a x - b x^3 - c x' + d cos(w t + phase) to t = `end`.

    The phase is `turn`, and the error is that of the vector (x, v).
    """

    def make(turned: np.ndarray, turn: int) -> Case:
        run = runner(fun=swinging, t_span=(0, end), y0=[1.0, 0.3], args=(a, b, c, d, w, float(turn)))
        return Case(run, {"H": Balance(swing_energy, swing_power, name="H")}, {"h": h}, 16, (slice(0, 2),))

    return make


# Henon and Heiles, with a little drag.


@njit
def henon(t, y, c):
    return np.array([y[2], y[3], -y[0] - 2 * y[0] * y[1] - c * y[2], -y[1] - y[0] ** 2 + y[1] ** 2 - c * y[3]])


@njit
def henon_energy(t, y, c):
    return 0.5 * (y[2] ** 2 + y[3] ** 2 + y[0] ** 2 + y[1] ** 2) + y[0] ** 2 * y[1] - y[1] ** 3 / 3


@njit
def henon_loss(t, y, c):
    return -c * (y[2] ** 2 + y[3] ** 2)


@njit
def partial_energy(t, y, c):
    return 0.5 * (y[2] ** 2 + y[0] ** 2)


@njit
def partial_power(t, y, c):
    return -2 * y[0] * y[1] * y[2] - c * y[2] ** 2


def chaos(turned: np.ndarray, turn: int) -> Case:
    """Return the case of a chaotic orbit of Hénon and Heiles with energy 1/7 and y = 0.05 `turn` - 0.1 at the start."""
    y = 0.05 * turn - 0.1
    speed = math.sqrt(2 * (1 / 7 - 0.5 * y * y + y**3 / 3))
    run = runner(fun=henon, t_span=(0, 200), y0=[0, y, speed * 0.96, speed * 0.28], args=(1e-5,))
    sets = {
        "H": Balance(henon_energy, henon_loss, name="H"),
        "energy of x": Balance(partial_energy, partial_power, name="E_x"),
    }
    return Case(run, sets, {"h": 0.4}, 16, (slice(0, 4),))


SYSTEMS = {
    "drag 1e-6, e = 0.2, 1000 revolutions": System(drag(1e-6, 1000), "", True, True),
    "satellite, J2 and drag, 10 days": System(leo(10), "m", True, True, 1e3),
    "satellite, J2 and drag, 100 days": System(leo(100), "m", True, True, 1e3),
    "four planets, 1PN, 200 years": System(
        bodies(("Sun", "Mercury", "Venus", "EMB", "Mars"), 200, 1 / 70, 16, relativity=True), "AU", True, True
    ),
    "asteroid inside of Jupiter, 2000 years": System(asteroid, "AU", True),
    "Moon and Earth, 20 years, 16 steps a month": System(
        bodies(("Sun", "Earth", "Moon", "Jupiter"), 20, LUNAR_MONTH / 16, 16, "de440-moon"), "AU", True
    ),
    "Moon and Earth, 20 years, 24 steps a month": System(
        bodies(("Sun", "Earth", "Moon", "Jupiter"), 20, LUNAR_MONTH / 24, 10, "de440-moon"), "AU", True
    ),
    "Duffing, driven by 1e-3": System(oscillator(1, 1, 0, 1e-3, 0.4, 1000), "", True),
    "charge in a varying mirror": System(particle, "", True),
    "charge in a varying field and potential": System(held, "", True),
    "strong driving": System(oscillator(1, 1, 0, 1.0, 0.4, 200), "", False),
    "linear resonance": System(oscillator(1, 0, 0, 1e-2, 1.0, 500), "", False),
    "attractor, damped by 0.02": System(oscillator(1, 1, 0.02, 0.05, 1.2, 2000), "", False),
    "linear attractor, damped by 0.01": System(oscillator(1, 0, 0.01, 0.01, 2.0, 2000), "", False),
    "attractor, damped by 0.2": System(oscillator(1, 1, 0.2, 0.5, 1.2, 500), "", False),
    "encounter at 5e-4 AU": System(encounter, "AU", False),
    "chaos of Henon and Heiles": System(chaos, "", False),
    "drag 1e-2, 5 revolutions": System(drag(1e-2, 5), "", False),
    "wrong centre, 20 years": System(
        bodies(("Sun", "Earth", "Moon"), 20, LUNAR_MONTH / 16, 16, "de440-moon", wrong=True), "AU", False
    ),
    "wrong rate, 200 revolutions": System(
        drag(1e-6, 200, rates={"doubled": energy_loss_doubled, "1 % more": energy_loss_off_by_a_hundredth}), "", False
    ),
}


def runner(**start: Any) -> Callable[..., Any]:
    """Return ``run(**options)``, which calls `integrate` with EIPDOP853, the arguments `start` and these options."""
    return lambda **options: integrate(method=EIPDOP853, **start, **options)


def of(problem: Any, method: Any = EIPDOP853) -> Callable[..., Any]:
    """Return ``run(**options)``, which calls `integrate` for a problem with this method and these options."""
    return lambda **options: integrate(problem, method=method, **options)


class Row(NamedTuple):
    """Errors of a system without and with one set of balances (`kept`) in the rotation of number `turn`.

    `calls` and `calls_with` are the numbers of calls of the right-hand side, `without` and `with_balances` the errors,
    in the unit of the `System`. `slowness` is the largest `Diagnostics.slowness` of a balance, `warned` tells whether
    the run with balances gave a warning or was not reliable, and `said` contains the warnings and the message of a run
    that is not reliable. `of_reference` is the error of the reference.
    """

    system: str
    kept: str
    turn: int
    calls: int
    calls_with: int
    without: float
    with_balances: float
    slowness: float
    warned: bool
    of_reference: float
    said: str


def finer_steps(case: Case, share: float = 1.0) -> dict[str, Any]:
    """Return the options of the reference, or of a run with `share` times the steps or tolerances of the reference."""
    exact = {"invariants": (), "compensated": True}
    return {**exact, **{name: value * share / case.finer for name, value in case.steps.items()}}


def distance(case: Case, a: np.ndarray, b: np.ndarray) -> Any:
    """Return the largest distance between states `a` and `b`, (n,) or (n, m), among the vectors at `places`."""
    return np.max([np.linalg.norm((a - b)[part], axis=0) for part in case.places], axis=0)


def measured(name: str, system: System, turned: np.ndarray, turn: int) -> list[Row]:
    """Run a system without and with balances in one rotation; return a `Row` for each set of balances.

    `turned` is the rotation matrix (3, 3) and `turn` its number, as for `System.make`.
    """
    case = system.make(turned, turn)
    right = case.run(**finer_steps(case)).y[:, -1]
    of_reference = distance(case, case.run(**finer_steps(case, 2.0)).y[:, -1], right)
    plain = case.run(**case.steps, invariants=())
    rows = []
    for kept, items in case.sets.items():
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            run = case.run(**case.steps, invariants=items)
        said = [str(item.message) for item in caught] + ([] if run.trusted else [run.message])
        slow = run.diagnostics.slowness
        without, within = (system.times * float(distance(case, y, right)) for y in (plain.y[:, -1], run.y[:, -1]))
        within = within if run.success else math.inf
        own = system.times * float(of_reference)
        rows.append(
            Row(name, kept, turn, plain.nfev, run.nfev, without, within, float(np.nanmax(slow)), bool(said), own,
                " | ".join(said))
        )  # fmt: skip
    return rows


@dataclass(frozen=True, kw_only=True)
class Balances(Study[list[Row]]):
    """Command ``eip-scipy study balances``."""

    rotations: int = option(
        6, "number of rotations of the axes, phases or starts of each system (default: %(default)s)", type=int
    )
    system: Sequence[str] | None = some_of("system", SYSTEMS)

    def measure(self, session: Session) -> list[Row]:
        turns = [np.eye(3), *Rotation.random(max(self.rotations - 1, 0), rng=1).as_matrix()]
        chosen = {name: system for name, system in SYSTEMS.items() if not self.system or name in self.system}
        rows: list[Row] = []
        with session.bar(len(chosen), "balances", "system") as bar:
            for name, system in chosen.items():
                for turn, turned in enumerate(turns):
                    rows += measured(name, system, turned, turn)
                bar.update()
        return rows

    def text(self, found: list[Row]) -> str:
        head = [["calls"], ["error", "without"], ["error", "with"], ["without /", "with"], ["with /", "without"],
                ["slowness"], ["warned"], ["error of", "reference"]]  # fmt: skip
        groups = grouped(found)
        body: list[tuple[str, list[str]]] = []
        for helps, title in ((True, "where they should help"), (False, "where they should not, or could hurt")):
            own = [(key, rows) for key, rows in groups.items() if SYSTEMS[key[0]].helps == helps]
            if own:
                body.append((title, []))
            for (name, kept), rows in own:
                one = summary(rows)
                body.append((
                    f"  {name}{f' [{SYSTEMS[name].unit}]' if SYSTEMS[name].unit else ''}: {kept}",
                    [str(rows[0].calls_with), f"{one['without']:.1e}", f"{one['with']:.1e}", f"{one['gain']:.3g}",
                     f"{one['worst']:.2g}", f"{one['slowness']:.1e}", f"{one['warned']:.0f}/{len(rows)}",
                     f"{one['reference']:.0e}"],
                ))  # fmt: skip
        return "\n\n".join([table(head, body), "\n".join(bars(groups))])

    def numbers(self, found: list[Row]) -> dict[str, Any]:
        return {"rows": [row._asdict() for row in found]}

    def tables(self, found: list[Row]) -> Mapping[str, Rows]:
        return {"balances.csv": [row._asdict() for row in found]}


def grouped(rows: list[Row]) -> dict[tuple[str, str], list[Row]]:
    """Return the rows of each system and set of balances."""
    found: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        found.setdefault((row.system, row.kept), []).append(row)
    return found


def summary(rows: list[Row]) -> dict[str, float]:
    """Return the medians of the errors and of the gain (error without over error with balances) over the rows.

    The other numbers are the largest inverse gain ("worst"), the largest slowness and error of the reference, and the
    number of rows with a warning ("warned").
    """
    return {
        "without": float(np.median([row.without for row in rows])),
        "with": float(np.median([row.with_balances for row in rows])),
        "gain": float(np.median([row.without / row.with_balances for row in rows])),
        "worst": max(row.with_balances / row.without for row in rows),
        "slowness": max(row.slowness for row in rows),
        "warned": sum(row.warned for row in rows),
        "reference": max(row.of_reference for row in rows),
    }


def bars(groups: Mapping[tuple[str, str], list[Row]]) -> list[str]:
    """Return a line for each condition of `System` that does not hold, or the line "all bars hold"."""
    lines = []
    for (name, kept), rows in groups.items():
        system, one = SYSTEMS[name], summary(rows)
        what = f"{name}, {kept}"
        if system.gains and one["gain"] < LEAST_GAIN:
            lines.append(f"{what}: {one['gain']:.3g} times less, not {LEAST_GAIN:g}")
        if system.helps and one["worst"] > MOST_TIMES:
            lines.append(f"{what}: {one['worst']:.3g} times the error without, more than {MOST_TIMES:g}")
        if not system.helps and any(row.with_balances > MOST_UNWARNED * row.without and not row.warned for row in rows):
            lines.append(f"{what}: more than {MOST_UNWARNED:g} times the error without, and no warning")
    return lines or ["all bars hold"]
