"""The main application: the solar system keeps H and L, and the error metric improves the orbits."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from eip_scipy import EIPRK4, integrate
from eip_scipy.problems import nbody, solar_data, solar_system

pytestmark = pytest.mark.needs_jit


def position_errors(y, reference):
    return np.linalg.norm((y - reference)[:30].reshape(10, 3), axis=1)[1:]


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 5))])
def test_mercury_gains_a_hundredfold_in_any_orientation(seed):
    data = solar_data.load("de440")
    turn = Rotation.random(rng=seed).as_matrix()
    problem = nbody(
        data.gm * 365.25**2, data.position @ turn.T, data.velocity @ turn.T * 365.25, t_span=(0.0, 100.0), h=0.002
    )
    reference = (solar_system().reference(100.0).reshape(20, 3) @ turn.T).ravel()
    eip = position_errors(integrate(problem, method=EIPRK4).y[:, -1], reference)
    plain = position_errors(integrate(problem, method=EIPRK4, invariants=()).y[:, -1], reference)
    assert plain[0] > 100 * eip[0]
    # No other planet pays for it: 1e-7 rad is 3e-6 AU at most.
    assert np.all(eip[1:] < np.maximum(2 * plain[1:], 1e-8))
