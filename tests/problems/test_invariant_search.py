"""`find_invariants` finds all invariants, and nothing else."""

import math
import pickle

import numpy as np
import pytest
from numba import config, njit

from eip_scipy import EIPRK4, check_gradient, find_invariants, hamiltonian, integrate
from eip_scipy.problems import kepler as kepler_problem
from eip_scipy_studies.hard_cases import hard_cases


def kepler(t, y):
    r3 = (y[0] ** 2 + y[1] ** 2) ** 1.5
    return np.array([y[2], y[3], -y[0] / r3, -y[1] / r3])


def inverse_radius(y):
    return 1 / np.hypot(y[0], y[1])


def inverse_radius_gradient(y):
    r3 = np.hypot(y[0], y[1]) ** 3
    return np.array([-y[0] / r3, -y[1] / r3, 0.0, 0.0])


def cosine(y):
    return y[0] / np.hypot(y[0], y[1])


def cosine_gradient(y):
    r3 = np.hypot(y[0], y[1]) ** 3
    return np.array([y[1] ** 2 / r3, -y[0] * y[1] / r3, 0.0, 0.0])


def rigid_body(*inertia):
    return lambda t, m: np.cross(m, m / np.array(inertia))


def heavy_top(inertia, centre):
    def f(t, y):
        m, gamma = y[:3], y[3:]
        w = m / np.array(inertia)
        return np.concatenate([np.cross(m, w) + np.cross(gamma, centre), np.cross(gamma, w)])

    return f


def lattice(n, alpha, beta):
    def f(t, y):
        q, p = y[:n], y[n:]
        d = np.roll(q, -1) - q
        force = d + alpha * d**2 + beta * d**3
        return np.concatenate([p, force - np.roll(force, 1)])

    return f


def coupled(t, y):
    return np.array([y[2], y[3], -2 * y[0] + y[1], y[0] - 2 * y[1]])


def lotka_volterra(t, y):
    return np.array([y[0] * (2 / 3 - 4 / 3 * y[1]), y[1] * (y[0] - 1)])


def log_of(k):
    def g(y):
        return np.log(y[k])

    def grad(y):
        return np.array([1 / y[0], 0.0]) if k == 0 else np.array([0.0, 1 / y[1]])

    return g, grad


LOGARITHMS = {"log(y0)": log_of(0), "log(y1)": log_of(1)}


def names(*args, **options):
    return [item.name for item in find_invariants(*args, **options)]


def same_functions(found, known, points):
    """Return whether the gradients span the same spaces, and so the invariants the same functions."""
    for y in points:
        a = np.array([item.grad(0.0, y) for item in found])
        b = np.array([grad(y) for grad in known])
        a, b = (rows / np.linalg.norm(rows, axis=1, keepdims=True) for rows in (a, b))
        ranks = [np.linalg.matrix_rank(rows, tol=1e-8) for rows in (a, b, np.vstack([a, b]))]
        if ranks != [len(known)] * 3:
            return False
    return len(found) == len(known)


# --- what is found ---


@pytest.mark.parametrize("seed", range(4))
def test_keplers_problem(seed):
    assert names(kepler, [1.0, 0.0, 0.0, 1.2], seed=seed) == ["y0*y3 - y1*y2"]
    assert names(kepler, [1.0, 0.0, 0.0, 1.2], degree=4, seed=seed) == ["y0*y3 - y1*y2"]


def test_keplers_problem_with_terms():
    """Energy and the eccentricity vector; the vector's other component is a function of these."""
    terms = [(inverse_radius, inverse_radius_gradient), (cosine, cosine_gradient)]
    assert names(kepler, [1.0, 0.0, 0.0, 1.2], degree=3, terms=terms) == [
        "y0*y3 - y1*y2",
        "y2**2 + y3**2 - 2*inverse_radius(y)",
        "y0*y3**2 - y1*y2*y3 - cosine(y)",
    ]


def test_in_any_units():
    GM, AU = 1.327e20, 1.496e11

    def si(t, y):
        r3 = np.hypot(y[0], y[1]) ** 3
        return np.array([y[2], y[3], -GM * y[0] / r3, -GM * y[1] / r3])

    assert names(si, [AU, 0.0, 0.0, 2.98e4]) == ["y0*y3 - y1*y2"]


