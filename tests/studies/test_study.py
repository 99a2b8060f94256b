"""Common parts of all commands: the runner of studies, the table of commands, the reading of options."""

import json
import subprocess
import sys
from dataclasses import dataclass, fields
from importlib import import_module
from pathlib import Path

import pytest

from eip_scipy_studies.cli import main
from eip_scipy_studies.commands import COMMANDS
from eip_scipy_studies.report import UsageError
from eip_scipy_studies.study import Check, Command, PartlyDone, Session, Study, option


class Figure:
    """Replacement of matplotlib's figure."""

    def savefig(self, path):
        path.write_text("drawn")


@dataclass(frozen=True, kw_only=True)
class Sums(Study):
    """Add numbers, and fail on request."""

    upto: int = option(3, "the last number", type=int)
    ends: dict
    passed: bool = True

    def measure(self, session):
        with session.bar(self.upto, "sums"):
            return self.obey("measure", list(range(self.upto + 1)))

    def obey(self, where, value):
        if where in self.ends:
            raise self.ends[where]
        return value

    def text(self, found):
        return f"sum: {sum(found)}"

    def tables(self, found):
        return {"sums.csv": [{"number": number} for number in found]}

    def numbers(self, found):
        return {"sum": sum(found)}

    def checks(self, found):
        return [Check("all", self.passed)]

    def refine(self, found, session):
        found.append(self.obey("refine", 10))
        return True

    def figures(self, found):
        yield "first.png", Figure()
        yield self.obey("figures", "second.txt"), lambda path: path.write_text("written")

    def when_interrupted(self):
        return "go on so"


def outcome(tmp_path, capsys, **settings):
    """Return exit status, lines printed, lines of errors, and names of files."""
    out = tmp_path / "out"
    study = Sums(**{"ends": {}, **settings})
    status = study.run(Session("sums", out, tmp_path / "sums.json"))
    printed = capsys.readouterr()
    return status, printed.out.splitlines(), printed.err.splitlines(), sorted(path.name for path in out.iterdir())


def test_text_numbers_and_figures(tmp_path, capsys):
    status, printed, errors, files = outcome(tmp_path, capsys)
    assert (status, errors) == (0, [])
    assert printed[:2] == ["sum: 6", ""]
    names = ["sums.csv", "sums.json", "first.png", "second.txt"]  # numbers first, and each named once
    assert [line.rpartition("/")[2] for line in printed[2:]] == names
    assert files == ["first.png", "second.txt", "sums.csv"]
    content = json.loads((tmp_path / "sums.json").read_text())
    assert (content["command"], content["arguments"], content["sum"]) == ("sums", {"upto": 3}, 16)


def test_a_failed_check_is_the_status(tmp_path, capsys):
    assert outcome(tmp_path, capsys, passed=False)[0] == 1


def test_an_interruption_writes_nothing(tmp_path, capsys):
    status, printed, errors, files = outcome(tmp_path, capsys, ends={"measure": KeyboardInterrupt()})
    assert (status, printed, files) == (130, [], [])
    assert errors == ["eip-scipy: go on so", "eip-scipy: interrupted; nothing was written"]


@pytest.mark.parametrize(
    ("ends", "message"),
    [
        ({"measure": PartlyDone([1, 2])}, "interrupted; the runs that were done are in the table and the files"),
        ({"refine": KeyboardInterrupt()}, "interrupted; the table is complete, what is measured after it"),
    ],
)
def test_an_interruption_later_leaves_the_numbers(ends, message, tmp_path, capsys):
    status, printed, errors, files = outcome(tmp_path, capsys, ends=ends)
    assert (status, files) == (130, ["sums.csv"])
    assert printed[0].startswith("sum: ")
    assert message in errors[1]


def test_a_figure_that_cannot_be_drawn(tmp_path, capsys):
    status, _, errors, files = outcome(tmp_path, capsys, ends={"figures": ImportError("no brush")})
    assert (status, errors) == (0, ["eip-scipy: no figures: no brush"])
    assert files == ["first.png", "sums.csv"]


def test_what_the_memory_does_not_hold(tmp_path):
    with pytest.raises(UsageError, match="not enough memory: 3 GB"):
        Sums(ends={"measure": MemoryError("3 GB")}).run(Session("sums", tmp_path))


def test_progress_is_for_terminals(monkeypatch, capsys):
    """Progress is not shown in a file, which stderr is here, because it would fill it."""
    with Session("sums").bar(2, "adding") as bar:
        bar.update()
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    with Session("sums").bar(2, "adding") as bar:
        bar.update()
    assert "adding:   0%" in capsys.readouterr().err
    with Session("sums", quiet=True).bar(2, "adding") as bar:
        bar.update()
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_is_there_and_says_what_it_takes(name, capsys):
    module, kind = COMMANDS[name].where.split(":")
    command = getattr(import_module(f"eip_scipy_studies.{module}"), kind)
    assert issubclass(command, Command)
    assert main([*name.split(), "--help"]) == 0
    printed = capsys.readouterr().out
    for item in fields(command):
        positional = item.metadata.get("metavar") if item.metadata.get("positional") else None
        flag = positional or f"--{item.name.replace('_', '-')} "
        assert (flag in printed) == ("help" in item.metadata)


def test_help_is_quick():
    """The help imports neither SciPy nor NumPy nor matplotlib."""
    code = "import sys; from eip_scipy_studies.cli import main; main(['--help']); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = {name.split(".")[0] for name in done.stdout.split()}
    assert "argparse" in loaded
    assert not loaded & {"numpy", "scipy", "numba", "matplotlib", "tqdm"}


WRITING = """
import sys
sys.path.insert(0, {tests!r})
from pathlib import Path
from eip_scipy_studies.cli import main
from eip_scipy_studies.commands import COMMANDS, Entry
import test_study
sys.modules["eip_scipy_studies.test_study"] = test_study
COMMANDS["sums"] = Entry("test_study:Sums", "")
sys.exit(main(["sums", "--out", {out!r}, "--json", {json!r}], ends={{}}))
"""


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no file that is always full")
@pytest.mark.parametrize(("redirected", "status"), [(">/dev/full", 3), (">&-", 3), (">&- 2>&-", 3), ("| true", 0)])
def test_a_stdout_that_takes_nothing_loses_no_file(redirected, status, tmp_path):
    names = {"tests": str(Path(__file__).parent), "out": str(tmp_path / "out"), "json": str(tmp_path / "sums.json")}
    (tmp_path / "run.py").write_text(WRITING.format(**names))
    command = f"set -o pipefail; sleep 0.1 | {sys.executable} {tmp_path / 'run.py'} {redirected}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True)
    assert done.returncode == status
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["first.png", "second.txt", "sums.csv"]
    assert json.loads((tmp_path / "sums.json").read_text())["sum"] == 16
    if status and "2>" not in redirected:
        assert done.stderr.startswith("eip-scipy: cannot print to standard output: ")
        assert done.stderr.count("\n") == 1


def test_files_are_written_before_the_text_is_made(tmp_path):
    class Wordless(Sums):
        def text(self, found):
            raise UnicodeError

    with pytest.raises(UnicodeError):
        Wordless(ends={}).run(Session("sums", tmp_path, tmp_path / "sums.json"))
    assert (tmp_path / "sums.csv").exists()
    assert (tmp_path / "sums.json").exists()
