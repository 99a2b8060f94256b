"""A user's functions: their last arguments, their form, and what the engine calls for them.

Functions are plain Python, jitted by Numba, C functions by pointer, or functions of the engine's library. Numba is not
imported here: before a user imports it, there are no jitted functions.
"""

from __future__ import annotations

import ctypes
import math
import re
import sys
from collections import defaultdict
from collections.abc import Callable, Mapping
from functools import cache, lru_cache
from importlib.util import find_spec
from itertools import chain
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn, cast

import numpy as np

from ..engine.native import Call, LibraryFunction, NativeFunctions, Rates
from .inputs import as_vector, filled, is_number, real_array, reals, shown

if TYPE_CHECKING:
    from .numba_bridge import Compiled
    from .runs import Run

__all__ = [
    "BY_NAME", "GRADIENT", "AccelerationField", "ChangedShapeError", "CompiledFunction", "Kind", "NotCompilableError",
    "PointerFunction", "are_same", "by_address", "by_pointer", "compilable", "compiled_like", "extra_arguments",
    "floats", "is_compiled", "is_jitted", "is_pointer", "jit_is_off", "jitted", "jitted_call", "names",
    "native_functions", "own_values", "parameter_values", "reraise_user_exception", "scalars", "without_gradient",
]  # fmt: skip

BY_NAME = (
    "pass it by name: integrate(acceleration=fun, t_span=..., y0=..., ...), or "
    "eip_scipy.solve_ivp(acceleration=fun, t_span=..., y0=..., ...)"
)
# States of at most this many components are so short that a call, and what functions share, take most of a step's time.
FEW = 12
EXACT = 2**53  # integers up to this one are exact as floats
# Signatures of C functions.
VALUE = "int (double t, const double *y, double *out, const double *params)"
GRADIENT = "int (double t, const double *y, const double *f, double *out, const double *params)"
# Modules of the classes of pointers that are not wrapped in a LowLevelCallable, and of the functions of numba.cfunc.
NUMBA = "numba.core.ccallback"
BARE = {"ctypes", "_ctypes", "_cffi_backend", NUMBA}
NO_DUALS = "a gradient is compiled only for jitted functions of real states"
_capsule_pointer = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.py_object, ctypes.c_char_p)(
    ("PyCapsule_GetPointer", ctypes.pythonapi)
)


class ChangedShapeError(ValueError):
    """A compiled function returned an array of another shape than at the start."""


class NotCompilableError(TypeError):
    """A run cannot be compiled; the message names the function and says why."""


def extra_arguments(args: Any, params: Any) -> tuple[Any, ...]:
    """Return the last arguments of the functions of a run as a tuple: `args`, ``(params,)``, or () if both are None."""
    if args is None:
        return () if params is None else (parameter_values(params).reshape(-1),)
    if params is not None:
        raise TypeError("give args or params, not both: each of them defines the last arguments of the functions.")
    try:
        found = tuple(args)
    except TypeError:
        raise TypeError(f"args must be a tuple, got {shown(args)}; write args=(x,) for a single argument.") from None
    return tuple(item.copy() for item in found) if _is_array(found) else found


def are_same(one: tuple[Any, ...], other: tuple[Any, ...]) -> bool:
    """Return True if two tuples have the same length and their items are pairwise the same object, or equal numbers."""
    return len(one) == len(other) and all(a is b or np.array_equal(a, b) for a, b in zip(one, other, strict=True))


def parameter_values(params: Any) -> np.ndarray:
    """Return `params` as a new array of floats; raise TypeError if they are not numbers, for instance a mapping."""
    if isinstance(params, Mapping):
        raise TypeError(
            f"params must be an array of numbers, got {shown(params)}. Give the values in the order in which fun reads "
            "them, params=[1.0, 2.0], or pass the mapping as args=(mapping,); fun is then called from Python. Problems "
            "made by hamiltonian or equations accept a mapping from names to values."
        )
    return real_array("params", params, TypeError)


