"""Small systems with quantities that are claimed to be invariants, rightly or wrongly, as `Problem`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from eip_scipy import Invariant
from eip_scipy.problems import Problem

from ...hard_cases import CaseEquations
from ...report import needed

njit = needed("numba", '"eip_scipy[numba]"').njit

Array = np.ndarray


def claimed(fun: Callable[..., Any], y0: Any, end: float, *kept: Invariant) -> Problem:
    """Return a problem from a right-hand side and the quantities `kept` that are claimed to be invariants."""
    y0 = np.array(y0)
    y0 = y0 + (0j if y0.dtype.kind == "c" else 0.0)
    return Problem(name="claimed", fun=fun, y0=y0, t_span=(0.0, end), invariants=kept)


def equations(system: CaseEquations, y0: Any, end: float, of: CaseEquations | None = None) -> Problem:
    """Return a system of the hard cases with the claimed invariants of the system `of`; default: its own invariants."""
    of = of or system
    return claimed(system.fun, y0, end, Invariant(of.values, of.gradients, name="I"))


def mechanics(
    acceleration: Callable[[float, Array, Array], Any],
    potential: Callable[[Array], float],
    slope: Callable[[Array], Any],
    q0: Any,
    v0: Any,
    end: float,
    masses: Any = 1.0,
) -> Problem:
    """Return q'' = acceleration(t, q, v) with the claimed energy m v^2 / 2 + potential(q).

    `slope` is the derivative of the potential.
    """
    n = np.size(q0)

    def fun(t, y):
        return np.concatenate([y[n:], np.atleast_1d(acceleration(t, y[:n], y[n:]))])

    def energy(t, y):
        return float(np.sum(masses * y[n:] ** 2) / 2 + potential(y[:n]))

    def gradient(t, y):
        return np.concatenate([np.atleast_1d(slope(y[:n])), masses * y[n:]])

    y0 = np.concatenate([np.atleast_1d(q0), np.atleast_1d(v0)])
    return claimed(fun, y0, end, Invariant(energy, gradient, name="energy"))


def turning() -> Invariant:
    """Return the angular momentum of motion in the plane, y = (x, z, u, v) with velocities u and v, as an invariant."""
    return Invariant(
        lambda t, y: y[0] * y[3] - y[1] * y[2], lambda t, y: np.array([y[3], -y[2], -y[1], y[0]]), name="L"
    )


class Verlet:
    """Velocity Verlet for q'' = force(t, q, v), as a one-step method that a user has written."""

    order = 2

    def __init__(self, force: Callable[[float, np.ndarray, np.ndarray], np.ndarray]) -> None:
        self.force = force

    def one_step(self, t, y, h):
        q, v = np.split(y, 2)
        v = v + h / 2 * self.force(t, q, v)
        q = q + h * v
        return np.concatenate([q, v + h / 2 * self.force(t + h, q, v)])


# --- one and two degrees of freedom ---


def pendulum(friction: float = 0.0, sign: float = 1.0, end: float = 20.0, q0: float = 2.0, v0: float = 0.0) -> Problem:
    """Return a pendulum with friction; the potential in the claimed energy has the factor `sign`."""
    return mechanics(
        lambda t, q, v: -np.sin(q) - friction * v,
        lambda q: -sign * np.cos(q[0]),
        lambda q: sign * np.sin(q),
        q0,
        v0,
        end,
    )


def spring(force: Callable[[float, Array, Array], Any], q0: float = 1.0, v0: float = 0.0, end: float = 20.0) -> Problem:
    """Return q'' = force(t, q, v) with the claimed energy q'^2 / 2 + q^2 / 2."""
    return mechanics(force, lambda q: q[0] ** 2 / 2, lambda q: q, q0, v0, end)


def duffing(cubic: float = 1.0, q0: float = 0.5, end: float = 20.0) -> Problem:
    """Return q'' = q - q^3; the quartic term in the claimed energy has the factor `cubic`."""
    return mechanics(
        lambda t, q, v: q - q**3,
        lambda q: -(q[0] ** 2) / 2 + cubic * q[0] ** 4 / 4,
        lambda q: -q + cubic * q**3,
        q0,
        0.0,
        end,
    )


