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
from ..engine.data import NO_METHOD, Dense, new_work
from ..engine.native import Call, Engine, PythonFunctions
from ..methods.base import PROJECTION_ONLY, DenseForm
from .bound_problem import BoundProblem
from .inputs import reals, shown
from .projection import ProjectionOptions
from .runs import Run
from .step_control import StepControl

__all__ = ["ExactEnds", "Interpolants", "ManifoldDenseOutput", "solution"]

Array = np.ndarray
ITERATIONS = 5
# Capacity for roots of events that the loop finds between two queries, and for the floats of their states.
MOST_ROOTS, ROOT_NUMBERS = 1024, 2**17


class _Immutable:
    """Mixin of objects that are their own copies, because they do not change."""

    def __copy__(self) -> Any:
        return self

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        return self


class Interpolants(_Immutable):
    """Interpolants of a run, created and evaluated by its engine, whose dense output is switched on.

    If the run does not project each step, the states after unprojected steps are returned as projected copies.
    Interpolated states are projected too, onto levels of the invariants between those at the two ends of the step. The
    levels differ from the targets by invariant errors that are interpolated linearly between the two ends, where they
    are 1e-15 to 1e-12 after a projection, and larger if the step was not projected. The states at the ends are met
    exactly. The change of balances between the ends is interpolated in the same way as the state, and is added to their
    levels.

    The engine's loop looks for the roots of `events` functions. ``errors()`` returns a context manager that replaces
    the engine's error in a compiled function by the user's exception, such as `Driver.own_errors`. The `form` is that
    of the run's method by default. A pickle has the form alone, without the functions and the invariants of the run.
    """

    def __init__(
        self,
        run: Run,
        engine: Engine,
        events: int = 0,
        errors: Callable[[], AbstractContextManager[None]] = nullcontext,
        form: DenseForm | None = None,
    ) -> None:
        self._form, self._method = form or run.method.dense_form(run.stepper), run.stepper
        self.record = _record(run, self._form, events)
        self._engine, self._dtype, self._n, self._errors = engine, run.y0.dtype, run.y0.size, errors
        self._lock = threading.RLock()  # all threads share one buffer
        engine.sample(self.record)

    def __reduce__(self) -> Any:
        return _without_functions, (self._form, self._method.b.size, self._method.multistep, self._n, self._dtype)

    @property
    def floats(self) -> int:
        """Number of floats in an interpolant."""
        return self.record.piece.size

    @property
    def pickled_floats(self) -> int:
        """Number of the floats that do not belong to invariants, which precede the others."""
        return 3 + (3 + self._form.rows) * self._n * (self._dtype.itemsize // 8)

    def over(self, t_old: float, y_old: Array, t: float, y: Array) -> ManifoldDenseOutput:
        """Return the dense output over the last step, from (t_old, y_old) to (t, y)."""
        segment = np.empty(self.floats)
        with self._lock, self._errors():
            self._engine.describe(t_old, y_old, t, y, segment)
        return ManifoldDenseOutput(self, segment)

    def shown(self, t: float, y: Array) -> Array:
        """Return a copy of the last state `y` at `t` as the run saves it: projected if its step left it unprojected."""
        out = np.empty_like(y)
        with self._lock, self._errors():
            self._engine.show(t, y, out)
        return out

    def states(self, segment: Array, times: Array) -> Array:
        """Return the states (n, m) at times (m,) from `segment`, the floats of an interpolant."""
        out = np.empty((times.size, self._n), self._dtype)
        with self._lock, self._errors():
            self._engine.interpolate(segment, times, out)
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


def _record(run: Run, form: DenseForm, events: int) -> Dense:
    roots = min(MOST_ROOTS, ROOT_NUMBERS // run.y0.size) if events else 0
    n, dtype, invariants = run.y0.size, run.y0.dtype, run.invariants.size
    balances, stages = run.invariants.balances.places.size, run.stepper.b.size
    options = run.options._replace(
        metric=data.GIVEN, direction=data.NEW, every=1, compensated=False, iterations=ITERATIONS, watched=False,
        limit=math.inf, target=np.zeros(invariants), uses_f=run.invariants.uses_f,
    )  # fmt: skip
    width, further = dtype.itemsize // 8, form.c.size
    return Dense(
        kind=form.kind,
        weights=form.weights.copy("C"),
        A=form.A.copy("C"),
        c=form.c.copy(),
        own_slopes=form.own_slopes,
        shows=run.shows,
        by_travel=invariants > 0 and run.options.metric == data.BY_ERROR,
        options=options,
        work=new_work(
            n, dtype, stages + further if further else 1, invariants, options.blocks.start.size - 1, balances
        ),
        missed=np.zeros(2),
        waiting=np.zeros(2, np.int64),
        piece=np.zeros(3 + (3 + form.rows) * n * width + 2 * invariants + (2 + form.rows) * balances),
        event=np.zeros(roots, np.int64),
        t=np.zeros(roots),
        y=np.zeros((roots, n), dtype),
        counts=np.zeros(3, np.int64),
        left=np.zeros(events),
        pending_event=np.zeros(data.MOST_CROSSINGS * events, np.int64),
        pending_t=np.zeros(data.MOST_CROSSINGS * events),
    )


def _without_functions(form: DenseForm, stages: int, history: Any, n: int, dtype: np.dtype) -> Interpolants:
    """Return the interpolants of a run without invariants and without steps, which evaluate those of another run."""
    method, options = PROJECTION_ONLY, ProjectionOptions(invariants=(), check=False)
    problem = BoundProblem(lambda t, y: y, start := np.zeros(n, dtype))
    run = Run(problem, "dense output", method, StepControl.without_steps(0.0, n), options).start_at(start)
    if history is not None:
        rows = len(history.rates)
        history = history._replace(
            corrected_count=0, levels=np.zeros((3, 0)), rates=np.zeros((rows, 0)), rate_sums=np.zeros((2, 0))
        )
    none, A = np.zeros(stages), np.zeros((stages, stages))
    run.stepper = NO_METHOD._replace(A=A, b=none, b_low=none, b_v=none, b_v_low=none, c=none, multistep=history)
    run.work = new_work(n, dtype, stages, 0, run.options.blocks.start.size - 1)
    functions = PythonFunctions(Call(problem.fun, (), (n,), lambda value, t: value), (), (), (), second_order=False)
    engine = Engine(run.stepper, run.options._replace(compensated=history is not None), run.work, functions)
    return Interpolants(run, engine, form=form)


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


class ManifoldDenseOutput(_Immutable, AtRealTimes):
    """An interpolant over one step, see `Interpolants`; `segment` are the floats of the interpolant.

    A pickle does not hold the functions of the run: samples of an unpickled interpolant are not projected, so that they
    are as accurate as SciPy's and do not meet the invariants; the states at both ends are the same. A copy by
    `copy.deepcopy` shares the functions.
    """

    def __init__(self, interpolants: Interpolants, segment: Array) -> None:
        super().__init__(float(segment[0]), float(segment[1]))
        self._interpolants, self._segment = interpolants, segment

    def __reduce__(self) -> Any:
        return ManifoldDenseOutput, (self._interpolants, self._segment[: self._interpolants.pickled_floats])

    def _call_impl(self, t: Array) -> Array:
        times = np.array(t, float, ndmin=1)
        out = self._interpolants.states(self._segment, times)
        return out[:, 0] if t.ndim == 0 else out


class _Segments(_Immutable, Sequence[ManifoldDenseOutput]):
    """Sequence of interpolants, made when requested from `segments` (m, floats), whose rows are their floats."""

    def __init__(self, interpolants: Interpolants, segments: Array) -> None:
        self._interpolants, self._segments = interpolants, segments

    def __reduce__(self) -> Any:
        return _Segments, (self._interpolants, self._segments[:, : self._interpolants.pickled_floats])

    def __len__(self) -> int:
        return len(self._segments)

    def __getitem__(self, k: Any) -> Any:
        if isinstance(k, slice):
            return [ManifoldDenseOutput(self._interpolants, segment) for segment in self._segments[k]]
        return ManifoldDenseOutput(self._interpolants, self._segments[k])


class _AtRest(AtRealTimes):
    """Dense output of a run without steps: it returns the state y at all times."""

    def __init__(self, t: float, y: Array) -> None:
        super().__init__(t, t)
        self._y = y.copy()

    def _call_impl(self, t: Array) -> Array:
        return self._y.copy() if t.ndim == 0 else np.repeat(self._y[:, None], t.size, axis=1)


def solution(interpolants: Interpolants, segments: Array, t_end: float, y_end: Array) -> OdeSolution:
    """Return the dense output over a run, which ends at (t_end, y_end), from the interpolants of its steps (m, floats).

    If an event ended the run at the beginning of a step, the dense output extends to the end of that step.
    """
    if not len(segments):
        return OdeSolution([t_end, t_end], [_AtRest(t_end, y_end)])
    if segments[-1, 0] == t_end:
        t_end = segments[-1, 1]
    return OdeSolution(np.append(segments[:, 0], t_end), _Segments(interpolants, segments))
