"""The figures of runs and ensembles: panels of states, errors of invariants, corrections, and ends of members."""

from __future__ import annotations

import itertools
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..run.fields import component_names, distinct, invariant_errors, labels, time_name
from ..run.results import steps
from . import FLOOR, PALETTE, draw_lines, log_errors, method_styles, shown_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.gridspec import SubplotSpec

__all__ = ["ensemble_figure", "run_figure"]

MOST = 9  # components, or bodies, that can be distinguished
MOST_PANELS = 6  # components with a panel
TICKS = 5  # more labels of times with five digits would touch each other
WIDE = 10.0  # ratio of sizes from which on two components get separate axes, because the smaller one would look flat
USUAL = 5.0  # corrections in units of the local error, see `Diagnostics`
AT_MOST = 10_000  # members whose errors are drawn
BANDS = (5, 25, 50, 75, 95)  # percentiles
ENDS = {
    "reached the end": "#0072B2",
    "ended by an event": "#56B4E9",
    "not to be trusted": "#E69F00",
    "failed": "#D55E00",
    "did not run": "#777777",
}
STATUS = {0: "reached the end", 1: "ended by an event", -1: "failed", -2: "did not run"}


def run_figure(result: Any, names: Any, orbit: bool | None, axis: Any) -> Any:
    """Draw a run, see `eip_scipy.results.plot`: all panels in a new figure, or only the states into an axis."""
    known, title = labels(result, names), ""
    if "method" in result:
        title = steps(result) + ("" if result.trusted else ": not to be trusted")
    directions, paths = _paths(result.y, known["component"]) if orbit is not False else ([], {})
    if orbit and not paths:
        raise ValueError(
            "plot: an orbit needs components named x and y, or x_0 and y_0 and so on, with real values; pass such "
            "names as names=, or omit orbit."
        )
    curves = paths or _real_rows(known["component"], np.asarray(result.y))
    shown = dict(list(curves.items())[:MOST])
    whole = axis is not None or bool(paths) or len(curves) > MOST
    groups = [shown] if whole else _by_size(shown)
    figure, axes = _run_panels(result, known, title, len(groups)) if axis is None else (axis, [axis])
    if paths:
        _draw_paths(axes[0], directions, shown)
    else:
        for lowest, group in zip(axes, groups, strict=True):
            draw_lines(lowest, result.t, group, method_styles(shown))
        axes[-1].set_xlabel(time_name(known["component"]))
    if len(curves) > MOST:
        axes[0].set_title(f"the first {MOST} of {len(curves)}", fontsize="medium")
    if title and axis is not None and not axis.get_title():
        axis.set_title(_plain(title), fontsize="medium")
    return figure


def _run_panels(result: Any, known: Mapping[str, Any], title: str, count: int) -> tuple[Figure, list[Axes]]:
    """Return the figure of a run with the panels of its invariants, and `count` empty axes for its states."""
    names = [_plain(name) for name in known.get("invariant", ())]
    rows = np.abs(invariant_errors(result)) if names else []
    errors = {name: row for name, row in zip(names, rows, strict=True) if not np.isnan(row).all()}
    sizes = result.diagnostics.corrections if names else []
    corrections = {name: size for name, size in zip(names, sizes, strict=True) if not np.isnan(size)}
    styles = method_styles(names)
    figure, places = _panels(title, [1.0, *([1.0] if errors else []), *([0.6] if corrections else [])])
    axes = _stacked(places[0], count)
    if errors:
        axis = figure.add_subplot(places[1])
        lines = {name: style | {"marker": None, "lw": 1.1} for name, style in styles.items()}
        _draw_errors(axis, result.t, errors, result.invariants, lines)
        axis.set(xlabel=time_name(known["component"]), ylabel="|I - target|")
    if corrections:
        _draw_corrections(figure.add_subplot(places[-1]), corrections, [styles[name]["color"] for name in corrections])
    return figure, axes


