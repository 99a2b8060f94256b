"""Errors of the runs of the solar system against the reference: checks, table, and rows of the file."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np

from eip_scipy.problems.gravity.solar_data import YEAR_D

from ..report import compact, table
from .runs import TIGHT, Run, Scene

OBLIQUITY = math.radians(84381.448 / 3600)  # IAU 1976, as the paper's data: from the axes of the ICRF to the ecliptic
# A turn is counted right if the longitude error changes by less than half a turn between saved states. Two ellipses as
# eccentric as Mercury's, out of phase, contribute up to 1.6 rad; a change above this bound means that counting is lost.
COUNTABLE_CHANGE = 2.5
ROUND_OFF = 1e-13
FASTEST = 40.0  # rad/yr: Mercury at its perihelion
TIGHT_POSITION = {"IAS15": 1e-8, TIGHT: 1e-7}  # AU, after 2000 years

NOTES = {
    "SV": "SV: Stoermer-Verlet, kick-drift-kick.",
    "IAS15": "WHFast (c17: corrector of order 17), IAS15: REBOUND.",
    "EIPRKN12": "EIPRKN12: Nystroem, order 12, projected at each tenth step, compensated.",
    "EIPGJ14": "EIPGJ14: multistep, order 14, one evaluation a step, projected when it pays; balances: keeps each "
    "planet's energy about the Sun, at its rate.",
    TIGHT: f"{TIGHT}: half of its step.",
    "EMB": "EMB: barycentre of Earth and Moon.",
}
"""Notes about runs and planets, by name."""


class PointErrors(NamedTuple):
    """Errors (9,) of the planets in a run at one time, and the name of the reference.

    Errors of longitude are signed, in rad, and nan if whole turns cannot be counted; those of position are in AU.
    """

    reference: str | None
    longitude: np.ndarray
    position: np.ndarray


class Comparison:
    """Runs, and the most accurate of them, with which the others are compared (`tight`; None if it was not done)."""

    def __init__(self, scene: Scene, runs: Sequence[Run], tight: Run | None) -> None:
        self.scene, self.runs, self.tight = scene, runs, tight
        others = () if tight is None else [(run, tight) for run in runs if run is not tight]
        self.longitudes = {run.name: longitude_errors(scene, run, truth) for run, truth in others}
        self.at = {year: {run.name: self._errors(run, year) for run in runs} for year in scene.report_times()}
        self.end = self.at[scene.years]

    def _errors(self, run: Run, year: float) -> PointErrors | None:
        """Return the errors of a run at a time; None after its end, and if there is no reference.

        The reference is a stored state or else that of the run `tight`, along which whole turns are counted; without
        this run longitudes are nan. Positions are relative to the centre of mass.
        """
        k, truth, source, counting = saved_at(run, year), self.scene.stored(year), "stored states", None
        if self.tight is not None:
            counting = saved_at(self.tight, year)
            if truth is None and counting is not None and run is not self.tight:
                truth, source = self.tight.y[:, counting], self.tight.name
        if k is None or truth is None:
            return None
        own = run.y[:, k]
        position = np.linalg.norm((own - truth)[: own.size // 2].reshape(-1, 3)[1:], axis=1)
        error = _wrapped(self.scene, own[:, None], truth[:, None])[:, 0]
        if counting is None:
            return PointErrors(source, np.full_like(error, np.nan), position)
        counted = error if run is self.tight else self.longitudes[run.name][:, counting]
        return PointErrors(source, error + 2 * np.pi * np.round((counted - error) / (2 * np.pi)), position)

    def checks(self, order: int) -> Iterator[tuple[str, bool]]:
        """Yield checks, with their texts, that hold for any sensible settings of a method of the given order.

        The first run, by this method, reached the end and keeps H and L; the run `tight` agrees with the last stored
        state or, if there is none that it reached, got to the end.
        """
        main = self.runs[0]
        yield f"{main.name} reached the end", not main.failure
        # Residuals are O(h^(2p + 2)): round-off for small steps; for large ones the factor is measured, with a margin
        # of 10.
        bound = max(ROUND_OFF, 1e-3 * (FASTEST * self.scene.h) ** (2 * order + 2))
        for name, series in (("H", main.energy_error), ("L", main.momentum_error)):
            value = float(series.max())
            yield f"{main.name} keeps {name}: relative error {value:.1e} (bound {bound:.1e})", value <= bound
        if self.tight is None:
            return
        name, stored = self.tight.name, [year for year in self.at if self.scene.stored(year) is not None]
        errors = self.at[stored[-1]][name] if stored else None
        if errors is None:
            yield f"{name} reached the end", not self.tight.failure
            return
        worst, bound = float(errors.position.max()), TIGHT_POSITION[name]
        text = f"{name} agrees with the stored states at {stored[-1]:g} yr to {worst:.1e} AU (bound {bound:g})"
        yield text, worst <= bound


def heliocentric(scene: Scene, y: np.ndarray) -> np.ndarray:
    """Return the positions (9, 3, m) of the planets from the Sun in ecliptic axes, from states (60, m)."""
    q = y[: len(y) // 2].reshape(-1, 3, y.shape[1])
    x, y, z = np.moveaxis(q[1:] - q[0], 1, 0)
    c, s = (math.cos(OBLIQUITY), math.sin(OBLIQUITY)) if scene.data.axes == "ICRF" else (1.0, 0.0)
    return np.stack([x, c * y + s * z, c * z - s * y], axis=1)


def longitude_errors(scene: Scene, run: Run, truth: Run) -> np.ndarray:
    """Return the errors (9, m) in rad of the heliocentric ecliptic longitude along a run, with whole turns counted.

    They are those at the times of `truth`; nan after the end of the run, and as soon as its error changes too fast
    between saved states for its turns to be counted. The difference of two longitudes changes slowly even if the
    longitudes do not: the difference is made continuous in time.
    """
    n = min(run.t.size, truth.t.size)
    same = np.isclose(run.t[:n], truth.t[:n], rtol=1e-9, atol=1e-12)
    n = n if same.all() else int(np.argmin(same))
    error = np.full((len(scene.planets), truth.t.size), np.nan)
    error[:, :n] = np.unwrap(_wrapped(scene, run.y[:, :n], truth.y[:, :n]), axis=1)
    too_fast = np.abs(np.diff(error[:, :n], axis=1)) > COUNTABLE_CHANGE
    error[:, 1:n][np.logical_or.accumulate(too_fast, axis=1)] = np.nan
    return error


def _wrapped(scene: Scene, y: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the differences (9, m) of the longitudes of two runs, in [-pi, pi)."""
    own, there = (np.arctan2(q[:, 1], q[:, 0]) for q in (heliocentric(scene, y), heliocentric(scene, truth)))
    return np.remainder(own - there + np.pi, 2 * np.pi) - np.pi


