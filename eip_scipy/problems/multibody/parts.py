"""Functions that a mechanical problem is made of."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from ...core.inputs import shown
from .motion import plain
from .start import Names

__all__ = ["Energy", "Outputs", "Parts", "required_outputs"]


class Outputs(NamedTuple):
    """Names of outputs, and ``fill(t, x, out, *params)``, which computes them from x = (q, u, u')."""

    names: tuple[str, ...]
    fill: Callable[..., None]


def required_outputs(what: str, outputs: Any, taken: Any) -> dict[str, Any]:
    """Return `outputs` as a dictionary; raise an error if a key is not a string, or is `taken` by a component."""
    if not isinstance(outputs, Mapping | None):
        raise TypeError(f"{what}: outputs must be a mapping of names to quantities, got {shown(outputs)}.")
    for name in outputs or {}:
        if not isinstance(name, str):
            raise TypeError(f"{what}: names of outputs must be strings, got {shown(name)}.")
        if name in taken:
            raise ValueError(f"{what}: the output {name!r} has the name of a component of the state; rename it.")
    return dict(outputs or {})


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
        nq, n, m = names.sizes
        out = np.empty((n + m + 1) * n + m + nq)
        plain(self.fill)(t, y, out, *args)
        M, F, G, gamma, rates = np.split(out, np.cumsum([n * n, n, m * n, m]))
        return [M.reshape(n, n), F, G.reshape(m, n), gamma, rates]
