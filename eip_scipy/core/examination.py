"""Examinations during a run: whether its quantities are invariants, and whether their gradients are correct.

At the start a rate or a gradient may vanish, or a function may take another branch than later. So the invariants are
checked again after 10, 100, 1000, ... steps and at the end. Steps that the engine suspects are examined, too (`suspect`
in engine/cpp/trust.hpp). The invariants need not show an error in them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from ..engine import data
from ..engine.native import BUILD
from ..methods.runge_kutta import RK4
from .invariant_checks import complaints
from .invariants import InvariantSet, copied
from .resolution import runge_kutta_step

__all__ = ["Examiner", "is_check_due", "steps_to_check", "unless_refused"]

# Number of steps before the first check of the invariants, and the factor from one check to the next.
FIRST_CHECK = SPACING = 10
# Number of points of a step at which rates are examined, because a force may act for less than a step.
POINTS = 8
# Number of points in each earlier step that was not projected.
BACK = 4
# Factor by which the largest correction has to grow before a large correction is examined again.
GROWTH = 2.0

Array = np.ndarray
Derivative = Callable[[float, Array], Array]


def steps_to_check(steps: int) -> int:
    """Return the number of steps from step `steps` to the next check of the invariants."""
    due = FIRST_CHECK
    while due <= steps:
        due *= SPACING
    return due - steps


def is_check_due(steps: int) -> bool:
    """Return True if a check of the invariants is due after `steps` steps."""
    return steps > 0 and steps_to_check(steps - 1) == 1


@dataclass
class Examiner:
    """Examiner of the states of a run; `tau` is the length of a step.

    `figures` (l, N_FIGURES) are numbers about the projections of the run, see `engine.trust`; rates of change are also
    stored there. ``resolution(rhs, t, h, y, end_of_run)`` is `unresolved` for the method and the blocks of this run.
    `largest` is the largest correction, in local errors, when a large correction was last examined.
    """

    invariants: InvariantSet
    tau: float
    figures: Array
    resolution: Callable[[Derivative, float, float, Array, float], str | None]
    largest: float = 0.0

    def complaint(self, rhs: Derivative, t: float, y: Array) -> str | None:
        """Return a sentence about an invariant or a gradient that is wrong at a state of the run, or None."""
        return self._unless_refused(_complaint, rhs, t, y, True)

    def examine(self, suspect: Array, rhs: Derivative) -> str | None:
        """Return a sentence about what is wrong in the step that the engine suspects, or None.

        `suspect`, the engine's record of that step, is cleared, so that the engine may record another step.
        """
        reason, t_old, t_new = suspect[data.REASON], float(suspect[data.SUSPECT_FROM]), float(suspect[data.SUSPECT_TO])
        suspect[data.REASON] = data.NOTHING
        old, new = np.split(suspect[data.N_SUSPECT :].copy().view(self.invariants.dtype), 2)
        if reason == data.CHANGES_ALONG_FLOW:
            return self.complaint(rhs, t_new, new)
        if reason == data.LARGE_ERROR:
            return unless_refused(self.resolution, rhs, t_old, t_new - t_old, old, self.invariants.t_span[1])
        if reason != data.LARGE_CORRECTION:
            return None
        return self._unless_refused(_along_chord, rhs, (t_old, t_new), (old, new), int(suspect[data.SUSPECT_WAITED]))

    def _unless_refused(self, look: Callable[..., str | None], rhs: Derivative, *args: Any) -> str | None:
        """Return the result of the examination `look`; None if a function of the user raises an exception in it.

        The run does not visit the examined states. Therefore an exception there says nothing about the run.
        """
        known = copied(self.invariants)
        known.functions = _Guarded(known.functions)
        return unless_refused(partial(look, self, known), rhs, *args)


def unless_refused(look: Callable[..., str | None], rhs: Derivative, *args: Any) -> str | None:
    """Return ``look(rhs, *args)``; None if the right-hand side raises an exception in it, except MemoryError."""
    try:
        with np.errstate(all="ignore"):
            return look(_guarded(rhs), *args)
    except _RefusedError:
        return None


class _RefusedError(Exception):
    """A function of the user raised an exception at a state that the run does not visit."""


class _Guarded:
    """The functions of a set of invariants, whose exceptions, except MemoryError, become `_RefusedError`."""

    def __init__(self, functions: Any) -> None:
        self._functions = functions

    def __getattr__(self, name: str) -> Any:
        return _guarded(getattr(self._functions, name))


def _guarded(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return `function` with its exceptions, except MemoryError, replaced by `_RefusedError`."""

    def call(*args: Any) -> Any:
        try:
            return function(*args)
        except MemoryError:
            raise
        except Exception as error:
            raise _RefusedError from error

    return call


def _complaint(
    examiner: Examiner, known: InvariantSet, rhs: Derivative, t: float, y: Array, on_manifold: bool
) -> str | None:
    """Return the text of the first of the `complaints` at a state, or None, and note rates in ``examiner.figures``.

    `known` is a copy of the examiner's invariants whose functions raise `_RefusedError`. Without `on_manifold`,
    complaints about invariants that depend on other invariants are ignored. A state whose derivative is not finite is
    not examined.
    """
    f = rhs(t, y)
    if not BUILD.are_finite(f.view(float)):
        return None
    evaluated = known.gradients(t, y, f), known.values(t, y)
    known.note_rates(examiner.figures, t, y, f, *evaluated)
    found = complaints(known, t, y, f, examiner.tau, rhs, evaluated)
    return next((one.text for one in found if on_manifold or not one.dependent), None)


def _along_chord(
    examiner: Examiner,
    known: InvariantSet,
    rhs: Derivative,
    times: tuple[float, float],
    ends: tuple[Array, Array],
    waited: int,
) -> str | None:
    """Return a sentence about what is wrong in a step with a large correction, or in the steps before it, or None.

    The states examined in the step are on the straight line between its `ends`, those before it on the trajectory. The
    `waited` steps before that step were not projected, and each of them may be the cause of the correction. Nothing is
    examined unless the largest correction of the run has grown by the factor `GROWTH` since the last examination.
    """
    largest = float(examiner.figures[:, data.NU].max(initial=0.0))
    if largest < GROWTH * examiner.largest:
        return None
    examiner.largest = largest
    (t_old, t_new), (old, new) = times, ends
    for share in np.arange(1, POINTS + 1) / POINTS:
        t, y = t_old + float(share) * (t_new - t_old), old + share * (new - old)
        found = _complaint(examiner, known, rhs, t, y, False)
        if found is not None:
            return found
    return _on_the_way(examiner, known, rhs, (t_old, old), t_new - t_old, waited)


def _on_the_way(
    examiner: Examiner, known: InvariantSet, rhs: Derivative, start: tuple[float, Array], h: float, steps: int
) -> str | None:
    """Return a sentence about what is wrong in about `steps` steps of length h that led to `start`, or None."""
    (t, y), part = start, h / BACK
    begin = known.t_span[0]
    # More than `steps` steps of length h are followed, because earlier steps may have been longer.
    for _ in range(BACK * (steps + (steps + 1) // 2)):
        if (t - part - begin) * part < 0:
            return None
        t, y = t - part, runge_kutta_step(RK4.A, RK4.b, RK4.c, rhs, t, -part, y)
        if not np.isfinite(y).all():
            return None
        found = _complaint(examiner, known, rhs, t, y, False)
        if found is not None:
            return found
    return None
