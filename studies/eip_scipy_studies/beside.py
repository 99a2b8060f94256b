"""Processes that work in parallel with a command: a single one, or several that share calls."""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import Connection
from typing import Any

from .report import UsageError

__all__ = ["Beside", "workers"]


class Beside:
    """Context of a second process that makes one call after the other.

    Leaving the context kills the process, even during a call. The process is spawned, not forked, because a fork copies
    locks that other threads hold. It needs about a second for its imports.
    """

    def __enter__(self) -> Beside:
        context = multiprocessing.get_context("spawn")
        self._pipe, there = context.Pipe()
        self._process = context.Process(target=_serve, args=(there,), daemon=True)
        with _deaf():
            self._process.start()
        there.close()
        return self

    def __exit__(self, *error: object) -> None:
        self._process.kill()
        self._process.join()
        self._pipe.close()

    def start(self, call: Callable[[], Any]) -> None:
        """Start ``call()`` in the process; `result` of the previous call must have been read.

        The function and its value must be picklable.
        """
        with contextlib.suppress(BrokenPipeError):  # `result` reports it
            self._pipe.send(call)

    def result(self) -> Any:
        """Wait for the call that `start` began, and return its value or raise its error.

        Raises
        ------
        UsageError
            If the process has died.
        """
        try:
            value, error = self._pipe.recv()
        except (EOFError, ConnectionError):
            raise UsageError(
                "the second process of this command has died: it was killed, or memory ran out. Free memory and repeat "
                "the command."
            ) from None
        if error is not None:
            raise error
        return value


@contextlib.contextmanager
def workers(processes: int) -> Iterator[Callable[..., Callable[[], Any]]]:
    """Start processes that share calls; leaving the context kills them, even during calls.

    Parameters
    ----------
    processes : int

    Yields
    ------
    callable
        ``start(function, *args)`` queues a call and returns a function that waits for its value, or raises
        UsageError if a process has died. Function, arguments and value must be picklable.
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
                raise UsageError(
                    "a process of this command has died: it was killed, or memory ran out. Free memory and repeat the "
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


def _serve(pipe: Connection) -> None:
    try:
        while True:
            call = pipe.recv()
            answer: tuple[Any, Exception | None]
            try:
                answer = call(), None
            except Exception as error:
                answer = None, error
            pipe.send(answer)
    except (EOFError, ConnectionError, KeyboardInterrupt):  # the command has ended; REBOUND listens to Ctrl-C itself
        pass
