"""Charged particles: an orbit in closed form, and the numbers of the page."""

import numpy as np
import pytest
from pages import assert_printed, printed_tables

import eip_scipy
from eip_scipy import EIPDOP853, EIPRK4, integrate
from eip_scipy.problems import ParticleField, charged_particle, tokamak
from eip_scipy_studies.output import Output
from eip_scipy_studies.particles import charged_particle as study
from eip_scipy_studies.particles.orbits import ParticleOrbit

PAGE = "results/charged-particles.md"


def test_gyration_in_a_constant_field():
    """B = 2 e_z, m = 1.5: frequency |q| B / m, and the E x B drift (0.15, 0, 0)."""
    field = ParticleField(
        lambda x, y, z: (-y, x, 0.0),
        magnetic=lambda x, y, z: (0.0, 0.0, 2.0),
        electric=lambda x, y, z: (0.0, 0.3, 0.0),
        potential=lambda x, y, z: -0.3 * y,
    )
    mass, v, charge = 1.5, np.array([0.15 + 0.4, 0.0, 0.25]), -3.0
    problem = charged_particle(field, [0.5, 1.0, 0.0], v, mass=mass, charge=charge, t_span=(0.0, 4.0), h=0.01)
    run = integrate(problem, method=EIPRK4, save_every=1)
    orbit = ParticleOrbit(problem, run.t, run.y)
    np.testing.assert_allclose(orbit.magnetic_moment, 0.5 * mass * 0.4**2 / 2.0, rtol=1e-7)
    np.testing.assert_allclose(orbit.parallel_velocity, 0.25, rtol=1e-7)
    # The guiding centre drifts with 0.15 along x and 0.25 along z; averaged, its gyration is gone.
    drift = np.diff(orbit.averaged(orbit.guiding_centre)[:, [0, -1]], axis=1)[:, 0]
    expected = np.array([0.15, 0.0, 0.25]) * (orbit.averaged(run.t)[-1] - orbit.averaged(run.t)[0])
    np.testing.assert_allclose(drift, expected, atol=2e-4)
    np.testing.assert_allclose(orbit.energy, problem.invariants[0].fun(0.0, problem.y0, problem.params), rtol=1e-11)
    # Anticlockwise for a negative charge, seen along B; relative to the direction away from the axis.
    angle = orbit.gyrophase + np.unwrap(np.arctan2(run.y[1], run.y[0]))
    np.testing.assert_allclose(angle - angle[0], 2 * abs(charge) / mass * run.t, atol=1e-5)


# Numbers of the page, by their columns.
UNIFORM = ("gyroradius_first", "gyroradius_last", "angle_error", "phase_error", "energy_error", "momentum_error")
BANANA = ("tips", ("tip_nearest", "tip_farthest"), "extrema_error", "moment_change", "phase_error", "position_error")
COLUMNS = {"uniform": UNIFORM, "tokamak-banana": BANANA, "tokamak-transit": BANANA[2:]}


@pytest.mark.nightly
@pytest.mark.needs_jit
@pytest.mark.parametrize("scene", study.SCENES)
def test_numbers_of_the_page(scene):
    """The paper's intervals, a minute: all checks of the command hold, and the page's table has its numbers."""
    found, out = study.Experiment(scene), Output(quiet=True)
    found.check(out)
    assert out.passed, out.numbers["checks"]
    rows = printed_tables(PAGE)[1 + list(study.SCENES).index(scene)]
    for method, cells in rows.items():
        for keys, cell in zip(COLUMNS[scene], cells, strict=True):
            if cell:
                values = (found.numbers[method][key] for key in ((keys,) if isinstance(keys, str) else keys))
                assert_printed(cell, *(abs(x) if "phase" in keys else x for x in values), round_off=1e-10)


@pytest.mark.nightly
@pytest.mark.needs_jit
def test_numbers_of_longer_steps_on_the_page():
    problem = tokamak("transit")
    exact = integrate(problem, method=EIPDOP853, h=problem.h / 4, compensated=True, invariants=()).y[:3, -1]
    for label, (evaluations, error) in printed_tables(PAGE)[4].items():
        *names, step = label.split(", ")
        kept, method = problem.invariants if "EIP-HL" in names else (), getattr(eip_scipy, f"EIP{names[-1]}")
        run = integrate(problem, method=method, h=float(step.split()[0]) * problem.h, invariants=kept)
        assert_printed(evaluations, run.nfev)
        assert_printed(error, np.linalg.norm(run.y[:3, -1] - exact))
