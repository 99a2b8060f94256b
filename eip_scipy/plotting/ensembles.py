"""The figure of an ensemble: states of its members, errors of the invariants, and how the members ended."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from ..run.fields import component_names, distinct, time_name
from ..run.figures import plain, real_rows, steps
from . import PALETTE, draw_errors, log_errors, method_styles
from .shown import shown_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["ensemble_figure"]

MOST = 6  # components with a panel
AT_MOST = 10_000  # members whose errors are drawn
LARGEST = "largest |I - target|"
BANDS = (5, 25, 50, 75, 95)  # percentiles
WIDE, NARROW = 0.18, 0.32  # opacities of the bands
FAILURES = "#D55E00"
ENDS = {
    "reached the end": "#0072B2",
    "ended by an event": "#56B4E9",
    "not to be trusted": "#E69F00",
    "failed": FAILURES,
    "did not run": "#777777",
}


def ensemble_figure(result: Any, names: Any = None) -> Figure:
    """Draw an ensemble, see `EnsembleResult.plot`."""
    components = component_names(result, names, result.y.shape[1])
    trajectories = result.trajectories is not None and result.times.size > 1
    ended = result.status >= 0
    states = result.trajectories if trajectories else result.y[ended, :, None]
    shown = dict(list(real_rows(components, np.moveaxis(states, 1, 0)).items())[:MOST])
    widths = [1.25, *([1.0] if result.names else []), 0.75]
    figure = shown_figure(4.2 * sum(widths) + 0.4, max(4.2, 1.25 * len(shown) + 0.9 if trajectories else 0.0))
    figure.suptitle(plain(f"{len(result.t)} members, {steps(result)}"), fontsize="large")
    grid = figure.add_gridspec(1, len(widths), width_ratios=widths)
    if trajectories:
        rows = grid[0].subgridspec(len(shown), 1)
        axes = [figure.add_subplot(rows[0])]
        axes += [figure.add_subplot(rows[k], sharex=axes[0]) for k in range(1, len(shown))]
        for k, (axis, (name, values)) in enumerate(zip(axes, shown.items(), strict=True)):
            _draw_fan(axis, result.times, name, values, PALETTE[k])
            axis.tick_params(labelbottom=axis is axes[-1])
        axes[-1].set_xlabel(time_name(components))
        figure.align_ylabels(axes)
        _explain(axes[0], next(iter(shown.values())))
    else:
        axes = [figure.add_subplot(grid[0])]
        _draw_last(axes[0], shown)
        whose = "" if ended.all() else f" of the {np.count_nonzero(ended)} of {ended.size} that did not fail"
        axes[0].set_ylabel(f"last states{whose}")
    if len(components) > MOST:
        axes[0].set_title(f"the first {MOST} of {len(components)} components", fontsize="medium")
    if result.names:
        _draw_errors(figure.add_subplot(grid[1]), result)
    _draw_counts(figure.add_subplot(grid[-1]), _counts(result))
    return figure


def _draw_fan(axis: Axes, times: np.ndarray, name: str, values: Any, color: str) -> None:
    """Draw the median of members in time, and bands that contain 50 % and 90 % of them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # raised at times that no member reached
        low, lower, middle, upper, high = np.nanpercentile(values, BANDS, axis=0)
    axis.fill_between(times, low, high, color=color, alpha=WIDE, lw=0)
    axis.fill_between(times, lower, upper, color=color, alpha=NARROW, lw=0)
    axis.plot(times, middle, color=color, lw=1.2)
    axis.set_ylabel(name)
    axis.grid(alpha=0.2)


def _explain(axis: Axes, values: np.ndarray) -> None:
    """Draw a legend of the line and the bands above the first panel, which shows `values` (members, m)."""
    left = np.count_nonzero(~np.isnan(values), axis=0).min()
    title = None if left == len(values) else f"of members still running: at least {left} of {len(values)}"
    parts = [
        Line2D([], [], color="0.25", lw=1.2, label="median"),
        Patch(color="0.25", alpha=WIDE + NARROW, lw=0, label="50 %"),
        Patch(color="0.25", alpha=WIDE, lw=0, label="90 %" if title else "90 % of members"),
    ]
    look: dict[str, Any] = {"loc": "lower center", "ncols": 3, "fontsize": "small", "frameon": False}
    axis.legend(handles=parts, bbox_to_anchor=(0.5, 1.0), title=title, title_fontsize="small", **look)


