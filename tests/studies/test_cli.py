"""The command line: output and files, exit statuses, and one clear line for every wrong input."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
import warnings
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest
from forked import Forker

import eip_scipy
import eip_scipy.integrations
from eip_scipy import EIPRK1, EIPRK4, Invariant, integrate
from eip_scipy.problems import solar_data
from eip_scipy_studies import report
from eip_scipy_studies.cli import main
from eip_scipy_studies.listing import fixed_step_methods
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


@pytest.fixture
def no_matplotlib(monkeypatch):
    for name in list(sys.modules):
        if name.split(".")[0] == "matplotlib":
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    for module in ("eip_scipy.plotting", "eip_scipy_studies.plotting", "eip_scipy_studies.solar.figures"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    monkeypatch.delattr(eip_scipy, "plotting", raising=False)
    monkeypatch.delattr("eip_scipy_studies.solar.figures", raising=False)


def lines(text):
    return [line for line in text.splitlines() if line.strip()]


# --- the whole command, with REBOUND ---


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


def test_csv_holds_the_numbers_of_the_json(short):
    with open(short.out / "solar-system.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["method"] for row in rows] == [method["method"] for method in short.json["methods"]]
    first, known = rows[0], short.json["methods"][0]
    assert float(first["year"]) == 0.1
    assert float(first["longitude_Mercury_rad"]) == known["errors"][0]["longitude_rad"]["Mercury"]
    assert float(first["position_Pluto_AU"]) == known["errors"][0]["position_AU"]["Pluto"]
    assert float(first["max_relative_error_H"]) == known["max_relative_error_H"] < 1e-8
    assert rows[-1]["longitude_Mercury_rad"] == ""


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
def test_euclidean_metric_comes_first_when_asked_for(tmp_path, capsys, no_rebound):
    assert (
        main(["solar-system", *SPAN, "--metric", "euclidean", "--data", "paper", "--out", str(tmp_path)], **LITTLE) == 0
    )
    out = capsys.readouterr().out
    assert lines(out)[4].split() == ["euclid.", "error", "alone", "every", "10", "auto", "balances", "tight"]
    assert "initial data 'paper'" in out
    assert "Earth" in out
    assert "ok     EIPRK4 (euclidean) keeps H" in out


@pytest.mark.nightly
@pytest.mark.slow
def test_a_method_without_estimate_has_one_metric(tmp_path, capsys, no_rebound):
    assert main(["solar-system", *SPAN, "--method", "EIPRK1", "--out", str(tmp_path)], **LITTLE) == 0
    heads = ["EIPRK1", "RK1", "SV", "EIPRKN12", "EIPGJ14", "EIPGJ14", "EIPRKN12"]
    assert lines(capsys.readouterr().out)[3].split() == heads


# --- what is missing ---


@pytest.mark.nightly
@pytest.mark.slow
def test_without_rebound_the_command_runs_and_says_what_to_install(tmp_path, capsys, no_rebound):
    assert main(["solar-system", *SPAN, "--out", str(tmp_path), "--quiet"], **LITTLE) == 0
    captured = capsys.readouterr()
    assert captured.out == ""
    (line,) = lines(captured.err)
    assert 'pip install "eip_scipy[rebound]"' in line
    assert {path.name for path in tmp_path.iterdir()} >= FIGURES


def test_without_matplotlib_the_numbers_are_there(tmp_path, capsys, no_rebound, no_matplotlib):
    assert main(["solar-system", *SPAN, "--out", str(tmp_path), "--json", str(tmp_path / "run.json")], **LITTLE) == 0
    captured = capsys.readouterr()
    figures, rebound = lines(captured.err)[-2:]
    assert 'pip install "eip_scipy[plot]"' in figures
    assert 'pip install "eip_scipy[rebound]"' in rebound
    assert "error of longitude [rad]" in captured.out
    assert {path.name for path in tmp_path.iterdir()} == {"solar-system.csv", "error-against-cost.csv", "run.json"}


# --- runs that go wrong ---


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.needs_jit
def test_a_run_that_fails_is_reported_and_changes_the_status(tmp_path, capsys, no_rebound, monkeypatch):
    broken = Invariant(lambda t, y, p: 1.0 if t < 1 else np.nan, lambda t, y, p: 0.0 * y, name="broken")

    def integrate_with_it(problem, **options):
        if options.get("metric") == "error":
            options["invariants"] = [*problem.invariants, broken]
        return integrate(problem, **options)

    monkeypatch.setattr(solar_run, "integrate", integrate_with_it)
    status = main(
        ["solar-system", "--years", "2", "--h", "0.01", "--method", "EIPRK5", "--out", str(tmp_path)], **LITTLE
    )
    out = capsys.readouterr().out
    assert status == 1
    assert "FAILED EIPRK5 (error) reached the end" in out
    assert "projection failed at t=1: invariant 'broken'" in out
    assert "failed" in next(line for line in out.splitlines() if line.startswith("  Mercury"))
    assert (tmp_path / "orbits-inner.png").exists()


@pytest.mark.nightly
@pytest.mark.slow
def test_a_failed_check_changes_the_status(tmp_path, capsys, no_rebound, monkeypatch):
    monkeypatch.setattr(solar_errors, "ROUND_OFF", 1e-30)
    monkeypatch.setattr(solar_errors, "FASTEST", 1e-9)
    assert main(["solar-system", *SPAN, "--out", str(tmp_path)], **LITTLE) == 1
    assert "FAILED EIPRK4 (error) keeps H" in capsys.readouterr().out


@pytest.mark.nightly
@pytest.mark.slow
def test_a_run_that_is_not_to_be_trusted_is_told(tmp_path, capsys, no_rebound, monkeypatch):
    """Each run is named once, at the end; in the JSON and the exit status too. Other warnings are shown as usual."""

    def doubtful(problem, **options):
        if options.get("metric") == "error":
            for _ in range(2):
                integrate(pendulum, (0.0, 20.0), [2.0, 0.0], method=options["method"], h=0.05, invariants=[energy])
            warnings.warn("another", UserWarning, stacklevel=2)
        return integrate(problem, **options)

    def pendulum(t, y):  # with friction
        return np.array([y[1], -np.sin(y[0]) - 0.2 * y[1]])

    energy = Invariant(lambda t, y: 0.5 * y[1] ** 2 - np.cos(y[0]), name="energy")

    file = tmp_path / "run.json"
    command = ["solar-system", *SPAN, "--quiet", "--out", str(tmp_path), "--json", str(file)]
    with monkeypatch.context() as patch:
        patch.setattr(solar_run, "integrate", doubtful)
        with pytest.warns(UserWarning, match="another") as shown:
            assert main(command, **LITTLE) == 1
    assert [item.category for item in shown] == [UserWarning]
    _, line = lines(capsys.readouterr().err)  # the first is on REBOUND
    assert line.startswith("eip-scipy: EIPRK4 (error): not to be trusted: 'energy' ")
    assert json.loads(file.read_text())["trusted"] is False
    assert main(command, **LITTLE) == 0
    assert len(lines(capsys.readouterr().err)) == 1
    assert json.loads(file.read_text())["trusted"] is True


def test_an_interruption_keeps_what_was_done(tmp_path, capsys, no_rebound, monkeypatch):
    def interrupted(scene):
        raise KeyboardInterrupt

    monkeypatch.setattr(solar_run, "_verlet", interrupted)
    assert main(["solar-system", *SPAN, "--out", str(tmp_path)]) == 130
    captured = capsys.readouterr()
    assert lines(captured.out)[3].split() == ["EIPRK4", "EIPRK4", "RK4"]
    assert "interrupted; the runs that were done are in the table" in captured.err
    with open(tmp_path / "solar-system.csv", newline="") as stream:
        assert [row["method"] for row in csv.DictReader(stream)] == ["EIPRK4 (error)", "EIPRK4 (euclidean)", "RK4"]


@pytest.mark.posix
def test_sigterm_keeps_what_was_done(tmp_path):
    """SIGTERM keeps the results as Ctrl-C does; the process then ends by it, as its sender expects."""
    code = f"""
        import os, signal, sys
        sys.modules["rebound"] = None
        from eip_scipy_studies import cli
        from eip_scipy_studies.solar import runs

        runs._verlet = lambda problem: os.kill(os.getpid(), signal.SIGTERM)
        cli.main(["solar-system", *{SPAN}, "--out", out])
        print("went on")
    """
    forker = Forker(tmp_path)
    out = tmp_path / "out"
    code, printed, errors = forker.start(code, out=str(out)).wait()
    forker.close()
    assert code == -signal.SIGTERM, errors
    assert lines(printed)[3].split() == ["EIPRK4", "EIPRK4", "RK4"]
    assert "went on" not in printed
    assert "interrupted; the runs that were done are in the table" in errors
    assert [path.name for path in out.iterdir()] == ["solar-system.csv"]


def test_an_interruption_while_timing_keeps_the_table(tmp_path, capsys, no_rebound, monkeypatch):
    def interrupted(*args, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(solar_system, "cost", interrupted)
    assert main(["solar-system", *SPAN, "--out", str(tmp_path)]) == 130
    captured = capsys.readouterr()
    assert "max |dH/H|" in captured.out
    assert "the table is complete" in captured.err
    assert [path.name for path in tmp_path.iterdir()] == ["solar-system.csv"]


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
    ("options", "message"),
    [
        (["--resume"], "--resume needs the folder to resume from: --checkpoint DIR"),
        (["truth", "--checkpoint", "a"], "unrecognized arguments: --checkpoint a"),
        (["frontier", "--resume"], "unrecognized arguments: --resume"),
    ],
)
def test_options_that_nothing_can_be_done_with(options, message, tmp_path, capsys, no_rebound):
    assert main(["solar-system", *options, "--out", str(tmp_path)]) == 2
    assert message in capsys.readouterr().err


def test_an_interruption_anywhere_is_one_line(tmp_path, capsys, monkeypatch):
    def interrupted(*args, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr("eip_scipy_studies.paper.tables.table_text", interrupted)
    assert main(["reproduce", "table1", "--out", str(tmp_path)]) == 130
    assert lines(capsys.readouterr().err) == ["eip-scipy: interrupted"]


@pytest.mark.slow
@pytest.mark.needs_jit
@pytest.mark.posix
def test_control_c(tmp_path):
    out = tmp_path / "out"
    command = [sys.executable, "-m", "eip_scipy", "solar-system", "--out", str(out), "--quiet"]
    command += ["--years", "1e6"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        deadline = time.monotonic() + 60
        while not out.exists() and time.monotonic() < deadline:
            time.sleep(0.1)
        time.sleep(2)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130, err
    assert lines(err)[-1] == "eip-scipy: interrupted; nothing was written"
    assert "Traceback" not in err


def test_a_file_that_cannot_be_written_at_the_end_leaves_the_table(tmp_path, capsys, no_rebound, monkeypatch):
    def full(*args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(report.os, "replace", full)
    assert main(["solar-system", *SPAN, "--out", str(tmp_path)], **LITTLE) == 2
    captured = capsys.readouterr()
    assert "max |dH/H|" in captured.out
    assert lines(captured.err)[-1].endswith("solar-system.csv': no space left on device")
    assert list(tmp_path.iterdir()) == []


# --- wrong usage ---


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "expected COMMAND first, one of list, doctor, solar-system"),
        (["solar"], "unknown COMMAND 'solar', expected one of list, "),
        (["solar-sytem"], "did you mean 'solar-system'?"),
        (["--years", "1", "solar-system"], "expected COMMAND first"),
        (["solar-system", "--yaers", "5"], "unrecognized arguments: --yaers 5; did you mean '--years'?"),
        (["solar-system", "--years", "many"], "--years: expected a positive number, got 'many'"),
        (["solar-system", "--years", "-5"], "--years: expected a positive number, got '-5'"),
        (["solar-system", "--years", "0"], "--years: expected a positive number"),
        (["solar-system", "--years", "inf"], "--years: expected a positive number"),
        (["solar-system", "--h", "nan"], "--h: expected a positive number"),
        (["study", "growth", "--years", "0"], "--years: expected a positive number"),
        (["study", "growth", "--years", "0.1"], "--years must be at least 1, where the reference begins, got 0.1"),
        (["solar-system", "--years", "1", "--h", "2"], "`h` exceeds bounds"),
        (["solar-system", "--h", "1e-20"], "`h` is too small"),
        (["solar-system", "--method", "EIPRK9"], "'EIPRK9' (choose from"),
        (["solar-system", "--metric", "taxicab"], "'taxicab' (choose from"),
        (["solar-system", "--data", "de999"], "'de999' (choose from"),
        (["solar-system", "--plot"], "unrecognized arguments: --plot"),
        (["solar-system", "--json", "{missing}/run.json"], "cannot write '{missing}/run.json': no such file"),
        (["solar-system", "--json", "{folder}"], "it is a folder"),
        (["solar-system", "--out", "{file}"], "cannot write to the folder '{file}': file exists"),
        (["solar-system", "--out", "{file}/out"], "cannot write to the folder"),
        (["list", "--json", "{missing}/list.json"], "no such file"),
    ],
)
def test_wrong_usage_is_one_line(tmp_path, capsys, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("here")
    known = {"missing": tmp_path / "missing", "folder": tmp_path, "file": tmp_path / "file"}
    assert main([argument.format(**known) for argument in arguments]) == 2
    (line,) = lines(capsys.readouterr().err)
    assert line.startswith("eip-scipy")
    assert message.format(**known) in line


def test_a_folder_without_permission(tmp_path, capsys, monkeypatch):
    def forbidden(path, *args, **kwargs):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(report.Path, "touch", forbidden)
    assert main(["solar-system", "--out", str(tmp_path / "new")]) == 2
    assert lines(capsys.readouterr().err)[-1].endswith("new': permission denied")


def test_too_much_memory_is_one_line(tmp_path, capsys, no_rebound, monkeypatch):
    monkeypatch.setattr("eip_scipy.run.memory.free_memory", lambda: 1000.0)
    monkeypatch.setattr("eip_scipy.run.memory.SMALL", 0)
    assert main(["solar-system", *SPAN, "--out", str(tmp_path), "--quiet"]) == 2
    assert "not enough memory" in lines(capsys.readouterr().err)[-1]


# --- list, version, entry points ---


def test_a_clone_has_its_integrations(tmp_path):
    """Python finds the folder it is started in first; what is installed lies elsewhere."""
    root = Path(eip_scipy.__file__).parents[1]
    for name in ("eip_scipy", "integrations"):
        (tmp_path / name).symlink_to(root / name)
    code = "import eip_scipy.integrations.jpl as jpl, eip_scipy; print(eip_scipy.integrations.jpl is jpl, jpl.__file__)"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", str(tmp_path / "integrations" / "jpl.py")]


def test_list(capsys, tmp_path):
    file = tmp_path / "list.json"
    assert main(["list", "--json", str(file)]) == 0
    text = capsys.readouterr().out
    for name in ("solar-system", "EIPRK5", "stormer_verlet", "kepler", "de440-j2000"):
        assert name in text
    found = json.loads(file.read_text())
    assert set(found["methods"]) >= {"EIPRK1", "EIPRK2", "EIPRK3", "EIPRK4", "EIPRK5"}
    assert set(found["problems"]) >= {"kepler", "nbody", "hamiltonian", "hard_cases", "soliton", "tokamak"}
    assert set(found["for problems"]) >= {"find_invariants", "harmonic_trap", "orbital_elements", "pair_time"}
    assert main(["list", "--quiet"]) == 0
    assert capsys.readouterr().out == ""


def test_version_and_help(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"eip_scipy {eip_scipy.__version__}\n"
    assert main(["solar-system", "--help"]) == 0
    assert "--metric" in capsys.readouterr().out


@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
def test_module_runs_on_any_terminal(encoding):
    done = subprocess.run(
        [sys.executable, "-m", "eip_scipy", "list"],
        env={**os.environ, "PYTHONIOENCODING": encoding},
        capture_output=True,
        check=True,
    )
    assert "rmer-Verlet" in done.stdout.decode(encoding)


def test_a_reader_that_leaves_is_no_error():
    done = subprocess.run(
        f"{sys.executable} -m eip_scipy list | head -n 1", shell=True, capture_output=True, text=True, check=True
    )
    assert (done.stdout, done.stderr) == ("commands:\n", "")


# --- behind the table ---


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


def test_report_times():
    assert solar_run.report_times(solar_run.make_scene("de440", 500.0, 0.01)) == [1.0, 10.0, 100.0, 500.0]
    assert solar_run.report_times(solar_run.make_scene("paper", 500.0, 0.01)) == [500.0]


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


def test_turns_that_cannot_be_counted_are_nan():
    scene, run, truth = turning_pair(5.5)  # 2.75 rad between saved states
    assert np.isnan(solar_errors.longitude_errors(scene, run, truth)[:, 1:]).all()


def test_a_run_that_ended_early_has_no_error_after_that():
    scene, run, truth = turning_pair(0.1)
    t = np.append(run.t[:50], 24.7)
    stopped = replace(run, t=t, y=run.y[:, :51], failure="stopped")
    errors = solar_errors.longitude_errors(scene, stopped, truth)
    assert np.isfinite(errors[:, :50]).all()
    assert np.isnan(errors[:, 50:]).all()
    assert solar_errors.errors_at(scene, stopped, 100.0, truth) is None


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


def test_ecliptic_axes():
    """On these the Earth's orbit lies in the plane; both data sets agree on it."""
    for name in ("de440", "paper"):
        scene = solar_run.make_scene(name, 1.0, 0.1)
        q, v = (part[2, :, 0] for part in jacobi(scene, scene.problem.y0[:, None]))
        normal = np.cross(q, v)
        assert np.hypot(*normal[:2]) / normal[2] < 3e-4


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


