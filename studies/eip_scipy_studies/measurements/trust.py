"""``eip-scipy study trust``: whether faulty runs are reported, and correct ones are not. The runs are in trust_runs/.

Faulty runs have one of these faults: quantities that are not invariants (with a rate of 0 at the start, or another
one), leaks of an invariant, leaks that start late or act only in some places, wrong gradients, too long steps, light
bodies, and passages that blow up; some are members of ensembles. They use all methods, fixed and adaptive steps,
solve_ivp and integrate, compiled and interpreted functions, real and complex states. A run is reported by ValueError or
UserWarning at the start, by ProjectionWarning, status -1, or `trusted` false. Its error is that of the last state,
relative to the largest component of the true state.

Each correct run is compared with the same run without invariants, to make sure that it is one: its error must not
exceed ten times the other one plus 1000 times the relative tolerance (1e-12 for fixed steps). Any report about a
correct run is a false alarm.

The exit status is 1 if less than 95 % of the faulty runs are reported, or more than 1 % of the correct ones.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from ..beside import workers
from ..report import cores
from ..study import Check, Figures, Measurement, Rows, Session, option
from .trust_runs.healthy import healthy_runs
from .trust_runs.late import LATE
from .trust_runs.record import CHANNELS, SILENT, Outcome, Run, carry_out, carry_out_plain
from .trust_runs.sick import sick_runs

LEAST_TOLD, MOST_ALARMS = 0.95, 0.01
SPOILT, TOLERANCE = 10.0, 1e3  # times the error without projection; times rtol
CHUNK = 8


def carried_out(numbers: list[int]) -> list[dict[str, Any]]:
    """Carry out the runs with these indices in `all_runs`, and return the results of `record`."""
    every = all_runs()
    return [record(every[number]) for number in numbers]


def all_runs() -> list[Run]:
    """Return all runs, the faulty ones first."""
    return sick_runs() + healthy_runs()


def record(run: Run) -> dict[str, Any]:
    """Carry out one run, and return its properties and results as a dict without arrays.

    The entry "group" is the name of the group to which the run belongs: the kind of fault, or of correct run.
    """
    begin = time.perf_counter()
    outcome = carry_out(run)
    if (run.sick is False or run.group == LATE) and outcome.y is not None:
        outcome.plain_error = carry_out_plain(run, outcome.t).error
    data = {key: value for key, value in asdict(outcome).items() if key != "y"}
    told = outcome.told[0] if outcome.told else SILENT
    return {
        "sick": bool(run.sick), "group": run.group, "name": run.name, "how": run.label, **data, "first": told,
        "spoilt": not run.sick and spoilt(run, outcome), "wall": time.perf_counter() - begin,
    }  # fmt: skip


def spoilt(run: Run, outcome: Outcome) -> bool:
    """Return whether the error with projection exceeds `SPOILT` times the one without, plus `TOLERANCE` times rtol.

    For fixed steps rtol is 1e-12.
    """
    allowed = SPOILT * outcome.plain_error + TOLERANCE * run.options.get("rtol", 1e-12)
    return bool(outcome.error > allowed)


def listing(rows: Iterable[dict[str, Any]]) -> str:
    """Lay out a line for each of `rows`, the results of `record`, below the name of the run's group."""
    lines, group = [], None
    for row in rows:
        if row["group"] != group:
            group = row["group"]
            lines += ["", group]
        error = "" if np.isnan(row["error"]) else f"{row['error']:9.1e}"
        channels = ", ".join(row["told"]) or (SILENT if row["sick"] else "")
        lines.append(f"  {row['name'][:52]:52} {row['how'][:62]:62} {error:>9}  {channels}")
    return "\n".join(lines)


