"""Coefficients of solver classes, as in SciPy's Runge-Kutta classes, and classes made of such classes."""

import numpy as np
import pytest
from scipy.integrate import DOP853, LSODA, RK23, RK45, OdeSolver, solve_ivp
from systems import PENDULUM_ENERGY, pendulum

from eip_scipy import EIPDOP853, EIPRK23, EIPRK45, eip_method, integrate

NAMES = ("order", "error_estimator_order", "n_stages", "A", "B", "C", "E", "P")


class CashKarp(RK45.__bases__[0]):
    """Cash and Karp's pair as a class like SciPy's, without dense output."""

    order, error_estimator_order, n_stages = 5, 4, 6
    C = np.array([0, 1 / 5, 3 / 10, 3 / 5, 1, 7 / 8])
    A = np.array(
        [
            [0, 0, 0, 0, 0],
            [1 / 5, 0, 0, 0, 0],
            [3 / 40, 9 / 40, 0, 0, 0],
            [3 / 10, -9 / 10, 6 / 5, 0, 0],
            [-11 / 54, 5 / 2, -70 / 27, 35 / 27, 0],
            [1631 / 55296, 175 / 512, 575 / 13824, 44275 / 110592, 253 / 4096],
        ]
    )
    B = np.array([37 / 378, 0, 250 / 621, 125 / 594, 0, 512 / 1771])
    E = np.append(np.array([2825 / 27648, 0, 18575 / 48384, 13525 / 55296, 277 / 14336, 1 / 4]) - B, 0)


class Foreign(OdeSolver):
    """A class of another package: not SciPy's RungeKutta, and another name for the order of the embedded method."""

    order, order_secondary, n_stages = 3, 2, 3
    A, B, C, E, P = RK23.A, RK23.B, RK23.C, RK23.E, RK23.P


@pytest.mark.parametrize(("ours", "scipy_s"), [(EIPRK23, RK23), (EIPRK45, RK45), (EIPDOP853, DOP853)])
def test_the_attributes_are_scipy_s(ours, scipy_s):
    for method in (scipy_s, type("Renamed", (scipy_s,), {}), ours):
        assert eip_method(method) is ours
    solver = ours(pendulum, 0, [1.0, 0.0], 1.0)
    for found in (ours, solver):
        for name in NAMES:
            np.testing.assert_array_equal(getattr(found, name), getattr(scipy_s, name))


def test_a_class_like_scipy_s():
    """The class takes the steps of SciPy's class, to rounding; the energy is kept, and the order is the class'."""
    method = eip_method(CashKarp)
    assert (method.__name__, method.order, method.TABLEAU.has_estimate) == ("EIP_CashKarp", 5, True)
    given = {"rtol": 1e-8, "atol": 1e-10}
    ours = solve_ivp(pendulum, (0, 10), [1.0, 0.3], method=method, **given)
    theirs = solve_ivp(pendulum, (0, 10), [1.0, 0.3], method=CashKarp, **given)
    np.testing.assert_allclose(ours.t, theirs.t, rtol=1e-8)
    np.testing.assert_allclose(ours.y[:, -1], theirs.y[:, -1], rtol=0, atol=1e-10)
    kept = integrate(pendulum, (0, 10), [1.0, 0.3], method=method, invariants=PENDULUM_ENERGY, **given)
    assert kept.max_residual < 1e-13
    errors = []
    exact = solve_ivp(pendulum, (0, 2), [1.0, 0.3], method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    for n in (20, 40):
        run = integrate(pendulum, (0, 2), [1.0, 0.3], method=method, h=2 / n)
        errors.append(np.abs(run.y[:, -1] - exact).max())
    assert 2**4.5 < errors[0] / errors[1] < 2**6.5


def test_a_class_of_another_package():
    """The class also has the dense output of RK23, its polynomial."""
    method = eip_method(Foreign)
    assert method.error_estimator_order == 2
    np.testing.assert_array_equal(method.P, RK23.P)
    times = np.linspace(0, 5, 33)
    given = {"t_eval": times, "rtol": 1e-6, "atol": 1e-8}
    ours = solve_ivp(pendulum, (0, 5), [1.0, 0.3], method=method, **given)
    theirs = solve_ivp(pendulum, (0, 5), [1.0, 0.3], method=RK23, **given)
    np.testing.assert_allclose(ours.y, theirs.y, rtol=0, atol=1e-12)


def changed(**members):
    return type("Changed", (CashKarp,), members)


@pytest.mark.parametrize(
    ("method", "error", "match"),
    [
        (LSODA, TypeError, "no coefficients A, B, C"),
        (changed(B=1.01 * CashKarp.B), ValueError, "b is not of order 5"),
        (changed(E=0 * CashKarp.E), TypeError, "are all 0, so Changed does not compute its error estimate"),
        (changed(E=1.1 * np.append(CashKarp.E[:-1], 0.1)), ValueError, "b_hat is not of order 4"),
        (changed(_step_impl=lambda self: (True, None)), TypeError, "has its own _step_impl"),
        (changed(P=np.ones((7, 4))), ValueError, "dense output P of Changed does not belong to its steps"),
        (changed(E=NotImplemented, E5=CashKarp.E, E3=CashKarp.E), TypeError, "two parts, E5 and E3"),
        (changed(A=CashKarp.A + 0.1), ValueError, "lower triangular|row sums"),
        (changed(Bp=CashKarp.B), TypeError, "Nystrom"),
        (int, TypeError, "expected a Tableau"),
    ],
)
def test_classes_that_are_refused(method, error, match):
    with pytest.raises(error, match=match):
        eip_method(method)