def test_rigid_body():
    points = np.random.default_rng(0).normal(size=(5, 3))
    for inertia in ((1.0, 2.0, 3.0), (1.1, 2.23, 3.7)):
        found = find_invariants(rigid_body(*inertia), [1.0, 0.2, 0.3])
        assert same_functions(found, [lambda m, inertia=inertia: m / np.array(inertia), lambda m: m], points)
    assert names(rigid_body(1.0, 2.0, 3.0), [1.0, 0.2, 0.3]) == ["3*y0**2 - y2**2", "3*y1**2 + 4*y2**2"]
    assert len(names(rigid_body(1.0, 2.0, 3.0), [1.0, 0.2, 0.3], degree=4)) == 2


def test_heavy_top():
    inertia, centre = np.array([1.0, 2.0, 3.0]), np.array([0.3, 0.2, 1.0])
    found = find_invariants(heavy_top(inertia, centre), [1.0, 0.2, 0.3, 0.1, 0.2, 0.9])
    known = [
        lambda y: np.concatenate([y[:3] / inertia, centre]),
        lambda y: np.concatenate([y[3:], y[:3]]),
        lambda y: np.concatenate([np.zeros(3), y[3:]]),
    ]
    assert same_functions(found, known, np.random.default_rng(0).normal(size=(5, 6)))
    assert {"y0*y3 + y1*y4 + y2*y5", "y3**2 + y4**2 + y5**2"} < {item.name for item in found}


def test_tops_with_a_further_invariant():
    """Lagrange's keeps m3, Kovalevskaya's a quartic."""
    assert names(heavy_top([1.0, 1.0, 0.5], [0.0, 0.0, 1.0]), [1.0, 0.2, 0.3, 0.1, 0.2, 0.9]) == [
        "y2",
        "2*y5 + y0**2 + y1**2",
        "y3**2 + y4**2 + y5**2",
        "y0*y3 + y1*y4 + y2*y5",
    ]
    kovalevskaya = heavy_top([2.0, 2.0, 1.0], [1.0, 0.0, 0.0])
    assert len(names(kovalevskaya, [1.0, 0.2, 0.3, 0.1, 0.2, 0.9])) == 3
    found = find_invariants(kovalevskaya, [1.0, 0.2, 0.3, 0.1, 0.2, 0.9], degree=4)
    assert len(found) == 4

    m1, m2 = np.array([1.0, 0, 0, 0, 0, 0]), np.array([0, 1.0, 0, 0, 0, 0])
    g1, g2 = np.array([0, 0, 0, 1.0, 0, 0]), np.array([0, 0, 0, 0, 1.0, 0])

    def quartic(y):
        """Return the gradient of ((m1^2 - m2^2) / 4 - g1)^2 + (m1 m2 / 2 - g2)^2."""
        a, b = (y[0] ** 2 - y[1] ** 2) / 4 - y[3], y[0] * y[1] / 2 - y[4]
        return 2 * a * ((y[0] * m1 - y[1] * m2) / 2 - g1) + 2 * b * ((y[1] * m1 + y[0] * m2) / 2 - g2)

    for y in np.random.default_rng(0).normal(size=(5, 6)):
        rows = np.array([item.grad(0.0, y) for item in found])
        assert np.linalg.matrix_rank(np.vstack([rows, quartic(y)]), tol=1e-8) == np.linalg.matrix_rank(rows) == 4


def test_oscillators():
    """Coupled: the energies of both modes. Equal ones: these and the angular momentum, of which the fourth depends."""
    found = find_invariants(coupled, [1.0, 0.0, 0.0, 0.5])
    known = [
        lambda y: np.array([y[0] + y[1], y[0] + y[1], y[2] + y[3], y[2] + y[3]]),
        lambda y: np.array([3 * (y[0] - y[1]), 3 * (y[1] - y[0]), y[2] - y[3], y[3] - y[2]]),
    ]
    assert same_functions(found, known, np.random.default_rng(0).normal(size=(5, 4)))
    equal = names(lambda t, y: np.array([y[2], y[3], -y[0], -y[1]]), [1.0, 0.0, 0.0, 0.5])
    assert equal == ["y0*y3 - y1*y2", "y0**2 + y2**2", "y1**2 + y3**2"]


