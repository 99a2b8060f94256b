"""The paper's test of efficiency: error against processor time for the NLS equation, EIP compared with other schemes.

Two problems on 64 x 64 points of [0, 2 pi)^2, beta = 1, to t = 1. The paper's plane wave is a stationary state: a
projection onto mass and energy has rank 1, the linear systems of LIC (`linearly_implicit`) need no iteration, and
splittings are exact. None of this holds for the modulated wave. Times are processor seconds, the least of several runs
taken in turn, minus the least time of a run of a single step, which removes the set-up of up to 20 ms.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from math import ceil
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from eip_scipy import EIPRK4, eip_method, integrate
from eip_scipy.problems import FieldProblem

from ..comparators import crank_nicolson, linearly_implicit, sav_crank_nicolson
from ..output import Output
from ..report import describe_machine, table
from .problems import plane_wave
from .splitting import Splitting

SHARES = (0.9, 0.64, 0.45, 0.32, 0.225)  # of the step above which RK4 is unstable
LONG = tuple(1 / n for n in (25, 50, 100, 200, 400, 800, 1600, 3200, 6400))
FOURTH = tuple(1 / n for n in (10, 20, 40, 80, 160, 320))
FIT_BETWEEN = 1e-11, 1e-2  # smaller errors are round-off, larger ones are not in the asymptotic range yet
FITTED = 3  # number of the finest steps used: longer steps of splittings are not in the asymptotic range
LEVELS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
KEPT = ("mass", "energy")


def ours(base: Callable[..., Any] | None, *names: str) -> Callable[..., Any]:
    """Return a function that runs the method ``base(gpe)``, or RK4, with projection onto the invariants `names`."""

    def run(problem: FieldProblem, h: float, t_end: float) -> Any:
        method = EIPRK4 if base is None else eip_method(base(problem.equation))
        return integrate(problem, (0.0, t_end), method=method, h=h, invariants=problem.equation.invariants(names))

    return run


def implicit(scheme: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that runs one of the paper's implicit schemes."""
    return lambda problem, h, t_end: scheme(problem.equation, (0.0, t_end), problem.y0, h)


# Methods, their steps (those of RK4 depend on its limit of stability), and their orders.
METHODS: dict[str, tuple[Callable[..., Any], Sequence[float], int]] = {
    "RK4": (ours(None), (), 4),
    "EIP-M": (ours(None, "mass"), (), 4),
    "EIP-E": (ours(None, "energy"), (), 4),
    "EIP-ME": (ours(None, *KEPT), (), 4),
    "CN": (implicit(crank_nicolson), LONG, 2),
    "LIC": (implicit(linearly_implicit), LONG, 2),
    "SAV/CN": (implicit(sav_crank_nicolson), LONG, 2),
    "Strang": (ours(partial(Splitting, scheme="strang")), LONG, 2),
    "splitting4-EIP": (ours(Splitting, *KEPT), FOURTH, 4),
}


