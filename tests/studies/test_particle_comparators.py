"""Boris pusher and implicit midpoint: closed forms, order, what each keeps, and the contract of their driver."""

import math

import numpy as np
import pytest
from numba import TypingError, njit

from eip_scipy.problems import UNIFORM, tokamak, uniform_field
from eip_scipy_studies.comparators import boris, implicit_midpoint

Y0 = np.array([0.5, 1.0, 0.2, 0.3, -0.1, 0.25])


@njit
def gyration(t, x, out):
    """B = 2 e_z."""
    for i in range(5):
        out[i] = 0.0
    out[5] = 2.0


@njit
def crossed(t, x, out, params):
    """B = e_z, E = params[0] e_y."""
    for i in range(6):
        out[i] = 0.0
    out[1] = params[0]
    out[5] = 1.0


@njit
def oscillator(t, y, out):
    out[0] = y[1]
    out[1] = -y[0]


@njit
def driven(t, y, out, params):
    out[0] = params[0] * math.cos(params[0] * t)


def exact_gyration(t, omega):
    c, s = math.cos(omega * t), math.sin(omega * t)
    v = np.array([c * Y0[3] + s * Y0[4], -s * Y0[3] + c * Y0[4], Y0[5]])
    x = Y0[:3] + np.array([(s * Y0[3] + (1 - c) * Y0[4]) / omega, ((c - 1) * Y0[3] + s * Y0[4]) / omega, Y0[5] * t])
    return np.concatenate([x, v])


@pytest.mark.parametrize(("mass", "charge"), [(1.0, 1.0), (2.0, -3.0)])
def test_boris_has_order_two_on_a_gyration(mass, charge):
    omega = 2.0 * charge / mass
    errors = [
        np.linalg.norm(
            boris(gyration, (0.0, 5.0), Y0, 5.0 / n, mass=mass, charge=charge).y[:, -1] - exact_gyration(5.0, omega)
        )
        for n in (1000, 2000)
    ]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.02)


def test_boris_rotates_by_its_own_angle_and_keeps_the_speed():
    """One step turns v by 2 atan(q B h / (2 m)), exactly."""
    h = 0.3
    run = boris(gyration, (0.0, 300 * h), Y0, h, save_every=1)
    angle = np.unwrap(np.arctan2(run.y[4], run.y[3]))
    np.testing.assert_allclose(np.diff(angle), -2 * math.atan(0.5 * 2.0 * h), rtol=1e-12)
    np.testing.assert_allclose((run.y[3:] ** 2).sum(axis=0), (Y0[3:] ** 2).sum(), rtol=1e-13)


def test_boris_drifts_across_the_electric_field():
    """E x B / B^2 = (0.2, 0, 0): a particle that starts with it moves straight, at any step."""
    run = boris(crossed, (0.0, 50.0), [0, 0, 0, 0.2, 0, 0.1], 0.7, params=[0.2])
    np.testing.assert_allclose(run.y[:, -1], [10.0, 0, 5.0, 0.2, 0, 0.1], atol=1e-13)
    assert run.nfev == math.ceil(50 / 0.7)


def flow_jacobian(step, y, size=1e-5):
    """Return derivatives of one step's result by its start, by central differences."""
    columns = [(step(y + d) - step(y - d)) / (2 * size) for d in size * np.eye(y.size)]
    return np.array(columns).T


def test_boris_keeps_volume():
    field = tokamak().field
    y = np.array([1.05, 0.1, 0.05, 0.2, 0.3, -0.4])
    jacobian = flow_jacobian(lambda y: boris(field.fill, (0.0, 0.5), y, 0.5).y[:, -1], y)
    assert np.linalg.det(jacobian) == pytest.approx(1.0, abs=1e-8)
    symplectic = np.kron([[0, 1], [-1, 0]], np.eye(3))
    assert np.abs(jacobian.T @ symplectic @ jacobian - symplectic).max() > 1e-2  # not in (x, v)


def test_boris_is_reversible():
    there = boris(UNIFORM.fill, (0.0, 20.0), Y0, 0.1)
    back = boris(UNIFORM.fill, (20.0, 0.0), there.y[:, -1], 0.1)
    assert np.linalg.norm(there.y[:, -1] - Y0) > 0.1
    np.testing.assert_allclose(back.y[:, -1], Y0, rtol=0, atol=1e-12)


# --- implicit midpoint ---


def test_midpoint_has_order_two():
    exact = np.array([math.cos(10.0), -math.sin(10.0)])
    errors = [
        np.linalg.norm(implicit_midpoint(oscillator, (0, 10), [1.0, 0.0], 10 / n).y[:, -1] - exact) for n in (100, 200)
    ]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.02)


def test_midpoint_is_the_papers_rational_function():
    """On the oscillator a step turns by 2 atan(h / 2), exactly."""
    run = implicit_midpoint(oscillator, (0.0, 100.0), [1.0, 0.0], 0.5, save_every=1)
    angle = np.unwrap(np.arctan2(-run.y[1], run.y[0]))
    np.testing.assert_allclose(angle, 2 * math.atan(0.25) * np.arange(201), atol=1e-12)


