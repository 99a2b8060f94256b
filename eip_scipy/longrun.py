"""`integrate`: long runs with the compiled step, or with the same step interpreted."""

from __future__ import annotations

import hashlib
import math
import os
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numba import typeof, types
from numba.extending import is_jitted

from . import _kernels as kn
from . import _resume, _setup
from ._caching import cached_njit
from ._compile import (
    ChangedShapeError,
    CompiledFunctions,
    Handed,
    NotCompilableError,
    compile_functions,
    signatures,
    with_inlined,
)
from ._events import Events
from ._inputs import count, filled, flag, is_number, real_array, refuse_units, require_arguments, shown
from ._interrupts import ended_by_sigterm, kept_ctrl_c, look_for_signals
from ._kernels import OK
from ._names import nearest
from ._setup import ProjectionOptions, Run
from ._step import T_NEW, Span, T, finish_step, next_step
from ._trust import ProjectionWarning
from .dense import ManifoldDenseOutput, dense_output
from .invariants import Invariant, as_invariants
from .nystrom import NystromTableau
from .one_step import OneStep
from .problems._problem import Problem
from .result import NFEV, NJEV, NLU, Diagnostics, IntegrationResult
from .solvers import EIPSolver
from .tableaux import Tableau

__all__ = ["integrate"]

CHUNK_SECONDS = 0.2
FIRST_CHUNK = 64
FIRST_ROWS = 1024
STEP, ROW, PENDING = 0, 1, 2
PAUSE, FULL = 10, 11
ARRIVED, STOPPED = "reached the end of the interval", "stopped by the callback"
FORMS = {  # (of a Nystrom method, in place) -> what a user's function is
    (False, False): "value",
    (False, True): "in place",
    (True, False): "acceleration",
    (True, True): "acceleration in place",
}


CALLED = "fun", "It takes (t, y), out with in_place=True, and params where the run has them: params=..."


class _Default:
    def __repr__(self) -> str:
        return "<default>"


DEFAULT: Any = _Default()


class Grid(NamedTuple):
    """Where a run steps and what it saves.

    `place` holds [step, row, pending]: pending is 1 between a step and its becoming the current state, so that whoever
    is called in between sees both of its ends. `clock` is that of the step.
    """

    span: Span
    save_every: int
    t_eval: np.ndarray
    place: np.ndarray
    clock: np.ndarray
    g: np.ndarray
    g_new: np.ndarray
    g_direction: np.ndarray


def source_stamp(*names: str) -> str:
    """Hash of all source that goes into a compiled driver, that of the files `names` too.

    Numba's cache on disk looks only at the file of the function itself: without this, an upgraded or edited kernel
    would leave the old driver, with the old kernel inlined, in use.
    """
    folder = Path(__file__).parent
    names = ("_octets.py", "_lanes.py", "_triples.py", "_trust.py", "_kernels.py", "_step.py", *names)
    return hashlib.sha256(b"".join((folder / name).read_bytes() for name in names)).hexdigest()


def make_advance(stamp):
    """The loop over steps; `stamp` enters the key of its cache."""

    def advance(rhs, inv, grad, event, params, grid, k_end, m, o, w, y, y_r, y_new, y_new_r, t_saved, y_saved):
        """Steps up to `k_end`; the one loop of compiled and interpreted runs. Returns OK or why it stopped."""
        _ = stamp
        place, clock = grid.place, grid.clock
        while True:
            if place[PENDING] == 1:
                clock[T] = clock[T_NEW]
                kn.copy(w.K_r[-1], w.K_r[0])
                kn.copy(y_new_r, y_r)
                kn.copy(grid.g_new, grid.g)
                place[PENDING] = 0
            k = place[STEP]
            if clock[T] == grid.span.t_bound or k >= k_end:
                return OK
            if place[ROW] + 2 > t_saved.size:
                return FULL
            status = next_step(
                finish_step, rhs, inv, grad, params, clock, k, grid.span, m, o, w, y, y_r, y_new, y_new_r
            )
            if status != OK:
                return status
            place[STEP] = k + 1
            place[PENDING] = 1
            t_new = clock[T_NEW]
            saved = t_new == grid.span.t_bound or (grid.save_every > 0 and (k + 1) % grid.save_every == 0)
            if grid.t_eval.size == 0 and saved:
                t_saved[place[ROW]] = t_new
                kn.copy(y_new_r, y_saved[place[ROW]])
                place[ROW] += 1
            if grid.g.size > 0:
                event(t_new, y_new, grid.g_new, params)
                if kn.crossed(grid.g, grid.g_new, grid.g_direction):
                    return PAUSE
            if place[ROW] < grid.t_eval.size and grid.span.sign * (grid.t_eval[place[ROW]] - t_new) <= 0.0:
                return PAUSE

    return advance


advance = make_advance(source_stamp("longrun.py"))


def fill_values(inv, params, t, y, values):
    """Invariants of saved states, row by row."""
    for k in range(t.size):
        inv(t[k], y[k], values[k], params)


