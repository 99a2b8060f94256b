"""Closest approaches of two bodies, in space (encounters) or as seen along an axis (transits), as events of a run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import OptimizeResult

from ...core.inputs import real_array, shown
from ...core.problem import Problem
from ...engine.native import LibraryFunction, library_function
from .bodies import bodies_of

__all__ = ["Approach", "Transits", "approaches", "check_distances", "encounters", "transits"]

IN_SPACE = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Approach:
    """An event in which the distance of bodies i and j is smallest or largest, a zero of half the rate of its square.

    The distance is that seen along the unit vector `axis`, or that in space if `axis` is 0.
    """

    i: int
    j: int
    axis: tuple[float, ...] = IN_SPACE
    direction: float = 0.0

    @cached_property
    def jitted(self) -> LibraryFunction:
        """Return the function that the engine calls."""
        return library_function("gravity.approach", (self.i, self.j, *self.axis))

    def __call__(self, t: float, y: np.ndarray, *params: Any) -> Any:
        """Return the value of the event at a state, which may be complex."""
        x, v = self.relative(y)
        return x @ v - (x @ self.axis) * (v @ self.axis)

    def by_state(self, t: float, y: np.ndarray) -> np.ndarray:
        """Return the gradient (6 N,) of the event."""
        out = np.zeros((2, y.size // 6, 3))
        for row, part in zip(out[::-1], self.relative(y), strict=True):
            row[self.j] = part - (part @ self.axis) * np.asarray(self.axis)
            row[self.i] = -row[self.j]
        return out.ravel()

    def relative(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return position and velocity (..., 3) of body j relative to body i, of states (..., 6 N)."""
        half = y.shape[-1] // 2
        places = [
            (slice(k + 3 * self.j, k + 3 * self.j + 3), slice(k + 3 * self.i, k + 3 * self.i + 3)) for k in (0, half)
        ]
        x, v = (y[..., j] - y[..., i] for j, i in places)
        return x, v


def approaches(n: int) -> tuple[Approach, ...]:
    """Return the events of all pairs of n bodies."""
    return tuple(Approach(i, j) for i, j in combinations(range(n), 2))


def check_distances(given: Any, n: int) -> np.ndarray:
    """Return the option `encounters` of `nbody` as radii (n,), whose sums are the distances of pairs."""
    found = real_array("encounters", given)
    if found.shape not in ((), (n,)) or not np.isfinite(found).all() or (found < 0).any() or not found.any():
        raise ValueError(
            f"nbody: encounters must be a positive distance, or {n} radii, one of each body, at least 0 and not all 0; "
            f"got {shown(given)}."
        )
    return np.full(n, found / 2) if found.ndim == 0 else found


def encounters(
    radii: np.ndarray, events: Iterable[Any], times: Iterable[Any], states: Iterable[Any], fun: Callable[..., Any]
) -> np.ndarray | None:
    """Return the encounters (m, 5) of a run, from the times (k,) and states (k, 6 N) of its events.

    Columns are the time, i, j, the distance and the relative speed. The result is None if no pair was watched. ``fun(t,
    y)`` is the right-hand side, which tells closest approaches from largest distances.
    """
    rows, watched = [], False
    for event, t, y in zip(events, times, states, strict=True):
        if not (isinstance(event, Approach) and event.axis == IN_SPACE):
            continue
        watched = True
        for at, state in zip(t, y, strict=True):
            x, v = event.relative(state)
            distance = float(np.linalg.norm(x))
            if distance < radii[event.i] + radii[event.j] and v @ v + x @ event.relative(fun(at, state))[1] > 0:
                rows.append((float(at), event.i, event.j, distance, float(np.linalg.norm(v))))
    if not watched:
        return None
    table = np.array(rows).reshape(-1, 5)
    return table[np.argsort(table[:, 0], kind="stable")]


