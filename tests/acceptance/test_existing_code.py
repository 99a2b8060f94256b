"""Published examples of solve_ivp run with only the method's name changed, and keep their invariants.

Lotka-Volterra, with args and dense output, is in the documentation of `scipy.integrate.solve_ivp`; the double pendulum
is that of Matplotlib's gallery with its equations (masses and lengths 1), where a user would watch the energy.
"""

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

    def gradient(t, z):
        return np.array([d - c / z[0], b - a / z[1]])

    def run(method, **options):
        sol = solve_ivp(lotkavolterra, [0, 15], [10, 5], args=(a, b, c, d), dense_output=True, method=method, **options)
        z = sol.sol(np.linspace(0, 15, 300))
        assert sol.success
        return np.ptp([value(0, column) for column in z.T]), sol.y[:, -1]

    plain, _ = run("RK45")
    same, _ = run(EIPRK45)
    kept, end = run(EIPRK45, invariants=Invariant(value, gradient, name="V"))
    exact = solve_ivp(lotkavolterra, [0, 15], [10, 5], args=(a, b, c, d), method="DOP853", rtol=1e-12, atol=1e-12).y[
        :, -1
    ]
    assert same == plain
    assert plain > 0.1
    assert kept < 2e-3
    assert np.linalg.norm(end - exact) < 0.2 * np.linalg.norm(run("RK45")[1] - exact)


def test_double_pendulum():
    G = 9.8

    def derivs(t, state):
        dydx = np.zeros_like(state)
        delta = state[2] - state[0]
        dydx[0] = state[1]
        den = 2 - np.cos(delta) ** 2
        dydx[1] = (
            state[1] ** 2 * np.sin(delta) * np.cos(delta)
            + G * np.sin(state[2]) * np.cos(delta)
            + state[3] ** 2 * np.sin(delta)
            - 2 * G * np.sin(state[0])
        ) / den
        dydx[2] = state[3]
        dydx[3] = (
            -(state[3] ** 2) * np.sin(delta) * np.cos(delta)
            + 2 * (G * np.sin(state[0]) * np.cos(delta) - state[1] ** 2 * np.sin(delta) - G * np.sin(state[2]))
        ) / den
        return dydx

    def energy(t, s):
        kinetic = s[1] ** 2 + 0.5 * s[3] ** 2 + s[1] * s[3] * np.cos(s[0] - s[2])
        return kinetic - G * (2 * np.cos(s[0]) + np.cos(s[2]))

    state = np.radians([120.0, 0.0, -10.0, 0.0])
    t = np.arange(0, 2.5, 0.01)
    options = {"t_eval": t, "rtol": 1e-5, "atol": 1e-8}
    kept = solve_ivp(derivs, t[[0, -1]], state, method=EIPRK45, invariants=Invariant(energy, name="energy"), **options)
    plain = solve_ivp(derivs, t[[0, -1]], state, **options)
    exact = solve_ivp(derivs, t[[0, -1]], state, t_eval=t, method="DOP853", rtol=1e-12, atol=1e-12)
    drift = [np.ptp([energy(0, s) for s in sol.y.T]) for sol in (plain, kept)]
    assert drift[0] > 1e-3
    assert drift[1] < 1e-4 * drift[0]
    assert np.abs(kept.y - exact.y).max() < np.abs(plain.y - exact.y).max()
