"""The example scripts of PDEs run, and print small errors of the invariants and of the solution."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "kept", "solution"), [("korteweg_de_vries", 1e-13, 3e-5), ("sine_gordon", 1e-12, 1e-6)]
)
def test_script(name, kept, solution, tmp_path):
    pytest.importorskip("numba" if name == "sine_gordon" else "numpy")
    command = [sys.executable, EXAMPLES / f"{name}.py"]
    lines = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True).stdout.splitlines()
    errors = {line.split(":")[0].strip(): [float(e) for e in re.findall(r"off by ([\d.e+-]+)", line)] for line in lines}
    *invariants, error = errors["projected"]
    assert max(invariants) < kept
    assert error < solution
    assert max(errors["plain"][:-1]) > 100 * kept
