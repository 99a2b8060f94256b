"""The option ``checkpoint=`` of ensembles: a file with the finished members, from which a later call continues."""

from __future__ import annotations

import os
import time
import warnings
from typing import Any

import numpy as np

from .. import checkpoint
from ..checkpoint import CheckpointError
from ..checkpoint.locks import Lock
from ..core.callers import users_level
from .chunks import Chunk
from .happened import Flat, flattened, unflattened
from .saving import expanded, shortened
from .tasks import LISTS, Members, Plan

__all__ = ["EnsembleFile"]

KIND = "ensemble"
# Relative difference allowed between values of the same function, also on another machine.
SAME = 1e-9
# Writing takes at most 5 % of the time.
LEAST_RATIO = 19.0
FIELDS = [name for name in Members._fields if name not in LISTS]


class EnsembleFile:
    """File with the finished members of an ensemble, rewritten every `every` seconds.

    `finished` members are stored when the file is opened, the first ones of `everyone`; `members` are their results,
    and `reduced` the values of ``reduce=``. CheckpointError is raised if the file exists and `resume` is False, or if
    it belongs to another ensemble than that of `plan`.
    """

    def __init__(self, path: str, every: float, resume: bool, plan: Plan, everyone: Chunk) -> None:
        self._every, self._plan, self._everyone = every, plan, everyone
        self._identity = _identity(plan, everyone)
        self.finished, self.members = 0, plan.empty(0)
        self.reduced: np.ndarray | None = None
        self._waiting: tuple[int, Members, np.ndarray | None] | None = None
        self._seen: dict[str, Any] = {}
        self._lock = Lock(path)
        self.path = self._lock.name
        try:
            self._open(resume)
        except BaseException:
            self.close()
            raise
        self._written, self._cost = time.perf_counter(), 0.0

    def _open(self, resume: bool) -> None:
        """Read the existing file, or create one."""
        if not os.path.lexists(self.path):
            checkpoint.write(self.path, {"kind": KIND, "settings": self._identity, "finished": 0}, {})
            return
        if not resume:
            raise checkpoint.existing(self.path, "ensemble")
        header, arrays = checkpoint.read(self.path, KIND)
        checkpoint.require_same(self.path, header.get("settings"), self._identity)
        self.finished = int(header["finished"])
        if not self.finished:
            return
        try:
            flat = Flat(*(arrays[f"events_{name}"] for name in Flat._fields))
            fields = {name: arrays[f"members_{name}"] for name in FIELDS}
            message, place = expanded(header["messages"], self.finished), header["seen"]
        except KeyError as error:
            raise self._other(f"{error} is missing") from error
        plan = self._plan
        empty = Members.empty(self.finished, plan.size, plan.dtype, len(plan.names), plan.held)
        for name, array in fields.items():
            if array.shape != getattr(empty, name).shape:
                raise self._other(f"{name} has the shape {array.shape}, expected {getattr(empty, name).shape}")
        self.members = Members(**fields, message=message, happened=unflattened(flat))
        self.reduced = arrays.get("reduced")
        if place is not None:
            self._seen = {"place": place, "f": arrays["seen_f"]}
            self._require_same_functions(place, arrays["seen_f"])
        checkpoint.warn_of_other_versions(self.path, header, stacklevel=users_level())

    def _other(self, why: str) -> CheckpointError:
        return CheckpointError(
            f"{self.path!r} was written by another version of eip_scipy, or is damaged: {why}. Use another file for a "
            "new ensemble."
        )

    def _require_same_functions(self, k: int, f: np.ndarray) -> None:
        """Raise CheckpointError if the present functions differ at the last state of member `k`, where fun was `f`."""
        members = self.members
        t, y = float(members.t[k]), members.y[k].copy()
        ready = self._plan.task.prepared(self._everyone.y0s[k], self._everyone.params[k])
        here, values = ready.system.derivative(t, y.copy()), ready.run.invariants.values(t, y)
        sizes = ready.run.invariants.term_sizes(t, y, here)
        names = [f"invariant {name!r}" for name in self._plan.names]
        same = [np.abs(values - members.values[k]) <= SAME * sizes]
        same.append(np.abs(here - f).max(keepdims=True, initial=0.0) <= SAME * np.abs(f).max(initial=0.0))
        wrong = [name for name, right in zip([*names, "fun"], np.concatenate(same), strict=True) if not right]
        if wrong:
            raise CheckpointError(
                f"the checkpoint {self.path!r} belongs to another ensemble: {wrong[-1]} has another value at the end "
                f"of member {k}. Resume with the functions of that ensemble, or use another file for a new one."
            )

    def write(self, done: int, whole: Members, reduced: np.ndarray | None) -> None:
        """Record that the first `done` members of `whole` are finished; write the file if it is time to do so."""
        self._waiting = done, whole, reduced
        if not self._seen:
            self._see(whole.status[:done], whole)
        if time.perf_counter() - self._written >= max(self._every, LEAST_RATIO * self._cost):
            self.flush()

    def _see(self, status: np.ndarray, whole: Members) -> None:
        """Evaluate fun at the last state of the first member that did not fail, to recognise it later."""
        for k in np.flatnonzero(status >= 0)[:1].tolist():
            self._seen = {"place": None, "f": np.zeros(0)}
            try:
                ready = self._plan.task.prepared(self._everyone.y0s[k], self._everyone.params[k])
                f = ready.system.derivative(float(whole.t[k]), whole.y[k].copy())
            except Exception:  # a function may raise an error there; the members are stored all the same
                return
            if np.isfinite(f).all() and np.isfinite(whole.values[k]).all():
                self._seen = {"place": k, "f": f}

    def flush(self) -> None:
        """Write new results; an error, such as a full disk, only causes a warning, and the previous file is kept."""
        if self._waiting is None:
            return
        begin = time.perf_counter()
        done, whole, reduced = self._waiting
        header = {"kind": KIND, "settings": self._identity, "finished": done, "seen": self._seen.get("place")}
        header["messages"] = shortened(whole.message[:done])
        happened = whole.happened[:done]
        flat = flattened(happened, self._plan.events, self._plan.size, self._plan.dtype)
        arrays = {f"members_{name}": getattr(whole, name)[:done] for name in FIELDS}
        arrays |= {f"events_{name}": value for name, value in flat._asdict().items()}
        arrays["seen_f"] = self._seen.get("f", np.zeros(0))
        if reduced is not None:
            arrays["reduced"] = reduced[:done]
        try:
            checkpoint.write(self.path, header, arrays)
        except CheckpointError as error:
            warnings.warn(f"{error}; the previous checkpoint is kept", RuntimeWarning, stacklevel=users_level())
        self._waiting = None
        self._written = time.perf_counter()
        self._cost = self._written - begin

    def close(self) -> None:
        """Release the lock."""
        self._lock.close()


def _identity(plan: Plan, everyone: Chunk) -> dict[str, Any]:
    """Return all settings except functions that determine the result, by users' names, in a form for JSON."""
    reduce = plan.task.reduce
    name = None if reduce is None else getattr(reduce, "__qualname__", type(reduce).__qualname__)
    return plan.ready.identity(everyone.y0s, everyone.params) | {"reduce": name}
