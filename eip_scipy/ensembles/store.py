"""Ensembles on disk that a later call can resume: a Zarr group written chunk by chunk, or a checkpoint file."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np

from .. import checkpoint
from ..checkpoint import CheckpointError
from ..checkpoint.locks import Lock, absolute
from ..core.callers import users_level
from ..core.inputs import shown
from .happened import Flat, flattened, unflattened
from .saving import expanded, shortened
from .statistics import Statistics
from .tasks import AT_ENDS, COMPARED, LISTS, NOT_RUN, Members

__all__ = ["CheckpointStore", "Store", "ZarrStore", "location", "require_same_functions"]

KIND = "ensemble"
LABEL = "eip_scipy_ensemble"
# Format 2 is refused because its metadata may name a codec that unpickles. Consolidated metadata may be of any format.
FORMAT: dict[str, Any] = {"zarr_format": 3, "use_consolidated": False}
# Arrays of a group: the field of Members, and the axes after the member axis. The status is written last.
ARRAYS: dict[str, tuple[str, tuple[str, ...]]] = {
    "y": ("y", ("component",)),
    "states": ("saved", ("component", "time")),
    "invariants": ("saved_values", ("invariant", "time")),
    "end_invariants": ("values", ("invariant",)),
    "target": ("target", ("invariant",)),
    "t_end": ("t", ()),
    "max_defect": ("max_defect", ("invariant",)),
    "max_correction": ("max_correction", ()),
    "counters": ("counters", ("counter",)),
    "side_by_side": ("side_by_side", ()),
    "trusted": ("trusted", ()),
    "message": ("message", ()),
    "status": ("status", ()),
}
FILLED = {"message": "", "status": NOT_RUN}
TIMES = {1: "time", 2: "times"}  # array of the times that all members have, (m,), or of each member's, (members, m)
CODECS = {"blosc", "bytes", "crc32c", "gzip", "transpose", "vlen-bytes", "vlen-utf8", "zstd"}
SAME = 1e-9
EVENTS_IN_A_FILE = 4096
OPTIONAL = {"known_events"}  # arrays that groups of earlier versions do not have
# Writing a checkpoint takes at most 5 % of the time.
LEAST_RATIO = 19.0


class _Store:
    """Base class of the two stores of an ensemble's finished chunks on disk.

    A chunk consists of successive members that are run and stored together; all chunks but the last have one size.
    """

    path: str  # absolute path, or URL
    finished = 0  # number of members whose results were stored at the start: complete chunks, beginning with the first
    statistics: Statistics | None = None  # of these members, if the store contains them
    # Zarr arrays of saved states (members, n, times) and invariants (members, l, times), if only the store has them.
    states: Any = None
    saved_values: Any = None
    _lock: Lock | None = None

    def flush(self) -> None:
        """Write results that have not been written yet."""

    def close(self) -> None:
        """Release the lock."""
        if self._lock is not None:
            self._lock.close()

    def _require_same(self, there: dict[str, Any], here: dict[str, Any], missing: list[str]) -> None:
        """Raise CheckpointError if the stored identity `there` differs from `here` or names of arrays are `missing`."""
        checkpoint.require_same(self.path, there.get("settings"), here["settings"])
        one, other = ([complex(text) for text in found["start"]] for found in (there, here))
        if len(one) != len(other) or not np.allclose(one, other, rtol=SAME, atol=0.0, equal_nan=True):
            stored, now = (", ".join(found["start"][:4]) for found in (there, here))
            raise _other_functions(
                self.path, "fun, an invariant or reduce", f"at the start (stored: {stored}; now: {now})"
            )
        if missing:
            raise CheckpointError(
                f"{self.path!r} is not an ensemble of eip_scipy, or was written by an earlier version of eip_scipy: "
                f"{missing[0]!r} is missing. Resume it with that version, or use another place for a new ensemble."
            )
        checkpoint.warn_of_other_versions(self.path, there, stacklevel=users_level())


def require_same_functions(path: str, there: np.ndarray, here: np.ndarray, sizes: np.ndarray, first: int) -> None:
    """Raise CheckpointError if functions have other values at the end of a member of the chunk from `first` on.

    `there` are the stored values, `here` those of the present functions, and `sizes` the sizes relative to which they
    are compared, see `Plan.known_by`. Values that are not stored are not compared: earlier versions stored none of the
    events, which are the last in `here`. `SAME` allows for rounding errors on another machine.
    """
    here, sizes = here[: there.size], sizes[: there.size]
    if there.size and not (there.shape == here.shape and bool(np.all(np.abs(there - here) <= SAME * sizes))):
        what = "fun, an invariant or an event"
        raise _other_functions(path, what, f"at the end of a member from number {first} on")


def _other_functions(path: str, what: str, where: str) -> CheckpointError:
    return CheckpointError(
        f"{path!r} belongs to another ensemble: {what} had other values {where}. Resume with the functions of that "
        "run, or use another place."
    )


class ZarrStore(_Store):
    """A Zarr group with the results of an ensemble, in arrays whose first axis is the member.

    The arrays have one Zarr chunk for each chunk of the ensemble. The status of the members of a chunk is written last:
    if it is present, the chunk is complete. (Zarr writes each file under a temporary name and renames it.) A group in
    the local file system is locked. Before each write a check makes sure that it is still the group that was opened.

    `path` is a folder or the URL of a store, and `identity` the output of `Plan.identity`, which must agree when the
    ensemble is resumed. `empty` holds the buffers of one chunk, which define shapes and types, and `times` the times of
    the saved states, (m,) for all `members` or (members, m), empty if no states are saved. `events` is the number of
    events whose times and states are stored.
    """

    def __init__(
        self,
        path: Any,
        identity: dict[str, Any],
        resume: bool,
        empty: Members,
        times: np.ndarray,
        members: int,
        events: int,
    ) -> None:
        zarr = _zarr()
        self.path, self._members, self._chunk, self._events = location(path), members, len(empty.t), events
        self._empty, self._arrays = empty, dict[str, Any]()
        self._place = self.path if is_url(self.path) else os.path.realpath(self.path)
        with self._written():
            if not is_url(self.path):
                os.makedirs(os.path.dirname(self._place), exist_ok=True)
                self._lock = Lock(self.path)
            try:
                self._label = self._open(zarr, identity, times, resume)
                with self._being_read("the status of the members"):
                    missing = np.flatnonzero(self._arrays["status"][:] == NOT_RUN)
            except BaseException:
                self.close()
                raise
        self.finished = int(missing[0]) // self._chunk * self._chunk if missing.size else members
        self.states, self.saved_values = self._arrays.get("states"), self._arrays.get("invariants")

    def _open(self, zarr: Any, identity: dict[str, Any], times: np.ndarray, resume: bool) -> Any:
        """Open the existing Zarr group or create one; return its stored identity."""
        mode: Any = "w-"
        if self._exists(zarr):
            if not resume:
                raise checkpoint.existing(self.path, "ensemble")
            if (found := self._existing(zarr, identity, times)) is not None:
                return found
            mode = "w"  # the creation of this group was interrupted
        try:
            group = zarr.open_group(self._place, mode=mode, attributes={LABEL: None}, **FORMAT)
        except FileExistsError as error:
            raise CheckpointError(
                f"{self.path!r} is not an ensemble of eip_scipy: {error} (use another place for a new ensemble)"
            ) from error
        except OSError:
            with suppress(OSError):  # Zarr may have created only the folder
                os.rmdir(self._place)
            raise
        self._arrays = {name: group.create_array(name, **how) for name, how in self._layout(times).items()}
        if times.size:
            self._arrays[TIMES[times.ndim]][...] = times
        # Written last: the creation of a group without it was interrupted.
        group.attrs[LABEL] = {**checkpoint.origin(), **identity}
        return group.attrs[LABEL]

    def _exists(self, zarr: Any) -> bool:
        if self._lock is not None:
            return os.path.lexists(self._place)
        try:
            zarr.open_group(self._place, mode="r", **FORMAT)
        except FileNotFoundError:
            return False
        return True

    def _existing(self, zarr: Any, identity: dict[str, Any], times: np.ndarray) -> dict[str, Any] | None:
        """Open the existing Zarr group; return its stored identity, or None if its creation was interrupted."""
        try:
            group = zarr.open_group(self._place, mode="r+", **FORMAT)
            found: dict[str, Any] | None = group.attrs[LABEL]
            if found is None:
                return None
            if not isinstance(found, dict):
                raise ValueError(f"its attribute {LABEL!r} is {shown(found)}, not a mapping")
            layout = self._layout(times)
            self._require_same(found, identity, [name for name in layout if name not in group and name not in OPTIONAL])
            self._arrays = {name: self._plain(name, group[name], how) for name, how in layout.items() if name in group}
        except (KeyError, TypeError, ValueError, OSError) as error:  # Zarr raises TypeError for codecs in a wrong order
            old = self._lock is not None and os.path.exists(f"{self._place}/.zgroup")
            why = "it is a Zarr group of format 2, whose metadata may name code to run" if old else error
            raise CheckpointError(
                f"{self.path!r} is not an ensemble of eip_scipy: {why} (use another place for a new ensemble)"
            ) from error
        return found

    def _plain(self, name: str, there: Any, how: dict[str, Any]) -> Any:
        """Return the array `there` of the group, after a check that it is as `how` of `_layout` says.

        Unknown codecs are refused, because reading could run foreign code.
        """
        metadata = there.metadata.to_dict()
        if metadata.get("node_type") != "array":
            raise ValueError(f"its {name!r} is not an array")
        codecs = {codec["name"] for codec in metadata.get("codecs", ())}
        if metadata["zarr_format"] != 3 or not codecs <= CODECS:
            raise ValueError(
                f"its array {name!r} is stored with {', '.join(sorted(codecs - CODECS)) or 'another format'}; "
                f"expected codecs among {', '.join(sorted(CODECS))}"
            )
        shape, chunks = how["shape"], how.get("chunks", there.chunks)
        grows = name in ("event_t", "event_y")
        if there.shape[grows:] != shape[grows:] or there.chunks != chunks:
            raise CheckpointError(
                f"{self.path!r} is damaged: its array {name!r} has the shape {there.shape} in chunks of "
                f"{there.chunks}; expected {shape} in chunks of {chunks}. Use another place for a new ensemble."
            )
        return there

    @contextmanager
    def _written(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise CheckpointError(f"cannot write to {self.path!r}: {error.strerror or error}") from error

    def _require_own(self) -> None:
        """Raise CheckpointError unless the group in the local file system is the one that was opened."""
        if self._lock is None:
            return
        try:
            own = _zarr().open_group(self._place, mode="r", **FORMAT).attrs[LABEL] == self._label
        except (KeyError, ValueError, OSError):
            own = False
        if not own:
            raise CheckpointError(
                f"{self.path!r} is no longer the group that this ensemble writes to: it was replaced or removed. "
                "Nothing more is written there. Start the ensemble again with another out=..."
            )

    def _layout(self, times: np.ndarray) -> dict[str, dict[str, Any]]:
        """Return for each array of the group, by name, the arguments with which it is created."""
        layout: dict[str, dict[str, Any]] = {}

        def array(name: str, dtype: Any, axes: tuple[str, ...], shape: tuple[int, ...], rows: int, chunk: int) -> None:
            chunks = (chunk, *(max(1, size) for size in shape))
            fill = FILLED.get(name, np.nan if np.dtype(dtype).kind in "fc" else np.dtype(dtype).type())
            layout[name] = {"shape": (rows, *shape), "chunks": chunks, "dtype": dtype, "dimension_names": axes}
            layout[name] |= {"fill_value": fill}

        # xarray rejects a two-dimensional array with the name of one of its axes.
        rows = "time" if times.ndim == 1 else "row"
        for name, (field, axes) in ARRAYS.items():
            if "time" not in axes or times.size:
                value = _as_stored(getattr(self._empty, field))
                named = ("member", *(rows if axis == "time" else axis for axis in axes))
                dtype = str if field == "message" else value.dtype
                array(name, dtype, named, value.shape[1:], self._members, self._chunk)
        if times.size:
            axes = ("time",) if times.ndim == 1 else ("member", "row")
            layout[TIMES[times.ndim]] = {"shape": times.shape, "dtype": times.dtype, "dimension_names": axes}
        n, state = self._empty.y.shape[1], self._empty.y.dtype
        if self._events:
            array("event_count", int, ("member", "event"), (self._events,), self._members, self._chunk)
            array("event_t", float, ("happened",), (), 0, EVENTS_IN_A_FILE)
            array("event_y", state, ("happened", "component"), (n,), 0, EVENTS_IN_A_FILE)
        # Values by which the functions of a chunk are identified.
        width = COMPARED + self._empty.target.shape[1]
        chunks = -(-self._members // self._chunk)
        array("known_by", float, ("chunk", "value"), (width,), chunks, 1)
        if self._events:
            array("known_events", float, ("chunk", "event_value"), (AT_ENDS * self._events,), chunks, 1)
        return layout

    def read(self, first: int, last: int) -> Members:
        """Return the results of members `first` to `last` - 1; raise CheckpointError if they are damaged."""
        names = [name for name in ARRAYS if name in self._arrays]
        with self._being_read(f"the results of the members {first} to {last - 1}"):
            found: dict[str, Any] = {ARRAYS[name][0]: _as_stored(self._arrays[name][first:last]) for name in names}
            happened = unflattened(self._flat(first, last))
        found["message"] = [str(text) for text in found["message"]]
        none = Members.empty(last - first, found["y"].shape[1], found["y"].dtype, found["target"].shape[1], 0)
        members = none._replace(**found, happened=happened)
        self._require_states(first, members)
        return members

    def _require_states(self, first: int, members: Members) -> None:
        """Raise CheckpointError if states of a member that did not fail are missing; `first` is the first member.

        Zarr reads a lost file as NaN. A member that an event ended may have NaN in all rows of saved states.
        """
        lost = (members.status >= 0) & np.isnan(members.y).any(axis=1)
        if members.saved.shape[1]:
            lost |= (members.status == 0) & np.isnan(members.saved[:, 0]).any(axis=1)
        if lost.any():
            k = first + int(np.argmax(lost))
            raise CheckpointError(
                f"{self.path!r} is damaged: member {k} is marked as finished, but its states are missing. Restore a "
                "copy of the group, or use another place for a new ensemble."
            )

    @contextmanager
    def _being_read(self, what: str) -> Iterator[None]:
        """Replace an error inside the block, which reads `what`, by a CheckpointError."""
        try:
            yield
        except MemoryError:
            raise
        except Exception as error:  # codecs raise errors of many kinds for files that are cut or overwritten
            raise CheckpointError(
                f"{self.path!r} is damaged: {what} cannot be read: {error}. Restore a copy of the group, or use "
                "another place for a new ensemble."
            ) from error

    def _flat(self, first: int, last: int) -> Flat:
        """Return the events of members `first` to `last` - 1, which are stored after those of preceding members."""
        if not self._events:
            return Flat(np.zeros((last - first, 0), np.int64), np.zeros(0), np.zeros((0, 1)))
        counts = self._arrays["event_count"][:last]
        begin, end = int(counts[:first].sum()), int(counts.sum())
        return Flat(counts[first:], self._arrays["event_t"][begin:end], self._arrays["event_y"][begin:end])

    def _write_events(self, first: int, members: Members) -> None:
        """Write the events of a chunk; they replace those of an incomplete chunk."""
        flat = flattened(members.happened, self._events, members.y.shape[1], members.y.dtype)
        self._arrays["event_count"][first : first + len(members.t)] = flat.counts
        begin = int(self._arrays["event_count"][:first].sum())
        end = begin + flat.t.size
        for name, values in (("event_t", flat.t), ("event_y", flat.y)):
            self._arrays[name].resize((end, *values.shape[1:]))
            if values.size:
                self._arrays[name][begin:end] = values

    def known_by(self, first: int) -> np.ndarray:
        """Return the values stored with the chunk that starts at member `first`, see `Plan.known_by`."""
        names = [name for name in ("known_by", "known_events") if name in self._arrays]
        with self._being_read(f"the values of the functions in chunk {first // self._chunk}"):
            row = np.concatenate([self._arrays[name][first // self._chunk] for name in names])
        return row[~np.isnan(row)]

    def write(
        self, first: int, members: Members, known_by: np.ndarray, whole: Members, statistics: Statistics | None
    ) -> None:
        """Write the results of a chunk that starts at member `first`; `known_by` is the output of `Plan.known_by`."""
        self._require_own()
        with self._written():
            if self._events:
                self._write_events(first, members)
            others = max(0, known_by.size - AT_ENDS * self._events)
            self._arrays["known_by"][first // self._chunk, :others] = known_by[:others]
            if known_by.size and "known_events" in self._arrays:
                self._arrays["known_events"][first // self._chunk] = known_by[others:]
            for name, (field, _) in ARRAYS.items():
                if name in self._arrays:
                    self._arrays[name][first : first + len(members.t)] = _as_stored(getattr(members, field))


class CheckpointStore(_Store):
    """A checkpoint file with the finished members and their statistics, rewritten every `every` seconds.

    `identity` is the output of `Plan.identity`, which must agree when the ensemble is resumed.
    """

    def __init__(self, path: Any, identity: dict[str, Any], resume: bool, every: float) -> None:
        self._identity, self._every = identity, every
        self._waiting: tuple[int, np.ndarray, Members, Statistics | None] | None = None
        self._lock = Lock(path)
        self.path = self._lock.name
        try:
            self._open(resume)
        except BaseException:
            self.close()
            raise
        self._written, self._cost = time.perf_counter(), 0.0

    def _open(self, resume: bool) -> None:
        """Read the existing file, or create one."""
        if not os.path.lexists(self.path):
            checkpoint.write(self.path, {"kind": KIND, **self._identity, "finished": 0}, {})
            return
        if not resume:
            raise checkpoint.existing(self.path, "ensemble")
        self._header, self._arrays = checkpoint.read(self.path, KIND)
        self.finished = int(self._header["finished"])
        needed = [f"members_{name}" for name in Members._fields if name not in LISTS]
        needed += [f"events_{name}" for name in Flat._fields]
        missing = [name for name in needed if name not in self._arrays]
        self._require_same(self._header, self._identity, missing if self.finished else [])
        mark = "statistics_"
        found = {name.removeprefix(mark): a for name, a in self._arrays.items() if name.startswith(mark)}
        self.statistics = Statistics(**found) if found else None

    def read(self, first: int, last: int) -> Members:
        """Return the results of members `first` to `last` - 1."""
        arrays = {name: self._arrays[f"members_{name}"][first:last] for name in Members._fields if name not in LISTS}
        flat = Flat(*(self._arrays[f"events_{name}"] for name in Flat._fields))
        message = expanded(self._header["messages"], first, last)
        return Members(**arrays, message=message, happened=unflattened(flat)[first:last])

    def known_by(self, first: int) -> np.ndarray:
        """Return the values stored with the last chunk, see `Plan.known_by`."""
        return self._arrays["known_by"]

    def write(
        self, first: int, members: Members, known_by: np.ndarray, whole: Members, statistics: Statistics | None
    ) -> None:
        """Record that the chunk that starts at member `first` is finished; write the file if it is time to do so.

        `whole` holds the results of all members, and `statistics` are those of the finished members.
        """
        self._waiting = first + len(members.t), known_by, whole, statistics
        if time.perf_counter() - self._written >= max(self._every, LEAST_RATIO * self._cost):
            self.flush()

    def flush(self) -> None:
        """Write new results; an error, such as a full disk, only causes a warning, and the previous file is kept."""
        if self._waiting is None:
            return
        begin = time.perf_counter()
        done, known_by, whole, statistics = self._waiting
        header = {"kind": KIND, **self._identity, "finished": done, "messages": shortened(whole.message[:done])}
        arrays = {f"members_{name}": getattr(whole, name)[:done] for name in Members._fields if name not in LISTS}
        happened = whole.happened[:done]
        flat = flattened(happened, max(map(len, happened), default=0), whole.y.shape[1], whole.y.dtype)
        arrays |= {f"events_{name}": value for name, value in flat._asdict().items()}
        arrays["known_by"] = known_by
        if statistics is not None:
            arrays |= {f"statistics_{name}": value for name, value in vars(statistics).items()}
        try:
            checkpoint.write(self.path, header, arrays)
        except CheckpointError as error:
            warnings.warn(f"{error}; the previous checkpoint is kept", RuntimeWarning, stacklevel=users_level())
        self._waiting = None
        self._written = time.perf_counter()
        self._cost = self._written - begin


Store = ZarrStore | CheckpointStore


def _as_stored(value: Any) -> np.ndarray:
    """Convert a field of `Members` to an array of the Zarr group, in which time is the last axis, or back."""
    array = np.array(value, dtype=object) if isinstance(value, list) else value
    return array.swapaxes(1, 2) if array.ndim == 3 else array


def is_url(path: str) -> bool:
    """Return True if a path is a URL, not a place in the local file system."""
    return "://" in path


def location(path: str | os.PathLike[str]) -> str:
    """Return the absolute path; a URL is returned unchanged."""
    text = os.fspath(path)
    return text if is_url(text) else absolute(text)


def _zarr() -> Any:
    try:
        import zarr
    except ModuleNotFoundError as error:
        raise ImportError('out= needs zarr: pip install "eip_scipy[zarr]"', name="zarr") from error
    return zarr
