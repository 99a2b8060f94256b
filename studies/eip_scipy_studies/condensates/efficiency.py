"""The paper's test of efficiency: error against processor time for the NLS equation, EIP compared with other schemes.

Two problems on 64 x 64 points of [0, 2 pi)^2, beta = 1, to t = 1. The paper's plane wave is a stationary state: a
projection onto mass and energy has rank 1, the linear systems of LIC (`linearly_implicit`) need no iteration, and
splittings are exact. None of this holds for the modulated wave. Times are processor seconds, the least of several runs
taken in turn, minus the least time of a run of a single step, which removes the set-up of up to 20 ms.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import ceil
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from eip_scipy import EIPRK4, eip_method, integrate
from eip_scipy.problems import FieldProblem

from ..comparators import crank_nicolson, linearly_implicit, sav_crank_nicolson
from ..report import describe_machine, table
from ..study import Check, Figures, Rows, Session, Study, option
from ..work_precision import cost_to_reach, known_end, work_precision
from .problems import plane_wave
from .splitting import Splitting

T_END = 1.0
SHARES = (0.9, 0.64, 0.45, 0.32, 0.225)  # of the step above which RK4 is unstable
LONG = tuple(T_END / n for n in (25, 50, 100, 200, 400, 800, 1600, 3200, 6400))
FOURTH = tuple(T_END / n for n in (10, 20, 40, 80, 160, 320))
FIT_BETWEEN = 1e-11, 1e-2  # smaller errors are round-off, larger ones are not in the asymptotic range yet
FITTED = 3  # number of the finest steps used: longer steps of splittings are not in the asymptotic range
LEVELS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
WAVES = ("plane wave", "modulated wave")
KEPT = ("mass", "energy")
# Known slopes in h, to 0.1 (those of CN and EIP-ME are also drawn), and the bounds of both invariant errors of EIP-ME.
ORDERS = dict.fromkeys(("RK4", "EIP-M", "EIP-E", "EIP-ME"), 4) | dict.fromkeys(("CN", "LIC", "SAV/CN", "Strang"), 2)
ORDERS["splitting4-EIP"] = 4
SLOPES, SLOPE_TOLERANCE, LEFT = ("CN", "EIP-ME"), 0.1, 1e-12


class Contender(NamedTuple):
    """A method of the test, and the lengths ``steps(problem)`` of the steps at which it is run.

    ``run(problem, h, t_end)`` returns the first and the last state (n, 2), the number of pairs of transforms, and a
    remark for the table.
    """

    run: Callable[[FieldProblem, float, float], tuple[np.ndarray, int, str]]
    steps: Callable[[FieldProblem], Sequence[float]]


def stable_steps(problem: FieldProblem) -> list[float]:
    """Return the lengths of the steps of RK4: `SHARES` of its stability limit, shortened to divide the interval."""
    limit = problem.equation.largest_step(problem.y0)
    return [T_END / ceil(T_END / (share * limit)) for share in SHARES]


def ours(base: Callable[..., Any] | None, steps: Sequence[float] | None, *names: str) -> Contender:
    """Return the one-step method ``base(gpe)``, or RK4, with projection onto the invariants `names`, if any.

    `steps` are the lengths of its steps, by default those of `stable_steps`.
    """

    def run(problem: FieldProblem, h: float, t_end: float) -> Any:
        method = EIPRK4 if base is None else eip_method(base(problem.equation))
        invariants = problem.equation.invariants(names)
        result = integrate(problem, (0.0, t_end), method=method, h=h, invariants=invariants)
        made, reduced = result.diagnostics.n_projections, result.diagnostics.n_rank_reduced
        return result.y, result.nfev, f"rank 1 in {reduced} of {made} projections" if reduced else ""

    return Contender(run, lambda problem: stable_steps(problem) if steps is None else steps)


def implicit(scheme: Callable[..., Any]) -> Contender:
    """Return one of the paper's implicit schemes, a function of `comparators`, run with the step lengths `LONG`."""

    def run(problem: FieldProblem, h: float, t_end: float) -> tuple[np.ndarray, int, str]:
        result = scheme(problem.equation, (0.0, t_end), problem.y0, h)
        return result.y, result.nfev, "" if result.message == "completed" else result.message

    return Contender(run, lambda problem: LONG)


METHODS = {
    "RK4": ours(None, None),
    "EIP-M": ours(None, None, "mass"),
    "EIP-E": ours(None, None, "energy"),
    "EIP-ME": ours(None, None, *KEPT),
    "CN": implicit(crank_nicolson),
    "LIC": implicit(linearly_implicit),
    "SAV/CN": implicit(sav_crank_nicolson),
    "Strang": ours(lambda gpe: Splitting(gpe, "strang"), LONG),
    "splitting4-EIP": ours(Splitting, FOURTH, *KEPT),
}


