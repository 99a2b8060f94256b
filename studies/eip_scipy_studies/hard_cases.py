"""Hard cases for integrators with projection: 35 problems with exact final states.

Kepler orbits to e = 0.999, SI units, circular orbits (parallel gradients), close encounters, tops, lattices, spins,
weak invariants, complex states. The equations are here; parameters, starts and final states are data
(``data/hard_cases.json``).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.resources import files
from typing import Any, NamedTuple

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
    """

    name: str
    title: str
    problem: Problem
    end: np.ndarray
    invariant_names: tuple[str, ...]
    weak: tuple[str, ...]
    growth: float
    note: str

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


class CaseEquations(NamedTuple):
    """Equations of a case: right-hand side ``fun(t, y) -> (n,)``, and its invariants.

    ``values(t, y) -> (l,)`` returns the invariants, and ``gradients(t, y) -> (l, n)`` their gradients. The functions
    below that return such equations name the invariants in the order of ``values``.
    """

    fun: Callable[..., np.ndarray]
    values: Callable[..., np.ndarray]
    gradients: Callable[..., np.ndarray]


class _Function:
    """One of the functions of a `CaseEquations`, which is pickled as the arguments from which it is made.

    `equations` is a key of `EQUATIONS`, `params` are the keywords of the function found there, and `which` is the name
    of a field of the `CaseEquations` that it returns.
    """

    def __init__(self, equations: str, params: dict[str, Any], which: str) -> None:
        self._made = equations, params, which
        self._function = getattr(EQUATIONS[equations](**params), which)

    def __call__(self, t: float, y: np.ndarray) -> np.ndarray:
        return self._function(t, y)

    def __reduce__(self) -> tuple[Any, ...]:
        return _Function, self._made


def stored_cases() -> dict[str, dict[str, Any]]:
    """Return the parameters, starts and final states of all cases by their names, as they are stored."""
    text = files("eip_scipy_studies.data").joinpath("hard_cases.json").read_text(encoding="utf-8")
    return {record["name"]: record for record in json.loads(text)["cases"]}


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
    known = stored_cases()
    unknown = [name for name in names or () if name not in known]
    if unknown:
        raise ValueError(f"there is no hard case {unknown[0]!r}; there are {', '.join(known)}.")
    return tuple(_case(known[name]) for name in (known if names is None else names))


def _case(record: dict[str, Any]) -> HardCase:
    made = record["equations"], record["params"]
    fun, values, gradients = (_Function(*made, which) for which in CaseEquations._fields)
    y0, end = (_state(record, key) for key in ("y0", "reference"))
    t_end = record["t_span"][1]
    problem = Problem(
        name=record["name"],
        fun=fun,
        y0=y0,
        t_span=(record["t_span"][0], t_end),
        invariants=(Invariant(values, gradients, name=", ".join(record["invariants"])),),
        reference=partial(_at_end, t_end, end),
        source=record["source"],
    )
    return HardCase(
        name=record["name"],
        title=record["title"],
        problem=problem,
        end=end,
        invariant_names=tuple(record["invariants"]),
        weak=tuple(record["weak"]),
        growth=record["growth"],
        note=record["note"],
    )


def _at_end(t_end: float, end: np.ndarray, t: float) -> np.ndarray | None:
    return end.copy() if t == t_end else None


def _state(record: dict[str, Any], key: str) -> np.ndarray:
    floats = np.array(record[key], dtype=float)
    return floats.view(complex) if record["complex"] else floats


# --- planar motion, y = (x, z, u, v) with velocity (u, v) ---


def kepler(mu: float) -> CaseEquations:
    """Return the Kepler problem with GM = `mu`; invariants: energy, angular momentum."""

    def fun(t, y):
        x, z, u, v = y
        r2 = x * x + z * z
        r3 = r2 * np.sqrt(r2)
        return np.array([u, v, -mu * x / r3, -mu * z / r3])

    def values(t, y):
        x, z, u, v = y
        return np.array([(u * u + v * v) / 2 - mu / np.sqrt(x * x + z * z), x * v - z * u])

    def gradients(t, y):
        x, z, u, v = y
        r2 = x * x + z * z
        r3 = r2 * np.sqrt(r2)
        return np.array([[mu * x / r3, mu * z / r3, u, v], [v, -u, -z, x]])

    return CaseEquations(fun, values, gradients)


