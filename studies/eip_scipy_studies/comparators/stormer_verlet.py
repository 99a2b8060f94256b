"""Störmer-Verlet (leapfrog), the symplectic method of order 2 for q'' = a(t, q), in both of its forms."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ._steps import FixedStepResult, FixedSteps, add, check_state, drive, inlined, njit

__all__ = ["FORMS", "StormerVerletResult", "newton", "stormer_verlet"]

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
        ``acc(t, q[, params]) -> (n/2,)``. A function jitted by Numba runs compiled, any other callable interpreted.
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
        A record with t (m,), y (n, m), nfev (the number of steps plus one), wall_time [s] and message.

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
    steps, y = FixedSteps.of(t_span, h, save_every), check_state(y0)
    half = y.size // 2
    if y.size == 0 or y.size % 2:
        raise ValueError(f"y0 must hold q and v, an even number of components, got {y.size}")
    if form not in FORMS:
        raise ValueError(f"unknown form {form!r}: expected one of {', '.join(map(repr, FORMS))}")
    extra = () if params is None else (check_state(params, "params"),)
    value = acc(steps.t0, y[:half].copy(), *extra)
    if np.iscomplexobj(value) or np.shape(value) != (half,):
        raise ValueError(f"acc returned {value!r}, expected an array of {half} real numbers")
    step, kicks = (_kick_drift_kick, True) if form == FORMS[0] else (_drift_kick_drift, False)
    run = drive(step, acc, steps, y, params, takes=half, fills=half, returns=True, start=kicks)
    return StormerVerletResult(run.t, run.y, int(steps.saved[-1]) + 1, run.wall_time, run.message)


@inlined
def _kick_drift_kick(fun, t, h, q, v, params, constant, a, work):  # type: ignore[no-untyped-def]
    add(v, 0.5 * h, a)
    add(q, h, v)
    fun(t + h, q, a, params)
    add(v, 0.5 * h, a)
    return 1


@inlined
def _drift_kick_drift(fun, t, h, q, v, params, constant, a, work):  # type: ignore[no-untyped-def]
    add(q, 0.5 * h, v)
    fun(t + 0.5 * h, q, a, params)
    add(v, h, a)
    add(q, 0.5 * h, v)
    return 1


@njit(error_model="numpy")
def newton(t, q, gm):  # type: ignore[no-untyped-def]
    """Return the accelerations (3 N,) of N bodies under their mutual gravity; `gm` (N,) is G times the masses."""
    n, k = gm.size, 0
    out, pulls = np.zeros(3 * n), np.empty(n * (n - 1) // 2)  # r^-3 of the pairs, in a loop that vectors can take
    for i in range(1, n):
        for j in range(i):
            x, y, z = q[3 * j] - q[3 * i], q[3 * j + 1] - q[3 * i + 1], q[3 * j + 2] - q[3 * i + 2]
            pulls[k] = x * x + y * y + z * z
            k += 1
    for k in range(pulls.size):
        pulls[k] = 1.0 / (pulls[k] * np.sqrt(pulls[k]))
    k = 0
    for i in range(1, n):
        ax = ay = az = 0.0
        for j in range(i):
            x, y, z = q[3 * j] - q[3 * i], q[3 * j + 1] - q[3 * i + 1], q[3 * j + 2] - q[3 * i + 2]
            a, b = gm[j] * pulls[k], gm[i] * pulls[k]
            k += 1
            ax, ay, az = ax + a * x, ay + a * y, az + a * z
            out[3 * j] -= b * x
            out[3 * j + 1] -= b * y
            out[3 * j + 2] -= b * z
        out[3 * i] += ax
        out[3 * i + 1] += ay
        out[3 * i + 2] += az
    return out
