"""What several benchmarks of orbits share: one run by each package, and a table of timed runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from eip_scipy import EIPSolver, integrate
from eip_scipy.problems import Problem

from ..solar.cost import TimedRun
from ..work_precision import Runner
from .installed import peer

rebound = peer("eip_scipy.integrations.rebound")

__all__ = ["by_rebound", "by_us", "one_each", "rows", "show"]

Methods = dict[str, tuple[Runner, Sequence[float]]]


def by_us(problem: Problem, method: type[EIPSolver], **options: Any) -> Runner:
    """From the start to the end of the problem's interval, by steps of the runner's argument."""

    def run(h: float) -> tuple[float, np.ndarray]:
        result = integrate(problem, method=method, h=h, **options)
        return result.wall_time, result.y[:, -1]

    return run


def by_rebound(problem: Problem, integrator: str, prepare: Callable[..., Any] | None = None) -> Runner:
    """The same by one of REBOUND's integrators, whose steps are shortened to divide the interval; nan for IAS15's."""
    gm, years = problem.params[: problem.y0.size // 6], problem.t_span[1]

    def run(h: float) -> tuple[float, np.ndarray]:
        n = 1 if math.isnan(h) else round(years / h)
        result = rebound.run(gm, problem.y0, integrator, h=years / n, n_steps=n, prepare=prepare)
        return result.wall_time, result.y[:, -1]

    return run


def one_each(label: Callable[[float], str], run: Runner, steps: Iterable[float]) -> Methods:
    """A row for each step."""
    return {label(h): (run, [h]) for h in steps}


def rows(turns: Sequence[Sequence[TimedRun]]) -> dict[str, dict[str, float]]:
    """Per method the least and the median time, and the extremes of the errors, over all turns in which it ran."""
    found = {}
    for name in dict.fromkeys(item.method for turn in turns for item in turn):
        own = [item for turn in turns for item in turn if item.method == name]
        found[name] = {
            "least": min(item.wall_time for item in own),
            "median": float(np.median([item.wall_time for item in own])),
            "step": own[0].step,
            "best": min(item.mercury for item in own),
            "worst": max(item.mercury for item in own),
            "others": max(item.others for item in own),
        }
    return found


def show(found: Mapping[str, Mapping[str, float]], first: str) -> None:
    """The table of `rows`; `first`: the name of the innermost planet."""
    print(f"{'':26}{'median [s]':>11}{'least':>10}  {first + ' [AU]':20}{'others [AU]':>11}")
    for name, row in found.items():
        errors = f"{row['best']:.1e}" + (f" ... {row['worst']:.1e}" if row["worst"] > row["best"] else "")
        print(f"{name:26}{row['median']:11.4g} {row['least']:9.4g}  {errors:20}{row['others']:11.1e}")
