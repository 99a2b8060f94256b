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
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from eip_scipy import EIPDOP853, EIPRK4, EIPRK5, EIPRK45, Invariant, integrate

from ..report import needed, table
from ..study import Session, Study, option

__all__ = ["MetricMemory"]

njit = needed("numba", '"eip_scipy[numba]"').njit
METHODS = (EIPRK4, EIPRK5, EIPRK45, EIPDOP853)
FACTOR, TOLERANCE = 3.0, 1e-9
ADAPTIVE = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9)


@dataclass
class Case:
    """A problem with its invariants, and the steps or tolerances with which it is run."""

    group: str
    name: str
    fun: Callable[..., Any]
    invariants: tuple[Invariant, ...]
    y0: np.ndarray
    end: float
    steps: tuple[float, ...] = ()
    methods: tuple[Any, ...] = METHODS
    options: dict[str, Any] = field(default_factory=dict)
    in_place: bool = True
    reference_options: dict[str, Any] = field(default_factory=lambda: {"rtol": 1e-12, "atol": 1e-13})
    known: np.ndarray | None = None
    seen: Any = ...  # components whose errors count

    @cached_property
    def reference(self) -> np.ndarray:
        """Return the exact state at the end: `known`, or the result of EIPDOP853 with `reference_options`."""
        if self.known is not None:
            return self.known
        run = integrate(
            self.fun, (0, self.end), self.y0, method=EIPDOP853, in_place=self.in_place, **self.reference_options
        )
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
                    plain[key] = case.error(integrate(case.fun, (0, case.end), case.y0, **given).y[:, -1])
                run = integrate(
                    case.fun,
                    (0, case.end),
                    case.y0,
                    invariants=case.invariants,
                    **given,
                    **case.options,
                    **options,
                )
            failed = run.status < 0
            yield Outcome(
                case.name, case.group, method.__name__, step, failed, not failed and not run.trusted,
                np.nan if failed else case.error(run.y[:, -1]), plain[key], run.message,
            )  # fmt: skip


def second_order(force: Any, energy: Any, slope: Any) -> tuple[Any, tuple[Invariant, ...]]:
    """Return the right-hand side of y = (q, v) with unit masses, and a tuple with its energy v^2/2 + U(q).

    ``force(q, out)`` fills in the force, ``energy(q)`` returns U, and ``slope(q, out)`` fills in grad U.
    """

    @njit
    def fun(t, y, out):
        n = y.size // 2
        out[:n] = y[n:]
        force(y[:n], out[n:])

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


def of_potential(energy: Any, slope: Any) -> tuple[Any, tuple[Invariant, ...]]:
    """Return the result of `second_order` for the force -grad U.

    ``energy(q)`` returns U, and ``slope(q, out)`` fills in grad U.
    """

    @njit
    def force(q, out):
        slope(q, out)
        for k in range(out.size):
            out[k] = -out[k]

    return second_order(force, energy, slope)


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


def constrained(
    mass: Callable[..., Any], forces: Callable[..., Any], jacobian: Callable[..., Any], bias: Callable[..., Any]
) -> Callable[..., Any]:
    """Return the right-hand side of (q, u): q' = u, M u' + G^T l = F and G u' = -bias, with multipliers l.

    The arguments are the functions ``M(q)``, ``F(q, u)``, ``G(q)`` and ``bias(q, u)``.
    """

    def fun(t: float, y: np.ndarray) -> np.ndarray:
        n = y.size // 2
        q, u = y[:n], y[n:]
        G = jacobian(q)
        m = len(G)
        matrix = np.zeros((n + m, n + m))
        matrix[:n, :n], matrix[:n, n:], matrix[n:, :n] = mass(q), G.T, G
        right = np.concatenate([forces(q, u), -bias(q, u)])
        return np.concatenate([u, np.linalg.solve(matrix, right)[:n]])

    return fun


