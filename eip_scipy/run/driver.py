"""The steps of one run: the engine, the buffers of the run, and the states that it saves."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
from scipy.integrate import DenseOutput, OdeSolution

from ..core.dense import Interpolants, ManifoldDenseOutput, solution
from ..core.functions import ChangedShapeError, reraise_user_exception
from ..core.inputs import is_number, shown
from ..core.runs import Run
from ..core.step_control import UNBOUNDED
from ..engine.data import PENDING, ROW, STEP, TIME, TIME_NEW, Members, Schedule
from ..engine.native import BUILD, FailedCallError, NativeFunctions, PythonFunctions

__all__ = ["Driver", "check_bytes", "check_memory", "expected_steps", "require_memory", "saved_rows"]

# Rows and bytes allocated at the start of a run whose number of steps is unknown; the buffers grow later.
FIRST_ROWS, FIRST_BYTES = 1024, 2**24
SMALL = 2**22  # number of bytes up to which the free memory is not determined, because that takes longer than a fill
# Buffers of the record `Work`, and of the history of a multistep method, that determine the remaining steps.
OF_WORK = (
    *("level", "level_carry", "slow", "carry", "err_sum", "sigma", "memory"),
    *("residual", "max_residual", "max_correction", "trust", "counters"),
)
OF_HISTORY = ("rates", "rate_sums", "nodes", "sums", "place", "levels")


class Driver:
    """One run: its functions, buffers and saved rows, and with `keeps_steps` the interpolants of its steps.

    A row is a saved time with its state. `max_bytes` bounds the memory of the rows and that of the interpolants, see
    `require_memory`. `interpolants` is None if nothing needs states between steps.
    """

    def __init__(
        self,
        run: Run,
        functions: PythonFunctions | NativeFunctions,
        *,
        keeps_steps: bool,
        max_bytes: float | None,
    ) -> None:
        self.run, self.schedule, self._events = run, run.schedule, run.problem.events
        self.params = run.problem.parameters
        self.functions: Any = functions
        schedule = self.schedule
        self._max_bytes = max_bytes
        n, dtype = run.y0.size, run.y0.dtype
        rows = saved_rows(schedule) or _first(run.y0.nbytes)
        # One extra row for the last state of a run that ends early.
        self.t = np.empty(rows + 1)
        self.y = np.empty((rows + 1, n), dtype)
        self.state = run.y0.copy()
        self.new = np.empty_like(self.state)
        self.engine = run.engine(functions)
        self.interpolants: Any = None
        self._segments = np.empty((0, 0))
        if schedule.t_eval.size or schedule.g.size or keeps_steps or run.shows:
            self.interpolants = Interpolants(run, self.engine, schedule.g.size, errors=self.own_errors)
            steps = expected_steps(schedule) or _first(8 * self.interpolants.floats)
            self._segments = self._more_segments(steps if keeps_steps else 0)

    def advance(self, k_end: int) -> int:
        """Advance to step `k_end`, or until something stops the loop earlier; return the loop's status code."""
        interpolants = self.interpolants
        if interpolants is not None:
            interpolants.record.left[:] = self._events.left
        try:
            return int(self._call(self.engine.advance, k_end, self.state, self.new, self.t, self.y, self._segments))
        finally:
            if interpolants is not None:
                self._events.take(*interpolants.roots())

    def sweep(self, members: Members, steps: int) -> int:
        """Run members of an ensemble, starting at `members.where`, for `steps` steps in total, on this run's buffers.

        Return `OK`, also if more calls are needed, or the code of what happened to the current member. Members of
        batches whose status is not set afterwards must be run individually.
        """
        code = int(self._call(self.engine.sweep, members, steps, self.state, self.new))
        self.warn()
        return code

    def _call(self, function: Callable[..., Any], *given: Any) -> Any:
        """Return ``function(*given)``, of the engine, with the errors of `own_errors`."""
        try:
            return function(*given)
        except FailedCallError as error:
            failed = error
        with self.own_errors():
            raise failed

    @contextmanager
    def own_errors(self) -> Iterator[None]:
        """Replace a `FailedCallError` raised in the block by the exception of the Numba or C function that failed."""
        try:
            yield
            return
        except FailedCallError as error:
            failed = error.args
        try:
            reraise_user_exception(self.functions, *failed)
        except ChangedShapeError as changed:  # compiled code cannot format the time
            changed.args = (f"{changed}, in the step from t={self.schedule.clock[TIME]:.10g}",)
            raise

    @property
    def step(self) -> int:
        """Number of steps made so far."""
        return int(self.schedule.place[STEP])

    @property
    def rows(self) -> int:
        """Number of rows saved so far."""
        return int(self.schedule.place[ROW])

    @property
    def now(self) -> tuple[float, np.ndarray]:
        """Time and state after the last accepted step."""
        pending = self.schedule.place[PENDING] == 1
        return float(self.schedule.clock[TIME_NEW if pending else TIME]), self.new if pending else self.state

    def parts(self) -> dict[str, np.ndarray]:
        """Return the counters and the buffers, by name, that determine the remaining steps.

        After a step in which the loop has paused, they are those that follow this step.
        """
        w, schedule, history = self.run.work, self.schedule, self.run.stepper.multistep
        place, clock, g, rate, last = schedule.place, schedule.clock, schedule.g, schedule.rate, 0
        if place[PENDING] == 1:
            place, clock, g, rate, last = place.copy(), clock.copy(), schedule.g_new, schedule.rate_new, -1
            place[PENDING], clock[TIME] = 0, clock[TIME_NEW]
        found = {"place": place, "clock": clock, "y": self.now[1], "slope": w.K[last], "balance_rate": w.rates[last]}
        found |= {"g": g, "rate": rate, "target": self.run.options.target}
        found |= {name: getattr(w, name) for name in OF_WORK} | self.run.found_rows
        return found | ({} if history is None else {f"history_{name}": getattr(history, name) for name in OF_HISTORY})

    def load(self, t: np.ndarray, y: np.ndarray) -> None:
        """Copy the saved times `t` (m,) and states `y` (m, n) of a run that is resumed to the buffers of rows."""
        self._reserve(t.size + 1)
        self.t[: t.size], self.y[: t.size] = t, y

    def save(self, t: float, y: np.ndarray) -> None:
        """Append a time and a state to the saved rows."""
        row = self.rows
        self.t[row], self.y[row], self.schedule.place[ROW] = t, y, row + 1

    def save_now(self) -> None:
        """Save the last accepted state, or its projected copy, unless it is the last saved row already."""
        t, y = self.now
        if self.rows == 0 or self.t[self.rows - 1] != t:
            self.save(t, self.interpolants.shown(t, y) if self.run.shows else y)

    def cut(self, t: float, y: np.ndarray) -> None:
        """Remove the saved rows from `t` on, and append the state `y` at `t`, in which an event ended the run."""
        while self.rows and self.schedule.span.sign * (self.t[self.rows - 1] - t) >= 0:
            self.schedule.place[ROW] -= 1
        self.save(t, y)

    def grow(self) -> None:
        """Double the buffers of rows or interpolants that are full; raise MemoryError beyond `max_bytes`."""
        if self._kept and self._kept == len(self._segments):
            self._segments = np.concatenate([self._segments, self._more_segments(self._kept)])
        self._reserve(self.rows + 2)

    def _reserve(self, rows: int) -> None:
        while self.t.size < rows:
            check_memory(2 * self.t.size, self.run, self._max_bytes)
            self.t, self.y = (np.concatenate([buffer, np.empty_like(buffer)]) for buffer in (self.t, self.y))

    def _more_segments(self, count: int) -> np.ndarray:
        floats = self.interpolants.floats
        needed = (self._kept + count) * 8.0 * floats
        require_memory(needed, "dense_output=True needs", self._max_bytes, "use t_eval, or increase max_bytes")
        return np.empty((count, floats))

    @property
    def _kept(self) -> int:
        """Number of interpolants stored so far."""
        return 0 if self.interpolants is None else int(self.interpolants.record.counts[1])

    def dense(self) -> DenseOutput:
        """Return the dense output over the pending step."""
        segment = self._segments[self._kept - 1] if self._kept else self.interpolants.record.piece.copy()
        return ManifoldDenseOutput(self.interpolants, segment)

    def warn(self) -> None:
        """Warn about states between steps that the loop could not project."""
        if self.interpolants is not None:
            self.interpolants.warn()

    def solution(self, t_end: float) -> OdeSolution | None:
        """Return the dense output from the start of the run to `t_end`, or None if the run does not store its steps."""
        if not self._segments.size:
            return None
        return solution(self.interpolants, self._segments[: self._kept], t_end, self.now[1])

    def note(self, values: np.ndarray, target: np.ndarray) -> None:
        """Update the largest errors (l,) with the `values` (m, l) at the saved states except the start."""
        first = int(self.rows > 0 and self.t[0] == self.schedule.span.t0)
        BUILD.raise_residuals(self.run.work.max_residual, values[first:], target)

    def values(self) -> np.ndarray:
        """Return the invariants of the saved states, (m, l)."""
        rows = self.rows
        return self.values_at(self.t[:rows], self.y[:rows])

    def values_at(self, t: np.ndarray, y: np.ndarray, *params: np.ndarray) -> np.ndarray:
        """Return the invariants (m, l) of states (m, n), each with its own `params` (m, p) if these are given."""
        out = np.empty((len(t), self.run.invariants.size))
        self._call(self.engine.values, t, y, out, *params)
        return out


