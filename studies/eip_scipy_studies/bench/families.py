"""Random conservative systems, each with all that it keeps: polynomials, bodies, lattices, spins, quantum states."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

Array = np.ndarray


@dataclass(frozen=True)
class Quantity:
    """Something that a system keeps, a number or a vector; its gradient, and the same by f where that is known."""

    name: str
    fun: Callable[[float, Array], Any]
    grad: Callable[[float, Array], Array]
    by_f: Callable[[float, Array, Array], Array] | None = None


@dataclass(frozen=True)
class System:
    """An initial value problem: `acc` of q'' = acc(t, q) where it is one, `frame` for what it keeps linearly.

    `rate` is the fastest one that the Jacobian matrix does not show (that of a driving force).
    """

    name: str
    fun: Callable[[float, Array], Array]
    y0: Array
    kept: tuple[Quantity, ...]
    acc: Callable[[float, Array], Array] | None = None
    frame: tuple[Array, Array] | None = None
    exact: Callable[[float], Array] | None = None
    rate: float = 0.0
    t0: float = 0.0
    unit: Array | float = 1.0
    notes: tuple[str, ...] = field(default=())


def second_order(
    name: str, acc: Callable[[float, Array], Array], q: Array, v: Array, kept: tuple[Quantity, ...], **more: Any
) -> System:
    """The system of q'' = acc(t, q)."""
    return System(name, first_order(acc), np.concatenate([q, v]), kept, acc=acc, **more)


def first_order(acc: Callable[[float, Array], Array]) -> Callable[[float, Array], Array]:
    """The right-hand side for y = (q, v) of q'' = acc(t, q)."""

    def fun(t: float, y: Array) -> Array:
        half = y.size // 2
        return np.concatenate([y[half:], acc(t, y[:half])])

    return fun


def mechanical(name: str, V: Callable[[Array], float], dV: Callable[[Array], Array]) -> Quantity:
    """The energy of q'' = -dV(q)."""

    def value(t: float, y: Array) -> float:
        half = y.size // 2
        return 0.5 * (y[half:] @ y[half:]) + V(y[:half])

    def gradient(t: float, y: Array) -> Array:
        half = y.size // 2
        return np.concatenate([dV(y[:half]), y[half:]])

    def by_f(t: float, y: Array, f: Array) -> Array:
        half = y.size // 2
        return np.concatenate([-f[half:], f[:half]])

    return Quantity(name, value, gradient, by_f)


def bowl(rng: np.random.Generator, n: int) -> tuple[Callable[[Array], float], Callable[[Array], Array]]:
    """A polynomial of degree 4 that grows in all directions, and its gradient."""
    Q, _ = np.linalg.qr(rng.standard_normal((n, n)))
    A, B = (Q * rng.uniform(0.3, 3.0, n)) @ Q.T, rng.uniform(0.0, 0.5, (n, n))
    B = B + B.T

    def value(x: Array) -> float:
        return 0.5 * (x @ A @ x) + 0.25 * (x**2 @ B @ x**2)

    def gradient(x: Array) -> Array:
        return A @ x + x * (B @ x**2)

    return value, gradient


def oscillators(rng: np.random.Generator) -> System:
    """Linear ones of frequencies up to a factor of 30 apart, in coordinates that mix them; closed form."""
    n = int(rng.integers(1, 6))
    Q, _ = np.linalg.qr(rng.standard_normal((n, n)))
    w = 10 ** rng.uniform(-0.75, 0.75, n)
    K = (Q * w**2) @ Q.T
    q, v = rng.standard_normal(n), rng.standard_normal(n)

    def modes(t: float, y: Array) -> Array:
        return 0.5 * ((Q.T @ y[n:]) ** 2 + (w * (Q.T @ y[:n])) ** 2)

    def modes_gradient(t: float, y: Array) -> Array:
        return np.hstack([(w**2 * (Q.T @ y[:n]))[:, None] * Q.T, (Q.T @ y[n:])[:, None] * Q.T])

    def exact(t: float) -> Array:
        a, b, c, s = Q.T @ q, Q.T @ v / w, np.cos(w * t), np.sin(w * t)
        return np.concatenate([Q @ (a * c + b * s), Q @ (w * (b * c - a * s))])

    kept = (mechanical("H", lambda x: 0.5 * (x @ K @ x), lambda x: K @ x), Quantity("modes", modes, modes_gradient))
    return second_order("oscillators", lambda t, x: -(K @ x), q, v, kept, exact=exact)


def driven(rng: np.random.Generator) -> System:
    """A driven oscillator: what it keeps depends on time."""
    w, drive, F = rng.uniform(0.5, 2.0), rng.uniform(2.5, 5.0), rng.uniform(0.2, 2.0)
    gain = F / (w * w - drive * drive)

    def relative(t: float, y: Array) -> tuple[float, float]:
        return y[0] - gain * math.cos(drive * t), y[1] + gain * drive * math.sin(drive * t)

    def value(t: float, y: Array) -> float:
        q, v = relative(t, y)
        return 0.5 * (v * v + w * w * q * q)

    def gradient(t: float, y: Array) -> Array:
        q, v = relative(t, y)
        return np.array([w * w * q, v])

    def acc(t: float, q: Array) -> Array:
        return np.array([F * math.cos(drive * t) - w * w * q[0]])

    kept = (Quantity("relative energy", value, gradient),)
    return second_order("driven", acc, rng.standard_normal(1), rng.standard_normal(1), kept, rate=drive)


def poisson(rng: np.random.Generator) -> System:
    """y' = S(y) grad H(y) with a skew matrix S that is linear in y."""
    n = int(rng.integers(2, 8))
    H, dH = bowl(rng, n)
    S0, *S1 = (scale * (a - a.T) for scale in [1.0, *[0.3] * n] for a in [rng.standard_normal((n, n)) / math.sqrt(n)])

    def fun(t: float, y: Array) -> Array:
        return (S0 + np.tensordot(y, np.array(S1), 1)) @ dH(y)

    return System("poisson", fun, 0.7 * rng.standard_normal(n), (Quantity("H", lambda t, y: H(y), lambda t, y: dH(y)),))


