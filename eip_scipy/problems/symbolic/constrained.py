"""Mechanical systems with constraints as expressions, the functions compiled from them, and potentials of forces."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import sympy
from sympy.integrals.manualintegrate import manualintegrate

from ...core.jitted import compilable, compiled_like, is_jitted, jitted
from ..multibody.motion import new_floats, new_like
from ..multibody.parts import Energy, Outputs, Parts
from .brackets import slope
from .parser import symbol
from .program import Arguments, function

__all__ = [
    "Constrained",
    "acceleration",
    "at_rest",
    "conservative",
    "cyclic",
    "filling",
    "own_speed",
    "parts_of",
    "potential_of",
]

BRANCHES = (sympy.Piecewise, sympy.Abs, sympy.sign, sympy.Heaviside, sympy.Max, sympy.Min)


class Constrained(NamedTuple):
    """A system with the state (q, u): q' = `rates`, M u' + G^T lambda = F, and its constraints, all in real symbols.

    Equal systems share their compiled functions. `mass` is M by rows, and `rates` are linear in the speeds. `positions`
    and `velocities` are the expressions that constraints set to 0; the latter are linear in the speeds and include the
    derivatives of `positions`. `inputs` are names of quantities in the forces that functions ``f(t, y)`` compute.
    """

    coordinates: tuple[str, ...]
    speeds: tuple[str, ...]
    parameters: tuple[str, ...]
    rates: tuple[Any, ...]
    mass: tuple[Any, ...]
    forces: tuple[Any, ...]
    positions: tuple[Any, ...]
    velocities: tuple[Any, ...]
    inputs: tuple[tuple[str, Callable[..., float]], ...] = ()

    @property
    def arguments(self) -> Arguments:
        """Return the `Arguments` of the compiled functions: the components of the state and the parameters."""
        return Arguments((*self.coordinates, *self.speeds), self.parameters)

    @property
    def variables(self) -> list[Any]:
        """Return the symbols of the state."""
        return [symbol(name) for name in (*self.coordinates, *self.speeds)]

    def rate(self, expression: Any, accelerations: Sequence[Any] = ()) -> Any:
        """Return the derivative of an expression in time, with u' = `accelerations`, by default 0."""
        change = [*self.rates, *(accelerations or [0] * len(self.speeds))]
        terms = (sympy.diff(expression, x) * dx for x, dx in zip(self.variables, change, strict=True) if dx != 0)
        return sympy.Add(sympy.diff(expression, symbol("t")), *terms)

    def with_velocities(self) -> Constrained:
        """Return the system with the derivatives of `positions` in front of the other constraints on velocities."""
        return self._replace(velocities=(*map(self.rate, self.positions), *self.velocities))


def own_speed(system: Constrained, k: int) -> list[Any]:
    """Return the derivatives of all speeds with respect to q_k', the rate of coordinate k.

    The result is [] unless exactly one speed occurs in q_k', and this speed occurs in no other rate.
    """
    speeds = [symbol(name) for name in system.speeds]
    own = [u for u in speeds if u in system.rates[k].free_symbols]
    if len(own) != 1 or sum(own[0] in rate.free_symbols for rate in system.rates) != 1:
        return []
    slope = sympy.diff(system.rates[k], own[0])
    return [1 / slope if u == own[0] else sympy.Integer(0) for u in speeds]


def cyclic(system: Constrained, speeds_by_rate: Callable[[int], Sequence[Any]]) -> list[int]:
    """Return the indices of coordinates whose momenta may be constant, because masses and forces do not depend on them.

    ``speeds_by_rate(k)`` returns the derivatives (n,) of the speeds with respect to the rate of coordinate k, or [] if
    they are not known; the coordinate is then left out. A coordinate is also left out if exactly one speed depends on
    its rate and a constraint contains this speed, or if the force along it has branches or comes from a function,
    because such a force may be 0 only near the start.
    """
    known = set().union(*(item.free_symbols for item in (*system.mass, *system.forces)))
    inputs = {symbol(name) for name, _ in system.inputs}
    constrained = set().union(*(item.free_symbols for item in system.velocities))
    found = []
    for k, name in enumerate(system.coordinates):
        if symbol(name) in known:
            continue
        column = speeds_by_rate(k)
        parts = [u for u, part in zip(system.speeds, column, strict=True) if part != 0] if column else []
        if len(parts) == 1 and symbol(parts[0]) in constrained:
            continue
        along = [F for F, part in zip(system.forces, column, strict=True) if part != 0] if column else []
        unsure = any(F.has(*BRANCHES) or F.free_symbols & inputs for F in along)
        if along and not unsure:
            found.append(k)
    return found


