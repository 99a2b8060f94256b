"""Sums over the pairs of many bodies, each pair once and by several threads: accuracy, and the same bits every time."""

import math
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from eip_scipy import EIPRK4, EIPRKN12, Invariant, ensemble, integrate
from eip_scipy.engine.native import library
from eip_scipy.ensembles import tasks
from eip_scipy.problems import nbody

ROUNDING = np.finfo(float).eps / 2
MANY = 128  # the least number of bodies for these sums
SIZES = [26, 33, 100, MANY - 1, MANY, MANY + 1, MANY + 7, 257, 300]
HEADER = """
import hashlib, os, signal, sys, threading, time
import numpy as np
from eip_scipy import EIPRK4, integrate
from eip_scipy.engine.native import BUILD, library
from eip_scipy.problems import nbody

def problem(n):
    rng = np.random.default_rng(n)
    return nbody(10.0 ** rng.uniform(-6, 0, n), *rng.standard_normal((2, n, 3)), t_span=(0, 1), h=1e-3)

def sums(n):
    p, out = problem(n), np.empty(6 * n)
    library["gravity.rhs"](0.0, p.y0, out, p.params)
    return out.tobytes() + np.float64(library["gravity.energy"](0.0, p.y0, p.params)).tobytes()

def end(n, steps=4):
    return integrate(problem(n), (0, steps * 1e-3), method=EIPRK4).y[:, -1].tobytes()

def threads():
    return len(os.listdir("/proc/self/task")) if sys.platform == "linux" else 0
"""


def bodies(n, seed=0):
    rng = np.random.default_rng([n, seed])
    return 10.0 ** rng.uniform(-6, 0, n), rng.standard_normal(6 * n)


