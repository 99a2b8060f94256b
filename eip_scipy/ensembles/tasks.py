"""The members of an ensemble: a driver that is set up once and runs them one after the other, or in batches.

A `Task` contains everything that members share, and can be sent to other processes. In each process it becomes a
`Plan`, with compiled functions and buffers, which `run_members` runs. The result of a member depends only on the task,
its start and its parameters: it agrees bit by bit with `integrate`, regardless of the other members.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from ..core.failures import failure
from ..core.functions import NotCompilableError
from ..core.runs import Run
from ..core.stepping import UNBOUNDED, saved_steps
from ..engine import data
from ..engine.data import DOUBTFUL, N_COUNTERS, NFEV, OK, PAUSE, Schedule
from ..engine.native import BUILD
from ..engine.trust import Trust, sick, suspects
from ..run.driver import Driver, saved_rows
from ..run.integrate import ARRIVED, ENDED_BY_EVENT, Loop
from ..run.prepare import RunArguments, prepared
from .side_by_side import need_compiling, octet_functions, why_one_by_one

__all__ = ["FAILED", "NOT_RUN", "Members", "Plan", "StoppedError", "Task", "run_members"]

FAILED, NOT_RUN = -1, -2
# Number of steps in the first call of the engine, and the target duration of a call.
FIRST_STEPS, SWEEP_SECONDS = 1024, 0.1
ENDS = (ARRIVED, ENDED_BY_EVENT)
BY_MEMBER = (
    *("starts", "params", "first_steps", "events", "y", "t", "status", "max_residual", "counters", "max_correction"),
    *("figures", "suspects"),
)
LEAST_WORK = 3e7  # floats times steps, one or two seconds: compiling functions for eight members takes as long
Events = list[list[np.ndarray]]  # for each member, an array for each event


class StoppedError(Exception):
    """Exception that ends members that run while their ensemble is stopped."""


@dataclass(frozen=True)
class Task:
    """The part of an ensemble that all members share, in a form that can be sent to other processes."""

    request: RunArguments  # arguments of `integrate` for one member with a valid start
    members: int = 1  # total number of members
    reduce: Callable[[Any], Any] | None = None  # function of the result of a member, whose value replaces saved states
    doubt: tuple[np.ndarray, str] | None = None  # parameters for which the checks at the start found the given fault

    def prepared(self, y0: np.ndarray, params: np.ndarray | None, *, check_start: bool = False) -> Run:
        """Return the run of one member, prepared as `integrate` does; without parameters if the request has none."""
        params = None if self.request.params is None else params
        return prepared(self.request._replace(y0=y0, params=params), check_start=check_start)


class Members(NamedTuple):
    """Results of m members, see `EnsembleResult`."""

    y: np.ndarray  # (m, n): last states
    t: np.ndarray  # (m,): their times
    status: np.ndarray  # (m,): 0 or 1, as in `integrate`, `FAILED`, or `NOT_RUN`
    message: np.ndarray  # (m,): str
    max_residual: np.ndarray  # (m, l)
    counters: np.ndarray  # (m, N_COUNTERS): the engine's, such as that of the evaluations of f (index `NFEV`)
    max_correction: np.ndarray  # (m,)
    side_by_side: np.ndarray  # (m,)
    trusted: np.ndarray  # (m,)
    saved: np.ndarray  # (m, times, n): states at the `times` of the plan; nan after the end of a member
    saved_values: np.ndarray  # (m, times, l): values of the invariants in the saved states
    values: np.ndarray  # (m, l): values of the invariants in the last states
    target: np.ndarray  # (m, l)
    t_events: Events  # times (k,) of each event; an empty list instead of all members if there are no events
    y_events: Events  # states (k, n)

    @classmethod
    def empty(cls, m: int, n: int, dtype: Any, invariants: int, times: int, events: int) -> Members:
        """Return the results of `m` members that did not run, for states with `n` components at `times` times."""
        no_events = range(m if events else 0)
        return cls(
            y=np.full((m, n), np.nan, dtype),
            t=np.full(m, np.nan),
            status=np.full(m, NOT_RUN),
            message=np.full(m, "not run", object),
            max_residual=np.full((m, invariants), np.nan),
            counters=np.zeros((m, N_COUNTERS), np.int64),
            max_correction=np.full(m, np.nan),
            side_by_side=np.zeros(m, bool),
            trusted=np.zeros(m, bool),
            saved=np.full((m, times, n), np.nan, dtype),
            saved_values=np.full((m, times, invariants), np.nan),
            values=np.full((m, invariants), np.nan),
            target=np.full((m, invariants), np.nan),
            t_events=[[np.zeros(0)] * events for _ in no_events],
            y_events=[[np.zeros((0, n), dtype)] * events for _ in no_events],
        )


class Plan:
    """A task in one process, compiled if possible, with a driver for each thread that needs one.

    `why_not` is the reason why the members run interpreted, None if they are compiled, and `one_by_one` the reason why
    they run one after the other, "" if they are vectorised; both are known after compilation.
    """

    def __init__(self, task: Task, ready: Run | None = None) -> None:
        """Create the plan; `ready` is the run of the member of `task`, if it has been prepared already."""
        self.task = task
        self.ready = task.prepared(task.request.y0, task.request.params) if ready is None else ready
        schedule, run = self.ready.schedule, self.ready
        self.why_not: str | None = None
        self.one_by_one = ""
        self.names = tuple(run.invariants.names)
        self.size, self.dtype, self.t0 = run.y0.size, run.y0.dtype, schedule.span.t0
        self.h = run.stepping.h
        # Times at which states are saved; none if only the last state is needed.
        self.times = saved_times(schedule)
        self.is_saving = self.times.size > 0
        self.held = self.times.size if task.reduce is None else 0  # number of saved states that results keep
        if task.reduce is not None and not self.is_saving:
            self.times = np.array([self.t0])
        self.events = len(self.ready.problem.events.functions)
        self.variations = self.ready.problem.variations
        self.n_steps = None if schedule.span.n_steps >= UNBOUNDED else schedule.span.n_steps
        self._together, self._idle = False, list[Sweeper]()

    def compile(self, *, progress: bool = False) -> Plan:
        """Compile the functions, before threads start and would each compile them, and return the plan itself."""
        ready, invariants = self.ready, self.ready.invariants
        loop = Loop(ready, self.task.request._replace(progress=progress))
        own_targets = any(item.target is not None for item in invariants.items)
        reasons = {
            "the runs have derivatives": self.variations is not None,
            "the runs have balances": invariants.balances.items,
            # The shifts of the differences depend on the start.
            "the gradient of an invariant is computed by differences": invariants.by_differences,
            "the scale of an invariant that depends on time depends on the start": self.ready.depends_on_time,
            "the start of each member is projected, or an invariant has a target": own_targets
            or ready.identity()["project_initial"],
        }
        self.why_not = loop.why_not
        self.one_by_one = self.why_not or next((reason for reason, holds in reasons.items() if holds), "")
        self._together = not self.one_by_one
        if self._together:
            sweeper = Sweeper(loop, self.task.members)
            self.one_by_one, self._idle = sweeper.one_by_one, [sweeper]
        return self

    def empty(self, m: int, rows: int | None = None) -> Members:
        """Return buffers for `m` members with `rows` saved states, by default those that a member saves."""
        rows = self.times.size if rows is None else rows
        return Members.empty(m, self.size, self.dtype, len(self.names), rows, self.events)

    @contextmanager
    def driver(self) -> Iterator[Sweeper | None]:
        """Yield a `Sweeper` that no other thread is using; None if each member needs its own run."""
        if not self._together:
            yield None
            return
        try:
            mine = self._idle.pop()
        except IndexError:
            request = self.task.request
            mine = Sweeper(Loop(self.task.prepared(request.y0, request.params), request), self.task.members)
        yield mine
        self._idle.append(mine)


def saved_times(schedule: Schedule) -> np.ndarray:
    """Return the times of the rows that a run saves; empty if it saves only its two ends.

    ValueError is raised if members would save at different times, or if the interval is infinite.
    """
    if schedule.t_eval.size:
        return schedule.t_eval.copy()
    if schedule.save_every == 0:
        return np.zeros(0)
    if saved_rows(schedule) == 0:
        raise ValueError(
            "save_every in an ensemble needs fixed steps h and a finite interval, because with adaptive steps each "
            "member would save at different times; give t_eval."
        )
    times = schedule.span.t0 + saved_steps(schedule.span.n_steps, schedule.save_every) * schedule.span.h
    times[-1] = schedule.span.t_bound
    return times


def run_members(plan: Plan, y0s: np.ndarray, params: np.ndarray, stop: threading.Event | None = None) -> Members:
    """Run members with the initial states `y0s` (m, n) and the parameters `params` (m, p), and return their results.

    A member that fails, also by an exception in the user's functions, has the status `FAILED` and a message with the
    reason; it does not affect the others. If `stop` is set, StoppedError ends the members within tenths of a second.
    """
    out = plan.empty(len(y0s))
    watch = _Watch(stop)
    with plan.driver() as driver:
        if driver is not None:
            driver.run(plan, y0s, params, out, watch)
        else:
            for k in range(len(y0s)):
                _alone(plan, k, y0s[k], params[k], out, watch)
    if plan.task.doubt is not None:
        of, text = plan.task.doubt
        for k in np.flatnonzero(out.trusted & (params == of).all(axis=1)).tolist():
            out.trusted[k], out.message[k] = False, f"{out.message[k]}; {text}"
    return out


class _Watch:
    """Stand-in for a progress bar, which a run calls regularly; it stops the run if requested."""

    n = 0.0

    def __init__(self, stop: threading.Event | None) -> None:
        self._stop = stop

    def update(self, amount: float = 0.0) -> None:
        if self._stop is not None and self._stop.is_set():
            raise StoppedError


def _alone(plan: Plan, k: int, y0: np.ndarray, params: np.ndarray, out: Members, watch: _Watch) -> None:
    """Run member `k` as `integrate` does, and store its results in `out`."""
    try:
        loop = Loop(plan.task.prepared(y0, params), plan.task.request)
    except Exception as error:
        out.y[k], out.t[k] = plan.ready.tangents.with_state(out.y[k], y0), plan.t0
        out.status[k], out.message[k] = FAILED, _reason(error)
        return
    broken = False
    try:
        status, message = loop.steps(watch)
    except StoppedError:
        raise
    except Exception as error:
        status, message, broken = FAILED, _reason(error), True
    _store(loop, k, status, loop.explained(message), out, loop.driver.y[: loop.driver.rows], broken=broken)
    rows = min(loop.driver.rows, plan.times.size)
    same = np.flatnonzero(loop.driver.t[:rows] != plan.times[:rows])
    rows = int(same[0]) if same.size else rows
    out.saved[k, :rows] = loop.driver.y[:rows]
    out.saved_values[k, :rows] = _values(loop.driver, loop.driver.t[:rows], loop.driver.y[:rows])
    out.values[k] = _values(loop.driver, out.t[k : k + 1], out.y[k : k + 1])[0]
    out.target[k] = loop.driver.run.invariants.fixed_target
    schedule = loop.driver.schedule
    after = loop.driver.t[:rows] != schedule.span.t0
    _cover(out, slice(k, k + 1), out.saved_values[k, :rows][None, after], schedule)
    if plan.events:
        out.t_events[k] = [np.array(t) for t in loop.events.t]
        out.y_events[k] = [np.array(y, plan.dtype).reshape(len(y), plan.size) for y in loop.events.y]


def _cover(out: Members, those: slice, rows: np.ndarray, schedule: Schedule) -> None:
    """Update the largest invariant errors of some members, `those`, with errors in saved states and at the end.

    `rows` (m, k, l) are the values of the invariants in k saved states.

    The state at an event that ended a member is not included if `t_eval` was given, as in the result of a single run.
    """
    target, before = out.target[those], out.max_residual[those]
    not_saved = (out.status[those] == 1) & (schedule.t_eval.size > 0)
    with np.errstate(invalid="ignore"):  # members that have failed contain nan
        last = np.where(not_saved[:, None], 0.0, np.abs(out.values[those] - target))
        largest = np.fmax(last, np.fmax.reduce(np.abs(rows - target[:, None]), axis=1, initial=0.0))
    out.max_residual[those] = np.where(np.isnan(before), before, np.fmax(before, largest))


def _values(driver: Driver, t: np.ndarray, y: np.ndarray, *params: np.ndarray) -> np.ndarray:
    """Return the invariants (m, l) of states (m, n), nan if an invariant cannot be evaluated."""
    try:
        return driver.values_at(t, y, *params)
    except Exception:
        if len(t) == 1:
            return np.full((1, driver.run.invariants.size), np.nan)
        each = [_values(driver, t[k : k + 1], y[k : k + 1], *(p[k : k + 1] for p in params)) for k in range(len(t))]
        return np.concatenate(each)


def _store(
    loop: Loop, k: int, status: int, message: str, out: Members, rows: np.ndarray, *, broken: bool = False
) -> None:
    """Store the results of member k, whose saved states are `rows`; `broken` is True if a function raised an error."""
    driver, work = loop.driver, loop.driver.run.work
    t, y = driver.now
    if status == 1:
        t, y = loop.events.last
    elif status == FAILED and not broken:
        y = rows[-1] if len(rows) and driver.t[len(rows) - 1] == t else driver.shown(t, y)
    out.y[k], out.t[k] = y, t
    out.max_residual[k] = work.max_residual
    out.counters[k] = work.counters
    out.max_correction[k] = loop.diagnostics.max_correction
    out.trusted[k] = driver.run.trust.trusted and status >= 0
    out.status[k], out.message[k] = status, message


def _reason(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"


class Sweeper:
    """A compiled run with its buffers, which the engine uses for all members.

    In the methods, `each` holds the inputs of the members and the buffers that the engine fills, and `out` the results.
    `one_by_one` is the reason why members run one after the other; "" if they are vectorised.
    """

    def __init__(self, loop: Loop, members: int) -> None:
        self.loop = loop
        run = loop.driver.run
        self._sigma, self._evaluations = run.work.sigma.copy(), int(run.work.counters[NFEV])
        self._left = np.array(loop.events.left)
        self._steps = FIRST_STEPS
        self.one_by_one = self._go_side_by_side(members)

    def run(self, plan: Plan, y0s: np.ndarray, params: np.ndarray, out: Members, watch: _Watch) -> None:
        """Run all members and store their results in `out`."""
        each = self._each(plan, y0s, params, out)
        if self.one_by_one:
            self._one_by_one(plan, slice(0, len(y0s)), each, out, watch)
        else:
            self._side_by_side(each, out, watch)
            for k in np.flatnonzero(out.status == NOT_RUN).tolist():
                self._one_by_one(plan, slice(k, k + 1), each, out, watch)
        BUILD.call(self._examine, each, out)
        if each.kept:
            out.saved[:] = each.rows[:, : plan.times.size]
        self._evaluate(plan, y0s, params, out)
        if np.isnan(self.loop.diagnostics.max_correction):  # the method has no error estimate
            out.max_correction[:] = np.nan

    def _evaluate(self, plan: Plan, y0s: np.ndarray, params: np.ndarray, out: Members) -> None:
        """Evaluate the invariants of all members at their starts, ends and saved states, as a single run does."""
        driver, m = self.loop.driver, len(y0s)
        if not driver.run.invariants.size:
            return
        # Arrays that come from other processes may be read-only or not aligned, which the engine does not take.
        y0s, params = (np.require(a, requirements=["A", "C", "W"]) for a in (y0s, params))
        out.target[:] = _values(driver, np.full(m, plan.t0), y0s, params)
        ran = np.flatnonzero(~np.isnan(out.t))
        out.values[ran] = _values(driver, out.t[ran], out.y[ran], params[ran])
        if plan.times.size:
            members, rows = np.nonzero(~np.isnan(out.saved).any(axis=2))
            times = plan.times[rows]
            out.saved_values[members, rows] = _values(driver, times, out.saved[members, rows], params[members])
        _cover(out, slice(None), out.saved_values[:, plan.times != plan.t0], driver.schedule)

    def _go_side_by_side(self, members: int) -> str:
        driver = self.loop.driver
        run, schedule = driver.run, driver.schedule
        reason = why_one_by_one(run.method.multistep, run.options, schedule, run.y0.dtype)
        little = members * schedule.span.n_steps * run.y0.size < LEAST_WORK
        if not reason and little and need_compiling(driver.functions):
            reason = "compiling functions for eight members would take longer than the run"
        try:
            if not reason:
                driver.engine.side_by_side(octet_functions(driver.functions))
        except NotCompilableError as error:
            reason = str(error)
        return reason

    def _each(self, plan: Plan, y0s: np.ndarray, params: np.ndarray, out: Members) -> data.Members:
        """Return the inputs of the members and the buffers for their results."""
        driver, m = self.loop.driver, len(y0s)
        y0s, params = (np.require(a, requirements=["A", "C", "W"]) for a in (y0s, params))
        kept, (first_steps, events) = plan.times.size > 0, self._at_start(y0s, params)
        return data.Members(
            starts=y0s,
            params=params,
            first_steps=first_steps,
            events=events,
            evaluations=self._evaluations,
            sigma=self._sigma,
            left=self._left,
            kept=kept,
            rows=np.empty((m if kept else 1, *driver.y.shape), plan.dtype),
            y=out.y,
            t=out.t,
            status=out.status,
            max_residual=out.max_residual,
            counters=out.counters,
            max_correction=out.max_correction,
            figures=np.zeros((m, *driver.run.work.trust.shape)),
            suspects=np.zeros((m, driver.run.work.suspect.size)),
            where=np.zeros(2, np.int64),
        )

    def _one_by_one(self, plan: Plan, those: slice, each: data.Members, out: Members, watch: _Watch) -> None:
        part = _part(each, those)
        m, where = len(part.t), part.where
        while where[0] < m:
            watch.update()
            first, begin = int(where[0]), time.perf_counter()
            reason, code = None, OK
            try:
                code = self.loop.driver.sweep(part, self._steps)
            except Exception as error:
                reason = _reason(error)
            done = int(where[0])
            self._arrived(np.arange(those.start + first, those.start + done), each, out)
            failed = reason is not None or code != OK
            if plan.events and (failed or done > first):
                which, t, y = self.loop.driver.interpolants.roots()
                out.t_events[those.start + first] = [t[which == k].copy() for k in range(plan.events)]
                out.y_events[those.start + first] = [y[which == k].copy() for k in range(plan.events)]
            if failed:
                self._look_at(plan, those.start + done, code, reason, each, out, watch)
                where[:] = done + 1, 0
            elif done < m:
                self._adapt(time.perf_counter() - begin)

    def _examine(self, each: data.Members, out: Members) -> None:
        """Examine the steps that the engine has marked as suspicious, and check the invariants at the ends of members.

        The invariants are checked at the ends of the members that did not fail, in their order, up to the first member
        at which nothing is found.
        """
        run = self.loop.driver.run
        arrived = np.flatnonzero(out.status >= 0)
        if not run.options.watched or not arrived.size:
            return
        suspected, at_ends = suspects(each.figures, each.suspects), True
        for k in arrived.tolist():
            if not (at_ends or suspected[k]):
                continue
            derivative = self._derivative(each.params[k])
            t0, start = self.loop.driver.schedule.span.t0, each.starts[k]
            run.invariants.target[:] = run.invariants.values(t0, start)
            tau = run.stepping.scale_of_time(float(each.first_steps[k]), start, derivative(t0, start))
            examiner = replace(run.examiner, tau=tau, figures=each.figures[k], largest=0.0)
            found = examiner.examine(each.suspects[k], derivative) if suspected[k] else None
            if at_ends:
                at_end = examiner.complaint(derivative, float(out.t[k]), out.y[k])
                found, at_ends = found or at_end, at_end is not None
            self._judge(k, each, out, [found] if found else [])

    def _judge(self, k: int, each: data.Members, out: Members, doubts: list[str]) -> None:
        """Store whether member `k`, which did not fail, is reliable, by its corrections and the findings `doubts`."""
        trust = Trust(self.loop.driver.run.invariants.names, each.figures[k])
        trust.doubts += doubts
        end = ENDS[out.status[k]]
        out.trusted[k] = trust.trusted
        out.message[k] = end if trust.trusted else f"{end}; {trust.message}"

    def _arrived(self, those: np.ndarray, each: data.Members, out: Members) -> None:
        """Store whether the members that the engine has completed are reliable, and their messages."""
        for k in those.tolist():
            out.trusted[k], out.message[k] = True, ENDS[out.status[k]]
        for k in those[sick(each.figures[those]).any(axis=1)].tolist():
            self._judge(k, each, out, [])

    def _side_by_side(self, each: data.Members, out: Members, watch: _Watch) -> None:
        """Run members in batches of eight, except those that must run individually, whose status stays `NOT_RUN`."""
        m, where = len(each.t), each.where
        while where[0] < m:
            watch.update()
            begin = time.perf_counter()
            self.loop.driver.sweep_octets(each, self._steps)
            if where[0] < m:
                self._adapt(time.perf_counter() - begin)
        done = np.flatnonzero(out.status != NOT_RUN)
        out.side_by_side[done] = True
        self._arrived(done, each, out)

    def _adapt(self, seconds: float) -> None:
        """Choose the number of steps, at most doubled, for about `SWEEP_SECONDS`, by the time of the last call."""
        self._steps = max(1, min(2 * self._steps, int(self._steps * SWEEP_SECONDS / max(seconds, 1e-9))))

    def _look_at(
        self, plan: Plan, k: int, code: int, reason: str | None, each: data.Members, out: Members, watch: _Watch
    ) -> None:
        """Run member `k` again as `integrate` does if the engine asks for that by its `code`; else store its failure.

        `reason` is the text of an exception in the user's functions, or None.
        """
        loop, driver = self.loop, self.loop.driver
        if code in (DOUBTFUL, PAUSE):
            _alone(plan, k, each.starts[k], each.params[k], out, watch)
            if each.kept:
                each.rows[k, :-1] = out.saved[k]
            return
        rows = each.rows[k if each.kept else 0, : driver.rows]
        message = reason or failure(code, driver.run, driver.schedule.clock)
        _store(loop, k, FAILED, message, out, rows, broken=reason is not None)
        if each.kept:
            each.rows[k, driver.rows :] = np.nan

    def _at_start(self, y0s: np.ndarray, params: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the length (m,) of each member's first step, NaN if it cannot be found, and the events (m, events)."""
        span, stepping, events = self.loop.driver.schedule.span, self.loop.driver.run.stepping, self.loop.events
        known = stepping.h or stepping.first_step
        taus, values = np.full(len(y0s), known or np.nan), np.zeros((len(y0s), len(events.functions)))
        for k, (y0, p) in enumerate(zip(y0s, params, strict=True) if events.functions or not known else ()):
            derivative = self._derivative(p)
            try:
                f = derivative(span.t0, y0)
                taus[k] = known or stepping.first(derivative, y0, f, self.loop.driver.run.tableau)
                values[k] = events.at_start(span.t0, y0, f, span.sign * taus[k])
            except Exception:
                taus[k] = np.nan
        return taus, values

    def _derivative(self, params: np.ndarray) -> Callable[[float, np.ndarray], np.ndarray]:
        """Set the parameters of the driver to those of a member, and return the right-hand side."""
        self.loop.driver.params[:] = params
        return self.loop.problem.derivative


def _part(each: data.Members, those: slice) -> data.Members:
    """Return the inputs and buffers of some of the members, none of which has started."""
    own = {name: getattr(each, name)[those] for name in BY_MEMBER}
    rows = each.rows[those] if each.kept else each.rows
    return each._replace(**own, rows=rows, where=np.zeros(2, np.int64))
