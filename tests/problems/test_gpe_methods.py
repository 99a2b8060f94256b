"""Splittings and the exact flows of the Gross-Pitaevskii equation, by themselves and projected."""

import numpy as np
import pytest
from orders import observed_order
from scipy.linalg import expm

from eip_scipy import EIPDOP853, eip_method, integrate
from eip_scipy.problems import Grid, GrossPitaevskii, Splitting, harmonic_trap, soliton
from eip_scipy.problems.gross_pitaevskii import RKN6, S6, STRANG, LinearFlow, Scheme, at_rest, rotated
from eip_scipy.problems.gross_pitaevskii.pointwise import local_flow

SCHEMES = [STRANG, S6, RKN6]
KEPT = ("mass", "energy")
MASS, ENERGY = 1e-13, 4e-13  # absolute; both are of order 1


def name(scheme):
    return scheme.name


def noise(grid):
    return np.random.default_rng(3).standard_normal(2 * grid.size).view(complex).reshape(grid.shape)


def flow(gpe, psi, *args):
    return LinearFlow(gpe, *args).apply(psi.astype(complex), np.empty(gpe.grid.shape, complex))[0]


# Coefficients.


@pytest.mark.parametrize("scheme", SCHEMES, ids=name)
def test_scheme_is_symmetric_and_of_its_order(scheme):
    """On exp(h (A + B)) for matrices without any relation between them the local error falls like h^(p + 1)."""
    assert scheme.local == scheme.local[::-1]
    assert scheme.linear == scheme.linear[::-1]
    A, B = np.random.default_rng(0).standard_normal((2, 5, 5))

    def error(h):
        product = np.eye(5)
        for local, linear in zip(scheme.local, (*scheme.linear, 0.0), strict=True):
            product = product @ expm(local * h * B) @ expm(linear * h * A)
        return np.linalg.norm(product - expm(h * (A + B)))

    steps = np.array([1 / 8, 1 / 16])
    assert observed_order([error(h) for h in steps], steps)[0] == pytest.approx(scheme.order + 1, abs=0.1)


# Flows.


def packet(x, y, t):
    """Return a Gaussian away from the centre in free motion."""
    spread = 1 + 1j * t
    return np.exp(-((x - 2) ** 2 + (y - 1) ** 2) / (2 * spread)) / spread


def turned(x, y, angle):
    return np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y


@pytest.mark.parametrize("time", [0.7, -0.7])
@pytest.mark.parametrize("Omega", [0.0, 0.8])
def test_linear_flow_is_free_motion_seen_from_a_rotating_frame(Omega, time):
    grid = Grid((96, 112), (-11, -12), (11, 13))
    gpe = GrossPitaevskii(grid, Omega=Omega)
    exact = packet(*turned(*grid.mesh(), Omega * time), time)
    np.testing.assert_allclose(flow(gpe, packet(*grid.mesh(), 0.0), time), exact, rtol=0, atol=1e-11)


def test_linear_flow_in_three_dimensions():
    """The motion along z is free, and does not affect the other axes."""
    grid = Grid((48, 48, 24), (-9, -9, -8), (9, 9, 8))
    gpe = GrossPitaevskii(grid, Omega=0.5)
    x, y, z = grid.mesh()

    def along_z(t):
        return np.exp(-(z**2) / (2 * (1 + 1j * t))) / np.sqrt(1 + 1j * t)

    exact = packet(*turned(x, y, 0.3), 0.6) * along_z(0.6)
    np.testing.assert_allclose(flow(gpe, packet(x, y, 0.0) * along_z(0.0), 0.6), exact, atol=2e-6)


def test_linear_flow_is_unitary_and_reversible_for_any_field():
    for shape in ((9,), (8, 12), (6, 9, 5)):
        grid = Grid(shape, -1, 2)
        gpe = GrossPitaevskii(grid, Omega=0.0 if len(shape) == 1 else 0.9)
        psi = noise(grid)
        there = flow(gpe, psi, 0.3)
        assert np.linalg.norm(there) == pytest.approx(np.linalg.norm(psi), rel=1e-14)
        np.testing.assert_allclose(flow(gpe, there, -0.3), psi, atol=1e-13)


