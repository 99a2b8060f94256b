"""The invariants and balances of a run together, with the checks that a run starts with."""

from __future__ import annotations

import math
import warnings
from bisect import bisect_right
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cached_property
from itertools import accumulate, pairwise
from typing import Any

import numpy as np

from ..engine.data import EPS, Grouping
from ..engine.native import BUILD, Call, LibraryFunction, Rates, call
from .callers import users_level
from .derivatives import NumericalGradient, difference_gradient, typical_sizes, unless_error, with_duals
from .functions import Kind, NotCompilableError, PointerFunction, by_address, names
from .inputs import filled, numbers, require_arguments, shown, states
from .invariant_checks import listed, time_derivative
from .invariants import Invariant, as_invariants, with_targets

__all__ = ["BalanceSet", "InvariantSet", "check_gradient"]

Array = np.ndarray
FLOAT, NO_PARAMS = np.dtype(float), np.zeros(0)

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
# Shifts of differences in time, in fixed steps and in first steps of adaptive ones, which are shorter than later ones.
SHIFT_OF_FIXED, SHIFT_OF_FIRST = 1 / 32, 1 / 8
# Parts of the run's interval, and roundings of the time, that a shift has at most and at least.
PARTS, ROUNDINGS = 8.0, 16.0


def _labels(items: Sequence[Invariant]) -> list[str]:
    """Return the names of the items in messages: given names, else unique names of functions, else "invariant k"."""
    found = [item.name or getattr(item.function, "__name__", "<lambda>") for item in items]
    return [
        name if item.name or (name.isidentifier() and found.count(name) == 1) else f"invariant {k}"
        for k, (item, name) in enumerate(zip(items, found, strict=True))
    ]


def _real(value: Any, what: str, t: float, expected: tuple[int, ...] | None = None) -> Array:
    """Return the value of the function `what` at t as an array; raise an error if it is not real or not `expected`."""
    if isinstance(value, float) and not expected:
        return np.array(float(value))
    found = numbers(f"{what} returned", value)
    if found is None or found.dtype.kind == "c":
        error, given = (TypeError, shown(value)) if found is None else (ValueError, "complex values")
        raise error(f"{what} returned {given} at t={t:g}; expected a real number or a real array of shape (l,).")
    if expected is not None and found.shape != expected:
        raise ValueError(f"{what} returned shape {found.shape} at t={t:g}, expected {expected}.")
    return found


def _gradient(value: Any, what: str, t: float, expected: tuple[int, ...], dtype: np.dtype) -> Array:
    """Return the value of a gradient at t after checks: it has the expected shape, and is real if the state is real."""
    found = numbers(f"{what} returned", value)
    if found is None:
        raise TypeError(f"{what} returned {shown(value)} at t={t:g}, expected numbers of shape {expected}.")
    if found.shape != expected:
        raise ValueError(f"{what} has shape {found.shape}, expected {expected} for this state, at t={t:g}.")
    if found.dtype.kind == "c" and dtype.kind != "c":
        raise ValueError(f"{what} is complex, but y0 is real, at t={t:g}.")
    return found


def _real_call(fun: Any, args: tuple, what: str, shape: tuple[int, ...], **kind: bool) -> Call:
    """Return a function of real values of this shape as the engine calls it; `what` is its name in messages."""

    def convert(found: Any, t: float) -> Array:
        return np.array(_real(found, what, t, shape), float, order="C")

    return call(fun, args, shape, convert, real=True, **kind)


def _first_value(item: Invariant, label: str, t: float, y: Array, extra: tuple) -> Array:
    """Return the value at the start, a number or (l_i,)."""
    what = f"invariant {label!r}"
    try:
        value = _real(item.function(t, y.copy(), *item.args, *extra), what, t)
    except TypeError:
        _require_arguments(item.function, what, ("t", "y"), item.args, extra)
        raise
    if value.ndim > 1:
        raise ValueError(f"{what} returned shape {value.shape}; expected a number or one dimension (l,).")
    if item.size not in (None, value.size):
        raise ValueError(f"{what} returned {value.size} values, but has size={item.size}.")
    return value


