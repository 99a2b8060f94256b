"""Charged particles: fields against the paper's formulas in 30 digits, invariants, observables, user-defined fields."""

import math
import re
from dataclasses import replace

import mpmath as mp
import numpy as np
import pytest
from numba import njit
from scipy.integrate import solve_ivp

from eip_scipy import EIPDOP853, EIPRK4, EIPRK45, Invariant, check_gradient, integrate
from eip_scipy.problems import TOKAMAK, UNIFORM, ParticleField, charged_particle, tokamak, uniform_field
from eip_scipy.problems.particle_orbits import ParticleOrbit, radial_range

POINTS = [(1.05, 0.0, 0.0), (0.3, -0.9, 0.07), (-0.8, 0.7, -0.2), (1.3, 0.2, 0.5)]


# --- the paper's fields ---


def paper_uniform(x, y, z):
    """Return A and phi as printed."""
    return (-y / 2, x / 2, mp.mpf(0)), mp.mpf("1e-2") / mp.sqrt(x**2 + y**2)


def paper_tokamak(x, y, z):
    R = mp.sqrt(x**2 + y**2)
    b = ((1 - R) ** 2 + z**2) / (4 * R**2)
    return (x * z / (2 * R**2) - b * y, y * z / (2 * R**2) + b * x, -mp.log(R) / 2), mp.mpf(0)


def paper_tokamak_magnetic(x, y, z):
    R = mp.sqrt(x**2 + y**2)
    return -(2 * y + x * z) / (2 * R**2), (2 * x - y * z) / (2 * R**2), (R - 1) / (2 * R)


FIELDS = [(UNIFORM, paper_uniform), (TOKAMAK, paper_tokamak)]


def exact_jacobian(paper, point):
    """Return rows dA_i/dx_j, and grad phi."""

    def slope(value, j):
        return mp.diff(value, point, tuple(int(k == j) for k in range(3)))

    rows = [[slope(lambda *p, i=i: paper(*p)[0][i], j) for j in range(3)] for i in range(3)]
    return np.array(rows, dtype=float), np.array([slope(lambda *p: paper(*p)[1], j) for j in range(3)], dtype=float)


