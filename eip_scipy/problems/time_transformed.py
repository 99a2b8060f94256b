"""Fictitious time s: if the step in s is fixed, the steps in time t are short during fast motion.

With dt = g(y) ds the state (y, t) as a function of s obeys another autonomous system, which has the invariants of the
problem. In this way a method with a fixed step and its projection can be used for close encounters.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from math import sqrt
from typing import Any

import numpy as np

from ..core.functions import compilable, compiled_like, jitted, jitted_call, own_values
from ..core.invariants import Invariant
from ..core.problem import Problem, bind

__all__ = ["centre_time", "pair_time", "reaches", "time_transformed"]


@compilable
def centre_time(y, params):
    """Return the time scale r^(3/2) of motion around one centre with G M = 1, which is the function g for `kepler`.

    See Also
    --------
    time_transformed, pair_time, reaches
    """
    r2 = 0.0
    for k in range(y.size // 2):
        r2 += y[k] * y[k]
    r = sqrt(r2)
    return r * sqrt(r)


@compilable
def pair_time(y, params):
    """Return (sum over pairs of (Gm_i + Gm_j) / r^3)^(-1/2), a smooth time scale of the closest pair of N bodies.

    `y` holds the N positions and the N velocities in space, and `params` begins with the N values Gm_i.

    See Also
    --------
    time_transformed, centre_time, reaches
    """
    rate2 = 0.0
    for i in range(y.size // 6):
        for j in range(i):
            x, y_, z = y[3 * i] - y[3 * j], y[3 * i + 1] - y[3 * j + 1], y[3 * i + 2] - y[3 * j + 2]
            r2 = x * x + y_ * y_ + z * z
            rate2 += (params[i] + params[j]) / (r2 * sqrt(r2))
    return 1.0 / sqrt(rate2)


def reaches(t: float) -> Callable[..., float]:
    """Return a terminal event that ends a run of a transformed problem at the time `t` (not at s = t).

    See Also
    --------
    time_transformed, pair_time, centre_time
    """
    t = float(t)
    event = jitted(compilable(lambda s, y, params: y[-1] - t))
    event.terminal = True
    return event


def time_transformed(problem: Problem, s_end: float, g: Callable[..., Any] = pair_time) -> Problem:
    """Return a problem in fictitious time s, dt = g(y) ds (Sundman 1913; Mikkola and Tanikawa 1999).

    Parameters
    ----------
    problem : Problem
        An autonomous problem with ``rhs``.
    s_end : float
        End of the interval of s, which starts at 0. To stop at a time t, use a large value and pass
        ``events=reaches(t)`` to `integrate`.
    g : callable, optional
        Compiled ``g(y, params) -> float``, positive: the time dt for a unit of s at y. Default: `pair_time`, for
        problems such as `nbody`; `centre_time` is for `kepler`. With these functions 2 pi in s is one revolution of a
        circular orbit of two bodies, or about half a revolution of a narrow ellipse that includes the pericentre.

    Returns
    -------
    Problem
        A problem of first order with the state (y, t), where t = ``problem.t_span[0]`` at the start. It has the same
        invariants, blocks and linear invariants, which do not contain t, and no step `h`.

    Raises
    ------
    ValueError
        If the problem has no compiled right-hand side, or one of its invariants is a `Balance` or depends on t.

    See Also
    --------
    pair_time, centre_time, reaches, pythagorean

    Examples
    --------
    >>> from eip_scipy import EIPDOP853, integrate
    >>> from eip_scipy.problems import pythagorean, reaches, time_transformed
    >>> near = time_transformed(pythagorean(), 1e4)
    >>> run = integrate(near, method=EIPDOP853, rtol=1e-12, atol=1e-12, events=reaches(16.0))
    >>> round(float(run.y[-1, -1]), 6)
    16.0
    """
    if problem.rhs is None:
        raise ValueError(
            f"time_transformed: the problem {problem.name!r} has no compiled right-hand side that fills an "
            "array (rhs). Use a problem that has one, such as kepler() or nbody(...)."
        )
    if problem.y0 is None or problem.t_span is None:
        raise ValueError(
            f"time_transformed: the problem {problem.name!r} has no y0 or no t_span, from which the new state starts. "
            "Pass dataclasses.replace(problem, y0=..., t_span=...)."
        )
    params = np.zeros(0) if problem.params is None else problem.params
    for item in problem.invariants:
        _check_time(item, problem, params)
    rhs = _equations(jitted_call(problem.rhs), jitted(g))
    n, blocks, kept = problem.y0.size, problem.blocks, problem.linear_invariants
    if kept is not None:
        kept = np.pad(kept[0], ((0, 0), (0, 1))), np.pad(kept[1], ((0, 1), (0, 0)))
    return Problem(
        name=f"{problem.name} in fictitious time",
        fun=bind(rhs, params),
        rhs=rhs,
        y0=np.append(problem.y0, problem.t_span[0]),
        t_span=(0.0, float(s_end)),
        params=params,
        invariants=tuple(map(_invariant, problem.invariants)),
        component_names=None if problem.component_names is None else (*problem.component_names, "t"),
        blocks=tuple(np.arange(n).reshape(-1, blocks)) if isinstance(blocks, int) else blocks,
        linear_invariants=kept,
        units=problem.units and f"state in {problem.units}",  # fictitious time has no unit
        source=problem.source,
    )


def _check_time(item: Invariant, problem: Problem, params: np.ndarray) -> None:
    """Raise ValueError for a balance, and for an invariant whose values at three times differ."""
    why = "is a Balance, whose rate is a derivative with respect to time"
    if not item.is_balance:
        t0, t1 = problem.t_span
        fun, args = own_values(item.function), item.args or (params,)
        values = [fun(t, problem.y0, *args) for t in (t0, t0 + 0.37 * (t1 - t0), t1)]
        if all(np.array_equal(value, values[0], equal_nan=True) for value in values):
            return
        why = "depends on t, but the gradient with respect to the state (y, t) is known only for invariants of y"
    raise ValueError(
        f"time_transformed: {item!r} {why}. Pass dataclasses.replace(problem, invariants=...) without it; the new "
        "problem may get one that is written in fictitious time."
    )


# The functions are cached, so that they are compiled once for all problems with the same functions.


@cache
def _equations(rhs: Callable[..., None], g: Callable[..., Any]) -> Callable[..., None]:
    def transformed(s, y, out, params):
        n = y.size - 1
        rhs(y[n], y[:n], out[:n], params)
        weight = g(y[:n], params)
        for k in range(n):
            out[k] *= weight
        out[n] = weight

    return compiled_like(transformed, rhs, g)


def _invariant(item: Invariant) -> Invariant:
    """Return an invariant of y as one of (y, t); a gradient that is not filled in place is computed."""
    form = {"in_place": True, "uses_f": item.uses_f} if item.in_place else {}
    fun, grad = _value_and_gradient(jitted_call(item.function), jitted_call(item.gradient), item.uses_f)
    return Invariant(fun, grad if form else None, args=item.args, name=item.name, scale=item.scale, **form)


@cache
def _value_and_gradient(fun: Callable[..., Any], grad: Callable[..., Any], uses_f: bool) -> tuple[Any, Any]:
    """Return functions of s and (y, t) for those of an invariant of y, whose f, dy/dt, is dy/ds over dt/ds."""

    def value(s, y, params):
        return fun(y[-1], y[:-1], params)

    def gradient(s, y, out, params):
        grad(y[-1], y[:-1], out[..., :-1], params)
        out[..., -1] = 0.0

    def gradient_of_f(s, y, f, out, params):
        grad(y[-1], y[:-1], f[:-1] / f[-1], out[..., :-1], params)
        out[..., -1] = 0.0

    return compiled_like(value, fun), compiled_like(gradient_of_f if uses_f else gradient, grad)
