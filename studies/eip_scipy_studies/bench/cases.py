"""Problems of the bench: equations as a user writes them, starts, spans, and reference states at the end.

The functions of a small system are made from a module that has sqrt, sin and cos (`math` for Python and Numba, heyoka,
jax.numpy), so that all packages get the same expressions. ``tools/bench_references.py`` computes the references in
80-bit arithmetic by a method that no package here uses.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property
from importlib import import_module
from importlib.resources import files
from typing import Any, NamedTuple

import numpy as np

from eip_scipy import problems
from eip_scipy.problems import MechanicsProblem

from .mechanisms import EXAMPLES

DELTA, MU, GRAVITY = 0.005, 1.215058560962404e-2, 1.0
INERTIA = (2.0, 1.0, 2.0 / 3.0)
ATOMS, MEMBERS, YEARS = 64, 1000, (100.0, 1000.0)


class Functions(NamedTuple):
    """Right-hand side f(t, y), acceleration a(t, q) or None, and invariants I(t, y) by name."""

    fun: Callable[..., Any]
    acceleration: Callable[..., Any] | None
    invariants: Mapping[str, Callable[..., Any]]


def kepler(m: Any, delta: float = DELTA) -> Functions:
    """Return a perturbed Kepler problem, H = v^2/2 - 1/r - delta/(2 r^3); with delta = 0 Kepler's own."""

    def acceleration(t, q):  # type: ignore[no-untyped-def]
        r2 = q[0] * q[0] + q[1] * q[1]
        w = -(1.0 + 1.5 * delta / r2) / (r2 * m.sqrt(r2))
        return w * q[0], w * q[1]

    def fun(t, y):  # type: ignore[no-untyped-def]
        r2 = y[0] * y[0] + y[1] * y[1]
        w = -(1.0 + 1.5 * delta / r2) / (r2 * m.sqrt(r2))
        return y[2], y[3], w * y[0], w * y[1]

    def energy(t, y):  # type: ignore[no-untyped-def]
        r2 = y[0] * y[0] + y[1] * y[1]
        return 0.5 * (y[2] * y[2] + y[3] * y[3]) - (1.0 + 0.5 * delta / r2) / m.sqrt(r2)

    def momentum(t, y):  # type: ignore[no-untyped-def]
        return y[0] * y[3] - y[1] * y[2]

    return Functions(fun, acceleration, {"H": energy, "L": momentum})


def henon_heiles(m: Any) -> Functions:
    """Return the system of Hénon and Heiles."""

    def acceleration(t, q):  # type: ignore[no-untyped-def]
        return -q[0] - 2.0 * q[0] * q[1], -q[1] - q[0] * q[0] + q[1] * q[1]

    def fun(t, y):  # type: ignore[no-untyped-def]
        return y[2], y[3], -y[0] - 2.0 * y[0] * y[1], -y[1] - y[0] * y[0] + y[1] * y[1]

    def energy(t, y):  # type: ignore[no-untyped-def]
        square = y[0] * y[0] + y[1] * y[1] + y[2] * y[2] + y[3] * y[3]
        return 0.5 * square + y[0] * y[0] * y[1] - y[1] * y[1] * y[1] / 3.0

    return Functions(fun, acceleration, {"H": energy})


def double_pendulum(m: Any) -> Functions:
    """Return two equal point masses on equal rods: angles and their momenta."""

    def fun(t, y):  # type: ignore[no-untyped-def]
        c, s = m.cos(y[0] - y[1]), m.sin(y[0] - y[1])
        d = 1.0 / (1.0 + s * s)
        first = y[2] * y[3] * s * d
        second = (y[2] * y[2] + 2.0 * y[3] * y[3] - 2.0 * y[2] * y[3] * c) * s * c * d * d
        return (
            (y[2] - y[3] * c) * d,
            (2.0 * y[3] - y[2] * c) * d,
            second - first - 2.0 * GRAVITY * m.sin(y[0]),
            first - second - GRAVITY * m.sin(y[1]),
        )

    def energy(t, y):  # type: ignore[no-untyped-def]
        c, s = m.cos(y[0] - y[1]), m.sin(y[0] - y[1])
        kinetic = 0.5 * (y[2] * y[2] + 2.0 * y[3] * y[3] - 2.0 * y[2] * y[3] * c) / (1.0 + s * s)
        return kinetic - GRAVITY * (2.0 * m.cos(y[0]) + m.cos(y[1]))

    return Functions(fun, None, {"H": energy})


