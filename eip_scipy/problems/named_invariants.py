"""Invariants of equations on grids, created from their names, and the balances that replace them with damping."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from ..core.balances import Balance
from ..core.inputs import is_number, refuse_units, shown
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
    """Return the invariant with the name `name`.

    `made` maps names to pairs of functions, ``value(y)`` and ``gradient(t, y, out)``, or ``gradient(t, y, f, out)`` if
    `uses_f` is True; the gradient fills `out`.

    Raises
    ------
    ValueError
        If the name is not in `made`; the message has `where` after the name, and lists the `known` names.
    """
    if name not in made:
        raise ValueError(f"unknown invariant {name!r}{where}, expected {', '.join(known)}{nearest(name, known)}")
    value, gradient = made[name]
    return Invariant(partial(_at, value), gradient, name=name, in_place=True, uses_f=uses_f)


def _at(value: Callable[[np.ndarray], float], t: float, y: np.ndarray) -> float:
    return value(y)


def checked_damping(damping: float) -> float:
    """Return the damping as a float.

    Raises
    ------
    ValueError
        If it is not a finite number >= 0.
    """
    refuse_units(damping=damping)
    if not (is_number(damping) and np.isfinite(damping) and damping >= 0):
        raise ValueError(f"damping must be a finite number >= 0, got {shown(damping)}.")
    return float(damping)


Parts = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def damped_invariant(
    item: Invariant, rated: Invariant, parts: Parts, total: Callable[[float], float] | None = None
) -> Balance:
    """Return an invariant of the undamped equation as a balance of the damped equation.

    Parameters
    ----------
    item, rated : Invariant
        Two separate objects for the same invariant, for its values and for its rates, because an invariant may store
        results for its last state, and rates are computed at other states than values.
    parts : callable
        ``parts(y, f) -> (kept, lost)``, two parts of the derivative f: the derivative without damping, and the terms
        that damping adds.
    total : callable, optional
        Function that returns the sum over the whole grid from the sum over the part of this process.
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
