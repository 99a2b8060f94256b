"""Forces in addition to Newton's gravitation: relativity, oblateness, a Moon without orbit, drag, radiation.

All terms are chosen by numbers in the vector of parameters, so that one right-hand side serves every combination: first
G m of each body, then `N_ENTRIES` entries of the forces, then beta of each body. The first body is the Sun; each force
on another body except "radiation" has its reaction on the Sun, so that momentum and centre of mass are Newton's. The
full post-Newtonian equations ("eih") have another momentum and another centre of mass. They are in
engine/cpp/problems/einstein.hpp, and the other forces in forces.cpp there. A new force is one row of `FORCES` here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any, NamedTuple

import numpy as np

from ...core.inputs import real_array
from ...core.invariants import Invariant
from ...core.names import nearest
from ...core.problem import native_invariant
from ...engine.native import library

__all__ = ["FORCES", "ForceConstants", "check_forces", "equations", "invariants", "parameters"]

# Entries after the G m: which relativity (0: none), 1/c^2, J2 R^2, the pole (3), the body with the Moon (-1: none), its
# coefficient; of drag the coefficient, where it holds, the scale height and the air's rotation; J4 R^4.
KIND, OVER_C2, OBLATENESS, POLE, MOON_BODY, MOON, DRAG, OBLATENESS_4, N_ENTRIES = 0, 1, 2, 3, 6, 7, 8, 12, 13
# Round-off of an energy in which large terms nearly cancel: what "kept" means for invariants that are not exact.
KEPT = 1e-13


@dataclass(frozen=True)
class ForceConstants:
    """Constants that the forces of `nbody` need, in the units of the state.

    Only the constants of the forces in use must be given.

    Attributes
    ----------
    c : float, optional
        Speed of light, for "1pn", "eih", "gr-potential" and "radiation", there ``numpy.inf`` for the pressure alone.
    j2 : float, optional
        J2 times the square of the Sun's equatorial radius, for "j2".
    j4 : float, optional
        J4 times the fourth power of this radius, for "j4".
    pole : sequence of 3 floats, optional
        Vector of any length along the Sun's axis of rotation, for "j2", "j4", and for "drag" with `spin`.
    moon_body, moon : int and float, optional
        Index of the body that stands for Earth and Moon, and ``a^2 m_E m_M / (4 (m_E + m_M)^2)`` with the radius a of
        the Moon's orbit, for "moon-quadrupole".
    drag, drag_radius, scale_height, spin : float, optional
        Acceleration divided by the squared speed relative to the air, which is half the density of the air times
        c_D A / m of the bodies, at the distance `drag_radius` from the first body; the distance over which the density
        falls by a factor of e; and the angular velocity of the air about the pole, for "drag".
    beta : sequence of N floats, optional
        Radiation pressure over the Sun's gravitation, of each body, 0 for the Sun; for "radiation".

    See Also
    --------
    nbody

    Examples
    --------
    >>> from eip_scipy.problems import ForceConstants, nbody
    >>> orbit = [1.0, 0.0], [[0, 0, 0], [1, 0, 0]], [[0, 0, 0], [0, 1, 0]]
    >>> nbody(*orbit, t_span=(0, 9), forces="1pn", constants=ForceConstants(c=1e4)).invariants
    (Invariant(H), Invariant(L))
    """

    c: float | None = None
    j2: float | None = None
    j4: float | None = None
    pole: Sequence[float] | None = None
    moon_body: int | None = None
    moon: float | None = None
    drag: float | None = None
    drag_radius: float | None = None
    scale_height: float | None = None
    spin: float = 0.0
    beta: Sequence[float] | None = None


class Force(NamedTuple):
    """Constants that a force needs, a function that returns its entries by place, and the invariants that it keeps."""

    needs: tuple[str, ...]
    entries: Callable[[Any], dict[int, Any]]
    keeps: tuple[str, ...] = ("H", "L")
    sees_velocity: bool = False
    is_relativity: bool = False


def _relativity(kind: int) -> Callable[[Any], dict[int, Any]]:
    return lambda k: {KIND: kind} | _over_c2(k)


def _over_c2(k: ForceConstants) -> dict[int, Any]:
    return {OVER_C2: 1.0 / np.float64(k.c) ** 2}


def _drag(k: ForceConstants) -> dict[int, Any]:
    air = {DRAG: k.drag, DRAG + 1: k.drag_radius, DRAG + 2: k.scale_height, DRAG + 3: k.spin}
    return air | (_pole(k) if k.spin else {})


def _pole(k: ForceConstants) -> dict[int, Any]:
    pole = np.asarray(k.pole, dtype=float)
    return dict(enumerate(pole / np.linalg.norm(pole), POLE))


FORCES = {
    "1pn": Force(("c",), _relativity(1), sees_velocity=True, is_relativity=True),
    "eih": Force(("c",), _relativity(2), sees_velocity=True, is_relativity=True),
    "gr-potential": Force(("c",), _relativity(3), is_relativity=True),
    "j2": Force(("j2", "pole"), lambda k: {OBLATENESS: k.j2} | _pole(k), keeps=("H", "L_pole")),
    "j4": Force(("j4", "pole"), lambda k: {OBLATENESS_4: k.j4} | _pole(k), keeps=("H", "L_pole")),
    "moon-quadrupole": Force(("moon_body", "moon"), lambda k: {MOON_BODY: k.moon_body, MOON: k.moon}),
    "drag": Force(("drag", "drag_radius", "scale_height"), _drag, keeps=(), sees_velocity=True),
    "radiation": Force(("c", "beta"), _over_c2, sees_velocity=True),
}
"""The forces by name; `nbody` describes each of them."""


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
    if len(kinds := [name for name in FORCES if name in names and FORCES[name].is_relativity]) > 1:
        raise ValueError(f"the forces {' and '.join(map(repr, kinds))} all describe relativity; give only one of them")
    return tuple(name for name in FORCES if name in names)


def parameters(gm: np.ndarray, forces: tuple[str, ...], constants: ForceConstants | None) -> np.ndarray:
    """Return the vector of parameters: G m of all bodies, then the entries of the forces and beta, if there are any.

    A ValueError is raised if a constant is missing or wrong, or the first body has no mass.
    """
    if not forces:
        return gm
    known, entries = ForceConstants() if constants is None else constants, np.zeros(N_ENTRIES)
    entries[MOON_BODY] = -1.0
    for name in forces:
        needs, places, *_ = FORCES[name]
        for key in (*needs, "spin", "pole") if name == "drag" and known.spin != 0 else needs:
            _check_constant(name, key, getattr(known, key), gm.size)
        for place, value in places(known).items():
            entries[place] = value
    if not gm[0] > 0:
        raise ValueError(
            f"forces: the first body must be the one that exerts the forces, with G m > 0; its G m is {gm[0]!r}."
        )
    return np.concatenate([gm, entries, known.beta if "radiation" in forces else np.zeros(gm.size)])


def has_radiating_masses(params: np.ndarray, n: int) -> bool:
    """Return True if radiation acts on one of n bodies that has a mass, so that Newton's invariants do not hold."""
    return params.size > n and bool((params[:n] * params[n + N_ENTRIES :]).any())