@cache
def _compiled_advance(dtype: np.dtype, arguments: tuple[Any, ...]) -> Callable[..., int]:
    """The driver compiled for one type of state, its callables as first-class functions: cached on disk."""
    rhs, inv, grad = signatures(dtype)
    functions = [types.FunctionType(s) for s in (rhs, inv, grad, inv)]
    signature = types.int64(*functions, *arguments)
    whole = with_inlined(advance, next_step, finish_step)
    return cached_njit([signature], error_model="numpy", nogil=True, _nrt=False)(whole)


@cache
def _compiled_values(dtype: np.dtype, arguments: tuple[Any, ...]) -> Callable[..., None]:
    inv = types.FunctionType(signatures(dtype).inv)
    return cached_njit([types.void(inv, *arguments)], error_model="numpy", _nrt=False)(fill_values)


class _Driver:
    """One run: its functions, buffers and the rows saved so far."""

    def __init__(self, run: Run, grid: Grid, functions: CompiledFunctions, params: np.ndarray, compiled: bool) -> None:
        self.run, self.grid, self.functions, self.params, self.compiled = run, grid, functions, params, compiled
        rows = saved_rows(grid) or FIRST_ROWS
        n, dtype = run.y0.size, run.y0.dtype
        # One row to spare for the last state of a run that ends early.
        self.t = np.empty(rows + 1)
        self.y = np.empty((rows + 1, n), dtype)
        self.state = run.y0.copy()
        self.new = np.empty_like(self.state)
        if compiled:
            run.options = run.options._replace(joint=None)
        self._tail = (
            run.method,
            run.options,
            run.work,
            self.state,
            self.state.view(float),
            self.new,
            self.new.view(float),
        )
        self._advance: Callable[..., int] = advance
        if compiled:
            arguments = tuple(typeof(a) for a in (params, grid, 0, *self._tail, self.t, self.y.view(float)))
            self._advance = _compiled_advance(dtype, arguments)

    def advance(self, k_end: int) -> int:
        arguments = (self.params, self.grid, k_end, *self._tail, self.t, self.y.view(float))
        try:
            return self._advance(*self.functions, *arguments)
        except ChangedShapeError as error:
            self.place(error)
            raise

    def place(self, error: ChangedShapeError) -> None:
        """Add the step to an error that compiled code raises, which cannot put a number into it."""
        error.args = (f"{error}, in the step from t={self.grid.clock[T]:.10g}",)

    @property
    def step(self) -> int:
        return int(self.grid.place[STEP])

    @property
    def rows(self) -> int:
        return int(self.grid.place[ROW])

    @property
    def now(self) -> tuple[float, np.ndarray]:
        """Time and state after the last step that was accepted."""
        pending = self.grid.place[PENDING] == 1
        return float(self.grid.clock[T_NEW if pending else T]), self.new if pending else self.state

    def parts(self) -> dict[str, np.ndarray]:
        """The buffers that decide the steps to come, or count; all others are filled before they are read."""
        w, grid = self.run.work, self.grid
        kept = ("carry", "err_sum", "sigma", "defect", "max_defect", "max_correction", "trust", "counters")
        return {
            "place": grid.place,
            "clock": grid.clock,
            "y": self.state,
            "slope": w.K[0],
            "g": grid.g,
            "target": self.run.options.target,
            **{name: getattr(w, name) for name in kept},
        }

    def snapshot(self) -> dict[str, np.ndarray]:
        """Copies of these after the last accepted step, made current as the loop does it."""
        copies = {name: part.copy() for name, part in self.parts().items()}
        if self.grid.place[PENDING] == 1:
            copies["place"][PENDING] = 0
            copies["clock"][T] = self.grid.clock[T_NEW]
            copies["y"], copies["slope"] = self.new.copy(), self.run.work.K[-1].copy()
            copies["g"] = self.grid.g_new.copy()
        return copies

    def load(self, t: np.ndarray, y: np.ndarray, max_bytes: float) -> None:
        """Rows of a run that is resumed."""
        while self.t.size <= t.size:
            self.grow(max_bytes)
        self.t[: t.size], self.y[: t.size] = t, y

    def save(self, t: float, y: np.ndarray) -> None:
        """One more row."""
        self.t[self.rows], self.y[self.rows] = t, y
        self.grid.place[ROW] += 1

    def save_start(self) -> None:
        """The first row: the start, where it is asked for and not there already."""
        if self.rows == 0 and (self.grid.t_eval.size == 0 or self.grid.t_eval[0] == self.grid.span.t0):
            self.save(self.grid.span.t0, self.state)

    def save_now(self) -> None:
        """After an early end: the last accepted state too."""
        t, y = self.now
        if self.rows == 0 or self.t[self.rows - 1] != t:
            self.save(t, y)

    def cut(self, t: float, y: np.ndarray) -> None:
        """End the rows with the state at which an event ended the run inside the last step."""
        while self.rows and self.grid.span.sign * (self.t[self.rows - 1] - t) >= 0:
            self.grid.place[ROW] -= 1
        self.save(t, y)

    def grow(self, max_bytes: float) -> None:
        """Room for twice as many rows.

        Raises
        ------
        MemoryError
            When they would need more than `max_bytes`.
        """
        rows = 2 * self.t.size
        check_memory(rows, self.run, max_bytes)
        self.t = np.resize(self.t, rows)
        self.y = np.concatenate([self.y, np.empty_like(self.y)])

    def dense(self, tableau: Tableau, rhs: Callable[..., None]) -> ManifoldDenseOutput:
        """Dense output over the step that is pending."""
        t_old, t = (float(self.grid.clock[place]) for place in (T, T_NEW))
        w = self.run.work
        return dense_output(
            rhs, self.run, tableau, t_old, t, self.state, self.new, w.K[0].copy(), w.K[-1].copy(), self.params
        )

    def values(self) -> np.ndarray:
        """Invariants of the saved states, (l, m)."""
        t, y = self.t[: self.rows], self.y[: self.rows]
        out = np.empty((self.rows, self.run.invariants.size))
        arguments = (self.params, t, y, out)
        fill = fill_values
        if self.compiled:
            fill = _compiled_values(self.run.y0.dtype, tuple(typeof(a) for a in arguments))
        fill(self.functions.inv, *arguments)
        return out.T


