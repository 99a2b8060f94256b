"""Styles for all figures. Only this package and the figures of `eip_scipy_studies` import matplotlib.

Needs ``pip install "eip_scipy[plot]"``. The figures of runs and ensembles are drawn by ``run.plot()``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, Literal

try:
    from matplotlib.ticker import LogLocator, NullFormatter
except ModuleNotFoundError as error:
    message = 'eip_scipy.plotting needs matplotlib: pip install "eip_scipy[plot]"'
    raise ImportError(message, name="matplotlib") from error

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["FLOOR", "MARKERS", "PALETTE", "draw_lines", "log_errors", "method_styles", "typeset"]

# Colours of Okabe & Ito, Color universal design (2008), without yellow, which is too light for lines on white, and
# wine and olive of Tol.
PALETTE = ("#0072B2", "#E69F00", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#000000", "#777777", "#882255", "#999933")
LINES = ("-", "--", "-.", (0, (5, 1, 1, 1, 1, 1)), (0, (3, 1)), (0, (1, 1)), "-", "--", (0, (8, 2, 1, 2)), (0, (4, 2)))
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", "*", ">")
GREEK = {"alpha": "α", "beta": "β", "kappa": "κ", "Omega": "Ω"}
POWERS = "⁰¹²³⁴⁵⁶⁷⁸⁹"
# An error below the spacing of floats is meaningless, and a log axis cannot show zero.
FLOOR = 1e-16


def method_styles(names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Choose colour, line and marker of each method, so that methods differ by more than colour.

    Parameters
    ----------
    names : iterable of str
        All methods in a set of figures, so that the styles agree between figures.

    Returns
    -------
    dict
        Keywords of ``Axes.plot`` for each name.
    """
    return {
        name: {
            "color": PALETTE[k % len(PALETTE)],
            "ls": LINES[(k + k // len(PALETTE)) % len(LINES)],
            "marker": MARKERS[(k + 3 * (k // len(PALETTE))) % len(MARKERS)],
            "label": name,
        }
        for k, name in enumerate(names)
    }


def typeset(text: str) -> str:
    """Return a title with Greek letters, superscripts and arrows instead of their ASCII forms."""
    greek = re.sub(r"\b(alpha|beta|kappa|Omega)\b", lambda name: GREEK[name[0]], text.replace("->", "→"))
    return re.sub(r"\^(\d)", lambda power: POWERS[int(power[1])], greek)


def log_errors(axis: Axes, x: str, y: str, *, along: Literal["x", "y"] = "y") -> None:
    """Give the axis `along` a log scale with few ticks over two powers of ten at least, and label both axes."""
    axis.set(**{f"{along}scale": "log"}, xlabel=x, ylabel=y)
    low, high = axis.get_ylim() if along == "y" else axis.get_xlim()
    # A range below two powers of ten would have too few labelled ticks.
    if high / low < 100:
        axis.set(**{f"{along}lim": (low / 3, high * 3)})
    shown = axis.yaxis if along == "y" else axis.xaxis
    shown.set_major_locator(LogLocator(numticks=9 if along == "y" else 5))
    shown.set_minor_formatter(NullFormatter())
    axis.grid(which="major", alpha=0.3)


def draw_lines(
    axis: Axes,
    x: Any,
    curves: Mapping[str, Any],
    styles: Mapping[str, Any] | None = None,
    loc: Literal["best", "upper right"] = "best",
) -> None:
    """Draw curves by name, in the `styles` of their names, with a legend if there are several styles."""
    styles = method_styles(curves) if styles is None else styles
    for name, values in curves.items():
        axis.plot(x, values, lw=1.1, **styles[name] | {"marker": None})
    axis.grid(alpha=0.2)
    if len(styles) > 1:
        axis.legend(fontsize="small", loc=loc)
