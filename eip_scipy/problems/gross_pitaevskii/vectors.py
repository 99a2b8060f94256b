"""Eight neighbouring points of a field in vector registers: loads, stores and the exchange of rows and columns.

Fields are flat float views (Re, Im, Re, Im ...); eight complex numbers become two octets (see `_octets`), one of the
real and one of the imaginary parts.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba import config, njit, types
from numba.extending import intrinsic

from ..._octets import LANES, OCTET, VECTOR, octets, spread

__all__ = ["aligned", "larger", "load", "load_pair", "octets", "spread", "store_pair", "transpose"]

EVEN, ODD = tuple(range(0, 2 * LANES, 2)), tuple(range(1, 2 * LANES, 2))
LOW, HIGH = (0, 8, 1, 9, 2, 10, 3, 11), (4, 12, 5, 13, 6, 14, 7, 15)
# Of rows k and k + 1, k + 2 and k + 4: which entries go into the first and the second after the exchange.
EXCHANGES = (
    (1, (0, 8, 2, 10, 4, 12, 6, 14), (1, 9, 3, 11, 5, 13, 7, 15)),
    (2, (0, 1, 8, 9, 4, 5, 12, 13), (2, 3, 10, 11, 6, 7, 14, 15)),
    (4, (0, 1, 2, 3, 8, 9, 10, 11), (4, 5, 6, 7, 12, 13, 14, 15)),
)


def aligned(*shape: int) -> np.ndarray:
    """Zeros that begin at a multiple of an octet's size, which a load or store then meets in one cache line."""
    size = 8 * LANES
    raw = np.zeros(8 * int(np.prod(shape)) + size, np.uint8)
    start = -raw.ctypes.data % size
    return raw[start : start + 8 * int(np.prod(shape))].view(float).reshape(shape)


def _address(context: Any, builder: Any, kind: Any, array: Any, i: Any) -> Any:  # emits LLVM
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [i]), VECTOR.as_pointer())


def _choose(builder: Any, a: Any, b: Any, order: Sequence[int]) -> Any:  # emits LLVM
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(ir.IntType(32), LANES), list(order)))


def _next(builder: Any, i: Any) -> Any:  # emits LLVM
    return builder.add(i, ir.Constant(i.type, LANES))


@intrinsic  # emits LLVM
def load(typingctx, a, i):
    """The octet a[i] ... a[i + 7]."""

    def codegen(context, builder, sig, args):
        return builder.load(_address(context, builder, sig.args[0], *args), align=8)

    return OCTET(a, types.intp), codegen


@intrinsic  # emits LLVM
def load_pair(typingctx, a, i):
    """Real and imaginary parts of the eight complex numbers from the float a[i] on."""

    def codegen(context, builder, sig, args):
        array, i = args
        low, high = (
            builder.load(_address(context, builder, sig.args[0], array, k), align=8) for k in (i, _next(builder, i))
        )
        parts = [_choose(builder, low, high, order) for order in (EVEN, ODD)]
        return context.make_tuple(builder, sig.return_type, parts)

    return types.UniTuple(OCTET, 2)(a, types.intp), codegen


@intrinsic  # emits LLVM
def store_pair(typingctx, re, im, a, i):
    """Store eight complex numbers from the float a[i] on."""

    def codegen(context, builder, sig, args):
        re, im, array, i = args
        for order, k in ((LOW, i), (HIGH, _next(builder, i))):
            place = _address(context, builder, sig.args[2], array, k)
            builder.store(_choose(builder, re, im, order), place, align=8)
        return context.get_dummy_value()

    return types.void(OCTET, OCTET, a, types.intp), codegen


@intrinsic  # emits LLVM
def transpose(typingctx, rows):
    """Rows and columns of an 8 x 8 block, a tuple of eight octets, exchanged."""

    def codegen(context, builder, sig, args):
        block = [builder.extract_value(args[0], k) for k in range(LANES)]
        for distance, first, second in EXCHANGES:
            for k in range(LANES):
                if k & distance == 0:
                    a, b = block[k], block[k + distance]
                    block[k] = _choose(builder, a, b, first)
                    block[k + distance] = _choose(builder, a, b, second)
        return context.make_tuple(builder, sig.return_type, block)

    return types.UniTuple(OCTET, LANES)(rows), codegen


@njit(error_model="numpy", forceinline=True)
def larger(a, b):
    """The larger one of two octets, lane by lane."""
    return max(a, b)


if config.DISABLE_JIT:  # octets are arrays of eight, or numbers for eight alike

    def octets(array, column):
        """The octets of (n, 8)."""
        return array

    def spread(number):
        """A number as an octet."""
        return number

    def load(a, i):
        """The octet a[i] ... a[i + 7]."""
        return a[i : i + LANES]

    def load_pair(a, i):
        """Real and imaginary parts of eight complex numbers."""
        return a[i : i + 2 * LANES : 2], a[i + 1 : i + 2 * LANES : 2]

    def store_pair(re, im, a, i):
        """Store eight complex numbers."""
        a[i : i + 2 * LANES : 2], a[i + 1 : i + 2 * LANES : 2] = re, im

    def transpose(rows):
        """Rows and columns of an 8 x 8 block exchanged."""
        return tuple(np.array(rows).T)

    larger = np.maximum
