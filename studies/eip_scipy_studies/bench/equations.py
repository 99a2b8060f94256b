"""The equations of the problems, written once for all packages: plain Python, Numba, heyoka's expressions and JAX.

The equations of small systems are made by functions that take the square root to use (NumPy's, heyoka's ...) and return
the components as tuples. Systems of bodies have one form for each kind of function: sums over arrays for plain Python,
loops for Numba, and the form that each package has for its own equations.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np


class Functions(NamedTuple):
    """Functions of a problem: right-hand side ``fun(t, y)``, invariants ``values(t, y)``, their ``gradients(t, y)``.

    The acceleration ``acc(t, q)`` is given if the equations are q'' = acc.
    """

    fun: Callable[..., Any]
    values: Callable[..., Any]
    gradients: Callable[..., Any]
    acc: Callable[..., Any] | None = None


def kepler(sqrt: Any) -> Functions:
    """Return the functions of Kepler's problem in a plane; the invariants are energy and angular momentum."""

    def fun(t, y):  # type: ignore[no-untyped-def]
        r2 = y[0] * y[0] + y[1] * y[1]
        w = -1.0 / (r2 * sqrt(r2))
        return y[2], y[3], w * y[0], w * y[1]

    def acc(t, q):  # type: ignore[no-untyped-def]
        r2 = q[0] * q[0] + q[1] * q[1]
        w = -1.0 / (r2 * sqrt(r2))
        return w * q[0], w * q[1]

    def values(t, y):  # type: ignore[no-untyped-def]
        r = sqrt(y[0] * y[0] + y[1] * y[1])
        return 0.5 * (y[2] * y[2] + y[3] * y[3]) - 1.0 / r, y[0] * y[3] - y[1] * y[2]

    def gradients(t, y):  # type: ignore[no-untyped-def]
        r2 = y[0] * y[0] + y[1] * y[1]
        w = 1.0 / (r2 * sqrt(r2))
        return (w * y[0], w * y[1], y[2], y[3]), (y[3], -y[2], -y[1], y[0])

    return Functions(fun, values, gradients, acc)


def henon_heiles(sqrt: Any) -> Functions:
    """Return the functions of the system of Hénon and Heiles; the invariant is the energy."""

    def fun(t, y):  # type: ignore[no-untyped-def]
        return y[2], y[3], -y[0] - 2.0 * y[0] * y[1], -y[1] - y[0] * y[0] + y[1] * y[1]

    def acc(t, q):  # type: ignore[no-untyped-def]
        return -q[0] - 2.0 * q[0] * q[1], -q[1] - q[0] * q[0] + q[1] * q[1]

    def values(t, y):  # type: ignore[no-untyped-def]
        square = y[2] * y[2] + y[3] * y[3] + y[0] * y[0] + y[1] * y[1]
        return (0.5 * square + y[0] * y[0] * y[1] - y[1] * y[1] * y[1] / 3.0,)

    def gradients(t, y):  # type: ignore[no-untyped-def]
        return ((y[0] + 2.0 * y[0] * y[1], y[1] + y[0] * y[0] - y[1] * y[1], y[2], y[3]),)

    return Functions(fun, values, gradients, acc)


def rigid_body(sqrt: Any) -> Functions:
    """Return the functions of a free top with moments of inertia 2, 1, 2/3; y is its angular momentum L.

    The invariants are |L|^2 / 2 and the energy.
    """

    def fun(t, y):  # type: ignore[no-untyped-def]
        return 0.5 * y[1] * y[2], -y[2] * y[0], 0.5 * y[0] * y[1]

    def values(t, y):  # type: ignore[no-untyped-def]
        squares = y[0] * y[0], y[1] * y[1], y[2] * y[2]
        return 0.5 * (squares[0] + squares[1] + squares[2]), 0.25 * squares[0] + 0.5 * squares[1] + 0.75 * squares[2]

    def gradients(t, y):  # type: ignore[no-untyped-def]
        return (y[0], y[1], y[2]), (0.5 * y[0], y[1], 1.5 * y[2])

    return Functions(fun, values, gradients)


