"""States between steps and roots of events in the loop: those of solve_ivp, and of functions in Python."""

import warnings

import numpy as np
import pytest
from numba import njit
from scipy.integrate import solve_ivp
from scipy.interpolate import BPoly
from systems import same

import eip_scipy
from eip_scipy import EIPDOP853, EIPGJ12, EIPRK4, EIPRK23, EIPRK45, EIPRKN8, EIPRKN12, Invariant, ensemble, integrate
from eip_scipy.methods import NystromTableau
from eip_scipy.problems import kepler

pytestmark = pytest.mark.needs_jit
STEPS = {
    "RK4": (EIPRK4, {"h": 0.05}),
    "RK23": (EIPRK23, {"rtol": 1e-4}),
    "RK45": (EIPRK45, {"rtol": 1e-6}),
    "RK45, fixed": (EIPRK45, {"h": 0.05, "every": 3}),
    "DOP853": (EIPDOP853, {"rtol": 1e-7}),
    "RKN8": (EIPRKN8, {"h": 0.1}),
    "RKN12": (EIPRKN12, {"h": 0.3}),
}
methods = pytest.mark.parametrize(("method", "steps"), list(STEPS.values()), ids=list(STEPS))
NYSTROM = EIPRKN8, EIPRKN12
PROBLEM = kepler(t_end=30.0)
crossing = njit(lambda t, y, params: y[1])
apsis = njit(lambda t, y, params: y[0] * y[2] + y[1] * y[3])
clock = njit(lambda t, y, params: np.sin(3.0 * t + 0.1))
apsis.direction = 1.0
EVENTS = [crossing, apsis, clock]


@njit
def acceleration(t, q, params):
    r2 = q[0] * q[0] + q[1] * q[1]
    w = 1.0 / (r2 * np.sqrt(r2))
    return -(w + 1.5 * params[0] * w / r2) * q


def run(method, events=None, span=(0.0, 30.0), **options):
    """Return Kepler's problem by Numba functions; a Nystrom method gets its acceleration."""
    if method in NYSTROM:
        given = {"y0": PROBLEM.y0, "params": PROBLEM.params, "invariants": PROBLEM.invariants, "blocks": 2}
        return integrate(acceleration=acceleration, t_span=span, method=method, events=events, **given, **options)
    return integrate(PROBLEM, span, method=method, events=events, **options)


@methods
def test_roots_and_samples_of_compiled_and_interpreted_runs(method, steps):
    """Compiled and interpreted runs give the same bits."""
    span = (0.0, 30.0) if "h" in steps else (30.0, 0.0)
    times = np.linspace(*span, 500)
    options = {"t_eval": times, "events": EVENTS, "span": span, "dense_output": True, **steps}
    compiled, interpreted = run(method, **options), run(method, compiled=False, **options)
    assert compiled.compiled
    assert not interpreted.compiled
    assert [len(t) > 4 for t in compiled.t_events] == [True, True, True]
    same(compiled, interpreted)
    np.testing.assert_array_equal(compiled.sol(times), interpreted.sol(times))


@pytest.mark.parametrize(("method", "steps"), [STEPS["RK4"], STEPS["RK45"], STEPS["DOP853"]])
def test_integrate_and_solve_ivp_agree(method, steps):
    """Values at t_eval, roots and states there agree: SciPy's loop and this one, with the same functions in Python."""
    p = PROBLEM.params
    events = [lambda t, y, f=event: f(t, y, p) for event in EVENTS]
    events[1].direction = 1.0
    common = {"t_eval": np.linspace(0, 30, 500), "events": events, **steps}
    options = {"invariants": PROBLEM.invariants, "blocks": 2}
    sol = solve_ivp(PROBLEM.fun, (0, 30), PROBLEM.y0, method=method, dense_output=True, **common, **options)
    ours = integrate(PROBLEM.fun, (0, 30), PROBLEM.y0, method=method, dense_output=True, **common, **options)
    for name in ("t", "y"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(sol, name))
    for k in range(3):
        later = sol.t_events[k] > 0.0  # SciPy counts a zero at the start
        np.testing.assert_allclose(ours.t_events[k], sol.t_events[k][later], rtol=1e-15)  # brentq's is 8.9e-16
        np.testing.assert_allclose(ours.y_events[k], np.array(sol.y_events[k])[later], rtol=0, atol=1e-14)
    np.testing.assert_array_equal(ours.sol.ts, sol.sol.ts)
    np.testing.assert_array_equal(ours.sol(common["t_eval"]), sol.sol(common["t_eval"]))


