"""Newtonian point masses."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ..invariants import Invariant
from . import _gravity
from ._problem import Problem, bind

__all__ = ["nbody"]


def nbody(
    gm: Any,
    position: Any,
    velocity: Any,
    *,
    t_span: tuple[float, float],
    h: float | None = None,
    name: str = "nbody",
    units: str = "",
    source: str = "",
    reference: Callable[[float], np.ndarray | None] | None = None,
) -> Problem:
    """N point masses under Newton's gravitation.

    Parameters
    ----------
    gm : array_like, shape (N,)
        G times the masses, > 0, in the units of length and time of the state.
    position, velocity : array_like, shape (N, 3)
    t_span : (float, float)
    h : float, optional
    name, units, source : str, optional
    reference : callable, optional

    Returns
    -------
    Problem
        State (q_1, ..., q_N, v_1, ..., v_N), each with 3 components. Invariants: "H", the energy times G, and "L", the
        angular momentum times G. Momentum and centre of mass are in the `frame`; `blocks` are the bodies'
        positions and velocities.

    Raises
    ------
    ValueError
        When shapes disagree or a mass is not positive.
    """
    params = np.array(gm, dtype=float)
    q, v = np.array(position, dtype=float), np.array(velocity, dtype=float)
    n = params.size
    if params.ndim != 1 or q.shape != (n, 3) or v.shape != (n, 3):
        raise ValueError(
            f"nbody: gm {params.shape}, position {q.shape}, velocity {v.shape}; expected (N,), (N, 3), (N, 3)."
        )
    if not np.all(params > 0):
        raise ValueError("nbody: every G m must be positive (a test particle's motion enters no invariant).")
    return Problem(
        name=name,
        fun=bind(_gravity.rhs, params),
        rhs=_gravity.rhs,
        acc=_gravity.acc,
        y0=np.concatenate([q.ravel(), v.ravel()]),
        t_span=(float(t_span[0]), float(t_span[1])),
        h=h,
        params=params,
        invariants=(
            Invariant(_gravity.energy, _gravity.energy_gradient, args=(params,), in_place=True, uses_f=True, name="H"),
            Invariant(_gravity.momentum, _gravity.momentum_gradient, args=(params,), in_place=True, name="L"),
        ),
        blocks=3,
        frame=recoil(params),
        units=units,
        source=source,
        reference=reference,
    )


def recoil(gm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The frame (C, S): centre of mass and momentum, kept by shifts of the bodies in proportion to their masses.

    So the recoil of a planet's correction goes to its star. A common shift would move the outer planets as far.
    """
    axes = np.eye(3)
    share = gm / gm.sum()
    C = np.kron(np.eye(2), np.kron(share, axes))
    S = np.kron(np.eye(2), np.kron(share[:, None], axes))
    return C, S
