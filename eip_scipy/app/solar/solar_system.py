"""``eip-scipy solar-system``: the paper's Experiment II as a table, figures and files; options and order of events."""

from __future__ import annotations

import argparse
import contextlib
import io
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from ...checkpoint import CheckpointError
from ...ensembles.chunks import cores
from .. import long_runs
from ..beside import Beside
from ..listing import METRICS, fixed_step_methods
from ..long_runs import positive
from ..report import UsageError, check_outputs, say, warn, write_csv, write_file, write_json
from . import epoch as solar_epoch
from . import truth as solar_truth
from .cost import REPEATS, cost, cost_methods
from .errors import SolarStudy
from .report import cost_rows, csv_rows, json_content, text
from .runs import MethodRun, Peer, make_scene, plan

__all__ = ["add_arguments", "run"]

YEARS, STEP = 2000.0, 0.002
COST_YEARS = 100.0
BESIDE_YEARS = 200.0  # in shorter runs a second process would cost what it saves
BESIDE_FIGURES, OWN_FIGURES = slice(None, 4), slice(4, None)  # they take as long as the timings and the others
DONE, CHECK_FAILED, INTERRUPTED = 0, 1, 130


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``solar-system``."""
    parser.add_argument(
        "--years",
        type=_span,
        help=f"length in Julian years ({YEARS:g}; with --truth {solar_truth.YEARS:g}, negative to go back)",
    )
    parser.add_argument(
        "--h",
        type=positive,
        help=f"step in years, shortened to divide the run ({STEP:g}; with --truth {solar_truth.STEP:g})",
    )
    parser.add_argument(
        "--method", choices=list(fixed_step_methods()), default="EIPRK4", help="the method to show (%(default)s)"
    )
    parser.add_argument("--metric", choices=METRICS, default="error", help="its metric (%(default)s)")
    parser.add_argument(
        "--frontier",
        action="store_true",
        help="error against cost of high-order methods and their peers instead; --years 1, 10, 100, 1000 or 2000",
    )
    long_runs.add_arguments(parser, "the runs that this package does")
    solar_epoch.add_arguments(parser)
    solar_truth.add_arguments(parser)


def _span(text: str) -> float:
    return -positive(text[1:]) if text.startswith("-") else positive(text)


def run(args: argparse.Namespace, peer: Peer | None, ephemeris: solar_epoch.Ephemeris | None = None) -> int:
    """Run the command.

    Parameters
    ----------
    args : argparse.Namespace
        Options of `add_arguments`, and ``out``, ``json`` (Path or None) and ``quiet``.
    peer : callable or None
        `eip_scipy.integrations.rebound.run`, None without REBOUND.
    ephemeris : callable, optional
        `eip_scipy.integrations.jpl.initial_data`, for ``--epoch``.

    Returns
    -------
    int
        Exit status: 0 done, 1 a check failed, 130 interrupted.

    Raises
    ------
    UsageError
        For arguments or files that cannot be used.
    """
    args.years = YEARS if args.years is None else args.years
    args.h = STEP if args.h is None else args.h
    if args.years < 0:
        raise UsageError(f"--years: expected a positive number, got '{args.years:g}'; only --truth goes back in time")
    if args.forces:
        raise UsageError("--forces goes with --truth; without it, methods are compared under Newton's gravitation")
    long_runs.check(args)
    data = solar_epoch.initial_data(args, ephemeris)
    try:
        study = SolarStudy(make_scene(data, args.years, args.h), fixed_step_methods()[args.method].TABLEAU.order)
    except ValueError as error:
        raise UsageError(str(error)) from error
    check_outputs(args.out, args.json)
    if peer is None or args.years < BESIDE_YEARS or cores() < 2:
        return _compare(study, args, peer, None)
    with Beside() as beside:
        return _compare(study, args, peer, beside)


def _compare(study: SolarStudy, args: argparse.Namespace, peer: Peer | None, beside: Beside | None) -> int:
    """The command in its order: runs, table, timings, figures; `beside` takes the longest run, and then figures."""
    interrupted = _integrate(study, args, peer, beside)
    if interrupted:
        long_runs.tell_how_to_resume(args)
    if not study.runs:
        warn("interrupted; no run was done")
        return INTERRUPTED
    if not args.quiet:
        say(text(study, args))
    status = DONE if all(check.passed for check in study.checks()) else CHECK_FAILED
    _write_numbers(study, args)
    if interrupted:
        warn("interrupted; the runs that were done are in the table and the files")
        return INTERRUPTED
    try:
        if beside is not None:
            beside.start(partial(images, study, BESIDE_FIGURES))
        _time_methods(study, args, peer)
        _write_numbers(study, args)
    except KeyboardInterrupt:
        warn("interrupted; the table is complete, error against cost and the figures are missing")
        return INTERRUPTED
    _write_figures(study, args, beside)
    return status


def _integrate(study: SolarStudy, args: argparse.Namespace, peer: Peer | None, beside: Beside | None) -> bool:
    """Do the runs, the last of them beside the others if it may; True if the user interrupted them."""
    tasks = plan(
        study.scene, fixed_step_methods()[args.method], args.metric, peer, partial(long_runs.checkpoint_options, args)
    )
    starts: list[Callable[[], MethodRun]] = [partial(task.start, not args.quiet) for task in tasks]
    try:
        if beside is not None:
            beside.start(partial(tasks[-1].start, False))
            starts[-1], study.beside = beside.result, tasks[-1].name
        for task, start in zip(tasks, starts, strict=True):
            with _waiting(task.name, shown=not (args.quiet or task.has_bar)):
                study.runs.append(start())
        study.tight = study.runs[-1]
    except KeyboardInterrupt:
        return True
    except (MemoryError, CheckpointError) as error:
        raise long_runs.unusable(error) from error
    return False


@contextlib.contextmanager
def _waiting(label: str, *, shown: bool) -> Iterator[None]:
    """Show what runs, and for how long, where there is no progress to be had."""
    from tqdm import tqdm

    with tqdm(total=1, desc=label, bar_format="{desc}: {elapsed}", disable=not shown) as bar:
        yield
        bar.update()


def _time_methods(study: SolarStudy, args: argparse.Namespace, peer: Peer | None) -> None:
    from tqdm import tqdm

    years = min(study.scene.years, COST_YEARS)
    scene = study.scene if years == study.scene.years else make_scene(study.scene.data, years, min(args.h, years))
    methods = cost_methods(scene, fixed_step_methods()[args.method], args.metric, peer)
    total = REPEATS * sum(len(steps) for _, steps in methods.values())
    with tqdm(total=total, desc="error against cost", unit="run", disable=args.quiet) as bar:
        study.cost = cost(scene, methods, peer, bar.update)
    study.cost_scene = scene


def _write_numbers(study: SolarStudy, args: argparse.Namespace) -> None:
    """Write what is known; a second time when the timings are there, too."""
    again = bool(study.cost)
    _say(args, write_csv(args.out / "solar-system.csv", csv_rows(study)), again=again)
    if study.cost:
        _say(args, write_csv(args.out / "error-against-cost.csv", cost_rows(study)))
    if args.json is not None:
        _say(args, write_json(args.json, json_content(study, args)), again=again)


def images(study: SolarStudy, part: slice) -> dict[str, bytes]:
    """Some of the figures as PNG files, by their names."""
    from .figures import figures

    found = {}
    for name, figure in figures(study, part):
        stream = io.BytesIO()
        figure.savefig(stream, format="png")
        found[name] = stream.getvalue()
    return found


def _write_figures(study: SolarStudy, args: argparse.Namespace, beside: Beside | None) -> None:
    try:
        drawn = images(study, slice(None) if beside is None else OWN_FIGURES)
        if beside is not None:
            drawn = beside.result() | drawn
    except ImportError as error:
        warn(f"no figures: {error}")
        return
    for name, image in drawn.items():
        _say(args, write_file(args.out / name, partial(_write, image)))


def _write(image: bytes, path: Path) -> None:
    path.write_bytes(image)


def _say(args: argparse.Namespace, path: Path, *, again: bool = False) -> None:
    if not (args.quiet or again):
        say(f"wrote {path}")
