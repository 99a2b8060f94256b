"""Balances among the invariants of a run: indices of their values, their rates, and how the engine calls the rates."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import copy
from typing import Any

import numpy as np

from ..engine.native import Call, Rates, call
from .functions import NotCompilableError, is_jitted, jit_is_off, scalars
from .inputs import numbers, shown

__all__ = ["Carried", "bound", "real_value", "time_shift"]

Array = np.ndarray
NO_PLACES, NO_BOUNDS = np.zeros(0, np.int64), np.zeros(0)
# Shifts of differences in time, in fixed steps and in first steps of adaptive ones, which are shorter than later ones.
OF_FIXED, OF_FIRST = 1 / 32, 1 / 8
# Parts of the run's interval, and roundings of the time, that a shift has at most and at least.
PARTS, ROUNDINGS = 8.0, 16.0


def bound(fun: Callable[..., Any], arguments: tuple) -> Callable[..., Any]:
    """Return ``fun`` with its last arguments bound; ``fun`` itself if there are none."""
    return (lambda *first: fun(*first, *arguments)) if arguments else fun


def real_value(value: Any, what: str, t: float, expected: tuple[int, ...] | None = None) -> Array:
    """Return the value of the function `what` at t as an array; raise an error if it is not real or not `expected`."""
    if isinstance(value, float) and not expected:
        return np.array(float(value))
    found = numbers(f"{what} returned", value)
    if found is not None and found.dtype.kind == "c":
        raise ValueError(
            f"{what} returned complex values at t={t:g}; expected a real number or a real array of shape (l,)."
        )
    if found is None:
        raise TypeError(
            f"{what} returned {shown(value)} at t={t:g}; expected a real number or a real array of shape (l,)."
        )
    if expected is not None and found.shape != expected:
        raise ValueError(f"{what} returned shape {found.shape} at t={t:g}, expected {expected}.")
    return found


def time_shift(tau: float, adaptive: bool, t_span: tuple[float, float]) -> float:
    """Return the shift in time, a power of two, for differences that give dF/dt; 0 for an empty interval."""
    t0, length = t_span[0], abs(t_span[1] - t_span[0])
    wanted = tau * (OF_FIRST if adaptive else OF_FIXED) if 0 < tau < math.inf else math.inf
    shift = max(min(wanted, length / PARTS), ROUNDINGS * float(np.spacing(abs(t0))))
    return 2.0 ** math.floor(math.log2(shift)) if length > 0 and shift < math.inf else 0.0


class Carried:
    """The balances among the invariants of a run.

    `items`, `labels` and `shapes` are all invariants of the run, their names, and the shapes of their values. `starts`
    are the indices of their first values among all values, and at the end the number of values. In each call the run's
    further arguments, `extra`, follow the item's own.

    The attribute `items` maps the index of each balance among all items to the balance. After `compile_rates` a jitted
    balance without a given rate has a compiled rate, if its function can be compiled for dual numbers. `places` (b,)
    are the indices of the balances' values among all values, and `mask` (l,) is True for them. `most_slowness` (b,) are
    the bounds for `Diagnostics.slowness` above which a run warns.
    """

    def __init__(
        self,
        items: Sequence[Any],
        labels: Sequence[str],
        starts: Sequence[int],
        shapes: Sequence[tuple[int, ...]],
        extra: tuple,
    ) -> None:
        self._labels, self._starts, self._shapes, self._extra = labels, starts, shapes, extra
        self.items = {k: item for k, item in enumerate(items) if item.is_balance}
        self._given = {k for k, item in self.items.items() if item.rate_function is not None}
        self.mask = np.zeros(starts[-1], bool)
        self.places, self.most_slowness = NO_PLACES, NO_BOUNDS
        if not self.items:
            return
        most = np.zeros(starts[-1])
        for k, item in self.items.items():
            own = slice(starts[k], starts[k + 1])
            self.mask[own], most[own] = True, item.most_slowness
        self.places = np.flatnonzero(self.mask).astype(np.int64)
        self.most_slowness = most[self.places]

    def compile_rates(self, n: int) -> None:
        """Compile rates by dual numbers for jitted balances without a rate; the state is real and has n components."""
        numbers = scalars(self._extra) if self.items else None
        for k, item in self.items.items():
            lacks = item.rate_function is None and not item.args and is_jitted(item.function) and not jit_is_off()
            if not lacks or numbers is None:
                continue
            from .jitted_gradients import rate_by_duals  # which loads Numba

            item = copy(item)
            try:
                item.rate_function = rate_by_duals(item.function, n, self._shapes[k], bool(self._extra), numbers)
            except NotCompilableError:  # the gradient and differences in time take its place
                continue
            item.rate_uses_f = True
            self.items[k] = item

    def check(self, t: float, y: Array, f: Array) -> None:
        """Raise an error if a given rate at the start is not real and finite, or has another shape than the balance."""
        for k in sorted(self._given):
            value = self._rate(k, t, y, f)
            if not np.isfinite(value).all():
                raise ValueError(f"{self._what(k)} is not finite at y0: it returned {value}.")

    def known(self, t: float, y: Array, f: Array) -> Array:
        """Return the known rates (l,) of all values: 0 for invariants, NaN for balances whose rate is not given."""
        rates = np.where(self.mask, np.nan, 0.0)
        for k in self._given:
            rates[self._starts[k] : self._starts[k + 1]] = self._rate(k, t, y, f)
        return rates

    @property
    def given_places(self) -> Array:
        """Return the indices, among all values, of the values whose rates are given."""
        return np.array([p for k in sorted(self._given) for p in range(self._starts[k], self._starts[k + 1])], np.intp)

    def given(self, t: float, y: Array, f: Array) -> Array:
        """Return the rates that are given by functions of the user, at (t, y), in the order of `given_places`."""
        return self.known(t, y, f)[self.given_places]

    def rates(self, low: float, high: float, shift: float, functions: Sequence[Any] | None = None) -> Rates:
        """Return the `Rates`, of compiled `functions` or by default the user's, in a run from `low` to `high`."""
        items = tuple((k, self._starts[k + 1] - self._starts[k]) for k in self.items)
        return Rates(items, tuple(map(self._call, self.items) if functions is None else functions), low, high, shift)

    def _what(self, k: int) -> str:
        return f"rate of balance {self._labels[k]!r}"

    def _rate(self, k: int, t: float, y: Array, f: Array) -> Array:
        item = self.items[k]
        rate = bound(item.rate_function, item.args + self._extra)
        value = rate(t, y.copy(), f.copy()) if item.rate_uses_f else rate(t, y.copy())
        return real_value(value, self._what(k), t, self._shapes[k]).astype(float)

    def _call(self, k: int) -> Call | None:
        item, shape, what = self.items[k], self._shapes[k], self._what(k)
        if item.rate_function is None:
            return None

        def convert(found: Any, t: float) -> Array:
            return np.array(real_value(found, what, t, shape), float, order="C")

        arguments = item.args + self._extra
        return call(item.rate_function, arguments, shape, convert, real=True, takes_f=item.rate_uses_f)