def saved_rows(grid: Grid) -> int:
    """States that a run saves, its start included; 0 where that is not known before."""
    if grid.t_eval.size:
        return grid.t_eval.size
    if grid.save_every == 0:
        return 2
    if grid.span.h == 0.0 or grid.span.n_steps == _setup.UNBOUNDED:
        return 0
    return 1 + math.ceil(grid.span.n_steps / grid.save_every)


def integrate(
    fun: Callable[..., Any] | Problem,
    t_span: Any = None,
    y0: Any = None,
    *,
    method: type[EIPSolver],
    h: float | None = DEFAULT,
    params: Any = None,
    in_place: bool = False,
    save_every: int | None = None,
    t_eval: Any = None,
    events: Any = None,
    callback: Callable[[float, np.ndarray, np.ndarray], Any] | None = None,
    progress: bool = False,
    compensated: bool = False,
    compiled: bool | None = None,
    max_bytes: float | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    checkpoint_every: float = 60.0,
    resume: bool = False,
    invariants: Any = DEFAULT,
    metric: Any = DEFAULT,
    blocks: Any = DEFAULT,
    frame: Any = DEFAULT,
    direction: str = "new",
    iterations: int = 1,
    every: int | str = 1,
    reuse_f: bool = True,
    check: bool = True,
    project_initial: bool = False,
    diagnostics: Diagnostics | None = None,
    rtol: Any = DEFAULT,
    atol: Any = DEFAULT,
    first_step: float | None = None,
    max_step: float = np.inf,
    **unknown: Any,
) -> IntegrationResult:
    """Integrate with fixed or adaptive steps, compiled where the functions are Numba functions.

    The step is that of the solver classes; with the same jitted functions the same bits come out, compiled or not.

    Parameters
    ----------
    fun : callable or Problem
        ``fun(t, y[, params]) -> (n,)``; with ``in_place=True``, ``fun(t, y, out[, params])``. For a compiled run a
        lazily jitted Numba function. With a Nystrom method (`EIPRKN8`, `EIPRKN12`), whose state is (q, v), the
        acceleration: ``acc(t, q[, params]) -> (n/2,)``, in place ``acc(t, q, out[, params])``. A `Problem` brings
        everything else with it; options given here take precedence.
    t_span : (float, float)
        Start and end; backward if the end comes first.
    y0 : array_like, shape (n,)
        Initial state, real or complex.
    method : type
        `EIPRK1` ... `EIPRK5`, `EIPRK23`, `EIPRK45`, `EIPDOP853`, `EIPRKN8`, `EIPRKN12`, or a class made by
        `eip_method`; one on a one-step method runs interpreted.
    h : float, optional
        Length of the steps, > 0; the last one ends on the end of `t_span` and may be shorter. None: adaptive steps by
        `rtol`, `atol`, `first_step` and `max_step`. Default: adaptive where one of these is given, else a problem's
        own step, if it has one.
    params : array_like of float, optional
        Passed on to `fun` and to the invariants' functions as the last argument.
    in_place : bool, optional
        Whether `fun` fills its third argument.
    save_every : int, optional
        Save each so many-th step, besides the first and the last state.
    t_eval : array_like, optional
        Times to save at instead, inside `t_span`, in its direction; states between steps come from dense output, on
        the manifold. With neither, the first and the last state are saved.
    events : callable or sequence of callable, optional
        ``event(t, y[, params]) -> float``, with ``terminal`` and ``direction`` as for `scipy.integrate.solve_ivp`; in
        compiled runs Numba functions.
    callback : callable, optional
        ``callback(t, y, defects)`` at each saved point; return True to stop the run. With `save_every` the interval
        may then be endless, as with a terminal event.
    progress : bool, optional
        Show a progress bar with the time that is left.
    compensated : bool, optional
        Carry the rounding errors of the state along (for steps so small that round-off dominates).
    compiled : bool, optional
        None: compiled where possible, else interpreted, with the reason in ``.message``. True: TypeError where it is
        not possible. False: interpreted.
    max_bytes : float, optional
        Bound on the memory for saved states; default: half of what is free.
    checkpoint : path-like, optional
        File that holds the run, saved states included, so that it can be resumed; written at the start, every
        `checkpoint_every` seconds, and when the run ends or is broken off, by SIGTERM too. A file that is there already
        is replaced only by the run that resumes it, and only one run at a time may have it.
    checkpoint_every : float, optional
        Seconds from one checkpoint to the next; more where writing would take over a twentieth of the time.
    resume : bool, optional
        Go on from the checkpoint, with the same arguments: the result is bit for bit that of a run without the
        interruption. Where the file does not exist yet the run starts at the beginning; `message` tells which.
    invariants, metric, blocks, frame, direction, iterations, every, reuse_f, check, project_initial
        As for the solver classes, see `EIPSolver`. Functions of invariants are called as
        ``fun(t, y, *args[, params])``; an invariant whose only argument equals `params` takes the run's
        `params` in its place.
    diagnostics, first_step, max_step
        Likewise.
    rtol, atol : float or array_like, optional
        Likewise, 1e-3 and 1e-6 by default. Beside a given `h` they only set the scale of the error metric.

    Returns
    -------
    IntegrationResult
        Times ``t`` (m,), states ``y`` (n, m), values ``invariants`` (l, m), ``max_defect`` (l,), and more.

    Raises
    ------
    TypeError
        Unknown options, values of a wrong kind, or ``compiled=True`` with functions that cannot be compiled.
    ValueError
        Options with wrong values, a start that misses a given target, a wrong gradient.
    MemoryError
        When the saved states would need more than `max_bytes`.
    CheckpointError
        When the file cannot be written at the start, or is there and not to be resumed, or is damaged, or belongs to a
        run with other arguments or functions, or another run has it.

    Notes
    -----
    A step that fails ends the run with ``status=-1`` and everything up to there. Exceptions from user code and
    KeyboardInterrupt pass through, with what the run had as ``exception.partial`` (one row, the start, before the first
    step), and with a note that says from where its checkpoint goes on. A checkpoint that cannot be written later on is
    a RuntimeWarning and stands in `message`; the former one stays.

    The user's functions may keep or overwrite the states that they are given: compiled or not, they get copies where
    they do.

    Examples
    --------
    >>> from eip_scipy import EIPRK4, integrate
    >>> from eip_scipy.problems import kepler
    >>> run = integrate(kepler(), (0, 200), method=EIPRK4, h=0.03, save_every=100)
    >>> run.y.shape, bool((run.max_defect < 1e-11).all())
    ((4, 68), True)
    """
    arguments = {name: value for name, value in locals().items() if name != "unknown"}
    for name in unknown:
        hint = nearest(name, integrate.__kwdefaults__ or ())
        raise TypeError(f"integrate() has no option {name!r}{hint}")
    refuse_units(checkpoint_every=checkpoint_every)
    own = {name: arguments.pop(name) for name in ("checkpoint", "checkpoint_every", "resume")}
    kept = _resume.kept(*own.values())
    with kept_ctrl_c(), ended_by_sigterm(checkpoint is not None), kept as keeper, _start_kept(fun, t_span, y0, method):
        return prepared(**arguments, keeper=keeper).run()


