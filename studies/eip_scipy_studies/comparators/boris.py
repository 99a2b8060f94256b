"""The Boris pusher, the standard method for charged particles: explicit, of order 2, keeping phase-space volume."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from ._steps import FixedStepResult, FixedSteps, add, check_state, drive, inlined

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
        jitted by Numba runs compiled, any other callable interpreted.
    t_span, y0, h, params, save_every
        As for `stormer_verlet`, with y = (x, v).
    mass, charge : float, optional

    Returns
    -------
    FixedStepResult
        A record with t (m,), y (6, m), nfev, wall_time [s] and message. Positions and velocities are those at the same
        times.

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
    if not (mass > 0 and math.isfinite(mass) and math.isfinite(charge)):
        raise ValueError(f"mass must be positive and finite, and charge finite, got {mass!r} and {charge!r}")
    steps = FixedSteps.of(t_span, h, save_every)
    return drive(_step, fields, steps, y, params, takes=3, fills=6, constant=charge / mass)


@inlined
def _step(fun, t, h, x, v, params, constant, f, work):  # type: ignore[no-untyped-def]
    half, kick = 0.5 * h, constant * 0.5 * h
    add(x, half, v)
    fun(t + half, x, f, params)
    u, w, z = v[0] + kick * f[0], v[1] + kick * f[1], v[2] + kick * f[2]
    a, b, c = kick * f[3], kick * f[4], kick * f[5]
    s = 2.0 / (1.0 + a * a + b * b + c * c)
    # v' = v + v x t, then v + v' x s.
    p, q, r = u + w * c - z * b, w + z * a - u * c, z + u * b - w * a
    v[0] = u + s * (q * c - r * b) + kick * f[0]
    v[1] = w + s * (r * a - p * c) + kick * f[1]
    v[2] = z + s * (p * b - q * a) + kick * f[2]
    add(x, half, v)
    return 1
