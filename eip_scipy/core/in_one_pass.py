"""A user's jitted functions in one C function, which computes once what several of them contain."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

from llvmlite import ir
from numba.core.compiler_lock import global_compiler_lock

from .numba_bridge import Compiled, serial

__all__ = ["in_one_pass"]

# As `Wanted` in cpp/library.hpp, and the sums of these that the engine asks for.
DERIVATIVE, VALUES, GRADIENTS = 1, 2, 4
WANTED = (DERIVATIVE + VALUES + GRADIENTS, VALUES + GRADIENTS, DERIVATIVE + VALUES, VALUES)
NUMBER, STATUS = ir.DoubleType(), ir.IntType(32)
NUMBERS = NUMBER.as_pointer()
NOT_FILLED = ir.Constant(NUMBER, math.nan)


@lru_cache(maxsize=256)
def in_one_pass(rhs: Compiled, inv: tuple[Compiled, ...], grad: tuple[Compiled, ...]) -> tuple[int, Any]:
    """Return the address of a C function of the signature `AllPointer` in cpp/library.hpp, and the owner of its code.

    It calls a right-hand side, or an acceleration, invariants and their gradients, and returns 0, or another number if
    one of them raises. The optimizer sees them all, and that the arrays do not overlap. The values have the same bits
    as those of the functions one by one. Entries that a function leaves as they are become NaN.
    """
    name = f"eip_scipy.{next(serial)}"
    library = rhs.library.codegen.create_library(name)
    module = library.create_ir_module(name)
    function = ir.Function(module, ir.FunctionType(STATUS, [NUMBER, *[NUMBERS] * 5, STATUS]), name)
    t, y, f, values, G, params, wanted = function.args
    for array in (y, f, values, G, params):
        array.add_attribute("noalias")
    builder = ir.IRBuilder(function.append_basic_block())
    n = inv[0].kind.size
    velocities = n - rhs.kind.size  # the first components of the derivative if `rhs` is an acceleration
    state = builder.alloca(NUMBER, n)  # a function may change its argument

    def place(array: Any, k: int) -> Any:
        return builder.gep(array, [STATUS(k)])

    def copy(array: Any, first: int, out: Any, count: int) -> None:
        for k in range(count):
            builder.store(builder.load(place(array, first + k)), place(out, k))

    def call(parts: tuple[Compiled, ...], out: Any, first: int = 0) -> None:
        for part in parts:
            copy(y, 0, state, n)
            size = math.prod(part.kind.shape)
            for k in range(first, first + size):
                builder.store(NOT_FILLED, place(out, k))
            states = [state] * (1 + part.kind.gradient)
            kind = ir.FunctionType(STATUS, [NUMBER, *[NUMBERS] * (len(states) + 2)])
            known = module.globals.get(part.library.name) or ir.Function(module, kind, part.library.name)
            status = builder.call(known, [t, *states, place(out, first), params])
            with builder.if_then(builder.icmp_signed("!=", status, STATUS(0)), likely=False):
                builder.ret(status)
            first += size

    switch = builder.switch(wanted, function.append_basic_block())
    for those in WANTED:
        builder.position_at_end(function.append_basic_block())
        switch.add_case(STATUS(those), builder.block)
        if those & DERIVATIVE:
            copy(y, n - velocities, f, velocities)
            call((rhs,), f, velocities)
        if those & VALUES:
            call(inv, values)
        if those & GRADIENTS:
            call(grad, G)
        builder.ret(STATUS(0))
    builder.position_at_end(switch.default)
    builder.ret(STATUS(-1))
    with global_compiler_lock:
        library.add_ir_module(module)
        for owner in {part.library for part in (rhs, *inv, *grad)}:
            library.add_linking_library(owner)
        library.finalize()
    return library.get_pointer_to_function(name), library
