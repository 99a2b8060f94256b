"""`ensemble`: many runs of one system, with different initial states or parameters."""

from __future__ import annotations

import dataclasses
import math
import os
import time
import uuid
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Executor
from contextlib import ExitStack, closing, nullcontext
from functools import partial
from importlib import import_module
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike

from ..checkpoint.locks import absolute
from ..checkpoint.signals import sigterm_as_ctrl_c
from ..core.conserved import NEAR_DISTANCE
from ..core.events import Events
from ..core.functions import PointerFunction, extra_arguments, floats, is_compiled, parameter_values
from ..core.gradients import unless_error
from ..core.inputs import count, flag, is_number, shown, states
from ..core.invariants import as_invariants
from ..core.linear import confirmed
from ..core.names import nearest
from ..core.options import ProjectionDetails, ProjectionOptions
from ..core.problem import Problem
from ..core.solvers import EIPRK4, EIPSolver
from ..core.tangent_vectors import TangentVectors
from ..engine.data import N_COUNTERS, NFEV, NJEV, NLU, REJECTED
from ..engine.trust import ProjectionWarning
from ..run.fields import Field, component_names, distinct, time_name
from ..run.figures import steps
from ..run.memory import check_bytes, most_bytes
from ..run.prepare import DEFAULT, RunArguments, default_method
from ..run.results import Result
from ..run.tables import dataset
from .checkpoints import EnsembleFile
from .chunks import Chunk, Part, Pool, cores, run_elsewhere, thread_pool
from .reduction import placed
from .side_by_side import LANES
from .tasks import FAILED, NOT_RUN, Members, Plan, Task

__all__ = ["EnsembleResult", "ensemble"]

CHUNK_STEPS = 2_000_000
INTERPRETED_STEPS = 20_000
UNKNOWN_STEPS = 10_000
CHUNK_BYTES = 4e6
LARGEST_CHUNK = 4096
LEAST_CHUNKS = 16
LEAST_OCTETS = 4  # of members in a chunk
TRIED = 8
SHOWN = 5
# Fields of a request that an ensemble handles itself, those that it does not have, and its own parameters.
HANDLED = {"fun", "acceleration", "t_span", "params", "callback", "max_bytes", "progress"}
ALONE = HANDLED | {"y0", "diagnostics", "projection"}
# Fields of `Members` that are fields of the result.
SAME = ("y", "t", "status", "message", "max_residual", "max_correction", "side_by_side", "trusted", "target")
OWN = ("y0s", "executor", "reduce", "checkpoint", "checkpoint_every", "resume", "chunk", *sorted(HANDLED))


class EnsembleKeywords(ProjectionDetails, total=False):
    """The options of `integrate` that `ensemble` passes on, for type checkers."""

    args: Iterable[Any] | None
    in_place: bool
    jacobian: Callable[..., Any] | None
    jac: Any
    events: Any
    dense_output: bool
    compiled: bool | None
    rtol: ArrayLike
    atol: ArrayLike
    first_step: float | None
    max_step: float
    variations: Any
    jvp: Callable[..., Any] | None
    symplectic: bool | None


FIELDS = {
    "y": Field(("member", "component")),
    "t": Field(("member",), table="t_end"),
    "target": Field(("member", "invariant")),
    "max_residual": Field(("member", "invariant")),
    "trajectories": Field(("member", "component", "time"), table="states"),
    "invariants": Field(("member", "invariant", "time")),
    **dict.fromkeys(("status", "message", "trusted", "max_correction"), Field(("member",))),
    **dict.fromkeys(("nfev", "njev", "nlu", "n_rejected_projections"), Field(("member",))),
    **dict.fromkeys(("method", "h", "success", "stopped", "wall_time"), Field(())),
}
END_INVARIANTS = Field(("member", "invariant"), table="end_invariants")  # if trajectories are not saved


