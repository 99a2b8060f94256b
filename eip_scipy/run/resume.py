"""Checkpoints of `integrate`: the identity of a run, what is stored and when, and how a run is resumed."""

from __future__ import annotations

import hashlib
import math
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from .. import checkpoint
from ..checkpoint import CheckpointError
from ..checkpoint.locks import held, require_place
from ..core.callers import users_level
from ..core.events import Events
from ..core.inputs import is_number
from ..core.runs import Run
from ..engine.data import NEXT_LENGTH, TIME
from ..methods.gauss_jackson import Weights

__all__ = ["Keeper", "keeping", "plain", "settings"]

KIND = "integrate"
# Seconds from one snapshot to the next. A run resumes from its last snapshot; later steps are repeated.
SNAPSHOT_SECONDS = 0.2
# Smallest ratio of run time to the time for copying or writing, so that each takes at most 5 % for any size of state.
LEAST_RATIO = 19.0
SHORT = 16
STEP = 0

Arrays = dict[str, np.ndarray]
Derivative = Callable[[float, np.ndarray], np.ndarray]


@contextmanager
def keeping(path: Any, every: Any, resume: Any, dense_output: Any) -> Iterator[Keeper | None]:
    """Yield the keeper for the options ``checkpoint``, ``checkpoint_every``, ``resume``; None without a checkpoint."""
    require_place(path, every, resume, "the path of a file")
    if path is None:
        yield None
        return
    if dense_output:
        raise ValueError(
            "a checkpoint does not store dense output; omit dense_output=True and use t_eval or save_every."
        )
    with held(path, KIND, "run", resume) as (name, found):
        origin = "there was no checkpoint: started at the beginning" if resume and found is None else ""
        yield Keeper(name, float(every), found, origin)


def settings(
    method: str, y0: np.ndarray, params: np.ndarray, run: Run, schedule: Any, events: Events
) -> dict[str, Any]:
    """Return everything except functions that determines the bits of a run, with the names that users know."""
    span = run.stepping.span
    # A user-defined one-step method is identified by its name and orders; functions are identified by their values.
    if run.tableau.in_python:
        parts = [run.tableau.order, run.tableau.error_estimator_order]
    else:
        *parts, history = run.method
        parts += [] if history is None else [getattr(history, part) for part in Weights._fields]
    found = {
        "method": f"{method} {_digest(parts)[:8]}",
        "t_span": (span.t0, span.t_bound),
        "h": run.stepping.h,
        "first_step": run.stepping.first_step,
        "max_step": span.max_step,
        "y0": y0,
        "params": params,
        **run.identity(),
        "save_every": schedule.save_every or None,
        "t_eval": schedule.t_eval if schedule.t_eval.size else None,
        "events": events.ends,
    }
    return {name: plain(value) for name, value in found.items()}


def plain(value: Any) -> Any:
    """Return a value in a form that JSON can hold; long arrays are replaced by their digest."""
    if isinstance(value, np.ndarray):
        if value.size <= SHORT:
            return plain(value.tolist())
        return f"{value.dtype} {value.shape} {_digest((value,))}"
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, complex) or (isinstance(value, float) and not math.isfinite(value)):
        return repr(value)
    return value


def _number(value: Any) -> str:
    """Return the text of a real or complex number; real values are complex numbers next to a complex derivative."""
    return f"{value if value.imag else value.real:.12g}"


def _digest(values: Iterable[Any]) -> str:
    """Return a hash of arrays and numbers."""
    digest = hashlib.sha256()
    for value in values:
        a = np.ascontiguousarray(value)
        digest.update(f"{a.dtype} {a.shape} ".encode() + a.tobytes())
    return digest.hexdigest()


class _Snapshot(NamedTuple):
    """State of a run after an accepted step: its small arrays, how often each event has happened, and the run time."""

    arrays: Arrays
    happened: list[int]
    seconds: float


