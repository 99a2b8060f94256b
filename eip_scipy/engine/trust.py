"""Detection of runs whose projection hides a failure, from their corrections.

The errors of the steps explain the corrections of a correct run. If corrections are much larger, the quantity is not an
invariant of the system, its gradient is wrong, or the step is much too long; the projected run looks perfect
nevertheless. The step records numbers about its projections, called figures, in a row for each invariant (`note` in
cpp/trust.hpp); this module interprets them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .data import (
    AT,
    BY_VALUES,
    EXAMINED,
    EXPECTED,
    FAR_FROM,
    FIRST,
    JUDGED,
    LARGE,
    LARGE_CORRECTION,
    LARGE_ERROR,
    LARGE_SHARE,
    MANY,
    NOTED,
    NU,
    RATE,
    RATE_NOTED,
    RATE_TERMS,
    RAW,
    RAW_AT,
    RAW_MANY,
    REASON,
    ROUGH_NOTED,
    SHARE,
    SHARE_AT,
    SUM,
    TERMS,
)

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
MOST_REASONS = 3  # largest number of reasons in a message
PAGE = '"When a run is not trusted" (docs/explanation/trust.md)'


class ProjectionWarning(RuntimeWarning):
    """Warning that a projection hides a failure, usually because errors of the steps do not explain its corrections.

    `solve_ivp` with an EIP method and `integrate` issue it for a run, and `ensemble` once for all members; ``trusted``
    of the result or its diagnostics is then False, and ``message`` gives the reason. `project` issues it if a large
    error remains, and `recommend` if it recommends a run without invariants. The page "When a run is not trusted"
    explains what to do.
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
        return not (self.failed or self.doubts or self.is_sick)

    @property
    def is_sick(self) -> bool:
        """Return True if the corrections or errors of an invariant do not occur in correct runs."""
        return not are_calm(self.figures) and bool(sick(self.figures).any())

    @property
    def beyond_doubt(self) -> bool:
        """Return True if later projections cannot make the run reliable again."""
        return not are_calm(self.figures) and bool(_extreme(self.figures).any())

    @property
    def worst(self) -> tuple[str, float, float] | None:
        """Return invariant, time and size in local errors of the largest correction; None if none was measured."""
        if not np.any(self.figures[:, JUDGED] > 0):
            return None
        k = int(np.argmax(self.figures[:, NU]))
        return self.names[k], float(self.figures[k, AT]), float(self.figures[k, NU])

    @property
    def corrections(self) -> np.ndarray:
        """Size in local errors of each invariant's largest correction, (l,); nan where none was measured."""
        return np.where(self.figures[:, JUDGED] > 0, self.figures[:, NU], np.nan)

    def followed_by(self, other: Trust) -> Trust:
        """Return the combined record of this run and of the run `other` that continued it."""
        one, two = self.figures, other.figures
        both = two.copy()  # START, TERMS, LEFT: of the last
        largest = [TERMS, RATE, RATE_TERMS, RATE_NOTED, ROUGH_NOTED, FAR_FROM, BY_VALUES, EXAMINED]
        both[:, largest] = np.maximum(one[:, largest], two[:, largest])
        counts = [NOTED, RAW_MANY, MANY, SUM, EXPECTED, JUDGED]
        both[:, counts] = one[:, counts] + two[:, counts]
        for size, at in ((SHARE, SHARE_AT), (RAW, RAW_AT), (NU, AT)):
            larger = one[:, size] > two[:, size]
            both[larger, size], both[larger, at] = one[larger, size], one[larger, at]
        both[:, FIRST] = np.where(one[:, MANY] > 0, one[:, FIRST], two[:, FIRST])
        trust = Trust(self.names, both)
        trust.doubts = list(dict.fromkeys(self.doubts + other.doubts))
        trust.failed = self.failed or other.failed
        return trust

    @property
    def reasons(self) -> list[str]:
        """Return sentences on corrections and errors that make the run unreliable; an empty list if there are none.

        There is one for each of the worst three invariants, and one that counts the other invariants.
        """
        if not self.is_sick:
            return []
        found = np.flatnonzero(sick(self.figures))
        worst = found[np.argsort(-_severity(self.figures[found]), kind="stable")]
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


