"""``eip-scipy solar-system``: the paper's Experiment II as a table, figures and files."""

from __future__ import annotations

import argparse
import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np

from . import solar_run as sr
from . import solvers
from .problems.solar_data import YEAR_D, available
from .report import (
    UsageError,
    check_folder,
    check_target,
    compact,
    describe_machine,
    document,
    say,
    table,
    warn,
    write_csv,
    write_file,
    write_json,
)
from .work_precision import WorkPrecision

__all__ = ["add_arguments", "fixed_step_methods", "run"]

METRICS = ("error", "euclidean")
COST_YEARS = 100.0
DONE, CHECK_FAILED, INTERRUPTED = 0, 1, 130


def fixed_step_methods() -> dict[str, type[solvers.EIPSolver]]:
    """Find the solver classes that a user names: those with a tableau."""
    found = {name: getattr(solvers, name) for name in solvers.__all__}
    return {
        name: value
        for name, value in found.items()
        if isinstance(value, type) and issubclass(value, solvers.EIPSolver) and hasattr(value, "TABLEAU")
    }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``solar-system``."""
    parser.add_argument("--years", type=_positive, default=2000.0, help="length in Julian years (%(default)g)")
    parser.add_argument(
        "--h", type=_positive, default=0.002, help="step in years, shortened to divide the run (%(default)g)"
    )
    parser.add_argument(
        "--method", choices=list(fixed_step_methods()), default="EIPRK4", help="the method to show (%(default)s)"
    )
    parser.add_argument("--metric", choices=METRICS, default="error", help="its metric (%(default)s)")
    parser.add_argument("--data", choices=available(), default="de440", help="initial data (%(default)s)")


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (value > 0 and math.isfinite(value)):
        raise argparse.ArgumentTypeError(f"expected a positive number, got {text!r}")
    return value


@dataclass
class Study:
    """The runs done so far and what follows from them; an interruption leaves it usable."""

    scene: sr.Scene
    order: int
    runs: list[sr.MethodRun] = field(default_factory=list)
    tight: sr.MethodRun | None = None
    cost: WorkPrecision | None = None
    cost_scene: sr.Scene | None = None

    def errors(self, year: float) -> dict[str, sr.PointErrors]:
        """Errors of the runs at a time, where they are known."""
        found = {run.name: sr.errors_at(self.scene, run, year, self.tight) for run in self.runs}
        return {name: errors for name, errors in found.items() if errors is not None}

    def checks(self) -> list[sr.Check]:
        """Do the command's checks, as far as there are runs for them."""
        return sr.checks(self.scene, self.order, self.runs[0], self.tight) if self.runs else []


def run(args: argparse.Namespace, judge: sr.Judge | None) -> int:
    """Run the command.

    Parameters
    ----------
    args : argparse.Namespace
        Options of `add_arguments`, and ``out``, ``json`` (Path or None) and ``quiet``.
    judge : callable or None
        `eip_scipy.integrations.rebound.run`, None without REBOUND.

    Returns
    -------
    int
        Exit status: 0 done, 1 a check failed, 130 interrupted.

    Raises
    ------
    UsageError
        For arguments or files that cannot be used.
    """
    try:
        study = Study(
            sr.make_scene(args.data, args.years, args.h), fixed_step_methods()[args.method].TABLEAU.order
        )
    except ValueError as error:
        raise UsageError(str(error)) from error
    check_folder(args.out)
    if args.json is not None:
        check_target(args.json)
    interrupted = _integrate(study, args, judge)
    if not study.runs:
        return INTERRUPTED
    if not args.quiet:
        say(_text(study, args))
    status = DONE if all(check.passed for check in study.checks()) else CHECK_FAILED
    _write_numbers(study, args)
    if interrupted:
        warn("interrupted; the runs that were done are in the table and the files")
        return INTERRUPTED
    try:
        _time_methods(study, args, judge)
        _write_numbers(study, args)
    except KeyboardInterrupt:
        warn("interrupted; the table is complete, error against cost and the figures are missing")
        return INTERRUPTED
    _write_figures(study, args)
    return status