def accelerations(gm, y):
    return library["gravity.acc"](0.0, y[: y.size // 2], gm).reshape(-1, 3)


def terms(gm, y):
    """Return the pull of every body on every body (N, N, 3), and the terms of the energy times G."""
    q, v = y.reshape(2, -1, 3)
    d = q[None] - q[:, None]
    r = np.sqrt((d**2).sum(axis=2))
    np.fill_diagonal(r, np.inf)
    kinetic, potential = gm * (v**2).sum(axis=1) / 2, np.outer(gm, gm) / r / 2
    return gm[:, None] * d / r[..., None] ** 3, np.r_[kinetic, -potential.ravel()]


def run_script(code, threads, **variables):
    # The threads of OpenBLAS would be counted as well.
    environment = os.environ | {"OMP_NUM_THREADS": str(threads), "OPENBLAS_NUM_THREADS": "1"} | variables
    run = subprocess.run(
        [sys.executable, "-c", HEADER + code], env=environment, capture_output=True, text=True, check=False, timeout=300
    )
    assert run.returncode == 0, run.stderr
    return run.stdout


@pytest.mark.parametrize("n", SIZES)
def test_sums_agree_with_those_of_numpy(n):
    gm, y = bodies(n)
    pulls, energies = terms(gm, y)
    size = np.abs(pulls).sum(axis=1)
    # A pull of NumPy's is right to 7 roundings as well.
    assert (np.abs(accelerations(gm, y) - pulls.sum(axis=1)) <= 2 * (7 + np.sqrt(n)) * ROUNDING * size).all()
    found = library["gravity.energy"](0.0, y, gm)
    assert abs(found - math.fsum(energies)) <= 7 * ROUNDING * np.abs(energies).sum()


@pytest.mark.parametrize("n", [MANY, 257])
def test_sums_agree_with_exact_ones_of_the_same_terms(n):
    gm, y = bodies(n, 1)
    pulls, _ = terms(gm, y)
    exact = np.array([[math.fsum(pulls[i, :, c]) for c in range(3)] for i in range(n)])
    size = np.abs(pulls).sum(axis=1)
    assert (np.abs(accelerations(gm, y) - exact) <= (14 + np.sqrt(n)) * ROUNDING * size).all()


def test_the_pull_of_the_star_is_rounded_once():
    """Light bodies change the sum in a star's field by less than its rounding, in whatever order they are added."""
    n = 300
    gm, y = bodies(n)
    gm[0], gm[1:] = 1.0, 1e-25
    np.testing.assert_array_equal(accelerations(gm, y)[8:], accelerations(np.r_[1.0, np.zeros(n - 1)], y)[8:])


@pytest.mark.parametrize("method", [EIPRK4, EIPRKN12])
@pytest.mark.parametrize("compensated", [False, True])
def test_the_energy_that_comes_with_the_accelerations_has_the_bits_of_the_energy_alone(method, compensated):
    """Functions in Python are called one by one."""
    gm, y = bodies(MANY + 3)
    problem = nbody(gm, *y.reshape(2, -1, 3), t_span=(0, 0.1), h=0.02)
    options = {"method": method, "compensated": compensated, "every": 1}
    energy = Invariant(
        lambda t, y, gm: library["gravity.energy"](t, y, gm),
        lambda *given: library["gravity.energy_gradient"](*given),
        uses_f=True,
        in_place=True,
        name="H",
    )
    alone = replace(problem, invariants=(energy, problem.invariants[1]))
    found, expected = integrate(problem, **options), integrate(alone, **options)
    assert found.diagnostics.n_projections > 0
    np.testing.assert_array_equal(found.y, expected.y)
    np.testing.assert_array_equal(found.diagnostics.max_defect, expected.diagnostics.max_defect)


def test_members_of_an_ensemble_get_the_bits_of_single_runs(monkeypatch):
    monkeypatch.setattr(tasks, "LEAST_WORK", 0)
    gm, y = bodies(MANY + 3)
    problem = nbody(gm, *y.reshape(2, -1, 3), t_span=(0, 2e-3), h=1e-3)
    starts = problem.y0 * (1 + 1e-3 * np.random.default_rng(1).standard_normal((9, y.size)))
    run = ensemble(problem, problem.t_span, starts, method=EIPRK4, executor=2)
    assert run.side_by_side.any()
    for start, found in zip(starts, run.y, strict=True):
        np.testing.assert_array_equal(found, integrate(problem, y0=start, method=EIPRK4).y[:, -1])


BITS = """
parts = [f(n) for n in (128, 131, 300, 1000) for f in (sums, end)]
digest = hashlib.sha256(b"".join(parts)).hexdigest()
print(digest)
"""


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_the_same_bits_for_any_number_of_threads(threads):
    here = {}
    exec(HEADER + BITS, here)
    assert run_script(BITS, threads).strip() == here["digest"]


def test_the_same_bits_from_the_build_for_every_processor():
    here = {}
    exec(HEADER + BITS, here)
    assert run_script(BITS, 2, EIP_SCIPY_ENGINE="_native").strip() == here["digest"]


FORKED = """
from multiprocessing import get_context
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


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_forked_processes():
    """They have threads of their own with OMP_NUM_THREADS, else none."""
    run_script(FORKED, 3)


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


def test_runs_of_several_threads_at_once():
    run_script(AT_ONCE, 3)


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


@pytest.mark.skipif(not hasattr(__import__("signal"), "setitimer"), reason="needs a timer")
def test_interrupted_runs():
    run_script(INTERRUPTED, 3)


ALONE = """
assert BUILD.work_alone(True) is False
first = threads()
expected = end(200)
assert threads() == first
from concurrent.futures import ThreadPoolExecutor
from eip_scipy import ensemble
p = problem(200)
for executor in (2, ThreadPoolExecutor(1)):
    runs = ensemble(p, (0, 4e-3), np.array([p.y0] * 3), method=EIPRK4, executor=executor)
    assert all(y.tobytes() == expected for y in runs.y)
before = threads()
assert before <= first + 3  # the executors' own
assert BUILD.work_alone(False) is True
assert end(200) == expected
assert threads() in (0, before + 4)
"""


def test_threads_of_an_ensemble_work_alone():
    run_script(ALONE, 5)