def perturbed_kepler(delta: float) -> CaseEquations:
    """Return motion in the potential -1 / r - delta / (2 r^3); invariants: energy, angular momentum."""

    def attraction(r2):
        r = np.sqrt(r2)
        return 1 / (r2 * r) + 3 * delta / (2 * r2 * r2 * r)

    def fun(t, y):
        x, z, u, v = y
        w = attraction(x * x + z * z)
        return np.array([u, v, -w * x, -w * z])

    def values(t, y):
        x, z, u, v = y
        r2 = x * x + z * z
        r = np.sqrt(r2)
        return np.array([(u * u + v * v) / 2 - 1 / r - delta / (2 * r2 * r), x * v - z * u])

    def gradients(t, y):
        x, z, u, v = y
        w = attraction(x * x + z * z)
        return np.array([[w * x, w * z, u, v], [v, -u, -z, x]])

    return CaseEquations(fun, values, gradients)


def arenstorf(mu: float) -> CaseEquations:
    """Return the restricted three-body problem with masses 1 - mu and mu in the rotating frame.

    The invariant is Jacobi's integral.
    """
    rest = 1 - mu

    def attractions(x, z):
        a2 = (x + mu) * (x + mu) + z * z
        b2 = (x - rest) * (x - rest) + z * z
        return rest / (a2 * np.sqrt(a2)), mu / (b2 * np.sqrt(b2))

    def fun(t, y):
        x, z, u, v = y
        a, b = attractions(x, z)
        return np.array([u, v, x + 2 * v - a * (x + mu) - b * (x - rest), z - 2 * u - (a + b) * z])

    def values(t, y):
        x, z, u, v = y
        a = np.sqrt((x + mu) * (x + mu) + z * z)
        b = np.sqrt((x - rest) * (x - rest) + z * z)
        return np.array([x * x + z * z + 2 * rest / a + 2 * mu / b - u * u - v * v])

    def gradients(t, y):
        x, z, u, v = y
        a, b = attractions(x, z)
        return np.array([[2 * (x - a * (x + mu) - b * (x - rest)), 2 * (z - (a + b) * z), -2 * u, -2 * v]])

    return CaseEquations(fun, values, gradients)


def henon_heiles() -> CaseEquations:
    """Return the system of Hénon and Heiles; invariant: energy."""

    def fun(t, y):
        x, z, u, v = y
        return np.array([u, v, -x - 2 * x * z, -z - x * x + z * z])

    def values(t, y):
        x, z, u, v = y
        return np.array([(u * u + v * v + x * x + z * z) / 2 + x * x * z - z * z * z / 3])

    def gradients(t, y):
        x, z, u, v = y
        return np.array([[x + 2 * x * z, z + x * x - z * z, u, v]])

    return CaseEquations(fun, values, gradients)


def boris_2d(charge: float) -> CaseEquations:
    """Return a charged particle in B = r e_z and the potential charge / r.

    Invariants: energy and canonical angular momentum.
    """

    def fun(t, y):
        x, z, u, v = y
        r2 = x * x + z * z
        r = np.sqrt(r2)
        e = charge / (r2 * r)
        return np.array([u, v, e * x + v * r, e * z - u * r])

    def values(t, y):
        x, z, u, v = y
        r2 = x * x + z * z
        r = np.sqrt(r2)
        return np.array([(u * u + v * v) / 2 + charge / r, x * v - z * u + r2 * r / 3])

    def gradients(t, y):
        x, z, u, v = y
        r2 = x * x + z * z
        r = np.sqrt(r2)
        e = charge / (r2 * r)
        return np.array([[-e * x, -e * z, u, v], [v + r * x, -u + r * z, -z, x]])

    return CaseEquations(fun, values, gradients)


