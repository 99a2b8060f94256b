"""Mechanical systems with constraints as problems."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from ...core.functions import is_jitted
from ...core.inputs import is_number, real_array, shown
from ...core.invariants import Invariant
from ...core.problem import Problem, bind
from ...core.results import Multipliers
from .energies import Examined, states_near, typical_speed
from .motion import Motion, motion, plain, vector
from .parts import Parts
from .start import Names, by_name, started

__all__ = ["MechanicsProblem", "mechanics_problem"]

# Dependent constraints contradict each other if accelerations leave residuals above this share of their terms.
CONTRADICTING = 1e-3
# For the scale of constraints on velocities, speeds count as at least this share of a typical speed, because the terms
# of these constraints vanish at rest.
SLOW = 0.1


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class MechanicsProblem(Problem):
    """A `Problem` of a mechanical system with constraints, whose state is (q, u).

    Its invariants are the constraints on positions and velocities, the norms of quaternions, the momenta of cyclic
    coordinates, and the energy if it is known. To keep only some of them, pass these:
    ``integrate(problem, invariants=problem.constraints, ...)``.

    Attributes
    ----------
    names : Names
        Names of coordinates, speeds and constraints; `parameter_names` has those of `params`.
    constraints : tuple of Invariant
        The constraints, with the target 0; empty for a system without constraints.
    norms, momenta : tuple of Invariant
        Sums of squares of coordinates that are constant because of the kinematics, such as the norm of a quaternion,
        and momenta of coordinates that neither the energy nor forces depend on.
    energy : Invariant, Balance or None
        The energy, if a run can keep it; `energy_kept` says how, or why not.
    notes : tuple of str
        Descriptions of changes to the equations and to the start.
    independent : tuple of str, optional
        Components whose given values `start` keeps. Default: all.
    rank_tolerance : float
        Distance within which gradients of constraints, each scaled to length 1, count as dependent.
    motion, parts : Motion, Parts
        Functions of the motion, and those that the problem is made of.

    See Also
    --------
    mechanics, mechanism, Problem, eip_scipy.results.Multipliers

    Examples
    --------
    >>> from eip_scipy.problems import mechanism
    >>> pendulum = mechanism([1, 1], [0, -9.81], lambda t, q: [q[0] ** 2 + q[1] ** 2 - 1], q0=[1, 0], u0=[0, 0],
    ...                      coordinates="x y")
    >>> pendulum.component_names, len(pendulum.constraints)
    (('x', 'y', 'u1', 'u2'), 1)
    """

    names: Names
    parameter_names: tuple[str, ...] = ()
    constraints: tuple[Invariant, ...]
    norms: tuple[Invariant, ...] = ()
    momenta: tuple[Invariant, ...] = ()
    energy: Invariant | None
    energy_kept: str
    notes: tuple[str, ...] = ()
    independent: tuple[str, ...] | None = None
    rank_tolerance: float
    motion: Motion
    parts: Parts

    @property
    def parameters(self) -> dict[str, float]:
        """Return the values of the parameters by name."""
        return dict(zip(self.parameter_names, [] if self.params is None else self.params.tolist(), strict=True))

    @property
    def stiff_invariants(self) -> tuple[Any, ...]:
        """Return the invariants that implicit methods keep by default: all except the energy."""
        return tuple(item for item in super().stiff_invariants if item is not self.energy)

    def multipliers(self, t: Any, y: Any, params: Any = None) -> Multipliers:
        """Return the Lagrange multipliers at states of a run.

        For the saved states of a result of `integrate`, ``run.multipliers`` has them.

        Parameters
        ----------
        t : float or array_like, shape (k,)
            Times, such as ``run.t``.
        y : array_like, shape (n,) or (n, k)
            States, such as ``run.y``.
        params : mapping or array_like, optional
            Parameters of the run, or (k, p) of each state. Default: those of the problem.

        Returns
        -------
        Multipliers
        """
        solved = [self._solved(*state) for state in self._states("multipliers", t, y, params)]
        ranks = np.array([item[0] for item in solved], int)
        values = np.array([item[2] for item in solved]).reshape(-1, len(self.names.velocities)).T.copy()
        if np.ndim(t) == 0:
            return Multipliers(self.names.velocities, values[:, 0], int(ranks[0]))
        return Multipliers(self.names.velocities, values, ranks)

    def outputs(self, t: Any, y: Any, params: Any = None) -> dict[str, Any]:
        """Return the outputs of the problem at states of a run.

        For the saved states of a result of `integrate`, ``run.outputs`` has them.

        Parameters
        ----------
        t, y, params
            As for `multipliers`.

        Returns
        -------
        dict of str to float or ndarray, shape (k,)
        """
        if self.parts.outputs is None:
            return {}
        states, (names, fill) = self._states("outputs", t, y, params), self.parts.outputs
        found = np.empty((len(states), len(names)))
        for row, (time, state, *args) in zip(found, states, strict=True):
            plain(fill)(time, np.append(state, self._solved(time, state, *args)[1]), row, *args)
        return dict(zip(names, found[0].tolist() if np.ndim(t) == 0 else found.T.copy(), strict=True))

    def observed(self, t: Any, y: Any, params: Any = None) -> dict[str, Any]:
        """Return the outputs and the multipliers of a run, see `Problem.observed`."""
        found: dict[str, Any] = {} if self.parts.outputs is None else {"outputs": self.outputs(t, y, params)}
        return found | ({"multipliers": self.multipliers(t, y, params)} if self.names.velocities else {})

    def _states(self, what: str, t: Any, y: Any, params: Any) -> list[tuple[Any, ...]]:
        """Return a time, a state and, if there are parameters, an array of them for each t; ValueError if y misfits."""
        n, times, states = len(self.names.state), np.atleast_1d(np.asarray(t, float)), np.asarray(y, float)
        if states.shape != (n, *np.shape(t)):
            raise ValueError(
                f"{what}: y has the shape {states.shape} for {times.size} times; expected ({n},) for a number t, or a "
                "column for each time."
            )
        params = self.named_parameters(params) if isinstance(params, Mapping) else params
        params = self.params if params is None else np.atleast_1d(np.asarray(params, float))
        args = () if params is None else (np.broadcast_to(params, (times.size, params.shape[-1])).copy(),)
        return list(zip(times.tolist(), np.ascontiguousarray(states.reshape(n, -1).T), *args, strict=True))

    def named_parameters(self, given: Mapping[Any, Any]) -> np.ndarray:
        """Return the values of all parameters; see `Problem.named_parameters`."""
        return super().named_parameters(by_name("params", given))

    def motion_at(self, t: float, y: np.ndarray) -> np.ndarray:
        """Return the derivative (q', u') of one state, computed by functions that are not compiled."""
        out = np.empty(len(self.names.state))
        self.motion.rhs(t, np.ascontiguousarray(y, float), out, *([] if self.params is None else [self.params]))
        return out

    def _solved(self, t: float, y: np.ndarray, *args: np.ndarray) -> tuple[int, np.ndarray, np.ndarray]:
        """Return the rank of the constraints, u' and the multipliers at a state."""
        rates, accelerations, multipliers = map(np.empty, self.names.sizes)
        return self.motion.solved(t, y, rates, accelerations, multipliers, *args), accelerations, multipliers

    def start(
        self, q0: Any, u0: Any, params: Any = None, *, t: float | None = None, independent: Iterable[str] | None = None
    ) -> np.ndarray:
        """Return a state that meets the constraints.

        Parameters
        ----------
        q0, u0 : array_like or mapping
            Coordinates and speeds, in the order of ``names.coordinates`` and ``names.speeds`` or by name. The guess for
            those that are neither given nor independent is 0.
        params : mapping or array_like, optional
            Parameters, by default those of the problem. Several values of a parameter, or rows of an array, stand for
            the members of an ensemble.
        t : float, optional
            The time. Default: the start of the problem's interval, or 0.
        independent : iterable of str, optional
            Names of the coordinates and speeds whose given values are kept; all others are guesses, from which Newton's
            method finds the nearest solution. Default: those of the problem, which a model of SymPy may define.

        Returns
        -------
        ndarray, shape (n,) or (members, n)

        Raises
        ------
        ValueError
            If the constraints cannot be met; the message names the constraint that is violated most.
        """
        if params is not None:
            params = self.named_parameters(params) if isinstance(params, Mapping) else real_array("params", params)
        if params is not None and params.ndim == 2:
            return np.array([self.start(q0, u0, row, t=t, independent=independent) for row in params])
        time = self._begin if t is None else float(t)
        held = self.independent if independent is None else independent
        return started(self.name, self.names, self.constraints, q0, u0, params, time, held)[0]

    @property
    def _begin(self) -> float:
        return 0.0 if self.t_span is None else float(self.t_span[0])

    def __repr__(self) -> str:
        first, *others = super().__repr__().splitlines()
        lines = [f"  constraints {self._constraints_described()}"]
        for label, items in (("norms", self.norms), ("momenta", self.momenta)):
            lines += [f"  {label:<12}{', '.join(item.name or '' for item in items)}"] if items else []
        lines.append(f"  energy      {self.energy_kept}")
        others = [line for line in others if not line.startswith(("  invariants", "  functions"))]
        kind = "jitted by Numba" if is_jitted(self.rhs) else "plain Python"
        notes = [f"  note        {note}" for note in self.notes]
        return "\n".join([first, *others[:1], *lines, *others[1:], f"  functions   {kind}", *notes])

    def _constraints_described(self) -> str:
        m, n = len(self.names.velocities), len(self.names.speeds)
        rank = self.multipliers(self._begin, self.y0).rank if m else 0
        free = f"{n - rank} degree{'s' * (n - rank != 1)} of freedom"
        if m == 0:
            return f"none, {free}"
        return f"{m} on velocities of rank {rank}, {free}, {len(self.names.positions)} of them on positions too"

    def __reduce__(self) -> Any:
        """Pickle the expressions, or the functions of the user, from which all other functions are made again."""
        own, nq = self._own_invariants, len(self.names.coordinates)
        kept = [own.index(item) if item in own else item for item in self.invariants]
        others = {item.name: getattr(self, item.name) for item in fields(self) if item.name not in REMADE}
        arguments = (self.names, self._begin, (self.y0[:nq], self.y0[nq:]), self.params, None, self.rank_tolerance)
        return _again, (self.parts.origin, arguments, self.t_span, kept, others)

    @property
    def _own_invariants(self) -> tuple[Invariant, ...]:
        return (*self.constraints, *self.norms, *self.momenta, *([] if self.energy is None else [self.energy]))