def prepared(
    fun: Callable[..., Any] | Problem,
    t_span: Any,
    y0: Any,
    *,
    method: type[EIPSolver],
    h: float | None,
    params: Any,
    in_place: bool,
    save_every: int | None,
    t_eval: Any,
    events: Any,
    callback: Callable[[float, np.ndarray, np.ndarray], Any] | None,
    progress: bool,
    compensated: bool,
    compiled: bool | None,
    max_bytes: float | None,
    diagnostics: Diagnostics | None,
    rtol: Any,
    atol: Any,
    first_step: float | None,
    max_step: float,
    keeper: _resume.Keeper,
    check_start: bool = True,
    **projection: Any,
) -> Loop:
    """What `integrate` runs, by the same arguments, all of them validated; `projection`: those of the projection."""
    refuse_units(first_step=first_step, max_step=max_step, max_bytes=max_bytes)
    given = {key: value for key, value in projection.items() if value is not DEFAULT}
    tableau = _tableau(method)
    form = FORMS[isinstance(tableau, NystromTableau), flag("in_place", in_place)]
    _check_choices(callback, progress, compiled, max_bytes)
    no_bound = isinstance(max_step, float) and max_step == np.inf
    adaptive = not (rtol is DEFAULT and atol is DEFAULT and first_step is None and no_bound)
    t_span, y0 = _start(fun, t_span, y0)
    if isinstance(fun, Problem):
        problem = fun
        form = "value" if problem.rhs is None else "in place"
        fun = problem.fun if problem.rhs is None else problem.rhs
        if h is DEFAULT and not adaptive:
            h = problem.h
        own = {key: getattr(problem, key) for key in ("invariants", "metric", "blocks", "frame")}
        given = {**own, **given}
        given["invariants"] = _with_run_params(given["invariants"], problem.params)
        if params is None and problem.rhs is not None:
            params = problem.params
    if not callable(fun):
        raise TypeError(f"integrate: fun must be callable or a Problem, got {fun!r}.")
    parameters = np.zeros(0) if params is None else _parameters(params)
    extra = () if params is None else (parameters,)
    handed: list[Handed] = []
    hand = partial(_hand, handed)
    happenings = Events(events, extra, hand)
    t0, t_bound = _span(t_span, happenings.terminal or (callback is not None and save_every is not None))
    start = _state(y0)
    stepping = _setup.stepping(
        method.__name__,
        tableau,
        t0,
        t_bound,
        start.size,
        None if h is DEFAULT else h,
        first_step,
        max_step,
        1e-3 if rtol is DEFAULT else rtol,
        1e-6 if atol is DEFAULT else atol,
        stacklevel=4,
    )
    if "invariants" in given:
        given["invariants"] = _with_run_params(given["invariants"], params)
    rhs = INTERPRETED[form](hand(fun, 1), extra, start)

    def derivative(t: float, y: np.ndarray) -> np.ndarray:
        out = np.empty_like(y)
        rhs(t, y, out, parameters)
        return out

    calls = _setup.Counted(derivative)
    try:
        f0 = calls(t0, start)
    except TypeError:
        out = ("out",) if "in place" in form else ()
        require_arguments(fun, ("t", "y", *out, *("params" for _ in extra)), *CALLED)
        raise
    if isinstance(tableau, NystromTableau):
        _setup.check_second_order(calls, t0, start, f0, method.__name__)
    tau = stepping.first(calls, start, f0, tableau)
    grid = _grid(stepping.span, tau, save_every, t_eval, happenings)
    run = _setup.prepare(
        tableau,
        calls,
        t0,
        start,
        f0,
        tau,
        ProjectionOptions(**given),
        stepping,
        extra=extra,
        compensated=compensated,
        check_start=check_start,
        hand=hand,
    )
    run.in_place = "in place" in form
    bound = 0.5 * free_memory() if max_bytes is None else max_bytes
    check_memory(saved_rows(grid), run, bound)
    record = Diagnostics() if diagnostics is None else diagnostics
    _setup.attach(record, run)
    happenings.fill(t0, run.y0, grid.g)
    if keeper.keeps:
        settings = _resume.settings(method.__name__, stepping, start, parameters, run, grid, happenings)
        keeper.identify(settings, run, derivative, t0, start, f0)
    with _compiling(progress and compiled is not False and is_jitted(fun)):
        functions, why_not = _functions(fun, form, extra, run, happenings, compiled, rhs)
        driver = _Driver(run, grid, functions, parameters, compiled=why_not is None)
    for function in handed:
        function.read_only &= why_not is None
    run.work.K[0] = f0 if run.y0 is start else calls(t0, run.y0)
    run.work.counters[NFEV] = calls.count
    keeper.begin(driver, happenings, bound)
    loop = Loop(driver, tableau, rhs, happenings, record, callback, progress, method.__name__, why_not, bound, keeper)
    loop.in_octets = partial(compile_functions, fun, form, bool(extra), run.invariants, (), start.dtype, in_octets=True)
    return loop


