"""Use of the functions of the ready problems inside Numba functions: a user's jitted code may call `problem.rhs`.

Numba finds `register` through the package's entry point ``numba_extensions``.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numba import carray, njit, types
from numba.core import cgutils
from numba.extending import intrinsic, overload, typeof_impl

from ..engine.native import LibraryFunction

__all__ = ["register"]

FUNCTION = ctypes.CFUNCTYPE(
    ctypes.c_int, ctypes.c_void_p, ctypes.c_double, *[ctypes.c_void_p] * 4, *[ctypes.c_int64] * 2
)
FITS = ctypes.CFUNCTYPE(ctypes.c_bool, *[ctypes.c_int64] * 2)


# Inlined, because only then the compiler sees that arrays need no counting of references.
INLINED = {"forceinline": True}
_inlined = njit(**INLINED)


def register() -> None:
    """Make each `LibraryFunction`, such as ``problem.rhs``, callable from functions that Numba compiles."""
    typeof_impl.register(LibraryFunction)(lambda function, context: types.Dispatcher(_jitted(function)))


@cache
def _jitted(function: Any) -> Any:
    """Return a jitted function that calls a `LibraryFunction` with arrays of any memory layout."""
    if function.own or function.numbers < 0:
        raise TypeError(
            f"{function.__name__} cannot be called by jitted functions, because its parameters are fixed, or the size "
            "of its value is not. Call it outside of jitted functions."
        )
    fill = _inlined(_filling(function))
    if function.in_place and function.takes_f:
        return _inlined(lambda t, y, f, out, params: fill(t, y, f, out, params))
    if function.in_place:
        return _inlined(lambda t, y, out, params: fill(t, y, y, out, params))
    value = _inlined(_value_of(function, fill))
    if function.takes_f:
        return _inlined(lambda t, y, f, params: value(t, y, f, params))
    return _inlined(lambda t, y, params: value(t, y, y, params))


def _value_of(function: Any, fill: Any) -> Callable[..., Any]:
    """Return ``value(t, y, f, params)``, which returns what `fill` writes for `function`: a number or a new array.

    It is a number if the value has one component for states of any size and does not depend on f.
    """
    numbers, of_state = function.numbers, function.fills_states

    def number(t, y, f, params):
        out = carray(_room_for_a_number(), 1)
        fill(t, y, f, out, params)
        return out[0]

    def array(t, y, f, params):
        out = np.empty(numbers * (y.size if of_state else 1))
        fill(t, y, f, out, params)
        return out

    return number if numbers == 1 and not of_state and not function.takes_f else array


def _filling(function: Any) -> Callable[..., None]:
    call, fits, handle = FUNCTION(function.call_address), FITS(function.fits_address), function.handle
    numbers, of_state = function.numbers, function.fills_states
    no_memory = f"{function.__name__} could not get the memory that it needs"
    wrong = f"{function.__name__} was called with a state, derivative or params of the wrong size"
    wrong_out = f"{function.__name__} was called with an array out of another size than its value"

    def fill(t, y, f, out, params):
        n, p = y.size, params.size
        if not (fits(n, p) and f.size == n):
            raise ValueError(wrong)
        if out.size != numbers * (n if of_state else 1):
            raise ValueError(wrong_out)
        values, parameters = _floats(out), _floats(params)
        state, slope = _apart(_floats(y), values), _apart(_floats(f), values)
        pointers = state.ctypes.data, slope.ctypes.data, values.ctypes.data, parameters.ctypes.data
        if call(handle, t, *pointers, n, p) != 0:
            raise MemoryError(no_memory)
        _write_back(values, out)

    return fill


@intrinsic
def _room_for_a_number(context):
    """Return a pointer to a number on the stack, which takes less time than an array."""

    def code(context, builder, signature, arguments):
        return cgutils.alloca_once(builder, context.get_value_type(types.float64))

    return types.CPointer(types.float64)(), code


def _is_plain(array: Any) -> bool:
    return bool(array.layout == "C" and array.dtype == types.float64)


def _floats(values: Any) -> Any:
    """Return `values` itself if it is a C-contiguous array of float64, else a flat copy; for jitted functions."""
    raise NotImplementedError


@overload(_floats, jit_options=INLINED)
def _floats_of(values):
    if _is_plain(values):
        return lambda values: values

    def copied(values):
        out, flat = np.empty(values.size), values.flat
        for i in range(out.size):
            out[i] = flat[i]
        return out

    return copied


def _write_back(values: Any, out: Any) -> None:
    """Write the values to `out`, if they are not in its memory already; for jitted functions."""
    raise NotImplementedError


@overload(_write_back, jit_options=INLINED)
def _write_back_to(values, out):
    if _is_plain(out):
        return lambda values, out: None

    def written(values, out):
        flat = out.flat
        for i in range(values.size):
            flat[i] = values[i]

    return written


@_inlined
def _apart(values, out):
    """Return `values`, or a copy if they share memory with `out`, to which functions write while they read."""
    distance = out.ctypes.data - values.ctypes.data
    if -8 * out.size < distance < 8 * values.size:
        return values.copy()
    return values
