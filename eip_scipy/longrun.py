"""`integrate`: long runs with the compiled step, or with the same step interpreted."""

from __future__ import annotations

import hashlib
import math
import os
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numba import njit, typeof, types

from . import _kernels as kn
from . import _setup
from ._compile import CompiledFunctions, NotCompilableError, compile_functions, signatures
from ._kernels import NOT_FINITE, OK
from ._setup import ProjectionOptions, Run
from ._step import eip_step
from .invariants import Invariant, InvariantSet, as_invariants
from .problems._problem import Problem
from .result import NFEV, NJEV, NLU, Diagnostics, IntegrationResult
from .solvers import EIPSolver

__all__ = ["integrate"]

CHUNK_SECONDS = 0.2
FIRST_CHUNK = 64
STEP, ROW = 0, 1


class _Default:
    def __repr__(self) -> str:
        return "<default>"


DEFAULT: Any = _Default()


class Grid(NamedTuple):
    """The steps of a run: t_k = t0 + k h, the last one on t_bound; and what is saved in `place` [step, row]."""

    t0: float
    h: float
    t_bound: float
    n_steps: int
    save_every: int
    t_eval: np.ndarray
    place: np.ndarray


def source_stamp() -> str:
    """Hash of all source that goes into the compiled driver.

    Numba's cache on disk looks only at the file of the function itself: without this, an upgraded or edited kernel
    would leave the old driver, with the old kernel inlined, in use.
    """
    folder = Path(__file__).parent
    sources = [(folder / name).read_bytes() for name in ("_lanes.py", "_kernels.py", "_step.py", "longrun.py")]
    return hashlib.sha256(b"".join(sources)).hexdigest()


def make_advance(stamp):
    """The loop over steps; `stamp` enters the key of its cache."""

    def advance(rhs, inv, grad, params, grid, k_end, m, o, w, y, y_r, y_new, y_new_r, t_saved, y_saved):
        """Steps up to `k_end`; the one loop of compiled and interpreted runs. Returns OK or why it stopped."""
        _ = stamp
        while grid.place[STEP] < k_end:
            k = grid.place[STEP]
            last = k + 1 == grid.n_steps
            t = grid.t0 + k * grid.h
            t_new = grid.t_bound if last else grid.t0 + (k + 1) * grid.h
            h = t_new - t if last else grid.h
            project = o.target.size > 0 and (last or (k + 1) % o.every == 0)
            status = eip_step(rhs, inv, grad, params, t, y, y_r, t_new, h, project, m, o, w, y_new, y_new_r)
            if status != OK:
                return status
            if grid.t_eval.size > 0:
                kn.sample(grid.t_eval, grid.place, t, t_new, h, y_r, w.K_r, y_new_r, t_saved, y_saved)
            elif last or (grid.save_every > 0 and (k + 1) % grid.save_every == 0):
                row = grid.place[ROW]
                t_saved[row] = t_new
                kn.copy(y_new_r, y_saved[row])
                grid.place[ROW] = row + 1
            kn.copy(w.K_r[-1], w.K_r[0])
            kn.copy(y_new_r, y_r)
            grid.place[STEP] = k + 1
        return OK

    return advance


advance = make_advance(source_stamp())


def fill_values(inv, params, t, y, values):
    """Invariants of saved states, row by row."""
    for k in range(t.size):
        inv(t[k], y[k], values[k], params)


@cache
def _compiled_advance(dtype: np.dtype, arguments: tuple[Any, ...]) -> Callable[..., int]:
    """The driver compiled for one type of state, its callables as first-class functions: cached on disk."""
    functions = [types.FunctionType(s) for s in signatures(dtype)]
    return njit([types.int64(*functions, *arguments)], cache=True, error_model="numpy", _nrt=False)(advance)


@cache
def _compiled_values(dtype: np.dtype, arguments: tuple[Any, ...]) -> Callable[..., None]:
    inv = types.FunctionType(signatures(dtype).inv)
    return njit([types.void(inv, *arguments)], cache=True, error_model="numpy", _nrt=False)(fill_values)


