"""Joint invariants: the same steps as with separate items, in fewer passes."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from eip_scipy import EIPRK4, Diagnostics, Invariant, integrate
from eip_scipy.problems import JointInvariants

RNG = np.random.default_rng(7)
N = 24
MATRIX = RNG.standard_normal((N, N)) + 1j * RNG.standard_normal((N, N))
MATRIX = (MATRIX + MATRIX.conj().T) / 8
START = RNG.standard_normal(N) + 1j * RNG.standard_normal(N)
START /= np.linalg.norm(START)
SPAN, H = (0.0, 2.0), 0.02


def fun(t, y):
    return -1j * (MATRIX @ y)


def mass(t, y):
    return np.vdot(y, y).real


def energy(t, y):
    return np.vdot(y, MATRIX @ y).real


MASS = Invariant(mass, lambda t, y: 2 * y, name="mass")
ENERGY = Invariant(energy, lambda t, y, f: 2j * f, name="energy", uses_f=True)


class Counted:
    """The functions of the joint invariants, from the definitions, and how often they are called."""

    def __init__(self):
        self.moments_taken = self.shifts = 0

    def moments(self, t, y, f, values, gram, terms):
        self.moments_taken += 1
        G = self.gradients(y, f)
        values[:] = mass(t, y), energy(t, y)
        gram[:] = (G.conj() @ G.T).real
        terms[:] = (abs(G.real * y.real) + abs(G.imag * y.imag)).sum(axis=1)

    def shift(self, t, y, f, mu, out, values):
        self.shifts += 1
        out[:] = y + mu @ self.gradients(y, f)
        values[:] = mass(t, out), energy(t, out)

    def gradients(self, y, f):
        return np.array([2 * y, 2j * f])

    def invariants(self):
        return JointInvariants([MASS, ENERGY], self.moments, self.shift)


def run(invariants, start=START, driver="solve_ivp", **options):
    diagnostics = Diagnostics()
    options = {"h": H, "metric": "euclidean", "invariants": invariants, "diagnostics": diagnostics, **options}
    if driver == "integrate":
        done = integrate(fun, SPAN, start, method=EIPRK4, compiled=False, **options)
    else:
        done = solve_ivp(fun, SPAN, start, method=EIPRK4, **options)
    assert done.success
    return done.y[:, -1], diagnostics


@pytest.mark.parametrize("driver", ["solve_ivp", "integrate"])
def test_same_steps(driver):
    counted = Counted()
    end, found = run(counted.invariants(), driver=driver)
    expected, known = run([MASS, ENERGY], driver=driver)
    assert counted.shifts == found.n_projections > 90
    assert counted.moments_taken == 100
    np.testing.assert_allclose(end, expected, atol=1e-13)
    np.testing.assert_allclose([mass(0, end), energy(0, end)], [mass(0, START), energy(0, START)], atol=2e-15)
    assert (found.max_defect < 4e-15).all()
    assert found.n_projections + found.n_skipped == known.n_projections + known.n_skipped == 100


@pytest.mark.parametrize(
    "options",
    [
        {"metric": "error"},
        {"metric": np.ones(N)},
        {"direction": "midpoint"},
        {"iterations": 2},
        {"every": "auto"},
        {"frame": (np.ones((1, N)), np.ones((N, 1)))},
    ],
)
def test_other_options_take_the_items(options):
    counted = Counted()
    end, _ = run(counted.invariants(), **options)
    assert counted.moments_taken == 0
    np.testing.assert_array_equal(end, run([MASS, ENERGY], **options)[0])


def test_parallel_gradients_take_the_items():
    """A stationary state still has rank 1."""
    values, states = np.linalg.eigh(MATRIX)
    start = np.ascontiguousarray(states[:, -1])
    counted = Counted()
    end, found = run(counted.invariants(), start)
    assert counted.moments_taken == 100
    assert counted.shifts < 5
    assert found.n_rank_reduced > 90
    np.testing.assert_allclose(end, start * np.exp(-1j * values[-1] * SPAN[1]), atol=1e-7)


def test_a_shift_that_fails_is_not_taken():
    class Wrong(Counted):
        def shift(self, t, y, f, mu, out, values):
            super().shift(t, y, f, -mu, out, values)

    wrong = Wrong()
    end, found = run(wrong.invariants(), h=0.1)
    assert wrong.shifts == 20
    np.testing.assert_array_equal(end, run([MASS, ENERGY], h=0.1)[0])
    assert found.n_projections == 20


def test_steps_in_the_dead_band_are_left_alone():
    counted = Counted()
    end, found = run(counted.invariants(), h=1e-3, driver="integrate", save_every=2000)
    assert found.n_skipped > 1500
    assert counted.shifts == found.n_projections
    np.testing.assert_allclose(end, run([MASS, ENERGY], h=1e-3, driver="integrate", save_every=2000)[0], atol=1e-12)
