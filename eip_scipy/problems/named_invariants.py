"""Invariants of equations on grids, made by their names."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from ..core.invariants import Invariant
from ..core.names import nearest

__all__ = ["named_invariant"]


def named_invariant(
    name: str,
    made: Mapping[str, tuple[Callable[..., float], Callable[..., None]]],
    known: Sequence[str],
    *,
    uses_f: bool = False,
    where: str = "",
) -> Invariant:
    """The invariant of that name, from its value ``value(y)`` and its gradient in place.

    Raises
    ------
    ValueError
        For a name that is not among `made`; the message names those that are `known`, and says `where`.
    """
    if name not in made:
        raise ValueError(f"unknown invariant {name!r}{where}, expected {', '.join(known)}{nearest(name, known)}")
    value, gradient = made[name]
    return Invariant(partial(_at, value), gradient, name=name, in_place=True, uses_f=uses_f)


def _at(value: Callable[[np.ndarray], float], t: float, y: np.ndarray) -> float:
    return value(y)
