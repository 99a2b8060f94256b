"""Step control of a run: its interval, and a fixed length of the steps or tolerances."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ..engine.data import EPS, Span
from ..methods.base import Method
from .callers import users_level
from .derivatives import time_of_motion
from .inputs import is_number, reals, shown

__all__ = ["ATOL", "UNBOUNDED", "StepControl", "fixed_steps", "interval", "saved_steps"]

UNBOUNDED = 2**62
LARGE_TIME = 1e300  # below it an integer can be converted to a float
LEAST_RTOL = 100 * EPS  # as in SciPy
# Part of the time in which a state changes by its own size that is short enough for differences in time.
PART_OF_MOTION = 2.0**-10

Array = np.ndarray


class DefaultTolerance(float):
    """Default value of a tolerance, to distinguish it from a value that the user gave."""


ATOL = DefaultTolerance(1e-6)  # as in SciPy


class StepControl(NamedTuple):
    """Step control of a run: a fixed `h`, or tolerances if `h` is None; `first_step` is None if it is estimated."""

    span: Span
    h: float | None
    first_step: float | None
    rtol: Array
    atol: Array

    @classmethod
    def of(
        cls,
        name: str,
        method: Method,
        ends: tuple[float, float],
        n: int,
        *,
        h: Any = None,
        first_step: Any = None,
        max_step: Any = np.inf,
        rtol: Any = 1e-3,
        atol: Any = ATOL,
    ) -> StepControl:
        """Return the step control of a run from ``ends[0]`` to ``ends[1]`` with n components, after checks.

        The other arguments are those of the user, and `name` is the solver class, for messages. The default of `atol`
        applies to adaptive steps only. With fixed steps `atol` is only a scale of the error metric, and its default is
        0, so that the metric does not depend on the units of the state.
        """
        t0, t_bound = ends
        _check_kind(name, method, h, first_step, max_step)
        first_step, max_step = _bounds(first_step, max_step, abs(t_bound - t0))
        unset = h is not None and isinstance(atol, DefaultTolerance)
        is_loose = isinstance(rtol, float) and rtol >= LEAST_RTOL
        rtol, atol = _tolerance("rtol", rtol, n), _tolerance("atol", 0.0 if unset else atol, n)
        sign = -1.0 if t_bound < t0 else 1.0
        if h is None:
            if not is_loose and (rtol < LEAST_RTOL).any():
                text = f"At least one element of `rtol` is too small. Setting `rtol = np.maximum(rtol, {LEAST_RTOL})`."
                warnings.warn(text, stacklevel=users_level())
                rtol = np.maximum(rtol, LEAST_RTOL)
            return cls(Span(t0, 0.0 * sign, t_bound, sign, UNBOUNDED, max_step), None, first_step, rtol, atol)
        h = _fixed_length(h, t0, t_bound)
        return cls(Span(t0, sign * h, t_bound, sign, fixed_steps(h, t0, t_bound), max_step), h, first_step, rtol, atol)

    @classmethod
    def without_steps(cls, t: float, n: int) -> StepControl:
        """Return the step control for the projection of a state of n components without a step."""
        return cls(Span(t, 0.0, t, 1.0, 0, np.inf), 0.0, None, np.zeros(n), np.zeros(n))

    def first(self, rhs: Callable[[float, Array], Array], y0: Array, f0: Array, method: Method) -> float:
        """Return the length of the first step: `h`, at most the length of the interval, `first_step` or an estimate."""
        if self.h is not None:
            length = abs(self.span.t_bound - self.span.t0)
            return min(self.h, length) if length else self.h
        if self.first_step is not None:
            return self.first_step
        return self._estimate(rhs, y0, f0, method.error_estimator_order or 0)

    def _estimate(self, rhs: Callable[[float, Array], Array], y0: Array, f0: Array, order: int) -> float:
        """Estimate the first step of an adaptive run (Hairer, Norsett & Wanner I, II.4) with one call of `rhs`.

        `order` is that of the error estimate. The result is NaN if the derivative `f0` is not finite, 0 for an interval
        of length 0, and infinite for a state without components.
        """
        span, scale = self.span, self.scale(y0)
        if y0.size == 0:
            return math.inf
        length = abs(span.t_bound - span.t0)
        if length == 0.0:
            return 0.0

        def size(x: Array) -> float:
            return float(np.linalg.norm(x / scale)) / math.sqrt(x.size)

        d0, d1 = size(y0), size(f0)
        if not math.isfinite(d1):
            return math.nan
        h0 = 1e-6 if d0 < 1e-5 or d1 < 1e-5 else 0.01 * d0 / d1
        h0 = min(h0, length)
        d2 = size(rhs(span.t0 + h0 * span.sign, y0 + h0 * span.sign * f0) - f0) / h0
        if d1 <= 1e-15 and d2 <= 1e-15:
            h1 = max(1e-6, h0 * 1e-3)
        else:
            h1 = (0.01 / max(d1, d2)) ** (1 / (order + 1))
        return min(100 * h0, h1, length, span.max_step)

    def scale_of_time(self, tau: float, y: Array, f: Array) -> float:
        """Return a scale for differences in time: the step `tau`, or in adaptive runs a part of the motion if longer.

        The estimated first step depends on the unit of time: in seconds it can be millions of times shorter than the
        steps of an orbit of years, and differences over so short a time are rounding.
        """
        if self.h is not None or (motion := time_of_motion(y, f)) == math.inf:
            return tau
        length = abs(self.span.t_bound - self.span.t0)
        return max(tau, min(PART_OF_MOTION * motion, length, self.span.max_step))

    def scale(self, y0: Array) -> Array:
        """Return the unit (n,) of the error of each component at the start; raise an error if it is 0."""
        scale = self.atol + np.abs(y0) * self.rtol
        if np.count_nonzero(scale) < scale.size:
            raise ValueError(
                f"the error of component {scale.argmin()} has no scale, because y0 and `atol` are 0 there. Give atol "
                "> 0, or a fixed step h."
            )
        return np.asarray(scale)


def _check_kind(name: str, method: Method, h: Any, first_step: Any, max_step: Any) -> None:
    """Raise ValueError if a method cannot take the kind of steps, fixed or adaptive, that the options ask for."""
    if h is None and method.fixed_steps_only:
        why = "takes fixed steps" if method.has_estimate else "has no error estimate"
        raise ValueError(
            f"{name} {why} and needs the step h=...; give it. The step of a problem is not used if rtol, atol, "
            "first_step or max_step is given."
        )
    if h is not None and method.drives:
        raise ValueError(
            f"h={shown(h)}: the steps of {name} are those of SciPy's {method.name}, which controls their length. "
            "Omit h, and give rtol and atol, and max_step to bound the steps."
        )
    if h is not None and (first_step is not None or max_step != np.inf):
        raise ValueError(
            "h sets a fixed step, but first_step and max_step are for adaptive steps; omit h, or the other two."
        )


def _bounds(first_step: Any, max_step: Any, length: float) -> tuple[float | None, float]:
    """Return first_step and max_step after checks, with SciPy's messages."""
    if not is_number(max_step, "max_step") or not max_step > 0:
        raise ValueError(f"`max_step` must be positive. Got {shown(max_step)}; give a real number > 0.")
    if first_step is None:
        return None, float(max_step)
    if not is_number(first_step, "first_step") or not first_step > 0:
        raise ValueError(f"`first_step` must be positive. Got {shown(first_step)}; give a real number > 0.")
    if first_step > length:
        raise ValueError(f"`first_step` exceeds bounds. Got {first_step:g} for an interval of length {length:g}.")
    return float(first_step), float(max_step)


