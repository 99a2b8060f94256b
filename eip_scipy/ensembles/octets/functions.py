"""A user's Numba functions for eight members, by C pointers: arrays of n octets are (n, 8) doubles."""

from __future__ import annotations

from ...core.numba_pointers import Compiled, compiled
from .type import OCTET

__all__ = ["compiled_for_octets"]


def compiled_for_octets(one: Compiled) -> Compiled:
    """The function of one member, compiled for eight.

    Raises
    ------
    NotCompilableError
        Where it branches on values, makes arrays, or does something else that octets cannot.
    """
    return compiled(one.fun, one.kind, one.name, OCTET)
