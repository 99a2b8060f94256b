"""`hamiltonian` with a perturbation or dissipation: what H alone keeps becomes a balance."""

import pickle

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from systems import SO3

from eip_scipy import EIPDOP853, EIPGJ12, Balance, hamiltonian, integrate

sympy = pytest.importorskip("sympy")
pytestmark = pytest.mark.needs_jit
KEPLER = "(px**2 + py**2)/2 - 1/sqrt(x**2 + y**2)"
MOMENTUM = {"H": KEPLER, "L": "x*py - y*px"}


def gain(problem, y0, t_end, h):
    """Return how much nearer to the truth a run with the balances ends than one without, and the run."""
    truth = solve_ivp(problem.fun, (0, t_end), y0, method="DOP853", rtol=1e-13, atol=1e-15).y[:, -1]
    options = {"method": EIPDOP853, "h": h}
    run, plain = (integrate(problem, (0, t_end), y0, **options, **more) for more in ({}, {"invariants": ()}))
    assert run.trusted
    return np.linalg.norm(plain.y[:, -1] - truth) / np.linalg.norm(run.y[:, -1] - truth), run


def test_a_driven_oscillator():
    problem = hamiltonian("p**2/2 + q**2/2 + q**4/4", perturbation="-a*q*cos(2.3*t)", params={"a": 1e-3})
    assert [type(item) for item in problem.invariants] == [Balance]
    assert str(problem.system.balances[0][2]) == "a*p*cos(23*t/10)"  # without the bracket of H with itself
    nearer, run = gain(problem, [1.0, 0.0], 300.0, 0.4)
    assert nearer > 30
    assert run.diagnostics.slowness[0] < 2e-3


def test_friction():
    problem = hamiltonian(KEPLER, dissipation={"px": "-c*px", "py": "-c*py"}, params={"c": 1e-6}, balances=MOMENTUM)
    assert [item.name for item in problem.invariants] == ["H", "L"]
    values = {symbol.name: symbol for symbol in problem.system.balances[1][2].free_symbols}
    wanted = -values["c"] * (values["x"] * values["py"] - values["y"] * values["px"])
    assert sympy.simplify(problem.system.balances[1][2] - wanted) == 0
    assert gain(problem, [0.8, 0.0, 0.0, 1.5**0.5], 100 * 2 * np.pi, 2 * np.pi / 16)[0] > 100


def test_in_positions_and_velocities_and_from_a_pickle():
    """The oscillator has a mass, so that momenta are not velocities."""
    problem = hamiltonian("p**2/(2*m) + k*q**2/2", perturbation="e*q**3", params={"m": 2.0, "k": 3.0, "e": 1e-3})
    second = problem.second_order()
    assert second.system.components == ("q", "v_q")
    run = integrate(second, (0, 50), [0.5, 0.0], method=EIPGJ12, h=0.02)
    same = integrate(problem, (0, 50), [0.5, 0.0], method=EIPDOP853, h=0.02)
    np.testing.assert_allclose(run.y[0, -1], same.y[0, -1], rtol=0, atol=1e-11)
    again = integrate(pickle.loads(pickle.dumps(problem)), (0, 50), [0.5, 0.0], method=EIPDOP853, h=0.02)
    np.testing.assert_array_equal(again.y, same.y)


def test_a_poisson_matrix():
    """A rigid body with a torque: both quadratic forms are balances."""
    forms = {"energy": "m1**2/2 + m2**2/4 + m3**2/6", "square": "m1**2 + m2**2 + m3**2"}
    problem = hamiltonian(forms["energy"], "m1 m2 m3", poisson=SO3, dissipation={"m1": "-c*m1"}, params={"c": 1e-4},
                          balances=forms)  # fmt: skip
    rates = [str(sympy.expand(rate)) for _, _, rate in problem.system.balances]
    assert rates == ["-c*m1**2", "-2*c*m1**2"]


def test_what_is_refused():
    for options, match in [
        ({"balances": {"H": KEPLER}}, "balances are given without a perturbation or dissipation"),
        ({"perturbation": "x", "extended": True}, "extended=True keeps"),
        ({"perturbation": "x*z"}, "perturbation contains z"),
        ({"dissipation": {"z": "-x"}}, "z is not a component of the state"),
        ({"dissipation": "-x"}, "must be a mapping"),
        ({"perturbation": "x", "balances": {"px": "px"}}, "'px' is not an invariant"),
        ({"H": "p**2/2 + q**2*(1 + t)/2", "perturbation": "q**3"}, "move such terms to perturbation="),
    ]:
        with pytest.raises((TypeError, ValueError), match=match):
            hamiltonian(**({"H": KEPLER} | options))
