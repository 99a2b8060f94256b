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
from ..core.arguments import extra_arguments, floats, parameter_values
from ..core.inputs import count, flag, is_number, shown
from ..core.invariants import as_invariants
from ..core.jitted import is_compiled
from ..core.names import nearest
from ..core.options import ProjectionDetails, ProjectionOptions
from ..core.pointers import PointerFunction
from ..core.problem import Problem, component_names
from ..core.solvers import EIPRK4, EIPSolver
from ..core.states import states
from ..core.variations import Columns
from ..engine.data import N_COUNTERS, NFEV, NJEV, NLU, REJECTED
from ..engine.trust import ProjectionWarning
from ..run.events import Events
from ..run.memory import check_bytes, most_bytes
from ..run.prepare import DEFAULT, Request, default_method
from ..run.results import WithColumns
from ..run.tables import dataset, default_names, to_dataframe
from .chunks import Chunk, FuturesPool, Part, Pool, ThreadPool, cores, finished, in_order, run_elsewhere
from .own_times import OwnTimes, own_times
from .side_by_side import LANES
from .statistics import Statistics, merge
from .store import CheckpointStore, Store, ZarrStore, location, require_same_functions
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
OWN = ("y0s", "executor", "reduce", "out", "checkpoint", "checkpoint_every", "resume", "chunk", *sorted(HANDLED))


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


