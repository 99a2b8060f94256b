"""Guards of the projection: dependent and vanishing gradients, round-off, units, amplitudes, and clean failures."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from systems import PENDULUM_ENERGY, SQUARE, VOLTERRA, lotka_volterra, oscillator, pendulum

import eip_scipy
from eip_scipy import EIPDOP853, EIPRK2, EIPRK3, EIPRK4, EIPRK5, EIPRK45, Balance, Invariant, integrate, project
from eip_scipy.problems import kepler

EPS = np.finfo(float).eps
metrics = pytest.mark.parametrize("metric", ["error", "euclidean"])


def run(fun, t_span, y0, **options):
    return integrate(fun, t_span, y0, **{"method": EIPRK4, "save_every": 1, **options})


def turning(**options):
    """Return a run of the oscillator in ten steps."""
    return run(oscillator, (0, 1), [1.0, 2.0], h=0.1, **options)


# Circular Kepler: the gradients of H and L are parallel.


@metrics
@pytest.mark.parametrize(("method", "h"), [(EIPRK2, 0.02), (EIPRK3, 0.02), (EIPRK4, 0.03), (EIPRK5, 0.05)])
def test_circular_kepler(metric, method, h):
    """Truncation errors make parallel gradients nearly so: a poor correction does not end a correct run."""
    for eccentricity in (0.0, 1e-8, 1e-4):
        problem = kepler(eccentricity, 0.0)
        options = {"method": method, "h": h, "compiled": False, "blocks": None}
        found = integrate(problem, (0.0, 12.6), metric=metric, **options)
        plain = integrate(problem, (0.0, 12.6), invariants=(), **options)
        assert found.status == 0
        drift = [abs(i.fun(0.0, plain.y[:, -1], *i.args) - i.fun(0.0, problem.y0, *i.args)) for i in problem.invariants]
        assert (found.max_residual < np.array(drift)).all()
        if method is EIPRK4:
            assert (found.max_residual <= 4 * EPS).all()
            error, of_plain = (np.linalg.norm(r.y[:, -1] - problem.reference(12.6)) for r in (found, plain))
            assert error < of_plain
            d = found.diagnostics
            assert (d.n_projections, d.n_rank_reduced) == (420, 420 if eccentricity < 1e-7 else 0)


@pytest.mark.needs_jit
@pytest.mark.parametrize(
    ("method", "steps", "allowed"),
    [(eip_scipy.EIPRKN12, 24, 5e-12), (eip_scipy.EIPGJ14, 90, 1e-12), (EIPDOP853, 100, 1e-11)],
)
def test_nearly_parallel_gradients_do_not_amplify_rounding(method, steps, allowed):
    """The rounding errors of the residuals were divided by the sine of the angle between the gradients."""
    for eccentricity in (1e-2, 1e-4, 1e-6, 3e-8):
        problem = kepler(eccentricity, 0.0)
        found = integrate(problem, (0, 200 * np.pi), method=method, h=2 * np.pi / steps)
        assert found.trusted
        assert np.abs(found.y[:, -1] - problem.y0).max() < allowed
        assert (found.max_residual <= 8 * EPS).all()


# Equilibria and saddles: the gradient of H vanishes.


@metrics
@pytest.mark.parametrize("y0", [[0.0, 0.0], [np.pi, 0.0]], ids=["hanging", "upright"])
def test_equilibrium_at_rest(metric, y0):
    found = run(pendulum, (0, 30), y0, h=0.05, invariants=PENDULUM_ENERGY, metric=metric)
    np.testing.assert_array_equal(found.y, run(pendulum, (0, 30), y0, h=0.05).y)
    assert (found.status, found.diagnostics.n_projections, found.diagnostics.n_skipped) == (0, 0, 600)
    assert (found.max_residual <= 4 * EPS).all()


@metrics
@pytest.mark.parametrize("offset", [1e-3, 1e-8, 1e-12])
def test_saddle(metric, offset):
    """Near (pi, 0) a correction of round-off divided by the small gradient must not kick the pendulum about."""
    for y0 in ([np.pi, offset], [np.pi - offset, 0.0]):
        found = run(pendulum, (0, 10), y0, h=0.05, invariants=PENDULUM_ENERGY, metric=metric)
        plain = run(pendulum, (0, 10), y0, h=0.05)
        assert found.status == 0
        assert (found.max_residual <= 8 * EPS).all()
        # While it is near the saddle the two runs part by no more than the step's error there.
        near = np.abs(plain.y[0] - np.pi) < 0.1
        assert near.sum() > 40
        assert np.abs((found.y - plain.y)[:, near]).max() < 1e-6 * np.abs(plain.y[0, near] - np.pi).max() + 1e-14


def test_zero_gradient_drops_the_row_and_counts():
    """A product of two coordinates, both 0: no division by 0, the other invariant is met."""
    product = Invariant(lambda t, y: y[2] * y[3], lambda t, y: np.array([0.0, 0.0, y[3], y[2]]))
    norm = Invariant(lambda t, y: y[0] ** 2 + y[1] ** 2, lambda t, y: np.array([2 * y[0], 2 * y[1], 0, 0]))
    found = run(
        lambda t, y: np.array([y[1], -y[0], 0.0, 0.0]), (0, 5), [1.0, 0, 0, 0], h=0.1, invariants=[product, norm]
    )
    assert found.status == 0
    assert found.diagnostics.n_rank_reduced == found.diagnostics.n_projections > 40
    assert found.max_residual[0] == 0
    assert found.max_residual[1] <= 4 * EPS
    assert (found.y[2:, -1] == 0).all()


@pytest.mark.parametrize("direction", ["new", "old", "midpoint"])
def test_without_any_gradient_the_raw_state_stays(direction):
    """A residual that nothing can correct has rank 0 and is counted; it fails only if the projection increases it."""
    square = Invariant(lambda t, y: y[0] ** 2 + 1e-3 * t, lambda t, y: np.array([2 * y[0], 0.0]))
    options = {"h": 0.25, "invariants": square, "direction": direction, "check": False}
    found = run(lambda t, y: np.array([0.0, 1.0]), (0, 1), [0.0, 3.0], **options)
    np.testing.assert_array_equal(found.y, [[0.0] * 5, [3.0, 3.25, 3.5, 3.75, 4.0]])
    assert found.diagnostics.n_projections == found.diagnostics.n_rank_reduced == 4
    assert found.max_residual[0] == 1e-3
    with pytest.warns(eip_scipy.ProjectionWarning, match="left an error of -1 in 'S', 1 of the size of its terms"):
        result = project([0.0, 0.0], SQUARE, target=1.0, iterations=3)
    assert (result.rank, *result.y, *result.correction, *result.residual) == (0, 0.0, 0.0, 0.0, 0.0, -1.0)


@metrics
@pytest.mark.parametrize(("blocks", "atol"), [(None, 0.0), (3, 1e-6)])
@pytest.mark.parametrize("amplitude", [1e-160, 1e-155, 1e-20, 1.0, 1e150])
def test_amplitudes_of_a_nonlinear_problem(metric, blocks, amplitude, atol):
    """Euler's top is homogeneous: times an amplitude, it runs that many times faster along the same curve."""
    D, start = np.array([1 / 3, 1 / 2, 1.0]), np.array([1.0, 0.1, 0.4])

    def top(t, y):
        return np.cross(y, D * y)

    energy = Invariant(lambda t, y: 0.5 * (y @ (D * y)), lambda t, y: D * y)
    options = {"invariants": [energy, SQUARE], "metric": metric, "blocks": blocks}
    found = run(top, (0, 5 / amplitude), amplitude * start, h=0.1 / amplitude, atol=atol, **options)
    assert found.status == 0
    size = amplitude**2 * np.array([0.5 * start @ (D * start), start @ start])
    assert (found.max_residual <= 8 * EPS * size + 2 * 5e-324).all()
    if amplitude >= 1e-150:
        one = run(top, (0, 5), start, h=0.1, atol=atol / amplitude, **options)
        np.testing.assert_allclose(found.y / amplitude, one.y, rtol=0, atol=1e-12)


