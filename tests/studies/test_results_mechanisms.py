"""The numbers of docs/how-to/mechanisms.md, computed again."""

import warnings

import numpy as np
import pytest
from pages import NUMBER, printed_tables
from scipy.integrate import solve_ivp

from eip_scipy import EIPDOP853, integrate
from eip_scipy_studies.bench.cases import CASES
from eip_scipy_studies.bench.mechanisms import four_bar, n_four_bar

pytestmark = [pytest.mark.nightly, pytest.mark.needs_jit]
LINKAGE, WINDOW = printed_tables("how-to/mechanisms.md")[1:3]


def runs(problem, tolerance, methods=()):
    control = {"rtol": tolerance, "atol": tolerance}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # without projection the runs are not reliable
        for kept in ((), problem.constraints, problem.invariants):
            yield integrate(problem, invariants=kept, method=EIPDOP853, **control)
    for method in methods:
        yield solve_ivp(problem.fun, problem.t_span, problem.y0, method=method, **control)


def compare(cells, found, end):
    for cell, run in zip(cells, found, strict=True):
        error, calls = map(float, NUMBER.findall(cell))
        assert abs(run.nfev / calls - 1) < 0.05
        measured = np.abs(run.y[: end.size, -1] - end).max()
        assert 0.4 < measured / error < 2.5, (measured, error)  # rounding errors differ between processors


@pytest.mark.parametrize("tolerance", LINKAGE)
def test_linkage(tolerance):
    compare(LINKAGE[tolerance], runs(four_bar(), float(tolerance), ("LSODA", "Radau")), CASES["four-bar"].end)


@pytest.mark.parametrize("tolerance", WINDOW)
def test_one_window(tolerance):
    """Without projection the motion is wrong, by an amount that rounding errors decide."""
    problem = n_four_bar(1)
    end = problem.reference(10.0)[:4]
    wrong, *kept = runs(problem, float(tolerance))
    assert np.abs(wrong.y[:4, -1] - end).max() > 0.5
    compare(WINDOW[tolerance][1:], kept, end)
