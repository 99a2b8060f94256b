"""Definition of a run, its execution, and its result."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

import eip_scipy
from eip_scipy import EIPDOP853, Diagnostics, eip_method, ensemble, integrate
from eip_scipy.problems import Problem
from eip_scipy.solvers import EIPSolver

# Ways in which a run may report a fault, the clearest first.
ERROR, START, WARNING, FAILED, UNTRUSTED, SILENT = (
    "ValueError", "UserWarning", "ProjectionWarning", "status -1", "untrusted", "NOT TOLD",
)  # fmt: skip
CHANNELS = (ERROR, START, WARNING, FAILED, UNTRUSTED)


@dataclass(frozen=True)
class Run:
    """Definition of one run.

    `group` is the heading under which the tables list the run, and `name` names its system. `way` is "solve_ivp",
    "integrate" (compiled if the functions are jitted), "interpreted" (by integrate, not compiled), or "ensemble" (with
    y0s and perhaps params in the options). `sick`: whether the run is faulty and must be reported; for an ensemble, the
    indices of the faulty members. `truth`: if false, the true final state is not computed.
    """

    group: str
    name: str
    problem: Callable[[], Problem]
    method: type[EIPSolver]
    options: dict[str, Any] = field(default_factory=dict)
    way: str = "solve_ivp"
    sick: bool | tuple[int, ...] = True
    truth: bool = True

    @property
    def label(self) -> str:
        """Return method, step or tolerance, options and way of the run as text."""
        given = {key: value for key, value in self.options.items() if key in SHOWN}
        shown = ", ".join(
            f"{key} {value:g}" if isinstance(value, float) else f"{key} {value}" for key, value in given.items()
        )
        return f"{self.method.__name__}, {shown or 'own h'}, {self.way}"


SHOWN = ("h", "rtol", "every", "metric", "compensated", "direction", "iterations", "forces")


WAYS = ("solve_ivp", "integrate", "interpreted", "ensemble")


def runs(
    group: str,
    name: str,
    problem: Callable[[], Problem],
    ways: str,
    *,
    truth: bool = True,
    sick: bool | tuple[int, ...] = True,
    user: Any = None,
    **more: Any,
) -> Iterator[Run]:
    """Yield runs of one system, as the text `ways` describes: "RK45 1e-6, RK4 h=0.05 every=10 integrate".

    Each part names the method, then a tolerance or options, then the way if it is not "solve_ivp". The method "user" is
    the one-step method in `user`. Further options that are not text are given as keywords. All other arguments are
    fields of `Run`.
    """
    for text in ways.split(","):
        word, *rest = text.split()
        method = eip_method(user) if word == "user" else getattr(eip_scipy, f"EIP{word}")
        way = rest.pop() if rest and rest[-1] in WAYS else "solve_ivp"
        options = {key: value for item in rest for key, value in _option(item).items()}
        yield Run(group, name, problem, method, options | more, way, sick, truth)


def _option(item: str) -> dict[str, Any]:
    key, equals, value = item.partition("=")
    if item[0].isdigit():
        return {"rtol": float(item), "atol": 1e-2 * float(item)}
    if not equals:
        return {key: True}
    return {key: int(value) if value.isdigit() and key != "h" else float(value) if value[0].isdigit() else value}


@dataclass
class Outcome:
    """Result of a run: how a fault was reported (`told`), its last state, and its error with and without projection.

    `told` has those of the `CHANNELS` that reported a fault. For an ensemble, `flagged` has the indices of the members
    that are not reliable.
    """

    told: list[str]
    status: int | None = None
    t: float = math.nan
    y: np.ndarray | None = None
    message: str = ""
    error: float = math.nan
    plain_error: float = math.nan
    flagged: list[int] = field(default_factory=list)


def carry_out(run: Run) -> Outcome:
    """Carry out the run, and return its result with the warnings."""
    act = {"solve_ivp": _by_scipy, "ensemble": _members}.get(run.way, partial(_by_integrate, way=run.way))
    with warnings.catch_warnings(record=True) as said, np.errstate(all="ignore"):
        warnings.simplefilter("always")
        problem = run.problem()
        try:
            outcome = act(run, problem, run.options)
        except ValueError as error:
            outcome = Outcome([ERROR], message=str(error))
    if run.way != "ensemble" or not run.sick:  # each faulty member must be reported
        outcome.told += [name for name in map(_kind, said) if name is not None]
    outcome.told = [name for name in CHANNELS if name in outcome.told]
    outcome.message = "; ".join([outcome.message, *(str(item.message) for item in said if _kind(item))]).strip("; ")
    if outcome.y is not None and run.truth and run.way != "ensemble":
        outcome.error = _error(run, problem, outcome)
    return outcome


def carry_out_plain(run: Run, t: float) -> Outcome:
    """Carry out `run` without invariants, to the time `t` that it reached with invariants, and return the result."""
    problem = run.problem()
    options = {key: value for key, value in run.options.items() if key not in ("metric", "every")}
    options |= {"invariants": ()}
    act = _by_scipy if run.way == "solve_ivp" else partial(_by_integrate, way=run.way)
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        outcome = act(run, problem, options)
    if outcome.y is not None:
        outcome.error = _error(run, problem, outcome)
    return outcome


def _kind(warning: warnings.WarningMessage) -> str | None:
    if issubclass(warning.category, eip_scipy.ProjectionWarning):
        return WARNING
    return START if warning.category is UserWarning and "no invariant" in str(warning.message) else None


def _by_scipy(run: Run, problem: Problem, options: dict[str, Any]) -> Outcome:
    diagnostics = Diagnostics()
    own: dict[str, Any] = {"invariants": problem.invariants, "diagnostics": diagnostics}
    own |= {key: getattr(problem, key) for key in ("metric", "blocks", "frame") if getattr(problem, key) is not None}
    span = options.get("t_span", problem.t_span)
    given = {key: value for key, value in options.items() if key != "t_span"}
    adaptive = any(key in given for key in ("h", "rtol"))
    found = solve_ivp(
        problem.fun, span, problem.y0, method=run.method, **own | ({} if adaptive else {"h": problem.h}) | given
    )
    told = [FAILED] * (found.status < 0) + [UNTRUSTED] * (diagnostics.trusted is False)
    return Outcome(told, found.status, found.t[-1], found.y[:, -1], found.message)


def _by_integrate(run: Run, problem: Problem, options: dict[str, Any], way: str) -> Outcome:
    given: dict[str, Any] = {"h": None} if "rtol" in options else {}
    if way == "interpreted":
        given["compiled"] = False
    found = integrate(problem, method=run.method, **given | options)
    told = [FAILED] * (found.status < 0) + [UNTRUSTED] * (not found.trusted)
    return Outcome(told, found.status, found.t[-1], found.y[:, -1], found.message)


def _members(run: Run, problem: Problem, options: dict[str, Any]) -> Outcome:
    found = ensemble(problem, method=run.method, **options)
    flagged = np.flatnonzero((found.status < 0) | ~found.trusted).tolist()
    must = run.sick if isinstance(run.sick, tuple) else ()
    told = [UNTRUSTED] if flagged and flagged == list(must or flagged) else []
    return Outcome(told, int(found.status.min()), message=f"members {flagged[:9]} flagged", flagged=flagged)


def _error(run: Run, problem: Problem, outcome: Outcome) -> float:
    """Return the largest error of a component of the last state, relative to the largest true component."""
    truth = _truth(run.problem, outcome.t)
    assert outcome.y is not None
    return float(np.max(np.abs(outcome.y - truth)) / np.max(np.abs(truth)))


@cache
def _truth(make: Callable[[], Problem], t: float) -> np.ndarray:
    problem = make()
    known = None if problem.reference is None else problem.reference(t)
    if known is not None:
        return known
    span = (problem.t_span[0], t)
    if problem.rhs is not None:
        free = replace(problem, invariants=(), h=None)
        return integrate(free, span, method=EIPDOP853, rtol=1e-12, atol=1e-14).y[:, -1]
    return solve_ivp(problem.fun, span, problem.y0, method="DOP853", rtol=1e-12, atol=1e-14).y[:, -1]
