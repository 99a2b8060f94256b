"""Statistics over the members of an ensemble, accumulated chunk by chunk."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

__all__ = ["Statistics", "merge", "statistics_of"]


@dataclass(frozen=True, repr=False)
class Statistics:
    """Mean, variance and extremes of k quantities over members, at each of m times.

    Members without a state at a time, such as those that failed before, are not included at that time; `count` is the
    number of the others.

    Attributes
    ----------
    t : ndarray, shape (m,)
        Times.
    count : ndarray, shape (m,)
        Number of members included.
    mean : ndarray, shape (k, m)
        Mean values.
    squares : ndarray, shape (k, m)
        Sum of the squares of the deviations from the mean.
    min, max : ndarray, shape (k, m)
        Smallest and largest values.
    """

    t: np.ndarray
    count: np.ndarray
    mean: np.ndarray
    squares: np.ndarray
    min: np.ndarray
    max: np.ndarray

    @property
    def var(self) -> np.ndarray:
        """Variance (k, m) of the members, divided by their number; nan if there are none."""
        return self.squares / np.where(self.count > 0, self.count, np.nan)

    @property
    def std(self) -> np.ndarray:
        """Standard deviation (k, m) of the members; nan if there are none."""
        return np.sqrt(self.var)

    def __repr__(self) -> str:
        members = " to ".join(map(str, sorted({int(self.count.min()), int(self.count.max())})))
        quantities, times = self.mean.shape
        return f"Statistics of {members} members at {times} times, {quantities} quantities: mean, var, std, min, max"


def statistics_of(reduce: Any, t: np.ndarray, states: np.ndarray) -> Statistics | None:
    """Return the statistics over some members of their `states` (members, m, n), nan if there is none, at times t (m,).

    The quantities are the states themselves, or ``reduce(t, y) -> float or (k,)``. Return None if no member has a
    state, so that the number of quantities is unknown.
    """
    there = ~np.isnan(states).any(axis=2)
    values = states if isinstance(reduce, str) else _values(reduce, t, states, there)
    if values is None:
        return None
    if values.dtype.kind == "c":
        raise TypeError("reduce: the quantities are complex, expected real numbers; pass a real function reduce(t, y).")
    count = there.sum(axis=0)
    weight = there[:, :, None]
    divisor = np.maximum(count, 1)[:, None]
    mean = np.where(weight, values, 0.0).sum(axis=0) / divisor
    squares = (np.where(weight, values - mean, 0.0) ** 2).sum(axis=0)
    low, high = np.where(weight, values, np.inf).min(axis=0), np.where(weight, values, -np.inf).max(axis=0)
    some = (count > 0)[:, None]
    mean, low, high = (np.where(some, a, np.nan) for a in (mean, low, high))
    return Statistics(t, count, mean.T, squares.T, low.T, high.T)


def _values(reduce: Callable[..., Any], t: np.ndarray, states: np.ndarray, there: np.ndarray) -> np.ndarray | None:
    """Return the values (members, m, k) of `reduce`, nan where the mask `there` is False; None if it is everywhere."""
    out: np.ndarray | None = None
    for i, j in zip(*np.nonzero(there), strict=True):
        value = np.atleast_1d(np.asarray(reduce(float(t[j]), states[i, j].copy())))
        if out is None:
            if value.ndim != 1 or value.dtype.kind not in "fiubc":
                raise TypeError(f"reduce returned {value!r}, expected a number or a 1-D array of numbers (k,).")
            dtype = complex if value.dtype.kind == "c" else float
            out = np.full((*there.shape, value.size), np.nan, dtype)
        out[i, j] = value
    return out


def merge(first: Statistics | None, second: Statistics | None) -> Statistics | None:
    """Return the statistics of the union of two groups (Chan, Golub & LeVeque 1983, eq. 2.1).

    None stands for a group without any state. The order affects the last bits: merge chunks in order.
    """
    if first is None or second is None:
        return first if second is None else second
    count = first.count + second.count
    total = np.maximum(count, 1)
    none, alone = first.count == 0, second.count == 0
    shift = np.where(none | alone, 0.0, second.mean - first.mean)
    mean = np.where(none, second.mean, first.mean + shift * (second.count / total))
    squares = first.squares + second.squares + shift**2 * (first.count * (second.count / total))
    return Statistics(first.t, count, mean, squares, np.fmin(first.min, second.min), np.fmax(first.max, second.max))