# The dead band.


@metrics
@pytest.mark.parametrize("iterations", [1, 2])
def test_a_step_on_the_manifold_is_returned_bitwise(metric, iterations):
    """RK keeps linear invariants: with one, the projected run is the plain one, bit for bit, and says it skipped."""
    total = Invariant(lambda t, y: y.sum(), lambda t, y: np.ones(3))

    def exchange(t, y):
        flow = np.array([y[0] * y[1], y[1] * y[2]])
        return np.array([-flow[0], flow[0] - flow[1], flow[1]])

    options = {"h": 0.1, "metric": metric, "iterations": iterations}
    found = run(exchange, (0, 10), [0.7, 0.2, 0.1], invariants=total, **options)
    np.testing.assert_array_equal(found.y, run(exchange, (0, 10), [0.7, 0.2, 0.1], h=0.1).y)
    assert (found.diagnostics.n_skipped, found.diagnostics.n_projections, found.nlu) == (100, 0, 0)
    assert found.max_residual[0] == np.abs(found.y.sum(axis=0) - found.y[:, 0].sum()).max() > 0


@pytest.mark.parametrize("scale", [1.0, 2.0**20])
def test_width_of_the_dead_band(scale):
    """Four rounding errors of the largest of |I|, |target|, sum |G_k y_k| and the given scale."""
    first = Invariant(lambda t, y: y[0], lambda t, y: np.array([1.0, 0.0]), target=1.0, scale=scale)
    for residual in (3, 5):
        result = project([1.0 + residual * EPS * scale, 0.0], first)
        assert (result.rank, result.correction[0] != 0) == (residual > 4, residual > 4)


