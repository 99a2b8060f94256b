"""Run random systems with random options for a while, and check the conditions that hold for every run.

    python -m tests.fuzz.systems --seconds 60

Each system is made from a number. A violation prints the number, the system and its options, and the command that runs
it again; the exit status is then 1.
"""

import argparse
import itertools
import math
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from functools import cached_property
from pathlib import Path
from unittest import mock

import numba
import numpy as np

from eip_scipy import Diagnostics, ProjectionWarning, ensemble

from .cases import TooManyCallsError, random_case

# Largest error of a reliable run relative to the run without projection.
FACTOR = 1e3
# Errors of the true states and rounding, in units of what the motion makes of a small change.
FLOOR = 1e-10
DIFFERENCES = "has no grad and allows no complex step"
NO_INVARIANT, WRONG_GRADIENT = "is not an invariant of this system", "gradient of invariant"
CLOCK_STEP = 0.3  # seconds
MOST_BREAKS = 3


class BrokenOffError(Exception):
    """Exception that replaces a crash."""


class Runs:
    """The runs of a case, each made on first use, with its warnings."""

    def __init__(self, case):
        self.case = case
        self.rng = np.random.default_rng([case.seed, 1])

    @cached_property
    def whole(self):
        """Return the run by `integrate`, every step saved."""
        return observed(lambda: self.case.integrate(save_every=1))

    @cached_property
    def plain(self):
        """Return the run without invariants, at the times of the truth."""
        options = {"invariants": (), "t_eval": self.case.times, "events": None, "project_initial": False}
        return observed(lambda: self.case.integrate(**options))

    @cached_property
    def sampled(self):
        """Return the run with invariants, at the same times."""
        return observed(lambda: self.case.integrate(t_eval=self.case.times, events=None))

    @cached_property
    def scipy(self):
        """Return the run by SciPy's `solve_ivp`, with its diagnostics and warnings."""
        record = Diagnostics()
        found = observed(lambda: self.case.solve_ivp(diagnostics=record, dense_output=True))
        found.diagnostics = record
        return found

    @cached_property
    def allowed(self):
        """Return the allowed error of a reliable run; infinite if there is no reference."""
        case = self.case
        if not case.regular or self.plain.status != 0:
            return math.inf
        tolerance = case.steps.get("rtol", 0.0)
        return FACTOR * case.error(self.plain.y) + tolerance + FLOOR * case.growth

    @property
    def checked(self):
        return bool(self.case.projection.get("check", True))

    @property
    def healthy(self):
        """Return whether the system is correct, and the steps resolve it."""
        return not self.case.sick and self.allowed < FACTOR * 1e-2


def observed(call):
    """Return the result of a call, with its warnings as `warned`."""
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        found = call()
    found.warned = warned
    return found


def same(one, other):
    """Compare bit for bit, except the sign of zero and the kinds of NaN."""
    return np.array_equal(one, other, equal_nan=True)


def different(one, other, *names):
    """Return the names of the numbers of two results that differ in bits."""
    for name in names:
        a, b = getattr(one, name), getattr(other, name)
        if not (same(a, b) if a is not None and b is not None else a is b):
            yield f"{name}: {_short(a)} and {_short(b)}"


def projected_rows(case, steps):
    """Return which of the states at the ends of steps are known to be projected."""
    every = case.projection.get("every", 1)
    return list(range(0, steps, every)) if isinstance(every, int) else [0]


def _short(value):
    a = np.asarray(value)
    return f"{value!r}" if a.size <= 8 else f"{a.dtype} {a.shape} ending with {a[..., -1]!r}"


def different_events(run, other):
    """Events of `solve_ivp` that `integrate` has not found too, up to the rounding of the roots."""
    span = np.ptp(run.t)
    for k, (found, expected) in enumerate(zip(run.t_events or (), other.t_events or (), strict=True)):
        for t, y in zip(expected, other.y_events[k], strict=True):
            near = np.flatnonzero(np.isclose(found, t, rtol=1e-13, atol=1e-13 * span))
            if not any(np.allclose(run.y_events[k][i], y, rtol=1e-9, atol=1e-9 * np.abs(y).max()) for i in near):
                yield f"event {k} at {t!r}: {y!r}; integrate found {found!r}"


# Conditions on runs. Each check yields the violations.


