"""``eip-scipy hard-scenes``: high eccentricities, chaos, close encounters; error against cost of several methods."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from ..report import compact, describe_machine, table
from ..study import Figures, Rows, Session, Study, some_of
from ..work_precision import cost_to_reach, curves
from .runs import ATOL_PER_RTOL, SCENES, HardScene, Point, Spread, measure, methods, scene

Results = dict[str, tuple[HardScene, list[Point]]]


class Found(NamedTuple):
    """Results (`Point`) of all methods by problem, and the description of the machine."""

    results: Results
    machine: str


def _cells(point: Point) -> list[str]:
    errors = (point.error, point.energy_error, point.momentum_error)
    return [_setting(point), str(point.nfev), compact(1e3 * point.wall_time, 3), *map(compact, errors)]


def _setting(point: Point) -> str:
    return f"{point.setting} {compact(point.value)}"


def _failures(failures: list[str]) -> list[str]:
    return ["Did not reach the end:", *(f"  {line}" for line in failures), ""] if failures else []


def _costs(results: Results) -> list[str]:
    """Lay out what each method costs, in evaluations and time, at the error level of each problem."""
    scenes = [of for of, _ in results.values()]
    names = list(dict.fromkeys(p.method for _, points in results.values() for p in points))
    lines = []
    for key, label, factor in (("nfev", "1000 evaluations", 1e-3), ("wall_time", "milliseconds", 1e3)):
        levels = [(of.level, curves(points, key)) for of, points in results.values()]
        costs = {name: [factor * cost_to_reach(*of[name], level) for level, of in levels] for name in names}
        body = [(name, [compact(cost) for cost in row]) for name, row in costs.items()]
        head = [[of.name, compact(of.level, 1)] for of in scenes]
        cheapest = []
        for k in range(len(scenes)):
            known = {name: row[k] for name, row in costs.items() if np.isfinite(row[k])}
            cheapest.append(min(known, key=known.__getitem__) if known else "none")
        least = [f"  least for {of.name}: {name}" for of, name in zip(scenes, cheapest, strict=True)]
        lines += [f"{label.capitalize()} for an error of", table(head, body), *least, ""]
    return [*lines, '"-": no run is as accurate.']


@dataclass(frozen=True, kw_only=True)
class HardScenes(Study[Found]):
    """Command ``eip-scipy hard-scenes``."""

    scene: Sequence[str] | None = some_of("scene", SCENES)
    spread: Spread = field(default_factory=Spread)

    def arguments(self) -> dict[str, Any]:
        return {"scenes": list(dict.fromkeys(self.scene or SCENES))}

    def measure(self, session: Session) -> Found:
        rebound = session.peer("rebound", "WHFast and IAS15")
        scenes = [scene(name) for name in self.arguments()["scenes"]]
        points = sum(len(method.settings) for of in scenes for method in methods(of, self.spread, rebound).values())
        with session.bar(self.spread.repeats * points, "hard problems") as bar:
            results = {of.name: (of, measure(of, self.spread, rebound, bar.update)) for of in scenes}
        return Found(results, describe_machine())

    def text(self, found: Found) -> str:
        lines = [
            "Hard problems: error against cost",
            f"{found.machine}; one thread, least of at most {self.spread.repeats} runs.",
            "error: largest distance of a body from its true position at the end, in the problem's unit.",
            "dH, dL: largest error along the run, relative (L absolute where it is zero).",
            "EIPDOP853, EIPRKN12: H and L kept. DOP853: the same compiled loop without them.",
            "IAS15: prs23 is REBOUND's own step criterion, global that of 2015; on Kepler it moves two bodies.",
            f"rtol: adaptive, atol = {ATOL_PER_RTOL:g} rtol. ds: fixed steps in fictitious time. "
            "h: fixed steps in time.",
        ]
        columns = [["setting"], ["evaluations"], ["time [ms]"], ["error"], ["dH"], ["dL"]]
        for of, points in found.results.values():
            lines += ["", f"{of.name}: {of.title}", table(columns, [(p.method, _cells(p)) for p in points])]
        every = [p for _, points in found.results.values() for p in points]
        failures = [f"{p.scene}, {p.method}, {_setting(p)}: {p.failure}" for p in every if p.failure]
        return "\n".join([*lines, "", *_failures(failures), *_costs(found.results)])

    def tables(self, found: Found) -> dict[str, Rows]:
        return {"hard-scenes.csv": _rows(found.results)}

    def numbers(self, found: Found) -> dict[str, Any]:
        return {"points": _rows(found.results)}

    def figures(self, found: Found) -> Figures:
        """Draw error against evaluations and time, two panels for each problem."""
        from ..plotting import CostPanel, cost_figure

        every = list(found.results.values())
        rows = [
            [CostPanel(of.title if key == "nfev" else "", label, curves(points, key)) for of, points in three]
            for three in (every[k : k + 3] for k in range(0, len(every), 3))
            for key, label in (("nfev", "evaluations of f"), ("wall_time", "wall time [s]"))
        ]
        yield (
            "hard-scenes.png",
            cost_figure(
                rows,
                error="error of position at the end",
                title="Hard problems: error against cost (errors above 1 left out)",
                footnote=f"{found.machine}; one thread, least of at most {self.spread.repeats}",
                largest=1.0,
                size=(4.0, 2.8),
                shared=False,
            ),
        )


def _rows(results: Results) -> Rows:
    """Make the lines of the CSV file."""
    return [
        {
            "scene": p.scene,
            "method": p.method,
            "setting": p.setting,
            "value": p.value,
            "nfev": p.nfev,
            "wall_time_s": p.wall_time,
            "position_error": p.error,
            "error_H": p.energy_error,
            "error_L": p.momentum_error,
            "failure": p.failure or None,
        }
        for _, points in results.values()
        for p in points
    ]
