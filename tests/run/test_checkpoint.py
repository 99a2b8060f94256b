"""Checkpoint files and runs that are stopped and resumed: bit for bit, after any fault of process, disk or file."""

import contextlib
import errno
import io
import json
import os
import pickle
import re
import signal
import subprocess
import sys
import textwrap
import time
import warnings
import zipfile
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from numba import njit
from numpy.lib import format as npy
from systems import H_USES_F, JIT_H, JIT_L, H, L, jit_orbit, orbit, pericentre, same

from eip_scipy import (
    EIPDOP853,
    EIPGJ12,
    EIPGJ14,
    EIPRK2,
    EIPRK4,
    EIPRK5,
    EIPRK45,
    EIPRKN8,
    EIPRKN12,
    Invariant,
    checkpoint,
    integrate,
)
from eip_scipy.checkpoint import CheckpointError
from eip_scipy.run import driver as _driver
from eip_scipy.run import integrate as longrun
from eip_scipy.run import resume

Y0 = pericentre(0.6)


class BrokenOffError(Exception):
    pass


# Resuming, bit for bit.


def crossing(t, y):
    return y[1]


def attraction(t, q):
    return -q / np.hypot(*q) ** 3


def attraction_gradient(t, q, dq, out):
    r2 = q @ q
    out[:] = (3 * q * (q @ dq) / r2 - dq) / r2**1.5


CORRECTED = {"acceleration": attraction, "jacobian": attraction_gradient}


def falling(t, y):
    return y[0]


def third(t, y):
    return y[1]


falling.direction = -1
third.terminal = 2


@njit
def jit_crossing(t, y):
    return y[1]


@njit
def precession(t, y):
    return np.array([-1j * (y[0] + 0.3 * y[1]), -1j * (0.3 * y[0] - (1.0 + 0.1 * np.sin(t)) * y[1])])


@njit
def mass(t, y):
    return y[0].real ** 2 + y[0].imag ** 2 + y[1].real ** 2 + y[1].imag ** 2


@njit
def mass_gradient(t, y):
    return 2.0 * y


MASS = Invariant(mass, mass_gradient, name="mass")
SPAN, FRAME = (0.0, 6.0), (np.array([[1.0, 2.0, 0.0, 0.0]]), np.array([[0.5], [0.25], [0.0], [0.0]]))
FIXED = {"method": EIPRK4, "h": 0.03, "invariants": [H, L], "save_every": 7}
ADAPTIVE = {"method": EIPRK45, "rtol": 1e-7, "atol": 1e-10, "invariants": [H, L], "save_every": 3}
COMPLEX = FIXED | {"invariants": MASS, "compensated": True}

CASES = {
    "fixed": (orbit, Y0, FIXED),
    "a slope of its own": (orbit, Y0, FIXED | {"reuse_f": False}),
    "the slope of the raw step": (orbit, Y0, FIXED | {"invariants": [H_USES_F, L]}),
    "no estimate": (orbit, Y0, FIXED | {"metric": "euclidean", "method": EIPRK2, "h": 0.01}),
    "weights": (orbit, Y0, FIXED | {"metric": np.array([1.0, 1.0, 0.5, 0.5]), "frame": FRAME}),
    "every auto": (orbit, Y0, FIXED | {"every": "auto", "method": EIPDOP853, "h": 0.02}),
    "compensated": (orbit, Y0, FIXED | {"compensated": True, "h": 0.01}),
    "projected start": (
        orbit,
        Y0,
        FIXED | {"invariants": Invariant(H.fun, H.grad, target=-0.4), "project_initial": True},
    ),
    "samples": (orbit, Y0, FIXED | {"save_every": None, "t_eval": np.linspace(0.1, 5.9, 100)}),
    "adaptive": (orbit, Y0, ADAPTIVE),
    "adaptive, pair": (orbit, Y0, ADAPTIVE | {"method": EIPDOP853, "first_step": 1e-3, "rtol": 1e-11, "atol": 1e-13}),
    "adaptive, samples": (orbit, Y0, ADAPTIVE | {"save_every": None, "t_eval": np.linspace(0, 6, 300)}),
    "events": (orbit, Y0, FIXED | {"events": [crossing, falling]}),
    "adaptive, events": (orbit, Y0, ADAPTIVE | {"events": [falling, crossing]}),
    "an event that ends it": (orbit, Y0, FIXED | {"events": [crossing, third], "every": 45}),
    "Nystrom": (None, Y0, FIXED | {"method": EIPRKN8, "acceleration": attraction}),
    "Nystrom, all": (
        orbit,
        Y0,
        FIXED | {"method": EIPRKN12, "h": 0.05, "every": "auto", "compensated": True, "save_every": 2},
    ),
    "multistep": (None, Y0, FIXED | {"method": EIPGJ12, "acceleration": attraction, "h": 0.01}),
    "multistep, corrected": (None, Y0, FIXED | {"method": EIPGJ14, "h": 0.01, **CORRECTED}),
    "complex": (
        precession,
        np.array([0.6, 0.8j]),
        FIXED | {"invariants": MASS, "compensated": True, "compiled": False},
    ),
}
JIT = {"invariants": [JIT_H, JIT_L], "compiled": True}
COMPILED = {
    "compensated, every auto": (jit_orbit, Y0, FIXED | JIT | {"every": "auto", "compensated": True, "h": 0.01}),
    "adaptive": (jit_orbit, Y0, ADAPTIVE | JIT),
    "events": (jit_orbit, Y0, FIXED | JIT | {"events": jit_crossing}),
    "Nystrom": (
        None,
        Y0,
        FIXED
        | JIT
        | {"acceleration": njit(lambda t, q: -q / (q[0] * q[0] + q[1] * q[1]) ** 1.5)}
        | {"method": EIPRKN12, "h": 0.05, "every": 5},
    ),
    "complex": (precession, np.array([0.6, 0.8j]), COMPLEX | {"compiled": True}),
}
AT_ONCE = ("compensated, every auto", "events", "Nystrom")


