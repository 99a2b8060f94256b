"""From a user's options to what the step needs: validation, in one place for `solve_ivp` and `integrate`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import OdeSolver

from ..engine.data import (
    EPS,
    ERROR,
    EUCLIDEAN,
    EXAMINED,
    HAVE_NODES,
    LAST_RANK,
    LENGTH,
    NEW,
    NEWEST,
    NO_METHOD,
    NOT_FINITE,
    NOTHING,
    REASON,
    TIME,
    TIME_NEW,
    TOO_SMALL,
    UNSTABLE,
    Schedule,
    Work,
)
from ..engine.native import Call, Engine, Hooks, NativeFunctions, PythonFunctions
from ..engine.trust import Trust
from . import steppers
from .blocks import kinds_of
from .examination import Derivative, Examiner, is_check_due
from .frame import spanned
from .inputs import reals, refuse_units, shown
from .invariants import TARGET_TOLERANCE, InvariantSet
from .one_step import as_vector
from .options import Options, ProjectionOptions
from .resolution import unresolved
from .results import Diagnostics
from .stepping import AnyMethod, Stepping

__all__ = ["Projection", "Run", "Start", "as_derivative", "prepare"]

START_ITERATIONS = 50
FRAME_DISTANCE = 1e-4


class Start(NamedTuple):
    """Where a run starts: time, state, derivative there, and the scale of time, which is the step or the first one."""

    t: float
    y: np.ndarray
    f: np.ndarray
    tau: float


@dataclass
class Run:
    """All that a driver needs, apart from the user's functions.

    `tableau` is the method as it was given, `method` what the engine takes its steps by. `called` is the name of the
    argument that gave the right-hand side. `left_out`: what NaN in its value may come from. `moved` says how far
    `project_initial` has moved y0, or is empty.
    """

    y0: np.ndarray
    tableau: AnyMethod
    method: Any  # Method, or OneStep
    options: Options
    work: Work
    invariants: InvariantSet
    identity: dict[str, Any]  # see `Settled`
    trust: Trust
    tau: float
    called: str = "fun"
    left_out: str = ""
    looked: int = -1
    moved: str = ""

    def engine(
        self, functions: PythonFunctions | NativeFunctions, schedule: Schedule, *, begins: bool = True, **others: Any
    ) -> Engine:
        """Return the engine of the run, which `begins` where work.K[0] is the derivative, or is to go on.

        `others` are further `Hooks`.
        """
        in_python = self.tableau.in_python
        hooks = Hooks(
            one_step=partial(self.method.fill, self.work) if in_python else None,
            estimates=in_python and self.tableau.has_estimate,
            joint=None if functions.native else self.options.joint,
            **others,
        )
        engine, w = Engine(self.method, self.options, self.work, functions, schedule, _if_any(hooks)), self.work
        if self.options.watched and begins:
            t, f = schedule.span.t0, w.K[0]
            w.values[:], w.G[:] = self.invariants.values(t, self.y0), self.invariants.gradients(t, self.y0, f)
            engine.start(self.y0, f, self.tau)
        return engine

    @property
    def shows(self) -> bool:
        """Return whether states that are not projected are handed out as projected copies."""
        return self.invariants.size > 0 and (self.options.every != 1 or self.tableau.has_history)

    def look(self, steps: int, ended: bool, t: float, y: np.ndarray, rhs: Derivative) -> bool:
        """Examine a run after `steps` steps, or where it has `ended`. Return whether it is to be reported now.

        Steps that the engine suspects are examined. The invariants are checked after some numbers of steps and at the
        end, and where the corrections are too large, to find the reason. `rhs` returns a new array.
        """
        if not self.options.watched or self.trust.failed:
            return False  # a failure has its own message
        suspect = self.work.suspect
        if self.trust.doubts:
            # One examination still has to tell how fast the invariants change, by which corrections are judged.
            if suspect[REASON] != NOTHING and not self.work.trust[:, EXAMINED].any():
                self.examiner.examine(suspect, rhs)
            return self._is_doubtful(ended)
        found = self.examiner.examine(suspect, rhs) if suspect[REASON] != NOTHING else None
        due = ended or is_check_due(steps)
        if found is None and ((due and steps != self.looked) or self._is_doubtful(ended)):
            self.looked = steps
            found = self.examiner.complaint(rhs, t, y)
        self.trust.doubts += [found] if found else []
        return self._is_doubtful(ended) or found is not None

    def _is_doubtful(self, ended: bool) -> bool:
        """Return whether the corrections contradict the run, or will do so at its end."""
        return self.trust.beyond_doubt or (ended and bool(self.trust.sick.any()))

    @cached_property
    def examiner(self) -> Examiner:
        """Return the examiner of the run's states."""
        resolution = partial(unresolved, self.method, self.options.groups)
        return Examiner(self.invariants, self.tau, self.work.trust, resolution)


