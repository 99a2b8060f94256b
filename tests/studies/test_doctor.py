"""The command that checks an installation: it passes here, and reports faults."""

import json

import pytest

import eip_scipy
from eip_scipy.core import config
from eip_scipy.engine.native import BUILD
from eip_scipy_studies import doctor
from eip_scipy_studies.cli import main


def test_says_what_is_there_and_that_it_works(capsys, tmp_path):
    file = tmp_path / "doctor.json"
    assert main(["doctor", "--json", str(file)]) == 0
    text = capsys.readouterr().out
    assert BUILD.__name__.rsplit(".", 1)[-1] in text
    assert text.count(" ok") == len(doctor.CHECKS)
    found = json.loads(file.read_text())
    assert all(check["passed"] for check in found["checks"])
    assert found["installation"] == eip_scipy.show_config("dicts")
    assert main(["doctor", "--quiet"]) == 0
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("measure", [lambda: 2.0, lambda: float("nan"), lambda: 1 / 0])
def test_a_wrong_result_is_told(measure, capsys, monkeypatch):
    monkeypatch.setattr(doctor, "CHECKS", (*doctor.CHECKS[:1], ("sums", 1.0, measure)))
    assert main(["doctor"]) == 1
    shown = capsys.readouterr()
    assert "FAILED" in shown.out
    assert shown.out.count(" ok") == 1
    assert "failed: sums." in shown.err


def test_an_extra_that_is_absent_is_named(capsys, monkeypatch):
    monkeypatch.setattr(config, "EXTRAS", {"no_such_module": ("plot", "figures")})
    assert main(["doctor"]) == 0
    assert "no_such_module  absent: pip install 'eip_scipy[plot]'" in capsys.readouterr().out
