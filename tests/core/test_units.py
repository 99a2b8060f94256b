"""With metric="error" and atol=0 the result of a run does not depend on the units of its state."""

import numpy as np
import pytest

from eip_scipy import EIPRK4, integrate
from eip_scipy.problems import nbody, solar_system
from eip_scipy.problems.gravity.solar_data import AU_KM, DAY_S, YEAR_D

EPS = np.finfo(float).eps
METRE_PER_AU = AU_KM * 1e3
SI = np.repeat([METRE_PER_AU, METRE_PER_AU / (YEAR_D * DAY_S)], 30)


def in_au(years, units="AU, yr", **options):
    """Return the final state of the solar system in AU and AU/yr, run in either units."""
    problem = solar_system(units=units, years=years)
    run = integrate(problem, method=EIPRK4, h=problem.h, compiled=True, **options)
    assert run.status == 0
    return run.y[:, -1] / (SI if units == "SI" else 1.0)


def planets(difference):
    """Return the largest difference of position of each body [AU]."""
    return np.abs(difference[:30]).reshape(10, 3).max(axis=1)


@pytest.mark.needs_jit
def test_solar_system_in_si_and_in_au():
    """After ten years the runs differ by no more than the growth of rounding errors."""
    there, si = in_au(10.0, atol=0), in_au(10.0, "SI", atol=0)
    problem = solar_system(years=10.0)
    signs = np.random.default_rng(0).choice([-1, 1], (8, 60))
    options = {"method": EIPRK4, "h": problem.h, "atol": 0, "compiled": True}
    nudged = [integrate(problem, y0=problem.y0 * (1 + s * EPS), **options).y[:, -1] for s in signs]
    growth = np.max([planets(y - there) for y in nudged], axis=0)
    # One nudge against a rounding in each of the 5000 steps.
    assert (planets(si - there) < 30 * growth + 1e-14).all()
    assert planets(si - there).max() < 1e-7
    assert planets(si - there)[5:].max() < 1e-12  # a nudge by a rounding moves Mars by 6e-13


@pytest.mark.needs_jit
def test_short_run_agrees_to_round_off_with_the_error_metric_only():
    there, si = in_au(0.1, atol=0), in_au(0.1, "SI", atol=0)
    # The euclidean metric measures in metres and metres per second, or in AU and AU/yr: not the same run.
    plain, plain_si = in_au(0.1, metric="euclidean"), in_au(0.1, "SI", metric="euclidean")
    assert planets(si - there)[3:].max() < 2e-13
    assert planets(plain_si - plain)[3:].max() > 1e-10


def scaled_run(length, time, steps, **options):
    """The solar system in units of 2^length AU and 2^time years, its final state in AU and years."""
    own = solar_system()
    a, b = 2.0**-length, 2.0**-time
    problem = nbody(
        own.params * a**3 / b**2,
        own.y0[:30].reshape(10, 3) * a,
        own.y0[30:].reshape(10, 3) * (a / b),
        t_span=(0.0, steps * 2.0**-9 * b),
        h=2.0**-9 * b,
    )
    run = integrate(problem, method=EIPRK4, h=problem.h, compiled=False, **options)
    assert run.status == 0
    return run.y[:, -1] / np.repeat([a, a / b], 30)


@pytest.mark.parametrize(("length", "time"), [(37, 25), (-50, 60), (0, -40)])
def test_units_of_powers_of_two_change_no_bit(length, time):
    one, other = scaled_run(0, 0, 10, atol=0), scaled_run(length, time, 10, atol=0)
    np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("options", [{"metric": "euclidean"}, {"atol": 1e-6}])
def test_units_of_powers_of_two_matter_without_it(options):
    """Neither the euclidean metric nor an atol is independent of units: the test above is able to fail."""
    assert (scaled_run(0, 0, 10, **options) != scaled_run(37, 25, 10, **options)).any()
