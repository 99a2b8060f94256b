"""An HTML page that plays a run: one file that needs no network."""

from __future__ import annotations

import json
import os
import tempfile
import webbrowser
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from ..core.inputs import shown
from ..core.problem import Problem
from .figures import described, planes
from .tables import component_names, invariant_rows

__all__ = ["page", "view"]

MOST = 9  # largest number of components, or bodies, that can be distinguished
FRAMES = 4000
NUMBERS = 400_000  # largest number of values in all frames of the state
POINTS = 1000  # largest number of points of a profile
PLACE = "__RUN__"


def view(result: Any, path: str | os.PathLike[str] | None = None, *, names: Any = None, reference: Any = None) -> Path:
    """Write a page that plays a run: the orbit, or the state, with the errors of the invariants and of the trajectory.

    The page is one file that needs no network, with play, pause and a slider, for desktop and phone.

    Parameters
    ----------
    result : IntegrationResult or OdeResult
        Result of `integrate`, `load` or `scipy.integrate.solve_ivp`. The page plays the saved states: use `save_every`
        or `t_eval`.
    path : path-like, optional
        File to write. Default: a temporary file, which is opened in the browser.
    names : sequence of str or str, optional
        As for `to_xarray`; bodies in the plane are those whose components are named x and y, or x_0 and y_0 and so on.
    reference : callable, array_like (n, m) or result, optional
        Reference solution: ``reference(t) -> (n,)`` or None, states at the times of the run, or another result with
        these times. Default: the reference of the problem, if the run has its initial state and parameters.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    ValueError
        If fewer than two states were saved, or if `reference` has another shape or other times.

    Examples
    --------
    >>> from eip_scipy import EIPRK4, integrate
    >>> from eip_scipy.problems import kepler
    >>> run = integrate(kepler(), (0, 20), method=EIPRK4, save_every=2)
    >>> run.view("kepler.html")  # doctest: +SKIP
    """
    text = page(result, names=names, reference=reference)
    if path is not None:
        Path(path).write_text(text, encoding="utf-8")
        return Path(path)
    with tempfile.NamedTemporaryFile("w", suffix=".html", prefix="run-", delete=False, encoding="utf-8") as stream:
        stream.write(text)
    webbrowser.open(Path(stream.name).as_uri())
    return Path(stream.name)


