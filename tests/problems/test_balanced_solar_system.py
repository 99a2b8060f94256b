"""`solar_system` and `nbody` with balances: the orbits against states that were computed in 80 bits."""

import numpy as np
import pytest

from eip_scipy import EIPDOP853, EIPGJ14, EIPRK4, EIPRKN12, integrate
from eip_scipy.problems import nbody, solar_system

ALL = ("energy", "momentum", "laplace")


def errors(problem, run, years):
    """Return distances of Mercury, and of the worst of the other bodies, from the stored state [AU]."""
    apart = np.linalg.norm((run.y[:, -1] - problem.reference(years))[:30].reshape(10, 3), axis=1)
    return apart[1], apart[2:].max()


@pytest.mark.parametrize(
    ("method", "h", "balances", "mercury", "others", "gain"),
    [
        (EIPGJ14, 1 / 512, "kepler", 4e-13, 5e-14, 500),
        (EIPDOP853, 1 / 256, "kepler", 9e-10, 1e-12, 200),
        (EIPDOP853, 1 / 256, ALL, 3e-10, 6e-13, 700),
        (EIPRK4, 1 / 512, ALL, 5e-5, 3e-7, 1000),
    ],
)
def test_a_hundred_years(method, h, balances, mercury, others, gain):
    problem = solar_system(years=100.0, balances=balances)
    kept = errors(problem, integrate(problem, method=method, h=h), 100.0)
    plain = errors(problem, integrate(problem, method=method, h=h, invariants=()), 100.0)
    assert kept[0] < mercury
    assert kept[1] < others
    assert gain * kept[0] < plain[0]


def test_totals_stay_at_rounding_though_nothing_projects_them():
    problem, totals = solar_system(years=100.0, balances="kepler"), solar_system(years=100.0).invariants
    run = integrate(problem, method=EIPGJ14, h=1 / 512)
    energy, momentum = (np.array([item.fun(0, y) for y in run.y.T]) for item in totals)
    assert abs(energy[1] / energy[0] - 1) < 1e-14
    np.testing.assert_allclose(momentum[1], momentum[0], rtol=0, atol=1e-14 * np.linalg.norm(momentum[0]))


@pytest.mark.parametrize("forces", ["1pn", ("j2", "gr-potential")])
def test_further_forces(forces):
    """The rates are those of all forces; the reference has steps sixteen times shorter."""
    problem = solar_system(years=5.0, forces=forces, balances="kepler")
    truth = integrate(problem, method=EIPDOP853, h=1 / 4096, invariants=(), compensated=True).y[3:6, -1]
    kept, plain = (
        np.linalg.norm(integrate(problem, method=EIPDOP853, h=1 / 256, **options).y[3:6, -1] - truth)
        for options in ({}, {"invariants": ()})
    )
    assert kept < 3e-11
    assert 5 * kept < plain


def test_the_results_name_the_orbits():
    problem = solar_system(years=1.0, balances="kepler")
    run = integrate(problem, method=EIPDOP853, h=1 / 256)
    assert tuple(run.diagnostics.names[:2]) == ("energy of Mercury", "energy of Venus")
    assert run.trusted
    assert run.invariants.shape == (9, 2)
    np.testing.assert_allclose(run.invariants[:, 0], 0.0, atol=1e-14)  # the energies less those at the start


def test_methods_without_velocities_at_their_stages_are_refused():
    with pytest.raises(ValueError, match="does not carry a Balance"):
        integrate(solar_system(years=1.0, balances="kepler"), method=EIPRKN12, h=1 / 64)


def test_unknown_quantities():
    with pytest.raises(ValueError, match="unknown quantity 'enrgy'; known: 'kepler', 'energy'"):
        nbody([1.0, 1e-3], np.eye(2, 3), np.eye(2, 3)[:, ::-1], t_span=(0, 1), balances="enrgy")