class EnsembleResult(Result):
    """Result of `ensemble`; fields are accessible by attribute or by key, as in SciPy's results.

    Attributes
    ----------
    y : ndarray, shape (members, n)
        Last states: at the end of the interval, or before a member failed.
    t : ndarray, shape (members,)
        Times of the last states.
    status : ndarray, shape (members,)
        0: the end was reached; 1: an event ended the member; -1: it failed; -2: it did not run (in the partial result
        of an interrupted ensemble).
    message : ndarray of str, shape (members,)
        Reason for the end of each member.
    failed : ndarray
        Indices of the members with status -1.
    success : bool
        True if all members ran and none failed.
    max_residual : ndarray, shape (members, l)
        Largest invariant error ``|I - target|`` after a projection; each member has its own target.
    max_correction : ndarray, shape (members,)
        Largest correction in units of the local error; nan if the method has no error estimate.
    side_by_side : ndarray of bool, shape (members,)
        True for members that ran vectorised, in a batch with others, which is several times faster; the page on
        ensembles in the documentation lists the conditions.
    one_by_one : str
        Reason why members ran one after the other instead of vectorised; "" if they were vectorised. Single members
        that a batch could not finish may have run alone even then, see `side_by_side`.
    trusted : ndarray of bool, shape (members,)
        True for members that did not fail and are reliable, as in `IntegrationResult`; otherwise `message` says why.
    names : tuple of str
        Names of the l invariants.
    nfev, njev, nlu, n_rejected_projections : ndarray, shape (members,)
        Evaluations of the right-hand side and of the gradients, factorisations, and rejected projections.
    times : ndarray, shape (m,)
        Times of the saved states; empty if no states are saved.
    trajectories : ndarray or None, shape (members, n, m)
        Saved states; nan after the end of a member that ended early. None if no states are saved or ``reduce=`` was
        given.
    invariants : ndarray, shape (members, l) or (members, l, m)
        Values of the invariants in the saved states if `trajectories` has them, else in the last states.
    target : ndarray, shape (members, l)
        Values to which the invariants of each member were projected.
    t_events, y_events : list of list of ndarray, or None
        If there are events, ``t_events[k]`` and ``y_events[k]`` are those of member k, as in
        `scipy.integrate.solve_ivp`: one array for each event.
    reduced : ndarray or None, shape (members, ...)
        Value of the function ``reduce=`` for each member, nan for members that failed or did not run. None without
        ``reduce=``.
    variations : ndarray, shape (members, n, k) or (members, m, n, k)
        Columns of derivatives if ``variations=`` was given, in the saved states if `trajectories` has them, else in the
        last states. `stm` and `sensitivities` are parts of it; `columns` is as in `IntegrationResult`.
    first : int
        Number of the first member; it is 0 except in the results that a `callback` receives.
    stopped : bool
        True if the callback stopped the ensemble.
    wall_time : float
        Run time in seconds.
    method : str
        Name of the method.
    h : float or None
        Step size; None for adaptive steps.
    chunk : int
        Number of members in a chunk.
    """

    COMPONENTS = 1
    status: np.ndarray
    message: np.ndarray
    failed: np.ndarray
    success: bool
    max_residual: np.ndarray
    max_correction: np.ndarray
    side_by_side: np.ndarray
    one_by_one: str
    trusted: np.ndarray
    names: tuple[str, ...]
    nfev: np.ndarray
    njev: np.ndarray
    nlu: np.ndarray
    n_rejected_projections: np.ndarray
    times: np.ndarray
    trajectories: np.ndarray | None
    invariants: np.ndarray
    target: np.ndarray
    t_events: list[list[np.ndarray]] | None
    y_events: list[list[np.ndarray]] | None
    reduced: np.ndarray | None
    first: int
    stopped: bool
    wall_time: float
    method: str
    h: float | None
    chunk: int

    def to_xarray(self, names: Any = None) -> Any:
        """Return the members as an `xarray.Dataset`.

        Parameters
        ----------
        names : sequence of str or str, optional
            As for `eip_scipy.results.to_xarray`.

        Returns
        -------
        xarray.Dataset
            Dataset with ``y`` (member, component), ``t_end``, ``status``, ``message``, ``trusted``, ``max_correction``
            (member), ``max_residual``, ``target`` (member, invariant), and the counts. If trajectories are in memory,
            also ``states`` (member, component, time) and ``invariants`` (member, invariant, time); otherwise
            ``end_invariants`` (member, invariant).

        Raises
        ------
        ImportError
            If xarray is missing: ``pip install "eip_scipy[xarray]"``.
        """
        components = component_names(self, names, self.y.shape[1])
        coordinates = {
            "member": self.first + np.arange(self.t.size),
            "component": list(components),
            "invariant": distinct(self.names),
        }
        if self.trajectories is None:
            data = dataset(self, FIELDS | {"invariants": END_INVARIANTS}, coordinates)
        else:
            data = dataset(self, FIELDS, coordinates | {"time": self.times})
        if (time := time_name(components)) != "t":
            data = data.rename({"t_end": f"{time}_end", **({"time": time} if "time" in data.dims else {})})
        return data

    def plot(self, names: Any = None) -> Any:
        """Draw the ensemble: its states, the errors of the invariants, and how its members ended.

        Parameters
        ----------
        names : sequence of str or str, optional
            As for `eip_scipy.results.to_xarray`.

        Returns
        -------
        matplotlib.figure.Figure
            For each component the median of the members in time, with bands that contain 50 % and 90 % of them; if some
            end early, of those that are still running, as the legend says. If no states are saved, the distribution of
            the last states. Further panels show the largest error of each invariant in each member, and how many
            members reached the end, were ended by an event, are not to be trusted, failed or did not run. A notebook
            shows the figure automatically.

        Raises
        ------
        ImportError
            If matplotlib is missing: ``pip install "eip_scipy[plot]"``.
        """
        from ..plotting.ensembles import ensemble_figure

        return ensemble_figure(self, names)

    def __repr__(self) -> str:
        ran = int(np.count_nonzero(self.status != NOT_RUN))
        members, n = self.y.shape
        lines = [
            f"Ensemble: {members} members of {n} components, {steps(self)}; {ran} ran in "
            f"{self.wall_time:.3g} s, {np.count_nonzero(self.side_by_side)} vectorised, "
            f"{self.failed.size} failed"
        ]
        if self.one_by_one:
            lines.append(f"  not vectorised: {self.one_by_one}")
        width = max((len(name) for name in self.names), default=0)
        for name, residuals in zip(self.names, self.max_residual[self.status >= 0].T, strict=True):
            if residuals.size:
                lines.append(
                    f"  {name:<{width}}  largest error {residuals.max():.2e}, median {np.median(residuals):.2e}"
                )
        doubtful = np.flatnonzero((self.status >= 0) & ~self.trusted)
        for those, what in ((self.failed, ".failed"), (doubtful, ".trusted")):
            lines += [f"  member {self.first + k}: {self.message[k]}" for k in those[:SHOWN]]
            if those.size > SHOWN:
                lines.append(f"  ... and {those.size - SHOWN} more: {what}, .message")
        return "\n".join(lines)


