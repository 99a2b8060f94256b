"""Wide states (a state and columns of its derivatives) for the option `variations`, and functions of wide states."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import OdeSolution

from ..engine.data import EUCLIDEAN, GIVEN
from ..engine.data import Columns as KeptColumns
from ..engine.native import BUILD, LibraryFunction
from .arguments import scalars
from .blocks import INDEX
from .gradients import NumericalGradient, difference_gradient, typical_sizes, unless_error
from .inputs import filled, reals, require_arguments, shown
from .invariants import Invariant
from .jitted import NotCompilableError, is_compiled, is_jitted, jit_is_off, jitted_call
from .pointers import GRADIENT, PointerFunction, by_pointer
from .states import as_derivative

__all__ = [
    "Columns", "StateSolution", "Variations", "asked_columns", "kept_symplectic", "require_tableau",
    "right_hand_side", "widened",
]  # fmt: skip

Array = np.ndarray
STATE = "state"
# Largest difference between a derivative that a run would use and a difference of order 6 of the right-hand side: as
# shares of the component and of the largest component. A jvp of the user may itself consist of differences.
TOLERANCES = {"jvp": (0.0, 1e-3), "dual numbers": (1e-3, 1e-12), "complex steps": (0.0, 1e-6)}
# Distances from the start, in units of the state, at which they are compared: at the first one within the domain of the
# function. At the start itself the function may have a kink, or terms that vanish there alone.
DISTANCES = (1e-2, 1e-4, 1e-6, 0.0)
COMPLEX_STEP = 2.0**-332  # a power of two, so that the product has no other error than the rounding of the function
LEAST = 1e-3  # size for differences of a parameter that is 0
TINY = 1e-150  # least size of a component: the product of it and a complex step does not underflow


class OfState(NamedTuple):
    """An invariant or event that the engine evaluates at the state, which is `n` components of the wide state.

    `function` is the `Invariant` or the event of the state alone. If `parameters` parameters follow the state in the
    wide state, ``by_parameters(t, y, params)`` returns the derivatives of an invariant with respect to them.
    """

    n: int
    function: Any
    by_parameters: Callable[..., Any] | None = None
    parameters: int = 0


@dataclass(frozen=True)
class Columns:
    """The columns of derivatives of a run, at its start or where it is continued.

    `values` (n + p, k) are the initial columns; the last p rows belong to the parameters with the indices `parameters`
    and are constant. The first n columns are the state-transition matrix from the first start if `is_transition`, which
    is kept symplectic if `symplectic`. The wide state has all positions first and then all velocities, as Nystrom
    methods need it, if `in_halves`; otherwise one column follows the other.
    """

    values: Array
    parameters: tuple[int, ...]
    is_transition: bool
    symplectic: bool
    in_halves: bool = False

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

    @property
    def half(self) -> int:
        """Return the number of positions in the state, n / 2, if the wide state is `in_halves`; otherwise 0."""
        return self.n // 2 if self.in_halves else 0

    @cached_property
    def order(self) -> Array:
        """Return indices (1 + k, n + p) in the wide state: row 0 for the state and parameters, row j for column j."""
        places = np.arange(self.size * (1 + self.count))
        if not self.in_halves:
            return places.reshape(1 + self.count, self.size)
        return np.concatenate(places.reshape(2, 1 + self.count, self.half), axis=1)

    @cached_property
    def places(self) -> Array | slice:
        """Return the indices, or the slice, of the n components of the state in the wide state."""
        return self.order[0] if self.in_halves else slice(self.n)

    def wide(self, y: Array, params: Array) -> Array:
        """Return the wide state made of `y`, the p entries of `params` that belong to `parameters`, and `values`."""
        out = np.empty(self.order.size)
        out[self.order[0]] = np.concatenate([y, params[list(self.parameters)]])
        out[self.order[1:]] = self.values.T
        return out

    def own(self, rows: Array) -> Array:
        """Return the states (..., n) of wide states (..., m), as copies."""
        return np.array(rows[..., self.places])

    def apart(self, rows: Array) -> tuple[Array, Array]:
        """Return states (..., n) and columns (..., n, k) of wide states (..., m)."""
        blocks = rows[..., self.order]
        return blocks[..., 0, : self.n], blocks[..., 1:, : self.n].swapaxes(-1, -2)

    @property
    def identity(self) -> dict[str, Any]:
        """Return by name the properties of the columns that a checkpoint stores, because results depend on them."""
        return {"variations": self.values, "derivatives by": self.parameters, "symplectic": self.symplectic}

    def after(self, wide: Array) -> Columns:
        """Return the columns at the start of a run that continues from the wide state `wide`."""
        return replace(self, values=wide[self.order[1:]].T.copy())


def require_tableau(method: Any) -> None:
    """Raise ValueError for a method without a Runge-Kutta or Nystrom tableau, which carries no columns."""
    if method.TABLEAU.has_history or method.TABLEAU.in_python:
        raise ValueError(
            f"variations: {method.__name__} carries no derivatives, because its steps do not consist of stages of a "
            "tableau. Use EIPDOP853, EIPRKN12 or another explicit Runge-Kutta or Nystrom method."
        )


def asked_columns(asked: Any, y0: Array, params: Array, names: Sequence[str], in_halves: bool) -> Columns:
    """Return the columns for the option `variations`, `asked`; `params` and `names` are the run's parameters."""
    if isinstance(asked, Columns):
        return replace(asked, in_halves=in_halves)
    n = y0.size
    if y0.dtype.kind == "c":
        raise ValueError("variations: the state is complex; write it in real and imaginary parts.")
    items = [asked] if _is_name(asked) else asked
    if isinstance(items, list | tuple) and items and all(map(_is_name, items)):
        own = [_parameter(item, params, names) for item in items if item != STATE]
        if own and in_halves:
            raise ValueError(
                "variations: Nystrom methods give no derivatives with respect to parameters; use EIPDOP853."
            )
        if len(set(own)) < len(own) or list(items).count(STATE) > 1:
            raise ValueError(f"variations: {shown(asked)} asks for the same derivatives twice.")
        has_state, p = STATE in items, len(own)
        identity = np.zeros((n + p, n * has_state + p))
        if has_state:
            identity[:n, :n] = np.eye(n)
        identity[n:, n * has_state :] = np.eye(p)
        return Columns(identity, tuple(own), has_state, False, in_halves)
    found = reals("variations", asked)
    values: Array = np.zeros(0) if found is None else np.array(found, float)
    if values.ndim == 1 and values.size == n:
        values = values[:, None]
    if values.ndim != 2 or values.shape[0] != n or values.shape[1] == 0 or not np.isfinite(values).all():
        raise ValueError(
            f'variations must be "state" for all {n} columns of the state-transition matrix, names or indices of '
            f"parameters, a list of these, or an array ({n}, k) of finite initial columns, got {shown(asked)}."
        )
    return Columns(values, (), False, False, in_halves)


