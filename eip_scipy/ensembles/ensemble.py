"""`ensemble`: many runs of one system, with different initial states or parameters."""

from __future__ import annotations

import dataclasses
import inspect
import math
import time
import warnings
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike

from ..checkpoint import require_place
from ..core.conserved import NEAR_DISTANCE, confirmed, states_near
from ..core.derivatives import unless_error
from ..core.event_derivatives import EVENT_DERIVATIVES
from ..core.events import Events
from ..core.functions import PointerFunction, extra_arguments, floats, is_compiled, parameter_values
from ..core.inputs import count, flag, shown, states
from ..core.invariants import as_invariants
from ..core.names import nearest
from ..core.problem import Problem
from ..core.projection import ProjectionDetails
from ..core.solvers import EIPRK4, EIPSolver
from ..engine.data import N_COUNTERS
from ..engine.trust import ProjectionWarning
from ..run.driver import check_bytes, expected_steps, require_memory
from ..run.integrate import at_events
from ..run.prepare import DEFAULT, RunArguments, default_method, prepared
from .checkpoints import opened
from .executors import results
from .members import LANES, Chunk, Plan, Task, placed
from .result import FAILED, EnsembleResult

__all__ = ["EnsembleResult", "ensemble"]

# Work in a chunk: floats times steps (a state has at least four floats), of compiled and of interpreted functions.
CHUNK_WORK, INTERPRETED_WORK = 8e6, 8e4
UNKNOWN_STEPS = 10_000
CHUNK_BYTES = 4e6
LARGEST_CHUNK = 4096
LEAST_CHUNKS = 16
LEAST_BATCHES = 4  # in a chunk
TRIED = 8  # members


class EnsembleKeywords(ProjectionDetails, total=False):
    """The options of `integrate` that `ensemble` passes on, for type checkers."""

    args: Iterable[Any] | None
    in_place: bool
    jacobian: Callable[..., Any] | None
    jac: Any
    events: Any
    compiled: bool | None
    rtol: ArrayLike
    atol: ArrayLike
    first_step: float | None
    max_step: float
    variations: Any
    jvp: Callable[..., Any] | None
    symplectic: bool | None


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
        max_step, variations, jvp, symplectic. An array (members, n, k) as `variations` has the initial columns of each
        member. Linear invariants are found at the start of the first member; they are kept if they hold for the
        parameters of all members. Members with an invariant that depends on times far from 0 run one after the other,
        and so do projected members with derivatives. Events are stored for each member in
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

    See Also
    --------
    integrate, eip_scipy.results.EnsembleResult

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
    _check(options, reduce, callback, progress, max_bytes)
    require_place(checkpoint, checkpoint_every, resume, "a path")
    if invariants is not DEFAULT:
        options["invariants"] = invariants
    everyone = _inputs(fun, y0s, params, options)
    members, n = everyone.y0s.shape
    everyone, vectors = _with_vectors(everyone, options)
    request = RunArguments.of(
        fun=_bare(fun), acceleration=acceleration, t_span=t_span, y0=everyone.y0s[0, :n], params=everyone.params[0],
        h=h, method=default_method(fun) or EIPRK4 if method is None else method, save_every=save_every, t_eval=t_eval,
        **options,
    ).sendable()  # fmt: skip
    if request.args is not None or not everyone.params.shape[1]:
        request = request._replace(params=None)
    plan = _first_that_starts(Task(request, members, reduce, vectors), everyone)
    everyone = everyone._replace(y0s=np.ascontiguousarray(everyone.y0s, plan.dtype))
    given = fun if acceleration is None else acceleration
    size = _chunk_size(plan, members, given) if chunk is None else count("chunk", chunk)
    _check_memory(plan, members, max_bytes)
    with opened(checkpoint, checkpoint_every, resume, plan, everyone) as (finished, write):
        result = _Collector(plan, everyone, size, write, callback).run(finished, executor, progress)
    _warn_of_doubtful(result)
    return result


