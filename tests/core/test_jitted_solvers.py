"""Numba functions in `solve_ivp`, called as C functions: the same states as through Python, their errors and memory."""

import numpy as np
import pytest
from numba import njit
from scipy.integrate import solve_ivp

from eip_scipy import EIPRK4, Invariant

pytestmark = pytest.mark.needs_jit
Y0 = np.array([0.4, 0.0, 0.0, 2.0])


@njit
def rhs(t, y):
    r3 = (y[0] ** 2 + y[1] ** 2) ** 1.5
    y[0], y[1] = -y[0] / r3, -y[1] / r3  # the argument is a copy that a function may overwrite
    return np.array([y[2], y[3], y[0], y[1]])


@njit
def both(t, y):
    energy = 0.5 * (y[2] ** 2 + y[3] ** 2) - 1 / np.sqrt(y[0] ** 2 + y[1] ** 2)
    return np.array([energy, y[0] * y[3] - y[1] * y[2]])


@njit
def both_gradients(t, y):
    r3 = (y[0] ** 2 + y[1] ** 2) ** 1.5
    return np.array([[y[0] / r3, y[1] / r3, y[2], y[3]], [y[3], -y[2], -y[1], y[0]]])


def test_python_is_not_called_in_the_steps(monkeypatch):
    solver = EIPRK4(rhs, 0.0, Y0, 10.0, h=0.03, invariants=[Invariant(both, both_gradients)])
    # From here on the functions refuse calls from Python.
    for fun in (rhs, both, both_gradients):
        monkeypatch.setattr(fun, "overloads", {})
        fun._reset_overloads()
        monkeypatch.setattr(fun, "_can_compile", False)
        with pytest.raises(TypeError, match="No matching definition"):
            fun(0.0, Y0)
    for _ in range(10):
        solver.step()
    assert solver.status == "running"


@njit
def late(t, y):
    if t > 1.0:
        raise ValueError("too late")
    return np.array([y[1], -y[0]])


shrinks = njit(lambda t, y: np.array([y[1], -y[0]]) if t < 1.0 else np.array([y[1]]))
divides = njit(lambda t, y: np.array([1.0 / (y[0] - y[0] * (t > 1.0)), -y[0]]))


@pytest.mark.parametrize("fun", [late, shrinks, divides])
def test_errors_are_those_of_python_calls(fun):
    raised = []
    for called in (fun, lambda t, y: fun(t, y)):
        with pytest.raises((ValueError, ZeroDivisionError)) as caught:
            solve_ivp(called, (0, 3), [1.0, 0.5], method=EIPRK4, h=0.1)
        raised.append((caught.type, str(caught.value)))
    assert raised[0] == raised[1]


def test_returned_arrays_are_freed():
    from numba.core.runtime import _nrt_python, rtsys

    _nrt_python.memsys_enable_stats()

    def in_use():
        stats = rtsys.get_allocation_stats()
        return stats.alloc - stats.free

    options = {"method": EIPRK4, "h": 0.01, "invariants": [Invariant(both, both_gradients)]}
    solve_ivp(rhs, (0, 1), Y0, **options)
    before = in_use()
    solve_ivp(rhs, (0, 10), Y0, **options)
    with pytest.raises(ValueError, match="shape"):
        solve_ivp(shrinks, (0, 3), [1.0, 0.5], method=EIPRK4, h=0.1)
    assert in_use() == before
    _nrt_python.memsys_disable_stats()