class Counted:
    """A right-hand side that counts its calls and returns new arrays."""

    __slots__ = ("_rhs", "count")

    def __init__(self, rhs: Callable[[float, np.ndarray], np.ndarray]) -> None:
        self._rhs = rhs
        self.count = 0

    def __call__(self, t: float, y: np.ndarray) -> np.ndarray:
        self.count += 1
        return self._rhs(t, y).copy()


def _if_any(hooks: Hooks) -> Hooks | None:
    return hooks if hooks != Hooks() else None


def as_derivative(value: Any, n: int, dtype: np.dtype, t: float, name: str = "fun") -> np.ndarray:
    """The value of a user's right-hand side at t as an array (n,), or an error; see `as_vector`."""
    return as_vector(value, n, dtype, f"{name} returned", t)


def initial_state(y0: Any, name: str = "y0") -> np.ndarray:
    """y0 as a new float64 or complex128 array (n,), with SciPy's messages for what is no state."""
    y = states(name, y0)
    if y.ndim != 1:
        raise ValueError(f"`{name}` must be 1-dimensional.")
    if not np.isfinite(y).all():
        raise ValueError(f"All components of the initial state `{name}` must be finite.")
    return y


def states(name: str, value: Any) -> np.ndarray:
    """A state, or several, as a new float64 or complex128 array of any shape.

    Raises
    ------
    TypeError
        For what holds no numbers, or numbers with a unit.
    ValueError
        For masked values.
    """
    refuse_units(**{name: value})
    if np.ma.isMaskedArray(value) and np.ma.is_masked(value):
        raise ValueError(f"masked values in {name}; fill or drop them first.")
    found = reals(value)
    if found is not None:
        return found
    try:
        y = np.asarray(value)
    except ValueError:  # rows of different lengths
        raise ValueError(f"`{name}` must be an array of numbers, got {shown(value)}.") from None
    if y.dtype.kind != "c":
        raise TypeError(f"`{name}` must hold numbers, got {shown(value)}, dtype {y.dtype}.")
    return np.array(y, dtype=complex, order="C")


