"""The implicit midpoint rule, the symplectic Gauss method of order 2, for any system."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from ._steps import FixedStepResult, FixedSteps, check_state, drive, inlined

__all__ = ["implicit_midpoint"]

MOST_ITERATIONS = 100
SOLVED = 1e-12  # relative change below which an iteration that no longer improves is done


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

    y_new = y + h k, k = f(t + h / 2, y + h k / 2). The rule is symplectic for canonical equations. It keeps linear and
    quadratic invariants, such as x p_y - y p_x, but in general no others. The equation for k is solved to round-off by
    fixed-point iteration, which starts from an extrapolation of the last two steps.

    Parameters
    ----------
    rhs : callable
        ``rhs(t, y, out[, params])`` fills out. A function jitted by Numba runs compiled, any other callable
        interpreted.
    t_span, y0, h, params, save_every
        As for `stormer_verlet`, with any state.

    Returns
    -------
    FixedStepResult
        A record with t (m,), y (n, m), nfev, wall_time [s] and message. The iteration
        converges if h times the norm of the Jacobian of f is below about 2; otherwise the run ends, and the states from
        there on are nan.

    References
    ----------
    E. Hairer, C. Lubich, G. Wanner, Geometric Numerical Integration (2006), theorems IV.2.1 and VI.4.2; the stopping
    criterion of the iteration as in section VIII.6.

    Examples
    --------
    >>> from eip_scipy_studies.comparators import implicit_midpoint
    >>> def oscillator(t, y, out):
    ...     out[:] = y[1], -y[0]
    >>> run = implicit_midpoint(oscillator, (0.0, 100.0), [1.0, 0.0], 0.1)
    >>> bool(abs((run.y[:, -1] ** 2).sum() - 1.0) < 1e-13)
    True
    """
    y = check_state(y0)
    steps = FixedSteps.of(t_span, h, save_every)
    return drive(_step, rhs, steps, y, params, takes=y.size, fills=y.size)


@inlined
def _step(fun, t, h, y, v, params, constant, f, work):  # type: ignore[no-untyped-def]
    n = y.size
    stage, k, before = work[0], work[1], work[2]
    for i in range(n):
        k[i], before[i] = 2.0 * k[i] - before[i], k[i]
    last = math.inf
    for iteration in range(1, MOST_ITERATIONS + 1):
        for i in range(n):
            stage[i] = y[i] + 0.5 * h * k[i]
        fun(t + 0.5 * h, stage, f, params)
        change = size = 0.0
        for i in range(n):
            change, size = max(change, abs(f[i] - k[i])), max(size, abs(f[i]))
            k[i] = f[i]
        if change == 0.0 or (change >= last and change <= SOLVED * size):
            for i in range(n):
                y[i] += h * k[i]
            return iteration
        last = change
    return -MOST_ITERATIONS
