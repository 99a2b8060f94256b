"""Attributes of SciPy's implicit solvers that EIPRadau and EIPBDF use."""

import pytest
from scipy.integrate import solve_ivp
from systems import SQUARE, oscillator

from eip_scipy import EIPBDF, EIPRadau
from eip_scipy.methods import implicit


@pytest.mark.parametrize("method", [EIPRadau, EIPBDF])
def test_private_names_of_scipy(method, monkeypatch):
    """All used attributes exist, and a version of SciPy that lacks one is named."""
    inner = method.TABLEAU.solver
    solver = inner(oscillator, 0.0, [1.0, 0.0], 1.0)
    solver.step()
    assert all(hasattr(solver, name) for name in (*implicit.PRIVATE[inner], "jac_factor", "max_step"))
    monkeypatch.setitem(implicit.PRIVATE, inner, ("D", "f", "lost"))
    with pytest.raises(NotImplementedError, match=rf"EIP{inner.__name__} uses .*not have: .*lost\. Use another"):
        solve_ivp(oscillator, (0, 1), [1.0, 0.0], method=method, invariants=SQUARE)
