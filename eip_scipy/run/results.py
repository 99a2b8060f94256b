"""The result of `integrate`: tables, files, figures, and the continuation of a run."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.integrate import OdeSolution
from scipy.optimize import OptimizeResult

from ..core.problem import Problem, component_names
from ..core.results import Diagnostics, Multipliers
from .tables import to_dataframe, to_xarray

__all__ = ["Fields", "IntegrationResult", "Origin", "Result", "described"]


class Origin(NamedTuple):
    """Origin of a result, from which its run can be continued."""

    request: Any  # `RunArguments`: the arguments of `integrate`
    t: float  # time of the last state
    y: np.ndarray  # (n,): last state of the run, saved or not
    sign: float  # direction of time, 1 or -1
    kept: Callable[[], Any]  # returns the invariants of the run, with the kept values as their targets
    values: Callable[[], np.ndarray]  # returns the invariants (l,) in the last state, as their functions are now
    ended: str  # reason for the end of the run
    notes: tuple[str, ...]  # remarks at the end of its message


def described(ended: str, diagnostics: Diagnostics, notes: Sequence[str]) -> str:
    """Return a message: the reason for the end, remarks on the start and on doubts, and `notes` in parentheses."""
    message = "; ".join(filter(None, (ended, diagnostics.moved, diagnostics.message)))
    return f"{message} ({'; '.join(notes)})" if notes else message


if TYPE_CHECKING:
    Fields = dict[str, Any]  # type checkers know the annotated fields
else:
    Fields = OptimizeResult
ABSENT = {
    "stm": 'this run has no state-transition matrix; ask for it with variations="state".',
    "sensitivities": "this run has no sensitivities; name parameters in variations=[...].",
    "variations": "this run carried no derivatives; ask for them with variations=...",
    "multipliers": "this result has no multipliers: its problem is not a mechanical system with constraints.",
    "outputs": "this result has no outputs; give outputs={name: ...} to `mechanism` or `mechanics`.",
}
OBSERVED = ("outputs", "multipliers")  # computed when they are first requested
UNSET = ("units", "epoch")  # fields that are printed only if they are set


class Result(Fields):
    """Base class of the results of runs and ensembles, which may have derivatives of the state (``variations=``)."""

    COMPONENTS = 0  # axis of `y`
    t: np.ndarray
    y: np.ndarray
    variations: np.ndarray
    columns: dict[str, Any]

    @property
    def stm(self) -> np.ndarray:
        """State-transition matrices at the saved times, (m, n, n), of a run with ``variations="state"``.

        ``run.stm[k, i, j]`` is the derivative of ``run.y[i, k]`` with respect to component j of the initial state. For
        an ensemble the shape is (members, m, n, n), or (members, n, n) without trajectories.

        Raises
        ------
        AttributeError
            If the run did not integrate the state-transition matrix.
        """
        if not self.get("columns", {}).get("state"):
            raise AttributeError(ABSENT["stm"])
        return self.variations[..., : self.variations.shape[-2]]

    @property
    def sensitivities(self) -> np.ndarray:
        """Derivatives of the state with respect to parameters, ``variations=[...]``, at the saved times, (m, n, p).

        p is the number of these parameters. For an ensemble the shape is (members, m, n, p), or (members, n, p)
        without trajectories.

        Raises
        ------
        AttributeError
            If the run did not integrate derivatives with respect to parameters.
        """
        count = self.get("columns", {}).get("parameters", 0)
        if not count:
            raise AttributeError(ABSENT["sensitivities"])
        return self.variations[..., self.variations.shape[-1] - count :]

    @property
    def component_names(self) -> tuple[str, ...]:
        """Names of the components from the `Problem`, or "y0", "y1" and so on; other names can be assigned."""
        names = self.get("component_names")
        return component_names(None, self.y.shape[self.COMPONENTS]) if names is None else tuple(names)

    def to_xarray(self, names: Any = None) -> Any:
        """Return the run as an `xarray.Dataset`, see `eip_scipy.results.to_xarray`."""
        return to_xarray(self, names)

    def to_dataframe(self, names: Any = None) -> Any:
        """Return the run as a `pandas.DataFrame`, see `eip_scipy.results.to_dataframe`."""
        return to_dataframe(self, names)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the result to a file that `eip_scipy.load` reads, see `eip_scipy.results.save`."""
        from .saving import save

        save(self, path)

    def _observe(self) -> None:
        """Compute the fields for outputs and multipliers if the problem has them and they have not been computed."""
        origin = vars(self).get("_origin")
        if origin is None or any(name in self for name in OBSERVED) or not isinstance(origin.request.fun, Problem):
            return
        self.update(origin.request.fun.observed(self.t, self.y, origin.request.params))

    def __dir__(self) -> list[str]:
        methods = ("continue_to", "plot", "save", "to_dataframe", "to_xarray")
        return [*super().__dir__(), *(name for name in methods if hasattr(type(self), name))]

    if not TYPE_CHECKING:  # type checkers would accept any attribute name

        def __getattr__(self, name: str) -> Any:
            # The __getattr__ of OptimizeResult would replace the error that a property has just raised.
            if name in OBSERVED:
                self._observe()
            if name in ABSENT and name not in self:
                raise AttributeError(ABSENT[name])
            return OptimizeResult.__getattr__(self, name)


