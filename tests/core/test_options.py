"""Options of the projection in signatures, documentation and keywords; attributes of SciPy that methods use."""

import inspect

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from systems import SQUARE, oscillator

from eip_scipy import EIPBDF, EIPRK4, EIPRK45, EIPRadau, ensemble, integrate
from eip_scipy.core.projection import ProjectionKeywords, ProjectionOptions
from eip_scipy.ensembles.ensemble import EnsembleKeywords
from eip_scipy.methods import implicit
from eip_scipy.problems import kepler
from eip_scipy.solvers import EIPSolver

NAMES = ProjectionOptions.names()


def test_keywords_for_type_checkers_are_the_options():
    assert sorted(ProjectionKeywords.__annotations__) == sorted(NAMES)
    given = set(inspect.signature(ensemble).parameters) | set(EnsembleKeywords.__annotations__)
    assert set(EnsembleKeywords.__annotations__) >= {*NAMES} - {"invariants"}
    alone = {"y0", "diagnostics", "variations", "jvp", "symplectic", "dense_output", "max_steps"}
    assert given >= set(inspect.signature(integrate).parameters) - alone


@pytest.mark.parametrize("function", [EIPSolver, EIPRK4, integrate])
def test_signatures_show_the_options(function):
    shown = inspect.signature(function).parameters
    for name, option in inspect.signature(ProjectionOptions).parameters.items():
        assert shown[name].default == option.default
        assert shown[name].kind is inspect.Parameter.KEYWORD_ONLY


def test_documentation_names_the_options():
    for name in NAMES:
        assert f"\n{name} : " in inspect.getdoc(EIPSolver)
    assert ", ".join(NAMES) in integrate.__doc__
    assert "{" + "ProjectionOptions" not in EIPSolver.__doc__ + integrate.__doc__


@pytest.mark.parametrize("options", [{"h": 0.01}, {"rtol": 1e-10, "atol": 1e-12}])
@pytest.mark.parametrize("kept", [True, False])
def test_solve_ivp_compensates_as_integrate_does(options, kept):
    """Without invariants the steps are not SciPy's then."""
    p = kepler()
    options = {"method": EIPRK45, "invariants": p.invariants if kept else (), **options}
    sol = solve_ivp(p.fun, (0, 3), p.y0, compensated=True, **options)
    run = integrate(p.fun, (0, 3), p.y0, compensated=True, compiled=False, **options)
    np.testing.assert_array_equal(sol.y[:, -1], run.y[:, -1])
    assert np.any(solve_ivp(p.fun, (0, 3), p.y0, **options).y[:, -1] != sol.y[:, -1])


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
