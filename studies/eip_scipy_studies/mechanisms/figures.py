"""Figures of the four-bar linkage at several times, and of its errors against costs."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from eip_scipy import EIPRK45, integrate

from .examples import four_bar

TOLERANCE, LAST = 1e-4, np.array([2.0, 1.5, 1.0, 0.5, 0.0])  # of the runs that are drawn; seconds before the end


def joints(y: np.ndarray, sizes: Mapping[str, float]) -> np.ndarray:
    """Return the ends of the links of the four-bar linkage at the states `y` (6, k), as an array (k, 4, 2).

    `sizes` has the lengths of the three moving links, "la", "lb" and "lc".
    """
    angles = np.cumsum(y[:3], axis=0).T
    lengths = np.array([sizes[name] for name in ("la", "lb", "lc")])[:, None]
    ends = np.cumsum(lengths * np.stack([np.cos(angles), np.sin(angles)], axis=-1), axis=1)
    return np.concatenate([np.zeros((len(ends), 1, 2)), ends], axis=1)


def four_bar_figures(panels: Sequence[Any]) -> tuple[Any, Any]:
    """Draw the linkage by RK45 without projection and with all invariants kept.

    Return two figures: one of the two linkages with errors against costs below them, and one of the linkages alone.
    `panels` are the two `CostPanel` objects for the errors against costs.
    """
    from ..plotting import Linkage, linkage_figure, linkages_figure

    problem = four_bar()
    pivots, drawings = [[0, 0], [problem.parameters["ln"], 0]], {}
    options: dict[str, Any] = {
        "method": EIPRK45,
        "rtol": TOLERANCE,
        "atol": TOLERANCE,
        "t_eval": problem.t_span[1] - LAST,
    }
    for name, invariants in (("without projection", ()), ("constraints and energy kept", problem.invariants)):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            run = integrate(problem, invariants=invariants, **options)
        drawings[f"RK45 at {TOLERANCE:g}, {name}"] = Linkage(run.t, joints(run.y, problem.parameters), pivots)
    both = linkage_figure(
        drawings,
        panels,
        unit="m",
        time="t [s]",
        error="error of the last angles",
        title="Four-bar linkage",
        largest=1.0,
    )
    return both, linkages_figure(drawings, unit="m", time="t [s]")
