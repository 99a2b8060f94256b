"""Events, with the meaning that `scipy.integrate.solve_ivp` gives them, except at the start of a run."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from scipy.integrate import DenseOutput

from ..engine.data import EPS
from ..engine.native import Call, call
from .functions import by_pointer, is_pointer, names
from .inputs import is_number, reals, require_arguments, shown

__all__ = ["ContinuedEvents", "Events", "JittedEvent", "Start", "as_events", "replaced"]

# A value at the start is zero if it is at most this number of roundings of its terms and of the time, or if its zero is
# within this share of the first step: the time of an event is a zero of an interpolant, and not known any better.
ROUNDINGS, SHARE = 64.0, 1e-10
PART = 2.0**-20  # of a step and of the components, for differences

# Returns the derivative at the start (t, y) of a run and the first step.
Start = Callable[[float, np.ndarray], tuple[np.ndarray, float]]


def replaced(events: tuple[Callable[..., Any], ...], others: Iterable[Callable[..., Any]]) -> tuple[Any, ...]:
    """Return `others`, one function for each of `events`, as a tuple that replaces `events`.

    If `events` is a `ContinuedEvents`, the result is one too, with the same times in `happened`.
    """
    if isinstance(events, ContinuedEvents):
        return ContinuedEvents(others, events.happened)
    return tuple(others)


class ContinuedEvents(tuple):
    """Events of a continued run, and the times at which each has happened before."""

    happened: tuple[np.ndarray, ...]

    def __new__(cls, events: Any, happened: Any) -> ContinuedEvents:
        """Make the tuple from the events and, for each event, the times at which it has happened."""
        found = super().__new__(cls, events)
        found.happened = tuple(happened)
        return found


class JittedEvent:
    """A jitted event with its attributes, which Numba functions lose where they are sent to another process."""

    def __init__(self, jitted: Any) -> None:
        self.jitted, self.__name__ = jitted, jitted.__name__
        self.terminal, self.direction = getattr(jitted, "terminal", None), getattr(jitted, "direction", 0)

    def __call__(self, *given: Any) -> Any:
        """Return the value of the event."""
        return self.jitted(*given)


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
        self._happened = items.happened if isinstance(items, ContinuedEvents) else (None,) * len(items)
        self.t: list[list[float]] = [[] for _ in items]
        self.y: list[list[np.ndarray]] = [[] for _ in items]
        self.last: tuple[float, np.ndarray] = math.nan, np.zeros(0)
        self.last_index = -1

    @property
    def terminal(self) -> bool:
        """True if an event can end the run."""
        return any(map(math.isfinite, self._allowed))

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

    @property
    def left(self) -> list[float]:
        """Return for each event after how many further times it ends the run; infinity if it never does."""
        counts = zip(self._allowed, self._happened, self.t, strict=True)
        return [allowed - len(() if before is None else before) - len(times) for allowed, before, times in counts]

    def restore(self, k: int, t: np.ndarray, y: np.ndarray) -> None:
        """Record that event `k` has happened in this run at the times `t` (m,) in the states `y` (m, n)."""
        self.t[k], self.y[k] = t.tolist(), list(y)

    def take(self, which: np.ndarray, times: np.ndarray, states: np.ndarray) -> None:
        """Record events that the loop has found, by their indices, times and states, in the order of their times."""
        for k, t, y in zip(which.tolist(), times.tolist(), states, strict=True):
            self._note(k, t, y.copy())

    def _note(self, k: int, t: float, y: np.ndarray) -> None:
        self.t[k].append(t)
        self.y[k].append(y)
        self.last, self.last_index = (t, y), k

    def at_start(self, t: float, y: np.ndarray, f: np.ndarray, step: float) -> np.ndarray:
        """Return the values of all events at the start (t, y) of a run; 0 for those that do not happen there.

        `f` is the derivative, and `step` the first step. In a run that continues another one, the events that have
        happened at `t` do not happen again.
        """
        values = [self._value(k, t, y.copy()) for k in range(len(self.functions))]
        for k, (value, known) in enumerate(zip(values, self._happened, strict=True)):
            if self._is_zero(k, value, t, y, f, step) if known is None else t in known[-1:]:
                values[k] = 0.0
        return np.array(values, float)

    def _is_zero(self, k: int, value: float, t: float, y: np.ndarray, f: np.ndarray, step: float) -> bool:
        """Return True if the `value` of event k at the start is zero to rounding, so that its sign means nothing.

        The rounding is that of its terms, found by small changes of all components, and that of the time, at which the
        event may have ended another run.
        """
        try:
            moved = abs(self._value(k, t + PART * step, y + PART * step * f) - value) / PART
            terms = abs(self._value(k, t, y * (1.0 + PART * np.cos(np.arange(y.size)))) - value) / PART
            rounding = ROUNDINGS * EPS * (terms + moved * abs(t / step)) + SHARE * moved
        except Exception:  # an event need not be defined in these states, and the step may be 0
            rounding = 0.0
        return value == 0.0 or abs(value) <= rounding

    def for_scipy(self, start: Start | None, *, as_scipy: bool) -> list[Callable[..., float]]:
        """Return the events for `scipy.integrate.solve_ivp`, with checked values, and with a start as in `integrate`.

        ``start(t, y)`` returns the derivative at the start and the first step. A value that is zero to rounding at the
        start becomes NaN there, because SciPy counts a zero. With `as_scipy` this does not apply to values that are
        exactly 0, and without `start` to any.
        """
        return [self._for_scipy(k, start, as_scipy) for k in range(len(self.functions))]

    def _for_scipy(self, k: int, start: Start | None, as_scipy: bool) -> Callable[..., float]:
        begin: list[Any] = []  # time and value at the start, and whether it is beyond the event, which is a limit
        direction = float(self.directions[k])

        def event(t: float, y: np.ndarray, *_: Any) -> float:
            value = self._value(k, t, y.copy())
            if not begin:
                exact = as_scipy and value == 0.0
                is_zero = start is not None and not exact and self._is_zero(k, value, t, y, *start(t, y))
                begin[:] = t, math.nan if is_zero else value, not is_zero and value * direction == math.inf
            if begin[2]:  # SciPy finds the zero at the start, because the next value is beyond too
                return 0.0 if t == begin[0] else direction
            return begin[1] if t == begin[0] else value

        made: Any = event
        made.terminal, made.direction = getattr(self.functions[k], "terminal", None), direction
        return made

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
            if self.left[k] <= 0:
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
        if found is None or found.ndim or isinstance(value, bool | np.bool_):
            what = f"event {k} returned {shown(value)} at t={t:.10g}"
            raise TypeError(f"{what}, expected a real number that changes its sign, y[0] and not y[0] > 0.")
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
