"""Invariants of equations on grids, created from their names, and the balances that replace them with damping."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from ..core.balances import Balance
from ..core.inputs import is_number, shown
from ..core.invariants import Invariant
from ..core.names import nearest

__all__ = ["checked_damping", "damped_invariant", "named_invariant"]


def named_invariant(
    name: str,
    made: Mapping[str, tuple[Callable[..., float], Callable[..., None]]],
    known: Sequence[str],
    *,
    uses_f: bool = False,
    where: str = "",
) -> Invariant:
    """Return the invariant with the name `name`; a ValueError lists the `known` names if it is not in `made`.

    `made` maps names to functions ``value(y)`` and ``gradient(t, y, out)``, or ``gradient(t, y, f, out)`` if `uses_f`.
    """
    if name not in made:
        raise ValueError(f"unknown invariant {name!r}{where}, expected {', '.join(known)}{nearest(name, known)}")
    value, gradient = made[name]
    return Invariant(partial(_at, value), gradient, name=name, in_place=True, uses_f=uses_f)


def _at(value: Callable[[np.ndarray], float], t: float, y: np.ndarray) -> float:
    return value(y)


def checked_damping(damping: float) -> float:
    """Return the damping as a float; raise ValueError if it is not a finite number >= 0."""
    if not (is_number(damping) and np.isfinite(damping) and damping >= 0):
        raise ValueError(f"damping must be a finite number >= 0, got {shown(damping)}.")
    return float(damping)


Parts = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def damped_invariant(
    item: Invariant, rated: Invariant, parts: Parts, total: Callable[[float], float] | None = None
) -> Balance:
    """Return an invariant of the undamped equation as a balance of the damped equation.

    `item` and `rated` are separate objects for the same invariant, because an invariant may store results for its last
    state, and rates are computed at other states than values. ``parts(y, f)`` splits the derivative f into the one
    without damping, and the terms that damping adds. `total` returns the sum over the whole grid from that of this
    process.
    """
    gradient = partial(_damped_gradient, item, parts)
    return Balance(
        item.fun, partial(_loss, rated, parts, total), gradient, name=item.name, in_place=True, uses_f=True
    )  # fmt: skip


def _damped_gradient(item: Invariant, parts: Parts, t: float, y: np.ndarray, f: np.ndarray, out: np.ndarray) -> None:
    assert item.gradient is not None
    item.gradient(t, y, *((parts(y, f)[0],) if item.uses_f else ()), out)


def _loss(
    item: Invariant, parts: Parts, total: Callable[[float], float] | None, t: float, y: np.ndarray, f: np.ndarray
) -> float:
    """Return the rate of a `damped_invariant`: Re <gradient, lost>, where `lost` is the second result of `parts`."""
    kept, lost = parts(y, f)
    gradient = np.empty_like(y)
    assert item.gradient is not None
    item.gradient(t, y, *((kept,) if item.uses_f else ()), gradient)
    rate = float(np.vdot(gradient, lost).real)
    return rate if total is None else total(rate)