def _integrate(study: Study, args: argparse.Namespace, judge: sr.Judge | None) -> bool:
    """Do the runs one by one; True if the user interrupted them."""
    tasks = sr.plan(study.scene, fixed_step_methods()[args.method], args.metric, judge)
    try:
        for task in tasks:
            with _waiting(task.name, shown=not (args.quiet or task.has_bar)):
                study.runs.append(task.start(not args.quiet))
        study.tight = study.runs[-1]
    except KeyboardInterrupt:
        return True
    except MemoryError as error:
        raise UsageError(f"not enough memory: {error}") from error
    return False


@contextlib.contextmanager
def _waiting(label: str, *, shown: bool) -> Iterator[None]:
    """Show what runs, and for how long, where there is no progress to be had."""
    from tqdm import tqdm

    with tqdm(total=1, desc=label, bar_format="{desc}: {elapsed}", disable=not shown) as bar:
        yield
        bar.update()


def _time_methods(study: Study, args: argparse.Namespace, judge: sr.Judge | None) -> None:
    from tqdm import tqdm

    years = min(study.scene.years, COST_YEARS)
    scene = study.scene if years == study.scene.years else sr.make_scene(args.data, years, min(args.h, years))
    methods = sr.cost_methods(scene, fixed_step_methods()[args.method], args.metric, judge)
    total = sr.REPEATS * sum(len(steps) for _, steps in methods.values())
    with tqdm(total=total, desc="error against cost", unit="run", disable=args.quiet) as bar:
        study.cost = sr.cost(scene, methods, judge, bar.update)
    study.cost_scene = scene


# --- text ---


def _text(study: Study, args: argparse.Namespace) -> str:
    parts = [_head(study, args), _table(study), _notes(study), *_check_lines(study)]
    return "\n".join(["", *parts])


def _head(study: Study, args: argparse.Namespace) -> str:
    scene = study.scene
    asked = "" if math.isclose(scene.h, args.h, rel_tol=1e-12) else f", shortened from {args.h:g} to divide the run"
    return "\n".join(
        [
            f"Solar system, {scene.years:g} yr from {scene.data.epoch}, initial data {args.data!r}",
            f"h = {scene.h:.6g} yr = {scene.h * YEAR_D:.6g} d{asked}; {scene.n_saves + 1} states saved",
            _reference_line(study),
            "",
        ]
    )


def _reference_line(study: Study) -> str:
    sources = {errors.reference for errors in study.errors(study.scene.years).values()}
    if not sources:
        return "No reference: the runs did not get to the end."
    if sources == {"stored states"}:
        counted = f"; turns counted along {study.tight.name}" if study.tight else ""
        return f"Reference: stored states (Taylor, 80 bits) at {study.scene.years:g} yr{counted}"
    return f"Reference: the tightest run at hand, {sources.pop()}"


def _table(study: Study) -> str:
    end = study.errors(study.scene.years)
    rows: list[tuple[str, Sequence[str]]] = [
        ("step [d]", [_step(run) for run in study.runs]),
        ("wall time [s]", [compact(run.wall_time) for run in study.runs]),
        ("max |dH/H|", [compact(float(run.energy_error.max())) for run in study.runs]),
        ("max |dL/L|", [compact(float(run.momentum_error.max())) for run in study.runs]),
    ]
    for heading, quantity in (("error of longitude [rad]", "longitude"), ("error of position [AU]", "position")):
        rows.append((heading, ()))
        for k, planet in enumerate(study.scene.planets):
            rows.append((f"  {planet}", [_cell(study, run, end.get(run.name), quantity, k) for run in study.runs]))
    return table([run.head for run in study.runs], rows)


def _step(run: sr.MethodRun) -> str:
    return "adaptive" if run.step is None else f"{run.step * YEAR_D:.4g}"


def _cell(study: Study, run: sr.MethodRun, errors: sr.PointErrors | None, quantity: str, k: int) -> str:
    if errors is None:
        return "failed" if run.failure else "ref." if run is study.tight else "-"
    value = float(getattr(errors, quantity)[k])
    return "lost" if study.tight is not None and math.isnan(value) else compact(value)


