"""The checkpoint file of one run: locked while it runs, and never replaced by it where it has become another's."""

from __future__ import annotations

import os
from collections.abc import Mapping
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np

from .. import checkpoint
from . import CheckpointError
from .locks import HeldError, Lock

__all__ = ["OwnFile", "absolute", "unlocked"]


class _Mark(NamedTuple):
    """What a file is known by that this run has read or written."""

    inode: int
    time: int
    size: int
    digest: str

    @classmethod
    def of(cls, status: os.stat_result, digest: str) -> _Mark:
        return cls(status.st_ino, status.st_mtime_ns, status.st_size, digest)


class OwnFile:
    """A file that only this run writes to, from here to the end of the block.

    Parameters
    ----------
    path : path-like
        Where it lies is settled now, whatever becomes of the working directory.

    Attributes
    ----------
    name : str
        Its absolute path.
    moved : str
        What there is to say where the run had to go to another name; else empty.
    problem : str
        Why it could not be locked; else empty.

    Raises
    ------
    CheckpointError
        When another run holds it, of this process or of another.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.name, self.moved = absolute(path), ""
        self._path = Path(os.path.realpath(self.name))
        self._lock = Lock(self._path, self.name)
        self.problem = self._lock.problem
        self._mine: list[_Mark] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Let other runs in."""
        self._lock.release()

    def exists(self) -> bool:
        """Whether anything is there."""
        return os.path.lexists(self._path)

    def existing(self, what: str) -> CheckpointError:
        """The error for a file that is there and not to be resumed."""
        return CheckpointError(
            f"{self.name!r} exists. resume=True goes on with the {what} that it holds; to start anew, name another "
            "file or delete this one."
        )

    def read(self, kind: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """As `checkpoint.read`; what was read may be replaced."""
        header, arrays, status, digest = checkpoint.read_known(self.name, kind)
        self._mine = [_Mark.of(status, digest)]
        return header, arrays

    def write(self, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
        """As `checkpoint.write`, but nothing is replaced that this run has not read or written.

        Where something else has come to be there, the checkpoint gets a name beside it, and keeps it: `moved` says so.

        Raises
        ------
        CheckpointError
            When the file cannot be written, or something is there before the first one.
        """
        checkpoint.put(self._path, header, arrays, self._place)

    def _place(self, temporary: Path, digest: str) -> None:
        mark = _Mark.of(os.stat(temporary), digest)
        first = not self._mine
        # Before anything is moved: an exception may come right after that.
        self._mine.append(mark)
        if first or not self.exists():
            try:
                _create(temporary, self._path)
            except FileExistsError:
                if first:
                    raise self.existing("run") from None
                self._step_aside(temporary)
        elif self._is_mine():
            os.replace(temporary, self._path)
        else:
            self._step_aside(temporary)
        self._mine = [mark]

    def _is_mine(self) -> bool:
        """By number, time and size, else by content: file systems may renumber, and users touch."""
        try:
            status = os.stat(self._path)
            if any(mark == _Mark.of(status, mark.digest) for mark in self._mine):
                return True
            return checkpoint.digest_of(self._path) in {mark.digest for mark in self._mine}
        except (OSError, CheckpointError):
            return False

    def _step_aside(self, temporary: Path) -> None:
        """Take a name beside the file that has become another's."""
        for k in count(1):
            path = self._path.with_name(f"{self._path.stem}-{k}{self._path.suffix}")
            try:
                lock = Lock(path, str(path))
            except HeldError:
                continue
            try:
                _create(temporary, path)
            except FileExistsError:
                lock.release()
                continue
            except BaseException:
                lock.release()
                raise
            break
        self._lock.release()
        self.moved = (
            f"{self.name!r} is no longer the file that this run wrote, and stays as it is; its checkpoint is "
            f"{str(path)!r} now"
        )
        self.name, self._path, self._lock = str(path), path, lock


def absolute(path: str | os.PathLike[str]) -> str:
    """Where a path leads to now.

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


def unlocked(name: str, problem: str) -> str:
    """The warning for a place that could not be locked."""
    return (
        f"{name!r} could not be locked ({problem}): see to it yourself that no other run writes there at the same time."
    )


def _create(temporary: Path, path: Path) -> None:
    """Give a file its name where nothing has it.

    Raises
    ------
    FileExistsError
    """
    try:
        os.link(temporary, path)
    except FileExistsError:
        raise
    except OSError:  # no hard links here: the name is taken first
        os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL))
        try:
            os.replace(temporary, path)
        except BaseException:
            os.unlink(path)
            raise
