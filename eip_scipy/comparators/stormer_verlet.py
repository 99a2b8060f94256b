"""Störmer-Verlet (leapfrog), the symplectic method of order 2 for q'' = a(t, q), in both of its forms."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from time import perf_counter
from typing import Any

import numpy as np
from numba import types
from numba.core.dispatcher import Dispatcher
from numba.extending import register_jitable

from ..engine.caching import cached_njit
from ._common import FixedStepResult, FixedSteps, check_state, message, real_vector

__all__ = ["FORMS", "StormerVerletResult", "stormer_verlet"]

FORMS = ("kick-drift-kick", "drift-kick-drift")


class StormerVerletResult(FixedStepResult):
    """What `stormer_verlet` returns: a `FixedStepResult` with states (q, v) and evaluations of the acceleration."""


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
        ``acc(t, q[, params]) -> (n/2,)``. A function jitted lazily by Numba that returns a new C-contiguous float64
        array runs compiled; any other callable runs interpreted, through the same loop.
    t_span : tuple of float
        Start and end; a smaller end integrates backward.
    y0 : array_like, shape (n,)
        Initial state (q, v), real.
    h : float
        Length of a step, positive in both directions. Step k starts at t0 + k h; the last one ends on the end of the
        interval exactly, shortened where `h` does not divide the interval.
    form : {"kick-drift-kick", "drift-kick-drift"}
        Order of the updates within a step: v first and last (velocity Verlet), or q first and last.
    params : array_like, shape (p,), optional
        Passed to `acc` as a float64 array when given.
    save_every : int, optional
        Save each `save_every`-th state besides the first and the last; default: these two only.

    Returns
    -------
    StormerVerletResult
        A record with t (m,), y (n, m), nfev, wall_time [s] and message.

    Raises
    ------
    TypeError
        The state, `params` or what `acc` returns is not made of real numbers.
    ValueError
        An argument has a wrong value, or `acc` returns a wrong shape. The message says what came and what was expected.

    Notes
    -----
    nfev is the number of steps plus one: the first evaluation, which also checks the shape, opens the
    kick-drift-kick form, and the drift-kick-drift form has no further use for it.

    References
    ----------
    E. Hairer, C. Lubich, G. Wanner, Geometric numerical integration illustrated by the Störmer-Verlet method,
    Acta Numerica 12 (2003) 399-450.

    Examples
    --------
    >>> import numpy as np
    >>> from eip_scipy.comparators import stormer_verlet
    >>> run = stormer_verlet(lambda t, q: -q, (0.0, 10.0), [1.0, 0.0], 0.01)
    >>> bool(abs(run.y[0, -1] - np.cos(10.0)) < 1e-4)
    True
    """
    steps = FixedSteps.of(t_span, h, save_every)
    y = _check_halves(y0)
    if form not in FORMS:
        raise ValueError(f"unknown form {form!r}: expected one of {', '.join(map(repr, FORMS))}")
    extra = () if params is None else (real_vector(params, "params"),)

    checked = _checked(acc, y.size // 2)
    a = checked(steps.t0, y[: y.size // 2], *extra).copy()
    reason = _why_interpreted(acc, len(extra))
    drive = _drive if reason else _compiled_drive(len(extra))
    ys = np.empty((steps.saved.size, y.size))
    ys[0] = y

    def advance(to_save: np.ndarray) -> None:
        drive(checked if reason else acc, extra, steps.t0, steps.h, steps.last, form == FORMS[0], to_save, y, a, ys)

    # Saving nothing but the start takes no step: whatever is still to be compiled or bound is so before the clock runs.
    advance(steps.saved[:1])
    start = perf_counter()
    advance(steps.saved)
    wall_time = perf_counter() - start
    nfev = int(steps.saved[-1]) + 1
    return StormerVerletResult(steps.t, ys.T, nfev, wall_time, message(reason, steps.t, ys))


def _check_halves(y0: Any) -> np.ndarray:
    y = check_state(y0)
    if y.size == 0 or y.size % 2:
        raise ValueError(f"y0 must hold q and v, an even number of components, got {y.size}")
    return y


def _checked(acc: Callable[..., Any], size: int) -> Callable[..., np.ndarray]:
    """`acc` with its result checked: NumPy would broadcast a scalar and drop an imaginary part silently."""

    def checked(*args: Any) -> np.ndarray:
        value = acc(*args)
        if value is None:
            raise TypeError(f"acc returned None, expected {size} numbers")
        if np.iscomplexobj(value):
            raise TypeError("acc returned complex numbers, expected real ones")
        array = np.ascontiguousarray(value, dtype=float)
        if np.shape(value) != (size,):
            raise ValueError(f"acc returned shape {np.shape(value)}, expected ({size},)")
        return array

    return checked


def _why_interpreted(acc: Callable[..., Any], n_extra: int) -> str:
    """Why `acc` cannot enter the compiled loop; empty when it can."""
    if not isinstance(acc, Dispatcher):
        return "acc is not jitted by Numba"
    signature = _acc_signature(n_extra)
    # The checked first call compiled a lazily jitted acc for these types.
    returned = {known.args: known.return_type for known in acc.nopython_signatures}.get(signature.args)
    if returned is None:
        return f"acc is jitted for other signatures than {signature}"
    return "" if returned == signature.return_type else f"acc returns {returned}, not {signature.return_type}"


def _acc_signature(n_extra: int) -> Any:
    vector = types.float64[::1]
    return vector(types.float64, vector, *[vector] * n_extra)


@cache
def _compiled_drive(n_extra: int) -> Callable[..., None]:
    """`_drive` compiled for any jitted acceleration.

    With the acceleration typed as a first-class function and the signature given, the machine code does not depend on
    the user's function and is found in Numba's cache by the next process.
    """
    vector = types.float64[::1]
    signature = types.void(
        types.FunctionType(_acc_signature(n_extra)),
        types.UniTuple(vector, n_extra),
        types.float64,
        types.float64,
        types.float64,
        types.boolean,
        types.int64[::1],
        vector,
        vector,
        types.float64[:, ::1],
    )
    return cached_njit(signature, error_model="numpy")(_drive)


@cached_njit(error_model="numpy")
def _add(x: np.ndarray, c: float, dx: np.ndarray) -> None:
    """Add c dx to x. Compiled in interpreted runs as well, so that both give the same bits."""
    for i in range(x.size):
        x[i] += c * dx[i]


@register_jitable
def _kick_drift_kick(acc, extra, t, h, q, v, a):
    """One step in place; `a` holds a(t, q) before and after it."""
    _add(v, 0.5 * h, a)
    _add(q, h, v)
    a[:] = acc(t + h, q, *extra)
    _add(v, 0.5 * h, a)


@register_jitable
def _drift_kick_drift(acc, extra, t, h, q, v, a):
    """One step in place; `a` is work space."""
    _add(q, 0.5 * h, v)
    a[:] = acc(t + 0.5 * h, q, *extra)
    _add(v, h, a)
    _add(q, 0.5 * h, v)


def _drive(acc, extra, t0, h, last_step, kick_first, saved, y, a, ys):
    """Take saved[-1] steps; ys[row] receives the state after step saved[row]. `extra` is () or (params,)."""
    half = y.size // 2
    q = y[:half]
    v = y[half:]
    n_steps = saved[-1]
    row = 1
    for k in range(n_steps):
        t = t0 + k * h
        step = last_step if k == n_steps - 1 else h
        if kick_first:
            _kick_drift_kick(acc, extra, t, step, q, v, a)
        else:
            _drift_kick_drift(acc, extra, t, step, q, v, a)
        if k + 1 == saved[row]:
            ys[row] = y
            row += 1
