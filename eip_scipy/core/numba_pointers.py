"""Numba functions as the native engine takes them: by C pointers, compiled when a run begins."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import carray, cfunc, from_dtype, njit, types
from numba.core.errors import NumbaError
from numba.extending import intrinsic

from .jitted import ChangedShapeError, NotCompilableError
from .native_functions import Kind

__all__ = ["Compiled", "compiled"]


# Called from compiled code alone. Inlined, for that an array is nobody's and needs no counting of references shows only
# there.
_called = njit(no_cpython_wrapper=True, no_cfunc_wrapper=True)
_inlined = njit(forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)


class Compiled(NamedTuple):
    """A function as C calls it, with all arguments."""

    pointer: Any
    fun: Any
    name: str
    kind: Kind

    @property
    def address(self) -> int:
        """Of the C function."""
        return int(self.pointer.address)

    def failure(self, t: float, y: bytes, f: bytes, params: np.ndarray) -> RuntimeError:
        """What it raises is raised here, in a second call; returned is the error that it raises nothing."""
        kind = self.kind
        state = np.frombuffer(y, kind.dtype)[: kind.size].copy()
        slope = np.frombuffer(f or bytes(len(y)), kind.dtype).copy()
        out = np.empty(kind.shape or (1,), float if kind.real else kind.dtype)
        call = _with_all_arguments(self.fun, kind, njit)
        try:
            call(t, state, slope, out, params)
        except ChangedShapeError:
            raise ChangedShapeError(f"{self.name} returned an array of another shape than at the start") from None
        return RuntimeError(f"{self.name} raised an exception at t={t:.10g}, but not when it was called again there.")


def compiled(fun: Any, kind: Kind, name: str) -> Compiled:
    """A Numba function compiled for states of one kind.

    Raises
    ------
    NotCompilableError
        When it does not compile for the arguments that `integrate` documents.
    """
    try:
        pointer = _compile(fun, kind)
    except NumbaError as error:
        first = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
        raise NotCompilableError(f"{name} does not compile for this state: {first}") from error
    if any(isinstance(known.return_type, types.Optional) for known in fun.nopython_signatures):
        raise NotCompilableError(f"{name} returns None in some places, and a number or an array in others")
    return Compiled(pointer, fun, name, kind)


@lru_cache(maxsize=256)
def _compile(fun: Any, kind: Kind) -> Any:
    """The C function; for the same function and kind of state once in a process."""
    call = _with_all_arguments(fun, kind, _inlined)
    scalar = from_dtype(np.dtype(kind.dtype))
    state, floats = types.CPointer(scalar), types.CPointer(types.float64)
    size, p, shape = kind.size, max(kind.p, 0), kind.shape or (1,)

    def value(t, y, out, params):
        given = carray(y, (size,))
        return _status_of(call, t, given, given, carray(out, shape), carray(params, (p,)))

    def rows(t, y, f, out, params):
        return _status_of(call, t, carray(y, (size,)), carray(f, (size,)), carray(out, shape), carray(params, (p,)))

    out = floats if kind.real else state
    if kind.gradient:
        return cfunc(types.int32(types.float64, state, state, out, floats))(rows)
    return cfunc(types.int32(types.float64, state, out, floats))(value)


@intrinsic  # emits LLVM
def _status_of(typingctx, function, t, y, f, out, params):
    """0 after a call of a Numba function, -1 where it raised an exception."""
    arguments = t, y, f, out, params
    resolved = function.get_call_type(typingctx, arguments, {})

    def codegen(context, builder, signature, values):
        compiled = function.dispatcher.get_compile_result(resolved)
        context.active_code_library.add_linking_library(compiled.library)
        status, _ = context.call_internal_no_propagate(builder, compiled.fndesc, resolved, values[1:])
        return builder.sext(status.is_error, ir.IntType(32))

    return types.int32(function, *arguments), codegen


def _with_all_arguments(fun: Any, kind: Kind, jit: Any) -> Any:
    """``call(t, y, f, out, params)``, which puts the function's value into out."""
    has_params = kind.p >= 0
    bare = jit(
        {
            (False, False, False): lambda t, y, f, out, params: fun(t, y),
            (False, False, True): lambda t, y, f, out, params: fun(t, y, params),
            (False, True, False): lambda t, y, f, out, params: fun(t, y, out),
            (False, True, True): lambda t, y, f, out, params: fun(t, y, out, params),
            (True, False, False): lambda t, y, f, out, params: fun(t, y, f),
            (True, False, True): lambda t, y, f, out, params: fun(t, y, f, params),
            (True, True, False): lambda t, y, f, out, params: fun(t, y, f, out),
            (True, True, True): lambda t, y, f, out, params: fun(t, y, f, out, params),
        }[kind.takes_f, kind.in_place, has_params]
    )
    if kind.in_place:
        return bare
    put = {0: _put_number, 1: _put_values if kind.real else _put_array, 2: _put_rows}[len(kind.shape)]
    return jit(lambda t, y, f, out, params: put(bare(t, y, f, out, params), out))


@_called
def _put_number(value, out):
    out[0] = value


@_called
def _put_values(values, out):
    if len(values) != out.size:
        raise ChangedShapeError
    for i in range(out.size):
        out[i] = values[i]


@_called
def _put_array(values, out):
    if values.size != out.size:
        raise ChangedShapeError
    for i in range(out.size):
        out[i] = values[i]


@_called
def _put_rows(rows, out):
    if rows.shape[0] != out.shape[0] or rows.shape[1] != out.shape[1]:
        raise ChangedShapeError
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = rows[i, j]
