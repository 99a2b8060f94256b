"""``eip-scipy study waves``: error against processor time for waves by the method of lines, also by SciPy's DOP853.

Three waves with closed forms: the breather of the nonlinear Schroedinger equation, a kink and an antikink of the
sine-Gordon equation that meet, two solitons of the Korteweg-de Vries equation that overtake each other. Each by

1. the problem's own method with fixed steps, projected;
2. the same without a projection;
3. EIPDOP853, projected, and
4. DOP853 of `scipy.integrate.solve_ivp`, both by tolerances, rtol = atol.

The first tables have the errors at the end: the largest difference of the field from the closed form, and the largest
relative error of an invariant. The last ones have errors at several times in longer runs. Times are processor times on
one thread, the least of three runs, which take turns; runs of more than a second are made once.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from eip_scipy import EIPDOP853, integrate
from eip_scipy.problems import breather, korteweg_de_vries_solitons, sine_gordon_breather, sine_gordon_kinks

from ..report import table
from ..study import Figures, Measurement, Session, option

OWN, RAW, EIP, SCIPY = "own method, projected", "own method alone", "EIPDOP853", "SciPy's DOP853"
METHODS = (OWN, RAW, EIP, SCIPY)
REPEATS, SHORT = 3, 1.0  # runs that take less than `SHORT` seconds are repeated, others run once
# Problem, fixed steps, tolerances.
SCENES: dict[str, tuple[Any, tuple[float, ...], tuple[float, ...]]] = {
    "NLS breather": (breather(t_end=5.0, fft="scipy"), (0.02, 0.01, 0.005, 0.0025), (1e-4, 1e-8, 1e-10)),
    "sine-Gordon kinks": (sine_gordon_kinks(), (0.4, 0.35, 0.3, 0.25, 0.2), (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)),
    "KdV solitons": (korteweg_de_vries_solitons(), (0.03, 0.02, 0.015, 0.01, 0.007), (1e-4, 1e-8, 1e-10)),
}
LONG: dict[str, tuple[Any, float, float]] = {  # problem, end, and a step of which the times below are multiples
    "NLS breather": (breather(fft="scipy"), 25.0, 0.01),
    "sine-Gordon breather": (sine_gordon_breather(), 1000.0, 0.125),
    "KdV solitons": (korteweg_de_vries_solitons((1.0, 0.6), (-20.0, 20.0), 256, 120.0), 160.0, 0.04),
}
TIMES = (0.1, 0.3, 1.0)  # of the longer runs, as parts of their length


def by_own(problem: Any, t: Any, h: float, **options: Any) -> tuple[np.ndarray, int | None]:
    return integrate(problem, (0.0, t[-1]), h=h, t_eval=t, **options).y, None


def by_eip(problem: Any, t: Any, tolerance: float) -> tuple[np.ndarray, int | None]:
    run = integrate(problem, (0.0, t[-1]), method=EIPDOP853, rtol=tolerance, atol=tolerance, t_eval=t)
    return run.y, run.nfev


def by_scipy(problem: Any, t: Any, tolerance: float) -> tuple[np.ndarray, int | None]:
    span = (0.0, t[-1])
    run = solve_ivp(problem.fun, span, problem.y0, method="DOP853", rtol=tolerance, atol=tolerance, t_eval=t)
    return run.y, run.nfev


def methods(problem: Any, steps: Any, tolerances: Any) -> dict[tuple[str, float], Any]:
    """Return the runs by (method, step or tolerance), each a function of the times at which states are wanted.

    The function returns the states at these times in columns, and the calls of f (None for the problem's own method).
    """
    runs: dict[tuple[str, float], Any] = {}
    for h in steps:
        runs[OWN, h] = lambda t, h=h: by_own(problem, t, h)
        runs[RAW, h] = lambda t, h=h: by_own(problem, t, h, invariants=())
    for tolerance in tolerances:
        runs[EIP, tolerance] = lambda t, x=tolerance: by_eip(problem, t, x)
        runs[SCIPY, tolerance] = lambda t, x=tolerance: by_scipy(problem, t, x)
    return runs


def errors(problem: Any, t: float, y: np.ndarray) -> tuple[float, float]:
    """Return the largest error of the field in the state `y` at `t`, and the largest relative error of an invariant."""
    start, end = (np.array([item.fun(0.0, state) for item in problem.invariants]) for state in (problem.y0, y))
    return float(np.abs(y - problem.reference(t)).max()), float(np.abs(end / start - 1).max())


def costs(problem: Any, steps: Any, tolerances: Any, times: Any, repeats: int) -> list[dict[str, Any]]:
    """Return a row for each run: its least processor time in seconds, calls of f, and errors of the field at `times`.

    Each run is made up to `repeats` times. "field" and "invariants" are the largest errors at the last of `times`.
    """
    runs = methods(problem, steps, tolerances)
    rows: dict[tuple[str, float], dict[str, Any]] = {}
    for _ in range(repeats):
        for key, run in runs.items():
            if key in rows and rows[key]["seconds"] > SHORT:
                continue
            begin = time.process_time()
            y, calls = run(times)
            seconds = time.process_time() - begin
            if key not in rows:
                pairs = [errors(problem, at, state) for at, state in zip(times, y.T, strict=True)]
                (method, at), (field, kept) = key, pairs[-1]
                rows[key] = {"method": method, "at": at, "field": field, "invariants": kept, "calls": calls}
                rows[key] |= {"fields": [pair[0] for pair in pairs], "seconds": seconds}
            rows[key]["seconds"] = min(rows[key]["seconds"], seconds)
    return sorted(rows.values(), key=lambda row: (METHODS.index(row["method"]), -row["at"]))


def rows_table(rows: list[dict[str, Any]], times: Any) -> str:
    """Lay out the rows of `costs` as a table, with the errors of the field at `times`."""
    body = []
    for row in rows:
        fields = [f"{error:.1e}" for error in row["fields"]]
        numbers = [f"{row['invariants']:.0e}", f"{row['seconds']:.2f}", str(row["calls"] or "")]
        body.append((row["method"], [f"{row['at']:g}", *fields, *numbers]))
    heads = [["field", f"t = {t:g}"] for t in times]
    return table([["h or", "rtol"], *heads, ["invariants", "at the end"], ["time [s]"], ["f"]], body)


@dataclass(frozen=True, kw_only=True)
class Waves(Measurement[dict[str, dict[str, list[dict[str, Any]]]]]):
    """Command ``eip-scipy study waves``."""

    writes_files = True
    quick: bool = option(False, "a trial: 0.05 of each time span, each method once, no longer runs")

    def measure(self, session: Session) -> dict[str, dict[str, list[dict[str, Any]]]]:
        found: dict[str, dict[str, list[dict[str, Any]]]] = {"costs": {}, "growth": {}}
        longer = {} if self.quick else LONG
        with session.bar(len(SCENES) + len(longer), "waves", "wave") as bar:
            for name, (problem, steps, tolerances) in SCENES.items():
                if self.quick:
                    steps, tolerances = steps[:1], tolerances[:1]
                    problem = replace(problem, t_span=(0.0, problem.t_span[1] / 20))
                repeats = 1 if self.quick else REPEATS
                found["costs"][name] = costs(problem, steps, tolerances, [problem.t_span[1]], repeats)
                bar.update()
            for name, (problem, t_end, h) in longer.items():
                found["growth"][name] = costs(problem, (h,), (1e-8,), t_end * np.array(TIMES), 1)
                bar.update()
        return found

    def table(self, found: dict[str, dict[str, list[dict[str, Any]]]]) -> str:
        share = 20 if self.quick else 1
        ends = {name: [problem.t_span[1] / share] for name, (problem, *_) in SCENES.items()}
        parts = [f"{name}\n\n{rows_table(rows, ends[name])}" for name, rows in found["costs"].items()]
        for name, rows in found["growth"].items():
            parts.append(f"{name}, in time\n\n{rows_table(rows, LONG[name][1] * np.array(TIMES))}")
        return "\n\n".join(parts)

    def figures(self, found: dict[str, dict[str, list[dict[str, Any]]]]) -> Figures:
        yield "waves.png", figure(found["costs"])


def figure(found: dict[str, list[dict[str, Any]]]) -> Any:
    """Draw the waves in space and time, and below each the errors against processor time.

    `found` has the rows of `costs` by the names of the waves.
    """
    from eip_scipy.plotting import method_styles

    from ..plotting import blank_figure, log_x

    styles = method_styles(METHODS)
    figure = blank_figure(12, 10.5)
    panels = figure.subplots(3, len(SCENES), height_ratios=(1.1, 1, 1))
    widths = {"NLS breather": 5, "sine-Gordon kinks": 20, "KdV solitons": 32}
    labels = {"NLS breather": "|ψ|", "sine-Gordon kinks": "q", "KdV solitons": "u"}
    for (name, (problem, *_)), column in zip(SCENES.items(), panels.T, strict=True):
        grid = problem.equation.grid
        x, t = grid.points(0), np.linspace(0.0, problem.t_span[1], 240)
        field = np.array([problem.reference(at)[: grid.size] for at in t])
        middle = np.abs(x) < widths[name]
        shown = np.abs(field) if np.iscomplexobj(field) else field
        image = column[0].pcolormesh(x[middle], t, shown[:, middle], cmap="cividis", rasterized=True)
        figure.colorbar(image, ax=column[0], label=labels[name])
        column[0].set(title=name, xlabel="x", ylabel="t")
        for axis, what in zip(column[1:], ("field", "invariants"), strict=True):
            for method in METHODS:
                rows = [(r["seconds"], r[what]) for r in found[name] if r["method"] == method]
                axis.plot(*np.maximum(np.array(rows), 1e-16).T, ms=5, lw=1.3, **styles[method])
            log_x(axis)
            axis.set(yscale="log", xlabel="processor time [s]")
            axis.grid(alpha=0.3)
    panels[1, 0].set_ylabel("largest error of the field at the end")
    panels[2, 0].set_ylabel("largest relative error of an invariant")
    figure.legend(*panels[1, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    return figure
