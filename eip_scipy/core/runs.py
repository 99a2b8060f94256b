"""A run that is ready to step: its buffers and options, and the checks during the run."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np

from ..engine.data import BY_ERROR, EXAMINED, NO_BALANCES, NO_METHOD, NOTHING, REASON, Schedule, Work
from ..engine.native import BUILD, Call, Engine, Hooks, NativeFunctions, PythonFunctions
from ..engine.trust import Trust
from ..methods.base import Method
from .callers import users_level
from .conserved import Conserved
from .examination import Derivative, Examiner, is_check_due, unresolved
from .invariant_checks import listed
from .invariant_set import InvariantSet
from .linear import confirmed
from .options import Options
from .results import Diagnostics, slowness
from .stepping import Stepping

__all__ = ["Counted", "Run", "Start", "parts_of", "run_of"]

# Fields that a copy of a run makes again, copies by itself, or does not need.
BOUND = ("tableau", "work", "invariants", "trust", "identity")


class Start(NamedTuple):
    """Start of a run: time, state, derivative, and the length of the fixed or first step, which is a scale of time."""

    t: float
    y: np.ndarray
    f: np.ndarray
    tau: float


@dataclass
class Run:
    """A run that `RunSpec.build` has made: everything that a driver needs, except the user's functions.

    The invariants were measured at `begin`; `start`, of the first step, may have been moved by `project_initial`, and
    `moved` says how far. `tableau` is the method as it was given, and `method` the form of it that the engine uses for
    the steps. `identity`: see `settled`. `called` is the argument that gave the right-hand side, and `left_out` a
    possible cause of NaN in its value, for messages. `looked` is the step at which the invariants were checked last.
    `depends_on_time` is True if an invariant depends on time; its scale then depends on the start. `conserved` is what
    the system conserves in addition to the invariants.
    """

    begin: Start
    start: Start
    stepping: Stepping
    tableau: Method
    method: Any
    options: Options
    work: Work
    invariants: InvariantSet
    identity: Callable[[], dict[str, Any]]
    trust: Trust
    conserved: Conserved
    called: str = "fun"
    left_out: str = ""
    looked: int = -1
    moved: str = ""
    warned_of_balances: bool = False
    depends_on_time: bool = False

    @property
    def y0(self) -> np.ndarray:
        """Return the state at which the first step starts."""
        return self.start.y

    def engine(
        self, functions: PythonFunctions | NativeFunctions, schedule: Schedule, *, begins: bool = True
    ) -> Engine:
        """Return the engine of the run, which it `begins` or continues; work.K[0] must hold the derivative there."""
        joint = None if functions.native else self.options.joint
        hooks = self.tableau.hooks(self.method, self.work)._replace(joint=joint)
        needed = hooks if hooks != Hooks() else None
        engine, w = Engine(self.method, self.options, self.work, functions, schedule, needed), self.work
        if self.options.watched and begins:
            t, f = schedule.span.t0, w.K[0]
            if self.start is not self.begin:  # the buffers have the values and gradients at `begin`
                w.values[:], w.G[:] = self.invariants.values(t, self.y0), self.invariants.gradients(t, self.y0, f)
            engine.start(self.y0, f, self.start.tau)
        return engine

    def projected(self, rhs: Derivative, t: float, y: np.ndarray) -> tuple[np.ndarray, int]:
        """Return the projection of a state, and the engine's status code; work.K[-1] must hold the derivative there."""
        derivative = Call(rhs, (), y.shape, lambda value, t: np.array(value, y.dtype))
        functions = PythonFunctions(derivative, *self.invariants.calls, (), second_order=False)
        engine = Engine(NO_METHOD, self.options._replace(joint=None, balances=NO_BALANCES), self.work, functions)
        self.work.y_hat[:], out = y, np.empty_like(y)
        return out, engine.project(t, y, t, True, out)

    def attach(self, diagnostics: Any) -> None:
        """Let `diagnostics` read the run's buffers."""
        if not isinstance(diagnostics, Diagnostics):
            raise TypeError(f"diagnostics must be a Diagnostics() object, got {diagnostics!r}.")
        w = self.work
        diagnostics._attach(
            max_residual=w.max_residual,
            _residual=w.residual,
            _max_correction=w.max_correction,
            _counters=w.counters,
            _trust=self.trust,
            _estimated=self.options.metric == BY_ERROR,
            moved=self.moved,
            remarks=self.conserved.remarks,
            _slow=(self.invariants.balances.places, w.slow),
        )

    @property
    def shows(self) -> bool:
        """Return True if some steps may stay unprojected; the run then returns projected copies of their states."""
        return self.invariants.size > 0 and (self.options.every != 1 or self.tableau.has_history)

    def look(self, steps: int, ended: bool, t: float, y: np.ndarray, rhs: Derivative) -> bool:
        """Examine a run after `steps` steps, or at its end (`ended`), and return True if it must be reported as faulty.

        Steps that the engine has marked as suspicious are examined. The invariants are checked after 10, 100, 1000, ...
        steps, at the end, and if the corrections are too large, to find the reason. `rhs` returns a new array.
        """
        return bool(BUILD.call(self._look, steps, ended, t, y, rhs))

    def _look(self, steps: int, ended: bool, t: float, y: np.ndarray, rhs: Derivative) -> bool:
        if self.trust.failed or not self.options.watched:  # a failure has its own message
            return False
        if ended:
            self._warn_of_fast_balances()
            self._warn_of_refuted_constraints(t, y, rhs)
        suspect = self.work.suspect
        if self.trust.doubts:
            # One examination is still needed for the rates of the invariants, which are used to judge corrections.
            if suspect[REASON] != NOTHING and not self.work.trust[:, EXAMINED].any():
                self.examiner.examine(suspect, rhs)
            return self._is_doubtful(ended)
        found = self.examiner.examine(suspect, rhs) if suspect[REASON] != NOTHING else None
        due = (ended or is_check_due(steps)) and steps != self.looked
        doubtful = not due and self._is_doubtful(ended)
        if found is None and (due or doubtful):
            self.looked = steps
            found = self.examiner.complaint(rhs, t, y)
            doubtful = self._is_doubtful(ended)  # which depends on the rates that the examination has noted
        self.trust.doubts += [found] if found else []
        return found is not None or doubtful

    def _warn_of_fast_balances(self) -> None:
        """Warn once about balances that change too fast to be useful."""
        carried = self.invariants.balances
        if not carried.items or self.warned_of_balances:
            return
        found = slowness(self.work.slow)
        fast = np.flatnonzero(found > carried.most_slowness)
        if not fast.size:
            return
        self.warned_of_balances = True
        names, bound = [self.invariants.names[place] for place in carried.places[fast]], carried.most_slowness[fast[0]]
        warnings.warn(
            f"balance {listed(names)} changes too fast to be of much use: on average its rate is "
            f"{found[fast].max():.2g} of the sum of the absolute values of the terms of grad @ f (the largest of "
            f"Diagnostics.slowness). Above {bound:g} a balance hardly improves the result. Compare with a run without "
            "it, or with other tolerances.",
            UserWarning,
            stacklevel=users_level(),
        )

    def _warn_of_refuted_constraints(self, t: float, y: np.ndarray, rhs: Derivative) -> None:
        """Warn if linear invariants that were found at the start do not hold at the state y, as in contact."""
        linear = self.conserved.linear
        if not len(linear.C) or linear.C.shape[1] != y.size:
            return
        lost = len(linear.C) - len(linear.only(confirmed(y[None], rhs(t, y)[None], linear)).C)
        if lost:
            warnings.warn(
                f"{lost} of the {len(linear.C)} linear invariants that were found at the start do not "
                f"hold at t={t:.6g}. The corrections leave them unchanged, which may make the result less accurate. "
                "Pass linear_invariants=None.",
                UserWarning,
                stacklevel=users_level(),
            )

    def _is_doubtful(self, ended: bool) -> bool:
        """Return True if corrections or errors show that the run is faulty, before its end without hope of recovery."""
        return self.trust.is_sick if ended else self.trust.beyond_doubt

    @cached_property
    def examiner(self) -> Examiner:
        """Return the `Examiner` of the run's steps and states."""
        resolution = partial(unresolved, self.method, self.options.groups)
        return Examiner(self.invariants, self.invariants.tau, self.work.trust, resolution)


