"""The step in C++: the build of it that this processor takes, and a user's functions as it takes them."""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

__all__ = [
    "BUILD",
    "Call",
    "Engine",
    "FailedCallError",
    "Hooks",
    "LibraryFunction",
    "NativeFunctions",
    "OctetFunctions",
    "PythonFunctions",
    "Rates",
    "call",
    "library",
    "library_function",
]

# Names one of the builds, _native or _native_v3, in place of the best one that the processor takes.
VARIABLE = "EIP_SCIPY_ENGINE"
AGAIN = "python -m pip install --no-build-isolation --no-deps --editable ."


class Call(NamedTuple):
    """A user's function in Python: ``fun(t, y[, f][, out], *args)``.

    Its value is taken as it is where it is an array of that shape (a float for ``()``), of the state's type or, where
    it is `real`, of floats; else ``convert(value, t)`` makes such an array of it, or raises.
    """

    fun: Callable[..., Any]
    args: tuple[Any, ...]
    shape: tuple[int, ...]
    convert: Callable[[Any, float], np.ndarray]
    real: bool = False
    takes_f: bool = False
    in_place: bool = False


def call(fun: Callable[..., Any], args: tuple[Any, ...], shape: tuple[int, ...], convert: Any, **kind: bool) -> Call:
    """A `Call` with as many further arguments as there are."""
    if len(args) > BUILD.MOST_ARGUMENTS:
        return Call(lambda *first: fun(*first, *args), (), shape, convert, **kind)
    return Call(fun, args, shape, convert, **kind)


class Rates(NamedTuple):
    """The rates at which the balances of a run change.

    Attributes
    ----------
    items : tuple of (int, int)
        Of each balance its place among the functions of the invariants, and the number of its values.
    functions : tuple
        Of each balance its rate, as a `Call` or by its address. None: the rate of the gradient along the flow, and of
        the explicit dependence on time.
    low, high, shift : float
        The interval within which derivatives in time are taken, and by what shifts.
    """

    items: tuple[tuple[int, int], ...] = ()
    functions: tuple[Any, ...] = ()
    low: float = 0.0
    high: float = 0.0
    shift: float = 0.0


class PythonFunctions(NamedTuple):
    """A run's functions in Python; `second_order`: `rhs` gives the accelerations of (q, v)."""

    rhs: Call
    inv: tuple[Call, ...]
    grad: tuple[Call, ...]
    event: tuple[Call, ...]
    second_order: bool
    jacobian: Call | None = None
    rates: Rates = Rates()
    native: bool = False


class NativeFunctions(NamedTuple):
    """A run's functions by their addresses, with the signatures in cpp/system.hpp; `owner` keeps them alive.

    A function of the library's stands for itself. Of each invariant, gradient and event the address, and how many
    floats it fills. `python`: the functions in Python,
    of which the events are called; there are none by address then. None for a gradient: by differences, with shifts in
    units of the size of a component and of its floor, `floors` (n,).
    """

    rhs: Any
    inv: tuple[tuple[Any, int], ...]
    grad: tuple[tuple[Any, int], ...]
    event: tuple[tuple[Any, int], ...]
    params: np.ndarray
    second_order: bool
    owner: Any
    python: PythonFunctions | None = None
    jacobian: Any = None
    floors: np.ndarray | None = None
    rates: Rates = Rates()
    native: bool = True


class OctetFunctions(NamedTuple):
    """The same functions for eight members of an ensemble: for each number of their arrays there are eight."""

    rhs: Any
    inv: tuple[tuple[Any, int], ...]
    grad: tuple[tuple[Any, int], ...]
    owner: Any
    jacobian: Any = None


class Hooks(NamedTuple):
    """Parts of a step in Python, in place of the engine's own.

    ``one_step(t, y, h)`` fills work.y_hat, and work.err if it `estimates`. If it `drives`, it is
    ``one_step(t, y, again)`` of a solver that controls its own error: it fills work.K too, and returns the end of its
    step and the length of the next one, or None where no step is short enough; `again`: in place of the last one, and
    shorter. ``project(t_old, t, last, y_new)`` projects work.y_hat and returns the engine's code. `joint` are
    `JointInvariants`, which come before that. ``agree(here)``: whether the raw result is finite on all processes that
    have a part of the state, as it is `here`.
    """

    one_step: Callable[..., Any] | None = None
    estimates: bool = False
    drives: bool = False
    project: Callable[..., Any] | None = None
    agree: Callable[..., Any] | None = None
    joint: Any = None


def _build(name: str) -> Any:
    try:
        return import_module(f"{__package__}.{name}")
    except ModuleNotFoundError:
        version = f"{sys.version_info.major}.{sys.version_info.minor}"
        raise ImportError(
            f"eip_scipy's engine is not built for Python {version} here ({Path(__file__).parent} has no {name}). In a "
            "clone of the sources: python -m pip install -e . ; else leave the clone's folder, or install the package."
        ) from None


def _best() -> Any:
    """The build that was asked for, or the best one that the processor takes."""
    if name := os.environ.get(VARIABLE):
        return _build(name)
    plain = _build("_native")
    return _build("_native_v3") if plain.HAS_V3 else plain


def _require_current(build: Any) -> None:
    """In a clone: the build is that of the sources beside it."""
    folder = Path(__file__).parent / "cpp"
    files = sorted(folder.rglob("*.?pp"))
    if files and hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest() != build.SOURCES:
        raise ImportError(f"the sources in {folder} have changed since the engine was built. Build it: {AGAIN}")


if TYPE_CHECKING:
    from . import _native as BUILD  # noqa: N812
else:
    BUILD = _best()
    _require_current(BUILD)
Engine = BUILD.Engine
FailedCallError = BUILD.FailedCallError
LibraryFunction = BUILD.LibraryFunction
library: dict[str, LibraryFunction] = BUILD.LIBRARY
"""The functions of the library's own problems that are in C++, by name."""


def library_function(name: str, own: Sequence[float] = ()) -> Any:
    """The function of that name, as it comes back from a pickle, with its `own` parameters, if it has any."""
    return library[name].bound(own) if own else library[name]
