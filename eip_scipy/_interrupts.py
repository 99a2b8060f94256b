"""Ctrl-C, kept where Python forgets it."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

__all__ = ["kept_ctrl_c", "look_for_ctrl_c"]


class _Kept:
    pressed = False


@contextmanager
def kept_ctrl_c() -> Iterator[None]:
    """Let `look_for_ctrl_c` know of a Ctrl-C that comes from now on.

    An exception that is raised inside a destructor is printed and dropped, KeyboardInterrupt too, and compilation makes
    and drops objects of LLVM all the time: a Ctrl-C then would do nothing. A handler of the user's own stays in place.
    """
    on_main = threading.current_thread() is threading.main_thread()
    if not on_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    _Kept.pressed = False
    signal.signal(signal.SIGINT, _note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        _Kept.pressed = False


def _note(number: int, frame: FrameType | None) -> None:
    _Kept.pressed = True
    signal.default_int_handler(number, frame)


def look_for_ctrl_c() -> None:
    """Raise what was dropped.

    Raises
    ------
    KeyboardInterrupt
        In the main thread, after a Ctrl-C since `kept_ctrl_c` that did not end its block.
    """
    if _Kept.pressed and threading.current_thread() is threading.main_thread():
        raise KeyboardInterrupt