class EnsembleResult(WithColumns):
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
    max_defect : ndarray, shape (members, l)
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
    times : ndarray, shape (m,) or (members, m)
        Times of the saved states; empty if no states are saved. If members have different times, there is one row for
        each member, padded with nan.
    trajectories : ndarray or zarr.Array or None, shape (members, n, m)
        Saved states; nan after the end of a member that ended early. None if no states are saved or they were reduced.
    invariants : ndarray or zarr.Array, shape (members, l) or (members, l, m)
        Values of the invariants in the saved states if `trajectories` has them, else in the last states.
    target : ndarray, shape (members, l)
        Values to which the invariants of each member were projected.
    t_events, y_events : list of list of ndarray, or None
        If there are events, ``t_events[k]`` and ``y_events[k]`` are those of member k, as in
        `scipy.integrate.solve_ivp`: one array for each event.
    statistics : Statistics or None
        Statistics over all members, if ``reduce=`` was given.
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
    component_names : tuple of str
        Names of the components from the `Problem`, or "y0", "y1" and so on.
    """

    y: np.ndarray
    t: np.ndarray
    status: np.ndarray
    message: np.ndarray
    failed: np.ndarray
    success: bool
    max_defect: np.ndarray
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
    trajectories: Any
    invariants: Any
    target: np.ndarray
    t_events: list[list[np.ndarray]] | None
    y_events: list[list[np.ndarray]] | None
    statistics: Statistics | None
    first: int
    stopped: bool
    wall_time: float
    method: str
    h: float | None
    chunk: int

    @property
    def component_names(self) -> tuple[str, ...]:
        """Names of the components of the state, (n,)."""
        given = self.get("component_names")
        return default_names(self.y.shape[1]) if given is None else tuple(given)

    def to_xarray(self, names: Any = None) -> Any:
        """Return the members as an `xarray.Dataset`.

        Parameters
        ----------
        names : sequence of str or str, optional
            As for `eip_scipy.results.to_xarray`.

        Returns
        -------
        xarray.Dataset
            Dataset with the names of the Zarr group that `out` writes, and more: ``y`` (member, component), ``t_end``,
            ``status``, ``message``, ``trusted``, ``max_correction`` (member), ``max_defect``, ``target`` (member,
            invariant), and the counts. If trajectories are in memory, also ``states`` (member, component, time) and
            ``invariants`` (member, invariant, time), with ``row`` and ``times`` (member, row) instead of ``time`` if
            members have different times; otherwise ``end_invariants`` (member, invariant). To open the group written
            by `out`, use ``xarray.open_zarr(out, consolidated=False)``.

        Raises
        ------
        ImportError
            If xarray is missing: ``pip install "eip_scipy[xarray]"``.
        """
        by_member = ("status", "trusted", "max_correction", "nfev", "njev", "nlu", "n_rejected_projections")
        variables: dict[str, Any] = {name: (("member",), self[name]) for name in by_member}
        variables["y"] = ("member", "component"), self.y
        variables["t_end"] = ("member",), self.t
        variables["message"] = ("member",), self.message.astype(str)
        variables["max_defect"] = ("member", "invariant"), self.max_defect
        variables["target"] = ("member", "invariant"), self.target
        if isinstance(self.invariants, np.ndarray) and self.invariants.ndim == 2:
            variables["end_invariants"] = ("member", "invariant"), self.invariants
        coordinates: dict[str, Any] = {
            "member": self.first + np.arange(self.t.size),
            "component": list(component_names(self.component_names if names is None else names, self.y.shape[1])),
            "invariant": list(self.names),
        }
        if isinstance(self.trajectories, np.ndarray):
            axis = "time" if self.times.ndim == 1 else "row"
            variables["states"] = ("member", "component", axis), self.trajectories
            variables["invariants"] = ("member", "invariant", axis), self.invariants
            if self.times.ndim == 1:
                coordinates["time"] = self.times
            else:
                variables["times"] = ("member", "row"), self.times
        attributes = {name: self[name] for name in ("method", "h", "success", "stopped", "wall_time")}
        return dataset(variables, coordinates, attributes)

    def to_dataframe(self, names: Any = None) -> Any:
        """Return the members as a `pandas.DataFrame`, see `eip_scipy.results.to_dataframe`."""
        return to_dataframe(self, names)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the result to a file that `eip_scipy.load` reads, see `eip_scipy.results.save`.

        Trajectories in the Zarr group of `out` stay there: after `load`, `trajectories` is None and `invariants` holds
        the values in the last states.
        """
        from ..run.saving import save

        save(self, path)

    def plot(self, names: Any = None) -> Any:
        """Draw the ensemble: its states, the errors of the invariants, and how its members ended.

        Parameters
        ----------
        names : sequence of str or str, optional
            As for `eip_scipy.results.to_xarray`.

        Returns
        -------
        matplotlib.figure.Figure
            For each component the median of all members in time, with bands that contain 50 % and 90 % of them; if no
            states are saved at common times, the distribution of the last states. Further panels show the largest error
            of each invariant in each member, and how many members reached the end, were ended by an event, are not to
            be trusted, failed or did not run. A notebook shows the figure automatically.

        Raises
        ------
        ImportError
            If matplotlib is missing: ``pip install "eip_scipy[plot]"``.
        """
        from .figures import plot

        return plot(self, names)

    def _packed(self) -> dict[str, Any]:
        """Return the fields in the form that `eip_scipy.results.save` accepts."""
        from .saving import packed

        return packed(self)

    @classmethod
    def _unpacked(cls, fields: dict[str, Any]) -> EnsembleResult:
        """Return a result from the output of `_packed`."""
        from .saving import unpacked

        return cls(unpacked(fields))

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), "plot", "save", "to_dataframe", "to_xarray"]

    def __repr__(self) -> str:
        ran = int(np.count_nonzero(self.status != NOT_RUN))
        step = "adaptive steps" if self.h is None else f"h = {self.h:g}"
        members, n = self.y.shape
        lines = [
            f"Ensemble: {members} members of {n} components, {self.method}, {step}; {ran} ran in "
            f"{self.wall_time:.3g} s, {np.count_nonzero(self.side_by_side)} vectorised, "
            f"{self.failed.size} failed",
        ]
        if self.one_by_one:
            lines.append(f"  not vectorised: {self.one_by_one}")
        width = max((len(name) for name in self.names), default=0)
        for name, defects in zip(self.names, self.max_defect[self.status >= 0].T, strict=True):
            if defects.size:
                lines.append(f"  {name:<{width}}  largest error {defects.max():.2e}, median {np.median(defects):.2e}")
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
    reduce: Any = None,
    callback: Callable[[EnsembleResult], Any] | None = None,
    out: Any = None,
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
    t_span : (float, float) or array_like, shape (members, 2)
        Start and end: the same for all members, or a row for each.
    y0s : array_like, shape (members, n)
        Initial states; one state (n,) for all if `params`, `t_span` or `t_eval` has a row for each member. Default: the
        initial state of a `Problem`.
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
    executor : None, int, "dask", distributed.Client, DaskExecutor or concurrent.futures.Executor, optional
        Where members run. None: threads on all cores. A number: this number of threads. If functions are not compiled:
        one thread. A client or an executor: its workers. "dask": the configured Dask cluster
        (``DASK_SCHEDULER_ADDRESS``), or a local cluster with one process for each core; see
        `eip_scipy.integrations.dask`.
    save_every : int, optional
        Save every `save_every`-th step of each member in ``.trajectories``; fixed steps only.
    t_eval : array_like or sequence of array_like, optional
        Times to save at instead: the same for all members, or a row (members, m) or an array for each. Members with
        different intervals or times are prepared and run one after the other, which takes some milliseconds for each;
        they accept neither `save_every` nor `reduce`.
    reduce : "state" or callable, optional
        Statistics over members (mean, variance, extremes) of the saved states, or of the last states if none are saved.
        A function ``reduce(t, y) -> float or (k,)``: statistics of its values. Trajectories are then stored only in
        `out`.
    callback : callable, optional
        ``callback(part)``, called after each chunk of members, in order, with an `EnsembleResult` of that chunk; return
        True to stop.
    out : path-like, optional
        Zarr group to which results are written chunk by chunk, for trajectories that do not fit into memory; xarray can
        open it. The path of a folder, or a URL.
    checkpoint : path-like, optional
        Without `out`: a file that stores finished members, see `eip_scipy.checkpoint`. It is written every
        `checkpoint_every` seconds, and when the ensemble ends or is interrupted.
    checkpoint_every : float, optional
        Seconds from one checkpoint to the next; longer if writing would take more than 5 % of the time.
    resume : bool, optional
        Continue with the content of `out` or `checkpoint`, with the same arguments: only missing members run, and the
        result agrees bit by bit. If there is no content, start at the beginning.
    chunk : int, optional
        Number of members that run together; results do not depend on it, except for the last bits of `reduce`.
    progress : bool, optional
        Show a progress bar with the remaining time.
    max_bytes : float, optional
        Bound on the memory for results in bytes; default: half of the free memory.
    **keywords
        Options of `integrate`: args (the same for all), in_place, events, compensated, compiled, metric, blocks, frame,
        direction, iterations, every, reuse_f, check, project_initial, rtol, atol, first_step, max_step, variations,
        jvp, symplectic. Members with derivatives run one after the other, and accept neither `out` nor `reduce`. Events
        are stored for each member in ``.t_events`` and ``.y_events``; a terminal event ends its member. `check`
        examines one member.

    Returns
    -------
    EnsembleResult
        ``y`` (members, n), ``status``, ``message``, ``max_defect`` (members, l), ``t``, and more.

    Raises
    ------
    TypeError, ValueError
        If an argument is wrong, or none of up to 8 members, spread over all, can start; the errors are then those of
        `integrate`.
    MemoryError
        If results would need more than `max_bytes`.
    CheckpointError
        If `out` or `checkpoint` exists without ``resume=True``, is damaged, belongs to other arguments or functions, or
        is used by another ensemble, or if `out` can no longer be written.

    Notes
    -----
    Members run in chunks, whose size does not depend on the number of workers, and chunks are collected in order, so
    that statistics also agree bit by bit for any number of workers. If the ensemble is interrupted (Ctrl-C, or an
    exception raised by the callback), the attribute ``partial`` of the exception is the result up to that point.

    Examples
    --------
    >>> import numpy as np
    >>> from eip_scipy import ensemble
    >>> from eip_scipy.problems import kepler
    >>> problem = kepler()
    >>> starts = problem.y0 * np.linspace(0.99, 1.01, 5)[:, None]
    >>> run = ensemble(problem, (0, 20), starts)
    >>> run.y.shape, run.success, bool((run.max_defect < 1e-11).all())
    ((5, 4), True, True)
    """
    options: dict[str, Any] = dict(keywords)
    _check_options(options, reduced=out is not None or reduce is not None)
    _check_choices(reduce, callback, progress, max_bytes)
    if invariants is not DEFAULT:
        options["invariants"] = invariants
    out, checkpoint = _places(out, checkpoint, checkpoint_every, resume)
    own = own_times(fun, t_span, t_eval, save_every, reduce)
    everyone = _inputs(fun, y0s, params, options, own)
    total = len(everyone.y0s)
    keep = reduce is None or out is not None
    method = default_method(fun) or EIPRK4 if method is None else method
    common = {"method": method, "h": h, "save_every": save_every, "t_eval": t_eval, **options}
    common["acceleration"] = acceleration
    request = Request.of(fun=_bare(fun), t_span=t_span, y0=everyone.y0s[0], params=everyone.params[0], **common)
    request = request.with_own_events().with_pointers()._replace(**own.of(0))
    if request.args is not None or not everyone.params.shape[1]:
        request = request._replace(params=None)
    task = Task(request, reduce, keep, total, own.padded.shape[1] if own else None)
    plan, doubts = _first_that_starts(task, everyone)
    everyone = everyone._replace(y0s=np.ascontiguousarray(everyone.y0s, plan.dtype))
    size = _chunk_size(plan, total, request.function) if chunk is None else count("chunk", chunk)
    held = plan.times.size if reduce is None and out is None else 0
    _check_memory(plan, total, held, max_bytes)
    store: Store | None = None
    if out is not None or checkpoint is not None:
        stored = reduce if out is None else None  # statistics of the states in `out` can be computed anew
        identity = plan.identity(everyone.y0s, everyone.params, size, own, stored)
        store = (
            CheckpointStore(checkpoint, identity, resume, checkpoint_every)
            if out is None
            else ZarrStore(out, identity, resume, plan.empty(size), _all_times(plan, own), total, plan.events)
        )
    stopped, closed = (nullcontext(), nullcontext()) if store is None else (sigterm_as_ctrl_c(), closing(store))
    with stopped, closed:
        gathered = _Gathered(plan, everyone, held, size, store, callback, doubts)
        result = gathered.run(partial(_pool, executor, plan, progress), progress)
    _warn(result, np.flatnonzero((result.status >= 0) & ~result.trusted))
    return result


def _check_choices(reduce: Any, callback: Any, progress: Any, max_bytes: Any) -> None:
    if not (reduce is None or reduce == "state" or callable(reduce)):
        raise ValueError(f"reduce must be 'state' or a function reduce(t, y), got {shown(reduce)}.")
    if callback is not None and not callable(callback):
        raise TypeError(f"callback must be a function callback(part), got {shown(callback)}.")
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

    `everyone` has the inputs of all members, `chunk` is the number of members in a chunk, and `store` writes `out` or
    `checkpoint`, if one is given. `held` is the number of saved states that are kept in memory for each member.
    `doubts` holds, by member, the findings of the checks at the start.
    """

    def __init__(
        self,
        plan: Plan,
        everyone: Chunk,
        held: int,
        chunk: int,
        store: Store | None,
        callback: Callable[[EnsembleResult], Any] | None,
        doubts: dict[int, str],
    ) -> None:
        self.everyone = everyone
        self.plan, self.chunk, self.store, self.callback, self.doubts = plan, chunk, store, callback, doubts
        self.method = plan.task.request.method.__name__
        self.whole = Members.empty(len(everyone.y0s), plan.size, plan.dtype, len(plan.names), held)
        self.statistics: Statistics | None = None
        self.stopped, self.one_by_one = False, ""
        self._begin = time.perf_counter()

    def run(self, pool: Callable[[], Pool], progress: bool) -> EnsembleResult:
        """Run all chunks that are not stored yet in the pool that ``pool()`` makes, and return the result."""
        from tqdm import tqdm

        done = self._stored()
        total = len(self.whole.t)
        chunks = (self.everyone.part(first, first + self.chunk) for first in range(done, total, self.chunk))
        shown: dict[str, Any] = {"desc": self.method, "unit": "member", "unit_scale": True, "disable": not progress}
        try:
            if done < total:
                with tqdm(total=total, initial=done, **shown) as bar:
                    self._gather(pool(), chunks, bar)
        except BaseException as error:
            error.partial = self._of(self.whole, self.statistics, 0)  # type: ignore[attr-defined]
            raise
        return self._of(self.whole, self.statistics, 0)

    def _stored(self) -> int:
        """Read the results of the stored members, compare their functions, and return the number of these members."""
        if self.store is None:
            return 0
        done, statistics = self.store.finished, self.store.statistics
        for first in range(0, done, self.chunk):
            members = self.store.read(first, min(first + self.chunk, done))
            part = Part(members, None) if statistics is not None else finished(self.plan.task, self.plan, members)
            self._take(first, part)
            if first + self.chunk >= done:
                last = self.everyone.part(first, done)
                here = self.plan.known_by(last.y0s, last.params, members)
                require_same_functions(self.store.path, self.store.known_by(first), *here, first)
        self.statistics = self.statistics if statistics is None else statistics
        return done

    def _gather(self, pool: Pool, chunks: Iterator[Chunk], bar: Any) -> None:
        with ExitStack() as stack:
            stack.callback(pool.close)
            if self.store is not None:
                stack.callback(self.store.flush)  # first, because the process may be killed soon
            for chunk, part in in_order(pool, chunks):
                self._take(chunk.first, part)
                if self.store is not None:
                    known_by, _ = self.plan.known_by(chunk.y0s, chunk.params, part.members)
                    self.store.write(chunk.first, part.members, known_by, self.whole, self.statistics)
                bar.update(len(part.members.t))
                if self.callback is not None and self.callback(self._of(part.members, part.statistics, chunk.first)):
                    self.stopped = True
                    return

    def _take(self, first: int, part: Part) -> None:
        members, last = part.members, first + len(part.members.t)
        for name, whole in self.whole._asdict().items():
            if not name.startswith("saved") or whole.shape[1]:
                whole[first:last] = getattr(members, name)
        self.statistics = merge(self.statistics, part.statistics)
        self.one_by_one = part.one_by_one or self.one_by_one

    def _of(self, members: Members, statistics: Statistics | None, first: int) -> EnsembleResult:
        plan, counters, times = self.plan, members.counters, _all_times(self.plan, self.everyone.own)
        trajectories = members.saved.swapaxes(1, 2) if members.saved.shape[1] else None
        ends = members.values
        invariants = ends if trajectories is None else members.saved_values.swapaxes(1, 2)
        if members is self.whole and self.store is not None and self.store.states is not None:
            trajectories, invariants = self.store.states, self.store.saved_values
        none = [(np.zeros(0), np.zeros((0, plan.size), plan.dtype))] * plan.events  # of a member that did not run
        events = [found or none for found in members.happened]
        trusted, message = members.trusted.copy(), np.array(members.message, dtype=object)
        for k in range(len(trusted)) if self.doubts else ():
            if trusted[k] and first + k in self.doubts:
                trusted[k], message[k] = False, f"{message[k]}; {self.doubts[first + k]}"
        result = EnsembleResult(
            y=members.y,
            t=members.t,
            status=members.status,
            message=message,
            failed=np.flatnonzero(members.status == FAILED),
            success=bool((members.status >= 0).all()),
            max_defect=members.max_defect,
            max_correction=members.max_correction,
            side_by_side=members.side_by_side,
            one_by_one=self.one_by_one,
            trusted=trusted,
            names=plan.names,
            nfev=counters[:, NFEV],
            njev=counters[:, NJEV],
            nlu=counters[:, NLU],
            n_rejected_projections=counters[:, REJECTED],
            times=times if times.ndim == 1 else times[first : first + len(members.t)],
            trajectories=trajectories,
            invariants=invariants,
            target=members.target,
            t_events=[[t for t, _ in member] for member in events] if plan.events else None,
            y_events=[[y for _, y in member] for member in events] if plan.events else None,
            statistics=statistics,
            first=first,
            stopped=self.stopped,
            wall_time=time.perf_counter() - self._begin,
            method=self.method,
            h=plan.h,
            chunk=self.chunk,
            component_names=plan.ready.component_names,
        )
        if plan.variations is not None:
            _separate(result, plan.variations.columns)
            result["columns"] = plan.ready.described_columns
        object.__setattr__(result, "_ends", ends)  # an attribute, not a field
        return result