def ensemble(
    fun: Callable[..., Any] | Problem | None = None,
    t_span: Any = None,
    y0s: Any = None,
    *,
    acceleration: Any = None,
    params: Any = None,
    method: type[EIPSolver] | None = None,
    h: float | None = DEFAULT,
    invariants: Any = DEFAULT,
    executor: Any = None,
    save_every: int | None = None,
    t_eval: Any = None,
    reduce: Callable[[Any], Any] | None = None,
    callback: Callable[[EnsembleResult], Any] | None = None,
    checkpoint: Any = None,
    checkpoint_every: float = 60.0,
    resume: bool = False,
    chunk: int | None = None,
    progress: bool = False,
    max_bytes: float | None = None,
    **keywords: Unpack[EnsembleKeywords],
) -> EnsembleResult:
    """Integrate many members of one system: compiled, on all cores, or on a cluster.

    Each member agrees bit by bit with its own `integrate`, for any kind and number of workers. A member that fails is
    reported with its index and the reason, and does not affect the others.

    Parameters
    ----------
    fun : callable or Problem
        As for `integrate`.
    t_span : (float, float)
        Start and end, the same for all members.
    y0s : array_like, shape (members, n)
        Initial states; one state (n,) for all if `params` has a row for each member. Default: the initial state of a
        `Problem`.
    acceleration : callable, optional
        Instead of `fun`, as for `integrate`.
    params : array_like of float, shape (p,) or (members, p), optional
        Parameters of all members, or of each. One number k[i] for each member is ``params=k[:, None]``, because an
        array (p,) is common to all members; for a `Problem` with a single parameter also ``params=k``. For a problem
        that names its parameters also a mapping from names to one value or to one value for each member, as in
        ``params={"k": [1.0, 2.0]}``.
    method : type, optional
        As for `integrate`. Default: the method of the problem, if it has one, else `EIPRK4`.
    h : float, optional
        As for `integrate`: the step; None for adaptive steps. Default: adaptive if rtol, atol, first_step or max_step
        is given, else the step of the problem.
    invariants : Invariant or sequence of Invariant, optional
        Invariants to keep: each member keeps the values at its own start. If `params` differ, the functions receive the
        parameters as the last argument and must have no args.
    executor : None, int, "dask", distributed.Client or concurrent.futures.Executor, optional
        Where members run. None: threads on all cores. A number: this number of threads. If functions are not compiled:
        one thread. A client or an executor, such as ``mpi4py.futures.MPIPoolExecutor()``: its workers. "dask": the
        configured Dask cluster (``DASK_SCHEDULER_ADDRESS``), or a local cluster with one process for each core; see
        `eip_scipy.integrations.dask`.
    save_every : int, optional
        Save every `save_every`-th step of each member in ``.trajectories``; fixed steps only.
    t_eval : array_like, optional
        Times to save at instead, the same for all members.
    reduce : callable, optional
        ``reduce(result) -> float or array``, called with the result of each member that did not fail. The result has
        the fields of `integrate`, with the same bits, except `diagnostics`, `sol`, `calls` and `wall_time`. The values
        are stacked in ``.reduced``; trajectories are not kept.
    callback : callable, optional
        ``callback(part)``, called after each chunk of members, in order, with an `EnsembleResult` of that chunk; return
        True to stop.
    checkpoint : path-like, optional
        File that stores finished members, see `eip_scipy.checkpoint`. It is written every `checkpoint_every` seconds,
        and when the ensemble ends or is interrupted.
    checkpoint_every : float, optional
        Seconds from one checkpoint to the next; longer if writing would take more than 5 % of the time.
    resume : bool, optional
        Continue with the members that `checkpoint` does not contain, with the same arguments: the result agrees bit by
        bit with that of an ensemble without interruption. If there is no file, start at the beginning.
    chunk : int, optional
        Number of members that run together; results do not depend on it.
    progress : bool, optional
        Show a progress bar with the remaining time.
    max_bytes : float, optional
        Bound on the memory for results in bytes; default: half of the free memory.
    **keywords
        Options of `integrate`: args (the same for all), in_place, events, compensated, compiled, metric, blocks,
        linear_invariants, direction, iterations, every, reuse_f, check, project_initial, rtol, atol, first_step,
        max_step, variations, jvp, symplectic. Linear invariants are found at the start of the first member; they are
        kept if they hold for the parameters of all members. Members with derivatives run one after the other, and so do
        those with an invariant that depends on times far from 0. Events are stored for each member in
        ``.t_events`` and ``.y_events``; a terminal event ends its member. `check` examines one member.

    Returns
    -------
    EnsembleResult
        ``y`` (members, n), ``status``, ``message``, ``max_residual`` (members, l), ``t``, and more.

    Raises
    ------
    TypeError, ValueError
        If an argument is wrong, or none of up to 8 members, spread over all, can start; the errors are then those of
        `integrate`.
    MemoryError
        If results would need more than `max_bytes`.
    CheckpointError
        If `checkpoint` exists without ``resume=True``, is damaged, belongs to other arguments or functions, or is used
        by another ensemble.

    Notes
    -----
    Members run in chunks, which are collected in order. If the ensemble is interrupted (Ctrl-C, or an exception raised
    by `callback` or `reduce`), the attribute ``partial`` of the exception is the result up to that point.

    Examples
    --------
    >>> import numpy as np
    >>> from eip_scipy import ensemble
    >>> from eip_scipy.problems import kepler
    >>> problem = kepler()
    >>> starts = problem.y0 * np.linspace(0.99, 1.01, 5)[:, None]
    >>> run = ensemble(problem, (0, 20), starts)
    >>> run.y.shape, run.success, bool((run.max_residual < 1e-11).all())
    ((5, 4), True, True)
    """
    options: dict[str, Any] = dict(keywords)
    _check_options(options)
    _check_choices(reduce, callback, progress, max_bytes)
    if invariants is not DEFAULT:
        options["invariants"] = invariants
    checkpoint = _place(checkpoint, checkpoint_every, resume)
    everyone = _inputs(fun, y0s, params, options)
    total = len(everyone.y0s)
    method = default_method(fun) or EIPRK4 if method is None else method
    common = {"method": method, "h": h, "save_every": save_every, "t_eval": t_eval, **options}
    common["acceleration"] = acceleration
    request = RunArguments.of(fun=_bare(fun), t_span=t_span, y0=everyone.y0s[0], params=everyone.params[0], **common)
    request = request.with_pointers()
    if request.args is not None or not everyone.params.shape[1]:
        request = request._replace(params=None)
    plan = _first_that_starts(Task(request, total, reduce), everyone)
    everyone = everyone._replace(y0s=np.ascontiguousarray(everyone.y0s, plan.dtype))
    given = fun if acceleration is None else acceleration
    size = _chunk_size(plan, total, given) if chunk is None else count("chunk", chunk)
    _check_memory(plan, total, max_bytes)
    file = None if checkpoint is None else EnsembleFile(checkpoint, checkpoint_every, resume, plan, everyone)
    with nullcontext() if file is None else sigterm_as_ctrl_c(), nullcontext() if file is None else closing(file):
        gathered = _Gathered(plan, everyone, size, file, callback)
        result = gathered.run(partial(_pool, executor, plan, progress), progress)
    _warn(result, np.flatnonzero((result.status >= 0) & ~result.trusted))
    return result