def scalars(extra: tuple[Any, ...]) -> str | None:
    """Return the types of further arguments that are numbers: "d" for a float, "q" for an integer, "?" for a bool.

    Return "" for one array of floats or no argument, and None for arguments that only Python can pass.
    """
    types = ""
    for item in () if _is_array(extra) else extra:
        if isinstance(item, (bool, np.bool_)):
            types += "?"
        elif not is_number(item) or (isinstance(item, (int, np.integer)) and abs(int(item)) > EXACT):
            return None
        else:
            types += "q" if isinstance(item, (int, np.integer)) else "d"
    return types


def floats(extra: tuple[Any, ...]) -> np.ndarray:
    """Return further arguments as an array of floats for native functions; it is empty if only Python can pass them."""
    return extra[0] if _is_array(extra) else np.array(extra if scalars(extra) else (), float)


def names(extra: tuple[Any, ...]) -> tuple[str, ...]:
    """Return the names of the further arguments in messages: "params" for one array, else "args[0]", "args[1]", ..."""
    return ("params",) if _is_array(extra) else tuple(f"args[{k}]" for k in range(len(extra)))


def _is_array(extra: tuple[Any, ...]) -> bool:
    """Return True if the further arguments are one array of floats."""
    return len(extra) == 1 and type(extra[0]) is np.ndarray and extra[0].ndim == 1 and extra[0].dtype == float


class AccelerationField:
    """First-order right-hand side ``f(t, y[, *args]) = (v, a)`` of y = (q, v), made from an acceleration.

    This is ``acceleration(t, q, *args) -> (n/2,)``, or ``acceleration(t, q, out, *args)`` with `in_place`. `integrate`
    and the functions built on it call the acceleration itself. The object can be pickled if the acceleration can.
    """

    def __init__(self, acceleration: Callable[..., Any], in_place: bool = False) -> None:
        self.acceleration, self.in_place = acceleration, in_place

    def __call__(self, t: float, y: np.ndarray, *args: Any) -> np.ndarray:
        """Return the derivative at (t, y) as a new array."""
        half, state = y.size // 2, np.asarray(y)
        q, v = state[:half].copy(), state[half:]
        if self.in_place:
            a = filled(lambda out: self.acceleration(t, q, out, *args), q.shape, q.dtype, "acceleration", t)
        else:
            a = as_vector(self.acceleration(t, q, *args), half, q.dtype, "acceleration returned", t)
        return np.concatenate([v, a])


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
        given, wanted = (re.sub(r"\b(const|t|y|f|out|params)\b|\s", "", text) for text in (pointer.signature, kind))
        if given != wanted:
            raise TypeError(f"{name} is a C function of the signature {pointer.signature!r}, expected {kind}.")
        if pointer.user_data is not None:
            raise TypeError(f"{name} is a LowLevelCallable with user_data, which is not supported; pass it as params.")
        self.pointer, self.name, self.kind = pointer, name, kind
        self.takes_f, self.shape = takes_f, shape
        # The first item of this tuple is the capsule of the pointer, whose name is the signature.
        self.address = _capsule_pointer(tuple.__getitem__(pointer, 0), pointer.signature.encode())
        # Calls release the GIL, as runs with native functions only do.
        arrays = [ctypes.c_void_p] * kind.count("*")
        self._function = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_double, *arrays)(self.address)

    def __call__(self, t: float, y: np.ndarray, *others: Any) -> Any:
        """Call the function; return its value if `shape` is given, else None.

        Entries of a returned value that the function does not fill are NaN. All entries of the value are NaN if the
        status is above 0. If it is below 0, a RuntimeError is raised.
        """
        state = np.ascontiguousarray(y, complex if np.iscomplexobj(y) else float)
        given = [state]
        if self.kind == GRADIENT:
            f, *others = others if self.takes_f else (np.full_like(state, np.nan), *others)  # type: ignore[assignment]
            given.append(np.ascontiguousarray(f, state.dtype))
        out, *extra = others if self.shape is None else (np.full(self.shape, np.nan), *others)
        if len(extra) == 1:
            params = reals("params", extra[0])
        else:
            params = None if scalars(tuple(extra)) is None else floats(tuple(extra))
        if params is None:
            raise TypeError(
                f"{self.name} is a C function: its arguments after t and y are numbers or one array of floats, "
                f"its params; it got {', '.join(map(shown, extra))}."
            )
        status = self._function(t, *(array.ctypes.data for array in (*given, out, params)))
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
    if fun is None:
        return None
    if is_pointer(fun):
        return PointerFunction(fun, name, kind, **form)
    module = type(fun).__module__
    if module in BARE:
        given = f"{fun.__name__}.ctypes" if module == NUMBA else "pointer"
        raise TypeError(f"{name} is a bare C function, {shown(fun)}; wrap it: scipy.LowLevelCallable({given}).")
    return fun


