"""Adaptive steps with invariants: every option in both drivers, gains, and failures of runs."""

import math
import warnings

import numpy as np
import pytest
from numba import njit
from scipy.integrate import solve_ivp
from systems import H_USES_F, VOLTERRA, H, L, energy, energy_gradient, jit_orbit, lotka_volterra, orbit, pericentre

from eip_scipy import (
    EIPDOP853,
    EIPRK2,
    EIPRK3,
    EIPRK4,
    EIPRK5,
    EIPRK23,
    EIPRK45,
    EIPRKN12,
    Diagnostics,
    Invariant,
    integrate,
)

EPS = np.finfo(float).eps
METHODS = [EIPRK2, EIPRK3, EIPRK4, EIPRK5, EIPRK23, EIPRK45, EIPDOP853]
second_order = pytest.param(EIPRK2, marks=[pytest.mark.nightly, pytest.mark.slow])  # in thousands of steps
methods = pytest.mark.parametrize("method", [second_order, *METHODS[1:]], ids=lambda m: m.__name__)
E = 0.6
Y0 = pericentre(E)


def by_scipy(fun, t_span, y0, *, method=EIPRK45, **options):
    d = Diagnostics()
    sol = solve_ivp(fun, t_span, y0, method=method, **{"diagnostics": d, **options})
    sol.diagnostics, sol.max_defect = d, d.max_defect
    return sol


def by_integrate(fun, t_span, y0, *, method=EIPRK45, **options):
    saved = {} if "t_eval" in options else {"save_every": 1}
    return integrate(fun, t_span, y0, method=method, **{**saved, **options})


both = pytest.mark.parametrize("driver", [by_scipy, by_integrate], ids=["solve_ivp", "integrate"])


# Adaptive steps with projection work, and improve the results.


@both
@methods
@pytest.mark.parametrize("t_span", [(0.0, 10.0), (10.0, 0.0)], ids=["forward", "backward"])
def test_invariants_are_kept(driver, method, t_span):
    """No h is needed; residuals of O(h^(2p + 2)) are below the local error, far below the tolerance."""
    options = {"method": method, "rtol": 1e-6, "atol": 1e-9}
    run = driver(orbit, t_span, Y0, invariants=[H, L], **options)
    assert run.status == 0
    assert run.t[-1] == t_span[1]
    assert (np.diff(run.t) * np.sign(t_span[1] - t_span[0]) > 0).all()
    assert len(set(np.round(np.diff(run.t), 12))) > 5, "steps of one length"
    assert (run.max_defect < 1e-9).all()
    for item in (H, L):
        drift = np.abs([item.fun(t, y) - item.fun(0, Y0) for t, y in zip(run.t, run.y.T, strict=True)])
        assert drift.max() < 1e-9
    plain = driver(orbit, t_span, Y0, **options)
    assert np.abs(energy(0, plain.y[:, -1]) - energy(0, Y0)) > 1e-8


@methods
def test_error_goes_with_the_tolerance(method):
    """A tolerance of 0.1 rtol needs 10^(1 / (p_hat + 1)) times the steps and reduces the error."""
    exact = solve_ivp(orbit, (0, 10), Y0, method="DOP853", rtol=3e-14, atol=1e-16).y[:, -1]
    errors, steps = [], []
    # DOP853 needs small tolerances to leave its first steps behind.
    for rtol in (1e-7, 1e-10) if method is EIPDOP853 else (1e-4, 1e-7):
        run = by_scipy(orbit, (0, 10), Y0, method=method, rtol=rtol, atol=rtol * 1e-3, invariants=[H, L], blocks=2)
        errors.append(np.abs(run.y[:, -1] - exact).max())
        steps.append(len(run.t))
    assert errors[1] < errors[0] / 30
    order = method.TABLEAU.error_estimator_order
    assert math.log(1e3) / math.log(steps[1] / steps[0]) == pytest.approx(order + 1, rel=0.25)