def _is_name(item: Any) -> bool:
    """Return True if an item is "state", or the name or the index of a parameter."""
    return isinstance(item, str | int | np.integer) and not isinstance(item, bool)


def kept_symplectic(columns: Columns, asked: bool | None, canonical: bool, invariants: Sequence[Invariant]) -> Columns:
    """Return the columns with `symplectic` as `asked`, by default as `canonical`, the problem's, where possible."""
    reasons = {
        "derivatives with respect to parameters or along given directions are not a state-transition matrix; use "
        'variations="state"':
            not columns.is_transition or bool(columns.parameters),
        f"a state of {columns.n} components is not (q, p); omit symplectic": columns.n % 2 == 1,
        "without invariants no step is projected; give the energy, at least": not invariants,
    }  # fmt: skip
    reason = next((words for words, holds in reasons.items() if holds), None)
    if asked and reason is not None:
        raise ValueError(f"symplectic=True: {reason}.")
    return replace(columns, symplectic=reason is None and (canonical if asked is None else bool(asked)))


def _parameter(item: Any, params: Array, names: Sequence[str]) -> int:
    if isinstance(item, str):
        if item not in names:
            known = f"; it has {', '.join(names)}" if names else "; give its index in params instead"
            raise ValueError(f"variations: the run has no parameter {item!r}{known}.")
        return list(names).index(item)
    if not 0 <= item < params.size:
        raise ValueError(f"variations: there is no parameter {item}; params has {params.size} entries, counted from 0.")
    return int(item)


