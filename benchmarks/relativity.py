"""Ten bodies with relativity: EIPRKN12 beside WHFast, SABA and IAS15 with REBOUNDx.

    python benchmarks/relativity.py [--years 100] [--json FILE]

The force is the potential in 1/r^2 of Nobili & Roxburgh, the same in both packages: `forces="gr-potential"` here,
`gr_potential` there. Errors of position [AU] against heyoka in 80-bit arithmetic, run anew each time; wall times are
the least of three, one core. REBOUNDx (GPL) and heyoka are no dependencies: ``pip install reboundx heyoka``.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from typing import Any

import heyoka
import numpy as np
import rebound
import reboundx

from eip_scipy import EIPRKN12, integrate
from eip_scipy.app.report import describe_machine
from eip_scipy.integrations import rebound as peers
from eip_scipy.problems import Problem, solar_system
from eip_scipy.problems.gravity.solar_data import YEAR_D

REPEATS = 3
FLOAT = np.longdouble
C = 299792.458 * 86400 * YEAR_D / 149597870.7  # AU/yr
STEPS = (1 / 32, 1 / 40, 1 / 48, 1 / 64, 1 / 80)
DAYS = {"whfast": (5, 2, 1), "whfast-c17": (5, 3, 2, 1, 0.5), "saba(10,6,4)": (10, 5, 3)}


def reference(gm: np.ndarray, y0: np.ndarray, years: float) -> np.ndarray:
    """The positions (30,) at the end, by heyoka in 80 bits."""
    n = gm.size
    equations = list(heyoka.model.nbody(n, masses=list(gm.astype(FLOAT)), Gconst=FLOAT(1)))
    places = [heyoka.make_vars(f"x_{i}", f"y_{i}", f"z_{i}") for i in range(n)]
    strength = FLOAT(6) * FLOAT(gm[0]) ** 2 / FLOAT(C) ** 2
    for i in range(1, n):
        d = [a - b for a, b in zip(places[i], places[0], strict=True)]
        r2 = heyoka.sum([x * x for x in d])
        for axis in range(3):
            pull = strength * d[axis] / (r2 * r2)
            for body, share in ((i, FLOAT(-1)), (0, FLOAT(gm[i]) / FLOAT(gm[0]))):
                k = 6 * body + 3 + axis
                equations[k] = (equations[k][0], equations[k][1] + share * pull)
    by_body = y0.reshape(2, n, 3).swapaxes(0, 1).ravel().astype(FLOAT)
    integrator = heyoka.taylor_adaptive(
        equations, by_body, fp_type=FLOAT, tol=FLOAT(1e-22), high_accuracy=True, compact_mode=True
    )
    integrator.propagate_until(FLOAT(years))
    return integrator.state.reshape(n, 2, 3)[:, 0].astype(float).ravel()


def potential(sim: rebound.Simulation) -> reboundx.Extras:
    """Add the force; whoever calls keeps the result alive."""
    extras = reboundx.Extras(sim)
    force = extras.load_force("gr_potential")
    extras.add_force(force)
    force.params["c"] = C
    return extras


def least(run: Callable[[], Any]) -> Any:
    """The fastest of several runs."""
    return min((run() for _ in range(REPEATS)), key=lambda result: result.wall_time)


def runs(problem: Problem, years: float) -> dict[str, tuple[float, np.ndarray]]:
    """Wall time and final state of every method and step."""
    found = {}
    for h in STEPS:
        result = least(lambda h=h: integrate(problem, (0.0, years), method=EIPRKN12, h=h, every=10, compensated=True))
        found[f"EIPRKN12, {h * YEAR_D:.3g} d"] = (result.wall_time, result.y[:, -1])
    gm = problem.params[:10]
    for name, days in DAYS.items():
        for d in days:
            n = round(years * YEAR_D / d)
            result = least(
                lambda name=name, n=n: peers.run(gm, problem.y0, name, h=years / n, n_steps=n, prepare=potential)
            )
            found[f"{name}, {d} d"] = (result.wall_time, result.y[:, -1])
    result = least(lambda: peers.run(gm, problem.y0, "ias15", h=years, n_steps=1, prepare=potential))
    found["ias15"] = (result.wall_time, result.y[:, -1])
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--years", type=float, default=100.0)
    parser.add_argument("--json", metavar="FILE")
    args = parser.parse_args()
    problem = solar_system(years=args.years, forces="gr-potential")
    truth = reference(problem.params[:10], problem.y0, args.years)
    print(f"{describe_machine()}; {args.years:g} years; errors of position [AU]")
    print(f"{'':24}{'wall [s]':>10}{'Mercury':>10}{'others':>10}")
    rows = {}
    for name, (wall, y) in runs(problem, args.years).items():
        errors = np.linalg.norm((y[:30] - truth).reshape(10, 3), axis=1)[1:]
        rows[name] = {"wall": wall, "Mercury": errors[0], "others": errors[1:].max()}
        print(f"{name:24}{wall:10.4f}{errors[0]:10.1e}{errors[1:].max():10.1e}")
    if args.json:
        with open(args.json, "w") as file:
            json.dump({"machine": describe_machine(), "years": args.years, "rows": rows}, file, indent=1, default=float)


if __name__ == "__main__":
    main()
