"""The steps of one run: the engine, the buffers of the run, and the states that it saves."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NoReturn

import numpy as np
from scipy.integrate import DenseOutput, OdeSolution

from ..core.dense import Interpolants, ManifoldDenseOutput, solution
from ..core.functions import ChangedShapeError, reraise_user_exception
from ..core.runs import Run
from ..core.step_control import UNBOUNDED
from ..engine.data import NOTHING, PENDING, REASON, ROW, STEP, TIME, TIME_NEW, Members, Schedule
from ..engine.native import FailedCallError, NativeFunctions, PythonFunctions
from .memory import most_bytes

__all__ = ["Driver", "check_memory", "saved_rows"]

# Rows and bytes allocated at the start of a run whose number of steps is unknown; the buffers grow later.
FIRST_ROWS, FIRST_BYTES = 1024, 2**24
# Buffers that decide the remaining steps, or count.
OF_WORK = ["carry", "err_sum", "sigma", "memory", "residual", "max_residual", "max_correction", "trust", "counters"]


class Driver:
    """One run: its functions, buffers and saved rows, and with `keeps_steps` the interpolants of its steps.

    A row is a saved time with its state. `max_bytes` bounds the memory of the rows and that of the interpolants, see
    `most_bytes`.
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
        self._interpolants = None
        self._pieces = np.empty((0, 0))
        if schedule.t_eval.size or schedule.g.size or keeps_steps or run.shows:
            self._interpolants = Interpolants(run, self.engine, schedule.g.size, errors=self.own_errors)
            steps = expected_steps(schedule) or _first(8 * self._interpolants.floats)
            self._pieces = self._more_pieces(steps if keeps_steps else 0)

    def advance(self, k_end: int) -> int:
        """Advance to step `k_end`, or until something stops the loop earlier; return the loop's status code."""
        interpolants = self._interpolants
        if interpolants is not None:
            interpolants.record.left[:] = self._events.left
        try:
            return int(self.engine.advance(k_end, self.state, self.new, self.t, self.y, self._pieces))
        except FailedCallError as error:
            failed = error.args
        finally:
            if interpolants is not None:
                self._events.take(*interpolants.roots())
        self._raise_own(*failed)

    def sweep(self, members: Members, steps: int) -> int:
        """Run members of an ensemble, starting at `members.where`, for `steps` steps in total, on this run's buffers.

        Return `OK`, also if more calls are needed, or the code of what happened to the current member.
        """
        with self.own_errors():
            code = int(self.engine.sweep(members, steps, self.state, self.new, self.t))
        self.warn()
        return code

    def sweep_octets(self, members: Members, steps: int) -> None:
        """Run members in batches of eight until all have ended or `steps` steps of batches are made.

        Members whose status is not set afterwards must be run individually.
        """
        self.engine.sweep_octets(members, steps, self.state, self.new, self.t)
        self.warn()

    @contextmanager
    def own_errors(self) -> Iterator[None]:
        """Replace a `FailedCallError` raised in the block by the exception of the Numba or C function that failed."""
        try:
            yield
        except FailedCallError as error:
            failed = error.args
        else:
            return
        self._raise_own(*failed)

    def _raise_own(self, *failed: Any) -> NoReturn:
        """Raise the exception of the Numba or C function that failed; the arguments are those of `FailedCallError`."""
        try:
            reraise_user_exception(self.functions, *failed)
        except ChangedShapeError as changed:
            self.place(changed)
            raise

    def place(self, error: ChangedShapeError) -> None:
        """Add the time of the step to the message of an error from compiled code, which cannot format numbers."""
        error.args = (f"{error}, in the step from t={self.schedule.clock[TIME]:.10g}",)

    @property
    def step(self) -> int:
        """Number of steps made so far."""
        return int(self.schedule.place[STEP])

    @property
    def suspects(self) -> bool:
        """Return True if the engine has marked a step as suspect, so that `Run.look` must examine the run."""
        return bool(self.run.work.suspect[REASON] != NOTHING)

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
        """Return the counters and the buffers, by name, that determine the remaining steps."""
        w, schedule, history = self.run.work, self.schedule, self.run.stepper.multistep
        found = {"place": schedule.place, "clock": schedule.clock, "y": self.state, "slope": w.K[0], "g": schedule.g}
        if schedule.g.size:
            found["rate"] = schedule.rate
        found["target"] = self.run.options.target
        balanced = w.level.size > 0
        if balanced:
            found |= {"level": w.level, "level_carry": w.level_carry, "slow": w.slow, "balance_rate": w.rates[0]}
        if history is not None:
            found |= {"rates": history.rates, "rate_sums": history.rate_sums} if balanced else {}
            found |= {"nodes": history.nodes, "sums": history.sums, "node": history.place, "levels": history.levels}
        return found | {name: getattr(w, name) for name in OF_WORK}

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return copies of the buffers of `parts` after the last accepted step, in which the loop may have paused."""
        copies = {name: part.copy() for name, part in self.parts().items()}
        work, schedule = self.run.work, self.schedule
        if schedule.place[PENDING] == 1:
            copies["place"][PENDING] = 0
            copies["clock"][TIME] = schedule.clock[TIME_NEW]
            new = {"y": self.new, "slope": work.K[-1], "g": schedule.g_new, "rate": schedule.rate_new}
            new |= {"balance_rate": work.rates[-1]}
            copies |= {name: new[name].copy() for name in copies.keys() & new.keys()}
        return copies

    def load(self, t: np.ndarray, y: np.ndarray) -> None:
        """Copy the saved times `t` (m,) and states `y` (m, n) of a run that is resumed to the buffers of rows."""
        while self.t.size <= t.size:
            self._more_rows()
        self.t[: t.size], self.y[: t.size] = t, y

    def save(self, t: float, y: np.ndarray) -> None:
        """Append a time and a state to the saved rows."""
        self.t[self.rows], self.y[self.rows] = t, y
        self.schedule.place[ROW] += 1

    def save_start(self) -> None:
        """Save the start as the first row, if it is requested and not saved already."""
        if self.rows == 0 and (self.schedule.t_eval.size == 0 or self.schedule.t_eval[0] == self.schedule.span.t0):
            self.save(self.schedule.span.t0, self.state)

    def save_now(self) -> None:
        """Save the last accepted state after an early end of the run, unless it is the last saved row already."""
        t, y = self.now
        if self.rows == 0 or self.t[self.rows - 1] != t:
            self.save(t, self.shown(t, y))

    def shown(self, t: float, y: np.ndarray) -> np.ndarray:
        """Return the last state `y` at `t` in the form of the saved rows, which may be a projected copy."""
        interpolants = self._interpolants
        return interpolants.shown(t, y) if interpolants is not None and interpolants.record.shows else y

    def cut(self, t: float, y: np.ndarray) -> None:
        """Remove the saved rows from `t` on, and append the state `y` at `t`, in which an event ended the run."""
        while self.rows and self.schedule.span.sign * (self.t[self.rows - 1] - t) >= 0:
            self.schedule.place[ROW] -= 1
        self.save(t, y)

    def grow(self) -> None:
        """Double the buffers of rows or interpolants that are full; raise MemoryError beyond `max_bytes`."""
        if self._kept and self._kept == len(self._pieces):
            self._pieces = np.concatenate([self._pieces, self._more_pieces(self._kept)])
        if self.rows + 2 > self.t.size:
            self._more_rows()

    def _more_rows(self) -> None:
        rows = 2 * self.t.size
        check_memory(rows, self.run, self._max_bytes)
        self.t = np.resize(self.t, rows)
        self.y = np.concatenate([self.y, np.empty_like(self.y)])

    def _more_pieces(self, count: int) -> np.ndarray:
        floats = 0 if self._interpolants is None else self._interpolants.floats
        needed = (self._kept + count) * 8.0 * floats
        require_memory(needed, "dense_output=True", self._max_bytes, "use t_eval, or increase max_bytes")
        return np.empty((count, floats))

    @property
    def _kept(self) -> int:
        """Number of interpolants stored so far."""
        return 0 if self._interpolants is None else int(self._interpolants.record.counts[1])

    @property
    def interpolants(self) -> Interpolants:
        """Return the interpolants of a run that has events or times between steps, or stores its steps."""
        assert self._interpolants is not None
        return self._interpolants

    def dense(self) -> DenseOutput:
        """Return the dense output over the pending step."""
        piece = self._pieces[self._kept - 1] if self._kept else self.interpolants.record.piece.copy()
        return ManifoldDenseOutput(self.interpolants, piece)

    def warn(self) -> None:
        """Warn about states between steps that the loop could not project."""
        if self._interpolants is not None:
            self._interpolants.warn()

    def solution(self, t_end: float) -> OdeSolution | None:
        """Return the dense output from the start of the run to `t_end`, or None if the run does not store its steps."""
        if self._interpolants is None or not self._pieces.size:
            return None
        return solution(self._interpolants, self._pieces[: self._kept], t_end, self.now[1])

    def note(self, values: np.ndarray, target: np.ndarray) -> None:
        """Update the largest errors (l,) with the `values` (l, m) at the saved states except the start."""
        errors = np.abs(values[:, self.t[: self.rows] != self.schedule.span.t0].T - target)
        largest = self.run.work.max_residual
        np.fmax(largest, np.fmax.reduce(errors, axis=0, initial=0.0), out=largest)  # NaN does not count

    def values(self) -> np.ndarray:
        """Return the invariants of the saved states, (l, m)."""
        return self.values_at(self.t[: self.rows], self.y[: self.rows]).T

    def values_at(self, t: np.ndarray, y: np.ndarray, *params: np.ndarray) -> np.ndarray:
        """Return the invariants (m, l) of states (m, n), each with its own `params` (m, p) if these are given."""
        out = np.empty((len(t), self.run.invariants.size))
        with self.own_errors():
            self.engine.values(t, y, out, *params)
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
    require_memory(
        needed, f"saving {rows:.3g} states of {run.y0.size} components", max_bytes, "increase save_every or max_bytes"
    )


def require_memory(needed: float, what: str, max_bytes: float | None, advice: str) -> None:
    """Raise MemoryError, with `advice`, if the `needed` bytes for `what` exceed the bound of `most_bytes`."""
    bound = most_bytes(needed, max_bytes)
    if needed > bound:
        raise MemoryError(
            f"{what} needs {needed / 1e9:.3g} GB, but the bound is {bound / 1e9:.3g} GB (max_bytes, by default half of "
            f"the free memory); {advice}."
        )
