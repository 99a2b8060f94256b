"""The scripts of examples/ run as they stand, print the numbers of the pages and draw their figures."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"
PNG = b"\x89PNG\r\n\x1a\n"
NUMBER = re.compile(r"(?<![\w.])-?\d+\.?\d*(?:e[+-]?\d+)?")


def printed(name, folder, *arguments):
    """Return the lines that a script prints in a folder, where it also draws its figure if it has one."""
    paths = os.pathsep.join([str(EXAMPLES.parent), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "MPLBACKEND": "Agg", "PYTHONPATH": paths}
    command = [sys.executable, "-W", "error", EXAMPLES / f"{name}.py", *arguments]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    assert all(path.read_bytes().startswith(PNG) for path in folder.glob("*.png"))
    return done.stdout.splitlines()


def numbers(line):
    return [float(number) for number in NUMBER.findall(line)]


@pytest.mark.slow
@pytest.mark.needs_jit
@pytest.mark.parametrize(
    ("name", "pattern", "bounds"),
    [
        ("periodic_orbit", r"open by (\S+)\npublished: period off by (\S+), start by (\S+)", (1e-11, 1e-10, 1e-10)),
        ("trajectory_fit", r"off by (\S+) errors\n6 runs, mean square of the residuals (\S+)", (3.0, 1.2)),
        ("linkage", r"ends 1.4e\+00 m from its pivot\n.* kept: the last link ends (\S+) m", (1e-10,)),
        ("course", r"kepler by EIPRK4: energy off by (\S+), state by (\S+)", (1e-12, 1e-3)),
        pytest.param("crystal", r"kept: .* by (\S+) of -504, .* by (\S+)", (1e-9, 1e-5), marks=pytest.mark.nightly),
        pytest.param(
            "stiff_systems", r"magnet +\S+ +(\S+) .*\nchain +\S+ +(\S+) ", (5e-9, 1e-6), marks=pytest.mark.nightly
        ),
    ],
)
def test_numbers_within_bounds(name, pattern, bounds, tmp_path):
    found = re.search(pattern, "\n".join(printed(name, tmp_path))).groups()
    assert all(abs(float(number)) < bound for number, bound in zip(found, bounds, strict=True)), found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "kept", "solution"), [("korteweg_de_vries", 1e-13, 3e-5), ("sine_gordon", 1e-12, 1e-6)]
)
def test_partial_differential_equations(name, kept, solution, tmp_path):
    pytest.importorskip("numba" if name == "sine_gordon" else "numpy")
    lines = printed(name, tmp_path)
    errors = {line.split(":")[0].strip(): [float(e) for e in re.findall(r"off by ([\d.e+-]+)", line)] for line in lines}
    *invariants, error = errors["projected"]
    assert max(invariants) < kept
    assert error < solution
    assert max(errors["plain"][:-1]) > 100 * kept


@pytest.mark.slow
def test_with_and_without(tmp_path):
    pytest.importorskip("matplotlib")
    plain, _, place, kept, energy, kept_place = printed("with_and_without", tmp_path)
    assert numbers(plain)[-1] == numbers(kept)[-1] == 9812
    assert max(numbers(energy)) < 1e-11
    assert numbers(place)[-1] == pytest.approx(240 * numbers(kept_place)[-1], rel=0.05)
    assert (tmp_path / "with-and-without.png").exists()


@pytest.mark.slow
def test_low_orbit(tmp_path):
    pytest.importorskip("matplotlib")
    (calls, metres, _), (more, fewer, _) = (numbers(line.partition(":")[2]) for line in printed("low_orbit", tmp_path))
    assert more / calls == pytest.approx(1.08, abs=0.01)
    assert metres / fewer == pytest.approx(80, rel=0.1)
    assert (tmp_path / "low-orbit.png").exists()


@pytest.mark.nightly
@pytest.mark.needs_jit
def test_balances(tmp_path):
    found = {line.split(":")[0]: numbers(line.partition("ratio")[2]) for line in printed("balances", tmp_path)}
    ratios, warned = ([row[k] for row in found.values()] for k in (0, 1))
    assert ratios == pytest.approx([5600, 4, 0.0095, 260, 7.4, 0.98, 13, 0.12], rel=0.3)
    assert warned == [0, 0, 6, 0, 6, 0, 0, 6]


@pytest.mark.slow
@pytest.mark.needs_jit
@pytest.mark.parametrize(
    ("points", "revolutions"), [(4, 300), pytest.param(20, 2000, marks=pytest.mark.nightly)], ids=["few", "many"]
)
def test_megno_map_is_that_of_rebound(tmp_path, points, revolutions):
    pytest.importorskip("rebound")
    pytest.importorskip("matplotlib")
    *_, compared, _ = printed("megno_map", tmp_path, str(points), str(revolutions))
    same, clear, again, both = numbers(compared)
    assert clear >= 0.9 * points**2
    assert same >= 0.98 * clear
    assert again >= 0.98 * both
    assert (tmp_path / "megno-map.png").exists()


@pytest.mark.nightly
def test_growth(tmp_path):
    pytest.importorskip("matplotlib")
    (line,) = (line for line in printed("growth", tmp_path) if line.startswith("EIPGJ14, balances"))
    mercury, earth, jupiter = (float(error) for error in re.findall(r"(\S+) AU", line))
    assert mercury == pytest.approx(1.2e-11, rel=0.2)
    assert earth < 4e-13
    assert jupiter < 1e-13
    assert (tmp_path / "growth.png").exists()