def _first(size: int) -> int:
    """Return the number of items of `size` bytes for which memory is allocated at first."""
    return min(FIRST_ROWS, max(2, FIRST_BYTES // max(size, 1)))


def saved_rows(schedule: Schedule) -> int:
    """Return the number of states that a run saves: those at `t_eval`, or the start and later ones; 0 if unknown."""
    if schedule.t_eval.size:
        return schedule.t_eval.size
    if schedule.save_every == 0:
        return 2
    return 1 + math.ceil(steps / schedule.save_every) if (steps := expected_steps(schedule)) else 0


def expected_steps(schedule: Schedule) -> int:
    """Return the number of steps of a run; 0 if it is not known in advance."""
    return 0 if schedule.span.h == 0.0 or schedule.span.n_steps == UNBOUNDED else schedule.span.n_steps


def check_memory(rows: int, run: Run, max_bytes: float | None) -> None:
    """Raise MemoryError if `rows` saved states of the run would need more memory than `max_bytes` allows."""
    needed = rows * (run.y0.nbytes + 8.0 * (1 + run.invariants.size))
    if needed > SMALL or max_bytes is not None:
        what = f"saving {rows:.3g} states of {run.y0.size} components needs"
        require_memory(needed, what, max_bytes, "increase save_every or max_bytes")


def require_memory(needed: float, what: str, max_bytes: float | None, advice: str) -> None:
    """Raise MemoryError if `needed` bytes exceed `max_bytes`, by default half of the free memory, or `SMALL` if more.

    The message begins with `what`, which ends with a verb, and ends with `advice`.
    """
    bound = max_bytes
    if bound is None:
        bound = SMALL if needed <= SMALL else 0.5 * free_memory()
    if needed > bound:
        raise MemoryError(
            f"{what} {needed / 1e9:.3g} GB, but the bound is {bound / 1e9:.3g} GB (max_bytes, by default half of the "
            f"free memory); {advice}."
        )


def check_bytes(max_bytes: Any) -> None:
    """Raise ValueError unless the option ``max_bytes`` is None or a number >= 0."""
    if max_bytes is not None and not (is_number(max_bytes, "max_bytes") and max_bytes >= 0):
        raise ValueError(f"max_bytes must be a number of bytes >= 0, got {shown(max_bytes)}.")


def free_memory() -> float:
    """Return an estimate of the number of bytes that a process can still allocate."""
    with suppress(OSError, StopIteration), open("/proc/meminfo") as lines:
        return 1024.0 * int(next(line for line in lines if line.startswith("MemAvailable:")).split()[1])
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        return 0.5 * os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return 4e9
