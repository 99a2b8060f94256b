"""``eip-scipy trust``: whether faulty runs are reported, and correct ones are not."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict
from itertools import groupby
from typing import Any

import numpy as np

from ..output import Output, processes
from ..report import cores
from .runs import CHANNELS, SILENT, Outcome, Run, carry_out, carry_out_plain
from .table import LATE, all_runs

LEAST_TOLD, MOST_ALARMS = 0.95, 0.01
SPOILT, TOLERANCE = 10.0, 1e3  # times the error without projection; times rtol
CHUNK = 8


def trust(out: Output, *, only: str = "") -> None:
    """Make faulty runs and correct ones, and check that the faulty ones are reported and the correct ones are not.

    Faulty runs have quantities that are not invariants (with a rate of 0 at the start, or another one), leaks of an
    invariant, leaks that start late or act only in some places, wrong gradients, too long steps, light bodies, or
    passages that blow up; some are members of ensembles. They use all methods, fixed and adaptive steps, solve_ivp and
    integrate, compiled and interpreted functions, real and complex states. A run is reported by ValueError or
    UserWarning at the start, by ProjectionWarning, status -1, or `trusted` false. Its error is that of the last state,
    relative to the largest component of the true state.

    Each correct run is compared with the same run without invariants, to make sure that it is one: its error must not
    exceed ten times the other one plus 1000 times the relative tolerance (1e-12 for fixed steps). The exit status is 1
    if less than 95 % of the faulty runs are reported, or more than 1 % of the correct ones.

    Parameters
    ----------
    only : str
        carry out only runs whose group, name or method contains this text
    """
    numbers = [k for k, run in enumerate(all_runs()) if only in f"{run.group} {run.name} {run.label}"]
    # Neighbouring runs are processed together, because they share the states that their errors refer to.
    parts = [numbers[k : k + CHUNK] for k in range(0, len(numbers), CHUNK)]
    found: list[dict[str, Any]] = []
    with out.keep(), processes(min(cores(), max(1, len(parts)))) as pool:
        for future in out.bar([pool.submit(carried_out, part) for part in parts], "trust", unit="part"):
            found += future.result()
    out.numbers["found"] = found
    out.rows("trust.csv", [{**row, "told": ", ".join(row["told"])} for row in found])
    faulty, correct = ([row for row in found if row["faulty"] == kind] for kind in (True, False))
    tables = "\n\n".join(markdown(make(own)) for make, own in ((how_reported, faulty), (alarms, correct)) if own)
    out.file("trust.md", lambda path: path.write_text(tables + "\n", encoding="utf-8"))
    told = [row for row in found if row["told"]]
    reported, accused = (sum(row["faulty"] == kind for row in told) for kind in (True, False))
    late = [row for row in faulty if row["group"] == LATE and row["error"] > SPOILT * row["plain_error"]]
    out.text(f"FAULTY RUNS: error of the last state, and how each was reported\n{listing(faulty)}\n")
    out.text(f"CORRECT RUNS that were reported\n{listing(row for row in told if not row['faulty'])}\n")
    if harmed := [row for row in correct if row["spoilt"]]:
        out.text(f"NOT CORRECT: much more accurate without projection\n{listing(harmed)}\n")
    out.text(
        f"{tables}\n\nlate leaks that make the error more than {SPOILT:g} times larger: "
        f"{sum(bool(row['told']) for row in late)} of {len(late)} reported\n"
    )
    out.check(f"faulty runs are reported: {reported} of {len(faulty)}", reported >= LEAST_TOLD * len(faulty))
    out.check(f"correct runs are not: {accused} of {len(correct)}", accused <= MOST_ALARMS * len(correct))


def carried_out(numbers: list[int]) -> list[dict[str, Any]]:
    """Carry out the runs with these indices in `all_runs`, and return the results of `record`."""
    every = all_runs()
    return [record(every[number]) for number in numbers]


def record(run: Run) -> dict[str, Any]:
    """Carry out one run, and return its properties and results as a dict without arrays."""
    outcome = carry_out(run)
    if (not run.faulty or run.group == LATE) and outcome.y is not None:
        outcome.plain_error = carry_out_plain(run, outcome.t)
    about = {"faulty": bool(run.faulty), "group": run.group, "name": run.name, "how": run.label}
    data = {key: value for key, value in asdict(outcome).items() if key != "y"}
    told = outcome.told[0] if outcome.told else SILENT
    return {**about, **data, "first": told, "spoilt": not run.faulty and spoilt(run, outcome)}


def spoilt(run: Run, outcome: Outcome) -> bool:
    """Return whether the error exceeds `SPOILT` times the one without projection, plus `TOLERANCE` times rtol."""
    return bool(outcome.error > SPOILT * outcome.plain_error + TOLERANCE * run.options.get("rtol", 1e-12))


def listing(rows: Iterable[dict[str, Any]]) -> str:
    """Lay out a line for each of `rows`, the results of `record`, below the name of the run's group."""
    lines = []
    for group, own in groupby(rows, key=lambda row: row["group"]):
        lines += ["", group]
        for row in own:
            error = "" if np.isnan(row["error"]) else f"{row['error']:9.1e}"
            channels = ", ".join(row["told"]) or (SILENT if row["faulty"] else "")
            lines.append(f"  {row['name'][:52]:52} {row['how'][:62]:62} {error:>9}  {channels}")
    return "\n".join(lines)


def groups(rows: list[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """Return the results of `record` by the group of the run, and then all of them."""
    return {**{group: list(own) for group, own in groupby(rows, key=lambda row: row["group"])}, "all": rows}


def how_reported(rows: list[dict[str, Any]]) -> list[list[str]]:
    """Return a table of the numbers of faulty runs, by group and by the first way in which each was reported."""
    table = [["what is wrong", "runs", *CHANNELS, "not reported"]]
    for group, own in groups(rows).items():
        counts = [sum(row["first"] == channel for row in own) for channel in (*CHANNELS, SILENT)]
        table.append([group, str(len(own)), *(str(count or "") for count in counts)])
    return table


def alarms(rows: list[dict[str, Any]]) -> list[list[str]]:
    """Return a table of the numbers of correct runs and of false alarms, by group."""
    counts = [[group, str(len(own)), str(sum(bool(row["told"]) for row in own))] for group, own in groups(rows).items()]
    return [["correct runs", "runs", "false alarms"], *counts]


def markdown(table: list[list[str]]) -> str:
    """Lay out a table as text that is also Markdown."""
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    padded = [[cell.ljust(width) for cell, width in zip(row, widths, strict=True)] for row in table]
    head, *body = ["| " + " | ".join(row) + " |" for row in padded]
    rule = "|" + "|".join("-" * (width + 1) + (":" if k else "-") for k, width in enumerate(widths)) + "|"
    return "\n".join([head, rule, *body])
