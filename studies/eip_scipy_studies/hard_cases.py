"""Hard cases for integrators with projection: 35 problems with exact final states.

Kepler orbits to e = 0.999, SI units, circular orbits (parallel gradients), close encounters, tops, lattices, spins,
weak invariants, complex states. The equations are here; parameters, starts and final states are data
(``data/hard_cases.json``).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.resources import files
from typing import Any

import numpy as np

from eip_scipy import Invariant
from eip_scipy.problems import Problem

__all__ = ["HardCase", "hard_cases"]


@dataclass(frozen=True, eq=False)
class HardCase:
    """A hard case: a problem with its exact final state.

    Attributes
    ----------
    name, title : str
    problem : Problem
        The problem. It has one `Invariant` with values (l,), and ``problem.source`` is the citation.
    end : ndarray, shape (n,)
        The exact state at the end of ``problem.t_span``, up to about one rounding error.
    invariant_names : tuple of str, length l
    weak : tuple of str
        Names of invariants that are constant only on the manifold on which the start lies.
    growth : float
        Factor by which a small relative perturbation of the start has grown at the end.
    note : str
        Why the case is hard.
    cause : str
        Why projection does not reduce the error; "" if that is not known, or if it does.
    """

    name: str
    title: str
    problem: Problem
    end: np.ndarray
    invariant_names: tuple[str, ...]
    weak: tuple[str, ...]
    growth: float
    note: str
    cause: str

    def error(self, y: np.ndarray) -> float:
        """Return the error of a final state: largest component of `y` - `end`, relative to the largest one of `end`."""
        return float(np.max(np.abs(y - self.end)) / np.max(np.abs(self.end)))

    def drift(self, y: np.ndarray) -> float:
        """Return the largest relative change of an invariant along the states `y` (n, m), since the first one.

        The change is relative to the invariant's first value, or to a thousandth of the largest of all invariants if
        that is larger (an invariant may be zero).
        """
        (invariant,) = self.problem.invariants
        values = np.array([invariant.fun(0.0, state) for state in y.T])
        sizes = np.abs(values[0])
        return float(np.max(np.abs(values - values[0]) / np.maximum(sizes, 1e-3 * sizes.max())))


def hard_cases(names: Sequence[str] | None = None) -> tuple[HardCase, ...]:
    """Return the hard cases.

    Parameters
    ----------
    names : sequence of str, optional
        Names of the cases; default: all 35.

    Returns
    -------
    tuple of HardCase

    Raises
    ------
    ValueError
        If a name is unknown.

    Examples
    --------
    >>> case, = hard_cases(["kepler_e06"])
    >>> case.invariant_names, case.problem.y0.shape
    (('H', 'L'), (4,))
    """
    text = files("eip_scipy_studies.data").joinpath("hard_cases.json").read_text(encoding="utf-8")
    known = {record["name"]: record for record in json.loads(text)["cases"]}
    if unknown := [name for name in names or () if name not in known]:
        raise ValueError(f"there is no hard case {unknown[0]!r}; there are {', '.join(known)}.")
    return tuple(_case(known[name]) for name in (known if names is None else names))


def _case(record: dict[str, Any]) -> HardCase:
    equations = CaseEquations(record["equations"], tuple(record["params"].values()))
    y0, end = (np.array(record[key], dtype=float) for key in ("y0", "reference"))
    if record["complex"]:
        y0, end = y0.view(complex), end.view(complex)
    t0, t_end = record["t_span"]
    problem = Problem(
        name=record["name"],
        fun=equations.fun,
        y0=y0,
        t_span=(t0, t_end),
        invariants=(Invariant(equations.values, equations.gradients, name=", ".join(record["invariants"])),),
        reference=partial(_at_end, t_end, end),
        source=record["source"],
    )
    names, weak, cause = tuple(record["invariants"]), tuple(record["weak"]), record.get("cause", "")
    about = problem, end, names, weak, record["growth"], record["note"], cause
    return HardCase(record["name"], record["title"], *about)


def _at_end(t_end: float, end: np.ndarray, t: float) -> np.ndarray | None:
    return end.copy() if t == t_end else None


@dataclass(frozen=True)
class CaseEquations:
    """Equations of a case: the function of `EQUATIONS` with this name and these parameters in its order.

    It is a generator function of t, y and the parameters. It yields the right-hand side, and then pairs of an invariant
    and its gradient in the order in which its docstring names them.
    """

    name: str
    params: tuple[Any, ...] = ()

    def fun(self, t: float, y: np.ndarray) -> np.ndarray:
        """Return the right-hand side (n,)."""
        return np.asarray(next(self._parts(t, y)))

    def values(self, t: float, y: np.ndarray) -> np.ndarray:
        """Return the invariants (l,)."""
        _, *invariants = self._parts(t, y)
        return np.array([value for value, _ in invariants])

    def gradients(self, t: float, y: np.ndarray) -> np.ndarray:
        """Return the gradients (l, n) of the invariants."""
        _, *invariants = self._parts(t, y)
        return np.array([gradient for _, gradient in invariants])

    def _parts(self, t: float, y: np.ndarray) -> Iterator[Any]:
        return EQUATIONS[self.name](t, y, *self.params)


# --- planar motion, y = (x, z, u, v) with velocity (u, v) ---


def kepler(t, y, mu):
    """Kepler problem with GM = `mu`; invariants: energy, angular momentum."""
    x, z, u, v = y
    r2 = x * x + z * z
    r3 = r2 * np.sqrt(r2)
    yield [u, v, -mu * x / r3, -mu * z / r3]
    yield (u * u + v * v) / 2 - mu / np.sqrt(r2), [mu * x / r3, mu * z / r3, u, v]
    yield x * v - z * u, [v, -u, -z, x]


def perturbed_kepler(t, y, delta):
    """Motion in the potential -1 / r - delta / (2 r^3); invariants: energy, angular momentum."""
    x, z, u, v = y
    r2 = x * x + z * z
    r = np.sqrt(r2)
    w = 1 / (r2 * r) + 3 * delta / (2 * r2 * r2 * r)
    yield [u, v, -w * x, -w * z]
    yield (u * u + v * v) / 2 - 1 / r - delta / (2 * r2 * r), [w * x, w * z, u, v]
    yield x * v - z * u, [v, -u, -z, x]


def arenstorf(t, y, mu):
    """Restricted three-body problem with masses 1 - mu and mu in the rotating frame; invariant: Jacobi's integral."""
    x, z, u, v = y
    rest = 1 - mu
    a2 = (x + mu) * (x + mu) + z * z
    b2 = (x - rest) * (x - rest) + z * z
    a, b = rest / (a2 * np.sqrt(a2)), mu / (b2 * np.sqrt(b2))
    yield [u, v, x + 2 * v - a * (x + mu) - b * (x - rest), z - 2 * u - (a + b) * z]
    jacobi = x * x + z * z + 2 * rest / np.sqrt(a2) + 2 * mu / np.sqrt(b2) - u * u - v * v
    yield jacobi, [2 * (x - a * (x + mu) - b * (x - rest)), 2 * (z - (a + b) * z), -2 * u, -2 * v]


