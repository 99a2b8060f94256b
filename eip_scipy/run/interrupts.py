"""Handling of Ctrl-C, which Python may drop, and of SIGTERM, which waits for the checkpoint."""

from __future__ import annotations

import _signal  # type: ignore[import-not-found]  # signal without conversions to enumerations, which are slow
import _thread
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

__all__ = ["TerminatedError", "ended_by_sigterm", "kept_ctrl_c", "look_for_signals"]


class TerminatedError(KeyboardInterrupt):
    """Exception raised by SIGTERM in a run with a checkpoint, which is then written, as after Ctrl-C."""


# A Ctrl-C that Python would drop is repeated after this number of seconds.
AGAIN = 0.02


class _Came:
    ctrl_c = False
    sigterm = False
    put_off: object = None


class kept_ctrl_c:  # noqa: N801, faster than one made from a generator
    """Make `look_for_signals` raise KeyboardInterrupt after a Ctrl-C that Python would drop.

    Python prints and drops exceptions raised inside a destructor or a callback from C, including KeyboardInterrupt.
    Compilation creates and destroys LLVM objects all the time, so a Ctrl-C could do nothing. A Ctrl-C in a
    destructor or a callback is postponed until Python has left it. A user-defined handler stays in place.
    """

    def __enter__(self) -> None:
        self._is_ours = _is_ours(signal.SIGINT, signal.default_int_handler)
        if self._is_ours:
            _Came.ctrl_c = False
            _signal.signal(signal.SIGINT, _note_ctrl_c)

    def __exit__(self, *error: object) -> None:
        if self._is_ours:
            _Came.put_off = None
            _signal.signal(signal.SIGINT, signal.default_int_handler)
            _Came.ctrl_c = False


@contextmanager
def ended_by_sigterm() -> Iterator[None]:
    """Let SIGTERM end the block by an exception, and then the process, as its sender expects.

    The notes of this exception are printed to the standard error stream. All of this applies only in the main thread
    and without a user-defined handler, where SIGTERM would end the process at once. A second SIGTERM is ignored.
    """
    if not _is_ours(signal.SIGTERM, signal.SIG_DFL):
        yield
        return
    signal.signal(signal.SIGTERM, _note_sigterm)
    try:
        yield
    except BaseException as error:
        if _Came.sigterm:
            print("SIGTERM", *getattr(error, "__notes__", ()), sep="\n", file=sys.stderr, flush=True)
        raise
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        if _Came.sigterm:
            sys.stdout.flush()  # the signal does not flush it
            signal.raise_signal(signal.SIGTERM)


def look_for_signals() -> None:
    """Raise, in the main thread, the exception of a signal that did not end `kept_ctrl_c` or `ended_by_sigterm`."""
    if not (_Came.ctrl_c or _Came.sigterm) or threading.current_thread() is not threading.main_thread():
        return
    _Came.put_off = None
    raise TerminatedError if _Came.sigterm else KeyboardInterrupt


def _is_ours(number: int, usual: object) -> bool:
    """Return True if signal `number` may be handled here: in the main thread, and if its handler is the `usual` one."""
    return threading.current_thread() is threading.main_thread() and _signal.getsignal(number) == usual


def _note_ctrl_c(number: int, frame: FrameType | None) -> None:
    _Came.ctrl_c = True
    if _would_be_dropped(frame):
        _Came.put_off = this = object()
        _thread.start_new_thread(_press_again, (this,))  # threading.Thread would take locks
    else:
        signal.default_int_handler(number, frame)


def _would_be_dropped(frame: FrameType | None) -> bool:
    """Return True if Python would drop an exception in `frame`: in a destructor, or in LLVM, which uses callbacks."""
    while frame is not None:
        if frame.f_code.co_name == "__del__" or frame.f_globals.get("__name__", "").startswith("llvmlite."):
            return True
        frame = frame.f_back
    return False


def _press_again(this: object) -> None:
    time.sleep(AGAIN)
    if _Came.put_off is this:
        _thread.interrupt_main()


def _note_sigterm(number: int, frame: FrameType | None) -> None:
    if not _Came.sigterm:
        _Came.sigterm = True
        raise TerminatedError