@pytest.mark.parametrize(("field", "paper"), FIELDS, ids=["uniform", "tokamak"])
@pytest.mark.parametrize("point", POINTS)
def test_field_is_the_papers(field, paper, point):
    functions = field.functions
    with mp.workdps(30):
        exact = [mp.mpf(c) for c in point]
        A, phi = paper(*exact)
        jacobian, slope = exact_jacobian(paper, exact)
    np.testing.assert_allclose(functions.A(0.0, *point), np.array(A, dtype=float), rtol=1e-14, atol=1e-16)
    np.testing.assert_allclose(functions.phi(0.0, *point), float(phi), rtol=1e-15)
    np.testing.assert_allclose(np.array(functions.jacobian(0.0, *point)), jacobian, rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(functions.E(0.0, *point), -slope, rtol=1e-13, atol=1e-17)


@pytest.mark.parametrize(("field", "paper"), FIELDS, ids=["uniform", "tokamak"])
@pytest.mark.parametrize("point", POINTS)
def test_magnetic_field_is_the_curl_and_the_papers(field, paper, point):
    with mp.workdps(30):
        exact = [mp.mpf(c) for c in point]
        d, _ = exact_jacobian(paper, exact)
        printed = (0, 0, 1) if field is UNIFORM else paper_tokamak_magnetic(*exact)
    curl = [d[2, 1] - d[1, 2], d[0, 2] - d[2, 0], d[1, 0] - d[0, 1]]
    np.testing.assert_allclose(field.functions.B(0.0, *point), curl, rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(field.functions.B(0.0, *point), np.array(printed, dtype=float), rtol=1e-14, atol=1e-16)


def test_fields_along_many_points():
    x = np.array(POINTS).T
    for key in ("A", "E", "B"):
        expected = np.array([getattr(UNIFORM.functions, key)(0.0, *point) for point in POINTS]).T
        np.testing.assert_array_equal(UNIFORM.along(key, x), expected)
    np.testing.assert_array_equal(UNIFORM.along("phi", x), [UNIFORM.functions.phi(0.0, *point) for point in POINTS])


# --- equations and invariants ---


@pytest.fixture(
    scope="module", params=["canonical", pytest.param("velocity", marks=[pytest.mark.nightly, pytest.mark.slow])]
)
def form(request):
    return request.param


@pytest.fixture(scope="module", params=[uniform_field, tokamak])
def problem(request, form):
    return request.param(form=form)


def test_invariants_have_their_gradients_and_do_not_change(problem):
    rng = np.random.default_rng(5)
    for point in POINTS:
        y = np.concatenate([point, rng.normal(0.0, 0.1, 3)])
        f = problem.fun(0.0, y)
        for item in problem.invariants:
            assert check_gradient(item, 0.0, y, fun=problem.fun) < 1e-8
            gradient = np.zeros(6)
            item.grad(0.0, y, *([f] if item.uses_f else []), gradient, *item.args)
            assert abs(gradient @ f) < 1e-15 + 1e-13 * (np.abs(gradient) * np.abs(f)).sum()


@pytest.mark.slow
@pytest.mark.parametrize("make", [uniform_field, tokamak])
def test_both_forms_are_the_same_motion(make):
    t_end = 40.0
    ends = []
    for form in ("canonical", "velocity"):
        problem = make(form=form, t_end=t_end, h=0.02)
        run = integrate(problem, method=EIPDOP853, invariants=())
        end = run.y[:, -1:]
        ends.append(np.concatenate([end[:3], problem.velocity(end)])[:, 0])
    np.testing.assert_allclose(*ends, rtol=0, atol=1e-13)
    assert np.linalg.norm(ends[0][:3] - problem.y0[:3]) > 0.01


@pytest.mark.parametrize("make", [uniform_field, tokamak])
@pytest.mark.parametrize("form", ["canonical", pytest.param("velocity", marks=[pytest.mark.nightly, pytest.mark.slow])])
def test_first_reference_state_is_met(make, form):
    problem = make(form=form)
    t = problem.t_span[1] / 100
    run = integrate(problem, (0.0, t), method=EIPDOP853, h=problem.h / 2, compensated=True)
    np.testing.assert_allclose(run.y[:, -1], problem.reference(t), rtol=0, atol=1e-11)
    assert problem.reference(1.5 * t) is None


def test_order_four_with_the_invariants_kept(problem):
    t = 300 * problem.h
    truth = integrate(problem, (0.0, t), method=EIPDOP853, h=problem.h / 4).y[:, -1]
    errors = []
    for n in (2, 4):
        run = integrate(problem, (0.0, t), method=EIPRK4, h=problem.h / n)
        errors.append(np.linalg.norm(run.y[:, -1] - truth))
        assert (run.max_defect / np.abs(run.invariants[:, 0])).max() < 1e-10
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4.0, abs=0.25)


def test_orientation_of_the_axes_does_not_matter():
    """Blocks of 3: a start turned around z gives the turned orbit, with the default metric, too."""
    turn = np.array([[math.cos(0.7), -math.sin(0.7), 0.0], [math.sin(0.7), math.cos(0.7), 0.0], [0.0, 0.0, 1.0]])
    x, v = np.array([1.05, 0, 0]), np.array([0, 4.816e-4, -2.059e-3])
    ends = []
    for R in (np.eye(3), turn):
        problem = charged_particle(TOKAMAK, R @ x, R @ v, t_span=(0.0, 60.0), h=math.pi / 10)
        ends.append(R.T @ integrate(problem, method=EIPRK4).y[:3, -1])
    np.testing.assert_allclose(*ends, rtol=0, atol=1e-12)


# --- observables ---


@njit
def constant_a(x, y, z):
    return -y, x, 0.0


@njit
def constant_b(x, y, z):
    return 0.0, 0.0, 2.0


@njit
def constant_e(x, y, z):
    return 0.0, 0.3, 0.0


@njit
def slope_phi(x, y, z):
    return -0.3 * y


@pytest.mark.parametrize("charge", [3.0, pytest.param(-3.0, marks=[pytest.mark.nightly, pytest.mark.slow])])
def test_gyration_in_a_constant_field(charge):
    """B = 2 e_z, m = 1.5: frequency |q| B / m, radius m v / (|q| B), and the E x B drift (0.15, 0, 0)."""
    field = ParticleField(vector_potential=constant_a, magnetic=constant_b, electric=constant_e, potential=slope_phi)
    mass, v = 1.5, np.array([0.15 + 0.4, 0.0, 0.25])
    problem = charged_particle(field, [0.5, 1.0, 0.0], v, mass=mass, charge=charge, t_span=(0.0, 10.0), h=0.01)
    run = integrate(problem, method=EIPRK4, save_every=1)
    orbit = ParticleOrbit(problem, run.t, run.y)
    omega = abs(charge) * 2.0 / mass
    assert orbit.gyrofrequency == pytest.approx(omega)
    np.testing.assert_allclose(orbit.gyroradius, 0.4 / omega, rtol=1e-7)
    np.testing.assert_allclose(orbit.magnetic_moment, 0.5 * mass * 0.4**2 / 2.0, rtol=1e-7)
    np.testing.assert_allclose(orbit.parallel_velocity, 0.25, rtol=1e-7)
    np.testing.assert_allclose(orbit.v[:, -1], problem.velocity(run.y)[:, -1])
    # Guiding centre: drifts with 0.15 along x and 0.25 along z; averaged, its gyration is gone.
    drift = np.diff(orbit.averaged(orbit.guiding_centre)[:, [0, -1]], axis=1)[:, 0]
    expected = np.array([0.15, 0.0, 0.25]) * (orbit.averaged(run.t)[-1] - orbit.averaged(run.t)[0])
    np.testing.assert_allclose(drift, expected, atol=2e-4)
    np.testing.assert_allclose(orbit.energy, problem.invariants[0].fun(0.0, problem.y0, problem.params), rtol=1e-11)
    # Clockwise for a positive charge, seen along B; relative to the direction away from the axis.
    angle = orbit.gyrophase + np.unwrap(np.arctan2(run.y[1], run.y[0]))
    np.testing.assert_allclose(angle - angle[0], -np.sign(charge) * omega * run.t, atol=1e-5)


def test_gyrophase_of_a_particle_that_starts_on_the_axis():
    # The directions x there, and away from the axis afterwards, are those of one motion as long as that goes along x.
    field = ParticleField(vector_potential=constant_a, magnetic=constant_b)
    problem = charged_particle(field, [0.0, 0.0, 0.0], [1.0, 0.0, 0.5], t_span=(0.0, 0.01), h=0.001)
    run = integrate(problem, method=EIPRK4, save_every=1)
    phase = ParticleOrbit(problem, run.t, run.y).gyrophase
    turned = np.arctan2(run.y[1, 1:], run.y[0, 1:])
    np.testing.assert_allclose(phase[1:] + turned, phase[0] - 2.0 * run.t[1:], atol=1e-9)


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


def test_banana_tip():
    """The first tip is found at 0.1 of the paper's interval, by a method of order 8."""
    problem = tokamak("banana", t_end=16_000)
    run = integrate(problem, method=EIPDOP853, h=2 * problem.h, save_every=1)
    orbit = ParticleOrbit(problem, run.t, run.y)
    tips = orbit.banana_tips()
    np.testing.assert_allclose(tips.R, [1.00953], atol=2e-5)
    k = int(np.searchsorted(run.t, tips.t[0]))
    assert abs(orbit.parallel_velocity[k]) < 0.01 * np.abs(orbit.parallel_velocity).max()
    assert tips.z[0] == pytest.approx(orbit.guiding_centre[2, k], abs=1e-5)


def test_poloidal_turns_of_the_transit_orbit():
    problem = tokamak("transit", t_end=60_000)
    run = integrate(problem, method=EIPDOP853, h=2 * problem.h, save_every=1)
    orbit = ParticleOrbit(problem, run.t, run.y)
    parts = list(orbit.poloidal_turns())
    assert len(parts) == 2
    assert parts[0].stop == parts[1].start
    for part in parts:
        assert orbit.z[part].max() == pytest.approx(0.0614, abs=2e-4)
        assert orbit.z[part].min() == pytest.approx(-0.0614, abs=2e-4)
        assert orbit.R[part].max() - 1 < 0.06 < 1 - orbit.R[part].min()


def test_averages_need_enough_states():
    problem = tokamak(t_end=200.0)
    run = integrate(problem, method=EIPRK4, save_every=10)
    with pytest.raises(ValueError, match="Save more often"):
        ParticleOrbit(problem, run.t, run.y).averaged(run.t)


def test_averages_take_out_what_has_the_gyrations_period():
    problem = uniform_field(t_end=10.0)
    t = np.arange(100) * math.pi / 10
    orbit = ParticleOrbit(problem, t, np.tile(problem.y0[:, None], 100))
    np.testing.assert_allclose(orbit.averaged(3.0 + np.cos(t)), 3.0, rtol=1e-13)
    np.testing.assert_allclose(orbit.averaged(t), t[:81] + 9.5 * math.pi / 10, rtol=1e-13)
    backward = ParticleOrbit(problem, -t, orbit.y)
    np.testing.assert_allclose(backward.averaged(3.0 + np.cos(t)), 3.0, rtol=1e-13)


@pytest.mark.parametrize("seed", range(3))
def test_averages_weigh_states_by_the_spacing_of_their_times(seed):
    """The mean of a cosine over its period is 0, whatever the times."""
    problem = uniform_field(t_end=10.0)
    t = np.sort(np.random.default_rng(seed).uniform(0, 20 * math.pi, 1600))
    orbit = ParticleOrbit(problem, t, np.tile(problem.y0[:, None], t.size))
    assert np.abs(orbit.averaged(np.cos(t))).max() < 4e-3


# --- user-defined fields ---


@njit
def mirror_a(x, y, z):
    return -0.5 * y * (1 + z * z), 0.5 * x * (1 + z * z), 0.0


@njit
def mirror_b(x, y, z):
    return -x * z, -y * z, 1 + z * z


@njit
def mirror_jacobian(x, y, z):
    b = 0.5 * (1 + z * z)
    return (0.0, -b, -y * z), (b, 0.0, x * z), (0.0, 0.0, 0.0)


@njit
def well(x, y, z):
    return 0.05 * (x * x + y * y) * (1 + z)


@njit
def well_force(x, y, z):
    return -0.1 * x * (1 + z), -0.1 * y * (1 + z), -0.05 * (x * x + y * y)


MIRRORS = {
    "A alone": (ParticleField(mirror_a, potential=well, axisymmetric=True), "canonical", "HL"),
    "A, jacobian": (
        ParticleField(mirror_a, mirror_jacobian, potential=well, electric=well_force, axisymmetric=True),
        "canonical",
        "HL",
    ),
    "A, (x, v)": (ParticleField(mirror_a, potential=well, axisymmetric=True), "velocity", "HL"),
    "B alone": (ParticleField(magnetic=mirror_b, potential=well, electric=well_force), "velocity", "H"),
    "no potential": (ParticleField(magnetic=mirror_b, electric=well_force), "velocity", ""),
    "not axisymmetric": (ParticleField(mirror_a, potential=well), "canonical", "H"),
}


def mirror_run(field, form, **options):
    problem = charged_particle(
        field, [0.2, 0.1, 0.3], [0.1, 0.3, 0.2], mass=2.0, charge=-1.5, form=form, t_span=(0.0, 20.0), h=0.05
    )
    run = integrate(problem, method=EIPRK45, first_step=0.05, rtol=1e-11, atol=1e-13, **options)
    return problem, run


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("name", MIRRORS)
def test_own_field(name):
    field, form, kept = MIRRORS[name]
    problem, run = mirror_run(field, form)
    assert "".join(item.name for item in problem.invariants) == kept
    assert run.success
    assert run.max_defect.max(initial=0.0) < 1e-11
    reference, truth = mirror_run(*MIRRORS["A, jacobian"][:2])
    np.testing.assert_allclose(run.y[:3, -1], truth.y[:3, -1], rtol=0, atol=2e-9)
    np.testing.assert_allclose(problem.velocity(run.y[:, -1:]), reference.velocity(truth.y[:, -1:]), rtol=0, atol=2e-9)


@pytest.mark.needs_jit
@pytest.mark.parametrize(
    "name",
    [
        name if name == "B alone" else pytest.param(name, marks=[pytest.mark.nightly, pytest.mark.slow])
        for name in MIRRORS
    ],
)
def test_own_field_compiles(name):
    field, form, _ = MIRRORS[name]
    assert mirror_run(field, form, compiled=True)[1].compiled


def test_plain_python_functions_do_as_well():
    plain = ParticleField(
        lambda x, y, z: [-0.5 * y * (1 + z * z), 0.5 * x * (1 + z * z), 0.0],
        potential=lambda x, y, z: 0.05 * (x * x + y * y) * (1 + z),
        axisymmetric=True,
    )
    _, run = mirror_run(plain, "canonical")
    _, truth = mirror_run(*MIRRORS["A, jacobian"][:2])
    assert not run.compiled
    np.testing.assert_allclose(run.y[:3, -1], truth.y[:3, -1], rtol=0, atol=2e-9)
    assert run.max_defect.max() < 1e-11
    points = np.array(POINTS).T
    np.testing.assert_allclose(plain.along("B", points), np.array([mirror_b(*p) for p in POINTS]).T, rtol=1e-10)


@pytest.mark.parametrize(("form", "varies"), [("canonical", False), ("velocity", False), ("velocity", True)])
def test_functions_may_return_the_same_array_in_each_call(form, varies):
    """A particle gyrates once in the uniform field B = e_z."""
    array = np.empty(3)

    def A(*where):
        array[:] = -where[-2] / 2, where[-3] / 2, 0.0
        return array

    def E(*where):
        array[:] = 0.0
        return array

    field = ParticleField(A, electric=E, potential=lambda *where: 0.0, varies=varies)
    problem = charged_particle(field, [1.0, 0, 0], [0, 0.5, 0.1], t_span=(0, 2 * np.pi), form=form)
    run = integrate(problem, method=EIPDOP853, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(run.y[:3, -1], [1.0, 0.0, 0.2 * np.pi], rtol=0, atol=1e-8)


def test_differences_take_the_fields_length():
    """Differences of the same field on a small scale need its length, which determines their step."""
    small = 1e-6
    field = ParticleField(
        lambda x, y, z: (-y * math.cos(z / small), x * math.cos(z / small), 0.0), axisymmetric=True, length=small
    )
    x = np.array([0.3, -0.2, 0.5]) * small
    jacobian = np.array(field.functions.jacobian(0.0, *x))
    assert jacobian[0, 2] == pytest.approx(x[1] / small * math.sin(0.5), rel=1e-11)


def start_of_differences(field, position):
    return charged_particle(field, position, [0.0, 0.1, 0.0], t_span=(0.0, 1.0))


def wiggler(x, y, z):
    return 0.0, math.sin(100 * x) / 100, 0.0


def narrow(x, y, z):
    """Return a vector potential that underflows to 0 within the default step."""
    around = math.exp(-(x * x + y * y) / 1e-12)
    return -around * y, around * x, 0.0


@pytest.mark.parametrize("form", ["canonical", "velocity"])
def test_a_length_that_does_not_fit_is_told(form):
    """In SI units at 1 au the default step is lost in rounding; the length in the warning gives the exact helix."""
    place, B, charge, mass, speed = 1.5e11, 5e-9, 1.602e-19, 1.6726e-27, 3e7
    omega = charge * B / mass
    field = ParticleField(lambda x, y, z: (-B * y / 2, B * x / 2, 0.0), axisymmetric=True)
    end = 20 * 2 * math.pi / omega
    start, velocity = [place, 0, 0], [0, 0.8 * speed, 0.6 * speed]
    options = {"t_span": (0.0, end), "h": end / 1200, "mass": mass, "charge": charge, "form": form}
    with pytest.warns(UserWarning, match="length=1 does not fit the field at .* relative error of 0.00") as told:
        charged_particle(field, start, velocity, **options)
    assert len(told) == 1
    assert told[0].filename == __file__
    named = float(re.search(r"set length=(\S+) ", str(told[0].message))[1])
    problem = charged_particle(replace(field, length=named), start, velocity, **options)
    run = integrate(problem, method=EIPDOP853)
    exact = [place, 0.0, 0.6 * speed * end]
    np.testing.assert_allclose(run.y[:3, -1], exact, rtol=0, atol=1e-5 * 0.8 * speed / omega)
    assert run.max_defect[0] < 1e-10 * abs(run.target[0])


@pytest.mark.parametrize(
    ("field", "position", "words"),
    [
        (ParticleField(wiggler), [1e-3, 0.0, 0.0], "vector_potential .* give jacobian or magnetic"),
        (ParticleField(narrow), [1e-7, 1e-7, 0.0], "vector_potential have a relative error of 1,"),
        (ParticleField(constant_a), [1e17, 1.0, 0.0], "vector_potential have a relative error of 1,"),
        (
            ParticleField(constant_a, potential=lambda x, y, z: math.sin(80 * x)),
            [1.0, 0.0, 0.0],
            "potential .* give electric",
        ),
    ],
)
def test_lengths_too_long_or_too_short(field, position, words):
    with pytest.warns(UserWarning, match=words) as told:
        start_of_differences(field, position)
    named = float(re.search(r"set length=(\S+) ", str(told[0].message))[1])
    assert start_of_differences(replace(field, length=named), position).invariants


@pytest.mark.parametrize(
    ("vector_potential", "position"),
    [
        (constant_a, [1e6, 2e5, -3e5]),
        (lambda x, y, z: (1.0, 2.0, 3.0), [1.0, 2.0, 3.0]),  # no field
        (lambda x, y, z: (2 * x * y, x * x, 0.0), [1.1, 0.2, 0.3]),  # no field
        (lambda x, y, z: (0.0, 0.0, x * x - y * y), [0.0, 1e-12, 0.0]),  # almost none where the particle starts
        (lambda x, y, z: (-math.log(math.cosh(z)), 1e3, 0.0), [0.0, 0.0, 1e-9]),
        (lambda x, y, z: (y * math.sqrt(x), 0.0, 0.0), [0.03, 1.0, 0.0]),  # defined in a half of space only
    ],
)
def test_a_length_that_fits_is_not_told(vector_potential, position):
    assert start_of_differences(ParticleField(vector_potential), position).invariants


@pytest.mark.filterwarnings("ignore:.*not to be trusted:eip_scipy.ProjectionWarning")
def test_a_wrong_claim_of_symmetry_is_seen():
    field = ParticleField(lambda x, y, z: (-y, x * (1 + 0.1 * x), 0.0), axisymmetric=True)
    problem = charged_particle(field, [0.2, 0.1, 0.0], [0.1, 0.3, 0.2], t_span=(0.0, 1.0), h=0.1)
    with pytest.warns(UserWarning, match="L"):
        integrate(problem, method=EIPRK4)


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.needs_jit
@pytest.mark.parametrize("form", ["velocity", pytest.param("canonical", marks=[pytest.mark.nightly, pytest.mark.slow])])
def test_compiled_functions_may_return_integers_and_arrays(form):
    @njit
    def mixed_a(x, y, z):
        return -0.5 * y, 0.5 * x, 0

    @njit
    def array_jacobian(x, y, z):
        return np.array([[0.0, -0.5, 0.0], [0.5, 0.0, 0.0], [0.0, 0.0, 0.0]])

    @njit
    def mixed_e(x, y, z):
        return 0, 0.02 * y, 0

    field = ParticleField(mixed_a, array_jacobian, lambda x, y, z: -0.01 * y * y, mixed_e)
    jitted = replace(field, potential=njit(field.potential))
    problem = charged_particle(jitted, [1, 0, 0], [0.1, 0, 0.2], form=form, t_span=(0, 20), h=0.05)
    run = integrate(problem, method=EIPRK4, compiled=True)
    assert run.max_defect.max() < 1e-13
    plain = charged_particle(field, [1, 0, 0], [0.1, 0, 0.2], form=form, t_span=(0, 20), h=0.05)
    np.testing.assert_allclose(integrate(plain, method=EIPRK4).y[:, -1], run.y[:, -1], atol=1e-13)
    out = np.empty(6)
    jitted.fill(0.0, problem.y0[:3], out)
    np.testing.assert_array_equal(out, [0, 0, 0, 0, 0, 1])


def test_functions_of_one_field_are_composed_once():
    a, b = tokamak("banana"), tokamak("transit")
    assert a.rhs is b.rhs
    assert a.invariants[0].function is b.invariants[0].function
    assert replace(a, h=0.1).field is TOKAMAK


def start(field=UNIFORM, position=(1.0, 0, 0), velocity=(0, 0.1, 0), **options):
    return charged_particle(field, position, velocity, t_span=(0.0, 1.0), **options)


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: start(field="uniform"), TypeError, "ParticleField"),
        (lambda: start(form="canonicl"), ValueError, "canonical"),
        (lambda: start(position=(1.0, 0.0)), ValueError, "position must be three finite numbers"),
        (lambda: start(velocity=(1.0, 0.0, np.nan)), ValueError, "velocity must be three finite numbers"),
        (lambda: start(mass=0.0), ValueError, "mass must be positive"),
        (lambda: start(charge=0.0), ValueError, "charge not 0"),
        (lambda: start(position=(0.0, 0.0, 0.0)), (ValueError, ZeroDivisionError), "."),
        (lambda: start(field=ParticleField(magnetic=constant_b)), ValueError, "vector_potential"),
        (lambda: ParticleField(), ValueError, "vector_potential, or magnetic"),
        (
            lambda: ParticleField(magnetic=constant_b, jacobian=mirror_jacobian),
            ValueError,
            "without vector_potential",
        ),
        (lambda: ParticleField(vector_potential=3.0), TypeError, "function of"),
        (lambda: ParticleField(constant_a, length=0.0), ValueError, "length must be positive"),
        (lambda: start(field=ParticleField(constant_a, magnetic=mirror_b)), ValueError, "the curl of"),
        (lambda: start(field=ParticleField(constant_a, mirror_jacobian)), ValueError, "the derivatives of"),
        (
            lambda: start(field=ParticleField(constant_a, potential=well, electric=constant_e)),
            ValueError,
            "minus the gradient",
        ),
        (lambda: start(field=ParticleField(lambda x, y, z: (x, y))), ValueError, "shape"),
        (lambda: start(field=ParticleField(lambda x, y, z: (x, y, math.inf))), ValueError, "finite"),
        (lambda: tokamak("bananna"), ValueError, "banana"),
    ],
)
def test_bad_input(call, error, words):
    with pytest.raises(error, match=words):
        call()