@pytest.mark.parametrize(("alpha", "beta", "degree"), [(0.25, 0.0, 3), (0.0, 0.5, 4)])
def test_lattices_with_a_translation(alpha, beta, degree):
    n = 4 if degree == 3 else 3
    start = np.array([0.1, 0.2, -0.3, 0.4, 0.0, 0.1, 0.2, -0.1])[: 2 * n]
    found = find_invariants(lattice(n, alpha, beta), start, degree=degree)
    assert found[0].name == " + ".join(f"y{k}" for k in range(n, 2 * n))

    def energy_gradient(y):
        q, p = y[:n], y[n:]
        d = np.roll(q, -1) - q
        force = d + alpha * d**2 + beta * d**3
        return np.concatenate([np.roll(force, 1) - force, p])

    for y in np.random.default_rng(0).normal(size=(5, 2 * n)):
        rows = np.array([item.grad(0.0, y) for item in found])
        combination = np.linalg.lstsq(rows.T, energy_gradient(y))[0]
        assert rows.T @ combination == pytest.approx(energy_gradient(y), abs=1e-9)


def test_lotka_volterra():
    assert names(lotka_volterra, [1.0, 0.5], terms=LOGARITHMS) == ["3*y0 + 4*y1 - 3*log(y0) - 2*log(y1)"]
    assert names(lotka_volterra, [1.0, 0.5], degree=4) == []


@pytest.mark.nightly
@pytest.mark.slow
def test_terms_of_time_and_state_jitted():
    if config.DISABLE_JIT:
        pytest.skip("of compiled functions")
    f = njit(lotka_volterra)
    terms = [
        (njit(lambda t, y: np.log(y[0])), njit(lambda t, y: np.array([1 / y[0], 0.0]))),
        (njit(lambda t, y: np.log(y[1])), njit(lambda t, y: np.array([0.0, 1 / y[1]]))),
    ]
    (found,) = find_invariants(f, [1.0, 0.5], terms=terms)
    assert found.name == "3*y0 + 4*y1 - 3*term0(y) - 2*term1(y)"
    run = integrate(f, (0, 20), [1.0, 0.5], method=EIPRK4, h=0.05, invariants=found, compiled=True)
    assert run.max_defect[0] < 1e-13
    assert run.trusted


def test_what_depends_on_time():
    """The angular momentum of a trap that breathes is found; its energy at one time is not an invariant."""

    def trap(t, y):
        k = 1 + 0.3 * np.cos(t)
        return np.array([y[2], y[3], -k * y[0], -k * y[1]])

    assert names(trap, [1.0, 0.0, 0.0, 1.0], degree=4) == ["y0*y3 - y1*y2"]


DRIVEN = {
    "force": lambda t, y: np.array([y[1], -y[0] + np.sin(2 * t)]),
    "force alone": lambda t, y: np.array([y[1], -t]),
    "stiffness": lambda t, y: np.array([y[1], -y[0] * t]),
    "all of it": lambda t, y: np.array([t * y[1], -(t**2)]),
    "weak and all of it": lambda t, y: 1e-12 * np.array([y[1], -y[0] + t]) * t,
    "field after a while": lambda t, y: np.array([y[1], -y[0] + (t > 30.0)]),
    "all of it after a while": lambda t, y: np.array([y[1], y[0] ** 2]) * (t > 1e6),
}