def is_jitted(fun: Any) -> bool:
    """Return True if a function is a Numba function."""
    # Not numba.extending.is_jitted, which imports the class in each of its calls.
    return isinstance(fun, getattr(sys.modules.get("numba.core.dispatcher"), "Dispatcher", ()))


def is_compiled(fun: Any) -> bool:
    """Return True if the engine calls `fun` by its address: a Numba function, or a `LibraryFunction` of the engine."""
    return is_jitted(fun) or isinstance(fun, LibraryFunction)


def jit_is_off() -> bool:
    """Return True if Numba's compilation is disabled (NUMBA_DISABLE_JIT)."""
    return "numba" in sys.modules and bool(sys.modules["numba"].config.DISABLE_JIT)


def compilable(fun: Callable[..., Any]) -> Callable[..., Any]:
    """Mark a function of this package as one that `jitted` may compile, and return the function."""
    fun.compilable = True  # type: ignore[attr-defined]
    return fun


@cache
def jitted(fun: Any) -> Any:
    """Return a `compilable` function jitted by Numba, if Numba is installed; return any other function unchanged."""
    if not getattr(fun, "compilable", False) or is_jitted(fun) or find_spec("numba") is None:
        return fun
    from numba import njit

    return njit(fun, error_model="numpy", forceinline=True)


def compiled_like(fun: Callable[..., Any], *others: Callable[..., Any]) -> Callable[..., Any]:
    """Return `fun` jitted if all `others`, which `fun` calls, are Numba functions; else `fun`."""
    return cast(Callable[..., Any], jitted(compilable(fun))) if all(map(is_jitted, others)) else fun


def jitted_call(fun: Any) -> Any:
    """Return a `LibraryFunction` in a form that Numba functions can call, if there is one; else `fun` itself."""
    if not isinstance(fun, LibraryFunction) or find_spec("numba") is None or jit_is_off():
        return fun
    from . import numba_bridge

    return numba_bridge.jitted_call(fun)


def own_values(fun: Callable[..., Any]) -> Callable[..., Any]:
    """Return a user's function with values that its later calls do not change; it may return one array again and again.

    Numba functions, which cannot fill a global array, are returned unchanged.
    """
    if is_jitted(fun):
        return fun

    def own(*args: Any) -> Any:
        value = fun(*args)
        return np.array(value) if isinstance(value, np.ndarray | list) else value

    return own


class Kind(NamedTuple):
    """Signature of a function.

    Its value has the `shape`, () for a number, and is real, even if the state is complex, if `real`. It receives `size`
    components of the state, of the type `dtype`, and an array params of length `p`, -1 for none, or numbers of the
    types in `scalars`, see the function of this name. The user's function takes f, the derivative of the state, if
    `takes_f`, and fills an argument `out` if `in_place`. If `gradient`, the engine calls it with the arguments of a
    gradient, which include f.
    """

    shape: tuple[int, ...]
    size: int
    p: int
    dtype: str
    real: bool = False
    takes_f: bool = False
    in_place: bool = False
    gradient: bool = False
    scalars: str = ""


class CompiledFunction(NamedTuple):
    """A function that the engine calls: it fills `floats` floats, and `entry` is its address, or a `LibraryFunction`.

    `function` keeps the address valid. It and `entry` are None for a gradient or rate that the engine computes.
    """

    function: PointerFunction | Compiled | LibraryFunction | None
    floats: int
    entry: Any


