"""Dense output that can be pickled without the functions of its run: a polynomial through states of a step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.integrate import DenseOutput

from .inputs import refuse_units, shown

__all__ = ["AtRealTimes", "KeptDenseOutput", "kept"]

Array = np.ndarray
# Degrees that are tried one after the other. A degree is enough if its error is below the tolerance, as a share of the
# largest value of a component in the step, or not half that of the degree before: then the error is rounding.
DEGREES = 8, 16, 32, 64
TOLERANCE = 1e-14


class AtRealTimes(DenseOutput):
    """Dense output that raises a clear error for times that are not real numbers."""

    def __call__(self, t: Any) -> Array:
        """Return the states at a time or at times (m,), as (n,) or (n, m).

        Raises
        ------
        TypeError
            If times are not real numbers, or have a unit.
        """
        real = np.asarray(t).dtype.kind in "fiub"
        if not real or type(t) not in (float, np.float64, Array):
            refuse_units(t=t)
        if not real:
            raise TypeError(f"dense output is defined at real times, got {shown(t)}.")
        return super().__call__(t)


class KeptDenseOutput(AtRealTimes):
    """The polynomial through states of one step, in barycentric form; at both ends it returns exactly the given states.

    `shares` (k,) are the distinct times of the `states` (k, n) in units of the step, in increasing order from 0, which
    is `t_old`, to 1, which is `t`.
    """

    def __init__(self, t_old: float, t: float, shares: Array, states: Array) -> None:
        super().__init__(t_old, t)
        self._shares, self._states = shares, states
        self._weights = _barycentric_weights(self._shares)

    def __reduce__(self) -> Any:
        return KeptDenseOutput, (self.t_old, self.t, self._shares, self._states)

    def _call_impl(self, t: Array) -> Array:
        shares = (np.array(t, float, ndmin=1) - self.t_old) / (self.t - self.t_old)
        out = _polynomial(self._shares, self._weights, self._states, shares).T
        return out[:, 0] if t.ndim == 0 else out


def kept(t_old: float, t: float, states: Callable[[Array], Array]) -> KeptDenseOutput:
    """Return a polynomial through ``states(times) -> (n, m)`` over the step from `t_old` to `t`, see `DEGREES`."""

    def polynomial() -> KeptDenseOutput:
        return KeptDenseOutput(t_old, t, (times - t_old) / (t - t_old), found)

    times = _times(t_old, t, DEGREES[0])
    found = states(times).T
    left = np.full(found.shape[1], np.inf)
    for degree in DEGREES[1:]:
        further = np.setdiff1d(_times(t_old, t, degree), times)
        if further.size == 0:
            break
        values = states(further).T
        error = np.abs(polynomial()(further).T - values).max(axis=0)
        largest = np.maximum(np.abs(found).max(axis=0), np.abs(values).max(axis=0))
        if np.all((error <= TOLERANCE * largest) | (error > 0.5 * left)):
            break
        times, left = np.concatenate([times, further]), error
        order = np.argsort(times if t > t_old else -times)
        times, found = times[order], np.concatenate([found, values])[order]
    return polynomial()


def _times(t_old: float, t: float, degree: int) -> Array:
    """Return the distinct times nearest to the Chebyshev-Lobatto nodes of a step, in the order of the step."""
    shares = np.sin(0.5 * np.pi * np.arange(degree + 1) / degree) ** 2
    times = np.unique(np.clip(t_old + shares * (t - t_old), min(t_old, t), max(t_old, t)))
    times = times if t > t_old else times[::-1].copy()
    times[0], times[-1] = t_old, t
    return times


def _barycentric_weights(nodes: Array) -> Array:
    """Return the barycentric weights of distinct nodes in [0, 1].

    A common factor of the weights has no effect. The differences are multiplied by 4, the inverse of the capacity of
    [0, 1], so that the weights neither overflow nor underflow.
    """
    differences = 4.0 * (nodes[:, None] - nodes)
    np.fill_diagonal(differences, 1.0)
    return 1.0 / differences.prod(axis=1)


def _polynomial(nodes: Array, weights: Array, values: Array, at: Array) -> Array:
    """Return the values (m, n), at the points `at` (m,), of the polynomial that has `values` (k, n) at `nodes` (k,)."""
    differences = at[:, None] - nodes
    met = differences == 0.0
    shares = weights / np.where(met, 1.0, differences)
    shares[met.any(axis=1)] = 0.0
    shares[met] = 1.0
    return (shares @ values) / shares.sum(axis=1)[:, None]
