"""The numbers of docs/how-to/mechanisms.md, computed again."""

import warnings

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from eip_scipy import EIPDOP853, integrate
from eip_scipy_studies.bench.cases import CASES
from eip_scipy_studies.bench.mechanisms import four_bar, n_four_bar

pytestmark = [pytest.mark.nightly, pytest.mark.slow, pytest.mark.needs_jit]
# Errors and calls, by tolerance: without projection, constraints, constraints and energy, LSODA, Radau.
LINKAGE = {
    1e-4: "4.2e-1 2774  5.2e-2 2786  1.0e-4 2810  7.6e-2 2275  2.1e-2 5522",
    1e-6: "3.6e-3 4214  3.3e-5 4214  2.4e-6 4214  6.3e-2 3739  1.1e-4 13633",
    1e-8: "1.5e-5 6962  1.5e-7 6962  2.1e-8 6962  1.5e-4 5461  2.0e-7 40051",
    1e-10: "1.4e-7 11954  2.6e-9 11954  5.5e-11 11954  7.5e-6 8337  4.5e-10 124916",
}
WINDOW = {  # without projection the motion is wrong, by an amount that rounding errors decide
    1e-4: "1.3e-2 638  6.6e-5 638",
    1e-6: "2.5e-4 950  7.1e-7 950",
    1e-8: "1.9e-6 1754  1.5e-8 1754",
}


def runs(problem, tolerance, methods=()):
    control = {"rtol": tolerance, "atol": tolerance}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # without projection the runs are not reliable
        for kept in ((), problem.constraints, problem.invariants):
            yield integrate(problem, invariants=kept, method=EIPDOP853, **control)
    for method in methods:
        yield solve_ivp(problem.fun, problem.t_span, problem.y0, method=method, **control)


def compare(line, found, end):
    printed = np.reshape(line.split(), (-1, 2)).astype(float)
    for (error, calls), run in zip(printed, found, strict=True):
        assert abs(run.nfev / calls - 1) < 0.05
        measured = np.abs(run.y[: end.size, -1] - end).max()
        assert 0.4 < measured / error < 2.5, (measured, error)  # rounding errors differ between processors


@pytest.mark.parametrize("tolerance", LINKAGE)
def test_linkage(tolerance):
    compare(LINKAGE[tolerance], runs(four_bar(), tolerance, ("LSODA", "Radau")), CASES["four-bar"].end)


@pytest.mark.parametrize("tolerance", WINDOW)
def test_one_window(tolerance):
    problem = n_four_bar(1)
    end = problem.reference(10.0)[:4]
    wrong, *kept = runs(problem, tolerance)
    assert np.abs(wrong.y[:4, -1] - end).max() > 0.5
    compare(WINDOW[tolerance], kept, end)
