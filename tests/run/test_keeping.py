"""Exclusive use of files, functions, signals and disks by a run, against other runs."""

import contextlib
import errno
import os
import re
import signal
import subprocess
import threading
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
from forked import Forker
from systems import SQUARE, H, L, orbit, oscillator, pericentre

from eip_scipy import EIPRK4, Invariant, checkpoint, ensemble, integrate
from eip_scipy.checkpoint import CheckpointError
from eip_scipy.checkpoint.locks import Lock
from eip_scipy.run import resume as _resume

TESTS = Path(__file__).parents[1]
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


KEEPING = [kept_by_integrate, kept_by_ensemble]
keeping = pytest.mark.parametrize("keep", KEEPING)


def same(one, other):
    for key in ("t", "y", "max_defect", "status", "nfev"):
        np.testing.assert_array_equal(one[key], other[key], err_msg=key)


@pytest.fixture
def often(monkeypatch):
    """Return options of checkpoints after about every step."""
    from eip_scipy.run import integrate as longrun

    monkeypatch.setattr(longrun, "FIRST_CHUNK", 5)
    monkeypatch.setattr(longrun, "CHUNK_SECONDS", 0.0)
    monkeypatch.setattr(_resume, "SNAPSHOT_SECONDS", 0.0)
    monkeypatch.setattr(_resume, "LEAST_RATIO", 0.0)


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


# Location of a file.


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


def test_notes_name_the_file_wherever_one_is(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def callback(*_):
        os.chdir("/")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as info:
        run("kept", callback=callback)
    assert f"the checkpoint {str(tmp_path / 'kept')!r} holds step 0" in info.value.__notes__[-1]


@posix
@keeping
def test_a_relative_path_in_a_folder_that_is_gone(keep, tmp_path, monkeypatch):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    with pytest.raises(CheckpointError, match="'kept' is relative to a folder that no longer exists"):
        keep("kept")


# One run at a time.

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


def test_runs_of_different_kinds(tmp_path):
    def callback(*_):
        with pytest.raises(CheckpointError, match=IN_USE):
            kept_by_ensemble(tmp_path / "kept")

    run(tmp_path / "kept", callback=callback)


def test_a_second_thread_is_refused(tmp_path):
    found = []

    def other():
        try:
            run(tmp_path / "kept", resume=True)
        except CheckpointError as error:
            found.append(str(error))

    def callback(*_):
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()

    run(tmp_path / "kept", callback=callback)
    assert found
    assert all(re.search(IN_USE, text) for text in found)


@pytest.mark.parametrize("wrong", [{"h": -1.0}, {"metric": "unknown"}, {"save_every": 0}, {"events": 3}])
def test_a_call_that_fails_lets_go(wrong, tmp_path):
    with pytest.raises((TypeError, ValueError)):
        run(tmp_path / "kept", **wrong)
    assert content(tmp_path) == []
    run(tmp_path / "kept")


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
@keeping
@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS])
def test_where_locks_do_not_work(number, keep, tmp_path, monkeypatch):
    def flock(descriptor, operation):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("fcntl.flock", flock)
    with pytest.warns(RuntimeWarning, match=r"kept' could not be locked \(.*\)\. Make sure that") as record:
        whole = keep(tmp_path / "kept")
    assert [warning.filename for warning in record] == [__file__]
    assert content(tmp_path) == ["kept"]
    with pytest.warns(RuntimeWarning, match="could not be locked"):
        same(whole, keep(tmp_path / "kept", resume=True))