def henon_heiles(t, y):
    """System of Hénon and Heiles; invariant: energy."""
    x, z, u, v = y
    yield [u, v, -x - 2 * x * z, -z - x * x + z * z]
    energy = (u * u + v * v + x * x + z * z) / 2 + x * x * z - z * z * z / 3
    yield energy, [x + 2 * x * z, z + x * x - z * z, u, v]


def boris_2d(t, y, charge):
    """Charged particle in B = r e_z and the potential charge / r; invariants: energy, canonical angular momentum."""
    x, z, u, v = y
    r2 = x * x + z * z
    r = np.sqrt(r2)
    e = charge / (r2 * r)
    yield [u, v, e * x + v * r, e * z - u * r]
    yield (u * u + v * v) / 2 + charge / r, [-e * x, -e * z, u, v]
    yield x * v - z * u + r2 * r / 3, [v + r * x, -u + r * z, -z, x]


# --- bodies, pendulums, particles ---


def n_body(t, y, masses, G, dimension, softening=0.0):
    """N bodies, y = (positions of all, velocities of all); invariants: energy, momentum, angular momentum.

    `softening` is added to squared distances.
    """
    m = np.array(masses)
    q, v = y.reshape(2, m.size, dimension)
    d = q[:, None] - q[None, :]
    r2 = (d * d).sum(axis=-1) + softening
    np.fill_diagonal(r2, 1.0)
    w = G / (r2 * np.sqrt(r2))
    a = -np.einsum("ij,j,ijk->ik", w, m, d)
    yield np.concatenate([v.ravel(), a.ravel()])
    first, second = np.triu_indices(m.size, 1)
    d = q[first] - q[second]
    kinetic = (m[:, None] * v * v).sum() / 2
    potential = (G * m[first] * m[second] / np.sqrt((d * d).sum(axis=-1) + softening)).sum()
    yield kinetic - potential, np.concatenate([(-m[:, None] * a).ravel(), (m[:, None] * v).ravel()])
    for k, momentum in enumerate(m @ v):
        row = np.zeros((2, m.size, dimension))
        row[1, :, k] = m
        yield momentum, row.ravel()
    for i, j in [(0, 1)] if dimension == 2 else [(1, 2), (2, 0), (0, 1)]:
        row = np.zeros((2, m.size, dimension))
        row[0, :, i], row[0, :, j] = m * v[:, j], -m * v[:, i]
        row[1, :, j], row[1, :, i] = m * q[:, i], -m * q[:, j]
        yield (m * (q[:, i] * v[:, j] - q[:, j] * v[:, i])).sum(), row.ravel()


