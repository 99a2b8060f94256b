"""Invariants, their gradients, and the checks that a run starts with."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from functools import cached_property
from itertools import accumulate, pairwise
from typing import Any

import numpy as np

from ..engine.data import EPS, Grouping
from ..engine.native import BUILD, Call, LibraryFunction, Rates, call
from .callers import users_level
from .carried import Carried, bound, real_value, time_shift
from .functions import GRADIENT, NotCompilableError, PointerFunction, by_pointer, is_jitted, jit_is_off, names, scalars
from .gradients import NumericalGradient, difference_gradient, typical_sizes, unless_error
from .inputs import count, filled, flag, numbers, reals, require_arguments, shown, states
from .invariant_checks import complaints, listed, reported, time_derivative
from .linear import LinearInvariants

__all__ = ["Invariant", "InvariantSet", "as_invariants", "check_gradient", "copied", "with_args"]

Array = np.ndarray
FLOAT = np.dtype(float)

TARGET_TOLERANCE = 1e-8
# A value that misses its target by at most this many roundings of the state meets it.
TARGET_ROUNDINGS = 64.0
# A run warns of the cost of computed gradients for states with at least this many components. A computed gradient makes
# the steps of EIPRK4 on a chain of 64, 256 and 4096 components 5, 66 and 640 times longer in Python; if the functions
# are jitted, those of 128, 256 and 4096 components 3, 12 and 110 times longer.
LARGE = 200
# If times are more than FAR_TIMES steps long, invariants are compared with their values at the start after these shares
# of the interval, to see whether they depend on time.
FAR_TIMES, TIMES = 1e5, (0.382, 1.0)


class OwnArguments:
    """A function that is called with an invariant's own `args` after the `first` arguments if a call omits them."""

    def __init__(self, function: Callable[..., Any], args: tuple[Any, ...], first: int) -> None:
        self.function, self.args, self.first = function, args, first
        self.__name__ = getattr(function, "__name__", type(function).__name__)

    def __call__(self, *given: Any) -> Any:
        """Return the value of the function."""
        return self.function(*given, *(self.args if len(given) == self.first else ()))


def copied(original: Any) -> Any:
    """Return a shallow copy of an object, about 5 times faster than `copy.copy`."""
    new = object.__new__(type(original))
    vars(new).update(vars(original))
    return new


