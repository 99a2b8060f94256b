"""Styles for all figures, and figures that are displayed automatically in notebooks and by ``pyplot.show``.

Only this package and the figures of `eip_scipy_studies` import matplotlib.

Needs ``pip install "eip_scipy[plot]"``. The figures of runs and ensembles are drawn by ``run.plot()``.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, Literal, cast

try:
    from matplotlib import pyplot, rcParams
    from matplotlib.backends.registry import BackendFilter, backend_registry
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch
    from matplotlib.ticker import LogLocator, NullFormatter
except ModuleNotFoundError as error:
    message = 'eip_scipy.plotting needs matplotlib: pip install "eip_scipy[plot]"'
    raise ImportError(message, name="matplotlib") from error

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = [
    "FLOOR", "MARKERS", "PALETTE", "draw_lines", "log_errors", "map", "method_styles", "shown_figure", "typeset",
]  # fmt: skip

# Colours of Okabe & Ito, Color universal design (2008), without yellow, which is too light for lines on white, and
# wine and olive of Tol.
PALETTE = ("#0072B2", "#E69F00", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#000000", "#777777", "#882255", "#999933")
LINES = ("-", "--", "-.", (0, (5, 1, 1, 1, 1, 1)), (0, (3, 1)), (0, (1, 1)), "-", "--", (0, (8, 2, 1, 2)), (0, (4, 2)))
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", "*", ">")
# Orbits in maps that ended early, by status; others are white.
ENDED = {"escaped": "#D55E00", "collided": "#CC79A7", "failed": "#777777"}
GREEK = {"alpha": "α", "beta": "β", "kappa": "κ", "Omega": "Ω"}
POWERS = "⁰¹²³⁴⁵⁶⁷⁸⁹"
DPI = 160
INLINE = "inline"  # in the name of the backend of notebooks
# An error below the spacing of floats is meaningless, and a log axis cannot show zero.
FLOOR = 1e-16


def method_styles(names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Return keywords of ``Axes.plot`` by name: colour, line and marker, so that methods differ by more than colour.

    `names` are all methods in a set of figures, so that the styles agree between figures.
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


def draw_lines(axis: Axes, x: Any, curves: Mapping[str, Any], styles: Mapping[str, Any] | None = None) -> None:
    """Draw curves by name, in the `styles` of their names, with a legend if there are several styles."""
    styles = method_styles(curves) if styles is None else styles
    for name, values in curves.items():
        axis.plot(x, values, lw=1.1, **styles[name] | {"marker": None})
    axis.grid(alpha=0.2)
    if len(styles) > 1:
        axis.legend(fontsize="small", loc="upper right")


def map(
    x: Any, y: Any, found: Any, *, ax: Axes | None = None, xlabel: str = "x", ylabel: str = "y", title: str = "",
    most: float | None = None,
) -> Figure:  # fmt: skip
    """Draw a map of a chaos indicator over two quantities.

    Parameters
    ----------
    x, y : array_like, shape (k,) and (j,)
        Values of the quantities, in ascending order.
    found : ChaosResult or array_like, shape (j, k)
        Result of `eip_scipy.chaos.megno` or `lyapunov_exponent` for a grid with a row for each y, or values of MEGNO.
        Orbits that an event ended or that failed have a colour for each status, and nan has none.
    ax : matplotlib.axes.Axes, optional
        Axes to draw on. Default: those of a new figure.
    xlabel, ylabel, title : str, optional
        Labels and title.
    most : float, optional
        Upper end of the colour scale, which starts at 0, the MEGNO of a harmonic oscillator; values beyond have the
        colour of the end. Default: 8 for MEGNO, the largest value for exponents, whose scale starts at the least one.

    Returns
    -------
    Figure

    Raises
    ------
    ValueError
        If the shapes do not agree, or `most` is not above 0.

    See Also
    --------
    eip_scipy.chaos.megno, eip_scipy.chaos.lyapunov_exponent

    Examples
    --------
    >>> import numpy as np
    >>> from eip_scipy.plotting import map
    >>> figure = map([1.0, 1.1, 1.2], [0.0, 0.1], np.full((2, 3), 2.0), xlabel="axis", ylabel="eccentricity")
    """
    known = isinstance(found, Mapping)
    is_megno = not known or "megno" in found
    values = np.array(found["megno" if is_megno else "lyapunov"] if known else found, float)
    status = np.array(found["status"]) if known else np.full(values.shape, "ok")
    x, y = np.asarray(x, float), np.asarray(y, float)
    if values.shape != (y.size, x.size):
        raise ValueError(
            f"found must have the shape {(y.size, x.size)}, a row for each y and a column for each x, got "
            f"{values.shape}."
        )
    values[status != "ok"] = np.nan
    if most is None:
        most = 8.0 if is_megno else float(np.nanmax(values, initial=1e-300))
    if not most > 0:
        raise ValueError(f"most must be above 0, got {most!r}.")
    axis = shown_figure(6.4, 4.6).add_subplot() if ax is None else ax
    least = 0.0 if is_megno else float(np.nanmin(values, initial=0.0))
    # Viridis suits colour-blind readers.
    image = axis.pcolormesh(
        x, y, np.clip(values, least, most), cmap="viridis", vmin=least, vmax=most, shading="nearest"
    )
    others = [name for name in np.unique(status).tolist() if name != "ok"]
    for name in others:
        cells, colors = np.where(status == name, 1.0, np.nan), ListedColormap([ENDED.get(name, "#FFFFFF")])
        axis.pcolormesh(x, y, cells, cmap=colors, shading="nearest")
    if others:
        patches = [Patch(facecolor=ENDED.get(name, "#FFFFFF"), edgecolor="k", label=name) for name in others]
        axis.legend(handles=patches, fontsize="small", loc="upper right")
    label = "mean MEGNO (2: regular)" if is_megno else "largest Lyapunov exponent"
    axis.figure.colorbar(image, ax=axis, extend="max", label=label)
    axis.set(xlabel=xlabel, ylabel=ylabel, title=typeset(title))
    return cast(Figure, axis.figure)


class ShownFigure(Figure):
    """A matplotlib Figure that a notebook shows once, also if it is not the last value of a cell.

    If figures have windows, and in notebooks with the inline backend, the figure belongs to pyplot: ``pyplot.show()``
    and the end of a cell show it. The number of windows stays below the one at which pyplot warns. Otherwise the figure
    is freed with its last reference.
    """

    def savefig(self, fname: Any, **options: Any) -> None:
        """Save the figure, at 160 dots per inch unless `dpi` or the rc parameter ``savefig.dpi`` is set."""
        if rcParams["savefig.dpi"] == "figure":
            options.setdefault("dpi", DPI)
        super().savefig(fname, **options)

    def _repr_png_(self) -> bytes | None:
        """Return the picture for a notebook; None for a figure that has a window or a widget."""
        if self.canvas.manager is not None and pyplot.fignum_exists(self.canvas.manager.num):
            return None
        stream = io.BytesIO()
        self.savefig(stream, format="png")
        return stream.getvalue()

    def _ipython_display_(self) -> None:
        """Close the figure in a notebook with the inline backend, which shows it now and not again after the cell.

        NotImplementedError is always raised, so that IPython uses another representation.
        """
        if INLINE in _backend():
            pyplot.close(self)
        raise NotImplementedError


def shown_figure(width: float, height: float) -> ShownFigure:
    """Create an empty figure of a size in inches, which pyplot shows if the backend can show figures."""
    backend, dpi = _backend(), DPI
    if backend in backend_registry.list_builtin(BackendFilter.NON_INTERACTIVE):
        return ShownFigure(figsize=(width, height), dpi=DPI, layout="constrained")
    if INLINE not in backend:  # in a notebook the end of the cell closes its figures
        dpi = rcParams["figure.dpi"]  # a window of 160 dots per inch would leave the screen
        _close_oldest()
    figure = pyplot.figure(FigureClass=ShownFigure, figsize=(width, height), dpi=dpi, layout="constrained")
    assert isinstance(figure, ShownFigure)
    return figure


def _close_oldest() -> None:
    """Close the oldest figures of this package in pyplot before it warns about too many; they can still be saved."""
    most, numbers = rcParams["figure.max_open_warning"], pyplot.get_fignums()
    own = [number for number in numbers if isinstance(pyplot.figure(number), ShownFigure)]
    for number in own[: max(0, len(numbers) - most + 1) if most > 0 else 0]:
        pyplot.close(number)


def _backend() -> str:
    """Return the name of pyplot's backend, which is chosen now if it has not been chosen before."""
    return str(pyplot.get_backend()).lower()
