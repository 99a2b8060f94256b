"""Guards of the projection: dependent and vanishing gradients, round-off, units, amplitudes, and clean failures."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from systems import SQUARE, VOLTERRA, lotka_volterra, oscillator, pendulum, pendulum_energy, pendulum_gradient

from eip_scipy import (
    EIPDOP853,
    EIPGJ14,
    EIPRK1,
    EIPRK2,
    EIPRK3,
    EIPRK4,
    EIPRK5,
    EIPRKN12,
    Diagnostics,
    Invariant,
    ProjectionWarning,
    integrate,
    project,
)
from eip_scipy.problems import kepler, solar_system

EPS = np.finfo(float).eps
METRICS = ["error", "euclidean"]
PENDULUM_ENERGY = Invariant(pendulum_energy, pendulum_gradient, name="H")


def by_scipy(fun, t_span, y0, **options):
    """Run solve_ivp, and add the residuals of `integrate`'s result."""
    diagnostics = Diagnostics()
    sol = solve_ivp(fun, t_span, y0, method=EIPRK4, diagnostics=diagnostics, **options)
    sol.max_defect, sol.diagnostics = diagnostics.max_defect, diagnostics
    return sol


def by_integrate(fun, t_span, y0, **options):
    return integrate(fun, t_span, y0, method=EIPRK4, save_every=1, **options)


DRIVERS = [by_scipy, by_integrate]
both = pytest.mark.parametrize("driver", DRIVERS, ids=["solve_ivp", "integrate"])
metrics = pytest.mark.parametrize("metric", METRICS)


# Circular Kepler: the gradients of H and L are parallel.


@metrics
@pytest.mark.parametrize("eccentricity", [0.0, 1e-8, 1e-4])
def test_circular_kepler(metric, eccentricity):
    problem = kepler(eccentricity, 0.0)
    run = by_integrate(problem.fun, (0.0, 12.6), problem.y0, h=0.03, invariants=problem.invariants, metric=metric)
    assert run.status == 0
    assert np.isfinite(run.y).all()
    assert (run.max_defect <= 4 * EPS).all()
    error, plain = (
        np.linalg.norm(y[:, -1] - problem.reference(12.6))
        for y in (run.y, by_integrate(problem.fun, (0.0, 12.6), problem.y0, h=0.03).y)
    )
    assert error < plain
    reduced, done = run.diagnostics.n_rank_reduced, run.diagnostics.n_projections
    assert reduced == (done if eccentricity < 1e-7 else 0)
    assert done == 420


@metrics
@pytest.mark.parametrize("eccentricity", [0.0, 1e-8, 1e-4])
@pytest.mark.parametrize(
    ("method", "h"),
    [pytest.param(EIPRK1, 0.005, marks=pytest.mark.slow), (EIPRK2, 0.02), (EIPRK3, 0.02), (EIPRK5, 0.05)],
)
def test_circular_kepler_by_other_methods(metric, eccentricity, method, h):
    """Truncation errors make parallel gradients nearly so: a poor correction does not end a correct run."""
    problem = kepler(eccentricity, 0.0)
    options = {"method": method, "h": h, "compiled": False, "blocks": None}
    run = integrate(problem, (0.0, 20.0), metric=metric, **options)
    plain = integrate(problem, (0.0, 20.0), invariants=(), **options)
    assert run.status == 0
    assert np.isfinite(run.y).all()
    drift = [abs(i.fun(0.0, plain.y[:, -1], *i.args) - i.fun(0.0, problem.y0, *i.args)) for i in problem.invariants]
    assert (run.max_defect < np.array(drift)).all()


