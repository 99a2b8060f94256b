"""Processes that work in parallel with a command, and share calls."""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from .report import UsageError


@contextlib.contextmanager
def workers(processes: int) -> Iterator[Callable[..., Callable[[], Any]]]:
    """Start processes that share calls; leaving the context kills them, even during calls.

    The processes are spawned, not forked, because a fork copies locks that other threads hold. Each needs about a
    second for its imports. ``start(function, *args)``, which is yielded, queues a call and returns a function that
    waits for its value, or raises UsageError if a process has died. Function, arguments and value must be picklable.
    """
    others = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn"))

    def start(function: Callable[..., Any], *args: Any) -> Callable[[], Any]:
        with _deaf():
            future = pool.submit(function, *args)

        def value() -> Any:
            try:
                return future.result()
            except BrokenProcessPool:
                which = "the second process" if processes == 1 else "a process"
                raise UsageError(
                    f"{which} of this command has died: it was killed, or memory ran out. Free memory and repeat the "
                    "command."
                ) from None

        return value

    try:
        yield start
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in set(multiprocessing.active_children()) - others:
            process.kill()


@contextlib.contextmanager
def _deaf() -> Iterator[None]:
    """Ignore Ctrl-C while a process starts, so that the new process ignores it, too.

    In a terminal Ctrl-C goes to all processes, and the command alone reacts to it.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    heard = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, heard)
