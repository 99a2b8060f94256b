"""Checkpoint files: a JSON header and arrays in one file that is whole or not there, and known to be undamaged.

A file is an uncompressed npz archive, which `numpy.load` opens too: ``header.json``, then an array as ``NAME.npy``
each. The comment at its end holds the SHA-256 of all its bytes, with zeros in the digest's own place. Nothing in it is
pickled, and no part is believed before the digest is checked.
"""

from __future__ import annotations

import contextlib
import errno
import glob
import hashlib
import json
import math
import os
import platform
import secrets
import sys
import time
import warnings
import zipfile
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.lib import format as npy

from ..core.versions import versions

__all__ = ["CheckpointError", "origin", "read", "require_same", "warn_of_other_versions", "write"]

FORMAT, SCHEMA = "eip_scipy checkpoint", 3
HEADER = "header.json"
MARK = b"eip_scipy checkpoint, SHA-256 "
DIGITS = 64
ZIP = b"PK\x03\x04"
BLOCK = 2**20
LEFT_OVER = 3600.0
# Numba's, where it is loaded: else no function of the run is its.
DECIDING = ("python", "eip_scipy", "numpy", "scipy", "numba")
# One date for all members: the same content gives the same bytes.
DATE = (1980, 1, 1, 0, 0, 0)


class CheckpointError(Exception):
    """A checkpoint cannot be written, is damaged, is none, or belongs to another run; the message says what to do."""


def write(path: str | os.PathLike[str], header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
    """Write a checkpoint; a file at `path` is replaced in one step, or stays as it was.

    The bytes go to a temporary file in the same folder, are brought to the disk, and take the place of `path` then. A
    process that is killed meanwhile leaves the former checkpoint, and a file ``.NAME-*.tmp`` that the first `write`
    an hour later removes.

    Parameters
    ----------
    path : path-like
    header : mapping
        What JSON holds, without NaN and infinity; ``kind`` says whose checkpoint it is. Format, schema, versions and
        machine are added.
    arrays : mapping of str to ndarray
        Numbers, real or complex.

    Raises
    ------
    CheckpointError
        When the file cannot be written, for instance because the disk is full.

    Examples
    --------
    >>> import tempfile, numpy as np
    >>> from eip_scipy import checkpoint
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     checkpoint.write(f"{folder}/a.npz", {"kind": "example"}, {"x": np.arange(3)})
    ...     header, arrays = checkpoint.read(f"{folder}/a.npz", "example")
    >>> header["kind"], arrays["x"]
    ('example', array([0, 1, 2]))
    """
    target = Path(os.path.realpath(path))
    put(target, header, arrays, lambda temporary, digest: os.replace(temporary, target))


def put(
    path: Path, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray], place: Callable[[Path, str], None]
) -> None:
    """Write a checkpoint to a file in the folder of `path`, bring it to the disk, and let `place` give it its name.

    Parameters
    ----------
    path : Path
        Links resolved.
    header, arrays
        As for `write`.
    place : callable
        ``place(temporary, digest)``: the temporary file, which is removed if it is still there afterwards, and the
        SHA-256 that it ends with.

    Raises
    ------
    CheckpointError
        When the file cannot be written.
    """
    own = {"format": FORMAT, "schema": SCHEMA, **origin()}
    text = json.dumps({**header, **own}, indent=1, allow_nan=False).encode()
    temporary = path.with_name(f".{path.name}-{secrets.token_hex(4)}.tmp")
    try:
        try:
            with open(temporary, "xb") as stream:
                digest = _fill(stream, text, arrays)
                stream.flush()
                os.fsync(stream.fileno())
            place(temporary, digest)
        finally:
            temporary.unlink(missing_ok=True)
        _sync_folder(path.parent)
        _remove_leftovers(path)
    except OSError as error:
        raise CheckpointError(f"cannot write the checkpoint {_name(path)}: {_reason(error)}") from error