class IntegrationResult(Result):
    """Result of `integrate`; fields are accessible by attribute or by key, as in SciPy's results.

    Attributes
    ----------
    t : ndarray, shape (m,)
        Saved times.
    y : ndarray, shape (n, m)
        Saved states.
    invariants : ndarray, shape (l, m)
        Values of the invariants at the saved times.
    target : ndarray, shape (l,)
        Values to which the invariants were projected.
    max_residual : ndarray, shape (l,)
        Largest invariant error ``|I - target|`` after a projection or at a saved state.
    diagnostics : Diagnostics
        Record of the projections.
    t_events, y_events : list of ndarray or None
        As in `scipy.integrate.solve_ivp`.
    sol : OdeSolution or None
        The run as a function of time, with ``dense_output=True``; as in `scipy.integrate.solve_ivp`.
    nfev, njev, nlu : int
        Numbers of evaluations of the right-hand side and of the invariants' gradients, and of factorisations in
        projections. For `EIPRadau` and `EIPBDF`, `njev` and `nlu` also count the Jacobians of the right-hand side and
        the factorisations in steps. For a one-step method of another kind, `nfev` also counts the evaluations that
        replace the right-hand side.
    status : int
        0: the end was reached; 1: a callback or an event stopped the run; -1: a step failed.
    message : str
        Reason for the end of the run, and remarks on it.
    success : bool
        ``status >= 0``.
    trusted : bool
        True if the run succeeded and is reliable; if not, `message` says why. See `Diagnostics`.
    wall_time : float
        Run time in seconds, without compilation.
    compiled : bool
        True if all functions were called natively; if not, `message` says which were not, and why.
    calls : dict of str
        How each function was called: "python", "jitted" (a Numba function, as a C pointer), "native" (a function of the
        engine), "pointer" (a C function), or "differences" for the gradient of a C function without one. The keys are
        "fun" or "acceleration", the name of each invariant ("invariant 0" for the first one, if it has none),
        "gradient of " and, for a `Balance`, "rate of " followed by that name, "jacobian" for a method that uses it,
        "event 0", "event 1" and so on.
    method : str
        Name of the method.
    h : float or None
        Step size; None for adaptive steps.
    variations : ndarray, shape (m, n, k)
        Columns of derivatives at the saved times, if they were requested. Between two steps they are interpolated
        and projected, as the states are. See `stm` and `sensitivities`.
    columns : dict
        Description of the columns of `variations`: "state", True if the state-transition matrix is included;
        "parameters", the number of derivatives with respect to parameters, and "names", the names of these parameters;
        "symplectic", True if the matrix was kept symplectic; "source", the origin of the products with the Jacobian:
        "problem", "jvp", "dual numbers" or "complex steps".
    units : str
        Units of the `Problem`; "" without one.
    epoch : (float, float) or None
        Time of t = 0, see `Problem`.
    outputs : dict of str to ndarray, shape (m,)
        For a mechanical system with ``outputs=``: values of these quantities at the saved times.
    multipliers : Multipliers
        For a mechanical system with constraints: Lagrange multipliers at the saved times. Outputs and multipliers are
        computed when they are first requested.

    Notes
    -----
    The result can be pickled. A result that was pickled or loaded does not know the functions of its run: `continue_to`
    raises an error. In a pickled result ``sol`` has the same states at the steps, but those in between are not
    projected, because that needs the functions; in a loaded result it is None.
    """

    invariants: np.ndarray
    target: np.ndarray
    max_residual: np.ndarray
    diagnostics: Diagnostics
    t_events: list[np.ndarray] | None
    y_events: list[np.ndarray] | None
    sol: OdeSolution | None
    nfev: int
    njev: int
    nlu: int
    status: int
    message: str
    success: bool
    trusted: bool
    wall_time: float
    compiled: bool
    calls: dict[str, str]
    method: str
    h: float | None
    units: str
    epoch: tuple[float, float] | None
    outputs: dict[str, np.ndarray]
    multipliers: Multipliers

    def plot(self, names: Any = None, *, orbit: bool | None = None, ax: Any = None) -> Any:
        """Draw the run, see `eip_scipy.results.plot`."""
        from .figures import plot

        return plot(self, names, orbit=orbit, ax=ax)

    def continue_to(self, t: float, **options: Any) -> IntegrationResult:
        """Continue from the last state to a later time, with the functions and options of the run.

        Parameters
        ----------
        t : float
            New end of the run, beyond the present one in its direction.
        **options
            Options of `integrate` that change: method, h, rtol, atol, first_step, max_step, save_every, t_eval, events,
            callback, progress, compiled, max_bytes, checkpoint, checkpoint_every, resume, check and project_initial.
            `t_eval` is not repeated: pass new times, otherwise the states at both ends are saved. Events keep their
            counts: an event with ``terminal = 3`` that happened twice before ends the run when it happens once more,
            and an event that ended the run ends it again when it happens next; ``events=None`` removes all events. New
            events start to count at 0, and may happen at once. If they are not the same functions in the same order,
            `t_events` and `y_events` contain those of the second run only.

        Returns
        -------
        IntegrationResult
            Both runs combined: rows, events and interpolants in order, counts and seconds added, invariant errors and
            corrections the larger of both, `trusted` if both are, with the reasons of both in `message`; status,
            method and h are those of the second run. Fields that were added to the first result are left out.

        Raises
        ------
        ValueError
            If another option of `integrate` is given, because a value of the first part belongs to it: the targets of
            the invariants to `params`, derivatives to the first start. If an invariant has another value in the last
            state than before, because something that its function uses has changed. If `t` is not beyond the end, or
            the result was loaded, unpickled or copied. If at the last state the error of an invariant with a given
            target exceeds 1e-8 of the terms of this invariant, as after an unreliable run or one without checks;
            ``project_initial=True`` then projects the state first.

        Notes
        -----
        The second run agrees bit by bit with an `integrate` from the last state, except that each invariant keeps the
        value of the first start, so that errors do not add up. It does not agree bit by bit with an uninterrupted run:
        `save_every` counts from the new start, adaptive steps begin with a first step again, and compensated sums and
        the history of multistep methods start again, which costs a rounding error and a new start of the method. Use a
        checkpoint (``checkpoint=``, ``resume=True``) for a run with the same bits.

        Examples
        --------
        >>> from eip_scipy import EIPRK4, integrate
        >>> from eip_scipy.problems import kepler
        >>> run = integrate(kepler(), (0, 10), method=EIPRK4, save_every=10)
        >>> longer = run.continue_to(20)
        >>> float(longer.t[-1]), bool((longer.max_residual < 1e-11).all())
        (20.0, True)
        """
        from .continuation import continue_to

        return continue_to(self, t, options)

    def __repr__(self) -> str:
        """Return the fields as text, without `units` and `epoch` if they are not set."""
        return repr(OptimizeResult({key: value for key, value in self.items() if key not in UNSET or value}))

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Compute outputs and multipliers, for which an unpickled result has no functions; return what is pickled."""
        self._observe()
        return super().__reduce_ex__(protocol)

    def __getstate__(self) -> None:
        """Return None: a pickle excludes attributes that are not fields, such as the functions of the run."""
        return None
