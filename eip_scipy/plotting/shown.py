"""Figures that are displayed automatically in notebooks, and in windows by ``pyplot.show``."""

from __future__ import annotations

import io
from typing import Any

from matplotlib import pyplot, rcParams
from matplotlib.backends.registry import BackendFilter, backend_registry
from matplotlib.figure import Figure

__all__ = ["DPI", "ShownFigure", "shown_figure"]

DPI = 160
INLINE = "inline"  # in the name of the backend of notebooks


class ShownFigure(Figure):
    """A matplotlib Figure that a notebook shows once, also if it is not the last value of a cell.

    Notes
    -----
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

        Raises
        ------
        NotImplementedError
            Always: IPython then uses another representation.
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