class Invariant:
    """A conserved quantity of a system, or several at once.

    Parameters
    ----------
    fun : callable
        ``fun(t, y, *args) -> float or (l_i,)``, real. Or, like `grad`, a `scipy.LowLevelCallable` (see Notes).
    grad : callable, optional
        ``grad(t, y, *args) -> (n,) or (l_i, n)``. For complex y, dI = Re sum_k conj(g_k) dy_k. Default: the gradient
        is computed. If `fun` is jitted by Numba, y is real and there are no `args`, dual numbers give a compiled
        gradient, exact to rounding. The gradient of a C function comes from central differences of order 6, in the
        engine. For any other function it comes from a complex step if `fun` allows one, otherwise from such
        differences (with a warning; not compiled). A complex step takes n + 1 evaluations of `fun`, differences take
        6 n and more. If a complex step is wrong for some states only, as for a norm or an absolute value, differences
        replace it at these states.
    target : float or array_like, shape (l_i,), optional
        The value to keep. Default: the value at the start. If a target is given, the start must meet it to 1e-8 of the
        largest of ``|I|``, ``|target|``, ``sum_k |G_k y_k|`` (G is the gradient) and `scale`. Steps meet it to 1e-9,
        with further Newton steps if the first one leaves more.
    args : tuple, optional
        Further arguments of `fun` and `grad`. The ``args`` of `eip_scipy.solve_ivp` and of `integrate` follow these;
        SciPy's own solve_ivp does not pass its ``args`` to invariants.
    size : int, optional
        Number l_i of the values of `fun`. It is needed for a C function that returns more than one value.
    name : str, optional
        Name in messages and diagnostics. Default: the name of the function.
    scale : float or array_like, shape (l_i,), optional
        Size of the terms that cancel in `fun`, in the unit of `fun`: residuals below four rounding errors of this size
        are not corrected. Needed only if neither the value nor ``sum_k |G_k y_k|`` has that size.
    in_place : bool, optional
        ``grad(t, y, out, *args)`` fills ``out``, (n,) for a scalar invariant, else (l_i, n).
    uses_f : bool, optional
        ``grad(t, y, f, *args)`` also receives the derivative f = fun(t, y) of the system, which the step has often
        evaluated already.

    Notes
    -----
    Every Runge-Kutta method keeps linear invariants. Do not list them as invariants. `integrate` finds them in compiled
    functions, and the option ``linear_invariants`` takes them, so that the corrections do not change them.

    C functions are given as `scipy.LowLevelCallable`, of the signatures
    ``int I(double t, const double *y, double *values, const double *params)`` and
    ``int G(double t, const double *y, const double *f, double *out, const double *params)``; f is the derivative of
    the state only with ``uses_f=True``; otherwise its content is undefined. See :doc:`/tutorials/c-functions`.

    Examples
    --------
    >>> from eip_scipy import Invariant
    >>> energy = Invariant(lambda t, y: 0.5 * (y @ y), grad=lambda t, y: y, name="energy")
    """

    # These are attributes of balances, see `Balance`.
    is_balance = False
    unaugmented: Any = None  # for invariants of augmented states, see `variations.Unaugmented`
    # The linear invariants that corrections leave unchanged in runs with this one, see `particle_invariants`.
    linear: LinearInvariants | None = None
    rate_function: Callable[..., Any] | None = None
    rate_uses_f = False
    # Components and weights (s, k) of the s directions along which all values are projected, or one such pair for every
    # value. Invariants without such pairs are projected together, along all components.
    subspaces: tuple[tuple[Array, Array], ...] = ()
    value_names: tuple[str, ...] = ()
    # A run warns that a balance hardly helps if its rate is above this share of the terms of the rate.
    most_slowness = 0.05

    def __init__(
        self,
        fun: Callable[..., Any],
        grad: Callable[..., Any] | None = None,
        *,
        target: Any = None,
        args: Sequence[Any] = (),
        size: int | None = None,
        name: str | None = None,
        scale: Any = None,
        in_place: bool = False,
        uses_f: bool = False,
    ) -> None:
        own = type(self).__name__
        in_place, uses_f = flag(f"{own}: in_place", in_place), flag(f"{own}: uses_f", uses_f)
        size = None if size is None else count(f"{own}: size", size)
        what = "an invariant" if name is None else f"invariant {name!r}"
        for given in (fun, grad):  # of another invariant, whose arguments take the place of `args` if it is empty
            args = args or given.args if isinstance(given, OwnArguments) else args
        functions: list[Any] = [item.function if isinstance(item, OwnArguments) else item for item in (fun, grad)]
        fun, grad = functions
        fun = by_pointer(fun, what, shape=(size,) if size and size > 1 else ())
        grad = by_pointer(grad, f"gradient of {what}", GRADIENT, takes_f=uses_f)
        if not callable(fun):
            raise TypeError(f"{own}: fun must be callable, got {fun!r}.")
        if grad is not None and not callable(grad):
            raise TypeError(f"{own}: grad must be callable or None, got {grad!r}.")
        if grad is None and (in_place or uses_f):
            raise ValueError(f"{own}: in_place and uses_f describe grad, but grad is missing. Give grad or omit them.")
        if not isinstance(args, tuple):
            raise TypeError(f"{own}: args must be a tuple, got {shown(args)}; write args=(x,) for a single argument.")
        if name is not None and not isinstance(name, str):
            raise TypeError(f"{own}: name must be a string, got {shown(name)}.")
        self.function, self.gradient = fun, grad
        self.target = None if target is None else _target(target)
        self.is_measured = False  # whether the target is the value at the start of an earlier run
        self.args = args
        self.size = size
        self.name = name
        self.scale = None if scale is None else _scale(scale)
        self.in_place = in_place or isinstance(grad, PointerFunction)
        self.uses_f = uses_f

    @property
    def fun(self) -> Callable[..., Any]:
        """Return the function; `args` are passed to it if a call omits them."""
        return OwnArguments(self.function, self.args, 2) if self.args else self.function

    @property
    def grad(self) -> Callable[..., Any] | None:
        """Return the gradient, to which `args` are passed if a call omits them; None if the gradient is computed."""
        if self.gradient is None or not self.args:
            return self.gradient
        return OwnArguments(self.gradient, self.args, 2 + self.uses_f + self.in_place)

    def __repr__(self) -> str:
        name = self.name or getattr(self.function, "__name__", "?")
        return f"{type(self).__name__}({name})"


