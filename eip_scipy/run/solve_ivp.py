"""`solve_ivp` with typed options: SciPy's function, whose result also shows whether the run is reliable."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
import scipy.integrate
from numpy.typing import ArrayLike
from scipy.integrate import OdeSolution, OdeSolver

from ..core.derivatives import First
from ..core.events import Events, as_events, replaced
from ..core.functions import AccelerationField, are_same
from ..core.inputs import initial_state, shown
from ..core.invariants import as_invariants, with_args
from ..core.projection import ProjectionKeywords, ProjectionOptions, takes_projection_options
from ..core.results import Diagnostics
from ..core.solvers import (
    EIPBDF,
    EIPDOP853,
    EIPRK23,
    EIPRK45,
    Context,
    EIPRadau,
    EIPSolver,
    class_named,
    eip_method,
)  # fmt: skip
from ..core.step_control import interval
from ..core.tangent_vectors import StateSolution, TangentVectors, tangent_vectors
from ..core.variations import Variations, augmented_rhs
from .watch import Watch

if TYPE_CHECKING:
    Result = dict[str, Any]
else:  # SciPy's class of results has no public name
    Result = type(scipy.integrate.solve_ivp(lambda t, y: y, (0.0, 0.0), [0.0]))

__all__ = ["OdeResult", "solve_ivp"]

BY_NAME = {"RK23": EIPRK23, "RK45": EIPRK45, "DOP853": EIPDOP853, "Radau": EIPRadau, "BDF": EIPBDF}
NOTHING = np.zeros(0)
WITHOUT = "LSODA"  # the method of SciPy without an EIP method
# Options that only EIP methods have.
OWN = {"h", "jacobian", "diagnostics", "variations", "jvp", *ProjectionOptions.names()}


class OdeResult(Result):
    """Result of `solve_ivp`: SciPy's OdeResult with fields that show whether the run is reliable.

    Attributes
    ----------
    t : ndarray, shape (m,)
        Times.
    y : ndarray, shape (n, m)
        States. With ``project_initial=True`` the state at the start is the projected one.
    sol : OdeSolution or None
        The solution as a function of time, with ``dense_output=True``.
    t_events, y_events : list of ndarray or None
        Times and states of each event.
    nfev, njev, nlu : int
        Numbers of evaluations of `fun` and of the invariants' gradients, and of factorisations in projections.
    status : int
        0: the end was reached; 1: an event ended the run; -1: a step failed.
    message : str
        The reason why the run ended, how far `project_initial` moved the start, and, for an unreliable run, the reason.
    success : bool
        ``status >= 0``.
    trusted : bool
        True if no step failed and the run is reliable, see `Diagnostics`.
    diagnostics : Diagnostics
        The record of the projections.
    variations : ndarray, shape (m, n, k)
        The columns of derivatives of the state at the times `t`, if they were requested.

    See Also
    --------
    eip_scipy.solve_ivp
    """

    t: np.ndarray
    y: np.ndarray
    sol: OdeSolution | None
    t_events: list[np.ndarray] | None
    y_events: list[np.ndarray] | None
    nfev: int
    njev: int
    nlu: int
    status: int
    message: str
    success: bool
    trusted: bool
    diagnostics: Diagnostics
    variations: np.ndarray


@takes_projection_options
def solve_ivp(
    fun: Callable[..., Any] | None = None,
    t_span: ArrayLike | None = None,
    y0: ArrayLike | None = None,
    method: type[OdeSolver] | str = EIPRK45,
    t_eval: ArrayLike | None = None,
    dense_output: bool = False,
    events: Callable[..., Any] | Sequence[Callable[..., Any]] | None = None,
    vectorized: bool = False,
    args: Iterable[Any] | None = None,
    *,
    acceleration: Callable[..., Any] | None = None,
    h: float | None = None,
    first_step: float | None = None,
    max_step: float | None = None,
    rtol: ArrayLike | None = None,
    atol: ArrayLike | None = None,
    jacobian: Callable[..., Any] | None = None,
    variations: Any = None,
    jvp: Callable[..., Any] | None = None,
    diagnostics: Diagnostics | None = None,
    jac: Any = None,
    jac_sparsity: Any = None,
    lband: int | None = None,
    uband: int | None = None,
    min_step: float | None = None,
    callback: Callable[[float, np.ndarray, np.ndarray], Any] | None = None,
    progress: bool = False,
    max_steps: int | None = None,
    **projection: Unpack[ProjectionKeywords],
) -> OdeResult:
    """Solve an initial value problem with `scipy.integrate.solve_ivp`, and report whether the run is reliable.

    The states are those of `scipy.integrate.solve_ivp` with the same method. In addition this function passes `args` to
    the invariants, accepts accelerations, and has options that editors and type checkers know.

    Parameters
    ----------
    fun : callable
        ``fun(t, y, *args) -> (n,)``, the right-hand side.
    t_span : (float, float)
        Start and end.
    y0 : array_like, shape (n,)
        Initial state, real or complex.
    method : type or str, optional
        An EIP method (default: `EIPRK45`), or a method of SciPy by its name or class. If invariants or other options of
        the EIP methods are given, "RK23", "RK45", "DOP853", "Radau", "BDF" and other explicit Runge-Kutta classes are
        replaced by the EIP methods for them; otherwise the run uses SciPy's method.
    t_eval, dense_output, events, vectorized
        As for `scipy.integrate.solve_ivp`. At the start, events are those of `integrate`; with the steps of SciPy and
        without invariants, one that is exactly 0 there happens, as in SciPy.
    args : tuple, optional
        Further arguments of `fun`, of the events, of `jacobian` and `jac`, and of the invariants. An invariant receives
        them after its own ``args``, unless both are the same.
    acceleration : callable, optional
        Instead of `fun`: ``acceleration(t, q, *args) -> (n/2,)`` for q'' = a(t, q) with the state (q, v).
    h : float, optional
        Length of fixed steps. Default: adaptive steps.
    first_step, max_step, rtol, atol : optional
        As for the methods, with the defaults of the methods.
    jacobian : callable, optional
        For `EIPGJ14`: ``jacobian(t, q, dq, out, *args)``.
    variations : "state" or array_like, shape (n, k), optional
        Derivatives of the state that are integrated with it: all n columns of the state-transition matrix, or columns
        with these initial values. The result has them as ``variations``. `integrate` also gives derivatives with
        respect to parameters.
    jvp : callable, optional
        For `variations`: ``jvp(t, y, dy, *args) -> (n,)``, the Jacobian of `fun` times dy.
    {names of ProjectionOptions}
        As for the methods, see `EIPSolver`.
    diagnostics : Diagnostics, optional
        An empty record, which the run fills. Default: a new one.
    jac, jac_sparsity : optional
        The Jacobian, for `EIPRadau`, `EIPBDF` and SciPy's implicit methods, see `scipy.integrate.Radau`.
    lband, uband, min_step : optional
        Options of SciPy's LSODA.
    callback : callable, optional
        ``callback(t, y, residuals)``, called at each saved point with the invariant errors `residuals` (none with a
        method of SciPy); return True to stop the run with status 1. Points at `t_eval` are reported after their step.
    progress : bool, optional
        Show a progress bar with the remaining time.
    max_steps : int, optional
        Largest number of steps; a run that needs more ends with status -1, and keeps what it has.

    Returns
    -------
    OdeResult
        SciPy's result, with ``trusted`` and ``diagnostics``; for an unreliable run ``message`` includes the reason.

    Raises
    ------
    TypeError
        If options of the EIP methods are given with LSODA or a class without an EIP method, or if SciPy or the method
        rejects an argument.

    Warns
    -----
    ProjectionWarning
        If the run is not reliable.
    UserWarning
        If an option has no effect for the method.

    See Also
    --------
    integrate, scipy.integrate.solve_ivp, eip_scipy.solvers.EIPSolver, eip_scipy.results.OdeResult

    References
    ----------
    .. [1] W. Cai, Y. Gong, Y. Wang, "An explicit and practically invariants-preserving method for conservative
       systems".

    Examples
    --------
    >>> import numpy as np
    >>> from eip_scipy import EIPDOP853, solve_ivp
    >>> def pendulum(t, y, g):
    ...     return [y[1], -g * np.sin(y[0])]
    >>> def energy(t, y, g):
    ...     return 0.5 * y[1] ** 2 - g * np.cos(y[0])
    >>> sol = solve_ivp(pendulum, (0, 20), [1.0, 0.0], EIPDOP853, args=(9.81,), invariants=energy, rtol=1e-8)
    >>> sol.success, sol.trusted, bool(sol.diagnostics.max_residual < 1e-11)
    (True, True, True)
    """
    options: dict[str, Any] = {
        "h": h, "first_step": first_step, "max_step": max_step, "rtol": rtol, "atol": atol, "jacobian": jacobian,
        "diagnostics": diagnostics, "jac": jac, "jac_sparsity": jac_sparsity, "lband": lband, "uband": uband,
        "min_step": min_step, "variations": variations, "jvp": jvp,
    }  # fmt: skip
    options = {name: value for name, value in options.items() if value is not None} | dict(projection)
    if kept := as_invariants(options.pop("invariants", ())):
        options["invariants"] = kept
    function = _right_hand_side(fun, acceleration, t_span, y0)
    args, extra = _unpacked(args)
    watch = Watch(callback, progress, max_steps)
    common: dict[str, Any] = {"t_eval": t_eval, "dense_output": dense_output, "vectorized": vectorized, "args": args}
    method = _with_projection(method, [name for name in options if name in OWN])
    if isinstance(method, type) and issubclass(method, EIPSolver):
        return _solve(watch, method, function, t_span, y0, extra, events, common, options)
    if events is not None:
        common["events"] = Events(events, extra).for_scipy(None, as_scipy=True)
    sol = watch.run(function, t_span, y0, method, **common, **options)
    return OdeResult(sol, trusted=bool(sol.success), diagnostics=Diagnostics())


def _solve(
    watch: Watch,
    method: type[EIPSolver],
    fun: Any,
    t_span: Any,
    y0: Any,
    extra: tuple,
    events: Any,
    common: Any,
    options: Any,
) -> OdeResult:
    """Return the result of a run with an EIP method; `common` has the options of SciPy's solve_ivp itself."""
    start, solvers = initial_state(y0), list[Any]()
    items = options.get("invariants", ())
    if extra:
        # The arguments of the call follow those of an invariant, unless both are the same.
        items = tuple(x if are_same(x.args, extra) else with_args(x, (*x.args, *extra)) for x in items)
        if (jacobian := options.get("jacobian")) is not None:
            options["jacobian"] = lambda *first: jacobian(*first, *extra)
    record = options.setdefault("diagnostics", Diagnostics())
    asked, jvp, augmented = options.pop("variations", None), options.pop("jvp", None), None
    if asked is not None:
        first = First(interval(t_span)[0], start, extra)
        tangents = tangent_vectors(asked, method, start, NOTHING)
        rhs, source = augmented_rhs(tangents, fun, "value", first, jvp)
        augmented = Variations.of(tangents, rhs, source, first._replace(extra=()), items, in_python=True)
        fun, start, items = augmented.derivative, tangents.augmented(start, NOTHING), augmented.invariants
        events = None if events is None else replaced(as_events(events), map(augmented.event, as_events(events)))
    elif jvp is not None:
        raise TypeError("solve_ivp: jvp needs variations=...; pass variations, or omit jvp.")
    if events is not None:
        begun = lambda t, y: (solvers[0].f, solvers[0].direction * float(solvers[0].h or solvers[0].h_abs))  # noqa: E731
        common["events"] = Events(events, extra).for_scipy(begun, as_scipy=method._takes_scipys_steps(options))
    options |= {"invariants": items, "_context": Context(start, solvers, augmented)}
    common["tangents"] = None if augmented is None else augmented.tangents
    sol = watch.run(fun, t_span, start, method, **common, **options)
    if augmented is not None:
        _split(sol, augmented.tangents)
    if sol.status == 1:  # SciPy does not inform the solver that its run has ended
        solvers[0]._watch(ended=True)
    missing = solvers[0]._run.conserved.missing
    message = "; ".join(map(str, filter(None, (sol.message, record.moved, missing, record.message))))
    return OdeResult(sol, message=message, trusted=bool(sol.success) and record.trusted, diagnostics=record)


