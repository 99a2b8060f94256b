"""The Boris pusher, the standard method for charged particles: explicit, of order 2, keeping phase-space volume."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from eip_scipy.native_kernels import FixedStepResult, FixedSteps, check_state, run_in_place

__all__ = ["boris"]


def boris(
    fields: Callable[..., None],
    t_span: tuple[float, float],
    y0: Any,
    h: float,
    *,
    mass: float = 1.0,
    charge: float = 1.0,
    params: Any = None,
    save_every: int | None = None,
) -> FixedStepResult:
    """Integrate m x'' = q (E + x' x B) by the Boris pusher with a fixed step.

    A step consists of half a step along the velocity, half of the electric kick, a rotation around B, the other half of
    the kick, and half a step along the velocity, with one evaluation of the fields. The method is reversible, of order
    2 and keeps phase-space volume, but is not symplectic; the rotation alone keeps the kinetic energy exactly if E is
    0.

    Parameters
    ----------
    fields : callable
        ``fields(t, x, out[, params])`` fills out[:3] with E and out[3:] with B; see `ParticleField.fill`. A function
        jitted by Numba and a C function by pointer run compiled, any other callable interpreted, in the same loop.
    t_span : tuple of float
        Start and end; a smaller end integrates backward.
    y0 : array_like, shape (6,)
        Initial state (x, v).
    h : float
        Length of a step, positive in both directions; the last one ends on the end of the interval exactly.
    mass, charge : float, optional
    params : array_like, shape (p,), optional
        Passed to `fields` as a float64 array when given.
    save_every : int, optional
        Save every `save_every`-th state in addition to the first and the last; default: only these two.

    Returns
    -------
    FixedStepResult
        A record with t (m,), y (6, m), nfev, wall_time [s] and message. Positions and velocities are those at the same
        times.

    Raises
    ------
    TypeError
        If the state or `params` are not made of real numbers, or `fields` is not callable.
    ValueError
        If an argument has a wrong value. The message gives the value and what was expected.

    References
    ----------
    J. P. Boris, Relativistic plasma simulation, Proc. 4th Conf. on Numerical Simulation of Plasmas (1970) 3-67.
    H. Qin et al., Why is Boris algorithm so good?, Physics of Plasmas 20 (2013) 084503.

    Examples
    --------
    >>> import numpy as np
    >>> from eip_scipy_studies.comparators import boris
    >>> def fields(t, x, out):
    ...     out[:] = 0, 0, 0, 0, 0, 1
    >>> run = boris(fields, (0.0, 2 * np.pi), [0, 0, 0, 1, 0, 0], 2 * np.pi / 1000)
    >>> bool(abs(run.y[:3, -1]).max() < 1e-4)
    True
    """
    y = check_state(y0)
    if y.size != 6:
        raise ValueError(f"y0 must hold position and velocity, 6 components, got {y.size}")
    if not (mass > 0 and np.isfinite(mass) and np.isfinite(charge)):
        raise ValueError(f"mass must be positive and finite, and charge finite, got {mass!r} and {charge!r}")
    steps = FixedSteps.of(t_span, h, save_every)
    ratio = charge / mass
    return run_in_place("boris", fields, steps, y, params, name="fields", takes=3, fills=6, constant=ratio)
