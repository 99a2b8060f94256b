"""Definition of a run, as a row of the table describes it, its execution, and its result."""

from __future__ import annotations

import ast
import math
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

import eip_scipy
from eip_scipy import EIPDOP853, Diagnostics, ensemble, integrate
from eip_scipy.problems import Problem
from eip_scipy.solvers import EIPSolver

from . import systems

# Ways in which a run may report a fault, the clearest first.
ERROR, START, WARNING, FAILED, UNTRUSTED = CHANNELS = (
    "ValueError", "UserWarning", "ProjectionWarning", "status -1", "untrusted",
)  # fmt: skip
SILENT = "NOT TOLD"
SHOWN = ("h", "rtol", "every", "metric", "compensated", "direction", "iterations")
WAYS = ("solve_ivp", "integrate", "interpreted", "ensemble")


@dataclass(frozen=True)
class Run:
    """Definition of one run.

    `group` is the heading under which the tables list the run, and `name` names its system. `way` is one of `WAYS`:
    "integrate" compiles if the functions are jitted, "interpreted" is integrate without compilation. `faulty`: whether
    the run must be reported; for an ensemble, the indices of the faulty members. Without `truth` the true final state
    is not computed.
    """

    group: str
    name: str
    problem: Callable[[], Problem]
    method: type[EIPSolver]
    options: dict[str, Any]
    way: str
    faulty: bool | tuple[int, ...]
    truth: bool = True

    @property
    def label(self) -> str:
        """Return method, step or tolerance, options and way of the run as text."""
        given = {key: value for key, value in self.options.items() if key in SHOWN}
        shown = [f"{key} {value:g}" if isinstance(value, float) else f"{key} {value}" for key, value in given.items()]
        return f"{self.method.__name__}, {', '.join(shown) or 'own h'}, {self.way}"


def parsed(table: str, faulty: bool, ensembles: dict[str, tuple[Any, dict[str, Any]]]) -> Iterator[Run]:
    """Yield the runs of a table.

    Below a line "= group" there is a row for each system: "name | system | ways". The system is a function of `systems`
    or of the package with its arguments, and each way has a method, a tolerance or options, and one of `WAYS` if it is
    not "solve_ivp". What follows a semicolon holds for all ways of the row. Indented lines continue a row. A fourth
    column may have ``truth=False``, ``ensemble=NAME`` (a key of `ensembles`, which has the faulty members and the
    options), or ``each=(...)``, whose values replace the "%" of the row.
    """
    group = ""
    for row in table.strip().replace("\n    ", " ").splitlines():
        if row.startswith("= "):
            group = row[2:]
            continue
        *columns, more = row.split(" | ") if row.count(" | ") == 3 else (*row.split(" | "), "")
        extra = words(more)[1]
        for value in extra.get("each", ("%",)):
            name, system, ways = (column.replace("%", str(value)) for column in columns)
            (maker, *args), params = words(system)
            made = partial(systems.maker(maker), *args, **params)
            members, options = ensembles[extra["ensemble"]] if "ensemble" in extra else (faulty, {})
            ways, _, common = ways.partition("; ")
            for way in ways.split(","):
                yield Run(group, name, made, *_way(f"{way} {common}", options), members, extra.get("truth", True))


def words(text: str) -> tuple[list[Any], dict[str, Any]]:
    """Read words and ``key=value`` pairs; what is no literal of Python is text."""
    found, named = [], {}
    for word in text.split():
        key, equals, value = word.rpartition("=")
        try:
            read = ast.literal_eval(value)
        except (ValueError, SyntaxError):
            read = value
        if equals:
            named[key] = read
        else:
            found.append(read)
    return found, named


def _way(text: str, options: dict[str, Any]) -> tuple[type[EIPSolver], dict[str, Any], str]:
    """Return the method, the options and the way of ``"METHOD [RTOL] [OPTION...] [WAY]"``."""
    method, *rest = text.split()
    given: dict[str, Any] = {}
    for word in rest:
        flags, named = words(word)
        given |= named | {"h": float(named["h"])} if "h" in named else named
        for flag in flags:
            given |= {"rtol": float(flag), "atol": 1e-2 * flag} if not isinstance(flag, str) else {flag: True}
    way = next((word for word in WAYS if given.pop(word, False)), WAYS[0])
    if "events" in given:
        given["events"] = systems.EVENTS[given["events"]]
    return systems.METHODS.get(method) or getattr(eip_scipy, f"EIP{method}"), given | options, way


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
    with warnings.catch_warnings(record=True) as said, np.errstate(all="ignore"):
        warnings.simplefilter("always")
        problem = run.problem()
        try:
            outcome = _members(run, problem) if run.way == "ensemble" else _single(run, problem, run.options)
        except ValueError as error:
            outcome = Outcome([ERROR], message=str(error))
    heard = [(kind, str(item.message)) for item in said if (kind := _kind(item))]
    if run.way != "ensemble" or not run.faulty:  # each faulty member must be reported
        outcome.told += [kind for kind, _ in heard]
    outcome.told = [name for name in CHANNELS if name in outcome.told]
    outcome.message = "; ".join([outcome.message, *(text for _, text in heard)]).strip("; ")
    if outcome.y is not None and run.truth:
        outcome.error = _error(run, problem, outcome)
    return outcome


def carry_out_plain(run: Run, t: float) -> float:
    """Carry out `run` without invariants, to the time `t` that it reached with invariants, and return its error."""
    problem = run.problem()
    options = {key: value for key, value in run.options.items() if key not in ("metric", "every")}
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        return _error(run, problem, _single(run, problem, options | {"invariants": ()}))


def _kind(warning: warnings.WarningMessage) -> str | None:
    if issubclass(warning.category, eip_scipy.ProjectionWarning):
        return WARNING
    return START if warning.category is UserWarning and "not an invariant" in str(warning.message) else None


def _single(run: Run, problem: Problem, options: dict[str, Any]) -> Outcome:
    if run.way == "solve_ivp":
        record = Diagnostics()
        own: dict[str, Any] = {"invariants": problem.invariants, "diagnostics": record}
        own |= {
            key: getattr(problem, key)
            for key in ("metric", "blocks", "linear_invariants")
            if getattr(problem, key) is not None
        }
        own |= {} if {"h", "rtol"} & options.keys() else {"h": problem.h}
        found = solve_ivp(problem.fun, problem.t_span, problem.y0, method=run.method, **own | options)
        trusted = record.trusted is not False
    else:
        given: dict[str, Any] = {"h": None} if "rtol" in options else {}
        given |= {"compiled": False} if run.way == "interpreted" else {}
        found = integrate(problem, method=run.method, **given | options)
        trusted = found.trusted
    told = [FAILED] * (found.status < 0) + [UNTRUSTED] * (not trusted)
    return Outcome(told, found.status, found.t[-1], found.y[:, -1], found.message)


def _members(run: Run, problem: Problem) -> Outcome:
    free: dict[str, Any] = {"h": None} if "rtol" in run.options else {}
    found = ensemble(problem, method=run.method, **free | run.options)
    flagged = np.flatnonzero((found.status < 0) | ~found.trusted).tolist()
    as_wanted = not isinstance(run.faulty, tuple) or flagged == list(run.faulty)
    told = [UNTRUSTED] if flagged and as_wanted else []
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
