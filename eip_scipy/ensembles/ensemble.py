"""`ensemble`: many runs of one system, from many starts or with many parameters."""

from __future__ import annotations

import dataclasses
import math
import os
import time
import uuid
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor
from contextlib import ExitStack, closing, nullcontext
from functools import partial
from importlib import import_module
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike

from ..checkpoint.locks import absolute
from ..core.arguments import extra_arguments, floats, parameter_values
from ..core.inputs import count, flag, is_number, refuse_units, shown
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
from ..run.interrupts import ended_by_sigterm, kept_ctrl_c
from ..run.memory import check_bytes, most_bytes
from ..run.prepare import DEFAULT, Request, default_method
from ..run.results import WithColumns
from ..run.tables import dataset, default_names, to_dataframe
from .chunks import Chunk, FuturesPool, Part, Pool, ThreadPool, cores, finished, in_order, run_elsewhere
from .happened import Happened
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
# Of a request: what an ensemble has of its own, or not at all.
ALONE = {"fun", "acceleration", "t_span", "y0", "params", "projection"}
ALONE |= {"callback", "diagnostics", "max_bytes", "progress"}
OWN = ("executor", "reduce", "callback", "out", "checkpoint", "checkpoint_every", "resume", "chunk", *sorted(ALONE))


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
    """Result of `ensemble`; fields by name or by key, as in SciPy's own results.

    Attributes
    ----------
    y : ndarray, shape (members, n)
        Last states: at the end of the interval, or the last one before a member failed.
    t : ndarray, shape (members,)
        Their times.
    status : ndarray, shape (members,)
        0: the end was reached; 1: an event ended the member; -1: it failed; -2: it did not run (in what a broken off
        ensemble leaves behind).
    message : ndarray of str, shape (members,)
        What ended each.
    failed : ndarray
        Indices of the members with status -1.
    success : bool
        Whether all members ran and none failed.
    max_defect : ndarray, shape (members, l)
        Largest ``|I - target|`` after a projection, where target is each member's own.
    max_correction : ndarray, shape (members,)
        Largest correction in local errors; nan where the method estimates none.
    side_by_side : ndarray of bool, shape (members,)
        Whether each ran in a vector with others, several times faster; the docs' page on ensembles says what it takes.
    one_by_one : str
        Why members ran one after the other instead; "" where they did not, or only those did that had to.
    trusted : ndarray of bool, shape (members,)
        Whether each did not fail and nothing speaks against it, as in `IntegrationResult`; else `message` says what.
    names : tuple of str
        Of the l invariants.
    nfev, njev, nlu, n_rejected_projections : ndarray, shape (members,)
    times : ndarray, shape (m,) or (members, m)
        Times of saved states; empty if none were asked for. If members have times of their own, there is one row for
        each, which ends with nan where it is shorter than the others.
    trajectories : ndarray or zarr.Array or None, shape (members, n, m)
        Saved states; nan after the end of a member that did not get there. None if they were reduced.
    invariants : ndarray or zarr.Array, shape (members, l) or (members, l, m)
        Values of the invariants: in the last states, or in the saved states if `trajectories` has them.
    target : ndarray, shape (members, l)
        The values that were kept, each member's own.
    t_events, y_events : list of list of ndarray, or None
        With events, ``t_events[k]`` and ``y_events[k]`` are those of member k, as in `scipy.integrate.solve_ivp`: one
        array for each event.
    statistics : Statistics or None
        Over all members, by ``reduce=``.
    variations : ndarray, shape (members, n, k) or (members, m, n, k)
        With ``variations=``, the columns of derivatives: in the last states, or in the saved states if `trajectories`
        has them. `stm` and `sensitivities` take theirs from it; `columns` is as in `IntegrationResult`.
    first : int
        Number of the first member: 0, but for what a `callback` gets.
    stopped : bool
        Whether the callback stopped the ensemble.
    wall_time : float
        Seconds.
    method : str
    h : float or None
    chunk : int
        Members in a chunk.
    component_names : tuple of str
        Those of the `Problem`, or "y0", "y1" and so on.
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
        """The members as an `xarray.Dataset`.

        Parameters
        ----------
        names : sequence of str or str, optional
            As for `eip_scipy.results.to_xarray`.

        Returns
        -------
        xarray.Dataset
            The names of a Zarr group that `out` asks for, and more: ``y`` (member, component), ``t_end``, ``status``,
            ``message``, ``trusted``, ``max_correction`` (member), ``max_defect``, ``target`` (member, invariant), the
            counts; ``states`` (member, component, time) and ``invariants`` (member, invariant, time) if trajectories
            are in memory, with ``row`` and ``times`` (member, row) in place of ``time`` if members have times of their
            own; else ``end_invariants`` (member, invariant). What `out` holds is opened by
            ``xarray.open_zarr(out, consolidated=False)``.

        Raises
        ------
        ImportError
            Without xarray: ``pip install "eip_scipy[xarray]"``.
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

        Trajectories that `out` holds stay there: after `load` they are None, and `invariants` those of the last states.
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
            For each component the median of all members in time, with bands that hold 50 % and 90 % of them; or, if no
            states are saved at common times, the same of the last states. Then the largest error of each invariant in
            each member, and the numbers of members that came to the end, were ended by an event, are not to be trusted,
            failed or did not run. A notebook shows the figure, as that of `IntegrationResult.plot`.

        Raises
        ------
        ImportError
            Without matplotlib: ``pip install "eip_scipy[plot]"``.
        """
        from .figures import plot

        return plot(self, names)

    def _packed(self) -> dict[str, Any]:
        """Return the fields as `eip_scipy.results.save` takes them."""
        from .saving import packed

        ends = vars(self).get("_ends")
        return packed(self if ends is None else {**self, "end_invariants": ends})

    @classmethod
    def _unpacked(cls, fields: dict[str, Any]) -> EnsembleResult:
        """Return a result from what `_packed` gave."""
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
            f"{self.wall_time:.3g} s, {np.count_nonzero(self.side_by_side)} side by side in vectors, "
            f"{self.failed.size} failed",
        ]
        if self.one_by_one:
            lines.append(f"  one by one: {self.one_by_one}")
        width = max((len(name) for name in self.names), default=0)
        for name, defects in zip(self.names, self.max_defect[self.status >= 0].T, strict=True):
            if defects.size:
                lines.append(f"  {name:<{width}}  max defect {defects.max():.2e}, median {np.median(defects):.2e}")
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

    Each member comes out as from its own `integrate`, bit for bit, on whatever and on however many workers it ran.
    A member that fails is reported with its index and reason, and disturbs no other.

    Parameters
    ----------
    fun : callable or Problem
        As for `integrate`.
    t_span : (float, float) or array_like, shape (members, 2)
        Start and end: the same for all, or a row for each member.
    y0s : array_like, shape (members, n)
        Starts; one (n,) for all where `params` differ. Default: the start of a `Problem`.
    acceleration : callable, optional
        In place of `fun`, as for `integrate`.
    params : array_like of float, shape (p,) or (members, p), optional
        Parameters of all members, or of each. Of a problem that names them also a mapping, of a name to one value or
        to one for each member, as in ``params={"k": [1.0, 2.0]}``.
    method : type, optional
        As for `integrate`. Default: the problem's own, if it has one, else `EIPRK4`.
    h : float, optional
        As for `integrate`: the step; None: adaptive steps; without it, adaptive steps where rtol, atol, first_step or
        max_step ask for them, else a problem's own step.
    invariants : Invariant or sequence of Invariant, optional
        What to keep: each member keeps the values at its own start. Where `params` differ, their functions take them
        as the last argument and have no args.
    executor : None, int, "dask", distributed.Client, DaskExecutor or concurrent.futures.Executor, optional
        Where members run. None: threads on all cores (one, where functions are not compiled); a number: so many
        threads. "dask": the Dask cluster of the configuration (``DASK_SCHEDULER_ADDRESS``), or a local one of a process
        for each core; see `eip_scipy.integrations.dask`.
    save_every : int, optional
        Save each so many-th step of every member in ``.trajectories``; fixed steps only.
    t_eval : array_like or sequence of array_like, optional
        Times to save at instead: the same for all, or a row (members, m) or an array for each member. Members that have
        intervals or times of their own are prepared and run one by one, which takes some milliseconds for each; they
        take neither `save_every` nor `reduce`.
    reduce : "state" or callable, optional
        Statistics over members (mean, variance, extremes) of the saved states, or of the last ones where none are
        saved; a function ``reduce(t, y) -> float or (k,)``: of that. Trajectories are then kept in `out` only.
    callback : callable, optional
        ``callback(part)`` after each chunk of members, in their order, with an `EnsembleResult` of that chunk; return
        True to stop.
    out : path-like, optional
        A Zarr group to write to, chunk by chunk, for trajectories that do not fit into memory; xarray opens it. The
        path of a folder, or a URL.
    checkpoint : path-like, optional
        Without `out`: a file that keeps finished members, see `eip_scipy.checkpoint`; written every `checkpoint_every`
        seconds, and when the ensemble ends or is broken off.
    checkpoint_every : float, optional
        Seconds; more where writing would take over a twentieth of the time.
    resume : bool, optional
        Go on with what is in `out` or `checkpoint`, with the same arguments: only members that are missing there run,
        and the result has the same bits. Where there is nothing, start.
    chunk : int, optional
        Members that run together; results do not depend on it, but for the last bits of `reduce`.
    progress : bool, optional
        Show a progress bar with the time that is left.
    max_bytes : float, optional
        Bound on the memory for results; default: half of what is free.
    **keywords
        Options of `integrate`: args (the same for all), in_place, events, compensated, compiled, metric, blocks, frame,
        direction, iterations, every, reuse_f, check, project_initial, rtol, atol, first_step, max_step, variations,
        jvp, symplectic. Members with derivatives run one by one, and take neither `out` nor `reduce`. Events are kept
        for each member in ``.t_events`` and ``.y_events``; a terminal one ends its member. `check` looks at one member.

    Returns
    -------
    EnsembleResult
        ``y`` (members, n), ``status``, ``message``, ``max_defect`` (members, l), ``t``, and more.

    Raises
    ------
    TypeError, ValueError
        As by `integrate`, for what would fail in every member.
    MemoryError
        When results would need more than `max_bytes`.
    CheckpointError
        When `out` or `checkpoint` exists and is not to be resumed, or is damaged, or belongs to other arguments or
        functions, or another ensemble has it, or `out` can no longer be written.

    Notes
    -----
    Members run in chunks, whose size depends on the problem only, and chunks come back in their order, so that
    statistics too have the same bits on any number of workers. When the ensemble is broken off (Ctrl-C, an exception of
    the callback), the exception carries what there was as ``exception.partial``.

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
    request = dataclasses.replace(request.with_pointers(), **own.of(0))
    if request.args is not None or not everyone.params.shape[1]:
        request = dataclasses.replace(request, params=None)
    task = Task(request, reduce, keep, total, own.padded.shape[1] if own else None)
    plan, doubts = _first_that_starts(task, everyone)
    everyone = everyone._replace(y0s=np.ascontiguousarray(everyone.y0s, plan.dtype))
    size = _chunk_size(plan, total, request.function) if chunk is None else count("chunk", chunk)
    held = plan.times.size if reduce is None and out is None else 0
    _check_memory(plan, total, held, max_bytes)
    store: Store | None = None
    if out is not None or checkpoint is not None:
        identity, times = plan.identity(everyone.y0s, everyone.params, size, own), _all_times(plan, own)
        store = (
            CheckpointStore(checkpoint, identity, resume, checkpoint_every)
            if out is None
            else ZarrStore(out, identity, resume, plan.empty(size), times, total, plan.events)
        )
    with ended_by_sigterm(store is not None), nullcontext() if store is None else closing(store):
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
    """Warn of members that are not to be trusted, if there are any.

    Raises
    ------
    ProjectionWarning
        Where warnings are errors, with the result as ``partial``.
    """
    if not doubtful.size:
        return
    k = int(doubtful[0])
    try:
        warnings.warn(
            f"{doubtful.size} of {result.t.size} members are not to be trusted (.trusted, .message), the first of them "
            f"member {k}: {result.message[k]}",
            ProjectionWarning,
            stacklevel=3,
        )
    except ProjectionWarning as error:
        error.partial = result  # type: ignore[attr-defined]
        raise


class _Gathered:
    """What came back so far, and what is made of it at the end."""

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
        """Run all chunks that are not in the store yet."""
        from tqdm import tqdm

        done = self._stored()
        total = len(self.whole.t)
        try:
            if done < total:
                with (
                    kept_ctrl_c(),
                    tqdm(
                        total=total,
                        initial=done,
                        desc=self.method,
                        unit="member",
                        unit_scale=True,
                        disable=not progress,
                    ) as bar,
                ):
                    self._gather(pool(), self._chunks(done), bar)
        except BaseException as error:
            error.partial = self.result()  # type: ignore[attr-defined]
            raise
        return self.result()

    def _chunks(self, done: int) -> Iterator[Chunk]:
        """Yield the members from number `done` on, chunk by chunk."""
        for first in range(done, len(self.whole.t), self.chunk):
            yield self.everyone.part(first, first + self.chunk)

    def _stored(self) -> int:
        """Take what the store has; returns the number of members."""
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
                stack.callback(self.store.flush)  # first: whoever ends the process may not wait long
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

    def result(self) -> EnsembleResult:
        """The result as far as it is there."""
        return self._of(self.whole, self.statistics, 0)

    def _of(self, members: Members, statistics: Statistics | None, first: int) -> EnsembleResult:
        plan, counters, times = self.plan, members.counters, _all_times(self.plan, self.everyone.own)
        trajectories = members.saved.swapaxes(1, 2) if members.saved.shape[1] else None
        ends = members.values
        invariants = ends if trajectories is None else members.saved_values.swapaxes(1, 2)
        if members is self.whole and self.store is not None and self.store.states is not None:
            trajectories, invariants = self.store.states, self.store.saved_values
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
            t_events=[[t for t, _ in member] for member in self._events(members)] if plan.events else None,
            y_events=[[y for _, y in member] for member in self._events(members)] if plan.events else None,
            statistics=statistics,
            first=first,
            stopped=self.stopped,
            wall_time=time.perf_counter() - self._begin,
            method=self.method,
            h=plan.h,
            chunk=self.chunk,
            component_names=plan.component_names,
        )
        if plan.variations is not None:
            _separate(result, plan.variations.columns)
            result["columns"] = plan.described_columns
        object.__setattr__(result, "_ends", ends)  # an attribute, not a field
        return result

    def _events(self, members: Members) -> list[Happened]:
        """Return the events of members; none of those that did not run."""
        n, dtype = self.plan.size, self.plan.dtype
        none = [(np.zeros(0), np.zeros((0, n), dtype))] * self.plan.events
        return [found or none for found in members.happened]


def _separate(result: EnsembleResult, columns: Columns) -> None:
    """Give a result the states and their columns of derivatives apart."""
    result["y"], result["variations"] = columns.apart(result.y)
    if result.trajectories is not None:
        rows, result["variations"] = columns.apart(result.trajectories.swapaxes(1, 2))
        result["trajectories"] = rows.swapaxes(1, 2)
    if result.y_events is not None:
        result["y_events"] = [[columns.own(rows) for rows in member] for member in result.y_events]


def _all_times(plan: Plan, own: OwnTimes) -> np.ndarray:
    """Return the times of saved states, with a row for each member if they have times of their own."""
    return plan.times if own.times is None else own.padded


def _check_options(options: dict[str, Any], *, reduced: bool) -> None:
    """The options that go on to `integrate`; `reduced`: states go into statistics or a store."""
    if reduced and options.get("variations") is not None:
        raise ValueError("ensemble: derivatives of the members (variations=) go neither into out= nor into reduce=.")
    known = {option.name for option in dataclasses.fields(Request)} - ALONE | set(ProjectionOptions.names())
    for name in options:
        if name not in known:
            raise TypeError(f"ensemble() has no option {name!r}{nearest(name, (*OWN, *known))}")
    Events(options.get("events"))  # which raises for what is wrong with them


def _places(out: Any, checkpoint: Any, every: Any, resume: Any) -> tuple[str | None, str | None]:
    """Return where `out` and `checkpoint` lead to now, whatever becomes of the working directory."""
    refuse_units(checkpoint_every=every)
    if not is_number(every) or not every > 0:
        raise ValueError(f"checkpoint_every must be a number of seconds > 0, got {shown(every)}.")
    flag("resume", resume)
    if out is not None and checkpoint is not None:
        raise ValueError("give out= or checkpoint=, not both: out keeps finished members already.")
    for name, path in (("out", out), ("checkpoint", checkpoint)):
        if path is not None and not isinstance(path, (str, os.PathLike)):
            raise TypeError(f"{name} must be a path, got {path!r}.")
    if resume and out is None and checkpoint is None:
        raise ValueError("resume=True needs the place to go on from: out= or checkpoint=.")
    return None if out is None else location(out), None if checkpoint is None else absolute(checkpoint)


def _inputs(fun: Any, y0s: Any, params: Any, options: dict[str, Any], times: OwnTimes) -> Chunk:
    """Return all members: their starts (m, n), parameters (m, p), p = 0 where there are none, and own times."""
    problem = fun if isinstance(fun, Problem) else None
    if y0s is None:
        y0s = None if problem is None else problem.y0
        if y0s is None:
            raise TypeError("ensemble: y0s is missing; only a Problem brings a start of its own, and not each does.")
    starts = states("y0s", y0s)
    if problem is not None:
        params = problem.plain(params=params)["params"]
    own = None if params is None else np.atleast_1d(parameter_values(params))
    if starts.ndim == 1 and own is not None and own.ndim == 2:
        starts = np.tile(starts, (len(own), 1))
    elif starts.ndim == 1 and times:
        starts = np.tile(starts, (times.members, 1))
    if starts.ndim != 2 or starts.size == 0:
        raise ValueError(f"y0s must have the shape (members, n), got {starts.shape}.")
    if times and times.members != len(starts):
        raise ValueError(
            f"{times.name} has {times.members} rows for {len(starts)} members; give one row for each, or one for all."
        )
    if own is None:
        brought = None if problem is None or problem.rhs is None else problem.params
        own = np.zeros(0) if brought is None else np.asarray(brought, float).reshape(-1)
    elif own.ndim == 2 and len(own) != len(starts):
        raise ValueError(
            f"params has {len(own)} rows for {len(starts)} members; give one row for each, or one for all."
        )
    elif own.ndim > 2:
        raise ValueError(f"params must have the shape (p,) or (members, p), got {own.shape}.")
    if own.ndim == 2 and any(item.args for item in as_invariants(options.get("invariants", ()))):
        raise ValueError(
            "ensemble: invariants with args, and params for each member: leave args out; the functions receive each "
            "member's params as their last argument."
        )
    if options.get("args") is not None:
        own = floats(extra_arguments(options["args"], params))
    return Chunk(0, starts, own if own.ndim == 2 else np.broadcast_to(own, (len(starts), own.size)), times)


def _bare(fun: Any) -> Any:
    """A problem without what members do not need and other processes may not be able to take."""
    if not isinstance(fun, Problem) or fun.rhs is None:
        return fun
    return dataclasses.replace(fun, fun=_not_called, reference=None)


def _not_called(t: float, y: np.ndarray) -> np.ndarray:
    raise NotImplementedError("the problem's compiled right-hand side is in use")


def _first_that_starts(task: Task, everyone: Chunk) -> tuple[Plan, dict[int, str]]:
    """The plan by a member whose start `integrate` takes; its error where it takes none of some members.

    Also what the checks of the start found, by member: it holds for all that have the same parameters.
    """
    first: Exception | None = None
    starts, params = everyone.y0s, everyone.params
    for k in np.unique(np.linspace(0, len(starts) - 1, TRIED).astype(int)):
        own = None if task.request.params is None else params[k].copy()
        request = dataclasses.replace(task.request, y0=starts[k].copy(), params=own, **everyone.own.of(k))
        tried = dataclasses.replace(task, request=request)
        try:
            ready = tried.prepared(tried.request.y0, own, check_start=True)
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
    # A transposed array meets the user's own function first, which may say little: jitted code says nothing at all.
    first.add_note(f"ensemble: the rows of y0s are the members, here {len(starts)} of {starts.shape[1]} components.")
    raise first


def _chunk_size(plan: Plan, members: int, fun: Any) -> int:
    """Members in a chunk, by the problem alone: about a second's work, bounded in bytes, a multiple of the lanes."""
    rhs = fun.rhs or fun.fun if isinstance(fun, Problem) else fun
    native = is_compiled(rhs) or isinstance(rhs, PointerFunction)
    budget = CHUNK_STEPS if native and plan.task.request.compiled is not False else INTERPRETED_STEPS
    steps = plan.n_steps or UNKNOWN_STEPS
    by_work = budget * 4 / (steps * max(4, plan.size))
    by_bytes = CHUNK_BYTES / (plan.size * plan.dtype.itemsize * (1 + plan.times.size))
    size = min(by_work, by_bytes, LARGEST_CHUNK, math.ceil(members / LEAST_CHUNKS))
    return LANES * max(LEAST_OCTETS, math.ceil(size / LANES))