def widened(options: Any, sigma: Array | None, columns: Columns, G: Array) -> tuple[Any, Array]:
    """Return the options and the weights (m,) of the error metric for wide states of m components.

    They are made from `options` and `sigma`, which are for the state. `G` (l, m) contains the gradients of the
    invariants at the start, with respect to the wide state.
    """
    n, places = columns.n, columns.order[0]

    def spread(values: Array | float) -> Array:
        wide = np.zeros(columns.order.size)
        wide[columns.places] = values
        return wide

    def members(blocks: Any) -> Any:
        # Blocks of one size cover the whole state.
        return blocks._replace(member=places[blocks.member.astype(np.intp)].astype(INDEX), size=0)

    frame = options.frame
    kept = KeptColumns(
        kept=np.ascontiguousarray(G[:, places] @ columns.values),
        size=columns.size, seen=n, half=columns.half, symplectic=columns.symplectic,
    )  # fmt: skip
    options = options._replace(
        rtol=spread(options.rtol), atol=spread(options.atol), groups=members(options.groups),
        kinds=members(options.kinds), columns=kept, joint=None,
        metric=GIVEN if options.metric == EUCLIDEAN and columns.parameters else options.metric,
        # A frame of bodies is extended in the same way.
        frame=frame._replace(bodies=np.zeros((2, 0, 0)), place=places[frame.place.astype(np.intp)].astype(INDEX)),
    )  # fmt: skip
    return options, spread(1.0 if sigma is None else sigma)


class StateSolution(OdeSolution):
    """Dense output of the state alone, made from the dense output of a wide state."""

    def __init__(self, solution: OdeSolution, columns: Columns) -> None:
        super().__init__(solution.ts, solution.interpolants)
        self.columns = columns

    def __call__(self, t: Any) -> Array:
        """Return the state (n,) at the time t, or the states (n, m) at m times."""
        return self.columns.own(super().__call__(t).T).T


