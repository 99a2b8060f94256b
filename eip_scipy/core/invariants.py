"""Invariants, their gradients, and the checks that a run starts with."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from copy import copy
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from ..engine.data import EPS
from ..engine.native import BUILD, Call, call
from .arguments import names, scalars
from .callers import users_level
from .inputs import count, filled, flag, is_number, reals, refuse_units, require_arguments, shown
from .jitted import NotCompilableError, is_jitted, jit_is_off, numba_errors
from .pointers import GRADIENT, PointerFunction, address_hint, by_pointer

__all__ = ["Invariant", "InvariantSet", "JointInvariants", "as_invariants", "check_gradient"]

Array = np.ndarray
FLOAT = np.dtype(float)

# Shorter ones have the last word where the first reaches too far.
CHECK_STEPS = (6e-6, 6e-8, 6e-10)
CHECK_TOLERANCE, CHECK_NOISE = 1e-4, 6.0
INVARIANCE_TOLERANCE = 1e-8
TARGET_TOLERANCE = 1e-8
# A gradient may be rounding and nothing else, as differences find that of a square which is 0: so many roundings of the
# state, or as many times what those make of it.
BLUR = 4.0
COMPLEX_STEP = 1e-100
# Components from which on a gradient by as many evaluations is told of. Steps of EIPRK4 of a chain with it and without:
# in Python 5 times longer for 64 components, 66 for 256, 640 for 4096; jitted 3 for 128, 12 for 256, 110 for 4096.
LARGE = 200
# Central differences of order 6: weights of +-1, +-2, +-3 steps (Fornberg 1988, table 1); those of order 4, to compare.
DIFFERENCE_WEIGHTS = ((1, 3 / 4), (2, -3 / 20), (3, 1 / 60))
LOWER_WEIGHTS = (2 / 3, -1 / 12, 0.0)
# As in engine/cpp/differences.hpp.
FIRST_SHIFT, SHORTER, MOST_SHIFTS = 5e-3, 1 / 16, 5
DIFFER, ROUNDINGS, LEAST = 1e-8, 1e3, np.finfo(float).tiny


class Invariant:
    """A conserved quantity of a system, or several at once.

    Parameters
    ----------
    fun : callable
        ``fun(t, y, *args) -> float or (l_i,)``, real. Or, like `grad`, a C function by pointer (see Notes).
    grad : callable, optional
        ``grad(t, y, *args) -> (n,) or (l_i, n)``. For complex y, dI = Re sum_k conj(g_k) dy_k. Without it a function
        jitted by Numba, of a real state and without `args`, gets a compiled one by dual numbers, exact to rounding.
        That of a C function comes from central differences of order 6, in the engine; for any other, from a complex
        step where `fun` allows one, else from such differences (with a warning; not compiled). A complex step takes n
        evaluations of `fun`, differences 6 n and more.
    target : float or array_like, shape (l_i,), optional
        The value to keep. Default: the value at the start. A given target is a condition that the start must meet.
    args : tuple, optional
        Further arguments of `fun` and `grad`. (``solve_ivp(args=...)`` reaches only its own functions.)
    size : int, optional
        Number l_i of the values of `fun`, which a C function does not show; without it, a C function gives one number.
    name : str, optional
        Name in messages and diagnostics.
    scale : float, optional
        Size of the terms that cancel in `fun`, in its own unit: defects below four rounding errors of it are left
        alone. Needed only where neither the value nor ``sum_k |G_k y_k|`` shows that size.
    in_place : bool, optional
        ``grad(t, y, out, *args)`` fills ``out``, (n,) for a scalar invariant, else (l_i, n).
    uses_f : bool, optional
        ``grad(t, y, f, *args)`` also receives f = fun(t, y) of the system, which the step often has already.

    Notes
    -----
    Linear invariants are kept by every Runge-Kutta method; keep the corrections out of them with the option ``frame``
    rather than list them here.

    C functions are given as `scipy.LowLevelCallable`, ctypes or cffi function pointers, of the signatures
    ``int I(double t, const double *y, double *values, const double *params)`` and
    ``int G(double t, const double *y, const double *f, double *out, const double *params)``; f is the derivative with
    ``uses_f=True`` and holds nothing else. See :doc:`/tutorials/c-functions`.

    Examples
    --------
    >>> from eip_scipy import Invariant
    >>> energy = Invariant(lambda t, y: 0.5 * (y @ y), grad=lambda t, y: y, name="energy")
    """

    def __init__(
        self,
        fun: Callable[..., Any],
        grad: Callable[..., Any] | None = None,
        *,
        target: Any = None,
        args: Sequence[Any] = (),
        size: int | None = None,
        name: str | None = None,
        scale: float | None = None,
        in_place: bool = False,
        uses_f: bool = False,
    ) -> None:
        in_place, uses_f = flag("Invariant: in_place", in_place), flag("Invariant: uses_f", uses_f)
        size = None if size is None else count("Invariant: size", size)
        what = "an invariant" if name is None else f"invariant {name!r}"
        fun = by_pointer(fun, what, shape=(size,) if size and size > 1 else ())
        grad = by_pointer(grad, f"gradient of {what}", GRADIENT, takes_f=uses_f)
        if not callable(fun):
            raise TypeError(f"Invariant: fun must be callable, got {fun!r}{address_hint(fun)}.")
        if grad is not None and not callable(grad):
            raise TypeError(f"Invariant: grad must be callable or None, got {grad!r}{address_hint(grad)}.")
        if grad is None and (in_place or uses_f):
            raise ValueError("Invariant: in_place and uses_f describe grad; give grad or leave them out.")
        refuse_units(target=target, args=args, scale=scale)
        if scale is not None and not (is_number(scale) and 0 <= scale < np.inf):
            raise ValueError(f"Invariant: scale must be a finite number >= 0, got {shown(scale)}.")
        if not isinstance(args, tuple):
            raise TypeError(
                f"Invariant: args must be a tuple, got {shown(args)}; write args=(x,) for a single argument."
            )
        if name is not None and not isinstance(name, str):
            raise TypeError(f"Invariant: name must be a string, got {shown(name)}.")
        self.fun = fun
        self.grad = grad
        self.target = None if target is None else _target(target)
        self.args = args
        self.size = size
        self.name = name
        self.scale = scale
        self.in_place = in_place or isinstance(grad, PointerFunction)
        self.uses_f = uses_f

    def __repr__(self) -> str:
        name = self.name or getattr(self.fun, "__name__", "?")
        return f"Invariant({name})"


class JointInvariants(tuple[Invariant, ...]):
    """Scalar invariants whose projection takes two passes over the state: for fields, whose gradients fill memory.

    A tuple of `Invariant`, to be given as ``invariants=`` as it is. Interpreted runs with the euclidean metric,
    ``direction="new"``, one Newton step and no frame call `moments` and `shift` in place of the invariants'
    values and gradients; all others, and steps whose gradients are nearly parallel, take those.

    Parameters
    ----------
    items : iterable of Invariant
    moments : callable
        ``moments(t, y, f, values, gram, terms)`` fills, at the state `y`, the `values` (l,), the lower half of the
        gradients' Gram matrix `gram` (l, l), Re <G_i, G_j>, and `terms` (l,), the sums of ``|G_ik y_k|`` over the
        floats of the state. `f`, the derivative there, holds nothing unless an item `uses_f`.
    shift : callable
        ``shift(t, y, f, mu, out, values)`` fills `out` with ``y + sum_i mu_i G_i(y)``, and `values` with the
        invariants there, not finite where `out` is not.
    """

    moments: Callable[..., None]
    shift: Callable[..., None]

    def __new__(
        cls, items: Iterable[Invariant], moments: Callable[..., None], shift: Callable[..., None]
    ) -> JointInvariants:
        """The tuple of the items, with both functions."""
        self = super().__new__(cls, items)
        self.moments, self.shift = moments, shift
        return self

    def __getnewargs__(self) -> tuple[Any, ...]:
        return tuple(self), self.moments, self.shift


def as_invariants(invariants: Any) -> tuple[Invariant, ...]:
    """One Invariant or a sequence of them, as a tuple; `JointInvariants` as they are.

    Raises
    ------
    TypeError
        For anything else.
    """
    if isinstance(invariants, Invariant):
        return (invariants,)
    if callable(invariants):
        raise TypeError(f"invariants: got the function {invariants!r}; wrap it: Invariant(fun, grad=...).")
    try:
        items = invariants if isinstance(invariants, JointInvariants) else tuple(invariants)
    except TypeError:
        raise TypeError(f"invariants: expected an Invariant or a sequence of them, got {invariants!r}.") from None
    for item in items:
        if not isinstance(item, Invariant):
            raise TypeError(
                f"invariants: expected Invariant objects, got {item!r}; wrap functions: Invariant(fun, grad=...)."
            )
    return items


def _lacks_gradient(item: Invariant) -> bool:
    """Whether an invariant is jitted, as a compiled run takes it, but for its gradient."""
    return item.grad is None and not item.args and is_jitted(item.fun) and not jit_is_off()


def _target(target: Any) -> Array:
    found = reals(target)
    if found is None:
        raise ValueError(f"Invariant: target must be a number or an array of numbers, got {shown(target)}.")
    return found


def _first_value(invariant: Invariant, fun: Any, label: str, t: float, y: Array, extra: tuple) -> Array:
    """The value at the start, a number or (l_i,), by `fun`, the invariant's own with its arguments."""
    try:
        value = fun(t, y.copy())
    except TypeError:
        _require_arguments(invariant.fun, f"invariant {label!r}", ("t", "y"), invariant.args, extra)
        raise
    value = _value(value, label, t)
    if value.ndim > 1:
        raise ValueError(f"invariant {label!r} returned shape {value.shape}; expected a number or one dimension (l,).")
    if invariant.size not in (None, value.size):
        raise ValueError(f"invariant {label!r} returned {value.size} values, but has size={invariant.size}.")
    return value.astype(float)