# Attributes that are computed from other attributes.
REMADE = {
    "fun", "rhs", "y0", "t_span", "params", "invariants", "names", "constraints", "norms", "momenta", "energy",
    "energy_kept", "rank_tolerance", "motion", "parts",
}  # fmt: skip


def _again(
    origin: Any, arguments: Sequence[Any], t_span: Any, kept: Sequence[Any], others: dict[str, Any]
) -> MechanicsProblem:
    """Return an unpickled problem, whose invariants are `kept`: numbers of its own ones, or others."""
    made, given = origin
    problem = mechanics_problem("", made(*given), *arguments, t_span=t_span)
    own = problem._own_invariants
    return replace(problem, invariants=tuple(own[item] if isinstance(item, int) else item for item in kept), **others)


def mechanics_problem(
    name: str, parts: Parts, names: Names, t: float, start: tuple[Any, Any], params: np.ndarray | None,
    independent: Iterable[Any] | None, tolerance: float, *, t_span: Any, notes: tuple[str, ...] = (), **others: Any,
) -> MechanicsProblem:  # fmt: skip
    """Return the problem with the functions `parts`, started at the coordinates and speeds `start` at time `t`.

    The components in `independent`, by default all, keep the values in `start`; the others are guesses.
    """
    if not (is_number(tolerance) and 0 < tolerance < 1):
        raise ValueError(f"{name}: rank_tolerance must be a number between 0 and 1, got {shown(tolerance)}.")
    args, nq = () if params is None else (params,), len(names.coordinates)
    functions, once = (motion(fill, names.sizes, tolerance) for fill in (parts.fill, plain(parts.fill)))
    given = [independent] if isinstance(independent, str) else independent
    fun, held = bind(once.rhs, params), None if given is None else tuple(given)
    examined = _constraints_invariant(plain(parts.values), plain(parts.gradient), names, args)
    kept = _constraints_invariant(parts.values, parts.gradient, names, args)
    y0, solved = started(name, names, examined, *start, params, t, held)
    _require_accelerations(name, parts, once, names, t, y0, args)
    speed = typical_speed(y0, fun(t, y0), nq)
    for item in (*examined, *kept):
        item.scale = _at_speed(item, t, y0, nq, speed)
    near = Examined(states_near(t, y0, examined, fun, nq, None if t_span is None else float(t_span[1])), fun, args)
    energy, energy_kept = near.energy_of(parts.energies)
    norms = near.norms_of(parts, names, examined)
    momenta = near.momenta_of(parts.momenta, (*examined, *norms))
    for item in momenta:
        item.scale = _at_speed(item, t, y0, nq, speed)
    return MechanicsProblem(
        name=name, fun=bind(functions.rhs, params), rhs=functions.rhs, y0=y0, t_span=t_span, params=params,
        invariants=(*kept, *norms, *momenta, *([] if energy is None else [energy])),
        blocks=(np.arange(nq), np.arange(nq, y0.size)), component_names=names.state, names=names, constraints=kept,
        norms=norms, momenta=momenta, energy=energy, energy_kept=energy_kept, motion=once, parts=parts,
        notes=(*notes, *solved, *filter(None, [parts.note])), independent=held, rank_tolerance=tolerance, **others,
    )  # fmt: skip


