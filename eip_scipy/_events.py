"""Events of `integrate`, with the meaning that `scipy.integrate.solve_ivp` gives them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.integrate import DenseOutput
from scipy.optimize import brentq

from ._kernels import EPS

__all__ = ["Events"]


class Events:
    """The events of a run and the places where they happened.

    Parameters
    ----------
    events : callable or sequence of callable or None
        ``event(t, y[, params]) -> float``, with the attributes ``terminal`` (bool, or the number of times after which
        the run ends) and ``direction`` of SciPy's `solve_ivp`.
    extra : tuple
        ``(params,)`` or nothing.

    Raises
    ------
    TypeError
        When an event is not callable.
    ValueError
        When ``terminal`` is no number of times.
    """

    def __init__(self, events: Any, extra: tuple = ()) -> None:
        items: Sequence[Any] = () if events is None else (events,) if callable(events) else tuple(events)
        for item in items:
            if not callable(item):
                raise TypeError(f"events must be callable, got {item!r}.")
        self.functions: list[Callable[..., Any]] = list(items)
        self._extra = extra
        self.directions = np.array([float(getattr(item, "direction", 0)) for item in items])
        self._allowed = [_allowed(getattr(item, "terminal", None)) for item in items]
        self._counts = [0] * len(items)
        self.t: list[list[float]] = [[] for _ in items]
        self.y: list[list[np.ndarray]] = [[] for _ in items]
        self.last: tuple[float, np.ndarray] | None = None

    @property
    def terminal(self) -> bool:
        """Whether an event can end the run."""
        return any(math.isfinite(allowed) for allowed in self._allowed)

    @property
    def ends(self) -> list[tuple[float, float]]:
        """Of each event the direction and the number of times after which it ends the run."""
        return list(zip(self.directions.tolist(), self._allowed, strict=True))

    def restore(self, k: int, t: np.ndarray, y: np.ndarray) -> None:
        """Let event `k` have happened at the times `t` (m,) in the states `y` (m, n)."""
        self.t[k], self.y[k], self._counts[k] = t.tolist(), list(y), t.size

    def fill(self, t: float, y: np.ndarray, values: np.ndarray, params: Any = None) -> None:
        """Values of all events."""
        y = y.copy()
        for k, function in enumerate(self.functions):
            values[k] = function(t, y, *self._extra)

    def handle(self, old: np.ndarray, new: np.ndarray, sol: DenseOutput) -> float | None:
        """Locate the events between the ends of a step; returns the time at which the run ends, if it does."""
        up, down = (old <= 0) & (new >= 0), (old >= 0) & (new <= 0)
        rising, falling = up & (self.directions >= 0), down & (self.directions <= 0)
        active = np.flatnonzero(rising | falling)
        roots = [(self._root(int(k), sol), int(k)) for k in active]
        roots.sort(reverse=bool(sol.t < sol.t_old))
        for root, k in roots:
            self._counts[k] += 1
            self.t[k].append(root)
            self.y[k].append(sol(root))
            self.last = root, self.y[k][-1]
            if self._counts[k] >= self._allowed[k]:
                return root
        return None

    def _root(self, k: int, sol: DenseOutput) -> float:
        function = self.functions[k]
        return float(brentq(lambda t: function(t, sol(t), *self._extra), sol.t_old, sol.t, xtol=4 * EPS, rtol=4 * EPS))


def _allowed(terminal: Any) -> float:
    """How many times an event may happen before it ends the run."""
    if terminal is None or terminal is False or terminal == 0:
        return math.inf
    if not isinstance(terminal, (bool, np.bool_, int, np.integer)) or terminal < 0:
        raise ValueError(
            f"The `terminal` attribute of each event must be a boolean or positive integer, got {terminal!r}."
        )
    return float(int(terminal))
