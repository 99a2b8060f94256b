"""The bridge to Numba: jitted functions as C functions of the engine, and the engine's functions for jitted ones."""

from __future__ import annotations

import ctypes
from contextlib import suppress
from functools import cache, lru_cache
from itertools import count
from types import CodeType, FunctionType
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import from_dtype, njit, types
from numba.core.compiler_lock import global_compiler_lock
from numba.core.errors import NumbaError
from numba.np.arrayobj import populate_array

from ..engine.native import LibraryFunction
from .arrays_into_out import into_out
from .functions import ChangedShapeError, Kind, NotCompilableError

__all__ = ["Compiled", "compiled", "jitted_call", "serial"]

# Counter for the names of C functions.
serial = count()
# How a number of each type in `scalars` is read from params.
SCALARS = {"d": "params[{}]", "q": "int(params[{}])", "?": "params[{}] != 0"}
# Statements that write `value` to `out`, by the number of dimensions; "values" are those of invariants, also in a list.
PUT = {
    0: ["out[0] = value"],
    "values": ["if len(value) != out.size: raise ChangedShapeError", "for i in range(out.size): out[i] = value[i]"],
    1: ["if value.size != out.size: raise ChangedShapeError", "for i in range(out.size): out[i] = value[i]"],
    2: [
        "if value.shape[0] != out.shape[0] or value.shape[1] != out.shape[1]: raise ChangedShapeError",
        "for i in range(out.shape[0]):",
        "    for j in range(out.shape[1]): out[i, j] = value[i, j]",
    ],
}
# Of `call_by_handle` in library.cpp.
FUNCTION = ctypes.CFUNCTYPE(
    ctypes.c_double, ctypes.c_void_p, ctypes.c_double, *[ctypes.c_void_p] * 4, *[ctypes.c_int64] * 2
)
# Inlined, because only then the compiler sees that the arrays need no counting of references.
_inlined = njit(forceinline=True)
_inner = njit(forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)


class Compiled(NamedTuple):
    """The address of a C function made from a Numba function, the owner of its code, its name, and its signature."""

    address: int
    library: Any
    fun: Any
    name: str
    kind: Kind

    def failure(self, t: float, y: bytes, f: bytes, params: np.ndarray) -> RuntimeError:
        """Call the function again at t and y, so that its exception propagates; return an error if it raises none."""
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


def compiled(fun: Any, kind: Kind, name: str, number: Any = None) -> Compiled:
    """Compile a Numba function of the signature `kind` as a C function; `number` replaces the state's Numba type."""
    try:
        address, library, may_lack_value = _compile(fun, kind, number)
    except NumbaError as error:
        if any(isinstance(known.return_type, types.List | types.BaseTuple) for known in fun.nopython_signatures):
            raise NotCompilableError(f"{name} returns a list or a tuple: return np.array([...])") from error
        lines = [line.strip() for line in str(error).splitlines() if line.strip()] or [type(error).__name__]
        raise NotCompilableError(f"{name} does not compile for this state: {' '.join(lines[:2])}") from error
    if may_lack_value:
        raise NotCompilableError(f"{name} returns None in some places, and a number or an array in others")
    return Compiled(address, library, fun, name, kind)


@lru_cache(maxsize=256)
def _compile(fun: Any, kind: Kind, number: Any) -> tuple[int, Any, bool]:
    """Return the address of a C function, the owner of its code, and whether it returns None in some branches.

    Equal functions, `kind` and `number` are compiled once in a process. Where it can be, a new array that the function
    returns is `out` itself, see `arrays_into_out`.
    """
    if len(kind.shape) == 1 and not kind.in_place and number is None:
        with suppress(NumbaError):
            return *_compiled(into_out(fun), kind, number, into=True), False
    address, library = _compiled(fun, kind, number)
    return address, library, any(isinstance(known.return_type, types.Optional) for known in fun.nopython_signatures)