@dataclass(frozen=True)
class Variations:
    """The functions of a wide state.

    `rhs` is the right-hand side in place, ``rhs(t, Y, out, *extra)``. `invariants` are functions of the wide state, and
    `given` the same invariants as functions of the state. `source` is the source of the products with the Jacobian:
    "problem", "jvp", "dual numbers" or "complex steps".
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
        products: tuple[Callable[..., Any], str],
        t0: float,
        y0: Array,
        extra: tuple,
        invariants: Any,
        *,
        in_python: bool = False,
    ) -> Variations:
        """Return the functions of a wide state from the output of `right_hand_side`; compiled unless `in_python`."""
        if any(item.is_balance for item in invariants):
            raise ValueError(
                "variations: derivatives are not carried together with balances, whose values depend on the whole "
                "orbit; omit the balances in this run."
            )
        rhs, source = products
        compiled = _has_address(rhs) and not in_python
        items = tuple(_wide(item, columns, t0, y0, extra, compiled) for item in invariants)
        return cls(columns, rhs, items, tuple(invariants), source)

    def derivative(self, t: float, Y: Array, *extra: Any) -> Array:
        """Return the derivative (m,) with respect to time of the wide state Y."""
        out = np.empty_like(Y)
        self.rhs(t, Y, out, *extra)
        return out

    def with_targets(self, wide: tuple[Invariant, ...]) -> tuple[Invariant, ...]:
        """Return copies of `given` with the targets of `wide`, the same invariants as functions of the wide state."""
        kept = []
        for item, known in zip(self.given, wide, strict=True):
            own = copy(item)
            own.target, own.is_measured = known.target, known.is_measured
            kept.append(own)
        return tuple(kept)

    def events(self, events: Sequence[Callable[..., Any]]) -> list[Callable[..., Any]]:
        """Return events as functions of the wide state."""
        return [self._event(event) for event in events]

    def _event(self, fun: Callable[..., Any]) -> Callable[..., Any]:
        columns = self.columns

        def wide(t: float, Y: Array, *extra: Any) -> Any:
            return fun(t, columns.own(Y), *extra)

        wide.of_state = OfState(columns.n, fun)  # type: ignore[attr-defined]
        for name in ("terminal", "direction"):
            if hasattr(fun, name):
                setattr(wide, name, getattr(fun, name))
        return wide


def _has_address(fun: Any) -> bool:
    """Return True if a function belongs to the library or is jitted, so that the engine calls it by its address."""
    return is_compiled(fun) and not (is_jitted(fun) and jit_is_off())


def right_hand_side(
    columns: Columns, fun: Any, form: str, t0: float, y0: Array, extra: tuple, jvp: Any, own: Any = None
) -> tuple[Callable[..., Any], str]:
    """Return the right-hand side of the wide state, in place, and the source of its products with the Jacobian."""
    if columns.parameters and scalars(extra) != "":
        raise ValueError("variations: derivatives with respect to parameters need params=[...], one array of numbers.")
    if own is not None and jvp is None:
        return _rearranged(own(columns.parameters), columns.order[:, : columns.n]), "problem"
    jvp = by_pointer(jvp, "jvp", GRADIENT, takes_f=True, shape=(columns.n,))
    rhs, source = _of_columns_in_order(columns, fun, form, t0, y0, extra, jvp)
    return _rearranged(rhs, columns.order), source


def _of_columns_in_order(
    columns: Columns, fun: Any, form: str, t0: float, y0: Array, extra: tuple, jvp: Any
) -> tuple[Callable[..., Any], str]:
    """Return the output of `right_hand_side` for a wide state in which one column follows the other."""
    n, parameters = columns.n, columns.parameters
    check = _Comparison.at_start(_derivative(fun, form, y0), t0, y0, list(parameters), extra)
    if jvp is not None:
        _require_products(check, jvp)
        if is_jitted(jitted_call(fun)) and is_jitted(jvp) and not jit_is_off():
            from .jitted_tangents import rhs_by_products

            return rhs_by_products(jitted_call(fun), form, jvp, n, columns.count), "jvp"

        def products(t: float, y: Array, M: Array, extra: tuple) -> Array:
            found = np.empty((len(M), n))
            for out, row in zip(found, M, strict=True):  # each value is copied, because jvp may return the same array
                out[:] = as_derivative(jvp(t, y.copy(), row[:n].copy(), *extra), n, y0.dtype, t, "jvp")
            return found

        return _interpreted(columns, fun, form, y0, products), "jvp"
    why: str | None = "it is not compiled by Numba"
    if is_jitted(fun) and not jit_is_off() and scalars(extra) is not None:
        from .jitted_tangents import rhs_by_duals

        try:
            rhs = rhs_by_duals(fun, form, n, parameters, columns.count, bool(extra), scalars(extra) or "")
            why = _wrong_duals(check, columns, rhs)
        except NotCompilableError as error:
            why = str(error)
        if why is None:
            return rhs, "dual numbers"
    products = _ComplexSteps(check.derivative, y0, check.places)
    if not unless_error(
        lambda: check.wrong(lambda y: products(t0, y, check.way[None], extra)[0], "complex steps") is None
    ):
        raise ValueError(
            "variations: the derivatives of the right-hand side cannot be computed: it does not belong to a problem "
            f"with derivatives, {why}, and it does not support complex steps. Give jvp=..., a function "
            "jvp(t, y, dy) that returns the product of the Jacobian with dy."
        )
    return _interpreted(columns, fun, form, y0, products), "complex steps"


def _require_products(check: _Comparison, jvp: Any) -> None:
    """Raise an error unless `jvp` is the product of the Jacobian of the right-hand side and a vector."""
    if check.places:
        raise ValueError(
            "variations: derivatives with respect to parameters cannot be computed with jvp, which gives only products "
            'with the Jacobian with respect to the state. Omit jvp, or pass variations="state" or an array of initial '
            "columns."
        )
    if not callable(jvp):
        raise TypeError(f"jvp must be a function jvp(t, y, dy, ...) -> (n,), got {shown(jvp)}.")

    def product(y: Array) -> Array:
        try:
            given = jvp(check.t, y.copy(), check.way.copy(), *check.extra)
        except TypeError:
            names = ["t", "y", "dy", *["params"] * len(check.extra)]
            require_arguments(jvp, names, "jvp", f"Write jvp({', '.join(names)}).")
            raise
        return as_derivative(given, y.size, y.dtype, check.t, "jvp").copy()

    if (wrong := check.wrong(product, "jvp")) is not None:
        k, found, right = wrong
        raise ValueError(
            f"jvp is not the Jacobian of the right-hand side times dy: near the start, along {shown(check.way)}, "
            f"component {k} is {found:.6g} where differences of fun give {right:.6g}. Correct jvp."
        )


def _wrong_duals(check: _Comparison, columns: Columns, rhs: Any) -> str | None:
    """Return a clause about what is wrong in `rhs`, the output of `rhs_by_duals`; None if nothing is found."""
    as_derivative(check.derivative(check.t, check.y, check.extra), check.y.size, check.y.dtype, check.t, "fun")

    def product(y: Array) -> Array:
        wide = np.tile(check.way, 1 + columns.count)
        wide[: columns.size] = np.concatenate([y, check.extra[0][check.places] if check.places else []])
        out = np.empty_like(wide)
        rhs(check.t, wide, out, *check.extra)
        return out.reshape(-1, columns.size)[1:, : columns.n]

    try:
        wrong = check.wrong(product, "dual numbers")
    except MemoryError:
        raise
    except Exception as error:  # fun itself raises none at the start
        return f"it raises {type(error).__name__} with dual numbers"
    if wrong is None:
        return None
    k, found, right = wrong
    return (
        f"component {k} of its derivative along a test direction is {right:.6g} near the start, but {found:.6g} with "
        "dual numbers"
    )


class _Comparison(NamedTuple):
    """The check of derivatives: along one direction near the start they are compared with differences of the function.

    ``derivative(t, y, extra)`` is the function, and `way` (n + p,) a direction in the space of the state and of the
    parameters `places`.
    """

    derivative: Callable[..., Array]
    t: float
    y: Array
    way: Array
    places: list[int]
    extra: tuple

    @classmethod
    def at_start(
        cls, derivative: Callable[..., Array], t: float, y: Array, places: list[int], extra: tuple
    ) -> _Comparison:
        """Return the check along a random direction whose components have about the sizes of the state's."""
        way, sizes = np.random.default_rng(0).standard_normal(y.size + len(places)), np.abs(y)
        way[: y.size] *= np.where(sizes > 0, sizes, sizes[sizes > 0].min(initial=np.inf) if sizes.any() else 1.0)
        own = np.abs(extra[0][places]) if places else np.zeros(0)
        way[y.size :] *= np.where(own > 0, own, 1.0)
        return cls(derivative, t, y, way, places, extra)

    def wrong(self, product: Callable[[Array], Array], source: str) -> tuple[int, float, float] | None:
        """Return the index of a wrong component of ``product(y)``, its value and the difference; None if all are right.

        ``product(y)``, (n,) or (k, n), has the derivatives along `way`, from the `source`, a key of `TOLERANCES`.
        """
        own, of_largest = TOLERANCES[source]
        for share in DISTANCES:
            y = self.y + share * self.way[: self.y.size]
            found, right = unless_error(product, y) if share else product(y), self._difference(y)
            if share == 0.0 or (found is not None and np.isfinite(right).all()):
                break
        found = np.atleast_2d(found)
        with np.errstate(invalid="ignore"):
            sizes = np.maximum(np.abs(found), np.abs(right))
            close = np.abs(found - right) <= own * sizes + of_largest * np.nanmax(sizes, initial=0.0)
        wrong = np.argwhere(np.isfinite(right) & ~close)
        return (int(wrong[0, 1]), float(found[*wrong[0]]), float(right[wrong[0, 1]])) if wrong.size else None

    def _difference(self, y: Array) -> Array:
        """Return the derivative (n,) along `way` by differences of order 6; NaN where the function raises an error."""

        def along(s: Array) -> Array:
            shift = s[0] * self.way
            found: Array | None = unless_error(_shifted, self.derivative, self.t, y, shift, self.places, self.extra)
            return np.full(y.size, np.nan) if found is None else found

        with np.errstate(all="ignore"):
            return np.asarray(difference_gradient(along, np.zeros(1), np.full(1, 1e-2)))[..., 0]


