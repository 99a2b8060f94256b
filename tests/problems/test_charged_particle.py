"""Charged particles: fields against the paper's formulas in 30 digits, invariants, user-defined fields."""

import math
from dataclasses import replace

import mpmath as mp
import numpy as np
import pytest
from numba import config, njit
from scipy.integrate import solve_ivp

from eip_scipy import EIPDOP853, EIPRK4, EIPRK45, Invariant, check_gradient, integrate
from eip_scipy.problems import TOKAMAK, UNIFORM, ParticleField, charged_particle, tokamak, uniform_field

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
        printed = (0, 0, 1) if field is UNIFORM else paper_tokamak_magnetic(*exact)
    np.testing.assert_allclose(functions.A(0.0, *point), np.array(A, dtype=float), rtol=1e-14, atol=1e-16)
    np.testing.assert_allclose(functions.phi(0.0, *point), float(phi), rtol=1e-15)
    np.testing.assert_allclose(np.array(functions.jacobian(0.0, *point)), jacobian, rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(functions.E(0.0, *point), -slope, rtol=1e-13, atol=1e-17)
    curl = [jacobian[2, 1] - jacobian[1, 2], jacobian[0, 2] - jacobian[2, 0], jacobian[1, 0] - jacobian[0, 1]]
    np.testing.assert_allclose(functions.B(0.0, *point), curl, rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(functions.B(0.0, *point), np.array(printed, dtype=float), rtol=1e-14, atol=1e-16)


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


# --- user-defined fields ---


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


@pytest.mark.parametrize(
    "name",
    [k if k == "B alone" else pytest.param(k, marks=[pytest.mark.nightly, pytest.mark.slow]) for k in MIRRORS],
)
def test_own_field(name):
    field, form, kept = MIRRORS[name]
    problem, run = mirror_run(field, form)
    assert run.compiled == (not config.DISABLE_JIT)
    assert "".join(item.name for item in problem.invariants) == kept
    assert run.success
    assert run.max_defect.max(initial=0.0) < 1e-11
    reference, truth = mirror_run(*MIRRORS["A, jacobian"][:2])
    np.testing.assert_allclose(run.y[:3, -1], truth.y[:3, -1], rtol=0, atol=2e-9)
    np.testing.assert_allclose(problem.velocity(run.y[:, -1:]), reference.velocity(truth.y[:, -1:]), rtol=0, atol=2e-9)


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
        (lambda: ParticleField(magnetic=constant_b, jacobian=mirror_jacobian), ValueError, "without vector_potential"),
        (lambda: ParticleField(vector_potential=3.0), TypeError, "function of"),
        (lambda: ParticleField(constant_a, length=0.0), ValueError, "length must be positive"),
        (lambda: start(field=ParticleField(constant_a, magnetic=mirror_b)), ValueError, "the curl of"),
        (lambda: start(field=ParticleField(constant_a, mirror_jacobian)), ValueError, "the derivatives of"),
        (
            lambda: start(ParticleField(constant_a, potential=well, electric=constant_e)),
            ValueError,
            "minus the gradient",
        ),
        (lambda: start(field=ParticleField(lambda x, y, z: (x, y))), ValueError, "shape"),
        (lambda: start(field=ParticleField(lambda x, y, z: (x, y, math.inf))), ValueError, "finite"),
        (lambda: tokamak("bananna"), ValueError, "banana"),
        (lambda: ring(electric=None), ValueError, "a field that varies needs electric"),
        (lambda: moving(ring(), form="canonical"), ValueError, "a field that varies needs form='velocity'"),
        (lambda: moving(UNIFORM, "energy", form="canonical"), ValueError, "balances need form='velocity'"),
        (lambda: moving(ring(), "energie"), ValueError, "balances must be 'energy', 'kinetic' or None"),
        (lambda: moving(ring(magnetic=lambda t, x, y, z: (0.0, 0.0, 2.0))), ValueError, "the curl of"),
    ],
)
def test_bad_input(call, error, words):
    with pytest.raises(error, match=words):
        call()


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