def finite(runs):
    """Check that success means finite numbers, times in order, and the requested end."""
    for name, run in (("saved", runs.whole), ("sampled", runs.sampled), ("solve_ivp", runs.scipy)):
        if not run.success:
            continue
        for part in ("t", "y", "invariants", "max_residual"):
            if part in run and not np.isfinite(run[part]).all():
                yield f"{name}: success, and {part} holds {run[part][~np.isfinite(run[part])][:3]}"
        t0, end = runs.case.t_span
        if not (np.diff(run.t) * np.sign(end - t0) > 0).all():
            yield f"{name}: times out of order"
        if run.status == 0 and run.t[-1] != end:
            yield f"{name}: status 0 at t = {run.t[-1]!r}, not at {end!r}"


def accurate(runs):
    """Check that a reliable run errs at most `FACTOR` times as much as the one without projection."""
    run = runs.sampled
    if run.trusted and (runs.checked or not runs.case.sick) and math.isfinite(runs.allowed):
        error = runs.case.error(run.y)
        if not error <= runs.allowed:
            yield (
                f"trusted, and its error is {error:.3g}; without projection {runs.case.error(runs.plain.y):.3g}, "
                f"growth {runs.case.growth:.3g}"
            )


def survives(runs):
    """Check that steps which resolve the motion neither fail nor become far more numerous with projection.

    Other directions and further iterations have no second tries where gradients are nearly parallel; they may fail.
    """
    usual = runs.case.projection.get("direction", "new") == "new" and runs.case.projection.get("iterations", 1) == 1
    if not (runs.healthy and usual):
        return
    if runs.whole.status < 0:
        yield f"failed: {runs.whole.message}"
    elif runs.sampled.nfev > 10 * runs.plain.nfev + 200:
        yield f"{runs.sampled.nfev} evaluations, {runs.plain.nfev} without projection"


def kept(runs):
    """Check that the invariants of saved states agree with `max_residual`."""
    run, case = runs.whole, runs.case
    if not run.success or not run.max_residual.size or case.compensated:
        return
    target = run.invariants[:, 0]
    off = np.abs(run.invariants[:, 1:] - target[:, None]).max(axis=1, initial=0.0)
    rounding = 1e-15 * np.abs(run.invariants).max(axis=1)
    if not (off <= run.max_residual + rounding).all() and run.status == 0:
        yield f"saved states are off by {off}, max_residual says {run.max_residual}"


def quiet(runs):
    """Check that there are no warnings, except those of numerical gradients and of doubts in the run."""
    if runs.healthy:
        for warned in (*runs.whole.warned, *runs.scipy.warned):
            if DIFFERENCES not in str(warned.message) and not issubclass(warned.category, ProjectionWarning):
                yield f"{warned.category.__name__}: {warned.message}"


def told(runs):
    """Check that `trusted`, the warning, the message and the diagnostics agree."""
    for name, run in (("integrate", runs.whole), ("solve_ivp", runs.scipy)):
        record, warned = run.diagnostics, run.warned
        doubts = [str(w.message) for w in warned if issubclass(w.category, ProjectionWarning)]
        early = [w for w in warned if NO_INVARIANT in str(w.message)]
        # A solver does not see that an event has ended its run: what all corrections say together stands in the
        # diagnostics.
        unseen = name == "solve_ivp" and run.status == 1 and not record.trusted
        if record.trusted != (run.status >= 0 and not doubts and not early) and not unseen:
            yield (
                f"{name}: trusted is {record.trusted}, status {run.status}, {len(doubts)} ProjectionWarnings, "
                f"{len(early)} others; {record.message!r}"
            )
        if len(doubts) > 1:
            yield f"{name}: {len(doubts)} ProjectionWarnings in one run"
        if name == "integrate" and run.trusted != record.trusted:
            yield f"trusted is {run.trusted} in the result and {record.trusted} in its diagnostics"
        if doubts and name == "integrate" and doubts[0].partition(": ")[2] not in run.message:
            yield f"the message {run.message!r} does not have the warning {doubts[0]!r}"
        if bool(doubts) and not record.message:
            yield f"{name}: warned of {doubts[0]!r}, and Diagnostics.message is empty"


