"""``eip-scipy solar-system --truth``: what each force is worth, measured against the ephemeris DE440 itself."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from ...core.names import nearest
from ...core.solvers import EIPDOP853
from ...problems import SolarSystemData, solar_system
from ...problems.gravity.forces import FORCES, check_forces
from ...problems.gravity.solar_data import AU_KM, YEAR_D
from ...run.integrate import integrate
from ..report import (
    UsageError,
    check_outputs,
    compact,
    deliver,
    table,
    warn,
)
from .runs import whole_number

__all__ = ["Ephemeris", "Model", "ModelRun", "add_arguments", "errors", "models", "run", "run_model"]

PAPER_EPOCH = (2456690.5, 20.3 / 24)
YEARS, STEP = 100.0, 0.001
MOON = "moon"  # no force but a body, chosen beside the forces
STANDARD = ((), ("1pn",), ("1pn", "moon-quadrupole"), ("1pn", MOON), ("1pn", "j2", MOON))
REPORTED = (1.0, 10.0, 100.0)
PANELS = ("Mercury", "EMB", "Mars", "Jupiter")
ARCSEC = math.degrees(1.0) * 3600
# The step may add this share of an error, and this many km, which no model here reaches.
STEP_SHARE, STEP_KM = 0.01, 1e-3
DONE, CHECK_FAILED, INTERRUPTED = 0, 1, 130


class Ephemeris(NamedTuple):
    """What is asked of a kernel: functions of `eip_scipy.integrations.jpl`."""

    initial_data: Callable[..., SolarSystemData]
    heliocentric: Callable[..., dict[str, np.ndarray]]


class Model(NamedTuple):
    """Forces beside Newton's, and whether the Moon is a body of its own."""

    forces: tuple[str, ...]
    moon: bool

    @property
    def name(self) -> str:
        """Name in the table, by the words of the command line."""
        return " + ".join(["Newton", *self.forces, *[MOON] * self.moon])


class ModelRun(NamedTuple):
    """Errors of a model against the ephemeris: years (m,), and for each planet km and arcsec (m,)."""

    model: Model
    years: np.ndarray
    km: dict[str, np.ndarray]
    arcsec: dict[str, np.ndarray]
    step_km: dict[str, float]
    """Change of the final position when the step is halved."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--truth`` and ``--forces``."""
    parser.add_argument(
        "--truth", action="store_true", help="compare force models with DE440 itself instead of methods with each other"
    )
    parser.add_argument(
        "--forces",
        type=_force,
        nargs="+",
        metavar="FORCE",
        help=f"with --truth: one model in place of the standard ones, of {', '.join([*FORCES, MOON])}",
    )


def _force(text: str) -> str:
    known = [*FORCES, MOON]
    if text in known:
        return text
    hint = nearest(text.lower(), known, cutoff=0.4)
    raise argparse.ArgumentTypeError(f"unknown force {text!r}; known: {', '.join(known)}{hint}")


def models(forces: Sequence[str] | None) -> list[Model]:
    """The models to be compared: Newton and the one asked for, or the standard ones.

    Raises
    ------
    ValueError
        For forces that exclude each other.
    """
    asked = STANDARD if forces is None else ((), tuple(forces))
    found = [Model(check_forces(name for name in names if name != MOON), MOON in names) for names in asked]
    return list(dict.fromkeys(found))


