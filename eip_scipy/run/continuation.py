"""Continuation of a run from its end, and the combination of two runs."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.integrate import OdeSolution

from ..core.events import ContinuedEvents, as_events
from ..core.inputs import is_number, shown
from ..core.results import Diagnostics, Multipliers, joined_sums
from ..core.tangent_vectors import StateSolution
from .integrate import integrate
from .prepare import Request
from .results import IntegrationResult, Origin

__all__ = ["continued"]

# Arguments that follow from the end of the run, or apply to the first run only.
OWN = {"t_span", "y0", "t_eval", "diagnostics", "projection"}
FIXED = ("fun", "acceleration", "t_span", "y0", "invariants")


def continued(result: IntegrationResult, t: float, options: dict[str, Any]) -> IntegrationResult:
    """Continue a run to the time t, see `IntegrationResult.continue_to`."""
    origin: Origin | None = vars(result).get("_origin")
    if origin is None:
        raise ValueError(
            "continue_to: this result does not know its functions, because it was loaded, unpickled or copied. "
            "Continue from its last state: integrate(fun, (result.t[-1], t), result.y[:, -1], ...)."
        )
    for name in FIXED:
        if name in options:
            raise TypeError(f"continue_to: {name} cannot be changed; start a new run with integrate.")
    if not is_number(t, "t") or not origin.sign * (t - origin.t) > 0:
        raise ValueError(f"continue_to: t must lie beyond the end of the run, {origin.t:.10g}, got {shown(t)}.")
    request = origin.request
    asked = {name: getattr(request, name) for name in Request._fields if name not in OWN}
    asked |= {**request.projection, "invariants": origin.kept()}
    if result.t_events is not None:
        asked["events"] = ContinuedEvents(as_events(asked["events"]), result.t_events)
    if options.get("t_eval") is not None:
        asked["save_every"] = None
    if "params" in options:
        result._observe()  # outputs and multipliers are computed with the parameters of the first run
    try:
        more = integrate(**(asked | {"t_span": (origin.t, t), "y0": origin.y} | options))
    except BaseException as error:
        partial = getattr(error, "partial", None)
        if isinstance(partial, IntegrationResult):
            started = len(partial.invariants) == len(result.invariants)
            error.partial = _joined(result, partial) if started else result  # type: ignore[attr-defined]
        raise
    return _joined(result, more)


def _joined(one: IntegrationResult, two: IntegrationResult) -> IntegrationResult:
    """Return one result for a run and its continuation; the state where they meet is stored once."""
    new = slice(1 if one.t.size and two.t.size and two.t[0] == one.t[-1] else 0, None)
    both = IntegrationResult(two)
    for name in ("t", "y", "invariants"):
        both[name] = np.concatenate([one[name], two[name][..., new]], axis=-1)
    if "variations" in one and "variations" in two:
        both["variations"] = np.concatenate([one["variations"], two["variations"][new]])
    for name in ("nfev", "njev", "nlu", "wall_time"):
        both[name] = one[name] + two[name]
    if one.t_events is not None and _events(one) == _events(two):
        for name in ("t_events", "y_events"):
            both[name] = [
                np.concatenate([a, b]) if a.size and b.size else b if b.size else a
                for a, b in zip(one[name], two[name], strict=True)
            ]
    if "outputs" in one or "multipliers" in one:
        both.update(_observed(one, two, new))
    both["diagnostics"] = _diagnostics(one.diagnostics, two.diagnostics)
    both["max_residual"] = both.diagnostics.max_residual
    both["trusted"] = both.diagnostics.trusted
    both["sol"] = _solution(one.sol, two.sol)
    if "_origin" in vars(two):
        object.__setattr__(both, "_origin", vars(two)["_origin"])
    return both


def _events(result: IntegrationResult) -> list[Any]:
    """Return the event functions of a run, of C functions the pointers; an empty list if the run did not start."""
    origin: Origin | None = vars(result).get("_origin")
    return [] if origin is None else [getattr(event, "pointer", event) for event in as_events(origin.request.events)]


def _observed(one: IntegrationResult, two: IntegrationResult, new: slice) -> dict[str, Any]:
    """Return outputs and multipliers of two joined runs as fields; `new` selects times that the first does not have."""
    two._observe()
    found: dict[str, Any] = {}
    if "outputs" in one:
        found["outputs"] = {name: np.append(row, two.outputs[name][new]) for name, row in one.outputs.items()}
    if "multipliers" in one:
        (names, before, ranks), (_, after, more) = one.multipliers, two.multipliers
        found["multipliers"] = Multipliers(names, np.hstack([before, after[:, new]]), np.append(ranks, more[new]))
    return found


def _diagnostics(one: Diagnostics, two: Diagnostics) -> Diagnostics:
    both = Diagnostics()
    both._attach(
        np.maximum(one.max_residual, two.max_residual),
        two._residual.copy(),
        np.maximum(one._max_correction, two._max_correction),
        one._counters + two._counters,
        one._trust.followed_by(two._trust),
        estimated=one._estimated and two._estimated,
        moved=one.moved or two.moved,
        remarks=two.remarks,
        slow=(two._slow[0], joined_sums(one._slow[1], two._slow[1])),
    )
    return both


def _solution(one: OdeSolution | None, two: OdeSolution | None) -> OdeSolution | None:
    if one is None or two is None:
        return None
    both = OdeSolution(np.append(one.ts, two.ts[1:]), [*one.interpolants, *two.interpolants])
    return StateSolution(both, two.tangents) if isinstance(two, StateSolution) else both
