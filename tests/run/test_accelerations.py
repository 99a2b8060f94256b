"""One meaning of `fun` for all methods: the derivative of y = (q, v); accelerations have a separate argument."""

import math
from itertools import product

import numpy as np
import pytest
from numba import njit
from scipy.integrate import solve_ivp
from systems import refuse

import eip_scipy
from eip_scipy import EIPGJ12, EIPRK4, EIPRKN8, EIPRKN12, Invariant, integrate

Y0 = np.array([1.0, 0.5, 0.2, -0.3])
SECOND_ORDER = {EIPRKN8: {"rtol": 1e-11, "atol": 1e-13}, EIPRKN12: {"rtol": 1e-11, "atol": 1e-13}}
SECOND_ORDER |= {EIPGJ12: {"h": 0.02}}
ENERGY = Invariant(
    lambda t, y, p: 0.5 * (p[0] * y[:2] @ y[:2] + y[2:] @ y[2:]), lambda t, y, p: np.append(p[0] * y[:2], y[2:])
)


def spring(t, q):
    return -4 * q


def spring_in_place(t, q, out):
    out[0], out[1] = -4 * q[0], -4 * q[1]  # all at once takes Numba five seconds to compile


def spring_of_two(t, q):
    x, y = q
    return [-4 * x, -4 * y]


def field(t, y):
    return np.append(y[2:], -4 * y[:2])


JITTED = {fun: njit(fun) for fun in (spring, spring_in_place, field)}


def exact(t):
    """Return the closed form of q'' = -4 q."""
    q, v = Y0[:2], Y0[2:]
    return np.append(q * np.cos(2 * t) + v / 2 * np.sin(2 * t), v * np.cos(2 * t) - 2 * q * np.sin(2 * t))


@pytest.mark.slow
@pytest.mark.parametrize("method", SECOND_ORDER)
def test_accelerations_and_fields_of_second_order_methods(method):
    ways = [{"fun": field}, {"fun": JITTED[field]}]
    ways += [{"acceleration": fun} for fun in (spring, JITTED[spring])]
    ways += [{"acceleration": fun, "in_place": True} for fun in (spring_in_place, JITTED[spring_in_place])]
    ways += [{"acceleration": lambda t, q, params: -params[0] * q, "params": [4.0], "invariants": ENERGY}]
    for way in ways:
        run = integrate(t_span=(0, 3), y0=Y0, method=method, **SECOND_ORDER[method], **way)
        np.testing.assert_allclose(run.y[:, -1], exact(3), rtol=0, atol=2e-10)
        assert next(iter(run.calls)) == next(iter(way))
        np.testing.assert_allclose(run.continue_to(4).y[:, -1], exact(4), rtol=0, atol=4e-10)


def test_every_method_takes_accelerations():
    """Runge-Kutta methods have the bits of the field derived from accelerations."""
    run = integrate(acceleration=spring, t_span=(0, 3), y0=Y0, method=EIPRK4, h=0.01)
    np.testing.assert_array_equal(run.y, integrate(field, (0, 3), Y0, method=EIPRK4, h=0.01).y)


def test_an_acceleration_as_fun_gets_a_note():
    """The acceleration of q, called with y, gives n/2 values or raises."""
    accelerations = spring_of_two, lambda t, q: -4 * q[:2]
    for solve, fun, method in product((integrate, solve_ivp, eip_scipy.solve_ivp), accelerations, (EIPRKN12, EIPGJ12)):
        with pytest.raises(ValueError, match=r"unpack|expected") as info:
            solve(fun, (0, 1), Y0, method=method, h=0.01)
        assert "integrate(acceleration=fun, t_span=..., y0=..., ...)" in info.value.__notes__[0]


def test_what_is_neither():
    """The function is not a first-order field of (q, v); errors of the user's own function are passed on."""
    given = {"t_span": (0, 1), "y0": Y0, "method": EIPRKN12, "rtol": 1e-8}
    rows = [
        ({"fun": lambda t, y: -y, "y0": [1.0, 0.0]}, ValueError, "acceleration=fun"),
        ({"fun": lambda t, y: {}["mass"]}, KeyError, "mass"),
        ({"fun": field, "acceleration": spring}, TypeError, "give fun or acceleration, not both"),
        ({}, TypeError, "fun is missing"),
        ({"acceleration": 3}, TypeError, "acceleration must be callable"),
        ({"acceleration": lambda t, q, v: -v}, TypeError, r"'v'.*the right-hand side fun\(t, y\)"),
    ]
    refuse(integrate, [(given | options, *rest) for options, *rest in rows])
    message = r"first 1 components of fun must be v.*or eip_scipy\.solve_ivp"
    refuse(solve_ivp, [(given | rows[0][0], ValueError, message), (given | rows[1][0], KeyError, "mass")])


def test_accelerations_that_depend_on_velocities():
    """Accelerations are the second half of fun: q'' = -q - v/50, whose solution decays as exp(-t/100)."""
    rate = math.sqrt(1 - 1e-4)
    run = integrate(lambda t, y: np.array([y[1], -y[0] - y[1] / 50]), (0, 10), [1.0, -0.01], method=EIPGJ12, h=0.01)
    np.testing.assert_allclose(run.y[0, -1], math.exp(-0.1) * math.cos(10 * rate), rtol=0, atol=1e-12)
