"""The search of `recommend`: methods that suit a problem, the cost of each at the wanted error, and the reason."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..core.invariants import as_invariants
from ..core.particles import Particles, particle_invariants
from ..core.problem import Problem
from ..core.results import ProjectionWarning
from ..core.runs import Counted
from ..core.solvers import EIPDOP853, EIPGJ12, EIPGJ14, EIPRK23, EIPRK45, EIPRKN8, EIPRKN12
from ..core.steppers import depends_on_velocity
from .integrate import integrate
from .prepare import Request, prepared
from .recommendation import Recommendation, called
from .stiffness import implicit_run
from .trials import Bench, Outcome, Trial, difference
from .tuning import AIM, COARSEST_RTOL, FINEST_RTOL, WINDOW, Kind, best, tune

__all__ = ["Search"]

PLAIN: dict[str, Any] = {"invariants": ()}
# Options of Nystrom methods: their steps are so accurate that rounding errors matter.
LONG: dict[str, Any] = {"every": "auto", "compensated": True}
# Largest number of evaluations in one trial; the key says whether the functions are native.
MOST_NFEV = {False: 100_000, True: 500_000}
# The first run may use 1 / FIRST_PART of these evaluations, since the tightest run needs several times as many.
FIRST_PART = 4
# Approximate bound on the numbers that the first run stores.
MOST_SAVED = 4_000_000
# Number of times at which a trial that covers only a part of the interval is compared.
LOOKS = 8
# Tolerances of the reference runs, in decreasing order. A reference is accepted if two of them agree to this fraction
# of the wanted error.
REFERENCE_START, REFERENCE_STEP, FINE_START = 1e-2, 1e-2, 1e-12
AGREEMENT, LEAST_AGREEMENT = 0.02, 0.3
# A trial is stopped when it has used LONGEST times the evaluations of the longest reference.
LONGEST = 3
# Only rounding errors remain if a smaller tolerance leaves more than this fraction of the difference.
ROUNDED = 0.5
# Runs with and without projection agree if their difference is below SAME times the uncertainty of the latter.
SAME = 10.0
# Methods of low order, and the smallest wanted error for which each is tried.
LOW_ORDERS = (EIPRK45, 1e-7), (EIPRK23, 1e-3)
# Equal steps, and multistep methods, are tried if the steps of an adaptive run vary by less than these factors.
EVEN, VERY_EVEN = 5.0, 2.5
# Multistep methods are tried if EIPDOP853 needs at least this many steps, because their start takes 200 evaluations.
LEAST_MULTISTEP = 100
# Smallest number of equal steps in an interval.
LEAST_STEPS = 40
# Another metric or other blocks are tuned if they reduce the error by at least this factor.
BETTER = 3.0
# A later, less usual candidate replaces the current choice if it needs less than this fraction of the evaluations.
CHEAPER = 0.9
# Stability limits the steps if a tolerance LOOSER times larger needs more than FEWER times the evaluations.
LOOSER, FEWER = 10.0, 0.9
# Equations are stiff if an implicit method takes fewer evaluations by at least this factor.
STIFF = 3.0
# Runs with fewer evaluations than this are not tested for stiffness or stability.
LEAST_BOUND = 1000


@dataclass(frozen=True)
class Look:
    """Results of a first run, by adaptive steps of `EIPDOP853`.

    `size` is the largest component of the state, but at most 1, `step` the median of the steps, and `variation` the
    ratio of long to short steps (95th to 5th percentile). `velocities` says whether the accelerations of
    q'' = a(t, q, v) depend on v; it is None if the system is not of that form.
    """

    size: float
    step: float
    variation: float
    velocities: bool | None


class Search:
    """Search for the cheapest method for one problem; `trials` holds all trials in the order in which they were run.

    `common` are the options that all trials have in common, and `wanted` is the largest error allowed. `max_nfev` and
    `output` are the arguments `max_nfev` and `t_eval` of `recommend`.
    """

    def __init__(
        self, problem: Problem, common: Mapping[str, Any], wanted: float, max_nfev: int | None, output: Any = None
    ) -> None:
        self.bench, self.wanted = Bench(problem, common, output), wanted
        self.asked = bool(common.get("invariants", problem.invariants))
        self.keeps = self.asked
        self.trials: list[Trial] = []
        self.kinds: dict[int, Kind] = {}
        self.notes: list[str] = []
        self.message, self.longest = "", 0
        self.look = self._look(max_nfev)
        self._find_truth()
        self.bench.most = LONGEST * self.longest

    def recommendation(self) -> Recommendation:
        """Return the cheapest method with its options and the reason; raise ValueError if none has the wanted error."""
        chosen = self._cheapest()
        if chosen is None and self.keeps:
            self.keeps = False
            why = self._smallest("with the projection the error stays at")
            self.message = f"the invariants are left out because no trial that keeps them has the wanted error: {why}"
            chosen = self._cheapest()
        if chosen is None:
            raise ValueError(
                f"recommend: no trial has an error of {self.wanted:g}: {self._smallest('the smallest was')}. Allow a "
                "larger error or a shorter interval."
            )
        if self.keeps:
            chosen = self._other_metric(chosen)
            plain = self._trial({**chosen.options, **PLAIN})
            if math.isfinite(plain.error):
                self.notes.append(f"Without the projection the error is {plain.error:.1e}.")
        stiff = self._say_that_it_is_stiff(chosen)
        if not stiff:
            self._say_what_binds(chosen)
        if self.message:
            warnings.warn(f"recommend: {self.message}", ProjectionWarning, stacklevel=3)
        return Recommendation(
            problem=self.bench.problem,
            options={
                **chosen.options,
                **{k: v for k, v in self.bench.common.items() if k not in chosen.options},
                **({} if self.bench.output is None else {"t_eval": self.bench.output}),
            },
            trial=chosen,
            wanted=self.wanted,
            share=self.bench.share,
            message=self.message,
            reason=" ".join([self._why(chosen), *self.notes]),
            trials=tuple(self.trials),
            stiff=stiff,
        )

    # --- preparation: size, steps, a reference solution ---

    def _look(self, max_nfev: int | None) -> Look:
        """Run once by `EIPDOP853` without projection, and return the `Look`; raise ValueError if the run fails.

        The run stops after about 1 / `FIRST_PART` of the evaluations that one trial may take (`max_nfev`, or else
        `MOST_NFEV`). If it stops before the end of the interval, all later trials end there too.
        """
        bench, problem = self.bench, self.bench.problem
        rtol = min(max(self.wanted, 1e-10), 1e-4)
        atol = 1e-3 * rtol * min(1.0, float(np.abs(problem.y0).max()) or 1.0)
        options = {**bench.common, "method": EIPDOP853, "rtol": rtol, "atol": atol}
        velocities, native, missing = _asked_of_the_field(Request.of(fun=problem, **options))
        if missing is not None:
            own = particle_invariants(missing.masses, missing.dimension)
            known = as_invariants(bench.common.get("invariants", problem.invariants))
            bench.common = {**bench.common, "invariants": (*known, *own)}
            self.notes.append("Momentum and angular momentum of the particles are kept too, by particle_invariants.")
        most = MOST_NFEV[native] if max_nfev is None else max_nfev
        steps = max(most // (FIRST_PART * EIPDOP853.TABLEAU.n_stages), 10)
        every = max(1, steps * problem.y0.size // MOST_SAVED)
        rows = iter(range(steps // every))

        def enough(t: float, y: np.ndarray, residuals: np.ndarray) -> bool:
            return next(rows, None) is None

        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            run = integrate(problem, **{**options, **PLAIN}, save_every=every, callback=enough)
        if not run.success:
            raise ValueError(f"recommend: a trial by EIPDOP853 with rtol={rtol:g} failed: {run.message}")
        if run.status == 1:
            bench.shorten(float(run.t[-1]), LOOKS)
        lengths = np.abs(np.diff(run.t)) / every
        lengths = lengths[2:-1] if lengths.size > 5 else lengths
        short, long = np.percentile(lengths, [5, 95])
        size = min(1.0, float(np.abs(run.y).max())) or 1.0
        return Look(size, float(np.median(lengths)), float(long / short), velocities)

    def _find_truth(self) -> None:
        """Store the reference states, of the tighter of two runs that agree; raise ValueError if no two do."""
        size, plain = self.look.size, Kind(EIPDOP853, size=self.look.size, options=PLAIN)
        found, enough = [self._reference(plain, REFERENCE_START * self.wanted)], AGREEMENT * self.wanted
        method, options = (EIPRKN12, LONG) if self.look.velocities is False else (EIPDOP853, {})
        if found[0][0] > enough and self.keeps:
            kept = self._reference(Kind(method, size=size, options=options), FINE_START)
            apart = difference(kept[1].y, found[0][1].y).max()
            if apart <= SAME * self.bench.share * found[0][0]:  # found[0][0] is for the end of the whole interval
                found.append(kept)
        if min(item[0] for item in found) > enough and method is EIPRKN12:
            found.append(self._reference(Kind(method, size=size, options=options | PLAIN), FINE_START))
        agreement, reference = min(found, key=lambda item: item[0])
        least = agreement / LEAST_AGREEMENT
        if least > self.wanted:
            hint = f"Pass error={least:.0e} or more, or a shorter interval." if least < 0.1 else "Shorten the interval."
            raise ValueError(
                f"recommend: an error of {self.wanted:g} cannot be reached or cannot be verified: two runs with the "
                f"smallest tolerances differ by {agreement:.1e} at the end, because rounding errors have grown to that "
                f"size or the motion is chaotic. {hint}"
            )
        self.bench.truth, self.bench.doubt = reference.y, agreement

    def _reference(self, kind: Kind, rtol: float) -> tuple[float, Outcome]:
        """Reduce the tolerance from `rtol` until two runs agree or rounding errors remain.

        Return the relative difference of the last two runs at the end of the interval, and the tighter of them.
        """
        rtol, wider, agreement = max(rtol, FINE_START), None, math.inf
        while True:
            value = kind.near(rtol)
            settings = kind.settings(value)
            done, before = self.bench.run(settings), agreement
            self.longest = max(self.longest, done.nfev)
            if done.trouble:
                return agreement, done if wider is None else wider
            if wider is not None:
                agreement = self.bench.judged(settings, wider, done.y).error
            if agreement <= AGREEMENT * self.wanted or value <= FINEST_RTOL or agreement > ROUNDED * before:
                return min(agreement, before), done
            wider, rtol = done, max(rtol * REFERENCE_STEP, FINEST_RTOL)

    # --- candidates ---

    def _cheapest(self) -> Trial | None:
        """Return the cheapest trial of all kinds that suit the problem, or None if none has the wanted error."""
        first = self._kind(EIPDOP853)
        chosen = self._tuned(first, self.wanted)
        if self.keeps and not any(trial.good for trial in self.trials):
            return None  # invariants that fail with one method fail with all methods
        rtol = self.wanted if chosen is None else chosen.options["rtol"]
        for kind, value in self._others(rtol):
            other = self._tuned(kind, value, math.inf if chosen is None else chosen.cost)
            if other is not None and (chosen is None or other.cost < CHEAPER * chosen.cost):
                chosen = other
        return chosen

    def _others(self, rtol: float) -> list[tuple[Kind, float]]:
        """Return each `Kind` to try after `EIPDOP853`, with the step or `rtol` at which its search starts."""
        look, found = self.look, []
        if look.velocities is False:
            found += [(self._kind(EIPRKN8, **LONG), rtol), (self._kind(EIPRKN12, **LONG), rtol)]
            if look.variation <= EVEN:
                found.append((self._kind(EIPRKN12, fixed=True, **LONG), 2 * look.step))
        else:
            found += [(self._kind(method), rtol) for method, least in LOW_ORDERS if self.wanted >= least]
        length = abs(self.bench.t_end - self.bench.t0)
        if look.velocities is not None and look.variation <= VERY_EVEN and length > LEAST_MULTISTEP * look.step:
            jacobian = self.bench.common.get("jacobian", self.bench.problem.jacobian)
            method, step = (EIPGJ12, look.step / 12) if jacobian is None else (EIPGJ14, look.step / 6)
            found.append((self._kind(method, fixed=True), step))
        return found

    def _kind(self, method: Any, *, fixed: bool = False, **options: Any) -> Kind:
        if self.asked and not self.keeps:
            options |= PLAIN
        length = abs(self.bench.times[-1] - self.bench.t0)
        return Kind(method, fixed, self.look.size, length / LEAST_STEPS if fixed else COARSEST_RTOL, options)

    def _tuned(self, kind: Kind, value: float, bound: float = math.inf) -> Trial | None:
        """Return the cheapest trial of a kind, from `value` of its step or tolerance on; None if none is good enough.

        The search ends if the kind costs much more than `bound` evaluations.
        """
        tried = tune(kind, value, self.wanted, self._trial, bound)
        for trial in tried:
            self.kinds[id(trial)] = kind
        chosen = best(tried, self.wanted)
        return None if chosen is None else self._with_output(chosen)

    def _with_output(self, chosen: Trial) -> Trial:
        """Replace `chosen` in `trials` by its copy from `Bench.with_output`, and return the copy."""
        counted = self.bench.with_output(chosen)
        self.trials[[trial is chosen for trial in self.trials].index(True)] = counted
        self.kinds[id(counted)] = self.kinds.pop(id(chosen))  # an object that is gone may pass its id on
        return counted

    def _trial(self, options: Mapping[str, Any]) -> Trial:
        self.trials.append(self.bench.trial(options))
        return self.trials[-1]

    def _other_metric(self, chosen: Trial) -> Trial:
        """Return the trial with another metric or blocks if that makes the run cheaper, else `chosen`."""
        for options in self._metrics():
            kind, trial = self.kinds[id(chosen)], self._trial({**chosen.options, **options})
            if not (trial.good and BETTER * trial.error <= chosen.error):
                continue
            value = chosen.options[kind.knob] * (AIM * self.wanted / max(trial.error, 1e-17)) ** (1 / kind.slope)
            better = self._tuned(replace(kind, options={**kind.options, **options}), value)
            if better is not None and better.cost < CHEAPER * chosen.cost:
                self.notes.append(f"{called(options)} divides the error by {chosen.error / trial.error:.2g}.")
                chosen = better
        return chosen

    def _metrics(self) -> list[dict[str, Any]]:
        """Return sets of options to try: other blocks and another metric, unless the problem or the user sets them."""
        problem, n = self.bench.problem, self.bench.problem.y0.size
        if problem.metric is not None or "metric" in self.bench.common:
            return []
        if any(item.subspaces for item in as_invariants(self.bench.common.get("invariants", problem.invariants))):
            return []  # these have their own metric
        found: list[dict[str, Any]] = []
        if problem.blocks is None and "blocks" not in self.bench.common and self.look.velocities is not None:
            found += [{"blocks": size} for size in (3, 2) if n % (2 * size) == 0 and n > 2 * size]
        return [*found, {"metric": "euclidean"}]

    # --- remarks ---

    def _say_that_it_is_stiff(self, chosen: Trial) -> bool:
        """Return True if an implicit method needs at most 1 / `STIFF` of the evaluations of `chosen`, and add a remark.

        Runs with fewer than `LEAST_BOUND` evaluations and complex states are not tested, and the result is False.
        """
        bench, share = self.bench, self.bench.share
        if chosen.nfev * share < LEAST_BOUND or np.iscomplexobj(bench.truth):
            return False
        implicit = implicit_run(bench, self.wanted, int(chosen.nfev * share / STIFF), self.keeps)
        if implicit is None:
            return False
        nfev = round(implicit.nfev / share)
        self.notes.append(
            "The equations are stiff: stability limits the steps of explicit methods. The implicit method EIPRadau "
            f"has an error of {implicit.error:.1e} with {nfev} evaluations, {chosen.nfev / nfev:.2g} times fewer. Use "
            f"method=EIPRadau, rtol={implicit.rtol:.2g}, atol={implicit.atol:.2g}, or EIPBDF, in `integrate`."
        )
        return True

    def _say_what_binds(self, chosen: Trial) -> None:
        """Test whether stability limits the steps of a run that is more accurate than wanted, and add a remark."""
        kind = self.kinds[id(chosen)]
        if chosen.error >= WINDOW * self.wanted or kind.fixed or chosen.nfev < LEAST_BOUND:
            return
        looser = self._trial(kind.settings(kind.near(LOOSER * chosen.options["rtol"])))
        if looser.nfev > FEWER * chosen.nfev:
            self.notes.append(
                "Stability limits the steps, and accuracy does not: an implicit method or a splitting may cost much "
                "less."
            )

    def _why(self, chosen: Trial) -> str:
        """Return a sentence that explains the choice of the method."""
        look = self.look
        if look.velocities is None:
            form = "The equations are not of the form q'' = a(t, q) with y = (q, v)"
        else:
            form = "The accelerations depend on velocities" if look.velocities else "The equations are q'' = a(t, q)"
        kind = self.kinds[id(chosen)]
        rivals = [trial for trial in self.trials if self._name(trial) not in ("", kind.name)]
        rival = best(rivals, self.wanted)
        ratio = math.inf if rival is None else rival.cost / chosen.cost
        nearly = "nearly " if ratio < 1 else ""  # the more usual method was preferred
        words = f"{form}, and the steps vary by a factor of {look.variation:.2g}: {kind.name} needs {nearly}the fewest "
        words += "evaluations" if rival is None else f"evaluations, {self._name(rival)} {ratio:.3g} times as many"
        return f"{words}."

    def _name(self, trial: Trial) -> str:
        """Return the name of a trial's kind, or an empty string if the trial only served as a comparison."""
        kind = self.kinds.get(id(trial))
        return "" if kind is None else kind.name

    def _smallest(self, words: str) -> str:
        """Return the smallest error of the trials after these words, or the trouble of the last trial if all failed."""
        good = [trial.error for trial in self.trials if trial.good]
        return f"{words} {min(good):.1e}" if good else self.trials[-1].trouble


def _asked_of_the_field(request: Request) -> tuple[bool | None, bool, Particles | None]:
    """Return the `velocities` of `Look`, whether all functions are called natively, and `Run.missing`.

    The start is checked as for a run with the invariants: a wrong gradient raises an error, and a quantity that the
    system does not conserve causes a warning.
    """
    ready = prepared(request)
    _, why_not = ready.system.functions(ready.run, None)
    calls, start = Counted(ready.system.derivative), ready.run.start
    with np.errstate(all="ignore"):
        try:
            velocities = depends_on_velocity(calls, start, "")
        except ValueError:
            velocities = None
    return velocities, why_not is None, ready.run.missing
