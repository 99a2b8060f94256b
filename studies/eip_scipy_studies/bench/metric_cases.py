"""Cases of ``eip-scipy bench metric``: contacts, discs, particles in SI units, mechanisms, planets in rotated axes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from eip_scipy import EIPDOP853, EIPRK4, EIPRK5, EIPRK45, Invariant, integrate
from eip_scipy.problems import nbody, solar_system

from ..report import needed
from .mechanisms import EXAMPLES

njit = needed("numba", '"eip_scipy[numba]"').njit
METRICS: dict[str, dict[str, Any]] = {"none": {"invariants": ()}, "euclidean": {"metric": "euclidean"}, "default": {}}
METHODS = EIPRK4, EIPRK5, EIPRK45, EIPDOP853
LONG, SHORT = (0.01, 0.02, 0.05), (0.005, 0.01, 0.02)


def at(seen: Any = ...) -> Callable[[Any], np.ndarray]:
    """Return a function of a run with the components `seen` of its last state."""
    return lambda run: np.asarray(run.y[seen, -1])


@dataclass
class Case:
    """A problem with its invariants, its methods, and the steps or (if `adaptive`) tolerances with which it is run.

    `measured(run)` is the vector whose error counts, by default the last state, and `known` its true value.
    """

    group: str
    name: str
    fun: Any
    kept: tuple[Any, ...]
    y0: np.ndarray
    end: float
    steps: tuple[float, ...]
    methods: tuple[Any, ...] = METHODS
    adaptive: bool = False
    options: dict[str, Any] = field(default_factory=dict)
    exact: dict[str, Any] = field(default_factory=lambda: {"rtol": 1e-12, "atol": 1e-13})
    known: np.ndarray | None = None
    measured: Callable[[Any], np.ndarray] = field(default_factory=at)

    @cached_property
    def reference(self) -> np.ndarray:
        """Return the true vector: `known`, or that of EIPDOP853 with the options `exact`."""
        if self.known is not None:
            return self.known
        options = {"method": EIPDOP853, **self.options, **self.exact, **METRICS["none"]}
        return self.measured(integrate(self.fun, (0, self.end), self.y0, **options))

    def run(self, method: Any, step: float, metric: Mapping[str, Any]) -> float:
        """Return the error of what is measured; inf if the run failed."""
        control = {"rtol": step, "atol": step} if self.adaptive else {"h": step}
        options = {"invariants": self.kept, **control, **self.options, **metric}
        run = integrate(self.fun, (0, self.end), self.y0, method=method, **options)
        if not run.success:
            return np.inf
        return float(np.abs(self.measured(run) - self.reference).max() / np.abs(self.reference).max())


# Bonds: y = (q, p), q' = p / mass, and the potential sum_k law(d_k). The elongation d_k is B_k q, or the distance
# |(B_k q, C_k q)| if C_k is not 0. `params` has the number of bonds and the mass, then for each bond its kind, three
# numbers, B_k and C_k.
EVEN, ONE_SIDED, HUBER, WEIGHT, LENNARD_JONES = 0.0, 1.0, 2.0, 3.0, 4.0


@njit
def law(kind, a, b, p, d):  # type: ignore[no-untyped-def]
    """Return the energy and the force -dV/dd of a bond with the elongation d."""
    if kind == LENNARD_JONES:  # it ends at a
        s = d**-6.0
        return (4 * (s * s - s - a**-12 + a**-6), 24 * (2 * s * s - s) / d) if d < a else (0.0, 0.0)
    if kind == HUBER:
        return (0.5 * d * d, -d) if abs(d) < a else (a * (abs(d) - 0.5 * a), -a * np.sign(d))
    if kind == WEIGHT:
        return b * d, -b
    depth, side = (abs(d) - a, np.sign(d)) if kind == EVEN else (d - a, 1.0)
    return (b * depth ** (p + 1) / (p + 1), -b * depth**p * side) if depth > 0 else (0.0, 0.0)


@njit
def forces(q, out, params):  # type: ignore[no-untyped-def]
    """Write the forces to `out`, and return the potential energy."""
    n, total = q.size, 0.0
    out[:] = 0.0
    for k in range(int(params[0])):
        row = params[2 + k * (4 + 2 * n) : 2 + (k + 1) * (4 + 2 * n)]
        x = y = 0.0
        for i in range(n):
            x, y = x + row[4 + i] * q[i], y + row[4 + n + i] * q[i]
        d = x if y == 0 and not row[4 + n :].any() else np.sqrt(x * x + y * y)
        value, force = law(row[0], row[1], row[2], row[3], d)
        total += value
        if force != 0:
            for i in range(n):
                out[i] += force / d * (row[4 + i] * x + row[4 + n + i] * y) if d != 0 else force * row[4 + i]
    return total


@njit
def bonded(t, y, out, params):  # type: ignore[no-untyped-def]
    """Write the derivative of y = (q, p) to `out`."""
    n = y.size // 2
    out[:n] = y[n:] / params[1]
    forces(y[:n], out[n:], params)


@njit
def bonded_energy(t, y, params):  # type: ignore[no-untyped-def]
    """Return the energy."""
    n = y.size // 2
    return 0.5 * (y[n:] ** 2).sum() / params[1] + forces(y[:n], np.empty(n), params)


@njit
def bonded_slope(t, y, out, params):  # type: ignore[no-untyped-def]
    """Write the gradient of the energy to `out`."""
    n = y.size // 2
    forces(y[:n], out[:n], params)
    out[:n] *= -1.0
    out[n:] = y[n:] / params[1]


TURNING = Invariant(njit(lambda t, y, params: y[0] * y[3] - y[1] * y[2]), name="L")
ENERGY = Invariant(bonded_energy, grad=bonded_slope, in_place=True, name="energy")


def bonds(
    group: str, name: str, rows: Any, y0: Any, end: float, steps: Any, *also: Any, mass: float = 1.0, **more: Any
) -> Case:
    """Return a system of bonds, each a row (kind, a, b, p, B, C), without C where it is 0."""
    n = len(y0) // 2
    padded = [[*row, *[0.0] * (4 + 2 * n - len(row))] for row in rows]
    options = {"in_place": True, "params": np.array([len(rows), mass, *np.ravel(padded)])}
    return Case(group, name, bonded, (ENERGY, *also), np.array(y0), end, steps, options=options, **more)


def chain(count: int, *law: float) -> list[list[float]]:
    """Return bonds between walls and neighbours of `count` bodies on a line; elongations are positive in contact."""
    return [[*law, *row] for row in np.eye(count + 1, count, -1) - np.eye(count + 1, count)]


def contacts() -> Iterator[Case]:
    """Yield dead zones, soft walls, Hertz contacts, and springs of constant force beyond an elongation."""
    for start in ((1.2, 0.0), (0.0, 1.0), (0.7, -0.3)):
        for k in (1.0, 10.0, 100.0):
            yield bonds("backlash", f"k = {k:g}, start {start}", [[EVEN, 0.5, k, 1, 1]], start, 40.0, LONG)
    for k in (10.0, 100.0):
        rows = [[EVEN, 0, 1, 1, 1, 0], [EVEN, 0.5, k, 1, 1, -1]]
        yield bonds("backlash", f"gear, k = {k:g}", rows, [1.0, 0.3, 0.0, 0.5], 30.0, LONG)
    for power in (1, 2, 3):
        for k in (100.0, 1.0):
            yield bonds("wall", f"power {power}, k = {k:g}", [[EVEN, 1, k, power, 1]], [0.1, 1.0], 20.0, LONG)
        rows = [[EVEN, 1, 100, power, 1, 0, 0, 1]]
        yield bonds("wall", f"round, power {power}", rows, [0.2, 0.1, 0.9, 0.5], 20.0, LONG, TURNING)
    for k in (1e3, 1e4):
        rows = [[ONE_SIDED, 0, k, 1.5, -1], [WEIGHT, 0, 1, 0, 1]]
        yield bonds("Hertz", f"ball, k = {k:g}", rows, [1.0, 0.0], 20.0, SHORT)
    for count in (6, 2):
        y0 = np.zeros(2 * count)
        y0[count] = 1.0
        yield bonds("Hertz", f"{count} beads", chain(count, ONE_SIDED, 0, 100, 1.5), y0, 3.0, SHORT)
    for width in (0.1, 0.5):
        for count in (1, 5):
            y0 = np.zeros(2 * count)
            y0[0], y0[count] = 1.0, 0.3
            rows = chain(count, HUBER, width, 0, 0) if count > 1 else [[HUBER, width, 0, 0, 1]]
            yield bonds("Huber", f"width {width:g}, {count} bodies", rows, y0, 20.0, LONG)


def discs(seed: int, cut: float = 2.5) -> Case:
    """Return nine discs, at first at random (`seed`), with a Lennard-Jones force that ends at the distance `cut`."""
    rng = np.random.default_rng(seed)
    grid = np.array([[x, y] for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0)]) * (1.6 if cut > 1.5 else 1.3)
    q, v = grid + 0.1 * rng.standard_normal((9, 2)), rng.standard_normal((9, 2))
    pairs = [np.eye(18)[2 * i : 2 * i + 2] - np.eye(18)[2 * j : 2 * j + 2] for i in range(9) for j in range(i)]
    rows = [[LENNARD_JONES, cut, 0, 0, *pair.ravel()] for pair in pairs]
    y0 = np.concatenate([q.ravel(), (v - v.mean(axis=0)).ravel()])
    return bonds("discs", f"cut-off {cut:.3g}, start {seed}", rows, y0, 3.0, (0.002, 0.005, 0.01))


CHARGE, MASSES, SIZE = 1.602176634e-19, {"electron": 9.1093837e-31, "proton": 1.67262192e-27, "ion": 6.64e-26}, 1e-3


def in_si_units(name: str, kind: str) -> Case:
    """Return a particle in a field of 1 T and a Penning trap's potential, with states (x, p) or (x, v)."""
    mass, unit = MASSES[name], MASSES[name] if kind == "momenta" else 1.0
    turning = CHARGE / mass
    k, period = mass * (0.1 * turning) ** 2, 2 * np.pi / turning

    @njit
    def fun(t, y, out):  # type: ignore[no-untyped-def]
        out[0], out[1], out[2] = y[3] / unit, y[4] / unit, y[5] / unit
        out[3] = unit / mass * (CHARGE * y[4] / unit + 0.5 * k * y[0])
        out[4] = unit / mass * (-CHARGE * y[3] / unit + 0.5 * k * y[1])
        out[5] = unit / mass * -k * y[2]

    @njit
    def energy(t, y):  # type: ignore[no-untyped-def]
        square = (y[3] ** 2 + y[4] ** 2 + y[5] ** 2) / unit**2
        return 0.5 * mass * square + 0.5 * k * (y[2] ** 2 - 0.5 * (y[0] ** 2 + y[1] ** 2))

    @njit
    def slope(t, y, out):  # type: ignore[no-untyped-def]
        out[0], out[1], out[2] = -0.5 * k * y[0], -0.5 * k * y[1], k * y[2]
        out[3], out[4], out[5] = mass * y[3] / unit**2, mass * y[4] / unit**2, mass * y[5] / unit**2

    speed, kept = 0.1 * SIZE * turning * unit, (Invariant(energy, grad=slope, in_place=True, name="energy"),)
    y0, steps = np.array([SIZE, 0.0, 0.3 * SIZE, 0.0, speed, 0.1 * speed]), tuple(period / n for n in (20, 40, 80))
    more: dict[str, Any] = {"options": {"in_place": True}, "exact": {"h": period / 400}, "measured": at(slice(3))}
    return Case("SI units", f"{name}, {kind}", fun, kept, y0, 20 * period, steps, **more)


