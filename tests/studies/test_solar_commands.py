"""``eip-scipy solar-system``: a short run with all of its files, the errors of a year and of 2000, checkpoints."""

import csv
import json
import os
from types import SimpleNamespace

import numpy as np
import pytest

import eip_scipy
import eip_scipy.integrations
from eip_scipy import EIPRK4
from eip_scipy.problems import solar_data
from eip_scipy_studies import report
from eip_scipy_studies.cli import main
from eip_scipy_studies.solar import errors as solar_errors
from eip_scipy_studies.solar import runs as solar_run
from eip_scipy_studies.solar import solar_system
from eip_scipy_studies.solar.figures import jacobi, osculating_orbits

FIGURES = {
    "invariant-errors.png",
    "longitude-errors.png",
    "orbits-outer.png",
    "orbits-inner.png",
    "orbit-mercury.png",
    "error-against-cost.png",
}
PNG = b"\x89PNG\r\n\x1a\n"
SPAN = ("--years", "0.1", "--h", "0.005")  # quick in plain Python, too; four times that resolves Mercury


def leapfrog_only(scene, method, metric, judge):
    """Return fewer timings than the command's."""
    return {"SV": (lambda step: (1.0, scene.problem.y0), [scene.h, scene.h / 2])}


LITTLE = {"timed_methods": leapfrog_only}


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """Return a short run with everything on; with REBOUND if it is installed."""
    pytest.importorskip("rebound")
    folder = tmp_path_factory.mktemp("short")
    command = ["solar-system", *SPAN, "--out", str(folder / "out"), "--json", str(folder / "run.json"), "--quiet"]
    status = main(command, repeats=1, beside_years=0.0)  # with a second process, as in the 2000 years
    return SimpleNamespace(status=status, out=folder / "out", json=json.loads((folder / "run.json").read_text()))


def test_short_run_is_done(short):
    assert short.status == 0
    assert all(check["passed"] for check in short.json["checks"])


def test_files_are_there_and_whole(short):
    names = {path.name for path in short.out.iterdir()}
    assert names == FIGURES | {"solar-system.csv", "error-against-cost.csv"}  # and no temporary file
    for name in FIGURES:
        content = (short.out / name).read_bytes()
        assert content.startswith(PNG)
        assert len(content) > 10_000


def test_json_holds_numbers_versions_and_machine(short):
    run = short.json
    assert run["command"] == "solar-system"
    assert run["arguments"] == {"years": 0.1, "h": 0.005, "method": "EIPRK4", "metric": "error", "data": "de440"}
    assert run["versions"]["eip_scipy"] == eip_scipy.__version__
    assert run["versions"]["numpy"] == np.__version__
    assert run["machine"]["cpus"] == os.cpu_count()
    names = [method["method"] for method in run["methods"]]
    own = ["EIPRK4 (error)", "EIPRK4 (euclidean)", "RK4", "SV", "EIPRKN12", "EIPGJ14", "EIPGJ14 (balances)"]
    assert names == [*own, "WHFast", "WHFast (c17)", "IAS15"]
    for method in run["methods"][:-1]:
        (errors,) = method["errors"]
        assert errors["reference"] == "IAS15"
        assert set(errors["longitude_rad"]) == set(solar_data.load().bodies[1:])
        assert 0 < errors["position_AU"]["Mercury"] < 1
    assert run["methods"][-1]["errors"] == []  # it is the reference
    assert run["ran_beside_the_others"] == ("IAS15" if report.cores() > 1 else None)
    points = run["error_against_cost"]["points"]
    assert {point["method"] for point in points} >= {"EIPRK5 (error)", "EIPRKN12", "EIPGJ14", "WHFast (c17)"}
    assert all(point["error"] > 0 and point["error_others"] > 0 for point in points)


def test_order_shows_in_the_errors(short):
    error = {method["method"]: method["errors"][0]["position_AU"] for method in short.json["methods"][:-1]}
    assert error["EIPRK4 (error)"]["Mercury"] < error["SV"]["Mercury"] / 10
    assert error["WHFast (c17)"]["Mercury"] < error["WHFast"]["Mercury"] / 10
    for name in ("EIPRKN12", "EIPGJ14"):
        for planet, best in error[name].items():
            assert best < max(1e-3 * error["EIPRK4 (error)"][planet], 1e-13)