def modulated_wave(points: int) -> tuple[FieldProblem, np.ndarray]:
    """Return the problem of a modulated plane wave, and its final state (n,) by SciPy's DOP853 at its tightest."""
    gpe = plane_wave((points, points)).equation
    x, y = gpe.grid.mesh()
    psi0 = np.exp(1j * (x + y)) * (1 + 0.5 * np.cos(x) + 0.5 * np.sin(y))
    problem = gpe.problem(psi0, T_END, name="modulated-wave")
    fine = solve_ivp(gpe.fun, (0.0, T_END), problem.y0, method="DOP853", rtol=3e-14, atol=1e-15)
    return problem, fine.y[:, -1]


class Trial:
    """A problem with its exact state (n,) at the end, and the results of its runs by (name of a method, h)."""

    def __init__(self, problem: FieldProblem, exact: np.ndarray) -> None:
        self.problem, self.exact = problem, exact
        self.rows: dict[tuple[str, float], dict[str, Any]] = {}
        self._single: dict[str, float] = {}  # seconds of a single step, including set-up

    def runner(self, name: str) -> Callable[[float], tuple[float, np.ndarray]]:
        """Return ``run(h) -> (seconds, final state)`` of a method, for `work_precision`; a run also fills `rows`."""
        method = METHODS[name]

        def run(h: float) -> tuple[float, np.ndarray]:
            begin = time.process_time()
            method.run(self.problem, h, h)
            between = time.process_time()
            y, pairs, remark = method.run(self.problem, h, T_END)
            seconds = time.process_time() - between
            self._single[name] = min(self._single.get(name, np.inf), between - begin)
            self.rows[name, h] = {"method": name, "h": h, "pairs": pairs, "remark": remark, **self.errors(y)}
            return seconds, y[:, -1]

        return run

    def errors(self, y: np.ndarray) -> dict[str, float]:
        """Return errors of the final state of `y` (n, 2), the states at start and end; those of invariants relative."""
        gpe, (start, end) = self.problem.equation, y.T
        difference = end - self.exact
        return {
            "error_max": float(np.abs(difference).max()),
            "error_L2": float(np.sqrt(gpe.mass(difference))),
            "error_mass": abs(gpe.mass(end) / gpe.mass(start) - 1),
            "error_energy": abs(gpe.energy(end) / gpe.energy(start) - 1),
        }

    def methods(self) -> dict[str, tuple[Callable[[float], tuple[float, np.ndarray]], Sequence[float]]]:
        """Return the `runner` and the lengths of the steps of each method."""
        return {name: (self.runner(name), method.steps(self.problem)) for name, method in METHODS.items()}

    def measure(self, repeats: int, callback: Callable[[], Any]) -> None:
        """Run all methods at all steps and fill `rows`; call `callback()` after each run."""

        def error(end: np.ndarray) -> float:
            return float(np.abs(end - self.exact).max())

        found = work_precision(self.methods(), error, repeats=repeats, enough_seconds=np.inf, callback=callback)
        for point in found.points:
            self.rows[point.method, point.step]["seconds"] = point.wall_time - self._single[point.method]

    def column(self, name: str, key: str) -> np.ndarray:
        """Return the values of a quantity (a key of `rows`) for all steps of a method."""
        return np.array([row[key] for (method, _), row in self.rows.items() if method == name])

    def slope(self, name: str) -> float:
        """Return the order of a method: the slope of a line fitted to the logarithms of error and h.

        It is nan without two errors in the fitted range, as for a splitting on the plane wave, which is exact.
        """
        h, error = self.column(name, "h"), self.column(name, "error_max")
        clean = np.flatnonzero((error > FIT_BETWEEN[0]) & (error < FIT_BETWEEN[1]))[-FITTED:]
        return float(np.polyfit(np.log(h[clean]), np.log(error[clean]), 1)[0]) if clean.size > 1 else float("nan")


def _checked(wave: str, quantity: str, known: float, ours: float, slack: float) -> Check:
    """Return the check that a slope or an invariant error differs from the expected one by at most `slack`."""
    matched = abs(ours - known) <= slack
    record = {"wave": wave, "quantity": quantity, "known": known, "ours": ours, "matched": matched}
    return Check(f"{wave}, {quantity}: {ours:.3g}, known {known:.3g}", matched, record)


Found = dict[str, Trial]