def _separate(result: EnsembleResult, columns: Columns) -> None:
    """Separate the states of a result from the columns of derivatives that follow them, in place."""
    result["y"], result["variations"] = columns.apart(result.y)
    if result.trajectories is not None:
        rows, result["variations"] = columns.apart(result.trajectories.swapaxes(1, 2))
        result["trajectories"] = rows.swapaxes(1, 2)
    if result.y_events is not None:
        result["y_events"] = [[columns.own(rows) for rows in member] for member in result.y_events]


def _all_times(plan: Plan, own: OwnTimes) -> np.ndarray:
    """Return the times of saved states, with a row for each member if their times differ."""
    return plan.times if own.times is None else own.padded


def _check_options(options: dict[str, Any], *, reduced: bool) -> None:
    """Check the options of `integrate`; `reduced` is True if the states go into statistics or the store of `out`."""
    if reduced and options.get("variations") is not None:
        raise ValueError("ensemble: variations= cannot be combined with out= or reduce=; omit one of them.")
    known = set(Request._fields) - ALONE | set(ProjectionOptions.names())
    for name in options:
        if name not in known:
            raise TypeError(f"ensemble() has no option {name!r}{nearest(name, (*OWN, *known))}")
    Events(options.get("events"))  # raises an error if they are wrong