@pytest.mark.slow
@pytest.mark.needs_jit
def test_one_year_against_the_stored_states(tmp_path, capsys, monkeypatch):
    pytest.importorskip("rebound")
    monkeypatch.setattr(solar_system, "images", lambda study, part: {"figure.png": PNG})  # the short run draws them
    assert main(["solar-system", "--years", "1", "--out", str(tmp_path)], **LITTLE) == 0
    text = capsys.readouterr().out
    assert "Reference: stored states (80 bits) at 1 yr; turns counted along IAS15" in text
    assert "IAS15 agrees with the stored states at 1 yr" in text
    assert "FAILED" not in text
    assert max(map(len, text.splitlines()[:-3])) <= 100  # ten columns
    with open(tmp_path / "solar-system.csv", newline="") as stream:
        rows = {row["method"]: row for row in csv.DictReader(stream)}
    assert {row["reference"] for row in rows.values()} == {"stored states"}
    assert abs(float(rows["IAS15"]["longitude_Mercury_rad"])) < 1e-12
    assert abs(float(rows["EIPRKN12"]["longitude_Mercury_rad"])) < 1e-9
    assert abs(float(rows["EIPGJ14"]["longitude_Mercury_rad"])) < 1e-11
    assert float(rows["EIPGJ14"]["step_yr"]) == 0.1 / 60
    assert float(rows["EIPRKN12"]["step_yr"]) == 0.1 / 7  # of the steps that divide the time between saved states
    assert abs(float(rows["SV"]["longitude_Mercury_rad"])) == pytest.approx(0.05, rel=0.5)


@pytest.mark.nightly
@pytest.mark.slow
def test_an_interrupted_command_goes_on(tmp_path, capsys, no_rebound, monkeypatch):
    """With --checkpoint, completed runs are not repeated; the numbers are those of an uninterrupted command."""
    folder = tmp_path / "kept"
    command = ["solar-system", *SPAN, "--checkpoint", str(folder)]
    assert main(["solar-system", *SPAN, "--out", str(tmp_path / "whole"), "--quiet"], **LITTLE) == 0

    def interrupted(scene):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(solar_run, "_verlet", interrupted)
        assert main([*command, "--out", str(tmp_path / "first")], **LITTLE) == 130
    assert f"the same command with --resume goes on from the checkpoints in '{folder}'" in capsys.readouterr().err
    done = {"EIPRK4-error.npz", "EIPRK4-euclidean.npz", "RK4.npz"}
    assert {path.name for path in folder.iterdir()} == done
    before = {name: (folder / name).read_bytes() for name in done}
    assert main([*command, "--out", str(tmp_path / "again")], **LITTLE) == 2
    assert "exists. Pass resume=True to continue the run that it holds" in capsys.readouterr().err
    assert main([*command, "--out", str(tmp_path / "second"), "--resume", "--quiet"], **LITTLE) == 0
    long = {"EIPRKN12.npz", "EIPGJ14.npz", "EIPGJ14-balances.npz", "EIPRKN12-tight.npz"}
    assert {path.name for path in folder.iterdir()} == {*done, *long}
    assert {name: (folder / name).read_bytes() for name in done} == before

    def numbers(name):
        with open(tmp_path / name / "solar-system.csv", newline="") as stream:
            return [{k: v for k, v in row.items() if k != "wall_time_s"} for row in csv.DictReader(stream)]

    assert numbers("second") == numbers("whole")
    assert main([*command, "--out", str(tmp_path / "third"), "--resume", "--h", "0.001"], **LITTLE) == 2
    assert "belongs to another run: h is" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("years", "h", "expected"),
    [
        (2000.0, 0.002, (2000, 500, 0.002)),
        (100.0, 0.002, (200, 250, 0.002)),
        (2.0, 0.003, (20, 34, 0.1 / 34)),
        (2.5, 0.002, (25, 50, 0.002)),
        (1.0, 0.5, (2, 1, 0.5)),
        (1.0, 1.0, (1, 1, 1.0)),
        (1e6, 1.0, (20_000, 50, 1.0)),
    ],
)
def test_saved_times_are_whole_numbers_of_steps(years, h, expected):
    scene = solar_run.make_scene("de440", years, h)
    assert (scene.n_saves, scene.every) == expected[:2]
    assert scene.h == pytest.approx(expected[2], rel=1e-14)
    assert scene.h <= h * (1 + 1e-12)
    assert scene.n_saves * scene.every * scene.h == pytest.approx(years, rel=1e-14)


