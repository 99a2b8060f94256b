"""Systems with quantities that are claimed to be invariants, rightly or wrongly; each function makes a `Problem`."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

import eip_scipy.problems
from eip_scipy import Invariant, eip_method
from eip_scipy.problems import Grid, GrossPitaevskii, Problem, centre_time, kepler, solar_system, time_transformed

from ..condensates import problems as condensates
from ..hard_cases import CaseEquations, hard_cases
from ..report import needed

njit = partial(needed("numba", '"eip_scipy[numba]"').njit, cache=True)
Array = np.ndarray


def maker(name: str) -> Callable[..., Problem]:
    """Return the function of this module or of the package that makes a problem."""
    places = (globals(), vars(condensates), vars(eip_scipy.problems))
    found: Callable[..., Problem] = next(place[name] for place in places if name in place)
    return found


def problem(fun: Callable[..., Any], start: Any, end: float, *kept: Invariant) -> Problem:
    """Return a problem from a right-hand side and the quantities `kept` that are claimed to be invariants."""
    y0 = np.array(start)
    y0 = y0 + (0j if y0.dtype.kind == "c" else 0.0)
    return Problem(name="claimed", fun=fun, y0=y0, t_span=(0.0, end), invariants=kept)


def until(name: str, end: float, *args: Any) -> Problem:
    """Return a problem of the package with another end of its interval."""
    made = maker(name)(*args)
    return replace(made, t_span=(made.t_span[0], end))


# --- mechanics, y = (q, v) ---


def springs(force: Callable[[Any, float], Any], energy: Callable[[Any, float], Any]) -> tuple[Any, Any]:
    """Return potential and slope of masses in a row between walls, from functions of the springs' elongations."""

    def stretched(q):
        return np.diff(q, prepend=0.0, append=0.0)

    return lambda q, a: energy(stretched(q), a).sum(), lambda q, a: -np.diff(force(stretched(q), a))


# Potentials of q and a size, and their slopes; q is a number in one dimension.
POTENTIALS: dict[str, tuple[Any, Any]] = {
    "pendulum": (lambda q, a: -a * np.cos(q), lambda q, a: a * np.sin(q)),
    "spring": (lambda q, a: q**2 / 2, lambda q, a: q),
    "duffing": (lambda q, a: -(q**2) / 2 + a * q**4 / 4, lambda q, a: -q + a * q**3),
    "stone": (lambda q, a: q, lambda q, a: 1.0),
    # With kinks: a force constant beyond the size, a ball on a spring, Hertz's contact, backlash, soft walls.
    "huber": (lambda q, a: 0.5 * q * q if abs(q) < a else a * (abs(q) - a / 2), lambda q, a: min(max(q, -a), a)),
    "contact": (lambda q, a: q + 0.5 * a * min(q, 0.0) ** 2, lambda q, a: 1 + a * min(q, 0.0)),
    "hertz": (lambda q, a: q + 0.4 * a * max(-q, 0.0) ** 2.5, lambda q, a: 1 - a * max(-q, 0.0) ** 1.5),
    "backlash": (lambda q, a: 0.5 * max(abs(q) - a, 0.0) ** 2, lambda q, a: np.sign(q) * max(abs(q) - a, 0.0)),
    "walls": (lambda q, a: a / 4 * max(abs(q) - 1, 0.0) ** 4, lambda q, a: a * np.sign(q) * max(abs(q) - 1, 0.0) ** 3),
    # In the plane.
    "kepler": (lambda q, a: -1 / np.hypot(*q), lambda q, a: q / np.hypot(*q) ** 3),
    "trap": (lambda q, a: q[0] ** 2 / 2 + q[1] ** 2, lambda q, a: np.array([q[0], 2.0 * q[1]])),
    "henon": (
        lambda q, a: (q @ q) / 2 + a * (q[0] ** 2 * q[1] - q[1] ** 3 / 3),
        lambda q, a: np.array([q[0] + a * 2 * q[0] * q[1], q[1] + a * (q[0] ** 2 - q[1] ** 2)]),
    ),
    # Lattices.
    "harmonic": springs(lambda d, a: a * d, lambda d, a: a * d * d / 2),
    "toda": springs(lambda d, a: np.expm1(d), lambda d, a: np.expm1(d) - d),
    "fput": springs(lambda d, a: d + a * d * d, lambda d, a: d * d / 2 + a * d**3 / 3),
    "sine_gordon": (
        lambda q, a: a * (np.diff(q, append=q[:1]) ** 2).sum() / 2 + (1 - np.cos(q)).sum(),
        lambda q, a: -a * (np.roll(q, -1) - 2 * q + np.roll(q, 1)) + np.sin(q),
    ),
}
# Accelerations that spoil an energy.
PUSHES: dict[str, Callable[[float, Any, Any], Any]] = {
    "friction": lambda t, q, v: -v,
    "friction_after_3": lambda t, q, v: -v * max(0.0, t - 3.0) / (1 + max(0.0, t - 3.0)),
    "friction_after_5": lambda t, q, v: -v * (t > 5),
    "friction_beyond": lambda t, q, v: -v * max(0.0, q - 0.5) ** 2,
    "friction_below": lambda t, q, v: -10 * v * (q < 0),
    "drag": lambda t, q, v: -v * abs(v),
    "sine": lambda t, q, v: np.sin(1.3 * t),
    "stiffness": lambda t, q, v: -q * np.sin(2 * t),
    "kicks": lambda t, q, v: 10 * sum(np.exp(-(((t - at) / 0.2) ** 2)) for at in (6.1, 11.7, 17.3)),
    "along_axis": lambda t, q, v: np.array([1.0, 0.0]),
    "precession": lambda t, q, v: -q / np.hypot(*q) ** 5,
    "mass_loss": lambda t, q, v: np.sin(0.01 * t) * q / np.hypot(*q) ** 3,
    "air": lambda t, q, v: -(v - 1.2 * np.array([-q[1], q[0]])),  # at rest relative to a rotating planet at first
    "near_centre": lambda t, q, v: -np.exp(-((np.hypot(*q) / 0.5) ** 8)) * v,
}


