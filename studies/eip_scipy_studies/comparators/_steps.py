"""Common part of the methods with fixed steps: their times, their result, and the loop over steps.

The loop is compiled by Numba if the user's function is, and runs as Python otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

try:
    from numba import njit as njit
except ImportError:  # everything then runs as Python

    def njit(function: Any = None, **_: Any) -> Any:
        """Return the function itself."""
        return (lambda given: given) if function is None else function


inlined = njit(forceinline=True, error_model="numpy")
"""Decorator of the parts of a step."""

FEWEST_STEPS, PAUSE = 64, 0.02  # steps, and seconds, after which an interrupt by the user is noticed


@dataclass(frozen=True)
class Result:
    """Result of a method: saved times t (m,) and states y (n, m), which are nan after a failure.

    `nfev` counts evaluations of the user's function, or pairs of transforms of a field. `wall_time` [s] is without
    compilation and without planning transforms. `message` is "compiled", "interpreted" or, for fields, "completed", or
    says where and why the method failed. `modified_energy` (m,) is the one that `sav_crank_nicolson` keeps.
    """

    t: np.ndarray
    y: np.ndarray
    nfev: int
    wall_time: float
    message: str
    modified_energy: Any = None


class FixedSteps(NamedTuple):
    """Steps of a run: signed lengths `h` and `last`, and numbers of the steps after which a state is saved, 0 first."""

    t0: float
    t_bound: float
    h: float
    last: float
    saved: np.ndarray

    @classmethod
    def of(cls, t_span: Any, h: Any, save_every: int | None = None) -> FixedSteps:
        """Return the steps of length `h` over `t_span`, or raise a ValueError; the number of steps is `integrate`'s."""
        span = np.array(t_span, dtype=float)
        if span.shape != (2,) or not np.isfinite(span).all():
            raise ValueError(f"t_span must hold two finite numbers, got {t_span!r}")
        if not 0 < h < math.inf:
            raise ValueError(f"`h` must be positive. Got {h!r}; give a real number > 0.")
        if save_every is not None and (save_every != int(save_every) or save_every < 1):
            raise ValueError(f"save_every must be a positive integer or None, got {save_every!r}")
        t0, t_bound = span.tolist()
        length, ends = abs(t_bound - t0), abs(t0) + abs(t_bound)
        slack = max(1e-9, 8 * np.finfo(float).eps * (length + ends) / h)  # of the number of steps, by rounding
        if length and h > length * (1 + slack):
            raise ValueError(f"`h` exceeds bounds. Got h = {h:g} for an interval of length {length:g}.")
        if length and h < 10 * math.ulp(max(abs(t0), abs(t_bound))):
            raise ValueError(f"`h` is too small: h = {h:g} is below 10 spacings of t. Give a larger h.")
        whole = max(round(length / h), 1) if length else 0
        n_steps = whole if abs(length / h - whole) <= slack else math.ceil(length / h)
        step = math.copysign(h, t_bound - t0)
        saved = np.append(np.arange(0, n_steps, save_every or max(n_steps, 1)), n_steps)
        return cls(t0, t_bound, step, (t_bound - t0) - (n_steps - 1) * step, saved)

    @property
    def t(self) -> np.ndarray:
        """Return the saved times."""
        t = self.t0 + self.saved * self.h
        t[-1] = self.t_bound
        return t


def check_state(y0: Any, name: str = "y0") -> np.ndarray:
    """Return a copy of a vector of real, finite numbers; `name` is its name in errors."""
    if np.iscomplexobj(y0):
        raise TypeError(f"{name} must be real, got complex numbers")
    y = np.array(y0, dtype=float)
    if y.ndim != 1 or not np.isfinite(y).all():
        raise ValueError(f"{name} must be 1-dimensional and finite, got {y0!r}")
    return y


def drive(
    step: Callable[..., int], fun: Callable[..., Any], steps: FixedSteps, y: np.ndarray, params: Any,
    *, takes: int, fills: int, returns: bool = False, constant: float = 0.0, start: bool = False,
) -> Result:  # fmt: skip
    """Make all steps of a scheme with a user's function.

    ``step(fun, t, h, x, v, params, constant, f, work) -> evaluations``, `inlined`, advances the state in place, whose
    parts are x (takes,) and v (n - takes,). A negative number of evaluations is a failure. `f` (fills,) is a buffer for
    the values of ``fun(t, x, f, *params)``, with the value at the start if `start` is set; `work` (3, n) is 0 at the
    start. Both are kept between steps. If `returns` is set, the user's function is ``fun(t, x[, params])``.
    """
    if not callable(fun):
        raise TypeError(f"{fun!r} is not callable")
    given: tuple[np.ndarray, ...] = () if params is None else (check_state(params, "params"),)
    compiled = hasattr(fun, "py_func")
    called = _filling(fun, compiled) if returns else fun
    parts: list[Any] = [part if compiled else getattr(part, "py_func", part) for part in (_march, step)]
    march, own = parts
    ys = np.full((steps.saved.size, y.size), np.nan)
    ys[0], f, work = y, np.zeros(fills), np.zeros((3, y.size))
    x, v = y[:takes], y[takes:]
    arguments = own, called, steps.t0, steps.h, steps.last, steps.saved, ys, x, v, given, constant, f, work
    march(*arguments, 0, 0, 1)  # compiles
    begin = perf_counter()
    if start and steps.saved[-1]:
        called(steps.t0, x, f, *given)
    k, row, evaluations, size, failed = 0, 1, int(start), FEWEST_STEPS, False
    while k < steps.saved[-1] and not failed:
        before, end = perf_counter(), min(k + size, int(steps.saved[-1]))
        row, more, failed = march(*arguments, k, end, row)
        k, evaluations = end, evaluations + more
        if perf_counter() - before < PAUSE:
            size *= 2
    wall_time = perf_counter() - begin
    message, finite = "compiled" if compiled else "interpreted", np.isfinite(ys).all(axis=1)
    if not finite.all():
        message += f"; the saved states from t={steps.t[np.argmin(finite)].item()!r} on are not finite"
    return Result(steps.t, ys.T, evaluations, wall_time, message)


@inlined
def add(x, c, dx):  # type: ignore[no-untyped-def]
    """Add `c` times `dx` to `x`."""
    for i in range(x.size):
        x[i] += c * dx[i]


@inlined
def copy(values, out):  # type: ignore[no-untyped-def]
    """Write `values` to the first components of `out`."""
    for i in range(values.size):
        out[i] = values[i]


@njit(nogil=True, error_model="numpy")
def _march(step, fun, t0, h, last, saved, rows, x, v, params, constant, f, work, k, end, row):  # type: ignore[no-untyped-def]
    """Make the steps from number k to `end`, and return the next row of `rows`, the evaluations and a failure."""
    evaluations = 0
    while k < end:
        made = step(fun, t0 + k * h, last if k == saved[-1] - 1 else h, x, v, params, constant, f, work)
        evaluations += abs(made)
        if made < 0:
            return row, evaluations, True
        k += 1
        if k == saved[row]:
            copy(x, rows[row])
            copy(v, rows[row, x.size :])
            row += 1
    return row, evaluations, False


@lru_cache(maxsize=64)
def _filling(fun: Any, compiled: bool) -> Any:
    """Return ``filling(t, x, out, *params)``, which writes the value of ``fun(t, x, *params)`` to `out`."""

    def filling(t, x, out, *params):  # type: ignore[no-untyped-def]
        copy(fun(t, x, *params), out)

    return inlined(filling) if compiled else filling
