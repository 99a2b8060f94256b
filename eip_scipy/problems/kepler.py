"""The Kepler problem with the relativistic perturbation of the paper's Experiment I."""

from __future__ import annotations

from math import sqrt

import numpy as np
from scipy.optimize import brentq

from ..core.inputs import refuse_units
from ..core.invariants import Invariant
from ..core.problem import Problem, bind
from ..engine.caching import cached_njit

__all__ = ["kepler"]


@cached_njit()
def _rhs(t, y, out, params):
    r2 = y[0] * y[0] + y[1] * y[1]
    w = 1.0 / (r2 * sqrt(r2))
    w += 1.5 * params[0] * w / r2
    out[0] = y[2]
    out[1] = y[3]
    out[2] = -w * y[0]
    out[3] = -w * y[1]


@cached_njit()
def _acc(t, q, params):
    r2 = q[0] * q[0] + q[1] * q[1]
    w = 1.0 / (r2 * sqrt(r2))
    return -(w + 1.5 * params[0] * w / r2) * q


@cached_njit()
def _energy(t, y, params):
    r2 = y[0] * y[0] + y[1] * y[1]
    r = sqrt(r2)
    return 0.5 * (y[2] * y[2] + y[3] * y[3]) - 1.0 / r - 0.5 * params[0] / (r * r2)


@cached_njit()
def _energy_gradient(t, y, f, out, params):
    out[0] = -f[2]
    out[1] = -f[3]
    out[2] = y[2]
    out[3] = y[3]


@cached_njit()
def _momentum(t, y, params):
    return y[0] * y[3] - y[1] * y[2]


@cached_njit()
def _momentum_gradient(t, y, out, params):
    out[0] = y[3]
    out[1] = -y[2]
    out[2] = -y[1]
    out[3] = y[0]


def kepler(eccentricity: float = 0.6, relativistic: float = 0.005, t_end: float = 200.0, h: float = 0.03) -> Problem:
    """Kepler problem, ``H = |p|^2 / 2 - 1 / r - relativistic / (2 r^3)``, L = q1 p2 - q2 p1.

    Parameters
    ----------
    eccentricity : float
        In [0, 1); the start is the pericentre of that orbit of semi-major axis 1.
    relativistic : float
        Coefficient of the perturbation (the paper's 0.005); 0 for the plain Kepler problem.
    t_end, h : float
        End of the interval that starts at 0, and a step.

    Returns
    -------
    Problem
        Invariants "H" and "L"; for ``relativistic=0`` with the closed form as `reference`.

    Raises
    ------
    ValueError
        When the eccentricity is not in [0, 1).
    """
    refuse_units(eccentricity=eccentricity, relativistic=relativistic, t_end=t_end, h=h)
    e = float(eccentricity)
    if not 0 <= e < 1:
        raise ValueError(f"eccentricity must be in [0, 1), got {eccentricity!r}.")
    params = np.array([relativistic], dtype=float)
    return Problem(
        name="kepler",
        fun=bind(_rhs, params),
        rhs=_rhs,
        acc=_acc,
        y0=np.array([1 - e, 0.0, 0.0, sqrt((1 + e) / (1 - e))]),
        t_span=(0.0, t_end),
        h=h,
        params=params,
        invariants=(
            Invariant(_energy, _energy_gradient, args=(params,), in_place=True, uses_f=True, name="H"),
            Invariant(_momentum, _momentum_gradient, args=(params,), in_place=True, name="L"),
        ),
        reference=(lambda t: _orbit(e, t)) if relativistic == 0 else None,
        blocks=2,
        units="G M = 1, semi-major axis 1: period 2 pi",
        source="Cai, Gong & Wang, section 3.1 (eq. 3.2, with L = q1 p2 - q2 p1)",
    )


def _orbit(e: float, t: float) -> np.ndarray:
    """The unperturbed orbit, by Kepler's equation E - e sin E = t."""
    mean = np.remainder(t + np.pi, 2 * np.pi) - np.pi
    E = brentq(lambda x: x - e * np.sin(x) - mean, mean - 1.0, mean + 1.0, xtol=1e-15, rtol=1e-15)
    b, r = sqrt(1 - e * e), 1 - e * np.cos(E)
    return np.array([np.cos(E) - e, b * np.sin(E), -np.sin(E) / r, b * np.cos(E) / r])