class _Driver:
    """One run: its functions, buffers and the rows saved so far."""

    def __init__(self, run: Run, grid: Grid, functions: CompiledFunctions, params: np.ndarray, compiled: bool) -> None:
        self.run, self.grid, self.functions, self.params, self.compiled = run, grid, functions, params, compiled
        rows = saved_rows(grid) + 1
        n, dtype = run.y0.size, run.y0.dtype
        self.t = np.empty(rows)
        self.y = np.empty((rows, n), dtype)
        self.state = run.y0.copy()
        self.new = np.empty_like(self.state)
        self._tail = (
            run.method,
            run.options,
            run.work,
            self.state,
            self.state.view(float),
            self.new,
            self.new.view(float),
            self.t,
            self.y.view(float),
        )
        self._advance: Callable[..., int] = advance
        if compiled:
            arguments = tuple(typeof(a) for a in (params, grid, 0, *self._tail))
            self._advance = _compiled_advance(dtype, arguments)

    def save_start(self) -> None:
        """The first row: the start, where it is asked for."""
        if self.grid.t_eval.size == 0 or self.grid.t_eval[0] == self.grid.t0:
            self.t[0], self.y[0] = self.grid.t0, self.state
            self.grid.place[ROW] = 1

    def advance(self, k_end: int) -> int:
        return self._advance(*self.functions, self.params, self.grid, k_end, *self._tail)

    @property
    def step(self) -> int:
        return int(self.grid.place[STEP])

    @property
    def rows(self) -> int:
        return int(self.grid.place[ROW])

    def time_of(self, k: int) -> float:
        return self.grid.t_bound if k == self.grid.n_steps else self.grid.t0 + k * self.grid.h

    def save_last(self) -> None:
        """After an early end: the last accepted state too."""
        t = self.time_of(self.step)
        if self.rows == 0 or self.t[self.rows - 1] != t:
            self.t[self.rows], self.y[self.rows] = t, self.state
            self.grid.place[ROW] += 1

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
    """States that a run saves, its start included."""
    if grid.t_eval.size:
        return grid.t_eval.size
    if grid.save_every == 0:
        return 2
    return 1 + math.ceil(grid.n_steps / grid.save_every)


