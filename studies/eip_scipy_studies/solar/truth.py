"""``eip-scipy solar-system --truth``: error of each force model against the ephemeris DE440."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from eip_scipy import EIPDOP853, integrate
from eip_scipy.problems import Problem, SolarSystemData, solar_system
from eip_scipy.problems.gravity.forces import FORCES
from eip_scipy.problems.gravity.solar_data import AU_KM, YEAR_D

from ..output import Output
from ..report import UsageError, compact, named, table
from .epoch import kernels, one_line, parse_epoch
from .runs import whole_number

PAPER_EPOCH = (2456690.5, 20.3 / 24)
STEP = 0.001
MOON = "moon"  # a body, not a force, but chosen together with the forces
KNOWN = (*(force for force in FORCES if force != "drag"), MOON)
STANDARD = ((), ("1pn",), ("1pn", "moon-quadrupole"), ("1pn", MOON), ("1pn", "j2", MOON))
REPORTED = (1.0, 10.0, 100.0)
ARCSEC = math.degrees(1.0) * 3600
# The step may add this share of an error, and this many km, an error below that of any model here.
STEP_SHARE, STEP_KM = 0.01, 1e-3
Errors = Mapping[str, np.ndarray]


class ModelRun(NamedTuple):
    """Errors of a model against the ephemeris, (m,) at the saved times for each body.

    `km` are distances, `arcsec` angles seen from the Sun, and `step_km` what halving the step changes at the end.
    """

    model: str
    km: Errors
    arcsec: Errors
    step_km: Mapping[str, float]


def compare_forces(
    out: Output, years: float, h: float | None, epoch: str | None, kernel: Path | None, forces: Sequence[str]
) -> None:
    """Compare force models with the ephemeris, and check that the step is short enough."""
    with one_line():
        start, jpl = PAPER_EPOCH if epoch is None else parse_epoch(epoch), kernels()
        times, every, step = save_times(years, min(STEP, abs(years)) if h is None else h)
        truth, wanted = jpl.heliocentric(start, times * YEAR_D, kernel), models(forces)
        data = {moon: jpl.initial_data(start, kernel, moon=moon) for moon in {MOON in model for model in wanted}}
        chosen = {  # invalid combinations are reported before anything runs
            model: solar_system(
                data[MOON in model], years=float(times[-1]), h=step, forces=[name for name in model if name != MOON]
            )
            for model in wanted
        }
    runs: list[ModelRun] = []
    with out.keep(), out.bar(wanted, "forces") as bar:
        for model in bar:
            runs.append(run_model(model, chosen[model], data[MOON in model], times, every, truth))
    if not runs:
        return
    begin, span = next(iter(data.values())).epoch, np.abs(times)
    places = [int(np.argmin(np.abs(span - year))) for year in REPORTED if year < span[-1] * (1 - 1e-9)]
    rows = [
        {"model": run.model, "years": times[k], "body": body, "km": run.km[body][k], "arcsec": run.arcsec[body][k]}
        for run in runs
        for k in range(1, times.size)
        for body in run.km
    ]
    out.numbers |= {"epoch": begin, "step_yr": step, "errors": rows, "step_km": {r.model: r.step_km for r in runs}}
    out.rows("solar-truth.csv", rows)
    out.text(_text(runs, times, [*places, times.size - 1], begin, step))
    for model, body, moved, error in ((r.model, b, moved, r.km[b][-1]) for r in runs for b, moved in r.step_km.items()):
        if moved > STEP_KM + STEP_SHARE * error:
            moves = f"{model}: halving the step moves {body} by {moved:.2g} km, its error is {error:.2g} km"
            out.check(f"{moves}; take a smaller --h", False)
    out.figure("solar-truth.png", "solar.figures:solar_truth", times, runs, begin)


def models(forces: Sequence[str]) -> list[tuple[str, ...]]:
    """Return the models to be compared: Newton's gravitation and the model with `forces`, or those in `STANDARD`."""
    if unknown := [name for name in forces if name not in KNOWN]:
        raise ValueError(f"--forces: unknown force {unknown[0]!r}, expected some of {', '.join(KNOWN)}")
    return [(), tuple(name for name in KNOWN if name in forces)] if forces else list(STANDARD)


