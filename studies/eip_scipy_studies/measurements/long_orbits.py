"""``eip-scipy study long-orbits``: effect of projection, its spacing and compensation on EIPRKN12 over 1000 years.

Ten bodies, DE440 system barycentres, Newtonian. Errors of position [AU] against the packaged reference states (80
bits); wall times [s] are the least of three, on one core. EIPGJ14 and, if REBOUND is installed, IAS15, SABA(10,6,4) and
WHFast with the corrector of order 17 run the same span.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from eip_scipy import EIPGJ14, EIPRKN12
from eip_scipy.problems import solar_system
from eip_scipy.problems.gravity.solar_data import YEAR_D

from ..report import UsageError, table
from ..solar.cost import TimedRun, by_us, timed
from ..study import Measurement, Session, option
from .orbits import Methods, by_rebound

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
PEERS = (
    ("IAS15", "ias15", float("nan")),
    ("SABA(10,6,4), 5 d", "saba(10,6,4)", 5.0),
    ("WHFast, corrector, 5 d", "whfast-c17", 5.0),
    ("WHFast, corrector, 1 d", "whfast-c17", 1.0),
)


@dataclass(frozen=True, kw_only=True)
class LongOrbits(Measurement[list[TimedRun]]):
    """Command ``eip-scipy study long-orbits``."""

    years: float = option(1000.0, "length of the runs in Julian years (default: %(default)s)", type=float)

    def measure(self, session: Session) -> list[TimedRun]:
        problem = solar_system(years=self.years)
        assert problem.reference is not None
        truth = problem.reference(self.years)
        if truth is None:
            raise UsageError(
                f"there is no stored reference state at {self.years:g} years: --years must be 1, 2, 5, 10 ... 10000"
            )
        methods: Methods = {
            f"h = {h:.5g} yr, {name}": (by_us(problem, EIPRKN12, **options), [h])
            for h in STEPS
            for name, options in WAYS.items()
        }
        methods |= {f"EIPGJ14, h = {h:.5g} yr": (by_us(problem, EIPGJ14), [h]) for h in MULTISTEP}
        if session.peer("rebound", "WHFast, SABA and IAS15") is not None:
            methods |= {label: (by_rebound(problem, name), [d / YEAR_D]) for label, name, d in PEERS}
        with session.bar(REPEATS * len(methods), "long-orbits") as bar:
            return timed(methods, truth, repeats=REPEATS, enough_seconds=np.inf, callback=bar.update)

    def table(self, found: list[TimedRun]) -> str:
        body = [(run.method, [f"{run.wall_time:.3f}", *(f"{x:.1e}" for x in run.errors)]) for run in found]
        head = [["wall [s]"], *([name] for name in PLANETS)]
        return f"{self.years:g} years, errors of position [AU]\n\n{table(head, body)}"

    def numbers(self, found: list[TimedRun]) -> dict[str, Any]:
        return {"found": {run.method: {"wall": run.wall_time, "errors": run.errors} for run in found}}
