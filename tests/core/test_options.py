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
def test_solve_ivp_compensates_as_integrate_does(options):
    p = kepler()
    sol = solve_ivp(p.fun, (0, 3), p.y0, method=EIPRK45, invariants=p.invariants, compensated=True, **options)
    run = integrate(
        p.fun, (0, 3), p.y0, method=EIPRK45, invariants=p.invariants, compensated=True, compiled=False, **options
    )
    np.testing.assert_array_equal(sol.y[:, -1], run.y[:, -1])
    without = solve_ivp(p.fun, (0, 3), p.y0, method=EIPRK45, invariants=p.invariants, **options)
    assert np.any(without.y[:, -1] != sol.y[:, -1])


def test_compensated_steps_without_invariants_are_not_scipys():
    def fun(t, y):
        return np.array([1.0 / 3.0])

    ends = [
        solve_ivp(fun, (0, 1), [1e6], method=EIPRK45, max_step=1e-3, first_step=1e-3, compensated=on).y[0, -1]
        for on in (True, False)
    ]
    exact = 1e6 + 1.0 / 3.0
    assert abs(ends[0] - exact) <= np.spacing(exact)
    assert abs(ends[1] - exact) > np.spacing(exact)
