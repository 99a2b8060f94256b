"""A lock on a place that one run at a time writes to, which ends with the process that holds it."""

from __future__ import annotations

import contextlib
import errno
import os
import platform
import sys
import warnings
from pathlib import Path

from filelock import FileLock, Timeout

from ..core.callers import users_level
from . import CheckpointError, reason

__all__ = ["Lock", "absolute"]

NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EINVAL}
NO_RIGHT = {errno.EACCES, errno.EPERM, errno.EROFS}


class Lock:
    """Exclusive right to write to a file or folder, from its making to `close` or to the end of this process.

    The lock is on a file of its own next to the place, because a checkpoint is replaced by another file at each
    writing. That file says who holds it, and `close` removes it. Processes that are started or forked do not inherit
    the lock. A file system without locks is a RuntimeWarning; without the right to write there is nothing to lock.

    Parameters
    ----------
    place : path-like
        It need not exist.

    Attributes
    ----------
    name : str
        Its absolute path, whatever becomes of the working directory.
    path : Path
        The same, with links resolved.

    Raises
    ------
    CheckpointError
        At once if another run holds the lock, in this process or another; or if the file for it cannot be made.
    """

    def __init__(self, place: str | os.PathLike[str]) -> None:
        self.name = absolute(place)
        self.path = Path(os.path.realpath(self.name))
        self._file = self.path.with_name(f".{self.path.name}.eip_scipy-lock")
        self._lock = FileLock(
            self._file, blocking=False, thread_local=False, fallback_to_soft=False, on_acquired=_write_holder
        )
        try:
            os.stat(self.path.parent)  # which filelock would make
            self._lock.acquire()
        except Timeout:
            raise CheckpointError(
                f"{self.name!r} is in use by another run, of {_holder(self._file)}. Wait for its end, or end it, or "
                "name another place."
            ) from None
        except OSError as error:
            if error.errno in NO_LOCKS:
                self._file.unlink(missing_ok=True)
                warnings.warn(
                    f"{self.name!r} could not be locked ({reason(error)}): see to it yourself that no other run "
                    "writes there at the same time.",
                    RuntimeWarning,
                    stacklevel=users_level(),
                )
            elif error.errno not in NO_RIGHT or os.path.lexists(self._file):
                raise CheckpointError(f"cannot write {self.name!r}: {reason(error)}") from error

    def close(self) -> None:
        """Let others in; a second call does nothing."""
        if self._lock.is_locked:
            if sys.platform != "win32":  # where filelock removes the file
                with contextlib.suppress(OSError):  # in a folder that is gone, or can no longer be written to
                    self._file.unlink()  # before others can lock it
            self._lock.release()


def absolute(path: str | os.PathLike[str]) -> str:
    """Return the absolute path that `path` leads to now.

    Raises
    ------
    CheckpointError
        When the working directory is gone.
    """
    try:
        return os.path.abspath(os.fsdecode(path))
    except FileNotFoundError as error:
        raise CheckpointError(
            f"{os.fspath(path)!r} is relative to a folder that is gone; give a whole path."
        ) from error


def _myself() -> str:
    return f"process {os.getpid()} on {platform.node()}"


def _write_holder(descriptor: int) -> None:
    with contextlib.suppress(OSError):  # on a full disk the holder's name is missing, not the lock
        os.ftruncate(descriptor, 0)
        os.write(descriptor, _myself().encode())


def _holder(file: Path) -> str:
    """Return the process that holds the lock, as it has written it down."""
    try:
        found = file.read_text(errors="replace")
    except OSError:  # Windows lets nobody read it, and the holder may just have removed it
        found = ""
    return f"{found}, this one" if found == _myself() else found or "another process"