def _value(value: Any, label: str, t: float, expected: tuple[int, ...] | None = None) -> Array:
    """What an invariant returned at t, real and of the expected shape."""
    refuse_units(**{f"invariant {label!r} returned": value})
    try:
        found = np.asarray(value)
    except ValueError:  # rows of different lengths
        found = np.asarray(None)
    if found.dtype.kind == "c":
        raise ValueError(
            f"invariant {label!r} returned complex values at t={t:g}; expected a real number or a real array (l,)."
        )
    if found.dtype.kind not in "fiub":
        raise TypeError(
            f"invariant {label!r} returned {shown(value)} at t={t:g}; expected a real number or a real array (l,)."
        )
    if expected is not None and found.shape != expected:
        raise ValueError(f"invariant {label!r} returned shape {found.shape} at t={t:g}, expected {expected}.")
    return found


def _gradient(value: Any, label: str, t: float, expected: tuple[int, ...], dtype: np.dtype) -> Array:
    """What a gradient returned at t, of the expected shape, and real where the state is."""
    what = f"gradient of invariant {label!r}"
    refuse_units(**{f"{what} returned": value})
    try:
        found = np.asarray(value)
    except ValueError:  # rows of different lengths
        found = np.asarray(None)
    if found.dtype.kind not in "fiubc":
        raise TypeError(f"{what} returned {shown(value)} at t={t:g}, expected numbers of shape {expected}.")
    if found.shape != expected:
        raise ValueError(f"{what} has shape {found.shape}, expected {expected} for this state, at t={t:g}.")
    if found.dtype.kind == "c" and dtype.kind != "c":
        raise ValueError(f"{what} is complex, but y0 is real, at t={t:g}.")
    return found


