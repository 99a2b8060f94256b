"""``eip-scipy study pendulum-period``: the period of a pendulum against its closed form."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import ellipk

from eip_scipy import EIPRK4, Invariant, integrate

from ..report import table
from ..study import Check, Session, Study, option

__all__ = ["PendulumPeriod"]


@dataclass(frozen=True, kw_only=True)
class PendulumPeriod(Study[list[dict[str, Any]]]):
    """Periods by the zeros of the angle, at several steps."""

    amplitude: float = option(1.0, "largest angle in radians")

    def measure(self, session: Session) -> list[dict[str, Any]]:
        exact = 4 * ellipk(np.sin(self.amplitude / 2) ** 2)
        return [{"h": h, "error": abs(self._period(h) - exact)} for h in (0.1, 0.05, 0.025)]

    def _period(self, h: float) -> float:
        energy = Invariant(lambda t, y: 0.5 * y[1] ** 2 - np.cos(y[0]), lambda t, y: np.array([np.sin(y[0]), y[1]]))
        run = integrate(
            lambda t, y: np.array([y[1], -np.sin(y[0])]), (0, 20), [self.amplitude, 0.0], method=EIPRK4, h=h,
            invariants=energy, events=lambda t, y: y[0],
        )  # fmt: skip
        assert run.t_events is not None
        return float(2 * (run.t_events[0][1] - run.t_events[0][0]))

    def text(self, found: list[dict[str, Any]]) -> str:
        return table([["error of the period"]], [(f"h = {row['h']}", [f"{row['error']:.2e}"]) for row in found])

    def checks(self, found: list[dict[str, Any]]) -> list[Check]:
        order = np.log2(found[0]["error"] / found[1]["error"])
        return [Check("the order of the period is at least 4", bool(order > 3.8))]
