"""The option ``reduce=`` of ensembles: a function of the result of each member."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..core.inputs import shown
from ..run.integrate import assembled
from ..run.results import IntegrationResult
from .tasks import Members, Plan

if TYPE_CHECKING:
    from .chunks import Chunk

__all__ = ["placed", "reduced"]


def reduced(plan: Plan, members: Members, chunk: Chunk) -> np.ndarray | None:
    """Return the values of the task's `reduce` for the members of a chunk, NaN for those that failed; None if all did.

    An exception that `reduce` raises gets a note with the number of the member.
    """
    assert plan.task.reduce is not None
    out: np.ndarray | None = None
    for k in np.flatnonzero(members.status >= 0).tolist():
        try:
            found = plan.task.reduce(_member(plan, members, k))
            value = np.asarray(found)
            if value.dtype.kind not in "biufc":
                raise TypeError(f"reduce returned {shown(found)}; expected a number or an array of numbers.")
            out = placed(out, len(members.t), slice(k, k + 1), value[None])
        except Exception as error:
            error.add_note(f"ensemble: this is reduce for member {chunk.first + k}")
            raise
    return out


def placed(out: np.ndarray | None, members: int, where: slice, values: np.ndarray) -> np.ndarray:
    """Return the rows `out` of all `members` with `values` at `where`; rows are made if they are missing or too narrow.

    ValueError is raised if the values of members differ in shape.
    """
    if out is None:
        out = np.full((members, *values.shape[1:]), np.nan, np.result_type(values, float))
    if values.shape[1:] != out.shape[1:]:
        raise ValueError(
            f"reduce returned arrays of shape {out.shape[1:]} and {values.shape[1:]} for different members; return the "
            "same shape for all of them. Members that an event ends may have fewer states."
        )
    if (wider := np.result_type(out, values)) != out.dtype:
        out = out.astype(wider)
    out[where] = values
    return out


def _member(plan: Plan, members: Members, k: int) -> IntegrationResult:
    """Return the result of member `k` as `integrate` does, with the fields that do not need the run itself."""
    there = ~np.isnan(members.saved[k]).any(axis=1)
    rows = there.size if there.all() else int(np.argmin(there))
    t, y, values = plan.times[:rows], members.saved[k, :rows], members.saved_values[k, :rows]
    if plan.ready.schedule.t_eval.size == 0 and members.t[k] not in t[-1:]:
        t, y = np.append(t, members.t[k]), np.concatenate([y, members.y[k : k + 1]])
        values = np.concatenate([values, members.values[k : k + 1]])
    return assembled(
        plan.ready,
        y,
        (members.t_events[k], members.y_events[k]) if plan.events else None,
        members.counters[k],
        t=t,
        invariants=values.T,
        target=members.target[k],
        max_residual=members.max_residual[k],
        status=int(members.status[k]),
        message=members.message[k],
        success=True,
        trusted=bool(members.trusted[k]),
        compiled=plan.why_not is None,
        h=plan.h,
    )