def test_every_method_of_the_solvers_is_offered():
    methods = fixed_step_methods()
    assert methods["EIPRK1"] is EIPRK1
    assert "EIPSolver" not in methods


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


# --- report ---


def test_compact_numbers():
    numbers = [0.0, 71.2, -0.8939, 0.0011, -3.6e-9, 123456.0, 9.96, 0.0996, 999.0, np.nan, None]
    expected = ["0", "71", "-0.89", "1.1e-3", "-3.6e-9", "1.2e5", "10", "0.10", "1.0e3", "-", "-"]
    assert [report.compact(number) for number in numbers] == expected


def test_table_layout():
    text = report.table([("A", "long"), ("B",)], [("x", ["1", "2"]), ("heading", ()), ("  yy", ["10", "-"])])
    assert text.splitlines() == ["        A B", "     long", "-----------", "x       1 2", "heading", "  yy   10 -"]


def test_json_has_no_nan_and_no_numpy(tmp_path):
    file = report.write_json(
        tmp_path / "x.json", {"a": np.array([1.0, np.nan]), "b": np.int64(3), 4: (np.bool_(True),)}
    )
    assert json.loads(file.read_text()) == {"a": [1.0, None], "b": 3, "4": [True]}


def test_an_interrupted_file_leaves_the_old_one(tmp_path):
    target = tmp_path / "x.txt"
    target.write_text("old")

    def torn(path):
        path.write_text("ne")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        report.write_file(target, torn)
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_machine_and_versions():
    assert report.versions()["matplotlib"] == matplotlib.__version__
    assert report.versions()["python"] == ".".join(map(str, sys.version_info[:3]))
    assert report.machine()["processor"]
    assert "CPU" in report.describe_machine()