def run(args: argparse.Namespace, ephemeris: Ephemeris) -> int:
    """Run the command.

    Parameters
    ----------
    args : argparse.Namespace
        Options of ``solar-system``, of which it takes ``years``, ``h``, ``forces``, ``epoch``, ``kernel``, ``out``,
        ``json`` and ``quiet``.
    ephemeris : Ephemeris

    Returns
    -------
    int
        Exit status: 0 done, 1 a check failed, 130 interrupted.

    Raises
    ------
    UsageError
        For arguments, a kernel or files that cannot be used.
    """
    years = YEARS if args.years is None else args.years
    h = min(STEP, abs(years)) if args.h is None else args.h
    if args.data is not None:
        raise UsageError("--truth starts from the ephemeris itself: leave --data out, or choose an --epoch")
    epoch, kernel = args.epoch or PAPER_EPOCH, args.kernel
    try:
        chosen = models(args.forces)
        times, every, step = save_times(years, h)
        truth = ephemeris.heliocentric(epoch, times * YEAR_D, kernel)
        data = {moon: ephemeris.initial_data(epoch, kernel, moon=moon) for moon in {m.moon for m in chosen}}
        for model in chosen:  # what cannot be combined is said before anything runs
            solar_system(data[model.moon], forces=model.forces)
    except (ImportError, OSError, ValueError) as error:
        raise UsageError(" ".join(str(error).split())) from error
    check_outputs(args.out, args.json)
    runs: list[ModelRun] = []
    try:
        for model in chosen:
            runs.append(run_model(model, data[model.moon], times, every, step, truth, progress=not args.quiet))
    except KeyboardInterrupt:
        warn("interrupted; the models that were done are in the table and the files")
    if not runs:
        return INTERRUPTED
    start = next(iter(data.values())).epoch
    failed = _failures(runs)
    _report(args, runs, start, step, failed)
    if len(runs) < len(chosen):
        return INTERRUPTED
    return CHECK_FAILED if failed else DONE


def save_times(years: float, h: float) -> tuple[np.ndarray, int, float]:
    """Times of saved states in years, the steps between them, and the step in years.

    1, 10, 100 and the end are among them; the time between them is a whole number of steps.

    Raises
    ------
    ValueError
        When the step is longer than the time between saved states.
    """
    span = abs(years)
    interval = span / 100 if span < 1 else 0.1 if span <= 200 else 1.0
    if not h <= span:
        raise ValueError(f"--h: a step of {h:g} yr does not fit into {years:g} yr")
    every = whole_number(interval / h)
    times = interval * np.arange(whole_number(span / interval) + 1)
    times[-1] = span
    return math.copysign(1.0, years) * times, every, interval / every


def run_model(
    model: Model,
    data: SolarSystemData,
    times: np.ndarray,
    every: int,
    step: float,
    truth: dict[str, np.ndarray],
    *,
    progress: bool = False,
) -> ModelRun:
    """Integrate a model with a step and with half of it, and compare with the ephemeris.

    Parameters
    ----------
    model : Model
    data : SolarSystemData
        With the Moon where the model has it.
    times : ndarray, shape (m,)
        Years, from `save_times`, with `every` and `step`.
    truth : dict of str to ndarray, shape (m, 3)
        Heliocentric positions at these times, km.
    progress : bool, optional
        Show progress bars.

    Returns
    -------
    ModelRun
    """
    halved, own = (_positions(model, data, times, every * k, step / k, progress) for k in (2, 1))
    km, arcsec = errors(own, truth)
    moved = {body: float(np.linalg.norm((own[body] - halved[body])[-1])) for body in truth}
    return ModelRun(model, times, km, arcsec, moved)


