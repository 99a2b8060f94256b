"""One evaluation a step: EIPGJ14 and EIPGJ12 beside EIPRKN12, WHFast, IAS15 and heyoka, in five tables.

    python -m eip_scipy_studies.measurements.multistep [--parts 1 2 3 4 5] [--quick] [--json FILE]

1. Ten bodies, Newton, 1000 years: each run once in each of six rotations of the axes, in turns. Errors of position [AU]
   against the packaged reference state: Mercury's, the least and the largest over the rotations, and the largest of
   another planet. The ratios below it are of least times.
2. The same over 10 000 years (IAS15 once), against growth_reference.json; and 1000 years with the relativistic
   potential, WHFast by REBOUNDx (relativity.py).
3. Ensembles over 100 years: systems per second and core (solar_cloud.py).
4. Three systems of exoplanets (exoplanets.py).
5. Kepler's problem with e = .6 and the relativistic term to t = 600, beside heyoka, which is compiled before.

One core, and nothing beside it: ratios of times are what counts. REBOUND for all of it; for the second half of 2, for 4
and for 5 ``pip install reboundx heyoka``, which are no dependencies. `--quick`: a tenth of it or less, to see that it
runs.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable
from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from eip_scipy import EIPDOP853, EIPGJ12, EIPGJ14, EIPRKN12, integrate
from eip_scipy.problems import Problem, kepler, solar_system
from eip_scipy.problems.gravity.solar_data import YEAR_D

from ..report import describe_machine
from ..solar.cost import timed
from ..work_precision import cost_to_reach
from .installed import peer
from .runners import Methods, by_rebound, by_us, one_each, rows, show

ROTATIONS = 6
REPEATS = 200  # of runs of milliseconds
END, WANTED = 600.0, 1e-9
Table = dict[str, dict[str, float]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", type=int, nargs="+", choices=sorted(PARTS), default=sorted(PARTS))
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json", metavar="FILE")
    args = parser.parse_args()
    if not {2, 4, 5}.isdisjoint(args.parts):  # before the minutes that others take
        peer("heyoka", '"eip_scipy[heyoka]"')
        peer("reboundx", "reboundx")
    print(describe_machine())
    found = {str(part): PARTS[part](args.quick) for part in args.parts}
    if args.json:
        with open(args.json, "w") as file:
            json.dump({"machine": describe_machine(), "quick": args.quick, "parts": found}, file, indent=1)


def thousand_years(quick: bool) -> Table:
    years = 100.0 if quick else 1000.0
    problem = solar_system(years=years)
    assert problem.reference is not None
    truth = problem.reference(years)
    assert truth is not None

    def methods(turned: Problem, turn: int) -> Methods:
        return {
            **yearly("EIPGJ14", by_us(turned, EIPGJ14), 260, 300, 350, 405, 440, 500, 600, 768),
            **yearly("EIPGJ12", by_us(turned, EIPGJ12), 592),
            **yearly("EIPRKN12", by_us(turned, EIPRKN12, every=10, compensated=True), 44, 64),
            **daily("WHFast c17", by_rebound(turned, "whfast-c17"), 5, 4, 3, 2, 1.4, 1),
            "IAS15": (by_rebound(turned, "ias15"), [math.nan]),
        }

    found = in_rotations(problem, truth, methods, 2 if quick else ROTATIONS)
    print(f"\n1. Ten bodies, {years:g} years")
    show(found, "Mercury")
    compare(found, 2e-9, 1e-10)
    compare(found, 1e-7, math.inf)
    return found


def ten_thousand_years(quick: bool) -> dict[str, Table]:
    from . import growth, relativity

    years = 1000.0 if quick else 10_000.0
    truth = growth.reference(years)[years]

    def methods(turned: Problem, turn: int) -> Methods:
        found = {
            **yearly("EIPGJ14", by_us(turned, EIPGJ14), 412, 500, 600, 768),
            **yearly("EIPRKN12", by_us(turned, EIPRKN12, every=10, compensated=True), 64, 80, 100),
            **daily("WHFast c17", by_rebound(turned, "whfast-c17"), 3, 2, 1),
        }
        return found if turn else found | {"IAS15": (by_rebound(turned, "ias15"), [math.nan])}

    found = in_rotations(solar_system(years=years), truth, methods, 1 if quick else ROTATIONS)
    print(f"\n2. Ten bodies, {years:g} years")
    show(found, "Mercury")
    return {"Newton": found, "gr-potential": relativity.table(10.0 if quick else 1000.0)}


def ensembles(quick: bool) -> Table:
    from . import solar_cloud

    print("\n3. Ensembles")
    return solar_cloud.table(*((32, 10.0, 2) if quick else (1000, 100.0, 16)))


def three_systems(quick: bool) -> dict[str, Table]:
    from . import exoplanets

    print("\n4. Exoplanets")
    return exoplanets.tables(0.02 if quick else 1.0)


def against_heyoka(quick: bool) -> Table:
    """Least times of a whole call in milliseconds, and of the steps alone; largest errors of a component."""
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
    print(f"\n5. Kepler, e = .6, relativistic term, t = {END:g}: steps in 2 pi, or tolerances")
    print(f"{'':26}{'call [ms]':>11}{'steps [ms]':>11}{'error':>10}")
    for name, row in found.items():
        print(f"{name:26}{row['call']:11.3f}{row['steps']:11.3f}{row['error']:10.1e}")
    enough = {name: row for name, row in found.items() if row["error"] <= WANTED}
    for kind in ("EIPGJ14", "EIPGJ12", "EIPRKN12"):
        times = [least(enough, kind, part) / least(enough, "heyoka", "call") for part in ("call", "steps")]
        print(f"error {WANTED:g}: {kind} takes {times[0]:.2f} of heyoka's time, its steps alone {times[1]:.2f}")
    return found


def own(problem: Problem, **options: Any) -> tuple[Callable[[], np.ndarray], Callable[[], float]]:
    """A run, and the seconds that its steps took."""
    last = [0.0]

    def run() -> np.ndarray:
        result = integrate(problem, **options)
        last[0] = result.wall_time
        return result.y[:, -1]

    return run, lambda: last[0]


def taylor(problem: Problem, tolerance: float) -> tuple[Callable[[], np.ndarray], Callable[[], float]]:
    """The same by heyoka, made and compiled before."""
    import heyoka

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


def yearly(name: str, run: Any, *counts: int) -> Methods:
    """Steps by how many there are in a year."""
    return one_each(lambda h: f"{name}, 1/{round(1 / h)} yr", run, [1 / n for n in counts])


def daily(name: str, run: Any, *days: float) -> Methods:
    """Steps in days."""
    return one_each(lambda h: f"{name}, {h * YEAR_D:.3g} d", run, [d / YEAR_D for d in days])


def in_rotations(problem: Problem, truth: np.ndarray, methods: Callable[[Problem, int], Methods], turns: int) -> Table:
    """All methods in turn, in axes turned anew each time."""
    found = []
    for turn, rotation in enumerate([Rotation.identity(), *Rotation.random(turns - 1, np.random.default_rng(1))]):
        own = replace(problem, y0=rotation.apply(problem.y0.reshape(-1, 3)).ravel()) if turn else problem
        there = rotation.apply(truth.reshape(-1, 3)).ravel()
        found.append(timed(methods(own, turn), there, repeats=1))
    return rows(found)


def compare(found: Table, mercury: float, others: float) -> None:
    """What the cheapest run that is as good takes, beside WHFast's time for Mercury and IAS15's."""
    whfast = [row for name, row in found.items() if name.startswith("WHFast")]
    there = cost_to_reach([row["least"] for row in whfast], [row["worst"] for row in whfast], mercury)
    good = {name: row for name, row in found.items() if row["worst"] <= mercury and row["others"] <= others}
    for kind in ("EIPGJ14", "EIPGJ12", "EIPRKN12"):
        own = least(good, kind, "least")
        print(
            f"Mercury {mercury:g}, others {others:g}: {kind} takes {own:.4g} s, {own / there:.2f} of WHFast's time for "
            f"Mercury, {found['IAS15']['least'] / own:.1f} times less than IAS15"
        )


def least(found: Table, kind: str, part: str) -> float:
    """The least time of a method; nan without a run of it."""
    return min((row[part] for name, row in found.items() if name.startswith(kind)), default=math.nan)


PARTS = {1: thousand_years, 2: ten_thousand_years, 3: ensembles, 4: three_systems, 5: against_heyoka}


if __name__ == "__main__":
    main()