def through_scipy(runs):
    """Check that `solve_ivp` takes the steps of `integrate`, with the same bits; SciPy's own if nothing is kept."""
    case, run, other = runs.case, runs.whole, runs.scipy
    if case.compensated:
        return
    if other.t.size != run.t.size or other.status != run.status:
        yield f"{other.t.size} times and status {other.status}, integrate {run.t.size} and {run.status}"
        return
    if not case.invariants and "h" not in case.steps:
        # At the same times: rounding in the estimates of small errors moves the ends of steps.
        states = other.sol(np.clip(run.t, other.t.min(), other.t.max()))
        if not np.allclose(states, run.y, rtol=1e-9, atol=1e-9 * case.size.max()):
            yield "other states, where nothing is kept"
        return
    # Between two projections `integrate` saves projected copies of its states, and `solve_ivp` the states; what events
    # look at then differs too, and with it the last state of a run that an event ends.
    steps = run.t.size - (run.status == 1)
    rows = projected_rows(case, steps)
    if not (same(run.t[:steps], other.t[:steps]) and same(run.y[:, rows], other.y[:, rows])):
        yield f"y: {_short(run.y[:, rows])} and {_short(other.y[:, rows])}"
    if len(rows) == steps:
        yield from different_events(run, other)


def dense(runs):
    """Check that dense output meets the states at the ends of steps, and that `t_eval` is dense output."""
    run, case = runs.scipy, runs.case
    if run.t.size < 2:  # no step was taken: nothing in between
        return
    # One by one: several times in one step, the end by an event among them, are a matrix product, which rounds
    # otherwise.
    alone, together = np.column_stack([run.sol(t) for t in run.t]), run.sol(run.t)
    if not same(alone, run.y):
        yield f"sol(t) is not y at the times {run.t[np.flatnonzero((alone != run.y).any(axis=0))[:3]]}"
    if not np.allclose(together, alone, rtol=1e-13, atol=1e-13 * np.abs(run.y).max()):
        yield f"sol of all times at once differs by {np.abs(together - alone).max()}"
    projected = case.invariants and case.projection.get("every", 1) == 1  # else `solve_ivp` hands out other states
    if run.status == 0 and not (case.compensated or case.events) and runs.sampled.status == 0 and projected:
        found = np.column_stack([run.sol(t) for t in case.times])
        if not same(found, runs.sampled.y):
            yield f"sol and t_eval differ by {np.abs(found - runs.sampled.y).max()}"


def resumed(runs, *, compiled=False):
    """Check that a run that is stopped repeatedly and resumed equals the whole one."""
    whole, case = runs.whole, runs.case
    broken, kinds = 0, [_at_a_row] if compiled else [_at_a_row, _at_a_call]
    with tempfile.TemporaryDirectory() as folder, mock.patch("time.perf_counter", _hasty_clock()):
        options = {"save_every": 1, "checkpoint": Path(folder) / "run", "resume": True, "compiled": compiled}
        for _ in range(MOST_BREAKS):
            breaking = kinds[runs.rng.integers(len(kinds))](runs)
            try:
                observed(lambda more=breaking: case.integrate(**options, **more))
            except BrokenOffError:
                broken += 1
        run = observed(lambda: case.integrate(**options))
    found = [*different(whole, run, *BITS), *different_events(whole, run)]
    found += different(whole.diagnostics, run.diagnostics, *COUNTS)
    if run.message.split(" (")[0] != whole.message.split(" (")[0]:
        found.append(f"{run.message!r} and {whole.message!r}")
    for text in found:
        yield f"broken off {broken} times, {run.message!r}: {text}"


BITS = ("t", "y", "invariants", "max_residual", "status", "nfev", "njev", "nlu", "success", "trusted", "h")
COUNTS = ("n_projections", "n_skipped", "n_rank_reduced", "n_rejected_projections", "max_correction")


def _hasty_clock():
    """Clock that advances by a large step each time it is read: checkpoints are due between any two steps."""
    read = itertools.count()
    return lambda: CLOCK_STEP * next(read)


def _at_a_row(runs):
    """Return options that stop the run at a saved state."""
    left = int(runs.rng.integers(runs.whole.t.size + 1))

    def stop(t, y, residuals):
        nonlocal left
        left -= 1
        if left < 0:
            raise BrokenOffError

    return {"callback": stop}


def _at_a_call(runs):
    """Return options that stop the run inside a step."""
    left, fun = int(runs.rng.integers(1, runs.whole.nfev + 5)), runs.case.fun

    def failing(*arguments):
        nonlocal left
        left -= 1
        if left < 0:
            raise BrokenOffError
        return fun(*arguments)

    return {"fun": failing}


