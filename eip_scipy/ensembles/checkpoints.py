"""The option ``checkpoint=`` of ensembles: a file with the finished members, from which a later call continues."""

from __future__ import annotations

import time
import warnings
from contextlib import ExitStack, suppress
from typing import Any

import numpy as np

from .. import checkpoint
from ..checkpoint import CheckpointError, decoded, encoded, held
from ..core.callers import users_level
from ..core.runs import Run
from ..run.prepare import identity
from .chunks import Chunk
from .tasks import Members, Plan

__all__ = ["EnsembleFile"]

KIND = "ensemble"
# Writing takes at most 5 % of the time.
LEAST_RATIO = 19.0


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
        self._known_by: np.ndarray | None = None
        self._lock = ExitStack()
        self.path, content = self._lock.enter_context(held(path, KIND, "ensemble", resume))
        try:
            self._open(content)
        except BaseException:
            self.close()
            raise
        self._written, self._cost = time.perf_counter(), 0.0

    def _open(self, content: tuple[dict[str, Any], dict[str, np.ndarray]] | None) -> None:
        """Read the content of an existing file, or create one."""
        if content is None:
            checkpoint.write(self.path, {"kind": KIND, "settings": self._identity, "finished": 0}, {})
            return
        header, arrays = content
        checkpoint.require_same(self.path, header.get("settings"), self._identity)
        self.finished = int(header["finished"])
        if not self.finished:
            return
        expected = self._plan.empty(self.finished, self._plan.held)
        try:
            found = {name: decoded(header["members"][name], arrays) for name in Members._fields}
            wrong = [name for name, value in found.items() if _shape(value) != _shape(getattr(expected, name))]
            known_by = arrays["known_by"]
        except KeyError as error:
            wrong = [str(error)]
        if wrong:
            raise CheckpointError(
                f"{self.path!r} was written by another version of eip_scipy, or is damaged: {wrong[0]} is missing or "
                "has another shape. Use another file for a new ensemble."
            )
        self.members, self.reduced, self._known_by = Members(**found), arrays.get("reduced"), known_by
        if known_by.size:
            self._require_same_functions(known_by)
        checkpoint.warn_of_other_versions(self.path, header, stacklevel=users_level())

    def _end(self, members: Members) -> tuple[int, Run, float, np.ndarray, np.ndarray]:
        """Return number, run, end (t, y) and derivative there of the first member that did not fail."""
        k = int(np.flatnonzero(members.status >= 0)[0])
        ready = self._plan.task.prepared(self._everyone.y0s[k], self._everyone.params[k])
        t, y = float(members.t[k]), members.y[k].copy()
        return k, ready, t, y, ready.problem.derivative(t, y.copy())

    def _require_same_functions(self, known_by: np.ndarray) -> None:
        k, ready, t, y, f = self._end(self.members)
        if changed := checkpoint.changed_function(ready.invariants, t, y, known_by, f):
            raise CheckpointError(
                f"the checkpoint {self.path!r} belongs to another ensemble: {changed[0]} has another value at the end "
                f"of member {k}. Resume with the functions of that ensemble, or use another file for a new one."
            )

    def write(self, done: int, whole: Members, reduced: np.ndarray | None) -> None:
        """Record that the first `done` members of `whole` are finished; write the file if it is time to do so."""
        self._waiting = done, whole, reduced
        if self._known_by is None and (whole.status[:done] >= 0).any():
            self._known_by = np.zeros(0)
            with suppress(Exception):  # a function may raise an error there; the members are stored all the same
                _, ready, t, y, f = self._end(whole)
                self._known_by = np.concatenate([f, ready.invariants.values(t, y)])
        if time.perf_counter() - self._written >= max(self._every, LEAST_RATIO * self._cost):
            self.flush()

    def flush(self) -> None:
        """Write new results; an error, such as a full disk, only causes a warning, and the previous file is kept."""
        if self._waiting is None:
            return
        begin = time.perf_counter()
        done, whole, reduced = self._waiting
        arrays = {"known_by": np.zeros(0) if self._known_by is None else self._known_by}
        fields = whole._asdict().items()
        members = {name: encoded(f"members_{name}", value[:done], arrays) for name, value in fields}
        if reduced is not None:
            arrays["reduced"] = reduced[:done]
        header = {"kind": KIND, "settings": self._identity, "finished": done, "members": members}
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


def _shape(value: Any) -> tuple[int, ...] | None:
    return value.shape if isinstance(value, np.ndarray) else None


def _identity(plan: Plan, everyone: Chunk) -> dict[str, Any]:
    """Return all settings except functions that determine the result, by users' names, in a form for JSON."""
    reduce = plan.task.reduce
    name = None if reduce is None else getattr(reduce, "__qualname__", type(reduce).__qualname__)
    return identity(plan.ready, everyone.y0s, everyone.params) | {"reduce": name}
