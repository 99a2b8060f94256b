"""What the bodies feel besides Newton's gravitation: relativity, the Sun's oblateness, a Moon without orbit.

All terms are chosen by numbers in the vector of parameters, so that one right-hand side serves every combination and
is compiled once: first G m of each body, then the entries that `parameters` lists. The first body is the Sun; each
force on another body has its reaction on the Sun, so that momentum and centre of mass are those of Newton. (The full
post-Newtonian equations, which have their own, are in `_einstein`.)

Newton's part is that of `_newton`, inlined here: after an edit there, clear Numba's cache (CONTRIBUTING).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import exp, expm1, isfinite, sqrt
from typing import Any

import numpy as np

from ...core.inputs import refuse_units
from ...core.invariants import Invariant
from ...core.names import nearest
from ...engine.caching import cached_njit
from . import _einstein, _newton
from ._einstein import add_cross, add_outer

__all__ = ["FORCES", "ForceConstants", "acceleration", "check_forces", "equations", "invariants", "parameters"]

FORCES = {
    "1pn": "first post-Newtonian terms of the Sun's field, harmonic coordinates",
    "eih": "first post-Newtonian terms of all bodies (Einstein, Infeld & Hoffmann)",
    "gr-potential": "a potential in 1/r^2 that advances perihelia as relativity does (Nobili & Roxburgh)",
    "j2": "the Sun's oblateness J2",
    "moon-quadrupole": "the Moon smeared out along a circle around the Earth",
}
"""Names of the forces with a line on each."""

RELATIVITY = ("1pn", "eih", "gr-potential")
VELOCITY_DEPENDENT = ("1pn", "eih")
# Entries after the G m: which relativity (0: none, else 1 + its place in RELATIVITY), 1/c^2, J2 R^2, the pole (3), the
# body with the Moon, its coefficient.
KIND, OVER_C2, OBLATENESS, POLE, MOON_BODY, MOON, N_ENTRIES = 0, 1, 2, 3, 6, 7, 8
ONE_PN, EIH, POTENTIAL = 1.0, 2.0, 3.0
# Round-off of an energy in which large terms nearly cancel: what "kept" means for invariants that are not exact.
KEPT = 1e-13


@dataclass(frozen=True)
class ForceConstants:
    """Constants of nature that forces need, in the units of the state; only those of the forces in use.

    Attributes
    ----------
    c : float, optional
        Speed of light: "1pn", "eih", "gr-potential".
    j2 : float, optional
        J2 times the square of the Sun's equatorial radius: "j2".
    pole : sequence of 3 floats, optional
        The Sun's axis of rotation, of any length: "j2".
    moon_body : int, optional
        Index of the body that stands for Earth and Moon: "moon-quadrupole".
    moon : float, optional
        ``a^2 m_E m_M / (4 (m_E + m_M)^2)``, a the radius of the Moon's orbit: "moon-quadrupole".
    """

    c: float | None = None
    j2: float | None = None
    pole: Sequence[float] | None = None
    moon_body: int | None = None
    moon: float | None = None

    def __post_init__(self) -> None:
        refuse_units(c=self.c, j2=self.j2, pole=self.pole, moon=self.moon)


NEEDS = {
    "1pn": ("c",),
    "eih": ("c",),
    "gr-potential": ("c",),
    "j2": ("j2", "pole"),
    "moon-quadrupole": ("moon_body", "moon"),
}


def check_forces(forces: Any) -> tuple[str, ...]:
    """The names of forces, one name or several, in the order of `FORCES`.

    Raises
    ------
    ValueError
        For an unknown name, or two kinds of relativity at once.
    TypeError
        For what is no name and no sequence.
    """
    if not isinstance(forces, Iterable):
        raise TypeError(f"forces must be a name or a sequence of names, got {forces!r}; () is Newton alone.")
    names = (forces,) if isinstance(forces, str) else tuple(forces)
    for name in names:
        if name not in FORCES:
            hint = nearest(str(name).lower(), FORCES, cutoff=0.4)
            raise ValueError(f"unknown force {name!r}; known: {', '.join(map(repr, FORCES))}{hint}")
    found = tuple(name for name in FORCES if name in names)
    if len(kinds := [name for name in found if name in RELATIVITY]) > 1:
        raise ValueError(f"the forces {' and '.join(map(repr, kinds))} are the same relativity twice; give one of them")
    return found


def parameters(gm: np.ndarray, forces: tuple[str, ...], constants: ForceConstants | None) -> np.ndarray:
    """The vector of parameters: every G m, then the forces' own.

    Raises
    ------
    ValueError
        When a constant that a force needs is missing or senseless, or the first body has no mass.
    """
    known = ForceConstants() if constants is None else constants
    for force in forces:
        for name in NEEDS[force]:
            _check_constant(force, name, getattr(known, name), gm.size)
    if not gm[0] > 0:
        raise ValueError(f"forces: the first body must be the Sun, with G m > 0; its G m is {gm[0]!r}.")
    entries = np.zeros(N_ENTRIES)
    entries[MOON_BODY] = -1.0
    for place, name in enumerate(RELATIVITY, 1):
        if name in forces:
            entries[KIND], entries[OVER_C2] = place, 1.0 / np.float64(known.c) ** 2
    if "j2" in forces:
        pole = np.asarray(known.pole, dtype=float)
        entries[OBLATENESS], entries[POLE : POLE + 3] = known.j2, pole / np.linalg.norm(pole)
    if "moon-quadrupole" in forces:
        entries[MOON_BODY], entries[MOON] = known.moon_body, known.moon
    return np.concatenate([gm, entries])


def _check_constant(force: str, name: str, value: Any, n: int) -> None:
    if value is None:
        raise ValueError(f"the force {force!r} needs constants=ForceConstants({name}=...), in the units of the state.")
    if name == "pole":
        pole = np.asarray(value, dtype=float)
        if pole.shape != (3,) or not np.isfinite(pole).all() or not pole.any():
            raise ValueError(f"ForceConstants: pole must be three numbers, not all 0; got {value!r}.")
    elif name == "moon_body":
        if not (isinstance(value, int | np.integer) and 0 < value < n):
            raise ValueError(f"ForceConstants: moon_body must be an index from 1 to {n - 1}; got {value!r}.")
    elif not (isfinite(value) and value > 0):
        raise ValueError(f"ForceConstants: {name} must be a positive number; got {value!r}.")


def equations(forces: tuple[str, ...]) -> tuple[Any, Any]:
    """The right-hand side, and the accelerations where they depend on positions only (else None)."""
    return rhs, None if set(forces) & set(VELOCITY_DEPENDENT) else acc


def acceleration(y: np.ndarray, params: np.ndarray) -> np.ndarray:
    """The accelerations (N, 3) of a state."""
    out = np.empty_like(y)
    rhs(0.0, y, out, params)
    return out[y.size // 2 :].reshape(-1, 3)


def invariants(forces: tuple[str, ...], params: np.ndarray, y0: np.ndarray) -> tuple[Invariant, ...]:
    """The invariants that the equations have with these forces, see `nbody`."""
    args = (params,)
    if "1pn" in forces:
        if y0.size > 12 or len(forces) > 1:
            return ()
        return (
            Invariant(pair_energy, pair_energy_gradient, args=args, in_place=True, name="H"),
            Invariant(pair_momentum, pair_momentum_gradient, args=args, in_place=True, name="L"),
        )
    if "eih" in forces:
        if not _small_second_order(params, y0):
            return ()
        first = Invariant(eih_energy, eih_energy_gradient, args=args, in_place=True, name="H")
        whole = (_einstein.momentum, _einstein.momentum_gradient)
        axial = (eih_axial_momentum, eih_axial_momentum_gradient)
    else:
        first = Invariant(energy, _newton.energy_gradient, args=args, in_place=True, uses_f=True, name="H")
        whole, axial = (momentum, momentum_gradient), (axial_momentum, axial_momentum_gradient)
    if "j2" in forces:
        return first, Invariant(*axial, args=args, in_place=True, name="L_pole")
    return first, Invariant(*whole, args=args, in_place=True, name="L")


def _small_second_order(params: np.ndarray, y0: np.ndarray) -> bool:
    """Whether v^2/c^2 times the relative size of what is added to Newton is lost in round-off."""
    n = y0.size // 6
    newton = np.empty_like(y0)
    _newton.rhs(0.0, y0, newton, params[:n])
    a = newton[3 * n :].reshape(-1, 3)
    size = np.linalg.norm(a, axis=1)
    added = np.linalg.norm(acceleration(y0, params) - a, axis=1)[size > 0] / size[size > 0]
    v2 = np.sum(y0[3 * n :].reshape(-1, 3) ** 2, axis=1)
    return bool(v2.max() * params[n + OVER_C2] * added.max(initial=0.0) < KEPT)


_jit = cached_njit(error_model="numpy", _nrt=False)
_jit_allocating = cached_njit(error_model="numpy")


@_jit
def _pull(x, y, z, k, gm_sun, i):
    """Acceleration of body i at (x, y, z) from the Sun by the terms that depend on positions; k: the entries."""
    r2 = x * x + y * y + z * z
    w = 0.0
    if k[KIND] == POTENTIAL:
        w += 6.0 * gm_sun * gm_sun * k[OVER_C2] / (r2 * r2)
    if k[MOON_BODY] == i:
        w += 3.0 * gm_sun * k[MOON] / (r2 * r2 * sqrt(r2))
    along = 0.0
    if k[OBLATENESS] > 0.0:
        s = x * k[POLE] + y * k[POLE + 1] + z * k[POLE + 2]
        u = 1.5 * gm_sun * k[OBLATENESS] / (r2 * r2 * sqrt(r2))
        w += u * (1.0 - 5.0 * s * s / r2)
        along = 2.0 * u * s
    return -w * x - along * k[POLE], -w * y - along * k[POLE + 1], -w * z - along * k[POLE + 2]


@_jit
def _pull_1pn(x, y, z, vx, vy, vz, k, gm_sun):
    """The Sun's first post-Newtonian pull on a body at (x, y, z) with the velocity (vx, vy, vz), both relative."""
    r2 = x * x + y * y + z * z
    r = sqrt(r2)
    w = gm_sun * k[OVER_C2] / (r2 * r)
    along_r = w * (4.0 * gm_sun / r - (vx * vx + vy * vy + vz * vz))
    along_v = 4.0 * w * (x * vx + y * vy + z * vz)
    return along_r * x + along_v * vx, along_r * y + along_v * vy, along_r * z + along_v * vz