# --- bodies, pendulums, particles ---


def n_body(masses: list[float], G: float, dimension: int) -> CaseEquations:
    """Return N bodies, y = (positions of all, velocities of all); invariants: energy, momentum, angular momentum."""
    m = np.array(masses)
    planes = [(0, 1)] if dimension == 2 else [(1, 2), (2, 0), (0, 1)]
    first, second = np.triu_indices(m.size, 1)

    def split(y):
        return y.reshape(2, m.size, dimension)

    def fun(t, y):
        q, v = split(y)
        d = q[:, None] - q[None, :]
        r2 = (d * d).sum(axis=-1)
        np.fill_diagonal(r2, 1.0)
        w = G / (r2 * np.sqrt(r2))
        a = -np.einsum("ij,j,ijk->ik", w, m, d)
        return np.concatenate([v.ravel(), a.ravel()])

    def values(t, y):
        q, v = split(y)
        d = q[first] - q[second]
        kinetic = (m[:, None] * v * v).sum() / 2
        potential = (G * m[first] * m[second] / np.sqrt((d * d).sum(axis=-1))).sum()
        turning = [(m * (q[:, a] * v[:, b] - q[:, b] * v[:, a])).sum() for a, b in planes]
        return np.array([kinetic - potential, *(m @ v), *turning])

    def gradients(t, y):
        q, v = split(y)
        force = -m[:, None] * split(fun(t, y))[1]
        rows = np.zeros((1 + dimension + len(planes), 2, m.size, dimension))
        rows[0] = force, m[:, None] * v
        for k in range(dimension):
            rows[1 + k, 1, :, k] = m
        for row, (a, b) in zip(rows[1 + dimension :], planes, strict=True):
            row[0, :, a], row[0, :, b] = m * v[:, b], -m * v[:, a]
            row[1, :, b], row[1, :, a] = m * q[:, a], -m * q[:, b]
        return rows.reshape(len(rows), -1)

    return CaseEquations(fun, values, gradients)


def pendulum() -> CaseEquations:
    """Return the mathematical pendulum, y = (angle, angular velocity); invariant: energy."""
    return CaseEquations(
        lambda t, y: np.array([y[1], -np.sin(y[0])]),
        lambda t, y: np.array([y[1] * y[1] / 2 - np.cos(y[0])]),
        lambda t, y: np.array([[np.sin(y[0]), y[1]]]),
    )


def duffing() -> CaseEquations:
    """Return the equation x'' = x - x^3, y = (x, x'); invariant: energy."""

    def values(t, y):
        q, p = y
        return np.array([p * p / 2 - q * q / 2 + q * q * q * q / 4])

    return CaseEquations(
        lambda t, y: np.array([y[1], y[0] - y[0] * y[0] * y[0]]),
        values,
        lambda t, y: np.array([[y[0] * y[0] * y[0] - y[0], y[1]]]),
    )


def oscillator() -> CaseEquations:
    """Return the harmonic oscillator; invariant: energy."""
    return CaseEquations(
        lambda t, y: np.array([y[1], -y[0]]),
        lambda t, y: np.array([(y[1] * y[1] + y[0] * y[0]) / 2]),
        lambda t, y: np.array([[y[0], y[1]]]),
    )


def double_pendulum(g: float) -> CaseEquations:
    """Return the double pendulum of equal masses and lengths, y = (angles, momenta); invariant: energy."""

    def fun(t, y):
        a, b, p, q = y
        s, c = np.sin(a - b), np.cos(a - b)
        D = 1 + s * s
        k = p * q * s / D
        w = (p * p + 2 * q * q - 2 * p * q * c) * s * c / (D * D)
        return np.array([(p - q * c) / D, (2 * q - p * c) / D, -2 * g * np.sin(a) - k + w, -g * np.sin(b) + k - w])

    def values(t, y):
        a, b, p, q = y
        s, c = np.sin(a - b), np.cos(a - b)
        kinetic = (p * p + 2 * q * q - 2 * p * q * c) / (2 * (1 + s * s))
        return np.array([kinetic - 2 * g * np.cos(a) - g * np.cos(b)])

    def gradients(t, y):
        f = fun(t, y)
        return np.array([[-f[2], -f[3], f[0], f[1]]])

    return CaseEquations(fun, values, gradients)


