"""Pickles and copies of dense output: without the functions of the run, and as accurate as the original."""

import copy
import multiprocessing
import pickle

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from systems import H_USES_F, H, L, energy, energy_gradient, momentum, momentum_gradient, orbit, pericentre

import eip_scipy
from eip_scipy import EIPRK4, Invariant, integrate
from eip_scipy.problems import kepler

Y0 = pericentre(0.6)
# Options of each method for a run of a few dozen steps.
RUNS = {name: {"rtol": 1e-6, "atol": 1e-9} for name in ("EIPRK23", "EIPRK45", "EIPDOP853", "EIPRKN8", "EIPRKN12")}
RUNS |= {name: {"h": 0.1} for name in ("EIPRK2", "EIPRK3", "EIPRK4", "EIPRK5", "EIPRKN12")}
RUNS["EIPRK1"] = {"h": 0.01}
RUNS |= {name: {"h": 0.008} for name in ("EIPGJ12", "EIPGJ14")}
each_method = pytest.mark.parametrize("name", RUNS)


def local_invariants():
    """Return invariants that do not pickle."""
    return [
        Invariant(lambda t, y: energy(t, y), lambda t, y: energy_gradient(t, y)),
        Invariant(lambda t, y: momentum(t, y), lambda t, y: momentum_gradient(t, y)),
    ]


def assert_same_states(found, expected, times):
    """Compare to 1e-12 of each component's largest value, and exactly at the steps."""
    states, other = expected(times), found(times)
    assert np.all(np.abs(other - states).max(axis=1) <= 1e-12 * np.abs(states).max(axis=1))
    np.testing.assert_array_equal(found(expected.ts), expected(expected.ts))
    np.testing.assert_allclose(found(times[5]), states[:, 5], rtol=0, atol=1e-14 * np.abs(states).max())


@each_method
@pytest.mark.parametrize("kept", [True, False], ids=["projected", "plain"])
def test_pickled_dense_output(name, kept):
    """Solutions of solve_ivp and of integrate pickle with functions that do not; the invariants hold as before."""
    invariants = local_invariants() if kept else ()
    method = getattr(eip_scipy, name)
    options = {**RUNS[name], "dense_output": True, "invariants": invariants}
    theirs = solve_ivp(lambda t, y: orbit(t, y), (0, 3), Y0, method=method, **options)
    ours = integrate(lambda t, y: orbit(t, y), (0, 3), Y0, method=method, compiled=False, **options)
    times = np.linspace(0, 3, 203)
    for solution in (theirs.sol, ours.sol):
        found = pickle.loads(pickle.dumps(solution))
        assert_same_states(found, solution, times)
        assert_same_states(pickle.loads(pickle.dumps(found)), solution, times)
        if kept:
            start = np.array([energy(0, Y0), momentum(0, Y0)])[:, None]
            drift, before = (
                np.abs(np.array([energy(0, y), momentum(0, y)]) - start).max() for y in (found(times), solution(times))
            )
            assert drift < before + 1e-13
        same = copy.deepcopy(solution)
        np.testing.assert_array_equal(same(times), solution(times))
        np.testing.assert_array_equal(copy.copy(solution.interpolants[0])(0.01), solution.interpolants[0](0.01))
    result = pickle.loads(pickle.dumps(ours))
    assert_same_states(result.sol, ours.sol, times)
    np.testing.assert_array_equal(copy.deepcopy(ours).sol(times), ours.sol(times))


def work(e):
    """Run new functions in a worker process, and return a solution."""
    y0 = pericentre(e)
    return solve_ivp(
        lambda t, y: orbit(t, y), (0, 3), y0, method=EIPRK4, h=0.1, dense_output=True, invariants=local_invariants()
    )


def test_workers_return_dense_output():
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        (found,) = pool.map(work, [0.6])
    assert_same_states(found.sol, work(0.6).sol, np.linspace(0, 3, 50))


@pytest.mark.parametrize(
    "options",
    [
        {"invariants": [H_USES_F, L]},
        {"invariants": [H, L], "every": 3},
        {"invariants": [H, L], "t_span": (8.0, 0.0)},
        {"invariants": [H, L], "t_span": (1e6, 1e6 + 8.0)},
        {"invariants": [H, L], "metric": "euclidean", "h": 0.2},
    ],
    ids=["uses_f", "every 3", "backward", "late", "long steps"],
)
def test_other_curves(options):
    options = {"t_span": (0.0, 8.0), "rtol": 1e-5, "atol": 1e-8, **options}
    if "h" in options:
        del options["rtol"], options["atol"]
    sol = solve_ivp(orbit, y0=Y0, method=EIPRK4, dense_output=True, **options).sol
    times = np.linspace(*options["t_span"], 501)
    assert_same_states(pickle.loads(pickle.dumps(sol)), sol, times)


def test_a_complex_state():
    norm = Invariant(lambda t, y: np.vdot(y, y).real, lambda t, y: 2 * y)
    run = integrate(
        lambda t, y: -1j * abs(y) ** 2 * y,
        (0, 2),
        [0.8, 0.6j],
        method=EIPRK4,
        h=0.1,
        invariants=norm,
        dense_output=True,
    )
    assert_same_states(pickle.loads(pickle.dumps(run.sol)), run.sol, np.linspace(0, 2, 77))


def test_steps_of_a_few_roundings():
    """Between whose ends there are fewer times than a polynomial has nodes."""
    options = {"method": EIPRK4, "h": 4e-15, "dense_output": True, "invariants": [H, L], "check": False}
    sol = solve_ivp(orbit, (1.0, 1.0 + 8e-15), Y0, **options).sol
    found = pickle.loads(pickle.dumps(sol))
    times = np.unique(np.linspace(1.0, 1.0 + 8e-15, 9))
    np.testing.assert_allclose(found(times), sol(times), rtol=0, atol=1e-15)


def test_long_runs_of_compiled_functions():
    """Thousands of steps, whose pieces lie in one array."""
    run = integrate(kepler(), (0, 60), method=EIPRK4, h=0.05, dense_output=True)
    found = pickle.loads(pickle.dumps(run.sol))
    assert len(found.interpolants) == 1200
    assert_same_states(found, run.sol, np.linspace(0, 60, 5001))