@posix
def test_a_folder_that_cannot_be_written_to(tmp_path, monkeypatch):
    """A finished run can be read there."""
    whole, place = run(tmp_path / "kept"), tmp_path / "kept"
    opened = os.open

    def refuse(path, flags, *mode):
        if flags & os.O_CREAT:
            raise OSError(errno.EROFS, os.strerror(errno.EROFS))
        return opened(path, flags, *mode)

    monkeypatch.setattr(os, "open", refuse)
    same(whole, run(place, resume=True))


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
            try:
                lock = Lock(tmp_path / "kept")
            except CheckpointError:
                continue
            inside[0] += 1
            most[0] = max(most[0], inside[0])
            taken[0] += 1
            time.sleep(0)
            inside[0] -= 1
            lock.close()

    threads = [threading.Thread(target=compete) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == [1]
    assert taken[0] > 10
    assert content(tmp_path) == []


# Files that are moved or replaced meanwhile.


def test_a_file_that_is_taken_away_comes_back(tmp_path):
    place = tmp_path / "kept"
    whole = run(place, callback=at_once(lambda: os.replace(place, tmp_path / "backup")), checkpoint_every=1e-9)
    assert checkpoint.read(place)[0]["status"] == 0
    same(whole, run(place, resume=True))


@pytest.mark.parametrize("keep", [kept_by_integrate, kept_by_ensemble])
def test_a_folder_in_the_place_of_the_file(keep, tmp_path):
    """The run ends nevertheless."""
    place = tmp_path / "kept"

    def change():
        place.unlink()
        place.mkdir()

    with pytest.warns(RuntimeWarning, match="cannot write the checkpoint .*: (is a directory|access denied)"):
        assert keep(place, callback=at_once(change)).success
    assert content(tmp_path) == ["kept"]


# Functions are compared at the step of the checkpoint, too.


def broken_off(place, **more):
    def callback(t, *_):
        if t > 3.0:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(place, callback=callback, **more)


def later(t, y):
    return orbit(t, y) * (1.0 if t < 1.0 else 1.001)


def energy_of_later(t, y):
    return H.fun(t, y) + (0.0 if t < 1.0 else 1e-6)


@pytest.mark.usefixtures("often")
@pytest.mark.parametrize(
    ("fun", "more", "match"),
    [
        (later, {}, r"fun was \S+ at t = 3\.\d+, where it was saved, and is \S+ now\. Resume with the functions"),
        (orbit, {"invariants": [Invariant(energy_of_later, H.grad, name="energy"), L], "check": False},
         r"invariant 'energy' was \S+ at t = 3\.\d+, where it was saved"),
    ],
)  # fmt: skip
def test_a_function_that_differs_later_is_seen(fun, more, match, tmp_path):
    place = tmp_path / "kept"
    broken_off(place)
    before = place.read_bytes()
    with pytest.raises(CheckpointError, match=match):
        run(place, fun, resume=True, **more)
    assert place.read_bytes() == before
    assert run(place, resume=True).success


@pytest.mark.usefixtures("often")
@pytest.mark.needs_jit
def test_compiled_functions_are_compared_there_before_they_are_compiled(tmp_path):
    from numba import njit
    from systems import jit_orbit

    @njit
    def other(t, y):
        out = jit_orbit(t, y)
        return out if t < 1.0 else 1.001 * out

    options = {"invariants": (), "compiled": None}
    broken_off(tmp_path / "kept", fun=jit_orbit, **options)
    with pytest.raises(CheckpointError, match=r"fun was .* where it was saved"):
        run(tmp_path / "kept", other, resume=True, **options)
    whole = integrate(jit_orbit, SPAN, Y0, **OPTIONS | options)
    same(whole, run(tmp_path / "kept", jit_orbit, resume=True, **options))


@pytest.mark.usefixtures("often")
def test_functions_may_differ_by_rounding_there(tmp_path):
    broken_off(tmp_path / "kept")
    assert run(tmp_path / "kept", lambda t, y: orbit(t, y) * (1 + 1e-14), resume=True).success


def test_evaluations_for_it_are_not_counted(tmp_path):
    assert run(tmp_path / "kept").nfev == integrate(orbit, SPAN, Y0, **OPTIONS).nfev


def test_a_function_that_no_longer_answers(tmp_path):
    """The exception that stops the run cannot be inspected again; the run is kept nevertheless."""
    gone = []

    def fun(t, y):
        if gone or t > 3.0:
            gone.append(t)
            raise RuntimeError("the licence server is down")
        return orbit(t, y)

    with pytest.raises(RuntimeError, match="licence"):
        run(tmp_path / "kept", fun)
    assert "state_f" not in checkpoint.read(tmp_path / "kept")[1]
    same(integrate(orbit, SPAN, Y0, **OPTIONS), run(tmp_path / "kept", resume=True))


# SIGTERM.

TERMINATED = """
    import os, signal, test_keeping, threading, time

    def callback(*_):
        calls.append(0)
        if len(calls) == 2:
            time.sleep(0.3)  # until the next snapshot
        if len(calls) == 3:
            exec(action, globals())

    calls = []
    exec(before, globals())
    getattr(test_keeping, keep)(place, callback=callback)
    print("went on")
"""
TERM = "os.kill(os.getpid(), signal.SIGTERM)"


@pytest.fixture
def terminated(forker):
    def found(place, keep=kept_by_integrate, action=TERM, before=""):
        return forker.start(TERMINATED, place=str(place), keep=keep.__name__, action=action, before=before).wait()

    return found


@posix
@pytest.mark.parametrize(
    "keep",
    [
        kept_by_ensemble,
        pytest.param(kept_by_integrate, marks=pytest.mark.slow),
    ],
)
def test_sigterm_waits_for_the_checkpoint(keep, tmp_path, terminated):
    """The process ends by the signal, as its sender expects, and the completed part is saved."""
    place, ran = tmp_path / "kept", []
    code, out, err = terminated(place, keep)
    assert (code, out) == (-signal.SIGTERM, "")
    assert content(tmp_path) == ["kept"]
    if keep is kept_by_integrate:
        where = (
            f"the checkpoint {str(place)!r} holds step 7, t = 0.21: the same call with resume=True continues from there"
        )
        assert err == f"SIGTERM\n{where}\n"
        found = keep(place, resume=True)
        assert "resumed at step 7" in found.message
        same(integrate(orbit, SPAN, Y0, **OPTIONS), found)
    else:
        assert err == "SIGTERM\n"
        same(members(), keep(place, resume=True, callback=lambda part: ran.append(part.first)))
        assert ran == [9]


@pytest.mark.slow
@posix
@pytest.mark.parametrize(
    "action",
    [
        f"for _ in range(3): {TERM}",
        f"class Dropped:\n  def __del__(self): {TERM}\nDropped()",
        f"try: {TERM}\nexcept BaseException: pass",
        f"try: {TERM}\nexcept BaseException: raise ValueError",
    ],
    ids=["again and again", "in a destructor", "swallowed", "turned into another error"],
)
def test_sigterm_however_it_is_met(action, tmp_path, terminated):
    code, out, _ = terminated(tmp_path / "kept", action=action)
    assert (code, out) == (-signal.SIGTERM, "")
    assert checkpoint.read(tmp_path / "kept")[0]["step"] >= 7
    assert run(tmp_path / "kept", resume=True).success


@posix
@pytest.mark.parametrize("handler", ["signal.SIG_IGN", "lambda *_: None"])
def test_a_handler_of_the_user_s_stays(handler, tmp_path, terminated):
    found = terminated(tmp_path / "kept", before=f"signal.signal(signal.SIGTERM, {handler})")
    assert found == (0, "went on\n", "")


@posix
def test_sigterm_in_a_thread(tmp_path, forker):
    """No handler can be installed from there: the process ends at once, with the existing checkpoint."""
    code = """
        import os, signal, threading, time
        from test_keeping import run

        def callback(t, *_):
            if t > 3:
                os.kill(os.getpid(), signal.SIGTERM)
                time.sleep(60)

        thread = threading.Thread(target=run, args=[place], kwargs={"callback": callback})
        thread.start()
        thread.join()
    """
    code, _, _ = forker.start(code, place=str(tmp_path / "kept")).wait()
    assert code == -signal.SIGTERM
    assert checkpoint.read(tmp_path / "kept")[0]["step"] == 0
    assert run(tmp_path / "kept", resume=True).success


@posix
def test_sigterm_without_a_checkpoint(forker):
    """There is nothing to keep: the signal has its usual effect."""
    code = """
        import os, signal
        from test_keeping import orbit, Y0
        from eip_scipy import EIPRK4, integrate

        def callback(*_):
            assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
            os.kill(os.getpid(), signal.SIGTERM)

        integrate(orbit, (0, 1), Y0, method=EIPRK4, h=0.1, save_every=1, callback=callback)
    """
    assert forker.start(code).wait() == (-signal.SIGTERM, "", "")


def test_sigterm_is_as_it_was_afterwards(tmp_path):
    run(tmp_path / "kept")
    with pytest.raises(ValueError, match="positive"):
        run(tmp_path / "other", h=-1)
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


@pytest.mark.slow
@posix
@pytest.mark.needs_jit
def test_sigterm_inside_a_compiled_run(tmp_path, forker):
    code = """
        import numpy as np
        from numba import njit
        from eip_scipy import EIPRK4, integrate

        fun = njit(lambda t, y: np.array([y[1], -y[0]]))
        integrate(fun, (0, 1), [1.0, 2.0], method=EIPRK4, h=1e-3, compiled=True)
        print("compiled", flush=True)
        integrate(fun, (0, 1e7), [1.0, 2.0], method=EIPRK4, h=1e-3, compiled=True, checkpoint=place)
    """
    place = tmp_path / "kept"
    process = forker.start(code, place=str(place))
    process.until("compiled")
    time.sleep(2.0)
    os.kill(process.pid, signal.SIGTERM)
    code, _, err = process.wait()
    assert code == -signal.SIGTERM
    header, _ = checkpoint.read(place)
    assert header["step"] > 1000
    assert f"holds step {header['step']}," in err


# Disks that are really full.


@pytest.fixture(params=["512k"])
def small_disk(tmp_path, request):
    """Return a file system of 512 kB, unless the test asks for another."""
    place = tmp_path / "disk"
    place.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={request.param}", "tmpfs", str(place)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        pytest.skip("there is no mount")
    if done.returncode:
        pytest.skip(f"no file system can be mounted here: {done.stderr.strip()}")
    yield place
    subprocess.run(["umount", str(place)], check=True)


def fill(folder):
    """Fill the remaining space."""
    with open(folder / "filler", "wb", buffering=0) as stream:
        while True:
            try:
                stream.write(bytes(512))
            except OSError:
                return


@pytest.mark.parametrize("small_disk", ["64k"], indirect=True)
def test_a_disk_fills_up_while_the_run_grows(small_disk):
    """There is no room for the former checkpoint and the next one: the run ends, and the former one is intact."""
    place, options = small_disk / "kept", {"save_every": 1, "h": 0.003}
    whole = integrate(orbit, SPAN, Y0, **OPTIONS | options)
    match = r"no space left on device; it still holds step .* The result is complete"
    with pytest.warns(RuntimeWarning, match=match):
        found = run(place, **options)
    same(whole, found)
    assert "no space left on device" in found.message
    assert content(small_disk) == ["kept"]
    with pytest.warns(RuntimeWarning, match="The result is complete"):
        same(whole, run(place, resume=True, **options))


@keeping
def test_a_disk_that_is_full_at_the_start(keep, small_disk):
    fill(small_disk)
    with pytest.raises(CheckpointError, match=re.compile("no space left on device", re.IGNORECASE)):
        keep(small_disk / "kept")
    (small_disk / "filler").unlink()
    assert keep(small_disk / "kept", resume=True).success


def test_an_ensemble_on_a_disk_that_fills_up(small_disk):
    place = small_disk / "kept"
    with pytest.warns(RuntimeWarning, match="no space left on device; the previous checkpoint is kept"):
        found = kept_by_ensemble(place, callback=at_once(lambda: fill(small_disk)), checkpoint_every=1e-9)
    same(members(), found)
    (small_disk / "filler").unlink()
    same(members(), kept_by_ensemble(place, resume=True))


@posix
def test_a_finished_run_on_a_read_only_disk(small_disk):
    whole = run(small_disk / "kept")
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        same(whole, run(small_disk / "kept", resume=True))
    with pytest.raises(CheckpointError, match=r"cannot write the checkpoint .*: read-only file system"):
        run(small_disk / "other")


@pytest.mark.parametrize("name", ["fsync", "replace"])
def test_a_full_disk_at_the_last_moment(name, tmp_path, monkeypatch):
    place, armed, real = tmp_path / "kept", [], getattr(os, name)
    whole = integrate(orbit, SPAN, Y0, **OPTIONS)

    def full(*arguments):
        if armed:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(*arguments)

    monkeypatch.setattr(os, name, full)
    with pytest.warns(RuntimeWarning, match="no space left on device; it still holds step 0"):
        same(whole, run(place, callback=at_once(lambda: armed.append(True))))
    monkeypatch.undo()
    assert checkpoint.read(place)[0]["step"] == 0
    assert content(tmp_path) == ["kept"]
    same(whole, run(place, resume=True))