class Loop:
    """Drives chunks of steps: progress, samples, events, callbacks, and what is kept when something goes wrong."""

    def __init__(
        self,
        driver: _Driver,
        tableau: Tableau,
        rhs: Callable[..., None],
        events: Events,
        diagnostics: Diagnostics,
        callback: Callable[..., Any] | None,
        progress: bool,
        method: str,
        why_not: str | None,
        max_bytes: float,
        keeper: _resume.Keeper,
    ) -> None:
        self.driver, self.tableau, self.rhs, self.events = driver, tableau, rhs, events
        self.diagnostics, self.callback, self.progress = diagnostics, callback, progress
        self.method, self.why_not, self.max_bytes = method, why_not, max_bytes
        self.keeper = keeper
        self.wall_time = keeper.seconds
        self.chunk = FIRST_CHUNK
        self.told = self._doubtful = False
        self.in_octets: Callable[[], CompiledFunctions]

    def run(self) -> IntegrationResult:
        driver = self.driver
        begin = time.perf_counter()
        try:
            with _bar(self.progress, driver.grid, self.method) as bar:
                status, message = self.steps(bar)
            self.keeper.end(status, message)
        except BaseException as error:
            self.wall_time += time.perf_counter() - begin
            self.keeper.interrupted(error)  # first: whoever ends the process may not wait long
            driver.run.trust.failed = True
            driver.save_now()
            partial = self._result(-1, f"interrupted by {type(error).__name__}", broken=True)
            error.partial = partial  # type: ignore[attr-defined]
            raise
        self.wall_time += time.perf_counter() - begin
        if status < 0:
            driver.save_now()
        result = self._result(status, message)
        if self.told:
            try:
                warnings.warn(f"{self.method}: {driver.run.trust.message}", ProjectionWarning, stacklevel=3)
            except ProjectionWarning as error:
                error.partial = result  # type: ignore[attr-defined]
                raise
        return result

    def steps(self, bar: Any) -> tuple[int, str]:
        """Run on to the end of the interval, or to what ends the run before it; returns status and message.

        At the end `told` says whether something speaks against a run that has not failed.
        """
        self._doubtful = False
        status, message = self._steps(bar)
        self.driver.run.trust.failed = status < 0
        self._look(ended=True)
        self.told = self._doubtful and status >= 0
        return status, message

    def _look(self, *, ended: bool = False) -> None:
        driver = self.driver
        t, y = driver.now

        def derivative() -> np.ndarray:
            f = np.empty_like(y)
            self.rhs(t, y, f, driver.params)
            return f

        self._doubtful |= driver.run.look(driver.step, ended, t, y.copy(), derivative)

    def _steps(self, bar: Any) -> tuple[int, str]:
        driver = self.driver
        if driver.step == 0:
            driver.save_start()
            if self._stopped_by_callback(0):
                return 1, STOPPED
        while True:
            look_for_signals()
            self.keeper.keep()
            k, rows, begin = driver.step, driver.rows, time.perf_counter()
            steps = self._chunk(self.chunk)
            code = driver.advance(k + steps)
            seconds = time.perf_counter() - begin
            ended = self._pause() if code == PAUSE else False
            bar.update(self._progress(bar.n, k))
            if self._stopped_by_callback(rows):
                return 1, STOPPED
            if ended:
                return 1, "A termination event occurred."
            if driver.step in _setup.LOOKS:
                self._look()
            if code == FULL:
                driver.grow(self.max_bytes)
            elif code not in (OK, PAUSE):
                return -1, _setup.failure(code, driver.run, driver.grid.clock)
            elif code == OK and driver.grid.clock[T] == driver.grid.span.t_bound:
                return 0, ARRIVED
            if code == OK:
                # At most a doubling, so that one fast chunk cannot make a slow one long; none of one that was cut.
                longer = max(self.chunk, 2 * steps)
                self.chunk = max(1, min(longer, int(steps * CHUNK_SECONDS / max(seconds, 1e-9))))

    def _progress(self, shown: float, k: int) -> float:
        """What the bar is to grow by: steps where their number is known, else time."""
        grid = self.driver.grid
        if grid.span.h != 0.0:
            return self.driver.step - k
        return abs(self.driver.now[0] - grid.span.t0) - shown

    def _pause(self) -> bool:
        """Samples and events in the step that is pending; True where an event ends the run."""
        driver, grid = self.driver, self.driver.grid
        sol = driver.dense(self.tableau, self.rhs)
        end = None
        if grid.g.size:
            end = self.events.handle(grid.g, grid.g_new, sol)
        limit = sol.t if end is None else end
        while driver.rows < grid.t_eval.size and grid.span.sign * (grid.t_eval[driver.rows] - limit) <= 0:
            t = float(grid.t_eval[driver.rows])
            driver.save(t, sol(t))
        if end is None:
            return False
        if grid.t_eval.size == 0:
            driver.cut(end, sol(end))
        return True

    def _chunk(self, chunk: int) -> int:
        """Steps of the next call: none beyond the next look or, with a callback, the next saved one."""
        grid, step = self.driver.grid, self.driver.step
        chunk = min([chunk, *(look - step for look in _setup.LOOKS if look > step)])
        if self.callback is None or grid.save_every == 0:
            return chunk
        return min(chunk, grid.save_every - step % grid.save_every)

    def _stopped_by_callback(self, first_row: int) -> bool:
        if self.callback is None:
            return False
        driver = self.driver
        for row in range(first_row, driver.rows):
            t, y = float(driver.t[row]), driver.y[row].copy()
            invariants = driver.run.invariants
            if self.callback(t, y, invariants.values(t, y) - invariants.target):
                driver.grid.place[ROW] = row + 1
                return True
        return False

    def _result(self, status: int, message: str, *, broken: bool = False) -> IntegrationResult:
        driver = self.driver
        rows, counters, events = driver.rows, driver.run.work.counters, self.events
        return IntegrationResult(
            t=driver.t[:rows],
            y=driver.y[:rows].T,
            invariants=self._values(broken),
            max_defect=driver.run.work.max_defect,
            diagnostics=self.diagnostics,
            t_events=[np.asarray(t) for t in events.t] if events.functions else None,
            y_events=[np.asarray(y) for y in events.y] if events.functions else None,
            nfev=int(counters[NFEV]),
            njev=int(counters[NJEV]),
            nlu=int(counters[NLU]),
            status=status,
            message=self.explained(message),
            success=status >= 0,
            trusted=driver.run.trust.trusted,
            wall_time=self.wall_time,
            compiled=self.why_not is None,
            method=self.method,
            h=abs(driver.grid.span.h) or None,
        )

    def explained(self, message: str) -> str:
        """With what speaks against the run, and what is to be said about checkpoints and not being compiled."""
        notes = [*self.keeper.notes, *([] if self.why_not is None else [f"interpreted: {self.why_not}"])]
        doubt = self.driver.run.trust.message
        message = f"{message}; {doubt}" if doubt else message
        return f"{message} ({'; '.join(notes)})" if notes else message

    def _values(self, broken: bool) -> np.ndarray:
        """Invariants of the saved states; NaN where the run was broken off by an invariant that still raises."""
        try:
            return self.driver.values()
        except BaseException:
            if not broken:
                raise
            return np.full((self.driver.run.invariants.size, self.driver.rows), np.nan)


