"""Charged particles: fields against the paper's formulas in 30 digits, invariants, user-defined fields."""

import math
from dataclasses import replace

import mpmath as mp
import numpy as np
import pytest
from numba import config, njit
from scipy.integrate import solve_ivp

from eip_scipy import EIPDOP853, EIPRK4, EIPRK45, check_gradient, integrate
from eip_scipy.problems import TOKAMAK, UNIFORM, ParticleField, charged_particle, tokamak, uniform_field

POINTS = [(1.05, 0.0, 0.0), (0.3, -0.9, 0.07), (-0.8, 0.7, -0.2), (1.3, 0.2, 0.5)]
VELOCITY = pytest.param("velocity", marks=pytest.mark.nightly)
FORMS = pytest.mark.parametrize("form", ["canonical", VELOCITY])
MAKERS = pytest.mark.parametrize("make", [uniform_field, tokamak])


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
def test_fields_are_the_papers(field, paper):
    functions = field.functions
    for point in POINTS:
        with mp.workdps(30):
            exact = [mp.mpf(c) for c in point]
            A, phi = paper(*exact)
            jacobian, slope = exact_jacobian(paper, exact)
            printed = (0, 0, 1) if field is UNIFORM else paper_tokamak_magnetic(*exact)
        curl = [jacobian[2, 1] - jacobian[1, 2], jacobian[0, 2] - jacobian[2, 0], jacobian[1, 0] - jacobian[0, 1]]
        B = functions.B(0.0, *point)
        for found, expected, tolerance in [
            (functions.A(0.0, *point), A, 1e-14), (functions.phi(0.0, *point), phi, 1e-15),
            (functions.jacobian(0.0, *point), jacobian, 1e-13), (functions.E(0.0, *point), -slope, 1e-13),
            (B, curl, 1e-13), (B, printed, 1e-14),
        ]:  # fmt: skip
            np.testing.assert_allclose(found, np.array(expected, dtype=float), rtol=tolerance, atol=1e-15)
    for key in ("A", "E", "B", "phi"):
        expected = np.array([getattr(functions, key)(0.0, *point) for point in POINTS]).T
        np.testing.assert_array_equal(field.along(key, np.array(POINTS).T), expected)


@FORMS
@MAKERS
def test_invariants_reference_and_order(make, form):
    problem, rng = make(form=form), np.random.default_rng(5)
    for point in POINTS:
        y = np.concatenate([point, rng.normal(0.0, 0.1, 3)])
        f = problem.fun(0.0, y)
        for item in problem.invariants:
            assert check_gradient(item, 0.0, y, fun=problem.fun) < 1e-8
            gradient = np.zeros(6)
            item.grad(0.0, y, *([f] if item.uses_f else []), gradient, *item.args)
            assert abs(gradient @ f) < 1e-15 + 1e-13 * (np.abs(gradient) * np.abs(f)).sum()
    t = problem.t_span[1] / 100
    run = integrate(problem, (0.0, t), method=EIPDOP853, h=problem.h / 2, compensated=True)
    np.testing.assert_allclose(run.y[:, -1], problem.reference(t), rtol=0, atol=1e-11)
    assert problem.reference(1.5 * t) is None
    t = 300 * problem.h
    truth = integrate(problem, (0.0, t), method=EIPDOP853, h=problem.h / 4).y[:, -1]
    runs = [integrate(problem, (0.0, t), method=EIPRK4, h=problem.h / n) for n in (2, 4)]
    errors = [np.linalg.norm(run.y[:, -1] - truth) for run in runs]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4.0, abs=0.25)
    assert max((run.max_residual / np.abs(run.invariants[:, 0])).max() for run in runs) < 1e-10


def test_orientation_of_the_axes_does_not_matter():
    """Blocks of 3: a start turned around z gives the turned orbit, with the default metric, too."""
    turn = np.array([[math.cos(0.7), -math.sin(0.7), 0.0], [math.sin(0.7), math.cos(0.7), 0.0], [0.0, 0.0, 1.0]])
    x, v, ends = np.array([1.05, 0, 0]), np.array([0, 4.816e-4, -2.059e-3]), []
    for R in (np.eye(3), turn):
        problem = charged_particle(TOKAMAK, R @ x, R @ v, t_span=(0.0, 60.0), h=math.pi / 10)
        ends.append(R.T @ integrate(problem, method=EIPRK4).y[:3, -1])
    np.testing.assert_allclose(*ends, rtol=0, atol=1e-12)


constant_a, constant_b = njit(lambda x, y, z: (-y, x, 0.0)), njit(lambda x, y, z: (0.0, 0.0, 2.0))
constant_e = njit(lambda x, y, z: (0.0, 0.3, 0.0))
mirror_a = njit(lambda x, y, z: (-0.5 * y * (1 + z * z), 0.5 * x * (1 + z * z), 0.0))
mirror_b = njit(lambda x, y, z: (-x * z, -y * z, 1 + z * z))
well = njit(lambda x, y, z: 0.05 * (x * x + y * y) * (1 + z))
well_force = njit(lambda x, y, z: (-0.1 * x * (1 + z), -0.1 * y * (1 + z), -0.05 * (x * x + y * y)))


