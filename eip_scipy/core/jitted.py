"""Numba functions, recognised without loading Numba: where it is not loaded, there are none."""

from __future__ import annotations

import sys
from typing import Any

__all__ = ["ChangedShapeError", "NotCompilableError", "is_jitted", "jit_is_off"]


class ChangedShapeError(ValueError):
    """A compiled function returned an array of another shape than at the start."""


class NotCompilableError(TypeError):
    """A run cannot be compiled; the message names the function and says why."""


def is_jitted(fun: Any) -> bool:
    """Whether a function is Numba's."""
    if "numba" not in sys.modules:
        return False
    from numba import extending

    return bool(extending.is_jitted(fun))


def jit_is_off() -> bool:
    """Whether Numba is told to leave functions as they are (NUMBA_DISABLE_JIT)."""
    if "numba" not in sys.modules:
        return False
    from numba import config

    return bool(config.DISABLE_JIT)
