"""Functions of the engine that evaluate the equation point by point, and sums over fields.

Fields are contiguous complex arrays with any number of axes, or float views of them (Re, Im, Re, Im ...). A function
writes to its argument `out` or, if it has none, to its first argument. Sums are computed in blocks of a few hundred
points. Therefore they have the same bits on every machine, and their rounding error is that of a sum over one block.
Other Python threads run meanwhile if a field is large.

Within a step mass, energy and products of their gradients follow from psi and f = -i H psi without transforms.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ...engine.native import BUILD

if TYPE_CHECKING:
    from .equation import GrossPitaevskii

__all__ = [
    "Energy",
    "Joint",
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


NEGLIGIBLE = 1e-16  # less than half a rounding, of a bound that is far too large
JOINT = ("mass", "energy")


class _Known:
    """Energy of a state at which f = -i H psi is known, and, by an expansion, of states at distances of about 1e-12."""

    def __init__(self, gpe: GrossPitaevskii) -> None:
        self._gpe, self._norm = gpe, gpe.largest_frequency()
        self.energy, self._peak = 0.0, np.inf  # the latter a bound of |psi|^2

    def note(self, psi: np.ndarray, f: np.ndarray) -> Moments:
        """Store the energy of a state, computed from f at this state, and return the sums from which it follows."""
        gpe = self._gpe
        found = gpe.moments(psi, f)
        self.energy, self._peak = gpe.grid.cell * found.energy(gpe.beta), found.quartic**0.5
        return found

    def beside(self, square: float, slope: float) -> float | None:
        """Return the energy of psi + d for a small d, where psi is the state of the last `note`.

        `square` is the sum of ``|d|^2``, and `slope` that of Re(conj(H psi) d). The result is None if terms of second
        order and higher are not far below the rounding of the energy.
        """
        cell = self._gpe.grid.cell
        density = 3 * self._peak + 2 * (self._peak * square) ** 0.5 + 0.5 * square
        rest = (self._norm + abs(self._gpe.beta) * density) * square
        return self.energy + 2 * cell * slope if cell * rest <= NEGLIGIBLE * abs(self.energy) else None


class Energy:
    """The energy as an invariant: its value, and its gradient 2 w i f with f = -i H psi and the size w of a cell.

    A step needs the gradient and the energy at its unprojected result, and the energy of the projected state. None of
    these needs a transform.
    """

    def __init__(self, gpe: GrossPitaevskii) -> None:
        self._gpe, self._known = gpe, _Known(gpe)
        self._near: tuple[np.ndarray, np.ndarray] | None = None  # the state noted last and f there

    def value(self, y: np.ndarray) -> float:
        """Return the energy of a state, without a transform if the state is very near that of the last `gradient`."""
        gpe = self._gpe
        energy = None
        if self._near is not None:
            sums = expansion(gpe.as_field(y), *self._near)
            energy = self._known.beside(*gpe._total(sums))
        return gpe.energy(y) if energy is None else energy

    def gradient(self, t: float, y: np.ndarray, f: np.ndarray, out: np.ndarray) -> None:
        """Fill `out` with the gradient at `y`, where the right-hand side is `f`."""
        turn(f, 2 * self._gpe.grid.cell, out)  # 2 w H psi, and H psi = i f
        # Copies: the caller may use its arrays for something else.
        if self._near is None:
            self._near = np.empty_like(y), np.empty_like(f)
        for kept, given in zip(self._near, (y, f), strict=True):
            kept[:] = given
        self._known.note(y, f)


class Joint:
    """The functions `moments` and `shift` of `JointInvariants` for mass and energy, or one of them.

    A projection takes two passes over the field. The gradients 2 w psi and 2 w H psi = 2 w i f, with the size w of a
    cell, are never stored: their products and the energy are computed as sums over psi and f.
    """

    def __init__(self, gpe: GrossPitaevskii, names: tuple[str, ...]) -> None:
        self._gpe, self._known = gpe, _Known(gpe)
        self._mass, self._energy = (names.index(name) if name in names else None for name in JOINT)

    def moments(
        self, t: float, y: np.ndarray, f: np.ndarray, values: np.ndarray, gram: np.ndarray, terms: np.ndarray
    ) -> None:
        """Fill the arrays that a projection needs at the state y (n,), where f = -i H psi.

        These are the values of the invariants (l,), the inner products of their gradients (l, l), and the sums (l,) of
        ``|G_k y_k|`` over the real components of the state, to which the rounding errors of the values are
        proportional.
        """
        found, w = self._known.note(y, f), self._gpe.grid.cell
        m, e = self._mass, self._energy
        if m is not None:
            values[m], gram[m, m], terms[m] = w * found.mass, 4 * w * w * found.mass, 2 * w * found.mass
        if e is not None:
            values[e], gram[e, e], terms[e] = self._known.energy, 4 * w * w * found.square, 2 * w * found.sizes
        if m is not None and e is not None:
            gram[m, e] = gram[e, m] = 4 * w * w * found.along

    def shift(
        self, t: float, y: np.ndarray, f: np.ndarray, mu: np.ndarray, out: np.ndarray, values: np.ndarray
    ) -> None:
        """Fill `out` with ``y + sum_i mu_i G_i(y)``, and `values` with the invariants there.

        y and f are those of the last `moments`, and the gradients G_i (l,) are those at y. The energy is computed with
        a transform only if the shift is large.
        """
        gpe, w = self._gpe, self._gpe.grid.cell
        a, b = (0.0 if k is None else 2 * w * mu[k] for k in (self._mass, self._energy))
        mass, square, slope = gpe._total(shifted(y, f, a, b, out))
        if self._mass is not None:
            values[self._mass] = w * mass
        if self._energy is not None:
            energy = self._known.beside(square, slope)
            values[self._energy] = gpe.energy(out) if energy is None else energy
