"""Compiled loops of the engine for methods with fixed steps, with which the projection is compared.

Other packages, such as `eip_scipy_studies.comparators`, use these loops through this module. `run_in_place` and
`run_second_order` make all steps of a named scheme with a user's function. They do not call Python if the function has
an address, that is, if it is jitted by Numba or a C function by pointer. `fields` holds loops over the points of a
complex field, one call for each part of a step of the Gross-Pitaevskii equation. Within the context manager
`working_alone` the calling thread computes sums over many bodies without the help of other threads. The names of the
schemes belong to the engine and may change with it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from .core.inputs import real_array, reals, shown
from .core.jitted import NotCompilableError
from .core.native_functions import Kind, function_alone, raise_again
from .core.pointers import by_pointer, is_pointer
from .core.stepping import check_fixed_step, fixed_steps, saved_steps
from .engine.data import Work
from .engine.native import BUILD, Call, FailedCallError, NativeFunctions, PythonFunctions, call, working_alone

__all__ = [
    "FixedStepResult", "FixedSteps", "check_state", "fields", "run_in_place", "run_second_order",
    "working_alone",
]  # fmt: skip

fields = BUILD.fields
"""Functions that loop over the points of a field, see engine/cpp/comparators/fields.cpp."""


@dataclass(frozen=True)
class FixedStepResult:
    """Result of a method with fixed steps.

    Attributes
    ----------
    t : ndarray, shape (m,)
        Saved times, including start and end of the interval.
    y : ndarray, shape (n, m)
        States at `t`.
    nfev : int
        Number of evaluations of the user's function.
    wall_time : float
        Time of the integration in seconds, without compilation.
    message : str
        "compiled", or "interpreted" and the reason. If saved states are not finite, the first such time is added.
    """

    t: np.ndarray
    y: np.ndarray
    nfev: int
    wall_time: float
    message: str


def _real_vector(values: Any, name: str) -> np.ndarray:
    """Return a contiguous float64 copy of a 1-D array of real numbers; `name` is the argument's name in messages."""
    if np.iscomplexobj(values):
        raise TypeError(f"{name} must be real, got complex numbers")
    if np.ma.is_masked(values):
        raise ValueError(f"masked values in {name}; fill or drop them first.")
    vector = real_array(name, values, TypeError)
    if vector.ndim != 1:
        raise ValueError(f"{name} must be 1-dimensional, got shape {vector.shape}")
    return vector


def check_state(y0: Any) -> np.ndarray:
    """Return a float64 copy of the initial state; raise ValueError unless all of its components are finite."""
    y = _real_vector(y0, "y0")
    if not np.isfinite(y).all():
        raise ValueError("All components of the initial state `y0` must be finite.")
    return y


class FixedSteps(NamedTuple):
    """The steps of a run and the states that it saves.

    `h` and `last` are the lengths of a step and of the last step, with their sign; `saved` holds the numbers of the
    steps after which the state is saved, starting with 0 for the start.
    """

    t0: float
    t_bound: float
    h: float
    last: float
    saved: np.ndarray

    @classmethod
    def of(cls, t_span: Any, h: Any, save_every: Any) -> FixedSteps:
        """Check the user's arguments `t_span`, `h` and `save_every`, and return the steps that they define."""
        span = reals("t_span", t_span)
        if span is None or span.shape != (2,) or not np.isfinite(span).all():
            raise ValueError(f"t_span must hold two finite numbers, got {shown(t_span)}")
        t0, t_bound = span.tolist()
        h = check_fixed_step(h, t0, t_bound)
        if save_every is None:
            save_every = 0
        elif isinstance(save_every, bool) or not isinstance(save_every, (int, np.integer)) or save_every < 1:
            raise ValueError(f"save_every must be a positive integer or None, got {save_every!r}")
        n_steps = fixed_steps(h, t0, t_bound)
        step = math.copysign(h, t_bound - t0)
        return cls(t0, t_bound, step, (t_bound - t0) - (n_steps - 1) * step, saved_steps(n_steps, int(save_every)))

    @property
    def t(self) -> np.ndarray:
        """Return the saved times."""
        t = self.t0 + self.saved * self.h
        t[-1] = self.t_bound
        return t


def _message(reason: str, t: np.ndarray, ys: np.ndarray) -> str:
    """Return the message of a run, interpreted for a `reason` if any, from its saved times (m,) and states (m, n)."""
    text = f"interpreted: {reason}" if reason else "compiled"
    finite = np.isfinite(ys).all(axis=1)
    if finite.all():
        return text
    return f"{text}; the saved states from t={t[np.argmin(finite)].item()!r} on are not finite"