def rigid_body(rng: np.random.Generator) -> System:
    """Euler's equations of a free body."""
    inertia = rng.uniform(0.5, 3.0, 3)
    kept = (
        Quantity("H", lambda t, w: 0.5 * (inertia @ w**2), lambda t, w: inertia * w),
        Quantity("L2", lambda t, w: (inertia * w) @ (inertia * w), lambda t, w: 2 * inertia**2 * w),
    )
    return System("rigid body", lambda t, w: np.cross(inertia * w, w) / inertia, rng.standard_normal(3), kept)


def toda(rng: np.random.Generator) -> System:
    """Toda's ring, with the third of its invariants."""
    n = int(rng.integers(3, 8))

    def pull(q: Array) -> Array:
        return np.exp(q - np.roll(q, -1))

    def slope(q: Array) -> Array:
        e = pull(q)
        return e - np.roll(e, 1)

    def third(t: float, y: Array) -> float:
        e, p = pull(y[:n]), y[n:]
        return float((p**3 + 3 * e * (p + np.roll(p, -1))).sum())

    def third_gradient(t: float, y: Array) -> Array:
        e, p = pull(y[:n]), y[n:]
        s = 3 * e * (p + np.roll(p, -1))
        return np.concatenate([s - np.roll(s, 1), 3 * p**2 + 3 * (e + np.roll(e, 1))])

    q, v = 0.5 * rng.standard_normal((2, n))
    C = np.kron(np.eye(2), np.ones((1, n)))  # the sums of positions and of velocities
    kept = (
        mechanical("H", lambda q: float(pull(q).sum()), slope),
        Quantity("P", lambda t, y: float(y[n:].sum()), lambda t, y: np.array([*np.zeros(n), *np.ones(n)])),
        Quantity("third", third, third_gradient),
    )
    return second_order("toda", lambda t, x: -slope(x), q, v, kept, linear_invariants=(C, C.T.copy()))


MOMENTUM = Quantity("L", lambda t, y: y[0] * y[3] - y[1] * y[2], lambda t, y: np.array([y[3], -y[2], -y[1], y[0]]))


def kepler(rng: np.random.Generator) -> System:
    """Kepler's problem with the Runge-Lenz vector, which depends on the others."""
    e = rng.choice([0.0, rng.uniform(0.0, 0.7)])
    angle = rng.uniform(0, 2 * np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])

    def slope(q: Array) -> Array:
        return q / (q @ q) ** 1.5

    def lenz(t: float, y: Array) -> Array:
        q, v = y[:2], y[2:]
        return (v @ v) * q - (q @ v) * v - q / math.sqrt(q @ q)

    def lenz_gradient(t: float, y: Array) -> Array:
        q, v = y[:2], y[2:]
        r = math.sqrt(q @ q)
        by_q = (v @ v - 1 / r) * np.eye(2) - np.outer(v, v) + np.outer(q, q) / r**3
        return np.hstack([by_q, 2 * np.outer(q, v) - np.outer(v, q) - (q @ v) * np.eye(2)])

    kept = (mechanical("H", lambda q: -1 / math.sqrt(q @ q), slope), MOMENTUM, Quantity("lenz", lenz, lenz_gradient))
    start = turn @ np.array([1 - e, 0.0]), turn @ np.array([0.0, math.sqrt((1 + e) / (1 - e))])
    return second_order("kepler", lambda t, x: -slope(x), *start, kept)


