"""Subnormal numbers are numbers, though another library has left the processor in a mode that flushes them to zero."""

import ctypes
import platform

import numpy as np
import pytest
from c_compiler import shared_library
from numba import njit
from systems import oscillator

from eip_scipy import EIPRK4, EIPRK45, Invariant, ensemble, integrate, project, solve_ivp

MODE = """
unsigned get(void) { return __builtin_ia32_stmxcsr(); }
void set(unsigned mode) { __builtin_ia32_ldmxcsr(mode); }
"""
FLUSHING = 0x8040
Y0 = np.array([1e-160, 0.0])  # the terms of the energy are subnormal


def energy(t, y):
    return 0.5 * (y[0] ** 2 + y[1] ** 2)


KEPT = Invariant(energy, lambda t, y: y.copy())
JITTED = njit(oscillator), Invariant(njit(energy), njit(lambda t, y: y.copy()))
STEPS = {"method": EIPRK4, "h": 0.1}
CALLS = {
    "compiled": lambda: integrate(JITTED[0], (0, 9), Y0, invariants=JITTED[1], **STEPS).y[:, -1],
    "interpreted": lambda: integrate(oscillator, (0, 9), Y0, invariants=KEPT, **STEPS).y[:, -1],
    "solve_ivp": lambda: solve_ivp(oscillator, (0, 9), Y0, EIPRK45, invariants=KEPT, atol=1e-165).y[:, -1],
    "ensemble": lambda: ensemble(JITTED[0], (0, 9), [Y0] * 9, invariants=JITTED[1], executor=1, **STEPS).y[8],
    "project": lambda: project(1.1 * Y0, KEPT, start=Y0).y,
}


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="sets a register of x86")
@pytest.mark.parametrize("name", CALLS)
def test_results_do_not_depend_on_the_mode_of_the_processor(name, tmp_path):
    source = tmp_path / "mode.c"
    source.write_text(MODE)
    mode = ctypes.CDLL(str(shared_library(tmp_path / "mode.so", source)))
    expected, before = CALLS[name](), mode.get()
    mode.set(before | FLUSHING)
    try:
        found = CALLS[name]()
        assert mode.get() & FLUSHING == FLUSHING
    finally:
        mode.set(before)
    np.testing.assert_array_equal(found, expected)
