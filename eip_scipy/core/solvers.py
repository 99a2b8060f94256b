"""The solver classes: EIP methods that `scipy.integrate.solve_ivp` takes as ``method=``."""

from __future__ import annotations

import copy
import copyreg
import inspect
import warnings
from collections.abc import Callable, Iterable, Mapping
from operator import is_
from typing import Any, ClassVar, NamedTuple

import numpy as np
import scipy.integrate
from scipy.integrate import DenseOutput, OdeSolver

from ..engine.data import FOUND, FROM_F, NEXT_LENGTH, NFEV, NJEV, NLU, OK, PENDING, WAITED, bare_schedule
from ..engine.trust import ProjectionWarning
from ..methods.base import Method
from ..methods.gauss_jackson import GaussJackson
from ..methods.implicit import BDF, RADAU, Jacobian
from ..methods.nystrom import RKN86, RKN1210, NystromTableau
from ..methods.one_step import OneStep, OneStepMethod
from ..methods.runge_kutta import ATTRIBUTES, DOP853, RK1, RK2, RK3, RK4, RK5, RK23, RK45, Tableau, is_same, tableau_of
from .between_steps import Settings, changed_control, checked_vector, is_state, kept_state, settings_of
from .bound_problem import BoundProblem
from .callers import users_level
from .dense import ExactEnds, Interpolants
from .examination import is_check_due
from .failures import failure
from .inputs import initial_state, is_number
from .invariants import as_invariants
from .names import nearest
from .projection import ProjectionOptions, takes_projection_options
from .results import Diagnostics
from .runs import Run, Start
from .step_control import ATOL, StepControl, interval
from .variations import Variations

__all__ = [
    "EIPBDF", "EIPDOP853", "EIPGJ12", "EIPGJ14", "EIPRK1", "EIPRK2", "EIPRK3", "EIPRK4", "EIPRK5", "EIPRK23",
    "EIPRK45", "EIPRKN8", "EIPRKN12", "EIPRadau", "EIPSolver", "eip_method",
]  # fmt: skip

# The attributes that a step of SciPy's solver reads: those that control the step, and the others.
CONTROL = ("t_bound", "direction", "max_step", "rtol", "atol", "h_abs")
HANDED = ("t", "y", "f", *CONTROL)
# Attributes that a copy of a solver makes again.
DERIVED = {"fun", "fun_single", "fun_vectorized", "_fun", "_bound_fun", "_engine", "_interpolants", "diagnostics"}
# Options of SciPy's other solvers, which code that runs several of them passes to all.
OF_OTHERS = {"jac", "jac_sparsity", "lband", "uband", "min_step"}
OPTIONS = ("h", "first_step", "max_step", "rtol", "atol", "vectorized", "diagnostics", *ProjectionOptions.names())


class Context(NamedTuple):
    """The data that `eip_scipy.solve_ivp` shares with the solver that SciPy makes for it.

    The solver writes the state from which it starts to `start`, the initial state of SciPy's loop, and itself to
    `solvers`. `variations` are the functions of an augmented state.
    """

    start: np.ndarray
    solvers: list[Any]
    variations: Variations | None = None


class SolverClass(type):
    """Metaclass of the solver classes. It makes the classes that `eip_method` returns picklable."""


# The end of the docstring of each method; the example is left out where there is another one.
SEE = """
    See Also
    --------
    eip_scipy.solvers.EIPSolver, eip_scipy.solve_ivp, eip_scipy.integrate, eip_scipy.recommend

    References
    ----------
    .. [1] {reference}.
"""
EXAMPLE = """
    Examples
    --------
    >>> import numpy as np
    >>> from eip_scipy import {name}, solve_ivp
    >>> turning, square = lambda t, y: np.append(y[2:], -y[:2]), lambda t, y: y @ y
    >>> sol = solve_ivp(turning, (0, 9), [1, 0, 0, 1], method={name}, h=0.02, invariants=square)
    >>> sol.trusted, bool(abs(square(9, sol.y[:, -1]) - 2) < 1e-6)
    (True, True)
"""


