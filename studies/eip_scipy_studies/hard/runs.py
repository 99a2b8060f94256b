"""The hard problems run by several methods: errors against stored states or a closed form, evaluations, time.

This module prints and writes nothing. The integration of REBOUND is passed as a module, or None, so that the extra is
optional.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from eip_scipy import EIPDOP853, EIPRKN12, integrate
from eip_scipy.problems import (
    Problem,
    centre_time,
    comet,
    figure_eight,
    kepler,
    pair_time,
    pythagorean,
    reaches,
    time_transformed,
)
from eip_scipy.solvers import EIPSolver

from ..long_runs import named
from ..work_precision import known_end, work_precision

# Settings of IAS15, by its step criterion; each starts where the steps are about as long as its corrector can handle.
EPSILONS = {"prs23": (1e-4, 1e-5, 1e-6, 1e-7, 1e-9), "global": (1e-2, 1e-3, 1e-4, 1e-6, 1e-9)}
ATOL_PER_RTOL = 1e-3
ENOUGH_SECONDS = 0.4
MOST_SAVES = 20_000
# Longer than any problem takes in fictitious time, which ends at an event.
FAR = 1e6


@dataclass(frozen=True)
class Spread:
    """Settings of all methods, from coarse to fine, and the number of repeats.

    `tolerances` are the relative ones of the adaptive methods, `steps_per_turn` the steps per turn of the orbit in
    fictitious time (see `time_transformed`), and `epsilons` the tolerances of IAS15 by its step criterion. Each point
    is timed at most `repeats` times, of which the least time counts; long runs are repeated less. A short run is timed
    often, so that one of them fits between two disturbances by other processes.
    """

    tolerances: tuple[float, ...] = (1e-5, 1e-7, 1e-9, 1e-11, 1e-13)
    steps_per_turn: tuple[int, ...] = (20, 40, 60, 80, 120)
    epsilons: Mapping[str, tuple[float, ...]] = field(default_factory=lambda: EPSILONS)
    repeats: int = 40


@dataclass(frozen=True, eq=False)
class HardScene:
    """A problem with a known state at its end, and the data that the methods need.

    `g` is the time per unit of fictitious time, as a function of the state; see `time_transformed`. `steps` are numbers
    of fixed steps in the whole run, for EIPRKN12. `level` is the error at which costs are compared: sufficient for a
    user, and reached by most methods.
    """

    name: str
    title: str
    problem: Problem
    g: Callable[..., Any]
    steps: tuple[int, ...]
    level: float

    @property
    def end(self) -> np.ndarray:
        """Return the exact state at the end."""
        return known_end(self.problem)

    @property
    def dimensions(self) -> int:
        """Return the number of coordinates of a body, 2 or 3."""
        return int(self.problem.blocks)

    def error(self, y: np.ndarray) -> float:
        """Return the largest distance of a body from its true position in a final state; nan if it is not finite."""
        if not np.isfinite(y).all():
            return math.nan
        half = y.size // 2
        return float(np.linalg.norm((y - self.end)[:half].reshape(-1, self.dimensions), axis=1).max())

    def invariant_errors(self, y: np.ndarray) -> tuple[float, float]:
        """Return the largest errors of H and of L in the states `y` (n, m).

        They are relative to the first value, or absolute if this is 0.
        """
        found = []
        for item in self.problem.invariants:
            values = np.array([np.atleast_1d(item.fun(0.0, state, *item.args)) for state in y.T])
            size = float(np.linalg.norm(values[0])) or 1.0
            found.append(float(np.linalg.norm(values - values[0], axis=1).max()) / size)
        energy, momentum = found
        return energy, momentum

    def bodies(self) -> tuple[np.ndarray, np.ndarray]:
        """Return G times the masses (N,) and the initial state (6 N,) of N bodies in space, for REBOUND.

        REBOUND has no fixed centre, so that Kepler's problem becomes one of two equal masses.
        """
        problem = self.problem
        if self.dimensions == 3:
            assert problem.params is not None
            return problem.params, problem.y0
        relative = np.pad(problem.y0.reshape(2, 2), ((0, 0), (0, 1)))
        return np.array([0.5, 0.5]), np.stack([relative / 2, -relative / 2], axis=1).ravel()

    def from_bodies(self, y: np.ndarray) -> np.ndarray:
        """Return states (6 N, m) of the bodies of `bodies` as states (n, m) of the problem."""
        if self.dimensions == 3:
            return y
        q1, q2, v1, v2 = y.reshape(4, 3, -1)
        return np.concatenate([(q1 - q2)[:2], (v1 - v2)[:2]])


def _kepler(eccentricity: float, steps: tuple[int, ...]) -> HardScene:
    return HardScene(
        f"kepler-{eccentricity:g}",
        f"Kepler, e = {eccentricity:g}, 31.8 periods",
        replace(kepler(eccentricity, relativistic=0.0, t_end=200.0), h=None),
        centre_time,
        steps,
        1e-8,
    )


SCENES: dict[str, Callable[[], HardScene]] = {
    "kepler-0.9": partial(_kepler, 0.9, (10_000, 20_000, 40_000)),
    "kepler-0.99": partial(_kepler, 0.99, (100_000, 200_000, 400_000)),
    "kepler-0.999": partial(_kepler, 0.999, (1_000_000,)),
    "pythagorean": lambda: HardScene(
        "pythagorean", "Burrau's three bodies, t = 70", pythagorean(), pair_time, (700_000,), 1e-2
    ),
    "figure-eight": lambda: HardScene(
        "figure-eight",
        "figure eight, 100 periods",
        replace(figure_eight(), h=None),
        pair_time,
        (2_000, 4_000, 8_000, 16_000),
        1e-8,
    ),
    "comet": lambda: HardScene(
        "comet",
        "comet past Jupiter at 3 radii, 20 yr",
        comet(),
        pair_time,
        (20_000, 40_000, 80_000, 160_000),
        1e-8,
    ),
}


def scene(name: str) -> HardScene:
    """Make a problem by its name, a key of `SCENES`."""
    return SCENES[name]()


class Outcome(NamedTuple):
    """Result of one run: saved states (n, m), the last one at the end, evaluations, seconds, reason for a failure.

    `nfev` is 0 for IAS15 unless `look` of `Contender.run` is true. `failure` is empty if the run reached its end.
    """

    y: np.ndarray
    nfev: int
    wall_time: float
    failure: str = ""


class Contender(NamedTuple):
    """A method with its settings for one problem, from coarse to fine.

    `setting` is their name: "rtol", "h", "ds" (a step of fictitious time) or "epsilon" (of IAS15). ``run(setting,
    look)`` returns an `Outcome`; if `look` is true, the states of all steps are saved, and the time is meaningless.
    """

    setting: str
    settings: tuple[float, ...]
    run: Callable[[float, bool], Outcome]


class Point(NamedTuple):
    """Result of a method on a problem at one setting, whose name and value are `setting` and `value`.

    `wall_time` is the least of several runs in seconds. `error` is the largest distance of a body from its true
    position at the end, nan if the run failed; `energy_error` and `momentum_error` are those of
    `HardScene.invariant_errors`.
    """

    scene: str
    method: str
    setting: str
    value: float
    nfev: int
    wall_time: float
    error: float
    energy_error: float
    momentum_error: float
    failure: str


def methods(of: HardScene, spread: Spread, rebound: Any = None) -> dict[str, Contender]:
    """Return the methods for a problem, by their names.

    `rebound` is `eip_scipy.integrations.rebound`; without it there is no IAS15. "DOP853" is EIPDOP853 without
    invariants, which is SciPy's DOP853 compiled.
    """
    transformed, end = time_transformed(of.problem, FAR, of.g), reaches(of.problem.t_span[1])
    in_s = tuple(2 * math.pi / n for n in spread.steps_per_turn)
    t0, t_end = of.problem.t_span
    found = {
        "EIPDOP853": Contender("rtol", spread.tolerances, partial(_adaptive, of.problem, {})),
        "DOP853": Contender("rtol", spread.tolerances, partial(_adaptive, of.problem, {"invariants": ()})),
        "EIPDOP853, fixed ds": Contender("ds", in_s, partial(_fictitious, transformed, end, {})),
        "DOP853, fixed ds": Contender("ds", in_s, partial(_fictitious, transformed, end, {"invariants": ()})),
        "EIPRKN12": Contender("h", tuple((t_end - t0) / n for n in of.steps), partial(_fixed, of.problem)),
        "SciPy's DOP853": Contender("rtol", spread.tolerances, partial(_scipy, of.problem)),
    }
    if rebound is not None:
        for criterion, epsilons in spread.epsilons.items():
            found[f"IAS15, {criterion}"] = Contender("epsilon", epsilons, partial(_ias15, of, rebound, criterion))
    return found


def measure(
    of: HardScene, spread: Spread, rebound: Any = None, callback: Callable[[], Any] = lambda: None
) -> list[Point]:
    """Run all methods on a problem; `rebound` is as for `methods`.

    ``callback()`` is called once for each of the ``spread.repeats`` runs of each method at each setting, also for runs
    that are left out.
    """
    contenders = methods(of, spread, rebound)
    failures: dict[tuple[str, float], str] = {}

    def timed(name: str, value: float) -> tuple[float, np.ndarray]:
        outcome = contenders[name].run(value, False)
        failures[name, value] = outcome.failure
        end = outcome.y[:, -1]
        return outcome.wall_time, np.full_like(end, math.nan) if outcome.failure else end

    runners = {name: (partial(timed, name), method.settings) for name, method in contenders.items()}
    done = work_precision(
        runners, of.error, repeats=spread.repeats, enough_seconds=math.inf, in_all=ENOUGH_SECONDS, callback=callback
    )
    found = []
    for name, value, wall_time, error in done.points:
        looked = contenders[name].run(value, True)
        errors = of.invariant_errors(looked.y)
        setting, failure = contenders[name].setting, failures[name, value]
        found.append(Point(of.name, name, setting, value, looked.nfev, wall_time, error, *errors, failure))
    return found


def _adaptive(problem: Problem, options: dict[str, Any], rtol: float, look: bool) -> Outcome:
    every = 1 if look else None
    method = _on(problem, EIPDOP853)
    return _outcome(
        integrate(problem, method=method, rtol=rtol, atol=ATOL_PER_RTOL * rtol, save_every=every, **options)
    )


def _fictitious(problem: Problem, end: Callable[..., float], options: dict[str, Any], h: float, look: bool) -> Outcome:
    # Without `look`, only the start and the event are saved.
    every = 1 if look else round(FAR)
    run = _outcome(integrate(problem, method=_on(problem, EIPDOP853), h=h, events=end, save_every=every, **options))
    return run._replace(y=run.y[:-1])


def _fixed(problem: Problem, h: float, look: bool) -> Outcome:
    t0, t_end = problem.t_span
    every = max(1, round((t_end - t0) / h / MOST_SAVES)) if look else None
    return _outcome(integrate(problem, method=_on(problem, EIPRKN12), h=h, save_every=every))


def _on(problem: Problem, method: type[EIPSolver]) -> type[EIPSolver]:
    return named(method, f"{method.__name__} on {problem.name}")


def _outcome(run: Any) -> Outcome:
    return Outcome(run.y, run.nfev, run.wall_time, "" if run.success else run.message)


def _scipy(problem: Problem, rtol: float, look: bool) -> Outcome:
    start = perf_counter()
    run = solve_ivp(problem.fun, problem.t_span, problem.y0, method="DOP853", rtol=rtol, atol=ATOL_PER_RTOL * rtol)
    return Outcome(run.y, run.nfev, perf_counter() - start, "" if run.success else run.message)


def _ias15(of: HardScene, rebound: Any, criterion: str, epsilon: float, look: bool) -> Outcome:
    gm, y0 = of.bodies()
    t_end = of.problem.t_span[1]
    if look:
        steps = rebound.ias15_steps(gm, y0, t_end, epsilon=epsilon, criterion=criterion)
        return Outcome(of.from_bodies(steps.y), steps.nfev, math.nan)
    run = rebound.run(gm, y0, "ias15", h=t_end, n_steps=1, epsilon=epsilon, criterion=criterion)
    return Outcome(of.from_bodies(run.y), 0, run.wall_time)