class _Compiler:
    """The functions of one run in the groups of the engine; `kind` has the arguments that all of them receive."""

    found: dict[str, list[CompiledFunction]]
    pairs: dict[str, list[tuple[Any, int]]]

    def __init__(self, kind: Kind) -> None:
        self._kind, self.found, self.pairs = kind, defaultdict(list), defaultdict(list)

    def add(self, group: str, fun: Any, name: str, known: ByAddress | None = None, **form: Any) -> None:
        """Add `fun`, with its `name` in messages and its form in fields of `Kind`; `known` is its C function."""
        shape, real = form["shape"], form.get("real") or self._kind.dtype == "d"
        count = math.prod(shape) * (1 if real else 2)
        if known is not None:
            found = CompiledFunction(known.function, count, known.address)
        elif fun is None or isinstance(fun, LibraryFunction):
            found = CompiledFunction(fun, count, fun)
        elif isinstance(fun, PointerFunction):
            found = CompiledFunction(fun, count, fun.address)
        elif jit_is_off():
            raise NotCompilableError("Numba's JIT is disabled (NUMBA_DISABLE_JIT)")
        elif not is_jitted(fun):
            why = getattr(fun, "not_jitted", "")  # of a function of this package that calls one of the user
            raise NotCompilableError(why or f"{name} is not a Numba function; decorate it with @numba.njit")
        else:
            function = _compiled(fun, self._kind._replace(**form), name)
            found = CompiledFunction(function, count, function.address)
        self.found[group].append(found)
        self.pairs[group].append((found.entry, count))

    def together(self) -> int | None:
        """Return the address of one C function of all functions of a run, or None if there is none.

        There is one if the state is real and short, the functions are jitted, and the gradients do not take f.
        """
        groups = [[known.function for known in self.found[name]] for name in ("rhs", "inv", "grad")]
        functions = [[cast("Compiled", part) for part in group if hasattr(part, "library")] for group in groups]
        if self._kind.dtype != "d" or functions != groups or any(part.kind.takes_f for part in chain(*functions)):
            return None
        from .in_one_pass import in_one_pass

        (rhs,), inv, grad = functions
        address, library = in_one_pass(rhs, tuple(inv), tuple(grad))
        self.found["together"].append(library)
        return address


@lru_cache(maxsize=256)
def _compiled(fun: Any, kind: Kind, name: str) -> Compiled:
    from .numba_bridge import compiled  # which loads Numba

    return compiled(fun, kind, name)


