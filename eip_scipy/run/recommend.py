"""Find the cheapest method, with its step or tolerance, for a wanted error, by trial runs."""

from __future__ import annotations

import math
import textwrap
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import count
from typing import Any, NamedTuple, TypedDict, Unpack

import numpy as np

from ..core.conserved import missing_linear
from ..core.functions import AccelerationField, PointerFunction, by_pointer
from ..core.inputs import flag, initial_state, is_number, shown
from ..core.invariants import Invariant, as_invariants
from ..core.names import nearest
from ..core.particles import particle_invariants
from ..core.problem import Problem, bind
from ..core.projection import Blocks, LinearConstraints, Metric
from ..core.solvers import EIPBDF, EIPDOP853, EIPGJ12, EIPGJ14, EIPRK23, EIPRK45, EIPRKN8, EIPRKN12, EIPRadau
from ..core.step_control import UNBOUNDED, interval
from ..engine.data import EPS, NFEV
from ..engine.trust import ProjectionWarning
from ..methods.nystrom import depends_on_velocity
from .integrate import Loop, integrate
from .prepare import RunArguments, evaluation_times, prepared
from .results import IntegrationResult

__all__ = ["Recommendation", "Trial", "recommend"]

UNPROJECTED: dict[str, Any] = {"invariants": ()}
NYSTROM: dict[str, Any] = {"every": "auto", "compensated": True}  # their steps are so accurate that rounding matters
MAX_NFEV = {False: 100_000, True: 500_000}  # of one trial, for Python functions and for native ones
TIGHTEST, FINE = 1e-13, 1e-12  # smallest tolerance, and the first one of a reference that rounding errors limit
# Fractions of the wanted error: to which two runs must agree, which the tuning aims at, and which is needlessly small.
AGREED, TARGET, ENOUGH = 0.02, 0.4, 0.15
CHEAPER = 0.9  # a less usual way must save 10 % of the evaluations


class RecommendKeywords(TypedDict, total=False):
    """The options of `integrate` that `recommend` passes on, for type checkers."""

    params: Any
    in_place: bool
    jacobian: Callable[..., Any] | None
    metric: Metric
    blocks: Blocks
    linear_invariants: LinearConstraints
    compiled: bool | None


@dataclass(frozen=True, eq=False)
class Trial:
    """Trial run with these `options` of `integrate`, apart from those that all trials have in common.

    `error` (nan if it failed) and `nfev` as for `Recommendation`; `trouble` says why it failed or is not reliable.
    """

    options: Mapping[str, Any]
    error: float
    nfev: int
    seconds: float
    trouble: str

    @property
    def good(self) -> bool:
        """True if the run is reliable and its error is known."""
        return not self.trouble and math.isfinite(self.error)


