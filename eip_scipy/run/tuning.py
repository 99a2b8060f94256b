"""Search for the step or the tolerance with which a method has the wanted error, by a few trials."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from ..core.solvers import EIPSolver
from .trials import Trial

__all__ = ["AIM", "COARSEST_RTOL", "FINEST_RTOL", "WINDOW", "Kind", "best", "tune"]

# Fractions of the wanted error: the target of the search, and the error below which a trial is needlessly accurate.
AIM, WINDOW = 0.4, 0.15
MOST_TRIALS, MOST_FAILURES = 8, 4
ATOL_PER_RTOL = 1e-3
COARSEST_RTOL, FINEST_RTOL = 0.01, 1e-13
# A kind is abandoned if it would cost more than this factor times the cost of another one.
TOO_DEAR = 1.5
# Largest and smallest change of the step (True) or the tolerance (False) from one trial to the next, in decades.
FARTHEST = {True: 0.5, False: 2.0}
NEAREST = 0.01
# Smallest distance, in decades, from a value with which a run fails.
AWAY = 0.1


@dataclass(frozen=True)
class Kind:
    """A method with options, tuned by one number: its step `h` if `fixed` is True, otherwise its tolerance `rtol`.

    `atol` is proportional to `rtol` and to `size`, the magnitude of the state. `coarsest` is the largest step or
    tolerance that is tried, and `options` are further options of `integrate`.
    """

    method: type[EIPSolver]
    fixed: bool = False
    size: float = 1.0
    coarsest: float = COARSEST_RTOL
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of the method, with the remark that its steps are equal if they are."""
        return f"{self.method.__name__}{' with equal steps' if self.fixed else ''}"

    @property
    def knob(self) -> str:
        """Name of the number that is tuned."""
        return "h" if self.fixed else "rtol"

    @property
    def order(self) -> int:
        """Order of the method."""
        return int(self.method.TABLEAU.order)

    @property
    def slope(self) -> float:
        """Power of the tuned number with which the error grows."""
        return self.order if self.fixed else self.order / ((self.method.TABLEAU.error_estimator_order or 0) + 1)

    def settings(self, value: float) -> dict[str, Any]:
        """Return the options of `integrate` for a value of the step or tolerance."""
        atol = _short(ATOL_PER_RTOL * value * self.size, 2)
        return {
            "method": self.method,
            **({"h": value} if self.fixed else {"rtol": value, "atol": atol}),
            **self.options,
        }

    def near(self, value: float) -> float:
        """Return `value`, rounded to three digits if it is a step, or to two if it is a tolerance.

        The value is first limited to at most `coarsest`, and a tolerance also to at least `FINEST_RTOL`.
        """
        value = min(value, self.coarsest)
        return _short(value, 3) if self.fixed else _short(max(value, FINEST_RTOL), 2)


def tune(
    kind: Kind, value: float, wanted: float, run: Callable[[Mapping[str, Any]], Trial], bound: float
) -> list[Trial]:
    """Run trials of a kind, the first with the step or tolerance `value`, and return them in order.

    ``run(options)`` makes a trial with options of `integrate`. The search ends if the error of a trial is between
    ``WINDOW * wanted`` and `wanted`, or after `MOST_TRIALS` trials. It ends early if the first trials fail, if no other
    value is left to try, or if the kind would need many more evaluations of the right-hand side than `bound`.
    """
    tried: dict[float, Trial] = {}
    fine: tuple[float, float] | None = None  # logarithms of number and error of an accurate enough trial
    coarse: tuple[float, float] | None = None  # the same of a trial that is not; its error is nan if the run failed
    x = math.log10(value)
    while len(tried) < MOST_TRIALS:
        value = kind.near(10**x)
        if value in tried:
            break
        x, trial = math.log10(value), run(kind.settings(value))
        tried[value] = trial
        # An estimate of the evaluations for the error `wanted`.
        cost = trial.nfev * (trial.error / wanted) ** (1 / kind.order)
        if trial.good and (WINDOW * wanted <= trial.error <= wanted or cost > TOO_DEAR * bound):
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
    """Return the logarithm of the step or tolerance at which the logarithm of the error is expected to be `aim`.

    `fine` and `coarse` are pairs, logarithms of step or tolerance and of the error, of a trial that is accurate
    enough and of one that is not (its error is nan if the run failed); one of them may be None.
    """
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
    """Return the good trial (see `Trial`) of least cost whose error is at most `wanted`, or None."""
    enough = [trial for trial in trials if trial.good and trial.error <= wanted]
    return min(enough, key=lambda trial: trial.cost, default=None)


def _short(value: float, digits: int) -> float:
    return float(f"{value:.{digits}g}")
