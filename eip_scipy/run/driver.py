"""One run's steps: where it steps and what it saves, and the loop that makes them, compiled or not."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numba import typeof, types

from ..core.compiled_functions import ChangedShapeError, CompiledFunctions, signatures, with_inlined
from ..core.dense import End, ManifoldDenseOutput, dense_output
from ..core.setup import Run
from ..core.stepping import UNBOUNDED, AnyMethod
from ..engine import kernels as kn
from ..engine.caching import cached_njit
from ..engine.kernels import OK
from ..engine.step import TIME, TIME_NEW, Span, finish_step, next_step

__all__ = [
    "FULL",
    "PAUSE",
    "PENDING",
    "ROW",
    "STEP",
    "Driver",
    "Schedule",
    "check_memory",
    "saved_rows",
    "source_stamp",
]

FIRST_ROWS = 1024
STEP, ROW, PENDING = 0, 1, 2
PAUSE, FULL = 10, 11


class Schedule(NamedTuple):
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
    folder = Path(__file__).parents[1]
    engine = ("octets", "sums", "triples", "trust", "kernels", "step")
    names = (*(f"engine/{name}.py" for name in engine), *names)
    return hashlib.sha256(b"".join((folder / name).read_bytes() for name in names)).hexdigest()


def make_advance(stamp):
    """The loop over steps; `stamp` enters the key of its cache."""

    def advance(rhs, inv, grad, event, params, schedule, k_end, m, o, w, y, y_r, y_new, y_new_r, t_saved, y_saved):
        """Steps up to `k_end`; the one loop of compiled and interpreted runs. Returns OK or why it stopped."""
        _ = stamp
        place, clock = schedule.place, schedule.clock
        while True:
            if place[PENDING] == 1:
                clock[TIME] = clock[TIME_NEW]
                kn.copy(w.K_r[-1], w.K_r[0])
                kn.copy(y_new_r, y_r)
                kn.copy(schedule.g_new, schedule.g)
                place[PENDING] = 0
            k = place[STEP]
            if clock[TIME] == schedule.span.t_bound or k >= k_end:
                return OK
            if place[ROW] + 2 > t_saved.size:
                return FULL
            status = next_step(
                finish_step, rhs, inv, grad, params, clock, k, schedule.span, m, o, w, y, y_r, y_new, y_new_r
            )
            if status != OK:
                return status
            place[STEP] = k + 1
            place[PENDING] = 1
            t_new = clock[TIME_NEW]
            saved = t_new == schedule.span.t_bound or (schedule.save_every > 0 and (k + 1) % schedule.save_every == 0)
            if schedule.t_eval.size == 0 and saved:
                t_saved[place[ROW]] = t_new
                kn.copy(y_new_r, y_saved[place[ROW]])
                place[ROW] += 1
            if schedule.g.size > 0:
                event(t_new, y_new, schedule.g_new, params)
                if kn.crossed(schedule.g, schedule.g_new, schedule.g_direction):
                    return PAUSE
            if place[ROW] < schedule.t_eval.size and schedule.span.sign * (schedule.t_eval[place[ROW]] - t_new) <= 0.0:
                return PAUSE

    return advance


advance = make_advance(source_stamp("run/driver.py"))


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


class Driver:
    """One run: its functions, buffers and the rows saved so far."""

    def __init__(
        self, run: Run, schedule: Schedule, functions: CompiledFunctions, params: np.ndarray, compiled: bool
    ) -> None:
        self.run, self.schedule, self.functions, self.params, self.compiled = run, schedule, functions, params, compiled
        rows = saved_rows(schedule) or FIRST_ROWS
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
            arguments = tuple(typeof(a) for a in (params, schedule, 0, *self._tail, self.t, self.y.view(float)))
            self._advance = _compiled_advance(dtype, arguments)

    def advance(self, k_end: int) -> int:
        """Step on to step `k_end`, or to what stops the loop before it; returns the loop's code."""
        arguments = (self.params, self.schedule, k_end, *self._tail, self.t, self.y.view(float))
        try:
            return self._advance(*self.functions, *arguments)
        except ChangedShapeError as error:
            self.place(error)
            raise

    def place(self, error: ChangedShapeError) -> None:
        """Add the step to an error that compiled code raises, which cannot put a number into it."""
        error.args = (f"{error}, in the step from t={self.schedule.clock[TIME]:.10g}",)

    @property
    def step(self) -> int:
        """Steps made so far."""
        return int(self.schedule.place[STEP])

    @property
    def rows(self) -> int:
        """Rows saved so far."""
        return int(self.schedule.place[ROW])

    @property
    def now(self) -> tuple[float, np.ndarray]:
        """Time and state after the last step that was accepted."""
        pending = self.schedule.place[PENDING] == 1
        return float(self.schedule.clock[TIME_NEW if pending else TIME]), self.new if pending else self.state

    def parts(self) -> dict[str, np.ndarray]:
        """The buffers that decide the steps to come, or count; all others are filled before they are read."""
        w, schedule = self.run.work, self.schedule
        kept = ("carry", "err_sum", "sigma", "defect", "max_defect", "max_correction", "trust", "counters")
        return {
            "place": schedule.place,
            "clock": schedule.clock,
            "y": self.state,
            "slope": w.K[0],
            "g": schedule.g,
            "target": self.run.options.target,
            **{name: getattr(w, name) for name in kept},
        }

    def snapshot(self) -> dict[str, np.ndarray]:
        """Copies of these after the last accepted step, made current as the loop does it."""
        copies = {name: part.copy() for name, part in self.parts().items()}
        if self.schedule.place[PENDING] == 1:
            copies["place"][PENDING] = 0
            copies["clock"][TIME] = self.schedule.clock[TIME_NEW]
            copies["y"], copies["slope"] = self.new.copy(), self.run.work.K[-1].copy()
            copies["g"] = self.schedule.g_new.copy()
        return copies

    def load(self, t: np.ndarray, y: np.ndarray, max_bytes: float) -> None:
        """Rows of a run that is resumed."""
        while self.t.size <= t.size:
            self.grow(max_bytes)
        self.t[: t.size], self.y[: t.size] = t, y

    def save(self, t: float, y: np.ndarray) -> None:
        """One more row."""
        self.t[self.rows], self.y[self.rows] = t, y
        self.schedule.place[ROW] += 1

    def save_start(self) -> None:
        """The first row: the start, where it is asked for and not there already."""
        if self.rows == 0 and (self.schedule.t_eval.size == 0 or self.schedule.t_eval[0] == self.schedule.span.t0):
            self.save(self.schedule.span.t0, self.state)

    def save_now(self) -> None:
        """After an early end: the last accepted state too."""
        t, y = self.now
        if self.rows == 0 or self.t[self.rows - 1] != t:
            self.save(t, y)

    def cut(self, t: float, y: np.ndarray) -> None:
        """End the rows with the state at which an event ended the run inside the last step."""
        while self.rows and self.schedule.span.sign * (self.t[self.rows - 1] - t) >= 0:
            self.schedule.place[ROW] -= 1
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

    def dense(self, tableau: AnyMethod, rhs: Callable[..., None]) -> ManifoldDenseOutput:
        """Dense output over the step that is pending."""
        t_old, t = (float(self.schedule.clock[place]) for place in (TIME, TIME_NEW))
        K = self.run.work.K
        old, end = End(t_old, self.state, K[0].copy()), End(t, self.new, K[-1].copy())
        return dense_output(rhs, self.run, tableau, old, end, self.params)

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


def saved_rows(schedule: Schedule) -> int:
    """States that a run saves, its start included; 0 where that is not known before."""
    if schedule.t_eval.size:
        return schedule.t_eval.size
    if schedule.save_every == 0:
        return 2
    if schedule.span.h == 0.0 or schedule.span.n_steps == UNBOUNDED:
        return 0
    return 1 + math.ceil(schedule.span.n_steps / schedule.save_every)


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