def _check_constant(force: str, name: str, value: Any, n: int) -> None:
    if value is None:
        raise ValueError(f"the force {force!r} needs constants=ForceConstants({name}=...), in the units of the state.")
    if name == "pole":
        pole, expected = np.asarray(value, dtype=float), "three finite numbers, not all 0"
        fits = pole.shape == (3,) and np.isfinite(pole).all() and pole.any()
    elif name == "moon_body":
        fits, expected = isinstance(value, int | np.integer) and 0 < value < n, f"an index from 1 to {n - 1}"
    elif name == "beta":
        betas, expected = real_array("beta", value), f"{n} numbers that are not negative, the first one, the Sun's, 0"
        fits = betas.shape == (n,) and np.isfinite(betas).all() and (betas >= 0).all() and betas[0] == 0
    elif force == "radiation":
        fits, expected = value > 0, "a positive number, or numpy.inf for the pressure alone"
    elif name in ("spin", "j4"):
        fits, expected = isfinite(value), "a finite number"
    else:
        fits, expected = isfinite(value) and value > 0, "a finite positive number"
    if not fits:
        raise ValueError(f"ForceConstants: {name} must be {expected}; got {value!r}.")


def equations(forces: tuple[str, ...]) -> tuple[Any, Any]:
    """Return the right-hand side, and the accelerations if they depend on positions only (else None)."""
    group = "forces" if forces else "gravity"
    sees_velocity = any(FORCES[name].sees_velocity for name in forces)
    return library[f"{group}.rhs"], None if sees_velocity else library[f"{group}.acc"]


def invariants(forces: tuple[str, ...], params: np.ndarray, y0: np.ndarray) -> tuple[Invariant, ...]:
    """Return the invariants of the equations with these forces, see `nbody`."""
    rows, group = [FORCES[name] for name in forces], "forces" if forces else "gravity"
    if "1pn" in forces:
        group = "pair" if y0.size <= 12 and len(forces) == 1 else ""
    elif "eih" in forces:
        group = "eih" if _small_second_order(params, y0) else ""
    if not (group and all(row.keeps for row in rows)) or has_radiating_masses(params, y0.size // 6):
        return ()
    axial = any("L_pole" in row.keeps for row in rows)
    momentum = ("axial_momentum", "L_pole") if axial else ("momentum", "L")
    return tuple(native_invariant(f"{group}.{key}", name, params) for key, name in (("energy", "H"), momentum))


def _small_second_order(params: np.ndarray, y0: np.ndarray) -> bool:
    """Return True if the terms in 1/c^4 that the invariants of "eih" lack are below round-off.

    They are about v^2/c^2 times the accelerations that "eih" adds to Newton's.
    """
    n = y0.size // 6
    newton, found = np.empty_like(y0), np.empty_like(y0)
    library["gravity.rhs"](0.0, y0, newton, params[:n])
    library["forces.rhs"](0.0, y0, found, params)
    v, a, added = (part[3 * n :].reshape(-1, 3) for part in (y0, newton, found - newton))
    size = np.linalg.norm(a, axis=1)
    added = np.linalg.norm(added, axis=1)[size > 0] / size[size > 0]
    return bool(np.sum(v**2, axis=1).max() * params[n + OVER_C2] * added.max(initial=0.0) < KEPT)
