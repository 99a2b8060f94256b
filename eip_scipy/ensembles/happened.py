"""Events of the members of an ensemble: their times and states, and their conversion to flat arrays for files."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

__all__ = ["Flat", "Happened", "flattened", "happened", "unflattened"]

# For each event of a run its times (m,) and states (m, n).
Happened = list[tuple[np.ndarray, np.ndarray]]


class Flat(NamedTuple):
    """Events of several members.

    Attributes
    ----------
    counts : ndarray, shape (members, events)
        How often each event happened in each member.
    t : ndarray, shape (total,)
    y : ndarray, shape (total, n)
        Times and states, member after member, event after event.
    """

    counts: np.ndarray
    t: np.ndarray
    y: np.ndarray


def happened(count: int, which: np.ndarray, t: np.ndarray, y: np.ndarray) -> Happened:
    """Return the times and states of one member's events, grouped by event.

    `count` is the number of event functions; `which`, `t` and `y` are the number of the event function, the time and
    the state of each event, in the order of time.
    """
    return [(t[which == k].copy(), y[which == k].copy()) for k in range(count)]


def flattened(members: Sequence[Happened], events: int, n: int, dtype: Any) -> Flat:
    """Return the events of members as flat arrays.

    `events` is the number of event functions, `n` the number of components of a state, and `dtype` that of the states.
    """
    counts = np.zeros((len(members), events), np.int64)
    times: list[np.ndarray] = [np.zeros(0)]
    states: list[np.ndarray] = [np.zeros((0, n), dtype)]
    for i, member in enumerate(members):
        for k, (t, y) in enumerate(member):
            counts[i, k] = t.size
            times.append(t)
            states.append(y.reshape(t.size, n))
    return Flat(counts, np.concatenate(times), np.concatenate(states))


def unflattened(flat: Flat) -> list[Happened]:
    """Return the events of members from flat arrays."""
    ends = np.cumsum(flat.counts.reshape(-1))
    begins = ends - flat.counts.reshape(-1)
    pairs = [(flat.t[a:b].copy(), flat.y[a:b].copy()) for a, b in zip(begins, ends, strict=True)]
    m, events = flat.counts.shape
    return [pairs[i * events : (i + 1) * events] for i in range(m)]