def as_invariants(invariants: Any) -> tuple[Invariant, ...]:
    """Return invariants or functions f(t, y, *args) as a tuple of `Invariant`; tuples of these stay unchanged."""
    if isinstance(invariants, tuple) and all(isinstance(item, Invariant) for item in invariants):
        return invariants
    if isinstance(invariants, Invariant) or (callable(invariants) and not isinstance(invariants, type)):
        return (_as_invariant(invariants),)
    try:
        items = tuple(invariants)
    except TypeError:
        raise TypeError(
            f"invariants: got {shown(invariants)}; expected an Invariant, a function f(t, y), or a sequence of them."
        ) from None
    return tuple(map(_as_invariant, items))


def _as_invariant(item: Any) -> Invariant:
    if isinstance(item, Invariant):
        return item
    if not callable(item) or isinstance(item, type):
        raise TypeError(
            f"invariants: the sequence contains {shown(item)}; expected Invariant objects or functions f(t, y)."
        )
    name = getattr(item, "__name__", "<")
    return Invariant(item, name=None if name.startswith("<") else name)


def with_args(item: Invariant, args: tuple[Any, ...]) -> Invariant:
    """Return a copy of an invariant with `args` as its own arguments."""
    new: Invariant = copied(item)
    new.args = args
    return new


def _lacks_gradient(item: Invariant) -> bool:
    """Return True if an invariant is jitted without `grad` and without `args`, so that a gradient can be compiled."""
    return item.gradient is None and not item.args and is_jitted(item.function) and not jit_is_off()


def _target(target: Any) -> Array:
    found = reals("target", target)
    if found is None:
        raise ValueError(f"Invariant: target must be a number or an array of numbers, got {shown(target)}.")
    return found


def _scale(scale: Any) -> Any:
    """Return a scale as a float, or as an array with one entry for each value of the invariant."""
    found = None if isinstance(scale, bool | np.bool_) else reals("scale", scale)
    if found is None or found.ndim > 1 or found.size == 0 or not ((found >= 0) & (found < np.inf)).all():
        raise ValueError(
            "Invariant: scale must be a finite number >= 0, or an array with one such number for each value of fun, "
            f"got {shown(scale)}."
        )
    return float(found) if found.ndim == 0 else found


def _labels(items: Sequence[Invariant]) -> list[str]:
    """Return the names of the items in messages: given names, else unique names of functions, else "invariant k"."""
    found = [item.name or getattr(item.function, "__name__", "<lambda>") for item in items]
    return [
        name if item.name or (name.isidentifier() and found.count(name) == 1) else f"invariant {k}"
        for k, (item, name) in enumerate(zip(items, found, strict=True))
    ]


def _first_value(invariant: Invariant, fun: Any, label: str, t: float, y: Array, extra: tuple) -> Array:
    """Return the value at the start, a number or (l_i,); `fun` is the invariant's function with its arguments bound."""
    try:
        value = fun(t, y.copy())
    except TypeError:
        _require_arguments(invariant.function, f"invariant {label!r}", ("t", "y"), invariant.args, extra)
        raise
    value = real_value(value, f"invariant {label!r}", t)
    if value.ndim > 1:
        raise ValueError(f"invariant {label!r} returned shape {value.shape}; expected a number or one dimension (l,).")
    if invariant.size not in (None, value.size):
        raise ValueError(f"invariant {label!r} returned {value.size} values, but has size={invariant.size}.")
    return value.astype(float)