def _compiled(fun: Any, kind: Kind, number: Any, *, into: bool = False) -> tuple[int, Any]:
    """Return the address of a C function, and the owner of its code; `into`: `fun` is from `into_out`."""
    call = _with_all_arguments(fun, kind, _inner, into=into)

    def array(scalar: Any, ndim: int) -> Any:
        return types.Array(number or scalar, ndim, "C", aligned=number is None)

    scalar = from_dtype(np.dtype(kind.dtype))
    state, floats = array(scalar, 1), array(types.float64, 1)
    out = floats if kind.real else array(scalar, max(1, len(kind.shape)))
    arguments = types.float64, state, state, out, floats
    with global_compiler_lock:
        call.compile(arguments)
        return _c_function(call.overloads[arguments], kind)


def _c_function(compiled: Any, kind: Kind) -> tuple[int, Any]:
    """Return a C function that calls `compiled(t, y, f, out, params)` and returns 0, or -1 if it raises, and its owner.

    Numba's `cfunc` would take twice as long to compile, and each call would go through another function.
    """
    name = f"eip_scipy.{next(serial)}"
    context = compiled.target_context
    library = context.codegen().create_library(name)
    module = library.create_ir_module(name)
    number, status = ir.DoubleType(), ir.IntType(32)
    pointers = [number.as_pointer()] * (4 if kind.gradient else 3)
    builder = ir.IRBuilder(ir.Function(module, ir.FunctionType(status, [number, *pointers]), name).append_basic_block())
    t, y, *others = builder.function.args
    given = (y, *others) if kind.gradient else (y, y, *others)
    lengths = ((kind.size,), (kind.size,), kind.shape or (1,), (max(kind.p, 0),))
    arrays = zip(compiled.signature.args[1:], given, lengths, strict=True)
    values = [t, *(_array(context, builder, *array) for array in arrays)]
    found, _ = context.call_internal_no_propagate(builder, compiled.fndesc, compiled.signature, values)
    builder.ret(builder.sext(found.is_error, status))
    library.add_ir_module(module)
    library.add_linking_library(compiled.library)
    library.finalize()
    return library.get_pointer_to_function(name), library


def _array(context: Any, builder: Any, kind: types.Array, data: Any, shape: tuple[int, ...]) -> Any:
    """Return the C array of this shape at `data` as a value of Numba's array type `kind`, which does not own it."""
    array = context.make_array(kind)(context, builder)
    item = context.get_abi_sizeof(context.get_data_type(kind.dtype))
    strides = np.cumprod((item, *shape[:0:-1]))[::-1].tolist()
    sizes = [[context.get_constant(types.intp, size) for size in found] for found in (shape, strides)]
    data = builder.bitcast(data, array.data.type)
    itemsize = context.get_constant(types.intp, item)
    populate_array(array, data=data, shape=sizes[0], strides=sizes[1], itemsize=itemsize, meminfo=None, parent=None)
    return array._getvalue()


def _with_all_arguments(fun: Any, kind: Kind, jit: Any, *, into: bool = False) -> Any:
    """Return ``call(t, y, f, out, params)``, compiled by `jit`, which writes the value of `fun` to out.

    It is made from text as one function, because Numba takes a third less time for it than for functions that call
    each other.
    """
    given = ["t", "y", *["f"] * kind.takes_f, *["out"] * kind.in_place]
    if kind.scalars:
        given += [SCALARS[letter].format(k) for k, letter in enumerate(kind.scalars)]
    elif kind.p >= 0:
        given.append("params")
    given += ["out"] * into
    dimensions = len(kind.shape)
    put = PUT["values" if kind.real and dimensions == 1 else dimensions] if not (kind.in_place or into) else ()
    text = "\n    ".join(["def call(t, y, f, out, params):", f"value = fun({', '.join(given)})", *put])
    (code,) = (item for item in compile(text, "<call>", "exec").co_consts if isinstance(item, CodeType))
    return jit(FunctionType(code, {"fun": fun, "ChangedShapeError": ChangedShapeError}))


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
