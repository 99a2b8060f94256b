"""Intervals and times of saved states that differ between members."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..core.inputs import shown
from ..core.stepping import interval

__all__ = ["OwnTimes", "own_times"]


class OwnTimes(NamedTuple):
    """Intervals of members, None if all members have the same, and times of their saved states.

    `times` are None if all members have the same interval and times, or no times.
    """

    spans: list[tuple[float, float]] | None = None
    times: list[np.ndarray] | None = None

    def __bool__(self) -> bool:
        return self.spans is not None or self.times is not None

    @property
    def members(self) -> int:
        """Number of rows, one for each member; 0 if all members have the same interval and times."""
        return len(self.spans or self.times or ())

    @property
    def name(self) -> str:
        """Name of the argument that has a row for each member."""
        return "t_eval" if self.spans is None else "t_span"

    def part(self, first: int, last: int) -> OwnTimes:
        """Return the intervals and times of members `first` to `last` - 1."""
        spans = None if self.spans is None else self.spans[first:last]
        return OwnTimes(spans, None if self.times is None else self.times[first:last])

    def of(self, k: int) -> dict[str, Any]:
        """Return the arguments `t_span` and `t_eval` of `integrate` for member `k`, if they differ between members."""
        found = {"t_span": self.spans, "t_eval": self.times}
        return {name: rows[k] for name, rows in found.items() if rows is not None}

    @property
    def identity(self) -> dict[str, Any]:
        """Return by name the intervals and times as arrays, which are compared when an ensemble is resumed."""
        found = {} if self.spans is None else {"t_span": np.array(self.spans)}
        return found if self.times is None else found | {"t_eval": self.padded}

    @property
    def padded(self) -> np.ndarray:
        """Return the times as rows (members, m), padded with nan."""
        times = self.times or []
        out = np.full((len(times), max((t.size for t in times), default=0)), np.nan)
        for row, t in zip(out, times, strict=True):
            row[: t.size] = t
        return out


def own_times(fun: Any, t_span: Any, t_eval: Any, save_every: Any, reduce: Any) -> OwnTimes:
    """Return the rows of `t_span` and `t_eval` for each member, if they have such rows."""
    spans, times = None, None
    if _has_rows(t_span):
        for row in t_span:
            if np.shape(row) != (2,):
                raise ValueError(
                    f"t_span must be (start, end), or have the shape (members, 2); got the row {shown(row)}."
                )
        spans = [interval(row) for row in t_span]
    if _has_rows(t_eval):
        times = [np.array(row, float) for row in t_eval]
        for k, row in enumerate(times):
            if row.ndim != 1 or row.size == 0:
                raise ValueError(f"t_eval[{k}] must be the times of one member, 1-dimensional and not empty.")
    if spans is not None and times is None and t_eval is not None:
        times = [np.array(t_eval, float)] * len(spans)
    if spans is not None and times is not None and len(spans) != len(times):
        raise ValueError(
            f"t_span has {len(spans)} rows and t_eval has {len(times)}; give one row of each for each member."
        )
    found = OwnTimes(spans, times)
    if found and save_every is not None:
        raise ValueError(
            "save_every needs the same t_span for all members, and cannot be combined with a t_eval for each member; "
            "omit it, and give t_eval with one row for each member."
        )
    if found and reduce is not None:
        raise ValueError("reduce compares members at the same times; give one t_span and one t_eval for all members.")
    return found


def _has_rows(given: Any) -> bool:
    """Return True if an argument has a row for each member."""
    if isinstance(given, np.ndarray) or not isinstance(given, Sequence):
        return np.ndim(given) == 2
    return len(given) > 0 and all(np.ndim(item) == 1 for item in given)
