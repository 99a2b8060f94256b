"""Problems of models of sympy.physics.mechanics, whose equations are converted to real symbols."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import sympy
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import maximum_bipartite_matching
from sympy.core.function import AppliedUndef
from sympy.physics.mechanics import KanesMethod, Point, dynamicsymbols, msubs

from ...core.functions import compiled_like, is_jitted
from ...core.inputs import is_number, shown
from ...core.names import nearest
from ..multibody.motion import plain
from ..multibody.parts import required_outputs
from ..multibody.problem import MechanicsProblem, mechanics_problem
from ..multibody.start import MET, Names, by_name
from .brackets import without_impulses
from .constrained import Constrained, acceleration, cyclic, filling, own_speed, parts_of
from .parser import as_expression, symbol
from .system import parameter_values

__all__ = ["Inputs", "mechanics_of_model", "name_of", "read_inputs"]

TIME = dynamicsymbols._t


def name_of(item: Any) -> str:
    """Return the name of a dynamicsymbol, a symbol or a string; the derivative of x is the speed ``v_x``."""
    if isinstance(item, sympy.Derivative):
        return f"v_{name_of(item.expr)}"
    text = item if isinstance(item, str) else item.func.__name__ if isinstance(item, AppliedUndef) else str(item)
    return re.sub(r"\W", "_", text.replace("'", "_prime"))


class Inputs(NamedTuple):
    """Values of functions of time as `expressions`, or as functions ``f(t, y)`` by name, which are `called`."""

    expressions: dict[Any, Any]
    called: tuple[tuple[str, Callable[..., float]], ...]


def read_inputs(
    given: Any, known: Mapping[str, Any], state: Mapping[Any, str], start: tuple[float, np.ndarray]
) -> Inputs:
    """Return the inputs.

    `given` are those of `mechanics`. `known` are the functions of time in the model by name, `state` the names of
    coordinates and speeds in the order of the state, and `start` a time and a state at which functions are called. A
    ValueError or TypeError is raised if a key is not an input, or a value has the wrong type or size.
    """
    if not isinstance(given, Mapping):
        raise TypeError(
            f"inputs must be a mapping of functions of time to expressions or functions, got {shown(given)}."
        )
    expressions: dict[Any, Any] = {}
    called: list[tuple[str, Callable[..., float]]] = []
    for key, value in given.items():
        keys = [_function_of_time(item, known, state) for item in (key if isinstance(key, tuple) else (key,))]
        if callable(value) and not isinstance(value, sympy.Basic):
            called += _called(keys, value, start)
        else:
            expressions |= _as_expressions(keys, value)
    return Inputs(expressions, tuple(called))


def _function_of_time(key: Any, known: Mapping[str, Any], state: Mapping[Any, str]) -> Any:
    if key in state or key in state.values():
        raise ValueError(f"inputs: {key} is a component of the state; inputs are the other functions of time.")
    if not isinstance(key, str):
        return key
    if key not in known:
        raise ValueError(f"inputs: the model has no function {key!r}{nearest(key, known)}.")
    return known[key]


def _as_expressions(keys: Sequence[Any], value: Any) -> dict[Any, Any]:
    """Return the numbers or expressions in `value` as a dictionary with the functions of time `keys`."""
    values = [value] if len(keys) == 1 and not isinstance(value, (tuple, list, np.ndarray)) else list(value)
    if len(values) != len(keys):
        raise ValueError(f"inputs: got {len(values)} values for {', '.join(map(str, keys))}; expected {len(keys)}.")
    for item in values:
        if not (is_number(item) or isinstance(item, sympy.Expr)):
            raise TypeError(
                f"inputs: {keys[0]} is {shown(item)}; expected a number, an expression of t and the state, or a "
                "function f(t, y)."
            )
    return dict(zip(keys, map(sympy.sympify, values), strict=True))


def _called(keys: Sequence[Any], fun: Any, start: tuple[float, np.ndarray]) -> list[tuple[str, Callable[..., float]]]:
    """Return for each function of time in `keys` its name, and a function ``f(t, y)`` of this component of `fun`."""
    t, y = start
    if (size := np.size(fun(t, y.copy()))) != len(keys):
        raise ValueError(
            f"inputs: the function of {', '.join(map(str, keys))} returns {size} numbers; expected {len(keys)}."
        )
    return [(name_of(key), _part(fun, k if len(keys) > 1 else None)) for k, key in enumerate(keys)]


def _part(fun: Any, k: int | None) -> Callable[..., float]:
    if not is_jitted(fun):
        return partial(_called_in_python, fun, k)
    if k is None:
        return fun
    return compiled_like(lambda t, y: fun(t, y)[k], fun)


def _called_in_python(fun: Callable[..., Any], k: int | None, t: float, y: np.ndarray) -> float:
    return float(fun(t, y) if k is None else fun(t, y)[k])


# A row of constraints depends on the others if its remainder is below DEPENDENT, relative to the row, at POINTS points.
DEPENDENT, POINTS = 1e-9, 3
QUATERNION = 4  # components
# Largest number of rows of a block of kinematical equations that is solved by Cramer's rule.
LARGEST_BLOCK = 3


class _Equations(NamedTuple):
    """A model's equations in its own symbols: q' = `rates` and `mass` u' = `forces` plus the forces of the constraints.

    `positions` and `velocities` are the expressions that the constraints set to 0. `energies` are pairs (description,
    expression), and `independent` is None if the model has no dependent coordinates or speeds.
    """

    coordinates: list[Any]
    speeds: list[Any]
    rates: list[Any]
    mass: Any
    forces: Any
    positions: list[Any]
    velocities: list[Any]
    energies: list[tuple[str, Any]]
    kinetic: Any  # the kinetic energy, or the Lagrangian
    method: Any  # the KanesMethod, whose speeds may be any linear functions of the derivatives of coordinates
    independent: list[Any] | None
    by_speeds: dict[Any, Any]  # derivatives of coordinates as functions of speeds


def mechanics_of_model(
    model: Any,
    params: Mapping[Any, float] | None,
    q0: Any,
    u0: Any,
    *,
    t_span: tuple[float, float] | None,
    inputs: Mapping[Any, Any] | None,
    energy: Any,
    potential_energy: Any,
    outputs: Any,
    independent: Iterable[Any] | None,
    rank_tolerance: float,
    name: str,
    others: Mapping[str, Any],
) -> MechanicsProblem:
    """Return the problem of a model; see `mechanics`."""
    values, q0, u0, inputs = _with_defaults(model, params, q0, u0, inputs)
    t = 0.0 if t_span is None else float(t_span[0])
    outputs = required_outputs("mechanics", outputs, ())
    method = _method(model)
    found = _of_lagrange(method) if hasattr(method, "_L") else _of_kane(method)
    converted = _Conversion(found, inputs, t, q0, u0)
    system = _system(found, converted)
    energies = [(label, item, None) for label, item in _energies(found, energy, potential_energy, converted)]
    momenta = list(_momenta(found, system, converted))
    observed = [(label, converted.output(label, item, values)) for label, item in outputs.items()]
    extra = [item for _, item, *_ in (*energies, *momenta, *observed)]
    system = system._replace(parameters=_parameters(system, extra, values))
    system, added = _with_missing_velocities(system, values)
    notes = [f"velocity constraints were added for {', '.join(added)}, which the model lacks"] if added else []
    own = [f"v{k + 1}" for k in range(len(system.velocities) - len(added))]
    positions = tuple(f"g{k + 1}" for k in range(len(system.positions)))
    names = Names(system.coordinates, system.speeds, positions, (*own, *(f"{item}'" for item in added)))
    held = independent
    if held is None and found.independent is not None:
        held = [converted.names[item] for item in found.independent]
    try:
        problem = mechanics_problem(
            name,
            parts_of(system, energies, momenta, observed),
            names,
            t,
            (_by_name("q0", q0, system.coordinates), _by_name("u0", u0, system.speeds)),
            np.array([values[key] for key in system.parameters]) if system.parameters else None,
            None if held is None else [name_of(item) for item in held],
            rank_tolerance,
            t_span=t_span,
            notes=tuple(notes),
            parameter_names=system.parameters,
            **others,
        )
    except ZeroDivisionError as error:
        raise ValueError(
            "mechanics: the equations divide by zero at the start. Start at another position, or describe it by other "
            "coordinates: Euler angles have singular attitudes, for example, and quaternions have none."
        ) from error
    _require_rotations(problem)
    return problem


def _with_defaults(model: Any, params: Any, q0: Any, u0: Any, inputs: Any) -> tuple[dict[str, float], Any, Any, Any]:
    """Return the parameters by name, the start, and the inputs, by default those that a System of PyDy has."""
    # PyDy refuses constants that are in the constraints on positions alone: they are given here.
    constants = getattr(model, "constants", None) or {}
    values = {**by_name("constants", constants, name_of), **by_name("params", params or {}, name_of)}
    if q0 is None and u0 is None:
        q0 = u0 = getattr(model, "initial_conditions", None)
    if q0 is None or u0 is None:
        raise TypeError("mechanics: q0 or u0 is missing; give the coordinates and speeds at the start.")
    if inputs is None:
        given = getattr(model, "specifieds", None) or {}
        inputs = {key: _swapped(value) if callable(value) else value for key, value in given.items()}
    return parameter_values(values), q0, u0, inputs


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


def _by_name(what: str, given: Any, names: tuple[str, ...]) -> Any:
    """Return a mapping with names as keys, those in `names` or, if there are none, all; return an array unchanged."""
    if not isinstance(given, Mapping):
        return given
    found = by_name(what, given, name_of)
    return {key: value for key, value in found.items() if key in names} or found


def _require_different(items: Iterable[Any]) -> None:
    """Raise ValueError if two different items, which are symbols, functions of time or their derivatives, share a name.

    Converted expressions would not distinguish them.
    """
    known: dict[str, Any] = {}
    for item in items:
        first = known.setdefault(name := name_of(item), item)
        if first != item:
            raise ValueError(
                f"mechanics: two different quantities are called {name!r}: {_described(first)} and {_described(item)}. "
                "Rename one or, if they are meant to be the same, use one of them everywhere."
            )


def _described(item: Any) -> str:
    """Return an item as text; that of a symbol contains its assumptions, which make symbols different."""
    if item == TIME:
        return "the time, dynamicsymbols._t"
    return sympy.srepr(item) if isinstance(item, sympy.Symbol) else str(item)


class _Conversion:
    """Converter of expressions from a model's functions of time and symbols to the real symbols of this package."""

    def __init__(self, found: _Equations, inputs: Any, t: float, q0: Any, u0: Any) -> None:
        self.names = {item: name_of(item) for item in (*found.coordinates, *found.speeds)}
        components = list(self.names.values())
        self._found = found
        self._symbols = {item: symbol(name) for item, name in self.names.items()} | {TIME: symbol("t")}
        self._accelerations = {item.diff(TIME): acceleration(self.names[item]) for item in found.speeds}
        count = len(found.coordinates)
        state = np.array([*_numbers(q0, components[:count]), *_numbers(u0, components[count:])])
        parts = [*found.forces, *found.positions, *found.velocities, *found.mass, *found.rates]
        functions = set().union(*(sympy.sympify(item).atoms(AppliedUndef) for item in parts))
        self.inputs = read_inputs(inputs, {name_of(item): item for item in functions}, self.names, (t, state))
        self._called = {name for name, _ in self.inputs.called}
        if taken := self._called & {*self.names.values(), "t"}:
            raise ValueError(
                f"inputs: {taken.pop()!r} is also the name of the time or of a component of the state; rename it."
            )
        parts += [item for _, item in found.energies]
        symbols = set().union(*(sympy.sympify(item).free_symbols for item in parts))
        called = {item for item in functions if name_of(item) in self._called}
        _require_different((TIME, *self.names, *sorted(called | symbols, key=sympy.srepr)))

    def __call__(self, expression: Any) -> Any:
        """Return the converted expression."""
        found, given = self._found, self.inputs.expressions
        expression = msubs(sympy.sympify(expression), found.by_speeds)
        if given and expression.has(*given):
            expression = msubs(expression.subs(given).doit(), found.by_speeds)
        for derivatives in (True, False):
            chosen = {k: v for k, v in self._symbols.items() if isinstance(k, sympy.Derivative) == derivatives}
            expression = expression.xreplace(chosen)
        # The derivative of Abs(x(t)), which may be complex, contains Derivative(re(x), x), which is 1 for a real x.
        expression = expression.xreplace({item: item.doit() for item in expression.atoms(sympy.Derivative)})
        left = sorted(
            expression.atoms(AppliedUndef, sympy.Derivative), key=lambda item: (item.args != (TIME,), str(item))
        )
        unknown = [item for item in left if isinstance(item, sympy.Derivative) or name_of(item) not in self._called]
        if unknown:
            raise self._unknown(unknown[-1])
        expression = expression.xreplace({item: symbol(name_of(item)) for item in left})
        own = {*self._symbols.values(), *self._accelerations.values()}
        expression = expression.xreplace({item: symbol(name_of(item)) for item in expression.free_symbols - own})
        return without_impulses(expression)

    def _unknown(self, item: Any) -> ValueError:
        inner = item.expr if isinstance(item, sympy.Derivative) else item
        if name_of(inner) in self._called:
            return ValueError(
                f"mechanics: the equations contain the derivative {item} of an input that is a function without an "
                f"expression; give it as an expression of t: inputs={{{name_of(inner)!r}: ...}}."
            )
        return ValueError(
            f"mechanics: {item} is neither a coordinate nor a speed; give it as an expression of t and the state, or a "
            f"function f(t, y): inputs={{{name_of(inner)!r}: ...}}."
        )

    def depends_on_call(self, expression: Any) -> bool:
        """Return True if an expression contains an input that is called as a function."""
        return bool({item.name for item in expression.free_symbols} & self._called)

    def output(self, name: str, given: Any, parameters: Mapping[str, float]) -> Any:
        """Return the converted expression of an output, which may be text and may contain accelerations."""
        if isinstance(given, str):
            return as_expression(f"the output {name!r}", given, {*self.names.values(), *parameters})
        found = self._found
        second = {q.diff(TIME, 2): value.diff(TIME) for q, value in found.by_speeds.items() for q in (q.args[0],)}
        expression = sympy.sympify(given).xreplace(second)
        return self(expression.xreplace(self._accelerations))