@njit
def mirror_jacobian(x, y, z):
    b = 0.5 * (1 + z * z)
    return (0.0, -b, -y * z), (b, 0.0, x * z), (0.0, 0.0, 0.0)


PLAIN = ParticleField(
    lambda x, y, z: [-0.5 * y * (1 + z * z), 0.5 * x * (1 + z * z), 0.0],
    potential=lambda x, y, z: 0.05 * (x * x + y * y) * (1 + z),
    axisymmetric=True,
)
WHOLE = ParticleField(mirror_a, mirror_jacobian, potential=well, electric=well_force, axisymmetric=True)
MIRRORS = {  # field, form, names of what is kept
    "plain": (PLAIN, "canonical", "HL"),
    "B alone": (ParticleField(magnetic=mirror_b, potential=well, electric=well_force), "velocity", "H"),
    "A alone": (ParticleField(mirror_a, potential=well, axisymmetric=True), "canonical", "HL"),
    "A, (x, v)": (ParticleField(mirror_a, potential=well, axisymmetric=True), "velocity", "HL"),
    "no potential": (ParticleField(magnetic=mirror_b, electric=well_force), "velocity", ""),
    "not axisymmetric": (ParticleField(mirror_a, potential=well), "canonical", "H"),
}
GATE = ("plain", "B alone")


def mirror_run(field, form):
    start = {"position": [0.2, 0.1, 0.3], "velocity": [0.1, 0.3, 0.2], "mass": 2.0, "charge": -1.5}
    problem = charged_particle(field, **start, form=form, t_span=(0.0, 20.0), h=0.05)
    run = integrate(problem, method=EIPRK45, first_step=0.05, rtol=1e-11, atol=1e-13)
    return run, np.concatenate([run.y[:3, -1:], problem.velocity(run.y[:, -1:])])[:, 0]


@pytest.fixture(scope="module")
def truth():
    return mirror_run(WHOLE, "canonical")[1]


@pytest.mark.parametrize("name", [k if k in GATE else pytest.param(k, marks=pytest.mark.nightly) for k in MIRRORS])
def test_own_field(name, truth):
    field, form, kept = MIRRORS[name]
    run, end = mirror_run(field, form)
    assert run.compiled == (name != "plain" and not config.DISABLE_JIT)
    assert run.success
    assert len(run.invariants) == len(kept)
    assert run.max_residual.max(initial=0.0) < 1e-11
    np.testing.assert_allclose(end, truth, rtol=0, atol=2e-9)
    points = np.array(POINTS).T
    np.testing.assert_allclose(field.along("B", points), np.array([mirror_b(*p) for p in POINTS]).T, rtol=1e-9)


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
    small, place = 1e-6, np.array([0.3, -0.2, 0.5])
    A = lambda x, y, z: (-y * math.cos(z / small), x * math.cos(z / small), 0.0)  # noqa: E731
    jacobian = ParticleField(A, axisymmetric=True, length=small).functions.jacobian(0.0, *(place * small))
    assert jacobian[0][2] == pytest.approx(place[1] * math.sin(0.5), rel=1e-11)


@pytest.mark.filterwarnings("ignore:.*not to be trusted:eip_scipy.ProjectionWarning")
def test_a_wrong_claim_of_symmetry_is_seen():
    field = ParticleField(lambda x, y, z: (-y, x * (1 + 0.1 * x), 0.0), axisymmetric=True)
    problem = charged_particle(field, [0.2, 0.1, 0.0], [0.1, 0.3, 0.2], t_span=(0.0, 1.0), h=0.1)
    with pytest.warns(UserWarning, match="L"):
        integrate(problem, method=EIPRK4)


@pytest.mark.nightly
@pytest.mark.needs_jit
@pytest.mark.parametrize("form", ["velocity", "canonical"])
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
    assert run.max_residual.max() < 1e-13
    plain = charged_particle(field, [1, 0, 0], [0.1, 0, 0.2], form=form, t_span=(0, 20), h=0.05)
    np.testing.assert_allclose(integrate(plain, method=EIPRK4).y[:, -1], run.y[:, -1], atol=1e-13)
    out = np.empty(6)
    jitted.fill(0.0, problem.y0[:3], out)
    np.testing.assert_array_equal(out, [0, 0, 0, 0, 0, 1])


def ring_a(t, x, y, z):
    around = (1 + 1e-4 * t) * (0.5 + (x * x + y * y) / 4)
    return -around * y, around * x, 0.0


def ring_phi(t, x, y, z):
    return 0.02 * (1 + 5e-4 * t) * (x * x + y * y)


def ring_e(t, x, y, z):
    out, around = -0.04 * (1 + 5e-4 * t), 1e-4 * (0.5 + (x * x + y * y) / 4)
    return out * x + around * y, out * y - around * x, 0.0


