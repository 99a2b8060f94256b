"""The figures of ``eip-scipy solar-system``: functions with the names of their files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from eip_scipy.plotting import MARKERS, PALETTE, log_errors, method_styles

from ..plot import blank_figure, cost_figure, envelope, legend_below, log_x
from ..report import describe_machine
from .comparison import Comparison, heliocentric
from .cost import ENOUGH_SECONDS, REPEATS, TimedRun
from .truth import ModelRun

MERCURY = 0
PANELS = ("Mercury", "EMB", "Mars", "Jupiter")  # of the figure of force models


def invariant_errors(found: Comparison) -> Any:
    """Draw errors of H and L in time, and next to them the error of Mercury's longitude."""
    assert found.tight is not None
    title = f"Preserved invariants do not prove a correct orbit: solar system, {found.span}"
    longitude = f"|longitude of Mercury - {found.tight.name}| [rad]"
    styles = method_styles(run.name for run in found.runs)
    figure = blank_figure(11.7, 4.4, title)
    axes = figure.subplots(1, 3, sharex=True)
    for run in found.runs:
        unknown = np.full((1, run.t.size), np.nan)
        series = run.energy_error, run.momentum_error, found.longitudes.get(run.name, unknown)[MERCURY]
        for axis, values in zip(axes, series, strict=True):
            envelope(axis, run.t, values, styles[run.name])
    for axis, label in zip(axes, ("relative error of H", "relative error of L", longitude), strict=True):
        log_errors(axis, "time [yr]", label)
    legend_below(figure, axes[0])
    return figure


def longitude_errors(found: Comparison) -> Any:
    """Draw errors of all planets' longitudes in time."""
    assert found.tight is not None
    planets = found.planets
    series = {name: dict(zip(planets, errors, strict=True)) for name, errors in found.longitudes.items()}
    title = f"Error of heliocentric longitude against {found.tight.name}: {found.span}"
    return _by_planet(found.tight.t, series, planets, "time [yr]", "|error of longitude| [rad]", title)


def solar_truth(years: np.ndarray, runs: Sequence[ModelRun], start: str) -> Any:
    """Draw the errors of force models in time; `start` is the epoch as text."""
    series = {run.model: run.km for run in runs}
    time = f"years {'after' if years[-1] > 0 else 'before'} {start[:10]}"
    return _by_planet(np.abs(years), series, PANELS, time, "error against DE440 [km]", "What each force is worth")


def _by_planet(
    t: np.ndarray, series: Mapping[str, Mapping[str, Any]], planets: Sequence[str], time: str, error: str, title: str
) -> Any:
    """Draw errors in time by method and planet, a panel for each planet; on log axes a power is a straight line."""
    styles, columns = method_styles(series), 2 if len(planets) == 4 else 3
    rows = -(-len(planets) // columns)
    figure = blank_figure(3.7 * columns, 2.5 * rows + 1.2, title)
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for k, (axis, planet) in enumerate(zip(axes.flat, planets, strict=True)):
        for method, errors in series.items():
            envelope(axis, t, errors[planet], styles[method], log=True)
        log_x(axis)
        log_errors(axis, time if k + columns >= len(planets) else "", "")
        axis.set_title(planet, fontsize="medium")
    figure.supylabel(error, fontsize="medium")
    legend_below(figure, axes[0, 0])
    return figure


def orbits(found: Comparison) -> Any:
    """Draw where the planets were at the saved times, by Stoermer-Verlet, the chosen method and the reference."""
    assert found.tight is not None
    shown = dict.fromkeys(["SV", found.runs[0].name, found.tight.name])
    figure = blank_figure(4.1 * len(shown), 9.0, f"Heliocentric positions at saved times, {found.span}, ecliptic plane")
    axes = figure.subplots(2, len(shown), sharex="row", sharey="row", squeeze=False)
    for column, name in zip(axes.T, shown, strict=True):
        (run,) = (run for run in found.runs if run.name == name)
        places = heliocentric(found.scene, run.y)
        for axis, first, last in zip(column, (4, 0), (9, 4), strict=True):
            axis.plot(0, 0, ls="", marker="+", color="black", ms=8)
            for k in range(first, last):
                axis.plot(*places[k, :2], ls="", marker=".", ms=1.5, mew=0, color=PALETTE[k], rasterized=True)
                end = {"marker": MARKERS[k], "mec": "white", "ms": 7, "label": found.planets[k]}
                axis.plot(*places[k, :2, -1], ls="", color=PALETTE[k], **end)
            axis.set(aspect="equal", xlabel="x [AU]")
            axis.grid(alpha=0.2)
            if name == found.tight.name:
                axis.legend(fontsize="x-small", title="final position", title_fontsize="x-small")
        column[0].set_title(f"{name}, ended at {run.t[-1]:.4g} yr" if run.failure else name, fontsize="medium")
    for axis in axes[:, 0]:
        axis.set_ylabel("y [AU]")
    return figure


def error_against_cost(data: str, runs: Sequence[TimedRun]) -> Any:
    """Draw error against cost, for Mercury and for the worst of the other planets; `data` names the start."""
    panels = []
    for title, kind in (("Mercury", "error"), ("the worst of the other planets", "error_others")):
        curves: dict[str, tuple[list[float], list[float]]] = {run.method: ([], []) for run in runs}
        for run in runs:
            curves[run.method][0].append(run.wall_time)
            curves[run.method][1].append(getattr(run, kind))
        panels.append((title, curves))
    footnote = f"{describe_machine()}; one thread, least of {REPEATS} timings, or one above {ENOUGH_SECONDS} s"
    title = f"Error against cost: runs of {runs[0].years:g} yr, {data}"
    return cost_figure(panels, cost="wall time [s]", error="error of position [AU]", title=title, footnote=footnote)
