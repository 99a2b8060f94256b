"""Mechanical systems with constraints as expressions, and the functions compiled from them."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import sympy

from ...core.functions import compilable, compiled_like, is_jitted, jitted
from ..multibody.motion import new_floats, new_like
from ..multibody.parts import Energy, Outputs, Parts
from .brackets import derivative
from .parser import symbol
from .program import Arguments, function
from .system import value_and_gradient

__all__ = ["Constrained", "acceleration", "parts_of"]


class Constrained(NamedTuple):
    """A system with the state (q, u): q' = `rates`, M u' + G^T lambda = F, and its constraints.

    `coordinates` and `speeds` are names if the expressions are in real symbols, otherwise the model's own symbols.
    `mass` is M by rows, and `rates` are linear in the speeds. `positions` and `velocities` are the expressions that
    constraints set to 0; the latter are linear in the speeds and include the derivatives of `positions`. `inputs` are
    names of quantities in the forces that functions ``f(t, y)`` compute.
    """

    coordinates: Any
    speeds: Any
    parameters: tuple[str, ...]
    rates: Any
    mass: Any
    forces: Any
    positions: Any
    velocities: Any
    inputs: tuple[tuple[str, Callable[..., float]], ...] = ()

    @property
    def expressions(self) -> tuple[Any, ...]:
        """Return the rates, masses, forces and constraints."""
        return self.rates, self.mass, self.forces, self.positions, self.velocities

    @property
    def arguments(self) -> Arguments:
        """Return the arguments of the compiled functions: the components of the state and the parameters."""
        return Arguments((*self.coordinates, *self.speeds), self.parameters)

    def rate(self, expression: Any) -> Any:
        """Return the derivative of an expression in time for u' = 0."""
        terms = [sympy.diff(expression, symbol(x)) * dx for x, dx in zip(self.coordinates, self.rates, strict=True)]
        return sympy.Add(sympy.diff(expression, symbol("t")), *terms)


def acceleration(speed: str) -> sympy.Symbol:
    """Return the symbol of the derivative of a speed."""
    return symbol(f"{speed}'")


def parts_of(
    system: Constrained,
    energies: tuple[tuple[str, Any], ...],
    momenta: tuple[tuple[str, Any], ...] = (),
    outputs: tuple[tuple[str, Any], ...] = (),
) -> Parts:
    """Return the compiled functions of a system.

    `energies` are descriptions and expressions of quantities that may be constant. `momenta` and `outputs` are names
    and expressions; the latter may contain accelerations.
    """
    arguments, items = system.arguments, (*system.positions, *system.velocities)
    states, m = [symbol(name) for name in arguments.y], len(items)
    gradients = [tuple(derivative(item, x) for x in states) for item in items]
    slopes = [slope for row in gradients[len(system.positions) :] for slope in row[len(system.coordinates) :]]
    motion = (*system.mass, *system.forces, *slopes, *map(system.rate, system.velocities), *system.rates)
    observer = None
    if outputs:
        names, observed = zip(*outputs, strict=True)
        accelerations = tuple(acceleration(name).name for name in system.speeds)
        observer = Outputs(names, _with_inputs("outputs", observed, system, accelerations))
    return Parts(
        _with_inputs("equations of motion", motion, system),
        function("constraints", items, arguments, shape=(m,)),
        function("gradients", tuple(slope for row in gradients for slope in row), arguments, shape=(m, len(states))),
        tuple(Energy(label, *value_and_gradient("energy", item, arguments)) for label, item in energies),
        momenta=tuple(Energy(name, *value_and_gradient(name, item, arguments)) for name, item in momenta),
        outputs=observer,
        origin=(parts_of, (system, energies, momenta, outputs)),
    )


@lru_cache(maxsize=64)
def _with_inputs(
    what: str, items: tuple[Any, ...], system: Constrained, behind: tuple[str, ...] = ()
) -> Callable[..., None]:
    """Return ``fill(t, y, out, *params)``, where y holds the state and further values that are named in `behind`.

    `fill` appends the values of the inputs to y before it computes the expressions `items`.
    """
    n = len(system.arguments.y)
    names = (*system.arguments.y, *behind, *(name for name, _ in system.inputs))
    fill = function(what, items, Arguments(names, system.parameters), shape=(len(items),))
    for _, given in reversed(system.inputs):
        fill = _with_input(fill, given, n)
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