def _numbers(given: Any, names: Sequence[str]) -> list[float]:
    """Return values with which functions can be called; components that were not given are 0."""
    if isinstance(given, Mapping):
        found = {name_of(key): value for key, value in given.items()}
        return [float(found.get(name, 0.0)) for name in names]
    return [float(value) for value in given] if np.shape(given) == (len(names),) else [0.0] * len(names)


def _system(found: _Equations, converted: _Conversion) -> Constrained:
    """Return the equations as a `Constrained` whose parameters are not known yet, as outputs may have further ones.

    A ValueError is raised if a constraint or the kinematics depend on an input that is called as a function.
    """
    names = converted.names
    system = Constrained(
        tuple(names[item] for item in found.coordinates),
        tuple(names[item] for item in found.speeds),
        (),
        tuple(map(converted, found.rates)),
        tuple(map(converted, found.mass)),
        tuple(map(converted, found.forces)),
        tuple(map(converted, found.positions)),
        tuple(map(converted, found.velocities)),
        converted.inputs.called,
    )
    parts = {"constraint": (*system.positions, *system.velocities), "kinematic equation": system.rates}
    for what, items in parts.items():
        if any(map(converted.depends_on_call, items)):
            raise ValueError(
                f"inputs: a {what} depends on an input that is a function without an expression, and its derivatives "
                "are needed. Give the input as an expression of t and the state."
            )
    return system


