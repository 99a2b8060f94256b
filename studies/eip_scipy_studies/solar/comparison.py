"""Errors of the runs of the solar system against the reference: checks, table, and rows of the file."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from textwrap import fill
from typing import Any

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

NOTES = (
    "dH, dL: largest along the saved states. Longitude: heliocentric, ecliptic, with whole turns; lost: it grows too "
    "much between saved states for its turns to be counted. Position: from the centre of mass. SV: Stoermer-Verlet, "
    "kick-drift-kick. WHFast (c17: corrector of order 17), IAS15: REBOUND. EIPRKN12: Nystroem, order 12, projected at "
    "each tenth step, compensated; tight: half of its step. EIPGJ14: multistep, order 14, one evaluation a step, "
    "projected when it pays; balances: keeps each planet's energy about the Sun, at its rate. EMB: barycentre of Earth "
    "and Moon."
)


class Comparison:
    """Runs, and the most accurate of them, with which the others are compared (`tight`; None if it was not done)."""

    def __init__(self, scene: Scene, runs: Sequence[Run], tight: Run | None) -> None:
        self.scene, self.runs, self.tight = scene, runs, tight
        others = () if tight is None else [(run, tight) for run in runs if run is not tight]
        self.longitudes = {run.name: longitude_errors(scene, run, truth) for run, truth in others}
        self.planets, self.span = scene.data.bodies[1:], f"{scene.years:g} yr, {scene.data.name}"
        self.rows = [self._row(run, year) for year in scene.report_times() for run in runs]
        self.end = {row["method"]: row for row in self.rows if row["year"] == scene.years}

    def _row(self, run: Run, year: float) -> dict[str, Any]:
        """Return the errors of a run at a time; nan after its end, and if there is no reference.

        Errors of longitude are signed, in rad, those of position distances from the centre of mass in AU. The reference
        is a stored state or else that of the run `tight`, along which whole turns are counted; without this run
        longitudes are nan.
        """
        k, truth, source, counting = saved_at(run, year), self.scene.stored(year), "stored states", None
        if self.tight is not None:
            counting = saved_at(self.tight, year)
            if truth is None and counting is not None and run is not self.tight:
                truth, source = self.tight.y[:, counting], self.tight.name
        longitude = position = np.full(len(self.planets), np.nan)
        if k is None or truth is None:
            source = ""
        else:
            own = run.y[:, k]
            position = np.linalg.norm((own - truth)[: own.size // 2].reshape(-1, 3)[1:], axis=1)
            if counting is not None:
                error = _wrapped(self.scene, own[:, None], truth[:, None])[:, 0]
                counted = error if run is self.tight else self.longitudes[run.name][:, counting]
                longitude = error + 2 * np.pi * np.round((counted - error) / (2 * np.pi))
        return {
            "method": run.name, "step_yr": run.step, "wall_time_s": run.wall_time,
            "max_relative_error_H": run.energy_error.max(), "max_relative_error_L": run.momentum_error.max(),
            "year": year, "reference": source or None,
            **{f"longitude_{p}_rad": value for p, value in zip(self.planets, longitude, strict=True)},
            **{f"position_{p}_AU": value for p, value in zip(self.planets, position, strict=True)},
        }  # fmt: skip

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
        name = self.tight.name
        stored = [row for row in self.rows if row["method"] == name and row["reference"] == "stored states"]
        if not stored:
            yield f"{name} reached the end", not self.tight.failure
            return
        worst, year = max(stored[-1][f"position_{planet}_AU"] for planet in self.planets), stored[-1]["year"]
        text = f"{name} agrees with the stored states at {year:g} yr to {worst:.1e} AU (bound {TIGHT_POSITION[name]:g})"
        yield text, worst <= TIGHT_POSITION[name]


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
    error = np.full((len(scene.data.bodies) - 1, truth.t.size), np.nan)
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
    scene, runs, end = found.scene, found.runs, found.end
    shortened = "" if np.isclose(scene.h, asked, rtol=1e-12) else f", shortened from {asked:g} to divide the run"
    sources = {row["reference"] for row in end.values() if row["reference"]}
    counted = f"; turns counted along {found.tight.name}" if found.tight else ""
    body: list[tuple[str, Sequence[str]]] = [
        ("step [d]", ["adaptive" if run.step is None else f"{run.step * YEAR_D:.4g}" for run in runs]),
        ("wall [s]", [compact(run.wall_time) for run in runs]),
        ("max |dH/H|", [compact(float(run.energy_error.max())) for run in runs]),
        ("max |dL/L|", [compact(float(run.momentum_error.max())) for run in runs]),
    ]
    for quantity, unit in (("longitude", "rad"), ("position", "AU")):
        body.append((f"error of {quantity} [{unit}]", ()))
        for p in found.planets:
            body.append((f"  {p}", [_cell(found, run, end[run.name][f"{quantity}_{p}_{unit}"]) for run in runs]))
    lines = [
        "",
        f"Solar system, {scene.years:g} yr from {scene.data.epoch}, initial data {scene.data.name!r}",
        f"h = {scene.h:.6g} yr = {scene.h * YEAR_D:.6g} d{shortened}; {scene.n_saves + 1} states saved",
        f"Reference: {', '.join(sorted(sources)) or 'none'} at {scene.years:g} yr{counted}",
        "",
        table([run.name.replace("(", "").replace(")", "").split() for run in runs], body),
        "",
        fill(NOTES, 79, break_on_hyphens=False),
        *(f"{run.name} ended at {run.t[-1]:g} yr: {run.failure}" for run in runs if run.failure),
        "",
    ]
    return "\n".join(lines)


def _cell(found: Comparison, run: Run, error: float) -> str:
    if not found.end[run.name]["reference"]:
        return "failed" if run.failure else "ref." if run is found.tight else "-"
    return "lost" if np.isnan(error) and found.tight and not found.tight.failure else compact(error)