@pytest.mark.parametrize("angle", [0.3, 2.0, -3.0, 10.0])
def test_rotation(angle):
    grid = Grid((96, 96), -10, 10)
    gpe = GrossPitaevskii(grid)
    x, y = grid.mesh()
    np.testing.assert_allclose(
        rotated(gpe, packet(x, y, 0), angle), packet(*turned(x, y, angle), 0), rtol=0, atol=1e-10
    )


def test_local_flow_is_a_phase():
    """The angles have either sign and reach 1e5, where their own rounding is 1e-11."""
    psi = noise(Grid(4000, 0, 1))
    V = np.linspace(-50, 50, psi.size)
    for h, tolerance in ((0.1, 2e-14), (-0.1, 2e-14), (2e3, 3e-11)):
        out = psi.copy()
        local_flow(out.view(float), V, 0.7, h)
        np.testing.assert_allclose(out, psi * np.exp(-1j * h * (V + 0.7 * abs(psi) ** 2)), atol=4 * tolerance)
        assert np.linalg.norm(out) == pytest.approx(np.linalg.norm(psi), rel=1e-15)


# Steps.


@pytest.mark.parametrize("scheme", SCHEMES, ids=name)
def test_a_step_is_unitary_and_a_step_back_undoes_it(scheme):
    grid = Grid((16, 20), -3, 3)
    gpe = GrossPitaevskii(grid, harmonic_trap(1, 1), Omega=0.6, beta=3.0)
    method = Splitting(gpe, scheme)
    start = noise(grid).ravel()
    there = method.one_step(0.0, start.copy(), 0.05).copy()
    assert np.linalg.norm(there) == pytest.approx(np.linalg.norm(start), rel=1e-14)
    assert np.linalg.norm(there - start) > 1
    np.testing.assert_allclose(method.one_step(0.05, there, -0.05), start, atol=1e-12)


METHODS = {
    "strang": (lambda gpe: Splitting(gpe, "strang"), (0.1, 0.05)),
    "s6": (lambda gpe: Splitting(gpe, "s6"), (0.1, 0.05)),
    "rkn6": (lambda gpe: Splitting(gpe), (0.4, 0.2)),
}


def assert_order(found, method):
    """The order is that of the method; for "rkn6", whose errors of order 5 are tiny here, at least that."""
    assert found > method.order - 0.25
    assert found < method.order + 0.25 or method.name == "splitting-rkn6"


def test_a_splitting_of_the_equation_before_a_quench_is_reported():
    scene = soliton(length=60.0, t_end=0.04, h=0.02)
    after = scene.equation.changed(beta=1.1 * scene.equation.beta).problem(scene.y0, 0.04, 0.02)
    with pytest.warns(UserWarning, match="the steps of splitting-rkn6 do not solve the equation of fun"):
        assert not integrate(after, method=eip_method(Splitting(scene.equation))).trusted


@pytest.mark.parametrize("kept", [(), KEPT], ids=["raw", "EIP"])
@pytest.mark.parametrize("method", METHODS)
def test_soliton(method, kept):
    """The error has the order of the method, projected or not; mass and energy are kept to round-off if projected."""
    scene = soliton(length=60.0, t_end=2.0)
    make, steps = METHODS[method]
    made = make(scene.equation)
    errors = []
    for h in steps:
        run = integrate(scene, method=eip_method(made), h=h, invariants=scene.equation.invariants(kept))
        errors.append(np.abs(run.y[:, -1] - scene.reference(2.0)).max())
        if kept and made.order == 4:
            assert run.max_defect[0] < MASS
            assert run.max_defect[1] < ENERGY
    assert_order(observed_order(errors, steps)[0], made)
    assert errors[-1] < 1e-3


