"""The engine in C++: the build for this processor, and the forms in which it accepts a user's functions."""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

__all__ = [
    "BUILD", "BatchFunctions", "Call", "Engine", "FailedCallError", "Hooks", "LibraryFunction", "NativeFunctions",
    "PythonFunctions", "Rates", "call", "library", "library_function", "working_alone",
]  # fmt: skip

# Names one of the builds, _native or _native_v3, to use instead of the best one for the processor.
VARIABLE = "EIP_SCIPY_ENGINE"
AGAIN = "python -m pip install --no-build-isolation --no-deps --editable ."


class Call(NamedTuple):
    """A user's function in Python: ``fun(t, y[, f][, out], *args)``.

    `fun` receives the derivative f of the state if `takes_f`, and fills `out` if `in_place`. Otherwise its value is
    used directly if it is an array of the shape `shape` (a float for ``()``) and of the dtype of the state (float if
    `real`). ``convert(value, t)`` converts any other value to such an array, or raises an error.

    The C function `compiled` (see `ByAddress` in `core.functions`) is called instead of `fun` if there is one. `fun` is
    called if the C function returns another status than 0.
    """

    fun: Callable[..., Any]
    args: tuple[Any, ...]
    shape: tuple[int, ...]
    convert: Callable[[Any, float], np.ndarray]
    real: bool = False
    takes_f: bool = False
    in_place: bool = False
    compiled: Any = None


def call(fun: Callable[..., Any], args: tuple[Any, ...], shape: tuple[int, ...], convert: Any, **kind: Any) -> Call:
    """Return a `Call` of ``fun(t, y, ..., *args)``; if the engine does not accept as many `args`, Python adds them."""
    if len(args) > BUILD.MOST_ARGUMENTS:
        return Call(lambda *first: fun(*first, *args), (), shape, convert, **kind)
    return Call(fun, args, shape, convert, **kind)


class Rates(NamedTuple):
    """The rates at which the balances of a run change.

    `functions` has for each balance its rate, as a `Call`, an address or a `LibraryFunction`. If it is None, the rate
    is computed from the gradient along the flow and from the explicit dependence on time, by finite differences with
    the `shift` of the time, in the interval from `low` to `high`.
    """

    items: tuple[tuple[int, int], ...] = ()  # of each balance: index among the invariants' functions, number of values
    functions: tuple[Any, ...] = ()
    low: float = 0.0
    high: float = 0.0
    shift: float = 0.0


class PythonFunctions(NamedTuple):
    """The functions of a run in Python. If `second_order`, the state is (q, v) and `rhs` returns the accelerations.

    `inv`, `grad` and `event` are the invariants, their gradients and the event functions. `jacobian` computes the
    Jacobian of the accelerations times a vector. `native` is False here and True in `NativeFunctions`; the engine tells
    the two classes apart by it.
    """

    rhs: Call
    inv: tuple[Call, ...]
    grad: tuple[Call, ...]
    event: tuple[Call, ...]
    second_order: bool
    jacobian: Call | None = None
    rates: Rates = Rates()
    native: bool = False


class NativeFunctions(NamedTuple):
    """The addresses of the functions of a run, with the signatures in cpp/system.hpp; `keepalive` keeps them alive.

    A function of the library is a `LibraryFunction` instead of an address. Each invariant, gradient and event is a
    pair: the address, and the number of floats that the function fills. If the address of a gradient is None, the
    gradient is computed by differences, with a shift of each component that is proportional to the sum of the absolute
    value of the component and its entry of `floors` (n,). `python` contains the functions in Python if events are
    called from Python; then `event` is empty. `by_parameters` are the derivatives of each invariant with respect to the
    parameters whose columns of derivatives follow the state. `together` is the address of one C function that computes
    the derivative, all invariants and all gradients, see ``Wanted`` in cpp/library.hpp, or None.
    """

    rhs: Any
    inv: Sequence[tuple[Any, int]]
    grad: Sequence[tuple[Any, int]]
    event: Sequence[tuple[Any, int]]
    params: np.ndarray
    second_order: bool
    keepalive: Any
    python: PythonFunctions | None = None
    jacobian: Any = None
    floors: np.ndarray | None = None
    rates: Rates = Rates()
    by_parameters: Sequence[tuple[Any, int]] = ()
    together: int | None = None
    native: bool = True


class BatchFunctions(NamedTuple):
    """Functions that compute eight members of an ensemble at once; their arrays hold eight numbers in place of one."""

    rhs: Any
    inv: tuple[tuple[Any, int], ...]
    grad: tuple[tuple[Any, int], ...]
    keepalive: Any
    jacobian: Any = None


class Hooks(NamedTuple):
    """Parts of a step in Python, which replace those of the engine.

    ``one_step(t, y, h)`` fills work.y_hat, and work.err if `estimates` is True. If `drives` is True, it is instead
    ``one_step(t, y, again)`` of a solver that controls its own error: it fills work.K too, and returns the end of its
    step and the length of the next one, or None if no step is short enough. If `again` is True, it repeats the last
    step with a shorter length. `joint` are invariants with functions `moments` and `shift`, which are tried before the
    engine's own projection.
    """

    one_step: Callable[..., Any] | None = None
    estimates: bool = False
    drives: bool = False
    joint: Any = None


def _build(name: str) -> Any:
    try:
        return import_module(f"{__package__}.{name}")
    except ModuleNotFoundError:
        version = f"{sys.version_info.major}.{sys.version_info.minor}"
        raise ImportError(
            f"the engine of eip_scipy is not built for Python {version} here ({Path(__file__).parent} has no {name}). "
            "In a clone of the sources, run python -m pip install -e . ; otherwise leave the folder of the clone, or "
            "install the package."
        ) from None


def _require_current(build: Any) -> None:
    """Raise ImportError in a clone whose sources have changed since the engine was built."""
    folder = Path(__file__).parent / "cpp"
    files = sorted(folder.rglob("*.?pp"))
    if files and hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest() != build.SOURCES:
        raise ImportError(f"the sources in {folder} have changed since the engine was built. Build it again: {AGAIN}")


if TYPE_CHECKING:
    from . import _native as BUILD  # noqa: N812
else:
    BUILD = _build(os.environ.get(VARIABLE) or "_native")
    if BUILD.HAS_V3 and not os.environ.get(VARIABLE):  # the best one for the processor
        BUILD = _build("_native_v3")
    _require_current(BUILD)
_processes = sys.modules.get("multiprocessing.process")
if _processes is not None and _processes.parent_process() is not None and "OMP_NUM_THREADS" not in os.environ:
    BUILD.end_threads()  # in a worker of `multiprocessing`: there are usually as many of these as processors


@contextmanager
def working_alone() -> Iterator[None]:
    """Return a context in which the calling thread computes sums over many bodies alone, without other threads."""
    before = BUILD.work_alone(True)
    try:
        yield
    finally:
        BUILD.work_alone(before)


Engine = BUILD.Engine
FailedCallError = BUILD.FailedCallError
LibraryFunction = BUILD.LibraryFunction
library: dict[str, LibraryFunction] = BUILD.LIBRARY
"""The functions in C++ of the problems in `eip_scipy.problems`, by name."""


def library_function(name: str, own: Sequence[float] = ()) -> Any:
    """Return the library's function `name`, with its `own` parameters if it has any; unpickling calls this function."""
    return library[name].bound(own) if own else library[name]
