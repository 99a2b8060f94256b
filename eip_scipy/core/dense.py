"""Dense output: interpolants of the same orders as SciPy's that meet the projected states and stay on the manifold."""

from __future__ import annotations

import math
import threading
import warnings
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np
from numpy.polynomial.legendre import legint, legval
from numpy.polynomial.polynomial import polyder, polyint, polyval
from scipy.integrate import DenseOutput, OdeSolution

from ..engine import data
from ..engine.data import Dense, Work
from ..engine.native import Engine
from ..methods.base import DenseForm
from .inputs import reals, shown
from .runs import Run

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
        self._form = run.tableau.dense_form(run.method)
        self.record = _record(run, self._form, events)
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

    def unprojected(self, piece: Array) -> UnprojectedDenseOutput:
        """Return the interpolant without the functions of the run, from its floats."""
        kind, rows, weights, *_ = self._form
        m = self._n * self._dtype.itemsize // 8
        parts = piece[3 : 3 + (2 + rows) * m].reshape(2 + rows, m).copy()
        return UnprojectedDenseOutput(float(piece[0]), float(piece[1]), kind, parts, weights, self._dtype)

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


def _record(run: Run, shape: DenseForm, events: int) -> Dense:
    roots = min(MOST_ROOTS, ROOT_NUMBERS // run.y0.size) if events else 0
    kind, rows, weights, A, c, own_slopes = shape
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


class AtRealTimes(DenseOutput):
    """Dense output that raises a TypeError for times that are not real numbers."""

    def __call__(self, t: Any) -> Array:
        """Return the states at a time or at times (m,), as (n,) or (n, m)."""
        if type(t) not in (float, np.float64) and reals("t", t) is None:
            raise TypeError(f"dense output is defined at real times, got {shown(t)}.")
        return super().__call__(t)


class ExactEnds(AtRealTimes):
    """Dense output of `inner` that returns exactly the states `y_old` and `y` at the ends, without rounding."""

    def __init__(self, inner: DenseOutput, y_old: Array, y: Array) -> None:
        super().__init__(inner.t_old, inner.t)
        self._inner, self._y_old, self._y = inner, y_old, y

    def _call_impl(self, t: Array) -> Array:
        column = (slice(None),) + (None,) * t.ndim
        out = np.where(t == self.t_old, self._y_old[column], self._inner(t))
        return np.where(t == self.t, self._y[column], out)


class UnprojectedDenseOutput(AtRealTimes):
    """The interpolant of a step without its projection, which needs no functions: the content of a pickle.

    `parts` are the floats of the states at both ends, and of the further rows of an interpolant of this `kind`, with
    its `weights`, see `DenseForm`. The engine has the same formulas.
    """

    def __init__(self, t_old: float, t: float, kind: int, parts: Array, weights: Array, dtype: np.dtype) -> None:
        super().__init__(t_old, t)
        self._kind, self._parts, self._weights, self._dtype = kind, parts, weights, dtype

    def __reduce__(self) -> Any:
        arguments = self.t_old, self.t, self._kind, self._parts, self._weights, self._dtype
        return UnprojectedDenseOutput, arguments

    def _call_impl(self, t: Array) -> Array:
        times = np.array(t, float, ndmin=1)
        out = self._floats((times - self.t_old) / (self.t - self.t_old))
        for end, state in ((self.t_old, self._parts[0]), (self.t, self._parts[1])):
            out[:, times == end] = state[:, None]
        found = np.ascontiguousarray(out.T).view(self._dtype).T
        return found[:, 0] if t.ndim == 0 else found

    def _floats(self, s: Array) -> Array:
        """Return the floats (m, k) of the states at the shares s (k,) of the step."""
        h, start, rows = self.t - self.t_old, self._parts[0][:, None], self._parts[2:]
        rest, half = 1.0 - s, self._parts.shape[1] // 2
        if self._kind == data.CUBIC:
            r = rows[..., None]
            return start + s * (r[0] + rest * (rest * r[1] - s * r[2]))
        if self._kind == data.QUINTIC:
            place = rows.reshape(6, half)
            return np.concatenate([polyval(s, place), polyval(s, polyder(place)) / h])
        if self._kind == data.SEVENTH:
            out = np.zeros((start.size, s.size))
            for k, row in enumerate(rows[::-1]):
                out = (out + row[:, None]) * (rest if k % 2 else s)
            return start + out
        if self._kind == data.POLYNOMIAL:
            return polyval(s, np.vstack([start.T, rows[:-1]])) + _share(s) * rows[-1][:, None]
        if self._kind == data.NYSTROM:  # accelerations in Legendre polynomials of the step
            a = rows[:-1].reshape(-1, half)[: len(self._weights)]
            v, q = (legval(2 * s - 1, legint(a, k, lbnd=-1, scl=0.5)) for k in (1, 2))
            return self._moved(h * s, h * h * q, h * v) + _share(s) * rows[-1][:, None]
        back, nodes = int(rows[-1, 0]), rows[-1, 1]  # accelerations at nodes, and the step in units of their distance
        h = h / nodes
        order = self._weights.shape[1]
        a = self._weights[back * order : (back + 1) * order].T @ rows[:-2].reshape(-1, half)[:order]
        v, q = (polyval(s * nodes, polyint(a, k)) for k in (1, 2))
        return self._moved(h * nodes * s, h * h * q, h * v) + _share(s) * rows[-2][:, None]

    def _moved(self, passed: Array, q: Array, v: Array) -> Array:
        """Return the state after a time `passed`, in which accelerations add q to positions and v to velocities."""
        start, half = self._parts[0][:, None], self._parts.shape[1] // 2
        return np.concatenate([start[:half] + passed * start[half:] + q, start[half:] + v])


def _share(s: Array) -> Array:
    """Return the share, at the shares s of a step, of what an interpolant misses at the end of the step."""
    return s * s * (3.0 - 2.0 * s)


class ManifoldDenseOutput(AtRealTimes):
    """An interpolant over one step, see `Interpolants`; `piece` are the floats of the interpolant.

    A pickle does not hold the functions of the run: samples of an unpickled interpolant are not projected, so that they
    are as accurate as SciPy's and do not meet the invariants; the states at both ends are the same. A copy by
    `copy.deepcopy` shares the functions.
    """

    def __init__(self, interpolants: Interpolants, piece: Array) -> None:
        super().__init__(float(piece[0]), float(piece[1]))
        self._interpolants, self._piece = interpolants, piece

    def __copy__(self) -> ManifoldDenseOutput:
        return self  # it is immutable

    def __deepcopy__(self, memo: dict[int, Any]) -> ManifoldDenseOutput:
        return self

    def __reduce__(self) -> Any:
        return self._interpolants.unprojected(self._piece).__reduce__()

    def _call_impl(self, t: Array) -> Array:
        times = np.array(t, float, ndmin=1)
        out = self._interpolants.states(self._piece, times)
        return out[:, 0] if t.ndim == 0 else out


class _Pieces(Sequence[ManifoldDenseOutput]):
    """Sequence of interpolants, made when requested from `pieces` (m, floats), whose rows are their floats."""

    def __init__(self, interpolants: Interpolants, pieces: Array) -> None:
        self._interpolants, self._pieces = interpolants, pieces

    def __deepcopy__(self, memo: dict[int, Any]) -> _Pieces:
        return self  # it is immutable

    def __reduce__(self) -> Any:
        return list, ([self._interpolants.unprojected(piece) for piece in self._pieces],)

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