def _with_facts(name: str, text: str, method: Method) -> str:
    """Return the docstring of a method with its order, stages, estimate and source, and with an example."""
    first, _, rest = text.rstrip().partition("\n")
    stages = f", {method.n_stages} stages" if hasattr(method, "n_stages") else ""
    order = "Orders 1 to 5" if method is BDF else f"Order {method.order}"
    estimate = f"an error estimate of order {'1 to 5' if method is BDF else method.error_estimator_order}"
    facts = f"{order}{stages}, {estimate if method.has_estimate else 'no error estimate'} [1]_."
    example = "" if "Examples\n" in rest else EXAMPLE.format(name=name)
    return f"{first}\n\n    {facts}\n{rest}\n{SEE.format(reference=method.reference)}{example}    "


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
    order: Any = NotImplemented
    error_estimator_order: Any = NotImplemented
    n_stages: Any = NotImplemented
    A: Any = NotImplemented
    B: Any = NotImplemented
    C: Any = NotImplemented
    E: Any = NotImplemented
    P: Any = NotImplemented
    fun: Any
    t: float
    t_old: float
    y: np.ndarray
    f: np.ndarray
    h_abs: Any
    nfev: int
    rtol: Any
    atol: Any
    _interpolants: Interpolants | None

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
        start = initial_state(y0)
        context: Context | None = options.pop("_context", None)
        jacobians = _jacobians(self.TABLEAU, options)
        own, extraneous = ProjectionOptions.split(options)
        projection = ProjectionOptions(**own | {"invariants": as_invariants(own.get("invariants", ()))})
        if extraneous:
            warnings.warn(_without_effect(extraneous), UserWarning, stacklevel=users_level())
        t0, t_bound = interval((t0, t_bound))
        super().__init__(fun, t0, start, t_bound, vectorized, support_complex=True)
        variations = None if context is None else context.variations
        problem = BoundProblem(fun, start, variations=variations, vectorized=vectorized, by_address=True, **jacobians)
        longest = np.inf if is_number(max_step) and np.isnan(max_step) else max_step  # NaN sets no bound, as in SciPy
        name, control = type(self).__name__, {"h": h, "first_step": first_step, "max_step": longest}
        stepping = StepControl.of(name, self.TABLEAU, (t0, t_bound), problem.n, **control, rtol=rtol, atol=atol)
        self._run = run = Run(problem, name, self.TABLEAU, stepping, projection, level=True)
        self._bound_fun = self.fun
        self._take_stepping(stepping, rtol, atol)
        if self.h is None and stepping.first_step is None:
            stepping.scale(run.tangents.state(start))
        plain = not (projection.invariants or projection.compensated or problem.n < self.n)
        self._scipy = self._scipy_solver(start) if plain else None
        self.h_previous: float | None = None
        self.diagnostics = Diagnostics() if diagnostics is None else diagnostics
        begun = (None, None) if self._scipy is None else (self._scipy.f, float(self._scipy.h_abs or 0.0))
        self._begin(run.start_at(start, *begun))
        self.h_abs = run.start.tau if self._scipy is None else self._scipy.h_abs
        run.work.counters[NFEV] = problem.count
        self._make_engine(begins=True)
        self.y_old = self.y
        self._noted, self._warned = 0, False
        self._count()
        self._settle()
        if context is not None:
            context.start[:] = self.y
            context.solvers.append(self)

    @classmethod
    def _takes_scipys_steps(cls, options: Mapping[str, Any]) -> bool:
        """Return True if the steps of a run with these options are those of a method of SciPy."""
        known = cls._SCIPY is not None or cls.TABLEAU.drives
        return known and options.get("h") is None and not options.get("invariants")

    def __init_subclass__(cls, **keywords: Any) -> None:
        """Give a subclass the attributes of SciPy's RungeKutta classes: order, n_stages, A, B, C, E, P ..."""
        super().__init_subclass__(**keywords)
        if "TABLEAU" in vars(cls):
            if cls.__name__ in __all__:
                cls.__doc__ = _with_facts(cls.__name__, cls.__doc__ or "", cls.TABLEAU)
            found = dict.fromkeys(ATTRIBUTES, NotImplemented) | cls.TABLEAU.class_attributes()
            if cls._SCIPY is not None:
                found = {name: getattr(cls._SCIPY, name, NotImplemented) for name in ATTRIBUTES}
            for name, value in found.items():
                if name not in vars(cls):
                    setattr(cls, name, value)

    def _take_stepping(self, stepping: StepControl, rtol: Any, atol: Any) -> None:
        """Store options of the step control that have been checked; numbers stay numbers, as in SciPy."""
        self._run.stepping = stepping
        self.h, self.max_step = stepping.h, stepping.span.max_step
        given = (rtol, stepping.rtol), (atol, stepping.atol)  # the checked arrays of an empty state have no number
        self.rtol, self.atol = (a.copy() if np.size(x) > 1 else float(np.max(a if a.size else x)) for x, a in given)

    def _begin(self, run: Run) -> None:
        """Go on with the `run`, which has been started."""
        self._run = run
        run.attach(self.diagnostics)
        self.y, self.f = run.y0, run.start.f
        # The steps continue from `_raw`. If it waits for its projection, `y` is its projected copy.
        self._raw = self._raw_old = run.y0
        self._waits = False, False  # whether the states at both ends of the last step wait for a projection
        self._steps = 0

    def _make_engine(self, *, begins: bool) -> None:
        """Make the engine for the present interval, options and functions; `begins` is False if a run continues."""
        self._k, self._interpolants = 0, None
        if self._scipy is not None:
            return
        run = self._run
        if self.TABLEAU.drives:
            run.stepper.count(run.work)
        run.work.K[0] = self.f
        run.schedule = bare_schedule(run.stepping.span, float(self.h_abs or 0.0))
        run.schedule.place[PENDING] = 1  # the solver shows the end of the last step
        self._engine = run.engine(run.problem.in_python(run), begins=begins)

    def _settle(self) -> None:
        """Store the attributes after a step, so that the next step detects which of them the user has set."""
        self._was = Settings._make(settings_of(self))
        self._kept = kept_state(self.y) if self._scipy is None else None

    @property
    def _untouched(self) -> bool:
        """Return True if no attribute was set since the last step."""
        stepping = self._run.stepping
        return (
            all(map(is_, settings_of(self), self._was))
            and self.fun is self._bound_fun
            and (type(self.rtol) is float or np.array_equal(self.rtol, stepping.rtol))  # or changed in place
            and (type(self.atol) is float or np.array_equal(self.atol, stepping.atol))
            and (self._kept is None or is_state(self.y, self._kept))
        )

    @property
    def _moved(self) -> bool:
        """Return True if the state or the time was changed since the last step."""
        t, y = self._was.t, self._was.y
        if self.t != t or (self._kept is not None and not is_state(self.y, self._kept)):
            return True
        return self.y is not y and not np.array_equal(self.y, y)

    def _apply_changes(self) -> None:
        """Apply the attributes that were set between two steps, as the notes of `EIPSolver` describe."""
        was, run, like, problem = self._was, self._run, self._run.y0, self._run.problem
        stepping = changed_control(self, self.TABLEAU, was)
        y = self.y if self.y is was.y else checked_vector("y", self.y, like)
        f = self.f if self.f is was.f else checked_vector("f", self.f, like)
        self.y, self.f = y, f
        called = self.nfev - was.nfev
        problem.count += called
        run.work.counters[NFEV] += called
        moved, new_function = self._moved, self.fun is not self._bound_fun
        if new_function:
            self._bound_fun, problem.vectorized = self.fun, False
            problem.bind(self.fun)
        self._take_stepping(stepping, self.rtol, self.atol)
        if self._scipy is not None:
            self._scipy.fun = self._evaluate
            for name in HANDED:
                setattr(self._scipy, name, getattr(self, name))
            return
        before = problem.count
        if (new_function or moved) and self.f is was.f:
            self.f = problem.derivative(self.t, self.y)
        here = Start(float(self.t), self.y, self.f, float(self.h_abs or 0.0))
        (self._restart if moved else self._continue)(here, new_function)
        self._run.work.counters[NFEV] += problem.count - before
        self._make_engine(begins=moved)

    def _restart(self, here: Start, new_function: bool) -> None:
        """Start a new run at `here`, a time and a state set by the user; counts and the largest residuals continue."""
        old = self._run
        method = self.TABLEAU if new_function else old.method
        new = Run(old.problem, old.name, method, old.stepping, old.projection, level=True)
        self._begin(new.start_at(*here[1:], check=False, is_known=not new_function))
        new.work.counters[:] = old.work.counters
        new.work.counters[WAITED] = 0
        new.work.max_residual[:] = old.work.max_residual
        new.work.max_correction[:] = old.work.max_correction
        new.trust.doubts += [*old.trust.reasons, *old.trust.doubts]
        new.trust.failed = old.trust.failed

    def _continue(self, here: Start, new_function: bool) -> None:
        """Continue from `here`, the last time and state, with other tolerances, or another interval or function."""
        run, work = self._run, self._run.work
        run.examine(here.y, here.f, is_known=not new_function)
        work.counters[FROM_F] &= not new_function
        run.invariants.t_span = (run.invariants.t_span[0], float(self.t_bound))
        fresh = run.projection.validate(run.method, run.stepping, run.y0, run.start.f, run.invariants)[0]
        run.options = run.options._replace(rtol=fresh.rtol, atol=fresh.atol, block_atol=fresh.block_atol)
        if self.TABLEAU.drives and not new_function:
            for name in (*CONTROL, "status"):
                setattr(run.stepper.scipy_solver, name, getattr(self, name))
        else:
            run.method.begin(run, here)
        work.rates[0] = np.nan if new_function else work.rates[-1]

    def __getstate__(self) -> dict[str, Any]:
        own = {name: value for name, value in vars(self).items() if name not in DERIVED}
        if self.fun is not self._bound_fun:  # it was set since the last step
            own["fun"] = self.fun
        own["_bound_fun"] = self._bound_fun is self._run.problem.fun  # it was set before, and is not SciPy's wrapper
        own["_was"] = {name: x for name, x in self._was._asdict().items() if getattr(self, name) is not x}
        if self._scipy is not None:
            own["_scipy"] = {name: value for name, value in vars(self._scipy).items() if not callable(value)}
        return own

    def __setstate__(self, own: dict[str, Any]) -> None:
        run, was, scipy = own["_run"], own.pop("_was"), own.pop("_scipy")
        problem, begin, count = run.problem, run.begin, run.problem.count
        super().__init__(problem.fun, begin.t, begin.y, begin.t + 1.0, problem.vectorized, support_complex=True)
        self._bound_fun = self.fun = problem.fun if own.pop("_bound_fun") else self.fun
        self.__dict__.update(own, _scipy=None, _interpolants=None, diagnostics=Diagnostics())
        run.restore(self.TABLEAU)
        run.attach(self.diagnostics)
        if scipy is None:
            run.work.rates[0] = run.work.rates[-1]
            self._engine = run.engine(problem.in_python(run), begins=False)
        elif self._SCIPY is not None:
            self._scipy = self._SCIPY(problem.derivative, begin.t, begin.y, begin.t + 1.0, first_step=1.0)
            self._scipy.fun = self._evaluate
            for name, value in scipy.items():
                if name.startswith("K"):  # the stages, which may be a view of another array
                    getattr(self._scipy, name)[...] = value
                else:
                    setattr(self._scipy, name, value)
        problem.count = count
        self._was = Settings._make(settings_of(self))._replace(**was)

    def __copy__(self) -> EIPSolver:
        return copy.deepcopy(self)

    def _count(self) -> int:
        """Update nfev, njev and nlu, and return how many suspicious corrections and errors the engine has counted."""
        counters = self._run.work.counters.tolist()
        self.nfev, self.njev, self.nlu = counters[NFEV], counters[NJEV], counters[NLU]
        return int(counters[FOUND])

    def _evaluate(self, t: float, y: np.ndarray) -> np.ndarray:
        """Return the checked value of `fun`, and count the call: for SciPy's solver, which copies it."""
        problem = self._run.problem
        problem.count += 1
        return problem.evaluate(t, y)

    def _scipy_solver(self, start: np.ndarray) -> OdeSolver | None:
        """Return a solver of SciPy that makes the steps of a run without invariants, or None if there is none."""
        if self._SCIPY is None or self.h is not None:
            return None
        control = {"max_step": self.max_step, "rtol": self.rtol, "atol": self.atol}
        control["first_step"] = self._run.stepping.first_step
        solver = self._SCIPY(self._run.problem.derivative, self.t, start, self.t_bound, **control)
        if np.isnan(solver.h_abs):
            return None  # SciPy's loop would never end
        solver.fun = self._evaluate  # it replaces SciPy's two wrappers, which count and convert as it does
        return solver

    def _scipy_step(self, solver: OdeSolver) -> tuple[bool, str | None]:
        # This solver's own step() does the bookkeeping, so that SciPy's step() is not needed.
        success, message = solver._step_impl()
        self.nfev = self._run.problem.count
        if not success:
            if not np.isfinite(solver.K).all():
                message = f"fun returned a non-finite value at t={self.t:.10g}"
            elif (unscaled := np.flatnonzero((self.atol == 0) & (solver.y == 0) & (solver.f == 0))).size:
                message = (
                    f"the error of component {unscaled[0]} has no scale at t={self.t:.10g}: y and `atol` are 0 there; "
                    "give atol > 0"
                )
            return False, message
        solver.t_old = self.t
        self.y_old, self.y, self.t = self.y, solver.y, solver.t
        self.f, self.h_abs, self.h_previous = solver.f, solver.h_abs, solver.h_previous
        return True, None

    def _step_impl(self) -> tuple[bool, str | None]:
        if not self._untouched:
            self._apply_changes()
        done, message = self._own_step() if self._scipy is None else self._scipy_step(self._scipy)
        self._settle()
        return done, message

    def _own_step(self) -> tuple[bool, str | None]:
        run = self._run
        status, t, y_new, f_new = self._engine.step(self._k, self.t, self._raw, self.f)
        found = self._count()
        if status != OK:
            run.trust.failed = True
            return False, failure(status, run, run.schedule.clock)
        if t == self.t:
            return False, self.TOO_SMALL_STEP
        self._k += 1
        self._steps += 1
        self.h_previous = t - self.t
        self._raw_old, self._raw = self._raw, y_new
        self.y_old = self.y
        self.y = self._on_manifold(t, y_new) if run.shows else y_new
        self.t, self.f = t, f_new
        if self.h is None:
            self.h_abs = run.schedule.clock.item(NEXT_LENGTH)
        if found != self._noted or is_check_due(self._steps) or self.t == self.t_bound:
            self._watch()
            if slowed := run.slowed(self._steps, t, y_new):
                run.trust.failed = True
                return False, slowed
        return True, None

    def _watch(self, *, ended: bool = False) -> None:
        """Examine the run, and warn once if it looks faulty, at once, because the user may make no further step."""
        run, arrived = self._run, ended or self.t == self.t_bound
        self._noted = run.work.counters[FOUND]
        if not self._warned and run.look(self._steps, arrived, self.t, self.y):
            self._warned = True
            warnings.warn(f"{type(self).__name__}: {run.trust.message}", ProjectionWarning, stacklevel=users_level())

    def _sampled(self) -> Interpolants:
        """Return the `Interpolants` of the run, which return projected states; the first call creates them."""
        if self._interpolants is None:
            self._interpolants = Interpolants(self._run, self._engine)
        self._interpolants.record.waiting[:] = self._waits
        return self._interpolants

    def _on_manifold(self, t: float, y: np.ndarray) -> np.ndarray:
        """Return the state of a step for the user: a projected copy if the state waits for its projection."""
        waits = bool(t != self.t_bound if self.TABLEAU.has_history else self._run.work.counters[WAITED] > 0)
        self._waits = self._waits[1], waits
        return self._sampled().shown(t, y) if waits else y

    def _dense_output_impl(self) -> DenseOutput:
        t, y = self._was.t, self._was.y
        if self._kept is not None and not is_state(y, self._kept):  # y was changed in place since the last step
            y = np.frombuffer(self._kept, y.dtype) if isinstance(self._kept, bytes) else self._kept
        if self._scipy is not None:
            out: DenseOutput = ExactEnds(self._scipy.dense_output(), self.y_old, y)
            self.nfev = self._run.problem.count
        elif self.TABLEAU.drives and not self._run.invariants.size:
            out = ExactEnds(self._run.stepper.scipy_solver.dense_output(), self.y_old, y)
        else:
            ends = (self._raw_old, self._raw) if self._run.shows else (self.y_old, y)
            out = self._sampled().over(self.t_old, ends[0], t, ends[1])
            self._count()
        self._was = self._was._replace(nfev=self.nfev)
        return out