def kinks(points: int) -> Array:
    """Return a kink and an antikink at rest."""
    x = np.linspace(-10, 10, points, endpoint=False)
    return np.concatenate([4 * np.arctan(np.exp(x + 5)) - 4 * np.arctan(np.exp(x - 5)), np.zeros(points)])


def mode(masses: int) -> Array:
    """Return the first mode of a row of masses."""
    return np.concatenate([np.sin(np.pi * np.arange(1, masses + 1) / (masses + 1)), np.zeros(masses)])


def mechanics(
    name: str, start: Any, end: float = 20.0, size: float = 1.0, push: str = "friction", strength: Any = 0.0,
    masses: Any = 1.0, claim: Any = None, kept: Any = ("energy",),
) -> Problem:  # fmt: skip
    """Return motion in one of the `POTENTIALS` with one of the `PUSHES`.

    The claimed energy has masses of 1, and is that of `claim`, a pair of potential and size, by default the true one.
    """
    slope, (other, own) = POTENTIALS[name][1], claim or (name, size)
    start = globals()[start[0]](*start[1:]) if isinstance(start[0], str) else start
    n, strength, masses = len(start) // 2, np.array(strength), np.array(masses)

    def split(y):
        return y if n == 1 else (y[:n], y[n:])

    def fun(t, y):
        q, v = split(y)
        return np.concatenate([y[n:], np.atleast_1d((-slope(q, size) + strength * PUSHES[push](t, q, v)) / masses)])

    def energy(t, y):
        q, _ = split(y)
        return (y[n:] ** 2).sum() / 2 + POTENTIALS[other][0](q, own)

    def gradient(t, y):
        q, _ = split(y)
        return np.concatenate([np.atleast_1d(POTENTIALS[other][1](q, own)), y[n:]])

    known = {**CLAIMS, "energy": Invariant(energy, gradient, name="energy")}
    return problem(fun, start, end, *(known[name] for name in kept))


class Verlet:
    """Velocity Verlet for a pendulum, as a one-step method that a user has written."""

    order = 2

    def __init__(self, friction: float) -> None:
        self.force = lambda q, v: -np.sin(q) - friction * v

    def one_step(self, t, y, h):
        q, v = np.split(y, 2)
        v = v + h / 2 * self.force(q, v)
        q = q + h * v
        return np.concatenate([q, v + h / 2 * self.force(q, v)])


METHODS = {"Verlet": eip_method(Verlet(0.0)), "VerletWithFriction": eip_method(Verlet(0.2))}


# The pendulum turns back, or leaves its place.
EVENTS: dict[str, Any] = {"turns_back": lambda t, y: y[1] - 1e-3, "leaves": njit(lambda t, y, params: y[0] + 0.99)}
for event, direction in (("turns_back", 1.0), ("leaves", -1.0)):
    EVENTS[event].terminal, EVENTS[event].direction = True, direction


