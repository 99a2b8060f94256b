"""The stack level of warnings, so that they show the line of the user's program that caused them."""

from __future__ import annotations

import sys

__all__ = ["users_level"]

INSIDE = (__name__.partition(".")[0], "scipy", "contextlib")


def users_level() -> int:
    """Return the `stacklevel` for a warning of the caller: that of the first function outside of the package and SciPy.

    The number of functions in between differs, because `solve_ivp`, `integrate`, `ensemble` and `recommend` share code.
    """
    frame, level = sys._getframe(1), 1
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] in INSIDE:
        frame, level = frame.f_back, level + 1
    return level
