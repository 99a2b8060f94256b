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
from ..core.examination import is_check_due, steps_to_check
from ..core.failures import failure
from ..core.functions import PointerFunction, is_compiled, is_jitted
from ..core.invariants import Invariant
from ..core.names import nearest
from ..core.problem import Problem
from ..core.projection import ProjectionKeywords, ProjectionOptions, takes_projection_options
from ..core.results import Diagnostics
from ..core.runs import Run
from ..core.solvers import EIPSolver
from ..core.step_control import UNBOUNDED
from ..core.tangent_vectors import StateSolution
from ..engine.data import ENDED, FULL, NFEV, NJEV, NLU, OK, PAUSE, ROW, STEP, TIME, Schedule
from ..engine.native import PythonFunctions
from ..engine.trust import ProjectionWarning
from . import resume as _resume
from .driver import Driver
from .prepare import DEFAULT, RunArguments, identity, prepared, started_at
from .results import IntegrationResult, Origin, described

__all__ = ["integrate"]

CHUNK_SECONDS = 0.2
FIRST_CHUNK = 64
# Run time in seconds after which compiling the invariants is suggested.
SLOW_SECONDS = 2.0
ARRIVED, STOPPED = "reached the end of the interval", "stopped by the callback"
ENDED_BY_EVENT = "A termination event occurred."


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
    **projection: Unpack[ProjectionKeywords],
) -> IntegrationResult:
    """Integrate with fixed or adaptive steps, compiled if the functions are Numba functions.

    The solver classes take the same steps. Results agree to rounding, whether the functions are compiled or not.

    Parameters
    ----------
    fun : callable or Problem
        ``fun(t, y[, params]) -> (n,)``; with ``in_place=True``, ``fun(t, y, out[, params])``. For a compiled run a
        lazily jitted Numba function, or a C function as `scipy.LowLevelCallable`,
        ``int fun(double t, const double *y, double *out, const double *params)``, see
        :doc:`/tutorials/c-functions`. With a Nystrom method (`EIPRKN8`, `EIPRKN12`) or a multistep one
        (`EIPGJ12`, `EIPGJ14`), whose state is (q, v), ``fun`` must return (v, a); give `acceleration` instead to
        write only a. A `Problem` contains everything else; options given here take precedence.
    t_span : (float, float)
        Start and end; time runs backward if the end is before the start. `eip_scipy.integrations.astropy` converts
        quantities and dates.
    y0 : array_like, shape (n,)
        Initial state, real or complex.
    acceleration : callable, optional
        Instead of `fun`, for q'' = a(t, q) with the state (q, v) and any method: ``acceleration(t, q[, params]) ->
        (n/2,)``, in place ``acceleration(t, q, out[, params])``; a Python, Numba or C function as for `fun`.
        Accelerations that depend on velocities belong in `fun`.
    method : type, optional
        `EIPRK1` ... `EIPRK5`, `EIPRK23`, `EIPRK45`, `EIPDOP853`, `EIPRKN8`, `EIPRKN12`, `EIPGJ12`, `EIPGJ14`,
        `EIPRadau`, `EIPBDF`, or a class made by `eip_method`. `EIPRadau`, `EIPBDF` and classes made from a one-step
        method run interpreted. Default: the method of the problem, if it has one.
    h : float, optional
        Length of the steps, > 0; the last step ends at the end of `t_span` and may be shorter. None: adaptive steps
        controlled by `rtol`, `atol`, `first_step` and `max_step`. Default: adaptive if one of these is given, else the
        step of the problem, if it has one.
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
    variations : str, int, sequence of these or array_like, shape (n, k), optional
        Derivatives of the state that are integrated with it by a Runge-Kutta method, and projected so that they are
        consistent with the invariants. ``"state"``: with respect to the initial state, the state-transition matrix
        ``run.stm``. Names or indices of parameters: ``run.sensitivities``; a list combines several of these. An array:
        columns with these initial values, ``run.variations``. Products with the Jacobian come from the problem, from
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
    events : callable or sequence of callable, optional
        ``event(t, y[, params]) -> float``, or ``event(t, y, *args)``, with ``terminal`` and ``direction`` as for
        `scipy.integrate.solve_ivp`; Numba functions or C functions, or Python functions, which are called from Python
        even if `fun` is native. An event does not happen where its value is NaN, and not at the start if it is zero
        there to rounding. An event with an infinite ``direction`` is a limit: it also happens at a start beyond it.
    dense_output : bool, optional
        If True, store the interpolants of all steps as ``.sol``, a function of time; not available with a checkpoint.
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
    {names of ProjectionOptions}
        As for the solver classes, see `EIPSolver`. Functions of invariants are called as
        ``fun(t, y, *args[, params])``; an invariant whose only argument equals `params` is called with the `params` of
        the run instead.
    diagnostics, first_step, max_step
        As for the solver classes.
    rtol, atol : float or array_like, optional
        As for the solver classes, 1e-3 and 1e-6 by default. If `h` is given, they only scale the error metric.

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
        If the file cannot be written at the start, exists without ``resume=True``, is damaged, belongs to a run with
        other arguments or functions, or is used by another run.

    Notes
    -----
    A step that fails ends the run with ``status=-1``; the result holds everything up to that step. Exceptions raised by
    the user's functions and KeyboardInterrupt propagate. Their attribute ``partial`` is the result up to that point
    (one row, the initial state, before the first step), and a note says where the checkpoint continues. If a later
    checkpoint cannot be written, a RuntimeWarning says so, `message` repeats it, and the previous checkpoint is kept.

    The user's functions may store or overwrite the states that they receive: functions that do so receive copies.

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
            own = (name for name in RunArguments._fields if name != "projection")
            others = (*own, "checkpoint", "checkpoint_every", "resume", *known)
            raise TypeError(f"integrate() has no option {name!r}{nearest(name, others)}")
    request = RunArguments(*map(asked.__getitem__, RunArguments._fields))
    opened = _resume.opened(checkpoint, checkpoint_every, resume, dense_output)
    begin = time.perf_counter()
    with opened as keeper:
        try:
            return Loop(prepared(request), request, keeper).run()
        except BaseException as error:
            _keep_start(error, request, time.perf_counter() - begin)
            raise


class Loop:
    """A run in chunks of steps, with a progress bar, states at `t_eval`, events, callbacks, and checkpoints.

    An exception raised in `run` gets the result up to that point as its attribute `partial`.
    """

    def __init__(self, run: Run, given: RunArguments, keeper: _resume.Checkpointer | None = None) -> None:
        self.given, self.keeper, self.problem = given, keeper, run.problem
        self.method, self.events, self.diagnostics = run.name, run.problem.events, run.diagnostics
        self.callback, self.progress = given.callback, given.progress
        if keeper is not None and run.method.drives:
            raise ValueError(
                f"checkpoint: a file cannot store the internal state of SciPy's {run.method.name}, which resuming "
                "needs. Omit checkpoint, or save the last state of a run and start another run from it."
            )
        wanted, fun = given.compiled, run.problem.fun
        with _compiling(self.progress and wanted is not False and is_jitted(fun)):
            functions, self.why_not = run.problem.functions(run, wanted)
            self.driver = Driver(run, functions, keeps_steps=given.dense_output, max_bytes=given.max_bytes)
        if keeper is not None:
            own = identity(run, run.begin.y, run.problem.parameters)
            keeper.begin(self.driver, own, run.problem.derivative, self.events)
        self._slowed = wanted is None and _slowed_by_invariants(fun, functions, run)
        self.wall_time = 0.0 if keeper is None else keeper.seconds
        self.chunk = FIRST_CHUNK
        self._seconds = 0.0
        self.is_unreliable = self._doubtful = self._event_ended = False

    def run(self) -> IntegrationResult:
        driver = self.driver
        begin = time.perf_counter()
        try:
            with _bar(self.progress, driver.schedule, self.method) as bar:
                status, message = self.steps(bar)
            if self.keeper is not None:
                self.keeper.end(status, message)
        except BaseException as error:
            self.wall_time += time.perf_counter() - begin
            if self.keeper is not None:
                self.keeper.interrupted(error)  # first, because a batch system may kill the process soon after SIGTERM
            driver.run.trust.failed = True
            driver.save_now()
            partial = self._result(-1, f"interrupted by {type(error).__name__}", broken=True)
            error.partial = partial  # type: ignore[attr-defined]
            raise
        self.wall_time += time.perf_counter() - begin
        if status < 0:
            driver.save_now()
        result = self._result(status, message)
        if self.is_unreliable:
            try:
                warnings.warn(f"{self.method}: {driver.run.trust.message}", ProjectionWarning, stacklevel=users_level())
            except ProjectionWarning as error:
                error.partial = result  # type: ignore[attr-defined]
                raise
        return result

    def steps(self, bar: Any) -> tuple[int, str]:
        """Run until something ends the run; return status and message, and set `is_unreliable`."""
        self._doubtful = False
        status, message = self._steps(bar)
        self.driver.run.trust.failed = status < 0
        self._look(ended=True)
        self.is_unreliable = self._doubtful and status >= 0
        return status, message

    def _look(self, *, ended: bool = False) -> None:
        driver = self.driver
        t, y = driver.now
        self._doubtful |= driver.run.look(driver.step, ended, t, y.copy())

    def _steps(self, bar: Any) -> tuple[int, str]:
        driver, schedule = self.driver, self.driver.schedule
        if driver.step == 0:
            driver.save_start()
            if self._stopped_by_callback(0):
                return 1, STOPPED
        while True:
            if self.keeper is not None:
                self.keeper.keep()
            k, rows, begin = driver.step, driver.rows, time.perf_counter()
            steps = self._chunk(self.chunk)
            code = driver.advance(k + steps)
            seconds = time.perf_counter() - begin
            driver.warn()
            self._warn_if_slow(seconds)
            ended = self._ended(code)
            if schedule.span.h != 0.0:
                bar.update(driver.step - k)
            else:
                bar.update(abs(driver.now[0] - schedule.span.t0) - bar.n)
            if self._stopped_by_callback(rows):
                return 1, STOPPED
            if ended:
                return 1, ENDED_BY_EVENT
            if code not in (OK, PAUSE, ENDED, FULL):
                return -1, failure(code, driver.run, schedule.clock)
            if is_check_due(driver.step) or driver.suspects:
                self._look()
            if code == FULL:
                driver.grow()
            elif code == OK and schedule.clock[TIME] == schedule.span.t_bound:
                return 0, ARRIVED
            if code == OK:
                # At most a doubling, so that one fast chunk cannot make a slow one long; none of one that was cut.
                longer = max(self.chunk, 8 * steps)
                self.chunk = max(1, min(longer, int(steps * CHUNK_SECONDS / max(seconds, 1e-9))))

    def _warn_if_slow(self, seconds: float) -> None:
        """Warn once if only the invariants prevent a slow run from being compiled; `seconds` is the time of a chunk."""
        self._seconds += seconds
        if self._slowed and self._seconds > SLOW_SECONDS:
            self._slowed = False
            warnings.warn(
                f"{self.method}: fun is jitted, and the run could be many times faster, but it is {self.why_not}. "
                "Compile the functions of the invariants with numba.njit, or pass compiled=False if this is intended.",
                UserWarning,
                stacklevel=users_level(),
            )

    def _ended(self, code: int) -> bool:
        """Return True if an event ends the run, by the loop's `code`, and handle a step that has paused."""
        driver, schedule = self.driver, self.driver.schedule
        self._event_ended = self._pause() if code == PAUSE else code == ENDED
        if self._event_ended and schedule.t_eval.size == 0:
            driver.cut(*self.events.last)
        return self._event_ended

    def _pause(self) -> bool:
        """Save states at `t_eval` and record events in a step that has paused; return True if one ends the run."""
        driver, schedule = self.driver, self.driver.schedule
        sol = driver.dense()
        end = self.events.handle(*driver.interpolants.pending(), sol)
        limit = sol.t if end is None else end
        while driver.rows < schedule.t_eval.size and schedule.span.sign * (schedule.t_eval[driver.rows] - limit) <= 0:
            t = float(schedule.t_eval[driver.rows])
            driver.save(t, sol(t))
        return end is not None

    def _chunk(self, chunk: int) -> int:
        """Return the number of steps to make next: at most `chunk`, and none beyond the next check of the run.

        With a callback, no step goes beyond the next state that is saved. Near the end of a multistep run `chunk` is
        replaced by the number of all remaining steps, even if it is larger.
        """
        driver, schedule = self.driver, self.driver.schedule
        history, left = driver.run.stepper.multistep, schedule.span.n_steps - driver.step
        if history is not None and left - history.middle <= chunk:
            chunk = left  # each of the last states that is requested costs a step of the starting method
        chunk = min(chunk, steps_to_check(driver.step))
        if self.callback is None:
            return chunk
        if schedule.t_eval.size:
            return max(1, min(chunk, self._steps_to_next_time()))
        return min(chunk, schedule.save_every - driver.step % schedule.save_every) if schedule.save_every else chunk

    def _steps_to_next_time(self) -> int:
        """Return a number of fixed steps that does not go beyond the next time in `t_eval`; 1 for adaptive steps."""
        driver, schedule = self.driver, self.driver.schedule
        h = abs(schedule.span.h)
        if h == 0.0 or driver.rows == schedule.t_eval.size:
            return 1
        return int(abs(schedule.t_eval[driver.rows] - driver.now[0]) / h)

    def _stopped_by_callback(self, first_row: int) -> bool:
        if self.callback is None:
            return False
        driver = self.driver
        for row in range(first_row, driver.rows):
            t, y = float(driver.t[row]), driver.y[row].copy()
            invariants = driver.run.invariants
            if self.callback(t, driver.run.tangents.state(y), invariants.values(t, y) - invariants.fixed_target):
                driver.schedule.place[ROW] = row + 1
                return True
        return False

    def _result(self, status: int, message: str, *, broken: bool = False) -> IntegrationResult:
        driver, events, tangents = self.driver, self.events, self.driver.run.tangents
        rows = driver.rows
        values, target = self._values(broken), driver.run.invariants.fixed_target
        driver.note(values, target)
        result = assembled(
            driver.run,
            driver.y[:rows],
            (events.t, events.y) if events.functions else None,
            driver.run.work.counters,
            t=driver.t[:rows],
            invariants=values,
            target=target,
            max_residual=driver.run.work.max_residual,
            diagnostics=self.diagnostics,
            sol=self._solution(),
            status=status,
            message=self.explained(message),
            success=status >= 0,
            trusted=driver.run.trust.trusted,
            wall_time=self.wall_time,
            compiled=self.why_not is None,
            calls=self.problem.calls(driver.run, driver.functions),
            h=abs(driver.schedule.span.h) or None,
        )
        t, y = events.last if self._event_ended else driver.now
        last, values_at = (np.array([t]), y[None].copy()), driver.values_at
        asked = self.given
        if self.problem.variations is not None:
            asked = asked._replace(variations=tangents.restarted(y))
        y, sign = tangents.state(y.copy()), driver.schedule.span.sign
        arguments = asked._asdict() | {"params": copy(asked.params)}  # the user may change the array
        arguments |= arguments.pop("projection")
        origin = Origin(arguments, t, y, sign, self._kept, lambda: values_at(*last)[0], message, self.notes)
        object.__setattr__(result, "_origin", origin)  # not a field: fields are items of the result
        return result

    def _kept(self) -> tuple[Invariant, ...]:
        """Return the invariants with the values that the run keeps as their targets."""
        kept = self.driver.run.invariants.with_targets(at_end=not self._event_ended)
        return kept if self.problem.variations is None else self.problem.variations.with_targets(kept)

    def _solution(self) -> Any:
        """Return the run as a function of time, or None if its steps are not stored."""
        found = self.driver.solution(self.events.last[0] if self._event_ended else self.driver.now[0])
        if found is None or self.problem.variations is None:
            return found
        return StateSolution(found, self.driver.run.tangents)

    def explained(self, message: str) -> str:
        """Return the message with remarks: on a start that was moved, on doubts about the run, and notes."""
        return described(message, self.diagnostics, self.notes)

    @property
    def notes(self) -> tuple[str, ...]:
        """Return notes on checkpoints, functions that were not compiled and gradients by differences."""
        notes = [] if self.keeper is None else list(self.keeper.notes)
        notes += [] if self.why_not is None else [self.why_not]
        if labels := self.driver.run.invariants.by_differences:
            names = ", ".join(map(repr, labels))
            notes.append(
                f"the gradient of {names} is computed by differences: a function for it would be faster and exact"
            )
        missing = self.driver.run.conserved.missing
        return (*notes, *([] if missing is None else [str(missing)]))

    def _values(self, broken: bool) -> np.ndarray:
        """Return the invariants (l, m) of the saved states; NaN if an error has `broken` the run and occurs again."""
        try:
            return self.driver.values()
        except BaseException:
            if not broken:
                raise
            return np.full((self.driver.run.invariants.size, self.driver.rows), np.nan)


