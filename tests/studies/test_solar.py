"""``eip-scipy solar-system``: a short run with all of its files, stored states, checkpoints, epochs, force models."""

import json
import math
import sys
from fractions import Fraction

import pytest
from pages import read_rows

from eip_scipy_studies.cli import main
from eip_scipy_studies.solar import command, cost, runs
from eip_scipy_studies.solar.epoch import parse_epoch

FIGURES = {"invariant-errors.png", "longitude-errors.png", "orbits.png", "error-against-cost.png"}
SPAN = ("--years", "0.1", "--h", "0.005")  # quick in plain Python, too; four times that resolves Mercury


def solar(folder, *words):
    """Run the command, and return its status and the rows of its CSV files without times."""
    status = main(["solar-system", *words, "--out", str(folder), "--json", str(folder / "run.json")])
    rows = {}
    for file in folder.glob("*.csv"):
        rows[file.stem] = [{k: v for k, v in row.items() if "wall" not in k} for row in read_rows(file)]
    return status, rows


@pytest.fixture
def few_methods(monkeypatch):
    """Run less than the command would: no REBOUND, no figures."""
    monkeypatch.setitem(sys.modules, "rebound", None)
    monkeypatch.delitem(sys.modules, "eip_scipy.integrations.rebound", raising=False)
    monkeypatch.delattr("eip_scipy.integrations.rebound", raising=False)
    monkeypatch.setattr(command, "FIGURES", ())


@pytest.mark.slow
def test_short_run_with_everything(tmp_path, capsys, monkeypatch):
    pytest.importorskip("rebound")
    monkeypatch.setattr(cost, "REPEATS", 1)
    status, rows = solar(tmp_path, *SPAN, "--cost")
    text = capsys.readouterr().out
    assert status == 0
    assert "FAILED" not in text
    assert max(map(len, text.splitlines()[1:40])) <= 100  # ten columns
    assert {path.name for path in tmp_path.glob("*.png")} == FIGURES
    assert all(path.read_bytes().startswith(b"\x89PNG\r\n\x1a\n") for path in tmp_path.glob("*.png"))
    mercury = {row["method"]: float(row["position_Mercury_AU"] or "nan") for row in rows["solar-system"]}
    own = ["EIPRK4 (error)", "EIPRK4 (euclidean)", "RK4", "SV", "EIPRKN12", "EIPGJ14", "EIPGJ14 (balances)"]
    assert list(mercury) == [*own, "WHFast", "WHFast (c17)", "IAS15"]
    assert math.isnan(mercury["IAS15"])  # it is the reference
    assert mercury["EIPRK4 (error)"] < mercury["SV"] / 10
    assert mercury["WHFast (c17)"] < mercury["WHFast"] / 10
    assert max(mercury["EIPRKN12"], mercury["EIPGJ14"]) < 1e-3 * mercury["EIPRK4 (error)"]
    assert {row["method"] for row in rows["error-against-cost"]} >= {"EIPRK5 (error)", "EIPRKN12", "WHFast (c17)"}
    assert all(float(row["error"]) > 0 for row in rows["error-against-cost"])
    content = json.loads((tmp_path / "run.json").read_text())
    assert (content["command"], content["trusted"], len(content["checks"])) == ("solar-system", True, 4)


@pytest.mark.nightly
@pytest.mark.usefixtures("few_methods")
def test_an_interrupted_command_goes_on(tmp_path, capsys, monkeypatch):
    """With --checkpoint, completed runs are not repeated; the numbers are those of an uninterrupted command."""
    folder = tmp_path / "kept"
    words = [*SPAN, "--checkpoint", str(folder)]
    whole = solar(tmp_path / "whole", *SPAN)

    def interrupted(scene):
        def solve(*arguments, **options):
            raise KeyboardInterrupt

        return solve

    with monkeypatch.context() as patch:
        patch.setattr(runs, "by_verlet", interrupted)
        status, rows = solar(tmp_path / "first", *words)
    assert (status, len(rows["solar-system"])) == (130, 3)
    said = capsys.readouterr().err
    assert f"the same command with --resume goes on from the checkpoints in '{folder}'" in said
    assert "no comparison with WHFast and IAS15" in said
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert set(before) == {"EIPRK4-error.npz", "EIPRK4-euclidean.npz", "RK4.npz"}
    assert solar(tmp_path / "again", *words)[0] == 2
    assert solar(tmp_path / "second", *words, "--resume") == whole
    assert {name: (folder / name).read_bytes() for name in before} == before