def test_dead_band_sees_cancelling_terms():
    """I = y0 - y1 with terms of 1e8 that cancel: a residual of 1e-8 is round-off of the terms."""
    gap = Invariant(lambda t, y: y[0] - y[1], lambda t, y: np.array([1.0, -1.0]), target=0.0)
    y = np.array([1e8, 1e8 - 2.0**-26])
    result = project(y, gap)
    np.testing.assert_array_equal(result.y, y)
    assert (result.rank, result.residual[0]) == (0, 2.0**-26)
    assert project([1e8, 1e8 - 2.0**-20], gap).rank == 1


def test_row_inside_the_band_stays():
    """If one residual is outside its band, the correction does not change the invariant that is inside."""
    sphere = Invariant(lambda t, y: y @ y, lambda t, y: 2 * y, target=1.01)
    plane = Invariant(lambda t, y: y.sum(), lambda t, y: np.ones(3), target=1.0)
    result = project([1.0, 0.0, 0.0], [sphere, plane])
    assert result.rank == 2
    assert abs(result.y.sum() - 1.0) <= 2 * EPS
    assert abs(project([1.0, 0.0, 0.0], sphere).y.sum() - 1.0) > 1e-3


def test_contradicting_targets():
    """The worst one comes first, whatever the order: "a" is off by 0.995 of its size, "b" by 0.75."""
    a, b = (Invariant(SQUARE.fun, SQUARE.grad, target=x, name=name) for x, name in ((1000.0, "a"), (20.0, "b")))
    for invariants in ([a, b], [b, a]):
        with pytest.raises(ValueError, match=r"violates invariant 'a' by -995, and also 'b'; .*project_initial=True"):
            turning(invariants=invariants)
        with pytest.raises(ValueError, match=r"projection failed at t=0: invariant '[ab]', residual .*, rank 1 of 2"):
            turning(invariants=invariants, project_initial=True)


def test_values_at_a_start():
    """Without a target an invariant takes its value at `start`, with one it keeps its own."""
    total = Invariant(lambda t, y: np.array([y[0] + y[1], t * y[2]]), name="sums")
    first = Invariant(lambda t, y: y[0], target=1.2)
    start, rough = np.array([1.0, 2.0, 3.5]), np.array([1.1, 2.0, 3.4])
    # y0 + y1 = 3 and 2 y2 = 7 as at the start.
    np.testing.assert_allclose(project(rough, total, t=2.0, start=start).y, [1.05, 1.95, 3.5], rtol=1e-14)
    np.testing.assert_allclose(project(rough, [total, first], t=2.0, start=start).y, [1.2, 1.8, 3.5], rtol=1e-14)
    np.testing.assert_array_equal(project(rough, first, start=start).y, project(rough, first).y)
    wrong = [
        ({"start": start, "target": [3.0, 7.0]}, "not both"),
        ({"start": start[:2]}, "a state with 3 components"),
        ({"start": start + 1j}, "a state with"),
        ({}, r"'sums' has no target"),
    ]
    for options, match in wrong:
        with pytest.raises(ValueError, match=match):
            project(rough, total, **options)


# Failing projections and right-hand sides: status -1, the message of the contract, everything kept.


def changing(value=lambda t, y: y @ y, grad=lambda t, y: 2 * y):
    return Invariant(value, grad, name="x")


