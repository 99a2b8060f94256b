"""``eip-scipy orders``: whether EIPRK2 to EIPRK5 have their orders, projected, on Kepler's problem."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ...core.solvers import EIPRK2, EIPRK3, EIPRK4, EIPRK5, EIPSolver
from ...problems import Problem, kepler
from ...run.integrate import integrate
from ..long_runs import positive
from ..report import compact, table
from ..study import Figures, Rows, Session, Study, option
from ..work_precision import WorkPoint, work_precision

__all__ = ["Orders"]

METHODS: tuple[type[EIPSolver], ...] = (EIPRK2, EIPRK3, EIPRK4, EIPRK5)
SLACK = 0.3


class Order(NamedTuple):
    """A method's order, as it should be and as the two shortest steps have it."""

    method: str
    known: int
    ours: float

    @property
    def passed(self) -> bool:
        """A projection does not lower the order; that it may raise it is no miss."""
        return self.ours > self.known - SLACK


@dataclass(frozen=True, kw_only=True)
class Orders(Study[list[WorkPoint]]):
    """The command."""

    t_end: float = option(3.0, "end of the runs (%(default)s)", type=positive, metavar="T")
    counts: Sequence[int] = (60, 120, 240, 480)

    def measure(self, session: Session) -> list[WorkPoint]:
        """The position's error at the end, at each step."""
        problem = kepler(0.2, relativistic=0.0, t_end=self.t_end)
        assert problem.reference is not None
        truth = problem.reference(self.t_end)
        assert truth is not None
        steps = [self.t_end / n for n in self.counts]
        methods = {method.__name__: (partial(_run, problem, method), steps) for method in METHODS}
        with session.bar(len(METHODS) * len(steps), "orders") as bar:
            found = work_precision(methods, lambda y: float(np.hypot(*(y - truth)[:2])), repeats=1, callback=bar.update)
        return list(found.points)

    def checks(self, found: list[WorkPoint]) -> list[Order]:
        """All orders."""
        return [
            Order(method.__name__, method.TABLEAU.order, float(np.log2(errors[-2] / errors[-1])))
            for method in METHODS
            for errors in ([point.error for point in found if point.method == method.__name__],)
        ]

    def text(self, found: list[WorkPoint]) -> str:
        """Errors, and the order from the two shortest steps."""
        head = [["error,", f"{n} steps"] for n in self.counts] + [["order"], ["ours"], [""]]
        body = []
        for order in self.checks(found):
            errors = [compact(point.error) for point in found if point.method == order.method]
            verdict = "ok" if order.passed else "FAILED"
            body.append((order.method, [*errors, str(order.known), f"{order.ours:.2f}", verdict]))
        return f"Kepler's problem, e = 0.2, H and L kept, t = {self.t_end:g}\n\n{table(head, body)}"

    def tables(self, found: list[WorkPoint]) -> dict[str, Rows]:
        """A row for each run."""
        return {"orders.csv": [{"method": p.method, "h": p.step, "error": p.error} for p in found]}

    def numbers(self, found: list[WorkPoint]) -> dict[str, Any]:
        """The orders."""
        return {"orders": [order._asdict() for order in self.checks(found)]}

    def figures(self, found: list[WorkPoint]) -> Figures:
        """Error against step."""
        from ...plotting import CostPanel, cost_figure
        from ..work_precision import curves

        panel = CostPanel("", "step h", curves(found, "step"))
        yield "orders.png", cost_figure([[panel]], error="error of position", title="Kepler's problem: error and step")


def _run(problem: Problem, method: type[EIPSolver], step: float) -> tuple[float, np.ndarray]:
    result = integrate(problem, method=method, h=step)
    return result.wall_time, result.y[:, -1]
