"""An example of SciPy's documentation, with args and dense output, runs with only the method's name changed."""

import numpy as np
from scipy.integrate import solve_ivp

from eip_scipy import EIPRK45, Invariant


def test_lotka_volterra():
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
