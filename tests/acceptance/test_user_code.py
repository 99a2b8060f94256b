"""Programs of users: the typed one of tests/typing, which mypy checks; one of SciPy's documentation; the planets."""

import ast
import importlib.util
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import eip_scipy
from eip_scipy import EIPRK4, EIPRK45, Invariant, integrate
from eip_scipy.problems import nbody, solar_data, solar_system

PROGRAM = Path(__file__).parents[1] / "typing" / "user_code.py"


@pytest.fixture(scope="module")
def program():
    spec = importlib.util.spec_from_file_location("user_code", PROGRAM)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_it_uses_all_public_names():
    used = {node.id for node in ast.walk(ast.parse(PROGRAM.read_text())) if isinstance(node, ast.Name)}
    assert set(eip_scipy.__all__) <= used


def test_it_runs(program, tmp_path):
    assert 0 < program.slow() < 1e-3
    residual, states, message, trusted = program.one_run()
    assert residual < 1e-14
    assert states.shape == (2, 11)
    assert (message, trusted) == ("The solver successfully reached the end of the integration interval.", True)
    assert program.long_run(tmp_path / "run.npz") > 4 * 334
    np.testing.assert_allclose(program.members()[:, 0], [0.600086, 0.277699], atol=1e-4)
    assert program.others() == []  # no polynomial


def test_lotka_volterra():
    """With args and dense output, and only the method's name changed."""
    a, b, c, d = 1.5, 1, 3, 1

    def lotkavolterra(t, z, a, b, c, d):
        x, y = z
        return [a * x - b * x * y, -c * y + d * x * y]

    def value(t, z):
        return d * z[0] - c * np.log(z[0]) + b * z[1] - a * np.log(z[1])

    def run(method, **options):
        sol = solve_ivp(lotkavolterra, [0, 15], [10, 5], args=(a, b, c, d), dense_output=True, method=method, **options)
        z = sol.sol(np.linspace(0, 15, 300))
        assert sol.success
        return np.ptp([value(0, column) for column in z.T]), sol.y[:, -1]

    (plain, plain_end), (same, _) = run("RK45"), run(EIPRK45)
    kept, end = run(EIPRK45, invariants=Invariant(value, lambda t, z: np.array([d - c / z[0], b - a / z[1]])))
    _, exact = run("DOP853", rtol=1e-12, atol=1e-12)
    assert same == plain > 0.1
    assert kept < 5e-3
    assert np.linalg.norm(end - exact) < 0.05 * np.linalg.norm(plain_end - exact)


@pytest.mark.needs_jit
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 5))])
def test_mercury_gains_a_hundredfold_in_any_orientation(seed):
    data = solar_data.load("de440")
    turn = Rotation.random(rng=seed).as_matrix()
    problem = nbody(
        data.gm * 365.25**2, data.position @ turn.T, data.velocity @ turn.T * 365.25, t_span=(0.0, 100.0), h=0.002
    )
    reference = (solar_system().reference(100.0).reshape(20, 3) @ turn.T).ravel()
    ends = [integrate(problem, method=EIPRK4, **kept).y[:, -1] for kept in ({}, {"invariants": ()})]
    eip, plain = (np.linalg.norm((y - reference)[:30].reshape(10, 3), axis=1)[1:] for y in ends)
    assert plain[0] > 100 * eip[0]
    # No other planet pays for it: 1e-7 rad is 3e-6 AU at most.
    assert np.all(eip[1:] < np.maximum(2 * plain[1:], 1e-8))
