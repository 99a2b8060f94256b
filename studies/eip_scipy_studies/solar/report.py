"""Output of ``eip-scipy solar-system``: the table, its notes, and the rows of the files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from textwrap import fill
from typing import Any

import numpy as np

from eip_scipy.problems.gravity.solar_data import YEAR_D

from ..report import compact, table
from .errors import PointErrors, SolarRuns
from .runs import BALANCED, HIGH_ORDER, MULTISTEP, TIGHT, MethodRun, report_times


def text(study: SolarRuns, settings: Any) -> str:
    """Lay out the head, the table, the notes and the checks, 90 characters wide with the usual names of methods.

    `settings` is the command, whose `h` is the step that was requested.
    """
    checks = [check.line for check in study.checks()]
    return "\n".join(["", _head(study, settings), _table(study), _notes(study), "", *checks])


def _head(study: SolarRuns, settings: Any) -> str:
    scene = study.scene
    asked = (
        "" if math.isclose(scene.h, settings.h, rel_tol=1e-12) else f", shortened from {settings.h:g} to divide the run"
    )
    return "\n".join(
        [
            f"Solar system, {scene.years:g} yr from {scene.data.epoch}, initial data {scene.data.name!r}",
            f"h = {scene.h:.6g} yr = {scene.h * YEAR_D:.6g} d{asked}; {scene.n_saves + 1} states saved",
            _reference_line(study),
            "",
        ]
    )


def _reference_line(study: SolarRuns) -> str:
    sources = {errors.reference for errors in study.errors(study.scene.years).values()}
    if not sources:
        return "No reference: the runs did not get to the end."
    if sources == {"stored states"}:
        counted = f"; turns counted along {study.tight.name}" if study.tight else ""
        return f"Reference: stored states (80 bits) at {study.scene.years:g} yr{counted}"
    return f"Reference: the tightest available run, {sources.pop()}"


def _table(study: SolarRuns) -> str:
    end = study.errors(study.scene.years)
    rows: list[tuple[str, Sequence[str]]] = [
        ("step [d]", [_step(run) for run in study.runs]),
        ("wall [s]", [compact(run.wall_time) for run in study.runs]),
        ("max |dH/H|", [compact(float(run.energy_error.max())) for run in study.runs]),
        ("max |dL/L|", [compact(float(run.momentum_error.max())) for run in study.runs]),
    ]
    for heading, quantity in (("error of longitude [rad]", "longitude"), ("error of position [AU]", "position")):
        rows.append((heading, ()))
        for k, planet in enumerate(study.scene.planets):
            rows.append((f"  {planet}", [_cell(study, run, end.get(run.name), quantity, k) for run in study.runs]))
    return table([run.head for run in study.runs], rows)


def _step(run: MethodRun) -> str:
    return "adaptive" if run.step is None else f"{run.step * YEAR_D:.4g}"


def _cell(study: SolarRuns, run: MethodRun, errors: PointErrors | None, quantity: str, k: int) -> str:
    if errors is None:
        return "failed" if run.failure else "ref." if run is study.tight else "-"
    value = float(getattr(errors, quantity)[k])
    return "lost" if _counts(study.tight) and math.isnan(value) else compact(value)


def _counts(tight: MethodRun | None) -> bool:
    """Return True if whole turns of the longitudes can be counted along the run `tight`: it exists and did not fail."""
    return tight is not None and not tight.failure


def _notes(study: SolarRuns) -> str:
    shown = {run.name for run in study.runs}
    notes = [
        "dH, dL: largest along the saved states.",
        "Longitude: heliocentric, ecliptic, with whole turns. Position: from the centre of mass.",
        "SV: Stoermer-Verlet, kick-drift-kick." if "SV" in shown else "",
        "WHFast (c17: corrector of order 17), IAS15: REBOUND." if "IAS15" in shown else "",
        f"{study.beside} ran in parallel to the others, on another core." if study.beside in shown else "",
        f"{HIGH_ORDER}: Nystroem, order 12, projected at each tenth step, compensated." if HIGH_ORDER in shown else "",
        f"{MULTISTEP}: multistep, order 14, one evaluation a step, projected when it pays."
        if MULTISTEP in shown
        else "",
        "balances: keeps each planet's energy about the Sun, at its rate." if BALANCED in shown else "",
        f"{TIGHT}: half of its step." if TIGHT in shown else "",
        "EMB: barycentre of Earth and Moon." if "EMB" in study.scene.planets else "",
    ]
    end = study.errors(study.scene.years).values()
    if _counts(study.tight) and any(np.isnan(errors.longitude).any() for errors in end):
        notes.append("lost: the longitude error grows by too much between saved states for its turns to be counted.")
    failures = [f"{run.name} ended at {run.t[-1]:g} yr: {run.failure}" for run in study.runs if run.failure]
    return "\n".join(["", fill(" ".join(filter(None, notes)), 79, break_on_hyphens=False), *failures])


def cost_rows(study: SolarRuns) -> list[dict[str, Any]]:
    """Return a row for each method and step that was timed."""
    if study.cost_scene is None:
        return []
    return [
        {
            "years": study.cost_scene.years,
            "method": item.method,
            "step": item.step,
            "wall_time": item.wall_time,
            "error": item.mercury,
            "error_others": item.others,
        }
        for item in study.cost
    ]


def _about(run: MethodRun) -> dict[str, Any]:
    return {
        "method": run.name,
        "step_yr": run.step,
        "wall_time_s": run.wall_time,
        "max_relative_error_H": run.energy_error.max(),
        "max_relative_error_L": run.momentum_error.max(),
    }


def csv_rows(study: SolarRuns) -> list[dict[str, Any]]:
    """Return a row for each method and each of the `report_times`, with columns for all planets."""
    rows = []
    planets = study.scene.planets
    for year in report_times(study.scene):
        known = study.errors(year)
        for run in study.runs:
            errors = known.get(run.name)
            unknown = [None] * len(planets)
            longitude, position = (errors.longitude, errors.position) if errors else (unknown, unknown)
            rows.append(
                {
                    **_about(run),
                    "year": year,
                    "reference": errors.reference if errors else None,
                    **{f"longitude_{p}_rad": value for p, value in zip(planets, longitude, strict=True)},
                    **{f"position_{p}_AU": value for p, value in zip(planets, position, strict=True)},
                }
            )
    return rows


def json_content(study: SolarRuns) -> dict[str, Any]:
    """Return all numbers for the JSON file."""
    scene = study.scene
    times = {year: study.errors(year) for year in report_times(scene)}
    methods = [
        {
            **_about(run),
            "failure": run.failure or None,
            "errors": [
                {
                    "year": year,
                    "reference": known[run.name].reference,
                    "longitude_rad": dict(zip(scene.planets, known[run.name].longitude, strict=True)),
                    "position_AU": dict(zip(scene.planets, known[run.name].position, strict=True)),
                }
                for year, known in times.items()
                if run.name in known
            ],
        }
        for run in study.runs
    ]
    return {
        "step_yr": scene.h,
        "data": {"epoch": scene.data.epoch, "axes": scene.data.axes, "source": scene.data.source},
        "methods": methods,
        "ran_beside_the_others": study.beside or None,
        "error_against_cost": {
            "error": "Mercury's position [AU]",
            "error_others": "largest error of another planet's position [AU]",
            "points": cost_rows(study),
        },
        "checks": [check.entry for check in study.checks()],
    }
