"""The members of an ensemble: what they share, and how those of a chunk run in one process.

A `Task` can be sent to other processes, where it becomes a `Plan` with compiled functions. If members can share the
buffers of one run, the engine runs them: eight at a time in vectors, or one after another. The others run as
`integrate` does. The result of a member depends only on the task, its start and its parameters.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from ..core.event_derivatives import EVENT_DERIVATIVES, event_derivatives
from ..core.functions import CompiledFunction, NotCompilableError, PointerFunction
from ..core.inputs import shown
from ..core.runs import Run
from ..core.step_control import UNBOUNDED, saved_steps
from ..engine import data
from ..engine.native import BUILD, BatchFunctions, LibraryFunction
from ..engine.trust import Trust, exceed_bounds, suspects
from ..run.driver import Driver, expected_steps
from ..run.integrate import ARRIVED, ENDED_BY_EVENT, Loop, assembled
from ..run.prepare import RunArguments, prepared
from ..run.results import IntegrationResult, described
from .result import COUNTERS, FAILED, MEMBER_FIELDS, NOT_RUN

__all__ = ["LANES", "Chunk", "Plan", "Task", "placed", "run_chunk"]

LANES = 8
# Number of steps in the first call of the engine, and the target duration of a call.
FIRST_STEPS, CALL_SECONDS = 1024, 0.1
ENDS = np.array([ARRIVED, ENDED_BY_EVENT], object)
LEAST_WORK = 3e7  # floats times steps, one or two seconds: compiling functions for eight members takes as long


class StoppedError(BaseException):
    """Exception that ends members that run while their ensemble is stopped; it is not an error of a member."""


class Chunk(NamedTuple):
    """Members that run together: the number `first` of the first one, their initial states, and their parameters."""

    first: int
    y0s: np.ndarray  # (m, n); (m, n + k n) if each has k tangent vectors of its own, which follow its state
    params: np.ndarray  # (m, p)


class Task(NamedTuple):
    """The part of an ensemble that all members share, in a form that can be sent to other processes."""

    request: RunArguments  # arguments of `integrate` for one member with a valid start
    members: int  # total number of members
    reduce: Callable[[Any], Any] | None  # function of the result of a member, whose value replaces saved states
    vectors: int = 0  # number of tangent vectors that each member has of its own, see `Chunk`
    doubt: tuple[np.ndarray, str] | None = None  # parameters for which the checks at the start found the given fault

    def of_member(self, start: np.ndarray, params: np.ndarray) -> RunArguments:
        """Return the arguments of `integrate` for a member with a row `start` of y0s; they may have no parameters."""
        y0, *vectors = start.reshape(1 + self.vectors, -1).copy()
        given = self.request._replace(y0=y0, params=None if self.request.params is None else params.copy())
        return given._replace(variations=np.transpose(vectors)) if vectors else given

    def prepared(self, start: np.ndarray, params: np.ndarray) -> Run:
        """Return the run of one member, prepared as `integrate` does, without the checks at its start."""
        return prepared(self.of_member(start, params), check_start=False)


class Plan:
    """A task in one process, compiled if possible, with a `BatchRunner` for each thread if members can share a run.

    `ready` is the run of the member of `task`, if it has been prepared already.
    `why_not` is the reason why the members run interpreted, None if they are compiled, and `not_batched_because` the
    reason why they run one after the other, "" if they are vectorised; both are known after compilation. `saved` are
    the times of the saved states that the result has, and `times` those that a member has.
    """

    def __init__(self, task: Task, ready: Run | None = None) -> None:
        self.task = task
        self.ready = prepared(task.request, check_start=False) if ready is None else ready
        self.why_not: str | None = None
        self.not_batched_because = ""
        run, schedule = self.ready, self.ready.schedule
        self.names = tuple(run.invariants.names)
        self.size, self.dtype, self.t0 = run.y0.size, run.y0.dtype, schedule.span.t0
        self.events = len(self.ready.problem.events.functions)
        self.saved = saved_times(schedule)
        self.times = np.array([self.t0]) if task.reduce is not None and not self.saved.size else self.saved
        self.held = self.times.size if task.reduce is None else 0  # number of saved states that the result keeps
        self._shares_run, self._idle = False, list[BatchRunner]()

    def compile(self, *, progress: bool = False) -> Plan:
        """Compile the functions, before threads start and would each compile them, and return the plan itself."""
        run, invariants = self.ready, self.ready.invariants
        loop = Loop(run, self.task.request._replace(progress=progress))
        own_starts = run.projection.project_initial or any(item.target is not None for item in invariants.items)
        reasons: dict[str, Any] = {
            "the runs have balances": invariants.balances.items,
            # The shifts of the differences depend on the start.
            "the gradient of an invariant is computed by differences": invariants.by_differences,
            "the gradient of an invariant is made of f, by masses of each member": run.conserved.masses.size,
            "the scale of an invariant that depends on time depends on the start": run.depends_on_time,
            "the start of each member is projected, or an invariant has a target": own_starts,
        }
        self.why_not = loop.why_not
        self.not_batched_because = self.why_not or next(filter(reasons.get, reasons), "")
        self._shares_run = not self.not_batched_because
        if self._shares_run:
            self._idle = [BatchRunner(self, loop)]
            self.not_batched_because = self._idle[0].not_batched_because
        return self

    def not_run(self, m: int, rows: int) -> dict[str, Any]:
        """Return the fields of `m` members that did not run, with `rows` saved states, one after the other in memory.

        ``t_events`` and ``y_events`` have a list for each member, with an array for each event; without events they are
        empty.
        """
        sizes, found = {"component": self.size, "invariant": len(self.names), "time": rows}, dict[str, Any]()
        for name, field in MEMBER_FIELDS.items():
            if field.dims:
                kind = self.dtype if "component" in field.dims else object if isinstance(field.unset, str) else None
                values = np.full([m, *(sizes[dim] for dim in field.dims[:0:-1])], field.unset, kind)
                found[name] = values.swapaxes(1, 2) if values.ndim == 3 else values
        members = range(m if self.events else 0)
        found["t_events"] = [[np.zeros(0)] * self.events for _ in members]
        found["y_events"] = [[np.zeros((0, self.size), self.dtype)] * self.events for _ in members]
        if self.ready.problem.variations is not None:
            n, count = self.ready.tangents.n, self.ready.tangents.count
            for name, shape in zip(EVENT_DERIVATIVES, ((n, count), (count,), (n, count)), strict=True):
                found[name] = [[np.zeros((0, *shape))] * self.events for _ in members]
        return found

    def starts(self, y0s: np.ndarray, params: np.ndarray) -> np.ndarray:
        """Return the states (m, size) at which runs start, with tangent vectors if they have these."""
        if self.ready.problem.variations is None:
            return y0s
        if not self.task.vectors:
            return self.ready.tangents.augmented(y0s, params)
        rows = y0s.reshape(len(y0s), 1 + self.task.vectors, -1)
        return self.ready.tangents.augmented(rows[:, 0], params, rows[:, 1:])

    def run(self, y0s: np.ndarray, params: np.ndarray, stop: threading.Event | None = None) -> dict[str, Any]:
        """Run members with the initial states `y0s` (m, n) and the parameters `params` (m, p); return their results.

        A member that fails, also by an exception in the user's functions, has the status `FAILED` and a message with
        the reason; it does not affect the others. If `stop` is set, StoppedError ends the members soon.
        """
        out, watch = self.not_run(len(y0s), self.times.size), _Watch(stop)
        if self._shares_run:
            runner = self._runner()
            runner.run_batch(y0s, params, out, watch)
            self._idle.append(runner)
        for k in np.flatnonzero(out["status"] < 0).tolist():
            for name, value in self._alone(y0s[k], params[k], watch, out["y"][k]).items():
                out[name][k] = value
        if self.task.doubt is not None:
            of, text = self.task.doubt
            for k in np.flatnonzero(out["trusted"] & (params == of).all(axis=1)).tolist():
                out["trusted"][k], out["message"][k] = False, f"{out['message'][k]}; {text}"
        return out

    def _runner(self) -> BatchRunner:
        """Return a runner that no other thread is using."""
        try:
            return self._idle.pop()
        except IndexError:
            request = self.task.request
            return BatchRunner(self, Loop(prepared(request, check_start=False), request))

    def _alone(self, y0: np.ndarray, params: np.ndarray, watch: _Watch, unset: np.ndarray) -> dict[str, Any]:
        """Run a member as `integrate` does, and return its fields; `unset` is the state of one that did not run."""
        loop = None
        try:
            loop = Loop(self.task.prepared(y0, params), self.task.request)
            status, message = loop.steps(watch)
        except Exception as error:
            status, message = FAILED, f"{type(error).__name__}: {error}"
        if loop is None:
            start = self.task.of_member(y0, params).y0
            return {
                "y": self.ready.tangents.with_state(unset, start),
                "t": self.t0,
                "status": status,
                "message": message,
            }
        driver, target = loop.driver, loop.driver.run.invariants.fixed_target
        t, y = loop.events.last if status == 1 else driver.now
        values, at_end = np.full((driver.rows + 1, target.size), np.nan), np.full(target.size, np.nan)
        with suppress(Exception):  # a function may raise again what has ended the member
            if status == FAILED:
                driver.save_now()
                y = driver.y[driver.rows - 1]
            values[: driver.rows] = driver.values()
            at_end[:] = driver.values_at(np.array([t]), y[None].copy())
        driver.note(values[: driver.rows], target)
        rows = min(driver.rows, self.times.size)
        rows = int(np.cumprod(driver.t[:rows] == self.times[:rows]).sum())  # the last one may be of an early end
        padding = ((0, 0), (0, self.times.size - rows))
        message = described(message, driver.run.diagnostics, loop.notes())
        found = {
            "y": y, "t": t, "status": status, "message": message, "target": target,
            "trusted": driver.run.trust.trusted and status >= 0, "max_residual": driver.run.work.max_residual,
            "max_correction": loop.driver.run.diagnostics.max_correction, "end_invariants": at_end,
            "trajectories": np.pad(driver.y[:rows].T, padding, constant_values=np.nan),
            "invariants": np.pad(values[:rows].T, padding, constant_values=np.nan),
            **{name: driver.run.work.counters[place] for name, place in COUNTERS.items()},
        }  # fmt: skip
        if self.events:
            found["t_events"] = [np.array(t) for t in loop.events.t]
            found["y_events"] = [np.array(y, self.dtype).reshape(len(y), self.size) for y in loop.events.y]
            derivatives, remarks = event_derivatives(driver.run.problem, self.t0, loop.events.t, loop.events.y)
            found |= {"message": "; ".join([found["message"], *remarks]), **derivatives}
        return found


class BatchRunner:
    """The compiled run of a plan with its buffers, on which the engine runs members.

    In the methods, `each` holds the inputs of the members and the buffers that the engine fills, and `out` the results.
    `not_batched_because` is the reason why members run one after the other; "" if they are vectorised.
    """

    def __init__(self, plan: Plan, loop: Loop) -> None:
        self._plan, self._loop, self._driver = plan, loop, loop.driver
        work = loop.driver.run.work
        self._sigma, self._evaluations = work.sigma.copy(), int(work.counters[data.NFEV])
        self._left = np.array(loop.events.left)
        self._steps = FIRST_STEPS
        self.not_batched_because = not_batched_because(loop.driver, plan.task.members)

    def run_batch(self, y0s: np.ndarray, params: np.ndarray, out: dict[str, Any], watch: _Watch) -> None:
        """Run members and store their results, except of those whose status stays `NOT_RUN`.

        These have failed, or need what only the loop of `integrate` does.
        """
        # Arrays that come from other processes may be read-only or not aligned, which the engine does not take.
        y0s, params = (np.require(a, requirements=["A", "C", "W"]) for a in (self._plan.starts(y0s, params), params))
        each = self._inputs(y0s, params, out)
        while each.where[0] < len(y0s):
            watch.update()
            begin = time.perf_counter()
            if self._advance(each, out) and each.where[0] < len(y0s):
                faster = CALL_SECONDS / max(time.perf_counter() - begin, 1e-9)
                self._steps = max(1, int(self._steps * min(2.0, faster)))  # the last call may have been cut short
        arrived = np.flatnonzero(out["status"] >= 0)
        try:
            self._evaluate(arrived, each, out)
        except Exception:  # of a function of an invariant, at a state of one of the members
            out["status"][arrived] = NOT_RUN
            return
        out["side_by_side"][arrived] = not self.not_batched_because
        for name, place in COUNTERS.items():
            out[name][arrived] = each.counters[arrived, place]
        if np.isnan(self._driver.run.diagnostics.max_correction):  # the method has no error estimate
            out["max_correction"][arrived] = np.nan
        BUILD.call(self._judge, arrived, each, out)
        if self._plan.events and self._driver.run.problem.variations is not None:
            self._differentiate_events(np.flatnonzero(out["status"] >= 0), each, out)

    def _differentiate_events(self, arrived: np.ndarray, each: data.Members, out: dict[str, Any]) -> None:
        """Store the derivatives at the events of the members `arrived`, and remarks on those that are missing."""
        for k in arrived.tolist():
            self._driver.params[:] = each.params[k]
            problem, t0 = self._driver.run.problem, self._plan.t0
            found, remarks = event_derivatives(problem, t0, out["t_events"][k], out["y_events"][k])
            for name, value in found.items():
                out[name][k] = value
            out["message"][k] = "; ".join([out["message"][k], *remarks])

    def _inputs(self, y0s: np.ndarray, params: np.ndarray, out: dict[str, Any]) -> data.Members:
        """Return the inputs of the members and the buffers for their results."""
        m, kept = len(y0s), self._plan.times.size > 0
        first_steps, events = self._at_start(y0s, params)
        return data.Members(
            starts=y0s, params=params, first_steps=first_steps, events=events, evaluations=self._evaluations,
            sigma=self._sigma, left=self._left, t_saved=self._driver.t, kept=kept, where=np.zeros(2, np.int64),
            rows=np.empty((m if kept else 1, *self._driver.y.shape), y0s.dtype),
            counters=np.zeros((m, data.N_COUNTERS), np.int64),
            figures=np.zeros((m, *self._driver.run.work.trust.shape)),
            suspects=np.zeros((m, self._driver.run.work.suspect.size)),
            **{name: out[name] for name in ("y", "t", "status", "max_residual", "max_correction")},
        )  # fmt: skip

    def _at_start(self, y0s: np.ndarray, params: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the length (m,) of each member's first step, NaN if it cannot be found, and the events (m, events)."""
        run, span, events = self._driver.run, self._driver.schedule.span, self._loop.events
        known = run.stepping.h or run.stepping.first_step
        taus, values = np.full(len(y0s), known or np.nan), np.zeros((len(y0s), len(events.functions)))
        for k, y0 in enumerate(y0s if events.functions or not known else ()):
            derivative, state = self._derivative(params[k]), run.tangents.state
            try:
                f = derivative(span.t0, y0)
                of_state = run.tangents.of_state(derivative, y0)
                taus[k] = known or run.stepping.first(of_state, state(y0), state(f), run.method)
                values[k] = events.at_start(span.t0, y0, f, span.sign * taus[k])
            except Exception:
                taus[k] = np.nan
        return taus, values

    def _derivative(self, params: np.ndarray) -> Callable[[float, np.ndarray], np.ndarray]:
        """Set the parameters of the driver to those of a member, and return the right-hand side."""
        self._driver.params[:] = params
        return self._driver.run.problem.derivative

    def _advance(self, each: data.Members, out: dict[str, Any]) -> bool:
        """Make some steps; return False if the current member must run alone, and go to the next one then."""
        driver, first = self._driver, int(each.where[0])
        try:
            code = driver.sweep(each, self._steps)
        except Exception:  # of a user's function; it is raised again when the member runs alone
            code = None
        if code != data.OK:
            each.where[:] = each.where[0] + 1, 0
        elif self._loop.events.functions and each.where[0] > first:
            which, t, y = driver.interpolants.roots()
            for name, values in (("t_events", t), ("y_events", y)):
                out[name][first] = [values[which == k].copy() for k in range(len(self._loop.events.functions))]
        return code == data.OK

    def _judge(self, arrived: np.ndarray, each: data.Members, out: dict[str, Any]) -> None:
        """Store the messages of the members `arrived` at their ends, and whether they are reliable.

        Steps that the engine has marked as suspicious are examined. The invariants are checked at the ends of the
        members, in their order, up to the first member at which nothing is found.
        """
        run, t0 = self._driver.run, self._driver.schedule.span.t0
        out["trusted"][arrived], out["message"][arrived] = True, ENDS[out["status"][arrived]]
        at_ends = run.options.watched
        suspected = suspects(each.figures, each.suspects) & at_ends
        doubtful = np.asarray(exceed_bounds(each.figures).any(axis=1) | suspected)
        for k in arrived.tolist():
            if not (at_ends or doubtful[k]):
                continue
            trust = Trust(run.invariants.names, each.figures[k])
            if at_ends or suspected[k]:
                derivative, start = self._derivative(each.params[k]), each.starts[k]
                run.invariants.target[:] = run.invariants.values(t0, start)
                scaled = map(run.tangents.state, (start, derivative(t0, start)))
                tau = run.stepping.scale_of_time(float(each.first_steps[k]), *scaled)
                examiner = replace(run.examiner, tau=tau, figures=each.figures[k], largest=0.0)
                found = [examiner.examine(each.suspects[k], derivative)] if suspected[k] else []
                if at_ends:
                    found.append(examiner.finding(derivative, float(out["t"][k]), out["y"][k]))
                    at_ends = found[-1] is not None
                trust.doubts += list(filter(None, found))[:1]
            if run.options.adaptive and trust.is_doubtful():
                out["status"][k] = NOT_RUN  # alone it may end early
            elif not trust.trusted:
                out["trusted"][k] = False
                out["message"][k] += f"; {trust.message}"

    def _evaluate(self, arrived: np.ndarray, each: data.Members, out: dict[str, Any]) -> None:
        """Store the saved states of members, and the invariants at their starts, ends and saved states.

        The state at an event that ended a member does not count for its largest error if `t_eval` was given, as in the
        result of a single run.
        """
        driver, times, params = self._driver, self._plan.times, each.params[arrived]
        t0, sampled = driver.schedule.span.t0, driver.schedule.t_eval.size > 0
        target = driver.values_at(np.full(arrived.size, t0), each.starts[arrived], params)
        last = driver.values_at(out["t"][arrived], out["y"][arrived], params)
        out["target"][arrived], out["end_invariants"][arrived] = target, last
        last = np.where((out["status"][arrived, None] == 1) & sampled, target, last)
        errors = np.fmax(out["max_residual"][arrived], np.abs(last - target))
        if times.size:
            rows = each.rows[arrived, : times.size]
            out["trajectories"][arrived] = rows.swapaxes(1, 2)
            members, places = np.nonzero(~np.isnan(rows).any(axis=2))
            found = np.full((*rows.shape[:2], target.shape[1]), np.nan)
            found[members, places] = driver.values_at(times[places], rows[members, places], params[members])
            out["invariants"][arrived] = found.swapaxes(1, 2)
            found = np.abs(found[:, times != t0] - target[:, None])
            errors = np.fmax(errors, np.fmax.reduce(found, axis=1, initial=0.0))
        out["max_residual"][arrived] = errors


