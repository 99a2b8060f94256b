"""The sums over pairs of point masses: accuracy, symmetry, and the same bits by all ways to call them."""

import math
import os
import subprocess
import sys
from dataclasses import replace
from itertools import combinations

import mpmath
import numpy as np
import pytest

from eip_scipy import EIPGJ12, EIPGJ14, EIPRK4, EIPRKN12, Invariant, ensemble, integrate
from eip_scipy.engine.native import library
from eip_scipy.problems import nbody
from eip_scipy.problems.gravity.frequencies import orbital_frequencies

rhs, acc = library["gravity.rhs"], library["gravity.acc"]
energy, energy_gradient = library["gravity.energy"], library["gravity.energy_gradient"]
momentum, momentum_gradient = library["gravity.momentum"], library["gravity.momentum_gradient"]
ROUNDING = np.finfo(float).eps / 2
MANY = 128  # the least number of bodies for sums in which each pair is taken once, by several threads
FEW = [1, 2, 3, 4, 5, 7, 8, 9, 10, 11, 12, 13, 16, 17, 30]  # in all ways of pair_sums.hpp


def bodies(n, seed=0):
    """Return random masses, over six powers of ten, and a random state."""
    rng = np.random.default_rng([n, seed])
    return 10.0 ** rng.uniform(-6, 0, n), rng.standard_normal(6 * n)


def close_pairs(n):
    gm, y = bodies(n)
    y[3:6] = y[:3] + 1e-9 * y[3:6]
    if n > 6:
        y[3 * n - 3 : 3 * n] = y[6:9] * (1 + 4e-16)
        y[3 * n - 3] += 1e-13
    return gm, y


def particles(n):
    gm, y = bodies(n)
    gm[1::2] = 0.0
    return gm, y


