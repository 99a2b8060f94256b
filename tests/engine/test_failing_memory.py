"""Memory that C++ does not get is a MemoryError in Python, wherever it is asked for; the same call works afterwards."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from c_compiler import compiler, shared_library

from eip_scipy.engine.native import BUILD

HERE = Path(__file__).parent
KEPLER = HERE.parents[1] / "examples" / "c-functions" / "kepler.c"
pytestmark = [
    pytest.mark.nightly,
    pytest.mark.slow,
    pytest.mark.needs_jit,
    pytest.mark.skipif(sys.platform != "linux", reason="preloads a library"),
    pytest.mark.skipif(
        b"libstdc++.so" not in Path(BUILD.__file__).read_bytes(),
        reason="the engine, built by ziglang, has an operator new of its own, which no other can replace",
    ),
]


@pytest.fixture(scope="module")
def failures(tmp_path_factory):
    """Return for each case whether the GIL is released, and what each allocation that failed has raised."""
    folder = tmp_path_factory.mktemp("memory")
    functions = shared_library(folder / "functions.so", HERE.parent / "run" / "pointers.c", KEPLER)
    preloaded = folder / "failing.so"
    source = HERE / "failing_memory.c"
    subprocess.run([*compiler(), "-O2", "-shared", "-fPIC", "-o", preloaded, source, "-lstdc++"], check=True)
    libraries = f"{preloaded} {os.environ.get('LD_PRELOAD', '')}".strip()
    done = subprocess.run(
        [sys.executable, HERE / "memory_cases.py", preloaded, functions],
        env=os.environ | {"LD_PRELOAD": libraries},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr  # below 0: the process was aborted
    return json.loads(done.stdout)


def test_each_allocation_that_fails_is_a_memory_error(failures):
    for name, (_, raised) in failures.items():
        assert raised, name  # the case does ask for memory
        assert set(raised) == {"MemoryError"}, name


@pytest.mark.parametrize("released", [True, False], ids=["without the GIL", "with the GIL"])
def test_many_places_are_tried(failures, released):
    assert sum(len(raised) for without, raised in failures.values() if without == released) >= 20
