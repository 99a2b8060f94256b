"""Columns of derivatives carried behind a state: what a user asks for, and the functions of the wider state."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.integrate import OdeSolution

from ..engine.data import EUCLIDEAN, GIVEN
from ..engine.data import Columns as KeptColumns
from ..engine.native import LibraryFunction
from .arguments import scalars
from .gradients import COMPLEX_STEP, NumericalGradient, difference_gradient, typical_sizes
from .inputs import filled, real_array, shown
from .invariants import Invariant
from .jitted import NotCompilableError, is_compiled, is_jitted, jit_is_off
from .pointers import PointerFunction
from .states import as_derivative

__all__ = ["Columns", "StateSolution", "Variations", "asked_columns", "widened"]

Array = np.ndarray
STATE = "state"
# How far a complex step may be from a difference, relative to the largest component: that of differences of order 6.
AGREES = 1e-6


@dataclass(frozen=True)
class Columns:
    """The columns of a run, at its start or where it goes on.

    Attributes
    ----------
    values : ndarray, shape (n + p, k)
        Initial columns; the last p rows are those of the parameters, which stay.
    parameters : tuple of int
        Which of the run's parameters the rows behind the state stand for.
    is_transition : bool
        Whether the first n columns are those of the state-transition matrix from the start of the first run.
    symplectic : bool
        Whether these are kept symplectic.
    """

    values: Array
    parameters: tuple[int, ...]
    is_transition: bool
    symplectic: bool

    @property
    def n(self) -> int:
        """Return the number of components of the state."""
        return len(self.values) - len(self.parameters)

    @property
    def size(self) -> int:
        """Return the length of a column."""
        return len(self.values)

    @property
    def count(self) -> int:
        """Return the number of columns."""
        return self.values.shape[1]

    def wide(self, y: Array, params: Array) -> Array:
        """Return the state with its columns."""
        return np.concatenate([y, params[list(self.parameters)], self.values.T.ravel()])

    def apart(self, rows: Array) -> tuple[Array, Array]:
        """Return states (m, n) and columns (m, n, k) of wide states (m, ...)."""
        blocks = rows.reshape(len(rows), 1 + self.count, self.size)
        return blocks[:, 0, : self.n], blocks[:, 1:, : self.n].transpose(0, 2, 1)

    def after(self, wide: Array) -> Columns:
        """Return those of a run that goes on from a wide state."""
        blocks = wide.reshape(1 + self.count, self.size)
        return Columns(blocks[1:].T.copy(), self.parameters, self.is_transition, self.symplectic)


def asked_columns(asked: Any, y0: Array, params: Array, names: Sequence[str], symplectic: bool) -> Columns:
    """The columns that the option `variations` asks for.

    Raises
    ------
    TypeError, ValueError
        For anything else than the option's documentation says, a complex state, or parameters that a run lacks.
    """
    if isinstance(asked, Columns):
        return asked
    n = y0.size
    if y0.dtype.kind == "c":
        raise ValueError("variations: the state is complex; write it in real and imaginary parts.")
    items = [asked] if isinstance(asked, str) else asked
    if isinstance(items, list | tuple) and items and all(isinstance(item, str | int | np.integer) for item in items):
        own = [_parameter(item, params, names) for item in items if item != STATE]
        if len(set(own)) < len(own):
            raise ValueError(f"variations: {shown(asked)} names a parameter twice.")
        has_state, p = STATE in items, len(own)
        values: Array = np.zeros((n + p, n * has_state + p))
        if has_state:
            values[:n, :n] = np.eye(n)
        values[n:, n * has_state :] = np.eye(p)
        return Columns(values, tuple(own), has_state, symplectic and has_state and p == 0)
    try:
        values = np.array(real_array("variations", asked), float)
    except (TypeError, ValueError):
        values = np.zeros(0)
    if values.ndim == 1 and values.size == n:
        values = values[:, None]
    if values.ndim != 2 or values.shape[0] != n or values.shape[1] == 0 or not np.isfinite(values).all():
        raise ValueError(
            f'variations must be "state" for all {n} columns of the state-transition matrix, names or places of '
            f"parameters, a list of these, or an array ({n}, k) of finite initial columns, got {shown(asked)}."
        )
    return Columns(values, (), False, False)


def _parameter(item: Any, params: Array, names: Sequence[str]) -> int:
    if isinstance(item, str):
        if item not in names:
            known = f"; it has {', '.join(names)}" if names else "; give their places in params instead"
            raise ValueError(f"variations: the run has no parameter {item!r}{known}.")
        return list(names).index(item)
    if not 0 <= item < params.size:
        raise ValueError(f"variations: there is no parameter {item}; the run has {params.size} in params.")
    return int(item)


def widened(options: Any, sigma: Array | None, columns: Columns, G: Array) -> tuple[Any, Array]:
    """Return the options and weights of a state for the same with columns behind it; `G`: gradients at the start."""
    n, m = columns.n, columns.size * (1 + columns.count)
    behind = np.zeros(m - n)
    weights = np.concatenate([np.ones(n) if sigma is None else sigma, behind])
    metric = GIVEN if options.metric == EUCLIDEAN and columns.parameters else options.metric
    # What is done with blocks of one size, and with a frame of bodies, goes over all of a state.
    groups, kinds = options.groups._replace(size=0), options.kinds._replace(size=0)
    kept = KeptColumns(
        kept=np.ascontiguousarray(G[:, : columns.size] @ columns.values),
        size=columns.size, seen=n, symplectic=columns.symplectic,
    )  # fmt: skip
    options = options._replace(
        rtol=np.concatenate([options.rtol, behind]), atol=np.concatenate([options.atol, behind]), groups=groups,
        kinds=kinds, frame=options.frame._replace(bodies=np.zeros((2, 0, 0))), metric=metric, columns=kept, joint=None,
    )  # fmt: skip
    return options, weights


class StateSolution(OdeSolution):
    """The state alone, of a solution that has columns of derivatives behind it."""

    def __init__(self, solution: OdeSolution, n: int) -> None:
        super().__init__(solution.ts, solution.interpolants)
        self._n = n

    def __call__(self, t: Any) -> Array:
        """Return the states (n,) or (n, m)."""
        return super().__call__(t)[: self._n]


@dataclass(frozen=True)
class Variations:
    """The functions of a state with columns behind it.

    Attributes
    ----------
    columns : Columns
    rhs : callable
        In place: ``rhs(t, Y, out, *extra)``.
    invariants : tuple of Invariant
    given : tuple of Invariant
        The same as functions of the state.
    source : str
        Where the products of the Jacobian come from.
    """

    columns: Columns
    rhs: Callable[..., Any]
    invariants: tuple[Invariant, ...]
    given: tuple[Invariant, ...]
    source: str

    @classmethod
    def of(
        cls,
        columns: Columns,
        fun: Any,
        form: str,
        t0: float,
        y0: Array,
        extra: tuple,
        invariants: Any,
        jvp: Any,
        own: Any,
    ) -> Variations:
        """Make them; `own`: the problem's ``variational``, or None.

        Raises
        ------
        ValueError
            Where there is no way to the derivatives.
        """
        if any(item.is_balance for item in invariants):
            raise ValueError(
                "variations: derivatives are not carried together with balances, whose values depend on the whole "
                "orbit; leave the balances out of this run."
            )
        rhs, source = _right_hand_side(columns, fun, form, t0, y0, extra, jvp, own)
        compiled = is_compiled(rhs) and not jit_is_off()
        items = tuple(_wide(item, columns, t0, y0, extra, compiled) for item in invariants)
        return cls(columns, rhs, items, tuple(invariants), source)

    def with_targets(self, wide: tuple[Invariant, ...]) -> tuple[Invariant, ...]:
        """Return the invariants as functions of the state, with the targets of those of the wide state."""
        kept = []
        for item, known in zip(self.given, wide, strict=True):
            own = copy(item)
            own.target, own.is_measured = known.target, known.is_measured
            kept.append(own)
        return tuple(kept)

    def event(self, fun: Callable[..., Any]) -> Callable[..., Any]:
        """Return an event as a function of the wide state."""
        n = self.columns.n
        if is_jitted(fun) and not jit_is_off() and is_compiled(self.rhs):
            from .jitted_columns import wide_value

            wide = wide_value(fun, n)
        else:

            def wide(t: float, Y: Array, *extra: Any) -> Any:
                return fun(t, Y[:n], *extra)

        for name in ("terminal", "direction"):
            if hasattr(fun, name):
                setattr(wide, name, getattr(fun, name))
        return wide


def _right_hand_side(
    columns: Columns, fun: Any, form: str, t0: float, y0: Array, extra: tuple, jvp: Any, own: Any
) -> tuple[Callable[..., Any], str]:
    n, parameters = columns.n, columns.parameters
    if parameters and scalars(extra) != "":
        raise ValueError("variations: derivatives by parameters need them as params=[...], one array of numbers.")
    if jvp is not None:
        if parameters:
            raise ValueError(
                "variations: a jvp gives no derivatives by parameters; ask for columns of the state alone."
            )
        if not callable(jvp):
            raise TypeError(f"jvp must be a function jvp(t, y, dy, ...) -> (n,), got {shown(jvp)}.")
        if is_compiled(fun) and is_jitted(jvp) and not jit_is_off():
            from .jitted_columns import rhs_by_products

            return rhs_by_products(fun, form, jvp, n, columns.count), "jvp"
        return _interpreted(columns, fun, form, y0, extra, lambda t, y, dy, dp: jvp(t, y, dy, *extra)), "jvp"
    if own is not None:
        rhs = own(parameters)
        if parameters and is_compiled(rhs) and not jit_is_off():
            from .jitted_columns import rhs_by_variational

            return rhs_by_variational(rhs, n, len(parameters), columns.count), "problem"
        if not parameters:
            return rhs, "problem"
        return _spread(rhs, columns), "problem"
    if is_jitted(fun) and not jit_is_off() and scalars(extra) is not None:
        from .jitted_columns import rhs_by_duals

        try:
            found = rhs_by_duals(fun, form, n, parameters, columns.count, bool(extra), scalars(extra) or "")
        except NotCompilableError:
            pass
        else:
            return found, "dual numbers"
    return _by_complex_steps(columns, fun, form, t0, y0, extra), "complex step"


def _spread(rhs: Callable[..., Any], columns: Columns) -> Callable[..., Any]:
    """A right-hand side of (y, columns), in place, as one of states with parameters behind them."""
    n, size = columns.n, columns.size

    def spread(t: float, Y: Array, out: Array, *extra: Any) -> None:
        blocks, found = Y.reshape(-1, size), out.reshape(-1, size)
        filled_in = np.empty((len(blocks), n))
        rhs(t, np.ascontiguousarray(blocks[:, :n]).ravel(), filled_in.reshape(-1), *extra)
        found[:, :n], found[:, n:] = filled_in, 0.0

    return spread


def _derivative(fun: Any, form: str, y0: Array) -> Callable[..., Array]:
    """The derivative as a function f(t, y, extra) of real or complex states."""
    n = y0.size
    half = n // 2 if form.startswith("acceleration") else 0

    def derivative(t: float, y: Array, extra: tuple) -> Array:
        state = y[: n - half].copy()
        if form.endswith("place"):
            found = np.full(n - half, np.nan, y.dtype)
            fun(t, state, found, *extra)
        else:
            found = np.asarray(fun(t, state, *extra))
        return np.concatenate([y[half:], found]) if half else found

    return derivative


def _interpreted(
    columns: Columns, fun: Any, form: str, y0: Array, extra: tuple, product: Callable[..., Array]
) -> Callable[..., Any]:
    derivative, n, size = _derivative(fun, form, y0), columns.n, columns.size

    def rhs(t: float, Y: Array, out: Array, *arguments: Any) -> None:
        blocks, found = Y.reshape(-1, size), out.reshape(-1, size)
        y = blocks[0, :n]
        found[:, n:] = 0.0
        found[0, :n] = as_derivative(derivative(t, y, arguments), n, y0.dtype, t, "fun")
        for column, slope in zip(blocks[1:], found[1:], strict=True):
            slope[:n] = as_derivative(product(t, y.copy(), column[:n].copy(), column[n:].copy()), n, y0.dtype, t, "jvp")

    return rhs


def _by_complex_steps(columns: Columns, fun: Any, form: str, t0: float, y0: Array, extra: tuple) -> Callable[..., Any]:
    derivative, places = _derivative(fun, form, y0), list(columns.parameters)

    def product(t: float, y: Array, dy: Array, dp: Array) -> Array:
        size = max(np.abs(dy).max(initial=0.0), np.abs(dp).max(initial=0.0))
        if size == 0.0:
            return np.zeros(y.size)
        step, arguments = COMPLEX_STEP / size, extra
        if places:
            params = extra[0].astype(complex)
            params[places] += 1j * step * dp
            arguments = (params,)
        return derivative(t, y + 1j * step * dy, arguments).imag / step

    rng = np.random.default_rng(0)
    dy, dp = rng.standard_normal(y0.size), rng.standard_normal(len(places))
    dy *= np.abs(y0) + np.abs(y0).max(initial=0.0) + (not y0.any())
    try:
        found = product(t0, y0, dy, dp)
        right = _difference(derivative, t0, y0, dy, dp, places, extra)
        good = bool(np.abs(found - right).max() <= AGREES * max(np.abs(right).max(), np.abs(found).max()))
    except MemoryError:
        raise
    except Exception:  # whatever a function raises for complex numbers
        good = False
    if not good:
        raise ValueError(
            "variations: the right-hand side is neither that of a problem with derivatives, nor jitted by Numba for "
            "dual numbers, nor right for a complex step. Give jvp=..., a function jvp(t, y, dy) that returns the "
            "product of the Jacobian with dy."
        )
    return _interpreted(columns, fun, form, y0, extra, product)


def _difference(
    derivative: Callable[..., Array], t: float, y: Array, dy: Array, dp: Array, places: list[int], extra: tuple
) -> Array:
    """The derivative along (dy, dp) by central differences of order 6."""

    def along(s: Array) -> Array:
        if not places:
            return derivative(t, y + s[0] * dy, extra)
        params = extra[0].copy()
        params[places] += s[0] * dp
        return derivative(t, y + s[0] * dy, (params,))

    return np.asarray(difference_gradient(along, np.zeros(1), np.full(1, 1e-2)))[..., 0]


def _wide(item: Invariant, columns: Columns, t0: float, y0: Array, extra: tuple, compiled: bool) -> Invariant:
    """An invariant as a function of the wide state, with a gradient."""
    n, parameters = columns.n, columns.parameters
    value = np.asarray(item.function(t0, y0.copy(), *item.args, *extra))
    wide = copy(item)
    takes_params = bool(extra) and not item.args and bool(parameters)
    own = copy(item)
    if compiled and is_compiled(item.function) and not item.args and scalars(extra) is not None:
        try:
            return _wide_jitted(own, wide, columns, value.shape, extra, takes_params)
        except NotCompilableError:
            pass
    if own.gradient is None:
        floors = typical_sizes(y0, np.zeros_like(y0), 0.0)
        takes_complex = not isinstance(own.function, PointerFunction | LibraryFunction)
        own.gradient = NumericalGradient(own.function, own.args, takes_complex, t0, y0, floors, extra)
        own.in_place, own.uses_f, own.args = False, False, ()
        by_numbers = True
    else:
        by_numbers = False
    slopes: Any = own.gradient
    args = () if by_numbers else item.args
    shape, places = value.shape, list(parameters)

    def own_arguments(Y: Array, arguments: tuple) -> tuple:
        if not takes_params:
            return arguments
        params = arguments[0].copy()
        params[places] = Y[n : n + len(places)]
        return (params,)

    def function(t: float, Y: Array, *arguments: Any) -> Any:
        return item.function(t, Y[:n].copy(), *item.args, *own_arguments(Y, arguments))

    def gradient(t: float, Y: Array, *rest: Any) -> Array:
        f, arguments = (rest[0][:n].copy(), rest[1:]) if own.uses_f else (None, rest)
        arguments = own_arguments(Y, arguments)
        first = (t, Y[:n].copy()) if f is None else (t, Y[:n].copy(), f)
        out = np.zeros((*shape, Y.size))
        if own.in_place:
            out[..., :n] = filled(
                lambda part: slopes(*first, part, *args, *arguments), (*shape, n), np.dtype(float), "gradient", t
            )
        else:
            out[..., :n] = slopes(*first, *args, *arguments)
        if takes_params:
            by = difference_gradient(
                lambda p: np.asarray(item.function(t, Y[:n].copy(), p)), arguments[0], np.abs(arguments[0]) + 1e-3
            )
            out[..., n : n + len(places)] = np.asarray(by)[..., places]
        return out

    wide.function, wide.gradient, wide.args = function, gradient, ()
    wide.in_place, wide.uses_f = False, own.uses_f
    return wide


def _wide_jitted(
    own: Invariant, wide: Invariant, columns: Columns, shape: tuple[int, ...], extra: tuple, takes_params: bool
) -> Invariant:
    from .jitted_columns import parameter_gradient, wide_gradient, wide_value
    from .jitted_gradients import gradient_by_duals

    n, parameters = columns.n, columns.parameters if takes_params else ()
    if own.gradient is None:
        own.gradient = gradient_by_duals(own.function, n, shape, bool(extra), scalars(extra) or "")
        own.in_place = True
    if not is_compiled(own.gradient):
        raise NotCompilableError("its gradient is not compiled")
    if takes_params and not is_jitted(own.function):
        raise NotCompilableError("it is no Numba function")
    by = parameter_gradient(own.function, extra[0].size, shape) if parameters else None
    wide.function = wide_value(own.function, n, parameters)
    wide.gradient = wide_gradient(own.gradient, by, n, parameters, shape, own.uses_f, own.in_place)
    wide.in_place = True
    return wide
