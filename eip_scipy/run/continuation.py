"""Continuation of a run from its end."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..checkpoint import first_difference
from ..core.events import ContinuedEvents, as_events
from ..core.inputs import is_number, shown
from ..core.names import nearest
from ..core.projection import ProjectionOptions
from ..engine.data import START
from .fields import joined
from .integrate import integrate
from .results import IntegrationResult, Origin, described

__all__ = ["continue_to", "continued"]

# Options of `integrate` that may change where a run continues. Everything else has fixed a value of the first part,
# such as the target of an invariant, or the start that derivatives refer to.
CHANGING = (
    *("method", "h", "rtol", "atol", "first_step", "max_step", "max_steps"),
    *("save_every", "t_eval", "events", "callback", "progress", "compiled", "max_bytes"),
    *("checkpoint", "checkpoint_every", "resume", "check", "project_initial"),
)
DEFINING = ("fun", "acceleration", "t_span", "y0", "invariants")
FIRST_PART = ("t_eval", "diagnostics")  # arguments that apply to the first part only


def continue_to(result: IntegrationResult, t: float, options: dict[str, Any]) -> IntegrationResult:
    """Continue a run to the time t, see `IntegrationResult.continue_to`."""
    for name in options.keys() - set(CHANGING):
        if name not in {*_origin(result).arguments, *ProjectionOptions.names()}:
            raise TypeError(f"continue_to() has no option {name!r}{nearest(name, CHANGING)}")
        error = TypeError if name in DEFINING else ValueError
        raise error(
            f"continue_to: {name} cannot be changed in a run that continues; start a new run with integrate from its "
            f"last state. These options may change: {', '.join(CHANGING)}."
        )
    return continued(result, t, options)


def continued(result: IntegrationResult, t: float, options: dict[str, Any]) -> IntegrationResult:
    """Return a run and its continuation to the time t, with the `options` of `integrate` that change."""
    origin = _origin(result)
    if not is_number(t, "t") or not origin.sign * (t - origin.t) > 0:
        raise ValueError(f"continue_to: t must lie beyond the end of the run, {origin.t:.10g}, got {shown(t)}.")
    _require_same_functions(result, origin)
    asked = {name: value for name, value in origin.arguments.items() if name not in FIRST_PART}
    asked |= {"invariants": origin.kept(), "t_span": (origin.t, t), "y0": origin.y}
    if result.t_events is not None:
        asked["events"] = ContinuedEvents(as_events(asked["events"]), result.t_events)
    if options.get("t_eval") is not None:
        asked["save_every"] = None
    asked |= options
    if "events" in options and options["events"] is None:
        asked["events"] = ()  # None would stand for the events of the problem
    try:
        return _joined(result, integrate(**asked))
    except BaseException as error:
        partial = getattr(error, "partial", None)
        if isinstance(partial, IntegrationResult):  # without an origin if it failed before the first step
            error.partial = _joined(result, partial) if "_origin" in vars(partial) else result  # type: ignore[attr-defined]
        raise


def _origin(result: IntegrationResult) -> Origin:
    origin: Origin | None = vars(result).get("_origin")
    if origin is None:
        raise ValueError(
            "continue_to: this result does not know its functions, because it was loaded, unpickled or copied. "
            "Continue from its last state: integrate(fun, (result.t[-1], t), result.y[:, -1], ...)."
        )
    return origin


def _require_same_functions(result: IntegrationResult, origin: Origin) -> None:
    """Raise ValueError if an invariant has another value in the last state now than at the end of the run."""
    if not (result.t.size and result.t[-1] == origin.t and np.array_equal(result.y[:, -1], origin.y)):
        return  # the last state was not saved
    before, now = result.invariants[:, -1], origin.values()
    terms = np.maximum(np.abs(before), result.diagnostics._trust.figures[:, START])
    k = first_difference(before, now, np.where(np.isnan(result.target), np.inf, terms))  # balances have no target
    if k is not None:
        raise ValueError(
            f"continue_to: the invariant {result.diagnostics.names[k]!r} was {before[k]:.12g} at t={origin.t:.10g} and "
            f"is {now[k]:.12g} in the same state now: its function, or a value that it uses, has changed since the "
            "first run. Start a new run with integrate from the last state."
        )


def _joined(one: IntegrationResult, two: IntegrationResult) -> IntegrationResult:
    """Return one result for a run and its continuation."""
    first, last = vars(one)["_origin"], vars(two)["_origin"]
    before, after = (
        [getattr(event, "pointer", event) for event in as_events(origin.arguments["events"])]
        for origin in (first, last)
    )
    both = IntegrationResult(two | joined(one, two, but=() if before == after else ("t_events", "y_events")))
    if one.status < 0:
        doubts = both.diagnostics._trust.doubts
        doubts.append(f"the part of the run up to t={first.t:.6g} did not end regularly: {first.ended}")
    last = last._replace(notes=tuple(dict.fromkeys(first.notes + last.notes)))
    both["message"] = described(last.ended, both.diagnostics, last.notes)
    object.__setattr__(both, "_origin", last)
    return both