def pendulum(t, y):
    """Mathematical pendulum, y = (angle, angular velocity); invariant: energy."""
    q, p = y
    yield [p, -np.sin(q)]
    yield p * p / 2 - np.cos(q), [np.sin(q), p]


def duffing(t, y):
    """Equation x'' = x - x^3, y = (x, x'); invariant: energy."""
    q, p = y
    yield [p, q - q * q * q]
    yield p * p / 2 - q * q / 2 + q * q * q * q / 4, [q * q * q - q, p]


def oscillator(t, y):
    """Harmonic oscillator; invariant: energy."""
    q, p = y
    yield [p, -q]
    yield (p * p + q * q) / 2, [q, p]


def double_pendulum(t, y, g):
    """Double pendulum of equal masses and lengths, y = (angles, momenta); invariant: energy."""
    a, b, p, q = y
    s, c = np.sin(a - b), np.cos(a - b)
    D = 1 + s * s
    k = p * q * s / D
    w = (p * p + 2 * q * q - 2 * p * q * c) * s * c / (D * D)
    f = [(p - q * c) / D, (2 * q - p * c) / D, -2 * g * np.sin(a) - k + w, -g * np.sin(b) + k - w]
    yield f
    kinetic = (p * p + 2 * q * q - 2 * p * q * c) / (2 * (1 + s * s))
    yield kinetic - 2 * g * np.cos(a) - g * np.cos(b), [-f[2], -f[3], f[0], f[1]]


def spherical_pendulum(t, y, g):
    """Pendulum in space, y = (q, v) in Cartesian coordinates.

    Invariants: the constraints ``(|q|^2 - 1) / 2`` and q @ v, energy, and angular momentum about the vertical.
    """
    q, v = y[:3], y[3:]
    yield np.concatenate([v, -(v @ v - g * q[2]) / (q @ q) * q - [0, 0, g]])
    a, b, c, u, w, z = y
    yield (q @ q - 1) / 2, [a, b, c, 0, 0, 0]
    yield q @ v, [u, w, z, a, b, c]
    yield v @ v / 2 + g * c, [0, 0, g, u, w, z]
    yield a * w - b * u, [w, -u, 0, -b, a, 0]


def fput(t, y, omega):
    """Chain of Fermi, Pasta, Ulam and Tsingou with stiff springs of frequency `omega`; invariant: energy."""
    x, z, p = y[:3], y[3:6], y[6:]
    soft = np.array([x[0] - z[0], x[1] - z[1] - x[0] - z[0], x[2] - z[2] - x[1] - z[1], x[2] + z[2]])
    a, b, c, d = soft**3
    force = np.concatenate([[b - a, c - b, -c - d], np.array([a + b, b + c, c - d]) - omega * omega * z])
    yield np.concatenate([p, force])
    energy = (p @ p + omega * omega * (z @ z)) / 2 + (soft**4).sum() / 4
    yield energy, np.concatenate([-force, p])


def vortices(t, y, strengths):
    """Point vortices, y = (x, y) vortex by vortex; invariants: energy, two momenta, angular impulse."""
    k, z = np.array(strengths), y.reshape(-1, 2)
    d = z[:, None] - z[None, :]
    r2 = (d * d).sum(axis=-1)
    np.fill_diagonal(r2, 1.0)
    w = k / r2
    f = np.stack([-(w * d[..., 1]).sum(axis=1), (w * d[..., 0]).sum(axis=1)], axis=1)
    yield f.ravel()
    first, second = np.triu_indices(k.size, 1)
    d = z[first] - z[second]
    energy = -(k[first] * k[second] * np.log((d * d).sum(axis=-1))).sum() / 2
    yield energy, np.stack([-k * f[:, 1], k * f[:, 0]], axis=1).ravel()
    for momentum, direction in zip(k @ z, np.eye(2), strict=True):
        yield momentum, np.outer(k, direction).ravel()
    yield (k[:, None] * z * z).sum(), (2 * k[:, None] * z).ravel()