@pytest.mark.needs_jit
@pytest.mark.parametrize("eccentricity", [1e-2, 1e-4, 1e-6, 3e-8])
@pytest.mark.parametrize(
    ("method", "steps", "allowed"), [(EIPRKN12, 24, 5e-12), (EIPGJ14, 90, 1e-12), (EIPDOP853, 100, 1e-11)]
)
def test_nearly_parallel_gradients_do_not_amplify_rounding(method, steps, allowed, eccentricity):
    """The rounding errors of the defects were divided by the sine of the angle between the gradients."""
    problem = kepler(eccentricity, 0.0)
    run = integrate(problem, (0, 200 * np.pi), method=method, h=2 * np.pi / steps)
    assert run.trusted
    assert np.abs(run.y[:, -1] - problem.y0).max() < allowed
    assert (run.max_defect <= 8 * EPS).all()


@pytest.mark.needs_jit
@pytest.mark.parametrize("eccentricity", [1e-3, 1e-5, 1e-7, 0.0])
@pytest.mark.parametrize("symplectic", [False, True])
def test_derivatives_of_nearly_circular_orbits(symplectic, eccentricity):
    problem = kepler(eccentricity, 0.0)
    options = {"method": EIPDOP853, "variations": "state"}
    truth = integrate(problem, (0, 20 * np.pi), h=2 * np.pi / 400, invariants=(), **options).stm[-1]
    run = integrate(problem, (0, 20 * np.pi), h=2 * np.pi / 40, symplectic=symplectic, **options)
    assert run.trusted
    assert np.abs(run.stm[-1] - truth).max() < 3e-10 * np.abs(truth).max()


# Equilibria and saddles: the gradient of H vanishes.


@metrics
@pytest.mark.parametrize("y0", [[0.0, 0.0], [np.pi, 0.0]], ids=["hanging", "upright"])
def test_equilibrium_at_rest(metric, y0):
    run = by_integrate(pendulum, (0, 30), y0, h=0.05, invariants=PENDULUM_ENERGY, metric=metric)
    plain = by_integrate(pendulum, (0, 30), y0, h=0.05)
    assert run.status == 0
    np.testing.assert_array_equal(run.y, plain.y)
    assert run.diagnostics.n_projections == 0
    assert run.diagnostics.n_skipped == 600
    assert (run.max_defect <= 4 * EPS).all()


@metrics
@pytest.mark.parametrize("offset", [1e-3, 1e-8, 1e-12])
@pytest.mark.parametrize("fast", [False, True], ids=["at rest", "moving"])
def test_saddle(metric, offset, fast):
    """Near (pi, 0) a correction of round-off divided by the small gradient must not kick the pendulum about."""
    y0 = [np.pi, offset] if fast else [np.pi - offset, 0.0]
    run = by_integrate(pendulum, (0, 10), y0, h=0.05, invariants=PENDULUM_ENERGY, metric=metric)
    plain = by_integrate(pendulum, (0, 10), y0, h=0.05)
    assert run.status == 0
    assert (run.max_defect <= 8 * EPS).all()
    # While it is near the saddle the two runs part by no more than the step's error there.
    near = np.abs(plain.y[0] - np.pi) < 0.1
    assert near.sum() > 40
    assert np.abs((run.y - plain.y)[:, near]).max() < 1e-6 * np.abs(plain.y[0, near] - np.pi).max() + 1e-14


def test_zero_gradient_drops_the_row_and_counts():
    """A product of two coordinates, both 0: no division by 0, the other invariant is met."""
    product = Invariant(lambda t, y: y[2] * y[3], lambda t, y: np.array([0.0, 0.0, y[3], y[2]]), name="product")
    norm = Invariant(lambda t, y: y[0] ** 2 + y[1] ** 2, lambda t, y: np.array([2 * y[0], 2 * y[1], 0, 0]), name="norm")
    run = by_integrate(
        lambda t, y: np.array([y[1], -y[0], 0.0, 0.0]), (0, 5), [1.0, 0, 0, 0], h=0.1, invariants=[product, norm]
    )
    assert run.status == 0
    assert run.diagnostics.n_rank_reduced == run.diagnostics.n_projections > 40
    assert run.max_defect[0] == 0
    assert run.max_defect[1] <= 4 * EPS
    assert (run.y[2:, -1] == 0).all()