# --- the equations of the hard cases ---


def quadratic(name: str, *weights: float) -> Invariant:
    """Return the sum of the squared moduli of the components with these weights as an invariant."""
    w = np.array(weights)
    return Invariant(lambda t, y: float((w * np.abs(y) ** 2).sum()), lambda t, y: 2 * w * y, name=name)


def linear(name: str, *weights: float) -> Invariant:
    """Return the sum of the components with these weights as an invariant."""
    w = np.array(weights, dtype=float)
    return Invariant(lambda t, y: w @ y, lambda t, y: w, name=name)


def laplace() -> Invariant:
    """Return the x component of Laplace's vector of motion around a centre with G M = 1 as an invariant."""

    def value(t, y):
        x, z, u, v = y
        return v * (x * v - z * u) - x / np.hypot(x, z)

    def gradient(t, y):
        x, z, u, v = y
        r = np.hypot(x, z)
        return np.array([v * v - 1 / r + x * x / r**3, -u * v + x * z / r**3, -z * v, 2 * x * v - z * u])

    return Invariant(value, gradient, name="A_x")


def shell() -> Invariant:
    """Return the mass shell of Schwarzschild's metric at 1.1 times the radius as an invariant."""
    right, scale = CaseEquations("schwarzschild"), np.array([1, 1.1, 1, 1, 1, 1])
    return Invariant(
        lambda t, y: right.values(t, y * scale)[0], lambda t, y: scale * right.gradients(t, y * scale)[0], name="shell"
    )


CLAIMS = {
    "A_x": laplace(),
    "L": Invariant(lambda t, y: y[0] * y[3] - y[1] * y[2], lambda t, y: np.array([y[3], -y[2], -y[1], y[0]]), name="L"),
    "shell": shell(),
    "S_x": linear("S_x", *4 * (1, 0, 0)),
    "S_z": linear("S_z", 0, 0, 1),
    "N": quadratic("N", 1, 0, -1),
    "norm": quadratic("norm", 1, 0.9, 1, 1),
    "V": Invariant(
        lambda t, y: np.log(y[0]) - y[0] + 3 * np.log(y[1]) - y[1],
        lambda t, y: np.array([1 / y[0] - 1, 3 / y[1] - 1]),
        name="V",
    ),
    "slow": quadratic("energy", 0.5, 0.5, 0, 0),
}
NUDGES: dict[str, Callable[[float, Array], Any]] = {
    "none": lambda t, y: 0.0,
    "brake": lambda t, y: -0.1 * np.array([y[0], 0.0, 0.0]),
    "field": lambda t, y: np.array([0.0, 0.0, 0.1 * np.sin(t), 0.0]),
}


def case(
    name: str, params: Any, start: Any, end: float, claim: Any = None, push: str = "none", kept: str = "I"
) -> Problem:
    """Return a system of the hard cases, spoilt by one of the `NUDGES`.

    `kept` is "I" for all invariants of the same system with the parameters `claim` (default: its own), "energy" for the
    first of them, or one of the `CLAIMS`.
    """
    system, of = (CaseEquations(name, tuple(given)) for given in (params, claim or params))
    known = {**CLAIMS, "I": Invariant(of.values, of.gradients, name="I")}
    known["energy"] = Invariant(
        lambda t, y, *_: of.values(t, y)[0], lambda t, y, *_: of.gradients(t, y)[0], name="energy"
    )
    return problem(lambda t, y: system.fun(t, y) + NUDGES[push](t, y), np.array(start), end, known[kept])


def hard_case(name: str) -> Problem:
    """Return one of the hard cases."""
    return hard_cases([name])[0].problem


def epidemic(infection: float, recovery: float, infected: float) -> Problem:
    """Return an epidemic, of which a part of the population has this part infected at first."""
    return case("sir", (infection, recovery), [1 - infected, infected, 0.0], 60.0)


def turning_field() -> Problem:
    """Return a spin in a field that turns, with its component along the axis."""
    return problem(lambda t, y: np.cross(y, [np.sin(t), 0.0, 1.0]), [0.6, 0.0, 0.8], 20.0, CLAIMS["S_z"])


def two_oscillators() -> Problem:
    """Return two oscillators of periods 0.25 and 6.3; the claimed energy is that of the slow one only."""
    return problem(lambda t, y: np.array([y[1], -y[0], y[3], -625 * y[2]]), [1, 0, 1, 0], 20.0, CLAIMS["slow"])