INTERRUPTED = {
    # Parallel gradients, values that part at t = 0.45: one projection before it, one failure after it.
    "contradiction": (
        [SQUARE, changing(lambda t, y: y @ y + 1e-3 * max(t - 0.45, 0))],
        "projection failed at t=0.5: invariant 'x', residual 5e-05, rank 1 of 2",
        5,
    ),
    "wrong sign": (changing(grad=lambda t, y: -2 * y), "projection failed at t=0.1: invariant 'x', residual ", 1),
    "gradient nan": (changing(grad=lambda t, y: 2 * y if t < 0.45 else math.nan * y), "the gradient of 'x' is not", 5),
    "gradient inf": (changing(grad=lambda t, y: 2 * y if t < 0.45 else math.inf * y), "the gradient of 'x' is not", 5),
}


@pytest.mark.parametrize("driver", [run, solve_ivp])
@pytest.mark.parametrize("iterations", [1, 3])
@pytest.mark.parametrize("case", INTERRUPTED)
def test_projection_that_fails_on_the_way(driver, iterations, case):
    invariants, words, rows = INTERRUPTED[case]
    d = eip_scipy.Diagnostics()
    options = {"invariants": invariants, "iterations": iterations, "check": False, "h": 0.1, "diagnostics": d}
    with np.errstate(all="ignore"):
        found = driver(oscillator, (0, 1), [1.0, 2.0], method=EIPRK4, **options)
    assert (found.status, found.success, d.n_rejected_projections) == (-1, False, 1)
    assert words in found.message
    np.testing.assert_allclose(found.t, np.arange(rows) * 0.1, atol=1e-15)
    np.testing.assert_allclose((found.y**2).sum(axis=0), 5.0, rtol=4 * EPS)


def test_invariant_not_finite_after_a_step():
    """A step of 2 takes Lotka-Volterra to u < 0, where log u is NaN; a correction leaves the domain."""
    found = run(lotka_volterra, (0, 30), [4.0, 2.0], h=2.0, invariants=VOLTERRA)
    assert found.status == -1
    assert found.message.startswith("projection failed at t=2: invariant 'V', residual nan, rank 1 of 1")
    np.testing.assert_array_equal(found.y, [[4.0], [2.0]])
    edge = Invariant(lambda t, y: y[0] if y[0] < 1.005 else math.nan, lambda t, y: np.ones(1), target=1.01, name="edge")
    with pytest.raises(ValueError, match="projection failed at t=0: invariant 'edge', residual nan, rank 1 of 1"):
        project([1.0], edge)


@pytest.mark.parametrize("driver", [run, solve_ivp])
@pytest.mark.parametrize("component", [1, slice(None)], ids=["second", "both"])
def test_rhs_not_finite_at_any_stage(driver, component):
    """The evaluation may be any, including the one at the new point (for the error estimate)."""
    for number in range(3, 9):
        calls = []

        def fun(t, y, calls=calls, number=number):
            calls.append(t)
            f = oscillator(t, y)
            if len(calls) == number:
                f[component] = np.nan
            return f

        found = driver(fun, (0, 1), [1.0, 2.0], method=EIPRK4, h=0.1, invariants=SQUARE)
        assert found.status == -1
        assert found.message.startswith("fun returned a non-finite value at t=0.")
        assert np.isfinite(found.y).all()
        np.testing.assert_allclose(found.t, np.arange(len(found.t)) * 0.1, atol=1e-16)


def test_growth_beyond_the_largest_float():
    """y' = y^2 reaches infinity at t = 1, which a fixed step finds out somewhat later; a sum may overflow alone."""
    with np.errstate(all="ignore"):
        found = run(lambda t, y: y * y, (0, 2), [1.0], h=0.01)
        sums = run(lambda t, y: np.full(1, 1e308), (0, 100), [1e308], method=EIPRK3, h=1.0)
    assert found.status == sums.status == -1
    assert np.isfinite(found.y).all()
    assert 1.0 < found.t[-1] < 1.1
    assert "non-finite" in found.message
    assert sums.message.startswith("the state is no longer finite at t=1")
    assert sums.t.tolist() == [0.0]


