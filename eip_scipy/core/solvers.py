"""The solver classes: EIP methods that `scipy.integrate.solve_ivp` takes as ``method=``."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar

import numpy as np
import scipy.integrate
from scipy.integrate import DenseOutput, OdeSolver

from ..engine.counters import FOUND, NFEV, NJEV, NLU, REJECTED
from ..engine.data import FAILED_PROJECTION, OK, bare_schedule
from ..engine.native import Call, PythonFunctions
from ..engine.trust import ProjectionWarning
from ..methods.multistep import GaussJackson
from ..methods.nystrom import RKN86, RKN1210, NystromTableau
from ..methods.runge_kutta import DOP853, RK1, RK2, RK3, RK4, RK5, RK23, RK45, Tableau
from . import setup
from .dense import ExactEnds, Interpolants
from .inputs import refuse_units, shown
from .invariants import as_invariants
from .multistep import SecondOrder, attach_history, times
from .names import nearest
from .one_step import OneStep, OneStepMethod
from .options import ProjectionOptions, takes_projection_options
from .setup import Start
from .stepping import StepOptions, Stepping, interval

__all__ = [
    "EIPDOP853",
    "EIPGJ12",
    "EIPGJ14",
    "EIPRK1",
    "EIPRK2",
    "EIPRK3",
    "EIPRK4",
    "EIPRK5",
    "EIPRK23",
    "EIPRK45",
    "EIPRKN8",
    "EIPRKN12",
    "EIPSolver",
    "eip_method",
]

OPTIONS = ("h", "first_step", "max_step", "rtol", "atol", "vectorized", "diagnostics", *ProjectionOptions.names())


@takes_projection_options
class EIPSolver(OdeSolver):
    """Explicit invariants-preserving solver: a Runge-Kutta step, then one Newton step of projection.

    Use one of the methods `EIPRK1` ... `EIPRK5`, or `eip_method` for a tableau of your own, with
    `scipy.integrate.solve_ivp`.

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
        Step control, as in SciPy's own methods; the error estimate sees the step before its projection. `rtol` and
        `atol` are also the scale of the error metric: ``|atol| + rtol |y|``, norms over a block.
    vectorized : bool, optional
        Whether `fun` takes (n, k) arrays, as in SciPy.
    h : float, optional
        A fixed step instead: its length, > 0 in either direction. The last step ends on `t_bound` and may be shorter.
    {ProjectionOptions}
    diagnostics : Diagnostics, optional
        An empty `Diagnostics`, which the run fills.

    Attributes
    ----------
    n, status, t_bound, direction, t, y, t_old, step_size, nfev, njev, nlu
        As in `scipy.integrate.OdeSolver`; `njev` counts evaluations of the invariants' gradients and `nlu`
        factorisations of the projection.

    Notes
    -----
    The error estimate sees the step before its projection. Defects of the invariants after it are O(h^(2p + 2)) for a
    method of order p (theorem 2.1 of [1]_), and the method keeps its order.

    References
    ----------
    .. [1] W. Cai, Y. Gong, Y. Wang, "An explicit and practically invariants-preserving method for conservative
       systems".
    """

    TABLEAU: ClassVar[Tableau | NystromTableau | GaussJackson | OneStep]
    # SciPy's class of the same pair: without invariants it takes the steps, so that they are SciPy's to the last bit.
    _SCIPY: ClassVar[type[OdeSolver] | None] = None
    t: float
    t_old: float

    def __init__(
        self,
        fun: Callable[..., Any],
        t0: float,
        y0: Any,
        t_bound: float,
        max_step: float = np.inf,
        rtol: Any = 1e-3,
        atol: Any = 1e-6,
        vectorized: bool = False,
        first_step: float | None = None,
        *,
        h: float | None = None,
        diagnostics: Any = None,
        **options: Any,
    ) -> None:
        if not hasattr(self, "TABLEAU"):
            raise TypeError("EIPSolver is the base class; use EIPRK4 and the like, or eip_method(tableau).")
        jacobian = options.pop("jacobian", None) if isinstance(self.TABLEAU, GaussJackson) else None
        projection, extraneous = ProjectionOptions.of(options)
        if extraneous:
            warnings.warn(_without_effect(extraneous), UserWarning, stacklevel=3)
        t0, t_bound = interval((t0, t_bound))
        start = setup.initial_state(y0)
        self._calls = [0]
        derivative, self._call = _checked(fun, start.size, start.dtype, vectorized, self._calls)
        self._derivative = derivative
        super().__init__(fun, t0, start, t_bound, vectorized, support_complex=True)
        steps = StepOptions(h=h, first_step=first_step, max_step=max_step, rtol=rtol, atol=atol)
        stepping = steps.checked(type(self).__name__, self.TABLEAU, t0, t_bound, self.n, stacklevel=4)
        self.h, self.max_step = stepping.h, stepping.span.max_step
        self.rtol, self.atol = stepping.rtol, stepping.atol
        self._k, self._span = 0, stepping.span
        kept = as_invariants(projection.invariants)
        if self.h is None and stepping.first_step is None:
            stepping.require_scale(start)
        self._scipy = self._scipy_solver(derivative, start, stepping, bool(kept) or bool(projection.compensated))
        f0 = derivative(t0, start).copy() if self._scipy is None else np.zeros_like(start)
        fresh = partial(_copied, derivative)
        if isinstance(self.TABLEAU, NystromTableau):
            setup.check_second_order(fresh, t0, start, f0, type(self).__name__)
        self._method = self.TABLEAU
        if isinstance(self.TABLEAU, GaussJackson):
            if self._finishes:
                raise TypeError(f"{type(self).__name__}: a multistep method has no step that _project_step could end.")
            velocities = setup.depends_on_velocity(fresh, t0, start, f0, type(self).__name__)
            self._method = replace(self.TABLEAU, velocities=velocities)
        self.h_abs = stepping.first_step
        if self._scipy is None:
            self.h_abs = stepping.first(derivative, start, f0, self.TABLEAU)
        projection = replace(projection, invariants=kept)
        begin = Start(t0, start, f0, self.h_abs or 0.0)
        run = setup.prepare(self._method, derivative, begin, projection, stepping)
        jacobian_call = None
        if isinstance(self._method, GaussJackson):
            jacobian_call = self._attach(run, jacobian, begin, stepping)
        setup.attach(diagnostics, run)
        self._run, self._work = run, run.work
        self._project_now, self._projection_status, self._last = False, OK, False
        self._accepted = run.y0
        if run.y0 is not start:
            f0 = derivative(t0, run.y0).copy()
        self.y, self.f = run.y0, f0
        self._work.counters[NFEV] = self._calls[0]
        self._count()
        self.y_old = self.y
        self._noted, self._told = 0, False
        self._interpolants: Interpolants | None = None
        if self._scipy is None:
            self._work.K[0] = f0
            self._schedule = bare_schedule(stepping.span, float(self.h_abs or 0.0))
            functions = PythonFunctions(
                self._call, *run.invariants.calls, (), second_order=False, jacobian=jacobian_call
            )
            self._engine = run.engine(functions, self._schedule, **self._hooks())

    def _attach(self, run: setup.Run, jacobian: Any, begin: Start, stepping: Stepping) -> Call | None:
        """The history of a multistep method; the Jacobian as the engine calls it."""
        method, half = self._method, self.n // 2
        assert isinstance(method, GaussJackson)
        if jacobian is not None and not callable(jacobian):
            raise TypeError(f"jacobian must be a function jacobian(t, q, dq, out), got {shown(jacobian)}.")

        moved = None if jacobian is None else times(jacobian)
        seen = SecondOrder(partial(_copied, self._derivative), begin, moved, None)
        attach_history(run, method, type(self).__name__, seen, stepping, level=True)
        if jacobian is None:
            return None
        return Call(jacobian, (), (half,), _never, takes_f=True, in_place=True)

    def _hooks(self) -> dict[str, Any]:
        """Parts of the steps that a subclass takes itself, see `Hooks`."""
        return {"finish": self._finish} if self._finishes else {}

    @property
    def _finishes(self) -> bool:
        """Whether a subclass ends the steps, by the hook."""
        return type(self)._project_step is not EIPSolver._project_step

    def _count(self) -> None:
        counters = self._work.counters.tolist()
        self.nfev, self.njev, self.nlu = counters[NFEV], counters[NJEV], counters[NLU]

    def _scipy_solver(
        self,
        derivative: Callable[[float, np.ndarray], np.ndarray],
        start: np.ndarray,
        stepping: Stepping,
        own_steps: bool,
    ) -> OdeSolver | None:
        if self._SCIPY is None or stepping.h is not None or own_steps or self._finishes:
            return None

        control = {"first_step": stepping.first_step, "max_step": self.max_step, "rtol": self.rtol, "atol": self.atol}
        solver = self._SCIPY(partial(_copied, derivative), self.t, start, self.t_bound, **control)
        if np.isnan(solver.h_abs):
            return None  # SciPy's loop would never end
        solver.fun = derivative  # in place of SciPy's two wrappers, whose work it does
        return solver

    def _scipy_step(self, solver: OdeSolver) -> tuple[bool, str | None]:
        # Not its step(), whose bookkeeping is done for this solver already.
        success, message = solver._step_impl()
        self.nfev = self._calls[0]
        if not success:
            if not np.isfinite(solver.K).all():
                message = f"fun returned a non-finite value at t={self.t:.10g}"
            elif (unscaled := np.flatnonzero((self.atol == 0) & (solver.y == 0) & (solver.f == 0))).size:
                message = (
                    f"the error of component {unscaled[0]} has no scale at t={self.t:.10g}: y and `atol` are 0 there"
                )
            return False, message
        # SciPy keeps the value itself, and a user's function may return the same buffer again.
        solver.f = solver.f.copy()
        solver.t_old = self.t
        self.y_old, self.y, self.t = self.y, solver.y, solver.t
        return True, None

    def _step_impl(self) -> tuple[bool, str | None]:
        if self._scipy is not None:
            return self._scipy_step(self._scipy)
        run, w = self._run, self._work
        status, t, y_new, f_new = self._engine.step(self._k, self.t, self.y, self.f)
        self._count()
        if status != OK:
            run.trust.failed = True
            return False, setup.failure(status, run, self._schedule.clock)
        self._k += 1
        self.y_old = self.y
        self.y, self.t, self.f = y_new, t, f_new
        if self._finishes:
            self.y = self._accepted
        if w.counters[FOUND] != self._noted or self._k in setup.LOOKS or self.t == self.t_bound:
            self._watch()
        return True, None

    def _watch(self) -> None:
        """Look at the run where something stands out, early and at its end; warn once, and at once: it may end here."""
        run, arrived = self._run, self.t == self.t_bound
        self._noted = self._work.counters[FOUND]
        if not self._told and run.look(self._k, arrived, self.t, self.y, lambda: self._derivative(self.t, self.y)):
            self._told = True
            warnings.warn(f"{type(self).__name__}: {run.trust.message}", ProjectionWarning, stacklevel=5)

    def _finish(self, t_new: float, project: bool, last: bool) -> int:
        """What the engine's `finish_step` does, with the hook in its place."""
        w = self._work
        self._project_now, self._projection_status, self._last = project, OK, last
        self._accepted = self._project_step(t_new, self.y, w.y_hat, w.err)
        if self._projection_status == FAILED_PROJECTION:
            w.counters[REJECTED] += 1
            return FAILED_PROJECTION
        self._engine.close(t_new, self._accepted, project, self._projection_status)
        return OK

    def _project_step(self, t: float, y: np.ndarray, y_hat: np.ndarray, err: np.ndarray) -> np.ndarray:
        """The accepted state from a raw step; override to act after each step.

        Parameters
        ----------
        t : float
            Time of the new state.
        y : ndarray, shape (n,)
            The state that the step started from.
        y_hat : ndarray, shape (n,)
            The raw result; a buffer, valid during the call.
        err : ndarray
            Its local error estimate (float view: 2 n entries for a complex state), zero where there is none.

        Returns
        -------
        ndarray, shape (n,)
            A new array.
        """
        w, y_new = self._work, np.empty_like(y)
        if not self._project_now:
            y_new[:] = y_hat
            return y_new
        if y_hat is not w.y_hat:
            w.y_hat[:] = y_hat
        if err is not w.err:
            w.err[:] = err
        self._projection_status = self._engine.project(self.t, y, t, self._last, y_new)
        return y_new

    def _dense_output_impl(self) -> DenseOutput:
        if self._scipy is not None:
            out = ExactEnds(self._scipy.dense_output(), self.y_old, self.y)
            self.nfev = self._calls[0]
            return out
        if self._interpolants is None:
            self._interpolants = Interpolants(self._run, self._method, self._engine)
        out = self._interpolants.over(self.t_old, self.y_old, self.t, self.y)
        self._count()
        return out


