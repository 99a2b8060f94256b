"""The symplectic Euler method, of order 1, for q'' = a(q)."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numba.extending import register_jitable

from ..engine.caching import cached_njit
from ._common import FixedStepResult, check_state, drive_signature, drive_steps, integrate_in_place

__all__ = ["symplectic_euler"]


def symplectic_euler(
    rhs: Callable[..., None],
    t_span: tuple[float, float],
    y0: Any,
    h: float,
    *,
    params: Any = None,
    save_every: Any = None,
) -> FixedStepResult:
    """Integrate (q, v) by v_new = v + h a(q), q_new = q + h v_new with a fixed step.

    Parameters
    ----------
    rhs : callable
        ``rhs(t, y, out[, params])`` fills out with (v, a).
    t_span, y0, h, params, save_every
        As for `implicit_midpoint`.

    Returns
    -------
    FixedStepResult

    References
    ----------
    E. Hairer, C. Lubich, G. Wanner, Geometric Numerical Integration (2006), theorem VI.3.3.
    """
    y = check_state(y0)
    return integrate_in_place(
        rhs, "rhs", _compiled_drive, _drive, t_span, y, h, params, save_every, np.zeros(0), np.zeros(y.size)
    )


@register_jitable
def _step(rhs, extra, t, h, constants, work, count, y):
    half = y.size // 2
    rhs(t, y, work, *extra)
    count[0] += 1
    for i in range(half):
        y[half + i] += h * work[half + i]
        y[i] += h * y[half + i]
    return True


def _drive(rhs, extra, t0, h, last_step, saved, constants, work, count, y, ys):
    drive_steps(_step, rhs, extra, t0, h, last_step, saved, constants, work, count, y, ys)


@cache
def _compiled_drive(n_extra: int) -> Callable[..., None]:
    return cached_njit(drive_signature(n_extra), error_model="numpy")(_drive)
