"""Mechanical systems with constraints as problems."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from ...core.functions import is_jitted
from ...core.inputs import is_number, real_array, shown
from ...core.invariants import Invariant
from ...core.problem import Problem, bind
from ...core.results import Multipliers
from .energies import energy_of, momenta_of, norms_of, states_near, typical_speed
from .motion import Motion, Sizes, motion, plain, vector
from .parts import Outputs, Parts, columns_of
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
        Names of coordinates, speeds and constraints.
    constraints : tuple of Invariant
        The constraints, with the target 0; empty for a system without constraints.
    norms : tuple of Invariant
        Sums of squares of coordinates that are constant because of the kinematics, such as the norm of a quaternion.
    momenta : tuple of Invariant
        Momenta of coordinates that neither the energy nor forces depend on.
    energy : Invariant, Balance or None
        The energy, if a run can keep it.
    energy_kept : str
        How a run keeps the energy, or why it does not.
    motion : Motion
        Functions of the motion.
    notes : tuple of str
        Descriptions of changes to the equations and to the start.
    parameter_names : tuple of str
        Names of the parameters, in the order of `params`.
    observer : Outputs, optional
        The functions of `outputs`.
    rank_tolerance : float
        Distance within which gradients of constraints, each scaled to length 1, count as dependent.
    origin : tuple, optional
        The function that made the functions of the problem, and its arguments, from which they are made again.
    """

    names: Names
    constraints: tuple[Invariant, ...]
    norms: tuple[Invariant, ...] = ()
    momenta: tuple[Invariant, ...] = ()
    energy: Invariant | None
    energy_kept: str
    motion: Motion
    notes: tuple[str, ...] = ()
    parameter_names: tuple[str, ...] = ()
    observer: Outputs | None = None
    rank_tolerance: float
    origin: Any = None

    @property
    def parameters(self) -> dict[str, float]:
        """Return the values of the parameters by name."""
        values = [] if self.params is None else self.params.tolist()
        return dict(zip(self.parameter_names, values, strict=True))

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
            Parameters of the run. Default: those of the problem.

        Returns
        -------
        Multipliers
        """
        times, columns = columns_of("multipliers", t, y, len(self.names.state))
        found, ranks = np.empty((len(self.names.velocities), times.size)), np.empty(times.size, int)
        extra = self._extra(params)
        for k, time in enumerate(times):
            ranks[k], _, found[:, k] = self._solved(time, columns[:, k], extra)
        if np.ndim(t) == 0:
            return Multipliers(self.names.velocities, found[:, 0], int(ranks[0]))
        return Multipliers(self.names.velocities, found, ranks)

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
        if self.observer is None:
            return {}
        times, columns = columns_of("outputs", t, y, len(self.names.state))
        names, fill = self.observer.names, plain(self.observer.fill)
        found, extra = np.empty((len(names), times.size)), self._extra(params)
        for k, time in enumerate(times):
            state = np.append(columns[:, k], self._solved(time, columns[:, k], extra)[1])
            row = np.empty(len(names))
            fill(time, state, row, *extra)
            found[:, k] = row
        return dict(zip(names, found[:, 0].tolist() if np.ndim(t) == 0 else found, strict=True))

    def observed(self, t: Any, y: Any, params: Any = None) -> dict[str, Any]:
        """Return the outputs and the multipliers of a run, see `Problem.observed`."""
        found: dict[str, Any] = {}
        if self.observer is not None:
            found["outputs"] = self.outputs(t, y, params)
        if self.names.velocities:
            found["multipliers"] = self.multipliers(t, y, params)
        return found

    def _extra(self, params: Any) -> tuple[np.ndarray, ...]:
        """Return a tuple with the parameters, the last argument of functions; it is empty if there are none."""
        if params is None:
            params = self.params
        elif isinstance(params, Mapping):
            params = self.named_parameters(params)
        return () if params is None else (np.asarray(params, float),)

    def named_parameters(self, given: Mapping[Any, Any]) -> np.ndarray:
        """Return the values of all parameters; see `Problem.named_parameters`."""
        return super().named_parameters(by_name("params", given))

    def motion_at(self, t: float, y: np.ndarray) -> np.ndarray:
        """Return the derivative (q', u') of one state, computed by functions that are not compiled."""
        out = np.empty(len(self.names.state))
        self.motion.rhs(t, np.ascontiguousarray(y, float), out, *self._extra(None))
        return out

    def _solved(self, t: float, y: np.ndarray, extra: tuple[np.ndarray, ...]) -> tuple[int, np.ndarray, np.ndarray]:
        """Return the rank of the constraints, u' and the multipliers at a state."""
        n, m = len(self.names.speeds), len(self.names.velocities)
        rates, accelerations, multipliers = np.empty(len(self.names.coordinates)), np.empty(n), np.empty(m)
        rank = self.motion.solved(float(t), np.ascontiguousarray(y), rates, accelerations, multipliers, *extra)
        return int(rank), accelerations, multipliers

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
            method finds the nearest solution. Default: all values are kept.

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
        t = (0.0 if self.t_span is None else self.t_span[0]) if t is None else float(t)
        if params is not None and params.ndim == 2:
            return np.array([self.start(q0, u0, row, t=t, independent=independent) for row in params])
        return started(self.name, self.names, self.constraints, q0, u0, params, t, independent)[0]

    def __repr__(self) -> str:
        first, *others = super().__repr__().splitlines()
        lines = [line for line in others if not line.startswith(("  invariants", "  functions"))]
        kind = "jitted by Numba" if is_jitted(self.rhs) else "plain Python"
        conserved = [
            f"  {label:<12}{', '.join(item.name or '' for item in items)}"
            for label, items in (("norms", self.norms), ("momenta", self.momenta))
            if items
        ]
        lines[1:1] = [
            f"  constraints {self._constraints_described()}", *conserved, f"  energy      {self.energy_kept}"
        ]  # fmt: skip
        lines += [f"  functions   {kind}", *(f"  note        {note}" for note in self.notes)]
        return "\n".join([first, *lines])

    def _constraints_described(self) -> str:
        m, n = len(self.names.velocities), len(self.names.speeds)
        if m == 0:
            return f"none, {_degrees(n)}"
        rank = self._solved(0.0 if self.t_span is None else self.t_span[0], self.y0, self._extra(None))[0]
        rest = f" of rank {rank}, {_degrees(n - rank)}"
        return f"{m} on velocities{rest}, {len(self.names.positions)} of them on positions too"

    def __reduce__(self) -> Any:
        """Pickle the expressions, or the functions of the user, from which all other functions are made again."""
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
        return (*self.constraints, *self.norms, *self.momenta, *([] if self.energy is None else [self.energy]))


