"""Functions of the engine that evaluate the equation point by point, and sums over fields.

Fields are contiguous complex arrays with any number of axes, or float views of them (Re, Im, Re, Im ...). A function
writes to its argument `out` or, if it has none, to its first argument. Sums are computed in blocks of a few hundred
points. Therefore they have the same bits on every machine, and their rounding error is that of a sum over one block.
Other Python threads run meanwhile if a field is large.
"""

from __future__ import annotations

from typing import NamedTuple

from ...engine.native import BUILD

__all__ = [
    "Moments",
    "add_potential",
    "derivative",
    "derivative_at_once",
    "divide_by_root",
    "expansion",
    "inner",
    "interaction_energy",
    "local_flow",
    "moments",
    "multiply",
    "quartic_sums",
    "rotate",
    "shifted",
    "total_mass",
    "turn",
    "weighted_square",
]

_native = BUILD.condensates

add_potential = _native.add_potential
"""``add_potential(psi, V, beta, out)``: out += ``(V + beta |psi|^2) psi``."""
derivative = _native.derivative
"""``derivative(rest, psi, V, beta, out)``: out = ``-i (out + rest + (V + beta |psi|^2) psi)``."""
derivative_at_once = _native.derivative_at_once
"""``derivative_at_once(psi, V, beta, out)``: out = ``-i (out + (V + beta |psi|^2) psi)``."""
divide_by_root = _native.divide_by_root
"""``divide_by_root(a, psi, V, beta, shift, out)``: out = ``a / sqrt(shift + V + beta |psi|^2)``; out may be a."""
inner = _native.inner
"""``inner(a, b)``: Re <a, b>, the sum of Re(conj(a) b)."""
interaction_energy = _native.interaction_energy
"""``interaction_energy(psi, V, beta)``: the sum of ``V |psi|^2 + beta / 2 |psi|^4``."""
local_flow = _native.local_flow
"""``local_flow(psi, V, beta, h)``: psi <- ``exp(-i h (V + beta |psi|^2)) psi``, to 1e-15 for angles up to 1e6."""
multiply = _native.multiply
"""``multiply(field, factor)``: field times real factors, one for each point or, of shape (rows, 1), for each row."""
quartic_sums = _native.quartic_sums
"""``quartic_sums(psi, p)``: the sums of nn, nq, mm, mq, qq; n = ``|psi|^2``, m = Re(conj(psi) p), q = ``|p|^2``."""
rotate = _native.rotate
"""``rotate(a, b, c, s)``: a <- c a + s b."""
turn = _native.turn
"""``turn(f, factor, out)``: out = i factor f."""
weighted_square = _native.weighted_square
"""``weighted_square(field, weight)``: the sum of ``weight |field|^2``, weights as factors of `multiply`."""
moments = _native.moments
"""``moments(psi, f)``: return the sums that `Moments` has for a field and its time derivative f = -i H psi."""
total_mass = _native.total_mass
"""``total_mass(psi)``: return the sum of ``|psi|^2``."""
expansion = _native.expansion
"""``expansion(psi, near, f)``: return the sums of ``|d|^2`` and Re(conj(i f) d) for d = psi - near."""
shifted = _native.shifted
"""``shifted(psi, f, a, b, out)``: fill out = psi + a psi + b i f.

Returns the sums of ``|out|^2``, and of ``|d|^2`` and Re(conj(i f) d) for the difference d from psi.
"""


class Moments(NamedTuple):
    """Sums over the grid of ``|psi|^2``, Re(conj(psi) H psi), ``|H psi|^2`` and ``|psi|^4``.

    `sizes` is the sum of the absolute values of the terms of `along`.
    """

    mass: float
    along: float
    square: float
    quartic: float
    sizes: float

    def energy(self, beta: float) -> float:
        """Return the energy divided by the size of a cell; `along` contains beta / 2 times `quartic` twice."""
        return self.along - 0.5 * beta * self.quartic