@dataclass
class _Watch:
    """Stand-in for a progress bar, which a run calls regularly; it stops the run if requested."""

    stop: threading.Event | None
    n: float = 0.0

    def update(self, amount: float = 0.0) -> None:
        if self.stop is not None and self.stop.is_set():
            raise StoppedError


def saved_times(schedule: data.Schedule) -> np.ndarray:
    """Return the times of the rows that a run saves; empty if it saves only its two ends.

    ValueError is raised if members would save at different times, or if the interval is infinite.
    """
    if schedule.t_eval.size or schedule.save_every == 0:
        return schedule.t_eval.copy()
    if not expected_steps(schedule):
        raise ValueError(
            "save_every in an ensemble needs fixed steps h and a finite interval, because with adaptive steps each "
            "member would save at different times; give t_eval."
        )
    times = schedule.span.t0 + saved_steps(schedule.span.n_steps, schedule.save_every) * schedule.span.h
    times[-1] = schedule.span.t_bound
    return times


def run_chunk(plan: Plan, chunk: Chunk, *, stop: threading.Event | None = None) -> dict[str, Any]:
    """Run the members of a chunk, and return their results, without saved states if these are reduced.

    An exception that `reduce` raises gets a note with the number of the member.
    """
    members = plan.run(chunk.y0s, chunk.params, stop) | {"reduced": None, "one_by_one": plan.not_batched_because}
    if plan.task.reduce is None:
        return members
    for k in np.flatnonzero(members["status"] >= 0).tolist():
        try:
            found = plan.task.reduce(_result(plan, members, k, chunk.params[k]))
            value = np.asarray(found)
            if value.dtype.kind not in "biufc":
                raise TypeError(f"reduce returned {shown(found)}; expected a number or an array of numbers.")
            members["reduced"] = placed(members["reduced"], len(chunk.y0s), k, value[None])
        except Exception as error:
            error.add_note(f"ensemble: this is reduce for member {chunk.first + k}")
            raise
    return members | {name: members[name][..., :0].copy() for name in ("trajectories", "invariants")}


