"""Checkpoint files: a JSON header and arrays in one npz archive, which is written completely or not at all.

`numpy.load` can open such a file: it contains ``header.json`` and each array as ``NAME.npy``, uncompressed. The archive
has a checksum (CRC-32) of each member, which is compared on reading. Nothing is pickled.
"""

from __future__ import annotations

import contextlib
import errno
import glob
import io
import json
import math
import os
import platform
import secrets
import signal
import sys
import threading
import time
import warnings
import zipfile
from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from filelock import FileLock, Timeout
from numpy.lib import format as npy

from .core.callers import users_level
from .core.inputs import flag, is_number, shown
from .core.results import Diagnostics, Multipliers
from .core.versions import VERSION, installed
from .engine.trust import Trust

__all__ = ["CheckpointError", "read", "require_same", "warn_of_other_versions", "write"]

FORMAT, SCHEMA = "eip_scipy checkpoint", 1
HEADER = "header.json"
LEFT_OVER = 3600.0
SAME = 1e-9  # relative difference allowed between values of the same function
NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EINVAL}
NO_RIGHT = {errno.EACCES, errno.EPERM, errno.EROFS}


class CheckpointError(Exception):
    """Error for a checkpoint that cannot be written or read, is damaged, or belongs to another run.

    See Also
    --------
    read, write
    """


