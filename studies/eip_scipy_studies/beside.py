"""Other processes for what may go on next to a command's own work: one that is asked, or as many as there are cores."""

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
    """A process that does one call after the other; leaving the context ends it, whatever it does.

    It is started anew, not forked: a fork copies locks that other threads hold. Until it has imported what the calls
    need, a second or so passes.
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
        """Let it do `call`, which must pickle, and whose result must; that of the call before has been asked for."""
        with contextlib.suppress(BrokenPipeError):  # `result` tells of it
            self._pipe.send(call)

    def result(self) -> Any:
        """Wait for what the call returns, or raise what it raised.

        Raises
        ------
        UsageError
            When the process is no more.
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
    """Start processes that share calls; leaving the context ends them, whatever they do.

    Parameters
    ----------
    processes : int

    Yields
    ------
    callable
        ``start(function, *args)`` puts a call in line and returns a function that waits for its value, or raises
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
    """Ctrl-C in a terminal goes to all processes; one that starts now leaves it to this one."""
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
