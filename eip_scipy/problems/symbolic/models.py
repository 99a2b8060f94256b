"""The equations of models of sympy.physics.mechanics, in the package's symbols."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import sympy
from sympy.core.function import AppliedUndef
from sympy.physics.mechanics import KanesMethod, Point, dynamicsymbols, msubs

from ...core.names import nearest
from ..multibody.motion import plain
from .constrained import Constrained, filling
from .parser import symbol

__all__ = ["Model", "name_of", "read"]

TIME = dynamicsymbols._t
# A row of constraints depends on the others if its remainder is below this share at each of this number of points.
DEPENDENT, POINTS = 1e-9, 3


class Model(NamedTuple):
    """The equations of a model, and its known properties.

    Attributes
    ----------
    system : Constrained
    energies : tuple of (str, expression)
        Descriptions of quantities that may be the energy, and their expressions.
    independent : tuple of str or None
        The components of the state that the model calls independent; None if it calls none dependent.
    position_names, velocity_names : tuple of str
    notes : tuple of str
    """

    system: Constrained
    energies: tuple[tuple[str, Any], ...]
    independent: tuple[str, ...] | None
    position_names: tuple[str, ...]
    velocity_names: tuple[str, ...]
    notes: tuple[str, ...]


class _Equations(NamedTuple):
    """A model's equations in its own symbols."""

    coordinates: list[Any]
    speeds: list[Any]
    rates: list[Any]
    mass: Any
    forces: Any
    positions: list[Any]
    velocities: list[Any]
    energies: list[tuple[str, Any]]
    independent: list[Any] | None
    by_speeds: dict[Any, Any]  # derivatives of coordinates


def name_of(item: Any) -> str:
    """Return the name of a dynamicsymbol, its derivative (that of a speed), a symbol, or a string."""
    if isinstance(item, sympy.Derivative):
        return f"v_{name_of(item.expr)}"
    text = item if isinstance(item, str) else item.func.__name__ if isinstance(item, AppliedUndef) else str(item)
    return re.sub(r"\W", "_", text.replace("'", "_prime"))


def read(model: Any, inputs: Mapping[Any, Any], parameters: Mapping[str, float], energy: Any) -> Model:
    """Return the equations of a model.

    Parameters
    ----------
    model
        A KanesMethod, LagrangesMethod, or an object with the attribute ``eom_method``, which is one of these.
    inputs : mapping
        Expressions of functions of time that are neither coordinates nor speeds.
    parameters : mapping
        Values of the parameters by their names.
    energy : expression or None
        The total energy, if it is given.
    """
    method = _method(model)
    found = _of_lagrange(method) if hasattr(method, "_L") else _of_kane(method)
    names = {item: name_of(item) for item in (*found.coordinates, *found.speeds)}
    _require_distinct(names)
    given = {_as_function(key, found): value for key, value in inputs.items()}
    symbols = {item: symbol(name) for item, name in names.items()} | {TIME: symbol("t")}

    def converted(expression: Any) -> Any:
        expression = msubs(sympy.sympify(expression), found.by_speeds)
        if given and expression.has(*given):
            expression = msubs(expression.subs(given).doit(), found.by_speeds)
        expression = expression.xreplace({k: v for k, v in symbols.items() if isinstance(k, sympy.Derivative)})
        expression = expression.xreplace({k: v for k, v in symbols.items() if not isinstance(k, sympy.Derivative)})
        left = sorted(expression.atoms(AppliedUndef, sympy.Derivative), key=str)
        if left:
            raise ValueError(
                f"mechanics: {left[0]} is neither a coordinate nor a speed; give it as an expression of t and the "
                f"state: inputs={{{name_of(left[0])!r}: ...}}."
            )
        others = {item: symbol(name_of(item)) for item in expression.free_symbols - set(symbols.values())}
        return expression.xreplace(others)

    positions = tuple(map(converted, found.positions))
    velocities = tuple(map(converted, found.velocities))
    energies = [("energy=", energy)] if energy is not None else found.energies
    system = Constrained(
        tuple(names[item] for item in found.coordinates),
        tuple(names[item] for item in found.speeds),
        (),
        tuple(map(converted, found.rates)),
        tuple(map(converted, found.mass)),
        tuple(map(converted, found.forces)),
        positions,
        velocities,
    )
    kept = tuple((label, converted(item)) for label, item in energies)
    system = system._replace(parameters=_parameters(system, [item for _, item in kept], parameters))
    system, added = _with_missing_velocities(system, parameters)
    notes = () if not added else (f"velocity constraints were added for {', '.join(added)}, which the model lacks",)
    own = len(system.velocities) - len(added)
    return Model(
        system,
        kept,
        None if found.independent is None else tuple(names[item] for item in found.independent),
        tuple(f"g{k + 1}" for k in range(len(positions))),
        (*(f"v{k + 1}" for k in range(own)), *(f"{item}'" for item in added)),
        notes,
    )