def _energies(
    found: _Equations, energy: Any, potential_energy: Any, converted: _Conversion
) -> Iterator[tuple[str, Any]]:
    """Yield the quantities that may be the energy.

    There are none if inputs are called as functions, because such a force may begin to do work later.
    """
    given = [("energy=", energy)] if energy is not None else []
    if potential_energy is not None:
        given += [(f"{label} and potential_energy=", item + potential_energy) for label, item in found.energies]
    if not given and converted.inputs.called:
        return
    for label, item in given or found.energies:
        if converted.depends_on_call(expression := converted(item)):
            raise ValueError(
                "mechanics: the energy depends on an input that is a function without an expression, and its "
                "derivatives are needed. Give the input as an expression of t and the state."
            )
        yield label, expression


def _by_rate(found: _Equations, system: Constrained, converted: _Conversion, k: int) -> list[Any]:
    """Return the derivatives of the speeds with respect to the rate of the k-th coordinate; [] if they are unknown."""
    return own_speed(system, k) or (_speeds_by_rate(found.method, k, converted) if found.method else [])


def _momenta(found: _Equations, system: Constrained, converted: _Conversion) -> Iterator[tuple[str, Any]]:
    """Yield the names and expressions of momenta that may be constant."""
    speeds_by_rate = partial(_by_rate, found, system, converted)
    places = cyclic(system, speeds_by_rate)
    slopes = [converted(sympy.diff(found.kinetic, u)) for u in found.speeds] if places else []
    for k in places:
        products = (a * b for a, b in zip(speeds_by_rate(k), slopes, strict=True))
        yield f"p_{system.coordinates[k]}", sympy.Add(*products)


