"""The solar system run by several methods: the common problem, the runs, and their states.

This module prints and writes nothing. REBOUND's `run` is passed as a function (`Peer`) or None, so that the extra is
optional.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from eip_scipy import EIPGJ14, EIPRKN12, integrate
from eip_scipy.problems import Problem, SolarSystemData, solar_system
from eip_scipy.problems.gravity.solar_data import YEAR_D, load
from eip_scipy.solvers import EIPSolver

from ..comparators import FixedSteps, Result, newton, stormer_verlet
from ..long_runs import named

Peer = Callable[..., Any]
"""`eip_scipy.integrations.rebound.run`."""

WHFAST_DAYS = 5.0
MOST_SAVES = 20_000
HIGH_ORDER, TIGHT = "EIPRKN12", "EIPRKN12 (tight)"
HIGH_ORDER_STEP = 1 / 64  # years: the remaining errors come from rounding, not from the step
KEPT: dict[str, Any] = {"every": 10, "compensated": True}
"""How long runs of high order keep their invariants."""
MULTISTEP, BALANCED = "EIPGJ14", "EIPGJ14 (balances)"
MULTISTEP_STEP = 1 / 600  # years
POWERS = (1.0, 10.0, 100.0, 1000.0, 10_000.0)


@dataclass(frozen=True, eq=False)
class SolarScene:
    """Common input of all methods: the problem in AU and Julian years, its data, and the times of saved states.

    The length `years` and the step `h` are in Julian years. `n_saves` equally spaced states are saved after the start,
    with `every` steps between two of them; `h` divides the time between saves.
    """

    problem: Problem
    data: SolarSystemData
    years: float
    h: float
    n_saves: int
    every: int

    @property
    def interval(self) -> float:
        """Return the time between two saved states in years."""
        return self.years / self.n_saves

    @property
    def planets(self) -> tuple[str, ...]:
        """Return the names of the bodies without the Sun."""
        return self.data.bodies[1:]


@dataclass(frozen=True, eq=False)
class MethodRun:
    """One method's run; states that are not finite are left out.

    `head` is the name, divided into the lines of a table's head. `step` is in years, None if the method chooses its
    steps. `wall_time` are the seconds of the run, without compilation and without reading states. The states `y` (60,
    m), in AU and AU/yr, are those at the times `t` (m,) in Julian years. The errors (m,) are ``|H - H(0)| / |H(0)|``
    and ``|L - L(0)| / |L(0)|``. `failure` is the reason why the run did not reach its end, empty if it did.
    """

    name: str
    head: tuple[str, ...]
    step: float | None
    wall_time: float
    t: np.ndarray
    y: np.ndarray
    energy_error: np.ndarray
    momentum_error: np.ndarray
    failure: str = ""


class PendingRun(NamedTuple):
    """A run that is still to be done.

    ``start(progress)`` does it and returns a `MethodRun`. `has_bar` says whether the run shows its own progress bar.
    """

    name: str
    start: Callable[[bool], MethodRun]
    has_bar: bool


def make_scene(data: str | SolarSystemData, years: float, h: float) -> SolarScene:
    """Make the problem for a run of `years` Julian years, > 0.

    `data` is one of `eip_scipy.problems.gravity.solar_data.available()`, or data for another epoch. `h` is the upper
    bound of the step in years; the step divides the time between saved states and is shortened if necessary. A
    ValueError is raised if the step is longer than the run or too small to change the time in floating-point
    arithmetic, or if the data are unknown.
    """
    FixedSteps.of((0.0, years), h, None)
    n_saves = whole_number(years / max(_save_interval(years), h))
    every = whole_number(years / (n_saves * h))
    step = years / (n_saves * every)
    known = load(data) if isinstance(data, str) else data
    return SolarScene(solar_system(known, years=years, h=step), known, years, step, n_saves, every)


def _save_interval(years: float) -> float:
    """Return the time in years between two saved states of a run of `years` years.

    It is short enough to count the turns of the planets and to draw curves, and such that states at 1, 10, 100 ...
    years are saved.
    """
    for least_years, interval in ((200.0, 1.0), (100.0, 0.5), (40.0, 0.2), (1.0, 0.1)):
        if years >= least_years:
            return max(interval, years / MOST_SAVES)
    return years / 10


def whole_number(ratio: float) -> int:
    """Return the ratio rounded up, or to the nearest integer if it differs only by rounding errors; at least 1."""
    nearest = round(ratio)
    return max(1, nearest if abs(ratio - nearest) <= 1e-9 * ratio else math.ceil(ratio))


def plan(
    scene: SolarScene,
    method: type[EIPSolver],
    metric: str,
    peer: Peer | None,
    checkpoint_of: Callable[[str], dict[str, Any]] = lambda name: {},
) -> list[PendingRun]:
    """Return the runs of the comparison: first that of `method`, last the most accurate one, which is the reference.

    `method` is `EIPRK1` ... `EIPRK5` or another fixed-step class, `metric` ("error" or "euclidean") that of its
    projection, and `peer` REBOUND's `run`, if REBOUND is installed. ``checkpoint_of(name)`` returns the options of
    `integrate` that keep checkpoints of the run of that name.
    """
    tasks = []

    def add(name: str, method: type[EIPSolver], head: tuple[str, str], per_save: int | None, **options: Any) -> None:
        options |= checkpoint_of(name)
        tasks.append(PendingRun(name, partial(_own, scene, name, method, head, per_save, **options), True))

    for m in dict.fromkeys([metric_of(method, metric), metric_of(method, "error"), "euclidean"]):
        add(eip_name(method, m), method, (method.__name__, "euclid." if m == "euclidean" else m), None, metric=m)
    name = method.TABLEAU.name
    add(name, method, (name, "alone"), None, invariants=())
    tasks.append(PendingRun("SV", lambda progress: _verlet(scene), False))
    high_order, multistep = (whole_number(scene.interval / h) for h in (HIGH_ORDER_STEP, MULTISTEP_STEP))
    add(HIGH_ORDER, EIPRKN12, (HIGH_ORDER, "every 10"), high_order, **KEPT)
    add(MULTISTEP, EIPGJ14, (MULTISTEP, "auto"), multistep)
    add(BALANCED, EIPGJ14, (MULTISTEP, "balances"), multistep, **orbits_kept(scene.data))
    if peer is None:
        tasks.append(PendingRun(TIGHT, partial(tight_run, scene, **checkpoint_of(TIGHT)), True))
        return tasks
    per_save = max(1, round(scene.interval * YEAR_D / WHFAST_DAYS))
    for name, integrator, steps in (
        ("WHFast", "whfast", per_save),
        ("WHFast (c17)", "whfast-c17", per_save),
        ("IAS15", "ias15", 1),
    ):
        tasks.append(PendingRun(name, partial(rebound_run, scene, peer, name, integrator, steps), False))
    return tasks


def metric_of(method: type[EIPSolver], metric: str) -> str:
    """Return the metric that a method uses: `metric`, or "euclidean" if the method has no error estimate."""
    return metric if method.TABLEAU.has_estimate else "euclidean"


def eip_name(method: type[EIPSolver], metric: str) -> str:
    """Return the name of a method with its metric, such as "EIPRK4 (error)"."""
    return f"{method.__name__} ({metric})"


def _own(
    scene: SolarScene,
    name: str,
    method: type[EIPSolver],
    head: tuple[str, str],
    per_save: int | None,
    progress: bool,
    **options: Any,
) -> MethodRun:
    """Run a method of this package, with `per_save` steps between two saved states, or the step of the problem."""
    step, every = (scene.h, scene.every) if per_save is None else (scene.interval / per_save, per_save)
    result = integrate(
        scene.problem, method=named(method, name), h=step, save_every=every, progress=progress, **options
    )
    return _finished(scene, name, head, step, result, "" if result.success else result.message)


def tight_run(scene: SolarScene, progress: bool, **checkpoint: Any) -> MethodRun:
    """Run the most accurate method that needs no REBOUND: EIPRKN12 with half of its usual step."""
    per_save = 2 * whole_number(scene.interval / HIGH_ORDER_STEP)
    return _own(scene, TIGHT, EIPRKN12, (HIGH_ORDER, "tight"), per_save, progress, **KEPT, **checkpoint)


def orbits_kept(data: str | SolarSystemData = "de440") -> dict[str, Any]:
    """Return options of `integrate` that keep each planet's energy about the Sun.

    These energies take the place of the total energy and the total angular momentum.
    """
    problem = solar_system(data, balances="kepler")
    return {"invariants": problem.invariants, "frame": problem.frame}


def _verlet(scene: SolarScene) -> MethodRun:
    result = leapfrog(scene.problem, scene.h, scene.every)
    failure = "" if np.isfinite(result.y).all() else result.message
    return _finished(scene, "SV", ("SV",), scene.h, result, failure)


def leapfrog(problem: Problem, step: float, save_every: int | None) -> Result:
    """Run Stoermer-Verlet in its kick-drift-kick form with steps of length `step`; return its `Result`.

    Every `save_every`-th state is saved in addition to the first and the last; None saves only these two.
    """
    return stormer_verlet(newton, problem.t_span, problem.y0, step, params=problem.params, save_every=save_every)


def rebound_run(scene: SolarScene, peer: Peer, name: str, integrator: str, per_save: int, progress: bool) -> MethodRun:
    """Run an integrator of REBOUND with `per_save` steps between two saved states.

    `peer` is REBOUND's `run`; `progress` is not used. Integrators with fixed steps are timed in a second run without
    saves, because each save costs a synchronisation.
    """
    step = scene.interval / per_save
    run = partial(peer, scene.problem.params, scene.problem.y0, integrator, h=step, n_steps=scene.n_saves * per_save)
    result = run(save_every=per_save)
    fixed = integrator != "ias15"
    wall_time = run().wall_time if fixed else result.wall_time
    head = tuple(name.replace("(", "").replace(")", "").split())
    return _finished(scene, name, head, step if fixed else None, result, "", wall_time)


def _finished(
    scene: SolarScene,
    name: str,
    head: tuple[str, ...],
    step: float | None,
    result: Any,
    failure: str,
    wall_time: float | None = None,
) -> MethodRun:
    finite = np.isfinite(result.y).all(axis=0)
    t, y = result.t[finite], result.y[:, finite]
    states = list(zip(t.tolist(), y.T.copy(), strict=True))
    kept = [np.array([item.fun(*state) for state in states]) for item in scene.problem.invariants]
    values = np.concatenate([item.reshape(t.size, -1).T for item in kept])
    start = values[:, :1]
    return MethodRun(
        name=name,
        head=head,
        step=step,
        wall_time=result.wall_time if wall_time is None else wall_time,
        t=t,
        y=y,
        energy_error=np.abs(values[0] / start[0] - 1),
        momentum_error=np.linalg.norm((values - start)[1:], axis=0) / np.linalg.norm(start[1:]),
        failure=failure,
    )


def stored_state(scene: SolarScene, year: float) -> np.ndarray | None:
    """Return the reference state (60,) that the package carries for the time `year`, or None if there is none."""
    known = scene.problem.reference
    return None if known is None else known(round(float(year), 9))


def report_times(scene: SolarScene) -> list[float]:
    """Return the years at which errors are reported: the end, and powers of ten with a saved and a stored state."""
    times = [t for t in np.linspace(0.0, scene.years, scene.n_saves + 1)[1:] if round(t, 9) in POWERS]
    stored = [round(float(t), 9) for t in times if stored_state(scene, t) is not None]
    return sorted({*stored, float(scene.years)})