def _require_arguments(fun: Any, what: str, first: tuple[str, ...], args: tuple, extra: tuple) -> None:
    given = (*first, *(f"args[{k}]" for k in range(len(args))), *names(extra))
    mend = "Give what it takes besides by Invariant(..., args=(...,))"
    mend += f", or take the run's {names(extra)[0].partition('[')[0]} as its last arguments." if extra else "."
    require_arguments(fun, given, what, mend)


class NumericalGradient:
    """Gradient of an invariant without `grad`: complex step where it is valid, else differences of order 6."""

    def __init__(self, invariant: Invariant, label: str, t: float, y: Array, floors: Array, extra: tuple) -> None:
        self._invariant, self._label = invariant, label
        self.floors = floors
        by_pointer = isinstance(invariant.fun, PointerFunction)
        self.complex_step = y.dtype.kind == "f" and not by_pointer and self._complex_step_is_valid(t, y, extra)

    def __call__(self, t: float, y: Array, *extra: Any) -> Array:
        if self.complex_step:
            return self._by_complex_step(t, y, extra)
        return difference_gradient(lambda x: self._fun(t, x, extra), y, self.floors)

    def _fun(self, t: float, y: Array, extra: tuple) -> Array:
        return np.asarray(self._invariant.fun(t, y.copy(), *self._invariant.args, *extra))

    def _by_complex_step(self, t: float, y: Array, extra: tuple) -> Array:
        return BUILD.gradients.complex_step(self._invariant.fun, t, y, self._invariant.args + extra, COMPLEX_STEP)

    def _complex_step_is_valid(self, t: float, y: Array, extra: tuple) -> bool:
        """Whether `fun` takes complex states and is analytic there: the real part unmoved, differences agree."""
        refusals: tuple[type[BaseException], ...] = (TypeError, ValueError, np.exceptions.ComplexWarning)
        refusals += numba_errors()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", np.exceptions.ComplexWarning)
                self._by_complex_step(t, y, extra)
                plain = self._fun(t, y.astype(complex), extra)
        except refusals:
            return False
        if np.any(np.imag(plain) != 0) or not np.allclose(np.real(plain), self._fun(t, y, extra), rtol=1e-12):
            return False
        # Beside y, which may be a point where the derivatives of |y_k| and the like happen to vanish.
        size = np.abs(y) + self.floors
        y = y + 0.01 * size * _random_directions(y.size, False)[0]
        G = self._by_complex_step(t, y, extra)
        D = difference_gradient(lambda x: self._fun(t, x, extra), y, self.floors)
        return bool(np.all(np.abs((G - D) * size) <= 1e-7 * np.max(np.abs(D * size), axis=-1, keepdims=True)))


