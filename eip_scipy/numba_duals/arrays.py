"""Copies of jitted functions for dual numbers, in which new arrays hold duals too.

`np.empty(3)` is an array of floats, which cannot hold duals, and Numba replaces `np.array([a, b])` before it looks for
an overload with duals. In a copy of the user's function, and of the functions that it calls, these names refer to the
functions of this module.
"""

from __future__ import annotations

import types as python_types
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import numpy as np
from numba import njit, types
from numba.core.errors import TypingError
from numba.core.typing.templates import AttributeTemplate, infer_getattr
from numba.extending import is_jitted, overload

from .numbers import Dual

__all__ = ["for_duals", "inside", "refuse_addresses"]

# Options of Numba that a copy takes over, because they change its results or its speed.
KEPT = ("fastmath", "error_model", "boundscheck", "inline", "forceinline")
MOST_DIMENSIONS = 4  # of arrays whose addresses are refused
# Compiles functions that only compiled code calls, because arrays of duals cannot be passed to or from Python.
inside = partial(njit, no_cpython_wrapper=True, no_cfunc_wrapper=True)


class _NumPy(python_types.ModuleType):
    """Module that has the attributes `others`, and takes all further ones from NumPy."""

    def __init__(self, others: dict[str, Any]) -> None:
        super().__init__("numpy")
        self.__dict__.update(others)

    def __getattr__(self, name: str) -> Any:
        return getattr(np, name)


def for_duals(fun: Any, dual: Dual) -> Any:
    """Return a copy of a jitted function, and of those that it calls, in which new arrays hold numbers of `dual`."""
    by_name = _array_functions(dual)
    others = {id(getattr(np, name)): function for name, function in by_name.items()}
    return _replaced(fun, others | {id(np): _NumPy(by_name)}, dual)


def _replaced(item: Any, others: dict[int, Any], dual: Dual) -> Any:
    """Return the replacement of a global or closure variable in a copied function, or the variable if there is none.

    `others` maps the id of each object to its replacement. Copies of jitted functions are added to it. A function with
    an attribute ``for_duals(dual)`` is replaced by what this attribute returns.
    """
    if id(item) in others or not is_jitted(item):
        return others.get(id(item), item)
    source = item.py_func
    if (own := getattr(source, "for_duals", None)) is not None:
        others[id(item)] = own(dual)
        return others[id(item)]
    names, cells = source.__globals__.copy(), [python_types.CellType() for _ in source.__closure__ or ()]
    copied = python_types.FunctionType(source.__code__, names, source.__name__, source.__defaults__, tuple(cells))
    others[id(item)] = inside(copied, **{name: item.targetoptions[name] for name in KEPT if name in item.targetoptions})
    # The copy is registered before its names are replaced, because a function may call itself.
    for name in _names(source.__code__) & names.keys():
        names[name] = _replaced(names[name], others, dual)
    for cell, known in zip(cells, source.__closure__ or (), strict=True):
        cell.cell_contents = _replaced(known.cell_contents, others, dual)
    return others[id(item)]


def _names(code: python_types.CodeType) -> set[str]:
    """Return the names of globals and attributes in the code of a function and of its inner functions."""
    inside = (_names(item) for item in code.co_consts if isinstance(item, python_types.CodeType))
    return set(code.co_names).union(*inside)


def _of_floats(dtype: Any) -> bool:
    """Return True if a dtype argument, as typed by Numba, means floats or is missing."""
    if isinstance(dtype, types.NumberClass):
        return isinstance(dtype.dtype, types.Float)
    return not (isinstance(dtype, types.Function) and dtype.typing_key is not float)


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


@cache
def _array_functions(dual: Dual) -> dict[str, Callable[..., Any]]:
    """Return replacements of NumPy's functions by name, for compiled code, whose new arrays hold `dual` for floats."""

    def empty(shape, dtype=float):
        pass

    def zeros(shape, dtype=float):
        pass

    def ones(shape, dtype=float):
        pass

    for name, function in (("empty", empty), ("zeros", zeros)):
        _overload_maker(function, getattr(np, name), dual)

    @overload(ones)
    def _ones(shape, dtype=float):
        def filled(shape, dtype=float):
            out = np.empty(shape, dual)
            for i in range(out.size):
                out.flat[i] = 1.0
            return out

        return filled if _of_floats(dtype) else lambda shape, dtype=float: np.ones(shape, dtype)

    refuse_addresses(dual, "dual numbers")
    return {"empty": empty, "zeros": zeros, "ones": ones, "array": array, "cross": cross}


def _overload_maker(function: Any, numpy_function: Any, dual: Dual) -> None:
    @overload(function)
    def typed(shape, dtype=float):
        if _of_floats(dtype):
            return lambda shape, dtype=float: numpy_function(shape, dual)
        return lambda shape, dtype=float: numpy_function(shape, dtype)


def array(object):
    """Return what `np.array` returns, also for lists and tuples that contain duals; for compiled code only."""


def cross(a, b):
    """Return what `np.cross` returns, also for two vectors (3,) that contain duals; for compiled code only."""


@overload(array)
def _array(object):
    sequences = types.List | types.UniTuple
    inner = getattr(object, "dtype", None)
    if isinstance(object, sequences) and isinstance(inner, Dual):
        dual = inner

        def of_numbers(object):
            out = np.empty(len(object), dual)
            for i in range(len(object)):
                out[i] = object[i]
            return out

        return of_numbers
    if isinstance(object, sequences) and isinstance(inner, sequences) and isinstance(inner.dtype, Dual):
        dual = inner.dtype

        def of_rows(object):
            out = np.empty((len(object), len(object[0])), dual)
            for i in range(out.shape[0]):
                for j in range(out.shape[1]):
                    out[i, j] = object[i][j]
            return out

        return of_rows
    return lambda object: np.array(object)


@overload(cross)
def _cross(a, b):
    duals = [k.dtype for k in (a, b) if isinstance(k, types.Array) and isinstance(k.dtype, Dual)]
    if not duals or not (a.ndim == b.ndim == 1):
        return (lambda a, b: np.cross(a, b)) if not duals else None
    dual = duals[0]

    def of_vectors(a, b):
        if a.size != 3 or b.size != 3:
            raise ValueError("np.cross: vectors of three components are expected")
        out = np.empty(3, dual)
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            out[i] = a[j] * b[k] - a[k] * b[j]
        return out

    return of_vectors
