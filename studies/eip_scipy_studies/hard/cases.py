"""``eip-scipy hard-cases``: 35 problems with exact final states, with and without projection."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from textwrap import fill
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from eip_scipy import Diagnostics
from eip_scipy.solvers import EIPSolver

from ..hard_cases import HardCase, hard_cases
from ..long_runs import METRICS, fixed_step_methods, named, number
from ..report import compact, table
from ..study import Check, Figures, Rows, Session, Study, option

TOLERANCES = {"EIPDOP853": 1e-9}
USUAL_TOLERANCE = 1e-6
ATOL_PER_RTOL = 1e-3
TOLERANCE = number("a number from 1e-13 to 0.1", lambda value: 1e-13 <= value <= 0.1)

# Bounds, set for one tolerance of two methods; the last three for the error metric only.
SETTINGS = {("EIPRK45", 1e-6), ("EIPDOP853", 1e-9)}
SMALL_DRIFT, MAY_EXCEED, MEDIAN_DRIFT = 1e-9, 2, 1e-12
LEAST_GAIN = {"EIPRK45": 20.0, "EIPDOP853": 15.0}
WORST_GAIN = {"EIPRK45": 1 / 3}
LARGEST_ERROR = {"EIPDOP853": 1e-7}

NEIGHBOURS = (math.sqrt(10.0), 1 / math.sqrt(10.0))
# Reasons why projection does not help. Each was found from errors at five tolerances, with all metrics and directions.
CAUSES = {
    "kepler_e00": "the plain method is lucky: its phase lag, which grows as t, and the lead from its loss of energy, "
    "which grows as t^2, cancel near the end of this run. Projection takes away the second; the lag stays, with every "
    "metric and direction. In a run three times as long the projected error is half the plain one",
    "euler_top_tennis": "the plain method's error lies along the axis, its unstable components stay at 1e-14. At the "
    "saddle the two gradients are parallel to 1e-8, and a correction magnifies the round-off in H - C/i2 by 1e8",
    "arenstorf": "perturbations grow 2e6-fold, and the one invariant sees little of those at close encounters: which "
    "is smaller changes from one tolerance to the next",
    "oscillator": "the error is one of phase, along the orbit, where the invariant cannot see it; weighted corrections "
    "are not normal to the orbit and add to it",
    "vortices": "chaotic, and errors of equal size: which is smaller changes from one tolerance to the next",
    "fput": "the error is the phase of the stiff springs' oscillations, which the energy cannot see; weighted "
    "corrections restore the amplitudes but shift the phases, euclidean ones less",
    "kdv_zk": "mass and momentum see 3 % of the error",
}


@dataclass(frozen=True)
class CaseOutcome:
    """Result of one run; `failure` is the reason why it did not reach its end, empty if it did.

    `error` is the relative error of the final state, see `HardCase.error`, nan for a run that did not reach the end.
    `drift` is the largest relative change of an invariant, see `HardCase.drift`. For a run that raised an error it is
    nan, and the numbers of steps and evaluations of the right-hand side are 0. `rank_reduced` and
    `rejected_projections` are the numbers of projections with linearly dependent gradients, and of projections that
    failed.
    """

    error: float
    drift: float
    steps: int
    nfev: int
    failure: str = ""
    rank_reduced: int = 0
    rejected_projections: int = 0


@dataclass(frozen=True)
class Comparison:
    """A case without and with projection.

    For a case that gets worse by projection, `nearby` has three values of `gain`: at rtol times sqrt(10), at rtol
    divided by sqrt(10), and at rtol with the euclidean metric.
    """

    case: HardCase
    plain: CaseOutcome
    projected: CaseOutcome
    nearby: tuple[float, ...] = ()

    @property
    def gain(self) -> float:
        """Return the final error without projection divided by that with projection."""
        return _ratio(self.plain.error, self.projected.error)


def _ratio(a: float, b: float) -> float:
    return a / b if b > 0 else math.nan if math.isnan(b) else math.inf


def adaptive_methods() -> dict[str, type[EIPSolver]]:
    """Return the solver classes with adaptive steps for systems of the first order, by their names."""
    return {
        name: method
        for name, method in fixed_step_methods().items()
        if method.TABLEAU.has_estimate and not method.TABLEAU.of_second_order
    }


def solve(case: HardCase, method: type[EIPSolver], rtol: float, metric: str | None) -> CaseOutcome:
    """Run one case with one method; the `metric` None means no projection.

    A run that raises an error is returned as well, with the error as its `failure`.
    """
    problem, record = case.problem, Diagnostics()
    options: dict[str, Any] = {} if metric is None else {"invariants": problem.invariants, "metric": metric}
    try:
        with np.errstate(all="ignore"):  # trial steps may leave the domain
            sol = solve_ivp(
                problem.fun,
                problem.t_span,
                problem.y0,
                method=named(method, f"{method.__name__} on {problem.name}"),
                rtol=rtol,
                atol=ATOL_PER_RTOL * rtol,
                diagnostics=record,
                **options,
            )
            drift = case.drift(sol.y)
    except Exception as error:  # after any error the other cases are still to be run
        return CaseOutcome(math.nan, math.nan, 0, 0, f"{type(error).__name__}: {error}")
    failure = "" if sol.success else sol.message
    if not (failure or np.isfinite(sol.y).all()):
        failure = "the states are not finite"
    return CaseOutcome(
        math.nan if failure else case.error(sol.y[:, -1]),
        drift,
        sol.t.size - 1,
        sol.nfev,
        failure,
        0 if metric is None else record.n_rank_reduced,
        0 if metric is None else record.n_rejected_projections,
    )


def compare(
    cases: Iterable[HardCase],
    method: type[EIPSolver],
    rtol: float,
    metric: str,
    callback: Callable[[], Any] = lambda: None,
) -> list[Comparison]:
    """Run cases with and without projection, and call `callback()` after each case.

    A case whose error the projection increases is also run at neighbouring tolerances and in the euclidean metric.
    """
    done = []
    for case in cases:
        result = Comparison(case, solve(case, method, rtol, None), solve(case, method, rtol, metric))
        if result.gain < 1:
            nearby = [_ratio(*(solve(case, method, rtol * f, m).error for m in (None, metric))) for f in NEIGHBOURS]
            euclidean = solve(case, method, rtol, "euclidean").error
            result = replace(result, nearby=(*nearby, _ratio(result.plain.error, euclidean)))
        done.append(result)
        callback()
    return done


def geometric_mean(values: Iterable[float]) -> float:
    """Return the geometric mean of the finite positive values; nan if there are none."""
    logs = [math.log(x) for x in values if 0 < x < math.inf]
    return math.exp(sum(logs) / len(logs)) if logs else math.nan


def summary(results: Sequence[Comparison]) -> dict[str, Any]:
    """Return the numbers, by their names, that `bars` compares with bounds: of gain, drift and failures."""
    worst = min(results, key=lambda r: r.gain if r.gain == r.gain else -math.inf)
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


def bars(results: Sequence[Comparison], method: str, rtol: float, metric: str) -> list[Check]:
    """Check the results against bars: bounds on the number of failures, the drift and the errors.

    Bars on drift and errors are set for EIPRK45 at rtol = 1e-6 and EIPDOP853 at 1e-9 only, those on errors for the
    metric "error".
    """
    known = summary(results)
    found = [Check(f"every run with projection reaches its end: {known['n_failed']} did not", known["n_failed"] == 0)]
    if (method, rtol) not in SETTINGS:
        return found
    least = len(results) - MAY_EXCEED
    median, mean, worst = known["median_drift"], known["geometric_mean_gain"], known["worst_gain"]
    found += [
        Check(
            f"drift at most {compact(SMALL_DRIFT, 1)} in at least {least} cases: in {known['n_small_drift']}",
            known["n_small_drift"] >= least,
        ),
        Check(f"median of the drift at most {compact(MEDIAN_DRIFT, 1)}: {compact(median)}", median <= MEDIAN_DRIFT),
    ]
    if metric != "error":
        return found
    at_least = LEAST_GAIN[method]
    found.append(
        Check(f"geometric mean of the errors' reduction at least {at_least:g}: {compact(mean, 3)}", mean >= at_least)
    )
    if method in WORST_GAIN:
        at_most = 1 / WORST_GAIN[method]
        found.append(
            Check(
                f"no error more than {at_most:g} times that without projection: {_times(worst)}",
                worst >= WORST_GAIN[method],
            )
        )
    if method in LARGEST_ERROR:
        limit = LARGEST_ERROR[method]
        above = [r.case.name for r in results if r.plain.error < limit and not r.projected.error <= limit]
        found.append(
            Check(
                f"no error above {compact(limit, 1)} where that without projection is below it: "
                f"{', '.join(above) or 'none'}",
                not above,
            )
        )
    return found


def _times(gain: float) -> str:
    """Format a gain (error without projection by error with it) as "2.7 times worse" or "310 times better"."""
    if not math.isfinite(gain):
        return "-"
    factor, word = (gain, "better") if gain >= 1 else (1 / gain, "worse")
    return f"{factor:.2f} times {word}" if factor < 1.095 else f"{compact(factor)} times {word}"


def text(results: Sequence[Comparison], checks: Sequence[Check], arguments: dict[str, Any]) -> str:
    """Return table, summary, cases that projection makes worse, and checks as text of at most 79 columns.

    `arguments` are those of `HardCases.arguments`: the method, the metric and the tolerances of the runs.
    """
    known, rtol = summary(results), arguments["rtol"]
    head = [
        f"Hard cases: {arguments['method']}, metric {arguments['metric']!r}, rtol = {rtol:g}, atol = {rtol / 1000:g}",
        "Errors of the final state, relative to its largest component, in units of rtol.",
        "Gain: error without projection (plain) over error with it (EIP).",
        "Drift: largest relative change of an invariant, over all steps.",
        "",
    ]
    columns = [["error", "plain"], ["", "EIP"], ["gain"], ["drift", "plain"], ["", "EIP"]]
    columns += [["steps", "plain"], ["", "EIP"], ["nfev", "plain"], ["", "EIP"]]
    body = [(r.case.name, _cells(r, rtol)) for r in results]
    mean, worst = known["geometric_mean_gain"], known["worst_gain"]
    lines = [
        "",
        f"Geometric mean of the reduction of the error: {compact(mean, 3)}.",
        f"Least: {_times(worst)} ({known['worst_case']}).",
        f"Drift at most {compact(SMALL_DRIFT, 1)} in {known['n_small_drift']} of {known['n_cases']}; "
        f"median {compact(known['median_drift'])}.",
        "",
        *_failures(results),
        *_worse(results),
        *(check.line for check in checks),
    ]
    return "\n".join([*head, table(columns, body), *lines])


def _cells(result: Comparison, rtol: float) -> list[str]:
    plain, projected = result.plain, result.projected
    errors = [compact(plain.error / rtol), compact(projected.error / rtol), compact(result.gain)]
    counts = [str(n) for n in (plain.steps, projected.steps, plain.nfev, projected.nfev)]
    return [*errors, compact(plain.drift, 1), compact(projected.drift, 1), *counts]


def _failures(results: Sequence[Comparison]) -> list[str]:
    found = [
        fill(f"{r.case.name}, {kind}: {outcome.failure}", 79, initial_indent="  ", subsequent_indent="    ")
        for r in results
        for kind, outcome in (("plain", r.plain), ("EIP", r.projected))
        if outcome.failure
    ]
    return ["Failed:", *found, ""] if found else []


def _worse(results: Sequence[Comparison]) -> list[str]:
    worse = sorted((r for r in results if r.gain < 1), key=lambda r: r.gain)
    if not worse:
        return ["No case gets worse.", ""]
    lines = ["Cases that get worse, and why:"]
    for result in worse:
        more, less, euclidean = (compact(gain) for gain in result.nearby)
        measured = f"Gain at rtol x 3.2: {more}, at rtol / 3.2: {less}; euclidean metric: {euclidean}."
        words = f"{result.case.name}, {_times(result.gain)}: {cause(result)}. {measured}"
        lines.append(fill(words, 79, initial_indent="  ", subsequent_indent="    "))
    return [*lines, ""]


def cause(result: Comparison) -> str:
    """Return why projection makes a case worse.

    If this is not known, return whether projection also does so at neighbouring tolerances.
    """
    if result.case.name in CAUSES:
        return CAUSES[result.case.name]
    if geometric_mean([result.gain, *result.nearby[:2]]) >= 1:
        return "scatter: over neighbouring tolerances projection gains"
    return "not known; it is worse at neighbouring tolerances, too"


def rows(results: Sequence[Comparison]) -> list[dict[str, Any]]:
    """Return the rows of the CSV file: for each case a dictionary of values by the names of the columns."""
    lines: list[dict[str, Any]] = []
    for r in results:
        line: dict[str, Any] = {"case": r.case.name, "gain": r.gain}
        for kind, outcome in (("plain", r.plain), ("projected", r.projected)):
            line |= {f"{kind}_{name}": getattr(outcome, name) for name in ("error", "drift", "steps", "nfev")}
            line[f"{kind}_failure"] = outcome.failure or None
        line |= {name: getattr(r.projected, name) for name in ("rank_reduced", "rejected_projections")}
        line["cause"] = cause(r) if r.gain < 1 else None
        lines.append(line)
    return lines


@dataclass(frozen=True, kw_only=True)
class HardCases(Study[list[Comparison]]):
    """Command ``eip-scipy hard-cases``."""

    method: str = option("EIPRK45", "the adaptive method (default: %(default)s)", choices=list(adaptive_methods()))
    rtol: float | None = option(
        None,
        "relative tolerance (default: 1e-9 for EIPDOP853, else 1e-6); atol is 0.001 of it",
        type=TOLERANCE,
    )
    metric: str = option("error", "metric of the projection (default: %(default)s)", choices=METRICS)
    cases: Sequence[HardCase] = field(default_factory=hard_cases)

    @property
    def tolerance(self) -> float:
        """Return the relative tolerance."""
        return self.rtol or TOLERANCES.get(self.method, USUAL_TOLERANCE)

    def arguments(self) -> dict[str, Any]:
        """Return the method, the metric, rtol and atol of the runs, by name."""
        rtol = self.tolerance
        return {"method": self.method, "rtol": rtol, "atol": ATOL_PER_RTOL * rtol, "metric": self.metric}

    def measure(self, session: Session) -> list[Comparison]:
        with session.bar(len(self.cases), "hard cases", "case") as bar:
            return compare(self.cases, adaptive_methods()[self.method], self.tolerance, self.metric, bar.update)

    def checks(self, found: list[Comparison]) -> list[Check]:
        return bars(found, self.method, self.tolerance, self.metric)

    def text(self, found: list[Comparison]) -> str:
        return text(found, self.checks(found), self.arguments())

    @property
    def _stem(self) -> str:
        return f"hard-cases-{self.method}-{self.metric}"

    def tables(self, found: list[Comparison]) -> dict[str, Rows]:
        return {f"{self._stem}.csv": rows(found)}

    def numbers(self, found: list[Comparison]) -> dict[str, Any]:
        checks = [check.entry for check in self.checks(found)]
        return {"cases": rows(found), "summary": summary(found), "checks": checks}

    def figures(self, found: list[Comparison]) -> Figures:
        from ..plotting import gains_figure

        rtol = self.tolerance
        yield (
            f"{self._stem}.png",
            gains_figure(
                {r.case.name: (r.plain.error / rtol, r.projected.error / rtol) for r in found},
                what="final error / rtol",
                title=f"{self.method}, metric {self.metric!r}, rtol = {rtol:g}: {len(found)} hard cases",
            ),
        )
