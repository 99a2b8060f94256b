"""Ten bodies by EIPRKN12 in random rotations: scatter of the error, speed against IAS15, worth of the projection.

    python -m eip_scipy_studies.measurements.rotations [--rotations 5] [--seed 1] [--years 1000 100] [--json FILE]

DE440 system barycentres, Newtonian; errors of position [AU] against the packaged reference states, turned the same
way. Wall times are the least of three, one core.

1. 1000 years, h = 1/44 yr and h = 1/64 yr, every = 10, compensated: Mercury's error and the largest of the others', in
   each rotation, and the ratio of IAS15's wall time over the same span to the run's.
2. 100 years, h = .02 yr: projection at each 10th step against none: what it gains for Mercury, what it costs in time,
   and the worst that it does to a planet.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from eip_scipy import EIPRKN12, integrate
from eip_scipy.problems import Problem, solar_system

from ..report import describe_machine
from .installed import peer

rebound = peer("eip_scipy.integrations.rebound")

REPEATS = 3
STEPS = (1 / 44, 1 / 64)


def turned(y: np.ndarray, rotation: Rotation) -> np.ndarray:
    """All positions and velocities of a state, turned."""
    return rotation.apply(y.reshape(-1, 3)).ravel()


def timed(problem: Problem, years: float, truth: np.ndarray, **options: Any) -> tuple[float, np.ndarray]:
    """Least wall time, and the planets' errors."""
    runs = [integrate(problem, (0.0, years), method=EIPRKN12, **options) for _ in range(REPEATS)]
    distances = np.linalg.norm((runs[0].y[:, -1] - truth)[:30].reshape(10, 3), axis=1)
    return min(run.wall_time for run in runs), distances[1:]


def long_runs(problems: list[tuple[Problem, Rotation]], years: float) -> dict[str, Any]:
    """Scatter over the longer span, and the ratio to IAS15."""
    problem = problems[0][0]
    ias15 = min(rebound.run(problem.params, problem.y0, "ias15", h=years, n_steps=1).wall_time for _ in range(REPEATS))
    found: dict[str, Any] = {"IAS15 [s]": ias15}
    for h in STEPS:
        rows = []
        for turned_problem, rotation in problems:
            assert problem.reference is not None
            truth = turned(problem.reference(years), rotation)
            wall, errors = timed(turned_problem, years, truth, h=h, every=10, compensated=True)
            rows.append({"wall": wall, "Mercury": errors[0], "others": errors[1:].max(), "ratio": ias15 / wall})
        found[f"h = 1/{round(1 / h)} yr"] = rows
    return found


def short_runs(problems: list[tuple[Problem, Rotation]], years: float) -> list[dict[str, float]]:
    """What projection brings over the shorter span."""
    rows = []
    original = problems[0][0]
    assert original.reference is not None
    for problem, rotation in problems:
        truth = turned(original.reference(years), rotation)
        plain, raw = timed(problem, years, truth, h=0.02, invariants=())
        wall, kept = timed(problem, years, truth, h=0.02, every=10)
        harmed = kept > np.maximum(2 * raw, raw + 1e-11)
        rows.append(
            {
                "without": raw[0],
                "with": kept[0],
                "gain": raw[0] / kept[0],
                "time": wall / plain,
                "planets harmed": int(harmed.sum()),
                "worst excess": float((kept - raw).max()),
            }
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rotations", type=int, default=5)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--years", type=float, nargs=2, default=[1000.0, 100.0], metavar=("LONG", "SHORT"))
    parser.add_argument("--json", metavar="FILE")
    args = parser.parse_args()
    long, short = args.years
    problem = solar_system(years=long)
    rotations = [Rotation.identity(), *Rotation.random(args.rotations, np.random.default_rng(args.seed))]
    problems = [(replace(problem, y0=turned(problem.y0, r)) if k else problem, r) for k, r in enumerate(rotations)]
    print(describe_machine())
    far = long_runs(problems, long)
    print(f"\n{long:g} years; IAS15 takes {far['IAS15 [s]']:.2f} s")
    for name, rows in far.items():
        if isinstance(rows, list):
            for k, row in enumerate(rows):
                print(
                    f"{name}, rotation {k}: Mercury {row['Mercury']:.1e}, others <= {row['others']:.1e} AU, "
                    f"{row['wall']:.3f} s, IAS15 takes {row['ratio']:.1f} times as long"
                )
    near = short_runs(problems, short)
    print(f"\n{short:g} years, h = .02 yr")
    for k, row in enumerate(near):
        print(
            f"rotation {k}: Mercury {row['without']:.1e} -> {row['with']:.1e} AU ({row['gain']:.0f} times better), "
            f"time x {row['time']:.2f}, planets worse by 2x and 1e-11 AU: {row['planets harmed']} (largest excess "
            f"{row['worst excess']:.1e} AU)"
        )
    if args.json:
        with open(args.json, "w") as file:
            json.dump({"machine": describe_machine(), "long": far, "short": near}, file, indent=1, default=float)


if __name__ == "__main__":
    main()
