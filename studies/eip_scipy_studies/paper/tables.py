"""The paper's tables 1 to 5 recomputed in its setting, and compared with the printed numbers.

The paper's numbers, their misprints and the same computations in 50 digits are data: ``data/paper_tables.json``.
"""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import nullcontext
from decimal import Decimal
from importlib.resources import files
from itertools import groupby, pairwise
from typing import Any

import numpy as np

from eip_scipy import EIPRK1, EIPRK2, EIPRK3, EIPRK4, ProjectionWarning, integrate, project
from eip_scipy.problems import harmonic, kepler

from ..condensates.problems import rotating_packet
from ..output import Output, processes
from ..report import cores

OMEGA = 10.0
METHODS = {"RK1": EIPRK1, "RK2": EIPRK2, "RK3": EIPRK3, "RK4": EIPRK4}
DATA = json.loads(files("eip_scipy_studies.data").joinpath("paper_tables.json").read_text(encoding="utf-8"))
LONGEST = 5  # the table that takes minutes
# check=False, because the paper's longest steps are far too long on purpose.
SETTING: dict[str, Any] = {"metric": "euclidean", "reuse_f": False, "check": False, "compiled": False, "save_every": 1}

Series = dict[str, Any]
"""One method at shorter and shorter steps, as it is stored: an entry of "series" in the data."""


def table(out: Output, number: int) -> None:
    """Recompute one of the tables, and check that no number differs from the paper's by more than round-off.

    Table 5 takes minutes: 37500 steps on 128 x 128 points for each of nine columns. Its runs share the cores.
    """
    stored = [series for series in DATA["series"] if series["table"] == number]
    found: list[dict[str, Any]] = []
    with processes(cores()) if number == LONGEST else nullcontext() as pool:
        ends = in_processes(pool, stored) if pool else end
        for series in out.bar(stored, f"table{number}", unit="column"):
            found += rows_of(series, errors(series, ends))
    numbers = {"paper": float, "misprinted_as": lambda text: text and float(text)}
    rows = [row | {key: convert(row[key]) for key, convert in numbers.items()} for row in found]
    by_quantity = {kind: [row for row in rows if row["quantity"] == kind] for kind in ("error", "order")}
    out.rows(f"table{number}.csv", by_quantity["error"] + by_quantity["order"])
    for key, kind in (("cells", "error"), ("orders", "order")):
        out.numbers.setdefault(key, []).extend(by_quantity[kind])
    out.text(text(found))
    out.check(f"table{number}: no number differs by more than round-off", all(r["status"] != "differs" for r in rows))


def run(problem: Any, series: Series, h: float, t_end: float = 1.0, **more: Any) -> Any:
    """Take round(t_end/h) steps of length h: the paper's last steps do not all end on t = 1."""
    kept = [item for item in problem.invariants if item.name[0].upper() in series["invariants"]]
    options = SETTING | {"invariants": kept, "iterations": series["iterations"]} | more
    return integrate(problem, (0.0, round(t_end / h) * h), method=METHODS[series["method"]], h=h, **options)


def multiplier(series: Series, h: float) -> float:
    """Return the error of table 1: the projection's multiplier in the last step, less the paper's closed form of it."""
    problem, method = harmonic(OMEGA), METHODS[series["method"]]
    found = integrate(problem, method=method, h=h, **SETTING)
    y, h = found.y[:, -2], found.t[-1] - found.t[-2]
    K = np.empty((method.B.size, y.size))
    for i, row in enumerate(method.A):
        K[i] = problem.fun(0.0, y + h * (row[:i] @ K[:i]))
    y_hat = y + h * (method.B @ K)
    (invariant,) = problem.invariants
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ProjectionWarning)  # the paper's longest steps are shown on purpose
        y_new = project(y_hat, invariant, target=invariant.fun(0.0, problem.y0)).y
    g = OMEGA * y_hat  # fsum, because BLAS rounds differently from machine to machine
    exact = -(1 - math.hypot(*problem.y0) / math.hypot(*y_hat)) / OMEGA
    return abs(math.fsum((y_new - y_hat) * g) / math.fsum(g * g) - exact)


def residual(series: Series, h: float) -> float:
    """Return the error of tables 2 and 4: the change of the first kept invariant over a run."""
    problem = harmonic(OMEGA) if series["table"] == 2 else kepler(eccentricity=0.6, relativistic=0.005)
    values = run(problem, series, h).invariants[0]
    return abs(float(values[-1] - values[0]))


def end(series: Series, h: float) -> np.ndarray:
    """Return the last state of a run for tables 3 and 5, whose errors are differences between successive h."""
    if series["table"] == 3:
        return run(kepler(eccentricity=0.6, relativistic=0.005), series, h).y[:, -1]
    problem = rotating_packet(series.get("Omega", 0.0), nyquist="zero")
    return run(problem, series, h, problem.t_span[1], save_every=None).y[:, -1]


def in_processes(pool: Executor, stored: list[Series]) -> Callable[[Series, float], np.ndarray]:
    """Queue the runs of all series, those with most steps first; the function that replaces `end` waits for them."""
    waiting = [(series, h) for series in stored for h in (2 * lengths(series)[0], *lengths(series))]
    ends = {(s["name"], h): pool.submit(end, s, h) for s, h in sorted(waiting, key=lambda item: item[1])}
    return lambda series, h: ends[series["name"], h].result()


