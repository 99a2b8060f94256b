"""The implicit midpoint rule, the symplectic Gauss method of order 2, for any system."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numba.extending import register_jitable

from ..engine.caching import cached_njit
from ._common import FixedStepResult, check_state, drive_signature, drive_steps, integrate_in_place

__all__ = ["implicit_midpoint"]

MOST_ITERATIONS = 100
SOLVED = 1e-12  # relative change of the slope below which an iteration that no longer improves has converged


def implicit_midpoint(
    rhs: Callable[..., None],
    t_span: tuple[float, float],
    y0: Any,
    h: float,
    *,
    params: Any = None,
    save_every: int | None = None,
) -> FixedStepResult:
    """Integrate y' = f(t, y) by the implicit midpoint rule with a fixed step.

    y_new = y + h k, k = f(t + h / 2, y + h k / 2). Symplectic for canonical equations; it keeps quadratic
    invariants, such as x p_y - y p_x, and no others. The equation for k is solved by fixed-point iteration until
    round-off, from an extrapolation of the last two steps.

    Parameters
    ----------
    rhs : callable
        ``rhs(t, y, out[, params])`` fills out. A function jitted lazily by Numba runs compiled, any other callable
        interpreted, through the same loop.
    t_span : tuple of float
        Start and end; a smaller end integrates backward.
    y0 : array_like, shape (n,)
        Initial state, real.
    h : float
        Length of a step, positive in both directions; the last one ends on the end of the interval exactly.
    params : array_like, shape (p,), optional
        Passed to `rhs` as a float64 array when given.
    save_every : int, optional
        Save each `save_every`-th state besides the first and the last; default: these two only.

    Returns
    -------
    FixedStepResult
        A record with t (m,), y (n, m), nfev, wall_time [s] and message. Where the iteration does not converge, with h
        times the largest derivative of f above about 2, the run ends, and the states from there on are nan.

    Raises
    ------
    TypeError
        The state or `params` are not made of real numbers, or `rhs` is not callable.
    ValueError
        An argument has a wrong value. The message says what came and what was expected.

    References
    ----------
    E. Hairer, C. Lubich, G. Wanner, Geometric Numerical Integration (2006), theorems IV.2.1 and VI.4.2; the end of the
    iteration as in section VIII.6.

    Examples
    --------
    >>> from eip_scipy.comparators import implicit_midpoint
    >>> def oscillator(t, y, out):
    ...     out[:] = y[1], -y[0]
    >>> run = implicit_midpoint(oscillator, (0.0, 100.0), [1.0, 0.0], 0.1)
    >>> bool(abs((run.y[:, -1] ** 2).sum() - 1.0) < 1e-13)
    True
    """
    y = check_state(y0)
    return integrate_in_place(
        rhs, "rhs", _compiled_drive, _drive, t_span, y, h, params, save_every, np.zeros(0), np.zeros(4 * y.size)
    )


@register_jitable
def _step(rhs, extra, t, h, constants, work, count, y):
    """One step in place; work holds k, the k of the step before, a stage, and f there."""
    n = y.size
    k, before, stage, f = work[:n], work[n : 2 * n], work[2 * n : 3 * n], work[3 * n :]
    for i in range(n):
        guess = 2.0 * k[i] - before[i]
        before[i] = k[i]
        k[i] = guess
    last = np.inf
    for _ in range(MOST_ITERATIONS):
        for i in range(n):
            stage[i] = y[i] + 0.5 * h * k[i]
        rhs(t + 0.5 * h, stage, f, *extra)
        count[0] += 1
        change = 0.0
        size = 0.0
        for i in range(n):
            change = max(change, abs(f[i] - k[i]))
            size = max(size, abs(f[i]))
            k[i] = f[i]
        if change == 0.0 or (change >= last and change <= SOLVED * size):
            for i in range(n):
                y[i] += h * k[i]
            return True
        last = change
    return False


def _drive(rhs, extra, t0, h, last_step, saved, constants, work, count, y, ys):
    drive_steps(_step, rhs, extra, t0, h, last_step, saved, constants, work, count, y, ys)


@cache
def _compiled_drive(n_extra: int) -> Callable[..., None]:
    """`_drive` compiled once for all functions, typed as first-class functions; found in Numba's cache afterwards."""
    return cached_njit(drive_signature(n_extra), error_model="numpy")(_drive)
