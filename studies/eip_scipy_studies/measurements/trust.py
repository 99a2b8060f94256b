"""Are sick runs told, and healthy ones left in peace? The runs are in trust_runs/.

    python -m eip_scipy_studies.measurements.trust [--only TEXT] [--workers 2] [--markdown FILE] [--csv FILE] [--json FILE]

Sick runs: quantities that are no invariants (their rate 0 at the start, or not), leaks, leaks that start late or act in
places, wrong gradients, steps too long, light bodies, passages that blow up, members of ensembles; by all methods,
fixed and adaptive, solve_ivp and integrate, compiled and interpreted, real and complex. Told means: ValueError or
UserWarning at the start, ProjectionWarning, status -1, or `trusted` false. Their error is that of the last
state, relative to its largest component.

Healthy runs: each is compared with the same run without invariants; one whose error is over ten times the other's, and
above the tolerance, would be no healthy one. Anything told is a false alarm there.

Exit status 1 when less than 95 % of the sick runs are told, or more than 1 % of the healthy ones.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from ..report import describe_machine, write_csv
from .trust_runs.healthy import healthy_runs
from .trust_runs.late import LATE
from .trust_runs.record import CHANNELS, SILENT, Outcome, Run, carry_out, carry_out_plain
from .trust_runs.sick import sick_runs

LEAST_TOLD, MOST_ALARMS = 0.95, 0.01
SPOILT, TOLERANCE = 10.0, 1e3  # times the error without projection; times rtol
CHUNK = 8


def measure(numbers: list[int]) -> list[dict[str, Any]]:
    """The runs of these numbers, as plain data."""
    every = all_runs()
    return [record(every[number]) for number in numbers]


def all_runs() -> list[Run]:
    """Sick ones first."""
    return sick_runs() + healthy_runs()


def record(run: Run) -> dict[str, Any]:
    """One run carried out."""
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
    """Whether the projection did harm to a run that was to be healthy."""
    allowed = SPOILT * outcome.plain_error + TOLERANCE * run.options.get("rtol", 1e-12)
    return bool(outcome.error > allowed)


def listing(rows: Iterable[dict[str, Any]]) -> str:
    """A line for each run."""
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
    """Return the late leaks that make a run much less accurate than the same run without projection."""
    return [row for row in rows if row["group"] == LATE and row["error"] > SPOILT * row["plain_error"]]


def groups(rows: list[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """Rows by group, in their order."""
    found: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        found.setdefault(row["group"], []).append(row)
    return found


def sick_table(rows: list[dict[str, Any]]) -> list[list[str]]:
    """Group by group how they were told, by the plainest of the ways of each run."""
    table = [["what is wrong", "runs", *CHANNELS, "not told"]]
    for group, own in {**groups(rows), "all": rows}.items():
        counts = [sum(row["first"] == channel for row in own) for channel in (*CHANNELS, SILENT)]
        table.append([group, str(len(own)), *(str(count or "") for count in counts)])
    return table


def healthy_table(rows: list[dict[str, Any]]) -> list[list[str]]:
    """Group by group the false alarms."""
    table = [["healthy runs", "runs", "false alarms"]]
    for group, own in {**groups(rows), "all": rows}.items():
        table.append([group, str(len(own)), str(sum(bool(row["told"]) for row in own))])
    return table


def markdown(table: list[list[str]]) -> str:
    """A table as text that is also Markdown."""
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    lines = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |" for row in table
    ]
    rule = "|" + "|".join("-" * (width + 1) + (":" if k else "-") for k, width in enumerate(widths)) + "|"
    return "\n".join([lines[0], rule, *lines[1:]])


def run_all(numbers: list[int], workers: int) -> list[dict[str, Any]]:
    """In processes of their own; neighbours together, for they share what their errors are measured against."""
    parts = [numbers[k : k + CHUNK] for k in range(0, len(numbers), CHUNK)]
    rows = []
    with (
        ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool,
        tqdm(total=len(numbers), leave=False) as bar,
    ):
        for part in pool.map(measure, parts):
            rows += part
            bar.update(len(part))
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", metavar="TEXT", default="", help="runs whose group, name or method contains this")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="the tables of docs/explanation/trust.md")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="a line for each run")
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    wanted = [k for k, run in enumerate(all_runs()) if args.only in f"{run.group} {run.name} {run.label}"]
    begin = time.perf_counter()
    rows = run_all(wanted, args.workers)
    sick, healthy = ([row for row in rows if row["sick"] is state] for state in (True, False))
    tables = [table(own) for table, own in ((sick_table, sick), (healthy_table, healthy)) if own]
    told, alarms = sum(bool(row["told"]) for row in sick), [row for row in healthy if row["told"]]
    print(f"{describe_machine()}; {len(rows)} runs, {time.perf_counter() - begin:.0f} s")
    print("\nSICK RUNS: error of the last state, and how each was told", listing(sick), sep="\n")
    print("\nHEALTHY RUNS that were told", listing(alarms), sep="\n")
    harmed = [row for row in healthy if row["spoilt"]]
    if harmed:
        print("\nNOT HEALTHY: much more accurate without projection", listing(harmed), sep="\n")
    print("\n" + "\n\n".join(map(markdown, tables)))
    print(f"\ntold: {told} of {len(sick)} sick runs ({told / max(1, len(sick)):.1%}); false alarms: {len(alarms)} of "
          f"{len(healthy)} ({len(alarms) / max(1, len(healthy)):.1%})")  # fmt: skip
    late = harmful(sick)
    print(f"late leaks that make the error more than {SPOILT:g} times larger: {sum(bool(row['told']) for row in late)} "
          f"of {len(late)} reported")  # fmt: skip
    if args.markdown is not None:
        args.markdown.write_text("\n\n".join(map(markdown, tables)) + "\n")
    if args.csv is not None:
        write_csv(args.csv, [{**row, "told": ", ".join(row["told"])} for row in rows])
    if args.json is not None:
        args.json.write_text(json.dumps({"machine": describe_machine(), "runs": rows}, indent=1, default=float))
    return int(told < LEAST_TOLD * len(sick) or len(alarms) > MOST_ALARMS * len(healthy))


if __name__ == "__main__":
    sys.exit(main())