def ring(**options):
    magnetic = lambda t, x, y, z: (0.0, 0.0, (1 + 1e-4 * t) * (1 + x * x + y * y))  # noqa: E731
    given = {"vector_potential": ring_a, "magnetic": magnetic, "electric": ring_e, "axisymmetric": True}
    return ParticleField(**(given | options), varies=True)


def moving(field, balances=None, t_end=20.0, **options):
    given = {"form": "velocity", "h": 0.4, "mass": 1.5, "charge": -0.7} | options
    return charged_particle(field, [0.5, 0.1, 0.2], [0.1, 0.3, 0.05], t_span=(0.5, t_end), balances=balances, **given)


@pytest.mark.parametrize(
    ("field", "balances", "names"),
    [
        (ring(), None, "L"),
        (ring(potential=ring_phi), None, "L"),
        (ring(), "energy", "TL"),
        (ring(potential=ring_phi), "energy", "HL"),
        (ring(potential=ring_phi), "kinetic", "TL"),
        (ParticleField(magnetic=mirror_b, electric=well_force), "energy", "T"),
    ],
)
@pytest.mark.filterwarnings("ignore:balance 'T' changes")  # in a potential
def test_energies_in_fields_that_do_work(field, balances, names):
    problem = moving(field, balances)
    assert "".join(item.name for item in problem.invariants) == names
    y, v, m, q = problem.y0, problem.y0[3:], problem.mass, problem.charge
    E, B = (np.array(getattr(field.functions, key)(0.5, *y[:3])) for key in "EB")
    np.testing.assert_allclose(problem.fun(0.5, y)[3:], q / m * (E + np.cross(v, B)), rtol=1e-14, atol=1e-16)
    for item in problem.invariants:
        if item.name in "TH":
            potential = q * ring_phi(0.5, *y[:3]) if item.name == "H" else 0.0
            assert item.fun(0.5, y, problem.params) == pytest.approx(0.5 * m * v @ v + potential, rel=1e-15)
        if item.name == "T":
            assert item.rate_function(0.5, y, problem.params) == pytest.approx(q * v @ E, rel=1e-14)
    run = integrate(problem, method=EIPDOP853)
    assert run.trusted
    exact = solve_ivp(problem.fun, problem.t_span, y, method="DOP853", rtol=1e-13, atol=1e-15).y[:, -1]
    np.testing.assert_allclose(run.y[:, -1], exact, rtol=0, atol=2e-7)


def start(field=UNIFORM, position=(1.0, 0, 0), velocity=(0, 0.1, 0), **options):
    return charged_particle(field, position, velocity, t_span=(0.0, 1.0), **options)


WRONG = [
    (lambda: start(field="uniform"), TypeError, "ParticleField"),
    (lambda: start(form="canonicl"), ValueError, "canonical"),
    (lambda: start(position=(1.0, 0.0)), ValueError, "position must be three finite numbers"),
    (lambda: start(velocity=(1.0, 0.0, np.nan)), ValueError, "velocity must be three finite numbers"),
    (lambda: start(mass=0.0), ValueError, "mass must be positive"),
    (lambda: start(charge=0.0), ValueError, "charge not 0"),
    (lambda: start(position=(0.0, 0.0, 0.0)), (ValueError, ZeroDivisionError), "."),
    (lambda: start(ParticleField(magnetic=constant_b)), ValueError, "vector_potential"),
    (lambda: ParticleField(), ValueError, "vector_potential, or magnetic"),
    (lambda: ParticleField(magnetic=constant_b, jacobian=mirror_jacobian), ValueError, "without vector_potential"),
    (lambda: ParticleField(vector_potential=3.0), TypeError, "function of"),
    (lambda: ParticleField(constant_a, length=0.0), ValueError, "length must be positive"),
    (lambda: start(ParticleField(constant_a, magnetic=mirror_b)), ValueError, "the curl of"),
    (lambda: start(ParticleField(constant_a, mirror_jacobian)), ValueError, "the derivatives of"),
    (lambda: start(ParticleField(constant_a, potential=well, electric=constant_e)), ValueError, "minus the gradient"),
    (lambda: start(ParticleField(lambda x, y, z: (x, y))), ValueError, "shape"),
    (lambda: start(ParticleField(lambda x, y, z: (x, y, math.inf))), ValueError, "finite"),
    (lambda: tokamak("bananna"), ValueError, "banana"),
    (lambda: integrate(tokamak(), (0, 9), np.ones(5), method=EIPRK4), ValueError, "y0 has 5 components"),
    (lambda: ring(electric=None), ValueError, "a field that varies needs electric"),
    (lambda: moving(ring(), form="canonical"), ValueError, "a field that varies needs form='velocity'"),
    (lambda: moving(UNIFORM, "energy", form="canonical"), ValueError, "balances need form='velocity'"),
    (lambda: moving(ring(), "energie"), ValueError, "balances must be 'energy', 'kinetic' or None"),
    (lambda: moving(ring(magnetic=lambda t, x, y, z: (0.0, 0.0, 2.0))), ValueError, "the curl of"),
]


def test_bad_input():
    for call, error, words in WRONG:
        with pytest.raises(error, match=words):
            call()
