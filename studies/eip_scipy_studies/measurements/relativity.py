"""Ten bodies with relativity: EIPGJ14 and EIPRKN12 beside WHFast, SABA and IAS15 with REBOUNDx.

    python -m eip_scipy_studies.measurements.relativity [--years 100] [--json FILE]

The force is the potential in 1/r^2 of Nobili & Roxburgh, the same in both packages: `forces="gr-potential"` here,
`gr_potential` there. Errors of position [AU] against heyoka in 80-bit arithmetic, run anew each time; wall times are
the least of three, one core. REBOUNDx (GPL) and heyoka are no dependencies: ``pip install reboundx heyoka``.
"""

from __future__ import annotations

import argparse
import json
import math
from typing import Any

import numpy as np

from eip_scipy import EIPGJ14, EIPRKN12
from eip_scipy.problems import Problem, solar_system
from eip_scipy.problems.gravity.solar_data import YEAR_D

from ..report import describe_machine
from ..solar.cost import timed
from .installed import peer
from .runners import Methods, by_rebound, by_us, one_each, rows, show

heyoka = peer("heyoka", '"eip_scipy[heyoka]"')
rebound = peer("rebound", "rebound")
reboundx = peer("reboundx", "reboundx")

REPEATS = 3
FLOAT = np.longdouble
C = 299792.458 * 86400 * YEAR_D / 149597870.7  # AU/yr
MULTISTEP, NYSTROM = (260, 300, 360, 412, 500, 600), (32, 40, 48, 64, 80)  # steps a year
DAYS = {"whfast-c17": (5, 3, 2, 1, 0.5), "saba(10,6,4)": (10, 5, 3)}


def reference(gm: np.ndarray, y0: np.ndarray, years: float, c: float | None = C) -> np.ndarray:
    """The positions (3 N,) at the end, by heyoka in 80 bits; `c`: the speed of light, None for Newton alone."""
    n = gm.size
    equations = list(heyoka.model.nbody(n, masses=list(gm.astype(FLOAT)), Gconst=FLOAT(1)))
    places = [heyoka.make_vars(f"x_{i}", f"y_{i}", f"z_{i}") for i in range(n)]
    strength = None if c is None else FLOAT(6) * FLOAT(gm[0]) ** 2 / FLOAT(c) ** 2
    for i in () if strength is None else range(1, n):
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


def methods(problem: Problem) -> Methods:
    """A row for each method and step."""
    found = one_each(lambda h: f"EIPGJ14, 1/{round(1 / h)} yr", by_us(problem, EIPGJ14), [1 / n for n in MULTISTEP])
    nystrom = by_us(problem, EIPRKN12, every=10, compensated=True)
    found |= one_each(lambda h: f"EIPRKN12, 1/{round(1 / h)} yr", nystrom, [1 / n for n in NYSTROM])
    for name, days in DAYS.items():
        run = by_rebound(problem, name, potential)
        found |= one_each(lambda h, name=name: f"{name}, {h * YEAR_D:.3g} d", run, [d / YEAR_D for d in days])
    return found | {"ias15": (by_rebound(problem, "ias15", potential), [math.nan])}


def table(years: float) -> dict[str, Any]:
    """Print and return it."""
    problem = solar_system(years=years, forces="gr-potential")
    truth = np.zeros_like(problem.y0)
    truth[:30] = reference(problem.params[:10], problem.y0, years)
    found = rows([timed(methods(problem), truth, repeats=REPEATS)])
    print(f"\nTen bodies, {years:g} years, potential in 1/r^2 on both sides")
    show(found, "Mercury")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--years", type=float, default=100.0)
    parser.add_argument("--json", metavar="FILE")
    args = parser.parse_args()
    print(describe_machine())
    found = table(args.years)
    if args.json:
        with open(args.json, "w") as file:
            json.dump({"machine": describe_machine(), "years": args.years, "rows": found}, file, indent=1)


if __name__ == "__main__":
    main()
