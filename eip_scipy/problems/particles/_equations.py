"""Equations of motion, their derivatives, and invariants of a charged particle, from functions of its field.

The functions are compiled if those of the field are jitted, otherwise they are plain Python. In compiled code they are
inlined, and subexpressions that two functions of the field have in common are computed once, so that a loop is as fast
as one written for the field. Components are written out, because Numba accepts only constant indices of a tuple such as
(-y, x, 0), whose types differ.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple, cast

import numpy as np

from ...core.gradients import DIFFERENCE_WEIGHTS, NumericalGradient
from ...core.jitted import NotCompilableError, compiled_like, is_jitted, jit_is_off

__all__ = ["FieldFunctions", "ParticleEquations", "compose", "jit_like", "variational"]

MASS, CHARGE = 0, 1  # places in the parameters


class FieldFunctions(NamedTuple):
    """Functions of a field, with arguments (t, x, y, z); A and its jacobian, or phi, are None if they are not known."""

    A: Callable[..., Any] | None
    jacobian: Callable[..., Any] | None
    phi: Callable[..., Any] | None
    E: Callable[..., Any]
    B: Callable[..., Any]


class ParticleEquations(NamedTuple):
    """Functions of a particle: the energy is None without a potential, and the momentum and its gradient without A.

    The last three functions, which concern the kinetic energy, are None in the canonical form.
    """

    rhs: Callable[..., None]
    energy: Callable[..., float] | None
    energy_gradient: Callable[..., None]
    momentum: Callable[..., float] | None
    momentum_gradient: Callable[..., None] | None
    kinetic: Callable[..., float] | None = None
    kinetic_gradient: Callable[..., None] | None = None
    power: Callable[..., float] | None = None


def jit_like(fun: Callable[..., Any], *others: Callable[..., Any] | None) -> Callable[..., Any]:
    """Return `fun`, compiled if all `others`, except None, are compiled."""
    return compiled_like(fun, *(other for other in others if other is not None))


def no_potential(t, x, y, z):
    """Return 0, the potential of a field without one."""
    return 0.0


def no_force(t, x, y, z):
    """Return (0, 0, 0), the electric field of a field without one."""
    return 0.0, 0.0, 0.0


@lru_cache(maxsize=32)  # compiled once in a process
def compose(field: FieldFunctions, form: str) -> ParticleEquations:
    """Return the equations of motion and the invariants of a particle in the form "canonical" or "velocity".

    The equations need A, jacobian and E in the canonical form, and B and E in the form (x, v). The other functions are
    needed for invariants only. The results are functions of ``(t, y, [f,] [out,] params)``.
    """
    return _canonical(field) if form == "canonical" else _velocity(field)


# The canonical form, y = (x, p).


def _canonical(field: Any) -> ParticleEquations:
    A, jacobian, phi, E = field.A, field.jacobian, field.phi, field.E

    def rhs(t, y, out, params):
        # x' = v = (p - q A) / m and p_j' = q (sum_i v_i dA_i/dx_j + E_j)
        a, d, e = A(t, y[0], y[1], y[2]), jacobian(t, y[0], y[1], y[2]), E(t, y[0], y[1], y[2])
        q = params[CHARGE]
        inverse = 1.0 / params[MASS]  # does not wait for the field, as a division of the velocity would
        u, v, w = (y[3] - q * a[0]) * inverse, (y[4] - q * a[1]) * inverse, (y[5] - q * a[2]) * inverse
        out[0] = u
        out[1] = v
        out[2] = w
        out[3] = q * (u * d[0][0] + v * d[1][0] + w * d[2][0] + e[0])
        out[4] = q * (u * d[0][1] + v * d[1][1] + w * d[2][1] + e[1])
        out[5] = q * (u * d[0][2] + v * d[1][2] + w * d[2][2] + e[2])

    def energy(t, y, params):
        # H = |p - q A|^2 / (2 m) + q phi (Cai, Gong & Wang, eq. 3.7)
        q, a = params[CHARGE], A(t, y[0], y[1], y[2])
        u, v, w = y[3] - q * a[0], y[4] - q * a[1], y[5] - q * a[2]
        return 0.5 / params[MASS] * (u * u + v * v + w * w) + q * phi(t, y[0], y[1], y[2])

    return ParticleEquations(
        jit_like(rhs, A, jacobian, E),
        None if phi is None else jit_like(energy, A, phi),
        jit_like(canonical_energy_gradient, A, jacobian, E),
        jit_like(canonical_momentum, A),
        jit_like(canonical_momentum_gradient, A),
    )


def canonical_energy_gradient(t, y, f, out, params):
    """Fill `out` with the gradient of H, which the canonical equations give: dH/dx = -p', dH/dp = x'."""
    out[0] = -f[3]
    out[1] = -f[4]
    out[2] = -f[5]
    out[3] = f[0]
    out[4] = f[1]
    out[5] = f[2]


def canonical_momentum(t, y, params):
    """Return L = x p_y - y p_x (Cai, Gong & Wang, eq. 3.9, with its misprint corrected)."""
    return y[0] * y[4] - y[1] * y[3]


def canonical_momentum_gradient(t, y, out, params):
    """Fill `out` with the gradient of L."""
    out[0] = y[4]
    out[1] = -y[3]
    out[2] = 0.0
    out[3] = -y[1]
    out[4] = y[0]
    out[5] = 0.0


# The form y = (x, v).


def _velocity(field: Any) -> ParticleEquations:
    _, _, phi, E, B = field

    def rhs(t, y, out, params):
        # x' = v and v' = (q / m) (E + v x B) (Cai, Gong & Wang, eq. 3.8)
        e, b = E(t, y[0], y[1], y[2]), B(t, y[0], y[1], y[2])
        ratio, u, v, w = params[CHARGE] / params[MASS], y[3], y[4], y[5]
        out[0] = u
        out[1] = v
        out[2] = w
        out[3] = ratio * (e[0] + v * b[2] - w * b[1])
        out[4] = ratio * (e[1] + w * b[0] - u * b[2])
        out[5] = ratio * (e[2] + u * b[1] - v * b[0])

    def energy(t, y, params):
        # H = m |v|^2 / 2 + q phi
        square = y[3] * y[3] + y[4] * y[4] + y[5] * y[5]
        return 0.5 * params[MASS] * square + params[CHARGE] * phi(t, y[0], y[1], y[2])

    def energy_gradient(t, y, out, params):
        # (-q E, m v)
        e, m, q = E(t, y[0], y[1], y[2]), params[MASS], params[CHARGE]
        out[0] = -q * e[0]
        out[1] = -q * e[1]
        out[2] = -q * e[2]
        out[3] = m * y[3]
        out[4] = m * y[4]
        out[5] = m * y[5]

    def power(t, y, params):
        e = E(t, y[0], y[1], y[2])
        return params[CHARGE] * (y[3] * e[0] + y[4] * e[1] + y[5] * e[2])

    momentum, momentum_gradient = (None, None) if field.A is None else _velocity_momentum(field.A, field.jacobian)
    return ParticleEquations(
        jit_like(rhs, E, B),
        None if phi is None else jit_like(energy, phi),
        jit_like(energy_gradient, E),
        momentum,
        momentum_gradient,
        jit_like(kinetic_energy, E),
        jit_like(kinetic_energy_gradient, E),
        jit_like(power, E),
    )


def _velocity_momentum(A, jacobian):
    def momentum(t, y, params):
        # L = x p_y - y p_x with p = m v + q A
        a, m, q = A(t, y[0], y[1], y[2]), params[MASS], params[CHARGE]
        return y[0] * (m * y[4] + q * a[1]) - y[1] * (m * y[3] + q * a[0])

    def gradient(t, y, out, params):
        a, d, m, q = A(t, y[0], y[1], y[2]), jacobian(t, y[0], y[1], y[2]), params[MASS], params[CHARGE]
        out[0] = q * (y[0] * d[1][0] - y[1] * d[0][0] + a[1]) + m * y[4]
        out[1] = q * (y[0] * d[1][1] - y[1] * d[0][1] - a[0]) - m * y[3]
        out[2] = q * (y[0] * d[1][2] - y[1] * d[0][2])
        out[3] = -m * y[1]
        out[4] = m * y[0]
        out[5] = 0.0

    return jit_like(momentum, A), jit_like(gradient, A, jacobian)


def kinetic_energy(t, y, params):
    """Return the kinetic energy m |v|^2 / 2."""
    return 0.5 * params[MASS] * (y[3] * y[3] + y[4] * y[4] + y[5] * y[5])


def kinetic_energy_gradient(t, y, out, params):
    """Fill `out` with the gradient of the kinetic energy, (0, m v)."""
    out[:3] = 0.0
    out[3] = params[MASS] * y[3]
    out[4] = params[MASS] * y[4]
    out[5] = params[MASS] * y[5]


# Missing functions of a field, computed from those that it has.


def at_any_time(fun: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of (t, x, y, z) with the values of `fun`, a function of (x, y, z)."""

    def timeless(t, x, y, z):
        return fun(x, y, z)

    if not is_jitted(fun):
        return timeless
    from numba import njit

    # A function that returns an array needs Numba's memory, which the callers here are compiled without.
    return cast(Callable[..., Any], njit(timeless, error_model="numpy", _nrt=True))


