"""Functions of the engine that evaluate the equation point by point, and sums over fields.

Fields are contiguous complex arrays with any number of axes, or float views of them (Re, Im, Re, Im ...). A function
writes to its argument `out` or, if it has none, to its first argument. Sums are computed in blocks of a few hundred
points. Therefore they have the same bits on every machine, and their rounding error is that of a sum over one block.
Other Python threads run meanwhile if a field is large.
"""

from __future__ import annotations

from ...engine.native import BUILD

__all__ = [
    "add_potential",
    "derivative",
    "derivative_at_once",
    "divide_by_root",
    "inner",
    "interaction_energy",
    "local_flow",
    "multiply",
    "quartic_sums",
    "rotate",
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