@methods
def test_step_control_is_that_of_the_raw_step(method):
    """The estimate sees the step before its projection: about as many steps with invariants as without."""
    with_them = by_scipy(orbit, (0, 20), Y0, method=method, rtol=1e-5, invariants=[H, L])
    without = by_scipy(orbit, (0, 20), Y0, method=method, rtol=1e-5)
    assert len(with_them.t) == pytest.approx(len(without.t), rel=0.2)


@both
def test_max_step_and_first_step_are_obeyed(driver):
    run = driver(orbit, (0, 10), Y0, invariants=H, max_step=0.07, first_step=0.05)
    steps = np.diff(run.t)
    assert steps[0] == pytest.approx(0.05)
    assert steps.max() <= 0.07 + 1e-15
    assert steps.max() > 0.069
    run = driver(orbit, (0, 10), Y0, invariants=H, first_step=5.0)
    assert run.t[1] < 1.0


# Options, in both drivers.

OPTIONS = {
    "no invariants": {},
    "one": {"invariants": H},
    "two": {"invariants": [H, L]},
    "rtol by component": {"invariants": H, "rtol": [1e-3, 1e-4, 1e-5, 1e-6]},
    "atol by component": {"invariants": H, "atol": [1e-3, 1e-4, 1e-5, 1e-6]},
    "metric error": {"invariants": [H, L], "metric": "error"},
    "metric euclidean": {"invariants": [H, L], "metric": "euclidean"},
    "metric weights": {"invariants": [H, L], "metric": [1.0, 1.0, 0.3, 0.3]},
    "euclidean, every": {"invariants": [H, L], "metric": "euclidean", "every": 3},
    "several": {"invariants": [H, L], "every": 2, "iterations": 2, "blocks": 2, "reuse_f": False, "max_step": 0.5},
    "blocks": {"invariants": [H, L], "blocks": 2},
    "blocks by index": {"invariants": [H, L], "blocks": [[0, 1], [2, 3]]},
    "frame": {"invariants": H, "frame": ([[0.0, 0.0, 1.0, 0.0]], [[0.0], [0.0], [1.0], [0.0]])},
    "direction old": {"invariants": [H, L], "direction": "old"},
    "direction midpoint": {"invariants": [H, L], "direction": "midpoint"},
    "iterations": {"invariants": [H, L], "iterations": 4},
    "every": {"invariants": [H, L], "every": 5},
    "reuse_f": {"invariants": [H, L], "reuse_f": False},
    "uses_f": {"invariants": [H_USES_F, L]},
    "check": {"invariants": [H, L], "check": False},
    "project_initial": {
        "invariants": Invariant(energy, energy_gradient, target=-0.45, name="H"),
        "project_initial": True,
    },
    "target": {"invariants": Invariant(energy, energy_gradient, target=-0.5, name="H")},
    "first_step": {"invariants": H, "first_step": 0.01},
    "max_step": {"invariants": H, "max_step": 0.1},
}
# One of the last three options is the default, one has no effect in a correct run, and the run is refused without the
# third.
WITHOUT_EFFECT = "no invariants", "one", "two", "uses_f", "target", "metric error", "check", "project_initial"