def _reduced_class(made: type) -> Any:
    """Return the name by which a class is pickled, or the call of `eip_method` that makes it again."""
    origin = vars(made).get("_ORIGIN")
    return made.__qualname__ if origin is None else (eip_method, (origin,))


copyreg.pickle(SolverClass, _reduced_class)


def _jacobians(method: Any, options: dict[str, Any]) -> dict[str, Any]:
    """Remove the options for the Jacobian from `options`, and return those that the method takes, by name."""
    if method.drives:
        return {"jac": Jacobian(options.pop("jac", None), options.pop("jac_sparsity", None))}
    return {"jacobian": options.pop("jacobian", None)} if method.has_history else {}


def _without_effect(names: Iterable[str]) -> str:
    """Return SciPy's warning about unknown options in its own words, so that existing warning filters apply."""
    listed = ", ".join(f"`{name}`" for name in names)
    hints = ((name, nearest(name, OPTIONS).removeprefix("; ")) for name in names if name not in OF_OTHERS)
    meant = "".join(f" `{name}`: {hint}" for name, hint in hints if hint)
    return f"The following arguments have no effect for a chosen solver: {listed}.{meant}"


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

    Examples
    --------
    >>> import numpy as np
    >>> from eip_scipy import EIPBDF, solve_ivp
    >>> decay = lambda t, y: np.array([-1e4 * y[0] + y[1], 1e4 * y[0] - y[1]])
    >>> sol = solve_ivp(decay, (0, 10), [1, 0], method=EIPBDF, invariants=lambda t, y: y.sum())
    >>> sol.trusted, bool(abs(sol.y.sum(axis=0) - 1).max() < 1e-14)
    (True, True)
    """

    TABLEAU = BDF
    error_estimator_order: Any = NotImplemented  # it varies

    @property
    def order(self) -> int:
        """Order of the next step, as in `scipy.integrate.BDF`."""
        return int(self._run.stepper.scipy_solver.order)


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

    See Also
    --------
    solve_ivp, integrate, eip_scipy.methods.Tableau, eip_scipy.solvers.OneStepMethod

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
