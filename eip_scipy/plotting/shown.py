"""Figures that are displayed automatically in notebooks, and in windows by ``pyplot.show``."""

from __future__ import annotations

import io
import weakref
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
        if _is_open(self):
            return None
        stream = io.BytesIO()
        self.savefig(stream, format="png")
        return stream.getvalue()

    def _ipython_display_(self) -> None:
        """Show the figure in a notebook with the inline backend, which then does not show it again after the cell.

        Raises
        ------
        NotImplementedError
            If the backend is another one; IPython then uses another representation.
        """
        if INLINE not in _backend():
            raise NotImplementedError
        from IPython import get_ipython
        from IPython.display import publish_display_data

        pyplot.close(self)
        formatters = get_ipython().display_formatter.formatters
        found = {kind: formatter(self) for kind, formatter in formatters.items()}
        publish_display_data({kind: picture for kind, picture in found.items() if picture is not None})


_windows: list[weakref.ref[ShownFigure]] = []


def shown_figure(width: float, height: float) -> ShownFigure:
    """Create an empty figure of a size in inches, which pyplot shows if the backend can show figures."""
    backend = _backend()
    if backend in backend_registry.list_builtin(BackendFilter.NON_INTERACTIVE):
        return ShownFigure(figsize=(width, height), dpi=DPI, layout="constrained")
    inline = INLINE in backend
    if not inline:  # in a notebook the end of the cell closes its figures
        _close_oldest()
    dpi = DPI if inline else rcParams["figure.dpi"]  # a window of 160 dots per inch would leave the screen
    most = rcParams["figure.max_open_warning"]
    # rc_context is not used, because pyplot may load its backend now, whose settings must not be reset afterwards.
    rcParams["figure.max_open_warning"] = 0 if inline else most
    try:
        figure = pyplot.figure(FigureClass=ShownFigure, figsize=(width, height), dpi=dpi, layout="constrained")
    finally:
        rcParams["figure.max_open_warning"] = most
    assert isinstance(figure, ShownFigure)
    _windows.append(weakref.ref(figure))
    return figure


def _backend() -> str:
    """Return the name of pyplot's backend, which is chosen now if it has not been chosen before."""
    return str(pyplot.get_backend()).lower()


def _is_open(figure: Figure) -> bool:
    """Return True if pyplot manages a figure."""
    return figure.canvas.manager is not None and pyplot.fignum_exists(figure.canvas.manager.num)


def _close_oldest() -> None:
    """Close the oldest figures of this package in pyplot before it warns about too many; they can still be saved."""
    mine = [figure for figure in (window() for window in _windows) if figure is not None and _is_open(figure)]
    most = rcParams["figure.max_open_warning"]
    while mine and 0 < most <= len(pyplot.get_fignums()):
        pyplot.close(mine.pop(0))
    _windows[:] = map(weakref.ref, mine)
