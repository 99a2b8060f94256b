"""Memory for saved states: the option ``max_bytes``, and the free memory."""

from __future__ import annotations

import os
from contextlib import suppress
from typing import Any

from ..core.inputs import is_number, shown

__all__ = ["check_bytes", "most_bytes"]

SMALL = 2**22  # number of bytes up to which the free memory is not determined, because that takes longer than a fill


def check_bytes(max_bytes: Any) -> None:
    """Raise ValueError unless the option ``max_bytes`` is None or a number >= 0."""
    if max_bytes is not None and not (is_number(max_bytes, "max_bytes") and max_bytes >= 0):
        raise ValueError(f"max_bytes must be a number of bytes >= 0, got {shown(max_bytes)}.")


def most_bytes(needed: float, max_bytes: float | None) -> float:
    """Return the bound in bytes on the memory of a run that needs `needed` bytes.

    It is `max_bytes` if this is given, else `SMALL` for a run that needs no more, else half of the free memory.
    """
    if max_bytes is not None:
        return max_bytes
    return SMALL if needed <= SMALL else 0.5 * free_memory()


def free_memory() -> float:
    """Return an estimate of the number of bytes that a process can still allocate."""
    with suppress(OSError, StopIteration), open("/proc/meminfo") as lines:
        return 1024.0 * int(next(line for line in lines if line.startswith("MemAvailable:")).split()[1])
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        return 0.5 * os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return 4e9