@_jit
def _add_pulls(q, v, params, out):
    """Add to out (3 N,) the Sun's further pulls on all others, and their reactions on it."""
    n = q.size // 3
    k, gm_sun = params[n:], params[0]
    bx = by = bz = 0.0
    for i in range(1, n):
        a = 3 * i
        x, y, z = q[a] - q[0], q[a + 1] - q[1], q[a + 2] - q[2]
        ax, ay, az = _pull(x, y, z, k, gm_sun, i)
        if k[KIND] == ONE_PN:
            px, py, pz = _pull_1pn(x, y, z, v[a] - v[0], v[a + 1] - v[1], v[a + 2] - v[2], k, gm_sun)
            ax, ay, az = ax + px, ay + py, az + pz
        out[a] += ax
        out[a + 1] += ay
        out[a + 2] += az
        share = params[i] / gm_sun
        bx += share * ax
        by += share * ay
        bz += share * az
    out[0] -= bx
    out[1] -= by
    out[2] -= bz


@_jit_allocating
def rhs(t, y, out, params):
    """The derivative (v, a) of the state (q, v) with all forces that params names."""
    half = y.size // 2
    n = half // 3
    q, v, a = y[:half], y[half:], out[half:]
    for i in range(half):
        out[i] = v[i]
    _newton._accelerations(q, params[:n], a)
    if params[n + KIND] == EIH:
        _einstein.add_accelerations(q, v, params, a)
    _add_pulls(q, v, params, a)