def spherical_pendulum(g: float) -> CaseEquations:
    """Return a pendulum in space, y = (q, v) in Cartesian coordinates.

    Invariants: the constraints ``(|q|^2 - 1) / 2`` and q @ v, energy, and angular momentum about the vertical.
    """

    def fun(t, y):
        q, v = y[:3], y[3:]
        tension = (v @ v - g * q[2]) / (q @ q)
        return np.concatenate([v, -tension * q - [0, 0, g]])

    def values(t, y):
        q, v = y[:3], y[3:]
        return np.array([(q @ q - 1) / 2, q @ v, v @ v / 2 + g * q[2], q[0] * v[1] - q[1] * v[0]])

    def gradients(t, y):
        a, b, c, u, v, w = y
        return np.array([[a, b, c, 0, 0, 0], [u, v, w, a, b, c], [0, 0, g, u, v, w], [v, -u, 0, -b, a, 0]])

    return CaseEquations(fun, values, gradients)


def fput(omega: float) -> CaseEquations:
    """Return the chain of Fermi, Pasta, Ulam and Tsingou with stiff springs of frequency `omega`; invariant: energy."""

    def soft(y):
        x, z = y[:3], y[3:6]
        return np.array([x[0] - z[0], x[1] - z[1] - x[0] - z[0], x[2] - z[2] - x[1] - z[1], x[2] + z[2]])

    def fun(t, y):
        a, b, c, d = soft(y) ** 3
        stiff = omega * omega * y[3:6]
        return np.concatenate([y[6:], [b - a, c - b, -c - d], np.array([a + b, b + c, c - d]) - stiff])

    def values(t, y):
        stiff = omega * omega * (y[3:6] @ y[3:6])
        return np.array([(y[6:] @ y[6:] + stiff) / 2 + (soft(y) ** 4).sum() / 4])

    def gradients(t, y):
        return np.array([np.concatenate([-fun(t, y)[6:], y[6:]])])

    return CaseEquations(fun, values, gradients)


def vortices(strengths: list[float]) -> CaseEquations:
    """Return point vortices, y = (x, y) vortex by vortex; invariants: energy, two momenta, angular impulse."""
    k = np.array(strengths)
    first, second = np.triu_indices(k.size, 1)

    def fun(t, y):
        z = y.reshape(-1, 2)
        d = z[:, None] - z[None, :]
        r2 = (d * d).sum(axis=-1)
        np.fill_diagonal(r2, 1.0)
        w = k / r2
        return np.stack([-(w * d[..., 1]).sum(axis=1), (w * d[..., 0]).sum(axis=1)], axis=1).ravel()

    def values(t, y):
        z = y.reshape(-1, 2)
        d = z[first] - z[second]
        energy = -(k[first] * k[second] * np.log((d * d).sum(axis=-1))).sum() / 2
        return np.array([energy, *(k @ z), (k[:, None] * z * z).sum()])

    def gradients(t, y):
        z, f = y.reshape(-1, 2), fun(t, y).reshape(-1, 2)
        rows = np.zeros((4, k.size, 2))
        rows[0, :, 0], rows[0, :, 1] = -k * f[:, 1], k * f[:, 0]
        rows[1, :, 0] = rows[2, :, 1] = k
        rows[3] = 2 * k[:, None] * z
        return rows.reshape(4, -1)

    return CaseEquations(fun, values, gradients)


