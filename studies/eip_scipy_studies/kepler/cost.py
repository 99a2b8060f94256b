"""``eip-scipy work-precision``: error against cost of all methods on the perturbed Kepler problem."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from eip_scipy import EIPDOP853, EIPRK2, EIPRK3, EIPRK4, EIPRK5, EIPRK23, EIPRK45, integrate
from eip_scipy.problems import Problem, kepler
from eip_scipy.solvers import EIPSolver

from ..long_runs import named
from ..report import compact, table
from ..study import Figures, Rows, Session, Study
from ..work_precision import Curve, Runner, cost_to_reach, costs_at, curves, work_precision

FIXED: dict[type[EIPSolver], tuple[int, ...]] = {
    # Numbers of steps in the whole run.
    EIPRK2: (10_000, 30_000, 100_000, 300_000, 1_000_000),
    EIPRK3: (4_000, 10_000, 30_000, 100_000, 300_000),
    EIPRK4: (2_000, 4_000, 10_000, 30_000, 100_000),
    EIPRK5: (2_000, 4_000, 10_000, 20_000, 40_000),
}
PAIRS: dict[type[EIPSolver], tuple[float, ...]] = {
    # Relative tolerances; atol is 0.001 of them.
    EIPRK23: (1e-4, 1e-5, 1e-6, 1e-7, 1e-8),
    EIPRK45: (1e-4, 1e-6, 1e-8, 1e-10, 1e-11),
    EIPDOP853: (1e-4, 1e-6, 1e-8, 1e-10, 1e-12),
}
LEVELS = (1e-2, 1e-4, 1e-6, 1e-8)


class KeplerPoint(NamedTuple):
    """Result of a method at one `setting`, a step or a relative tolerance.

    It has the number of evaluations of f, the least time in seconds, and the final error of the position.
    """

    method: str
    setting: float
    nfev: int
    wall_time: float
    error: float


class Found(NamedTuple):
    """The results of all runs, and the description of the machine."""

    points: list[KeplerPoint]
    machine: str


@dataclass(frozen=True, kw_only=True)
class KeplerCost(Study[Found]):
    """Command ``eip-scipy work-precision``.

    Each method is timed `repeats` times at each of its steps or tolerances; the least time counts.
    """

    t_end: float = 200.0
    repeats: int = 5
    reference_steps: int = 40_000
    fixed: Mapping[type[EIPSolver], Sequence[int]] = field(default_factory=lambda: FIXED)
    pairs: Mapping[type[EIPSolver], Sequence[float]] = field(default_factory=lambda: PAIRS)

    def measure(self, session: Session) -> Found:
        problem = kepler(t_end=self.t_end)
        adaptive = replace(problem, h=None)
        truth = integrate(problem, method=EIPDOP853, h=self.t_end / self.reference_steps, compensated=True).y[:2, -1]
        nfev: dict[tuple[str, float], int] = {}
        methods: dict[str, tuple[Runner, Sequence[float]]] = {}
        for method, counts in self.fixed.items():
            methods[method.__name__] = (partial(_fixed, problem, method, nfev), [self.t_end / n for n in counts])
        for method, tolerances in self.pairs.items():
            methods[method.__name__] = (partial(_adaptive, adaptive, method, nfev), tolerances)
        total = self.repeats * sum(len(settings) for _, settings in methods.values())
        with session.bar(total, "error against cost") as bar:
            result = work_precision(
                methods, lambda y: float(np.hypot(*(y[:2] - truth))), repeats=self.repeats, callback=bar.update
            )
        points = [KeplerPoint(p.method, p.step, nfev[p.method, p.step], p.wall_time, p.error) for p in result.points]
        return Found(points, result.machine)

    def text(self, found: Found) -> str:
        title = f"Work and precision: perturbed Kepler problem, e = 0.6, H and L kept, t = {self.t_end:g}"
        parts = [title, found.machine]
        for cost, unit, factor in (("nfev", "1000 evaluations of f", 1e-3), ("wall_time", "milliseconds", 1e3)):
            known = curves(found.points, cost)
            fixed = {method.__name__: known[method.__name__] for method in self.fixed}
            body = [(name, costs_at(curve, LEVELS, factor)) for name, curve in known.items()]
            body.append(("cheapest with fixed step", [_cheapest(fixed, level) for level in LEVELS]))
            body.append(("cheapest of all", [_cheapest(known, level) for level in LEVELS]))
            head = [["error", compact(level, 1)] for level in LEVELS]
            parts += ["", f"{unit.capitalize()} for an error of the final position:", table(head, body)]
        parts += ["", '"<": the cheapest run is more accurate; "-": no run is as accurate.']
        return "\n".join(parts)

    def tables(self, found: Found) -> dict[str, Rows]:
        return {"work-precision.csv": self._rows(found)}

    def numbers(self, found: Found) -> dict[str, Any]:
        return {"points": self._rows(found)}

    def _rows(self, found: Found) -> Rows:
        fixed = {method.__name__ for method in self.fixed}
        return [
            {
                "method": p.method,
                "h": p.setting if p.method in fixed else None,
                "rtol": None if p.method in fixed else p.setting,
                "nfev": p.nfev,
                "wall_time_s": p.wall_time,
                "position_error": p.error,
            }
            for p in found.points
        ]

    def figures(self, found: Found) -> Figures:
        from ..plotting import CostPanel, cost_figure

        costs = {"nfev": "evaluations of f", "wall_time": "wall time [s]"}
        yield (
            "work-precision.png",
            cost_figure(
                [[CostPanel("", label, curves(found.points, cost)) for cost, label in costs.items()]],
                error=f"error of position at t = {self.t_end:g}",
                title="Perturbed Kepler problem, e = 0.6, H and L kept: error against cost",
                footnote=f"{found.machine}; one thread, least of {self.repeats}",
            ),
        )


def _fixed(problem: Problem, method: type[EIPSolver], nfev: dict[Any, int], step: float) -> tuple[float, np.ndarray]:
    name = f"{method.__name__}, h = {step:.3g}"
    return _noted(integrate(problem, method=named(method, name), h=step), method, nfev, step)


def _adaptive(problem: Problem, method: type[EIPSolver], nfev: dict[Any, int], rtol: float) -> tuple[float, np.ndarray]:
    name = f"{method.__name__}, rtol = {rtol:.0e}"
    return _noted(integrate(problem, method=named(method, name), rtol=rtol, atol=1e-3 * rtol), method, nfev, rtol)


def _noted(result: Any, method: type[EIPSolver], nfev: dict[Any, int], step: float) -> tuple[float, np.ndarray]:
    nfev[method.__name__, step] = result.nfev
    return result.wall_time, result.y[:, -1] if result.success else np.full(4, np.nan)


def _cheapest(known: Mapping[str, Curve], level: float) -> str:
    costs = {name: cost_to_reach(*curve, level) for name, curve in known.items()}
    finite = {name: cost for name, cost in costs.items() if math.isfinite(cost)}
    return min(finite, key=finite.__getitem__) if finite else "-"