@pytest.fixture
def fine(monkeypatch):
    """Return short chunks with a snapshot after each; values that are not in a checkpoint are NaN in a resumed run."""
    monkeypatch.setattr(longrun, "FIRST_CHUNK", 5)
    monkeypatch.setattr(longrun, "CHUNK_SECONDS", 0.0)
    monkeypatch.setattr(resume, "SNAPSHOT_SECONDS", 0.0)
    monkeypatch.setattr(resume, "LEAST_RATIO", 0.0)
    load = longrun.Driver.load

    def poisoned(driver, *rows):
        known = [a.copy() for a in driver.parts().values()]
        w, grid = driver.run.work, driver.schedule
        for buffer in (*w.arrays().values(), grid.g_new, driver.new, driver.t, driver.y):
            buffer[...] = np.nan if buffer.dtype.kind in "fc" else 77
        for part, value in zip(driver.parts().values(), known, strict=True):
            part[...] = value
        load(driver, *rows)

    monkeypatch.setattr(longrun.Driver, "load", poisoned)


@contextlib.contextmanager
def broken_off(monkeypatch, calls):
    """Stop the run before the chunk of this number."""
    advance, left = longrun.Driver.advance, [calls]

    def stop(driver, k_end):
        left[0] -= 1
        if left[0] < 0:
            raise BrokenOffError
        return advance(driver, k_end)

    with monkeypatch.context() as patch:
        patch.setattr(longrun.Driver, "advance", stop)
        yield


def resumed(case, path, monkeypatch, first=7, more=9):
    """Stop a run repeatedly; return the result, and the number of stops."""
    fun, y0, options = case
    for k in range(1000):
        with contextlib.suppress(BrokenOffError), broken_off(monkeypatch, first if k == 0 else more):
            return integrate(fun, SPAN, y0, checkpoint=path, resume=True, **options), k
    raise AssertionError("the run does not advance")


@pytest.mark.usefixtures("fine")
@pytest.mark.parametrize("name", CASES)
def test_resumed_runs_are_the_same(name, tmp_path, monkeypatch):
    fun, y0, options = CASES[name]
    whole = integrate(fun, SPAN, y0, **options)
    found, times = resumed(CASES[name], tmp_path / "run", monkeypatch)
    assert times >= 4
    same(whole, found)
    assert found.status == (1 if "ends" in name and "event" in name else 0)


@pytest.mark.slow
@pytest.mark.needs_jit
@pytest.mark.usefixtures("fine")
@pytest.mark.parametrize("name", [k if k in AT_ONCE else pytest.param(k, marks=pytest.mark.nightly) for k in COMPILED])
def test_resumed_compiled_runs_are_the_same(name, tmp_path, monkeypatch):
    fun, y0, options = COMPILED[name]
    whole = integrate(fun, SPAN, y0, **options)
    found, times = resumed(COMPILED[name], tmp_path / "run", monkeypatch)
    assert times >= 4
    assert found.compiled
    same(whole, found)
    # A run may change its kind on the way: compiled and interpreted steps have the same bits.
    interpreted = (fun, y0, options | {"compiled": False})
    with contextlib.suppress(BrokenOffError), broken_off(monkeypatch, 6):
        integrate(fun, SPAN, y0, checkpoint=tmp_path / "other", **options)
    found, times = resumed(interpreted, tmp_path / "other", monkeypatch, first=1000)
    assert times == 0
    same(whole, found)