def tokamak() -> CaseEquations:
    """Return a charged particle in an axisymmetric field, R0 = B0 = 1, q = 2; invariants: energy, toroidal momentum."""

    def fun(t, y):
        x, w, z, a, b, c = y
        R2 = x * x + w * w
        R = np.sqrt(R2)
        bx, bw, bz = -(2 * w + x * z) / (2 * R2), (2 * x - w * z) / (2 * R2), (R - 1) / (2 * R)
        return np.array([a, b, c, b * bz - c * bw, c * bx - a * bz, a * bw - b * bx])

    def values(t, y):
        x, w, z, a, b, c = y
        R = np.sqrt(x * x + w * w)
        return np.array([(a * a + b * b + c * c) / 2, x * b - w * a + ((R - 1) * (R - 1) + z * z) / 4])

    def gradients(t, y):
        x, w, z, a, b, c = y
        R = np.sqrt(x * x + w * w)
        k = (R - 1) / (2 * R)
        return np.array([[0, 0, 0, a, b, c], [b + k * x, -a + k * w, z / 2, -w, x, 0]])

    return CaseEquations(fun, values, gradients)


def schwarzschild() -> CaseEquations:
    """Return geodesics of Schwarzschild's metric, M = 1, y = (t, r, phi, E, p_r, L).

    Invariants: the mass shell, energy and angular momentum.
    """

    def fun(t, y):
        _, r, _, E, p, L = y
        a = 1 - 2 / r
        force = -E * E / (a * a * r * r) - p * p / (r * r) + L * L / (r * r * r)
        return np.array([E / a, a * p, L / (r * r), 0, force, 0])

    def values(t, y):
        _, r, _, E, p, L = y
        a = 1 - 2 / r
        return np.array([(-E * E / a + a * p * p + L * L / (r * r)) / 2, E, L])

    def gradients(t, y):
        _, r, _, E, p, L = y
        a = 1 - 2 / r
        radial = E * E / (a * a * r * r) + p * p / (r * r) - L * L / (r * r * r)
        return np.array([[0, radial, 0, -E / a, a * p, L / (r * r)], [0, 0, 0, 1, 0, 0], [0, 0, 0, 0, 0, 1]])

    return CaseEquations(fun, values, gradients)


# --- tops, spins, attitude ---


def rigid_body(i1: float, i2: float, i3: float) -> CaseEquations:
    """Return Euler's top with the moments of inertia i1, i2, i3, y = the angular momentum.

    Invariants: Casimir function, energy.
    """

    def fun(t, y):
        a, b, c = y
        return np.array([(1 / i3 - 1 / i2) * b * c, (1 / i1 - 1 / i3) * c * a, (1 / i2 - 1 / i1) * a * b])

    def values(t, y):
        a, b, c = y
        return np.array([(a * a + b * b + c * c) / 2, (a * a / i1 + b * b / i2 + c * c / i3) / 2])

    def gradients(t, y):
        a, b, c = y
        return np.array([[a, b, c], [a / i1, b / i2, c / i3]])

    return CaseEquations(fun, values, gradients)


def euler_detest(k2: float) -> CaseEquations:
    """Return problem B5 of DETEST, whose solutions are Jacobi's elliptic functions; two quadratic invariants.

    `k2` is the square of the modulus of the elliptic functions.
    """

    def fun(t, y):
        a, b, c = y
        return np.array([b * c, -a * c, -k2 * a * b])

    def values(t, y):
        a, b, c = y
        return np.array([a * a + b * b, k2 * a * a + c * c])

    def gradients(t, y):
        a, b, c = y
        return np.array([[2 * a, 2 * b, 0], [2 * k2 * a, 0, 2 * c]])

    return CaseEquations(fun, values, gradients)


def quaternion(w3: float) -> CaseEquations:
    """Return the attitude, a quaternion y, under the angular velocity (sin t, cos 2t, w3); invariant: ``y @ y``."""

    def fun(t, y):
        s, a, b, c = y
        u, v, w = np.sin(t), np.cos(2 * t), w3
        turned = [-(a * u + b * v + c * w), s * u + b * w - c * v, s * v + c * u - a * w, s * w + a * v - b * u]
        return np.array(turned) / 2

    return CaseEquations(fun, lambda t, y: np.array([y @ y]), lambda t, y: np.array([2 * y]))


