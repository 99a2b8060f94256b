"""The options `callback`, `progress` and `max_steps` of `solve_ivp`, for SciPy's loop of steps."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.integrate
from scipy.integrate import BDF, LSODA, OdeSolution

from ..core.solvers import EIPSolver
from ..core.step_control import UNBOUNDED
from ..core.tangent_vectors import NO_TANGENT_VECTORS
from .integrate import STOPPED, progress_bar, used_up
from .prepare import check_watching

__all__ = ["Watch"]

NOTHING = np.zeros(0)


class Watch:
    """The observer of a run of SciPy's solve_ivp, which may end the run before a step."""

    def __init__(self, callback: Any, progress: Any, max_steps: Any) -> None:
        check_watching(callback, progress, max_steps)
        self._callback: Any = callback
        self._progress, self._most_steps = progress, UNBOUNDED if max_steps is None else max_steps
        self._is_needed = callback is not None or progress or max_steps is not None
        self._rows = self._steps = 0  # saved points that the callback has received, and steps
        self._stopped = False

    def run(self, fun: Any, t_span: Any, y0: Any, method: Any, *, tangents: Any = None, **options: Any) -> Any:
        """Return the result of `scipy.integrate.solve_ivp`; `tangents` are the vectors in the states, or None."""
        solve = scipy.integrate.solve_ivp
        method = getattr(scipy.integrate, method, method) if isinstance(method, str) else method
        if not (self._is_needed and isinstance(method, type)):  # SciPy raises the error for what is no method
            return solve(fun, t_span, y0, method=method, **options)
        self._tangents = NO_TANGENT_VECTORS if tangents is None else tangents
        t_eval, (self._t0, end) = options.get("t_eval"), map(float, t_span)
        self._times = None if t_eval is None else np.asarray(t_eval, float)
        shown = {"desc": method.__name__, "total": abs(end - self._t0), "unit": "time", "unit_scale": True}
        with progress_bar(self._progress, lambda: shown) as self._bar:
            sol = solve(fun, t_span, y0, method=self._watched(method), **options)
            if self._bar is not None:
                self._bar.update(abs(float(sol.t[-1]) - self._t0) - self._bar.n)
        if sol.sol is not None and method in (BDF, LSODA):  # which SciPy recognises by their classes
            sol.sol = OdeSolution(sol.sol.ts, sol.sol.interpolants, alt_segment=True)
        states = np.transpose(sol.y)
        self._report(sol.t[self._rows :], states[self._rows :])
        if self._stopped:
            sol.t, sol.y = sol.t[: self._rows], np.transpose(states[: self._rows])
            sol.status, sol.success, sol.message = 1, True, STOPPED
        return sol

    def _watched(self, method: Any) -> Any:
        """Return a subclass of a solver that asks before each step whether to go on."""

        def start(solver: Any, *given: Any, **options: Any) -> None:
            self._solver = solver  # which makes no step over an interval of no length
            method.__init__(solver, *given, **options)

        def step(solver: Any) -> tuple[bool, str | None]:
            reason = self._before_step(solver)
            return (False, reason) if reason else method._step_impl(solver)

        return type(method)(method.__name__, (method,), {"__init__": start, "_step_impl": step})

    def _before_step(self, solver: Any) -> str:
        """Report the points saved in the last step; return the reason why no further step is made, or ""."""
        t = float(solver.t)
        if self._bar is not None:
            self._bar.update(abs(t - self._t0) - self._bar.n)
        if self._callback is not None and self._times is None:
            self._report([t], [solver.y])
        elif self._callback is not None and self._times is not None and self._steps:
            times = self._times[self._rows :]
            times = times[solver.direction * (times - t) <= 0]
            self._report(times, solver.dense_output()(times).T if times.size else times)
        if self._stopped:
            return STOPPED
        self._steps += 1
        return used_up(self._most_steps, t) if self._steps > self._most_steps else ""

    def _report(self, times: Any, states: Any) -> None:
        """Call the callback with saved points until it stops the run."""
        for t, y in zip(times, states, strict=True) if self._callback is not None else ():
            if self._stopped:
                return
            self._rows += 1
            residuals = NOTHING
            if isinstance(self._solver, EIPSolver):
                invariants = self._solver._run.invariants
                residuals = invariants.values(float(t), np.ascontiguousarray(y)) - invariants.fixed_target
            self._stopped = bool(self._callback(float(t), np.array(self._tangents.state(y)), residuals))
