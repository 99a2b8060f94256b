"""The sums over pairs of N point masses: accuracy, symmetry, and the same bits by all ways to call them."""

import os
import subprocess
import sys
from itertools import combinations

import mpmath
import numpy as np
import pytest

from eip_scipy import EIPGJ12, EIPGJ14, EIPRKN12, integrate
from eip_scipy.engine.native import library
from eip_scipy.problems import nbody
from eip_scipy.problems.gravity import orbits

rhs, acc = library["gravity.rhs"], library["gravity.acc"]
energy, energy_gradient = library["gravity.energy"], library["gravity.energy_gradient"]
momentum, momentum_gradient = library["gravity.momentum"], library["gravity.momentum_gradient"]

ROUNDING = np.finfo(float).eps / 2
SIZES = [1, 2, 3, 4, 5, 7, 8, 9, 10, 11, 12, 13, 16, 17, 30, 100]
MANY = 128  # the least number of bodies for sums in which each pair is taken once, by several threads


def bodies(n, seed=0):
    """Return random masses, over six powers of ten, and a random state."""
    rng = np.random.default_rng([n, seed])
    return 10.0 ** rng.uniform(-6, 0, n), rng.standard_normal(6 * n)


def accelerations(gm, y):
    out = np.full(y.size, np.nan)
    rhs(0.0, y, out, gm)
    np.testing.assert_array_equal(out[: y.size // 2], y[y.size // 2 :])
    return out[y.size // 2 :].reshape(-1, 3)


def exact_sums(gm, y):
    """Return accelerations, the sums of their terms' sizes, and the energy with that of its terms, in 40 digits."""
    n = gm.size
    with mpmath.workdps(40):
        m = [mpmath.mpf(x) for x in gm]
        q, v = ([[mpmath.mpf(x) for x in row] for row in part] for part in y.reshape(2, n, 3))
        a, size = [[mpmath.mpf(0)] * 3 for _ in m], np.zeros((n, 3))
        kinetic = sum(mi * sum(x * x for x in row) for mi, row in zip(m, v, strict=True)) / 2
        potential = mpmath.mpf(0)
        for i, j in combinations(range(n), 2):
            d = [x - z for x, z in zip(q[j], q[i], strict=True)]
            r = mpmath.sqrt(sum(x * x for x in d))
            potential += m[i] * m[j] / r
            for c in range(3):
                a[i][c] += m[j] * d[c] / r**3
                a[j][c] -= m[i] * d[c] / r**3
                size[i, c] += abs(m[j] * d[c] / r**3)
                size[j, c] += abs(m[i] * d[c] / r**3)
        return a, size, kinetic - potential, float(kinetic + potential)


def check_against_exact(gm, y):
    a, size, exact, energy_size = exact_sums(gm, y)
    found = accelerations(gm, y)
    # One pull is right to about 7 roundings (the old pair loop: 8), the sum of N grows like a random walk.
    bound = (7 + np.sqrt(gm.size)) * ROUNDING * size
    error = [float(mpmath.fsub(x, z, exact=True)) for x, z in zip(found.flat, np.array(a).flat, strict=True)]
    assert (np.abs(error) <= bound.ravel()).all()
    error = float(mpmath.fsub(energy(0.0, y, gm), exact, exact=True))
    # From 8 bodies on, rounding errors of the sum are carried along.
    assert abs(error) <= (3 if gm.size >= 8 else 4 + np.sqrt(gm.size)) * ROUNDING * energy_size


@pytest.mark.parametrize("n", [*SIZES[:-1], pytest.param(100, marks=[pytest.mark.nightly, pytest.mark.slow])])
def test_accuracy(n):
    check_against_exact(*bodies(n))


@pytest.mark.parametrize("n", [2, 3, 7, 10, 17])
def test_close_pairs(n):
    gm, y = bodies(n)
    y[3:6] = y[:3] + 1e-9 * y[3:6]
    if n > 6:
        y[3 * n - 3 : 3 * n] = y[6:9] * (1 + 4e-16)
        y[3 * n - 3] += 1e-13
    check_against_exact(gm, y)


@pytest.mark.parametrize("n", [2, 3, 7, 10, 17])
def test_test_particles(n):
    gm, y = bodies(n)
    gm[1::2] = 0.0
    check_against_exact(gm, y)
    # They are attracted and do not attract.
    assert (accelerations(gm, y)[1] != 0).all()
    if n > 3:
        massive = np.repeat(gm > 0, 3)
        np.testing.assert_allclose(
            accelerations(gm, y)[gm > 0], accelerations(gm[gm > 0], y[np.tile(massive, 2)]), rtol=0, atol=1e-12
        )


@pytest.mark.parametrize("n", [*SIZES, MANY, MANY + 5])
def test_action_is_reaction(n):
    """Between two bodies of one mass among test particles, bit for bit, in whichever lanes or places they are."""
    _, y = bodies(n)
    far = [(0, 1), (2, n - 1), (12, 13), (20, 27), (20, 28), (20, 60), (40, n - 2), (n - 2, n - 1)]
    for i, j in combinations(range(min(n, 17)), 2) if n < MANY else far:
        gm = np.zeros(n)
        gm[[i, j]] = 0.7
        a = accelerations(gm, y)
        np.testing.assert_array_equal(a[i], -a[j])
        assert (a[i] != 0).all()


@pytest.mark.parametrize(("n", "seeds"), [(10, 200), (MANY, 1), (MANY + 5, 1), (300, 1)])
def test_momentum_is_kept_to_rounding(n, seeds):
    worst = 0.0
    for seed in range(seeds):
        gm, y = bodies(n, seed)
        forces = gm[:, None] * accelerations(gm, y)
        worst = max(worst, np.abs(forces.sum(axis=0)).max() / np.abs(forces).sum())
    assert worst < 4 * ROUNDING


@pytest.mark.parametrize("n", [2, 7, 8, 10, 30, MANY + 3])
@pytest.mark.parametrize("power", [-150, -30, 1, 37, 150])
def test_units_of_powers_of_two_change_no_bit(n, power):
    gm, y = bodies(n)
    factor = 2.0**power
    one, other = accelerations(gm, y), accelerations(gm, y * factor)
    np.testing.assert_array_equal(one, other * factor**2)
    half = y.size // 2
    still = np.concatenate([y[:half], np.zeros(half)])
    assert energy(0.0, still, gm) == energy(0.0, still * factor, gm) * factor


@pytest.mark.slow
@pytest.mark.parametrize("n", [2, 5, 8, 10, 11, 13])
def test_strided_arrays(n):
    gm, y = bodies(n)
    wide, wide_gm, out = np.zeros((6 * n, 3)), np.zeros((n, 2)), np.zeros((6 * n, 2))
    wide[:, 1], wide_gm[:, 0] = y, gm
    rhs(0.0, wide[:, 1], out[:, 1], wide_gm[:, 0])
    np.testing.assert_array_equal(out[3 * n :, 1].reshape(-1, 3), accelerations(gm, y))
    np.testing.assert_array_equal(out[:, 0], 0.0)
    np.testing.assert_array_equal(acc(0.0, wide[: 3 * n, 1], gm), accelerations(gm, y).ravel())
    assert energy(0.0, wide[:, 1], gm) == energy(0.0, y, gm)
    np.testing.assert_array_equal(momentum(0.0, wide[:, 1], gm), momentum(0.0, y, gm))


@pytest.mark.parametrize("n", [1, 2, 7, 8, 10, 17])
def test_nothing_is_written_outside(n):
    gm, y = bodies(n)
    frame = np.full(6 * n + 20, 7.0)
    rhs(0.0, y, frame[10:-10], gm)
    assert (frame[:10] == 7.0).all()
    assert (frame[-10:] == 7.0).all()
    assert np.isfinite(frame).all()


@pytest.mark.parametrize("n", [1, 2, 3, 8, 10])
def test_gradients(n):
    gm, y = bodies(n)
    f, grad, grads = np.empty(6 * n), np.empty(6 * n), np.empty((3, 6 * n))
    rhs(0.0, y, f, gm)
    energy_gradient(0.0, y, f, grad, gm)
    momentum_gradient(0.0, y, grads, gm)
    q, v = y.reshape(2, n, 3)
    np.testing.assert_allclose(momentum(0.0, y, gm), gm @ np.cross(q, v), rtol=0, atol=1e-14)
    step = 1e-6 * np.random.default_rng(3).standard_normal(6 * n)
    ahead, back = ((energy(0.0, z, gm), np.array(momentum(0.0, z, gm))) for z in (y + step, y - step))
    assert grad @ step == pytest.approx((ahead[0] - back[0]) / 2, rel=1e-4, abs=1e-14)
    np.testing.assert_allclose(grads @ step, (ahead[1] - back[1]) / 2, rtol=0, atol=1e-14)


@pytest.mark.needs_jit
@pytest.mark.parametrize(("n", "pair"), [(2, [0, 1]), (5, [0, 4]), (10, [0, 9]), (MANY + 2, [20, MANY])])
def test_bodies_at_one_place_are_not_finite(n, pair):
    gm, y = bodies(n)
    q = y[: 3 * n].reshape(n, 3)
    q[pair[1]] = q[pair[0]]
    a = accelerations(gm, y)
    assert not np.isfinite(a[pair]).any()
    assert np.isfinite(np.delete(a, pair, axis=0)).all()
    assert not np.isfinite(energy(0.0, y, gm))


PRINT = """
import numpy as np
from eip_scipy.engine.native import library
for n in %r:
    rng = np.random.default_rng([n, 0])
    gm, y, out = 10.0 ** rng.uniform(-6, 0, n), rng.standard_normal(6 * n), np.empty(6 * n)
    library["gravity.rhs"](0.0, y, out, gm)
    print(*(x.hex() for x in out[3 * n :].tolist()), library["gravity.energy"](0.0, y, gm).hex())
"""


def test_the_same_bits_from_the_build_for_every_processor():
    run = subprocess.run(
        [sys.executable, "-c", PRINT % SIZES],
        env=os.environ | {"EIP_SCIPY_ENGINE": "_native"},
        capture_output=True,
        text=True,
        check=True,
    )
    for n, line in zip(SIZES, run.stdout.splitlines(), strict=True):
        gm, y = bodies(n)
        found = [float.fromhex(x) for x in line.split()]
        np.testing.assert_array_equal(np.reshape(found[:-1], (-1, 3)), accelerations(gm, y))
        assert found[-1] == energy(0.0, y, gm)


def test_arguments_are_converted_or_refused():
    gm, y = bodies(10)
    out, single = np.empty(60), y.astype(np.float32)
    rhs(0.0, single, out, gm.tolist())
    np.testing.assert_array_equal(out[30:].reshape(-1, 3), accelerations(gm, single.astype(float)))
    with pytest.raises(TypeError, match="Cannot cast array data from dtype"):
        rhs(0.0, y.astype(complex), out, gm)
    with pytest.raises(ValueError, match=r"gravity.rhs expects .* got y with 60 numbers, and 9 parameters"):
        rhs(0.0, y, out, gm[1:])
    with pytest.raises(ValueError, match="fills 60 numbers for this state, but out has 59"):
        rhs(0.0, y, out[1:], gm)
    with pytest.raises(ValueError, match="f has 59 numbers, but y has 60"):
        energy_gradient(0.0, y, out[1:], out, gm)
    with pytest.raises(TypeError, match=r"takes the 4 arguments \(t, y, out, params\); got 3"):
        rhs(0.0, y, gm)
    with pytest.raises(TypeError, match="takes no keywords"):
        rhs(0.0, y, out, params=gm)


def test_frequencies_of_orbits_and_of_a_moon():
    """Two planets and a moon on known orbits."""
    gm = np.array([1e-3, 1.0, 1e-9, 0.0])  # the first planet, the star, its moon, a test particle
    q, v = np.zeros((2, 4, 3))
    q[0], v[0] = (1, 0, 0), (0, np.sqrt(gm[0] + gm[1]), 0)
    q[2], v[2] = q[0] + (0, 0, 0.01), v[0] + (np.sqrt((gm[0] + gm[2]) / 0.01), 0, 0)
    e = 0.5
    q[3], v[3] = (0, 4 * (1 - e), 0), (np.sqrt((1 + e) / (4 * (1 - e))), 0, 0)
    about, others = orbits.orbital_frequencies(gm, np.concatenate([q.ravel(), v.ravel()]))
    assert about[1] == 0.0
    assert about[0] == pytest.approx(np.sqrt(1.001), rel=1e-12)
    assert about[3] == pytest.approx(np.sqrt(4**-3 * (1 - e) ** -1.5), rel=1e-12)
    assert others == pytest.approx(np.sqrt((gm[0] + gm[2]) / 0.01**3), rel=1e-9)


def falling(t_span):
    """Return two bodies that fall from rest; they collide at pi / sqrt(8 G m) = 0.907."""
    return nbody([1.0, 0.5], [[0, 0, 0], [1, 0, 0]], np.zeros((2, 3)), t_span=t_span, G=1.0)


@pytest.mark.parametrize("method", [EIPGJ12, EIPGJ14])
@pytest.mark.parametrize("end", [0.3, -0.3])
def test_a_pericentre_behind_the_end_of_a_run_does_not_bound_its_steps(method, end):
    """Return the distance of bodies that fall from rest, by its closed form."""
    run = integrate(falling((0, end)), method=method, h=0.003)
    r = run.y[3, -1] - run.y[0, -1]
    time = (np.sqrt(r * (1 - r)) + np.arccos(np.sqrt(r))) / np.sqrt(2 * 1.5)
    assert run.trusted
    assert time == pytest.approx(0.3, abs=1e-11)


def test_a_pericentre_within_a_run_bounds_its_steps():
    with pytest.raises(ValueError, match="is not stable for the fastest motion"):
        integrate(falling((0, 1.0)), method=EIPGJ14, h=0.003)


@pytest.mark.parametrize("approaches", [True, False])
def test_frequencies_within_a_run(approaches):
    """At the end of the run, or in the pericentre if that comes before: e = 0.9, from a known place on the orbit."""
    e, anomaly = 0.9, 2.0
    r = 1 - e * np.cos(anomaly)
    place = np.array([np.cos(anomaly) - e, np.sqrt(1 - e**2) * np.sin(anomaly), 0])
    speed = np.array([-np.sin(anomaly), np.sqrt(1 - e**2) * np.cos(anomaly), 0]) / r
    y = np.concatenate([np.zeros(3), place, np.zeros(3), -speed if approaches else speed])
    mean = anomaly - e * np.sin(anomaly)
    to_pericentre = mean if approaches else 2 * np.pi - mean
    later = 1.2 if approaches else 2 * np.pi - 1.2  # an eccentric anomaly on the way there
    duration = abs(mean - (later - e * np.sin(later)))

    def found(duration):
        return orbits.orbital_frequencies(np.array([1.0, 0.0]), y, duration)[0][1]

    assert found(duration) == pytest.approx((1 - e * np.cos(later)) ** -0.75, rel=1e-6)
    assert found(1.01 * to_pericentre) == found(np.inf) == pytest.approx((1 - e) ** -0.75, rel=1e-6)
    assert found(-1e-9) == pytest.approx(r**-0.75, rel=1e-6)


# Masses and G.


def test_masses_are_multiplied_by_G():
    """A circular orbit of 1 AU takes a year; params are G m."""
    G = 4 * np.pi**2
    places, speeds = [[0, 0, 0], [1, 0, 0]], [[0, 0, 0], [0, 2 * np.pi, 0]]
    problem = nbody([1.0, 0.0], places, speeds, t_span=(0, 1), G=G)
    np.testing.assert_array_equal(problem.params, [G, 0.0])
    assert problem.G == G
    run = integrate(problem, method=EIPRKN12, h=1 / 64)
    np.testing.assert_allclose(run.y[:, -1], problem.y0, atol=1e-12)
    same = nbody([G, 0.0], places, speeds, t_span=(0, 1))
    np.testing.assert_array_equal(same.params, problem.params)
    one = nbody([1.0, 1e-3], places, [[0, 0, 0], [0, 1, 0]], t_span=(0, 1), G=1.0)
    np.testing.assert_array_equal(one.params, [1.0, 1e-3])


@pytest.mark.parametrize("G", [0.0, -1.0, np.nan, np.inf, "1", True])
def test_a_wrong_G(G):
    with pytest.raises(ValueError, match="nbody: G must be a positive finite number, got"):
        nbody([1.0, 0.0], [[0, 0, 0], [1, 0, 0]], [[0, 0, 0], [0, 1, 0]], t_span=(0, 1), G=G)