def _tolerance(name: str, value: Any, n: int) -> Array:
    """Return a tolerance as an array (n,), after checks."""
    if isinstance(value, float) and 0.0 <= value < math.inf:
        same = np.empty(n)
        same.fill(value)  # np.full takes much longer
        return same
    a = reals(name, value)
    if a is None:
        raise ValueError(f"`{name}` must be a number or an array of {n} numbers. Got {shown(value)}.")
    if a.ndim > 0 and a.shape != (n,) and not (name == "rtol" and a.shape == (1,)):  # which SciPy takes
        raise ValueError(f"`{name}` has wrong shape. It has {a.shape}, but the state has ({n},).")
    if not np.all(a >= 0):
        raise ValueError(f"`{name}` must be positive. Got {shown(value)}.")
    if not np.all(np.isfinite(a)):
        raise ValueError(
            f"`{name}` must be finite. Got {shown(value)}; to exclude a component from the step control, use a "
            "large number such as 1e30."
        )
    return np.array(np.broadcast_to(a, (n,)), order="C")


def _fixed_length(h: Any, t0: float, t_bound: float) -> float:
    """Return the step h as a positive float, after checks.

    It must not be below ten spacings of floating-point numbers at the end of the interval that is farther from 0. If it
    is longer than the interval, the step is shortened, as the last step of any run.
    """
    if not is_number(h, "h") or not 0 < h < math.inf:
        raise ValueError(f"`h` must be positive. Got {shown(h)}; give a real number > 0.")
    largest = max(abs(t0), abs(t_bound)) if math.isfinite(t_bound) else abs(t0)
    if t_bound != t0 and h < 10 * math.ulp(largest):
        raise ValueError(
            f"`h` is too small: h = {h:g} is below 10 spacings of t; the spacing of floating-point numbers at t = "
            f"{largest:g} is {math.ulp(largest):.3g}. Give a larger h."
        )
    return float(h)


def fixed_steps(h: float, t0: float, t_bound: float) -> int:
    """Return the number of steps of length h from t0 to t_bound; `UNBOUNDED` for an infinite interval.

    It is the length of the interval divided by h, rounded if that is an integer up to round-off. Otherwise it is
    rounded up, so that the last step is shorter. An interval that is not empty has at least one step, for any h.
    """
    ratio = abs(t_bound - t0) / h
    if not ratio < UNBOUNDED:
        return UNBOUNDED
    whole = max(round(ratio), 1) if ratio > 0 else 0
    slack = max(1e-9, 8 * EPS * (abs(t_bound - t0) + abs(t0) + abs(t_bound)) / h)
    return whole if abs(ratio - whole) <= slack else math.ceil(ratio)


def saved_steps(n_steps: int, save_every: int) -> Array:
    """Return the numbers of the steps after which a state is saved: 0, every `save_every`-th if not 0, and the last."""
    return np.append(np.arange(0, n_steps, save_every or max(n_steps, 1)), n_steps)


def interval(t_span: Any) -> tuple[float, float]:
    """Return start and end of an interval, whose end may be infinite, after checks."""
    if type(t_span) is tuple and len(t_span) == 2 and all(map(_is_plain_time, t_span)):
        return float(t_span[0]), float(t_span[1])
    ends = reals("t_span", t_span)
    if ends is None or ends.shape != (2,):
        raise ValueError(f"t_span must hold two numbers, got {shown(t_span)}.")
    t0, t_bound = ends.tolist()
    if not math.isfinite(t0) or math.isnan(t_bound):
        raise ValueError(f"t_span must be finite, got {shown(t_span)}; only its end may be infinite.")
    return t0, t_bound


def _is_plain_time(end: Any) -> bool:
    return type(end) in (int, float) and abs(end) < LARGE_TIME
