"""Ctrl-C in a destructor, where Python drops it: a run ends nevertheless, with its results."""

import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from systems import jit_orbit, orbit, oscillator, pericentre

from eip_scipy import EIPRK4, ensemble, integrate
from eip_scipy.run.interrupts import kept_ctrl_c, look_for_signals

pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")


class PressesCtrlC:
    """In its destructor, as happens to the objects of a compiler."""

    def __del__(self):
        signal.raise_signal(signal.SIGINT)


def press(*_):
    PressesCtrlC()


@pytest.fixture(autouse=True)
def handler():
    """Return the handler that Python installs, which is set before and after each run."""
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    yield
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_it_is_dropped():
    press()


def test_integrate():
    with pytest.raises(KeyboardInterrupt) as info:
        integrate(oscillator, (0, 1), [1.0, 0.0], method=EIPRK4, h=0.01, save_every=10, callback=press)
    assert info.value.partial.t.tolist() == [0.0]


@pytest.mark.needs_jit
def test_integrate_while_it_compiles(monkeypatch):
    from eip_scipy.run.prepare import System

    def compiles(*arguments):
        press()
        return real(*arguments)

    real = System.functions
    monkeypatch.setattr(System, "functions", compiles)
    with pytest.raises(KeyboardInterrupt) as info:
        integrate(jit_orbit, (0, 1e9), pericentre(0.6), method=EIPRK4, h=0.01)
    assert info.value.partial.t.tolist() == [0.0]


def test_ensemble():
    with pytest.raises(KeyboardInterrupt) as info:
        ensemble(oscillator, (0, 1), np.ones((6, 2)), h=0.1, chunk=2, executor=1, callback=press)
    assert info.value.partial.status.tolist() == [0, 0, -2, -2, -2, -2]


def test_runs_after_it_are_not_disturbed():
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            integrate(orbit, (0, 1), pericentre(0.6), method=EIPRK4, h=0.1, save_every=2, callback=press)
        assert integrate(orbit, (0, 1), pericentre(0.6), method=EIPRK4, h=0.1).success


def test_a_run_inside_a_run():
    def run_another(*_):
        with pytest.raises(KeyboardInterrupt):
            integrate(oscillator, (0, 1), [1.0, 0.0], method=EIPRK4, h=0.1, save_every=1, callback=press)

    with pytest.raises(KeyboardInterrupt):  # the outer one ends too
        integrate(oscillator, (0, 1), [1.0, 0.0], method=EIPRK4, h=0.1, save_every=1, callback=run_another)


def test_a_handler_of_ones_own_stays():
    seen = []
    signal.signal(signal.SIGINT, lambda number, frame: seen.append(number))
    try:
        run = integrate(oscillator, (0, 1), [1.0, 0.0], method=EIPRK4, h=0.1, save_every=5, callback=press)
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    assert run.success
    assert seen == [signal.SIGINT] * 3


def test_other_threads():
    """Other threads cannot install a handler, and must not raise an interrupt of the main thread."""
    found = []

    def run():
        look_for_signals()
        found.append(integrate(oscillator, (0, 1), [1.0, 0.0], method=EIPRK4, h=0.1).success)

    with kept_ctrl_c():
        press()
        thread = threading.Thread(target=run)
        thread.start()
        thread.join()
        with pytest.raises(KeyboardInterrupt):
            look_for_signals()
    assert found == [True]


COMPILES = """
import time
import numpy as np
from numba import njit
from eip_scipy import EIPRK4, Invariant, integrate

fun = njit(lambda t, y, params: np.append(y[2:], -y[:2] / np.hypot(y[0], y[1]) ** 3))
energy = njit(lambda t, y, params: 0.5 * (y[2] ** 2 + y[3] ** 2) - 1 / np.hypot(y[0], y[1]))
gradient = njit(lambda t, y, params: np.append(y[:2] / np.hypot(y[0], y[1]) ** 3, y[2:]))
event = njit(lambda t, y, params: np.linalg.norm(y) - 1)

def run(t_end):
    options = {"h": 0.01, "params": [1.0], "invariants": Invariant(energy, gradient), "events": event}
    return integrate(fun, (0, t_end), [0.4, 0, 0, 2.0], method=EIPRK4, **options)

print("compiles", flush=True)
try:
    run(1e9)
except KeyboardInterrupt as error:
    print(time.time(), flush=True)
    assert error.partial.t[0] == 0.0
    assert run(1.0).compiled
    print("and again", flush=True)
"""


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.needs_jit
@pytest.mark.posix
@pytest.mark.parametrize("seed", range(30))
def test_at_any_instant_of_compilation(seed):
    """KeyboardInterrupt within three seconds, nothing on the terminal, and the next run compiles."""
    process = subprocess.Popen(
        [sys.executable, "-c", COMPILES], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout.readline() == "compiles\n"
        time.sleep(np.random.default_rng(seed).uniform(0.0, 6.0))
        pressed = time.time()
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=120)
    finally:
        process.kill()
    assert (process.returncode, err) == (0, "")
    seconds, again = out.splitlines()
    assert float(seconds) - pressed < 3.0
    assert again == "and again"