def _check_choices(reduce: Any, callback: Any, progress: Any, max_bytes: Any) -> None:
    for name, given, form in (("reduce", reduce, "reduce(result)"), ("callback", callback, "callback(part)")):
        if given is not None and not callable(given):
            raise TypeError(f"{name} must be a function {form}, got {shown(given)}.")
    flag("progress", progress)
    check_bytes(max_bytes)


def _warn(result: EnsembleResult, doubtful: np.ndarray) -> None:
    """Warn about the members with the indices `doubtful`, which are not to be trusted."""
    if not doubtful.size:
        return
    k = int(doubtful[0])
    try:
        warnings.warn(
            f"{doubtful.size} of {result.t.size} members are not to be trusted (see .trusted and .message of the "
            f"result), the first of them member {k}: {result.message[k]}",
            ProjectionWarning,
            stacklevel=3,
        )
    except ProjectionWarning as error:
        error.partial = result  # type: ignore[attr-defined]
        raise


class _Gathered:
    """The finished members so far, from which the result is made.

    `everyone` has the inputs of all members, `chunk` is the number of members in a chunk, and `file` is the checkpoint,
    if there is one.
    """

    def __init__(
        self,
        plan: Plan,
        everyone: Chunk,
        chunk: int,
        file: EnsembleFile | None,
        callback: Callable[[EnsembleResult], Any] | None,
    ) -> None:
        self.plan, self.everyone, self.chunk, self.file, self.callback = plan, everyone, chunk, file, callback
        self.method = plan.task.request.method.__name__
        self.whole = plan.empty(len(everyone.y0s), plan.held)
        self.reduced: np.ndarray | None = None
        self.stopped, self.one_by_one = False, ""
        self._begin = time.perf_counter()

    def run(self, pool: Callable[[], Pool], progress: bool) -> EnsembleResult:
        """Run all chunks that are not stored yet in the pool that ``pool()`` makes, and return the result."""
        from tqdm import tqdm

        done, total = 0, len(self.whole.t)
        if self.file is not None and self.file.finished:
            done = self.file.finished
            self._take(0, Part(self.file.members, self.file.reduced))
        chunks = (self.everyone.part(first, first + self.chunk) for first in range(done, total, self.chunk))
        shown: dict[str, Any] = {"desc": self.method, "unit": "member", "unit_scale": True, "disable": not progress}
        try:
            if done < total:
                with tqdm(total=total, initial=done, **shown) as bar:
                    self._gather(pool(), chunks, bar)
        except BaseException as error:
            error.partial = self._of(self.whole, self.reduced, 0)  # type: ignore[attr-defined]
            raise
        return self._of(self.whole, self.reduced, 0)

    def _gather(self, pool: Pool, chunks: Iterator[Chunk], bar: Any) -> None:
        with ExitStack() as stack:
            stack.callback(pool.close)
            if self.file is not None:
                stack.callback(self.file.flush)  # first, because the process may be killed soon
            for chunk, part in pool.in_order(chunks):
                self._take(chunk.first, part)
                done = chunk.first + len(part.members.t)
                if self.file is not None:
                    self.file.write(done, self.whole, self.reduced)
                bar.update(len(part.members.t))
                if self.callback is not None and self.callback(self._of(part.members, part.reduced, chunk.first)):
                    self.stopped = True
                    return

    def _take(self, first: int, part: Part) -> None:
        members, last = part.members, first + len(part.members.t)
        if part.reduced is not None:
            self.reduced = placed(self.reduced, len(self.whole.t), slice(first, last), part.reduced)
        for name, whole in self.whole._asdict().items():
            whole[first:last] = getattr(members, name)
        self.one_by_one = part.one_by_one or self.one_by_one

    def _of(self, members: Members, reduced: np.ndarray | None, first: int) -> EnsembleResult:
        plan, counters = self.plan, members.counters
        trajectories = members.saved.swapaxes(1, 2) if plan.held else None
        if reduced is None and plan.task.reduce is not None:  # all members failed
            reduced = np.full(len(members.t), np.nan)
        result = EnsembleResult(
            {name: getattr(members, name) for name in SAME},
            failed=np.flatnonzero(members.status == FAILED),
            success=bool((members.status >= 0).all()),
            one_by_one=self.one_by_one,
            names=plan.names,
            nfev=counters[:, NFEV],
            njev=counters[:, NJEV],
            nlu=counters[:, NLU],
            n_rejected_projections=counters[:, REJECTED],
            times=plan.times if plan.is_saving else np.zeros(0),
            trajectories=trajectories,
            invariants=members.values if trajectories is None else members.saved_values.swapaxes(1, 2),
            t_events=members.t_events if plan.events else None,
            y_events=members.y_events if plan.events else None,
            reduced=reduced,
            first=first,
            stopped=self.stopped,
            wall_time=time.perf_counter() - self._begin,
            method=self.method,
            h=plan.h,
            chunk=self.chunk,
            component_names=plan.ready.problem.component_names,
        )
        if plan.variations is not None:
            _separate(result, plan.ready.tangents)
            result["columns"] = plan.ready.problem.described_columns
        return result


