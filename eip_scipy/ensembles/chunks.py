"""Pools that run the chunks of an ensemble: threads of this process, or executors of `concurrent.futures`."""

from __future__ import annotations

import os
import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ThreadPoolExecutor
from functools import partial
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from ..engine.native import BUILD, working_alone
from .reduction import reduced
from .tasks import Members, Plan, Task, run_members

__all__ = ["Chunk", "Part", "Pool", "cores", "run_chunk", "run_elsewhere", "thread_pool"]

KEPT = (
    "The attribute partial of this exception contains the finished members. With checkpoint=, the same call with "
    "resume=True and another executor continues from there."
)
KEPT_PLANS = 4
AHEAD = 3


class Chunk(NamedTuple):
    """Members that run together: the number `first` of the first one, and the data of all m members.

    `y0s` (m, n) are the initial states, `params` (m, p) the parameters.
    """

    first: int
    y0s: np.ndarray
    params: np.ndarray

    def part(self, first: int, last: int) -> Chunk:
        """Return members `first` to `last` - 1 as a chunk, where 0 is the first member of this chunk."""
        return Chunk(self.first + first, self.y0s[first:last], np.ascontiguousarray(self.params[first:last]))


class Part(NamedTuple):
    """Results of a chunk; `one_by_one` is the reason why its members were not vectorised, "" if they were.

    `reduced` are the values (m, ...) of the function `reduce`, None without it or if all members failed.
    """

    members: Members
    reduced: np.ndarray | None
    one_by_one: str = ""


def run_chunk(plan: Plan, chunk: Chunk, *, stop: threading.Event | None = None) -> Part:
    """Run the members of a chunk, and return their results, without saved states if these are reduced."""
    members = run_members(plan, chunk.y0s, chunk.params, stop)
    if plan.task.reduce is None:
        return Part(members, None, plan.one_by_one)
    values = reduced(plan, members, chunk)
    members = members._replace(saved=members.saved[:, :0].copy(), saved_values=members.saved_values[:, :0].copy())
    return Part(members, values, plan.one_by_one)


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


class Pool:
    """Calls of ``run(chunk)``, which returns a `Part`, on an executor of `concurrent.futures`.

    ``workers()`` returns how many chunks can run at the same time. `close` cancels the chunks that have not started and
    calls ``end()``.
    """

    def __init__(
        self,
        executor: Executor,
        run: Callable[[Chunk], Part],
        workers: Callable[[], int],
        end: Callable[[], Any] = lambda: None,
    ) -> None:
        self._executor, self._run, self._workers, self._end = executor, run, workers, end
        self._under_way: deque[tuple[Chunk, Future[Part]]] = deque()

    def in_order(self, chunks: Iterable[Chunk]) -> Iterator[tuple[Chunk, Part]]:
        """Run chunks and yield each with its results, in order; `AHEAD` per worker are submitted at a time."""
        waiting = iter(chunks)
        while True:
            room = AHEAD * self._workers() - len(self._under_way)
            for chunk in islice(waiting, max(0, room)):
                self._under_way.append((chunk, self._submit(chunk)))
            if not self._under_way:
                return
            chunk, future = self._under_way.popleft()
            try:
                part = future.result()
            except BrokenExecutor as error:
                raise _broken(error, chunk) from error
            except CancelledError as error:
                raise RuntimeError(f"the executor given as executor= was closed while members ran. {KEPT}") from error
            yield chunk, part

    def _submit(self, chunk: Chunk) -> Future[Part]:
        try:
            return self._executor.submit(self._run, chunk)
        except BrokenExecutor as error:
            raise _broken(error, chunk) from error
        except RuntimeError as error:
            raise RuntimeError(f"the executor given as executor= is closed ({error}). {KEPT}") from error

    def close(self) -> None:
        """Stop everything that is running."""
        for _, future in self._under_way:
            future.cancel()
        self._end()


def thread_pool(plan: Plan, workers: int) -> Pool:
    """Return a pool of threads of this process; compiled members run in parallel."""
    stop = threading.Event()
    alone = partial(BUILD.work_alone, workers > 1)
    threads = ThreadPoolExecutor(workers, thread_name_prefix="eip-ensemble", initializer=alone)

    def end() -> None:
        stop.set()
        threads.shutdown(wait=True, cancel_futures=True)

    return Pool(threads, partial(run_chunk, plan, stop=stop), lambda: workers, end)


def _broken(error: BrokenExecutor, chunk: Chunk) -> BrokenExecutor:
    """Return an error for a worker that died; the executor does not say which of the running members caused it."""
    last = chunk.first + len(chunk.y0s) - 1
    return type(error)(
        f"a worker of the executor died before members {chunk.first} to {last} finished: it was killed, ran out of "
        f"memory, or a member ended its process. {KEPT}"
    )


def cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
