"""Diagnostics of a run, the result of `project`, and Lagrange multipliers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..engine import data
from ..engine.trust import Trust

__all__ = ["Diagnostics", "Multipliers", "ProjectionResult", "slowness"]


def _count(place: int, text: str) -> property:
    """Return a property of `Diagnostics` that reads one of the engine's counters."""
    return property(lambda self: int(self._counters[place]), doc=text)


class Diagnostics:
    """Record of the projections in a run; pass an empty one as ``diagnostics=`` and read it during or after the run.

    Attributes
    ----------
    max_residual : ndarray, shape (l,)
        Largest invariant error ``|I - target|`` after a projection, in the unit of each invariant.
    moved : str
        How far ``project_initial=True`` moved y0; "" if it did not.

    See Also
    --------
    integrate, solve_ivp, ProjectionWarning

    Examples
    --------
    >>> from scipy.integrate import solve_ivp
    >>> from eip_scipy import EIPRK45, Diagnostics
    >>> record = Diagnostics()
    >>> options = {"rtol": 1e-8, "atol": 1e-8, "invariants": lambda t, y: y @ y, "diagnostics": record}
    >>> sol = solve_ivp(lambda t, y: [y[1], -y[0]], (0, 9), [1, 0], method=EIPRK45, **options)
    >>> record.trusted, bool(record.max_residual[0] < 1e-13)
    (True, True)
    """

    def __init__(self) -> None:
        none = np.zeros(0)
        self.max_residual, self._residual, self._max_correction = none, none, np.zeros(1)
        self._counters, self._estimated = np.zeros(data.N_COUNTERS, np.int64), False  # True with an error estimate
        self._trust = Trust((), np.zeros((0, data.N_FIGURES)))
        self.moved, self._remarks, self._from_f, self._found_rows = "", tuple[str, ...](), "", None
        self._slow = np.zeros(0, np.int64), np.zeros((data.N_SLOW, 0))  # indices of the balances, and their sums

    def _attach(self, **buffers: Any) -> None:
        """Keep the buffers of a run, from which the attributes are computed when they are read."""
        vars(self).update(buffers)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the l invariants, in order."""
        return self._trust.names

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences on what the run found by itself, and on invariants of particles that are missing.

        The number of linear invariants that were found and are kept; the invariants whose gradients need no evaluation
        of their own, because f has their components; and whether the run has found that they do not hold any longer.
        """
        found = list(self._remarks)
        if self._found_rows is not None and not self._found_rows.any():
            found.append("a linear invariant that was found at the start does not hold later: none is kept since then")
        if self._from_f:
            until = "" if self._counters[data.FROM_F] else ", until a projection missed; it is computed since then"
            found.append(f"the gradient of {self._from_f} is made of the components of f{until}")
        return tuple(found)

    def spread(self, names: Sequence[str], places: Sequence[int]) -> Diagnostics:
        """Return the record of a run of more invariants, with these `names`; its own are those at `places`."""

        def whole(values: np.ndarray) -> np.ndarray:
            out = np.zeros((len(names), *values.shape[1:]))
            out[places] = values
            return out

        more, (of_balances, sums) = Diagnostics(), self._slow
        trust = Trust(names, whole(self._trust.figures))
        trust.doubts, trust.failed = self._trust.doubts, self._trust.failed
        slow = np.asarray(places, np.int64)[of_balances], sums
        own = {"max_residual": whole(self.max_residual), "_residual": whole(self._residual)}
        more._attach(**vars(self) | own | {"_trust": trust, "_slow": slow})
        return more

    def followed_by(self, other: Diagnostics) -> Diagnostics:
        """Return the record of this run and of the run with the record `other`, which continued it, together."""
        both = Diagnostics()
        both._attach(
            max_residual=np.fmax(self.max_residual, other.max_residual),
            _residual=other._residual.copy(),
            _max_correction=np.maximum(self._max_correction, other._max_correction),
            _counters=self._counters + other._counters,
            _trust=self._trust.followed_by(other._trust),
            _estimated=self._estimated and other._estimated,
            moved=self.moved or other.moved,
            _remarks=tuple(dict.fromkeys(self.remarks + other.remarks)),
            _slow=_joined_sums(self._slow, other._slow),
        )
        return both

    @property
    def last_residual(self) -> np.ndarray:
        """Last invariant errors ``|I - target|`` after a projection, (l,)."""
        return np.abs(self._residual)

    n_projections = _count(data.PROJECTIONS, "Number of projections.")
    n_skipped = _count(data.SKIPPED, "Number of projections omitted because all invariant errors were round-off.")
    n_rank_reduced = _count(
        data.RANK_REDUCED,
        "Number of projections whose rank was reduced, because gradients were (nearly) dependent or zero.",
    )
    n_rejected_projections = _count(data.REJECTED, "Number of projections that failed.")

    @property
    def max_correction(self) -> float:
        """Largest correction in units of the local error of the step: at most about 5 in a correct run.

        It is nan without an error estimate (the euclidean metric with fixed steps). If round-off exceeds the local
        errors, as in compensated runs, it may be thousands and is meaningless; `worst` takes round-off into account.
        """
        return float(self._max_correction[0]) if self._estimated else float("nan")

    @property
    def trusted(self) -> bool:
        """True if no step failed, no check found an error, and the errors of the steps explain all corrections.

        It says nothing about the accuracy of the trajectory.
        """
        return self._trust.trusted

    @property
    def message(self) -> str:
        """Reason why the run is not to be trusted; "" if there is none."""
        return self._trust.message

    @property
    def worst(self) -> tuple[str, float, float] | None:
        """Invariant, time and size of the largest correction, in units of the local error including round-off.

        The size is below 5 in most correct runs. None if no correction was measured.
        """
        figures = self._trust.figures
        if not np.any(figures[:, data.JUDGED] > 0):
            return None
        k = int(np.argmax(figures[:, data.NU]))
        return self.names[k], float(figures[k, data.AT]), float(figures[k, data.NU])

    @property
    def corrections(self) -> np.ndarray:
        """Largest correction of each invariant, (l,), in the unit of `worst`; nan if none was measured."""
        figures = self._trust.figures
        return np.where(figures[:, data.JUDGED] > 0, figures[:, data.NU], np.nan)

    @property
    def slowness(self) -> np.ndarray:
        """Rate of change of each `Balance`, (l,): its mean rate divided by the mean of the terms of ``grad @ f``.

        Both are taken at some of the projections; it is the larger of the ratios for the whole run and for about the
        last eighth of it. The error of a balance is about this fraction of the error of an invariant; above 0.05 a
        balance hardly helps. nan for invariants, and with ``check=False``.
        """
        places, sums = self._slow
        found = np.full(len(self.names), np.nan)
        found[places] = slowness(sums)
        return found

    def __repr__(self) -> str:
        if not self.names:
            return "Diagnostics: no invariants"
        lines = [
            f"Diagnostics: {self.n_projections} projections ({self.n_rank_reduced} of reduced rank), "
            f"{self.n_skipped} skipped (round-off), {self.n_rejected_projections} rejected"
        ]
        width = max(len(name) for name in self.names)
        for name, largest, last in zip(self.names, self.max_residual, self.last_residual, strict=True):
            lines.append(f"  {name:<{width}}  max residual {largest:.2e}, last {last:.2e}")
        if self.worst is not None:
            name, t, size = self.worst
            lines.append(f"  largest correction: {size:.3g} local errors, of {name} at t={t:.6g}")
        return "\n".join(lines + [f"  {remark}" for remark in (self.moved, *self.remarks, self.message) if remark])