def tokamak(t, y):
    """Charged particle in an axisymmetric field, R0 = B0 = 1, q = 2; invariants: energy, toroidal momentum."""
    x, w, z, a, b, c = y
    R2 = x * x + w * w
    R = np.sqrt(R2)
    k = (R - 1) / (2 * R)
    bx, bw, bz = -(2 * w + x * z) / (2 * R2), (2 * x - w * z) / (2 * R2), k
    yield [a, b, c, b * bz - c * bw, c * bx - a * bz, a * bw - b * bx]
    yield (a * a + b * b + c * c) / 2, [0, 0, 0, a, b, c]
    yield x * b - w * a + ((R - 1) * (R - 1) + z * z) / 4, [b + k * x, -a + k * w, z / 2, -w, x, 0]


def schwarzschild(t, y):
    """Geodesics of Schwarzschild's metric, M = 1, y = (t, r, phi, E, p_r, L).

    Invariants: the mass shell, energy and angular momentum.
    """
    _, r, _, E, p, L = y
    a = 1 - 2 / r
    force = -E * E / (a * a * r * r) - p * p / (r * r) + L * L / (r * r * r)
    yield [E / a, a * p, L / (r * r), 0, force, 0]
    yield (-E * E / a + a * p * p + L * L / (r * r)) / 2, [0, -force, 0, -E / a, a * p, L / (r * r)]
    yield E, [0, 0, 0, 1, 0, 0]
    yield L, [0, 0, 0, 0, 0, 1]


# --- tops, spins, attitude ---


def rigid_body(t, y, i1, i2, i3):
    """Euler's top with these moments of inertia, y = the angular momentum; invariants: Casimir function, energy."""
    a, b, c = y
    yield [(1 / i3 - 1 / i2) * b * c, (1 / i1 - 1 / i3) * c * a, (1 / i2 - 1 / i1) * a * b]
    yield (a * a + b * b + c * c) / 2, y
    yield (a * a / i1 + b * b / i2 + c * c / i3) / 2, [a / i1, b / i2, c / i3]


def euler_detest(t, y, k2):
    """Problem B5 of DETEST, whose solutions are Jacobi's elliptic functions of modulus k; two quadratic invariants."""
    a, b, c = y
    yield [b * c, -a * c, -k2 * a * b]
    yield a * a + b * b, [2 * a, 2 * b, 0]
    yield k2 * a * a + c * c, [2 * k2 * a, 0, 2 * c]


def quaternion(t, y, w3):
    """Attitude, a quaternion y, under the angular velocity (sin t, cos 2t, w3); invariant: ``y @ y``."""
    s, a, b, c = y
    u, v, w = np.sin(t), np.cos(2 * t), w3
    turned = [-(a * u + b * v + c * w), s * u + b * w - c * v, s * v + c * u - a * w, s * w + a * v - b * u]
    yield np.array(turned) / 2
    yield y @ y, 2 * y


def heisenberg(t, y, anisotropy):
    """Ring of spins (Landau and Lifshitz); invariants: squared length of each, energy, total spin along z."""
    S, axis = y.reshape(-1, 3), np.array([0.0, 0.0, anisotropy])
    before, after = np.roll(S, 1, axis=0), np.roll(S, -1, axis=0)
    yield np.cross(S, before + after + axis * S).ravel()
    for length, one in zip((S * S).sum(axis=1), np.eye(len(S)), strict=True):
        yield length, (2 * one[:, None] * S).ravel()
    yield -(S * after).sum() - anisotropy * (S[:, 2] @ S[:, 2]) / 2, (-before - after - axis * S).ravel()
    yield S[:, 2].sum(), np.tile([0.0, 0.0, 1.0], len(S))


# --- populations, lattices, fields ---


def lotka_volterra(t, y):
    """Predator and prey, y = (u, v); invariant: ln u - u + 2 ln v - v."""
    u, v = y
    yield [u * (v - 2), v * (1 - u)]
    yield np.log(u) - u + 2 * np.log(v) - v, [1 / u - 1, 2 / v - 1]


