"""Construction of a `Problem` from expressions."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache, partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import sympy

from ...core.balances import Balance
from ...core.functions import is_jitted
from ...core.inputs import is_number, reals, shown
from ...core.invariants import Invariant
from ...core.problem import Deferred, Problem, bind
from ..multibody.motion import vector
from .brackets import Manifold, NotKeptError, how_kept, slope, vanishes
from .pairs import Timed, paired
from .parser import as_expression, as_names, symbol
from .program import Arguments, function
from .program import variational as variational_function

__all__ = ["SymbolicProblem", "equations_problem", "hamiltonian_problem", "parameter_values"]


HINT = "If it is conserved only if constraints hold, pass them as constraints=."
LARGEST_JACOBIAN = 16  # number of coordinates; the Jacobian has its square of entries


class System(NamedTuple):
    """Equations and their invariants and balances as expressions. Equal systems share their compiled functions.

    `invariants` holds pairs (name, expression), `balances` triples (name, expression, rate), and `constraints` the
    names of the invariants that are 0.
    """

    components: tuple[str, ...]
    parameters: tuple[str, ...]
    rates: tuple[Any, ...]
    invariants: tuple[tuple[str, Any], ...]
    balances: tuple[tuple[str, Any, Any], ...] = ()
    constraints: tuple[str, ...] = ()  # names of invariants that are 0

    @property
    def variables(self) -> list[Any]:
        """Return the symbols of the state."""
        return [symbol(name) for name in self.components]

    @property
    def accelerations(self) -> tuple[Any, ...] | None:
        """Return a of q'' = a(t, q) if the equations have this form for a state (q, q'); otherwise None."""
        variables, half = self.variables, len(self.components) // 2
        velocities = variables[half:]
        found = self.rates[half:]
        if len(variables) % 2 or list(self.rates[:half]) != velocities:
            return None
        return None if any(rate.has(*velocities) for rate in found) else found


class Functions(NamedTuple):
    """Functions made from a `System`; gradients fill an array, and `acc` and `jacobian` are None if there are none.

    `jacobian` is the Jacobian of the accelerations times a vector. `invariants` holds (value, gradient) for each, and
    `balances` (value, gradient, rate).
    """

    rhs: Callable[..., None]
    acc: Callable[..., np.ndarray] | None
    jacobian: Deferred | None
    invariants: tuple[tuple[Callable[..., float], Callable[..., None]], ...]
    balances: tuple[tuple[Callable[..., float], Callable[..., None], Callable[..., float]], ...]


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class SymbolicProblem(Problem):
    """A `Problem` written as expressions.

    It has no start and no interval. Pass these to the run, or make a problem that has them:
    ``dataclasses.replace(problem, y0=np.array([...]), t_span=(0.0, 100.0))``.

    Attributes
    ----------
    system : System
        The names ``components`` and ``parameters``; ``rates``, the time derivatives; ``invariants``, pairs of name and
        expression; ``balances``, triples of name, expression and rate. All are SymPy expressions in real symbols.
    checks : mapping
        How each invariant was shown to be conserved: "by construction", "symbolically" or "numerically, at 8 points".
    pairs : tuple of (str, str)
        Coordinates and their momenta, if the system is canonical.
    """

    system: System
    checks: Mapping[str, str]
    pairs: tuple[tuple[str, str], ...] = ()

    @property
    def parameters(self) -> dict[str, float]:
        """Return the values of the parameters by name."""
        values = [] if self.params is None else self.params.tolist()
        return dict(zip(self.system.parameters, values, strict=True))

    def second_order(self) -> SymbolicProblem:
        """Return the problem in (q, v) with v = q', as Nystrom methods need it, if H is p W p / 2 + V(t, q).

        Returns
        -------
        SymbolicProblem
            A problem without start and interval. The velocity of a coordinate ``x`` is called ``v_x``.

        Raises
        ------
        ValueError
            If q' is not a constant invertible matrix W times p, p' depends on p, or the state does not consist of pairs
            of coordinates and momenta.
        """
        names, rates = self.system.components, self.system.rates
        half, W = len(self.pairs), self._kinetic()
        if W is None:
            raise ValueError(
                f"{self.name}: second_order needs q' = W p, p' = a(t, q) with an invertible constant matrix W, for a "
                f"state of coordinates and momenta (q, p), but the equations are {_cut(rates)}."
            )
        q, p = names[:half], [symbol(item) for item in names[half:]]
        new = as_names("the state", (*q, *(f"v_{item}" for item in q)))
        v = sympy.Matrix([symbol(item) for item in new[half:]])
        momenta = dict(zip(p, W.inv() * v, strict=True))
        kept = tuple((label, item.xreplace(momenta)) for label, item in self.system.invariants)
        slow = tuple((label, item.xreplace(momenta), r.xreplace(momenta)) for label, item, r in self.system.balances)
        rates = (*v, *(W * sympy.Matrix(rates[half:])))
        system = System(new, self.system.parameters, rates, kept, slow, self.system.constraints)
        return _problem(
            name=self.name,
            system=system,
            params=self.params,
            checks=self.checks,
            invariants=_invariants(system, self.params),
        )

    @property
    def has_second_order(self) -> bool:
        """Return True if `second_order` returns a problem."""
        return self._kinetic() is not None

    def _kinetic(self) -> Any:
        """Return the matrix W of q' = W p if it is constant and invertible and p' is free of p, otherwise None."""
        names, rates, half = self.system.components, self.system.rates, len(self.pairs)
        p = [symbol(item) for item in names[half:]]
        if half == 0 or len(names) != 2 * half or any(rate.has(*p) for rate in rates[half:]):
            return None
        W = sympy.Matrix(rates[:half]).jacobian(p)
        if W.has(*(symbol(item) for item in (*names, "t"))) or W.det() == 0:
            return None
        rest = sympy.Matrix(rates[:half]) - W * sympy.Matrix(p)
        return W if all(map(vanishes, rest)) else None

    def __repr__(self) -> str:
        pairs = ", ".join(f"{q} with {p}" for q, p in self.pairs)
        constraints = self.system.constraints
        kept = [
            f"{name} = {_cut(expression)}{' = 0' * (name in constraints)} ({self.checks[name]})"
            for name, expression in self.system.invariants
        ]
        rates = [f"{k}' = {_cut(f)}" for k, f in zip(self.system.components, self.system.rates, strict=True)]
        lines = [
            f"{self.name}: y = ({', '.join(self.system.components)})" + (f", pairs {pairs}" if pairs else ""),
            f"  equations   {_cut('; '.join(rates), 400)}",
            f"  invariants  {'; '.join(kept) or 'none'}",
            *(f"  balance     {name} = {_cut(F)}, at the rate {_cut(rate)}" for name, F, rate in self.system.balances),
            f"  parameters  {', '.join(f'{k} = {v:g}' for k, v in self.parameters.items()) or 'none'}",
            f"  functions   {'jitted by Numba' if is_jitted(self.rhs) else 'plain Python'}",
        ]
        return "\n".join(lines)

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the content of a pickle: the expressions, from which loading makes the functions again."""
        functions = _functions(self.system)
        own = [fun for fun, *_ in (*functions.invariants, *functions.balances)]
        kept = [own.index(item.function) if item.function in own else item for item in self.invariants]
        left = {"fun", "rhs", "acc", "jacobian", "variational", "invariants"}
        return _again, (kept, {item.name: getattr(self, item.name) for item in fields(self) if item.name not in left})


def _again(kept: Sequence[Any], others: dict[str, Any]) -> SymbolicProblem:
    own = _invariants(others["system"], others["params"])
    return _problem(invariants=tuple(own[item] if isinstance(item, int) else item for item in kept), **others)


def hamiltonian_problem(
    H: Any,
    q: Any,
    p: Any,
    params: Any,
    invariants: Any,
    name: str | None,
    poisson: Any,
    extended: bool,
    perturbed: Perturbed,
) -> SymbolicProblem:
    """Return the problem of a Hamiltonian; see `hamiltonian`."""
    values = parameter_values(params)
    declared = {*values, *(name for given in (q, p) if given is not None for name in as_names("q and p", given))}
    energy = as_expression("H", H, declared)
    names, flow, pairs = _canonical(energy, q, p, values) if poisson is None else _lie(q, p, poisson, declared)
    rates = flow(energy)
    if not energy.has(*map(symbol, names)):
        raise ValueError(f"hamiltonian: H = {_cut(energy)} does not depend on {', '.join(names)}.")
    if perturbed.given:
        if extended:
            raise ValueError(
                "hamiltonian: extended=True keeps H + p_t, which a perturbation or dissipation changes; omit "
                "extended=True, or perturbation= and dissipation=."
            )
        rates, slow = _with_perturbation(energy, names, rates, values, declared, perturbed, flow)
        return _checked("H", name or "hamiltonian", names, rates, values, {}, Further(invariants), pairs, slow)
    kept = {"H": energy}
    time = symbol("t")
    if energy.has(time) and extended:
        names, rates = (*names, "p_t"), (*rates, -sympy.diff(energy, time))
        kept = {"H + p_t": energy + symbol("p_t")}
    elif energy.has(time):
        warnings.warn(
            "H depends on t, so that it is not an invariant, and the problem does not keep it. "
            "hamiltonian(..., extended=True) adds p_t with p_t' = -dH/dt to the state and keeps H + p_t.",
            UserWarning,
            stacklevel=3,
        )
        kept = {}
    return _checked("H", name or "hamiltonian", names, rates, values, kept, Further(invariants), pairs)


class Further(NamedTuple):
    """Arguments of `hamiltonian` and `equations`: expressions by name that are conserved, and that are 0, or None."""

    invariants: Any
    constraints: Any = None


class Perturbed(NamedTuple):
    """Arguments of `hamiltonian` for a perturbed system: a second Hamiltonian, dissipation, and balances."""

    perturbation: Any
    dissipation: Any
    balances: Any

    @property
    def given(self) -> bool:
        """Return True if a perturbation or dissipation is given; raise TypeError if only balances are given."""
        if self.perturbation is None and self.dissipation is None:
            if self.balances is not None:
                raise TypeError(
                    "hamiltonian: balances are given without a perturbation or dissipation. Integrals of H alone are "
                    "invariants; give them as invariants=."
                )
            return False
        return True


def _with_perturbation(
    energy: Any,
    names: Sequence[str],
    rates: Sequence[Any],
    values: Mapping[str, float],
    declared: set[str],
    perturbed: Perturbed,
    flow: Callable[[Any], tuple[Any, ...]],
) -> tuple[tuple[Any, ...], tuple[tuple[str, Any, Any], ...]]:
    """Return the derivatives of the perturbed system, and its balances (name, expression, rate).

    Balances are quantities that the system of H alone (`energy`, with the derivatives `rates` of the components
    `names`) conserves, with their rates of change due to the perturbation and the dissipation. ``flow(expression)``
    returns the derivatives that belong to another Hamiltonian. Names in `declared` are not read as constants or
    functions.
    """
    if energy.has(symbol("t")):
        raise ValueError(
            "hamiltonian: H depends on t, so that it is not an integral; move such terms to perturbation=."
        )
    known = {*names, *values, "t"}
    added = [sympy.Integer(0)] * len(names)
    if perturbed.perturbation is not None:
        extra = as_expression("perturbation", perturbed.perturbation, declared | set(names))
        _require_known("perturbation", extra, known)
        added = list(flow(extra))
    given = {} if perturbed.dissipation is None else perturbed.dissipation
    if not isinstance(given, Mapping):
        raise TypeError(f"dissipation must be a mapping of components to expressions, got {shown(given)}.")
    for component, item in zip(as_names("the keys of dissipation", list(given)), given.values(), strict=True):
        if component not in names:
            raise ValueError(f"dissipation: {component} is not a component of the state ({', '.join(names)}).")
        force = as_expression(f"dissipation of {component}", item, declared | set(names))
        _require_known(f"dissipation of {component}", force, known)
        added[list(names).index(component)] += force
    variables, parameters = [symbol(item) for item in names], {symbol(k): v for k, v in values.items()}
    slow = []
    for label, item in ({"H": energy} if perturbed.balances is None else dict(perturbed.balances)).items():
        quantity = as_expression(f"balance {label!r}", item, declared | set(names))
        _require_known(f"balance {label!r}", quantity, known)
        how_kept(label, quantity, variables, rates, parameters)  # checked without the perturbation
        rate = sympy.Add(*(slope(quantity, y) * f for y, f in zip(variables, added, strict=True)))
        slow.append((label, quantity, rate))
    return tuple(a + b for a, b in zip(rates, added, strict=True)), tuple(slow)


def equations_problem(
    f: Any, y: Any, params: Any, invariants: Any, constraints: Any, name: str | None
) -> SymbolicProblem:
    """Return the problem y' = f(t, y); see `equations`."""
    timed = Timed(f, y)
    values = parameter_values(params)
    declared = {*timed.names, *values}
    rates = tuple(
        as_expression(f"the derivative of {k}", item, declared)
        for k, item in zip(timed.names, timed.values, strict=True)
    )
    given = [
        {key: timed(item) for key, item in items.items()} if isinstance(items, Mapping) else items
        for items in (invariants, constraints)
    ]
    return _checked("f", name or "equations", timed.names, rates, values, {}, Further(*given), ())


def _canonical(energy: Any, q: Any, p: Any, values: Mapping[str, float]) -> tuple[Any, Any, Any]:
    """Return the names of the components, a function that returns (dH/dp, -dH/dq) of H, and the pairs of names.

    If neither q nor p is given, the pairs are found from the names in H that are not keys of `values`.
    """
    if q is None and p is None:
        q, p = paired({item.name for item in energy.free_symbols} - {"t", *values})
    elif q is None or p is None:
        raise TypeError("hamiltonian: give both q and p, or neither; with poisson=, give the whole state as q.")
    q, p = as_names("q", q), as_names("p", p)
    if len(q) != len(p) or not q:
        raise ValueError(
            f"hamiltonian: {len(q)} coordinates ({', '.join(q)}) but {len(p)} momenta ({', '.join(p)}); expected a "
            "momentum for each coordinate, and at least one pair."
        )
    names = as_names("q and p", (*q, *p))

    def flow(H: Any) -> tuple[Any, ...]:
        forward = [slope(H, symbol(item)) for item in p]
        return (*forward, *(-slope(H, symbol(item)) for item in q))

    return names, flow, tuple(zip(q, p, strict=True))


def _lie(y: Any, p: Any, poisson: Any, declared: set[str]) -> tuple[Any, Any, Any]:
    """Return the names of the components, a function that returns B(y) grad H for B = `poisson`, and no pairs."""
    if y is None or p is not None:
        raise TypeError("hamiltonian: with poisson= give the names of the whole state as q, and omit p.")
    names = as_names("q", y)
    rows = poisson.tolist() if hasattr(poisson, "tolist") else [list(row) for row in poisson]
    n = len(names)
    if len(rows) != n or any(len(row) != n for row in rows):
        raise ValueError(f"hamiltonian: poisson must have the shape ({n}, {n}), for {', '.join(names)}.")
    B = sympy.Matrix(n, n, lambda i, j: as_expression(f"poisson[{i}][{j}]", rows[i][j], declared))
    for i, j in product(range(n), repeat=2):
        total = B[i, j] + B[j, i]
        if not vanishes(total):
            raise ValueError(f"hamiltonian: poisson must be antisymmetric, but [{i}][{j}] + [{j}][{i}] = {total}.")

    def flow(H: Any) -> tuple[Any, ...]:
        return tuple(B * sympy.Matrix([slope(H, symbol(item)) for item in names]))

    return names, flow, ()


def _checked(
    what: str,
    name: str,
    names: Any,
    rates: Any,
    values: Any,
    kept: Any,
    given: Further,
    pairs: Any,
    slow: tuple[tuple[str, Any, Any], ...] = (),
) -> SymbolicProblem:
    """Return the problem after checks of the names and of the `given` invariants and constraints.

    `kept` maps the names of invariants by construction to their expressions. `slow` holds the balances as in `System`.
    `what` is the user's argument with the equations, "H" or "f".
    """
    if not isinstance(name, str):
        raise TypeError(f"name must be a string, got {shown(name)}.")
    for kind, items in given._asdict().items():
        if items is not None and not isinstance(items, Mapping):
            raise TypeError(f"{kind} must be a mapping of names to expressions, got {shown(items)}.")
    further, constraints = given.invariants or {}, given.constraints or {}
    both = [item for item in names if item in values]
    if both:
        raise ValueError(f"{both[0]} is the name of a component of the state and of a parameter; rename one.")
    parameters = {symbol(item): value for item, value in values.items()}
    known = {*names, *values, "t"}
    for rate in rates:
        _require_known(what, rate, known)
    for label in constraints:
        if label in further:
            raise ValueError(f"{label!r} is the name of a constraint and of an invariant; rename or omit one of them.")
    quantities = {}
    for label, item in (*constraints.items(), *further.items()):
        if not isinstance(label, str):
            raise TypeError(f"invariants and constraints: names must be strings, got {shown(label)}.")
        if label in kept:
            raise ValueError(f"invariants: {label} is already the name of an invariant; choose another or omit it.")
        described = f"{'constraint' if label in constraints else 'invariant'} {label!r}"
        quantities[label] = quantity = as_expression(described, item, known)
        _require_known(described, quantity, known)
        if not quantity.has(*map(symbol, names)):
            raise ValueError(f"{described} is {_cut(quantity)}, which does not depend on {', '.join(names)}.")
    zero = {label: quantities[label] for label in constraints}
    manifold = Manifold(zero, names, rates, values) if zero else None
    checks = dict.fromkeys(kept, "by construction")
    for label, quantity in quantities.items():
        checks[label] = _how_kept(label, quantity, names, rates, parameters, manifold, HINT if what == "f" else "")
        kept[label] = quantity
    system = System(tuple(names), tuple(values), tuple(rates), tuple(kept.items()), slow, tuple(constraints))
    params = np.array(list(values.values())) if values else None
    return _problem(
        name=name, system=system, params=params, checks=checks, pairs=pairs, invariants=_invariants(system, params)
    )


def _how_kept(
    label: str, quantity: Any, names: Sequence[str], rates: Any, parameters: Any, manifold: Manifold | None, hint: str
) -> str:
    """Return how a quantity was shown to be conserved at all states, or else at those of the `manifold`.

    Without constraints `hint` is added to the message of the error.
    """
    try:
        return how_kept(label, quantity, [symbol(item) for item in names], rates, parameters)
    except NotKeptError as error:
        if manifold is None:
            raise (ValueError(f"{error} {hint}") if hint else error) from None
    return manifold.how_kept(label, quantity)


def _problem(*, system: System, params: np.ndarray | None, **others: Any) -> SymbolicProblem:
    functions = _functions(system)
    rhs = functions.rhs
    unset: dict[str, Any] = {"y0": None, "t_span": None}  # these are arguments of a run
    unset["component_names"] = system.components
    # A perturbed system may have friction, so that it does not count as canonical.
    unset["canonical"] = 2 * len(others.get("pairs", ())) == len(system.components) and not system.balances
    return SymbolicProblem(
        **(unset | others),
        system=system,
        params=params,
        fun=bind(rhs, params),
        rhs=rhs,
        acc=functions.acc,
        jacobian=functions.jacobian,
        variational=partial(_variational, system),
    )


def _invariants(system: System, params: np.ndarray | None) -> tuple[Invariant, ...]:
    args = () if params is None else (params,)
    functions = _functions(system)
    kept = [
        Invariant(fun, grad, target=0.0 if name in system.constraints else None, args=args, in_place=True, name=name)
        for (name, _), (fun, grad) in zip(system.invariants, functions.invariants, strict=True)
    ]
    slow = [
        Balance(fun, rate, grad, args=args, in_place=True, name=name)
        for (name, _, _), (fun, grad, rate) in zip(system.balances, functions.balances, strict=True)
    ]
    return (*kept, *slow)


@lru_cache(maxsize=64)
def _functions(system: System) -> Functions:
    """Return the compiled functions of a system."""
    arguments = Arguments(system.components, system.parameters)
    rhs = function("derivative", system.rates, arguments, in_place=True)

    def value_and_gradient(name: str, quantity: Any) -> tuple[Callable[..., float], Callable[..., None]]:
        gradient = [slope(quantity, variable) for variable in system.variables]
        value = function(f"invariant {name}", [quantity], arguments, in_place=False)
        return value, function(f"gradient of {name}", gradient, arguments, in_place=True)

    invariants = tuple(value_and_gradient(name, quantity) for name, quantity in system.invariants)
    balances = tuple(
        (*value_and_gradient(name, quantity), function(f"rate of {name}", [rate], arguments, in_place=False))
        for name, quantity, rate in system.balances
    )
    return Functions(rhs, _acceleration(system), _deferred_jacobian(system), invariants, balances)


def _acceleration(system: System) -> Callable[..., np.ndarray] | None:
    found = system.accelerations
    if found is None:
        return None
    half = len(found)
    fill = function("acceleration", found, Arguments(system.components[:half], system.parameters), in_place=True)
    return vector(fill, half)


def _deferred_jacobian(system: System) -> Deferred | None:
    """Return the Jacobian of the accelerations times a vector, which is made when it is called.

    Return None if the system is not of the form q'' = a(t, q), is too large, or has accelerations that jump.
    """
    found = system.accelerations
    if found is None or len(found) > LARGEST_JACOBIAN:
        return None
    if any(a.has(sympy.sign, sympy.Heaviside) for a in found):  # derivatives of abs, max and min
        return None
    return Deferred(partial(_jacobian, system))


@lru_cache(maxsize=64)
def _jacobian(system: System) -> Callable[..., None]:
    found = system.accelerations
    assert found is not None
    names = system.components[: len(found)]
    along = [f"d {name}" for name in names]  # no component can have such a name
    pairs = [(symbol(q), symbol(d)) for q, d in zip(names, along, strict=True)]
    rows = [sympy.Add(*(sympy.diff(a, q) * d for q, d in pairs)) for a in found]
    return function("Jacobian", rows, Arguments(names, system.parameters, along), in_place=True)


def _variational(system: System, parameters: tuple[int, ...]) -> Callable[..., None]:
    """Return the equations of a state and of columns of derivatives, the last ones by `parameters` (indices)."""
    for k in parameters:
        if not 0 <= k < len(system.parameters):
            raise ValueError(
                f"variational: there is no parameter {k}; expected indices of ({', '.join(system.parameters)})."
            )
    return _with_columns(system, tuple(map(int, parameters)))


@lru_cache(maxsize=64)
def _with_columns(system: System, parameters: tuple[int, ...]) -> Callable[..., None]:
    def nonzero(by: Any) -> dict[int, Any]:
        found = {i: slope(rate, by) for i, rate in enumerate(system.rates)}
        for i, item in found.items():
            if impulses := sorted(item.atoms(sympy.DiracDelta), key=str):
                raise ValueError(
                    f"variational: the derivative of {system.components[i]} jumps where {_cut(impulses[0].args[0])} is "
                    "0, or is not seen to be continuous there; at a jump derivatives of the state do not follow from "
                    "derivatives of the equations. Use a continuous expression."
                )
        return {i: item for i, item in found.items() if item != 0}

    columns = [nonzero(variable) for variable in system.variables]
    jacobian = {(i, j): item for j, column in enumerate(columns) for i, item in column.items()}
    added = [nonzero(symbol(system.parameters[k])) for k in parameters]
    arguments = Arguments(system.components, system.parameters)
    return variational_function("variational equations", system.rates, jacobian, added, arguments)


def parameter_values(params: Any) -> dict[str, float]:
    """Return the parameters as a mapping of names to floats; raise an error if one is not a finite number."""
    if params is None:
        return {}
    if not isinstance(params, Mapping):
        raise TypeError(f"params must be a mapping of names to values, got {shown(params)}.")
    names = as_names("the keys of params", list(params))
    for name, value in zip(names, params.values(), strict=True):
        is_constant = isinstance(value, sympy.Expr) and reals("params", value) is not None
        if not ((is_number(value) or is_constant) and math.isfinite(value)):
            raise ValueError(f"params: {name} must be a finite number, got {shown(value)}.")
    return dict(zip(names, map(float, params.values()), strict=True))


def _require_known(what: str, expression: Any, known: set[str]) -> None:
    unknown = sorted({item.name for item in expression.free_symbols} - known)
    if unknown:
        raise ValueError(
            f"{what} contains {unknown[0]}, which is neither a component of the state nor a parameter. Give its value, "
            f"params={{{unknown[0]!r}: ...}}. Known names are {', '.join(sorted(known))}."
        )


def _cut(expression: Any, length: int = 100) -> str:
    text = str(expression)
    return text if len(text) <= length else f"{text[:length]}..."