def integrate(
    fun: Callable[..., Any] | Problem,
    t_span: Any = None,
    y0: Any = None,
    *,
    method: type[EIPSolver],
    h: float | None = None,
    params: Any = None,
    in_place: bool = False,
    save_every: int | None = None,
    t_eval: Any = None,
    callback: Callable[[float, np.ndarray, np.ndarray], Any] | None = None,
    progress: bool = False,
    compensated: bool = False,
    compiled: bool | None = None,
    max_bytes: float | None = None,
    invariants: Any = DEFAULT,
    metric: Any = DEFAULT,
    blocks: Any = DEFAULT,
    frame: Any = DEFAULT,
    direction: str = "new",
    iterations: int = 1,
    every: int = 1,
    reuse_f: bool = True,
    check: bool = True,
    project_initial: bool = False,
    diagnostics: Diagnostics | None = None,
    rtol: Any = 1e-3,
    atol: Any = 1e-6,
    **unknown: Any,
) -> IntegrationResult:
    """Integrate with fixed steps, compiled where the functions are Numba functions.

    The step is that of the solver classes; with the same jitted functions the same bits come out, compiled or not.

    Parameters
    ----------
    fun : callable or Problem
        ``fun(t, y[, params]) -> (n,)``; with ``in_place=True``, ``fun(t, y, out[, params])``. For a compiled run a
        lazily jitted Numba function. A `Problem` brings everything else with it; options given here take precedence.
    t_span : (float, float)
        Start and end; backward if the end comes first.
    y0 : array_like, shape (n,)
        Initial state, real or complex.
    method : type
        `EIPRK1` ... `EIPRK5` or a class made by `eip_method`.
    h : float
        Length of the steps, > 0; the last one ends on the end of `t_span` and may be shorter.
    params : array_like of float, optional
        Passed on to `fun` and to the invariants' functions as the last argument.
    in_place : bool, optional
        Whether `fun` fills its third argument.
    save_every : int, optional
        Save each so many-th step, besides the first and the last state.
    t_eval : array_like, optional
        Times to save at instead, inside `t_span`, in its direction. States between steps come from cubic Hermite
        interpolation. With neither, the first and the last state are saved.
    callback : callable, optional
        ``callback(t, y, defects)`` at each saved point; return True to stop the run.
    progress : bool, optional
        Show a progress bar with the time that is left.
    compensated : bool, optional
        Carry the rounding errors of the state along (for steps so small that round-off dominates).
    compiled : bool, optional
        None: compiled where possible, else interpreted, with the reason in ``.message``. True: TypeError where it is
        not possible. False: interpreted.
    max_bytes : float, optional
        Bound on the memory for saved states; default: half of what is free.
    invariants, metric, blocks, frame, direction, iterations, every, reuse_f, check, project_initial
        As for the solver classes, see `EIPSolver`. Functions of invariants are called as
        ``fun(t, y, *args[, params])``; an invariant whose only argument equals `params` takes the run's
        `params` in its place.
    diagnostics, rtol, atol
        Likewise.

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

    Notes
    -----
    A step that fails ends the run with ``status=-1`` and everything up to there. Exceptions from user code and
    KeyboardInterrupt pass through, with what the run had as ``exception.partial``.

    Examples
    --------
    >>> from eip_scipy import EIPRK4, integrate
    >>> from eip_scipy.problems import kepler
    >>> run = integrate(kepler(), (0, 200), method=EIPRK4, h=0.03, save_every=100)
    >>> run.y.shape, bool((run.max_defect < 1e-11).all())
    ((4, 68), True)
    """
    for name in unknown:
        hint = _setup.nearest_option(name, integrate.__kwdefaults__ or ())
        raise TypeError(f"integrate() has no option {name!r}{hint}")
    given = {"invariants": invariants, "metric": metric, "blocks": blocks, "frame": frame}
    given = {key: value for key, value in given.items() if value is not DEFAULT}
    if isinstance(fun, Problem):
        problem = fun
        fun, in_place = (problem.fun, False) if problem.rhs is None else (problem.rhs, True)
        t_span = problem.t_span if t_span is None else t_span
        y0 = problem.y0 if y0 is None else y0
        h = problem.h if h is None else h
        own = {key: getattr(problem, key) for key in ("invariants", "metric", "blocks", "frame")}
        given = {**own, **given}
        given["invariants"] = [_with_run_params(item, problem.params) for item in as_invariants(given["invariants"])]
        if params is None and problem.rhs is not None:
            params = problem.params
    if not callable(fun):
        raise TypeError(f"integrate: fun must be callable or a Problem, got {fun!r}.")
    tableau = _tableau(method)
    t0, t_bound = _span(t_span)
    start = _setup.initial_state(_required("y0", y0))
    if h is None:
        raise ValueError(f"integrate with {method.__name__} needs the step h=...")
    h = _setup.check_fixed_step(h, t0, t_bound)
    grid = _grid(t0, t_bound, h, save_every, t_eval)
    _check_memory(grid, start, max_bytes)
    parameters = np.zeros(0) if params is None else _parameters(params)
    extra = () if params is None else (parameters,)
    if params is not None and "invariants" in given:
        given["invariants"] = [_with_run_params(item, params) for item in as_invariants(given["invariants"])]
    rhs = _interpreted_rhs(fun, in_place, extra, start)
    f0 = np.zeros_like(start)
    rhs(t0, start, f0, parameters)

    def derivative(t: float, y: np.ndarray) -> np.ndarray:
        out = np.zeros_like(y)
        rhs(t, y, out, parameters)
        return out

    projection = ProjectionOptions(
        **given,
        direction=direction,
        iterations=iterations,
        every=every,
        reuse_f=reuse_f,
        check=check,
        project_initial=project_initial,
    )
    run = _setup.prepare(
        tableau, derivative, t0, start, f0, h, projection, rtol, atol, extra=extra, compensated=compensated
    )
    record = Diagnostics() if diagnostics is None else diagnostics
    _setup.attach(record, run)
    functions, why_not = _functions(fun, in_place, extra, run.invariants, start.dtype, compiled, rhs)
    driver = _Driver(run, grid, functions, parameters, compiled=why_not is None)
    rhs(t0, driver.state, run.work.K[0], parameters)
    run.work.counters[NFEV] = 1
    loop = _Loop(driver, record, callback, progress, method.__name__, why_not)
    return loop.run()


