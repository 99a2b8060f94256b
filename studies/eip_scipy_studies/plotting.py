"""Figures of the studies: functions that take data and return a `matplotlib.figure.Figure`.

Needs ``pip install "eip_scipy[plot]"``. The figures belong to no window: save them with ``figure.savefig(path)``, or
show them in a notebook.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

# Imported first, because its error says how matplotlib is installed.
from eip_scipy.plotting import FLOOR, MARKERS, PALETTE, log_errors, method_styles, typeset  # isort: skip
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = [
    "CostPanel",
    "ErrorSeries",
    "Linkage",
    "Orbits",
    "blank_figure",
    "cost_figure",
    "errors_figure",
    "gains_figure",
    "linkage_figure",
    "linkages_figure",
    "log_x",
    "longitude_figure",
    "orbit_in_time_figure",
    "orbits_figure",
    "paper_kepler_figure",
]

WIDTH, HEIGHT = 6.4, 7.4
LINE_HEIGHT = 0.19  # height of a line of the legend, inches
FAINT = {"lw": 1.0, "ms": 4, "alpha": 0.85}
OURS = {"lw": 2.4, "ms": 6, "zorder": 5}
DPI = 160
WIDEST = 9.0  # inches
POINTS = 250
LONG_LABEL = 24


class ErrorSeries(NamedTuple):
    """Errors of one method in time.

    Attributes
    ----------
    t : array_like, shape (m,)
    invariants : mapping of str to array_like, shape (m,)
        Relative error of each invariant.
    trajectory : array_like, shape (m,)
        Error of the trajectory; nan if unknown.
    """

    t: Any
    invariants: Mapping[str, Any]
    trajectory: Any


class Orbits(NamedTuple):
    """Orbits of k bodies by one method.

    Attributes
    ----------
    paths : array_like, shape (k, m, 2, points)
        For each body `m` curves in the plane.
    last : array_like, shape (k, 2)
        The final positions.
    """

    paths: Any
    last: Any


Styles = Mapping[str, Mapping[str, Any]]


def errors_figure(
    series: Mapping[str, ErrorSeries], *, time: str, trajectory: str, title: str = "", styles: Styles | None = None
) -> Figure:
    """Draw invariant errors in time, and next to them the error of the trajectory.

    Small invariant errors alone do not show that the trajectory is right.

    Parameters
    ----------
    series : mapping of str to ErrorSeries
        Series by method; all have the same invariants.
    time, trajectory : str
        Labels of the time axis and of the trajectory's error, with units.
    title : str, optional
    styles : mapping, optional
        From `method_styles`.

    Returns
    -------
    Figure
    """
    names = list(next(iter(series.values())).invariants)
    styles = method_styles(series) if styles is None else styles
    figure = blank_figure(3.9 * (len(names) + 1), 4.4, title)
    axes = figure.subplots(1, len(names) + 1, sharex=True)
    for axis, name in zip(axes, names, strict=False):
        for method, data in series.items():
            _envelope(axis, data.t, data.invariants[name], styles[method])
        log_errors(axis, time, f"relative error of {name}")
    for method, data in series.items():
        _envelope(axes[-1], data.t, data.trajectory, styles[method])
    log_errors(axes[-1], time, trajectory)
    _legend_below(figure, axes[0])
    return figure


def longitude_figure(
    t: Any,
    errors: Mapping[str, Any],
    planets: Sequence[str],
    *,
    time: str,
    error: str = "|error of longitude| [rad]",
    title: str = "",
    styles: Styles | None = None,
) -> Figure:
    """Draw an error in time, one panel for each planet; on log axes a power of time is a straight line.

    Parameters
    ----------
    t : array_like, shape (m,)
    errors : mapping of str to array_like, shape (k, m)
        Errors of the k planets by method; nan if unknown.
    planets : sequence of str, length k
    time, error : str
        Labels of the axes, with units.
    title : str, optional
    styles : mapping, optional
        From `method_styles`.

    Returns
    -------
    Figure
    """
    styles = method_styles(errors) if styles is None else styles
    columns = min(3, len(planets)) if len(planets) != 4 else 2
    rows = -(-len(planets) // columns)
    figure = blank_figure(3.7 * columns, 2.5 * rows + 1.2, title)
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for k, axis in enumerate(axes.flat):
        if k >= len(planets):
            axis.set_visible(False)
            continue
        for method, values in errors.items():
            _envelope(axis, t, np.asarray(values)[k], styles[method], log=True)
        log_x(axis)
        log_errors(axis, time if k + columns >= len(planets) else "", "")
        axis.set_title(planets[k], fontsize="medium")
    figure.supylabel(error, fontsize="medium")
    _legend_below(figure, axes[0, 0])
    return figure


def orbits_figure(panels: Mapping[str, Orbits], bodies: Sequence[str], *, unit: str, title: str = "") -> Figure:
    """Draw orbits in a plane, one panel for each method, with the final positions.

    Parameters
    ----------
    panels : mapping of str to Orbits
        Orbits of k bodies by method.
    bodies : sequence of str, length k
    unit : str
        Unit of length.
    title : str, optional

    Returns
    -------
    Figure
    """
    figure = blank_figure(4.1 * len(panels), 5.4, title)
    axes = figure.subplots(1, len(panels), sharex=True, sharey=True, squeeze=False)[0]
    for axis, (name, orbits) in zip(axes, panels.items(), strict=True):
        for k, body in enumerate(bodies):
            colour = PALETTE[k % len(PALETTE)]
            axis.add_collection(
                LineCollection(list(np.swapaxes(np.asarray(orbits.paths)[k], 1, 2)), colors=colour, lw=0.5)
            )
            mark = {"marker": MARKERS[k % len(MARKERS)], "mec": "white", "ms": 7, "zorder": 3}
            axis.plot(*np.asarray(orbits.last)[k], ls="", color=colour, label=body, **mark)
        _plane(axis, name, unit)
    axes[0].set_ylabel(f"y [{unit}]")
    _legend_below(figure, axes[0], heading="final position")
    return figure


def orbit_in_time_figure(panels: Mapping[str, tuple[Any, Any]], *, unit: str, time: str, title: str = "") -> Figure:
    """Draw one body's changing orbit in a plane, coloured by time, one panel for each method.

    Parameters
    ----------
    panels : mapping of str to (array_like, array_like)
        Times, (m,), and curves, (m, 2, points), by method.
    unit, time : str
        Unit of length, and label of the time.
    title : str, optional

    Returns
    -------
    Figure
    """
    figure = blank_figure(4.1 * len(panels) + 0.8, 4.9, title)
    axes = figure.subplots(1, len(panels), sharex=True, sharey=True, squeeze=False)[0]
    norm = Normalize(0.0, max(float(np.max(t)) for t, _ in panels.values()))
    for axis, (name, (t, paths)) in zip(axes, panels.items(), strict=True):
        curves = LineCollection(list(np.swapaxes(paths, 1, 2)), cmap="viridis", norm=norm, lw=0.7)
        curves.set_array(np.asarray(t, dtype=float))
        axis.add_collection(curves)
        axis.autoscale()
        _plane(axis, name, unit)
    axes[0].set_ylabel(f"y [{unit}]")
    figure.colorbar(curves, ax=list(axes), label=time, shrink=0.8, pad=0.01)
    return figure


def paper_kepler_figure(runs: Mapping[str, Any], *, title: str = "") -> Figure:
    """Draw orbits, energy, momentum and position errors, a row for each method, as the paper's figures 1 and 2 do.

    Parameters
    ----------
    runs : mapping of str to object
        Runs by method, with attributes `t` (m,), `energy_error`, `momentum_error` and `position_error` (m,), which are
        absolute errors, and `orbit` (2, k), the positions to draw.
    title : str, optional

    Returns
    -------
    Figure
    """
    figure = blank_figure(14.0, 3.1 * len(runs) + 0.6, title)
    axes = figure.subplots(len(runs), 4, squeeze=False, width_ratios=[0.85, 1, 1, 1])
    for row, (name, run) in zip(axes, runs.items(), strict=True):
        row[0].plot(*np.asarray(run.orbit), color=PALETTE[0], lw=0.35)
        _plane(row[0], name, "")
        row[0].set_xlabel("$q_1$")
        row[0].set_ylabel("$q_2$")
        errors = (("$|H - H_0|$", run.energy_error), ("$|L - L_0|$", run.momentum_error))
        for k, (label, values) in enumerate((*errors, ("error of position", run.position_error))):
            _envelope(row[1 + k], run.t, values, {"color": PALETTE[k], "ls": "-", "marker": ""})
            log_errors(row[1 + k], "t", label)
            low, high = np.log10(row[1 + k].get_ylim())
            row[1 + k].set_ylim(10 ** np.floor(low), 10 ** np.ceil(high))  # at least two labelled ticks
    return figure


def gains_figure(errors: Mapping[str, tuple[float, float]], *, what: str, title: str = "", labels: int = 6) -> Figure:
    """Draw errors with projection against errors without; projection helps below the diagonal.

    Parameters
    ----------
    errors : mapping of str to (float, float)
        Errors without and with projection by case; values that are zero or not finite are left out.
    what : str
        Name of the error, with its unit.
    title : str, optional
    labels : int, optional
        Number of the largest gains that are labelled with their names; all cases above the diagonal are.

    Returns
    -------
    Figure
    """
    figure = blank_figure(7.4, 6.4, title)
    axis = figure.subplots()
    good = {name: pair for name, pair in errors.items() if all(np.isfinite(x) and x > 0 for x in pair)}
    axis.set_xscale("log")
    axis.set_yscale("log")
    x, y = np.array(list(good.values())).reshape(-1, 2).T
    low, high = (float(f(10.0, g(np.log10([x, y])) + d)) for f, g, d in ((pow, np.min, -0.5), (pow, np.max, 0.5)))
    span = np.array([low, high])
    axis.plot(span, span, color="0.4", lw=1.0)
    for factor in (1e-1, 1e-2, 1e-3):
        axis.plot(span, factor * span, color="0.75", lw=0.7, ls=":")
        axis.annotate(
            f"{1 / factor:.0f} times less", (low / factor, low), (10, 3), textcoords="offset points",
            fontsize="x-small", color="0.5", rotation=45, rotation_mode="anchor",
        )  # fmt: skip
    worse = y > x
    axis.plot(
        x[~worse], y[~worse], ls="", marker="o", color=PALETTE[0], mec="white", ms=7, label="less with projection"
    )
    if worse.any():
        axis.plot(
            x[worse], y[worse], ls="", marker="s", color=PALETTE[2], mec="white", ms=7, label="more with projection"
        )
    gains = set(np.argsort(y / x)[:labels])
    for k, name in enumerate(good):
        if worse[k]:  # labelled to the left, where there are no other points
            axis.annotate(name, (x[k], y[k]), (-6, 3), textcoords="offset points", fontsize="x-small", ha="right")
        elif k in gains:
            axis.annotate(name, (x[k], y[k]), (6, -3), textcoords="offset points", fontsize="x-small")
    high_x = high * 40  # room for names
    axis.set_xlim(low, high_x)
    axis.set_ylim(low, high)
    axis.set_aspect("equal")
    axis.set_xlabel(f"{what}, without projection")
    axis.set_ylabel(f"{what}, with projection")
    axis.grid(which="major", alpha=0.25)
    axis.legend(loc="upper left", fontsize="small", framealpha=0.9)
    return figure


class CostPanel(NamedTuple):
    """Errors against one cost.

    Attributes
    ----------
    title : str
    cost : str
        Label of the cost, with its unit.
    curves : mapping of str to (array_like, array_like)
        Costs and errors by method; points whose error is not a number above 0 are left out.
    slopes : mapping of str to float, optional
        Slopes for some of the methods, each drawn as a dotted line a little below the method's curve.
    """

    title: str
    cost: str
    curves: Mapping[str, tuple[Any, Any]]
    slopes: Mapping[str, float] = {}


def cost_figure(
    rows: Sequence[Sequence[CostPanel]],
    *,
    error: str,
    title: str = "",
    footnote: str = "",
    styles: Styles | None = None,
    largest: float = np.inf,
    size: tuple[float, float] = (5.3, 4.2),
    shared: bool = True,
) -> Figure:
    """Draw error against cost, a line for each method.

    Parameters
    ----------
    rows : sequence of sequences of CostPanel
        Panels; a method has the same style in all.
    error : str
        Label of the error, with its unit.
    title, footnote : str, optional
    styles : mapping, optional
        From `method_styles`.
    largest : float, optional
        Larger errors, of runs that failed, are left out.
    size : (float, float), optional
        Size of a panel in inches.
    shared : bool, optional
        Panels of a row share the axis of errors, and those with the same cost share the axis of costs.

    Returns
    -------
    Figure
    """
    columns = max(map(len, rows))
    names = dict.fromkeys(name for row in rows for panel in row for name in panel.curves)
    styles = method_styles(names) if styles is None else styles
    figure = blank_figure(max(size[0] * columns, 6.5), size[1] * len(rows) + 1.1, title)
    if footnote:  # above the panels, because the legend is below
        figure.suptitle(f"{typeset(title)}\n{footnote}", fontsize="medium")
    axes = figure.subplots(len(rows), columns, sharey="row" if shared else "none", squeeze=False)
    first: dict[str, Axes] = {}
    drawn = []
    for row, places in zip(rows, axes, strict=True):
        for axis in places[len(row) :]:
            axis.set_visible(False)
        for panel, axis in zip(row, places, strict=False):
            drawn.append((panel, axis))
            if shared and first.setdefault(panel.cost, axis) is not axis:
                axis.sharex(first[panel.cost])
            _draw_costs(axis, panel, styles, largest)
    for panel, axis in drawn:
        log_x(axis)
        log_errors(axis, panel.cost, error if shared and axis in axes[:, 0] else "")
        for name, slope in panel.slopes.items():
            cost, errors = panel.curves[name]
            _slope_line(axis, np.asarray(cost), np.asarray(errors), slope)
    if not shared:
        figure.supylabel(error, fontsize="medium")
    _legend_below(figure, axes[0, 0])
    return figure


def _draw_costs(axis: Axes, panel: CostPanel, styles: Styles, largest: float) -> None:
    for name, values in panel.curves.items():
        cost, errors = (np.asarray(value, dtype=float) for value in values)
        good = (errors > 0) & (errors <= largest)
        axis.plot(cost[good], errors[good], ms=5, lw=1.2, **styles[name])
    axis.set_title(panel.title, fontsize="medium")


class Linkage(NamedTuple):
    """Positions of a linkage in a plane.

    Attributes
    ----------
    t : array_like, shape (k,)
    joints : array_like, shape (k, p, 2)
        Both ends of the chain of links, and the joints between them.
    pivots : array_like, shape (2, 2)
        Fixed points to which the two ends of the chain are attached.
    """

    t: Any
    joints: Any
    pivots: Any


def linkage_figure(
    drawings: Mapping[str, Linkage],
    panels: Sequence[CostPanel],
    *,
    unit: str,
    time: str,
    error: str,
    title: str = "",
    largest: float = np.inf,
) -> Figure:
    """Draw a linkage at several times, a panel for each run, and below errors against costs.

    A dotted line connects the last link at the last time with its pivot.

    Parameters
    ----------
    drawings : mapping of str to Linkage
        Linkages by the titles of the panels; all have the same times.
    panels : sequence of CostPanel
        As many as `drawings`; they are drawn below them.
    unit, time, error : str
        Unit of length, labels of the time and of the error.
    title : str, optional
    largest : float, optional
        Larger errors are left out.

    Returns
    -------
    Figure
    """
    figure = blank_figure(4.9 * len(panels), 7.4, title)
    above, below = figure.subplots(2, len(panels), height_ratios=[1, 1.15], squeeze=False)
    _draw_linkages(figure, above, drawings, unit, time)
    styles = method_styles(dict.fromkeys(name for panel in panels for name in panel.curves))
    for axis, panel in zip(below, panels, strict=True):
        _draw_costs(axis, panel, styles, largest)
        log_x(axis)
        log_errors(axis, panel.cost, error)
    _legend_below(figure, below[0])
    return figure


def linkages_figure(drawings: Mapping[str, Linkage], *, unit: str, time: str) -> Figure:
    """Draw a linkage at several times, a panel for each run, as the upper row of `linkage_figure`.

    Parameters
    ----------
    drawings : mapping of str to Linkage
        Linkages by the titles of the panels; all have the same times.
    unit, time : str
        Unit of length, label of the time.

    Returns
    -------
    Figure
    """
    figure = blank_figure(4.5 * len(drawings), 2.7)
    _draw_linkages(figure, figure.subplots(1, len(drawings)), drawings, unit, time)
    return figure


def _draw_linkages(figure: Figure, above: Any, drawings: Mapping[str, Linkage], unit: str, time: str) -> None:
    """Draw linkages in the row of axes `above`, with a colour scale of the time."""
    t = np.asarray(next(iter(drawings.values())).t, dtype=float)
    for axis, (name, linkage) in zip(above, drawings.items(), strict=True):
        links = LineCollection(
            list(np.asarray(linkage.joints, dtype=float)), cmap="viridis", norm=Normalize(t[0], t[-1]), lw=1.8, zorder=2
        )
        links.set_array(t)
        axis.add_collection(links)
        for colour, joints in zip(links.to_rgba(t), np.asarray(linkage.joints), strict=True):
            axis.plot(*joints.T, ls="", marker="o", ms=4, color=colour, zorder=3)
        gap = np.array([linkage.joints[-1][-1], linkage.pivots[-1]])  # at the last time
        axis.plot(*gap.T, color="crimson", ls=":", lw=1.6, zorder=1)
        axis.plot(*np.asarray(linkage.pivots).T, ls="", marker="^", ms=10, color="black", zorder=4)
        if axis is not above[0]:
            axis.sharex(above[0])
            axis.sharey(above[0])
        axis.set(aspect="equal", xlabel=f"x [{unit}]", ylabel=f"y [{unit}]")
        axis.set_title(name, fontsize="medium")
        axis.grid(alpha=0.2)
    figure.colorbar(links, ax=list(above), label=time, shrink=0.8, pad=0.01)


def _slope_line(axis: Axes, h: np.ndarray, error: np.ndarray, slope: float) -> None:
    """Draw a dotted line of the given slope a little below a method's curve, labelled with the slope.

    `h` and `error` are the costs and the errors of the points of the curve.
    """
    ends = np.array([h.min(), h.max()])
    line = 0.25 * error[np.argmax(h)] * (ends / ends[1]) ** slope
    axis.plot(ends, line, color="0.4", lw=1.0, ls=":")
    start = float(ends[0]), float(line[0])
    text = axis.annotate(f"slope {slope:.2f}", start, (4, -2), textcoords="offset points", va="top", fontsize="small")
    text.set_bbox({"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.5})


def blank_figure(width: float, height: float, title: str = "") -> Figure:
    """Return an empty figure in the layout of all figures.

    `width` and `height` are in inches. A wide figure is made narrower, because a page scales all figures to its own
    width, and text in a wide one would be too small to read. The height is then reduced by the square root of the
    factor of the width, to leave room for text.
    """
    scale = min(1.0, WIDEST / width)
    figure = Figure(figsize=(scale * width, scale**0.5 * height), dpi=DPI, layout="constrained")
    if title:
        figure.suptitle(typeset(title), fontsize="large")
    return figure


def _envelope(axis: Axes, t: Any, values: Any, style: Mapping[str, Any], *, log: bool = False) -> None:
    """Draw the largest magnitude in each of `POINTS` intervals of time, because all values would fill the area.

    The intervals are equal in time, or in its logarithm if `log` is true.
    """
    t, magnitude = np.asarray(t, dtype=float), np.abs(np.asarray(values, dtype=float))
    n = min(t.size, magnitude.size)
    known = np.flatnonzero(np.isfinite(magnitude[:n]) & (t[:n] > 0))
    if not known.size:
        axis.plot([], [], **style)
        return
    scale = np.log(t[known]) if log else t[known]
    edges = np.linspace(scale[0], scale[-1], POINTS + 1)[1:-1]
    groups = [group for group in np.split(known, np.searchsorted(scale, edges, side="right")) if group.size]
    at = np.array([t[group[-1]] for group in groups])
    top = np.array([max(magnitude[group].max(), FLOOR) for group in groups])
    axis.plot(at, top, lw=1.3, ms=4.5, markevery=_marked(np.log(at) if log else at), **style)


def _marked(scale: np.ndarray, count: int = 6) -> list[int]:
    """Return the indices of at most `count` of the ascending values `scale`, about equally spaced, for markers."""
    wanted = np.linspace(scale[0], scale[-1], 2 * count + 1)[1::2]
    return sorted({int(np.argmin(np.abs(scale - at))) for at in wanted})


def log_x(axis: Axes) -> None:
    """Make x a log axis with labels at powers of ten; in a short range also at 2 and 5 times those.

    Parameters
    ----------
    axis : matplotlib.axes.Axes
        Axes in which the curves are drawn already.
    """
    axis.set_xscale("log")
    low, high = axis.get_xlim()
    if high / low < 5:  # two labels at least, or matplotlib chooses others
        axis.set_xlim(low / 1.6, high * 1.6)
    if high / low < 100:
        axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.xaxis.set_major_formatter(FuncFormatter(_short))
    axis.xaxis.set_minor_formatter(NullFormatter())


def _short(value: float, _: Any) -> str:
    """Format a number in few characters, for labels of a log axis that would overlap otherwise."""
    return f"{value:g}" if value < 1e4 else f"{value:.0e}".replace("e+0", "e")


def _plane(axis: Axes, title: str, unit: str) -> None:
    """Label a panel of orbits in a plane, set equal scales, and draw a cross for the central body."""
    axis.plot(0, 0, ls="", marker="+", color="black", ms=8)
    axis.set_title(title, fontsize="medium")
    axis.set_aspect("equal", adjustable="box")
    axis.set_xlabel(f"x [{unit}]")
    axis.xaxis.set_major_locator(MaxNLocator(3))
    axis.yaxis.set_major_locator(MaxNLocator(3))
    axis.grid(alpha=0.2)


def _legend_below(figure: Figure, axis: Axes, heading: str | None = None) -> None:
    handles, labels = axis.get_legend_handles_labels()
    most = 4 if len(labels) > 5 else 5
    if max(map(len, labels), default=0) > LONG_LABEL:
        most = 2
    figure.legend(
        handles,
        labels,
        loc="outside lower center",
        ncols=min(len(labels), most),
        fontsize="small",
        frameon=False,
        handlelength=3.5 if heading is None else 1.5,
        title=heading,
        title_fontsize="small",
    )