def ensemble_figure(result: Any, names: Any = None) -> Figure:
    """Draw an ensemble, see `EnsembleResult.plot`."""
    components, ended = component_names(result, names, result.y.shape[1]), result.status >= 0
    in_time = result.trajectories is not None and result.times.size > 1
    states = result.trajectories if in_time else result.y[ended, :, None]
    shown = dict(list(_real_rows(components, np.moveaxis(states, 1, 0)).items())[:MOST_PANELS])
    widths = [1.25, *([1.0] if result.names else []), 0.75]
    height = max(4.2, 1.25 * len(shown) + 0.9 if in_time else 0.0)
    figure, places = _panels(f"{len(result.t)} members, {steps(result)}", widths, height)
    axes = _stacked(places[0], len(shown) if in_time else 1)
    if in_time:
        left = np.count_nonzero(~np.isnan(shown[next(iter(shown))]), axis=0).min()
        title = f"of members still running: at least {left} of {ended.size}" if left < ended.size else None
        for axis, color, (name, values) in zip(axes, PALETTE, shown.items(), strict=False):
            _draw_fan(axis, result.times, values, color, "90 %" if title else "90 % of members")
            axis.set_ylabel(name)
        axes[-1].set_xlabel(time_name(components))
        figure.align_ylabels(axes)
        look: dict[str, Any] = {"fontsize": "small", "title_fontsize": "small", "frameon": False}
        axes[0].legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, title=title, **look)
    else:
        _draw_last(axes[0], shown)
        whose = "" if ended.all() else f" of the {np.count_nonzero(ended)} of {ended.size} that did not fail"
        axes[0].set(ylabel=f"last states{whose}", xlabel="box: 50 %, whiskers: 90 % of members")
    if len(components) > MOST_PANELS:
        axes[0].set_title(f"the first {MOST_PANELS} of {len(components)} components", fontsize="medium")
    if result.names:
        _draw_largest_errors(figure.add_subplot(places[1]), result)
    _draw_ends(figure.add_subplot(places[-1]), result)
    return figure


# Labels and panels.


def _plain(text: str) -> str:
    """Return text that matplotlib draws as it is, though it contains $ or begins with _, which legends leave out."""
    text = text.replace("$", r"\$")
    return f" {text}" if not text or text.startswith("_") else text


def _real_rows(names: Sequence[str], values: np.ndarray) -> dict[str, np.ndarray]:
    """Return real values by their labels in figures: of complex ones the magnitude, with the label |name|."""
    if np.iscomplexobj(values):
        names, values = [f"|{name}|" for name in names], np.abs(values)
    return {_plain(name): row for name, row in zip(names, values, strict=True)}


def _panels(title: str, widths: Sequence[float], height: float = 4.2) -> tuple[Figure, list[SubplotSpec]]:
    """Return a figure with a title, and the places of its panels, which have relative `widths`, in a row."""
    figure = shown_figure(4.3 * sum(widths) + 0.5, height)
    if title:
        figure.suptitle(_plain(title), fontsize="large")
    grid = figure.add_gridspec(1, len(widths), width_ratios=widths)
    return figure, [grid[k] for k in range(len(widths))]


def _stacked(place: SubplotSpec, count: int) -> list[Axes]:
    """Return axes one above the other, with a common axis of times."""
    axes = list(place.subgridspec(count, 1).subplots(sharex=True, squeeze=False)[:, 0])
    axes[-1].locator_params(axis="x", nbins=TICKS)
    return axes


# States.


