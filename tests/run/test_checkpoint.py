"""Checkpoint files and runs that are stopped and resumed: bit for bit, after any fault of process, disk or file."""

import errno
import io
import itertools
import json
import os
import pickle
import re
import time
import warnings
import zipfile
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from numpy.lib import format as npy
from systems import H_USES_F, H, L, orbit, pericentre, refuse, same

from eip_scipy import EIPRK4, EIPRK5, EIPRK45, EIPRKN12, Invariant, checkpoint, integrate
from eip_scipy.checkpoint import CheckpointError

Y0 = pericentre(0.6)


def crossing(t, y):
    return y[1]


def falling(t, y):
    return y[0]


falling.direction = -1
FRAME = (np.array([[1.0, 2.0, 0.0, 0.0]]), np.array([[0.5], [0.25], [0.0], [0.0]]))
FIXED = {"method": EIPRK4, "h": 0.03, "invariants": [H, L], "save_every": 7}


def run(**options):
    return integrate(**{"fun": orbit, "t_span": (0.0, 6.0), "y0": Y0} | FIXED | options)


@pytest.mark.slow
@pytest.mark.usefixtures("fine")
@pytest.mark.parametrize(
    "case",
    [
        {"invariants": [H_USES_F, L], "reuse_f": False},
        {"method": EIPRK45, "h": None, "rtol": 1e-7, "atol": 1e-10, "save_every": 3, "events": [falling, crossing]},
        {"method": EIPRKN12, "h": 0.05, "every": "auto", "compensated": True, "save_every": 2},
    ],
)
def test_broken_off_inside_a_step(case, tmp_path):
    """A step may be left anywhere: its half-filled buffers are not kept."""
    whole = run(**case)
    for last in (9, *range(150, 158, 2), whole.nfev - 10):
        calls = itertools.count(1)

        def counted(t, y, last=last, calls=calls):
            if next(calls) == last:
                raise KeyboardInterrupt
            return orbit(t, y)

        options = case | {"checkpoint": tmp_path / f"run-{last}"}
        with pytest.raises(KeyboardInterrupt) as info:
            run(**options | {"fun": counted})
        partial = info.value.partial
        np.testing.assert_array_equal(partial.t[:-1], whole.t[: partial.t.size - 1])
        found = run(resume=True, **options)
        (note,) = info.value.__notes__
        step = int(re.search(r"holds step (\d+), t = [-\d.e]+: the same call with resume=True continues", note)[1])
        assert found.message.startswith(f"reached the end of the interval (resumed at step {step}")
        assert step > 0 or last == 9
        same(whole, found)


@pytest.mark.usefixtures("fine")
def test_a_result_is_there_at_once(tmp_path):
    """A finished run that is resumed calls nothing beyond its start and leaves the file alone."""
    path, calls, seen = tmp_path / "run.npz", itertools.count(), []

    def counted(t, y):
        next(calls)
        return orbit(t, y)

    options = {"checkpoint": path, "fun": counted}
    whole = run(**options)
    before, content = next(calls), path.read_bytes()
    again = run(resume=True, callback=lambda t, y, residuals: seen.append(t), **options)
    same(whole, again)
    assert next(calls) - before < 20
    assert seen == []
    assert path.read_bytes() == content
    assert again.wall_time >= checkpoint.read(path)[0]["wall_time"] > 0
    assert "resumed at step 200" in again.message
    assert [entry.name for entry in tmp_path.iterdir()] == ["run.npz"]


def test_a_failed_run_fails_again(tmp_path):
    def fun(t, y):
        return orbit(t, y) * (np.nan if t > 3.0 else 1.0)

    path = tmp_path / "run"
    failed = run(fun=fun, checkpoint=path)
    assert failed.status == -1
    assert checkpoint.read(path)[0]["status"] == -1
    same(failed, run(fun=fun, checkpoint=path, resume=True))
    # And succeeds where the reason has gone.
    same(run(), run(checkpoint=path, resume=True))


