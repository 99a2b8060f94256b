"""A second process for what may go on beside a command's own work: one call at a time."""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
import threading
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from typing import Any

from .report import UsageError

__all__ = ["Beside"]


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