def heisenberg(anisotropy: float) -> CaseEquations:
    """Return a ring of spins (Landau and Lifshitz); invariants: squared length of each, energy, total spin along z."""
    axis = np.array([0.0, 0.0, anisotropy])

    def fun(t, y):
        S = y.reshape(-1, 3)
        return np.cross(S, np.roll(S, 1, axis=0) + np.roll(S, -1, axis=0) + axis * S).ravel()

    def values(t, y):
        S = y.reshape(-1, 3)
        energy = -(S * np.roll(S, -1, axis=0)).sum() - anisotropy * (S[:, 2] @ S[:, 2]) / 2
        return np.concatenate([(S * S).sum(axis=1), [energy, S[:, 2].sum()]])

    def gradients(t, y):
        S = y.reshape(-1, 3)
        n = len(S)
        rows = np.zeros((n + 2, n, 3))
        rows[np.arange(n), np.arange(n)] = 2 * S
        rows[n] = -np.roll(S, 1, axis=0) - np.roll(S, -1, axis=0) - axis * S
        rows[n + 1, :, 2] = 1
        return rows.reshape(n + 2, -1)

    return CaseEquations(fun, values, gradients)


# --- populations, lattices, fields ---


def lotka_volterra() -> CaseEquations:
    """Return predator and prey, y = (u, v); invariant: ln u - u + 2 ln v - v."""
    return CaseEquations(
        lambda t, y: np.array([y[0] * (y[1] - 2), y[1] * (1 - y[0])]),
        lambda t, y: np.array([np.log(y[0]) - y[0] + 2 * np.log(y[1]) - y[1]]),
        lambda t, y: np.array([[1 / y[0] - 1, 2 / y[1] - 1]]),
    )


def sir(infection: float, recovery: float) -> CaseEquations:
    """Return the epidemic of Kermack and McKendrick, y = (S, I, R).

    Invariants: S + I + R and I + S - (recovery / infection) ln S.
    """
    ratio = recovery / infection

    def fun(t, y):
        s, i, _ = y
        return np.array([-infection * s * i, infection * s * i - recovery * i, recovery * i])

    def values(t, y):
        s, i, r = y
        return np.array([s + i + r, i + s - ratio * np.log(s)])

    return CaseEquations(fun, values, lambda t, y: np.array([[1, 1, 1], [1 - ratio / y[0], 1, 0]]))


def volterra_lattice() -> CaseEquations:
    """Return Kac and van Moerbeke's lattice; invariants: sum, a quadratic one, logarithm of the product."""

    def values(t, y):
        return np.array([y.sum(), (y * y / 2 + y * np.roll(y, -1)).sum(), np.log(y).sum()])

    return CaseEquations(
        lambda t, y: y * (np.roll(y, -1) - np.roll(y, 1)),
        values,
        lambda t, y: np.array([np.ones(y.size), y + np.roll(y, -1) + np.roll(y, 1), 1 / y]),
    )


def zabusky_kruskal(c1: float, c2: float) -> CaseEquations:
    """Return Korteweg and de Vries's equation in Zabusky and Kruskal's scheme; invariants: sum of u, sum of u^2.

    For u_t + u u_x + delta^2 u_xxx = 0 on points with the distance d, `c1` is 1 / (6 d), and `c2` is
    delta^2 / (2 d^3).
    """

    def fun(t, y):
        a, b = np.roll(y, -1), np.roll(y, 1)
        return -(a + y + b) * (a - b) * c1 - c2 * (np.roll(y, -2) - 2 * a + 2 * b - np.roll(y, 2))

    return CaseEquations(fun, lambda t, y: np.array([y.sum(), y @ y]), lambda t, y: np.array([np.ones(y.size), 2 * y]))