def test_checkpoint_every(tmp_path, times_written):
    written = times_written(run, tmp_path / "a", 0.5)
    np.testing.assert_allclose([t for t, _, _ in written], [0.0, 0.5, 1.0, 1.5, 2.0], atol=0.025)
    assert [status for _, _, status in written] == [None] * 4 + [0]
    assert written[1][1] == pytest.approx(50, abs=1)
    assert [step for _, step, _ in times_written(run, tmp_path / "b", np.inf)] == [0, 200]
    # Writing takes at most a twentieth of the time.
    gaps = np.diff([t for t, _, _ in times_written(run, tmp_path / "c", 0.01, seconds=0.02)])[:-1]
    assert gaps.size > 3
    np.testing.assert_allclose(gaps, 0.425, atol=0.026)


def test_options_and_places(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exists = r"exists\. Pass resume=True to continue .* delete this one"
    damaged = "is damaged, or not a checkpoint of eip_scipy"
    rows = [
        ({"resume": True}, ValueError, "resume=True needs a file to resume from: pass checkpoint=path"),
        ({"resume": "yes", "checkpoint": "a"}, ValueError, "resume must be True or False"),
        ({"checkpoint": 3}, TypeError, "checkpoint must be the path of a file"),
        ({"checkpoint": "a", "checkpoint_every": 0}, ValueError, "checkpoint_every must be a number of seconds > 0"),
        ({"checkpoint": "a", "checkpoint_every": "1 min"}, ValueError, "checkpoint_every .* got '1 min'"),
        ({"checkpoints": "a"}, TypeError, "did you mean 'checkpoint'"),
        ({"checkpoint": "no/such/folder/a"}, CheckpointError, "cannot write .* (no such file|path not)"),
        ({"checkpoint": "."}, CheckpointError, exists),
        ({"checkpoint": ".", "resume": True}, CheckpointError, "cannot read .*: (is a dir|permission)"),
    ]
    refuse(run, rows)
    assert list(tmp_path.iterdir()) == []
    for content in (b"", b"my only copy"):
        Path("a").write_bytes(content)
        refuse(run, [({"checkpoint": "a"}, CheckpointError, exists)])
        refuse(run, [({"checkpoint": "a", "resume": True}, CheckpointError, damaged)])
        assert Path("a").read_bytes() == content
    new = run(checkpoint="b", resume=True)
    assert "there was no checkpoint: started at the beginning" in new.message
    assert "checkpoint" not in run(checkpoint="c").message
    same(run(), new)


OTHERS = {"method": EIPRK5, "h": 0.02, "rtol": 1e-4, "invariants": [H], "metric": "euclidean", "blocks": 2}
OTHERS |= {"linear_invariants": FRAME}
OTHERS |= {"direction": "midpoint", "iterations": 2, "every": 2, "reuse_f": False, "compensated": True, "save_every": 8}
OTHERS |= {"events": crossing, "y0": pericentre(0.5), "t_span": (0, 7)}


@pytest.fixture(scope="module")
def old_run(tmp_path_factory):
    """Return a finished run of FIXED, and its file."""
    path = tmp_path_factory.mktemp("checkpoint") / "run"
    return run(checkpoint=path), path


def test_other_arguments_are_named(old_run):
    others = [{name: value} for name, value in OTHERS.items()]
    others += [{"t_eval": [0.0, 1.0], "save_every": None}]
    others += [{"params": [1.0], "fun": lambda t, y, p: orbit(t, y), "invariants": ()}]
    for other in others:
        words = f"belongs to another run: (.*; )?{next(iter(other))} (is .* in the checkpoint and|differs)"
        refuse(run, [({"checkpoint": old_run[1], "resume": True, **other}, CheckpointError, words)])


ANOTHER = [
    ({"fun": lambda t, y: orbit(t, y) * (1.0 if t < 1.0 else 1.001)}, r"fun was \S+ at t = \S+, where it was saved"),
    (
        {"invariants": [Invariant(lambda t, y: H.fun(t, y) + (t > 1.0) * 1e-6, H.grad, name="energy"), L]},
        r"invariant 'energy' was \S+ at t = \S+, where it was saved, and is \S+ now\. Resume with",
    ),
]
ROUNDED = [
    {"fun": lambda t, y: orbit(t, y) * (1 + 1e-15)},
    {"invariants": [Invariant(lambda t, y: H.fun(t, y) * (1 + 1e-13), H.grad, name="energy"), L]},
]


@pytest.mark.usefixtures("fine")
def test_another_function_is_seen_at_the_stored_state(tmp_path, stopped):
    """Functions may differ by rounding, as on another processor; the targets remain those of the first run."""
    path = tmp_path / "run"
    options = {"checkpoint": path, "check": False, "resume": True}
    with stopped(100):
        run(**options)
    before = path.read_bytes()
    for other, words in ANOTHER:
        refuse(run, [(options | other, CheckpointError, f"belongs to another run: {words}")])
        assert path.read_bytes() == before
    for other in ROUNDED:
        path.write_bytes(before)
        assert run(**options | other).status == 0
        np.testing.assert_array_equal(checkpoint.read(path)[1]["target"], [H.fun(0, Y0), L.fun(0, Y0)])


CHANGES = [
    (lambda h, a: h.update(kind="ensemble"), "is a checkpoint of 'ensemble', expected 'integrate'"),
    (lambda h, a: a.pop("clock"), "clock is missing"),
    (lambda h, a: a.update(carry=np.zeros(5)), r"carry is float64 \(5,\), expected float64 \(4,\)"),
    (lambda h, a: a.update(y=a["y"] * 1j), "y is complex128"),
    (lambda h, a: a.update(saved_y=a["saved_y"][1:]), r"saved_y is float64 \(29, 4\), expected"),
    (lambda h, a: a.update(place=np.array([5, -1, 0])), "step 5, -1 rows"),
    (lambda h, a: h.pop("settings"), "belongs to another run: method is null in the checkpoint"),
    (lambda h, a: h.update(settings=[1]), "belongs to another run"),
    (lambda h, a: h.update(wall_time="long"), "is not a checkpoint of this run"),
]


def test_files_that_others_made(old_run, tmp_path):
    for change, match in CHANGES:
        path = tmp_path / "run"
        path.write_bytes(old_run[1].read_bytes())
        header, arrays = checkpoint.read(path)
        change(header, arrays)
        checkpoint.write(path, header, arrays)  # sealed again
        with pytest.raises(CheckpointError, match=match):
            run(checkpoint=path, resume=True)


def test_other_versions_are_a_warning(old_run, tmp_path, monkeypatch):
    path = tmp_path / "run"
    path.write_bytes(old_run[1].read_bytes())
    monkeypatch.setattr(checkpoint, "_versions", lambda: {"numpy": "1.0", "numba": None})
    with pytest.warns(
        UserWarning, match=r"written with .*numpy 2\.\S+, here 1.0; numba .*: the last bits may"
    ) as record:
        found = run(checkpoint=path, resume=True)
    assert record[0].filename == __file__
    same(old_run[0], found)


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
    # Temporary files of writers that were killed more than an hour ago are removed, others are not.
    names = [".a.npz-1.tmp", ".a.npz-2.tmp", ".ab-1.tmp", "a.npz-1.tmp", ".b-1.tmp"]
    for name in names:
        (tmp_path / name).touch()
        if name != ".a.npz-2.tmp":
            os.utime(tmp_path / name, (time.time() - 4000,) * 2)
    checkpoint.write(path, {"kind": "test"}, {})
    assert {entry.name for entry in tmp_path.iterdir()} == {"a.npz", *names[1:]}


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


@pytest.mark.slow
@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_mutations(data, tmp_path):
    """Pieces cut out, doubled, overwritten, bits changed: a file is refused, or what is read is what was written."""
    path = tmp_path / "a"
    raw = small_file(path)
    known = outcome(path)
    for _ in range(data.draw(st.integers(1, 4))):
        i, j = sorted(data.draw(st.tuples(*[st.integers(0, len(raw))] * 2)))
        flipped = bytes([raw[i] ^ 1]) + raw[i + 1 : j] if i < j else b""
        new = data.draw(st.one_of(st.binary(max_size=40), st.just(raw[i:j] * 2), st.just(flipped)))
        raw = raw[:i] + new + raw[j:]
    path.write_bytes(raw)
    assert outcome(path) in (known, "refused")


HEADER = {"format": "eip_scipy checkpoint", "schema": 1}


def forged(path, name, member, **header):
    """Write a file with the given bytes of one member and the header."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("header.json", json.dumps(HEADER | {"arrays": [name[:-4]]} | header))
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


def test_foreign_archives(tmp_path):
    path, one = tmp_path / "a.npz", npy_bytes("<f8", (1,), bytes(8))
    old = io.BytesIO()
    npy.write_array(old, np.zeros(1), version=(2, 0))
    huge = [(10**15,), (10**6, 10**6, 10**6), (2**62, 4), (3,), (-1, -1), (10**400,)]
    rows = [
        *((npy_bytes("<f8", shape, bytes(8)), {}, r"x\.npy (declares|holds)|not a checkpoint") for shape in huge),
        (npy_bytes("<f8", (1, 1), bytes(8), fortran=True), {}, "not a checkpoint"),
        (one, {"schema": 2}, r"has schema 2, expected 1; .* that wrote it \(unknown\)"),
        (one, {"schema": 2, "versions": {"eip_scipy": "0.2.0"}}, r"that wrote it \(0\.2\.0\)"),
        (one, {"format": "another"}, "its header does not name the format"),
        (old.getvalue(), {}, r"x\.npy does not have version 1\.0 of the npy format"),
    ]
    for member, header, words in rows:
        forged(path, "x.npy", member, **header)
        refuse(checkpoint.read, [({"path": path}, CheckpointError, words)])
    np.savez(path, x=np.arange(3))
    with pytest.raises(CheckpointError, match=r"not a checkpoint of eip_scipy: .* its members are \['x\.npy'\]"):
        checkpoint.read(path)
    # Members of the same bytes: 40 arrays of 1 kB in a file of a few.
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("header.json", json.dumps(HEADER | {"arrays": [f"x{k}" for k in range(40)]}))
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


def test_a_full_disk_at_each_write(tmp_path, monkeypatch):
    path = tmp_path / "a"
    before, messages = small_file(path), set()
    for writes in range(1, 10**6):
        with monkeypatch.context() as patch:
            room = [writes]
            full = lambda path, mode, room=room: io.BufferedWriter(FullDisk(path, mode, room), 16)  # noqa: E731
            patch.setattr(checkpoint, "open", full, raising=False)
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
    whole, path = run(), tmp_path / "run"
    write, calls = checkpoint.write, []

    def full_for_a_while(path, header, arrays):
        calls.append(header["step"])
        if 6 <= len(calls) <= 8:
            raise CheckpointError("cannot write the checkpoint: no space left on device")
        write(path, header, arrays)

    monkeypatch.setattr(checkpoint, "write", full_for_a_while)
    match = r"no space left on device; it still holds step 7, t = 0\.21\. The run continues and tries again"
    with pytest.warns(RuntimeWarning, match=match) as record:
        found = run(checkpoint=path, checkpoint_every=1e-9)
    assert len(record) == 3
    assert all(warning.filename == __file__ for warning in record)
    same(whole, found)
    assert "space" not in found.message
    assert checkpoint.read(path)[0]["status"] == 0
