"""First runs of an installation: the package compiles nothing, stores nothing on disk, and loads nothing for it."""

import os
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

import eip_scipy

PACKAGE = Path(eip_scipy.__file__).parent
RUNS = """
    import sys
    import numpy as np
    from eip_scipy import EIPDOP853, EIPRK4, EIPRKN12, ensemble, integrate
    from eip_scipy.problems import Grid, GrossPitaevskii, harmonic, kepler, nbody, solar_system

    for problem in harmonic(), kepler(), solar_system(years=1), solar_system(years=1, forces="eih"):
        run = integrate(problem, method=EIPRK4)
        assert run.success and run.compiled, run.message
        assert set(run.calls.values()) == {"native"}
    gpe = GrossPitaevskii(Grid(64, -8, 8), beta=-1.0)
    wave = gpe.problem(1 / np.cosh(gpe.grid.points(0)), t_end=0.1, h=0.01)
    assert integrate(wave, method=EIPRK4).success
    problem = solar_system(years=1)
    assert integrate(problem, method=EIPRKN12).success
    assert ensemble(kepler(), (0, 10), [[0.4, 0, 0, 2]] * 16, method=EIPDOP853, h=0.1).success
    print([name for name in ("numba", "llvmlite") if name in sys.modules])
"""


@pytest.fixture
def installed(tmp_path):
    """A copy of the package whose folders take no caches: also where the tests run as root."""
    folder = tmp_path / "installed"
    shutil.copytree(PACKAGE, folder / "eip_scipy", ignore=shutil.ignore_patterns("__pycache__"))
    for place in [path for path in (folder / "eip_scipy").rglob("*") if path.is_dir()] + [folder / "eip_scipy"]:
        (place / "__pycache__").write_text("no folder")
    return folder


def test_problems_of_the_package_load_no_compiler(installed):
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("NUMBA_", "XDG_"))}
    run = subprocess.run(
        [sys.executable, "-W", "error", "-c", textwrap.dedent(RUNS)],
        env=environment | {"PYTHONPATH": str(installed), "HOME": "/dev/null"},
        cwd=installed,
        text=True,
        capture_output=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    assert run.stdout == "[]\n"
