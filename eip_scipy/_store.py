"""Ensembles on disk, from which a run goes on: a Zarr group that grows chunk by chunk, or a checkpoint file."""

from __future__ import annotations

import os
import shutil
import time
import warnings
from collections import Counter
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from . import checkpoint
from ._members import NOT_RUN, Members
from ._statistics import Statistics
from .checkpoint import CheckpointError

__all__ = ["CheckpointStore", "Store", "ZarrStore", "require_identity"]

KIND = "ensemble"
LABEL = "eip_scipy_ensemble"
SAME = 1e-9
# Writing a checkpoint takes at most a twentieth of the time.
LEAST_RATIO = 19.0


class Store(Protocol):
    """Where finished chunks are kept."""

    @property
    def finished(self) -> int:
        """Members whose results are there; whole chunks, from the first one on."""

    @property
    def statistics(self) -> Statistics | None:
        """Those of the finished members, where the store keeps them."""

    @property
    def states(self) -> Any:
        """The saved states (members, n, times), where the store keeps them and nobody else."""

    def read(self, first: int, last: int) -> Members:
        """Results of members `first` to `last`."""

    def write(self, first: int, members: Members, whole: Members, statistics: Statistics | None) -> None:
        """Results of a chunk that starts with number `first`, the last part of `whole` so far, with its statistics."""

    def close(self) -> None:
        """Nothing comes any more."""


def require_identity(path: Any, there: dict[str, Any], here: dict[str, Any]) -> None:
    """Compare what makes two ensembles the same.

    Raises
    ------
    CheckpointError
        Naming each setting that differs.
    """
    checkpoint.require_same(path, there.get("settings"), here["settings"])
    one, other = ([complex(text) for text in found["start"]] for found in (there, here))
    if len(one) != len(other) or not np.allclose(one, other, rtol=SAME, atol=0.0, equal_nan=True):
        raise CheckpointError(
            f"{os.fspath(path)!r} belongs to another ensemble: fun or an invariant had other values at the start "
            f"({one[:4]} there, {other[:4]} here). Resume with the functions of that run, or name another place."
        )


def _existing(path: Any) -> CheckpointError:
    return CheckpointError(
        f"{os.fspath(path)!r} exists. resume=True goes on with the ensemble that it holds; to start anew, name another "
        "place or delete this one."
    )


class ZarrStore:
    """A group of arrays whose first axis is the member, one Zarr chunk for each chunk of the ensemble.

    The status of a chunk's members is written last: where it is, the chunk is whole. (Zarr puts each file in its place
    by renaming it.)

    Parameters
    ----------
    path : path-like
    identity : dict
        What makes two ensembles the same.
    empty : Members
        One chunk's room, for shapes and types.
    times : ndarray, shape (m,)
    members : int
    resume : bool

    Raises
    ------
    ImportError
        Without zarr.
    CheckpointError
        When there is something at `path` and `resume` is false, or it is no such group, or that of another ensemble.
    """

    statistics = None

    def __init__(
        self, path: Any, identity: dict[str, Any], empty: Members, times: np.ndarray, members: int, resume: bool
    ) -> None:
        self.path, self._members, self._chunk = Path(path), members, len(empty.t)
        zarr = _zarr()
        if self.path.exists():
            if not resume:
                raise _existing(path)
            if self._opened(zarr, identity):
                return
        self._group = zarr.open_group(self.path, mode="w", zarr_format=3, attributes={LABEL: None})
        self._create(identity, empty, times)

    def _opened(self, zarr: Any, identity: dict[str, Any]) -> bool:
        """Go on with what is there; False where it was left before it was whole."""
        try:
            group = zarr.open_group(self.path, mode="r+")
            found = group.attrs[LABEL]
        except (KeyError, ValueError, OSError) as error:
            raise CheckpointError(f"{os.fspath(self.path)!r} is no ensemble of eip_scipy: {error}") from error
        if found is None:
            shutil.rmtree(self.path)
            return False
        require_identity(self.path, found, identity)
        checkpoint.warn_of_other_versions(self.path, found, stacklevel=4)
        self._group = group
        return True

    def _create(self, identity: dict[str, Any], empty: Members, times: np.ndarray) -> None:
        n = empty.y.shape[1]
        self._make("y", empty.y.dtype, ("member", "component"), (n,))
        if times.size:
            self._make("states", empty.y.dtype, ("member", "component", "time"), (n, times.size))
            self._group.create_array("time", data=times, dimension_names=("time",))
        self._make("t_end", np.dtype(float), ("member",))
        self._make("max_defect", np.dtype(float), ("member", "invariant"), empty.max_defect.shape[1:])
        self._make("max_correction", np.dtype(float), ("member",))
        self._make("counters", np.dtype(np.int64), ("member", "counter"), empty.counters.shape[1:], fill=0)
        self._make("side_by_side", np.dtype(bool), ("member",), fill=False)
        self._make("trusted", np.dtype(bool), ("member",), fill=False)
        self._make("message", str, ("member",), fill="")
        self._make("status", np.dtype(np.int64), ("member",), fill=NOT_RUN)
        # Last: a group without it was left before it was whole.
        self._group.attrs[LABEL] = {**checkpoint.origin(), **identity}

    def _make(
        self, name: str, dtype: Any, axes: tuple[str, ...], shape: tuple[int, ...] = (), fill: Any = np.nan
    ) -> None:
        chunks = (self._chunk, *(max(1, size) for size in shape))
        self._group.create_array(
            name, shape=(self._members, *shape), chunks=chunks, dtype=dtype, fill_value=fill, dimension_names=axes
        )

    @property
    def finished(self) -> int:
        missing = np.flatnonzero(self._group["status"][:] == NOT_RUN)
        return self._members if not missing.size else int(missing[0]) // self._chunk * self._chunk

    @property
    def states(self) -> Any:
        return self._group.get("states", None)

    def read(self, first: int, last: int) -> Members:
        group, place = self._group, slice(first, last)
        y = group["y"][place]
        none = np.empty((last - first, 0, y.shape[1]), y.dtype)
        return Members(
            y=y,
            t=group["t_end"][place],
            status=group["status"][place],
            message=[str(text) for text in group["message"][place]],
            max_defect=group["max_defect"][place],
            counters=group["counters"][place],
            max_correction=group["max_correction"][place],
            side_by_side=group["side_by_side"][place],
            trusted=group["trusted"][place],
            saved=group["states"][place].swapaxes(1, 2) if "states" in group else none,
        )

    def write(self, first: int, members: Members, whole: Members, statistics: Statistics | None) -> None:
        group, place = self._group, slice(first, first + len(members.t))
        group["y"][place] = members.y
        group["t_end"][place] = members.t
        group["max_defect"][place] = members.max_defect
        group["counters"][place] = members.counters
        group["max_correction"][place] = members.max_correction
        group["side_by_side"][place] = members.side_by_side
        group["trusted"][place] = members.trusted
        if "states" in group:
            group["states"][place] = members.saved.swapaxes(1, 2)
        group["message"][place] = np.array(members.message, dtype=object)
        group["status"][place] = members.status

    def close(self) -> None:
        """All is written."""


