"""`integrate`: long runs with the compiled step, or with the same step interpreted."""

from __future__ import annotations

import math
import os
import time
import warnings
from collections.abc import Callable
from contextlib import nullcontext, suppress
from copy import copy
from typing import Any, Unpack

import numpy as np

from ..core.callers import users_level
from ..core.event_derivatives import event_derivatives
from ..core.examination import is_check_due, steps_to_check
from ..core.failures import failure
from ..core.functions import PointerFunction, is_compiled, is_jitted
from ..core.names import nearest
from ..core.problem import Problem
from ..core.projection import ProjectionKeywords, ProjectionOptions, takes_projection_options
from ..core.results import Diagnostics
from ..core.runs import Run
from ..core.solvers import EIPSolver
from ..core.step_control import UNBOUNDED
from ..core.tangent_vectors import StateSolution
from ..engine.data import ENDED, FULL, NFEV, NJEV, NLU, NOTHING, OK, PAUSE, REASON, ROW, START, TIME
from ..engine.trust import ProjectionWarning
from . import resume as _resume
from .driver import Driver, expected_steps
from .origin import Origin
from .prepare import DEFAULT, RunArguments, identity, prepared, started_at
from .results import IntegrationResult, described

__all__ = ["STOPPED", "integrate", "progress_bar", "used_up"]

CHUNK_SECONDS = 0.2
FIRST_CHUNK = 64
# Run time in seconds after which compiling the invariants is suggested.
SLOW_SECONDS = 2.0
ARRIVED, STOPPED = "reached the end of the interval", "stopped by the callback"
ENDED_BY_EVENT = "A termination event occurred."
COMPILING = {"desc": "compiling the functions", "total": 0, "bar_format": "{desc}", "leave": False}