def _separate(result: EnsembleResult, tangents: TangentVectors) -> None:
    """Separate the states of a result from the tangent vectors, in place."""
    result["y"], result["variations"] = tangents.split(result.y)
    if result.trajectories is not None:
        rows, result["variations"] = tangents.split(result.trajectories.swapaxes(1, 2))
        result["trajectories"] = rows.swapaxes(1, 2)
    if result.y_events is not None:
        result["y_events"] = [[tangents.state(rows) for rows in member] for member in result.y_events]


def _check_options(options: dict[str, Any]) -> None:
    known = set(RunArguments._fields) - ALONE | set(ProjectionOptions.names())
    for name in options:
        if name not in known:
            raise TypeError(f"ensemble() has no option {name!r}{nearest(name, (*OWN, *known))}")
    Events(options.get("events"))  # raises an error if they are wrong


def _place(checkpoint: Any, every: Any, resume: Any) -> str | None:
    """Return `checkpoint` as an absolute path after checks, so that the working directory may change."""
    if not is_number(every, "checkpoint_every") or not every > 0:
        raise ValueError(f"checkpoint_every must be a number of seconds > 0, got {shown(every)}.")
    flag("resume", resume)
    if checkpoint is not None and not isinstance(checkpoint, (str, os.PathLike)):
        raise TypeError(f"checkpoint must be a path, got {checkpoint!r}.")
    if resume and checkpoint is None:
        raise ValueError("resume=True needs a file to resume from: pass checkpoint=.")
    return None if checkpoint is None else absolute(checkpoint)


