"""The Kepler problem of Experiment I of Cai, Gong & Wang, and the harmonic oscillator of their tables 1 and 2."""

from __future__ import annotations

from functools import partial
from math import sqrt
from typing import Any

import numpy as np
from scipy.optimize import brentq

from ..core.inputs import real_array
from ..core.problem import Problem, bind, library_variational, native_invariant
from ..engine.native import library

__all__ = ["harmonic", "kepler"]


def kepler(eccentricity: float = 0.6, relativistic: float = 0.005, t_end: float = 200.0, h: float = 0.03) -> Problem:
    """Return the Kepler problem with ``H = |p|^2 / 2 - 1 / r - relativistic / (2 r^3)`` and L = q1 p2 - q2 p1.

    Parameters
    ----------
    eccentricity : float
        Eccentricity in [0, 1); the start is the pericentre of the orbit with semi-major axis 1.
    relativistic : float
        Coefficient of the perturbation, by default that of Cai, Gong & Wang; 0 for the plain Kepler problem.
    t_end, h : float
        End of the interval that starts at 0, and the step.

    Returns
    -------
    Problem
        Its invariants are "H" and "L". For ``relativistic=0`` its `reference` is the closed form.

    Raises
    ------
    ValueError
        If the eccentricity is not in [0, 1).

    See Also
    --------
    harmonic, nbody, time_transformed

    References
    ----------
    .. [1] W. Cai, Y. Gong, Y. Wang, "An explicit and practically invariants-preserving method for conservative
       systems".

    Examples
    --------
    >>> import numpy as np
    >>> from eip_scipy import EIPDOP853, integrate
    >>> from eip_scipy.problems import kepler
    >>> problem = kepler(0.6, relativistic=0, t_end=20)
    >>> run = integrate(problem, method=EIPDOP853, h=None, rtol=1e-11, atol=1e-11)
    >>> bool(np.abs(run.y[:, -1] - problem.reference(20)).max() < 1e-7)
    True
    """
    e = float(eccentricity)
    if not 0 <= e < 1:
        raise ValueError(f"eccentricity must be in [0, 1), got {eccentricity!r}.")
    params = np.array([relativistic], dtype=float)
    return Problem(
        name="kepler",
        fun=bind(library["kepler.rhs"], params),
        rhs=library["kepler.rhs"],
        acc=library["kepler.acc"],
        jacobian=library["kepler.jacobian"],
        y0=np.array([1 - e, 0.0, 0.0, sqrt((1 + e) / (1 - e))]),
        t_span=(0.0, t_end),
        h=h,
        params=params,
        invariants=(native_invariant("kepler.energy", "H", params), native_invariant("kepler.momentum", "L", params)),
        reference=partial(_orbit, e) if relativistic == 0 else None,
        blocks=2,
        variational=partial(library_variational, "kepler.variational", ("relativistic",)),
        component_names=("x", "y", "vx", "vy"),
        canonical=True,
        units="G M = 1, semi-major axis 1: period 2 pi",
        source="Cai, Gong & Wang, section 3.1 (eq. 3.2, with L = q1 p2 - q2 p1)",
    )


def _orbit(e: float, t: float) -> np.ndarray:
    """Return the state on the unperturbed orbit at time t, by Kepler's equation E - e sin E = t."""
    mean = np.remainder(t + np.pi, 2 * np.pi) - np.pi
    E = brentq(lambda x: x - e * np.sin(x) - mean, mean - 1.0, mean + 1.0, xtol=1e-15, rtol=1e-15)
    b, r = sqrt(1 - e * e), 1 - e * np.cos(E)
    return np.array([np.cos(E) - e, b * np.sin(E), -np.sin(E) / r, b * np.cos(E) / r])


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

    See Also
    --------
    kepler, eip_scipy.hamiltonian

    Examples
    --------
    >>> from eip_scipy import EIPRK4, integrate
    >>> from eip_scipy.problems import harmonic
    >>> integrate(harmonic(), method=EIPRK4).trusted
    True
    """
    start = real_array("y0", y0)
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