@takes_projection_options
def integrate(
    fun: Callable[..., Any] | Problem | None = None,
    t_span: Any = None,
    y0: Any = None,
    *,
    acceleration: Any = None,
    method: type[EIPSolver] | None = None,
    h: float | None = DEFAULT,
    args: Any = None,
    params: Any = None,
    in_place: bool = False,
    jacobian: Any = None,
    jac: Any = None,
    variations: Any = None,
    jvp: Any = None,
    symplectic: bool | None = None,
    save_every: int | None = None,
    t_eval: Any = None,
    events: Any = None,
    dense_output: bool = False,
    callback: Callable[[float, np.ndarray, np.ndarray], Any] | None = None,
    progress: bool = False,
    compiled: bool | None = None,
    max_bytes: float | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    checkpoint_every: float = 60.0,
    resume: bool = False,
    diagnostics: Diagnostics | None = None,
    rtol: Any = DEFAULT,
    atol: Any = DEFAULT,
    first_step: float | None = None,
    max_step: float = np.inf,
    max_steps: int | None = None,
    **projection: Unpack[ProjectionKeywords],
) -> IntegrationResult:
    """Integrate with fixed or adaptive steps, compiled if the functions are Numba functions.

    The solver classes take the same steps. Results agree to rounding, whether the functions are compiled or not. The
    parameters below come in groups:

    - the problem: `fun` to `jac`;
    - the method and its steps: `method`, `h`, `rtol`, `atol`, `first_step`, `max_step`, `max_steps`;
    - the invariants and their projection: `invariants` and the options after it;
    - derivatives of the solution: `variations`, `jvp`, `symplectic`;
    - what is saved, and events: `save_every` to `events`;
    - the course of the run: `callback`, `progress`, `compiled`, `max_bytes`;
    - checkpoints: `checkpoint` to `resume`.

    Parameters
    ----------
    fun : callable or Problem
        ``fun(t, y[, params]) -> (n,)``; with ``in_place=True``, ``fun(t, y, out[, params])``. For a compiled run a
        lazily jitted Numba function, or a C function as `scipy.LowLevelCallable`,
        ``int fun(double t, const double *y, double *out, const double *params)``, see
        :doc:`/tutorials/compiled-functions`. With a Nystrom method (`EIPRKN8`, `EIPRKN12`) or a multistep one
        (`EIPGJ12`, `EIPGJ14`), whose state is (q, v), ``fun`` must return (v, a); give `acceleration` instead to
        write only a. A `Problem` contains everything else; options given here take precedence.
    acceleration : callable, optional
        Instead of `fun`, for q'' = a(t, q) with the state (q, v) and any method: ``acceleration(t, q[, params]) ->
        (n/2,)``, and otherwise as `fun`. Accelerations that depend on velocities belong in `fun`.
    t_span : (float, float)
        Start and end; time runs backward if the end is before the start. `eip_scipy.integrations.astropy` converts
        quantities and dates.
    y0 : array_like, shape (n,)
        Initial state, real or complex.
    args : tuple, optional
        As in `scipy.integrate.solve_ivp`: passed on as the last arguments, to `fun`, events, `jacobian` and `jac`, and
        to the invariants' functions behind their own. Numbers reach Numba functions as such (a float, an int, a bool)
        and C functions as `params`; a single array of floats is the same as ``params``. With any other arguments the
        functions are called from Python.
    params : array_like of float, optional
        Instead of `args`: one array of floats, passed on as the last argument. A problem that names its parameters
        (`hamiltonian`, `equations`) also accepts a mapping of the parameters that change.
    in_place : bool, optional
        Whether `fun`, or `acceleration`, fills its third argument.
    jacobian : callable, optional
        For a multistep method that takes it (`EIPGJ14`): ``jacobian(t, q, dq, out[, params])`` fills `out` with the
        derivative of the accelerations along dq, a Numba or C function for a compiled run. A problem may have its own.
    jac : callable or array_like, shape (n, n), optional
        For `EIPRadau` and `EIPBDF`, as for SciPy's Radau and BDF: ``jac(t, y[, params]) -> (n, n)``, the matrix of the
        derivatives of `fun`, dense or sparse, or a constant matrix.
    method : type, optional
        `EIPRK1` ... `EIPRK5`, `EIPRK23`, `EIPRK45`, `EIPDOP853`, `EIPRKN8`, `EIPRKN12`, `EIPGJ12`, `EIPGJ14`,
        `EIPRadau`, `EIPBDF`, or a class made by `eip_method`. `EIPRadau`, `EIPBDF` and classes made from a one-step
        method run interpreted. Default: the method of the problem, if it has one.
    h : float, optional
        Length of the steps, > 0; the last step ends at the end of `t_span` and may be shorter. None: adaptive steps
        controlled by `rtol`, `atol`, `first_step` and `max_step`. Default: adaptive if one of these is given, else the
        step of the problem, if it has one.
    diagnostics, first_step, max_step, rtol, atol
        As for the solver classes; `rtol` and `atol` are 1e-3 and 1e-6 by default. If `h` is given, they only scale the
        error metric.
    max_steps : int, optional
        Largest number of steps; a run that needs more ends with status -1, and keeps what it has. A faulty run with
        adaptive steps also ends early if its projections make the steps much shorter than the equations need.
    {names of ProjectionOptions}
        As for the solver classes, see `EIPSolver`. Functions of invariants are called as
        ``fun(t, y, *args[, params])``; an invariant whose only argument equals `params` is called with the `params` of
        the run instead.
    variations : str, int, sequence of these or array_like, shape (n, k), optional
        Derivatives of the state that are integrated with it by an explicit method, and projected, except by multistep
        methods, so that they are consistent with the invariants. ``"state"``: with respect to the initial state, the
        state-transition matrix ``run.stm``. Names or indices of parameters: ``run.sensitivities``; a list combines
        several of these. An array: columns with these initial values, ``run.variations``. With events also
        ``run.time_derivatives`` and ``run.state_derivatives``. Products with the Jacobian come from the problem, from
        dual numbers if the functions are jitted, from `jvp`, or else from complex steps. See
        :doc:`/how-to/tangent-maps`.
    jvp : callable, optional
        ``jvp(t, y, dy[, params]) -> (n,)``: the Jacobian of `fun` times dy, for `variations`. Or a C function by
        pointer, ``int jvp(double t, const double *y, const double *dy, double *out, const double *params)``.
    symplectic : bool, optional
        If True, a state-transition matrix is kept symplectic, for states (q, p) of a Hamiltonian system. Default: True
        if the problem is known to be such a system.
    save_every : int, optional
        Save every `save_every`-th step, in addition to the first and the last state.
    t_eval : array_like, optional
        Times at which states are saved, inside `t_span` and in its direction; not together with `save_every`. States
        between steps come from dense output and are projected. Without `save_every` and `t_eval`, the first and the
        last state are saved.
    dense_output : bool, optional
        If True, store the interpolants of all steps as ``.sol``, a function of time; not available with a checkpoint.
    events : callable or sequence of callable, optional
        ``event(t, y[, params]) -> float``, or ``event(t, y, *args)``, with ``terminal`` and ``direction`` as for
        `scipy.integrate.solve_ivp`; Numba functions or C functions, or Python functions, which are called from Python
        even if `fun` is native. An event does not happen where its value is NaN, and not at the start if it is zero
        there to rounding. An event with an infinite ``direction`` is a limit: it also happens at a start beyond it.
    callback : callable, optional
        ``callback(t, y, residuals)``, called at each saved point with the invariant errors `residuals`; return True to
        stop the run. With `save_every` the interval may then be infinite, as with a terminal event.
    progress : bool, optional
        Show a progress bar with the remaining time.
    compiled : bool, optional
        None: compiled if possible, else interpreted, with the reason in ``.message``. True: TypeError if a function
        cannot be compiled. False: interpreted.
    max_bytes : float, optional
        Bound on the memory for saved states; default: half of the free memory.
    checkpoint : path-like, optional
        File that stores the run, including the saved states, so that it can be resumed. It is written at the start,
        every `checkpoint_every` seconds, and when the run ends or is interrupted, also by SIGTERM, which raises
        KeyboardInterrupt in the main thread unless the user has installed a handler. An existing file is replaced only
        by the run that resumes it, and only one run at a time may use it.
    checkpoint_every : float, optional
        Seconds from one checkpoint to the next; longer if writing would take more than 5 % of the time.
    resume : bool, optional
        Continue from the checkpoint, with the same arguments: the result agrees bit by bit with that of an
        uninterrupted run. If the file does not exist, the run starts at the beginning. The `message` of
        the result says which of the two happened.

    Returns
    -------
    IntegrationResult
        Times ``t`` (m,), states ``y`` (n, m), values ``invariants`` (l, m), ``max_residual`` (l,), and more.

    Raises
    ------
    TypeError
        Unknown options, values of a wrong type, or ``compiled=True`` with functions that cannot be compiled.
    ValueError
        Options with wrong values, an initial state that misses a given target, or a wrong gradient.
    MemoryError
        If the saved states would need more than `max_bytes`.
    CheckpointError
        If the file cannot be written at the start, exists without ``resume=True``, is damaged or used by another run,
        or belongs to one with other arguments or functions.

    See Also
    --------
    solve_ivp, ensemble, recommend, eip_scipy.results.IntegrationResult

    Notes
    -----
    A step that fails ends the run with ``status=-1``; the result holds everything up to that step. Exceptions raised by
    the user's functions and KeyboardInterrupt propagate. Their attribute ``partial`` is the result up to that point
    (one row, the initial state, before the first step), and a note says where the checkpoint continues. If a later
    checkpoint cannot be written, a RuntimeWarning says so, `message` repeats it, and the previous checkpoint is kept.

    The user's functions may store or overwrite the states that they receive: functions that do so receive copies.

    References
    ----------
    .. [1] W. Cai, Y. Gong, Y. Wang, "An explicit and practically invariants-preserving method for conservative
       systems".

    Examples
    --------
    >>> from eip_scipy import EIPRK4, integrate
    >>> from eip_scipy.problems import kepler
    >>> run = integrate(kepler(), (0, 200), method=EIPRK4, h=0.03, save_every=100)
    >>> run.y.shape, bool((run.max_residual < 1e-11).all())
    ((4, 68), True)
    """
    asked = locals()  # the fields of RunArguments have the same names and defaults
    known = ProjectionOptions.names()
    for name in projection:
        if name not in known:
            others = [*asked.keys() - {"projection"}, *known]
            raise TypeError(f"integrate() has no option {name!r}{nearest(name, others)}")
    request = RunArguments(*map(asked.__getitem__, RunArguments._fields))
    opened = _resume.opened(checkpoint, checkpoint_every, resume, dense_output)
    begin = time.perf_counter()
    with opened as keeper:
        try:
            functions = fun, acceleration, getattr(fun, "rhs", None)
            compiles = compiled is not False and any(map(is_jitted, functions))
            with progress_bar(progress is True and compiles, lambda: COMPILING):
                loop = Loop(prepared(request), request, keeper)
            return loop.run()
        except BaseException as error:
            if not hasattr(error, "partial"):
                _attach_start(error, request, time.perf_counter() - begin)
            raise


