"""The start of ``eip-scipy solar-system`` at any epoch of a JPL kernel."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import date
from fractions import Fraction
from importlib import import_module
from typing import Any

from ..report import UsageError

FORMS = '"2014-02-02T20:18", "2000-01-01" (both TDB, Gregorian calendar), "JD2451545.0" or "2451545.0"'
_DATE = re.compile(r"(\d{4}-\d\d-\d\d)(?:[T ]([01]\d|2[0-3]):([0-5]\d)(?::([0-5]\d(?:\.\d+)?))?)?")
_JULIAN_DATE = re.compile(r"(?:JD ?)?(-?\d{1,8}(?:\.\d*)?)", re.IGNORECASE)
_TDB = re.compile(r" ?TDB$", re.IGNORECASE)
_ORDINAL_ZERO_JD = Fraction(3442849, 2)  # of date.toordinal(), at midnight


def parse_epoch(text: str) -> tuple[float, float]:
    """Read an epoch without loss, and return the Julian date (TDB) of the last midnight and the days since then.

    Both are the numbers nearest to the text, which is a date of the proleptic Gregorian calendar with or without time,
    or a Julian date; "TDB" may follow. TDB has no leap seconds. Other texts raise a ValueError.

    Examples
    --------
    >>> parse_epoch("2000-01-01T12:00")
    (2451544.5, 0.5)
    """
    words = _TDB.sub("", text.strip())
    if written := _JULIAN_DATE.fullmatch(words):
        julian_date = Fraction(written[1])
    elif written := _DATE.fullmatch(words):
        hour, minute, second = (Fraction(part or 0) for part in written.groups()[1:])
        try:
            days = date.fromisoformat(written[1]).toordinal()
        except ValueError as error:
            raise ValueError(f"no such date: {text!r} ({error})") from error
        julian_date = days + _ORDINAL_ZERO_JD + ((hour * 60 + minute) * 60 + second) / 86400
    else:
        raise ValueError(f"expected an epoch such as {FORMS}, got {text!r}")
    half = Fraction(1, 2)
    midnight = (julian_date - half) // 1 + half
    return float(midnight), float(julian_date - midnight)


def kernels() -> Any:
    """Return `eip_scipy.integrations.jpl`; its dependencies are imported when a kernel is read."""
    return import_module("eip_scipy.integrations.jpl")


@contextmanager
def one_line() -> Iterator[None]:
    """Turn errors about an epoch, a kernel or a force model into a UsageError with a message of one line."""
    try:
        yield
    except (ImportError, OSError, ValueError) as error:
        raise UsageError(" ".join(str(error).split())) from error
