"""Equations of motion, energies and angular momentum of a charged particle, from the functions of its field.

The functions are compiled if those of the field are jitted, otherwise they are plain Python. In compiled code they are
inlined, and what several of them compute is computed once, so that a loop is as fast as one written for the field.
Components are written out, because Numba accepts only constant indices of a tuple such as (-y, x, 0), whose types
differ.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

from ...core.functions import compiled_like

__all__ = ["CHARGE", "MASS", "FieldFunctions", "Motion", "motion", "no_force", "no_potential"]

MASS, CHARGE = 0, 1  # places in the parameters

Function = Callable[..., Any]


class FieldFunctions(NamedTuple):
    """Functions of a field, with arguments (t, x, y, z); A and its jacobian, or phi, are None if they are not known."""

    A: Function | None
    jacobian: Function | None
    phi: Function | None
    E: Function
    B: Function


class Motion(NamedTuple):
    """Functions of ``(t, y, [f,] [out,] params)``: value and gradient of each quantity.

    The kinetic energy also has its rate, in the second place; it is None in the canonical form. Energy and
    momentum are None if the field lacks what they need.
    """

    rhs: Function
    energy: tuple[Function, Function] | None
    momentum: tuple[Function, Function] | None
    kinetic: tuple[Function, Function, Function] | None = None


def no_potential(t, x, y, z):
    """Return 0, the potential of a field without one."""
    return 0.0


def no_force(t, x, y, z):
    """Return (0, 0, 0), the electric field of a field without one."""
    return 0.0, 0.0, 0.0


@lru_cache(maxsize=32)  # compiled once in a process
def motion(field: FieldFunctions, form: str) -> Motion:
    """Return the functions of a particle in the form "canonical", which needs A, or "velocity"."""
    return _canonical(field) if form == "canonical" else _of_velocity(field)


def _canonical(field: Any) -> Motion:
    """Return the functions of a state (x, p)."""
    A, jacobian, phi, E, _ = field

    def velocity(t, y, params):
        # Multiplying by 1 / m does not wait for the field, as a division would.
        a, q, inverse = A(t, y[0], y[1], y[2]), params[CHARGE], 1.0 / params[MASS]
        return (y[3] - q * a[0]) * inverse, (y[4] - q * a[1]) * inverse, (y[5] - q * a[2]) * inverse

    velocity = compiled_like(velocity, A)

    def rhs(t, y, out, params):
        # x' = v and p_j' = q (sum_i v_i dA_i/dx_j + E_j)
        u, v, w = velocity(t, y, params)
        d, e, q = jacobian(t, y[0], y[1], y[2]), E(t, y[0], y[1], y[2]), params[CHARGE]
        out[0], out[1], out[2] = u, v, w
        out[3] = q * (u * d[0][0] + v * d[1][0] + w * d[2][0] + e[0])
        out[4] = q * (u * d[0][1] + v * d[1][1] + w * d[2][1] + e[1])
        out[5] = q * (u * d[0][2] + v * d[1][2] + w * d[2][2] + e[2])

    def energy_gradient(t, y, f, out, params):
        out[0], out[1], out[2] = -f[3], -f[4], -f[5]
        out[3], out[4], out[5] = f[0], f[1], f[2]

    def momentum(t, y, params):
        # L = x p_y - y p_x (Cai, Gong & Wang, eq. 3.9, with its misprint corrected)
        return y[0] * y[4] - y[1] * y[3]

    def momentum_gradient(t, y, out, params):
        out[0], out[1], out[2] = y[4], -y[3], 0.0
        out[3], out[4], out[5] = -y[1], y[0], 0.0

    return Motion(
        compiled_like(rhs, A, jacobian, E),
        phi and (_energy(velocity, phi), compiled_like(energy_gradient, A, jacobian, E)),
        (compiled_like(momentum, A), compiled_like(momentum_gradient, A)),
    )


def _of_velocity(field: Any) -> Motion:
    """Return the functions of a state (x, v)."""
    A, jacobian, phi, E, B = field

    def rhs(t, y, out, params):
        # x' = v and v' = (q / m) (E + v x B) (Cai, Gong & Wang, eq. 3.8)
        e, b = E(t, y[0], y[1], y[2]), B(t, y[0], y[1], y[2])
        ratio, u, v, w = params[CHARGE] / params[MASS], y[3], y[4], y[5]
        out[0], out[1], out[2] = u, v, w
        out[3] = ratio * (e[0] + v * b[2] - w * b[1])
        out[4] = ratio * (e[1] + w * b[0] - u * b[2])
        out[5] = ratio * (e[2] + u * b[1] - v * b[0])

    def velocity(t, y, params):
        return y[3], y[4], y[5]

    def power(t, y, params):
        e = E(t, y[0], y[1], y[2])
        return params[CHARGE] * (y[3] * e[0] + y[4] * e[1] + y[5] * e[2])

    def momentum(t, y, params):
        # L = x p_y - y p_x with p = m v + q A
        a, m, q = A(t, y[0], y[1], y[2]), params[MASS], params[CHARGE]
        return y[0] * (m * y[4] + q * a[1]) - y[1] * (m * y[3] + q * a[0])

    def momentum_gradient(t, y, out, params):
        a, d, m, q = A(t, y[0], y[1], y[2]), jacobian(t, y[0], y[1], y[2]), params[MASS], params[CHARGE]
        out[0] = q * (y[0] * d[1][0] - y[1] * d[0][0] + a[1]) + m * y[4]
        out[1] = q * (y[0] * d[1][1] - y[1] * d[0][1] - a[0]) - m * y[3]
        out[2] = q * (y[0] * d[1][2] - y[1] * d[0][2])
        out[3], out[4], out[5] = -m * y[1], m * y[0], 0.0

    velocity, nothing, still = (compiled_like(fun, E) for fun in (velocity, no_force, no_potential))
    return Motion(
        compiled_like(rhs, E, B),
        phi and (_energy(velocity, phi), _energy_gradient(E)),
        A and (compiled_like(momentum, A), compiled_like(momentum_gradient, A, jacobian)),
        (_energy(velocity, still), compiled_like(power, E), _energy_gradient(nothing)),
    )


def _energy(velocity: Function, phi: Function) -> Function:
    def energy(t, y, params):
        # H = m |v|^2 / 2 + q phi (Cai, Gong & Wang, eq. 3.7)
        u, v, w = velocity(t, y, params)
        return 0.5 * params[MASS] * (u * u + v * v + w * w) + params[CHARGE] * phi(t, y[0], y[1], y[2])

    return compiled_like(energy, velocity, phi)


def _energy_gradient(E: Function) -> Function:
    def gradient(t, y, out, params):
        e, m, q = E(t, y[0], y[1], y[2]), params[MASS], params[CHARGE]
        out[0], out[1], out[2] = -q * e[0], -q * e[1], -q * e[2]
        out[3], out[4], out[5] = m * y[3], m * y[4], m * y[5]

    return compiled_like(gradient, E)
