"""`eip-scipy reproduce fig-efficiency` on a small grid: runs, checks, and files."""

import csv
import json

import numpy as np
import pytest

from eip_scipy_studies.cli import main
from eip_scipy_studies.condensates import efficiency as gpe_efficiency
from eip_scipy_studies.study import Session

pytestmark = [pytest.mark.nightly, pytest.mark.slow]


SMALL = gpe_efficiency.Efficiency(points=16, repeats=1)


@pytest.fixture(scope="module")
def trials():
    """On 16 x 16 points, where the modulated wave is resolved to 1e-3: the errors are those of the steps alone."""
    return SMALL.measure(Session("fig-efficiency"))


def test_orders_are_those_of_the_methods(trials):
    """On the plane wave, where splittings are exact and RK4 is at round-off; on the modulated one all have theirs."""
    for name, order in {"CN": 2, "LIC": 2, "SAV/CN": 2, "Strang": 2, "splitting4-EIP": 4}.items():
        assert trials["modulated wave"].slope(name) == pytest.approx(order, abs=0.1), name
    for name in ("RK4", "EIP-M", "EIP-E", "EIP-ME"):
        assert trials["modulated wave"].slope(name) == pytest.approx(4, abs=0.1), name
    for name in ("Strang", "splitting4-EIP"):
        assert np.isnan(trials["plane wave"].slope(name))
        assert trials["plane wave"].column(name, "error_max").max() < 1e-12


def test_each_method_keeps_what_it_says(trials):
    wave = trials["modulated wave"]
    for name, kept in {"EIP-M": "mass", "EIP-E": "energy"}.items():
        lost = {"mass": "energy", "energy": "mass"}[kept]
        # The longest steps leave residuals of order 10 in h.
        assert wave.column(name, f"error_{kept}").max() < 1e-12 < wave.column(name, f"error_{lost}").max()
    fine = slice(2, None)
    for name in ("EIP-ME", "splitting4-EIP"):
        for kept in ("mass", "energy"):
            assert wave.column(name, f"error_{kept}")[fine].max() < 1e-13
    assert "rank 1" in trials["plane wave"].rows["EIP-ME", trials["plane wave"].column("EIP-ME", "h")[0]]["remark"]


def test_sav_takes_one_pair_of_transforms_a_step(trials):
    for trial in trials.values():
        np.testing.assert_allclose(trial.column("SAV/CN", "pairs") * trial.column("SAV/CN", "h"), 1, rtol=0.05)


def test_command(trials, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(gpe_efficiency.Efficiency, "measure", lambda self, session: trials)
    status = main(["reproduce", "fig-efficiency", "--out", str(tmp_path), "--json", str(tmp_path / "run.json")])
    content = json.loads((tmp_path / "run.json").read_text())
    checks = content["fig-efficiency"]["checks"]
    assert status == (0 if all(check["matched"] for check in checks) else 1)
    assert {path.name for path in tmp_path.iterdir()} == {"fig-efficiency.csv", "fig-efficiency.png", "run.json"}
    out = capsys.readouterr().out
    assert out.count("FAILED") == sum(not check["matched"] for check in checks)
    for name in gpe_efficiency.METHODS:
        assert out.count(f"\n{name} ") == 2  # a row in each table
    with open(tmp_path / "fig-efficiency.csv", newline="") as stream:
        lines = list(csv.DictReader(stream))
    assert len(lines) == sum(len(trial.rows) for trial in trials.values())
    assert {line["wave"] for line in lines} == {"plane wave", "modulated wave"}


def test_a_wrong_slope_is_a_failure(trials):
    study = gpe_efficiency.Efficiency(orders={**gpe_efficiency.ORDERS, "CN": 3})
    failed = [check for check in study.checks(trials) if check.record["quantity"] == "slope of CN"]
    assert [check.passed for check in failed] == [False, False]
    assert "FAILED modulated wave, slope of CN: 2, known 3" in study.text(trials)


def test_figure_has_a_row_for_each_wave(trials):
    ((name, figure),) = SMALL.figures(trials)
    assert name == "fig-efficiency.png"
    assert len(figure.axes) == 4
    assert [axis.get_title() for axis in figure.axes[::2]] == list(trials)
    labels = [line.get_label() for line in figure.axes[0].lines if not line.get_label().startswith("_")]
    assert labels == list(gpe_efficiency.METHODS)