@pytest.mark.slow
@pytest.mark.usefixtures("fine")
@pytest.mark.parametrize(
    "name",
    ["fixed", "adaptive, events", "Nystrom, all"]
    + [pytest.param(name, marks=pytest.mark.nightly) for name in ("compensated", "every auto", "adaptive")],
)
def test_broken_off_inside_a_step(name, tmp_path):
    """A step may be left anywhere: its half-filled buffers are not kept."""
    fun, y0, options = CASES[name]
    whole = integrate(fun, SPAN, y0, **options)
    for last in (9, *range(150, 158), whole.nfev - 10):
        calls = [0]

        def counted(t, y, last=last, calls=calls):
            calls[0] += 1
            if calls[0] == last:
                raise KeyboardInterrupt
            return fun(t, y)

        path = tmp_path / f"run-{last}"
        with pytest.raises(KeyboardInterrupt) as info:
            integrate(counted, SPAN, y0, checkpoint=path, **options)
        partial = info.value.partial
        np.testing.assert_array_equal(partial.t[:-1], whole.t[: partial.t.size - 1])
        found = integrate(fun, SPAN, y0, checkpoint=path, resume=True, **options)
        step = checkpoint_step(info.value)
        assert found.message.startswith(f"reached the end of the interval (resumed at step {step}")
        assert step > 0 or last == 9
        same(whole, found)


def checkpoint_step(error):
    """Return the step that the note of an exception names."""
    (note,) = error.__notes__
    return int(re.search(r"holds step (\d+), t = [-\d.e]+: the same call with resume=True continues", note)[1])


@pytest.mark.usefixtures("fine")
def test_a_result_is_there_at_once(tmp_path):
    """A finished run that is resumed calls nothing beyond its start and leaves the file alone."""
    calls = [0]

    def counted(t, y):
        calls[0] += 1
        return orbit(t, y)

    path = tmp_path / "run.npz"
    seen = []
    options = FIXED | {"callback": lambda t, y, defects: seen.append(t), "checkpoint": path}
    whole = integrate(counted, SPAN, Y0, **options)
    before, content = calls[0], path.read_bytes()
    seen.clear()
    again = integrate(counted, SPAN, Y0, resume=True, **options)
    same(whole, again)
    assert calls[0] - before < 20
    assert seen == []
    assert path.read_bytes() == content
    assert again.wall_time >= checkpoint.read(path)[0]["wall_time"] > 0
    assert "resumed at step 200" in again.message
    # Nor does it need a folder that can be written to.
    assert [entry.name for entry in tmp_path.iterdir()] == ["run.npz"]


@pytest.mark.usefixtures("fine")
def test_a_failed_run_fails_again(tmp_path):
    def fun(t, y):
        return orbit(t, y) * (np.nan if t > 3.0 else 1.0)

    path = tmp_path / "run"
    failed = integrate(fun, SPAN, Y0, checkpoint=path, **FIXED)
    assert failed.status == -1
    assert checkpoint.read(path)[0]["status"] == -1
    same(failed, integrate(fun, SPAN, Y0, checkpoint=path, resume=True, **FIXED))
    # And succeeds where the reason has gone.
    same(integrate(orbit, SPAN, Y0, **FIXED), integrate(orbit, SPAN, Y0, checkpoint=path, resume=True, **FIXED))


@pytest.mark.usefixtures("fine")
def test_an_endless_run(tmp_path, monkeypatch):
    """No known number of rows: they grow beyond what is allocated, before an interruption and after it."""
    monkeypatch.setattr(_driver, "FIRST_ROWS", 4)
    options = FIXED | {"events": third, "save_every": 3}
    whole = integrate(orbit, (0, np.inf), Y0, **options)
    assert whole.status == 1
    with pytest.raises(BrokenOffError), broken_off(monkeypatch, 40):
        integrate(orbit, (0, np.inf), Y0, checkpoint=tmp_path / "run", **options)
    same(whole, integrate(orbit, (0, np.inf), Y0, checkpoint=tmp_path / "run", resume=True, **options))


# When checkpoints are written.


def times_written(monkeypatch, path, every, seconds=0.0, **options):
    """Return the times of writing in a run of 200 chunks of 10 ms of a simulated clock, with `seconds` for each."""
    now, written, advance, write = [0.0], [], longrun.Driver.advance, checkpoint.write

    def tick(driver, k_end):
        now[0] += 0.01
        return advance(driver, min(k_end, driver.step + 1))

    def note(path, header, arrays):
        now[0] += seconds
        written.append((now[0], header["step"], header["status"]))
        write(path, header, arrays)

    with monkeypatch.context() as patch:
        patch.setattr(longrun.Driver, "advance", tick)
        patch.setattr(resume.time, "perf_counter", lambda: now[0])
        patch.setattr(checkpoint, "write", note)
        integrate(orbit, SPAN, Y0, checkpoint=path, checkpoint_every=every, **FIXED | options)
    return written


