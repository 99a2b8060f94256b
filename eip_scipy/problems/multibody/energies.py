"""Search for an energy that a mechanical system conserves, by its rates at states that meet the constraints."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ...core.balances import Balance
from ...core.gradients import difference_gradient
from ...core.invariants import Invariant
from .motion import plain
from .start import nearest_start

__all__ = ["CONSTANT", "FEWEST", "Energy", "energy_of", "rates_of", "states_near", "typical_speed"]

# Number of states near the start at which rates are examined, and their distance in units of the components' sizes.
STATES, AWAY = 6, 0.2
NEARER = (1.0, 0.3, 0.1)  # factors of the distance; the first one that leads to a state is used
# Smallest number of states at which a quantity is examined.
FEWEST = 3
# An energy is constant if its rate is below this share of the rate's terms.
CONSTANT = 1e-9
# Largest difference between a given power and the rate of its energy, relative to the terms of the rate.
RIGHT = 1e-6


class Energy(NamedTuple):
    """Description of a quantity that may be constant, ``value(t, y, *params)``, and ``gradient(t, y, out, *params)``.

    `power` is the given rate of change, a function of (t, y, *params), or None.
    """

    description: str
    value: Callable[..., float]
    gradient: Callable[..., None]
    power: Callable[..., float] | None = None


def energy_of(
    candidates: Sequence[Energy],
    derivative: Callable[[float, np.ndarray], np.ndarray],
    states: Sequence[tuple],
    params: np.ndarray | None,
) -> tuple[Invariant | None, str]:
    """Return the energy as an `Invariant` or `Balance`, or None if it is not kept, and a description for the repr.

    The energy is the first candidate without a given power that is constant, otherwise the candidate that changes most
    slowly, if its rate is small enough for a balance. It is not kept if there are fewer than 3 `states`, times and
    states that meet the constraints. `derivative(t, y)` returns y'. A ValueError is raised if a given power is not the
    rate of its energy.
    """
    args = () if params is None else (params,)
    if candidates and len(states) < FEWEST:
        return None, "not kept: it was not examined, because too few states near the start meet the constraints"
    slowest, least = None, np.inf
    for item in candidates:
        rates, terms = rates_of(item, derivative, states, args)
        _require_power(item, rates, terms, states, args)
        rates = np.abs(rates)
        # All states are used together, because at one state the terms may vanish, as in a steady motion.
        if rates.max() <= CONSTANT * terms.max() and terms.max() > 0 and item.power is None:
            kept = Invariant(item.value, item.gradient, args=args, in_place=True, name="energy")
            return kept, f"invariant, {item.description}"
        moving = terms > CONSTANT * terms.max()
        slowness = float(np.median(rates[moving] / terms[moving])) if moving.any() else 0.0
        if slowness < least:
            slowest, least = item, slowness
    if slowest is None:
        return None, "not known; give energy= or potential="
    described = (
        f"{slowest.description}, whose rate of change is about {least:.2g} of the sum of the absolute values of the "
        "terms of that rate"
    )
    if least > Balance.most_slowness:
        return None, f"not kept: {described}"
    kept = Balance(slowest.value, slowest.power, slowest.gradient, args=args, in_place=True, name="energy")
    return kept, f"balance, {described}"


def _require_power(
    item: Energy, rates: np.ndarray, terms: np.ndarray, states: Sequence[tuple], args: tuple[Any, ...]
) -> None:
    """Raise ValueError if the given power is not the rate of change; `rates` and `terms` are those of `rates_of`."""
    if item.power is None:
        return
    given = np.array([float(plain(item.power)(t, y, *args)) for t, y in states])
    wrong = np.abs(given - rates)
    k = int(np.argmax(wrong / np.maximum(terms, np.finfo(float).tiny)))
    if not wrong[k] <= RIGHT * max(terms[k], np.abs(given[k])):
        raise ValueError(
            f"power is {given[k]:.6g} at a state near the start that meets the constraints, but the energy "
            f"({item.description}) changes at the rate {rates[k]:.6g} there. Correct power or the energy, or omit "
            "power to have it computed."
        )


def states_near(
    t: float,
    y: np.ndarray,
    constraints: Sequence[Invariant],
    derivative: Callable[[float, np.ndarray], np.ndarray],
    coordinates: int,
    t_end: float | None = None,
) -> list[tuple[float, np.ndarray]]:
    """Return times and states that meet the constraints: the start, and states near it at typical speeds.

    The times lie between t and `t_end`, and within the time in which the coordinates change by their size at a typical
    speed.
    """
    rng = np.random.default_rng(20391)
    half = np.abs(y[:coordinates]).max(initial=0.0) or 1.0
    sizes = np.maximum(np.abs(y), AWAY * half) * AWAY
    speed = typical_speed(y[:coordinates], y[coordinates:], derivative(t, y)[coordinates:])
    if speed == 0:  # a start in equilibrium
        speed = half
    sizes[coordinates:] = speed
    duration = half / speed
    if t_end is not None:
        duration = float(np.copysign(min(duration, abs(t_end - t)), t_end - t))
    found = [(t, y)]
    for time in t + duration * np.random.default_rng(20392).uniform(size=STATES):
        direction = rng.standard_normal(y.size)
        origin = _nearest(y, constraints, time, sizes)
        for share in NEARER:
            moved = _nearest(origin + share * sizes * direction, constraints, time, sizes)
            # Newton's method may end beyond a singular position. Such a state is farther away and is not used.
            near = np.linalg.norm((moved - origin) / sizes) <= 2 * share * np.linalg.norm(direction) * (1 + CONSTANT)
            meets = all(_meets(item, time, moved) for item in constraints)
            if near and meets and np.isfinite(derivative(time, moved)).all():
                found.append((time, moved))
                break
    return found


def _nearest(y: np.ndarray, constraints: Sequence[Invariant], t: float, sizes: np.ndarray) -> np.ndarray:
    for item in constraints:
        y = nearest_start(y, item, t, sizes)
    return y


def typical_speed(q: np.ndarray, u: np.ndarray, accelerations: np.ndarray) -> float:
    """Return the largest speed, or sqrt(size of q times the largest acceleration) if larger; size of 0 counts as 1."""
    size = np.abs(q).max(initial=0.0) or 1.0
    return float(max(np.abs(u).max(initial=0.0), np.sqrt(size * np.abs(accelerations).max(initial=0.0))))


def _meets(item: Invariant, t: float, y: np.ndarray) -> bool:
    return bool(np.abs(item.fun(t, y)).max() <= CONSTANT * max(1.0, np.abs(y).max()))


def rates_of(
    item: Energy, derivative: Callable[[float, np.ndarray], np.ndarray], states: Sequence[tuple], args: tuple[Any, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the rates (k,) of an energy at k states, and the sums (k,) of the absolute values of the rates' terms."""
    rates, terms = np.zeros(len(states)), np.zeros(len(states))
    for k, (t, y) in enumerate(states):
        gradient = np.empty(y.size)
        plain(item.gradient)(t, y, gradient, *args)
        products = gradient * derivative(t, y)
        value = plain(item.value)
        explicit = float(difference_gradient(partial(_at_time, value, t, y, args), np.zeros(1), np.ones(1))[0])
        rates[k], terms[k] = products.sum() + explicit, np.abs(products).sum() + abs(explicit)
    return rates, terms


def _at_time(value: Callable[..., float], t: float, y: np.ndarray, args: tuple[Any, ...], shift: np.ndarray) -> float:
    return value(t + shift[0], y, *args)