def relativistic_planets() -> Problem:
    """Return planets with post-Newtonian terms, and Newton's energy."""
    planets, masses = solar_system(years=1.0, forces="1pn"), solar_system().params
    assert masses is not None
    newton = case("n_body", (masses.tolist(), 1.0, 3), planets.y0, 1.0, kept="energy")
    return replace(planets, invariants=newton.invariants, reference=None)


def from_apocentre(e: float = 0.99) -> Problem:
    """Return an orbit that starts at its apocentre."""
    return replace(kepler(e, 0.0, 30.0), y0=np.array([-(1 + e), 0, 0, -np.sqrt((1 - e) / (1 + e))]), reference=None)


def fictitious() -> Problem:
    """Return an orbit with e = 0.9 in fictitious time."""
    return time_transformed(kepler(0.9, 0.0), 40.0, centre_time)


# --- fields ---

# Potentials of t and x.
WELLS: dict[str, Callable[[float, Array], Any]] = {
    "trap": lambda t, x: x**2 / 2,
    "other_trap": lambda t, x: 0.45 * x**2,
    "absorbing": lambda t, x: x**2 / 2 - 0.5j * np.exp(-((x + 5) ** 2)),
    "lossy": lambda t, x: x**2 / 2 - 1e-3j * np.maximum(x, 0) ** 2,
    "shaken": lambda t, x: x**2 / 2 + 0.3 * x * np.sin(t),
}


def waves(
    end: float, well: str = "trap", claim: str = "", beta: float = 0.0, claimed_beta: float | None = None,
    centre: float = 1.0, width: float = 2.0, phase: int = 0, keep: Any = ("mass", "energy"),
) -> Problem:  # fmt: skip
    """Return i psi' = -psi''/2 + V psi + beta |psi|^2 psi on a periodic line, with claimed mass and energy.

    V is one of the `WELLS`, `claim` and `claimed_beta` are V and beta in the claimed energy, by default the true ones
    at t = 0. The field starts as a packet at `centre`, with the phase x to the power of `phase` if that is not 0.
    """
    x = np.linspace(-8, 8, 64, endpoint=False)
    dx = x[1] - x[0]
    k2 = (2 * np.pi * np.fft.fftfreq(64, dx)) ** 2
    V, b = np.real(WELLS[claim or well](0.0, x)), beta if claimed_beta is None else claimed_beta

    def kinetic(psi):
        return np.fft.ifft(k2 / 2 * np.fft.fft(psi))

    def fun(t, psi):
        return -1j * (kinetic(psi) + (WELLS[well](t, x) + beta * np.abs(psi) ** 2) * psi)

    def energy(t, psi):
        density = np.abs(psi) ** 2
        return float((np.vdot(psi, kinetic(psi)).real + (V * density + b / 2 * density**2).sum()) * dx)

    def slope(t, psi):
        return 2 * dx * (kinetic(psi) + (V + b * np.abs(psi) ** 2) * psi)

    mass = Invariant(lambda t, psi: float(np.vdot(psi, psi).real * dx), lambda t, psi: 2 * dx * psi, name="mass")
    known = {"mass": mass, "energy": Invariant(energy, slope, name="energy")}
    exponent = -((x - centre) ** 2) / width
    start = np.exp(exponent + 1j * x**phase) if phase else np.exp(exponent) + 0j
    return problem(fun, start, end, *(known[name] for name in keep))


def shaken_condensate() -> Problem:
    """Return a condensate that is shaken from t = 0 on, with the joint mass and energy of one that is not shaken."""
    grid = Grid((16, 16), -4.0, 4.0)
    x, y = grid.mesh()
    psi = np.exp(-((x - 0.5) ** 2 + y**2) / 2)
    resting = GrossPitaevskii(grid, condensates.harmonic_trap(1.0, 1.0), beta=10.0).problem(
        psi, 2.0, 4e-3, name="condensate"
    )
    return replace(resting, fun=lambda t, psi: resting.fun(t, psi) - 1j * np.sin(t) * (x + 0 * y).ravel() * psi)


# --- wrong gradients ---

CHANGES: dict[str, Callable[[Array], Array]] = {
    "none": lambda G: G,
    "permuted": lambda G: np.roll(G, 1),
    "conjugated": np.conj,
    "swapped": lambda G: G[[0, 1, 2, 3, 10, 5, 6, 7, 8, 9, 4, 11]],
}