def assembled(run: Run, y: np.ndarray, events: Any, counters: np.ndarray, **fields: Any) -> IntegrationResult:
    """Return a result with the given `fields` and those that follow from the `run`.

    `y` (m, n) are the saved states, with the tangent vectors that follow them, and `events` the times and states of
    each event; None without events. `counters` are those of the engine.
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
        units="" if problem is None else problem.units,
        epoch=None if problem is None else problem.epoch,
    )
    if run.problem.variations is not None:
        result["variations"] = tangents.split(y)[1]
        result["columns"] = run.problem.described_columns
    return result


def _slowed_by_invariants(fun: Any, functions: Any, run: Any) -> bool:
    """Return True if a jitted `fun` is called from Python only because invariants are not compiled."""
    if not (isinstance(functions, PythonFunctions) and is_jitted(fun)):
        return False
    kept = [found for item in run.invariants.items for found in (item.function, item.gradient)]
    return not all(is_compiled(found) or isinstance(found, PointerFunction) for found in kept)


def _compiling(shown: bool) -> Any:
    """Return a context manager that, if `shown`, shows a line while functions are compiled, which may take seconds."""
    if not shown:
        return nullcontext()
    from tqdm import tqdm

    return tqdm(total=0, desc="compiling the functions", bar_format="{desc}", leave=False)


class _NoBar:
    """Stand-in for a progress bar that is not shown."""

    n = 0.0

    def update(self, amount: float = 0.0) -> None:
        pass


def _bar(progress: bool, schedule: Schedule, label: str) -> Any:
    if not progress:
        return nullcontext(_NoBar())
    from tqdm import tqdm

    span, shown = schedule.span, {"desc": label, "unit_scale": True, "smoothing": 0.05}
    # `initial` is above 0 if the run is resumed.
    if span.h != 0.0:
        total = span.n_steps if span.n_steps < UNBOUNDED else None
        return tqdm(total=total, initial=int(schedule.place[STEP]), unit="step", **shown)
    length = abs(span.t_bound - span.t0) if math.isfinite(span.t_bound) else None
    return tqdm(total=length, initial=abs(float(schedule.clock[TIME]) - span.t0), unit="time", **shown)


def _keep_start(error: BaseException, request: RunArguments, seconds: float) -> None:
    """Attach a result with the initial state as `partial` to an exception that has no `partial`."""
    if hasattr(error, "partial"):
        return
    with suppress(TypeError, ValueError):  # the initial state itself cannot be read
        t0, start = started_at(request)
        error.partial = IntegrationResult(  # type: ignore[attr-defined]
            {"t": np.array([t0]), "y": start[:, None], "invariants": np.zeros((0, 1)), "target": np.zeros(0)},
            max_residual=np.zeros(0),
            diagnostics=Diagnostics(),
            **dict.fromkeys(("t_events", "y_events", "sol")),
            **dict.fromkeys(("nfev", "njev", "nlu"), 0),
            status=-1,
            message=f"interrupted by {type(error).__name__} at the start",
            **dict.fromkeys(("success", "trusted"), False),
            wall_time=seconds,
            compiled=False,
            calls={},
            method=getattr(request.method, "__name__", str(request.method)),
            **{"h": None, "component_names": None, "units": "", "epoch": None},
        )