def _inputs(fun: Any, y0s: Any, params: Any, options: dict[str, Any]) -> Chunk:
    """Return all members as one `Chunk`: states (m, n) and parameters (m, p), p = 0 if there are none."""
    problem = fun if isinstance(fun, Problem) else None
    if y0s is None:
        y0s = None if problem is None else problem.y0
        if y0s is None:
            raise TypeError("ensemble: y0s is missing; it can be omitted only for a Problem with an initial state.")
    starts = states("y0s", y0s)
    if problem is not None and isinstance(params, Mapping):
        params = problem.named_parameters(params)
    own = None if params is None else np.atleast_1d(parameter_values(params))
    if own is not None and own.ndim == 1 and own.size > 1 and problem is not None and _takes_one_parameter(problem):
        own = own[:, None]  # one for each member, because they cannot be common to all
    if starts.ndim == 1 and own is not None and own.ndim == 2:
        starts = np.tile(starts, (len(own), 1))
    if starts.ndim != 2 or starts.size == 0:
        raise ValueError(
            f"y0s must have the shape (members, n), got {starts.shape}; one state (n,) is possible only if params has "
            "a row for each member."
        )
    if own is None:
        brought = None if problem is None or problem.rhs is None else problem.params
        own = np.zeros(0) if brought is None else np.asarray(brought, float).reshape(-1)
    elif own.ndim == 2 and len(own) != len(starts):
        raise ValueError(
            f"params has {len(own)} rows for {len(starts)} members; give one row for each member, or one for all."
        )
    elif own.ndim > 2:
        raise ValueError(f"params must have the shape (p,) or (members, p), got {own.shape}.")
    if own.ndim == 2 and any(item.args for item in as_invariants(options.get("invariants", ()))):
        raise ValueError(
            "ensemble: invariants must not have args if params differ between members: omit args; the functions "
            "receive the params of each member as their last argument."
        )
    if options.get("args") is not None:
        own = floats(extra_arguments(options["args"], params))
    return Chunk(0, starts, own if own.ndim == 2 else np.broadcast_to(own, (len(starts), own.size)))