def sir(t, y, infection, recovery):
    """Epidemic of Kermack and McKendrick, y = (S, I, R).

    Invariants: S + I + R and I + S - (recovery / infection) ln S.
    """
    s, i, r = y
    yield [-infection * s * i, infection * s * i - recovery * i, recovery * i]
    ratio = recovery / infection
    yield s + i + r, [1, 1, 1]
    yield i + s - ratio * np.log(s), [1 - ratio / s, 1, 0]


def volterra_lattice(t, y):
    """Kac and van Moerbeke's lattice; invariants: sum, a quadratic one, logarithm of the product."""
    after, before = np.roll(y, -1), np.roll(y, 1)
    yield y * (after - before)
    yield y.sum(), np.ones(y.size)
    yield (y * y / 2 + y * after).sum(), y + after + before
    yield np.log(y).sum(), 1 / y


def zabusky_kruskal(t, y, c1, c2):
    """Korteweg and de Vries's equation in Zabusky and Kruskal's scheme; invariants: sum of u, sum of u^2.

    For u_t + u u_x + delta^2 u_xxx = 0 on points with the distance d, `c1` is 1 / (6 d), and `c2` is
    delta^2 / (2 d^3).
    """
    a, b = np.roll(y, -1), np.roll(y, 1)
    yield -(a + y + b) * (a - b) * c1 - c2 * (np.roll(y, -2) - 2 * a + 2 * b - np.roll(y, 2))
    yield y.sum(), np.ones(y.size)
    yield y @ y, 2 * y


def sine_gordon(t, y, coupling):
    """Periodic chain of Frenkel and Kontorova, y = (u, v); invariant: energy."""
    u, v = np.split(y, 2)
    force = coupling * (np.roll(u, -1) - 2 * u + np.roll(u, 1)) - np.sin(u)
    yield np.concatenate([v, force])
    d = np.roll(u, -1) - u
    yield (v * v / 2 + coupling * d * d / 2 + 1 - np.cos(u)).sum(), np.concatenate([-force, v])


def three_wave(t, y):
    """Resonant interaction of three complex waves; invariants: two Manley-Rowe relations, energy."""
    a, b, c = y
    pairs = np.array([np.conj(b) * c, np.conj(a) * c, a * b])
    yield -1j * pairs
    square = (y * np.conj(y)).real
    yield square[0] + square[2], [2 * a, 0, 2 * c]
    yield square[1] + square[2], [0, 2 * b, 2 * c]
    yield 2 * (a * b * np.conj(c)).real, 2 * pairs


def ablowitz_ladik(t, y):
    """Ablowitz and Ladik's periodic complex lattice; invariants: mass, and the complex correlation of neighbours."""
    right, left, square = np.roll(y, -1), np.roll(y, 1), (y * np.conj(y)).real
    yield 1j * ((right + left) * (1 + square) - 2 * y)
    correlation = (y * np.conj(right)).sum()
    yield np.log(1 + square).sum(), 2 * y / (1 + square)
    yield correlation.real, right + left
    yield correlation.imag, 1j * (right - left)


def brockett(t, y):
    """Double-bracket flow L' = [L, [L, diag(1, 2, 3)]], y = (diagonal, off-diagonals) of L.

    Invariants: the traces of L, L^2 and L^3.
    """
    L, levels = y[np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2]])], np.diag([1.0, 2.0, 3.0])
    components = ([0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2])
    K = L @ levels - levels @ L
    yield (L @ K - K @ L)[components]
    counted = np.array([1, 1, 1, 2, 2, 2])  # off-diagonal entries occur twice in L
    powers = np.eye(3), L, L @ L, L @ L @ L
    for k in (1, 2, 3):
        yield np.trace(powers[k]), k * counted * powers[k - 1][components]


EQUATIONS: dict[str, Callable[..., Iterator[Any]]] = {
    system.__name__: system
    for system in (
        *(kepler, perturbed_kepler, arenstorf, henon_heiles, boris_2d, n_body, pendulum, duffing, oscillator),
        *(double_pendulum, spherical_pendulum, fput, vortices, tokamak, schwarzschild, rigid_body, euler_detest),
        *(quaternion, heisenberg, lotka_volterra, sir, volterra_lattice, zabusky_kruskal, sine_gordon, three_wave),
        *(ablowitz_ladik, brockett),
    )
}