def _copied(derivative: Callable[[float, np.ndarray], np.ndarray], t: float, y: np.ndarray) -> np.ndarray:
    """The derivative as an array of its own."""
    return derivative(t, y).copy()


def _never(value: Any, t: float) -> np.ndarray:
    """Of a function in place, whose value nobody looks at."""
    raise AssertionError


def _without_effect(names: Iterable[str]) -> str:
    """What SciPy's own solvers warn of, in their words: filters made for theirs hold here too."""
    listed = ", ".join(f"`{name}`" for name in names)
    hints = ((name, nearest(name, OPTIONS).removeprefix("; ")) for name in names)
    meant = "".join(f" `{name}`: {hint}" for name, hint in hints if hint)
    return f"The following arguments have no effect for a chosen solver: {listed}.{meant}"


def _checked(
    fun: Callable[..., Any], n: int, dtype: np.dtype, vectorized: bool, calls: list[int]
) -> tuple[Callable[[float, np.ndarray], np.ndarray], Call]:
    """The user's right-hand side with clear errors: as (t, y) -> (n,), maybe their buffer, and for the engine.

    The first counts in `calls`; the step counts its own. All hand out copies, because a user's function may keep or
    overwrite what it was given, and test the common case, an array of the right shape and type, first.
    """
    shape = (n,)

    def flat(t: float, y: np.ndarray) -> np.ndarray:
        f = fun(t, y[:, None])
        refuse_units(**{"fun returned": f})
        return np.asarray(f).reshape(-1)

    called = flat if vectorized else fun

    def convert(f: Any, t: float) -> np.ndarray:
        return np.array(setup.as_derivative(f, n, dtype, t), dtype, order="C")

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
    """EIP method on explicit Euler (order 1); it has no error estimate, so the metric is euclidean.

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
    """

    TABLEAU = RKN86


