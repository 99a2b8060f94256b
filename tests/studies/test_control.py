"""The study of the step control: its copy of the projected step is the step of the package."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from eip_scipy import eip_method
from eip_scipy_studies.hard_cases import hard_cases
from eip_scipy_studies.measurements.control import METHODS, Projected


@pytest.mark.parametrize("name", METHODS)
def test_same_steps_as_the_class(name):
    (case,), method, rtol = hard_cases(["three_wave"]), METHODS[name], 1e-5
    problem, tolerances = case.problem, {"rtol": rtol, "atol": 1e-3 * rtol}
    own = solve_ivp(problem.fun, (0, 10), problem.y0, method=method, invariants=problem.invariants, **tolerances)
    copied = eip_method(Projected(case, method, rtol, "before"))
    copy = solve_ivp(problem.fun, (0, 10), problem.y0, method=copied, **tolerances)
    assert copy.nfev == own.nfev
    np.testing.assert_allclose(copy.t, own.t, rtol=1e-8)
    np.testing.assert_allclose(copy.y, own.y, rtol=0, atol=1e-8)