def dipole(x, y, z):
    r2 = x * x + y * y + z * z
    return 3 * x * z / r2**2.5, 3 * y * z / r2**2.5, (3 * z * z - r2) / r2**2.5


def wire(x, y, z):
    return -y / (x * x + y * y), x / (x * x + y * y), 0.0


def ripple(x, y, z):
    """Return a field that changes over 1/30 of the default length."""
    return math.sin(200 * x) * math.cos(200 * y), -math.cos(200 * x) * math.sin(200 * y), 1e3


def nothing(x, y, z):
    return 0.0, 0.0, 0.0


@pytest.mark.parametrize("place", [0.1, 1.0, 1e6])
@pytest.mark.parametrize("field", [dipole, wire, ripple, nothing, mirror_b, constant_b, TOKAMAK.magnetic])
@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e12])
def test_a_field_without_divergence_passes(field, place, scale):
    position = place * np.array([0.6, 0.5, -0.4])
    scaled = ParticleField(magnetic=lambda x, y, z: tuple(scale * b for b in field(x, y, z)))
    assert start(field=scaled, position=position, form="velocity").invariants


@pytest.mark.parametrize(
    "field",
    [
        lambda x, y, z: (x, 0.0, 0.0),
        lambda x, y, z: (0.0, 0.0, 1 + z * z),  # none at z = 0, where the particle starts
        lambda x, y, z: (0.0, 0.0, 5e4 + 1e-3 * z),
        lambda x, y, z: tuple(b + x for b in dipole(x, y, z)),
    ],
)
def test_a_field_with_a_divergence_is_refused(field):
    with pytest.raises(ValueError, match=r"divergence of magnetic is -?[\d.e-]+ at \[.*, where its largest derivative"):
        start(field=ParticleField(magnetic=field), form="velocity")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        (lambda x, y, z: (1e-4 * x - x * z, -y * z, 1 + z * z), r"0\.0001"),
        (lambda x, y, z: (x * z, y * z, 1 + z * z), r"0\.0\d+"),  # small relative to dB_x/dz where the particle starts
    ],
)
def test_a_small_divergence_is_told(field, value):
    """The field is given as by a table; the run continues, because the energy is kept all the same."""
    with pytest.warns(UserWarning, match=f"divergence of magnetic is {value} at") as told:
        start(field=ParticleField(magnetic=field), form="velocity")
    assert len(told) == 1


