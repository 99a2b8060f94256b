"""Validation of numeric arguments; error messages name the argument."""

from __future__ import annotations

import datetime
import inspect
import math
from collections.abc import Callable, Sequence
from contextvars import ContextVar
from typing import Any

import numpy as np

from ..engine.native import BUILD

__all__ = [
    "as_vector", "converted_from_single", "count", "filled", "flag", "initial_state", "is_number",
    "numbers", "real_array", "reals", "require_arguments", "shown", "states",
]  # fmt: skip

PLAIN = frozenset((int, float, complex, str, bool, type(None), np.float64, np.complex128))
DATES = (datetime.date, datetime.timedelta, np.datetime64, np.timedelta64)
NO_UNITS = ("", "dimensionless")
SHOWN = 120
SINGLE = ("float32", "complex64")
READS = "reads its argument out, whose content is arbitrary, before filling it"
LARGEST_COUNT = 2**63 - 1  # largest 64-bit integer
# Names of the values of single precision that have been converted, while `converted_from_single` looks for them.
_singles: ContextVar[list[str] | None] = ContextVar("_singles", default=None)


def shown(value: Any) -> str:
    """Return a value as text for an error message: on one line, shortened if it is long."""
    try:
        text = " ".join(repr(value).split())
    except ValueError:  # an integer of thousands of digits
        text = f"a very long {type(value).__name__}"
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."


def numbers(name: str, value: Any) -> np.ndarray | None:
    """Return a value as a new array of float64 or complex128, or None if it does not consist of numbers.

    Objects that Python can convert, such as numbers of SymPy and mpmath, are converted. A TypeError that contains the
    argument's `name` is raised for dates and for values with a unit, because NumPy would silently drop the unit.
    """
    if type(value) is np.ndarray and value.dtype == float:
        return np.array(value, order="C")
    _refuse_units(name, value)
    if (singles := _singles.get()) is not None and _is_single(value):
        singles.append(name)
    try:
        found = np.asarray(value)
        if found.dtype.kind == "O":
            found = _converted(found)
    except (TypeError, ValueError, OverflowError):  # for instance rows of different lengths
        return None
    kind = found.dtype.kind
    return np.array(found, complex if kind == "c" else float, order="C") if kind in "fiubc" else None


def converted_from_single(evaluate: Callable[[], Any]) -> str:
    """Return the name of the first value of single precision that `numbers` converts in ``evaluate()``, or ""."""
    found: list[str] = []
    token = _singles.set(found)
    try:
        evaluate()
    finally:
        _singles.reset(token)
    return found[0] if found else ""


def _is_single(value: Any) -> bool:
    """Return True if an array or a number of NumPy, JAX or PyTorch has single precision, also one in a list."""
    if isinstance(value, list | tuple):
        return any(map(_is_single, value))
    return str(getattr(value, "dtype", "")).rpartition(".")[2] in SINGLE


def _converted(objects: np.ndarray) -> np.ndarray:
    """Return an array of Python objects as an array of floats, or of complex numbers if some are not real."""
    items = objects.ravel().tolist()
    if any(isinstance(item, str) for item in items):  # float would read the text
        raise TypeError
    try:
        is_complex = any(isinstance(item, np.complexfloating) for item in items)  # float would drop the imaginary part
        found = list(map(complex if is_complex else float, items))
    except TypeError:  # not all are real
        found = list(map(complex, items))
    return np.array(found).reshape(objects.shape)


def _refuse_units(name: str, value: Any, *, is_item: bool = False) -> None:
    """Raise a TypeError for a date or a number with a unit, also in lists, tuples and arrays of objects.

    Items of a sequence are converted by ``float``, which applies units without a dimension, such as m / km of astropy.
    """
    if type(value) in PLAIN or (type(value) is np.ndarray and value.dtype.kind in "fiubc"):
        return
    if type(value) in (list, tuple):
        if not PLAIN.issuperset(map(type, value)):
            for item in value:
                _refuse_units(name, item, is_item=True)
        return
    if isinstance(value, np.ndarray) and value.dtype.kind == "O":
        _refuse_units(name, value.ravel().tolist())
    unit = getattr(value, "unit", getattr(value, "units", None))
    is_date = isinstance(value, DATES) or hasattr(value, "jd1")  # a time of astropy
    is_date |= getattr(getattr(value, "dtype", None), "kind", "") in ("m", "M")
    dimension = getattr(unit, "physical_type", unit) if is_item else unit
    if is_date or (unit is not None and str(dimension) not in NO_UNITS):
        raise TypeError(
            f"{name}: {shown(value)} has a unit or is a date; expected plain numbers, in the units of the equations. "
            "Convert it first: eip_scipy.integrations.astropy.plain does this for the arguments of a problem."
        )


def reals(name: str, value: Any) -> np.ndarray | None:
    """Return a value as a new array of floats as `numbers` does, or None if it does not consist of real numbers."""
    found = numbers(name, value)
    return None if found is None or found.dtype.kind == "c" else found


def real_array(name: str, value: Any, error: type[Exception] = ValueError) -> np.ndarray:
    """Return a value as a new array of floats; raise `error` if it is not real, and TypeError if it has a unit."""
    found = reals(name, value)
    if found is None:
        raise error(f"{name} must be an array of numbers, got {shown(value)}; expected real ones.")
    return found


