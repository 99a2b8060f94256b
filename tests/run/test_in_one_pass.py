"""Jitted functions of short states are called in one pass: the same values, errors and copies as one by one."""

import numpy as np
import pytest
from numba import njit

from eip_scipy import EIPDOP853, EIPRK4, EIPRK45, EIPRKN12, Invariant, integrate

Y0 = np.array([0.1, 0.2, 0.3, -0.2])


def fun(t, y):
    return np.array([y[2], y[3], -y[0] - 2.0 * y[0] * y[1], -y[1] - y[0] * y[0] + y[1] * y[1]])


def acceleration(t, q):
    return np.array([-q[0] - 2.0 * q[0] * q[1], -q[1] - q[0] * q[0] + q[1] * q[1]])


def energy(t, y):
    square = y[0] * y[0] + y[1] * y[1] + y[2] * y[2] + y[3] * y[3]
    value = 0.5 * square + y[0] * y[0] * y[1] - y[1] * y[1] * y[1] / 3.0
    y[0] = 7.0  # of a copy
    return value


def gradient(t, y):
    return np.array([y[0] + 2.0 * y[0] * y[1], y[1] + y[0] * y[0] - y[1] * y[1], y[2], y[3]])


@pytest.mark.parametrize(
    ("method", "options"),
    [
        (EIPRK4, {"h": 0.1}),
        (EIPRK4, {"h": 0.1, "metric": "euclidean", "iterations": 2}),
        (EIPRK45, {"rtol": 1e-6, "reuse_f": False}),
        (EIPDOP853, {"rtol": 1e-9, "every": 2}),
        (EIPRKN12, {"h": 0.5}),
        (EIPRKN12, {"rtol": 1e-9, "acceleration": acceleration}),
    ],
)
def test_bits_are_those_of_python(method, options):
    def run(jit):
        form = {name: jit(value) if callable(value) else value for name, value in options.items()}
        given = None if "acceleration" in options else jit(fun)
        invariant = Invariant(jit(energy), jit(gradient))
        return integrate(given, (0, 20), Y0, method=method, invariants=invariant, **form)

    compiled, interpreted = run(njit), run(lambda function: function)
    assert (compiled.compiled, interpreted.compiled) == (True, False)
    np.testing.assert_array_equal(compiled.y, interpreted.y)
    assert compiled.nfev == interpreted.nfev


def test_an_entry_that_is_not_filled_is_found():
    @njit
    def partly(t, y, out):
        out[:3] = y[1:]
        if t < 1.0:
            out[3] = -y[0]

    result = integrate(partly, (0, 2), Y0, method=EIPRK4, h=0.1, invariants=njit(energy), in_place=True, check=False)
    assert result.status == -1
    assert "non-finite" in result.message
    assert 0.9 <= result.t[-1] <= 1.0


def test_an_invariant_that_raises_ends_the_run_with_its_error():
    @njit
    def late(t, y):
        if t > 1.0:
            raise ZeroDivisionError("late")
        return y[0] * y[0] + y[2] * y[2]

    with pytest.raises(ZeroDivisionError, match="late") as caught:
        integrate(njit(fun), (0, 2), Y0, method=EIPRK4, h=0.1, invariants=Invariant(late, njit(gradient)), check=False)
    assert 0.9 <= caught.value.partial.t[-1] <= 1.0
