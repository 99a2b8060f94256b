"""Results in files: arrays and JSON in an npz archive, nothing pickled, written as checkpoints are."""

from __future__ import annotations

import os
from importlib import import_module
from typing import Any

import numpy as np
from scipy.optimize import OptimizeResult

from .. import checkpoint
from ..checkpoint import CheckpointError
from ..checkpoint.encoding import decoded, encoded
from ..core.inputs import shown
from .results import IntegrationResult

__all__ = ["load", "save"]

KIND = "result"
ENSEMBLE = "EnsembleResult"
RESUMED = ("integrate", "ensemble")  # functions that continue from a checkpoint if called with the same arguments


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
        If `result` is not such a result, or a field is neither numeric nor representable in JSON. An array with a mask
        or a unit is refused as well, because only its numbers would be saved.
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
    if isinstance(result, IntegrationResult):
        result._observe()
    arrays: dict[str, np.ndarray] = {}
    fields = {name: None if callable(value) else encoded(name, value, arrays) for name, value in result.items()}
    checkpoint.write(path, {"kind": KIND, "class": type(result).__name__, "fields": fields}, arrays)


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
    name = repr(os.fspath(path))
    try:
        header, arrays = checkpoint.read(path)
    except CheckpointError as error:
        if isinstance(error.__cause__, OSError):
            raise error.__cause__ from None
        raise ValueError(f"load: {name} is not a result written by save of this version: {error}") from error
    if (kind := header.get("kind")) != KIND:
        again = f"; {kind}(..., checkpoint={name}, resume=True) continues it" if kind in RESUMED else ""
        raise ValueError(f"load: {name} is not a result written by save, but a checkpoint of {kind!r}{again}.")
    fields = {field: decoded(value, arrays) for field, value in header["fields"].items()}
    if header["class"] == ENSEMBLE:  # imported by name, because ensembles are built on runs
        return getattr(import_module(f"{__package__.rpartition('.')[0]}.ensembles.ensemble"), ENSEMBLE)(fields)
    return (IntegrationResult if header["class"] == IntegrationResult.__name__ else OptimizeResult)(fields)
