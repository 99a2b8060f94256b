"""Compiled functions of a state with columns of derivatives; imported only if the whole run is compiled."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit

from .dual_arrays import for_duals, inside
from .dual_numbers import put_slope, seed, slope, value_of
from .jitted_gradients import compiled_for, dual_along, gradient_by_duals, new_state

__all__ = ["parameter_gradient", "rearranged", "rhs_by_duals", "rhs_by_products"]

# A state with columns is (y, p, first column, second column, ...): the parameters p that derivatives are taken by stand
# behind the n components as constants, so that each column has size = n + len(p) numbers.


@lru_cache(maxsize=64)
def rhs_by_duals(
    fun: Any, form: str, n: int, parameters: tuple[int, ...], columns: int, has_params: bool, scalars: str
) -> Any:
    """Return ``rhs(t, Y, out, ...)``, the in-place right-hand side of a state with columns, for a jitted `fun`.

    Y consists of the state (n,), the parameters with the indices `parameters`, and `columns` columns of derivatives.
    The derivatives of `fun` are exact up to rounding. `form` is that of `fun`, see `native_functions`. If `scalars` is
    not empty, `fun` takes numbers of these types instead of params, see `Packed`. Raise NotCompilableError if dual
    numbers cannot do what `fun` does.
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
    """Return ``copied(params, Y, first)``, which returns params as dual numbers, or unchanged without `parameters`.

    Their derivatives are entries of the columns of Y from the column `first` on, or 0 for other parameters. ``seeded(Y,
    first, i)`` returns entry i of Y as such a dual number; the parameters follow the `n` entries of the state.
    """
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
    """Return ``call(t, x, out, params)``, which returns the value of `fun` at x; an in-place `fun` writes to `out`."""
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
    """Return the in-place right-hand side of a state (n,) with `columns` columns of derivatives, from a jitted `fun`.

    `form` is that of `fun`, see `native_functions`. ``jvp(t, y, dy, ...)`` returns the derivative (n,) along dy.
    """
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
    """Return the right-hand side of a state that is that of `rhs` at `places` and constant elsewhere, in place."""
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


@lru_cache(maxsize=256)
def parameter_gradient(fun: Any, p: int, shape: tuple[int, ...], parameters: tuple[int, ...]) -> Any:
    """Return ``slopes(t, y, params) -> (*shape, k)``, derivatives of a jitted invariant by k of its p `parameters`."""
    swapped = njit(lambda t, params, y: fun(t, y, params))
    grad = gradient_by_duals(swapped, p, shape, True)
    sizes, chosen, places = (*shape, p), (*shape, len(parameters)), np.array(parameters, np.int64)

    def slopes(t, y, params):
        found, out = np.empty(sizes), np.empty(chosen)
        grad(t, params, found, y)
        for j in range(places.size):
            out[..., j] = found[..., places[j]]
        return out

    return njit(slopes)