def _split(sol: Any, tangents: TangentVectors) -> None:
    """Split the augmented states in a result `sol` into its states and its ``variations``, in place."""
    sol.y, sol.variations = tangents.split(sol.y.T)
    sol.y = sol.y.T
    if sol.y_events is not None:
        sol.y_events = list(map(tangents.state, sol.y_events))
    if sol.sol is not None:
        sol.sol = StateSolution(sol.sol, tangents)


def _right_hand_side(fun: Any, acceleration: Any, t_span: Any, y0: Any) -> Any:
    """Return `fun`, or the right-hand side that belongs to `acceleration`, after checks of the arguments."""
    name, given = ("fun", fun) if acceleration is None else ("acceleration", acceleration)
    if acceleration is not None and fun is not None:
        raise TypeError("solve_ivp: give fun or acceleration, not both.")
    if given is None:
        raise TypeError("solve_ivp: fun is missing; give a function fun(t, y), or a function a(t, q) as acceleration=.")
    if not callable(given):
        hint = "; for a Problem call problem.solve_ivp(method=...)" if hasattr(given, "solve_ivp") else ""
        raise TypeError(f"solve_ivp: {name} must be callable, got {shown(given)}{hint}.")
    if t_span is None or y0 is None:
        raise TypeError(f"solve_ivp: {'t_span' if t_span is None else 'y0'} is missing.")
    return fun if acceleration is None else AccelerationField(acceleration)


