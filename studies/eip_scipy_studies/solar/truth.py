"""``eip-scipy solar-system truth``: error of each force model against the ephemeris DE440."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from eip_scipy import EIPDOP853, integrate
from eip_scipy.problems import SolarSystemData, solar_system
from eip_scipy.problems.gravity.forces import FORCES, check_forces
from eip_scipy.problems.gravity.solar_data import AU_KM, YEAR_D

from ..long_runs import named, positive
from ..report import UsageError, compact, table, warn
from ..study import Check, Figures, PartlyDone, Rows, Session, Study, one_of, option
from .epoch import AnyEpoch, kernels, one_line
from .runs import whole_number

PAPER_EPOCH = (2456690.5, 20.3 / 24)
STEP = 0.001
MOON = "moon"  # a body, not a force, but chosen together with the forces
KNOWN = (*(force for force in FORCES if force != "drag"), MOON)
STANDARD = ((), ("1pn",), ("1pn", "moon-quadrupole"), ("1pn", MOON), ("1pn", "j2", MOON))
REPORTED = (1.0, 10.0, 100.0)
PANELS = ("Mercury", "EMB", "Mars", "Jupiter")
ARCSEC = math.degrees(1.0) * 3600
# The step may add this share of an error, and this many km, an error below that of any model here.
STEP_SHARE, STEP_KM = 0.01, 1e-3


class Model(NamedTuple):
    """Forces other than Newton's, and whether the Moon is a separate body."""

    forces: tuple[str, ...]
    moon: bool

    @property
    def name(self) -> str:
        """Return the model's name in the table: "Newton", and the words of the option ``--forces``, joined by " + "."""
        return " + ".join(["Newton", *self.forces, *[MOON] * self.moon])


class ModelRun(NamedTuple):
    """Errors of a model against the ephemeris at the times `years` (m,).

    `km` and `arcsec` have for each body the distance from its position in the ephemeris, and the angle between both
    positions seen from the Sun, (m,).
    """

    model: Model
    years: np.ndarray
    km: dict[str, np.ndarray]
    arcsec: dict[str, np.ndarray]
    step_km: dict[str, float]
    """Change of the final position when the step is halved."""


def models(forces: Sequence[str] | None) -> list[Model]:
    """Return the models to be compared: Newton's gravitation and the model with `forces`, or those in `STANDARD`.

    The name `MOON` among the forces makes the Moon a separate body. `STANDARD` is used if `forces` is None. A
    ValueError is raised if two of the forces exclude each other.
    """
    asked = STANDARD if forces is None else ((), tuple(forces))
    found = [Model(check_forces(name for name in names if name != MOON), MOON in names) for names in asked]
    return list(dict.fromkeys(found))


def save_times(years: float, h: float) -> tuple[np.ndarray, int, float]:
    """Return the times of saved states in years, the number of steps between two of them, and the step in years.

    The times have the sign of `years`; 1, 10, 100 and the end are among them if they are in the span. The step is at
    most `h`, and the interval before the end may be shorter than the others. A ValueError is raised if the step is
    longer than the run.
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

    `data` must have the Moon as a separate body if the model has it. `times`, `every` and `step` are the results of
    `save_times`, and `truth` has the heliocentric positions (m, 3) at these times by body, km.
    """
    halved, own = (_positions(model, data, times, every * k, step / k, progress) for k in (2, 1))
    km, arcsec = errors(own, truth)
    moved = {body: float(np.linalg.norm((own[body] - halved[body])[-1])) for body in truth}
    return ModelRun(model, times, km, arcsec, moved)


def _positions(
    model: Model, data: SolarSystemData, times: np.ndarray, every: int, step: float, progress: bool
) -> dict[str, np.ndarray]:
    """Integrate a model, and return the heliocentric positions (m, 3) in km of each body but the Sun at `times`.

    There are `every` steps of `step` years between two saved states. If the Moon is a separate body, "EMB" is the
    centre of mass of Earth and Moon.
    """
    problem = solar_system(data, years=float(times[-1]), h=step, forces=model.forces)
    method = named(EIPDOP853, model.name)
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
    """Return, by body, the distances in km and the angles in arcsec (m,) between the positions `own` and `truth`.

    Positions are heliocentric, (m, 3), in km; angles are seen from the Sun.
    """
    km = {body: np.linalg.norm(own[body] - there, axis=1) for body, there in truth.items()}
    chord = {body: np.linalg.norm(_unit(own[body]) - _unit(there), axis=1) for body, there in truth.items()}
    return km, {body: 2 * np.arcsin(np.minimum(c / 2, 1.0)) * ARCSEC for body, c in chord.items()}


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


class Found(NamedTuple):
    """The runs of all models, the epoch at which they start (`start`) as text, and the step in years."""

    runs: list[ModelRun]
    start: str
    step: float


def _span(text: str) -> float:
    return -positive(text[1:]) if text.startswith("-") else positive(text)


