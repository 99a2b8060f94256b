"""A run: its method, options, invariants and buffers, made and checked at its start, and watched while it goes on."""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from ..engine import data
from ..engine.data import EPS, NOTHING, OK, PENDING, REASON, Schedule, Work, bare_schedule, new_work
from ..engine.native import BUILD, Call, Engine, NativeFunctions, PythonFunctions
from ..engine.trust import Trust
from ..methods.base import PROJECTION_ONLY, Method
from .callers import users_level
from .conserved import Conserved, confirmed, conserved, states_near
from .examination import Derivative, Examiner, is_check_due, unresolved
from .failures import projection_failure
from .invariant_checks import Finding, findings, listed, reported
from .invariant_set import TARGET_TOLERANCE, InvariantSet
from .projection import ProjectionOptions, are_combinations, linear_rows
from .results import Diagnostics, slowness
from .step_control import StepControl

if TYPE_CHECKING:
    from .bound_problem import BoundProblem

__all__ = ["Run", "Start"]

START_ITERATIONS = 50
# Steps without projections that are made for comparison in a faulty run, and how much longer they are in one that ends.
FREE_STEPS, SLOWED, LEAST_STEPS = 10, 10.0, 100
COMBINATION_DISTANCE = 1e-4

# Attributes that `restore` makes again, and those that a copy does not need.
RESTORED = ("method", "invariants", "diagnostics", "examiner")

Array = np.ndarray


class Start(NamedTuple):
    """Start of a run: time, state, derivative, and the length of the fixed or first step, which is a scale of time."""

    t: float
    y: Array
    f: Array
    tau: float