def members(runs, **options):
    """Check that a member of an ensemble equals the single run."""
    case = runs.case
    if any(not event.terminal for event in case.events):
        return
    starts = np.tile(case.system.y0, (2, 1))
    if all(item.target is None for item in case.invariants):
        starts[0] += 1e-3 * case.size * runs.rng.standard_normal(case.size.size)
    given = {**case.options, "t_eval": case.times, **options}
    run = observed(lambda: ensemble(**{case.takes: case.fun}, t_span=case.t_span, y0s=starts, **given))
    if any(TooManyCallsError.__name__ in message for message in run.message):  # calls are counted for both together
        return
    alone = runs.whole
    # The start is checked for the first member only; the same report may come later for the others.
    checked = any(text in alone.message for text in (NO_INVARIANT, WRONG_GRADIENT))
    until = "; not to be trusted" if checked and not run.trusted[1] else " ("
    end = alone.t[-1], alone.status, alone.message.split(until)[0]
    found = run.t[1], run.status[1], run.message[1].split(until)[0]
    if found != end or not same(run.y[1], alone.y[:, -1]):
        yield f"the last member: {found}, {run.y[1]}; alone: {end}, {alone.y[:, -1]}"
    # Checks after the start are made in single runs only.
    if run.trusted[1] != alone.trusted and not (checked and run.trusted[1]):
        yield f"the last member: trusted is {run.trusted[1]}, {run.message[1]!r}; alone: {alone.message!r}"
    if alone.status == 0 and not case.events and not same(run.trajectories[1], runs.sampled.y):
        yield "other trajectories"


def native(runs):
    """Check that compiled runs have the bits of interpreted ones, also stopped or as members."""
    case, whole = runs.case, runs.whole
    if not case.native or numba.config.DISABLE_JIT:
        return
    run = observed(lambda: case.integrate(save_every=1, compiled=True))
    yield from different(whole, run, *BITS)
    yield from different(whole.diagnostics, run.diagnostics, *COUNTS)
    one, other = ([str(w.message) for w in made.warned] for made in (run, whole))
    if one != other:
        yield f"warned of {one}, interpreted of {other}"
    yield from resumed(runs, compiled=True)
    yield from members(runs, compiled=True)


CHECKS = (finite, accurate, survives, kept, quiet, told, through_scipy, dense, resumed, members, native)


def look_at(seed):
    """Run the case of that number; what was violated, and how. None: it takes too long, with and without projection."""
    case = random_case(seed)
    runs, wrong = Runs(case), []
    try:
        if runs.plain.status < 0 and "h" not in case.steps:
            return None, []
        if case.sick:  # each step may be moved by far more than the tolerance: steps get ever shorter
            _ = runs.whole, runs.sampled, runs.scipy
    except TooManyCallsError:
        return None, []
    for check in CHECKS:
        try:
            wrong += [(check.__name__, text) for text in check(runs)]
        except Exception:
            wrong.append((check.__name__, traceback.format_exc(limit=-6)))
    return runs, wrong


def main(arguments=None):
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz.systems", description=__doc__.partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=math.inf, help="stop after this number of seconds")
    parser.add_argument("--count", type=int, default=None, help="stop after this number of systems")
    parser.add_argument("--seed", type=int, default=0, help="the number of the first system")
    given = parser.parse_args(arguments)
    if given.count is None and math.isinf(given.seconds):
        given.seconds = 60.0
    count, begin, doubted, last = Counter(), time.monotonic(), [], given.seed
    for seed in itertools.count(given.seed):
        if time.monotonic() - begin > given.seconds or seed - given.seed == given.count:
            break
        last = seed
        runs, wrong = look_at(seed)
        if runs is None:
            count["left out as endless"] += 1
            continue
        count.update({"systems": 1, "regular": runs.case.regular, "with a false invariant": runs.case.sick})
        count.update({runs.case.method: 1, "healthy": runs.healthy, "violations": len(wrong)})
        if not wrong and runs.healthy and not runs.whole.trusted:
            doubted.append(seed)
        for name, text in wrong:
            print(f"VIOLATION of {name!r} by system {seed}\n  {runs.case}\n  {text}")
            print(f"  again: python -m tests.fuzz.systems --seed {seed} --count 1", flush=True)
    print(f"systems {given.seed} to {last} in {time.monotonic() - begin:.0f} s: {dict(count)}")
    print(f"not trusted, and nothing wrong was known of them: {len(doubted)} {doubted[:20]}")
    print(f"violations: {count['violations']}")
    return 1 if count["violations"] else 0


if __name__ == "__main__":
    sys.exit(main())
