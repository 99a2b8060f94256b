"""``eip-scipy study solar-cloud``: an ensemble of solar systems with perturbed starts, compared with REBOUND.

`ensemble` runs EIPRKN12 and EIPGJ14 on one core, every member with its own H and L. It is compared with `integrate`,
which makes the same runs one at a time, and with WHFast (corrector 17) and IAS15 from REBOUND. Runs one at a time use a
sample of the members, because each costs the same. The errors are the largest in the sample, of Mercury's position [AU]
at the end, relative to IAS15, which is accurate to 1e-11. The times are the least processor times of five runs.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from eip_scipy import EIPGJ14, EIPRKN12, ensemble, integrate
from eip_scipy.problems import Problem, solar_system
from eip_scipy.problems.gravity.solar_data import YEAR_D

from ..report import needed, table
from ..study import Measurement, Session, option
from ..timing import clocked, least
from .orbits import Row

REPEATS = 5
# Steps per year of each method, and its options.
METHODS: dict[str, tuple[tuple[int, ...], dict[str, Any]]] = {
    "EIPRKN12": ((36, 38, 44), {"method": EIPRKN12, "every": 10}),
    "EIPGJ14": ((236, 255, 300, 405, 460), {"method": EIPGJ14}),
}
DAYS = (2, 3, 4, 5)
SPREAD = 1e-6  # of each coordinate, relative


def clones(problem: Problem, members: int) -> np.ndarray:
    """Return perturbed starts (members, 6 N), each in its barycentric frame, which REBOUND's integrators use."""
    assert problem.params is not None
    factors = 1 + SPREAD * np.random.default_rng(1).standard_normal((members, problem.y0.size))
    states = (problem.y0 * factors).reshape(members, 2, -1, 3)
    shares = problem.params / problem.params.sum()
    return (states - np.einsum("j,mkjc->mkc", shares, states)[:, :, None]).reshape(members, -1)


@dataclass(frozen=True, kw_only=True)
class SolarCloud(Measurement[dict[str, Row]]):
    """Command ``eip-scipy study solar-cloud``."""

    members: int = option(1000, "members of the ensemble (default: %(default)s)", type=int)
    years: float = option(100.0, "length of the runs in Julian years (default: %(default)s)", type=float)
    sample: int = option(16, "number of members that are also run one at a time (default: %(default)s)", type=int)

    def measure(self, session: Session) -> dict[str, Row]:
        needed("eip_scipy.integrations.rebound")
        problem = solar_system(years=self.years)
        starts = clones(problem, self.members)
        ensemble(problem, (0, 0.1), starts[:16], method=EIPRKN12, h=0.02, executor=1)  # loads and compiles
        runs = self._runs(problem, starts)
        states: dict[str, np.ndarray] = {}

        def run(name: str) -> None:
            states[name] = runs[name][1]()[: self.sample]

        clocks = {name: clocked(partial(run, name), time.process_time) for name in runs}
        seconds = least(clocks, turns=REPEATS)
        truth = states["IAS15"]
        return {
            name: {
                "seconds": seconds[name] / count,
                "Mercury": float(np.linalg.norm((states[name] - truth)[:, 3:6], axis=1).max()),
            }
            for name, (count, _) in runs.items()
        }

    def _runs(self, problem: Problem, starts: np.ndarray) -> dict[str, tuple[int, Callable[[], np.ndarray]]]:
        """Return, for each row of the table, the number of members that it runs, and a function that runs them.

        The function returns the final states in rows.
        """
        few, span = starts[: self.sample], (0.0, self.years)
        found: dict[str, tuple[int, Callable[[], np.ndarray]]] = {}

        def together(options: dict[str, Any]) -> np.ndarray:
            return ensemble(problem, span, starts, executor=1, **options).y

        def alone(options: dict[str, Any]) -> np.ndarray:
            return np.array([integrate(problem, span, y, **options).y[:, -1] for y in few])

        def rebound(integrator: str, h: float) -> np.ndarray:
            rebound = needed("eip_scipy.integrations.rebound")
            n = 1 if np.isnan(h) else round(self.years / h)
            runs = (rebound.run(problem.params, y, integrator, h=self.years / n, n_steps=n) for y in few)
            return np.array([run.y[:, -1] for run in runs])

        for method, (steps, chosen) in METHODS.items():
            for n in steps:
                options = chosen | {"h": 1 / n}
                found[f"ensemble, {method}, 1/{n} yr"] = len(starts), partial(together, options)
                found[f"integrate, {method}, 1/{n} yr"] = len(few), partial(alone, options)
        for days in DAYS:
            found[f"WHFast c17, {days} d"] = len(few), partial(rebound, "whfast-c17", days / YEAR_D)
        return found | {"IAS15": (len(few), partial(rebound, "ias15", np.nan))}

    def table(self, found: dict[str, Row]) -> str:
        body = [(name, [f"{1 / row['seconds']:.1f}", f"{row['Mercury']:.1e}"]) for name, row in found.items()]
        title = f"{self.members} members, {self.years:g} years, one core"
        return f"{title}\n\n{table([['systems', 'per second'], ['Mercury', '[AU]']], body)}"
