"""``eip-scipy study bodies``: cost and error against the number of bodies, EIPRKN12, REBOUND's IAS15 and its leapfrog.

A star with N - 1 light planets (G m = 1e-9 of the star's) on nearly circular, nearly coplanar orbits of semi-major axes
from 1 to 30, random phases. EIPRKN12, with every=10 and compensated=True, takes 25 or 4 steps in the innermost period;
IAS15 chooses its steps; leapfrog takes 400 or 800 in this period. REBOUND uses one thread, and so does this package
with ``OMP_NUM_THREADS=1``. Times are the least of three or more (of one for REBOUND with more than 300 bodies).
Errors are the largest distance of a body from its place in a run of EIPRKN12 with 50 steps. The steps that leapfrog
needs for the error of the run with 4 steps are extrapolated by its order, 2: the more accurate runs are beyond its
rounding errors. The share of the projection is that of the processor time, compared with runs without invariants; with
few bodies it contains the start of a run.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from eip_scipy import EIPRKN12, integrate
from eip_scipy.problems import Problem, nbody

from ..report import needed, table
from ..study import Measurement, Session, option
from ..timing import clocked, least

REPEATS, SECONDS = 3, 4.0
PERIOD = 2 * np.pi
STEPS, COARSE, REFERENCE = 25, 4, 50
LEAPFROG = 400, 800
FEW = 300  # with fewer bodies the runs are longer
Found = dict[int, dict[str, Any]]


@dataclass(frozen=True)
class Row:
    """Results of an integrator: steps per innermost period, milliseconds for a step and for a period, and the error.

    The error is a distance, in units of the innermost semi-major axis.
    """

    steps: float
    step: float
    period: float
    error: float


def system(bodies: int, periods: float) -> Problem:
    rng = np.random.default_rng(bodies)
    a = np.geomspace(1.0, 30.0, bodies - 1)
    phase, tilt = rng.uniform(0, 2 * np.pi, a.size), rng.normal(0, 0.01, a.size)
    flat = np.array([np.cos(phase), np.sin(phase) * np.cos(tilt), np.sin(phase) * np.sin(tilt)]).T
    along = np.array([-np.sin(phase), np.cos(phase) * np.cos(tilt), np.cos(phase) * np.sin(tilt)]).T
    gm = np.concatenate([[1.0], np.full(a.size, 1e-9)])
    q = np.concatenate([np.zeros((1, 3)), a[:, None] * flat])
    v = np.concatenate([np.zeros((1, 3)), along / np.sqrt(a)[:, None]])
    share = gm / gm.sum()
    return nbody(gm, q - share @ q, v - share @ v, t_span=(0.0, periods * PERIOD), h=PERIOD / STEPS)


@dataclass(frozen=True, kw_only=True)
class Bodies(Measurement[Found]):
    """Command ``eip-scipy study bodies``."""

    periods: int = option(
        5,
        "length of the runs in innermost periods, for N >= 300 bodies; 300 / N times as many for fewer (default: "
        "%(default)s)",
        type=int,
        metavar="N",
    )
    bodies: Sequence[int] = option((10, 30, 100, 300, 1000), "numbers of bodies", type=int, nargs="+", metavar="N")

    def measure(self, session: Session) -> Found:
        rebound = needed("eip_scipy.integrations.rebound")
        found = {}
        with session.bar(len(self.bodies), "bodies") as bar:
            for n in self.bodies:
                found[n] = _compare(n, self.periods * max(1, FEW // n), rebound)
                bar.update()
        return found

    def table(self, found: Found) -> str:
        body: list[tuple[str, list[str]]] = []
        for n, item in found.items():
            shares = ", ".join(f"{100 * share:.1f} % with {name}" for name, share in item["projection"].items())
            body.append((f"{n} bodies; share of the projection {shares}", []))
            body += [
                (f"  {name}", [f"{row[k]:{form}}" for k, form in FORMS.items()]) for name, row in item["rows"].items()
            ]
        head = [["steps", "a period"], ["ms", "a step"], ["ms", "a period"], ["error"]]
        return table(head, body)


FORMS = {"steps": ".3g", "step": ".3g", "period": ".3g", "error": ".1e"}


def _compare(n: int, periods: int, rebound: Any) -> dict[str, Any]:
    problem = system(n, periods)
    reference = _run(problem, h=PERIOD / REFERENCE).y[:, -1]

    def row(seconds: float, steps: int, end: np.ndarray) -> Row:
        return Row(steps / periods, 1e3 * seconds / steps, 1e3 * seconds / periods, _distance(end, reference))

    rows, shares = _ours(problem, periods, row)
    rows |= _theirs(problem, periods, row, rebound)
    last = rows[f"leapfrog, {LEAPFROG[1]} steps"]
    error = rows[f"EIPRKN12, {COARSE} steps"].error
    steps = last.steps * np.sqrt(last.error / error)
    rows["leapfrog, extrapolated"] = Row(steps, last.step, steps * last.step, error)
    return {"rows": {name: vars(item) for name, item in rows.items()}, "projection": shares}


def _ours(problem: Problem, periods: int, row: Callable[..., Row]) -> tuple[dict[str, Row], dict[str, float]]:
    """Return the rows of this package by the names of its runs, and the shares of the projection, see `_shares`.

    ``row(seconds, steps, end)`` makes a row from the time, the number of steps and the final state of a run.
    """
    coarse, h = f"EIPRKN12, {COARSE} steps", PERIOD / COARSE
    actions = {"EIPRKN12": partial(_seconds, problem), coarse: partial(_seconds, problem, h=h)}
    seconds = least(actions, seconds=SECONDS)
    ends = {coarse: _run(problem, h=h).y[:, -1], "EIPRKN12": _run(problem).y[:, -1]}
    rows = {
        name: row(seconds[name], periods * (COARSE if name == coarse else STEPS), ends.get(name, ends["EIPRKN12"]))
        for name in actions
    }
    return rows, _shares(problem)


def _shares(problem: Problem) -> dict[str, float]:
    """Return the shares of the time of a run that the projection takes, for ``every=10`` and ``every=1``.

    They are computed from processor times, which other programs hardly change.
    """
    cases: dict[str, dict[str, Any]] = {
        "every=10": {"every": 10},
        "every=1": {"every": 1},
        "none": {"every": None, "invariants": ()},
    }
    actions = {
        name: clocked(partial(_run, problem, check=False, **options), time.process_time)
        for name, options in cases.items()
    }
    seconds = least(actions, seconds=SECONDS)
    return {name: 1 - seconds["none"] / seconds[name] for name in cases if name != "none"}


def _theirs(problem: Problem, periods: int, row: Callable[..., Row], rebound: Any) -> dict[str, Row]:
    run = partial(rebound.run, problem.params, problem.y0)
    calls = {"IAS15": partial(run, "ias15", h=problem.t_span[1], n_steps=1)}
    for steps in LEAPFROG:
        calls[f"leapfrog, {steps} steps"] = partial(run, "leapfrog", h=PERIOD / steps, n_steps=steps * periods)
    rows = {}
    for name, call in calls.items():
        runs = [call() for _ in range(REPEATS if problem.y0.size <= 6 * FEW else 1)]
        rows[name] = row(min(item.wall_time for item in runs), runs[0].steps, runs[0].y[:, -1])
    return rows


def _run(problem: Problem, *, every: int | None = 10, **options: Any) -> Any:
    return integrate(problem, method=EIPRKN12, every=every, compensated=True, **options)


def _seconds(problem: Problem, **options: Any) -> float:
    return float(_run(problem, **options).wall_time)


def _distance(end: np.ndarray, reference: np.ndarray) -> float:
    apart = (end - reference)[: end.size // 2].reshape(-1, 3)
    return float(np.linalg.norm(apart, axis=1).max())
