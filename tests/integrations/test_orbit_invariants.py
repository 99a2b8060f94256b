"""Which invariants of an orbit are found."""

import numpy as np
import pytest

from eip_scipy.integrations._orbits import kept_invariants, run_orbits

W, TIMES = np.array([1.0, 0.3, 0.2, 0.1, 0.8, -0.3]), np.array([0.0, 5.0, 20.0])


class Spring:
    """Springs of stiffness k along axes that turn at a speed about z, growth of the stiffness, and friction."""

    def __init__(self, k=(1.0, 1.0, 2.0), speed=0.0, growth=0.0, friction=0.0):
        self.k, self.speed, self.growth, self.friction = np.array(k), speed, growth, friction

    def matrix(self, t):
        c, s = np.cos(self.speed * t), np.sin(self.speed * t)
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        return (1 + self.growth * t) * (turn * self.k) @ turn.T

    def __call__(self, t, w):
        return np.concatenate([w[3:], -self.matrix(t) @ w[:3] - self.friction * w[3:]])

    def energy(self, t, w):
        return (w[3:] @ w[3:] + w[:3] @ self.matrix(t) @ w[:3]) / 2


@pytest.mark.parametrize(
    ("settings", "pattern_speed", "names"),
    [
        ({}, 0.0, ["energy", "L_z"]),
        ({"k": (1, 1.001, 2)}, 0.0, ["energy"]),
        ({"growth": 1e-3}, 0.0, ["L_z"]),
        ({"friction": 1e-3}, 0.0, []),
        ({"k": (1, 1.2, 2), "speed": 0.3}, 0.0, []),
        ({"k": (1, 1.2, 2), "speed": 0.3}, 0.3, ["Jacobi"]),
    ],
)
@pytest.mark.parametrize("w", [W, np.concatenate([W[:3], np.zeros(3)])])
def test_what_is_kept(settings, pattern_speed, names, w):
    system = Spring(**settings)
    found = kept_invariants(system, w, TIMES, pattern_speed)
    assert [item.name for item in found] == names
    last = run_orbits(system, w[None], TIMES, {"rtol": 1e-6, "atol": 1e-6}, pattern_speed)[0, -1]
    assert all(abs(item.fun(TIMES[-1], last) - item.fun(0.0, w)) < 1e-12 for item in found)
