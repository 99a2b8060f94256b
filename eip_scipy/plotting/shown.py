"""Figures that show themselves: in a notebook without a magic, and in windows by ``pyplot.show``."""

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
    """A matplotlib Figure that a notebook shows once, whether it is a cell's last value or not.

    Notes
    -----
    If figures have windows, and in notebooks with the inline backend, the figure belongs to pyplot: ``pyplot.show()``
    and the end of a cell show it. pyplot keeps at most as many windows as it does without a warning. Elsewhere the
    figure is freed with its last reference.
    """

    def savefig(self, fname: Any, **options: Any) -> None:
        """Save the figure, at 160 dots per inch unless `dpi` or the rc parameter says otherwise."""
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
            Elsewhere, for which IPython then takes another representation.
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
    """Make an empty figure, which pyplot shows where it can show figures at all.

    Parameters
    ----------
    width, height : float
        In inches.

    Returns
    -------
    ShownFigure
    """
    backend = _backend()
    if backend in backend_registry.list_builtin(BackendFilter.NON_INTERACTIVE):
        return ShownFigure(figsize=(width, height), dpi=DPI, layout="constrained")
    inline = INLINE in backend
    if not inline:  # in a notebook the end of the cell closes what it has shown
        _close_oldest()
    dpi = DPI if inline else rcParams["figure.dpi"]  # a window of 160 dots per inch would leave the screen
    most = rcParams["figure.max_open_warning"]
    # Not by rc_context: pyplot may load its backend now, and what that sets (interactive for the inline one) must stay.
    rcParams["figure.max_open_warning"] = 0 if inline else most
    try:
        figure = pyplot.figure(FigureClass=ShownFigure, figsize=(width, height), dpi=dpi, layout="constrained")
    finally:
        rcParams["figure.max_open_warning"] = most
    assert isinstance(figure, ShownFigure)
    _windows.append(weakref.ref(figure))
    return figure


def _backend() -> str:
    """Return the name of pyplot's backend, which is chosen now if it was not before."""
    return str(pyplot.get_backend()).lower()


def _is_open(figure: Figure) -> bool:
    """Return whether pyplot has a figure."""
    return figure.canvas.manager is not None and pyplot.fignum_exists(figure.canvas.manager.num)


def _close_oldest() -> None:
    """Let pyplot forget the oldest of these figures before it warns of too many. Who has one may still save it."""
    mine = [figure for figure in (window() for window in _windows) if figure is not None and _is_open(figure)]
    most = rcParams["figure.max_open_warning"]
    while mine and 0 < most <= len(pyplot.get_fignums()):
        pyplot.close(mine.pop(0))
    _windows[:] = map(weakref.ref, mine)
