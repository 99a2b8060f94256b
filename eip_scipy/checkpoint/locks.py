"""A lock on a path, by which one run at a time writes there, and which ends with the process that holds it."""

from __future__ import annotations

import contextlib
import errno
import os
import platform
import sys
from pathlib import Path

from . import CheckpointError

__all__ = ["HeldError", "Lock"]

NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EINVAL}
NO_RIGHT = {errno.EACCES, errno.EPERM, errno.EROFS}
# No links: the name may be planted in a folder that others write to.
OPENED = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)
READ_ONLY = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0)
WHO = 200

if sys.platform == "win32":
    import msvcrt

    HELD = {errno.EACCES, errno.EDEADLK}

    def _take(descriptor: int) -> None:
        # What is locked cannot be read by others: a byte that is not there.
        os.lseek(descriptor, 2**30, os.SEEK_SET)
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)

else:
    import fcntl

    HELD = {errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES}

    def _take(descriptor: int) -> None:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


class HeldError(CheckpointError):
    """Somebody else holds the lock."""


class Lock:
    """Held from its making to `release`, or to the end of this process.

    The lock is on a file of its own beside `path`, for a checkpoint is replaced by another file at each writing. That
    file holds who took it, and is removed at the release, by its holder only; whoever has opened it meanwhile finds
    that it is no longer the one of that name, and opens the new one. Processes that are started or forked do not
    inherit the lock.

    Parameters
    ----------
    path : Path
        Of the file or folder, links resolved; it need not exist.
    name : str
        What messages call it.

    Attributes
    ----------
    problem : str
        Why the file system knows no locks; empty where there is one, and where nothing can be written anyway.

    Raises
    ------
    HeldError
        At once, with process and machine of the holder.
    CheckpointError
        When the file beside `path` cannot be made.
    """

    def __init__(self, path: Path, name: str) -> None:
        self.problem = ""
        self._file, self._name = path.with_name(f".{path.name}.eip_scipy-lock"), name
        self._descriptor: int | None = None
        while self._try():
            pass
        if self._descriptor is not None:
            _held.add(self)

    def release(self) -> None:
        """Let others in; a second call does nothing."""
        _held.discard(self)
        if self._descriptor is None:
            return
        # Windows removes only what is closed.
        if sys.platform != "win32":
            self._remove()
        self.forget()
        if sys.platform == "win32":
            self._remove()

    def forget(self) -> None:
        """Close the file: with its last descriptor the lock goes."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None

    def _try(self) -> bool:
        """Open the file and lock it; whether to try again."""
        descriptor = self._opened()
        if descriptor is None:
            return False
        try:
            try:
                _take(descriptor)
            except OSError as error:
                if error.errno in HELD:
                    raise HeldError(self._held_by(os.read(descriptor, WHO).decode(errors="replace"))) from None
                if error.errno not in NO_LOCKS:
                    raise self._cannot(error) from error
                self.problem = _reason(error)
                self._remove()
            else:
                if not self._is_current(descriptor):
                    return True
                with contextlib.suppress(OSError):  # on a full disk the holder's name is missing, not the lock
                    os.lseek(descriptor, 0, os.SEEK_SET)
                    os.ftruncate(descriptor, 0)
                    os.write(descriptor, _myself().encode())
                self._descriptor = descriptor
        finally:
            if self._descriptor is None:
                os.close(descriptor)
        return False

    def _opened(self) -> int | None:
        """A descriptor; None in a folder that this user cannot write to, where nobody has left a file to lock."""
        try:
            return os.open(self._file, OPENED, 0o666)
        except OSError as error:
            if error.errno not in NO_RIGHT:
                raise self._cannot(error) from error
        try:
            return os.open(self._file, READ_ONLY)
        except OSError:
            return None

    def _is_current(self, descriptor: int) -> bool:
        try:
            return os.path.samestat(os.fstat(descriptor), os.stat(self._file))
        except FileNotFoundError:
            return False

    def _remove(self) -> None:
        if self._descriptor is None or self._is_current(self._descriptor):
            with contextlib.suppress(OSError):  # in use by another on Windows, or of a folder that is gone
                self._file.unlink()

    def _held_by(self, holder: str) -> str:
        who = holder or "another process"
        own = ", this one" if holder == _myself() else ""
        return (
            f"{self._name!r} is in use by another run, of {who}{own}. Wait for its end, or end it, or name another "
            "place."
        )

    def _cannot(self, error: OSError) -> CheckpointError:
        return CheckpointError(f"cannot write {self._name!r}: {_reason(error)}")


_held: set[Lock] = set()


def _reason(error: OSError) -> str:
    return (error.strerror or str(error)).lower()


def _myself() -> str:
    return f"process {os.getpid()} on {platform.node()}"


def _forget_all() -> None:
    for lock in _held:
        lock.forget()
    _held.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_all)
