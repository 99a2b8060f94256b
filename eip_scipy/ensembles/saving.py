"""Conversion of an `EnsembleResult` to plain fields for a file, and back."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from .happened import Flat, flattened, unflattened

__all__ = ["expanded", "packed", "shortened", "unpacked"]

TUPLES = "names", "component_names"


def packed(result: Any) -> dict[str, Any]:
    """Return the fields of a result as arrays and values that JSON can hold."""
    fields = dict(result)
    fields["messages"] = shortened(fields.pop("message"))
    times, states = fields.pop("t_events"), fields.pop("y_events")
    if times is not None:
        pairs = [list(zip(t, y, strict=True)) for t, y in zip(times, states, strict=True)]
        n, dtype = fields["y"].shape[1], fields["y"].dtype
        flat = flattened(pairs, len(times[0]), n, dtype)
        fields |= {f"events.{name}": value for name, value in flat._asdict().items()}
    return fields


def unpacked(fields: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a result from the output of `packed`."""
    fields = dict(fields)
    fields["message"] = np.array(expanded(fields.pop("messages"), len(fields["t"])), dtype=object)
    events = [fields.pop(f"events.{name}", None) for name in Flat._fields]
    fields["t_events"] = fields["y_events"] = None
    if events[0] is not None:
        members = unflattened(Flat(*events))
        fields["t_events"] = [[t for t, _ in member] for member in members]
        fields["y_events"] = [[y for _, y in member] for member in members]
    for name in TUPLES:
        if fields.get(name) is not None:
            fields[name] = tuple(fields[name])
    return fields


def shortened(messages: Sequence[str]) -> dict[str, Any]:
    """Return the messages of members for JSON: the most frequent one, and the others by the member's number."""
    usual = str(Counter(messages).most_common(1)[0][0])
    return {"usual": usual, "others": {str(k): str(text) for k, text in enumerate(messages) if text != usual}}


def expanded(found: dict[str, Any], members: int) -> list[str]:
    """Return the messages of all `members` from the output of `shortened`."""
    return [found["others"].get(str(k), found["usual"]) for k in range(members)]
