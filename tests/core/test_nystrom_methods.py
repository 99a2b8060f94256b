"""Runge-Kutta-Nystrom methods: orders of steps and of what is between them."""

import numba
import numpy as np
import pytest
from closed_forms import kepler_state
from orders import observed_order
from scipy.integrate import solve_ivp
from systems import JIT_H, JIT_L

from eip_scipy import EIPGJ12, EIPRKN8, EIPRKN12, Invariant, eip_method, integrate
from eip_scipy.methods import NystromTableau
from eip_scipy.problems import kepler

Y0 = np.array([0.8, 0.1, -0.2, 1.1])
both = pytest.mark.parametrize("method", [EIPRKN8, EIPRKN12])


def pull(t, q):
    return -q / (q[0] ** 2 + q[1] ** 2) ** 1.5


acceleration = numba.njit(pull)
KEPT = {"invariants": [JIT_H, JIT_L], "blocks": 2}


@pytest.fixture(scope="module")
def exact():
    return kepler_state(Y0, 2)


@pytest.mark.parametrize("options", [{"invariants": ()}, KEPT, {**KEPT, "metric": "euclidean"}])
@pytest.mark.parametrize(("method", "n"), [(EIPRKN8, (8, 12)), (EIPRKN12, (4, 5))])
def test_order(method, n, options, exact):
    """The steps of one interval are so large that truncation dominates."""
    given = {"acceleration": acceleration, "t_span": (0, 2), "y0": Y0, "method": method, "compiled": False, **options}
    errors = [np.abs(integrate(h=2 / k, **given).y[:, -1] - exact).max() for k in n]
    assert errors[1] > 3e-14
    assert observed_order(errors, [1 / k for k in n])[0] > method.TABLEAU.order - 1.0


@both
def test_time_reaches_every_stage(method):
    """q'' = -9 sin 3t from t0 = 0.4: exact q = sin 3t."""
    start, end = (np.array([np.sin(3 * t), 3 * np.cos(3 * t)]) for t in (0.4, 2.4))
    for compensated in (False, True):
        given = {"t_span": (0.4, 2.4), "y0": start, "method": method, "h": 0.05, "compensated": compensated}
        run = integrate(acceleration=lambda t, q: np.array([-9 * np.sin(3 * t)]), **given)
        np.testing.assert_allclose(run.y[:, -1], end, rtol=0, atol=1e-10)


def test_auto_projects_where_it_pays():
    """Large steps are projected one and all; small ones, whose error is below round-off, at the end only."""
    counts = []
    for h in (0.5, 0.005):
        run = integrate(acceleration=acceleration, t_span=(0, 10), y0=Y0, method=EIPRKN12, h=h, every="auto", **KEPT)
        counts.append((run.diagnostics.n_projections + run.diagnostics.n_skipped, round(10 / h)))
    assert counts[0][0] == counts[0][1]
    assert counts[1][0] <= 3


# Between the steps: samples, dense output and events as accurate as the steps.

STEPS = [{"rtol": 1e-10, "atol": 1e-13}, {"rtol": 1e-12, "atol": 1e-15}, {"h": 0.1}]
steps = pytest.mark.parametrize("options", STEPS, ids=["1e-10", "1e-12", "fixed"])
ECCENTRICITY, END = 0.6, 50.0
TIMES = np.linspace(0.0, END, 501)


def logarithmic(t, q):
    return -np.array([q[0], q[1] / 0.64]) / (0.1 + q[0] ** 2 + q[1] ** 2 / 0.64)


def exact_kepler(t):
    """Return the orbit from its pericentre at t = 0, by Kepler's equation, as (4, m)."""
    t, e = np.asarray(t, float), ECCENTRICITY
    u = t + e * np.sin(t)
    for _ in range(60):
        u = u - (u - e * np.sin(u) - t) / (1 - e * np.cos(u))
    b, r = np.sqrt(1 - e * e), 1 - e * np.cos(u)
    return np.array([np.cos(u) - e, b * np.sin(u), -np.sin(u) / r, b * np.cos(u) / r])


