"""The figure of one run."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from . import FLOOR, PALETTE, log_errors, method_styles, typeset
from .shown import shown_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.gridspec import SubplotSpec

__all__ = ["draw_run", "run_figure"]

MOST = 9  # components, or bodies, that can be distinguished
TICKS = 5  # more labels of times with five digits would touch each other
WIDE = 10.0  # ratio of sizes from which on two components get separate axes, because the smaller one would look flat
USUAL = 5.0  # corrections in units of the local error, see `Diagnostics`


def run_figure(
    t: Any,
    components: Mapping[str, Any],
    *,
    paths: Mapping[str, tuple[Any, Any]],
    errors: Mapping[str, Any],
    corrections: Mapping[str, float],
    title: str = "",
) -> Figure:
    """Draw one run: paths or components, errors of the invariants in time, largest corrections.

    By name, `components` has the values (m,) of each component, of whose complex values the magnitude is drawn, `paths`
    x and y of each body, which replace the components if there are any, `errors` the errors (m,) of each invariant, and
    `corrections` the largest correction for each, in units of the local error. Panels of empty mappings are omitted.
    """
    widths = [1.0, *([1.0] if errors else []), *([0.6] if corrections else [])]
    figure = shown_figure(4.4 * sum(widths) + 0.6, 4.2)
    if title:
        figure.suptitle(typeset(title), fontsize="large")
    grid = figure.add_gridspec(1, len(widths), width_ratios=widths)
    if paths:
        _draw_paths(figure.add_subplot(grid[0]), paths)
    else:
        _draw_components(figure, grid[0], np.asarray(t), components)
    axes = [figure.add_subplot(grid[k]) for k in range(1, len(widths))]
    styles = method_styles(dict.fromkeys([*errors, *corrections]))
    for name, values in errors.items():
        axes[0].plot(t, _above_zero(np.abs(values)), lw=1.1, **styles[name] | {"marker": None})
    if errors:
        log_errors(axes[0], "t", "|I - target|")
        axes[0].locator_params(axis="x", nbins=TICKS)
        axes[0].legend(fontsize="small", loc="best")
    if corrections:
        _draw_corrections(axes[-1], corrections, styles)
    return figure


def draw_run(
    axis: Axes, t: Any, components: Mapping[str, Any], paths: Mapping[str, tuple[Any, Any]], title: str = ""
) -> None:
    """Draw the paths of a run, or else its components, into axes, and give them a title if they have none."""
    if paths:
        _draw_paths(axis, paths)
    else:
        shown = dict(list(components.items())[:MOST])
        _draw_lines(axis, t, shown, method_styles(shown))
        axis.set_xlabel("t")
        _counted(axis, len(components))
    if title and not axis.get_title():
        axis.set_title(typeset(title), fontsize="medium")


def _draw_paths(axis: Axes, paths: Mapping[str, tuple[Any, Any]]) -> None:
    for k, (name, (x, y)) in enumerate(list(paths.items())[:MOST]):
        axis.plot(x, y, color=PALETTE[k], lw=0.8)
        axis.plot(x[-1], y[-1], ls="", marker="o", color=PALETTE[k], mec="white", label=name)
    axis.set_aspect("equal", adjustable="datalim")
    axis.set_xlabel("x")
    axis.set_ylabel("y")
    axis.grid(alpha=0.2)
    if len(paths) > 1:  # below the orbits, which leave no corner free
        axis.legend(fontsize="small", loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=3, frameon=False)
    _counted(axis, len(paths))


def _draw_components(figure: Figure, place: SubplotSpec, t: np.ndarray, components: Mapping[str, Any]) -> None:
    """Draw components on one axis, or on two if some would look flat, such as a velocity next to a growing angle."""
    shown = dict(list(components.items())[:MOST])
    groups = _by_size(shown) if len(components) <= MOST else [list(shown)]
    parts = place.subgridspec(len(groups), 1)
    axes = [figure.add_subplot(parts[0])]
    axes += [figure.add_subplot(parts[k], sharex=axes[0]) for k in range(1, len(groups))]
    styles = method_styles(shown)
    for axis, group in zip(axes, groups, strict=True):
        _draw_lines(axis, t, {name: shown[name] for name in group}, styles, legend=len(shown) > 1)
    axes[-1].set_xlabel("t")
    axes[-1].locator_params(axis="x", nbins=TICKS)
    _counted(axes[0], len(components))


def _draw_lines(
    axis: Axes, t: Any, components: Mapping[str, Any], styles: Mapping[str, dict[str, Any]], *, legend: bool = True
) -> None:
    for name, given in components.items():
        values = np.asarray(given)
        is_complex = values.dtype.kind == "c"
        style = styles[name] | {"label": f"|{name}|" if is_complex else name, "marker": None}
        axis.plot(t, np.abs(values) if is_complex else values, lw=1.1, **style)
    axis.grid(alpha=0.2)
    if legend and len(components) > 0:
        axis.legend(fontsize="small", loc="upper right")


def _by_size(components: Mapping[str, Any]) -> list[list[str]]:
    """Return the names in two lists if the sizes of components have a gap of a factor `WIDE`, else in one list.

    The size of a component is its largest magnitude; the largest gap separates the lists.
    """
    sizes = {name: np.max(np.abs(values), initial=0.0) for name, values in components.items()}
    ordered = sorted((size, name) for name, size in sizes.items() if 0 < size < np.inf)
    gaps = [above / below for (below, _), (above, _) in itertools.pairwise(ordered)]
    if not gaps or max(gaps) < WIDE:
        return [list(components)]
    bar = ordered[gaps.index(max(gaps)) + 1][0]
    return [
        [name for name in components if sizes[name] >= bar],
        [name for name in components if not sizes[name] >= bar],
    ]


def _counted(axis: Axes, there: int) -> None:
    if there > MOST:
        axis.set_title(f"the first {MOST} of {there}", fontsize="medium")


def _above_zero(magnitudes: np.ndarray) -> np.ndarray:
    """Return magnitudes for a log axis, zeros replaced by the smallest positive one, or by `FLOOR` if all are 0."""
    positive = magnitudes[magnitudes > 0]
    return np.maximum(magnitudes, positive.min() if positive.size else FLOOR)


def _draw_corrections(axis: Axes, corrections: Mapping[str, float], styles: Mapping[str, Mapping[str, Any]]) -> None:
    for k, (name, size) in enumerate(corrections.items()):
        axis.barh(k, max(size, FLOOR), height=0.6, color=styles[name]["color"])
    axis.set(yticks=range(len(corrections)), yticklabels=list(corrections), ylim=(len(corrections) + 0.1, -0.6))
    axis.axvline(USUAL, color="0.4", lw=1.0, ls=":")
    log_errors(axis, "largest correction\n[local errors]", "", along="x")
    low, high = np.log(axis.get_xlim())
    side = "right" if np.log(USUAL) > 0.5 * (low + high) else "left"
    axis.text(USUAL, len(corrections) - 0.1, "most correct runs stay below", va="center", ha=side, fontsize="x-small")
