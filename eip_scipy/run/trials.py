"""Trial runs: the error of each, compared with a much more accurate run, and its cost."""

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

# Errors that grow faster than this power of time are taken to grow exponentially.
WILD_POWER = 4.0
LEAST_POWER, LARGEST_POWER = 1.0, 2.0
# Number of times at which an adaptive trial checks whether it has used too many evaluations.
ROWS = 16


@dataclass(frozen=True)
class Trial:
    """Result of one trial run, extrapolated to the whole interval.

    Attributes
    ----------
    options : dict
        Options of `integrate`, without those that all trials have in common.
    error : float
        Error of the state at the end of the interval: largest component of the difference from the reference, relative
        to the largest component of the reference. Extrapolated if the trial is shorter than the interval; nan if the
        run failed.
    nfev : int
        Evaluations of the right-hand side for the whole interval.
    seconds : float
        Run time of the trial itself.
    trouble : str
        Reason why the run failed or is not reliable; empty for a good run.
    power : float
        Power of time with which the error is extrapolated; nan if the trial covers the whole interval.
    output : int
        Further evaluations, for states between the steps.
    """

    options: Mapping[str, Any]
    error: float
    nfev: int
    seconds: float
    trouble: str = ""
    power: float = math.nan
    output: int = 0

    @property
    def cost(self) -> int:
        """Number of all evaluations: the sum of `nfev` and `output`."""
        return self.nfev + self.output

    @property
    def good(self) -> bool:
        """True if the run is reliable and its error is known."""
        return not self.trouble and math.isfinite(self.error)


class Outcome(NamedTuple):
    """Result of one run of a `Bench`.

    `y` holds the states (n, k) at the times of the bench, `nfev` the number of evaluations, `seconds` the run time, and
    `trouble` the reason if the run failed or is not reliable.
    """

    y: np.ndarray
    nfev: int
    seconds: float
    trouble: str


class Bench:
    """A problem, the options that all trials have in common, and the times at which trials are compared.

    `truth` holds the reference states at these times; their own error is about `doubt`. `most` is an approximate bound
    on the evaluations of a trial. `output` are the times at which the user wants states, or None.
    """

    def __init__(self, problem: Problem, common: Mapping[str, Any], output: np.ndarray | None = None) -> None:
        self.problem, self.common, self.output = problem, common, output
        self.t0, self.t_end = problem.t_span
        self.times: Sequence[float] = [self.t_end]
        self.truth, self.doubt, self.most = np.zeros(0), 0.0, UNBOUNDED

    def shorten(self, t: float, looks: int) -> None:
        """Let trials end at `t`, and compare them at `looks` equidistant times."""
        self.times = [self.t0 + (t - self.t0) * k / looks for k in range(1, looks + 1)]

    @property
    def share(self) -> float:
        """Fraction of the interval that a trial covers."""
        return (self.times[-1] - self.t0) / (self.t_end - self.t0)

    def run(self, options: Mapping[str, Any]) -> Outcome:
        """Run once; exceptions raised at the start or by the user's functions propagate."""
        asked = {**self.common, **options}
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")  # the message of a run repeats its warnings
            if "h" in asked:
                return self._with_equal_steps(asked)
            steps = max(self.most // asked["method"].TABLEAU.n_stages, ROWS)
            rows = iter(range(ROWS))

            def too_many(t: float, y: np.ndarray, residuals: np.ndarray) -> bool:
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
        """Run with equal steps, and return the outcome with the states at the times of the bench.

        A one-step method continues its run from each of these times to the next. A multistep method makes a single run
        with ``t_eval``, because each of its starts costs about 200 evaluations.
        """
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
        """Run once and compare with the reference; a ValueError or ArithmeticError makes it a failed trial."""
        try:
            done = self.run(options)
        except (ValueError, ArithmeticError) as error:
            return Trial(options, math.nan, 0, 0.0, f"{error}")
        found = self.judged(options, done, self.truth)
        # This may be the reference run itself.
        return replace(found, error=max(found.error, self.doubt)) if found.good else found

    def with_output(self, trial: Trial) -> Trial:
        """Return the trial with the further evaluations of a run that saves states at the times `self.output`."""
        if self.output is None:
            return trial
        end = self.times[-1]
        times = self.output[np.abs(self.output - self.t0) <= abs(end - self.t0)]
        if times.size == 0:
            return trial
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            run = integrate(self.problem, (self.t0, end), **{**self.common, **trial.options, "t_eval": times})
        return replace(trial, output=round(run.nfev / self.share) - trial.nfev)

    def judged(self, options: Mapping[str, Any], done: Outcome, truth: np.ndarray) -> Trial:
        """Return the `Trial` of a run with `options` and the outcome `done`, whose states are compared with `truth`."""
        nfev = round(done.nfev / self.share)
        if done.y.shape != truth.shape or not np.isfinite(done.y).all():
            return Trial(options, math.nan, nfev, done.seconds, done.trouble or "it did not reach its end")
        errors = difference(done.y, truth)
        if len(errors) == 1:
            return Trial(options, float(errors[0]), nfev, done.seconds, done.trouble)
        power, trouble = _power(errors), done.trouble
        if power > WILD_POWER:
            wild = f"its error grows faster than the {WILD_POWER:g}th power of time; the motion may be chaotic"
            trouble = trouble or wild
        power = min(max(power, LEAST_POWER), LARGEST_POWER)
        return Trial(options, float(errors.max()) / self.share**power, nfev, done.seconds, trouble, power)


def _outcome(run: IntegrationResult, y: np.ndarray, stopped: str = "") -> Outcome:
    """Return the outcome of a run with states `y`; `stopped` is the reason if the callback stopped it."""
    trouble = run.diagnostics.message if run.status >= 0 else run.message
    if run.status != 0:
        trouble, y = trouble or stopped, np.full_like(y, np.nan)
    return Outcome(y, run.nfev, run.wall_time, trouble)


def difference(y: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return for each column of two arrays (n, k) the largest difference relative to the largest entry of `truth`."""
    sizes = np.abs(truth).max(axis=0)
    return np.abs(y - truth).max(axis=0) / np.where(sizes > 0, sizes, 1.0)


def _power(errors: np.ndarray) -> float:
    """Return the power of time with which errors at equidistant times grow: the slope of the logarithms."""
    largest = np.maximum.accumulate(errors)
    seen = largest > 0
    if seen.sum() < 2:
        return LEAST_POWER
    times = np.arange(1, len(errors) + 1)[seen]
    return float(np.polyfit(np.log(times), np.log(largest[seen]), 1)[0])
