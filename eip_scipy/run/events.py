"""Events of `integrate`, with the meaning that `scipy.integrate.solve_ivp` gives them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from scipy.integrate import DenseOutput

from ..core.arguments import names
from ..core.inputs import is_number, reals, require_arguments, shown
from ..core.pointers import by_pointer, is_pointer
from ..engine.native import Call, call

__all__ = ["ContinuedEvents", "Events", "as_events", "replaced"]


def replaced(events: tuple[Callable[..., Any], ...], others: Iterable[Callable[..., Any]]) -> tuple[Any, ...]:
    """Return `others`, one function for each of `events`, as a tuple that replaces `events`.

    If `events` is a `ContinuedEvents`, the result is one too, with the same times in `happened`.
    """
    return ContinuedEvents(others, events.happened) if isinstance(events, ContinuedEvents) else tuple(others)


class ContinuedEvents(tuple):
    """Events of a continued run, and the times at which each has happened before."""

    happened: tuple[np.ndarray, ...]

    def __new__(cls, events: Any, happened: Any) -> ContinuedEvents:
        """Make the tuple from the events and, for each event, the times at which it has happened."""
        found = super().__new__(cls, events)
        found.happened = tuple(happened)
        return found


class Events:
    """The events of a run, and the times and states at which they happened.

    `events` are those of `integrate`, and `extra` their further arguments: ``(params,)``, ``args``, or nothing.
    """

    def __init__(self, events: Any, extra: tuple = ()) -> None:
        items = as_events(events)
        self.functions: list[Callable[..., Any]] = list(items)
        self._extra = extra
        self.directions = np.array([_direction(getattr(item, "direction", 0)) for item in items])
        self._allowed = [_allowed(getattr(item, "terminal", None)) for item in items]
        self._happened = items.happened if isinstance(items, ContinuedEvents) else (np.zeros(0),) * len(items)
        self._before = [len(times) for times in self._happened]
        self._counts = list(self._before)
        self.t: list[list[float]] = [[] for _ in items]
        self.y: list[list[np.ndarray]] = [[] for _ in items]
        self.last: tuple[float, np.ndarray] = math.nan, np.zeros(0)

    @property
    def terminal(self) -> bool:
        """True if an event can end the run."""
        return any(math.isfinite(allowed) for allowed in self._allowed)

    @property
    def calls(self) -> tuple[Call, ...]:
        """Return the events in the form that the engine calls."""

        def one(k: int, event: Any) -> Call:
            return call(event, self._extra, (), lambda value, t: np.array(self._number(k, t, value)), real=True)

        return tuple(one(k, event) for k, event in enumerate(self.functions))

    @property
    def ends(self) -> list[tuple[float, float]]:
        """Return the direction of each event and the number of times after which it ends the run."""
        return list(zip(self.directions.tolist(), self._allowed, strict=True))

    def restore(self, k: int, t: np.ndarray, y: np.ndarray) -> None:
        """Record that event `k` has happened in this run at the times `t` (m,) in the states `y` (m, n)."""
        self.t[k], self.y[k], self._counts[k] = t.tolist(), list(y), self._before[k] + t.size

    @property
    def left(self) -> list[float]:
        """Return for each event after how many further times it ends the run; infinity if it never does."""
        return [allowed - count for allowed, count in zip(self._allowed, self._counts, strict=True)]

    def take(self, which: np.ndarray, times: np.ndarray, states: np.ndarray) -> None:
        """Record events that the loop has found, by their indices, times and states, in the order of their times."""
        for k, t, y in zip(which.tolist(), times.tolist(), states, strict=True):
            self._note(k, t, y.copy())

    def _note(self, k: int, t: float, y: np.ndarray) -> None:
        self._counts[k] += 1
        self.t[k].append(t)
        self.y[k].append(y)
        self.last = t, y

    def values(self, t: float, y: np.ndarray) -> np.ndarray:
        """Return the values of all events at (t, y)."""
        return np.array([self._value(k, t, y.copy()) for k in range(len(self.functions))], float)

    def sizes(self, t: float, y: np.ndarray, f: np.ndarray, step: float) -> np.ndarray:
        """Return the sizes of the events' values at (t, y), relative to which rounding errors are small.

        A size is the absolute value plus its change in a step along the derivative `f`, because the value of an event
        that happens near (t, y) may be smaller than the terms that cancel in it.
        """
        here = self.values(t, y)
        try:
            change = np.abs(self.values(t + step, y + step * f) - here)
        except Exception:  # an event need not be defined in that state
            change = np.zeros_like(here)
        return np.abs(here) + np.where(np.isfinite(change), change, 0.0)

    def leave(self, t: float, y: np.ndarray, f: np.ndarray, step: float, values: np.ndarray) -> None:
        """Replace the value of each event that happened at the start (t, y) of a continued run by a slightly later one.

        The value of such an event at the start is a rounding error, whose sign could make the event happen again.
        `values` holds the values of all events. The later state is y plus a small part of `step` times the derivative
        `f`.
        """
        part = step / 4096
        for k, times in enumerate(self._happened):
            if len(times) and times[-1] == t:
                values[k] = self._value(k, t + part, y + part * f)

    def handle(self, which: np.ndarray, times: np.ndarray, sol: DenseOutput) -> float | None:
        """Record the events with indices `which` that happen at `times`, in this order, until one ends the run.

        The states are those of the interpolation `sol` of the step. Return the time at which the run ends, or None.
        ValueError is raised if an event changes its sign without a root, because it is NaN in between.
        """
        for k, t in zip(which.tolist(), times.tolist(), strict=True):
            if math.isnan(t):
                raise ValueError(
                    f"event {k} changes its sign between t={sol.t_old:.10g} and t={sol.t:.10g}, but is NaN in between, "
                    "so that its time cannot be found. The event must return a finite number for every state."
                )
            self._note(k, t, sol(t))
            if self._counts[k] >= self._allowed[k]:
                return t
        return None

    def _value(self, k: int, t: float, y: np.ndarray) -> float:
        """Return the value of event k at (t, y); the event may store or overwrite y."""
        try:
            value = self.functions[k](t, y, *self._extra)
        except TypeError:
            given = "t", "y", *names(self._extra)
            advice = f"Further arguments of the call or its Problem come last: def event({', '.join(given)})."
            require_arguments(self.functions[k], given, f"event {k}", advice)
            raise
        return self._number(k, t, value)

    def _number(self, k: int, t: float, value: Any) -> float:
        if isinstance(value, float):
            return value
        found = reals(f"event {k} returned", value)
        if found is None or found.ndim:
            raise TypeError(f"event {k} returned {shown(value)} at t={t:.10g}, expected a real number.")
        return float(found)


def as_events(events: Any) -> tuple[Callable[..., Any], ...]:
    """Return one event or a sequence of events as a tuple, after checks; C functions are wrapped for Python."""
    if events is None:
        return ()
    if callable(events) or is_pointer(events):  # which is a tuple
        events = (events,)
    try:
        given = tuple(events)
    except TypeError:
        raise TypeError(f"events must be callable, or a sequence of callables, got {shown(events)}.") from None
    items = []
    for k, event in enumerate(given):
        found = by_pointer(event, f"event {k}", shape=())
        if found is not event:
            for name, default in ("terminal", None), ("direction", 0):  # a function of ctypes may have them too
                setattr(found, name, getattr(event, name, getattr(event.function, name, default)))
        if not callable(found):
            raise TypeError(f"events must be callable, got {shown(found)}.")
        items.append(found)
    return replaced(events, items)


def _direction(direction: Any) -> float:
    """Return the `direction` of an event after a check: the sign that its change must have, 0 for both signs."""
    if not (is_number(direction) or isinstance(direction, (bool, np.bool_))) or math.isnan(direction):
        raise ValueError(
            f"The `direction` attribute of each event must be a number: positive, negative or 0, got "
            f"{shown(direction)}."
        )
    return float(direction)


def _allowed(terminal: Any) -> float:
    """Return the number of times after which an event ends the run, from its `terminal`; infinity if it never does."""
    if terminal is None:
        return math.inf
    known = isinstance(terminal, (bool, np.bool_)) or (is_number(terminal) and float(terminal).is_integer())
    if not known or terminal < 0:
        raise ValueError(
            f"The `terminal` attribute of each event must be a boolean or positive integer, got {shown(terminal)}."
        )
    return float(terminal) if terminal else math.inf