def _shifted(
    derivative: Callable[..., Array], t: float, y: Array, shift: Array, places: list[int], extra: tuple
) -> Array:
    """Return ``derivative(t, y, extra)`` with y and the parameters `places` shifted by the n + p floats of `shift`."""
    if places:
        params = extra[0].astype(shift.dtype)
        params[places] += shift[y.size :]
        extra = (params,)
    return derivative(t, y + shift[: y.size], extra)


def _rearranged(rhs: Callable[..., Any], places: Array) -> Callable[..., Any]:
    """Return a right-hand side of a state that is that of `rhs` at `places` and constant elsewhere, in place."""
    if np.array_equal(places.ravel(), np.arange(places.size)):
        return rhs
    if is_jitted(jitted_call(rhs)) and not jit_is_off():
        from .jitted_tangents import rearranged

        return rearranged(jitted_call(rhs), tuple(places.ravel().tolist()))

    def in_place(t: float, Y: Array, out: Array, *extra: Any) -> None:
        found = np.empty(places.size)
        rhs(t, Y[places].ravel(), found, *extra)
        out[:] = 0.0
        out[places] = found.reshape(places.shape)

    return in_place


def _derivative(fun: Any, form: str, y0: Array) -> Callable[..., Array]:
    """Return ``derivative(t, y, extra) -> (n,)`` for real or complex states; it calls `fun`, which has this `form`."""
    n = y0.size
    half = n // 2 if form.startswith("acceleration") else 0

    def derivative(t: float, y: Array, extra: tuple) -> Array:
        state = y[: n - half].copy()
        if form.endswith("place"):
            found = np.full(n - half, np.nan, y.dtype)
            fun(t, state, found, *extra)
        else:
            found = np.array(fun(t, state, *extra))  # a copy, because fun may return the same array in each call
            if found.shape == () and n - half == 1:
                found = found.reshape(1)
        return np.concatenate([y[half:], found]) if half else found

    return derivative


