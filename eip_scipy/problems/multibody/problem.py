"""Mechanical systems with constraints as problems."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np

from ...core.inputs import real_array
from ...core.invariants import Invariant
from ...core.jitted import is_jitted
from ...core.problem import Problem, bind
from .energies import energy_of, states_near, typical_speed
from .motion import Motion, Sizes, motion, plain, vector
from .parts import Parts
from .start import Names, started

__all__ = ["MechanicsProblem", "Multipliers", "mechanics_problem"]


# Speeds count as at least this share of a typical one where errors of constraints on velocities are compared with their
# terms, which vanish at rest.
SLOW = 0.1


class Multipliers(NamedTuple):
    """Lagrange's multipliers, by the names of the constraints on velocities.

    Attributes
    ----------
    names : tuple of str
    values : ndarray, shape (m,) or (m, k)
        lambda of M u' + G^T lambda = F: the constraints exert the generalised forces -G^T lambda. The unit is that of
        power over that of the constraint's derivative in time.
    rank : int or ndarray of int, shape (k,)
        Rank of the constraints. Where it is below m, forces are distributed over dependent constraints such that the
        sum of the squares of ``lambda_i |G_i|`` is least.
    """

    names: tuple[str, ...]
    values: np.ndarray
    rank: Any

    @property
    def unique(self) -> Any:
        """True where the multipliers are the only solution."""
        return self.rank == len(self.names)


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class MechanicsProblem(Problem):
    """A `Problem` of a mechanical system with constraints, whose state is (q, u).

    Its invariants are the constraints on positions and velocities, and the energy where it is known. `constraints` and
    `energy` may be kept apart: ``integrate(problem, invariants=problem.constraints, ...)``.

    Attributes
    ----------
    names : Names
        Names of coordinates, speeds and constraints.
    constraints : tuple of Invariant
        The constraints, with the target 0; empty for a system without any.
    energy : Invariant, Balance or None
    energy_kept : str
        How the energy is kept, or why it is not.
    motion : Motion
        Functions of the motion.
    notes : tuple of str
        What was done to the equations and to the start.
    parameter_names : tuple of str
    rank_tolerance : float
    origin : optional
        What the functions were made of, if they can be made again.
    """

    names: Names
    constraints: tuple[Invariant, ...]
    energy: Invariant | None
    energy_kept: str
    motion: Motion
    notes: tuple[str, ...] = ()
    parameter_names: tuple[str, ...] = ()
    rank_tolerance: float
    origin: Any = None

    @property
    def parameters(self) -> dict[str, float]:
        """Values of the parameters by name."""
        values = [] if self.params is None else self.params.tolist()
        return dict(zip(self.parameter_names, values, strict=True))

    @property
    def stiff_invariants(self) -> tuple[Any, ...]:
        """The invariants that implicit methods keep by default: all but the energy."""
        return tuple(item for item in super().stiff_invariants if item is not self.energy)

    def multipliers(self, t: Any, y: Any) -> Multipliers:
        """Return Lagrange's multipliers at states of a run.

        Parameters
        ----------
        t : float or array_like, shape (k,)
            Times, as a run's ``t``.
        y : array_like, shape (n,) or (n, k)
            States, as a run's ``y``.

        Returns
        -------
        Multipliers
        """
        times, states = np.atleast_1d(np.asarray(t, float)), np.asarray(y, float)
        n, columns = len(self.names.state), states.reshape(len(states), -1)
        if np.ndim(t) != states.ndim - 1 or columns.shape != (n, times.size):
            raise ValueError(
                f"multipliers: y has the shape {states.shape} for {times.size} times; expected ({n},) for a number t, "
                "or a column for each time."
            )
        found, ranks = np.empty((len(self.names.velocities), times.size)), np.empty(times.size, int)
        for k, time in enumerate(times):
            ranks[k], _, found[:, k] = self._solved(time, columns[:, k])
        if states.ndim == 1:
            return Multipliers(self.names.velocities, found[:, 0], int(ranks[0]))
        return Multipliers(self.names.velocities, found, ranks)

    def motion_at(self, t: float, y: np.ndarray) -> np.ndarray:
        """Return the derivative (q', u') of one state, by functions that are not compiled."""
        out = np.empty(len(self.names.state))
        self.motion.rhs(t, np.ascontiguousarray(y, float), out, *(() if self.params is None else (self.params,)))
        return out

    def _solved(self, t: float, y: np.ndarray) -> tuple[int, np.ndarray, np.ndarray]:
        """Return the rank of the constraints, u' and the multipliers."""
        n, m = len(self.names.speeds), len(self.names.velocities)
        rates, accelerations, multipliers = np.empty(len(self.names.coordinates)), np.empty(n), np.empty(m)
        extra = () if self.params is None else (self.params,)
        rank = self.motion.solved(float(t), np.ascontiguousarray(y), rates, accelerations, multipliers, *extra)
        return int(rank), accelerations, multipliers

    def start(
        self, q0: Any, u0: Any, params: Any = None, *, t: float | None = None, independent: Iterable[str] | None = None
    ) -> np.ndarray:
        """Return a state that meets the constraints.

        Parameters
        ----------
        q0, u0 : array_like or mapping
            Coordinates and speeds, in the order of ``names.coordinates`` and ``names.speeds`` or by name. Those that
            are neither given nor independent begin at 0.
        params : mapping or array_like, optional
            Parameters, by default those of the problem.
        t : float, optional
            The time. Default: the start of the problem's interval, or 0.
        independent : iterable of str, optional
            Names of the coordinates and speeds that stay as they are given; all others are guesses, from which Newton's
            method finds the nearest solution. Default: all stay.

        Returns
        -------
        ndarray, shape (n,)

        Raises
        ------
        ValueError
            If the constraints cannot be met; the message names the constraint that is violated most.
        """
        if params is not None:
            params = self._named_parameters(params) if isinstance(params, Mapping) else real_array("params", params)
        t = (0.0 if self.t_span is None else self.t_span[0]) if t is None else float(t)
        return started(self.name, self.names, self.constraints, q0, u0, params, t, independent)[0]

    def __repr__(self) -> str:
        first, *others = super().__repr__().splitlines()
        lines = [line for line in others if not line.startswith(("  invariants", "  functions"))]
        kind = "jitted by Numba" if is_jitted(self.rhs) else "plain Python"
        lines[1:1] = [f"  constraints {self._constraints_described()}", f"  energy      {self.energy_kept}"]
        lines += [f"  functions   {kind}", *(f"  note        {note}" for note in self.notes)]
        return "\n".join([first, *lines])

    def _constraints_described(self) -> str:
        m, n = len(self.names.velocities), len(self.names.speeds)
        if m == 0:
            return f"none, {_degrees(n)}"
        rank = self._solved(0.0 if self.t_span is None else self.t_span[0], self.y0)[0]
        rest = f" of rank {rank}, {_degrees(n - rank)}"
        return f"{m} on velocities{rest}, {len(self.names.positions)} of them on positions too"

    def __reduce__(self) -> Any:
        """Functions are made again from the expressions where it is read."""
        if self.origin is None:
            return super().__reduce__()
        own = self._own_invariants
        kept = [own.index(item) if item in own else item for item in self.invariants]
        others = {item.name: getattr(self, item.name) for item in fields(self) if item.name not in REMADE}
        nq = len(self.names.coordinates)
        arguments = (self.names, self.t_span, (self.y0[:nq], self.y0[nq:]), self.params, self.rank_tolerance)
        return _again, (self.origin, arguments, kept, others)

    @property
    def _own_invariants(self) -> tuple[Invariant, ...]:
        return (*self.constraints, *([] if self.energy is None else [self.energy]))


