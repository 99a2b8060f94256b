"""Tests of an installation with its dependencies only, run by `.ci/wheel`.

By assertions, since there is no pytest where it runs.
"""

import re
import subprocess
import sys
import sysconfig
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

import numpy as np

import eip_scipy
from eip_scipy import EIPRK4, ensemble, integrate
from eip_scipy.engine.native import BUILD
from eip_scipy.problems import Grid, GrossPitaevskii, kepler, solar_system

MEGABYTES = 6  # builds by zig contain their C++ library; building/wheels.py limits the size of the wheel itself
# Bound of the invariant errors; without projection those of the first example are 9e-5.
BOUND = 1e-11

package = Path(eip_scipy.__file__).parent
assert package == Path(sysconfig.get_path("platlib")) / "eip_scipy", f"{package} is not the installed package"
files = metadata.files("eip_scipy")
assert files is not None
size = sum(Path(file.locate()).stat().st_size for file in files if file.suffix != ".pyc")
assert size < MEGABYTES * 1e6, f"our own files take {size / 1e6:.1f} MB"
SUFFIXES = {"", ".json", ".py", ".pyc", ".pyd", ".pyi", ".so", ".txt", ".typed"}
assert {file.suffix for file in files} <= SUFFIXES, "more than the package"
assert {"py.typed", "LICENSE"} <= {file.name for file in files}
folders = {file.parts[0] for file in files} - {".."}  # above it the command
assert folders == {"eip_scipy", "eip_scipy_studies", f"eip_scipy-{eip_scipy.__version__}.dist-info"}, folders
assert find_spec("numba") is None, "Numba came along, which is an extra"

# The README's first example; the README is the wheel's description.
example = re.search(r"^```python\n(.*?)^```$", metadata.metadata("eip_scipy").get_payload(), re.MULTILINE | re.DOTALL)
names: dict = {}
exec(example[1], names)
assert np.ptp(names["H"](0, names["sol"].y)) < BOUND


gpe = GrossPitaevskii(Grid(256, -20, 20), beta=-1.0)
soliton = gpe.problem(1 / np.cosh(gpe.grid.points(0)), t_end=1.0, h=0.005)
for problem, t_span in (kepler(), (0, 100)), (solar_system(), (0, 100)), (soliton, (0, 1)):
    run = integrate(problem, t_span, method=EIPRK4)
    assert run.success, run.message
    assert run.trusted, run.message
    assert max(run.diagnostics.max_residual) < BOUND, run.diagnostics
starts = np.array([[0.4, 0, 0, 2], [0.5, 0, 0, 1.7]])
members = ensemble(kepler(), (0, 10), starts, method=EIPRK4)
assert members.success, members.message

assert metadata.version("eip_scipy") == eip_scipy.__version__
# Tests of its own, which pass without any extra.
subprocess.run([Path(sysconfig.get_path("scripts")) / "eip-scipy", "doctor"], check=True)
print(f"eip_scipy {eip_scipy.__version__} ({BUILD.__name__}) on {sys.version.split()[0]}: {size / 1e6:.2f} MB, works")
