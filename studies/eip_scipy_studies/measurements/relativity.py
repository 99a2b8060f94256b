"""``eip-scipy study relativity``: ten bodies with relativity, against WHFast, SABA and IAS15 with REBOUNDx.

The force is the potential in 1/r^2 of Nobili & Roxburgh, the same in both packages: `forces="gr-potential"` here,
`gr_potential` in REBOUNDx. Errors of position [AU] are those against heyoka in 80-bit arithmetic, which is run each
time; wall times are the least of three, on one core. The study needs REBOUND, REBOUNDx (GPL) and heyoka: ``pip install
rebound reboundx heyoka``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from eip_scipy import EIPGJ14, EIPRKN12
from eip_scipy.problems import Problem, solar_system
from eip_scipy.problems.gravity.solar_data import YEAR_D

from ..report import needed
from ..solar.cost import by_us, timed
from ..study import Measurement, Session, option
from .orbits import Methods, Row, by_rebound, daily, orbit_table, rows, yearly

REPEATS = 3
FLOAT = np.longdouble
speed_of_light = 299792.458 * 86400 * YEAR_D / 149597870.7  # AU/yr
MULTISTEP, NYSTROM = (260, 300, 360, 412, 500, 600), (32, 40, 48, 64, 80)  # steps a year
DAYS = {"whfast-c17": (5, 3, 2, 1, 0.5), "saba(10,6,4)": (10, 5, 3)}


def reference(gm: np.ndarray, y0: np.ndarray, years: float, c: float | None = speed_of_light) -> np.ndarray:
    """Return the positions (3 N,) of N bodies after `years`, by heyoka in 80 bits.

    `gm` (N,) are the masses times G, `y0` (6 N,) is the start, and `c` the speed of light; None leaves out relativity.
    """
    heyoka = needed("heyoka", '"eip_scipy[heyoka]"')
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


def potential(sim: Any) -> Any:
    """Add the relativistic force to a REBOUND simulation; the caller must keep the returned object alive."""
    extras = needed("reboundx", "reboundx").Extras(sim)
    force = extras.load_force("gr_potential")
    extras.add_force(force)
    force.params["c"] = speed_of_light
    return extras


def methods(problem: Problem) -> Methods:
    """Return the runs of each method with each of its steps, by name, in the form that `work_precision` takes."""
    found = yearly("EIPGJ14", by_us(problem, EIPGJ14), *MULTISTEP)
    found |= yearly("EIPRKN12", by_us(problem, EIPRKN12, every=10, compensated=True), *NYSTROM)
    for name, days in DAYS.items():
        found |= daily(name, by_rebound(problem, name, prepare=potential), *days)
    return found | {"ias15": (by_rebound(problem, "ias15", prepare=potential), [math.nan])}


@dataclass(frozen=True, kw_only=True)
class Relativity(Measurement[dict[str, Row]]):
    """Command ``eip-scipy study relativity``."""

    years: float = option(100.0, "length of the runs in Julian years (default: %(default)s)", type=float)

    def measure(self, session: Session) -> dict[str, Row]:
        needed("reboundx", "reboundx")
        problem = solar_system(years=self.years, forces="gr-potential")
        assert problem.params is not None
        truth = np.zeros_like(problem.y0)
        truth[:30] = reference(problem.params[:10], problem.y0, self.years)
        return rows([timed(methods(problem), truth, repeats=REPEATS)])

    def table(self, found: dict[str, Row]) -> str:
        title = f"Ten bodies, {self.years:g} years, potential in 1/r^2 on both sides"
        return f"{title}\n\n{orbit_table(found, 'Mercury')}"
