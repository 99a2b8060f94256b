"""The harmonic oscillator of tables 1 and 2 of Cai, Gong & Wang."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from ..core.inputs import refuse_units
from ..core.problem import Problem, bind, library_variational, native_invariant
from ..engine.native import library

__all__ = ["harmonic"]


def harmonic(omega: float = 10.0, y0: Any = (1.0, 0.0), t_end: float = 1.0, h: float = 0.1) -> Problem:
    """Return the harmonic oscillator y1' = omega y2, y2' = -omega y1 with the energy ``H = omega |y|^2 / 2``.

    Parameters
    ----------
    omega : float
        Angular frequency.
    y0 : array_like, shape (2,)
    t_end, h : float
        End of the interval that starts at 0, and the step.

    Returns
    -------
    Problem
        With the closed form as `reference`.
    """
    refuse_units(omega=omega, y0=y0, t_end=t_end, h=h)
    start = np.array(y0, dtype=float)
    params = np.array([omega], dtype=float)

    return Problem(
        name="harmonic",
        fun=bind(library["harmonic.rhs"], params),
        rhs=library["harmonic.rhs"],
        y0=start,
        t_span=(0.0, t_end),
        h=h,
        params=params,
        invariants=(native_invariant("harmonic.energy", "H", params),),
        reference=partial(_rotated, omega, start),
        variational=partial(library_variational, "harmonic.variational", ("omega",)),
        component_names=("q", "p"),
        canonical=True,
        units="dimensionless",
        source="Cai, Gong & Wang, section 2.1",
    )


def _rotated(omega: float, start: np.ndarray, t: float) -> np.ndarray:
    c, s = np.cos(omega * t), np.sin(omega * t)
    return np.array([c * start[0] + s * start[1], c * start[1] - s * start[0]])
