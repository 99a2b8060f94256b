"""Report of the bench: where other packages are faster comes first, then a table for each problem."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

from .cases import CASES
from .measure import LEVELS, Measured, seconds_at
from .solvers import OTHER, READY, SOLVERS, USER

BY_NAME = {solver.name: solver for solver in SOLVERS}
HOW = (
    "Each time is the least processor time of a whole call, from the start to the state at the end, on one core; each "
    "solver runs in a process of its own. It is interpolated to an error of 1e-6 or 1e-9 of the state at the end, the "
    "largest of a component relative to the largest component. Compilation is what the first call takes longer, and is "
    "not part of the times. Functions are jitted by Numba, return arrays, and come without gradients, as a user "
    "writes them; heyoka, diffrax and REBOUND take equations in their own form. Ratios are to the fastest of ours with "
    "a user's functions. `<`: the loosest setting is more accurate than that."
)


class Row(NamedTuple):
    """A solver on a case: its times and whether they are bounds, for each of `LEVELS`, and its compilation."""

    solver: str
    kind: str
    seconds: tuple[float, ...]
    bounds: tuple[bool, ...]
    compilation: float
    said: str


def rows(found: list[Measured], case: str) -> list[Row]:
    """Return the rows of a case: with a user's functions, the library's problems, other packages; the fastest first."""
    made = []
    for each in found:
        if each.case == case:
            at = [seconds_at(each.runs, level) for level in LEVELS]
            times, bounds = tuple(time for time, _ in at), tuple(bound for _, bound in at)
            made.append(Row(each.solver, BY_NAME[each.solver].kind, times, bounds, each.compilation, each.said))
    kinds = (USER, READY, OTHER)
    return sorted(made, key=lambda row: (kinds.index(row.kind), [math.isnan(t) or t for t in row.seconds[::-1]]))


def ours(table: list[Row], level: int) -> float:
    """Return our least time with a user's functions, nan if none of our runs was accurate enough."""
    return min((row.seconds[level] for row in table if row.kind == USER and row.seconds[level] > 0), default=math.nan)


def losses(found: list[Measured]) -> Iterator[tuple[float, str]]:
    """Yield (ratio, sentence) for each case and error at which another package is faster, the fastest of them only."""
    for case in dict.fromkeys(each.case for each in found):
        table = rows(found, case)
        for k, level in enumerate(LEVELS):
            others = [row for row in table if row.kind == OTHER and row.seconds[k] > 0]
            best = min(others, key=lambda row: row.seconds[k], default=None)
            mine = ours(table, k)
            if best and not best.seconds[k] >= mine:
                ratio = mine / best.seconds[k]
                told = f"{float(f'{ratio:.2g}'):g} times faster" if ratio > 0 else "the only one that arrives"
                yield ratio, f"{case}, error {level:.0e}: {best.solver} is {told}"


def markdown(found: list[Measured], machine: str) -> str:
    """Return the page."""
    versions = {BY_NAME[each.solver].package: each.version for each in found if each.version}
    packages = ", ".join(f"{name} {number}" for name, number in versions.items())
    lines = [f"{machine}. {packages}.", "", HOW, "", "## Where another package is faster", ""]
    lost = sorted(losses(found), key=lambda item: -item[0] if item[0] > 0 else -math.inf)
    lines += [f"- {sentence}." for _, sentence in lost] or ["- Nowhere in this table."]
    for case in dict.fromkeys(each.case for each in found):
        table = rows(found, case)
        lines += ["", f"## {case}", "", f"{CASES[case].title}.", ""]
        heads = [cell for level in LEVELS for cell in (f"error {level:.0e}", "ratio")]
        lines += [f"| | functions | {' | '.join(heads)} | compilation |", f"|---|---|{'---|' * len(heads)}---|"]
        for row in table:
            cells = []
            for k in range(len(LEVELS)):
                cells += [
                    ("< " if row.bounds[k] else "") + shown(row.seconds[k]),
                    ratio(row.seconds[k], ours(table, k)),
                ]
            lines.append(f"| {row.solver} | {row.kind} | {' | '.join(cells)} | {shown(row.compilation)} |")
        lines += ["", *(f"- {row.solver}: {row.said}" for row in table if row.said)]
    return "\n".join(lines).rstrip() + "\n"


def shown(seconds: float) -> str:
    """Return a time with its unit."""
    if not math.isfinite(seconds):
        return "-"
    seconds = max(seconds, 0.0)
    return f"{seconds:.3g} s" if seconds >= 1 else f"{seconds * 1e3:.3g} ms"


def ratio(seconds: float, mine: float) -> str:
    """Return a ratio of times."""
    value = seconds / mine
    return "-" if math.isnan(value) else f"{value:.2g}" if value < 100 else f"{value:.0f}"