def _paths(y: Any, names: Sequence[str]) -> tuple[list[str], dict[str, Any]]:
    """Return the labels of two directions, and for each body of a run its coordinates in these directions.

    They are x and y, or in space the two directions in which the orbits are largest.
    """
    place = {name: k for k, name in enumerate(names)}
    bodies = [name[1:] for name in names if name[:1] == "x" and name[1:2] in ("", "_") and f"y{name[1:]}" in place]
    if not bodies or not np.size(y) or np.iscomplexobj(y):
        return [], {}
    directions = "xyz" if all(f"z{body}" in place for body in bodies) else "xy"
    rows = {d: np.array([y[place[d + body]] for body in bodies]) for d in directions}
    extent = {d: np.ptp(row, axis=1).max() for d, row in rows.items()}
    first, second = sorted(sorted(directions, key=lambda d: -extent[d])[:2])
    left = next((d for d in directions if d not in (first, second) and extent[d] > 0), "")
    names = [_plain(body.removeprefix("_") or "orbit") for body in bodies]
    mark = f" (projection along {left})" if left else ""
    return [first + mark, second], dict(zip(names, zip(rows[first], rows[second], strict=True), strict=True))


def _draw_paths(axis: Axes, directions: Sequence[str], paths: Mapping[str, Any]) -> None:
    for color, (name, (x, y)) in zip(PALETTE, paths.items(), strict=False):
        axis.plot(x, y, color=color, lw=0.8)
        axis.plot(x[-1], y[-1], ls="", marker="o", color=color, mec="white", label=name)
    axis.set_aspect("equal", adjustable="datalim")
    axis.set(xlabel=directions[0], ylabel=directions[1])
    axis.grid(alpha=0.2)
    if len(paths) > 1:  # below the orbits, which leave no corner free
        axis.legend(fontsize="small", loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=3, frameon=False)