def test_more_roots_than_the_loop_has_room_for():
    @njit
    def often(t, y, params):
        return np.sin(200.0 * t + 0.5)

    found = run(EIPRK4, often, h=0.01)
    roots = (np.pi * np.arange(1, found.t_events[0].size + 1) - 0.5) / 200.0
    assert roots.size > 1900
    assert roots[-1] <= 30.0 < roots[-1] + np.pi / 200.0
    np.testing.assert_allclose(found.t_events[0], roots, rtol=1e-15, atol=1e-14)


def test_an_event_that_is_nan_in_between():
    """Raise an error that names the event and the step."""

    @njit
    def broken(t, y, params):
        return np.nan if 1.0 < t < 1.04 else t - 1.02

    for compiled in (None, False):
        with pytest.raises(ValueError, match="NaN"):
            run(EIPRK4, broken, h=0.05, compiled=compiled)


@methods
def test_solution_over_the_run(method, steps):
    plain = run(method, save_every=1, **steps)
    kept = run(method, save_every=1, dense_output=True, **steps)
    np.testing.assert_array_equal(kept.y, plain.y)
    np.testing.assert_array_equal(kept.sol.ts, kept.t)
    np.testing.assert_array_equal(kept.sol(kept.t), kept.y)
    assert len(kept.sol.interpolants) == kept.t.size - 1
    assert plain.sol is None
    first, *_, last = kept.sol.interpolants
    assert (first.t_old, last.t) == (0.0, 30.0)
    assert kept.sol(5.0).shape == (4,)
    times = np.linspace(0, 30, 777)
    np.testing.assert_array_equal(kept.sol(times), run(method, t_eval=times, **steps).y)
    assert [piece.t for piece in kept.sol.interpolants[1:3]] == kept.t[2:4].tolist()


NYSTROM4 = NystromTableau(
    "Nystrom 4", [[], ["1/8"], [0, "1/2"]], ["1/6", "1/3", 0], ["1/6", "2/3", "1/6"], [0, "1/2", 1], 4
)


@pytest.mark.parametrize("method", [EIPRK4, eip_scipy.eip_method(NYSTROM4)])
def test_interpolants_are_hermite_s(method):
    """Interpolation is SciPy's, by values and slopes at both ends; for Nystrom methods by accelerations too."""
    y0, params = PROBLEM.y0, PROBLEM.params
    given = {"fun": PROBLEM.fun} if method is EIPRK4 else {"acceleration": acceleration, "params": params}
    found = integrate(**given, t_span=(0, 1), y0=y0, method=method, h=0.1, save_every=1, dense_output=True)
    slopes = np.array([PROBLEM.fun(t, y) for t, y in zip(found.t, found.y.T, strict=True)])
    times = np.linspace(0, 1, 97)
    if method is EIPRK4:
        expected = BPoly.from_derivatives(found.t, np.stack([found.y.T, slopes], axis=1))(times).T
    else:
        places = np.stack([found.y[:2].T, found.y[2:].T, slopes[:, 2:]], axis=1)
        spline = BPoly.from_derivatives(found.t, places)
        expected = np.concatenate([spline(times).T, spline.derivative()(times).T])
    np.testing.assert_allclose(found.sol(times), expected, rtol=0, atol=2e-14)


@pytest.mark.parametrize("method", [EIPRK23, EIPRK45, EIPDOP853])
def test_interpolants_join_the_states_from_which_steps_continue(method):
    """Steps of the class, which SciPy's loop takes, and of `integrate`, of which one in three is projected."""
    options = {"rtol": 1e-2, "first_step": 0.05, "max_step": 0.05, "dense_output": True, "every": 3}
    options |= {"method": method, "invariants": PROBLEM.invariants}
    stepped = solve_ivp(PROBLEM.fun, (0, 3), PROBLEM.y0, **options)
    looped = integrate(PROBLEM.fun, (0, 3), PROBLEM.y0, compiled=False, linear_invariants=None, **options)
    np.testing.assert_array_equal(stepped.sol(np.linspace(0, 3, 501)), looped.sol(np.linspace(0, 3, 501)))


