"""The implicit midpoint rule, the symplectic Gauss method of order 2, for any system."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from eip_scipy.native_kernels import FixedStepResult, FixedSteps, check_state, run_in_place

__all__ = ["implicit_midpoint"]


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
        ``rhs(t, y, out[, params])`` fills out. A function jitted by Numba and a C function by pointer run compiled,
        any other callable interpreted, in the same loop.
    t_span : tuple of float
        Start and end; a smaller end integrates backward.
    y0 : array_like, shape (n,)
        Initial state, real.
    h : float
        Length of a step, positive in both directions; the last one ends on the end of the interval exactly.
    params : array_like, shape (p,), optional
        Passed to `rhs` as a float64 array when given.
    save_every : int, optional
        Save every `save_every`-th state in addition to the first and the last; default: only these two.

    Returns
    -------
    FixedStepResult
        A record with t (m,), y (n, m), nfev, wall_time [s] and message. The iteration
        converges if h times the norm of the Jacobian of f is below about 2; otherwise the run ends, and the states from
        there on are nan.

    Raises
    ------
    TypeError
        If the state or `params` are not made of real numbers, or `rhs` is not callable.
    ValueError
        If an argument has a wrong value. The message gives the value and what was expected.

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
    return run_in_place("implicit-midpoint", rhs, steps, y, params, name="rhs", takes=y.size, fills=y.size)
