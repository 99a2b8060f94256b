"""Values of results in files: numbers as arrays, everything else as JSON."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from ..core.inputs import shown
from ..core.results import Diagnostics, Multipliers
from ..engine.trust import Trust

__all__ = ["decoded", "encoded"]


def _record(kind: type, fields: dict[str, Any]) -> Any:
    found: Any = object.__new__(kind)
    vars(found).update(fields)
    return found


# Values with named fields: type, and the functions that return their fields and make them from their fields.
KINDS: dict[str, tuple[type, Callable[[Any], dict[str, Any]], Callable[[dict[str, Any]], Any]]] = {
    "dict": (dict, dict, dict),
    "multipliers": (Multipliers, Multipliers._asdict, lambda fields: Multipliers(**fields)),
    **{record.__name__: (record, vars, partial(_record, record)) for record in (Diagnostics, Trust)},
}


def encoded(name: str, value: Any, arrays: dict[str, np.ndarray]) -> Any:
    """Return a field in the form that `decoded` reads: values of JSON, and the names of arrays, added to `arrays`.

    A mapping with one key stands for everything that JSON does not have; its key names the kind. TypeError is raised
    for a field that would not come back as it is.
    """
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, (str, int)) or (isinstance(value, float) and math.isfinite(value)):
        return value
    if _has_numbers(value):
        arrays[name] = value
        return {"array": name}
    if (
        isinstance(value, np.ndarray)
        and value.dtype == object
        and value.ndim
        and all(isinstance(text, str) for text in value)
    ):
        texts, arrays[name] = np.unique(value, return_inverse=True)  # most messages of members are equal
        return {"texts": [texts.tolist(), name]}
    for kind, (known, fields, _) in KINDS.items():
        if isinstance(value, known) and all(isinstance(key, str) for key in fields(value)):
            # Numbers instead of keys, which may contain any character, in the names of arrays.
            items = enumerate(fields(value).items())
            return {kind: {key: encoded(f"{name}.{k}", item, arrays) for k, (key, item) in items}}
    if isinstance(value, list) and _are_alike(leaves := _leaves(value)):  # as the events of many members
        arrays[name] = np.concatenate(leaves)
        return {"parts": [name, _nested(len, value)]}
    if isinstance(value, (list, tuple)):
        found = [encoded(f"{name}.{k}", item, arrays) for k, item in enumerate(value)]
        return found if isinstance(value, list) else {"tuple": found}
    raise TypeError(
        f"save: the field {name!r} is {shown(value)}, which would not be loaded as it is. Delete it, or convert it, "
        "for instance to a plain array of numbers, without a mask or a unit."
    )


def decoded(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    """Return a field from the output of `encoded`; KeyError is raised if an array is missing."""
    if isinstance(value, list):
        return [decoded(item, arrays) for item in value]
    if not isinstance(value, dict):
        return value
    ((kind, content),) = value.items()
    if kind == "array":
        return arrays[content]
    if kind == "texts":
        return np.array(content[0], dtype=object)[arrays[content[1]]]
    if kind == "parts":
        name, lengths = content
        parts = iter(np.split(arrays[name], np.cumsum(_leaves(lengths))))
        return _nested(lambda _: next(parts), lengths)
    if kind == "tuple":
        return tuple(decoded(content, arrays))
    return KINDS[kind][2]({key: decoded(item, arrays) for key, item in content.items()})


def _has_numbers(value: Any) -> bool:
    """Return True for an array of numbers; another one may be more than its numbers, for instance masked."""
    return type(value) in (np.ndarray, np.memmap) and value.dtype.kind in "biufc"


def _nested(function: Callable[[Any], Any], items: list[Any]) -> list[Any]:
    """Return the values of a function for the leaves of nested lists, in the same lists."""
    return [_nested(function, item) if isinstance(item, list) else function(item) for item in items]


def _leaves(items: list[Any]) -> list[Any]:
    found: list[Any] = []
    _nested(found.append, items)
    return found


def _are_alike(leaves: list[Any]) -> bool:
    """Return True for arrays that differ in their lengths and values only."""
    return all(_has_numbers(leaf) and leaf.ndim for leaf in leaves) and (
        len({(leaf.dtype, leaf.shape[1:]) for leaf in leaves}) == 1
    )
