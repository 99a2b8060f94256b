"""Trial runs: the error of each against a run that is much more accurate, and what it costs."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from ..core.problem import Problem
from ..core.stepping import UNBOUNDED
from .integrate import integrate
from .results import IntegrationResult

__all__ = ["Bench", "Outcome", "Trial", "difference"]

# Errors that grow as a higher power of time than this do so exponentially, as far as a trial can tell.
WILD_POWER = 4.0
LEAST_POWER, LARGEST_POWER = 1.0, 2.0
# So many times does an adaptive trial look whether it has gone on for too long.
ROWS = 16


@dataclass(frozen=True)
class Trial:
    """What one trial run says of the whole interval.

    Attributes
    ----------
    options : dict
        Those of the run, as `integrate` takes them, besides what all trials have in common.
    error : float
        Of the state at the end of the interval: largest component of the difference, relative to the largest
        component. Extrapolated where the trial is shorter than the interval; nan for a run that failed.
    nfev : int
        Evaluations of the right-hand side for the whole interval.
    seconds : float
        Of the trial itself.
    trouble : str
        Why the run failed, or is not to be trusted; empty for a good one.
    power : float
        The error was taken to grow as this power of time from the trial's end on; nan where it covers the interval.
    """

    options: Mapping[str, Any]
    error: float
    nfev: int
    seconds: float
    trouble: str = ""
    power: float = math.nan

    @property
    def good(self) -> bool:
        """Whether nothing speaks against the run."""
        return not self.trouble and math.isfinite(self.error)


class Outcome(NamedTuple):
    """States at the times of the bench, (n, k), and what the run cost and said."""

    y: np.ndarray
    nfev: int
    seconds: float
    trouble: str


class Bench:
    """Where trials are run: a problem, options that all have in common, times to compare at.

    `truth` holds the states there, whose own error is about `doubt`; `most` bounds the evaluations of a trial, about.
    """

    def __init__(self, problem: Problem, common: Mapping[str, Any]) -> None:
        self.problem, self.common = problem, common
        self.t0, self.t_end = problem.t_span
        self.times: Sequence[float] = [self.t_end]
        self.truth, self.doubt, self.most = np.zeros(0), 0.0, UNBOUNDED

    def shorten(self, t: float, looks: int) -> None:
        """Let trials end at t, with states at so many times on the way there."""
        self.times = [self.t0 + (t - self.t0) * k / looks for k in range(1, looks + 1)]

    @property
    def share(self) -> float:
        """The part of the interval that a trial covers."""
        return (self.times[-1] - self.t0) / (self.t_end - self.t0)

    def run(self, options: Mapping[str, Any]) -> Outcome:
        """Run once; exceptions of the start and of the user's functions pass through."""
        asked = {**self.common, **options}
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")  # whatever speaks against a run stands in its message
            if "h" in asked:
                return self._with_equal_steps(asked)
            steps = max(self.most // asked["method"].TABLEAU.n_stages, ROWS)
            rows = iter(range(ROWS))

            def too_many(t: float, y: np.ndarray, defects: np.ndarray) -> bool:
                return next(rows, None) is None

            states = []
            run = integrate(
                self.problem, (self.t0, self.times[0]), **asked, save_every=steps // ROWS, callback=too_many
            )
            for t in self.times[1:]:
                if run.status != 0:
                    break
                states.append(run.y[:, -1])
                run = run.continue_to(t)
        states.append(run.y[:, -1])
        return _outcome(run, np.array(states).T, f"it takes more than {self.most} evaluations")

    def _with_equal_steps(self, asked: dict[str, Any]) -> Outcome:
        """A multistep method starts once only: each start costs it some 200 evaluations."""
        method = asked["method"].TABLEAU
        several = method.has_history
        nfev = abs(self.times[-1] - self.t0) / asked["h"] * (1 if several else method.n_stages)
        if nfev > self.most:
            raise ValueError(f"it takes more than {self.most} evaluations")
        if several:
            run = integrate(self.problem, (self.t0, self.times[-1]), **asked, t_eval=self.times)
            return _outcome(run, run.y)
        run = integrate(self.problem, (self.t0, self.times[0]), **asked)
        for t in self.times[1:]:
            if run.success:
                run = run.continue_to(t)
        return _outcome(run, run.y[:, 1:])

    def trial(self, options: Mapping[str, Any]) -> Trial:
        """Run once and compare with the truth; a run that raises for its options or steps is one that failed."""
        try:
            done = self.run(options)
        except (ValueError, ArithmeticError) as error:
            return Trial(options, math.nan, 0, 0.0, f"{error}")
        found = self.judged(options, done, self.truth)
        return replace(found, error=max(found.error, self.doubt)) if found.good else found  # one may be the truth's run

    def judged(self, options: Mapping[str, Any], done: Outcome, truth: np.ndarray) -> Trial:
        """What a run says, where its states should have been `truth`."""
        nfev = round(done.nfev / self.share)
        if done.y.shape != truth.shape or not np.isfinite(done.y).all():
            return Trial(options, math.nan, nfev, done.seconds, done.trouble or "it did not reach its end")
        errors = difference(done.y, truth)
        if len(errors) == 1:
            return Trial(options, float(errors[0]), nfev, done.seconds, done.trouble)
        power, trouble = _power(errors), done.trouble
        if power > WILD_POWER:
            trouble = trouble or f"its error grows faster than the {WILD_POWER:g}th power of time: a chaotic motion?"
        power = min(max(power, LEAST_POWER), LARGEST_POWER)
        return Trial(options, float(errors.max()) / self.share**power, nfev, done.seconds, trouble, power)


def _outcome(run: IntegrationResult, y: np.ndarray, stopped: str = "") -> Outcome:
    """Of a run, with states y; why it was stopped, where it was, or what its diagnostics say against it."""
    trouble = run.diagnostics.message if run.status >= 0 else run.message
    if run.status != 0:
        trouble, y = trouble or stopped, np.full_like(y, np.nan)
    return Outcome(y, run.nfev, run.wall_time, trouble)


def difference(y: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Largest component of the difference, relative to the largest component, of states in columns (n, k)."""
    sizes = np.abs(truth).max(axis=0)
    return np.abs(y - truth).max(axis=0) / np.where(sizes > 0, sizes, 1.0)


def _power(errors: np.ndarray) -> float:
    """As which power of time errors at equidistant times grow: the slope of the largest so far, on logarithmic axes."""
    largest = np.maximum.accumulate(errors)
    seen = largest > 0
    if seen.sum() < 2:
        return LEAST_POWER
    times = np.arange(1, len(errors) + 1)[seen]
    return float(np.polyfit(np.log(times), np.log(largest[seen]), 1)[0])
