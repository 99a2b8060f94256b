"""Compiled loops of the engine for methods with fixed steps that the projection is compared with.

This module is the door through which other packages, `eip_scipy_studies.comparators` among them, reach these loops.
`take_steps` runs a scheme over functions of the user, compiled where they have an address; `fields` holds loops over
the points of a complex field, one call for each part of a step of the Gross-Pitaevskii equation. Names and signatures
of the schemes follow the engine and may change with it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from .core.inputs import reals, refuse_units, shown
from .core.jitted import NotCompilableError
from .core.native_functions import Kind, function_alone, raise_again
from .core.pointers import by_pointer, is_pointer
from .core.stepping import check_fixed_step, fixed_steps, saved_steps
from .engine.data import make_work
from .engine.native import BUILD, Call, FailedCallError, NativeFunctions, PythonFunctions, call

__all__ = [
    "FixedStepResult",
    "FixedSteps",
    "Kind",
    "by_pointer",
    "call",
    "check_state",
    "fields",
    "fill_in_place",
    "functions_of",
    "real_vector",
    "refuse_units",
    "take_steps",
]

fields = BUILD.fields
"""Loops over the points of a field, see engine/cpp/comparators/fields.cpp."""


@dataclass(frozen=True)
class FixedStepResult:
    """Result of a method with fixed steps.

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
        return cls(t0, t_bound, step, (t_bound - t0) - (n_steps - 1) * step, saved_steps(n_steps, int(save_every)))

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


def functions_of(
    fun: Callable[..., Any],
    in_python: Call,
    kind: Kind,
    name: str,
    params: np.ndarray | None,
    *,
    second_order: bool = False,
) -> tuple[NativeFunctions | PythonFunctions, str]:
    """A user's function as the engine takes it, by its address or `in_python`; and why not by its address, if not."""
    try:
        return function_alone(fun, kind, name, params, second_order=second_order), ""
    except NotCompilableError as error:
        return PythonFunctions(in_python, (), (), (), second_order), str(error)


def fill_in_place(
    scheme: str,
    fun: Callable[..., Any],
    name: str,
    kind: Kind,
    steps: FixedSteps,
    y: np.ndarray,
    params: Any,
    constant: float = 0.0,
) -> FixedStepResult:
    """Run a comparator whose function is ``fun(t, x, out[, params])``, x the state's first ``kind.size`` numbers."""
    if not callable(fun) and not is_pointer(fun):
        raise TypeError(f"{name} must be callable, got {fun!r}")
    given = None if params is None else real_vector(params, "params")
    fun, size = by_pointer(fun, name), kind.size

    def called(t: float, y: np.ndarray, out: np.ndarray, *extra: np.ndarray) -> None:
        fun(t, y[:size], out, *extra)

    in_python = call(called, () if given is None else (given,), kind.shape, None, in_place=True)
    kind = kind._replace(p=-1 if given is None else given.size)
    functions, reason = functions_of(fun, in_python, kind, name, given)
    return take_steps(scheme, functions, steps, y, reason, constant)


def take_steps(
    scheme: str,
    functions: NativeFunctions | PythonFunctions,
    steps: FixedSteps,
    y: np.ndarray,
    reason: str,
    constant: float = 0.0,
) -> FixedStepResult:
    """All steps from y, which moves, by a scheme of engine/cpp/comparators; `reason` says why they are interpreted."""
    ys = np.full((steps.saved.size, y.size), np.nan)
    ys[0] = y
    work = make_work(y.size, np.dtype(float), 1, 0, 0)
    start = perf_counter()
    try:
        evaluations = BUILD.comparators.take_steps(scheme, constant, functions, work, steps, y, ys)
    except FailedCallError as error:
        failed = error.args
    else:
        wall_time = perf_counter() - start
        return FixedStepResult(steps.t, ys.T, evaluations, wall_time, message(reason, steps.t, ys))
    assert isinstance(functions, NativeFunctions)  # those in Python raise their own errors
    raise_again(functions, *failed)
