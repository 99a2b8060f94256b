"""``eip-scipy reproduce table1 ... table5``: the paper's numbers compared with ours.

The paper's numbers, their misprints and the same computations in 50 digits are data: ``data/paper_tables.json``.
"""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass, field
from decimal import Decimal
from functools import cache
from importlib.resources import files
from itertools import groupby, pairwise
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from eip_scipy import EIPRK1, EIPRK2, EIPRK3, EIPRK4, ProjectionWarning, integrate, project
from eip_scipy.problems import Problem, harmonic, kepler
from eip_scipy.solvers import EIPSolver

from ..beside import workers
from ..condensates.problems import rotating_packet
from ..report import cores
from ..study import Check, Rows, Session, Study

TABLES = ("table1", "table2", "table3", "table4", "table5")
LONGEST = 5  # the table that takes minutes
OMEGA = 10.0
METHODS: dict[str, type[EIPSolver]] = {"RK1": EIPRK1, "RK2": EIPRK2, "RK3": EIPRK3, "RK4": EIPRK4}
# check=False: the paper's longest steps are far too long, which is known and need not be reported.
PAPER_SETTING: dict[str, Any] = {"metric": "euclidean", "reuse_f": False, "check": False}
WIDE, NARROW, DIGITS = 12, 9, 8  # columns of the printed tables


@dataclass(frozen=True)
class Value:
    """A number of the paper as printed, its misprints corrected, and the same number computed by this package.

    `ours` is in double precision, and `mpmath` in 50 digits (nan if this takes too long). `roundoff` is the largest
    change of the number that round-off may cause, and `printed` the misprint of the paper, if there is one.
    """

    paper: str
    ours: float
    mpmath: float
    roundoff: float
    printed: str | None = None

    @property
    def paper_digits(self) -> int:
        """Return the number of significant digits that the paper prints."""
        return len(Decimal(self.paper).as_tuple().digits)

    @property
    def digits(self) -> int:
        """Return the number of significant digits to which `paper` and `ours` agree when rounded."""
        paper, ours = Decimal(self.paper), Decimal(self.ours)
        for count in range(self.paper_digits, 0, -1):
            place = Decimal(1).scaleb(paper.adjusted() - count + 1)
            if paper.quantize(place) == ours.quantize(place):
                return count
        return 0

    @property
    def matched(self) -> bool:
        """Return whether every digit printed in the paper agrees with our number."""
        return self.digits == self.paper_digits

    @property
    def within_roundoff(self) -> bool:
        """Return True if our number is within round-off of the paper's number, or of the number in 50 digits.

        In the second case the paper's number differs by the paper's own round-off.
        """
        half_unit = 0.5 * 10.0 ** int(Decimal(self.paper).as_tuple().exponent)
        from_paper, from_exact = abs(self.ours - float(self.paper)), abs(self.ours - self.mpmath)
        return from_paper <= half_unit + self.roundoff or from_exact <= self.roundoff

    @property
    def status(self) -> str:
        """Return "matched", "round-off" or "differs"."""
        if self.matched:
            return "matched"
        return "round-off" if self.within_roundoff else "differs"

    def like_paper(self, value: float) -> str:
        """Return `value` in the notation and with the digits of the paper."""
        decimals = len(self.paper.partition("e")[0].partition(".")[2])
        return f"{value:.{decimals}{'e' if 'e' in self.paper else 'f'}}"


@dataclass(frozen=True)
class Cell:
    """A cell of one of the paper's tables: an error and its order of convergence, None for the first of a series."""

    table: int
    row: str
    column: str
    error: Value
    order: Value | None


@dataclass(frozen=True)
class Series:
    """The paper's numbers of one method at successively shorter steps, as they are stored.

    The lengths of the steps are `h` divided by each of `divisors`. `iterations` is the number of Newton steps of a
    projection, and `invariants` has the initials of the kept invariants, such as "HL". `errors` and `orders` are the
    numbers as printed, with the misprints corrected, and `mpmath` are the errors in 50 digits. `errata` has the
    misprints by the index of the error, and `Omega` is the angular velocity of the rotation in table 5.
    """

    table: int
    name: str
    method: str
    iterations: int
    invariants: str
    h: str
    divisors: list[int]
    errors: list[str]
    orders: list[str]
    mpmath: list[str] | None = None
    errata: dict[str, dict[str, str]] | None = None
    Omega: float = 0.0

    @property
    def steps(self) -> list[float]:
        """Return the lengths of the steps."""
        return [float(self.h) / d for d in self.divisors]

    @property
    def solver(self) -> type[EIPSolver]:
        """Return the solver class of the method."""
        return METHODS[self.method]


