"""Störmer-Verlet (leapfrog), the symplectic method of order 2 for q'' = a(t, q), in both of its forms."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from eip_scipy.native_kernels import FixedStepResult, FixedSteps, check_state, run_second_order

__all__ = ["FORMS", "StormerVerletResult", "stormer_verlet"]

FORMS = ("kick-drift-kick", "drift-kick-drift")


class StormerVerletResult(FixedStepResult):
    """Result of `stormer_verlet`: a `FixedStepResult` with states (q, v), whose `nfev` counts calls of `acc`."""


def stormer_verlet(
    acc: Callable[..., Any],
    t_span: tuple[float, float],
    y0: Any,
    h: float,
    *,
    form: str = "kick-drift-kick",
    params: Any = None,
    save_every: int | None = None,
) -> StormerVerletResult:
    """Integrate q'' = a(t, q) by Störmer-Verlet with a fixed step.

    Both forms are symplectic (as long as all steps are equal), reversible and of order 2, with one evaluation
    per step; their error constants differ. REBOUND's "leapfrog" is the drift-kick-drift form.

    Parameters
    ----------
    acc : callable
        ``acc(t, q[, params]) -> (n/2,)``. A function jitted by Numba and a C function by pointer run compiled, any
        other callable interpreted, in the same loop.
    t_span : tuple of float
        Start and end; a smaller end integrates backward.
    y0 : array_like, shape (n,)
        Initial state (q, v), real.
    h : float
        Length of a step, positive in both directions. Step k starts at t0 + k h; the last one ends on the end of the
        interval exactly, shortened if `h` does not divide the interval.
    form : {"kick-drift-kick", "drift-kick-drift"}
        Order of the updates within a step: v first and last (velocity Verlet), or q first and last.
    params : array_like, shape (p,), optional
        Passed to `acc` as a float64 array when given.
    save_every : int, optional
        Save every `save_every`-th state in addition to the first and the last; default: only these two.

    Returns
    -------
    StormerVerletResult
        A record with t (m,), y (n, m), nfev, wall_time [s] and message.

    Raises
    ------
    TypeError
        If the state, `params` or the value of `acc` is not made of real numbers.
    ValueError
        If an argument has a wrong value, or `acc` returns a wrong shape. The message gives the value and what was
        expected.

    Notes
    -----
    nfev is the number of steps plus one: the first evaluation, which also checks the shape, starts the
    kick-drift-kick form, while the drift-kick-drift form does not use it further.

    References
    ----------
    E. Hairer, C. Lubich, G. Wanner, Geometric numerical integration illustrated by the Störmer-Verlet method,
    Acta Numerica 12 (2003) 399-450.

    Examples
    --------
    >>> import numpy as np
    >>> from eip_scipy_studies.comparators import stormer_verlet
    >>> run = stormer_verlet(lambda t, q: -q, (0.0, 10.0), [1.0, 0.0], 0.01)
    >>> bool(abs(run.y[0, -1] - np.cos(10.0)) < 1e-4)
    True
    """
    steps = FixedSteps.of(t_span, h, save_every)
    y = _check_halves(y0)
    if form not in FORMS:
        raise ValueError(f"unknown form {form!r}: expected one of {', '.join(map(repr, FORMS))}")
    run = run_second_order(form, acc, steps, y, params)
    return StormerVerletResult(run.t, run.y, int(steps.saved[-1]) + 1, run.wall_time, run.message)


def _check_halves(y0: Any) -> np.ndarray:
    y = check_state(y0)
    if y.size == 0 or y.size % 2:
        raise ValueError(f"y0 must hold q and v, an even number of components, got {y.size}")
    return y
