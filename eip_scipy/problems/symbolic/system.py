"""Construction of a `Problem` from expressions."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
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
from .brackets import Equations, NotConservedError, derivative, shortened, vanishes
from .pairs import paired, without_derivatives
from .parser import as_expression, as_mapping, as_names, symbol
from .program import Arguments, function, variational

__all__ = ["SymbolicProblem", "equations_problem", "hamiltonian_problem", "parameter_values", "value_and_gradient"]

LARGEST_JACOBIAN = 16  # number of coordinates; the Jacobian has its square of entries


class System(NamedTuple):
    """Equations, their invariants (name, expression) and balances (name, expression, rate).

    `constraints` has the names of the invariants that are 0.
    """

    components: tuple[str, ...]
    parameters: tuple[str, ...]
    rates: tuple[Any, ...]
    invariants: tuple[tuple[str, Any], ...]
    balances: tuple[tuple[str, Any, Any], ...] = ()
    constraints: tuple[str, ...] = ()

    @property
    def arguments(self) -> Arguments:
        """Return the arguments of functions of the system."""
        return Arguments(self.components, self.parameters)

    @property
    def accelerations(self) -> tuple[Any, ...]:
        """Return a of q'' = a(t, q) if the equations have this form for a state (q, q'); otherwise ()."""
        half = len(self.components) // 2
        velocities, found = [symbol(name) for name in self.components[half:]], self.rates[half:]
        is_second_order = list(self.rates[:half]) == velocities and not any(rate.has(*velocities) for rate in found)
        return found if is_second_order else ()


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
        return dict(zip(self.system.parameters, [] if self.params is None else self.params.tolist(), strict=True))

    def second_order(self) -> SymbolicProblem:
        """Return the problem in (q, v) with v = q', as Nystrom methods need it, if H is p W p / 2 + V(t, q).

        The velocity of a coordinate ``x`` is called ``v_x``. A ValueError is raised if q' is not a constant invertible
        matrix W times p, p' depends on p, or the state does not consist of pairs of coordinates and momenta.
        """
        names, rates, half, W = self.system.components, self.system.rates, len(self.pairs), self._inverse_mass_matrix()
        if W is None:
            raise ValueError(
                f"{self.name}: second_order needs q' = W p, p' = a(t, q) with an invertible constant matrix W, for a "
                f"state of coordinates and momenta (q, p), but the equations are {shortened(rates)}."
            )
        new = as_names("the state", (*names[:half], *(f"v_{item}" for item in names[:half])))
        v = sympy.Matrix([symbol(item) for item in new[half:]])
        momenta = dict(zip(map(symbol, names[half:]), W.inv() * v, strict=True))
        kept, slow = (
            tuple((label, *(item.xreplace(momenta) for item in items)) for label, *items in given)
            for given in (self.system.invariants, self.system.balances)
        )
        rates = (*v, *(W * sympy.Matrix(rates[half:])))
        system = System(new, self.system.parameters, rates, kept, slow, self.system.constraints)
        return _problem(self.name, system, self.params, self.checks)

    @property
    def has_second_order(self) -> bool:
        """Return True if `second_order` returns a problem."""
        return self._inverse_mass_matrix() is not None

    def _inverse_mass_matrix(self) -> Any:
        """Return the matrix W of q' = W p if it is constant and invertible and p' is free of p, otherwise None."""
        names, rates, half = self.system.components, self.system.rates, len(self.pairs)
        p = [symbol(item) for item in names[half:]]
        if half == 0 or len(names) != 2 * half or any(rate.has(*p) for rate in rates[half:]):
            return None
        W = sympy.Matrix(rates[:half]).jacobian(p)
        if W.has(*map(symbol, (*names, "t"))) or W.det() == 0:
            return None
        return W if all(map(vanishes, sympy.Matrix(rates[:half]) - W * sympy.Matrix(p))) else None

    def __repr__(self) -> str:
        system, pairs = self.system, ", ".join(f"{q} with {p}" for q, p in self.pairs)
        rates = "; ".join(f"{k}' = {shortened(f)}" for k, f in zip(system.components, system.rates, strict=True))
        kept = "; ".join(
            f"{name} = {shortened(expression)}{' = 0' * (name in system.constraints)} ({self.checks[name]})"
            for name, expression in system.invariants
        )
        lines = [
            f"{self.name}: y = ({', '.join(system.components)}){f', pairs {pairs}' if pairs else ''}",
            f"  equations   {shortened(rates, 400)}",
            f"  invariants  {kept or 'none'}",
            *(
                f"  balance     {name} = {shortened(F)}, at the rate {shortened(rate)}"
                for name, F, rate in system.balances
            ),
            f"  parameters  {', '.join(f'{k} = {v:g}' for k, v in self.parameters.items()) or 'none'}",
            f"  functions   {'jitted by Numba' if is_jitted(self.rhs) else 'plain Python'}",
        ]
        return "\n".join(lines)

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the content of a pickle: the expressions, from which loading makes the functions again."""
        own = [item.function for item in _invariants(self.system, self.params)]
        kept = [own.index(item.function) if item.function in own else item for item in self.invariants]
        others = {item.name: getattr(self, item.name) for item in fields(self) if item.name not in REMADE}
        return _again, (kept, others)


# Attributes that are made from the expressions.
REMADE = {"fun", "rhs", "acc", "jacobian", "variational", "invariants"}


def _again(kept: Sequence[Any], others: dict[str, Any]) -> SymbolicProblem:
    own = _invariants(others["system"], others["params"])
    return _problem(**others, invariants=tuple(own[item] if isinstance(item, int) else item for item in kept))


def hamiltonian_problem(
    H: Any, q: Any, p: Any, *, poisson: Any, extended: bool, added: Any, params: Any, invariants: Any, name: str | None
) -> SymbolicProblem:
    """Return the problem of a Hamiltonian; see `hamiltonian`. `added`: a perturbation, dissipation and balances."""
    values = parameter_values(params)
    declared = {*values, *(item for given in (q, p) if given is not None for item in as_names("q and p", given))}
    energy, time = as_expression("H", H, declared), symbol("t")
    if poisson is None:
        names, pairs, B = _canonical_structure(energy, q, p, values)
    else:
        names, pairs, B = _poisson_structure(q, p, poisson, declared)
    scope = _Scope(names, values)
    scope.read_quantity("H", energy)

    def vector_field(F: Any) -> tuple[Any, ...]:
        return tuple(B * sympy.Matrix([derivative(F, symbol(item)) for item in names]))

    rates, kept, slow = vector_field(energy), {"H": energy}, tuple[Any, ...]()
    perturbation, dissipation, balances = added
    if perturbation is not None or dissipation is not None:
        if extended:
            raise ValueError(
                "hamiltonian: extended=True keeps H + p_t, which a perturbation or dissipation changes; omit "
                "extended=True, or perturbation= and dissipation=."
            )
        if energy.has(time):
            raise ValueError(
                "hamiltonian: H depends on t, so that it is not an integral; move such terms to perturbation=."
            )
        change = scope.added_rates(vector_field, perturbation, dissipation)
        slow = tuple(scope.balances(kept if balances is None else as_mapping("balances", balances), rates, change))
        rates, kept = tuple(a + b for a, b in zip(rates, change, strict=True)), {}
    elif balances is not None:
        raise TypeError(
            "hamiltonian: balances are given without a perturbation or dissipation. Integrals of H alone are "
            "invariants; give them as invariants=."
        )
    elif energy.has(time) and extended:
        scope, rates = _Scope((*names, "p_t"), values), (*rates, -sympy.diff(energy, time))
        kept = {"H + p_t": energy + symbol("p_t")}
    elif energy.has(time):
        kept = {}
        warnings.warn(
            "H depends on t, so that it is not an invariant, and the problem does not keep it. "
            "hamiltonian(..., extended=True) adds p_t with p_t' = -dH/dt to the state and keeps H + p_t.",
            stacklevel=3,
        )
    return scope.problem(name or "hamiltonian", rates, kept, invariants, None, slow, pairs)


def equations_problem(
    f: Any, y: Any, params: Any, invariants: Any, constraints: Any, name: str | None
) -> SymbolicProblem:
    """Return the problem y' = f(t, y); see `equations`."""
    names, rates, (invariants, constraints) = without_derivatives(f, y, invariants, constraints)
    scope = _Scope(names, parameter_values(params))
    rates = [scope.read(f"the derivative of {k}", item) for k, item in zip(names, rates, strict=True)]
    try:
        return scope.problem(name or "equations", rates, {}, invariants, constraints)
    except NotConservedError as error:
        hint = "" if constraints else " If it is conserved only if constraints hold, pass them as constraints=."
        raise NotConservedError(f"{error}{hint}") from None


def _canonical_structure(energy: Any, q: Any, p: Any, values: Mapping[str, float]) -> tuple[Any, Any, Any]:
    """Return the names of the components (q, p), the pairs of names, and the matrix B of y' = B grad H.

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
    zero, one = sympy.zeros(len(q)), sympy.eye(len(q))
    return as_names("q and p", (*q, *p)), tuple(zip(q, p, strict=True)), sympy.Matrix([[zero, one], [-one, zero]])


def _poisson_structure(y: Any, p: Any, poisson: Any, declared: set[str]) -> tuple[Any, Any, Any]:
    """Return the names of the components, no pairs, and the matrix B of y' = B grad H."""
    if y is None or p is not None:
        raise TypeError("hamiltonian: with poisson= give the names of the whole state as q, and omit p.")
    names = as_names("q", y)
    rows = poisson.tolist() if hasattr(poisson, "tolist") else [list(row) for row in poisson]
    n = len(names)
    if len(rows) != n or any(len(row) != n for row in rows):
        raise ValueError(f"hamiltonian: poisson must have the shape ({n}, {n}), for {', '.join(names)}.")
    B = sympy.Matrix(n, n, lambda i, j: as_expression(f"poisson[{i}][{j}]", rows[i][j], declared))
    for i, j in product(range(n), repeat=2):
        if not vanishes(total := B[i, j] + B[j, i]):
            raise ValueError(f"hamiltonian: poisson must be antisymmetric, but [{i}][{j}] + [{j}][{i}] = {total}.")
    return names, (), B


class _Scope:
    """Names that expressions of a problem may contain: `components`, and parameters with their `values`."""

    def __init__(self, components: Sequence[str], values: Mapping[str, float]) -> None:
        self.components, self.values = tuple(components), values
        for item in components:
            if item in values:
                raise ValueError(f"{item} is the name of a component of the state and of a parameter; rename one.")

    def read(self, what: str, given: Any) -> Any:
        """Return text or an expression as an expression; raise ValueError if it contains an unknown name."""
        expression = as_expression(what, given, {*self.components, *self.values})
        known = {*self.components, *self.values, "t"}
        if unknown := sorted({item.name for item in expression.free_symbols} - known):
            raise ValueError(
                f"{what} contains {unknown[0]}, which is neither a component of the state nor a parameter. Give its "
                f"value, params={{{unknown[0]!r}: ...}}. Known names are {', '.join(sorted(known))}."
            )
        return expression

    def read_quantity(self, what: str, given: Any) -> Any:
        """Return an expression that depends on the state."""
        expression = self.read(what, given)
        if not expression.has(*map(symbol, self.components)):
            raise ValueError(
                f"{what} is {shortened(expression)}, which does not depend on {', '.join(self.components)}."
            )
        return expression

    def added_rates(self, vector_field: Callable[[Any], Any], perturbation: Any, dissipation: Any) -> list[Any]:
        """Return the parts of y' that are due to a perturbation and dissipation."""
        extra = self.read("perturbation", 0 if perturbation is None else perturbation)
        added, given = list(vector_field(extra)), as_mapping("dissipation", dissipation)
        for name, item in zip(as_names("the keys of dissipation", list(given)), given.values(), strict=True):
            if name not in self.components:
                raise ValueError(f"dissipation: {name} is not a component of the state ({', '.join(self.components)}).")
            added[self.components.index(name)] += self.read(f"dissipation of {name}", item)
        return added

    def balances(self, given: Mapping[str, Any], rates: Any, added: Any) -> Iterator[tuple[str, Any, Any]]:
        """Yield the names, expressions and rates of integrals of y' = `rates` that change because of `added`."""
        equations = Equations(self.components, rates, self.values)
        for label, item in given.items():
            quantity = self.read(f"balance {label!r}", item)
            equations.check_conserved(label, quantity)
            terms = (derivative(quantity, symbol(y)) * f for y, f in zip(self.components, added, strict=True))
            yield label, quantity, sympy.Add(*terms)

    def problem(
        self, name: Any, rates: Any, kept: Any, invariants: Any, constraints: Any, balances: Any = (), pairs: Any = ()
    ) -> SymbolicProblem:
        """Return the problem after checks of invariants and constraints; `kept` has invariants by construction."""
        if not isinstance(name, str):
            raise TypeError(f"name must be a string, got {shown(name)}.")
        invariants, constraints = as_mapping("invariants", invariants), as_mapping("constraints", constraints)
        quantities = {}
        for label, item in (*constraints.items(), *invariants.items()):
            if not isinstance(label, str):
                raise TypeError(f"invariants and constraints: names must be strings, got {shown(label)}.")
            if label in kept:
                raise ValueError(f"invariants: {label} is already the name of an invariant; choose another or omit it.")
            if label in quantities:
                raise ValueError(f"{label!r} is the name of a constraint and of an invariant; rename or omit one.")
            what = f"{'constraint' if label in constraints else 'invariant'} {label!r}"
            quantities[label] = self.read_quantity(what, item)
        zero = {label: quantities[label] for label in constraints}
        equations = Equations(self.components, rates, self.values, zero)
        checks = dict.fromkeys(kept, "by construction")
        checks |= {label: equations.check_conserved(label, quantity) for label, quantity in quantities.items()}
        every = (*kept.items(), *quantities.items())
        system = System(self.components, tuple(self.values), tuple(rates), every, tuple(balances), tuple(zero))
        params = np.array(list(self.values.values())) if self.values else None
        return _problem(name, system, params, checks, pairs=pairs)


def _problem(
    name: str, system: System, params: np.ndarray | None, checks: Mapping[str, str], **others: Any
) -> SymbolicProblem:
    rhs = function("derivative", system.rates, system.arguments)
    acc, half = system.accelerations, len(system.accelerations)
    # The derivatives of abs, max and min jump.
    is_smooth = 0 < half <= LARGEST_JACOBIAN and not any(a.has(sympy.sign, sympy.Heaviside) for a in acc)
    unset = {
        "y0": None, "t_span": None,  # arguments of a run
        "component_names": system.components, "invariants": _invariants(system, params),
        # A perturbed system may have friction, so that it does not count as canonical.
        "canonical": 2 * len(others.get("pairs", ())) == len(system.components) and not system.balances,
    }  # fmt: skip
    arguments = Arguments(system.components[:half], system.parameters)
    made = {
        "name": name, "system": system, "params": params, "checks": checks, "fun": bind(rhs, params), "rhs": rhs,
        "acc": vector(function("acceleration", acc, arguments), half) if half else None,
        "jacobian": Deferred(partial(_jacobian, system)) if is_smooth else None,
        "variational": partial(_variational, system),
    }  # fmt: skip
    return SymbolicProblem(**(unset | others | made))


def value_and_gradient(name: str, quantity: Any, arguments: Arguments) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Return the functions of a quantity, its value and its gradient, which fills an array."""
    gradient = tuple(derivative(quantity, symbol(item)) for item in arguments.y)
    value = function(f"invariant {name}", (quantity,), arguments, in_place=False)
    return value, function(f"gradient of {name}", gradient, arguments)


def _invariants(system: System, params: np.ndarray | None) -> tuple[Invariant, ...]:
    options: dict[str, Any] = {"args": () if params is None else (params,), "in_place": True}
    kept: list[Invariant] = []
    for name, quantity in system.invariants:
        target = 0.0 if name in system.constraints else None
        value, gradient = value_and_gradient(name, quantity, system.arguments)
        kept.append(Invariant(value, gradient, target=target, name=name, **options))
    for name, quantity, change in system.balances:
        value, gradient = value_and_gradient(name, quantity, system.arguments)
        rate = function(f"rate of {name}", (change,), system.arguments, in_place=False)
        kept.append(Balance(value, rate, gradient, name=name, **options))
    return tuple(kept)


def _jacobian(system: System) -> Callable[..., None]:
    """Return the Jacobian of the accelerations times a vector."""
    names = system.components[: len(system.accelerations)]
    along = tuple(f"d {name}" for name in names)  # no component can have such a name
    pairs = [(symbol(q), symbol(d)) for q, d in zip(names, along, strict=True)]
    rows = tuple(sympy.Add(*(sympy.diff(a, q) * d for q, d in pairs)) for a in system.accelerations)
    return function("Jacobian", rows, Arguments(names, system.parameters, along))


def _variational(system: System, parameters: Sequence[int]) -> Callable[..., None]:
    """Return the equations of a state and of columns of derivatives, the last ones by `parameters` (indices)."""
    known = system.parameters
    for k in parameters:
        if not 0 <= k < len(known):
            raise ValueError(f"variational: there is no parameter {k}; expected indices of ({', '.join(known)}).")
    columns = [_nonzero_slopes(system, name) for name in system.components]
    jacobian = tuple((i, j, item) for j, column in enumerate(columns) for i, item in column)
    by_parameters = tuple(_nonzero_slopes(system, known[k]) for k in parameters)
    return variational(system.rates, jacobian, by_parameters, system.arguments)


def _nonzero_slopes(system: System, name: str) -> tuple[tuple[int, Any], ...]:
    """Return the nonzero derivatives of the rates with respect to a component or parameter, as (row, expression)."""
    found = [derivative(rate, symbol(name)) for rate in system.rates]
    for component, item in zip(system.components, found, strict=True):
        if impulses := sorted(item.atoms(sympy.DiracDelta), key=str):
            raise ValueError(
                f"variational: the derivative of {component} jumps where {shortened(impulses[0].args[0])} is 0, or is "
                "not seen to be continuous there; at a jump derivatives of the state do not follow from derivatives of "
                "the equations. Use a continuous expression."
            )
    return tuple((i, item) for i, item in enumerate(found) if item != 0)


def parameter_values(params: Any) -> dict[str, float]:
    """Return the parameters as a mapping of names to floats; raise an error if one is not a finite number."""
    given = as_mapping("params", params)
    names = as_names("the keys of params", list(given))
    for name, value in zip(names, given.values(), strict=True):
        is_constant = isinstance(value, sympy.Expr) and reals("params", value) is not None
        if not ((is_number(value) or is_constant) and math.isfinite(value)):
            raise ValueError(f"params: {name} must be a finite number, got {shown(value)}.")
    return dict(zip(names, map(float, given.values()), strict=True))