def errors(series: Series, ends: Callable[[Series, float], np.ndarray] = end) -> list[float]:
    """Return the errors of a series at each of its steps; ``ends(series, h)`` returns the last state of a run."""
    steps = lengths(series)
    if series["table"] in (3, 5):
        return [float(np.abs(a - b).max()) for a, b in pairwise(ends(series, h) for h in (2 * steps[0], *steps))]
    return [(multiplier if series["table"] == 1 else residual)(series, h) for h in steps]


def lengths(series: Series) -> list[float]:
    """Return the lengths of the steps of a series."""
    return [float(series["h"]) / d for d in series["divisors"]]


def compared(
    paper: str, ours: float, exact: float, roundoff: float, cause: str, misprint: str | None = None
) -> dict[str, Any]:
    """Return to how many digits of the paper a number agrees, and whether round-off explains the rest of them.

    It does if ours is within `roundoff` of the paper's number or of `exact`, computed in 50 digits.
    """
    a, b = Decimal(paper), Decimal(ours)
    printed = len(a.as_tuple().digits)
    places = {k: Decimal(1).scaleb(a.adjusted() - k + 1) for k in range(printed, 0, -1)}
    digits = next((k for k, place in places.items() if a.quantize(place) == b.quantize(place)), 0)
    half_unit = 0.5 * 10.0 ** int(a.as_tuple().exponent)
    near = abs(ours - float(paper)) <= half_unit + roundoff or abs(ours - exact) <= roundoff
    status = "matched" if digits == printed else "round-off" if near else "differs"
    found = {"paper": paper, "ours": ours, "mpmath": exact, "digits": digits, "paper_digits": printed, "status": status}
    return found | {"cause": cause if status == "round-off" else None, "misprinted_as": misprint}


def rows_of(series: Series, ours: list[float]) -> Iterator[dict[str, Any]]:
    """Yield a row for each error of a series, and one for each order of convergence from one step to the next."""
    about = DATA["tables"][str(series["table"])]
    exact = [float(x) for x in series.get("mpmath") or [math.nan] * len(ours)]
    refined = -np.diff(np.log(lengths(series)))
    orders = [-np.diff(np.log(np.abs(values))) / refined for values in (ours, exact)]
    relative = about["roundoff"] / np.where(np.isnan(exact), ours, exact)
    slack = (relative[:-1] + relative[1:]) / refined
    for k, (paper, divisor) in enumerate(zip(series["errors"], series["divisors"], strict=True)):
        labels = {"name": series["name"], "method": series["method"], "h": series["h"], "d": divisor}
        place = {"table": series["table"], **{key: about[key].format(**labels) for key in ("row", "column")}}
        misprint = (series.get("errata") or {}).get(str(k), {}).get("printed")
        found = compared(paper, ours[k], exact[k], about["roundoff"], about["cause"], misprint)
        yield {"quantity": "error", **place, **found}
        if k:
            order, exactly, roundoff = (float(values[k - 1]) for values in (*orders, slack))
            found = compared(series["orders"][k - 1], order, exactly, roundoff, about["cause"])
            yield {"quantity": "order", **place, **found}


def text(rows: list[dict[str, Any]]) -> str:
    """Lay out one table: the paper's numbers, ours, the digits that agree, and 50 digits where one does not."""
    number, about = rows[0]["table"], DATA["tables"][str(rows[0]["table"])]
    first, second = ("row", "column") if number == 2 else ("column", "row")
    width = max(len(row[key]) for row in rows for key in (first, second))
    exact = "mpmath" if any(not math.isnan(row["mpmath"]) for row in rows if row["quantity"] == "error") else ""
    heads = [f"{'paper':>{w}}{'ours':>{w}}{'digits':>8}{exact:>{w}}" for w in (12, 9)]
    rules = [
        "  " + f" {name} ".center(len(head) - 2, "-") for name, head in zip(("error", "order"), heads, strict=True)
    ]
    margin = " " * (2 * width + 2)
    lines = [f"Table {number}: {about['title']}", f"         {about['problem']}", ""]
    lines += [margin + "".join(rules), margin + "".join(heads)]
    last = None
    for (one, two), cell in groupby(rows, key=lambda row: (row[first], row[second])):
        numbers = list(cell)
        misprint = numbers[0]["misprinted_as"]
        tail = "".join(map(shown, numbers)) + (f"  misprinted as {misprint}" if misprint else "")
        lines.append(f"{one if one != last else '':<{width}}  {two:<{width}}{tail}".rstrip())
        last = one
    counts = []
    for quantity in ("error", "order"):
        own = [row["status"] for row in rows if row["quantity"] == quantity]
        counts.append(f"{own.count('matched')} of {len(own)} {quantity}s")
    lines += ["", f"{' and '.join(counts)} agree to every printed digit."]
    statuses = [row["status"] for row in rows]
    if n := statuses.count("round-off"):
        lines.append(f"Round-off ({about['roundoff']:.1e}) explains {n}: {about['cause']}.")
    if n := statuses.count("differs"):
        lines.append(f"{n} marked ! DIFFER by more than round-off.")
    return "\n".join(lines)


def shown(row: dict[str, Any]) -> str:
    """Return a number of the paper, ours in the same notation, the digits that agree, and 50 digits if not all do."""
    paper, width = row["paper"], 12 if row["quantity"] == "error" else 9
    decimals = f".{len(paper.partition('e')[0].partition('.')[2])}{'e' if 'e' in paper else 'f'}"
    exact = "" if row["status"] == "matched" or math.isnan(row["mpmath"]) else f"{row['mpmath']:{decimals}}"
    agree = f"{row['digits']}/{row['paper_digits']}{'!' if row['status'] == 'differs' else ' '}"
    return f"{paper:>{width}}{row['ours']:>{width}{decimals}}{agree:>8}{exact:>{width}}"
