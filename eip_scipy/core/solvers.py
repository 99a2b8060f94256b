"""The solver classes: EIP methods that `scipy.integrate.solve_ivp` takes as ``method=``."""

from __future__ import annotations

import copy
import copyreg
import inspect
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial
from operator import is_
from typing import Any, ClassVar

import numpy as np
import scipy.integrate
from scipy.integrate import DenseOutput, OdeSolver

from ..engine.data import FOUND, NEXT_LENGTH, NFEV, NJEV, NLU, OK, PENDING, WAITED, Work, bare_schedule
from ..engine.native import Call, PythonFunctions, call
from ..engine.trust import ProjectionWarning
from ..methods.base import Method
from ..methods.gauss_jackson import GaussJackson, jacobian_product
from ..methods.implicit import BDF, RADAU, Jacobian
from ..methods.nystrom import RKN86, RKN1210, NystromTableau
from ..methods.one_step import OneStep, OneStepMethod
from ..methods.runge_kutta import ATTRIBUTES, DOP853, RK1, RK2, RK3, RK4, RK5, RK23, RK45, Tableau, is_same, tableau_of
from .acceleration import BY_NAME
from .between_steps import Settings, checked_stepping, checked_vector, is_state, kept_state, settings_of
from .callers import users_level
from .dense import ExactEnds, Interpolants
from .examination import is_check_due
from .failures import failure
from .inputs import is_number, numbers, shown
from .invariant_set import InvariantSet
from .invariants import as_invariants
from .jitted import compiled_call
from .names import nearest
from .options import ProjectionOptions, takes_projection_options
from .results import Diagnostics
from .run_spec import RunSpec
from .runs import Run, Start, parts_of, run_of
from .states import as_derivative, initial_state
from .stepping import ATOL, StepOptions, Stepping, interval
from .tangent_vectors import NO_TANGENT_VECTORS, TangentVectors

__all__ = [
    "EIPBDF", "EIPDOP853", "EIPGJ12", "EIPGJ14", "EIPRK1", "EIPRK2", "EIPRK3", "EIPRK4", "EIPRK5", "EIPRK23",
    "EIPRK45", "EIPRKN8", "EIPRKN12", "EIPRadau", "EIPSolver", "eip_method",
]  # fmt: skip

# The attributes that a step of SciPy's solver reads.
HANDED = ("t", "y", "f", "t_bound", "direction", "max_step", "rtol", "atol", "h_abs")
# SHARED: attributes that a solver and its copies share; MADE: attributes that each copy makes again.
SHARED = {"_user_fun", "_jacobian"}
MADE = {"fun", "fun_single", "fun_vectorized", "_fun", "_bound_fun", "_derivative", "_call", "_spec", "_scipy"}
MADE |= {"_run", "_work", "_schedule", "_engine", "_interpolants", "_was", "diagnostics"}
# Options of SciPy's other solvers, which code that runs several of them passes to all.
OF_OTHERS = {"jac", "jac_sparsity", "lband", "uband", "min_step"}
OPTIONS = ("h", "first_step", "max_step", "rtol", "atol", "vectorized", "diagnostics", *ProjectionOptions.names())


class SolverClass(type):
    """Metaclass of the solver classes. It makes the classes that `eip_method` returns picklable."""