def test_energy_and_momentum_need_their_potentials():
    field = ParticleField(magnetic=mirror_b, electric=well_force)
    problem = start(field=field, form="velocity", h=0.1)
    run = integrate(problem, method=EIPRK4, save_every=1)
    orbit = ParticleOrbit(problem, run.t, run.y)
    with pytest.raises(ValueError, match="potential"):
        _ = orbit.energy
    with pytest.raises(ValueError, match="vector_potential"):
        _ = orbit.momentum


@pytest.mark.slow
def test_further_invariants_can_be_added():
    """RK keeps p_z in the uniform field, which the problem does not list."""
    problem = charged_particle(UNIFORM, [1, 0, 0], [0.1, 0, 0.2], t_span=(0, 20), h=math.pi / 10)
    p_z = Invariant(lambda t, y, params: y[5], lambda t, y, params: np.eye(6)[5], args=(problem.params,), name="p_z")
    run = integrate(problem, method=EIPRK4, invariants=[*problem.invariants, p_z])
    assert run.max_defect[2] == 0.0


# --- fields that vary, and balances ---


def ring_a(t, x, y, z):
    around = (1 + 1e-4 * t) * (0.5 + (x * x + y * y) / 4)
    return -around * y, around * x, 0.0


def ring_b(t, x, y, z):
    return 0.0, 0.0, (1 + 1e-4 * t) * (1 + x * x + y * y)