def _first_gradient(
    invariant: Invariant, gradient: Call, label: str, start: tuple[float, Array, Array], extra: tuple
) -> Array:
    """Return the gradient (n,) or (l_i, n) at `start`, which holds a time, a state and its derivative."""
    t, y, f = start
    what, states = f"gradient of invariant {label!r}", (y.copy(), f.copy()) if gradient.takes_f else (y.copy(),)

    def call(*out: Array) -> Any:
        return gradient.fun(t, *states, *out, *gradient.args)

    try:
        if not gradient.in_place:
            return _gradient(call(), label, t, gradient.shape, y.dtype)
        if not isinstance(gradient.fun, LibraryFunction):
            return filled(call, gradient.shape, y.dtype, what, t)
        out = np.empty(gradient.shape)
        call(out)
        return out
    except TypeError:
        given = ("t", "y", *(("f",) if gradient.takes_f else ()), *(("out",) if gradient.in_place else ()))
        _require_arguments(invariant.gradient or invariant.function, what, given, invariant.args, extra)
        raise


def _gradient(value: Any, label: str, t: float, expected: tuple[int, ...], dtype: np.dtype) -> Array:
    """Return the value of a gradient at t after checks: it has the expected shape, and is real if the state is real."""
    what = f"gradient of invariant {label!r}"
    found = numbers(f"{what} returned", value)
    if found is None:
        raise TypeError(f"{what} returned {shown(value)} at t={t:g}, expected numbers of shape {expected}.")
    if found.shape != expected:
        raise ValueError(f"{what} has shape {found.shape}, expected {expected} for this state, at t={t:g}.")
    if found.dtype.kind == "c" and dtype.kind != "c":
        raise ValueError(f"{what} is complex, but y0 is real, at t={t:g}.")
    return found


def _require_arguments(fun: Any, what: str, first: tuple[str, ...], args: tuple, extra: tuple) -> None:
    given = (*first, *(f"args[{k}]" for k in range(len(args))), *names(extra))
    last = f"the {names(extra)[0].partition('[')[0]} of the run" if extra else "those of the call"
    advice = f"It must accept {', '.join(first)}, then its own arguments, Invariant(..., args=(...,)), then {last}."
    require_arguments(fun, given, what, advice)