# Attributes that come from others.
REMADE = {
    "fun", "rhs", "y0", "t_span", "params", "invariants", "constraints", "energy", "energy_kept", "motion", "names",
    "rank_tolerance", "origin",
}  # fmt: skip


def _again(origin: Any, arguments: Sequence[Any], kept: Sequence[Any], others: dict[str, Any]) -> MechanicsProblem:
    from ..symbolic.constrained import parts_of

    names, t_span, start, params, tolerance = arguments
    t = 0.0 if t_span is None else t_span[0]
    problem = mechanics_problem("", parts_of(*origin), names, t, start, params, None, tolerance, t_span=t_span)
    own = problem._own_invariants
    return replace(problem, invariants=tuple(own[item] if isinstance(item, int) else item for item in kept), **others)


def _degrees(count: int) -> str:
    return f"{count} degree{'s' * (count != 1)} of freedom"


def mechanics_problem(
    name: str,
    parts: Parts,
    names: Names,
    t: float,
    start: tuple[Any, Any],
    params: np.ndarray | None,
    independent: Iterable[str] | None,
    tolerance: float,
    *,
    t_span: Any,
    notes: tuple[str, ...] = (),
    **others: Any,
) -> MechanicsProblem:
    """Return the problem of the functions `parts`, from the coordinates and speeds of `start`."""
    sizes = Sizes(len(names.coordinates), len(names.speeds), len(names.velocities))
    functions = motion(parts.fill, sizes, tolerance)
    once = motion(plain(parts.fill), sizes, tolerance)
    fun = bind(once.rhs, params)
    examined = _constraints_invariant(plain(parts.values), plain(parts.gradient), names, params)
    y0, solved = started(name, names, examined, *start, params, t, independent)
    examined = tuple(_scaled(item, t, y0, fun, sizes) for item in examined)
    kept = _constraints_invariant(parts.values, parts.gradient, names, params)
    for item, scaled in zip(kept, examined, strict=True):
        item.scale = scaled.scale
    energy, described = energy_of(parts.energies, fun, states_near(t, y0, examined, fun, sizes.coordinates), params)
    nq = sizes.coordinates
    return MechanicsProblem(
        name=name,
        fun=bind(functions.rhs, params),
        rhs=functions.rhs,
        y0=y0,
        t_span=t_span,
        params=params,
        invariants=(*kept, *([] if energy is None else [energy])),
        blocks=(np.arange(nq), np.arange(nq, y0.size)),
        component_names=names.state,
        names=names,
        constraints=kept,
        energy=energy,
        energy_kept=described,
        motion=once,
        notes=(*notes, *solved, *filter(None, [parts.note])),
        rank_tolerance=tolerance,
        origin=parts.origin,
        **others,
    )


def _constraints_invariant(
    fill: Callable[..., None], gradient: Callable[..., None], names: Names, params: np.ndarray | None
) -> tuple[Invariant, ...]:
    """Return the constraints as one invariant of several values, in a tuple that is empty without any."""
    size = len(names.positions) + len(names.velocities)
    if size == 0:
        return ()
    args = () if params is None else (params,)
    item = Invariant(
        vector(fill, size), gradient, target=np.zeros(size), args=args, size=size, name="constraints", in_place=True
    )
    item.value_names = (*names.positions, *names.velocities)
    return (item,)


def _scaled(
    item: Invariant, t: float, y: np.ndarray, derivative: Callable[[float, np.ndarray], np.ndarray], sizes: Sizes
) -> Invariant:
    """Give the constraints on velocities the size of their terms at a typical speed: at rest they have none."""
    nq = sizes.coordinates
    speed = typical_speed(y[:nq], y[nq:], derivative(t, y)[nq:])
    gradient = np.empty((item.size or 0, y.size))
    assert item.grad is not None
    item.grad(t, y, gradient)
    scale = SLOW * np.abs(gradient[:, nq:]).sum(axis=1) * speed
    item.scale = scale if np.isfinite(scale).all() else None
    return item
