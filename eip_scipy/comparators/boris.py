"""The Boris pusher, the standard method for charged particles: explicit, of order 2, keeping phase-space volume."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numba.extending import register_jitable

from ..core.inputs import refuse_units
from ..engine.caching import cached_njit
from ._common import FixedStepResult, check_state, drive_signature, drive_steps, integrate_in_place

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

    Half a step along the velocity, half of the electric kick, a rotation around B, the other half of the kick, half a
    step along the velocity: one evaluation of the fields in a step. The method is reversible, of order 2 and keeps
    phase-space volume, but is not symplectic; the rotation alone keeps the kinetic energy exactly where E is 0.

    Parameters
    ----------
    fields : callable
        ``fields(t, x, out[, params])`` fills out[:3] with E and out[3:] with B; see `ParticleField.fill`. A function
        jitted lazily by Numba runs compiled, any other callable interpreted, through the same loop.
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
        Save each `save_every`-th state besides the first and the last; default: these two only.

    Returns
    -------
    FixedStepResult
        A record with t (m,), y (6, m), nfev, wall_time [s] and message. Positions and velocities are of the same time.

    Raises
    ------
    TypeError
        The state or `params` are not made of real numbers, or `fields` is not callable.
    ValueError
        An argument has a wrong value. The message says what came and what was expected.

    References
    ----------
    J. P. Boris, Relativistic plasma simulation, Proc. 4th Conf. on Numerical Simulation of Plasmas (1970) 3-67.
    H. Qin et al., Why is Boris algorithm so good?, Physics of Plasmas 20 (2013) 084503.

    Examples
    --------
    >>> import numpy as np
    >>> from eip_scipy.comparators import boris
    >>> def fields(t, x, out):
    ...     out[:] = 0, 0, 0, 0, 0, 1
    >>> run = boris(fields, (0.0, 2 * np.pi), [0, 0, 0, 1, 0, 0], 2 * np.pi / 1000)
    >>> bool(abs(run.y[:3, -1]).max() < 1e-4)
    True
    """
    y = check_state(y0)
    if y.size != 6:
        raise ValueError(f"y0 must hold position and velocity, 6 components, got {y.size}")
    refuse_units(mass=mass, charge=charge)
    if not (mass > 0 and np.isfinite(mass) and np.isfinite(charge)):
        raise ValueError(f"mass must be positive and charge finite, got {mass!r} and {charge!r}")
    constants = np.array([charge / mass])
    return integrate_in_place(
        fields, "fields", _compiled_drive, _drive, t_span, y, h, params, save_every, constants, np.zeros(6)
    )


@register_jitable
def _step(fields, extra, t, h, constants, work, count, y):
    """One step in place."""
    half = 0.5 * h
    kick = constants[0] * half
    for i in range(3):
        y[i] += half * y[i + 3]
    fields(t + half, y[:3], work, *extra)
    count[0] += 1
    u = y[3] + kick * work[0]
    v = y[4] + kick * work[1]
    w = y[5] + kick * work[2]
    a, b, c = kick * work[3], kick * work[4], kick * work[5]
    s = 2.0 / (1.0 + a * a + b * b + c * c)
    # v' = v + v x t, then v + v' x s.
    p = u + v * c - w * b
    q = v + w * a - u * c
    r = w + u * b - v * a
    y[3] = u + s * (q * c - r * b) + kick * work[0]
    y[4] = v + s * (r * a - p * c) + kick * work[1]
    y[5] = w + s * (p * b - q * a) + kick * work[2]
    for i in range(3):
        y[i] += half * y[i + 3]
    return True


def _drive(fields, extra, t0, h, last_step, saved, constants, work, count, y, ys):
    drive_steps(_step, fields, extra, t0, h, last_step, saved, constants, work, count, y, ys)


@cache
def _compiled_drive(n_extra: int) -> Callable[..., None]:
    """`_drive` compiled once for all functions, typed as first-class functions; found in Numba's cache afterwards."""
    return cached_njit(drive_signature(n_extra), error_model="numpy")(_drive)
