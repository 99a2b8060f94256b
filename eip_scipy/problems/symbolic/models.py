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
from sympy.physics.mechanics import KanesMethod, Point, msubs

from ...core.functions import compiled_like, is_jitted
from ...core.inputs import is_number, shown
from ...core.names import nearest
from ..multibody.motion import plain
from ..multibody.parts import required_outputs
from ..multibody.problem import MechanicsProblem, mechanics_problem
from ..multibody.start import MET, Names, by_name
from .brackets import BRANCHES, drop_dirac_deltas, sampled_values
from .constrained import Constrained, acceleration, parts_of
from .parser import TIME, as_expression, as_mapping, symbol
from .system import parameter_values

__all__ = ["mechanics_of_model", "name_of"]

DEPENDENT = 1e-9  # a row of constraints depends on others if its remainder is below this share of the row
LARGEST_BLOCK = 3  # of linear equations that are solved by Cramer's rule


def name_of(item: Any) -> str:
    """Return the name of a dynamicsymbol, a symbol or a string; the derivative of x is the speed ``v_x``."""
    if isinstance(item, sympy.Derivative):
        return f"v_{name_of(item.expr)}"
    text = item if isinstance(item, str) else item.func.__name__ if isinstance(item, AppliedUndef) else str(item)
    return re.sub(r"\W", "_", text.replace("'", "_prime"))


class _Model(NamedTuple):
    """A model, whose equations `own`, with their coordinates and speeds, are in its own symbols.

    `energies` are pairs (description, expression), and `independent` is None if the model has no dependent coordinates
    or speeds.
    """

    own: Constrained
    energies: list[tuple[str, Any]]
    kinetic: Any  # the kinetic energy, or the Lagrangian
    partial_speeds: Callable[[int], Sequence[Any]]  # the derivatives of the speeds by the rate of a coordinate, or []
    independent: list[Any] | None = None
    by_speeds: Mapping[Any, Any] = {}  # derivatives of coordinates as functions of speeds