def particle(sqrt: Any) -> Functions:
    """Return the functions of a charge in a plane, in the field B = r e_z and the potential 0.01 / r.

    The invariants are the energy and the canonical angular momentum.
    """

    def fun(t, y):  # type: ignore[no-untyped-def]
        r2 = y[0] * y[0] + y[1] * y[1]
        r = sqrt(r2)
        e = 0.01 / (r2 * r)
        return y[2], y[3], e * y[0] + y[3] * r, e * y[1] - y[2] * r

    def values(t, y):  # type: ignore[no-untyped-def]
        r2 = y[0] * y[0] + y[1] * y[1]
        r = sqrt(r2)
        return 0.5 * (y[2] * y[2] + y[3] * y[3]) + 0.01 / r, y[0] * y[3] - y[1] * y[2] + r2 * r / 3.0

    def gradients(t, y):  # type: ignore[no-untyped-def]
        r2 = y[0] * y[0] + y[1] * y[1]
        r = sqrt(r2)
        e = 0.01 / (r2 * r)
        return (-e * y[0], -e * y[1], y[2], y[3]), (y[3] + r * y[0], -y[2] + r * y[1], -y[1], y[0])

    return Functions(fun, values, gradients)


EQUATIONS: Mapping[str, Callable[[Any], Functions]] = {
    "kepler": kepler, "henon_heiles": henon_heiles, "rigid_body": rigid_body, "particle": particle,
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Scene:
    """A problem as a worker receives it.

    `equations` is a key of `EQUATIONS`, "members" (of Kepler's problem), "bodies", "nls" or "case" (a hard case). `y0`
    and `end` (n,) are the state at t = 0, and the exact state at `t_end`; for "members" they are (members, n). `params`
    has "gm" (G times the masses) for "bodies", "name" for "case", and "length" of the ring for "nls".
    """

    title: str
    equations: str
    y0: np.ndarray
    end: np.ndarray
    t_end: float
    params: dict[str, Any]

    def plain(self) -> Functions:
        """Return the functions of the problem as plain Python functions that return arrays."""
        if self.equations == "bodies":
            return _bodies(self.params["gm"])
        if self.equations == "nls":
            return _nls(self.y0.size, self.params["length"])
        if self.equations == "case":
            (case,) = import_module("eip_scipy_studies.hard_cases").hard_cases([self.params["name"]])
            invariant = case.problem.invariants[0]
            return Functions(case.problem.fun, invariant.fun, invariant.grad)
        return Functions(*(_returning_array(function) for function in EQUATIONS[self.equations](math.sqrt)))

    def compiled(self) -> Functions:
        """Return the functions of the problem jitted by Numba, for "members" those of one orbit.

        ``fun(t, y, out)`` and ``acc(t, q, out)`` fill `out`. The invariants and gradients return arrays; for "bodies"
        these two are not jitted.
        """
        njit = import_module("numba").njit
        name = "kepler" if self.equations == "members" else self.equations
        if self.equations == "bodies":
            return _jitted_bodies(np.array(self.params["gm"]), njit)
        if name not in EQUATIONS:
            raise NotImplementedError("the bench has no Numba functions for hard cases and fields, only plain ones")
        fun, values, gradients, acc = EQUATIONS[name](math.sqrt)
        return Functions(
            _filling(njit(fun), njit),
            _jitted_array(njit(values), njit),
            _jitted_array(njit(gradients), njit),
            None if acc is None else _filling(njit(acc), njit),
        )

    def error(self, y: np.ndarray) -> float:
        """Return the largest component of the error of the final state `y`, relative to that of the exact state."""
        return float(np.max(np.abs(np.asarray(y) - self.end)) / np.max(np.abs(self.end)))

    def drift(self, y: np.ndarray) -> float | None:
        """Return the largest relative change of an invariant up to the final state `y`; None for "members".

        Changes of small invariants are relative to 0.001 of the largest invariant.
        """
        if self.equations == "members":
            return None
        values = self.plain().values
        first, last = np.atleast_1d(values(0.0, self.y0)), np.atleast_1d(values(self.t_end, np.asarray(y)))
        return float(np.max(np.abs(last - first) / np.maximum(np.abs(first), 1e-3 * np.max(np.abs(first)))))


def scene_from(record: Mapping[str, Any]) -> Scene:
    """Return the problem that an entry of a worker's request describes."""
    y0, end = (np.array(record[name]) for name in ("y0", "end"))
    if record["complex"]:
        y0, end = y0.view(complex), end.view(complex)
    return Scene(record["title"], record["equations"], y0, end, record["t_end"], record["params"])


def _returning_array(function: Callable[..., Any] | None) -> Any:
    if function is None:
        return None
    return lambda t, y: np.array(function(t, y))


def _filling(function: Any, njit: Any) -> Any:
    @njit
    def fill(t, y, out):  # type: ignore[no-untyped-def]
        parts = function(t, y)
        for k in range(out.size):
            out[k] = parts[k]

    return fill


def _jitted_array(function: Any, njit: Any) -> Any:
    return njit(lambda t, y: np.array(function(t, y)))


def _bodies(gm: list[float]) -> Functions:
    """Return the functions of N bodies with G times the masses `gm`, computed by sums over arrays.

    The invariants are energy, momentum and angular momentum.
    """
    case = import_module("eip_scipy_studies.hard_cases").n_body(gm, 1.0, 3)
    m, n = np.array(gm), len(gm)

    def acc(t: float, q: np.ndarray) -> np.ndarray:
        at = q.reshape(n, 3)
        d = at[:, None] - at[None, :]
        r2 = (d * d).sum(axis=-1)
        np.fill_diagonal(r2, 1.0)
        return -np.einsum("ij,j,ijk->ik", 1.0 / (r2 * np.sqrt(r2)), m, d).ravel()

    return Functions(case.fun, case.values, case.gradients, acc)


def _jitted_bodies(gm: np.ndarray, njit: Any) -> Functions:
    """Return the functions of N bodies with G times the masses `gm`; `fun` and `acc` are jitted loops over pairs.

    The invariants and their gradients are the plain Python functions of `_bodies`.
    """

    @njit
    def acc(t, q, out):  # type: ignore[no-untyped-def]
        out[:] = 0.0
        for i in range(gm.size):
            for j in range(i):
                dx, dy, dz = q[3 * i] - q[3 * j], q[3 * i + 1] - q[3 * j + 1], q[3 * i + 2] - q[3 * j + 2]
                r2 = dx * dx + dy * dy + dz * dz
                w = 1.0 / (r2 * math.sqrt(r2))
                a, b = w * gm[j], w * gm[i]
                out[3 * i] -= a * dx
                out[3 * i + 1] -= a * dy
                out[3 * i + 2] -= a * dz
                out[3 * j] += b * dx
                out[3 * j + 1] += b * dy
                out[3 * j + 2] += b * dz

    @njit
    def fun(t, y, out):  # type: ignore[no-untyped-def]
        half = y.size // 2
        out[:half] = y[half:]
        acc(t, y[:half], out[half:])

    plain = _bodies(gm.tolist())
    return Functions(fun, plain.values, plain.gradients, acc)


def _nls(points: int, length: float) -> Functions:
    """Return the functions of i dpsi/dt = -(d/dx)^2 psi / 2 - |psi|^2 psi on a ring of this length, by FFT.

    The invariants are mass and energy.
    """
    k2 = (2 * np.pi * np.fft.fftfreq(points, length / points)) ** 2
    dx = length / points

    def half_laplacian(psi: np.ndarray) -> np.ndarray:
        return np.fft.ifft(-0.5 * k2 * np.fft.fft(psi))

    def fun(t: float, psi: np.ndarray) -> np.ndarray:
        return 1j * (half_laplacian(psi) + (psi.real**2 + psi.imag**2) * psi)

    def values(t: float, psi: np.ndarray) -> np.ndarray:
        density = psi.real**2 + psi.imag**2
        energy = -np.vdot(psi, half_laplacian(psi)).real - 0.5 * (density @ density)
        return dx * np.array([density.sum(), energy])

    def gradients(t: float, psi: np.ndarray) -> np.ndarray:
        density = psi.real**2 + psi.imag**2
        return 2 * dx * np.array([psi, -half_laplacian(psi) - density * psi])

    return Functions(fun, values, gradients)