class Loop:
    """A run in chunks of steps, with a progress bar, states at `t_eval`, events, callbacks, and checkpoints.

    `why_not` is the reason why not all functions are called natively, or None.
    """

    def __init__(self, run: Run, given: RunArguments, keeper: _resume.Checkpointer | None = None) -> None:
        problem = run.problem
        self.given, self.keeper, self.events = given, keeper, problem.events
        if keeper is not None and run.method.drives:
            raise ValueError(
                f"checkpoint: a file cannot store the internal state of SciPy's {run.method.name}, which resuming "
                "needs. Omit checkpoint, or save the last state of a run and start another run from it."
            )
        functions, self.why_not = problem.functions(run, given.compiled)
        self.driver = Driver(run, functions, keeps_steps=given.dense_output, max_bytes=given.max_bytes)
        if keeper is not None:
            own = identity(run, run.begin.y, problem.parameters)
            keeper.begin(self.driver, own, problem.derivative, self.events)
        self._chunk, self._seconds, self._begin = FIRST_CHUNK, 0.0, 0.0
        self._doubtful = self._event_ended = self._ended_early = False
        self.remarks: list[str] = []  # on derivatives at events
        self._most_steps = UNBOUNDED if given.max_steps is None else given.max_steps

    def run(self) -> IntegrationResult:
        """Run to the end, and return the result; an exception gets it as its attribute `partial`."""
        driver, keeper, result = self.driver, self.keeper, None
        self._begin = time.perf_counter() - (0.0 if keeper is None else keeper.seconds)
        try:
            with progress_bar(self.given.progress, self._shown_by_bar) as bar:
                status, message = self.steps(bar)
            if keeper is not None:
                keeper.end(status, message)
            result = self._result(status, message)
            if self._doubtful and (status >= 0 or self._ended_early):
                text = f"{driver.run.name}: {driver.run.trust.message}"
                warnings.warn(text, ProjectionWarning, stacklevel=users_level())
        except BaseException as error:
            if result is None:
                if keeper is not None:
                    keeper.interrupted(error)  # first, because a batch system may kill the process soon after SIGTERM
                driver.run.trust.failed = True
                result = self._result(-1, f"interrupted by {type(error).__name__}", broken=True)
            error.partial = result  # type: ignore[attr-defined]
            raise
        return result

    def steps(self, bar: Any = None) -> tuple[int, str]:
        """Run until something ends the run, check the run, and return status and message."""
        status, message = self._steps(bar)
        self.driver.run.trust.failed = status < 0
        self._check(ended=True)
        return status, message

    def _check(self, *, ended: bool = False) -> None:
        t, y = self.driver.now
        self._doubtful |= self.driver.run.look(self.driver.step, ended, t, y.copy())

    def _steps(self, bar: Any) -> tuple[int, str]:
        driver, schedule, step = self.driver, self.driver.schedule, self.driver.step
        if step == 0:
            t0, times = schedule.span.t0, schedule.t_eval
            if driver.rows == 0 and (times.size == 0 or times[0] == t0):
                driver.save(t0, driver.state)
            if self._stopped_by_callback(0):
                return 1, STOPPED
        while True:
            if step >= self._most_steps and driver.now[0] != schedule.span.t_bound:
                if self.keeper is not None:
                    self.keeper.take_snapshot()
                return -1, used_up(self._most_steps, driver.now[0])
            if self.keeper is not None:
                self.keeper.keep()
            rows, steps, begin = driver.rows, self._next_steps(step), time.perf_counter()
            code = driver.advance(step + steps)
            seconds, step = time.perf_counter() - begin, driver.step
            driver.warn()
            self._seconds += seconds
            if self._seconds > SLOW_SECONDS:
                self._warn_of_interpreted_invariants()
            self._event_ended = self._pause() if code == PAUSE else code == ENDED
            if self._event_ended and schedule.t_eval.size == 0:
                driver.cut(*self.events.last)
            if bar is not None:
                bar.update(self._progress() - bar.n)
            if self._stopped_by_callback(rows):
                return 1, STOPPED
            if self._event_ended:
                return 1, ENDED_BY_EVENT
            if code not in (OK, PAUSE, FULL):
                return -1, failure(code, driver.run, schedule.clock)
            if is_check_due(step) or driver.run.work.suspect[REASON] != NOTHING:
                self._check()
                if self._doubtful and (slowed := driver.run.slowed(step, *driver.now)):
                    self._ended_early = True
                    return -1, slowed
            if code == FULL:
                driver.grow()
            elif code == OK and schedule.clock[TIME] == schedule.span.t_bound:
                return 0, ARRIVED
            elif code == OK:
                # At most ten times as many, so that one fast chunk cannot make a slow one long.
                longer = max(self._chunk, 10 * steps)
                self._chunk = max(1, min(longer, int(steps * CHUNK_SECONDS / max(seconds, 1e-9))))

    def _next_steps(self, step: int) -> int:
        """Return the number of steps to make after `step`: at most `_chunk`, and none beyond the next check of the run.

        With a callback, no step goes beyond the next state that is saved. Near the end of a multistep run it is instead
        the number of all remaining steps, because each of the last states that is requested costs a step of the
        starting method.
        """
        driver, schedule, span = self.driver, self.driver.schedule, self.driver.schedule.span
        history, left = driver.run.stepper.multistep, span.n_steps - step
        chunk = left if history is not None and left - history.middle <= self._chunk else self._chunk
        chunk = max(1, min(chunk, steps_to_check(step), self._most_steps - step))
        if self.given.callback is None:
            return chunk
        if schedule.t_eval.size:
            times = schedule.t_eval[driver.rows :]
            known = span.h != 0.0 and times.size  # adaptive steps are made one by one
            return max(1, min(chunk, int(abs((times[0] - driver.now[0]) / span.h)))) if known else 1
        return min(chunk, schedule.save_every - step % schedule.save_every) if schedule.save_every else chunk

    def _warn_of_interpreted_invariants(self) -> None:
        """Warn once if only the invariants prevent a slow run from being compiled."""
        self._seconds, run = -math.inf, self.driver.run
        if self.given.compiled is not None or self.driver.functions.native or not is_jitted(run.problem.fun):
            return
        functions = [function for item in run.invariants.items for function in (item.function, item.gradient)]
        if not all(is_compiled(function) or isinstance(function, PointerFunction) for function in functions):
            warnings.warn(
                f"{run.name}: fun is jitted, and the run could be many times faster, but it is {self.why_not}. "
                "Compile the functions of the invariants with numba.njit, or pass compiled=False if this is intended.",
                UserWarning,
                stacklevel=users_level(),
            )

    def _pause(self) -> bool:
        """Save states at `t_eval` and record events in a step that has paused; return True if one ends the run."""
        driver, schedule = self.driver, self.driver.schedule
        sol, (which, times) = driver.dense(), driver.interpolants.pending()
        end = self.events.handle(which, times, sol)
        limit = sol.t if end is None else end
        while driver.rows < schedule.t_eval.size and schedule.span.sign * (schedule.t_eval[driver.rows] - limit) <= 0:
            t = float(schedule.t_eval[driver.rows])
            driver.save(t, sol(t))
        return end is not None

    def _stopped_by_callback(self, first_row: int) -> bool:
        driver, invariants, tangents = self.driver, self.driver.run.invariants, self.driver.run.tangents
        for row in range(first_row, driver.rows) if self.given.callback is not None else ():
            t, y = float(driver.t[row]), driver.y[row].copy()
            if self.given.callback(t, tangents.state(y), invariants.values(t, y) - invariants.fixed_target):
                driver.schedule.place[ROW] = row + 1
                return True
        return False

    def _progress(self) -> float:
        """Return the number of steps made, or the length of the interval done by adaptive steps."""
        span = self.driver.schedule.span
        return self.driver.step if span.h != 0.0 else abs(self.driver.now[0] - span.t0)

    def _shown_by_bar(self) -> dict[str, Any]:
        """Return the options of the progress bar; `initial` is above 0 if the run is resumed."""
        span, unit = self.driver.schedule.span, "step"
        total: float | None = expected_steps(self.driver.schedule) or None
        if span.h == 0.0:
            total, unit = abs(span.t_bound - span.t0) if math.isfinite(span.t_bound) else None, "time"
        shown = {"total": total, "unit": unit, "initial": self._progress(), "unit_scale": True, "smoothing": 0.05}
        return {"desc": self.driver.run.name, **shown}

    def _result(self, status: int, message: str, *, broken: bool = False) -> IntegrationResult:
        """Return the result at the end of a run; if it is `broken`, invariants whose functions fail again are NaN."""
        driver, run, events = self.driver, self.driver.run, self.events
        if status < 0:
            driver.save_now()
        try:
            values = driver.values()
        except BaseException:
            if not broken:
                raise
            values = np.full((driver.rows, run.invariants.size), np.nan)
        rows, target = len(values), run.invariants.fixed_target
        driver.note(values, target)
        at_events, self.remarks = event_derivatives(run.problem, driver.schedule.span.t0, events.t, events.y)
        notes = self.notes()
        t, y = events.last if self._event_ended else driver.now
        sol, asked, kept = driver.solution(t), self.given, run.invariants.with_targets
        variations = run.problem.variations
        if variations is not None:
            sol = None if sol is None else StateSolution(sol, run.tangents)
            asked = asked._replace(variations=run.tangents.restarted(y))
        result = assembled(
            run,
            driver.y[:rows],
            (events.t, events.y) if events.functions else None,
            run.work.counters,
            run.problem.parameters,
            t=driver.t[:rows],
            invariants=values.T,
            target=target,
            max_residual=run.work.max_residual,
            diagnostics=run.diagnostics,
            sol=sol,
            status=status,
            message=described(message, run.diagnostics, notes),
            success=status >= 0,
            trusted=run.trust.trusted,
            wall_time=time.perf_counter() - self._begin,
            compiled=self.why_not is None,
            calls=run.problem.calls(run, driver.functions),
            h=abs(driver.schedule.span.h) or None,
            **at_events,
        )
        last, values_at, at_end = (np.array([t]), y[None].copy()), driver.values_at, not self._event_ended
        arguments = {**asked._asdict(), **asked.projection, "params": copy(asked.params)}  # the user may change it
        del arguments["projection"]
        saved = rows > 0 and driver.t[rows - 1] == t and np.array_equal(driver.y[rows - 1], y)
        origin = Origin(
            arguments, t, run.tangents.state(y.copy()), driver.schedule.span.sign, tuple(run.invariants.names),
            terms=np.where(np.isnan(target), np.inf, run.trust.figures[:, START]),  # balances have no target
            before=values[-1].copy() if saved else None,
            event=events.last_index if self._event_ended else None,
            kept=lambda: kept(at_end=at_end) if variations is None else variations.with_targets(kept(at_end=at_end)),
            values=lambda: values_at(*last)[0],
            derivative=lambda: run.tangents.state(run.problem.derivative(t, last[1][0])),
            ended=message, notes=notes,
        )  # fmt: skip
        object.__setattr__(result, "_origin", origin)  # not a field: fields are items of the result
        return result

    def notes(self) -> tuple[str, ...]:
        """Return notes on checkpoints, functions that were not compiled and gradients by differences."""
        run = self.driver.run
        notes = [*(() if self.keeper is None else self.keeper.notes), self.why_not]
        if labels := run.invariants.by_differences:
            names = ", ".join(map(repr, labels))
            notes.append(
                f"the gradient of {names} is computed by differences: a function for it would be faster and exact"
            )
        return tuple(str(note) for note in (*notes, run.conserved.missing, *self.remarks) if note is not None)


