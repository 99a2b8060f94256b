"""Problems from expressions without Numba and without SymPy."""

import subprocess
import sys

import numpy as np
import pytest

from eip_scipy import EIPRK45, equations, hamiltonian, integrate
from eip_scipy.core import functions
from eip_scipy.problems import symbolic


def test_without_numba(monkeypatch):
    H = "(p{0}**2 + py**2)/2 + log({0}) + atan2(y, {0}) + sqrt(1 + y**2) + abs(y) + max({0}, y) + cbrt({0}) + y*cbrt(y)"
    y = np.array([1.2, -0.4, 0.3, 0.1])
    compiled = hamiltonian(H.format("x"))
    monkeypatch.setattr(functions, "find_spec", lambda name: None)
    plain = hamiltonian(H.format("r"))  # another name, because equal expressions share their functions
    assert "plain Python" in repr(plain)
    assert plain.fun(0.0, y) == pytest.approx(compiled.fun(0.0, y), rel=1e-14)
    assert plain.invariants[0].fun(0.0, y) == pytest.approx(compiled.invariants[0].fun(0.0, y), rel=1e-14)
    run = integrate(plain, (0, 0.5), y, method=EIPRK45, rtol=1e-9)
    assert run.success
    assert not run.compiled
    with np.errstate(all="ignore"):  # where a step reaches too far there is no exception
        assert np.isnan(plain.invariants[0].fun(0.0, np.array([-1.0, 0.1, 0.0, 0.0])))


def test_sympy_is_loaded_by_its_callers_alone(monkeypatch):
    code = "import sys; from eip_scipy import hamiltonian, equations, problems; print('sympy' in sys.modules)"
    command = [sys.executable, "-c", code]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "False\n"
    monkeypatch.setattr(symbolic, "find_spec", lambda name: None)
    for call in (lambda: hamiltonian("p**2"), lambda: equations(["x"], "x")):
        with pytest.raises(ImportError, match=r'needs SymPy: python -m pip install "eip_scipy\[sympy\]"'):
            call()