def turning_pair(rate):
    """Return a run whose planets gain `rate` rad/yr on those of another, both on circles."""
    scene = solar_run.make_scene("paper", 100.0, 1.0)
    t = np.linspace(0.0, 100.0, 201)
    runs = []
    for extra in (rate, 0.0):
        y = np.zeros((60, t.size))
        for body in range(1, 10):
            angle = (2 * np.pi / body + extra) * t
            y[3 * body], y[3 * body + 1] = body * np.cos(angle), body * np.sin(angle)
        runs.append(solar_run.MethodRun("run", ("run",), 1.0, 0.0, t, y, t, t))
    return scene, *runs


@pytest.mark.parametrize("rate", [0.01, -0.7, 4.5])
def test_turns_are_counted(rate):
    scene, run, truth = turning_pair(rate)
    errors = solar_errors.longitude_errors(scene, run, truth)
    np.testing.assert_allclose(errors, np.tile(rate * truth.t, (9, 1)), atol=1e-9)


@pytest.mark.parametrize(
    ("name", "offset", "passed"),
    [
        ("IAS15", 5e-9, True),
        ("IAS15", 2e-8, False),
        ("EIPRKN12 (tight)", 5e-8, True),
        ("EIPRKN12 (tight)", 2e-7, False),
    ],
)
def test_the_tightest_run_is_checked_against_the_stored_states(name, offset, passed):
    """The positions are compared, to 1e-8 AU for IAS15 and 1e-7 AU for the run without REBOUND."""
    scene = solar_run.make_scene("de440", 1.0, 0.1)
    y = np.stack([scene.problem.y0, solar_run.stored_state(scene, 1.0)], axis=1)
    y[3:5, 1] += offset  # Mercury
    zero = np.zeros(2)
    run = solar_run.MethodRun(name, (name,), 0.1, 0.0, np.array([0.0, 1.0]), y, zero, zero)
    *_, check = solar_errors.SolarRuns(scene, 4, [run], run).checks()
    assert check.text.startswith(f"{name} agrees with the stored states at 1 yr")
    assert check.passed == passed


def test_osculating_orbits_pass_through_the_planets():
    scene = solar_run.make_scene("de440", 1.0, 0.1)
    y = scene.problem.y0[:, None]
    at = jacobi(scene, y)[0][:, :2, 0]
    paths = osculating_orbits(scene, y, 5000)[:, 0]
    distance = np.linalg.norm(paths - at[:, :, None], axis=1).min(axis=1)
    assert (distance < 1e-3 * np.linalg.norm(at, axis=1)).all()
    radius = np.linalg.norm(paths[0], axis=0)  # Mercury: 0.307 and 0.467 AU, seen at 7 degrees
    assert radius.min() == pytest.approx(0.3075, rel=0.01)
    assert radius.max() == pytest.approx(0.4667, rel=0.01)


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.needs_jit
def test_two_thousand_years():
    """The table of the default run: Mercury's turns, and the errors to two digits."""
    pytest.importorskip("rebound")
    from eip_scipy.integrations import rebound

    scene = solar_run.make_scene("de440", 2000.0, 0.002)
    tasks = {task.name: task for task in solar_run.plan(scene, EIPRK4, "error", rebound.run)}
    runs = {name: tasks[name].start(False) for name in ("EIPRK4 (error)", "RK4", "SV", "EIPRKN12", "EIPGJ14", "IAS15")}
    study = solar_errors.SolarRuns(scene, 4, list(runs.values()), runs["IAS15"])
    longitude = {name: errors.longitude for name, errors in study.errors(2000.0).items()}
    assert longitude["RK4"][0] == pytest.approx(70.5, abs=0.5)
    assert longitude["SV"][0] == pytest.approx(-96.7, abs=0.5)
    assert abs(longitude["EIPRK4 (error)"][0]) < abs(longitude["RK4"][0]) / 50
    assert np.abs(longitude["IAS15"]).max() < 1e-8
    assert np.abs(longitude["EIPRKN12"]).max() < 1e-7
    assert np.abs(longitude["EIPRKN12"][1:]).max() < 1e-9
    for name in ("EIPRKN12", "EIPGJ14"):
        assert runs[name].energy_error.max() < 1e-14
    assert np.abs(longitude["EIPGJ14"]).max() < 2e-8
    assert np.abs(longitude["EIPGJ14"][1:]).max() < 1e-9
    assert (np.abs(longitude["EIPRK4 (error)"]) <= np.maximum(2 * np.abs(longitude["RK4"]), 1e-7)).all()
    assert all(check.passed for check in study.checks())