def halo(m: Any) -> Functions:
    """Return the circular restricted problem of three bodies, Earth and Moon, in the rotating frame."""

    def fun(t, y):  # type: ignore[no-untyped-def]
        a, b = y[0] + MU, y[0] - 1.0 + MU
        side = y[1] * y[1] + y[2] * y[2]
        r2, s2 = a * a + side, b * b + side
        u, w = (1.0 - MU) / (r2 * m.sqrt(r2)), MU / (s2 * m.sqrt(s2))
        return (
            y[3], y[4], y[5],
            y[0] + 2.0 * y[4] - u * a - w * b, y[1] - 2.0 * y[3] - (u + w) * y[1], -(u + w) * y[2],
        )  # fmt: skip

    def jacobi(t, y):  # type: ignore[no-untyped-def]
        a, b = y[0] + MU, y[0] - 1.0 + MU
        side = y[1] * y[1] + y[2] * y[2]
        potential = 0.5 * (y[0] * y[0] + y[1] * y[1]) + (1.0 - MU) / m.sqrt(a * a + side) + MU / m.sqrt(b * b + side)
        return 0.5 * (y[3] * y[3] + y[4] * y[4] + y[5] * y[5]) - potential

    return Functions(fun, None, {"E": jacobi})


def rigid_body(m: Any) -> Functions:
    """Return a free top; y is its angular momentum."""
    a, b, c = (
        1.0 / INERTIA[2] - 1.0 / INERTIA[1],
        1.0 / INERTIA[0] - 1.0 / INERTIA[2],
        1.0 / INERTIA[1] - 1.0 / INERTIA[0],
    )

    def fun(t, y):  # type: ignore[no-untyped-def]
        return a * y[1] * y[2], b * y[2] * y[0], c * y[0] * y[1]

    def energy(t, y):  # type: ignore[no-untyped-def]
        return 0.5 * (y[0] * y[0] / INERTIA[0] + y[1] * y[1] / INERTIA[1] + y[2] * y[2] / INERTIA[2])

    def casimir(t, y):  # type: ignore[no-untyped-def]
        return y[0] * y[0] + y[1] * y[1] + y[2] * y[2]

    return Functions(fun, None, {"E": energy, "C": casimir})


def particle(m: Any) -> Functions:
    """Return the paper's charge: B = e_z, potential 0.01/r, position and velocity."""

    def fun(t, y):  # type: ignore[no-untyped-def]
        r2 = y[0] * y[0] + y[1] * y[1]
        e = 0.01 / (r2 * m.sqrt(r2))
        return y[2], y[3], e * y[0] + y[3], e * y[1] - y[2]

    def energy(t, y):  # type: ignore[no-untyped-def]
        return 0.5 * (y[2] * y[2] + y[3] * y[3]) + 0.01 / m.sqrt(y[0] * y[0] + y[1] * y[1])

    def momentum(t, y):  # type: ignore[no-untyped-def]
        return y[0] * y[3] - y[1] * y[2] + 0.5 * (y[0] * y[0] + y[1] * y[1])

    return Functions(fun, None, {"H": energy, "L": momentum})


def robertson(m: Any) -> Functions:
    """Return Robertson's stiff reactions."""

    def fun(t, y):  # type: ignore[no-untyped-def]
        first, second, third = 0.04 * y[0], 1e4 * y[1] * y[2], 3e7 * y[1] * y[1]
        return second - first, first - second - third, third

    def mass(t, y):  # type: ignore[no-untyped-def]
        return y[0] + y[1] + y[2]

    return Functions(fun, None, {"mass": mass})


def magnet(m: Any) -> Functions:
    """Return a magnetic moment in a rotating field, with strong damping (Landau and Lifshitz)."""

    def fun(t, y):  # type: ignore[no-untyped-def]
        a, b, c = 1e3 * m.cos(t), 1e3 * m.sin(t), 500.0 + 1e3 * y[2]
        u, v, w = y[1] * c - y[2] * b, y[2] * a - y[0] * c, y[0] * b - y[1] * a
        return (
            -u - 5.0 * (y[1] * w - y[2] * v),
            -v - 5.0 * (y[2] * u - y[0] * w),
            -w - 5.0 * (y[0] * v - y[1] * u),
        )

    def length(t, y):  # type: ignore[no-untyped-def]
        return y[0] * y[0] + y[1] * y[1] + y[2] * y[2]

    return Functions(fun, None, {"length": length})