@_jit_allocating
def acc(t, q, params):
    """The accelerations at the positions q, for forces that do not depend on velocities."""
    out = np.empty(q.size)
    _newton._accelerations(q, params[: q.size // 3], out)
    _add_pulls(q, q, params, out)
    return out


@_jit
def _potential(y, params):
    """G times the potential energy of `_pull`."""
    n = y.size // 6
    k, gm_sun = params[n:], params[0]
    total = 0.0
    for i in range(1, n):
        dx, dy, dz = y[3 * i] - y[0], y[3 * i + 1] - y[1], y[3 * i + 2] - y[2]
        r2 = dx * dx + dy * dy + dz * dz
        over_r3 = 1.0 / (r2 * sqrt(r2))
        part = 0.0
        if k[KIND] == POTENTIAL:
            part -= 3.0 * gm_sun * k[OVER_C2] / r2
        if k[MOON_BODY] == i:
            part -= k[MOON] * over_r3
        if k[OBLATENESS] > 0.0:
            s = dx * k[POLE] + dy * k[POLE + 1] + dz * k[POLE + 2]
            part += 0.5 * k[OBLATENESS] * over_r3 * (3.0 * s * s / r2 - 1.0)
        total += params[i] * part
    return gm_sun * total


@_jit
def energy(t, y, params):
    """G times the energy, for forces that do not depend on velocities; its gradient is Newton's, from f."""
    return _newton.energy(t, y, params[: y.size // 6]) + _potential(y, params)


@_jit_allocating
def momentum(t, y, params):
    """G times the angular momentum."""
    return _newton.momentum(t, y, params[: y.size // 6])


@_jit
def momentum_gradient(t, y, out, params):
    """out (3, 6 N)."""
    _newton.momentum_gradient(t, y, out, params[: y.size // 6])


@_jit
def axial_momentum(t, y, params):
    """G times the angular momentum along the Sun's pole."""
    n = y.size // 6
    lx, ly, lz = _newton.momentum(t, y, params[:n])
    return lx * params[n + POLE] + ly * params[n + POLE + 1] + lz * params[n + POLE + 2]


@_jit
def axial_momentum_gradient(t, y, out, params):
    """out (6 N,): G m v x pole and G m pole x q."""
    half = y.size // 2
    n = half // 3
    px, py, pz = params[n + POLE], params[n + POLE + 1], params[n + POLE + 2]
    for i in range(n):
        a, b, gm = 3 * i, half + 3 * i, params[i]
        out[a] = gm * (y[b + 1] * pz - y[b + 2] * py)
        out[a + 1] = gm * (y[b + 2] * px - y[b] * pz)
        out[a + 2] = gm * (y[b] * py - y[b + 1] * px)
        out[b] = gm * (py * y[a + 2] - pz * y[a + 1])
        out[b + 1] = gm * (pz * y[a] - px * y[a + 2])
        out[b + 2] = gm * (px * y[a + 1] - py * y[a])


@_jit
def eih_energy(t, y, params):
    """G times the post-Newtonian energy of all bodies, with the potentials of the Sun's further pulls."""
    return _einstein.energy(t, y, params) + _potential(y, params)


@_jit_allocating
def eih_energy_gradient(t, y, out, params):
    """out (6 N,)."""
    _einstein.energy_gradient(t, y, out, params)
    n = y.size // 6
    pulls = np.zeros(3 * n)
    _add_pulls(y[: 3 * n], y[3 * n :], params, pulls)
    for i in range(3 * n):
        out[i] -= params[i // 3] * pulls[i]


@_jit_allocating
def eih_axial_momentum(t, y, params):
    """G times the post-Newtonian angular momentum along the Sun's pole."""
    k = params[y.size // 6 :]
    lx, ly, lz = _einstein.momentum(t, y, params)
    return lx * k[POLE] + ly * k[POLE + 1] + lz * k[POLE + 2]


@_jit_allocating
def eih_axial_momentum_gradient(t, y, out, params):
    """out (6 N,)."""
    k, rows = params[y.size // 6 :], np.empty((3, y.size))
    _einstein.momentum_gradient(t, y, rows, params)
    for i in range(y.size):
        out[i] = k[POLE] * rows[0, i] + k[POLE + 1] * rows[1, i] + k[POLE + 2] * rows[2, i]


@_jit
def _relative(y, over_c2, mu):
    """Position, velocity and 1/r of the second of two bodies from the first, and mu / (c^2 r)."""
    x, z = (y[3] - y[0], y[4] - y[1], y[5] - y[2]), (y[9] - y[6], y[10] - y[7], y[11] - y[8])
    u = 1.0 / sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2])
    return x, z, u, over_c2 * mu * u


@_jit
def pair_energy(t, y, params):
    """Energy of two bodies' relative motion with "1pn", per reduced mass; no order is left out.

    With w = v^2 and u = 1/r the equations give dw/du + 6 mu/c^2 w = 2 mu - 8 mu M u/c^2, linear; this is the constant
    of its solution. For a test particle it is, to first order in 1/c^2, the known energy
    v^2/2 - M/r + c^-2 (3/8 v^4 + 3/2 M v^2/r + M^2/(2 r^2)), but for 3/(2 c^2) (v^2/2 - M/r)^2, which is constant too.
    """
    gm_sun, mu, over_c2 = params[0], params[0] + params[1], params[2 + OVER_C2]
    _, v, u, x = _relative(y, over_c2, mu)
    w = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    return (0.5 * w + 2.0 / 3.0 * gm_sun * u) * exp(6.0 * x) - (mu + 2.0 / 3.0 * gm_sun) / (6.0 * mu * over_c2) * expm1(
        6.0 * x
    )


@_jit
def pair_energy_gradient(t, y, out, params):
    """out (12,)."""
    gm_sun, mu, over_c2 = params[0], params[0] + params[1], params[2 + OVER_C2]
    r, v, u, x = _relative(y, over_c2, mu)
    w = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    growth = exp(6.0 * x)
    by_u = growth * (3.0 * over_c2 * mu * (w + 4.0 / 3.0 * gm_sun * u) - mu)
    for i in range(3):
        out[3 + i] = -by_u * u * u * u * r[i]
        out[9 + i] = growth * v[i]
        out[i] = -out[3 + i]
        out[6 + i] = -out[9 + i]


@_jit_allocating
def pair_momentum(t, y, params):
    """Angular momentum of two bodies' relative motion with "1pn", per reduced mass: r x v exp(4 mu / (c^2 r))."""
    r, v, _, x = _relative(y, params[2 + OVER_C2], params[0] + params[1])
    growth = exp(4.0 * x)
    return (
        growth * (r[1] * v[2] - r[2] * v[1]),
        growth * (r[2] * v[0] - r[0] * v[2]),
        growth * (r[0] * v[1] - r[1] * v[0]),
    )


@_jit_allocating
def pair_momentum_gradient(t, y, out, params):
    """out (3, 12)."""
    r, v, u, x = _relative(y, params[2 + OVER_C2], params[0] + params[1])
    growth, (lx, ly, lz) = exp(4.0 * x), pair_momentum(t, y, params)
    out[:] = 0.0
    for sign, q, p in ((-1.0, 0, 6), (1.0, 3, 9)):
        add_cross(out, q, -sign * growth, v)
        add_cross(out, p, sign * growth, r)
        add_outer(out, q, -4.0 * sign * x * u * u, (lx, ly, lz), r)
