"""Ensembles on disk, from which a run goes on: a Zarr group that grows chunk by chunk, or a checkpoint file."""

from __future__ import annotations

import os
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from .. import checkpoint
from ..checkpoint import CheckpointError
from ..checkpoint.locks import Lock
from ..checkpoint.own_file import OwnFile, absolute, unlocked
from ..core.inputs import shown
from .happened import Flat, flattened, unflattened
from .statistics import Statistics
from .tasks import COMPARED, LISTS, NOT_RUN, Members

__all__ = ["CheckpointStore", "Store", "ZarrStore", "location", "require_identity", "require_same_functions"]

KIND = "ensemble"
LABEL = "eip_scipy_ensemble"
# Metadata of format 2 may name the codec that unpickles. A group's own file may hold metadata of any format.
FORMAT: dict[str, Any] = {"zarr_format": 3, "use_consolidated": False}
OPTIONAL = (
    "states", "time", "times", "invariants", "end_invariants", "target", "event_count", "event_t", "event_y",
    "known_by",
)  # fmt: skip
ARRAYS = (
    *OPTIONAL, "y", "t_end", "max_defect", "max_correction", "counters", "side_by_side", "trusted", "message", "status",
)  # fmt: skip
CODECS = {"blosc", "bytes", "crc32c", "gzip", "transpose", "vlen-bytes", "vlen-utf8", "zstd"}
SAME = 1e-9
EVENTS_IN_A_FILE = 4096
# Writing a checkpoint takes at most a twentieth of the time.
LEAST_RATIO = 19.0


class Store(Protocol):
    """Where finished chunks are kept."""

    @property
    def path(self) -> str:
        """Its absolute path, or its URL."""

    @property
    def finished(self) -> int:
        """Members whose results are there; whole chunks, from the first one on."""

    @property
    def statistics(self) -> Statistics | None:
        """Those of the finished members, where the store keeps them."""

    @property
    def states(self) -> Any:
        """The saved states (members, n, times), where the store keeps them and nobody else."""

    @property
    def saved_values(self) -> Any:
        """The invariants of the saved states (members, l, times), likewise."""

    def read(self, first: int, last: int) -> Members:
        """Results of members `first` to `last`."""

    def known_by(self, first: int) -> np.ndarray:
        """What was written beside the last finished chunk, which starts with number `first`; empty: nothing was."""

    def write(
        self, first: int, members: Members, known_by: np.ndarray, whole: Members, statistics: Statistics | None
    ) -> None:
        """Results of a chunk that starts with number `first`, the last part of `whole` so far, with its statistics.

        `known_by` is what its functions are recognised by.
        """

    def flush(self) -> None:
        """Write what is waiting."""

    def close(self) -> None:
        """Let other ensembles in."""


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


def require_all(path: Any, missing: list[str]) -> None:
    """Refuse a store that lacks something that an ensemble keeps.

    Raises
    ------
    CheckpointError
        Naming the first that is missing.
    """
    if missing:
        raise CheckpointError(
            f"{os.fspath(path)!r} was written by an earlier version of eip_scipy: {missing[0]!r} is missing. Resume it "
            "with that version, or name another place to start anew."
        )


def require_same_functions(path: Any, there: np.ndarray, here: np.ndarray, sizes: np.ndarray, first: int) -> None:
    """Compare what functions give where a member of the last finished chunk ended.

    Raises
    ------
    CheckpointError
        Where they differ by more than another machine's rounding.
    """
    if there.size and not (there.shape == here.shape and bool(np.all(np.abs(there - here) <= SAME * sizes))):
        raise CheckpointError(
            f"{os.fspath(path)!r} belongs to another ensemble: fun or an invariant had other values where a member "
            f"from number {first} on ended. Resume with the functions of that run, or name another place."
        )