class EIPRKN12(EIPSolver):
    """EIP method on the Runge-Kutta-Nystrom pair 12(10) of Dormand, El-Mikkawy and Prince, 17 stages.

    For q'' = a(t, q) as a first-order system: the state is (q, v), and the first half of `fun` must be v. `integrate`
    also takes the acceleration alone, as ``acceleration=``. Options: see `EIPSolver`; at small steps ``every="auto"``.
    Dense output is as accurate as the steps and takes 15 more evaluations in each step in which a state is asked for.
    """

    TABLEAU = RKN1210


class EIPGJ12(EIPSolver):
    """EIP method on the summed multistep method of Gauss and Jackson, of order 12: one evaluation a step.

    For smooth motions q'' = a(t, q), with a fixed step `h`, as a first-order system: the state is (q, v), and the
    first half of `fun` must be v. `integrate` also takes the acceleration alone, as ``acceleration=``; accelerations
    that depend on velocities come as the second half of `fun`. Options: see `EIPSolver`; `every` is "auto" and
    `compensated` True unless given.

    Raises
    ------
    ValueError
        When `h` is not stable at the start; the message says which step is.

    Notes
    -----
    The first states come from `EIPRKN12` (from DOP853 where accelerations depend on velocities), with the same step.
    The projection's corrections go into the sums. `integrate` shows states that are centred on the history, which runs
    ahead of them by half the order, up to the end of the interval; solve_ivp those at its newest end, which are less
    accurate by rounding.
    """

    TABLEAU = GaussJackson(order=12)