def test_checkpoint_every(tmp_path, monkeypatch):
    written = times_written(monkeypatch, tmp_path / "a", 0.5)
    np.testing.assert_allclose([t for t, _, _ in written], [0.0, 0.5, 1.0, 1.5, 2.0], atol=0.025)
    assert [status for _, _, status in written] == [None] * 4 + [0]
    assert written[1][1] == pytest.approx(50, abs=1)
    assert [step for _, step, _ in times_written(monkeypatch, tmp_path / "b", np.inf)] == [0, 200]


def test_writing_takes_a_twentieth_of_the_time(tmp_path, monkeypatch):
    written = times_written(monkeypatch, tmp_path / "a", 0.01, seconds=0.02)
    gaps = np.diff([t for t, _, _ in written])[:-1]
    assert gaps.size > 3
    assert (gaps >= 0.4 - 1e-9).all()
    assert (gaps <= 0.45).all()


# Files that are there, that are not, and runs that do not fit.


def test_a_file_that_is_there_is_not_replaced(tmp_path):
    path = tmp_path / "run"
    for content in (b"", b"my only copy"):
        path.write_bytes(content)
        with pytest.raises(CheckpointError, match=r"exists\. Pass resume=True to continue .* delete this one"):
            integrate(orbit, SPAN, Y0, checkpoint=path, **FIXED)
        with pytest.raises(CheckpointError, match="is damaged, or not a checkpoint of eip_scipy"):
            integrate(orbit, SPAN, Y0, checkpoint=path, resume=True, **FIXED)
        assert path.read_bytes() == content


