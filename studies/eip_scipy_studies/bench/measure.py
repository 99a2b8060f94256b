"""Measurement of the bench: each solver in a process of its own, from loose to tight settings."""

from __future__ import annotations

import math
import multiprocessing
import os
import warnings
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from time import process_time
from typing import Any, NamedTuple

import numpy as np

from .cases import CASES
from .solvers import SOLVERS, Solver

LEVELS = (1e-6, 1e-9)
TOLERANCES = tuple(10.0 ** -(0.5 * k) for k in range(8, 28))
FINER = 1.25  # ratio of successive numbers of steps
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


class Run(NamedTuple):
    """One setting of a solver: least processor time of a whole call in seconds, and the error at the end."""

    case: str
    solver: str
    setting: float
    seconds: float
    error: float


class Measured(NamedTuple):
    """All runs of a solver on a case; `compilation` is how much longer the first call took; `said` an error, or ""."""

    case: str
    solver: str
    version: str
    compilation: float
    runs: list[Run]
    said: str


def settings(solver: Solver, steps: int) -> Iterator[Any]:
    """Yield tolerances, or numbers of steps."""
    if solver.steps:
        yield from (round(steps * FINER**k / 2) for k in range(20))
    else:
        yield from TOLERANCES


def measure(case_name: str, solver_name: str, enough: float, patience: float) -> Measured:
    """Run a solver with finer and finer settings, until its error is below all of `LEVELS` or a call takes too long.

    `enough` are the seconds after which a setting is not run again, `patience` those of a call after which no finer
    setting follows.
    """
    case = CASES[case_name]
    (solver,) = (each for each in SOLVERS if each.name == solver_name)
    runs: list[Run] = []
    compilation, said = math.nan, ""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            begin = process_time()
            solve = solver.prepare(case)
            prepared = process_time() - begin
            for setting in settings(solver, case.steps.get(solver.steps, 0)):
                try:
                    if not runs or solver.warm:
                        begin = process_time()
                        solve(setting)
                        first = process_time() - begin
                    seconds, y = least(partial(solve, setting), enough)
                except (RuntimeError, ValueError) as error:  # too long a step, for instance
                    said = _line(error)
                    continue
                if not runs:
                    compilation = prepared + first - seconds
                error_here = case.error(y) if np.isfinite(y).all() else math.inf
                runs.append(Run(case.name, solver.name, float(setting), seconds, error_here))
                if error_here < LEVELS[-1] or seconds > patience:
                    break
        except Exception as error:  # whatever a package raises is its answer
            said = _line(error)
    try:
        installed = version(solver.package)
    except PackageNotFoundError:
        installed = ""
    return Measured(case.name, solver.name, installed, compilation, runs, said)


def _line(error: BaseException) -> str:
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"


def least(call: Any, enough: float) -> tuple[float, Any]:
    """Return the least processor time of a call in seconds, of at least three unless they take long, and its result."""
    best, spent, y = math.inf, 0.0, None
    for _ in range(50):
        begin = process_time()
        y = call()
        seconds = process_time() - begin
        best, spent = min(best, seconds), spent + seconds
        if spent > enough:
            break
    return best, y


def everything(cases: Iterable[str], wanted: Iterable[str], enough: float, patience: float) -> Iterator[Measured]:
    """Yield the measurements, each made in a new process with one thread."""
    os.environ.update(dict.fromkeys(THREADS, "1"))
    os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    chosen = tuple(wanted)
    for case_name in cases:
        for solver in SOLVERS:
            named = not chosen or any(solver.name.lower().startswith(name.lower()) for name in chosen)
            if named and solver.fits(CASES[case_name]):
                context = multiprocessing.get_context("spawn")
                with ProcessPoolExecutor(1, context) as pool:
                    try:
                        yield pool.submit(measure, case_name, solver.name, enough, patience).result()
                    except (BrokenProcessPool, ImportError) as error:
                        yield Measured(case_name, solver.name, "", math.nan, [], _line(error))


def seconds_at(runs: list[Run], level: float) -> tuple[float, bool]:
    """Return the time at which the error falls to `level`, interpolated on log axes, and whether it is only a bound.

    It is nan if no run was as accurate. If the first run is more accurate, its time is an upper bound.
    """
    for k, run in enumerate(runs):
        if run.error <= level:
            if k == 0:
                return run.seconds, True
            before = runs[k - 1]
            if not math.isfinite(before.error) or run.error == 0.0:
                return run.seconds, True
            part = math.log(before.error / level) / math.log(before.error / run.error)
            return before.seconds * (run.seconds / before.seconds) ** part, False
    return math.nan, False
