"""The command line and what all studies share: exit statuses, options, files; the check of an installation."""

import inspect
import json
import sys
import warnings
from importlib import import_module
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

import eip_scipy
from eip_scipy import ProjectionWarning
from eip_scipy_studies import doctor, report
from eip_scipy_studies.cli import COMMANDS, main
from eip_scipy_studies.output import Output, parser, run


def sums(out: Output, *, upto: int = 3, then: Literal["pass", "fail", "stop", "warn"] = "pass") -> None:
    """Add numbers, and fail on request.

    Parameters
    ----------
    upto : int
        the last number
    then : str
        what happens after the first number
    """
    rows = []
    with out.keep():
        for number in out.bar(range(upto + 1)):
            rows.append({"number": number})
            if then == "stop":
                raise KeyboardInterrupt
            if then == "warn":
                warnings.warn("not reliable", ProjectionWarning, stacklevel=1)
    total = sum(row["number"] for row in rows)
    out.numbers["sum"] = total
    out.rows("sums.csv", rows)
    out.figure("first.png", "plot:blank_figure", 4, 3)
    out.text(f"sum: {total}")
    out.check("all", then != "fail")


def copied(out: Output, *, given: Path | None = None) -> None:
    """Write a number to a file, which may be the one that is given.

    Parameters
    ----------
    given : Path
        an input
    """
    out.numbers["sum"] = 1
    out.rows("sums.csv", [{"number": 1}])


@pytest.mark.parametrize("place", ["--out", "--json", "link"])
def test_no_input_of_a_command_is_overwritten(place, tmp_path, capsys):
    given = tmp_path / "sums.csv"
    given.write_text("kept")
    target, out = tmp_path / "sums.json", tmp_path if place == "--out" else tmp_path / "out"
    if place == "link":
        target.hardlink_to(given)
    words = ["--given", str(given), "--out", str(out), "--json", str(given if place == "--json" else target)]
    assert run("copied", copied, words) == 2
    assert given.read_text() == "kept"
    assert "is an input of this command" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("then", "status", "err"), [("pass", 0, ""), ("fail", 1, ""), ("stop", 130, "interrupted"), ("warn", 1, "reliable")]
)
def test_status_and_files(then, status, err, tmp_path, capsys):
    words = ["--then", then, "--out", str(tmp_path), "--json", str(tmp_path / "sums.json")]
    assert run("sums", sums, words) == status
    assert sorted(path.name for path in tmp_path.iterdir()) == ["first.png", "sums.csv", "sums.json"]
    content, printed = json.loads((tmp_path / "sums.json").read_text()), capsys.readouterr()
    assert content["command"] == "sums"
    assert content["arguments"] == {"upto": 3, "then": then}
    assert content["sum"] == (0 if then == "stop" else 6)
    assert content["trusted"] == (then != "warn")
    assert content["versions"]["eip_scipy"] == eip_scipy.__version__
    assert content["checks"] == [{"text": "all", "passed": then != "fail"}]
    assert f"sum: {content['sum']}\n" in printed.out
    assert err in printed.err


def test_without_matplotlib_the_rest_is_done(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert run("sums", sums, ["--out", str(tmp_path)]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["sums.csv"]
    assert 'no figures without matplotlib: pip install "eip_scipy[plot]"' in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "status"),
    [
        (["--version"], 0),
        (["--help"], 0),
        (["solar-system", "--help"], 0),
        (["solar"], 2),
        (["solar-system", "--years", "-1"], 2),
        (["solar-system", "--resume"], 2),
        (["solar-system", "truth"], 2),
        (["hard-cases", "--out", "/dev/null/folder"], 2),
        *((["hard-cases", wrong], 2) for wrong in ("--rtol=0", "--rtol=nan", "--rtol=one", "--rtol=1e-20")),
        (["hard-cases", "--cases", "nobody"], 2),
        (["doctor", "--many"], 2),
    ],
)
def test_status_of_words(words, status, capsys):
    assert main(words) == status
    printed = capsys.readouterr()
    assert bool(printed.out) == (status == 0)
    assert bool(printed.err) == (status == 2)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_is_a_function_whose_options_are_described(name):
    assert len(COMMANDS) <= 12
    module, _, function = COMMANDS[name][0].partition(":")
    study = getattr(import_module(f"eip_scipy_studies.{module}"), function)
    described = parser(name, study).format_help()
    for option in list(inspect.signature(study).parameters)[1:]:
        assert option.replace("_", "-") in described.lower()
    assert "eip_results" in described


def test_numbers_as_text():
    numbers = [0.0, 71.2, -0.8939, 0.0011, -3.6e-9, 123456.0, 9.96, 0.0996, 999.0, np.nan, None]
    expected = ["0", "71", "-0.89", "1.1e-3", "-3.6e-9", "1.2e5", "10", "0.10", "1.0e3", "-", "-"]
    assert [report.compact(number) for number in numbers] == expected


def test_json_has_no_nan_and_no_numpy(tmp_path):
    content = {"a": np.array([1.0, np.nan]), "b": np.int64(3), 4: (np.bool_(True),)}
    file = report.write_json(tmp_path / "x.json", content)
    assert json.loads(file.read_text()) == {"a": [1.0, None], "b": 3, "4": [True]}


def test_an_installation_that_works(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr("eip_scipy.core.config.EXTRAS", {"no_such_module": ("plot", "figures")})
    file = tmp_path / "doctor.json"
    assert main(["doctor", "--json", str(file)]) == 0
    text = capsys.readouterr().out
    assert text.count(" ok") == len(doctor.CHECKS)
    assert "no_such_module  absent: pip install 'eip_scipy[plot]'" in text
    found = json.loads(file.read_text())
    assert all(check["passed"] for check in found["checks"])
    assert found["installation"] == eip_scipy.show_config("dicts")
    assert found["installation"]["engine"]["build"] in text


@pytest.mark.parametrize("measure", [lambda: 2.0, lambda: float("nan"), lambda: 1 / 0])
def test_an_installation_that_does_not(measure, capsys, monkeypatch):
    monkeypatch.setattr(doctor, "CHECKS", (*doctor.CHECKS[:1], ("sums", 1.0, measure)))
    assert main(["doctor"]) == 1
    shown = capsys.readouterr()
    assert "FAILED" in shown.out
    assert shown.out.count(" ok") == 1
    assert "failed: sums." in shown.err
