"""The figure of one run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from . import FLOOR, PALETTE, _figure, _log_errors, method_styles

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["run_figure"]

MOST = 9  # components, or bodies, that can be told apart
TICKS = 5  # of times with five digits: more would touch each other
HEALTHY = 5.0  # corrections in local errors, see `Diagnostics`


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

    Parameters
    ----------
    t : array_like, shape (m,)
    components : mapping of str to array_like, shape (m,)
        Real, or complex, of which the magnitude is drawn.
    paths : mapping of str to (array_like, array_like)
        For each body x and y, (m,) both; drawn in place of the components where there are some.
    errors : mapping of str to array_like, shape (m,)
        For each invariant; without any there is no panel.
    corrections : mapping of str to float
        For each invariant the largest, in local errors; likewise.
    title : str, optional

    Returns
    -------
    Figure
    """
    widths = [1.0, *([1.0] if errors else []), *([0.6] if corrections else [])]
    figure = _figure(4.4 * sum(widths) + 0.6, 4.2, title)
    axes = figure.subplots(1, len(widths), width_ratios=widths, squeeze=False)[0]
    if paths:
        _draw_paths(axes[0], paths)
    else:
        _draw_components(axes[0], np.asarray(t), components)
    styles = method_styles(errors)
    for name, values in errors.items():
        axes[1].plot(t, _above_zero(np.abs(values)), lw=1.1, **styles[name] | {"marker": None})
    if errors:
        _log_errors(axes[1], "t", "|I - target|")
        axes[1].locator_params(axis="x", nbins=TICKS)
        axes[1].legend(fontsize="small", loc="upper left")
    if corrections:
        _draw_corrections(axes[-1], corrections, styles)
    return figure


def _draw_paths(axis: Axes, paths: Mapping[str, tuple[Any, Any]]) -> None:
    for k, (name, (x, y)) in enumerate(list(paths.items())[:MOST]):
        axis.plot(x, y, color=PALETTE[k], lw=0.8)
        axis.plot(x[-1], y[-1], ls="", marker="o", color=PALETTE[k], mec="white", label=name)
    axis.set_aspect("equal", adjustable="datalim")
    axis.set_xlabel("x")
    axis.set_ylabel("y")
    axis.grid(alpha=0.2)
    _named(axis, len(paths))


def _draw_components(axis: Axes, t: np.ndarray, components: Mapping[str, Any]) -> None:
    shown = dict(list(components.items())[:MOST])
    for name, style in method_styles(shown).items():
        values = np.asarray(shown[name])
        is_complex = values.dtype.kind == "c"
        style |= {"label": f"|{name}|" if is_complex else name, "marker": None}
        axis.plot(t, np.abs(values) if is_complex else values, lw=1.1, **style)
    axis.set_xlabel("t")
    axis.locator_params(axis="x", nbins=TICKS)
    axis.grid(alpha=0.2)
    _named(axis, len(components))


def _named(axis: Axes, there: int) -> None:
    if there > 1:
        axis.legend(fontsize="small", loc="upper right")
    if there > MOST:
        axis.set_title(f"the first {MOST} of {there}", fontsize="medium")


def _above_zero(magnitudes: np.ndarray) -> np.ndarray:
    """Magnitudes for a log axis: zero is drawn as the smallest of the others, whatever the unit."""
    positive = magnitudes[magnitudes > 0]
    return np.maximum(magnitudes, positive.min() if positive.size else FLOOR)


def _draw_corrections(axis: Axes, corrections: Mapping[str, float], styles: Mapping[str, Mapping[str, Any]]) -> None:
    for k, (name, size) in enumerate(corrections.items()):
        axis.bar(k, max(size, FLOOR), width=0.6, color=styles[name]["color"])
    axis.set_xticks(range(len(corrections)), list(corrections))
    axis.axhline(HEALTHY, color="0.4", lw=1.0, ls=":")
    text = axis.annotate("most healthy runs stay below", (0.02, HEALTHY), xycoords=("axes fraction", "data"))
    text.set(va="bottom", fontsize="x-small")
    _log_errors(axis, "", "largest correction [local errors]")