def assembled(
    run: Run, y: np.ndarray, events: Any, counters: np.ndarray, params: np.ndarray, **fields: Any
) -> IntegrationResult:
    """Return a result with the given `fields` and those that follow from the `run`.

    `y` (m, n) are the saved states, with the tangent vectors that follow them, and `events` the times and states of
    each event; None without events. `counters` are those of the engine, and `params` the parameters.
    """
    problem, tangents = run.problem.problem, run.tangents
    result = IntegrationResult(
        fields,
        y=tangents.state(y).T,
        t_events=None if events is None else [np.asarray(t) for t in events[0]],
        y_events=None if events is None else [tangents.state(np.asarray(states)) for states in events[1]],
        nfev=int(counters[NFEV]),
        njev=int(counters[NJEV]),
        nlu=int(counters[NLU]),
        method=run.name,
        component_names=run.problem.component_names,
        restarts=[],
        units="" if problem is None else problem.units,
        epoch=None if problem is None else problem.epoch,
    )
    if events is not None:
        result |= at_events(run, result.t_events, result.y_events, params)
    if run.problem.variations is not None:
        result["variations"] = tangents.split(y)[1]
        result["columns"] = run.problem.described_columns
    return result


def at_events(run: Run, times: Any, states: Any, params: np.ndarray) -> dict[str, Any]:
    """Return the fields that the problem of a run computes from the times and states of each event."""
    problem, functions = run.problem.problem, run.problem.events.functions
    own = [getattr(getattr(function, "unaugmented", None), "function", function) for function in functions]
    return {} if problem is None else problem.at_events(own, times, states, params)


