"""Runs of planets by this package and by REBOUND, and the table of their times and errors."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from eip_scipy.problems import Problem
from eip_scipy.problems.gravity.solar_data import YEAR_D

from ..report import needed, table
from ..solar.cost import TimedRun, by_peer
from ..work_precision import Runner

Methods = dict[str, tuple[Runner, Sequence[float]]]
Row = dict[str, float]


def by_rebound(problem: Problem, integrator: str, **options: Any) -> Runner:
    """Return ``run(step) -> (seconds, final state)`` by an integrator of REBOUND, which must be installed.

    See `by_peer`.
    """
    return by_peer(problem, needed("eip_scipy.integrations.rebound").run, integrator, **options)


def one_each(label: Callable[[float], str], run: Runner, steps: Iterable[float]) -> Methods:
    """Return `Methods` with an entry for each step in years: the name ``label(step)``, and `run` with this step."""
    return {label(h): (run, [h]) for h in steps}


def yearly(name: str, run: Runner, *counts: int) -> Methods:
    """Return `Methods` with an entry for each of `counts`, the numbers of steps per year."""
    return one_each(lambda h: f"{name}, 1/{round(1 / h)} yr", run, [1 / n for n in counts])


def daily(name: str, run: Runner, *days: float) -> Methods:
    """Return `Methods` with an entry for each of `days`, the lengths of a step in days."""
    return one_each(lambda h: f"{name}, {h * YEAR_D:.3g} d", run, [d / YEAR_D for d in days])


def rows(turns: Sequence[Sequence[TimedRun]]) -> dict[str, Row]:
    """Return for each method the step, the least and median time [s], and errors of position [AU].

    `turns` are repetitions of the same runs. "best" and "worst" are the least and the largest error of Mercury,
    "others" the largest of another planet.
    """
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


def orbit_table(found: Mapping[str, Row], first: str) -> str:
    """Lay out the results of `rows` as a table; `first` is the name of the innermost planet."""
    head = [["median", "[s]"], ["least", "[s]"], [f"{first} [AU]", "least"], ["", "largest"], ["others", "[AU]"]]
    cells = {
        name: [
            f"{row['median']:.4g}",
            f"{row['least']:.4g}",
            *(f"{row[key]:.1e}" for key in ("best", "worst", "others")),
        ]
        for name, row in found.items()
    }
    return table(head, cells.items())