def _check(options: dict[str, Any], reduce: Any, callback: Any, progress: Any, max_bytes: Any) -> None:
    for name in options:
        if name not in EnsembleKeywords.__annotations__:
            known = (*inspect.signature(ensemble).parameters, *EnsembleKeywords.__annotations__)
            raise TypeError(f"ensemble() has no option {name!r}{nearest(name, known)}")
    Events(options.get("events"))  # raises an error if they are wrong
    for name, given, form in (("reduce", reduce, "reduce(result)"), ("callback", callback, "callback(part)")):
        if given is not None and not callable(given):
            raise TypeError(f"{name} must be a function {form}, got {shown(given)}.")
    flag("progress", progress)
    check_bytes(max_bytes)


def _warn_of_doubtful(result: EnsembleResult) -> None:
    doubtful = np.flatnonzero((result.status >= 0) & ~result.trusted)
    if not doubtful.size:
        return
    try:
        warnings.warn(
            f"{doubtful.size} of {result.t.size} members are not to be trusted (see .trusted and .message of the "
            f"result), the first of them member {doubtful[0]}: {result.message[doubtful[0]]}",
            ProjectionWarning,
            stacklevel=3,
        )
    except ProjectionWarning as error:
        error.partial = result  # type: ignore[attr-defined]
        raise


@dataclasses.dataclass
class _Collector:
    """The finished members so far, from which the result is made.

    `everyone` has the inputs of all members, and `size` is the number of members in a chunk. ``write(done, whole)``
    writes the checkpoint, if there is one.
    """

    plan: Plan
    everyone: Chunk
    size: int
    write: Callable[..., None]
    callback: Callable[[EnsembleResult], Any] | None
    stopped: bool = False

    def __post_init__(self) -> None:
        self.begin, total = time.perf_counter(), len(self.everyone.y0s)
        self.whole = self.plan.not_run(total, self.plan.held) | {"reduced": None, "one_by_one": ""}

    def run(self, finished: dict[str, Any] | None, executor: Any, progress: bool) -> EnsembleResult:
        """Run all chunks but those of the first members, which are `finished`, and return the result."""
        done = 0 if finished is None else self._take(0, finished)
        try:
            if done < len(self.everyone.y0s):
                self._collect(executor, progress, done)
        except BaseException as error:
            error.partial = self._result(self.whole, 0)  # type: ignore[attr-defined]
            raise
        return self._result(self.whole, 0)

    def _collect(self, executor: Any, progress: bool, done: int) -> None:
        """Run the members from number `done` on, and add their results."""
        from tqdm import tqdm

        (_, y0s, params), size = self.everyone, self.size
        chunks = (Chunk(k, y0s[k : k + size], params[k : k + size]) for k in range(done, len(y0s), size))
        shown: dict[str, Any] = {"desc": self.plan.ready.name, "unit": "member", "unit_scale": True}
        with (
            tqdm(total=len(y0s), initial=done, disable=not progress, **shown) as bar,
            closing(results(executor, self.plan, chunks, progress=progress)) as parts,
        ):
            try:
                for first, part in parts:
                    done = self._take(first, part)
                    bar.update(done - first)
                    self.write(done, self.whole)
                    if self.callback is not None and self.callback(self._result(part, first)):
                        self.stopped = True
                        return
            finally:  # before the executor ends, because the process may be killed soon
                self.write(done, self.whole, now=True)

    def _take(self, first: int, part: dict[str, Any]) -> int:
        """Add the results `part` of the members from `first` on; return the number of members that are finished."""
        whole, last = self.whole, first + len(part["t"])
        if part["reduced"] is not None:
            whole["reduced"] = placed(whole["reduced"], len(whole["t"]), first, part["reduced"])
        for name in self.plan.not_run(0, 0):
            whole[name][first:last] = part[name]
        whole["one_by_one"] = part["one_by_one"] or whole["one_by_one"]
        return last

    def _result(self, members: dict[str, Any], first: int) -> EnsembleResult:
        """Return the result of members, which begin with number `first`."""
        plan, ready = self.plan, self.plan.ready
        result = EnsembleResult(
            members,
            failed=np.flatnonzero(members["status"] == FAILED),
            success=bool((members["status"] >= 0).all()),
            names=plan.names,
            times=plan.saved,
            first=first,
            stopped=self.stopped,
            wall_time=time.perf_counter() - self.begin,
            method=ready.name,
            h=ready.stepping.h,
            chunk=self.size,
            component_names=ready.problem.component_names,
        )
        count, request = len(members["t"]), plan.task.request
        params = None if request.params is None else self.everyone.params[first : first + count]
        object.__setattr__(result, "_members", (request.fun, params))  # not a field: fields are items of the result
        at_end = result.pop("end_invariants")
        if not plan.held:
            result.update(trajectories=None, invariants=at_end)
        if not plan.events:
            result.update(t_events=None, y_events=None)
            for name in EVENT_DERIVATIVES:
                result.pop(name, None)
        if plan.task.reduce is not None and result.reduced is None:  # all members failed
            result["reduced"] = np.full(len(result.t), np.nan)
        if ready.problem.variations is not None:
            tangents, result["columns"] = ready.tangents, ready.problem.described_columns
            result["y"], result["variations"] = tangents.split(result.y)
            if result.trajectories is not None:
                rows, result["variations"] = tangents.split(result.trajectories.swapaxes(1, 2))
                result["trajectories"] = rows.swapaxes(1, 2)
            if result.y_events is not None:
                result["y_events"] = [[tangents.state(rows) for rows in member] for member in result.y_events]
        if result.y_events is not None:
            events = zip(members["t_events"], result.y_events, self.everyone.params[first:], strict=False)
            found = [at_events(ready, *member) for member in events]
            result |= {name: [member[name] for member in found] for name in found[0]}
        return result


