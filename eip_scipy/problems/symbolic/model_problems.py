"""Problems that are made from models of sympy.physics.mechanics."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import sympy

from ..multibody.motion import plain
from ..multibody.outputs import required_outputs
from ..multibody.problem import MechanicsProblem, mechanics_problem
from ..multibody.start import MET, Names
from .constrained import parts_of
from .models import Start, name_of, read
from .system import parameter_values

__all__ = ["mechanics_of_model"]

QUATERNION = 4  # components


def mechanics_of_model(
    model: Any,
    params: Mapping[Any, float] | None,
    q0: Any,
    u0: Any,
    *,
    t_span: tuple[float, float] | None,
    inputs: Mapping[Any, Any] | None,
    energy: Any,
    outputs: Any,
    independent: Iterable[Any] | None,
    rank_tolerance: float,
    name: str,
    others: Mapping[str, Any],
) -> MechanicsProblem:
    """Return the problem of a model; see `mechanics`."""
    # PyDy refuses constants that are in the constraints on positions alone: they are given here.
    constants = {**(getattr(model, "constants", None) or {}), **(params or {})}
    if q0 is None and u0 is None:
        q0 = u0 = getattr(model, "initial_conditions", None)
    if q0 is None or u0 is None:
        raise TypeError("mechanics: q0 or u0 is missing; give the coordinates and speeds at the start.")
    values = parameter_values({name_of(key): value for key, value in constants.items()})
    if inputs is None:
        given = getattr(model, "specifieds", None) or {}
        inputs = {key: _swapped(value) if callable(value) else value for key, value in given.items()}
    t = 0.0 if t_span is None else float(t_span[0])
    outputs = required_outputs("mechanics", outputs, ())
    found = read(model, inputs, values, energy, outputs, Start(t, q0, u0))
    system = found.system
    names = Names(system.coordinates, system.speeds, found.position_names, found.velocity_names)
    held = found.independent if independent is None else [name_of(item) for item in independent]
    parts = parts_of(system, [(label, item, None) for label, item in found.energies], found.momenta, found.outputs)
    start = _by_name(q0, system.coordinates), _by_name(u0, system.speeds)
    numbers = np.array([values[key] for key in system.parameters]) if system.parameters else None
    problem = mechanics_problem(
        name,
        parts,
        names,
        t,
        start,
        numbers,
        held,
        rank_tolerance,
        t_span=t_span,
        notes=found.notes,
        parameter_names=system.parameters,
        **others,
    )
    _require_rotations(problem)
    return problem


def _require_rotations(problem: MechanicsProblem) -> None:
    """Raise ValueError if a quaternion that SymPy uses for a rotation does not have the norm 1."""
    args = () if problem.params is None else (problem.params,)
    for item in problem.norms:
        slopes, value = np.empty(problem.y0.size), plain(item.function)(0.0, problem.y0, *args)
        plain(item.gradient)(0.0, np.ones(problem.y0.size), slopes, *args)
        if np.count_nonzero(slopes) == QUATERNION and not abs(value - 1) <= MET:
            raise ValueError(
                f"mechanics: the start has {item.name} = {value:.6g}; expected 1, because the quaternion of a rotation "
                "has norm 1. Divide its components by their norm."
            )


def _swapped(function: Any) -> Any:
    """Convert a function ``f(y, t)`` of PyDy into ``f(t, y)``; return an expression unchanged."""
    return function if isinstance(function, sympy.Basic) else lambda t, y: function(y, t)


def _by_name(given: Any, names: tuple[str, ...]) -> Any:
    """Return a mapping with names as keys, those in `names` or, if there are none, all; return an array unchanged."""
    if not isinstance(given, Mapping):
        return given
    found = {name_of(key): value for key, value in given.items()}
    return {key: value for key, value in found.items() if key in names} or found