@pytest.mark.parametrize("direction", ["new", "old", "midpoint"])
def test_without_any_gradient_the_raw_state_stays(direction):
    """A residual that nothing can correct has rank 0 and is counted; it fails only if the projection increases it."""
    square = Invariant(lambda t, y: y[0] ** 2 + 1e-3 * t, lambda t, y: np.array([2 * y[0], 0.0]))
    options = {"h": 0.25, "invariants": square, "direction": direction, "check": False}
    run = by_integrate(lambda t, y: np.array([0.0, 1.0]), (0, 1), [0.0, 3.0], **options)
    np.testing.assert_array_equal(run.y, [[0.0] * 5, [3.0, 3.25, 3.5, 3.75, 4.0]])
    assert run.diagnostics.n_projections == run.diagnostics.n_rank_reduced == 4
    assert run.max_defect[0] == 1e-3


@pytest.mark.parametrize("iterations", [1, 3])
def test_project_with_zero_gradient(iterations):
    with pytest.warns(ProjectionWarning, match="left an error of -1 in 'S', 1 of the size of its terms"):
        result = project([0.0, 0.0], SQUARE, target=1.0, iterations=iterations)
    assert result.rank == 0
    np.testing.assert_array_equal(result.y, [0.0, 0.0])
    np.testing.assert_array_equal(result.correction, [0.0, 0.0])
    np.testing.assert_array_equal(result.defect, [-1.0])


# Units and amplitudes.


def sizes_of_h_and_l(problem):
    """Sums of the absolute terms of H and of the components of L."""
    gm, (q, v) = problem.params, problem.y0.reshape(2, -1, 3)
    distance = np.linalg.norm(q[:, None] - q, axis=2)[np.triu_indices(len(gm), 1)]
    energy = 0.5 * gm @ (v**2).sum(axis=1) + (np.outer(gm, gm)[np.triu_indices(len(gm), 1)] / distance).sum()
    momentum = [gm @ (abs(q[:, i] * v[:, j]) + abs(q[:, j] * v[:, i])) for i, j in ((1, 2), (2, 0), (0, 1))]
    return np.array([energy, *momentum])


@pytest.mark.slow
@pytest.mark.needs_jit
@metrics
def test_solar_system_in_si_units(metric):
    problem = solar_system(units="SI", years=2.0)
    run = integrate(problem, method=EIPRK4, metric=metric, compiled=True)
    assert run.status == 0
    assert np.isfinite(run.y).all()
    assert (run.max_defect <= 30 * EPS * sizes_of_h_and_l(problem)).all()
    assert run.diagnostics.n_rank_reduced == 0


AMPLITUDES = [1e-160, 1e-155, 1e-20, 1.0, 1e150]
D = np.array([1 / 3, 1 / 2, 1.0])


@metrics
@pytest.mark.parametrize("atol", [0.0, 1e-6])
@pytest.mark.parametrize("blocks", [None, 3])
@pytest.mark.parametrize("amplitude", AMPLITUDES)
def test_amplitudes_of_a_nonlinear_problem(metric, blocks, amplitude, atol):
    """Euler's top is homogeneous: times an amplitude, it runs that many times faster along the same curve."""
    invariants = [
        Invariant(lambda t, y: 0.5 * (y @ (D * y)), lambda t, y: D * y, name="T"),
        Invariant(lambda t, y: 0.5 * (y @ y), lambda t, y: 1.0 * y, name="M"),
    ]
    options = {"invariants": invariants, "metric": metric, "blocks": blocks, "atol": atol}
    direction = np.array([1.0, 0.1, 0.4])

    def top(t, y):
        return np.cross(y, D * y)

    run = by_integrate(top, (0, 5 / amplitude), amplitude * direction, h=0.1 / amplitude, **options)
    start = 0.5 * amplitude**2 * np.array([direction @ (D * direction), direction @ direction])
    assert run.status == 0
    assert np.isfinite(run.y).all()
    assert (run.max_defect <= 8 * EPS * start + 2 * 5e-324).all()
    if amplitude >= 1e-150:
        one = by_integrate(top, (0, 5), direction, h=0.1, **options | {"atol": atol / amplitude})
        np.testing.assert_allclose(run.y / amplitude, one.y, rtol=0, atol=1e-12)


