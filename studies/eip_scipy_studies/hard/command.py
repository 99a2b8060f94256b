"""``eip-scipy hard-cases``: 35 problems with exact final states, with and without projection."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from textwrap import fill
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

import eip_scipy

from ..hard_cases import HardCase
from ..hard_cases import hard_cases as made
from ..output import Output
from ..report import UsageError, compact, table

ATOL_PER_RTOL = 1e-3
NEIGHBOURS = (math.sqrt(10.0), 1 / math.sqrt(10.0))
Method = Literal["EIPRK2", "EIPRK3", "EIPRK4", "EIPRK5", "EIPRK23", "EIPRK45", "EIPDOP853", "EIPBDF", "EIPRadau"]
# Bounds, set for one tolerance of two methods; the last three for the error metric only.
SETTINGS = {("EIPRK45", 1e-6), ("EIPDOP853", 1e-9)}
SMALL_DRIFT, MAY_EXCEED, MEDIAN_DRIFT = 1e-9, 2, 1e-12
LEAST_GAIN = {"EIPRK45": 20.0, "EIPDOP853": 15.0}
MOST_WORSE, LARGEST_ERROR = 3.0, 1e-7  # of EIPRK45, of EIPDOP853


class Outcome(NamedTuple):
    """Result of one run: `error` and `drift` are those of `HardCase`, and `failure` says why it did not reach its end.

    `rank_reduced` and `rejected_projections` are the numbers of projections with linearly dependent gradients, and of
    projections that failed.
    """

    error: float = math.nan
    drift: float = math.nan
    steps: int = 0
    nfev: int = 0
    failure: str | None = None
    rank_reduced: int = 0
    rejected_projections: int = 0


class Comparison(NamedTuple):
    """A case without and with projection.

    For a case that gets worse by projection, `nearby` has three values of `gain`: at rtol times sqrt(10), at rtol
    divided by sqrt(10), and at rtol with the euclidean metric.
    """

    case: HardCase
    plain: Outcome
    projected: Outcome
    nearby: tuple[float, ...] = ()

    @property
    def gain(self) -> float:
        """Return the final error without projection divided by that with projection."""
        return ratio(self.plain.error, self.projected.error)


def hard_cases(
    out: Output,
    *,
    cases: tuple[str, ...] = (),
    method: Method = "EIPRK45",
    rtol: float | None = None,
    metric: Literal["error", "euclidean"] = "error",
) -> None:
    """Run 35 hard cases with and without projection, and compare the errors of their final states.

    Parameters
    ----------
    cases : tuple of str
        names of the cases to run (default: all)
    method : str
        the adaptive method (default: EIPRK45)
    rtol : float
        relative tolerance (default: 1e-9 for EIPDOP853, else 1e-6); atol is 0.001 of it
    metric : str
        metric of the projection (default: error)
    """
    rtol = (1e-9 if method == "EIPDOP853" else 1e-6) if rtol is None else rtol
    if not 1e-13 <= rtol <= 0.1:
        raise UsageError(f"--rtol: expected a number from 1e-13 to 0.1, got {rtol:g}")
    try:
        chosen = made(cases or None)
    except ValueError as error:
        raise UsageError(f"--cases: {error}") from None
    results = [compare(case, method, rtol, metric) for case in out.bar(chosen, "hard cases", unit="case")]
    known = summary(results)
    out.numbers |= {"rtol": rtol, "atol": ATOL_PER_RTOL * rtol, "cases": [*map(row, results)], "summary": known}
    stem, title = f"hard-cases-{method}-{metric}", f"{method}, metric {metric!r}, rtol = {rtol:g}"
    out.rows(f"{stem}.csv", out.numbers["cases"])
    out.figure(f"{stem}.png", "hard.figures:gains_figure", results, rtol, title)
    out.text(text(results, known, f"Hard cases: {title}, atol = {rtol / 1000:g}", rtol))
    for line, passed in bars(results, known, method, rtol, metric):
        out.check(line, passed)


def ratio(a: float, b: float) -> float:
    """Return a / b, or inf if b is 0."""
    return a / b if b > 0 else math.nan if math.isnan(b) else math.inf


def solve(case: HardCase, method: str, rtol: float, metric: str | None) -> Outcome:
    """Run one case with one method; the `metric` None means no projection. An error of the run is its `failure`."""
    problem, record = case.problem, eip_scipy.Diagnostics()
    options: dict[str, Any] = {"invariants": problem.invariants, "metric": metric} if metric else {}
    options |= {"method": getattr(eip_scipy, method), "rtol": rtol, "atol": ATOL_PER_RTOL * rtol, "diagnostics": record}
    try:
        with np.errstate(all="ignore"):  # trial steps may leave the domain
            sol = solve_ivp(problem.fun, problem.t_span, problem.y0, **options)
            drift = case.drift(sol.y)
    except Exception as raised:  # after any error the other cases are still to be run
        return Outcome(failure=f"{type(raised).__name__}: {raised}")
    failure = None if np.isfinite(sol.y).all() else "the states are not finite"
    failure = failure if sol.success else sol.message
    error = math.nan if failure else case.error(sol.y[:, -1])
    counts = (record.n_rank_reduced, record.n_rejected_projections) if metric else (0, 0)
    return Outcome(error, drift, sol.t.size - 1, sol.nfev, failure, *counts)


def compare(case: HardCase, method: str, rtol: float, metric: str) -> Comparison:
    """Run a case with and without projection; see `Comparison` for a case that gets worse."""
    plain = solve(case, method, rtol, None)
    result = Comparison(case, plain, solve(case, method, rtol, metric))
    if not result.gain < 1:
        return result
    nearby = [ratio(*(solve(case, method, rtol * f, m).error for m in (None, metric))) for f in NEIGHBOURS]
    return result._replace(nearby=(*nearby, ratio(plain.error, solve(case, method, rtol, "euclidean").error)))


def geometric_mean(values: Iterable[float]) -> float:
    """Return the geometric mean of the finite positive values; nan if there are none."""
    logs = [math.log(x) for x in values if 0 < x < math.inf]
    return math.exp(sum(logs) / len(logs)) if logs else math.nan


def summary(results: Sequence[Comparison]) -> dict[str, Any]:
    """Return the numbers, by their names, that `bars` compares with bounds: of gain, drift and failures."""
    worst = min(results, key=lambda r: -math.inf if math.isnan(r.gain) else r.gain)
    drifts = [r.projected.drift for r in results]
    return {
        "geometric_mean_gain": geometric_mean(r.gain for r in results),
        "worst_gain": worst.gain,
        "worst_case": worst.case.name,
        "n_small_drift": sum(drift <= SMALL_DRIFT for drift in drifts),
        "n_cases": len(results),
        "median_drift": float(np.median(drifts)),
        "n_failed": sum(bool(r.projected.failure) for r in results),
    }


def bars(
    results: Sequence[Comparison], known: Mapping[str, Any], method: str, rtol: float, metric: str
) -> list[tuple[str, bool]]:
    """Compare results and their `summary` with bounds; return texts, and whether the bounds are met."""
    least = len(results) - MAY_EXCEED
    failed, small, median = known["n_failed"], known["n_small_drift"], known["median_drift"]
    mean, worst = known["geometric_mean_gain"], known["worst_gain"]
    found = [(f"every run with projection reaches its end: {failed} did not", failed == 0)]
    if (method, rtol) not in SETTINGS:
        return found
    found += [
        (f"drift at most {compact(SMALL_DRIFT, 1)} in at least {least} cases: in {small}", small >= least),
        (f"median of the drift at most {compact(MEDIAN_DRIFT, 1)}: {compact(median)}", median <= MEDIAN_DRIFT),
    ]
    if metric != "error":
        return found
    bound = LEAST_GAIN[method]
    found.append((f"geometric mean of the errors' reduction at least {bound:g}: {compact(mean, 3)}", mean >= bound))
    if method == "EIPRK45":
        line = f"no error more than {MOST_WORSE:g} times that without projection: {times(worst)}"
        return [*found, (line, worst >= 1 / MOST_WORSE)]
    above = [r.case.name for r in results if r.plain.error < LARGEST_ERROR and not r.projected.error <= LARGEST_ERROR]
    line = f"no error above {compact(LARGEST_ERROR, 1)} where that without projection is below it"
    return [*found, (f"{line}: {', '.join(above) or 'none'}", not above)]


def times(gain: float) -> str:
    """Format a gain (error without projection by error with it) as "2.7 times worse" or "310 times better"."""
    if not math.isfinite(gain):
        return "-"
    factor, word = (gain, "better") if gain >= 1 else (1 / gain, "worse")
    return f"{factor:.2f} times {word}" if factor < 1.095 else f"{compact(factor)} times {word}"


def text(results: Sequence[Comparison], known: Mapping[str, Any], title: str, rtol: float) -> str:
    """Return table, summary and the cases that projection makes worse as text of at most 79 columns."""
    columns = [["error", "plain"], ["", "EIP"], ["gain"]]
    columns += [lines for what in ("drift", "steps", "nfev") for lines in ([what, "plain"], ["", "EIP"])]
    kinds = [(r.case.name, kind, o.failure) for r in results for kind, o in (("plain", r.plain), ("EIP", r.projected))]
    failed = [f"{name}, {kind}: {failure}" for name, kind, failure in kinds if failure]
    worse = [why(r) for r in sorted(results, key=lambda r: r.gain) if r.gain < 1]
    parts = [
        f"{title}\n"
        "Errors of the final state, relative to its largest component, in units of rtol.\n"
        "Gain: error without projection (plain) over error with it (EIP).\n"
        "Drift: largest relative change of an invariant, over all steps.",
        table(columns, [(r.case.name, cells(r, rtol)) for r in results]),
        f"Geometric mean of the reduction of the error: {compact(known['geometric_mean_gain'], 3)}.\n"
        f"Least: {times(known['worst_gain'])} ({known['worst_case']}).\n"
        f"Drift at most {compact(SMALL_DRIFT, 1)} in {known['n_small_drift']} of {known['n_cases']}; "
        f"median {compact(known['median_drift'])}.",
        *(listed("Failed:", failed) if failed else []),
        *(listed("Cases that get worse, and why:", worse) if worse else ["No case gets worse."]),
    ]
    return "\n\n".join(parts) + "\n"


def listed(title: str, lines: Sequence[str]) -> list[str]:
    """Return a part of the text: indented lines below a title."""
    return ["\n".join([title, *(fill(line, 79, initial_indent="  ", subsequent_indent="    ") for line in lines)])]


def cells(result: Comparison, rtol: float) -> list[str]:
    """Return the cells of the table for one case."""
    plain, projected = result.plain, result.projected
    errors = [compact(plain.error / rtol), compact(projected.error / rtol), compact(result.gain)]
    counts = [str(n) for n in (plain.steps, projected.steps, plain.nfev, projected.nfev)]
    return [*errors, compact(plain.drift, 1), compact(projected.drift, 1), *counts]


def why(result: Comparison) -> str:
    """Describe a case that gets worse, with its cause."""
    more, less, euclidean = map(compact, result.nearby)
    measured = f"Gain at rtol x 3.2: {more}, at rtol / 3.2: {less}; euclidean metric: {euclidean}."
    return f"{result.case.name}, {times(result.gain)}: {cause(result)}. {measured}"


def cause(result: Comparison) -> str:
    """Return why projection makes a case worse; if unknown, whether it does so at neighbouring tolerances, too."""
    if result.case.cause:
        return result.case.cause
    if geometric_mean([result.gain, *result.nearby[:2]]) >= 1:
        return "scatter: over neighbouring tolerances projection gains"
    return "not known; it is worse at neighbouring tolerances, too"


def row(result: Comparison) -> dict[str, Any]:
    """Return a row of the CSV file: the values by the names of the columns."""
    line: dict[str, Any] = {"case": result.case.name, "gain": result.gain}
    for kind, outcome in (("plain", result.plain), ("projected", result.projected)):
        line |= {f"{kind}_{name}": getattr(outcome, name) for name in Outcome._fields[:5]}
    line |= {name: getattr(result.projected, name) for name in Outcome._fields[5:]}
    return line | {"cause": cause(result) if result.gain < 1 else None}
