"""C functions by pointer: `scipy.LowLevelCallable`, and function pointers of ctypes and of cffi."""

from __future__ import annotations

import ctypes
import re
import sys
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np

from .arguments import floats, scalars
from .inputs import reals, shown

__all__ = ["GRADIENT", "VALUE", "CFunctions", "PointerFunction", "address_hint", "by_pointer", "is_pointer"]

VALUE = "int (double t, const double *y, double *out, const double *params)"
GRADIENT = "int (double t, const double *y, const double *f, double *out, const double *params)"
TYPES = {  # as LowLevelCallable writes them, without spaces and const
    VALUE: "int(double,double*,double*,double*)",
    GRADIENT: "int(double,double*,double*,double*,double*)",
}
# Prototype with which Python calls C functions; the GIL is released, as in a run with native functions only.
PROTOTYPES = {
    kind: ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_double, *[ctypes.c_void_p] * types.count("*"))
    for kind, types in TYPES.items()
}
# The class of all function pointers of ctypes, under the name that its documentation gives.
FROM_CTYPES: Any = ctypes._CFuncPtr  # type: ignore[attr-defined]
_capsule_name = ctypes.PYFUNCTYPE(ctypes.c_char_p, ctypes.py_object)(("PyCapsule_GetName", ctypes.pythonapi))
_capsule_pointer = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.py_object, ctypes.c_char_p)(
    ("PyCapsule_GetPointer", ctypes.pythonapi)
)


@dataclass(frozen=True)
class CFunctions:
    """A C function by pointer, and its version for eight members of an ensemble; it can be used like a C function.

    Parameters
    ----------
    one, eight : LowLevelCallable, ctypes or cffi function pointer
        Both have the same signature, see :doc:`/tutorials/c-functions`. The arrays of `eight` have eight numbers, one
        for each member, in place of each number: component i of member k is ``y[8 * i + k]``, and the same applies to
        `f`, `out` and `params`; t is common to all members. The results must have the bits of those of `one`.

    Examples
    --------
    >>> from eip_scipy import ensemble
    >>> from eip_scipy.problems import CFunctions
    >>> ensemble(CFunctions(library.rhs, library.rhs_of_eight), (0, 1), starts, h=0.1)  # doctest: +SKIP
    """

    one: Any
    eight: Any


class PointerFunction:
    """A C function in a form that Python can call: ``(t, y[, f], out[, params])``, with f for gradients that use it.

    The pointer is stored, so that its function lives as long as this object. `name` is its name in messages, and `kind`
    the required signature. The engine always passes f to a gradient; without `takes_f` Python passes NaN. If `shape` is
    given, there is no argument `out`: a new array of this shape is returned, or a float for ``()``.
    """

    def __init__(
        self, pointer: Any, name: str, kind: str = VALUE, *, takes_f: bool = False, shape: tuple[int, ...] | None = None
    ) -> None:
        self.pointer, self.name, self.kind = pointer, name, kind
        self.takes_f, self.shape = takes_f, shape
        both = isinstance(pointer, CFunctions)
        self.address = _checked_address(pointer.one if both else pointer, name, kind)
        # Address of the function of eight members; 0 if there is none.
        self.octet_address = _checked_address(pointer.eight, f"{name} for eight members", kind) if both else 0
        self._function = PROTOTYPES[kind](self.address)

    def __call__(self, t: float, y: np.ndarray, *others: Any) -> Any:
        """Call the function; return its value if `shape` is given, else None.

        Entries of a returned value that the function does not fill are NaN. All entries of the value are NaN if the
        status is above 0. If it is below 0, a RuntimeError is raised.
        """
        rest = list(others)
        state = np.ascontiguousarray(y, complex if np.iscomplexobj(y) else float)
        given = [state]
        if self.kind == GRADIENT:
            f = rest.pop(0) if self.takes_f else np.full_like(state, np.nan)
            given.append(np.ascontiguousarray(f, state.dtype))
        out = rest.pop(0) if self.shape is None else np.full(self.shape, np.nan)
        numbers = reals("params", rest[0]) if len(rest) == 1 else floats(tuple(rest))
        if numbers is None or (len(rest) != 1 and scalars(tuple(rest)) is None):
            raise TypeError(
                f"{self.name} is a C function pointer: its arguments after t and y are numbers or one array of floats, "
                f"its params; it got {', '.join(map(shown, rest))}."
            )
        given += [out, np.ascontiguousarray(numbers)]
        status = self._function(t, *(array.ctypes.data for array in given))
        if status < 0:
            raise self.failure(t, status)
        if status > 0:
            out.fill(np.nan)
        if self.shape is None:
            return None
        return out if self.shape else float(out)

    def __reduce__(self) -> NoReturn:
        raise self.unpicklable()

    def unpicklable(self) -> TypeError:
        """Return the error for an attempt to pickle this function."""
        return TypeError(
            f"{self.name} is a C function by pointer, which cannot be pickled, because its address is not valid in "
            "another process. Use Python or Numba functions for ensembles on Dask or on processes."
        )

    def failure(self, t: float, status: int) -> RuntimeError:
        """Return the error for a call at `t` that returned the negative `status`."""
        return RuntimeError(f"{self.name} returned the status {status} at t={t:.10g}; a status below 0 ends the run.")