def _inputs(fun: Any, y0s: Any, params: Any, options: dict[str, Any]) -> Chunk:
    """Return all members as one `Chunk`: states (m, n) and parameters (m, p), p = 0 if there are none."""
    problem = fun if isinstance(fun, Problem) else None
    if y0s is None and problem is not None:
        y0s = problem.y0
    if y0s is None:
        raise TypeError("ensemble: y0s is missing; it can be omitted only for a Problem with an initial state.")
    starts = states("y0s", y0s)
    if params is None:
        brought = None if problem is None or problem.rhs is None else problem.params
        own = np.zeros(0) if brought is None else np.asarray(brought, float).reshape(-1)
    else:
        if problem is not None and isinstance(params, Mapping):
            params = problem.named_parameters(params)
        own = np.atleast_1d(parameter_values(params))
        takes_one = problem is not None and problem.params is not None and np.size(problem.params) == 1
        if takes_one and own.ndim == 1 and own.size > 1:
            own = own[:, None]  # one for each member, because they cannot be common to all
    if starts.ndim == 1 and own.ndim == 2:
        starts = np.tile(starts, (len(own), 1))
    if starts.ndim != 2 or starts.size == 0:
        raise ValueError(
            f"y0s must have the shape (members, n), got {starts.shape}; one state (n,) is possible only if params has "
            "a row for each member."
        )
    if own.ndim > 2:
        raise ValueError(f"params must have the shape (p,) or (members, p), got {own.shape}.")
    if own.ndim == 2 and len(own) != len(starts):
        raise ValueError(
            f"params has {len(own)} rows for {len(starts)} members; give one row for each member, or one for all."
        )
    if own.ndim == 2 and any(item.args for item in as_invariants(options.get("invariants", ()))):
        raise ValueError(
            "ensemble: invariants must not have args if params differ between members: omit args; the functions "
            "receive the params of each member as their last argument."
        )
    if options.get("args") is not None:
        own = floats(extra_arguments(options["args"], params))
    return Chunk(0, starts, own if own.ndim == 2 else np.broadcast_to(own, (len(starts), own.size)))


def _with_vectors(everyone: Chunk, options: dict[str, Any]) -> tuple[Chunk, int]:
    """Return the members with the tangent vectors that each has of its own behind its state, and their number."""
    given = options.get("variations")
    if not (isinstance(given, np.ndarray) and given.ndim == 3):
        return everyone, 0
    members, n = everyone.y0s.shape
    if given.shape[:2] != (members, n) or not given.size or given.dtype.kind not in "iuf":
        raise ValueError(
            f"variations: initial columns of each member must be an array of real numbers of the shape (members, n, k) "
            f"= ({members}, {n}, k), got {given.dtype} {given.shape}."
        )
    options["variations"] = given[0]
    y0s = np.concatenate([everyone.y0s, given.swapaxes(1, 2).reshape(members, -1)], axis=1)
    return everyone._replace(y0s=y0s), given.shape[2]


