"""Checks of the attributes that a user may set between two steps of a solver, as on SciPy's solvers."""

from __future__ import annotations

from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from ..methods.base import Method
from .inputs import initial_state, is_number, shown
from .step_control import StepControl, fixed_steps

__all__ = ["Settings", "changed_control", "checked_vector", "is_state", "kept_state", "settings_of"]

# Up to this number of components a copy of the state is compared as bytes, which is faster for short arrays.
SHORT = 2048


class Settings(NamedTuple):
    """Attributes of a solver, after the last step, that a user may set; one that is another object now has been set."""

    t: float
    y: np.ndarray
    f: np.ndarray
    h_abs: float
    rtol: Any
    atol: Any
    nfev: int
    t_bound: float
    direction: float
    max_step: float
    h: float | None


settings_of = attrgetter(*Settings._fields)


def kept_state(y: np.ndarray) -> bytes | np.ndarray:
    """Return a copy of a state in the form that `is_state` compares: the bytes of a short state, else an array."""
    return y.tobytes() if y.size <= SHORT else y.copy()


def is_state(y: np.ndarray, kept: bytes | np.ndarray) -> bool:
    """Return True if `y` is equal to the state of which `kept` is a copy."""
    return y.tobytes() == kept if type(kept) is bytes else np.array_equal(y, kept)


def checked_vector(name: str, value: Any, like: np.ndarray) -> np.ndarray:
    """Return a state or a derivative that the user has set, checked, as a new array of the size and type of `like`."""
    found = initial_state(value, name)
    if found.shape != like.shape:
        raise ValueError(f"`{name}` was set to an array of {found.size} components; this solver has {like.size}.")
    if found.dtype.kind == "c" and like.dtype.kind != "c":
        raise ValueError(
            f"`{name}` was set to complex numbers, but the solver was started with a real y0. Set real numbers, or "
            "start a new solver with a complex y0."
        )
    return found.astype(like.dtype)


def changed_control(solver: Any, method: Method, was: Settings) -> StepControl:
    """Return the checked step control from a solver's present attributes, which were `was` after the last step."""
    _check_kind_of_steps(solver, was)
    t, t_bound, sign = (_number(name, getattr(solver, name)) for name in ("t", "t_bound", "direction"))
    if not np.isfinite(t) or np.isnan(t_bound):
        raise ValueError(f"`t` must be finite and `t_bound` a number, got t={shown(t)} and t_bound={shown(t_bound)}.")
    if abs(sign) != 1:
        raise ValueError(f"`direction` must be 1 or -1, got {shown(solver.direction)}.")
    if sign * (t_bound - t) < 0:
        raise ValueError(
            f"`t_bound` was set to {t_bound:g}, which is behind t = {t:g} in the direction {sign:+g} of the steps. Set "
            f"`direction` to {-sign:+g} too, or start a new solver."
        )
    given = {"h": solver.h, "max_step": solver.max_step, "rtol": solver.rtol, "atol": solver.atol}
    found = StepControl.of(type(solver).__name__, method, (t, sign * np.inf), solver.n, **given)
    h = found.h
    n_steps = found.span.n_steps if h is None else fixed_steps(h, t, t_bound)
    span = found.span._replace(h=sign * (h or 0.0), t_bound=t_bound, sign=sign, n_steps=n_steps)
    return found._replace(span=span, first_step=None if h is not None else float(solver.h_abs))


def _check_kind_of_steps(solver: Any, was: Settings) -> None:
    """Raise ValueError if `h` or `h_abs` was set to a value that the fixed or adaptive steps cannot use."""
    if (solver.h is None) != (was.h is None):
        kind = "adaptive steps" if was.h is None else f"the fixed step h = {was.h:g}"
        raise ValueError(f"`h` was set to {shown(solver.h)} on a solver with {kind}; start a new solver.")
    if was.h is None:
        if solver.h_abs is not was.h_abs and not (is_number(solver.h_abs) and solver.h_abs > 0):
            raise ValueError(f"`h_abs` must be a positive number, got {shown(solver.h_abs)}.")
    elif solver.h_abs != was.h_abs:
        raise ValueError(
            f"`h_abs` was set to {shown(solver.h_abs)} on a solver with the fixed step h = {was.h:g}; set `h` instead."
        )


def _number(name: str, value: Any) -> float:
    if not is_number(value):
        raise ValueError(f"`{name}` must be a real number, got {shown(value)}.")
    return float(value)
