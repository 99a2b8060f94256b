"""The functions of a mechanism: those that are given, and those that a problem is made of."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from .energies import Energy
from .outputs import Outputs

__all__ = ["Given", "Parts"]


class Given(NamedTuple):
    """The functions of a mechanism as they were given, None where they were not."""

    mass: Any
    forces: Any
    constraints: Any
    velocity_constraints: Any
    kinematics: Any
    jacobian: Any
    gamma: Any
    energy: Any
    potential: Any
    power: Any
    outputs: Any = None  # a mapping


class Parts(NamedTuple):
    """Functions made of those that were given: see `motion` and `Energy`.

    ``values(t, y, out, *params)`` fills in the constraints on positions and velocities, and ``gradient`` their
    derivatives (m, n) by the state.
    """

    fill: Callable[..., None]
    values: Callable[..., None]
    gradient: Callable[..., None]
    energies: tuple[Energy, ...]
    note: str = ""
    momenta: tuple[Energy, ...] = ()
    outputs: Outputs | None = None
    origin: Any = None  # arguments of `parts_of` in symbolic/constrained.py, where the functions were made there
