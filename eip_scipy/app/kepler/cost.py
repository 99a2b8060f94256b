"""``eip-scipy work-precision``: error against cost of all methods on the perturbed Kepler problem."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ...core.solvers import EIPDOP853, EIPRK2, EIPRK3, EIPRK4, EIPRK5, EIPRK23, EIPRK45, EIPSolver
from ...problems import Problem, kepler
from ...run.integrate import integrate
from ..long_runs import named
from ..report import check_outputs, compact, deliver, table, warn
from ..work_precision import Runner, cost_to_reach, work_precision

__all__ = ["CostCurve", "add_arguments", "measure", "run", "text"]

DONE, INTERRUPTED = 0, 130
T_END, REPEATS = 200.0, 5
REFERENCE_STEPS = 40_000
FIXED: dict[type[EIPSolver], tuple[int, ...]] = {
    # Steps in the whole run.
    EIPRK2: (10_000, 30_000, 100_000, 300_000, 1_000_000),
    EIPRK3: (4_000, 10_000, 30_000, 100_000, 300_000),
    EIPRK4: (2_000, 4_000, 10_000, 30_000, 100_000),
    EIPRK5: (2_000, 4_000, 10_000, 20_000, 40_000),
}
PAIRS: dict[type[EIPSolver], tuple[float, ...]] = {
    # Relative tolerances; atol is a thousandth.
    EIPRK23: (1e-4, 1e-5, 1e-6, 1e-7, 1e-8),
    EIPRK45: (1e-4, 1e-6, 1e-8, 1e-10, 1e-11),
    EIPDOP853: (1e-4, 1e-6, 1e-8, 1e-10, 1e-12),
}
LEVELS = (1e-2, 1e-4, 1e-6, 1e-8)


@dataclass(frozen=True, eq=False)
class CostCurve:
    """One method's runs, from the cheapest to the dearest.

    Attributes
    ----------
    setting : ndarray
        Step, or relative tolerance.
    nfev, wall_time, error : ndarray
        Evaluations of f, seconds, and final position error.
    """

    setting: np.ndarray
    nfev: np.ndarray
    wall_time: np.ndarray
    error: np.ndarray


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``work-precision``: none."""


def measure(repeats: int = REPEATS, callback: Any = None) -> tuple[dict[str, CostCurve], str]:
    """Run all methods.

    Parameters
    ----------
    repeats : int, optional
        The least time of so many runs counts.
    callback : callable, optional
        ``callback()`` after each run.

    Returns
    -------
    dict of str to CostCurve, and str
        By the methods' names, and the machine.
    """
    problem = kepler(t_end=T_END)
    adaptive = replace(problem, h=None)
    truth = integrate(problem, method=EIPDOP853, h=T_END / REFERENCE_STEPS, compensated=True).y[:2, -1]
    nfev: dict[tuple[str, float], int] = {}
    methods: dict[str, tuple[Runner, Sequence[float]]] = {}
    for method, counts in FIXED.items():
        methods[method.__name__] = (partial(_fixed, problem, method, nfev), [T_END / n for n in counts])
    for method, tolerances in PAIRS.items():
        methods[method.__name__] = (partial(_adaptive, adaptive, method, nfev), tolerances)
    result = work_precision(methods, lambda y: float(np.hypot(*(y[:2] - truth))), repeats=repeats, callback=callback)
    works = {}
    for name in methods:
        points = [point for point in result.points if point.method == name]
        works[name] = CostCurve(
            np.array([p.step for p in points]),
            np.array([nfev[name, p.step] for p in points]),
            np.array([p.wall_time for p in points]),
            np.array([p.error for p in points]),
        )
    return works, result.machine


def _fixed(problem: Problem, method: type[EIPSolver], nfev: dict[Any, int], step: float) -> tuple[float, np.ndarray]:
    name = f"{method.__name__}, h = {step:.3g}"
    return _noted(integrate(problem, method=named(method, name), h=step), method, nfev, step)


