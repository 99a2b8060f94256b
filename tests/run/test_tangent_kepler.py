"""Derivatives of Kepler's problem against its closed form, by all kinds of methods and interfaces."""

import mpmath
import numpy as np
import pytest
from closed_forms import kepler_flow
from numba import njit
from systems import jit_energy as energy
from systems import jit_momentum as momentum
from systems import jit_orbit as kepler
from systems import pericentre, refuse

from eip_scipy import EIPDOP853, EIPGJ14, EIPRK4, EIPRKN8, EIPRKN12, Invariant, eip_method, integrate, solve_ivp
from eip_scipy.problems import nbody

E = 0.6
START = pericentre(E)
END = 10 * np.pi  # five revolutions
acceleration = njit(lambda t, q: -q / (q[0] ** 2 + q[1] ** 2) ** 1.5)
KEPT = [Invariant(energy, name="H"), Invariant(momentum, name="L")]


@pytest.fixture(scope="module")
def matrix():
    with mpmath.workdps(40):
        start, t, shift = [mpmath.mpf(float(x)) for x in START], mpmath.mpf(END), mpmath.mpf(10) ** -15
        columns = []
        for k in range(4):
            ends = [kepler_flow([x + sign * shift * (i == k) for i, x in enumerate(start)], t) for sign in (1, -1)]
            columns.append([float((a - b) / (2 * shift)) for a, b in zip(*ends, strict=True)])
    return np.array(columns).T


def distance(found, matrix):
    return np.linalg.norm(found - matrix) / np.linalg.norm(matrix)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "steps", "worst", "gain"),
    [(EIPRK4, 400, 2e-6, 100), (EIPDOP853, 50, 2e-6, 50), (EIPRKN8, 60, 5e-8, 300), (EIPRKN12, 40, 2e-9, 100)],
)
def test_projected_columns_are_nearer(matrix, method, steps, worst, gain):
    options = {"method": method, "h": 2 * np.pi / steps}
    plain = integrate(kepler, (0, END), START, variations="state", **options)
    run = integrate(kepler, (0, END), START, invariants=KEPT, variations="state", symplectic=True, **options)
    assert run.trusted
    assert run.compiled
    assert distance(run.stm[-1], matrix) < worst
    assert distance(run.stm[-1], matrix) < distance(plain.stm[-1], matrix) / gain


@pytest.mark.parametrize("method", [EIPRK4, EIPDOP853, EIPRKN8])
def test_columns_fit_the_invariants_and_stay_symplectic(method):
    run = integrate(
        kepler, (0, END), START, method=method, h=0.05, invariants=KEPT, variations="state", symplectic=True
    )
    J = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.eye(2), np.zeros((2, 2))]])
    M = run.stm[-1]

    def gradients(y):
        r3 = np.hypot(*y[:2]) ** 3
        return np.array([[y[0] / r3, y[1] / r3, y[2], y[3]], [y[3], -y[2], -y[1], y[0]]])

    missed = gradients(run.y[:, -1]) @ M - gradients(START)
    assert np.abs(missed).max() < 1e-6 * np.abs(M).max()  # what the symplectic step moves, of second order
    exact = integrate(kepler, (0, END), START, method=method, h=0.05, invariants=KEPT, variations="state").stm[-1]
    assert np.abs(gradients(run.y[:, -1]) @ exact - gradients(START)).max() < 1e-12 * np.abs(exact).max()
    assert np.abs(M.T @ J @ M - J).max() < 1e-3 * np.abs(exact.T @ J @ exact - J).max()


@pytest.mark.parametrize(
    "options", [{"h": 0.05}, {"rtol": 1e-9, "atol": 1e-9}, {"h": 0.05, "every": 3}, {"h": 0.05, "compensated": True}]
)
@pytest.mark.parametrize("method", [EIPDOP853, EIPRKN8])
def test_states_are_those_of_the_run_without(method, options):
    t_eval = np.linspace(0, END, 7)
    both = [
        integrate(kepler, (0, END), START, method=method, invariants=KEPT, t_eval=t_eval, **options, **more)
        for more in ({}, {"variations": "state"})
    ]
    np.testing.assert_allclose(both[1].y, both[0].y, rtol=0, atol=1e-12)
    assert both[1].diagnostics.n_projections == both[0].diagnostics.n_projections


@pytest.mark.slow
def test_an_acceleration_and_a_run_that_goes_on(matrix):
    options = {"method": EIPRKN8, "h": np.pi / 30, "invariants": KEPT, "variations": "state"}
    whole = integrate(acceleration=acceleration, t_span=(0, END), y0=START, **options)
    parts = integrate(acceleration=acceleration, t_span=(0, END / 2), y0=START, **options).continue_to(END)
    assert whole.compiled
    assert whole.trusted
    assert parts.trusted
    assert distance(whole.stm[-1], matrix) < 1e-7
    assert distance(parts.stm[-1], whole.stm[-1]) < 1e-10


@pytest.mark.parametrize("method", [EIPDOP853, EIPRKN8, EIPGJ14])
def test_solve_ivp_has_the_same_columns(method):
    kept = [Invariant(item.function.py_func, name=item.name) for item in KEPT]
    options = {"invariants": kept, "h": 0.008 if method is EIPGJ14 else 0.05, "variations": "state"}
    run = integrate(kepler, (0, 3), START, method=method, **options)
    sol = solve_ivp(kepler, (0, 3), START, method, events=lambda t, y: y[1] - 0.5, dense_output=True, **options)
    np.testing.assert_array_equal(sol.variations[-1], run.stm[-1])
    assert sol.y.shape == (4, sol.t.size)
    assert sol.y_events[0].shape == (2, 4)
    assert sol.sol(1.0).shape == (4,)


@pytest.mark.parametrize("method", [EIPRK4, EIPRKN8])
def test_momentum_of_two_bodies_stays(method):
    problem = nbody([1.0, 0.5], [[0, 0, 0], [1, 0, 0]], [[0, -0.4, 0], [0, 0.5, 0]], t_span=(0, 10), G=1.0)
    run, momentum = integrate(problem, method=method, h=0.05, variations="state"), problem.linear_invariants[0][3:]
    assert np.abs(momentum @ run.stm[-1] - momentum).max() < 1e-12


def test_what_cannot_carry_them():
    class Euler:
        order, error_estimator_order = 1, None

        def one_step(self, t, y, h):
            return y + h * kepler(t, y)

    given = {"fun": kepler, "t_span": (0, 10), "y0": START, "variations": "state"}
    of_params = {"fun": lambda t, y, p: kepler(t, y), "params": [1.0], "variations": [0]}
    rows = [
        ({"method": EIPGJ14, "h": 0.02, "invariants": KEPT, "symplectic": True}, ValueError, "a multistep method"),
        ({"method": eip_method(Euler()), "h": 0.05}, ValueError, "carries no derivatives"),
        ({"method": EIPRKN8, "h": 0.05} | of_params, ValueError, "no derivatives with respect to parameters"),
    ]
    refuse(integrate, [(given | options, *rest) for options, *rest in rows])
    rows = [("Radau", ValueError, "EIPRadau carries no derivatives"), ("LSODA", TypeError, "takes no variations")]
    refuse(solve_ivp, [(given | {"method": method}, *rest) for method, *rest in rows])