def prepare(
    method: AnyMethod,
    rhs: Callable[[float, np.ndarray], np.ndarray],
    start: Start,
    projection: ProjectionOptions,
    stepping: Stepping,
    *,
    extra: tuple = (),
    check_start: bool = True,
) -> Run:
    """Check a run's options and make its buffers; the invariants are checked at the start.

    Parameters
    ----------
    method : Tableau, NystromTableau, GaussJackson or OneStep
    rhs : callable
        ``rhs(t, y) -> (n,)``, checked; called if the start is projected, and by checks of the invariants.
    start : Start
    projection : ProjectionOptions
    stepping : Stepping
    extra : tuple
        Further arguments of the invariants' functions (``(params,)`` or nothing).
    check_start : bool
        False: the invariants have been checked, and their cost told, at the start of another run like this.
    """
    t0, y0, f0, tau = start
    invariants = InvariantSet(
        projection.invariants, t0, y0, f0, tau, extra, tell=check_start, t_bound=stepping.span.t_bound, rhs=rhs
    )
    options, sigma, identity = projection.settled(method, stepping, y0, invariants)
    options = options._replace(kinds=kinds_of(options.groups, y0, f0))
    invariants.kinds = options.kinds
    options = options._replace(scales=_scales(options, invariants, start))
    arrays = steppers.arrays(method)
    work = Work(y0.size, y0.dtype, arrays.b.size, invariants.size, options.groups.start.size - 1)
    if sigma is not None:
        work.sigma[:] = sigma
    run = Run(y0, method, arrays, options, work, invariants, identity, Trust(invariants.names, work.trust), tau)
    if projection.project_initial:
        run.y0 = projected_start(run, rhs, t0, f0)
        run.moved = _moved(y0, run.y0, invariants.floors)
        f0 = rhs(t0, run.y0)
    violation = invariants.start_violation(t0, run.y0, f0)
    if violation:
        raise ValueError(f"{violation}; mend y0 or the target, or pass project_initial=True to project y0 first.")
    if options.watched and check_start and np.isfinite(f0).all():
        run.trust.doubts += invariants.check(t0, run.y0, f0, tau)
    return run


def _scales(options: Options, invariants: InvariantSet, start: Start) -> np.ndarray:
    """Scales of the invariants' dead bands: endless ones for what is a function of the frame's C y.

    Corrections do not touch these, and nothing but rounding is left of their gradients once the frame is taken out.
    At two states, for a gradient may lie in the frame by chance.
    """
    t0, y0, f0, tau = start
    if options.frame.products.size == 0:
        return options.scales
    away = FRAME_DISTANCE * (np.abs(y0) + tau * np.abs(f0)) * np.cos(np.arange(y0.size))
    held = [spanned(options.frame, invariants.gradients(t0, y, f0).view(float)) for y in (y0, y0 + away)]
    return np.where(np.all(held, axis=0), invariants.term_sizes(t0, y0, f0) / EPS, options.scales)


def projected_start(run: Run, rhs: Callable[[float, np.ndarray], np.ndarray], t0: float, f0: np.ndarray) -> np.ndarray:
    """y0 on the targets, by full Newton steps in the euclidean metric."""
    options = run.options._replace(
        metric=EUCLIDEAN, direction=NEW, iterations=START_ITERATIONS, compensated=False, watched=False, limit=np.inf
    )
    projection = Projection(run.invariants, options, rhs)
    projection.work.K[-1] = f0
    y, status = projection(t0, run.y0)
    work = projection.work
    if status != 0 or run.invariants.misses(t0, y, f0).any():
        raise ValueError(projection_failure(run.invariants, work, t0))
    return y


def _moved(before: np.ndarray, after: np.ndarray, floors: np.ndarray) -> str:
    """Return how far a start was moved, or nothing where that is no more than a target may be missed by."""
    share = np.abs(after - before) / np.maximum(np.abs(before), floors)
    count, k = int(np.count_nonzero(share > TARGET_TOLERANCE)), int(np.argmax(share)) if share.size else 0
    if not count:
        return ""
    return (
        f"project_initial moved {count} of {share.size} components of y0, most of all y0[{k}], from {before[k]:.6g} to "
        f"{after[k]:.6g}"
    )


class Projection:
    """The projection by itself; `work` may be filled before a call: K[-1] with f there, sigma with weights.

    Parameters
    ----------
    invariants : InvariantSet
    options : Options
    rhs : callable
        ``rhs(t, y) -> (n,)``, checked, for gradients that take f in iterations.
    """

    def __init__(
        self, invariants: InvariantSet, options: Options, rhs: Callable[[float, np.ndarray], np.ndarray]
    ) -> None:
        n, dtype = invariants.shape[1], invariants.dtype
        self.work = Work(n, dtype, 0, invariants.size, options.groups.start.size - 1)
        derivative = Call(rhs, (), (n,), lambda value, t: np.array(value, dtype))
        functions = PythonFunctions(derivative, *invariants.calls, (), second_order=False)
        self._engine = Engine(NO_METHOD, options._replace(joint=None), self.work, functions)

    def __call__(self, t: float, y: np.ndarray) -> tuple[np.ndarray, int]:
        """The state projected, and the engine's code."""
        self.work.y_hat[:] = y
        out = np.empty_like(self.work.y_hat)
        return out, self._engine.project(t, y, t, True, out)