@metrics
@pytest.mark.parametrize("amplitudes", [(1.0, 1e-155), (1e150, 1e-10), (1e100, 1e-100), (1e-30, 1e-160)])
def test_amplitudes_side_by_side(metric, amplitudes):
    """Two oscillators that know nothing of each other, each with its norm: both are kept, however small."""
    y0 = np.kron(amplitudes, [1.0, 0.3])

    def norm(k):
        own = slice(2 * k, 2 * k + 2)
        return Invariant(
            lambda t, y: math.hypot(*y[own]),
            lambda t, y: np.concatenate([y[:2] * (k == 0), y[2:] * (k == 1)]) / math.hypot(*y[own]),
        )

    def fun(t, y):
        return np.array([y[1], -y[0], y[3], -y[2]])

    options = {"invariants": [norm(0), norm(1)], "metric": metric, "atol": 0.0, "h": 0.1}
    run = by_integrate(fun, (0, 5), y0, **options)
    assert run.status == 0
    assert run.diagnostics.n_rank_reduced == 0
    assert (run.max_defect <= 8 * EPS * run.invariants[:, 0]).all()


# The dead band.


@both
@metrics
@pytest.mark.parametrize("iterations", [1, 2])
def test_a_step_on_the_manifold_is_returned_bitwise(driver, metric, iterations):
    """RK keeps linear invariants: with one, the projected run is the plain one, bit for bit, and says it skipped."""
    total = Invariant(lambda t, y: y.sum(), lambda t, y: np.ones(3), name="total")

    def exchange(t, y):
        flow = np.array([y[0] * y[1], y[1] * y[2]])
        return np.array([-flow[0], flow[0] - flow[1], flow[1]])

    options = {"h": 0.1, "metric": metric, "iterations": iterations}
    run = driver(exchange, (0, 10), [0.7, 0.2, 0.1], invariants=total, **options)
    plain = driver(exchange, (0, 10), [0.7, 0.2, 0.1], h=0.1)
    np.testing.assert_array_equal(run.y, plain.y)
    assert run.diagnostics.n_skipped == 100
    assert run.diagnostics.n_projections == 0
    assert run.nlu == 0
    assert run.max_defect[0] == np.abs(run.y.sum(axis=0) - run.y[:, 0].sum()).max() > 0


@pytest.mark.parametrize("defect", [3, 5])
def test_width_of_the_dead_band(defect):
    """Four rounding errors of the largest of |I|, |target|, sum |G_k y_k| and the given scale."""
    outside = defect > 4
    # |target| = sum |G_k y_k| = 1; a scale of 2^20 widens the band by as much.
    for scale in (1.0, 2.0**20):
        first = Invariant(lambda t, y: y[0], lambda t, y: np.array([1.0, 0.0]), target=1.0, scale=scale)
        result = project([1.0 + defect * EPS * scale, 0.0], first)
        assert result.rank == int(outside)
        assert (result.correction[0] != 0) == outside


def test_dead_band_sees_cancelling_terms():
    """I = y0 - y1 with terms of 1e8 that cancel: a residual of 1e-8 is round-off of the terms."""
    gap = Invariant(lambda t, y: y[0] - y[1], lambda t, y: np.array([1.0, -1.0]), target=0.0)
    y = np.array([1e8, 1e8 - 2.0**-26])
    result = project(y, gap)
    np.testing.assert_array_equal(result.y, y)
    assert result.rank == 0
    assert result.defect[0] == 2.0**-26
    assert project([1e8, 1e8 - 2.0**-20], gap).rank == 1