@metrics
def test_an_invariant_that_the_frame_holds(metric):
    """Only rounding is left of the gradient, in any direction; a compensated run sees the residual in every step."""
    n = 6
    total = np.repeat([0.0, 1.0], n)
    frame = np.kron(np.eye(2), np.ones((1, n))), np.kron(np.eye(2), np.ones((n, 1)))

    def forces(t, y):  # Toda's lattice
        pull = np.exp(y[:n] - np.roll(y[:n], -1))
        return np.concatenate([y[n:], np.roll(pull, 1) - pull])

    def slope(t, y):
        f = forces(t, y)
        return np.concatenate([-f[n:], f[:n]])

    energy = Invariant(lambda t, y: y[n:] @ y[n:] / 2 + np.exp(y[:n] - np.roll(y[:n], -1)).sum(), slope)
    momentum = Invariant(lambda t, y: total @ y, lambda t, y: total)
    options = {"method": EIPDOP853, "h": 0.05, "linear_invariants": frame, "metric": metric, "compensated": True}
    y0 = np.random.default_rng(4).standard_normal(2 * n)
    found, alone = (run(forces, (0, 20), y0, invariants=kept, **options) for kept in ([momentum, energy], energy))
    assert found.success
    assert found.trusted
    np.testing.assert_allclose(found.y[:, -1], alone.y[:, -1], rtol=0, atol=1e-9)
    assert found.max_residual.max() < 1e-13


# Corrections that fail are tried again with one direction less.


def bent(slopes, bend, target, along):
    """I = slopes . y + bend y_along^2."""
    slopes = np.array(slopes)

    def gradient(t, y):
        out = slopes.copy()
        out[along] += 2 * bend * y[along]
        return out

    return Invariant(lambda t, y: slopes @ y + bend * y[along] ** 2, gradient, target=target)


def place(k, bend=0.0):
    """The coordinate k itself."""
    return bent(np.eye(3)[k], bend, 0.0, k)


@pytest.mark.filterwarnings("ignore:the projection left:eip_scipy.ProjectionWarning")  # what is left out stays
@pytest.mark.parametrize(("slope", "bend"), [(1e-3, 1.0), (0.2, 1e3)])
def test_the_last_direction_is_left_out(slope, bend):
    """A step of 5e-4 / slope along y1 increases the second invariant's residual by its curvature: y1 is not moved."""
    nearly = bent([1.0, slope, 0.0], bend, -0.5e-3, along=1)
    result = project([1e-3, 0.0, 0.0], [place(0), nearly])
    assert result.rank == 1
    np.testing.assert_allclose(result.y, 0.0, atol=1e-18)
    np.testing.assert_allclose(result.residual, [0.0, 0.5e-3], atol=1e-18)
    three = project([1e-3, 0.0, 2e-3], [place(0), nearly, place(2)])
    assert three.rank == 2
    np.testing.assert_allclose(three.y, 0.0, atol=1e-18)


@pytest.mark.filterwarnings("ignore:the projection left:eip_scipy.ProjectionWarning")
def test_what_is_left_may_not_exceed_the_residuals_of_all():
    """Residuals of 1.0e-3 and 1.5e-3: the second may become 5.0e-3, twice their sum. It is 0.5e-3 + rise 1e-6."""

    def nearly(rise):
        return Invariant(
            lambda t, y: y[0] + 1e-3 * y[1] + y[1] ** 2 + rise * (y[0] - 1e-3) ** 2,
            lambda t, y: np.array([1.0 + 2 * rise * (y[0] - 1e-3), 1e-3 + 2 * y[1], 0.0]),
            target=-0.5e-3,
        )

    assert project([1e-3, 0.0, 0.0], [place(0), nearly(4.4e3)]).rank == 1
    with pytest.raises(ValueError, match=r"invariant 'invariant 1', residual 0\.0051, rank 1 of 2"):
        project([1e-3, 0.0, 0.0], [place(0), nearly(4.6e3)])
    with pytest.raises(ValueError, match="rank 1 of 1"):  # a single direction is not left out
        project(np.zeros(3), bent([1e-3, 0.0, 0.0], 1e3, 1.0, along=0))


@pytest.mark.parametrize("method", [eip_scipy.EIPRK23, EIPRK45, EIPDOP853])
def test_targets_that_contradict_each_other_end_the_run(method):
    """With drag an orbit of this angular momentum has no such energy; steps of 1e-12 would stay near the targets."""
    drag, problem = 1e-3, kepler(0.0, relativistic=0.0)

    def fun(t, y):
        return problem.fun(t, y) - drag * np.concatenate([[0, 0], y[2:]])

    def energy(t, y):
        return 0.5 * (y[2:] @ y[2:]) - 1 / np.sqrt(y[:2] @ y[:2])

    kept = [Balance(energy, lambda t, y: -drag * (y[2:] @ y[2:])), problem.invariants[1]]
    with pytest.warns(UserWarning, match="not an invariant of this system"):
        run = integrate(fun, (0, 100), problem.y0, method=method, rtol=1e-7, atol=1e-8, invariants=kept)
    assert run.status == -1
    assert "projection failed" in run.message
    assert run.nfev < 100_000
