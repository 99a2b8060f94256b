"""Use of the functions of the ready problems inside Numba functions: a user's jitted code may call `problem.rhs`.

Numba finds `register` through the package's entry point ``numba_extensions``.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numba import njit, types
from numba.extending import typeof_impl

from ..engine.native import LibraryFunction

__all__ = ["register"]

FUNCTION = ctypes.CFUNCTYPE(
    ctypes.c_int, ctypes.c_void_p, ctypes.c_double, *[ctypes.c_void_p] * 4, *[ctypes.c_int64] * 2
)
FITS = ctypes.CFUNCTYPE(ctypes.c_bool, *[ctypes.c_int64] * 2)


def register() -> None:
    """Make each `LibraryFunction`, such as ``problem.rhs``, callable from functions that Numba compiles."""
    typeof_impl.register(LibraryFunction)(lambda function, context: types.Dispatcher(_jitted(function)))


@cache
def _jitted(function: Any) -> Any:
    """Return a jitted function that calls a `LibraryFunction` with copies of its arguments, of any layout."""
    if function.own or function.numbers < 0:
        raise TypeError(f"{function.__name__} cannot be called by jitted functions.")
    value = njit(_value_of(function))
    if function.in_place and function.takes_f:
        return njit(lambda t, y, f, out, params: _fill(out, value(t, y, f, params)))
    if function.in_place:
        return njit(lambda t, y, out, params: _fill(out, value(t, y, y, params)))
    if function.takes_f:
        return njit(lambda t, y, f, params: value(t, y, f, params))
    if function.numbers == 1 and not function.fills_states:
        return njit(lambda t, y, params: value(t, y, y, params)[0])
    return njit(lambda t, y, params: value(t, y, y, params))


def _value_of(function: Any) -> Callable[..., Any]:
    call, fits, handle = FUNCTION(function.call_address), FITS(function.fits_address), function.handle
    numbers, of_state = function.numbers, function.fills_states
    no_memory = f"{function.__name__} could not get the memory that it needs"
    wrong = f"{function.__name__} was called with a state, derivative or params of the wrong size"

    def value(t, y, f, params):
        n, p = y.size, params.size
        if not (fits(n, p) and f.size == n):
            raise ValueError(wrong)
        out = np.empty(numbers * (n if of_state else 1))
        state, slope, parameters = _floats(y), _floats(f), _floats(params)
        pointers = state.ctypes.data, slope.ctypes.data, out.ctypes.data, parameters.ctypes.data
        if call(handle, t, *pointers, n, p) != 0:
            raise MemoryError(no_memory)
        return out

    return value


@njit
def _floats(values):
    out = np.empty(values.size)
    for i in range(out.size):
        out[i] = values[i]
    return out


@njit
def _fill(out, values):
    if out.size != values.size:
        raise ValueError("out has another size than the value that a function of eip_scipy writes to it")
    flat = out.flat
    for i in range(values.size):
        flat[i] = values[i]
