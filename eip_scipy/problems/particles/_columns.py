"""Variational equations of a charged particle, from the derivatives of its field's functions."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np

from ...core.gradients import NumericalGradient
from ...core.jitted import NotCompilableError, is_jitted, jit_is_off
from ._equations import CHARGE, MASS, FieldFunctions, jit_like

__all__ = ["variational"]


def variational(
    rhs: Callable[..., None],
    functions: FieldFunctions,
    form: str,
    length: float,
    start: tuple[float, ...],
    parameters: tuple[int, ...],
) -> Callable[..., None]:
    """Return the right-hand side of a state and of columns of derivatives, see `variational` of `Problem`.

    `rhs(t, y, out, params)` is that of the state alone, and `parameters` are the indices in [mass, charge] to which the
    last columns belong; any other index raises ValueError. Jitted functions of the field are differentiated by dual
    numbers. Others are differentiated by complex steps if these give correct derivatives at `start` (t, x, y, z),
    otherwise by differences of order 6, with shifts proportional to a coordinate's distance from 0 plus `length`.
    """
    if not set(parameters) <= {MASS, CHARGE}:
        raise ValueError(
            f"variational: a charged particle has derivatives with respect to its state, to parameter {MASS} (the "
            f"mass) and to parameter {CHARGE} (the charge); got parameters={tuple(parameters)}."
        )
    by_mass = np.array([place == MASS for place in parameters], bool)

    def slopes(fun: Callable[..., Any], ndim: int) -> Callable[..., Any]:
        return _slopes(fun, ndim, length, start)

    A, jacobian, _, E, B = functions
    if form == "velocity":
        return _velocity(rhs, B, E, slopes(B, 1), slopes(E, 1), by_mass)
    assert A is not None
    assert jacobian is not None
    return _canonical(rhs, A, jacobian, E, slopes(jacobian, 2), slopes(E, 1), by_mass)


def combined(scale, u, v, w, first, second, third, fourth):
    """Return the vector scale (u first + v second + w third + fourth), from vectors of three numbers."""
    return (
        scale * (u * first[0] + v * second[0] + w * third[0] + fourth[0]),
        scale * (u * first[1] + v * second[1] + w * third[1] + fourth[1]),
        scale * (u * first[2] + v * second[2] + w * third[2] + fourth[2]),
    )


def _canonical(rhs, A, jacobian, E, slopes, slopes_of_E, by_mass):
    last, join = by_mass.size, jit_like(combined, rhs, A, jacobian, E, slopes, slopes_of_E)

    def wide(t, Y, out, params):
        rhs(t, Y[:6], out[:6], params)
        m, q = params[MASS], params[CHARGE]
        a, d, e = A(t, Y[0], Y[1], Y[2]), jacobian(t, Y[0], Y[1], Y[2]), E(t, Y[0], Y[1], Y[2])
        H, F = slopes(t, Y, Y), slopes_of_E(t, Y, Y)
        v0, v1, v2 = out[0], out[1], out[2]
        # The derivative of the force at constant v, row by row.
        x = join(q, v0, v1, v2, H[0][0], H[1][0], H[2][0], F[0])
        y = join(q, v0, v1, v2, H[0][1], H[1][1], H[2][1], F[1])
        z = join(q, v0, v1, v2, H[0][2], H[1][2], H[2][2], F[2])
        inverse, first = 1.0 / m, Y.size - 6 * last
        for k in range(6, Y.size, 6):
            dx, dy, dz = Y[k], Y[k + 1], Y[k + 2]
            dm = dq = 0.0
            if k >= first:
                dm = 1.0 if by_mass[(k - first) // 6] else 0.0
                dq = 1.0 - dm
            dp0 = Y[k + 3] - q * (d[0][0] * dx + d[0][1] * dy + d[0][2] * dz)
            dp1 = Y[k + 4] - q * (d[1][0] * dx + d[1][1] * dy + d[1][2] * dz)
            dp2 = Y[k + 5] - q * (d[2][0] * dx + d[2][1] * dy + d[2][2] * dz)
            dv0 = inverse * (dp0 - dq * a[0] - dm * v0)
            dv1 = inverse * (dp1 - dq * a[1] - dm * v1)
            dv2 = inverse * (dp2 - dq * a[2] - dm * v2)
            u, v, w = q * dv0 + dq * v0, q * dv1 + dq * v1, q * dv2 + dq * v2
            out[k] = dv0
            out[k + 1] = dv1
            out[k + 2] = dv2
            out[k + 3] = u * d[0][0] + v * d[1][0] + w * d[2][0] + dq * e[0] + (x[0] * dx + x[1] * dy + x[2] * dz)
            out[k + 4] = u * d[0][1] + v * d[1][1] + w * d[2][1] + dq * e[1] + (y[0] * dx + y[1] * dy + y[2] * dz)
            out[k + 5] = u * d[0][2] + v * d[1][2] + w * d[2][2] + dq * e[2] + (z[0] * dx + z[1] * dy + z[2] * dz)

    return jit_like(wide, rhs, A, jacobian, E, slopes, slopes_of_E)


def _velocity(rhs, B, E, slopes, slopes_of_E, by_mass):
    last, join = by_mass.size, jit_like(combined, rhs, B, E, slopes, slopes_of_E)

    def wide(t, Y, out, params):
        rhs(t, Y[:6], out[:6], params)
        m, q = params[MASS], params[CHARGE]
        b, r, v0, v1, v2 = B(t, Y[0], Y[1], Y[2]), q / m, Y[3], Y[4], Y[5]
        H, F = slopes(t, Y, Y), slopes_of_E(t, Y, Y)
        # The derivative of the acceleration at constant v, row by row.
        x = join(r, 0.0, -v2, v1, H[0], H[1], H[2], F[0])
        y = join(r, v2, 0.0, -v0, H[0], H[1], H[2], F[1])
        z = join(r, -v1, v0, 0.0, H[0], H[1], H[2], F[2])
        first = Y.size - 6 * last
        for k in range(6, Y.size, 6):
            dx, dy, dz, u, v, w = Y[k], Y[k + 1], Y[k + 2], Y[k + 3], Y[k + 4], Y[k + 5]
            growth = 0.0  # of the acceleration with the parameter, relative
            if k >= first:
                growth = -1.0 / m if by_mass[(k - first) // 6] else 1.0 / q
            out[k] = u
            out[k + 1] = v
            out[k + 2] = w
            out[k + 3] = r * (v * b[2] - w * b[1]) + growth * out[3] + (x[0] * dx + x[1] * dy + x[2] * dz)
            out[k + 4] = r * (w * b[0] - u * b[2]) + growth * out[4] + (y[0] * dx + y[1] * dy + y[2] * dz)
            out[k + 5] = r * (u * b[1] - v * b[0]) + growth * out[5] + (z[0] * dx + z[1] * dy + z[2] * dz)

    return jit_like(wide, rhs, B, E, slopes, slopes_of_E)


@lru_cache(maxsize=64)
def _slopes(fun: Callable[..., Any], ndim: int, length: float, start: tuple[float, ...]) -> Callable[..., Any]:
    """Return ``slopes(t, y, y)``, the derivatives of a field's function with respect to the position y[:3].

    The second y is not used. `ndim` is 1 for a vector and 2 for three rows; the last index is that of the position.
    """
    if is_jitted(fun) and not jit_is_off():
        try:
            return _by_duals(fun, ndim)
        except NotCompilableError:  # numbers may do
            pass
    t, *position = start
    x, floors = np.array(position), np.full(3, length)
    gradient = NumericalGradient(lambda t, x: np.asarray(fun(t, *x)), (), True, t, x, floors, ())
    return lambda t, y, _: gradient(t, y[:3])


def _by_duals(fun: Callable[..., Any], ndim: int) -> Callable[..., Any]:
    """Return the compiled function of `_slopes`, by dual numbers; NotCompilableError if they do not support it."""
    from ...core.dual_arrays import for_duals, inside
    from ...core.dual_numbers import Dual, seed, slope
    from ...core.jitted_gradients import compiled_for

    dual = Dual(3)
    call = for_duals(fun, dual)
    of_number = inside(lambda value: (slope(value, 0), slope(value, 1), slope(value, 2)))
    # The places are constants, since a tuple may hold duals and plain numbers.
    of_vector = inside(lambda values: (of_number(values[0]), of_number(values[1]), of_number(values[2])))
    of_rows = inside(lambda rows: (of_vector(rows[0]), of_vector(rows[1]), of_vector(rows[2])))
    parts = of_vector if ndim == 1 else of_rows

    def slopes(t, y, _, params):
        return parts(call(t, seed(dual, y[0], 0), seed(dual, y[1], 1), seed(dual, y[2], 2)))

    return compiled_for(slopes, 1, False, "")
