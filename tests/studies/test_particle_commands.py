"""The commands on charged particles in small: numbers, checks, files, exit statuses; and in full, marked slow."""

import csv
import json
import math

import numpy as np
import pytest

from eip_scipy_studies.cli import main
from eip_scipy_studies.particles import charged_particle
from eip_scipy_studies.particles import report as particle_report
from eip_scipy_studies.particles import runs as particle_runs
from eip_scipy_studies.particles.report import range_check

PNG = b"\x89PNG\r\n\x1a\n"
STEPS = 60
T_END = STEPS * math.pi / 10


@pytest.fixture(scope="module")
def short():
    return {name: particle_runs.study(name, t_end=T_END) for name in particle_runs.SCENES}


@pytest.fixture
def short_runs(short, monkeypatch):
    monkeypatch.setattr(charged_particle, "study", lambda name, **options: short[name])


def read(file):
    with open(file, newline="") as stream:
        return list(csv.DictReader(stream))


@pytest.mark.slow
@pytest.mark.parametrize("name", particle_runs.SCENES)
def test_numbers_of_a_short_run(short, name):
    found = short[name]
    assert list(found.lines) == [*particle_runs.METHODS, "Boris"]
    got = found.numbers
    assert got["reference"]["position_error"] == 0
    error = {method: values["position_error"] for method, values in got.items()}
    assert error["EIP-HL, RK5"] < error["EIP-HL"] < error["implicit midpoint"]
    for method, values in got.items():
        keeps = {"EIP-H": "H", "implicit midpoint": "L", "reference": "HL"}.get(method, "HL" if "HL" in method else "")
        assert (values["energy_error"] < 1e-9) == ("H" in keeps or (method == "Boris" and name != "uniform"))
        assert (values["momentum_error"] < 1e-9) == ("L" in keeps)
    assert got["EIP-HL"]["nfev"] == 1 + 5 * STEPS  # four stages, and f at the raw result for the gradient of H
    assert got["Boris"]["nfev"] == STEPS


@pytest.mark.slow
def test_figures_have_a_row_for_each_method(short):
    figures = dict(particle_report.figures(short))
    assert {name: len(figure.axes) for name, figure in figures.items()} == {"uniform": 7 * 4, "tokamak": 7 * 4}
    paper = dict(particle_report.figures(short, paper_only=True))
    assert {name: len(figure.axes) for name, figure in paper.items()} == {"uniform": 3 * 4, "tokamak": 2 * 4}
    orbit = paper["tokamak"].axes[0].lines[0].get_xydata()
    line = short["tokamak-banana"].lines["RK4"].orbit
    np.testing.assert_array_equal(orbit, np.stack([line.R, line.z], axis=1))


@pytest.mark.slow
def test_checks_fail_on_a_run_too_short_for_them(short):
    for found in short.values():
        checks = particle_report.checks(found)
        assert not all(check.passed for check in checks)
        assert all(check.passed for check in checks if "relative error" in check.text)
        text = particle_report.text(found)
        assert text.count("\nFAILED ") == sum(not check.passed for check in checks)
        assert text.count("\nok ") == sum(check.passed for check in checks)


