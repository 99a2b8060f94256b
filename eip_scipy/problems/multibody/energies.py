"""Quantities that a mechanical system conserves: its energy, momenta of cyclic coordinates, norms of quaternions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from ...core.balances import Balance
from ...core.conserved import reduced_rows
from ...core.derivatives import difference_gradient
from ...core.functions import compiled_like
from ...core.invariants import Invariant
from .motion import plain
from .parts import Energy, Parts
from .start import Names, nearest_start

__all__ = ["energy_of", "momenta_of", "norms_of", "states_near", "typical_speed"]

# Number of states near the start at which rates are examined, and their distance in units of the components' sizes.
STATES, AWAY = 6, 0.2
NEARER = (1.0, 0.3, 0.1)  # factors of the distance; the first one that leads to a state is used
# Smallest number of states at which a quantity is examined.
FEWEST = 3
# An energy is constant if its rate is below this share of the rate's terms.
CONSTANT = 1e-9
# Largest difference between a given power and the rate of its energy, relative to the terms of the rate.
RIGHT = 1e-6


def energy_of(
    candidates: Sequence[Energy],
    derivative: Callable[[float, np.ndarray], np.ndarray],
    states: Sequence[tuple],
    args: tuple[Any, ...],
) -> tuple[Invariant | None, str]:
    """Return the energy as an `Invariant` or `Balance`, or None if it is not kept, and a description for the repr.

    The energy is the first candidate without a given power that is constant, otherwise the candidate that changes most
    slowly, if its rate is small enough for a balance. It is not kept if there are fewer than 3 `states`, times and
    states that meet the constraints. `derivative(t, y)` returns y'. A ValueError is raised if a given power is not the
    rate of its energy.
    """
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
        return None, "not known; give energy= or potential_energy="
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
            most = CONSTANT * max(1.0, np.abs(moved).max())
            meets = all(np.abs(item.fun(time, moved)).max() <= most for item in constraints)
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


# Bound for the rounding of a rate, relative to the gradient times the largest derivative.
ROUNDING = 1e-12
# A gradient depends on those of other invariants if its distance from their span is below this share of its length.
DEPENDENT = 1e-6


def momenta_of(
    candidates: Sequence[Energy],
    kept: Sequence[Invariant],
    derivative: Callable[[float, np.ndarray], np.ndarray],
    states: Sequence[tuple],
    args: tuple[Any, ...],
) -> tuple[Invariant, ...]:
    """Return the candidates that are constant and independent of the invariants in `kept` and of each other.

    The functions of `kept` are not compiled, and `derivative(t, y)` returns y'. If there are fewer than 3 `states`,
    pairs (t, y) that meet the constraints, no momenta are returned.
    """
    found: list[Invariant] = []
    if len(states) < FEWEST:
        return ()
    known = [_rows(kept, t, y) for t, y in states]
    for item in candidates:
        rates, terms = rates_of(item, derivative, states, args)
        slopes = [np.empty(y.size) for _, y in states]
        for slope, (t, y) in zip(slopes, states, strict=True):
            plain(item.gradient)(t, y, slope, *args)
        rounding = [np.abs(g).sum() * np.abs(derivative(t, y)).max() for g, (t, y) in zip(slopes, states, strict=True)]
        if not (np.abs(rates) <= CONSTANT * terms + ROUNDING * np.array(rounding)).all():
            continue
        if not any(_is_independent(g, rows) for g, rows in zip(slopes, known, strict=True)):
            continue
        found.append(Invariant(item.value, item.gradient, args=args, in_place=True, name=item.description))
        known = [np.vstack([rows, g]) for g, rows in zip(slopes, known, strict=True)]
    return tuple(found)


def norms_of(
    parts: Parts, names: Names, kept: Sequence[Invariant], states: Sequence[tuple], args: tuple[Any, ...]
) -> tuple[Invariant, ...]:
    """Return the sums of squares of coordinates, such as a quaternion's, whose sum of q q' is 0 for all speeds.

    Those that depend on the invariants in `kept` are left out.
    """
    nq, n = len(names.coordinates), len(names.speeds)

    def rates(t: float, y: np.ndarray, speeds: np.ndarray) -> np.ndarray:
        return parts.matrices(names, t, np.append(y[:nq], speeds), args)[-1]

    t, y = states[-1]
    speeds = np.arange(1.0, n + 1.0)
    if nq == n and np.array_equal(rates(t, y, speeds), speeds):
        return ()
    # The products q_i q_i' of all coordinates: at zero speeds, then with each speed in turn set to 1.
    units = np.vstack([np.zeros(n), np.eye(n)])
    products = np.array([y[:nq] * rates(t, y, u) for t, y in states for u in units])
    found = []
    for places in _sets(products):
        item = _sum_of_squares(parts, names, places, args)
        if any(_is_independent(_rows([item], t, y)[0], _rows(kept, t, y)) for t, y in states):
            found.append(item)
    return tuple(found)


def _rows(items: Sequence[Invariant], t: float, y: np.ndarray) -> np.ndarray:
    """Return the gradients of the values of all invariants at a state as rows (l, n)."""
    found = [np.zeros((0, y.size))]
    for item in items:
        out = np.empty((item.size, y.size) if item.size else y.size)
        plain(item.gradient)(t, y, out, *item.args)
        found.append(np.atleast_2d(out))
    return np.vstack(found)


def _is_independent(gradient: np.ndarray, rows: np.ndarray) -> bool:
    """Return True if a gradient is not a linear combination of `rows`."""
    sizes = np.linalg.norm(rows, axis=1)
    rows = rows[sizes > 0] / sizes[sizes > 0, None]
    _, values, directions = np.linalg.svd(rows, full_matrices=False)
    directions = directions[values > DEPENDENT * values.max(initial=0.0)]
    left = gradient - directions.T @ (directions @ gradient)
    return bool(np.linalg.norm(left) > DEPENDENT * np.linalg.norm(gradient))


def _sets(products: np.ndarray) -> list[tuple[int, ...]]:
    """Return the sets of at least two columns of `products` whose sum is 0 in each row, as tuples of their indices."""
    if not np.isfinite(products).all():
        return []
    size = np.abs(products).max(initial=0.0)
    moving = np.flatnonzero(np.abs(products).max(axis=0, initial=0.0) > CONSTANT * size)
    if moving.size < 2:
        return []
    _, values, directions = np.linalg.svd(products[:, moving])
    rank = int((values > CONSTANT * values.max(initial=0.0)).sum())
    basis = reduced_rows(directions[rank:], DEPENDENT)
    chosen = np.abs(basis) > 0.5
    whole = np.abs(basis - chosen).max(axis=1, initial=0.0) < DEPENDENT
    return [
        tuple(int(k) for k in moving[row]) for row, fits in zip(chosen, whole, strict=True) if fits and row.sum() > 1
    ]


def _sum_of_squares(parts: Parts, names: Names, places: tuple[int, ...], args: tuple[Any, ...]) -> Invariant:
    def value(t, y, *params):
        total = 0.0
        for k in places:
            total += y[k] * y[k]
        return total

    def gradient(t, y, out, *params):
        for k in range(y.size):
            out[k] = 0.0
        for k in places:
            out[k] = 2.0 * y[k]

    functions = compiled_like(value, parts.fill), compiled_like(gradient, parts.fill)
    name = " + ".join(f"{names.coordinates[k]}^2" for k in places)
    return Invariant(*functions, args=args, in_place=True, name=name)
