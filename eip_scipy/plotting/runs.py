"""The figure of one run."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..run.fields import labels, time_name
from ..run.figures import described, plain, real_rows
from ..run.tables import invariant_errors
from . import PALETTE, draw_errors, log_errors, method_styles
from .shown import shown_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.gridspec import SubplotSpec

__all__ = ["draw"]

MOST = 9  # components, or bodies, that can be distinguished
TICKS = 5  # more labels of times with five digits would touch each other
WIDE = 10.0  # ratio of sizes from which on two components get separate axes, because the smaller one would look flat
USUAL = 5.0  # corrections in units of the local error, see `Diagnostics`


def draw(result: Any, names: Any, orbit: bool | None, axis: Any) -> Any:
    """Draw a run, see `eip_scipy.results.plot`: all panels in a new figure, or only the states into an axis."""
    known = labels(result, names)
    time, title = time_name(known["component"]), plain(described(result))
    directions, paths = _paths(result.y, known["component"]) if orbit is not False else ((), {})
    if orbit and not paths:
        raise ValueError(
            "plot: an orbit needs components named x and y, or x_0 and y_0 and so on, with real values; pass such "
            "names as names=, or omit orbit."
        )
    components = real_rows(known["component"], np.asarray(result.y))
    if axis is not None:
        if paths:
            _draw_paths(axis, directions, paths)
        else:
            _draw_lines(axis, result.t, dict(list(components.items())[:MOST]))
            axis.set_xlabel(time)
            _counted(axis, len(components))
        if title and not axis.get_title():
            axis.set_title(title, fontsize="medium")
        return axis
    errors, corrections = _errors(result, known) if "invariant" in known else ({}, {})
    widths = [1.0, *([1.0] if errors else []), *([0.6] if corrections else [])]
    figure = shown_figure(4.4 * sum(widths) + 0.6, 4.2)
    if title:
        figure.suptitle(title, fontsize="large")
    grid = figure.add_gridspec(1, len(widths), width_ratios=widths)
    if paths:
        _draw_paths(figure.add_subplot(grid[0]), directions, paths)
    else:
        _draw_components(figure, grid[0], result.t, components).set_xlabel(time)
    axes = [figure.add_subplot(grid[k]) for k in range(1, len(widths))]
    styles = method_styles(dict.fromkeys([*errors, *corrections]))
    if errors:
        lines = {name: style | {"marker": None, "lw": 1.1} for name, style in styles.items()}
        draw_errors(axes[0], result.t, errors, lines, result.invariants)
        log_errors(axes[0], time, "|I - target|")
        axes[0].locator_params(axis="x", nbins=TICKS)
        axes[0].legend(fontsize="small", loc="best")
    if corrections:
        _draw_corrections(axes[-1], corrections, styles)
    return figure


def _errors(result: Any, known: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, float]]:
    """Return the magnitude (m,) of the errors of each invariant that has a target, and the largest corrections."""
    names = [plain(name) for name in known["invariant"]]
    rows = zip(names, np.abs(invariant_errors(result)), strict=True)
    sizes = zip(names, result.diagnostics.corrections, strict=True)
    return {name: row for name, row in rows if not np.isnan(row).all()}, {k: v for k, v in sizes if not np.isnan(v)}


def _paths(y: Any, names: Sequence[str]) -> tuple[tuple[str, ...], dict[str, tuple[np.ndarray, np.ndarray]]]:
    """Return the labels of two directions, and for each body of a run its coordinates in these directions.

    They are x and y, or in space the two directions in which the orbits are largest.
    """
    place = {name: k for k, name in enumerate(names)}
    bodies = [name[1:] for name in names if name[:1] == "x" and name[1:2] in ("", "_") and f"y{name[1:]}" in place]
    if not bodies or not np.size(y) or np.iscomplexobj(y):
        return (), {}
    directions = "xyz" if all(f"z{body}" in place for body in bodies) else "xy"
    rows = {d: np.array([y[place[d + body]] for body in bodies]) for d in directions}
    extent = {d: np.ptp(row, axis=1).max() for d, row in rows.items()}
    left = min(reversed(directions), key=lambda d: extent[d]) if len(directions) == 3 else ""
    first, second = (d for d in directions if d != left)
    mark = f" (projection along {left})" if left and extent[left] > 0 else ""
    labels = [plain(body.removeprefix("_") or "orbit") for body in bodies]
    return (first + mark, second), dict(zip(labels, zip(rows[first], rows[second], strict=True), strict=True))


def _draw_paths(axis: Axes, directions: tuple[str, ...], paths: Mapping[str, tuple[Any, Any]]) -> None:
    for k, (name, (x, y)) in enumerate(list(paths.items())[:MOST]):
        axis.plot(x, y, color=PALETTE[k], lw=0.8)
        axis.plot(x[-1], y[-1], ls="", marker="o", color=PALETTE[k], mec="white", label=name)
    axis.set_aspect("equal", adjustable="datalim")
    axis.set_xlabel(directions[0])
    axis.set_ylabel(directions[1])
    axis.grid(alpha=0.2)
    if len(paths) > 1:  # below the orbits, which leave no corner free
        axis.legend(fontsize="small", loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=3, frameon=False)
    _counted(axis, len(paths))


def _draw_components(figure: Figure, place: SubplotSpec, t: np.ndarray, components: Mapping[str, Any]) -> Axes:
    """Draw components on one axis, or on two if some would look flat, such as a velocity next to a growing angle.

    Return the lowest axis.
    """
    shown = dict(list(components.items())[:MOST])
    groups = _by_size(shown) if len(components) <= MOST else [list(shown)]
    parts = place.subgridspec(len(groups), 1)
    axes = [figure.add_subplot(parts[0])]
    axes += [figure.add_subplot(parts[k], sharex=axes[0]) for k in range(1, len(groups))]
    for axis, group in zip(axes, groups, strict=True):
        _draw_lines(axis, t, shown, group)
    axes[-1].locator_params(axis="x", nbins=TICKS)
    _counted(axes[0], len(components))
    return axes[-1]


def _draw_lines(axis: Axes, t: Any, components: Mapping[str, Any], group: Sequence[str] | None = None) -> None:
    """Draw the components in `group`, by default all, in the styles that they have among all."""
    styles = method_styles(components)
    for name in components if group is None else group:
        axis.plot(t, components[name], lw=1.1, **styles[name] | {"marker": None})
    axis.grid(alpha=0.2)
    if len(components) > 1:
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


def _draw_corrections(axis: Axes, corrections: Mapping[str, float], styles: Mapping[str, Mapping[str, Any]]) -> None:
    for k, (name, size) in enumerate(corrections.items()):
        axis.barh(k, size if np.isfinite(size) else 0.0, height=0.6, color=styles[name]["color"])
        if size == 0 or np.isinf(size):  # a log axis cannot show it
            axis.text(0.02, k, f"{size:g}", transform=axis.get_yaxis_transform(), va="center", fontsize="x-small")
    axis.set(yticks=range(len(corrections)), yticklabels=list(corrections), ylim=(len(corrections) + 0.1, -0.6))
    axis.axvline(USUAL, color="0.4", lw=1.0, ls=":")
    log_errors(axis, "largest correction\n[local errors]", "", along="x")
    low, high = np.log(axis.get_xlim())
    side = "right" if np.log(USUAL) > 0.5 * (low + high) else "left"
    axis.text(USUAL, len(corrections) - 0.1, "most correct runs stay below", va="center", ha=side, fontsize="x-small")