def harmful(rows: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows of late leaks whose error is more than `SPOILT` times that of the run without projection."""
    return [row for row in rows if row["group"] == LATE and row["error"] > SPOILT * row["plain_error"]]


def groups(rows: list[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """Return the results of `record` by the group of the run, in the given order."""
    found: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        found.setdefault(row["group"], []).append(row)
    return found


def sick_table(rows: list[dict[str, Any]]) -> list[list[str]]:
    """Return a table of the numbers of faulty runs, by group and by the way in which they were reported.

    If a run was reported in several ways, the first one in `CHANNELS` counts.
    """
    table = [["what is wrong", "runs", *CHANNELS, "not reported"]]
    for group, own in {**groups(rows), "all": rows}.items():
        counts = [sum(row["first"] == channel for row in own) for channel in (*CHANNELS, SILENT)]
        table.append([group, str(len(own)), *(str(count or "") for count in counts)])
    return table


def healthy_table(rows: list[dict[str, Any]]) -> list[list[str]]:
    """Return a table of the numbers of correct runs and of false alarms, by group."""
    table = [["correct runs", "runs", "false alarms"]]
    for group, own in {**groups(rows), "all": rows}.items():
        table.append([group, str(len(own)), str(sum(bool(row["told"]) for row in own))])
    return table


def markdown(table: list[list[str]]) -> str:
    """Lay out a table as text that is also Markdown."""
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    lines = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |" for row in table
    ]
    rule = "|" + "|".join("-" * (width + 1) + (":" if k else "-") for k, width in enumerate(widths)) + "|"
    return "\n".join([lines[0], rule, *lines[1:]])


@dataclass(frozen=True, kw_only=True)
class Trust(Measurement[list[dict[str, Any]]]):
    """Command ``eip-scipy study trust``."""

    writes_files = True
    only: str = option("", "carry out only runs whose group, name or method contains TEXT", metavar="TEXT")
    processes: int = field(default_factory=cores)

    def measure(self, session: Session) -> list[dict[str, Any]]:
        numbers = [k for k, run in enumerate(all_runs()) if self.only in f"{run.group} {run.name} {run.label}"]
        # Neighbouring runs are processed together, because they share the states that their errors refer to.
        parts = [numbers[k : k + CHUNK] for k in range(0, len(numbers), CHUNK)]
        found = []
        with workers(min(self.processes, len(parts))) as start, session.bar(len(numbers), "trust") as bar:
            for part, value in zip(parts, [start(carried_out, part) for part in parts], strict=True):
                found += value()
                bar.update(len(part))
        return found

    def table(self, found: list[dict[str, Any]]) -> str:
        sick, healthy = split(found)
        reported, alarms = [row for row in sick if row["told"]], [row for row in healthy if row["told"]]
        parts = [
            f"FAULTY RUNS: error of the last state, and how each was reported\n{listing(sick)}",
            f"CORRECT RUNS that were reported\n{listing(alarms)}",
        ]
        if harmed := [row for row in healthy if row["spoilt"]]:
            parts.append(f"NOT CORRECT: much more accurate without projection\n{listing(harmed)}")
        parts += tables(found)
        late = harmful(sick)
        parts.append(
            f"reported: {len(reported)} of {len(sick)} faulty runs ({len(reported) / max(1, len(sick)):.1%}); false "
            f"alarms: {len(alarms)} of {len(healthy)} ({len(alarms) / max(1, len(healthy)):.1%})\n"
            f"late leaks that make the error more than {SPOILT:g} times larger: "
            f"{sum(bool(row['told']) for row in late)} of {len(late)} reported"
        )
        return "\n\n".join(parts)

    def checks(self, found: list[dict[str, Any]]) -> list[Check]:
        sick, healthy = split(found)
        reported, alarms = (sum(bool(row["told"]) for row in rows) for rows in (sick, healthy))
        return [
            Check("faulty runs are reported", reported >= LEAST_TOLD * len(sick)),
            Check("correct runs are not", alarms <= MOST_ALARMS * len(healthy)),
        ]

    def tables(self, found: list[dict[str, Any]]) -> dict[str, Rows]:
        return {"trust.csv": [{**row, "told": ", ".join(row["told"])} for row in found]}

    def figures(self, found: list[dict[str, Any]]) -> Figures:
        """Yield one Markdown file with the tables for the page on trust."""
        yield "trust.md", lambda path: path.write_text("\n\n".join(tables(found)) + "\n", encoding="utf-8")


def split(found: list[dict[str, Any]]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return the rows of faulty runs and those of correct runs."""
    return [row for row in found if row["sick"]], [row for row in found if not row["sick"]]


def tables(found: list[dict[str, Any]]) -> list[str]:
    """Return the tables of faulty and of correct runs as Markdown texts, each only if there are such runs."""
    return [markdown(make(own)) for make, own in zip((sick_table, healthy_table), split(found), strict=True) if own]