def run_in_place(
    scheme: str,
    fun: Callable[..., Any],
    steps: FixedSteps,
    y: np.ndarray,
    params: Any,
    *,
    name: str,
    takes: int,
    fills: int,
    constant: float = 0.0,
) -> FixedStepResult:
    """Make all steps of a scheme with a function that writes its value into an array.

    Parameters
    ----------
    scheme : str
        Name of a scheme in engine/cpp/comparators.
    fun : callable
        ``fun(t, x, out[, params])``, which writes its value into `out`. A function jitted by Numba and a C function by
        pointer run compiled, any other callable interpreted.
    steps : FixedSteps
    y : ndarray, shape (n,)
        The state at the start, which is overwritten.
    params : array_like or None
        Last argument of `fun`; None if it has none.
    name : str
        Name of `fun` in messages.
    takes, fills : int
        Sizes of x, the first components of the state, and of `out`.
    constant : float, optional
        A number that the scheme uses, such as the charge per mass.

    Returns
    -------
    FixedStepResult
    """
    if not callable(fun) and not is_pointer(fun):
        raise TypeError(f"{name} must be callable, got {fun!r}")
    given = None if params is None else _real_vector(params, "params")
    fun = by_pointer(fun, name)

    def called(t: float, y: np.ndarray, out: np.ndarray, *extra: np.ndarray) -> None:
        fun(t, y[:takes], out, *extra)

    in_python = call(called, () if given is None else (given,), (fills,), None, in_place=True)
    kind = Kind((fills,), takes, -1 if given is None else given.size, "d", in_place=True)
    return _run(scheme, fun, in_python, kind, name, given, steps, y, constant=constant)


def run_second_order(
    scheme: str, acc: Callable[..., Any], steps: FixedSteps, y: np.ndarray, params: Any
) -> FixedStepResult:
    """Make all steps of a scheme for q'' = acc(t, q[, params]) with the state y = (q, q'); see `run_in_place`.

    The acceleration is called once before the run to check the shape of its value.
    """
    given = None if params is None else _real_vector(params, "params")
    half = y.size // 2
    extra = () if given is None else (given,)

    def convert(value: Any, t: float) -> np.ndarray:
        # Without the checks NumPy would silently broadcast scalars or drop imaginary parts.
        if value is None:
            raise TypeError(f"acc returned None, expected {half} numbers")
        if np.iscomplexobj(value):
            raise TypeError("acc returned complex numbers, expected real ones")
        if np.shape(value) != (half,):
            raise ValueError(f"acc returned shape {np.shape(value)}, expected ({half},)")
        return np.array(value, dtype=float)

    acc = by_pointer(acc, "acc", shape=(half,))
    convert(acc(steps.t0, y[:half].copy(), *extra), steps.t0)
    in_python = call(acc, extra, (half,), convert)
    kind = Kind((half,), half, -1 if given is None else given.size, "d")
    return _run(scheme, acc, in_python, kind, "acc", given, steps, y, second_order=True)


def _run(
    scheme: str,
    fun: Callable[..., Any],
    in_python: Call,
    kind: Kind,
    name: str,
    params: np.ndarray | None,
    steps: FixedSteps,
    y: np.ndarray,
    *,
    constant: float = 0.0,
    second_order: bool = False,
) -> FixedStepResult:
    """Make all steps from y, which is overwritten, and return the result.

    `fun` is called by its address; if it has none, `in_python` is called. `kind` is the signature of `fun`. With
    `second_order` it returns accelerations. See `run_in_place` for the other arguments.
    """
    functions: NativeFunctions | PythonFunctions
    try:
        functions, reason = function_alone(fun, kind, name, params, second_order=second_order), ""
    except NotCompilableError as error:
        functions, reason = PythonFunctions(in_python, (), (), (), second_order), str(error)
    ys = np.full((steps.saved.size, y.size), np.nan)
    ys[0] = y
    work = Work(y.size, np.dtype(float), 1, 0, 0)
    start = perf_counter()
    try:
        evaluations = BUILD.comparators.take_steps(scheme, constant, functions, work, steps, y, ys)
    except FailedCallError as error:
        failed = error.args
    else:
        wall_time = perf_counter() - start
        return FixedStepResult(steps.t, ys.T, evaluations, wall_time, _message(reason, steps.t, ys))
    assert isinstance(functions, NativeFunctions)  # those in Python raise their own errors
    raise_again(functions, *failed)