@pytest.mark.parametrize(
    ("text", "julian_date"),
    [
        ("2000-01-01", "2451544.5"),
        ("2000-01-01 12:00:00 TDB", "2451545"),
        ("1549-12-31", "2287184.5"),
        ("2000-02-29T23:59:59", "2451604.49998842592592592592592"),
        ("2014-02-02T00:00:00.000000123", "2456690.500000000001423611111111111111111"),
        ("2451545.", "2451545"),
        ("JD 2451544.5 TDB", "2451544.5"),
        ("2456690.123456789012345678", "2456690.123456789012345678"),
        ("jd-3027215.5", "-3027215.5"),
    ],
)
def test_epochs_without_loss(text, julian_date):
    midnight, rest = parse_epoch(text)
    assert midnight % 1 == 0.5
    assert rest == float(Fraction(julian_date) - Fraction(midnight))


@pytest.mark.parametrize(
    "text", ["", "tomorrow", "nan", "2.4e6", "2014-2-2", "2014-02-02T20", "2014-02-02T20:18Z", "2000-01-01T24:00",
             "2000-01-01T12:00:60", "2001-02-29", "0000-01-01"],
)  # fmt: skip
def test_other_epochs_are_refused(text):
    with pytest.raises(ValueError, match=r"no such date|\"2451545\.0\", got"):
        parse_epoch(text)


@pytest.mark.usefixtures("few_methods")
def test_the_command_at_the_packages_epoch_and_at_another(kernel, tmp_path, capsys):
    span = ("--years", "1", "--h", "0.01")
    assert solar(tmp_path / "a", *span) == solar(tmp_path / "b", *span, "--epoch", "2014-02-02T20:18")
    assert solar(tmp_path / "c", *SPAN, "--epoch", "JD2460000.5", "--kernel", str(kernel))[0] == 0
    printed = capsys.readouterr().out
    assert "from 2023-02-25 00:00:00 TDB" in printed
    assert "Reference: EIPRKN12 (tight) at 0.1 yr" in printed


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--epoch", "3000-01-01"], "outside the kernel's span"),
        (["--epoch", "2000-01-01", "--data", "paper"], "not allowed with --data"),
        (["--kernel", "x.bsp"], "--kernel goes with --epoch"),
        (["--method", "EIPRK7"], "unknown method"),
        (["--forces", "1pn"], "--forces goes with --truth"),
        (["--truth", "--forces", "1pn", "eih"], "only one of them"),
        (["--truth", "--forces", "drag"], "unknown force"),
        (["--truth", "--h", "2", "--years", "-1"], "does not fit"),
        (["--truth", "--years", "0"], "expected a positive number"),
    ],
)
@pytest.mark.usefixtures("kernel", "few_methods")
def test_wrong_usage_is_one_line(tmp_path, capsys, words, message):
    assert solar(tmp_path, *words)[0] == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line


@pytest.mark.usefixtures("few_methods")
def test_a_missing_extra(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "jplephem.spk", None)
    assert solar(tmp_path, *SPAN, "--epoch", "2000-01-01")[0] == 2
    assert 'pip install "eip_scipy[jpl]"' in capsys.readouterr().err


@pytest.mark.needs_jit
def test_a_step_that_is_too_long_fails(kernel, tmp_path, capsys):
    assert solar(tmp_path, "--truth", "--years", "2", "--h", "0.05", "--forces", "1pn")[0] == 1
    assert "FAILED Newton: halving the step moves Mercury by" in capsys.readouterr().out