def _compiling(shown: bool) -> Any:
    """A line while the first run of an installation compiles, which takes longer than anyone waits without a word."""
    from tqdm import tqdm

    line = "compiling (about a minute in the first run, then kept on disk)"
    return tqdm(total=0, desc=line, bar_format="{desc}", leave=False, disable=not shown)


def _bar(progress: bool, grid: Grid, label: str) -> Any:
    from tqdm import tqdm

    fixed = grid.span.h != 0.0
    total: float | None
    if fixed:
        total = grid.span.n_steps if grid.span.n_steps < _setup.UNBOUNDED else None
    else:
        total = abs(grid.span.t_bound - grid.span.t0) if math.isfinite(grid.span.t_bound) else None
    unit = "step" if fixed else "time"
    # Beyond 0 where the run is resumed.
    initial = int(grid.place[STEP]) if fixed else abs(float(grid.clock[T]) - grid.span.t0)
    return tqdm(
        total=total, initial=initial, desc=label, unit=unit, unit_scale=True, disable=not progress, smoothing=0.05
    )


def _required(name: str, value: Any) -> Any:
    if value is None:
        raise TypeError(f"integrate: {name} is missing; only a Problem brings its own.")
    return value


def _tableau(method: Any) -> Any:
    if not (isinstance(method, type) and issubclass(method, EIPSolver) and hasattr(method, "TABLEAU")):
        raise TypeError(
            f"integrate: method must be an EIP class such as EIPRK4, or one that eip_method made; got {method!r}."
        )
    if method._project_step is not EIPSolver._project_step:
        raise TypeError(f"integrate does not call {method.__name__}._project_step; use it through solve_ivp.")
    return method.TABLEAU


