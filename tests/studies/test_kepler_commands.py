"""The commands on Kepler's problem in small, quick in plain Python, too: numbers, files, figures, exit statuses."""

import csv
import json

import numpy as np
import pytest

from eip_scipy import EIPRK2, EIPRK4, EIPRK45
from eip_scipy_studies.cli import main
from eip_scipy_studies.kepler import cost as kepler_cost
from eip_scipy_studies.kepler import figures as kepler_figures
from eip_scipy_studies.report import compact
from eip_scipy_studies.study import Session

PNG = b"\x89PNG\r\n\x1a\n"
T_END = 1.5


def read(file):
    with open(file, newline="") as stream:
        return list(csv.DictReader(stream))


# Work and precision.


FEW = {
    "t_end": T_END,
    "repeats": 1,
    "reference_steps": 300,
    "fixed": {EIPRK2: (100, 400), EIPRK4: (100, 200)},
    "pairs": {EIPRK45: (1e-4, 1e-7)},
}


def test_errors_fall_with_the_order_and_work_is_counted(tmp_path, capsys):
    file = tmp_path / "run.json"
    assert main(["work-precision", "--out", str(tmp_path), "--json", str(file)], **FEW) == 0
    points = json.loads(file.read_text())["points"]
    error = {method: [p["position_error"] for p in points if p["method"] == method] for method in ("EIPRK2", "EIPRK4")}
    assert error["EIPRK2"][0] / error["EIPRK2"][1] == pytest.approx(4**2, rel=0.2)
    assert error["EIPRK4"][0] / error["EIPRK4"][1] == pytest.approx(2**4, rel=0.2)
    assert [p["h"] for p in points] == [T_END / 100, T_END / 400, T_END / 100, T_END / 200, None, None]
    assert [p["rtol"] for p in points] == [None] * 4 + [1e-4, 1e-7]
    assert [p["nfev"] for p in points[:2]] == [1 + 2 * 100, 1 + 2 * 400]  # f at the start and two stages a step
    assert points[4]["position_error"] > 100 * points[5]["position_error"]
    assert (tmp_path / "work-precision.png").read_bytes().startswith(PNG)
    lines = capsys.readouterr().out.splitlines()
    assert sum(line.startswith("cheapest of all") for line in lines) == 2
    assert [line.split()[0] for line in lines if line.startswith("wrote")] == ["wrote"] * 3


def test_csv_of_work_and_precision_has_a_line_for_each_run(tmp_path, capsys):
    assert main(["work-precision", "--out", str(tmp_path), "--quiet"], **FEW) == 0
    assert [row["method"] for row in read(tmp_path / "work-precision.csv")] == [
        "EIPRK2", "EIPRK2", "EIPRK4", "EIPRK4", "EIPRK45", "EIPRK45",
    ]  # fmt: skip
    assert capsys.readouterr().out == ""


def test_cheapest_methods_of_the_text():
    def work(name, *errors):
        return [kepler_cost.KeplerPoint(name, k, 1000 * k, k / 1000, error) for k, error in enumerate(errors, 1)]

    points = [*work("EIPRK2", 0.1, 1e-2, 1e-4), *work("EIPRK45", 1e-2, 1e-3)]
    points += [point for name in ("EIPRK3", "EIPRK4", "EIPRK5") for point in work(name, np.nan)]
    text = kepler_cost.KeplerCost().text(kepler_cost.Found(points, "a machine"))
    nfev = text.split("for an error of")[1].splitlines()
    row = {line[:24].strip(): line[24:].split() for line in nfev}
    assert row["EIPRK2"] == ["2.0", "3.0", "-", "-"]
    assert row["EIPRK3"] == ["-"] * 4
    assert row["EIPRK45"] == ["<1.0", "-", "-", "-"]
    assert row["cheapest with fixed step"] == ["EIPRK2", "EIPRK2", "-", "-"]
    assert row["cheapest of all"] == ["EIPRK45", "EIPRK2", "-", "-"]


# The paper's figures 1 and 2.


SHORT = kepler_figures.KeplerFigures(t_end=T_END)


