"""``eip-scipy study far``: ten bodies over 100 000 years, longer than any reference, by methods of several kinds.

The numbers are the distances of the runs from the finest one, which has twice the number of steps. The evidence for its
accuracy is that two methods that share only the balances reach the same positions. Up to 10 000 years its error is
known from the packaged reference.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from eip_scipy import EIPDOP853, EIPGJ14, integrate
from eip_scipy.problems import solar_system
from eip_scipy.problems.gravity.solar_data import reference_states

from ..report import needed, table
from ..solar.runs import orbits_kept
from ..study import Measurement, Session, option
from .growth import distances
from .orbits import rebound_states

FINEST = "EIPGJ14, balances, 1/1024 yr"
MERCURY, OTHERS = 1, slice(2, None)
DECADES = (100.0, 1000.0, 10_000.0, 100_000.0)


def ways() -> dict[str, dict[str, Any]]:
    """Return the options of `integrate` for each run of this package, by the name of the run."""
    return {
        FINEST: {"method": EIPGJ14, "h": 1 / 1024, **orbits_kept()},
        "EIPGJ14, balances, 1/512 yr": {"method": EIPGJ14, "h": 1 / 512, **orbits_kept()},
        "EIPDOP853, balances, 1/512 yr": {"method": EIPDOP853, "h": 1 / 512, "compensated": True, **orbits_kept()},
        "EIPGJ14, 1/600 yr": {"method": EIPGJ14, "h": 1 / 600},
    }


class Found(NamedTuple):
    """Results of all runs: `times` (m,) in years, and `seconds`, the wall times of the runs by their names.

    `apart` are the distances [AU] (m, 10) of the bodies from their places in the finest run, for each other run.
    `known` are the distances [AU] (10,) of the finest run from the packaged reference, by time, for those of
    `times` that the reference has.
    """

    times: np.ndarray
    seconds: dict[str, float]
    apart: dict[str, np.ndarray]
    known: dict[float, np.ndarray]


@dataclass(frozen=True, kw_only=True)
class Far(Measurement[Found]):
    """Command ``eip-scipy study far``."""

    years: float = option(100_000.0, "length of the runs in Julian years (default: %(default)s)", type=float)
    ias15: bool = option(False, "also run IAS15, which takes minutes")

    def measure(self, session: Session) -> Found:
        needed("eip_scipy.integrations.rebound")  # checked before runs that take minutes
        times = np.array([t for t in DECADES if t < self.years] + [self.years])
        problem, own = solar_system(years=self.years), ways()
        peers = {"WHFast (c17), 1 d": "whfast-c17"} | ({"IAS15": "ias15"} if self.ias15 else {})
        seconds, states = dict[str, float](), dict[str, np.ndarray]()
        with session.bar(len(own) + len(peers), "far") as bar:
            for name, options in own.items():
                run = integrate(problem, (0.0, self.years), t_eval=times, **options)
                seconds[name], states[name] = run.wall_time, run.y
                bar.update()
            for name, integrator in peers.items():
                seconds[name], states[name] = rebound_states(problem, integrator, times)
                bar.update()
        references, finest = reference_states(), states.pop(FINEST)
        known = {
            float(t): distances(y[:, None], references[t][:, None])[0]
            for t, y in zip(times, finest.T, strict=True)
            if t in references
        }
        return Found(times, seconds, {name: distances(y, finest) for name, y in states.items()}, known)

    def table(self, found: Found) -> str:
        def cells(rows: Any) -> list[str]:
            return [f"{value:.1e}" for row in rows for value in (row[MERCURY], row[OTHERS].max())]

        heads = [["time [s]"], *(head for t in found.times for head in ([f"{t:g} yr", "Mercury"], ["", "others"]))]
        none = np.full(10, np.nan)
        body = [
            (f"{FINEST}: off", [f"{found.seconds[FINEST]:.0f}", *cells(found.known.get(t, none) for t in found.times)])
        ]
        body += [(name, [f"{found.seconds[name]:.0f}", *cells(rows)]) for name, rows in found.apart.items()]
        return f"Distances [AU] from {FINEST}, and its own from the reference in the first row\n\n{table(heads, body)}"

    def numbers(self, found: Found) -> dict[str, Any]:
        return {"seconds": found.seconds, "times": found.times.tolist()}