def _check_memory(plan: Plan, members: int, rows: int, max_bytes: float | None) -> None:
    """Refuse to gather more than fits."""
    each = plan.size * plan.dtype.itemsize * (1 + rows) + 8 * (len(plan.names) * (3 + rows) + N_COUNTERS + 4)
    bound = most_bytes(members * each, max_bytes)
    if members * each > bound:
        what = f"{rows} states each; raise save_every, take statistics (reduce=), write to a Zarr group (out=)"
        mend = what if rows else "the last state of each; run them in parts"
        raise MemoryError(
            f"{members} members of {plan.size} components need {members * each / 1e9:.3g} GB, the bound is "
            f"{bound / 1e9:.3g} GB. Kept are {mend}, or raise max_bytes."
        )


def _pool(executor: Any, plan: Plan, progress: bool) -> Pool:
    """Where the chunks run."""
    task, key = plan.task, uuid.uuid4().hex
    if executor is None or isinstance(executor, (int, np.integer)):
        plan.compile(progress=progress)
        workers = cores() if executor is None else count("executor", executor)
        return ThreadPool(plan, workers if plan.why_not is None else 1)
    if isinstance(executor, Executor):
        return FuturesPool(executor, partial(run_elsewhere, task, key), cores())
    if executor == "dask" or _is_of_dask(executor):
        if plan.pointers:
            raise plan.pointers[0].unpicklable()  # Dask would bury it in pages of its own
        # By name: the integrations are built on the package, and need what it does not.
        return import_module("eip_scipy.integrations.dask").pool(executor, task, key)
    raise TypeError(
        f"executor must be None, a number of threads, 'dask', a dask.distributed Client or an executor of "
        f"concurrent.futures, got {executor!r}."
    )


def _is_of_dask(executor: Any) -> bool:
    return type(executor).__module__.partition(".")[0] == "distributed" or type(executor).__name__ == "DaskExecutor"