def _positions(
    model: Model, data: SolarSystemData, times: np.ndarray, every: int, step: float, progress: bool
) -> dict[str, np.ndarray]:
    """Heliocentric positions in km, as the ephemeris gives them."""
    problem = solar_system(data, years=float(times[-1]), h=step, forces=model.forces)
    method = type(model.name, (EIPDOP853,), {"__doc__": EIPDOP853.__doc__})  # names the progress bar
    result = integrate(problem, method=method, save_every=every, every="auto", compensated=True, progress=progress)
    if not result.success:
        raise UsageError(f"{model.name} with h = {step:g} yr: {result.message}")
    q = result.y[: result.y.shape[0] // 2].reshape(-1, 3, times.size).transpose(0, 2, 1) * AU_KM
    found = {body: q[k] - q[0] for k, body in enumerate(data.bodies) if k > 0}
    if model.moon:
        earth, moon = (data.gm[data.bodies.index(body)] for body in ("Earth", "Moon"))
        found["EMB"] = (earth * found["Earth"] + moon * found["Moon"]) / (earth + moon)
    return found


def errors(
    own: dict[str, np.ndarray], truth: dict[str, np.ndarray]
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Distances in km, and angles as seen from the Sun in arcsec, between positions (m, 3) of each body of `truth`."""
    km = {body: np.linalg.norm(own[body] - there, axis=1) for body, there in truth.items()}
    chord = {body: np.linalg.norm(_unit(own[body]) - _unit(there), axis=1) for body, there in truth.items()}
    return km, {body: 2 * np.arcsin(np.minimum(c / 2, 1.0)) * ARCSEC for body, c in chord.items()}


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _failures(runs: Sequence[ModelRun]) -> list[str]:
    """What the step adds to an error where it is more than a small share of it."""
    return [
        f"{run.model.name}: halving the step moves {body} by {moved:.2g} km, its error is {run.km[body][-1]:.2g} km; "
        "take a smaller --h"
        for run in runs
        for body, moved in run.step_km.items()
        if not moved <= STEP_KM + STEP_SHARE * run.km[body][-1]
    ]


def _report(args: argparse.Namespace, runs: Sequence[ModelRun], start: str, step: float, failed: list[str]) -> None:
    for failure in failed:
        warn(failure)
    arguments = {"years": args.years, "h": args.h, "forces": args.forces}
    content: dict[str, Any] = {"epoch": start, "step_yr": step, "errors": table_rows(runs), "failed": failed}
    tables = {"solar-truth.csv": csv_rows(runs)}
    deliver(args, "solar-system --truth", text(runs, start, step), tables, _figures(runs, start), arguments, **content)


def reported(years: np.ndarray) -> list[int]:
    """Places of 1, 10 and 100 years and of the end among the times."""
    span = np.abs(years)
    inside = [int(np.argmin(np.abs(span - year))) for year in REPORTED if year < span[-1] * (1 - 1e-9)]
    return [*inside, years.size - 1]


def text(runs: Sequence[ModelRun], start: str, step: float) -> str:
    """The table: for each time the error of each planet in km and arcsec."""
    bodies, years = list(runs[0].km), runs[0].years
    lines: list[tuple[str, Sequence[str]]] = []
    for place in reported(years):
        for unit in ("km", "arcsec"):
            lines.append((f"{years[place]:g} yr: error in {unit}", ()))
            for run in runs:
                found = run.km if unit == "km" else run.arcsec
                lines.append((f"  {run.model.name}", [compact(float(found[body][place])) for body in bodies]))
    lines.append(("end: change in km when the step is halved", ()))
    lines += [(f"  {run.model.name}", [compact(run.step_km[body]) for body in bodies]) for run in runs]
    head = f"Force models against DE440, {years[-1]:g} yr from {start}, EIPDOP853 with h = {step:.6g} yr"
    return f"{head}\nheliocentric positions; EMB: the mass-weighted mean of Earth and Moon\n\n" + table(
        [[body] for body in bodies], lines
    )


def table_rows(runs: Sequence[ModelRun]) -> list[dict[str, Any]]:
    """The numbers of the table."""
    return [
        _row(run, place, body) | {"step_km": run.step_km[body] if place == run.years.size - 1 else None}
        for run in runs
        for place in reported(run.years)
        for body in run.km
    ]


def csv_rows(runs: Sequence[ModelRun]) -> list[dict[str, Any]]:
    """All saved times but the start, where there is no error."""
    return [_row(run, k, body) for run in runs for k in range(1, run.years.size) for body in run.km]


def _row(run: ModelRun, k: int, body: str) -> dict[str, Any]:
    """The errors of a body at a saved time."""
    return {
        "model": run.model.name,
        "years": float(run.years[k]),
        "body": body,
        "km": float(run.km[body][k]),
        "arcsec": float(run.arcsec[body][k]),
    }


def _figures(runs: Sequence[ModelRun], start: str) -> Iterator[Any]:
    from ... import plotting

    direction = "after" if runs[0].years[-1] > 0 else "before"
    figure = plotting.longitude_figure(
        np.abs(runs[0].years),
        {run.model.name: np.array([run.km[body] for body in PANELS]) for run in runs},
        PANELS,
        time=f"years {direction} {start[:10]}",
        error="error against DE440 [km]",
        title="What each force is worth",
    )
    yield "solar-truth.png", figure