# Attributes that are computed from other attributes.
REMADE = {
    "fun", "rhs", "y0", "t_span", "params", "invariants", "constraints", "norms", "momenta", "energy", "energy_kept",
    "motion", "names", "observer", "rank_tolerance", "origin",
}  # fmt: skip


def _again(origin: Any, arguments: Sequence[Any], kept: Sequence[Any], others: dict[str, Any]) -> MechanicsProblem:
    names, t_span, start, params, tolerance = arguments
    t = 0.0 if t_span is None else t_span[0]
    made, given = origin
    problem = mechanics_problem("", made(*given), names, t, start, params, None, tolerance, t_span=t_span)
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
    """Return the problem with the functions `parts`, started at the coordinates and speeds `start` at time `t`.

    The components in `independent`, by default all, keep the values in `start`; the others are guesses.
    """
    if not (is_number(tolerance) and 0 < tolerance < 1):
        raise ValueError(f"{name}: rank_tolerance must be a number between 0 and 1, got {shown(tolerance)}.")
    sizes, args = names.sizes, () if params is None else (params,)
    functions = motion(parts.fill, sizes, tolerance)
    once = motion(plain(parts.fill), sizes, tolerance)
    fun = bind(once.rhs, params)
    examined = _constraints_invariant(plain(parts.values), plain(parts.gradient), names, args)
    y0, solved = started(name, names, examined, *start, params, t, independent)
    _require_accelerations(name, parts, once, names, t, y0, args)
    kept = _constraints_invariant(parts.values, parts.gradient, names, args)
    for item in (*examined, *kept):
        item.scale = _at_speed(plain(parts.gradient), item.size, t, y0, fun, sizes, item.args)
    states = states_near(t, y0, examined, fun, sizes.coordinates, None if t_span is None else float(t_span[1]))
    energy, described = energy_of(parts.energies, fun, states, args)
    norms = norms_of(parts, names, examined, states, args)
    momenta = momenta_of(parts.momenta, (*examined, *norms), fun, states, args)
    for item in momenta:
        item.scale = _at_speed(plain(item.gradient), None, t, y0, fun, sizes, item.args)
    nq = sizes.coordinates
    return MechanicsProblem(
        name=name,
        fun=bind(functions.rhs, params),
        rhs=functions.rhs,
        y0=y0,
        t_span=t_span,
        params=params,
        invariants=(*kept, *norms, *momenta, *([] if energy is None else [energy])),
        blocks=(np.arange(nq), np.arange(nq, y0.size)),
        component_names=names.state,
        names=names,
        constraints=kept,
        norms=norms,
        momenta=momenta,
        observer=parts.outputs,
        energy=energy,
        energy_kept=described,
        motion=once,
        notes=(*notes, *solved, *filter(None, [parts.note])),
        rank_tolerance=tolerance,
        origin=parts.origin,
        **others,
    )


