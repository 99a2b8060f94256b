"""The example scripts that replace studies run as they stand, print the numbers of the pages and draw their figures."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"
PNG = b"\x89PNG\r\n\x1a\n"
pytestmark = pytest.mark.slow


def printed(name, folder, *arguments):
    environment = {**os.environ, "MPLBACKEND": "Agg"}
    command = [sys.executable, EXAMPLES / f"{name}.py", *arguments]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=True)
    return done.stdout.splitlines()


def numbers(line):
    return [float(number) for number in re.findall(r"(?<![\w.])-?\d+\.?\d*(?:e[+-]?\d+)?", line)]


def test_with_and_without(tmp_path):
    pytest.importorskip("matplotlib")
    plain, _, place, kept, energy, kept_place = printed("with_and_without", tmp_path)
    assert numbers(plain)[-1] == numbers(kept)[-1] == 9812
    assert max(numbers(energy)) < 1e-11
    assert numbers(place)[-1] == pytest.approx(270 * numbers(kept_place)[-1], rel=0.05)
    assert (tmp_path / "with-and-without.png").read_bytes().startswith(PNG)


def test_low_orbit(tmp_path):
    pytest.importorskip("matplotlib")
    (calls, metres, _), (more, fewer, _) = (numbers(line.partition(":")[2]) for line in printed("low_orbit", tmp_path))
    assert more / calls == pytest.approx(1.08, abs=0.01)
    assert metres / fewer == pytest.approx(80, rel=0.1)
    assert (tmp_path / "low-orbit.png").read_bytes().startswith(PNG)


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.needs_jit
def test_balances(tmp_path):
    found = {line.split(":")[0]: numbers(line.partition("ratio")[2]) for line in printed("balances", tmp_path)}
    ratios, warned = ([row[k] for row in found.values()] for k in (0, 1))
    assert ratios == pytest.approx([5600, 4, 0.0095, 260, 7.4, 0.98, 13, 0.12], rel=0.3)
    assert warned == [0, 0, 6, 0, 6, 0, 0, 6]


@pytest.mark.needs_jit
def test_megno_map(tmp_path):
    pytest.importorskip("rebound")
    pytest.importorskip("matplotlib")
    _, compared = printed("megno_map", tmp_path, "3")
    assert numbers(compared) == [9, 5, 4, 0]
    assert (tmp_path / "megno-map.png").read_bytes().startswith(PNG)


@pytest.mark.nightly
def test_growth(tmp_path):
    pytest.importorskip("matplotlib")
    (line,) = (line for line in printed("growth", tmp_path) if line.startswith("EIPGJ14, balances"))
    mercury, earth, jupiter = (float(error) for error in re.findall(r"(\S+) AU", line))
    assert mercury == pytest.approx(1.2e-11, rel=0.2)
    assert earth < 4e-13
    assert jupiter < 1e-13
    assert (tmp_path / "growth.png").read_bytes().startswith(PNG)
