"""``eip-scipy mechanisms``: its runs, its comparisons, its files, and its checks."""

import csv
import json
import sys

import numpy as np
import pytest

from eip_scipy.problems import mechanism
from eip_scipy_studies.cli import main
from eip_scipy_studies.mechanisms import examples, study, ways
from eip_scipy_studies.mechanisms.figures import joints
from eip_scipy_studies.mechanisms.speed import Speed
from eip_scipy_studies.study import Session

PNG = b"\x89PNG\r\n\x1a\n"
FEW = {"tolerances": (1e-3, 1e-5), "repeats": 1}


def pendulum():
    """One that branches by its values, so that it runs in plain Python, which is quick here."""

    def length(t, q):
        assert np.all(np.real(q) < 2)
        return [(q[0] ** 2 + q[1] ** 2 - 1) / 2]

    return mechanism(
        [1, 1], [0, -9.81], length, q0=[1, 0], u0=[0, 0], t_span=(0, 0.4), potential_energy=lambda t, q: 9.81 * q[1]
    )


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setitem(examples.EXAMPLES, "small", pendulum)


def rows_of(folder):
    with open(folder / "mechanisms.csv", newline="") as stream:
        return list(csv.DictReader(stream))


@pytest.mark.slow
def test_it_compares_errors_calls_and_time(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "sksundae", None)
    monkeypatch.setitem(sys.modules, "sksundae.ida", None)
    file = tmp_path / "run.json"
    assert main(["mechanisms", "--only", "small", "--out", str(tmp_path), "--json", str(file)], **FEW) == 0
    out, err = capsys.readouterr()
    assert "no comparison with IDA: it needs scikit-sundae (python -m pip install scikit-sundae)" in err
    rows = rows_of(tmp_path)
    methods = ["DOP853", "constraints", "constraints and energy", "LSODA", "Radau"]
    assert [row["method"] for row in rows] == [method for method in methods for _ in FEW["tolerances"]]
    error = {(row["method"], float(row["tolerance"])): float(row["error"]) for row in rows}
    for method in methods:
        assert error[method, 1e-5] < 1e-2
        assert error[method, 1e-5] < error[method, 1e-3]
    assert all(int(row["calls"]) > 0 < float(row["seconds"]) for row in rows)
    assert len(json.loads(file.read_text())["runs"]) == len(rows)
    assert "small: error of the last position (calls), by tolerance" in out
    assert "small: calls and milliseconds for an error of" in out
    assert (tmp_path / "mechanisms.png").read_bytes().startswith(PNG)


def test_ida_keeps_the_constraints_as_equations():
    pytest.importorskip("sksundae", reason="needs scikit-sundae: python -m pip install scikit-sundae")
    problem, session = pendulum(), Session("mechanisms")
    found = ways.ways(problem, session)
    assert session.absent == []
    exact = found[ways.BOTH](1e-10).y
    errors = []
    for tolerance in (1e-4, 1e-6, 1e-8):
        outcome = found["IDA"](tolerance)
        assert abs(outcome.y[0] ** 2 + outcome.y[1] ** 2 - 1) < 10 * tolerance
        errors.append(np.abs(outcome.y - exact).max())
        assert outcome.calls > 20
    assert errors[2] < 1e-5
    assert errors[0] < 1e-2


def test_a_run_that_takes_too_long_has_no_error(monkeypatch, tmp_path):
    monkeypatch.setattr(ways, "MOST_CALLS", 30)
    main(["mechanisms", "--only", "small", "--out", str(tmp_path), "--quiet"], **FEW)
    rows = {row["method"]: row for row in rows_of(tmp_path)}
    assert rows["LSODA"]["error"] in ("", "nan")
    assert float(rows["DOP853"]["error"]) < 1


def test_checks_can_fail():
    def line(method, error, calls=100, reliable=True):
        return study.Line("four-bar", method, 1e-6, error, calls, 0.1, reliable)

    names = [f"Baumgarte {factor:g}" for factor in ways.FACTORS]
    lines = [line(ways.NEITHER, 1e-2), line(ways.BOTH, 1e-4, 104), *(line(name, 1e-3) for name in names)]
    found = study.Found(lines, {"car axis": 1e-9}, Speed(1.0, 30.0, 3.0), "a machine")
    checks = study.Mechanisms().checks(found)
    assert len(checks) == 5
    assert all(check.passed for check in checks)
    lines[1] = line(ways.BOTH, 2e-3, 106, reliable=False)
    found = study.Found(lines, {"car axis": 2e-8}, Speed(1.0, 19.0, 6.0), "a machine")
    checks = study.Mechanisms().checks(found)
    assert len(checks) == 6
    assert not any(check.passed for check in checks)


def test_the_linkage_is_drawn(tmp_path):
    from eip_scipy_studies.plotting import CostPanel, Linkage, linkage_figure, linkages_figure

    y = np.array([[np.pi / 2, 0.0], [-np.pi / 2, np.pi / 3], [-np.pi / 2, -np.pi / 3], [0, 0], [0, 0], [0, 0]])
    places = joints(y, {"la": 1.0, "lb": 2.0, "lc": 1.0})
    np.testing.assert_allclose(places[0], [[0, 0], [0, 1], [2, 1], [2, 0]], atol=1e-15)
    np.testing.assert_allclose(places[1], [[0, 0], [1, 0], [2, np.sqrt(3)], [3, np.sqrt(3)]], atol=1e-15)
    linkage = Linkage([0.0, 1.0], places, [[0, 0], [2, 0]])
    panel = CostPanel("", "calls", {"one": ([10.0, 100.0], [1e-2, 1e-4])})
    figure = linkage_figure({"run": linkage}, [panel], unit="m", time="t", error="error")
    figure.savefig(tmp_path / "linkage.png")
    assert (tmp_path / "linkage.png").read_bytes().startswith(PNG)
    alone = linkages_figure({"left": linkage, "right": linkage}, unit="m", time="t")
    assert [axes.get_title() for axes in alone.axes] == ["left", "right", ""]
    links, gap = alone.axes[0].collections[0].get_segments(), alone.axes[0].lines[2].get_xydata()
    np.testing.assert_array_equal(links, places)
    np.testing.assert_array_equal(gap, [places[1][-1], [2, 0]])  # at the last time, from the link to its pivot


def test_figures_are_no_wider_than_a_page():
    from eip_scipy_studies.plotting import blank_figure

    assert tuple(blank_figure(6, 4).get_size_inches()) == (6, 4)
    assert tuple(blank_figure(36, 4).get_size_inches()) == (9, 2)


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.needs_jit
@pytest.mark.parametrize("name", ["knife edge", "car axis"])
def test_a_known_one(name, tmp_path):
    assert main(["mechanisms", "--only", name, "--out", str(tmp_path)], repeats=1) == 0
