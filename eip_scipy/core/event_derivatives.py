"""Derivatives of the times of events, and of the states there, from the tangent vectors that a run carries."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .derivatives import NumericalGradient, time_of_motion, typical_sizes
from .functions import PointerFunction

if TYPE_CHECKING:
    from .bound_problem import BoundProblem

__all__ = ["EVENT_DERIVATIVES", "event_derivatives"]

Array = np.ndarray
EVENT_DERIVATIVES = ("tangent_events", "time_derivatives", "state_derivatives")
# An event is grazed if its rate is at most this share of its terms: of the rate, or of the event in the time in which
# the state changes by its own size. The rate is about 1e-8 of them where rounding decides whether the event happens.
GRAZED = 1e-6


class EventGradient:
    """Derivatives of an event along its state, its parameters in the augmented state, and time, as one gradient.

    Complex steps compute it, or else differences. A jitted event is evaluated by its Python function, because
    compiling derivatives takes seconds, and an event happens rarely.
    """

    def __init__(self, problem: BoundProblem, event: Callable[..., Any], t: float, row: Array) -> None:
        tangents, extra = problem.tangents, problem.extra
        self._problem, self._places, n = problem, tangents.order[0], tangents.n
        fun = event.unaugmented.function  # type: ignore[attr-defined]
        fun = getattr(getattr(fun, "jitted", fun), "py_func", fun)
        self._gradient: Callable[[float, Array], Array]
        if hasattr(fun, "by_state"):  # an event of a problem, with its gradient
            self._gradient = lambda _, z: np.append(fun.by_state(z[-1], z[:n]), np.zeros(z.size - n))
            return

        def value(_: float, z: Array) -> Any:
            given = extra
            if tangents.parameters:
                given = (extra[0].astype(z.dtype),)
                given[0][list(tangents.parameters)] = z[n:-1]
            return fun(z[-1], z[:n].copy(), *given)  # the event may overwrite its state

        z, takes_complex = self._variables(t, row), not isinstance(fun, PointerFunction)
        floors = typical_sizes(z, np.zeros(z.size), 0.0)
        self._gradient = NumericalGradient(value, (), takes_complex, 0.0, z, floors, ())

    def _variables(self, t: float, row: Array) -> Array:
        return np.append(row[self._places], t)

    def shifts(self, t: float, row: Array, vectors: Array) -> tuple[Array, Array] | None:
        """Return the derivatives (c,) of the time along `vectors` (c, n + p), and f (n,); None if it is grazed.

        `row` is the augmented state at the time t.
        """
        z, f = self._variables(t, row), self._problem.tangents.state(self._problem.derivative(t, row))
        gradient = self._gradient(0.0, z)
        terms = gradient * np.append(np.append(f, np.zeros(z.size - 1 - f.size)), 1.0)
        size = float(np.abs(gradient * z).sum()) / time_of_motion(z[: f.size], f)
        rate, largest = float(terms.sum()), max(float(np.abs(terms).sum()), size)
        if not np.isfinite(rate):
            raise ValueError("the gradient of the event is not finite")
        return (-(vectors @ gradient[:-1]) / rate, f) if abs(rate) > GRAZED * largest else None


def event_derivatives(
    problem: BoundProblem, t0: float, t_events: Sequence[Any], rows: Sequence[Any]
) -> tuple[dict[str, list[Array]], list[str]]:
    """Return the fields in `EVENT_DERIVATIVES`, and remarks on those that are NaN; nothing without tangent vectors.

    `t_events` and `rows` are the times (m,) and the augmented states (m, size) of each event of a run that starts at
    `t0`. An event that a state at the start is beyond has the time t0 for all neighbouring states.
    """
    found: dict[str, list[Array]] = {name: [] for name in EVENT_DERIVATIVES}
    remarks: list[str] = []
    if problem.variations is None or not problem.events.functions:
        return {}, remarks
    tangents = problem.tangents
    for k, (event, times, states) in enumerate(zip(problem.events.functions, t_events, rows, strict=True)):
        vectors = np.array(states).reshape(-1, tangents.order.size)[:, tangents.order[1:]]
        in_time = np.full(vectors.shape[:2], np.nan)
        of_state = np.full((len(vectors), tangents.n, tangents.count), np.nan)
        gradient: Any = None
        for j, (t, row) in enumerate(zip(times, states, strict=True)):
            if t == t0:
                in_time[j], of_state[j] = 0.0, vectors[j, :, : tangents.n].T
                continue
            try:
                gradient = gradient or EventGradient(problem, event, t, row)
                shifts = gradient.shifts(t, row, vectors[j])
                why = "the state only grazes it"
            except Exception as error:  # of a function of the user's, in states next to the event; the run is kept
                shifts, why = None, f"{type(error).__name__} was raised: {error}"
            if shifts is None:
                remarks.append(f"event {k} has no derivatives at t={t:.10g}, because {why}")
                continue
            in_time[j], f = shifts
            of_state[j] = vectors[j, :, : tangents.n].T + np.outer(f, in_time[j])
        fields = vectors[..., : tangents.n].swapaxes(1, 2), in_time, of_state
        for name, value in zip(EVENT_DERIVATIVES, fields, strict=True):
            found[name].append(value)
    return found, remarks