def _takes_one_parameter(problem: Problem) -> bool:
    return problem.params is not None and np.size(problem.params) == 1


def _bare(fun: Any) -> Any:
    """Return `fun`; if it is a problem with `rhs`, without its `fun` and `reference`, which may not be picklable."""
    if not isinstance(fun, Problem) or fun.rhs is None:
        return fun
    return dataclasses.replace(fun, fun=_not_called, reference=None)


def _not_called(t: float, y: np.ndarray) -> np.ndarray:
    raise NotImplementedError(
        "ensemble leaves out `fun` of a problem that has `rhs`, so that fun cannot be called here; call rhs(t, y, out, "
        "params) instead."
    )


def _first_that_starts(task: Task, everyone: Chunk) -> Plan:
    """Return the plan, made from the first member with a valid start; raise the first error if none has one.

    At most `TRIED` of the members `everyone`, spread over all, are tried. A finding of the checks at the start applies
    to all members with the same parameters.
    """
    first: Exception | None = None
    starts, params = everyone.y0s, everyone.params
    for k in np.unique(np.linspace(0, len(starts) - 1, TRIED).astype(int)):
        own = None if task.request.params is None else params[k].copy()
        request = task.request._replace(y0=starts[k].copy(), params=own)
        tried = dataclasses.replace(task, request=request)
        try:
            ready = tried.prepared(request.y0, own, check_start=True)
        except MemoryError:
            raise
        except Exception as error:
            first = first or error
        else:
            if found := ready.trust.message:
                ready.trust.doubts.clear()
                tried = dataclasses.replace(tried, doubt=(params[k].copy(), found))
            return _with_common_constraints(Plan(tried, ready), everyone)
    assert first is not None
    # A transposed y0s fails in the user's function, whose error may not explain that; jitted code explains nothing.
    first.add_note(
        f"ensemble: the rows of y0s are members; y0s has {len(starts)} rows of {starts.shape[1]} components."
    )
    raise first


def _with_common_constraints(plan: Plan, everyone: Chunk) -> Plan:
    """Return the plan whose members all keep the linear invariants that were found for its first member.

    If one of them does not hold for the parameters of some member, no member keeps any.
    """
    task, found = plan.task, plan.ready.conserved
    if found.found is None:
        return plan
    C = found.linear.C
    holds = len(C) > 0 and (task.request.params is None or _hold(plan, everyone))
    projection = {**task.request.projection, "linear_invariants": (C, C.T) if holds else None}
    task = dataclasses.replace(task, request=task.request._replace(projection=projection))
    return Plan(task, None if len(C) and not holds else plan.ready)