def test_row_inside_the_band_stays():
    """If one residual is outside its band, the correction does not change the invariant that is inside."""
    sphere = Invariant(lambda t, y: y @ y, lambda t, y: 2 * y, target=1.01, name="sphere")
    plane = Invariant(lambda t, y: y.sum(), lambda t, y: np.ones(3), target=1.0, name="plane")
    y = np.array([1.0, 0.0, 0.0])
    result = project(y, [sphere, plane])
    assert result.rank == 2
    assert abs(result.y.sum() - 1.0) <= 2 * EPS
    alone = project(y, sphere)
    assert abs(alone.y.sum() - 1.0) > 1e-3


# Duplicate and contradicting invariants.


@metrics
@pytest.mark.parametrize("iterations", [1, 2])
def test_duplicate_invariants(metric, iterations):
    twice = Invariant(lambda t, y: 3 * (y @ y), lambda t, y: 6 * y, name="thrice")
    options = {"h": 0.1, "metric": metric, "iterations": iterations}
    run = by_integrate(oscillator, (0, 10), [1.0, 2.0], invariants=[SQUARE, twice, SQUARE], **options)
    alone = by_integrate(oscillator, (0, 10), [1.0, 2.0], invariants=SQUARE, **options)
    assert run.status == 0
    assert run.diagnostics.n_rank_reduced == run.diagnostics.n_projections > 90
    assert (run.max_defect <= 8 * EPS * np.array([5.0, 15.0, 5.0])).all()
    np.testing.assert_allclose(run.y, alone.y, rtol=0, atol=1e-13)


def test_duplicates_hide_no_other_invariant():
    """The independent row is found behind two equal ones."""
    tilted = Invariant(lambda t, y: y[0] + 0.5 * y[1], lambda t, y: np.array([1.0, 0.5]))
    for order in ([SQUARE, SQUARE, tilted], [tilted, SQUARE, SQUARE], [SQUARE, tilted, SQUARE]):
        result = project([0.6, 0.81], order, target=[1.0 if item is SQUARE else 1.05 for item in order], iterations=8)
        assert result.rank == 2
        np.testing.assert_allclose(result.defect, 0.0, atol=4 * EPS)


A1000 = Invariant(lambda t, y: y @ y, lambda t, y: 2 * y, target=1000.0, name="a")
B20 = Invariant(lambda t, y: y @ y, lambda t, y: 2 * y, target=20.0, name="b")


@pytest.mark.parametrize("invariants", [[A1000, B20], [B20, A1000]])
def test_contradicting_targets(invariants):
    """The worst one comes first, whatever the order: "a" is off by 0.995 of its size, "b" by 0.75."""
    with pytest.raises(ValueError, match=r"violates invariant 'a' by -995, and also 'b'; .*project_initial=True"):
        by_integrate(oscillator, (0, 1), [1.0, 2.0], h=0.1, invariants=invariants)
    with pytest.raises(ValueError, match=r"projection failed at t=0: invariant '[ab]', residual .*, rank 1 of 2"):
        by_integrate(oscillator, (0, 1), [1.0, 2.0], h=0.1, invariants=invariants, project_initial=True)


def test_values_at_a_start():
    """Without a target an invariant takes its value at `start`, with one it keeps its own."""
    total = Invariant(lambda t, y: np.array([y[0] + y[1], t * y[2]]), name="sums")
    first = Invariant(lambda t, y: y[0], target=1.2, name="first")
    start, rough = np.array([1.0, 2.0, 3.5]), np.array([1.1, 2.0, 3.4])
    # y0 + y1 = 3 and 2 y2 = 7 as at the start.
    np.testing.assert_allclose(project(rough, total, t=2.0, start=start).y, [1.05, 1.95, 3.5], rtol=1e-14)
    both = project(rough, [total, first], t=2.0, start=start)
    np.testing.assert_allclose(both.y, [1.2, 1.8, 3.5], rtol=1e-14)
    np.testing.assert_array_equal(project(rough, first, start=start).y, project(rough, first).y)
    with pytest.raises(ValueError, match="target or start, not both"):
        project(rough, total, start=start, target=[3.0, 7.0])
    with pytest.raises(ValueError, match="start must be a state with 3 components, as y_hat, got"):
        project(rough, total, start=start[:2])
    with pytest.raises(ValueError, match="start must be a state with"):
        project(rough, total, start=start + 1j)
    with pytest.raises(ValueError, match=r"'sums' has no target\. Set its target, pass target=, or pass start="):
        project(rough, total)