class InvariantSet:
    """All invariants of a run together: sizes, names, targets, scales, and the functions that the step calls.

    The start is the time, the state, the derivative and the length of a step. The values and their shapes are checked
    there. `extra` are the run's further arguments. With `tell`, the cost and the accuracy of gradients that are not
    given are warned of. Invariants are evaluated only at times from t0 to `t_bound`, by default only at t0. `rhs` is
    the right-hand side of the system, for checks.

    The `target` of `balances` are the values that the run integrates. `kinds` are groups of components that have the
    same unit, see `kinds_of`, or None. Masks (l,) of the values: the user gave the target of the `given`, and the
    gradients of the `computed` are computed because none was given.
    """

    def __init__(
        self,
        invariants: Any,
        t0: float,
        y0: Array,
        f0: Array,
        tau: float,
        extra: tuple = (),
        *,
        tell: bool = True,
        t_bound: float | None = None,
        rhs: Callable[[float, Array], Array] | None = None,
    ) -> None:
        self.t_span, self.rhs, self.tau = (t0, t0 if t_bound is None else t_bound), rhs, tau
        self.kinds: Grouping | None = None
        self.items = given = as_invariants(invariants)
        self.extra = extra
        # The reasons why jitted invariants have no compiled gradient, by their labels.
        self.why_not: dict[str, str] = {}
        self._start = y0, f0, tau
        self.labels = _labels(self.items)
        functions = [bound(item.function, item.args + extra) for item in self.items]
        values = [
            _first_value(item, fun, label, t0, y0, extra)
            for item, fun, label in zip(self.items, functions, self.labels, strict=True)
        ]
        shapes = [value.shape for value in values]
        self.scalar = [shape == () for shape in shapes]
        if y0.dtype == FLOAT and any(map(_lacks_gradient, self.items)):
            each = zip(self.items, self.labels, shapes, strict=True)
            self.items = tuple(self._with_gradient(item, label, y0.size, shape) for item, label, shape in each)
        sizes = [value.size for value in values]
        self.starts = list(accumulate(sizes, initial=0))
        self.size = self.starts[-1]
        self.start_values = np.concatenate([value.ravel() for value in values]) if values else np.zeros(0)
        self.names = self._names(sizes)
        for name, number in zip(self.names, self.start_values.tolist(), strict=True):
            if not math.isfinite(number):
                raise ValueError(f"invariant {name!r} is not finite at y0: it returned {number}.")
        self.scales = self._scales(sizes)
        self.computed = self._of_values([item.gradient is None for item in given])
        self.uses_f = any(item.uses_f for item in self.items)
        self.grads = [self._gradient_of(item, t0, y0) for item in self.items]
        if tell:
            self._tell_of_differences()
            self._tell_of_cost(given, y0.size)
        self.target = self._targets()
        self.given = self._of_values([item.target is not None and not item.is_measured for item in self.items])
        self.shape, self.dtype = (self.size, y0.size), y0.dtype
        self.balances = Carried(self.items, self.labels, self.starts, shapes, extra)
        if y0.dtype == FLOAT:
            self.balances.compile_rates(y0.size)
        self.calls = self._calls(shapes, y0)
        self.functions: Any = BUILD.InvariantFunctions(*self.calls, y0.size, y0.dtype != FLOAT)
        self.start_gradients = self._gradients_at_start(t0, y0, f0)
        self.balances.check(t0, y0, f0)

    def _names(self, sizes: list[int]) -> list[str]:
        """Return names of the l values: an item's `value_names`, if any, else its label, with an index for arrays."""
        return [
            (label if scalar else f"{label}[{j}]") if not item.value_names else item.value_names[j]
            for item, label, scalar, size in zip(self.items, self.labels, self.scalar, sizes, strict=True)
            for j in range(size)
        ]

    @cached_property
    def floors(self) -> Array:
        """Return the `typical_sizes` (n,) of the components at the start, units that do not vanish with a component."""
        return typical_sizes(*self._start)

    @property
    def by_values(self) -> Array:
        """Return a mask (l,) of the values whose gradients come from differences, not from `grad` or a complex step."""
        known = zip(self.items, self.grads, strict=True)
        return self._of_values([item.gradient is None and not grad.complex_step for item, grad in known])

    def _gradient_of(self, item: Invariant, t: float, y: Array) -> Any:
        if item.gradient is not None:
            return item.gradient
        takes_complex = not isinstance(item.function, PointerFunction)
        return NumericalGradient(item.function, item.args, takes_complex, t, y, self.floors, self.extra)

    def _of_values(self, of_items: list[bool]) -> Array:
        """Return a mask (l,) in which the flag of each item is repeated as often as the item has values."""
        if all(self.scalar):
            return np.array(of_items, bool)
        ends = zip(of_items, pairwise(self.starts), strict=True)
        return np.array([flag for flag, (first, last) in ends for _ in range(last - first)], bool)

    def _scales(self, sizes: list[int]) -> Array:
        scales = np.zeros(self.size)
        for k, (item, size) in enumerate(zip(self.items, sizes, strict=True)):
            if item.scale is None:
                continue
            if np.size(item.scale) not in (1, size):
                raise ValueError(
                    f"invariant {self.labels[k]!r}: scale has {np.size(item.scale)} entries, but fun returns {size} "
                    "values. Give one number, or one for each value."
                )
            scales[self.starts[k] : self.starts[k + 1]] = item.scale
        return scales

    def _tell_of_differences(self) -> None:
        for grad, label in zip(self.grads, self.labels, strict=True):
            if isinstance(grad, NumericalGradient) and not grad.complex_step and label not in self.by_differences:
                warnings.warn(
                    f"invariant {label!r} has no grad and allows no complex step: its gradient comes from central "
                    "differences of order 6 (relative error about 1e-12). Give grad for full accuracy and speed.",
                    UserWarning,
                    stacklevel=users_level(),
                )

    def _tell_of_cost(self, given: Sequence[Invariant], n: int) -> None:
        """Warn once if a large state has invariants, as the user gave them, without a gradient."""
        slow = ", ".join(repr(label) for item, label in zip(given, self.labels, strict=True) if item.gradient is None)
        if slow and n >= LARGE:
            warnings.warn(
                f"no grad is given for {slow}: each gradient by the {n} components takes at least {n} evaluations of "
                "the invariant, which makes the run 10 to 1000 times slower. Give grad. For w * np.sum(y**2) it is "
                "Invariant(fun, grad=lambda t, y: 2 * w * y). For the energy of a Hamiltonian system of m coordinates "
                "and m momenta on a grid with cells of size w it is Invariant(fun, grad=lambda t, y, f: "
                "w * np.concatenate([-f[m:], f[:m]]), uses_f=True).",
                UserWarning,
                stacklevel=users_level(),
            )

    @property
    def by_differences(self) -> list[str]:
        """Return the labels of the invariants that are C functions without a gradient."""
        known = zip(self.items, self.labels, strict=True)
        return [label for item, label in known if item.gradient is None and isinstance(item.function, PointerFunction)]

    @property
    def fixed_target(self) -> Array:
        """Return the target values (l,) of the whole run; NaN for balances, whose values change."""
        target = self.target.copy()
        target[self.balances.places] = np.nan
        return target

    def rates(self, adaptive: bool, functions: Sequence[Any] | None = None) -> Rates:
        """Return the `Rates`, of compiled `functions` or from Python; `adaptive` says whether `tau` is a first step."""
        low, high = min(self.t_span), max(self.t_span)
        return self.balances.rates(low, high, time_shift(self.tau, adaptive, self.t_span), functions)

    def with_targets(self, *, at_end: bool = True) -> tuple[Invariant, ...]:
        """Return the invariants, with targets, for a run that continues this one; those of balances only `at_end`."""
        kept = list(map(copied, self.items))
        for k, item in enumerate(kept):
            if item.is_balance and not at_end:
                item.target = None
                continue
            item.is_measured = item.is_measured or item.target is None
            item.target = self.target[self.starts[k] : self.starts[k + 1]].copy()
        # Those of a field, which are projected together, see `problems.gross_pitaevskii`.
        return self.items.replaced(kept) if hasattr(self.items, "replaced") else tuple(kept)

    def _with_gradient(self, item: Invariant, label: str, n: int, shape: tuple[int, ...]) -> Invariant:
        """Return an invariant with a compiled gradient if it can have one; if not, store the reason in `why_not`."""
        numbers = scalars(self.extra)
        if not _lacks_gradient(item) or numbers is None:
            return item
        from .jitted_gradients import gradient_by_duals  # which loads Numba

        item = copied(item)
        try:
            item.gradient, item.in_place = gradient_by_duals(item.function, n, shape, bool(self.extra), numbers), True
        except NotCompilableError as error:
            self.why_not[label] = str(error)
        return item

    def _calls(self, shapes: list[tuple[int, ...]], y0: Array) -> tuple[tuple[Call, ...], tuple[Call, ...]]:
        """Return the functions of values, one for each item, and those of gradients, as the engine calls them."""

        def value(k: int) -> Call:
            label, shape = self.labels[k], shapes[k]

            def convert(found: Any, t: float) -> Array:
                return np.array(real_value(found, f"invariant {label!r}", t, shape), float, order="C")

            return call(self.items[k].function, self.items[k].args + self.extra, shape, convert, real=True)

        def gradient(k: int) -> Call:
            item, label, shape = self.items[k], self.labels[k], shapes[k] + y0.shape

            def convert(found: Any, t: float) -> Array:
                return np.array(_gradient(found, label, t, shape, y0.dtype), y0.dtype, order="C")

            arguments = self.extra if item.gradient is None else item.args + self.extra
            takes_f = item.gradient is not None and item.uses_f
            return call(self.grads[k], arguments, shape, convert, takes_f=takes_f, in_place=item.in_place)

        return tuple(map(value, range(len(self.items)))), tuple(map(gradient, range(len(self.items))))

    def _targets(self) -> Array:
        target = self.start_values.copy()
        for k, item in enumerate(self.items):
            if item.target is None:
                continue
            part = target[self.starts[k] : self.starts[k + 1]]
            if item.target.ndim > 1 or item.target.size not in (1, part.size):
                raise ValueError(
                    f"invariant {self.labels[k]!r}: target has shape {item.target.shape}, but fun returns {part.size} "
                    "values. Give one number, or one for each value."
                )
            part[:] = item.target
            if not BUILD.are_finite(part):
                raise ValueError(f"invariant {self.labels[k]!r}: target must be finite, got {part}.")
        return target

    def _gradients_at_start(self, t: float, y: Array, f: Array) -> Array:
        """Return the gradients (l, n) at the start; raise an error for wrong shapes and numbers that are not finite."""
        G = np.empty((self.size, *y.shape), y.dtype)
        if all(isinstance(grad, LibraryFunction) for grad in self.grads):  # whose values need no further checks
            G = self.gradients(t, y, f)
            if BUILD.are_finite(G.view(float)):
                return G
        for k, (item, label) in enumerate(zip(self.items, self.labels, strict=True)):
            rows = G[self.starts[k] : self.starts[k + 1]]
            rows[:] = _first_gradient(item, self.calls[1][k], label, (t, y, f), self.extra)
            if not BUILD.are_finite(rows.view(float)):
                raise ValueError(f"gradient of invariant {label!r} is not finite at y0.")
        return G

    def add_rounding_of_time(self, y: Array) -> bool:
        """Raise the scales of invariants that depend on time, and return True if there are any.

        The rounding of a time t, relative to t, changes such an invariant by ``abs(t dI/dt)`` times as much, which no
        correction of the state should follow. The largest of these products at some times of the run is taken. It is
        negligible compared with the errors of the steps unless t is very many steps long.
        """
        t0, t_bound = self.t_span
        end = t_bound if math.isfinite(t_bound) else t0 + self.tau
        if not max(abs(t0), abs(end)) > FAR_TIMES * self.tau:
            return False
        times = [t0 + share * (end - t0) for share in TIMES]
        found = [unless_error(self.values, t, y) for t in times]
        if all(here is None or np.array_equal(here, self.start_values) for here in found):
            return False
        for t, here in ((t0, self.start_values), *zip(times, found, strict=True)):
            if here is not None and np.isfinite(here).all():
                slope = time_derivative(self, t, y, self.start_gradients, here, self.tau)[0]
                self.scales = np.maximum(self.scales, max(abs(t0), abs(end)) * np.abs(slope))
        return True

    def values(self, t: float, y: Array) -> Array:
        """Return the values (l,) of all invariants at (t, y)."""
        return self.functions.values(t, y)

    def gradients(self, t: float, y: Array, f: Array) -> Array:
        """Return the gradients (l, n) of all values at (t, y); f is the derivative of the state."""
        return self.functions.gradients(t, y, f)

    def term_sizes(self, t: float, y: Array, f: Array) -> Array:
        """Return the sizes (l,) of the terms in the invariants: ``max(|I|, |target|, sum_k |G_k y_k|, scale)``."""
        return self.sizes_of_terms(y, self.gradients(t, y, f), self.values(t, y))

    def sizes_of_terms(self, y: Array, G: Array, values: Array) -> Array:
        """Return `term_sizes` from known gradients (l, n) and values (l,)."""
        terms = np.abs(G * y).sum(axis=1)
        return np.maximum(np.maximum(np.abs(values), np.abs(self.target)), np.maximum(terms, self.scales))

    def norm_products(self, G: Array, x: Array) -> Array:
        """Return ``sum_b |G_b| |x_b|`` over groups of components with the same unit, (l,), for gradients (l, n).

        The terms ``G_k x_k`` may all vanish for some orientation of the axes; these products do not.
        """
        largest, size = np.abs(G).max(initial=0.0), np.abs(x).max(initial=0.0)
        if not (0 < largest < np.inf and 0 < size < np.inf):
            return np.zeros(len(G))
        rows, vector = np.abs(G) / largest, np.abs(x) / size
        if self.kinds is not None and len(self.kinds.start) - 1 < x.size:
            first = self.kinds.start[:-1].astype(np.intp)
            order = self.kinds.member.astype(np.intp)[:: self.kinds.width] // self.kinds.width
            first //= self.kinds.width
            rows = np.sqrt(np.add.reduceat(rows[:, order] ** 2, first, axis=1))
            vector = np.sqrt(np.add.reduceat(vector[order] ** 2, first))
        return (rows @ vector) * size * largest

    def misses(self, t: float, y: Array, f: Array) -> Array:
        """Return a mask (l,) of invariants that miss their targets by more than 1e-8 `term_sizes`, plus rounding."""
        return ~(self._excess(t, y, f) <= 1.0)

    def _excess(self, t: float, y: Array, f: Array) -> Array:
        """Return the distances (l,) from the targets, as multiples of the distances that `misses` allows."""
        G, values = self.gradients(t, y, f), self.values(t, y)
        allowed = TARGET_TOLERANCE * self.sizes_of_terms(y, G, values)
        allowed += TARGET_ROUNDINGS * EPS * self.norm_products(G, y)
        residual = np.abs(values - self.target)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            return np.where(residual == 0, 0.0, residual / allowed)

    def note_rates(self, figures: Array, t: float, y: Array, f: Array, G: Array, here: Array) -> None:
        """Update the largest rates of change along f in `figures` (l, `N_FIGURES`), which `engine.trust` judges.

        The rates are relative to ``sum_k |G_k f_k|``, the size of the terms that cancel in the rate. The given rate of
        a balance is subtracted from its rate of change. Rates of balances without a given rate are not noted.
        """
        own = None
        if self.balances.items:
            in_time, _ = time_derivative(self, t, y, G, here, self.tau)
            own = self.balances.known(t, y, f) - np.where(self.balances.mask, in_time, 0.0)
        self.functions.note_rates(figures, t, y, f, G, here, self.target, self.scales, own)

    def start_violation(self, t: float, y: Array, f: Array) -> str | None:
        """Return a message if the start misses given targets, with the worst invariant first; otherwise None."""
        if not np.count_nonzero(self.given):
            return None
        excess = np.nan_to_num(self._excess(t, y, f), nan=np.inf, posinf=np.inf)
        missed = [int(k) for k in np.argsort(-excess, kind="stable") if excess[k] > 1.0 and self.given[k]]
        if not missed:
            return None
        residual = (self.values(t, y) - self.target)[missed[0]]
        others = [self.names[k] for k in missed[1:]]
        text = f"the start violates invariant {self.names[missed[0]]!r} by {residual:.3g}"
        return text + (f", and also {listed(others)}" if others else "")

    def check(
        self, t: float, y: Array, f: Array, tau: float, evaluated: tuple[Array, Array] | None = None
    ) -> list[str]:
        """Check the invariants at the start, with step `tau`: raise ValueError or warn; return the warnings' texts."""
        assert self.rhs is not None
        return reported(complaints(self, t, y, f, tau, self.rhs, evaluated))