def _notes(study: Study) -> str:
    shown = {run.name for run in study.runs}
    notes = [
        "Heliocentric ecliptic longitude, turns counted; dH, dL: largest along the saved states.",
        "SV: Stoermer-Verlet, kick-drift-kick." if "SV" in shown else "",
        "WHFast (c17: corrector of order 17), IAS15: REBOUND." if "IAS15" in shown else "",
        "EIPRK5 tight: a quarter of the step, compensated." if "EIPRK5 (tight)" in shown else "",
        "EMB: barycentre of Earth and Moon." if "EMB" in study.scene.planets else "",
    ]
    end = study.errors(study.scene.years).values()
    if study.tight is not None and any(np.isnan(errors.longitude).any() for errors in end):
        notes.append("lost: the longitude error grows by too much between saved states for its turns to be counted.")
    failures = [f"{run.name} ended at {run.t[-1]:g} yr: {run.failure}" for run in study.runs if run.failure]
    return "\n".join(["", fill(" ".join(filter(None, notes)), 79), *failures])


def _check_lines(study: Study) -> list[str]:
    return ["", *(f"{'ok    ' if check.passed else 'FAILED'} {check.text}" for check in study.checks())]


# --- files ---


def _write_numbers(study: Study, args: argparse.Namespace) -> None:
    _say(args, write_csv(args.out / "solar-system.csv", _csv_rows(study)), again=study.cost is not None)
    if study.cost is not None:
        points = [{"years": study.cost_scene.years, **p._asdict()} for p in study.cost.points]  # type: ignore[union-attr]
        _say(args, write_csv(args.out / "error-against-cost.csv", points))
    if args.json is not None:
        _say(args, write_json(args.json, _json(study, args)), again=study.cost is not None)


def _say(args: argparse.Namespace, path: Path, *, again: bool = False) -> None:
    if not (args.quiet or again):
        say(f"wrote {path}")


def _csv_rows(study: Study) -> list[dict[str, Any]]:
    """Make a row for each method and time with a reference, all planets in it."""
    rows = []
    planets = study.scene.planets
    for year in sr.report_times(study.scene):
        known = study.errors(year)
        for run in study.runs:
            errors = known.get(run.name)
            unknown = [None] * len(planets)
            longitude, position = (errors.longitude, errors.position) if errors else (unknown, unknown)
            rows.append(
                {
                    "method": run.name,
                    "step_yr": run.step,
                    "wall_time_s": run.wall_time,
                    "max_relative_error_H": run.energy_error.max(),
                    "max_relative_error_L": run.momentum_error.max(),
                    "year": year,
                    "reference": errors.reference if errors else None,
                    **{f"longitude_{p}_rad": value for p, value in zip(planets, longitude, strict=True)},
                    **{f"position_{p}_AU": value for p, value in zip(planets, position, strict=True)},
                }
            )
    return rows


