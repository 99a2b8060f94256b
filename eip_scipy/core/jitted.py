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
    "ChangedShapeError", "NotCompilableError", "compilable", "compiled_call", "compiled_like", "is_compiled",
    "is_jitted", "jit_is_off", "jitted", "jitted_call",
]  # fmt: skip


class ChangedShapeError(ValueError):
    """A compiled function returned an array of another shape than at the start."""


class NotCompilableError(TypeError):
    """A run cannot be compiled; the message names the function and says why."""


def is_jitted(fun: Any) -> bool:
    """Return True if a function is a Numba function."""
    # Not numba.extending.is_jitted, which imports the class in each of its calls.
    return isinstance(fun, getattr(sys.modules.get("numba.core.dispatcher"), "Dispatcher", ()))


def compiled_call(call: Call, n: int, dtype: np.dtype[Any]) -> Call:
    """Return `call` with the C function made from a Numba function ``fun(t, y)`` of states (n,) of the type `dtype`.

    Return `call` itself if it has another function, or one that does not compile.
    """
    if not is_jitted(call.fun) or jit_is_off() or call.args or call.takes_f or call.in_place:
        return call
    from .native_functions import Kind
    from .numba_pointers import compiled_or_none

    return call._replace(compiled=compiled_or_none(call.fun, Kind(call.shape, n, -1, dtype.char, call.real)))


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
    if not getattr(fun, "compilable", False) or is_jitted(fun) or find_spec("numba") is None:
        return fun
    from numba import njit

    return njit(fun, error_model="numpy", forceinline=True)


def is_compiled(fun: Any) -> bool:
    """Return True if the engine calls `fun` by its address: a Numba function, or a `LibraryFunction` of the engine."""
    return is_jitted(fun) or isinstance(fun, LibraryFunction)


def jitted_call(fun: Any) -> Any:
    """Return a `LibraryFunction` in a form that Numba functions can call, if there is one; else `fun` itself."""
    if not isinstance(fun, LibraryFunction) or find_spec("numba") is None or jit_is_off():
        return fun
    from . import library_calls

    return library_calls.jitted_call(fun)


def compiled_like(fun: Callable[..., Any], *others: Callable[..., Any]) -> Callable[..., Any]:
    """Return `fun` jitted if all `others`, which `fun` calls, are Numba functions; else `fun`."""
    if not all(is_jitted(other) for other in others):
        return fun
    return cast(Callable[..., Any], jitted(compilable(fun)))
