"""`project`: the projection of a state, without a solver."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from ..engine.data import BAND, EPS, LARGE_SHARE, LAST_RANK
from ..engine.trust import ProjectionWarning
from ..methods.base import PROJECTION_ONLY
from .bound_problem import BoundProblem
from .inputs import as_vector, count, initial_state, is_number, reals, shown
from .invariant_set import InvariantSet
from .projection import MOST_ITERATIONS, ProjectionOptions, weights
from .results import ProjectionResult
from .runs import Run
from .step_control import StepControl

__all__ = ["project"]


def project(
    y_hat: Any,
    invariants: Any,
    *,
    t: float = 0.0,
    sigma: Any = None,
    linear_invariants: Any = None,
    iterations: int = 1,
    target: Any = None,
    f: Any = None,
    start: Any = None,
) -> ProjectionResult:
    """Project a state onto the targets of invariants.

    Parameters
    ----------
    y_hat : array_like, shape (n,)
        State to project, real or complex.
    invariants : Invariant or sequence of Invariant
        Invariants whose targets are to be met.
    t : float, optional
        Time at which the invariants are evaluated.
    sigma : array_like, shape (n,), optional
        Weights of the components: components with larger weights move more. Default: all 1, the euclidean metric.
    linear_invariants : (C, S), optional
        Linear constraints C y that the correction leaves unchanged; see `EIPSolver`.
    iterations : int, optional
        Number of Newton steps. One step leaves errors of second order in the errors of y_hat.
    target : array_like, shape (l,), optional
        Target values. Default: the `target` of each invariant, or its value at `start`.
    f : array_like, shape (n,), or callable, optional
        Derivative of the system at y_hat, or ``f(t, y)``, for invariants with ``uses_f=True``; it must be a callable if
        `iterations` is above 1.
    start : array_like, shape (n,), optional
        State at which invariants without a `target` have the values that y_hat is projected onto, at time `t`.

    Returns
    -------
    ProjectionResult
        ``y`` (n,), ``residual`` (l,) = I(y) - target, ``rank``, ``correction`` (n,).

    Raises
    ------
    ValueError
        If an invariant has no target, an argument has a wrong shape or value, or the projection fails: an invariant
        error is not finite, or is larger after the projection than before.

    Warns
    -----
    ProjectionWarning
        If an error of more than 1 % of the terms of an invariant remains.

    See Also
    --------
    Invariant, integrate, eip_scipy.results.ProjectionResult

    Notes
    -----
    The correction is y - y_hat = sigma * x, shifted along S with linear invariants, where x has the smallest 2-norm
    with (G sigma) x = -(I(y_hat) - target), and G contains the gradients at y_hat. A column-pivoted QR computes it, so
    that dependent gradients reduce the rank instead of failing. Errors within four rounding errors of the terms of an
    invariant are not corrected.

    Examples
    --------
    >>> import numpy as np
    >>> from eip_scipy import Invariant, project
    >>> length = Invariant(lambda t, y: y @ y, lambda t, y: 2 * y, target=1.0)
    >>> project(np.array([0.6, 0.81]), length, iterations=3).residual
    array([0.])
    """
    if not is_number(t, "t") or not math.isfinite(t):
        raise ValueError(f"project: t must be a finite number, got {shown(t)}.")
    t, y = float(t), initial_state(y_hat, "y_hat")
    iterations = count("iterations", iterations, MOST_ITERATIONS)
    given = ProjectionOptions(
        invariants=invariants,
        metric=None if sigma is None else weights("sigma", sigma, y.size),  # None: the euclidean metric
        linear_invariants=linear_invariants,
        iterations=iterations,
        check=False,
    )
    problem, control = BoundProblem(_field(f, t, y), y), StepControl.without_steps(t, y.size)
    run = Run(problem, "project", PROJECTION_ONLY, control, given).start_at(y)
    known, work = run.invariants, run.work
    if known.uses_f and (f is None or (iterations > 1 and not callable(f))):
        raise ValueError(
            "project: a gradient uses f; pass f=, the derivative at y_hat, or with iterations > 1 a function f(t, y)."
        )
    options = run.options._replace(
        target=_targets(known, target, start, t),
        most_left=np.full(known.size, np.inf),  # always do all Newton steps
    )
    work.K[-1] = run.start.f
    out = run.projected(t, y, options, work)
    left = np.abs(work.residual) * BAND * EPS / np.where(work.band > 0, work.band, 1.0)
    for k in np.flatnonzero(left > LARGE_SHARE):
        warnings.warn(
            f"the projection left an error of {work.residual[k]:.3g} in {known.names[k]!r}, {left[k]:.2g} of the size "
            "of its terms: the state was far from the target, or the gradient is wrong; increase iterations, or "
            "correct grad",
            ProjectionWarning,
            stacklevel=2,
        )
    return ProjectionResult(out, work.residual.copy(), int(work.counters[LAST_RANK]), out - y)


def _field(f: Any, t: float, y: np.ndarray) -> Callable[[float, np.ndarray], np.ndarray]:
    """Return the derivative of the state as a function: `f`, or the constant that it is."""
    if callable(f):
        field: Callable[[float, np.ndarray], np.ndarray] = f
        return field
    fixed = np.zeros_like(y) if f is None else as_vector(f, y.size, y.dtype, "project: f has", t)
    return lambda t, state: fixed


def _targets(known: InvariantSet, target: Any, start: Any, t: float) -> np.ndarray:
    """Return the target values (l,): the `target`, or those of the invariants and, for the others, those at `start`."""
    if target is not None:
        if start is not None:
            raise ValueError("project: give target or start, not both; an invariant may also have its own target.")
        values = reals("target", target)
        if values is None or values.size != known.size or values.ndim > 1 or not np.isfinite(values).all():
            raise ValueError(f"project: target must be {known.size} finite numbers, got {shown(target)}.")
        return values.reshape(-1)
    for item, label in zip(known.items, known.labels, strict=True):
        if item.is_balance:
            raise ValueError(
                f"project: balance {label!r} changes and has no value to keep. Pass the target values as target=."
            )
        if item.target is None and start is None:
            raise ValueError(
                f"project: invariant {label!r} has no target. Set its target, pass target=, or pass start=, a state at "
                "which it has the target value."
            )
    if start is None:
        return known.target
    state = initial_state(start, "start")
    if state.shape != known.shape[1:] or (state.dtype.kind == "c" and known.dtype.kind != "c"):
        raise ValueError(
            f"project: start must be a state with {known.shape[1]} components, as y_hat, got {shown(start)}."
        )
    lacking = known.of_values([item.target is None for item in known.items])
    values = np.where(lacking, known.values(t, state.astype(known.dtype)), known.target)
    if not np.isfinite(values).all():
        raise ValueError(f"project: {known.names[int(np.argmin(np.isfinite(values)))]!r} is not finite at start.")
    return values
