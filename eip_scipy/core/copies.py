"""Copies of solvers in the middle of a run, in memory or by pickle, which continue with bit-identical results.

The engine and the objects that call the user's functions are made again; all values that steps change are copied.
"""

from __future__ import annotations

import copy
from dataclasses import fields
from typing import Any

from scipy.integrate import OdeSolver

from ..engine.trust import Trust
from . import steppers
from .invariants import InvariantSet
from .runs import Run

__all__ = ["parts_of", "run_of", "scipy_values", "set_scipy_values"]

BOUND = ("tableau", "work", "invariants", "trust")


def parts_of(run: Run) -> dict[str, Any]:
    """Return the values and arrays, by name, from which `run_of` makes a run again, apart from the invariants.

    These are fields of the run, a copy of its buffers, and attributes of its `Trust`. If a solver of SciPy makes the
    steps, the attributes of that solver are among them. A user-defined one-step method is not.
    """
    values = {item.name: getattr(run, item.name) for item in fields(run) if item.name not in BOUND}
    values["options"] = run.options._replace(joint=None)
    if run.tableau.in_python:
        values["method"] = run.method.state() if run.tableau.drives else None
    return values | {"work": copy.deepcopy(run.work), "doubts": list(run.trust.doubts), "failed": run.trust.failed}


def run_of(parts: dict[str, Any], invariants: InvariantSet, method: Any, *, joint: bool) -> Run:
    """Return a run made from its parts, with copies of their buffers.

    `invariants` is a new set of the same invariants, made at the same start. `joint` is True if the run projects
    `JointInvariants` with their functions `moments` and `shift`.
    """
    values = copy.deepcopy(parts)
    if method.in_python:
        values["method"] = steppers.arrays(method)
    if joint:
        values["options"] = values["options"]._replace(joint=invariants.items)
    invariants.target = values["options"].target  # those of balances change
    trust = Trust(invariants.names, values["work"].trust)
    trust.doubts, trust.failed = values.pop("doubts"), values.pop("failed")
    return Run(**values, tableau=method, invariants=invariants, trust=trust)


def scipy_values(solver: OdeSolver) -> dict[str, Any]:
    """Return the attributes of a solver of SciPy that are not callable, by name."""
    return {name: value for name, value in vars(solver).items() if not callable(value)}


def set_scipy_values(solver: OdeSolver, values: dict[str, Any]) -> None:
    """Set attributes of a solver of SciPy to the values that `scipy_values` returned.

    Arrays whose names begin with K, the stages, are filled in place, because K may be a view of another array.
    """
    for name, value in values.items():
        if name.startswith("K"):
            getattr(solver, name)[...] = value
        else:
            setattr(solver, name, value)