def used_up(most_steps: int, t: float) -> str:
    """Return the reason for the end of a run at t that has made `most_steps` steps, its option `max_steps`."""
    return f"max_steps={most_steps} steps were made, up to t={t:.10g}"


def progress_bar(shown: bool, options: Callable[[], dict[str, Any]]) -> Any:
    """Return a context manager that yields a progress bar with these options of tqdm, or None if it is not `shown`."""
    if not shown:
        return nullcontext()
    from tqdm import tqdm

    return tqdm(**options())


def _attach_start(error: BaseException, request: RunArguments, seconds: float) -> None:
    """Attach a result with the initial state as `partial` to an exception in the preparation of a run."""
    nothing = np.zeros((0, 1))
    with suppress(TypeError, ValueError):  # the initial state itself cannot be read
        t0, start = started_at(request)
        error.partial = IntegrationResult(  # type: ignore[attr-defined]
            dict.fromkeys(("t_events", "y_events", "sol", "h", "component_names", "epoch")),
            **dict.fromkeys(("nfev", "njev", "nlu"), 0),
            **dict.fromkeys(("success", "trusted", "compiled"), False),
            **{"t": np.array([t0]), "y": start[:, None], "invariants": nothing, "target": nothing[:, 0]},
            **{"max_residual": nothing[:, 0], "diagnostics": Diagnostics(), "calls": {}, "units": "", "restarts": []},
            **{"status": -1, "message": f"interrupted by {type(error).__name__} at the start", "wall_time": seconds},
            method=getattr(request.method, "__name__", str(request.method)),
        )
