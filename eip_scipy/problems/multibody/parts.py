"""Functions of a mechanism: those of the user, and those that a problem is made of."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from ...core.functions import compilable, jitted, own_values
from ...core.inputs import shown
from .motion import plain
from .start import Names

__all__ = ["Energy", "Given", "Outputs", "Parts", "columns_of", "on_copies", "required_outputs"]


class Outputs(NamedTuple):
    """Names of outputs, and ``fill(t, x, out, *params)``, which computes them from x = (q, u, u')."""

    names: tuple[str, ...]
    fill: Callable[..., None]


def columns_of(what: str, t: Any, y: Any, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the times as an array (k,) and the states as columns (n, k); ValueError if they do not fit."""
    times, states = np.atleast_1d(np.asarray(t, float)), np.asarray(y, float)
    columns = states.reshape(len(states), -1)
    if np.ndim(t) != states.ndim - 1 or columns.shape != (n, times.size):
        raise ValueError(
            f"{what}: y has the shape {states.shape} for {times.size} times; expected ({n},) for a number t, or a "
            "column for each time."
        )
    return times, columns


def required_outputs(what: str, outputs: Any, taken: Any) -> dict[str, Any]:
    """Return `outputs` as a dictionary; raise an error if a key is not a string, or is `taken` by a component."""
    if outputs is None:
        return {}
    if not isinstance(outputs, Mapping):
        raise TypeError(f"{what}: outputs must be a mapping of names to quantities, got {shown(outputs)}.")
    for name in outputs:
        if not isinstance(name, str):
            raise TypeError(f"{what}: names of outputs must be strings, got {shown(name)}.")
        if name in taken:
            raise ValueError(f"{what}: the output {name!r} has the name of a component of the state; rename it.")
    return dict(outputs)


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
    potential_energy: Any
    power: Any
    outputs: Any = None  # a mapping

    def compiled(self) -> Given:
        """Return functions that are jitted by Numba, if those of the user are: arrays are replaced by functions."""
        return self._mapped(lambda item: item if callable(item) else jitted(compilable(_constant(item))))

    def called(self) -> Given:
        """Return functions for calls from Python, see `on_copies`: arrays are replaced by functions, too."""
        return self._mapped(lambda item: on_copies(item if callable(item) else _constant(item)))

    def _mapped(self, change: Callable[[Any], Any]) -> Given:
        given = {name: item for name, item in self._asdict().items() if name != "outputs" and item is not None}
        return self._replace(**{name: change(item) for name, item in given.items()})


def _constant(value: Any) -> Callable[..., Any]:
    kept = np.array(value)  # which the user does not change
    return lambda *_: kept


def on_copies(fun: Callable[..., Any]) -> Callable[..., Any]:
    """Return `fun` with copies of its arguments and of its value, if these are arrays.

    A function of the user may then change its arguments, which are parts of the state, and may return the same array
    at each call.
    """
    own = own_values(fun)
    return lambda *args: own(*(item.copy() if isinstance(item, np.ndarray) else item for item in args))


class Energy(NamedTuple):
    """Description of a quantity that may be constant, ``value(t, y, *params)``, and ``gradient(t, y, out, *params)``.

    `power` is the given rate of change, ``power(t, y, *params)``, or None.
    """

    description: str
    value: Callable[..., float]
    gradient: Callable[..., None]
    power: Callable[..., float] | None = None


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
    origin: Any = None  # a function that makes these parts, and its arguments

    def matrices(self, names: Names, t: float, y: np.ndarray, args: tuple[Any, ...] = ()) -> list[np.ndarray]:
        """Return M, F, G, gamma and q' at a state, computed by functions that are not compiled."""
        n, m = len(names.speeds), len(names.velocities)
        out = np.empty(names.sizes.matrices + len(names.coordinates))
        plain(self.fill)(t, y, out, *args)
        M, F, G, gamma, rates = np.split(out, np.cumsum([n * n, n, m * n, m]))
        return [M.reshape(n, n), F, G.reshape(m, n), gamma, rates]