def curl(jacobian: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function B = curl A of (t, x, y, z), from the function of the rows dA_i/dx_j."""

    def magnetic(t, x, y, z):
        d = jacobian(t, x, y, z)
        return d[2][1] - d[1][2], d[0][2] - d[2][0], d[1][0] - d[0][1]

    return jit_like(magnetic, jacobian)


def difference_jacobian(A: Callable[..., Any], step: float) -> Callable[..., Any]:
    """Return a function of the rows dA_i/dx_j, computed by central differences of order 6 with the shift `step`."""

    def along(t, x, y, z, dx, dy, dz):
        d0 = d1 = d2 = 0.0
        for k, weight in DIFFERENCE_WEIGHTS:
            right = A(t, x + k * dx, y + k * dy, z + k * dz)
            left = A(t, x - k * dx, y - k * dy, z - k * dz)
            d0 += weight * (right[0] - left[0])
            d1 += weight * (right[1] - left[1])
            d2 += weight * (right[2] - left[2])
        return d0 / step, d1 / step, d2 / step

    along = jit_like(along, A)

    def jacobian(t, x, y, z):
        a = along(t, x, y, z, step, 0.0, 0.0)
        b = along(t, x, y, z, 0.0, step, 0.0)
        c = along(t, x, y, z, 0.0, 0.0, step)
        return (a[0], b[0], c[0]), (a[1], b[1], c[1]), (a[2], b[2], c[2])

    return jit_like(jacobian, A)


def difference_force(phi: Callable[..., Any], step: float) -> Callable[..., Any]:
    """Return the function E = -grad phi, computed by central differences of order 6 with the shift `step`."""

    def force(t, x, y, z):
        e0 = e1 = e2 = 0.0
        for k, weight in DIFFERENCE_WEIGHTS:
            e0 -= weight * (phi(t, x + k * step, y, z) - phi(t, x - k * step, y, z))
            e1 -= weight * (phi(t, x, y + k * step, z) - phi(t, x, y - k * step, z))
            e2 -= weight * (phi(t, x, y, z + k * step) - phi(t, x, y, z - k * step))
        return e0 / step, e1 / step, e2 / step

    return jit_like(force, phi)


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
        return _velocity_columns(rhs, B, E, slopes(B, 1), slopes(E, 1), by_mass)
    assert A is not None
    assert jacobian is not None
    return _canonical_columns(rhs, A, jacobian, E, slopes(jacobian, 2), slopes(E, 1), by_mass)


def combined(scale, u, v, w, first, second, third, fourth):
    """Return the vector scale (u first + v second + w third + fourth), from vectors of three numbers."""
    return (
        scale * (u * first[0] + v * second[0] + w * third[0] + fourth[0]),
        scale * (u * first[1] + v * second[1] + w * third[1] + fourth[1]),
        scale * (u * first[2] + v * second[2] + w * third[2] + fourth[2]),
    )


def _canonical_columns(rhs, A, jacobian, E, slopes, slopes_of_E, by_mass):
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


def _velocity_columns(rhs, B, E, slopes, slopes_of_E, by_mass):
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