def _draw_last(axis: Axes, components: Mapping[str, Any]) -> None:
    """Draw a box plot of each component in the last states: median, 50 % and 90 % of the members, and outliers."""
    boxes = axis.boxplot(
        [np.ravel(values) for values in components.values()],
        whis=(BANDS[0], BANDS[-1]),
        patch_artist=True,
        widths=0.55,
        medianprops={"color": "black", "lw": 1.4},
        flierprops={"marker": ".", "markersize": 3, "markeredgewidth": 0, "markerfacecolor": "0.4", "alpha": 0.5},
    )
    for box, color in zip(boxes["boxes"], PALETTE, strict=False):
        box.set(facecolor=color, alpha=0.6)
    axis.set_xticks(range(1, len(components) + 1), list(components))
    axis.grid(alpha=0.2, axis="y")
    axis.annotate(
        "box: 50 %, whiskers: 90 % of members", (0.5, 1.01), xycoords="axes fraction", ha="center", fontsize="small"
    )


def _draw_errors(axis: Axes, result: Any) -> None:
    """Draw the largest error of each invariant in each member, and a cross at the bottom for each failed member."""
    total = len(result.t)
    drawn = np.unique(np.linspace(0, total - 1, min(total, AT_MOST)).round().astype(int))
    members, failed, residuals = result.first + drawn, result.status[drawn] == -1, result.max_residual[drawn].T
    errors = {plain(name): row[~failed] for name, row in zip(distinct(result.names), residuals, strict=True)}
    small = 4.0 if members.size <= 300 else 2.0
    look: dict[str, Any] = {"ls": "", "ms": small, "mew": 0, "alpha": 0.8}
    styles = {name: style | look for name, style in method_styles(errors).items()}
    draw_errors(axis, members[~failed], errors, styles, result.target[drawn][~failed])
    if failed.any():  # at the bottom, because their errors are meaningless
        bottom = np.full(np.count_nonzero(failed), 0.03)
        style: dict[str, Any] = {"ls": "", "marker": "x", "ms": 6, "mew": 1.4, "color": FAILURES, "label": "failed"}
        axis.plot(members[failed], bottom, transform=axis.get_xaxis_transform(), **style)
    log_errors(axis, "member" if drawn.size == total else f"member ({drawn.size} of {total} are drawn)", LARGEST)
    axis.locator_params(axis="x", nbins=5, integer=True)
    axis.legend(fontsize="small", loc="best", markerscale=1.6 if small < 4 else 1.0)


def _counts(result: Any) -> dict[str, int]:
    """Return the number of members by the way in which they ended."""
    doubtful = (result.status >= 0) & ~result.trusted
    found = {
        "reached the end": (result.status == 0) & ~doubtful,
        "ended by an event": (result.status == 1) & ~doubtful,
        "not to be trusted": doubtful,
        "failed": result.status == -1,
        "did not run": result.status == -2,
    }
    return {what: int(np.count_nonzero(those)) for what, those in found.items()}


def _draw_counts(axis: Axes, counts: Mapping[str, int]) -> None:
    """Draw how many members ended in each way."""
    names = [name for name, count in counts.items() if count > 0]
    largest = max(1, *counts.values())
    for k, name in enumerate(names):
        axis.barh(k, counts[name], height=0.6, color=ENDS[name])
        place: dict[str, Any] = {"xytext": (4, 0), "textcoords": "offset points", "va": "center"}
        axis.annotate(str(counts[name]), (counts[name], k), fontsize="small", **place)
    axis.set_yticks(range(len(names)), names, fontsize="small")
    axis.set_ylim(max(len(ENDS), len(names)) - 0.5, -0.5)
    axis.set_xlim(0, 1.25 * largest)
    axis.set_xlabel("members")
    axis.locator_params(axis="x", nbins=4, integer=True)
    axis.grid(alpha=0.2, axis="x")
