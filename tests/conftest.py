"""What holds for every test: order, ``needs_jit``, plotting without a screen, Ctrl-C, the profile of hypothesis."""

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

# The loop over steps takes more than a minute to compile. Of two processes the first starts with that, the second with
# files that do without it, and finds it in the cache afterwards.
WITHOUT_LOOP = (
    "test_tableaux", "test_nystrom", "test_one_step", "test_dense_output", "test_order",
    "test_scipy_suite", "test_gpe_commands", "test_implicit_schemes", "test_gpe_methods", "test_plain_numbers",
)  # fmt: skip


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    if config.option.markexpr == "not slow":
        terminalreporter.write_line("slow tests were left out; to run them: python -m pytest -m slow")


def place(item: pytest.Item) -> int:
    if item.path.parent.name == "run":
        return 0
    return 1 + WITHOUT_LOOP.index(item.path.stem) if item.path.stem in WITHOUT_LOOP else 1 + len(WITHOUT_LOOP)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=place)
    if not numba.config.DISABLE_JIT:
        return
    skip = pytest.mark.skip(reason="needs compiled code; NUMBA_DISABLE_JIT is set")
    for item in items:
        if item.get_closest_marker("needs_jit"):
            item.add_marker(skip)
