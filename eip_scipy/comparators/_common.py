"""What the comparators share: arguments, the loop over fixed steps, and the record that comes back."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from numba import types
from numba.core.dispatcher import Dispatcher
from numba.core.errors import NumbaError
from numba.extending import register_jitable

from ..core.inputs import reals, refuse_units, shown
from ..core.stepping import check_fixed_step, fixed_steps, saved_steps

__all__ = [
    "FixedStepResult",
    "FixedSteps",
    "check_state",
    "drive_signature",
    "drive_steps",
    "integrate_in_place",
    "message",
    "real_vector",
]

VECTOR = types.float64[::1]


@dataclass(frozen=True)
class FixedStepResult:
    """What a comparator returns.

    Attributes
    ----------
    t : ndarray, shape (m,)
        Saved times, the first and the last of the interval among them.
    y : ndarray, shape (n, m)
        States at `t`.
    nfev : int
        Evaluations of the function.
    wall_time : float
        Seconds spent in the integration, compilation excluded.
    message : str
        "compiled", or "interpreted" and the reason; and where the states stop being finite, if they do.
    """

    t: np.ndarray
    y: np.ndarray
    nfev: int
    wall_time: float
    message: str


def check_span(t_span: Any) -> tuple[float, float]:
    """Start and end as floats; ValueError for anything but two finite numbers."""
    refuse_units(t_span=t_span)
    span = reals(t_span)
    if span is None or span.shape != (2,) or not np.isfinite(span).all():
        raise ValueError(f"t_span must hold two finite numbers, got {shown(t_span)}")
    return float(span[0]), float(span[1])


def real_vector(values: Any, name: str) -> np.ndarray:
    """Copy a 1-D array of real numbers to contiguous float64."""
    refuse_units(**{name: values})
    if np.iscomplexobj(values):
        raise TypeError(f"{name} must be real, got complex numbers")
    if np.ma.is_masked(values):
        raise ValueError(f"masked values in {name}")
    vector = np.array(values, dtype=float, order="C")
    if vector.ndim != 1:
        raise ValueError(f"{name} must be 1-dimensional, got shape {vector.shape}")
    return vector


def check_state(y0: Any) -> np.ndarray:
    """Copy the initial state; ValueError unless all of its components are finite."""
    y = real_vector(y0, "y0")
    if not np.isfinite(y).all():
        raise ValueError("All components of the initial state `y0` must be finite.")
    return y


class FixedSteps(NamedTuple):
    """The steps of a run and what it saves.

    `h` and `last` are the lengths of a step and of the last one, with their sign; `saved` holds the numbers of the
    steps after which the state is saved, 0, the start, the first of them.
    """

    t0: float
    t_bound: float
    h: float
    last: float
    saved: np.ndarray

    @classmethod
    def of(cls, t_span: Any, h: Any, save_every: Any) -> FixedSteps:
        """From what the user gave, checked."""
        t0, t_bound = check_span(t_span)
        h = check_fixed_step(h, t0, t_bound)
        if save_every is None:
            save_every = 0
        elif isinstance(save_every, bool) or not isinstance(save_every, (int, np.integer)) or save_every < 1:
            raise ValueError(f"save_every must be a positive integer or None, got {save_every!r}")
        n_steps = fixed_steps(h, t0, t_bound)
        step = math.copysign(h, t_bound - t0)
        return cls(t0, t_bound, step, t_bound - (t0 + (n_steps - 1) * step), saved_steps(n_steps, int(save_every)))

    @property
    def t(self) -> np.ndarray:
        """The saved times."""
        t = self.t0 + self.saved * self.h
        t[-1] = self.t_bound
        return t


def message(reason: str, t: np.ndarray, ys: np.ndarray) -> str:
    """How the run went; `reason` says why it was interpreted, and is empty where it was not."""
    text = f"interpreted: {reason}" if reason else "compiled"
    finite = np.isfinite(ys).all(axis=1)
    if finite.all():
        return text
    return f"{text}; the saved states from t={t[np.argmin(finite)].item()!r} on are not finite"


def _in_place_signature(n_extra: int) -> Any:
    """Signature of ``fun(t, y, out[, params]) -> None``."""
    return types.void(types.float64, VECTOR, VECTOR, *[VECTOR] * n_extra)


def drive_signature(n_extra: int) -> Any:
    """Signature of a loop over `drive_steps`.

    With the function typed as a first-class function the machine code does not depend on it and is found in Numba's
    cache by the next process.
    """
    fun, counts = types.FunctionType(_in_place_signature(n_extra)), types.int64[::1]
    steps = [types.float64] * 3
    return types.void(
        fun, types.UniTuple(VECTOR, n_extra), *steps, counts, VECTOR, VECTOR, counts, VECTOR, types.float64[:, ::1]
    )


def _why_interpreted(fun: Callable[..., Any], name: str, n_extra: int) -> str:
    """Why a function that fills its third argument cannot enter the compiled loop; empty when it can."""
    if not isinstance(fun, Dispatcher):
        return f"{name} is not jitted by Numba"
    signature = _in_place_signature(n_extra)
    try:
        fun.compile(signature.args)
    except (NumbaError, RuntimeError):
        return f"{name} does not compile as {name}{signature}"
    returned = {known.args: known.return_type for known in fun.nopython_signatures}.get(signature.args)
    return "" if returned == types.none else f"{name} returns {returned}, expected to fill its third argument"


def integrate_in_place(
    fun: Callable[..., Any],
    name: str,
    compiled_drive: Callable[[int], Callable[..., None]],
    drive: Callable[..., None],
    t_span: tuple[float, float],
    y: np.ndarray,
    h: float,
    params: Any,
    save_every: int | None,
    constants: np.ndarray,
    work: np.ndarray,
) -> FixedStepResult:
    """Run a comparator whose function is ``fun(t, y, out[, params])``; arguments checked, compiled where possible.

    Parameters
    ----------
    fun, name
        The user's function, and what the messages call it.
    compiled_drive, drive
        ``drive(fun, extra, t0, h, last_step, saved, constants, work, count, y, ys)``, compiled for so many extra
        arguments, and as it is.
    t_span, y, h, params, save_every
        As the user gave them; `y` from `check_state`.
    constants, work : ndarray
        Of the step; `work` is all zero at its first call.
    """
    if not callable(fun):
        raise TypeError(f"{name} must be callable, got {fun!r}")
    steps = FixedSteps.of(t_span, h, save_every)
    extra = () if params is None else (real_vector(params, "params"),)
    reason = _why_interpreted(fun, name, len(extra))
    run = drive if reason else compiled_drive(len(extra))
    count = np.zeros(1, dtype=np.int64)
    ys = np.full((steps.saved.size, y.size), np.nan)
    ys[0] = y

    def advance(to_save: np.ndarray) -> None:
        run(fun, extra, steps.t0, steps.h, steps.last, to_save, constants, work, count, y, ys)

    # Saving nothing but the start takes no step: whatever is still to be compiled or bound is so before the clock runs.
    advance(steps.saved[:1])
    start = perf_counter()
    advance(steps.saved)
    wall_time = perf_counter() - start
    return FixedStepResult(steps.t, ys.T, int(count[0]), wall_time, message(reason, steps.t, ys))


@register_jitable
def drive_steps(step, fun, extra, t0, h, last_step, saved, constants, work, count, y, ys):
    """Take saved[-1] steps; ys[row] receives the state after step saved[row]. `extra` is () or (params,).

    ``step(fun, extra, t, h, constants, work, count, y) -> bool`` moves `y` by one step; False: it could not, and the
    rest of `ys` is left as it is.
    """
    n_steps = saved[-1]
    row = 1
    for k in range(n_steps):
        length = last_step if k == n_steps - 1 else h
        if not step(fun, extra, t0 + k * h, length, constants, work, count, y):
            return
        if k + 1 == saved[row]:
            ys[row] = y
            row += 1
