"""C functions as `scipy.LowLevelCallable`, which wraps pointers of ctypes and of cffi, and functions of Cython."""

from __future__ import annotations

import ctypes
import re
import sys
from typing import Any, NoReturn

import numpy as np

from .arguments import floats, scalars
from .inputs import reals, shown

__all__ = ["GRADIENT", "VALUE", "PointerFunction", "by_pointer", "is_pointer"]

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
# Modules of the classes of pointers that are not wrapped in a LowLevelCallable, and of the functions of numba.cfunc.
NUMBA = "numba.core.ccallback"
BARE = {"ctypes", "_ctypes", "_cffi_backend", NUMBA}
_capsule_pointer = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.py_object, ctypes.c_char_p)(
    ("PyCapsule_GetPointer", ctypes.pythonapi)
)


class PointerFunction:
    """A C function in a form that Python can call: ``(t, y[, f], out[, params])``, with f for gradients that use it.

    The `pointer`, a LowLevelCallable, is stored, so that its function lives as long as this object. `name` is its name
    in messages, and `kind` the required signature. The engine always passes f to a gradient; without `takes_f` Python
    passes NaN. If `shape` is given, there is no argument `out`: a new array of this shape is returned, or a float for
    ``()``.
    """

    def __init__(
        self, pointer: Any, name: str, kind: str = VALUE, *, takes_f: bool = False, shape: tuple[int, ...] | None = None
    ) -> None:
        if re.sub(r"\bconst\b|\s", "", pointer.signature) != TYPES[kind]:
            raise TypeError(f"{name} is a C function of the signature {pointer.signature!r}, expected {kind}.")
        if pointer.user_data is not None:
            raise TypeError(f"{name} is a LowLevelCallable with user_data, which is not supported; pass it as params.")
        self.pointer, self.name, self.kind = pointer, name, kind
        self.takes_f, self.shape = takes_f, shape
        # The first item of this tuple is the capsule of the pointer, whose name is the signature.
        self.address = _capsule_pointer(tuple.__getitem__(pointer, 0), pointer.signature.encode())
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
                f"{self.name} is a C function: its arguments after t and y are numbers or one array of floats, "
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
    """Return True if `fun` is a `scipy.LowLevelCallable`; without SciPy imported it cannot be one."""
    return "scipy" in sys.modules and isinstance(fun, sys.modules["scipy"].LowLevelCallable)


def by_pointer(fun: Any, name: str, kind: str = VALUE, **form: Any) -> Any:
    """Return a `scipy.LowLevelCallable` as a `PointerFunction` with the keywords `form`; other functions unchanged.

    Raise TypeError for a pointer of ctypes or cffi, or an object of ``numba.cfunc``: Python could call it, but not with
    the arguments that it is made for.
    """
    if is_pointer(fun):
        return PointerFunction(fun, name, kind, **form)
    module = type(fun).__module__
    if module in BARE:
        given = f"{fun.__name__}.ctypes" if module == NUMBA else "pointer"
        raise TypeError(f"{name} is a bare C function, {shown(fun)}; wrap it: scipy.LowLevelCallable({given}).")
    return fun