def _speeds_by_rate(method: Any, k: int, converted: _Conversion) -> list[Any]:
    """Return the derivatives of a KanesMethod's speeds by the rate of coordinate k; [] if their numbers differ."""
    by_speeds, by_rates = method._k_ku_implicit, method._k_kqdot_implicit
    if by_speeds.rows != by_speeds.cols:
        return []
    found = _solution(by_speeds, -by_rates[:, k])
    return [] if found is None else [converted(item) for item in found]


def _solution(A: Any, B: Any) -> Any:
    """Return the solution X of A X = B; None if the matrix A has too many zeros to be regular.

    SymPy's `LUsolve` divides by pivots, which may be 0 although A is regular, for example with Euler angles at the
    attitude 0. Cramer's rule divides by determinants only, but its terms are too many for large matrices. Therefore A
    is permuted to a triangular matrix of blocks, and the rule is applied to blocks of at most `LARGEST_BLOCK` rows.
    """
    pattern = csr_matrix([[int(item != 0) for item in A.row(i)] for i in range(A.rows)])
    order = maximum_bipartite_matching(pattern, perm_type="column").tolist()
    if -1 in order:
        return None
    permuted, X = A[:, order], sympy.zeros(*B.shape)
    found: list[int] = []
    for rows in permuted.strongly_connected_components():
        block, rest = permuted[rows, rows], B[rows, :]
        for k in found:
            rest -= permuted[rows, k] * X[order[k], :]
        small = len(rows) <= LARGEST_BLOCK
        part = block.adjugate() * rest / block.det() if small else block.LUsolve(rest)
        for i, row in enumerate(rows):
            X[order[row], :] = part[i, :]
        found += rows
    return X


