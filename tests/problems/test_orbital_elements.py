"""Osculating elements: against REBOUND's own, in degenerate cases, and of whole runs."""

import numpy as np
import pytest

from eip_scipy import EIPRKN12, integrate, load
from eip_scipy.problems import kepler, nbody, orbital_elements, solar_system

ANGLES = ("Omega", "omega", "pomega", "f", "M", "theta", "l")
LENGTHS = ("a", "e", "inc", "n", "P")
EPS = np.finfo(float).eps


def turned(difference):
    """Return a difference of angles, without whole turns."""
    return np.abs((difference + np.pi) % (2 * np.pi) - np.pi)


def state(sim):
    q, v = np.empty((sim.N, 3)), np.empty((sim.N, 3))
    sim.serialize_particle_data(xyz=q, vxvyvz=v)
    return np.concatenate([q, v], axis=None)


def both(sim, primary="heliocentric"):
    """Return our elements of a simulation and REBOUND's, the latter by name."""
    own = orbital_elements(state(sim), [sim.G * p.m for p in sim.particles], primary=primary)
    theirs = sim.orbits(primary=sim.particles[0]) if primary == "heliocentric" else sim.orbits()
    return own, {name: np.array([getattr(orbit, name) for orbit in theirs]) for name in (*ANGLES, *LENGTHS)}


def simulation(orbits, m=0.0):
    rebound = pytest.importorskip("rebound")
    sim = rebound.Simulation()
    sim.G = 4 * np.pi**2
    sim.add(m=1.0)
    for orbit in orbits:
        sim.add(m=m, primary=sim.particles[0], **orbit)
    return sim


def random_orbits(hyperbolic, count=40):
    rng = np.random.default_rng(7)
    for k in range(count):
        shape = (
            {"a": -1.0 - k, "e": rng.uniform(1.1, 3)} if hyperbolic else {"a": 1.0 + k, "e": rng.uniform(0.02, 0.95)}
        )
        f = rng.uniform(-1, 1) if hyperbolic else rng.uniform(0, 7)
        yield shape | {"inc": rng.uniform(0.1, 3), "Omega": rng.uniform(0, 7), "omega": rng.uniform(0, 7), "f": f}


@pytest.mark.parametrize("primary", ["heliocentric", "jacobi"])
@pytest.mark.parametrize("hyperbolic", [False, True])
def test_generic_orbits_are_those_of_rebound(primary, hyperbolic):
    own, theirs = both(simulation(random_orbits(hyperbolic), m=1e-4), primary)
    for name in LENGTHS:
        np.testing.assert_allclose(getattr(own, name), theirs[name], rtol=200 * EPS)
    for name in ANGLES:  # REBOUND's arc cosines lose digits near 0 and pi
        assert turned(getattr(own, name) - theirs[name]).max() < 1e-13, name


FLAT, ROUND = ("pomega", "f", "M", "theta", "l"), ("Omega", "theta", "l")
DEGENERATE = [
    ({"e": 0.2, "inc": 0.0, "pomega": 1.0, "f": 2.0}, ANGLES),
    ({"e": 0.2, "inc": np.pi, "omega": 1.0, "f": 2.0}, ANGLES),
    ({"e": 0.2, "inc": 1e-9, "Omega": 1.0, "omega": 2.0, "f": 3.0}, FLAT),
    ({"e": 0.2, "inc": 1e-6, "Omega": 1.0, "omega": 2.0, "f": 3.0}, FLAT),
    ({"e": 0.0, "inc": 0.3, "Omega": 1.0, "f": 2.0}, ROUND),
    ({"e": 0.0, "inc": 0.0, "f": 2.0}, ("theta", "l")),
    ({"e": 1e-10, "inc": 2.5, "Omega": 1.0, "omega": 1.0, "f": 2.0}, ROUND),
    ({"e": 1 - 1e-9, "inc": 0.5, "Omega": 1.0, "omega": 2.0, "f": 2.0}, ("Omega", "omega", "pomega", "f", "theta")),
]


def test_degenerate_orbits_are_those_of_rebound():
    for orbit, names in DEGENERATE:
        own, theirs = both(simulation([{"a": 2.0} | orbit]))
        for name in ("a", "n", "P"):  # of nearly parabolic ones round-off divided by 1 - e
            np.testing.assert_allclose(getattr(own, name), theirs[name], rtol=20 * EPS / (1 - orbit["e"]))
        assert abs(own.e[0] - orbit["e"]) < 1e-14
        for name in names:
            assert turned(getattr(own, name) - theirs[name]).max() < 1e-13, name


def one(*relative):
    """Return the elements of a test particle at this relative position and velocity."""
    return orbital_elements([0, 0, 0, *relative[:3], 0, 0, 0, *relative[3:]], [1.0, 0.0])[0]


