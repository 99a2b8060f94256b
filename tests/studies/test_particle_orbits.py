"""Guiding centre, gyrophase, magnetic moment, averages and turns of charged particles."""

import math

import numpy as np
import pytest

from eip_scipy import EIPDOP853, EIPRK4, integrate
from eip_scipy.problems import ParticleField, charged_particle, tokamak, uniform_field
from eip_scipy_studies.particles.orbits import ParticleOrbit, radial_range


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
    omega = abs(charge) * 2.0 / mass
    np.testing.assert_allclose(orbit.magnetic_moment, 0.5 * mass * 0.4**2 / 2.0, rtol=1e-7)
    np.testing.assert_allclose(orbit.parallel_velocity, 0.25, rtol=1e-7)
    # The guiding centre drifts with 0.15 along x and 0.25 along z; averaged, its gyration is gone.
    drift = np.diff(orbit.averaged(orbit.guiding_centre)[:, [0, -1]], axis=1)[:, 0]
    expected = np.array([0.15, 0.0, 0.25]) * (orbit.averaged(run.t)[-1] - orbit.averaged(run.t)[0])
    np.testing.assert_allclose(drift, expected, atol=2e-4)
    np.testing.assert_allclose(orbit.energy, problem.invariants[0].fun(0.0, problem.y0, problem.params), rtol=1e-11)
    # Anticlockwise for a negative charge, seen along B; relative to the direction away from the axis.
    angle = orbit.gyrophase + np.unwrap(np.arctan2(run.y[1], run.y[0]))
    np.testing.assert_allclose(angle - angle[0], omega * run.t, atol=1e-5)


def test_drifting_gyration_in_the_papers_field():
    problem = uniform_field(t_end=2700 * math.pi / 10)
    run = integrate(problem, method=EIPDOP853, save_every=1)
    orbit = ParticleOrbit(problem, run.t, run.y)
    # Drift of the guiding centre at R = 1.1: E / B = 1e-2 / R^2, an angle of t 1e-2 / R^3, 2 % less by the gyroradius.
    assert orbit.guiding_angle[-1] - orbit.guiding_angle[0] == pytest.approx(-run.t[-1] * 1e-2 / 1.1**3, rel=0.02)
    assert radial_range(orbit, 1.0) == pytest.approx(0.10954, abs=1e-5)
    assert math.isnan(radial_range(orbit, 2.0))
    assert orbit.turns()[-1] == pytest.approx(1.0043, abs=0.001)
    np.testing.assert_allclose(orbit.momentum, orbit.momentum[0], rtol=1e-11)


def test_banana_tip_and_poloidal_turns():
    """The first tip is found at 0.1 of the paper's interval, by a method of order 8."""
    banana, transit = tokamak("banana", t_end=16_000), tokamak("transit", t_end=60_000)
    runs = [integrate(problem, method=EIPDOP853, h=2 * problem.h, save_every=1) for problem in (banana, transit)]
    tips = ParticleOrbit(banana, runs[0].t, runs[0].y).bounce_points()
    np.testing.assert_allclose(tips, [1.00953], atol=2e-5)
    orbit = ParticleOrbit(transit, runs[1].t, runs[1].y)
    first, second = orbit.poloidal_turns()
    assert first.stop == second.start
    assert orbit.z[first].max() == pytest.approx(0.0614, abs=2e-4)
    assert orbit.z[second].min() == pytest.approx(-0.0614, abs=2e-4)


def test_averages_take_out_what_has_the_gyrations_period():
    problem = uniform_field(t_end=10.0)
    t = np.arange(100) * math.pi / 10
    orbit = ParticleOrbit(problem, t, np.tile(problem.y0[:, None], 100))
    np.testing.assert_allclose(orbit.averaged(3.0 + np.cos(t)), 3.0, rtol=1e-13)
    np.testing.assert_allclose(orbit.averaged(t), t[:81] + 9.5 * math.pi / 10, rtol=1e-13)
    t = np.sort(np.random.default_rng(1).uniform(0, 20 * math.pi, 1600))
    uneven = ParticleOrbit(problem, t, np.tile(problem.y0[:, None], t.size))
    assert np.abs(uneven.averaged(np.cos(t))).max() < 4e-3