def saved_at(run: Run, year: float) -> int | None:
    """Return the index of the state of a run that was saved at a time, or None if there is none."""
    k = int(np.argmin(np.abs(run.t - year)))
    return k if math.isclose(run.t[k], year, rel_tol=1e-9) else None


def text(found: Comparison, asked: float) -> str:
    """Lay out the head, the table and the notes; `asked` is the step that the user wants."""
    scene, runs = found.scene, found.runs
    shortened = "" if np.isclose(scene.h, asked, rtol=1e-12) else f", shortened from {asked:g} to divide the run"
    rows: list[tuple[str, Sequence[str]]] = [
        ("step [d]", ["adaptive" if run.step is None else f"{run.step * YEAR_D:.4g}" for run in runs]),
        ("wall [s]", [compact(run.wall_time) for run in runs]),
        ("max |dH/H|", [compact(float(run.energy_error.max())) for run in runs]),
        ("max |dL/L|", [compact(float(run.momentum_error.max())) for run in runs]),
    ]
    for heading, quantity in (("error of longitude [rad]", "longitude"), ("error of position [AU]", "position")):
        rows.append((heading, ()))
        for k, planet in enumerate(scene.planets):
            rows.append((f"  {planet}", [_cell(found, run, quantity, k) for run in runs]))
    shown = {*(run.name for run in runs), *scene.planets}
    notes = [
        "dH, dL: largest along the saved states. Longitude: heliocentric, ecliptic, with whole turns; lost: it grows",
        "by too much between saved states for its turns to be counted. Position: from the centre of mass.",
        *(note for name, note in NOTES.items() if name in shown),
    ]
    lines = [
        "",
        f"Solar system, {scene.years:g} yr from {scene.data.epoch}, initial data {scene.data.name!r}",
        f"h = {scene.h:.6g} yr = {scene.h * YEAR_D:.6g} d{shortened}; {scene.n_saves + 1} states saved",
        _reference(found),
        "",
        table([run.name.replace("(", "").replace(")", "").split() for run in runs], rows),
        "",
        fill(" ".join(notes), 79, break_on_hyphens=False),
        *(f"{run.name} ended at {run.t[-1]:g} yr: {run.failure}" for run in runs if run.failure),
        "",
    ]
    return "\n".join(lines)


def _reference(found: Comparison) -> str:
    sources = {errors.reference for errors in found.end.values() if errors}
    if not sources:
        return "No reference: the runs did not get to the end."
    if sources == {"stored states"}:
        counted = f"; turns counted along {found.tight.name}" if found.tight else ""
        return f"Reference: stored states (80 bits) at {found.scene.years:g} yr{counted}"
    return f"Reference: the tightest available run, {sources.pop()}"


def _cell(found: Comparison, run: Run, quantity: str, k: int) -> str:
    errors = found.end[run.name]
    if errors is None:
        return "failed" if run.failure else "ref." if run is found.tight else "-"
    value = float(getattr(errors, quantity)[k])
    return "lost" if np.isnan(value) and found.tight and not found.tight.failure else compact(value)


def rows(found: Comparison) -> list[dict[str, Any]]:
    """Return a row for each time and method, with columns for all planets; unknown errors are nan."""
    made, planets = [], found.scene.planets
    nothing = PointErrors(None, np.full(len(planets), np.nan), np.full(len(planets), np.nan))
    for year, run in ((year, run) for year in found.at for run in found.runs):
        errors = found.at[year][run.name] or nothing
        row = {
            "method": run.name, "step_yr": run.step, "wall_time_s": run.wall_time,
            "max_relative_error_H": run.energy_error.max(), "max_relative_error_L": run.momentum_error.max(),
            "year": year, "reference": errors.reference,
        }  # fmt: skip
        row |= {f"longitude_{p}_rad": value for p, value in zip(planets, errors.longitude, strict=True)}
        made.append(row | {f"position_{p}_AU": value for p, value in zip(planets, errors.position, strict=True)})
    return made