def accelerations(gm, y):
    out = np.full(y.size, np.nan)
    rhs(0.0, y, out, gm)
    np.testing.assert_array_equal(out[: y.size // 2], y[y.size // 2 :])
    return out[y.size // 2 :].reshape(-1, 3)


def exact_sums(gm, y):
    """Return accelerations, the sums of their terms' sizes, and the energy with that of its terms, in 40 digits."""
    n = gm.size
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


@pytest.mark.parametrize("make", [bodies, close_pairs, particles])
def test_accuracy_of_few(make):
    for n in FEW if make is bodies else (2, 3, 7, 10, 17):
        gm, y = make(n)
        with mpmath.workdps(40):
            a, size, exact, energy_size = exact_sums(gm, y)
            error = [float(x - mpmath.mpf(z)) for x, z in zip(np.array(a).flat, accelerations(gm, y).flat, strict=True)]
            energy_error = float(exact - mpmath.mpf(energy(0.0, y, gm)))
        # One pull is right to about 7 roundings, the sum of N grows like a random walk.
        assert (np.abs(error) <= (7 + np.sqrt(n)) * ROUNDING * size.ravel()).all()
        # From 8 bodies on, rounding errors of the sum are carried along.
        assert abs(energy_error) <= (3 if n >= 8 else 4 + np.sqrt(n)) * ROUNDING * energy_size
        np.testing.assert_allclose(
            accelerations(gm, y)[gm > 0],
            accelerations(gm[gm > 0], y[np.tile(np.repeat(gm > 0, 3), 2)]),  # particles do not attract
            rtol=1e-13,
        )


@pytest.mark.parametrize("n", [26, 33, 100, MANY - 1, MANY, MANY + 1, MANY + 7, 257, 300])
def test_accuracy_of_many(n):
    gm, y = bodies(n, 1)
    q, v = y.reshape(2, -1, 3)
    d = q[None] - q[:, None]
    r = np.sqrt((d**2).sum(axis=2))
    np.fill_diagonal(r, np.inf)
    pulls = gm[:, None] * d / r[..., None] ** 3  # right to 7 roundings as well
    energies = np.r_[gm * (v**2).sum(axis=1) / 2, -(np.outer(gm, gm) / r / 2).ravel()]
    exact = np.array([[math.fsum(pulls[i, :, c]) for c in range(3)] for i in range(n)])
    size = np.abs(pulls).sum(axis=1)
    assert (np.abs(accelerations(gm, y) - exact) <= (14 + np.sqrt(n)) * ROUNDING * size).all()
    assert abs(energy(0.0, y, gm) - math.fsum(energies)) <= 7 * ROUNDING * np.abs(energies).sum()


def test_the_pull_of_the_star_is_rounded_once():
    """Light bodies change the sum in a star's field by less than its rounding, in whatever order they are added."""
    gm, y = bodies(300)
    gm[0], gm[1:] = 1.0, 1e-25
    np.testing.assert_array_equal(accelerations(gm, y)[8:], accelerations(np.r_[1.0, np.zeros(299)], y)[8:])


@pytest.mark.parametrize("n", [*FEW, 100, MANY, MANY + 5])
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


def test_momentum_is_kept_to_rounding():
    for n, seed in [*((10, seed) for seed in range(200)), (MANY, 0), (MANY + 5, 0), (300, 0)]:
        gm, y = bodies(n, seed)
        forces = gm[:, None] * accelerations(gm, y)
        assert np.abs(forces.sum(axis=0)).max() < 4 * ROUNDING * np.abs(forces).sum()


@pytest.mark.parametrize("n", [1, 2, 5, 7, 8, 10, 11, 13, 17, 30, MANY + 3])
def test_arrays_and_units(n):
    """Units of powers of two change no bit, nor do strides; nothing is written outside; gradients are differences."""
    gm, y = bodies(n)
    found, still = accelerations(gm, y), np.concatenate([y[: 3 * n], np.zeros(3 * n)])
    for power in (-150, -30, 1, 37, 150):
        factor = 2.0**power
        np.testing.assert_array_equal(found, accelerations(gm, y * factor) * factor**2)
        assert energy(0.0, still, gm) == energy(0.0, still * factor, gm) * factor
    wide, wide_gm, out = np.zeros((6 * n, 3)), np.zeros((n, 2)), np.zeros((6 * n, 2))
    wide[:, 1], wide_gm[:, 0] = y, gm
    rhs(0.0, wide[:, 1], out[:, 1], wide_gm[:, 0])
    np.testing.assert_array_equal(out[3 * n :, 1].reshape(-1, 3), found)
    np.testing.assert_array_equal(acc(0.0, wide[: 3 * n, 1], gm), found.ravel())
    assert energy(0.0, wide[:, 1], gm) == energy(0.0, y, gm)
    framed = np.full(6 * n + 20, 7.0)
    rhs(0.0, y, framed[10:-10], gm)
    assert (framed[:10] == 7.0).all()
    assert (framed[-10:] == 7.0).all()
    f, grad, grads = framed[10:-10], np.empty(6 * n), np.empty((3, 6 * n))
    energy_gradient(0.0, y, f, grad, gm)
    momentum_gradient(0.0, y, grads, gm)
    np.testing.assert_allclose(momentum(0.0, y, gm), gm @ np.cross(*y.reshape(2, n, 3)), rtol=0, atol=1e-13)
    step = 1e-6 * np.random.default_rng(3).standard_normal(6 * n)
    ahead, back = ((energy(0.0, z, gm), np.array(momentum(0.0, z, gm))) for z in (y + step, y - step))
    assert grad @ step == pytest.approx((ahead[0] - back[0]) / 2, rel=1e-4, abs=1e-13)
    np.testing.assert_allclose(grads @ step, (ahead[1] - back[1]) / 2, rtol=0, atol=1e-13)


@pytest.mark.needs_jit
@pytest.mark.parametrize(("n", "pair"), [(2, [0, 1]), (5, [0, 4]), (10, [0, 9]), (MANY + 2, [20, MANY])])
def test_bodies_at_one_place_are_not_finite(n, pair):
    gm, y = bodies(n)
    y[: 3 * n].reshape(n, 3)[pair[1]] = y[: 3 * n].reshape(n, 3)[pair[0]]
    a = accelerations(gm, y)
    assert not np.isfinite(a[pair]).any()
    assert np.isfinite(np.delete(a, pair, axis=0)).all()
    assert not np.isfinite(energy(0.0, y, gm))


def test_arguments_are_converted_or_refused():
    gm, y = bodies(10)
    out, single = np.empty(60), y.astype(np.float32)
    rhs(0.0, single, out, gm.tolist())
    np.testing.assert_array_equal(out[30:].reshape(-1, 3), accelerations(gm, single.astype(float)))
    for call, kind, says in [
        (lambda: rhs(0.0, y.astype(complex), out, gm), TypeError, "Cannot cast array data from dtype"),
        (lambda: rhs(0.0, y, out, gm[1:]), ValueError, r"gravity.rhs expects .* y with 60 numbers, and 9 parameters"),
        (lambda: rhs(0.0, y, out[1:], gm), ValueError, "fills 60 numbers for this state, but out has 59"),
        (lambda: energy_gradient(0.0, y, out[1:], out, gm), ValueError, "f has 59 numbers, but y has 60"),
        (lambda: rhs(0.0, y, gm), TypeError, r"takes the 4 arguments \(t, y, out, params\); got 3"),
        (lambda: rhs(0.0, y, out, params=gm), TypeError, "takes no keywords"),
    ]:
        with pytest.raises(kind, match=says):
            call()


@pytest.mark.parametrize("method", [EIPRK4, EIPRKN12])
@pytest.mark.parametrize("compensated", [False, True])
def test_the_energy_that_comes_with_the_accelerations_has_the_bits_of_the_energy_alone(method, compensated):
    """Functions in Python are called one by one."""
    gm, y = bodies(MANY + 3)
    problem = nbody(gm, *y.reshape(2, -1, 3), t_span=(0, 0.1), h=0.02)
    functions = (lambda t, y, gm: energy(t, y, gm)), (lambda *given: energy_gradient(*given))
    alone = Invariant(*functions, uses_f=True, in_place=True, name="H")
    options = {"method": method, "compensated": compensated, "every": 1}
    found = integrate(problem, **options)
    expected = integrate(replace(problem, invariants=(alone, problem.invariants[1])), **options)
    assert found.diagnostics.n_projections > 0
    np.testing.assert_array_equal(found.y, expected.y)
    np.testing.assert_array_equal(found.diagnostics.max_residual, expected.diagnostics.max_residual)


@pytest.mark.usefixtures("in_vectors")
def test_members_of_an_ensemble_get_the_bits_of_single_runs():
    gm, y = bodies(MANY + 3)
    problem = nbody(gm, *y.reshape(2, -1, 3), t_span=(0, 2e-3), h=1e-3)
    starts = problem.y0 * (1 + 1e-3 * np.random.default_rng(1).standard_normal((9, y.size)))
    run = ensemble(problem, problem.t_span, starts, method=EIPRK4, executor=2)
    assert run.side_by_side.any()
    for start, found in zip(starts, run.y, strict=True):
        np.testing.assert_array_equal(found, integrate(problem, y0=start, method=EIPRK4).y[:, -1])


HEADER = """
import hashlib, os, signal, sys, threading, time
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import get_context
import numpy as np
from eip_scipy import EIPRK4, ensemble, integrate
from eip_scipy.engine.native import BUILD, library
from eip_scipy.problems import nbody

def bodies(n):
    rng = np.random.default_rng(n)
    return 10.0 ** rng.uniform(-6, 0, n), rng.standard_normal((2, n, 3))

def problem(n):
    gm, y = bodies(n)
    return nbody(gm, *y, t_span=(0, 1), h=1e-3)

def sums(n):
    (gm, y), out = bodies(n), np.empty(6 * n)
    library["gravity.rhs"](0.0, y.ravel(), out, gm)
    return out.tobytes() + np.float64(library["gravity.energy"](0.0, y.ravel(), gm)).tobytes()

def end(n, steps=4):
    return integrate(problem(n), (0, steps * 1e-3), method=EIPRK4).y[:, -1].tobytes()

def threads():
    return len(os.listdir("/proc/self/task")) if sys.platform == "linux" else 0
"""


def run_script(code, threads, **variables):
    # The threads of OpenBLAS would be counted as well.
    environment = os.environ | {"OMP_NUM_THREADS": str(threads), "OPENBLAS_NUM_THREADS": "1"} | variables
    command = [sys.executable, "-c", HEADER + code]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=300)
    assert run.returncode == 0, run.stderr
    return run.stdout


BITS = """
parts = [sums(n) for n in (2, 3, 4, 5, 7, 8, 9, 10, 11, 12, 13, 16, 17, 30, 100)]
parts += [f(n) for n in (128, 131, 300, 1000) for f in (sums, end)]
digest = hashlib.sha256(b"".join(parts)).hexdigest()
print(digest)
"""


# The last: the build for every processor.
@pytest.mark.parametrize(("threads", "variables"), [(3, {}), (2, {"EIP_SCIPY_ENGINE": "_native"})])
def test_the_same_bits_for_any_number_of_threads(threads, variables):
    here = {}
    exec(HEADER + BITS, here)
    assert run_script(BITS, threads, **variables).strip() == here["digest"]


# They have threads of their own with OMP_NUM_THREADS, else none.
FORKED = """
expected, before = end(200), threads()

def check(own):
    good = end(200) == expected and threads() in (0, own)
    BUILD.end_threads()
    os._exit(0 if good and end(200) == expected else 1)

for own in (before, 1):
    child = get_context("fork").Process(target=check, args=(own,))
    child.start()
    child.join()
    assert child.exitcode == 0
    assert end(200) == expected and threads() == before
    os.environ.pop("OMP_NUM_THREADS", None)
"""
AT_ONCE = """
first = threads()
expected = [end(200), end(240)]
assert threads() in (0, first + 2)
found = {}
def run(k):
    found[k] = [end(200), end(240)] * 3
callers = [threading.Thread(target=run, args=(k,)) for k in range(4)]
for caller in callers: caller.start()
for caller in callers: caller.join()
assert list(found.values()) == [expected * 3] * 4
"""
INTERRUPTED = """
def stop(*_):
    raise KeyboardInterrupt
expected = end(200)
signal.signal(signal.SIGALRM, stop)
for delay in (0.05, 0.1):
    signal.setitimer(signal.ITIMER_REAL, delay)
    try:
        integrate(problem(200), (0, 1), method=EIPRK4, h=1e-6)
    except KeyboardInterrupt:
        pass
    else:
        sys.exit("not interrupted")
    assert end(200) == expected
"""
IN_AN_ENSEMBLE = """
assert BUILD.work_alone(True) is False
first = threads()
expected = end(200)
assert threads() == first
p = problem(200)
for executor in (2, ThreadPoolExecutor(1)):
    runs = ensemble(p, (0, 4e-3), np.array([p.y0] * 3), method=EIPRK4, executor=executor)
    assert all(y.tobytes() == expected for y in runs.y)
before = threads()
assert before <= first + 3  # the executors' own
assert BUILD.work_alone(False) is True
assert end(200) == expected
assert threads() in (0, before + 2)
"""


@pytest.mark.parametrize(
    "code",
    [pytest.param(FORKED, marks=pytest.mark.posix), AT_ONCE, pytest.param(INTERRUPTED, marks=pytest.mark.posix),
     IN_AN_ENSEMBLE],
    ids=["forked", "at once", "interrupted", "in an ensemble"],
)  # fmt: skip
def test_threads(code):
    run_script(code, 3)


# Frequencies of orbits, which bound the steps of multistep methods.


@pytest.mark.parametrize("approaches", [True, False])
def test_frequencies_within_a_run(approaches):
    """At the end of the run, or in the pericentre if that comes before: e = 0.9, from a known place on the orbit."""
    e, anomaly = 0.9, 2.0
    r = 1 - e * np.cos(anomaly)
    place = np.array([np.cos(anomaly) - e, np.sqrt(1 - e**2) * np.sin(anomaly), 0])
    speed = np.array([-np.sin(anomaly), np.sqrt(1 - e**2) * np.cos(anomaly), 0]) / r
    y = np.concatenate([np.zeros(3), place, np.zeros(3), -speed if approaches else speed])
    mean = anomaly - e * np.sin(anomaly)
    later = 1.2 if approaches else 2 * np.pi - 1.2  # an eccentric anomaly on the way to the pericentre

    def found(duration):
        return orbital_frequencies(np.array([1.0, 0.0]), y, duration)[0][1]

    duration = abs(mean - (later - e * np.sin(later)))
    assert found(duration) == pytest.approx((1 - e * np.cos(later)) ** -0.75, rel=1e-6)
    to_pericentre = mean if approaches else 2 * np.pi - mean
    assert found(1.01 * to_pericentre) == found(np.inf) == pytest.approx((1 - e) ** -0.75, rel=1e-6)
    assert found(-1e-9) == pytest.approx(r**-0.75, rel=1e-6)


@pytest.mark.parametrize("method", [EIPGJ12, EIPGJ14])
def test_a_pericentre_bounds_the_steps_of_runs_that_contain_it(method):
    """Bodies that fall from rest collide at pi / sqrt(8 G m) = 0.907; their distance has a closed form."""
    falling = nbody([1.0, 0.5], [[0, 0, 0], [1, 0, 0]], np.zeros((2, 3)), t_span=(0, 1), G=1.0)
    for end in (0.3, -0.3):
        run = integrate(falling, (0, end), method=method, h=0.003)
        r = run.y[3, -1] - run.y[0, -1]
        assert run.trusted
        assert (np.sqrt(r * (1 - r)) + np.arccos(np.sqrt(r))) / np.sqrt(2 * 1.5) == pytest.approx(0.3, abs=1e-11)
    with pytest.raises(ValueError, match="is not stable for the fastest motion"):
        integrate(falling, method=method, h=0.003)


def test_masses_are_multiplied_by_G():
    """A circular orbit of 1 AU takes a year; params are G m."""
    G = 4 * np.pi**2
    problem = nbody([1.0, 0.0], [[0, 0, 0], [1, 0, 0]], [[0, 0, 0], [0, 2 * np.pi, 0]], t_span=(0, 1), G=G)
    np.testing.assert_array_equal(problem.params, [G, 0.0])
    assert problem.G == G
    np.testing.assert_allclose(integrate(problem, method=EIPRKN12, h=1 / 64).y[:, -1], problem.y0, atol=1e-12)