def _hold(plan: Plan, everyone: Chunk) -> bool:
    """Return True if the linear invariants of the first member hold for the parameters of all members."""
    ready, own = plan.ready, plan.ready.problem.parameters.copy()
    first = np.unique(everyone.params, axis=0, return_index=True)[1]
    if len(first) == 1 or ready.problem.variations is not None:
        return len(first) == 1
    y = everyone.y0s[first] * (1 + NEAR_DISTANCE * np.cos(np.arange(plan.size)))
    f = np.full(y.shape, np.nan)
    for k, member in enumerate(first):
        ready.problem.parameters[:] = everyone.params[member]
        f[k] = unless_error(ready.problem.derivative, plan.t0, y[k])
    ready.problem.parameters[:] = own
    return bool(confirmed(y, f, ready.conserved.linear).all())


def _chunk_size(plan: Plan, members: int, fun: Any) -> int:
    """Return the number of members in a chunk: at most about one second of work, and a multiple of `LANES`.

    `members` is the number of all members, and `fun` the right-hand side or a `Problem`. The returned number
    depends on the problem and on the number of members, and not on the number of workers.
    """
    rhs = fun.rhs or fun.fun if isinstance(fun, Problem) else fun
    native = is_compiled(rhs) or isinstance(rhs, PointerFunction)
    budget = CHUNK_STEPS if native and plan.task.request.compiled is not False else INTERPRETED_STEPS
    steps = plan.n_steps or UNKNOWN_STEPS
    by_work = budget * 4 / (steps * max(4, plan.size))
    by_bytes = CHUNK_BYTES / (plan.size * plan.dtype.itemsize * (1 + plan.times.size))
    size = min(by_work, by_bytes, LARGEST_CHUNK, math.ceil(members / LEAST_CHUNKS))
    return LANES * max(LEAST_OCTETS, math.ceil(size / LANES))


def _check_memory(plan: Plan, members: int, max_bytes: float | None) -> None:
    """Raise MemoryError if the results would need too much memory."""
    rows = plan.held
    each = plan.size * plan.dtype.itemsize * (1 + rows) + 8 * (len(plan.names) * (3 + rows) + N_COUNTERS + 4)
    bound = most_bytes(members * each, max_bytes)
    if members * each > bound:
        many = f"{rows} states per member would be stored. Save fewer (save_every, t_eval), use reduce="
        advice = many if rows else "The last state of each member would be stored. Run the members in parts"
        raise MemoryError(
            f"{members} members of {plan.size} components need {members * each / 1e9:.3g} GB, the bound is "
            f"{bound / 1e9:.3g} GB. {advice}, or raise max_bytes."
        )


def _pool(executor: Any, plan: Plan, progress: bool) -> Pool:
    """Return the pool that runs the chunks."""
    if executor is None or isinstance(executor, (int, np.integer)):
        plan.compile(progress=progress)
        threads = cores() if executor is None else count("executor", executor)
        return thread_pool(plan, threads if plan.why_not is None else 1)
    run = partial(run_elsewhere, plan.task, uuid.uuid4().hex)
    if isinstance(executor, Executor):
        return Pool(executor, run, partial(_workers, executor))
    if executor == "dask" or type(executor).__module__.partition(".")[0] == "distributed":
        if pointers := plan.ready.problem.pointers(plan.ready):
            raise pointers[0].unpicklable()  # Dask's own message for it is very long
        # Imported by name, because the integrations depend on this package and need further libraries.
        found, workers, end = import_module("eip_scipy.integrations.dask").connected(executor)
        return Pool(found, run, workers, end)
    raise TypeError(
        f"executor must be None, a number of threads, 'dask', a dask.distributed Client or an executor of "
        f"concurrent.futures, got {executor!r}."
    )


def _workers(executor: Executor) -> int:
    """Return the number of workers of an executor, of `mpi4py.futures` or of Python, or else the number of cores."""
    found = (getattr(executor, name, None) for name in ("num_workers", "_max_workers"))
    return next((number for number in found if isinstance(number, int) and number > 0), cores())