@methods
@pytest.mark.parametrize("option", OPTIONS)
def test_both_drivers_take_every_option(method, option):
    """Both drivers call the same functions, take the same steps to round-off, and keep the invariants."""
    options = {"rtol": 1e-4, "atol": 1e-6, **OPTIONS[option]}
    one, other = (driver(orbit, (0.0, 6.0), Y0, method=method, **options) for driver in (by_scipy, by_integrate))
    assert one.status == other.status == 0
    assert one.nfev == other.nfev
    assert len(one.t) == len(other.t)
    if "invariants" in options:
        np.testing.assert_array_equal(one.t, other.t)
        # solve_ivp shows the start as it was given.
        np.testing.assert_array_equal(one.y[:, 1:], other.y[:, 1:])
        if option == "project_initial":
            assert energy(0, other.y[:, 0]) == pytest.approx(-0.45, abs=1e-14)
            np.testing.assert_array_equal(one.y[:, 0], Y0)
        assert (one.njev, one.nlu) == (other.njev, other.nlu)
        assert one.njev > 0
        target = options["invariants"].target if option in ("project_initial", "target") else energy(0, Y0)
        assert abs(energy(0, one.y[:, -1]) - target) < 1e-5
    else:
        np.testing.assert_allclose(one.y, other.y, rtol=0, atol=1e-3 * options["rtol"])
    if option not in WITHOUT_EFFECT and method not in (EIPRK2, EIPRK3, EIPRK5):  # for which reuse_f does nothing
        bare = {"invariants": options["invariants"], "rtol": 1e-4, "atol": 1e-6}
        without = by_scipy(orbit, (0.0, 6.0), Y0, method=method, **bare)
        assert not np.array_equal(without.y[:, -1], one.y[:, -1])


@both
def test_every_projects_each_kth_accepted_step_and_the_last(driver):
    run = driver(orbit, (0, 6), Y0, invariants=[H, L], every=4, rtol=1e-6, atol=1e-9)
    n = len(run.t) - 1
    assert run.diagnostics.n_projections + run.diagnostics.n_skipped == len([k for k in range(1, n) if k % 4 == 0]) + 1


@both
@pytest.mark.parametrize(
    ("method", "step"), [(EIPRK45, {"rtol": 1e-6, "atol": 1e-9}), (EIPRK4, {"h": 0.02}), (EIPRKN12, {"h": 0.2})]
)
def test_every_hands_out_copies_on_the_manifold(driver, method, step):
    """Rows, samples, events and dense output between two projections satisfy the invariants."""
    every = {"method": method, "invariants": [H, L], "every": 4, **step}
    times = np.linspace(0, 6, 43)

    def crossing(t, y):
        return y[0]

    rows = driver(orbit, (0, 6), Y0, **every)
    run = driver(orbit, (0, 6), Y0, t_eval=times, events=crossing, dense_output=True, **every)
    assert run.y_events[0].size
    dense = run.sol(np.linspace(0, 6, 101))
    for states in (rows.y, run.y, dense, run.y_events[0].T):
        np.testing.assert_allclose([energy(0, y) for y in states.T], energy(0, Y0), rtol=0, atol=1e-11)
    np.testing.assert_array_equal(run.sol(rows.t[1:]), rows.y[:, 1:])


@both
@methods
def test_zero_length_interval(driver, method):
    options = {"method": method, "dense_output": True, "events": lambda t, y: y[0]}
    run = driver(orbit, (2.0, 2.0), Y0, invariants=[H, L], **options)
    assert run.status == 0
    assert set(run.t.tolist()) == {2.0}
    assert (run.y == Y0[:, None]).all()
    assert run.njev == run.t_events[0].size == 0
    np.testing.assert_array_equal(run.sol(2.0), Y0)
    with pytest.raises(ValueError, match="`first_step` exceeds bounds"):
        driver(orbit, (2.0, 2.0), Y0, first_step=0.1)


# Wrong values.


@both
@pytest.mark.parametrize("rtol", [1e-20, 0.0, [1e-3, 1e-20, 1e-3, 1e-3]])
def test_rtol_too_small_warns_as_scipy_s(driver, rtol):
    least = 100 * EPS
    with pytest.warns(UserWarning, match=r"At least one element of `rtol` is too small\. Setting `rtol = np") as record:
        run = driver(orbit, (0, 0.1), Y0, rtol=rtol, invariants=H)
    assert len(record) == 1
    assert record[0].filename == __file__ or "scipy" in record[0].filename
    one = driver(orbit, (0, 0.1), Y0, rtol=np.maximum(rtol, least), invariants=H)
    np.testing.assert_array_equal(run.y, one.y)


