"""`recommend`: method, step or tolerance, metric and blocks for a wanted error, by trial runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, TypedDict, Unpack

from ..core.acceleration import AccelerationField
from ..core.inputs import flag, is_number, shown
from ..core.invariants import as_invariants
from ..core.names import nearest
from ..core.options import Blocks, LinearConstraints, Metric
from ..core.pointers import PointerFunction, by_pointer
from ..core.problem import Problem, bind
from ..core.states import initial_state
from ..core.stepping import interval
from .prepare import evaluation_times
from .recommendation import Recommendation
from .search import Search

__all__ = ["recommend"]


class RecommendKeywords(TypedDict, total=False):
    """The options of `integrate` that `recommend` passes on, for type checkers."""

    params: Any
    in_place: bool
    jacobian: Callable[..., Any] | None
    metric: Metric
    blocks: Blocks
    linear_invariants: LinearConstraints
    compiled: bool | None


COMMON = tuple(RecommendKeywords.__annotations__)


def recommend(
    fun: Callable[..., Any] | Problem | None = None,
    t_span: Any = None,
    y0: Any = None,
    *,
    acceleration: Any = None,
    error: float = 1e-6,
    invariants: Any = None,
    max_nfev: int | None = None,
    t_eval: Any = None,
    **keywords: Unpack[RecommendKeywords],
) -> Recommendation:
    """Find method, step or tolerance, metric and blocks for a wanted error, by trial runs.

    Parameters
    ----------
    fun : callable or Problem
        As for `integrate`, the first-order form: ``fun(t, y) -> (n,)``. Systems q'' = a(t, q) with y = (q, v) are
        recognised.
    t_span : (float, float)
        Start and end, which must be finite; default: those of the problem.
    y0 : array_like, shape (n,)
        Initial state; default: that of the problem.
    acceleration : callable, optional
        Instead of `fun`, as for `integrate`: the a of q'' = a(t, q), with y = (q, v).
    error : float, optional
        Wanted error of the state at the end: largest component of the difference from the exact state, relative to the
        largest component of the exact state.
    invariants : Invariant or sequence of Invariant, optional
        Invariants to keep; default: those of the problem; for a function, none. `particle_invariants` are added if the
        system keeps them.
    max_nfev : int, optional
        Approximate bound on the evaluations of one trial; default: 100 000, and 500 000 for compiled functions. A
        longer run is tried on the first part of its interval, and its error is extrapolated.
    t_eval : array_like, optional
        Times at which the recommended run saves states, as for `integrate`. The comparison of methods then includes
        the evaluations for states between steps.
    params, in_place, jacobian, metric, blocks, linear_invariants, compiled
        As for `integrate`, for all runs. With `jacobian`, or a problem that has one, `EIPGJ14` is tried.

    Returns
    -------
    Recommendation
        ``method`` and ``options`` for `integrate`, the expected ``error`` and ``nfev``, the ``reason``, all ``trials``,
        and ``run()``. It prints as a table.

    Raises
    ------
    TypeError
        If an option is unknown.
    ValueError
        If no trial has the wanted error (the message states the smallest error found), if the right-hand side cannot be
        integrated, if an option has a wrong value, or if a gradient is wrong.

    Warns
    -----
    ProjectionWarning
        If the projection is not reliable or keeps the error above the wanted one, so that a run without invariants is
        recommended.

    Notes
    -----
    Errors of trials are measured against a reference run, by `EIPDOP853` without projection if possible. Its tolerances
    are reduced until two runs agree to 2 % of the wanted error. With each method, up to 8 trials are made until one has
    between 15 % and 100 % of the wanted error. Of all trials with at most the wanted error, the one with the fewest
    evaluations is recommended, but a less usual method only if it needs less than 90 % of those of the others.

    Examples
    --------
    >>> from eip_scipy import recommend
    >>> from eip_scipy.problems import kepler
    >>> choice = recommend(kepler(0.6), (0, 50), error=1e-8)
    >>> run = choice.run()
    >>> choice.trusted, choice.error <= 1e-8, run.nfev <= 1.1 * choice.nfev
    (True, True, True)
    """
    options: dict[str, Any] = dict(keywords)
    _check(error, max_nfev, options)
    problem, common = _problem(_right_hand_side(fun, acceleration, options), t_span, y0, invariants, options)
    output = None if t_eval is None else evaluation_times(t_eval, *problem.t_span)
    return Search(problem, common, float(error), max_nfev, output).recommendation()


def _right_hand_side(fun: Any, acceleration: Any, options: dict[str, Any]) -> Any:
    """Return `fun`, or the `AccelerationField` of `acceleration`, for which `in_place` is removed from `options`."""
    if acceleration is None:
        return fun
    if fun is not None:
        raise TypeError("recommend: give fun or acceleration, not both.")
    acceleration = by_pointer(acceleration, "acceleration")
    if not callable(acceleration):
        raise TypeError(f"recommend: acceleration must be callable, got {shown(acceleration)}.")
    in_place = flag("in_place", options.pop("in_place", False)) or isinstance(acceleration, PointerFunction)
    return AccelerationField(acceleration, in_place)


def _check(error: Any, max_nfev: Any, options: Mapping[str, Any]) -> None:
    for name in options:
        if name not in COMMON:
            raise TypeError(
                f"recommend() has no option {name!r}{nearest(name, COMMON) or '.'} It finds method, step and "
                "tolerances; pass other options, such as events, to the run() of its result."
            )
    if not is_number(error, "error") or not 0 < error < 1:
        raise ValueError(f"error must be a number between 0 and 1, got {shown(error)}.")
    if max_nfev is not None and (not is_number(max_nfev) or not max_nfev >= 1000):
        raise ValueError(f"max_nfev must be at least 1000, got {shown(max_nfev)}.")


def _problem(
    fun: Any, t_span: Any, y0: Any, invariants: Any, options: dict[str, Any]
) -> tuple[Problem, dict[str, Any]]:
    """Return the problem with the start and interval of the call, and the options that all runs have."""
    common = {name: value for name, value in options.items() if value is not None}
    if not isinstance(fun, Problem):
        if t_span is None or y0 is None:
            raise TypeError(
                f"recommend: {'t_span' if t_span is None else 'y0'} is missing; it can be omitted only for a Problem."
            )
        fun = _made(fun, t_span, y0, common)
    brought = {} if t_span is None else {"t_span": t_span}
    brought |= {} if y0 is None else {"y0": y0}
    problem = replace(fun, **brought)
    t0, t_end = interval(problem.t_span)
    if not math.isfinite(t_end) or t_end == t0:
        raise ValueError(f"recommend needs an interval of a finite length above 0, got t_span={shown(problem.t_span)}.")
    problem = replace(problem, t_span=(t0, t_end), y0=initial_state(problem.y0))
    if invariants is not None:
        common["invariants"] = as_invariants(invariants)
    return problem, common


def _made(fun: Any, t_span: Any, y0: Any, common: dict[str, Any]) -> Problem:
    """Return a problem made from a function; `in_place`, and if it is True `params`, are removed from `common`."""
    pointer = by_pointer(fun, "fun")
    if not callable(pointer):
        raise TypeError(f"recommend: fun must be callable or a Problem, got {shown(fun)}.")
    name = getattr(getattr(fun, "acceleration", fun), "__name__", "problem")
    if not (flag("in_place", common.pop("in_place", False)) or isinstance(pointer, PointerFunction)):
        return Problem(name=name, fun=fun, y0=y0, t_span=t_span)
    params = common.pop("params", None)
    return Problem(name=name, fun=bind(pointer, params), rhs=fun, params=params, y0=y0, t_span=t_span)
