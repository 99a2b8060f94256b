"""The paper's test of efficiency: error against processor time for the NLS equation, EIP beside implicit schemes.

    python benchmarks/gpe_efficiency.py [--points N] [--repeats N] [--out FOLDER]

Two problems on 64 x 64 points, or N x N, of [0, 2 pi)^2, beta = 1, to t = 1. The paper's plane wave is a stationary
state: the gradients of mass and energy are parallel, so that a projection onto both has rank 1 (counted in the table),
and |psi|^2 is constant, so that the linear systems of LIC need no iteration. The modulated wave has none of that.
Explicit steps are limited by the grid, implicit ones are not. Times are processor seconds, the least of several runs
taken in turn, less the least of a run of a single step: what the set-up takes, up to 20 ms, is left out.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from math import ceil
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from eip_scipy import EIPRK4, integrate
from eip_scipy.comparators import crank_nicolson, linearly_implicit, sav_crank_nicolson
from eip_scipy.problems import plane_wave
from eip_scipy.problems.gross_pitaevskii import FieldProblem
from eip_scipy.report import describe_machine, table, write_csv
from eip_scipy.work_precision import cost_to_reach, work_precision

T_END = 1.0
SHARES = (0.9, 0.64, 0.45, 0.32, 0.225)  # of the step above which RK4 is unstable
IMPLICIT = tuple(T_END / n for n in (25, 50, 100, 200, 400, 800, 1600, 3200, 6400))
FIT_BETWEEN = 1e-11, 1e-2  # smaller errors are round-off, larger ones not yet of any order
LEVELS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
SLOPES = ("CN", "EIP-ME")  # drawn
DRAWN = {"h": "h", "cost": "seconds", "error": "error_max"}


class Method(NamedTuple):
    """``run(problem, h, t_end)`` returns the two ends, the evaluations of f or of the nonlinear term, and a remark."""

    run: Callable[[FieldProblem, float, float], tuple[np.ndarray, int, str]]
    steps: Callable[[FieldProblem], Sequence[float]]


def stable_steps(problem: FieldProblem) -> list[float]:
    limit = problem.equation.largest_step(problem.y0)
    return [T_END / ceil(T_END / (share * limit)) for share in SHARES]


def projected(*names: str) -> Method:
    def run(problem: FieldProblem, h: float, t_end: float) -> tuple[np.ndarray, int, str]:
        invariants = problem.equation.invariants(names)
        result = integrate(problem, (0.0, t_end), method=EIPRK4, h=h, invariants=invariants)
        made, reduced = result.diagnostics.n_projections, result.diagnostics.n_rank_reduced
        return result.y, result.nfev, f"rank 1 in {reduced} of {made} projections" if reduced else ""

    return Method(run, stable_steps)


def implicit(scheme: Callable[..., Any]) -> Method:
    def run(problem: FieldProblem, h: float, t_end: float) -> tuple[np.ndarray, int, str]:
        result = scheme(problem.equation, (0.0, t_end), problem.y0, h)
        return result.y, result.nfev, "" if result.message == "completed" else result.message

    return Method(run, lambda problem: IMPLICIT)


METHODS = {
    "RK4": projected(),
    "EIP-M": projected("mass"),
    "EIP-E": projected("energy"),
    "EIP-ME": projected("mass", "energy"),
    "CN": implicit(crank_nicolson),
    "LIC": implicit(linearly_implicit),
    "SAV/CN": implicit(sav_crank_nicolson),
}


def modulated_wave(points: int) -> tuple[FieldProblem, np.ndarray]:
    """A plane wave with bumps, and its state at the end by SciPy's DOP853 at its tightest."""
    gpe = plane_wave((points, points)).equation
    x, y = gpe.grid.mesh()
    psi0 = np.exp(1j * (x + y)) * (1 + 0.5 * np.cos(x) + 0.5 * np.sin(y))
    problem = gpe.problem(psi0, T_END, name="modulated-wave")
    fine = solve_ivp(gpe.fun, (0.0, T_END), problem.y0, method="DOP853", rtol=3e-14, atol=1e-15)
    return problem, fine.y[:, -1]


