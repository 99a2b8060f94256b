"""Columns by dual numbers are compared with the function at the start: what is found, and what is not an error."""

import ctypes
import math

import numpy as np
import pytest
from numba import njit

from eip_scipy import EIPDOP853, ensemble, integrate, numba_duals

pytestmark = [pytest.mark.needs_jit, pytest.mark.slow]
SPAN, START = (0.0, 3.0), [1.0, 0.3]
OPTIONS = {"method": EIPDOP853, "h": 0.02}
TWO = ctypes.c_double * 2


@ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)
def CALL(state, out):
    y, f = TWO.from_address(state), TWO.from_address(out)
    f[0], f[1] = y[1], -math.sin(y[0])


pendulum = njit(lambda t, y: np.array([y[1], -np.sin(y[0])]))


@njit
def by_address(t, y):
    state, out = y.copy(), np.empty(2)
    CALL(state.ctypes.data, out.ctypes.data)
    return out


@njit
def by_pointer_in_place(t, y, out):
    state = y.copy()
    CALL(state.ctypes, out.ctypes)


@njit
def by_floats(t, y):
    z = y.view(np.float64)
    return np.array([z[1], -np.sin(z[0])])


@njit
def by_complex_numbers(t, y):
    z = y.view(np.complex128)
    z = -1j * z * (1 + 0.1 * abs(z[0]) ** 2)
    return np.array([z[0].real, z[0].imag])


@pytest.mark.parametrize(
    ("fun", "reason"),
    [
        (by_address, "Cannot give C code the address of an array of dual numbers"),
        (by_pointer_in_place, "it does not compile for dual numbers: .*Pointer"),
        (by_floats, "component 0 of its derivative .* near the start, but .* with dual numbers"),
        (by_complex_numbers, "it raises ValueError with dual numbers"),
    ],
    ids=lambda item: getattr(item, "__name__", ""),
)
def test_functions_that_depend_on_the_memory_of_arrays_are_refused(fun, reason):
    options = {"in_place": fun is by_pointer_in_place, **OPTIONS}
    plain = integrate(fun, SPAN, START, **options)
    with pytest.raises(ValueError, match=rf"derivatives of the right-hand side .*{reason}.*Give jvp=") as error:
        integrate(fun, SPAN, START, variations="state", **options)
    assert "it is not compiled" not in str(error.value)
    if fun is not by_complex_numbers:
        product = njit(lambda t, y, dy: np.array([dy[1], -np.cos(y[0]) * dy[0]]))
        run = integrate(fun, SPAN, START, variations="state", jvp=product, **options)
        np.testing.assert_array_equal(run.y, plain.y)
        right = integrate(pendulum, SPAN, START, variations="state", **OPTIONS)
        np.testing.assert_allclose(run.stm[-1], right.stm[-1], rtol=0, atol=1e-13)


@pytest.mark.usefixtures("in_vectors")
def test_members_are_not_compiled_for_eight_whose_arrays_they_would_misread():
    starts, options = np.array(START) * np.linspace(1, 1.1, 16)[:, None], OPTIONS | {"in_place": True}
    found = ensemble(by_pointer_in_place, SPAN, starts, executor=1, **options)
    assert not found.side_by_side.any()
    for k in (0, 9):
        np.testing.assert_array_equal(found.y[k], integrate(by_pointer_in_place, SPAN, starts[k], **options).y[:, -1])


def test_a_component_is_compared_at_its_own_size():
    # The acceleration is 1e-8 of the velocity, in units of which it would seem to be right.
    @njit
    def fun(t, y):
        z = y.view(np.float64)
        return np.array([min(y[1], 9.0), -1e-8 * np.sin(z[1])])  # min() excludes complex steps

    with pytest.raises(ValueError, match="component 1 of its derivative"):
        integrate(fun, SPAN, [1e4, 1.0], variations="state", **OPTIONS)


def test_wrong_derivatives_of_right_values_are_replaced(monkeypatch):
    right = numba_duals.pushforward

    def wrong(*args):
        def rhs(t, Y, out, *extra):
            right(*args)(t, Y, out, *extra)
            out[5] *= 1.01

        return rhs

    monkeypatch.setattr(numba_duals, "pushforward", wrong)
    unknown = njit(pendulum.py_func)  # derivatives of functions are kept
    run = integrate(unknown, SPAN, START, variations="state", **OPTIONS)
    assert run.columns["source"] == "complex steps"

    @njit
    def without_complex_numbers(t, y):
        return np.array([y[1], -np.sin(max(y[0], -9.0))])

    with pytest.raises(ValueError, match=r"component 1 of its derivative along a test direction is .* with dual num"):
        integrate(without_complex_numbers, SPAN, START, variations="state", **OPTIONS)


kinked = njit(lambda t, y: np.array([y[1], -y[0] - 3 * max(y[0], 0.0) - abs(y[1]) * y[1]]))
with_many_digits = njit(lambda t, y: np.array([(y[1] + 1e8) - 1e8, -y[0]]))


@njit
def at_the_end_of_its_domain(t, y):
    if y[0] > 1.0000001:
        raise ValueError
    return -y


@njit
def two_bodies(t, y):
    out, dx, dy = np.empty(8), y[2] - y[0], y[3] - y[1]
    cube = 2 * (dx * dx + dy * dy) ** 1.5
    out[:4] = y[4:]
    out[4], out[5], out[6], out[7] = dx / cube, dy / cube, -dx / cube, -dy / cube
    return out


FAR = [1e8 - 0.5, 1e8, 1e8 + 0.5, 1e8, 0, -0.5, 0, 0.5]


@pytest.mark.parametrize(
    ("fun", "start"),
    [
        (kinked, [0.0, 0.0]),
        (with_many_digits, [1.0, 0.0]),
        (at_the_end_of_its_domain, [1.0, 0.0]),
        pytest.param(two_bodies, FAR, marks=pytest.mark.nightly),
    ],
)
def test_right_derivatives_are_not_refused(fun, start):
    run = integrate(fun, (0, 0.1), start, variations="state", **OPTIONS)
    assert run.columns["source"] == "dual numbers"