@pytest.fixture(scope="module")
def lines():
    return SHORT.measure(Session("fig-kepler"))


def test_each_line_keeps_what_it_is_named_after(lines):
    assert list(lines) == ["EIP-H", "EIP-L", "EIP-HL", "EIP-HL, RK2", "EIP-HL, RK5"]
    energy, momentum = ({name: getattr(line, f"{kind}_error").max() for name, line in lines.items()}
                        for kind in ("energy", "momentum"))  # fmt: skip
    assert energy["EIP-H"] < 1e-12 < 1e-7 < momentum["EIP-H"]
    assert momentum["EIP-L"] < 1e-12 < 1e-7 < energy["EIP-L"]
    assert max(energy["EIP-HL"], momentum["EIP-HL"]) < 1e-10
    assert energy["EIP-HL, RK5"] < 1e-12


def test_positions_are_measured_against_the_solution(lines):
    end = {name: line.position_error[-1] for name, line in lines.items()}
    assert lines["EIP-H"].t[-1] == pytest.approx(T_END)
    assert lines["EIP-H"].y.shape == (4, 51)
    assert 1e-4 < end["EIP-HL, RK2"] < 1e-1
    assert 1e-7 < end["EIP-HL, RK5"] < end["EIP-HL"] < 1e-3


def test_known_values_are_compared_to_their_digits(lines):
    assert not any(check.passed for check in kepler_figures.KeplerFigures().checks(lines))  # they are those at t = 2000
    at_end, largest = lines["EIP-H"].momentum_error[-1], lines["EIP-HL, RK2"].energy_error.max()
    known = [
        ("EIP-H", "momentum_error", "|L - L0|", "end", compact(at_end)),
        ("EIP-H", "momentum_error", "|L - L0|", "end", compact(1.2 * at_end)),
        ("EIP-HL, RK2", "energy_error", "max |H - H0|", "max", compact(largest)),
    ]
    study = kepler_figures.KeplerFigures(t_end=T_END, known=known)
    checks = study.checks(lines)
    assert [check.passed for check in checks] == [True, False, True]
    assert [check.record["ours"] for check in checks] == [at_end, at_end, largest]
    assert study.text(lines).splitlines()[-2].startswith("FAILED EIP-H")


def test_figures_have_a_row_for_each_method(lines):
    figures = dict(SHORT.figures(lines))
    assert {name: len(figure.axes) for name, figure in figures.items()} == {
        "fig-kepler-1.png": 3 * 4, "fig-kepler-2.png": 2 * 4,
    }  # fmt: skip
    for axis in (axis for figure in figures.values() for axis in figure.axes if axis.get_yscale() == "log"):
        powers = np.log10(axis.get_ylim())
        np.testing.assert_allclose(powers, np.round(powers), atol=1e-9)
        assert powers[1] - powers[0] >= 1
    orbit = figures["fig-kepler-1.png"].axes[0].lines[0].get_xydata().T
    np.testing.assert_array_equal(orbit, lines["EIP-H"].y[:2])


@pytest.mark.nightly
@pytest.mark.slow
def test_command_for_the_figures(lines, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(kepler_figures.KeplerFigures, "measure", lambda self, session: lines)
    file = tmp_path / "run.json"
    assert main(["reproduce", "fig-kepler", "--out", str(tmp_path), "--json", str(file)]) == 1
    assert capsys.readouterr().out.count("\nFAILED ") == 4
    assert not json.loads(file.read_text())["passed"]
    assert {path.name for path in tmp_path.iterdir()} == {
        "fig-kepler.csv", "fig-kepler-1.png", "fig-kepler-2.png", "run.json",
    }  # fmt: skip
    rows = read(tmp_path / "fig-kepler.csv")
    assert [(row["method"], float(row["t"])) for row in rows[:3]] == [
        ("EIP-H", 0.0), ("EIP-H", pytest.approx(50 * 0.03)), ("EIP-L", 0.0),
    ]  # fmt: skip
    assert float(rows[1]["q1"]) == lines["EIP-H"].y[0, 50]
