"""Detection of runs whose projection hides a failure, from their corrections.

The errors of the steps explain the corrections of a correct run. If corrections are much larger, the quantity is not an
invariant of the system, its gradient is wrong, or the step is much too long; the projected run looks perfect
nevertheless. The step records numbers about its projections, called figures, in a row for each invariant (`note` in
cpp/trust.hpp); this module interprets them.
"""

from __future__ import annotations

from collections.abc import Sequence
from operator import itemgetter

import numpy as np

from . import data

__all__ = ["ProjectionWarning", "Trust"]

# At loose tolerances steps may miss more: DISTANT is FAR_IN_TOLERANCES relative tolerances then, up to MOST_FAR.
FAR_IN_TOLERANCES, MOST_FAR = 7.5, 0.075
# Bounds that no correct run exceeds (measured in docs/explanation/trust.md): the size of one correction in local errors
# (it can be thousands, because estimates of pairs of methods vanish by chance), the fraction of projections with LARGE
# corrections, the sum of corrections relative to the errors, the size of one invariant error relative to DISTANT, and
# the fraction of projections with DISTANT errors.
BEYOND_DOUBT, OFTEN, TOGETHER = 1e4, 0.1, 20.0
TOO_FAR, FAR_OFTEN = 5 / 3, 0.01
# Rates of change along the flow are rounding errors up to this fraction of their terms.
ROUNDING_OF_RATES, ROUNDING_OF_DIFFERENCES = 1e-11, 1e-7
# Smallest number of projections for which fractions and sums are judged, if more than one correction is LARGE.
ENOUGH = 5
# Figures of corrections, and counts and shares that are 0 unless a step was suspicious.
JUDGED_FIRST = itemgetter(data.NU, data.SUM, data.EXPECTED, data.SHARE, data.RAW, data.RAW_MANY, data.MANY)
MOST_REASONS = 3  # largest number of reasons in a message
PAGE = '"When a run is not trusted" (docs/explanation/trust.md)'


class ProjectionWarning(RuntimeWarning):
    """Warning that a projection hides a failure, usually because errors of the steps do not explain its corrections.

    `solve_ivp` with an EIP method and `integrate` issue it for a run, and `ensemble` once for all members; ``trusted``
    of the result or its diagnostics is then False, and ``message`` gives the reason. `project` issues it if a large
    error remains, and `recommend` if it recommends a run without invariants. The page "When a run is not trusted"
    explains what to do.

    See Also
    --------
    Diagnostics, check_gradient

    Examples
    --------
    >>> import warnings
    >>> from eip_scipy import ProjectionWarning
    >>> warnings.simplefilter("error", ProjectionWarning)  # a faulty run is then an error
    >>> warnings.simplefilter("default", ProjectionWarning)
    """


class Trust:
    """The figures (l, N_FIGURES) recorded in the projections of a run, and the findings of the checks of the run."""

    def __init__(self, names: Sequence[str], figures: np.ndarray) -> None:
        self.names, self.figures = tuple(names), figures
        self.doubts: list[str] = []  # findings of the checks of the invariants, as sentences
        self.failed = False  # True if a step failed

    @property
    def trusted(self) -> bool:
        """True if no step failed, no check found anything and the errors of the steps explain all corrections."""
        return not (self.failed or self.doubts or self.exceeds_bounds)

    @property
    def exceeds_bounds(self) -> bool:
        """Return True if the corrections or errors of an invariant do not occur in correct runs."""
        return not all(map(_is_ordinary, self.figures.tolist())) and bool(exceed_bounds(self.figures).any())

    def is_doubtful(self, ended: bool = False) -> bool:
        """Return True if the figures show that the run is faulty, before its end without hope of recovery."""
        return self.exceeds_bounds and (ended or bool(_extreme(self.figures).any()))

    def followed_by(self, other: Trust) -> Trust:
        """Return the combined record of this run and of the run `other` that continued it."""
        one, two = self.figures, other.figures
        both = two.copy()  # START, LEFT and others: of the last
        largest = [
            data.TERMS, data.RATE, data.RATE_TERMS, data.RATE_NOTED, data.ROUGH_NOTED, data.FAR_FROM, data.BY_VALUES,
            data.EXAMINED,
        ]  # fmt: skip
        both[:, largest] = np.maximum(one[:, largest], two[:, largest])
        counts = [data.NOTED, data.RAW_MANY, data.MANY, data.SUM, data.EXPECTED, data.JUDGED]
        both[:, counts] = one[:, counts] + two[:, counts]
        for size, at in ((data.SHARE, data.SHARE_AT), (data.RAW, data.RAW_AT), (data.NU, data.AT)):
            larger = one[:, size] > two[:, size]
            both[larger, size], both[larger, at] = one[larger, size], one[larger, at]
        both[:, data.FIRST] = np.where(one[:, data.MANY] > 0, one[:, data.FIRST], two[:, data.FIRST])
        trust = Trust(self.names, both)
        trust.doubts = list(dict.fromkeys(self.doubts + other.doubts))
        trust.failed = other.failed
        return trust

    @property
    def reasons(self) -> list[str]:
        """Return sentences on corrections and errors that make the run unreliable; an empty list if there are none.

        There is one for each of the worst three invariants, and one that counts the other invariants.
        """
        if not self.exceeds_bounds:
            return []
        found = np.flatnonzero(exceed_bounds(self.figures))
        rows = self.figures[found]
        shares = (rows[:, data.NU] / BEYOND_DOUBT, rows[:, data.RAW] / TOO_FAR, rows[:, data.SHARE] / data.LARGE_SHARE)
        worst = found[np.argsort(-np.max(shares, axis=0), kind="stable")]
        reasons = [_reason(self.names[k], self.figures[k]) for k in worst[:MOST_REASONS]]
        if found.size > MOST_REASONS:
            reasons.append(f"{found.size - MOST_REASONS} more invariants exceed the bounds of correct runs")
        return reasons

    @property
    def message(self) -> str:
        """Reasons why the run is not to be trusted, and possible causes; "" if there are none."""
        reasons = self.reasons + self.doubts
        if not reasons:
            return ""
        cause = "" if self.doubts else (
            " Possible causes: the quantity is not an invariant of this system, its gradient is wrong, or the step is "
            "too long for the motion, for example for a close encounter."
        )  # fmt: skip
        return f"not to be trusted: {'; '.join(reasons)}.{cause} See {PAGE}"