def conservative(system: Constrained, active: Sequence[Any], speeds_by_rate: Callable[[int], Sequence[Any]]) -> Any:
    """Return the potential of the conservative part of the `active` forces (n,) on the speeds; None if there is none.

    Terms that depend on the time, on inputs, or on speeds are not conservative.
    """
    speeds = [symbol(name) for name in system.speeds]
    still = at_rest(active, speeds, {symbol("t"), *(symbol(name) for name, _ in system.inputs)})
    columns = [speeds_by_rate(k) for k in range(len(system.coordinates))]
    moved = [any(column and column[j] != 0 for column in columns) for j in range(len(speeds))]
    if all(F == 0 for F in still) or any(F != 0 and not known for F, known in zip(still, moved, strict=True)):
        return None
    forces = [sympy.Add(*(a * F for a, F in zip(column, still, strict=True))) if column else 0 for column in columns]
    return potential_of(list(map(sympy.sympify, forces)), [symbol(name) for name in system.coordinates])


def acceleration(speed: str) -> sympy.Symbol:
    """Return the symbol of the derivative of a speed."""
    return symbol(f"{speed}'")


def parts_of(
    system: Constrained,
    energies: Sequence[tuple[str, Any, Any]],
    momenta: Sequence[tuple[str, Any]] = (),
    outputs: Sequence[tuple[str, Any]] = (),
) -> Parts:
    """Return the compiled functions of a system as `Parts`.

    `energies` are descriptions and expressions of quantities that may be constant, and their rates or None. `momenta`
    and `outputs` are names and expressions; the latter may contain accelerations.
    """
    found = tuple(
        Energy(label, *energy_functions(item, system), None if rate is None else rate_function(rate, system))
        for label, item, rate in energies
    )
    return Parts(
        matrices(system),
        *values_and_gradient(system),
        found,
        momenta=tuple(Energy(name, *energy_functions(item, system)) for name, item in momenta),
        outputs=output_functions(tuple(outputs), system) if outputs else None,
        origin=(system, tuple(energies), tuple(momenta), tuple(outputs)),
    )


@lru_cache(maxsize=64)
def matrices(system: Constrained) -> Callable[..., None]:
    """Return `fill` of `motion`, which writes M, F, G, gamma and q'; G u' = -gamma keeps the constraints."""
    speeds = system.variables[len(system.coordinates) :]
    gradients = [sympy.diff(item, u) if item.has(u) else sympy.Integer(0) for item in system.velocities for u in speeds]
    gammas = map(system.rate, system.velocities)
    everything = (*system.mass, *system.forces, *gradients, *gammas, *system.rates)
    return _with_inputs(system, lambda arguments: filling("equations of motion", everything, arguments))


@lru_cache(maxsize=64)
def output_functions(outputs: tuple[tuple[str, Any], ...], system: Constrained) -> Outputs:
    """Return the `Outputs` with the compiled functions of the given pairs of name and expression."""
    accelerations = [acceleration(name).name for name in system.speeds]
    names, items = zip(*outputs, strict=True)
    return Outputs(names, _with_inputs(system, lambda given: filling("outputs", items, given), accelerations))


def _with_inputs(
    system: Constrained, made: Callable[[Arguments], Callable[..., None]], behind: Sequence[str] = ()
) -> Callable[..., None]:
    """Return ``fill(t, y, out, *params)``, where y holds the state and further values that are named in `behind`.

    `fill` appends the values of the inputs to y, and calls the function that `made` returns for the names of all
    values.
    """
    names = (*system.coordinates, *system.speeds, *behind, *(name for name, _ in system.inputs))
    fill = made(Arguments(names, system.parameters))
    for _, given in reversed(system.inputs):
        fill = _with_input(fill, given, len(system.variables))
    return fill