def test_midpoint_takes_time_and_parameters():
    run = implicit_midpoint(driven, (0.0, 3.0), [0.0], 0.001, params=[2.0])
    assert run.y[0, -1] == pytest.approx(math.sin(6.0), abs=1e-6)


@pytest.mark.slow
def test_midpoint_keeps_the_quadratic_invariant_and_not_the_energy():
    problem = uniform_field(t_end=500 * math.pi / 10)
    run = implicit_midpoint(problem.rhs, problem.t_span, problem.y0, problem.h, params=problem.params, save_every=1)
    H, L = (np.array([item.fun(0.0, y, problem.params) for y in run.y.T.copy()]) for item in problem.invariants)
    assert np.abs(L / L[0] - 1).max() < 1e-13
    assert 1e-7 < np.abs(H / H[0] - 1).max() < 1e-4


def test_midpoint_is_symplectic():
    problem = tokamak()
    y = np.array([1.05, 0.1, 0.05, 0.2, 0.3, -0.4])
    jacobian = flow_jacobian(
        lambda y: implicit_midpoint(problem.rhs, (0.0, 0.3), y, 0.3, params=problem.params).y[:, -1], y
    )
    symplectic = np.kron([[0, 1], [-1, 0]], np.eye(3))
    assert np.abs(jacobian - np.eye(6)).max() > 0.1
    np.testing.assert_allclose(jacobian.T @ symplectic @ jacobian, symplectic, atol=1e-8)


def test_midpoint_says_where_it_does_not_converge():
    @njit
    def stiff(t, y, out):
        out[0] = -(1.0 if t < 1.0 else 100.0) * y[0]

    run = implicit_midpoint(stiff, (0.0, 2.0), [1.0], 0.1, save_every=1)
    assert np.isfinite(run.y[0, :11]).all()
    assert np.isnan(run.y[0, 11:]).all()
    assert "from t=1.1 on are not finite" in run.message.replace("1.1000000000000001", "1.1")


# --- both ---


@pytest.mark.needs_jit
def test_compiled_and_interpreted_give_the_same_bits():
    for method, fun, y0, params in (
        (boris, crossed, Y0, [0.2]),
        (boris, gyration, Y0, None),
        (implicit_midpoint, oscillator, [1.0, 0.5], None),
        (implicit_midpoint, driven, [0.0], [2.0]),
    ):
        options = {"params": params, "save_every": 3}
        compiled = method(fun, (0.3, 5.0), y0, 0.07, **options)
        interpreted = method(lambda *args, fun=fun: fun(*args), (0.3, 5.0), y0, 0.07, **options)
        assert compiled.message == "compiled"
        assert interpreted.message.startswith("interpreted: ")
        assert interpreted.message.endswith("is not a Numba function; decorate it with @numba.njit")
        np.testing.assert_array_equal(compiled.t, interpreted.t)
        np.testing.assert_array_equal(compiled.y, interpreted.y)
        assert compiled.nfev == interpreted.nfev


@pytest.mark.needs_jit
def test_functions_that_cannot_be_compiled_say_why():
    @njit
    def unknown(t, y, out):
        out[:] = undefined  # noqa: F821

    @njit
    def too_many(t, y, out, a, b):
        out[:] = 0.0

    with pytest.raises(TypingError, match="undefined"):  # as it is called from Python
        implicit_midpoint(unknown, (0, 1), [1.0], 0.5)
    with pytest.raises(TypeError):
        implicit_midpoint(too_many, (0, 1), [1.0], 0.5)


def test_last_step_ends_on_the_end():
    run = boris(gyration, (0.0, 1.0), Y0, 0.3, save_every=2)
    np.testing.assert_allclose(run.t, [0.0, 0.6, 1.0])
    assert run.nfev == 4


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: boris(gyration, (0, 1), Y0[:4], 0.1), ValueError, "6 components, got 4"),
        (lambda: boris(gyration, (0, 1), Y0, 0.1, mass=0.0), ValueError, "mass must be positive"),
        (lambda: boris(gyration, (0, 1), Y0, -0.1), ValueError, "positive"),
        (lambda: boris(gyration, (0, np.inf), Y0, 0.1), ValueError, "finite"),
        (lambda: boris(gyration, (0, 1), 1j * Y0, 0.1), TypeError, "complex"),
        (lambda: boris(None, (0, 1), Y0, 0.1), TypeError, "fields must be callable"),
        (lambda: boris(gyration, (0, 1), Y0, 0.1, save_every=0), ValueError, "save_every"),
        (lambda: implicit_midpoint(oscillator, (0, 1), [np.nan, 0.0], 0.1), ValueError, "finite"),
        (lambda: implicit_midpoint(oscillator, (0, 1), [[1.0]], 0.1), ValueError, "1-dimensional"),
        (lambda: implicit_midpoint(driven, (0, 1), [1.0], 0.1, params=[1j]), TypeError, "params must be real"),
        (lambda: implicit_midpoint(7, (0, 1), [1.0], 0.1), TypeError, "rhs must be callable"),
    ],
)
def test_bad_input(call, error, words):
    with pytest.raises(error, match=words):
        call()