def bodies(m: Any, gm: Any) -> Functions:
    """Return N bodies with G times their masses `gm`, by loops over pairs; they fill arrays."""
    gm, n = np.array(gm), len(gm)

    def acceleration(t, q):  # type: ignore[no-untyped-def]
        out = np.zeros(3 * n)
        for i in range(n):
            for j in range(i):
                x, y, z = q[3 * i] - q[3 * j], q[3 * i + 1] - q[3 * j + 1], q[3 * i + 2] - q[3 * j + 2]
                r2 = x * x + y * y + z * z
                w = 1.0 / (r2 * np.sqrt(r2))
                a, b = w * gm[j], w * gm[i]
                out[3 * i] -= a * x
                out[3 * i + 1] -= a * y
                out[3 * i + 2] -= a * z
                out[3 * j] += b * x
                out[3 * j + 1] += b * y
                out[3 * j + 2] += b * z
        return out

    def energy(t, y):  # type: ignore[no-untyped-def]
        total = 0.0
        for i in range(n):
            u, v, w = y[3 * n + 3 * i], y[3 * n + 3 * i + 1], y[3 * n + 3 * i + 2]
            total += 0.5 * gm[i] * (u * u + v * v + w * w)
            for j in range(i):
                a, b, c = y[3 * i] - y[3 * j], y[3 * i + 1] - y[3 * j + 1], y[3 * i + 2] - y[3 * j + 2]
                total -= gm[i] * gm[j] / np.sqrt(a * a + b * b + c * c)
        return total

    def momentum(t, y):  # type: ignore[no-untyped-def]
        out = np.zeros(3)
        for i in range(n):
            x, y1, z = y[3 * i], y[3 * i + 1], y[3 * i + 2]
            u, v, w = y[3 * n + 3 * i], y[3 * n + 3 * i + 1], y[3 * n + 3 * i + 2]
            out[0] += gm[i] * (y1 * w - z * v)
            out[1] += gm[i] * (z * u - x * w)
            out[2] += gm[i] * (x * v - y1 * u)
        return out

    return Functions(None, acceleration, {"H": energy, "L": momentum})  # type: ignore[arg-type]


def atoms(m: Any) -> Functions:
    """Return atoms of unit mass with Lennard-Jones forces, 4 (r^-12 - r^-6)."""
    n = ATOMS

    def acceleration(t, q):  # type: ignore[no-untyped-def]
        out = np.zeros(3 * n)
        for i in range(n):
            for j in range(i):
                x, y, z = q[3 * i] - q[3 * j], q[3 * i + 1] - q[3 * j + 1], q[3 * i + 2] - q[3 * j + 2]
                s = 1.0 / (x * x + y * y + z * z)
                s6 = s * s * s
                w = 24.0 * s * s6 * (2.0 * s6 - 1.0)
                out[3 * i] += w * x
                out[3 * i + 1] += w * y
                out[3 * i + 2] += w * z
                out[3 * j] -= w * x
                out[3 * j + 1] -= w * y
                out[3 * j + 2] -= w * z
        return out

    def energy(t, y):  # type: ignore[no-untyped-def]
        total = 0.0
        for i in range(n):
            u, v, w = y[3 * n + 3 * i], y[3 * n + 3 * i + 1], y[3 * n + 3 * i + 2]
            total += 0.5 * (u * u + v * v + w * w)
            for j in range(i):
                a, b, c = y[3 * i] - y[3 * j], y[3 * i + 1] - y[3 * j + 1], y[3 * i + 2] - y[3 * j + 2]
                s = 1.0 / (a * a + b * b + c * c)
                s6 = s * s * s
                total += 4.0 * s6 * (s6 - 1.0)
        return total

    return Functions(None, acceleration, {"H": energy})  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class Case:
    """A problem of the bench.

    `make(m)` returns its `Functions`; they return tuples if `scalar`, arrays otherwise. `y0` is (n,), or (members, n)
    for many members. `steps` are the numbers of steps with which methods of fixed steps begin, by method. `hamiltonian`
    is H as text with its variables; `ready()` the library's own problem with its `to_own`, which takes a state of that
    problem to one of ours. `gm` is given for bodies, `stiff` for stiff systems. A `mechanism` makes its own functions;
    its reference has positions only.
    """

    name: str
    title: str
    make: Callable[[Any], Functions]
    y0: np.ndarray
    t_end: float
    scalar: bool = True
    steps: Mapping[str, int] = field(default_factory=dict)
    hamiltonian: tuple[str, str, str] | None = None
    ready: Callable[[], Any] | None = None
    to_own: Callable[[np.ndarray], np.ndarray] = np.asarray
    gm: Any = None
    stiff: bool = False
    mechanism: Callable[[], MechanicsProblem] | None = None

    @property
    def members(self) -> bool:
        """Return True if there are many starts."""
        return self.y0.ndim == 2

    @cached_property
    def end(self) -> np.ndarray:
        """Return the reference state at the end; members return to their starts."""
        return self.y0 if self.members else np.array(_references()[self.name])

    @cached_property
    def plain(self) -> Functions:
        """Return the functions in Python; those of the right-hand side return arrays."""
        return _arrays(self.make(math), self, lambda function: function)

    @cached_property
    def jitted(self) -> Functions:
        """Return the functions as a user jits them: arrays are returned, and gradients are not given."""
        return _arrays(self.make(math), self, import_module("numba").njit)

    def error(self, y: Any) -> float:
        """Return the largest error of a component of the reference, relative to its largest component."""
        difference = np.asarray(y)[: len(self.end)] - self.end
        return float(np.max(np.abs(difference)) / np.max(np.abs(self.end)))


