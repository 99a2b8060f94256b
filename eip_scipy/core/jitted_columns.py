"""Compiled functions of a state with columns of derivatives behind it; loaded only where all of a run is compiled."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit

from .dual_arrays import for_duals, inside
from .dual_numbers import put_slope, seed, slope, value_of
from .jitted_gradients import compiled_for, dual_along, gradient_by_duals, new_state

__all__ = [
    "parameter_gradient",
    "rearranged",
    "rhs_by_duals",
    "rhs_by_products",
    "wide_gradient",
    "wide_value",
]

# A state with columns is (y, p, first column, second column, ...): the parameters p that derivatives are taken by stand
# behind the n components as constants, so that each column has size = n + len(p) numbers.


@lru_cache(maxsize=64)
def rhs_by_duals(
    fun: Any, form: str, n: int, parameters: tuple[int, ...], columns: int, has_params: bool, scalars: str
) -> Any:
    """Return the in-place right-hand side of a state with columns, by dual numbers: exact up to rounding.

    Raises
    ------
    NotCompilableError
        When the function does something that dual numbers cannot.
    """
    dual = dual_along(columns)
    lanes = dual.lanes
    taken = n // 2 if form.startswith("acceleration") else n
    offset, size = n - taken, n + len(parameters)
    user = _with_out(for_duals(fun, dual), form, has_params, bool(scalars))
    new = new_state(dual, taken)

    def seeded(Y, first, i):
        x = seed(dual, Y[i], lanes)
        for lane in range(min(lanes, columns - first)):
            x = put_slope(x, lane, Y[size * (1 + first + lane) + i])
        return x

    seeded = inside(seeded)
    seeded_params = _seeded_params(dual, parameters, n, seeded)

    def filled(t, Y, out, params):
        out[:] = 0.0
        x, f = new(), new()
        for first in range(0, columns, lanes):
            for i in range(taken):
                x[i] = seeded(Y, first, i)
            found = user(t, x, f, seeded_params(params, Y, first))
            for i in range(offset):
                out[i] = Y[taken + i]
            for i in range(taken):
                out[offset + i] = value_of(found[i])
            for lane in range(min(lanes, columns - first)):
                start = size * (1 + first + lane)
                for i in range(offset):
                    out[start + i] = Y[start + taken + i]
                for i in range(taken):
                    out[start + offset + i] = slope(found[i], lane)

    return compiled_for(filled, 1, has_params, scalars)


def _seeded_params(dual: Any, parameters: tuple[int, ...], n: int, seeded: Any) -> Any:
    """Return a function that copies the parameters as duals, where derivatives are taken by some."""
    if not parameters:
        return inside(lambda params, Y, first: params)
    places, lanes = np.array(parameters, np.int64), dual.lanes

    def copied(params, Y, first):
        p = np.empty(params.size, dual)
        for i in range(params.size):
            p[i] = seed(dual, params[i], lanes)
        for j in range(places.size):
            p[places[j]] = seeded(Y, first, n + j)
        return p

    return inside(copied)


def _with_out(fun: Any, form: str, has_params: bool, one_by_one: bool) -> Any:
    """Return a function of (t, x, out, params) that returns the derivative, which it may have filled into out."""
    if form.endswith("place"):
        if one_by_one:
            return inside(lambda t, x, out, numbers: _second(fun(t, x, out, *numbers), out))
        if has_params:
            return inside(lambda t, x, out, params: _second(fun(t, x, out, params), out))
        return inside(lambda t, x, out, params: _second(fun(t, x, out), out))
    if one_by_one:
        return inside(lambda t, x, out, numbers: fun(t, x, *numbers))
    if has_params:
        return inside(lambda t, x, out, params: fun(t, x, params))
    return inside(lambda t, x, out, params: fun(t, x))


@inside
def _second(first, second):
    return second


@lru_cache(maxsize=256)
def rhs_by_products(fun: Any, form: str, jvp: Any, n: int, columns: int) -> Any:
    """The right-hand side in place of a state with columns, by a jitted ``jvp(t, y, dy, ...) -> (n,)``."""
    taken = n // 2 if form.startswith("acceleration") else n
    offset, in_place = n - taken, form.endswith("place")

    def rhs(t, Y, out, *extra):
        y = Y[:n]
        for i in range(offset):
            out[i] = y[taken + i]
        if in_place:
            fun(t, y[:taken], out[offset:n], *extra)
        else:
            out[offset:n] = fun(t, y[:taken], *extra)
        for c in range(columns):
            start = n * (1 + c)
            out[start : start + n] = jvp(t, y, Y[start : start + n], *extra)

    return njit(rhs)


@lru_cache(maxsize=256)
def rearranged(rhs: Any, places: tuple[int, ...]) -> Any:
    """The right-hand side in place of a state that has the numbers that `rhs` takes at these places; others stay."""
    order = np.array(places, np.int64)

    def in_place(t, Y, out, *extra):
        packed, found = np.empty(order.size), np.empty(order.size)
        for j in range(order.size):
            packed[j] = Y[order[j]]
        rhs(t, packed, found, *extra)
        out[:] = 0.0
        for j in range(order.size):
            out[order[j]] = found[j]

    return njit(in_place)


def _state_of(layout: tuple[int, int, int]) -> Any:
    """Return a function that takes the state out of a wide one, see `variations.layout`."""
    n, first, second = layout
    if first == n:
        return inside(lambda Y: Y[:n])

    def state(Y):
        y = np.empty(n)
        y[:first] = Y[:first]
        y[first:] = Y[second : second + n - first]
        return y

    return inside(state)


@lru_cache(maxsize=256)
def wide_value(fun: Any, layout: tuple[int, int, int], parameters: tuple[int, ...] = ()) -> Any:
    """A function of the state in a wide one, with these parameters from behind it."""
    state, n = _state_of(layout), layout[0]
    if not parameters:
        return njit(lambda t, Y, *extra: fun(t, state(Y), *extra))
    places = np.array(parameters, np.int64)
    return njit(lambda t, Y, params: fun(t, Y[:n], _from_state(Y, params, n, places)))


@inside
def _from_state(Y, params, n, places):
    found = params.copy()
    for j in range(places.size):
        found[places[j]] = Y[n + j]
    return found


@lru_cache(maxsize=256)
def wide_gradient(
    grad: Any,
    by_parameters: Any,
    layout: tuple[int, int, int],
    parameters: tuple[int, ...],
    shape: tuple[int, ...],
    takes_f: bool,
    in_place: bool,
) -> Any:
    """The gradient in place over a state with columns, on which the invariant does not depend.

    `shape` is that of the invariant's value. `takes_f` and `in_place` say how `grad` is called; the result takes f as
    `grad` does.
    """
    (n, first, second), state = layout, _state_of(layout)
    places, sizes = np.array(parameters, np.int64), (*shape, n)
    if takes_f and in_place:
        own = inside(lambda t, y, F, out, extra: grad(t, y, state(F), out, *extra))
    elif takes_f:
        own = inside(lambda t, y, F, out, extra: _put(grad(t, y, state(F), *extra), out))
    elif in_place:
        own = inside(lambda t, y, F, out, extra: grad(t, y, out, *extra))
    else:
        own = inside(lambda t, y, F, out, extra: _put(grad(t, y, *extra), out))

    def row(t, Y, F, out, extra):  # of a number's gradient, where it lies
        out[n:] = 0.0
        own(t, Y[:n], F, out[:n], extra)

    def rows(t, Y, F, out, extra):
        found = np.empty(sizes)
        own(t, state(Y), F, found, extra)
        out[:] = 0.0
        out[..., :first] = found[..., :first]
        out[..., second : second + n - first] = found[..., first:]

    def with_parameters(t, Y, F, out, extra):
        arguments = (_from_state(Y, extra[0], n, places),)
        rows(t, Y, F, out, arguments)
        slopes = by_parameters(t, Y[:n], *arguments)
        for j in range(places.size):
            out[..., n + j] = slopes[..., places[j]]

    rows = inside(rows)
    filled = inside(with_parameters if parameters else row) if parameters or (not shape and first == n) else rows
    if takes_f:
        return njit(lambda t, Y, F, out, *extra: filled(t, Y, F, out, extra))
    return njit(lambda t, Y, out, *extra: filled(t, Y, Y, out, extra))


@inside
def _put(values, out):
    out[:] = values


@lru_cache(maxsize=256)
def parameter_gradient(fun: Any, p: int, shape: tuple[int, ...]) -> Any:
    """The derivatives (..., p) of a jitted invariant by its parameters.

    Raises
    ------
    NotCompilableError
        When the function does something that dual numbers cannot.
    """
    swapped = njit(lambda t, params, y: fun(t, y, params))
    grad = gradient_by_duals(swapped, p, shape, True)
    sizes = (*shape, p)

    def slopes(t, y, params):
        out = np.empty(sizes)
        grad(t, params, out, y)
        return out

    return njit(slopes)
