"""`find_invariants`: a table of known systems, three properties of random ones, and a table of wrong arguments."""

import math
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eip_scipy import EIPRK4, check_gradient, find_invariants, hamiltonian, integrate
from eip_scipy.problems import kepler as kepler_problem

E = np.eye(6)


def kepler(t, y, gm=1.0):
    r3 = np.hypot(y[0], y[1]) ** 3
    return np.array([y[2], y[3], -gm * y[0] / r3, -gm * y[1] / r3])


def inverse_radius(y):
    return 1 / np.hypot(y[0], y[1])


def inverse_radius_gradient(y):
    return np.array([-y[0], -y[1], 0.0, 0.0]) * inverse_radius(y) ** 3


def cosine(y):
    return y[0] * inverse_radius(y)


def cosine_gradient(y):
    return np.array([y[1] ** 2, -y[0] * y[1], 0.0, 0.0]) * inverse_radius(y) ** 3


def log(k, n=2, factor=1.0):
    """The logarithm of a component, with its gradient times a factor."""
    return lambda y, k=k: np.log(y[k]), lambda y, k=k: factor * np.eye(n)[k] / y[k]


def sir(beta=2.0, gamma=0.5):
    return lambda t, y: y[1] * np.array([-beta * y[0], beta * y[0] - gamma, gamma])


def top(inertia, centre):
    def f(t, y):
        m, gamma = y[:3], y[3:]
        return np.concatenate([np.cross(m, m / inertia) + np.cross(gamma, centre), np.cross(gamma, m / inertia)])

    return f


def forced(force, damping=0.0):
    """q'' = force(t, q) - damping q'."""

    def f(t, y):
        q, v = np.split(y, 2)
        return np.concatenate([v, force(t, q) - damping * v])

    return f


def henon_heiles(b, c):
    return forced(lambda t, q: -np.array([q[0] + 2 * q[0] * q[1], b * q[1] + q[0] ** 2 + c * q[1] ** 2]))


def volterra(a, b, c, d):
    return lambda t, y: np.array([y[0] * (a - b * y[1]), y[1] * (c * y[0] - d)])


SHARED = np.empty(2)


def in_one_array(f):
    """f, but each call of each such function returns the same array."""
    return lambda *args: np.copyto(SHARED, f(*args)) or SHARED