PROBLEM = kepler(ECCENTRICITY, relativistic=0.0)
KEPLER = {"y0": PROBLEM.y0, "invariants": PROBLEM.invariants}
GALACTIC_ENERGY = Invariant(lambda t, y: 0.5 * (y[2] ** 2 + y[3] ** 2 + np.log(0.1 + y[0] ** 2 + y[1] ** 2 / 0.64)))
GALACTIC = {"y0": np.array([1.0, 0.0, 0.1, 0.8]), "invariants": [GALACTIC_ENERGY]}


@pytest.fixture(scope="module")
def exact_galactic():
    """Return the galactic orbit by steps so short that both methods and their interpolants agree to 1e-13."""
    fine = {"h": 0.025, "compensated": True, "dense_output": True, **GALACTIC}
    return integrate(acceleration=logarithmic, t_span=(0, END), method=EIPRKN12, **fine).sol


def field(acceleration):
    return lambda t, y: np.concatenate([y[2:], acceleration(t, y[:2])])


def largest(difference):
    return np.abs(difference).max()


@both
@steps
@pytest.mark.parametrize(("orbit", "kept"), [("kepler", True), ("kepler", False), ("galactic", True)])
def test_samples_are_as_accurate_as_the_steps(method, options, kept, orbit, exact_galactic):
    """The closed form of Kepler's problem, and a galactic orbit; 501 samples by all ways to them."""
    fun, acceleration, given, exact = {
        "kepler": (PROBLEM, pull, KEPLER, exact_kepler),
        "galactic": (field(logarithmic), logarithmic, GALACTIC, exact_galactic),
    }[orbit]
    given = {**given, **options, "method": method} | ({} if kept else {"invariants": ()})
    run = integrate(fun, (0, END), save_every=1, dense_output=True, **given)
    assert run.compiled == (orbit == "kepler")
    error = max(largest(run.y - exact(run.t)), 1e-14)
    sampled = integrate(fun, (0, END), t_eval=TIMES, **given)
    assert largest(sampled.y - exact(TIMES)) < 3 * error
    np.testing.assert_array_equal(run.sol(TIMES), sampled.y)
    np.testing.assert_array_equal(run.sol(run.t), run.y)
    y0 = given.pop("y0")
    run = solve_ivp(field(acceleration), (0, END), y0, dense_output=True, **given)
    error = max(largest(run.y - exact(run.t)), 1e-14)
    assert largest(run.sol(TIMES) - exact(TIMES)) < 3 * error


@both
@steps
def test_events_are_as_accurate_as_the_steps(method, options):
    """Passages of the apsides are at multiples of pi, where the radius is 1 - e or 1 + e."""
    apsis = lambda t, y: y[0] * y[2] + y[1] * y[3]  # noqa: E731
    given = {"method": method, "events": apsis, "compiled": False, **KEPLER, **options}
    run = integrate(acceleration=pull, t_span=(0.1, END), save_every=1, **{**given, "y0": exact_kepler([0.1])[:, 0]})
    error = max(largest(run.y - exact_kepler(run.t)), 1e-14)
    turns = np.pi * np.arange(1, 16)
    assert largest(run.t_events[0] - turns) < 3 * error
    assert largest(np.array(run.y_events[0]).T - exact_kepler(turns)) < 10 * error


@both
def test_samples_have_the_order_of_the_steps(method):
    """Halved steps divide the error of samples as they do that of the steps, of order p."""
    errors = []
    for h in (0.2, 0.1) if method is EIPRKN8 else (0.25, 0.125):
        given = {"method": method, "h": h, "t_eval": np.linspace(0, 2, 101), "compiled": False, **KEPLER}
        run = integrate(acceleration=pull, t_span=(0, 2), **given)
        errors.append(largest(run.y - exact_kepler(run.t)))
    assert np.log2(errors[0] / errors[1]) > method.TABLEAU.order - 2.0