def _with_projection(method: Any, given: list[str]) -> Any:
    """Return the EIP method on a method of SciPy if options of EIP methods are `given`; otherwise the method itself."""
    known = class_named(method)
    if isinstance(method, str) and known is not None and method.upper() == known.upper():
        raise ValueError(f"solve_ivp: {method!r} is a name; give the class, as in `from eip_scipy import {known}`.")
    is_class = isinstance(method, type) and issubclass(method, OdeSolver)
    if not given or not (is_class or method in BY_NAME or method == WITHOUT):
        return method
    if not is_class and method in BY_NAME:
        return BY_NAME[method]
    if is_class and (hasattr(method, "A") or method.__name__ in BY_NAME):
        return eip_method(method)
    if refused := [name for name in given if name in ("variations", "jvp", *ProjectionOptions.names())]:
        raise TypeError(
            f"solve_ivp: the method {getattr(method, '__name__', method)} takes no {', '.join(refused)}; give an EIP "
            "method such as EIPDOP853, or omit these options."
        )
    return method


def _unpacked(args: Any) -> tuple[Any, tuple[Any, ...]]:
    """Return `args` for SciPy, and as a tuple; SciPy raises the error for those that cannot become a tuple."""
    try:
        extra = () if args is None else tuple(args)
    except TypeError:
        return args, ()
    return None if args is None else extra, extra