class Keeper:
    """The checkpoint of a run in the file `name`, written every `every` seconds.

    `found` is the content of an existing file. `origin` is a note for the message of the result if a run that should be
    resumed has no file, otherwise "". The file always contains the last snapshot, never the current buffers, because an
    interruption may come inside a step. Saved rows and events only grow, so a snapshot needs only their number.
    """

    seconds = 0.0  # run time before the run was resumed

    def __init__(self, name: str, every: float, found: tuple[dict[str, Any], Arrays] | None, origin: str) -> None:
        self._name, self._every, self._read = name, every, found
        self._origin = origin
        self._failure = ""
        self._ended: Any = None

    def identify(self, settings: dict[str, Any], run: Run, derivative: Derivative, events: Events) -> None:
        """Record what identifies the run, before it is compiled; raise CheckpointError if the file has another run."""
        self._settings, self._run, self._derivative, self._events = settings, run, derivative, events
        self._names = run.invariants.names
        if self._read is None:
            return
        header, arrays = self._read
        checkpoint.require_same(self._name, header.get("settings"), settings)
        self._require_fitting(arrays, {"y": run.begin.y, "clock": np.zeros(NEXT_LENGTH + 1)})
        if "state_f" in arrays:
            self._require_same_functions(arrays)
        checkpoint.warn_of_other_versions(self._name, header, stacklevel=users_level())

    def _known_by(self, arrays: Arrays) -> Arrays:
        """Return the derivative and the invariants at the state in `arrays`, which identify the functions."""
        t, y = float(arrays["clock"][TIME]), arrays["y"]
        return {"state_f": self._derivative(t, y.copy()), "state_values": self._run.invariants.values(t, y)}

    def _require_same_functions(self, arrays: Arrays) -> None:
        self._require_fitting(arrays, known_by := self._known_by(arrays))
        t, there = float(arrays["clock"][TIME]), np.concatenate([arrays[name] for name in known_by])
        changed = checkpoint.changed_function(self._run.invariants, t, arrays["y"], there, known_by["state_f"])
        if changed:
            name, old, new = changed
            raise CheckpointError(
                f"the checkpoint {self._name!r} belongs to another run: {name} was {_number(old)} at t = {t:.10g}, "
                f"where it was saved, and is {_number(new)} now. Resume with the functions of that run, or use another "
                "file for a new run."
            )

    def _require_fitting(self, arrays: Arrays, expected: Arrays) -> None:
        for name, a in expected.items():
            found = arrays.get(name)
            if found is None or (found.dtype, found.shape) != (a.dtype, a.shape):
                what = "is missing" if found is None else f"is {found.dtype} {found.shape}"
                raise CheckpointError(
                    f"{self._name!r} is not a checkpoint of this run: {name} {what}, expected {a.dtype} {a.shape}."
                )

    def begin(self, driver: Any) -> None:
        """Store the driver, whose buffers hold the start; if a run is resumed, fill the buffers and the events."""
        self._driver = driver
        found, self._read = self._read, None
        if found is not None:
            self._restore(*found)
        self._begin = time.perf_counter() - self.seconds
        self._take_snapshot()
        self._written = self._where()
        self._due = time.perf_counter() + self._every
        if found is None:
            self._write(None, "running")

    def _restore(self, header: dict[str, Any], arrays: Arrays) -> None:
        """Fill the buffers of the run after all arrays have been checked."""
        driver, events = self._driver, self._events
        parts = driver.parts()
        self._require_fitting(arrays, parts)
        step, rows, pending = (int(k) for k in arrays["place"])
        if step < 0 or rows < 0 or pending != 0 or not is_number(header.get("wall_time")):
            stored = f"step {step}, {rows} rows, pending {pending}, wall_time {header.get('wall_time')!r}"
            raise CheckpointError(f"{self._name!r} is not a checkpoint of this run: its values are wrong: {stored}.")
        n, dtype = driver.run.y0.size, driver.run.y0.dtype
        expected = {"saved_t": np.broadcast_to(0.0, rows), "saved_y": np.broadcast_to(dtype.type(0), (rows, n))}
        for k in range(len(events.functions)):
            times = f"event_{k}_t"
            count = arrays[times].size if times in arrays else 0
            expected[times] = np.broadcast_to(0.0, count)
            expected[f"event_{k}_y"] = np.broadcast_to(dtype.type(0), (count, n))
        self._require_fitting(arrays, expected)
        driver.load(arrays["saved_t"], arrays["saved_y"])
        for name, part in parts.items():
            part[...] = arrays[name]
        for k in range(len(events.functions)):
            events.restore(k, arrays[f"event_{k}_t"], arrays[f"event_{k}_y"])
        self.seconds = float(header["wall_time"])
        driver.run.trust.doubts[:] = map(str, header.get("doubts") or ())
        self._ended = (header.get("status"), header.get("message"), step)
        self._origin = f"resumed at step {step}"

    @property
    def notes(self) -> tuple[str, ...]:
        """Additions to the message of the result."""
        return tuple(note for note in (self._origin, self._failure) if note)

    def keep(self) -> None:
        """Store a snapshot or write the file if it is due; called between two chunks of steps."""
        now = time.perf_counter()
        if now >= min(self._due, self._next_snapshot):
            self._take_snapshot()
        if now >= self._due:
            self._write_or_warn(None, "running")

    def end(self, status: int, message: str) -> None:
        """Record that the run has ended regularly."""
        if status == 0:
            self._take_snapshot()
        step = int(self._snapshot.arrays["place"][STEP])
        if self._ended != (status, message, step):  # otherwise the file already contains this
            self._write_or_warn(status, message)

    def interrupted(self, error: BaseException) -> None:
        """Record that `error` has ended the run."""
        try:
            self._write(None, f"interrupted by {type(error).__name__}")
        except CheckpointError as failure:
            error.add_note(str(failure))
        except KeyboardInterrupt:
            error.add_note("interrupted again while the checkpoint was written")
        error.add_note(
            f"the checkpoint {self._name!r} holds {self._written}: the same call with resume=True continues from there"
        )

    def _state(self) -> Arrays:
        """Return the values that identify the functions at the snapshot; {} if a function raises an error."""
        try:
            return self._known_by(self._snapshot.arrays)
        except Exception:  # a function may raise again what has ended the run; the checkpoint is written all the same
            return {}

    def _take_snapshot(self) -> None:
        begin = time.perf_counter()
        happened = [len(times) for times in self._events.t]
        self._snapshot = _Snapshot(self._driver.snapshot(), happened, begin - self._begin)
        end = time.perf_counter()
        self._next_snapshot = end + max(SNAPSHOT_SECONDS, LEAST_RATIO * (end - begin))

    def _where(self) -> str:
        arrays = self._snapshot.arrays
        return f"step {arrays['place'][STEP]}, t = {arrays['clock'][TIME]:.10g}"

    def _write_or_warn(self, status: int | None, message: str) -> None:
        """Write the file; if that fails, for example because the disk is full, warn and let the run continue."""
        self._failure = ""
        try:
            self._write(status, message)
        except CheckpointError as error:
            self._due = time.perf_counter() + self._every
            self._failure = f"{error}; it still holds {self._written}"
            again = f"The run continues and tries again in {self._every:g} s."
            then = again if status is None else "The result is complete."
            warnings.warn(f"{self._failure}. {then}", RuntimeWarning, stacklevel=users_level())

    def _write(self, status: int | None, message: str) -> None:
        driver, events, snapshot = self._driver, self._events, self._snapshot
        y0, begin = driver.run.y0, time.perf_counter()
        step, rows, _ = (int(k) for k in snapshot.arrays["place"])
        header = {
            "kind": KIND,
            "method": self._settings["method"],
            "n": y0.size,
            "invariants": self._names,
            "step": step,
            "t": float(snapshot.arrays["clock"][TIME]),
            "rows": rows,
            "status": status,
            "message": message,
            "wall_time": snapshot.seconds,
            "doubts": driver.run.trust.doubts,
            "settings": self._settings,
        }
        saved = {"saved_t": driver.t[:rows], "saved_y": driver.y[:rows]}
        arrays = {**self._state(), **snapshot.arrays, **saved}
        for k, count in enumerate(snapshot.happened):
            arrays[f"event_{k}_t"] = np.array(events.t[k][:count])
            arrays[f"event_{k}_y"] = np.array(events.y[k][:count], y0.dtype).reshape(count, y0.size)
        checkpoint.write(self._name, header, arrays)
        end = time.perf_counter()
        self._due = end + max(self._every, LEAST_RATIO * (end - begin))
        self._written = self._where()