@cache
def _data() -> dict[str, Any]:
    return json.loads(files("eip_scipy_studies.data").joinpath("paper_tables.json").read_text(encoding="utf-8"))


@dataclass(frozen=True, kw_only=True)
class PaperTable(Study[list[Cell]]):
    """Study of one of the paper's tables in the paper's setting: fixed steps, euclidean metric.

    Table 5 takes minutes: 37500 steps on 128 x 128 points for each of nine columns. Its runs share the cores.
    """

    name: str
    processes: int = field(default_factory=cores)

    def measure(self, session: Session) -> list[Cell]:
        """Compute all numbers of the table, method by method, from the longest step to the shortest."""
        number = TABLES.index(self.name) + 1
        stored = [Series(**s) for s in _data()["series"] if s["table"] == number]
        cells = []
        with session.bar(len(stored), self.name, "column") as bar, ExitStack() as stack:
            errors: Callable[[Series], list[float]] = _ERRORS[number]
            if number == LONGEST and self.processes > 1:
                errors = _shared(stored, stack.enter_context(workers(self.processes)))
            for series in stored:
                cells += _cells(series, errors(series))
                bar.update()
        return cells

    def text(self, found: list[Cell]) -> str:
        return table_text(found)

    def checks(self, found: list[Cell]) -> list[Check]:
        """Check that no number differs by more than round-off."""
        return [Check(self.name, passed(found))]

    def tables(self, found: list[Cell]) -> dict[str, Rows]:
        data = self.numbers(found)
        kinds = (("cells", "error"), ("orders", "order"))
        return {
            f"{self.name}.csv": [{"quantity": quantity, **record} for kind, quantity in kinds for record in data[kind]]
        }

    def numbers(self, found: list[Cell]) -> dict[str, Any]:
        """Return all cells; the orders, which the paper prints in separate columns, form a second list."""
        orders = [_record(cell, cell.order) for cell in found if cell.order is not None]
        return {"cells": [_record(cell, cell.error) for cell in found], "orders": orders}


def _cells(series: Series, errors: list[float]) -> list[Cell]:
    """Return the cells of one series, whose errors computed by this package are `errors`."""
    about = _data()["tables"][str(series.table)]
    exact = [math.nan] * len(errors) if series.mpmath is None else [float(x) for x in series.mpmath]
    orders = _orders(series, errors, exact, about["roundoff"])
    cells = []
    for k, (printed, divisor) in enumerate(zip(series.errors, series.divisors, strict=True)):
        labels = {"name": series.name, "method": series.method, "h": series.h, "d": divisor}
        misprint = (series.errata or {}).get(str(k), {}).get("printed")
        error = Value(printed, errors[k], exact[k], about["roundoff"], misprint)
        cells.append(
            Cell(series.table, about["row"].format(**labels), about["column"].format(**labels), error, orders[k])
        )
    return cells


def _orders(series: Series, errors: list[float], exact: list[float], roundoff: float) -> list[Value | None]:
    """Return None for the longest step, and for each shorter one the order of convergence from the next longer step.

    `errors` are those of this package and `exact` those in 50 digits, for each length of the step. The `roundoff` of an
    order is how much round-off in its two errors may change it.
    """
    refinement = -np.diff(np.log(series.steps))
    observed, expected = (-np.diff(np.log(np.abs(values))) / refinement for values in (errors, exact))
    relative = roundoff / np.where(np.isnan(exact), errors, exact)
    slack = (relative[:-1] + relative[1:]) / refinement
    columns = zip(series.orders, observed, expected, slack, strict=True)
    return [None, *(Value(paper, float(ours), float(mpmath), float(s)) for paper, ours, mpmath, s in columns)]


