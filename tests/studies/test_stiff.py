"""The stiff problems of the study: two formulations agree, and the projection reduces the error."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from eip_scipy import EIPBDF, EIPRadau, check_gradient
from eip_scipy_studies.stiff.cases import CASES, chain_case, governor_case
from eip_scipy_studies.stiff.mechanisms import chain, governor, governor_by_angles


@pytest.mark.parametrize("name", CASES)
def test_invariants_are_those_of_the_equations(name):
    """Gradients, and rates along the flow in the state after a short time."""
    case = CASES[name]()
    t = 1e-3 * case.end
    y = solve_ivp(case.fun, (0, t), case.y0, method="Radau", rtol=1e-9, atol=1e-12 * case.size).y[:, -1]
    for item in case.invariants:
        check_gradient(item, t, y)
        rows = np.atleast_2d(item.grad(t, y))
        rates, terms = rows @ case.fun(t, y), np.abs(rows) @ np.abs(case.fun(t, y))
        assert np.all(np.abs(rates) <= 1e-6 * terms + 1e-9)


def test_the_governor_is_that_of_the_library():
    """The slider's height in natural coordinates, in angles, and as computed elsewhere, after 2 s."""
    fun, start, height = governor_by_angles()
    sol = solve_ivp(fun, (0, 2), start, method="Radau", rtol=1e-9, atol=1e-11)
    assert abs(height(sol.y[:, -1]) - 0.505909094508515) < 1e-8
    made = governor()
    sol = solve_ivp(made.fun, (0, 2), made.y0, method=EIPRadau, rtol=1e-7, atol=1e-9, invariants=made.invariants)
    assert abs(1 + sol.y[2, -1] - 0.505909094508515) < 1e-8


def test_the_chain_in_angles_is_the_same():
    case = chain_case(end=0.5)
    error, _ = case.error(EIPRadau, 1e-8, invariants=case.invariants)
    assert error < 1e-8


ANGLES = [(1.2, 0.9, 0.5), (1.1, 0.8, 0.6), (1.25, 0.95, 0.45)]


@pytest.mark.parametrize(
    ("rtol", "starts"), [(1e-5, 1), pytest.param(1e-4, 3, marks=[pytest.mark.nightly, pytest.mark.slow])]
)
def test_projection_pays_on_the_chain(rtol, starts):
    """Single runs scatter with rounding errors, which BLAS threads change; the study takes the mean of five starts."""
    gains, calls = [], []
    for angles in ANGLES[:starts]:
        case = chain_case(angles, end=2.0)
        error, count = case.error("Radau", rtol, 1.0)
        kept, kept_count = case.error(EIPRadau, rtol, 1.0, invariants=case.invariants)
        gains.append(error / kept)
        calls.append(kept_count / count)
    assert np.exp(np.mean(np.log(gains))) > 5
    assert np.mean(calls) < 1.4


@pytest.mark.nightly
@pytest.mark.slow
def test_projection_pays_on_the_governor():
    case = governor_case(end=4.0)
    for base, own in (("Radau", EIPRadau), ("BDF", EIPBDF)):
        error, calls = case.error(base, 1e-4)
        kept, kept_calls = case.error(own, 1e-4, invariants=case.invariants)
        assert kept < error / 4
        assert kept_calls < 1.35 * calls


def test_the_dampers_do_nothing_to_a_chain_that_turns_as_a_whole():
    loose, stiff = (chain([1.2, 0.9, 0.5], damping) for damping in (0.0, 1e4))
    q = loose.y0[:6]
    v = np.concatenate([[-y, x] for x, y in q.reshape(-1, 2)])
    np.testing.assert_allclose(loose.forces(q, v), stiff.forces(q, v), atol=1e-9)
    assert abs(stiff.forces(q, v * [1, 1, 1, 1, 2, 2]) - loose.forces(q, v)).max() > 1e3
