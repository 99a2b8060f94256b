"""The option ``checkpoint=`` of ensembles: a file with the finished members, from which a later call continues."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np

from .. import checkpoint
from ..checkpoint import CheckpointError, decoded, encoded, held
from ..core.callers import users_level
from ..run.prepare import identity
from .members import Chunk, Plan

__all__ = ["opened"]

KIND = "ensemble"
LEAST_RATIO = 19.0  # writing takes at most 5 % of the time


@contextmanager
def opened(
    path: Any, every: float, resume: bool, plan: Plan, everyone: Chunk
) -> Iterator[tuple[dict[str, Any] | None, Callable[..., None]]]:
    """Yield the results in the file ``checkpoint=path``, and the function ``write(finished, members, now=False)``."""
    if path is None:
        yield None, lambda *_, **__: None
        return
    with held(path, KIND, KIND, resume) as (name, found):
        file = EnsembleFile(name, every, plan, everyone)
        if found is None:
            checkpoint.write(name, file.header, {})
        yield None if found is None else file.read(*found), file.write


class EnsembleFile:
    """The file `name` with the finished members of an ensemble, the first ones of `everyone`.

    It is rewritten every `every` seconds.
    """

    def __init__(self, name: str, every: float, plan: Plan, everyone: Chunk) -> None:
        self._name, self._every, self._plan, self._everyone = name, every, plan, everyone
        reduce = plan.task.reduce
        reduce_name = None if reduce is None else getattr(reduce, "__qualname__", type(reduce).__qualname__)
        settings = identity(plan.ready, everyone.y0s, everyone.params) | {"reduce": reduce_name}
        self.header: dict[str, Any] = {"kind": KIND, "settings": settings, "finished": 0}
        self._known_by = np.zeros(0)  # derivative and invariants at the end of a member, which identify the functions
        self._written, self._cost = time.perf_counter(), 0.0

    def read(self, header: dict[str, Any], arrays: dict[str, np.ndarray]) -> dict[str, Any] | None:
        """Return the results in the file, or None; CheckpointError is raised if it belongs to another ensemble."""
        checkpoint.require_same(self._name, header.get("settings"), self.header["settings"])
        members, finished = None, int(header["finished"])
        if finished:
            members = self._plan.not_run(finished, self._plan.held)
            try:
                for field, values in members.items():
                    values[:] = decoded(header["members"][field], arrays)
                self._known_by = arrays["known_by"]
            except (KeyError, ValueError) as error:
                raise CheckpointError(
                    f"{self._name!r} was written by another version of eip_scipy, or is damaged: {error}. Use another "
                    "file for a new ensemble."
                ) from error
            members |= {"reduced": arrays.get("reduced"), "one_by_one": ""}
            if self._known_by.size:
                k, invariants, t, y, f = self._end(members)
                if changed := checkpoint.changed_function(invariants, t, y, self._known_by, f):
                    raise CheckpointError(
                        f"the checkpoint {self._name!r} belongs to another ensemble: {changed[0]} has another value at "
                        f"the end of member {k}. Resume with the functions of that ensemble, or use another file for a "
                        "new one."
                    )
        self.header["finished"] = finished
        checkpoint.warn_of_other_versions(self._name, header, stacklevel=users_level())
        return members

    def _end(self, members: dict[str, Any]) -> tuple[int, Any, float, np.ndarray, np.ndarray]:
        """Return number, invariants, end (t, y) and derivative there of the first member that did not fail."""
        k = int(np.flatnonzero(members["status"] >= 0)[0])
        run = self._plan.task.prepared(self._everyone.y0s[k], self._everyone.params[k])
        t, y = float(members["t"][k]), members["y"][k].copy()
        return k, run.invariants, t, y, run.problem.derivative(t, y.copy())

    def write(self, finished: int, members: dict[str, Any], *, now: bool = False) -> None:
        """Write the `finished` first of all `members` that are new, if it is time to do so, or `now`.

        An error, such as a full disk, only causes a warning, and the previous file is kept.
        """
        begin = time.perf_counter()
        due = now or begin - self._written >= max(self._every, LEAST_RATIO * self._cost)
        if not due or finished == self.header["finished"]:
            return
        if not self._known_by.size:
            with suppress(Exception):  # no member has ended yet, or a function raises an error there
                _, invariants, t, y, f = self._end(members)
                self._known_by = np.concatenate([f, invariants.values(t, y)])
        arrays = {"known_by": self._known_by}
        if members["reduced"] is not None:
            arrays["reduced"] = members["reduced"][:finished]
        names = self._plan.not_run(0, 0)
        fields = {name: encoded(f"members_{name}", members[name][:finished], arrays) for name in names}
        self.header |= {"finished": finished, "members": fields}
        try:
            checkpoint.write(self._name, self.header, arrays)
        except CheckpointError as error:
            warnings.warn(f"{error}; the previous checkpoint is kept", RuntimeWarning, stacklevel=users_level())
        self._written = time.perf_counter()
        self._cost = self._written - begin