@pytest.mark.parametrize("start", [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
@pytest.mark.parametrize("drive", DRIVEN)
def test_what_is_at_rest_when_the_drive_begins(drive, start):
    """At time 0 the state does not move from some of these starts, or all states conserve a quantity."""
    assert names(DRIVEN[drive], start) == []


def test_what_is_conserved_from_rest():
    def ramped(t, y):
        return np.array([y[2], y[3], 0.1 * t, 0.0])

    assert names(ramped, [0.0, 0.0, 0.0, 0.0]) == ["y3"]
    assert names(lambda t, y: np.array([y[1], -y[0]]), [0.0, 0.0]) == ["y0**2 + y1**2"]
    assert names(lambda t, y: np.array([y[1], -y[0]]) * t, [0.0, 1.0]) == ["y0**2 + y1**2"]


def test_an_equilibrium_that_states_nearby_leave():
    """Neither the points around the start nor its own trajectory show that y1 moves."""

    def f(t, y):
        return np.array([y[0], float(abs(y[0]) > 4.0)])

    for seed in range(3):
        assert names(f, [0.0, 1.0], seed=seed) == []


def test_a_term_that_is_infinite_at_the_start():
    """The sum with log(y1) is infinite along the trajectory from the start, and not conserved where y1 > 5."""

    def f(t, y):
        return np.array([1.0 + (y[1] > 5.0), y[1]])

    for seed in range(3):
        assert names(f, [1.0, 0.0], terms={"log(y1)": log_of(1)}, seed=seed) == []
    assert names(lambda t, y: np.array([1.0, y[1]]), [1.0, 0.0], terms={"log(y1)": log_of(1)}) == ["y0 - log(y1)"]


def test_a_drive_at_rest_near_the_start_only():
    """States far from the start have no derivative, and those near it move only after time 0."""

    def f(t, y):
        return np.array([y[1], -1.0]) * t + 0 * np.sqrt(0.01 - y[0] ** 2 - y[1] ** 2)

    assert names(f, [0.0, 0.0], degree=1) == []


def vanishing(power, damping=0.0):
    """y'' = -y^power: all terms of the energy's rate are 0 where y is."""
    return lambda t, y: np.array([y[1], -(y[0] ** power) - damping * y[1]])


@pytest.mark.parametrize("start", [[1.0, 0.0], [0.3, 0.7], [-20.0, 5.0]])
@pytest.mark.parametrize("power", range(2, 10))
def test_a_force_that_is_a_power(power, start):
    """(k + 1) v^2 / 2 + y^(k + 1), in small whole numbers."""
    (found,) = find_invariants(vanishing(power), start, degree=power + 1)
    y = np.array([0.7, -1.1])
    gradient = found.grad(0.0, y)
    np.testing.assert_allclose(gradient / gradient[1], [y[0] ** power / y[1], 1.0], rtol=1e-12)
    assert f"y0**{power + 1}" in found.name


@pytest.mark.parametrize("damping", 10.0 ** -np.arange(1, 12))
def test_the_slightest_damping_of_such_a_force_is_seen(damping):
    assert names(vanishing(3, damping), [1.0, 0.0], degree=4) == []


@pytest.mark.parametrize("start", [[1.0, 0.5, 0.0, 0.0], [0.1, 0.2, 0.3, 0.4]])
def test_quartic_oscillators(start):
    def coupled(t, y):
        return np.array([y[2], y[3], -(y[0] ** 3) - 2 * y[0] * y[1] ** 2, -(y[1] ** 3) - 2 * y[1] * y[0] ** 2])

    def separate(t, y):
        return np.array([y[2], y[3], -(y[0] ** 3), -3 * y[1] ** 3])

    assert names(coupled, start, degree=4) == ["2*y2**2 + 2*y3**2 + y0**4 + 4*y0**2*y1**2 + y1**4"]
    assert names(separate, start, degree=4) == ["2*y2**2 + y0**4", "2*y3**2 + 3*y1**4"]


@pytest.mark.parametrize("size", [1.0, 1e6])
@pytest.mark.parametrize("infected", [1e-5, 1e-3, 0.01, 0.2])
def test_sir_from_a_typical_start(infected, size):
    """R + (gamma / beta) log S, in persons or parts; a start near the fixed point is slow, its surroundings are not."""

    def sir(t, y):
        new = 0.5 * y[0] * y[1] / size
        return np.array([-new, new - 0.1 * y[1], 0.1 * y[1]])

    terms = {"log S": (lambda y: np.log(y[0]), lambda y: np.array([1 / y[0], 0.0, 0.0]))}
    start = np.array([1 - infected, infected, 0.0]) * size
    found = find_invariants(sir, start, degree=1, terms=terms)
    assert found[0].name == "y0 + y1 + y2"
    assert found[1].name == ("5*y2 + log S" if size == 1 else "y2 + 200000*log S")
    assert len(found) == 2


@pytest.mark.parametrize("start", [[1.0, 0.5], [10.0, 10.0], [400.0, 1.0]])
def test_lotka_volterra_from_several_starts(start):
    """From (400, 1) the trajectory passes so near to 0 that the logarithm of its states means nothing."""

    def f(t, y):
        return np.array([1.1 * y[0] - 0.4 * y[0] * y[1], 0.1 * y[0] * y[1] - 0.4 * y[1]])

    assert names(f, start, terms={"log x": log_of(0), "log y": log_of(1)}) == ["y0 + 4*y1 - 4*log x - 11*log y"]


def test_what_does_not_move():
    assert names(lambda t, y: 0 * y, [1.0, 2.0]) == ["y0", "y1"]
    assert names(lambda t, y: np.array([-y[0] * y[1], 0.0]), [1.0, 2.0], degree=3) == ["y1"]


def test_problems_and_their_names():
    problem = hamiltonian("(px**2 + py**2)/2 - 1/sqrt(x**2 + y**2)")
    assert names(problem, [1.0, 0.0, 0.0, 1.2]) == ["x*py - y*px"]
    assert names(kepler_problem(), kepler_problem().y0) == ["x*vy - y*vx"]


KNOWN = {  # how many of a hard case's invariants are polynomials of degree 2
    "kepler_e06": 1, "kepler_e0999": 1, "kepler_si": 1, "arenstorf": 0, "oscillator": 1, "euler_top": 2,
    "euler_top_tennis": 2, "euler_detest": 2, "quaternion": 1, "lotka_volterra": 0, "sir": 1, "volterra_lattice": 2,
    "vortices": 3, "schwarzschild": 2, "brockett": 2, "pendulum": 0, "double_pendulum": 0, "tokamak": 1,
}  # fmt: skip


@pytest.mark.parametrize("name", KNOWN)
def test_hard_cases(name):
    (case,) = hard_cases([name])
    found = find_invariants(case.problem.fun, case.problem.y0)
    assert len(found) == KNOWN[name]
    for item in found:
        f = case.problem.fun(0.0, case.problem.y0)
        grad = item.grad(0.0, case.problem.y0)
        assert abs(grad @ f) <= 1e-12 * np.abs(grad * f).sum()


def test_functions_may_return_the_same_array_in_each_call():
    array = np.empty(2)

    def filled(*values):
        array[:] = values
        return array

    terms = {
        "log(x)": (lambda y: np.log(y[0]), lambda y: filled(1 / y[0], 0.0)),
        "log(y)": (lambda y: np.log(y[1]), lambda y: filled(0.0, 1 / y[1])),
    }
    assert names(lambda t, y: filled(*lotka_volterra(t, y)), [1.0, 0.5], terms=terms) == [
        "3*y0 + 4*y1 - 3*log(x) - 2*log(y)"
    ]


def test_they_can_be_pickled():
    found = find_invariants(coupled, [1.0, 0.0, 0.0, 0.5])
    found += find_invariants(kepler, [1.0, 0.0, 0.0, 1.2], terms=[(inverse_radius, inverse_radius_gradient)])
    assert found[-1].name == "y2**2 + y3**2 - 2*inverse_radius(y)"
    y = np.array([0.3, -0.7, 0.2, 0.9])
    for item in found:
        again = pickle.loads(pickle.dumps(item))
        assert repr(again) == repr(item)
        np.testing.assert_array_equal(again.fun(0.0, y), item.fun(0.0, y))
        np.testing.assert_array_equal(again.grad(0.0, y), item.grad(0.0, y))


@pytest.mark.parametrize("factor", [1.0, 1.01, 1.0001, -1.0])
def test_a_term_needs_its_own_gradient(factor):
    def sir(t, y):
        new, gone = 2.0 * y[0] * y[1], 0.5 * y[1]
        return np.array([-new, new - gone, gone])

    terms = {"log(S)": (lambda y: np.log(y[0]), lambda y: np.array([factor / y[0], 0.0, 0.0]))}
    if factor == 1.0:
        assert names(sir, [0.99, 0.01, 0.0], terms=terms) == ["y0 + y1 + y2", "4*y2 + log(S)"]
        return
    with pytest.raises(
        ValueError, match=r"the second function of the term 'log\(S\)' is not the gradient of the first"
    ):
        find_invariants(sir, [0.99, 0.01, 0.0], terms=terms)


def test_a_term_may_have_kinks_and_places_where_it_is_not_defined():
    terms = {
        "|x|": (lambda y: abs(y[0]), lambda y: np.array([np.sign(y[0]), 0.0])),
        "log(x)": (lambda y: math.log(y[0]), lambda y: np.array([1 / y[0], 0.0])),
        "big": (lambda y: 1e12 + y[1], lambda y: np.array([0.0, 1.0])),
    }
    assert names(lambda t, y: np.array([y[1], -y[0]]), [1e-3, 1.0], terms=terms) == ["y0**2 + y1**2"]


def test_they_serve_a_run():
    found = find_invariants(coupled, [1.0, 0.0, 0.0, 0.5])
    y = np.array([0.3, -0.7, 0.2, 0.9])
    assert all(check_gradient(item, 0.0, y) < 1e-10 for item in found)
    run = integrate(coupled, (0, 20), [1.0, 0.0, 0.0, 0.5], method=EIPRK4, h=0.05, invariants=found)
    assert (run.max_defect < 1e-13).all()
    assert run.trusted


# --- what is not found ---


@pytest.mark.parametrize("damping", 10.0 ** -np.arange(1, 12))
def test_the_slightest_damping_is_seen(damping):
    def f(t, y):
        return np.array([y[1], -y[0] - damping * y[1]])

    assert names(f, [1.0, 0.0], degree=4) == []


def test_friction_beyond_a_speed():
    """Everything is conserved near the start."""

    def f(t, y):
        return np.array([y[1], -y[0] - 0.1 * y[1] * (abs(y[1]) > 1.3)])

    assert names(f, [1.0, 0.0]) == []


def test_terms_that_are_polynomials_or_constant():
    """Their differences from polynomials are constants everywhere."""
    terms = {
        "square": (lambda y: y[0] ** 2 + y[1], lambda y: np.array([2 * y[0], 1.0, 0.0, 0.0])),
        "three": (lambda y: 3.0, lambda y: np.zeros(4)),
        "L": (lambda y: y[0] * y[3] - y[1] * y[2], lambda y: np.array([y[3], -y[2], -y[1], y[0]])),
    }
    assert names(kepler, [1.0, 0.0, 0.0, 1.2], terms=terms) == ["y0*y3 - y1*y2"]


@pytest.mark.parametrize(
    "degree", [8, *(pytest.param(n, marks=[pytest.mark.nightly, pytest.mark.slow]) for n in (16, 30))]
)
def test_high_degrees(degree):
    def damped(t, y):
        return np.array([y[1], -np.sin(y[0]) - 0.01 * y[1]])

    def near(t, y):
        """Defined close to the start only, where all functions are nearly polynomials."""
        return damped(t, y) + np.sqrt(0.0025 - (y[0] - 1) ** 2 - y[1] ** 2)

    assert names(damped, [1.0, 0.0], degree=degree) == names(near, [1.0, 0.0], degree=degree) == []


def test_a_jump_along_the_trajectory():
    """Points drawn around the start do not show it."""

    def f(t, y):
        return np.array([0.0, 1.0]) if y[1] < 1000.0 else np.array([1.0, 1.0])

    assert names(f, [1.0, 0.0], seed=1) == ["y0"]  # nobody could know
    assert names(lambda t, y: f(t, 400 * y), [1.0, 0.0], seed=1) == []


def random_system(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 6))
    A, B, c = rng.normal(size=(n, n)), rng.normal(size=(n, n, n)), rng.normal(size=n)
    some = rng.random((n, n)) < 0.5
    fields = (
        lambda t, y: A @ y,
        lambda t, y: A @ y + np.einsum("ijk,j,k->i", B, y, y),
        lambda t, y: np.sin(A @ y + c),
        lambda t, y: (A * some) @ y + c * np.cos(t) + 0.3,
        lambda t, y: np.tanh(A @ y) - c * y,
        lambda t, y: A @ y / (1 + y @ y) + c,
        lambda t, y: A @ y**3 + c * y,
        lambda t, y: y * (c + A @ y),
    )
    return fields[seed % len(fields)], rng.normal(size=n)


def dissipative_system(seed):
    """Return oscillators, coupled by linear and other forces, with dampings from 0.1 to 1e-11 of several kinds."""
    rng = np.random.default_rng(1000 + seed)
    n = int(rng.integers(1, 4))
    K, masses = rng.normal(size=(n, n)), rng.random(n) + 0.5
    K = K @ K.T + np.eye(n)
    g = 10.0 ** -rng.integers(1, 11) * (rng.random(n) + 0.1)
    forces = (lambda q: 0 * q, lambda q: q**3, np.sin, lambda q: K @ q * (q @ q), lambda q: 0 * q)
    dampings = (
        lambda p: g * p,
        lambda p: g * p,
        lambda p: g * p**3,
        lambda p: g * p * abs(p),
        lambda p: g[0] * p * (np.arange(n) == 0),
    )
    force, damping = forces[seed % 5], dampings[seed % 5]

    def f(t, y):
        q, p = y[:n], y[n:]
        return np.concatenate([p / masses, -K @ q - force(q) - damping(p)])

    return f, rng.normal(size=2 * n)


def kept_for(k):
    """The fast tests take 1/9 of the systems, the gate takes as many again, and the nights take the rest."""
    marks = {0: [], 4: [pytest.mark.slow]}.get(k % 9, [pytest.mark.slow, pytest.mark.nightly])
    return pytest.param(k, marks=marks)


@pytest.mark.parametrize("seed", [*map(kept_for, range(200))])
def test_none_in_random_systems(seed):
    f, y0 = random_system(seed)
    assert [names(f, y0, degree=degree) for degree in (2, 3, 4)] == [[], [], []]


@pytest.mark.parametrize(
    "seed", [k if k % 5 == k // 10 else pytest.param(k, marks=pytest.mark.slow) for k in range(50)]
)
def test_none_in_dissipative_systems(seed):
    f, y0 = dissipative_system(seed)
    assert [names(f, y0, degree=degree) for degree in (2, 3)] == [[], []]


# --- where functions end, and wrong arguments ---


def test_functions_that_are_defined_near_the_start_only():
    def f(t, y):
        if y[0] < 0.8:
            raise ValueError("too small")
        return np.array([np.sqrt(y[0] - 0.8), 0.0])

    assert names(f, [1.0, 2.0]) == ["y1"]


def test_functions_that_are_defined_nowhere():
    """Even where `fun` is defined at the start itself."""

    def f(t, y):
        if y.tolist() == [1.0, 2.0]:
            return np.array([1.0, 0.0])
        raise ZeroDivisionError("nowhere")

    with pytest.raises(ValueError, match="finite at fewer than 25 % of the random points around y0") as found:
        find_invariants(f, [1.0, 2.0])
    assert isinstance(found.value.__cause__, ZeroDivisionError)
    with pytest.raises(ValueError, match=r"fun\(t, y0\) raised ZeroDivisionError, expected finite") as found:
        find_invariants(f, [1.0, 1.0])
    assert isinstance(found.value.__cause__, ZeroDivisionError)


@pytest.mark.parametrize("value", [[np.nan, 1.0], [np.inf, 1.0], [np.nan, np.nan]])
def test_functions_that_are_not_finite_at_the_start(value):
    with pytest.raises(ValueError, match=r"fun\(t, y0\) is .*(nan|inf).*, expected finite numbers. Choose another y0"):
        find_invariants(lambda t, y: value, [1.0, 0.0])
    with pytest.raises(ValueError, match=r"fun\(t, y0\) is .*nan"), np.errstate(all="ignore"):
        find_invariants(kepler, [0.0, 0.0, 0.0, 1.0])


def test_functions_that_end_soon():
    """Half of the points are at the first time, and the trajectory ends where the function does."""

    def until(end, drive=0.0):
        return lambda t, y: np.array([y[1], -y[0] + drive * t]) if t <= end else np.full(2, np.nan)

    for start in ([1.0, 0.0], [0.0, 0.0]):
        assert names(until(1e-3), start) == ["y0**2 + y1**2"]
        assert names(until(1e-3, 1.0), start) == []


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"y0": [1.0, np.nan]}, "y0 must be a real, finite state"),
        ({"y0": [1j, 0.0]}, "y0 must be a real, finite state"),
        ({"y0": []}, "y0 must be a real, finite state"),
        ({"y0": 1.0}, "y0 must be a real, finite state"),
        ({"degree": 0}, "degree"),
        ({"degree": 200}, "2 components make 20300 functions, monomials up to degree 200 and terms; at most 2000"),
        ({"rtol": 0.0}, "rtol must be a number between 0 and 1, got"),
        ({"rtol": "a"}, "rtol must be a number between 0 and 1, got"),
        ({"t": np.inf}, "t must be a finite number, got"),
        ({"terms": [np.log]}, "must be a pair of functions"),
        ({"terms": {"log": np.log}}, "terms\\['log'\\] must be a pair of functions"),
        ({"fun": lambda t, y: y[:1]}, "fun returned shape"),
    ],
)
def test_wrong_arguments(options, says):
    with pytest.raises(ValueError, match=says):
        find_invariants(**({"fun": lotka_volterra, "y0": [1.0, 0.5]} | options))
