"""Error against cost for the solar system: what is timed, at which steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from ..longrun import integrate
from ..problems.solar_data import YEAR_D
from ..solvers import EIPRK4, EIPRK5, EIPSolver
from ..work_precision import Runner, WorkPrecision, work_precision
from .solar_errors import MERCURY
from .solar_run import Judge, Scene, eip_name, leapfrog, metric_of, rebound_run, stored_state, tight_run, whole_number

__all__ = ["REPEATS", "cost", "cost_methods"]

REPEATS = 3


def cost(
    scene: Scene,
    methods: Mapping[str, tuple[Runner, Sequence[float]]],
    judge: Judge | None,
    callback: Callable[[], Any] | None = None,
) -> WorkPrecision:
    """Mercury's final position error against the time of the run, for several methods and steps.

    Parameters
    ----------
    scene : Scene
        Of the span to be timed.
    methods : mapping
        From `cost_methods`.
    judge : callable or None
        REBOUND, if it is there.
    callback : callable, optional
        ``callback()`` after each run; there are `REPEATS` of each method and step.

    Returns
    -------
    WorkPrecision
    """
    truth = stored_state(scene, scene.years)
    if truth is None:
        truth = (tight_run(scene, False) if judge is None else rebound_run(scene, judge, "IAS15", "ias15", 1, False)).y[
            :, -1
        ]
    half = truth.size // 2

    def error(y: np.ndarray) -> float:
        return float(np.linalg.norm((y - truth)[:half].reshape(-1, 3)[1 + MERCURY]))

    return work_precision(methods, error, repeats=REPEATS, callback=callback)


def cost_methods(
    scene: Scene, method: type[EIPSolver], metric: str, judge: Judge | None
) -> dict[str, tuple[Runner, Sequence[float]]]:
    """List what `cost` times, with the steps.

    Parameters
    ----------
    scene : Scene
    method : type
        With its projection, and without; and beside it EIPRK5 (EIPRK4 beside EIPRK5).
    metric : {"error", "euclidean"}
    judge : callable or None

    Returns
    -------
    dict
        As `work_precision` takes it.
    """
    other = EIPRK4 if method is EIPRK5 else EIPRK5
    own = metric_of(method, metric)
    steps = _steps(scene, [scene.h * factor for factor in (4, 2, 1, 0.5)])
    methods: dict[str, tuple[Runner, Sequence[float]]] = {
        eip_name(method, own): (partial(_time_eip, scene, method, {"metric": own}), steps),
        method.TABLEAU.name: (partial(_time_eip, scene, method, {"invariants": ()}), steps),
        eip_name(other, metric): (partial(_time_eip, scene, other, {"metric": metric}), steps),
        "SV": (partial(_time_verlet, scene), _steps(scene, [scene.h * f for f in (2, 1, 1 / 2, 1 / 4, 1 / 8, 1 / 16)])),
    }
    if judge is None:
        return methods
    days = _steps(scene, [d / YEAR_D for d in (10.0, 5.0, 2.5, 1.25)])
    methods["WHFast"] = (partial(_time_rebound, scene, judge, "whfast"), days)
    methods["WHFast (c17)"] = (partial(_time_rebound, scene, judge, "whfast-c17"), days)
    if stored_state(scene, scene.years) is not None:  # otherwise it is the reference
        methods["IAS15"] = (partial(_time_rebound, scene, judge, "ias15"), [scene.years])
    return methods


def _steps(scene: Scene, wanted: Sequence[float]) -> list[float]:
    """Shorten steps to divide the span: a shortened last one would spoil a symplectic method."""
    return sorted({scene.years / whole_number(scene.years / h) for h in wanted}, reverse=True)


def _time_eip(scene: Scene, method: type[EIPSolver], options: dict[str, Any], step: float) -> tuple[float, np.ndarray]:
    result = integrate(scene.problem, method=method, h=step, **options)
    return result.wall_time, result.y[:, -1] if result.success else np.full_like(scene.problem.y0, np.nan)


def _time_verlet(scene: Scene, step: float) -> tuple[float, np.ndarray]:
    result = leapfrog(scene, step, None)
    return result.wall_time, result.y[:, -1]


def _time_rebound(scene: Scene, judge: Judge, integrator: str, step: float) -> tuple[float, np.ndarray]:
    n_steps = whole_number(scene.years / step)
    result = judge(scene.problem.params, scene.problem.y0, integrator, h=scene.years / n_steps, n_steps=n_steps)
    return result.wall_time, result.y[:, -1]