K = np.array([[-2.0, 1.0], [1.0, -2.0]])
LOGS = {"log(y0)": log(0), "log(y1)": log(1)}
REUSED = {name: (g, in_one_array(grad)) for name, (g, grad) in LOGS.items()}
NO_USE = {  # kinks, logarithms of negative numbers, roundings
    "|x|": (lambda y: abs(y[0]), lambda y: np.array([np.sign(y[0]), 0.0])),
    "log(x)": (lambda y: math.log(y[0]), lambda y: np.array([1 / y[0], 0.0])),
    "big": (lambda y: 1e12 + y[1], lambda y: np.array([0.0, 1.0])),
}
KNOWN_ALREADY = {
    "square": (lambda y: y[0] ** 2 + y[1], lambda y: np.array([2 * y[0], 1.0, 0.0, 0.0])),
    "three": (lambda y: 3.0, lambda y: np.zeros(4)),
    "L": (lambda y: y[0] * y[3] - y[1] * y[2], lambda y: np.array([y[3], -y[2], -y[1], y[0]])),
}
PLANET, SPINNING = [1.0, 0.0, 0.0, 1.2], [1.0, 0.2, 0.3, 0.1, 0.2, 0.9]
ELLIPSE = [(inverse_radius, inverse_radius_gradient), (cosine, cosine_gradient)]
L, CIRCLE = "y0*y3 - y1*y2", "y0**2 + y1**2"
# What is searched: function, start, options; and the names of all that is found.
TABLE = {
    "Kepler": (kepler, PLANET, {}, [L]),
    "Kepler, SI": (lambda t, y: kepler(t, y, 1.327e20), [1.496e11, 0.0, 0.0, 2.98e4], {}, [L]),
    "Kepler, terms": (kepler, PLANET, {"degree": 3, "terms": ELLIPSE},
                      [L, "y2**2 + y3**2 - 2*inverse_radius(y)", "y0*y3**2 - y1*y2*y3 - cosine(y)"]),
    "terms known already": (kepler, PLANET, {"terms": KNOWN_ALREADY}, [L]),
    "names of a problem": (hamiltonian("(px**2 + py**2)/2 - 1/sqrt(x**2 + y**2)"), PLANET, {}, ["x*py - y*px"]),
    "names of Kepler's": (kepler_problem(), kepler_problem().y0, {}, ["x*vy - y*vx"]),
    "rigid body": (lambda t, m: np.cross(m, m / [1, 2, 3]), [1.0, 0.2, 0.3], {"degree": 4},
                   ["3*y0**2 - y2**2", "3*y1**2 + 4*y2**2"]),
    "Lagrange's top": (top([1, 1, 0.5], E[2, :3]), SPINNING, {},
                       ["y2", "2*y5 + y0**2 + y1**2", "y3**2 + y4**2 + y5**2", "y0*y3 + y1*y4 + y2*y5"]),
    "equal oscillators": (forced(lambda t, q: -q), [1.0, 0.0, 0.0, 0.5], {}, [L, "y0**2 + y2**2", "y1**2 + y3**2"]),
    "coupled quartic": (forced(lambda t, q: -(q**3) - 2 * q * q[::-1] ** 2), [1.0, 0.5, 0.0, 0.0], {"degree": 4},
                        ["2*y2**2 + 2*y3**2 + y0**4 + 4*y0**2*y1**2 + y1**4"]),
    "Henon and Heiles, Sawada and Kotera's": (henon_heiles(1, 1), [0.1, 0.2, 0.3, 0.1], {"degree": 3},
        ["3*y0*y1 + 3*y2*y3 + y0**3 + 3*y0*y1**2", "3*y0**2 + 3*y1**2 + 3*y2**2 + 3*y3**2 + 6*y0**2*y1 + 2*y1**3"]),
    "Henon and Heiles, Korteweg and de Vries'": (henon_heiles(4, 6), [0.1, 0.2, 0.3, 0.1], {"degree": 4},
        ["y0**2 + 4*y1**2 + y2**2 + y3**2 + 2*y0**2*y1 + 4*y1**3", "2*y0**2 + 8*y1**2 + 2*y2**2 + 2*y3**2 - 4*y0*y2*y3 "
         "+ 8*y1**3 + 4*y1*y2**2 - y0**4 - 4*y0**2*y1**2"]),
    "Toda, three particles": (lambda t, y: np.append(y[:3] * (np.roll(y[3:], -1) - y[3:]),
                                                     2 * (y[:3] ** 2 - np.roll(y[:3], 1) ** 2)),
        SPINNING, {"degree": 3}, ["y3 + y4 + y5", "2*y0**2 + 2*y1**2 + 2*y2**2 + y3**2 + y4**2 + y5**2", "y0*y1*y2",
        "3*y0**2*y3 + 3*y0**2*y4 + 3*y1**2*y4 + 3*y1**2*y5 + 3*y2**2*y3 + 3*y2**2*y5 + y3**3 + y4**3 + y5**3"]),
    "Nose and Hoover": (lambda t, y: np.array([y[1], -y[0] - y[2] * y[1], y[1] ** 2 - 1, y[2] * y[3]]),
        [1.0, 0.2, 0.1, 1.0], {"terms": {"log(s)": log(3, 4)}}, ["y0**2 + y1**2 + y2**2 + 2*log(s)"]),
    "Volterra": (volterra(2 / 3, 4 / 3, 1, 1), [1.0, 0.5], {"terms": LOGS}, ["3*y0 + 4*y1 - 3*log(y0) - 2*log(y1)"]),
    "Volterra, far": (volterra(1.1, 0.4, 0.1, 0.4), [400.0, 1.0], {"terms": LOGS},
                      ["y0 + 4*y1 - 4*log(y0) - 11*log(y1)"]),
    "Volterra, one array": (in_one_array(volterra(2 / 3, 4 / 3, 1, 1)), [1.0, 0.5],
                            {"terms": REUSED}, ["3*y0 + 4*y1 - 3*log(y0) - 2*log(y1)"]),
    "Volterra, polynomials": (volterra(2 / 3, 4 / 3, 1, 1), [1.0, 0.5], {"degree": 4}, []),
    "SIR": (sir(), [0.99, 0.01, 0.0], {"terms": {"log(S)": log(0, 3)}}, ["y0 + y1 + y2", "4*y2 + log(S)"]),
    "SIR, hardly infected": (sir(0.5, 0.1), [1 - 1e-5, 1e-5, 0.0], {"degree": 1, "terms": {"log S": log(0, 3)}},
                             ["y0 + y1 + y2", "5*y2 + log S"]),
    "SIR, a million": (sir(0.5e-6, 0.1), [0.99e6, 0.01e6, 0.0], {"degree": 1, "terms": {"log S": log(0, 3)}},
                       ["y0 + y1 + y2", "y2 + 200000*log S"]),
    "SIR, slow recovery": (sir(2.0, 1e-8), [0.99, 0.01, 0.5], {"degree": 1}, ["y0 + y1 + y2"]),
    "terms of no use": (forced(lambda t, q: -q), [1e-3, 1.0], {"terms": NO_USE}, [CIRCLE]),
    "breathing trap": (forced(lambda t, q: -(1 + 0.3 * np.cos(t)) * q), [1.0, 0.0, 0.0, 1.0], {"degree": 4}, [L]),
    "at rest": (forced(lambda t, q: -q), [0.0, 0.0], {}, [CIRCLE]),
    "at rest, ramped": (forced(lambda t, q: np.array([0.1 * t, 0.0])), np.zeros(4), {}, ["y3"]),
    "still at t = 0": (lambda t, y: np.array([y[1], -y[0]]) * t, [0.0, 1.0], {}, [CIRCLE]),
    "nothing moves": (lambda t, y: 0 * y, [1.0, 2.0], {}, ["y0", "y1"]),
    "one does not move": (lambda t, y: np.array([-y[0] * y[1], 0.0]), [1.0, 2.0], {"degree": 3}, ["y1"]),
    "defined nearby": (lambda t, y: np.array([math.sqrt(y[0] - 0.8), 0.0]), [1.0, 2.0], {}, ["y1"]),
    "ends soon": (lambda t, y: np.array([y[1], -y[0]]) if t <= 1e-3 else [np.nan] * 2, [0.0, 0.0], {}, [CIRCLE]),
    "ends soon, driven": (lambda t, y: np.array([y[1], t - y[0]]) if t <= 1e-3 else [np.nan] * 2, [0.0, 0.0], {}, []),
    "infinite term": (lambda t, y: np.array([1.0, y[1]]), [1.0, 0.0], {"terms": {"log(y1)": log(1)}}, ["y0 - log(y1)"]),
    "infinite term, kept for y1 < 5": (lambda t, y: np.array([1.0 + (y[1] > 5.0), y[1]]), [1.0, 0.0],
                                       {"terms": {"log(y1)": log(1)}}, []),
    "driven": (forced(lambda t, q: -q + np.sin(2 * t)), [0.0, 0.0], {}, []),
    "driven late": (forced(lambda t, q: -q + (t > 30.0)), [1.0, 0.0], {}, []),
    "driven very late": (lambda t, y: np.array([y[1], y[0] ** 2]) * (t > 1e6), [1.0, 1.0], {}, []),
    "driven weakly": (lambda t, y: 1e-12 * np.array([y[1], -y[0] + t]) * t, [1.0, 0.0], {}, []),
    "driven near the start": (lambda t, y: np.array([y[1], -1.0]) * t + 0 * np.sqrt(0.01 - y @ y), [0.0, 0.0],
                              {"degree": 1}, []),
    "unstable equilibrium": (lambda t, y: np.array([y[0], float(abs(y[0]) > 4.0)]), [0.0, 1.0], {}, []),
    "friction above a speed": (lambda t, y: np.array([y[1], -y[0] - 0.1 * y[1] * (abs(y[1]) > 1.3)]), [1.0, 0.0],
                               {}, []),
    "jump on the way": (lambda t, y: np.array([float(400 * y[1] >= 1000.0), 1.0]), [1.0, 0.0], {"seed": 1}, []),
    "high degree": (forced(lambda t, q: -np.sin(q), 0.01), [1.0, 0.0], {"degree": 8}, []),
}  # fmt: skip