@pytest.fixture(scope="module")
def condensate():
    """Return two vortices off the centre of a rotating trap, well resolved, and the field at t = 0.5."""
    grid = Grid((96, 96), -8, 8)
    gpe = GrossPitaevskii(grid, harmonic_trap(1, 1), Omega=0.6, beta=20.0)
    x, y = grid.mesh()
    psi = (x - 0.7 + 1j * y) * (x + 1j * (y - 0.5)) * np.exp(-(x**2 + y**2) / 2)
    problem = gpe.problem(psi / np.sqrt(gpe.mass(psi)), 0.5)
    exact = integrate(problem, method=EIPDOP853, h=0.005, invariants=()).y[:, -1]
    return problem, exact


STEPS = {"strang": (0.025, 0.0125), "s6": (0.025, 0.0125), "rkn6": (0.05, 0.025)}


@pytest.mark.parametrize("kept", [(), KEPT], ids=["raw", "EIP"])
@pytest.mark.parametrize("method", METHODS)
def test_rotating_condensate(condensate, method, kept):
    problem, exact = condensate
    gpe = problem.equation
    made = METHODS[method][0](gpe)
    errors = []
    for h in STEPS[method]:
        run = integrate(problem, method=eip_method(made), h=h, invariants=gpe.invariants(kept))
        errors.append(np.sqrt(gpe.mass(run.y[:, -1] - exact)))
        if kept and made.order == 4:
            assert run.max_defect[0] < MASS
            assert run.max_defect[1] < ENERGY * abs(gpe.energy(problem.y0))
    assert_order(observed_order(errors, STEPS[method])[0], made)
    assert errors[-1] < 2e-3


@pytest.mark.parametrize("kept", [(), KEPT], ids=["raw", "EIP"])
def test_the_frame_at_rest(condensate, kept):
    """The rotated field and its energy are those of the rotating frame, as far as the grid resolves it."""
    problem, exact = condensate
    gpe, rest = problem.equation, at_rest(problem)
    assert rest.equation.Omega == 0
    run = integrate(
        rest, method=eip_method(Splitting(rest.equation)), h=0.025, invariants=rest.equation.invariants(kept)
    )
    if kept:
        assert (run.max_defect < [MASS, 10 * ENERGY]).all()
    seen = rotated(gpe, run.y[:, -1], gpe.Omega * 0.5)
    np.testing.assert_allclose(seen.ravel(), exact, rtol=0, atol=2e-8)
    assert gpe.energy(seen) == pytest.approx(gpe.energy(problem.y0), abs=1e-7)


# Refused arguments.


def test_wrong_options():
    grid = Grid((16, 16), -2, 2)
    gpe = GrossPitaevskii(grid, harmonic_trap(1, 1), Omega=0.5)
    with pytest.raises(ValueError, match=r"unknown scheme 'strangg', expected 'strang', .*Did you mean|strang"):
        Splitting(gpe, "strangg")
    with pytest.raises(ValueError, match="at the same distance from the z axis"):
        at_rest(gpe.changed(potential=lambda x, y: x**4 + y**4).problem(np.ones((16, 16)), 1.0))
    with pytest.raises(ValueError, match="the problem has one dimension, without a z axis"):
        at_rest(soliton())
    with pytest.raises(TypeError, match="expected a problem made by"):
        at_rest(gpe)
    with pytest.raises(ValueError, match=r"must be at most pi / 4, got 1;"):
        Splitting(gpe, "strang").one_step(0.0, noise(grid).ravel(), 2.0)
    with pytest.raises(ValueError, match="a rotation needs two or three"):
        rotated(GrossPitaevskii(Grid(8, -1, 1)), np.ones(8), 0.1)
    own = Scheme("euler", 1, (1.0, 0.0), (1.0,), "Lie & Trotter")
    assert Splitting(gpe, own).order == 1