def _multiplier_errors(series: Series) -> list[float]:
    """Return the errors in table 1, for the run with each step length."""
    return [_multiplier_error(series, h) for h in series.steps]


def _multiplier_error(series: Series, h: float) -> float:
    """Return |lambda_hat - lambda_star| in the last step of a run.

    lambda_hat is the multiplier of the projection, and lambda_star the paper's closed form, both at the same
    unprojected state.
    """
    problem = harmonic(OMEGA)
    sol = solve_ivp(
        problem.fun,
        problem.t_span,
        problem.y0,
        method=series.solver,
        h=h,
        invariants=problem.invariants,
        **PAPER_SETTING,
    )
    y_hat = _raw_step(series.solver, problem, sol.y[:, -2], sol.t[-1] - sol.t[-2])
    (invariant,) = problem.invariants
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ProjectionWarning)  # the paper's longest steps are shown on purpose
        y_new = project(y_hat, invariant, target=invariant.fun(0.0, problem.y0)).y
    gradient = OMEGA * y_hat
    # fsum, because BLAS rounds differently from machine to machine.
    lambda_hat = math.fsum((y_new - y_hat) * gradient) / math.fsum(gradient * gradient)
    lambda_star = -(1 - math.hypot(*problem.y0) / math.hypot(*y_hat)) / OMEGA
    return abs(lambda_hat - lambda_star)


def _raw_step(solver: type[EIPSolver], problem: Problem, y: np.ndarray, h: float) -> np.ndarray:
    """Return the state after a step without projection; the equations must not depend on time."""
    K = np.empty((solver.B.size, y.size))
    for i, row in enumerate(solver.A):
        K[i] = problem.fun(0.0, y + h * (row[:i] @ K[:i]))
    raw: np.ndarray = y + h * (solver.B @ K)
    return raw


def _last_defects(series: Series) -> list[float]:
    """Return the errors in tables 2 and 4: the change of the first kept invariant over a run, for each step length."""
    problem = harmonic(OMEGA) if series.table == 2 else kepler(eccentricity=0.6, relativistic=0.005)
    runs = (_run(problem, series, h).invariants[0] for h in series.steps)
    return [abs(float(values[-1] - values[0])) for values in runs]


def _differences(series: Series) -> list[float]:
    """Return the errors in table 3: largest differences of a component between the ends of runs with successive h."""
    problem = kepler(eccentricity=0.6, relativistic=0.005)
    return _changes([_run(problem, series, h).y[:, -1] for h in _refined(series)])


def _field_differences(series: Series) -> list[float]:
    """Return the errors in table 5: largest moduli of the difference between the final fields for successive h."""
    return _changes([_field_end(series, h) for h in _refined(series)])


def _shared(stored: list[Series], start: Callable[..., Callable[[], Any]]) -> Callable[[Series], list[float]]:
    """Queue the runs of all series in other processes, and return a function that replaces `_field_differences`.

    The returned function waits for the runs of a series, and returns the errors. Runs with most steps come first.
    `start` is the function that `workers` yields.
    """
    runs = [(series, h) for series in stored for h in _refined(series)]
    waiting = {(series.name, h): start(_field_end, series, h) for series, h in sorted(runs, key=lambda run: run[1])}
    return lambda series: _changes([waiting[series.name, h]() for h in _refined(series)])


def _refined(series: Series) -> list[float]:
    return [2 * series.steps[0], *series.steps]


def _field_end(series: Series, h: float) -> np.ndarray:
    problem = rotating_packet(series.Omega, nyquist="zero")
    end: np.ndarray = _run(problem, series, h, problem.t_span[1]).y[:, -1]
    return end


def _changes(ends: list[np.ndarray]) -> list[float]:
    return [float(np.abs(a - b).max()) for a, b in pairwise(ends)]


def _run(problem: Problem, series: Series, h: float, t_end: float = 1.0) -> Any:
    """Take round(t_end/h) steps of length h, and return the result: the paper's last steps do not all end on t = 1."""
    kept = [item for item in problem.invariants if item.name[0].upper() in series.invariants]
    return integrate(
        problem,
        (0.0, round(t_end / h) * h),
        method=series.solver,
        h=h,
        invariants=kept,
        iterations=series.iterations,
        compiled=False,  # the same bits; these runs are too short to be worth compiling
        **PAPER_SETTING,
    )


