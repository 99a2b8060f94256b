"""Potentials of traps, as functions of the coordinates."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ...core.inputs import refuse_units

__all__ = ["harmonic_trap", "quartic_trap"]

Potential = Callable[..., Any]


def harmonic_trap(*gamma: float) -> Potential:
    """Harmonic trap, V = sum_a (gamma_a x_a)^2 / 2.

    Parameters
    ----------
    *gamma : float
        The frequency along each axis.

    Returns
    -------
    callable
        ``V(x[, y[, z]])``.

    Raises
    ------
    ValueError
        If called with another number of coordinates.
    """
    refuse_units(gamma=gamma)
    return lambda *x: 0.5 * _squares(gamma, x)


def quartic_trap(alpha: float, kappa: float, *gamma: float) -> Potential:
    """Quadratic-plus-quartic trap, V = (1 - alpha) / 2 s + kappa / 4 s^2 with s = sum_a (gamma_a x_a)^2.

    Parameters
    ----------
    alpha, kappa : float
    *gamma : float
        The frequency along each axis.

    Returns
    -------
    callable
        ``V(x[, y[, z]])``.
    """
    refuse_units(alpha=alpha, kappa=kappa, gamma=gamma)

    def potential(*x: np.ndarray) -> np.ndarray:
        s = _squares(gamma, x)
        return 0.5 * (1 - alpha) * s + 0.25 * kappa * s * s

    return potential


def _squares(gamma: tuple[float, ...], x: tuple[np.ndarray, ...]) -> Any:
    if len(gamma) != len(x):
        raise ValueError(
            f"a trap of {len(gamma)} frequencies does not fit {len(x)} coordinates; give one frequency for each."
        )
    return sum((g * a) ** 2 for g, a in zip(gamma, x, strict=True))
