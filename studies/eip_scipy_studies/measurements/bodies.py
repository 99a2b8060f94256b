"""``eip-scipy study bodies``: cost against the number of bodies, EIPRKN12 and REBOUND's IAS15.

A star with N - 1 light planets (G m = 1e-9 of the star's) on nearly circular, nearly coplanar orbits of semi-major axes
from 1 to 30, random phases. EIPRKN12 takes 25 steps in the innermost period, every=10, compensated; IAS15 its own
steps. Wall times per innermost period, the least of three, one core; the relative error of the energy, and the largest
distance between the two final states as a measure of agreement.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from eip_scipy import EIPRKN12, integrate
from eip_scipy.problems import Problem, nbody

from ..report import needed, table
from ..study import Measurement, Session, option

__all__ = ["Bodies"]

REPEATS = 3
PERIOD = 2 * np.pi
STEPS = 25
Found = dict[int, dict[str, float]]


def system(bodies: int, periods: float) -> Problem:
    rng = np.random.default_rng(bodies)
    a = np.geomspace(1.0, 30.0, bodies - 1)
    phase, tilt = rng.uniform(0, 2 * np.pi, a.size), rng.normal(0, 0.01, a.size)
    flat = np.array([np.cos(phase), np.sin(phase) * np.cos(tilt), np.sin(phase) * np.sin(tilt)]).T
    along = np.array([-np.sin(phase), np.cos(phase) * np.cos(tilt), np.cos(phase) * np.sin(tilt)]).T
    gm = np.concatenate([[1.0], np.full(a.size, 1e-9)])
    q = np.concatenate([np.zeros((1, 3)), a[:, None] * flat])
    v = np.concatenate([np.zeros((1, 3)), along / np.sqrt(a)[:, None]])
    share = gm / gm.sum()
    return nbody(gm, q - share @ q, v - share @ v, t_span=(0.0, periods * PERIOD), h=PERIOD / STEPS)


@dataclass(frozen=True, kw_only=True)
class Bodies(Measurement[Found]):
    """The command."""

    periods: int = option(20, "length of the runs in innermost periods (%(default)s)", type=int, metavar="N")
    bodies: Sequence[int] = option((10, 30, 100, 300), "numbers of bodies", type=int, nargs="+", metavar="N")

    def measure(self, session: Session) -> Found:
        rebound = needed("eip_scipy.integrations.rebound")
        with session.bar(len(self.bodies), "bodies") as bar:
            return {n: self._compare(system(n, self.periods), rebound, bar) for n in self.bodies}

    def _compare(self, problem: Problem, rebound: Any, bar: Any) -> dict[str, float]:
        start = problem.y0
        own = [integrate(problem, method=EIPRKN12, every=10, compensated=True) for _ in range(REPEATS)]
        peers = [rebound.run(problem.params, start, "ias15", h=problem.t_span[1], n_steps=1) for _ in range(REPEATS)]
        seconds, theirs = (min(run.wall_time for run in runs) / self.periods for runs in (own, peers))
        end = own[0].y[:, -1]
        energy = [problem.invariants[0].fun(0.0, y, problem.params) for y in (start, end)]
        apart = (end - peers[0].y[:, -1])[: start.size // 2].reshape(-1, 3)
        bar.update()
        return {
            "EIPRKN12 [ms]": 1e3 * seconds,
            "IAS15 [ms]": 1e3 * theirs,
            "ratio": theirs / seconds,
            "dH/H": abs(energy[1] / energy[0] - 1),
            "IAS15 dE/E": peers[0].energy_error[-1],
            "distance": float(np.linalg.norm(apart, axis=1).max()),
        }

    def table(self, found: Found) -> str:
        forms = (".3f", ".3f", ".1f", ".1e", ".1e", ".1e")
        names = list(next(iter(found.values())))
        body = [(f"N = {n}", [f"{row[k]:{f}}" for k, f in zip(names, forms, strict=True)]) for n, row in found.items()]
        return "Milliseconds per innermost period\n\n" + table([[name] for name in names], body)
