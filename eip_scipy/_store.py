"""Ensembles on disk: a Zarr group that grows chunk by chunk, and from which a run goes on."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from ._members import NOT_RUN, Members

__all__ = ["ZarrStore"]

SCHEMA = 1
LABEL = "eip_scipy_ensemble"


class ZarrStore:
    """A group of arrays whose first axis is the member, one Zarr chunk for each chunk of the ensemble.

    The status of a chunk's members is written last: where it is, the chunk is whole. (Zarr puts each file in its place
    by renaming it.)

    Parameters
    ----------
    path : path-like
    header : dict
        What makes two ensembles the same; numbers and texts.
    empty : Members
        One chunk's room, for shapes and types.
    times : ndarray, shape (m,)
    members, chunk : int
    resume : bool

    Raises
    ------
    ImportError
        Without zarr.
    FileExistsError
        When there is something at `path` and `resume` is false.
    ValueError
        When it is no such group, or that of another ensemble.
    """

    def __init__(
        self,
        path: Any,
        header: dict[str, Any],
        empty: Members,
        times: np.ndarray,
        members: int,
        chunk: int,
        resume: bool,
    ) -> None:
        self.path, self._members, self._chunk = Path(path), members, chunk
        zarr = _zarr()
        if self.path.exists():
            if not resume:
                raise FileExistsError(f"{self.path} exists; pass resume=True to go on with it, or remove it.")
            if self._opened(zarr, header):
                return
        self._group = zarr.open_group(self.path, mode="w", zarr_format=3, attributes={LABEL: None})
        self._create(header, empty, times)

    def _opened(self, zarr: Any, header: dict[str, Any]) -> bool:
        """Go on with what is there; False where it was left before it was whole."""
        try:
            group = zarr.open_group(self.path, mode="r+")
            found = group.attrs[LABEL]
        except (KeyError, FileNotFoundError, ValueError, OSError) as error:
            raise ValueError(f"{self.path} is no ensemble of eip_scipy that could be resumed ({error}).") from None
        if found is None:
            shutil.rmtree(self.path)
            return False
        for name, value in header.items():
            if found.get(name) != value:
                raise ValueError(
                    f"{self.path} belongs to another ensemble: its {name} is {found.get(name)!r}, here {value!r}. "
                    "Resume with the same arguments, or write to another place."
                )
        self._group = group
        return True

    def _create(self, header: dict[str, Any], empty: Members, times: np.ndarray) -> None:
        n = empty.y.shape[1]
        self._make("y", empty.y.dtype, ("member", "component"), (n,))
        if times.size:
            self._make("states", empty.y.dtype, ("member", "component", "time"), (n, times.size))
            self._group.create_array("time", data=times, dimension_names=("time",))
        self._make("t_end", np.dtype(float), ("member",))
        self._make("max_defect", np.dtype(float), ("member", "invariant"), empty.max_defect.shape[1:])
        self._make("max_correction", np.dtype(float), ("member",))
        self._make("counters", np.dtype(np.int64), ("member", "counter"), empty.counters.shape[1:], fill=0)
        self._make("message", str, ("member",), fill="")
        self._make("status", np.dtype(np.int64), ("member",), fill=NOT_RUN)
        # Last: a group without it was left before it was whole.
        self._group.attrs[LABEL] = {"schema": SCHEMA, **header}

    def _make(
        self, name: str, dtype: Any, axes: tuple[str, ...], shape: tuple[int, ...] = (), fill: Any = np.nan
    ) -> None:
        chunks = (self._chunk, *(max(1, size) for size in shape))
        self._group.create_array(
            name, shape=(self._members, *shape), chunks=chunks, dtype=dtype, fill_value=fill, dimension_names=axes
        )

    @property
    def finished(self) -> int:
        """Members whose results are there; whole chunks, from the first one on."""
        missing = np.flatnonzero(self._group["status"][:] == NOT_RUN)
        return self._members if not missing.size else int(missing[0]) // self._chunk * self._chunk

    @property
    def states(self) -> Any:
        """The saved states (members, n, times), as a Zarr array, or None."""
        return self._group.get("states", None)

    def read(self, first: int, last: int) -> Members:
        """Results of members `first` to `last`."""
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
            saved=group["states"][place].swapaxes(1, 2) if "states" in group else none,
        )

    def write(self, first: int, members: Members) -> None:
        """Results of a chunk of members that starts at number `first`."""
        group, place = self._group, slice(first, first + len(members.t))
        group["y"][place] = members.y
        group["t_end"][place] = members.t
        group["max_defect"][place] = members.max_defect
        group["counters"][place] = members.counters
        group["max_correction"][place] = members.max_correction
        if "states" in group:
            group["states"][place] = members.saved.swapaxes(1, 2)
        group["message"][place] = np.array(members.message, dtype=object)
        group["status"][place] = members.status


def _zarr() -> Any:
    try:
        import zarr
    except ModuleNotFoundError as error:
        raise ImportError('out= needs zarr: pip install "eip_scipy[zarr]"', name="zarr") from error
    return zarr