def sine_gordon(coupling: float) -> CaseEquations:
    """Return the periodic chain of Frenkel and Kontorova, y = (u, v); invariant: energy."""

    def fun(t, y):
        u, v = np.split(y, 2)
        return np.concatenate([v, coupling * (np.roll(u, -1) - 2 * u + np.roll(u, 1)) - np.sin(u)])

    def values(t, y):
        u, v = np.split(y, 2)
        d = np.roll(u, -1) - u
        return np.array([(v * v / 2 + coupling * d * d / 2 + 1 - np.cos(u)).sum()])

    def gradients(t, y):
        v, force = y[y.size // 2 :], fun(t, y)[y.size // 2 :]
        return np.array([np.concatenate([-force, v])])

    return CaseEquations(fun, values, gradients)


def three_wave() -> CaseEquations:
    """Return the resonant interaction of three complex waves; invariants: two Manley-Rowe relations, energy."""

    def fun(t, y):
        a, b, c = y
        return -1j * np.array([np.conj(b) * c, np.conj(a) * c, a * b])

    def values(t, y):
        a, b, c = y
        square = (y * np.conj(y)).real
        return np.array([square[0] + square[2], square[1] + square[2], 2 * (a * b * np.conj(c)).real])

    def gradients(t, y):
        a, b, c = y
        return 2 * np.array([[a, 0, c], [0, b, c], [np.conj(b) * c, np.conj(a) * c, a * b]])

    return CaseEquations(fun, values, gradients)


def ablowitz_ladik() -> CaseEquations:
    """Return Ablowitz and Ladik's periodic complex lattice.

    Invariants: mass, and the real and imaginary part of the correlation of neighbours.
    """

    def square(y):
        return (y * np.conj(y)).real

    def fun(t, y):
        return 1j * ((np.roll(y, -1) + np.roll(y, 1)) * (1 + square(y)) - 2 * y)

    def values(t, y):
        S = (y * np.conj(np.roll(y, -1))).sum()
        return np.array([np.log(1 + square(y)).sum(), S.real, S.imag])

    def gradients(t, y):
        right, left = np.roll(y, -1), np.roll(y, 1)
        return np.array([2 * y / (1 + square(y)), right + left, 1j * (right - left)])

    return CaseEquations(fun, values, gradients)


def brockett() -> CaseEquations:
    """Return the double-bracket flow L' = [L, [L, diag(1, 2, 3)]], y = (diagonal, off-diagonals) of L.

    Invariants: the traces of L, L^2 and L^3.
    """
    where = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2]])
    levels = np.diag([1.0, 2.0, 3.0])

    def fun(t, y):
        L = y[where]
        K = L @ levels - levels @ L
        change = L @ K - K @ L
        return np.array([change[0, 0], change[1, 1], change[2, 2], change[0, 1], change[1, 2], change[0, 2]])

    def values(t, y):
        L = y[where]
        return np.array([np.trace(L), np.trace(L @ L), np.trace(L @ L @ L)])

    def gradients(t, y):
        powers = np.eye(3), y[where], y[where] @ y[where]
        counted = np.array([1, 1, 1, 2, 2, 2])  # off-diagonal entries occur twice in L
        index = ([0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2])
        return np.array([(k + 1) * counted * power[index] for k, power in enumerate(powers)])

    return CaseEquations(fun, values, gradients)


EQUATIONS: dict[str, Callable[..., CaseEquations]] = {
    make.__name__: make
    for make in (
        *(kepler, perturbed_kepler, arenstorf, henon_heiles, boris_2d, n_body, pendulum, duffing, oscillator),
        *(double_pendulum, spherical_pendulum, fput, vortices, tokamak, schwarzschild, rigid_body, euler_detest),
        *(quaternion, heisenberg, lotka_volterra, sir, volterra_lattice, zabusky_kruskal, sine_gordon, three_wave),
        *(ablowitz_ladik, brockett),
    )
}
