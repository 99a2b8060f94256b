"""Parts that the figures of several studies share: an empty figure, curves on log axes, a legend, error against cost.

Needs ``pip install "eip_scipy[plot]"``. The figures belong to no window.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

# Imported first, because its error says how matplotlib is installed.
from eip_scipy.plotting import FLOOR, log_errors, method_styles, typeset  # isort: skip
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WIDEST, DPI = 9.0, 160  # inches, dots per inch
POINTS, MARKS, LONG_LABEL = 250, 6, 24

Styles = Mapping[str, Mapping[str, Any]]
Curves = Mapping[str, tuple[Any, Any]]


def blank_figure(width: float, height: float, title: str = "") -> Figure:
    """Return an empty figure of a size in inches; a wide one is made narrower, as a page would make its text too small.

    The height is reduced by the square root of the factor of the width.
    """
    scale = min(1.0, WIDEST / width)
    figure = Figure(figsize=(scale * width, scale**0.5 * height), dpi=DPI, layout="constrained")
    if title:
        figure.suptitle(typeset(title), fontsize="large")
    return figure


def envelope(axis: Axes, t: Any, values: Any, style: Mapping[str, Any], *, log: bool = False) -> None:
    """Draw the largest magnitude in each of `POINTS` intervals of time, because all values would fill the area.

    The intervals are equal in time, or in its logarithm if `log` is true. Values that are not finite are left out.
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
    places = np.log(at) if log else at
    marked = {int(np.argmin(np.abs(places - p))) for p in np.linspace(places[0], places[-1], 2 * MARKS + 1)[1::2]}
    axis.plot(at, top, lw=1.3, ms=4.5, markevery=sorted(marked), **style)


def log_x(axis: Axes) -> None:
    """Make x a log axis with labels at powers of ten, and in a short range also at 2 and 5 times those."""
    axis.set_xscale("log")
    low, high = axis.get_xlim()
    if high / low < 5:  # two labels at least, or matplotlib chooses others
        axis.set_xlim(low / 1.6, high * 1.6)
    if high / low < 100:
        axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        short = lambda x, _: f"{x:g}" if x < 1e4 else f"{x:.0e}".replace("e+0", "e")  # noqa: E731
        axis.xaxis.set_major_formatter(FuncFormatter(short))
    axis.xaxis.set_minor_formatter(NullFormatter())


def legend_below(figure: Figure, axis: Axes, heading: str | None = None) -> None:
    """Put the legend of one axis below all of them."""
    handles, labels = axis.get_legend_handles_labels()
    most = 2 if max(map(len, labels), default=0) > LONG_LABEL else 4 if len(labels) > 5 else 5
    look: dict[str, Any] = {"fontsize": "small", "title": heading, "title_fontsize": "small", "frameon": False}
    length = 3.5 if heading is None else 1.5
    figure.legend(
        handles, labels, loc="outside lower center", ncols=min(len(labels), most), handlelength=length, **look
    )


def cost_figure(
    panels: Sequence[tuple[str, Curves]],
    *,
    cost: str,
    error: str,
    title: str = "",
    footnote: str = "",
    styles: Styles | None = None,
) -> Figure:
    """Draw error against cost, one panel for each pair (title, curves), which share their axes.

    The curves are pairs (costs, errors) by method; a method has the same style in all panels.
    """
    styles = method_styles(dict.fromkeys(name for _, curves in panels for name in curves)) if styles is None else styles
    figure = blank_figure(max(5.3 * len(panels), 6.5), 5.3, title)
    if footnote:  # above the panels, because the legend is below
        figure.suptitle(f"{typeset(title)}\n{footnote}", fontsize="medium")
    axes = figure.subplots(1, len(panels), sharex=True, sharey=True, squeeze=False)[0]
    for axis, (name, curves) in zip(axes, panels, strict=True):
        for method, (costs, errors) in curves.items():
            good = np.asarray(errors, dtype=float) > 0
            axis.plot(np.asarray(costs)[good], np.asarray(errors)[good], ms=5, lw=1.2, **styles[method])
        axis.set_title(name, fontsize="medium")
    for axis in axes:
        log_x(axis)
        log_errors(axis, cost, error if axis is axes[0] else "")
    legend_below(figure, axes[0])
    return figure