def placed(out: np.ndarray | None, members: int, first: int, values: np.ndarray) -> np.ndarray:
    """Return the rows `out` of all `members` with `values` from row `first` on; None stands for rows of NaN.

    ValueError is raised if the values of members differ in shape.
    """
    if out is None:
        out = np.full((members, *values.shape[1:]), np.nan)
    if values.shape[1:] != out.shape[1:]:
        raise ValueError(
            f"reduce returned arrays of shape {out.shape[1:]} and {values.shape[1:]} for different members; return the "
            "same shape for all of them. Members that an event ends may have fewer states."
        )
    out = out.astype(np.result_type(out, values), copy=False)
    out[first : first + len(values)] = values
    return out


def _result(plan: Plan, members: dict[str, Any], k: int, params: np.ndarray) -> IntegrationResult:
    """Return the result of member `k` as `integrate` does, with the fields that do not need the run itself."""
    states, values = (members[name][k].T for name in ("trajectories", "invariants"))
    rows = np.count_nonzero(~np.isnan(states).any(axis=1))
    t, states, values = plan.times[:rows], states[:rows], values[:rows]
    if plan.ready.schedule.t_eval.size == 0 and members["t"][k] not in t[-1:]:
        ends = (t, "t"), (states, "y"), (values, "end_invariants")
        t, states, values = (np.concatenate([saved, members[name][k : k + 1]]) for saved, name in ends)
    return assembled(
        plan.ready,
        states,
        (members["t_events"][k], members["y_events"][k]) if plan.events else None,
        {place: members[name][k] for name, place in COUNTERS.items()},  # type: ignore[arg-type]
        params,
        t=t,
        invariants=values.T,
        status=int(members["status"][k]),
        success=True,
        trusted=bool(members["trusted"][k]),
        compiled=plan.why_not is None,
        h=plan.ready.stepping.h,
        **{name: members[name][k] for name in ("message", "target", "max_residual")},
        **{name: members[name][k] for name in EVENT_DERIVATIVES if plan.events and name in members},
    )