_ERRORS = {1: _multiplier_errors, 2: _last_defects, 3: _differences, 4: _last_defects, 5: _field_differences}


def passed(cells: Iterable[Cell]) -> bool:
    """Return True if no number in these cells differs by more than round-off."""
    return all(value.status != "differs" for cell in cells for value in (cell.error, cell.order) if value is not None)


def _record(cell: Cell, value: Value) -> dict[str, Any]:
    cause = _data()["tables"][str(cell.table)]["cause"]
    return {
        "table": cell.table,
        "row": cell.row,
        "column": cell.column,
        "paper": float(value.paper),
        "ours": value.ours,
        "mpmath": value.mpmath,
        "digits": value.digits,
        "paper_digits": value.paper_digits,
        "status": value.status,
        "cause": cause if value.status == "round-off" else None,
        "misprinted_as": None if value.printed is None else float(value.printed),
    }


def table_text(cells: list[Cell]) -> str:
    """Lay out one table as text."""
    about = _data()["tables"][str(cells[0].table)]
    labels = [(cell.row, cell.column) if cells[0].table == 2 else (cell.column, cell.row) for cell in cells]
    width = max(len(label) for pair in labels for label in pair)
    exact = any(not math.isnan(cell.error.mpmath) for cell in cells)
    lines = [f"Table {cells[0].table}: {about['title']}", f"         {about['problem']}", "", *_head(width, exact)]
    series = groupby(zip(labels, cells, strict=True), key=lambda item: item[0][0])
    for name, members in series:
        for k, ((_, step), cell) in enumerate(members):
            lines.append(f"{name if k == 0 else '':<{width}}  {step:<{width}}{_values_text(cell)}".rstrip())
    return "\n".join([*lines, "", *_summary(cells)])


def _head(width: int, exact: bool) -> list[str]:
    name = "mpmath" if exact else ""
    errors = f"{'paper':>{WIDE}}{'ours':>{WIDE}}{'digits':>{DIGITS}}{name:>{WIDE}}"
    orders = f"{'paper':>{NARROW}}{'ours':>{NARROW}}{'digits':>{DIGITS}}{name:>{NARROW}}"
    rules = ["  " + f" {name} ".center(len(group) - 2, "-") for name, group in (("error", errors), ("order", orders))]
    margin = " " * (2 * width + 2)
    return [margin + "".join(rules), margin + errors + orders]


def _values_text(cell: Cell) -> str:
    """Lay out the numbers of one line of the table, with those in 50 digits if a printed digit differs."""
    text = _value_text(cell.error, WIDE)
    if cell.order is not None:
        text += _value_text(cell.order, NARROW)
    if cell.error.printed is not None:
        text += f"  misprinted as {cell.error.printed}"
    return text


def _value_text(value: Value, width: int) -> str:
    exact = "" if value.matched or math.isnan(value.mpmath) else value.like_paper(value.mpmath)
    agree = f"{value.digits}/{value.paper_digits}" + ("!" if value.status == "differs" else " ")
    return f"{value.paper:>{width}}{value.like_paper(value.ours):>{width}}{agree:>{DIGITS}}{exact:>{width}}"


def _summary(cells: list[Cell]) -> list[str]:
    """Return lines that say how many numbers agree, and why the others do not."""
    errors = [cell.error for cell in cells]
    orders = [cell.order for cell in cells if cell.order is not None]
    counts = [f"{sum(v.matched for v in values)} of {len(values)}" for values in (errors, orders)]
    lines = [f"{counts[0]} errors and {counts[1]} orders agree to every printed digit."]
    statuses = [value.status for value in (*errors, *orders)]
    if "round-off" in statuses:
        about = _data()["tables"][str(cells[0].table)]
        lines.append(f"Round-off ({about['roundoff']:.1e}) explains {statuses.count('round-off')}: {about['cause']}.")
    if "differs" in statuses:
        lines.append(f"{statuses.count('differs')} marked ! DIFFER by more than round-off.")
    return lines