def _with_input(fill: Callable[..., None], function: Callable[..., float], n: int) -> Callable[..., None]:
    compiles = is_jitted(fill) and is_jitted(function)
    new = jitted(compilable(new_floats)) if compiles else new_like

    def wider(t, y, out, *params):
        state, given = new(y.size + 1, y), new(n, y)  # the function may change its argument
        for k in range(y.size):
            state[k] = y[k]
        for k in range(n):
            given[k] = y[k]
        state[y.size] = function(t, given)
        fill(t, state, out, *params)

    return compiled_like(wider, fill, function)


@lru_cache(maxsize=64)
def values_and_gradient(system: Constrained) -> tuple[Callable[..., None], Callable[..., None]]:
    """Return two functions that fill an array: with all constraints (m,), and with their derivatives (m, n)."""
    items = (*system.positions, *system.velocities)
    found = {(i, k): slope for i, item in enumerate(items) for k, slope in _gradient(item, system).items()}
    rows = function("gradients", list(found.values()), system.arguments, in_place=True, places=list(found))
    return filling("constraints", items, system.arguments), rows


@lru_cache(maxsize=64)
def energy_functions(energy: Any, system: Constrained) -> tuple[Callable[..., float], Callable[..., None]]:
    """Return an energy ``value(t, y, *params)``, and ``gradient(t, y, out, *params)``, which fills `out`."""
    value = function("energy", [energy], system.arguments, in_place=False)
    slopes = _gradient(energy, system)
    places = list(slopes)
    return value, function(
        "gradient of the energy", list(slopes.values()), system.arguments, in_place=True, places=places
    )


@lru_cache(maxsize=64)
def rate_function(rate: Any, system: Constrained) -> Callable[..., float]:
    """Return the rate of change of an energy as a function ``rate(t, y, *params)``."""
    return function("power", [rate], system.arguments, in_place=False)


def filling(what: str, expressions: Sequence[Any], arguments: Arguments) -> Callable[..., None]:
    """Return ``fill(t, y, out, *params)``, which fills `out`; expressions that are 0 are not compiled."""
    found = {k: item for k, item in enumerate(expressions) if item != 0}
    return function(what, list(found.values()), arguments, in_place=True, places=list(found))


def _gradient(item: Any, system: Constrained) -> dict[int, Any]:
    """Return the nonzero derivatives of an expression with respect to the state, by the indices of the components."""
    slopes = ((k, slope(item, x)) for k, x in enumerate(system.variables) if item.has(x))
    return {k: value for k, value in slopes if value != 0}


# Forces with more operations in all are not integrated, because that may take long.
MOST_OPERATIONS = 1000
# Largest number of factors of an integrand, and largest power of its sines and cosines.
MOST_FACTORS = 4
KNOWN = (sympy.sin, sympy.cos, sympy.exp)
# Points from which integrals are taken: the second one if forces are infinite at the first.
BASES = (0, 1)


def at_rest(forces: Sequence[Any], speeds: Sequence[Any], others: set[Any]) -> list[Any]:
    """Return the forces at zero speeds as expressions, without their terms that contain a symbol of `others`."""
    still = [sympy.expand_mul(sympy.sympify(item).subs(dict.fromkeys(speeds, 0))) for item in forces]
    return [sympy.Add(*(term for term in sympy.Add.make_args(F) if not term.free_symbols & others)) for F in still]


def potential_of(forces: Sequence[Any], coordinates: Sequence[Any]) -> Any:
    """Return V with forces = -dV/dq if the forces are conservative, None if no such expression is found.

    V may be wrong if the forces, which contain no speeds, are not conservative: the caller must check whether the
    energy that contains V is conserved.
    """
    if sum(item.count_ops() for item in forces) > MOST_OPERATIONS:
        return None
    forces = [sympy.expand_mul(item) for item in forces]
    lengths, forces = _of_lengths(forces, coordinates)
    for base in BASES:
        rest = _along_axes(forces, coordinates, base)
        if rest is not None:
            return lengths + rest
    return None


