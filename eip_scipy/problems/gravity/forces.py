"""Forces in addition to Newton's gravitation: relativity, oblateness, a Moon without orbit, drag.

All terms are chosen by numbers in the vector of parameters, so that one right-hand side serves every combination:
first G m of each body, then the entries that `parameters` lists. The first body is the Sun; each force on another body
has its reaction on the Sun, so that momentum and centre of mass are those of Newton. The full post-Newtonian equations
("eih") have another momentum and another centre of mass. They are in engine/cpp/problems/einstein.hpp, and the other
forces in forces.cpp there.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any

import numpy as np

from ...core.invariants import Invariant
from ...core.names import nearest
from ...core.problem import native_invariant
from ...engine.native import library

__all__ = ["FORCES", "ForceConstants", "acceleration", "check_forces", "equations", "invariants", "parameters"]

FORCES = {
    "1pn": "first post-Newtonian terms of the Sun's field, harmonic coordinates",
    "eih": "first post-Newtonian terms of all bodies (Einstein, Infeld & Hoffmann)",
    "gr-potential": "a potential in 1/r^2 that advances perihelia as relativity does (Nobili & Roxburgh)",
    "j2": "the Sun's oblateness J2",
    "moon-quadrupole": "the Moon smeared out along a circle around the Earth",
    "drag": "drag in the first body's atmosphere, whose density falls exponentially",
}
"""Names of the forces, with a description of each."""

RELATIVITY = ("1pn", "eih", "gr-potential")
VELOCITY_DEPENDENT = ("1pn", "eih", "drag")
# Entries after the G m: which relativity (0: none, else 1 + its place in RELATIVITY), 1/c^2, J2 R^2, the pole (3), the
# body with the Moon, its coefficient; of drag the coefficient, where it holds, the scale height and the air's rotation.
KIND, OVER_C2, OBLATENESS, POLE, MOON_BODY, MOON, DRAG, N_ENTRIES = 0, 1, 2, 3, 6, 7, 8, 12
# Round-off of an energy in which large terms nearly cancel: what "kept" means for invariants that are not exact.
KEPT = 1e-13


@dataclass(frozen=True)
class ForceConstants:
    """Constants that the forces of `nbody` need, in the units of the state.

    Only the constants of the forces in use must be given.

    Attributes
    ----------
    c : float, optional
        Speed of light, for "1pn", "eih" and "gr-potential".
    j2 : float, optional
        J2 times the square of the Sun's equatorial radius, for "j2".
    pole : sequence of 3 floats, optional
        Vector of any length along the Sun's axis of rotation, for "j2", and for "drag" with `spin`.
    moon_body : int, optional
        Index of the body that stands for Earth and Moon, for "moon-quadrupole".
    moon : float, optional
        ``a^2 m_E m_M / (4 (m_E + m_M)^2)`` with the radius a of the Moon's orbit, for "moon-quadrupole".
    drag : float, optional
        Acceleration divided by the squared speed relative to the air, at the distance `drag_radius`: half the density
        of the air times c_D A / m of the bodies, for "drag".
    drag_radius, scale_height : float, optional
        Distance from the first body at which `drag` holds, and the distance over which the density falls by a factor
        of e, for "drag".
    spin : float, optional
        Angular velocity of the atmosphere about the pole, 0 by default, for "drag".
    """

    c: float | None = None
    j2: float | None = None
    pole: Sequence[float] | None = None
    moon_body: int | None = None
    moon: float | None = None
    drag: float | None = None
    drag_radius: float | None = None
    scale_height: float | None = None
    spin: float = 0.0


NEEDS = {
    "1pn": ("c",),
    "eih": ("c",),
    "gr-potential": ("c",),
    "j2": ("j2", "pole"),
    "moon-quadrupole": ("moon_body", "moon"),
    "drag": ("drag", "drag_radius", "scale_height"),
}


def check_forces(forces: Any) -> tuple[str, ...]:
    """Return the names of forces, one name or several, in the order of `FORCES`; raise an error if they do not fit."""
    if not isinstance(forces, Iterable):
        raise TypeError(
            f"forces must be a name or a sequence of names, got {forces!r}; use () for Newton's gravitation alone."
        )
    names = (forces,) if isinstance(forces, str) else tuple(forces)
    for name in names:
        if name not in FORCES:
            hint = nearest(str(name).lower(), FORCES, cutoff=0.4)
            raise ValueError(f"unknown force {name!r}; known: {', '.join(map(repr, FORCES))}{hint}")
    found = tuple(name for name in FORCES if name in names)
    if len(kinds := [name for name in found if name in RELATIVITY]) > 1:
        raise ValueError(f"the forces {' and '.join(map(repr, kinds))} all describe relativity; give only one of them")
    return found


def parameters(gm: np.ndarray, forces: tuple[str, ...], constants: ForceConstants | None) -> np.ndarray:
    """Return the vector of parameters: G m of all bodies, then the parameters of the forces.

    A ValueError is raised if a constant is missing or wrong, or the first body has no mass.
    """
    known = ForceConstants() if constants is None else constants
    for force in forces:
        for name in NEEDS[force]:
            _check_constant(force, name, getattr(known, name), gm.size)
    if "drag" in forces and known.spin != 0:
        _check_constant("drag", "pole", known.pole, gm.size)
        if not isfinite(known.spin):
            raise ValueError(f"ForceConstants: spin must be a finite number; got {known.spin!r}.")
    if not gm[0] > 0:
        raise ValueError(
            f"forces: the first body must be the one that exerts the forces, with G m > 0; its G m is {gm[0]!r}."
        )
    entries = np.zeros(N_ENTRIES)
    entries[MOON_BODY] = -1.0
    for place, name in enumerate(RELATIVITY, 1):
        if name in forces:
            entries[KIND], entries[OVER_C2] = place, 1.0 / np.float64(known.c) ** 2
    if "j2" in forces:
        entries[OBLATENESS] = known.j2
    if "drag" in forces:
        entries[DRAG:] = known.drag, known.drag_radius, known.scale_height, known.spin
    if known.pole is not None and {"j2", "drag"} & set(forces):
        pole = np.asarray(known.pole, dtype=float)
        entries[POLE : POLE + 3] = pole / np.linalg.norm(pole)
    if "moon-quadrupole" in forces:
        entries[MOON_BODY], entries[MOON] = known.moon_body, known.moon
    return np.concatenate([gm, entries])


def _check_constant(force: str, name: str, value: Any, n: int) -> None:
    if value is None:
        raise ValueError(f"the force {force!r} needs constants=ForceConstants({name}=...), in the units of the state.")
    if name == "pole":
        pole = np.asarray(value, dtype=float)
        if pole.shape != (3,) or not np.isfinite(pole).all() or not pole.any():
            raise ValueError(f"ForceConstants: pole must be three finite numbers, not all 0; got {value!r}.")
    elif name == "moon_body":
        if not (isinstance(value, int | np.integer) and 0 < value < n):
            raise ValueError(f"ForceConstants: moon_body must be an index from 1 to {n - 1}; got {value!r}.")
    elif not (isfinite(value) and value > 0):
        raise ValueError(f"ForceConstants: {name} must be a finite positive number; got {value!r}.")


def equations(forces: tuple[str, ...]) -> tuple[Any, Any]:
    """Return the right-hand side, and the accelerations if they depend on positions only (else None)."""
    if not forces:
        return library["gravity.rhs"], library["gravity.acc"]
    return library["forces.rhs"], None if set(forces) & set(VELOCITY_DEPENDENT) else library["forces.acc"]


def acceleration(y: np.ndarray, params: np.ndarray) -> np.ndarray:
    """Return the accelerations (N, 3) of all bodies in the state `y`, by gravitation and the forces in `params`."""
    out = np.empty_like(y)
    library["forces.rhs"](0.0, y, out, params)
    return out[y.size // 2 :].reshape(-1, 3)


def invariants(forces: tuple[str, ...], params: np.ndarray, y0: np.ndarray) -> tuple[Invariant, ...]:
    """Return the invariants of the equations with these forces, see `nbody`."""
    if not forces:
        return native_invariant("gravity.energy", "H", params), native_invariant("gravity.momentum", "L", params)
    if "drag" in forces:
        return ()
    if "1pn" in forces:
        if y0.size > 12 or len(forces) > 1:
            return ()
        return native_invariant("pair.energy", "H", params), native_invariant("pair.momentum", "L", params)
    if "eih" in forces and not _small_second_order(params, y0):
        return ()
    kind = "eih" if "eih" in forces else "forces"
    energy = native_invariant(f"{kind}.energy", "H", params)
    if "j2" in forces:
        return energy, native_invariant(f"{kind}.axial_momentum", "L_pole", params)
    return energy, native_invariant(f"{kind}.momentum", "L", params)


def _small_second_order(params: np.ndarray, y0: np.ndarray) -> bool:
    """Return True if the terms in 1/c^4 that the invariants of "eih" lack are below round-off.

    They are about v^2/c^2 times the accelerations that "eih" adds to Newton's.
    """
    n = y0.size // 6
    newton = np.empty_like(y0)
    library["gravity.rhs"](0.0, y0, newton, params[:n])
    a = newton[3 * n :].reshape(-1, 3)
    size = np.linalg.norm(a, axis=1)
    added = np.linalg.norm(acceleration(y0, params) - a, axis=1)[size > 0] / size[size > 0]
    v2 = np.sum(y0[3 * n :].reshape(-1, 3) ** 2, axis=1)
    return bool(v2.max() * params[n + OVER_C2] * added.max(initial=0.0) < KEPT)