def _check_filling(gradient: Call, what: str, t: float, y: Array, f: Array) -> None:
    """Raise an error if a user's in-place gradient does not fill its argument `out` at the state y."""
    states = (y.copy(), f.copy()) if gradient.takes_f else (y.copy(),)
    filled(lambda out: gradient.fun(t, *states, out, *gradient.args), gradient.shape, y.dtype, what, t)


def _require_arguments(fun: Any, what: str, first: tuple[str, ...], args: tuple, extra: tuple) -> None:
    given = (*first, *(f"args[{k}]" for k in range(len(args))), *names(extra))
    last = f"the {names(extra)[0].partition('[')[0]} of the run" if extra else "those of the call"
    advice = f"It must accept {', '.join(first)}, then its own arguments, Invariant(..., args=(...,)), then {last}."
    require_arguments(fun, given, what, advice)


class BalanceSet:
    """The balances among the invariants of a run.

    The attribute `items` maps the index of each balance among all items to the balance, with a compiled rate if it is
    jitted, has no given rate, and can be compiled for dual numbers. `places` (b,) are the indices of the balances'
    values among all values, and `mask` (l,) is True for them. `most_slowness` (b,) are the bounds for
    `Diagnostics.slowness` above which a run warns. `known` is the set of all invariants, at whose start (t, y, f) the
    given rates are checked: they must be real and finite, and have the shape of the balance.
    """

    parts: tuple[tuple[int, int], ...] = ()
    places, most_slowness = np.zeros(0, np.int64), np.zeros(0)
    calls: Sequence[Call | None] = ()
    _given: Sequence[tuple[slice, Call]] = ()

    def __init__(self, known: InvariantSet, t: float, y: Array, f: Array) -> None:
        self.items = {k: item for k, item in enumerate(known.items) if item.is_balance}
        self.mask = np.zeros(known.size, bool)
        if not self.items:
            return
        values = [(place, item) for k, item in self.items.items() for place in range(*known.starts[k : k + 2])]
        self.places = np.array([place for place, _ in values], np.int64)
        self.most_slowness = np.array([item.most_slowness for _, item in values])
        self.mask[self.places] = True
        self.parts = tuple((k, known.starts[k + 1] - known.starts[k]) for k in self.items)
        self.calls = calls = []
        self._given = own = []
        for k, item in self.items.items():
            is_given, shape = item.rate_function is not None, known.shapes[k]
            if not is_given and known.dtype == FLOAT:
                with suppress(NotCompilableError):  # the gradient and differences in time take its place
                    self.items[k] = item = with_duals(item, "rate", y.size, shape, known.extra)
            rate, args, what = item.rate_function, item.args + known.extra, f"rate of balance {known.labels[k]!r}"
            found = None if rate is None else _real_call(rate, args, what, shape, takes_f=item.rate_uses_f)
            calls.append(found)
            if is_given and found is not None:
                place = slice(*known.starts[k : k + 2])
                own.append((place, found))
                value = self.known(t, y, f)[place]
                if not np.isfinite(value).all():
                    raise ValueError(f"{what} is not finite at y0: it returned {value}.")

    def known(self, t: float, y: Array, f: Array) -> Array:
        """Return the known rates (l,) of all values: 0 for invariants, NaN for balances whose rate is not given."""
        rates = np.where(self.mask, np.nan, 0.0)
        for place, rate in self._given:
            states = (y.copy(), f.copy()) if rate.takes_f else (y.copy(),)
            rates[place] = rate.convert(rate.fun(t, *states, *rate.args), t)
        return rates


