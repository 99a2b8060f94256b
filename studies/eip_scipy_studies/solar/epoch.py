"""The start of ``eip-scipy solar-system``: a set that the package carries, or any epoch of a JPL kernel."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import date
from fractions import Fraction
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from ..report import UsageError
from ..study import option

FORMS = '"2014-02-02T20:18", "2000-01-01" (both TDB, Gregorian calendar), "JD2451545.0" or "2451545.0"'
_DATE = re.compile(r"(\d{4}-\d\d-\d\d)(?:[T ](\d\d):(\d\d)(?::(\d\d(?:\.\d+)?))?)?")
_JULIAN_DATE = re.compile(r"(?:JD ?)?(-?\d{1,8}(?:\.\d*)?)", re.IGNORECASE)
_TDB = re.compile(r" ?TDB$", re.IGNORECASE)
_ORDINAL_ZERO_JD = Fraction(3442849, 2)  # of date.toordinal(), at midnight


class Epoch(NamedTuple):
    """A Julian date, TDB, in two parts: the last midnight, and the time since then in days."""

    midnight: float
    rest: float


def parse_epoch(text: str) -> Epoch:
    """Read an epoch without loss: both parts are the numbers nearest to the text.

    The text is a date of the proleptic Gregorian calendar with or without time, or a Julian date; "TDB" may follow.
    Other texts raise a ValueError, whose message lists the accepted forms.

    Examples
    --------
    >>> parse_epoch("2000-01-01T12:00")
    Epoch(midnight=2451544.5, rest=0.5)
    """
    words = _TDB.sub("", text.strip())
    try:
        if written := _DATE.fullmatch(words):
            return _from_date(*written.groups(default="0"))
    except ValueError as error:
        raise ValueError(f"no such date or time: {text!r} ({error})") from error
    if written := _JULIAN_DATE.fullmatch(words):
        return _two_parts(Fraction(written[1]))
    raise ValueError(f"expected an epoch such as {FORMS}, got {text!r}")


def _from_date(day: str, hour: str, minute: str, second: str) -> Epoch:
    time = Fraction(int(hour) * 60 + int(minute)) * 60 + Fraction(second)
    if int(hour) > 23 or int(minute) > 59 or Fraction(second) >= 60:
        raise ValueError("hours are 00 to 23, minutes 00 to 59, seconds below 60; TDB has no leap seconds")
    return _two_parts(date.fromisoformat(day).toordinal() + _ORDINAL_ZERO_JD + time / 86400)


def _two_parts(julian_date: Fraction) -> Epoch:
    half = Fraction(1, 2)
    midnight = (julian_date - half) // 1 + half
    return Epoch(float(midnight), float(julian_date - midnight))


def _epoch(text: str) -> Epoch:
    try:
        return parse_epoch(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


@dataclass(frozen=True, kw_only=True)
class AnyEpoch:
    """Settings of a study that can start at any epoch of a JPL kernel."""

    epoch: Epoch | None = option(
        None, f'start at any epoch of a JPL kernel: {FORMS}; needs "eip_scipy[jpl]"', type=_epoch
    )
    kernel: Path | None = option(
        None, "file of a planetary kernel (.bsp) to use instead of DE440", type=Path, metavar="FILE"
    )


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
