"""Members of an ensemble side by side: buffers, starts and ends of batches, and those members that leave one.

See `vector_step` for the loop. A member that leaves is taken to the next point of meeting by the driver of single
runs, and comes back there.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numba import typeof, types

from ..core import setup
from ..core.compiled_functions import CompiledFunctions, compile_functions, signatures_of_batches, with_inlined
from ..core.jitted import NotCompilableError
from ..core.options import Options
from ..core.stepping import UNBOUNDED
from ..engine.caching import cached_njit
from ..engine.counters import FOUND, LAST_RANK, N_COUNTERS, NFEV, NLU, PROJECTIONS, RANK_REDUCED, SKIPPED
from ..engine.data import AUTO, NEW, OK, PENDING, ROW, STEP, TIME, Schedule
from ..engine.octets import LANES
from ..engine.trust import EXPECTED, START, SUM, TERMS, TOGETHER
from ..run.integrate import Loop
from .vector_step import finish_batch, make_advance_batch, make_lanes, make_lanes_work

__all__ = ["Batch", "Ended", "can_run", "lanes_of"]

FEW_FLOATS = 128  # in a state of all lanes: more lanes for small systems, as the loop itself takes its time
MOST_LANES = 32
# Steps from one meeting to the next: longer while none leaves, never longer than some tenths of a second.
FIRST_MEETING, LEAST_MEETING = 32, 32
MEETING_SECONDS = 0.1


def source_stamp(*names: str) -> str:
    """Hash of all source that goes into the loop, as Numba looks only at the file of the function itself."""
    folder = Path(__file__).parents[1]
    engine = ("octets", "sums", "triples", "trust", "data", "kernels", "step")
    names = (*(f"engine/{name}.py" for name in engine), *names)
    return hashlib.sha256(b"".join((folder / name).read_bytes() for name in names)).hexdigest()


def compiled_for_octets(loop: Loop) -> CompiledFunctions:
    """The functions of a run for vectors of members."""
    system, run = loop.prepared.system, loop.prepared.run
    extra, dtype = bool(system.extra), run.y0.dtype
    return compile_functions(system.fun, system.form, extra, run.invariants, (), dtype, in_octets=True)


advance_batch = make_advance_batch(source_stamp("ensembles/vector_step.py"))


@cache
def _compiled(arguments: tuple[Any, ...]) -> Callable[..., int]:
    """The loop compiled, its callables as first-class functions: cached on disk."""
    functions = [types.FunctionType(s) for s in signatures_of_batches()]
    signature = types.int64(*functions, *arguments)
    whole = with_inlined(advance_batch, finish_batch)
    return cached_njit([signature], error_model="numpy", nogil=True, _nrt=False)(whole)


def lanes_of(n: int) -> int:
    """Members side by side, of n components each."""
    return LANES * max(1, min(MOST_LANES, FEW_FLOATS // n) // LANES)


class Ended(NamedTuple):
    """A member at its end, or where it failed (`reason`: why, "" where it did not)."""

    y: np.ndarray
    t: float
    max_defect: np.ndarray
    max_correction: float
    counters: np.ndarray
    reason: str


def can_run(options: Options, schedule: Schedule, dtype: np.dtype) -> bool:
    """Whether members with these options take the same fixed steps, and a projection that a batch has."""
    steps = not options.adaptive and schedule.span.n_steps < UNBOUNDED and np.dtype(dtype).kind != "c"
    steps = steps and not (schedule.t_eval.size or schedule.g.size)
    projection = options.iterations == 1 and options.direction == NEW and options.every != AUTO
    return steps and projection and not options.compensated


class Batch:
    """Buffers for some members at once, beside the driver `loop` of single runs.

    Attributes
    ----------
    lanes : int
        Members that it takes.

    Raises
    ------
    NotCompilableError
        Where the options ask for steps of each member's own, or a function branches on values, makes arrays, or does
        something else that octets cannot.
    """

    def __init__(self, loop: Loop) -> None:
        driver = loop.driver
        run, span = driver.run, driver.schedule.span
        if not can_run(run.options, driver.schedule, run.y0.dtype):
            raise NotCompilableError("members with these options run one by one")
        self.functions = compiled_for_octets(loop)
        self.loop, self.span = loop, span
        n, rows = run.y0.size, run.invariants.size
        self.lanes = lanes = lanes_of(n)
        o = run.options
        self._work = make_lanes_work(n, lanes, run.method.b.size, rows)
        self._s = make_lanes(self._work, o.rtol, o.block_atol.size, o.frame.products.size)
        self._options = o._replace(rtol=np.repeat(o.rtol, lanes), atol=np.repeat(o.atol, lanes))
        self._sigma = run.work.sigma.copy()
        self._y, self._new = np.zeros((n, lanes)), np.zeros((n, lanes))
        self._params = np.zeros((driver.params.size, lanes))
        # Counters of what a member has done so far are those of the batch, less `_joined`, plus `_own`.
        self._own, self._joined = np.zeros((2, N_COUNTERS, lanes), np.int64)
        self._failed: dict[int, Ended] = {}
        self._advance: Callable[..., int] | None = None
        self._length = FIRST_MEETING
        self._rows = driver.y.copy()
        self._single_work = [a for a in run.work if isinstance(a, np.ndarray)] + list(run.work.inner)
        self._fresh = [a.copy() for a in self._single_work]

    def run(
        self,
        y0s: np.ndarray,
        params: np.ndarray,
        evaluations: int,
        meetings: list[int],
        save: Callable[[int, np.ndarray], None],
        watch: Callable[[], None],
    ) -> list[Ended | None]:
        """Run up to `sums` members; None for one that is to run alone.

        These are members whose start is not finite in some part, and those of whom something stands out.
        `meetings` are the steps (the last one at the end) at which ``save(row, states (m, n))`` is called; `watch` is
        called now and then.
        """
        m = len(y0s)
        sound = self._start(y0s, params, evaluations)
        k, length = 0, self._length
        for row, stop in enumerate(meetings):
            while k < stop:
                watch()
                end, begin = min(stop, k + length), time.perf_counter()
                left = self._steps(k, end, params)
                seconds = time.perf_counter() - begin
                if left or seconds > 2 * MEETING_SECONDS:
                    length = max(LEAST_MEETING if left else 1, length // 2)
                elif seconds < MEETING_SECONDS and end - k == length:
                    length *= 2
                k = end
            save(row, self._states()[:m])
        self._length = length
        alone = ~sound | self._suspect()
        return [None if alone[lane] else self._ended(lane) for lane in range(m)]

    def _suspect(self) -> np.ndarray:
        """Members whose corrections stand out, singly or in their sum."""
        s = self._s
        together = s.trust[:, SUM] > TOGETHER * s.trust[:, EXPECTED]
        return (s.suspect[0] > 0) | together.any(axis=0)

    def compile(self) -> None:
        """What the first run would compile."""
        self._steps(0, 0, np.zeros((0, self._params.shape[0])))

    def _start(self, y0s: np.ndarray, params: np.ndarray, evaluations: int) -> np.ndarray:
        """Everything as at the start; returns which members are sound."""
        w, s, m = self._work, self._s, len(y0s)
        for a in (w.K, w.err_sum, w.counters, s.max_defect, s.max_correction, s.projections, s.skips, s.reduced):
            a[...] = 0
        s.sigma[:] = self._sigma[:, None]
        s.left.step[:] = -1
        self._own[:], self._joined[:] = 0, 0
        self._failed.clear()
        # Lanes to spare repeat the last member.
        members = np.minimum(np.arange(self.lanes), m - 1)
        self._y[:] = y0s[members].T
        self._params[:] = params[members].T
        t0 = self.span.t0
        self.functions.rhs(t0, self._y, w.K[0], self._params)
        self.functions.inv(t0, self._y, s.target, self._params)
        self.functions.grad(t0, self._y, w.K[0], w.G, self._params)
        w.counters[NFEV] = evaluations
        parts = (self._y, w.K[0], s.target, w.G.reshape(-1, self.lanes))
        sound = np.logical_and.reduce([np.isfinite(part).all(axis=0) for part in parts])
        self._start_figures()
        s.alive[0] = sound
        s.alive[0, m:] = 0.0
        return sound

    def _start_figures(self) -> None:
        """What `start_figures` does for one member."""
        w, s = self._work, self._s
        moved = abs(self.span.h) * np.sum(np.abs(w.G * w.K[0]), axis=1)
        sums = np.sum(np.abs(w.G * self._y), axis=1), moved, np.abs(s.target)
        terms = np.maximum(np.max(sums, axis=0), self._options.scales[:, None])
        s.trust[:] = 0.0
        s.suspect[:] = 0.0
        s.trust[:, START] = np.where(np.isfinite(terms), terms, 0.0)
        s.trust[:, TERMS] = np.where(terms > 0, terms, np.inf)

    def _steps(self, k: int, end: int, params: np.ndarray) -> bool:
        """All members from step k to `end`; returns whether some had to leave."""
        y, new = self._y, self._new
        arguments = (
            *(self._params, self.span, k, end, self.loop.driver.run.method, self._options, self._work, self._s),
            *(y, y.reshape(-1), new, new.reshape(-1)),
        )
        functions = self.functions
        if self._advance is None:
            self._advance = _compiled(tuple(typeof(a) for a in arguments))
        self._advance(functions.rhs, functions.inv, functions.grad, *arguments)
        those = np.flatnonzero(self._s.left.step >= 0)
        for lane in those:
            self._alone(int(lane), end, params[lane])
        return those.size > 0

    def _counters(self, lane: int, shared: np.ndarray) -> np.ndarray:
        """What one member's counters are, those of the batch being `shared`."""
        s = self._s
        out = self._own[:, lane] + shared - self._joined[:, lane]
        projections = int(s.projections[0, lane])
        out[PROJECTIONS] += projections
        out[NLU] += projections
        out[SKIPPED] += int(s.skips[0, lane])
        out[RANK_REDUCED] += int(s.reduced[0, lane])
        out[LAST_RANK] = int(s.rank[0, lane])
        return out

    def _alone(self, lane: int, end: int, params: np.ndarray) -> None:
        """A member that left: by the driver of single runs to step `end`, and back into its lane."""
        s, left, driver = self._s, self._s.left, self.loop.driver
        w, schedule = driver.run.work, driver.schedule
        for a, fresh in zip(self._single_work, self._fresh, strict=True):
            a[...] = fresh
        driver.state[:], w.K[0], w.err_sum[:] = left.y[:, lane], left.f[:, lane], left.err_sum[:, lane]
        driver.params[:] = params
        driver.y = self._rows
        driver.run.options.target[:] = s.target[:, lane]
        w.max_defect[:], w.max_correction[0] = s.max_defect[:, lane], s.max_correction[0, lane]
        w.counters[:] = self._counters(lane, left.counters[:, lane])
        w.trust[:] = s.trust[:, :, lane]
        k = int(left.step[lane])
        schedule.place[STEP], schedule.place[ROW], schedule.place[PENDING] = k, 0, 0
        schedule.clock[TIME] = schedule.span.t0 + k * schedule.span.h
        try:
            code = driver.advance(end)
            reason = "" if code == OK else setup.failure(code, driver.run, schedule.clock)
        except Exception as error:
            reason = f"{type(error).__name__}: {error}"
        left.step[lane] = -1
        if reason:
            t, y = driver.now
            state = y.copy(), t, w.max_defect.copy(), float(w.max_correction[0]), w.counters.copy()
            self._failed[lane] = Ended(*state, reason)
            return
        self._y[:, lane], self._work.K[0, :, lane] = driver.state, w.K[0]
        self._work.err_sum.reshape(-1, self.lanes)[:, lane] = w.err_sum
        s.max_defect[:, lane], s.max_correction[0, lane] = w.max_defect, w.max_correction[0]
        s.trust[:, :, lane], s.suspect[0, lane] = w.trust, max(s.suspect[0, lane], float(w.counters[FOUND]))
        s.projections[0, lane] = s.skips[0, lane] = s.reduced[0, lane] = 0.0
        self._own[:, lane], self._joined[:, lane] = w.counters, self._work.counters
        s.alive[0, lane] = 1.0

    def _states(self) -> np.ndarray:
        """The states now, (lanes, n); NaN for members that failed."""
        states = self._y.T.copy()
        states[list(self._failed)] = np.nan
        return states

    def _ended(self, lane: int) -> Ended:
        if lane in self._failed:
            return self._failed[lane]
        s = self._s
        return Ended(
            self._y[:, lane].copy(),
            self.span.t_bound,
            s.max_defect[:, lane].copy(),
            float(s.max_correction[0, lane]),
            self._counters(lane, self._work.counters),
            "",
        )
