"""`equations` with functions of time, and with constraints that are kept only if all of them hold."""

import pickle

import numpy as np
import pytest
import sympy
from sympy.physics.mechanics import dynamicsymbols

from eip_scipy import EIPDOP853, equations, hamiltonian, integrate
from eip_scipy.problems import mechanism

TIME = dynamicsymbols._t
x, y, u, v = dynamicsymbols("x y u v")
g, l = sympy.symbols("g l")  # noqa: E741
S = (u**2 + v**2 - g * y) / l**2  # of the rod's force, where its length is l
MOTION = {x: u, y: v, u: -S * x, v: -S * y - g}
CONSTRAINTS = {"length": x**2 + y**2 - l**2, "rate": x * u + y * v}
ENERGY = {"energy": (u**2 + v**2) / 2 + g * y}
PARAMETERS = {g: 9.81, l: 1}


@pytest.fixture(scope="module")
def pendulum():
    return equations(MOTION, params=PARAMETERS, constraints=CONSTRAINTS, invariants=ENERGY)


def test_constraints_hold_where_all_of_them_do(pendulum):
    assert set(pendulum.checks) == {"length", "rate", "energy"}
    assert set(pendulum.checks.values()) == {"numerically, at 8 points that meet the constraints"}
    assert "length = -l**2 + x**2 + y**2 = 0 (numerically" in repr(pendulum)
    assert [item.target for item in pendulum.invariants] == [0, 0, None]
    again = pickle.loads(pickle.dumps(pendulum))
    assert [item.target for item in again.invariants] == [0, 0, None]
    # The masses and the rod alone give the same motion.
    other = mechanism([1, 1], [0, -9.81], lambda t, q: [q[0] ** 2 + q[1] ** 2 - 1], q0=[0.6, -0.8], u0=[0.8, 0.6])
    np.testing.assert_allclose(pendulum.fun(0.0, other.y0), other.motion_at(0.0, other.y0), rtol=1e-14)


def test_a_run_keeps_them(pendulum):
    found = integrate(pendulum, (0, 5), [0.6, -0.8, 0.8, 0.6], method=EIPDOP853, rtol=1e-6, atol=1e-6)
    assert found.trusted
    assert found.max_residual.max() < 1e-11
    with pytest.raises(ValueError, match=r"violates invariant 'length' by 0\.21"):
        integrate(pendulum, (0, 5), [1.1, 0, 0, 0], method=EIPDOP853, rtol=1e-6, atol=1e-6)


def test_derivatives_stand_for_what_they_are_equal_to(pendulum):
    rate = {"length": CONSTRAINTS["length"], "rate": (x**2 + y**2).diff(TIME) / 2}
    by_rates = {key.diff(TIME): value for key, value in MOTION.items()}
    for given in (by_rates, {x.diff(): u, y.diff(): v, u.diff(): -S * x, v.diff(): -S * y - g}):
        found = equations(given, params=PARAMETERS, constraints=rate, invariants=ENERGY)
        assert found.system == pendulum.system
    speeds = {u: x.diff(), v: y.diff()}
    second = {x: x.diff(), y: y.diff(), x.diff(): (-S * x).subs(speeds), y.diff(): (-S * y - g).subs(speeds)}
    found = equations(second, params=PARAMETERS, constraints=rate)
    assert found.system.components == ("x", "y", "v_x", "v_y")
    state = np.array([0.3, 0.4, 0.5, 0.6])
    np.testing.assert_array_equal(found.fun(0.0, state), pendulum.fun(0.0, state))
    assert equations([u, -x - x.diff()], [x, u]).fun(0.0, np.array([1.0, 2.0])).tolist() == [2, -3]
    assert hamiltonian((x**2 + u**2) / 2, [x], [u]).system == hamiltonian("(x**2 + u**2)/2", "x", "u").system


def test_constraints_may_depend_on_time():
    # A bead on a rod that turns at the rate 1: its distance r from the axis obeys r'' = r.
    rod = {"rod": "x*sin(t) - y*cos(t)", "rate": "u*sin(t) - v*cos(t) + x*cos(t) + y*sin(t)"}
    force = "2*(u*cos(t) + v*sin(t))"  # across the rod
    found = equations({"x": "u", "y": "v", "u": f"-{force}*sin(t)", "v": f"{force}*cos(t)"}, constraints=rod)
    assert set(found.checks.values()) == {"numerically, at 8 points that meet the constraints"}


def test_what_is_wrong_is_said():
    both = CONSTRAINTS | {"long": x**2 + y**2 - 4}
    for options, match in [
        ({"constraints": {"length": CONSTRAINTS["length"]}}, r"its rate is 2\*u\*x \+ 2\*v\*y.*add that to"),
        ({"constraints": both}, "no state was found that meets 'length', 'rate'"),
        ({"constraints": CONSTRAINTS, "invariants": {"E": u**2 + g * y}}, "'E' is not an invariant .* even where the"),
        ({"invariants": ENERGY}, "If it is conserved only if constraints hold, pass them as constraints="),
        ({"constraints": CONSTRAINTS, "invariants": {"rate": x}}, "'rate' is the name of a constraint and of"),
        ({"constraints": {"length": sympy.Integer(1)}}, "does not depend on x, y, u, v"),
        ({"f": {x: u, u: -x - v.diff()}}, r"contains Derivative\(v\(t\), t\)"),
        ({"f": {x: u, u: -x - u.diff()}}, r"contains Derivative\(u\(t\), t\)"),
        ({"f": {x: u, u: -x}, "constraints": [x]}, "constraints must be a mapping"),
    ]:
        with pytest.raises((TypeError, ValueError), match=match):
            equations(**({"f": MOTION, "params": PARAMETERS} | options))
