"""Figures of `eip-scipy bench`: errors of the trajectory and of the invariants against time, ours beside the field."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from . import FLOOR, _figure, _log_errors, _log_x, method_styles

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["side_by_side_figure"]

WIDTH, HEIGHT = 6.4, 7.4
LINE_HEIGHT = 0.19  # of the legend, inches
FAINT = {"lw": 1.0, "ms": 4, "alpha": 0.85}
OURS = {"lw": 2.4, "ms": 6, "zorder": 5}


def side_by_side_figure(
    series: Mapping[str, Mapping[str, Any]],
    *,
    ours: Collection[str],
    levels: Collection[float],
    time: str = "wall time [s]",
    title: str = "",
    footnote: str = "",
) -> Figure:
    """Draw the trajectory's error against time and, below, the invariants', a line for each peer.

    Parameters
    ----------
    series : mapping of str to mapping
        For each peer arrays "seconds", "error" and "drift", the last with nan where it is not known.
    ours : collection of str
        Those that are drawn heavier.
    levels : collection of float
        Errors of the trajectory at which the text compares: dotted lines.
    time : str, optional
        Label of the time.
    title, footnote : str, optional

    Returns
    -------
    Figure
    """
    drifts = np.concatenate([np.asarray(values["drift"], dtype=float) for values in series.values()])
    panels = ["error of the trajectory"] + ["change of the invariants"] * bool(np.isfinite(drifts).any())
    height = HEIGHT if len(panels) == 2 else 0.6 * HEIGHT
    figure = _figure(WIDTH, height + LINE_HEIGHT * -(-len(series) // 2), title)
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    styles = method_styles([*(name for name in series if name in ours), *(name for name in series if name not in ours)])
    for axis, key in zip(axes, ("error", "drift"), strict=False):
        for name in styles:
            _curve(
                axis, series[name]["seconds"], series[name][key], {**styles[name], **(OURS if name in ours else FAINT)}
            )
    for level in levels:
        axes[0].axhline(level, color="0.6", lw=0.8, ls=":")
    for axis, label in zip(axes, panels, strict=True):
        _log_x(axis)
        _log_errors(axis, time if axis is axes[-1] else "", label)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower center", ncols=2, fontsize="small", frameon=False, handlelength=3.5
    )
    if footnote:
        axes[0].annotate(footnote, (1, 1.02), xycoords="axes fraction", ha="right", fontsize="xx-small", color="0.35")
    return figure


def _curve(axis: Axes, seconds: Any, errors: Any, style: Mapping[str, Any]) -> None:
    """What is below the spacing of numbers is drawn there: a log axis has no zero."""
    x, y = np.asarray(seconds, dtype=float), np.asarray(errors, dtype=float)
    good = np.isfinite(x) & np.isfinite(y)
    axis.plot(x[good], np.maximum(y[good], FLOOR), **style)
