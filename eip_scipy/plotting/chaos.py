"""Figures of chaos indicators."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from . import draw_lines, shown_figure, typeset

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["draw_stability", "indicator_figure", "stability_map"]

REGULAR = 2.0  # MEGNO of a regular orbit


def stability_map(
    x: Any, y: Any, megno: Any, *, xlabel: str = "x", ylabel: str = "y", title: str = "", most: float = 8.0
) -> Figure:
    """Draw a map of MEGNO over two quantities.

    Parameters
    ----------
    x, y : array_like, shape (k,) and (j,)
        Values of the quantities, in ascending order.
    megno : array_like, shape (j, k)
        Mean MEGNO at each pair (y, x). Values above `most`, and inf, have the colour of `most`; nan has no colour.
    xlabel, ylabel, title : str, optional
        Labels and title.
    most : float, optional
        Upper end of the colour scale, above 2.

    Returns
    -------
    Figure

    Raises
    ------
    ValueError
        If the shapes do not agree, or `most` is too small.
    """
    figure = shown_figure(6.4, 4.6)
    if title:
        figure.suptitle(typeset(title), fontsize="large")
    axis = figure.add_subplot()
    image = draw_stability(axis, x, y, megno, most)
    figure.colorbar(image, ax=axis, extend="max", label="mean MEGNO (2: regular)")
    axis.set(xlabel=xlabel, ylabel=ylabel)
    return figure


def draw_stability(axis: Axes, x: Any, y: Any, megno: Any, most: float) -> Any:
    """Draw the cells of a `stability_map`, and return them as the QuadMesh for a colour bar."""
    x, y, values = (np.asarray(item, dtype=float) for item in (x, y, megno))
    if values.shape != (y.size, x.size):
        raise ValueError(
            f"megno must have the shape {(y.size, x.size)}, a row for each y, a column for each x, got {values.shape}."
        )
    if not most > REGULAR:
        raise ValueError(f"most must be above {REGULAR:g}, the MEGNO of a regular orbit, got {most!r}.")
    # The scale starts at 0, the value of a harmonic oscillator. Viridis suits colour-blind readers.
    return axis.pcolormesh(x, y, np.clip(values, 0.0, most), cmap="viridis", vmin=0.0, vmax=most, shading="nearest")


def indicator_figure(t: Any, curves: Mapping[str, Any], *, ylabel: str, level: float | None = None) -> Figure:
    """Draw indicators at times `t` (m,), `curves` of (m,) values by name; a line marks the value `level`."""
    figure = shown_figure(5.6, 4.0)
    axis = figure.add_subplot()
    draw_lines(axis, t, curves)
    axis.legend(fontsize="small", loc="best")
    if level is not None:
        axis.axhline(level, color="#777777", lw=0.8, ls=":")
    axis.set(xlabel="t", ylabel=ylabel)
    return figure