class CheckpointStore:
    """A checkpoint file with the finished members and their statistics, written anew every so many seconds.

    Parameters
    ----------
    path : path-like
    identity : dict
        What makes two ensembles the same.
    every : float
        Seconds from one writing to the next; more where it would take over a twentieth of the time.
    resume : bool

    Raises
    ------
    CheckpointError
        When there is a file and `resume` is false, or it is damaged, or that of another ensemble, or cannot be written.
    """

    states = None

    def __init__(self, path: Any, identity: dict[str, Any], every: float, resume: bool) -> None:
        self.path, self._identity, self._every = path, identity, every
        self._header: dict[str, Any] = {"finished": 0, "usual": "", "messages": {}}
        self._arrays: dict[str, np.ndarray] = {}
        self._waiting: tuple[int, Members, Statistics | None] | None = None
        if os.path.lexists(path):
            if not resume:
                raise _existing(path)
            self._header, self._arrays = checkpoint.read(path, KIND)
            require_identity(path, self._header, identity)
            checkpoint.warn_of_other_versions(path, self._header, stacklevel=3)
        else:
            checkpoint.write(path, {"kind": KIND, **identity, **self._header}, {})
        self._written, self._cost = time.perf_counter(), 0.0

    @property
    def finished(self) -> int:
        return int(self._header["finished"])

    @property
    def statistics(self) -> Statistics | None:
        mark = "statistics_"
        found = {name.removeprefix(mark): a for name, a in self._arrays.items() if name.startswith(mark)}
        return Statistics(**found) if found else None

    def read(self, first: int, last: int) -> Members:
        usual, others = self._header["usual"], self._header["messages"]
        arrays = {name: self._arrays[f"members_{name}"][first:last] for name in Members._fields if name != "message"}
        return Members(**arrays, message=[others.get(str(k), usual) for k in range(first, last)])

    def write(self, first: int, members: Members, whole: Members, statistics: Statistics | None) -> None:
        self._waiting = first + len(members.t), whole, statistics
        since = time.perf_counter() - self._written
        if since >= max(self._every, LEAST_RATIO * self._cost):
            self.close()

    def close(self) -> None:
        """Write what has come since the last time; a disk that is full then is a warning, the former file stays."""
        if self._waiting is None:
            return
        begin = time.perf_counter()
        done, whole, statistics = self._waiting
        messages = whole.message[:done]
        usual = Counter(messages).most_common(1)[0][0]
        header = {
            "kind": KIND,
            **self._identity,
            "finished": done,
            "usual": usual,
            "messages": {str(k): text for k, text in enumerate(messages) if text != usual},
        }
        arrays = {f"members_{name}": getattr(whole, name)[:done] for name in Members._fields if name != "message"}
        if statistics is not None:
            arrays |= {f"statistics_{name}": value for name, value in vars(statistics).items()}
        try:
            checkpoint.write(self.path, header, arrays)
        except CheckpointError as error:
            warnings.warn(f"{error}; the former checkpoint stays", RuntimeWarning, stacklevel=2)
        self._waiting = None
        self._written = time.perf_counter()
        self._cost = self._written - begin


def _zarr() -> Any:
    try:
        import zarr
    except ModuleNotFoundError as error:
        raise ImportError('out= needs zarr: pip install "eip_scipy[zarr]"', name="zarr") from error
    return zarr