def trapped(name: str, exponent: int) -> Case:
    """Return a particle in SI units on a line, (x, p), in a trap whose potential grows as x^`exponent`."""
    mass, turning = MASSES[name], 0.1 * CHARGE / MASSES[name]
    rows = [[EVEN, 0.0, mass * turning**2 * SIZE ** (2 - exponent), exponent - 1, 1.0]]
    period = 2 * np.pi / turning
    steps, more = tuple(period / n for n in (20, 40, 80)), {"exact": {"h": period / 400}, "measured": at(slice(1))}
    return bonds("SI units", f"{name}, trap x^{exponent}", rows, [SIZE, 0.0], 20 * period, steps, mass=mass, **more)


def mechanism(name: str, end: float, energy: bool) -> Case:
    """Return a mechanism with its constraints kept, and its energy if asked for; each component has its own weight."""
    problem = replace(EXAMPLES[name](), blocks=None)
    known = None if problem.reference is None else problem.reference(end)
    kept = (*problem.constraints, problem.energy) if energy else problem.constraints
    seen = at(slice(None if known is None else known.size))
    label, steps = f"{name}, c{' + E' * energy}", (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9)
    return Case(
        "mechanisms", label, problem, kept, problem.y0, end, steps, (EIPDOP853,), True, known=known, measured=seen
    )