def exceed_bounds(figures: np.ndarray) -> np.ndarray:
    """Return a mask of the rows of figures (..., N_FIGURES) that do not occur in correct runs."""
    far = figures[..., data.RAW_MANY] > FAR_OFTEN * figures[..., data.NOTED]
    return _extreme(figures) | (_may_leak(figures) & _large_corrections(figures)) | far


def _is_ordinary(row: list[float]) -> bool:
    """Return True if a row of figures is within the bounds at a glance, as in most runs."""
    nu, total, expected, *suspicious = JUDGED_FIRST(row)
    return nu <= BEYOND_DOUBT and total <= TOGETHER * expected and not any(suspicious)


def suspects(figures: np.ndarray, suspect: np.ndarray) -> np.ndarray:
    """Return a mask of the runs with a step that must be examined, from the figures (m, l, N_FIGURES) of m runs.

    `suspect`, (m, ...), holds for each run the suspicious step that the engine has kept, and the reason for it.
    """
    reason = suspect[:, data.REASON]
    return (reason >= data.LARGE_ERROR) | ((reason == data.LARGE_CORRECTION) & _large_corrections(figures).any(axis=1))


def _large_corrections(figures: np.ndarray) -> np.ndarray:
    """Return a mask of the rows with corrections that are much larger than the errors of the steps."""
    judged = figures[..., data.JUDGED]
    often = figures[..., data.MANY] > np.maximum(1, OFTEN * judged)
    together = figures[..., data.SUM] > TOGETHER * figures[..., data.EXPECTED]
    return (figures[..., data.NU] > BEYOND_DOUBT) | ((judged >= ENOUGH) & (often | together))


def _extreme(figures: np.ndarray) -> np.ndarray:
    """Return a mask of the rows with a single correction or error that is larger than in any correct run."""
    large = _may_leak(figures) & (figures[..., data.NU] > BEYOND_DOUBT)
    return large | (figures[..., data.RAW] > TOO_FAR * figures[..., data.FAR_FROM]) | (figures[..., data.SHARE] > 0)


def _may_leak(figures: np.ndarray) -> np.ndarray:
    """Return a mask of the rows of figures whose quantities may change along the flow, and may not be invariants.

    If the rate of change is only rounding, large corrections come from error estimates that are too small, as in a step
    over a kink, or if the derivative depends on time only.
    """
    by_values, by_gradient = figures[..., data.EXAMINED], figures[..., data.RATE]
    has_values = figures[..., data.BY_VALUES] > 0
    return np.where(has_values, by_values > ROUNDING_OF_DIFFERENCES, by_gradient > ROUNDING_OF_RATES)


def _reason(name: str, row: np.ndarray) -> str:
    """Return a sentence about the corrections of one invariant in a faulty run."""
    nu, expected, raw, share = (row[k] for k in (data.NU, data.EXPECTED, data.RAW, data.SHARE))
    leaks, parts = _may_leak(row), []
    if leaks and nu > data.LARGE:
        parts.append(
            f"{name!r} was corrected by up to {nu:.2g} local errors, at t={row[data.AT]:.6g} (by more than "
            f"{data.LARGE:g} in {row[data.MANY]:.0f} of {row[data.JUDGED]:.0f} projections, first at "
            f"t={row[data.FIRST]:.6g})"
        )
    elif leaks and row[data.SUM] > TOGETHER * expected:
        parts.append(f"{name!r} was corrected by {row[data.SUM] / expected:.2g} local errors per projection on average")
    if raw > 0:
        parts.append(
            f"before projections the error of {name!r} was up to {raw:.2g} times the size of its terms, at "
            f"t={row[data.RAW_AT]:.6g} (more than {row[data.FAR_FROM]:g} times this size in {row[data.RAW_MANY]:.0f} "
            f"of {row[data.NOTED]:.0f} projections)"
        )
    if share > 0:
        at = row[data.SHARE_AT]
        parts.append(
            f"the projection left an error of {name!r} of {share:.2g} times the size of its terms, at t={at:.6g}"
        )
    return ", and ".join(parts)