def page(result: Any, *, names: Any = None, reference: Any = None) -> str:
    """Return the page of `view` as text."""
    y = np.asarray(result.y)
    if y.shape[1] < 2:
        raise ValueError(
            f"view: the run has {y.shape[1]} saved states, expected two or more; use save_every or t_eval."
        )
    labels = component_names(result, names)
    bodies = planes(labels)
    frames = _frames(y.shape[1], 2 * len(bodies) if bodies else min(len(y), POINTS))
    content = {
        "title": described(result),
        "message": result.message,
        "doubt": "" if result.get("trusted", True) else "Not to be trusted.",
        "unit": _time_unit(result),
        "t": _numbers(result.t[frames], 9),
        "state": _state(y, labels, bodies, frames),
        "errors": _errors(result, y, labels, bodies, reference, frames),
    }
    # Text from the run must not end the script element that contains it.
    text = json.dumps(content, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    template = (files("eip_scipy.data") / "view.html").read_text(encoding="utf-8")
    before, after = template.split(PLACE)
    return before + text + after


def _frames(rows: int, columns: int) -> np.ndarray:
    """Return the indices of the rows of `columns` numbers that the page shows, including the first and the last."""
    most = min(rows, FRAMES, max(100, NUMBERS // max(columns, 1)))
    return np.unique(np.linspace(0, rows - 1, most).round().astype(int))


def _numbers(values: Any, digits: int = 5) -> list[float | None]:
    """Return numbers for JSON, rounded to `digits` digits; NaN and infinity, which JSON lacks, become None."""
    return [float(f"{value:.{digits}g}") if np.isfinite(value) else None for value in np.asarray(values).tolist()]


def _state(y: np.ndarray, labels: tuple[str, ...], bodies: dict[str, tuple[int, int]], frames: np.ndarray) -> Any:
    """Return the data of the animation: bodies in the plane, two components, curves in time, or a profile."""
    real = np.abs(y) if np.iscomplexobj(y) else y
    if not bodies and len(y) == 2 and not np.iscomplexobj(y):
        bodies = {f"{labels[1]} over {labels[0]}": (0, 1)}
        equal, title = False, "The state in the plane"
    else:
        equal, title = True, "The orbits"
    if bodies:
        rows: Any = [{"x": _numbers(real[i, frames]), "y": _numbers(real[j, frames])} for i, j in bodies.values()]
        return {"kind": "orbits", "title": title, "equal": equal, "names": list(bodies), "rows": rows}
    what = "Magnitudes of the components" if np.iscomplexobj(y) else "The components"
    if len(y) <= MOST:
        rows = [_numbers(row[frames]) for row in real]
        return {"kind": "curves", "title": f"{what} in time", "names": list(labels), "rows": rows}
    places = np.unique(np.linspace(0, len(y) - 1, min(len(y), POINTS)).round().astype(int))
    rows = [_numbers(column, 4) for column in real[np.ix_(places, frames)].T]
    return {"kind": "profile", "title": f"{what} by their number", "places": places.tolist(), "rows": rows}


def _errors(result: Any, y: np.ndarray, labels: Any, bodies: Any, reference: Any, frames: np.ndarray) -> list[Any]:
    groups = []
    kept = {name: np.abs(errors) for name, (_, errors) in invariant_rows(result).items()}
    if kept:
        groups.append(("Errors of the invariants", kept))
    right = _reference(result, reference)
    if right is not None:
        groups.append(("Errors of the trajectory", _distances(y - right, labels, bodies)))
    return [
        {"title": title, "names": list(rows), "rows": [_largest(row, frames) for row in rows.values()]}
        for title, rows in groups
    ]


def _largest(row: np.ndarray, frames: np.ndarray) -> list[float | None]:
    """Return, for each frame, the largest value in `row` since the previous frame, so that no peak is lost."""
    return _numbers([row[0], *np.fmax.reduceat(row[1:], frames[:-1])], 3)


def _distances(difference: np.ndarray, labels: tuple[str, ...], bodies: dict[str, Any]) -> dict[str, np.ndarray]:
    """Return the position error (m,) of each body by name, from differences (n, m); without bodies, the largest one."""
    if not bodies:
        return {"largest component": np.abs(difference).max(axis=0)}
    place = {name: k for k, name in enumerate(labels)}
    found = {}
    for body, (i, j) in bodies.items():
        z = place.get(f"z{labels[i][1:]}")
        found[body] = np.linalg.norm(difference[[i, j] if z is None else [i, j, z]], axis=0)
    return found


def _reference(result: Any, given: Any) -> np.ndarray | None:
    """Return the reference states at the saved times, (n, m), NaN where they are unknown; None without a reference."""
    t, shape = np.asarray(result.t), np.shape(result.y)
    if given is None:
        given = _own_reference(result)
    if given is None:
        return None
    if callable(given):
        states = [given(float(time)) for time in t]
        return np.array([np.full(shape[0], np.nan) if state is None else state for state in states]).T
    if hasattr(given, "y") and hasattr(given, "t"):
        if not np.array_equal(given.t, t):
            raise ValueError("view: the times of the reference and of the run differ; give both the same t_eval.")
        given = given.y
    found = np.asarray(given)
    if found.shape != shape:
        raise ValueError(
            f"view: reference {shown(given)} has the shape {found.shape}; expected {shape}, the shape of run.y."
        )
    return found


def _own_reference(result: Any) -> Any:
    """Return the reference of the problem if the run has the problem's initial state and parameters, otherwise None."""
    origin = getattr(result, "_origin", None)
    request = None if origin is None else origin.request
    if request is None or not isinstance(request.fun, Problem) or request.y0 is not None or request.params is not None:
        return None
    same_start = request.t_span is None or request.t_span[0] == request.fun.t_span[0]
    return request.fun.reference if same_start else None


def _time_unit(result: Any) -> str:
    """Return the unit of time if the units of the run are a length and a time, otherwise an empty string."""
    parts = (result.get("units") or "").split(", ")
    return parts[1] if len(parts) == 2 and parts[1].replace(" ", "").isalpha() else ""
