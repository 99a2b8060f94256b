"""Problems of models of sympy.physics.mechanics."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from ..multibody.problem import MechanicsProblem, mechanics_problem
from ..multibody.start import Names
from .constrained import parts_of
from .models import name_of, read
from .system import parameter_values

__all__ = ["mechanics_of_model"]


def mechanics_of_model(
    model: Any,
    params: Mapping[Any, float] | None,
    q0: Any,
    u0: Any,
    *,
    t_span: tuple[float, float] | None,
    inputs: Mapping[Any, Any] | None,
    energy: Any,
    independent: Iterable[Any] | None,
    rank_tolerance: float,
    name: str,
    others: Mapping[str, Any],
) -> MechanicsProblem:
    """See `mechanics`."""
    # PyDy refuses constants that are in the constraints on positions alone: they are given here.
    constants = {**(getattr(model, "constants", None) or {}), **(params or {})}
    if q0 is None and u0 is None:
        q0 = u0 = getattr(model, "initial_conditions", None)
    if q0 is None or u0 is None:
        raise TypeError("mechanics: q0 or u0 is missing; give the coordinates and speeds at the start.")
    values = parameter_values({name_of(key): value for key, value in constants.items()})
    found = read(model, inputs or {}, values, energy)
    system = found.system
    names = Names(system.coordinates, system.speeds, found.position_names, found.velocity_names)
    held = found.independent if independent is None else [name_of(item) for item in independent]
    parts = parts_of(system, [(label, item, None) for label, item in found.energies])
    start = _by_name(q0, system.coordinates), _by_name(u0, system.speeds)
    numbers = np.array([values[key] for key in system.parameters]) if system.parameters else None
    t = 0.0 if t_span is None else float(t_span[0])
    return mechanics_problem(
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


def _by_name(given: Any, names: tuple[str, ...]) -> Any:
    """Return a mapping by names in place of one by symbols; initial conditions of both kinds may be in one."""
    if not isinstance(given, Mapping):
        return given
    found = {name_of(key): value for key, value in given.items()}
    return {key: value for key, value in found.items() if key in names} or found