def _arrays(functions: Functions, case: Case, jit: Callable[..., Any]) -> Functions:
    acceleration, fun = functions.acceleration, functions.fun
    if case.scalar:

        def wrapped(function: Any) -> Any:
            inner = jit(function)
            return jit(lambda t, y: np.array(inner(t, y)))

        acceleration = None if acceleration is None else wrapped(acceleration)
        fun = wrapped(fun)
    else:
        inner = acceleration = jit(acceleration)

        def first_order(t, y):  # type: ignore[no-untyped-def]
            half = y.size // 2
            return np.concatenate((y[half:], inner(t, y[:half])))

        fun = jit(first_order)
    return Functions(fun, acceleration, {name: jit(item) for name, item in functions.invariants.items()})


def gravity(name: str, title: str, ready: Callable[[], problems.Problem], steps: Mapping[str, int]) -> Case:
    """Return a problem of the library with N bodies under Newton's gravitation."""
    problem = ready()
    assert problem.params is not None
    gm = problem.params[: problem.y0.size // 6].copy()
    return Case(
        name, title, lambda m: bodies(m, gm), problem.y0, problem.t_span[1],
        scalar=False, steps=steps, ready=ready, gm=gm,
    )  # fmt: skip


def ten_bodies(years: float) -> Case:
    """Return the Sun, the planets' systems and Pluto, from DE440, for some years."""
    steps = {"EIPRKN12": round(40 * years), "EIPGJ14": round(400 * years), "WHFast": round(40 * years)}
    ready = lambda: problems.solar_system(years=years)  # noqa: E731
    return gravity(f"ten bodies, {years:g} years", "Sun, planets and Pluto (DE440)", ready, steps)


def resonant_chain() -> problems.Problem:
    """Return seven planets with the periods, masses and transits of TRAPPIST-1's, on circles at the start.

    The periods' ratios are near 8:5, 5:3, 3:2, 3:2, 4:3 and 3:2. The units are AU and years.
    """
    solar = 4 * np.pi**2
    days = np.array([1.510826, 2.421937, 4.049219, 6.101013, 9.207540, 12.352446, 18.772866])
    transits = np.array([7.55044, 8.58728, 7.06768, 7.82771, 7.07426, 7.71462, -0.39324])
    masses = np.array([0.0898, *(3.003e-6 * np.array([1.374, 1.308, 0.388, 0.692, 1.039, 1.321, 0.326]))])
    axes, phases = (masses[0] * (days / 365.25) ** 2) ** (1 / 3), 2 * np.pi * (7.93 - transits) / days
    q, v = np.zeros((8, 3)), np.zeros((8, 3))
    q[1:, 0], q[1:, 1] = axes * np.cos(phases), axes * np.sin(phases)
    speeds = np.sqrt(solar * (masses[0] + masses[1:]) / axes)
    v[1:, 0], v[1:, 1] = -speeds * np.sin(phases), speeds * np.cos(phases)
    shares = masses / masses.sum()
    return problems.nbody(solar * masses, q - shares @ q, v - shares @ v, t_span=(0.0, 3.0))


def _crystal() -> np.ndarray:
    side = np.arange(4.0) * 2 ** (1 / 6)
    positions = np.stack(np.meshgrid(side, side, side, indexing="ij"), -1).reshape(-1, 3)
    velocities = np.random.default_rng(1).standard_normal((ATOMS, 3)) * 0.5
    return np.concatenate([positions.ravel(), (velocities - velocities.mean(0)).ravel()])


def _planar(y: np.ndarray) -> np.ndarray:
    return y[[0, 1, 3, 4]]


def _of_its_own(m: Any) -> Functions:
    raise TypeError("a mechanism has functions of its own")


def _made() -> tuple[Case, ...]:
    e = np.linspace(0.0, 0.6, MEMBERS)
    circle = np.array([1 - e, 0 * e, 0 * e, np.sqrt((1 + e) / (1 - e))]).T
    turn = 2 * math.pi
    return (
        Case(
            "perturbed Kepler", "1000 periods, e = 0.6", kepler, np.array([0.4, 0.0, 0.0, 2.0]), 1000 * turn,
            steps={"EIPRKN12": 25_000, "EIPGJ14": 400_000},
            hamiltonian=("(px**2 + py**2)/2 - 1/sqrt(x**2 + y**2) - 0.0025/sqrt(x**2 + y**2)**3", "x y", "px py"),
            ready=lambda: problems.kepler(0.6, DELTA, 1000 * turn),
        ),
        Case(
            "Hénon-Heiles", "t = 1000, regular", henon_heiles, np.array([0.12, 0.12, 0.12, 0.12]), 1000.0,
            steps={"EIPRKN12": 1200, "EIPGJ14": 20_000},
            hamiltonian=("(px**2 + py**2 + x**2 + y**2)/2 + x**2*y - y**3/3", "x y", "px py"),
        ),
        Case(
            "double pendulum", "t = 100", double_pendulum, np.array([0.8, 0.9, 0.0, 0.0]), 100.0,
            hamiltonian=(
                "(p1**2 + 2*p2**2 - 2*p1*p2*cos(q1 - q2))/(2*(1 + sin(q1 - q2)**2)) - 2*cos(q1) - cos(q2)",
                "q1 q2", "p1 p2",
            ),
        ),
        Case(
            "halo orbit", "Near-rectilinear, Earth and Moon, 3 periods", halo,
            np.array([1.0218881345465263, 0.0, -0.18209648779851, 0.0, -0.10325634106279, 0.0]), 3 * 1.511261560928471,
        ),
        Case("rigid body", "t = 1000", rigid_body, np.array([0.6, 0.0, 0.8]), 1000.0),
        *(ten_bodies(years) for years in YEARS),
        gravity(
            "resonant chain", "Seven exoplanets like TRAPPIST-1's, 725 revolutions", resonant_chain,
            {"EIPRKN12": 8700, "EIPGJ14": 72_500, "WHFast": 14_500},
        ),
        gravity("close encounter", "A comet past Jupiter at 3 radii, 20 years", problems.comet, {"WHFast": 1600}),
        Case(
            "Lennard-Jones", "64 atoms, t = 3", atoms, _crystal(), 3.0, scalar=False,
            steps={"EIPRKN12": 40, "EIPGJ14": 800},
        ),
        Case(
            "Kepler members", "1000 orbits, e from 0 to 0.6, ten revolutions", lambda m: kepler(m, 0.0), circle,
            10 * turn,
            steps={"EIPRKN12": 250},
        ),
        Case(
            "charged particle", "The paper's, 270 000 steps of pi/10", particle, np.array([0.0, -1.0, 0.1, 0.01]),
            27_000 * math.pi, ready=lambda: problems.uniform_field(form="velocity"), to_own=_planar,
        ),
        Case("Robertson", "Stiff kinetics to t = 1e5", robertson, np.array([1.0, 0.0, 0.0]), 1e5, stiff=True),
        Case("magnet", "Stiff, damped, to t = 5", magnet, np.array([0.6, 0.0, 0.8]), 5.0, stiff=True),
        *(
            Case(name, title, _of_its_own, np.empty(0), t_end, scalar=False, mechanism=EXAMPLES[name])
            for name, title, t_end in (
                ("four-bar", "Linkage by SymPy's KanesMethod, 30 s", 30.0),
                ("andrews", "Squeezing mechanism of the test set for initial value problem solvers", 0.03),
                ("wobbling disc", "A disc that rolls, 5 s", 5.0),
            )
        ),
    )  # fmt: skip


@cache
def _references() -> dict[str, list[float]]:
    return json.loads(files("eip_scipy_studies.data").joinpath("bench_references.json").read_text(encoding="utf-8"))


CASES: Mapping[str, Case] = {case.name: case for case in _made()}
