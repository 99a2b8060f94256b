"""The fields of a run's result: their dimensions, how those of two parts of a run are joined, and their labels."""

from __future__ import annotations

import operator
from collections.abc import Callable, Container, Iterable, Sequence
from itertools import chain, count
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import OdeSolution

from ..core.problem import component_names as checked
from ..core.results import Diagnostics
from ..core.tangent_vectors import StateSolution

__all__ = [
    "FIELDS", "Field", "component_names", "distinct", "joined", "label", "labels", "rows", "time_name"
]  # fmt: skip


class Field(NamedTuple):
    """The declaration of a field of a result.

    `dims` are its dimensions in tables, () for a number or text that describes the whole run, None if tables leave it
    out. ``join(one, two)`` returns the field of a run and its continuation. Without it fields along t are concatenated,
    or computed when they are first requested, and others are those of the continuation. `table` is the name in tables,
    if it is another one, and `unset` the value for a member of an ensemble that did not run.
    """

    dims: tuple[str, ...] | None = None
    join: Callable[[Any, Any], Any] | None = None
    table: str = ""
    unset: Any = None


def _by_event(one: list[np.ndarray] | None, two: list[np.ndarray] | None) -> list[np.ndarray] | None:
    """Return what was recorded for each event; an array without events may have another shape."""
    if one is None or two is None:
        return two
    return [np.concatenate([a, b]) if a.size and b.size else b if b.size else a for a, b in zip(one, two, strict=True)]


def _solution(one: OdeSolution | None, two: OdeSolution | None) -> OdeSolution | None:
    if one is None or two is None:
        return None
    both = OdeSolution(np.append(one.ts, two.ts[1:]), [*one.interpolants, *two.interpolants])
    return StateSolution(both, two.tangents) if isinstance(two, StateSolution) else both


FIELDS = {
    "t": Field(("t",)),
    "y": Field(("component", "t")),
    "invariants": Field(("invariant", "t")),
    "max_residual": Field(("invariant",), np.maximum),
    "variations": Field(("t", "component", "column")),
    "outputs": Field(("output", "t")),
    "multipliers": Field(("constraint", "t")),
    **dict.fromkeys(("method", "h", "message", "status", "success", "units"), Field(())),
    **dict.fromkeys(("trusted", "compiled"), Field((), operator.and_)),
    **dict.fromkeys(("nfev", "njev", "nlu", "wall_time"), Field((), operator.add)),
    **dict.fromkeys(("t_events", "y_events"), Field(None, _by_event)),
    **dict.fromkeys(("target", "calls", "columns", "epoch"), Field(None)),
    "component_names": Field(None, lambda one, two: one),  # the user may have assigned others
    "sol": Field(None, _solution),
    "diagnostics": Field(None, Diagnostics.followed_by),
}
# Axis of t of the fields along t.
ALONG = {name: field.dims.index("t") for name, field in FIELDS.items() if field.dims and "t" in field.dims}


def rows(result: Any, part: slice) -> dict[str, np.ndarray]:
    """Return the fields along t of a result, with the saved times in `part` only."""
    return {name: result[name][(slice(None),) * axis + (part,)] for name, axis in ALONG.items() if name in result}


def joined(one: Any, two: Any, but: Sequence[str] = ()) -> dict[str, Any]:
    """Return the fields of a run and its continuation together, except those in `but`.

    The state where both meet is stored once.
    """
    meet = one["t"].size and two["t"].size and two["t"][0] == one["t"][-1]
    found: dict[str, Any] = {}
    for name, new in rows(two, slice(1 if meet else 0, None)).items():
        found[name] = np.concatenate([one[name], new], axis=ALONG[name])
    for name, field in FIELDS.items():
        if field.join is not None and name in two and name not in but:
            found[name] = field.join(one[name], two[name])
    return found


# Labels.


def label(name: str, used: Container[str], kind: str = "") -> str:
    """Return `name`, or if it is `used` already, the name behind its `kind` or with a number."""
    longer = [f"{kind} {name}"] if kind else []
    return next(text for text in chain([name], longer, (f"{name} ({k})" for k in count(1))) if text not in used)


def distinct(names: Iterable[str]) -> list[str]:
    """Return labels for names, of which some may be equal."""
    found: dict[str, None] = {}
    for name in names:
        found[label(name, found)] = None
    return list(found)


def time_name(components: Container[str]) -> str:
    """Return the label of the independent variable: "t", or "s" if a component of the state is the time "t"."""
    return label("s" if "t" in components else "t", components)


def component_names(result: Any, names: Any = None, n: int | None = None) -> tuple[str, ...]:
    """Return the `n` names of components: `names`, by default those of the result, else "y0", "y1" and so on.

    By default `n` is len(result.y). ValueError is raised if `names` are not `n` different names.
    """
    n = len(result.y) if n is None else n
    return checked(getattr(result, "component_names", None) if names is None else names, n)


def labels(result: Any, names: Any = None) -> dict[str, list[str]]:
    """Return distinct labels along each dimension of a run except t; `names` are those of the components."""
    components = list(component_names(result, names))
    found = {"component": components}
    if "invariants" in result and len(result.invariants):
        found["invariant"] = distinct(result.diagnostics.names)
    if "variations" in result:
        known = result.get("columns", {})
        columns = [*(components if known.get("state") else ()), *known.get("names", ())]
        count = result.variations.shape[2]
        found["column"] = distinct(columns) if len(columns) == count else [str(k) for k in range(count)]
    if (outputs := getattr(result, "outputs", None)) is not None:
        found["output"] = list(outputs)
    if (multipliers := getattr(result, "multipliers", None)) is not None:
        found["constraint"] = distinct(multipliers.names)
    return found
