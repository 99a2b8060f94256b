"""The frame at rest instead of the rotating one, for potentials that are symmetric about the z axis."""

from __future__ import annotations

from dataclasses import replace
from math import ceil, pi, remainder
from typing import Any

import numpy as np

from .equation import FieldProblem, GrossPitaevskii
from .flows import LinearFlow

__all__ = ["at_rest", "rotated"]

# Shears stretch what they turn, by a fortieth of its radius at this angle: the field must stay inside the box.
SMALL_TURN = pi / 32
ALIKE = 1e-9  # radii and values of a potential that count as equal


def at_rest(problem: FieldProblem) -> FieldProblem:
    """Return the problem in the frame at rest, in which the equation has no rotation and needs fewer transforms.

    Where the potential is round about the z axis, ``rotated(gpe, y, gpe.Omega * t)`` is the solution in the rotating
    frame if y is that at rest. The invariants are the mass and the energy at rest; the energy in the rotating frame is
    that minus Omega times the angular momentum, which the grid keeps as far as it resolves the field.

    Parameters
    ----------
    problem : FieldProblem
        As `GrossPitaevskii.problem` makes it.

    Returns
    -------
    FieldProblem
        With Omega = 0 and the same start, interval, step and names of invariants, without `reference`.

    Raises
    ------
    ValueError
        If the potential is not round, or in one dimension.
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

    A solution of the equation with Omega = 0 and a potential that is round about z becomes that of Omega when it is
    rotated by ``Omega t``: the rotating frame, from the frame at rest.

    Parameters
    ----------
    gpe : GrossPitaevskii
        An equation in two or three dimensions.
    psi : array_like
        A field or flat state that vanishes towards the ends of the box.
    angle : float
        Any; done in parts of pi / 32 at most, whose shears hardly stretch the field.

    Returns
    -------
    ndarray
        A field.

    Raises
    ------
    ValueError
        If the grid has one dimension, or the field has another shape.
    """
    psi = gpe.as_field(psi).copy()
    angle = remainder(angle, 2 * pi)
    parts = max(1, ceil(abs(angle) / SMALL_TURN - 1e-9))
    flow, work = LinearFlow(gpe, 0.0, angle / parts), np.empty_like(psi)
    for _ in range(parts):
        psi, work = flow.apply(psi, work)
    return psi


def check_radial(gpe: GrossPitaevskii) -> None:
    """Return True if the potential is equal at all grid points with the same distance from the z axis.

    Raises
    ------
    ValueError
        If it has not, or in one dimension.
    """
    if gpe.grid.dim == 1:
        raise ValueError("without a z axis there is no rotation: the problem has one dimension.")
    x, y, *_ = gpe.grid.mesh()
    square = (x * x + y * y).ravel()
    order = np.argsort(square)
    values = gpe.V.reshape(square.size, -1)[order]
    alike = np.diff(square[order]) <= ALIKE * square.max()
    if np.any(np.abs(np.diff(values, axis=0))[alike] > ALIKE * np.abs(gpe.V).max()):
        raise ValueError(
            "at_rest: the potential differs between points equally far from the z axis; at rest it would turn."
        )
