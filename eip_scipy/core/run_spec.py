"""Construction of a run that is ready to step, from a specification: for solve_ivp, integrate, ensemble and project."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from ..engine.data import EPS, EUCLIDEAN, NEW, Method, Work
from ..engine.native import BUILD
from ..engine.trust import Trust
from ..methods.orders import AT_REST
from . import steppers
from .failures import projection_failure
from .frame import frame_rows, spanned
from .gradients import unless_error
from .invariant_checks import Complaint, reported
from .invariants import TARGET_TOLERANCE, InvariantSet
from .linear import (
    MORE,
    MOST_COMPONENTS,
    MOST_GRADIENTS,
    FoundInvariants,
    Samples,
    confirmed,
    found_invariants,
    independent_of,
)
from .multistep import SecondOrder, attach_history
from .options import ProjectionOptions
from .particles import Particles, missing_particles
from .runs import Run, Start
from .stepping import AnyMethod, Stepping
from .variations import Columns, widened

__all__ = ["RunSpec"]

START_ITERATIONS = 50
# Number of states near the start at which the total force and torque on particles are computed.
STATES = 3
FRAME_DISTANCE = 1e-4

Array = np.ndarray


class RunSpec(NamedTuple):
    """Specification of a run in numbers and functions of (t, y), which is common to all interfaces.

    `name` is the solver class, for messages. If `is_known`, `method` is the `tableau` of another run of these
    equations, which are not examined again. ``rhs(t, y) -> (n,)`` is checked and returns new arrays; `extra` are
    further arguments of the invariants' functions.

    ``jacobian()`` returns the Jacobian for a multistep method (see `SecondOrder`) or an implicit one, or None, and
    ``frequencies(y0, length)`` is that of `Problem`. With `level` a multistep method returns the state at the newest
    end of its history; otherwise that in the middle. ``hint()`` returns the end of a message: advice for equations that
    are not of second order. `columns` of derivatives follow the state; `stepping` and `projection` are for the state
    without them. `sees_velocity` says, for q'' = a, whether a comes from a function that is called with velocities too,
    on which it may come to depend; `is_second_order` that `rhs` is (v, a) by its construction. `called` and `left_out`:
    see `Run`. `uncounted` is `rhs` without the count of its calls, to search for what the system keeps, or None.
    """

    name: str
    method: AnyMethod
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
    columns: Columns | None = None
    sees_velocity: bool = True
    is_second_order: bool = False
    uncounted: Callable[[float, Array], Array] | None = None

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
        if method is AT_REST:
            return run  # the state may be far from the targets
        self._check(run, check_start)
        if method.has_history:
            self.attach_history(run, run.start)
        if method.drives:
            self.attach_solver(run, run.start)
        return run

    def examined(self, y0: Array, f0: Array | None = None) -> tuple[AnyMethod, Array]:
        """Return the method after a check of the equations, see `steppers.checked`, and the derivative (n,) at y0."""
        t0 = self.stepping.span.t0
        try:
            f0 = self.rhs(t0, y0) if f0 is None else f0
        except (ValueError, TypeError, IndexError) as error:
            if self.method.of_second_order and not self.is_second_order:
                error.add_note(f"With {self.name} too, fun(t, y) returns the derivative of y = (q, v){self.hint()}.")
            raise
        if self.is_known or self.is_second_order:
            return self.method, f0
        start = Start(t0, y0, f0, 0.0)
        return steppers.checked(self.method, self.rhs, start, self.name, self.hint, self.sees_velocity), f0

    def attach_history(self, run: Run, start: Start) -> None:
        """Give a run with a multistep method its history, which begins at `start`."""
        span = self.stepping.span
        frequencies = None if self.frequencies is None else self.frequencies(start.y, span.t_bound - span.t0)
        system = SecondOrder(self.rhs, start, self.jacobian(), frequencies)
        attach_history(run, self.name, system, self.stepping, level=self.level)

    def attach_solver(self, run: Run, start: Start) -> None:
        """Give a run with an implicit method its solver of SciPy, which begins at `start`."""
        run.method.begin(self.uncounted or self.rhs, start, self.stepping, self.jacobian())

    def _first_step(self, method: AnyMethod, y0: Array, f0: Array) -> float:
        """Return the length of the first step, chosen from the state alone, without columns of derivatives."""
        columns = self.columns
        if columns is None:
            return self.stepping.first(self.rhs, y0, f0, method)

        def derivative(t: float, y: Array) -> Array:
            wide = y0.copy()
            wide[columns.places] = y
            return columns.own(self.rhs(t, wide))

        return self.stepping.first(derivative, columns.own(y0), columns.own(f0), method)

    def _with_buffers(self, method: AnyMethod, start: Start, tell: bool) -> Run:
        """Return a run whose invariants have been evaluated at the start; `tell`: see `InvariantSet`."""
        t_bound, projection = self.stepping.span.t_bound, self.projection
        invariants = InvariantSet(projection.invariants, *start, self.extra, tell=tell, t_bound=t_bound, rhs=self.rhs)
        columns = self.columns
        y, f = start[1:3] if columns is None else map(columns.own, start[1:3])
        invariants.tau = self.stepping.scale_of_time(start.tau, y, f)
        depends_on_time = method is not AT_REST and invariants.size > 0 and invariants.add_rounding_of_time(start.y)
        options, sigma, identity = projection.settled(method, self.stepping, y, f, invariants)
        linear = None
        if self._may_have_frame(method, invariants):
            linear = unless_error(self._linear_invariants, start, invariants)
            C = np.zeros((0, 0)) if linear is None else linear.C
            options = options._replace(frame=frame_rows((C, C.T), y.size, 1)) if len(C) else options
        if columns is not None:
            options, sigma = widened(options, sigma, columns, invariants.start_gradients)
        invariants.kinds = options.kinds
        arrays = steppers.arrays(method)
        if isinstance(arrays, Method) and arrays.nystrom and self.sees_velocity:
            arrays = arrays._replace(sees_velocity=self.sees_velocity)
        carried, blocks = options.balances.place, options.groups.start.size - 1
        work = Work(start.y.size, start.y.dtype, arrays.b.size, invariants.size, blocks, carried.size)
        work.values[:], work.G[:] = invariants.start_values, invariants.start_gradients
        del invariants.start_gradients  # which may be large
        if carried.size:
            work.level[:] = invariants.target[carried]
            work.rates[[0, -1]] = np.nan  # not known yet
        if sigma is not None:
            work.sigma[:] = sigma
        trust = Trust(invariants.names, work.trust)
        return Run(
            start, start, self.stepping, method, arrays, options, work, invariants, identity, trust, self.called,
            self.left_out, depends_on_time=depends_on_time, linear=linear,
        )  # fmt: skip

    def _may_have_frame(self, method: AnyMethod, invariants: InvariantSet) -> bool:
        """Return True if linear invariants are to be found for the run, and can be kept by it."""
        option, is_known = self.projection.linear_invariants, self.projection.constraints is not None
        by_items = option == "given" and any(item.linear is not None for item in invariants.items)
        asked = not is_known and self.uncounted is not None and (option == "auto" or by_items)
        # A user's step need not keep linear invariants, and fields are projected by their own functions.
        keeps = (not method.in_python or method.drives) and not hasattr(invariants.items, "shift")
        plain = invariants.dtype.kind == "f" and not invariants.balances.items
        return asked and keeps and plain and invariants.size > 0

    def _linear_invariants(self, start: Start, invariants: InvariantSet) -> FoundInvariants | None:
        """Return the linear invariants that the corrections of a run from `start` leave unchanged."""
        derivative, gradients = self._of_state(start, invariants)
        columns = self.columns
        y, f = start[1:3] if columns is None else map(columns.own, start[1:3])
        searched = self.projection.linear_invariants == "auto" and y.size <= MOST_COMPONENTS
        given = next((item.linear for item in invariants.items if item.linear is not None), None)
        if not searched and (given is None or given.C.shape[1] != y.size):
            return None
        with np.errstate(all="ignore"):
            samples = Samples(derivative, start.t, y, f, invariants.tau, y.size if searched else MORE)
            if searched or given is None:
                found = found_invariants(samples, self.stepping.span.t_bound)
            else:
                found = confirmed(samples.y, samples.f, given)
            if not len(found.C):
                return FoundInvariants(found, 0, samples.calls)
            points = list(zip(samples.t.tolist(), samples.y, samples.f, strict=True))[:MOST_GRADIENTS]
            kept = independent_of(found, np.array([gradients(*point) for point in points]), samples.sizes)
        return FoundInvariants(kept, len(found.C), samples.calls)

    def _of_state(self, start: Start, invariants: InvariantSet) -> tuple[Any, Any]:
        """Return the derivative and the gradients as functions of the state alone, without columns of derivatives."""
        columns, rhs = self.columns, self.uncounted
        assert rhs is not None
        if columns is None:
            return rhs, invariants.gradients

        def wide(y: Array) -> Array:
            out = start.y.copy()
            out[columns.places] = y
            return out

        def gradients(t: float, y: Array, f: Array) -> Array:
            return invariants.gradients(t, wide(y), rhs(t, wide(y)))[:, columns.places]

        return lambda t, y: columns.own(rhs(t, wide(y))), gradients

    def _missing(self, run: Run) -> Particles | None:
        """Return the particles whose momentum and angular momentum the run does not keep, see `missing_particles`."""
        invariants, (t, y, f, _) = run.invariants, run.begin
        if self.uncounted is None or self.columns is not None or invariants.balances.items or y.dtype.kind == "c":
            return None
        if invariants.by_values.any() and y.size > MOST_COMPONENTS:
            return None  # gradients take long
        given = self.projection.constraints
        C = np.zeros((0, y.size)) if given is None else np.atleast_2d(given[0])
        C = C if run.linear is None else run.linear.C

        def sample() -> Any:
            samples = Samples(self.uncounted, t, y, f, invariants.tau, STATES)  # type: ignore[arg-type]
            return [(x, v, invariants.gradients(t, x, v)) for x, v in zip(samples.y, samples.f, strict=True)]

        with np.errstate(all="ignore"):
            return missing_particles(y, f, run.work.G, C, sample)

    def _check(self, run: Run, checks: bool) -> None:
        """Project the start if that is requested, and check the invariants and the steps there if `checks`."""
        if run.options.frame.products.size and (scales := _scales(run)) is not run.options.scales:
            run.options = run.options._replace(scales=scales)
        if self.projection.project_initial:
            t0, y0, _, tau = run.begin
            moved = projected_start(run, self.rhs)
            compared = y0, moved, run.invariants.floors
            run.moved = _moved(*(compared if self.columns is None else map(self.columns.own, compared)))
            run.start = Start(t0, moved, self.rhs(t0, moved), tau)
        violation = run.invariants.start_violation(*run.start[:3])
        if violation:
            raise ValueError(
                f"{violation}; correct y0 or the target, or pass project_initial=True to project y0 first."
            )
        if run.options.watched and checks and BUILD.are_finite(run.start.f.view(float)):
            known = (run.work.G, run.work.values) if run.start is run.begin else None
            run.trust.doubts += run.invariants.check(*run.start[:3], run.invariants.tau, known)
            run.missing = unless_error(self._missing, run)
        if self.projection.check and checks and run.tableau.in_python:
            text = steppers.of_another_equation(run.tableau, self.rhs, run.start, self.stepping.span.sign, self.called)
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
