"""Waves by lines: the methods that the problems bring beside SciPy's DOP853, errors against processor time.

    python -m eip_scipy_studies.measurements.waves [--quick] [--json FILE] [--figure FILE]

Three waves with closed forms: the breather of the nonlinear Schroedinger equation, a kink and an antikink of the
sine-Gordon equation that meet, two solitons of the Korteweg-de Vries equation that overtake each other. Each by

1. the problem's own method with fixed steps, projected;
2. the same without a projection;
3. EIPDOP853, projected, and
4. DOP853 of `scipy.integrate.solve_ivp`, both by tolerances, rtol = atol.

Errors at the end: the largest one of the field against the closed form, and the largest of the invariants, relative.
Then errors in longer runs, in time. Processor time, the least of three runs of each, which take turns;
runs of more than a second are made once. One thread.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from eip_scipy import EIPDOP853, integrate
from eip_scipy.problems import breather, korteweg_de_vries_solitons, sine_gordon_breather, sine_gordon_kinks

from ..report import describe_machine, table

OWN, RAW, EIP, SCIPY = "own method, projected", "own method alone", "EIPDOP853", "SciPy's DOP853"
METHODS = (OWN, RAW, EIP, SCIPY)
REPEATS, SHORT = 3, 1.0  # of runs below so many seconds; others run once
# Problem, fixed steps, tolerances.
SCENES: dict[str, tuple[Any, tuple[float, ...], tuple[float, ...]]] = {
    "NLS breather": (breather(t_end=5.0, fft="scipy"), (0.02, 0.01, 0.005, 0.0025), (1e-4, 1e-8, 1e-10)),
    "sine-Gordon kinks": (sine_gordon_kinks(), (0.4, 0.35, 0.3, 0.25, 0.2), (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)),
    "KdV solitons": (korteweg_de_vries_solitons(), (0.03, 0.02, 0.015, 0.01, 0.007), (1e-4, 1e-8, 1e-10)),
}
LONG: dict[str, tuple[Any, float, float]] = {  # problem, end, step, which the times below are multiples of
    "NLS breather": (breather(fft="scipy"), 25.0, 0.01),
    "sine-Gordon breather": (sine_gordon_breather(), 1000.0, 0.125),
    "KdV solitons": (korteweg_de_vries_solitons((1.0, 0.6), (-20.0, 20.0), 256, 120.0), 160.0, 0.04),
}
TIMES = (0.1, 0.3, 1.0)  # of the longer runs, in parts of their length


def own(problem: Any, t: Any, h: float, **options: Any) -> tuple[np.ndarray, int | None]:
    return integrate(problem, (0.0, t[-1]), h=h, t_eval=t, **options).y, None


def by_eip(problem: Any, t: Any, tolerance: float) -> tuple[np.ndarray, int | None]:
    run = integrate(problem, (0.0, t[-1]), method=EIPDOP853, rtol=tolerance, atol=tolerance, t_eval=t)
    return run.y, run.nfev


def by_scipy(problem: Any, t: Any, tolerance: float) -> tuple[np.ndarray, int | None]:
    span = (0.0, t[-1])
    run = solve_ivp(problem.fun, span, problem.y0, method="DOP853", rtol=tolerance, atol=tolerance, t_eval=t)
    return run.y, run.nfev


def methods(problem: Any, steps: Any, tolerances: Any) -> dict[tuple[str, float], Any]:
    """Runs by method and step or tolerance, each a function of the times at which states are wanted."""
    runs: dict[tuple[str, float], Any] = {}
    for h in steps:
        runs[OWN, h] = lambda t, h=h: own(problem, t, h)
        runs[RAW, h] = lambda t, h=h: own(problem, t, h, invariants=())
    for tolerance in tolerances:
        runs[EIP, tolerance] = lambda t, x=tolerance: by_eip(problem, t, x)
        runs[SCIPY, tolerance] = lambda t, x=tolerance: by_scipy(problem, t, x)
    return runs


def errors(problem: Any, t: float, y: np.ndarray) -> tuple[float, float]:
    """The field's largest error, and the invariants' largest relative one."""
    start, end = (np.array([item.fun(0.0, state) for item in problem.invariants]) for state in (problem.y0, y))
    return float(np.abs(y - problem.reference(t)).max()), float(np.abs(end / start - 1).max())


def costs(problem: Any, steps: Any, tolerances: Any, repeats: int) -> dict[tuple[str, float], dict[str, Any]]:
    runs, t_end = methods(problem, steps, tolerances), problem.t_span[1]
    found: dict[tuple[str, float], dict[str, Any]] = {}
    for _ in range(repeats):
        for key, run in runs.items():
            if key in found and found[key]["seconds"] > SHORT:
                continue
            begin = time.process_time()
            y, calls = run([t_end])
            seconds = time.process_time() - begin
            if key not in found:
                field, invariants = errors(problem, t_end, y[:, -1])
                found[key] = {"field": field, "invariants": invariants, "calls": calls, "seconds": seconds}
            found[key]["seconds"] = min(found[key]["seconds"], seconds)
    return found


def growth(problem: Any, t_end: float, h: float) -> dict[tuple[str, float], dict[str, Any]]:
    """Errors at some times of a longer run, one step and one tolerance for each method."""
    t = t_end * np.array(TIMES)
    found = {}
    for key, run in methods(problem, (h,), (1e-8,)).items():
        begin = time.process_time()
        y, calls = run(t)
        seconds = time.process_time() - begin
        pairs = [errors(problem, at, state) for at, state in zip(t, y.T, strict=True)]
        found[key] = {"t": t.tolist(), "field": [a for a, _ in pairs], "invariants": [b for _, b in pairs]}
        found[key] |= {"calls": calls, "seconds": seconds}
    return found


def show_costs(name: str, found: dict[tuple[str, float], dict[str, Any]]) -> None:
    print(f"\n{name}\n")
    rows = [
        (
            method,
            [f"{x:g}", f"{r['field']:.1e}", f"{r['invariants']:.0e}", f"{r['seconds']:.2f}", str(r["calls"] or "")],
        )
        for (method, x), r in sorted(found.items(), key=lambda item: (METHODS.index(item[0][0]), -item[0][1]))
    ]
    print(table([["h or", "rtol"], ["field"], ["invariants"], ["time [s]"], ["f"]], rows))


def show_growth(name: str, found: dict[tuple[str, float], dict[str, Any]]) -> None:
    t = next(iter(found.values()))["t"]
    print(f"\n{name}: errors of the field at t = {', '.join(f'{x:g}' for x in t)}, and of the invariants at the end\n")
    rows = [
        (method, [f"{x:g}", *(f"{e:.1e}" for e in r["field"]), f"{r['invariants'][-1]:.0e}", f"{r['seconds']:.1f}"])
        for (method, x), r in found.items()
    ]
    print(table([["h or", "rtol"], *([f"{x:g}"] for x in t), ["invariants"], ["time [s]"]], rows))


def save_figure(found: dict[str, Any], path: str) -> None:
    """Draw the waves in space and time, and below each the errors against the processor's time."""
    from matplotlib.figure import Figure

    from eip_scipy.plotting import method_styles

    styles = method_styles(METHODS)
    figure = Figure(figsize=(12, 10.5), layout="constrained")
    panels = figure.subplots(3, len(SCENES), height_ratios=(1.1, 1, 1))
    widths = {"NLS breather": 5, "sine-Gordon kinks": 20, "KdV solitons": 32}
    labels = {"NLS breather": "|ψ|", "sine-Gordon kinks": "q", "KdV solitons": "u"}
    for (name, (problem, *_)), column in zip(SCENES.items(), panels.T, strict=True):
        grid = problem.equation.grid
        x, t = grid.points(0), np.linspace(*problem.t_span, 240)
        field = np.array([problem.reference(at)[: grid.size] for at in t])
        middle = np.abs(x) < widths[name]
        shown = np.abs(field) if np.iscomplexobj(field) else field
        image = column[0].pcolormesh(x[middle], t, shown[:, middle], cmap="cividis", rasterized=True)
        figure.colorbar(image, ax=column[0], label=labels[name])
        column[0].set(title=name, xlabel="x", ylabel="t")
        for axis, what in zip(column[1:], ("field", "invariants"), strict=True):
            for method in METHODS:
                rows = [(r["seconds"], r[what]) for (m, _), r in found[name].items() if m == method]
                axis.plot(*np.maximum(np.array(rows), 1e-16).T, ms=5, lw=1.3, **styles[method])
            axis.set(xscale="log", yscale="log", xlabel="processor time [s]")
            axis.grid(alpha=0.3)
    panels[1, 0].set_ylabel("largest error of the field at the end")
    panels[2, 0].set_ylabel("largest relative error of an invariant")
    figure.legend(*panels[1, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    figure.savefig(path, dpi=130)
    print(f"wrote {path}")


def plain(found: dict[str, Any]) -> dict[str, Any]:
    return {name: [{"method": m, "at": x, **r} for (m, x), r in part.items()] for name, part in found.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a twentieth of each wave, each method once")
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--figure", metavar="FILE")
    arguments = parser.parse_args()
    print(describe_machine())
    found, longer = {}, {}
    for name, (problem, steps, tolerances) in SCENES.items():
        if arguments.quick:
            steps, tolerances = steps[:1], tolerances[:1]
            problem = replace(problem, t_span=(0.0, problem.t_span[1] / 20))
        found[name] = costs(problem, steps, tolerances, 1 if arguments.quick else REPEATS)
        show_costs(f"{name}, to t = {problem.t_span[1]:g}", found[name])
    if arguments.figure:
        save_figure(found, arguments.figure)
    for name, (problem, t_end, h) in () if arguments.quick else LONG.items():
        longer[name] = growth(problem, t_end, h)
        show_growth(name, longer[name])
    if arguments.json:
        with open(arguments.json, "w") as file:
            json.dump({"costs": plain(found), "growth": plain(longer)}, file, indent=1)


if __name__ == "__main__":
    main()
