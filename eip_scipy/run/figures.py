"""The figure of a run, of `integrate` or of `solve_ivp`."""

from __future__ import annotations

from typing import Any

import numpy as np

from .tables import component_names, invariant_rows, of_members

__all__ = ["described", "planes", "plot"]


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
        True: draw paths in the plane instead of components in time. Default: True if components are named x and y, or
        x_0 and y_0, x_1 and y_1 and so on.
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
    from ..plotting.runs import draw_run, run_figure

    if ax is not None and not hasattr(ax, "plot"):
        kind = f"{type(ax).__name__} of shape {ax.shape}" if isinstance(ax, np.ndarray) else type(ax).__name__
        raise TypeError(f"plot: ax must be one matplotlib Axes, got {kind}; choose one of several, such as axes[0].")
    if of_members(result):
        if ax is not None or orbit is not None:
            raise TypeError("plot: the figure of an ensemble takes neither ax nor orbit; omit them.")
        return result.plot(names)
    labels = component_names(result, names)
    pairs = planes(labels)
    if orbit and not pairs:
        raise ValueError(
            "plot: an orbit needs components named x and y, or x_0 and y_0 and so on; pass such names as names=, or "
            "omit orbit."
        )
    y, diagnostics = np.asarray(result.y), result.get("diagnostics")
    paths = {name: (y[i], y[j]) for name, (i, j) in pairs.items()} if orbit is not False else {}
    components = dict(zip(labels, y, strict=True))
    if ax is not None:
        draw_run(ax, result.t, components, paths, described(result))
        return ax
    invariants = invariant_rows(result)
    corrections = {} if diagnostics is None else dict(zip(diagnostics.names, diagnostics.corrections, strict=True))
    return run_figure(
        result.t,
        components,
        paths=paths,
        errors={name: errors for name, (_, errors) in invariants.items() if not np.isnan(errors).all()},  # no balances
        corrections={name: size for name, size in corrections.items() if name in invariants and np.isfinite(size)},
        title=described(result),
    )


def planes(names: tuple[str, ...]) -> dict[str, tuple[int, int]]:
    """Return the indices of the components x and y of each body, by the name of the body.

    The name is "0" for x_0 and y_0, and "orbit" for x and y.
    """
    place = {name: k for k, name in enumerate(names)}
    bodies = [name[1:] for name in names if name[:1] == "x" and name[1:2] in ("", "_")]
    return {
        body.removeprefix("_") or "orbit": (place[f"x{body}"], place[f"y{body}"])
        for body in bodies
        if f"y{body}" in place
    }


def described(result: Any) -> str:
    """Return the method, the step and a remark if the run is not reliable; no text if the result names no method."""
    if "method" not in result:
        return ""
    step = "adaptive steps" if result.h is None else f"h = {result.h:g}"
    return f"{result.method}, {step}" + ("" if result.trusted else ": not to be trusted")
