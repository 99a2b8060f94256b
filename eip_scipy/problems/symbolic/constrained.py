"""Mechanical systems with constraints as expressions, and the functions compiled from them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import sympy

from ...core.functions import compilable, compiled_like, is_jitted, jitted
from ..multibody.motion import new_floats, new_like
from ..multibody.parts import Energy, Outputs, Parts
from .brackets import slope
from .parser import symbol
from .program import Arguments, function

__all__ = [
    "Constrained",
    "acceleration",
    "cyclic",
    "filling",
    "own_speed",
    "parts_of",
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
        origin=(parts_of, (system, tuple(energies), tuple(momenta), tuple(outputs))),
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
    if plain := [name for name, given in system.inputs if not is_jitted(given)]:
        why = f"input {plain[0]!r} is a Python function; jit it by numba.njit, which makes runs about 150 times faster"
        fill.not_jitted = why  # type: ignore[attr-defined]
    return fill


def _with_input(fill: Callable[..., None], function: Callable[..., float], n: int) -> Callable[..., None]:
    compiles = is_jitted(fill) and is_jitted(function)
    new = jitted(compilable(new_floats)) if compiles else new_like

    def wider(t, y, out, *params):
        state = new(y.size + 1, y)
        for k in range(n):
            state[k] = y[k]
        state[y.size] = function(t, state[:n])  # which may change its argument
        for k in range(y.size):
            state[k] = y[k]
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