def levels(
    constraints: Callable[..., Any], jacobian: Callable[..., Any], rates: Callable[..., Any], count: int
) -> tuple[Invariant, ...]:
    """Return two invariants of y = (q, u): the `count` constraints g(q) = 0, and their rates G(q) u = 0.

    `constraints` is g, `jacobian` is G = dg/dq, and ``rates(q, u)`` is the derivative of G u by q.
    """

    def places(t: float, y: np.ndarray) -> np.ndarray:
        return constraints(y[: y.size // 2])

    def place_slopes(t: float, y: np.ndarray) -> np.ndarray:
        G = jacobian(y[: y.size // 2])
        return np.hstack([G, np.zeros_like(G)])

    def speeds(t: float, y: np.ndarray) -> np.ndarray:
        n = y.size // 2
        return jacobian(y[:n]) @ y[n:]

    def speed_slopes(t: float, y: np.ndarray) -> np.ndarray:
        n = y.size // 2
        return np.hstack([rates(y[:n], y[n:]), jacobian(y[:n])])

    return (
        Invariant(places, grad=place_slopes, target=np.zeros(count), name="g", size=count),
        Invariant(speeds, grad=speed_slopes, target=np.zeros(count), name="g'", size=count),
    )


def pendulum(links: int) -> tuple[Case, Case]:
    """Return a chain of massless rods in Cartesian coordinates as two cases: without and with the energy kept."""
    n = 2 * links

    def differences(q: np.ndarray) -> np.ndarray:
        return np.diff(np.vstack([np.zeros(2), q.reshape(links, 2)]), axis=0)

    def constraints(q: np.ndarray) -> np.ndarray:
        return 0.5 * ((differences(q) ** 2).sum(axis=1) - 1.0)

    def jacobian(q: np.ndarray) -> np.ndarray:
        d, G = differences(q), np.zeros((links, links, 2))
        for k in range(links):
            G[k, k] = d[k]
            if k:
                G[k, k - 1] = -d[k]
        return G.reshape(links, n)

    def bias(q: np.ndarray, u: np.ndarray) -> np.ndarray:
        return (differences(u) ** 2).sum(axis=1)

    def forces(q: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.tile([0.0, -9.81], links)

    def energy(t: float, y: np.ndarray) -> float:
        return 0.5 * y[n:] @ y[n:] + 9.81 * y[1:n:2].sum()

    def energy_slope(t: float, y: np.ndarray) -> np.ndarray:
        return np.concatenate([np.tile([0.0, 9.81], links), y[n:]])

    angles = np.array([1.2, 0.9, 0.5])[:links]
    q0 = np.cumsum(np.column_stack([np.sin(angles), -np.cos(angles)]), axis=0).ravel()
    fun = constrained(lambda q: np.eye(n), forces, jacobian, bias)
    kept = levels(constraints, jacobian, lambda q, u: jacobian(u), links)
    return _with_energy(f"pendulum of {links}", fun, kept, Invariant(energy, grad=energy_slope, name="energy"),
                        np.concatenate([q0, np.zeros(n)]), 10.0)  # fmt: skip


def _with_energy(
    name: str, fun: Any, kept: tuple[Invariant, ...], energy: Invariant, y0: np.ndarray, end: float, **more: Any
) -> tuple[Case, Case]:
    common: dict[str, Any] = {"methods": (EIPDOP853,), "in_place": False, "steps": ADAPTIVE}
    return (
        Case("mechanisms", f"{name}, c", fun, kept, y0, end, **common, **more),
        Case("mechanisms", f"{name}, c + E", fun, (*kept, energy), y0, end, **common, **more),
    )


def knife_edge() -> tuple[Case, Case]:
    """Return a knife edge on an inclined plane, (x, y, angle), with a non-holonomic constraint.

    It is Chaplygin's sleigh with the edge at its centre. The two cases are without and with the energy kept.
    """

    def jacobian(q: np.ndarray) -> np.ndarray:
        return np.array([[-np.sin(q[2]), np.cos(q[2]), 0.0]])

    def bias(q: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.array([-u[2] * (np.cos(q[2]) * u[0] + np.sin(q[2]) * u[1])])

    fun = constrained(lambda q: np.eye(3), lambda q, u: np.array([5.0, 0.0, 0.0]), jacobian, bias)

    def speed(t: float, y: np.ndarray) -> float:
        return float(-np.sin(y[2]) * y[3] + np.cos(y[2]) * y[4])

    def speed_slope(t: float, y: np.ndarray) -> np.ndarray:
        s, c = np.sin(y[2]), np.cos(y[2])
        return np.array([0.0, 0.0, -c * y[3] - s * y[4], -s, c, 0.0])

    energy = Invariant(
        lambda t, y: 0.5 * y[3:] @ y[3:] - 5.0 * y[0],
        grad=lambda t, y: np.concatenate([[-5.0, 0.0, 0.0], y[3:]]),
        name="energy",
    )
    kept = (Invariant(speed, grad=speed_slope, target=0.0, name="knife"),)
    return _with_energy("knife edge", fun, kept, energy, np.array([0.0, 0.0, 0.0, 1.0, 0.0, 2.0]), 10.0)


class Andrews:
    """Andrews' squeezing mechanism (test set for initial value problem solvers)."""

    m = (0.04325, 0.00365, 0.02373, 0.00706, 0.07050, 0.00706, 0.05498)
    i = (2.194e-6, 4.410e-7, 5.255e-6, 5.667e-7, 1.169e-5, 5.667e-7, 1.912e-5)
    xa, ya, xb, yb, xc, yc = -0.06934, -0.00227, -0.03635, 0.03273, 0.014, 0.072
    c0, lo, d, da, e, ea = 4530.0, 0.07785, 0.028, 0.0115, 0.02, 0.01421
    rr, ra, ss, sa, sb, sc, sd = 0.007, 0.00092, 0.035, 0.01874, 0.01043, 0.018, 0.02
    ta, tb, u, ua, ub, zf, zt, fa, mom = 0.02308, 0.00916, 0.04, 0.01228, 0.00449, 0.02, 0.04, 0.01421, 0.033
    start = (
        -0.0617138900142764496358948458001, 0.0, 0.455279819163070380255912382449, 0.222668390165885884674473185609,
        0.487364979543842550225598953530, -0.222668390165885884674473185609, 1.23054744454982119249735015568,
    )  # fmt: skip
    end = (
        15.81077119629904, -15.75637105984298, 0.04082224013073101, -0.5347301163226948, 0.5244099658805304,
        0.5347301163226948, 1.048080741042263,
    )  # fmt: skip

    @classmethod
    def mass(cls, q: np.ndarray) -> np.ndarray:
        m1, m2, m3, m4, m5, m6, m7 = cls.m
        i1, i2, i3, i4, i5, i6, i7 = cls.i
        _, th, _, ph, _, om, _ = q
        M = np.zeros((7, 7))
        M[0, 0] = m1 * cls.ra**2 + m2 * (cls.rr**2 - 2 * cls.da * cls.rr * np.cos(th) + cls.da**2) + i1 + i2
        M[1, 0] = m2 * (cls.da**2 - cls.da * cls.rr * np.cos(th)) + i2
        M[1, 1] = m2 * cls.da**2 + i2
        M[2, 2] = m3 * (cls.sa**2 + cls.sb**2) + i3
        M[3, 3] = m4 * (cls.e - cls.ea) ** 2 + i4
        M[4, 3] = m4 * ((cls.e - cls.ea) ** 2 + cls.zt * (cls.e - cls.ea) * np.sin(ph)) + i4
        M[4, 4] = (
            m4 * (cls.zt**2 + 2 * cls.zt * (cls.e - cls.ea) * np.sin(ph) + (cls.e - cls.ea) ** 2)
            + m5 * (cls.ta**2 + cls.tb**2) + i4 + i5
        )  # fmt: skip
        M[5, 5] = m6 * (cls.zf - cls.fa) ** 2 + i6
        M[6, 5] = m6 * ((cls.zf - cls.fa) ** 2 - cls.u * (cls.zf - cls.fa) * np.sin(om)) + i6
        M[6, 6] = (
            m6 * ((cls.zf - cls.fa) ** 2 - 2 * cls.u * (cls.zf - cls.fa) * np.sin(om) + cls.u**2)
            + m7 * (cls.ua**2 + cls.ub**2) + i6 + i7
        )  # fmt: skip
        return M + np.tril(M, -1).T

    @classmethod
    def spring(cls, q: np.ndarray) -> tuple[float, float, float, float]:
        """Return the spring's length, its elongation, and the differences of x and of y between its ends."""
        ga = q[2]
        xd = cls.sd * np.cos(ga) + cls.sc * np.sin(ga) + cls.xb
        yd = cls.sd * np.sin(ga) - cls.sc * np.cos(ga) + cls.yb
        length = float(np.hypot(xd - cls.xc, yd - cls.yc))
        return length, length - cls.lo, xd - cls.xc, yd - cls.yc

    @classmethod
    def forces(cls, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        m2, m4, m6 = cls.m[1], cls.m[3], cls.m[5]
        _, th, ga, ph, _, om, _ = q
        bep, thp, _, php, dep, omp, epp = v
        length, stretch, dx, dy = cls.spring(q)
        fx, fy = (-cls.c0 * stretch / length * d for d in (dx, dy))
        return np.array([
            cls.mom - m2 * cls.da * cls.rr * thp * (thp + 2 * bep) * np.sin(th),
            m2 * cls.da * cls.rr * bep**2 * np.sin(th),
            fx * (cls.sc * np.cos(ga) - cls.sd * np.sin(ga)) + fy * (cls.sd * np.cos(ga) + cls.sc * np.sin(ga)),
            m4 * cls.zt * (cls.e - cls.ea) * dep**2 * np.cos(ph),
            -m4 * cls.zt * (cls.e - cls.ea) * php * (php + 2 * dep) * np.cos(ph),
            -m6 * cls.u * (cls.zf - cls.fa) * epp**2 * np.cos(om),
            m6 * cls.u * (cls.zf - cls.fa) * omp * (omp + 2 * epp) * np.cos(om),
        ])  # fmt: skip

    @classmethod
    def terms(cls) -> list[list[tuple[float, float, tuple[float, ...]]]]:
        """Return, for each constraint, the terms (a, p, w) of the sum of a cos(w . q + p).

        Missing last entries of w are 0.
        """
        h = -np.pi / 2  # sin x = cos(x - pi / 2)
        be, ga, bt, fe, oe = (1.0,), (0, 0, 1.0), (1.0, 1.0), (0, 0, 0, 1.0, 1.0), (0, 0, 0, 0, 0, 1.0, 1.0)
        de, ep = (0, 0, 0, 0, 1.0), (0, 0, 0, 0, 0, 0, 1.0)
        s, d, e, z, f, u = cls.ss, cls.d, cls.e, cls.zt, cls.zf, cls.u
        none = (0.0,)
        return [
            [(cls.rr, 0, be), (-d, 0, bt), (-s, h, ga), (-cls.xb, 0, none)],
            [(cls.rr, h, be), (-d, h, bt), (s, 0, ga), (-cls.yb, 0, none)],
            [(cls.rr, 0, be), (-d, 0, bt), (-e, h, fe), (-z, 0, de), (-cls.xa, 0, none)],
            [(cls.rr, h, be), (-d, h, bt), (e, 0, fe), (-z, h, de), (-cls.ya, 0, none)],
            [(cls.rr, 0, be), (-d, 0, bt), (-f, 0, oe), (-u, h, ep), (-cls.xa, 0, none)],
            [(cls.rr, h, be), (-d, h, bt), (-f, h, oe), (u, 0, ep), (-cls.ya, 0, none)],
        ]

    def __init__(self) -> None:
        terms = [(row, *term) for row, line in enumerate(self.terms()) for term in line]
        self.sum = np.zeros((6, len(terms)))
        for k, term in enumerate(terms):
            self.sum[term[0], k] = term[1]
        self.phase = np.array([term[2] for term in terms])
        self.weights = np.array([np.pad(term[3], (0, 7 - len(term[3]))) for term in terms])

    def constraints(self, q: np.ndarray) -> np.ndarray:
        return self.sum @ np.cos(self.weights @ q + self.phase)

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        return (self.sum * -np.sin(self.weights @ q + self.phase)) @ self.weights

    def rates(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return (self.sum * (-np.cos(self.weights @ q + self.phase) * (self.weights @ v))) @ self.weights

    def bias(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return self.sum @ (-np.cos(self.weights @ q + self.phase) * (self.weights @ v) ** 2)

    def energy(self, t: float, y: np.ndarray) -> float:
        q, v = y[:7], y[7:]
        return 0.5 * v @ self.mass(q) @ v + 0.5 * self.c0 * self.spring(q)[1] ** 2 - self.mom * q[0]

    def energy_slope(self, t: float, y: np.ndarray) -> np.ndarray:
        q, v = y[:7], y[7:]
        out = np.concatenate([np.zeros(7), self.mass(q) @ v])
        for k in (1, 3, 5):  # M depends on these, by a sine or a cosine of one angle: exact by two quarter turns
            turn = np.zeros(7)
            turn[k] = np.pi / 2
            out[k] = 0.25 * v @ (self.mass(q + turn) - self.mass(q - turn)) @ v
        length, stretch, dx, dy = self.spring(q)
        ga = q[2]
        out[2] = (
            self.c0
            * stretch
            / length
            * (dx * (self.sc * np.cos(ga) - self.sd * np.sin(ga)) + dy * (self.sd * np.cos(ga) + self.sc * np.sin(ga)))
        )
        out[0] -= self.mom
        return out

    @classmethod
    def cases(cls) -> tuple[Case, Case]:
        one = cls()
        fun = constrained(one.mass, one.forces, one.jacobian, one.bias)
        kept = levels(one.constraints, one.jacobian, one.rates, 6)
        energy = Invariant(one.energy, grad=one.energy_slope, name="energy")
        known = np.concatenate([cls.end, np.zeros(7)])
        y0 = np.concatenate([cls.start, np.zeros(7)])
        return _with_energy("Andrews", fun, kept, energy, y0, 0.03, known=known, seen=[0, 1, 2, 3, 4, 5, 6])


DISC = 1.0, 1.0, 9.81, 0.25, 0.5  # mass, radius, gravity, moments of inertia about a diameter and about the axis


def disc_mechanics() -> tuple[Callable[..., Any], ...]:
    """Return the functions that define `disc`: mass matrix (q), forces (q, u), G (q), and the derivative of G u by q.

    The constraints are G(q) u = 0; the derivative is a function of (q, u).
    """
    mass, radius, gravity, flat, axial = DISC

    # q = (x, y, a, b, c) of the point of contact's track; velocity of the centre: that of (x, y, radius sin b).
    def matrix(q: np.ndarray) -> np.ndarray:
        b = q[3]
        M = np.zeros((5, 5))
        M[0, 0] = M[1, 1] = mass
        # Spin about the axis: c' + a' cos b; about the diameters: b' and a' sin b.
        M[2, 2] = flat * np.sin(b) ** 2 + axial * np.cos(b) ** 2
        M[2, 4] = M[4, 2] = axial * np.cos(b)
        M[3, 3] = flat + mass * (radius * np.cos(b)) ** 2
        M[4, 4] = axial
        return M

    def forces(q: np.ndarray, u: np.ndarray) -> np.ndarray:
        b, a1, b1, c1 = q[3], u[2], u[3], u[4]
        s, c = np.sin(b), np.cos(b)
        out = np.zeros(5)
        # d/dt of the mass matrix' own part, and grad of T - V, by hand.
        out[2] = -((flat - axial) * 2 * s * c * b1 * a1 - axial * s * b1 * c1)
        out[3] = (flat - axial) * s * c * a1 * a1 - axial * s * a1 * c1 + mass * radius**2 * s * c * b1 * b1
        out[3] += -mass * gravity * radius * c
        out[4] = axial * s * b1 * a1
        return out

    # The centre (x, y, radius sin b) is radius e2 from the contact, e2 = (-sin a cos b, cos a cos b, sin b), and moves
    # at w x (radius e2).
    def jacobian(q: np.ndarray) -> np.ndarray:
        a, b = q[2], q[3]
        G = np.zeros((2, 5))
        G[0, 0] = G[1, 1] = 1.0
        G[:, 2] = radius * np.cos(b) * np.array([np.cos(a), np.sin(a)])
        G[:, 3] = -radius * np.sin(b) * np.array([np.sin(a), -np.cos(a)])
        G[:, 4] = radius * np.array([np.cos(a), np.sin(a)])
        return G

    def rates(q: np.ndarray, u: np.ndarray) -> np.ndarray:
        a, b = q[2], q[3]
        forward, side = np.array([np.cos(a), np.sin(a)]), np.array([np.sin(a), -np.cos(a)])
        out = np.zeros((2, 5))
        # d/da: forward -> -side, side -> forward.
        out[:, 2] = -radius * side * (np.cos(b) * u[2] + u[4]) - radius * np.sin(b) * forward * u[3]
        out[:, 3] = -radius * np.sin(b) * forward * u[2] - radius * np.cos(b) * side * u[3]
        return out

    return matrix, forces, jacobian, rates


def disc() -> tuple[Case, Case]:
    """Return a thin disc that wobbles and rolls without slipping, as two cases: without and with the energy kept.

    Its coordinates are x, y, heading, lean and spin; rolling is two non-holonomic constraints.
    """
    mass, radius, gravity, flat, axial = DISC
    matrix, forces, jacobian, rates = disc_mechanics()

    def bias(q: np.ndarray, u: np.ndarray) -> np.ndarray:
        return rates(q, u) @ u

    def energy(t: float, y: np.ndarray) -> float:
        return float(0.5 * y[5:] @ matrix(y[:5]) @ y[5:] + mass * gravity * radius * np.sin(y[3]))

    def energy_slope(t: float, y: np.ndarray) -> np.ndarray:
        q, u = y[:5], y[5:]
        s, c = np.sin(q[3]), np.cos(q[3])
        out = np.concatenate([np.zeros(5), matrix(q) @ u])
        out[3] = (flat - axial) * s * c * u[2] ** 2 - axial * s * u[2] * u[4] - mass * radius**2 * s * c * u[3] ** 2
        out[3] += mass * gravity * radius * c
        return out

    fun = constrained(matrix, forces, jacobian, bias)

    def speeds(t: float, y: np.ndarray) -> np.ndarray:
        return jacobian(y[:5]) @ y[5:]

    def speed_slopes(t: float, y: np.ndarray) -> np.ndarray:
        return np.hstack([rates(y[:5], y[5:]), jacobian(y[:5])])

    kept = (Invariant(speeds, grad=speed_slopes, target=np.zeros(2), name="rolling", size=2),)
    q0 = np.array([0.0, 0.0, 0.0, 1.2, 0.0])
    u0 = np.array([0.0, 0.0, 1.0, 0.5, 4.0])
    u0[:2] = -jacobian(q0)[:, 2:] @ u0[2:]
    return _with_energy(
        "disc, wobbling", fun, kept, Invariant(energy, grad=energy_slope, name="energy"), np.concatenate([q0, u0]), 5.0
    )


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
    yield from Andrews.cases()
    yield from disc()
    yield from knife_edge()
    yield from pendulum(2)
    yield from pendulum(3)


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
