"""What a run's functions take besides time and state: `args` as SciPy hands them on, or one array, `params`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from .inputs import is_number, real_array, refuse_units, shown

__all__ = ["Packed", "are_same", "extra_arguments", "floats", "names", "parameter_values", "scalars"]

EXACT = 2**53  # an integer up to here is a float as well


class Packed(NamedTuple):
    """What native functions read: `values` as one array, or, for jitted ones, number by number.

    `scalars`: the type of each number, "d" for a float, "q" for an integer, "?" for a bool; "": they take the array.
    """

    values: np.ndarray
    scalars: str = ""


def extra_arguments(args: Any, params: Any) -> tuple[Any, ...]:
    """The last arguments of a run's functions: `args`, or ``(params,)``, or none.

    Raises
    ------
    TypeError
        For both, for `args` that cannot be unpacked, and for `params` that are no floats.
    """
    if args is None:
        return () if params is None else (parameter_values(params).reshape(-1),)
    if params is not None:
        raise TypeError("give args or params, not both: either is what the functions take as their last arguments.")
    try:
        found = tuple(args)
    except TypeError:
        raise TypeError(f"args must be a tuple, got {shown(args)}; write args=(x,) for a single argument.") from None
    refuse_units(args=found)
    return tuple(item.copy() for item in found) if _is_array(found) else found


def are_same(one: tuple[Any, ...], other: tuple[Any, ...]) -> bool:
    """Return whether two tuples hold the same arguments, or equal numbers."""
    pairs = zip(one, other, strict=False)
    return len(one) == len(other) and all(a is b or np.array_equal(a, b) for a, b in pairs)


def parameter_values(params: Any) -> np.ndarray:
    """`params` as an array of floats.

    Raises
    ------
    TypeError
        For what holds no numbers, names among it.
    """
    if isinstance(params, Mapping):
        raise TypeError(
            f"params must be an array of numbers, got {shown(params)}: give the values in the order in which fun reads "
            "them, params=[1.0, 2.0], or the mapping itself by args=(mapping,), with which Python calls fun. Problems "
            "made by hamiltonian or equations take names."
        )
    return real_array("params", params, TypeError)


def scalars(extra: tuple[Any, ...]) -> str | None:
    """The types of the numbers in `extra`, see `Packed`; "" for one array, None: not for native functions."""
    if _is_array(extra):
        return ""
    types = [_type(item) for item in extra]
    return None if None in types else "".join(map(str, types))


def floats(extra: tuple[Any, ...]) -> np.ndarray:
    """The array that native functions read: numbers as floats; empty where they take none of what there is."""
    if _is_array(extra):
        return np.asarray(extra[0])
    return np.array(extra if scalars(extra) else (), float)


def names(extra: tuple[Any, ...]) -> tuple[str, ...]:
    """Of the further arguments, in messages."""
    return ("params",) if _is_array(extra) else tuple(f"args[{k}]" for k in range(len(extra)))


def _is_array(extra: tuple[Any, ...]) -> bool:
    """Whether they are one array of floats."""
    return len(extra) == 1 and type(extra[0]) is np.ndarray and extra[0].ndim == 1 and extra[0].dtype == float


def _type(item: Any) -> str | None:
    if isinstance(item, (bool, np.bool_)):
        return "?"
    if not is_number(item):
        return None
    if isinstance(item, (int, np.integer)):
        return "q" if abs(int(item)) <= EXACT else None
    return "d"
