"""Bodies with units and names: conversion of arguments of `nbody`, and the bodies of a problem or run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ...core.inputs import has_unit, refuse_units, shown
from ...core.problem import Problem
from ...core.units import Unit, in_unit, is_time
from ...core.units import units as known_units
from ...engine.native import library
from .forces import DRAG, KIND, MOON_BODY, OBLATENESS, RELATIVITY

__all__ = ["Bodies", "bodies_of", "body_names", "default_units", "in_units"]

# CODATA 2018, as in astropy, where it makes of its solar mass the IAU's G M, 1.3271244e20 m^3/s^2.
G_SI = 6.67430e-11


class Bodies(NamedTuple):
    """The bodies of a problem: G times their masses (N,), and their names; "0", "1" and so on without names."""

    problem: Problem
    gm: np.ndarray
    names: tuple[str, ...]

    @property
    def forces(self) -> tuple[str, ...]:
        """Forces in addition to Newton's gravitation."""
        further = np.asarray(self.problem.params, dtype=float)[self.gm.size :]
        if not further.size:
            return ()
        kind = (RELATIVITY[int(further[KIND]) - 1],) if further[KIND] else ()
        return (
            *kind,
            *(("j2",) if further[OBLATENESS] else ()),
            *(("moon-quadrupole",) if further[MOON_BODY] >= 0 else ()),
            *(("drag",) if further[DRAG] else ()),
        )


def bodies_of(run: Any) -> Bodies:
    """Return the bodies of a problem that was made by `nbody`, or of a run of it; TypeError for anything else."""
    origin = None if isinstance(run, Problem) else getattr(run, "__dict__", {}).get("_origin")
    problem = run if origin is None else origin.request.fun
    if not (isinstance(problem, Problem) and problem.rhs in (library["gravity.rhs"], library["forces.rhs"])):
        raise TypeError(
            f"expected a problem of bodies, such as nbody(...) or solar_system(), or a result of integrate for such a "
            f"problem; got {shown(type(run).__name__)}. A result that was loaded or comes from solve_ivp does not "
            "contain the masses: give them, or pass the problem."
        )
    given = None if origin is None else origin.request.params
    params = np.asarray(problem.params if given is None else given, dtype=float)
    names = problem.component_names or ()
    n = len(names) // 6
    return Bodies(problem, params[:n].copy(), tuple(name[2:] for name in names[: 3 * n : 3]))


def body_names(names: Sequence[str], n: int) -> tuple[str, ...]:
    """Return the names of n bodies; raise an error if they are not n different strings."""
    if isinstance(names, str) or not all(isinstance(name, str) for name in names):
        raise TypeError(f"bodies must be a sequence of names, got {shown(names)}.")
    if len(names) != n or len(set(names)) < n:
        raise ValueError(f"bodies: expected {n} names, all different, got {shown(names)}.")
    return tuple(names)


def default_units(gm: Any, position: Any, velocity: Any, t_span: Any) -> str:
    """Return the units of length and time as text such as "au, d", or "" if an argument has no unit.

    The unit of time is that of t_span (days for dates), or that of the velocities if t_span has no unit.
    """
    given = {name: _first(value) for name, value in (("gm", gm), ("position", position), ("velocity", velocity))}
    if not all(hasattr(value, "unit") and hasattr(value, "to_value") for value in given.values()):
        return ""
    start = _first(t_span)
    time = "d" if is_time(start) else None
    if time is None:
        unit = getattr(start, "unit", None)
        if unit is None:
            speed = given["velocity"].unit
            found = [base for base, power in zip(speed.bases, speed.powers, strict=True) if power == -1]
            unit = next((base for base in found if base.physical_type == "time"), speed.si.bases[-1])
        time = _named(unit, "s", 1)
    return f"{_named(given['position'].unit, 'm', 0)}, {time}"


def in_units(gm: Any, position: Any, velocity: Any, known: tuple[Unit, Unit] | None) -> tuple[Any, Any, Any]:
    """Return G m, positions and velocities as plain numbers in the problem's units; masses become G m.

    `known` are the problem's units of length and time, or None. Arguments without units are returned unchanged. A
    TypeError is raised if only some of them have units, or the units of the problem are not known, and TypeError or
    ValueError if a dimension is wrong.
    """
    given = {"gm": gm, "position": position, "velocity": velocity}
    with_unit = [name for name, value in given.items() if has_unit(_first(value))]
    if known is None or not with_unit:
        refuse_units(**given)
        return gm, position, velocity
    for name in given:
        if name not in with_unit:
            raise TypeError(
                f"{name} has no unit, but {' and '.join(with_unit)} has: give units to all of gm, position and "
                "velocity, or to none."
            )
    return (
        _gravitational(gm, known),
        in_unit("position", position, (1, 0), known),
        in_unit("velocity", velocity, (1, -1), known),
    )


def _gravitational(gm: Any, known: tuple[Unit, Unit]) -> Any:
    """Return G m as plain numbers in the units `known` of length and time, from values of G m or masses with units."""
    if isinstance(gm, tuple | list) or type(gm) is np.ndarray:
        return np.array([_gravitational(value, known) for value in gm])
    if getattr(getattr(gm, "unit", None), "physical_type", None) != "mass":  # a plain 0 among others is a test particle
        return in_unit("gm", gm, (3, -2), known)
    length, time = known
    return gm.to_value("kg") * (G_SI * time.si**2 / length.si**3)


def _first(value: Any) -> Any:
    """Return the first item of nested lists; a value that is not a list is returned unchanged."""
    while isinstance(value, tuple | list) and len(value):
        value = value[0]
    return value


def _named(unit: Any, base: str, place: int) -> str:
    """Return a unit of astropy as text for `units`: its name, or a number of `base`, or `base` if it is no such unit.

    `place` is 0 for a length and 1 for a time.
    """
    if not unit.is_equivalent(base):  # what is converted to it will say so
        return base
    pair = f"{unit}, s" if place == 0 else f"m, {unit}"
    return str(unit) if known_units(pair) is not None else f"{float(unit.to(base))!r} {base}"