@contextmanager
def _start_kept(fun: Any, t_span: Any, y0: Any, method: Any) -> Iterator[None]:
    """Give an exception that comes before the first step the start as what the run had."""
    begin = time.perf_counter()
    try:
        yield
    except BaseException as error:
        if not hasattr(error, "partial"):
            with suppress(TypeError, ValueError):  # no start that could be read
                t_span, y0 = _start(fun, t_span, y0)
                t0, start = _setup.interval(t_span)[0], _state(y0)
                error.partial = IntegrationResult(  # type: ignore[attr-defined]
                    t=np.array([t0]),
                    y=start[:, None],
                    invariants=np.zeros((0, 1)),
                    max_defect=np.zeros(0),
                    diagnostics=Diagnostics(),
                    t_events=None,
                    y_events=None,
                    nfev=0,
                    njev=0,
                    nlu=0,
                    status=-1,
                    message=f"interrupted by {type(error).__name__} at the start",
                    success=False,
                    wall_time=time.perf_counter() - begin,
                    compiled=False,
                    method=getattr(method, "__name__", str(method)),
                    h=None,
                )
        raise


def _start(fun: Any, t_span: Any, y0: Any) -> tuple[Any, Any]:
    """t_span and y0 as they are given, else a problem's own."""
    if isinstance(fun, Problem):
        return fun.t_span if t_span is None else t_span, fun.y0 if y0 is None else y0
    return t_span, y0


def _state(y0: Any) -> np.ndarray:
    start = _setup.initial_state(_required("y0", y0))
    if start.size == 0:
        raise ValueError("y0 is empty; integrate needs a state of at least one component.")
    return start


def _span(t_span: Any, ends: bool) -> tuple[float, float]:
    """The interval; endless only where something `ends` the run."""
    t0, t_bound = _setup.interval(t_span)
    if math.isinf(t_bound) and not ends:
        raise ValueError(
            f"t_span must be finite unless a terminal event ends the run, got {shown(t_span)}; a callback may end it "
            "too, at the steps that save_every=... saves."
        )
    return t0, t_bound


def _check_choices(callback: Any, progress: Any, compiled: Any, max_bytes: Any) -> None:
    if callback is not None and not callable(callback):
        raise TypeError(f"callback must be a function callback(t, y, defects), got {shown(callback)}.")
    flag("progress", progress)
    if compiled is not None and not isinstance(compiled, (bool, np.bool_)):
        raise ValueError(f"compiled must be True, False or None (where possible), got {shown(compiled)}.")
    check_bytes(max_bytes)


def check_bytes(max_bytes: Any) -> None:
    """The option ``max_bytes`` is None or a number."""
    refuse_units(max_bytes=max_bytes)
    if max_bytes is not None and not (is_number(max_bytes) and max_bytes >= 0):
        raise ValueError(f"max_bytes must be a number of bytes >= 0, got {shown(max_bytes)}.")


def _parameters(params: Any) -> np.ndarray:
    return real_array("params", params, TypeError).reshape(-1)


def _with_run_params(invariants: Any, params: Any) -> tuple[Invariant, ...]:
    """The invariants with `params` taken out of their args, where they are all these hold: the run passes them."""
    items = as_invariants(invariants)
    if params is None:
        return items
    return tuple(_bare(item) if _takes(item, params) else item for item in items)


def _takes(item: Invariant, params: Any) -> bool:
    return len(item.args) == 1 and np.array_equal(item.args[0], params)


def _bare(item: Invariant) -> Invariant:
    bare = Invariant.__new__(Invariant)
    bare.__dict__.update(item.__dict__, args=())
    return bare


def _grid(span: Span, tau: float, save_every: Any, t_eval: Any, events: Events) -> Grid:
    times = np.zeros(0)
    if t_eval is not None:
        if save_every is not None:
            raise ValueError("give save_every or t_eval, not both.")
        times = _evaluation_times(t_eval, span)
    n_events = len(events.functions)
    return Grid(
        span=span,
        save_every=0 if save_every is None else count("save_every", save_every),
        t_eval=times,
        place=np.zeros(3, np.int64),
        clock=np.array([span.t0, span.t0, 0.0, tau]),
        g=np.zeros(n_events),
        g_new=np.zeros(n_events),
        g_direction=events.directions,
    )


