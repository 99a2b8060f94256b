"""``eip-scipy bench metric``: the projection's metric on problems whose error estimates mislead it.

Contacts and springs whose forces have kinks or jumps, discs with a truncated Lennard-Jones force, charged particles in
SI units, mechanisms with adaptive steps, the solar system in rotated axes, and the systems of `metric_systems`. Each
case is run by its methods and steps without projection, with the euclidean metric and with the default one. The table
has the geometric means of the errors at the end, relative to the largest component of the reference, and the largest
ratio of the default metric's error to the smaller of the two others; the two last columns count the runs in which that
ratio exceeds 1.5 and 5. Errors below 1e-9 count as 1e-9.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from ..output import Output
from ..report import UsageError, compact, table
from . import metric_cases, metric_systems
from .metric_cases import METRICS

WORSE, FAR_WORSE, TOLERANCE = 1.5, 5.0, 1e-9


def metric(out: Output, *, only: str = "") -> None:
    """Compare the default metric with none and euclidean, case by case.

    Parameters
    ----------
    only : str
        run only cases whose group or name contains this text
    """
    every = [*metric_cases.cases(), *metric_systems.cases()]
    chosen, rows = [case for case in every if only in f"{case.group} {case.name}"], []
    if not chosen:
        raise UsageError(f"--only: no case has {only!r} in its group or name")
    with out.keep(), warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        for case in out.bar(chosen, "metric", unit="case"):
            for method in case.methods:
                for step in case.steps:
                    row = {"group": case.group, "case": case.name, "method": method.__name__, "step": step}
                    errors = {name: case.run(method, step, metric) for name, metric in METRICS.items()}
                    best = max(min(errors["none"], errors["euclidean"]), TOLERANCE)
                    rows.append(row | errors | {"ratio": max(errors["default"], TOLERANCE) / best})
    if not rows:
        return
    out.numbers["runs"] = rows
    out.rows("metric.csv", rows)
    out.text(summary(rows))


def summary(rows: list[dict[str, Any]]) -> str:
    """Return the table of cases and groups, and of all."""
    heads = [["runs"], *([name] for name in METRICS), ["worst", "ratio"], ["worse"], ["far", "worse"]]
    body = []
    for key in ("case", "group", "all"):
        for group, name in dict.fromkeys((row["group"], row[key]) if key != "all" else ("", "") for row in rows):
            own = [row for row in rows if key == "all" or (row["group"], row[key]) == (group, name)]
            means = [compact(float(np.exp(np.mean(np.log([row[m] + 1e-16 for row in own]))))) for m in METRICS]
            ratios = np.array([row["ratio"] for row in own])
            label = {"case": f"{group}: {name}", "group": f"all {group}", "all": "all"}[key]
            counts = [str(int((ratios > bar).sum())) for bar in (WORSE, FAR_WORSE)]
            body.append((label, [str(len(own)), *means, f"{ratios.max():.3g}", *counts]))
    return table(heads, body)
