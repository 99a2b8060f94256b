"""Mechanical systems with constraints, as expressions, and their functions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import sympy

from ..multibody.energies import Energy
from ..multibody.motion import Sizes
from ..multibody.parts import Parts
from .parser import symbol
from .program import Arguments, function

__all__ = ["Constrained", "filling", "parts_of"]


class Constrained(NamedTuple):
    """A system with the state (q, u): q' = `rates`, M u' + G^T lambda = F, and its constraints, all in real symbols.

    Equal systems share their functions.

    Attributes
    ----------
    coordinates, speeds, parameters : tuple of str
    rates : tuple of expressions
        The derivatives of the coordinates, linear in the speeds.
    mass : tuple of expressions
        M by rows.
    forces : tuple of expressions
    positions, velocities : tuple of expressions
        The constraints, which are 0: those on positions, and all of those on velocities, linear in the speeds, the
        derivatives of the former included.
    """

    coordinates: tuple[str, ...]
    speeds: tuple[str, ...]
    parameters: tuple[str, ...]
    rates: tuple[Any, ...]
    mass: tuple[Any, ...]
    forces: tuple[Any, ...]
    positions: tuple[Any, ...]
    velocities: tuple[Any, ...]

    @property
    def sizes(self) -> Sizes:
        """Numbers of coordinates, speeds, and constraints on velocities."""
        return Sizes(len(self.coordinates), len(self.speeds), len(self.velocities))

    @property
    def arguments(self) -> Arguments:
        """Arguments of the functions."""
        return Arguments((*self.coordinates, *self.speeds), self.parameters)

    @property
    def variables(self) -> list[Any]:
        """The symbols of the state."""
        return [symbol(name) for name in (*self.coordinates, *self.speeds)]

    def rate(self, expression: Any, accelerations: Sequence[Any] = ()) -> Any:
        """Return the derivative of an expression in time, with u' = `accelerations`, by default 0."""
        change = [*self.rates, *(accelerations or [0] * len(self.speeds))]
        terms = (sympy.diff(expression, x) * dx for x, dx in zip(self.variables, change, strict=True) if dx != 0)
        return sympy.Add(sympy.diff(expression, symbol("t")), *terms)

    def with_velocities(self) -> Constrained:
        """Return the system with the derivatives of all positions' constraints in front of those on velocities."""
        return self._replace(velocities=(*map(self.rate, self.positions), *self.velocities))


def parts_of(system: Constrained, energies: Sequence[tuple[str, Any, Any]]) -> Parts:
    """Return the functions of a system.

    Parameters
    ----------
    system : Constrained
    energies : sequence of (str, expression, expression or None)
        Descriptions of quantities that may be constant, their expressions, and their rates where these are given.
    """
    found = tuple(
        Energy(label, *energy_functions(item, system), None if rate is None else rate_function(rate, system))
        for label, item, rate in energies
    )
    return Parts(matrices(system), *values_and_gradient(system), found, origin=(system, tuple(energies)))


@lru_cache(maxsize=64)
def matrices(system: Constrained) -> Callable[..., None]:
    """Return ``fill(t, y, out, *params)`` of M, F, G, gamma and q', as `motion` takes it."""
    speeds = system.variables[len(system.coordinates) :]
    gradients = [sympy.diff(item, u) if item.has(u) else sympy.Integer(0) for item in system.velocities for u in speeds]
    gammas = map(system.rate, system.velocities)
    return filling("equations of motion", (*system.mass, *system.forces, *gradients, *gammas, *system.rates), system)


@lru_cache(maxsize=64)
def values_and_gradient(system: Constrained) -> tuple[Callable[..., None], Callable[..., None]]:
    """Return the constraints on positions and velocities and their gradient, both in place."""
    items = (*system.positions, *system.velocities)
    found = {(i, k): slope for i, item in enumerate(items) for k, slope in _gradient(item, system).items()}
    rows = function("gradients", list(found.values()), system.arguments, in_place=True, places=list(found))
    return filling("constraints", items, system), rows


@lru_cache(maxsize=64)
def energy_functions(energy: Any, system: Constrained) -> tuple[Callable[..., float], Callable[..., None]]:
    """Return an energy ``value(t, y, *params)`` and its gradient in place."""
    value = function("energy", [energy], system.arguments, in_place=False)
    slopes = _gradient(energy, system)
    places = list(slopes)
    return value, function(
        "gradient of the energy", list(slopes.values()), system.arguments, in_place=True, places=places
    )


@lru_cache(maxsize=64)
def rate_function(rate: Any, system: Constrained) -> Callable[..., float]:
    """Return the rate of an energy, ``rate(t, y, *params)``."""
    return function("power", [rate], system.arguments, in_place=False)


def filling(what: str, expressions: Sequence[Any], system: Constrained) -> Callable[..., None]:
    """Return a function that fills an array with expressions, most of which may be 0."""
    found = {k: item for k, item in enumerate(expressions) if item != 0}
    return function(what, list(found.values()), system.arguments, in_place=True, places=list(found))


def _gradient(item: Any, system: Constrained) -> dict[int, Any]:
    """Return the derivatives by the components of the state that are not 0, by their places."""
    slopes = ((k, sympy.diff(item, x)) for k, x in enumerate(system.variables) if item.has(x))
    return {k: slope for k, slope in slopes if slope != 0}