def difference_gradient(value: Callable[[Array], Any], y: Array, floor: Array) -> Array:
    """Gradient of value(y) by central differences of order 6, shifts in units of |y_k| + floor_k.

    Where those of order 4 do not agree, as beside a singularity that is nearer than the state's size, the shifts are
    shortened while that helps. The engine computes the same bits (engine/cpp/differences.hpp).
    """

    def along(k: int, unit: complex) -> Any:
        # A power of two: y + shift and y - shift then differ by the shift exactly, but for their own rounding.
        shift = 2.0 ** np.round(np.log2(FIRST_SHIFT * (abs(y[k]) + floor[k])))
        found, least = None, np.inf
        for _ in range(MOST_SHIFTS):
            sums, excess = _shifted_sums(value, y, k, shift * unit)
            found = np.full_like(sums, np.nan) if found is None else found
            if excess < least:
                found, least = sums / shift, excess
            elif least < np.inf:
                break
            if least <= 1:
                break
            shift *= SHORTER
        return found

    columns = [along(k, 1.0) for k in range(y.size)]
    if y.dtype.kind == "c":
        columns = [column + 1j * along(k, 1j) for k, column in enumerate(columns)]
    return np.stack(columns, axis=-1)


def _shifted_sums(value: Callable[[Array], Any], y: Array, k: int, shift: complex) -> tuple[Array, float]:
    """The sums of order 6 over shifts of y_k, and by how much more than they may those of order 4 differ."""
    sums, lower, largest = np.zeros(()), np.zeros(()), np.zeros(())
    for (multiple, weight), lower_weight in zip(DIFFERENCE_WEIGHTS, LOWER_WEIGHTS, strict=True):
        ends = [y.copy(), y.copy()]
        ends[0][k] += multiple * shift
        ends[1][k] -= multiple * shift
        above, below = (np.asarray(value(end)) for end in ends)
        with np.errstate(invalid="ignore"):
            sums, lower = sums + weight * (above - below), lower + lower_weight * (above - below)
            largest = np.max([np.broadcast_to(largest, above.shape), np.abs(above), np.abs(below)], axis=0)
    with np.errstate(invalid="ignore"):
        excess = np.abs(sums - lower) / (DIFFER * np.abs(sums) + ROUNDINGS * EPS * largest + LEAST)
    return sums, float(np.max(excess, initial=0.0))


def _floors(y: Array, f: Array, tau: float) -> Array:
    """By component: as if of what size one is to be shifted that is small now; 1 where nothing is known."""
    floors = np.where(np.isfinite(f), np.abs(tau * f), 0.0)
    floors = np.maximum(floors, 1e-3 * np.abs(y))
    floors[floors == 0] = 1.0
    return floors


class Complaint(NamedTuple):
    """What a check found, about a gradient or about the rate of an invariant."""

    of_gradient: bool
    text: str


def bound(fun: Callable[..., Any], arguments: tuple) -> Callable[..., Any]:
    """``fun`` with its last arguments given; itself where there are none."""
    return (lambda *first: fun(*first, *arguments)) if arguments else fun