def slowness(sums: np.ndarray) -> np.ndarray:
    """Return `Diagnostics.slowness` (b,) of the balances, from the sums (`N_SLOW`, b) of rates and terms.

    A mean over the whole run does not detect a balance that is slow only while its terms are large, such as the energy
    of an oscillator that is damped until its driving dominates. Therefore the larger of two ratios of rates to terms is
    returned: the ratio of the sums over the whole run, and that of the sums over its last part.
    """
    rates, terms = sums[[data.ALL_RATES, data.LATE_RATES]], sums[[data.ALL_TERMS, data.LATE_TERMS]]
    known = terms > 0
    return np.max(np.where(known, rates, np.nan) / np.where(known, terms, 1.0), axis=0)


def _joined_sums(one: tuple[Any, Any], two: tuple[Any, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Return places and sums of rates and terms (`N_SLOW`, b), see `slowness`, of a run and its continuation."""
    places = np.union1d(one[0], two[0]) if one[0].size or two[0].size else two[0]
    first, second = (np.zeros((data.N_SLOW, places.size)) for _ in range(2))
    first[:, np.searchsorted(places, one[0])], second[:, np.searchsorted(places, two[0])] = one[1], two[1]
    both = first + second
    late = [data.LATE_RATES, data.LATE_TERMS]
    kept = (first[data.SAMPLES] / np.maximum(both[data.SAMPLES], 1.0)) ** (1 / data.LATE_SHARE)
    both[late] = kept * first[late] + second[late]
    return places, both


class Multipliers(NamedTuple):
    """Lagrange multipliers of m constraints on velocities, at one state or at k states.

    Attributes
    ----------
    names : tuple of str
        Names of the constraints.
    values : ndarray, shape (m,) or (m, k)
        lambda of M u' + G^T lambda = F: the constraints exert the generalised forces -G^T lambda. The unit of lambda is
        that of power, divided by that of the constraint on velocities.
    rank : int or ndarray of int, shape (k,)
        Rank of the constraints. Where it is below m, forces are distributed over dependent constraints such that the
        sum of the squares of ``lambda_i |G_i|`` is least.

    See Also
    --------
    eip_scipy.problems.mechanism
    """

    names: tuple[str, ...]
    values: np.ndarray
    rank: Any

    @property
    def unique(self) -> Any:
        """True if the multipliers at a state are the only solution; for k states a mask (k,)."""
        return self.rank == len(self.names)


class ProjectionResult(NamedTuple):
    """Result of `project`.

    Attributes
    ----------
    y : ndarray, shape (n,)
        The projected state.
    residual : ndarray, shape (l,)
        I(y) - target.
    rank : int
        Rank of the gradients: l if all invariants are independent; 0 if no correction was necessary.
    correction : ndarray, shape (n,)
        y - y_hat.

    See Also
    --------
    eip_scipy.project
    """

    y: Any
    residual: np.ndarray
    rank: int
    correction: Any