SELDOM = {
    "RK4": (EIPRK4, {"h": 0.05, "every": 3}),
    "RK45": (EIPRK45, {"rtol": 1e-5, "every": 10}),
    "RK23, euclidean": (EIPRK23, {"rtol": 1e-4, "every": 7, "metric": "euclidean"}),
    "DOP853": (EIPDOP853, {"rtol": 1e-5, "every": 4}),
    "RKN8": (EIPRKN8, {"h": 0.1, "every": 50}),
    "RKN12, auto": (EIPRKN12, {"rtol": 1e-5, "every": "auto", "compensated": True}),
    "GJ12": (EIPGJ12, {"h": 0.01}),
}
seldom = pytest.mark.parametrize(("method", "steps"), list(SELDOM.values()), ids=list(SELDOM))


@seldom
def test_output_between_projections_lies_on_the_manifold(method, steps):
    """Rows, samples, dense output and states of events miss the targets by no more than projected steps do."""
    problem = kepler(0.6, relativistic=0.0, t_end=30.0)
    given = {"method": method, "check": False, **steps}
    plain = integrate(problem, (0, 30), **given)
    saved = integrate(problem, (0, 30), save_every=1, dense_output=True, events=apsis, **given)
    times = np.linspace(0, 30, 401)
    sampled = integrate(problem, (0, 30), t_eval=times, **given)
    level = max(plain.max_residual.max(), 1e-14)
    for run in (saved, sampled):
        assert np.abs(run.invariants - run.target[:, None]).max() < 1.01 * level
        assert np.all(run.max_residual >= np.abs(run.invariants - run.target[:, None]).max(axis=1))
    for t, y in zip(saved.t_events[0], saved.y_events[0], strict=True):
        values = [item.fun(t, y, *item.args) for item in problem.invariants]
        assert np.abs(values - saved.target).max() < 1.01 * level
    np.testing.assert_array_equal(saved.sol(saved.t), saved.y)
    np.testing.assert_array_equal(saved.sol(times), sampled.y)
    # The steps are the same, whatever is handed out.
    np.testing.assert_array_equal(saved.y[:, -1], plain.y[:, -1])
    np.testing.assert_array_equal(sampled.y[:, -1], plain.y[:, -1])
    # Rows and largest residuals of an ensemble are those of single runs, also with eight members at a time.
    starts = problem.y0 * (1 + 0.01 * np.arange(9))[:, None]
    rows = {"save_every": 1} if "h" in steps else {"t_eval": np.linspace(0, 3, 40)}
    many = ensemble(problem, (0, 3), starts, method=method, executor=1, **rows, **steps)
    single = integrate(problem, (0, 3), starts[8], method=method, check=False, **rows, **steps)
    np.testing.assert_array_equal(many.trajectories[8], single.y)
    np.testing.assert_array_equal(many.max_residual[8], single.max_residual)


def test_memory_of_the_solution():
    with pytest.raises(MemoryError, match="dense_output=True needs"):
        run(EIPRK4, h=1e-3, dense_output=True, max_bytes=1e6)
    with pytest.raises(MemoryError, match="dense_output=True needs"):
        run(EIPRK45, rtol=1e-12, span=(0.0, 500.0), dense_output=True, max_bytes=1e6)
    assert len(run(EIPRK45, rtol=1e-10, span=(0.0, 900.0), dense_output=True).sol.interpolants) > 2048


def test_a_checkpoint_keeps_no_solution(tmp_path):
    with pytest.raises(ValueError, match="save_every"):
        run(EIPRK4, h=0.1, dense_output=True, checkpoint=tmp_path / "run.npz")
    with pytest.raises(ValueError, match="dense_output"):
        run(EIPRK4, h=0.1, dense_output="yes")


def test_an_unprojected_state_is_told():
    """A level that no state near the interpolant meets is reported once, and the state is returned unchanged."""

    @njit
    def turn(t, y):
        return np.array([-y[1], y[0]])

    # In between the gradient leads away.
    value = njit(lambda t, y: y[0] ** 2 + y[1] ** 2)
    gradient = njit(lambda t, y: 2.0 * y if t % 0.5 == 0.0 else -0.2 * y)
    false = Invariant(value, gradient, name="norm")
    options = {"method": EIPRK4, "h": 0.5, "invariants": false, "check": False, "t_eval": [0.0, 0.25, 0.75, 1.0]}
    for compiled in (None, False):
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            integrate(turn, (0.0, 1.0), [1.0, 0.0], compiled=compiled, **options)
        told = [str(warning.message) for warning in told]
        assert any(line.startswith("dense output at t=0.25, and 1 more: ") for line in told)