def _bare(fun: Any) -> Any:
    """Return `fun`; if it is a problem with `rhs`, only with that, because its other functions may not be picklable."""
    has_rhs = isinstance(fun, Problem) and fun.rhs is not None
    return dataclasses.replace(fun, fun=fun.rhs, reference=None) if has_rhs else fun


def _first_that_starts(task: Task, everyone: Chunk) -> Plan:
    """Return the plan, made from the first member with a valid start; raise the first error if none has one.

    At most `TRIED` of the members `everyone`, spread over all, are tried. A finding of the checks at the start applies
    to all members with the same parameters.
    """
    errors: list[Exception] = []
    y0s, params = everyone.y0s, everyone.params
    for k in np.unique(np.linspace(0, len(y0s) - 1, TRIED).astype(int)):
        tried = task._replace(request=task.of_member(y0s[k], params[k]))
        try:
            ready = prepared(tried.request)
        except MemoryError:
            raise
        except Exception as error:
            errors.append(error)
            continue
        if found := ready.trust.message:
            ready.trust.doubts.clear()
            tried = tried._replace(doubt=(params[k].copy(), found))
        return _with_common_constraints(Plan(tried, ready), everyone)
    # A transposed y0s fails in the user's function, whose error may not explain that; jitted code explains nothing.
    n = np.size(tried.request.y0)
    errors[0].add_note(f"ensemble: the rows of y0s are members; y0s has {len(y0s)} rows of {n} components.")
    raise errors[0]


def _with_common_constraints(plan: Plan, everyone: Chunk) -> Plan:
    """Return the plan whose members all keep the linear invariants that were found for its first member.

    If one of them does not hold for the parameters of some member, no member keeps any.
    """
    task, ready, conserved = plan.task, plan.ready, plan.ready.conserved
    if conserved.found is None:
        return plan
    C, parameters = conserved.linear.C, ready.problem.parameters
    first = np.unique(everyone.params, axis=0, return_index=True)[1]
    holds = len(C) > 0 and (len(first) == 1 or ready.problem.variations is None)
    if holds and len(first) > 1:
        starts = everyone.y0s[first, : ready.problem.n]
        y = np.array([states_near(start, np.abs(start), (NEAR_DISTANCE,))[0] for start in starts])
        f, own = np.full(y.shape, np.nan), parameters.copy()
        for k, member in enumerate(first):
            parameters[:] = everyone.params[member]
            f[k] = unless_error(ready.problem.derivative, plan.t0, y[k])
        parameters[:] = own
        holds = bool(confirmed(y, f, conserved.linear).all())
    projection = {**task.request.projection, "linear_invariants": (C, C.T) if holds else None}
    task = task._replace(request=task.request._replace(projection=projection))
    return Plan(task, None if len(C) and not holds else ready)


def _chunk_size(plan: Plan, members: int, fun: Any) -> int:
    """Return the number of members in a chunk: at most about one second of work, and a multiple of `LANES`.

    `members` is the number of all members, and `fun` the right-hand side or a `Problem`. The returned number
    depends on the problem and on the number of members, and not on the number of workers.
    """
    rhs = fun.rhs or fun.fun if isinstance(fun, Problem) else fun
    native = is_compiled(rhs) or isinstance(rhs, PointerFunction)
    work = CHUNK_WORK if native and plan.task.request.compiled is not False else INTERPRETED_WORK
    by_work = work / ((expected_steps(plan.ready.schedule) or UNKNOWN_STEPS) * max(4, plan.size))
    by_bytes = CHUNK_BYTES / (plan.size * plan.dtype.itemsize * (1 + plan.times.size))
    size = min(by_work, by_bytes, LARGEST_CHUNK, math.ceil(members / LEAST_CHUNKS))
    return LANES * max(LEAST_BATCHES, math.ceil(size / LANES))


def _check_memory(plan: Plan, members: int, max_bytes: float | None) -> None:
    """Raise MemoryError if the results would need too much memory."""
    rows = plan.held
    each = plan.size * plan.dtype.itemsize * (1 + rows) + 8 * (len(plan.names) * (3 + rows) + N_COUNTERS + 4)
    many = f"{rows} states per member would be stored: save fewer (save_every, t_eval), use reduce="
    advice = many if rows else "the last state of each member would be stored. Run the members in parts"
    what = f"{members} members of {plan.size} components need"
    require_memory(members * each, what, max_bytes, f"{advice}, or increase max_bytes")
