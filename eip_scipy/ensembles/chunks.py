"""Pools that run the chunks of an ensemble: threads of this process, or executors of `concurrent.futures`."""

from __future__ import annotations

import os
import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple, Protocol

import numpy as np

from ..engine.native import BUILD, working_alone
from .own_times import OwnTimes
from .statistics import Statistics, statistics_of
from .tasks import Members, Plan, Task, run_members

__all__ = ["Chunk", "FuturesPool", "Part", "Pool", "ThreadPool", "in_order", "run_chunk", "run_elsewhere"]

KEPT = (
    "The attribute partial of this exception contains the finished members. With out= or checkpoint=, the same call "
    "with resume=True and another executor continues from there."
)
KEPT_PLANS = 4
AHEAD = 3


class Chunk(NamedTuple):
    """Members that run together: the number `first` of the first one, and the data of all m members.

    `y0s` (m, n) are the initial states, `params` (m, p) the parameters, and `own` the intervals and times if members
    have different ones.
    """

    first: int
    y0s: np.ndarray
    params: np.ndarray
    own: OwnTimes = OwnTimes()

    def part(self, first: int, last: int) -> Chunk:
        """Return members `first` to `last` - 1 as a chunk, where 0 is the first member of this chunk."""
        params = np.ascontiguousarray(self.params[first:last])
        return Chunk(self.first + first, self.y0s[first:last], params, self.own.part(first, last))


class Part(NamedTuple):
    """Results of a chunk; `one_by_one` is the reason why its members were not vectorised, "" if they were."""

    members: Members
    statistics: Statistics | None
    one_by_one: str = ""


class Pool(Protocol):
    """Interface of the classes that run chunks."""

    def capacity(self) -> int:
        """Return how many chunks can run at the same time."""

    def submit(self, chunk: Chunk) -> Any:
        """Start a chunk, and return a ticket by which `collect` finds it."""

    def collect(self, chunk: Chunk, ticket: Any) -> Part:
        """Wait for a chunk and return its results."""

    def close(self) -> None:
        """Stop everything that is running."""


def run_chunk(plan: Plan, chunk: Chunk, *, stop: threading.Event | None = None) -> Part:
    """Run the members of a chunk, and return their results, with statistics if the task requests them."""
    return finished(plan.task, plan, run_members(plan, chunk.y0s, chunk.params, stop, chunk.own))


def finished(task: Task, plan: Plan, members: Members) -> Part:
    """Return the results and, if requested, the statistics of `members`; saved states only if the task keeps them."""
    statistics = None
    if task.reduce is not None:
        statistics = statistics_of(task.reduce, *plan.states(members))
    if not task.keep:
        members = members._replace(saved=members.saved[:, :0].copy(), saved_values=members.saved_values[:, :0].copy())
    return Part(members, statistics, plan.one_by_one)


_plans: OrderedDict[str, Plan] = OrderedDict()
_making = threading.Lock()


@working_alone()  # the other processors run other chunks
def run_elsewhere(task: Task, key: str, chunk: Chunk) -> Part:
    """Run a chunk in a worker process and return its results.

    The process creates the plan for its first chunk and keeps it under `key`, which identifies the ensemble.
    """
    with _making:
        plan = _plans.get(key)
        if plan is None:
            plan = _plans[key] = Plan(task).compile()
            while len(_plans) > KEPT_PLANS:
                _plans.popitem(last=False)
    return run_chunk(plan, chunk)


class FuturesPool:
    """Pool that calls ``run(chunk)``, which returns a `Part`, on an executor of `concurrent.futures`.

    `close` cancels the chunks that have not started, and leaves the executor open.
    """

    def __init__(self, executor: Executor, run: Callable[[Chunk], Part], workers: int) -> None:
        self._executor, self._run, self._workers = executor, run, workers
        self._open: set[Future[Part]] = set()

    def capacity(self) -> int:
        return self._workers

    def submit(self, chunk: Chunk) -> Future[Part]:
        try:
            future = self._executor.submit(self._run, chunk)
        except BrokenExecutor as error:
            raise _broken(error, chunk) from error
        except RuntimeError as error:
            raise RuntimeError(f"the executor given as executor= is closed ({error}). {KEPT}") from error
        self._open.add(future)
        return future

    def collect(self, chunk: Chunk, ticket: Future[Part]) -> Part:
        try:
            return ticket.result()
        except BrokenExecutor as error:
            raise _broken(error, chunk) from error
        except CancelledError as error:
            raise RuntimeError(f"the executor given as executor= was closed while members ran. {KEPT}") from error
        finally:
            self._open.discard(ticket)

    def close(self) -> None:
        for future in self._open:
            future.cancel()


class ThreadPool(FuturesPool):
    """Pool of threads of this process; compiled members run in parallel."""

    def __init__(self, plan: Plan, workers: int) -> None:
        self._stop = threading.Event()
        alone = partial(BUILD.gravity.work_alone, workers > 1)
        threads = ThreadPoolExecutor(workers, thread_name_prefix="eip-ensemble", initializer=alone)
        super().__init__(threads, partial(run_chunk, plan, stop=self._stop), workers)

    def close(self) -> None:
        self._stop.set()
        self._executor.shutdown(wait=True, cancel_futures=True)


def _broken(error: BrokenExecutor, chunk: Chunk) -> BrokenExecutor:
    """Return an error for a worker that died; the executor does not say which of the running members caused it."""
    last = chunk.first + len(chunk.y0s) - 1
    return type(error)(
        f"a worker of the executor died before members {chunk.first} to {last} finished: it was killed, ran out of "
        "memory, or a member ended its process (executor='dask' finds such a member and runs the others). " + KEPT
    )


def cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def in_order(pool: Pool, chunks: Iterable[Chunk]) -> Iterator[tuple[Chunk, Part]]:
    """Run chunks and yield each with its results, in order; at most `AHEAD` per worker are submitted at a time."""
    waiting = iter(chunks)
    under_way: deque[tuple[Chunk, Any]] = deque()
    while True:
        room = AHEAD * pool.capacity() - len(under_way)
        for _, chunk in zip(range(room), waiting, strict=False):
            under_way.append((chunk, pool.submit(chunk)))
        if not under_way:
            return
        chunk, ticket = under_way.popleft()
        yield chunk, pool.collect(chunk, ticket)