@both
def test_backward_and_complex(method):
    """Dense output works for the orbit run backward, and in the complex plane as one component."""
    given = {"t_span": (0, -9), "method": method, "h": 0.05, "t_eval": -TIMES[:90], "compiled": False}
    run = integrate(acceleration=pull, **given, **KEPLER)
    assert largest(run.y - exact_kepler(run.t)) < (1e-9 if method is EIPRKN8 else 1e-13)
    y0 = KEPLER["y0"][::2] + 1j * KEPLER["y0"][1::2]
    plane = integrate(acceleration=lambda t, z: -z / abs(z) ** 3, y0=y0, **given)
    real = integrate(acceleration=pull, y0=KEPLER["y0"], **given)
    np.testing.assert_allclose([plane.y[0].real, plane.y[0].imag], real.y[:2], rtol=0, atol=1e-13)


@pytest.mark.parametrize(("method", "further"), [(EIPRKN8, 5), (EIPRKN12, 15)])
def test_evaluations_are_counted(method, further):
    """Each step with samples in it takes the interpolant's further stages, and no other step does."""
    given = {"method": method, "h": 0.1, "compiled": False, "y0": PROBLEM.y0}
    plain = integrate(acceleration=pull, t_span=(0, 5), **given)
    for count in (1, 20):
        times = 0.1 * np.arange(10, 20)[:, None] + 0.1 * (np.arange(count) + 0.5) / count
        assert (
            integrate(acceleration=pull, t_span=(0, 5), t_eval=times.ravel(), **given).nfev == plain.nfev + 10 * further
        )
    assert integrate(acceleration=pull, t_span=(0, 5), dense_output=True, **given).nfev == plain.nfev + 50 * further
    assert integrate(acceleration=pull, t_span=(0, 5), t_eval=plain.t, **given).nfev == plain.nfev


def test_multistep_runs_too_short_for_a_history():
    """Samples are those of the Nystrom method that starts the run, or, if accelerations depend on velocities, of the
    quintic with the slopes at both ends of each step, for which DOP853 needs four steps.
    """
    times = np.linspace(0, 1, 41)
    run = integrate(acceleration=pull, t_span=(0, 1), method=EIPGJ12, h=0.125, t_eval=times, compiled=False, **KEPLER)
    assert largest(run.y - exact_kepler(times)) < 1e-9

    def damped(t, y):
        return np.concatenate([y[2:], pull(t, y[:2]) - 0.05 * y[2:]])

    given = {"t_span": (0, 2), "y0": [0.8, 0.0, 0.0, 1.2], "t_eval": 2 * times}
    exact = solve_ivp(damped, method="DOP853", rtol=1e-12, atol=1e-14, **given).y
    run = integrate(damped, method=EIPGJ12, h=0.25, compiled=False, **given)
    assert largest(run.y - exact) < 5e-6


def test_methods_of_low_order_keep_the_quintic():
    """Nystrom's own method of order 4: the quintic through both ends errs about as much as the steps, for nothing."""
    weights = ["1/6", "1/3", 0], ["1/6", "2/3", "1/6"]
    tableau = NystromTableau("Nystrom 4", [[], ["1/8"], [0, "1/2"]], *weights, [0, "1/2", 1], 4)
    given = {"method": eip_method(tableau), "h": 0.02, "compiled": False, **KEPLER}
    run = integrate(acceleration=pull, t_span=(0, 5), save_every=1, dense_output=True, **given)
    times = np.linspace(0, 5, 333)
    assert run.nfev == integrate(acceleration=pull, t_span=(0, 5), **given).nfev
    assert largest(run.sol(times) - exact_kepler(times)) < 3 * largest(run.y - exact_kepler(run.t))
