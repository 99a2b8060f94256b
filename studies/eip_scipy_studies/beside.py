"""Processes that work in parallel to a command: a single one, or one for each core."""

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
    """A process that does one call after the other; leaving the context ends it at any time.

    It is started from scratch, not forked: a fork copies locks that other threads hold. It imports what the calls
    need in about a second.
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
        """Start `call`, which must pickle like its result; the result of the previous call must have been read."""
        with contextlib.suppress(BrokenPipeError):  # `result` reports it
            self._pipe.send(call)

    def result(self) -> Any:
        """Wait for the value of the call, or raise its error.

        Raises
        ------
        UsageError
            If the process has ended.
        """
        try:
            value, error = self._pipe.recv()
        except (EOFError, ConnectionError):
            raise UsageError("a second process of this command has died: killed, or out of memory") from None
        if error is not None:
            raise error
        return value


@contextlib.contextmanager
def workers(processes: int) -> Iterator[Callable[..., Callable[[], Any]]]:
    """Start processes that share calls; leaving the context ends them at any time.

    Parameters
    ----------
    processes : int

    Yields
    ------
    callable
        ``start(function, *args)`` queues a call and returns a function that waits for its value, or raises
        UsageError if a process is no more. Function, arguments and value must pickle.
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
                raise UsageError("a process of this command has died: killed, or out of memory") from None

        return value

    try:
        yield start
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in set(multiprocessing.active_children()) - others:
            process.kill()


@contextlib.contextmanager
def _deaf() -> Iterator[None]:
    """Ignore Ctrl-C while a process starts: in a terminal it goes to all processes, and the command handles it."""
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
