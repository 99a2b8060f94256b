"""Problems in the frame at rest instead of the rotating frame, for potentials that are symmetric about the z axis."""

from __future__ import annotations

from dataclasses import replace
from math import ceil, pi, remainder
from typing import Any

import numpy as np

from .equation import FieldProblem, GrossPitaevskii
from .splitting import LinearFlow

__all__ = ["at_rest", "rotated"]

# Shears stretch what they turn, by a fortieth of its radius at this angle: the field must stay inside the box.
SMALL_TURN = pi / 32
ALIKE = 1e-9  # radii and values of a potential that count as equal


def at_rest(problem: FieldProblem) -> FieldProblem:
    """Return the problem in the frame at rest, in which the equation has no rotation and needs fewer transforms.

    The potential must be symmetric about the z axis. If y is the solution at time t in the frame at rest,
    ``rotated(gpe, y, gpe.Omega * t)`` is the solution in the rotating frame. The invariants are the mass and the energy
    in the frame at rest. The energy in the rotating frame is this energy minus Omega times the angular momentum, which
    is conserved as far as the grid resolves the field.

    Parameters
    ----------
    problem : FieldProblem
        A problem made by `GrossPitaevskii.problem`.

    Returns
    -------
    FieldProblem
        A problem with Omega = 0 and the same start, interval, step and names of invariants, without `reference`.

    Raises
    ------
    ValueError
        If the potential is not symmetric about the z axis, or the problem has one dimension.
    """
    gpe = problem.equation
    assert gpe is not None
    check_radial(gpe)
    names = [item.name for item in problem.invariants if item.name is not None]
    rest = gpe.changed(Omega=0.0).problem(
        problem.y0,
        problem.t_span[1],
        problem.h,
        name=f"{problem.name}-at-rest",
        invariants=names,
        source=problem.source,
    )
    return replace(rest, metric=problem.metric)


def rotated(gpe: GrossPitaevskii, psi: Any, angle: float) -> np.ndarray:
    """Return exp(i angle Lz) psi, the field at points turned anticlockwise by `angle` about the z axis.

    For a potential that is symmetric about z, this function converts a solution from the frame at rest (Omega = 0) to
    the frame that rotates with Omega, if the angle is ``Omega t``.

    Parameters
    ----------
    gpe : GrossPitaevskii
        An equation in two or three dimensions.
    psi : array_like
        A field or flat state that vanishes towards the ends of the box.
    angle : float
        Any angle. The rotation is made in parts of at most pi / 32, because the shears of larger parts could stretch
        the field beyond the box.

    Returns
    -------
    ndarray
        The rotated field.

    Raises
    ------
    ValueError
        If the grid has one dimension, or `psi` has the wrong shape.
    """
    psi = gpe.as_field(psi).copy()
    angle = remainder(angle, 2 * pi)
    parts = max(1, ceil(abs(angle) / SMALL_TURN - 1e-9))
    flow, work = LinearFlow(gpe, 0.0, angle / parts), np.empty_like(psi)
    for _ in range(parts):
        psi, work = flow.apply(psi, work)
    return psi


def check_radial(gpe: GrossPitaevskii) -> None:
    """Raise ValueError unless the potential is equal at all grid points with the same distance from the z axis."""
    if gpe.grid.dim == 1:
        raise ValueError("at_rest: the problem has one dimension, without a z axis; expected two or three dimensions.")
    x, y, *_ = gpe.grid.mesh()
    square = (x * x + y * y).ravel()
    order = np.argsort(square)
    values = gpe.V.reshape(square.size, -1)[order]
    alike = np.diff(square[order]) <= ALIKE * square.max()
    if np.any(np.abs(np.diff(values, axis=0))[alike] > ALIKE * np.abs(gpe.V).max()):
        raise ValueError(
            "at_rest: the potential differs between points at the same distance from the z axis, so that it would "
            "rotate in the frame at rest. Use the problem in the rotating frame."
        )
