"""Checkpoint files: a JSON header and arrays in one npz archive, which is written completely or not at all.

`numpy.load` can open such a file: it contains ``header.json`` and each array as ``NAME.npy``, uncompressed. The archive
has a checksum (CRC-32) of each member, which is compared on reading. Nothing is pickled.
"""

from __future__ import annotations

import contextlib
import glob
import io
import json
import os
import platform
import secrets
import sys
import time
import warnings
import zipfile
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.lib import format as npy

from ..core.versions import VERSION, installed

__all__ = ["CheckpointError", "read", "require_same", "warn_of_other_versions", "write"]

FORMAT, SCHEMA = "eip_scipy checkpoint", 1
HEADER = "header.json"
LEFT_OVER = 3600.0
SAME = 1e-9  # relative difference allowed between values of the same function


class CheckpointError(Exception):
    """Error for a checkpoint that cannot be written or read, is damaged, or belongs to another run."""


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
    with np.errstate(invalid="ignore"):
        same = (there == here) | (np.abs(there - here) <= SAME * sizes) | (np.isnan(there) & np.isnan(here))
    for k in np.flatnonzero(~same)[:1].tolist():
        name = "fun" if k < f.size else f"invariant {invariants.names[k - f.size]!r}"
        return name, complex(there[k]), complex(here[k])
    return None


def warn_of_other_versions(path: str | os.PathLike[str], header: Mapping[str, Any], *, stacklevel: int) -> None:
    """Warn if a checkpoint was written by other versions of the packages, or on another kind of machine.

    The last bits of the results may then differ from those of an uninterrupted run.
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