class Trial:
    """A wave with its exact state (n,) at the end, and the rows of its runs by (name of a method, h)."""

    def __init__(self, problem: FieldProblem, exact: np.ndarray) -> None:
        self.problem, self.exact = problem, exact
        limit = problem.equation.largest_step(problem.y0)
        stable = [1 / ceil(1 / (share * limit)) for share in SHARES]
        self.rows: dict[tuple[str, float], dict[str, Any]] = {
            (name, h): {"method": name, "h": h} for name, (_, steps, _) in METHODS.items() for h in steps or stable
        }
        self.single = dict.fromkeys(METHODS, np.inf)  # seconds of a single step, including set-up

    def run(self, name: str, h: float) -> None:
        """Run a method, and keep its errors, those of the invariants relative, and its least time."""
        begin = time.process_time()
        METHODS[name][0](self.problem, h, h)
        between = time.process_time()
        run = METHODS[name][0](self.problem, h, 1.0)
        seconds, row = time.process_time() - between, self.rows[name, h]
        self.single[name] = min(self.single[name], between - begin)
        gpe, (start, end), made = self.problem.equation, run.y.T, getattr(run, "diagnostics", None)
        reduced = f"rank 1 in {made.n_rank_reduced} of {made.n_projections} projections" if made else run.message
        row |= {
            "pairs": run.nfev,
            "remark": "" if reduced.startswith(("rank 1 in 0", "completed")) else reduced,
            "error_max": float(np.abs(end - self.exact).max()),
            "error_L2": float(np.sqrt(gpe.mass(end - self.exact))),
            "error_mass": abs(gpe.mass(end) / gpe.mass(start) - 1),
            "error_energy": abs(gpe.energy(end) / gpe.energy(start) - 1),
            "seconds": min(row.get("seconds", np.inf), seconds),
        }

    def column(self, name: str, key: str) -> np.ndarray:
        """Return the values of a quantity for all steps of a method."""
        return np.array([row[key] for (method, _), row in self.rows.items() if method == name])

    def slope(self, name: str) -> float:
        """Return the order of a method: the slope of a line fitted to the logarithms of error and h.

        It is nan without two errors in the fitted range, as for a splitting on the plane wave, which is exact.
        """
        h, error = self.column(name, "h"), self.column(name, "error_max")
        clean = np.flatnonzero((error > FIT_BETWEEN[0]) & (error < FIT_BETWEEN[1]))[-FITTED:]
        return float(np.polyfit(np.log(h[clean]), np.log(error[clean]), 1)[0]) if clean.size > 1 else float("nan")

    def seconds(self, name: str, level: float) -> float:
        """Return the time to reach an error, interpolated on log axes; that of the longest step is an upper bound."""
        cost, error = self.column(name, "seconds"), self.column(name, "error_max")
        k = int(np.argmax(error <= level))
        if error[k] > level:
            return float("nan")
        last = [k, k - 1] if k else [0]
        return float(np.exp(np.interp(np.log(level), np.log(error[last]), np.log(cost[last]))))


def trials(points: int) -> dict[str, Trial]:
    """Return the plane wave, and a modulated one, whose end is that of SciPy's DOP853 at its tightest."""
    plane = plane_wave((points, points), t_end=1.0)
    exact = plane.reference and plane.reference(1.0)
    assert exact is not None
    gpe = plane.equation
    x, y = gpe.grid.mesh()
    problem = gpe.problem(np.exp(1j * (x + y)) * (1 + 0.5 * np.cos(x) + 0.5 * np.sin(y)), 1.0, name="modulated-wave")
    fine = solve_ivp(gpe.fun, (0.0, 1.0), problem.y0, method="DOP853", rtol=3e-14, atol=1e-15)
    return {"plane wave": Trial(plane, exact), "modulated wave": Trial(problem, fine.y[:, -1])}


def efficiency(out: Output, points: int = 64, repeats: int = 3) -> None:
    """Run all methods on both waves, compare slopes and invariants with the known ones, and draw errors and costs."""
    found = trials(points)
    runs = [(trial, *run) for trial in found.values() for run in trial.rows] * repeats
    for trial, name, h in out.bar(runs, "fig-efficiency", unit="run"):
        trial.run(name, h)
    for trial in found.values():
        for row in trial.rows.values():
            row["seconds"] -= trial.single[row["method"]]
    rows = [{"wave": wave, **row} for wave, trial in found.items() for row in trial.rows.values()]
    out.rows("fig-efficiency.csv", rows)
    out.text(describe_machine())
    for wave, trial in found.items():
        numbers = {name: (trial.slope(name), *(trial.seconds(name, level) for level in LEVELS)) for name in METHODS}
        body = [(name, [f"{x:.3g}" if np.isfinite(x) else "-" for x in own]) for name, own in numbers.items()]
        out.text(f"\n{wave}: slope in h, and processor seconds to reach an error (max)\n")
        out.text(table([["slope"], *([f"{level:.0e}"] for level in LEVELS)], body))
        for name, (*_, order) in METHODS.items():
            slope = trial.slope(name)
            if np.isfinite(slope):
                out.check(f"{wave}, slope of {name}: {slope:.3g}, known {order}", abs(slope - order) <= 0.1, ours=slope)
    left = max(float(found["modulated wave"].column("EIP-ME", f"error_{name}").max()) for name in KEPT)
    out.check(f"modulated wave, mass and energy of EIP-ME: {left:.3g}, at most 1e-12", left <= 1e-12, ours=left)
    for file, key, cost in (("", "seconds", "processor time [s]"), ("-steps", "h", "step h")):
        out.figure(f"fig-efficiency{file}.png", "condensates.figures:efficiency_figure", found, key, cost)