def _method(model: Any) -> Any:
    """Return the KanesMethod or LagrangesMethod of a model."""
    if hasattr(model, "form_eoms") and getattr(model, "eom_method", None) is None:
        model.form_eoms()
    method = model.eom_method if hasattr(model, "eom_method") else model
    if not (hasattr(method, "_L") or hasattr(method, "kindiffdict")):
        raise TypeError(
            f"mechanics: got {type(model).__name__}; expected a KanesMethod, a LagrangesMethod, or an object with "
            "eom_method, such as a System of sympy.physics.mechanics."
        )
    return method


def _of_kane(method: Any) -> _Equations:
    """Return the equations of a KanesMethod with all speeds independent and multipliers for the constraints.

    The model's own equations, with dependent speeds, have poles at states where the choice of these is singular.
    """
    if method._uaux:
        raise ValueError(
            f"mechanics: the model has auxiliary speeds ({', '.join(map(name_of, method._uaux))}), which are not "
            "supported. Remove them, and take the forces of constraints from problem.multipliers."
        )
    bodies, loads = method.bodylist, method.forcelist
    if not bodies:
        raise ValueError("mechanics: the model has no bodies yet; call kanes_equations(bodies, loads) first.")
    q, u = list(method.q), list(method.u)
    rates = -_solution(method._k_kqdot_implicit, method._k_ku_implicit * sympy.Matrix(u) + method._f_k_implicit)
    by_speeds = dict(zip(method.kindiffdict(), rates, strict=True))
    frame = method._inertial
    free = KanesMethod(frame, q_ind=q, u_ind=u, kd_eqs=[dq - value for dq, value in by_speeds.items()])
    free.kanes_equations(bodies, loads)
    velocities = list(method._k_nh * sympy.Matrix(u) + method._f_nh) if method._k_nh else []
    dependent = {*method._qdep, *method._udep}
    kinetic = sympy.Add(*(body.kinetic_energy(frame) for body in bodies))
    potential = sympy.Add(*(body.potential_energy for body in bodies))
    of_loads = _potential_of_loads(loads or [], frame)
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
        kinetic,
        method,
        [item for item in (*q, *u) if item not in dependent] if dependent else None,
        by_speeds,
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
        L,
        None,
        None,
        {},
    )