def _interpreted(
    columns: Columns, fun: Any, form: str, y0: Array, products: Callable[[float, Array, Array, tuple], Array]
) -> Callable[..., Any]:
    """Return the right-hand side of a wide state in Python, with ``products(t, y, M, extra)`` of rows of M."""
    derivative, n, size = _derivative(fun, form, y0), columns.n, columns.size

    def rhs(t: float, Y: Array, out: Array, *arguments: Any) -> None:
        blocks, found = Y.reshape(-1, size), out.reshape(-1, size)
        y = blocks[0, :n]
        found[:, n:] = 0.0
        found[0, :n] = as_derivative(derivative(t, y, arguments), n, y0.dtype, t, "fun")
        found[1:, :n] = products(t, y, blocks[1:], arguments)

    return rhs


class _ComplexSteps:
    """Products of the Jacobian and columns by complex steps.

    ``derivative(t, y, extra)`` takes real and complex states. `places` are the indices in the run's parameters to which
    the last p components of a column belong.
    """

    def __init__(self, derivative: Callable[..., Array], y0: Array, places: list[int]) -> None:
        self._derivative, self._places = derivative, places
        self._floors = typical_sizes(y0, np.zeros_like(y0), 0.0)

    def __call__(self, t: float, y: Array, M: Array, extra: tuple) -> Array:
        """Return the products (k, n) of the Jacobian at (t, y) and the rows of M (k, n + p)."""
        rows, sizes = self._scaled(y, M, extra)
        at_rest = np.zeros(len(rows))
        return BUILD.gradients.complex_step(self._along, t, at_rest, (y, rows, extra), COMPLEX_STEP).T * sizes

    def _scaled(self, y: Array, M: Array, extra: tuple) -> tuple[Array, Array]:
        """Return the rows of M, divided by powers of two, without rounding, to about the state's size; and these."""
        scale = np.maximum(np.abs(y) + self._floors, TINY)
        if self._places:
            own = np.abs(extra[0][self._places])
            scale = np.concatenate([scale, np.where(own > 0, own, LEAST)])
        with np.errstate(over="ignore"):  # columns that grow without bound end the run later, with a message
            sizes = 2.0 ** (np.frexp((np.abs(M) / scale).max(axis=1))[1][:, None] - 1)
        return M / sizes, sizes

    def _along(self, t: float, shares: Array, y: Array, rows: Array, extra: tuple) -> Array:
        """Return the derivative at the state, and the parameters, shifted by ``shares @ rows``."""
        return _shifted(self._derivative, t, y, shares @ rows, self._places, extra)


