"""The result of an ensemble: its fields, its table and its text."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..core.problem import Problem
from ..core.results import Multipliers
from ..engine.data import NFEV, NJEV, NLU, REJECTED
from ..run.fields import Field, component_names, dataset, distinct, time_name
from ..run.results import Result, steps

__all__ = ["COUNTERS", "FAILED", "MEMBER_FIELDS", "NOT_RUN", "EnsembleResult"]

FAILED, NOT_RUN = -1, -2  # status; the others are those of `integrate`
SHOWN = 5
COUNTERS = {"nfev": NFEV, "njev": NJEV, "nlu": NLU, "n_rejected_projections": REJECTED}


def _each(*dims: str, unset: Any = np.nan, table: str = "") -> Field:
    """Return the declaration of a field that each member has; its value is `unset` for a member that did not run."""
    return Field(("member", *dims), table=table, unset=unset)


MEMBER_FIELDS = {
    "y": _each("component"),
    "t": _each(table="t_end"),
    "status": _each(unset=NOT_RUN),
    "message": _each(unset="not run"),
    **dict.fromkeys(("trusted", "side_by_side"), _each(unset=False)),
    **dict.fromkeys(COUNTERS, _each(unset=0)),
    "max_correction": _each(),
    **dict.fromkeys(("max_residual", "target"), _each("invariant")),
    "trajectories": _each("component", "time", table="states"),
    "invariants": _each("invariant", "time"),
    "end_invariants": _each("invariant", table="end_invariants"),  # `invariants` of a result without trajectories
    **dict.fromkeys(("method", "h", "success", "stopped", "wall_time"), Field(())),
}


class EnsembleResult(Result):
    """Result of `ensemble`; fields are accessible by attribute or by key, as in SciPy's results.

    Attributes
    ----------
    y : ndarray, shape (members, n)
        Last states: at the end of the interval, or before a member failed.
    t : ndarray, shape (members,)
        Times of the last states.
    status : ndarray, shape (members,)
        0: the end was reached; 1: an event ended the member; -1: it failed; -2: it did not run (in the partial result
        of an interrupted ensemble).
    message : ndarray of str, shape (members,)
        Reason for the end of each member.
    failed : ndarray
        Indices of the members with status -1.
    success : bool
        True if all members ran and none failed.
    max_residual : ndarray, shape (members, l)
        Largest invariant error ``|I - target|`` after a projection; each member has its own target.
    max_correction : ndarray, shape (members,)
        Largest correction in units of the local error; nan if the method has no error estimate.
    side_by_side : ndarray of bool, shape (members,)
        True for members that ran vectorised, in a batch with others, which is several times faster; the page on
        ensembles in the documentation lists the conditions.
    one_by_one : str
        Reason why members ran one after the other instead of vectorised; "" if they were vectorised. Single members
        that a batch could not finish may have run alone even then, see `side_by_side`.
    trusted : ndarray of bool, shape (members,)
        True for members that did not fail and are reliable, as in `IntegrationResult`; otherwise `message` says why.
    names : tuple of str
        Names of the l invariants.
    nfev, njev, nlu, n_rejected_projections : ndarray, shape (members,)
        Evaluations of the right-hand side and of the gradients, factorisations, and rejected projections.
    times : ndarray, shape (m,)
        Times of the saved states; empty if no states are saved.
    trajectories : ndarray or None, shape (members, n, m)
        Saved states; nan after the end of a member that ended early. None if no states are saved or ``reduce=`` was
        given.
    invariants : ndarray, shape (members, l) or (members, l, m)
        Values of the invariants in the saved states if `trajectories` has them, else in the last states.
    target : ndarray, shape (members, l)
        Values to which the invariants of each member were projected.
    t_events, y_events : list of list of ndarray, or None
        If there are events, ``t_events[k]`` and ``y_events[k]`` are those of member k, as in
        `scipy.integrate.solve_ivp`: one array for each event.
    reduced : ndarray or None, shape (members, ...)
        Value of the function ``reduce=`` for each member, nan for members that failed or did not run. None without
        ``reduce=``.
    variations : ndarray, shape (members, n, k) or (members, m, n, k)
        Columns of derivatives if ``variations=`` was given, in the saved states if `trajectories` has them, else in the
        last states. `stm` and `sensitivities` are parts of it; `columns` is as in `IntegrationResult`.
    tangent_events, time_derivatives, state_derivatives : list of list of ndarray
        With events and ``variations=``: for member k the lists of `IntegrationResult`, with one array for each event.
    encounters : list of ndarray, shape (m, 5)
        The closest approaches of each member, of a problem ``nbody(..., encounters=...)``.
    outputs : dict of str to ndarray, shape (members,) or (members, m)
        For a mechanical system with ``outputs=``: values of these quantities in the same states, computed when they are
        first requested; nan where there is no state.
    multipliers : Multipliers
        For a mechanical system with constraints, likewise: ``values`` (members, c) or (members, c, m) for c constraints
        and ``rank`` (members,) or (members, m), which is 0 where there is no state.
    first : int
        Number of the first member; it is 0 except in the results that a `callback` receives.
    stopped : bool
        True if the callback stopped the ensemble.
    wall_time, method, h
        As in `IntegrationResult`.
    chunk : int
        Number of members in a chunk.

    See Also
    --------
    eip_scipy.ensemble, IntegrationResult
    """

    COMPONENTS = 1
    status: np.ndarray
    message: np.ndarray
    failed: np.ndarray
    success: bool
    max_residual: np.ndarray
    max_correction: np.ndarray
    side_by_side: np.ndarray
    one_by_one: str
    trusted: np.ndarray
    names: tuple[str, ...]
    nfev: np.ndarray
    njev: np.ndarray
    nlu: np.ndarray
    n_rejected_projections: np.ndarray
    times: np.ndarray
    trajectories: np.ndarray | None
    invariants: np.ndarray
    target: np.ndarray
    t_events: list[list[np.ndarray]] | None
    y_events: list[list[np.ndarray]] | None
    reduced: np.ndarray | None
    first: int
    stopped: bool
    wall_time: float
    method: str
    h: float | None
    chunk: int
    outputs: dict[str, np.ndarray]
    multipliers: Multipliers

    def _observed(self) -> dict[str, Any]:
        """Return the fields that the problem computes from the states of each member, see `Problem.observed`."""
        problem, params = vars(self).get("_members", (None, None))
        if not isinstance(problem, Problem):
            return {}
        states = self.y[:, :, None] if self.trajectories is None else self.trajectories
        saved = self.trajectories is not None
        known = np.isfinite(states).all(axis=1) & (self.status[:, None] != NOT_RUN)
        times = np.broadcast_to(self.times if saved else self.t[:, None], known.shape)
        k, j = np.nonzero(known)
        found = problem.observed(times[k, j], states[k, :, j].T, None if params is None else params[k])

        def whole(values: np.ndarray, unset: Any = np.nan) -> np.ndarray:
            out = np.full((len(known), *values.shape[:-1], known.shape[1]), unset)
            out[k, ..., j] = np.moveaxis(values, -1, 0)
            return out if saved else out[..., 0]

        if "outputs" in found:
            found["outputs"] = {name: whole(values) for name, values in found["outputs"].items()}
        if "multipliers" in found:
            names, values, rank = found["multipliers"]
            found["multipliers"] = Multipliers(names, whole(values), whole(rank, 0))
        return found

    def to_xarray(self, names: Any = None) -> Any:
        """Return the members as an `xarray.Dataset`.

        Parameters
        ----------
        names : sequence of str or str, optional
            As for `eip_scipy.results.to_xarray`, which also names the errors.

        Returns
        -------
        xarray.Dataset
            Dataset with ``y`` (member, component), ``t_end``, ``status``, ``message``, ``trusted``, ``side_by_side``,
            ``max_correction`` (member), ``max_residual``, ``target`` (member, invariant), and the counts. If
            trajectories are in memory, also ``states`` (member, component, time) and ``invariants`` (member, invariant,
            time); otherwise ``end_invariants`` (member, invariant).
        """
        components = component_names(self, names, self.y.shape[1])
        coordinates = {
            "member": self.first + np.arange(self.t.size),
            "component": list(components),
            "invariant": distinct(self.names),
        }
        if self.trajectories is None:
            data = dataset(self, MEMBER_FIELDS | {"invariants": MEMBER_FIELDS["end_invariants"]}, coordinates)
        else:
            data = dataset(self, MEMBER_FIELDS, coordinates | {"time": self.times})
        if (time := time_name(components)) != "t":
            data = data.rename({"t_end": f"{time}_end", **({"time": time} if "time" in data.dims else {})})
        return data

    def plot(self, names: Any = None) -> Any:
        """Draw the ensemble: its states, the errors of the invariants, and how its members ended.

        Parameters
        ----------
        names : sequence of str or str, optional
            As for `eip_scipy.results.to_xarray`.

        Returns
        -------
        matplotlib.figure.Figure
            For each component the median of the members in time, with bands that contain 50 % and 90 % of them; if some
            end early, of those that are still running, as the legend says. If no states are saved, the distribution of
            the last states. Further panels show the largest error of each invariant in each member, and how many
            members reached the end, were ended by an event, are not to be trusted, failed or did not run. A notebook
            shows the figure automatically.
        """
        from ..plotting.results import ensemble_figure

        return ensemble_figure(self, names)

    def __repr__(self) -> str:
        ran = int(np.count_nonzero(self.status != NOT_RUN))
        members, n = self.y.shape
        lines = [
            f"Ensemble: {members} members of {n} components, {steps(self)}; {ran} ran in {self.wall_time:.3g} s, "
            f"{np.count_nonzero(self.side_by_side)} vectorised, {self.failed.size} failed"
        ]
        if self.one_by_one:
            lines.append(f"  not vectorised: {self.one_by_one}")
        width = max((len(name) for name in self.names), default=0)
        for name, residuals in zip(self.names, self.max_residual[self.status >= 0].T, strict=True):
            if residuals.size:
                largest, median = residuals.max(), np.median(residuals)
                lines.append(f"  {name:<{width}}  largest error {largest:.2e}, median {median:.2e}")
        doubtful = np.flatnonzero((self.status >= 0) & ~self.trusted)
        for those, what in ((self.failed, ".failed"), (doubtful, ".trusted")):
            lines += [f"  member {self.first + k}: {self.message[k]}" for k in those[:SHOWN]]
            if those.size > SHOWN:
                lines.append(f"  ... and {those.size - SHOWN} more: {what}, .message")
        return "\n".join(lines)