def read(path: str | os.PathLike[str], kind: str | None = None) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read a checkpoint that `write` has written.

    Parameters
    ----------
    path : path-like
    kind : str, optional
        The ``kind`` that its header must have.

    Returns
    -------
    header : dict
    arrays : dict of str to ndarray

    Raises
    ------
    CheckpointError
        For a file that cannot be read, is no checkpoint, is damaged or truncated, or has another schema or kind.
    """
    header, arrays, _, _ = read_known(path, kind)
    return header, arrays


def read_known(
    path: str | os.PathLike[str], kind: str | None
) -> tuple[dict[str, Any], dict[str, np.ndarray], os.stat_result, str]:
    """As `read`, with what the file is known by: its status, and the SHA-256 that it ends with."""
    try:
        with open(path, "rb") as stream:
            status = os.fstat(stream.fileno())
            size, digest = _require_undamaged(path, stream)
            header, arrays = _parse(stream, size)
    except OSError as error:
        raise CheckpointError(f"cannot read the checkpoint {_name(path)}: {_reason(error)}") from error
    except (CheckpointError, MemoryError):
        raise
    except Exception as error:  # whatever zipfile, json and numpy say to bytes that `write` has not made
        raise CheckpointError(f"{_name(path)} is no checkpoint of eip_scipy: {error}") from error
    if header["schema"] != SCHEMA:
        raise CheckpointError(
            f"{_name(path)} has schema {header['schema']!r}, expected {SCHEMA}; "
            "resume with the version of eip_scipy that wrote it."
        )
    if kind is not None and header.get("kind") != kind:
        raise CheckpointError(f"{_name(path)} is a checkpoint of {header.get('kind')!r}, expected {kind!r}.")
    return header, arrays, status, digest


def digest_of(path: str | os.PathLike[str]) -> str:
    """The SHA-256 that an undamaged checkpoint ends with.

    Raises
    ------
    CheckpointError
        For another file.
    OSError
        When it cannot be read.
    """
    with open(path, "rb") as stream:
        return _require_undamaged(path, stream)[1]


def require_same(path: str | os.PathLike[str], there: Any, here: Mapping[str, Any]) -> None:
    """Compare the settings in a header with those of the run that wants to resume.

    Raises
    ------
    CheckpointError
        Naming each setting that differs, with both values where they are short.
    """
    here = json.loads(json.dumps(here))
    there = there if isinstance(there, dict) else {}
    names = [name for name in (*here, *(there.keys() - here.keys())) if here.get(name) != there.get(name)]
    if not names:
        return
    what = "; ".join(_difference(name, there.get(name), here.get(name)) for name in names)
    raise CheckpointError(
        f"the checkpoint {_name(path)} belongs to another run: {what}. Resume with the arguments of that run, or name "
        "another file to start anew."
    )


def warn_of_other_versions(path: str | os.PathLike[str], header: Mapping[str, Any], *, stacklevel: int) -> None:
    """Warn where a checkpoint comes from other versions or another kind of machine: the last bits may differ then."""
    there, here = ({**(header.get("versions") or {}), "machine": header.get("machine")}, _here())
    other = [
        f"{name} {there.get(name)}, here {here[name]}"
        for name in here
        if there.get(name) != here[name] and (name in there or name != "numba")
    ]
    if other:
        warnings.warn(
            f"the checkpoint {_name(path)} was written with {'; '.join(other)}: the last bits may differ from those of "
            "a run that was not interrupted.",
            UserWarning,
            stacklevel=stacklevel + 1,
        )


def _difference(name: str, there: Any, here: Any) -> str:
    values = [json.dumps(value) for value in (there, here)]
    if sum(map(len, values)) > 120:
        return f"{name} differs"
    return f"{name} is {values[0]} there and {values[1]} here"


def _name(path: str | os.PathLike[str]) -> str:
    return repr(os.fspath(path))


def _reason(error: OSError) -> str:
    return (error.strerror or str(error)).lower()


@cache
def _versions() -> dict[str, str | None]:
    found = versions()
    return {name: found[name] for name in DECIDING}


def _machine() -> str:
    return f"{platform.system()} {platform.machine()}"


def origin() -> dict[str, Any]:
    """Versions and machine, as the header of every checkpoint has them."""
    decide = {name: version for name, version in _versions().items() if name != "numba" or name in sys.modules}
    return {"versions": decide, "machine": _machine()}


def _here() -> dict[str, str | None]:
    return {**_versions(), "machine": _machine()}


class _Hashed:
    """A stream to write to only, whose bytes are hashed on their way."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream, self.digest = stream, hashlib.sha256()

    def write(self, data: Any) -> int:
        self.digest.update(data)
        return self._stream.write(data)

    def flush(self) -> None:
        self._stream.flush()