def check_gradient(invariant: Invariant, t: float, y: Any, fun: Callable[..., Any] | None = None) -> float:
    """Return the largest relative difference between an invariant's gradient and central differences of order 6.

    Parameters
    ----------
    invariant : Invariant
    t : float
    y : array_like, shape (n,)
        State at which to compare; real or complex.
    fun : callable, optional
        ``fun(t, y)``, the right-hand side of the system, needed for an invariant with ``uses_f=True``.

    Returns
    -------
    float
        Maximum over the components k, and over the values of the invariant, of
        ``|grad_k - difference_k| s_k / max_j |grad_j| s_j``, with ``s_k = |y_k|``, or the size of the largest component
        if ``y_k`` is 0. A correct gradient gives about 1e-12.

    Raises
    ------
    ValueError
        If the gradient has the wrong shape, or `fun` is missing for an invariant with ``uses_f=True``.
    """
    y = states("y", y)
    if invariant.uses_f and fun is None:
        raise ValueError("check_gradient: this invariant's grad uses f, the derivative of the state; pass fun=.")
    f = np.array(fun(t, y.copy()), dtype=y.dtype) if fun is not None else np.zeros_like(y)
    size = np.where(y == 0, np.max(np.abs(y), initial=0.0) or 1.0, np.abs(y))
    G = InvariantSet(invariant, t, y, f, 0.0).gradients(t, y, f)
    floor = np.where(y == 0, size, 0.0)
    D = np.atleast_2d(difference_gradient(lambda x: invariant.function(t, x, *invariant.args), y, floor))
    largest = np.max(np.abs(G) * size, axis=1, keepdims=True)
    largest[largest == 0] = 1.0
    return float(np.max(np.abs(G - D) * size / largest))
