"""The command line and the runner of all commands: exit statuses, files, and small runs of each measurement."""

import json
import os
import shlex
import subprocess
import sys
from dataclasses import dataclass
from importlib import import_module

import numpy as np
import pytest

import eip_scipy
from eip_scipy_studies import report
from eip_scipy_studies.cli import main
from eip_scipy_studies.commands import COMMANDS
from eip_scipy_studies.study import Check, PartlyDone, Session, Study, option
from eip_scipy_studies.timing import least

RUNS = [
    ("bench metric", "--only gear", ()),
]


class Figure:
    """Replacement of matplotlib's figure."""

    def savefig(self, path):
        path.write_text("drawn")


@dataclass(frozen=True, kw_only=True)
class Sums(Study):
    """Add numbers, and fail on request."""

    upto: int = option(3, "the last number", type=int)
    fails: BaseException | None = None
    passed: bool = True

    def measure(self, session):
        if self.fails:
            raise self.fails
        return list(range(self.upto + 1))

    def text(self, found):
        return f"sum: {sum(found)}"

    def tables(self, found):
        return {"sums.csv": [{"number": number} for number in found]}

    def numbers(self, found):
        return {"sum": sum(found)}

    def checks(self, found):
        return [Check("all", self.passed)]

    def figures(self, found):
        yield "first.png", Figure()


@pytest.mark.parametrize(
    ("settings", "status", "files"),
    [
        ({}, 0, ["first.png", "sums.csv", "sums.json"]),
        ({"passed": False}, 1, ["first.png", "sums.csv", "sums.json"]),
        ({"fails": KeyboardInterrupt()}, 130, []),
        ({"fails": PartlyDone([1, 2])}, 130, ["sums.csv", "sums.json"]),
    ],
)
def test_status_and_files(settings, status, files, tmp_path, capsys):
    assert Sums(**settings).run(Session("sums", tmp_path, tmp_path / "sums.json")) == status
    assert sorted(path.name for path in tmp_path.iterdir()) == files
    if not status:
        content = json.loads((tmp_path / "sums.json").read_text())
        assert (content["command"], content["arguments"], content["sum"]) == ("sums", {"upto": 3}, 6)
        assert content["versions"]["numpy"] == np.__version__
        assert capsys.readouterr().out.startswith("sum: 6\n")


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
    ],
)
def test_status_of_words(words, status, capsys):
    assert main(words) == status
    printed = capsys.readouterr()
    assert bool(printed.out) == (status == 0)
    assert bool(printed.err) == (status == 2)


def test_every_command_is_found_and_every_measurement_run():
    for entry in COMMANDS.values():
        module, kind = entry.where.split(":")
        assert hasattr(import_module(f"eip_scipy_studies.{module}"), kind)
    assert {name for name, *_ in RUNS} >= {name for name in COMMANDS if name.startswith("study ")}


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.needs_jit
@pytest.mark.parametrize(("name", "arguments", "modules"), RUNS, ids=[f"{name} {words}" for name, words, _ in RUNS])
def test_small_run(name, arguments, modules, tmp_path):
    for module in modules:
        pytest.importorskip(module)
    words = [*name.split(), *shlex.split(arguments), "--json", "run.json"]
    command = [sys.executable, "-m", "eip_scipy", *words]
    run = subprocess.run(command, cwd=tmp_path, env={**os.environ, "MPLBACKEND": "Agg"}, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert run.stdout
    assert json.loads((tmp_path / "run.json").read_text())["versions"]["eip_scipy"] == eip_scipy.__version__


def test_numbers_and_times():
    numbers = [0.0, 71.2, -0.8939, 0.0011, -3.6e-9, 123456.0, 9.96, 0.0996, 999.0, np.nan, None]
    expected = ["0", "71", "-0.89", "1.1e-3", "-3.6e-9", "1.2e5", "10", "0.10", "1.0e3", "-", "-"]
    assert [report.compact(number) for number in numbers] == expected
    order = []
    actions = {name: lambda name=name: order.append(name) or float(len(order)) for name in "ab"}
    assert least(actions, turns=3) == {"a": 1.0, "b": 2.0}
    assert order == list("ababab")


def test_json_has_no_nan_and_no_numpy(tmp_path):
    content = {"a": np.array([1.0, np.nan]), "b": np.int64(3), 4: (np.bool_(True),)}
    file = report.write_json(tmp_path / "x.json", content)
    assert json.loads(file.read_text()) == {"a": [1.0, None], "b": 3, "4": [True]}
