"""Examinations during a run: of its invariants and their gradients, and whether its steps resolve the motion.

At the start a rate or a gradient may vanish, or a function may take another branch than later. So the invariants are
checked again after 10, 100, 1000, ... steps and at the end. Steps that the engine suspects are examined, too (`suspect`
in engine/cpp/trust.hpp). The invariants need not show an error in them.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain, pairwise
from typing import Any, NamedTuple

import numpy as np

from ..engine import data
from ..engine.data import LEAST_CHANGE, Grouping, Method
from ..engine.native import BUILD
from ..methods.runge_kutta import DOP853, RK4
from .derivatives import random_directions, unless_error
from .invariant_checks import findings
from .invariant_set import InvariantSet

__all__ = ["Examiner", "is_check_due", "steps_to_check", "unresolved"]

# Number of points of a step at which rates are examined, because a force may act for less than a step.
POINTS = 8
# Number of points in each earlier step that was not projected.
BACK = 4
# Halvings of a part of a step that leave of a change only a jump, of at least this share of it, and no rounding.
HALVINGS, JUMP, BEYOND_ROUNDING = 40, 0.1, 1e3 * data.EPS
# Factor by which the largest correction has to grow before a large correction is examined again.
GROWTH = 2.0
# Consecutive steps that are compared, each with SUBSTEPS of DOP853. At most one of them passes a kink, so the step with
# the largest error counts only from the share LOST on: what a close passage throws out moves freely from then on. Steps
# over kinks have up to 0.11 (a ball that bounces on a stiff spring, by RK5).
STEPS, SUBSTEPS = 3, 4
# A block is not resolved if a step errs by this share of the block's size, or of what the step changes in it, by the
# least number of stages. Correct runs have up to 0.034 by RK2 (table 2 of the paper) and 0.0074 by RK4 (the pericentre
# of Kepler's orbit with e = 0.6 and h = 0.1).
UNRESOLVED = {2: 0.1, 3: 0.03, 4: 1e-2, 8: 2e-3}
LOST = 0.3
# Share of its length by which a whole number of steps may miss an interval.
ROUNDING = 1e-12
# Numbers of steps after which a check is due.
CHECKS = [10**k for k in range(1, 20)]

Array = np.ndarray
Derivative = Callable[[float, Array], Array]


def steps_to_check(steps: int) -> int:
    """Return the number of steps from step `steps` to the next check, which is due after 10, 100, 1000, ... steps."""
    return CHECKS[bisect_right(CHECKS, steps)] - steps


def is_check_due(steps: int) -> bool:
    """Return True if a check of the invariants is due after `steps` steps."""
    return steps in CHECKS


@dataclass
class Examiner:
    """Examiner of the states of a run; `tau` is the length of a step.

    `figures` (l, N_FIGURES) are numbers about the projections of the run, see `engine.trust`; rates of change are also
    stored there. ``resolution(rhs, t, h, y, end_of_run)`` is `unresolved` for the method and the blocks of this run.
    `largest` is the largest correction, in local errors, when a large correction was last examined.

    The run does not visit all of the examined states. Therefore an exception of a user's function at one of them says
    nothing about the run, and the examination finds nothing.
    """

    invariants: InvariantSet
    tau: float
    figures: Array
    resolution: Callable[[Derivative, float, float, Array, float], str | None]
    largest: float = 0.0

    def finding(self, rhs: Derivative, t: float, y: Array) -> str | None:
        """Return a sentence about an invariant or a gradient that is wrong at a state of the run, or None."""
        with np.errstate(all="ignore"):
            if not self.invariants.balances.items and unless_error(self._is_in_order, rhs, t, y) is not False:
                return None
            return unless_error(self._finding, rhs, t, y)

    def examine(self, suspect: Array, rhs: Derivative) -> str | None:
        """Return a sentence about what is wrong in the step that the engine suspects, or None; clear its record."""
        reason, t_old, t_new = suspect[data.REASON], float(suspect[data.SUSPECT_FROM]), float(suspect[data.SUSPECT_TO])
        suspect[data.REASON] = data.NOTHING
        old, new = np.split(suspect[data.N_SUSPECT :].copy().view(self.invariants.dtype), 2)
        if reason == data.CHANGES_ALONG_FLOW:
            return self.finding(rhs, t_new, new)
        with np.errstate(all="ignore"):
            if reason == data.LARGE_ERROR:
                return unless_error(self.resolution, rhs, t_old, t_new - t_old, old, self.invariants.t_span[1])
            if reason == data.LARGE_CORRECTION:
                waited = int(suspect[data.SUSPECT_WAITED])
                return unless_error(self._along_chord, rhs, (t_old, t_new), (old, new), waited)
        return None

    def _is_in_order(self, rhs: Derivative, t: float, y: Array) -> bool:
        """Return False if a quick look, which also notes rates, finds something that is wrong."""
        known, ways = self.invariants, random_directions(y.size, y.dtype.kind == "c")
        of_run = known.target, known.scales, self.tau, known.t_span, ways
        return bool(known.functions.look(self.figures, t, y, rhs(t, y), *of_run))

    def _finding(self, rhs: Derivative, t: float, y: Array) -> str | None:
        """Return the text of the first of the `findings` at a state, if f is finite there, and note rates."""
        f = rhs(t, y)
        if not BUILD.are_finite(f.view(float)):
            return None
        evaluated = self.invariants.gradients(t, y, f), self.invariants.values(t, y)
        self.invariants.note_rates(self.figures, t, y, f, *evaluated)
        found = findings(self.invariants, t, y, f, self.tau, rhs, evaluated)
        return found[0].text if found else None

    def _along_chord(
        self, rhs: Derivative, times: tuple[float, float], ends: tuple[Array, Array], waited: int
    ) -> str | None:
        """Return a sentence about what is wrong in a step with a large correction, or in the steps before it, or None.

        The states examined in the step are on the straight line between its `ends`, those before it on the trajectory.
        The `waited` steps before that step were not projected, and each of them may be the cause of the correction.
        Nothing is examined unless the largest correction has grown by the factor `GROWTH` since the last examination.
        """
        largest = float(self.figures[:, data.NU].max(initial=0.0))
        if largest < GROWTH * self.largest:
            return None
        self.largest = largest
        (t_old, t_new), (old, new) = times, ends
        shares = np.arange(1, POINTS + 1) / POINTS
        chord = ((t_old + float(share) * (t_new - t_old), old + share * (new - old)) for share in shares)
        states = chain(chord, _before(self.invariants.t_span[0], rhs, t_old, old, t_new - t_old, waited))
        found = next(filter(None, (self._finding(rhs, t, y) for t, y in states)), None)
        return found or self._jump(rhs, lambda share: (t_old + share * (t_new - t_old), old + share * (new - old)))

    def _jump(self, rhs: Derivative, chord: Callable[[float], tuple[float, Array]]) -> str | None:
        """Return a sentence if the invariant with the largest correction jumps on a step's chord, or None.

        The rate of the invariant is 0 on both sides of a jump. Of a part of the chord, the half is kept in which the
        value changes most by what its gradients do not explain, until only a jump can be left.
        """
        k, kept = int(self.figures[:, data.NU].argmax()), self.invariants

        def point(share: float) -> Point:
            t, y = chord(share)
            return Point(share, t, y, float(kept.values(t, y)[k]), kept.gradients(t, y, rhs(t, y))[k])

        for left, right in pairwise(map(point, np.linspace(0.0, 1.0, POINTS + 1).tolist())):
            least = max(JUMP * _change((left, right)), BEYOND_ROUNDING * self.figures[k, data.TERMS])
            for _ in range(HALVINGS):
                middle = point((left.share + right.share) / 2)
                left, right = max((left, middle), (middle, right), key=_change)
                if not _change((left, right)) > least:
                    break
            else:
                where = f"{kept.names[k]!r} jumps by {_change((left, right)):.2g} at t={left.t:.6g}"
                return (
                    f"{where}, so that it is not an invariant there; make it continuous, for instance by a shift of a "
                    "potential that is cut off"
                )
        return None


class Point(NamedTuple):
    """A state on the chord of a step, with the value and the gradient of an invariant."""

    share: float
    t: float
    y: Array
    value: float
    gradient: Array


def _change(ends: tuple[Point, Point]) -> float:
    """Return the part of a change of value between two points that the gradients there do not explain."""
    one, two = ends
    explained = np.vdot(one.gradient + two.gradient, two.y - one.y).real / 2
    return abs(two.value - one.value - float(explained))


def _before(begin: float, rhs: Derivative, t: float, y: Array, h: float, steps: int) -> Iterator[tuple[float, Array]]:
    """Yield times and states of the trajectory that led to (t, y), back for about `steps` steps of length h."""
    part = h / BACK
    # More than `steps` steps of length h are followed, because earlier steps may have been longer.
    for _ in range(BACK * (steps + (steps + 1) // 2)):
        if (t - part - begin) * part < 0:
            return
        t, y = t - part, _runge_kutta_step(RK4, rhs, t, -part, y)
        if not np.isfinite(y).all():
            return
        yield t, y


def unresolved(
    method: Any, groups: Grouping, rhs: Derivative, t: float, h: float, y: Array, end_of_run: float
) -> str | None:
    """Return a sentence on the part of the state that steps of length h from (t, y) do not resolve, or None.

    `method` is `Run.method`, and `groups` are the blocks of the state. Methods of one stage, and user-defined methods,
    are not judged: the error of a method of order 1 in a first step from rest is as large as the motion in this step.
    `rhs` is not called at times after `end_of_run`.
    """
    steps = int(min(STEPS, (end_of_run - t) / h * (1 + ROUNDING)))
    if method.b.size == 1 or steps < 2:
        return None
    step = _nystrom_step if method.nystrom else _runge_kutta_step
    shares, end = [], y
    for at in (t + h * np.arange(steps)).tolist():
        begin = end
        for part in range(SUBSTEPS):
            end = _runge_kutta_step(DOP853, rhs, at + part * h / SUBSTEPS, h / SUBSTEPS, end)
        own = step(method, rhs, at, h, begin)
        size = np.max([_norms(part, groups) for part in (end - begin, h * rhs(at, begin), begin)], axis=0)
        if not (np.isfinite(end).all() and np.isfinite(own).all() and size.max() > 0):
            return None
        # Rounding in the tails of a field is not resolved.
        shares.append(_norms(own - end, groups) / (size + LEAST_CHANGE * size.max()))
    second, largest = np.sort(shares, axis=0)[-2:]
    errors = np.where(largest > LOST, largest, second)
    block = int(errors.argmax())
    if errors[block] < next(share for stages, share in reversed(UNRESOLVED.items()) if method.b.size >= stages):
        return None
    return (
        f"steps of h={abs(h):g} do not resolve the motion of component{_components(groups, block)} of the state: at "
        f"t={t:.6g} the error of one step is {errors[block]:.2g} of the size of this part or of its change; take a "
        "shorter step"
    )


def _runge_kutta_step(method: Any, rhs: Derivative, t: float, h: float, y: Array) -> Array:
    """Return the state (n,) after a step of length h, which may be negative, by a Runge-Kutta method."""
    K = np.empty((method.b.size, y.size), y.dtype)
    for i in range(method.b.size):
        K[i] = rhs(t + method.c[i] * h, y + h * (method.A[i, :i] @ K[:i]))
    return y + h * (method.b @ K)


def _nystrom_step(method: Method, rhs: Derivative, t: float, h: float, y: Array) -> Array:
    q, v = np.split(y, 2)
    a = np.empty((method.b.size, q.size), y.dtype)
    for i in range(method.b.size):
        stage = q + h * (method.c[i] * v + h * (method.A[i, :i] @ a[:i]))
        a[i] = rhs(t + method.c[i] * h, np.concatenate([stage, v]))[q.size :]
    return np.concatenate([q + h * (v + h * (method.b @ a)), v + h * (method.b_v @ a)])


def _norms(state: Array, groups: Grouping) -> Array:
    """Return an array with the 2-norm of each block of a state."""
    squares = np.ascontiguousarray(state).view(float)[groups.member] ** 2
    return np.sqrt(np.add.reduceat(squares, groups.start[:-1].astype(np.intp)))


def _components(groups: Grouping, block: int) -> str:
    """Return the text after "component" in a message that names the components of a block: " 3" or "s 0, 1, 2"."""
    floats = groups.member[groups.start[block] : groups.start[block + 1]].astype(int)
    places = np.unique(floats // groups.width).tolist()
    return f" {places[0]}" if len(places) == 1 else "s " + ", ".join(map(str, places[:6])) + ", ..." * (len(places) > 6)