class InvariantSet:
    """All invariants of a run as one: sizes, names, targets, scales, and the functions that the step calls.

    Made at the start state, where values and shapes are checked. `extra` holds the run's `params`, if any. `tell`: warn
    of what gradients that are not given cost.
    """

    def __init__(
        self, invariants: Any, t0: float, y0: Array, f0: Array, tau: float, extra: tuple = (), *, tell: bool = True
    ) -> None:
        self.items = given = as_invariants(invariants)
        self.extra = extra
        # Why a jitted invariant has no compiled gradient, by its label.
        self.why_not: dict[str, str] = {}
        self.floors = _floors(y0, f0, tau)
        self.labels = [item.name or f"invariant {k}" for k, item in enumerate(self.items)]
        functions = [bound(item.fun, item.args + extra) for item in self.items]
        values = [
            _first_value(item, fun, label, t0, y0, extra)
            for item, fun, label in zip(self.items, functions, self.labels, strict=True)
        ]
        self.scalar = [value.ndim == 0 for value in values]
        if y0.dtype == FLOAT and any(_lacks_gradient(item) for item in self.items):
            shapes = zip(self.items, self.labels, values, strict=True)
            self.items = tuple(self._with_gradient(item, label, y0.size, v.shape) for item, label, v in shapes)
        sizes = [value.size for value in values]
        self.starts = [0, *np.cumsum(sizes, dtype=int).tolist()]
        self.size = self.starts[-1]
        self.start_values = np.concatenate([np.atleast_1d(v) for v in values]) if values else np.zeros(0)
        self.names = [
            label if scalar else f"{label}[{j}]"
            for label, scalar, size in zip(self.labels, self.scalar, sizes, strict=True)
            for j in range(size)
        ]
        self._require_finite(self.start_values, "not finite at y0")
        self.scales = np.repeat([float(item.scale or 0.0) for item in self.items], sizes)
        self.uses_f = any(item.uses_f for item in self.items)
        self.grads = [
            item.grad if item.grad is not None else NumericalGradient(item, label, t0, y0, self.floors, extra)
            for item, label in zip(self.items, self.labels, strict=True)
        ]
        if tell:
            self._tell_of_differences()
            self._tell_of_cost(given, y0.size)
        self.target = self._targets()
        self.shape, self.dtype = (self.size, y0.size), y0.dtype
        places = [
            start if scalar else slice(start, stop)
            for start, stop, scalar in zip(self.starts[:-1], self.starts[1:], self.scalar, strict=True)
        ]
        self._values = [
            (fun, label, place, value.shape)
            for fun, label, place, value in zip(functions, self.labels, places, values, strict=True)
        ]
        self._gradients = [
            (*self._bound_gradient(k), label, place, value.shape + y0.shape)
            for k, (label, place, value) in enumerate(zip(self.labels, places, values, strict=True))
        ]
        self._gradients_at_start(t0, y0, f0)
        self.calls = self._calls(y0)

    def _tell_of_differences(self) -> None:
        for grad, label in zip(self.grads, self.labels, strict=True):
            if isinstance(grad, NumericalGradient) and not grad.complex_step and label not in self.by_differences:
                warnings.warn(
                    f"invariant {label!r} has no grad and allows no complex step: its gradient comes from central "
                    "differences of order 6 (about 1e-12 relative). Give grad for full accuracy and speed.",
                    UserWarning,
                    stacklevel=users_level(),
                )

    def _tell_of_cost(self, given: Sequence[Invariant], n: int) -> None:
        """Once for all invariants of a large state whose gradients are computed from their values.

        Of those that were `given`, for a jitted one has a compiled gradient by now.
        """
        slow = ", ".join(repr(label) for item, label in zip(given, self.labels, strict=True) if item.grad is None)
        if slow and n >= LARGE:
            warnings.warn(
                f"no grad is given for {slow}: each gradient of these {n} components takes {n} evaluations and more, "
                "which makes the run 10 to 1000 times slower. Give it; of a sum over a grid it is one line: for "
                "w * np.sum(y**2) Invariant(fun, grad=lambda t, y: 2 * w * y), for the energy of a Hamiltonian system "
                "of m coordinates and m momenta, of cells w, Invariant(fun, grad=lambda t, y, f: "
                "w * np.concatenate([-f[m:], f[:m]]), uses_f=True).",
                UserWarning,
                stacklevel=users_level(),
            )

    @property
    def by_differences(self) -> list[str]:
        """The C functions by pointer without a gradient, by their labels."""
        known = zip(self.items, self.labels, strict=True)
        return [label for item, label in known if item.grad is None and isinstance(item.fun, PointerFunction)]

    def with_targets(self) -> tuple[Invariant, ...]:
        """The invariants with the values that are kept as their targets."""
        kept = [copy(item) for item in self.items]
        for k, item in enumerate(kept):
            item.target = self.target[self.starts[k] : self.starts[k + 1]].copy()
        return (
            JointInvariants(kept, self.items.moments, self.items.shift)
            if isinstance(self.items, JointInvariants)
            else tuple(kept)
        )

    def _with_gradient(self, item: Invariant, label: str, n: int, shape: tuple[int, ...]) -> Invariant:
        """A jitted invariant with a compiled gradient, where it comes without one; any other, as it is."""
        numbers = scalars(self.extra)
        if not _lacks_gradient(item) or numbers is None:
            return item
        from .jitted_gradients import gradient_by_duals  # which loads Numba

        item = copy(item)
        try:
            item.grad, item.in_place = gradient_by_duals(item.fun, n, shape, bool(self.extra), numbers), True
        except NotCompilableError as error:
            self.why_not[label] = str(error)
        return item

    def _calls(self, y0: Array) -> tuple[tuple[Call, ...], tuple[Call, ...]]:
        """Values and gradients, as the engine calls them."""

        def value(k: int) -> Call:
            _, label, _, shape = self._values[k]

            def convert(found: Any, t: float) -> Array:
                return np.array(_value(found, label, t, shape), float, order="C")

            return call(self.items[k].fun, self.items[k].args + self.extra, shape, convert, real=True)

        def gradient(k: int) -> Call:
            _, takes_f, in_place, label, _, shape = self._gradients[k]

            def convert(found: Any, t: float) -> Array:
                return np.array(_gradient(found, label, t, shape, y0.dtype), y0.dtype, order="C")

            arguments = self._gradient_arguments(k)
            return call(self.grads[k], arguments, shape, convert, takes_f=takes_f, in_place=in_place)

        return tuple(map(value, range(len(self.items)))), tuple(map(gradient, range(len(self.items))))

    def _require_finite(self, values: Array, what: str) -> None:
        for name, value in zip(self.names, values, strict=True):
            if not np.isfinite(value):
                raise ValueError(f"invariant {name!r} is {what}: it returned {value}.")

    def _targets(self) -> Array:
        target = self.start_values.copy()
        for k, item in enumerate(self.items):
            if item.target is None:
                continue
            part = target[self.starts[k] : self.starts[k + 1]]
            if item.target.ndim > 1 or item.target.size not in (1, part.size):
                raise ValueError(
                    f"invariant {self.labels[k]!r}: target has shape {item.target.shape}, its value "
                    f"{part.size} entries."
                )
            part[:] = item.target
            self._require_finite_target(k, part)
        return target

    def _require_finite_target(self, k: int, part: Array) -> None:
        if not np.all(np.isfinite(part)):
            raise ValueError(f"invariant {self.labels[k]!r}: target must be finite, got {part}.")

    def _gradients_at_start(self, t: float, y: Array, f: Array) -> None:
        """Shapes and finiteness of every gradient, once."""
        for item, (gradient, takes_f, in_place, label, _, expected) in zip(self.items, self._gradients, strict=True):
            what = f"gradient of invariant {label!r}"

            def call(*out: Array, gradient: Any = gradient, takes_f: bool = takes_f) -> Any:
                return gradient(t, y.copy(), f.copy(), *out) if takes_f else gradient(t, y.copy(), *out)

            try:
                if in_place:
                    G = filled(call, expected, y.dtype, what, t)
                else:
                    G = _gradient(call(), label, t, expected, y.dtype)
            except TypeError:
                first = ("t", "y", *(("f",) if takes_f else ()), *(("out",) if in_place else ()))
                _require_arguments(item.grad or item.fun, what, first, item.args, self.extra)
                raise
            if not np.all(np.isfinite(G)):
                raise ValueError(f"{what} is not finite at y0.")

    def _bound_gradient(self, k: int) -> tuple[Callable[..., Any], bool, bool]:
        """Gradient k as gradient(t, y), with f behind y if the second is true and `out` at the end if the third is."""
        item = self.items[k]
        return bound(self.grads[k], self._gradient_arguments(k)), item.uses_f and item.grad is not None, item.in_place

    def _gradient_arguments(self, k: int) -> tuple[Any, ...]:
        item = self.items[k]
        return self.extra if item.grad is None else item.args + self.extra

    def inv(self, t: float, y: Array, values: Array, params: Any = None) -> None:
        """Fill `values` (l,)."""
        # A copy for each here and in grad: a user's function may keep or overwrite what it was given.
        for fun, label, place, expected in self._values:
            value = fun(t, y.copy())
            if isinstance(value, float):
                known = expected == ()
            else:
                known = type(value) is np.ndarray and value.dtype is FLOAT and value.shape == expected
            values[place] = value if known else _value(value, label, t, expected)

    def grad(self, t: float, y: Array, f: Array, G: Array, params: Any = None) -> None:
        """Fill the gradients `G` (l, n)."""
        dtype = y.dtype
        for gradient, takes_f, in_place, label, place, expected in self._gradients:
            if in_place:
                out = G[place]
                out.fill(np.nan)  # shows in the run where the gradient leaves a part of it as it was
                gradient(t, y.copy(), f.copy(), out) if takes_f else gradient(t, y.copy(), out)
                continue
            row = gradient(t, y.copy(), f.copy()) if takes_f else gradient(t, y.copy())
            if not (type(row) is np.ndarray and row.shape == expected and row.dtype is dtype):
                row = _gradient(row, label, t, expected, dtype)
            G[place] = row

    def values(self, t: float, y: Array) -> Array:
        """All values (l,)."""
        out = np.empty(self.size)
        self.inv(t, y, out)
        return out

    def gradients(self, t: float, y: Array, f: Array) -> Array:
        """All gradients (l, n)."""
        out = np.zeros(self.shape, dtype=y.dtype)
        self.grad(t, y, f, out)
        return out

    def term_sizes(self, t: float, y: Array, f: Array) -> Array:
        """Size of the terms in each invariant: max(|I|, |target|, sum_k |G_k y_k|, scale)."""
        return self._term_sizes(y, self.gradients(t, y, f), self.values(t, y))

    def _term_sizes(self, y: Array, G: Array, values: Array) -> Array:
        terms = np.abs(G * y).sum(axis=1)
        return np.maximum(np.maximum(np.abs(values), np.abs(self.target)), np.maximum(terms, self.scales))

    def start_violation(self, t: float, y: Array, f: Array) -> str | None:
        """What is wrong with the start, where it misses a given target by more than 1e-8 of its terms."""
        residual = self.values(t, y) - self.target
        for name, r, size in zip(self.names, residual, self.term_sizes(t, y, f), strict=True):
            if not abs(r) <= TARGET_TOLERANCE * size:
                return f"the start violates invariant {name!r} by {r:.3g}"
        return None

    def check(self, t: float, y: Array, f: Array, tau: float) -> list[str]:
        """Compare gradients with differences along two directions, and the invariance with the system.

        Returns
        -------
        list of str
            The texts of the warnings.

        Raises
        ------
        ValueError
            When a gradient disagrees with the difference of its invariant.

        Warns
        -----
        UserWarning
            When an invariant changes along the flow of this system.
        """
        found = list(self.complaints(t, y, f, tau))
        for complaint in found:
            if complaint.of_gradient:
                raise ValueError(
                    f"{complaint.text}. Mend grad, leave it out (it is then computed), or pass check=False to skip "
                    "this check."
                )
            warnings.warn(
                f"{complaint.text}. Projecting on it gives a wrong solution. (check=False skips this check.)",
                UserWarning,
                stacklevel=users_level(),
            )
        return [complaint.text for complaint in found]

    def complaints(self, t: float, y: Array, f: Array, tau: float) -> Iterator[Complaint]:
        """What is wrong with gradients, and which quantities are no invariants, at a state with the derivative f."""
        if self.size == 0 or y.size == 0:
            return
        # No further than the state moves while it changes by its own size: close to a singularity that is far less
        # than a step.
        moving, size = np.abs(f).max(), np.abs(y).max()
        span = np.abs(y) + (min(tau, size / moving) if size > 0 and moving > 0 else tau) * np.abs(f)
        directions = _random_directions(y.size, y.dtype.kind == "c") * span
        G, here = self.gradients(t, y, f), self.values(t, y)

        def rounding(ways: Array) -> Array:
            """Of derivatives along these, (k, l): how far they change where the state does by roundings."""
            blurred = [self.gradients(t, y + BLUR * EPS * d, f) - G for d in (*directions, -directions[0])]
            return BLUR * np.abs(np.array(blurred)[:, None] * ways[:, None]).sum(axis=3).max(axis=0)

        found = list(self._wrong_gradients(t, y, directions, G, here, rounding))
        yield from found or self._wrong_rates(t, y, f, tau, G, here, rounding)

    def _wrong_gradients(
        self, t: float, y: Array, directions: Array, G: Array, here: Array, rounding: Callable[[Array], Array]
    ) -> Iterator[Complaint]:
        """Those that do not agree with the differences along the first direction in which any does not."""
        along, terms = (directions @ G.conj().T).real, np.abs(directions) @ np.abs(G).T
        wrong = np.array(True)
        for step in CHECK_STEPS:
            both = np.array([[self.values(t, state) for state in y + side * directions] for side in (step, -step)])
            difference = (both[0] - both[1]) * (0.5 / step)
            sizes, moves = np.abs(both), np.abs(both - here)
            noise = (CHECK_NOISE / step) * (EPS * np.maximum(sizes[0], sizes[1]) + 5e-324)
            # At an extremum both ends move alike; their difference is then the rounding inside the invariant.
            allowed = CHECK_TOLERANCE * (terms + (moves[0] + moves[1]) * (0.5 / step))
            agrees = ~(np.abs(difference - along) > allowed + noise)
            if step != CHECK_STEPS[0]:
                agrees &= noise <= allowed
            wrong = wrong & ~agrees
            if not wrong.any():
                return
        wrong &= ~(rounding(directions) > np.abs(difference - along))
        way = int(wrong.any(axis=1).argmax())
        for k in np.flatnonzero(wrong[way]):
            yield Complaint(
                True,
                f"gradient of invariant {self.names[k]!r} is wrong: along a test direction at t={t:.6g} its derivative "
                f"is {difference[way, k]:.6g} by differences and {along[way, k]:.6g} by grad",
            )

    def _wrong_rates(
        self, t: float, y: Array, f: Array, tau: float, G: Array, here: Array, rounding: Callable[[Array], Array]
    ) -> Iterator[Complaint]:
        # In units of the largest component of f: large states would overflow otherwise.
        unit = np.abs(f).max()
        if 0 < unit < np.finfo(float).tiny / EPS:
            return
        unit = unit or 1.0
        in_time, noise = self._time_derivative(t, y, tau, G, here)
        in_time, noise = in_time / unit, noise / unit
        products = G.conj() * (f / unit)
        rate, terms = in_time + products.sum(axis=1).real, np.abs(in_time) + np.abs(products).sum(axis=1)
        wrong = np.abs(rate) > INVARIANCE_TOLERANCE * terms + noise
        if not wrong.any():
            return
        for k in np.flatnonzero(wrong & ~(rounding(f[None] / unit)[0] > np.abs(rate))):
            yield Complaint(
                False,
                f"{self.names[k]!r} is no invariant of this system: at t={t:.6g} it changes at the rate "
                f"{rate[k] * unit:.3g}, where the terms of that rate sum to {terms[k] * unit:.3g}",
            )

    def _time_derivative(self, t: float, y: Array, tau: float, G: Array, here: Array) -> tuple[Array, Array]:
        """The partial derivative in time, and the rounding in it."""
        none = np.zeros(self.size)
        step = 2.0 ** round(math.log2(0.01 * tau)) if 0 < 0.01 * tau < math.inf else 0.0
        if step == 0.0 or not step > 100 * np.spacing(abs(t)):
            return none, none
        total = np.zeros(self.size)
        if all((self.values(t + side * step, y) == here).all() for side in (-1, 1)):  # as almost always
            return none, none
        for multiple, weight in DIFFERENCE_WEIGHTS:
            total += weight * (self.values(t + multiple * step, y) - self.values(t - multiple * step, y))
        total[~np.isfinite(total)] = 0.0
        if not total.any():
            return none, none
        with np.errstate(over="ignore"):
            noise = np.where(total == 0, 0.0, 10 * EPS * self._term_sizes(y, G, here) / step)
            return total / step, noise