def spoilt(on: str, factor: float = 1.0, at: Any = slice(None), way: str = "none") -> Problem:
    """Return a system with a correct energy and a wrong gradient; "chain" moves at one end only at first.

    The components `at` of the gradient are multiplied by `factor`, and `way` names one of the `CHANGES`.
    """
    made = {
        "henon": partial(mechanics, "henon", (0.3, 0.2, 0.1, 0.2), 50.0),
        "moving": partial(mechanics, "henon", (1.0, 0.5, 0.3, 0.2), 10.0),
        "chain": partial(mechanics, "toda", (0.8, *np.zeros(11))),
        "waves": partial(waves, 2.0, phase=1),
    }[on]()
    *others, energy = made.invariants

    def gradient(t, y):
        G = np.array(energy.grad(t, y))
        G[at] *= factor
        return CHANGES[way](G)

    return replace(made, invariants=(*others, Invariant(energy.fun, gradient, name="energy")))


# --- compiled: jitted equations and energies, written to `out` ---


_spring_acc = njit(lambda t, q, params: -params[0] * q + params[2] * np.sin(params[3] * t))
_spring_energy = njit(lambda t, y, params: 0.5 * (y[1] * y[1] + params[0] * y[0] * y[0]))
_pendulum_energy = njit(lambda t, y, params: 0.5 * y[1] * y[1] - math.cos(y[0]))
_trap_acc = njit(lambda t, q, params: np.array([-q[0], -params[0] * q[1]]))
_turning = njit(lambda t, y, params: y[0] * y[3] - y[1] * y[2])


@njit
def _spring(t, y, out, params):  # params: square of the frequency, friction, strength of a force, its frequency
    out[0] = y[1]
    out[1] = -params[0] * y[0] - params[1] * y[1] + params[2] * np.sin(params[3] * t)


@njit
def _spring_slope(t, y, out, params):
    out[0], out[1] = params[0] * y[0], y[1]


@njit
def _doubled_slope(t, y, out, params):
    out[0], out[1] = 2 * params[0] * y[0], 2 * y[1]


@njit
def _pendulum(t, y, out, params):
    out[0], out[1] = y[1], -math.sin(y[0]) - params[0] * y[1]


@njit
def _pendulum_slope(t, y, out, params):
    out[0], out[1] = math.sin(y[0]), y[1]


@njit
def _trap(t, y, out, params):
    out[0], out[1], out[2], out[3] = y[2], y[3], -y[0], -params[0] * y[1]


@njit
def _turning_slope(t, y, out, params):
    out[0], out[1], out[2], out[3] = y[3], -y[2], -y[1], y[0]


def compiled(
    rhs: Any, value: Any, slope: Any, start: Any, end: float, params: Any, acc: Any = None, members: bool = False
) -> Problem:
    """Return a problem of jitted functions; for `members` the invariant takes the parameters of each one."""
    y0, params, name = np.array(start, dtype=float), np.array(params), "L" if value is _turning else "energy"

    def fun(t, y):
        out = np.empty(y.size)
        rhs(t, y, out, params)
        return out

    kept = Invariant(value, slope, args=() if members else (params,), in_place=True, name=name)
    return Problem(name, fun, rhs=rhs, acc=acc, y0=y0, t_span=(0.0, end), params=params, invariants=(kept,))


def compiled_spring(
    square: float = 1.0, friction: float = 0.0, force: float = 0.0, frequency: float = 1.0, end: float = 20.0,
    start: Any = (1.0, 0.0), doubled: bool = False, members: bool = False,
) -> Problem:  # fmt: skip
    """Return a spring with friction and the force ``force * sin(frequency * t)``, with the energy of a free spring.

    The gradient of the energy may be `doubled`.
    """
    params, acc = [square, friction, force, frequency], None if friction else _spring_acc
    slope = _doubled_slope if doubled else _spring_slope
    return compiled(_spring, _spring_energy, slope, start, end, params, acc, members)


def compiled_pendulum(
    friction: float = 0.0, end: float = 20.0, start: Any = (2.0, 0.0), members: bool = False
) -> Problem:
    """Return a pendulum with friction, with the energy of one without."""
    return compiled(_pendulum, _pendulum_energy, _pendulum_slope, start, end, [friction], members=members)


def compiled_trap(square: float) -> Problem:
    """Return a body in a trap that starts on an axis, with its angular momentum; `square` is 1 in an isotropic trap."""
    return compiled(_trap, _turning, _turning_slope, (1.0, 0.0, 0.0, 0.5), 20.0, [square], _trap_acc)