@dataclass(frozen=True, kw_only=True)
class Truth(AnyEpoch, Study[Found]):
    """Command ``eip-scipy solar-system truth``."""

    years: float = option(100.0, "length in Julian years, negative to go back (default: %(default)g)", type=_span)
    h: float | None = option(None, f"step in years, shortened to divide the run (default: {STEP:g})", type=positive)
    forces: Sequence[str] | None = option(
        None,
        f"forces of one model in place of the standard ones; some of {', '.join(KNOWN)}",
        type=one_of("force", KNOWN),
        nargs="+",
        metavar="FORCE",
    )

    def arguments(self) -> dict[str, Any]:
        """Return the user's settings for the JSON file, except the epoch and the kernel."""
        return {"years": self.years, "h": self.h, "forces": self.forces}

    def measure(self, session: Session) -> Found:
        """Run the models; if the user interrupts, the completed runs are kept."""
        h = min(STEP, abs(self.years)) if self.h is None else self.h
        epoch, jpl = self.epoch or PAPER_EPOCH, kernels()
        with one_line():
            chosen = models(self.forces)
            times, every, step = save_times(self.years, h)
            truth = jpl.heliocentric(epoch, times * YEAR_D, self.kernel)
            data = {moon: jpl.initial_data(epoch, self.kernel, moon=moon) for moon in {m.moon for m in chosen}}
            for model in chosen:  # invalid combinations are reported before anything runs
                solar_system(data[model.moon], forces=model.forces)
        found = Found([], next(iter(data.values())).epoch, step)
        try:
            for model in chosen:
                own = data[model.moon]
                found.runs.append(run_model(model, own, times, every, step, truth, progress=session.shown))
        except KeyboardInterrupt:
            if not found.runs:
                raise
            raise PartlyDone(found) from None
        for check in self.checks(found):
            if not check.passed:
                warn(check.text)
        return found

    def checks(self, found: Found) -> list[Check]:
        """Check that halving the step moves no body by more than `STEP_KM` plus `STEP_SHARE` of its final error."""
        return [
            Check(
                f"{run.model.name}: halving the step moves {body} by {moved:.2g} km, "
                f"its error is {run.km[body][-1]:.2g} km; take a smaller --h",
                moved <= STEP_KM + STEP_SHARE * float(run.km[body][-1]),
            )
            for run in found.runs
            for body, moved in run.step_km.items()
        ]

    def text(self, found: Found) -> str:
        runs = found.runs
        bodies, years = list(runs[0].km), runs[0].years
        lines: list[tuple[str, Sequence[str]]] = []
        for place in reported(years):
            for unit in ("km", "arcsec"):
                lines.append((f"{years[place]:g} yr: error in {unit}", ()))
                for run in runs:
                    errors = run.km if unit == "km" else run.arcsec
                    lines.append((f"  {run.model.name}", [compact(float(errors[body][place])) for body in bodies]))
        lines.append(("end: change in km when the step is halved", ()))
        lines += [(f"  {run.model.name}", [compact(run.step_km[body]) for body in bodies]) for run in runs]
        head = (
            f"Force models against DE440, {years[-1]:g} yr from {found.start}, EIPDOP853 with h = {found.step:.6g} yr\n"
            "heliocentric positions; EMB: the mass-weighted mean of Earth and Moon\n\n"
        )
        return head + table([[body] for body in bodies], lines)

    def tables(self, found: Found) -> dict[str, Rows]:
        return {"solar-truth.csv": csv_rows(found.runs)}

    def numbers(self, found: Found) -> dict[str, Any]:
        failed = [check.text for check in self.checks(found) if not check.passed]
        return {"epoch": found.start, "step_yr": found.step, "errors": table_rows(found.runs), "failed": failed}

    def figures(self, found: Found) -> Figures:
        from ..plotting import longitude_figure

        runs = found.runs
        direction = "after" if runs[0].years[-1] > 0 else "before"
        figure = longitude_figure(
            np.abs(runs[0].years),
            {run.model.name: np.array([run.km[body] for body in PANELS]) for run in runs},
            PANELS,
            time=f"years {direction} {found.start[:10]}",
            error="error against DE440 [km]",
            title="What each force is worth",
        )
        yield "solar-truth.png", figure


def reported(years: np.ndarray) -> list[int]:
    """Return the indices in `years` of the end, and of those of 1, 10 and 100 years that are before it."""
    span = np.abs(years)
    inside = [int(np.argmin(np.abs(span - year))) for year in REPORTED if year < span[-1] * (1 - 1e-9)]
    return [*inside, years.size - 1]


def table_rows(runs: Sequence[ModelRun]) -> list[dict[str, Any]]:
    """Return a row of errors for each model, each of the `reported` times and each body."""
    return [
        _row(run, place, body) | {"step_km": run.step_km[body] if place == run.years.size - 1 else None}
        for run in runs
        for place in reported(run.years)
        for body in run.km
    ]


def csv_rows(runs: Sequence[ModelRun]) -> list[dict[str, Any]]:
    """Return a row for each model, body and saved time except the start, at which there is no error."""
    return [_row(run, k, body) for run in runs for k in range(1, run.years.size) for body in run.km]


def _row(run: ModelRun, k: int, body: str) -> dict[str, Any]:
    """Return a row with the errors of a body at the time ``run.years[k]``."""
    return {
        "model": run.model.name,
        "years": float(run.years[k]),
        "body": body,
        "km": float(run.km[body][k]),
        "arcsec": float(run.arcsec[body][k]),
    }