def planets(turned: np.ndarray, name: str) -> Case:
    """Return ten bodies over 100 years in rotated axes, without blocks; the error is that of Mercury's position."""
    plain = solar_system(years=100.0)
    assert plain.reference is not None
    y0, known = ((y.reshape(20, 3) @ turned.T).ravel() for y in (plain.y0, np.array(plain.reference(100.0))))
    problem = nbody(plain.params, *y0.reshape(2, 10, 3), t_span=(0.0, 100.0))
    steps, more = (0.002,), {"options": {"blocks": None}, "known": known[3:6], "measured": at(slice(3, 6))}
    return Case("planets", name, problem, tuple(problem.invariants), y0, 100.0, steps, (EIPRK4,), **more)


def cases() -> Iterator[Case]:
    """Yield all cases of this module."""
    for seed, cut in ((0, 2.5), (1, 2.5), (2, 2.5), (3, 2 ** (1 / 6)), (4, 1.5)):
        yield discs(seed, cut)
    yield from contacts()
    for name in MASSES:
        yield from (in_si_units(name, kind) for kind in ("momenta", "velocities"))
        yield from (trapped(name, exponent) for exponent in (2, 4))
    for name, end in (("andrews", 0.03), ("wobbling disc", 5.0), ("knife edge", 10.0), ("1-four-bar", 10.0)):
        yield from (mechanism(name, end, energy) for energy in (False, True))
    for k, turned in enumerate([np.eye(3), *Rotation.random(3, rng=1).as_matrix()]):
        yield planets(turned, f"axes {k}")
