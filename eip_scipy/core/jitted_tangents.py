"""Compiled functions of an augmented state; imported only if there are jitted functions to make them from."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit

from .dual_arrays import for_duals, inside
from .dual_numbers import put_slope, seed, slope, value_of
from .jitted_gradients import compiled_for, dual_along, gradient_by_duals, new_state

__all__ = ["parameter_gradient", "rearranged", "rhs_by_duals", "rhs_by_products"]

# Augmented states have the order (y, p, first vector, second vector, ...) here: the parameters p that derivatives are
# taken by follow the n components as constants, so that each vector has size = n + len(p) numbers.


@lru_cache(maxsize=64)
def rhs_by_duals(
    fun: Any, form: str, n: int, parameters: tuple[int, ...], count: int, has_params: bool, scalars: str
) -> Any:
    """Return ``rhs(t, Y, out, ...)``, the in-place right-hand side of an augmented state, for a jitted `fun`.

    Y consists of the state (n,), the parameters with the indices `parameters`, and `count` tangent vectors. The
    derivatives of `fun` are exact up to rounding. `form` is that of `fun`, see `native_functions`. If `scalars` is not
    empty, `fun` takes numbers of these types instead of params, see `scalars`. Raise NotCompilableError if dual numbers
    cannot do what `fun` does.
    """
    dual = dual_along(count)
    lanes = dual.lanes
    taken = n // 2 if form.startswith("acceleration") else n
    offset, size = n - taken, n + len(parameters)
    user, new = _returning(for_duals(fun, dual), form), new_state(dual, taken)

    def seeded(Y, first, i):
        x = seed(dual, Y[i], lanes)
        for lane in range(min(lanes, count - first)):
            x = put_slope(x, lane, Y[size * (1 + first + lane) + i])
        return x

    seeded = inside(seeded)
    seeded_args = _seeded_args(dual, parameters, n, seeded)

    def fill(t, Y, out, args):
        out[:] = 0.0
        x, f = new(), new()
        for first in range(0, count, lanes):
            for i in range(taken):
                x[i] = seeded(Y, first, i)
            found = user(t, x, f, seeded_args(args, Y, first))
            for i in range(offset):
                out[i] = Y[taken + i]
            for i in range(taken):
                out[offset + i] = value_of(found[i])
            for lane in range(min(lanes, count - first)):
                start = size * (1 + first + lane)
                for i in range(offset):
                    out[start + i] = Y[start + taken + i]
                for i in range(taken):
                    out[start + offset + i] = slope(found[i], lane)

    return compiled_for(fill, 1, has_params, scalars)


def _seeded_args(dual: Any, parameters: tuple[int, ...], n: int, seeded: Any) -> Any:
    """Return a function that returns the arguments ``(params,)`` as duals, or any arguments without `parameters`.

    Their slopes are those in the tangent vectors of Y from the vector `first` on, or 0 for other parameters.
    ``seeded(Y, first, i)`` returns entry i of Y as such a dual; the parameters follow the `n` entries of the state.
    """
    if not parameters:
        return inside(lambda args, Y, first: args)
    places, lanes = np.array(parameters, np.int64), dual.lanes

    def as_duals(args, Y, first):
        params = args[0]
        p = np.empty(params.size, dual)
        for i in range(params.size):
            p[i] = seed(dual, params[i], lanes)
        for j in range(places.size):
            p[places[j]] = seeded(Y, first, n + j)
        return (p,)

    return inside(as_duals)


def _returning(fun: Any, form: str) -> Any:
    """Return ``call(t, x, out, args)``, which returns the value of `fun` at x; an in-place `fun` writes to `out`."""
    if not form.endswith("place"):
        return inside(lambda t, x, out, args: fun(t, x, *args))

    def filled(t, x, out, args):
        fun(t, x, out, *args)
        return out

    return inside(filled)


@lru_cache(maxsize=256)
def rhs_by_products(fun: Any, form: str, jvp: Any, n: int, count: int) -> Any:
    """Return the in-place right-hand side of a state (n,) with `count` tangent vectors, from a jitted `fun`.

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
        for k in range(1, count + 1):
            out[n * k : n * (k + 1)] = jvp(t, y, Y[n * k : n * (k + 1)], *extra)

    return njit(rhs)


@lru_cache(maxsize=256)
def rearranged(rhs: Any, places: tuple[int, ...]) -> Any:
    """Return the in-place right-hand side of a state that is that of `rhs` at `places` and constant elsewhere."""
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
