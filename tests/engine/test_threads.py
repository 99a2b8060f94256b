"""Runs in several threads at once, with a global interpreter lock and in a Python that has none."""

import os
import subprocess
import sys
import sysconfig
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from systems import SQUARE, Verlet, momentum, orbit, oscillator, pericentre

from eip_scipy import EIPDOP853, EIPGJ14, EIPRK4, EIPRK45, Invariant, eip_method, ensemble, integrate, solve_ivp
from eip_scipy.problems import kepler

THREADS = 4
# The threads share the invariants, whose gradients are found by complex steps.
H = Invariant(lambda t, y: 0.5 * (y[2] ** 2 + y[3] ** 2) - 1 / np.sqrt(y[0] ** 2 + y[1] ** 2), name="energy")
L = Invariant(momentum, name="momentum")


def in_a_list(t, y):
    return [y[2], y[3], *(-y[:2] / np.hypot(y[0], y[1]) ** 3)]


STARTS = pericentre(0.3) + 1e-3 * np.arange(12)[:, None]
PLAIN = {"method": EIPRK4, "h": 0.05}
SCIPY = {"method": EIPRK45, "invariants": [H], "dense_output": True, "rtol": 1e-6}
RUNS = {
    "by Python": lambda: integrate(in_a_list, (0, 2), pericentre(0.4), invariants=[H, L], compiled=False, **PLAIN).y,
    "by SciPy": lambda: solve_ivp(orbit, (0, 2), pericentre(0.4), **SCIPY).sol(np.linspace(0, 2, 20)),
    "by a user-defined method": lambda: (
        integrate(oscillator, (0, 2), [1.0, 0.0], method=eip_method(Verlet()), h=0.05, invariants=SQUARE).y
    ),
    "by the library": lambda: integrate(kepler(), (0, 9), method=EIPDOP853, t_eval=np.linspace(0, 9, 30)).y,
    "by a multistep method": lambda: integrate(kepler(), (0, 9), method=EIPGJ14, h=0.02, save_every=50).y,
    "as an ensemble": lambda: ensemble(kepler(), (0, 3), STARTS, save_every=10, executor=1, **PLAIN).trajectories,
}


def test_runs_in_threads_have_the_bits_of_runs_alone():
    expected = {name: run() for name, run in RUNS.items()}
    together = threading.Barrier(THREADS)

    def all_runs(first):
        together.wait()
        return {name: RUNS[name]() for name in np.roll(list(RUNS), first).tolist()}

    with ThreadPoolExecutor(THREADS) as pool:
        for found in pool.map(all_runs, range(THREADS)):
            for name, values in found.items():
                np.testing.assert_array_equal(values, expected[name], err_msg=name)


def test_a_solver_is_stepped_by_one_thread_at_a_time():
    """The steps of the other thread are refused, and the refused ones leave the solver as it was."""
    inside, leave = threading.Event(), threading.Event()

    def fun(t, y):
        if threading.current_thread() is first:
            inside.set()
            assert leave.wait(60)
        return oscillator(t, y)

    first = None
    solver = EIPRK4(fun, 0.0, np.array([1.0, 0.0]), 1.0, invariants=SQUARE, h=0.1)
    first = threading.Thread(target=solver.step)
    first.start()
    assert inside.wait(60)
    try:
        with pytest.raises(RuntimeError, match="a second thread"):
            solver.step()
    finally:
        leave.set()
        first.join()
    assert solver.t == 0.1
    while solver.status == "running":
        solver.step()
    alone = EIPRK4(oscillator, 0.0, np.array([1.0, 0.0]), 1.0, invariants=SQUARE, h=0.1)
    while alone.status == "running":
        alone.step()
    np.testing.assert_array_equal(solver.y, alone.y)


@pytest.mark.skipif(not sysconfig.get_config_var("Py_GIL_DISABLED"), reason="needs a free-threaded Python")
def test_the_global_lock_stays_off():
    """A module that does not declare that it needs no lock switches the lock on, with a RuntimeWarning."""
    code = """
import sys
from eip_scipy import EIPRK4, integrate
from eip_scipy.problems import kepler
assert integrate(kepler(), (0, 1), method=EIPRK4).success
print(sys._is_gil_enabled())
"""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHON_GIL"}
    command = [sys.executable, "-W", "error", "-c", code]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert (run.stdout, run.stderr) == ("False\n", "")


@pytest.mark.parametrize("fun", ["problem", "in_python"])
def test_a_daemon_thread_does_not_crash_the_process_at_its_end(fun):
    code = f"""
import threading, time
from eip_scipy import EIPRK4, integrate
from eip_scipy.problems import kepler

problem = kepler()
def in_python(t, y):
    return [y[2], y[3], -y[0], -y[1]]
def forever():
    while True:
        integrate({fun}, (0, 1e4), problem.y0, method=EIPRK4, h=0.01)
integrate(problem, (0, 1), method=EIPRK4, h=0.01)
threading.Thread(target=forever, daemon=True).start()
time.sleep(0.3)
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (ended.returncode, ended.stderr) == (0, "")
