"""Further arguments of the functions of a run: `args` as in SciPy, or one array, `params`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from .inputs import is_number, real_array, shown

__all__ = ["Packed", "are_same", "extra_arguments", "floats", "names", "parameter_values", "scalars"]

EXACT = 2**53  # integers up to this one are exact as floats


class Packed(NamedTuple):
    """Further arguments of native functions: `values` as one array, or as separate numbers for jitted functions.

    `scalars` contains the type of each number: "d" for a float, "q" for an integer, "?" for a bool. It is "" if the
    functions take the array.
    """

    values: np.ndarray
    scalars: str = ""


def extra_arguments(args: Any, params: Any) -> tuple[Any, ...]:
    """Return the last arguments of the functions of a run as a tuple: `args`, ``(params,)``, or () if both are None."""
    if args is None:
        return () if params is None else (parameter_values(params).reshape(-1),)
    if params is not None:
        raise TypeError("give args or params, not both: each of them defines the last arguments of the functions.")
    try:
        found = tuple(args)
    except TypeError:
        raise TypeError(f"args must be a tuple, got {shown(args)}; write args=(x,) for a single argument.") from None
    return tuple(item.copy() for item in found) if _is_array(found) else found


def are_same(one: tuple[Any, ...], other: tuple[Any, ...]) -> bool:
    """Return True if two tuples have the same length and their items are pairwise the same object, or equal numbers."""
    pairs = zip(one, other, strict=False)
    return len(one) == len(other) and all(a is b or np.array_equal(a, b) for a, b in pairs)


def parameter_values(params: Any) -> np.ndarray:
    """Return `params` as an array of floats; raise TypeError if they are not numbers, for instance a mapping."""
    if isinstance(params, Mapping):
        raise TypeError(
            f"params must be an array of numbers, got {shown(params)}. Give the values in the order in which fun reads "
            "them, params=[1.0, 2.0], or pass the mapping as args=(mapping,); fun is then called from Python. Problems "
            "made by hamiltonian or equations accept a mapping from names to values."
        )
    return params.copy() if _is_floats(params) else real_array("params", params, TypeError)


def scalars(extra: tuple[Any, ...]) -> str | None:
    """Return the types of the numbers in `extra`, see `Packed`; "" for an array or none; None for anything else."""
    if _is_array(extra):
        return ""
    types = [_type(item) for item in extra]
    return None if None in types else "".join(map(str, types))


def floats(extra: tuple[Any, ...]) -> np.ndarray:
    """Return further arguments as an array of floats for native functions; it is empty if only Python can pass them."""
    if _is_array(extra):
        return np.asarray(extra[0])
    return np.array(extra if scalars(extra) else (), float)


def names(extra: tuple[Any, ...]) -> tuple[str, ...]:
    """Return the names of the further arguments in messages: "params" for one array, else "args[0]", "args[1]", ..."""
    return ("params",) if _is_array(extra) else tuple(f"args[{k}]" for k in range(len(extra)))


def _is_array(extra: tuple[Any, ...]) -> bool:
    """Return True if the further arguments are one array of floats."""
    return len(extra) == 1 and _is_floats(extra[0])


def _is_floats(item: Any) -> bool:
    return type(item) is np.ndarray and item.ndim == 1 and item.dtype == float


def _type(item: Any) -> str | None:
    if isinstance(item, (bool, np.bool_)):
        return "?"
    if not is_number(item):
        return None
    if isinstance(item, (int, np.integer)):
        return "q" if abs(int(item)) <= EXACT else None
    return "d"
