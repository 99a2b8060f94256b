"""Records of the functions of a mechanism: those of the user, and those that a problem is made of."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from .energies import Energy
from .outputs import Outputs

__all__ = ["Given", "Parts"]


class Given(NamedTuple):
    """The functions of a mechanism, see `mechanism`; None for those that the user did not give."""

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
    """The functions of which a problem is made.

    ``fill`` is the argument of `motion`. ``values(t, y, out, *params)`` fills `out` with the constraints on positions
    and then those on velocities, m in total, and ``gradient`` with their derivatives (m, n). `energies` and `momenta`
    may be constant, and `note` is a line for the repr.
    """

    fill: Callable[..., None]
    values: Callable[..., None]
    gradient: Callable[..., None]
    energies: tuple[Energy, ...]
    note: str = ""
    momenta: tuple[Energy, ...] = ()
    outputs: Outputs | None = None
    origin: Any = None  # arguments of `parts_of` in symbolic/constrained.py, if that made the functions