@dataclass(frozen=True, eq=False, repr=False)
class Recommendation:
    """A method and its options for a wanted error; prints as a table of trials and a sentence.

    Attributes
    ----------
    problem, options : Problem, dict
        ``integrate(recommendation.problem, **recommendation.options)`` is the recommended run; see also `run`.
    trial, trials : Trial, tuple of Trial
        Trial of the recommended run, and all trials.
    wanted, error : float
        Wanted and expected error of the state at the end of the interval: largest component of the difference from the
        exact state, relative to the largest component of the exact state.
    nfev : int
        Expected evaluations of the right-hand side, also those for Jacobians, which the `nfev` of a run does not count.
    share : float
        Fraction of the interval that the trials cover; if it is below 1, `error` and `nfev` are extrapolated.
    trusted, message : bool, str
        True if the trial was reliable and kept all invariants that were asked for; otherwise `message` is the reason.
    reason, stiff : str, bool
        Reason for the choice; True if the equations are stiff, so that the method is an implicit one.
    pays : float
        Estimated time of a run of equal error without invariants, divided by that of this run; nan if there is none.
    missing : tuple of Invariant
        Invariants of the equations that runs with the given invariants do not keep: linear ones, and momenta of
        particles. The recommended run keeps those that its projection would change; `reason` says so.

    See Also
    --------
    eip_scipy.recommend
    """

    problem: Problem
    options: Mapping[str, Any]
    trial: Trial
    wanted: float
    share: float
    message: str
    reason: str
    trials: tuple[Trial, ...]
    stiff: bool
    pays: float
    missing: tuple[Invariant, ...]

    method = property(lambda self: self.options["method"], doc="The solver class.")
    error = property(lambda self: self.trial.error, doc="Expected error at the end of the interval.")
    nfev = property(lambda self: self.trial.nfev, doc="Expected number of evaluations of the right-hand side.")
    trusted = property(lambda self: not self.message, doc="True if the run is expected to be reliable.")

    def run(self, **options: Any) -> IntegrationResult:
        """Integrate with the recommended options; `options` of `integrate`, such as ``events``, take precedence."""
        return integrate(self.problem, **{**self.options, **options})

    def __repr__(self) -> str:
        t0, t_end = self.problem.t_span
        part = "" if self.share == 1 else f", extrapolated from {self.share:.2g} of the interval"
        rows: dict[str, Trial] = {}  # of each method and set of options, the recommended trial or the last good one
        for trial in self.trials:
            way = f"{_called(trial.options, ('h', 'rtol', 'atol'))}, {'h' in trial.options}"
            if way not in rows or (rows[way] is not self.trial and (trial.good or not rows[way].good)):
                rows[way] = trial
        # `atol` and `compensated` follow from the other options.
        names = [_called(trial.options, ("atol", "compensated")).removeprefix("method=") for trial in rows.values()]
        width = max(map(len, names))
        lines = [
            f"{self.problem.name}: error {self.wanted:g} at the end of t from {t0:g} to {t_end:g}",
            f"  run(): integrate(problem, {_called(self.options)})",
            f"  expected: error {self.error:.1e}, {self.nfev} evaluations{part}",
            *([f"  WARNING: {self.message}"] if self.message else []),
            f"     {'trials':<{width}}     error evaluations",
        ]
        for name, trial in zip(names, rows.values(), strict=True):
            cost = f"{trial.error:9.1e} {trial.nfev:11d}" if math.isfinite(trial.error) else f"{'-':>9} {'-':>11}"
            trouble = textwrap.shorten(trial.trouble, 90, placeholder=" ...")
            lines.append(f"  {'->' if trial is self.trial else '':>2} {name:<{width}} {cost}  {trouble}".rstrip())
        return "\n".join([*lines, f"  {self.reason}"])


def recommend(
    fun: Callable[..., Any] | Problem | None = None,
    t_span: Any = None,
    y0: Any = None,
    *,
    acceleration: Any = None,
    error: float = 1e-6,
    invariants: Any = None,
    max_nfev: int | None = None,
    t_eval: Any = None,
    **keywords: Unpack[RecommendKeywords],
) -> Recommendation:
    """Find method, step or tolerance, metric and blocks for a wanted error, by trial runs.

    Parameters
    ----------
    fun, t_span, y0, acceleration
        As for `integrate`. The interval must be finite. Systems q'' = a(t, q) with y = (q, v) are recognised.
    error : float, optional
        Wanted error of the state at the end, see `Recommendation`.
    invariants : Invariant or sequence of Invariant, optional
        Invariants to keep; default: those of the problem; for a function, none. `particle_invariants` are added if the
        system keeps them.
    max_nfev : int, optional
        Approximate bound on the evaluations of one trial; default: 100 000, and 500 000 for compiled functions. A
        longer run by an explicit method is tried on the first part of its interval, and its error is extrapolated.
    t_eval : array_like, optional
        Times at which the recommended run saves states. Evaluations for states between steps are then counted too.
    params, in_place, jacobian, metric, blocks, linear_invariants, compiled
        As for `integrate`, for all runs. With `jacobian`, or a problem that has one, `EIPGJ14` is tried.

    Returns
    -------
    Recommendation

    Raises
    ------
    TypeError, ValueError
        If an option is unknown or wrong, if a gradient is wrong, if the right-hand side cannot be integrated, or if no
        trial has the wanted error (the message states the smallest error found).

    Warns
    -----
    ProjectionWarning
        If no run with the projection is reliable and has the wanted error, so that one without it is recommended.

    See Also
    --------
    integrate, find_invariants, eip_scipy.results.Recommendation

    Notes
    -----
    Errors are measured against a run by `EIPDOP853` without projection if possible, whose tolerances are reduced until
    two runs agree to 2 % of the wanted error. Each method is tuned until a trial has between 15 % and 100 % of the
    wanted error. The trial with the fewest evaluations is recommended, a less usual method only if it saves 10 %.
    If stability limits the steps, `EIPRadau` and `EIPBDF` are tried first, over the whole interval and with a reference
    by `EIPRadau`. They are recommended if they need at most a third of the evaluations of `EIPDOP853`.

    Examples
    --------
    >>> from eip_scipy import recommend
    >>> from eip_scipy.problems import kepler
    >>> choice = recommend(kepler(0.6), (0, 50), error=1e-8)
    >>> choice.trusted, choice.error <= 1e-8, choice.run().nfev <= 1.1 * choice.nfev
    (True, True, True)
    """
    known = RecommendKeywords.__annotations__
    for name in keywords:
        if name not in known:
            raise TypeError(
                f"recommend() has no option {name!r}{nearest(name, known) or '.'} It finds method, step and "
                "tolerances; pass other options, such as events, to the run() of its result."
            )
    if not is_number(error, "error") or not 0 < error < 1:
        raise ValueError(f"error must be a number between 0 and 1, got {shown(error)}.")
    if max_nfev is not None and (not is_number(max_nfev) or not max_nfev >= 1000):
        raise ValueError(f"max_nfev must be at least 1000, got {shown(max_nfev)}.")
    common: dict[str, Any] = {name: value for name, value in keywords.items() if value is not None}
    problem = _problem(fun, acceleration, t_span, y0, common)
    if invariants is not None:
        common["invariants"] = as_invariants(invariants)
    output = None if t_eval is None else evaluation_times(t_eval, *problem.t_span)
    search = _Search(problem, common, float(error), output)
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")  # the message of a run repeats its warnings
        choice = search.recommendation(max_nfev)
    if choice.message:
        warnings.warn(f"recommend: {choice.message}", ProjectionWarning, stacklevel=2)
    return choice


