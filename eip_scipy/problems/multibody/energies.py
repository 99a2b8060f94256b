"""Quantities that a mechanical system conserves: its energy, momenta of cyclic coordinates, norms of quaternions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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

__all__ = ["Examined", "states_near", "typical_speed"]

Array = np.ndarray
Derivative = Callable[[float, Array], Array]
# Number of states near the start at which rates are examined, and their distance in units of the components' sizes.
STATES, AWAY = 6, 0.2
NEARER = (1.0, 0.3, 0.1)  # factors of the distance; the first one that leads to a state is used
FEWEST = 3  # smallest number of states at which a quantity is examined
# A quantity is constant if its rate is below CONSTANT times the rate's terms, or below ROUNDING, the bound for the
# rounding of a rate, times the gradient and the largest derivative.
CONSTANT, ROUNDING = 1e-9, 1e-12
# Largest difference between a given power and the rate of its energy, relative to the terms of the rate.
RIGHT = 1e-6
# A gradient depends on those of other invariants if its distance from their span is below this share of its length.
DEPENDENT = 1e-6


def states_near(
    t: float, y: Array, constraints: Sequence[Invariant], derivative: Derivative, nq: int, t_end: float | None = None
) -> list[tuple[float, Array]]:
    """Return times and states that meet the constraints: the start, and states near it at typical speeds.

    The times lie between t and `t_end`, and within the time in which the `nq` coordinates change by their size at a
    typical speed.
    """
    rng = np.random.default_rng(20391)
    half = np.abs(y[:nq]).max(initial=0.0) or 1.0
    speed = typical_speed(y, derivative(t, y), nq) or half  # it is 0 in equilibrium
    sizes = np.append(np.maximum(np.abs(y[:nq]), AWAY * half) * AWAY, np.full(y.size - nq, speed))
    span = half / speed if t_end is None else min(half / speed, abs(t_end - t)) * np.sign(t_end - t)

    def nearest(y: Array, time: float) -> Array:
        for item in constraints:
            y = nearest_start(y, item, time, sizes)
        return y

    found = [(t, y)]
    for time in t + span * np.random.default_rng(20392).uniform(size=STATES):
        direction, origin = rng.standard_normal(y.size), nearest(y, time)
        for share in NEARER:
            moved = nearest(origin + share * sizes * direction, time)
            # Newton's method may end beyond a singular position. Such a state is farther away and is not used.
            near = np.linalg.norm((moved - origin) / sizes) <= 2 * share * np.linalg.norm(direction) * (1 + CONSTANT)
            most = CONSTANT * max(1.0, np.abs(moved).max())
            meets = all(np.abs(item.fun(time, moved)).max() <= most for item in constraints)
            if near and meets and np.isfinite(derivative(time, moved)).all():
                found.append((time, moved))
                break
    return found


def typical_speed(y: Array, f: Array, nq: int) -> float:
    """Return the largest speed, or sqrt(size of q times the largest acceleration) if larger; size of 0 counts as 1."""
    size = np.abs(y[:nq]).max(initial=0.0) or 1.0
    return float(max(np.abs(y[nq:]).max(initial=0.0), np.sqrt(size * np.abs(f[nq:]).max(initial=0.0))))


class Examined:
    """States at which quantities are examined, pairs (t, y) that meet the constraints; f (k, n) are the derivatives."""

    def __init__(self, states: Sequence[tuple[float, Array]], derivative: Derivative, args: tuple[Any, ...]) -> None:
        self.states, self.args = states, args
        self.f = np.array([derivative(t, y) for t, y in states])

    def slopes(self, gradient: Any, size: int | None, args: tuple[Any, ...]) -> Array:
        """Return the gradients (k, size, n) of an invariant, or (k, 1, n) if `size` is None."""
        out = np.empty((len(self.states), size or 1, self.f.shape[1]))
        for rows, (t, y) in zip(out, self.states, strict=True):
            plain(gradient)(t, y, rows if size else rows[0], *args)
        return out

    def rates(self, item: Energy) -> tuple[Array, Array, float]:
        """Return the rates (k,) of a quantity, the sums (k,) of the absolute values of their terms, and a bound.

        The quantity is constant if all rates are below the bound. It is one for all states, because at one state the
        terms may vanish, as in a steady motion.
        """
        value, slopes = plain(item.value), self.slopes(item.gradient, None, self.args)[:, 0]

        def later(shift: Array) -> Array:
            return np.array([value(t + shift[0], y, *self.args) for t, y in self.states])

        explicit = difference_gradient(later, np.zeros(1), np.ones(1))[:, 0]
        products = slopes * self.f
        terms = np.abs(products).sum(axis=1) + np.abs(explicit)
        rounding = np.abs(slopes).sum(axis=1) * np.abs(self.f).max(axis=1)
        return products.sum(axis=1) + explicit, terms, CONSTANT * terms.max() + ROUNDING * rounding.max()

    def energy_of(self, candidates: Sequence[Energy]) -> tuple[Invariant | None, str]:
        """Return the energy as an `Invariant` or `Balance`, or None if it is not kept, and a description for the repr.

        The energy is the first candidate without a given power that is constant, otherwise the candidate that changes
        most slowly, if its rate is small enough for a balance. It is not kept if there are fewer than 3 states. A
        ValueError is raised if a given power is not the rate of its energy.
        """
        if not candidates:
            return None, "not known; give energy= or potential_energy="
        if len(self.states) < FEWEST:
            return None, "not kept: it was not examined, because too few states near the start meet the constraints"
        slowness = []
        for item in candidates:
            rates, terms, bound = self.rates(item)
            self._require_power(item, rates, terms)
            if np.abs(rates).max() <= bound and terms.max() > 0 and item.power is None:
                energy = Invariant(item.value, item.gradient, args=self.args, in_place=True, name="energy")
                return energy, f"invariant, {item.description}"
            moving = terms > CONSTANT * terms.max()
            slowness.append(float(np.median(np.abs(rates[moving]) / terms[moving])) if moving.any() else 0.0)
        least = min(slowness)
        item = candidates[slowness.index(least)]
        described = (
            f"{item.description}, whose rate of change is about {least:.2g} of the sum of the absolute values of the "
            "terms of that rate"
        )
        if least > Balance.most_slowness:
            return None, f"not kept: {described}"
        kept = Balance(item.value, item.power, item.gradient, args=self.args, in_place=True, name="energy")
        return kept, f"balance, {described}"

    def _require_power(self, item: Energy, rates: Array, terms: Array) -> None:
        """Raise ValueError if the given power is not the rate of change; `rates` and `terms` are those of `rates`."""
        if item.power is None:
            return
        given = np.array([float(plain(item.power)(t, y, *self.args)) for t, y in self.states])
        wrong = np.abs(given - rates)
        k = int(np.argmax(wrong / np.maximum(terms, np.finfo(float).tiny)))
        if not wrong[k] <= RIGHT * max(terms[k], np.abs(given[k])):
            raise ValueError(
                f"power is {given[k]:.6g} at a state near the start that meets the constraints, but the energy "
                f"({item.description}) changes at the rate {rates[k]:.6g} there. Correct power or the energy, or omit "
                "power to have it computed."
            )

    def momenta_of(self, candidates: Sequence[Energy], kept: Sequence[Invariant]) -> tuple[Invariant, ...]:
        """Return the candidates that are constant and independent of the invariants in `kept` and of each other.

        The functions of `kept` are not compiled. If there are fewer than 3 states, no momenta are returned.
        """
        found: list[Invariant] = []
        for item in candidates if len(self.states) >= FEWEST else ():
            rates, _, bound = self.rates(item)
            momentum = Invariant(item.value, item.gradient, args=self.args, in_place=True, name=item.description)
            if np.abs(rates).max() <= bound and self._is_independent(momentum, [*kept, *found]):
                found.append(momentum)
        return tuple(found)

    def _is_independent(self, item: Invariant, kept: Sequence[Invariant]) -> bool:
        """Return True if the gradient of `item` is not a linear combination of those of `kept` at some states."""
        rows = np.concatenate([self.slopes(one.gradient, one.size, one.args) for one in (item, *kept)], axis=1)
        for gradient, *others in rows:
            known = np.array([row / np.linalg.norm(row) for row in others if row.any()]).reshape(-1, gradient.size)
            left = gradient - known.T @ np.linalg.lstsq(known.T, gradient, rcond=DEPENDENT)[0]
            if np.linalg.norm(left) > DEPENDENT * np.linalg.norm(gradient):
                return True
        return False

    def norms_of(self, parts: Parts, names: Names, kept: Sequence[Invariant]) -> tuple[Invariant, ...]:
        """Return the sums of squares of coordinates, such as a quaternion's, whose sum of q q' is 0 for all speeds.

        Those that depend on the invariants in `kept` are left out.
        """
        nq, n = len(names.coordinates), len(names.speeds)
        (t, y), speeds = self.states[-1], np.arange(1.0, n + 1.0)
        if np.array_equal(parts.matrices(names, t, np.append(y[:nq], speeds), self.args)[-1], speeds):
            return ()
        # The products q_i q_i' of all coordinates: at zero speeds, then with each speed in turn set to 1.
        products = np.array([
            y[:nq] * parts.matrices(names, t, np.append(y[:nq], u), self.args)[-1]
            for t, y in self.states for u in np.vstack([np.zeros(n), np.eye(n)])
        ])  # fmt: skip
        sums = (self._sum_of_squares(parts, names, places) for places in _zero_sums(products))
        return tuple(item for item in sums if self._is_independent(item, kept))

    def _sum_of_squares(self, parts: Parts, names: Names, places: tuple[int, ...]) -> Invariant:
        def value(t, y, *params):
            total = 0.0
            for k in places:
                total += y[k] * y[k]
            return total

        def gradient(t, y, out, *params):
            out[:] = 0.0
            for k in places:
                out[k] = 2.0 * y[k]

        functions = compiled_like(value, parts.fill), compiled_like(gradient, parts.fill)
        name = " + ".join(f"{names.coordinates[k]}^2" for k in places)
        return Invariant(*functions, args=self.args, in_place=True, name=name)


def _zero_sums(products: Array) -> list[tuple[int, ...]]:
    """Return the sets of at least two columns of `products` whose sum is 0 in each row, as tuples of their indices."""
    sizes = np.abs(products).max(axis=0)
    moving = np.flatnonzero(sizes > CONSTANT * sizes.max())
    if moving.size < 2 or not np.isfinite(products).all():
        return []
    _, values, directions = np.linalg.svd(products[:, moving])
    basis = reduced_rows(directions[np.count_nonzero(values > CONSTANT * values[0]) :], DEPENDENT)
    whole = (np.abs(basis - (basis > 0.5)) < DEPENDENT).all(axis=1)
    return [tuple(moving[row > 0.5].tolist()) for row in basis[whole] if np.count_nonzero(row > 0.5) > 1]
