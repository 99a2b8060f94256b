"""``eip-scipy study multistep``: Gauss-Jackson methods, one evaluation a step, against EIPRKN12 and other packages.

1. Ten bodies, Newton, 1000 years: each method runs once in each of six orientations of the axes (the original one and
   five random ones), in turns. Errors of position [AU] against the packaged reference state: Mercury's, the least and
   the largest over the orientations, and the largest of another planet. The ratios below the table are those of the
   least times.
2. The same over 10 000 years (IAS15 once), against the packaged states.
3. Kepler's problem with e = 0.6 and the relativistic term to t = 600, compared with heyoka, without its compilation.
4. EIPRKN12 over 100 years with steps of 0.02 yr, with and without projection, in the same orientations.

All runs use one core, which must have no other load, since ratios of times are the result. Parts 1 and 2 need REBOUND,
part 3 heyoka.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from eip_scipy import EIPDOP853, EIPGJ12, EIPGJ14, EIPRKN12, eip_method, integrate
from eip_scipy.methods import GaussJackson
from eip_scipy.problems import Problem, kepler, solar_system
from eip_scipy.problems.gravity.solar_data import reference_states

from ..report import needed, table
from ..solar.cost import by_us, timed
from ..study import Measurement, Session, option
from ..work_precision import cost_to_reach, known_end
from .orbits import Methods, Row, by_rebound, daily, orbit_table, rows, yearly

ROTATIONS = 6
REPEATS = 200  # for runs of milliseconds
END, WANTED = 600.0, 1e-9
OURS = ("EIP_GJ16", "EIPGJ14", "EIPGJ12", "EIPRKN12")
EIP_GJ16 = eip_method(GaussJackson(order=16, corrected=True))
Table = dict[str, Row]


@dataclass(frozen=True, kw_only=True)
class Multistep(Measurement[dict[str, Table]]):
    """Command ``eip-scipy study multistep``."""

    parts: Sequence[int] = option(
        (1, 2, 3, 4), "parts of the study to run (default: all)", type=int, nargs="+", choices=(1, 2, 3, 4)
    )
    quick: bool = option(False, "a trial: 0.1 of the time spans and fewer rotations")

    def measure(self, session: Session) -> dict[str, Table]:
        if 3 in self.parts:  # before the minutes that the other parts take
            needed("heyoka", '"eip_scipy[heyoka]"')
        ways = {1: thousand_years, 2: ten_thousand_years, 3: against_heyoka, 4: with_projection}
        with session.bar(len(self.parts), "multistep", "part") as bar:
            found = {}
            for part in self.parts:
                found[str(part)] = ways[part](self.quick)
                bar.update()
        return found

    def table(self, found: dict[str, Table]) -> str:
        share = 10 if self.quick else 1
        titles = {
            "1": f"Ten bodies, {1000 / share:g} years",
            "2": f"Ten bodies, {10_000 / share:g} years",
            "3": f"Kepler, e = 0.6, relativistic term, t = {END:g}: steps in 2 pi, or tolerances",
            "4": f"Ten bodies, {100 / share:g} years, h = 0.02 yr",
        }
        parts = []
        for part, own in found.items():
            text = kepler_table(own) if part == "3" else orbit_table(own, "Mercury")
            if part == "1":
                text += "\n\n" + "\n".join(compared(own, 2e-9, 1e-10) + compared(own, 1e-7, math.inf))
            parts.append(f"{part}. {titles[part]}\n\n{text}")
        return "\n\n".join(parts)


def thousand_years(quick: bool) -> Table:
    years = 100.0 if quick else 1000.0
    problem = solar_system(years=years)

    def methods(turned: Problem, turn: int) -> Methods:
        return {
            **yearly("EIP_GJ16", by_us(turned, EIP_GJ16), 300, 325, 350),
            **yearly("EIP_GJ16, every=100", by_us(turned, EIP_GJ16, every=100), 330, 350),
            **yearly("EIPGJ14", by_us(turned, EIPGJ14), 260, 300, 350, 405, 440, 500, 600, 768),
            **yearly("EIPGJ12", by_us(turned, EIPGJ12), 592),
            **yearly("EIPRKN12", by_us(turned, EIPRKN12, every=10, compensated=True), 44, 64),
            **daily("WHFast c17", by_rebound(turned, "whfast-c17"), 5, 4, 3, 2, 1.4, 1),
            "IAS15": (by_rebound(turned, "ias15"), [math.nan]),
        }

    return in_rotations(problem, known_end(problem), methods, 2 if quick else ROTATIONS)


def ten_thousand_years(quick: bool) -> Table:
    years = 1000.0 if quick else 10_000.0

    def methods(turned: Problem, turn: int) -> Methods:
        found = {
            **yearly("EIPGJ14", by_us(turned, EIPGJ14), 412, 500, 600, 768),
            **yearly("EIPRKN12", by_us(turned, EIPRKN12, every=10, compensated=True), 64, 80, 100),
            **daily("WHFast c17", by_rebound(turned, "whfast-c17"), 3, 2, 1),
        }
        return found if turn else found | {"IAS15": (by_rebound(turned, "ias15"), [math.nan])}

    return in_rotations(solar_system(years=years), reference_states()[years], methods, 1 if quick else ROTATIONS)


def with_projection(quick: bool) -> Table:
    problem = solar_system(years=10.0 if quick else 100.0)

    def methods(turned: Problem, turn: int) -> Methods:
        ways: dict[str, dict[str, Any]] = {"no projection": {"invariants": ()}, "every=10": {"every": 10}}
        runs = {name: (by_us(turned, EIPRKN12, **options), [0.02]) for name, options in ways.items()}
        return {f"{name}, rotation {turn}": run for name, run in runs.items()}

    return in_rotations(problem, known_end(problem), methods, 2 if quick else ROTATIONS)


def against_heyoka(quick: bool) -> Table:
    """Return a row for each method: least times in ms of the whole call and of its steps alone, and the final error.

    The error is the largest component of the difference of the final state from that by heyoka with tolerance 1e-18.
    """
    problem = kepler(0.6, 0.005, END)
    truth = taylor(problem, 1e-18)[0]()
    calls: dict[str, tuple[Callable[[], np.ndarray], Callable[[], float]]] = {
        f"heyoka, tol {tol:g}": taylor(problem, tol) for tol in (1e-13, 1e-12, 3e-12)
    }
    for method, counts in ((EIPGJ14, (256, 288, 320, 384)), (EIPGJ12, (400, 448, 512)), (EIPRKN12, (40, 44, 48))):
        options = {"every": 10} if method is EIPRKN12 else {}
        for n in counts:
            calls[f"{method.__name__}, {n}"] = own(problem, method=method, h=2 * math.pi / n, **options)
    calls["EIPDOP853, rtol 3e-12"] = own(problem, method=EIPDOP853, rtol=3e-12, atol=3e-14)
    found: Table = {name: {"call": math.inf, "steps": math.inf, "error": 0.0} for name in calls}
    for _ in range(2 if quick else REPEATS):
        for name, (run, steps) in calls.items():
            begin = perf_counter()
            state = run()
            row = found[name]
            row["call"] = min(row["call"], 1e3 * (perf_counter() - begin))
            row["steps"] = min(row["steps"], 1e3 * steps())
            row["error"] = float(np.abs(state - truth).max())
    return found


def kepler_table(found: Table) -> str:
    """Lay out the results of `against_heyoka`, and compare the least times for an error of at most `WANTED`.

    Below the table is a line for each method of this package: its least time of the whole call and of the steps alone,
    each divided by heyoka's least time of the whole call.
    """
    body = [(name, [f"{row['call']:.3f}", f"{row['steps']:.3f}", f"{row['error']:.1e}"]) for name, row in found.items()]
    lines = [table([["call [ms]"], ["steps [ms]"], ["error"]], body), ""]
    enough = {name: row for name, row in found.items() if row["error"] <= WANTED}
    for kind in OURS:
        times = [least(enough, kind, part) / least(enough, "heyoka", "call") for part in ("call", "steps")]
        lines.append(f"error {WANTED:g}: {kind} takes {times[0]:.2f} of heyoka's time, its steps alone {times[1]:.2f}")
    return "\n".join(lines)


def own(problem: Problem, **options: Any) -> tuple[Callable[[], np.ndarray], Callable[[], float]]:
    """Return a function that runs the problem and returns its final state, and one for the seconds of the last run.

    The `options` are those of `integrate`. The seconds are those of the steps, without compilation and without the time
    before the steps.
    """
    last = [0.0]

    def run() -> np.ndarray:
        result = integrate(problem, **options)
        last[0] = result.wall_time
        return result.y[:, -1]

    return run, lambda: last[0]


def taylor(problem: Problem, tolerance: float) -> tuple[Callable[[], np.ndarray], Callable[[], float]]:
    """Compile the problem for heyoka.

    Return a function that runs the problem and returns its final state, and one for the seconds of the last run.
    """
    heyoka = needed("heyoka", '"eip_scipy[heyoka]"')
    assert problem.params is not None
    x, y, u, v = heyoka.make_vars("x", "y", "u", "v")
    square = x * x + y * y
    pull = square**-1.5 * (1.0 + 1.5 * float(problem.params[0]) / square)
    equations = [(x, u), (y, v), (u, -pull * x), (v, -pull * y)]
    integrator = heyoka.taylor_adaptive(equations, list(problem.y0), tol=tolerance)
    last = [0.0]

    def run() -> np.ndarray:
        integrator.time = 0.0
        integrator.state[:] = problem.y0
        begin = perf_counter()
        integrator.propagate_until(END)
        last[0] = perf_counter() - begin
        return integrator.state.copy()

    return run, lambda: last[0]


def in_rotations(problem: Problem, truth: np.ndarray, methods: Callable[[Problem, int], Methods], turns: int) -> Table:
    """Run all methods `turns` times, first in the original axes and then in new random ones each time.

    ``methods(problem, turn)`` returns the methods for the problem in the axes of the turn with the index `turn`, which
    is 0 for the original axes. `truth` is the reference state at the end, in the original axes. Return what
    `orbits.rows` makes of the runs.
    """
    found = []
    for turn, rotation in enumerate([Rotation.identity(), *Rotation.random(turns - 1, np.random.default_rng(1))]):
        own = replace(problem, y0=rotation.apply(problem.y0.reshape(-1, 3)).ravel()) if turn else problem
        there = rotation.apply(truth.reshape(-1, 3)).ravel()
        found.append(timed(methods(own, turn), there, repeats=1))
    return rows(found)


def compared(found: Table, mercury: float, others: float) -> list[str]:
    """Return a line of text for each method of this package: the time of its cheapest run that is accurate enough.

    The largest error [AU] must be at most `mercury` for Mercury and `others` for other planets. The time is compared
    with the time in which WHFast reaches the error `mercury`, and with the time of IAS15.
    """
    whfast = [row for name, row in found.items() if name.startswith("WHFast")]
    there = cost_to_reach([row["least"] for row in whfast], [row["worst"] for row in whfast], mercury)
    good = {name: row for name, row in found.items() if row["worst"] <= mercury and row["others"] <= others}
    times = {kind: least(good, kind, "least") for kind in OURS}
    return [
        f"Mercury {mercury:g}, others {others:g}: {kind} takes {own:.4g} s, {own / there:.2f} of WHFast's time for "
        f"Mercury, {found['IAS15']['least'] / own:.1f} times less than IAS15"
        for kind, own in times.items()
    ]


def least(found: Table, kind: str, part: str) -> float:
    """Return the least value in the column `part` of the rows whose names begin with `kind`; nan if there is none."""
    return min((row[part] for name, row in found.items() if name.startswith(kind)), default=math.nan)
