"""What holds for every test: ``needs_jit``, plotting without a screen, Ctrl-C, the profile of hypothesis."""

import os
import signal

import hypothesis
import numba
import pytest

# Before any import of matplotlib, and through the environment, so that subprocesses inherit it.
os.environ["MPLBACKEND"] = "Agg"

# As in a terminal: what a shell starts in the background ignores Ctrl-C, with all its children, and tests press it.
signal.signal(signal.SIGINT, signal.default_int_handler)

# The same examples in each run, and no deadline: the first call of a function compiles it. To look for new
# counterexamples: python -m pytest --hypothesis-profile=default
hypothesis.settings.register_profile("ci", derandomize=True, deadline=None)
hypothesis.settings.load_profile("ci")


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    if config.option.markexpr == "not slow":
        terminalreporter.write_line("slow tests were left out; to run them: python -m pytest -m slow")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if not numba.config.DISABLE_JIT:
        return
    skip = pytest.mark.skip(reason="needs compiled code; NUMBA_DISABLE_JIT is set")
    for item in items:
        if item.get_closest_marker("needs_jit"):
            item.add_marker(skip)