@pytest.mark.parametrize("case", TABLE)
def test_known_systems(case):
    fun, y0, options, names = TABLE[case]
    assert [item.name for item in find_invariants(fun, y0, **options)] == names


# Properties of random systems y' = S grad H(y), with an antisymmetric matrix S, and H a polynomial.

seeds = st.integers(0, 2**32 - 1)


def random_hamiltonian(seed, degree):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 5)) if degree == 2 else 2
    powers = np.array([p for p in np.ndindex(*[degree + 1] * n) if 0 < sum(p) <= degree])
    coefficients = rng.integers(-3, 4, len(powers))
    coefficients[[0, -1]] = 1

    def grad(y):
        factors = y ** np.maximum(powers[:, None] - np.eye(n, dtype=int), 0)
        return coefficients @ (powers * factors.prod(axis=2))

    S = rng.normal(size=(n, n))
    return grad, S - S.T, rng.normal(size=n)


@settings(max_examples=10)
@given(seeds, st.sampled_from([2, 3, 4]))
def test_the_energy_of_a_random_system_is_found_with_its_gradient(seed, degree):
    grad, S, y0 = random_hamiltonian(seed, degree)
    found = find_invariants(lambda t, y: S @ grad(y), y0, degree=degree)
    for y in y0 + 0.3 * np.random.default_rng(seed).normal(size=(3, y0.size)):
        rows = np.array([item.grad(0.0, y) for item in found])
        assert rows.T @ np.linalg.lstsq(rows.T, grad(y))[0] == pytest.approx(grad(y), rel=1e-7, abs=1e-7)
        assert all(check_gradient(item, 0.0, y) < 1e-8 for item in found)


