"""The step and its loop as Numba compiles them, for members of an ensemble."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numba import typeof, types

from ..core.compiled_functions import CompiledFunctions, compile_functions, signatures, with_inlined
from ..engine import kernels as kn
from ..engine.caching import cached_njit
from ..engine.data import FULL, OK, PAUSE, PENDING, ROW, STEP, TIME, TIME_NEW
from ..engine.step import finish_step, next_step
from ..run.integrate import Loop

__all__ = ["NumbaDriver", "compiled_by_numba", "source_stamp"]


def source_stamp(*names: str) -> str:
    """Hash of all source that goes into a compiled driver, that of the files `names` too.

    Numba's cache on disk looks only at the file of the function itself: without this, an upgraded or edited kernel
    would leave the old driver, with the old kernel inlined, in use.
    """
    folder = Path(__file__).parents[1]
    engine = ("octets", "sums", "triples", "trust", "data", "kernels", "step")
    names = (*(f"engine/{name}.py" for name in engine), *names)
    return hashlib.sha256(b"".join((folder / name).read_bytes() for name in names)).hexdigest()


def make_advance(stamp):
    """The loop over steps; `stamp` enters the key of its cache."""

    def advance(rhs, inv, grad, event, params, schedule, k_end, m, o, w, y, y_r, y_new, y_new_r, t_saved, y_saved):
        """Steps up to `k_end`; the loop of the engine. Returns OK or why it stopped."""
        _ = stamp
        place, clock = schedule.place, schedule.clock
        while True:
            if place[PENDING] == 1:
                clock[TIME] = clock[TIME_NEW]
                kn.copy(w.K_r[-1], w.K_r[0])
                kn.copy(y_new_r, y_r)
                kn.copy(schedule.g_new, schedule.g)
                place[PENDING] = 0
            k = place[STEP]
            if clock[TIME] == schedule.span.t_bound or k >= k_end:
                return OK
            if place[ROW] + 2 > t_saved.size:
                return FULL
            status = next_step(
                finish_step, rhs, inv, grad, params, clock, k, schedule.span, m, o, w, y, y_r, y_new, y_new_r
            )
            if status != OK:
                return status
            place[STEP] = k + 1
            place[PENDING] = 1
            t_new = clock[TIME_NEW]
            saved = t_new == schedule.span.t_bound or (schedule.save_every > 0 and (k + 1) % schedule.save_every == 0)
            if schedule.t_eval.size == 0 and saved:
                t_saved[place[ROW]] = t_new
                kn.copy(y_new_r, y_saved[place[ROW]])
                place[ROW] += 1
            if schedule.g.size > 0:
                event(t_new, y_new, schedule.g_new, params)
                if kn.crossed(schedule.g, schedule.g_new, schedule.g_direction):
                    return PAUSE
            if place[ROW] < schedule.t_eval.size and schedule.span.sign * (schedule.t_eval[place[ROW]] - t_new) <= 0.0:
                return PAUSE

    return advance


advance = make_advance(source_stamp("ensembles/numba_driver.py"))


@cache
def _compiled_advance(dtype: np.dtype, arguments: tuple[Any, ...]) -> Callable[..., int]:
    """The driver compiled for one type of state, its callables as first-class functions: cached on disk."""
    rhs, inv, grad = signatures(dtype)
    functions = [types.FunctionType(s) for s in (rhs, inv, grad, inv)]
    signature = types.int64(*functions, *arguments)
    whole = with_inlined(advance, next_step, finish_step)
    return cached_njit([signature], error_model="numpy", nogil=True, _nrt=False)(whole)


def compiled_by_numba(loop: Loop, *, in_octets: bool = False) -> CompiledFunctions:
    """The functions of a run, or with `in_octets` those for vectors of members."""
    system, run = loop.prepared.system, loop.prepared.run
    events = () if in_octets else tuple(system.events.functions)
    extra, dtype = bool(system.extra), run.y0.dtype
    return compile_functions(system.fun, system.form, extra, run.invariants, events, dtype, in_octets=in_octets)


class NumbaDriver:
    """The loop compiled for a run, on the buffers of its driver.

    Attributes
    ----------
    functions : CompiledFunctions
    tail : tuple
        Its arguments from the method to the new state.
    advance : callable
    """

    def __init__(self, loop: Loop) -> None:
        driver = loop.driver
        run, state, new = driver.run, driver.state, driver.new
        self.functions = compiled_by_numba(loop)
        options = run.options._replace(joint=None)
        self.tail = run.method, options, run.work, state, state.view(float), new, new.view(float)
        arguments = (driver.params, driver.schedule, 0, *self.tail, driver.t, driver.y.view(float))
        self.advance: Any = _compiled_advance(run.y0.dtype, tuple(typeof(a) for a in arguments))
