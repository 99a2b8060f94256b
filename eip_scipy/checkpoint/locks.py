"""A lock on a file or folder to which only one run at a time may write; it ends with the process that holds it."""

from __future__ import annotations

import contextlib
import errno
import os
import platform
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from ..core.callers import users_level
from ..core.inputs import flag, is_number, shown
from . import CheckpointError, existing, read, reason
from .signals import sigterm_as_ctrl_c

__all__ = ["Lock", "held", "require_place"]

NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EINVAL}
NO_RIGHT = {errno.EACCES, errno.EPERM, errno.EROFS}


class Lock:
    """Exclusive right to write to a file or folder, until `close` or the end of the process.

    The lock is held on a separate file next to the place, because a checkpoint is replaced by another file each time it
    is written. The lock file contains the name of the process that holds the lock, and `close` removes it. Processes
    that are started or forked do not inherit the lock. A file system without locks causes a RuntimeWarning. If the user
    has no right to create the lock file, nothing is locked. CheckpointError is raised if another run holds the lock, in
    this process or another, or the file cannot be opened or created for another reason than missing rights.

    `place`, the file or folder, need not exist; `name` is its absolute path, and `path` that with links resolved.
    """

    def __init__(self, place: str | os.PathLike[str]) -> None:
        self.name = absolute(place)
        self.path = Path(os.path.realpath(self.name))
        self._file = self.path.with_name(f".{self.path.name}.eip_scipy-lock")
        self._lock = FileLock(
            self._file, blocking=False, thread_local=False, fallback_to_soft=False, on_acquired=_write_holder
        )
        try:
            os.stat(self.path.parent)  # filelock would create a missing folder
            self._lock.acquire()
        except Timeout:
            raise CheckpointError(
                f"{self.name!r} is in use by another run ({_holder(self._file)}). Wait until that run ends, stop it, "
                "or use another path."
            ) from None
        except OSError as error:
            if error.errno in NO_LOCKS:
                self._file.unlink(missing_ok=True)
                warnings.warn(
                    f"{self.name!r} could not be locked ({reason(error)}). Make sure that no other run writes there at "
                    "the same time.",
                    RuntimeWarning,
                    stacklevel=users_level(),
                )
            elif error.errno not in NO_RIGHT or os.path.lexists(self._file):
                raise CheckpointError(f"cannot write {self.name!r}: {reason(error)}") from error

    def close(self) -> None:
        """Release the lock; a second call does nothing."""
        if self._lock.is_locked:
            if sys.platform != "win32":  # filelock removes the file on Windows
                with contextlib.suppress(OSError):  # the folder may be gone, or no longer writable
                    self._file.unlink()  # before others can lock it
            self._lock.release()


def require_place(path: Any, every: Any, resume: Any, expected: str) -> None:
    """Check the options ``checkpoint``, ``checkpoint_every`` and ``resume``; the message names the `expected` path."""
    flag("resume", resume)
    if not is_number(every, "checkpoint_every") or not every > 0:
        raise ValueError(f"checkpoint_every must be a number of seconds > 0, got {shown(every)}.")
    if path is None and resume:
        raise ValueError("resume=True needs a file to resume from: pass checkpoint=path.")
    if path is not None and not isinstance(path, (str, os.PathLike)):
        raise TypeError(f"checkpoint must be {expected}, got {path!r}.")


@contextmanager
def held(
    path: str | os.PathLike[str], kind: str, what: str, resume: bool
) -> Iterator[tuple[str, tuple[dict[str, Any], dict[str, Any]] | None]]:
    """Lock the checkpoint of a run or ensemble (`what`); yield its absolute path, and the content of an existing file.

    The header must have the `kind`. CheckpointError is raised if the file exists and `resume` is False.
    """
    with sigterm_as_ctrl_c(), contextlib.closing(Lock(path)) as lock:
        found = None
        if os.path.lexists(lock.path):
            if not resume:
                raise existing(lock.name, what)
            found = read(lock.name, kind)
        yield lock.name, found


def absolute(path: str | os.PathLike[str]) -> str:
    """Return `path` as an absolute path; raise CheckpointError if it is relative to a folder that no longer exists."""
    try:
        return os.path.abspath(os.fsdecode(path))
    except FileNotFoundError as error:
        raise CheckpointError(
            f"{os.fspath(path)!r} is relative to a folder that no longer exists; give an absolute path."
        ) from error


def _myself() -> str:
    return f"process {os.getpid()} on {platform.node()}"


def _write_holder(descriptor: int) -> None:
    with contextlib.suppress(OSError):  # on a full disk the holder's name is missing, not the lock
        os.ftruncate(descriptor, 0)
        os.write(descriptor, _myself().encode())


def _holder(file: Path) -> str:
    """Return the name of the process that holds the lock, read from its file; "another process" if that fails."""
    try:
        found = file.read_text(errors="replace")
    except OSError:  # Windows does not allow reading it, and the holder may just have removed it
        found = ""
    return f"{found}, this one" if found == _myself() else found or "another process"