def _adaptive(problem: Problem, method: type[EIPSolver], nfev: dict[Any, int], rtol: float) -> tuple[float, np.ndarray]:
    name = f"{method.__name__}, rtol = {rtol:.0e}"
    return _noted(integrate(problem, method=named(method, name), rtol=rtol, atol=1e-3 * rtol), method, nfev, rtol)


def _noted(result: Any, method: type[EIPSolver], nfev: dict[Any, int], step: float) -> tuple[float, np.ndarray]:
    nfev[method.__name__, step] = result.nfev
    return result.wall_time, result.y[:, -1] if result.success else np.full(4, np.nan)


def text(works: dict[str, CostCurve], machine: str) -> str:
    """Lay out the cost of each method at some errors."""
    parts = [f"Work and precision: perturbed Kepler problem, e = 0.6, H and L kept, t = {T_END:g}", machine]
    for cost, unit, factor in (("nfev", "1000 evaluations of f", 1e-3), ("wall_time", "milliseconds", 1e3)):
        body = []
        for name, work in works.items():
            cells = [compact(factor * cost_to_reach(getattr(work, cost), work.error, level)) for level in LEVELS]
            body.append(
                (name, [f"<{cell}" if work.error[0] <= x else cell for x, cell in zip(LEVELS, cells, strict=True)])
            )
        cheapest = []
        for level in LEVELS:
            known = {name: cost_to_reach(getattr(work, cost), work.error, level) for name, work in works.items()}
            fixed = {name: known[name] for name in (method.__name__ for method in FIXED)}
            cheapest.append([_cheapest(fixed), _cheapest(known)])
        body.append(("cheapest with fixed step", [pair[0] for pair in cheapest]))
        body.append(("cheapest of all", [pair[1] for pair in cheapest]))
        head = [["error", compact(level, 1)] for level in LEVELS]
        parts += ["", f"{unit.capitalize()} for an error of the final position:", table(head, body)]
    parts += ["", '"<": the cheapest run is more accurate; "-": no run is as accurate.']
    return "\n".join(parts)


def _cheapest(known: dict[str, float]) -> str:
    finite = {name: cost for name, cost in known.items() if math.isfinite(cost)}
    return min(finite, key=finite.__getitem__) if finite else "-"


def rows(works: dict[str, CostCurve]) -> list[dict[str, Any]]:
    """Make the lines of the CSV file."""
    fixed = {method.__name__ for method in FIXED}
    return [
        {
            "method": name,
            "h": float(work.setting[k]) if name in fixed else None,
            "rtol": None if name in fixed else float(work.setting[k]),
            "nfev": int(work.nfev[k]),
            "wall_time_s": float(work.wall_time[k]),
            "position_error": float(work.error[k]),
        }
        for name, work in works.items()
        for k in range(work.error.size)
    ]


def run(args: argparse.Namespace) -> int:
    """Run the command.

    Parameters
    ----------
    args : argparse.Namespace
        With ``out``, ``json`` (Path or None) and ``quiet``.

    Returns
    -------
    int
        Exit status: 0 done, 130 interrupted.
    """
    from tqdm import tqdm

    check_outputs(args.out, args.json)
    total = REPEATS * sum(map(len, (*FIXED.values(), *PAIRS.values())))
    try:
        with tqdm(total=total, desc="error against cost", unit="run", disable=args.quiet, leave=False) as bar:
            works, machine = measure(REPEATS, bar.update)
    except KeyboardInterrupt:
        warn("interrupted; nothing was written")
        return INTERRUPTED
    found = rows(works)
    deliver(
        args,
        "work-precision",
        text(works, machine),
        {"work-precision.csv": found},
        _figures(works, machine),
        {},
        points=found,
    )
    return DONE


def _figures(works: dict[str, CostCurve], machine: str) -> Iterator[Any]:
    from ...plotting import work_figure

    yield (
        "work-precision.png",
        work_figure(
            {name: vars(work) for name, work in works.items()},
            error=f"error of position at t = {T_END:g}",
            title="Perturbed Kepler problem, e = 0.6, H and L kept: error against cost",
            footnote=f"{machine}; one thread, least of {REPEATS}",
        ),
    )