def falling(drag: float, v0: float = 0.0, end: float = 10.0) -> Problem:
    """Return a stone that falls with the air's resistance, with the claimed energy of one that falls without."""
    return mechanics(lambda t, q, v: -1 - drag * v * np.abs(v), lambda q: q[0], lambda q: np.ones(1), 10.0, v0, end)


def henon_heiles(cubic: float = 1.0, q0: Any = (0.3, 0.2), v0: Any = (0.0, 0.0), end: float = 50.0) -> Problem:
    """Return the system of Henon and Heiles; the cubic terms in the claimed energy have the factor `cubic`."""
    return mechanics(
        lambda t, q, v: np.array([-q[0] - 2 * q[0] * q[1], -q[1] - q[0] ** 2 + q[1] ** 2]),
        lambda q: (q @ q) / 2 + cubic * (q[0] ** 2 * q[1] - q[1] ** 3 / 3),
        lambda q: np.array([q[0] + cubic * 2 * q[0] * q[1], q[1] + cubic * (q[0] ** 2 - q[1] ** 2)]),
        q0,
        v0,
        end,
    )


def central(extra: Callable[[float, Array], Any], y0: Any, end: float, *kept: Invariant) -> Problem:
    """Return Kepler's attraction plus the acceleration extra(t, y) in the plane, with the claimed invariants `kept`."""

    def fun(t, y):
        return np.concatenate([y[2:], -y[:2] / np.hypot(y[0], y[1]) ** 3 + extra(t, y)])

    return claimed(fun, y0, end, *kept)


def kepler_energy() -> Invariant:
    """Return the energy of motion around a centre with G M = 1 in the plane as an invariant."""
    return Invariant(
        lambda t, y: (y[2] ** 2 + y[3] ** 2) / 2 - 1 / np.hypot(y[0], y[1]),
        lambda t, y: np.concatenate([y[:2] / np.hypot(y[0], y[1]) ** 3, y[2:]]),
        name="energy",
    )


def laplace_x() -> Invariant:
    """Return the x component of Laplace's vector of motion around a centre with G M = 1 as an invariant."""

    def value(t, y):
        x, z, u, v = y
        return v * (x * v - z * u) - x / np.hypot(x, z)

    def gradient(t, y):
        x, z, u, v = y
        r = np.hypot(x, z)
        return np.array([v * v - 1 / r + x * x / r**3, -u * v + x * z / r**3, -z * v, 2 * x * v - z * u])

    return Invariant(value, gradient, name="A_x")


# --- lattices ---


def chain(
    force: Callable[[Array], Array],
    spring_energy: Callable[[Array], Array],
    claimed_force: Callable[[Array], Array],
    q0: Any,
    end: float,
    v0: Any = None,
    friction: Any = 0.0,
    masses: Any = 1.0,
) -> Problem:
    """Return masses in a row between walls, connected by springs, with a claimed energy.

    `force` is a function of the elongations of the springs. The claimed energy is computed with `spring_energy`, whose
    derivative is `claimed_force`, and with masses of 1.
    """
    q0 = np.array(q0, dtype=float)

    def stretched(q):
        return np.diff(q, prepend=0.0, append=0.0)

    def acceleration(t, q, v):
        return (np.diff(force(stretched(q))) - friction * v) / masses

    def potential(q):
        return float(spring_energy(stretched(q)).sum())

    v0 = np.zeros(q0.size) if v0 is None else v0
    return mechanics(acceleration, potential, lambda q: -np.diff(claimed_force(stretched(q))), q0, v0, end)


