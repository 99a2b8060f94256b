"""Refusal of addresses of arrays whose numbers are not floats, when a user's function is compiled for such arrays."""

from __future__ import annotations

from typing import Any

from numba import types
from numba.core.errors import TypingError
from numba.core.typing.templates import AttributeTemplate, infer_getattr

__all__ = ["refuse_addresses"]

MOST_DIMENSIONS = 4


def refuse_addresses(kind: Any, name: str) -> None:
    """Make the use of ``array.ctypes`` an error in functions compiled for arrays of the Numba type `kind`.

    C code would read the memory of such an array as floats. `name` describes the numbers in the error.
    """
    for ndim in range(1, MOST_DIMENSIONS + 1):
        addresses = types.ArrayCTypes(types.Array(kind, ndim, "C"))  # Numba has one object for all layouts
        addresses.can_convert_to = lambda context, other: None

        @infer_getattr
        class _Refusal(AttributeTemplate):  # a template for one type replaces those for its class
            key = addresses

            def generic_resolve(self, kind: Any, attribute: str) -> None:
                raise TypingError(f"Cannot give C code the address of an array of {name}")
