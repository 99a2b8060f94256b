"""Code that Numba has already compiled for a user's functions; the engine calls it without making Python objects."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from llvmlite import ir
from numba import from_dtype, types
from numba.core.runtime import _nrt_python

from ..engine.native import Call, NumbaEntry

__all__ = ["with_entry"]

WORD, ADDRESS = ir.IntType(64), ir.IntType(8).as_pointer()


def with_entry(call: Call, dtype: np.dtype[Any]) -> Call:
    """Return `call`, of a Numba function ``fun(t, y)``, with the function's compiled code for states of type `dtype`.

    Return `call` itself if there is no such code that the engine can call. Nothing is compiled here: the code exists as
    soon as the function has been called once with such a state.
    """
    if call.args or call.takes_f or call.in_place or len(call.shape) > 2:
        return call
    state = types.Array(from_dtype(dtype), 1, "C")
    known: Any = call.fun
    code = known.overloads.get((types.float64, state))
    if code is None or code.objectmode:
        return call
    scalar = types.float64 if call.real else state.dtype
    shown = types.Array(scalar, len(call.shape), "C") if call.shape else scalar
    if code.fndesc.restype != shown or not _is_as_expected(code.target_context, shown, state):
        return call
    address = code.library.get_pointer_to_function(code.fndesc.llvm_func_name)
    return call._replace(entry=NumbaEntry(address, _nrt_python.c_helpers["MemInfo_release"], code))


@lru_cache(maxsize=16)
def _is_as_expected(context: Any, value: types.Type, state: types.Array) -> bool:
    """Return True if this version of Numba passes the argument y, `state`, and the value as the engine assumes."""
    number = context.get_data_type(state.dtype).as_pointer()
    returned = context.get_data_type(value)
    if isinstance(value, types.Array):
        data = context.get_data_type(value.dtype).as_pointer()
        lengths = ir.ArrayType(WORD, value.ndim)
        if returned != ir.LiteralStructType([ADDRESS, ADDRESS, WORD, WORD, data, lengths, lengths]):
            return False
    elif returned != ir.DoubleType():
        return False
    raised = context.call_conv.get_function_type(types.none, ()).args[1]
    array = [ADDRESS, ADDRESS, WORD, WORD, number, WORD, WORD]
    expected = ir.FunctionType(ir.IntType(32), [returned.as_pointer(), raised, ir.DoubleType(), *array])
    return bool(context.call_conv.get_function_type(value, (types.float64, state)) == expected)
