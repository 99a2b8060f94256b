"""A cloud of solar systems, clones with perturbed starts: members in vectors beside REBOUND, member by member.

    python -m eip_scipy_studies.measurements.solar_cloud [--members 1000] [--years 100] [--sample 16] [--json FILE]

`ensemble` with EIPRKN12 and EIPGJ14 on one core, every member its own H and L, beside the same runs by `integrate` one
at a time, and WHFast with corrector 17 and IAS15 from REBOUND, of which a sample of members is run: each costs the
same. Errors of Mercury's position [AU] at the end against IAS15, itself good to 1e-11, the largest over the sample.
Least times of five, all in turns; processor time, which other load on the machine hardly touches.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable

import numpy as np

from eip_scipy import EIPGJ14, EIPRKN12, ensemble, integrate
from eip_scipy.problems import Problem, solar_system
from eip_scipy.problems.gravity.solar_data import YEAR_D

from ..report import describe_machine
from .installed import peer

rebound = peer("eip_scipy.integrations.rebound")

REPEATS = 5
# Of each method the steps a year, and its options.
METHODS = {
    "EIPRKN12": ((36, 38, 44), {"method": EIPRKN12, "every": 10}),
    "EIPGJ14": ((236, 255, 300, 405, 460), {"method": EIPGJ14}),
}
DAYS = (2, 3, 4, 5)
SPREAD = 1e-6  # of each coordinate, relative


def clones(problem: Problem, members: int) -> np.ndarray:
    """Perturbed starts, in the frame of each one's own barycentre: REBOUND's integrators need it, or go there."""
    factors = 1 + SPREAD * np.random.default_rng(1).standard_normal((members, problem.y0.size))
    states = (problem.y0 * factors).reshape(members, 2, -1, 3)
    shares = problem.params / problem.params.sum()
    return (states - np.einsum("j,mkjc->mkc", shares, states)[:, :, None]).reshape(members, -1)


def timed(run: Callable[[], np.ndarray]) -> tuple[float, np.ndarray]:
    """Processor seconds, and the final states (members, 60)."""
    begin = time.process_time()
    states = run()
    return time.process_time() - begin, states


def runs(problem: Problem, years: float, starts: np.ndarray, sample: int) -> dict[str, tuple[int, Callable]]:
    """Per row of the table: how many members it runs, and the run."""
    few = starts[:sample]
    found: dict[str, tuple[int, Callable]] = {}
    for method, (steps, chosen) in METHODS.items():
        for n in steps:
            options = chosen | {"h": 1 / n}
            found[f"ensemble, {method}, 1/{n} yr"] = (
                len(starts),
                lambda options=options: ensemble(problem, (0, years), starts, executor=1, **options).y,
            )
            found[f"integrate, {method}, 1/{n} yr"] = (
                sample,
                lambda options=options: np.array([integrate(problem, (0, years), y, **options).y[:, -1] for y in few]),
            )
    for days in DAYS:
        n = round(years * YEAR_D / days)
        found[f"WHFast c17, {days} d"] = (sample, lambda n=n: by_rebound(problem, few, "whfast-c17", years / n, n))
    found["IAS15"] = (sample, lambda: by_rebound(problem, few, "ias15", years, 1))
    return found


def by_rebound(problem: Problem, starts: np.ndarray, integrator: str, h: float, n: int) -> np.ndarray:
    return np.array([rebound.run(problem.params, y, integrator, h=h, n_steps=n).y[:, -1] for y in starts])


def mercury(states: np.ndarray, truth: np.ndarray) -> float:
    """Largest error over the members [AU]."""
    return float(np.linalg.norm((states - truth)[:, 3:6], axis=1).max())


def table(members: int, years: float, sample: int) -> dict[str, dict[str, float]]:
    """Print and return it."""
    problem = solar_system(years=years)
    starts = clones(problem, members)
    ensemble(problem, (0, 0.1), starts[:16], method=EIPRKN12, h=0.02, executor=1)  # loads what it needs
    rows = runs(problem, years, starts, sample)
    best: dict[str, tuple[float, np.ndarray]] = {}
    for _ in range(REPEATS):
        for name, (count, run) in rows.items():
            seconds, states = timed(run)
            if name not in best or seconds / count < best[name][0]:
                best[name] = (seconds / count, states[:sample])
    truth = best["IAS15"][1]
    found = {name: {"seconds": seconds, "Mercury": mercury(y, truth)} for name, (seconds, y) in best.items()}
    print(f"\n{members} members, {years:g} years, one core")
    print(f"{'':30}{'systems/s':>10}{'Mercury [AU]':>14}")
    for name, row in found.items():
        print(f"{name:30}{1 / row['seconds']:10.1f}{row['Mercury']:14.1e}")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--members", type=int, default=1000)
    parser.add_argument("--years", type=float, default=100.0)
    parser.add_argument("--sample", type=int, default=16)
    parser.add_argument("--json", metavar="FILE")
    args = parser.parse_args()
    print(describe_machine())
    found = table(args.members, args.years, args.sample)
    if args.json:
        with open(args.json, "w") as file:
            json.dump({"machine": describe_machine(), "years": args.years, "rows": found}, file, indent=1)


if __name__ == "__main__":
    main()
