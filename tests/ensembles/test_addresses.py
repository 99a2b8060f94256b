"""Functions that give C code addresses of arrays are not compiled for eight members, whose arrays it would misread."""

import ctypes

import numba
import numpy as np
import pytest

from eip_scipy import EIPRK4, ensemble, integrate
from eip_scipy.ensembles import tasks
from eip_scipy.problems import mechanism

pytestmark = pytest.mark.needs_jit
SPAN, STARTS = (0.0, 1.0), np.array([[1 + 0.01 * k, 0.3] for k in range(16)])
OPTIONS = {"method": EIPRK4, "h": 0.02}


TWO = ctypes.c_double * 2


@ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)
def CALL(state, out):
    y, f = TWO.from_address(state), TWO.from_address(out)
    f[0], f[1] = y[1], -y[0]


@numba.njit
def by_address(t, y, out):
    out[0], out[1] = 0.0, 0.0
    CALL(y.ctypes.data, out.ctypes.data)


@numba.njit
def by_pointer(t, y, out):
    out[0], out[1] = 0.0, 0.0
    CALL(y.ctypes, out.ctypes)


@pytest.mark.parametrize("fun", [by_address, by_pointer])
def test_members_have_the_bits_of_their_runs(monkeypatch, fun):
    monkeypatch.setattr(tasks, "LEAST_WORK", 0)  # functions are compiled for eight members if they can be
    found = ensemble(fun, SPAN, STARTS, in_place=True, executor=1, **OPTIONS)
    assert not found.side_by_side.any()
    for k in (0, 9):
        run = integrate(fun, SPAN, STARTS[k], in_place=True, **OPTIONS)
        np.testing.assert_array_equal(found.y[k], run.y[:, -1])


def test_members_of_mechanisms_have_the_bits_of_their_runs(monkeypatch):
    monkeypatch.setattr(tasks, "LEAST_WORK", 0)
    problem = mechanism([1.0], numba.njit(lambda t, q, u: np.array([-q[0]])), q0=[1], u0=[0], t_span=SPAN)
    found = ensemble(problem, SPAN, STARTS, executor=1, **OPTIONS)
    for k in (0, 9):
        np.testing.assert_array_equal(found.y[k], integrate(problem, SPAN, STARTS[k], **OPTIONS).y[:, -1])
