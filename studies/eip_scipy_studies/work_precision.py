"""Error against cost: methods at several steps, timed on one machine; and the cost of an error."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from eip_scipy.problems import Problem

from .report import compact, describe_machine

Runner = Callable[[float], tuple[float, np.ndarray]]
"""``run(step) -> (wall_time, y)``."""
Curve = tuple[list[float], list[float]]
"""A method's costs and errors, from the cheapest run to the dearest."""


class WorkPoint(NamedTuple):
    """One method at one step: the least time of several runs in seconds, and the error, nan if it was not finished."""

    method: str
    step: float
    wall_time: float
    error: float


@dataclass(frozen=True)
class WorkPrecision:
    """Result of `work_precision`: the points, in the order of the methods and of their steps, and the machine.

    `states` has the final state of the run at each point.
    """

    points: tuple[WorkPoint, ...]
    states: tuple[np.ndarray, ...]
    machine: str


def work_precision(
    methods: Mapping[str, tuple[Runner, Sequence[float]]],
    error: Callable[[np.ndarray], float],
    *,
    repeats: int = 3,
    enough_seconds: float = 1.0,
    in_all: float = math.inf,
    callback: Callable[[], Any] | None = None,
) -> WorkPrecision:
    """Run methods at several steps and measure error and time.

    `methods` has for each method the function ``run(step) -> (wall_time, y)``, and the steps. `run` returns the seconds
    without compilation and the final state, which is nan if the run failed; ``error(y)`` is the error of a final state.
    The least time of `repeats` runs (at least 1, or a ValueError is raised) counts: disturbances make a timing longer,
    never shorter. A point (method and step) is not run again if its fastest run took more than `enough_seconds`, or its
    runs together more than `in_all`. ``callback()`` is called after each of the `repeats` runs of each point, including
    those that are left out.
    """
    if repeats < 1:
        raise ValueError(f"repeats must be at least 1, got {repeats!r}.")
    points = [WorkPoint(method, step, 0.0, math.nan) for method, (_, steps) in methods.items() for step in steps]
    states = [np.empty(0)] * len(points)
    spent = [0.0] * len(points)
    for turn in range(repeats):
        # All points in turn, not each one repeatedly: another process then disturbs only one run of a point.
        for k, point in enumerate(points):
            if point.wall_time <= enough_seconds and spent[k] <= in_all:
                seconds, states[k] = methods[point.method][0](point.step)
                spent[k] += seconds
                least = min(seconds, point.wall_time) if turn else seconds
                points[k] = point._replace(wall_time=least, error=_error(states[k], error))
            if callback is not None:
                callback()
    return WorkPrecision(tuple(points), tuple(states), describe_machine())


def cost_to_reach(costs: Any, errors: Any, level: float) -> float:
    """Interpolate the cost at which a method's error falls to `level`, on log axes.

    `costs` and `errors` (m,) are those of the method's runs, in ascending cost. If the cheapest run has a smaller error
    already, the result is its cost, an upper bound; if no run has an error of at most `level`, it is nan.
    """
    if errors[0] <= level:
        return float(costs[0])
    for k in range(1, len(errors)):
        if errors[k] <= level < errors[k - 1]:
            part = math.log(errors[k - 1] / level) / math.log(errors[k - 1] / errors[k])
            return float(costs[k - 1] * (costs[k] / costs[k - 1]) ** part)
    return math.nan


def known_end(problem: Problem) -> np.ndarray:
    """Return the problem's reference state at the end of its interval, which must be known."""
    assert problem.reference is not None
    truth = problem.reference(problem.t_span[1])
    assert truth is not None
    return truth


def curves(runs: Iterable[Any], cost: str = "wall_time", error: str = "error") -> dict[str, Curve]:
    """Gather the costs and errors of runs by their methods, in the order of the runs.

    `runs` have ``method`` and the attributes named by `cost` and `error`, such as `WorkPoint`, each method's in
    ascending cost. The result has two lists for each method, the costs and the errors of its runs.
    """
    found: dict[str, Curve] = {}
    for run in runs:
        costs, errors = found.setdefault(run.method, ([], []))
        costs.append(getattr(run, cost))
        errors.append(getattr(run, error))
    return found


def costs_at(curve: Curve, levels: Iterable[float], factor: float = 1.0) -> list[str]:
    """Return cells of a table: `factor` times the cost of reaching each of the errors `levels`.

    `curve` holds the costs and the errors of a method's runs, see `curves`. A cell has "<" before the cost if the error
    of the cheapest run is at most the level, and is "-" if no run has so small an error.
    """
    return [("<" if curve[1][0] <= level else "") + compact(factor * cost_to_reach(*curve, level)) for level in levels]


def _error(state: np.ndarray, error: Callable[[np.ndarray], float]) -> float:
    return float(error(state)) if np.isfinite(state).all() else math.nan
