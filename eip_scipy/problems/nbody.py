"""Newtonian point masses."""

from __future__ import annotations

from collections.abc import Callable
from math import sqrt
from typing import Any

import numpy as np
from numba import njit

from ..invariants import Invariant
from ._problem import Problem, bind

__all__ = ["nbody"]


@njit(cache=True)
def _accelerations(q, gm, out):
    """Sum over pairs of gm_j (q_j - q_i) / r^3, added into out (3 N,)."""
    n = gm.size
    for i in range(n):
        x, y, z = q[3 * i], q[3 * i + 1], q[3 * i + 2]
        ax = ay = az = 0.0
        for j in range(i + 1, n):
            dx, dy, dz = q[3 * j] - x, q[3 * j + 1] - y, q[3 * j + 2] - z
            r2 = dx * dx + dy * dy + dz * dz
            w = 1.0 / (r2 * sqrt(r2))
            wi, wj = w * gm[j], w * gm[i]
            ax += wi * dx
            ay += wi * dy
            az += wi * dz
            out[3 * j] -= wj * dx
            out[3 * j + 1] -= wj * dy
            out[3 * j + 2] -= wj * dz
        out[3 * i] += ax
        out[3 * i + 1] += ay
        out[3 * i + 2] += az


@njit(cache=True)
def _rhs(t, y, out, params):
    half = y.size // 2
    for i in range(half):
        out[i] = y[half + i]
        out[half + i] = 0.0
    _accelerations(y[:half], params, out[half:])


@njit(cache=True)
def _acc(t, q, params):
    out = np.zeros(q.size)
    _accelerations(q, params, out)
    return out


@njit(cache=True)
def _energy(t, y, params):
    n, half = params.size, y.size // 2
    kinetic = potential = 0.0
    for i in range(n):
        vx, vy, vz = y[half + 3 * i], y[half + 3 * i + 1], y[half + 3 * i + 2]
        kinetic += params[i] * (vx * vx + vy * vy + vz * vz)
        partial = 0.0
        for j in range(i + 1, n):
            dx, dy, dz = y[3 * j] - y[3 * i], y[3 * j + 1] - y[3 * i + 1], y[3 * j + 2] - y[3 * i + 2]
            partial += params[j] / sqrt(dx * dx + dy * dy + dz * dz)
        potential += params[i] * partial
    return 0.5 * kinetic - potential


@njit(cache=True)
def _energy_gradient(t, y, f, out, params):
    half = y.size // 2
    for i in range(half):
        gm = params[i // 3]
        out[i] = -gm * f[half + i]
        out[half + i] = gm * y[half + i]


@njit(cache=True)
def _momentum(t, y, params):
    half = y.size // 2
    out = np.zeros(3)
    for i in range(params.size):
        qx, qy, qz = y[3 * i], y[3 * i + 1], y[3 * i + 2]
        vx, vy, vz = y[half + 3 * i], y[half + 3 * i + 1], y[half + 3 * i + 2]
        gm = params[i]
        out[0] += gm * (qy * vz - qz * vy)
        out[1] += gm * (qz * vx - qx * vz)
        out[2] += gm * (qx * vy - qy * vx)
    return out


@njit(cache=True)
def _momentum_gradient(t, y, out, params):
    half = y.size // 2
    for i in range(params.size):
        gm, a = params[i], 3 * i
        b = half + a
        # d(q x v): row c holds the component c of L, +-gm times the other two components.
        out[0, a], out[0, a + 1], out[0, a + 2] = 0.0, gm * y[b + 2], -gm * y[b + 1]
        out[1, a], out[1, a + 1], out[1, a + 2] = -gm * y[b + 2], 0.0, gm * y[b]
        out[2, a], out[2, a + 1], out[2, a + 2] = gm * y[b + 1], -gm * y[b], 0.0
        out[0, b], out[0, b + 1], out[0, b + 2] = 0.0, -gm * y[a + 2], gm * y[a + 1]
        out[1, b], out[1, b + 1], out[1, b + 2] = gm * y[a + 2], 0.0, -gm * y[a]
        out[2, b], out[2, b + 1], out[2, b + 2] = -gm * y[a + 1], gm * y[a], 0.0


def nbody(
    gm: Any,
    position: Any,
    velocity: Any,
    *,
    t_span: tuple[float, float],
    h: float | None = None,
    name: str = "nbody",
    units: str = "",
    source: str = "",
    reference: Callable[[float], np.ndarray | None] | None = None,
) -> Problem:
    """N point masses under Newton's gravitation.

    Parameters
    ----------
    gm : array_like, shape (N,)
        G times the masses, > 0, in the units of length and time of the state.
    position, velocity : array_like, shape (N, 3)
    t_span : (float, float)
    h : float, optional
    name, units, source : str, optional
    reference : callable, optional

    Returns
    -------
    Problem
        State (q_1, ..., q_N, v_1, ..., v_N), each with 3 components. Invariants: "H", the energy times G, and "L", the
        angular momentum times G. Momentum and centre of mass are in the `frame`; `blocks` are the bodies'
        positions and velocities.

    Raises
    ------
    ValueError
        When shapes disagree or a mass is not positive.
    """
    params = np.array(gm, dtype=float)
    q, v = np.array(position, dtype=float), np.array(velocity, dtype=float)
    n = params.size
    if params.ndim != 1 or q.shape != (n, 3) or v.shape != (n, 3):
        raise ValueError(
            f"nbody: gm {params.shape}, position {q.shape}, velocity {v.shape}; expected (N,), (N, 3), (N, 3)."
        )
    if not np.all(params > 0):
        raise ValueError("nbody: every G m must be positive (a test particle's motion enters no invariant).")
    return Problem(
        name=name,
        fun=bind(_rhs, params),
        rhs=_rhs,
        acc=_acc,
        y0=np.concatenate([q.ravel(), v.ravel()]),
        t_span=(float(t_span[0]), float(t_span[1])),
        h=h,
        params=params,
        invariants=(
            Invariant(_energy, _energy_gradient, args=(params,), in_place=True, uses_f=True, name="H"),
            Invariant(_momentum, _momentum_gradient, args=(params,), in_place=True, name="L"),
        ),
        blocks=3,
        frame=recoil(params),
        units=units,
        source=source,
        reference=reference,
    )


def recoil(gm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The frame (C, S): centre of mass and momentum, kept by shifts of the bodies in proportion to their masses.

    So the recoil of a planet's correction goes to its star. A common shift would move the outer planets as far.
    """
    axes = np.eye(3)
    share = gm / gm.sum()
    C = np.kron(np.eye(2), np.kron(share, axes))
    S = np.kron(np.eye(2), np.kron(share[:, None], axes))
    return C, S
