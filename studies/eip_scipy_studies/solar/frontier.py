"""``eip-scipy solar-system frontier``: error against cost of long runs at high accuracy, with other packages."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from eip_scipy import EIPDOP853, EIPGJ12, EIPGJ14, EIPRK4, EIPRKN8, EIPRKN12
from eip_scipy.problems import Problem, solar_system
from eip_scipy.problems.gravity.solar_data import YEAR_D, load, reference_states

from ..long_runs import positive
from ..report import UsageError, compact, describe_machine, table
from ..study import Figures, Rows, Session, Study, option
from ..work_precision import Runner, costs_at, curves, known_end
from .cost import MERCURY, TimedRun, by_peer, by_us, by_verlet, panels, timed
from .runs import KEPT, Peer, orbits_kept, whole_number

PATIENCE = 30.0  # longer runs, in seconds, are not repeated
LEVELS = (1e-6, 1e-7, 1e-8, 1e-9, 1e-10)


def methods(problem: Problem, years: float, peer: Peer | None, heyoka: Peer | None) -> dict[str, Any]:
    """Return the methods to time on the ten bodies in AU and years, with steps in years or tolerances.

    `peer` and `heyoka` are the functions ``run`` for REBOUND and for heyoka, if these packages are installed. The
    result is as for `work_precision`.
    """

    def own(method: Any, *steps: float, **options: Any) -> tuple[Runner, Sequence[float]]:
        return by_us(problem, method, **options), _dividing(years, steps)

    steps = (1 / 24, 1 / 32, 1 / 40, 1 / 48, 1 / 64, 1 / 80, 1 / 100)
    found = {
        "EIPRKN12": own(EIPRKN12, *steps, **KEPT),
        "RKN12, no projection": own(EIPRKN12, *steps, compensated=True, invariants=()),
        "EIPGJ14": own(EIPGJ14, 1 / 255, 1 / 275, 1 / 300, 1 / 350, 1 / 412, 1 / 500, 1 / 600, 1 / 768),
        "EIPGJ14, balances": own(EIPGJ14, 1 / 350, 1 / 412, 1 / 512, 1 / 640, **orbits_kept()),
        "EIPGJ12": own(EIPGJ12, 1 / 500, 1 / 550, 1 / 592, 1 / 700, 1 / 850),
        "EIPRKN8": own(EIPRKN8, 1 / 80, 1 / 100, 1 / 160, 1 / 240, **KEPT),
        "EIPDOP853": own(EIPDOP853, 1 / 80, 1 / 120, 1 / 180, 1 / 240, **KEPT),
        "EIPRK4": own(EIPRK4, 1 / 500, 1 / 1000),
        "SV": (by_verlet(problem), _dividing(years, [1 / 500, 1 / 1000, 1 / 2000])),
    }
    if peer is not None:

        def by_rebound(name: str, *days: float) -> tuple[Runner, Sequence[float]]:
            return by_peer(problem, peer, name), _dividing(years, [d / YEAR_D for d in days])

        found |= {
            "WHFast (c17)": by_rebound("whfast-c17", 10, 5, 3, 2, 1.4, 1, 0.7305),
            "SABA(10,6,4)": by_rebound("saba(10,6,4)", 20, 15, 10, 7.5, 5, 3),
            "IAS15": (by_peer(problem, peer, "ias15"), [math.nan]),
        }
    if heyoka is not None:
        found["heyoka (double)"] = partial(_heyoka, heyoka, problem, years), [1e-9, 1e-11, 1e-13, 2.2e-16]
    return found


def _dividing(years: float, wanted: Sequence[float]) -> list[float]:
    """Return the wanted steps, shortened to divide the time span."""
    return [years / whole_number(years / h) for h in wanted]


def _heyoka(peer: Peer, problem: Problem, years: float, tolerance: float) -> tuple[float, np.ndarray]:
    result = peer(problem.params, problem.y0, t_end=years, tolerance=tolerance)
    return result.wall_time, result.y


def _setting(item: TimedRun) -> str:
    if math.isnan(item.step):
        return "own"
    return f"tol {item.step:.0e}" if item.method.startswith("heyoka") else f"{item.step * YEAR_D:.4g} d"


def _rows(runs: Sequence[TimedRun]) -> Rows:
    """Make the lines of the CSV file."""
    planets = load("de440").bodies[1:]
    return [
        {
            "method": item.method,
            "setting": _setting(item),
            "wall_time_s": item.wall_time,
            **{f"{name}_au": float(x) for name, x in zip(planets, item.errors, strict=True)},
        }
        for item in runs
    ]


class Found(NamedTuple):
    """The timed runs, and a description of the machine in one line."""

    runs: list[TimedRun]
    machine: str


@dataclass(frozen=True, kw_only=True)
class Frontier(Study[Found]):
    """Command ``eip-scipy solar-system frontier``."""

    years: float = option(1000.0, "length in Julian years: 1, 2, 5, 10 ... 10000 (default: %(default)g)", type=positive)
    repeats: int = 3

    def check_settings(self) -> None:
        """Raise a UsageError if no reference state is stored for the time `years`."""
        if self.years not in reference_states():
            known = ", ".join(f"{t:g}" for t in reference_states())
            raise UsageError(f"there is no stored reference state: --years must be one of {known}, got {self.years:g}")

    def measure(self, session: Session) -> Found:
        peers = session.peer("rebound", "WHFast and IAS15"), session.peer("heyoka", "heyoka")
        peer, heyoka = (None if found is None else found.run for found in peers)
        problem = solar_system(years=self.years)
        chosen = methods(problem, self.years, peer, heyoka)
        total = self.repeats * sum(len(steps) for _, steps in chosen.values())
        with session.bar(total, "frontier") as bar:
            runs = timed(chosen, known_end(problem), repeats=self.repeats, enough_seconds=PATIENCE, callback=bar.update)
        return Found(runs, describe_machine())

    def text(self, found: Found) -> str:
        others = np.delete(np.array(load("de440").bodies[1:]), MERCURY)
        body = []
        for item in found.runs:
            rest = np.delete(item.errors, MERCURY)
            worst = f"{compact(rest.max())} {others[rest.argmax()]}" if np.isfinite(rest).all() else compact(math.nan)
            cells = [_setting(item), f"{item.wall_time:.3g}", compact(item.errors[MERCURY]), worst]
            body.append((item.method, cells))
        what = "errors of position [AU] and wall time"
        costs = [(name, costs_at(curve, LEVELS)) for name, curve in curves(found.runs, error="mercury").items()]
        parts = [
            f"Ten bodies, Newton, {self.years:g} years: {what}, least of {self.repeats}, one core",
            found.machine,
            "",
            table([["step", ""], ["wall", "[s]"], ["Mercury", "[AU]"], ["worst of the", "others [AU]"]], body),
            "",
            "Seconds for an error of Mercury's position:",
            table([["error [AU]", compact(level, 1)] for level in LEVELS], costs),
            '"<": the cheapest run is more accurate; "-": no run is as accurate.',
        ]
        return "\n".join(parts)

    def tables(self, found: Found) -> dict[str, Rows]:
        return {"frontier.csv": _rows(found.runs)}

    def numbers(self, found: Found) -> dict[str, Any]:
        return {"runs": _rows(found.runs)}

    def figures(self, found: Found) -> Figures:
        """Yield a figure of position errors against wall time: of Mercury, and the largest of another planet."""
        from ..plotting import cost_figure

        yield (
            "frontier.png",
            cost_figure(
                panels(found.runs),
                error="error of position [AU]",
                title=f"Ten bodies, Newton, {self.years:g} years: error of position against cost",
                footnote=f"{found.machine}; one thread, least of {self.repeats}",
            ),
        )