@both
def test_invariants_from_an_iterator(driver):
    """Invariants are read once, not first for their presence and then for their values."""
    run, same = (driver(orbit, (0, 1), Y0, invariants=given) for given in (iter([H, L]), [H, L]))
    assert run.diagnostics.names == ("energy", "momentum")
    np.testing.assert_array_equal(run.y, same.y)


# Endless intervals.


@both
@pytest.mark.parametrize("sign", [1, -1])
def test_endless_interval_with_a_terminal_event(driver, sign):
    def far_side(t, y):
        return y[0] + 1.5

    far_side.terminal = True
    options = {"rtol": 1e-8, "atol": 1e-11, "invariants": [H, L], "events": far_side}
    run = driver(orbit, (0.0, sign * np.inf), Y0, **options)
    assert run.status == 1
    assert run.message.startswith("A termination event occurred.")
    eccentric = math.acos(-1.5 + E)  # x = cos u - e, t = u - e sin u
    assert run.t[-1] == pytest.approx(sign * (eccentric - E * math.sin(eccentric)), abs=1e-5)
    assert run.t_events[0].size == 1
    np.testing.assert_array_equal(run.y[:, -1], run.y_events[0][0])


def test_endless_interval_without_one():
    with pytest.raises(ValueError, match="t_span must be finite unless a terminal event ends the run"):
        integrate(orbit, (0.0, np.inf), Y0, method=EIPRK45)
    with pytest.raises(ValueError, match="t_span must be finite"):
        integrate(orbit, (0.0, np.inf), Y0, method=EIPRK45, events=lambda t, y: y[0])


# Failures: rejected, retried, reported, everything kept.


@both
@pytest.mark.filterwarnings("ignore:.*not to be trusted:eip_scipy.ProjectionWarning")  # nor is it
@pytest.mark.parametrize("method", [EIPRK2, EIPRK23, EIPRK4, EIPRK45], ids=lambda m: m.__name__)
def test_invariant_nan_after_a_trial_step_is_mended_by_shorter_ones(driver, method):
    """A loose first step of 2 takes Lotka-Volterra to u < 0: it is rejected, h x 0.25, and the run continues."""
    options = {"rtol": 0.5, "atol": 5.0, "first_step": 2.0, "invariants": VOLTERRA, "metric": "euclidean"}
    run = driver(lotka_volterra, (0, 20), [4.0, 2.0], method=method, **options)
    assert run.status == 0
    assert (run.y > 0).all()
    assert run.diagnostics.n_rejected_projections >= 1
    assert run.t[1] - run.t[0] < 1.0
    assert np.isfinite(run.max_defect).all()
    assert np.ptp([VOLTERRA.fun(0, u) for u in run.y.T]) < 3.0


def turn(t, y):
    return np.array([y[1], -y[0]])


@both
def test_shorter_and_shorter_at_most_ten_times(driver):
    """An invariant that nothing meets after t = 0: trials of h, h / 4, h / 16 ..., ten retries, then the end."""
    asked = []

    def value(t, y):
        asked.append(t)
        return y @ y if t == 0 else math.nan

    item = Invariant(value, lambda t, y: 2 * y, name="stubborn")
    run = driver(turn, (0, 1), [1.0, 2.0], rtol=0.5, atol=1.0, first_step=0.5, invariants=item, check=False)
    assert run.status == -1
    assert not run.success
    place = f"projection failed at t={0.5 / 4**10:g}"
    assert run.message.startswith(f"{place}: invariant 'stubborn', residual nan, rank 1 of 1")
    np.testing.assert_array_equal(np.unique([t for t in asked if t > 0])[::-1], 0.5 / 4.0 ** np.arange(11))
    assert run.diagnostics.n_rejected_projections == 11
    np.testing.assert_array_equal(run.t, [0.0])
    np.testing.assert_array_equal(run.y, [[1.0], [2.0]])