def _places(out: Any, checkpoint: Any, every: Any, resume: Any) -> tuple[str | None, str | None]:
    """Return `out` and `checkpoint` as absolute paths after checks, so that the working directory may change."""
    if not is_number(every, "checkpoint_every") or not every > 0:
        raise ValueError(f"checkpoint_every must be a number of seconds > 0, got {shown(every)}.")
    flag("resume", resume)
    if out is not None and checkpoint is not None:
        raise ValueError("got both out= and checkpoint=; omit checkpoint, because out already stores finished members.")
    for name, path in (("out", out), ("checkpoint", checkpoint)):
        if path is not None and not isinstance(path, (str, os.PathLike)):
            raise TypeError(f"{name} must be a path, got {path!r}.")
    if resume and out is None and checkpoint is None:
        raise ValueError("resume=True needs a place to resume from: pass out= or checkpoint=.")
    return None if out is None else location(out), None if checkpoint is None else absolute(checkpoint)


def _inputs(fun: Any, y0s: Any, params: Any, options: dict[str, Any], times: OwnTimes) -> Chunk:
    """Return all members as one `Chunk`: states (m, n), parameters (m, p), p = 0 if there are none, and own `times`."""
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
    elif starts.ndim == 1 and times:
        starts = np.tile(starts, (times.members, 1))
    if starts.ndim != 2 or starts.size == 0:
        raise ValueError(
            f"y0s must have the shape (members, n), got {starts.shape}; one state (n,) is possible only if params, "
            "t_span or t_eval has a row for each member."
        )
    if times and times.members != len(starts):
        raise ValueError(
            f"{times.name} has {times.members} rows for {len(starts)} members; give one row for each member, or one "
            "for all."
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
    return Chunk(0, starts, own if own.ndim == 2 else np.broadcast_to(own, (len(starts), own.size)), times)


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


def _first_that_starts(task: Task, everyone: Chunk) -> tuple[Plan, dict[int, str]]:
    """Return the plan, made from the first member with a valid start; raise the first error if none has one.

    At most `TRIED` of the members `everyone`, spread over all, are tried. Also return the findings of the checks at
    the start, by member: they apply to all members with the same parameters.
    """
    first: Exception | None = None
    starts, params = everyone.y0s, everyone.params
    for k in np.unique(np.linspace(0, len(starts) - 1, TRIED).astype(int)):
        own = None if task.request.params is None else params[k].copy()
        request = task.request._replace(y0=starts[k].copy(), params=own, **everyone.own.of(k))
        tried = dataclasses.replace(task, request=request)
        try:
            ready = tried.prepared(request.y0, own, check_start=True)
        except MemoryError:
            raise
        except Exception as error:
            first = first or error
        else:
            found = ready.run.trust.message
            ready.run.trust.doubts.clear()
            alike: list[int] = np.flatnonzero((params == params[k]).all(axis=1)).tolist() if found else []
            return Plan(tried, ready), dict.fromkeys(alike, found)
    assert first is not None
    # A transposed y0s fails in the user's function, whose error may not explain that; jitted code explains nothing.
    first.add_note(
        f"ensemble: the rows of y0s are members; y0s has {len(starts)} rows of {starts.shape[1]} components."
    )
    raise first


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


def _check_memory(plan: Plan, members: int, rows: int, max_bytes: float | None) -> None:
    """Raise MemoryError if the results, with `rows` saved states for each member, would need too much memory."""
    each = plan.size * plan.dtype.itemsize * (1 + rows) + 8 * (len(plan.names) * (3 + rows) + N_COUNTERS + 4)
    bound = most_bytes(members * each, max_bytes)
    if members * each > bound:
        many = f"{rows} states per member would be stored. Save fewer (save_every, t_eval), use reduce= or out="
        advice = many if rows else "The last state of each member would be stored. Run the members in parts"
        raise MemoryError(
            f"{members} members of {plan.size} components need {members * each / 1e9:.3g} GB, the bound is "
            f"{bound / 1e9:.3g} GB. {advice}, or raise max_bytes."
        )


def _pool(executor: Any, plan: Plan, progress: bool) -> Pool:
    """Return the pool that runs the chunks."""
    task, key = plan.task, uuid.uuid4().hex
    if executor is None or isinstance(executor, (int, np.integer)):
        plan.compile(progress=progress)
        workers = cores() if executor is None else count("executor", executor)
        return ThreadPool(plan, workers if plan.why_not is None else 1)
    if isinstance(executor, Executor):
        return FuturesPool(executor, partial(run_elsewhere, task, key), cores())
    kind = type(executor)
    if executor == "dask" or kind.__module__.partition(".")[0] == "distributed" or kind.__name__ == "DaskExecutor":
        if pointers := plan.ready.pointers:
            raise pointers[0].unpicklable()  # Dask's own message for it is very long
        # Imported by name, because the integrations depend on this package and need further libraries.
        return import_module("eip_scipy.integrations.dask").pool(executor, task, key)
    raise TypeError(
        f"executor must be None, a number of threads, 'dask', a dask.distributed Client or an executor of "
        f"concurrent.futures, got {executor!r}."
    )
