"""The paper's figures 1 and 2: perturbed Kepler orbits, with the errors of the invariants and of the orbit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from eip_scipy import EIPDOP853, EIPRK2, EIPRK4, EIPRK5, integrate
from eip_scipy.problems import kepler
from eip_scipy.solvers import EIPSolver

from ..report import compact, table
from ..study import Check, Figures, Rows, Session, Study

STEP = 0.03
ORBIT_END = 100.0
REFINEMENT = 6  # number of steps of the reference in one step
# check=False, because the paper's RK2 keeps both invariants and loses the orbit, which the figure shows.
PAPER_SETTING: dict[str, Any] = {"metric": "euclidean", "reuse_f": False, "check": False}
FIGURES: dict[str, tuple[str, dict[str, tuple[type[EIPSolver], str]]]] = {
    "fig-kepler-1.png": (
        "Perturbed Kepler problem, e = 0.6, RK4, h = 0.03 (the paper's figure 1)",
        {"EIP-H": (EIPRK4, "H"), "EIP-L": (EIPRK4, "L"), "EIP-HL": (EIPRK4, "HL")},
    ),
    "fig-kepler-2.png": (
        "Perturbed Kepler problem, e = 0.6, EIP-HL with RK2 and RK5, h = 0.03 (the paper's figure 2)",
        {"EIP-HL, RK2": (EIPRK2, "HL"), "EIP-HL, RK5": (EIPRK5, "HL")},
    ),
}
# Known values, to two digits: at t = 2000 ("end") or along the run ("max").
KNOWN = (
    ("EIP-H", "momentum_error", "|L - L0| at t = 2000", "end", "1.5e-4"),
    ("EIP-L", "energy_error", "|H - H0| at t = 2000", "end", "4.8e-4"),
    ("EIP-HL, RK2", "energy_error", "max |H - H0|", "max", "8.5e-8"),
    ("EIP-HL, RK2", "momentum_error", "max |L - L0|", "max", "8.8e-9"),
)


@dataclass(frozen=True, eq=False)
class KeplerRun:
    """One method's run, saved at each step: times (m,), states (4, m) and absolute errors (m,).

    The error of the position is its distance from the reference.
    """

    t: np.ndarray
    y: np.ndarray
    energy_error: np.ndarray
    momentum_error: np.ndarray
    position_error: np.ndarray

    @property
    def orbit(self) -> np.ndarray:
        """Return the positions up to `ORBIT_END`, which are drawn."""
        return self.y[:2, self.t <= ORBIT_END]


Found = dict[str, KeplerRun]


@dataclass(frozen=True, kw_only=True)
class KeplerFigures(Study[Found]):
    """Command ``reproduce fig-kepler``: the methods of the paper's figures 1 and 2, in the paper's setting.

    The reference is EIPDOP853 with 1/6 of the step and compensated sums; with 1/3 of the step it differs by 1e-11 at
    t = 2000.

    Each entry of `known` consists of a method, an attribute of `KeplerRun`, a description, "end" or "max" (for the
    error at `t_end` or its maximum), and the known value.
    """

    t_end: float = 2000.0
    known: Sequence[tuple[str, str, str, str, str]] = KNOWN

    def measure(self, session: Session) -> Found:
        problem = kepler()
        span = (0.0, round(self.t_end / STEP) * STEP)
        tight = integrate(
            problem, span, method=EIPDOP853, h=STEP / REFINEMENT, save_every=REFINEMENT, compensated=True
        ).y
        return {
            name: _line(method, kept, problem, span, tight)
            for _, methods in FIGURES.values()
            for name, (method, kept) in methods.items()
        }

    def checks(self, found: Found) -> list[Check]:
        """Compare with the known values, to their two digits."""
        checks = []
        for name, error, quantity, kind, known in self.known:
            line = found[name]
            values = getattr(line, error)
            at = int(np.searchsorted(line.t, self.t_end)) if kind == "end" else slice(None)
            ours = float(np.max(values[at])) if line.t[-1] >= self.t_end * (1 - 1e-12) else float("nan")
            text = f"{name}, {quantity}: {compact(ours)}, known {compact(float(known))}"
            matched = compact(ours) == known
            record = {"method": name, "quantity": quantity, "known": float(known), "ours": ours, "matched": matched}
            checks.append(Check(text, matched, record))
        return checks

    def text(self, found: Found) -> str:
        t_end = next(iter(found.values())).t[-1]
        head = [["error of", "H"], ["error of", "L"], ["error of", "position"]]
        body = [
            (name, [compact(float(e.max())) for e in (line.energy_error, line.momentum_error, line.position_error)])
            for name, line in found.items()
        ]
        title = (
            f"Figures 1 and 2: perturbed Kepler problem, h = {STEP:g}, t = 0 ... {t_end:.5g}; largest absolute errors"
        )
        return "\n".join([title, "", table(head, body), "", *(check.line for check in self.checks(found))])

    def numbers(self, found: Found) -> dict[str, Any]:
        return {"checks": [check.entry for check in self.checks(found)]}

    def tables(self, found: Found) -> dict[str, Rows]:
        lines = [
            {
                "method": name,
                "t": line.t[k],
                "q1": line.y[0, k],
                "q2": line.y[1, k],
                "energy_error": line.energy_error[k],
                "momentum_error": line.momentum_error[k],
                "position_error": line.position_error[k],
            }
            for name, line in found.items()
            for k in range(0, line.t.size, 50)
        ]
        return {"fig-kepler.csv": lines}

    def figures(self, found: Found) -> Figures:
        from ..plotting import paper_kepler_figure

        for file, (title, methods) in FIGURES.items():
            yield file, paper_kepler_figure({name: found[name] for name in methods}, title=title)


def _line(method: type[EIPSolver], kept: str, problem: Any, span: tuple[float, float], tight: np.ndarray) -> KeplerRun:
    chosen = [item for item in problem.invariants if item.name in kept]
    run = integrate(problem, span, method=method, h=STEP, save_every=1, invariants=chosen, **PAPER_SETTING)
    q, v = run.y[:2], run.y[2:]
    r = np.hypot(*q)
    energy = 0.5 * (v * v).sum(axis=0) - 1 / r - 0.5 * problem.params[0] / r**3
    momentum = q[0] * v[1] - q[1] * v[0]
    position_error = np.hypot(*(q - tight[:2]))
    return KeplerRun(run.t, run.y, np.abs(energy - energy[0]), np.abs(momentum - momentum[0]), position_error)