@both
def test_impossible_manifold(driver):
    """A circle that shrinks from t = 0.45 on and vanishes at t = 0.7 ends the run with a report."""
    shrinking = Invariant(lambda t, y: y @ y + 20 * max(t - 0.45, 0.0), lambda t, y: 2 * y, name="shrinking")
    run = driver(turn, (0, 1), [1.0, 2.0], max_step=0.1, invariants=shrinking, check=False)
    assert run.status == -1
    assert run.message.startswith("projection failed at t=")
    assert "invariant 'shrinking'" in run.message
    assert "rank 1 of 1" in run.message
    assert 0.45 < run.t[-1] < 1.0
    assert np.isfinite(run.y).all()
    before = run.t < 0.45
    assert before.sum() > 4
    np.testing.assert_allclose((run.y[:, before] ** 2).sum(axis=0), 5.0, rtol=1e-9)
    assert run.diagnostics.n_rejected_projections >= 11
    # The diagnostics hold the residual of the states that were accepted although no state meets the level.
    assert run.max_defect[0] >= 0.9 * 20 * max(run.t[-1] - 0.7, 0.0)


@both
def test_failed_projection_counts_only_in_a_row(driver):
    """Occasional failures are recovered each time: many steps are rejected, and the run ends well."""
    asked = []

    def value(t, y):
        asked.append(t)
        return math.nan if len(asked) % 7 == 0 else y @ y

    flaky = Invariant(value, lambda t, y: 2 * y, target=5.0, name="flaky")
    run = driver(cubic, (0, 30), [1.0, 2.0], invariants=flaky, check=False, rtol=1e-5)
    assert run.status == 0
    assert run.diagnostics.n_rejected_projections > 11
    np.testing.assert_allclose((run.y**2).sum(axis=0), 5.0, rtol=1e-5)


def cubic(t, y):
    """Rotation by an angle that goes with the state: no step keeps the radius."""
    return (1 + y[0] ** 2) * turn(t, y)


@both
@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("invariants", [(), [H]], ids=["plain", "projected"])
def test_rhs_not_finite(driver, bad, invariants):
    """From t = 1 on: the step shrinks towards it, then status -1 that names the time; everything before is kept."""

    def fun(t, y):
        return orbit(t, y) if t < 1.0 else np.full(4, bad)

    with np.errstate(all="ignore"):
        run = driver(fun, (0, 2), Y0, invariants=invariants)
    assert run.status == -1
    assert run.message.startswith("fun returned a non-finite value at t=1")
    assert 0.99 < run.t[-1] < 1.0
    assert np.isfinite(run.y).all()
    assert len(run.t) > 3
    clean = driver(orbit, (0, 2), Y0, invariants=invariants)
    first = np.count_nonzero(clean.t < 0.5)
    np.testing.assert_array_equal(run.y[:, :first], clean.y[:, :first])


@both
@pytest.mark.parametrize("invariants", [(), [H]], ids=["plain", "projected"])
def test_rhs_not_finite_at_the_start(driver, invariants):
    calls = []

    def fun(t, y):
        calls.append(t)
        assert len(calls) < 1000, "it hangs, as SciPy does"
        return np.full(4, np.nan)

    with np.errstate(all="ignore"):
        run = driver(fun, (0, 2), Y0, invariants=invariants, check=False)
    assert run.status == -1
    assert run.message.startswith("fun returned a non-finite value at t=0")
    assert run.t.tolist() == [0.0]
    np.testing.assert_array_equal(run.y[:, 0], Y0)


