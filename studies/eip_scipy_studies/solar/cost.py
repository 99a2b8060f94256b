"""``eip-scipy solar-system --cost``: error against cost of several methods, each at several steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from eip_scipy import EIPGJ14, EIPRK4, EIPRK5, EIPRKN12
from eip_scipy.problems.gravity.solar_data import YEAR_D
from eip_scipy.solvers import EIPSolver

from ..output import Output
from ..report import compact, describe_machine, table
from .runs import KEPT, Rebound, Scene, by_rebound, by_us, by_verlet, metric_of, tightest, whole_number

REPEATS, ENOUGH_SECONDS = 3, 0.2  # a longer run is not repeated: disturbances of it are invisible on log axes
MULTISTEP_COUNTS = (255, 300, 412, 600)  # steps a year; half of the first number would be unstable
Methods = Mapping[str, tuple[Callable[..., Any], Sequence[float]]]  # `solve`, see `runs`, and steps


class TimedRun(NamedTuple):
    """A method at one step in years, the least wall time in seconds, and the errors of the positions at the end in AU.

    `error` is that of Mercury, and `error_others` the largest of another planet; both are nan if the run failed.
    """

    years: float
    method: str
    step: float
    wall_time: float
    error: float
    error_others: float


def cost_methods(scene: Scene, method: type[EIPSolver], metric: str, rebound: Rebound | None) -> Methods:
    """Return the methods and their steps in years: the chosen one with its projection and without it, and others."""

    def steps(wanted: Sequence[float]) -> list[float]:  # a shortened last step would spoil a symplectic method
        return sorted({scene.years / whole_number(scene.years / h) for h in wanted}, reverse=True)

    other, own = EIPRK4 if method is EIPRK5 else EIPRK5, metric_of(method, metric)
    usual = steps([scene.h * factor for factor in (4, 2, 1, 0.5)])
    found: dict[str, tuple[Callable[..., Any], Sequence[float]]] = {
        f"{method.__name__} ({own})": (by_us(scene, method, metric=own), usual),
        method.TABLEAU.name: (by_us(scene, method, invariants=()), usual),
        f"{other.__name__} ({metric})": (by_us(scene, other, metric=metric), usual),
        "SV": (by_verlet(scene), steps([scene.h * 2.0**-k for k in range(-1, 5)])),
        "EIPRKN12": (by_us(scene, EIPRKN12, **KEPT), steps([1 / n for n in (24, 32, 40, 48, 64)])),
        "EIPGJ14": (by_us(scene, EIPGJ14), steps([1 / n for n in MULTISTEP_COUNTS])),
    }
    if rebound is not None:
        for name, key in (("WHFast", "whfast"), ("WHFast (c17)", "whfast-c17")):
            found[name] = by_rebound(scene, rebound, key), steps([d / YEAR_D for d in (10.0, 5.0, 2.5, 1.25)])
        if scene.stored(scene.years) is not None:  # otherwise it is the reference
            found["IAS15"] = by_rebound(scene, rebound, "ias15"), [scene.years]
    return found


def show_costs(out: Output, scene: Scene, methods: Methods, rebound: Rebound | None) -> None:
    """Time methods, and write the table and the figure of error against cost."""
    with out.bar(None, "error against cost", total=REPEATS) as bar:
        runs = timed(scene, methods, rebound, bar.update)
    out.numbers["error_against_cost"] = [run._asdict() for run in runs]
    out.rows("error-against-cost.csv", out.numbers["error_against_cost"])
    body = []
    for run in runs:
        step = "adaptive" if run.method == "IAS15" else f"{run.step * YEAR_D:.4g}"
        body.append((run.method, [step, *map(compact, (run.wall_time, run.error, run.error_others))]))
    out.text(f"\nError of position after {scene.years:g} yr; {describe_machine()}, one thread, least of {REPEATS}\n")
    out.text(table([["step [d]"], ["wall [s]"], ["Mercury [AU]"], ["others [AU]"]], body))
    out.figure("error-against-cost.png", "solar.figures:error_against_cost", scene.data.name, runs)


def timed(scene: Scene, methods: Methods, rebound: Rebound | None, progress: Callable[[], Any]) -> list[TimedRun]:
    """Time all methods in turn, `REPEATS` times; another process then disturbs only one run of each.

    The errors are relative to the stored state or, if there is none, to the most accurate method.
    """
    stored = scene.stored(scene.years)
    truth = tightest(scene, rebound).run(scene).y[:, -1] if stored is None else stored
    found: dict[tuple[str, float], TimedRun] = {}
    for _ in range(REPEATS):
        for name, step in ((name, step) for name, (_, steps) in methods.items() for step in steps):
            before = found.get((name, step))
            if before is None or before.wall_time <= ENOUGH_SECONDS:
                result = methods[name][0](f"{name.partition(' (')[0]}, h = {step:.4g} yr", step)
                end = result.y[:, -1] if getattr(result, "success", True) else np.full(truth.size, np.nan)
                mercury, *others = np.linalg.norm((end - truth)[: truth.size // 2].reshape(-1, 3), axis=1)[1:]
                seconds = min(result.wall_time, before.wall_time if before else np.inf)
                found[name, step] = TimedRun(scene.years, name, step, seconds, float(mercury), float(max(others)))
        progress()
    return list(found.values())
