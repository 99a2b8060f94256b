"""Messages that explain why a step or a projection failed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.integrate import OdeSolver

from ..engine import data
from ..engine.data import Work
from .invariant_set import InvariantSet

if TYPE_CHECKING:
    from .runs import Run

__all__ = ["failure", "projection_failure"]


def projection_failure(invariants: InvariantSet, work: Work, t: float) -> str:
    """Return the message for a failed projection: the largest residual, and the rank of the gradients.

    The largest residual is the one that most exceeds its dead band, within which it would not be corrected. `work` has
    the buffers of the step, which hold the residuals and the rank.
    """
    excess = np.abs(work.residual) / np.maximum(work.band, np.finfo(float).tiny)
    worst = int(np.argmax(np.where(np.isfinite(excess), excess, np.inf)))
    broken = [name for name, row in zip(invariants.names, work.G, strict=True) if not np.isfinite(row).all()]
    because = f"; the gradient of {broken[0]!r} is not finite there" if broken else ""
    return (
        f"projection failed at t={t:g}: invariant {invariants.names[worst]!r}, residual {work.residual[worst]:.3g}, "
        f"rank {int(work.counters[data.LAST_RANK])} of {invariants.size}{because}"
    )


def failure(status: int, run: Run, clock: Sequence[float] | np.ndarray) -> str:
    """Return the message for a failed step, from the engine's `status` and its `clock` of times and step lengths."""
    if status == data.NOT_FINITE:
        return _not_finite(run, clock[data.TIME], clock[data.LENGTH])
    called = run.problem.name
    if status == data.TOO_SMALL:
        at = run.stepper.not_finite_at if run.method.drives else None
        return OdeSolver.TOO_SMALL_STEP if at is None else f"{called} returned a non-finite value at t={at:.10g}"
    if status == data.UNSTABLE:
        return _unstable(run)
    if status == data.BY_VELOCITY:
        return (
            f"at t={clock[data.TIME]:.10g} the accelerations in {called} depend on the velocity, and a Nystrom "
            "method does not integrate such equations; the states of the last 4 steps or so may be wrong. Use a "
            "Runge-Kutta method such as EIPDOP853, or EIPGJ12 with small steps"
        )
    message = projection_failure(run.invariants, run.work, clock[data.TIME_NEW])
    return f"{message}. Use a shorter step or tighter tolerances, or correct fun or grad of the invariant"


def _unstable(run: Run) -> str:
    """Return the message for a multistep method whose history has too large differences of the accelerations."""
    history = run.stepper.multistep
    assert history is not None  # only multistep methods return this code
    t = history.t0 + int(history.place[data.NEWEST]) * history.h
    others = "EIPRKN12 if there are close encounters or forces that jump"
    if history.uses_v:
        others = "EIPDOP853 if there are close encounters, forces that jump, or strong forces that depend on velocities"
    return (
        f"the step is too long, or the motion not smooth, at t={t:.10g}: with h={abs(history.h):g} the differences "
        f"of order {history.predict_q.size} of the accelerations are not small compared with the accelerations. "
        f"Use a shorter step, or a one-step method such as {others}"
    )


def _not_finite(run: Run, t: float, h: float) -> str:
    """Return the message for a step in which a stage, the new state or the error estimate is not finite."""
    work, method = run.work, run.stepper
    stages = [(work.K[i], t + method.c[i] * h) for i in range(method.b.size)]
    history = method.multistep
    if history is not None and history.place[data.HAVE_NODES]:
        stages.insert(0, (work.K[1], history.t0 + (int(history.place[data.NEWEST]) + 1) * history.h))
    if np.isfinite(work.y_hat).all():  # f at the end of the step is meaningless otherwise
        stages.append((work.K[-1], t + h))
    for f, at in stages:
        if not np.isfinite(f).all():
            unset = np.flatnonzero(np.isnan(f))
            cause = run.problem.left_out
            hint = f" (component {unset[0]} is NaN; {cause})" if cause and unset.size else ""
            return f"{run.problem.name} returned a non-finite value at t={at:.10g}{hint}"
    if not np.isfinite(work.y_hat).all():
        return f"the state is no longer finite at t={t + h:.10g}: it overflowed, or the step is too long"
    return f"the error estimate is not finite at t={t + h:.10g}: it overflowed, or y and `atol` are 0 in a component"
