"""Duffing's oscillator without damping or driving."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..core.invariants import Invariant
from ..core.problem import Problem

__all__ = ["duffing"]


def duffing(stiffness: float = 1.0, bend: float = 1.0, y0: Any = (1.0, 0.0), h: float = 0.05) -> Problem:
    """Return q'' = -stiffness q - bend q^3 with its energy.

    Parameters
    ----------
    stiffness, bend : float
    y0 : array_like, shape (2,)
    h : float
        A step.

    Returns
    -------
    Problem
    """

    def fun(t: float, y: np.ndarray) -> np.ndarray:
        return np.array([y[1], -stiffness * y[0] - bend * y[0] ** 3])

    def energy(t: float, y: np.ndarray) -> float:
        return float(0.5 * y[1] ** 2 + 0.5 * stiffness * y[0] ** 2 + 0.25 * bend * y[0] ** 4)

    def gradient(t: float, y: np.ndarray) -> np.ndarray:
        return np.array([stiffness * y[0] + bend * y[0] ** 3, y[1]])

    return Problem(
        name="duffing",
        fun=fun,
        y0=np.array(y0, float),
        t_span=(0.0, 20.0),
        h=h,
        invariants=(Invariant(energy, gradient, name="H"),),
        component_names=("q", "p"),
        source="G. Duffing, Erzwungene Schwingungen bei veraenderlicher Eigenfrequenz (1918)",
    )