@both
@pytest.mark.parametrize("iterations", [1, 3])
def test_contradiction_on_the_way(driver, iterations):
    """Parallel gradients, values that part at t = 0.45: one projection before it, one failure after it."""
    drifting = Invariant(lambda t, y: y @ y + 1e-3 * max(t - 0.45, 0), lambda t, y: 2 * y, name="drifting")
    options = {"invariants": [SQUARE, drifting], "iterations": iterations, "check": False, "h": 0.1}
    run = driver(oscillator, (0, 1), [1.0, 2.0], **options)
    assert run.status == -1
    assert not run.success
    assert run.message.startswith("projection failed at t=0.5: invariant 'drifting', residual 5e-05, rank 1 of 2")
    np.testing.assert_allclose(run.t, np.arange(5) * 0.1, atol=1e-15)
    assert run.y.shape == (2, 5)
    np.testing.assert_allclose((run.y**2).sum(axis=0), 5.0, rtol=4 * EPS)
    assert run.diagnostics.n_rejected_projections == 1


# Failing projections and right-hand sides: status -1, the message of the contract, everything kept.


def test_invariant_not_finite_after_a_step():
    """A step of 2 takes Lotka-Volterra to u < 0, where log u is NaN."""
    run = by_integrate(lotka_volterra, (0, 30), [4.0, 2.0], h=2.0, invariants=VOLTERRA)
    assert run.status == -1
    assert run.message.startswith("projection failed at t=2: invariant 'V', residual nan, rank 1 of 1")
    np.testing.assert_array_equal(run.t, [0.0])
    np.testing.assert_array_equal(run.y, [[4.0], [2.0]])


def test_value_not_finite_at_the_projected_state():
    """The value was finite before the correction, which leaves the domain."""
    edge = Invariant(lambda t, y: y[0] if y[0] < 1.005 else math.nan, lambda t, y: np.ones(1), target=1.01, name="edge")
    with pytest.raises(ValueError, match="projection failed at t=0: invariant 'edge', residual nan, rank 1 of 1"):
        project([1.0], edge)


def test_correction_in_the_wrong_direction():
    """A gradient of the wrong sign doubles the residual, which is a failure."""
    wrong = Invariant(lambda t, y: y @ y, lambda t, y: -2 * y, name="wrong")
    run = by_integrate(oscillator, (0, 1), [1.0, 2.0], h=0.1, invariants=wrong, check=False)
    assert run.status == -1
    assert run.message.startswith("projection failed at t=0.1: invariant 'wrong', residual ")
    assert run.t.tolist() == [0.0]


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_gradient_not_finite_on_the_way(bad):
    """A gradient that is not finite does not silently disable the projection."""
    broken = Invariant(lambda t, y: y @ y, lambda t, y: 2 * y if t < 0.45 else bad * y, name="broken")
    with np.errstate(all="ignore"):
        run = by_integrate(oscillator, (0, 1), [1.0, 2.0], h=0.1, invariants=broken, check=False)
    assert run.status == -1
    assert "broken" in run.message
    assert "t=0.5" in run.message
    assert len(run.t) == 5


def not_finite_at_call(number, component):
    """The oscillator, one component NaN at one call (from 1)."""
    calls = 0

    def fun(t, y):
        nonlocal calls
        calls += 1
        f = oscillator(t, y)
        if calls == number:
            f[component] = np.nan
        return f

    return fun