def _is_constant(load: Any, frame: Any) -> bool:
    """Return True if a load is a force that is constant in the inertial frame."""
    place, vector = load
    components = [vector.dot(axis) for axis in frame]
    return isinstance(place, Point) and not any(
        item.atoms(AppliedUndef, sympy.Derivative) or item.has(TIME) for item in components
    )


def _potential_of_loads(loads: Iterable[Any], frame: Any) -> Any:
    """Return the potential of the forces that are constant in the inertial frame; None if a position is unknown."""
    total = sympy.Integer(0)
    for place, vector in loads:
        if not _is_constant((place, vector), frame):
            continue
        components = [vector.dot(axis) for axis in frame]
        origin = _fixed_point(place, frame)
        if origin is None:
            return None
        position = place.pos_from(origin)
        total -= sympy.Add(*(f * position.dot(axis) for f, axis in zip(components, frame, strict=True)))
    return total


def _fixed_point(place: Any, frame: Any) -> Any:
    """Return a point at rest in `frame` whose position relative to `place` is known; None if there is none."""
    seen, left = {place}, [place]
    while left:
        point = left.pop()
        if point._vel_dict.get(frame) == 0:
            return point
        new = [other for other in point._pos_dict if other not in seen]
        seen.update(new)
        left += new
    return None


def _parameters(system: Constrained, others: Sequence[Any], values: Mapping[str, float]) -> tuple[str, ...]:
    """Return the parameters in the equations or in `others`, in the order of `values`; all must have a value."""
    items = (*system.rates, *system.mass, *system.forces, *system.positions, *system.velocities, *others)
    known = {*system.variables, symbol("t"), *map(acceleration, system.speeds)}
    known |= {symbol(name) for name, _ in system.inputs}
    if taken := sorted(values.keys() & {item.name for item in known}):
        raise ValueError(
            f"params: {taken[0]!r} is the name of a parameter, and of a component of the state or an input; rename one."
        )
    free = set().union(*(item.free_symbols for item in items)) - known
    needed = {item.name for item in free}
    missing = sorted(needed - values.keys())
    if missing:
        hint = nearest(missing[0], [name for name in values if name not in needed])
        raise ValueError(
            f"params: the value of {missing[0]!r} is missing{hint}. The parameters of the model are "
            f"{', '.join(sorted(needed))}."
        )
    return tuple(name for name in values if name in needed)


def _with_missing_velocities(system: Constrained, values: Mapping[str, float]) -> tuple[Constrained, list[str]]:
    """Add the derivatives of constraints on positions that do not follow from the constraints on velocities.

    KanesMethod ignores a configuration constraint without its velocity constraint. Return the system and the names of
    the constraints whose derivatives were added. Dependence is tested at random states with the `values` of the
    parameters.
    """
    if not system.positions:
        return system, []
    rates = [system.rate(item) for item in system.positions]
    items = (*rates, *system.velocities)
    speeds = system.variables[len(system.coordinates) :]
    rows = filling("rows", [sympy.diff(item, u) for item in items for u in speeds], system.arguments)
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
