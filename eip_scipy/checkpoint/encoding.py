"""Values of results in files: numbers as arrays, everything else as JSON."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

import numpy as np

from ..core.inputs import shown
from ..core.results import Diagnostics, Multipliers
from ..engine.trust import Trust

__all__ = ["decoded", "encoded"]

RECORDS = {record.__name__: record for record in (Diagnostics, Trust)}


def encoded(name: str, value: Any, arrays: dict[str, np.ndarray]) -> Any:
    """Return a field in the form that `decoded` reads: values of JSON, and the names of arrays, added to `arrays`.

    A mapping with one key stands for everything that JSON does not have; its key names the kind. TypeError is raised
    for a field that would not come back as it is.
    """
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, (str, bool, int)) or (isinstance(value, float) and math.isfinite(value)):
        return value
    if isinstance(value, np.ndarray):
        if value.dtype == object and value.ndim == 1 and value.size and all(isinstance(item, str) for item in value):
            return {"texts": _texts(value)}
        return {"array": _added(name, value, arrays)}
    if type(value) in RECORDS.values():
        return {type(value).__name__: _items(name, vars(value), arrays)}
    if isinstance(value, Multipliers):
        return {"multipliers": _items(name, value._asdict(), arrays)}
    if isinstance(value, dict) and all(isinstance(key, str) for key in value):
        return {"dict": _items(name, value, arrays)}
    if isinstance(value, list) and (lengths := _lengths(value)) is not None:
        parts = np.concatenate([_numbers(name, leaf) for leaf in _leaves(value)])
        return {"parts": [_added(name, parts, arrays), _added(f"{name}.lengths", lengths, arrays)]}
    if isinstance(value, (list, tuple)):
        items = [encoded(f"{name}.{k}", item, arrays) for k, item in enumerate(value)]
        return items if isinstance(value, list) else {"tuple": items}
    raise TypeError(f"save: the field {name!r} is {shown(value)}, which cannot be saved. Delete it or convert it.")


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
        usual, others, size = content
        return np.array([others.get(str(k), usual) for k in range(size)], dtype=object)
    if kind == "parts":
        joined, lengths = (arrays[name] for name in content)
        parts = np.split(joined, np.cumsum(lengths)[:-1])
        rows, columns = lengths.shape if lengths.ndim == 2 else (1, lengths.size)
        found = [parts[k * columns : (k + 1) * columns] for k in range(rows)]
        return found if lengths.ndim == 2 else found[0]
    if kind == "tuple":
        return tuple(decoded(content, arrays))
    items = {key: decoded(item, arrays) for key, item in content.items()}
    if kind == "multipliers":
        return Multipliers(**items)
    if kind == "dict":
        return items
    record = object.__new__(RECORDS[kind])
    vars(record).update(items)
    return record


def _items(name: str, items: dict[str, Any], arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    # Numbers instead of keys, which may contain any character, in the names of arrays.
    return {key: encoded(f"{name}.{k}", item, arrays) for k, (key, item) in enumerate(items.items())}


def _added(name: str, value: np.ndarray, arrays: dict[str, np.ndarray]) -> str:
    arrays[name] = _numbers(name, value)
    return name


def _numbers(name: str, array: np.ndarray) -> np.ndarray:
    """Return an array of numbers; TypeError is raised for another one, and for one that is more than its numbers."""
    if array.dtype.kind not in "biufc":
        raise TypeError(f"save: the field {name!r} has dtype {array.dtype}, expected numbers. Delete it or convert it.")
    if type(array) not in (np.ndarray, np.memmap):
        raise TypeError(
            f"save: the field {name!r} is a {type(array).__name__}, of which only the numbers would be saved, without "
            "a mask or a unit. Delete it or convert it to a plain array."
        )
    return array


def _texts(texts: np.ndarray) -> list[Any]:
    """Return texts, most of which are equal: the usual one, the others by their place, and the number of texts."""
    usual = Counter(texts.tolist()).most_common(1)[0][0]
    return [usual, {str(k): text for k, text in enumerate(texts) if text != usual}, texts.size]


def _leaves(nested: list[Any]) -> list[Any]:
    """Return the items of a list, or of a list of lists, in order."""
    return [leaf for item in nested for leaf in (item if isinstance(item, list) else [item])]


def _lengths(nested: list[Any]) -> np.ndarray | None:
    """Return the lengths of arrays in a list (m,) or in m lists (m, k); None if they are not alike except for these."""
    leaves = _leaves(nested)
    if not leaves or not all(isinstance(leaf, np.ndarray) and leaf.ndim for leaf in leaves):
        return None
    rows = {len(item) if isinstance(item, list) else 0 for item in nested}
    if len(rows) > 1 or len({(leaf.dtype, leaf.shape[1:]) for leaf in leaves}) > 1:
        return None
    lengths = np.array([len(leaf) for leaf in leaves])
    return lengths.reshape(len(nested), -1) if rows.pop() else lengths