@both
@pytest.mark.parametrize("component", [1, slice(None)], ids=["second", "both"])
@pytest.mark.parametrize("call", range(3, 9))
def test_rhs_not_finite_at_any_stage(driver, call, component):
    """The evaluation may be any, including the one at the new point (for the error estimate)."""
    run = driver(not_finite_at_call(call, component), (0, 1), [1.0, 2.0], h=0.1, invariants=SQUARE)
    assert run.status == -1
    assert run.message.startswith("fun returned a non-finite value at t=0.")
    assert np.isfinite(run.y).all()
    assert len(run.t) in (1, 2, 3)
    np.testing.assert_allclose(run.t, np.arange(len(run.t)) * 0.1, atol=1e-16)


def test_rhs_not_finite_at_the_start():
    for invariant in (SQUARE, Invariant(lambda t, y: y @ y, name="without grad")):
        run = by_integrate(lambda t, y: y * np.nan, (0, 1), [1.0, 2.0], h=0.1, invariants=invariant)
        assert run.status == -1
        assert run.message.startswith("fun returned a non-finite value at t=0")
        assert run.t.tolist() == [0.0]


@both
def test_blow_up_ends_with_a_finite_state(driver):
    """y' = y^2 reaches infinity at t = 1; a fixed step finds out somewhat later."""
    with np.errstate(all="ignore"):
        run = driver(lambda t, y: y * y, (0, 2), [1.0], h=0.01)
    assert run.status == -1
    assert np.isfinite(run.y).all()
    assert 1.0 < run.t[-1] < 1.1
    assert "non-finite" in run.message or "finite" in run.message


def test_overflow_of_the_sum_alone():
    """Every stage finite, the new state not: the message blames the step."""
    with np.errstate(all="ignore"):
        run = integrate(lambda t, y: np.full(1, 1e308), (0, 100), [1e308], method=EIPRK3, h=1.0)
    assert run.status == -1
    assert run.message.startswith("the state is no longer finite at t=1")
    assert run.t.tolist() == [0.0]


@pytest.mark.needs_jit
@both
def test_no_flood_of_warnings(driver):
    """Without an errstate of the user's, numpy warns from the user's own line; the package adds none."""
    with pytest.warns(RuntimeWarning) as record:
        driver(lambda t, y: 1e200 * y, (0, 2), [1.0], h=0.01)
    assert len(record) <= 4
    assert all(w.filename == __file__ for w in record)


# Frames.


@metrics
def test_an_invariant_that_the_frame_holds(metric):
    """Only rounding is left of the gradient, in any direction; a compensated run sees the residual in every step."""
    n = 6
    total = np.repeat([0.0, 1.0], n)
    frame = np.kron(np.eye(2), np.ones((1, n))), np.kron(np.eye(2), np.ones((n, 1)))

    def forces(t, y):
        pull = np.exp(y[:n] - np.roll(y[:n], -1))
        return np.concatenate([y[n:], np.roll(pull, 1) - pull])

    def energy(t, y):
        return y[n:] @ y[n:] / 2 + np.exp(y[:n] - np.roll(y[:n], -1)).sum()

    def slope(t, y):
        f = forces(t, y)
        return np.concatenate([-f[n:], f[:n]])

    kept = Invariant(lambda t, y: total @ y, lambda t, y: total, name="P"), Invariant(energy, slope, name="H")
    y0 = np.random.default_rng(4).standard_normal(2 * n)
    options = {"method": EIPDOP853, "h": 0.05, "frame": frame, "metric": metric, "compensated": True}
    run = integrate(forces, (0, 20), y0, invariants=kept, **options)
    assert run.success
    assert run.trusted
    alone = integrate(forces, (0, 20), y0, invariants=kept[1], **options)
    np.testing.assert_allclose(run.y[:, -1], alone.y[:, -1], rtol=0, atol=1e-9)
    assert run.max_defect.max() < 1e-13
