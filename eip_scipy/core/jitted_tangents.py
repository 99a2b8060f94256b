"""Compiled functions of an augmented state; imported only if there are jitted functions to make them from."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit

from .dual_arrays import for_duals, inside
from .dual_numbers import put_slope, seed, slope, value_of
from .jitted_gradients import compiled_for, dual_along, gradient_by_duals, new_state

__all__ = ["parameter_gradient", "rhs_by_duals"]

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
    dual, places = dual_along(count), np.array(parameters, np.int64)
    lanes, size = dual.lanes, n + len(parameters)
    taken = n // 2 if form.startswith("acceleration") else n
    offset, in_place, by_parameters = n - taken, form.endswith("place"), len(parameters) > 0
    user, new = for_duals(fun, dual), new_state(dual, taken)

    def seeded(Y, first, i):
        x = seed(dual, Y[i], lanes)
        for lane in range(min(lanes, count - first)):
            x = put_slope(x, lane, Y[size * (1 + first + lane) + i])
        return x

    seeded = inside(seeded)

    def fill(t, Y, out, args):
        out[:] = 0.0
        x, found = new(), new()
        for first in range(0, count, lanes):
            for i in range(taken):
                x[i] = seeded(Y, first, i)
            if by_parameters:
                p = np.empty(args[0].size, dual)
                for i in range(p.size):
                    p[i] = seed(dual, args[0][i], lanes)
                for j in range(places.size):
                    p[places[j]] = seeded(Y, first, n + j)
                given = (p,)
            else:
                given = args
            if in_place:
                user(t, x, found, *given)
                f = found
            else:
                f = user(t, x, *given)
            for i in range(offset):
                out[i] = Y[taken + i]
            for i in range(taken):
                out[offset + i] = value_of(f[i])
            for lane in range(min(lanes, count - first)):
                start = size * (1 + first + lane)
                for i in range(offset):
                    out[start + i] = Y[start + taken + i]
                for i in range(taken):
                    out[start + offset + i] = slope(f[i], lane)

    return compiled_for(fill, 1, has_params, scalars)


@lru_cache(maxsize=256)
def parameter_gradient(fun: Any, p: int, shape: tuple[int, ...], parameters: tuple[int, ...]) -> Any:
    """Return ``slopes(t, y, params) -> (*shape, k)``, derivatives of a jitted invariant by k of its p `parameters`."""
    swapped = njit(lambda t, params, y: fun(t, y, params))
    grad = gradient_by_duals(swapped, p, shape, True)
    sizes, places = (*shape, p), np.array(parameters, np.int64)

    def slopes(t, y, params):
        found = np.empty(sizes)
        grad(t, params, found, y)
        return found[..., places]

    return njit(slopes)
