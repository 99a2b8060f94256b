"""The options of the projection are known in one place: signatures, documentation, keywords."""

import inspect

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from eip_scipy import EIPRK4, EIPRK45, ensemble, integrate
from eip_scipy.core.projection import ProjectionKeywords, ProjectionOptions
from eip_scipy.ensembles.ensemble import EnsembleKeywords
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