@takes_projection_options
class EIPSolver(OdeSolver, metaclass=SolverClass):
    """Explicit invariants-preserving solver: a Runge-Kutta step, then one Newton step of projection.

    This is the base class. Pass a subclass, such as `EIPRK4` or the class that `eip_method` makes from your own
    tableau, to `scipy.integrate.solve_ivp` as ``method=``.

    Parameters
    ----------
    fun : callable
        ``fun(t, y) -> (n,)``, the right-hand side.
    t0 : float
        Start.
    y0 : array_like, shape (n,)
        Initial state, real or complex.
    t_bound : float
        End; before t0 to integrate backward.
    max_step, rtol, atol, first_step
        Step control, as in SciPy's own methods; the error is estimated before the projection. `rtol` and `atol` are
        also the scale of the error metric: ``|atol| + rtol |y|``, norms over a block. The default of `atol` is 1e-6
        for adaptive steps and 0 for a fixed step `h`, so that the metric does not depend on units.
    vectorized : bool, optional
        Whether `fun` takes (n, k) arrays, as in SciPy.
    h : float, optional
        Length of a fixed step, positive in both directions. The last step ends on `t_bound` and may be shorter.
        Default: the step length is adapted to the tolerances.
    {ProjectionOptions}
    diagnostics : Diagnostics, optional
        An empty `Diagnostics` object, which the solver fills.

    Attributes
    ----------
    n, status, t_bound, direction, t, y, t_old, step_size, nfev, njev, nlu
        As in `scipy.integrate.OdeSolver`; `njev` counts evaluations of the invariants' gradients and `nlu`
        factorisations of the projection.
    order, error_estimator_order, n_stages, A, B, C, E, P
        Attributes of the classes, as in SciPy's Runge-Kutta classes; NotImplemented if a method has no such attribute.
    diagnostics : Diagnostics
        The record of the projections, the given one or a new one.

    Notes
    -----
    Between two steps, ``fun``, ``t``, ``y``, ``f``, ``t_bound`` (with ``status = "running"`` after the end),
    ``direction``, ``max_step``, ``h_abs``, ``rtol``, ``atol`` and, with fixed steps, ``h`` may be set, and the next
    step uses the new values. Setting the state or the time is a new start: each invariant without a given target takes
    its value there as target, given targets must be met, and the record of corrections by which the run is judged is
    reset, while counts and the largest residuals continue. If ``y``, ``t`` or ``fun`` was set and ``f`` was not, the
    derivative is evaluated again; only `EIPRK23`, `EIPRK45` and `EIPDOP853` without invariants keep the old one for the
    first stage, as SciPy's methods do. A multistep method starts again after any change. A wrong value raises an error
    in the next step. Copies made by `copy.deepcopy` or `pickle` continue to the same bits; pickling needs functions
    that pickle.

    With ``every=k`` the states between two projections are returned as projected copies, also by dense output; the
    steps continue from the unprojected states.

    The residuals of the invariants after the projection are O(h^(2p + 2)) for a method of order p (theorem 2.1 of
    [1]_), and the method keeps its order.

    References
    ----------
    .. [1] W. Cai, Y. Gong, Y. Wang, "An explicit and practically invariants-preserving method for conservative
       systems".
    """

    TABLEAU: ClassVar[Method]
    # SciPy's class of the same pair: without invariants it takes the steps, so that they are SciPy's to the last bit.
    _SCIPY: ClassVar[type[OdeSolver] | None] = None
    _TANGENTS: ClassVar[TangentVectors] = NO_TANGENT_VECTORS
    order: Any = NotImplemented
    error_estimator_order: Any = NotImplemented
    n_stages: Any = NotImplemented
    A: Any = NotImplemented
    B: Any = NotImplemented
    C: Any = NotImplemented
    E: Any = NotImplemented
    P: Any = NotImplemented
    t: float
    t_old: float
    y: np.ndarray
    f: np.ndarray
    h_abs: Any
    nfev: int
    _interpolants: Interpolants | None
    _was: Settings
    rtol: Any
    atol: Any
    _run: Run
    _spec: RunSpec
    _work: Work

    def __init__(
        self,
        fun: Callable[..., Any],
        t0: float,
        y0: Any,
        t_bound: float,
        max_step: float = np.inf,
        rtol: Any = 1e-3,
        atol: Any = ATOL,
        vectorized: bool = False,
        first_step: float | None = None,
        *,
        h: float | None = None,
        diagnostics: Any = None,
        **options: Any,
    ) -> None:
        if not hasattr(self, "TABLEAU"):
            raise TypeError("EIPSolver is the base class; use EIPRK4 and the like, or eip_method(tableau).")
        jacobian = _jacobian(self.TABLEAU, options)
        own, extraneous = ProjectionOptions.split(options)
        projection = ProjectionOptions(**own)
        if extraneous:
            warnings.warn(_without_effect(extraneous), UserWarning, stacklevel=users_level())
        t0, t_bound = interval((t0, t_bound))
        start = initial_state(y0)
        super().__init__(fun, t0, start, t_bound, vectorized, support_complex=True)
        longest = np.inf if is_number(max_step) and np.isnan(max_step) else max_step  # NaN sets no bound, as in SciPy
        steps = StepOptions(h=h, first_step=first_step, max_step=longest, rtol=rtol, atol=atol)
        n = self._TANGENTS.state(start).size
        stepping = steps.checked(type(self).__name__, self.TABLEAU, t0, t_bound, n, stacklevel=users_level() + 1)
        kept = as_invariants(projection.invariants)
        self._jacobian = jacobian
        self._bind(fun, [0])
        self._spec = self._specified(stepping, replace(projection, invariants=kept))
        self._take_stepping(stepping, rtol, atol)
        if self.h is None and stepping.first_step is None:
            stepping.require_scale(self._TANGENTS.state(start))
        self._scipy = self._scipy_solver(start, bool(kept) or bool(projection.compensated) or n < self.n)
        self.h_previous: float | None = None
        self.diagnostics = Diagnostics() if diagnostics is None else diagnostics
        begun = (None, None) if self._scipy is None else (self._scipy.f, float(self._scipy.h_abs or 0.0))
        self._start(start, *begun)
        self.h_abs = self._run.start.tau if self._scipy is None else self._scipy.h_abs
        self._work.counters[NFEV] = self._calls[0]
        self._drive(begins=True)
        self.y_old = self.y
        self._noted, self._told = 0, False
        self._count()
        self._settle()

    @classmethod
    def _takes_scipys_steps(cls, options: Mapping[str, Any]) -> bool:
        """Return True if the steps of a run with these options are those of a method of SciPy."""
        known = cls._SCIPY is not None or cls.TABLEAU.drives
        return known and options.get("h") is None and not options.get("invariants")

    def __init_subclass__(cls, **keywords: Any) -> None:
        """Give a subclass the attributes of SciPy's RungeKutta classes: order, n_stages, A, B, C, E, P ..."""
        super().__init_subclass__(**keywords)
        if "TABLEAU" in vars(cls):
            found = dict.fromkeys(ATTRIBUTES, NotImplemented) | cls.TABLEAU.class_attributes()
            if cls._SCIPY is not None:
                found = {name: getattr(cls._SCIPY, name, NotImplemented) for name in ATTRIBUTES}
            for name, value in found.items():
                if name not in vars(cls):
                    setattr(cls, name, value)

    def _bind(self, fun: Callable[..., Any], calls: list[int]) -> None:
        """Use `fun` as right-hand side from now on; ``calls[0]`` counts its evaluations."""
        self._user_fun, self._bound_fun, self._calls = fun, self.fun, calls
        vectorized = self.vectorized and fun is not self.fun
        self._derivative, self._call = _checked(fun, self.n, self.y.dtype, vectorized, calls)

    def _take_stepping(self, stepping: Stepping, rtol: Any, atol: Any) -> None:
        """Store options of the step control that have been checked; numbers stay numbers, as in SciPy."""
        self._spec = self._spec._replace(stepping=stepping)
        self.h, self.max_step = stepping.h, stepping.span.max_step
        given = (rtol, stepping.rtol), (atol, stepping.atol)  # the checked arrays of an empty state have no number
        self.rtol, self.atol = (a.copy() if np.size(x) > 1 else float(np.max(a if a.size else x)) for x, a in given)

    def _specified(self, stepping: Stepping, projection: ProjectionOptions) -> RunSpec:
        """Return a `RunSpec` of the solver's present right-hand side with these options."""
        moved = jacobian_product(self._jacobian) if callable(self._jacobian) else self._jacobian
        return RunSpec(
            name=type(self).__name__,
            method=self.TABLEAU,
            rhs=partial(_copied, self._derivative),
            stepping=stepping,
            projection=projection,
            jacobian=lambda: moved,
            level=True,
            hint=lambda: f". If fun is the acceleration a(t, q), {BY_NAME}",
            tangents=self._TANGENTS,
            uncount=self._uncount,
        )

    def _uncount(self, calls: int) -> None:
        self._calls[0] -= calls

    def _start(self, y0: np.ndarray, f0: np.ndarray | None, tau: float | None, *, check: bool = True) -> None:
        """Start a run at a state and make its buffers; the arguments are those of `RunSpec.build`."""
        run = self._spec.build(y0, f0, tau, check_start=check)
        self._run, self._work = run, run.work
        self._spec = self._spec._replace(method=run.tableau, is_known=True)
        run.attach(self.diagnostics)
        self.y, self.f = run.y0, run.start.f
        # The steps continue from `_raw`. If it waits for its projection, `y` is its projected copy.
        self._raw = self._raw_old = run.y0
        self._waits = False, False  # whether the states at both ends of the last step wait for a projection
        self._shows = run.shows
        self._steps = 0

    def _drive(self, *, begins: bool) -> None:
        """Make the engine for the present interval, options and functions; `begins` is False if a run continues."""
        self._k, self._interpolants = 0, None
        if self._scipy is not None:
            return
        if self.TABLEAU.drives:
            self._run.method.count(self._work)
        self._work.K[0] = self.f
        self._schedule = bare_schedule(self._spec.stepping.span, float(self.h_abs or 0.0))
        self._schedule.place[PENDING] = 1  # the solver shows the end of the last step
        jacobian = None
        if callable(self._jacobian):
            jacobian = call(self._jacobian, (), (self.n // 2,), None, takes_f=True, in_place=True)
        rates = self._run.invariants.rates(self._run.options.adaptive)
        state = self.n, self.y.dtype
        rhs = compiled_call(self._call, *state)
        inv, grad = (tuple(compiled_call(known, *state) for known in group) for group in self._run.invariants.calls)
        functions = PythonFunctions(rhs, inv, grad, (), second_order=False, jacobian=jacobian, rates=rates)
        self._engine = self._run.engine(functions, self._schedule, begins=begins)

    def _settle(self) -> None:
        """Store the attributes after a step, so that the next step detects which of them the user has set."""
        self._was = Settings._make(settings_of(self))
        self._kept = kept_state(self.y) if self._scipy is None else None

    @property
    def _untouched(self) -> bool:
        """Return True if no attribute was set since the last step."""
        stepping = self._spec.stepping
        return (
            all(map(is_, settings_of(self), self._was))
            and (type(self.rtol) is float or np.array_equal(self.rtol, stepping.rtol))  # or changed in place
            and (type(self.atol) is float or np.array_equal(self.atol, stepping.atol))
            and (self._kept is None or is_state(self.y, self._kept))
        )

    def _hand_on(self) -> None:
        """Apply the attributes that were set between two steps, as the notes of `EIPSolver` describe."""
        was, like = self._was, self._run.y0
        stepping = checked_stepping(self, self.TABLEAU, was, stacklevel=5)
        y = self.y if self.y is was.y else checked_vector("y", self.y, like)
        f = self.f if self.f is was.f else checked_vector("f", self.f, like)
        self.y, self.f = y, f
        called = self.nfev - was.nfev
        self._calls[0] += called
        self._work.counters[NFEV] += called
        refunctioned, moved = self.fun is not was.fun, self._moved
        if refunctioned:
            self._bind(self.fun, self._calls)
            self._spec = self._specified(stepping, self._spec.projection)
        self._take_stepping(stepping, self.rtol, self.atol)
        if self._scipy is not None:
            if refunctioned:
                self._scipy.fun = self._derivative
            for name in HANDED:
                setattr(self._scipy, name, getattr(self, name))
            return
        before = self._calls[0]
        if (refunctioned or moved) and self.f is was.f:
            self.f = self._derivative(self.t, self.y).copy()
        here = Start(float(self.t), self.y, self.f, float(self.h_abs or 0.0))
        if moved:
            self._restart(here)
        else:
            self._go_on(here)
            self._work.rates[0] = np.nan if refunctioned else self._work.rates[-1]
        self._work.counters[NFEV] += self._calls[0] - before
        self._drive(begins=moved)

    def _restart(self, here: Start) -> None:
        """Start a new run at `here`, a time and a state set by the user; counts and the largest residuals continue."""
        old = self._run
        self._start(*here[1:], check=False)
        new, counters = self._run, self._work.counters
        counters[:] = old.work.counters
        counters[WAITED] = 0
        new.work.max_residual[:] = old.work.max_residual
        new.work.max_correction[:] = old.work.max_correction
        new.trust.doubts += [*old.trust.reasons, *old.trust.doubts]
        new.trust.failed = old.trust.failed

    def _go_on(self, here: Start) -> None:
        """Continue from `here`, the last time and state, with other tolerances, or another interval or function."""
        run, spec = self._run, self._spec
        method, _ = spec.examined(here.y, here.f)
        run.invariants.t_span = (run.invariants.t_span[0], float(self.t_bound))
        fresh = spec.projection.settled(method, spec.stepping, run.y0, run.start.f, run.invariants)[0]
        run.options = run.options._replace(rtol=fresh.rtol, atol=fresh.atol, block_atol=fresh.block_atol)
        run.stepping = spec.stepping
        method.begin(spec, run, here)
        self._spec = spec._replace(method=method, is_known=True)

    def _state(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return two mappings for a copy of this solver: values to share, such as functions, and values to copy."""
        shared = {name: getattr(self, name) for name in SHARED} | {"projection": self._spec.projection}
        shared["tau"] = self._run.invariants.tau
        was = self._was._asdict()
        if self.fun is not self._bound_fun:  # `fun` was set since the last step
            shared["fun"] = self.fun
        del was["fun"]
        copied = {
            "attributes": {name: value for name, value in vars(self).items() if name not in MADE | SHARED},
            "set": {name: value for name, value in was.items() if getattr(self, name) is not value},
            "replaced": self._user_fun is self._bound_fun,
            "velocities": getattr(self._spec.method, "velocities", None),
            "run": parts_of(self._run),
            "joint": self._run.options.joint is not None,
            "clock": None if self._scipy is not None else self._schedule.clock,
            "scipy": {name: value for name, value in vars(self._scipy).items() if not callable(value)}
            if self._scipy is not None
            else None,
        }
        return shared, copied

    def _revive(self, shared: dict[str, Any], copied: dict[str, Any]) -> None:
        """Restore the solver from the output of `_state`."""
        begin, user = copied["run"]["begin"], shared["_user_fun"]
        vectorized = copied["attributes"]["vectorized"]
        super().__init__(user, begin.t, begin.y, begin.t + 1.0, vectorized, support_complex=True)
        if copied["replaced"]:
            self.fun = user
        self._jacobian, self._scipy = shared["_jacobian"], None
        self._bind(user, [0])
        spec = self._specified(copied["run"]["stepping"], shared["projection"])
        if self.TABLEAU.has_history:
            tableau: Any = self.TABLEAU
            spec = spec._replace(method=replace(tableau, velocities=copied["velocities"]))
        self._spec = spec._replace(is_known=True)
        if copied["scipy"] is not None and self._SCIPY is not None:
            fresh = partial(_copied, self._derivative)
            self._scipy = self._SCIPY(fresh, begin.t, begin.y, begin.t + 1.0, first_step=1.0)
            self._scipy.fun = self._derivative
            for name, value in copied["scipy"].items():
                if name.startswith("K"):  # the stages, which may be a view of another array
                    getattr(self._scipy, name)[...] = value
                else:
                    setattr(self._scipy, name, value)
        t_bound = copied["attributes"]["t_bound"]
        invariants = InvariantSet(shared["projection"].invariants, *begin, tell=False, t_bound=t_bound)
        invariants.tau = shared["tau"]
        self._run = run_of(copied["run"], invariants, self._spec.method, joint=copied["joint"])
        if self.TABLEAU.drives:
            self._spec.method.begin(self._spec, self._run, begin)
            self._run.method.resume(copied["run"]["method"])
        self._work, self.f, self.h_abs = self._run.work, begin.f, 0.0
        self._drive(begins=False)
        self._work.K[0], self._work.rates[0] = copied["run"]["work"].K[0], copied["run"]["work"].rates[-1]
        if copied["clock"] is not None:
            self._schedule.clock[:] = copied["clock"]
        calls = self._calls
        self.__dict__.update(copied["attributes"] | {name: shared[name] for name in SHARED})
        calls[:], self._calls = self._calls, calls
        self.diagnostics = Diagnostics()
        self._run.attach(self.diagnostics)
        now = {name: getattr(self, name) for name in Settings._fields}
        self._was = Settings(**now | copied["set"])
        self.fun = shared.get("fun", self.fun)

    def __reduce_ex__(self, protocol: Any) -> tuple[Any, ...]:
        return _revived, (type(self), *self._state())

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        new = memo[id(self)] = type(self).__new__(type(self))
        shared, copied = self._state()
        new._revive(shared, copy.deepcopy(copied, memo))
        return new

    def _count(self) -> int:
        """Update nfev, njev and nlu, and return how many suspicious corrections and errors the engine has counted."""
        counters = self._work.counters.tolist()
        self.nfev, self.njev, self.nlu = counters[NFEV], counters[NJEV], counters[NLU]
        return int(counters[FOUND])

    def _scipy_solver(self, start: np.ndarray, own_steps: bool) -> OdeSolver | None:
        if self._SCIPY is None or self.h is not None or own_steps:
            return None

        control = {"max_step": self.max_step, "rtol": self.rtol, "atol": self.atol}
        control["first_step"] = self._spec.stepping.first_step
        solver = self._SCIPY(partial(_copied, self._derivative), self.t, start, self.t_bound, **control)
        if np.isnan(solver.h_abs):
            return None  # SciPy's loop would never end
        solver.fun = self._derivative  # it replaces SciPy's two wrappers, which count and convert as it does
        return solver

    def _scipy_step(self, solver: OdeSolver) -> tuple[bool, str | None]:
        # This solver's own step() does the bookkeeping, so that SciPy's step() is not needed.
        success, message = solver._step_impl()
        self.nfev = self._calls[0]
        if not success:
            if not np.isfinite(solver.K).all():
                message = f"fun returned a non-finite value at t={self.t:.10g}"
            elif (unscaled := np.flatnonzero((self.atol == 0) & (solver.y == 0) & (solver.f == 0))).size:
                message = (
                    f"the error of component {unscaled[0]} has no scale at t={self.t:.10g}: y and `atol` are 0 there; "
                    "give atol > 0"
                )
            return False, message
        # SciPy keeps the value itself, and a user's function may return the same buffer again.
        solver.f = solver.f.copy()
        solver.t_old = self.t
        self.y_old, self.y, self.t = self.y, solver.y, solver.t
        self.f, self.h_abs, self.h_previous = solver.f, solver.h_abs, solver.h_previous
        return True, None

    def _step_impl(self) -> tuple[bool, str | None]:
        if not self._untouched:
            self._hand_on()
        done, message = self._own_step() if self._scipy is None else self._scipy_step(self._scipy)
        self._settle()
        return done, message

    @property
    def _moved(self) -> bool:
        """Return True if the state or the time was changed since the last step."""
        t, y = self._was.t, self._was.y
        if self.t != t or (self._kept is not None and not is_state(self.y, self._kept)):
            return True
        return self.y is not y and not np.array_equal(self.y, y)

    def _own_step(self) -> tuple[bool, str | None]:
        run = self._run
        status, t, y_new, f_new = self._engine.step(self._k, self.t, self._raw, self.f)
        found = self._count()
        if status != OK:
            run.trust.failed = True
            return False, failure(status, run, self._schedule.clock)
        if t == self.t:
            return False, self.TOO_SMALL_STEP
        self._k += 1
        self._steps += 1
        self.h_previous = t - self.t
        self._raw_old, self._raw = self._raw, y_new
        self.y_old = self.y
        self.y = self._on_manifold(t, y_new) if self._shows else y_new
        self.t, self.f = t, f_new
        if self.h is None:
            self.h_abs = self._schedule.clock.item(NEXT_LENGTH)
        if found != self._noted or is_check_due(self._steps) or self.t == self.t_bound:
            self._watch()
        return True, None

    def _watch(self, *, ended: bool = False) -> None:
        """Examine the run, and warn once if it looks faulty, at once, because the user may make no further step."""
        run, arrived = self._run, ended or self.t == self.t_bound
        self._noted = self._work.counters[FOUND]
        rhs = partial(_copied, self._derivative)
        if not self._told and run.look(self._steps, arrived, self.t, self.y, rhs):
            self._told = True
            warnings.warn(f"{type(self).__name__}: {run.trust.message}", ProjectionWarning, stacklevel=users_level())

    def _sampled(self) -> Interpolants:
        """Return the `Interpolants` of the run, which return projected states; the first call creates them."""
        if self._interpolants is None:
            self._interpolants = Interpolants(self._run, self._engine)
        self._interpolants.record.waiting[:] = self._waits
        return self._interpolants

    def _on_manifold(self, t: float, y: np.ndarray) -> np.ndarray:
        """Return the state of a step for the user: a projected copy if the state waits for its projection."""
        waits = bool(t != self.t_bound if self.TABLEAU.has_history else self._work.counters[WAITED] > 0)
        self._waits = self._waits[1], waits
        return self._sampled().shown(t, y) if waits else y

    def _dense_output_impl(self) -> DenseOutput:
        t, y = self._was.t, self._was.y
        if self._kept is not None and not is_state(y, self._kept):  # y was changed in place since the last step
            y = np.frombuffer(self._kept, y.dtype) if isinstance(self._kept, bytes) else self._kept
        if self._scipy is not None:
            out = ExactEnds(self._scipy.dense_output(), self.y_old, y)
            self.nfev = self._calls[0]
        else:
            ends = (self._raw_old, self._raw) if self._shows else (self.y_old, y)
            out = self._sampled().over(self.t_old, ends[0], t, ends[1])
            self._count()
        self._was = self._was._replace(nfev=self.nfev)
        return out


def _revived(solver: type[EIPSolver], shared: dict[str, Any], copied: dict[str, Any]) -> EIPSolver:
    """Return a solver of the class `solver` from the output of `EIPSolver._state`."""
    new = solver.__new__(solver)
    new._revive(shared, copied)
    return new


def _reduced_class(made: type) -> Any:
    """Return the name by which a class is pickled, or the call of `eip_method` that makes it again."""
    origin = vars(made).get("_ORIGIN")
    return made.__qualname__ if origin is None else (eip_method, (origin,))


copyreg.pickle(SolverClass, _reduced_class)


def _copied(derivative: Callable[[float, np.ndarray], np.ndarray], t: float, y: np.ndarray) -> np.ndarray:
    """Return the derivative as a new array."""
    return derivative(t, y).copy()


def _jacobian(method: Any, options: dict[str, Any]) -> Any:
    """Remove the options for the Jacobian from `options`, and return them as a method that takes them needs them."""
    if method.drives:
        return Jacobian(options.pop("jac", None), options.pop("jac_sparsity", None))
    jacobian = options.pop("jacobian", None) if method.has_history else None
    if jacobian is not None and not callable(jacobian):
        raise TypeError(f"jacobian must be a function jacobian(t, q, dq, out), got {shown(jacobian)}.")
    return jacobian


def _without_effect(names: Iterable[str]) -> str:
    """Return SciPy's warning about unknown options in its own words, so that existing warning filters apply."""
    listed = ", ".join(f"`{name}`" for name in names)
    hints = ((name, nearest(name, OPTIONS).removeprefix("; ")) for name in names if name not in OF_OTHERS)
    meant = "".join(f" `{name}`: {hint}" for name, hint in hints if hint)
    return f"The following arguments have no effect for a chosen solver: {listed}.{meant}"


def _checked(
    fun: Callable[..., Any], n: int, dtype: np.dtype, vectorized: bool, calls: list[int]
) -> tuple[Callable[[float, np.ndarray], np.ndarray], Call]:
    """Return the user's right-hand side with checks of its values: as ``derivative(t, y) -> (n,)``, and as a `Call`.

    ``derivative`` counts its calls in ``calls[0]``, while the engine counts its own calls. Its value may be a buffer of
    the user. `fun` gets a copy of the state, because it may keep or overwrite its argument.
    """
    shape = (n,)

    def flat(t: float, y: np.ndarray) -> np.ndarray:
        f = fun(t, y[:, None])
        found = numbers("fun returned", f)
        return f if found is None else np.resize(found, n) if found.size == 1 else found.reshape(-1)

    called = flat if vectorized else fun

    def convert(f: Any, t: float) -> np.ndarray:
        return np.array(as_derivative(f, n, dtype, t), dtype, order="C")

    def checked(t: float, y: np.ndarray) -> np.ndarray:
        f = called(t, y.copy())
        if type(f) is np.ndarray and f.shape == shape and f.dtype is dtype:
            return f
        return convert(f, t)

    def derivative(t: float, y: np.ndarray) -> np.ndarray:
        calls[0] += 1
        return checked(t, y)

    return derivative, Call(called, (), shape, convert)


class EIPRK1(EIPSolver):
    """EIP method on the explicit Euler method (order 1), which has no error estimate; the metric is euclidean.

    Options: see `EIPSolver`.
    """

    TABLEAU = RK1


class EIPRK2(EIPSolver):
    """EIP method on the explicit midpoint rule (order 2). Options: see `EIPSolver`."""

    TABLEAU = RK2


class EIPRK3(EIPSolver):
    """EIP method on Heun's third-order method. Options: see `EIPSolver`."""

    TABLEAU = RK3


class EIPRK4(EIPSolver):
    """EIP method on the classical Runge-Kutta method of order 4, the paper's choice.

    Options: see `EIPSolver`.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.integrate import solve_ivp
    >>> from eip_scipy import EIPRK4, Invariant
    >>> def fun(t, y):
    ...     return [y[2], y[3], *(-y[:2] / np.hypot(*y[:2]) ** 3)]
    >>> def energy(t, y):
    ...     return 0.5 * (y[2] ** 2 + y[3] ** 2) - 1 / np.hypot(*y[:2])
    >>> def energy_gradient(t, y):
    ...     return np.concatenate([y[:2] / np.hypot(*y[:2]) ** 3, y[2:]])
    >>> H = Invariant(energy, energy_gradient, name="energy")
    >>> sol = solve_ivp(fun, (0, 20), [0.4, 0, 0, 2], method=EIPRK4, h=0.03, invariants=H)
    >>> bool(abs(energy(20, sol.y[:, -1]) - energy(0, sol.y[:, 0])) < 1e-11)
    True
    """

    TABLEAU = RK4


class EIPRK5(EIPSolver):
    """EIP method on Fehlberg's method of order 5 (six stages). Options: see `EIPSolver`."""

    TABLEAU = RK5


class EIPRK23(EIPSolver):
    """EIP method on SciPy's RK23, the pair of Bogacki and Shampine. Options: see `EIPSolver`."""

    TABLEAU = RK23
    _SCIPY = scipy.integrate.RK23


class EIPRK45(EIPSolver):
    """EIP method on SciPy's RK45, the pair of Dormand and Prince.

    Options: see `EIPSolver`. Without invariants it takes the steps of `scipy.integrate.RK45`.
    """

    TABLEAU = RK45
    _SCIPY = scipy.integrate.RK45


class EIPDOP853(EIPSolver):
    """EIP method on SciPy's DOP853, of order 8. Options: see `EIPSolver`."""

    TABLEAU = DOP853
    _SCIPY = scipy.integrate.DOP853


class EIPRKN8(EIPSolver):
    """EIP method on the Runge-Kutta-Nystrom pair 8(6) of Dormand, El-Mikkawy and Prince, nine stages.

    For q'' = a(t, q) as a first-order system: the state is (q, v), and the first half of `fun` must be v. `integrate`
    also takes the acceleration alone, as ``acceleration=``. Options: see `EIPSolver`. Dense output is
    as accurate as the steps and takes five more evaluations in each step in which a state is asked for.

    Notes
    -----
    Accelerations must not depend on velocities. With `fun` this is checked at the start, where it raises ValueError,
    and in about every fourth step, with two evaluations: a run in which they come to depend on them ends there with
    status -1. A force that acts for fewer steps can be missed.
    """

    TABLEAU = RKN86


class EIPRKN12(EIPSolver):
    """EIP method on the Runge-Kutta-Nystrom pair 12(10) of Dormand, El-Mikkawy and Prince, 17 stages.

    For q'' = a(t, q) as a first-order system: the state is (q, v), and the first half of `fun` must be v. `integrate`
    also takes the acceleration alone, as ``acceleration=``. Options: see `EIPSolver`; use ``every="auto"`` with small
    steps.
    Dense output is as accurate as the steps and takes 15 more evaluations in each step in which a state is asked for.

    Notes
    -----
    Accelerations must not depend on velocities, see `EIPRKN8`.
    """

    TABLEAU = RKN1210


class EIPGJ12(EIPSolver):
    """EIP method on the summed multistep method of Gauss and Jackson, of order 12: one evaluation a step.

    For smooth motions q'' = a(t, q), with a fixed step `h`, as a first-order system: the state is (q, v), and the
    first half of `fun` must be v. `integrate` also takes the acceleration alone, as ``acceleration=``; accelerations
    that depend on velocities come as the second half of `fun`. Options: see `EIPSolver`; `every` is "auto" and
    `compensated` is True by default.

    Raises
    ------
    ValueError
        If the step `h` is unstable at the start; the message gives a stable one.

    Notes
    -----
    The first states come from `EIPRKN12` with the same step; if `fun` is given, they come from DOP853 in four steps for
    each step, because such accelerations may depend on velocities, at the start or later.
    The corrections of the projection are added to the sums of accelerations that give positions and velocities.
    `integrate` returns states in the middle of the history of accelerations: for order p, the state after a step is
    returned when p / 2 further steps have been made, or all steps up to the end of the interval. solve_ivp returns the
    newest state of the history, whose rounding error is larger.
    """

    TABLEAU = GaussJackson(order=12)


class EIPGJ14(EIPSolver):
    """EIP method on the multistep method of Gauss and Jackson of order 14, its accelerations corrected by the Jacobian.

    It is used like `EIPGJ12`, with longer steps: after each evaluation the accelerations are corrected by the Jacobian
    times the change of the positions that a corrector step would make, for the bodies that need it. `nbody` and the
    problems made from it provide the Jacobian of the central body; for others pass
    ``jacobian=fun(t, q, dq, out[, params])`` to `integrate` or solve_ivp. Without a Jacobian only very short steps are
    stable.
    """

    TABLEAU = GaussJackson(order=14, corrected=True)


class _Implicit(EIPSolver):
    """Base of the methods on SciPy's implicit solvers, whose arguments have the order of those of SciPy's classes."""

    def __init__(self, *given: Any, **options: Any) -> None:
        super().__init__(**inspect.signature(scipy.integrate.Radau).bind_partial(*given).arguments, **options)

    _own = inspect.signature(EIPSolver.__init__).parameters.values()
    __init__.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [*list(inspect.signature(scipy.integrate.Radau.__init__).parameters.values())[:-1],
         *(item for item in _own if item.kind in (item.KEYWORD_ONLY, item.VAR_KEYWORD))]
    )  # fmt: skip


class EIPRadau(_Implicit):
    """EIP method on the steps of SciPy's Radau, the implicit Runge-Kutta method of order 5, for stiff systems.

    Options: see `EIPSolver`, without `h` and `compensated`, and ``jac`` and ``jac_sparsity`` as for
    `scipy.integrate.Radau`. Without invariants its steps are those of SciPy. As in SciPy, `nfev` does not count the
    evaluations for a numerical Jacobian. `njev` counts Jacobians and gradients of the invariants, and `nlu` the
    factorisations of both.

    Notes
    -----
    Use constraints as invariants, and not an energy that contains fast oscillations: the method damps these even if
    the system does not, and the projection would put the energy that they lose into the slow motion. See
    :doc:`/how-to/stiff-systems`.

    Raises
    ------
    ValueError
        If `y0` is complex, because SciPy's Radau needs real states.

    Examples
    --------
    >>> from scipy.integrate import solve_ivp
    >>> from eip_scipy import EIPRadau, Invariant
    >>> def robertson(t, y):
    ...     a, b, c = 0.04 * y[0], 1e4 * y[1] * y[2], 3e7 * y[1] ** 2
    ...     return [b - a, a - b - c, c]
    >>> mass = Invariant(lambda t, y: y.sum(), lambda t, y: [1.0, 1.0, 1.0], name="mass")
    >>> sol = solve_ivp(robertson, (0, 1e5), [1, 0, 0], method=EIPRadau, rtol=1e-6, atol=1e-10, invariants=mass)
    >>> sol.success, bool(abs(sol.y[:, -1].sum() - 1) < 1e-15)
    (True, True)
    """

    TABLEAU = RADAU


class EIPBDF(_Implicit):
    """EIP method on the steps of SciPy's BDF, of variable order up to 5, for stiff systems and loose tolerances.

    Options and notes: see `EIPRadau`; complex states are possible.
    """

    TABLEAU = BDF
    error_estimator_order: Any = NotImplemented  # it varies

    @property
    def order(self) -> int:
        """Order of the next step, as in `scipy.integrate.BDF`."""
        return int(self._run.method.scipy_solver.order)


def class_named(method: Any) -> str | None:
    """Return the name of the EIP class for an EIP class, a solver class of SciPy, or the name of either, or None."""
    name = f"EIP{str(getattr(method, '__name__', method)).upper().removeprefix('EIP')}"
    return next((known for known in __all__ if known.upper() == name), None)


def eip_method(method: Tableau | NystromTableau | GaussJackson | OneStepMethod | type[OdeSolver]) -> type[EIPSolver]:
    """Return a solver class on a Runge-Kutta or Runge-Kutta-Nystrom method, or on a user-defined one-step method.

    Parameters
    ----------
    method : Tableau, NystromTableau, GaussJackson, OneStepMethod or a class like SciPy's RK45
        If it is a subclass of SciPy's RungeKutta, or a class of another package with the same attributes, its
        coefficients A, B, C, E and P are read and checked against the order conditions; the step control is the one of
        this package. SciPy's Radau and BDF give `EIPRadau` and `EIPBDF`.
        A one-step method is any object with ``one_step(t, y, h) -> y_hat`` and ``order``; see `OneStepMethod`. Its
        steps are projected like those of other methods. `fun` is called only for gradients that use f and for dense
        output (the cubic through states and derivatives at both ends of a step), so that `nfev` does not count the
        evaluations of `one_step`.

    Returns
    -------
    type[EIPSolver]
        A class to pass as ``method=`` to `scipy.integrate.solve_ivp` or `integrate`.

    Raises
    ------
    TypeError
        If `method` is none of these, or a class whose steps do not follow from its coefficients.
    ValueError
        If the order of a one-step method is not an integer >= 1, or coefficients of a class miss an order condition.

    Examples
    --------
    >>> from scipy.integrate import solve_ivp
    >>> from eip_scipy import Invariant, eip_method
    >>> class SymplecticEuler:
    ...     order = 1
    ...     def one_step(self, t, y, h):
    ...         q, p = y
    ...         p = p - h * q
    ...         return [q + h * p, p]
    >>> energy = Invariant(lambda t, y: y @ y / 2, lambda t, y: y, name="energy")
    >>> sol = solve_ivp(lambda t, y: [y[1], -y[0]], (0, 10), [1.0, 0.0], method=eip_method(SymplecticEuler()),
    ...                 h=0.01, invariants=energy)
    >>> bool(abs(sol.y[:, -1] @ sol.y[:, -1] - 1) < 1e-8)
    True
    """
    given: Any = method
    if isinstance(given, type) and issubclass(given, OdeSolver):
        if issubclass(given, EIPSolver):
            return given
        classes: tuple[Any, ...] = EIPRK23, EIPRK45, EIPDOP853, EIPRadau, EIPBDF
        for own in classes:
            if is_same(given, own._SCIPY or own.TABLEAU.solver):
                return own
        given = tableau_of(given)
    tableau = given if isinstance(given, Method) else OneStep(given)
    members = {"TABLEAU": tableau, "_ORIGIN": given, "__doc__": f"EIP method on {tableau!r}."}
    made: Any = SolverClass(f"EIP_{tableau.name}", (EIPSolver,), members)
    return made
