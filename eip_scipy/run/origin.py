"""Origin of a result, from which its run can be continued, and the part of it that a file holds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ..checkpoint import decoded, encoded
from ..core import solvers
from ..core.derivatives import unless_error
from ..core.tangent_vectors import TangentVectors
from .prepare import DEFAULT

__all__ = ["Origin", "restored", "stored"]

# Arguments that a file does not hold: those that describe the state, and functions that are given again or not needed.
NOT_STORED = ("fun", "acceleration", "t_span", "y0", "invariants", "diagnostics", "callback", "jvp", "jac", "jacobian")


class Origin(NamedTuple):
    """Origin of a result, from which its run can be continued."""

    arguments: dict[str, Any]  # the keyword arguments of `integrate`
    t: float  # time of the last state
    y: np.ndarray  # (n,): last state of the run, saved or not
    sign: float  # direction of time, 1 or -1
    names: tuple[str, ...]  # of the invariants (l,)
    terms: np.ndarray  # (l,): sizes of the terms of the invariants; infinite for balances
    before: np.ndarray | None  # (l,): values of the invariants in the last state; None if it was not saved
    event: int | None  # index of the event that ended the run
    kept: Callable[[], Any]  # returns the invariants of the run, with the kept values as their targets
    values: Callable[[], np.ndarray]  # returns the invariants (l,) in the last state, as their functions are now
    derivative: Callable[[], np.ndarray]  # returns the derivative (n,) there
    ended: str  # reason for the end of the run
    notes: tuple[str, ...]  # remarks at the end of its message
    loaded: dict[str, Any] | None = None  # values by which the functions of a loaded run are recognised


def stored(origin: Origin, arrays: dict[str, np.ndarray]) -> Any:
    """Return everything of an origin except functions in the form of `encoded`; None if its functions raise errors."""
    known = origin.loaded or unless_error(_known, origin)
    if known is None:
        return None
    missing, arguments = list(known["missing"]), dict[str, Any]()
    for name, value in origin.arguments.items():
        is_unset = value is None or value is DEFAULT or (isinstance(value, float) and not np.isfinite(value))
        if is_unset or name in NOT_STORED or (name == "events" and not value):
            continue
        if name == "method":
            known_name = getattr(value, "__name__", "")
            value = known_name if getattr(solvers, known_name, None) is value else value
        elif name == "variations":
            value = {key: getattr(value, key) for key in TangentVectors.__dataclass_fields__}
        try:
            encoded(name, value, {})
        except TypeError:
            missing.append(name)
        else:
            arguments[name] = value
    own = {name: getattr(origin, name) for name in ("t", "y", "sign", "names", "terms", "event", "ended", "notes")}
    return encoded("origin", own | {"arguments": arguments, "known": known | {"missing": missing}}, arrays)


def _known(origin: Origin) -> dict[str, Any]:
    """Return the values by which the functions of a run are recognised at its end, and targets (l,), NaN for none."""
    values, parts = origin.values(), [np.zeros(0)]
    for item in origin.kept():
        size = np.size(item.target) if item.target is not None else 1
        parts.append(np.full(size, np.nan) if item.target is None else np.ravel(item.target))
    return {"f": origin.derivative(), "values": values, "targets": np.concatenate(parts), "missing": []}


def restored(content: Any, arrays: dict[str, np.ndarray]) -> Origin | None:
    """Return an origin without functions from the output of `stored`."""
    if content is None:
        return None
    own = decoded(content, arrays)
    arguments, known = own.pop("arguments"), own.pop("known")
    arguments = (
        dict.fromkeys(NOT_STORED) | {"params": None, "args": None, "events": None, "variations": None} | arguments
    )
    arguments["method"] = getattr(solvers, arguments["method"]) if "method" in arguments else None
    if arguments["variations"] is not None:
        arguments["variations"] = TangentVectors(**arguments["variations"])

    def nothing() -> Any:
        raise ValueError("the functions of a loaded run are not known")

    return Origin(
        **own, arguments=arguments, before=None, kept=nothing, values=nothing, derivative=nothing, loaded=known
    )
