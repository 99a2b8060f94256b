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

from ...core.derivatives import DIFFERENCE_WEIGHTS
from ...core.functions import compiled_like, is_jitted

__all__ = ["FieldFunctions", "ParticleEquations", "compose", "jit_like"]

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
