"""Dense output pickles without the functions of its run: the interpolant, whose samples are not projected."""

import copy
import pickle

import numpy as np
import pytest
from systems import H, L, energy, orbit, pericentre

import eip_scipy
from eip_scipy import integrate, solve_ivp

Y0, TIMES = pericentre(0.6), np.linspace(0, 3, 203)
RUNS = {name: {"rtol": 1e-6, "atol": 1e-9} for name in ("EIPRK45", "EIPDOP853", "EIPRKN8", "EIPRKN12", "EIPRadau")}
RUNS |= {"EIPRK4": {"h": 0.02}, "EIPGJ12": {"h": 0.008}, "EIPGJ14": {"h": 0.008}}


def runs(name, **options):
    options |= {"method": getattr(eip_scipy, name), "dense_output": True} | RUNS[name]
    for solve in (integrate, solve_ivp):
        yield solve(lambda t, y: orbit(t, y), (0, 3), Y0, **options)


@pytest.mark.parametrize("name", RUNS)
def test_without_invariants_it_is_the_same(name):
    for run in runs(name):
        found = pickle.loads(pickle.dumps(pickle.loads(pickle.dumps(run.sol))))
        np.testing.assert_allclose(found(TIMES), run.sol(TIMES), rtol=1e-12, atol=1e-13)
        np.testing.assert_array_equal(found(run.sol.ts), run.sol(run.sol.ts))
        np.testing.assert_allclose(found(TIMES[5]), found(TIMES)[:, 5], rtol=1e-14, atol=1e-15)  # BLAS sums in two ways


@pytest.mark.parametrize("name", RUNS)
def test_with_invariants_samples_are_not_projected(name):
    for run in runs(name, invariants=[H, L]):
        found, projected = pickle.loads(pickle.dumps(run.sol)), run.sol(TIMES)
        np.testing.assert_allclose(found(TIMES), projected, rtol=0, atol=1e-4)
        np.testing.assert_array_equal(found(run.sol.ts), run.sol(run.sol.ts))
        np.testing.assert_array_equal(copy.deepcopy(run.sol)(TIMES), projected)
        drift = [max(abs(energy(0, y) - energy(0, Y0)) for y in states.T) for states in (found(TIMES), projected)]
        assert drift[0] > drift[1] or name.startswith("EIPGJ")


@pytest.mark.parametrize("method", [eip_scipy.EIPRK4, eip_scipy.EIPRK45, eip_scipy.EIPDOP853])
@pytest.mark.parametrize("factor", [1.0, 1j])
def test_complex_states_and_odd_numbers_of_components(method, factor):
    run = integrate(lambda t, y: factor * y, (0, 1), [1.0 * factor], method=method, dense_output=True, rtol=1e-6)
    np.testing.assert_allclose(pickle.loads(pickle.dumps(run.sol))(TIMES / 3), run.sol(TIMES / 3), rtol=1e-14)
