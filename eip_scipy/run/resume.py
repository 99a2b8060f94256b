"""Checkpoints of `integrate`: the identity of a run, what is stored and when, and how a run is resumed."""

from __future__ import annotations

import hashlib
import math
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np

from .. import checkpoint
from ..checkpoint import CheckpointError, held, require_place
from ..core.callers import users_level
from ..core.events import Events
from ..core.inputs import is_number
from ..core.runs import Run
from ..engine.data import STEP, TIME
from ..methods.gauss_jackson import Weights

__all__ = ["Checkpointer", "opened", "plain", "settings"]

KIND = "integrate"
# Seconds from one snapshot to the next. A run resumes from its last snapshot; later steps are repeated.
SNAPSHOT_SECONDS = 0.2
# Smallest ratio of run time to the time for copying or writing, so that each takes at most 5 % for any size of state.
LEAST_RATIO = 19.0
SHORT = 16

Arrays = dict[str, np.ndarray]
Derivative = Callable[[float, np.ndarray], np.ndarray]


@contextmanager
def opened(path: Any, every: Any, resume: Any, dense_output: Any) -> Iterator[Checkpointer | None]:
    """Yield the `Checkpointer` for ``checkpoint``, ``checkpoint_every``, ``resume``; None without a checkpoint."""
    require_place(path, every, resume, "the path of a file")
    if path is None:
        yield None
        return
    if dense_output:
        raise ValueError(
            "a checkpoint does not store dense output; omit dense_output=True and use t_eval or save_every."
        )
    with held(path, KIND, "run", resume) as (name, found):
        note = "there was no checkpoint: started at the beginning" if resume else ""
        yield Checkpointer(name, float(every), found, note)


def settings(
    method: str, y0: np.ndarray, params: np.ndarray, run: Run, schedule: Any, events: Events
) -> dict[str, Any]:
    """Return everything except functions that determines the bits of a run, with the names that users know."""
    span = run.stepping.span
    # A user-defined one-step method is identified by its name and orders; functions are identified by their values.
    if run.method.in_python:
        parts = [run.method.order, run.method.error_estimator_order]
    else:
        *parts, history = run.stepper
        parts += [] if history is None else [getattr(history, part) for part in Weights._fields]
    found = {
        "method": f"{method} {_digest(parts)[:8]}",
        "t_span": (span.t0, span.t_bound),
        "h": run.stepping.h,
        "first_step": run.stepping.first_step,
        "max_step": span.max_step,
        "y0": y0,
        "params": params,
        **run.projection.identity(run.options, run.invariants),
        "save_every": schedule.save_every or None,
        "t_eval": schedule.t_eval if schedule.t_eval.size else None,
        "events": events.ends,
    }
    return {name: plain(value) for name, value in found.items()}


def plain(value: Any) -> Any:
    """Return a value in a form that JSON can hold; long arrays are replaced by their digest."""
    if isinstance(value, np.ndarray):
        return plain(value.tolist()) if value.size <= SHORT else f"{value.dtype} {value.shape} {_digest((value,))}"
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, complex) or (isinstance(value, float) and not math.isfinite(value)):
        return repr(value)
    return value


def _digest(values: Iterable[Any]) -> str:
    """Return a hash of arrays and numbers."""
    digest = hashlib.sha256()
    for value in values:
        a = np.ascontiguousarray(value)
        digest.update(f"{a.dtype} {a.shape} ".encode() + a.tobytes())
    return digest.hexdigest()


