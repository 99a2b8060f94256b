"""``eip-scipy study nystrom-defaults``: two options of EIPRKN8 and EIPRKN12 that could be defaults.

The options are a projection only if the invariant error exceeds round-off (`every="auto"`), and compensated sums. Runs
with either or both are compared with a run with neither. Ten bodies over 100 and 1000 years, orbits of exoplanets, the
hard problems and all hard cases whose forces do not change with the velocity; fixed steps with which EIPRKN12 has
errors of about 1e-3, 1e-6, 1e-9 and 1e-12, and three tolerances. Each number is over three neighbouring steps or
tolerances, because a single run's last digits are luck: the geometric mean of the errors at the end and of the largest
changes of an invariant along the run (up to 4000 of its rows), the sum of the times, and how many runs were not
reliable. Exoplanets need heyoka and REBOUNDx.

Result: the error is that of projecting each step, compensated or not, unless rounding is most of it; then both options
together divide it by up to 1000 (1000 years). But compensation takes 10 to 40 % more time in most runs, "auto" leaves
invariant errors of 1e-9 to 1e-7 between projections at loose tolerances, and with either option members of an ensemble
are not vectorised. Runs without them are never worse, so neither is a default.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from eip_scipy import EIPRKN8, EIPRKN12, ProjectionWarning, integrate
from eip_scipy.problems import Problem, solar_system
from eip_scipy.solvers import EIPSolver

from ..hard.runs import SCENES, scene
from ..hard_cases import hard_cases
from ..report import table
from ..study import Measurement, Session, option
from ..timing import clocked, least
from ..work_precision import known_end

WAYS: dict[str, dict[str, Any]] = {
    "each": {"every": 1, "compensated": False},
    "auto": {"every": "auto", "compensated": False},
    "each, compensated": {"every": 1, "compensated": True},
    "auto, compensated": {"every": "auto", "compensated": True},
}
NEIGHBOURS = 1.0, 0.97, 0.94
LEVELS = 1e-3, 1e-6, 1e-9, 1e-12
TOLERANCES = 1e-5, 1e-8, 1e-11
REPEATS = 3
MOST_STEPS = 40_000  # 1/8 of it in Python
MOST_ROWS = 4_000


class System(NamedTuple):
    """A problem, and a function that returns the error of a final state.

    `natively`: the run is compiled, so that its time is measured.
    """

    problem: Problem
    error: Callable[[np.ndarray], float]
    natively: bool = True


def by_reference(problem: Problem) -> System:
    """Make a system from a problem whose last state is known; errors are those of a component of the position."""
    truth = known_end(problem)
    return System(problem, lambda y: float(np.max(np.abs(y - truth)[: y.size // 2])))


def systems() -> Iterator[tuple[str, Callable[[], System]]]:
    """Yield the names of the systems, each with a function that makes the system."""
    for years in (100.0, 1000.0):
        yield f"ten bodies, {years:g} yr", partial(_solar, years)
    for name in ("resonant chain", "e = .6", "hot Jupiter"):
        yield name, partial(exoplanets, name)
    for name in SCENES:
        if name != "kepler-0.999":  # a million steps
            yield name, partial(_scene, name)
    for case in hard_cases():
        if is_second_order(case.problem):
            yield case.name, partial(System, case.problem, case.error, natively=False)


def _solar(years: float) -> System:
    return by_reference(solar_system(years=years))


def _scene(name: str) -> System:
    return by_reference(replace(scene(name).problem, h=None))


def exoplanets(name: str) -> System:
    """Return the system `name` of the study `exoplanets`, over 0.2 of its time span; the truth is a run by heyoka."""
    from .exoplanets import SYSTEMS
    from .relativity import reference, speed_of_light

    problem, _, relativity, *_ = SYSTEMS[name](0.2)
    assert problem.params is not None
    gm, half = problem.params[: problem.y0.size // 6], problem.y0.size // 2
    end = reference(gm, problem.y0, problem.t_span[1], speed_of_light if relativity else None)
    return System(problem, lambda y: float(np.max(np.abs(y[:half] - end))))


def is_second_order(problem: Problem) -> bool:
    """Return whether a hard case has the form q'' = a(t, q), judged by its right-hand side at two velocities."""
    t, y = problem.t_span[0], np.asarray(problem.y0)
    n = y.size // 2
    if y.dtype.kind == "c" or y.size % 2:
        return False
    rng = np.random.default_rng(1)
    turned = np.concatenate([y[:n], y[n:] * (1 + 0.1 * rng.standard_normal(n)) + 0.1 * rng.standard_normal(n)])
    f, other = problem.fun(t, y), problem.fun(t, turned)
    return bool(
        np.array_equal(f[:n], y[n:]) and np.array_equal(other[:n], turned[n:]) and np.array_equal(f[n:], other[n:])
    )


class Run(NamedTuple):
    """Results of a run.

    They are the error of the last state, the largest relative change of an invariant (`drift`), the processor time in
    seconds, the calls of the right-hand side, and whether the run is reliable.
    """

    error: float
    drift: float
    time: float
    nfev: int
    trusted: bool


def run_one(system: System, method: type[EIPSolver], options: dict[str, Any], rows: bool = True) -> Run:
    """Run a system, and return the results; if `rows` is true, the states that show the drift are saved.

    The time is the least of `REPEATS` further runs without saved states; it is inf if `rows` is false or the run is not
    compiled.
    """
    steps = options.get("save_every", 1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ProjectionWarning)
        run = integrate(system.problem, method=method, **options | ({"save_every": steps} if rows else {}))
        again = partial(integrate, system.problem, method=method, **options | {"save_every": None})
        turns = REPEATS if system.natively and rows else 0
        wall = least({"": clocked(again, time.process_time)}, turns=turns)[""]
    error = system.error(run.y[:, -1]) if run.success else math.nan
    values = run.invariants
    sizes = np.maximum(np.abs(values[:, 0]), 1e-3 * np.abs(values[:, 0]).max(initial=0.0))[:, None]
    drift = float(np.max(np.abs(values - values[:, :1]) / sizes)) if values.size else 0.0
    return Run(error, drift, wall, run.nfev, run.trusted)


def steps(system: System) -> list[int]:
    """Return the first numbers of steps at which the error of EIPRKN12 with projection is below each of `LEVELS`.

    Numbers grow by a factor of 1.3 from 8 on. Levels that are not reached with fewer than `MOST_STEPS` steps
    (`MOST_STEPS` / 8 for runs in Python) are left out.
    """
    found, n, left = list[int](), 8, list(LEVELS)
    span = abs(system.problem.t_span[1] - system.problem.t_span[0])
    while left and n < (MOST_STEPS if system.natively else MOST_STEPS // 8):
        error = run_one(system, EIPRKN12, {"h": span / n, "every": 1, "compensated": False}, rows=False).error
        if error < left[0]:
            found.append(n)
            while left and error < left[0]:
                left.pop(0)
        n = math.ceil(1.3 * n)
    return found


def settings(system: System) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """Yield, for each number of steps and each tolerance, its name and the options of three runs close to it."""
    span = abs(system.problem.t_span[1] - system.problem.t_span[0])
    for n in steps(system):
        save = {"save_every": max(1, n // MOST_ROWS)}
        yield f"{n} steps", [{"h": x * span / n} | save for x in NEIGHBOURS]
    for rtol in TOLERANCES:
        yield f"rtol {rtol:g}", [{"h": None, "rtol": x * rtol, "atol": 1e-3 * x * rtol} for x in NEIGHBOURS]


def mean(values: list[float]) -> float:
    """Return the geometric mean of `values`, each at least 1e-18; nan if one of them is nan, as for a failed run."""
    return float(np.exp(np.mean(np.log(np.maximum(values, 1e-18)))))


def rows(name: str, make: Callable[[], System]) -> Iterator[dict[str, Any]]:
    """Yield a row of results for each setting, method and way (one of `WAYS`, a combination of both options)."""
    system = make()
    for setting, options in settings(system):
        for method in (EIPRKN8, EIPRKN12):
            # In turn, because the machine may have other work to do.
            runs = [{way: run_one(system, method, o | more) for way, more in WAYS.items()} for o in options]
            for way in WAYS:
                own = [turn[way] for turn in runs]
                yield {
                    "system": name,
                    "method": method.__name__,
                    "setting": setting,
                    "way": way,
                    "error": mean([run.error for run in own]),
                    "worst": max(run.error for run in own),
                    "drift": mean([run.drift for run in own]),
                    "time": sum(run.time for run in own),
                    "nfev": sum(run.nfev for run in own),
                    "untrusted": sum(not run.trusted for run in own),
                    "natively": system.natively,
                }


@dataclass(frozen=True, kw_only=True)
class NystromDefaults(Measurement[list[dict[str, Any]]]):
    """Command ``eip-scipy study nystrom-defaults``."""

    system: list[str] | None = option(
        None, "name of a system to run, may be repeated; default: all", action="append", metavar="NAME"
    )

    def measure(self, session: Session) -> list[dict[str, Any]]:
        chosen = {name: make for name, make in systems() if not self.system or name in self.system}
        found: list[dict[str, Any]] = []
        with session.bar(len(chosen), "nystrom-defaults", "system") as bar:
            for name, make in chosen.items():
                found += rows(name, make)
                bar.update()
        return found

    def table(self, found: list[dict[str, Any]]) -> str:
        """Lay out, for each of `WAYS`, the error, the change of invariants, the cost and the number of unreliable runs.

        The cost is relative to the first way: processor time, or calls of the right-hand side for runs in Python.
        """
        heads = [[way if what == "error" else "", what] for way in WAYS for what in ("error", "drift", "time", "bad")]
        body = []
        for k in range(0, len(found), len(WAYS)):
            group, cells = found[k : k + len(WAYS)], []
            for row in group:
                cost = "time" if row["natively"] else "nfev"
                ratio = row[cost] / group[0][cost]
                cells += [f"{row['error']:.1e}", f"{row['drift']:.1e}", f"{ratio:.2f}", str(row["untrusted"])]
            body.append((", ".join(group[0][key] for key in ("system", "method", "setting")), cells))
        return table(heads, body)
