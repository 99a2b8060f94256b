"""Dense output: interpolants of the same orders as SciPy's that meet the projected states and stay on the manifold."""

from __future__ import annotations

import math
import threading
import warnings
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np
from scipy.integrate import DenseOutput, OdeSolution

from ..engine import data
from ..engine.data import Dense, Work
from ..engine.native import Engine
from .kept_dense import AtRealTimes, KeptDenseOutput, kept
from .runs import Run
from .steppers import form

__all__ = ["ExactEnds", "Interpolants", "ManifoldDenseOutput", "solution"]

Array = np.ndarray
ITERATIONS = 5
# Capacity for roots of events that the loop finds between two queries, and for the floats of their states.
MOST_ROOTS, ROOT_NUMBERS = 1024, 2**17


class Interpolants:
    """Interpolants of a run, created and evaluated by its engine, whose dense output is switched on.

    If the run does not project each step, the states after unprojected steps are returned as projected copies.
    Interpolated states are projected too, onto levels of the invariants between those at the two ends of the step. The
    levels differ from the targets by invariant errors that are interpolated linearly between the two ends, where they
    are 1e-15 to 1e-12 after a projection, and larger if the step was not projected. The states at the ends are met
    exactly. The change of balances between the ends is interpolated in the same way as the state, and is added to their
    levels.

    The engine's loop looks for the roots of `events` functions. ``errors()`` returns a context manager that replaces
    the engine's error in a compiled function by the user's exception, such as `Driver.own_errors`.
    """

    def __init__(
        self,
        run: Run,
        engine: Engine,
        events: int = 0,
        errors: Callable[[], AbstractContextManager[None]] = nullcontext,
    ) -> None:
        self.record = _record(run, events)
        self._engine, self._dtype, self._n, self._errors = engine, run.y0.dtype, run.y0.size, errors
        self._lock = threading.RLock()  # all threads share one buffer
        engine.sample(self.record)

    def __deepcopy__(self, memo: dict[int, Any]) -> Interpolants:
        return self  # it is immutable

    @property
    def floats(self) -> int:
        """Number of floats in an interpolant."""
        return self.record.piece.size

    def over(self, t_old: float, y_old: Array, t: float, y: Array) -> ManifoldDenseOutput:
        """Return the dense output over the last step, from (t_old, y_old) to (t, y)."""
        piece = np.empty(self.floats)
        with self._lock, self._errors():
            self._engine.describe(t_old, y_old, t, y, piece)
        return ManifoldDenseOutput(self, piece)

    def shown(self, t: float, y: Array) -> Array:
        """Return a copy of the last state `y` at `t` as the run saves it: projected if its step left it unprojected."""
        out = np.empty_like(y)
        with self._lock, self._errors():
            self._engine.show(t, y, out)
        return out

    def states(self, piece: Array, times: Array) -> Array:
        """Return the states (n, m) at times (m,) from `piece`, the floats of an interpolant."""
        out = np.empty((times.size, self._n), self._dtype)
        with self._lock, self._errors():
            self._engine.interpolate(piece, times, out)
        self.warn()
        return out.T

    def roots(self) -> tuple[Array, Array, Array]:
        """Return indices (k,), times (k,) and states (k, n) of the events found since the last call of `roots`."""
        record = self.record
        count = int(record.counts[0])
        record.counts[0] = 0
        return record.event[:count], record.t[:count], record.y[:count]

    def pending(self) -> tuple[Array, Array]:
        """Return the indices and times (k,) of the events in a step that the engine's loop left to the caller."""
        record = self.record
        count = int(record.counts[2])
        record.counts[2] = 0
        return record.pending_event[:count], record.pending_t[:count]

    def warn(self) -> None:
        """Warn if projections of interpolated states have failed since the last call of this function."""
        missed = self.record.missed
        if missed[0] > 0:
            others = f", and {missed[0] - 1:.0f} more" if missed[0] > 1 else ""
            missed[0] = 0
            warnings.warn(
                f"dense output at t={missed[1]}{others}: no state near the interpolant has the required values of the "
                "invariants; the unprojected state is returned. Take shorter steps, or correct grad",
                RuntimeWarning,
                stacklevel=2,
            )