def test_no_file_yet(tmp_path):
    found = integrate(orbit, SPAN, Y0, checkpoint=tmp_path / "run", resume=True, **FIXED)
    assert "there was no checkpoint: started at the beginning" in found.message
    same(integrate(orbit, SPAN, Y0, **FIXED), found)
    assert "checkpoint" not in integrate(orbit, SPAN, Y0, checkpoint=tmp_path / "other", **FIXED).message


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        ({"resume": True}, ValueError, "resume=True needs a file to resume from: pass checkpoint=path"),
        ({"resume": "yes", "checkpoint": "a"}, ValueError, "resume must be True or False, got 'yes'"),
        ({"checkpoint": 3}, TypeError, "checkpoint must be the path of a file, got 3"),
        ({"checkpoint": "a", "checkpoint_every": 0}, ValueError, "checkpoint_every must be a number of seconds > 0"),
        ({"checkpoint": "a", "checkpoint_every": "1 min"}, ValueError, "checkpoint_every .* got '1 min'"),
        ({"checkpoints": "a"}, TypeError, "did you mean 'checkpoint'"),
        ({"checkpoint": "no/such/folder/a"}, CheckpointError, "cannot write .*folder.+a'.* (no such file|path not)"),
        ({"checkpoint": "."}, CheckpointError, "' exists"),
        (
            {"checkpoint": ".", "resume": True},
            CheckpointError,
            "cannot read the checkpoint '.*': (is a dir|permission)",
        ),
    ],
)
def test_bad_options(options, error, match, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(error, match=match):
        integrate(orbit, SPAN, Y0, **FIXED | options)
    assert list(tmp_path.iterdir()) == []


OTHERS = {
    "method": {"method": EIPRK5},
    "h": {"h": 0.02},
    "rtol": {"rtol": 1e-4},
    "invariants": {"invariants": [H]},
    "metric": {"metric": "euclidean"},
    "blocks": {"blocks": 2},
    "frame": {"frame": FRAME},
    "direction": {"direction": "midpoint"},
    "iterations": {"iterations": 2},
    "every": {"every": 2},
    "reuse_f": {"reuse_f": False},
    "compensated": {"compensated": True},
    "save_every": {"save_every": 8},
    "t_eval": {"save_every": None, "t_eval": [0.0, 1.0]},
    "events": {"events": crossing},
    "params": {"params": [1.0]},
    "y0": {"y0": pericentre(0.5)},
    "t_span": {"t_span": (0, 7)},
}


@pytest.fixture(scope="module")
def old_run(tmp_path_factory):
    """Return a finished run of FIXED, and its file."""
    path = tmp_path_factory.mktemp("checkpoint") / "run"
    return integrate(orbit, SPAN, Y0, checkpoint=path, **FIXED), path


@pytest.mark.parametrize("name", OTHERS)
def test_other_arguments_are_named(name, old_run):
    _, path = old_run
    fun = (lambda t, y, p: orbit(t, y)) if name == "params" else orbit
    options = {"t_span": SPAN, "y0": Y0, **FIXED, **OTHERS[name]}
    if name == "params":
        options["invariants"] = [Invariant(lambda t, y, p: H.fun(t, y), lambda t, y, p: H.grad(t, y), name="energy")]
    with pytest.raises(
        CheckpointError, match=rf"belongs to another run: (.*; )?{name} (is .* in the checkpoint and|differs)"
    ) as info:
        integrate(fun, checkpoint=path, resume=True, **options)
    assert "Resume with the arguments of that run, or use another file" in str(info.value)


@pytest.mark.usefixtures("fine")
@pytest.mark.parametrize(
    ("fun", "invariants", "match"),
    [
        (
            lambda t, y: orbit(t, y) * (1.0 if t < 1.0 else 1.001),
            [H, L],
            r"fun was \S+ at t = \S+, where it was saved",
        ),
        (
            orbit,
            [Invariant(lambda t, y: H.fun(t, y) + (t > 1.0) * 1e-6, H.grad, name="energy"), L],
            r"invariant 'energy' was \S+ at t = \S+, where it was saved, and is \S+ now\. Resume with",
        ),
        (lambda t, y: orbit(t, y) * (1 + 1e-15), [H, L], None),
        (orbit, [Invariant(lambda t, y: H.fun(t, y) * (1 + 1e-13), H.grad, name="energy"), L], None),
    ],
)
def test_another_function_is_seen_at_the_stored_state(fun, invariants, match, tmp_path, monkeypatch):
    """Functions may differ by rounding, as on another processor; the targets remain those of the first run."""
    path = tmp_path / "run"
    options = FIXED | {"checkpoint": path, "invariants": invariants, "check": False, "resume": True}
    with pytest.raises(BrokenOffError), broken_off(monkeypatch, 100):
        integrate(orbit, SPAN, Y0, **options | {"invariants": [H, L]})
    before = path.read_bytes()
    if match is None:
        assert integrate(fun, SPAN, Y0, **options).status == 0
        np.testing.assert_array_equal(checkpoint.read(path)[1]["target"], [H.fun(0, Y0), L.fun(0, Y0)])
    else:
        with pytest.raises(CheckpointError, match=f"belongs to another run: {match}"):
            integrate(fun, SPAN, Y0, **options)
        assert path.read_bytes() == before


def test_a_function_that_no_longer_answers(tmp_path):
    """The exception that stops the run cannot be inspected again; the run is kept nevertheless."""
    gone = []

    def fun(t, y):
        if gone or t > 3.0:
            gone.append(t)
            raise RuntimeError("the licence server is down")
        return orbit(t, y)

    with pytest.raises(RuntimeError, match="licence"):
        integrate(fun, SPAN, Y0, checkpoint=tmp_path / "run", **FIXED)
    assert "state_f" not in checkpoint.read(tmp_path / "run")[1]
    found = integrate(orbit, SPAN, Y0, checkpoint=tmp_path / "run", resume=True, **FIXED)
    same(integrate(orbit, SPAN, Y0, **FIXED), found)


def test_another_kind_of_checkpoint(tmp_path):
    path = tmp_path / "members"
    checkpoint.write(path, {"kind": "ensemble"}, {"y": np.zeros((3, 4))})
    with pytest.raises(CheckpointError, match="is a checkpoint of 'ensemble', expected 'integrate'"):
        integrate(orbit, SPAN, Y0, checkpoint=path, resume=True, **FIXED)


def rewritten(path, change):
    """The file with header and arrays changed, sealed again as `write` does it."""
    header, arrays = checkpoint.read(path)
    change(header, arrays)
    checkpoint.write(path, header, arrays)


CHANGES = {
    "an array is missing": (lambda h, a: a.pop("clock"), "clock is missing"),
    "another shape": (lambda h, a: a.update(carry=np.zeros(5)), r"carry is float64 \(5,\), expected float64 \(4,\)"),
    "another type": (lambda h, a: a.update(y=a["y"] * 1j), "y is complex128"),
    "rows are missing": (lambda h, a: a.update(saved_y=a["saved_y"][1:]), r"saved_y is float64 \(29, 4\), expected"),
    "a negative number of rows": (lambda h, a: a.update(place=np.array([5, -1, 0])), "step 5, -1 rows"),
    "no settings": (lambda h, a: h.pop("settings"), "belongs to another run: method is null in the checkpoint"),
    "settings of another kind": (lambda h, a: h.update(settings=[1]), "belongs to another run"),
    "no time": (lambda h, a: h.update(wall_time="long"), "is not a checkpoint of this run"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_files_that_others_made(name, old_run, tmp_path):
    change, match = CHANGES[name]
    path = tmp_path / "run"
    path.write_bytes(old_run[1].read_bytes())
    rewritten(path, change)
    with pytest.raises(CheckpointError, match=match):
        integrate(orbit, SPAN, Y0, checkpoint=path, resume=True, **FIXED)


def test_other_versions_are_a_warning(old_run, tmp_path, monkeypatch):
    path = tmp_path / "run"
    path.write_bytes(old_run[1].read_bytes())
    monkeypatch.setattr(checkpoint, "_versions", lambda: {"numpy": "1.0", "numba": None})
    with pytest.warns(
        UserWarning, match=r"written with .*numpy 2\.\S+, here 1.0; numba .*: the last bits may"
    ) as record:
        found = integrate(orbit, SPAN, Y0, checkpoint=path, resume=True, **FIXED)
    assert record[0].filename == __file__
    same(old_run[0], found)


# The file.


def test_header_and_arrays(tmp_path):
    path = tmp_path / "a.npz"
    arrays = {
        "x": np.linspace(0, 1, 7),
        "none": np.zeros((0, 3)),
        "z": np.array([[1 + 2j, np.nan]]),
        "n": np.array(3),
        "columns": np.arange(12.0).reshape(3, 4).T,
        "bits": np.array([True, False]),
        "extremes": np.array([-0.0, 5e-324, np.inf, 0.1 + 0.2]),
    }
    checkpoint.write(path, {"kind": "test", "a": [1, 2.5, None], "b": "ü"}, arrays)
    header, found = checkpoint.read(path, "test")
    assert (header["kind"], header["a"], header["b"]) == ("test", [1, 2.5, None], "ü")
    assert header["schema"] == 1
    assert header["arrays"] == list(arrays)
    assert header["versions"]["numpy"] == np.__version__
    assert list(found) == list(arrays)
    with np.load(path, allow_pickle=False) as plain:
        for name, a in arrays.items():
            assert found[name].dtype == plain[name].dtype == a.dtype
            assert found[name].shape == a.shape
            assert found[name].tobytes() == plain[name].tobytes() == a.tobytes()
    with zipfile.ZipFile(path) as archive:
        assert json.loads(archive.read("header.json")) == header
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.npz"]


def test_leftovers_of_killed_processes_are_removed(tmp_path):
    names = [".a-1.tmp", ".a-2.tmp", ".ab-1.tmp", "a-1.tmp", ".b-1.tmp"]
    for name in names:
        (tmp_path / name).touch()
        if name != ".a-2.tmp":
            os.utime(tmp_path / name, (time.time() - 4000,) * 2)
    checkpoint.write(tmp_path / "a", {"kind": "test"}, {})
    assert {entry.name for entry in tmp_path.iterdir()} == {"a", *names[1:]}


# Damage.


def small_file(path):
    checkpoint.write(path, {"kind": "test"}, {"x": np.arange(3.0), "n": np.array([7, 8], np.int32)})
    return path.read_bytes()


def outcome(path):
    """Return the contents, or check that the file is refused by the one kind of error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            header, arrays = checkpoint.read(path)
        except CheckpointError:
            return "refused"
    assert all(a.nbytes < 10**4 for a in arrays.values())
    return header, {name: (a.dtype, a.tolist()) for name, a in arrays.items()}


def test_changed_and_missing_bytes(tmp_path):
    """Some bytes are in no checksum, dates for instance; whatever they are, header and arrays are those written."""
    path = tmp_path / "a"
    raw = small_file(path)
    known, refused = outcome(path), 0
    for k in range(len(raw)):
        for bits in (1 << k % 8, 255):
            path.write_bytes(raw[:k] + bytes([raw[k] ^ bits]) + raw[k + 1 :])
            found = outcome(path)
            refused += found == "refused"
            assert found in (known, "refused")
        path.write_bytes(raw[:k])
        assert outcome(path) == "refused"
    assert refused > 1.5 * len(raw)


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_mutations(data, tmp_path):
    """Pieces cut out, doubled, overwritten, moved: a file is refused, or what is read is what was written."""
    path = tmp_path / "a"
    raw = small_file(path)
    known = outcome(path)
    for _ in range(data.draw(st.integers(1, 4))):
        i, j = sorted(data.draw(st.tuples(*[st.integers(0, len(raw))] * 2)))
        new = data.draw(st.one_of(st.binary(max_size=40), st.just(raw[i:j] * 2), st.just(b"\xff" * (j - i))))
        raw = raw[:i] + new + raw[j:]
    path.write_bytes(raw)
    assert outcome(path) in (known, "refused")


def forged(path, name, member, header=None):
    """Write a file with the given bytes of one member and the header."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(
            "header.json",
            json.dumps({"format": "eip_scipy checkpoint", "schema": 1, "arrays": [name[:-4]], **(header or {})}),
        )
        archive.writestr(name, member)


def npy_bytes(descr, shape, data, fortran=False):
    stream = io.BytesIO()
    npy.write_array_header_1_0(stream, {"descr": descr, "fortran_order": fortran, "shape": shape})
    return stream.getvalue() + data


class Bomb:
    def __reduce__(self):
        return Path.touch, (Path("exploded"),)


def test_nothing_is_unpickled(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data = pickle.dumps(Bomb())
    pickle.loads(data)
    assert Path("exploded").exists()  # the bomb works
    Path("exploded").unlink()
    path = tmp_path / "a"
    forged(path, "x.npy", npy_bytes("|O", (1,), data))
    with pytest.raises(CheckpointError, match=r"x\.npy holds object"):
        checkpoint.read(path)
    forged(path, "x.pkl", data)
    with pytest.raises(CheckpointError, match="not a checkpoint"):
        checkpoint.read(path)
    assert not Path("exploded").exists()


@pytest.mark.parametrize("shape", [(10**15,), (10**6, 10**6, 10**6), (2**62, 4), (3,), (-1, -1), (10**400,)])
def test_declared_sizes_are_checked_before_they_are_allocated(shape, tmp_path):
    path = tmp_path / "a"
    forged(path, "x.npy", npy_bytes("<f8", shape, bytes(8)))
    with pytest.raises(CheckpointError, match=r"x\.npy (declares|holds)|not a checkpoint"):
        checkpoint.read(path)


def test_foreign_archives(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, x=np.arange(3))
    with pytest.raises(CheckpointError, match=r"not a checkpoint of eip_scipy: .* its members are \['x\.npy'\]"):
        checkpoint.read(path)
    for versions, named in (({}, "unknown"), ({"versions": {"eip_scipy": "0.2.0"}}, "0.2.0")):
        forged(path, "x.npy", npy_bytes("<f8", (1,), bytes(8)), {"schema": 2, **versions})
        with pytest.raises(CheckpointError, match=rf"has schema 2, expected 1; .* that wrote it \({named}\)\."):
            checkpoint.read(path)
    forged(path, "x.npy", npy_bytes("<f8", (1, 1), bytes(8), fortran=True))
    with pytest.raises(CheckpointError, match="not a checkpoint"):
        checkpoint.read(path)
    forged(path, "x.npy", npy_bytes("<f8", (1,), bytes(8)), {"format": "another"})
    with pytest.raises(CheckpointError, match="its header does not name the format"):
        checkpoint.read(path)
    old = io.BytesIO()
    npy.write_array(old, np.zeros(1), version=(2, 0))
    forged(path, "x.npy", old.getvalue())
    with pytest.raises(CheckpointError, match=r"x\.npy does not have version 1\.0 of the npy format"):
        checkpoint.read(path)
    # Members of the same bytes: 40 arrays of 1 kB in a file of a few.
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(
            "header.json",
            json.dumps({"format": "eip_scipy checkpoint", "schema": 1, "arrays": [f"x{k}" for k in range(40)]}),
        )
        archive.writestr("x0.npy", npy_bytes("<f8", (128,), bytes(1024)))
        first = archive.filelist[-1]
        for k in range(1, 40):
            twin = zipfile.ZipInfo(f"x{k}.npy")
            for name in ("CRC", "compress_size", "file_size", "header_offset"):
                setattr(twin, name, getattr(first, name))
            archive.filelist.append(twin)
    with pytest.raises(CheckpointError, match="its members claim more bytes than it has"):
        checkpoint.read(path)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("header.json", bytes(10**7))
    with pytest.raises(CheckpointError, match="compressed"):
        checkpoint.read(path)


# Disks that are full.


class FullDisk(io.FileIO):
    """File whose write of a given number finds the disk full after half of it."""

    def __init__(self, path, mode, room):
        super().__init__(path, mode)
        self.room = room

    def write(self, data):
        self.room[0] -= 1
        if self.room[0] == 0:
            super().write(bytes(data)[: len(data) // 2])
        if self.room[0] <= 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return super().write(data)


def fill_disk(patch, writes):
    """From now on, fill the disk at the write of this number."""
    room = [writes]
    patch.setattr(
        checkpoint, "open", lambda path, mode: io.BufferedWriter(FullDisk(path, mode, room), 16), raising=False
    )
    return room


def test_a_full_disk_at_each_write(tmp_path, monkeypatch):
    path = tmp_path / "a"
    before, messages = small_file(path), set()
    for writes in range(1, 10**6):
        with monkeypatch.context() as patch:
            room = fill_disk(patch, writes)
            try:
                checkpoint.write(path, {"kind": "new"}, {"x": np.arange(100)})
                break
            except CheckpointError as error:
                messages.add(str(error))
        assert path.read_bytes() == before
        assert [entry.name for entry in tmp_path.iterdir()] == ["a"]
    assert room[0] > 0
    assert writes > 10
    assert messages == {f"cannot write the checkpoint {str(path)!r}: no space left on device"}
    assert checkpoint.read(path)[0]["kind"] == "new"


@pytest.mark.usefixtures("fine")
def test_a_run_goes_on_while_the_disk_is_full(tmp_path, monkeypatch):
    whole, path = integrate(orbit, SPAN, Y0, **FIXED), tmp_path / "run"
    write, calls = checkpoint.write, []

    def full_for_a_while(path, header, arrays):
        calls.append(header["step"])
        if 6 <= len(calls) <= 8:
            raise CheckpointError("cannot write the checkpoint: no space left on device")
        write(path, header, arrays)

    monkeypatch.setattr(checkpoint, "write", full_for_a_while)
    match = r"no space left on device; it still holds step 7, t = 0\.21\. The run continues and tries again"
    with pytest.warns(RuntimeWarning, match=match) as record:
        found = integrate(orbit, SPAN, Y0, checkpoint=path, checkpoint_every=1e-9, **FIXED)
    assert len(record) == 3
    assert all(warning.filename == __file__ for warning in record)
    same(whole, found)
    assert "space" not in found.message
    assert checkpoint.read(path)[0]["status"] == 0


@pytest.mark.usefixtures("fine")
def test_interrupted_with_a_full_disk(tmp_path, monkeypatch):
    """The disk does not hide the first exception, its partial result, or the step of the checkpoint that is there."""
    path = tmp_path / "run"

    def fun(t, y):
        if t > 1.5:
            fill_disk(monkeypatch, 3)
            raise BrokenOffError
        return orbit(t, y)

    with pytest.raises(BrokenOffError) as info:
        integrate(fun, SPAN, Y0, checkpoint=path, checkpoint_every=1e9, **FIXED)
    assert info.value.partial.t[-1] > 1.0
    first, second = info.value.__notes__
    assert "no space left" in first
    assert f"{str(path)!r} holds step 0, t = 0: the same call with resume=True continues from there" in second
    monkeypatch.undo()
    assert checkpoint.read(path)[0]["step"] == 0


# Processes that are killed.


def python(code, *arguments):
    command = [sys.executable, "-c", textwrap.dedent(code), *map(str, arguments)]
    return subprocess.Popen(command, cwd=Path(__file__).parents[1], stderr=subprocess.PIPE, text=True)


RUN = """
    import sys
    import numpy as np
    from systems import H, L, orbit, pericentre
    from eip_scipy import EIPRK4, integrate

    integrate(orbit, (0, 3000), pericentre(0.6), method=EIPRK4, h=0.01, invariants=[H, L], save_every=10, every="auto",
              checkpoint=sys.argv[1], checkpoint_every=0.05, resume=True)
"""


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.posix
@pytest.mark.parametrize("name", ["SIGKILL", "SIGINT"])
def test_a_run_is_killed_again_and_again(name, tmp_path):
    options = {"method": EIPRK4, "h": 0.01, "invariants": [H, L], "save_every": 10, "every": "auto"}
    whole, path, steps = integrate(orbit, (0, 3000), Y0, **options), tmp_path / "run", [0]
    for _ in range(3):
        process = python(RUN, path)
        deadline = time.monotonic() + 60
        while (not path.exists() or checkpoint.read(path)[0]["step"] <= steps[-1]) and time.monotonic() < deadline:
            time.sleep(0.01)
        time.sleep(0.1)
        process.send_signal(getattr(signal, name))
        _, err = process.communicate(timeout=60)
        steps.append(checkpoint.read(path)[0]["step"])
        if name == "SIGINT":
            assert f"KeyboardInterrupt\nthe checkpoint {str(path)!r} holds step {steps[-1]}, t = " in err
    assert 0 < steps[1] < steps[2] < steps[3] < 300_000
    same(whole, integrate(orbit, (0, 3000), Y0, checkpoint=path, resume=True, **options))