@dataclass(frozen=True, kw_only=True)
class Efficiency(Study[Found]):
    """``reproduce fig-efficiency``: all methods on both waves; `orders` are the expected slopes."""

    points: int = 64
    repeats: int = 3
    orders: Mapping[str, int] = field(default_factory=lambda: ORDERS)
    stem: str = "fig-efficiency"

    def measure(self, session: Session) -> Found:
        plane = plane_wave((self.points, self.points), t_end=T_END)
        trials = dict(zip(WAVES, (Trial(plane, known_end(plane)), Trial(*modulated_wave(self.points))), strict=True))
        total = self.repeats * sum(len(steps) for trial in trials.values() for _, steps in trial.methods().values())
        with session.bar(total, "fig-efficiency") as bar:
            for trial in trials.values():
                trial.measure(self.repeats, bar.update)
        return trials

    def checks(self, found: Found) -> list[Check]:
        """Compare known slopes with the orders, and invariant errors of EIP-ME on the modulated wave with 0."""
        slopes = [
            _checked(wave, f"slope of {name}", order, trial.slope(name), SLOPE_TOLERANCE)
            for wave, trial in found.items()
            for name, order in self.orders.items()
        ]
        left = max(float(found[WAVES[1]].column("EIP-ME", f"error_{name}").max()) for name in KEPT)
        known = [slope for slope in slopes if not np.isnan(slope.record["ours"])]
        return [*known, _checked(WAVES[1], "mass and energy of EIP-ME", 0.0, left, LEFT)]

    def text(self, found: Found) -> str:
        parts = [describe_machine()]
        for wave, trial in found.items():
            body = []
            for name in METHODS:
                cost, error = trial.column(name, "seconds"), trial.column(name, "error_max")
                numbers = [_number(trial.slope(name), ".2f")]
                body.append((name, numbers + [_number(cost_to_reach(cost, error, level), ".2g") for level in LEVELS]))
            parts.append(f"{wave}: slope in h, and processor seconds to reach an error (max)")
            parts.append(table([["slope"], *([f"{level:.0e}"] for level in LEVELS)], body))
        checks = self.checks(found)
        failed = [check for check in checks if not check.passed]
        parts.append(f"{len(checks) - len(failed)} of {len(checks)} slopes and invariants are as they should be.")
        parts += [check.line for check in failed]
        return "\n\n".join(parts)

    def numbers(self, found: Found) -> dict[str, Any]:
        return {"checks": [check.entry for check in self.checks(found)]}

    def tables(self, found: Found) -> dict[str, Rows]:
        return {
            f"{self.stem}.csv": [{"wave": wave, **row} for wave, trial in found.items() for row in trial.rows.values()]
        }

    def figures(self, found: Found) -> Figures:
        """Draw error against step and against time."""
        from ..plotting import CostPanel, cost_figure

        rows = []
        for wave, trial in found.items():
            steps, times = (
                {name: (trial.column(name, cost), trial.column(name, "error_max")) for name in METHODS}
                for cost in ("h", "seconds")
            )
            slopes = {name: trial.slope(name) for name in SLOPES}
            rows.append([CostPanel(wave, "step h", steps, slopes), CostPanel(wave, "processor time [s]", times)])
        yield (
            f"{self.stem}.png",
            cost_figure(
                rows,
                error=r"max $|\delta\psi|$ at t = 1",
                title=f"NLS equation, {self.points} x {self.points} points: accuracy and cost",
            ),
        )


@dataclass(frozen=True, kw_only=True)
class AllRuns(Efficiency):
    """Command ``eip-scipy study gpe-efficiency``: the test on a grid of any size, with a table of all runs."""

    points: int = option(64, "points of the grid along each axis (default: %(default)s)", type=int)
    repeats: int = option(5, "runs of each method and step (default: %(default)s)", type=int)
    stem: str = "gpe-efficiency"

    def text(self, found: Found) -> str:
        return f"{runs_text(found)}\n\n{super().text(found)}"


def _number(value: float, form: str) -> str:
    return "-" if np.isnan(value) else f"{value:{form}}"


def runs_text(trials: Found) -> str:
    """Return a table of all runs of each wave as text."""
    parts = []
    for wave, trial in trials.items():
        body = []
        for row in trial.rows.values():
            errors = [f"{row[key]:.1e}" for key in ("error_max", "error_L2", "error_mass", "error_energy")]
            pairs = f"{row['pairs'] * row['h'] / T_END:.1f}"
            body.append((row["method"], [f"{row['h']:.2e}", *errors, pairs, f"{row['seconds']:.4f}", row["remark"]]))
        heads = [["h"], ["error", "max"], ["error", "L2"], ["error of", "mass"], ["error of", "energy"]]
        parts += [wave, table([*heads, ["pairs", "a step"], ["CPU [s]"], [""]], body)]
    return "\n\n".join(parts)
