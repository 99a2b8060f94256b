"""Mass, energy and products of their gradients from psi and f = -i H psi, in one pass without a transform."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...engine.native import BUILD

__all__ = ["Moments", "expansion", "moments", "shifted", "total_mass"]

_native = BUILD.condensates


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


def moments(psi: np.ndarray, f: np.ndarray) -> Moments:
    """Return the sums over the grid for a field `psi` and its time derivative f = -i H psi."""
    return Moments(*_native.moments(psi, f))


total_mass = _native.total_mass
"""``total_mass(psi)``: return the sum of ``|psi|^2``."""
expansion = _native.expansion
"""``expansion(psi, near, f)``: return the sums of ``|d|^2`` and Re(conj(i f) d) for d = psi - near."""
shifted = _native.shifted
"""``shifted(psi, f, a, b, out)``: fill out = psi + a psi + b i f.

Returns the sums of ``|out|^2``, and of ``|d|^2`` and Re(conj(i f) d) for the difference d from psi.
"""
