"""Conversion of astropy's quantities and times to plain numbers in the units of a problem; astropy is not imported."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from .inputs import has_unit, is_date, refuse_units, shown

__all__ = [
    "DAY_S", "LENGTHS", "TIMES", "Epoch", "Unit", "apart", "as_epoch", "days_since", "exact_sum", "in_unit", "is_time",
    "moment", "shown_epoch", "units",
]  # fmt: skip

Epoch = tuple[float, float]
"""A Julian date in TDB, in two parts, whose sum a single float would round to 20 microseconds."""

DAY_S = 86400.0
LENGTHS = {"m": 1.0, "cm": 0.01, "km": 1e3, "AU": 149597870700.0, "pc": 648000 / math.pi * 149597870700.0}
TIMES = {"s": 1.0, "min": 60.0, "h": 3600.0, "d": DAY_S, "yr": 365.25 * DAY_S}
TIMES |= {f"{prefix}yr": factor * TIMES["yr"] for prefix, factor in (("k", 1e3), ("M", 1e6), ("G", 1e9))}
ALIASES = {"au": "AU", "day": "d", "days": "d", "year": "yr", "years": "yr", "Julian year": "yr", "hr": "h"}
NUMBERED = re.compile(r"(\d+(?:\.\d*)?(?:e[-+]?\d+)?) (m|s)")


class Unit(NamedTuple):
    """A unit of length or time: `scale` times the unit `name` of astropy, or `si` metres or seconds."""

    name: str
    scale: float
    si: float


def units(text: str) -> tuple[Unit, Unit] | None:
    """Return the units of length and time in a text such as "AU, yr" or "km, 5022642.9 s"; None for other texts."""
    parts = [part.strip() for part in text.split(",")]
    if len(parts) != 2:
        return None
    length, time = _unit(parts[0], LENGTHS), _unit(parts[1], TIMES)
    return None if length is None or time is None else (length, time)


def _unit(text: str, known: dict[str, float]) -> Unit | None:
    name = ALIASES.get(text, text)
    if name in known:
        return Unit(name, 1.0, known[name])
    numbered = NUMBERED.fullmatch(text)
    if numbered is None or numbered[2] not in known:
        return None
    return Unit(numbered[2], float(numbered[1]), float(numbered[1]))


def in_unit(name: str, value: Any, powers: tuple[int, int], known: tuple[Unit, Unit] | None) -> Any:
    """Convert a value with a unit, or a list of such values, to plain numbers in the unit length**a time**b.

    `name` is the name of the argument, `powers` are a and b, and `known` the units of length and time; if it is None,
    values with a unit are refused. Plain numbers are returned unchanged if `known` is None or the unit is that of time.
    Otherwise only zeros may have no unit.
    """
    if known is None:
        refuse_units(**{name: value})
        return value

    def convert(item: Any) -> Any:
        if is_time(item):
            quantity = f"quantity in units of {known[1].name}"
            expected = f"a number, or a {quantity}" if powers == (0, 1) else "a number or a quantity"
            raise TypeError(f"{name}: {shown(item)} is a date; expected {expected}.")
        if powers != (0, 1) and not has_unit(item) and np.any(item):
            raise TypeError(f"{name}: {shown(item)} has no unit, but others have one; give it a unit too.")
        return _converted(name, item, powers, known)

    return _each(name, value, convert)


def moment(name: str, value: Any, known: tuple[Unit, Unit] | None, epoch: Epoch | None, whose: str) -> Any:
    """Convert dates, durations or plain numbers to numbers in the unit of time.

    `known` are the units of length and time, see `in_unit`. Dates are counted from `epoch`. `whose` names the owner of
    the epoch in messages.
    """
    if known is None:
        refuse_units(**{name: value})
        return value

    def convert(item: Any) -> Any:
        if not is_time(item):
            return _converted(name, item, (0, 1), known)
        if epoch is None:
            raise TypeError(
                f"{name}: {shown(item)} is a date, but {whose} does not define the date of t = 0. Give plain numbers "
                f"or durations, or make the problem with epoch=..., such as nbody(..., epoch=...)."
            )
        return days_since(name, epoch, item) * (DAY_S / known[1].si)

    return _each(name, value, convert)


def is_time(value: Any) -> bool:
    """Return True if a value is a time of astropy, not a duration."""
    return hasattr(value, "jd1") and hasattr(value, "jd2") and hasattr(value, "mjd")


def apart(span: Any) -> Any:
    """Return the ends of a span as a pair if they are one array of astropy's times; otherwise the span unchanged."""
    return tuple(span) if is_time(span) and np.shape(span.jd1) else span


def as_epoch(name: str, value: Any) -> Epoch:
    """Return a Time of astropy, or a Julian date in TDB as one number or two, as two numbers with this sum."""
    if is_time(value):
        dynamic = value.tdb
        value = (dynamic.jd1, dynamic.jd2)
        if np.shape(value[0]) != ():
            raise ValueError(f"{name}: expected one moment, got times of shape {np.shape(value[0])}.")
        value = (float(value[0]), float(value[1]))
    refuse_units(**{name: value})
    parts = tuple(value) if isinstance(value, tuple | list) else (value, 0.0)
    try:
        first, second = (float(part) for part in parts)
    except (TypeError, ValueError):
        raise TypeError(
            f"{name}: expected a Julian date in TDB, as a number or as two numbers with this sum, or a Time of "
            f"astropy; got {shown(value)}."
        ) from None
    if not (math.isfinite(first) and math.isfinite(second)):
        raise ValueError(f"{name}: expected a finite Julian date, got {shown(value)}.")
    return first, second


def days_since(name: str, epoch: Epoch, time: Any) -> Any:
    """Return the days of TDB from the epoch to a moment, or to each moment of an array."""
    dynamic = time.tdb
    days = (np.asarray(dynamic.jd1, dtype=float) - epoch[0]) + (np.asarray(dynamic.jd2, dtype=float) - epoch[1])
    return float(days) if days.shape == () else days


def exact_sum(a: float, b: float) -> tuple[float, float]:
    """Return the rounded sum of a and b, and the exact sum minus the rounded one."""
    total = a + b
    part = total - a
    return total, (a - (total - part)) + (b - part)


def shown_epoch(epoch: Epoch) -> str:
    """Return the Julian date and its scale as text."""
    return f"JD {epoch[0] + epoch[1]:.13g} TDB"


def _each(name: str, value: Any, convert: Callable[[Any], Any]) -> Any:
    if isinstance(value, tuple | list):
        converted = [_each(name, item, convert) for item in value]
        return tuple(converted) if isinstance(value, tuple) else converted
    if type(value) is np.ndarray and value.dtype.kind == "O":
        return np.array([_each(name, item, convert) for item in value.tolist()])
    return convert(value)


def _converted(name: str, value: Any, powers: tuple[int, int], known: tuple[Unit, Unit]) -> Any:
    duration = is_date(value) and hasattr(value, "to_value") and powers == (0, 1)
    if not duration and not (has_unit(value) and hasattr(value, "to_value")):
        refuse_units(**{name: value})
        return value
    length, time = known
    a, b = powers
    expression = " ".join(
        unit.name if power == 1 else f"{unit.name}{power}" for unit, power in ((length, a), (time, b)) if power
    )
    try:
        number = value.to_value(expression)
    except (TypeError, ValueError) as error:
        raise type(error)(f"{name}: {shown(value)} is not in units of {expression}: {error}.") from None
    return number / (length.scale**a * time.scale**b)
