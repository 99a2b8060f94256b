"""Exclusive use of checkpoint files by a run, against other runs and processes, and SIGTERM."""

import contextlib
import os
import signal
import threading
import time

import numpy as np
import pytest
from forked import Forker
from systems import SQUARE, H, L, orbit, oscillator, pericentre

from eip_scipy import EIPRK4, ensemble, integrate
from eip_scipy.checkpoint import CheckpointError, held

Y0 = pericentre(0.6)
SPAN = (0.0, 6.0)
OPTIONS = {"method": EIPRK4, "h": 0.03, "invariants": [H, L], "save_every": 7, "compiled": False}
posix = pytest.mark.posix


def run(place, fun=orbit, **more):
    return integrate(fun, SPAN, Y0, checkpoint=place, **OPTIONS | more)


def members(**more):
    y0s = np.random.default_rng(3).standard_normal((11, 2))
    options = {"h": 0.1, "invariants": SQUARE, "save_every": 4, "chunk": 3, "compiled": False}
    return ensemble(more.pop("fun", oscillator), (0, 1), y0s, **options | more)


def kept_by_integrate(place, **more):
    return run(place, **more)


def kept_by_ensemble(place, **more):
    return members(checkpoint=place, **more)


keeping = pytest.mark.parametrize("keep", [kept_by_integrate, kept_by_ensemble])


def same(one, other):
    for key in ("t", "y", "max_residual", "status", "nfev"):
        np.testing.assert_array_equal(one[key], other[key], err_msg=key)


def content(folder):
    return sorted(entry.name for entry in folder.iterdir())


@pytest.fixture(scope="module")
def forker(tmp_path_factory):
    found = Forker(tmp_path_factory.mktemp("forked"))
    yield found
    found.close()


def at_once(action):
    """Return a callback that acts at its first call."""
    calls = []

    def callback(*_):
        if not calls:
            calls.append(action())

    return callback


@keeping
def test_a_relative_path_is_that_of_the_start(keep, tmp_path, monkeypatch):
    here, elsewhere = tmp_path / "here", tmp_path / "elsewhere"
    for folder in (here, elsewhere):
        folder.mkdir()
    (elsewhere / "kept").write_bytes(b"another's")
    monkeypatch.chdir(here)
    whole = keep("kept", callback=lambda *_: os.chdir(elsewhere), checkpoint_every=1e-9)
    assert (elsewhere / "kept").read_bytes() == b"another's"
    assert content(elsewhere) == content(here) == ["kept"]
    monkeypatch.chdir(here)
    same(whole, keep("kept", resume=True))


IN_USE = rf"in use by another run \(process {os.getpid()} on \S+, this one\)\. Wait until that run ends"


@keeping
def test_a_second_call_is_refused(keep, tmp_path, monkeypatch):
    """The file is refused by another path as well; the first run is not disturbed, and leaves no files."""
    place, seen = tmp_path / "kept", []
    link = tmp_path / "link"
    monkeypatch.chdir(tmp_path)
    ways = [place, "kept", str(tmp_path / "." / "kept")]

    def callback(*_):
        link.unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # Windows asks for a privilege
            link.symlink_to(place)
        for way in [*ways, link] if link.is_symlink() else ways:
            for resume in (False, True):
                with pytest.raises(CheckpointError, match=IN_USE):
                    keep(way, resume=resume)
        seen.append(True)

    whole = keep(place, callback=callback)
    assert seen
    assert content(tmp_path) == ["kept", "link"] if link.is_symlink() else ["kept"]
    same(whole, keep(link if link.is_symlink() else place, resume=True))


HOLDER = """
    import test_keeping, time

    def callback(*_):
        print("running", flush=True)
        time.sleep(600)

    getattr(test_keeping, keep)(place, callback=callback, checkpoint_every=1e-9)
"""


@pytest.mark.slow
@posix
@keeping
def test_another_process(keep, tmp_path, forker):
    """Another process is named in the message, and its lock ends with it, by kill -9 too."""
    place = tmp_path / "kept"
    process = forker.start(HOLDER, keep=keep.__name__, place=str(place))
    try:
        process.until("running")
        with pytest.raises(CheckpointError, match=rf"in use by another run \(process {process.pid} on \S+\)\. Wait"):
            keep(place, resume=True)
    finally:
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    assert keep(place, resume=True).success
    assert content(tmp_path) == ["kept"]


@posix
@pytest.mark.parametrize("child", ["forked()", "subprocess.Popen(['sleep', '600']).pid"])
def test_children_do_not_keep_the_lock(child, tmp_path, forker):
    code = f"""
        import os, signal, subprocess, time
        from test_keeping import at_once, run

        def forked():
            out, into = os.pipe()
            pid = os.fork()
            if pid == 0:
                os.write(into, b"I run")
                time.sleep(600)
            os.read(out, 5)
            return pid

        def start():
            print({child}, flush=True)
            os.kill(os.getpid(), signal.SIGKILL)

        run(place, callback=at_once(start))
    """
    process = forker.start(code, place=str(tmp_path / "kept"))
    code, out, _ = process.wait()
    assert code == -signal.SIGKILL
    os.kill(int(out), 0)  # it is there
    try:
        assert run(tmp_path / "kept", resume=True).success
    finally:
        os.kill(int(out), signal.SIGKILL)


@posix
def test_a_link_in_the_place_of_the_lock(tmp_path):
    """A link planted by another user of the folder is not followed."""
    (tmp_path / "precious").write_bytes(b"precious")
    (tmp_path / ".kept.eip_scipy-lock").symlink_to(tmp_path / "precious")
    with pytest.raises(CheckpointError, match="cannot write"):
        run(tmp_path / "kept")
    assert (tmp_path / "precious").read_bytes() == b"precious"


@pytest.mark.slow
def test_one_holder_at_any_time(tmp_path):
    """Each run removes the lock's file when it ends: others that have it open detect that."""
    inside, most, taken, end = [0], [0], [0], time.monotonic() + 2.0

    def compete():
        while time.monotonic() < end:
            with contextlib.suppress(CheckpointError), held(tmp_path / "kept", "integrate", "run", False):
                inside[0] += 1
                most[0] = max(most[0], inside[0])
                taken[0] += 1
                time.sleep(0)
                inside[0] -= 1

    threads = [threading.Thread(target=compete) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == [1]
    assert taken[0] > 10
    assert content(tmp_path) == []


@posix
@pytest.mark.parametrize("keep", [kept_by_integrate, kept_by_ensemble])
def test_sigterm(keep, tmp_path):
    """It raises KeyboardInterrupt after the checkpoint is written; a handler of the user's is left alone."""
    place, seen = tmp_path / "kept", []

    def callback(*_):
        seen.append(signal.getsignal(signal.SIGTERM))
        if len(seen) == 3:
            os.kill(os.getpid(), signal.SIGTERM)

    with pytest.raises(KeyboardInterrupt) as info:
        keep(place, callback=callback)
    assert info.value.partial.t.size > 1
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    same(keep(tmp_path / "whole"), keep(place, resume=True))
    handled = []
    signal.signal(signal.SIGTERM, lambda *_: handled.append(True))
    try:
        seen.clear()
        assert keep(tmp_path / "other", callback=callback).success
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
    assert handled == [True]