class Transits(NamedTuple):
    """Transits of a run, in the order of their times.

    Attributes
    ----------
    times : ndarray, shape (m,)
        Mid-transit times.
    planet : ndarray of int, shape (m,)
        Indices of the bodies.
    derivatives : ndarray, shape (m, c), or None
        Derivatives of the times along the c columns of derivatives of the run, in the order of `run.variations`: with
        respect to the components of the initial state for ``variations="state"``, then to parameters.

    See Also
    --------
    transits, nbody
    """

    times: np.ndarray
    planet: np.ndarray
    derivatives: np.ndarray | None


def transits(run: Any, star: int | str = 0, axis: Sequence[float] = (0, 0, 1)) -> Transits:
    """Return the mid-transit times of all planets of a run, as seen along an axis, and their derivatives.

    Parameters
    ----------
    run : IntegrationResult
        Run of a problem that was made by `nbody`. It is repeated with events for the transits, so that the times do not
        depend on which states it has saved. With ``variations=`` it has the derivatives too.
    star : int or str, optional
        Index or name of the star.
    axis : sequence of 3 floats, optional
        Vector from the star to the observer, of any length.

    Returns
    -------
    Transits
        A transit is a smallest distance of planet and star in the plane of the sky, x vx + y vy = 0 in the coordinates
        across the axis, with the planet in front. Whether the planet is then in front of the disc of the star depends
        on its radius, and is not considered.

    Raises
    ------
    TypeError, ValueError
        If `run` is not a run of bodies, or was continued from another one; if `star` or `axis` is wrong.

    See Also
    --------
    nbody, Transits

    Examples
    --------
    >>> import numpy as np
    >>> from eip_scipy import EIPDOP853, integrate
    >>> from eip_scipy.problems import nbody, transits
    >>> star, planet = np.zeros(3), np.array([0, 0, 1.0])
    >>> problem = nbody([1, 0], [star, planet], [star, [1.0, 0, 0]], t_span=(0, 10))
    >>> found = transits(integrate(problem, method=EIPDOP853, rtol=1e-11, atol=1e-11, variations="state"))
    >>> found.times / (2 * np.pi), found.planet, found.derivatives.shape
    (array([1.]), array([1]), (1, 12))
    """
    if isinstance(run, Problem):
        raise TypeError("transits: expected a result of integrate, got a problem; call integrate(problem, ...) first.")
    if isinstance(run, OptimizeResult) and "_origin" not in vars(run):
        raise TypeError("transits: a result that was loaded has no functions; take the transits before saving it.")
    names, origin = bodies_of(run).names, vars(run)["_origin"]
    if star not in (*names, *range(len(names))):
        raise ValueError(f"transits: star must be an index below {len(names)} or one of {names}, got {shown(star)}.")
    index = names.index(star) if isinstance(star, str) else int(star)
    view = real_array("axis", axis)
    if view.shape != (3,) or not np.isfinite(view).all() or not view.any():
        raise ValueError(f"transits: axis must be three finite numbers, not all 0; got {shown(axis)}.")
    view = view / np.linalg.norm(view)
    planets = [j for j in range(len(names)) if j != index]
    events = tuple(Approach(index, j, tuple(view.tolist()), origin.sign) for j in planets)
    again = run._repeated(events)
    found: list[tuple[Any, ...]] = []
    for k, (event, t, y) in enumerate(zip(events, again.t_events, again.y_events, strict=True)):
        if t.size:
            front = event.relative(y)[0] @ view > 0
            slopes = again.time_derivatives[k][front] if "variations" in run else np.zeros((front.sum(), 0))
            found.append((t[front], np.full(front.sum(), event.j), slopes))
    count = run.variations.shape[2] if "variations" in run else 0
    found.append((np.zeros(0), np.zeros(0, int), np.zeros((0, count))))
    times, planet, slopes = map(np.concatenate, zip(*found, strict=True))
    order = np.argsort(times, kind="stable")
    return Transits(times[order], planet[order], slopes[order] if "variations" in run else None)