def mechanics_of_model(
    model: Any, params: Any, start: tuple[Any, Any], inputs: Any, energies: tuple[Any, Any], outputs: Any, **others: Any
) -> MechanicsProblem:
    """Return the problem of a model; see `mechanics`. `energies` are the total and the potential energy that are given.

    `others` are arguments of `mechanics_problem`.
    """
    values, start, inputs = _with_defaults(model, params, start, inputs)
    t = 0.0 if others["t_span"] is None else float(others["t_span"][0])
    outputs = required_outputs("mechanics", outputs, ())
    method = _method(model)
    found = _of_lagrange(method) if hasattr(method, "_L") else _of_kane(method)
    converted = _Conversion(found, inputs, t, start)
    system = converted.system()
    kept, momenta = tuple(converted.energies(*energies)), tuple(_momenta(found, system, converted))
    observed = tuple((label, converted.output(label, item, values)) for label, item in outputs.items())
    system = _with_parameters(system, [item for _, item in (*kept, *momenta, *observed)], values)
    given, lacking = len(system.velocities), _missing_velocities(system, values)
    system = system._replace(velocities=(*system.velocities, *(system.rate(system.positions[k]) for k in lacking)))
    positions, added = tuple(f"g{k + 1}" for k in range(len(system.positions))), [f"g{k + 1}" for k in lacking]
    velocities = (*(f"v{k + 1}" for k in range(given)), *(f"{item}'" for item in added))
    if others["independent"] is None:
        others["independent"] = found.independent
    elif not isinstance(others["independent"], str):
        others["independent"] = [name_of(item) for item in others["independent"]]
    try:
        problem = mechanics_problem(
            parts=parts_of(system, kept, momenta, observed),
            names=Names(system.coordinates, system.speeds, positions, velocities),
            t=t,
            start=tuple(map(_by_component, ("q0", "u0"), start, (system.coordinates, system.speeds))),
            params=np.array([values[key] for key in system.parameters]) if system.parameters else None,
            notes=(f"velocity constraints were added for {', '.join(added)}, which the model lacks",) * bool(added),
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


def _with_defaults(model: Any, params: Any, start: Any, inputs: Any) -> tuple[dict[str, float], Any, Any]:
    """Return the parameters by name, the start, and the inputs, by default those that a System of PyDy has."""
    # PyDy refuses constants that are in the constraints on positions alone: they are given here.
    constants = getattr(model, "constants", None) or {}
    values = {**by_name("constants", constants, name_of), **by_name("params", params or {}, name_of)}
    if start[0] is None and start[1] is None:
        start = (getattr(model, "initial_conditions", None),) * 2
    if start[0] is None or start[1] is None:
        raise TypeError("mechanics: q0 or u0 is missing; give the coordinates and speeds at the start.")
    if inputs is None:  # functions f(y, t) of PyDy
        given = getattr(model, "specifieds", None) or {}
        inputs = {key: partial(_swapped, item) if _is_called(item) else item for key, item in given.items()}
    return parameter_values(values), start, inputs


def _is_called(item: Any) -> bool:
    return callable(item) and not isinstance(item, sympy.Basic)


def _swapped(function: Any, t: float, y: np.ndarray) -> Any:
    return function(y, t)


def _by_component(what: str, given: Any, names: tuple[str, ...]) -> Any:
    """Return a mapping with names as keys, those in `names` or, if there are none, all; return an array unchanged."""
    if not isinstance(given, Mapping):
        return given
    found = by_name(what, given, name_of)
    return {key: value for key, value in found.items() if key in names} or found


def _require_rotations(problem: MechanicsProblem) -> None:
    """Raise ValueError if a quaternion that SymPy uses for a rotation does not have the norm 1."""
    args = () if problem.params is None else (problem.params,)
    for item in problem.norms:
        value = plain(item.function)(0.0, problem.y0, *args)
        if str(item.name).count("^2") == 4 and not abs(value - 1) <= MET:
            raise ValueError(
                f"mechanics: the start has {item.name} = {value:.6g}; expected 1, because the quaternion of a rotation "
                "has norm 1. Divide its components by their norm."
            )


class _Conversion:
    """Converter of expressions from a model's functions of time and symbols to the real symbols of this package.

    `inputs` are those of `mechanics`. Functions among them are called once, at the start.
    """

    def __init__(self, found: _Model, inputs: Any, t: float, start: tuple[Any, Any]) -> None:
        own = found.own
        self._found, self.names = found, {item: name_of(item) for item in (*own.coordinates, *own.speeds)}
        self._symbols = {item: symbol(name) for item, name in self.names.items()} | {TIME: symbol("t")}
        self._accelerations = {item.diff(TIME): acceleration(self.names[item]) for item in own.speeds}
        parts = [sympy.sympify(item) for items in own.expressions for item in items]
        functions = set().union(*(item.atoms(AppliedUndef) for item in parts))
        self._known = {name_of(item): item for item in functions}
        self._inputs: dict[Any, Any] = {}  # expressions
        self._called: dict[Any, Callable[..., float]] = {}  # functions f(t, y)
        y = np.array([*_numbers(start[0], own.coordinates), *_numbers(start[1], own.speeds)])
        for key, value in as_mapping("inputs", inputs).items():
            self._read_input(
                [self._function(item) for item in (key if isinstance(key, tuple) else (key,))], value, t, y
            )
        self._called_names = set(map(name_of, self._called))
        symbols = (item.free_symbols for item in (*parts, *(sympy.sympify(item) for _, item in found.energies)))
        _require_different((TIME, *self.names, *self._called, *sorted(set().union(*symbols), key=sympy.srepr)))

    def _function(self, key: Any) -> Any:
        """Return the function of time that is meant by the key of an input."""
        if key in self.names or key in self.names.values():
            raise ValueError(f"inputs: {key} is a component of the state; inputs are the other functions of time.")
        if isinstance(key, str) and key not in self._known:
            raise ValueError(f"inputs: the model has no function {key!r}{nearest(key, self._known)}.")
        return self._known[key] if isinstance(key, str) else key

    def _read_input(self, keys: list[Any], value: Any, t: float, y: np.ndarray) -> None:
        """Read the value of an input, of which a function is called at (t, y)."""
        if is_called := _is_called(value):
            values = np.ravel(value(t, y.copy())).tolist()
        else:
            values = list(value) if len(keys) > 1 or isinstance(value, tuple | list | np.ndarray) else [value]
        if len(values) != len(keys):
            what = ("function of {} returns" if is_called else "value of {} has").format(", ".join(map(str, keys)))
            raise ValueError(f"inputs: the {what} {len(values)} numbers; expected {len(keys)}.")
        for k, (key, item) in enumerate(zip(keys, values, strict=True)):
            if is_called:
                self._called[key] = _component(value, k if len(keys) > 1 else None)
            elif is_number(item) or isinstance(item, sympy.Expr):
                self._inputs[key] = sympy.sympify(item)
            else:
                raise TypeError(
                    f"inputs: {key} is {shown(item)}; expected a number, an expression of t and the state, or a "
                    "function f(t, y)."
                )

    def __call__(self, expression: Any) -> Any:
        """Return the converted expression."""
        by_speeds = self._found.by_speeds
        expression = msubs(sympy.sympify(expression), by_speeds)
        if self._inputs and expression.has(*self._inputs):
            expression = msubs(expression.subs(self._inputs).doit(), by_speeds)
        for derivatives in (True, False):
            chosen = {k: v for k, v in self._symbols.items() if isinstance(k, sympy.Derivative) == derivatives}
            expression = expression.xreplace(chosen)
        # The derivative of Abs(x(t)), which may be complex, contains Derivative(re(x), x), which is 1 for a real x.
        expression = expression.xreplace({item: item.doit() for item in expression.atoms(sympy.Derivative)})
        left = sorted(expression.atoms(AppliedUndef, sympy.Derivative), key=lambda x: (x.args != (TIME,), str(x)))
        for item in reversed(left):
            if isinstance(item, sympy.Derivative) or name_of(item) not in self._called_names:
                raise self._unknown(item)
        own = {*self._symbols.values(), *self._accelerations.values()}
        expression = expression.xreplace({item: symbol(name_of(item)) for item in left})
        expression = expression.xreplace({item: symbol(name_of(item)) for item in expression.free_symbols - own})
        return drop_dirac_deltas(expression)

    def _unknown(self, item: Any) -> ValueError:
        inner = item.expr if isinstance(item, sympy.Derivative) else item
        if name_of(inner) in self._called_names:
            return ValueError(
                f"mechanics: the equations contain the derivative {item} of an input that is a function without an "
                f"expression; give it as an expression of t: inputs={{{name_of(inner)!r}: ...}}."
            )
        return ValueError(
            f"mechanics: {item} is neither a coordinate nor a speed; give it as an expression of t and the state, or a "
            f"function f(t, y): inputs={{{name_of(inner)!r}: ...}}."
        )

    def _require_smooth(self, what: str, expressions: Iterable[Any]) -> None:
        """Raise ValueError if a converted expression contains an input that is a function."""
        if {item.name for x in expressions for item in x.free_symbols} & self._called_names:
            raise ValueError(
                f"mechanics: {what} depends on an input that is a function without an expression, and its derivatives "
                "are needed. Give the input as an expression of t and the state."
            )

    def system(self) -> Constrained:
        """Return the equations, whose parameters are not known yet, because outputs may have further ones."""
        own = self._found.own
        names = (tuple(self.names[item] for item in items) for items in (own.coordinates, own.speeds))
        expressions = (tuple(map(self, items)) for items in own.expressions)
        called = tuple((name_of(key), function) for key, function in self._called.items())
        system = Constrained._make([*names, (), *expressions, called])
        self._require_smooth("a kinematic equation", system.rates)
        self._require_smooth("a constraint", (*system.positions, *system.velocities))
        return system

    def energies(self, energy: Any, potential_energy: Any) -> Iterator[tuple[str, Any]]:
        """Yield the quantities that may be the energy.

        There are none if inputs are called as functions, because such a force may begin to do work later.
        """
        given, known = [] if energy is None else [("energy=", energy)], self._found.energies
        if potential_energy is not None:
            given += [(f"{label} and potential_energy=", item + potential_energy) for label, item in known]
        for label, item in given or ([] if self._called else known):
            self._require_smooth("the energy", [expression := self(item)])
            yield label, expression

    def output(self, name: str, given: Any, parameters: Mapping[str, float]) -> Any:
        """Return the converted expression of an output, which may be text and may contain accelerations."""
        if isinstance(given, str):
            return as_expression(f"the output {name!r}", given, {*self.names.values(), *parameters})
        second = {dq.expr.diff(TIME, 2): value.diff(TIME) for dq, value in self._found.by_speeds.items()}
        return self(sympy.sympify(given).xreplace(second).xreplace(self._accelerations))


def _component(fun: Any, k: int | None) -> Callable[..., float]:
    """Return a function of (t, y) that returns component k of the value of an input, or the whole value."""
    if not is_jitted(fun):
        return partial(_called_in_python, fun, k)
    return fun if k is None else compiled_like(lambda t, y: fun(t, y)[k], fun)


def _called_in_python(fun: Callable[..., Any], k: int | None, t: float, y: np.ndarray) -> float:
    return float(fun(t, y) if k is None else fun(t, y)[k])


def _numbers(given: Any, components: Sequence[Any]) -> list[float]:
    """Return values with which functions can be called; components that were not given are 0."""
    if isinstance(given, Mapping):
        found = {name_of(key): value for key, value in given.items()}
        return [float(found.get(name_of(item), 0.0)) for item in components]
    known = np.shape(given) == (len(components),)
    return [float(value) for value in given] if known else [0.0] * len(components)


def _require_different(items: Iterable[Any]) -> None:
    """Raise ValueError if two different items, which are symbols, functions of time or their derivatives, share a name.

    Converted expressions would not distinguish them.
    """
    known: dict[str, Any] = {}
    for item in items:
        first = known.setdefault(name := name_of(item), item)
        if first != item:
            # The representation of a symbol contains its assumptions, which make symbols different.
            one, other = (
                "the time" if x == TIME else sympy.srepr(x) if isinstance(x, sympy.Symbol) else x for x in (first, item)
            )
            raise ValueError(
                f"mechanics: two different quantities are called {name!r}: {one} and {other}. Rename one or, if they "
                "are meant to be the same, use one of them everywhere."
            )


def _momenta(found: _Model, system: Constrained, converted: _Conversion) -> Iterator[tuple[str, Any]]:
    """Yield the names and expressions of momenta that may be constant: masses and forces lack their coordinates.

    A coordinate is left out if exactly one speed depends on its rate and a constraint contains this speed, or if the
    force along it has branches or comes from a function, because such a force may be 0 only near the start.
    """
    known = set().union(*(item.free_symbols for item in (*system.mass, *system.forces)))
    inputs = {symbol(name) for name, _ in system.inputs}
    constrained = {item.name for velocity in system.velocities for item in velocity.free_symbols}
    for k, name in enumerate(system.coordinates):
        column = [] if symbol(name) in known else [converted(item) for item in found.partial_speeds(k)]
        along = [(u, F) for u, F, part in zip(system.speeds, system.forces, column, strict=False) if part != 0]
        unsure = any(F.has(*BRANCHES, sympy.Piecewise) or F.free_symbols & inputs for _, F in along)
        if along and not unsure and not (len(along) == 1 and along[0][0] in constrained):
            slopes = [converted(sympy.diff(found.kinetic, u)) for u in found.own.speeds]
            yield f"p_{name}", sympy.Add(*(a * b for a, b in zip(column, slopes, strict=True)))


def _kane_partial_speeds(method: Any, k: int) -> list[Any]:
    """Return the derivatives of a KanesMethod's speeds by the rate of coordinate k; [] if they are not determined.

    The kinematic equations are A u + B q' + f = 0. Those of them are solved that are connected with coordinate k.
    """
    A, B = method._k_ku_implicit, -method._k_kqdot_implicit[:, k]
    rows, columns, known = [i for i in range(A.rows) if B[i] != 0], list[int](), -1
    while len(columns) > known:
        known = len(columns)
        columns = [j for j in range(A.cols) if any(A[i, j] != 0 for i in rows)]
        rows = [i for i in range(A.rows) if i in rows or any(A[i, j] != 0 for j in columns)]
    X = _solution(A[rows, columns], B[rows, :]) if len(rows) == len(columns) else None
    return [] if X is None else [X[columns.index(j)] if j in columns else sympy.Integer(0) for j in range(A.cols)]


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


def _of_kane(method: Any) -> _Model:
    """Return the equations of a KanesMethod with all speeds independent and multipliers for the constraints.

    The model's own equations, with dependent speeds, have poles at states where the choice of these is singular.
    """
    if method._uaux:
        raise ValueError(
            f"mechanics: the model has auxiliary speeds ({', '.join(map(name_of, method._uaux))}), which are not "
            "supported. Remove them, and take the forces of constraints from problem.multipliers."
        )
    bodies, loads, frame = method.bodylist, method.forcelist, method._inertial
    if not bodies:
        raise ValueError("mechanics: the model has no bodies yet; call kanes_equations(bodies, loads) first.")
    q, u = list(method.q), list(method.u)
    rates = -_solution(method._k_kqdot_implicit, method._k_ku_implicit * sympy.Matrix(u) + method._f_k_implicit)
    by_speeds = dict(zip(method.kindiffdict(), rates, strict=True))
    free = KanesMethod(frame, q_ind=q, u_ind=u, kd_eqs=[dq - value for dq, value in by_speeds.items()])
    free.kanes_equations(bodies, loads)
    kinetic = sympy.Add(*(body.kinetic_energy(frame) for body in bodies))
    potential = sympy.Add(*(body.potential_energy for body in bodies))
    of_loads = _potential_of_loads(loads or [], frame)
    energies = [("kinetic and potential energy of the bodies", kinetic + potential)]
    if of_loads is not None and of_loads != 0:
        constant = "potential of constant loads"
        energies += [
            (f"kinetic energy of the bodies and {constant}", kinetic + of_loads),
            (f"kinetic and potential energy of the bodies and {constant}", kinetic + potential + of_loads),
        ]
    velocities = method._k_nh * sympy.Matrix(u) + method._f_nh if method._k_nh else []
    rates = [by_speeds[item.diff(TIME)] for item in q]
    own = Constrained(q, u, (), rates, free.mass_matrix, free.forcing, method._f_h, velocities)
    dependent = {*method._qdep, *method._udep}
    independent = [item for item in (*q, *u) if item not in dependent] if dependent else None
    return _Model(own, energies, kinetic, partial(_kane_partial_speeds, method), independent, by_speeds)


def _of_lagrange(method: Any) -> _Model:
    if method.eom is None:
        method.form_lagranges_equations()
    q, L = list(method.q), method._L[0]
    speeds = [item.diff(TIME) for item in q]
    own = Constrained(q, speeds, (), speeds, method._m_d, method._f_d, method._hol_coneqs, method.coneqs)
    energy = sympy.Add(*(v * sympy.diff(L, v) for v in speeds)) - L
    return _Model(own, [("of the Lagrangian", energy)], L, lambda k: [sympy.Integer(j == k) for j in range(len(q))])


def _potential_of_loads(loads: Iterable[Any], frame: Any) -> Any:
    """Return the potential of the forces that are constant in the inertial frame; None if a position is unknown."""
    total = sympy.Integer(0)
    for place, vector in loads:
        components = [vector.dot(axis) for axis in frame]
        moves = any(item.atoms(AppliedUndef, sympy.Derivative) or item.has(TIME) for item in components)
        if moves or not isinstance(place, Point):
            continue
        origin = _fixed_point(place, frame)
        if origin is None:
            return None
        position = place.pos_from(origin)
        total -= sympy.Add(*(f * position.dot(axis) for f, axis in zip(components, frame, strict=True)))
    return total


def _fixed_point(place: Any, frame: Any) -> Any:
    """Return a point at rest in `frame` whose position relative to `place` is known; None if there is none."""
    points = [place]
    for point in points:  # which grows
        if point._vel_dict.get(frame) == 0:
            return point
        points += [other for other in point._pos_dict if other not in points]
    return None


def _with_parameters(system: Constrained, others: Sequence[Any], values: Mapping[str, float]) -> Constrained:
    """Return the system with the parameters in the equations or in `others`, in the order of `values`."""
    items = [item for expressions in (*system.expressions, others) for item in expressions]
    known = {*system.arguments.y, "t", *(acceleration(name).name for name in system.speeds)}
    known |= {name for name, _ in system.inputs}
    if taken := sorted(values.keys() & known):
        raise ValueError(
            f"params: {taken[0]!r} is the name of a parameter, and of a component of the state or an input; rename one."
        )
    needed = {item.name for item in set().union(*(item.free_symbols for item in items))} - known
    if missing := sorted(needed - values.keys()):
        hint = nearest(missing[0], [name for name in values if name not in needed])
        raise ValueError(
            f"params: the value of {missing[0]!r} is missing{hint}. The parameters of the model are "
            f"{', '.join(sorted(needed))}."
        )
    return system._replace(parameters=tuple(name for name in values if name in needed))


def _missing_velocities(system: Constrained, values: Mapping[str, float]) -> list[int]:
    """Return the indices of constraints on positions whose derivatives do not follow from those on velocities.

    KanesMethod ignores a configuration constraint without its velocity constraint. Dependence is tested at random
    states.
    """
    items = (*map(system.rate, system.positions), *system.velocities)
    n, m = len(system.speeds), len(system.positions)
    slopes = tuple(sympy.diff(item, symbol(name)) for item in items for name in system.speeds)
    missing = np.zeros(m, bool)
    for found in sampled_values(slopes, system.arguments, [values[name] for name in system.parameters]):
        own, known = np.split(np.array(found, float).reshape(len(items), n), [m])
        left = own - (known.T @ np.linalg.lstsq(known.T, own.T, rcond=DEPENDENT)[0]).T
        missing |= np.linalg.norm(left, axis=1) > DEPENDENT * np.linalg.norm(own, axis=1)
    return np.flatnonzero(missing).tolist()