def _json(study: Study, args: argparse.Namespace) -> dict[str, Any]:
    scene = study.scene
    times = {year: study.errors(year) for year in sr.report_times(scene)}
    methods = [
        {
            "method": run.name,
            "step_yr": run.step,
            "wall_time_s": run.wall_time,
            "max_relative_error_H": run.energy_error.max(),
            "max_relative_error_L": run.momentum_error.max(),
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
    cost = study.cost and {
        "years": study.cost_scene and study.cost_scene.years,
        "error": "Mercury's position [AU]",
        "points": [point._asdict() for point in study.cost.points],
    }
    return document(
        "solar-system",
        {key: getattr(args, key) for key in ("years", "h", "method", "metric", "data")},
        step_yr=scene.h,
        data={"epoch": scene.data.epoch, "axes": scene.data.axes, "source": scene.data.source},
        methods=methods,
        cost=cost,
        checks=[check._asdict() for check in study.checks()],
    )


# --- figures ---

OUTER, INNER = slice(4, 9), slice(0, 4)
ELLIPSES = 40


def _write_figures(study: Study, args: argparse.Namespace) -> None:
    try:
        from . import plotting
    except ImportError as error:
        warn(f"no figures: {error}")
        return
    # One style for a method in all figures.
    names = dict.fromkeys([*(run.name for run in study.runs), *(p.method for p in study.cost.points)])  # type: ignore[union-attr]
    styles = plotting.method_styles(names)
    figures: dict[str, Callable[[], Any]] = {
        "invariant-errors.png": lambda: _errors_figure(plotting, study, styles),
        "longitude-errors.png": lambda: _longitude_figure(plotting, study, styles),
        "orbits-outer.png": lambda: _orbits_figure(plotting, study, OUTER, "Outer planets and Pluto"),
        "orbits-inner.png": lambda: _orbits_figure(plotting, study, INNER, "Inner planets"),
        "orbit-mercury.png": lambda: _mercury_figure(plotting, study),
        "error-against-cost.png": lambda: _cost_figure(plotting, study, styles),
    }
    for name, make in figures.items():
        figure = make()
        _say(args, write_file(args.out / name, figure.savefig))


def _span(study: Study) -> str:
    return f"{study.scene.years:g} yr, {study.scene.data.name}"


def _longitudes(study: Study) -> dict[str, np.ndarray]:
    """Longitude errors along each run but the reference."""
    tight = study.tight
    if tight is None:
        return {}
    return {run.name: sr.longitude_errors(study.scene, run, tight) for run in study.runs if run is not tight}


def _errors_figure(plotting: Any, study: Study, styles: Any) -> Any:
    longitude = _longitudes(study)
    series = {}
    for run in study.runs:
        mercury = longitude[run.name][sr.MERCURY] if run.name in longitude else np.full(run.t.size, np.nan)
        series[run.name] = plotting.ErrorSeries(run.t, {"H": run.energy_error, "L": run.momentum_error}, mercury)
    return plotting.errors_figure(
        series,
        styles=styles,
        time="time [yr]",
        trajectory=f"|longitude of Mercury - {_reference_name(study)}| [rad]",
        title=f"Kept invariants are no proof of a right orbit: solar system, {_span(study)}",
    )


def _reference_name(study: Study) -> str:
    return study.tight.name if study.tight else "reference"


def _longitude_figure(plotting: Any, study: Study, styles: Any) -> Any:
    return plotting.longitude_figure(
        study.tight.t if study.tight else (),
        _longitudes(study),
        study.scene.planets,
        styles=styles,
        time="time [yr]",
        title=f"Error of heliocentric longitude against {_reference_name(study)}: {_span(study)}",
    )


def _shown(study: Study) -> dict[str, sr.MethodRun]:
    """Stoermer-Verlet and the method asked for, as in the paper, and the reference."""
    verlet = next(run for run in study.runs if run.name == "SV")
    shown = {"Störmer-Verlet": verlet, study.runs[0].name: study.runs[0]}
    if study.tight:
        shown[f"{study.tight.name} (reference)"] = study.tight
    return {f"{name}, ended at {run.t[-1]:.4g} yr" if run.failure else name: run for name, run in shown.items()}


def _sample(run: sr.MethodRun) -> np.ndarray:
    """Choose some saved states; not equally spaced, which may show a precession only at its own period."""
    golden = np.arange(1, ELLIPSES) * (np.sqrt(5.0) - 1) / 2 % 1.0
    return np.unique(np.append((golden * run.t.size).astype(int), [0, run.t.size - 1]))


def _orbits_figure(plotting: Any, study: Study, which: slice, title: str) -> Any:
    scene = study.scene
    panels = {}
    for name, run in _shown(study).items():
        orbits = sr.osculating_orbits(scene, run.y[:, _sample(run)])[which]
        panels[name] = plotting.Orbits(orbits, sr.jacobi(scene, run.y[:, -1:])[0][which, :2, 0])
    return plotting.orbits_figure(
        panels,
        scene.planets[which],
        unit="AU",
        title=f"{title}: osculating orbits during {_span(study)}, plane of the ecliptic",
    )


def _mercury_figure(plotting: Any, study: Study) -> Any:
    panels = {}
    for name, run in _shown(study).items():
        sample = _sample(run)
        panels[name] = (run.t[sample], sr.osculating_orbits(study.scene, run.y[:, sample])[sr.MERCURY])
    return plotting.orbit_in_time_figure(
        panels,
        unit="AU",
        time="time [yr]",
        title=f"Mercury's osculating orbit during {_span(study)}, plane of the ecliptic",
    )


def _cost_figure(plotting: Any, study: Study, styles: Any) -> Any:
    assert study.cost is not None
    assert study.cost_scene is not None
    return plotting.cost_figure(
        study.cost.points,
        styles=styles,
        error="error of Mercury's position [AU]",
        title=f"Error against cost: runs of {study.cost_scene.years:g} yr, {study.scene.data.name}",
        footnote=f"{describe_machine()}; one thread, least of {sr.REPEATS} timings",
    )
