"""Error against cost for the solar system: methods and steps that are timed."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from eip_scipy import EIPGJ14, EIPRK4, EIPRK5, EIPRKN12, integrate
from eip_scipy.problems import Problem
from eip_scipy.problems.gravity.solar_data import YEAR_D
from eip_scipy.solvers import EIPSolver

from ..long_runs import named
from ..work_precision import Runner, curves, work_precision
from .runs import (
    HIGH_ORDER,
    KEPT,
    MULTISTEP,
    Peer,
    SolarScene,
    eip_name,
    leapfrog,
    metric_of,
    rebound_run,
    stored_state,
    tight_run,
    whole_number,
)

ENOUGH_SECONDS = 0.2  # disturbances of so long a run are invisible on axes of many powers of ten
MULTISTEP_COUNTS = (255, 300, 412, 600)  # steps a year; half of the first number would be unstable
MERCURY = 0  # number among the planets, which follow the Sun


@dataclass(frozen=True, eq=False)
class TimedRun:
    """One method at one step or tolerance, with its wall time in seconds.

    `step` is in years; for heyoka it is the tolerance, and for IAS15, which chooses its steps, nan. `errors` (9,) are
    the distances of the planets from the reference [AU], nan if the run failed.
    """

    method: str
    step: float
    wall_time: float
    errors: np.ndarray

    @property
    def mercury(self) -> float:
        """Return the error of Mercury's position in AU."""
        return float(self.errors[MERCURY])

    @property
    def others(self) -> float:
        """Return the largest error of the position of another planet than Mercury in AU."""
        return float(np.delete(self.errors, MERCURY).max())


def by_us(problem: Problem, method: type[EIPSolver], **options: Any) -> Runner:
    """Return ``run(step)``, which runs the problem by `integrate` with this step in years.

    ``run(step)`` returns the seconds and the final state, which is nan if the run failed.
    """

    def run(step: float) -> tuple[float, np.ndarray]:
        name = f"{method.__name__}, h = {step:.4g} yr"
        result = integrate(problem, method=named(method, name), h=step, **options)
        return result.wall_time, result.y[:, -1] if result.success else np.full_like(problem.y0, np.nan)

    return run


def by_verlet(problem: Problem) -> Runner:
    """Return ``run(step)`` by Stoermer-Verlet, as `by_us` does."""

    def run(step: float) -> tuple[float, np.ndarray]:
        result = leapfrog(problem, step, None)
        return result.wall_time, result.y[:, -1]

    return run