@settings(max_examples=25)
@given(seeds, st.sampled_from([2, 3, 4]), st.integers(1, 11))
def test_the_slightest_damping_is_seen(seed, degree, power):
    """Energy is lost at a rate down to 1e-11 of what flows."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 3))
    stiffness = rng.normal(size=(n, n))
    force = (lambda q: 0 * q, lambda q: q**3, np.sin)[seed % 3]
    f = forced(lambda t, q: -(stiffness @ stiffness.T + np.eye(n)) @ q - force(q), 10.0**-power)
    assert find_invariants(f, rng.normal(size=2 * n), degree=degree) == []


@settings(max_examples=20)
@given(seeds, st.integers(0, 4))
def test_nothing_is_found_where_nothing_is_conserved(seed, kind):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 6))
    A, B, c = rng.normal(size=(n, n)), rng.normal(size=(n, n, n)), rng.normal(size=n)
    fields = (
        lambda t, y: A @ y + np.einsum("ijk,j,k->i", B, y, y),
        lambda t, y: np.sin(A @ y + c),
        lambda t, y: A @ y + c * np.cos(t) + 0.3,
        lambda t, y: A @ y / (1 + y @ y) + c,
        lambda t, y: y * (c + A @ y),
    )
    assert find_invariants(fields[kind], rng.normal(size=n), degree=3) == []


@pytest.mark.parametrize("power", [2, 3, 6, 9])
def test_a_force_that_is_a_power(power):
    """All terms of the energy's rate vanish where y does."""
    (found,) = find_invariants(forced(lambda t, q: -(q**power)), [0.3, 0.7], degree=power + 1)
    gradient = found.grad(0.0, np.array([0.7, -1.1]))
    np.testing.assert_allclose(gradient / gradient[1], [0.7**power / -1.1, 1.0], rtol=1e-12)
    assert find_invariants(forced(lambda t, q: -(q**power), 1e-11), [1.0, 0.0], degree=power + 1) == []


def test_they_serve_a_run_and_can_be_pickled():
    start, y = [1.0, 0.0, 0.0, 0.5], np.array([0.3, -0.7, 0.2, 0.9])
    found = find_invariants(forced(lambda t, q: K @ q), start)
    run = integrate(forced(lambda t, q: K @ q), (0, 20), start, method=EIPRK4, h=0.05, invariants=found)
    assert run.trusted
    assert (run.max_residual < 1e-13).all()
    for item in found + find_invariants(kepler, PLANET, terms=ELLIPSE[:1]):
        again = pickle.loads(pickle.dumps(item))
        assert (again.name, again.fun(0.0, y)) == (item.name, item.fun(0.0, y))
        np.testing.assert_array_equal(again.grad(0.0, y), item.grad(0.0, y))


def nowhere(t, y):
    if y.tolist() == [1.0, 2.0]:
        return np.array([1.0, 0.0])
    raise ZeroDivisionError("nowhere")


WRONG = [
    *(({"y0": y0}, "y0 must be a real, finite state") for y0 in ([1.0, np.nan], [1j, 0.0], [], 1.0)),
    ({"degree": 0}, "degree"),
    ({"degree": 200}, "2 components make 20300 functions, monomials up to degree 200 and terms; at most 2000"),
    *(({"rtol": rtol}, "rtol must be a number between 0 and 1, got") for rtol in (0.0, "a")),
    ({"t": np.inf}, "t must be a finite number, got"),
    ({"terms": [np.log]}, r"terms\[0\] must be a pair of functions"),
    ({"terms": {"log": np.log}}, r"terms\['log'\] must be a pair of functions"),
    *(({"terms": {"log": log(0, factor=factor)}}, "function of the term 'log' is not the gradient of the first")
      for factor in (1.0001, -1.0)),
    ({"fun": lambda t, y: y[:1]}, "fun returned shape"),
    *(({"fun": lambda t, y, v=v: [v, 1.0]}, r"fun\(t, y0\) is .*(nan|inf).*, expected finite")
      for v in (np.nan, np.inf)),
    ({"fun": nowhere, "y0": [1.0, 2.0]}, "finite at fewer than 25 % of the random points around y0"),
    ({"fun": nowhere, "y0": [1.0, 1.0]}, r"fun\(t, y0\) raised ZeroDivisionError, expected finite"),
]  # fmt: skip


@pytest.mark.parametrize(("options", "says"), WRONG)
def test_wrong_arguments(options, says):
    with pytest.raises(ValueError, match=says) as error:
        find_invariants(**({"fun": volterra(2 / 3, 4 / 3, 1, 1), "y0": [1.0, 0.5]} | options))
    assert options.get("fun") is not nowhere or isinstance(error.value.__cause__, ZeroDivisionError)