def ring_phi(t, x, y, z):
    return 0.02 * (1 + 5e-4 * t) * (x * x + y * y)


def ring_e(t, x, y, z):
    out, around = -0.04 * (1 + 5e-4 * t), 1e-4 * (0.5 + (x * x + y * y) / 4)
    return out * x + around * y, out * y - around * x, 0.0


def ring(**options):
    given = {"vector_potential": ring_a, "magnetic": ring_b, "electric": ring_e, "axisymmetric": True, "varies": True}
    return ParticleField(**(given | options))


def moving(field, balances=None, t_end=20.0, **options):
    given = {"form": "velocity", "h": 0.4, "mass": 1.5, "charge": -0.7} | options
    return charged_particle(field, [0.5, 0.1, 0.2], [0.1, 0.3, 0.05], t_span=(0.5, t_end), balances=balances, **given)


@pytest.mark.parametrize(
    ("field", "balances", "names"),
    [
        (ring(), None, "L"),
        (ring(), "energy", "TL"),
        (ring(potential=ring_phi), None, "L"),
        (ring(potential=ring_phi), "energy", "HL"),
        (ring(potential=ring_phi), "kinetic", "TL"),
        (ParticleField(magnetic=mirror_b, electric=well_force), "energy", "T"),
    ],
)
@pytest.mark.filterwarnings("ignore:balance 'T' changes")  # in a potential
def test_energies_in_fields_that_do_work(field, balances, names):
    problem = moving(field, balances)
    assert "".join(item.name for item in problem.invariants) == names
    y = problem.y0
    v, m, q = y[3:], problem.mass, problem.charge
    E = np.array(field.functions.E(0.5, *y[:3]))
    B = np.array(field.functions.B(0.5, *y[:3]))
    np.testing.assert_allclose(problem.fun(0.5, y)[3:], q / m * (E + np.cross(v, B)), rtol=1e-14, atol=1e-16)
    for item in problem.invariants:
        if item.name == "T":
            assert item.fun(0.5, y, problem.params) == pytest.approx(0.5 * m * v @ v, rel=1e-15)
            assert item.rate_function(0.5, y, problem.params) == pytest.approx(q * v @ E, rel=1e-14)
        elif item.name == "H":
            expected = 0.5 * m * v @ v + q * ring_phi(0.5, *y[:3])
            assert item.fun(0.5, y, problem.params) == pytest.approx(expected, rel=1e-15)
    run = integrate(problem, method=EIPDOP853)
    assert run.trusted
    exact = solve_ivp(problem.fun, problem.t_span, y, method="DOP853", rtol=1e-13, atol=1e-15).y[:, -1]
    np.testing.assert_allclose(run.y[:, -1], exact, rtol=0, atol=2e-7)


