"""The plane pendulum."""

from __future__ import annotations

import math

import numpy as np

from ..core.inputs import refuse_units
from ..core.invariants import Invariant
from ..core.problem import Problem, bind
from ..engine.caching import cached_njit

__all__ = ["pendulum"]


@cached_njit()
def _rhs(t, y, out, params):
    out[0] = y[1]
    out[1] = -params[0] * math.sin(y[0])


@cached_njit()
def _energy(t, y, params):
    return 0.5 * y[1] * y[1] - params[0] * math.cos(y[0])


@cached_njit()
def _energy_gradient(t, y, out, params):
    out[0] = params[0] * math.sin(y[0])
    out[1] = y[1]


def pendulum(amplitude: float = 2.0, frequency: float = 1.0, t_end: float = 20.0, h: float = 0.05) -> Problem:
    """Plane pendulum q'' = -omega^2 sin q, let go at rest, with ``H = q'^2 / 2 - omega^2 cos q``.

    Parameters
    ----------
    amplitude : float
        Angle at the start [rad].
    frequency : float
        Angular frequency omega of small oscillations.
    t_end, h : float
        End of the interval that starts at 0, and a step.

    Returns
    -------
    Problem
    """
    refuse_units(amplitude=amplitude, frequency=frequency, t_end=t_end, h=h)
    params = np.array([frequency * frequency], dtype=float)
    return Problem(
        name="pendulum",
        fun=bind(_rhs, params),
        rhs=_rhs,
        y0=np.array([amplitude, 0.0]),
        t_span=(0.0, t_end),
        h=h,
        params=params,
        invariants=(Invariant(_energy, _energy_gradient, args=(params,), in_place=True, name="H"),),
        units="dimensionless",
        source="L. D. Landau, E. M. Lifshitz, Mechanics, section 11, problem 1",
    )
