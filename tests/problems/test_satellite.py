"""A satellite about an oblate planet with drag: forces and rates against mpmath, orbits against SciPy."""

import mpmath
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from eip_scipy import EIPDOP853, EIPGJ14, integrate
from eip_scipy.problems import ForceConstants, nbody, satellite, solar_system

EARTH = {"mu": 398600.4418, "radius": 6378.137, "j2": 1.08262668e-3}  # km and s
AIR = {"drag": 3.3e-11, "height": 400.0, "scale_height": 60.0, "spin": 7.292e-5}
POLE = (0.3, -0.2, 0.9)
START = [6800.0, 300.0, -500.0], [0.2, 5.0, 5.77]
ALL = ("energy", "momentum", "laplace")


def orbit(days=1.0, **options):
    return satellite(*START, t_span=(0.0, 86400 * days), **{**EARTH, **AIR, "pole": POLE, **options})


def vector(values):
    return mpmath.matrix([mpmath.mpf(float(x)) for x in values])


def cross(a, b):
    return mpmath.matrix([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def dot(a, b):
    return (a.T * b)[0]


def formulas():
    """Return the acceleration and the rates of Kepler's energy, angular momentum and Laplace's vector, by mpmath."""
    mu, radius, j2, drag, height, scale, spin = (mpmath.mpf(x) for x in (*EARTH.values(), *AIR.values()))
    x, v, pole = vector(START[0]), vector(START[1]), vector(POLE)
    pole /= mpmath.sqrt(dot(pole, pole))

    def potential(*place):
        y = mpmath.matrix(place)
        r2 = dot(y, y)
        sine2 = dot(y, pole) ** 2 / r2
        return -mu / mpmath.sqrt(r2) * j2 * radius**2 / r2 * (1 - 3 * sine2) / 2

    r, u = mpmath.sqrt(dot(x, x)), v - spin * cross(pole, x)
    gradient = mpmath.matrix([mpmath.diff(potential, tuple(x), tuple(np.eye(3, dtype=int)[k])) for k in range(3)])
    air = drag * mpmath.exp((radius + height - r) / scale) * mpmath.sqrt(dot(u, u))
    P = -gradient - air * u
    h = cross(x, v)
    rates = [dot(v, P), *cross(x, P), *(cross(P, h) + cross(v, cross(x, P)))]
    return P - mu * x / r**3, rates


def test_acceleration_and_rates_are_those_of_mpmath():
    problem = orbit(balances=ALL)
    with mpmath.workdps(40):
        acceleration, rates = formulas()
    f = problem.fun(0.0, problem.y0)
    np.testing.assert_allclose(f[9:], np.array(acceleration.tolist(), float)[:, 0], rtol=1e-14)
    assert not f[6:9].any()
    found = np.concatenate([np.ravel(item.rate(0.0, problem.y0, f)) for item in problem.invariants])
    sizes = np.repeat([1.0, 7e3, 7e4], [1, 3, 3]) * np.linalg.norm(f[9:]) * 8
    assert (np.abs(found - np.array([float(x) for x in rates])) < 1e-15 * sizes).all()


def end_errors(problem, *options):
    """Return distances of the ends of runs from that of SciPy at tight tolerances, and the runs."""
    truth = solve_ivp(problem.fun, problem.t_span, problem.y0, method="DOP853", rtol=1e-13, atol=1e-9).y[3:6, -1]
    runs = [integrate(problem, **given) for given in options]
    return [np.linalg.norm(run.y[3:6, -1] - truth) for run in runs], runs


@pytest.mark.parametrize(("balances", "gain"), [("kepler", 3), (ALL, 10)])
def test_balances_make_orbits_more_accurate(balances, gain):
    options = {"method": EIPDOP853, "invariants": ()}, {"method": EIPDOP853}, {"method": EIPGJ14, "h": 20.0}
    (plain, kept, multistep), runs = end_errors(orbit(4.0, balances=balances), *options)
    assert runs[1].trusted
    assert runs[2].trusted
    assert runs[1].nfev == runs[0].nfev
    assert gain * kept < plain
    assert multistep < 1e-4
    assert not runs[1].y[:3].any()  # the planet stays


def test_without_drag_height_and_balances():
    bare = satellite(*START, mu=EARTH["mu"], radius=EARTH["radius"], t_span=(0, 1), balances=None)
    assert bare.invariants == ()
    assert bare.params.size == 2
    for speed, h in ((1.0, pytest.approx(2 * np.pi / 16)), (2.0, None)):
        assert satellite([1.0, 0, 0], [0, speed, 0], mu=1, radius=0.5, t_span=(0, 1)).h == h


def test_drag_on_a_body_with_mass_moves_no_centre_of_mass():
    """The first body takes the reaction, and bodies far away feel nothing."""
    bodies = [1.0, 0.5, 0.1], [[0, 0, 0], [1, 0, 0], [0, 50.0, 0]], [[0, 0, 0], [0, 1, 0], [0.1, 0, 0]]
    constants = ForceConstants(drag=0.1, drag_radius=1.0, scale_height=0.2)
    problem = nbody(*bodies, forces="drag", constants=constants, t_span=(0, 1))
    newton = nbody(*bodies, t_span=(0, 1))
    added = (problem.fun(0.0, problem.y0) - newton.fun(0.0, newton.y0))[9:].reshape(3, 3)
    np.testing.assert_allclose(added, [[0, 0.05, 0], [0, -0.1, 0], [0, 0, 0]], atol=1e-16)
    assert problem.invariants == ()
    assert problem.acc is None


def test_what_is_refused():
    for make, match in [
        (lambda: orbit(radius=-1.0), "radius must be a finite number > 0"),
        (lambda: orbit(j2=-1.0), "j2 must be a finite number >= 0"),
        (lambda: orbit(scale_height=None), "drag needs scale_height"),
        (lambda: orbit(spin=np.inf), "spin must be a finite number"),
        (lambda: orbit(pole=(0, 0, 0)), "pole must be three finite numbers"),
        (lambda: orbit(balances="total"), "unknown quantity 'total'"),
        (lambda: satellite([1, 2], [3, 4], mu=1, radius=1, t_span=(0, 1)), "position has shape"),
        (lambda: solar_system(forces="drag"), "needs an atmosphere"),
        (lambda: solar_system(forces="radiation"), "needs beta; see nbody"),
    ]:
        with pytest.raises(ValueError, match=match):
            make()