@lru_cache
def _random_directions(n: int, is_complex: bool) -> Array:
    """Two, the same in each run: a generator takes as long to make as all else in a check."""
    rng = np.random.default_rng(20220)
    parts = rng.standard_normal((2, 2 if is_complex else 1, n))
    return parts[:, 0] + 1j * parts[:, 1] if is_complex else parts[:, 0]


def check_gradient(invariant: Invariant, t: float, y: Any, fun: Callable[..., Any] | None = None) -> float:
    """Largest relative difference between an invariant's gradient and central differences of order 6.

    Parameters
    ----------
    invariant : Invariant
    t : float
    y : array_like, shape (n,)
        Where to compare; real or complex.
    fun : callable, optional
        ``fun(t, y)``, the system, needed by an invariant with ``uses_f=True``.

    Returns
    -------
    float
        max over the components k of ``|grad_k - difference_k| s_k / max_j |grad_j| s_j``, with s the sizes of y's
        components (of the largest one, for components that are 0): about 1e-12 for a right gradient.

    Raises
    ------
    ValueError
        When the gradient has the wrong shape, or `fun` is missing for ``uses_f``.
    """
    refuse_units(t=t, y=y)
    y = np.array(y, dtype=complex if np.iscomplexobj(y) else float)
    if invariant.uses_f and fun is None:
        raise ValueError("check_gradient: this invariant's grad uses f; pass fun=.")
    f = np.asarray(fun(t, y.copy()), dtype=y.dtype) if fun is not None else np.zeros_like(y)
    size = np.where(y == 0, np.max(np.abs(y), initial=0.0) or 1.0, np.abs(y))
    G = InvariantSet(invariant, t, y, f, 0.0).gradients(t, y, f)
    floor = np.where(y == 0, size, 0.0)
    D = np.atleast_2d(difference_gradient(lambda x: invariant.fun(t, x, *invariant.args), y, floor))
    largest = np.max(np.abs(G) * size, axis=1, keepdims=True)
    largest[largest == 0] = 1.0
    return float(np.max(np.abs(G - D) * size / largest))