class InvariantSet:
    """All invariants of a run together: sizes, names, targets, scales, and the functions that the step calls.

    The start is the time, the state, the derivative and the length of a step. The values and their shapes are checked
    there. `extra` are the run's further arguments. Invariants are evaluated only at times from t0 to `t_bound`, by
    default only at t0. Numba functions are called as C functions with `params` if their `kind` is given.

    Item k has the values with the indices from `starts[k]` to `starts[k + 1]`, of the shape `shapes[k]`. The `target`
    of `balances` are the values that the run integrates. `kinds` are groups of components that have the same unit, or
    None. `why_not` has, by label, the reasons why jitted invariants have no compiled gradient. Masks (l,) of the
    values: the gradients of the `computed` come from complex steps, quadratic forms or differences. `given` and
    `given_gradients` say of each item whether the user gave its target, and its gradient.
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
        t_bound: float | None = None,
        kind: Kind | None = None,
        params: Array = NO_PARAMS,
    ) -> None:
        self._kind, self._params = kind, params
        self.t_span, self.tau = (t0, t0 if t_bound is None else t_bound), tau
        self.kinds: Grouping | None = None
        self.extra, self._start = extra, (y0, f0, tau)
        self.why_not: dict[str, str] = {}
        self.items = given = as_invariants(invariants)
        self.labels = _labels(given)
        pairs = zip(given, self.labels, strict=True)
        values = [_first_value(item, label, t0, y0, extra) for item, label in pairs]
        self.shapes = [value.shape for value in values]
        self.scalar = not any(self.shapes)
        self.starts = list(accumulate((value.size for value in values), initial=0))
        self.size = self.starts[-1]
        self.shape, self.dtype = (self.size, y0.size), y0.dtype
        self.start_values = np.concatenate(values, axis=None) if values else np.zeros(0)
        self.names: list[str] = []
        for item, label, value in zip(given, self.labels, values, strict=True):
            own = [f"{label}[{j}]" for j in range(value.size)] if value.ndim else [label]
            self.names += item.value_names or own
        for name, number in zip(self.names, self.start_values.tolist(), strict=True):
            if not math.isfinite(number):
                raise ValueError(f"invariant {name!r} is not finite at y0: it returned {number}.")
        if y0.dtype == FLOAT and any(item.gradient is None for item in given):
            self.items = tuple(self._with_gradient(item, k) for k, item in enumerate(given))
        self.given_gradients = [item.gradient is not None for item in given]
        self.computed = self.of_values([item.gradient is None for item in self.items])
        self.uses_f = any(item.uses_f for item in self.items)
        self.scales = self._spread("scale", np.zeros(self.size))
        self.grads = [self._gradient_of(item, t0, y0) for item in self.items]
        self.target = self._spread("target", self.start_values.copy())
        self.given = [item.target is not None and not item.is_measured for item in self.items]
        self.calls = tuple(map(self._value_call, range(len(given)))), tuple(map(self._gradient_call, range(len(given))))
        self.functions: Any = BUILD.InvariantFunctions(*self.calls, y0.size, y0.dtype != FLOAT)
        self.start_gradients = self._gradients_at_start(t0, y0, f0)
        self.balances = BalanceSet(self, t0, y0, f0)

    def of_values(self, of_items: Sequence[Any], dtype: Any = bool) -> Array:
        """Return an array (l,) in which the flag or the number of each item is repeated as often as it has values."""
        found = np.array(of_items, dtype)
        return found if self.scalar else np.repeat(found, np.diff(self.starts))

    def _with_gradient(self, item: Invariant, k: int) -> Invariant:
        """Return item k with a compiled gradient if it can have one; if not, store the reason in `why_not`."""
        try:
            return item if item.gradient else with_duals(item, "gradient", self.shape[1], self.shapes[k], self.extra)
        except NotCompilableError as error:
            self.why_not[self.labels[k]] = str(error)
            return item

    def _spread(self, name: str, out: Array) -> Array:
        """Write the targets or the scales of the items, whichever has this `name`, to those entries of `out` (l,)."""
        for item, label, (first, last) in zip(self.items, self.labels, pairwise(self.starts), strict=True):
            given = getattr(item, name)
            if given is None:
                continue
            if np.ndim(given) > 1 or np.size(given) not in (1, last - first):
                raise ValueError(
                    f"invariant {label!r}: {name} has shape {np.shape(given)}, but fun returns {last - first} values. "
                    "Give one number, or one for each value."
                )
            out[first:last] = given
            if not BUILD.are_finite(out[first:last]):
                raise ValueError(f"invariant {label!r}: {name} must be finite, got {out[first:last]}.")
        return out

    @cached_property
    def floors(self) -> Array:
        """Return the `typical_sizes` (n,) of the components at the start, units that do not vanish with a component."""
        return typical_sizes(*self._start)

    @property
    def by_values(self) -> Array:
        """Return a mask (l,) of the values whose gradients come from differences, not from `grad` or a complex step."""
        return self.of_values([isinstance(g, NumericalGradient) and g.by_differences for g in self.grads])

    @property
    def by_differences(self) -> list[str]:
        """Return the labels of the invariants that are C functions without a gradient."""
        known = zip(self.items, self.labels, strict=True)
        return [label for item, label in known if item.gradient is None and isinstance(item.function, PointerFunction)]

    def _gradient_of(self, item: Invariant, t: float, y: Array) -> Any:
        if item.gradient is not None:
            return item.gradient
        takes_complex = not isinstance(item.function, PointerFunction)
        return NumericalGradient(item.function, item.args, takes_complex, t, y, self.floors, self.extra)

    def warn_of_gradients(self, from_f: Sequence[int]) -> None:
        """Warn about gradients by differences, and about computed gradients of a large state.

        Those of the values with the indices `from_f` are made of f, and need no warning.
        """
        own = zip(self.grads, self.given_gradients, self.labels, self.starts, strict=False)
        missing = [(grad, label) for grad, is_given, label, first in own if not (is_given or first in from_f)]
        by_differences = [
            label
            for grad, label in missing
            if isinstance(grad, NumericalGradient) and grad.by_differences and label not in self.by_differences
        ]
        if by_differences:
            one = len(by_differences) == 1
            warnings.warn(
                f"invariant{'s' * (not one)} {listed(by_differences)} ha{'s' if one else 've'} no grad and "
                f"allow{'s' * one} no complex step: {'its gradient comes' if one else 'their gradients come'} from "
                "central differences of order 6 (relative error about 1e-12). Give grad for full accuracy and speed.",
                UserWarning,
                stacklevel=users_level(),
            )
        n = self.shape[1]
        if missing and n >= LARGE:
            slow = ", ".join(repr(label) for _, label in missing)
            warnings.warn(
                f"no grad is given for {slow}: each gradient by the {n} components takes at least {n} evaluations of "
                "the invariant, which makes the run 2 to 1000 times slower. Give grad. For w * np.sum(y**2) it is "
                "Invariant(fun, grad=lambda t, y: 2 * w * y).",
                UserWarning,
                stacklevel=users_level(),
            )

    def _value_call(self, k: int) -> Call:
        item, what = self.items[k], f"invariant {self.labels[k]!r}"
        found = _real_call(item.function, item.args + self.extra, what, self.shapes[k])
        return found if item.args else by_address(found, what, self._kind, self._params, self.shape[1])

    def _gradient_call(self, k: int) -> Call:
        item, what, dtype = self.items[k], f"gradient of invariant {self.labels[k]!r}", self.dtype
        shape = (*self.shapes[k], self.shape[1])

        def convert(found: Any, t: float) -> Array:
            return np.array(_gradient(found, what, t, shape, dtype), dtype, order="C")

        if item.gradient is None:
            return call(self.grads[k], self.extra, shape, convert)
        arguments = item.args + self.extra
        found = call(item.gradient, arguments, shape, convert, takes_f=item.uses_f, in_place=item.in_place)
        return found if item.args else by_address(found, what, self._kind, self._params, self.shape[1], gradient=True)

    def _gradients_at_start(self, t: float, y: Array, f: Array) -> Array:
        """Return the gradients (l, n) at the start; raise an error for wrong shapes and numbers that are not finite."""
        try:
            for gradient, label, is_given in zip(self.calls[1], self.labels, self.given_gradients, strict=True):
                if is_given and gradient.in_place and not isinstance(gradient.fun, LibraryFunction):
                    _check_filling(gradient, f"gradient of invariant {label!r}", t, y, f)
            G = self.gradients(t, y, f)
        except TypeError:
            for item, gradient, label in zip(self.items, self.calls[1], self.labels, strict=True):
                given = ("t", "y", *(("f",) if gradient.takes_f else ()), *(("out",) if gradient.in_place else ()))
                what = f"gradient of invariant {label!r}"
                _require_arguments(item.gradient or item.function, what, given, item.args, self.extra)
            raise
        if not BUILD.are_finite(G.view(float)):
            broken = next(k for k, row in enumerate(G) if not BUILD.are_finite(row.view(float)))
            label = self.labels[bisect_right(self.starts, broken) - 1]
            raise ValueError(f"gradient of invariant {label!r} is not finite at y0.")
        return G

    @property
    def fixed_target(self) -> Array:
        """Return the target values (l,) of the whole run; NaN for balances, whose values change."""
        return np.where(self.balances.mask, np.nan, self.target) if self.balances.items else self.target.copy()

    def with_targets(self, *, at_end: bool = True) -> tuple[Invariant, ...]:
        """Return the invariants, with targets, for a run that continues this one; those of balances only `at_end`."""
        targets = [self.target[slice(*ends)].copy() for ends in pairwise(self.starts)]
        balances = [item.is_balance and not at_end for item in self.items]
        return with_targets(self.items, [None if gone else x for gone, x in zip(balances, targets, strict=True)])

    def rates(self, adaptive: bool, functions: Sequence[Any] | None = None) -> Rates:
        """Return the `Rates` of the balances, of compiled `functions` or by default the user's.

        The shift in time for differences that give dF/dt is a power of two, or 0 for an empty interval; `adaptive`
        says whether `tau` is a first step.
        """
        t0, length, tau = self.t_span[0], abs(self.t_span[1] - self.t_span[0]), self.tau
        wanted = tau * (SHIFT_OF_FIRST if adaptive else SHIFT_OF_FIXED) if 0 < tau < math.inf else math.inf
        shift = max(min(wanted, length / PARTS), ROUNDINGS * float(np.spacing(abs(t0))))
        shift = 2.0 ** math.floor(math.log2(shift)) if length > 0 and shift < math.inf else 0.0
        found = self.balances.calls if functions is None else functions
        return Rates(self.balances.parts, tuple(found), min(self.t_span), max(self.t_span), shift)

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
        if not any(self.given):
            return None
        given = self.of_values(self.given)
        excess = np.nan_to_num(self._excess(t, y, f), nan=np.inf, posinf=np.inf)
        missed = [int(k) for k in np.argsort(-excess, kind="stable") if excess[k] > 1.0 and given[k]]
        if not missed:
            return None
        residual = (self.values(t, y) - self.target)[missed[0]]
        others = [self.names[k] for k in missed[1:]]
        text = f"the start violates invariant {self.names[missed[0]]!r} by {residual:.3g}"
        return text + (f", and also {listed(others)}" if others else "")


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

    See Also
    --------
    Invariant, find_invariants

    Examples
    --------
    >>> from eip_scipy import Invariant, check_gradient
    >>> wrong = Invariant(lambda t, y: y[0] ** 2 + y[1] ** 2, grad=lambda t, y: [2 * y[0], y[1]])
    >>> round(check_gradient(wrong, 0.0, [3.0, 4.0]), 2)
    0.89
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
