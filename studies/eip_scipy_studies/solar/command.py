"""``eip-scipy solar-system``: the paper's Experiment II as a table, figures and files."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Literal

from eip_scipy.problems.gravity.solar_data import load

from ..output import Output, checkpoint_options, require_positive
from ..report import UsageError
from .comparison import Comparison, text
from .cost import cost_methods, show_costs
from .epoch import kernels, one_line, parse_epoch
from .runs import Rebound, Run, make_scene, methods, tableaux
from .truth import compare_forces

COST_YEARS = 100.0
FIGURES = ("invariant-errors", "longitude-errors", "orbits")


def solar_system(
    out: Output,
    *,
    years: float | None = None,
    h: float | None = None,
    method: str = "EIPRK4",
    metric: Literal["error", "euclidean"] = "error",
    data: Literal["de440", "de440-j2000", "paper"] | None = None,
    epoch: str | None = None,
    kernel: Path | None = None,
    cost: bool = False,
    truth: bool = False,
    forces: tuple[str, ...] = (),
    checkpoint: Path | None = None,
    resume: bool = False,
) -> None:
    """Run the solar system by several methods, and compare the errors of the orbits (the paper's Experiment II).

    With --truth, force models are compared with the ephemeris DE440 instead.

    Parameters
    ----------
    years : float
        length in Julian years (default: 2000); with --truth 100, negative to go back
    h : float
        step in years, shortened to divide the run (default: 0.002; with --truth 0.001)
    method : str
        method to show, EIPRK1 to EIPRK5 or another with a tableau (default: EIPRK4)
    metric : str
        metric of its projection: error or euclidean (default: error)
    data : str
        initial data that the package carries: de440 (default), de440-j2000 or paper
    epoch : str
        start at any epoch of a JPL kernel, such as "2014-02-02T20:18", "2000-01-01" (both TDB, Gregorian calendar),
        "JD2451545.0" or "2451545.0"; needs "eip_scipy[jpl]"
    kernel : Path
        file of a planetary kernel (.bsp) to use instead of DE440
    cost : bool
        time the methods at several steps, too, over at most 100 years
    truth : bool
        compare force models with the ephemeris DE440
    forces : tuple of str
        with --truth, forces of one model in place of the standard ones: 1pn, eih, gr-potential, j2, moon-quadrupole,
        moon
    checkpoint : Path
        keep checkpoints of this package's own runs in this folder
    resume : bool
        continue from the checkpoints in the folder of --checkpoint
    """
    require_positive(years=abs(years) if truth and years else years, h=h)
    if epoch is not None and data is not None:
        raise UsageError("--epoch: not allowed with --data")
    if kernel is not None and epoch is None and not truth:
        raise UsageError("--kernel goes with --epoch, which is missing: give the time in the kernel at which to start")
    if method not in tableaux():
        raise UsageError(f"--method: unknown method {method!r}, expected one of {', '.join(tableaux())}")
    if truth:
        compare_forces(out, 100.0 if years is None else years, h, epoch, kernel, forces)
        return
    if forces:
        raise UsageError("--forces goes with --truth, which is missing")
    checkpoint_options(checkpoint, resume, "")  # their errors come before the runs
    longest = 0.002 if h is None else h
    with one_line():
        start = load(data or "de440") if epoch is None else kernels().initial_data(parse_epoch(epoch), kernel)
        scene = make_scene(start, 2000.0 if years is None else years, longest)
    chosen, rebound = tableaux()[method], rebound_or_none(out)
    runs: list[Run] = []
    tasks = methods(scene, chosen, metric, rebound)
    with out.keep(checkpoint), out.bar(tasks, "solar system") as bar:
        for task in bar:
            bar.set_postfix_str(task.name)
            runs.append(task.run(scene, **checkpoint_options(checkpoint, resume, task.name)))
    if runs:
        found = Comparison(scene, runs, runs[-1] if len(runs) == len(tasks) else None)
        show(out, found, chosen.TABLEAU.order, longest)
    if cost and not out.interrupted:
        if scene.years > COST_YEARS:
            scene = make_scene(scene.data, COST_YEARS, min(longest, COST_YEARS))
        show_costs(out, scene, cost_methods(scene, chosen, metric, rebound), rebound)


def rebound_or_none(out: Output) -> Rebound | None:
    """Return REBOUND's `run`, or None if it is not installed, which is then said at the end."""
    try:
        return import_module("eip_scipy.integrations.rebound").run
    except ImportError as error:
        out.missing(f"no comparison with WHFast and IAS15: {error}")
        return None


def show(out: Output, found: Comparison, order: int, asked: float) -> None:
    """Write the table, the checks and the figures of the runs."""
    data = found.scene.data
    out.numbers |= {"step_yr": found.scene.h, "data": [data.epoch, data.axes, data.source], "methods": found.rows}
    out.rows("solar-system.csv", found.rows)
    out.text(text(found, asked))
    for line, passed in found.checks(order):
        out.check(line, passed)
    for name in FIGURES if found.tight else ():
        out.figure(f"{name}.png", f"solar.figures:{name.replace('-', '_')}", found)
