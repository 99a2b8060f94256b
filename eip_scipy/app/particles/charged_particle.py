"""``eip-scipy charged-particle``: the paper's Experiment III by several methods, numbers, checks and figures."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from typing import Any

from ...problems.particles.charged_particle import ORBITS
from ..report import UsageError, check_outputs, deliver, warn
from . import report as particle_report
from .runs import METHODS, PAPER_METHODS, ParticleStudy, study

__all__ = ["add_arguments", "record", "results", "run", "run_scenes"]

DONE, FAILED, INTERRUPTED = 0, 1, 130
FIELDS = ("uniform", "tokamak")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``charged-particle``."""
    parser.add_argument("--field", choices=FIELDS, help="one field; default: both")
    parser.add_argument(
        "--orbit", choices=tuple(ORBITS), help="one orbit of the tokamak (implies --field tokamak); default: both"
    )


def run(args: argparse.Namespace) -> int:
    """Run the command.

    Parameters
    ----------
    args : argparse.Namespace
        Options of `add_arguments`, and ``out``, ``json`` (Path or None) and ``quiet``.

    Returns
    -------
    int
        Exit status: 0 done, 1 a check failed, 130 interrupted.
    """
    if args.orbit is not None and args.field == "uniform":
        raise UsageError("--orbit is for the tokamak; leave it out, or take --field tokamak")
    check_outputs(args.out, args.json)
    if find_spec("numba") is None:
        warn('the fields are Python here, which takes hours; with pip install "eip_scipy[numba]" it is a minute')
    scenes = _scenes(args.field, args.orbit)
    try:
        studies = run_scenes(scenes, paper_only=False, quiet=args.quiet)
    except KeyboardInterrupt:
        warn("interrupted; nothing was written")
        return INTERRUPTED
    content = record(studies)
    arguments = {"field": args.field, "orbit": args.orbit}
    tables, figures = results(studies, "charged-particle", paper_only=False)
    deliver(
        args,
        "charged-particle",
        "\n\n".join(particle_report.text(found) for found in studies.values()),
        tables,
        figures,
        arguments,
        **content,
    )
    return DONE if content["passed"] else FAILED


def _scenes(field: str | None, orbit: str | None) -> list[str]:
    orbits = [f"tokamak-{name}" for name in ORBITS if orbit in (None, name)]
    if orbit is not None or field == "tokamak":
        return orbits
    return ["uniform"] if field == "uniform" else ["uniform", *orbits]


def run_scenes(scenes: Sequence[str], *, paper_only: bool, quiet: bool) -> dict[str, ParticleStudy]:
    """Run scenes with a progress bar.

    Parameters
    ----------
    scenes : sequence of str
    paper_only : bool
        Leave out the methods that the paper's figures do not need.
    quiet : bool
        Show no progress.

    Returns
    -------
    dict of str to ParticleStudy
    """
    from tqdm import tqdm

    runs = len(scenes) * (1 + (len(PAPER_METHODS) if paper_only else len(METHODS) + 1))
    with tqdm(total=runs, desc="charged particle", unit="run", disable=quiet, leave=False) as bar:
        return {name: study(name, paper_only=paper_only, callback=bar.update) for name in scenes}


def results(studies: dict[str, ParticleStudy], stem: str, *, paper_only: bool) -> tuple[dict[str, Any], Iterator[Any]]:
    """``STEM.csv`` and figures, ``STEM-FIELD.png`` or, for the paper's, ``STEM.png``, for `write_results`."""
    lines = [row for found in studies.values() for row in particle_report.rows(found)]
    figures = (
        (f"{stem}.png" if paper_only else f"{stem}-{name}.png", figure)
        for name, figure in particle_report.figures(studies, paper_only=paper_only)
    )
    return {f"{stem}.csv": lines}, figures


def record(studies: dict[str, ParticleStudy]) -> dict[str, Any]:
    """Numbers and checks as plain data: ``scenes`` (by scene and method), ``checks`` and ``passed``."""
    checks = [check for found in studies.values() for check in particle_report.checks(found)]
    return {
        "scenes": {name: found.numbers for name, found in studies.items()},
        "checks": [{**check._asdict(), "passed": check.passed} for check in checks],
        "passed": all(check.passed for check in checks),
    }