@pytest.mark.parametrize("e", [0.0, 1e-17, 1e-12, 0.05, 0.3, 0.999999])
def test_sums_of_angles_hold_where_each_is_undefined(e):
    """theta from the position alone; and theta, l, M, f belong to one eccentricity."""
    for inc in (0.0, 1e-12, 0.4, np.pi):
        speed = np.sqrt((1 + e) / (1 - e))
        found = one(1 - e, 0, 0, 0, np.cos(inc) * speed, np.sin(inc) * speed)
        assert turned(found.theta) < 1e-15
        assert turned(found.l - found.theta) < 4 * e + 1e-15
        assert found.a == pytest.approx(1.0, rel=4 * EPS / (1 - e))
        assert turned(found.M - found.f) <= 1e-13
        turns = 1 if inc < 2 else -1
        assert turned(found.theta - (found.Omega + turns * (found.omega + found.f))) < 1e-14


def test_parabola_and_straight_line():
    parabola, falling = one(2, 0, 0, 0, 1, 0), one(0, 2, 0, 0, 0, 0)  # the latter from rest: at the apocentre
    assert (parabola.e, abs(parabola.a), parabola.n) == (1.0, np.inf, 0.0)
    assert np.isnan(parabola.M)
    assert (falling.a, falling.e, falling.theta) == (1.0, 1.0, np.pi / 2)
    assert pytest.approx(np.pi) == falling.M


def test_mean_anomaly_grows_with_time():
    """The mean anomaly of a hyperbola grows too, through its pericentre: n (t - T)."""
    q, v = [[0, 0, 0], [3, 4, 0]], [[0, 0, 0], [-6, 0.3, 1.0]]
    problem = nbody([4 * np.pi**2, 0.0], q, v, t_span=(0, 2), h=2e-3)
    found = orbital_elements(integrate(problem, method=EIPRKN12, save_every=10))["1"]
    assert found.e[0] > 1
    assert found.M[0] < 0 < found.M[-1]
    np.testing.assert_allclose(found.M - found.M[0], -found.n[0] * found.t, atol=1e-9)
    np.testing.assert_allclose(found.a, found.a[0], rtol=1e-10)


def test_a_run_at_once_and_loaded(tmp_path):
    problem = solar_system(years=5)
    run = integrate(problem, method=EIPRKN12, h=0.02, save_every=25)
    found = orbital_elements(run)
    assert found.bodies == ("Mercury", "Venus", "EMB", "Mars", "Jupiter", "Saturn", "Uranus", "Neptune", "Pluto")
    assert found.a.shape == (9, run.t.size)
    np.testing.assert_array_equal(found.t, run.t)
    for k in (0, 3):
        at_once = orbital_elements(run.y[:, k], problem.params)
        for name in (*LENGTHS, *ANGLES):
            np.testing.assert_array_equal(getattr(found, name)[:, k], getattr(at_once, name))
    np.testing.assert_array_equal(orbital_elements(problem).a, found.a[:, 0])
    np.testing.assert_array_equal(found["Jupiter"].e, found.e[4])
    assert found["Jupiter"].bodies == ("Jupiter",)
    with pytest.raises(KeyError, match=r"no orbit of 'Earth'; the bodies with orbits are Mercury, .*"):
        found["Earth"]
    run.save(tmp_path / "run.npz")
    again = load(tmp_path / "run.npz")
    np.testing.assert_array_equal(orbital_elements(again, problem.params).a, found.a)
    with pytest.raises(TypeError, match="does not contain the masses"):
        orbital_elements(again)
    heavier = integrate(problem, (0, 0.1), method=EIPRKN12, h=0.01, params=2 * problem.params, check=False)
    assert orbital_elements(heavier).a[0, 0] != found.a[0, 0]


def test_primaries():
    problem = solar_system("de440-moon", years=1)
    moon = orbital_elements(problem, primary="Earth")["Moon"]
    assert pytest.approx(27.3 / 365.25, rel=0.02) == moon.P
    assert moon.bodies == ("Moon",)
    sun = orbital_elements(problem, primary="heliocentric")
    np.testing.assert_array_equal(sun.a, orbital_elements(problem, primary=0).a)
    assert "Sun" not in sun.bodies
    centre = orbital_elements(problem, primary="barycentric")
    assert centre.bodies[0] == "Sun"
    pluto, total = centre["Pluto"], problem.params.sum() + problem.params[-1]
    q, v = problem.y0.reshape(2, -1, 3)[:, -1]  # the centre of mass is at rest at the origin
    assert pluto.a == pytest.approx(1 / (2 / np.linalg.norm(q) - v @ v / total), rel=1e-12)


def test_bad_input_is_named():
    for arguments, primary, error, message in [
        ((np.ones(12),), 0, TypeError, "states alone have no masses; give gm"),
        ((kepler(),), 0, TypeError, "expected a problem of bodies"),
        ((np.ones(11), [1, 0]), 0, ValueError, r"gm has the shape \(2,\) and the states \(11,\)"),
        ((np.ones(6), [1]), 0, ValueError, r"expected \(N,\) with N > 1"),
        ((np.ones(12), [0, 1]), "jacobi", ValueError, "needs a first body with a mass"),
        ((np.ones(12), [1, 0]), 1, ValueError, "primary '1' has no mass"),
        ((np.ones(12), [1, 0]), "sun", ValueError, "unknown primary 'sun'.*'jacobi'"),
        ((np.ones(12), [1, 0]), -1, ValueError, "number from 0 to 1"),
    ]:
        with pytest.raises(error, match=message):
            orbital_elements(*arguments, primary=primary)
