"""The result of `integrate`, with functions that make tables, files and figures of it, and continue the run."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.integrate import OdeSolution
from scipy.optimize import OptimizeResult

from .. import checkpoint
from ..checkpoint import CheckpointError, decoded, encoded
from ..core.event_derivatives import EVENT_DERIVATIVES
from ..core.inputs import shown
from ..core.problem import Problem, component_names
from ..core.results import Diagnostics, Multipliers
from . import fields
from .fields import OBSERVED
from .origin import restored, stored
from .prepare import DEFAULT

__all__ = ["Fields", "IntegrationResult", "Result", "described", "load", "plot", "save", "steps"]


def described(ended: str, diagnostics: Diagnostics, notes: Sequence[str]) -> str:
    """Return a message: the reason for the end, remarks on the start and on doubts, and `notes` in parentheses."""
    message = "; ".join(filter(None, (ended, diagnostics.moved, diagnostics.message)))
    return f"{message} ({'; '.join(notes)})" if notes else message


KIND = "result"
CLASSES = ("IntegrationResult", "EnsembleResult")
RESUMED = ("integrate", "ensemble")  # functions that continue from a checkpoint if called with the same arguments


def save(result: Any, path: str | os.PathLike[str]) -> None:
    """Write a result to a file that `load` reads.

    Parameters
    ----------
    result : IntegrationResult, EnsembleResult or OdeResult
        Result of `integrate`, `ensemble` or `scipy.integrate.solve_ivp`. All fields are saved, including those that
        were added later, except functions: ``sol``, and the functions of the run.
    path : path-like
        File to write, with any name; an existing file is replaced in one step when the new one is complete. The file is
        an npz archive, which `numpy.load` can open, with ``header.json`` for everything that is not an array.

    Raises
    ------
    TypeError
        If `result` is not such a result, or a field is neither numeric nor representable in JSON. An array with a mask
        or a unit is refused as well, because only its numbers would be saved.
    CheckpointError
        If the file cannot be written.

    See Also
    --------
    eip_scipy.load, to_dataframe, to_xarray

    Examples
    --------
    >>> import tempfile
    >>> from eip_scipy import EIPRK4, integrate, load
    >>> from eip_scipy.problems import kepler
    >>> run = integrate(kepler(), (0, 10), method=EIPRK4, save_every=10)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     run.save(f"{folder}/kepler.npz")
    ...     again = load(f"{folder}/kepler.npz")
    >>> bool((again.y == run.y).all()), again.message
    (True, 'reached the end of the interval')
    """
    if not isinstance(result, OptimizeResult):
        raise TypeError(f"save: expected a result of integrate, ensemble or solve_ivp, got {shown(result)}.")
    if isinstance(result, Result):
        result._observe()
    arrays: dict[str, np.ndarray] = {}
    found = {name: None if callable(value) else encoded(name, value, arrays) for name, value in result.items()}
    header = {"kind": KIND, "class": type(result).__name__, "fields": found}
    if (origin := vars(result).get("_origin")) is not None:
        header["origin"] = stored(origin, arrays)
    checkpoint.write(path, header, arrays)


def load(path: str | os.PathLike[str]) -> Any:
    """Read a result that `save` has written.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    IntegrationResult or EnsembleResult
        The saved result without functions: ``sol`` is None, and `IntegrationResult.continue_to` needs those of the run
        again. A result of `solve_ivp` is returned as `scipy.optimize.OptimizeResult`, its base class.

    Raises
    ------
    OSError
        If the file cannot be read, for instance because it does not exist.
    ValueError
        If the file was not written by `save`, or is damaged.

    See Also
    --------
    eip_scipy.results.save, integrate, eip_scipy.checkpoint.read

    Examples
    --------
    >>> import tempfile
    >>> from eip_scipy import EIPRK4, integrate, load
    >>> from eip_scipy.problems import kepler
    >>> run = integrate(kepler(), (0, 3), method=EIPRK4, save_every=10)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     run.save(f"{folder}/run.npz")
    ...     bool((load(f"{folder}/run.npz").y == run.y).all())
    True
    """
    name = repr(os.fspath(path))
    try:
        header, arrays = checkpoint.read(path)
    except CheckpointError as error:
        if isinstance(error.__cause__, OSError):
            raise error.__cause__ from None
        raise ValueError(f"load: {name} is not a result written by save of this version: {error}") from error
    if (kind := header.get("kind")) != KIND:
        again = f"; {kind}(..., checkpoint={name}, resume=True) continues it" if kind in RESUMED else ""
        raise ValueError(f"load: {name} is not a result written by save, but a checkpoint of {kind!r}{again}.")
    found = {field: decoded(value, arrays) for field, value in header["fields"].items()}
    if header["class"] not in CLASSES:
        return OptimizeResult(found)
    # Imported by name, because ensembles are built on runs.
    result = getattr(import_module("..results", __package__), header["class"])(found)
    object.__setattr__(result, "_origin", restored(header.get("origin"), arrays))
    return result


def plot(result: Any, names: Any = None, *, orbit: bool | None = None, ax: Any = None) -> Any:
    """Draw a run: the components or the orbit, the invariant errors, and the largest corrections.

    Small invariant errors only show that the projection works and say nothing about the orbit; the panel of corrections
    shows how much the projection had to correct.

    Parameters
    ----------
    result : IntegrationResult, OdeResult or EnsembleResult
        Result of `integrate`, `scipy.integrate.solve_ivp`, or `ensemble` (see `EnsembleResult.plot`). The saved states
        are drawn: use `save_every` or `t_eval`.
    names : sequence of str or str, optional
        As for `to_xarray`.
    orbit : bool, optional
        True: draw paths in the plane instead of components in time. Default: True if real components are named x and
        y, or x_0 and y_0, x_1 and y_1 and so on. Of paths in space, with z, the two directions in which they are
        largest are drawn, and the label names the third.
    ax : matplotlib.axes.Axes, optional
        Draw only the orbit or the components, into these axes.

    Returns
    -------
    matplotlib.figure.Figure or matplotlib.axes.Axes
        The figure, or `ax` if it is given. A notebook shows the figure automatically; in a script
        ``matplotlib.pyplot.show()`` shows it, and ``figure.savefig("run.png")`` writes it to a file.

    Raises
    ------
    ImportError
        If matplotlib is missing: ``pip install "eip_scipy[plot]"``.
    TypeError, ValueError
        If `ax` is not one Axes, `ax` or `orbit` is given for an ensemble, or no components have names of an orbit.

    See Also
    --------
    IntegrationResult, to_dataframe

    Examples
    --------
    >>> from eip_scipy import EIPRK4, integrate
    >>> from eip_scipy.problems import kepler
    >>> figure = integrate(kepler(), (0, 20), method=EIPRK4, save_every=1).plot()
    """
    if ax is not None and not hasattr(ax, "plot"):
        kind = f"{type(ax).__name__} of shape {ax.shape}" if isinstance(ax, np.ndarray) else type(ax).__name__
        raise TypeError(f"plot: ax must be one matplotlib Axes, got {kind}; choose one of several, such as axes[0].")
    if hasattr(result, "trajectories"):
        if ax is not None or orbit is not None:
            raise TypeError("plot: the figure of an ensemble takes neither ax nor orbit; omit them.")
        return result.plot(names)
    from ..plotting.results import run_figure

    return run_figure(result, names, orbit, ax)


def steps(result: Any) -> str:
    """Return the method and the step of a run or an ensemble."""
    return f"{result.method}, " + ("adaptive steps" if result.h is None else f"h = {result.h:g}")


if TYPE_CHECKING:
    Fields = dict[str, Any]  # type checkers know the annotated fields
else:
    Fields = OptimizeResult
ABSENT = {
    "stm": 'this run has no state-transition matrix; ask for it with variations="state".',
    "sensitivities": "this run has no sensitivities; name parameters in variations=[...].",
    "variations": "this run carried no derivatives; ask for them with variations=...",
    **dict.fromkeys(EVENT_DERIVATIVES, "this run has no derivatives at events; give it variations=... and events=..."),
    "encounters": "this run has no encounters; make its problem by nbody(..., encounters=...), and pass events of your "
    "own as events=[mine, *problem.events].",
    "multipliers": "this result has no multipliers: its problem is not a mechanical system with constraints.",
    "outputs": "this result has no outputs; give outputs={name: ...} to `mechanism` or `mechanics`.",
}
UNSET = ("units", "epoch", "restarts")  # fields that are printed only if they are set


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
        an ensemble the shape is (members, m, n, n), or (members, n, n) without trajectories. AttributeError is raised
        for other runs.
        """
        if not self.get("columns", {}).get("state"):
            raise AttributeError(ABSENT["stm"])
        return self.variations[..., : self.variations.shape[-2]]

    @property
    def sensitivities(self) -> np.ndarray:
        """Derivatives of the state with respect to parameters, ``variations=[...]``, at the saved times, (m, n, p).

        p is the number of these parameters. For an ensemble the shape is (members, m, n, p), or (members, n, p)
        without trajectories. AttributeError is raised for other runs.
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

    to_xarray = fields.to_xarray
    to_dataframe = fields.to_dataframe
    save = save

    def _observe(self) -> None:
        """Compute the fields for outputs and multipliers if the problem has them and they have not been computed."""
        if not any(name in self for name in OBSERVED):
            self.update(self._observed())

    def _observed(self) -> dict[str, Any]:
        """Return the fields that the problem computes from the states, see `Problem.observed`."""
        origin = vars(self).get("_origin")
        arguments = {} if origin is None else origin.arguments
        problem = arguments.get("fun")
        return problem.observed(self.t, self.y, arguments["params"]) if isinstance(problem, Problem) else {}

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Compute outputs and multipliers, for which an unpickled result has no functions; return what is pickled."""
        self._observe()
        return super().__reduce_ex__(protocol)

    def __getstate__(self) -> None:
        """Return None: a pickle excludes attributes that are not fields, such as the functions of the run."""
        return None

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
    tangent_events : list of ndarray, shape (m, n, k)
        For each event of a run with derivatives, the columns at the m times at which it happened.
    time_derivatives : list of ndarray, shape (m, k)
        Derivatives of these times, along the same columns: -(grad g Phi + dg/dp) / (dg/dt + grad g f) for an event g.
        They are NaN, and `message` says so, if the state only grazes the event, so that its rate vanishes there.
    state_derivatives : list of ndarray, shape (m, n, k)
        Derivatives of the states at the event, whose times shift: ``tangent_events`` plus f times ``time_derivatives``.
    columns : dict
        Description of the columns of `variations`: "state", True if the state-transition matrix is included;
        "parameters", the number of derivatives with respect to parameters, and "names", the names of these parameters;
        "symplectic", True if the matrix was kept symplectic; "source", the origin of the products with the Jacobian:
        "problem", "jvp", "dual numbers" or "complex steps".
    encounters : ndarray, shape (m, 5)
        Closest approaches, of a problem ``nbody(..., encounters=...)``: columns t, i, j, distance and relative speed.
    restarts : list of (float, str)
        Times at which `continue_to` has restarted the run with a change, and the names of what was given: "y, params".
    targets : ndarray, shape (l, m)
        Targets of the invariants at the saved times, which differ if restarts have changed them. `target` has the last.
    units : str
        Units of the `Problem`; "" without one.
    epoch : (float, float) or None
        Time of t = 0, see `Problem`.
    outputs : dict of str to ndarray, shape (m,)
        For a mechanical system with ``outputs=``: values of these quantities at the saved times.
    multipliers : Multipliers
        For a mechanical system with constraints: Lagrange multipliers at the saved times. Outputs and multipliers are
        computed when they are first requested.

    See Also
    --------
    eip_scipy.integrate, plot, save, to_dataframe, to_xarray

    Notes
    -----
    The result can be pickled. A result that was pickled or loaded does not know the functions of its run: `continue_to`
    of a loaded one takes them, and raises an error for one that was pickled. In a pickled result ``sol`` has the same
    states at the steps, but those in between are not projected, because that needs the functions; in a loaded result it
    is None.
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
    encounters: np.ndarray
    restarts: list[tuple[float, str]]
    tangent_events: list[np.ndarray]
    time_derivatives: list[np.ndarray]
    state_derivatives: list[np.ndarray]

    plot = plot

    @property
    def targets(self) -> np.ndarray:
        """Targets of the invariants at the saved times, (l, m); NaN for a `Balance`."""
        found = np.asarray(self["target"])[:, None]
        return self["targets"] if "targets" in self else np.broadcast_to(found, self["invariants"].shape)

    def continue_to(
        self,
        t: float,
        *,
        y: Any = None,
        jacobian: Any = None,
        params: Any = None,
        fun: Any = None,
        acceleration: Any = None,
        invariants: Any = None,
        events: Any = DEFAULT,
        h: float | None = DEFAULT,
        rtol: Any = DEFAULT,
        atol: Any = DEFAULT,
        save_every: int | None = DEFAULT,
        t_eval: Any = DEFAULT,
        **options: Any,
    ) -> IntegrationResult:
        """Continue from the last state to a later time, as before or with a change of the state or the equations.

        Parameters
        ----------
        t : float
            New end of the run, beyond the present one in its direction.
        y : array_like, shape (n,), or callable, optional
            The state from which the run continues, or a function ``y(state) -> (n,)`` of the last state: a kick or a
            bounce.
        jacobian : array_like, shape (n, n) or (n, n + p), or callable, optional
            Derivative of the new state with respect to the old one, and to the p parameters whose derivatives the run
            carries, or a function of the last state that returns it. Needed with `y` in a run with ``variations=``.
        params : array_like or mapping, optional
            New parameters; those that a mapping does not name keep their values.
        fun, acceleration : callable or Problem, optional
            New equations, as for `integrate`. For a loaded run, the equations that it had.
        invariants : optional
            New invariants. Default: those of the run; of a `Problem` that is given as `fun`; none if `fun` replaces a
            Problem by a function. For a loaded run, the invariants that it had.
        events : callable or sequence of callable, optional
            New events, which start to count at 0 and may happen at once; `t_events` and `y_events` are then those of
            the second run only. None removes all. By default the events keep their counts: one with ``terminal = 3``
            that happened twice before ends the run when it happens once more, and one that ended the run ends it again
            when it happens next.
        h, rtol, atol, save_every, t_eval : optional
            As for `integrate`. `t_eval` is not repeated: without new times the states at both ends are saved.
        **options
            Other options of `integrate` that may change: method, first_step, max_step, max_steps, callback, progress,
            compiled, max_bytes, checkpoint, checkpoint_every, resume, check and project_initial.

        Returns
        -------
        IntegrationResult
            Both runs combined: rows, events and interpolants in order, counts and seconds added, invariant errors and
            corrections the larger of both, `trusted` if both are, with the reasons of both in `message`; status,
            method and h are those of the second run. `restarts` lists what was given. Fields that were added to the
            first result are left out. Its rows may share memory with those of this result.

        Raises
        ------
        ValueError
            If another option of `integrate` is given; if something that an invariant uses has changed, so that it has
            another value in the last state; if `t` is not beyond the end; if functions given to a loaded run have other
            values in its last state than those that it had; if `jacobian` is missing or wrong; if the result was
            unpickled or copied; or if the state misses a given target by more than 1e-8 of the terms of the invariant,
            as after an unreliable run or one without checks: ``project_initial=True`` then projects the state first.

        Notes
        -----
        Without a change the second run agrees bit by bit with an `integrate` from the last state, except that each
        invariant keeps the value of the first start, so that errors do not add up. It agrees only to rounding with an
        uninterrupted run: `save_every`, the first step of adaptive steps, compensated sums and the history of multistep
        methods start again. Use a checkpoint (``checkpoint=``, ``resume=True``) for the same bits.

        With a change of `y`, `params`, `fun`, `acceleration` or `invariants` the states before and after it are saved
        both. An invariant keeps its value if the change leaves it, and otherwise takes the new value as its target,
        unless the user has given a target. Tangent vectors pass through the change: by its Jacobian J at a fixed
        time, and as J S - f dt at an event that ended the run, where f is the new derivative, dt the `time_derivatives`
        and S the `state_derivatives` of the event. They are not kept symplectic afterwards. Derivatives with respect to
        a parameter that changes are those for a shift by the same amount in all parts.

        Examples
        --------
        >>> from eip_scipy import EIPRK4, integrate
        >>> from eip_scipy.problems import kepler
        >>> run = integrate(kepler(), (0, 10), method=EIPRK4, save_every=10)
        >>> longer = run.continue_to(20)
        >>> float(longer.t[-1]), bool((longer.max_residual < 1e-11).all())
        (20.0, True)
        >>> kicked = longer.continue_to(30, y=lambda y: y * [1, 1, 1.01, 1.01])
        >>> kicked.restarts
        [(20.0, 'y')]
        """
        from .continuation import continue_to

        given = {"events": events, "h": h, "rtol": rtol, "atol": atol, "save_every": save_every, "t_eval": t_eval}
        changes = {"y": y, "jacobian": jacobian, "params": params, "fun": fun, "acceleration": acceleration}
        options |= {name: value for name, value in given.items() if value is not DEFAULT}
        options |= {name: value for name, value in (changes | {"invariants": invariants}).items() if value is not None}
        return continue_to(self, t, options)

    def _repeated(self, events: Sequence[Callable[..., Any]]) -> IntegrationResult:
        """Return the same run with these events in place of its own; it saves the states at both ends."""
        from .continuation import repeated

        return repeated(self, events)

    def __repr__(self) -> str:
        """Return the fields as text, without `units` and `epoch` if they are not set."""
        return repr(OptimizeResult({key: value for key, value in self.items() if key not in UNSET or value}))