def _require_accelerations(
    what: str, parts: Parts, functions: Motion, names: Names, t: float, y: np.ndarray, args: tuple[Any, ...]
) -> None:
    """Raise ValueError if constraints depend on each other at the start and no acceleration meets all of them."""
    nq, n, m = names.sizes
    rates, accelerations = np.empty(nq), np.empty(n)
    if functions.solved(t, y, rates, accelerations, np.empty(m), *args) == m:
        return
    _, _, G, gamma, _ = parts.matrices(names, t, y, args)
    left = G @ accelerations + gamma
    terms = np.abs(G) @ np.abs(accelerations) + np.abs(gamma)
    if (np.abs(left) > CONTRADICTING * terms.max(initial=0.0)).any():
        one, two = sorted(names.velocities[k] for k in np.argsort(-np.abs(left))[:2])
        raise ValueError(
            f"{what}: no accelerations meet the constraints {one!r} and {two!r} at the start, where their gradients "
            f"depend on each other: the rates of the constraints on velocities remain up to {np.abs(left).max():.3g}, "
            "expected 0. Remove a constraint that contradicts others, or start with speeds that the mechanism can have "
            "at this singular position."
        )


def _constraints_invariant(
    fill: Callable[..., None], gradient: Callable[..., None], names: Names, args: tuple[Any, ...]
) -> tuple[Invariant, ...]:
    """Return a tuple with one invariant that has all constraints as values; empty if there are no constraints."""
    size = len(names.positions) + len(names.velocities)
    if size == 0:
        return ()
    item = Invariant(
        vector(fill, size), gradient, target=np.zeros(size), args=args, size=size, name="constraints", in_place=True
    )
    item.value_names = (*names.positions, *names.velocities)
    return (item,)


def _at_speed(
    gradient: Callable[..., None],
    size: int | None,
    t: float,
    y: np.ndarray,
    derivative: Callable[[float, np.ndarray], np.ndarray],
    sizes: Sizes,
    args: tuple[Any, ...],
) -> Any:
    """Return the `scale` of constraints, an array (size,), or of a momentum, a number, if `size` is None.

    The scale is 0.1 times the terms that are proportional to the speeds, at a typical speed, because these terms vanish
    at rest. It is None if it is not finite.
    """
    nq = sizes.coordinates
    speed = typical_speed(y[:nq], y[nq:], derivative(t, y)[nq:])
    slopes = np.empty((size or 1, y.size))
    gradient(t, y, slopes if size else slopes[0], *args)
    scale = SLOW * np.abs(slopes[:, nq:]).sum(axis=1) * speed
    return (scale if size else float(scale[0])) if np.isfinite(scale).all() else None
