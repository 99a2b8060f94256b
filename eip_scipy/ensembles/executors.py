"""Execution of the chunks of an ensemble: in threads of this process, or on executors of `concurrent.futures`."""

from __future__ import annotations

import os
import threading
import uuid
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ThreadPoolExecutor
from functools import partial
from importlib import import_module
from itertools import islice
from typing import Any

import numpy as np

from ..core.inputs import count
from ..engine.native import BUILD, working_alone
from .members import Chunk, Plan, Task, run_chunk

__all__ = ["results"]

KEPT = (
    "The attribute partial of this exception contains the finished members. With checkpoint=, the same call with "
    "resume=True and another executor continues from there."
)
AHEAD = 3  # chunks that are submitted for each worker
KEPT_PLANS = 4

_plans: dict[str, Plan] = {}
_making = threading.Lock()


@working_alone()  # the other processors run other chunks
def run_elsewhere(task: Task, key: str, chunk: Chunk) -> dict[str, Any]:
    """Run a chunk in a worker process and return its results.

    The process creates the plan for its first chunk and keeps it under `key`, which identifies the ensemble.
    """
    with _making:
        plan = _plans.get(key) or Plan(task).compile()
        _plans[key] = plan
        if len(_plans) > KEPT_PLANS:
            del _plans[next(iter(_plans))]
    return run_chunk(plan, chunk)


def results(
    executor: Any, plan: Plan, chunks: Iterable[Chunk], *, progress: bool
) -> Generator[tuple[int, dict[str, Any]], None, None]:
    """Run chunks on the option `executor`, and yield the number of the first member and the results of each, in order.

    Closing the iterator stops everything.
    """
    stop = threading.Event()
    pool, run, workers, end = _opened(executor, plan, stop, progress)
    waiting, under_way = iter(chunks), deque[tuple[Chunk, Future[Any]]]()
    try:
        while True:
            for chunk in islice(waiting, max(0, AHEAD * workers() - len(under_way))):
                try:
                    under_way.append((chunk, pool.submit(run, chunk)))
                except RuntimeError as error:
                    if isinstance(error, BrokenExecutor):
                        raise
                    raise RuntimeError(f"the executor given as executor= is closed ({error}). {KEPT}") from error
            if not under_way:
                return
            chunk, future = under_way.popleft()
            yield chunk.first, future.result()
    except BrokenExecutor as error:  # it does not say which of the running members caused that
        last = chunk.first + len(chunk.y0s) - 1
        raise type(error)(
            f"a worker of the executor died before members {chunk.first} to {last} finished: it was killed, ran out of "
            f"memory, or a member ended its process. {KEPT}"
        ) from error
    except CancelledError as error:
        raise RuntimeError(f"the executor given as executor= was closed while members ran. {KEPT}") from error
    finally:
        stop.set()
        for _, future in under_way:
            future.cancel()
        end()


def _opened(
    executor: Any, plan: Plan, stop: threading.Event, progress: bool
) -> tuple[Executor, Callable[[Chunk], Any], Callable[[], int], Callable[[], Any]]:
    """Return an executor, what it calls for each chunk, and the functions that count its workers and that end it."""
    if executor is None or isinstance(executor, (int, np.integer)):
        plan.compile(progress=progress)
        number = _cores() if executor is None else count("executor", executor)
        number = number if plan.why_not is None else 1
        alone, run = partial(BUILD.work_alone, number > 1), partial(run_chunk, plan, stop=stop)
        threads = ThreadPoolExecutor(number, thread_name_prefix="eip-ensemble", initializer=alone)
        return threads, run, lambda: number, partial(threads.shutdown, cancel_futures=True)
    run = partial(run_elsewhere, plan.task, uuid.uuid4().hex)
    if isinstance(executor, Executor):
        return executor, run, partial(_workers, executor), lambda: None
    if executor == "dask" or type(executor).__module__.partition(".")[0] == "distributed":
        if pointers := plan.ready.problem.pointers(plan.ready):
            raise pointers[0].unpicklable()  # Dask's own message for it is very long
        # Imported by name, because the integrations depend on this package and need further libraries.
        pool, workers, end = import_module("eip_scipy.integrations.dask").connected(executor)
        return pool, run, workers, end
    raise TypeError(
        f"executor must be None, a number of threads, 'dask', a dask.distributed Client or an executor of "
        f"concurrent.futures, got {executor!r}."
    )


def _workers(executor: Executor) -> int:
    """Return the number of workers of an executor, of `mpi4py.futures` or of Python, or else the number of cores."""
    found = (getattr(executor, name, None) for name in ("num_workers", "_max_workers"))
    return next((number for number in found if isinstance(number, int) and number > 0), _cores())


def _cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
