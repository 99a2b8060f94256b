"""First runs of an installation: where nothing can be kept on disk, where it is damaged, and two at once."""

import errno
import os
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import numba
import pytest

import eip_scipy
from eip_scipy.engine.caching import cached_njit

pytestmark = pytest.mark.needs_jit

PACKAGE = Path(eip_scipy.__file__).parent
TOLD = "compiled functions cannot be kept on disk"
# One small function of the package: what holds for it holds for the others.
SMALL = """
    import warnings
    warnings.simplefilter("always")
    import numpy as np
    from eip_scipy.problems import kepler
    problem = kepler(relativistic=0)
    for y in np.array([4.0, 0.0, 0.0, 2.0]), np.array([4, 0, 0, 2], np.float32):
        print(np.abs(problem.fun(0.0, y)).astype(float).tolist())
"""
PRINTED = "[0.0, 2.0, 0.0625, 0.0]\n" * 2


def python(code, folder=PACKAGE.parent, **environment):
    """What it prints, and its warnings."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("NUMBA_", "XDG_"))}
    command = [sys.executable, "-c", textwrap.dedent(code)]
    environment = kept | {"PYTHONPATH": str(folder)} | {name: str(value) for name, value in environment.items()}
    return subprocess.Popen(
        command, env=environment, cwd=folder, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )


def ended(process):
    out, err = process.communicate(timeout=600)
    assert process.returncode == 0, err
    return out, err


def right(process):
    """Whether it was told that nothing is kept; what it computed is right."""
    out, err = ended(process)
    assert out == PRINTED
    assert err.count(TOLD) <= 1
    return TOLD in err


@pytest.fixture
def installed(tmp_path):
    """A copy of the package without its cache, whose folders take none: also where the tests run as root."""
    folder = tmp_path / "installed"
    shutil.copytree(PACKAGE, folder / "eip_scipy", ignore=shutil.ignore_patterns("__pycache__"))
    for place in [path for path in (folder / "eip_scipy").rglob("*") if path.is_dir()] + [folder / "eip_scipy"]:
        (place / "__pycache__").write_text("no folder")
    return folder


@pytest.mark.slow
def test_a_read_only_install_and_no_home(installed):
    assert right(python(SMALL, installed, HOME="/dev/null"))


def test_a_read_only_install(installed, tmp_path):
    home = tmp_path / "home"
    assert not right(python(SMALL, installed, HOME=home))
    assert list(home.rglob("*.nbi"))


@pytest.mark.slow
def test_a_folder_mounted_read_only(tmp_path):
    folder = tmp_path / "installed"
    shutil.copytree(PACKAGE, folder / "eip_scipy", ignore=shutil.ignore_patterns("__pycache__"))
    mount = ["mount", "--bind", str(folder), str(folder)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("nothing can be mounted here")
    try:
        subprocess.run(["mount", "-o", "remount,ro,bind", str(folder)], check=True)
        assert right(python(SMALL, folder, HOME=folder))
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def test_a_cache_on_a_full_disk(tmp_path):
    mount = ["mount", "-t", "tmpfs", "-o", "size=20k", "tmpfs", str(tmp_path)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("nothing can be mounted here")
    try:
        assert right(python(SMALL, NUMBA_CACHE_DIR=tmp_path))
    finally:
        subprocess.run(["umount", str(tmp_path)], check=True)


def double(x):
    return x + x


@pytest.fixture
def doubled(tmp_path, monkeypatch):
    """What a process that has not compiled it yet makes of `double`, and how often it finds it on the disk."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))

    def found():
        dispatcher = cached_njit()(double)
        assert (dispatcher(1.5), dispatcher(1.5 - 2j)) == (3.0, 3.0 - 4j)
        return sum(dispatcher.stats.cache_hits.values())

    assert found() == 0
    assert found() == 2
    return found


@pytest.mark.parametrize("ending", [".nbi", ".nbc"])
@pytest.mark.parametrize("damage", ["empty", "cut", "changed"])
def test_a_damaged_cache(ending, damage, doubled, tmp_path):
    """As a power cut leaves it; it is as good as new afterwards."""
    files = list(tmp_path.rglob(f"*{ending}"))
    assert files
    for path in files:
        raw = path.read_bytes()
        path.write_bytes({"empty": b"", "cut": raw[: len(raw) // 2], "changed": b"\x80\x05garbage" + raw}[damage])
    assert doubled() == 0
    assert doubled() == 2


def test_one_type_under_the_name_of_another(doubled, tmp_path):
    """Two first runs of one function for different types may both take the first number for their file."""
    one, other = tmp_path.rglob("*.nbc")
    first, second = one.read_bytes(), other.read_bytes()
    one.write_bytes(second)
    other.write_bytes(first)
    assert doubled() == 0
    assert doubled() == 2


@pytest.mark.filterwarnings("ignore:compiled functions cannot be kept:RuntimeWarning")
def test_a_disk_that_is_full_when_a_function_is_kept(doubled, tmp_path, monkeypatch):
    def full(self, path):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    for path in tmp_path.rglob("*.nb*"):
        path.unlink()
    monkeypatch.setattr(numba.core.caching.IndexDataCacheFile, "_open_for_write", full)
    assert doubled() == 0
    assert doubled() == 0


@pytest.mark.nightly
@pytest.mark.slow
def test_two_first_runs_at_once(tmp_path):
    assert [right(process) for process in [python(SMALL, NUMBA_CACHE_DIR=tmp_path) for _ in range(2)]] == [False] * 2
    assert not right(python(SMALL, NUMBA_CACHE_DIR=tmp_path))


WHOLE = """
    import numpy as np
    from eip_scipy import EIPRK4, Invariant, integrate
    from eip_scipy.problems import kepler
    from test_checkpoint import MASS, precession
    run = {run}
    assert run.compiled
    print(run.y[:, -1].tobytes().hex())
"""
RUNS = (
    "integrate(kepler(), (0, 20), method=EIPRK4)",
    "integrate(precession, (0, 6), np.array([0.6, 0.8j]), method=EIPRK4, h=0.03, invariants=MASS)",
)


@pytest.mark.nightly
@pytest.mark.slow
def test_two_whole_first_runs_at_once(tmp_path):
    """Of different kinds, so that the same functions are compiled for different types; then from the cache."""
    tests = [str(Path(__file__).parents[1]), str(Path(__file__).parents[1] / "run")]

    def both():
        codes = [f"import sys; sys.path += {tests!r}\n{textwrap.dedent(WHOLE.format(run=run))}" for run in RUNS]
        return [ended(process) for process in [python(code, NUMBA_CACHE_DIR=tmp_path) for code in codes]]

    first = both()
    assert [err for _, err in first] == ["", ""]
    assert both() == first
    files = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nb*")}
    assert both() == first
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nb*")} == files
