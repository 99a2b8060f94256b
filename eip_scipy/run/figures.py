"""The figure of a run, of `integrate` or of `solve_ivp`."""

from __future__ import annotations

from typing import Any

import numpy as np

__all__ = ["plot", "steps"]


def plot(result: Any, names: Any = None, *, orbit: bool | None = None, ax: Any = None) -> Any:
    """Draw a run: the components or the orbit, the invariant errors, and the largest corrections.

    Small invariant errors only show that the projection works and say nothing about the orbit; the panel of corrections
    shows how much the projection had to correct.

    Parameters
    ----------
    result : IntegrationResult, OdeResult or EnsembleResult
        Result of `integrate`, `scipy.integrate.solve_ivp`, or `ensemble` (see `EnsembleResult.plot`). The saved states
        are drawn: use `save_every` or `t_eval`.
    names : sequence of str or str, optional
        As for `to_xarray`.
    orbit : bool, optional
        True: draw paths in the plane instead of components in time. Default: True if real components are named x and
        y, or x_0 and y_0, x_1 and y_1 and so on. Of paths in space, with z, the two directions in which they are
        largest are drawn, and the label names the third.
    ax : matplotlib.axes.Axes, optional
        Draw only the orbit or the components, into these axes.

    Returns
    -------
    matplotlib.figure.Figure or matplotlib.axes.Axes
        The figure, or `ax` if it is given. A notebook shows the figure automatically; in a script
        ``matplotlib.pyplot.show()`` shows it, and ``figure.savefig("run.png")`` writes it to a file.

    Raises
    ------
    ImportError
        If matplotlib is missing: ``pip install "eip_scipy[plot]"``.
    TypeError
        If `ax` is not one Axes, or `ax` or `orbit` is given for an ensemble.
    ValueError
        If an orbit is requested but no components have such names.

    Examples
    --------
    >>> from eip_scipy import EIPRK4, integrate
    >>> from eip_scipy.problems import kepler
    >>> run = integrate(kepler(), (0, 20), method=EIPRK4, save_every=2)
    >>> run.plot().savefig("kepler.png")  # doctest: +SKIP
    """
    if ax is not None and not hasattr(ax, "plot"):
        kind = f"{type(ax).__name__} of shape {ax.shape}" if isinstance(ax, np.ndarray) else type(ax).__name__
        raise TypeError(f"plot: ax must be one matplotlib Axes, got {kind}; choose one of several, such as axes[0].")
    if hasattr(result, "trajectories"):
        if ax is not None or orbit is not None:
            raise TypeError("plot: the figure of an ensemble takes neither ax nor orbit; omit them.")
        return result.plot(names)
    from ..plotting.results import run_figure

    return run_figure(result, names, orbit, ax)


def steps(result: Any) -> str:
    """Return the method and the step of a run or an ensemble."""
    return f"{result.method}, " + ("adaptive steps" if result.h is None else f"h = {result.h:g}")
