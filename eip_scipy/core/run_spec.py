"""Construction of a run that is ready to step, from a specification: for solve_ivp, integrate, ensemble and project."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from ..engine.data import EPS, EUCLIDEAN, NEW, Work
from ..engine.native import BUILD
from ..engine.trust import Trust
from ..methods.base import PROJECTION_ONLY, Method
from .conserved import Conserved, Samples, conserved
from .failures import projection_failure
from .frame import frame_rows, spanned
from .gradients import unless_error
from .invariant_checks import Complaint, reported
from .invariant_set import TARGET_TOLERANCE, InvariantSet
from .options import ProjectionOptions
from .runs import Run, Start
from .stepping import Stepping
from .tangent_vectors import NO_TANGENT_VECTORS, TangentVectors

__all__ = ["RunSpec"]

START_ITERATIONS = 50
FRAME_DISTANCE = 1e-4

Array = np.ndarray


class RunSpec(NamedTuple):
    """Specification of a run in numbers and functions of (t, y), which is common to all interfaces.

    `name` is the solver class, for messages. If `is_known`, `method` is the `tableau` of another run of these
    equations, which are not examined again. ``rhs(t, y) -> (n,)`` is checked and returns new arrays; `extra` are
    further arguments of the invariants' functions.

    ``jacobian()`` returns the Jacobian for a multistep method (see `jacobian_product`) or an implicit one, or None, and
    ``frequencies(y0, length)`` is that of `Problem`. With `level` a multistep method returns the state at the newest
    end of its history; otherwise that in the middle. ``hint()`` returns the end of a message: advice for equations that
    are not of second order. `tangents` are the vectors in the augmented state; `stepping` and `projection` are for the
    state without them. `sees_velocity` says, for q'' = a, whether a comes from a function that is called with
    velocities too, on which it may come to depend; `is_second_order` that `rhs` is (v, a) by its construction. `called`
    and `left_out`: see `Run`. ``uncount(calls)`` takes back the count of calls of `rhs` that are no part of ``nfev``.
    """

    name: str
    method: Method
    rhs: Callable[[float, Array], Array]
    stepping: Stepping
    projection: ProjectionOptions
    is_known: bool = False
    extra: tuple[Any, ...] = ()
    jacobian: Callable[[], Any] = lambda: None
    frequencies: Callable[[Array, float], tuple[Array, float]] | None = None
    level: bool = False
    hint: Callable[[], str] = str
    called: str = "fun"
    left_out: str = ""
    tangents: TangentVectors = NO_TANGENT_VECTORS
    sees_velocity: bool = True
    is_second_order: bool = False
    uncount: Callable[[int], None] = lambda calls: None

    def build(self, y0: Array, f0: Array | None = None, tau: float | None = None, *, check_start: bool = True) -> Run:
        """Return the run that starts at the state y0, after a check of the options, the functions and the invariants.

        The derivative `f0` (n,) at y0 and the length `tau` of the first step are computed if they are None.
        `check_start` is False if the invariants and the steps of a user-defined method have been checked, and costs
        reported, at the start of a similar run.
        """
        made: Any = BUILD.call(self._built, y0, f0, tau, check_start)
        return made

    def _built(self, y0: Array, f0: Array | None, tau: float | None, check_start: bool) -> Run:
        t0 = self.stepping.span.t0
        method, f0 = self.examined(y0, f0)
        tau = self._first_step(method, y0, f0) if tau is None else tau
        run = self._with_buffers(method, Start(t0, y0, f0, tau), check_start)
        if method is PROJECTION_ONLY:
            return run  # the state may be far from the targets
        self._check(run, check_start)
        method.begin(self, run, run.start)
        return run

    def examined(self, y0: Array, f0: Array | None = None) -> tuple[Method, Array]:
        """Return the method after a check of the equations, see `Method.checked`, and the derivative (n,) at y0."""
        t0 = self.stepping.span.t0
        try:
            f0 = self.rhs(t0, y0) if f0 is None else f0
        except (ValueError, TypeError, IndexError) as error:
            if self.method.of_second_order and not self.is_second_order:
                error.add_note(f"With {self.name} too, fun(t, y) returns the derivative of y = (q, v){self.hint()}.")
            raise
        if self.is_known or self.is_second_order:
            return self.method, f0
        return self.method.checked(self, Start(t0, y0, f0, 0.0)), f0

    def _first_step(self, method: Method, y0: Array, f0: Array) -> float:
        """Return the length of the first step, chosen from the state alone, without tangent vectors."""
        tangents = self.tangents
        derivative = tangents.of_state(self.rhs, y0)
        return self.stepping.first(derivative, tangents.state(y0), tangents.state(f0), method)

    def _with_buffers(self, method: Method, start: Start, tell: bool) -> Run:
        """Return a run whose invariants have been evaluated at the start; `tell`: see `InvariantSet`."""
        t_bound, projection = self.stepping.span.t_bound, self.projection
        invariants = InvariantSet(projection.invariants, *start, self.extra, tell=tell, t_bound=t_bound, rhs=self.rhs)
        y, f = map(self.tangents.state, start[1:3])
        invariants.tau = self.stepping.scale_of_time(start.tau, y, f)
        depends_on_time = method is not PROJECTION_ONLY and invariants.add_rounding_of_time(start.y)
        options, sigma, identity = projection.settled(method, self.stepping, y, f, invariants)
        samples = Samples(self.rhs, start, invariants, self.tangents)
        found = unless_error(conserved, samples, projection, method, tell and options.watched)
        found = Conserved(calls=samples.calls) if found is None else found
        self.uncount(found.calls)
        if len(C := found.linear.C):
            options = options._replace(frame=frame_rows((C, C.T), y.size, 1))
        options, sigma = self.tangents.options(options, sigma, invariants.start_gradients)
        invariants.kinds = options.kinds
        stepper = method.for_engine(self.sees_velocity)
        carried, blocks = options.balances.place, options.groups.start.size - 1
        work = Work(start.y.size, start.y.dtype, stepper.b.size, invariants.size, blocks, carried.size)
        work.values[:], work.G[:] = invariants.start_values, invariants.start_gradients
        del invariants.start_gradients  # which may be large
        if carried.size:
            work.level[:] = invariants.target[carried]
            work.rates[[0, -1]] = np.nan  # not known yet
        if sigma is not None:
            work.sigma[:] = sigma
        trust = Trust(invariants.names, work.trust)
        return Run(
            start, start, self.stepping, method, stepper, options, work, invariants, identity, trust, found,
            self.called, self.left_out, depends_on_time=depends_on_time,
        )  # fmt: skip

    def _check(self, run: Run, checks: bool) -> None:
        """Project the start if that is requested, and check the invariants and the steps there if `checks`."""
        if run.options.frame.products.size and (scales := _scales(run)) is not run.options.scales:
            run.options = run.options._replace(scales=scales)
        if self.projection.project_initial:
            t0, y0, _, tau = run.begin
            moved = projected_start(run, self.rhs)
            run.moved = _moved(*map(self.tangents.state, (y0, moved, run.invariants.floors)))
            run.start = Start(t0, moved, self.rhs(t0, moved), tau)
        violation = run.invariants.start_violation(*run.start[:3])
        if violation:
            raise ValueError(
                f"{violation}; correct y0 or the target, or pass project_initial=True to project y0 first."
            )
        if run.options.watched and checks and BUILD.are_finite(run.start.f.view(float)):
            known = (run.work.G, run.work.values) if run.start is run.begin else None
            run.trust.doubts += run.invariants.check(*run.start[:3], run.invariants.tau, known)
        if self.projection.check and checks:
            text = run.tableau.contradiction(self, run.start)
            if text is not None:
                run.trust.doubts += reported([Complaint(False, text, "Make the method for the equation of this run")])


def _scales(run: Run) -> Array:
    """Return the scales (l,) of the dead bands, within which errors of the invariants are not corrected.

    Invariants that are functions of C y alone, where C is the matrix of the linear constraints of the option `frame`,
    get scales so large that their errors stay within the dead bands. Corrections, which leave C y unchanged, could not
    reduce these errors. The gradients are examined at two states, because a gradient may be a combination of rows of C
    by chance.
    """
    (t0, y0, f0, tau), frame, invariants, G = run.begin, run.options.frame, run.invariants, run.work.G
    held = spanned(frame, G.view(float))
    if not np.count_nonzero(held):
        return run.options.scales
    away = y0 + FRAME_DISTANCE * (np.abs(y0) + tau * np.abs(f0)) * np.cos(np.arange(y0.size))
    held &= spanned(frame, invariants.gradients(t0, away, f0).view(float))
    return np.where(held, invariants.sizes_of_terms(y0, G, run.work.values) / EPS, run.options.scales)


def projected_start(run: Run, rhs: Callable[[float, Array], Array]) -> Array:
    """Return the start projected onto the targets, by full Newton steps in the euclidean metric."""
    t0, y0, f0, _ = run.begin
    options = run.options._replace(
        metric=EUCLIDEAN, direction=NEW, iterations=START_ITERATIONS, compensated=False, watched=False, limit=np.inf
    )
    work = Work(y0.size, y0.dtype, 0, run.invariants.size, options.groups.start.size - 1)
    work.K[-1] = f0
    y, status = replace(run, options=options, work=work).projected(rhs, t0, y0)
    if status != 0 or run.invariants.misses(t0, y, f0).any():
        raise ValueError(projection_failure(run.invariants, work, t0))
    return y


def _moved(before: Array, after: Array, floors: Array) -> str:
    """Return a sentence on how far the projection moved the start; "" if by no more than `TARGET_TOLERANCE`."""
    share = np.abs(after - before) / np.maximum(np.abs(before), floors)
    count, k = int(np.count_nonzero(share > TARGET_TOLERANCE)), int(np.argmax(share)) if share.size else 0
    if not count:
        return ""
    return (
        f"project_initial moved {count} of {share.size} components of y0, most of all y0[{k}], from {before[k]:.6g} to "
        f"{after[k]:.6g}"
    )