class ZarrStore:
    """A group of arrays whose first axis is the member, one Zarr chunk for each chunk of the ensemble.

    The status of a chunk's members is written last: where it is, the chunk is whole. (Zarr puts each file in its place
    by renaming it.) A group in the local file system is locked, and written to while it is the one that was opened.

    Parameters
    ----------
    path : path-like or str
        A folder, or the URL of a store.
    identity : dict
        What makes two ensembles the same.
    empty : Members
        One chunk's room, for shapes and types.
    times : ndarray, shape (m,) or (members, m)
    members : int
    resume : bool
    events : int, optional
        How many there are, of which times and states are kept.

    Raises
    ------
    ImportError
        Without zarr.
    CheckpointError
        When there is something at `path` and `resume` is false, or it is no such group, or that of another ensemble, or
        another ensemble is writing there.
    """

    statistics = None

    def __init__(
        self,
        path: Any,
        identity: dict[str, Any],
        empty: Members,
        times: np.ndarray,
        members: int,
        resume: bool,
        events: int = 0,
    ) -> None:
        zarr = _zarr()
        self._events = events
        self._group: Any = None
        self.path, self._members, self._chunk = location(path), members, len(empty.t)
        self._local = None if is_url(self.path) else Path(os.path.realpath(self.path))
        self._place = self.path if self._local is None else str(self._local)
        self._lock: Lock | None = None
        if self._local is not None:
            with self._written():
                self._local.parent.mkdir(parents=True, exist_ok=True)
            self._lock = Lock(self._local, self.path)
            if self._lock.problem:
                warnings.warn(unlocked(self.path, self._lock.problem), RuntimeWarning, stacklevel=3)
        try:
            with self._written():
                self._open(zarr, identity, empty, times, resume)
        except BaseException:
            self.close()
            raise

    def _open(self, zarr: Any, identity: dict[str, Any], empty: Members, times: np.ndarray, resume: bool) -> None:
        """Go on with what is there, or begin."""
        mode: Any = "w-"
        if self._exists(zarr):
            if not resume:
                raise CheckpointError(
                    f"{self.path!r} exists. resume=True goes on with the ensemble that it holds; to start anew, name "
                    "another place or delete this one."
                )
            found = self._existing(zarr)
            if found is not None:
                require_identity(self.path, found, identity)
                require_all(self.path, [name for name in ("target", "end_invariants") if name not in self._group])
                self._require_layout(empty, times)
                checkpoint.warn_of_other_versions(self.path, found, stacklevel=4)
                self._label, self._mark = found, self._status()
                return
            mode = "w"  # left by us before it was whole
        try:
            self._group = zarr.open_group(self._place, mode=mode, attributes={LABEL: None}, **FORMAT)
        except FileExistsError as error:
            raise CheckpointError(f"{self.path!r} is no ensemble of eip_scipy: {error}") from error
        except OSError:
            with suppress(OSError):  # where Zarr has come no further than to the folder
                os.rmdir(self._place)
            raise
        self._create(identity, empty, times)
        self._label, self._mark = self._group.attrs[LABEL], self._status()

    def _exists(self, zarr: Any) -> bool:
        if self._local is not None:
            return os.path.lexists(self._local)
        try:
            zarr.open_group(self._place, mode="r", **FORMAT)
        except FileNotFoundError:
            return False
        return True

    def _existing(self, zarr: Any) -> dict[str, Any] | None:
        """What the group that is there says of itself; None where it was left before it was whole."""
        try:
            self._group = zarr.open_group(self._place, mode="r+", **FORMAT)
            found: dict[str, Any] | None = self._group.attrs[LABEL]
            if found is not None:
                if not isinstance(found, dict):
                    raise ValueError(f"its attribute {LABEL!r} is {shown(found)}, not a mapping")
                self._require_plain_arrays()
        except (KeyError, TypeError, ValueError, OSError) as error:  # TypeError: Zarr's, for codecs in a wrong order
            old = self._local is not None and (self._local / ".zgroup").exists()
            why = "it is a Zarr group of format 2, whose metadata may name code to run" if old else error
            raise CheckpointError(f"{self.path!r} is no ensemble of eip_scipy: {why}") from error
        return found

    def _require_plain_arrays(self) -> None:
        """Look at all arrays before one is read: a codec from elsewhere may run what is in the data."""
        for name in ARRAYS:
            if name not in self._group:
                if name in OPTIONAL:
                    continue
                raise ValueError(f"it has no array {name!r} of format 3")
            metadata = self._group[name].metadata.to_dict()
            if metadata.get("node_type") != "array":
                raise ValueError(f"its {name!r} is not an array")
            codecs = {codec["name"] for codec in metadata.get("codecs", ())}
            if metadata["zarr_format"] != 3 or not codecs <= CODECS:
                raise ValueError(
                    f"its array {name!r} is stored by {', '.join(sorted(codecs - CODECS)) or 'another format'}; "
                    f"expected {', '.join(sorted(CODECS))}"
                )

    def _status(self) -> tuple[int, int] | None:
        """What the group is known by: it writes its own file at its making only."""
        if self._local is None:
            return None
        status = os.stat(self._local / "zarr.json")
        return status.st_ino, status.st_mtime_ns

    @contextmanager
    def _written(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise CheckpointError(f"cannot write to {self.path!r}: {error.strerror or error}") from error

    def _require_own(self) -> None:
        """See that the group is the one that was opened; users may add to its attributes.

        Raises
        ------
        CheckpointError
        """
        try:
            mark = self._status()
            if mark != self._mark:
                own = _zarr().open_group(self._place, mode="r", **FORMAT).attrs[LABEL] == self._label
                self._mark = mark if own else None
        except (KeyError, ValueError, OSError):
            self._mark = None
        if self._mark is None and self._local is not None:
            raise CheckpointError(
                f"{self.path!r} is no longer the group that this ensemble writes to: it was replaced or removed. "
                "Nothing more is written there."
            )

    def _create(self, identity: dict[str, Any], empty: Members, times: np.ndarray) -> None:
        for name, array in self._layout(empty, times).items():
            self._group.create_array(name, **array)
        if times.size:
            self._group[_name_of(times)][...] = times
        # Last: a group without it was left before it was whole.
        self._group.attrs[LABEL] = {**checkpoint.origin(), **identity}

    def _layout(self, empty: Members, times: np.ndarray) -> dict[str, dict[str, Any]]:
        """Return what the arrays of this ensemble are created by."""
        n, (kept, rows) = empty.y.shape[1], (empty.max_defect.shape[1], empty.saved.shape[1])
        number, count, state = np.dtype(float), np.dtype(np.int64), empty.y.dtype
        layout: dict[str, dict[str, Any]] = {}

        def array(name: str, dtype: Any, axes: tuple[str, ...], *shape: int, fill: Any = np.nan) -> None:
            chunks = (self._chunk, *(max(1, size) for size in shape))
            layout[name] = {"shape": (self._members, *shape), "chunks": chunks, "dtype": dtype, "fill_value": fill}
            layout[name]["dimension_names"] = ("member", *axes)

        array("y", state, ("component",), n)
        if times.size:
            axis = "time" if times.ndim == 1 else "row"  # xarray takes no two-dimensional array by its axis' name
            array("states", state, ("component", axis), n, rows)
            array("invariants", number, ("invariant", axis), kept, rows)
            axes = ("time",) if times.ndim == 1 else ("member", "row")
            layout[_name_of(times)] = {"shape": times.shape, "dtype": times.dtype, "dimension_names": axes}
        array("end_invariants", number, ("invariant",), kept)
        array("target", number, ("invariant",), kept)
        if self._events:
            array("event_count", count, ("event",), self._events, fill=0)
            layout["event_t"] = {"shape": (0,), "chunks": (EVENTS_IN_A_FILE,), "dtype": number}
            layout["event_t"]["dimension_names"] = ("happened",)
            layout["event_y"] = {"shape": (0, n), "chunks": (EVENTS_IN_A_FILE, n), "dtype": state}
            layout["event_y"]["dimension_names"] = ("happened", "component")
        array("t_end", number, ())
        array("max_defect", number, ("invariant",), kept)
        array("max_correction", number, ())
        array("counters", count, ("counter",), empty.counters.shape[1], fill=0)
        array("side_by_side", np.dtype(bool), (), fill=False)
        array("trusted", np.dtype(bool), (), fill=False)
        # Room for what a chunk's functions are recognised by.
        width = COMPARED + kept
        layout["known_by"] = {"shape": (-(-self._members // self._chunk), width), "chunks": (1, width), "dtype": number}
        layout["known_by"] |= {"fill_value": np.nan, "dimension_names": ("chunk", "value")}
        array("message", str, (), fill="")
        array("status", count, (), fill=NOT_RUN)
        return layout

    def _require_layout(self, empty: Members, times: np.ndarray) -> None:
        """Refuse arrays of other sizes, whose reading may take any amount of memory.

        Raises
        ------
        CheckpointError
        """
        for name, array in self._layout(empty, times).items():
            there = self._group.get(name)
            if there is None:  # one of OPTIONAL
                continue
            shape, chunks = array["shape"], array.get("chunks", there.chunks)
            grows = name in ("event_t", "event_y")
            if there.shape[grows:] != shape[grows:] or there.chunks != chunks:
                raise CheckpointError(
                    f"{self.path!r} is damaged: its array {name!r} has the shape {there.shape} in chunks of "
                    f"{there.chunks}; expected {shape} in chunks of {chunks}. Name another place to start anew."
                )

    @property
    def finished(self) -> int:
        missing = np.flatnonzero(self._group["status"][:] == NOT_RUN)
        return self._members if not missing.size else int(missing[0]) // self._chunk * self._chunk

    @property
    def states(self) -> Any:
        return self._group.get("states", None)

    @property
    def saved_values(self) -> Any:
        return self._group.get("invariants", None)

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
            saved_values=group["invariants"][place].swapaxes(1, 2)
            if "invariants" in group
            else np.empty((last - first, 0, group["target"].shape[1])),
            values=group["end_invariants"][place],
            target=group["target"][place],
            happened=unflattened(self._flat(first, last)),
        )

    def _flat(self, first: int, last: int) -> Flat:
        """Return the events of members `first` to `last`, behind those of the members before."""
        if not self._events:
            return Flat(np.zeros((last - first, 0), np.int64), np.zeros(0), np.zeros((0, 1)))
        counts = self._group["event_count"][:last]
        begin, end = int(counts[:first].sum()), int(counts.sum())
        return Flat(counts[first:], self._group["event_t"][begin:end], self._group["event_y"][begin:end])

    def _write_events(self, first: int, members: Members) -> None:
        """Write the events of a chunk, in place of those of one that was broken off before it was whole."""
        group, y = self._group, members.y
        flat = flattened(members.happened, self._events, y.shape[1], y.dtype)
        group["event_count"][first : first + len(members.t)] = flat.counts
        begin = int(group["event_count"][:first].sum())
        end = begin + flat.t.size
        for name, values in (("event_t", flat.t), ("event_y", flat.y)):
            group[name].resize((end, *values.shape[1:]))
            if values.size:
                group[name][begin:end] = values

    def known_by(self, first: int) -> np.ndarray:
        if "known_by" not in self._group:
            return np.zeros(0)
        row = self._group["known_by"][first // self._chunk]
        return row[~np.isnan(row)]

    def write(
        self, first: int, members: Members, known_by: np.ndarray, whole: Members, statistics: Statistics | None
    ) -> None:
        self._require_own()
        with self._written():
            group, place = self._group, slice(first, first + len(members.t))
            group["y"][place] = members.y
            group["t_end"][place] = members.t
            group["max_defect"][place] = members.max_defect
            group["counters"][place] = members.counters
            group["max_correction"][place] = members.max_correction
            group["side_by_side"][place] = members.side_by_side
            group["trusted"][place] = members.trusted
            group["end_invariants"][place] = members.values
            group["target"][place] = members.target
            if "states" in group:
                group["states"][place] = members.saved.swapaxes(1, 2)
                group["invariants"][place] = members.saved_values.swapaxes(1, 2)
            if self._events:
                self._write_events(first, members)
            group["known_by"][first // self._chunk, : known_by.size] = known_by
            group["message"][place] = np.array(members.message, dtype=object)
            group["status"][place] = members.status

    def flush(self) -> None:
        """All is written."""

    def close(self) -> None:
        """Let other ensembles in."""
        if self._lock is not None:
            self._lock.release()


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

    states = saved_values = None

    def __init__(self, path: Any, identity: dict[str, Any], every: float, resume: bool) -> None:
        self._identity, self._every = identity, every
        self._header: dict[str, Any] = {"finished": 0, "usual": "", "messages": {}}
        self._arrays: dict[str, np.ndarray] = {}
        self._waiting: tuple[int, np.ndarray, Members, Statistics | None] | None = None
        self._file = OwnFile(path)
        if self._file.problem:
            warnings.warn(unlocked(self._file.name, self._file.problem), RuntimeWarning, stacklevel=3)
        try:
            self._open(resume)
        except BaseException:
            self._file.close()
            raise
        self._written, self._cost = time.perf_counter(), 0.0

    def _open(self, resume: bool) -> None:
        """Read what is there, or begin."""
        if not self._file.exists():
            self._file.write({"kind": KIND, **self._identity, **self._header}, {})
            return
        if not resume:
            raise self._file.existing("ensemble")
        self._header, self._arrays = self._file.read(KIND)
        require_identity(self._file.name, self._header, self._identity)
        if self.finished:
            needed = [f"members_{name}" for name in Members._fields if name not in LISTS]
            needed += [f"events_{name}" for name in Flat._fields]
            require_all(self._file.name, [name for name in needed if name not in self._arrays])
        checkpoint.warn_of_other_versions(self._file.name, self._header, stacklevel=4)

    @property
    def path(self) -> str:
        return self._file.name

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
        arrays = {name: self._arrays[f"members_{name}"][first:last] for name in Members._fields if name not in LISTS}
        flat = Flat(*(self._arrays[f"events_{name}"] for name in Flat._fields))
        return Members(
            **arrays,
            message=[others.get(str(k), usual) for k in range(first, last)],
            happened=unflattened(flat)[first:last],
        )

    def known_by(self, first: int) -> np.ndarray:
        return self._arrays.get("known_by", np.zeros(0))

    def write(
        self, first: int, members: Members, known_by: np.ndarray, whole: Members, statistics: Statistics | None
    ) -> None:
        self._waiting = first + len(members.t), known_by, whole, statistics
        since = time.perf_counter() - self._written
        if since >= max(self._every, LEAST_RATIO * self._cost):
            self.flush()

    def close(self) -> None:
        """Let other ensembles in."""
        self._file.close()

    def flush(self) -> None:
        """Write what has come since the last time; a disk that is full then is a warning, the former file stays."""
        if self._waiting is None:
            return
        begin = time.perf_counter()
        done, known_by, whole, statistics = self._waiting
        messages = whole.message[:done]
        usual = Counter(messages).most_common(1)[0][0]
        header = {
            "kind": KIND,
            **self._identity,
            "finished": done,
            "usual": usual,
            "messages": {str(k): text for k, text in enumerate(messages) if text != usual},
        }
        arrays = {f"members_{name}": getattr(whole, name)[:done] for name in Members._fields if name not in LISTS}
        happened = whole.happened[:done]
        flat = flattened(happened, max(map(len, happened), default=0), whole.y.shape[1], whole.y.dtype)
        arrays |= {f"events_{name}": value for name, value in flat._asdict().items()}
        arrays["known_by"] = known_by
        if statistics is not None:
            arrays |= {f"statistics_{name}": value for name, value in vars(statistics).items()}
        name = self._file.name
        try:
            self._file.write(header, arrays)
            if self._file.name != name:
                warnings.warn(f"{self._file.moved}.", RuntimeWarning, stacklevel=2)
        except CheckpointError as error:
            warnings.warn(f"{error}; the former checkpoint stays", RuntimeWarning, stacklevel=2)
        self._waiting = None
        self._written = time.perf_counter()
        self._cost = self._written - begin


def _name_of(times: np.ndarray) -> str:
    """Return the name of the array of times, which are common to all members or of each."""
    return "time" if times.ndim == 1 else "times"


def is_url(path: str) -> bool:
    """Whether Zarr finds a store of this name elsewhere than in the local file system."""
    return "://" in path


def location(path: str | os.PathLike[str]) -> str:
    """Where a path leads to now; a URL as it is."""
    text = os.fspath(path)
    return text if is_url(text) else absolute(text)


def _zarr() -> Any:
    try:
        import zarr
    except ModuleNotFoundError as error:
        raise ImportError('out= needs zarr: pip install "eip_scipy[zarr]"', name="zarr") from error
    return zarr