def _problem(fun: Any, acceleration: Any, t_span: Any, y0: Any, common: dict[str, Any]) -> Problem:
    """Return the problem with the start and interval of the call; options that it takes are removed from `common`."""
    if acceleration is not None:
        if fun is not None:
            raise TypeError("recommend: give fun or acceleration, not both.")
        pointer = by_pointer(acceleration, "acceleration")
        in_place = flag("in_place", common.pop("in_place", False)) or isinstance(pointer, PointerFunction)
        fun = AccelerationField(pointer, in_place)
    if not isinstance(fun, Problem):
        if t_span is None or y0 is None:
            missing = "t_span" if t_span is None else "y0"
            raise TypeError(f"recommend: {missing} is missing; it can be omitted only for a Problem.")
        pointer = by_pointer(fun, "fun")
        in_place = flag("in_place", common.pop("in_place", False)) or isinstance(pointer, PointerFunction)
        params, rhs = (common.pop("params", None), fun) if in_place else (None, None)
        name = getattr(getattr(fun, "acceleration", fun), "__name__", "problem")
        fun = Problem(name, bind(pointer, params) if in_place else fun, y0, t_span, rhs=rhs, params=params)
    t0, t_end = interval(fun.t_span if t_span is None else t_span)
    if not math.isfinite(t_end) or t_end == t0:
        raise ValueError(f"recommend needs an interval of a finite length above 0, got t_span={shown((t0, t_end))}.")
    return replace(fun, t_span=(t0, t_end), y0=initial_state(fun.y0 if y0 is None else y0))


class _Way(NamedTuple):
    """A method with options of `integrate`, tuned by its step if `fixed` is True, otherwise by its tolerance."""

    method: Any
    options: dict[str, Any]
    fixed: bool = False

    @property
    def name(self) -> str:
        return f"{self.method.__name__}{' with equal steps' if self.fixed else ''}"

    @property
    def order(self) -> int:
        return 5 if self.method.TABLEAU.drives else int(self.method.TABLEAU.order)  # BDF: the highest one

    @property
    def slope(self) -> float:
        """Power of the step or tolerance with which the error grows; about 1 for implicit methods."""
        tableau = self.method.TABLEAU
        if tableau.drives:
            return 1.0
        return self.order if self.fixed else self.order / ((tableau.error_estimator_order or 0) + 1)