def spins(rng: np.random.Generator) -> System:
    """A Heisenberg chain of classical spins: their lengths, their sum, the energy."""
    n = int(rng.integers(2, 5))
    J = rng.uniform(0.3, 1.5, n)

    def force(s: Array) -> Array:
        s = s.reshape(n, 3)
        return J[:, None] * np.roll(s, -1, 0) + np.roll(J[:, None] * s, 1, 0)

    def lengths_gradient(t: float, y: Array) -> Array:
        out = np.zeros((n, n, 3))
        out[np.arange(n), np.arange(n)] = 2 * y.reshape(n, 3)
        return out.reshape(n, 3 * n)

    kept = (
        Quantity("lengths", lambda t, y: (y.reshape(n, 3) ** 2).sum(1), lengths_gradient),
        Quantity("M", lambda t, y: y.reshape(n, 3).sum(0), lambda t, y: np.tile(np.eye(3), n)),
        Quantity("H", lambda t, y: 0.5 * float(y @ force(y).ravel()), lambda t, y: force(y).ravel()),
    )
    return System("spins", lambda t, y: np.cross(y.reshape(n, 3), force(y)).ravel(), rng.standard_normal(3 * n), kept)


def quantum(rng: np.random.Generator) -> System:
    """i c' = H c; closed form."""
    n = int(rng.integers(1, 8))
    A = rng.standard_normal((n, n)) + 1j * rng.standard_normal((n, n))
    H = (A + A.conj().T) / (2 * math.sqrt(n))
    w, Q = np.linalg.eigh(H)
    c0 = rng.standard_normal(n) + 1j * rng.standard_normal(n)
    kept = (
        Quantity("norm", lambda t, c: float(np.vdot(c, c).real), lambda t, c: 2 * c),
        Quantity("H", lambda t, c: float(np.vdot(c, H @ c).real), lambda t, c: 2 * (H @ c), lambda t, c, f: 2j * f),
    )
    exact = lambda t: Q @ (np.exp(-1j * w * t) * (Q.conj().T @ c0))  # noqa: E731
    return System("quantum", lambda t, c: -1j * (H @ c), c0, kept, exact=exact)


FAMILIES = (
    *(oscillators, driven, poisson, rigid_body, toda),
    *(kepler, spins, quantum),
)


def random_system(rng: np.random.Generator) -> System:
    """Return one of them; some begin at another time, some have a different unit for each component."""
    system = FAMILIES[rng.integers(len(FAMILIES))](rng)
    if rng.random() < 0.3:
        system = described(system, t0=float(rng.choice([1.0, -7.3, 250.0])))
    if rng.random() < 0.15:
        system = described(system, unit=10 ** rng.uniform(-9, 9, system.y0.size))
    return system


def described(system: System, t0: float = 0.0, unit: Array | None = None) -> System:
    """Return the same motion with its clock set to t0, or with y = unit z; velocities keep their positions' unit."""
    fun, acc, exact, frame = system.fun, system.acc, system.exact, system.linear_invariants
    scale = np.ones(system.y0.size) if unit is None else unit
    if acc is not None:
        scale = np.tile(scale[: scale.size // 2], 2)

    def quantity(item: Quantity) -> Quantity:
        by_f = item.by_f
        return Quantity(
            item.name,
            lambda t, z: item.fun(t - t0, z * scale),
            lambda t, z: item.grad(t - t0, z * scale) * scale,
            None if by_f is None else lambda t, z, f: by_f(t - t0, z * scale, f * scale) * scale,
        )

    def acceleration(t: float, q: Array) -> Array:
        assert acc is not None
        return acc(t - t0, q * scale[: q.size]) / scale[: q.size]

    note = f"t0 = {t0:g}" if unit is None else "units of its own for each component"
    return replace(
        system,
        fun=(lambda t, z: fun(t - t0, z * scale) / scale) if acc is None else first_order(acceleration),
        acc=acc and acceleration,
        exact=exact and (lambda t: exact(t - t0) / scale),
        y0=system.y0 / scale,
        kept=tuple(map(quantity, system.kept)),
        linear_invariants=frame and (frame[0] * scale, frame[1] / scale[:, None]),
        t0=system.t0 + t0,
        unit=system.unit if unit is None else scale,
        notes=(*system.notes, note),
    )