def _record(run: Run, events: int) -> Dense:
    roots = min(MOST_ROOTS, ROOT_NUMBERS // run.y0.size) if events else 0
    brief = run.tableau.has_history and run.method.multistep.brief
    kind, rows, weights, A, c, own_slopes = form(run.tableau, brief)
    stages = run.method.b.size
    n, dtype, invariants = run.y0.size, run.y0.dtype, run.invariants.size
    carried = run.invariants.balances.places.size
    options = run.options._replace(
        metric=data.GIVEN, direction=data.NEW, every=1, compensated=False, iterations=ITERATIONS, watched=False,
        limit=math.inf, target=np.zeros(invariants),
    )  # fmt: skip
    width = 2 if dtype.kind == "c" else 1
    return Dense(
        kind=kind,
        weights=weights.copy("C"),
        A=A.copy("C"),
        c=c.copy(),
        own_slopes=own_slopes,
        shows=run.shows,
        by_travel=invariants > 0 and run.options.metric == data.BY_ERROR,
        options=options,
        work=Work(n, dtype, stages + c.size if c.size else 1, invariants, options.groups.start.size - 1, carried),
        missed=np.zeros(2),
        waiting=np.zeros(2, np.int64),
        piece=np.zeros(3 + (3 + rows) * n * width + 2 * invariants + (2 + rows) * carried),
        event=np.zeros(roots, np.int64),
        t=np.zeros(roots),
        y=np.zeros((roots, n), dtype),
        counts=np.zeros(3, np.int64),
        left=np.zeros(events),
        pending_event=np.zeros(data.MOST_CROSSINGS * events, np.int64),
        pending_t=np.zeros(data.MOST_CROSSINGS * events),
    )


class ExactEnds(AtRealTimes):
    """Dense output of `inner` that returns exactly the states `y_old` and `y` at the ends, without rounding."""

    def __init__(self, inner: DenseOutput, y_old: Array, y: Array) -> None:
        super().__init__(inner.t_old, inner.t)
        self._inner, self._y_old, self._y = inner, y_old, y

    def _call_impl(self, t: Array) -> Array:
        column = (slice(None),) + (None,) * t.ndim
        out = np.where(t == self.t_old, self._y_old[column], self._inner(t))
        return np.where(t == self.t, self._y[column], out)


class ManifoldDenseOutput(AtRealTimes):
    """An interpolant over one step, see `Interpolants`; `piece` are the floats of the interpolant.

    A pickle does not hold functions of the run. It holds the polynomial through projected states at Chebyshev nodes of
    the step, whose degree of 8, 16, 32 or 64 is chosen by its error. This polynomial meets the states at both ends
    exactly. In between it is within 1e-12 of the largest value of each component, and usually within 1e-14. It is less
    accurate if the projected interpolant is not smooth, which happens in steps so long that it lies far from the
    manifold. A copy (`copy.copy`, `copy.deepcopy`) is such an interpolant again, not the polynomial.
    """

    def __init__(self, interpolants: Interpolants, piece: Array) -> None:
        super().__init__(float(piece[0]), float(piece[1]))
        self._interpolants, self._piece = interpolants, piece

    def __copy__(self) -> ManifoldDenseOutput:
        return ManifoldDenseOutput(self._interpolants, self._piece)

    def __deepcopy__(self, memo: dict[int, Any]) -> ManifoldDenseOutput:
        return ManifoldDenseOutput(self._interpolants, self._piece.copy())

    def kept(self) -> KeptDenseOutput:
        """Return the polynomial that a pickle holds."""
        return kept(self.t_old, self.t, lambda times: self._interpolants.states(self._piece, times))

    def __reduce__(self) -> Any:
        return self.kept().__reduce__()

    def _call_impl(self, t: Array) -> Array:
        times = np.array(t, float, ndmin=1)
        out = self._interpolants.states(self._piece, times)
        return out[:, 0] if t.ndim == 0 else out


class _Pieces(Sequence[ManifoldDenseOutput]):
    """Sequence of interpolants, made when requested from `pieces` (m, floats), whose rows are their floats."""

    def __init__(self, interpolants: Interpolants, pieces: Array) -> None:
        self._interpolants, self._pieces = interpolants, pieces

    def __deepcopy__(self, memo: dict[int, Any]) -> _Pieces:
        return _Pieces(self._interpolants, self._pieces.copy())

    def __reduce__(self) -> Any:
        return list, ([piece.kept() for piece in self],)

    def __len__(self) -> int:
        return len(self._pieces)

    def __getitem__(self, k: Any) -> Any:
        if isinstance(k, slice):
            return [ManifoldDenseOutput(self._interpolants, piece) for piece in self._pieces[k]]
        return ManifoldDenseOutput(self._interpolants, self._pieces[k])


class _AtRest(AtRealTimes):
    """Dense output of a run without steps: it returns the state y at all times."""

    def __init__(self, t: float, y: Array) -> None:
        super().__init__(t, t)
        self._y = y.copy()

    def _call_impl(self, t: Array) -> Array:
        return self._y.copy() if t.ndim == 0 else np.repeat(self._y[:, None], t.size, axis=1)


def solution(interpolants: Interpolants, pieces: Array, t_end: float, y_end: Array) -> OdeSolution:
    """Return the dense output over a run, which ends at (t_end, y_end), from the interpolants of its steps (m, floats).

    If an event ended the run at the beginning of a step, the dense output extends to the end of that step.
    """
    if not len(pieces):
        return OdeSolution([t_end, t_end], [_AtRest(t_end, y_end)])
    if len(pieces) and pieces[-1, 0] == t_end:
        t_end = pieces[-1, 1]
    ts = np.append(pieces[:, 0], t_end)
    return OdeSolution(ts, _Pieces(interpolants, pieces))