def is_number(value: Any, name: str = "") -> bool:
    """Return True if a value is a real number that a float can represent; False for a bool and for an array.

    With the `name` of an argument, a TypeError is raised if the value has a unit or is a date.
    """
    if type(value) is float:
        return True
    if name:
        _refuse_units(name, value)
    if isinstance(value, (bool, np.timedelta64)) or not isinstance(value, (int, float, np.integer, np.floating)):
        return False
    try:
        float(value)
    except OverflowError:  # an integer of hundreds of digits
        return False
    return True


def count(name: str, value: Any, most: int = LARGEST_COUNT) -> int:
    """Return the option `name` as an int; raise ValueError unless `value` is an integer from 1 to `most`."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, np.integer)) or value < 1:
        raise ValueError(f"{name} must be an integer >= 1, got {shown(value)}.")
    if value > most:
        raise ValueError(f"{name} must be at most {most}, got {shown(value)}.")
    return int(value)


def flag(name: str, value: Any) -> bool:
    """Return the option `name` as a bool; raise ValueError unless `value` is True or False."""
    if not isinstance(value, (bool, np.bool_)):
        raise ValueError(f"{name} must be True or False, got {shown(value)}.")
    return bool(value)


def require_arguments(fun: Callable[..., Any], given: Sequence[str], what: str, advice: str) -> None:
    """Raise a TypeError that explains a failed call if `fun` does not accept arguments with the names `given`.

    The message says with which arguments `what`, the name of the function, is called, and ends with `advice`, or with
    advice about the time if only the time is missing.
    """
    try:
        signature = inspect.signature(fun)
    except (TypeError, ValueError):  # some functions in C have no signature
        return
    if (error := _mismatch(signature, given)) is None:
        return
    names, first = ", ".join(given), next(iter(signature.parameters), "t")
    is_time = given[0] != "t" or first.strip("_").startswith("t")
    if not is_time and _mismatch(signature, given[1:]) is None:
        advice = f"The first argument is always the time: write lambda {names}: ..., or def name({names})."
    raise TypeError(f"{what} is called with ({names}): {error}. {advice}") from None


def _mismatch(signature: inspect.Signature, given: Sequence[str]) -> TypeError | None:
    """Return the error of a call with as many arguments as `given`, or None if the signature accepts them."""
    try:
        signature.bind(*given)
    except TypeError as error:
        return error
    return None


def as_vector(value: Any, n: int, dtype: np.dtype, came: str, t: float) -> np.ndarray:
    """Return the value of a user's function at t as an array (n,); `came` begins messages, as "fun returned"."""
    if value is None:
        raise TypeError(f"{came} None, expected {n} numbers, at t={t:.10g} (does it end without a return?).")
    a = numbers(came.removesuffix(":"), value)
    if a is None:
        raise TypeError(f"{came} {shown(value)}, expected {n} numbers, at t={t:.10g}.")
    if n == 1 and a.shape == ():
        a = a.reshape(1)
    if a.shape != (n,):
        raise ValueError(f"{came} shape {a.shape}, expected ({n},), at t={t:.10g}.")
    if a.dtype.kind == "c" and dtype.kind != "c":
        raise ValueError(f"{came} complex values at t={t:.10g}, but y0 is real; pass y0.astype(complex).")
    return a


def filled(call: Callable[[np.ndarray], Any], shape: tuple[int, ...], dtype: Any, what: str, t: float) -> np.ndarray:
    """Return the array of this shape and type that a user's in-place function fills; before, all entries are NaN.

    ``call(out)`` calls the function. An error is raised if it returns anything but None or the array itself, does not
    fill the whole array, or reads entries before it fills them. The message contains its name, `what`, and the time
    `t`.
    """
    out, ones = np.empty(shape, dtype), np.empty(shape, dtype)
    found, other = out.view(float), ones.view(float)
    found.fill(math.nan)
    returned = call(out)
    if returned is not None and not (isinstance(returned, np.ndarray) and np.may_share_memory(returned, out)):
        raise TypeError(
            f"{what} returned {shown(returned)}, but with in_place=True it must fill its argument out and return "
            f"nothing, at t={t:.10g}. Write out[:] = ..., or omit in_place=True."
        )
    if not np.isnan(found).any():
        return out
    other.fill(1.0)
    call(ones)
    unset = np.isnan(found) & (other == 1)
    wrong = unset if unset.any() else np.isnan(found) & ~np.isnan(other)
    if not wrong.any():
        return out
    *row, component = np.argwhere(wrong)[0].tolist()
    where = ", ".join(map(str, (*row, component * shape[-1] // found.shape[-1])))
    does = "does not fill all of its argument out" if wrong is unset else READS
    raise ValueError(f"{what} {does}, in component {where}, at t={t:.10g}.")


def initial_state(y0: Any, name: str = "y0") -> np.ndarray:
    """Return y0 as a new float64 or complex128 array (n,), with SciPy's error messages."""
    y = states(name, y0)
    if y.ndim != 1:
        raise ValueError(f"`{name}` must be 1-dimensional.")
    if not BUILD.are_finite(y.view(float)):
        raise ValueError(f"All components of the initial state `{name}` must be finite.")
    return y


def states(name: str, value: Any) -> np.ndarray:
    """Return a state, or several states, as a new float64 or complex128 array of any shape, after checks."""
    if np.ma.isMaskedArray(value) and np.ma.is_masked(value):
        raise ValueError(f"masked values in {name}; fill or drop them first.")
    found = numbers(name, value)
    if found is None:
        raise TypeError(f"`{name}` must hold numbers, got {shown(value)}.")
    return found
