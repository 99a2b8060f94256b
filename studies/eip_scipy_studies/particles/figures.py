"""Figure of the charged particles: orbits, errors of the invariants and of the orbit, a row for each method."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from eip_scipy.plotting import PALETTE, log_errors, method_styles

from ..plot import blank_figure, envelope
from .charged_particle import TITLES, Experiment, change

POINTS = 40_000  # largest number of points, approximately, of an orbit's curve
Curves = dict[str, tuple[np.ndarray, np.ndarray]]


def particle_figure(found: Mapping[str, Experiment], names: Sequence[str]) -> Figure:
    """Draw the uniform field or both orbits in the tokamak, `found` by scene, a row for each of the methods `names`."""
    uniform = "uniform" in found
    rows = {name: _uniform(found["uniform"], name) if uniform else _tokamak(found, name) for name in names}
    columns, title = len(rows[names[0]][0]) + 2, TITLES["uniform" if uniform else "tokamak"]
    figure = blank_figure(3.4 * columns, 2.9 * len(rows) + 0.6, f"Charged particle, {title}")
    axes = figure.subplots(len(rows), columns, squeeze=False)
    for line, (name, (orbits, error)) in zip(axes, rows.items(), strict=True):
        for axis, (panel, path) in zip(line, orbits.items(), strict=False):
            axis.plot(*path, color=PALETTE[0], lw=0.35, rasterized=True)
            axis.set_title(f"{name}\n{panel}", fontsize="medium")
            axis.set(xlabel="x" if uniform else "R", ylabel="y" if uniform else "z", aspect="equal")
            axis.grid(alpha=0.2)
        _errors(line[-2], _invariants(found, name), "relative error")
        _errors(line[-1], error, "error of angle [rad]" if uniform else "error of guiding centre")
    for column in range(columns):
        _share_limits(axes[:, column], "xy" if column < columns - 2 else "y")
    return figure


def _uniform(experiment: Experiment, name: str) -> tuple[Curves, Curves]:
    """Return the orbit in its first and 100th (or last) turn, and the errors of gyrophase and guiding centre."""
    orbit, truth = experiment.orbits[name], experiment.truth
    turns = orbit.turns()
    last = min(100.0, float(turns[-1]))
    parts = {
        "first turn": turns <= min(1.0, last),
        "100th turn" if last == 100 else "last turn": (turns >= last - 1) & (turns <= last),
    }
    angle = orbit.averaged(orbit.guiding_angle - truth.guiding_angle)
    errors = {
        "gyrophase": (orbit.t, orbit.gyrophase - truth.gyrophase),
        "guiding centre": (orbit.averaged(orbit.t), angle),
    }
    return {title: (orbit.x[0, part], orbit.x[1, part]) for title, part in parts.items()}, errors


def _tokamak(found: Mapping[str, Experiment], name: str) -> tuple[Curves, Curves]:
    """Return both orbits, and the errors of their averaged guiding centres."""
    orbits, errors = {}, {}
    for scene, experiment in found.items():
        orbit, kind = experiment.orbits[name], scene.removeprefix("tokamak-")
        every = max(orbit.t.size // POINTS, 1)  # a few states of each gyration are enough for the eye
        orbits[f"{kind} orbit"] = orbit.R[::every], orbit.z[::every]
        apart = orbit.averaged(orbit.guiding_centre - experiment.truth.guiding_centre)
        errors[kind] = (orbit.averaged(orbit.t), np.linalg.norm(apart, axis=0))
    return orbits, errors


def _invariants(found: Mapping[str, Experiment], name: str) -> Curves:
    curves: Curves = {}
    for scene, experiment in found.items():
        orbit, kind = experiment.orbits[name], "" if scene == "uniform" else f", {scene.removeprefix('tokamak-')}"
        curves |= {f"H{kind}": (orbit.t, change(orbit.energy)), f"L{kind}": (orbit.t, change(orbit.momentum))}
    return curves


def _errors(axis: Any, curves: Curves, label: str) -> None:
    for style, (t, error) in zip(method_styles(curves).values(), curves.values(), strict=True):
        envelope(axis, t, error, style)
    log_errors(axis, "t", label)
    axis.legend(fontsize="x-small", loc="best", handlelength=3, framealpha=0.8)


def _share_limits(axes: Iterable[Any], along: str) -> None:
    """Give all axes the same limits, wide enough for the data of all."""
    for x in along:
        limits = np.array([getattr(axis, f"get_{x}lim")() for axis in axes])
        for axis in axes:
            axis.set(**{f"{x}lim": (limits[:, 0].min(), limits[:, 1].max())})