class Trial:
    """One problem: its runs, and what besides error and time they tell."""

    def __init__(self, problem: FieldProblem, exact: np.ndarray) -> None:
        self.problem, self.exact = problem, exact
        self.rows: dict[tuple[str, float], dict[str, Any]] = {}
        self.single: dict[str, float] = {}  # seconds of a single step, set-up included

    def runner(self, name: str) -> Callable[[float], tuple[float, np.ndarray]]:
        method = METHODS[name]

        def run(h: float) -> tuple[float, np.ndarray]:
            begin = time.process_time()
            method.run(self.problem, h, h)
            between = time.process_time()
            y, nfev, remark = method.run(self.problem, h, T_END)
            seconds = time.process_time() - between
            self.single[name] = min(self.single.get(name, np.inf), between - begin)
            self.rows[name, h] = {"method": name, "h": h, "nfev": nfev, "remark": remark, **self.errors(y)}
            return seconds, y[:, -1]

        return run

    def errors(self, y: np.ndarray) -> dict[str, float]:
        gpe, (start, end) = self.problem.equation, y.T
        difference = end - self.exact
        return {
            "error_max": float(np.abs(difference).max()),
            "error_L2": float(np.sqrt(gpe.mass(difference))),
            "error_mass": abs(gpe.mass(end) / gpe.mass(start) - 1),
            "error_energy": abs(gpe.energy(end) / gpe.energy(start) - 1),
        }

    def measure(self, repeats: int) -> None:
        methods = {name: (self.runner(name), method.steps(self.problem)) for name, method in METHODS.items()}

        def error(end: np.ndarray) -> float:
            return float(np.abs(end - self.exact).max())

        for point in work_precision(methods, error, repeats=repeats, enough_seconds=np.inf).points:
            self.rows[point.method, point.step]["seconds"] = point.wall_time - self.single[point.method]

    def column(self, name: str, key: str) -> np.ndarray:
        return np.array([row[key] for (method, _), row in self.rows.items() if method == name])

    def slope(self, name: str) -> float:
        h, error = self.column(name, "h"), self.column(name, "error_max")
        clean = (error > FIT_BETWEEN[0]) & (error < FIT_BETWEEN[1])
        return float(np.polyfit(np.log(h[clean]), np.log(error[clean]), 1)[0])


def number(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.2g}"


def show(title: str, trial: Trial) -> None:
    body = []
    for row in trial.rows.values():
        errors = [f"{row[key]:.1e}" for key in ("error_max", "error_L2", "error_mass", "error_energy")]
        evaluations = f"{row['nfev'] * row['h'] / T_END:.1f}"
        body.append((row["method"], [f"{row['h']:.2e}", *errors, evaluations, f"{row['seconds']:.4f}", row["remark"]]))
    heads = [["h"], ["error", "max"], ["error", "L2"], ["error of", "mass"], ["error of", "energy"]]
    print(f"\n{title}\n")
    print(table([*heads, ["f per", "step"], ["CPU [s]"], [""]], body))
    print(f"\n{title}: slope in h, and CPU seconds to reach an error (max)\n")
    rows = []
    for name in METHODS:
        cost, error = trial.column(name, "seconds"), trial.column(name, "error_max")
        rows.append(
            (name, [f"{trial.slope(name):.2f}", *(number(cost_to_reach(cost, error, level)) for level in LEVELS)])
        )
    print(table([["slope"], *([f"{level:.0e}"] for level in LEVELS)], rows))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("eip_results"))
    parser.add_argument("--points", type=int, default=64)
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    print(describe_machine())
    points = arguments.points
    wave = plane_wave((points, points), t_end=T_END)
    trials = {"plane wave": Trial(wave, wave.reference(T_END)), "modulated wave": Trial(*modulated_wave(points))}
    for title, trial in trials.items():
        trial.measure(arguments.repeats)
        show(title, trial)
    arguments.out.mkdir(parents=True, exist_ok=True)
    rows = [{"problem": title, **row} for title, trial in trials.items() for row in trial.rows.values()]
    print(f"\nwrote {write_csv(arguments.out / f'gpe-efficiency-{points}.csv', rows)}")
    title = f"NLS equation, {points} x {points} points: accuracy and cost"
    save_figure(title, trials, arguments.out / f"gpe-efficiency-{points}.png")


def save_figure(title: str, trials: dict[str, Trial], path: Path) -> None:
    from eip_scipy.plotting import efficiency_figure

    series = {
        wave: {name: {key: trial.column(name, source) for key, source in DRAWN.items()} for name in METHODS}
        for wave, trial in trials.items()
    }
    slopes = {wave: {name: trial.slope(name) for name in SLOPES} for wave, trial in trials.items()}
    figure = efficiency_figure(
        series,
        error=r"max $|\delta\psi|$ at t = 1",
        cost="processor time [s]",
        slopes=slopes,
        title=title,
    )
    figure.savefig(path)
    print(f"wrote {path}")


if __name__ == "__main__":
    main()
