"""The step or the tolerance at which a method has a wanted error, by a few trials."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from ..core.solvers import EIPSolver
from .trials import Trial

__all__ = ["AIM", "COARSEST_RTOL", "FINEST_RTOL", "WINDOW", "Kind", "best", "tune"]

# Of the wanted error: what is aimed at, and from where on a run is accurate enough and not too accurate.
AIM, WINDOW = 0.4, 0.15
MOST_TRIALS, MOST_FAILURES = 8, 4
ATOL_PER_RTOL = 1e-3
COARSEST_RTOL, FINEST_RTOL = 0.01, 1e-13
# A kind is given up where it would cost so many times what another one does.
TOO_DEAR = 1.5
# By so much the step or the tolerance changes at most at once, in decades; by so little it is no longer changed.
FARTHEST = {True: 0.5, False: 2.0}
NEAREST = 0.01
# Not nearer than this to a number with which a run fails.
AWAY = 0.1


@dataclass(frozen=True)
class Kind:
    """One way to run a problem: a method with options, tuned by one number, its step `h` or its tolerance `rtol`.

    `size` is that of the state, for `atol`; `coarsest` bounds the number.
    """

    method: type[EIPSolver]
    fixed: bool = False
    size: float = 1.0
    coarsest: float = COARSEST_RTOL
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Of the method, and that its steps are equal."""
        return f"{self.method.__name__}{' with equal steps' if self.fixed else ''}"

    @property
    def knob(self) -> str:
        """Name of the number."""
        return "h" if self.fixed else "rtol"

    @property
    def order(self) -> int:
        """Of the method."""
        return int(self.method.TABLEAU.order)

    @property
    def slope(self) -> float:
        """How the error depends on the number: as this power of it."""
        return self.order if self.fixed else self.order / ((self.method.TABLEAU.error_estimator_order or 0) + 1)

    def settings(self, value: float) -> dict[str, Any]:
        """Options of `integrate` for the value of the number."""
        if self.fixed:
            return {"method": self.method, "h": value, **self.options}
        return {
            "method": self.method,
            "rtol": value,
            "atol": _short(ATOL_PER_RTOL * value * self.size, 2),
            **self.options,
        }

    def near(self, value: float) -> float:
        """The value in few digits, inside its bounds."""
        value = min(value, self.coarsest)
        return _short(value, 3) if self.fixed else _short(max(value, FINEST_RTOL), 2)

    def dearness(self, trial: Trial, wanted: float) -> float:
        """What it would cost at the wanted error, going by one trial."""
        return trial.nfev * (trial.error / wanted) ** (1 / self.order)


def tune(
    kind: Kind, value: float, wanted: float, run: Callable[[Mapping[str, Any]], Trial], bound: float
) -> list[Trial]:
    """Trials of a kind, from a first value of its number on, until one has the wanted error.

    Ends early where nothing helps, and where the kind would cost much more than `bound` evaluations.
    """
    tried: dict[float, Trial] = {}
    fine: tuple[float, float] | None = None  # logarithms of number and error: accurate enough
    coarse: tuple[float, float] | None = None  # not; its error is nan where the run failed
    x = math.log10(value)
    while len(tried) < MOST_TRIALS:
        value = kind.near(10**x)
        if value in tried:
            break
        x, trial = math.log10(value), run(kind.settings(value))
        tried[value] = trial
        if trial.good and WINDOW * wanted <= trial.error <= wanted:
            break
        if trial.good and kind.dearness(trial, wanted) > TOO_DEAR * bound:
            break
        if not any(other.good for other in tried.values()) and len(tried) == MOST_FAILURES:
            break
        if trial.good and trial.error <= wanted:
            fine = x, math.log10(max(trial.error, 1e-17))
        else:
            coarse = x, math.log10(trial.error) if trial.good else math.nan
        if fine and coarse and coarse[0] - fine[0] < (AWAY if math.isnan(coarse[1]) else NEAREST):
            break
        x = _next(kind, fine, coarse, math.log10(AIM * wanted))
    return list(tried.values())


def _next(kind: Kind, fine: tuple[float, float] | None, coarse: tuple[float, float] | None, aim: float) -> float:
    """Where the error would be the one aimed at, going by a value on either side or on one."""
    farthest = FARTHEST[kind.fixed]
    if fine and coarse:
        width = coarse[0] - fine[0]
        if math.isnan(coarse[1]):
            return fine[0] + min(0.5 * width, (aim - fine[1]) / kind.slope)
        part = (aim - fine[1]) / (coarse[1] - fine[1])
        return fine[0] + width * min(max(part, 0.1), 0.9)
    if fine:
        return fine[0] + min((aim - fine[1]) / kind.slope, farthest)
    assert coarse is not None
    if math.isnan(coarse[1]):
        return coarse[0] - 0.6 * farthest
    return coarse[0] - min((coarse[1] - aim) / kind.slope, farthest)


def best(trials: list[Trial], wanted: float) -> Trial | None:
    """The cheapest good trial that is accurate enough; None without one."""
    enough = [trial for trial in trials if trial.good and trial.error <= wanted]
    return min(enough, key=lambda trial: trial.nfev, default=None)


def _short(value: float, digits: int) -> float:
    return float(f"{value:.{digits}g}")
