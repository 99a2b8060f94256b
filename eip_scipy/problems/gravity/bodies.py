"""The bodies of a problem or run, with their names."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ...core.inputs import shown
from ...core.problem import Problem
from ...engine.native import library
from .forces import DRAG, KIND, MOON_BODY, OBLATENESS, RELATIVITY

__all__ = ["Bodies", "bodies_of", "body_names"]


class Bodies(NamedTuple):
    """The bodies of a problem: G times their masses (N,), and their names; "0", "1" and so on without names."""

    problem: Problem
    gm: np.ndarray
    names: tuple[str, ...]

    @property
    def forces(self) -> tuple[str, ...]:
        """Forces in addition to Newton's gravitation."""
        further = np.asarray(self.problem.params, dtype=float)[self.gm.size :]
        if not further.size:
            return ()
        kind = (RELATIVITY[int(further[KIND]) - 1],) if further[KIND] else ()
        return (
            *kind,
            *(("j2",) if further[OBLATENESS] else ()),
            *(("moon-quadrupole",) if further[MOON_BODY] >= 0 else ()),
            *(("drag",) if further[DRAG] else ()),
        )


def bodies_of(run: Any) -> Bodies:
    """Return the bodies of a problem that was made by `nbody`, or of a run of it; TypeError for anything else."""
    origin = None if isinstance(run, Problem) else getattr(run, "__dict__", {}).get("_origin")
    problem = run if origin is None else origin.arguments["fun"]
    if not (isinstance(problem, Problem) and problem.rhs in (library["gravity.rhs"], library["forces.rhs"])):
        raise TypeError(
            f"expected a problem of bodies, such as nbody(...) or solar_system(), or a result of integrate for such a "
            f"problem; got {shown(type(run).__name__)}. A result that was loaded or comes from solve_ivp does not "
            "contain the masses: give them, or pass the problem."
        )
    given = None if origin is None else origin.arguments["params"]
    params = np.asarray(problem.params if given is None else given, dtype=float)
    names = problem.component_names or ()
    n = len(names) // 6
    return Bodies(problem, params[:n].copy(), tuple(name[2:] for name in names[: 3 * n : 3]))


def body_names(names: Sequence[str], n: int) -> tuple[str, ...]:
    """Return the names of n bodies; raise an error if they are not n different strings."""
    if isinstance(names, str) or not all(isinstance(name, str) for name in names):
        raise TypeError(f"bodies must be a sequence of names, got {shown(names)}.")
    if len(names) != n or len(set(names)) < n:
        raise ValueError(f"bodies: expected {n} names, all different, got {shown(names)}.")
    return tuple(names)