@both
def test_rhs_not_finite_at_one_stage_only_is_passed_by(driver):
    """A hole that the shrunk step misses."""
    hole = []

    def fun(t, y):
        if 0.5 < t < 0.6 and not hole:
            hole.append(t)
            return np.full(4, np.nan)
        return orbit(t, y)

    run = driver(fun, (0, 2), Y0, invariants=[H], max_step=0.05)
    assert hole
    assert run.status == 0
    assert abs(energy(0, run.y[:, -1]) - energy(0, Y0)) < 1e-4


@both
@methods
@pytest.mark.parametrize("invariants", [(), [Invariant(lambda t, y: 1.0, lambda t, y: np.zeros(1))]])
def test_overflow_without_a_flood_of_warnings(driver, method, invariants):
    """y' = 1e200 y: a handful of warnings at most, none of them of the package's own lines, and a clean end."""
    with warnings.catch_warnings(record=True) as record:
        warnings.simplefilter("default")  # one per line of code, as users see them
        run = driver(lambda t, y: 1e200 * y, (0, 2), [1.0], method=method, invariants=invariants, check=False)
    assert run.status == -1
    assert np.isfinite(run.y).all()
    ours = [str(w.message) for w in record if "eip_scipy" in w.filename and not w.filename.startswith(__file__)]
    assert not ours
    assert len(record) <= 10


# Diagnostics.


@both
@methods
def test_counts_of_projections(driver, method):
    run = driver(orbit, (0, 6), Y0, method=method, invariants=[H, L])
    d = run.diagnostics
    assert d.names == ("energy", "momentum")
    assert d.n_projections + d.n_skipped == len(run.t) - 1
    assert d.n_projections > 0.5 * (len(run.t) - 1)
    assert d.n_rejected_projections == 0
    assert run.njev == len(run.t) - 1
    assert run.nlu - d.n_projections in range(d.n_softened, 3 * d.n_softened + 1)
    at_steps = np.array([[abs(item.fun(0, y) - item.fun(0, Y0)) for item in (H, L)] for y in run.y.T])
    np.testing.assert_allclose(d.max_defect, at_steps.max(axis=0), rtol=0, atol=1e-15)
    np.testing.assert_allclose(d.last_defect, at_steps[-1], rtol=0, atol=1e-15)
    assert 0 < d.max_correction < 1e4
    assert "2 invariants" in repr(d) or "energy" in repr(d)


@both
def test_max_correction_without_the_error_metric(driver):
    """The bound is measured in local errors, which the euclidean metric does not use."""
    run = driver(orbit, (0, 6), Y0, invariants=[H, L], metric="euclidean")
    assert math.isnan(run.diagnostics.max_correction)


@both
def test_nfev_is_the_number_of_calls(driver):
    for method in METHODS:
        for options in ({}, {"invariants": [H, L]}, {"invariants": [H_USES_F], "reuse_f": False}, {"every": 3}):
            calls = []

            def fun(t, y, calls=calls):
                calls.append(t)
                return orbit(t, y)

            check = {} if "invariants" not in options else {"check": False}
            run = driver(fun, (0, 6), Y0, method=method, **options, **check)
            assert run.nfev == len(calls), (method, options)


# Memory, saving, callbacks.


@pytest.mark.parametrize("compiled", [pytest.param(True, marks=pytest.mark.needs_jit), False])
def test_memory_bound_of_an_adaptive_run(compiled):
    """The number of steps is not known before: the run ends when the rows would outgrow the bound, with all of them."""
    fun = njit(lambda t, y: np.array([y[1], -y[0]]))
    square = Invariant(njit(lambda t, y: y[0] ** 2 + y[1] ** 2), njit(lambda t, y: 2 * y), name="S")
    options = {"method": EIPRK45, "invariants": square, "max_step": 0.01, "compiled": compiled}
    # A row: time, two components, one invariant.
    bound = 8 * 4 * 3000
    with pytest.raises(MemoryError, match="increase save_every or max_bytes") as caught:
        integrate(fun, (0, 1e4), [1.0, 2.0], save_every=1, max_bytes=bound, **options)
    partial = caught.value.partial
    assert partial.status == -1
    assert 1000 <= len(partial.t) <= 3000
    steps = np.diff(partial.t)
    assert steps.max() <= 0.01 + 1e-12
    assert (steps > 0).all()
    np.testing.assert_allclose((partial.y**2).sum(axis=0), 5.0, rtol=1e-12)
    assert partial.invariants.shape == (1, len(partial.t))
    run = integrate(fun, (0, 1e4), [1.0, 2.0], save_every=1000, max_bytes=bound, **{**options, "max_step": 1.0})
    assert run.status == 0