def _method(model: Any) -> Any:
    """Return the KanesMethod or LagrangesMethod of a model."""
    if hasattr(model, "form_eoms") and getattr(model, "eom_method", None) is None:
        model.form_eoms()
    method = model.eom_method if hasattr(model, "eom_method") else model
    if not (hasattr(method, "_L") or hasattr(method, "kindiffdict")):
        raise TypeError(
            f"mechanics: got {type(model).__name__}; expected a KanesMethod, a LagrangesMethod, or an object with "
            "eom_method, as a System of sympy.physics.mechanics."
        )
    return method


def _of_kane(method: Any) -> _Equations:
    """Return the equations with all speeds independent, in which the constraints keep their multipliers.

    The model's own equations, with dependent speeds, have poles where its choice of them is singular.
    """
    if method._uaux:
        raise ValueError(
            f"mechanics: the model has auxiliary speeds ({', '.join(map(name_of, method._uaux))}); leave them out, and "
            "take forces of constraints from problem.multipliers."
        )
    bodies, loads = method.bodylist, method.forcelist
    if not bodies:
        raise ValueError("mechanics: the model has no bodies yet; call kanes_equations(bodies, loads) first.")
    by_speeds = method.kindiffdict()
    q, u = list(method.q), list(method.u)
    frame = method._inertial
    free = KanesMethod(frame, q_ind=q, u_ind=u, kd_eqs=[dq - value for dq, value in by_speeds.items()])
    free.kanes_equations(bodies, loads)
    velocities = list(method._k_nh * sympy.Matrix(u) + method._f_nh) if method._k_nh else []
    dependent = {*method._qdep, *method._udep}
    kinetic = sympy.Add(*(body.kinetic_energy(frame) for body in bodies))
    potential = sympy.Add(*(body.potential_energy for body in bodies))
    of_loads = _potential_of_loads(loads or [], frame, {*q, *u})
    energies = [("kinetic and potential energy of the bodies", kinetic + potential)]
    if of_loads is not None and of_loads != 0:
        energies += [
            ("kinetic energy of the bodies and potential of constant loads", kinetic + of_loads),
            ("kinetic and potential energy of the bodies and potential of constant loads",
             kinetic + potential + of_loads),
        ]  # fmt: skip
    return _Equations(
        q,
        u,
        [by_speeds[item.diff(TIME)] for item in q],
        free.mass_matrix,
        free.forcing,
        list(method._f_h),
        velocities,
        energies,
        [item for item in (*q, *u) if item not in dependent] if dependent else None,
        dict(by_speeds),
    )


def _of_lagrange(method: Any) -> _Equations:
    if method.eom is None:
        method.form_lagranges_equations()
    q = list(method.q)
    speeds = [item.diff(TIME) for item in q]
    L = method._L[0]
    energy = sympy.Add(*(v * sympy.diff(L, v) for v in speeds)) - L
    return _Equations(
        q,
        speeds,
        speeds,
        method._m_d,
        method._f_d,
        list(method._hol_coneqs),
        list(method.coneqs),
        [("of the Lagrangian", energy)],
        None,
        {},
    )