def test_checks_and_their_words():
    nan = float("nan")
    assert not range_check("s", "w", nan, 0.0, 1.0).passed
    assert range_check("s", "tips", 8, 8, 8).line == "ok     tips: 8, expected 8"
    assert range_check("s", "error", 0.5, 0.0, 0.1).line == "FAILED error: 0.5000, at most 0.10"
    assert range_check("s", "error", 0.5, 0.1, np.inf).line == "ok     error: 0.5000, at least 0.10"
    assert "between 1.0093 and 1.0097" in range_check("s", "R of the tip", 1.0095, 1.0093, 1.0097).text


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.usefixtures("short_runs")
def test_command(tmp_path, capsys):
    file = tmp_path / "run.json"
    assert main(["charged-particle", "--out", str(tmp_path), "--json", str(file)]) == 1
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {
        "charged-particle.csv", "charged-particle-uniform.png", "charged-particle-tokamak.png", "run.json",
    }  # fmt: skip
    assert (tmp_path / "charged-particle-uniform.png").read_bytes().startswith(PNG)
    content = json.loads(file.read_text())
    assert content["passed"] is False
    assert set(content["scenes"]) == set(particle_runs.SCENES)
    assert content["scenes"]["uniform"]["EIP-HL"]["energy_error"] < 1e-9
    assert [check["passed"] for check in content["checks"]].count(False) > 0
    assert "FAILED" in capsys.readouterr().out
    rows = read(tmp_path / "charged-particle.csv")
    assert len(rows) == 3 * 8 * (STEPS + 1)
    assert float(rows[0]["y"]) == -1.0
    assert float(rows[0]["v_x"]) == pytest.approx(0.1)


@pytest.mark.slow
@pytest.mark.usefixtures("short_runs", "no_plotting")
@pytest.mark.parametrize(
    ("options", "scenes"),
    [
        ([], particle_runs.SCENES),
        (["uniform"], ("uniform",)),
        (["tokamak"], particle_runs.SCENES[1:]),
        (["tokamak", "--orbit", "banana"], ("tokamak-banana",)),
    ],
)
def test_scenes_of_the_command(options, scenes, tmp_path, capsys):
    file = tmp_path / "run.json"
    main(["charged-particle", *options, "--out", str(tmp_path), "--json", str(file), "--quiet"])
    assert tuple(json.loads(file.read_text())["scenes"]) == scenes
    assert capsys.readouterr().out == ""


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.usefixtures("short_runs")
def test_paper_figures(tmp_path, capsys):
    file = tmp_path / "run.json"
    assert main(["reproduce", "fig-particle", "fig-tokamak", "--out", str(tmp_path), "--json", str(file)]) == 1
    assert {path.name for path in tmp_path.iterdir()} == {
        "fig-particle.csv", "fig-particle.png", "fig-tokamak.csv", "fig-tokamak.png", "run.json",
    }  # fmt: skip
    content = json.loads(file.read_text())
    assert not content["passed"]
    assert list(content["fig-tokamak"]["scenes"]) == ["tokamak-banana", "tokamak-transit"]
    assert "Charged particle, axisymmetric tokamak, transit orbit" in capsys.readouterr().out


# --- the paper's intervals ---


@pytest.fixture(scope="module", params=particle_runs.SCENES)
def full(request):
    return particle_runs.study(request.param)


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.needs_jit
def test_the_papers_claims(full):
    """Gyroradius, guiding centre, banana tips, extrema, magnetic moment: all bounds of the command."""
    failed = [check.text for check in particle_report.checks(full) if not check.passed]
    assert failed == []


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.needs_jit
def test_what_the_documentation_says_of_the_peers(full):
    """The picture is right, the phase is not; and Boris is as good or better in the tokamak, in 1/6 of the time."""
    got = full.numbers
    if full.scene == "uniform":
        assert got["EIP-HL"]["phase_error"] == pytest.approx(6.8, abs=0.1)
        assert got["EIP-HL, RK5"]["phase_error"] == pytest.approx(0.051, abs=0.002)
        assert got["Boris"]["angle_error"] == pytest.approx(0.081, abs=0.002)
        assert got["implicit midpoint"]["angle_error"] == pytest.approx(0.11, abs=0.01)
        # Both turn by 2 atan(h / 2) in a step in place of h.
        h = full.problem.h
        for method in ("Boris", "implicit midpoint"):
            lag = 270_000 * (h - 2 * math.atan(h / 2))
            assert got[method]["phase_error"] == pytest.approx(lag, rel=0.02)
    else:
        assert got["Boris"]["extrema_error"] < got["EIP-HL"]["extrema_error"]
        assert abs(got["Boris"]["moment_change"]) < 1e-7
        assert got["implicit midpoint"]["energy_error"] > 5e-4
