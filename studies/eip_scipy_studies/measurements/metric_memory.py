"""``eip-scipy study metric-memory``: the projection's metric on problems whose error estimates mislead it.

There are three groups. Cut-off: forces with kinks or jumps (discs with a truncated Lennard-Jones force, backlash, soft
walls, Hertz contacts, Huber springs) with the energy kept, three fixed steps by four methods each. SI units: charged
particles whose momenta are near 1e-24. Mechanisms: constraints on positions or velocities, adaptive steps, without and
with the energy kept.

Each run is compared with the same run without projection. A run is "failed" if its status is -1, "accused" if it is
reported as not reliable (`trusted` is false), and "worse" if its final error exceeds three times that of the
unprojected run plus a tolerance of 1e-9. Errors are relative to the reference's largest component. For the discs, which
are chaotic, the command also counts how often errors become three times larger by chance.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from eip_scipy import EIPDOP853, EIPRK4, EIPRK5, EIPRK45, Invariant, integrate
from eip_scipy.problems import MechanicsProblem, mechanism

from ..mechanisms.examples import andrews
from ..report import needed, table
from ..study import Session, Study, option

njit = needed("numba", '"eip_scipy[numba]"').njit
METHODS = (EIPRK4, EIPRK5, EIPRK45, EIPDOP853)
FACTOR, TOLERANCE = 3.0, 1e-9
ADAPTIVE = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9)


@dataclass
class Case:
    """A problem with its invariants, and the steps or tolerances with which it is run."""

    group: str
    name: str
    fun: Any
    invariants: tuple[Any, ...]
    y0: np.ndarray
    end: float
    steps: tuple[float, ...] = ()
    methods: tuple[Any, ...] = METHODS
    in_place: bool = True
    reference_options: dict[str, Any] = field(default_factory=lambda: {"rtol": 1e-12, "atol": 1e-13})
    known: np.ndarray | None = None
    seen: Any = ...  # components whose errors count

    @cached_property
    def reference(self) -> np.ndarray:
        """Return the exact state at the end: `known`, or the result of EIPDOP853 with `reference_options`."""
        if self.known is not None:
            return self.known
        given = {"method": EIPDOP853, "in_place": self.in_place, **self.reference_options}
        run = integrate(self.fun, (0, self.end), self.y0, invariants=(), **given)
        return run.y[:, -1]

    def error(self, y: np.ndarray) -> float:
        """Return the largest error of the components `seen` of a final state, divided by the largest true one."""
        reference = self.reference[self.seen]
        return float(np.abs(y[self.seen] - reference).max() / np.abs(reference).max())


@dataclass
class Outcome:
    """Results of one run, its final error, and the final error of the same run without invariants (`plain`)."""

    case: str
    group: str
    method: str
    step: float
    failed: bool
    accused: bool
    error: float
    plain: float
    message: str

    @property
    def worse(self) -> bool:
        """Return whether `error` exceeds three times `plain` plus `TOLERANCE`; False for a failed run."""
        return not self.failed and not self.error <= FACTOR * self.plain + TOLERANCE

    @property
    def ratio(self) -> float:
        """Return the error divided by that of the unprojected run; 1e-15 is added to both."""
        return (self.error + 1e-15) / (self.plain + 1e-15)


def outcomes(case: Case, plain: dict[Any, float], **options: Any) -> Iterator[Outcome]:
    """Run a problem by all its methods and steps, and yield an `Outcome` for each run with projection.

    `plain` stores the errors of unprojected runs by (problem, method, step). `options` are further ones of `integrate`.
    """
    for method in case.methods:
        for step in case.steps:
            control = {"h": step} if step >= 1e-3 or case.group == "SI units" else {"rtol": step, "atol": step}
            given = {"method": method, "in_place": case.in_place, **control}
            key = case.name, method.__name__, step
            with warnings.catch_warnings(), np.errstate(all="ignore"):
                warnings.simplefilter("ignore")
                if key not in plain:
                    free = integrate(case.fun, (0, case.end), case.y0, invariants=(), **given)
                    plain[key] = case.error(free.y[:, -1])
                run = integrate(case.fun, (0, case.end), case.y0, invariants=case.invariants, **given, **options)
            failed = run.status < 0
            yield Outcome(
                case.name, case.group, method.__name__, step, failed, not failed and not run.trusted,
                np.nan if failed else case.error(run.y[:, -1]), plain[key], run.message,
            )  # fmt: skip


def of_potential(energy: Any, slope: Any) -> tuple[Any, tuple[Invariant, ...]]:
    """Return the right-hand side of y = (q, v) with unit masses and the force -grad U, and a tuple with its energy.

    ``energy(q)`` returns U, and ``slope(q, out)`` fills in grad U.
    """

    @njit
    def fun(t, y, out):
        n = y.size // 2
        out[:n] = y[n:]
        slope(y[:n], out[n:])
        for k in range(n, 2 * n):
            out[k] = -out[k]

    @njit
    def value(t, y):
        n = y.size // 2
        total = energy(y[:n])
        for k in range(n):
            total += 0.5 * y[n + k] ** 2
        return total

    @njit
    def gradient(t, y, out):
        n = y.size // 2
        slope(y[:n], out[:n])
        out[n:] = y[n:]

    return fun, (Invariant(value, grad=gradient, in_place=True, name="energy"),)


def discs(seed: int, cut: float = 2.5) -> Case:
    """Return nine discs, at first at random (`seed`), with a Lennard-Jones force that ends at the distance `cut`."""
    shift = 4 * (cut**-12 - cut**-6)

    @njit
    def energy(q):
        total = 0.0
        for i in range(9):
            for j in range(i):
                square = (q[2 * i] - q[2 * j]) ** 2 + (q[2 * i + 1] - q[2 * j + 1]) ** 2
                if square < cut * cut:
                    s = 1 / (square * square * square)
                    total += 4 * (s * s - s) - shift
        return total

    @njit
    def slope(q, out):
        out[:] = 0.0
        for i in range(9):
            for j in range(i):
                x, y = q[2 * i] - q[2 * j], q[2 * i + 1] - q[2 * j + 1]
                square = x * x + y * y
                if square < cut * cut:
                    s = 1 / (square * square * square)
                    c = -24 * (2 * s * s - s) / square
                    out[2 * i] += c * x
                    out[2 * i + 1] += c * y
                    out[2 * j] -= c * x
                    out[2 * j + 1] -= c * y

    fun, kept = of_potential(energy, slope)
    rng = np.random.default_rng(seed)
    grid = np.array([[x, y] for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0)]) * (1.6 if cut > 1.5 else 1.3)
    q = grid + 0.1 * rng.standard_normal((9, 2))
    v = rng.standard_normal((9, 2))
    v -= v.mean(axis=0)
    name = f"discs, cut-off {cut:.3g}, start {seed}"
    return Case("discs", name, fun, kept, np.concatenate([q.ravel(), v.ravel()]), 3.0, (0.002, 0.005, 0.01))


def backlash(stiffness: float, start: float, speed: float) -> Case:
    """Return one body on a spring with a dead zone of half width 0.5, at first at `start` with the velocity `speed`."""

    @njit
    def energy(q):
        d = abs(q[0]) - 0.5
        return 0.5 * stiffness * d * d if d > 0 else 0.0

    @njit
    def slope(q, out):
        d = abs(q[0]) - 0.5
        out[0] = stiffness * d * np.sign(q[0]) if d > 0 else 0.0

    fun, kept = of_potential(energy, slope)
    name = f"backlash, k = {stiffness:g}, start {start:g}, {speed:g}"
    return Case("backlash", name, fun, kept, np.array([start, speed]), 40.0, (0.01, 0.02, 0.05))


def gear(stiffness: float) -> Case:
    """Return two bodies in contact with play, the first one on a soft spring; `stiffness` is that of the contact."""

    @njit
    def energy(q):
        d = abs(q[0] - q[1]) - 0.5
        return 0.5 * q[0] ** 2 + (0.5 * stiffness * d * d if d > 0 else 0.0)

    @njit
    def slope(q, out):
        d = abs(q[0] - q[1]) - 0.5
        pull = stiffness * d * np.sign(q[0] - q[1]) if d > 0 else 0.0
        out[0] = q[0] + pull
        out[1] = -pull

    fun, kept = of_potential(energy, slope)
    return Case(
        "backlash", f"gear, k = {stiffness:g}", fun, kept, np.array([1.0, 0.3, 0.0, 0.5]), 30.0, (0.01, 0.02, 0.05)
    )


def wall(stiffness: float, power: int, speed: float) -> Case:
    """Return a body that flies freely between soft walls at -1 and 1, at first with the velocity `speed`.

    At a depth d in a wall the force is `stiffness` d^`power`.
    """

    @njit
    def energy(q):
        d = abs(q[0]) - 1.0
        return stiffness * d ** (power + 1) / (power + 1) if d > 0 else 0.0

    @njit
    def slope(q, out):
        d = abs(q[0]) - 1.0
        out[0] = stiffness * d**power * np.sign(q[0]) if d > 0 else 0.0

    fun, kept = of_potential(energy, slope)
    name = f"wall, power {power}, k = {stiffness:g}, speed {speed:g}"
    return Case("wall", name, fun, kept, np.array([0.1, speed]), 20.0, (0.01, 0.02, 0.05))


def round_wall(power: int) -> Case:
    """Return a body that flies freely inside a round soft wall in the plane; energy and angular momentum are kept.

    The force of the wall grows as the depth to the `power`.
    """

    @njit
    def energy(q):
        d = np.sqrt(q[0] ** 2 + q[1] ** 2) - 1.0
        return 100.0 * d ** (power + 1) / (power + 1) if d > 0 else 0.0

    @njit
    def slope(q, out):
        r = np.sqrt(q[0] ** 2 + q[1] ** 2)
        d = r - 1.0
        pull = 100.0 * d**power / r if d > 0 else 0.0
        out[0], out[1] = pull * q[0], pull * q[1]

    @njit
    def turn(t, y):
        return y[0] * y[3] - y[1] * y[2]

    @njit
    def turn_slope(t, y, out):
        out[0], out[1], out[2], out[3] = y[3], -y[2], -y[1], y[0]

    fun, kept = of_potential(energy, slope)
    kept += (Invariant(turn, grad=turn_slope, in_place=True, name="L"),)
    return Case(
        "wall", f"round wall, power {power}", fun, kept, np.array([0.2, 0.1, 0.9, 0.5]), 20.0, (0.01, 0.02, 0.05)
    )


def ball(stiffness: float) -> Case:
    """Return a ball that bounces under gravity on a Hertz contact, whose force is `stiffness` times depth^1.5."""

    @njit
    def energy(q):
        return q[0] + (0.4 * stiffness * (-q[0]) ** 2.5 if q[0] < 0 else 0.0)

    @njit
    def slope(q, out):
        out[0] = 1.0 - (stiffness * (-q[0]) ** 1.5 if q[0] < 0 else 0.0)

    fun, kept = of_potential(energy, slope)
    return Case("Hertz", f"ball, k = {stiffness:g}", fun, kept, np.array([1.0, 0.0]), 20.0, (0.005, 0.01, 0.02))


def beads(count: int) -> Case:
    """Return a chain of beads in Hertz contact, the first one struck; it ends in soft walls."""

    @njit
    def energy(q):
        total = 0.0
        for k in range(count + 1):
            d = (q[k - 1] if k > 0 else 0.0) - (q[k] if k < count else 0.0)
            if d > 0:
                total += 0.4 * 100.0 * d**2.5
        return total

    @njit
    def slope(q, out):
        out[:] = 0.0
        for k in range(count + 1):
            d = (q[k - 1] if k > 0 else 0.0) - (q[k] if k < count else 0.0)
            if d > 0:
                pull = 100.0 * d**1.5
                if k > 0:
                    out[k - 1] += pull
                if k < count:
                    out[k] -= pull

    fun, kept = of_potential(energy, slope)
    y0 = np.zeros(2 * count)
    y0[count] = 1.0
    return Case("Hertz", f"{count} beads", fun, kept, y0, 3.0, (0.005, 0.01, 0.02))


def huber(width: float, bodies: int) -> Case:
    """Return springs whose force is constant beyond the elongation `width`.

    They hold one body, or a chain of several `bodies` between walls.
    """

    @njit
    def well(d):
        return 0.5 * d * d if abs(d) < width else width * (abs(d) - 0.5 * width)

    @njit
    def pull(d):
        return d if abs(d) < width else width * np.sign(d)

    @njit
    def energy(q):
        total = well(q[0]) + (well(q[bodies - 1]) if bodies > 1 else 0.0)
        for k in range(1, bodies):
            total += well(q[k] - q[k - 1])
        return total

    @njit
    def slope(q, out):
        out[:] = 0.0
        out[0] += pull(q[0])
        if bodies > 1:
            out[bodies - 1] += pull(q[bodies - 1])
        for k in range(1, bodies):
            f = pull(q[k] - q[k - 1])
            out[k] += f
            out[k - 1] -= f

    fun, kept = of_potential(energy, slope)
    y0 = np.zeros(2 * bodies)
    y0[0], y0[bodies] = 1.0, 0.3
    return Case("Huber", f"Huber, width {width:g}, {bodies} bodies", fun, kept, y0, 20.0, (0.01, 0.02, 0.05))


CHARGE, MASSES = 1.602176634e-19, {"electron": 9.1093837e-31, "proton": 1.67262192e-27, "ion": 6.64e-26}


def magnetic(name: str, momenta: bool) -> Case:
    """Return a particle in SI units in a uniform field of 1 T and a Penning trap's potential.

    `name` is a key of `MASSES`. The state is (x, p) if `momenta` is true, otherwise (x, v).
    """
    mass = MASSES[name]
    charge, field_, size = CHARGE, 1.0, 1e-3
    cyclotron = charge * field_ / mass
    axial = 0.1 * cyclotron
    k = mass * axial**2  # of z; -k/2 of x and y
    unit = mass if momenta else 1.0

    @njit
    def fun(t, y, out):
        vx, vy, vz = y[3] / unit, y[4] / unit, y[5] / unit
        out[0], out[1], out[2] = vx, vy, vz
        scale = unit / mass
        out[3] = scale * (charge * field_ * vy + 0.5 * k * y[0])
        out[4] = scale * (-charge * field_ * vx + 0.5 * k * y[1])
        out[5] = scale * (-k * y[2])

    @njit
    def energy(t, y):
        square = (y[3] ** 2 + y[4] ** 2 + y[5] ** 2) / unit**2
        return 0.5 * mass * square + 0.5 * k * (y[2] ** 2 - 0.5 * (y[0] ** 2 + y[1] ** 2))

    @njit
    def energy_slope(t, y, out):
        out[0], out[1], out[2] = -0.5 * k * y[0], -0.5 * k * y[1], k * y[2]
        for i in range(3, 6):
            out[i] = mass * y[i] / unit**2

    speed = size * cyclotron * 0.1
    y0 = np.array([size, 0.0, 0.3 * size, 0.0, speed * unit, 0.1 * speed * unit])
    kept = (Invariant(energy, grad=energy_slope, in_place=True, name="energy"),)
    period = 2 * np.pi / cyclotron
    kind = "momenta" if momenta else "velocities"
    return Case(
        "SI units", f"{name}, {kind}", fun, kept, y0, 20 * period, tuple(period / n for n in (20, 40, 80)),
        reference_options={"h": period / 400}, seen=[0, 1, 2],
    )  # fmt: skip


def trap(name: str, exponent: int) -> Case:
    """Return a particle in SI units on a line, (x, p), in a trap whose potential grows as x^`exponent`.

    `name` is a key of `MASSES`.
    """
    mass, size = MASSES[name], 1e-3
    frequency = 0.1 * CHARGE / mass
    strength = mass * frequency**2 * size ** (2 - exponent)

    @njit
    def fun(t, y, out):
        out[0], out[1] = y[1] / mass, -strength * y[0] ** (exponent - 1)

    @njit
    def energy(t, y):
        return 0.5 * y[1] ** 2 / mass + strength * y[0] ** exponent / exponent

    @njit
    def slope(t, y, out):
        out[0], out[1] = strength * y[0] ** (exponent - 1), y[1] / mass

    period = 2 * np.pi / frequency
    kept = (Invariant(energy, grad=slope, in_place=True, name="energy"),)
    return Case(
        "SI units", f"{name}, trap x^{exponent}", fun, kept, np.array([size, 0.0]), 20 * period,
        tuple(period / n for n in (20, 40, 80)), reference_options={"h": period / 400}, seen=[0],
    )  # fmt: skip


def constrained(name: str, problem: MechanicsProblem, end: float) -> tuple[Case, Case]:
    """Return a mechanism as two cases: with its constraints kept, and with its energy as well.

    The metric has a weight for each component, in place of the two blocks of the problem. If the last position is
    known, the errors are those of the position.
    """
    known = None if problem.reference is None else problem.reference(end)
    common: dict[str, Any] = {"methods": (EIPDOP853,), "in_place": False, "steps": ADAPTIVE, "known": known}
    common["seen"] = slice(None if known is None else known.size)
    problem, kept = replace(problem, blocks=None), problem.constraints
    return (
        Case("mechanisms", f"{name}, c", problem, kept, problem.y0, end, **common),
        Case("mechanisms", f"{name}, c + E", problem, (*kept, problem.energy), problem.y0, end, **common),
    )


def pendulum(links: int) -> MechanicsProblem:
    """Return a chain of massless rods in Cartesian coordinates."""

    def lengths(t: Any, q: Any) -> np.ndarray:
        ends = np.vstack([np.zeros(2), q.reshape(links, 2)])
        return 0.5 * (((ends[1:] - ends[:-1]) ** 2).sum(axis=1) - 1.0)

    angles = np.array([1.2, 0.9, 0.5])[:links]
    q0 = np.cumsum(np.column_stack([np.sin(angles), -np.cos(angles)]), axis=0).ravel()
    weights = np.tile([0.0, -9.81], links)
    return mechanism(np.ones(q0.size), weights, lengths, q0=q0, u0=0 * q0, potential=lambda t, q: -weights @ q)


def knife_edge() -> MechanicsProblem:
    """Return a knife edge on an inclined plane, (x, y, angle), with a non-holonomic constraint.

    It is Chaplygin's sleigh with the edge at its centre.
    """
    return mechanism(
        np.ones(3),
        [5.0, 0.0, 0.0],
        velocity_constraints=lambda t, q, u: [np.cos(q[2]) * u[1] - np.sin(q[2]) * u[0]],
        q0=np.zeros(3),
        u0=[1.0, 0.0, 2.0],
        potential=lambda t, q: -5.0 * q[0],
    )


def disc() -> MechanicsProblem:
    """Return a thin disc of mass and radius 1 that wobbles and rolls without slipping.

    Its coordinates are x and y of the contact's track, heading, lean and spin. Rolling is two non-holonomic
    constraints.
    """
    gravity, flat, axial = 9.81, 0.25, 0.5  # moments of inertia about a diameter and about the axis

    def matrix(q: Any) -> np.ndarray:
        # Spin about the axis: c' + a' cos b; about the diameters: b' and a' sin b. The centre is at (x, y, sin b).
        s, c = np.sin(q[3]), np.cos(q[3])
        M = np.diag([1, 1, flat * s**2 + axial * c**2, flat + c**2, axial])
        M[2, 4] = M[4, 2] = axial * c
        return M

    def forces(t: Any, q: Any, u: Any) -> np.ndarray:
        s, c = np.sin(q[3]), np.cos(q[3])
        _, _, a1, b1, c1 = u
        lean = (flat - axial) * s * c * a1**2 - axial * s * a1 * c1 + s * c * b1**2 - gravity * c
        return np.array([0, 0, axial * s * b1 * c1 - (flat - axial) * 2 * s * c * b1 * a1, lean, axial * s * b1 * a1])

    def slip(t: Any, q: Any, u: Any) -> np.ndarray:
        """Return the velocity of the point of contact: that of the centre is w x (-sin a cos b, cos a cos b, sin b)."""
        _, _, a, b, _ = q
        along, across = np.cos(b) * u[2] + u[4], np.sin(b) * u[3]
        return np.array([u[0] + along * np.cos(a) - across * np.sin(a), u[1] + along * np.sin(a) + across * np.cos(a)])

    q0, u0 = np.array([0.0, 0.0, 0.0, 1.2, 0.0]), np.array([0.0, 0.0, 1.0, 0.5, 4.0])
    u0[:2] = -slip(0.0, q0, u0)
    potential = lambda t, q: gravity * np.sin(q[3])  # noqa: E731
    return mechanism(matrix, forces, velocity_constraints=slip, q0=q0, u0=u0, potential=potential)


def cut_off() -> Iterator[Case]:
    """Yield the problems whose forces have kinks or jumps."""
    for seed in range(3):
        yield discs(seed)
    yield discs(3, 2 ** (1 / 6))
    yield discs(4, 1.5)
    for start in ((1.2, 0.0), (0.0, 1.0), (0.7, -0.3)):
        for stiffness in (1.0, 10.0, 100.0):
            yield backlash(stiffness, *start)
    yield gear(10.0)
    yield gear(100.0)
    for power in (1, 2, 3):
        yield wall(100.0, power, 1.0)
        yield wall(1.0, power, 1.0)
        yield round_wall(power)
    yield ball(1e3)
    yield ball(1e4)
    yield beads(6)
    yield beads(2)
    for width in (0.1, 0.5):
        yield huber(width, 1)
        yield huber(width, 5)


def cases() -> Iterator[Case]:
    """Yield all problems."""
    yield from cut_off()
    for name in MASSES:
        for momenta in (True, False):
            yield magnetic(name, momenta)
        yield trap(name, 2)
        yield trap(name, 4)
    yield from constrained("Andrews", andrews(), 0.03)
    yield from constrained("disc, wobbling", disc(), 5.0)
    yield from constrained("knife edge", knife_edge(), 10.0)
    yield from constrained("pendulum of 2", pendulum(2), 10.0)
    yield from constrained("pendulum of 3", pendulum(3), 10.0)


def mean_ratio(found: Iterable[Outcome]) -> float:
    """Return the geometric mean of `Outcome.ratio` over the runs that did not fail; nan if all failed."""
    ratios = [one.ratio for one in found if not one.failed]
    return float(np.exp(np.mean(np.log(ratios)))) if ratios else np.nan


def row(name: str, found: list[Outcome]) -> tuple[str, list[str]]:
    """Return a row of the table: the label `name` and the cells with counts and error ratios of the runs in `found`."""
    failed, accused, worse = (sum(getattr(one, what) for one in found) for what in ("failed", "accused", "worse"))
    worst = max((one.ratio for one in found if not one.failed and one.error > TOLERANCE), default=np.nan)
    counts = [str(len(found)), str(failed), str(accused), str(worse)]
    return name, [*counts, f"{mean_ratio(found):.3g}", f"{worst:.3g}"]


def scatter(chosen: Iterable[Case]) -> str:
    """Return a text that says how often the final error is more than three times that of an unprojected run.

    It has two counts: that of unprojected runs whose step is 2 to 6 % shorter, where the cause is chance, and that of
    projected runs, each compared with the unprojected run of the same step.
    """
    chance, projected = [], []
    for case in chosen:
        for method in case.methods:
            for step in case.steps:
                options = [{"method": method, "in_place": True, "h": share * step} for share in (1.0, 0.98, 0.96, 0.94)]
                ends = (integrate(case.fun, (0, case.end), case.y0, **one).y[:, -1] for one in options)
                plain = [case.error(y) for y in ends]
                chance += [error / plain[0] for error in plain[1:]]
                for one, error in zip(options, plain, strict=True):
                    run = integrate(case.fun, (0, case.end), case.y0, invariants=case.invariants, **one)
                    projected.append(case.error(run.y[:, -1]) / error)
    counts = [f"{sum(ratio > FACTOR for ratio in ratios)} of {len(ratios)}" for ratios in (chance, projected)]
    return f"three times worse: {counts[0]} at a step 2 to 6 % shorter, {counts[1]} with projection"


class Found(NamedTuple):
    """Results of all runs, and the text of `scatter` for the discs (empty if no disc was run)."""

    runs: list[Outcome]
    chance: str


@dataclass(frozen=True, kw_only=True)
class MetricMemory(Study[Found]):
    """Command ``eip-scipy study metric-memory``."""

    writes_files = False
    only: str = option("", "run only problems whose group or name contains TEXT", metavar="TEXT")
    metric: str = option("error", "metric of the projection (default: %(default)s)", choices=("error", "euclidean"))

    def measure(self, session: Session) -> Found:
        chosen = [case for case in cases() if self.only in f"{case.group} {case.name}"]
        plain: dict[Any, float] = {}
        found: list[Outcome] = []
        with session.bar(len(chosen), "metric-memory", "problem") as bar, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for case in chosen:
                found += outcomes(case, plain, metric=self.metric)
                bar.update()
            discs_chosen = [case for case in chosen if case.group == "discs"]
            return Found(found, f"discs, {scatter(discs_chosen)}" if discs_chosen else "")

    def text(self, found: Found) -> str:
        heads = [["runs"], ["failed"], ["accused"], ["worse"], ["mean ratio"], ["worst"]]
        parts = []
        for key in ("case", "group"):
            names = dict.fromkeys(getattr(one, key) for one in found.runs)
            body = [row(name, [one for one in found.runs if getattr(one, key) == name]) for name in names]
            parts.append(table(heads, body))
        return "\n\n".join(filter(None, [*parts, found.chance]))

    def numbers(self, found: Found) -> dict[str, Any]:
        return {"runs": [vars(one) for one in found.runs]}