def _potential_of_loads(loads: Iterable[Any], frame: Any, state: set[Any]) -> Any:
    """Return the potential of forces that are constant in the inertial frame; None where a position is not known."""
    total = sympy.Integer(0)
    for place, vector in loads:
        if not isinstance(place, Point):
            continue
        components = [vector.dot(axis) for axis in frame]
        if any(item.atoms(AppliedUndef, sympy.Derivative) or item.has(TIME) for item in components):
            continue
        origin = _fixed_point(place, frame)
        if origin is None:
            return None
        position = place.pos_from(origin)
        total -= sympy.Add(*(f * position.dot(axis) for f, axis in zip(components, frame, strict=True)))
    return total


def _fixed_point(place: Any, frame: Any) -> Any:
    """Return a point that is at rest in the frame, connected with a point by known positions."""
    seen, left = {place}, [place]
    while left:
        point = left.pop()
        if point._vel_dict.get(frame) == 0:
            return point
        new = [other for other in point._pos_dict if other not in seen]
        seen.update(new)
        left += new
    return None


def _require_distinct(names: Mapping[Any, str]) -> None:
    found = list(names.values())
    twice = next((name for k, name in enumerate(found) if name in found[:k] or name == "t"), None)
    if twice is not None:
        raise ValueError(f"mechanics: {twice!r} names two components of the state, or the time; rename one.")


def _as_function(key: Any, found: _Equations) -> Any:
    """Return the function of time of an input that is given by its name or itself."""
    if not isinstance(key, str):
        return key
    atoms = set().union(*(sympy.sympify(item).atoms(AppliedUndef) for item in (*found.forces, *found.positions,
                        *found.velocities, *found.mass)))  # fmt: skip
    known = {name_of(item): item for item in atoms}
    if key not in known:
        raise ValueError(f"inputs: the model has no function {key!r}{nearest(key, known)}.")
    return known[key]


def _parameters(system: Constrained, others: Sequence[Any], values: Mapping[str, float]) -> tuple[str, ...]:
    """Return the names of the parameters that occur, in the order in which their values are given."""
    items = (*system.rates, *system.mass, *system.forces, *system.positions, *system.velocities, *others)
    free = set().union(*(item.free_symbols for item in items)) - {*system.variables, symbol("t")}
    needed = {item.name for item in free}
    missing = sorted(needed - values.keys())
    if missing:
        hint = nearest(missing[0], [name for name in values if name not in needed])
        raise ValueError(
            f"params: the value of {missing[0]!r} is missing{hint}. The model has {', '.join(sorted(needed))}."
        )
    return tuple(name for name in values if name in needed)


def _with_missing_velocities(system: Constrained, values: Mapping[str, float]) -> tuple[Constrained, list[str]]:
    """Add the derivatives of constraints on positions that those on velocities do not contain.

    KanesMethod ignores a configuration constraint without its velocity constraint.
    """
    if not system.positions:
        return system, []
    rates = [system.rate(item) for item in system.positions]
    items = (*rates, *system.velocities)
    speeds = system.variables[len(system.coordinates) :]
    rows = filling("rows", [sympy.diff(item, u) for item in items for u in speeds], system)
    params = np.array([values[name] for name in system.parameters])
    extra = (params,) if system.parameters else ()
    rng = np.random.default_rng(3)
    missing = np.zeros(len(rates), bool)
    for _ in range(POINTS):
        flat = np.empty(len(items) * len(speeds))
        plain(rows)(rng.uniform(0.1, 1.0), rng.uniform(0.1, 1.0, len(system.variables)), flat, *extra)
        found = flat.reshape(len(items), -1)
        own, known = found[: len(rates)], found[len(rates) :]
        left = own
        if len(known):
            _, sizes, directions = np.linalg.svd(known, full_matrices=False)
            directions = directions[sizes > DEPENDENT * sizes.max(initial=0.0)]
            left = own - own @ directions.T @ directions
        missing |= np.linalg.norm(left, axis=1) > DEPENDENT * np.linalg.norm(own, axis=1)
    added = [k for k in range(len(rates)) if missing[k]]
    system = system._replace(velocities=(*system.velocities, *(rates[k] for k in added)))
    return system, [f"g{k + 1}" for k in added]
