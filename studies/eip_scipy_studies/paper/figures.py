"""Figures 1 and 2 of the paper."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from eip_scipy.plotting import FLOOR, PALETTE, log_errors

from .orbits import ORBIT_END, POINTS, KeplerRun


def errors_figure(found: dict[str, KeplerRun], title: str) -> Any:
    """Draw the orbit and the errors of each run in a row, the errors as the largest of each of `POINTS` intervals."""
    figure = Figure(figsize=(9.0, 2.5 * len(found) + 0.5), dpi=160, layout="constrained")
    figure.suptitle(title, fontsize="large")
    panels = figure.subplots(len(found), 4, squeeze=False, width_ratios=[0.85, 1, 1, 1])
    for (orbit, *axes), (name, line) in zip(panels, found.items(), strict=True):
        orbit.plot(*line.y[:2, line.t <= ORBIT_END], color=PALETTE[0], lw=0.35)
        orbit.plot(0, 0, ls="", marker="+", color="black", ms=8)
        orbit.set(title=name, xlabel="$q_1$", ylabel="$q_2$", aspect="equal")
        parts = np.array_split(np.arange(1, line.t.size), min(POINTS, line.t.size - 1))
        for k, (axis, label) in enumerate(zip(axes, ("$|H - H_0|$", "$|L - L_0|$", "error of position"), strict=True)):
            largest = [max(line[2 + k][part].max(), FLOOR) for part in parts]
            axis.plot(line.t[[part[-1] for part in parts]], largest, lw=1.3, color=PALETTE[k])
            log_errors(axis, "t", label)
            low, high = np.log10(axis.get_ylim())
            axis.set_ylim(10 ** np.floor(low), 10 ** np.ceil(high))  # at least two labelled ticks
    return figure
