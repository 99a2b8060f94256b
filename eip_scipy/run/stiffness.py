"""Comparison with an implicit method, which shows whether equations are stiff."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from ..core.invariants import as_invariants, with_args
from ..core.solvers import EIPDOP853, EIPRadau
from .prepare import Request, prepared
from .trials import Bench, difference

__all__ = ["ImplicitRun", "implicit_run"]

# Values of rtol to try, in units of the wanted error, and the ratio of atol to rtol times the size of the start.
TOLERANCES, ATOL_PER_RTOL = (0.1, 1e-2, 1e-3, 1e-4), 1e-3
# Largest number of components. Beyond it the linear algebra of an implicit step costs more than the evaluations saved.
LARGEST = 500


class ImplicitRun(NamedTuple):
    """Tolerances, final error and number of evaluations of a run by `EIPRadau`, including those for Jacobians."""

    rtol: float
    atol: float
    error: float
    nfev: int


class _TooManyError(Exception):
    """A run has used all evaluations that it may take."""


def implicit_run(bench: Bench, wanted: float, most: int, keeps: bool) -> ImplicitRun | None:
    """Run the problem of a `Bench` by `EIPRadau` over the interval of its trials, with smaller and smaller tolerances.

    Return the first run with the error `wanted` at the last time of the bench. Return None if no run has it, a run
    fails or needs more than `most` evaluations, or the state has more than `LARGEST` components. If `keeps`, the
    invariants are kept.
    """
    y0, times = bench.problem.y0, bench.times
    if y0.size > LARGEST:
        return None
    options = {**bench.common, "method": EIPDOP853, "rtol": 1e-3, "atol": 1e-6, "invariants": ()}
    system = prepared(Request.of(fun=bench.problem, **options)).system
    items = as_invariants(bench.common.get("invariants", bench.problem.invariants) if keeps else ())
    kept = tuple(item if item.args else with_args(item, system.extra) for item in items)
    calls = 0

    def fun(t: float, y: np.ndarray) -> Any:
        nonlocal calls
        calls += 1
        if calls > most:
            raise _TooManyError
        return system.derivative(t, y)

    size = min(1.0, float(np.abs(y0).max())) or 1.0
    for part in TOLERANCES:
        rtol, calls = max(part * wanted, 1e-12), 0
        atol = ATOL_PER_RTOL * rtol * size
        try:
            with np.errstate(all="ignore"), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                run = solve_ivp(fun, (bench.t0, times[-1]), y0, method=EIPRadau, rtol=rtol, atol=atol, invariants=kept)
        except (_TooManyError, ValueError, ArithmeticError, np.linalg.LinAlgError):
            return None  # an explicit method is recommended even if the implicit run fails
        if not run.success:
            return None
        error = float(difference(run.y[:, -1:], bench.truth[:, -1:])[0])
        if error <= wanted:
            return ImplicitRun(rtol, atol, max(error, bench.doubt), calls)
    return None
