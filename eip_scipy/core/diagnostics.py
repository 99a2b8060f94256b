"""Numbers about runs: invariants along a solution, drift of a defect, observed order."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from .inputs import refuse_units
from .invariants import Invariant, as_invariants

__all__ = ["DriftSlope", "drift_slope", "invariants_along", "observed_order"]


class DriftSlope(NamedTuple):
    """Result of `drift_slope`.

    Attributes
    ----------
    slope : float or ndarray, shape (l,)
        Change of the defect per unit of time.
    stderr : float or ndarray, shape (l,)
        Its standard error, for residuals that do not depend on each other.
    """

    slope: Any
    stderr: Any


def drift_slope(t: Any, defects: Any) -> DriftSlope:
    """Least-squares slope of defects in time, with its standard error.

    Parameters
    ----------
    t : array_like, shape (m,)
        Times, at least three, not all equal.
    defects : array_like, shape (m,) or (l, m)
        One defect, or one in each row, with its sign.

    Returns
    -------
    DriftSlope
        slope and stderr, numbers for one defect, else (l,).

    Raises
    ------
    ValueError
        When shapes disagree, a number is not finite, or there are fewer than three different times.

    Notes
    -----
    The standard error takes the residuals for independent. Those of a random walk are not: there the slope of a run
    without drift is several standard errors.

    Examples
    --------
    >>> drift_slope([0, 1, 2, 3], [0.0, 2.1, 3.9, 6.0]).slope
    1.98
    """
    refuse_units(t=t, defects=defects)
    t = np.asarray(t, dtype=float)
    d = np.asarray(defects, dtype=float)
    if t.ndim != 1 or d.ndim not in (1, 2) or d.shape[-1] != t.size:
        raise ValueError(f"drift_slope: t has shape {t.shape} and defects {d.shape}; expected (m,) and (m,) or (l, m).")
    if t.size < 3 or not (np.isfinite(t).all() and np.isfinite(d).all()):
        raise ValueError("drift_slope needs at least three times, and finite numbers only.")
    x = t - t.mean()
    squares = x @ x
    if squares == 0:
        raise ValueError("drift_slope: all times are equal.")
    centred = d - d.mean(axis=-1, keepdims=True)
    slope = centred @ x / squares
    residual = centred - np.multiply.outer(slope, x)
    size = np.linalg.norm(residual, axis=-1)
    stderr = size / np.sqrt((t.size - 2) * squares)
    if d.ndim == 1:
        return DriftSlope(float(slope), float(stderr))
    return DriftSlope(slope, stderr)


def observed_order(errors: Any, steps: Any) -> np.ndarray:
    """Orders of convergence between neighbours, log(e_i / e_{i+1}) / log(h_i / h_{i+1}).

    Parameters
    ----------
    errors : array_like, shape (k,) or (k, m)
        Errors at the steps, along the first axis; signs are ignored.
    steps : array_like, shape (k,)
        Steps, positive, neighbours different.

    Returns
    -------
    ndarray, shape (k - 1,) or (k - 1, m)
        nan where an error is 0 or not finite.

    Raises
    ------
    ValueError
        When shapes disagree or steps are not positive or equal neighbours.

    Examples
    --------
    >>> observed_order([1e-2, 6.25e-4], [0.1, 0.05])
    array([4.])
    """
    refuse_units(errors=errors, steps=steps)
    e = np.abs(np.asarray(errors, dtype=float))
    h = np.asarray(steps, dtype=float)
    if h.ndim != 1 or e.ndim not in (1, 2) or len(e) != h.size or h.size < 2:
        raise ValueError(
            f"observed_order: errors have shape {e.shape} and steps {h.shape}; expected the same length, at least 2."
        )
    if not (np.isfinite(h).all() and (h > 0).all()) or (np.diff(h) == 0).any():
        raise ValueError("observed_order: steps must be positive, and neighbours different.")
    logs = np.log(np.where(np.isfinite(e) & (e > 0), e, np.nan))
    ratios = np.diff(np.log(h))
    return np.diff(logs, axis=0) / (ratios if e.ndim == 1 else ratios[:, None])


def invariants_along(invariants: Any, t: Any, y: Any, *, params: Any = None) -> np.ndarray:
    """Values of invariants along a solution.

    Parameters
    ----------
    invariants : Invariant or sequence of Invariant
        A `Problem`'s are ``problem.invariants``.
    t : array_like, shape (m,)
    y : array_like, shape (n, m)
        States in columns, as in the results of `integrate` and `scipy.integrate.solve_ivp`.
    params : array_like, optional
        Passed on as the last argument, as `integrate` does.

    Returns
    -------
    ndarray, shape (l, m)
        One row for each invariant, a vector's components in rows of their own.

    Raises
    ------
    ValueError
        When shapes disagree.
    """
    refuse_units(t=t, y=y, params=params)
    t, states = np.asarray(t, dtype=float), np.asarray(y)
    if t.ndim != 1 or states.ndim != 2 or states.shape[1] != t.size:
        raise ValueError(f"invariants_along: t has shape {t.shape} and y {states.shape}; expected (m,) and (n, m).")
    extra = () if params is None else (np.ascontiguousarray(params, dtype=float),)
    rows = [_along(item, t, np.ascontiguousarray(states.T), extra) for item in as_invariants(invariants)]
    return np.concatenate(rows) if rows else np.zeros((0, t.size))


def _along(item: Invariant, t: np.ndarray, states: np.ndarray, extra: tuple[Any, ...]) -> np.ndarray:
    values = [item.fun(float(at), state.copy(), *item.args, *extra) for at, state in zip(t, states, strict=True)]
    return np.array(values, dtype=float).reshape(t.size, -1).T if values else np.zeros((1, 0))