def toda(claim_harmonic: bool = False, n: int = 8, end: float = 20.0, moving: bool = False) -> Problem:
    """Return Toda's lattice with one mass displaced, which also has a velocity at the start if `moving`.

    The claimed energy is the true one or, if `claim_harmonic` is true, that of harmonic springs.
    """
    q0 = np.where(np.arange(n) == n // 2, 0.8, 0.0)
    v0 = np.where(np.arange(n) == n // 2, 0.5, 0.0) if moving else None
    if claim_harmonic:
        return chain(np.expm1, lambda d: d * d / 2, lambda d: d, q0, end, v0)
    return chain(np.expm1, lambda d: np.expm1(d) - d, np.expm1, q0, end, v0)


def fput(
    alpha: float = 0.25, claimed_alpha: float | None = None, n: int = 16, end: float = 50.0, **more: Any
) -> Problem:
    """Return the chain of Fermi, Pasta, Ulam and Tsingou, which starts in the first mode.

    `claimed_alpha` is the coefficient `alpha` in the claimed energy; default: the true one.
    """
    own = alpha if claimed_alpha is None else claimed_alpha
    q0 = np.sin(np.pi * np.arange(1, n + 1) / (n + 1))
    return chain(
        lambda d: d + alpha * d * d, lambda d: d * d / 2 + own * d**3 / 3, lambda d: d + own * d * d, q0, end, **more
    )


def sine_gordon(
    claimed_coupling: float | None = None, n: int = 64, end: float = 20.0, friction: float = 0.0
) -> Problem:
    """Return the sine-Gordon equation by the method of lines: a kink and an antikink at rest.

    `claimed_coupling` is a factor of the gradient term in the claimed energy; default: 1, the true one.
    """
    x = np.linspace(-10, 10, n, endpoint=False)
    h = x[1] - x[0]
    c = 1 / h**2
    own = c if claimed_coupling is None else claimed_coupling * c
    u0 = 4 * np.arctan(np.exp(x + 5)) - 4 * np.arctan(np.exp(x - 5))

    def curvature(u):
        return np.roll(u, -1) - 2 * u + np.roll(u, 1)

    return mechanics(
        lambda t, u, v: c * curvature(u) - np.sin(u) - friction * v,
        lambda u: own * (np.diff(u, append=u[:1]) ** 2).sum() / 2 + (1 - np.cos(u)).sum(),
        lambda u: -own * curvature(u) + np.sin(u),
        u0,
        np.zeros(n),
        end,
    )


# --- complex states ---


def waves(
    end: float,
    *,
    n: int = 64,
    potential: Callable[[float, Array], Any] = lambda t, x: x**2 / 2,
    beta: float = 0.0,
    claimed_beta: float | None = None,
    claimed_potential: Callable[[Array], Array] | None = None,
    start: Callable[[Array], Array] = lambda x: np.exp(-((x - 1) ** 2) / 2),
    keep: Sequence[str] = ("mass", "energy"),
) -> Problem:
    """Return i psi' = -psi''/2 + V psi + beta |psi|^2 psi on a periodic line, with claimed mass and energy.

    `potential` is the function V(t, x), `start` the function of x that is the field at t = 0, and `keep` has the names
    of the invariants that are claimed. `claimed_beta` and `claimed_potential` are beta and V in the claimed energy;
    default: the true ones at t = 0.
    """
    x = np.linspace(-8, 8, n, endpoint=False)
    dx = x[1] - x[0]
    k2 = (2 * np.pi * np.fft.fftfreq(n, dx)) ** 2
    b = beta if claimed_beta is None else claimed_beta
    V = np.real(potential(0.0, x)) if claimed_potential is None else claimed_potential(x)

    def kinetic(psi):
        return np.fft.ifft(k2 / 2 * np.fft.fft(psi))

    def fun(t, psi):
        return -1j * (kinetic(psi) + (potential(t, x) + beta * np.abs(psi) ** 2) * psi)

    def energy(t, psi):
        density = np.abs(psi) ** 2
        return float((np.vdot(psi, kinetic(psi)).real + (V * density + b / 2 * density**2).sum()) * dx)

    def slope(t, psi):
        return 2 * dx * (kinetic(psi) + (V + b * np.abs(psi) ** 2) * psi)

    mass = Invariant(lambda t, psi: float(np.vdot(psi, psi).real * dx), lambda t, psi: 2 * dx * psi, name="mass")
    known = {"mass": mass, "energy": Invariant(energy, slope, name="energy")}
    return claimed(fun, start(x) + 0j, end, *(known[item] for item in keep))


# --- compiled: jitted equations and energies ---


def jitted(rhs: Any, y0: Any, end: float, params: Array, kept: tuple[Any, Any, str], acc: Any = None) -> Problem:
    """Return a problem of jitted functions; `kept` are value, gradient and name of the claimed invariant."""
    value, gradient, name = kept

    def fun(t, y):
        out = np.empty(y.size)
        rhs(t, y, out, params)
        return out

    invariants = (Invariant(value, gradient, args=(params,), in_place=True, name=name),)
    y0 = np.array(y0, dtype=float)
    return Problem(name=name, fun=fun, rhs=rhs, acc=acc, y0=y0, t_span=(0.0, end), params=params, invariants=invariants)


# params: (square of the frequency, friction, strength of the driving force, its frequency)


@njit(cache=True)
def _spring_rhs(t, y, out, params):
    out[0] = y[1]
    out[1] = -params[0] * y[0] - params[1] * y[1] + params[2] * np.sin(params[3] * t)


@njit(cache=True)
def _spring_acc(t, q, params):
    return -params[0] * q + params[2] * np.sin(params[3] * t)


@njit(cache=True)
def _spring_energy(t, y, params):
    return 0.5 * (y[1] * y[1] + params[0] * y[0] * y[0])


@njit(cache=True)
def _spring_gradient(t, y, out, params):
    out[0] = params[0] * y[0]
    out[1] = y[1]


def compiled_spring(
    square: float = 1.0,
    friction: float = 0.0,
    force: float = 0.0,
    frequency: float = 1.0,
    end: float = 20.0,
    y0: Any = (1.0, 0.0),
) -> Problem:
    """Return a spring with friction and a driving force, jitted, with the claimed energy of a free spring.

    `square` is the square of the spring's angular frequency; the driving force is ``force * sin(frequency * t)``.
    """
    params, acc = np.array([square, friction, force, frequency]), None if friction else _spring_acc
    return jitted(_spring_rhs, y0, end, params, (_spring_energy, _spring_gradient, "energy"), acc)


@njit(cache=True)
def _pendulum_rhs(t, y, out, params):
    out[0] = y[1]
    out[1] = -np.sin(y[0]) - params[0] * y[1]


@njit(cache=True)
def _pendulum_energy(t, y, params):
    return 0.5 * y[1] * y[1] - np.cos(y[0])


@njit(cache=True)
def _pendulum_gradient(t, y, out, params):
    out[0] = np.sin(y[0])
    out[1] = y[1]


def compiled_pendulum(friction: float = 0.0, end: float = 20.0, y0: Any = (2.0, 0.0)) -> Problem:
    """Return a pendulum with friction, jitted, with the claimed energy of one without."""
    return jitted(_pendulum_rhs, y0, end, np.array([friction]), (_pendulum_energy, _pendulum_gradient, "energy"))


@njit(cache=True)
def _trap_rhs(t, y, out, params):
    out[0], out[1] = y[2], y[3]
    out[2], out[3] = -y[0], -params[0] * y[1]


@njit(cache=True)
def _trap_acc(t, q, params):
    return np.array([-q[0], -params[0] * q[1]])


@njit(cache=True)
def _trap_turning(t, y, params):
    return y[0] * y[3] - y[1] * y[2]


@njit(cache=True)
def _trap_gradient(t, y, out, params):
    out[0], out[1], out[2], out[3] = y[3], -y[2], -y[1], y[0]


def compiled_trap(square: float, end: float = 20.0) -> Problem:
    """Return a body in an anisotropic trap that starts on an axis, jitted, with a claimed angular momentum.

    The squares of the trap's angular frequencies are 1 along that axis and `square` along the other.
    """
    y0, kept = (1.0, 0.0, 0.0, 0.5), (_trap_turning, _trap_gradient, "L")
    return jitted(_trap_rhs, y0, end, np.array([square]), kept, _trap_acc)


@njit(cache=True)
def _doubled_gradient(t, y, out, params):
    out[0] = 2 * params[0] * y[0]
    out[1] = 2 * y[1]


def spring_of_doubled_gradient() -> Problem:
    """Return the problem of `compiled_spring` with twice the true gradient of the energy, jitted."""
    spring = compiled_spring()
    wrong = Invariant(_spring_energy, _doubled_gradient, args=(spring.params,), in_place=True, name="energy")
    return replace(spring, invariants=(wrong,))


# --- members: their invariants take the parameters ---


def bare(problem: Problem) -> Problem:
    return replace(
        problem, invariants=tuple(Invariant(i.fun, i.grad, in_place=True, name=i.name) for i in problem.invariants)
    )


def bare_pendulum(end: float = 20.0) -> Problem:
    return bare(compiled_pendulum(end=end))


def bare_spring() -> Problem:
    return bare(compiled_spring())