class _Loop:
    """Drives chunks of steps: time, progress, callbacks, and what is kept when something goes wrong."""

    def __init__(
        self,
        driver: _Driver,
        diagnostics: Diagnostics,
        callback: Callable[..., Any] | None,
        progress: bool,
        method: str,
        why_not: str | None,
    ) -> None:
        self.driver, self.diagnostics, self.callback, self.progress = driver, diagnostics, callback, progress
        self.method, self.why_not = method, why_not
        self.wall_time = 0.0

    def run(self) -> IntegrationResult:
        driver = self.driver
        begin = time.perf_counter()
        try:
            with _bar(self.progress, driver.grid.n_steps, self.method) as bar:
                status, message = self._steps(bar)
        except BaseException as error:
            self.wall_time = time.perf_counter() - begin
            driver.save_last()
            error.partial = self._result(-1, f"interrupted by {type(error).__name__}")  # type: ignore[attr-defined]
            raise
        self.wall_time = time.perf_counter() - begin
        if status != 0:
            driver.save_last()
        return self._result(status, message)

    def _steps(self, bar: Any) -> tuple[int, str]:
        driver = self.driver
        driver.save_start()
        if self._stopped_by_callback(0):
            return 1, "stopped by the callback"
        chunk = FIRST_CHUNK
        while driver.step < driver.grid.n_steps:
            k, rows, begin = driver.step, driver.rows, time.perf_counter()
            code = driver.advance(min(k + self._chunk(chunk), driver.grid.n_steps))
            seconds = time.perf_counter() - begin
            bar.update(driver.step - k)
            if code != OK:
                return -1, self._failure(code)
            if self._stopped_by_callback(rows):
                return 1, "stopped by the callback"
            # At most a doubling, so that one fast chunk cannot make a slow one long.
            chunk = max(1, min(2 * chunk, int(chunk * CHUNK_SECONDS / max(seconds, 1e-9))))
        return 0, "reached the end of the interval"

    def _chunk(self, chunk: int) -> int:
        """Steps of the next call: with a callback, none beyond the next saved one."""
        if self.callback is None:
            return chunk
        grid = self.driver.grid
        if grid.t_eval.size:
            return 1
        if grid.save_every == 0:
            return chunk
        return min(chunk, grid.save_every - self.driver.step % grid.save_every)

    def _stopped_by_callback(self, first_row: int) -> bool:
        if self.callback is None:
            return False
        driver = self.driver
        for row in range(first_row, driver.rows):
            t, y = float(driver.t[row]), driver.y[row].copy()
            invariants = driver.run.invariants
            if self.callback(t, y, invariants.values(t, y) - invariants.target):
                return True
        return False

    def _failure(self, code: int) -> str:
        driver = self.driver
        t, run = driver.time_of(driver.step), driver.run
        t_new = driver.time_of(driver.step + 1)
        if code == NOT_FINITE:
            return _setup.not_finite(run.work, run.method, t, t_new - t)
        return _setup.projection_failure(run.invariants, run.work, t_new)

    def _result(self, status: int, message: str) -> IntegrationResult:
        driver = self.driver
        rows, invariants, counters = driver.rows, driver.run.invariants, driver.run.work.counters
        values = driver.values()
        max_defect = driver.run.work.max_defect
        if rows:
            np.fmax(
                max_defect, np.nanmax(np.abs(values - invariants.target[:, None]), axis=1, initial=0), out=max_defect
            )
        if self.why_not is not None:
            message = f"{message} (interpreted: {self.why_not})"
        return IntegrationResult(
            t=driver.t[:rows],
            y=driver.y[:rows].T,
            invariants=values,
            max_defect=max_defect,
            diagnostics=self.diagnostics,
            t_events=None,
            y_events=None,
            nfev=int(counters[NFEV]),
            njev=int(counters[NJEV]),
            nlu=int(counters[NLU]),
            status=status,
            message=message,
            success=status >= 0,
            wall_time=self.wall_time,
            compiled=self.why_not is None,
            method=self.method,
            h=abs(driver.grid.h),
        )


def _bar(progress: bool, total: int, label: str) -> Any:
    from tqdm import tqdm

    return tqdm(total=total, desc=label, unit="step", unit_scale=True, disable=not progress, smoothing=0.05)


def _required(name: str, value: Any) -> Any:
    if value is None:
        raise TypeError(f"integrate: {name} is missing; only a Problem brings its own.")
    return value


def _tableau(method: Any) -> Any:
    if not (isinstance(method, type) and issubclass(method, EIPSolver) and hasattr(method, "TABLEAU")):
        raise TypeError(
            f"integrate: method must be an EIP class such as EIPRK4, or eip_method(tableau); got {method!r}."
        )
    if method._project_step is not EIPSolver._project_step:
        raise TypeError(f"integrate does not call {method.__name__}._project_step; use it through solve_ivp.")
    return method.TABLEAU