def write(path: str | os.PathLike[str], header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
    """Write a checkpoint; an existing file at `path` is replaced in one step, or stays unchanged.

    The bytes are written to a temporary file in the same folder, which is flushed to the disk and then replaces `path`.
    If the process is killed meanwhile, the previous checkpoint remains, next to the temporary file ``.NAME-*.tmp``. Any
    `write` to the same path more than an hour later removes that file.

    Parameters
    ----------
    path : path-like
        File to write.
    header : mapping
        Values that JSON can hold, without NaN and infinity; ``kind`` names the kind of checkpoint. Format, schema,
        names of the arrays, versions and machine are added.
    arrays : mapping of str to ndarray
        Real or complex numbers.

    Raises
    ------
    CheckpointError
        If the file cannot be written, for instance because the disk is full.

    See Also
    --------
    read, eip_scipy.results.save

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
    # The version of Numba only if it is loaded: otherwise it has compiled no function of the run.
    versions = {name: version for name, version in _versions().items() if name != "numba" or name in sys.modules}
    own = {"format": FORMAT, "schema": SCHEMA, "arrays": list(arrays), "versions": versions, "machine": _machine()}
    text = json.dumps({**header, **own}, indent=1, allow_nan=False).encode()
    temporary = target.with_name(f".{target.name}-{secrets.token_hex(4)}.tmp")
    try:
        try:
            with open(temporary, "xb") as stream:
                with zipfile.ZipFile(stream, "w") as archive:
                    # A ZipInfo has a fixed date, so that equal contents give equal files.
                    archive.writestr(zipfile.ZipInfo(HEADER), text)
                    for name, value in arrays.items():
                        with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
                            array = np.asarray(value, order="C")
                            npy.write_array(member, array, version=(1, 0), allow_pickle=False)
                stream.flush()
                os.fsync(stream.fileno())
            os.replace(temporary, target)
        finally:
            temporary.unlink(missing_ok=True)
        for leftover in target.parent.glob(f".{glob.escape(target.name)}-*.tmp"):
            with contextlib.suppress(OSError):  # another process may have removed it; the checkpoint is written
                if time.time() - leftover.stat().st_mtime > LEFT_OVER:
                    leftover.unlink()
    except OSError as error:
        raise CheckpointError(f"cannot write the checkpoint {_name(path)}: {reason(error)}") from error


def read(path: str | os.PathLike[str], kind: str | None = None) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read a checkpoint written by `write`.

    Parameters
    ----------
    path : path-like
        File to read.
    kind : str, optional
        The ``kind`` that the header must have.

    Returns
    -------
    header : dict
        The values of the header.
    arrays : dict of str to ndarray
        The arrays.

    Raises
    ------
    CheckpointError
        If the file cannot be read, is not a checkpoint, is damaged or truncated, or has another schema or kind.

    See Also
    --------
    write, eip_scipy.load

    Examples
    --------
    >>> import tempfile
    >>> from eip_scipy import EIPRK4, checkpoint, integrate
    >>> from eip_scipy.problems import kepler
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     run = integrate(kepler(), (0, 30), method=EIPRK4, checkpoint=f"{folder}/run.npz")
    ...     header, arrays = checkpoint.read(f"{folder}/run.npz")
    >>> header["kind"]
    'integrate'
    """
    try:
        with open(path, "rb") as stream:
            header, arrays = _parse(path, stream)
    except OSError as error:
        raise CheckpointError(f"cannot read the checkpoint {_name(path)}: {reason(error)}") from error
    except (CheckpointError, MemoryError):
        raise
    except Exception as error:  # zipfile, json and numpy raise errors of many kinds for bytes not made by `write`
        raise CheckpointError(
            f"{_name(path)} is damaged, or not a checkpoint of eip_scipy: {error}. Restore a copy of it, or use "
            "another file for a new run."
        ) from error
    if kind is not None and header.get("kind") != kind:
        raise CheckpointError(
            f"{_name(path)} is a checkpoint of {header.get('kind')!r}, expected {kind!r}. Use the function that wrote "
            "it, or another file."
        )
    return header, arrays


def require_same(path: str | os.PathLike[str], there: Any, here: Mapping[str, Any]) -> None:
    """Compare the settings `there` in a checkpoint with the settings `here` of the run that resumes it.

    Raises
    ------
    CheckpointError
        If settings differ; the message names each of them, with both values if they are short.

    See Also
    --------
    read, write
    """
    here, there = json.loads(json.dumps(here)), there if isinstance(there, dict) else {}
    differences = []
    for name in dict.fromkeys([*here, *there]):
        old, new = json.dumps(there.get(name)), json.dumps(here.get(name))
        if there.get(name) != here.get(name):
            long = len(old) + len(new) > 120
            values = "differs" if long else f"is {old} in the checkpoint and {new} in this run"
            differences.append(f"{name} {values}")
    if differences:
        raise CheckpointError(
            f"the checkpoint {_name(path)} belongs to another run: {'; '.join(differences)}. Resume with the arguments "
            "of that run, or use another file for a new run."
        )


def changed_function(
    invariants: Any, t: float, y: np.ndarray, there: np.ndarray, f: np.ndarray
) -> tuple[str, complex, complex] | None:
    """Compare functions at the state (t, y) with their values `there`: the derivative and then the invariants.

    Return the name of the first function that differs, its value there and its value here; None if all are the same.
    `f` is the derivative here. Differences of rounding are allowed, for instance on another machine.
    """
    here = np.concatenate([f, invariants.values(t, y)])
    sizes = np.concatenate([np.full(f.size, np.abs(f).max(initial=0.0)), invariants.term_sizes(t, y, f)])
    k = first_difference(there, here, sizes)
    if k is None:
        return None
    name = "fun" if k < f.size else f"invariant {invariants.names[k - f.size]!r}"
    return name, complex(there[k]), complex(here[k])


def first_difference(there: np.ndarray, here: np.ndarray, sizes: np.ndarray) -> int | None:
    """Return the index of the first value that differs by more than the rounding of terms of `sizes`; None if none."""
    with np.errstate(invalid="ignore"):
        same = (there == here) | (np.abs(there - here) <= SAME * sizes) | (np.isnan(there) & np.isnan(here))
    return None if same.all() else int(np.argmin(same))


def warn_of_other_versions(path: str | os.PathLike[str], header: Mapping[str, Any], *, stacklevel: int) -> None:
    """Warn if a checkpoint was written by other versions of the packages, or on another kind of machine.

    The last bits of the results may then differ from those of an uninterrupted run.

    See Also
    --------
    read, write
    """
    there = {**(header.get("versions") or {}), "machine": header.get("machine")}
    here = {**_versions(), "machine": _machine()}
    other = [f"{name} {there[name]}, here {here[name]}" for name in here if there.get(name, here[name]) != here[name]]
    if other:
        warnings.warn(
            f"the checkpoint {_name(path)} was written with {'; '.join(other)}: the last bits may differ from those of "
            "an uninterrupted run.",
            UserWarning,
            stacklevel=stacklevel + 1,
        )


def _name(path: str | os.PathLike[str]) -> str:
    return repr(os.fspath(path))


def reason(error: OSError) -> str:
    """Return the operating system's message for an error, in lower case."""
    return (error.strerror or str(error)).lower()


@cache
def _versions() -> dict[str, str | None]:
    own = {"python": platform.python_version(), "eip_scipy": VERSION}
    return {**own, **{name: installed(name) for name in ("numpy", "scipy", "numba")}}


def _machine() -> str:
    return f"{platform.system()} {platform.machine()}"


def _parse(path: str | os.PathLike[str], stream: BinaryIO) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the header and the arrays of the checkpoint in `stream`.

    The sizes that the file declares are compared with its own size before memory is allocated.
    """
    with zipfile.ZipFile(stream) as archive:
        members = archive.infolist()
        if any(m.compress_type != zipfile.ZIP_STORED or m.file_size != m.compress_size for m in members):
            raise ValueError("it contains compressed members")
        if sum(m.file_size for m in members) > stream.seek(0, os.SEEK_END):
            raise ValueError("its members claim more bytes than it has")
        names = [m.filename for m in members]
        if HEADER not in names:
            raise ValueError(f"it has no member {HEADER!r}; its members are {names[:10]}")
        header = json.loads(archive.read(HEADER))
        if not isinstance(header, dict) or header.get("format") != FORMAT:
            raise ValueError(f"its header does not name the format {FORMAT!r}")
        if header.get("schema") != SCHEMA:
            version = (header.get("versions") or {}).get("eip_scipy", "unknown")
            raise CheckpointError(
                f"{_name(path)} has schema {header.get('schema')!r}, expected {SCHEMA}; resume or load it with the "
                f"version of eip_scipy that wrote it ({version})."
            )
        if names != [HEADER, *(f"{name}.npy" for name in header["arrays"])]:  # the directory has no checksum
            raise ValueError(f"its members are {names[:10]}, which are not the arrays that its header names")
        return header, {name: _array(f"{name}.npy", archive.read(f"{name}.npy")) for name in header["arrays"]}


def _array(name: str, member: bytes) -> np.ndarray:
    stream = io.BytesIO(member)
    if npy.read_magic(stream) != (1, 0):
        raise ValueError(f"{name} does not have version 1.0 of the npy format")
    shape, fortran, dtype = npy.read_array_header_1_0(stream)
    if dtype.kind not in "biufc" or fortran:
        raise ValueError(f"{name} holds {dtype} of shape {shape}, expected numbers in C order")
    return np.ndarray(shape, dtype, member, stream.tell()).copy()


# Values of results: numbers as arrays, everything else as JSON.


def _record(kind: type, fields: dict[str, Any]) -> Any:
    found: Any = object.__new__(kind)
    vars(found).update(fields)
    return found


# Values with named fields: type, and the functions that return their fields and make them from their fields.
KINDS: dict[str, tuple[type, Callable[[Any], dict[str, Any]], Callable[[dict[str, Any]], Any]]] = {
    "dict": (dict, dict, dict),
    "multipliers": (Multipliers, Multipliers._asdict, lambda fields: Multipliers(**fields)),
    **{record.__name__: (record, vars, partial(_record, record)) for record in (Diagnostics, Trust)},
}


def encoded(name: str, value: Any, arrays: dict[str, np.ndarray]) -> Any:
    """Return a field in the form that `decoded` reads: values of JSON, and the names of arrays, added to `arrays`.

    A mapping with one key stands for everything that JSON does not have; its key names the kind. TypeError is raised
    for a field that would not come back as it is.
    """
    if isinstance(value, np.generic) and value.dtype.kind not in "mM":  # a date would become an integer
        value = value.item()
    if value is None or isinstance(value, (str, int)) or (isinstance(value, float) and math.isfinite(value)):
        return value
    if _has_numbers(value):
        arrays[name] = value
        return {"array": name}
    if (
        isinstance(value, np.ndarray)
        and value.dtype == object
        and value.ndim
        and all(isinstance(text, str) for text in value)
    ):
        texts, arrays[name] = np.unique(value, return_inverse=True)  # most messages of members are equal
        return {"texts": [texts.tolist(), name]}
    for kind, (known, fields, _) in KINDS.items():
        if isinstance(value, known) and all(isinstance(key, str) for key in fields(value)):
            # Numbers instead of keys, which may contain any character, in the names of arrays.
            items = enumerate(fields(value).items())
            return {kind: {key: encoded(f"{name}.{k}", item, arrays) for k, (key, item) in items}}
    if isinstance(value, list) and _are_alike(leaves := _leaves(value)):  # as the events of many members
        arrays[name] = np.concatenate(leaves)
        return {"parts": [name, _nested(len, value)]}
    if isinstance(value, (list, tuple)):
        found = [encoded(f"{name}.{k}", item, arrays) for k, item in enumerate(value)]
        return found if isinstance(value, list) else {"tuple": found}
    raise TypeError(
        f"save: the field {name!r} is {shown(value)}, which would not be loaded as it is. Delete it, or convert it, "
        "for instance to a plain array of numbers, without a mask or a unit."
    )


def decoded(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    """Return a field from the output of `encoded`; KeyError is raised if an array is missing."""
    if isinstance(value, list):
        return [decoded(item, arrays) for item in value]
    if not isinstance(value, dict):
        return value
    ((kind, content),) = value.items()
    if kind == "array":
        return arrays[content]
    if kind == "texts":
        return np.array(content[0], dtype=object)[arrays[content[1]]]
    if kind == "parts":
        name, lengths = content
        parts = iter(np.split(arrays[name], np.cumsum(_leaves(lengths))))
        return _nested(lambda _: next(parts), lengths)
    if kind == "tuple":
        return tuple(decoded(content, arrays))
    return KINDS[kind][2]({key: decoded(item, arrays) for key, item in content.items()})


def _has_numbers(value: Any) -> bool:
    """Return True for an array of numbers; another one may be more than its numbers, for instance masked."""
    return type(value) in (np.ndarray, np.memmap) and value.dtype.kind in "biufc"


def _nested(function: Callable[[Any], Any], items: list[Any]) -> list[Any]:
    """Return the values of a function for the leaves of nested lists, in the same lists."""
    return [_nested(function, item) if isinstance(item, list) else function(item) for item in items]


def _leaves(items: list[Any]) -> list[Any]:
    found: list[Any] = []
    _nested(found.append, items)
    return found


def _are_alike(leaves: list[Any]) -> bool:
    """Return True for arrays that differ in their lengths and values only."""
    return all(_has_numbers(leaf) and leaf.ndim for leaf in leaves) and (
        len({(leaf.dtype, leaf.shape[1:]) for leaf in leaves}) == 1
    )


# Exclusive use of a file by one run at a time, until its process ends, and SIGTERM, by which batch systems end it.


def require_place(path: Any, every: Any, resume: Any, expected: str) -> None:
    """Check the options ``checkpoint``, ``checkpoint_every`` and ``resume``; the message names the `expected` path."""
    flag("resume", resume)
    if not is_number(every, "checkpoint_every") or not every > 0:
        raise ValueError(f"checkpoint_every must be a number of seconds > 0, got {shown(every)}.")
    if path is None and resume:
        raise ValueError("resume=True needs a file to resume from: pass checkpoint=path.")
    if path is not None and not isinstance(path, (str, os.PathLike)):
        raise TypeError(f"checkpoint must be {expected}, got {path!r}.")


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
