"""Events of the members of an ensemble: their times and states, and their conversion to flat arrays for files."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

__all__ = ["Flat", "Happened", "flattened", "happened", "unflattened"]

# For each event of a run its times (m,) and states (m, n).
Happened = list[tuple[np.ndarray, np.ndarray]]


class Flat(NamedTuple):
    """Events of several members, member after member, event after event."""

    counts: np.ndarray  # (members, events): how often each event happened in each member
    t: np.ndarray  # (total,)
    y: np.ndarray  # (total, n)


def happened(count: int, which: np.ndarray, t: np.ndarray, y: np.ndarray) -> Happened:
    """Return the times and states of one member's events, in the order of time, for each of `count` event functions."""
    return [(t[which == k].copy(), y[which == k].copy()) for k in range(count)]


def flattened(members: Sequence[Happened], events: int, n: int, dtype: Any) -> Flat:
    """Return the events of members, `events` functions of states with `n` components of `dtype`, as flat arrays."""
    counts, times, states = np.zeros((len(members), events), np.int64), [np.zeros(0)], [np.zeros((0, n), dtype)]
    for i, member in enumerate(members):
        for k, (t, y) in enumerate(member):
            counts[i, k] = t.size
            times.append(t)
            states.append(y.reshape(t.size, n))
    return Flat(counts, np.concatenate(times), np.concatenate(states))


def unflattened(flat: Flat) -> list[Happened]:
    """Return the events of members from flat arrays."""
    ends = np.cumsum(flat.counts).reshape(flat.counts.shape)
    return [
        [(flat.t[b - n : b].copy(), flat.y[b - n : b].copy()) for n, b in zip(*row, strict=True)]
        for row in zip(flat.counts, ends, strict=True)
    ]