class Checkpointer:
    """The checkpoint of a run in the file `name`, written every `every` seconds.

    `found` is the content of an existing file; if there is none, the message of the result gets a `note`. The file
    always contains the last snapshot, which was taken after an accepted step, never the current buffers, because an
    interruption may come inside a step. Saved rows and events only grow, so a snapshot needs only their number.
    """

    seconds = 0.0  # run time before the run was resumed

    def __init__(self, name: str, every: float, found: tuple[dict[str, Any], Arrays] | None, note: str) -> None:
        self._name, self._every, self._found, self._origin = name, every, found, note
        self._failure = ""
        self._ended: Any = None

    def begin(self, driver: Any, settings: dict[str, Any], derivative: Derivative, events: Events) -> None:
        """Create the file, or fill the buffers of the `driver` and the `events` from it.

        The `settings` and the values of functions at the stored state identify the run; CheckpointError is raised if
        the file has another one.
        """
        self._driver, self._settings, self._derivative, self._events = driver, settings, derivative, events
        found, self._found = self._found, None
        if found is not None:
            self._restore(*found)
        self._begin = time.perf_counter() - self.seconds
        self.take_snapshot()
        self._written = self._where()
        self._due = time.perf_counter() + self._every
        if found is None:
            self._write(None, "running")

    def _restore(self, header: dict[str, Any], arrays: Arrays) -> None:
        """Fill the buffers of the run after everything has been checked."""
        driver, events, parts = self._driver, self._events, self._driver.parts()
        checkpoint.require_same(self._name, header.get("settings"), self._settings)
        self._require_fitting(arrays, parts)
        if "state_f" in arrays:
            self._require_same_functions(arrays)
        checkpoint.warn_of_other_versions(self._name, header, stacklevel=users_level())
        step, rows, pending = arrays["place"].tolist()
        if step < 0 or rows < 0 or pending != 0 or not is_number(header.get("wall_time")):
            stored = f"step {step}, {rows} rows, pending {pending}, wall_time {header.get('wall_time')!r}"
            raise CheckpointError(f"{self._name!r} is not a checkpoint of this run: its values are wrong: {stored}.")
        names = [f"event_{k}" for k in range(len(events.functions))]
        for name, m in {"saved": rows, **{name: np.size(arrays.get(f"{name}_t", ())) for name in names}}.items():
            states = np.broadcast_to(driver.state, (m, driver.state.size))
            self._require_fitting(arrays, {f"{name}_t": np.broadcast_to(0.0, m), f"{name}_y": states})
        driver.load(arrays["saved_t"], arrays["saved_y"])
        for name, part in parts.items():
            part[...] = arrays[name]
        for k, name in enumerate(names):
            events.restore(k, arrays[f"{name}_t"], arrays[f"{name}_y"])
        self.seconds = float(header["wall_time"])
        driver.run.trust.doubts[:] = map(str, header.get("doubts") or ())
        self._ended = (header.get("status"), header.get("message"), step)
        self._origin = f"resumed at step {step}"

    def _known_by(self, arrays: Arrays) -> Arrays:
        """Return the derivative and the invariants at the state in `arrays`, which identify the functions."""
        t, y = float(arrays["clock"][TIME]), arrays["y"]
        return {"state_f": self._derivative(t, y.copy()), "state_values": self._driver.run.invariants.values(t, y)}

    def _require_same_functions(self, arrays: Arrays) -> None:
        self._require_fitting(arrays, known_by := self._known_by(arrays))
        t, there = float(arrays["clock"][TIME]), np.concatenate([arrays[name] for name in known_by])
        invariants = self._driver.run.invariants
        changed = checkpoint.changed_function(invariants, t, arrays["y"], there, known_by["state_f"])
        if changed:
            name, *values = changed
            old, new = (f"{value if value.imag else value.real:.12g}" for value in values)
            raise CheckpointError(
                f"the checkpoint {self._name!r} belongs to another run: {name} was {old} at t = {t:.10g}, where it was "
                f"saved, and is {new} now. Resume with the functions of that run, or use another file for a new run."
            )

    def _require_fitting(self, arrays: Arrays, expected: Arrays) -> None:
        for name, a in expected.items():
            found = arrays.get(name)
            if found is None or (found.dtype, found.shape) != (a.dtype, a.shape):
                what = "is missing" if found is None else f"is {found.dtype} {found.shape}"
                raise CheckpointError(
                    f"{self._name!r} is not a checkpoint of this run: {name} {what}, expected {a.dtype} {a.shape}."
                )

    @property
    def notes(self) -> tuple[str, ...]:
        """Additions to the message of the result."""
        return tuple(note for note in (self._origin, self._failure) if note)

    def keep(self) -> None:
        """Store a snapshot or write the file if it is due; called between two chunks of steps."""
        now = time.perf_counter()
        if now >= min(self._due, self._next_snapshot):
            self.take_snapshot()
        if now >= self._due:
            self._write_or_warn(None, "running")

    def end(self, status: int, message: str) -> None:
        """Record that the run has ended regularly."""
        if status == 0:
            self.take_snapshot()
        step = int(self._snapshot[0]["place"][STEP])
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

    def take_snapshot(self) -> None:
        """Store a snapshot, which the next file holds; called between two chunks of steps."""
        begin = time.perf_counter()
        # One assignment, so that an interruption leaves a whole snapshot: buffers, numbers of events, and run time.
        parts = {name: part.copy() for name, part in self._driver.parts().items()}
        self._snapshot = parts, [len(times) for times in self._events.t], begin - self._begin
        self._next_snapshot = _next_time(begin, SNAPSHOT_SECONDS)

    def _where(self) -> str:
        parts = self._snapshot[0]
        return f"step {parts['place'][STEP]}, t = {parts['clock'][TIME]:.10g}"

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
        driver, events, begin = self._driver, self._events, time.perf_counter()
        parts, happened, seconds = self._snapshot
        step, rows, _ = parts["place"].tolist()
        header = {
            "kind": KIND,
            "method": self._settings["method"],
            "n": driver.state.size,
            "invariants": driver.run.invariants.names,
            "step": step,
            "t": float(parts["clock"][TIME]),
            "rows": rows,
            "status": status,
            "message": message,
            "wall_time": seconds,
            "doubts": driver.run.trust.doubts,
            "settings": self._settings,
        }
        arrays = dict(parts)
        with suppress(Exception):  # a function may raise again what has ended the run; the rest is written all the same
            arrays |= self._known_by(parts)
        saved = {"saved": (driver.t[:rows], driver.y[:rows])}
        for k, count in enumerate(happened):
            saved[f"event_{k}"] = events.t[k][:count], events.y[k][:count]
        for name, (t, y) in saved.items():
            arrays[f"{name}_t"] = np.asarray(t, float)
            arrays[f"{name}_y"] = np.asarray(y, driver.state.dtype).reshape(len(t), driver.state.size)
        checkpoint.write(self._name, header, arrays)
        self._due = _next_time(begin, self._every)
        self._written = self._where()


def _next_time(begin: float, every: float) -> float:
    """Return the time of the next copy: `every` seconds after one that began at `begin`, or later if it was slow."""
    now = time.perf_counter()
    return now + max(every, LEAST_RATIO * (now - begin))
