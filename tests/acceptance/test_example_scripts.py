"""The scripts of examples/ run as they stand and print what they are for."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPTS = {
    "periodic_orbit.py": (r"open by (\S+)\npublished: period off by (\S+), start by (\S+)\n", (1e-11, 1e-10, 1e-10)),
    "trajectory_fit.py": (r"mass .* off by (\S+) errors\n6 runs, mean square of the residuals (\S+)\n", (3.0, 1.2)),
    "linkage.py": (r"ends 1.4e\+00 m from its pivot\n.* kept: the last link ends (\S+) m", (1e-10,)),
    "stiff_systems.py": (r"magnet +\S+ +(\S+) .*\nchain +\S+ +(\S+) ", (5e-9, 1e-6)),
}


@pytest.mark.needs_jit
@pytest.mark.parametrize("script", SCRIPTS)
def test_example(script):
    ran = [sys.executable, "-W", "error", ROOT / "examples" / script]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    found = subprocess.run(ran, env=environment, capture_output=True, text=True, check=False)
    assert found.stderr == ""
    pattern, bounds = SCRIPTS[script]
    numbers = re.search(pattern, found.stdout).groups()
    assert all(abs(float(number)) < bound for number, bound in zip(numbers, bounds, strict=True)), found.stdout
