"""Problems of bodies, and the bodies of a problem or run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ...core.inputs import shown
from ...core.problem import Problem, bind

# Names of the parameters that follow G m of each body if there are further forces; the order is that of forces.cpp.
ENTRIES = (
    *("relativity", "1/c^2", "j2", "pole_x", "pole_y", "pole_z", "moon_body", "moon"),
    *("drag", "drag_radius", "scale_height", "spin", "j4"),
)

__all__ = ["ENTRIES", "Bodies", "BodiesProblem", "bodies_of", "component_names"]


@dataclass(frozen=True, eq=False, repr=False)
class BodiesProblem(Problem):
    """A `Problem` of point masses, whose parameters begin with G m of each.

    Attributes
    ----------
    bodies : tuple of str
        Names of the N bodies.
    forces : tuple of str
        Forces in addition to Newton's gravitation.
    radii : ndarray, shape (N,), optional
        Radii of the bodies for the option `encounters` of `nbody`.
    """

    bodies: tuple[str, ...] = ()
    forces: tuple[str, ...] = ()
    radii: np.ndarray | None = None

    @property
    def parameters(self) -> dict[str, float]:
        """Values of the parameters by name: ``gm_`` and each body's name, constants of forces, ``beta_`` and names."""
        behind = (*ENTRIES, *(f"beta_{name}" for name in self.bodies)) if self.forces else ()
        names = [*(f"gm_{name}" for name in self.bodies), *behind]
        return dict(zip(names, np.asarray(self.params).tolist(), strict=True))

    def at_events(self, events: Sequence[Any], times: Any, states: Any, params: np.ndarray) -> dict[str, Any]:
        """Return the encounters of a run, see `Problem.at_events`."""
        from .approaches import encounters  # which imports this module

        if self.radii is None or self.rhs is None:
            return {}
        table = encounters(self.radii, events, times, states, bind(self.rhs, params))
        return {} if table is None else {"encounters": table}


class Bodies(NamedTuple):
    """The bodies of a problem or of its run: G times their masses (N,), their names, and forces except Newton's."""

    problem: BodiesProblem
    gm: np.ndarray
    names: tuple[str, ...]
    forces: tuple[str, ...]


def bodies_of(run: Any) -> Bodies:
    """Return the bodies of a problem that was made by `nbody`, or of a run of it; TypeError for anything else."""
    origin = None if isinstance(run, Problem) else getattr(run, "__dict__", {}).get("_origin")
    problem, given = (run, None) if origin is None else (origin.arguments["fun"], origin.arguments["params"])
    if not isinstance(problem, BodiesProblem):
        raise TypeError(
            f"expected a problem of bodies, such as nbody(...) or solar_system(), or a result of integrate for such a "
            f"problem; got {shown(type(run).__name__)}. A result that was loaded or comes from solve_ivp does not "
            "contain the masses: give them, or pass the problem."
        )
    params = np.asarray(problem.params if given is None else given, dtype=float)
    return Bodies(problem, params[: len(problem.bodies)].copy(), problem.bodies, problem.forces)


def component_names(n: int, bodies: Sequence[str] | None) -> tuple[str, ...]:
    """Return the names of the 6 n components, x_0, y_0, ... then vx_0, ..., with `bodies` in place of the numbers."""
    names = tuple(map(str, range(n))) if bodies is None else bodies
    if isinstance(names, str) or not all(isinstance(name, str) for name in names):
        raise TypeError(f"bodies must be a sequence of names, got {shown(names)}.")
    if len(names) != n or len(set(names)) < n:
        raise ValueError(f"bodies: expected {n} names, all different, got {shown(names)}.")
    return tuple(f"{axis}_{body}" for axes in (("x", "y", "z"), ("vx", "vy", "vz")) for body in names for axis in axes)