def _by_size(components: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the components in two groups if their sizes have a gap of a factor `WIDE`, else in one group.

    The size of a component is its largest magnitude; the largest gap separates the groups.
    """
    sizes = {name: np.max(np.abs(values), initial=0.0) for name, values in components.items()}
    ordered = sorted(size for size in sizes.values() if 0 < size < np.inf)
    gaps = [above / below for below, above in itertools.pairwise(ordered)]
    if max(gaps, default=0.0) < WIDE:
        return [dict(components)]
    bar = ordered[gaps.index(max(gaps)) + 1]
    large = {name: row for name, row in components.items() if sizes[name] >= bar}
    return [large, {name: row for name, row in components.items() if name not in large}]


def _draw_fan(axis: Axes, times: np.ndarray, values: Any, color: str, most: str) -> None:
    """Draw the median of members in time, and bands that contain 50 % and 90 % (labelled `most`) of them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # raised at times that no member reached
        low, lower, middle, upper, high = np.nanpercentile(values, BANDS, axis=0)
    axis.plot(times, middle, color=color, lw=1.2, label="median")
    axis.fill_between(times, lower, upper, color=color, alpha=0.32, lw=0, label="50 %")
    axis.fill_between(times, low, high, color=color, alpha=0.18, lw=0, label=most)
    axis.grid(alpha=0.2)


def _draw_last(axis: Axes, components: Mapping[str, Any]) -> None:
    """Draw a box plot of each component in the last states: median, 50 % and 90 % of the members, and outliers."""
    boxes = axis.boxplot(
        [np.ravel(values) for values in components.values()],
        whis=(BANDS[0], BANDS[-1]),
        tick_labels=list(components),
        patch_artist=True,
        widths=0.55,
        medianprops={"color": "black", "lw": 1.4},
        flierprops={"marker": ".", "markersize": 3, "markeredgewidth": 0, "markerfacecolor": "0.4", "alpha": 0.5},
    )
    for box, color in zip(boxes["boxes"], PALETTE, strict=False):
        box.set(facecolor=color, alpha=0.6)
    axis.grid(alpha=0.2, axis="y")


# Invariants and ends.


def _draw_errors(axis: Axes, x: Any, errors: Mapping[str, Any], sizes: Any, styles: Mapping[str, Any]) -> None:
    """Draw errors by name on a log axis, which has no place for 0: errors of 0 are drawn below all others, and marked.

    `sizes` are those of the quantities with these errors; 0 is drawn below their rounding errors.
    """
    values = np.concatenate(list(errors.values()))
    size = np.max(np.abs(sizes), where=np.isfinite(sizes), initial=0.0)
    zero = np.min(values, where=values > 0, initial=FLOOR * (size or 1.0))
    for name, row in errors.items():
        axis.plot(x, np.where(row == 0, zero, row), **styles[name])
    if np.any(values == 0):
        across = axis.get_yaxis_transform()
        axis.text(1.0, zero, "error 0 ", transform=across, ha="right", va="top", fontsize="x-small")
    log_errors(axis, "", "")
    axis.locator_params(axis="x", nbins=TICKS, integer=True)
    axis.legend(fontsize="small", loc="best")


def _draw_corrections(axis: Axes, corrections: Mapping[str, float], colors: Sequence[str]) -> None:
    """Draw the largest correction of each invariant, and the size that most correct runs do not exceed."""
    sizes = np.array(list(corrections.values()))
    axis.barh(list(corrections), np.where(np.isfinite(sizes), sizes, 0.0), height=0.6, color=colors)
    for k in np.flatnonzero((sizes == 0) | np.isinf(sizes)).tolist():  # a log axis cannot show them
        axis.text(0.02, k, f"{sizes[k]:g}", transform=axis.get_yaxis_transform(), va="center", fontsize="x-small")
    axis.axvline(USUAL, color="0.4", lw=1.0, ls=":", label="most correct runs stay below")
    axis.set_ylim(sizes.size + 0.1, -0.6)
    log_errors(axis, "largest correction\n[local errors]", "", along="x")
    axis.legend(fontsize="x-small", loc="lower right")


def _draw_largest_errors(axis: Axes, result: Any) -> None:
    """Draw the largest error of each invariant in each member, and a cross at the bottom for each failed member."""
    total = len(result.t)
    drawn = np.unique(np.linspace(0, total - 1, min(total, AT_MOST)).round().astype(int))
    members, failed, residuals = result.first + drawn, result.status[drawn] == -1, result.max_residual[drawn].T
    errors = {_plain(name): row[~failed] for name, row in zip(distinct(result.names), residuals, strict=True)}
    look: dict[str, Any] = {"ls": "", "ms": 4.0 if members.size <= 300 else 2.0, "mew": 0, "alpha": 0.8}
    styles = {name: style | look for name, style in method_styles(errors).items()}
    _draw_errors(axis, members[~failed], errors, result.target[drawn][~failed], styles)
    if failed.any():  # at the bottom, because their errors are meaningless
        bottom = np.full(np.count_nonzero(failed), 0.03)
        look |= {"marker": "x", "ms": 6, "mew": 1.4, "color": ENDS["failed"], "label": "failed"}
        axis.plot(members[failed], bottom, transform=axis.get_xaxis_transform(), **look)
        axis.legend(fontsize="small", loc="best")
    axis.set_ylabel("largest |I - target|")
    axis.set_xlabel("member" if drawn.size == total else f"member ({drawn.size} of {total} are drawn)")


def _draw_ends(axis: Axes, result: Any) -> None:
    """Draw how many members ended in each way."""
    ends = Counter(
        "not to be trusted" if status >= 0 and not trusted else STATUS[status]
        for status, trusted in zip(result.status.tolist(), result.trusted.tolist(), strict=True)
    )
    counts = {name: ends[name] for name in ENDS if ends[name]}
    bars = axis.barh(list(counts), list(counts.values()), height=0.6, color=[ENDS[name] for name in counts])
    axis.bar_label(bars, padding=4, fontsize="small")
    axis.set(ylim=(len(ENDS) - 0.5, -0.5), xlim=(0, 1.25 * max([1, *counts.values()])), xlabel="members")
    axis.tick_params(axis="y", labelsize="small")
    axis.locator_params(axis="x", nbins=4, integer=True)
    axis.grid(alpha=0.2, axis="x")