def by_peer(problem: Problem, peer: Peer, integrator: str, **options: Any) -> Runner:
    """Return ``run(step)`` by an integrator of REBOUND, as `by_us` does; steps are shortened to divide the interval.

    `peer` is the function `run` of `eip_scipy.integrations.rebound`. IAS15 chooses its own steps; for it `step` is nan.
    """
    assert problem.params is not None
    gm, years = problem.params[: problem.y0.size // 6], problem.t_span[1]

    def run(step: float) -> tuple[float, np.ndarray]:
        n_steps = 1 if math.isnan(step) else whole_number(years / step)
        result = peer(gm, problem.y0, integrator, h=years / n_steps, n_steps=n_steps, **options)
        return result.wall_time, result.y[:, -1]

    return run


def timed(
    methods: Mapping[str, tuple[Runner, Sequence[float]]],
    truth: np.ndarray,
    *,
    repeats: int,
    enough_seconds: float = 1.0,
    callback: Callable[[], Any] | None = None,
) -> list[TimedRun]:
    """Run and time methods as `work_precision` does; `truth` (60,) is the state at the end of all runs."""
    done = work_precision(
        methods, lambda y: math.nan, repeats=repeats, enough_seconds=enough_seconds, callback=callback
    )

    def errors(y: np.ndarray) -> np.ndarray:
        return np.linalg.norm((y - truth)[: y.size // 2].reshape(-1, 3), axis=1)[1:]

    return [
        TimedRun(point.method, point.step, point.wall_time, errors(state))
        for point, state in zip(done.points, done.states, strict=True)
    ]


def panels(runs: Sequence[TimedRun], time: str = "wall time [s]") -> list[list[Any]]:
    """Return panels for `eip_scipy_studies.plotting.cost_figure`: Mercury's error, and the largest of the others.

    `time` is the label of the axis of times.
    """
    from ..plotting import CostPanel

    kinds = {"mercury": "Mercury", "others": "the worst of the other planets"}
    return [[CostPanel(title, time, curves(runs, error=error)) for error, title in kinds.items()]]


def cost(
    scene: SolarScene,
    methods: Mapping[str, tuple[Runner, Sequence[float]]],
    peer: Peer | None,
    *,
    repeats: int,
    callback: Callable[[], Any] | None = None,
) -> list[TimedRun]:
    """Time several methods and steps, and return the times and the errors of the final positions.

    The errors are relative to the stored state or, if there is none, to IAS15 or else to `tight_run`. `scene` is the
    problem over the time span to be timed, `methods` come from `cost_methods`, and `peer` is REBOUND, if it is
    installed. A run longer than `ENOUGH_SECONDS` is not repeated. ``callback()`` is called after each run, and for each
    repetition that is left out.
    """
    truth = stored_state(scene, scene.years)
    if truth is None:
        truth = (tight_run(scene, False) if peer is None else rebound_run(scene, peer, "IAS15", "ias15", 1, False)).y[
            :, -1
        ]
    return timed(methods, truth, repeats=repeats, enough_seconds=ENOUGH_SECONDS, callback=callback)


def cost_methods(
    scene: SolarScene, method: type[EIPSolver], metric: str, peer: Peer | None
) -> dict[str, tuple[Runner, Sequence[float]]]:
    """List the methods and steps that `cost` times, as for `work_precision`.

    `method`, the method asked for, is timed with and without its projection in the given `metric`; EIPRK5 (or EIPRK4 if
    `method` is EIPRK5), Stoermer-Verlet, EIPRKN12, EIPGJ14 and, if there is a `peer`, REBOUND's methods are timed as
    well.
    """
    other = EIPRK4 if method is EIPRK5 else EIPRK5
    own, problem = metric_of(method, metric), scene.problem
    steps = _steps(scene, [scene.h * factor for factor in (4, 2, 1, 0.5)])
    methods: dict[str, tuple[Runner, Sequence[float]]] = {
        eip_name(method, own): (by_us(problem, method, metric=own), steps),
        method.TABLEAU.name: (by_us(problem, method, invariants=()), steps),
        eip_name(other, metric): (by_us(problem, other, metric=metric), steps),
        "SV": (by_verlet(problem), _steps(scene, [scene.h * f for f in (2, 1, 1 / 2, 1 / 4, 1 / 8, 1 / 16)])),
        HIGH_ORDER: (by_us(problem, EIPRKN12, **KEPT), _steps(scene, [1 / n for n in (24, 32, 40, 48, 64)])),
        MULTISTEP: (by_us(problem, EIPGJ14), _steps(scene, [1 / n for n in MULTISTEP_COUNTS])),
    }
    if peer is None:
        return methods
    days = _steps(scene, [d / YEAR_D for d in (10.0, 5.0, 2.5, 1.25)])
    methods["WHFast"] = (by_peer(problem, peer, "whfast"), days)
    methods["WHFast (c17)"] = (by_peer(problem, peer, "whfast-c17"), days)
    if stored_state(scene, scene.years) is not None:  # otherwise it is the reference
        methods["IAS15"] = (by_peer(problem, peer, "ias15"), [scene.years])
    return methods


def _steps(scene: SolarScene, wanted: Sequence[float]) -> list[float]:
    """Return the wanted steps, shortened to divide the time span, in descending order.

    A shortened last step would spoil a symplectic method.
    """
    return sorted({scene.years / whole_number(scene.years / h) for h in wanted}, reverse=True)