def _span(t_span: Any) -> tuple[float, float]:
    try:
        t0, t_bound = map(float, _required("t_span", t_span))
    except (TypeError, ValueError):
        raise ValueError(f"t_span must hold two numbers, got {t_span!r}.") from None
    if not (math.isfinite(t0) and math.isfinite(t_bound)):
        raise ValueError(f"t_span must be finite, got {t_span!r}.")
    return t0, t_bound


def _parameters(params: Any) -> np.ndarray:
    try:
        return np.ascontiguousarray(params, dtype=float).reshape(-1)
    except (TypeError, ValueError):
        raise TypeError(f"params must be an array of numbers, got {params!r}.") from None


def _with_run_params(item: Invariant, params: Any) -> Invariant:
    """The invariant with `params` taken out of its args, where they are all it has: the run passes them."""
    if params is None or len(item.args) != 1 or not np.array_equal(item.args[0], params):
        return item
    bare = Invariant.__new__(Invariant)
    bare.__dict__.update(item.__dict__, args=())
    return bare


def _grid(t0: float, t_bound: float, h: float, save_every: Any, t_eval: Any) -> Grid:
    n_steps = int(_setup.fixed_steps(h, t0, t_bound))
    sign = -1.0 if t_bound < t0 else 1.0
    times = np.zeros(0)
    if t_eval is not None:
        if save_every is not None:
            raise ValueError("give save_every or t_eval, not both.")
        times = _evaluation_times(t_eval, t0, t_bound, sign)
    every = 0 if save_every is None else _setup.count("save_every", save_every)
    return Grid(t0, sign * h, t_bound, n_steps, every, times, np.zeros(2, np.int64))


def _evaluation_times(t_eval: Any, t0: float, t_bound: float, sign: float) -> np.ndarray:
    times = np.array(t_eval, dtype=float)
    if times.ndim != 1 or times.size == 0:
        raise ValueError("`t_eval` must be 1-dimensional and not empty.")
    if not np.isfinite(times).all():
        raise ValueError("t_eval must be finite.")
    if np.any(times < min(t0, t_bound)) or np.any(times > max(t0, t_bound)):
        raise ValueError("Values in `t_eval` are not within `t_span`.")
    if np.any(sign * np.diff(times) <= 0):
        raise ValueError("Values in `t_eval` are not properly sorted.")
    return times


def _check_memory(grid: Grid, y0: np.ndarray, max_bytes: float | None) -> None:
    bound = 0.5 * free_memory() if max_bytes is None else max_bytes
    needed = saved_rows(grid) * (y0.nbytes + 8)
    if needed > bound:
        raise MemoryError(
            f"saving {saved_rows(grid):.3g} states of {y0.size} components needs {needed / 1e9:.3g} GB, the bound is "
            f"{bound / 1e9:.3g} GB; raise save_every (or max_bytes)."
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


def _interpreted_rhs(fun: Callable[..., Any], in_place: bool, extra: tuple, y0: np.ndarray) -> Callable[..., None]:
    """The user's right-hand side as Python calls it, its values checked."""
    n, dtype, shape = y0.size, y0.dtype, y0.shape
    if in_place:

        def rhs(t: float, y: np.ndarray, out: np.ndarray, params: np.ndarray) -> None:
            fun(t, y, out, *extra)

    else:

        def rhs(t: float, y: np.ndarray, out: np.ndarray, params: np.ndarray) -> None:
            f = fun(t, y.copy(), *extra)
            out[:] = (
                f
                if type(f) is np.ndarray and f.shape == shape and f.dtype == dtype
                else _setup.as_derivative(f, n, dtype)
            )

    return rhs


def _functions(
    fun: Callable[..., Any],
    in_place: bool,
    extra: tuple,
    invariants: InvariantSet,
    dtype: np.dtype,
    compiled: bool | None,
    rhs: Callable[..., None],
) -> tuple[CompiledFunctions, str | None]:
    """The three functions of the step, and why they are not compiled (None: they are)."""
    interpreted = CompiledFunctions(rhs, invariants.inv, invariants.grad)
    if compiled is False:
        return interpreted, "compiled=False"
    try:
        return compile_functions(fun, in_place, bool(extra), invariants, dtype), None
    except NotCompilableError as reason:
        if compiled:
            raise
        return interpreted, str(reason)