class _WideInvariant:
    """An invariant as a function of the wide state, with its gradient, for calls from Python.

    `shape` is the shape of the invariant's value. `parameters` are the indices of the parameters that follow the state,
    if the invariant depends on them. ``slopes(t, y, params)`` returns the derivatives with respect to these parameters;
    by default they are computed by differences.
    """

    def __init__(
        self,
        item: Invariant,
        columns: Columns,
        shape: tuple[int, ...],
        parameters: tuple[int, ...],
        t0: float,
        y0: Array,
        extra: tuple,
        slopes: Callable[..., Array] | None = None,
    ) -> None:
        self.item, self.columns, self.shape, self.places = item, columns, shape, list(parameters)
        gradient: Any = item.gradient
        self.slopes = self._differences if slopes is None else slopes
        self.args, self.in_place, self.uses_f = item.args, item.in_place, item.uses_f
        if gradient is None:
            floors = typical_sizes(y0, np.zeros_like(y0), 0.0)
            takes_complex = not isinstance(item.function, PointerFunction | LibraryFunction)
            gradient = NumericalGradient(item.function, item.args, takes_complex, t0, y0, floors, extra)
            self.args, self.in_place, self.uses_f = (), False, False
        self.own_gradient: Callable[..., Any] = gradient

    def value(self, t: float, Y: Array, *extra: Any) -> Any:
        """Return the invariant's value at the wide state Y, with the parameters that follow the state in Y."""
        return self.item.function(t, self.columns.own(Y), *self.item.args, *self._arguments(Y, extra))

    def gradient(self, t: float, Y: Array, *rest: Any) -> Array:
        """Return the gradient (*shape, m) at Y (m,); `rest` begins with the derivative of Y if the gradient uses f."""
        own, places, n = self.columns.own, self.columns.places, self.columns.n
        first: tuple[Any, ...] = (t, own(Y))
        if self.uses_f:
            first, rest = (*first, own(rest[0])), rest[1:]
        extra = self._arguments(Y, rest)
        out = np.zeros((*self.shape, Y.size))
        if self.in_place:
            shape = (*self.shape, n)
            out[..., places] = filled(
                lambda part: self.own_gradient(*first, part, *self.args, *extra), shape, Y.dtype, "gradient", t
            )
        else:
            out[..., places] = self.own_gradient(*first, *self.args, *extra)
        if self.places:
            out[..., n : n + len(self.places)] = self.slopes(t, own(Y), extra[0])
        return out

    def _arguments(self, Y: Array, extra: tuple) -> tuple:
        if not self.places:
            return extra
        params = extra[0].copy()
        n = self.columns.n
        params[self.places] = Y[n : n + len(self.places)]
        return (params,)

    def _differences(self, t: float, y: Array, params: Array) -> Array:
        """Return the invariant's derivatives with respect to the parameters in Y, by differences of order 6."""
        slopes = difference_gradient(lambda p: self.item.function(t, y.copy(), p), params, np.abs(params) + LEAST)
        return np.asarray(slopes)[..., self.places]


def _wide(item: Invariant, columns: Columns, t0: float, y0: Array, extra: tuple, compiled: bool) -> Invariant:
    """Return an invariant, with a gradient, as a function of the wide state; `compiled`: see `OfState`."""
    shape = np.shape(item.function(t0, y0.copy(), *item.args, *extra))
    parameters = columns.parameters if extra and not item.args else ()
    found = copy(item)
    if compiled and not item.args and scalars(extra) is not None:
        found.of_state = _of_state(item, columns.n, shape, parameters, extra)
    own, slopes = (item, None) if found.of_state is None else (found.of_state.function, found.of_state.by_parameters)
    wide = _WideInvariant(own, columns, shape, parameters, t0, y0, extra, slopes)
    found.function, found.gradient, found.args = wide.value, wide.gradient, ()
    found.in_place, found.uses_f = False, wide.uses_f
    return found


def _of_state(
    item: Invariant, n: int, shape: tuple[int, ...], parameters: tuple[int, ...], extra: tuple
) -> OfState | None:
    """Return the invariant, with a gradient, as an `OfState`; None if the engine would have to call Python for it."""
    own, slopes = copy(item), None
    if not _has_address(own.function) or (parameters and not is_jitted(own.function)):
        return None
    try:
        if own.gradient is None and is_jitted(own.function):
            from .jitted_gradients import gradient_by_duals

            own.gradient = gradient_by_duals(own.function, n, shape, bool(extra), scalars(extra) or "")
            own.in_place = True
        if parameters:
            from .jitted_tangents import parameter_gradient

            slopes = parameter_gradient(own.function, extra[0].size, shape, parameters)
    except NotCompilableError:  # the function is then called from Python
        return None
    return OfState(n, own, slopes, len(parameters)) if _has_address(own.gradient) else None
