"""Results in files: arrays and JSON in an npz archive, nothing pickled, written as checkpoints are."""

from __future__ import annotations

import os
from importlib import import_module
from typing import Any

import numpy as np
from scipy.optimize import OptimizeResult

from .. import checkpoint
from ..checkpoint import CheckpointError
from ..core.inputs import shown
from ..core.results import Diagnostics
from ..engine.trust import Trust
from .results import IntegrationResult

__all__ = ["load", "save"]

KIND = "result"
ENSEMBLE = "EnsembleResult"
RESULTS: dict[str, Any] = {IntegrationResult.__name__: IntegrationResult}
RESUMED = ("integrate", "ensemble")  # functions that continue from a checkpoint if called with the same arguments
# Buffers of Diagnostics, in the order of its arguments.
BUFFERS = ("_max_residual", "_last_residual", "_max_correction", "_counters", "_figures")
OF_BALANCES = ("_balance_places", "_balance_sums")


def save(result: Any, path: str | os.PathLike[str]) -> None:
    """Write a result to a file that `load` reads.

    Parameters
    ----------
    result : IntegrationResult, EnsembleResult or OdeResult
        Result of `integrate`, `ensemble` or `scipy.integrate.solve_ivp`. All fields are saved, including those that
        were added later, except functions: ``sol``, and the functions of the run.
    path : path-like
        File to write, with any name; an existing file is replaced in one step when the new one is complete. The file is
        an npz archive, which `numpy.load` can open, with ``header.json`` for everything that is not an array.

    Raises
    ------
    TypeError
        If `result` is not such a result, or a field is neither numeric nor representable in JSON.
    CheckpointError
        If the file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from eip_scipy import EIPRK4, integrate, load
    >>> from eip_scipy.problems import kepler
    >>> run = integrate(kepler(), (0, 10), method=EIPRK4, save_every=10)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     run.save(f"{folder}/kepler.npz")
    ...     again = load(f"{folder}/kepler.npz")
    >>> bool((again.y == run.y).all()), again.message
    (True, 'reached the end of the interval')
    """
    if not isinstance(result, OptimizeResult):
        raise TypeError(f"save: expected a result of integrate, ensemble or solve_ivp, got {shown(result)}.")
    arrays: dict[str, np.ndarray] = {}
    values: dict[str, Any] = {}
    lists: dict[str, int] = {}
    described: dict[str, Any] | None = None
    packed = getattr(result, "_packed", None)  # a result that holds more than arrays and numbers has it
    for name, value in (result if packed is None else packed()).items():
        if isinstance(value, Diagnostics):
            described = _described(value, arrays)
        elif isinstance(value, np.ndarray):
            arrays[name] = _numbers(name, value)
        elif isinstance(value, list) and value and all(isinstance(item, np.ndarray) for item in value):
            lists[name] = len(value)
            arrays |= {f"{name}.{k}": _numbers(name, item) for k, item in enumerate(value)}
        else:
            values[name] = None if callable(value) else _plain(name, value)
    header = {"kind": KIND, "class": type(result).__name__, "values": values, "lists": lists, "diagnostics": described}
    checkpoint.write(path, header, arrays)


def load(path: str | os.PathLike[str]) -> Any:
    """Read a result that `save` has written.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    IntegrationResult or EnsembleResult
        The saved result without functions: ``sol`` is None, and `IntegrationResult.continue_to` raises an error that
        says how to continue. A result of `solve_ivp` is returned as `scipy.optimize.OptimizeResult`, its base class.

    Raises
    ------
    OSError
        If the file cannot be read, for instance because it does not exist.
    ValueError
        If the file was not written by `save`, or is damaged.

    Examples
    --------
    >>> from eip_scipy import load
    >>> run = load("kepler.npz")  # doctest: +SKIP
    """
    try:
        header, arrays = checkpoint.read(path)
    except CheckpointError as error:
        if isinstance(error.__cause__, OSError):
            raise error.__cause__ from None
        raise ValueError(
            f"load: {os.fspath(path)!r} is not a result written by save of this version: {error}"
        ) from error
    if (kind := header.get("kind")) != KIND:
        name = repr(os.fspath(path))
        again = f"; {kind}(..., checkpoint={name}, resume=True) continues it" if kind in RESUMED else ""
        raise ValueError(f"load: {name} is not a result written by save, but a checkpoint of {kind!r}{again}.")
    made = RESULTS.get(header["class"], OptimizeResult)
    if header["class"] == ENSEMBLE:  # by name: ensembles are built on runs
        made = getattr(import_module(f"{__package__.rpartition('.')[0]}.ensembles.ensemble"), ENSEMBLE)
    result = made(header["values"])
    for name, length in header["lists"].items():
        result[name] = [arrays.pop(f"{name}.{k}") for k in range(length)]
    if header["diagnostics"] is not None:
        result["diagnostics"] = _diagnostics(header["diagnostics"], arrays)
    result.update(arrays)
    if header["class"] != ENSEMBLE:
        for name in ("component_names", "epoch"):
            if result.get(name) is not None:
                result[name] = tuple(result[name])
    return made._unpacked(result) if hasattr(made, "_unpacked") else result


def _described(diagnostics: Diagnostics, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    """Return the part of `diagnostics` that JSON can hold; the other part is added to `arrays`."""
    trust = diagnostics._trust
    buffers = (diagnostics.max_residual, diagnostics._residual, diagnostics._max_correction, diagnostics._counters)
    arrays |= zip(BUFFERS, (*buffers, trust.figures), strict=True)
    if diagnostics._slow[0].size:
        arrays |= zip(OF_BALANCES, diagnostics._slow, strict=True)
    return {
        "names": list(trust.names),
        "doubts": trust.doubts,
        "failed": bool(trust.failed),
        "estimated": bool(diagnostics._estimated),
        "moved": diagnostics.moved,
    }


def _diagnostics(described: dict[str, Any], arrays: dict[str, np.ndarray]) -> Diagnostics:
    largest, last, correction, counters, figures = (arrays.pop(name) for name in BUFFERS)
    trust = Trust(described["names"], figures)
    trust.doubts, trust.failed = described["doubts"], described["failed"]
    slow = (arrays.pop(OF_BALANCES[0]), arrays.pop(OF_BALANCES[1])) if OF_BALANCES[0] in arrays else None
    diagnostics = Diagnostics()
    estimated, moved = described["estimated"], described["moved"]
    diagnostics._attach(largest, last, correction, counters, trust, estimated=estimated, moved=moved, slow=slow)
    return diagnostics


def _numbers(name: str, array: np.ndarray) -> np.ndarray:
    if array.dtype.kind not in "biufc":
        raise TypeError(f"save: the field {name!r} has dtype {array.dtype}, expected numbers. Delete it or convert it.")
    return array


def _plain(name: str, value: Any) -> Any:
    """Return the value of a field in a form that JSON can hold; raise TypeError if it has none."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, dict):
        return {str(key): _plain(f"{name}[{key!r}]", item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(name, item) for item in value]
    if value is None or isinstance(value, (str, bool, int)) or (isinstance(value, float) and np.isfinite(value)):
        return value
    raise TypeError(f"save: the field {name!r} is {shown(value)}, which cannot be saved. Delete it or convert it.")
