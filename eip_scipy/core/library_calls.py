"""Functions of the engine's library in a form that the package's own Numba functions can call."""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

import numpy as np
from numba import njit

from ..engine.native import LibraryFunction

__all__ = ["jitted_call"]

# Of `call_by_handle` in library.cpp.
FUNCTION = ctypes.CFUNCTYPE(
    ctypes.c_double, ctypes.c_void_p, ctypes.c_double, *[ctypes.c_void_p] * 4, *[ctypes.c_int64] * 2
)
# Inlined, because only then the compiler sees that arrays need no counting of references.
_inlined = njit(forceinline=True)


@cache
def jitted_call(function: LibraryFunction) -> Any:
    """Return a jitted function with the arguments of `function`, for contiguous states and parameters.

    Return `function` itself if its parameters are fixed, if the size of its value is not, or if it returns a value that
    depends on f or on the size of the state.
    """
    returns = function.returns_numbers
    if function.own or function.numbers < 0 or not (function.in_place or returns):
        return function
    call, handle, rows = FUNCTION(function.call_address), function.handle, function.numbers
    wrong = f"{function.__name__} was called with a state or params of the wrong size"
    no_memory = f"{function.__name__} could not get the memory that it needs"

    def number(t, y, params):
        state = y.ctypes.data
        return call(handle, t, state, state, 0, params.ctypes.data, y.size, params.size)

    def numbers(t, y, params):
        out = np.empty(rows)
        fill(t, y, y, out, params)
        return out

    def fill(t, y, f, out, params):
        pointers = y.ctypes.data, f.ctypes.data, out.ctypes.data, params.ctypes.data
        status = call(handle, t, *pointers, y.size, params.size)
        if status > 0.0:
            raise MemoryError(no_memory)
        if status != 0.0:
            raise ValueError(wrong)

    def fill_rows(t, y, f, out, params):  # `out` may be a part of a larger array
        found = np.empty((rows, y.size))
        fill(t, y, f, found, params)
        for i in range(rows):  # an assignment to a slice takes Numba seconds to compile
            for j in range(y.size):
                out[i, j] = found[i, j]

    fill = _inlined(fill)
    if returns:
        return _inlined(number if rows == 1 else numbers)
    filled = fill if rows == 1 else _inlined(fill_rows)
    if function.takes_f:
        return filled
    return _inlined(lambda t, y, out, params: filled(t, y, y, out, params))