class EIPGJ14(EIPSolver):
    """EIP method on the multistep method of Gauss and Jackson of order 14, its accelerations corrected by the Jacobian.

    As `EIPGJ12`, with longer steps: after each evaluation the accelerations are moved by the Jacobian times what the
    corrector would change of the positions, for the bodies that need it. `nbody` and the scenes made of it bring the
    Jacobian of the central body; for others give ``jacobian=fun(t, q, dq, out[, params])``, to `integrate` or
    solve_ivp. Without one the step is stable only where it is very short.
    """

    TABLEAU = GaussJackson(order=14, corrected=True)


def eip_method(method: Tableau | NystromTableau | GaussJackson | OneStepMethod) -> type[EIPSolver]:
    """A solver class on any explicit Runge-Kutta or Runge-Kutta-Nystrom tableau, or on a one-step method of your own.

    Parameters
    ----------
    method : Tableau, NystromTableau, GaussJackson or OneStepMethod
        The last is any object with ``one_step(t, y, h) -> y_hat`` and ``order``; see `OneStepMethod`. Its steps are
        projected like all others; `fun` serves gradients that take f and dense output (a cubic through both ends)
        only, so that `nfev` does not count what `one_step` evaluates.

    Returns
    -------
    type[EIPSolver]
        To be passed as ``method=`` to `scipy.integrate.solve_ivp` or `integrate`.

    Raises
    ------
    TypeError
        When it is none of them.
    ValueError
        When a one-step method's order is no integer >= 1.

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
    tableau = method if isinstance(method, (Tableau, NystromTableau, GaussJackson)) else OneStep(method)
    return type(f"EIP_{tableau.name}", (EIPSolver,), {"TABLEAU": tableau, "__doc__": f"EIP method on {tableau!r}."})
