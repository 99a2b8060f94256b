"""Recognition of Numba functions without importing Numba: before Numba is imported, there are none."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from typing import Any, cast

import numpy as np

from ..engine.native import Call, LibraryFunction

__all__ = [
    "ChangedShapeError", "NotCompilableError", "compilable", "compiled_like", "is_compiled", "is_jitted",
    "jit_is_off", "jitted", "with_entry",
]  # fmt: skip


class ChangedShapeError(ValueError):
    """A compiled function returned an array of another shape than at the start."""


class NotCompilableError(TypeError):
    """A run cannot be compiled; the message names the function and says why."""


def is_jitted(fun: Any) -> bool:
    """Return True if a function is a Numba function."""
    # Not numba.extending.is_jitted, which imports the class in each of its calls.
    return isinstance(fun, getattr(sys.modules.get("numba.core.dispatcher"), "Dispatcher", ()))


def with_entry(call: Call, dtype: np.dtype[Any]) -> Call:
    """Return `call` with the code that Numba has compiled for states of `dtype`, or `call` itself if there is none."""
    if not is_jitted(call.fun):
        return call
    from . import numba_pointers

    return numba_pointers.with_entry(call, dtype)


def jit_is_off() -> bool:
    """Return True if Numba's compilation is disabled (NUMBA_DISABLE_JIT)."""
    if "numba" not in sys.modules:
        return False
    from numba import config

    return bool(config.DISABLE_JIT)


def compilable(fun: Callable[..., Any]) -> Callable[..., Any]:
    """Mark a function of this package as one that `jitted` may compile, and return the function."""
    fun.compilable = True  # type: ignore[attr-defined]
    return fun


@cache
def jitted(fun: Any) -> Any:
    """Return a `compilable` function jitted by Numba, if Numba is installed; return any other function unchanged."""
    if not getattr(fun, "compilable", False) or find_spec("numba") is None:
        return fun
    from numba import njit

    return njit(fun, error_model="numpy", forceinline=True)


def is_compiled(fun: Any) -> bool:
    """Return True if Numba functions can call `fun`: if it is a Numba function or a `LibraryFunction` of the engine."""
    return is_jitted(fun) or isinstance(fun, LibraryFunction)


def compiled_like(fun: Callable[..., Any], *others: Callable[..., Any]) -> Callable[..., Any]:
    """Return `fun` jitted if Numba is installed and all `others`, which `fun` calls, are compiled; else `fun`."""
    if not all(is_compiled(other) for other in others):
        return fun
    return cast(Callable[..., Any], jitted(compilable(fun)))
