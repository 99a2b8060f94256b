"""Ways to run a mechanism to the end of its interval, each a function of the tolerance."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from eip_scipy import EIPDOP853, integrate
from eip_scipy.problems import MechanicsProblem

from ..study import Session
from .examples import four_bar_model

BOTH, CONSTRAINTS, NEITHER = "constraints and energy", "constraints", "DOP853"
FACTORS = (1.0, 5.0, 10.0)  # of Baumgarte
# A run ends after this number of calls: at singular positions those without projection need millions of them.
MOST_CALLS = 150_000
ROWS = 10  # times that a run by steps of `integrate` is looked at until then
FREE = 1e10  # absolute tolerance of IDA's multipliers, which are not part of the motion


class Outcome(NamedTuple):
    """A run: processor time in seconds, last state, calls of the right-hand side, and whether the run is reliable.

    The last state is NaN if the run did not reach its end.
    """

    seconds: float
    y: np.ndarray
    calls: int
    reliable: bool = True


Way = Callable[[float], Outcome]


class _TooManyCallsError(Exception):
    """Error that ends a run after more than `MOST_CALLS` calls of the right-hand side."""


def ways(problem: MechanicsProblem, session: Session) -> dict[str, Way]:
    """Return, by their names, functions that run a mechanism at a given tolerance.

    If scikit-sundae is not installed, IDA is left out, and the command prints a line about it at its end.
    """
    found: dict[str, Way] = {NEITHER: partial(_projected, problem, ())}
    found[CONSTRAINTS] = partial(_projected, problem, problem.constraints)
    if problem.energy is not None:
        found[BOTH] = partial(_projected, problem, problem.invariants)
    for method in ("LSODA", "Radau"):
        found[method] = partial(_by_scipy, problem, problem.fun, method)
    if problem.name == "four-bar":
        for factor in FACTORS:
            found[f"Baumgarte {factor:g}"] = partial(_by_scipy, problem, lambdified(problem, factor), "DOP853")
    try:
        found["IDA"] = partial(_by_ida, problem, import_module("sksundae.ida").IDA)
    except ImportError:
        line = "no comparison with IDA: it needs scikit-sundae (python -m pip install scikit-sundae)"
        if line not in session.absent:
            session.absent.append(line)
    return found


def kept(problem: MechanicsProblem, invariants: Any, tolerance: float, **options: Any) -> Any:
    """Run a mechanism by `integrate` with EIPDOP853, `invariants` and rtol = atol = `tolerance`; return the result.

    `options` are further options of `integrate`. Warnings are suppressed; the result's `trusted` tells whether the run
    is reliable.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a run that is not reliable is marked
        return integrate(problem, invariants=invariants, method=EIPDOP853, rtol=tolerance, atol=tolerance, **options)


def _projected(problem: MechanicsProblem, invariants: Any, tolerance: float) -> Outcome:
    rows = iter(range(ROWS))

    def too_many(t: float, y: np.ndarray, defects: np.ndarray) -> bool:
        return next(rows, None) is None

    steps = max(MOST_CALLS // (ROWS * EIPDOP853.TABLEAU.n_stages), 1)
    began = time.process_time()
    run = kept(problem, invariants, tolerance, save_every=steps, callback=too_many)
    seconds = time.process_time() - began
    return Outcome(seconds, run.y[:, -1] if run.status == 0 else np.full(run.y.shape[0], np.nan), run.nfev, run.trusted)


class _Calls:
    """Counter of calls of the right-hand side; `add` raises an error after more than `MOST_CALLS`, to end the run."""

    number = 0

    def add(self) -> None:
        self.number += 1
        if self.number > MOST_CALLS:
            raise _TooManyCallsError


def _by_scipy(problem: MechanicsProblem, fun: Any, method: str, tolerance: float) -> Outcome:
    calls, y = _Calls(), np.full(problem.y0.size, np.nan)

    def counted(t: float, state: np.ndarray) -> np.ndarray:
        calls.add()
        return fun(t, state)

    began = time.process_time()
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            run = solve_ivp(counted, problem.t_span, problem.y0, method=method, rtol=tolerance, atol=tolerance)
        y = run.y[:, -1] if run.success else y
    except (_TooManyCallsError, ValueError):  # Radau's Jacobian by differences overflows for a cyclic coordinate
        pass
    return Outcome(time.process_time() - began, y, calls.number)


def _by_ida(problem: MechanicsProblem, ida: Any, tolerance: float) -> Outcome:
    """Run `problem` by IDA, with the constraints on positions and velocities as equations, and a multiplier for each.

    `ida` is the class ``sksundae.ida.IDA``. The multipliers move q' and u' along the gradients of the constraints
    (Gear, Gupta and Leimkuhler 1985). They are 0 in the exact motion, since the accelerations satisfy the constraints
    already.
    """
    (item,) = problem.constraints
    n, nq, m = problem.y0.size, len(problem.names.coordinates), item.size or 0
    on_positions, gradient = len(problem.names.positions), np.empty((m, n))
    fill, values = item.gradient, item.function
    assert fill is not None
    calls, last = _Calls(), np.full(n, np.nan)

    def residual(t: float, y: np.ndarray, rates: np.ndarray, out: np.ndarray) -> None:
        calls.add()
        state = y[:n].copy()  # IDA's own array is read-only, for which functions would be compiled again
        fill(t, state, gradient, *item.args)
        out[:n] = rates[:n] - problem.fun(t, state)
        out[:nq] -= gradient[:on_positions, :nq].T @ y[n : n + on_positions]
        out[nq:n] -= gradient[on_positions:, nq:].T @ y[n + on_positions :]
        out[n:] = values(t, state, *item.args)

    atol = np.append(np.full(n, tolerance), np.full(m, FREE))
    options = {"algebraic_idx": list(range(n, n + m)), "max_num_steps": 10 * MOST_CALLS}
    start = np.append(problem.y0, np.zeros(m)), np.append(problem.fun(problem.t_span[0], problem.y0), np.zeros(m))
    residual(problem.t_span[0], *start, np.empty(n + m))  # compiles
    calls.number = 0
    began = time.process_time()
    try:
        run = ida(residual, rtol=tolerance, atol=atol, **options).solve(np.array(problem.t_span), *start)
        last = run.y[-1, :n] if run.success else last
    except _TooManyCallsError:
        pass
    return Outcome(time.process_time() - began, last, calls.number)


def lambdified(problem: MechanicsProblem, factor: float) -> Callable[[float, np.ndarray], np.ndarray]:
    """Return the right-hand side of the four-bar linkage as users write it: lambdify and numpy.linalg.solve.

    Baumgarte's terms, -2 `factor` g' - `factor`^2 g for the constraints g = 0, are added to the constraints on the
    accelerations.
    """
    import sympy

    model, constants = four_bar_model()
    state = [*model.q, *model.u]
    u = sympy.Matrix(model.u)
    rates = model._k_nh * u + model._f_nh
    rows = sympy.zeros(1, 1).col_join(-2 * factor * rates - factor**2 * model._f_h)
    plain = [sympy.Dummy() for _ in state]
    by_plain = dict(zip(state, plain, strict=True))
    expressions = [
        item.xreplace({sympy.Symbol(k.name): v for k, v in constants.items()}).xreplace(by_plain)
        for item in (model.mass_matrix, model.forcing + rows)
    ]
    matrices = sympy.lambdify([plain], expressions, cse=True)

    def fun(t: float, y: np.ndarray) -> np.ndarray:
        M, forces = matrices(y)
        return np.append(y[3:], np.linalg.solve(M, forces.ravel()))

    return fun
