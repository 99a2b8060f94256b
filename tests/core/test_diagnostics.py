"""Slopes, orders, invariants along a solution, and error against cost."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from eip_scipy import EIPRK4, Invariant, integrate
from eip_scipy.core.diagnostics import drift_slope, invariants_along, observed_order
from eip_scipy.problems import harmonic, kepler
from eip_scipy_studies.work_precision import WorkPoint, work_precision


def test_slope_of_a_line_is_exact():
    t = np.linspace(3.0, 10.0, 50)
    slope, stderr = drift_slope(t, 2.5e-12 * t - 7.0e-12)
    assert slope == pytest.approx(2.5e-12, rel=1e-12)
    assert stderr < 1e-25
    assert isinstance(slope, float)


def test_slope_and_standard_error_are_those_of_a_linear_regression():
    from scipy.stats import linregress

    t = np.linspace(0.0, 5.0, 40)
    defects = np.random.default_rng(3).normal(size=(3, 40)) + np.outer([0.0, 1.0, -2.0], t)
    slope, stderr = drift_slope(t, defects)
    for k in range(3):
        expected = linregress(t, defects[k])
        assert slope[k] == pytest.approx(expected.slope, rel=1e-12)
        assert stderr[k] == pytest.approx(expected.stderr, rel=1e-12)


def test_standard_error_tells_noise_from_drift():
    t = np.arange(1000.0)
    noise = np.random.default_rng(0).normal(size=(200, 1000))
    slope, stderr = drift_slope(t, noise)
    assert 0.6 < np.mean(np.abs(slope) < stderr) < 0.76
    slope, stderr = drift_slope(t, noise + 0.01 * t)
    assert np.all(slope > 5 * stderr)


@pytest.mark.parametrize(
    ("t", "defects", "message"),
    [
        ([0, 1, 2], [0, 1], r"t has shape \(3,\) and defects \(2,\)"),
        ([[0, 1, 2]], [0, 1, 2], "t has shape"),
        ([0, 1], [0, 1], "at least three times"),
        ([0, 1, 2], [0, np.nan, 1], "finite numbers only"),
        ([1, 1, 1], [0, 1, 2], "all times are equal"),
    ],
)
def test_slope_refuses(t, defects, message):
    with pytest.raises(ValueError, match=message):
        drift_slope(t, defects)


def test_observed_order_of_a_power():
    h = np.array([0.1, 0.05, 0.02])
    np.testing.assert_allclose(observed_order(3 * h**4, h), [4, 4], rtol=1e-12)
    both = observed_order(np.stack([h**2, -(h**5)], axis=1), h)
    np.testing.assert_allclose(both, [[2, 5], [2, 5]], rtol=1e-12)


def test_observed_order_is_nan_where_an_error_says_nothing():
    orders = observed_order([1e-2, 0.0, 1e-4, np.inf, 1e-6], [16, 8, 4, 2, 1])
    assert np.isnan(orders).all()


@pytest.mark.parametrize(
    ("errors", "steps", "message"),
    [
        ([1], [1], "at least 2"),
        ([1, 2], [1, 2, 3], "the same length"),
        ([1, 2], [1, 0], "positive"),
        ([1, 2], [1, 1], "neighbours different"),
        ([1, 2], [1, np.nan], "positive"),
    ],
)
def test_observed_order_refuses(errors, steps, message):
    with pytest.raises(ValueError, match=message):
        observed_order(errors, steps)


def test_observed_order_of_a_run():
    problem = kepler()

    def end(h):
        return integrate(problem, (0.0, 3.0), method=EIPRK4, h=h).y[:, -1]

    steps = np.array([0.02, 0.01, 0.005])
    ends = [end(h) for h in (*steps, 0.00125)]
    errors = [np.abs(y - ends[-1]).max() for y in ends[:-1]]
    np.testing.assert_allclose(observed_order(errors, steps), 4, atol=0.3)


def test_invariants_along_are_those_of_integrate():
    problem = kepler()
    run = integrate(problem, (0.0, 2.0), method=EIPRK4, h=0.01, save_every=10)
    values = invariants_along(problem.invariants, run.t, run.y)
    assert values.shape == (2, run.t.size)
    np.testing.assert_array_equal(values, run.invariants)


def test_invariants_along_a_solution_of_scipy():
    problem = harmonic()
    solution = solve_ivp(problem.fun, (0.0, 1.0), problem.y0, rtol=1e-10, atol=1e-12)
    values = invariants_along(problem.invariants, solution.t, solution.y)
    np.testing.assert_allclose(values, 5.0, rtol=1e-8)
    assert values.shape == (1, solution.t.size)


def test_invariants_along_takes_vectors_complex_states_and_params():
    both = Invariant(lambda t, y, p: np.array([abs(y[0]) ** 2, p[0] * t]), name="both")
    values = invariants_along(both, [0.0, 2.0], np.array([[1j, 2 + 1j]]), params=[3])
    np.testing.assert_allclose(values, [[1, 5], [0, 6]])
    assert invariants_along((), [0.0, 1.0], np.ones((2, 2))).shape == (0, 2)
    assert invariants_along(both, [], np.ones((1, 0)), params=[3]).shape == (1, 0)


def test_invariants_along_names_both_shapes():
    with pytest.raises(ValueError, match=r"t has shape \(3,\) and y \(2, 2\)"):
        invariants_along((), [0.0, 1.0, 2.0], np.ones((2, 2)))


def test_work_precision_takes_the_least_time_and_leaves_failures_without_error():
    seconds = iter([3.0, 5.0, 0.4, 1.0, 0.2, 1.5])
    ran = []

    def good(step):
        ran.append(step)
        return next(seconds), np.array([step])

    def bad(step):
        return 0.1, np.array([np.nan])

    ticks = []
    done = work_precision(
        {"good": (good, [2.0, 1.0]), "bad": (bad, [1.0])},
        lambda y: y[0] ** 2,
        repeats=3,
        enough_seconds=4.0,
        callback=lambda: ticks.append(1),
    )
    assert ran == [2.0, 1.0, 2.0, 2.0]  # 1.0 took 5 s, more than enough
    assert done.points[:2] == (WorkPoint("good", 2.0, 0.4, 4.0), WorkPoint("good", 1.0, 5.0, 1.0))
    assert np.isnan(done.points[2].error)
    assert len(ticks) == 9
    assert "Python" in done.machine


def test_work_precision_refuses_no_repeats():
    with pytest.raises(ValueError, match="at least 1"):
        work_precision({}, float, repeats=0)
