"""C pointers to a user's Numba functions, compiled for eight members: an array of n floats becomes (n, 8) doubles."""

from __future__ import annotations

from ...core.numba_pointers import Compiled, compiled
from .type import OCTET

__all__ = ["compiled_for_octets"]


def compiled_for_octets(one: Compiled) -> Compiled:
    """Compile the function of `one` again, for eight members instead of one, and return it with its address.

    Raises
    ------
    NotCompilableError
        If the function branches on values, creates arrays, or does something else that vectors of members do not
        support.
    """
    return compiled(one.fun, one.kind, one.name, OCTET)