def test_t_eval_is_refused_before_the_run():
    calls = []
    with pytest.raises(MemoryError, match="needs"):
        integrate(
            lambda t, y: calls.append(t) or -y, (0, 1), [1.0], method=EIPRK45, t_eval=np.linspace(0, 1, 1000),
            max_bytes=100,
        )  # fmt: skip
    assert len(calls) < 10


def test_rows_grow_beyond_the_first_thousand():
    options = {"method": EIPRK23, "rtol": 1e-8, "atol": 1e-10, "invariants": H}
    sol = solve_ivp(orbit, (0, 12), Y0, **options)
    assert len(sol.t) > 2100
    run = integrate(orbit, (0, 12), Y0, save_every=1, **options)
    np.testing.assert_array_equal(run.t, sol.t)
    np.testing.assert_array_equal(run.y, sol.y)
    seldom = integrate(orbit, (0, 12), Y0, save_every=1000, **options)
    np.testing.assert_array_equal(seldom.y, sol.y[:, [*range(0, len(sol.t) - 1, 1000), -1]])


@pytest.mark.needs_jit
def test_progress_says_that_a_run_is_compiled(capsys):
    integrate(jit_orbit, (0, 6), Y0, method=EIPRK45, progress=True)
    assert capsys.readouterr().err.strip().startswith("compiling")
    integrate(jit_orbit, (0, 6), Y0, method=EIPRK45, progress=True, compiled=False)
    shown = capsys.readouterr().err
    assert "EIPRK45" in shown
    assert "compiling" not in shown


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.needs_jit
@methods
@pytest.mark.filterwarnings("ignore:.*not to be trusted:eip_scipy.ProjectionWarning")
def test_failures_of_compiled_runs_are_the_same(method):
    lv = njit(lambda t, u: np.array([u[0] * (1 - u[1]), u[1] * (u[0] - 1)]))
    value = njit(lambda t, u: u[0] - np.log(u[0]) + u[1] - np.log(u[1]))
    grad = njit(lambda t, u: 1 - 1 / u)
    late_nan = njit(lambda t, u: np.array([u[1], -u[0]]) * (1.0 if t < 0.5 else np.nan))
    ball = njit(lambda t, u: u[0] ** 2 + u[1] ** 2 if t < 0.5 else np.nan)
    double = njit(lambda t, u: 2 * u)
    turn = njit(lambda t, u: np.array([u[1], -u[0]]))
    cases = [
        (lv, {"rtol": 0.5, "atol": 5.0, "first_step": 2.0, "invariants": Invariant(value, grad, name="V")}),
        (late_nan, {}),
        (turn, {"invariants": Invariant(ball, double, name="ball"), "check": False}),
        *((lv, {"h": h, "invariants": Invariant(value, grad, name="V")}) for h in (1.0, 2.0)),
        (late_nan, {"h": 0.01}),
    ]
    for fun, options in cases:
        one, other = (
            integrate(fun, (0, 20), [4.0, 2.0], method=method, save_every=1, compiled=compiled, **options)
            for compiled in (True, False)
        )
        assert one.compiled
        assert one.status == other.status
        assert other.message.startswith(one.message)
        np.testing.assert_array_equal(one.t, other.t)
        np.testing.assert_array_equal(one.y, other.y)
        assert repr(one.diagnostics) == repr(other.diagnostics)