def save_times(years: float, h: float) -> tuple[np.ndarray, int, float]:
    """Return the times of saved states in years, the number of steps between two of them, and the step in years.

    The times have the sign of `years`; 1, 10, 100 and the end are among them if they are in the span. The step is at
    most `h`, and the interval before the end may be shorter than the others.
    """
    span = abs(years)
    interval = span / 100 if span < 1 else 0.1 if span <= 200 else 1.0
    if not h <= span:
        raise ValueError(f"--h: a step of {h:g} yr does not fit into {years:g} yr; reduce --h or lengthen --years")
    every = whole_number(interval / h)
    times = interval * np.arange(whole_number(span / interval) + 1)
    times[-1] = span
    return math.copysign(1.0, years) * times, every, interval / every


def run_model(
    model: Sequence[str], problem: Problem, data: SolarSystemData, times: np.ndarray, every: int, truth: Errors
) -> ModelRun:
    """Integrate a model with the problem's step and with half of it, and compare with the ephemeris.

    `every` is the number of steps between two of the saved `times` in years, and `truth` has the heliocentric positions
    (m, 3) at these times by body, km.
    """
    name = " + ".join(["Newton", *model])
    halved, own = (_positions(name, problem, data, times, every, parts) for parts in (2, 1))
    moved = {body: float(np.linalg.norm((own[body] - halved[body])[-1])) for body in truth}
    return ModelRun(name, *errors(own, truth), moved)


def _positions(name: str, problem: Problem, data: SolarSystemData, times: np.ndarray, every: int, parts: int) -> Errors:
    """Return the heliocentric positions (m, 3) in km of each body but the Sun, from steps divided in `parts`.

    If the Moon is a separate body, "EMB" is the centre of mass of Earth and Moon.
    """
    assert problem.h is not None
    options: dict[str, Any] = {"method": named(EIPDOP853, name), "every": "auto", "compensated": True}
    result = integrate(problem, h=problem.h / parts, save_every=every * parts, **options)
    if not result.success:
        raise UsageError(f"{name} with h = {problem.h / parts:g} yr: {result.message}")
    q = result.y[: result.y.shape[0] // 2].reshape(-1, 3, times.size).transpose(0, 2, 1) * AU_KM
    found = {body: q[k] - q[0] for k, body in enumerate(data.bodies) if k > 0}
    if "Moon" in found:
        earth, moon = (data.gm[data.bodies.index(body)] for body in ("Earth", "Moon"))
        found["EMB"] = (earth * found["Earth"] + moon * found["Moon"]) / (earth + moon)
    return found


def errors(own: Errors, truth: Errors) -> tuple[Errors, Errors]:
    """Return by body the distances in km and the angles in arcsec (m,) between heliocentric positions (m, 3) in km."""
    unit = {body: own[body] / _norm(own[body]) - there / _norm(there) for body, there in truth.items()}
    km = {body: _norm(own[body] - there)[:, 0] for body, there in truth.items()}
    return km, {body: 2 * np.arcsin(np.minimum(_norm(d)[:, 0] / 2, 1.0)) * ARCSEC for body, d in unit.items()}


def _norm(vectors: np.ndarray) -> np.ndarray:
    return np.linalg.norm(vectors, axis=1, keepdims=True)


def _text(runs: Sequence[ModelRun], years: np.ndarray, places: Sequence[int], start: str, step: float) -> str:
    bodies = list(runs[0].km)
    lines: list[tuple[str, Sequence[str]]] = []
    for place in places:
        for unit in ("km", "arcsec"):
            lines.append((f"{years[place]:g} yr: error in {unit}", ()))
            lines += [
                (f"  {r.model}", [compact(float(getattr(r, unit)[body][place])) for body in bodies]) for r in runs
            ]
    lines.append(("end: change in km when the step is halved", ()))
    lines += [(f"  {run.model}", [compact(run.step_km[body]) for body in bodies]) for run in runs]
    head = f"Force models against DE440, {years[-1]:g} yr from {start}, EIPDOP853 with h = {step:.6g} yr\n"
    head += "heliocentric positions; EMB: the mass-weighted mean of Earth and Moon\n\n"
    return head + table([[body] for body in bodies], lines)
