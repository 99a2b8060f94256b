"""Search for what a system conserves in addition to the given invariants: linear invariants, momenta of particles."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np

from ..engine.native import LibraryFunction
from ..methods.base import PROJECTION_ONLY, Method
from .gradients import time_of_motion, typical_sizes, unless_error
from .invariant_set import InvariantSet
from .linear import LinearInvariants, confirmed, found_invariants, undetermined
from .options import ProjectionOptions
from .particles import Particles, missing_particles
from .tangent_vectors import TangentVectors

__all__ = ["Conserved", "Samples", "conserved"]

# Largest state whose linear invariants are searched for: the time grows with the cube of the number of components.
MOST_COMPONENTS = 300
# Number of points near the start if no invariants are searched for, and those at which gradients are computed; number
# of points far from it.
NEAR, FAR = 3, 5
# Distances of the points from the start, in units of the components' sizes.
NEAR_DISTANCE, FAR_DISTANCE = 1e-2, 0.5

Array = np.ndarray
Derivative = Callable[[float, Array], Array]


class Conserved(NamedTuple):
    """Linear invariants that the corrections of a run leave unchanged, and particles whose momenta it does not keep.

    `found` is the number of linear invariants with those that the given invariants determine, None if they were not
    looked for, and `calls` the number of evaluations.
    """

    linear: LinearInvariants = LinearInvariants(np.zeros((0, 0)), np.zeros((0, 0)))
    found: int | None = None
    calls: int = 0
    missing: Particles | None = None

    @property
    def remarks(self) -> tuple[str, ...]:
        """Return sentences for `Diagnostics`."""
        kept = len(self.linear.C)
        rest = "" if kept == self.found else "; the given invariants determine the others"
        text = f"linear invariants: {self.found} found by {self.calls} evaluations (not in nfev), {kept} kept{rest}"
        return (text,) * bool(self.found) + (() if self.missing is None else (str(self.missing),))


class Samples:
    """States around the start of a run and their derivatives. The states are the same in each run that starts there.

    There are `near` points near the start, at its time, and `far` points at larger distances, at times up to the end.
    `start` is a `Start`; of a state with `tangents` only the state itself is varied and returned. `calls` counts the
    evaluations of ``rhs(t, y)``.
    """

    def __init__(self, rhs: Derivative, start: Any, invariants: InvariantSet, tangents: TangentVectors) -> None:
        self._rhs, self._start, self.invariants, self._tangents = rhs, start, invariants, tangents
        self.y0, self.f0, self.G0 = map(tangents.state, (start.y, start.f, invariants.start_gradients))
        self.near, self.far, self.calls = NEAR, 0, 0

    @cached_property
    def sizes(self) -> Array:
        """Return the sizes (n,) of the components."""
        tau = min(self.invariants.tau, time_of_motion(self.y0, self.f0))
        return np.abs(self.y0) + typical_sizes(self.y0, self.f0, tau)

    @cached_property
    def points(self) -> tuple[Array, Array]:
        """Return states (m, n) and derivatives, which are NaN where the function fails."""
        t0, t_bound = self.invariants.t_span
        ways = _directions(self.near, self.far, self.y0.size)
        if not self.y0.all():  # a component that is 0 at the start may have to stay nonnegative, as a concentration
            ways = np.where(self.y0 == 0, np.abs(ways), ways)
        y = self.y0 + ways * self.sizes
        f = np.empty_like(y)
        span = t_bound - t0 if np.isfinite(t_bound) else 0.0
        times = [t0] * self.near + [t0 + span * k / (FAR - 1) for k in range(self.far)]
        self.calls += len(times)
        for k, t in enumerate(times):
            found = unless_error(self._rhs, t, self._augmented(y[k]))
            f[k] = np.nan if found is None else self._tangents.state(found)
        return y, f

    @cached_property
    def gradients(self) -> Array:
        """Return the gradients (NEAR, l, n) of the invariants at the first points."""
        self.calls += NEAR
        states = [(self._start.t, self._augmented(state)) for state in self.points[0][:NEAR]]
        found = [self.invariants.gradients(*here, self._rhs(*here)) for here in states]
        return self._tangents.state(np.array(found))

    def _augmented(self, y: Array) -> Array:
        return self._tangents.with_state(self._start.y, y)


@lru_cache(maxsize=8)
def _directions(near: int, far: int, n: int) -> Array:
    """Return random directions (near + far, n), the same in each run, of lengths that suit the distances."""
    ways = np.tanh(np.random.default_rng(20220).standard_normal((near + far, n)))
    return ways * np.repeat([NEAR_DISTANCE, FAR_DISTANCE], [near, far])[:, None]


def conserved(samples: Samples, projection: ProjectionOptions, method: Method, names: bool) -> Conserved:
    """Return what a system conserves; nothing if its runs cannot keep it.

    Particles are looked for if `names`, but not in ready problems.
    """
    invariants, n = samples.invariants, samples.y0.size
    plain = invariants.dtype.kind == "f" and not invariants.balances.items
    # Fields are projected by their own functions.
    if not plain or invariants.size == 0 or method is PROJECTION_ONLY or hasattr(invariants.items, "shift"):
        return Conserved()
    given = projection.constraints
    may_keep = given is None and (not method.in_python or method.drives)  # a user's step need not keep any
    known = next((item.linear for item in invariants.items if item.linear is not None), None)
    names = names and not all(isinstance(item.function, LibraryFunction) for item in invariants.items)
    found, count, _, missing = Conserved()
    with np.errstate(all="ignore"):
        if may_keep and projection.is_searched and n <= MOST_COMPONENTS:
            samples.near, samples.far = max(n, NEAR), FAR
            found = found_invariants(*samples.points)
            count = len(found.C)
        elif may_keep and known is not None and known.C.shape[1] == n:
            found = known.only(confirmed(*samples.points, known))
            count = len(found.C)
        if count:
            found = found.only(undetermined(found.C, samples.gradients, samples.sizes))
        # Momentum is among what a search finds. Gradients by differences take long.
        if names and (count or not samples.far) and not (n > MOST_COMPONENTS and invariants.by_values.any()):
            missing = missing_particles(samples, found.C.reshape(-1, n) if given is None else np.atleast_2d(given[0]))
    return Conserved(found, count, samples.calls, missing)
