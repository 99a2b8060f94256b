"""The figure of an ensemble: states of its members, errors of the invariants, and how the members ended."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from . import FLOOR, PALETTE, log_errors, method_styles, typeset
from .shown import shown_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["ensemble_figure"]

MOST = 6  # components with a panel
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


def ensemble_figure(
    times: Any,
    components: Mapping[str, Any],
    *,
    members: Any,
    errors: Mapping[str, Any],
    failed: Any,
    counts: Mapping[str, int],
    title: str = "",
) -> Figure:
    """Draw an ensemble.

    `components` has the values (members, m) of each component at `times` (m,), nan if a member has none; the magnitude
    of complex ones is drawn. If `times` is None, they are last states, drawn as one box for each component. `errors`
    has the largest error (k,) of each invariant in the `members` with these k indices, `failed` is a mask of those that
    failed, and `counts` has the number of members that ended in each of the ways in `ENDS`.
    """
    shown = dict(list(components.items())[:MOST])
    widths = [1.25, *([1.0] if errors else []), 0.75]
    height = 4.2 if times is None else max(4.2, 1.25 * len(shown) + 0.9)
    figure = shown_figure(4.2 * sum(widths) + 0.4, height)
    if title:
        figure.suptitle(typeset(title), fontsize="large")
    grid = figure.add_gridspec(1, len(widths), width_ratios=widths)
    if times is None:
        first = figure.add_subplot(grid[0])
        _draw_last(first, shown)
        axes = [first]
    else:
        rows = grid[0].subgridspec(len(shown), 1)
        axes = [figure.add_subplot(rows[0])]
        axes += [figure.add_subplot(rows[k], sharex=axes[0]) for k in range(1, len(shown))]
        for k, (axis, (name, values)) in enumerate(zip(axes, shown.items(), strict=True)):
            _draw_fan(axis, np.asarray(times), name, values, PALETTE[k])
            axis.tick_params(labelbottom=axis is axes[-1])
        axes[-1].set_xlabel("t")
        figure.align_ylabels(axes)
        _explain(axes[0])
    if len(components) > MOST:
        axes[0].set_title(f"the first {MOST} of {len(components)} components", fontsize="medium")
    if errors:
        _draw_errors(figure.add_subplot(grid[1]), np.asarray(members), errors, np.asarray(failed))
    _draw_counts(figure.add_subplot(grid[-1]), counts)
    return figure


def _draw_fan(axis: Axes, times: np.ndarray, name: str, values: Any, color: str) -> None:
    """Draw the median of members in time, and bands that contain 50 % and 90 % of them."""
    values = np.asarray(values)
    is_complex = values.dtype.kind == "c"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # raised at times that no member reached
        low, lower, middle, upper, high = np.nanpercentile(np.abs(values) if is_complex else values, BANDS, axis=0)
    axis.fill_between(times, low, high, color=color, alpha=WIDE, lw=0)
    axis.fill_between(times, lower, upper, color=color, alpha=NARROW, lw=0)
    axis.plot(times, middle, color=color, lw=1.2)
    axis.set_ylabel(f"|{name}|" if is_complex else name)
    axis.grid(alpha=0.2)


def _explain(axis: Axes) -> None:
    """Draw a legend of the line and the bands above the first panel."""
    parts = [
        Line2D([], [], color="0.25", lw=1.2, label="median"),
        Patch(color="0.25", alpha=WIDE + NARROW, lw=0, label="50 %"),
        Patch(color="0.25", alpha=WIDE, lw=0, label="90 % of members"),
    ]
    axis.legend(handles=parts, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, fontsize="small", frameon=False)


def _draw_last(axis: Axes, components: Mapping[str, Any]) -> None:
    """Draw a box plot of each component in the last states: median, 50 % and 90 % of the members, and outliers."""
    columns = [np.abs(values) if np.iscomplexobj(values) else np.asarray(values) for values in components.values()]
    finite = [column[np.isfinite(column)] for column in columns]
    boxes = axis.boxplot(
        finite,
        whis=(BANDS[0], BANDS[-1]),
        patch_artist=True,
        widths=0.55,
        medianprops={"color": "black", "lw": 1.4},
        flierprops={"marker": ".", "markersize": 3, "markeredgewidth": 0, "markerfacecolor": "0.4", "alpha": 0.5},
    )
    for box, color in zip(boxes["boxes"], PALETTE, strict=False):
        box.set(facecolor=color, alpha=0.6)
    names = [f"|{name}|" if np.iscomplexobj(values) else name for name, values in components.items()]
    axis.set_xticks(range(1, len(names) + 1), names)
    axis.set_ylabel("last states")
    axis.grid(alpha=0.2, axis="y")
    axis.annotate(
        "box: 50 %, whiskers: 90 % of members", (0.5, 1.01), xycoords="axes fraction", ha="center", fontsize="small"
    )


def _draw_errors(axis: Axes, members: np.ndarray, errors: Mapping[str, Any], failed: np.ndarray) -> None:
    """Draw the largest error of each invariant in each member, and a cross at the bottom for each failed member."""
    styles = method_styles(errors)
    size = 4.0 if members.size <= 300 else 2.0
    for name, given in errors.items():
        values = np.where(np.isfinite(given), given, np.nan)
        positive = values[values > 0]
        drawn = np.where(values > 0, values, positive.min() if positive.size else FLOOR)
        drawn = np.where(np.isnan(values), np.nan, drawn)
        style = styles[name] | {"ls": "", "ms": size, "mew": 0, "alpha": 0.8}
        axis.plot(members[~failed], drawn[~failed], **style)
    if failed.any():  # at the bottom, because their errors are meaningless
        bottom = np.full(np.count_nonzero(failed), 0.03)
        style = {"ls": "", "marker": "x", "ms": 6, "mew": 1.4, "color": FAILURES, "label": "failed"}
        axis.plot(members[failed], bottom, transform=axis.get_xaxis_transform(), **style)
    log_errors(axis, "member", "largest |I - target|")
    axis.locator_params(axis="x", nbins=5, integer=True)
    axis.legend(fontsize="small", loc="best", markerscale=1.6 if size < 4 else 1.0)


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