class Counted:
    """A right-hand side that counts its calls and returns new arrays."""

    __slots__ = ("_rhs", "count")

    def __init__(self, rhs: Callable[[float, np.ndarray], np.ndarray]) -> None:
        self._rhs = rhs
        self.count = 0

    def __call__(self, t: float, y: np.ndarray) -> np.ndarray:
        """Return the derivative (n,) at (t, y) as a new array, and count the call."""
        self.count += 1
        return self._rhs(t, y).copy()

    def uncount(self, calls: int) -> None:
        """Take back the count of some calls."""
        self.count -= calls


def parts_of(run: Run) -> dict[str, Any]:
    """Return the values and arrays, by name, from which `run_of` makes a run again, apart from the invariants.

    The new run continues with the same bits, in this process or another one. The values are fields of the run, a copy
    of its buffers, and attributes of its `Trust`. If a solver of SciPy makes the steps, the attributes of that solver
    are among them. A user-defined one-step method is not.
    """
    values = {item.name: getattr(run, item.name) for item in fields(run) if item.name not in BOUND}
    values["options"] = run.options._replace(joint=None)
    if run.tableau.in_python:
        values["method"] = run.method.state() if run.tableau.drives else None
    return values | {"work": copy.deepcopy(run.work), "doubts": list(run.trust.doubts), "failed": run.trust.failed}


def run_of(parts: dict[str, Any], invariants: InvariantSet, method: Any, *, joint: bool) -> Run:
    """Return a run made from its parts, with copies of their buffers.

    `invariants` is a new set of the same invariants, made at the same start. `joint` is True if the run projects them
    with their functions `moments` and `shift`.
    """
    values = copy.deepcopy(parts)
    if method.in_python:
        values["method"] = method.for_engine()
    if joint:
        values["options"] = values["options"]._replace(joint=invariants.items)
    invariants.target = values["options"].target  # those of balances change
    trust = Trust(invariants.names, values["work"].trust)
    trust.doubts, trust.failed = values.pop("doubts"), values.pop("failed")
    return Run(**values, tableau=method, invariants=invariants, trust=trust, identity=dict)
