"""Timing of functions to be compared: all are called in turn, and the least time of each counts."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Hashable, Mapping
from typing import Any, TypeVar

Name = TypeVar("Name", bound=Hashable)
Action = Callable[[], float]
FEWEST = 3


def clocked(call: Callable[[], Any], clock: Callable[[], float] = time.perf_counter) -> Action:
    """Make a function that calls `call` once and returns its duration in seconds, a difference of two ``clock()``."""

    def run() -> float:
        begin = clock()
        call()
        return clock() - begin

    return run


def many_calls(call: Callable[[], Any]) -> Action:
    """Make a function that returns the processor time of one call in seconds, as the mean of many calls.

    There are enough calls that the time of reading the clock is negligible. `call` is also called twice when the
    function is made, to compile `call` and to choose the number of calls.
    """
    call()
    calls = max(1, int(2e-3 / max(clocked(call)(), 1e-6)))

    def several() -> None:
        for _ in range(calls):
            call()

    def run() -> float:
        call()  # memory and caches in the state left by other functions are not measured
        return clocked(several, time.process_time)() / calls

    return run


def least(actions: Mapping[Name, Action], *, turns: int = 1, seconds: float = 0.0) -> dict[Name, float]:
    """Call all actions in turn several times, and return the least time of each; inf if there were no calls.

    Actions return the seconds that they took. There are `turns` calls of each action, in turn, so that other load
    affects all equally. If `seconds` is not 0, `turns` is ignored: there are at least 3, until this number of seconds
    has passed.
    """
    best = dict.fromkeys(actions, math.inf)
    end, done = time.perf_counter() + seconds, 0
    while done < (FEWEST if seconds else turns) or (seconds and time.perf_counter() < end):
        for name, action in actions.items():
            best[name] = min(best[name], action())
        done += 1
    return best
