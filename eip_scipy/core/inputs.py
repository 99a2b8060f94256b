"""What users give where plain numbers belong; errors name the argument."""

from __future__ import annotations

import datetime
import inspect
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

__all__ = [
    "count", "filled", "flag", "has_unit", "is_date", "is_number", "real_array", "reals", "refuse_units",
    "require_arguments", "shown",
]  # fmt: skip

PLAIN = (int, float, complex, str, bool, type(None), np.float64, np.complex128)
DATES = (datetime.date, datetime.timedelta, np.datetime64, np.timedelta64)
SHOWN = 120
LARGEST_COUNT = 2**63 - 1  # what compiled code holds


def shown(value: Any) -> str:
    """The value in an error message, on one line, long ones cut."""
    try:
        text = " ".join(repr(value).split())
    except ValueError:  # an integer of thousands of digits
        text = f"a very long {type(value).__name__}"
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."


def refuse_units(**arguments: Any) -> None:
    """Refuse values with a unit, and dates: NumPy would drop the unit without a word.

    Parameters
    ----------
    **arguments
        Values by the names that the user knows them by; looked for in lists and tuples too.

    Raises
    ------
    TypeError
        For quantities and times of astropy, pint, unyt and their like, and for dates.
    """
    for name, value in arguments.items():
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


def _leaves(value: Any) -> Any:
    """The items of nested lists and tuples, and of arrays of objects; all else as it is."""
    if type(value) in (list, tuple):
        for item in value:
            if type(item) not in PLAIN:
                yield from _leaves(item)
    elif type(value) is np.ndarray and value.dtype.kind == "O":
        yield from _leaves(value.ravel().tolist())
    elif type(value) not in PLAIN:
        yield value


def is_date(value: Any) -> bool:
    """Whether a value is a date, a time or a duration."""
    if isinstance(value, DATES) or getattr(getattr(value, "dtype", None), "kind", "") in ("m", "M"):
        return True
    return hasattr(value, "jd1") and hasattr(value, "jd2")  # times of astropy have no unit of their own


def has_unit(value: Any) -> bool:
    """Whether a value has a unit, as quantities of astropy, pint and unyt do."""
    numeric = hasattr(value, "__float__") or hasattr(type(value), "__array__")
    return numeric and any(getattr(value, name, None) is not None for name in ("unit", "units"))


def reals(value: Any) -> np.ndarray | None:
    """A value as a new array of floats of its shape; None where it does not hold real numbers that a float holds."""
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
    """A value as a new array of floats.

    Raises
    ------
    TypeError
        For values with a unit.
    ValueError
        For what does not hold real numbers; `error` in its place.
    """
    refuse_units(**{name: value})
    found = reals(value)
    if found is None:
        raise error(f"{name} must be an array of numbers, got {shown(value)}; expected real ones.")
    return found


def is_number(value: Any) -> bool:
    """Whether a value is a real number that a float holds (no bool, no array)."""
    number = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
    return number and reals(value) is not None


def count(name: str, value: Any, most: int = LARGEST_COUNT) -> int:
    """An integer option >= 1."""
    refuse_units(**{name: value})
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, np.integer)) or value < 1:
        raise ValueError(f"{name} must be an integer >= 1, got {shown(value)}.")
    if value > most:
        raise ValueError(f"{name} must be at most {most}, got {shown(value)}.")
    return int(value)


def flag(name: str, value: Any) -> bool:
    """An option that is True or False."""
    if not isinstance(value, (bool, np.bool_)):
        raise ValueError(f"{name} must be True or False, got {shown(value)}.")
    return bool(value)


def require_arguments(fun: Callable[..., Any], given: Sequence[str], what: str, mend: str) -> None:
    """After a TypeError in a call of `fun`: say so where it does not take the arguments that it is `given`.

    Raises
    ------
    TypeError
        Naming `what` was called, how, and how to `mend` it.
    """
    try:
        signature = inspect.signature(fun)
    except (TypeError, ValueError):  # of some functions in C
        return
    try:
        signature.bind(*given)
    except TypeError as error:
        if _leaves_out_time(signature, given):
            names = ", ".join(given)
            mend = f"The time comes first, needed or not: write lambda {names}: ..., or def name({names})."
        raise TypeError(f"{what} is called with ({', '.join(given)}): {error}. {mend}") from None


def _leaves_out_time(signature: inspect.Signature, given: Sequence[str]) -> bool:
    """Whether a function takes what it is given but for the time."""
    try:
        signature.bind(*given[1:])
    except TypeError:
        return False
    first = next(iter(signature.parameters), "t")
    return given[0] == "t" and not first.strip("_").startswith("t")


def filled(call: Callable[[np.ndarray], Any], shape: tuple[int, ...], dtype: Any, what: str, t: float) -> np.ndarray:
    """What a user's function in place fills, from an array of NaN.

    Raises
    ------
    TypeError
        When it returns a value.
    ValueError
        When it leaves a part as it is, or reads what was there.
    """
    out, ones = np.empty(shape, dtype), np.empty(shape, dtype)
    found, other = out.view(float), ones.view(float)
    found.fill(math.nan)
    returned = call(out)
    if returned is not None and not (isinstance(returned, np.ndarray) and np.may_share_memory(returned, out)):
        raise TypeError(
            f"{what} returned {shown(returned)}, but with in_place=True it must fill its argument out and return "
            f"nothing, at t={t:.10g}. Write out[:] = ..., or leave in_place=True out."
        )
    if not np.isnan(found).any():
        return out
    other.fill(1.0)
    call(ones)
    for places, does in (
        (np.isnan(found) & (other == 1), "does not fill all of its argument out"),
        (np.isnan(found) & ~np.isnan(other), "reads its argument out, which holds anything, before it fills it"),
    ):
        if places.any():
            *row, component = np.argwhere(places)[0].tolist()
            where = ", ".join(map(str, (*row, component * shape[-1] // found.shape[-1])))
            raise ValueError(f"{what} {does}, in component {where}, at t={t:.10g}.")
    return out