def projection_failure(invariants: InvariantSet, work: Work, t: float) -> str:
    """Which invariant a failed projection left worst, by how much, and the rank it had."""
    excess = np.abs(work.defect) / np.maximum(work.band, np.finfo(float).tiny)
    worst = int(np.argmax(np.where(np.isfinite(excess), excess, np.inf)))
    broken = [name for name, row in zip(invariants.names, work.G, strict=True) if not np.isfinite(row).all()]
    because = f"; the gradient of {broken[0]!r} is not finite there" if broken else ""
    return (
        f"projection failed at t={t:g}: invariant {invariants.names[worst]!r}, residual {work.defect[worst]:.3g}, "
        f"rank {int(work.counters[LAST_RANK])} of {invariants.size}{because}"
    )


def failure(status: int, run: Run, clock: Sequence[float] | np.ndarray) -> str:
    """Why a step failed."""
    if status == NOT_FINITE:
        return not_finite(run, clock[TIME], clock[LENGTH])
    if status == TOO_SMALL:
        return OdeSolver.TOO_SMALL_STEP
    if status == UNSTABLE:
        return _unstable(run)
    return projection_failure(run.invariants, run.work, clock[TIME_NEW])


def _unstable(run: Run) -> str:
    """Where a multistep method's step does not do."""
    history = run.method.multistep
    assert history is not None  # whose code it is
    t = history.t0 + int(history.place[NEWEST]) * history.h
    return (
        f"the step is too long, or the motion not smooth, at t={t:.10g}: differences of the accelerations of order "
        f"{history.predict_q.size} are not small beside them, as they are where h={abs(history.h):g} is stable and "
        "resolves the motion. Take a shorter step, or where bodies meet or forces jump a method of single steps such "
        "as EIPRKN12"
    )


def not_finite(run: Run, t: float, h: float) -> str:
    """Why a step was not finite: the first stage that was not, overflow of the sum, or the error estimate."""
    work, method = run.work, run.method
    history = method.multistep
    if history is not None and history.place[HAVE_NODES] and not np.isfinite(work.K[1]).all():
        return _bad_value(run, work.K[1], history.t0 + (int(history.place[NEWEST]) + 1) * history.h)
    for i in range(method.b.size):
        if not np.isfinite(work.K[i]).all():
            return _bad_value(run, work.K[i], t + method.c[i] * h)
    if not np.isfinite(work.y_hat).all():
        return f"the state is no longer finite at t={t + h:.10g}: it overflowed, or h is too large"
    if not np.isfinite(work.K[-1]).all():
        return _bad_value(run, work.K[-1], t + h)
    return f"the error estimate is not finite at t={t + h:.10g}: it overflowed, or y and `atol` are 0 in a component"


def _bad_value(run: Run, f: np.ndarray, t: float) -> str:
    unset = np.flatnonzero(np.isnan(f))
    hint = ""
    if run.left_out and unset.size:
        hint = f" (component {unset[0]} is NaN; {run.left_out})"
    return f"{run.called} returned a non-finite value at t={t:.10g}{hint}"


def attach(diagnostics: Any, run: Run) -> None:
    """Let `diagnostics` read the run's buffers."""
    if diagnostics is None:
        return
    if not isinstance(diagnostics, Diagnostics):
        raise TypeError(f"diagnostics must be a Diagnostics() object, got {diagnostics!r}.")
    w = run.work
    diagnostics._attach(
        w.max_defect,
        w.defect,
        w.max_correction,
        w.counters,
        run.trust,
        estimated=run.options.metric == ERROR,
        moved=run.moved,
    )
