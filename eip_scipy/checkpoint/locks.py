"""Exclusive use of a file by one run at a time, until its process ends, and SIGTERM, by which batch systems end it."""

from __future__ import annotations

import contextlib
import errno
import os
import platform
import signal
import sys
import threading
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from ..core.callers import users_level
from . import CheckpointError, read, reason

__all__ = ["absolute", "held", "sigterm_as_ctrl_c"]

NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EINVAL}
NO_RIGHT = {errno.EACCES, errno.EPERM, errno.EROFS}


@contextlib.contextmanager
def held(
    path: str | os.PathLike[str], kind: str, what: str, resume: bool
) -> Iterator[tuple[str, tuple[dict[str, Any], dict[str, Any]] | None]]:
    """Lock the checkpoint of a run or ensemble (`what`); yield its absolute path, and the content of an existing file.

    The lock is held on a separate file next to it, because a checkpoint is replaced by another file each time it is
    written. It contains the name of the process that holds it, and is removed at the end of the block. Processes that
    are started or forked do not inherit the lock, which ends with the process. In the block SIGTERM raises
    KeyboardInterrupt.

    CheckpointError is raised if the file exists and `resume` is False, if its header does not have the `kind`, or if
    another run holds the lock, in this process or another. A file system without locks causes a RuntimeWarning. If the
    user has no right to create the lock file, nothing is locked.
    """
    name = absolute(path)
    target = Path(os.path.realpath(name))
    file = target.with_name(f".{target.name}.eip_scipy-lock")
    lock = FileLock(file, blocking=False, thread_local=False, fallback_to_soft=False, on_acquired=_write_holder)
    with sigterm_as_ctrl_c():
        _acquire(lock, file, name)
        try:
            exists = os.path.exists(name)
            if exists and not resume:
                raise CheckpointError(
                    f"{name!r} exists. Pass resume=True to continue the {what} that it holds; for a new {what}, use "
                    "another place or delete this one."
                )
            yield name, read(name, kind) if exists else None
        finally:
            if lock.is_locked:
                if sys.platform != "win32":  # filelock removes the file on Windows
                    with contextlib.suppress(OSError):  # the folder may be gone, or no longer writable
                        file.unlink()  # before others can lock it
                lock.release()


def _acquire(lock: Any, file: Path, name: str) -> None:
    """Acquire the lock on a file for the checkpoint at `name`, if that is possible."""
    try:
        os.stat(file.parent)  # filelock would create a missing folder
        lock.acquire()
    except Timeout:
        raise CheckpointError(
            f"{name!r} is in use by another run ({_holder(file)}). Wait until that run ends, stop it, or use another "
            "path."
        ) from None
    except OSError as error:
        if error.errno in NO_LOCKS:
            file.unlink(missing_ok=True)
            warnings.warn(
                f"{name!r} could not be locked ({reason(error)}). Make sure that no other run writes there at the same "
                "time.",
                RuntimeWarning,
                stacklevel=users_level(),
            )
        elif error.errno not in NO_RIGHT or os.path.lexists(file):
            raise CheckpointError(f"cannot write {name!r}: {reason(error)}") from error


def absolute(path: str | os.PathLike[str]) -> str:
    """Return `path` as an absolute path; raise CheckpointError if it is relative to a folder that no longer exists."""
    try:
        return os.path.abspath(os.fsdecode(path))
    except FileNotFoundError as error:
        raise CheckpointError(
            f"{os.fspath(path)!r} is relative to a folder that no longer exists; give an absolute path."
        ) from error


def _myself() -> bytes:
    return f"process {os.getpid()} on {platform.node()}".encode()


def _write_holder(descriptor: int) -> None:
    with contextlib.suppress(OSError):  # on a full disk the holder's name is missing, not the lock
        os.ftruncate(descriptor, 0)
        os.write(descriptor, _myself())


def _holder(file: Path) -> str:
    """Return the name of the process that holds the lock, read from its file; "another process" if that fails."""
    try:
        found = file.read_bytes()
    except OSError:  # Windows does not allow reading it, and the holder may just have removed it
        found = b""
    return found.decode(errors="replace") + ", this one" * (found == _myself()) or "another process"


@contextlib.contextmanager
def sigterm_as_ctrl_c() -> Iterator[None]:
    """Let SIGTERM raise KeyboardInterrupt in the block, so that the checkpoint is written; not outside the main thread.

    A handler that the user has installed stays in place.
    """
    in_main_thread = threading.current_thread() is threading.main_thread()
    if not in_main_thread or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
