"""The result of `integrate`, and what can be done with it: tables, files, figures, a run that goes on."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.integrate import OdeSolution
from scipy.optimize import OptimizeResult

from ..core.results import Diagnostics
from .tables import default_names, to_dataframe, to_xarray

__all__ = ["Fields", "IntegrationResult", "Origin", "WithColumns"]


class Origin(NamedTuple):
    """Where a result comes from, so that its run can go on.

    Attributes
    ----------
    request : Request
        What `integrate` was asked for.
    t : float
    y : ndarray, shape (n,)
        The last state of the run, saved or not.
    sign : float
        The direction of time, 1 or -1.
    invariants : tuple of Invariant
        Those of the run, with the values that it keeps as their targets.
    """

    request: Any
    t: float
    y: np.ndarray
    sign: float
    invariants: Any


if TYPE_CHECKING:
    Fields = dict[str, Any]  # of which type checkers know those that are annotated
else:
    Fields = OptimizeResult
ABSENT = {
    "stm": 'this run has no state-transition matrix; ask for it with variations="state".',
    "sensitivities": "this run has no sensitivities; name parameters in variations=[...].",
    "variations": "this run carried no derivatives; ask for them with variations=...",
}
UNSET = ("units", "epoch")  # fields that print where they hold something


class WithColumns(Fields):
    """A result whose runs may have carried derivatives."""

    variations: np.ndarray
    columns: dict[str, Any]

    @property
    def stm(self) -> np.ndarray:
        """State-transition matrices at the saved times, (m, n, n), of a run with ``variations="state"``.

        ``run.stm[k, i, j]`` is the derivative of ``run.y[i, k]`` by component j of the initial state. In an ensemble
        those of the members, as its `variations`.

        Raises
        ------
        AttributeError
            When the run did not carry it.
        """
        if not self.get("columns", {}).get("state"):
            raise AttributeError(ABSENT["stm"])
        return self.variations[..., : self.variations.shape[-2]]

    @property
    def sensitivities(self) -> np.ndarray:
        """Derivatives of the state by the parameters of ``variations=[...]`` at the saved times, (m, n, p).

        Raises
        ------
        AttributeError
            When the run did not carry any.
        """
        count = self.get("columns", {}).get("parameters", 0)
        if not count:
            raise AttributeError(ABSENT["sensitivities"])
        return self.variations[..., self.variations.shape[-1] - count :]

    if not TYPE_CHECKING:  # which would take any name for an attribute

        def __getattr__(self, name: str) -> Any:
            # OptimizeResult's own would take the place of what a property has just raised.
            if name in ABSENT and name not in self:
                raise AttributeError(ABSENT[name])
            return OptimizeResult.__getattr__(self, name)


class IntegrationResult(WithColumns):
    """Result of `integrate`; fields by name or by key, as in SciPy's own results.

    Attributes
    ----------
    t : ndarray, shape (m,)
        Saved times.
    y : ndarray, shape (n, m)
        Saved states.
    invariants : ndarray, shape (l, m)
        Values of the invariants there.
    target : ndarray, shape (l,)
        The values that were kept.
    max_defect : ndarray, shape (l,)
        Largest ``|I - target|`` after a projection or at a saved state.
    diagnostics : Diagnostics
    t_events, y_events : list of ndarray or None
        As in `scipy.integrate.solve_ivp`.
    sol : OdeSolution or None
        Likewise: the run as a function of time, with ``dense_output=True``.
    nfev, njev, nlu : int
        Evaluations of the right-hand side and of the invariants' gradients, and factorisations. A one-step method of
        another kind (`Lawson`, `Splitting`) adds what it evaluates in the place of the right-hand side.
    status : int
        0: the end was reached; 1: a callback or an event stopped the run; -1: a step failed.
    message : str
    success : bool
        ``status >= 0``.
    trusted : bool
        Whether, besides, nothing speaks against the run; if not, `message` says what. See `Diagnostics`.
    wall_time : float
        Seconds in the integration, compilation left out.
    compiled : bool
        Whether all functions were called natively; if not, `message` says which were not, and why.
    calls : dict of str
        How each was called: "python", "jitted" (a Numba function, as a C pointer), "pointer" (a C function) or, of a
        C function's gradient that is not given, "differences". The keys are "fun" or "acceleration", the name of each
        invariant ("invariant 0" for the first one, if it has none), "gradient of " and that name, "event 0", "event 1"
        and so on.
    method : str
    h : float or None
    variations : ndarray, shape (m, n, k)
        The columns of derivatives at the saved times, of a run that was asked for them. Between two steps they are
        interpolated, not projected. See `stm` and `sensitivities`.
    columns : dict
        Of such a run: "state", whether the state-transition matrix is among them; "parameters", the number of
        derivatives by parameters, and their "names"; "symplectic", whether the matrix was kept so; "source", the origin
        of the products with the Jacobian: "problem", "jvp", "dual numbers" or "complex steps".
    component_names : tuple of str
        Those of the `Problem`, or "y0", "y1" and so on; assign others as you like.
    units : str
        Those of the `Problem`, "" without one.
    epoch : (float, float) or None
        When t is 0, see `Problem`.

    Notes
    -----
    The result pickles. A result that was pickled or loaded no longer knows the functions of its run: it cannot
    `continue_to`, and its ``sol`` holds a polynomial for each step, which meets the states at the steps exactly and
    those in between to 1e-12.
    """

    t: np.ndarray
    y: np.ndarray
    invariants: np.ndarray
    target: np.ndarray
    max_defect: np.ndarray
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

    @property
    def component_names(self) -> tuple[str, ...]:
        """Names of the components of the state, (n,)."""
        given = self.get("component_names")
        return default_names(len(self.y)) if given is None else tuple(given)

    def to_xarray(self, names: Any = None) -> Any:
        """The run as an `xarray.Dataset`, see `eip_scipy.results.to_xarray`."""
        return to_xarray(self, names)

    def to_dataframe(self, names: Any = None) -> Any:
        """The run as a `pandas.DataFrame`, see `eip_scipy.results.to_dataframe`."""
        return to_dataframe(self, names)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the result to a file that `eip_scipy.load` reads, see `eip_scipy.results.save`."""
        from .saving import save

        save(self, path)

    def plot(self, names: Any = None, *, orbit: bool | None = None, ax: Any = None) -> Any:
        """Draw the run, see `eip_scipy.results.plot`."""
        from .figures import plot

        return plot(self, names, orbit=orbit, ax=ax)

    def view(self, path: Any = None, *, names: Any = None, reference: Any = None) -> Any:
        """Write a page that plays the run, see `eip_scipy.results.view`."""
        from .view import view

        return view(self, path, names=names, reference=reference)

    def continue_to(self, t: float, **options: Any) -> IntegrationResult:
        """Go on from the last state to a later time, with the functions and options of the run.

        Parameters
        ----------
        t : float
            The new end, beyond the present one in the direction of the run; as in `t_span` of `integrate` also a
            duration from t = 0, or a time.
        **options
            Options of `integrate` that are to be others than before. Times in `t_eval` are not asked for again: give
            new ones, or the states at both ends are saved. Events keep their counts: one with ``terminal = 3`` that
            happened twice before ends the run when it happens once more, and one that ended the run ends it again when
            it happens next; ``events=None`` leaves it out. Events that are given anew begin to count at 0, and may
            happen at once.

        Returns
        -------
        IntegrationResult
            Both runs as one: rows, events and interpolants in order, counts and seconds summed, defects and corrections
            the largest of both, `trusted` where both are; status, message, method and h are those of the second.

        Raises
        ------
        ValueError
            When `t` is not beyond the end; when the result was loaded, unpickled or copied; when the last state misses
            an invariant by more than 1e-8 of its terms, as after a run that is not to be trusted or was not checked:
            ``project_initial=True`` then projects it first.

        Notes
        -----
        The second run is an `integrate` from the last state, and has its bits, but that each invariant keeps the value
        of the first start: defects do not add up. It is not bit for bit the run that had gone through: times are
        counted from the new start, `save_every` too; adaptive steps begin with a first step again; compensated sums,
        and the history of multistep methods, start anew, which costs a rounding error and a new start of the method.
        For a run that is to have the same bits, checkpoint it (``checkpoint=``, ``resume=True``).

        Examples
        --------
        >>> from eip_scipy import EIPRK4, integrate
        >>> from eip_scipy.problems import kepler
        >>> run = integrate(kepler(), (0, 10), method=EIPRK4, save_every=10)
        >>> longer = run.continue_to(20)
        >>> float(longer.t[-1]), bool((longer.max_defect < 1e-11).all())
        (20.0, True)
        """
        from .continuation import continued

        return continued(self, t, options)

    def __repr__(self) -> str:
        """Without what this run has none of."""
        return repr(OptimizeResult({key: value for key, value in self.items() if key not in UNSET or value}))

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), "continue_to", "plot", "save", "to_dataframe", "to_xarray", "view"]

    def __getstate__(self) -> None:
        """Of attributes beside the fields there is the origin alone, whose functions stay here."""
        return None