class _Search:
    """Trials for one problem, compared at `times` with states `reference` of error `doubt`, with at most `most` calls.

    `best` has the trial chosen for each method, and `share` is the fraction of the interval up to the last time.
    """

    def __init__(self, problem: Problem, common: dict[str, Any], wanted: float, output: np.ndarray | None) -> None:
        """Check the start as for a run with the invariants: a wrong gradient raises an error."""
        self.problem, self.common, self.wanted, self.output = problem, common, wanted, output
        self.t0, self.t_end = problem.t_span
        self.trials, self.remarks, self.stiff = list[Trial](), list[str](), False
        rtol = min(max(wanted, 1e-10), 1e-4)
        atol = 1e-3 * rtol * min(1.0, float(np.abs(problem.y0).max()) or 1.0)
        self.first = {**common, "method": EIPDOP853, "rtol": rtol, "atol": atol}
        self.pilot = prepared(RunArguments.of(fun=problem, **self.first))
        self.missing, particles = tuple(missing_linear(self.pilot)), self.pilot.conserved.missing
        if particles is not None:
            self.missing = tuple(particle_invariants(particles.masses, particles.dimension))
            common["invariants"] = (*as_invariants(common.get("invariants", problem.invariants)), *self.missing)
            self.remarks.append("Momentum and angular momentum of the particles are kept too, by particle_invariants.")
        elif self.missing and self.pilot.invariants.size:
            common.setdefault("linear_invariants", "auto")
            names = ", ".join(f"{item.name}" for item in self.missing)
            self.remarks.append(f"Linear invariants are kept too, by linear_invariants='auto': {names}.")

    def recommendation(self, max_nfev: int | None) -> Recommendation:
        """Return the cheapest method: an implicit one if stability makes explicit ones expensive."""
        self._first_run(max_nfev)
        common, problem = self.common, self.problem
        items = as_invariants(common.get("invariants", problem.stiff_invariants))
        # Implicit methods have neither balances nor compiled runs, and are slow for larger states.
        suits = problem.y0.dtype.kind != "c" and problem.y0.size <= 500 and not any(item.is_balance for item in items)
        if self.is_bound and suits:
            implicit = {name: x for name, x in common.items() if name != "compiled"} | {"invariants": items}
            self.stiff = True
            with suppress(ValueError, ArithmeticError):  # an explicit method is recommended if the implicit ones fail
                choice = self._cheapest_of(implicit, [self.t_end], min(self.max_nfev, MAX_NFEV[False]))
                if 3 * choice.nfev <= self.explicit_nfev:
                    return choice
            self.stiff = False
        if self.is_bound:
            self.remarks.append("Stability limits the steps: another implicit method or a splitting may cost less.")
        # Trials of a part of the interval are compared at 8 times, to see how their errors grow.
        times = [self.t_end] if self.end == self.t_end else np.linspace(self.t0, self.end, 9)[1:].tolist()
        return self._cheapest_of(common, times, UNBOUNDED)

    def _first_run(self, max_nfev: int | None) -> None:
        """Run `EIPDOP853` without projection, to see how long its steps are, what limits them, and how far it comes."""
        pilot, options = self.pilot, self.first | UNPROJECTED
        start = pilot.start
        self.max_nfev = int(max_nfev or MAX_NFEV[pilot.problem.functions(pilot, None)[1] is None])
        self.velocities: bool | None = None  # the equations are not of the form q'' = a(t, q, v)
        with suppress(ValueError):
            self.velocities = depends_on_velocity(pilot, start)
        steps = max(self.max_nfev // (4 * EIPDOP853.TABLEAU.n_stages), 10)  # the tightest run needs several times more
        every = max(1, steps * start.y.size // 4_000_000)  # a bound on the memory
        rows = iter(range(steps // every))
        run = integrate(self.problem, **options, save_every=every, callback=lambda *_: next(rows, None) is None)
        if not run.success:
            raise ValueError(f"recommend: a trial by EIPDOP853 with rtol={options['rtol']:g} failed: {run.message}")
        self.end = float(run.t[-1]) if run.status else self.t_end
        lengths = np.abs(np.diff(run.t)) / every
        short, self.step, long = np.percentile(lengths[2:-1] if lengths.size > 5 else lengths, [5, 50, 95]).tolist()
        self.size, self.variation = min(1.0, float(np.abs(run.y).max())) or 1.0, long / short
        self.explicit_nfev = run.nfev * (self.t_end - self.t0) / (self.end - self.t0)
        self.is_bound, looser = False, {name: 10 * options[name] for name in ("rtol", "atol")}
        if run.nfev >= 1000:  # stability limits the steps if looser tolerances hardly save evaluations
            with suppress(ValueError, ArithmeticError):
                looser_run = integrate(self.problem, (self.t0, self.end), **options | looser)
                self.is_bound = looser_run.nfev > 0.9 * run.nfev

    def _cheapest_of(self, common: dict[str, Any], times: list[float], most: int) -> Recommendation:
        """Return the cheapest explicit or implicit method; raise ValueError if none has the wanted error."""
        self.common, self.times, self.most, self.longest = common, times, most, 0
        self.best, self.notes, self.message = dict[str, Trial](), list[str](), ""
        self.share = (times[-1] - self.t0) / (self.t_end - self.t0)
        self.projects = self.asked = bool(common.get("invariants", self.problem.invariants))
        self._find_reference()
        self.most = min(most, 3 * self.longest)
        found = self._cheapest()
        if found is None and self.projects:
            self.projects = False
            why = self._smallest("with the projection the error stays at")
            self.message = f"the invariants are left out because no trial that keeps them has the wanted error: {why}"
            found = self._cheapest()
        if found is None:
            why = f"no trial has an error of {self.wanted:g}: {self._smallest('the smallest was')}"
            raise ValueError(f"recommend: {why}. Allow a larger error or a shorter interval.")
        way, chosen, pays = *found, math.nan
        if self.projects:
            way, chosen = self._with_other_metric(way, chosen)
            pays = self._compared_with_plain(way, chosen)
        options = {**chosen.options, **{name: x for name, x in common.items() if name not in chosen.options}}
        options |= {} if self.output is None else {"t_eval": self.output}
        reason = " ".join([self._why(way, chosen), *self.remarks, *self.notes])
        return Recommendation(
            self.problem, options, chosen, self.wanted, self.share, self.message, reason, tuple(self.trials),
            self.stiff, pays, self.missing,
        )  # fmt: skip

    def _settings(self, way: _Way, value: float) -> tuple[float, dict[str, Any]]:
        """Return the step or tolerance, rounded and within its limits, and the options of `integrate` for it."""
        smallest, largest, digits = TIGHTEST, 1e-3 if self.stiff else 1e-2, 2
        if way.fixed:
            smallest, largest, digits = 0.0, abs(self.times[-1] - self.t0) / 40, 3
        value = float(f"{min(max(value, smallest), largest):.{digits}g}")
        control = {"h": value} if way.fixed else {"rtol": value, "atol": float(f"{1e-3 * value * self.size:.2g}")}
        return value, {"method": way.method, **control, **way.options}

    def _integrate(self, t: float, options: Mapping[str, Any], **further: Any) -> tuple[IntegrationResult, int]:
        """Run from the start to t; return the result and its evaluations, for Jacobians of implicit methods too."""
        given = RunArguments.of(fun=self.problem, t_span=(self.t0, t), **{**self.common, **options, **further})
        run, is_implicit = prepared(given), options["method"].TABLEAU.drives
        if is_implicit:
            calls, fun = count(int(run.work.counters[NFEV]) + run.stepper.start_calls), run.problem.fun

            def counted(*args: Any) -> Any:
                if next(calls) > self.most:
                    raise ArithmeticError(f"it takes more than {self.most} evaluations")
                return fun(*args)

            run.problem.bind(counted)
        result = Loop(run, given).run()
        return result, next(calls) if is_implicit else result.nfev

    def _run(self, options: Mapping[str, Any]) -> tuple[np.ndarray, int, float, str]:
        """Return the states at `times`, evaluations, seconds and trouble of a run; exceptions propagate."""
        method, length = options["method"].TABLEAU, abs(self.times[-1] - self.t0)
        stages = getattr(method, "n_stages", 1)  # multistep methods have none; the runs of implicit ones count
        stopped = f"it takes more than {self.most} evaluations"
        if stages * length > self.most * options.get("h", math.inf):
            raise ValueError(stopped)
        if method.has_history:  # a single run, because each start costs about 200 evaluations
            run, nfev = self._integrate(self.times[-1], options, t_eval=self.times)
            states = run.y
        else:
            # The evaluations are compared with the bound 16 times; both ends of each part are saved too.
            rows, every = iter(range(16 + 2 * len(self.times))), max(self.most // (16 * stages), 1)
            watched = {"save_every": every, "callback": lambda *_: next(rows, None) is None}
            run, nfev = self._integrate(self.times[0], options, **watched)
            states = run.y[:, -1:]
            for t in self.times[1:]:
                if run.status == 0:
                    run = run.continue_to(t)
                    states = np.column_stack([states, run.y[:, -1]])
        trouble = run.diagnostics.message if run.status >= 0 else run.message
        if run.status != 0:
            states, trouble = np.zeros(0), trouble or stopped
        return states, max(nfev, run.nfev), run.wall_time, trouble

    def _trial(self, options: Mapping[str, Any]) -> Trial:
        """Run once, compare with the reference, and keep the result; an error in the run makes it a failed trial."""
        try:
            states, nfev, seconds, trouble = self._run(options)
        except (ValueError, ArithmeticError) as reason:
            states, nfev, seconds, trouble = np.zeros(0), 0, 0.0, f"{reason}"
        error = math.nan
        if states.shape == self.reference.shape and np.isfinite(states).all():
            error, wild = self._error(states, self.reference)
            error, trouble = max(error, self.doubt), trouble or wild  # it may be the run of the reference
        self.trials.append(Trial(options, error, round(nfev / self.share), seconds, trouble))
        return self.trials[-1]

    def _error(self, states: np.ndarray, reference: np.ndarray) -> tuple[float, str]:
        """Return the error at the end of the whole interval, and a remark if it may grow exponentially."""
        sizes = np.abs(reference).max(axis=0)
        errors = np.abs(states - reference).max(axis=0) / np.where(sizes > 0, sizes, 1.0)
        largest, power = np.maximum.accumulate(np.maximum(errors, EPS)), 1.0
        if largest.size > 1:  # the slope of the logarithms is the power of time with which errors grow
            power = float(np.polyfit(np.log(np.arange(1, largest.size + 1)), np.log(largest), 1)[0])
        wild = "its error grows faster than the 4th power of time; the motion may be chaotic" if power > 4 else ""
        return float(largest[-1]) / self.share ** min(max(power, 1.0), 2.0), wild

    def _find_reference(self) -> None:
        """Find states at `times` by two runs that agree; raise ValueError if no two do."""
        ways = [(_Way(EIPRadau if self.stiff else EIPDOP853, UNPROJECTED), max(1e-2 * self.wanted, FINE))]
        if not self.stiff:
            best = _Way(EIPDOP853, {}) if self.velocities is not False else _Way(EIPRKN12, NYSTROM)
            ways += [(best, FINE)] if self.projects else []
            ways += [(best._replace(options=NYSTROM | UNPROJECTED), FINE)] if best.options else []
        self.reference, self.doubt = np.zeros(0), math.inf
        for way, rtol in ways:
            agreement, states = self._agreement(way, rtol)
            if agreement < self.doubt:
                apart = self._error(states, self.reference)[0] if self.reference.size else 0.0
                if apart <= 10 * self.doubt:  # runs with and without projection must agree
                    self.doubt, self.reference = agreement, states
            if self.doubt <= AGREED * self.wanted:
                return
        least = self.doubt / 0.3
        if not least <= self.wanted:
            hint = f"Pass error={least:.0e} or more, or a shorter interval." if least < 0.1 else "Shorten the interval."
            raise ValueError(
                f"recommend: an error of {self.wanted:g} cannot be reached or cannot be verified: two runs with the "
                f"smallest tolerances differ by {self.doubt:.1e}, because rounding errors have grown or the motion is "
                f"chaotic. {hint}"
            )

    def _agreement(self, way: _Way, rtol: float) -> tuple[float, np.ndarray]:
        """Reduce `rtol` until two runs agree or rounding remains; return their difference and the tighter states."""
        wider, agreement = None, math.inf
        while True:
            value, options = self._settings(way, rtol)
            states, nfev, _, trouble = self._run(options)
            before, self.longest = agreement, max(self.longest, nfev)
            if trouble:
                return agreement, states if wider is None else wider
            if wider is not None:
                agreement = self._error(wider, states)[0]
            if agreement <= AGREED * self.wanted or value <= TIGHTEST or agreement > 0.5 * before:
                return min(agreement, before), states
            wider, rtol = states, max(1e-2 * rtol, TIGHTEST)

    def _cheapest(self) -> tuple[_Way, Trial] | None:
        """Return the cheapest way and its trial, or None if no trial has the wanted error."""
        own, before = {} if self.projects or not self.asked else UNPROJECTED, len(self.trials)
        way = _Way(EIPRadau if self.stiff else EIPDOP853, own)
        chosen = self._tuned(way, self.wanted)
        if self.projects and not any(trial.good for trial in self.trials[before:]):
            return None  # invariants that fail with one method fail with all
        for other, value in self._others(self.wanted if chosen is None else chosen.options["rtol"], own):
            trial = self._tuned(other, value, math.inf if chosen is None else 1.5 * chosen.nfev)
            if trial is not None and (chosen is None or trial.nfev < CHEAPER * chosen.nfev):
                way, chosen = other, trial
        return None if chosen is None else (way, chosen)

    def _others(self, rtol: float, own: dict[str, Any]) -> list[tuple[_Way, float]]:
        """Return further ways that suit the equations, with the step or tolerance at which their tuning starts."""
        nystrom, is_nystrom, is_other = NYSTROM | own, self.velocities is False, self.velocities is not False
        is_even = self.velocities is not None and self.variation <= 2.5 and abs(self.t_end - self.t0) > 100 * self.step
        has_jacobian = self.common.get("jacobian", self.problem.jacobian) is not None
        found = [
            (is_nystrom, _Way(EIPRKN8, nystrom), rtol),
            (is_nystrom, _Way(EIPRKN12, nystrom), rtol),
            (is_nystrom and self.variation <= 5.0, _Way(EIPRKN12, nystrom, True), 2 * self.step),
            (is_other and self.wanted >= 1e-7, _Way(EIPRK45, own), rtol),
            (is_other and self.wanted >= 1e-3, _Way(EIPRK23, own), rtol),
            (is_even and has_jacobian, _Way(EIPGJ14, own, True), self.step / 6),
            (is_even and not has_jacobian, _Way(EIPGJ12, own, True), self.step / 12),
        ]
        return [(_Way(EIPBDF, own), rtol)] if self.stiff else [(way, value) for suits, way, value in found if suits]

    def _tuned(self, way: _Way, value: float, bound: float = math.inf) -> Trial | None:
        """Return the cheapest trial of a way with the wanted error, tuned from `value` on, or None if there is none.

        The tuning ends early if a trial shows that the way needs more evaluations than `bound`.
        """
        tried = dict[float, Trial]()
        fine = coarse = None  # logarithms of value and error of trials that are accurate enough, and not (or nan)
        x, goal, change = math.log10(value), math.log10(TARGET), 0.5 if way.fixed else 2.0
        while len(tried) < 8:
            value, options = self._settings(way, 10**x)
            if value in tried:
                break
            x, trial = math.log10(value), self._trial(options)
            tried[value], ratio = trial, trial.error / self.wanted if trial.good else math.nan
            too_dear = trial.nfev * ratio ** (1 / way.order) > bound
            hopeless = len(tried) == 4 and not any(other.good for other in tried.values())
            if ENOUGH <= ratio <= 1 or too_dear or hopeless:
                break
            e = math.log10(ratio)
            fine, coarse = ((x, e), coarse) if e <= 0 else (fine, (x, e))
            if fine and coarse:
                width, part = coarse[0] - fine[0], (goal - fine[1]) / (coarse[1] - fine[1])
                if width < (0.1 if math.isnan(part) else 0.01):
                    break
                x = fine[0] + width * (0.5 if math.isnan(part) else min(max(part, 0.1), 0.9))
            else:
                x += max(min((goal - e) / way.slope, change), -change) if trial.good else -0.6 * change
        enough = [trial for trial in tried.values() if trial.good and trial.error <= self.wanted]
        if not enough:
            return None
        chosen = min(enough, key=lambda trial: trial.nfev)
        if self.output is not None:  # states between the steps need evaluations too
            times = self.output[np.abs(self.output - self.t0) <= abs(self.times[-1] - self.t0)]
            _, nfev = self._integrate(self.times[-1], chosen.options, t_eval=times if times.size else None)
            place, chosen = self.trials.index(chosen), replace(chosen, nfev=round(nfev / self.share))
            self.trials[place] = chosen
        self.best.setdefault(way.name, chosen)
        return chosen

    def _with_other_metric(self, way: _Way, chosen: Trial) -> tuple[_Way, Trial]:
        """Return the way with another metric or other blocks if that makes the run cheaper, else the given one."""
        problem, n, given, tried = self.problem, self.problem.y0.size, self.common, list[dict[str, Any]]()
        items = as_invariants(given.get("invariants", problem.invariants))
        has_own = problem.metric is not None or "metric" in given or any(item.subspaces for item in items)
        if has_own or self.stiff:
            return way, chosen
        if problem.blocks is None and "blocks" not in given and self.velocities is not None:
            tried += [{"blocks": size} for size in (3, 2) if n % (2 * size) == 0 and n > 2 * size]
        for options in (*tried, {"metric": "euclidean"}):
            other, value = way._replace(options=way.options | options), chosen.options["h" if way.fixed else "rtol"]
            trial = self._tuned(other, value, CHEAPER * chosen.nfev)
            if trial is not None and trial.nfev < CHEAPER * chosen.nfev:
                self.notes.append(f"{_called(options)} saves {1 - trial.nfev / chosen.nfev:.0%} of the evaluations.")
                way, chosen = other, trial
        return way, chosen

    def _compared_with_plain(self, way: _Way, chosen: Trial) -> float:
        """Return `Recommendation.pays`, and add remarks on the run without invariants."""
        plain = self._trial({**chosen.options, **UNPROJECTED})
        if not plain.good:
            return math.nan
        self.notes.append(f"Without the projection the error is {plain.error:.1e}.")
        # The times of short runs scatter: each is measured twice.
        projected, unprojected = (min(trial.seconds, self._run(trial.options)[2]) for trial in (chosen, plain))
        pays = (plain.error / chosen.error) ** (1 / way.order) * unprojected / projected
        if pays < 0.8:  # times scatter by less than this
            self.notes.append(f"The projection does not pay: equal accuracy without it takes {pays:.2g} of the time.")
        return pays

    def _why(self, way: _Way, chosen: Trial) -> str:
        """Return a sentence that explains the choice of the method."""
        words = "The equations are not of the form q'' = a(t, q) with y = (q, v)"
        if self.velocities is not None:
            words = "The accelerations depend on velocities" if self.velocities else "The equations are q'' = a(t, q)"
        words += f", and the steps vary by a factor of {self.variation:.2g}:"
        if self.stiff:
            words = "The equations are stiff: stability limits the steps of explicit methods, of which EIPDOP853 would "
            words += f"need about {self.explicit_nfev:.2g} evaluations."
        rivals = [(trial.nfev, name) for name, trial in self.best.items() if name != way.name]
        nfev, name = min(rivals, default=(math.inf, ""))
        nearly = "nearly " if nfev < chosen.nfev else ""  # the more usual method was preferred
        rest = f", {name} {nfev / chosen.nfev:.3g} times as many." if rivals else "."
        return f"{words} {way.name} needs {nearly}the fewest evaluations{rest}"

    def _smallest(self, words: str) -> str:
        """Return the smallest error of the trials after these words, or the trouble of the last trial if all failed."""
        good = [trial.error for trial in self.trials if trial.good]
        return f"{words} {min(good):.1e}" if good else self.trials[-1].trouble


def _called(options: Mapping[str, Any], without: tuple[str, ...] = ()) -> str:
    """Return options as they are written in a call; "..." replaces values that are long to write."""

    def text(value: Any) -> str:
        if isinstance(value, type):
            return value.__name__
        plain = isinstance(value, (str, int)) or value is None or (isinstance(value, tuple) and not value)
        return f"{value:g}" if isinstance(value, float) else repr(value) if plain else "..."

    return ", ".join(f"{name}={text(value)}" for name, value in options.items() if name not in without)
