"""Systems that several test modules share, such as Kepler's problem with G M = 1, and a comparison of results."""

import math
import re

import numpy as np
from numba import njit

from eip_scipy import Balance, Invariant

AU_KM, DAY_S, YEAR_D = 149597870.7, 86400.0, 365.25  # IAU 2012 Resolution B2, and the Julian year


def oscillator(t, y):
    return np.array([y[1], -y[0]])


SQUARE = Invariant(lambda t, y: y @ y, lambda t, y: 2 * y, name="S")


class Verlet:
    """Take a step of position Verlet for the unit oscillator, in place: a user-defined one-step method."""

    order = 2

    def one_step(self, t, y, h):
        y[0] += h / 2 * y[1]
        y[1] -= h * y[0]
        y[0] += h / 2 * y[1]
        return y


def pendulum(t, y):
    return np.array([y[1], -np.sin(y[0])])


def pendulum_energy(t, y):
    return 0.5 * y[1] ** 2 - np.cos(y[0])


def pendulum_gradient(t, y):
    return np.array([np.sin(y[0]), y[1]])


PENDULUM_ENERGY = Invariant(pendulum_energy, pendulum_gradient, name="energy")


# Kepler's problem in the plane, y = (x, y, vx, vy). The invariants take states (4, m) too.


def pericentre(e):
    """Return the state there, on an orbit of semi-major axis 1."""
    return np.array([1 - e, 0.0, 0.0, math.sqrt((1 + e) / (1 - e))])


def orbit(t, y):
    return np.array([y[2], y[3], *(-y[:2] / math.hypot(y[0], y[1]) ** 3)])


def energy(t, y):
    return 0.5 * (y[2] ** 2 + y[3] ** 2) - 1 / np.hypot(y[0], y[1])


def energy_gradient(t, y):
    return np.array([*(y[:2] / math.hypot(y[0], y[1]) ** 3), y[2], y[3]])


def momentum(t, y):
    return y[0] * y[3] - y[1] * y[2]


def momentum_gradient(t, y):
    return np.array([y[3], -y[2], -y[1], y[0]])


H = Invariant(energy, energy_gradient, name="energy")
L = Invariant(momentum, momentum_gradient, name="momentum")
# Energy with f: its gradient is (-a, v).
H_USES_F = Invariant(energy, lambda t, y, f: np.array([-f[2], -f[3], y[2], y[3]]), name="energy", uses_f=True)


@njit
def jit_orbit(t, y):
    r3 = (y[0] * y[0] + y[1] * y[1]) ** 1.5
    return np.array([y[2], y[3], -y[0] / r3, -y[1] / r3])


jit_energy = njit(lambda t, y: 0.5 * (y[2] * y[2] + y[3] * y[3]) - 1 / np.sqrt(y[0] * y[0] + y[1] * y[1]))


@njit
def jit_energy_gradient(t, y):
    r3 = (y[0] * y[0] + y[1] * y[1]) ** 1.5
    return np.array([y[0] / r3, y[1] / r3, y[2], y[3]])


jit_momentum, jit_momentum_gradient = njit(momentum), njit(momentum_gradient)
JIT_H = Invariant(jit_energy, jit_energy_gradient, name="energy")
JIT_L = Invariant(jit_momentum, jit_momentum_gradient, name="momentum")
jit_oscillator = njit(oscillator)
JIT_SQUARE = Invariant(njit(lambda t, y: y[0] * y[0] + y[1] * y[1]), njit(lambda t, y: 2 * y), name="S")
twice = njit(lambda t, y: 2 * y)


# Three complex amplitudes under a Hermitian matrix and a cubic phase, which keep their norm.


def spin(t, y):
    return -1j * (np.array([0.3 * y[1], 0.3 * y[0] + 0.7j * y[2], -0.7j * y[1]]) + np.arange(3) * abs(y) ** 2 * y)


SPIN_NORM = Invariant(lambda t, y: np.vdot(y, y).real, lambda t, y: 2 * y, name="N")
SPIN_START = np.array([0.8, 0.6j, 0.1 - 0.2j])

# A quartic oscillator whose stiffness varies slowly: amplitude and frequency of that are the parameters.
# Its energy is a balance, whose rate is given in several ways, or found.
QUARTIC_PARAMS, QUARTIC_START = np.array([1e-3, 0.3]), np.array([1.0, 0.3])
swinging = njit(lambda t, y, p: np.array([y[1], -(1 + p[0] * np.sin(p[1] * t)) * y[0] - y[0] ** 3]))


@njit
def quartic_energy(t, y, p):
    return 0.5 * y[1] ** 2 + 0.5 * (1 + p[0] * np.sin(p[1] * t)) * y[0] ** 2 + 0.25 * y[0] ** 4