def test_a_cycloid():
    """In constant fields E along x and B along z the charge drifts along -y; the potential is not given."""
    drift, end = 0.01, 600.0
    field = ParticleField(magnetic=lambda x, y, z: (0.0, 0.0, 1.0), electric=lambda x, y, z: (drift, 0.0, 0.0))
    problem = charged_particle(
        field, [0, 0, 0], [0, 0.5, 0], t_span=(0, end), h=0.5, form="velocity", balances="energy"
    )
    speed = 0.5 + drift
    exact = np.array([speed * (1 - np.cos(end)), speed * np.sin(end) - drift * end])
    errors = [
        np.linalg.norm(integrate(problem, method=EIPDOP853, invariants=kept).y[:2, -1] - exact)
        for kept in ((), problem.invariants)
    ]
    assert errors[0] < 1e-4
    assert errors[1] < 1.1 * errors[0]


@pytest.mark.nightly
@pytest.mark.slow
def test_the_total_energy_keeps_a_place():
    """The run agrees with DOP853 of SciPy at rtol=1e-13; nothing depends on z, so that v_z is kept as well."""
    problem = moving(ring(potential=ring_phi), "energy", t_end=1000.0, h=0.4, mass=1.0, charge=1.0)
    exact = solve_ivp(problem.fun, problem.t_span, problem.y0, method="DOP853", rtol=1e-13, atol=1e-15).y[:3, -1]
    along = Invariant(lambda t, y, params: y[5], name="v_z")
    errors = [
        np.linalg.norm(integrate(problem, method=EIPDOP853, invariants=kept).y[:3, -1] - exact)
        for kept in ((), (*problem.invariants, along))
    ]
    assert 20 * errors[1] < errors[0]


def test_observables_of_a_field_that_varies():
    problem = moving(ring(potential=ring_phi), "energy")
    run = integrate(problem, method=EIPDOP853, save_every=1)
    orbit = ParticleOrbit(problem, run.t, run.y)
    np.testing.assert_allclose(orbit.gyrofrequency, 0.7 / 1.5 * (1 + 1e-4 * run.t) * (1 + orbit.R**2), rtol=1e-14)
    np.testing.assert_allclose(orbit.momentum, orbit.momentum[0], rtol=1e-6)
    assert 1e-6 < np.ptp(orbit.energy) < 1e-2


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: ring(electric=None), "a field that varies needs electric"),
        (lambda: moving(ring(), form="canonical"), "a field that varies needs form='velocity'"),
        (lambda: moving(UNIFORM, "energy", form="canonical"), "balances need form='velocity'"),
        (lambda: moving(ring(), "energie"), "balances must be 'energy', 'kinetic' or None"),
        (lambda: moving(ring(magnetic=lambda t, x, y, z: (0.0, 0.0, 2.0))), "the curl of"),
    ],
)
def test_what_is_refused_of_varying_fields(make, match):
    with pytest.raises(ValueError, match=match):
        make()
