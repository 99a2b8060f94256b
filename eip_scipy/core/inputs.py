"""Validation of numeric arguments; error messages name the argument."""

from __future__ import annotations

import datetime
import inspect
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

__all__ = [
    "count", "filled", "flag", "has_unit", "is_date", "is_number", "is_plain", "real_array", "reals", "refuse_units",
    "require_arguments", "shown",
]  # fmt: skip

PLAIN = frozenset((int, float, complex, str, bool, type(None), np.float64, np.complex128))
DATES = (datetime.date, datetime.timedelta, np.datetime64, np.timedelta64)
SHOWN = 120
LARGEST_COUNT = 2**63 - 1  # largest 64-bit integer


def shown(value: Any) -> str:
    """Return a value as text for an error message: on one line, shortened if it is long."""
    try:
        text = " ".join(repr(value).split())
    except ValueError:  # an integer of thousands of digits
        text = f"a very long {type(value).__name__}"
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."


def refuse_units(**arguments: Any) -> None:
    """Raise TypeError for values with a unit and for dates, because NumPy would silently drop the unit.

    The keywords are the names of the user's arguments. Items of lists, tuples and object arrays are checked too.
    """
    for name, value in arguments.items():
        if type(value) in PLAIN or is_plain(value):
            continue
        for item in _leaves(value):
            if is_date(item):
                raise TypeError(
                    f"{name}: {shown(item)} is a date or a duration; expected plain numbers. Count time in the unit of "
                    "the equations, for instance (t - t0).to_value('day') with astropy."
                )
            if has_unit(item):
                raise TypeError(
                    f"{name}: {shown(item)} has a unit; expected plain numbers, in the units of the equations. Convert "
                    "it first: x.to_value('AU') with astropy, x.m_as('AU') with pint."
                )


def is_plain(value: Any) -> bool:
    """Return True if a value is certainly a plain number, an array of numbers, or a list or tuple of plain numbers."""
    kind = type(value)
    if kind is np.ndarray:
        return value.dtype.kind in "fiubc"
    return kind in PLAIN or (kind in (tuple, list) and all(type(item) in PLAIN for item in value))


def _leaves(value: Any) -> Any:
    """Yield the items of nested lists, tuples and object arrays, or a single value; plain numbers are left out."""
    if type(value) in (list, tuple):
        for item in value:
            if type(item) not in PLAIN:
                yield from _leaves(item)
    elif type(value) is np.ndarray and value.dtype.kind == "O":
        yield from _leaves(value.ravel().tolist())
    elif not is_plain(value):
        yield value


def is_date(value: Any) -> bool:
    """Return True if a value is a date, a time or a duration."""
    if isinstance(value, DATES) or getattr(getattr(value, "dtype", None), "kind", "") in ("m", "M"):
        return True
    return hasattr(value, "jd1") and hasattr(value, "jd2")  # times of astropy have no unit


def has_unit(value: Any) -> bool:
    """Return True if a value has a unit, as quantities of astropy, pint and unyt do."""
    numeric = hasattr(value, "__float__") or hasattr(type(value), "__array__")
    return numeric and any(getattr(value, name, None) is not None for name in ("unit", "units"))


def reals(value: Any) -> np.ndarray | None:
    """Return a value as a new array of floats, or None if it does not consist of real numbers."""
    try:
        found = np.asarray(value)
        if found.dtype.kind == "O":
            numbers = found.ravel().tolist()
            if any(isinstance(number, (str, complex, np.complexfloating)) for number in numbers):
                return None
            return np.array([float(number) for number in numbers]).reshape(found.shape)
    except (TypeError, ValueError, OverflowError):
        return None
    return np.array(found, dtype=float, order="C") if found.dtype.kind in "fiub" else None


def real_array(name: str, value: Any, error: type[Exception] = ValueError) -> np.ndarray:
    """Return a value as a new array of floats; raise `error` if it is not real, and TypeError if it has a unit."""
    refuse_units(**{name: value})
    found = reals(value)
    if found is None:
        raise error(f"{name} must be an array of numbers, got {shown(value)}; expected real ones.")
    return found


def is_number(value: Any) -> bool:
    """Return True if a value is a real number that a float can represent; False for a bool and for an array."""
    if type(value) is float:
        return True
    number = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
    return number and reals(value) is not None


def count(name: str, value: Any, most: int = LARGEST_COUNT) -> int:
    """Return the option `name` as an int; raise ValueError unless `value` is an integer from 1 to `most`."""
    if type(value) is int and 1 <= value <= most:
        return value
    refuse_units(**{name: value})
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, np.integer)) or value < 1:
        raise ValueError(f"{name} must be an integer >= 1, got {shown(value)}.")
    if value > most:
        raise ValueError(f"{name} must be at most {most}, got {shown(value)}.")
    return int(value)


def flag(name: str, value: Any) -> bool:
    """Return the option `name` as a bool; raise ValueError unless `value` is True or False."""
    if not isinstance(value, (bool, np.bool_)):
        raise ValueError(f"{name} must be True or False, got {shown(value)}.")
    return bool(value)


def require_arguments(fun: Callable[..., Any], given: Sequence[str], what: str, advice: str) -> None:
    """Raise a TypeError that explains a failed call if `fun` does not accept arguments with the names `given`.

    The message says with which arguments `what`, the name of the function, is called, and ends with `advice`, or with
    advice about the time if only the time is missing.
    """
    try:
        signature = inspect.signature(fun)
    except (TypeError, ValueError):  # some functions in C have no signature
        return
    try:
        signature.bind(*given)
    except TypeError as error:
        if _leaves_out_time(signature, given):
            names = ", ".join(given)
            advice = f"The first argument is always the time: write lambda {names}: ..., or def name({names})."
        raise TypeError(f"{what} is called with ({', '.join(given)}): {error}. {advice}") from None


def _leaves_out_time(signature: inspect.Signature, given: Sequence[str]) -> bool:
    """Return True if a function accepts all given arguments except the time, and its first argument is not the time."""
    try:
        signature.bind(*given[1:])
    except TypeError:
        return False
    first = next(iter(signature.parameters), "t")
    return given[0] == "t" and not first.strip("_").startswith("t")


def filled(call: Callable[[np.ndarray], Any], shape: tuple[int, ...], dtype: Any, what: str, t: float) -> np.ndarray:
    """Return the array of this shape and type that a user's in-place function fills; before, all entries are NaN.

    ``call(out)`` calls the function. An error is raised if it returns anything but None or the array itself, does not
    fill the whole array, or reads entries before it fills them. The message contains its name, `what`, and the time
    `t`.
    """
    out, ones = np.empty(shape, dtype), np.empty(shape, dtype)
    found, other = out.view(float), ones.view(float)
    found.fill(math.nan)
    returned = call(out)
    if returned is not None and not (isinstance(returned, np.ndarray) and np.may_share_memory(returned, out)):
        raise TypeError(
            f"{what} returned {shown(returned)}, but with in_place=True it must fill its argument out and return "
            f"nothing, at t={t:.10g}. Write out[:] = ..., or omit in_place=True."
        )
    if not np.isnan(found).any():
        return out
    other.fill(1.0)
    call(ones)
    for places, does in (
        (np.isnan(found) & (other == 1), "does not fill all of its argument out"),
        (np.isnan(found) & ~np.isnan(other), "reads its argument out, whose content is arbitrary, before filling it"),
    ):
        if places.any():
            *row, component = np.argwhere(places)[0].tolist()
            where = ", ".join(map(str, (*row, component * shape[-1] // found.shape[-1])))
            raise ValueError(f"{what} {does}, in component {where}, at t={t:.10g}.")
    return out
