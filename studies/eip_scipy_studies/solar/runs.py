"""The solar system run by several methods: the common problem, the methods, and the runs with their states."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

import eip_scipy
from eip_scipy import EIPGJ14, EIPRKN12, integrate
from eip_scipy.problems import Problem, SolarSystemData, solar_system
from eip_scipy.problems.gravity.solar_data import YEAR_D, load
from eip_scipy.solvers import EIPSolver

from ..comparators import FixedSteps, newton, stormer_verlet
from ..report import named

Solve = Callable[..., Any]
"""``solve(label, step, save_every=None, **checkpoint)`` returns a result with `t`, `y` and `wall_time`."""
Rebound = Callable[..., Any]
"""`eip_scipy.integrations.rebound.run`; where None is allowed, REBOUND may be missing."""

MOST_SAVES = 20_000
INTERVALS = ((200.0, 1.0), (100.0, 0.5), (40.0, 0.2), (1.0, 0.1))
"""Years of a run and, in runs as long as that, between saved states: turns are counted, and 1, 10 ... years are met."""
KEPT: dict[str, Any] = {"every": 10, "compensated": True}
"""How long runs of high order keep their invariants."""
TIGHT = "EIPRKN12 (tight)"
WHFAST, HIGH_ORDER, MULTISTEP = 5.0 / YEAR_D, 1 / 64, 1 / 600  # steps in years
POWERS = (1.0, 10.0, 100.0, 1000.0, 10_000.0)


class Scene(NamedTuple):
    """Common input of all methods: the problem in AU and Julian years, its data, and the times of saved states.

    `n_saves` equally spaced states are saved after the start, with `every` steps of `h` years between two of them.
    """

    problem: Problem
    data: SolarSystemData
    years: float
    h: float
    n_saves: int
    every: int

    def dividing(self, longest: float) -> tuple[float, int]:
        """Return the longest step up to `longest` that divides the time between saves, and how often it does."""
        interval = self.years / self.n_saves
        every = whole_number(interval / longest)
        return interval / every, every

    def stored(self, year: float) -> np.ndarray | None:
        """Return the reference state (60,) that the package carries for a time, or None if there is none."""
        known = self.problem.reference
        return None if known is None else known(round(float(year), 9))

    def report_times(self) -> list[float]:
        """Return the times at which errors are reported: the end, and powers of ten with a saved and a stored state."""
        times = [round(float(t), 9) for t in np.linspace(0.0, self.years, self.n_saves + 1)[1:]]
        return sorted({*(t for t in times if t in POWERS and self.stored(t) is not None), float(self.years)})


def make_scene(data: str | SolarSystemData, years: float, h: float) -> Scene:
    """Make the problem for a run of `years` Julian years; the step is at most `h` and divides the time between saves.

    A ValueError is raised if `h` is longer than the run or too small to change the time.
    """
    FixedSteps.of((0.0, years), h, None)
    interval = next((max(part, years / MOST_SAVES) for least, part in INTERVALS if years >= least), years / 10)
    n_saves = whole_number(years / max(interval, h))
    every = whole_number(years / (n_saves * h))
    step = years / (n_saves * every)
    known = load(data) if isinstance(data, str) else data
    return Scene(solar_system(known, years=years, h=step), known, years, step, n_saves, every)


def whole_number(ratio: float) -> int:
    """Return the ratio rounded up, or to the nearest integer if it differs only by rounding errors; at least 1."""
    nearest = round(ratio)
    return max(1, nearest if abs(ratio - nearest) <= 1e-9 * ratio else int(np.ceil(ratio)))


class Run(NamedTuple):
    """Result of a method: seconds, the states `y` (60, m) at the times `t`, and the relative errors (m,) of H and L.

    The step is in years, None if the method chooses its steps. `failure` is the reason why the run did not reach its
    end, empty if it did.
    """

    name: str
    step: float | None
    wall_time: float
    t: np.ndarray
    y: np.ndarray
    energy_error: np.ndarray
    momentum_error: np.ndarray
    failure: str = ""


class Method(NamedTuple):
    """A method with its step in years, and the number of steps between two saved states.

    An `adaptive` method chooses its steps. A `split` one is timed without saves, each of which synchronises it.
    """

    name: str
    solve: Solve
    step: float
    every: int
    adaptive: bool = False
    split: bool = False

    def run(self, scene: Scene, **checkpoint: Any) -> Run:
        """Run the method; states that are not finite are left out."""
        result = self.solve(self.name, self.step, self.every, **checkpoint)
        wall_time = self.solve(self.name, self.step).wall_time if self.split else result.wall_time
        finite = np.isfinite(result.y).all(axis=0)
        failure = "" if finite.all() and getattr(result, "success", True) else result.message
        t, y = result.t[finite], result.y[:, finite]
        states = list(zip(t.tolist(), y.T.copy(), strict=True))
        kept = [np.array([item.fun(*state) for state in states]) for item in scene.problem.invariants]
        H, L = (item.reshape(t.size, -1).T for item in kept)
        momentum = np.linalg.norm(L - L[:, :1], axis=0) / np.linalg.norm(L[:, 0])
        step = None if self.adaptive else self.step
        return Run(self.name, step, wall_time, t, y, np.abs(H[0] / H[0, 0] - 1), momentum, failure)


def by_us(scene: Scene, method: type[EIPSolver], **options: Any) -> Solve:
    """Return ``solve`` by a method of this package."""
    return lambda label, step, save_every=None, **checkpoint: integrate(
        scene.problem, method=named(method, label), h=step, save_every=save_every, **options, **checkpoint
    )


def by_verlet(scene: Scene) -> Solve:
    """Return ``solve`` by Stoermer-Verlet in its kick-drift-kick form."""
    run = partial(stormer_verlet, newton, scene.problem.t_span, scene.problem.y0, params=scene.problem.params)
    return lambda label, step, save_every=None, **_: run(h=step, save_every=save_every)


def by_rebound(scene: Scene, rebound: Rebound, integrator: str) -> Solve:
    """Return ``solve`` by an integrator of REBOUND."""
    run = partial(rebound, scene.problem.params, scene.problem.y0, integrator)
    return lambda label, step, save_every=None, **_: run(
        h=step, n_steps=whole_number(scene.years / step), save_every=save_every
    )


def tableaux() -> dict[str, type[EIPSolver]]:
    """Return the solver classes of `eip_scipy` that have a tableau of coefficients, by their names."""
    found = {name: getattr(eip_scipy, name) for name in eip_scipy.__all__ if name.startswith("EIP")}
    return {name: value for name, value in found.items() if hasattr(value, "TABLEAU")}


def metric_of(method: type[EIPSolver], metric: str) -> str:
    """Return `metric`, or "euclidean" if the method has no error estimate."""
    return metric if method.TABLEAU.has_estimate else "euclidean"


def methods(scene: Scene, method: type[EIPSolver], metric: str, rebound: Rebound | None) -> list[Method]:
    """Return the methods of the comparison: first `method` with `metric`, last the most accurate one, the reference."""
    own, high, multistep = (scene.h, scene.every), scene.dividing(HIGH_ORDER), scene.dividing(MULTISTEP)
    orbits = solar_system(scene.data, balances="kepler")
    kinds = dict.fromkeys([metric_of(method, metric), metric_of(method, "error"), "euclidean"])
    found = [Method(f"{method.__name__} ({kind})", by_us(scene, method, metric=kind), *own) for kind in kinds]
    found += [
        Method(method.TABLEAU.name, by_us(scene, method, invariants=()), *own),
        Method("SV", by_verlet(scene), *own),
        Method("EIPRKN12", by_us(scene, EIPRKN12, **KEPT), *high),
        Method("EIPGJ14", by_us(scene, EIPGJ14), *multistep),
        Method(
            "EIPGJ14 (balances)",
            by_us(scene, EIPGJ14, invariants=orbits.invariants, linear_invariants=orbits.linear_invariants),
            *multistep,
        ),
    ]
    if rebound is not None:
        interval = scene.years / scene.n_saves
        every = max(1, round(interval / WHFAST))
        for name, key in (("WHFast", "whfast"), ("WHFast (c17)", "whfast-c17")):
            found.append(Method(name, by_rebound(scene, rebound, key), interval / every, every, split=True))
    return [*found, tightest(scene, rebound)]


def tightest(scene: Scene, rebound: Rebound | None) -> Method:
    """Return the most accurate method: IAS15 or, without REBOUND, EIPRKN12 with half of its usual step."""
    interval = scene.years / scene.n_saves
    if rebound is not None:
        return Method("IAS15", by_rebound(scene, rebound, "ias15"), interval, 1, adaptive=True)
    every = 2 * scene.dividing(HIGH_ORDER)[1]
    return Method(TIGHT, by_us(scene, EIPRKN12, **KEPT), interval / every, every)