def _require_accelerations(
    what: str, parts: Parts, functions: Motion, names: Names, t: float, y: np.ndarray, args: tuple[Any, ...]
) -> None:
    """Raise ValueError if constraints depend on each other at the start and no acceleration meets all of them."""
    rates, accelerations, multipliers = map(np.empty, names.sizes)
    if functions.solved(t, y, rates, accelerations, multipliers, *args) == multipliers.size:
        return
    _, _, G, gamma, _ = parts.matrices(names, t, y, args)
    left = np.abs(G @ accelerations + gamma)
    terms = np.abs(G) @ np.abs(accelerations) + np.abs(gamma)
    if (left > CONTRADICTING * terms.max(initial=0.0)).any():
        one, two = sorted(names.velocities[k] for k in np.argsort(-left)[:2])
        raise ValueError(
            f"{what}: no accelerations meet the constraints {one!r} and {two!r} at the start, where their gradients "
            f"depend on each other: the rates of the constraints on velocities remain up to {left.max():.3g}, "
            "expected 0. Remove a constraint that contradicts others, or start with speeds that the mechanism can have "
            "at this singular position."
        )


def _constraints_invariant(values: Any, gradient: Any, names: Names, args: tuple[Any, ...]) -> tuple[Invariant, ...]:
    """Return a tuple with one invariant that has all constraints as values; empty if there are no constraints."""
    every = (*names.positions, *names.velocities)
    item = Invariant(
        vector(values, len(every)), gradient, target=np.zeros(len(every)), args=args, size=len(every) or None,
        name="constraints", in_place=True,
    )  # fmt: skip
    item.value_names = every
    return (item,) if every else ()


def _at_speed(item: Invariant, t: float, y: np.ndarray, nq: int, speed: float) -> Any:
    """Return the `scale` of constraints, an array (size,), or of a momentum, a number.

    The scale is 0.1 times the terms that are proportional to the speeds, at a typical `speed`, because these terms
    vanish at rest. It is None if it is not finite.
    """
    slopes = np.empty((item.size or 1, y.size))
    plain(item.gradient)(t, y, slopes if item.size else slopes[0], *item.args)
    scale = SLOW * np.abs(slopes[:, nq:]).sum(axis=1) * speed
    return (scale if item.size else float(scale[0])) if np.isfinite(scale).all() else None
