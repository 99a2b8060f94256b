"""The engine's solver for accelerations and multipliers, against the whole matrix."""

import numpy as np

from eip_scipy.engine.native import BUILD
from eip_scipy.problems.multibody import motion


def solved(M, F, rows, gamma):
    accelerations, multipliers = np.empty(len(F)), np.empty(len(rows))
    matrices = np.concatenate([M.ravel(), F, rows.ravel(), gamma])
    pointers = accelerations.ctypes.data, multipliers.ctypes.data
    rank = motion.SOLVE(matrices.ctypes.data, len(F), len(rows), 1e-9, *pointers)
    return rank, accelerations, multipliers


def test_the_solution_is_that_of_the_whole_matrix():
    for n, m, rank in [(3, 2, 2), (6, 4, 3), (5, 5, 5), (4, 0, 0), (6, 8, 4), (7, 7, 0), (9, 3, 1)]:
        rng = np.random.default_rng(10 * n + m)
        A = rng.normal(size=(n, n))
        M, F = A @ A.T + np.eye(n), rng.normal(size=n)
        rows = rng.normal(size=(m, rank)) @ rng.normal(size=(rank, n))
        gamma = -rows @ rng.normal(size=n)
        found, accelerations, multipliers = solved(M, F, rows, gamma)
        sizes = np.linalg.norm(rows, axis=1)
        sizes[sizes == 0] = 1
        unit = rows / sizes[:, None]
        whole = np.block([[M, unit.T], [unit, np.zeros((m, m))]])
        expected = np.linalg.lstsq(whole, np.append(F, -gamma / sizes), rcond=1e-10)[0]
        assert found == rank
        np.testing.assert_allclose(accelerations, expected[:n], rtol=0, atol=1e-11)
        np.testing.assert_allclose(multipliers * sizes, expected[n:], rtol=0, atol=1e-10)


def test_contradicting_rows_and_speeds_without_mass():
    _, accelerations, _ = solved(np.eye(2), np.zeros(2), np.array([[1.0, 0], [2.0, 0]]), np.array([-1.0, -4.0]))
    np.testing.assert_allclose(accelerations, [1.5, 0], atol=1e-15)  # in the mean
    M, rows = np.diag([1.0, 0, 0, 1]), np.array([[0, 1.0, 0, 0], [0, 1, 1, 0]])
    rank, accelerations, multipliers = solved(M, np.ones(4), rows, np.ones(2))
    assert rank == 2
    np.testing.assert_allclose(accelerations, [1, -1, 0, 1], atol=1e-15)
    np.testing.assert_allclose(multipliers, [0, 1], atol=1e-15)
    assert solved(M, np.ones(4), 0 * rows, np.ones(2))[0] == BUILD.multibody.MASS_IS_SINGULAR
    assert solved(M, np.full(4, np.nan), rows, np.ones(2))[0] == BUILD.multibody.NOT_FINITE
