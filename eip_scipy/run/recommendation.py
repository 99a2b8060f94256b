"""The result of `recommend`: method and options for a wanted error, the trials that led to them, and the reason."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from ..core.problem import Problem
from .integrate import integrate
from .results import IntegrationResult
from .trials import Trial

__all__ = ["Recommendation", "called"]

# Largest width of the reason why a trial failed, in the table.
WIDTH = 90


@dataclass(frozen=True, eq=False, repr=False)
class Recommendation:
    """A method and its options for a wanted error; prints as a table of trials and a sentence.

    Attributes
    ----------
    problem : Problem
        The given problem with the start and the interval of the call, or a problem made from the given function.
    options : dict
        Options of `integrate`, including ``method``: ``integrate(recommendation.problem, **recommendation.options)``.
    method : type
        The solver class.
    trial : Trial
        Trial of the recommended run.
    wanted : float
        The wanted error.
    error, nfev : float, int
        Expected error at the end of the interval (largest component of the difference from the exact state, relative to
        the largest component of the exact state), and expected number of evaluations of the right-hand side.
    share : float
        Fraction of the interval that the trials cover; if it is below 1, `error` and `nfev` are extrapolated.
    trusted : bool
        True if the trial of the recommended run was reliable and kept all invariants that were asked for.
    message : str
        Reason why the recommended run is not reliable; empty if it is.
    reason : str
        Reason for the choice.
    trials : tuple of Trial
        All trials: ``options``, ``error``, ``nfev``, ``seconds``, and ``trouble`` of those that failed.
    stiff : bool
        True if an implicit method needs at most 0.33 of the evaluations of the recommended run; `reason` names the
        method.
    """

    problem: Problem
    options: Mapping[str, Any]
    trial: Trial
    wanted: float
    share: float
    message: str
    reason: str
    trials: tuple[Trial, ...]
    stiff: bool = False

    @property
    def method(self) -> Any:
        """The solver class."""
        return self.options["method"]

    @property
    def error(self) -> float:
        """Expected error at the end of the interval, relative to the largest component of the exact state."""
        return self.trial.error

    @property
    def nfev(self) -> int:
        """Expected number of evaluations of the right-hand side."""
        return self.trial.cost

    @property
    def trusted(self) -> bool:
        """True if the run is expected to be reliable."""
        return not self.message

    def run(self, **options: Any) -> IntegrationResult:
        """Integrate with the recommended method and options.

        Parameters
        ----------
        **options
            Options of `integrate`, such as ``save_every`` or ``events``; they take precedence.

        Returns
        -------
        IntegrationResult
        """
        return integrate(self.problem, **{**self.options, **options})

    def __repr__(self) -> str:
        t0, t_end = self.problem.t_span
        part = "" if self.share == 1 else f", extrapolated from {self.share:.2g} of the interval"
        lines = [
            f"{self.problem.name}: error {self.wanted:g} at the end of t from {t0:g} to {t_end:g}",
            f"  run(): integrate(problem, {called(self.options)})",
            f"  expected: error {self.error:.1e}, {self.nfev} evaluations{part}",
            *([f"  WARNING: {self.message}"] if self.message else []),
            *_table(self.trials, self.trial),
            f"  {self.reason}",
        ]
        return "\n".join(lines)


def called(options: Mapping[str, Any]) -> str:
    """Return options as they are written in a call; "..." replaces values that are long to write."""
    return ", ".join(f"{name}={_shown(value)}" for name, value in options.items())


def _shown(value: Any) -> str:
    if isinstance(value, type):
        return value.__name__
    if isinstance(value, float):
        return f"{value:g}"
    plain = isinstance(value, (str, int)) or value is None or (isinstance(value, tuple) and not value)
    return repr(value) if plain else "..."


def _table(trials: tuple[Trial, ...], chosen: Trial) -> Iterator[str]:
    """Yield the lines of the table of trials; "->" marks the recommended one."""
    rows, output = [], any(trial.output for trial in trials)
    for trial in _one_each(trials, chosen):
        cost = f"{trial.error:9.1e} {trial.nfev:11d}" if math.isfinite(trial.error) else f"{'-':>9} {'-':>11}"
        if output:
            cost += f" {trial.cost if trial.output else '-':>11}"
        trouble = textwrap.shorten(trial.trouble, WIDTH, placeholder=" ...")
        # `atol` and `compensated` follow from the others.
        others = {name: x for name, x in trial.options.items() if name not in ("method", "atol", "compensated")}
        name = f"{trial.options['method'].__name__}, {called(others)}"
        rows.append(("->" if trial is chosen else "", name, cost, f"  {trouble}".rstrip()))
    width = max(len(row[1]) for row in rows)
    yield f"     {'trials':<{width}}     error evaluations{' with output' if output else ''}"
    for mark, name, cost, trouble in rows:
        yield f"  {mark:>2} {name:<{width}} {cost}{trouble}"


def _one_each(trials: tuple[Trial, ...], chosen: Trial) -> list[Trial]:
    """Return one trial of each group of trials that differ only in the values of `h`, or of `rtol` and `atol`.

    It is `chosen` if this trial belongs to the group, else the last good trial, or the last one if there is none.
    """
    ways: dict[str, Trial] = {}
    for trial in trials:
        options = {name: value for name, value in trial.options.items() if name not in ("h", "rtol", "atol")}
        way = f"{called(options)}, {'h' in trial.options}"
        known = ways.get(way)
        if known is None or (known is not chosen and (trial.good or not known.good)):
            ways[way] = trial
    return list(ways.values())
