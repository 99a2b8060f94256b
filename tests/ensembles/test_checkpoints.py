"""Checkpoints of ensembles: what is missing runs on, bit for bit; other ensembles and damaged files are refused."""

import numpy as np
import pytest
from systems import SQUARE, oscillator, refuse, same_fields

from eip_scipy import EIPDOP853, EIPRK4, Invariant, checkpoint, ensemble
from eip_scipy.checkpoint import CheckpointError
from eip_scipy.problems import kepler

STARTS = np.random.default_rng(3).standard_normal((11, 2))
STARTS[5] = np.nan
OPTIONS = {"method": EIPRK4, "h": 0.1, "invariants": SQUARE, "save_every": 4, "chunk": 3}


def members(fun=oscillator, t_span=(0, 1), y0s=STARTS, **options):
    return ensemble(fun, t_span, y0s, **OPTIONS | options)


def peak(run):
    return run.y.max(axis=1)


def trough(run):
    return run.y.min(axis=1)


def height(t, y):
    return y[0]


def broken_off(part):
    if part.first == 3:
        raise KeyboardInterrupt


def half_done(place, **options):
    with pytest.raises(KeyboardInterrupt):
        members(callback=broken_off, checkpoint=place, **options)


CASES = {
    "rows": {},
    "last states": {"save_every": None},
    "events": {"events": height},
    "reduced": {"reduce": peak},
    "adaptive": {"h": None, "method": EIPDOP853, "rtol": 1e-6, "save_every": None, "t_eval": [0.5, 1.0]},
    "in vectors": {"fun": kepler(), "y0s": kepler().y0 * np.linspace(0.99, 1.01, 11)[:, None], "invariants": ()},
}


@pytest.mark.parametrize("case", CASES)
def test_resume_runs_what_is_missing(case, tmp_path):
    options, ran = CASES[case], []
    whole = members(**options)
    half_done(tmp_path / "kept", **options)
    for _ in range(2):  # the second time there is nothing left to do
        found = members(resume=True, checkpoint=tmp_path / "kept", callback=lambda p: ran.append(p.first), **options)
        whole.one_by_one = found.one_by_one  # of the members that ran now
        same_fields(whole, found)
        assert ran == [6, 9]


def test_resume_starts_where_there_is_nothing(tmp_path):
    same_fields(members(), members(resume=True, checkpoint=tmp_path / "kept"))


def test_another_ensemble_is_refused(tmp_path):
    half_done(tmp_path / "kept")
    before = (tmp_path / "kept").read_bytes()
    params = {"params": np.ones((11, 1)), "fun": lambda t, y, p: oscillator(t, y), "invariants": ()}
    rows = [
        ({"h": 0.2}, r"belongs to another run: h is 0\.1 in the checkpoint and 0\.2 in this run"),
        ({"method": EIPDOP853}, "method is"),
        ({"y0s": np.ones((11, 2))}, "y0 differs"),
        ({"y0s": STARTS[:10]}, "y0 differs"),
        ({"t_span": (0, 2)}, "t_span"),
        (params, "params"),
        ({"save_every": 5}, "save_every is 4"),
        ({"events": height}, "events"),
        ({"metric": "euclidean"}, "metric"),
        ({"reduce": trough}, r'reduce is null in the checkpoint and "trough" in this run'),
        ({"resume": False}, "Pass resume=True to continue the ensemble"),
    ]
    kept = {"resume": True, "checkpoint": tmp_path / "kept"}
    refuse(members, [(kept | options, CheckpointError, words) for options, words in rows])
    assert (tmp_path / "kept").read_bytes() == before


def test_other_functions_are_refused(tmp_path):
    def later(t, y):
        return oscillator(t, y) * (1.0 if t < 0.9 else 1.001)

    def square(t, y):
        return SQUARE.fun(t, y) + (0.0 if t < 0.9 else 1e-6)

    half_done(tmp_path / "kept")
    for wrong, name in (
        ({"fun": lambda t, y: 2 * oscillator(t, y)}, "fun"),
        ({"fun": later}, "fun"),
        ({"invariants": Invariant(square, SQUARE.grad, name="S"), "check": False}, "invariant 'S'"),
    ):
        with pytest.raises(CheckpointError, match=f"another ensemble: {name} has another value at the end of member 0"):
            members(resume=True, checkpoint=tmp_path / "kept", **wrong)
    rounded = members(resume=True, checkpoint=tmp_path / "kept", fun=lambda t, y: oscillator(t, y) * (1 + 1e-14))
    assert rounded.failed.tolist() == [5]


def test_another_machine_is_a_warning(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "_machine", lambda: "another machine")
        whole = members(checkpoint=tmp_path / "kept")
    with pytest.warns(UserWarning, match="machine another machine, here") as seen:
        found = members(resume=True, checkpoint=tmp_path / "kept")
    same_fields(whole | {"one_by_one": ""}, found)
    assert seen[0].filename == __file__


def test_files_that_hold_no_ensemble(tmp_path):
    place = tmp_path / "kept"
    members(checkpoint=place)
    header, arrays = checkpoint.read(place)
    few = arrays | {"members_y": arrays["members_y"][:4]}
    missing = {name: array for name, array in arrays.items() if name != "members_y"}
    for given in ((header | {"kind": "integrate"}, arrays), (header, few), (header, missing)):
        checkpoint.write(place, *given)
        with pytest.raises(CheckpointError, match="kept"):
            members(resume=True, checkpoint=place)
    place.write_text("something")
    with pytest.raises(CheckpointError, match="kept"):
        members(resume=True, checkpoint=place)


def test_checkpoints_in_time(tmp_path):
    """Each chunk, if the seconds are over; a file that is read meanwhile is complete."""
    seen = []

    def callback(part):
        seen.append(checkpoint.read(tmp_path / "kept", "ensemble")[0]["finished"])

    members(checkpoint=tmp_path / "kept", checkpoint_every=1e-9, callback=callback)
    assert seen[0] == 3
    assert sorted(seen) == seen
    assert checkpoint.read(tmp_path / "kept", "ensemble")[0]["finished"] == 11


def test_a_full_disk_is_a_warning(tmp_path, monkeypatch):
    """The result exists all the same, and so does the former file."""
    path, write = tmp_path / "kept", checkpoint.write

    def full(*arguments):
        if path.exists():
            raise CheckpointError("cannot write the checkpoint: no space left on device")
        write(*arguments)

    monkeypatch.setattr(checkpoint, "write", full)
    with pytest.warns(RuntimeWarning, match="no space left on device; the previous checkpoint is kept"):
        same_fields(members(), members(checkpoint=path))
    assert checkpoint.read(path, "ensemble")[0]["finished"] == 0