def not_batched_because(driver: Driver, members: int) -> str:
    """Return the reason why `members` members cannot be vectorised; "" if they can, with their functions compiled."""
    run, options, schedule = driver.run, driver.run.options, driver.schedule
    history = run.stepper.multistep
    reasons: dict[str, Any] = {
        "steps are adaptive": options.adaptive,
        "the interval is infinite": schedule.span.n_steps >= UNBOUNDED,
        "the state is complex": run.y0.dtype.kind == "c",
        "the runs have derivatives, which are projected": run.problem.variations is not None
        and run.invariants.size > 0,
        "events may end members at different times": schedule.g.size > 0,
        "the run has fewer steps than the history of the method": history is not None and history.brief,
        "compensated=True": history is None and options.compensated,
        "every='auto'": history is None and options.every == data.AUTO,
        "iterations > 1": options.iterations > 1,
        "direction is not 'new'": options.direction != data.NEW,
    }
    if reason := next(filter(reasons.get, reasons), ""):
        return reason
    little, keepalive = members * schedule.span.n_steps * run.y0.size < LEAST_WORK, driver.functions.keepalive
    try:
        names = ("rhs", "inv", "grad", "jacobian")
        rhs, inv, grad, jacobian = (tuple(_for_lanes(one, little) for one in keepalive.get(name, ())) for name in names)
    except NotCompilableError as error:
        return str(error)
    product = jacobian[0][0] if jacobian else None
    driver.engine.side_by_side(BatchFunctions(rhs[0][0], inv, grad, driver.functions, product))
    return ""


def _for_lanes(native: CompiledFunction, little: bool) -> tuple[Any, int]:
    """Return the version of a function for eight members, and the number of floats that it fills for each member.

    If there is `little` work, no function is compiled. NotCompilableError is raised for a function without a version.
    """
    one: Any = native.function
    if isinstance(one, LibraryFunction):
        if not one.lanes8_address:
            raise NotCompilableError(f"{one.__name__} of this package is written for one member at a time")
        return one, native.floats
    if isinstance(one, PointerFunction):
        raise NotCompilableError(f"{one.name} is a C function, which is called for one member at a time")
    if little:
        raise NotCompilableError("compiling functions for eight members would take longer than the run")
    from ..core.numba_bridge import compiled  # both load Numba
    from .lanes8 import LANES8

    # An array of n floats becomes (n, 8) doubles. The function must not branch on values or create arrays.
    return compiled(one.fun, one.kind, one.name, LANES8).address, native.floats