def _fill(stream: BinaryIO, text: bytes, arrays: Mapping[str, np.ndarray]) -> str:
    """Write header, arrays and digest; returns the digest."""
    hashed: Any = _Hashed(stream)
    with zipfile.ZipFile(hashed, "w") as archive:
        archive.comment = MARK + b"0" * DIGITS
        archive.writestr(zipfile.ZipInfo(HEADER, DATE), text)
        for name, value in arrays.items():
            with archive.open(zipfile.ZipInfo(f"{name}.npy", DATE), "w", force_zip64=True) as member:
                npy.write_array(member, np.asarray(value, order="C"), version=(1, 0), allow_pickle=False)
    digest: str = hashed.digest.hexdigest()
    stream.seek(-DIGITS, os.SEEK_END)
    stream.write(digest.encode())
    return digest


def _sync_folder(folder: Path) -> None:
    """Bring the new name to the disk, where folders can be opened for it and the file system knows how."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(descriptor)


def _remove_leftovers(target: Path) -> None:
    """Remove the temporary files of processes that were killed: those that nobody has written to for an hour."""
    for leftover in target.parent.glob(f".{glob.escape(target.name)}-*.tmp"):
        with contextlib.suppress(OSError):  # another process may be as tidy; the checkpoint is written in any case
            if time.time() - leftover.stat().st_mtime > LEFT_OVER:
                leftover.unlink()


def _require_undamaged(path: str | os.PathLike[str], stream: BinaryIO) -> tuple[int, str]:
    """Check mark and digest; returns the size of the file and the digest."""
    start = stream.read(4)
    size = stream.seek(0, os.SEEK_END)
    if start != ZIP:
        raise CheckpointError(f"{_name(path)} is no file of eip_scipy; name another one.")
    tail = len(MARK) + DIGITS
    stream.seek(max(0, size - tail))
    end = stream.read(tail)
    if not end.startswith(MARK):
        raise CheckpointError(
            f"{_name(path)} is truncated or no checkpoint of eip_scipy: it does not end with a digest."
        )
    digest = hashlib.sha256()
    stream.seek(0)
    left = size - DIGITS
    while left > 0 and (block := stream.read(min(BLOCK, left))):
        digest.update(block)
        left -= len(block)
    digest.update(b"0" * DIGITS)
    if digest.hexdigest().encode() != end[-DIGITS:]:
        raise CheckpointError(
            f"{_name(path)} is damaged: its SHA-256 is not the one it was written with. Go back to a copy, or delete "
            "it and start anew."
        )
    return size, digest.hexdigest()


def _parse(stream: BinaryIO, size: int) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays of a file of `size` bytes; what members declare is compared with it before it is allocated."""
    with zipfile.ZipFile(stream) as archive:
        members = archive.infolist()
        if any(m.compress_type != zipfile.ZIP_STORED or m.file_size != m.compress_size for m in members):
            raise ValueError("it holds compressed members")
        if sum(m.file_size for m in members) > size:
            raise ValueError("its members claim more bytes than it has")
        names = [m.filename for m in members]
        if not names or names[0] != HEADER or len(set(names)) != len(names):
            raise ValueError(f"its members are {names[:10]}")
        header = json.loads(archive.read(HEADER))
        if not isinstance(header, dict) or header.get("format") != FORMAT or "schema" not in header:
            raise ValueError("its header is another")
        return header, {m.filename.removesuffix(".npy"): _array(archive, m) for m in members[1:]}


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    with archive.open(member) as stream:
        if npy.read_magic(stream) != (1, 0):
            raise ValueError(f"{member.filename} has another format")
        shape, fortran, dtype = npy.read_array_header_1_0(stream)
        if dtype.kind not in "biufc" or fortran or any(k < 0 for k in shape):
            raise ValueError(f"{member.filename} holds {dtype} of shape {shape}")
        n_bytes = math.prod(shape) * dtype.itemsize
        if n_bytes != member.file_size - stream.tell():
            raise ValueError(f"{member.filename} declares {n_bytes} bytes and has {member.file_size - stream.tell()}")
        out = np.empty(shape, dtype)
        flat = out.reshape(-1).view(np.uint8)
        for begin in range(0, n_bytes, BLOCK):
            part = flat[begin : begin + BLOCK]
            part[:] = np.frombuffer(stream.read(part.size), np.uint8, part.size)
        return out
