"""Vectorised members of an ensemble, in batches of eight: the conditions, and the functions for a batch."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..core.functions import CompiledFunction, NotCompilableError, PointerFunction
from ..core.options import Options
from ..core.stepping import UNBOUNDED
from ..engine.data import AUTO, NEW, Multistep, Schedule
from ..engine.native import LibraryFunction, NativeFunctions, OctetFunctions

__all__ = ["LANES", "need_compiling", "octet_functions", "why_one_by_one"]

LANES = 8
NAMES = ("rhs", "inv", "grad", "jacobian")  # the functions of a run


def why_one_by_one(history: Multistep | None, options: Options, schedule: Schedule, dtype: np.dtype) -> str:
    """Return the reason why members with these options cannot be vectorised; "" if they can."""
    reasons = {
        "steps are adaptive": options.adaptive,
        "the interval is infinite": schedule.span.n_steps >= UNBOUNDED,
        "the state is complex": np.dtype(dtype).kind == "c",
        "events may end members at different times": schedule.g.size > 0,
        "the run has fewer steps than the history of the method": history is not None and history.brief,
        "compensated=True": history is None and options.compensated,
        "every='auto'": history is None and options.every == AUTO,
        "iterations > 1": options.iterations > 1,
        "direction is not 'new'": options.direction != NEW,
    }
    return next((reason for reason, holds in reasons.items() if holds), "")


def octet_functions(functions: NativeFunctions) -> OctetFunctions:
    """Return the functions of a run for a batch of eight members; raise NotCompilableError if one has no version."""
    rhs, inv, grad, jacobian = ([_of_eight(one) for one in functions.keepalive.get(name, [])] for name in NAMES)
    moved = jacobian[0][0] if jacobian else None
    return OctetFunctions(rhs[0][0], tuple(inv), tuple(grad), functions, moved)


def need_compiling(functions: NativeFunctions) -> bool:
    """Return True if some functions are Numba functions, which must be compiled again for eight members."""
    return any(
        not isinstance(native.function, (PointerFunction, LibraryFunction))
        for name in NAMES
        for native in functions.keepalive.get(name, [])
    )


def _of_eight(native: CompiledFunction) -> tuple[Any, int]:
    """Return the version of a function for eight members, and the number of floats that it fills for each member."""
    one = native.function
    if one is None:
        raise NotCompilableError("the gradient of an invariant is computed by differences")
    if isinstance(one, LibraryFunction):
        if not one.octet_address:
            raise NotCompilableError(f"{one.__name__} of this package is written for one member at a time")
        return one, native.floats
    if isinstance(one, PointerFunction):
        raise NotCompilableError(f"{one.name} is a C function, which is called for one member at a time")
    from ..core.numba_bridge import compiled  # both load Numba
    from .octets.type import OCTET

    # An array of n floats becomes (n, 8) doubles. The function must not branch on values or create arrays.
    return compiled(one.fun, one.kind, one.name, OCTET).address, native.floats