def native_functions(run: Run) -> tuple[NativeFunctions, str]:
    """Return the addresses of the functions of a run, and the reason why those of its events are missing, or "".

    The engine passes the array of parameters itself, not a copy. Raise NotCompilableError if a function other than an
    event is neither a function of the library, nor a C function by pointer, nor a Numba function of the documented
    arguments, or if an invariant has `args`, or no gradient that can be compiled.
    """
    problem, invariants, n, tableau = run.problem, run.invariants, run.y0.size, run.method
    if tableau.in_python:
        raise NotCompilableError(f"{tableau.name} is a {'solver' if tableau.drives else 'one-step method'} in Python")
    if problem.kind is None:
        raise NotCompilableError("args are neither numbers nor one array of floats")
    compiler = _Compiler(problem.kind)
    (fun, form), add, pairs = problem.native_form, compiler.add, compiler.pairs
    second_order = form.startswith("acceleration")
    name, size = ("acceleration", n // 2) if second_order else ("fun", n)
    add("rhs", fun, name, problem.call.compiled, shape=(size,), size=size, in_place=form.endswith("place"))
    for k in range(len(invariants.items)):
        _add_invariant(add, run, k)
    for k, item in invariants.balances.items.items():
        name, takes_f = f"rate of balance {invariants.labels[k]!r}", item.rate_uses_f
        add("rate", item.rate_function, name, shape=invariants.shapes[k], real=True, takes_f=takes_f, gradient=True)
    if run.uses_jacobian:
        fun, half = problem.jacobian, n // 2
        add("jacobian", fun, "jacobian", shape=(half,), size=half, takes_f=True, in_place=True, gradient=True)
    reason = ""
    try:
        for k, event in enumerate(problem.events.functions):
            alone = getattr(event, "unaugmented", None)
            event, size = (event, n) if alone is None else (alone.function, alone.n)
            add("event", getattr(event, "jitted", event), f"event {k}", shape=(), size=size, real=True)
    except NotCompilableError as error:
        pairs["event"], compiler.found["event"], reason = [], [], str(error)
    rates = [entry for entry, _ in pairs["rate"]]
    together = None
    if n <= FEW and problem.variations is None and not invariants.balances.items and invariants.items:
        together = compiler.together()
    return NativeFunctions(
        rhs=pairs["rhs"][0][0],
        inv=pairs["inv"],
        grad=pairs["grad"],
        event=pairs["event"],
        params=problem.parameters,  # itself: an ensemble writes each member's there
        second_order=second_order,
        jacobian=pairs["jacobian"][0][0] if run.uses_jacobian else None,
        rates=invariants.rates(run.options.adaptive, rates) if rates else Rates(),
        by_parameters=pairs["by_parameters"],
        together=together,
        floors=invariants.floors if any([entry is None for entry, _ in pairs["grad"]]) else None,
        keepalive=compiler.found,
    ), reason


def _add_invariant(add: Callable[..., None], run: Run, k: int) -> None:
    """Add invariant k of a run: its value, its gradient, and derivatives by parameters of an augmented state."""
    invariants = run.invariants
    from_f = invariants.starts[k] in run.conserved.rows_from_f  # the engine takes differences where f does not serve
    item, label, shape = invariants.items[k], invariants.labels[k], invariants.shapes[k]
    value, gradient = (calls[k].compiled for calls in invariants.calls)
    name, alone, size = f"invariant {label!r}", item.unaugmented, invariants.shape[1]
    if alone is not None:
        item, size, value, gradient = alone.function, alone.n, None, None
    if item.args:
        raise NotCompilableError(f"{name} has args; pass its parameters through params")
    add("inv", item.function, name, value, shape=shape, size=size, real=True)
    if item.gradient is None and not (from_f or isinstance(item.function, PointerFunction)):
        raise NotCompilableError(without_gradient(label, invariants.why_not.get(label, NO_DUALS)))
    form = {"takes_f": item.uses_f, "in_place": item.in_place, "gradient": True}
    add("grad", item.gradient, f"gradient of {name}", gradient, shape=(*shape, size), size=size, **form)
    if alone is not None and alone.by_parameters is not None:
        rows, name = (*shape, alone.parameters), f"derivatives by parameters of {name}"
        add("by_parameters", alone.by_parameters, name, shape=rows, size=size, real=True)


def without_gradient(label: str, why: str) -> str:
    """Return the reason why a run is interpreted if an invariant has no gradient, and none can be compiled."""
    return f"invariant {label!r} has no grad, and {why}; give it one that is jitted too, Invariant(fun, grad=...)"


class ByAddress(NamedTuple):
    """The C function of a `Call`; it receives `params`, and f too if `takes_f`. `function` keeps the address valid."""

    address: int
    takes_f: bool
    params: np.ndarray
    function: Any


def by_address(call: Call, name: str, kind: Kind | None, params: np.ndarray, n: int, *, gradient: bool = False) -> Call:
    """Return a call, `name` in messages, with its C function if Numba can compile it for states (n,) of this `kind`."""
    if kind is None or not is_jitted(call.fun):
        return call
    _, _, p, dtype, *_, types = kind
    kind = Kind(call.shape, n, p, dtype, call.real, call.takes_f, call.in_place, gradient, types)
    try:
        function = _compiled(call.fun, kind, name)
    except NotCompilableError:
        return call
    return Call(*call[:-1], compiled=ByAddress(function.address, gradient, params, function))


def reraise_user_exception(
    functions: NativeFunctions, group: str, k: int, t: float, y: bytes, f: bytes, status: int
) -> NoReturn:
    """Raise the exception of a function whose call failed in the engine: of a Numba function its own, of any type.

    The arguments after `functions` are those of the `FailedCallError` that the engine raised. The function is number
    `k` of the list ``functions.keepalive[group]``. It was called with `t` and the arrays whose bytes are `y` and `f`,
    and returned `status`.
    """
    function = functions.keepalive[group][k].function
    if isinstance(function, PointerFunction):
        raise function.failure(t, status)
    raise function.failure(t, y, f, functions.params)