def sick(figures: np.ndarray) -> np.ndarray:
    """Return a mask of the rows of figures (..., N_FIGURES) that do not occur in correct runs."""
    if are_calm(figures):
        return np.zeros(figures.shape[:-1], bool)
    far = figures[..., RAW_MANY] > FAR_OFTEN * figures[..., NOTED]
    return _extreme(figures) | (_may_leak(figures) & _large_corrections(figures)) | far


# Counts and shares that are 0 unless a step was suspicious.
NOTED_STEPS = [SHARE, RAW, RAW_MANY, MANY]


def are_calm(figures: np.ndarray) -> bool:
    """Return True if no row of figures (..., N_FIGURES) can be that of a faulty run.

    This quick test usually suffices; if it is False, `sick` decides.
    """
    large = (figures[..., NU] > BEYOND_DOUBT) | (figures[..., SUM] > TOGETHER * figures[..., EXPECTED])
    return not (figures[..., NOTED_STEPS].any() or large.any())


def suspects(figures: np.ndarray, suspect: np.ndarray) -> np.ndarray:
    """Return a mask of the runs with a step that must be examined, from the figures (m, l, N_FIGURES) of m runs.

    `suspect`, (m, ...), holds for each run the suspicious step that the engine has kept, and the reason for it.
    """
    reason = suspect[:, REASON]
    return (reason >= LARGE_ERROR) | ((reason == LARGE_CORRECTION) & _large_corrections(figures).any(axis=1))


def _large_corrections(figures: np.ndarray) -> np.ndarray:
    """Return a mask of the rows with corrections that are much larger than the errors of the steps."""
    judged = figures[..., JUDGED]
    often = figures[..., MANY] > np.maximum(1, OFTEN * judged)
    together = figures[..., SUM] > TOGETHER * figures[..., EXPECTED]
    return (figures[..., NU] > BEYOND_DOUBT) | ((judged >= ENOUGH) & (often | together))


def _extreme(figures: np.ndarray) -> np.ndarray:
    """Return a mask of the rows with a single correction or error that is larger than in any correct run."""
    large = _may_leak(figures) & (figures[..., NU] > BEYOND_DOUBT)
    return large | (figures[..., RAW] > TOO_FAR * figures[..., FAR_FROM]) | (figures[..., SHARE] > 0)


def _may_leak(figures: np.ndarray) -> np.ndarray:
    """Return a mask of the rows of figures whose quantities may change along the flow, and may not be invariants.

    If the rate of change is only rounding, large corrections come from error estimates that are too small, as in a step
    over a kink, or if the derivative depends on time only.
    """
    by_values, by_gradient = figures[..., EXAMINED] > ROUNDING_OF_DIFFERENCES, figures[..., RATE] > ROUNDING_OF_RATES
    return np.where(figures[..., BY_VALUES] > 0, by_values, by_gradient)


def _severity(figures: np.ndarray) -> np.ndarray:
    """Return the factors by which rows of figures (..., N_FIGURES) exceed the limits of correct runs."""
    corrections = np.maximum(figures[..., NU] / BEYOND_DOUBT, figures[..., RAW] / TOO_FAR)
    return np.maximum(corrections, figures[..., SHARE] / LARGE_SHARE)


def _reason(name: str, row: np.ndarray) -> str:
    """Return a sentence about the corrections of one invariant in a faulty run."""
    parts = []
    if _may_leak(row) and row[NU] > LARGE:
        parts.append(
            f"{name!r} was corrected by up to {row[NU]:.2g} local errors, at t={row[AT]:.6g} (by more than {LARGE:g} "
            f"in {row[MANY]:.0f} of {row[JUDGED]:.0f} projections, first at t={row[FIRST]:.6g})"
        )
    elif _may_leak(row) and row[SUM] > TOGETHER * row[EXPECTED]:
        parts.append(f"{name!r} was corrected by {row[SUM] / row[EXPECTED]:.2g} local errors per projection on average")
    if row[RAW] > 0:
        parts.append(
            f"before projections the error of {name!r} was up to {row[RAW]:.2g} times the size of its terms, at "
            f"t={row[RAW_AT]:.6g} (more than {row[FAR_FROM]:g} times this size in {row[RAW_MANY]:.0f} of "
            f"{row[NOTED]:.0f} projections)"
        )
    if row[SHARE] > 0:
        parts.append(
            f"the projection left an error of {name!r} of {row[SHARE]:.2g} times the size of its terms, at "
            f"t={row[SHARE_AT]:.6g}"
        )
    return ", and ".join(parts)