def _of_lengths(forces: Sequence[Any], coordinates: Sequence[Any]) -> tuple[Any, list[Any]]:
    """Return the potential of the force terms along the gradient of a length, and the forces without these terms.

    Springs and gravitation have such terms. With S, the square of the length, such a term of the force of coordinate q
    is c S^p with c = a dS/dq / 2, where a does not depend on the coordinates. Its potential is
    -a S^(p + 1) / (2 p + 2).
    """
    potential, forces = sympy.Integer(0), list(forces)
    powers = set().union(*(item.atoms(sympy.Pow) for item in forces))
    powers = {item for item in powers if item.exp.is_Rational and item.exp < 0 and item.exp != -1 and item.base.is_Add}
    for inverse in sorted(powers, key=str):
        slopes = [sympy.diff(inverse.base, q) / 2 for q in coordinates]
        parts = [item.coeff(inverse) for item in forces]
        pairs = [(part, slope) for part, slope in zip(parts, slopes, strict=True) if part != 0 and slope != 0]
        if not pairs:
            continue
        factor = sympy.cancel(sympy.expand_trig(pairs[0][0]) / sympy.expand_trig(pairs[0][1]))
        if not factor.free_symbols & set(coordinates):
            potential -= factor * inverse.base ** (inverse.exp + 1) / (2 * inverse.exp + 2)
            forces = [sympy.expand_mul(item - part * inverse) for item, part in zip(forces, parts, strict=True)]
    return potential, forces


def _along_axes(forces: Sequence[Any], coordinates: Sequence[Any], base: int) -> Any:
    """Return minus the integral of the forces along a path, None if SymPy cannot integrate it quickly.

    The path starts at the point whose coordinates are all `base` and moves along one at a time, the last one first.
    """
    potential = sympy.Integer(0)
    for k, (force, q) in enumerate(zip(forces, coordinates, strict=True)):
        integrand = force.subs(dict.fromkeys(coordinates[:k], base))
        terms = sympy.Add.make_args(sympy.expand(integrand))
        if not all(_is_simple(term, q) for term in terms):
            return None
        integral = sympy.Add(*(manualintegrate(term, q) for term in terms))
        if integral.has(sympy.Integral):
            return None
        potential -= integral - integral.subs(q, base)
    is_finite = not potential.has(sympy.zoo, sympy.oo, -sympy.oo, sympy.nan, sympy.I)
    return potential if is_finite else None


def _is_simple(term: Any, q: Any) -> bool:
    """Return True if SymPy can integrate a term over q quickly; the integration of other terms may not end.

    Such a term has at most `MOST_FACTORS` factors that depend on q: powers of q and of one polynomial of degree at most
    2 in q, or powers of q and of sines, cosines and exponentials of linear functions of q.
    """
    powers = [item.as_base_exp() for item in sympy.Mul.make_args(term) if item.has(q)]
    if len(powers) > MOST_FACTORS:
        return False
    roots = [base for base, exponent in powers if base != q and not isinstance(base, sympy.Function | sympy.exp)]
    waves = [(base, exponent) for base, exponent in powers if isinstance(base, sympy.sin | sympy.cos)]
    others = [base for base, exponent in powers if base.has(q) and base != q and base not in roots]
    if any(exponent.has(q) or not exponent.is_Rational for base, exponent in powers if base is not sympy.E):
        return False
    own = [exponent for base, exponent in powers if base == q] if others else []  # such a term is integrated by parts
    if any(not (exponent.is_Integer and 0 < exponent <= MOST_FACTORS) for exponent in (*own, *(n for _, n in waves))):
        return False
    if not all(isinstance(base, KNOWN) and _degree(base.args[0], q) <= 1 for base in others):
        return False
    return len(roots) <= 1 and all(_degree(base, q) <= 2 for base in roots) and not (roots and others)


def _degree(expression: Any, q: Any) -> float:
    return float(sympy.degree(expression, q)) if expression.is_polynomial(q) else float("inf")