def _evaluation_times(t_eval: Any, span: Span) -> np.ndarray:
    times = real_array("t_eval", t_eval)
    if times.ndim != 1 or times.size == 0:
        raise ValueError("`t_eval` must be 1-dimensional and not empty.")
    if not np.isfinite(times).all():
        raise ValueError("t_eval must be finite.")
    if np.any(times < min(span.t0, span.t_bound)) or np.any(times > max(span.t0, span.t_bound)):
        raise ValueError("Values in `t_eval` are not within `t_span`.")
    if np.any(span.sign * np.diff(times) <= 0):
        raise ValueError("Values in `t_eval` are not properly sorted.")
    return times


def check_memory(rows: int, run: Run, max_bytes: float) -> None:
    """Refuse to save more than fits.

    Raises
    ------
    MemoryError
        With the number of bytes and what to do.
    """
    needed = rows * (run.y0.nbytes + 8 * (1 + run.invariants.size))
    if needed > max_bytes:
        raise MemoryError(
            f"saving {rows:.3g} states of {run.y0.size} components needs {needed / 1e9:.3g} GB, the bound is "
            f"{max_bytes / 1e9:.3g} GB; raise save_every (or max_bytes)."
        )


def free_memory() -> float:
    """Bytes that a process may still take."""
    try:
        with open("/proc/meminfo") as lines:
            for line in lines:
                if line.startswith("MemAvailable:"):
                    return 1024.0 * int(line.split()[1])
    except OSError:
        pass
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        return 0.5 * os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return 4e9


def _interpreted_value(fun: Callable[..., Any], extra: tuple, y0: np.ndarray) -> Callable[..., None]:
    """The user's right-hand side as Python calls it, its values checked."""
    n, dtype, shape = y0.size, y0.dtype, y0.shape

    def rhs(t: float, y: np.ndarray, out: np.ndarray, params: np.ndarray) -> None:
        f = fun(t, y.copy(), *extra)
        known = type(f) is np.ndarray and f.shape == shape and f.dtype == dtype
        out[:] = f if known else _setup.as_derivative(f, n, dtype, t)

    return rhs


def _interpreted_in_place(fun: Callable[..., Any], extra: tuple, y0: np.ndarray) -> Callable[..., None]:
    """The user's right-hand side in place, looked at in its first call; NaN in `out` then shows what it leaves out."""
    first = True

    def rhs(t: float, y: np.ndarray, out: np.ndarray, params: np.ndarray) -> None:
        nonlocal first
        if first:
            first = False
            out[:] = filled(lambda part: fun(t, y.copy(), part, *extra), out.shape, out.dtype, "fun", t)
        else:
            out.fill(math.nan)
            fun(t, y.copy(), out, *extra)

    return rhs


def _interpreted_acceleration(fun: Callable[..., Any], extra: tuple, y0: np.ndarray) -> Callable[..., None]:
    return _second_order(_interpreted_value(fun, extra, _positions(y0)))


def _interpreted_acceleration_in_place(fun: Callable[..., Any], extra: tuple, y0: np.ndarray) -> Callable[..., None]:
    return _second_order(_interpreted_in_place(fun, extra, _positions(y0)))


def _positions(y0: np.ndarray) -> np.ndarray:
    _setup.check_halves(y0.size)
    return y0[: y0.size // 2]


def _second_order(acc: Callable[..., None]) -> Callable[..., None]:
    """The right-hand side of (q, v) from its acceleration."""

    def rhs(t: float, y: np.ndarray, out: np.ndarray, params: np.ndarray) -> None:
        half = y.size // 2
        out[:half] = y[half:]
        acc(t, y[:half], out[half:], params)

    return rhs


INTERPRETED = {
    "value": _interpreted_value,
    "in place": _interpreted_in_place,
    "acceleration": _interpreted_acceleration,
    "acceleration in place": _interpreted_acceleration_in_place,
}


def _hand(handed: list[Handed], fun: Callable[..., Any], arrays: int) -> Callable[..., Any]:
    """What is called in the place of a user's function; those that are jitted are listed."""
    if not is_jitted(fun):
        return fun
    handed.append(Handed(fun, arrays))
    return handed[-1]


def _functions(
    fun: Callable[..., Any],
    form: str,
    extra: tuple,
    run: Run,
    events: Events,
    compiled: bool | None,
    rhs: Callable[..., None],
) -> tuple[CompiledFunctions, str | None]:
    """The functions of the loop, and why they are not compiled (None: they are)."""
    invariants, dtype = run.invariants, run.y0.dtype
    interpreted = CompiledFunctions(rhs, invariants.inv, invariants.grad, events.fill)
    if compiled is False:
        return interpreted, "compiled=False"
    try:
        if isinstance(run.method, OneStep):
            raise NotCompilableError(f"{run.method.name} is a one-step method in Python")
        return compile_functions(fun, form, bool(extra), invariants, tuple(events.functions), dtype), None
    except NotCompilableError as reason:
        if compiled:
            raise
        return interpreted, str(reason)
