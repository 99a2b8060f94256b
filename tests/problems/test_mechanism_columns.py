"""Tangent maps of mechanisms: against closed forms, differences of the flow, and the same pendulum as an equation."""

import numpy as np
import pytest
import sympy
from numba import njit
from scipy.special import ellipe, ellipk
from sympy.physics import mechanics as me

from eip_scipy import EIPDOP853, integrate
from eip_scipy.problems import mechanics, mechanism

G = 9.81
OPTIONS = {"method": EIPDOP853, "h": 0.02}
TIGHT = {"method": EIPDOP853, "rtol": 1e-12, "atol": 1e-12}
LATER = pytest.mark.nightly  # each jitted system takes many seconds to compile


def plain(function):
    return function


def forces_on_two(t, q, u):
    sine = np.sin(q[0] - q[1])
    return np.array([-(u[1] ** 2) * sine - 2 * G * np.sin(q[0]), u[0] ** 2 * sine - G * np.sin(q[1])])


def driven(t, q, u):
    last = -(q[2] ** 3) + np.sin(t) * q[0]
    return np.array([-q[0] - 0.1 * q[1] ** 2, -q[1] - 0.2 * q[0] * q[1] - 0.1 * u[1], last])


def twice(t, q):
    return np.array([(q[0] ** 2 + q[1] ** 2 - 1) / 2, np.sqrt(q[0] ** 2 + q[1] ** 2) - 1])


MOVING = {"constraints": lambda t, q: np.array([((q[0] - np.sin(t)) ** 2 + q[1] ** 2 - 1) / 2]), "u0": [1, 0]}
SPHERE = {"constraints": lambda t, q: np.array([(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 - 1) / 2]), "u0": [0, 0.5, 0.3]}
SKATE = {"velocity_constraints": lambda t, q, u: np.array([u[0] * np.sin(q[2]) - u[1] * np.cos(q[2])])}
SKATE |= {"q0": [0, 0, 0.3], "u0": [np.cos(0.3), np.sin(0.3), 0.7]}
PENDULUM = {"mass": [1.0], "forces": lambda t, q, u: np.array([-G * np.sin(q[0])]), "q0": [1.0], "u0": [0]}
PENDULUM |= {"potential_energy": lambda t, q: -G * np.cos(q[0])}
MASS = lambda q: np.array([[2.0, np.cos(q[0] - q[1])], [np.cos(q[0] - q[1]), 1.0]])  # noqa: E731
FALLING = {"mass": [1, 1], "forces": [0, -G], "q0": [1, 0], "u0": [0, 0.5]}
SYSTEMS = {
    "1, free": PENDULUM,
    "1, other speed": PENDULUM | {"kinematics": lambda t, q, u: u * (1 + q[0] ** 2)},
    "2, free": {"mass": MASS, "forces": forces_on_two, "q0": [1, 0.5], "u0": [0, 0.2]},
    "2, circle": FALLING | {"constraints": lambda t, q: np.array([(q[0] ** 2 + q[1] ** 2 - 1) / 2])},
    "2, circle twice": FALLING | {"constraints": twice},
    "2, moving circle": FALLING | MOVING,
    "3, free": {"mass": [1, 2, 3], "forces": driven, "q0": [1, 0.5, 0.3], "u0": [0, 0.1, 0]},
    "3, sphere": {"mass": [1, 1, 1], "forces": [0, 0, -G], "q0": [1, 0, 0]} | SPHERE,
    "3, skate": {"mass": [1, 1, 0.5], "forces": [0, G * 0.1, 0]} | SKATE,
}


def system(name, jit=njit):
    given = {key: jit(item) if callable(item) else item for key, item in SYSTEMS[name].items()}
    return mechanism(**given, t_span=(0.0, 1.0))


def along_constraints(problem):
    """Return orthonormal directions (n, k) that keep the constraints at the start."""
    y, n = problem.y0, problem.y0.size
    if not problem.constraints:
        return np.eye(n)
    (item,) = problem.constraints
    gradient = np.zeros((item.size, n))
    item.gradient(0.0, y, gradient, *item.args)
    _, sizes, rows = np.linalg.svd(gradient)
    return rows[np.sum(sizes > 1e-9) :].T


def flow_differences(problem, directions, step=1e-4):
    """Return the derivatives (n, k) of the state at the end along `directions`, by differences of order 4."""

    def last(shift):
        # A moved start misses the constraints by the square of the step.
        return integrate(problem, y0=problem.y0 + shift, project_initial=True, **OPTIONS).y[:, -1]

    found = []
    for d in step * directions.T:
        found.append((8 * (last(d) - last(-d)) - (last(2 * d) - last(-2 * d))) / (12 * step))
    return np.array(found).T


@pytest.mark.needs_jit
@pytest.mark.nightly
@pytest.mark.parametrize("name", SYSTEMS)
def test_columns_are_differences_of_the_flow(name):
    """The flow is that of functions that are not jitted, whose compilation would take as long again."""
    problem = system(name, plain)
    run, bare = integrate(system(name), variations="state", **OPTIONS), integrate(problem, **OPTIONS)
    assert run.trusted
    np.testing.assert_allclose(run.y, bare.y, rtol=0, atol=1e-13)
    directions = along_constraints(problem)
    expected = flow_differences(problem, directions)
    np.testing.assert_allclose(run.stm[-1] @ directions, expected, rtol=0, atol=1e-8 * np.abs(expected).max())


def period_and_slope(angle, omega):
    """Return the period of a pendulum that is released at `angle`, and its derivative by the angle."""
    m, K = np.sin(angle / 2) ** 2, ellipk(np.sin(angle / 2) ** 2)
    slope = (ellipe(m) - (1 - m) * K) / (2 * m * (1 - m)) * np.sin(angle) / 2
    return 4 * K / omega, 4 * slope / omega


@pytest.mark.parametrize("jit", [plain, pytest.param(njit, marks=[LATER, pytest.mark.needs_jit])])
def test_matrix_of_a_pendulum_after_its_period(jit):
    period, slope = period_and_slope(1.0, np.sqrt(G))
    run = integrate(system("1, free", jit), t_span=(0, period), variations="state", **TIGHT)
    assert (run.columns["source"] == "complex steps") is (jit is plain)
    assert run.trusted
    np.testing.assert_allclose(run.y[:, -1], [1, 0], atol=1e-10)
    # A change of the angle changes the phase after the period by that of the period. The other column is the flow.
    np.testing.assert_allclose(run.stm[-1], [[1, 0], [slope * G * np.sin(1.0), 1]], atol=1e-9)


@pytest.mark.slow
def test_derivatives_by_parameters_of_a_model():
    x, v = me.dynamicsymbols("x v")
    m, k = sympy.symbols("m k")
    N, P = me.ReferenceFrame("N"), me.Point("P")
    P.set_vel(N, v * N.x)
    model = me.KanesMethod(N, [x], [v], kd_eqs=[x.diff() - v])
    model.kanes_equations([me.Particle("A", P, m)], [(P, -k * sympy.sin(x) * N.x)])
    problem = mechanics(model, {m: 2, k: 3}, {x: 1}, {v: 0})
    period = period_and_slope(1.0, np.sqrt(1.5))[0]
    run = integrate(problem, t_span=(0, period), variations=["state", "k", "m"], **TIGHT)
    assert run.trusted
    # The period is proportional to (m / k)^(1/2).
    pull = 1.5 * np.sin(1.0)
    expected = [[0, 0], [-period / 6 * pull, period / 4 * pull]]
    np.testing.assert_allclose(run.sensitivities[-1], expected, atol=1e-9)