class Run:
    """A run of a `BoundProblem` by a method, as all interfaces use it; `start_at` makes its buffers and checks it.

    `name` is the solver class, for messages. `projection` has the user's options, and `options` what the step makes of
    them. With `level` a multistep method returns the state at the newest end of its history; otherwise that in the
    middle.

    After the start, `method` is the method for these equations, and `stepper` the form of it that the engine uses for
    the steps. The invariants were measured at `begin`; `start`, of the first step, may have been moved by
    `project_initial`, and `moved` says how far. `looked` is the step at which the invariants were checked last.
    `depends_on_time` is True if an invariant depends on time; its scale then depends on the start. `conserved` is what
    the system conserves in addition to the invariants. Whoever makes the steps sets `schedule`.
    """

    begin: Start
    start: Start
    stepper: Any
    options: Any
    work: Work
    invariants: InvariantSet
    trust: Trust
    conserved: Conserved
    schedule: Schedule
    diagnostics: Diagnostics

    def __init__(
        self,
        problem: BoundProblem,
        name: str,
        method: Method,
        stepping: StepControl,
        projection: ProjectionOptions,
        *,
        level: bool = False,
    ) -> None:
        self.problem, self.name, self.method, self.stepping = problem, name, method, stepping
        self.projection, self.level = projection, level
        self.tangents = problem.tangents
        self.looked, self.moved, self.depends_on_time, self._warned_of_balances = -1, "", False, False

    @property
    def y0(self) -> Array:
        """Return the state at which the first step starts."""
        return self.start.y

    @property
    def uses_jacobian(self) -> bool:
        """True if the method corrects accelerations by the Jacobian."""
        history = self.stepper.multistep
        return history is not None and history.corrected_count > 0

    def start_at(
        self,
        y0: Array,
        f0: Array | None = None,
        tau: float | None = None,
        *,
        check: bool = True,
        is_known: bool = False,
    ) -> Run:
        """Start at the state y0, after a check of the options, the functions and the invariants, and return the run.

        The derivative `f0` (n,) at y0 and the length `tau` of the first step are computed if they are None. `check` is
        False if the invariants and the steps of a user-defined method have been checked, and costs reported, at the
        start of a similar run. `is_known` is True if the equations have been examined for the method.
        """
        BUILD.call(self._start_at, y0, f0, tau, check, is_known)
        return self

    def _start_at(self, y0: Array, f0: Array | None, tau: float | None, check: bool, is_known: bool) -> None:
        f0 = self.examine(y0, f0, is_known=is_known)
        if tau is None:  # it depends on the state alone, without tangent vectors
            tangents = self.tangents
            derivative = tangents.of_state(self.problem.derivative, y0)
            tau = self.stepping.first(derivative, tangents.state(y0), tangents.state(f0), self.method)
        self.begin = self.start = Start(self.stepping.span.t0, y0, f0, tau)
        self._make_buffers(check)
        if self.method is PROJECTION_ONLY:
            return  # the state may be far from the targets
        self._check(check)
        self.method.begin(self, self.start)

    def examine(self, y0: Array, f0: Array | None = None, *, is_known: bool = False) -> Array:
        """Return the derivative (n,) at y0 after a check of the equations by the method, unless they are known."""
        t0, is_second_order = self.stepping.span.t0, self.problem.is_second_order
        try:
            f0 = self.problem.derivative(t0, y0) if f0 is None else f0
        except (ValueError, TypeError, IndexError) as error:
            if self.method.of_second_order and not is_second_order:
                hint = self.problem.hint()
                error.add_note(f"With {self.name} too, fun(t, y) returns the derivative of y = (q, v){hint}.")
            raise
        if not (is_known or is_second_order):
            self.method = self.method.checked(self, Start(t0, y0, f0, 0.0))
        return f0

    def _make_buffers(self, tell: bool) -> None:
        """Evaluate the invariants at the start, and make the buffers for them; `tell`: see `InvariantSet`."""
        start, method, projection = self.start, self.method, self.projection
        self.invariants = invariants = self._invariants_at(start)
        y, f = map(self.tangents.state, start[1:3])
        invariants.tau = self.stepping.scale_of_time(start.tau, y, f)
        self.depends_on_time = method is not PROJECTION_ONLY and invariants.add_rounding_of_time(start.y)
        options, sigma = projection.validate(method, self.stepping, y, f, invariants)
        self.conserved = conserved(self, y, f, tell and options.watched)
        if len(C := self.conserved.linear.C):
            frame = linear_rows((C, C.T), y.size, 1)
            options = options._replace(frame=frame._replace(value=frame.value.copy(), bodies=frame.bodies.copy()))
        masses = self.conserved.masses
        if masses.size:
            computed = np.maximum(options.computed, np.isfinite(masses[:, 0]))
            options = options._replace(masses=masses, uses_f=True, computed=computed)
        if tell:
            invariants.warn_of_gradients(self.conserved.rows_from_f)
        self.options, sigma = self.tangents.options(options, sigma, invariants.start_gradients)
        invariants.kinds = options.kinds
        self.stepper = method.for_engine(self.problem.sees_velocity)
        carried, blocks = options.balances.place, options.blocks.start.size - 1
        size = self.stepper.b.size
        self.work = work = new_work(start.y.size, start.y.dtype, size, invariants.size, blocks, carried.size)
        work.values[:], work.G[:] = invariants.start_values, invariants.start_gradients
        work.counters[data.FROM_F] = masses.size > 0
        del invariants.start_gradients  # which may be large
        if carried.size:
            work.level[:] = invariants.target[carried]
            work.rates[[0, -1]] = np.nan  # not known yet
        if sigma is not None:
            work.sigma[:] = sigma
        self.trust = Trust(invariants.names, work.trust)

    def _invariants_at(self, start: Start) -> InvariantSet:
        problem, t_bound = self.problem, self.stepping.span.t_bound
        return InvariantSet(
            self.projection.invariants, *start, problem.extra, t_bound=t_bound,
            kind=problem.called_kind, params=problem.parameters,
        )  # fmt: skip

    def _check(self, checks: bool) -> None:
        """Project the start if that is requested, and check the invariants and the steps there if `checks`."""
        if self.options.frame.products.size and (scales := self._scales()) is not self.options.scales:
            self.options = self.options._replace(scales=scales)
        rhs = self.problem.derivative
        if self.projection.project_initial:
            t0, y0, _, tau = self.begin
            moved = self._projected_start()
            self.moved = _moved(*map(self.tangents.state, (y0, moved, self.invariants.floors)))
            self.start = Start(t0, moved, rhs(t0, moved), tau)
        if violation := self.invariants.start_violation(*self.start[:3]):
            raise ValueError(
                f"{violation}; correct y0 or the target, or pass project_initial=True to project y0 first."
            )
        if self.options.watched and checks and BUILD.are_finite(self.start.f.view(float)):
            known = (self.work.G, self.work.values) if self.start is self.begin else None
            found = findings(self.invariants, *self.start[:3], self.invariants.tau, rhs, known)
            self.trust.doubts += reported(found)
        if self.projection.check and checks:
            text = self.method.contradiction(self, self.start)
            if text is not None:
                self.trust.doubts += reported([Finding(False, text, "Make the method for the equation of this run")])

    def _scales(self) -> Array:
        """Return the scales (l,) of the dead bands, within which errors of the invariants are not corrected.

        Invariants that are functions of C y alone, where C is the matrix of the linear invariants, get scales so large
        that their errors stay within the dead bands. Corrections, which leave C y unchanged, could not reduce these
        errors. The gradients are examined at two states, because a gradient may be a combination of rows of C by
        chance.
        """
        (t0, y0, f0, tau), linear, invariants, G = self.begin, self.options.frame, self.invariants, self.work.G
        held = are_combinations(linear, G.view(float))
        if not np.count_nonzero(held):
            return self.options.scales
        (away,) = states_near(y0, np.abs(y0) + tau * np.abs(f0), (COMBINATION_DISTANCE,))
        held &= are_combinations(linear, invariants.gradients(t0, away, f0).view(float))
        return np.where(held, invariants.sizes_of_terms(y0, G, self.work.values) / EPS, self.options.scales)

    def _projected_start(self) -> Array:
        """Return the start projected onto the targets, by full Newton steps in the euclidean metric."""
        t0, y0, f0, _ = self.begin
        options = self.options._replace(
            metric=data.EUCLIDEAN, direction=data.NEW, iterations=START_ITERATIONS, compensated=False, watched=False,
            limit=np.inf,
        )  # fmt: skip
        work = new_work(y0.size, y0.dtype, 0, self.invariants.size, options.blocks.start.size - 1)
        work.K[-1] = f0
        y = self.projected(t0, y0, options, work)
        if self.invariants.misses(t0, y, f0).any():
            raise ValueError(projection_failure(self.invariants, work, t0))
        return y

    def __getstate__(self) -> dict[str, Any]:
        """Return the values and arrays from which a copy continues with the same bits, after `restore`."""
        kept = {name: value for name, value in vars(self).items() if name not in RESTORED}
        if self.method.in_python:
            kept["stepper"] = self.stepper.state() if self.method.drives else None
        of_copy = {"joint": self.options.joint is not None, "velocities": getattr(self.method, "velocities", None)}
        return kept | {"options": self.options._replace(joint=None), "of_copy": of_copy | {"tau": self.invariants.tau}}

    def restore(self, given: Method) -> None:
        """Make again what a copy of a run by the method `given` lacks."""
        own = vars(self).pop("of_copy")
        self.method = given
        if given.has_history:
            self.method = replace(cast(Any, given), velocities=own["velocities"])
        self.invariants = found = self._invariants_at(self.begin)
        found.tau, found.kinds, found.target = own["tau"], self.options.kinds, self.options.target
        if own["joint"]:
            self.options = self.options._replace(joint=found.items)
        self.trust.figures = self.work.trust
        if given.in_python:
            state, self.stepper = self.stepper, given.for_engine()
            if given.drives:
                given.begin(self, self.begin)
                self.stepper.resume(state)

    def engine(self, functions: PythonFunctions | NativeFunctions, *, begins: bool = True) -> Engine:
        """Return the engine of the run, which it `begins` or continues; work.K[0] must hold the derivative there."""
        hooks, joint, w = None, None if functions.native else self.options.joint, self.work
        if joint is not None or self.method.in_python:
            hooks = self.method.hooks(self.stepper, w)._replace(joint=joint)
        engine = Engine(self.stepper, self.options, w, functions, self.schedule, hooks)
        if self.options.watched and begins:
            t, f = self.schedule.span.t0, w.K[0]
            if self.start is not self.begin:  # the buffers have the values and gradients at `begin`
                w.values[:], w.G[:] = self.invariants.values(t, self.y0), self.invariants.gradients(t, self.y0, f)
            engine.start(self.y0, f, self.start.tau)
        return engine

    def projected(self, t: float, y: Array, options: Any, work: Work) -> Array:
        """Return the projection of a state, or raise ValueError; work.K[-1] must hold the derivative there."""
        derivative = Call(self.problem.derivative, (), y.shape, lambda value, t: np.array(value, y.dtype))
        functions = PythonFunctions(derivative, *self.invariants.calls, (), second_order=False)
        engine = Engine(data.NO_METHOD, options._replace(joint=None, balances=data.NO_BALANCES), work, functions)
        work.y_hat[:], out = y, np.empty_like(y)
        if engine.project(t, y, t, True, out) != 0:
            raise ValueError(projection_failure(self.invariants, work, t))
        return out

    def attach(self, diagnostics: Any) -> None:
        """Let `diagnostics` read the run's buffers."""
        if not isinstance(diagnostics, Diagnostics):
            raise TypeError(f"diagnostics must be a Diagnostics() object, got {diagnostics!r}.")
        self.diagnostics, w = diagnostics, self.work
        diagnostics._attach(
            max_residual=w.max_residual,
            _residual=w.residual,
            _max_correction=w.max_correction,
            _counters=w.counters,
            _trust=self.trust,
            _estimated=self.options.metric == data.BY_ERROR,
            moved=self.moved,
            _remarks=self.conserved.remarks,
            _found_rows=self.found_rows.get("frame"),
            _from_f=listed([self.invariants.names[k] for k in self.conserved.rows_from_f]),
            _slow=(self.invariants.balances.places, w.slow),
        )

    @property
    def shows(self) -> bool:
        """Return True if some steps may stay unprojected; the run then returns projected copies of their states."""
        return self.invariants.size > 0 and (self.options.every != 1 or self.method.has_history)

    def look(self, steps: int, ended: bool, t: float, y: Array) -> bool:
        """Examine a run after `steps` steps, or at its end (`ended`), and return True if it must be reported as faulty.

        Steps that the engine has marked as suspicious are examined. The invariants are checked after 10, 100, 1000, ...
        steps, at the end, and if the corrections are too large, to find the reason.
        """
        return bool(BUILD.call(self._look, steps, ended, t, y))

    def _look(self, steps: int, ended: bool, t: float, y: Array) -> bool:
        rhs, suspect, trust = self.problem.derivative, self.work.suspect, self.trust
        if trust.failed or not self.options.watched:  # a failure has its own message
            return False
        if ended and self.invariants.balances.items and (text := self._fast_balances()):
            warnings.warn(text, UserWarning, stacklevel=users_level())
        if is_due := ended or is_check_due(steps):
            self._drop_refuted_rows(t, y, rhs)
        found, is_flagged = None, suspect[REASON] != NOTHING
        if not trust.doubts:
            found = self.examiner.examine(suspect, rhs) if is_flagged else None
            if found is None and ((is_due and steps != self.looked) or trust.is_doubtful(ended)):
                self.looked = steps
                found = self.examiner.finding(rhs, t, y)
        elif is_flagged and not self.work.trust[:, data.EXAMINED].any():
            self.examiner.examine(suspect, rhs)  # once more for the rates, which are used to judge corrections
        trust.doubts += [found] if found else []
        return found is not None or trust.is_doubtful(ended)

    def slowed(self, steps: int, t: float, y: Array) -> str:
        """Return a sentence if the projections of a faulty run make its adaptive steps much shorter; else "".

        After 100, 1000, ... steps, which led to (t, y), some are made from there without projections, for comparison.
        """
        faulty = self.trust.doubts and self.options.adaptive and not self.method.in_python and self.trust.is_doubtful()
        if not faulty or steps < LEAST_STEPS or not is_check_due(steps):
            return ""
        problem, span = self.problem, self.stepping.span
        count, stepping = problem.count, self.stepping._replace(span=span._replace(t0=t), first_step=None)
        free = Run(problem, self.name, self.method, stepping, ProjectionOptions(check=False))
        free.start_at(y, check=False, is_known=True)
        free.work.K[0], free.schedule = free.start.f, bare_schedule(stepping.span, free.start.tau)
        free.schedule.place[PENDING] = 1  # steps are made one by one
        engine, here = free.engine(problem.in_python(free)._replace(event=())), (OK, t, y, free.start.f)
        for k in range(FREE_STEPS):
            if here[0] == OK:
                here = engine.step(k, *here[1:])
        problem.count = count
        longer = abs(here[1] - t) / FREE_STEPS / (abs(t - self.begin.t) / steps)
        if here[0] != OK or not longer > SLOWED:
            return ""
        return f"its projections make the steps {longer:.3g} times shorter than the equations need, and it was ended"

    def _fast_balances(self) -> str:
        """Return a text about balances that change too fast to be useful; "" without any, or after the first one."""
        balances = self.invariants.balances
        if self._warned_of_balances:
            return ""
        found = slowness(self.work.slow)
        fast = np.flatnonzero(found > balances.most_slowness)
        if not fast.size:
            return ""
        self._warned_of_balances = True
        names = [self.invariants.names[place] for place in balances.places[fast]]
        bound = balances.most_slowness[fast[0]]
        return (
            f"balance {listed(names)} changes too fast to be of much use: on average its rate is "
            f"{found[fast].max():.2g} of the sum of the absolute values of the terms of grad @ f (the largest of "
            f"Diagnostics.slowness). Above {bound:g} a balance hardly improves the result. Compare with a run without "
            "it, or with other tolerances."
        )

    def _drop_refuted_rows(self, t: float, y: Array, rhs: Derivative) -> None:
        """Let corrections change the linear invariants that were found at the start if one does not hold at y.

        The engine goes on with rows of zeros.
        """
        linear, state = self.conserved.linear, self.tangents.state(y)
        if len(linear.C) and not confirmed(state[None], self.tangents.state(rhs(t, y))[None], linear).all():
            for array in self.found_rows.values():
                array.fill(0.0)

    @property
    def found_rows(self) -> dict[str, Array]:
        """Return by name the arrays of the linear invariants that were found; empty if there are none."""
        frame = self.options.frame
        return {"frame": frame.value, "bodies": frame.bodies} if len(self.conserved.linear.C) else {}

    @cached_property
    def examiner(self) -> Examiner:
        """Return the `Examiner` of the run's steps and states."""
        resolution = partial(unresolved, self.stepper, self.options.blocks)
        return Examiner(self.invariants, self.invariants.tau, self.work.trust, resolution)


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