quartic_gradient = njit(lambda t, y, p: np.array([(1 + p[0] * np.sin(p[1] * t)) * y[0] + y[0] ** 3, y[1]]))
quartic_rate = njit(lambda t, y, p: 0.5 * p[0] * p[1] * np.cos(p[1] * t) * y[0] ** 2)


@njit
def quartic_rate_by_f(t, y, f, p):
    return y[1] * f[1] + (1 + p[0] * np.sin(p[1] * t)) * y[0] * f[0] + y[0] ** 3 * f[0] + quartic_rate(t, y, p)


quartic_gradient_by_f = njit(lambda t, y, f, p: np.array([-f[1], f[0]]))
quartic_pair = njit(lambda t, y, p: np.array([quartic_energy(t, y, p), 2 * quartic_energy(t, y, p)]))
BALANCES = {
    "rate": Balance(quartic_energy, quartic_rate, quartic_gradient, name="H"),
    "f": Balance(quartic_energy, quartic_rate_by_f, quartic_gradient_by_f, name="H", uses_f=True),
    "gradient": Balance(quartic_energy, grad=quartic_gradient, name="H"),
    "values": Balance(quartic_energy, name="H"),
    "pair": Balance(quartic_pair, name="H"),
}


def van_der_pol(t, y, mu=5.0):
    return np.array([y[1], mu * (1 - y[0] ** 2) * y[1] - y[0]])


def lotka_volterra(t, u):
    return np.array([u[0] * (1 - u[1]), u[1] * (u[0] - 1)])


def _volterra(t, u):
    return u[0] - math.log(u[0]) + u[1] - math.log(u[1]) if (u > 0).all() else math.nan


VOLTERRA = Invariant(_volterra, lambda t, u: 1 - 1 / u, name="V")


def same(one, *others):
    """Compare every number of results of `integrate`."""
    for other in others:
        for key in ("t", "y", "invariants", "max_residual", "status", "nfev", "njev", "nlu", "success", "method", "h"):
            np.testing.assert_array_equal(one[key], other[key], err_msg=key)
        for key in ("t_events", "y_events"):
            assert (one[key] is None) == (other[key] is None)
            for a, b in zip(one[key] or (), other[key] or (), strict=True):
                np.testing.assert_array_equal(a, b, err_msg=key)
        for key in ("names", "n_projections", "n_skipped", "n_rank_reduced", "n_rejected_projections"):
            assert getattr(one.diagnostics, key) == getattr(other.diagnostics, key), key
        for key in ("last_residual", "max_residual", "max_correction", "slowness"):
            np.testing.assert_array_equal(getattr(one.diagnostics, key), getattr(other.diagnostics, key), err_msg=key)
        assert one.message.split(" (")[0] == other.message.split(" (")[0]


# Systems as text, for `hamiltonian` and `equations`: names of the state, and parameters.

HENON_HEILES = "(px**2 + py**2 + x**2 + y**2)/2 + x**2*y - y**3/3"
RELATIVISTIC_KEPLER = "(px**2 + py**2)/2 - 1/sqrt(x**2 + y**2) - eps/(2*(x**2 + y**2)**1.5)"
RIGID_BODY = "(m1**2/I1 + m2**2/I2 + m3**2/I3)/2"
SO3 = [[0, "-m3", "m2"], ["m3", 0, "-m1"], ["-m2", "m1", 0]]
INERTIA = {"I1": 1.0, "I2": 2.0, "I3": 3.0}
DOUBLE_PENDULUM = (
    "(m2*l2**2*p1**2 + (m1 + m2)*l1**2*p2**2 - 2*m2*l1*l2*p1*p2*cos(th1 - th2))"
    " / (2*m2*l1**2*l2**2*(m1 + m2*sin(th1 - th2)**2)) - (m1 + m2)*g*l1*cos(th1) - m2*g*l2*cos(th2)"
)
TWO_RODS = {"m1": 1.0, "m2": 0.5, "l1": 1.0, "l2": 0.7, "g": 9.81}


def refuse(call, rows):
    """Check that a call with each of some options is refused with an error of this type, which has these words."""
    for options, error, words in rows:
        try:
            call(**options)
        except error as refusal:
            said = str(refusal)
        else:
            raise AssertionError(f"not refused: {options}")
        assert re.search(words, said), f"{said!r} does not have {words!r}"


def same_fields(one, other, *, but=()):
    """Compare every field of two results of `ensemble`, except those named in `but`."""
    assert set(one) == set(other)
    for name in set(one) - {"wall_time", *but}:
        value = one[name]
        if name in ("t_events", "y_events") and value is not None:
            for a, b in zip(value, other[name], strict=True):
                for c, d in zip(a, b, strict=True):
                    np.testing.assert_array_equal(c, d)
        elif isinstance(value, np.ndarray):
            np.testing.assert_array_equal(other[name], value, err_msg=name)
            assert other[name].dtype == value.dtype
        else:
            assert other[name] == value