def is_pointer(fun: Any) -> bool:
    """Return True if a function is a C function pointer; it cannot be SciPy's or cffi's if these are not imported."""
    return isinstance(fun, (CFunctions, FROM_CTYPES)) or _is_low_level(fun) or _is_of_cffi(fun)


def by_pointer(fun: Any, name: str, kind: str = VALUE, **form: Any) -> Any:
    """Return a C function pointer as a `PointerFunction` with the keywords `form`; return anything else unchanged.

    Raise TypeError for an object of ``numba.cfunc``: Python could call it, but not with the arguments it is made for.
    """
    return PointerFunction(fun, name, kind, **form) if is_pointer(fun) or _is_cfunc(fun) else fun


def address_hint(fun: Any) -> str:
    """Return the end of a message: a hint if `fun` is an integer, such as an address, or a Numba cfunc, else ""."""
    if _is_cfunc(fun):
        return f"; give the pointer that it holds, {fun.__name__}.ctypes, or compile the function with numba.njit"
    if isinstance(fun, bool) or not isinstance(fun, (int, np.integer)):
        return ""
    return "; an address does not contain the signature: give a ctypes or cffi pointer, or a scipy.LowLevelCallable"


def _is_cfunc(fun: Any) -> bool:
    return "numba.core.ccallback" in sys.modules and isinstance(fun, sys.modules["numba.core.ccallback"].CFunc)


def _is_low_level(fun: Any) -> bool:
    return "scipy" in sys.modules and isinstance(fun, sys.modules["scipy"].LowLevelCallable)


def _is_of_cffi(fun: Any) -> bool:
    return "_cffi_backend" in sys.modules and isinstance(fun, sys.modules["_cffi_backend"].FFI.CData)


def _checked_address(pointer: Any, name: str, kind: str) -> int:
    if isinstance(pointer, CFunctions) or not is_pointer(pointer):
        raise TypeError(f"{name} must be a C function by pointer, got {pointer!r}{address_hint(pointer)}.")
    address = _address(pointer)
    if not address:
        raise TypeError(f"{name} is a null pointer, expected {kind}.")
    found = _signature(pointer)
    if re.sub(r"\bconst\b|\s", "", found) != TYPES[kind]:
        raise TypeError(f"{name} is a C function of the signature {found!r}, expected {kind}.")
    if _is_low_level(pointer) and pointer.user_data is not None:
        raise TypeError(f"{name} is a LowLevelCallable with user_data, which is not supported; pass it as params.")
    return address


def _signature(pointer: Any) -> str:
    if isinstance(pointer, FROM_CTYPES) and pointer.argtypes is None:
        return "unknown: its argtypes are not set"
    from scipy import LowLevelCallable

    return str((pointer if _is_low_level(pointer) else LowLevelCallable(pointer)).signature)


def _address(pointer: Any) -> int:
    if isinstance(pointer, FROM_CTYPES):
        return ctypes.cast(pointer, ctypes.c_void_p).value or 0
    if _is_of_cffi(pointer):
        from cffi import FFI

        return int(FFI().cast("uintptr_t", pointer))
    if _is_low_level(pointer):
        return _address(pointer.function)
    return int(_capsule_pointer(pointer, _capsule_name(pointer)))
