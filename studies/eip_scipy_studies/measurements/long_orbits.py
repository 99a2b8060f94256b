"""Ten bodies over 1000 years by EIPRKN12: what projection, its spacing and compensation bring; EIPGJ14 beside it.

    python -m eip_scipy_studies.measurements.long_orbits [--years 100|1000] [--json FILE]

DE440 system barycentres, Newtonian. Errors of position [AU] against the packaged reference states (Taylor, 80 bits);
wall times are the least of three, on one core. Where REBOUND is installed, IAS15, SABA(10,6,4) and WHFast with the
corrector of order 17 run the same span.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
from typing import Any

import numpy as np

from eip_scipy import EIPGJ14, EIPRKN12, EIPSolver, integrate
from eip_scipy.problems import Problem, solar_system

PLANETS = ("Mercury", "Venus", "EMB", "Mars", "Jupiter", "Saturn", "Uranus", "Neptune", "Pluto")
REPEATS = 3
STEPS = (1 / 128, 0.01, 1 / 64, 0.02)
MULTISTEP = (1 / 412, 1 / 500, 1 / 600)
WAYS: dict[str, dict[str, Any]] = {
    "no projection": {"invariants": ()},
    "no projection, compensated": {"invariants": (), "compensated": True},
    "every 10": {"every": 10},
    "every 10, compensated": {"every": 10, "compensated": True},
    "auto, compensated": {"every": "auto", "compensated": True},
}


def position_errors(problem: Problem, t: float, y: np.ndarray) -> list[float]:
    """Per planet, [AU]."""
    assert problem.reference is not None
    reference = problem.reference(t)
    if reference is None:
        raise SystemExit(f"there is no reference state at {t:g} yr")
    return [float(x) for x in np.linalg.norm((y - reference)[:30].reshape(10, 3), axis=1)[1:]]


def timed(problem: Problem, t: float, method: type[EIPSolver], h: float, options: dict[str, Any]) -> dict[str, Any]:
    """One way, timed."""
    runs = [integrate(problem, (0, t), method=method, h=h, **options) for _ in range(REPEATS)]
    wall = min(run.wall_time for run in runs)
    return {"wall": wall, "errors": position_errors(problem, t, runs[0].y[:, -1])}


def peers(problem: Problem, t: float) -> dict[str, dict[str, Any]]:
    """REBOUND's integrators, where there is one."""
    try:
        from eip_scipy.integrations import rebound
    except ImportError as error:
        print(f"no comparison with WHFast, SABA and IAS15: {error}", file=sys.stderr)
        return {}
    found = {}
    for label, name, steps in (
        ("IAS15", "ias15", 1),
        ("SABA(10,6,4), 5 d", "saba(10,6,4)", round(t * 365.25 / 5)),
        ("WHFast, corrector, 5 d", "whfast-c17", round(t * 365.25 / 5)),
        ("WHFast, corrector, 1 d", "whfast-c17", round(t * 365.25)),
    ):
        runs = [rebound.run(problem.params, problem.y0, name, h=t / steps, n_steps=steps) for _ in range(REPEATS)]
        wall = min(run.wall_time for run in runs)
        found[label] = {"wall": wall, "errors": position_errors(problem, t, runs[0].y[:, -1])}
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--years", type=float, default=1000.0)
    parser.add_argument("--json", metavar="FILE")
    args = parser.parse_args()
    problem = solar_system(years=args.years)
    rows = {
        f"h = {h:.5g} yr, {name}": timed(problem, args.years, EIPRKN12, h, options)
        for h in STEPS
        for name, options in WAYS.items()
    }
    rows |= {f"EIPGJ14, h = {h:.5g} yr": timed(problem, args.years, EIPGJ14, h, {}) for h in MULTISTEP}
    rows |= peers(problem, args.years)
    print(f"{platform.machine()}, Python {platform.python_version()}; {args.years:g} years, errors of position [AU]\n")
    print(f"{'':45}{'wall [s]':>9}" + "".join(f"{name:>9}" for name in PLANETS))
    for name, row in rows.items():
        print(f"{name:45}{row['wall']:9.3f}" + "".join(f"{x:9.1e}" for x in row["errors"]))
    if args.json:
        with open(args.json, "w") as file:
            json.dump({"years": args.years, "machine": platform.machine(), "rows": rows}, file, indent=1)


if __name__ == "__main__":
    main()
